"""ForeignRecording: one number of any MCAP file as readings, in constant memory.

Whatever program wrote the file: chunked or not, with an index or without, packed by zstd, lz4 or not at all. The
messages of one topic become readings, numbered from 0 in the order of the file; nothing tells whether one was lost.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, takewhile
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Metadata, Schema, Statistics
from numpy.typing import NDArray

from aemd.block import ESTIMATE, READING, Batch, Block, Estimates, Status
from aemd.errors import RecordingError, UsageError, not_among
from aemd.record.description import Description
from aemd.record.reader import open_map
from aemd.record.rows import concatenate, rows_at
from aemd.record.scalar import FixedRow, Numbers, UnknownEncodingError, numbers_of
from aemd.record.span import HEAD, Span, spans
from aemd.record.walk import Record, has_end, parse, walk

__all__ = ["ForeignRecording", "Selection", "TimeOf"]

TimeOf = Literal["publish", "log"]

_FOOTER_BYTES = 20
_MAGIC_BYTES = 8
_LISTED = 12  # candidates in an error
_LOOKED_AT = 1000  # messages whose fields are listed, where no schema lists them: some milliseconds of JSON
_INTERVAL_READINGS = 65_536  # whose median step is the interval between readings


@dataclass(frozen=True, slots=True)
class Selection:
    """Which number of a file is the reading."""

    topic: str | None = None
    """None for the only one that has numbers."""
    field: str | None = None
    """None for the only one; `a.b` for a field of a message in the message."""
    time: TimeOf | None = None
    """What stamps a reading; None for publish_time, or log_time where the first message has no publish_time."""

    def __bool__(self) -> bool:
        """Tell whether anything was selected."""
        return self != Selection()


class ForeignRecording:
    """A file of another program, open for reading as if it were a recording; a context manager."""

    is_finished = True
    """Whether the file was closed in order; others are refused."""

    def __init__(self, path: Path, selection: Selection) -> None:
        """Open the file, and find the number.

        Raises:
            RecordingError: it cannot be read, is damaged, or cannot be decoded.
            UsageError: there is no such topic or field, or several could be meant; the message lists them.
        """
        self.path = path
        self._map = open_map(path)
        self.metadata: dict[str, dict[str, str]] = {}
        """Every Metadata record by its name; one that comes twice adds to the first."""
        self._schemas: dict[int, Schema] = {}
        self._by_id: dict[int, Channel] = {}
        self._counted: dict[int, int] = {}
        try:
            self._scan()
            self._topic, self._field, self._numbers = self._choose(selection)
            self._rows = {number: numbers.row(self._field) for number, numbers in self._numbers.items()}
            self._time = selection.time
            self.description = self._describe()
        except BaseException:
            self.close()
            raise

    @property
    def channels(self) -> dict[str, Channel]:
        """By topic; of several channels on a topic, the first."""
        return {channel.topic: channel for channel in reversed(self._by_id.values())}

    @property
    def readings_told(self) -> int | None:
        """How many readings there are as the file's summary says; None where it does not."""
        return sum(self._counted.get(number, 0) for number in self._numbers) or None

    @property
    def size_bytes(self) -> int:
        """Length of the file."""
        return len(self._map)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file. Twice is fine."""
        self._map.close()

    def verify(self) -> None:
        """Do nothing: chunks are held against their checksums when they are read."""

    def batches(self, batch_readings: int | None = None) -> Iterator[Batch]:
        """Yield the readings in order.

        Args:
            batch_readings: readings in each batch but the last; None for as many as each chunk holds.

        Raises:
            RecordingError: the file is damaged, or its time steps back.
        """
        held = np.empty(0, READING)
        for block in self._blocks():
            if batch_readings is None:
                yield Batch(block)
                continue
            held = concatenate([held, block])
            while len(held) > batch_readings:
                yield Batch(held[:batch_readings])
                held = held[batch_readings:]
        if len(held):
            yield Batch(held)

    def batches_with_estimates(self, batch_readings: int | None = None) -> Iterator[tuple[Batch, Estimates]]:
        """Yield the same, without estimates: a file of another program has none."""
        for batch in self.batches(batch_readings):
            yield batch, np.empty(0, ESTIMATE)

    def _blocks(self) -> Iterator[Block]:
        index, last_ns = 0, 0
        for t_ns, values in self._columns():
            usable = np.isfinite(values)
            block = np.zeros(len(t_ns), READING)
            block["index"], block["t_ns"] = index + np.arange(len(t_ns)), t_ns
            block["value_V"] = np.where(usable, values, np.nan)
            block["status"] = np.where(usable, 0, int(Status.INVALID))
            falls = np.flatnonzero(np.diff(t_ns, prepend=last_ns) < 0)
            if len(falls):
                raise RecordingError(
                    f"{self.path}: message {index + int(falls[0])} of {self._topic} is earlier than the one before; "
                    "take the other time by --time, or sort the file, as `mcap sort` does"
                )
            yield block
            index, last_ns = index + len(t_ns), int(t_ns[-1])

    # What there is.

    def _scan(self) -> None:
        """Take in schemas, channels and metadata: those outside chunks or, where there are none, those in them."""
        if not has_end(self._map):
            raise RecordingError(f"{self.path}: is unfinished: it has no footer; `mcap recover` makes it whole")
        before = takewhile(lambda record: record.opcode not in (Opcode.CHUNK, Opcode.MESSAGE), walk(self._map))
        for record in chain(before, self._summary()):
            self._take(record.opcode, self._map[record.begin : record.end], record.at)
        if not self._by_id:
            for span in spans(self._map, str(self.path)):
                for opcode, body in span.declared:
                    self._take(opcode, body, span.at)

    def _summary(self) -> Iterator[Record]:
        end = len(self._map) - _MAGIC_BYTES
        try:
            start = parse(Footer, self._map, Record(Opcode.FOOTER, end, end - _FOOTER_BYTES, end)).summary_start
        except ValueError as error:
            raise RecordingError(f"{self.path}: is damaged: {error}") from error
        return walk(self._map, start) if 0 < start < end else iter(())

    def _take(self, opcode: int, body: bytes, at: int) -> None:
        whole = Record(opcode, at, 0, len(body))
        try:
            match opcode:
                case Opcode.SCHEMA:
                    schema = parse(Schema, body, whole)
                    self._schemas.setdefault(schema.id, schema)
                case Opcode.CHANNEL:
                    channel = parse(Channel, body, whole)
                    self._by_id.setdefault(channel.id, channel)
                case Opcode.STATISTICS:
                    self._counted = parse(Statistics, body, whole).channel_message_counts
                case Opcode.METADATA:
                    told = parse(Metadata, body, whole)
                    self.metadata.setdefault(told.name, {}).update(told.metadata)
        except ValueError as error:
            raise RecordingError(f"{self.path}: is damaged: {error}") from error

    # Which number is meant.

    def _choose(self, wanted: Selection) -> tuple[str, str, dict[int, Numbers]]:
        """Return the topic, the field, and how to decode each channel of the topic."""
        topics = sorted({channel.topic for channel in self._by_id.values()})
        if wanted.topic is not None and wanted.topic not in topics:
            raise UsageError(f"{self.path}: --topic {wanted.topic}: no such topic; {not_among(wanted.topic, topics)}")
        found: dict[str, tuple[dict[int, Numbers], list[str]]] = {}
        faults = []
        for topic in [wanted.topic] if wanted.topic is not None else topics:
            try:
                numbers = {
                    number: numbers_of(channel.message_encoding, self._schemas.get(channel.schema_id))
                    for number, channel in self._by_id.items()
                    if channel.topic == topic
                }
            except (UnknownEncodingError, ValueError) as error:
                faults.append(f"topic {topic} {error}")
                continue
            fields = list(next(iter(numbers.values())).fields) or self._fields_seen(numbers, wanted.field)
            found[topic] = numbers, fields
        if not found or not any(fields for _, fields in found.values()):
            told = "; ".join(faults) or f"its topics: {', '.join(topics) or 'none'}"
            raise RecordingError(f"{self.path}: holds no number that could be a reading: {told}")
        pairs = [(topic, field) for topic, (_, fields) in found.items() for field in fields]
        matching = [pair for pair in pairs if wanted.field in (None, pair[1])]
        if len(matching) != 1:
            listed = ", ".join(f"{topic} {field}" for topic, field in (matching or pairs)[:_LISTED])
            more = f", and {len(matching or pairs) - _LISTED} more" if len(matching or pairs) > _LISTED else ""
            why = "holds several numbers" if matching else f"--field {wanted.field}: no such number"
            raise UsageError(f"{self.path}: {why}; choose by --topic and --field among: {listed}{more}")
        topic, field = matching[0]
        return topic, field, found[topic][0]

    def _fields_seen(self, numbers: dict[int, Numbers], wanted: str | None) -> list[str]:
        """Return the numbers that messages have, where no schema tells: the first ones and, to find the wanted, more.

        A message may leave a field out, the first one as well as any other.
        """
        seen: dict[str, None] = {}
        looked_at = 0
        for span in spans(self._map, str(self.path)):
            heads = span.heads()
            for place in np.flatnonzero(np.isin(heads["channel"], list(numbers))).tolist():
                number = int(heads["channel"][place])
                try:
                    seen.update(dict.fromkeys(numbers[number].fields_in(_payload(span, place, heads))))
                except ValueError as error:
                    raise self._undecodable(number, span, error) from error
                looked_at += 1
                if looked_at >= _LOOKED_AT and (wanted is None or wanted in seen):
                    return list(seen)
        return list(seen)

    def _describe(self) -> Description:
        read, stamps = 0, list[NDArray[np.int64]]()
        for t_ns, _ in self._columns():
            stamps.append(t_ns)
            read += len(t_ns)
            if read > _INTERVAL_READINGS:
                break
        steps = np.diff(np.concatenate([np.empty(0, np.int64), *stamps])[:_INTERVAL_READINGS])
        told = self.channels[self._topic].metadata
        return Description(
            unit=told.get("unit", "V"),
            quantity=told.get("quantity", "voltage" if told.get("unit", "V") == "V" else "reading"),
            interval_s=float(np.median(steps)) * 1e-9 if len(steps) else 0.0,
            session={
                "origin": f"{self.path.name}, of another program",
                "topic": self._topic,
                "field": self._field,
                "time": f"{self._time or 'publish'}_time",
                "interval": f"median of the first {len(steps) + 1} readings",
            },
        )

    # The numbers.

    def _columns(self) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Yield instants, ns, and values, NaN where a message has none; each of shape (n,), n at least 1."""
        for span in spans(self._map, str(self.path)):
            heads = span.heads()
            of_topic = np.isin(heads["channel"], list(self._numbers))
            if not of_topic.any():
                continue
            values = np.full(len(heads), np.nan)
            for number in self._numbers:
                self._fill(values, span, heads, number)
            heads = heads[of_topic]
            if self._time is None:
                self._time = "publish" if heads["publish_time"][0] else "log"
            yield heads[f"{self._time}_time"].astype(np.int64), values[of_topic]

    def _fill(self, values: NDArray[np.float64], span: Span, heads: NDArray[np.void], number: int) -> None:
        """Write a channel's values to their places among the messages of the span."""
        places = np.flatnonzero(heads["channel"] == number)
        row = self._rows[number]
        if row is not None:
            places = _fill_fixed(values, span, heads, places, row)
        decoder = self._numbers[number]
        for place in places.tolist():
            try:
                values[place] = decoder.value(_payload(span, place, heads), self._field)
            except ValueError as error:
                raise self._undecodable(number, span, error) from error

    def _undecodable(self, number: int, span: Span, error: ValueError) -> RecordingError:
        topic = self._by_id[number].topic
        return RecordingError(f"{self.path}: is damaged: a message of {topic} from byte {span.at} on {error}")


