import fcntl
import math
import resource
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.records import Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from aemd.block import ESTIMATE, READING, Batch, Estimates
from aemd.errors import RecordingError
from aemd.record.reader import Recording
from aemd.record.writer import Recorder
from tests.record.made import DESCRIPTION, T0_NS, estimates_of, eventful_batch, readings_of, records_of

NOTHING: tuple[Batch, Estimates] = (Batch(np.empty(0, READING)), np.empty(0, ESTIMATE))
WITH_WITNESS = replace(DESCRIPTION, witnesses={"temperature": "degC"})


def test_an_independent_reader_finds_every_reading_and_estimate_once(record: Callable[..., Path]) -> None:
    batch, estimates = eventful_batch()
    path = record([(batch, estimates)], WITH_WITNESS)

    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = [(channel.topic, message, decoded) for _, channel, message, decoded in reader.iter_decoded_messages()]

    raw = [
        (message.sequence, message.publish_time, decoded) for topic, message, decoded in found if topic == "/dmm/raw"
    ]
    assert [sequence for sequence, _, _ in raw] == batch.readings["index"].tolist()
    assert [t_ns for _, t_ns, _ in raw] == batch.readings["t_ns"].tolist()
    np.testing.assert_array_equal([decoded.value for _, _, decoded in raw], batch.readings["value_V"])
    assert [decoded.status for _, _, decoded in raw] == batch.readings["status"].tolist()
    filtered = [decoded for topic, _, decoded in found if topic == "/dmm/filtered"]
    for field, column in {
        "sigma": "sigma_V",
        "u": "u_V",
        "window": "window",
        "log_likelihood": "log_likelihood",
    }.items():
        assert [getattr(decoded, field) for decoded in filtered] == estimates[column].tolist()
    events = [(message.publish_time, decoded.kind) for topic, message, decoded in found if topic == "/dmm/event"]
    assert events == [(event.t_ns, event.kind) for event in batch.events]
    witness = [decoded.value for topic, _, decoded in found if topic == "/witness/temperature"]
    assert witness == batch.witnesses["temperature"]["value"].tolist()


def test_every_crc_in_the_file_is_right_and_none_is_left_out(record: Callable[..., Path]) -> None:
    path = record([eventful_batch()], WITH_WITNESS)
    octets = path.read_bytes()
    records = records_of(octets)

    with path.open("rb") as file:
        kinds = Counter(type(found).__name__ for found in StreamReader(file, validate_crcs=True).records)

    assert kinds["Message"] == 40 + 40 + 2 + 4
    opcodes = [opcode for opcode, _, _ in records]
    (data_end,) = (body for opcode, _, body in records if opcode == 0x0F)
    assert struct.unpack("<I", data_end) == (zlib.crc32(octets[: records[opcodes.index(0x0F)][1]]),)
    footer_at = records[-1][1]
    start, _, crc = struct.unpack("<QQI", records[-1][2])
    assert crc == zlib.crc32(octets[start : footer_at + 9 + 16])
    chunk = next(body for opcode, _, body in records if opcode == 0x06)
    assert struct.unpack_from("<I", chunk, 24)[0] == zlib.crc32(zstandard.decompress(chunk[28 + 8 + 8 :]))


def test_one_reading_is_these_bytes(record: Callable[..., Path]) -> None:
    readings = readings_of(1, first_index=2**32 + 7)
    readings["value_V"], readings["status"] = 1.5, 8
    path = record([(Batch(readings), np.empty(0, ESTIMATE))], replace(DESCRIPTION, estimator={}), compression="none")
    octets = path.read_bytes()
    t_ns = int(readings["t_ns"][0])

    # MCAP specification: magic; Header (opcode 1), profile and library as length-prefixed strings.
    library = f"aemd {version('aemd')} mcap-python/{version('mcap')}".encode()
    assert octets[:8] == octets[-8:] == b"\x89MCAP0\r\n"
    header = struct.pack("<I", 0) + struct.pack("<I", len(library)) + library
    assert octets[8 : 17 + len(header)] == struct.pack("<BQ", 1, len(header)) + header
    # Message (opcode 5): channel, sequence, log time, publish time; then protobuf's tag 0x09, double, 0x15, fixed32.
    message = struct.pack("<BQHIQQ", 5, 36, 1, 7, t_ns, t_ns) + struct.pack("<BdBI", 0x09, 1.5, 0x15, 8)
    chunk = struct.pack("<QQQI", t_ns, t_ns, len(message), zlib.crc32(message)) + struct.pack("<IQ", 0, len(message))
    index = struct.pack("<HIQQ", 1, 16, t_ns, 0)
    whole = struct.pack("<BQ", 6, len(chunk) + len(message)) + chunk + message + struct.pack("<BQ", 7, 22) + index
    assert octets.count(whole) == 1


