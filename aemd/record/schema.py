"""The messages of a recording: their protobuf schemas, and the same bytes as numpy rows.

Every number of a message is a fixed-width protobuf field with explicit presence (`optional double`, `optional
fixed32`), so each message of a type has the same length, also when it is all zeros, and the Message records of a chunk
are one structured array. Any protobuf decoder reads them; we never need one, except for the words in an event.

The row is derived from the descriptor, not written down a second time, and the reader derives it from the descriptor
inside the file.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from google.protobuf import message_factory
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError, Message
from mcap.opcode import Opcode
from numpy.typing import NDArray

from aemd import block
from aemd.block import Event

__all__ = [
    "COLUMNS",
    "ENCODING",
    "EVENT",
    "FILTERED",
    "HEADER_BYTES",
    "RAW",
    "RECORDS",
    "SCHEMAS",
    "SCHEMA_DATA",
    "WITNESS",
    "WITNESS_PREFIX",
    "Layout",
    "decode_event",
    "encode_event",
    "fill_rows",
    "make_layout",
]

RAW = "/dmm/raw"
FILTERED = "/dmm/filtered"
EVENT = "/dmm/event"
WITNESS_PREFIX = "/witness/"
ENCODING = "protobuf"

Rows = NDArray[np.void]

_MESSAGES: Mapping[str, Mapping[str, str]] = {
    "Reading": {"value": "double", "status": "fixed32"},
    "Estimate": {
        "value": "double",
        "sigma": "double",
        "u": "double",
        "window": "fixed32",
        "passes": "fixed32",
        "spread": "double",
        "log_likelihood": "double",
        "status": "fixed32",
    },
    "Event": {"kind": "string", "message": "string", "first_index": "sfixed64", "last_index": "sfixed64"},
    "Witness": {"value": "double"},
}
"""Fields in the order of their numbers, from 1."""

SCHEMAS: Mapping[str, str] = {RAW: "aemd.v1.Reading", FILTERED: "aemd.v1.Estimate", EVENT: "aemd.v1.Event"}
"""Message type of each topic but the witnesses'."""
WITNESS = "aemd.v1.Witness"

RECORDS: Mapping[str, np.dtype[np.void]] = {
    "aemd.v1.Reading": block.READING,
    "aemd.v1.Estimate": block.ESTIMATE,
    WITNESS: block.WITNESS,
}
"""The array that a fixed-width message becomes."""

COLUMNS: Mapping[str, Mapping[str, str]] = {
    "aemd.v1.Reading": {"value": "value_V", "status": "status"},
    "aemd.v1.Estimate": {
        "value": "value_V",
        "sigma": "sigma_V",
        "u": "u_V",
        "window": "window",
        "passes": "passes",
        "spread": "spread",
        "log_likelihood": "log_likelihood",
        "status": "status",
    },
    WITNESS: {"value": "value"},
}
"""Field of the message -> column of the array. The rest of an array travels in the Message record's own header."""

_TYPES: Mapping[str, FieldDescriptorProto.Type.ValueType] = {
    "double": FieldDescriptorProto.TYPE_DOUBLE,
    "fixed32": FieldDescriptorProto.TYPE_FIXED32,
    "sfixed64": FieldDescriptorProto.TYPE_SFIXED64,
    "string": FieldDescriptorProto.TYPE_STRING,
}
_WIDTHS: Mapping[int, tuple[int, str]] = {
    FieldDescriptorProto.TYPE_DOUBLE: (1, "<f8"),
    FieldDescriptorProto.TYPE_FIXED64: (1, "<u8"),
    FieldDescriptorProto.TYPE_SFIXED64: (1, "<i8"),
    FieldDescriptorProto.TYPE_FLOAT: (5, "<f4"),
    FieldDescriptorProto.TYPE_FIXED32: (5, "<u4"),
    FieldDescriptorProto.TYPE_SFIXED32: (5, "<i4"),
}
"""Protobuf type -> wire type and numpy type, of those whose width never varies."""

_HEADER: list[tuple[str, str]] = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]
"""A Message record up to its payload (MCAP specification, "Message")."""
HEADER_BYTES = np.dtype(_HEADER).itemsize
_BEGIN_BYTES = 11  # opcode, length and channel
_FRAME_BYTES = 9  # opcode and length, which the length itself does not count
_MOST_FIELDS = 15  # a field number beyond it takes a tag of two bytes


def _describe() -> FileDescriptorProto:
    file = FileDescriptorProto(name="aemd/v1/messages.proto", package="aemd.v1", syntax="proto3")
    for name, fields in _MESSAGES.items():
        message = file.message_type.add(name=name)
        for number, (field, kind) in enumerate(fields.items(), start=1):
            # Explicit presence in proto3 is a one-of with a single member.
            message.oneof_decl.add(name=f"_{field}")
            message.field.add(
                name=field,
                number=number,
                type=_TYPES[kind],
                label=FieldDescriptorProto.LABEL_OPTIONAL,
                proto3_optional=True,
                oneof_index=number - 1,
            )
    return file


