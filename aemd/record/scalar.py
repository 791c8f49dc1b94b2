"""One number out of the messages of any schema: which fields there are, and their values, many messages at a time.

Protobuf messages whose fields all have a fixed width are rows of an array, with the number at the same place in each.
Where that is follows from the schema in the file. A writer may leave out fields that are zero, so each message is held
against the row's length and tags; those that do not fit, and all messages of other encodings, are decoded one by one.
"""

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from google.protobuf import message_factory
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import Default, DescriptorPool
from google.protobuf.message import DecodeError, Message
from mcap.records import Schema
from numpy.typing import NDArray

__all__ = ["FixedRow", "Numbers", "UnknownEncodingError", "numbers_of"]

_FIXED = {
    FieldDescriptor.TYPE_DOUBLE: (1, "<f8"),
    FieldDescriptor.TYPE_FIXED64: (1, "<u8"),
    FieldDescriptor.TYPE_SFIXED64: (1, "<i8"),
    FieldDescriptor.TYPE_FLOAT: (5, "<f4"),
    FieldDescriptor.TYPE_FIXED32: (5, "<u4"),
    FieldDescriptor.TYPE_SFIXED32: (5, "<i4"),
}
"""Protobuf type -> wire type and numpy type, of those whose width never varies."""
_NESTED = 2  # wire type of a message inside a message: a length, and its bytes
_NO_NUMBER = {FieldDescriptor.CPPTYPE_STRING, FieldDescriptor.CPPTYPE_BOOL, FieldDescriptor.CPPTYPE_ENUM}
_DEEPEST = 6  # messages within messages: a type may hold itself
_ROS = {"cdr": ("mcap_ros2.decoder", "mcap-ros2-support"), "ros1": ("mcap_ros1.decoder", "mcap-ros1-support")}
"""Encodings that a package of their own decodes, where it is installed."""


class UnknownEncodingError(Exception):
    """Messages of this encoding cannot be decoded here; the message says what would help."""


@dataclass(frozen=True, slots=True)
class FixedRow:
    """Where a number is in messages of fixed width."""

    template: NDArray[np.uint8]
    """A message with zero in place of every number; shape (bytes,)."""
    constant: NDArray[np.intp]
    """Places of tags and of lengths, which are alike in all messages."""
    offset: int
    """Place of the number."""
    number: np.dtype[Any]


@dataclass(frozen=True, slots=True)
class Numbers:
    """The numbers in the messages of a channel."""

    fields: tuple[str, ...]
    """Those that are known from the schema, nested ones as `a.b`; empty where only a message tells."""
    fields_in: Callable[[bytes], Iterable[str]]
    """Those that a message has."""
    value: Callable[[bytes, str], float]
    """A message's number; NaN where it has none. Raises ValueError if it is none of the schema's messages."""
    row: Callable[[str], FixedRow | None]
    """Where the field is, if the messages have a fixed width."""


def numbers_of(encoding: str, schema: Schema | None) -> Numbers:
    """Return how to take numbers out of messages.

    Raises:
        UnknownEncodingError: nothing here decodes them.
        ValueError: the schema is damaged.
    """
    if encoding == "protobuf" and schema is not None:
        return _of_protobuf(schema)
    if encoding == "json":
        return Numbers((), _flat_json, _value_in_json, lambda _: None)
    if encoding in _ROS and schema is not None:
        return _of_ros(encoding, schema)
    raise UnknownEncodingError(f"is encoded as {encoding!r}, of which we decode protobuf, json and ROS's only")


# Protobuf.


def _of_protobuf(schema: Schema) -> Numbers:
    descriptor = _find(schema)
    kind = message_factory.GetMessageClass(descriptor)
    return Numbers(
        fields=tuple(_paths(descriptor)),
        fields_in=lambda _: _paths(descriptor),
        value=lambda payload, field: _value_in_message(kind, payload, field),
        row=lambda field: _fixed_row(descriptor, field),
    )


def _find(schema: Schema) -> Descriptor:
    try:
        files = {file.name: file for file in FileDescriptorSet.FromString(schema.data).file}
        pool = DescriptorPool()
        _add(pool, files, list(files))
        return pool.FindMessageTypeByName(schema.name)
    except (DecodeError, KeyError, TypeError) as error:
        raise ValueError(f"has a damaged schema {schema.name!r}") from error


def _add(pool: DescriptorPool, files: Mapping[str, FileDescriptorProto], names: Iterable[str]) -> None:
    """Put the files into the pool, each behind those that it imports, in whatever order the schema has them."""
    for name in names:
        try:
            pool.FindFileByName(name)
        except KeyError:
            file = files.get(name)
            if file is None:  # a writer may leave out what every protobuf package brings, such as timestamp.proto
                file = FileDescriptorProto()
                Default().FindFileByName(name).CopyToProto(file)
            _add(pool, files, file.dependency)
            pool.Add(file)


