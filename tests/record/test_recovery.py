"""What a crash has left becomes a whole recording: everything good is in it, nothing is invented."""

import fcntl
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader

from aemd.block import ESTIMATE, READING, Batch, Block, Estimates
from aemd.errors import RecordingError
from aemd.record.check import check
from aemd.record.reader import Recording
from aemd.record.recovery import recover, recover_folder
from aemd.record.writer import Recorder
from tests.record.made import DESCRIPTION, estimates_of, eventful_batch, readings_of, records_of

WITH_WITNESS = replace(DESCRIPTION, witnesses={"temperature": "degC"})
COUNT, CHUNK_BYTES = 60, 2500


@pytest.fixture
def small(record: Callable[..., Path]) -> tuple[bytes, Block, Estimates]:
    """A finished file of some chunks, and what is in it."""
    readings = readings_of(COUNT)
    estimates = estimates_of(readings)
    path = record([(Batch(readings), estimates)], chunk_bytes=CHUNK_BYTES)
    return path.read_bytes(), readings, estimates


@pytest.fixture
def ram(tmp_path: Path) -> Iterator[Path]:
    """A folder that syncs in no time, where there is one: what a recovery owes the disk is not what is tested."""
    memory = Path("/dev/shm")
    with TemporaryDirectory(dir=memory if memory.is_dir() else tmp_path) as folder:
        yield Path(folder)


def _content(path: Path) -> tuple[Block, Estimates]:
    with Recording(path) as recording:
        recording.verify()
        pairs = list(recording.batches_with_estimates())
    readings = np.concatenate([np.empty(0, READING), *(batch.readings for batch, _ in pairs)])
    return readings, np.concatenate([np.empty(0, ESTIMATE), *(estimates for _, estimates in pairs)])


def _library_count(path: Path) -> int:
    """Return how many messages the mcap package's two readers find; both must find the same."""
    with path.open("rb") as file:
        streamed = sum(isinstance(found, Message) for found in StreamReader(file, validate_crcs=True).records)
    with path.open("rb") as file:
        sought = sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())
    assert streamed == sought
    return sought


def _expect_whole(path: Path) -> tuple[Block, Estimates]:
    readings, estimates = _content(path)
    result = check(path)
    assert result.whole, result.findings
    return readings, estimates


@pytest.mark.parametrize("step", [101, pytest.param(1, marks=[pytest.mark.slow, pytest.mark.timeout(600)])])
def test_a_file_cut_at_any_byte_becomes_a_whole_one_with_every_whole_chunk(
    small: tuple[bytes, Block, Estimates], ram: Path, step: int
) -> None:
    """At every byte near the ends of records; elsewhere at every 101st, and at every one where there is time."""
    octets, readings, estimates = small
    edges = {at + near for _, at, _ in records_of(octets) for near in (-1, 0, 1, 8, 9, 10)}
    ends = [at + 9 + len(body) for opcode, at, body in records_of(octets) if opcode == 0x06]
    assert len(ends) >= 3
    per_chunk = [int(np.ceil(CHUNK_BYTES / (45 + 91))) for _ in ends]
    for length in range(len(octets)):
        if length % step and length not in edges:
            continue
        active, path = ram / f"{length}.mcap.active", ram / f"{length}.mcap"
        active.write_bytes(octets[:length])
        if length < ends[0]:
            with pytest.raises(RecordingError):
                recover(active)
            assert active.read_bytes() == octets[:length]
            active.unlink()
            continue

        found = recover(active)

        read, made = _expect_whole(path)
        assert not active.exists()
        assert read.tobytes() == readings[: len(read)].tobytes()
        assert made.tobytes() == estimates[: len(made)].tobytes()
        whole = sum(end <= length for end in ends)
        assert found.chunks == whole
        assert (
            abs(len(read) - min(sum(per_chunk[:whole]), COUNT)) <= whole
        )  # a chunk ends with the message that fills it
        assert (found.readings, found.estimates) == (len(read), len(made))
        if length % 97 == 0:
            assert _library_count(path) == len(read) + len(made)
        path.unlink()