def _fill_fixed(
    values: NDArray[np.float64], span: Span, heads: NDArray[np.void], places: NDArray[np.intp], row: FixedRow
) -> NDArray[np.intp]:
    """Write the values of messages that are rows of fixed width; return the places of those that are not."""
    fits = heads["length"][places] == HEAD.itemsize - 9 + len(row.template)
    fixed = places[fits]
    if not len(fixed):
        return places
    kind = np.dtype(
        {
            "names": ["payload", "number"],
            "formats": [("u1", len(row.template)), row.number],
            "offsets": [HEAD.itemsize, HEAD.itemsize + row.offset],
            "itemsize": HEAD.itemsize + len(row.template),
        }
    )
    rows = rows_at(span.octets, kind, span.starts[fixed])
    alike = np.ones(len(rows), np.bool_)
    for constant in row.constant.tolist():
        alike &= rows["payload"][:, constant] == row.template[constant]
    values[fixed[alike]] = rows["number"][alike]
    return np.concatenate([places[~fits], fixed[~alike]])


def _payload(span: Span, place: int, heads: NDArray[np.void]) -> bytes:
    begin = int(span.starts[place]) + HEAD.itemsize
    return span.octets[begin : begin + int(heads["length"][place]) + 9 - HEAD.itemsize].tobytes()
