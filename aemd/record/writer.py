"""Recorder: a sink that turns readings, estimates and events into the chunks of an MCAP file.

A chunk is closed after an interval (live, so that a crash costs no more than that) or by its size (always; writing from
a file, only). What is written by size only does not depend on how the stream was cut into batches.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.well_known import SchemaEncoding
from numpy.typing import NDArray

from aemd.block import ESTIMATE, READING, Batch, Block, Estimates, Event
from aemd.errors import RecordingError
from aemd.record.counts import Counts
from aemd.record.description import Description
from aemd.record.growing import Compression, Durability, GrowingFile
from aemd.record.rows import EMPTY, Rows, Track, concatenate, merge
from aemd.record.schema import (
    COLUMNS,
    ENCODING,
    EVENT,
    FILTERED,
    HEADER_BYTES,
    RAW,
    SCHEMA_DATA,
    SCHEMAS,
    WITNESS,
    WITNESS_PREFIX,
    Layout,
    encode_event,
    fill_rows,
    make_layout,
)
from aemd.record.turns import Seat, Turn, Turns, take_turns, turn_bytes

__all__ = ["CHUNK_BYTES", "Recorder"]

CHUNK_BYTES = 1 << 20  # larger gains nothing in size or speed, and a reader holds one in memory
_PAUSE = 4  # between the end of a flush and the next one, at least this part of an interval


class Recorder:
    """Writes one recording. Not thread-safe; `Background` puts it into a thread of its own.

    Arrays handed to `write` must not change afterwards: they are encoded when their chunk is closed.
    """

    def __init__(
        self,
        path: Path,
        description: Description,
        *,
        flush_interval_s: float | None = None,
        chunk_bytes: int = CHUNK_BYTES,
        compression: Compression = "zstd",
        durability: Durability = "crash",
        keep_room: bool = False,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Create the file and write all that is known before the first reading.

        Args:
            path: name of the finished recording; it must not exist.
            description: what is recorded.
            flush_interval_s: longest time a reading waits for its chunk to be closed; None for by size only.
            chunk_bytes: a chunk is closed with the message that makes it at least this long.
            compression: of the chunks.
            durability: "power" waits for the disk after each chunk, so that a power cut costs no more than a crash of
                the program; "crash" leaves the time to the kernel.
            keep_room: own the blocks that the file's end will take, so that it can be finished on a disk that fills up.
            clock: host monotonic time, ns.

        Raises:
            RecordingError: the file exists, or cannot be created or written.
        """
        self._flush_interval_ns = None if flush_interval_s is None else round(flush_interval_s * 1e9)
        self._chunk_bytes = chunk_bytes
        self._clock = clock
        self._description = description
        self._waiting: list[tuple[Batch, Estimates]] = []
        self._waiting_bytes = 0
        self._rows = EMPTY  # encoded, and too few for a chunk
        self._due_ns = 0
        self._flushed_ns: int | None = None
        """When all that had come was last taken to be written: whatever waits has come since."""
        self._at_rest_ns = 0
        """When that was written. A disk that takes longer than an interval would else be given every batch alone."""
        self._log_time_ns = 0
        self._counts = Counts(description.first_index)
        self._written = Counts(description.first_index)
        self._unwritten = _Unwritten()

        schemas, channels = _declare(description)
        self._ids = {channel.topic: channel.id for channel in channels}
        self._layouts = {name: _layout(name) for name in COLUMNS}
        self._seats = [
            Seat(self._ids[topic], SCHEMAS[topic], self._layouts[SCHEMAS[topic]])
            for topic in (RAW, FILTERED)
            if topic in self._ids
        ]
        self._turns = Turns(self._seats)
        self._file = GrowingFile(
            path, schemas, channels, compression=compression, durability=durability, keep_room=keep_room
        )
        segment = {"first_index": str(description.first_index), "interval_s": repr(description.interval_s)}
        try:
            for name, pairs in {
                "session": description.session,
                "instrument": description.instrument,
                "calibration": description.calibration,
                "estimator": description.estimator,
                "clock": description.clock,
                "segment": segment | dict(description.segment),
                "state": description.state,
            }.items():
                if pairs:
                    self._file.append(Metadata(f"aemd.{name}", dict(pairs)))
            self._file.sync()
        except RecordingError:
            self._file.discard()
            raise
        # After the first chunk: `mcap recover` rewrites a file that begins with an attachment without compression.
        self._config_waits = bool(description.config_toml)

    @property
    def counts(self) -> Counts:
        """What was taken so far."""
        return self._counts

    @property
    def written(self) -> Counts:
        """What of it is in the file."""
        return self._written

    @property
    def unwritten_from(self) -> tuple[int, int] | None:
        """Index and instant, ns, of the first reading that was taken and is not in the file; None if all are."""
        return self._unwritten.first

    @property
    def has_failed(self) -> bool:
        """Whether the disk has refused something; `close` then finishes what was good before."""
        return self._file.has_failed

    @property
    def is_released(self) -> bool:
        """Whether it is closed, or cannot be closed any more."""
        return self._file.is_released

    @property
    def path(self) -> Path:
        """Name of the finished file."""
        return self._file.path

    @property
    def size_bytes(self) -> int:
        """What the file would have if it were closed now, at most, but for what waits for its chunk."""
        return self._file.size_bytes

    @property
    def active(self) -> Path:
        """The file as it is named while it grows."""
        return self._file.active

    @property
    def due_in_s(self) -> float:
        """How long what waits may go on waiting, s: an empty `write` is due then; infinite where nothing waits."""
        if self._flush_interval_ns is None or not (self._waiting or len(self._rows.start)):
            return math.inf
        return max(0, self._due_ns - self._clock()) * 1e-9

    def write(self, batch: Batch, estimates: Estimates) -> None:
        """Take one batch and the estimates that became ready with it; an empty batch only looks at the clock.

        Raises:
            RecordingError: the disk refused, now or before. What was written before is kept and readable.
        """
        if not self._file.is_open:
            raise RecordingError(f"{self._file.path}: is closed: nothing can be added; start another recording")
        if len(batch.readings) or len(estimates) or batch.events or batch.witnesses:
            if self._flush_interval_ns is not None and not self._waiting and not len(self._rows.start):
                since_ns = self._clock() if self._flushed_ns is None else self._flushed_ns
                pause_ns = self._flush_interval_ns // _PAUSE
                self._due_ns = max(since_ns + self._flush_interval_ns, self._at_rest_ns + pause_ns)
            if length := self._bytes_of(batch, estimates):
                self._waiting.append((batch, estimates))
                self._waiting_bytes += length
            self._counts.add(batch, estimates)
            self._unwritten.add(batch)
        due = self._flush_interval_ns is not None and (now_ns := self._clock()) >= self._due_ns
        if due:
            self._flushed_ns = now_ns
        if due or self._waiting_bytes + len(self._rows.octets) >= self._chunk_bytes:
            self._write_chunks(to_the_last=due)
            if due:
                self._at_rest_ns = self._clock()

    def close(
        self, reason: str = "stop", *, facts: Mapping[str, str] | None = None, clock: Mapping[str, str] | None = None
    ) -> Path:
        """Write what is left, finish the file and give it its name. Twice is fine.

        After a failed write it finishes what was good, and counts that only.

        Args:
            reason: one word: stop, end, rotate, disk-full, failed.
            facts: what the acquisition counted, such as acquired; added to our own counts, and winning over them.
            clock: the clock's epoch, offset and uncertainty as known now.

        Returns:
            Where the readings are: the finished recording, or the .active file if it could not take its name.

        Raises:
            RecordingError: the disk refused, or the name was taken meanwhile; the .active file is kept and readable,
                and a second call tries again without what was not written.
        """
        if not self._file.is_released:
            if self._file.is_open:
                self._write_chunks(to_the_last=True)
            self._write_config(self._log_time_ns)
            if clock:
                self._file.append(Metadata("aemd.clock", dict(clock)))
            self._file.append(Metadata("aemd.close", {"reason": reason} | self._written.to_text() | dict(facts or {})))
            self._file.finish()
        return self._file.active if self._file.active.exists() else self._file.path

    def discard(self) -> None:
        """Remove the unfinished file; a finished one stays. Twice is fine."""
        self._file.discard()

    def release(self) -> None:
        """Let go of a file that could not be closed; it stays .active, for `recover`."""
        self._file.release()

    def _bytes_of(self, batch: Batch, estimates: Estimates) -> int:
        witnesses = sum(len(values) for values in batch.witnesses.values())
        estimated = len(estimates) if FILTERED in self._ids else 0
        fixed = {SCHEMAS[RAW]: len(batch.readings), SCHEMAS[FILTERED]: estimated, WITNESS: witnesses}
        events = sum(HEADER_BYTES + len(encode_event(event)) for event in batch.events)
        return events + sum(self._layouts[name].row.itemsize * count for name, count in fixed.items())

    def _write_chunks(self, *, to_the_last: bool) -> None:
        while self._waiting_bytes + len(self._rows.octets) >= self._chunk_bytes or (
            to_the_last and (self._waiting or len(self._rows.start))
        ):
            if self._waiting and len(self._rows.octets) < self._chunk_bytes and not self._encode_turns():
                self._encode_waiting()
            chunk, self._rows = self._rows.split(int(np.searchsorted(self._rows.start, self._chunk_bytes)))
            self._file.write_chunk(chunk)
            self._note_written(chunk)
            self._write_config(int(chunk.log_time[-1]))

    def _encode_turns(self) -> bool:
        """Encode what fills a chunk, at most, of what waits; tell whether readings and estimates do take turns."""
        if any(batch.events or batch.witnesses for batch, _ in self._waiting):
            return False
        seats = len(self._seats)
        if not take_turns([(batch.readings, estimates)[:seats] for batch, estimates in self._waiting]):
            return False
        width = turn_bytes(self._seats)
        wanted = -(-(self._chunk_bytes - len(self._rows.octets)) // width)
        parts: list[Turn] = []
        while self._waiting and wanted:
            batch, estimates = self._waiting.pop(0)
            block = batch.readings
            if len(block) > wanted:
                self._waiting.insert(0, (Batch(block[wanted:]), estimates[wanted:]))
            parts.append((block[:wanted], estimates[:wanted])[:seats])
            wanted -= len(parts[-1][0])
            self._waiting_bytes -= len(parts[-1][0]) * width
        self._rows = self._turns.pack(parts, self._rows, self._log_time_ns)
        self._log_time_ns = int(self._rows.log_time[-1])
        return True

    def _encode_waiting(self) -> None:
        """Turn what waits into rows behind those that wait already."""
        batches = [batch for batch, _ in self._waiting]
        events = [event for batch in batches for event in batch.events]
        # At equal instants: what happened to the stream, then the reading, then its estimate.
        happened = [encode_event(event) for event in events]
        tracks = [Track(self._ids[EVENT], np.array([event.t_ns for event in events], np.int64), happened)]
        for name in {name: None for batch in batches for name in batch.witnesses}:
            values = [batch.witnesses[name] for batch in batches if name in batch.witnesses]
            tracks.append(self._track(WITNESS_PREFIX + name, WITNESS, values))
        tracks.append(self._track(RAW, SCHEMAS[RAW], [batch.readings for batch in batches]))
        if FILTERED in self._ids:
            tracks.append(self._track(FILTERED, SCHEMAS[FILTERED], [estimates for _, estimates in self._waiting]))
        self._waiting.clear()
        self._waiting_bytes = 0

        rows = merge(tracks, self._log_time_ns)
        if len(rows.log_time):
            self._log_time_ns = int(rows.log_time[-1])
            self._rows = self._rows.join(rows) if len(self._rows.start) else rows

    def _track(self, topic: str, schema: str, arrays: list[NDArray[np.void]]) -> Track:
        values = concatenate(arrays)
        rows = self._layouts[schema].make_rows(len(values), self._ids[topic])
        fill_rows(rows, schema, values)
        return Track(self._ids[topic], values["t_ns"], rows)

    def _note_written(self, chunk: Rows) -> None:
        """Move what the chunk holds from what waits to what is written, counted as a reader would."""
        held = {channel: len(chunk.start[mine]) for channel, mine in chunk.places().items()}
        readings, estimates, events = (held.get(self._ids.get(topic, 0), 0) for topic in (RAW, FILTERED, EVENT))
        for batch in self._unwritten.take(readings, events):
            self._written.add(batch, np.empty(0, ESTIMATE))
        self._written.estimates += estimates

    def _write_config(self, log_time_ns: int) -> None:
        if self._config_waits:
            self._config_waits = False
            text = self._description.config_toml.encode()
            self._file.append(Attachment(0, log_time_ns, "config.toml", "application/toml", text))


class _Unwritten:
    """Readings and events that were taken and are in no chunk yet, in their order, which is that of the file."""

    def __init__(self) -> None:
        self._blocks: deque[Block] = deque()
        self._events: deque[Event] = deque()

    @property
    def first(self) -> tuple[int, int] | None:
        """Index and instant of the first reading."""
        if not self._blocks:
            return None
        return int(self._blocks[0]["index"][0]), int(self._blocks[0]["t_ns"][0])

    def add(self, batch: Batch) -> None:
        """Put these behind the others."""
        if len(batch.readings):
            self._blocks.append(batch.readings)
        self._events.extend(batch.events)

    def take(self, readings: int, events: int) -> Iterator[Batch]:
        """Take out the first so many of each."""
        while readings:
            block = self._blocks.popleft()
            if len(block) > readings:
                self._blocks.appendleft(block[readings:])
                block = block[:readings]
            readings -= len(block)
            yield Batch(block)
        if events:
            yield Batch(np.empty(0, READING), tuple(self._events.popleft() for _ in range(events)))


def _layout(name: str) -> Layout:
    layout = make_layout(SCHEMA_DATA, name, COLUMNS[name])
    assert layout is not None, name  # noqa: S101 - of our own schema
    return layout


def _declare(description: Description) -> tuple[list[Schema], list[Channel]]:
    """Return the schemas and channels of a recording; the numbers of both begin with 1."""
    topics = {topic: schema for topic, schema in SCHEMAS.items() if topic != FILTERED or description.estimator}
    topics |= {WITNESS_PREFIX + name: WITNESS for name in description.witnesses}
    names = list(dict.fromkeys(topics.values()))
    told = {WITNESS_PREFIX + name: {"unit": unit} for name, unit in description.witnesses.items() if unit}
    reading = {"unit": description.unit, "quantity": description.quantity}
    if description.interval_s:
        reading["nominal_rate_hz"] = repr(1 / description.interval_s)
    told |= {
        RAW: reading | {"processing": "none"},
        FILTERED: reading | {"processing": description.estimator.get("name", "")},
    }
    schemas = [Schema(id_, SCHEMA_DATA, SchemaEncoding.Protobuf, name) for id_, name in enumerate(names, start=1)]
    channels = [
        Channel(id_, topic, ENCODING, told.get(topic, {}), names.index(schema) + 1)
        for id_, (topic, schema) in enumerate(topics.items(), start=1)
    ]
    return schemas, channels
