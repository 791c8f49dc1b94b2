"""A damaged chunk is told of as that, and takes no more memory than it states, whatever its packed frame says."""

import mmap
import struct
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard

from aemd.record.unpack import BadChunkError, unpack
from aemd.record.walk import Record

CONTENTS = bytes(range(256)) * 16


@pytest.fixture
def unpacked(tmp_path: Path) -> Callable[..., bytes]:
    """Return a function that unpacks what is packed by that compression, in a chunk that states that size."""

    def run(packed: bytes, compression: bytes, size: int = len(CONTENTS)) -> bytes:
        head = struct.pack("<QQQI", 0, 0, size, 0) + struct.pack("<I", len(compression)) + compression
        path = tmp_path / "chunk"
        path.write_bytes(head + struct.pack("<Q", len(packed)) + packed)
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as octets:
            return unpack(octets, Record(0x06, 0, 0, len(octets)))[1]

    return run


@pytest.mark.parametrize("tells_size", [True, False])
def test_a_frame_is_unpacked_whether_or_not_it_tells_its_size(
    unpacked: Callable[..., bytes], *, tells_size: bool
) -> None:
    zstd = zstandard.ZstdCompressor(write_content_size=tells_size).compress(CONTENTS)
    lz = lz4.frame.compress(CONTENTS, store_size=tells_size)

    assert unpacked(zstd, b"zstd") == CONTENTS
    assert unpacked(lz, b"lz4") == CONTENTS
    assert unpacked(lz4.frame.compress(b"", store_size=tells_size), b"lz4", 0) == b""


def test_any_bit_of_a_frame_s_head_may_be_wrong(unpacked: Callable[..., bytes]) -> None:
    """A Zstandard frame may tell a size of eight bytes (RFC 8878, 3.1.1.1), which is more than any memory."""
    packed = zstandard.ZstdCompressor().compress(CONTENTS)

    for bit in range(8 * 18):
        changed = bytearray(packed)
        changed[bit // 8] ^= 1 << bit % 8
        try:
            assert len(unpacked(bytes(changed), b"zstd")) == len(CONTENTS)
        except BadChunkError:
            continue


def test_a_frame_that_tells_another_size_than_its_chunk_is_refused_unopened(unpacked: Callable[..., bytes]) -> None:
    """Frame head by RFC 8878, 3.1.1: magic, single segment with a size of eight bytes, 2**62."""
    packed = b"\x28\xb5\x2f\xfd\xe0" + (1 << 62).to_bytes(8, "little") + b"\x01\0\0"

    with pytest.raises(BadChunkError, match=r"^does not unpack to the 4096 bytes that it states$"):
        unpacked(packed, b"zstd")


def _status_bytes(name: str) -> int:
    """Return a figure of the kernel's about this process."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:"))


@pytest.mark.parametrize("tells_size", [True, False])
def test_an_lz4_frame_is_unpacked_no_farther_than_its_chunk_states(
    unpacked: Callable[..., bytes], *, tells_size: bool
) -> None:
    packed = lz4.frame.compress(bytes(100 << 20), store_size=tells_size)

    before = _status_bytes("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
    with pytest.raises(BadChunkError, match=r"^does not unpack to the 1000 bytes that it states$"):
        unpacked(packed, b"lz4", 1000)

    assert _status_bytes("VmHWM") - before < 20 << 20