def test_what_describes_the_recording_stands_before_its_first_chunk_and_the_config_behind_it(
    record: Callable[..., Path],
) -> None:
    records = records_of(record([eventful_batch()], WITH_WITNESS).read_bytes())

    opcodes = [opcode for opcode, _, _ in records]
    first_chunk = opcodes.index(0x06)
    assert opcodes[:first_chunk] == [0x01] + [0x03] * 4 + [0x04] * 4 + [0x0C] * 6
    assert opcodes[first_chunk + 1 :][:5] == [0x07] * 4 + [0x09]


@pytest.mark.parametrize("lag", [0, 7])
def test_log_times_never_fall_over_the_whole_file(record: Callable[..., Path], lag: int) -> None:
    readings = readings_of(300)
    readings["t_ns"][100:] -= 40_000_000_000  # the clock's fit stepped back
    estimates = estimates_of(readings)
    pairs = [
        (Batch(readings[at : at + 30]), estimates[max(at - lag, 0) : max(at + 30 - lag, 0)]) for at in range(0, 300, 30)
    ]
    path = record([*pairs, (NOTHING[0], estimates[300 - lag :])], chunk_bytes=2000)

    with path.open("rb") as file:
        messages = [found for found in StreamReader(file).records if isinstance(found, Message)]

    assert len(messages) == 600
    log_times = [message.log_time for message in messages]
    assert log_times == sorted(log_times)
    assert all(message.publish_time <= message.log_time for message in messages)


def test_a_file_written_by_size_does_not_depend_on_the_batches(record: Callable[..., Path]) -> None:
    readings, whole = readings_of(2000), []
    estimates = estimates_of(readings)
    for number, length in enumerate((2000, 1, 77)):
        pairs = [(Batch(readings[at : at + length]), estimates[at : at + length]) for at in range(0, 2000, length)]
        whole.append(record(pairs, name=f"{number}.mcap", chunk_bytes=10_000).read_bytes())

    assert whole[0] == whole[1] == whole[2]


