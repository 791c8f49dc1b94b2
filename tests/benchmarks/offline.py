"""A recording through AEM into a recording, on one core: ours beside a loop over the mcap package and filterpy.

The loop is what a script does today: the package's reader and decoder, filterpy's Kalman filter, the package's writer.
"Alone" is what no program of this shape can leave out: unpacking, estimating and packing the same chunks, nothing else.
Seconds are of the processor, so that other programs on the machine disturb the ratios less.
"""

import tempfile
import time
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import zstandard
from filterpy.kalman import KalmanFilter
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message_factory import GetMessages
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory

from aemd.block import Batch, make_block
from aemd.config import name_estimator
from aemd.estimate.registry import make_estimator
from aemd.record.description import Description
from aemd.record.growing import compressor_for
from aemd.record.reader import Recording
from aemd.record.schema import FILTERED, RAW, SCHEMA_DATA, SCHEMAS
from aemd.record.writer import Recorder
from aemd.replay import replay

READINGS = 10_000_000
LIBRARY_READINGS = 100_000
BLOCK = 65_536
INTERVAL_S = 1e-4


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        compare(Path(folder), READINGS, LIBRARY_READINGS)


def compare(folder: Path, readings: int, library_readings: int) -> None:
    """Print readings/s of each, and the ratios."""
    whole, short = folder / "whole.mcap", folder / "short.mcap"
    make(whole, readings)
    make(short, library_readings)
    replay(short)  # compiles

    ours = readings / _cpu_s(lambda: replay(whole, out=folder / "ours.mcap"))
    size = (folder / "ours.mcap").stat().st_size / readings
    (folder / "ours.mcap").unlink()
    theirs = library_readings / _cpu_s(lambda: loop(short, folder / "theirs.mcap"))
    alone = readings / _cpu_s(lambda: bare(whole))
    read = readings / _cpu_s(lambda: count(whole, RAW))
    read_both = readings / _cpu_s(lambda: count(whole, FILTERED))
    library_read = library_readings / _cpu_s(lambda: count_by_library(short))

    print(f"offline: {readings:,} readings with estimates, two channels, {size:.1f} bytes each, AEM, one core")
    print(f"  MCAP to MCAP   {ours / 1e6:7.3f} M readings/s   {ours / theirs:7.1f} x mcap's and filterpy's loop")
    print(f"                                            {ours / alone:7.2f} x unpack + estimate + pack alone")
    print(f"  read           {read / 1e6:7.3f} M readings/s   {read / library_read:7.1f} x the mcap package's reader")
    print(f"  read both      {read_both / 1e6:7.3f} M readings/s")


def make(path: Path, readings: int) -> None:
    """Write readings of white noise, and AEM's estimates of them."""
    choice, rng = name_estimator("aem"), np.random.default_rng(1)
    estimator = make_estimator("aem", choice.options, INTERVAL_S)
    recorder = Recorder(path, Description(interval_s=INTERVAL_S, estimator=choice.as_text()))
    for begin in range(0, readings, BLOCK):
        values_V = np.round(1e-3 * rng.standard_normal(min(BLOCK, readings - begin)), 8)
        block = make_block(values_V, first_index=begin, t0_ns=10**18 + begin * 100_000, interval_ns=1e5)
        recorder.write(Batch(block), estimator.push(block))
    recorder.close()


def loop(path: Path, out: Path) -> None:
    """Filter each reading in a loop, message by message."""
    messages = GetMessages(FileDescriptorSet.FromString(SCHEMA_DATA).file)
    filter_ = KalmanFilter(dim_x=1, dim_z=1)
    filter_.F = filter_.H = np.eye(1)
    filter_.Q, filter_.R = np.array([[1e-8]]), np.array([[1e-6]])
    with path.open("rb") as source, out.open("wb") as target:
        writer = Writer(target, compression=CompressionType.ZSTD)
        writer.start()
        channels = [
            writer.register_channel(topic, "protobuf", writer.register_schema(SCHEMAS[topic], "protobuf", SCHEMA_DATA))
            for topic in (RAW, FILTERED)
        ]
        reader = make_reader(source, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, _, message, reading in reader.iter_decoded_messages(topics=[RAW]):
            filter_.predict()
            filter_.update(reading.value)
            estimate = messages[SCHEMAS[FILTERED]](value=float(filter_.x[0, 0]), sigma=float(filter_.P[0, 0]) ** 0.5)
            for channel, data in zip(channels, (message.data, estimate.SerializeToString()), strict=True):
                writer.add_message(channel, message.log_time, data, message.publish_time, message.sequence)
        writer.finish()


def bare(path: Path) -> None:
    """Unpack each chunk, estimate as many readings as it holds, and pack it again."""
    estimator = make_estimator("aem", name_estimator("aem").options, INTERVAL_S)
    unpack, pack = zstandard.ZstdDecompressor(), compressor_for("zstd-fast")  # as a replay packs
    assert pack is not None
    block = make_block(np.round(1e-3 * np.random.default_rng(1).standard_normal(BLOCK), 8), interval_ns=1e5)
    done = 0
    for chunk in _chunks(path):
        octets = unpack.decompress(chunk.data, max_output_size=chunk.uncompressed_size)
        count = len(octets) // 136  # a reading takes 45 bytes, its estimate 91
        estimator.push(block[:count])
        block["index"] += count
        done += count
        pack.compress(octets)
    assert done


def count(path: Path, topic: str) -> None:
    with Recording(path) as recording:
        if topic == RAW:
            assert sum(batch.readings.size for batch in recording.batches())
        else:
            assert sum(estimates.size for _, estimates in recording.batches_with_estimates())


def count_by_library(path: Path) -> None:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert sum(1 for _ in reader.iter_decoded_messages(topics=[RAW]))


def _chunks(path: Path) -> Iterator[Chunk]:
    """Yield each chunk, by walking over the records' lengths."""
    octets = path.read_bytes()
    at = 8
    while octets[at] != Opcode.FOOTER:
        end = at + 9 + int.from_bytes(octets[at + 1 : at + 9], "little")
        if octets[at] == Opcode.CHUNK:
            yield Chunk.read(ReadDataStream(BytesIO(octets[at + 9 : end])))
        at = end


def _cpu_s(work: Callable[[], object]) -> float:
    begun = time.process_time()
    work()
    return time.process_time() - begun


if __name__ == "__main__":
    main()
