import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from aemd.block import ESTIMATE, READING, WITNESS, Batch, Estimates, Event
from aemd.errors import RecordingError
from aemd.record.description import Description
from aemd.record.reader import Recording
from aemd.record.writer import Recorder
from tests.record.made import (
    DESCRIPTION,
    NO_ESTIMATES,
    STEP_NS,
    T0_NS,
    estimates_of,
    eventful_batch,
    read_all,
    readings_of,
    records_of,
)

WITH_WITNESS = replace(DESCRIPTION, witnesses={"temperature": "degC"})


@st.composite
def _streams(draw: st.DrawFn) -> tuple[int, list[tuple[Batch, Estimates]]]:
    """Blocks of any bits: values of any kind, statuses, clocks that jump, gaps, indexes that pass 2**32."""
    first_index = draw(st.integers(0, 2**33))
    pairs, index = [], first_index - 1
    for length in draw(st.lists(st.integers(0, 30), max_size=8)):
        readings, estimates = np.zeros(length, READING), np.zeros(length, ESTIMATE)
        steps = draw(hnp.arrays(np.int64, length, elements=st.sampled_from([1, 1, 1, 2, 2**30])))
        readings["index"] = index + np.cumsum(steps)
        index = int(readings["index"][-1]) if length else index
        readings["t_ns"] = draw(hnp.arrays(np.int64, length, elements=st.integers(0, 2**62)))
        readings["value_V"] = draw(hnp.arrays(np.uint64, length)).view(np.float64)  # every NaN has bits of its own
        readings["status"] = draw(hnp.arrays(np.uint32, length))
        estimates["index"], estimates["t_ns"] = readings["index"], readings["t_ns"]
        for name in ("value_V", "sigma_V", "u_V", "spread", "log_likelihood"):
            estimates[name] = draw(hnp.arrays(np.uint64, length)).view(np.float64)
        for name in ("window", "passes", "status"):
            estimates[name] = draw(hnp.arrays(np.uint32, length))
        pairs.append((Batch(readings), estimates))
    return first_index, pairs


@settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(_streams(), st.integers(40, 3000), st.sampled_from(["zstd", "none"]), st.sampled_from([None, 1, 7, 1000]))
def test_whatever_was_written_is_read_to_the_bit(
    tmp_path_factory: pytest.TempPathFactory,
    stream: tuple[int, list[tuple[Batch, Estimates]]],
    chunk_bytes: int,
    compression: str,
    batch_readings: int | None,
) -> None:
    first_index, pairs = stream
    path = tmp_path_factory.mktemp("r") / "r.mcap"
    description = replace(DESCRIPTION, first_index=first_index)
    recorder = Recorder(path, description, chunk_bytes=chunk_bytes, compression=compression)  # type: ignore[arg-type]
    for batch, estimates in pairs:
        recorder.write(batch, estimates)
    recorder.close()

    batches, readings, estimates = read_all(path, batch_readings)

    assert readings.tobytes() == b"".join(batch.readings.tobytes() for batch, _ in pairs)
    assert estimates.tobytes() == b"".join(made.tobytes() for _, made in pairs)
    if batch_readings is not None:
        assert {len(batch.readings) for batch in batches[:-1]} <= {batch_readings}


def test_estimates_that_lag_and_begin_before_the_first_reading_keep_their_index(record: Callable[..., Path]) -> None:
    readings = readings_of(10, first_index=2**32 + 2)
    estimates = estimates_of(readings_of(10, first_index=2**32 - 3))
    path = record([(Batch(readings), estimates)], replace(DESCRIPTION, first_index=2**32 + 2))

    _, read, made = read_all(path)

    assert read.tobytes() == readings.tobytes()
    assert made.tobytes() == estimates.tobytes()


def test_what_describes_the_recording_comes_back_whole(record: Callable[..., Path]) -> None:
    description = replace(WITH_WITNESS, unit="g", quantity="acceleration", interval_s=1 / 15, first_index=3)
    path = record([eventful_batch()], description)

    with Recording(path) as recording:
        assert recording.description == description
        assert recording.attachment("config.toml").decode() == description.config_toml
        with pytest.raises(RecordingError, match=r"no attachment 'x'; attached: config\.toml"):
            recording.attachment("x")


