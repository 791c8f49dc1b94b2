"""What other programs wrote: read where it is ours in other clothes, refused in one line where it is not."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from aemd.block import Batch
from aemd.errors import RecordingError
from aemd.record.reader import Recording
from aemd.record.schema import SCHEMA_DATA
from aemd.record.source import Selection, open_readings
from tests.record.made import DESCRIPTION, NO_ESTIMATES, read_all, readings_of


def _rewrite(source: Path, target: Path, **options: object) -> None:
    """Copy the messages with the mcap package's own writer, which puts schemas and channels into the chunks."""
    with source.open("rb") as file, target.open("wb") as out:
        writer = Writer(out, **options)  # type: ignore[arg-type]
        writer.start()
        schema = writer.register_schema("aemd.v1.Reading", "protobuf", SCHEMA_DATA)
        channel = writer.register_channel("/dmm/raw", "protobuf", schema)
        for message in StreamReader(file).records:
            if isinstance(message, Message):
                writer.add_message(channel, message.log_time, message.data, message.publish_time, message.sequence)
        writer.finish()


def test_a_recording_that_another_writer_rewrote_reads_the_same(record: Callable[..., Path], tmp_path: Path) -> None:
    readings = readings_of(500)
    path = record([(Batch(readings), NO_ESTIMATES)], replace(DESCRIPTION, estimator={}))
    _rewrite(path, tmp_path / "other.mcap", chunk_size=3000)

    with Recording(tmp_path / "other.mcap") as recording:
        assert recording.statistics().readings == 500

    assert read_all(tmp_path / "other.mcap")[1].tobytes() == readings.tobytes()


def _foreign(path: Path, topic: str, encoding: str, schema: str, data: bytes, **options: object) -> Path:
    with path.open("wb") as out:
        writer = Writer(out, **options)  # type: ignore[arg-type]
        writer.start()
        number = writer.register_schema(schema, "protobuf", data)
        channel = writer.register_channel(topic, encoding, number)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("made", "complaint"),
    [
        (("/imu", "json", "Imu", b""), r"has no topic /dmm/raw of aemd\.v1\.Reading, which we need; its topics: /imu$"),
        (
            ("/dmm/raw", "json", "Volt", b""),
            r"topic /dmm/raw has 'Volt' as 'json'; we read aemd\.v1\.Reading as protobuf",
        ),
        (("/dmm/raw", "protobuf", "aemd.v1.Reading", b""), r"lacks one of value, status"),
        (("/dmm/raw", "protobuf", "aemd.v1.Reading", b"\xff"), r"lacks one of value, status"),
        (("/dmm/raw", "protobuf", "aemd.v1.Reading", SCHEMA_DATA), r"chunk at byte \d+ holds a message that is not of"),
    ],
)
def test_a_foreign_recording_is_refused_in_one_line(tmp_path: Path, made: tuple, complaint: str) -> None:
    path = _foreign(tmp_path / "other.mcap", *made)

    with pytest.raises(RecordingError, match=complaint) as refused:
        read_all(path)
    assert "\n" not in str(refused.value)


def _merged(recordings: Sequence[Path], target: Path) -> Path:
    """Copy the readings of recordings, each with a channel of its own, as a merge does, behind two of others."""
    with target.open("wb") as out:
        writer = Writer(out)
        writer.start()
        for origin in ("left", "right"):
            writer.register_channel("/imu", "json", 0, {"from": origin})
        schema = writer.register_schema("aemd.v1.Reading", "protobuf", SCHEMA_DATA)
        for path in recordings:
            channel = writer.register_channel("/dmm/raw", "protobuf", schema, {"from": path.name})
            with path.open("rb") as file:
                for message in StreamReader(file).records:
                    if isinstance(message, Message):
                        writer.add_message(
                            channel, message.log_time, message.data, message.publish_time, message.sequence
                        )
        writer.finish()
    return target


def test_two_channels_of_readings_are_refused_with_a_way_to_read_both(
    record: Callable[..., Path], tmp_path: Path
) -> None:
    readings = readings_of(100)
    halves = {"a.mcap": readings[:50], "b.mcap": readings[50:]}
    path = _merged(
        [record([(Batch(half), NO_ESTIMATES)], name=name) for name, half in halves.items()], tmp_path / "both.mcap"
    )

    with pytest.raises(RecordingError, match=r"two channels on /dmm/raw, 3 and 4, .* --topic /dmm/raw --field value"):
        Recording(path)
    with open_readings(path, Selection("/dmm/raw", "value")) as recording:
        taken = np.concatenate([batch.readings for batch in recording.batches()])
    assert taken["value_V"].tobytes() == readings["value_V"].tobytes()
    assert taken["t_ns"].tobytes() == readings["t_ns"].tobytes()


def test_two_channels_on_a_topic_of_another_program_do_no_harm(record: Callable[..., Path], tmp_path: Path) -> None:
    readings = readings_of(100)
    path = _merged([record([(Batch(readings), NO_ESTIMATES)])], tmp_path / "other.mcap")

    assert read_all(path)[1].tobytes() == readings.tobytes()


def test_compression_and_layout_that_we_do_not_read_are_refused_in_one_line(tmp_path: Path) -> None:
    told = ("/dmm/raw", "protobuf", "aemd.v1.Reading", SCHEMA_DATA)
    path = _foreign(tmp_path / "lz4.mcap", *told, compression=CompressionType.LZ4)
    path.write_bytes(path.read_bytes().replace(b"lz4", b"lz5"))

    with pytest.raises(RecordingError, match="is compressed with 'lz5', of which we read zstd and lz4 only"):
        read_all(path)
    with pytest.raises(RecordingError, match="has a message outside a chunk at byte"):
        Recording(_foreign(tmp_path / "flat.mcap", *told, use_chunking=False))


@pytest.mark.parametrize("octets", [b"", b"time,value\n0,1\n", b"\x89MCAP0\r", b"\x89PNG\r\n\x1a\n" * 10])
def test_what_is_no_mcap_file_is_refused_in_one_line(tmp_path: Path, octets: bytes) -> None:
    (tmp_path / "x.mcap").write_bytes(octets)

    with pytest.raises(RecordingError, match=r"x\.mcap: is (no MCAP file|empty): "):
        Recording(tmp_path / "x.mcap")
    with pytest.raises(RecordingError, match=r"y\.mcap: cannot be read: no such file"):
        Recording(tmp_path / "y.mcap")
    with pytest.raises(RecordingError, match=r"is a folder: name the files in it, as .*/\*\.mcap$"):
        Recording(tmp_path)