@pytest.mark.parametrize("tail", [b"\0" * 7, b"\0" * 4096, b"\xff" * 64, b"\x06" * 5000, b"\x80" + b"\0" * 40])
def test_a_tail_of_rubbish_is_cut_off(small: tuple[bytes, Block, Estimates], tmp_path: Path, tail: bytes) -> None:
    octets, readings, _ = small
    third = [at for opcode, at, _ in records_of(octets) if opcode == 0x06][2]
    active = tmp_path / "x.mcap.active"
    active.write_bytes(octets[:third] + tail)

    found = recover(active)

    read, _ = _expect_whole(tmp_path / "x.mcap")
    assert read.tobytes() == readings[: len(read)].tobytes()
    assert found.chunks == 2
    assert found.dropped_bytes == len(tail) or tail.startswith(b"\x80")
    assert (tmp_path / "x.mcap").read_bytes().startswith(octets[:third])


@pytest.mark.parametrize("seed", range(60))
def test_a_hole_of_zeros_anywhere_costs_no_more_than_the_chunks_it_touches(
    record: Callable[..., Path], tmp_path: Path, seed: int
) -> None:
    readings = readings_of(1000)
    estimates = estimates_of(readings)
    octets = record([(Batch(readings), estimates)], chunk_bytes=8000, compression="none").read_bytes()
    records = records_of(octets)
    chunks = [(at, at + 9 + len(body)) for opcode, at, body in records if opcode == 0x06]
    data_end = next(at for opcode, at, _ in records if opcode == 0x0F)
    rng = np.random.default_rng(seed)
    begin = int(rng.integers(chunks[0][0], data_end - 4096))
    holed = bytearray(octets[:data_end])
    holed[begin : begin + 4096] = bytes(4096)
    active = tmp_path / "h.mcap.active"
    active.write_bytes(holed)

    found = recover(active)

    read, made = _expect_whole(tmp_path / "h.mcap")
    untouched = sum(end <= begin or at >= begin + 4096 for at, end in chunks)
    assert found.chunks >= untouched
    assert found.damaged_stretches <= 1
    assert read.tobytes() == readings[np.isin(readings["index"], read["index"])].tobytes()
    assert made.tobytes() == estimates[np.isin(estimates["index"], made["index"])].tobytes()
    assert len(read) >= untouched * 58
    # An independent reader finds the same, through the summary and without it.
    assert _library_count(tmp_path / "h.mcap") >= len(read) + len(made)
    # No good byte was touched: what differs lies in the hole, in what it damaged, or behind the end.
    now = np.frombuffer((tmp_path / "h.mcap").read_bytes()[:data_end], np.uint8)
    changed = np.flatnonzero(now != np.frombuffer(bytes(holed), np.uint8, len(now)))
    damaged = [(at, end) for at, end in chunks if at < begin + 4096 and end > begin]
    allowed = [(begin, begin + 4096), *damaged]
    if untouched + len(damaged) == len(chunks) and found.dropped_bytes == 0:
        assert all(any(at - 9 <= place < end + 4096 for at, end in allowed) for place in changed.tolist())