@pytest.mark.parametrize("chunk_bytes", [1, 100, 700, 1 << 20])
@pytest.mark.parametrize("batch_readings", [None, 1, 3, 20, 21, 40, 1000])
def test_events_and_witnesses_come_with_the_reading_that_follows_them(
    record: Callable[..., Path], chunk_bytes: int, batch_readings: int | None
) -> None:
    batch, estimates = eventful_batch()
    path = record([(batch, estimates)], WITH_WITNESS, chunk_bytes=chunk_bytes)

    batches, readings, made = read_all(path, batch_readings)

    assert readings.tobytes() == batch.readings.tobytes()
    assert made.tobytes() == estimates.tobytes()
    assert [event for part in batches for event in part.events] == list(batch.events)
    for part in batches:
        instants = [event.t_ns for event in part.events]
        instants += [t_ns for values in part.witnesses.values() for t_ns in values["t_ns"].tolist()]
        before = readings["t_ns"][readings["t_ns"] < part.readings["t_ns"][0]]
        assert all((before.max() if before.size else 0) < t_ns <= part.readings["t_ns"][-1] for t_ns in instants)


@pytest.mark.parametrize("chunk_bytes", [1, 100, 1 << 20])
def test_estimates_come_with_the_readings_that_made_them_ready(record: Callable[..., Path], chunk_bytes: int) -> None:
    batch, estimates = eventful_batch()
    path = record([(batch, estimates)], WITH_WITNESS, chunk_bytes=chunk_bytes)

    with Recording(path) as recording:
        pairs = list(recording.batches_with_estimates())

    assert all(part.readings["index"].tolist() == made["index"].tolist() for part, made in pairs)


def test_what_follows_the_last_reading_comes_at_the_end(record: Callable[..., Path]) -> None:
    readings = readings_of(3)
    event = Event(T0_NS + 10 * STEP_NS, "gap", "2 readings lost", 3, 4)
    path = record([(Batch(readings), NO_ESTIMATES), (Batch(readings[:0], (event,)), NO_ESTIMATES)])

    with Recording(path) as recording:
        assert [part.events for part in recording.batches()] == [(event,)]
        assert (recording.statistics().lost, recording.statistics().gaps) == (2, 1)


def test_the_figures_of_an_unfinished_recording_are_those_of_the_finished_one(
    record: Callable[..., Path], tmp_path: Path
) -> None:
    batch, estimates = eventful_batch()
    path = record([(batch, estimates)], WITH_WITNESS)
    octets = path.read_bytes()
    data_end = next(at for opcode, at, _ in records_of(octets) if opcode == 0x0F)
    cut = tmp_path / "cut.mcap.active"
    cut.write_bytes(octets[:data_end])

    with Recording(path) as whole, Recording(cut, allow_unfinished=True) as unfinished:
        assert (whole.is_finished, unfinished.is_finished) == (True, False)
        figures = whole.statistics()
        assert figures == unfinished.statistics()

    assert (figures.readings, figures.estimates, figures.lost, figures.gaps) == (40, 40, 5, 1)
    assert (figures.t0_ns, figures.t1_ns) == (T0_NS, T0_NS + 44 * STEP_NS)
    assert figures.topics == {"/dmm/raw": 40, "/dmm/filtered": 40, "/dmm/event": 2, "/witness/temperature": 4}


def test_a_file_cut_anywhere_is_refused_or_read_as_a_prefix(record: Callable[..., Path], tmp_path: Path) -> None:
    readings = readings_of(60)
    estimates = estimates_of(readings)
    octets = record(
        [(Batch(readings), estimates)], Description(estimator={"name": "aem"}), chunk_bytes=3000
    ).read_bytes()
    chunk_ends = [at + 9 + len(body) for opcode, at, body in records_of(octets) if opcode == 0x06]
    cut = tmp_path / "cut.mcap"
    # Every byte from the first chunk to the last, some of what stands around them.
    begin, end = chunk_ends[0] - 700, chunk_ends[-1] + 100
    cuts = [length for length in range(len(octets)) if begin < length < end or length % 50 == 0]
    lengths = []
    for length in cuts:
        cut.write_bytes(octets[:length])
        if length % 50 == 0:
            with pytest.raises(RecordingError, match=r"cut\.mcap: is (unfinished|no MCAP file|empty).*$"):
                Recording(cut)
        try:
            _, read, made = read_all(cut, allow_unfinished=True)
        except RecordingError:
            assert length < chunk_ends[0]
            continue
        assert read.tobytes() == readings[: len(read)].tobytes()
        assert made.tobytes() == estimates[: len(made)].tobytes()
        lengths.append(len(read) + len(made))

    # And all that was whole is there: a chunk counts from its last byte on, even without its index.
    whole = [sum(end <= length for end in chunk_ends) for length in cuts][-len(lengths) :]
    per_chunk = np.unique(lengths)
    assert lengths == per_chunk[whole].tolist()


