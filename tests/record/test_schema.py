import numpy as np
import pytest
from google.protobuf import message_factory
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool

from aemd.block import Event
from aemd.record.schema import (
    COLUMNS,
    HEADER_BYTES,
    SCHEMA_DATA,
    decode_event,
    encode_event,
    make_layout,
)


def _message_class(name: str):
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(SCHEMA_DATA).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


@pytest.mark.parametrize("value", [0.0, -0.0, 1.5, np.nan, np.inf, 5e-324])
@pytest.mark.parametrize("name", COLUMNS)
def test_a_row_is_the_bytes_that_the_protobuf_package_serialises(name: str, value: float) -> None:
    layout = make_layout(SCHEMA_DATA, name, COLUMNS[name])
    rows = layout.make_rows(1, channel=1)
    message = _message_class(name)()
    for number, field in enumerate(COLUMNS[name]):
        content = value if rows.dtype[field].kind == "f" else number * 2**28
        rows[field] = content
        setattr(message, field, content)

    assert rows.tobytes()[HEADER_BYTES:] == message.SerializeToString(deterministic=True)


def test_a_field_that_is_zero_is_present() -> None:
    layout = make_layout(SCHEMA_DATA, "aemd.v1.Reading", COLUMNS["aemd.v1.Reading"])
    rows = layout.make_rows(1, channel=1)
    rows["value"], rows["status"] = 0.0, 0

    message = _message_class("aemd.v1.Reading").FromString(rows.tobytes()[HEADER_BYTES:])

    assert message.HasField("value")
    assert message.HasField("status")


def test_an_event_survives_with_its_words_and_negative_numbers() -> None:
    event = Event(t_ns=7, kind="gap", message="5 readings lost, µV range", first_index=-1, last_index=2**40)

    assert decode_event(encode_event(event), 7) == event


def _schema(kind: FieldDescriptorProto.Type.ValueType, number: int = 1, *, presence: bool = True) -> bytes:
    file = FileDescriptorProto(name="x.proto", package="x", syntax="proto3")
    message = file.message_type.add(name="M")
    message.oneof_decl.add(name="_value")
    message.field.add(name="value", number=number, type=kind, label=1, proto3_optional=presence, oneof_index=0)
    return FileDescriptorSet(file=[file]).SerializeToString()


def test_a_message_whose_width_varies_has_no_rows() -> None:
    fixed, varint = FieldDescriptorProto.TYPE_DOUBLE, FieldDescriptorProto.TYPE_INT64

    assert make_layout(_schema(fixed), "x.M", ["value"]) is not None
    assert make_layout(_schema(varint), "x.M", ["value"]) is None
    assert make_layout(_schema(fixed, number=16), "x.M", ["value"]) is None  # its tag has two bytes
    assert make_layout(_schema(fixed, presence=False), "x.M", ["value"]) is None  # a zero would not be written
    assert make_layout(_schema(fixed), "x.M", ["sigma"]) is None
    assert make_layout(_schema(fixed), "x.Other", ["value"]) is None