def test_a_chunk_is_closed_by_the_message_that_fills_it(record: Callable[..., Path]) -> None:
    readings = readings_of(1000)
    path = record([(Batch(readings), np.empty(0, ESTIMATE))], chunk_bytes=1000, compression="none")

    sizes = [struct.unpack_from("<Q", body, 16)[0] for opcode, _, body in records_of(path.read_bytes()) if opcode == 6]
    per_chunk = 45 * 23  # a reading's record is 45 bytes; 22 of them are fewer than 1000, 23 are not
    assert sizes == [per_chunk] * (1000 // 23) + [45 * (1000 % 23)]


def test_a_reading_waits_no_longer_than_the_flush_interval(tmp_path: Path) -> None:
    now_ns = 0
    recorder = Recorder(tmp_path / "r.mcap", DESCRIPTION, flush_interval_s=1.0, clock=lambda: now_ns)
    readings = readings_of(3)

    def readable() -> int:
        with Recording(tmp_path / "r.mcap.active", allow_unfinished=True) as recording:
            return recording.statistics().readings

    recorder.write(Batch(readings[:1]), NOTHING[1])
    now_ns = 999_999_999
    recorder.write(Batch(readings[1:2]), NOTHING[1])
    before = readable()
    now_ns = 1_000_000_000
    recorder.write(*NOTHING)
    at_once = readable()
    recorder.write(Batch(readings[2:]), NOTHING[1])
    after = readable()

    assert (before, at_once, after) == (0, 2, 2)


def test_what_came_while_the_disk_was_slow_waits_no_longer_for_that(tmp_path: Path) -> None:
    now_ns = 0
    recorder = Recorder(tmp_path / "r.mcap", DESCRIPTION, flush_interval_s=1.0, clock=lambda: now_ns)
    readings = readings_of(2)
    recorder.write(Batch(readings[:1]), NOTHING[1])
    now_ns = 1_000_000_000
    recorder.write(*NOTHING)
    at_rest_s = recorder.due_in_s
    now_ns = 1_400_000_000  # it came at any time since, and waited for the disk as the flush did
    recorder.write(Batch(readings[1:]), NOTHING[1])
    due_in_s = recorder.due_in_s
    now_ns = 2_000_000_000
    recorder.write(*NOTHING)

    assert (at_rest_s, due_in_s) == (math.inf, pytest.approx(0.6))
    with Recording(tmp_path / "r.mcap.active", allow_unfinished=True) as recording:
        assert recording.statistics().readings == 2


def test_a_disk_that_takes_longer_than_the_interval_is_not_given_every_batch_alone(tmp_path: Path) -> None:
    now_ns, syncing = 0, False

    def clock() -> int:
        nonlocal now_ns
        now_ns += 1_500_000_000 if syncing else 0
        return now_ns

    recorder = Recorder(tmp_path / "r.mcap", DESCRIPTION, flush_interval_s=1.0, clock=clock)
    readings = readings_of(11)
    recorder.write(Batch(readings[:1]), NOTHING[1])
    now_ns, syncing = 1_000_000_000, True  # a sync takes 1.5 s: it is looked at before and after
    recorder.write(*NOTHING)
    syncing = False
    for number in range(1, 11):
        now_ns += 10_000_000
        recorder.write(Batch(readings[number : number + 1]), NOTHING[1])
    now_ns += 250_000_000
    recorder.write(*NOTHING)

    before_close = recorder.written.readings
    with recorder.close().open("rb") as file:
        summary = make_reader(file).get_summary()

    assert before_close == 11
    assert summary is not None
    assert len(summary.chunk_indexes) == 2


def test_the_description_is_readable_before_the_first_reading(tmp_path: Path) -> None:
    Recorder(tmp_path / "r.mcap", DESCRIPTION)

    with Recording(tmp_path / "r.mcap.active", allow_unfinished=True) as recording:
        assert recording.description == replace(DESCRIPTION, config_toml="")  # that one follows the first chunk


def test_a_recording_is_never_overwritten(record: Callable[..., Path], tmp_path: Path) -> None:
    path = record([eventful_batch()], WITH_WITNESS)
    before = path.read_bytes()

    with pytest.raises(RecordingError, match=r"r\.mcap: exists: .*never overwritten; choose another name"):
        Recorder(path, DESCRIPTION)
    Recorder(tmp_path / "live.mcap", DESCRIPTION)
    with pytest.raises(RecordingError, match=r"live\.mcap\.active: exists: another program"):
        Recorder(tmp_path / "live.mcap", DESCRIPTION)

    assert path.read_bytes() == before


def test_a_name_that_was_taken_meanwhile_is_left_alone(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "r.mcap", DESCRIPTION)
    recorder.write(Batch(readings_of(5)), NOTHING[1])
    (tmp_path / "r.mcap").write_text("mine")

    with pytest.raises(RecordingError, match=r"cannot take its name: file exists; .* in r\.mcap\.active"):
        recorder.close()

    assert (tmp_path / "r.mcap").read_text() == "mine"
    with Recording(tmp_path / "r.mcap.active") as recording:  # and it is finished
        assert recording.statistics().readings == 5


def test_an_unfinished_file_is_locked(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "r.mcap", DESCRIPTION)

    with (tmp_path / "r.mcap.active").open("rb") as file, pytest.raises(BlockingIOError):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)

    recorder.discard()
    recorder.discard()
    assert list(tmp_path.iterdir()) == []


@contextmanager
def _files_no_longer_than(limit: int) -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_refused_write_keeps_all_that_was_good(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "r.mcap", DESCRIPTION, chunk_bytes=450, compression="none")
    readings = readings_of(100)
    recorder.write(Batch(readings[:50]), NOTHING[1])
    size = (tmp_path / "r.mcap.active").stat().st_size

    with (
        _files_no_longer_than(size + 100),
        pytest.raises(
            RecordingError, match=rf"r\.mcap\.active: cannot be written: file too large; its first {size} bytes"
        ),
    ):
        recorder.write(Batch(readings[50:]), NOTHING[1])

    assert (tmp_path / "r.mcap.active").stat().st_size == size
    with Recording(tmp_path / "r.mcap.active", allow_unfinished=True) as recording:
        kept = np.concatenate([batch.readings for batch in recording.batches()])
    assert kept.tobytes() == readings[:50].tobytes()
    with pytest.raises(RecordingError, match="is closed"):
        recorder.write(Batch(readings[50:]), NOTHING[1])