@pytest.mark.parametrize("tail", [b"\0" * 64, b"\0" * 5000, b"\xff" * 64])
def test_a_tail_of_rubbish_is_not_read(record: Callable[..., Path], tmp_path: Path, tail: bytes) -> None:
    readings = readings_of(60)
    octets = record([(Batch(readings), NO_ESTIMATES)], chunk_bytes=1500).read_bytes()
    second = [at for opcode, at, _ in records_of(octets) if opcode == 0x06][1]
    path = tmp_path / "cut.mcap.active"
    path.write_bytes(octets[:second] + tail)

    _, read, _ = read_all(path, allow_unfinished=True)

    assert read.tobytes() == readings[: len(read)].tobytes()
    assert len(read) == 34  # ceil(1500 / 45) readings in the first chunk


def test_a_changed_bit_in_a_chunk_is_found_and_the_chunk_is_named(record: Callable[..., Path], tmp_path: Path) -> None:
    octets = bytearray(
        record([(Batch(readings_of(200)), NO_ESTIMATES)], compression="none", chunk_bytes=3000).read_bytes()
    )
    chunks = [(at, body) for opcode, at, body in records_of(bytes(octets)) if opcode == 0x06]
    at, body = chunks[1]
    octets[at + 9 + len(body) - 20] ^= 1
    path = tmp_path / "bad.mcap"
    path.write_bytes(octets)

    with pytest.raises(RecordingError, match=rf"bad\.mcap: is damaged: its chunk at byte {at} has a wrong CRC$"):
        read_all(path)


@pytest.mark.parametrize("seed", range(200))
def test_a_changed_byte_never_invents_a_reading(record: Callable[..., Path], tmp_path: Path, seed: int) -> None:
    readings = readings_of(30)
    estimates = estimates_of(readings)
    octets = bytearray(record([(Batch(readings), estimates)], chunk_bytes=1000).read_bytes())
    rng = np.random.default_rng(seed)
    first_chunk = next(at for opcode, at, _ in records_of(bytes(octets)) if opcode == 0x06)
    # Metadata has no CRC of its own in MCAP, so the change is behind it: chunks, indexes, summary.
    octets[rng.integers(first_chunk, len(octets))] ^= rng.integers(1, 256)
    path = tmp_path / "bad.mcap"
    path.write_bytes(octets)

    try:
        _, read, made = read_all(path, allow_unfinished=True)
    except RecordingError:
        return
    assert set(read["index"]) <= set(readings["index"])
    assert read.tobytes() == readings[np.isin(readings["index"], read["index"])].tobytes()
    assert made.tobytes() == estimates[np.isin(estimates["index"], made["index"])].tobytes()


def test_a_wrong_index_does_no_harm(record: Callable[..., Path], tmp_path: Path) -> None:
    readings = readings_of(20)
    octets = bytearray(record([(Batch(readings), NO_ESTIMATES)]).read_bytes())
    at = next(at for opcode, at, _ in records_of(bytes(octets)) if opcode == 0x07)
    path = tmp_path / "bad.mcap"
    for entry in range(20):
        changed = bytearray(octets)
        struct.pack_into("<Q", changed, at + 9 + 6 + 16 * entry + 8, 45 * entry + 1)
        path.write_bytes(changed)

        assert read_all(path)[1].tobytes() == readings.tobytes()


def test_an_open_recording_can_be_left_in_the_middle(record: Callable[..., Path]) -> None:
    path = record([(Batch(readings_of(500)), NO_ESTIMATES)], chunk_bytes=1000, compression="none")

    with Recording(path) as recording:
        first = next(recording.batches())

    assert first.readings["index"][0] == 0  # and closing the map did not fail


def test_a_witness_keeps_its_bits(record: Callable[..., Path]) -> None:
    values = np.zeros(50, WITNESS)
    values["t_ns"] = T0_NS + np.arange(50) * STEP_NS
    values["value"] = np.random.default_rng(3).standard_normal(50)
    path = record([(Batch(readings_of(50), (), {"temperature": values}), NO_ESTIMATES)], WITH_WITNESS, chunk_bytes=500)

    batches, _, _ = read_all(path)

    read = np.concatenate([batch.witnesses["temperature"] for batch in batches])
    assert read.tobytes() == values.tobytes()