_FILE = _describe()
SCHEMA_DATA: bytes = FileDescriptorSet(file=[_FILE]).SerializeToString(deterministic=True)
"""The descriptor that every Schema record of ours carries."""

_POOL = DescriptorPool()
_POOL.Add(_FILE)
_EventMessage: type[Message] = message_factory.GetMessageClass(_POOL.FindMessageTypeByName("aemd.v1.Event"))


@dataclass(frozen=True, slots=True)
class Layout:
    """How the Message records of one fixed-width type look as rows."""

    row: np.dtype[np.void]
    """Packed: the Message record's header, then a tag and a value for each field."""
    constants: Mapping[str, int]
    """What every such row holds: opcode, length, and the tag of each field."""
    blank: Rows
    """One row with these, and zeros for the rest; shape (1,)."""

    def make_rows(self, count: int, channel: int) -> Rows:
        """Return that many rows of the channel, times and values not yet filled in."""
        rows = np.empty(count, self.row)
        self.mark(rows, channel)
        return rows

    def mark(self, rows: Rows, channel: int) -> None:
        """Write into these rows what every row of the channel holds, and zeros for the rest."""
        row = self.blank.copy()
        row["channel"] = channel
        as_bytes = f"V{self.row.itemsize}"  # numpy would copy field by field
        rows.view(as_bytes)[:] = row.view(as_bytes)

    def are_heads(self, octets: NDArray[np.uint8], at: int, stride: int, count: int, channel: int) -> bool:
        """Tell whether a message of this length on that channel begins at each of these places, as far as heads tell.

        Args:
            octets: what holds them.
            at: the first place.
            stride: bytes from one to the next.
            count: how many.
            channel: of all of them.
        """
        head = self.blank.copy()
        head["channel"] = channel
        begin = head.tobytes()[:_BEGIN_BYTES]
        # One walk through all of it: where there are a million bytes, each takes as long as the comparing.
        return np.ndarray((count,), f"V{_BEGIN_BYTES}", octets, at, (stride,)).tobytes() == begin * count

    def are_rows(self, rows: Rows, channel: int) -> bool:
        """Tell whether each of these is a message of this type on that channel."""
        return bool((rows["channel"] == channel).all()) and all(
            bool((rows[name] == constant).all()) for name, constant in self.constants.items()
        )


def _find_message(schema_data: bytes, name: str) -> DescriptorProto | None:
    try:
        files = FileDescriptorSet.FromString(schema_data).file
    except DecodeError:
        return None
    for file in files:
        for message in file.message_type:
            if f"{file.package}.{message.name}" == name:
                return message
    return None


def make_layout(schema_data: bytes, name: str, required: Iterable[str]) -> Layout | None:
    """Derive the rows of a message type from its serialised FileDescriptorSet.

    Args:
        schema_data: what the Schema record carries.
        name: full name of the message type.
        required: fields that it must have; it may have more.

    Returns:
        None when that is no descriptor, or the type is not there, lacks a field, or has one whose width varies.

    >>> make_layout(SCHEMA_DATA, "aemd.v1.Reading", ["value", "status"]).row.itemsize  # 31 header, 1 + 8, 1 + 4
    45
    """
    message = _find_message(schema_data, name)
    if message is None or not set(required) <= {field.name for field in message.field}:
        return None
    columns, constants = list(_HEADER), {"opcode": int(Opcode.MESSAGE)}
    for field in sorted(message.field, key=lambda field: field.number):
        if field.type not in _WIDTHS or field.number > _MOST_FIELDS or not field.proto3_optional:
            return None
        wire_type, width = _WIDTHS[field.type]
        columns += [(f"{field.name}.tag", "u1"), (field.name, width)]
        constants[f"{field.name}.tag"] = field.number << 3 | wire_type
    row = np.dtype(columns)
    constants["length"] = row.itemsize - _FRAME_BYTES
    blank = np.zeros(1, row)
    for name, constant in constants.items():
        blank[name] = constant
    return Layout(row, constants, blank)


def fill_rows(rows: Rows, name: str, values: NDArray[np.void]) -> None:
    """Put readings, estimates or witness values into marked rows of their message type; all but the log times."""
    rows["publish_time"] = values["t_ns"]
    if name != WITNESS:
        rows["sequence"] = values["index"] & 0xFFFFFFFF
    for field, column in COLUMNS[name].items():
        rows[field] = values[column]


def encode_event(event: Event) -> bytes:
    """Return the event's payload; its instant goes into the Message record."""
    message = _EventMessage(
        kind=event.kind, message=event.message, first_index=event.first_index, last_index=event.last_index
    )
    return message.SerializeToString(deterministic=True)


def decode_event(payload: bytes, t_ns: int) -> Event:
    """Return the event of a payload.

    Raises:
        google.protobuf.message.DecodeError: it is not one.
    """
    message = _EventMessage.FromString(payload)
    words = {name: getattr(message, name) for name in ("kind", "message", "first_index", "last_index")}
    return Event(t_ns=t_ns, **words)