def test_after_a_refused_write_the_file_is_finished_and_counts_what_is_in_it(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "r.mcap", DESCRIPTION, chunk_bytes=4500, compression="none", keep_room=True)
    readings = readings_of(350)
    recorder.write(Batch(readings[:250]), NOTHING[1])
    with _files_no_longer_than((tmp_path / "r.mcap.active").stat().st_size + 100), pytest.raises(RecordingError):
        recorder.write(Batch(readings[250:]), NOTHING[1])

    assert (recorder.counts.readings, recorder.written.readings) == (350, 200)  # two chunks of 4500 / 45 bytes
    assert recorder.unwritten_from == (200, int(readings["t_ns"][200]))
    assert recorder.close("disk-full") == tmp_path / "r.mcap"
    with Recording(tmp_path / "r.mcap") as recording:
        recording.verify()
        assert recording.statistics().readings == 200
        assert recording.metadata["aemd.close"]["reason"] == "disk-full"
        assert recording.metadata["aemd.close"]["next_index"] == "200"
        kept = np.concatenate([batch.readings for batch in recording.batches()])
    assert kept.tobytes() == readings[:200].tobytes()


def test_the_room_kept_for_the_end_is_given_back(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "r.mcap", DESCRIPTION, keep_room=True)
    held = (tmp_path / "r.mcap.active").stat().st_blocks * 512
    path = recorder.close()

    assert held > 1 << 16
    assert path.stat().st_blocks * 512 < 1 << 14


def test_a_folder_that_is_not_there_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"cannot be created: no such file or directory; choose another folder"):
        Recorder(tmp_path / "nowhere" / "r.mcap", DESCRIPTION)


def test_closing_tells_why_and_how_much_and_twice_is_fine(tmp_path: Path) -> None:
    batch, estimates = eventful_batch()
    recorder = Recorder(tmp_path / "r.mcap", WITH_WITNESS)
    recorder.write(batch, estimates)
    path = recorder.close("stop", facts={"acquired": "45"}, clock={"uncertainty_ns": "900"})

    assert recorder.close() == path == tmp_path / "r.mcap"
    assert not (tmp_path / "r.mcap.active").exists()
    with path.open("rb") as file:
        metadata = {
            found.name: found.metadata for found in make_reader(file).iter_metadata() if isinstance(found, Metadata)
        }
    assert (
        metadata["aemd.close"] | {"reason": "stop", "acquired": "45", "readings": "40", "lost": "5", "gaps": "1"}
        == (metadata["aemd.close"])
    )
    assert metadata["aemd.clock"] == {"uncertainty_ns": "900"}


def test_the_summary_finds_everything_that_the_file_holds(record: Callable[..., Path]) -> None:
    path = record([eventful_batch()], WITH_WITNESS, chunk_bytes=2000)

    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        octets = path.read_bytes()

    statistics = summary.statistics
    assert (statistics.message_count, statistics.schema_count, statistics.channel_count) == (86, 4, 4)
    assert (statistics.metadata_count, statistics.attachment_count) == (7, 1)
    assert statistics.message_start_time == T0_NS
    assert statistics.chunk_count == len(summary.chunk_indexes) > 1
    assert all(octets[index.chunk_start_offset] == 0x06 for index in summary.chunk_indexes)
    for index in summary.chunk_indexes:
        for channel, offset in index.message_index_offsets.items():
            assert struct.unpack_from("<BQH", octets, offset)[::2] == (0x07, channel)
    topics: dict[str, Channel] = {channel.topic: channel for channel in summary.channels.values()}
    counts = {topic: statistics.channel_message_counts[channel.id] for topic, channel in topics.items()}
    assert counts == {"/dmm/raw": 40, "/dmm/filtered": 40, "/dmm/event": 2, "/witness/temperature": 4}