def _paths(descriptor: Descriptor, depth: int = 1) -> Iterable[str]:
    for field in descriptor.fields:
        if field.is_repeated:
            continue
        if field.message_type is None:
            if field.cpp_type not in _NO_NUMBER:
                yield field.name
        elif depth < _DEEPEST:
            yield from (f"{field.name}.{inner}" for inner in _paths(field.message_type, depth + 1))


def _value_in_message(kind: type[Message], payload: bytes, path: str) -> float:
    try:
        message: Any = kind.FromString(payload)
    except DecodeError as error:
        raise ValueError("is none of its schema") from error
    *outer, last = path.split(".")
    for name in outer:
        if not message.HasField(name):
            return math.nan
        message = getattr(message, name)
    if message.DESCRIPTOR.fields_by_name[last].has_presence and not message.HasField(last):
        return math.nan
    return float(getattr(message, last))


def _fixed_row(descriptor: Descriptor, field: str) -> FixedRow | None:
    """Return where the field is if each field of the message, and of those in it, has a fixed width; else None."""
    laid = _lay_out(descriptor)
    if laid is None or field not in laid[2]:
        return None
    template, constant, places = laid
    offset, number = places[field]
    return FixedRow(np.frombuffer(template, np.uint8), np.array(constant, np.intp), offset, np.dtype(number))


def _lay_out(descriptor: Descriptor, depth: int = 1) -> tuple[bytes, list[int], dict[str, tuple[int, str]]] | None:
    """Return a message's template, the places in it that are constant, and the place and type of each number."""
    template, constant, places = b"", list[int](), dict[str, tuple[int, str]]()
    for field in sorted(descriptor.fields, key=lambda field: field.number):
        one_of = field.containing_oneof  # of a single member, it is how proto3 marks presence
        if field.is_repeated or (one_of is not None and len(one_of.fields) > 1):
            return None
        inner = None
        if field.message_type is not None:
            inner = _lay_out(field.message_type, depth + 1) if depth < _DEEPEST else None
            if inner is None:
                return None
            mark = _varint(field.number << 3 | _NESTED) + _varint(len(inner[0]))
        elif field.type in _FIXED:
            mark = _varint(field.number << 3 | _FIXED[field.type][0])
        else:
            return None
        constant += range(len(template), len(template) + len(mark))
        template += mark
        if inner is not None:
            constant += [len(template) + place for place in inner[1]]
            for name, (place, number) in inner[2].items():
                places[f"{field.name}.{name}"] = (len(template) + place, number)
            template += inner[0]
        else:
            number = _FIXED[field.type][1]
            places[field.name] = (len(template), number)
            template += bytes(np.dtype(number).itemsize)
    return template, constant, places


def _varint(number: int) -> bytes:
    octets = b""
    while number > 0x7F:
        octets += bytes([number & 0x7F | 0x80])
        number >>= 7
    return octets + bytes([number])


# JSON, and what other packages decode.


def _flat_json(payload: bytes) -> Iterable[str]:
    return _flat(_parse_json(payload))


def _flat(value: Any, depth: int = 1) -> Iterable[str]:
    if isinstance(value, dict):
        for name, item in value.items():
            if isinstance(item, int | float) and not isinstance(item, bool):
                yield name
            elif depth < _DEEPEST:
                yield from (f"{name}.{inner}" for inner in _flat(item, depth + 1))


def _value_in_json(payload: bytes, path: str) -> float:
    value = _parse_json(payload)
    for name in path.split("."):
        value = value.get(name) if isinstance(value, dict) else None
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            return math.nan  # an integer beyond every double
    return math.nan


def _parse_json(payload: bytes) -> Any:
    try:
        return json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise ValueError("is no JSON") from error


def _of_ros(encoding: str, schema: Schema) -> Numbers:
    module, package = _ROS[encoding]
    try:
        factory = import_module(module).DecoderFactory()
    except ImportError as error:
        raise UnknownEncodingError(f"is encoded as {encoding!r}; install the package {package} to read it") from error
    decode = factory.decoder_for(encoding, schema)
    if decode is None:
        raise UnknownEncodingError(f"is encoded as {encoding!r} with a schema that {package} does not know")
    return Numbers(
        fields=(),
        fields_in=lambda payload: _flat(_as_mapping(decode(payload))),
        value=lambda payload, field: _attribute(decode(payload), field),
        row=lambda _: None,
    )


def _as_mapping(message: Any, depth: int = 1) -> Any:
    names = getattr(message, "__slots__", None)
    if not names or depth >= _DEEPEST:
        return message
    return {name: _as_mapping(getattr(message, name), depth + 1) for name in names}


def _attribute(message: Any, path: str) -> float:
    for name in path.split("."):
        message = getattr(message, name, None)
    return float(message) if isinstance(message, int | float) else math.nan