def test_readings_that_a_damaged_stretch_has_taken_are_told_of_as_lost(
    small: tuple[bytes, Block, Estimates], tmp_path: Path
) -> None:
    octets, readings, _ = small
    records = records_of(octets)
    at, body = next((at, body) for opcode, at, body in [r for r in records if r[0] == 0x06][1:])
    changed = bytearray(octets)
    changed[at + 9 + len(body) // 2] ^= 0x10
    active = tmp_path / "x.mcap.active"
    active.write_bytes(changed)

    found = recover(active)

    with Recording(tmp_path / "x.mcap") as recording:
        batches = list(recording.batches())
        close = recording.metadata["aemd.close"]
    read = np.concatenate([batch.readings for batch in batches])
    missing = sorted(set(readings["index"].tolist()) - set(read["index"].tolist()))
    events = [event for batch in batches for event in batch.events]
    assert [(event.kind, event.first_index, event.last_index) for event in events] == [("gap", missing[0], missing[-1])]
    assert (found.damaged_stretches, found.lost, found.gaps) == (1, len(missing), 1)
    assert (close["reason"], close["damaged_stretches"]) == ("recovered", "1")
    result = check(tmp_path / "x.mcap")
    assert result.whole, result.findings
    assert any("recovery passed over" in note for note in result.notes)


def test_wrong_and_missing_message_indexes_are_rebuilt(small: tuple[bytes, Block, Estimates], tmp_path: Path) -> None:
    octets, readings, estimates = small
    changed = bytearray(octets)
    first, second = [at for opcode, at, _ in records_of(octets) if opcode == 0x07][:2]
    struct.pack_into("<Q", changed, first + 9 + 6 + 8, 12345)
    changed[second : second + 9] = bytes(9)
    active = tmp_path / "x.mcap.active"
    active.write_bytes(changed)

    found = recover(active)

    read, made = _expect_whole(tmp_path / "x.mcap")
    assert found.indexes_rebuilt >= 2
    assert (read.tobytes(), made.tobytes()) == (readings.tobytes(), estimates.tobytes())
    data_end = next(at for opcode, at, _ in records_of(octets) if opcode == 0x0F)
    assert (tmp_path / "x.mcap").read_bytes()[:data_end] == octets[:data_end]


def test_events_and_witnesses_come_back_and_the_figures_are_those_of_the_file(
    record: Callable[..., Path], tmp_path: Path
) -> None:
    batch, estimates = eventful_batch()
    octets = record([(batch, estimates)], WITH_WITNESS).read_bytes()
    at = [at for opcode, at, _ in records_of(octets) if opcode == 0x0C][-1]  # the closing note
    active = tmp_path / "x.mcap.active"
    active.write_bytes(octets[:at])

    found = recover(active)

    with Recording(tmp_path / "x.mcap") as recording:
        (read,) = recording.batches()
        assert recording.description == WITH_WITNESS
        assert recording.statistics().lost == found.lost == 5
    assert read.events == batch.events
    assert read.witnesses["temperature"].tobytes() == batch.witnesses["temperature"].tobytes()


def test_a_recovery_that_is_interrupted_can_be_repeated(small: tuple[bytes, Block, Estimates], ram: Path) -> None:
    octets, readings, _ = small
    records = records_of(octets)
    bad = [at for opcode, at, _ in records if opcode == 0x06][1]
    last = [at + 9 + len(body) for opcode, at, body in records if opcode == 0x06][-1]
    changed = bytearray(octets[: last + 5])
    changed[bad + 60] ^= 1
    active = ram / "x.mcap.active"
    active.write_bytes(changed)
    recover(active)
    done = (ram / "x.mcap").read_bytes()
    whole, _ = _expect_whole(ram / "x.mcap")
    for length in range(last, len(done), 31):
        again = ram / "again.mcap.active"
        again.write_bytes(done[:length])

        recover(again)

        read, _ = _expect_whole(ram / "again.mcap")
        assert read.tobytes() == whole.tobytes()
        (ram / "again.mcap").unlink()
    assert len(whole) < len(readings)


def test_a_whole_file_is_left_as_it_is(small: tuple[bytes, Block, Estimates], tmp_path: Path) -> None:
    octets, _, _ = small
    for name in ("x.mcap.active", "y.mcap"):
        (tmp_path / name).write_bytes(octets)
        recover(tmp_path / name)

    assert (tmp_path / "x.mcap").read_bytes() == (tmp_path / "y.mcap").read_bytes() == octets


def test_what_a_living_writer_holds_is_refused_and_passed_over(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "r.mcap", DESCRIPTION)
    recorder.write(Batch(readings_of(5)), np.empty(0, ESTIMATE))

    with pytest.raises(RecordingError, match=r"r\.mcap\.active: is being written by another program"):
        recover(tmp_path / "r.mcap.active")
    assert list(recover_folder(tmp_path)) == []
    recorder.close()


def test_a_name_that_is_taken_is_left_alone(small: tuple[bytes, Block, Estimates], tmp_path: Path) -> None:
    octets, _, _ = small
    (tmp_path / "x.mcap").write_text("mine")
    (tmp_path / "x.mcap.active").write_bytes(octets[:-20])

    with pytest.raises(RecordingError, match=r"x\.mcap: exists: a recording is never overwritten"):
        recover(tmp_path / "x.mcap.active")

    assert (tmp_path / "x.mcap").read_text() == "mine"
    assert (tmp_path / "x.mcap.active").read_bytes() == octets[:-20]


@pytest.mark.parametrize("octets", [b"", b"time,value\n0,1\n", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + bytes(500)])
def test_what_is_no_recording_is_refused_in_one_line_and_left_alone(tmp_path: Path, octets: bytes) -> None:
    path = tmp_path / "x.mcap.active"
    path.write_bytes(octets)

    with pytest.raises(RecordingError) as refused:
        recover(path)

    assert "\n" not in str(refused.value)
    assert path.read_bytes() == octets
    with pytest.raises(RecordingError, match="cannot be opened: no such file"):
        recover(tmp_path / "nothing.mcap.active")


def test_all_that_is_left_in_a_folder_is_recovered_with_a_line_each(
    small: tuple[bytes, Block, Estimates], tmp_path: Path
) -> None:
    octets, _, _ = small
    for name in ("a", "b"):
        (tmp_path / f"{name}.mcap.active").write_bytes(octets[:-30])
    (tmp_path / "c.mcap.active").write_bytes(b"")
    with (tmp_path / "b.mcap.active").open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        lines = list(recover_folder(tmp_path))

    assert len(lines) == 2
    assert lines[0].startswith(f"recovered={tmp_path / 'a.mcap'} readings={COUNT} lost=0")
    assert lines[1].startswith("not recovered: ")
    assert (tmp_path / "b.mcap.active").exists()


def test_what_is_no_file_of_a_disk_is_one_line_and_no_fault_of_stdout() -> None:
    with pytest.raises(RecordingError, match="/dev/null: cannot be recovered: "):
        recover(Path("/dev/null"))


@pytest.mark.parametrize("behind", [b"", bytes(9000)])
def test_a_file_that_never_got_a_reading_is_removed_and_not_told_of_again(tmp_path: Path, behind: bytes) -> None:
    recorder = Recorder(tmp_path / "begun.mcap", DESCRIPTION)
    active = recorder.active
    begun = active.read_bytes()
    recorder.close("stop")
    (tmp_path / "begun.mcap").unlink()
    active.write_bytes(begun + behind)

    assert list(recover_folder(tmp_path)) == [f"removed={active} readings=0"]
    assert not active.exists()


@pytest.mark.parametrize("behind", [b"\x06" + bytes(40), b"something"])
def test_a_file_with_anything_behind_its_beginning_is_not_removed(tmp_path: Path, behind: bytes) -> None:
    recorder = Recorder(tmp_path / "begun.mcap", DESCRIPTION)
    active = recorder.active
    begun = active.read_bytes().rstrip(b"\0")
    recorder.close("stop")
    active.write_bytes(begun + behind)
    (tmp_path / "empty.mcap.active").touch()  # somebody may be about to lock it

    lines = list(recover_folder(tmp_path))

    assert [line.split(":")[0] for line in lines] == ["not recovered"] * 2
    assert active.exists()
    assert (tmp_path / "empty.mcap.active").exists()


def test_a_file_that_somebody_has_just_begun_is_left_to_them(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "begun.mcap", DESCRIPTION)

    assert list(recover_folder(tmp_path)) == []
    assert recorder.active.exists()
    recorder.close("stop")
