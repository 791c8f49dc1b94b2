"""Readings and estimates that take turns: packed without sorting, and to the same bytes as by sorting."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import IndexType, Writer

from aemd.block import ESTIMATE, READING, Batch
from aemd.record.reader import Recording
from aemd.record.rows import EMPTY, Rows, Track, merge
from aemd.record.schema import (
    FILTERED,
    HEADER_BYTES,
    RAW,
    RECORDS,
    SCHEMA_DATA,
    SCHEMAS,
    WITNESS,
    WITNESS_PREFIX,
    fill_rows,
    make_layout,
)
from aemd.record.turns import Seat, Turns, take_turns
from aemd.record.writer import Recorder
from tests.record.made import DESCRIPTION, estimates_of, readings_of


def _seat(channel: int, schema: str) -> Seat:
    layout = make_layout(SCHEMA_DATA, schema, ["value"])
    assert layout is not None
    return Seat(channel, schema, layout)


def _sorted(seats: list[Seat], columns: tuple[np.ndarray, ...], not_before_ns: int) -> Rows:
    tracks = []
    for seat, values in zip(seats, columns, strict=True):
        rows = seat.layout.make_rows(len(values), seat.channel)
        fill_rows(rows, seat.schema, values)
        tracks.append(Track(seat.channel, values["t_ns"], rows))
    return merge(tracks, not_before_ns)


@pytest.mark.parametrize("channels", [(1, 2), (2, 1), (3,)])
@given(
    steps=st.lists(st.integers(1, 50), min_size=3, max_size=40),
    cuts=st.sets(st.integers(1, 39)),
    kept=st.integers(0, 5),
    not_before_ns=st.integers(0, 80),
)
def test_turns_are_packed_to_the_bytes_that_sorting_gives(
    channels: tuple[int, ...], steps: list[int], cuts: set[int], kept: int, not_before_ns: int
) -> None:
    seats = [_seat(channel, SCHEMAS[topic]) for channel, topic in zip(channels, (RAW, FILTERED), strict=False)]
    readings = readings_of(len(steps))
    readings["t_ns"] = np.cumsum(steps)
    columns = (readings, estimates_of(readings))[: len(seats)]
    wanted = _sorted(seats, columns, not_before_ns)
    # What stands before is the end of an earlier run: whole turns, half of one, or nothing.
    earlier = readings_of(4)
    earlier["t_ns"] = 0
    turns = Turns(seats)
    before = turns.pack([(earlier, estimates_of(earlier))[: len(seats)]], EMPTY, 0) if kept else EMPTY
    _, before = before.split(max(len(before.start) - kept, 0))
    octets = before.octets.tobytes()
    places = [0, *sorted(cut for cut in cuts if cut < len(steps)), len(steps)]
    parts = [tuple(values[a:b] for values in columns) for a, b in pairwise(places)]

    assert take_turns(parts)
    packed = turns.pack(parts, before, not_before_ns)

    assert packed.octets.tobytes() == octets + wanted.octets.tobytes()
    assert packed.channel.tolist() == before.channel.tolist() + wanted.channel.tolist()
    assert packed.log_time.tolist() == before.log_time.tolist() + wanted.log_time.tolist()
    assert packed.start.tolist() == [*before.start.tolist(), *(wanted.start + len(octets)).tolist()]
    for rows in packed.split(len(packed.start) // 2):
        found = {channel: rows.start[mine].tolist() for channel, mine in rows.places().items()}
        assert list(found) == sorted(set(rows.channel.tolist()))
        assert found == {channel: rows.start[rows.channel == channel].tolist() for channel in found}


@pytest.mark.parametrize("wrong", ["an instant that falls", "an instant twice", "an estimate late", "one missing"])
def test_what_does_not_take_turns_is_seen(wrong: str) -> None:
    readings = readings_of(10)
    estimates = estimates_of(readings)
    assert take_turns([(readings[:5], estimates[:5]), (readings[5:], estimates[5:])])
    if wrong == "an instant that falls":
        readings["t_ns"][5:] -= 10**12
        estimates["t_ns"] = readings["t_ns"]
    elif wrong == "an instant twice":
        readings["t_ns"][7] = estimates["t_ns"][7] = readings["t_ns"][6]
    elif wrong == "an estimate late":
        estimates["t_ns"][3] += 1
    else:
        estimates = estimates[:-1]

    assert not take_turns([(readings[:5], estimates[:5]), (readings[5:], estimates[5:])])


def test_estimates_that_no_topic_takes_leave_no_trace(tmp_path: Path) -> None:
    readings = readings_of(3000)
    chunks = {}
    for name, lag in (("with", 7), ("without", 3000)):
        recorder = Recorder(tmp_path / name, replace(DESCRIPTION, estimator={}), chunk_bytes=4096)
        estimates = estimates_of(readings)
        for at in range(0, 3000, 100):
            recorder.write(Batch(readings[at : at + 100]), estimates[max(at - lag, 0) : max(at + 100 - lag, 0)])
        recorder.write(Batch(np.empty(0, READING)), estimates[-7:] if lag == 7 else np.empty(0, ESTIMATE))
        with Recording(recorder.close()) as recording:
            chunks[name] = [len(batch.readings) for batch in recording.batches()]

    assert sum(chunks["with"]) == 3000
    assert chunks["with"] == chunks["without"]


@pytest.mark.parametrize("order", ["rf rf rf", "rf rf fr rf", "fr fr fr f", "rrr", "rf rf rff", "rrff rf", "rrrw"])
def test_messages_are_found_in_any_order_whatever_the_index_says(tmp_path: Path, order: str) -> None:
    path = tmp_path / "r.mcap"
    topics = {RAW: SCHEMAS[RAW], FILTERED: SCHEMAS[FILTERED], WITNESS_PREFIX + "w": WITNESS}
    seats = {
        name: _seat(number, schema)
        for number, (name, schema) in enumerate(zip("rfw", topics.values(), strict=True), start=1)
    }
    readings = readings_of(8)
    values = {"r": readings, "f": estimates_of(readings), "w": np.ones(8, RECORDS[WITNESS])}
    taken = dict.fromkeys("rfw", 0)
    with path.open("wb") as file:
        writer = Writer(file, index_types=IndexType.NONE)
        writer.start()
        for topic, name in topics.items():
            writer.register_channel(topic, "protobuf", writer.register_schema(name, "protobuf", SCHEMA_DATA))
        for log_time, which in enumerate("r" + order.replace(" ", "")):
            seat, number = seats[which], taken[which]
            row = seat.layout.make_rows(1, seat.channel)
            fill_rows(row, seat.schema, values[which][number : number + 1])
            taken[which] += 1
            payload = row.tobytes()[HEADER_BYTES:]
            writer.add_message(seat.channel, log_time, payload, int(row["publish_time"][0]), number)
            if log_time == 0:
                writer.flush()  # a chunk of its own for schemas and channels, which the package puts into the first
        writer.finish()

    with Recording(path) as recording:
        batches = list(recording.batches_with_estimates())

    assert np.concatenate([batch.readings for batch, _ in batches]).tobytes() == readings[: taken["r"]].tobytes()
    assert np.concatenate([made for _, made in batches]).tobytes() == values["f"][: taken["f"]].tobytes()
    assert sum(len(batch.witnesses.get("w", ())) for batch, _ in batches) == taken["w"]
