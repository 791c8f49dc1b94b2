"""Writes a record as somebody else would: a CSV table, or MCAP with the mcap package's writer and bytes by struct."""

import struct
from pathlib import Path

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from mcap.writer import Writer

from tests.blind.plant import Record

__all__ = ["write_csv", "write_mcap"]

START_NS = 1_700_000_000_000_000_000
FIELDS = {
    "Reading": {"value": FieldDescriptorProto.TYPE_DOUBLE, "status": FieldDescriptorProto.TYPE_FIXED32},
    "Witness": {"value": FieldDescriptorProto.TYPE_DOUBLE},
}


def write_csv(record: Record, path: Path) -> None:
    """Write `time,value[,temperature]`, a row with the witness's last value."""
    names = list(record.witnesses)
    with path.open("w") as text:
        print("time", "value", *names, sep=",", file=text)
        columns = [
            values[np.maximum(np.searchsorted(times_s, record.time_s, side="right") - 1, 0)]
            for times_s, values in record.witnesses.values()
        ]
        for row, (time_s, value) in enumerate(zip(record.time_s, record.value_V, strict=True)):
            beside = [f"{column[row]:.4f}" for column in columns]
            print(f"{time_s:.9f}", repr(float(value)), *beside, sep=",", file=text)


def write_mcap(record: Record, path: Path, interval_s: float, aperture_s: float | None = None) -> None:
    """Write the topics /dmm/raw and /witness/NAME, as the recordings' schema has them, and the aperture, if known."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(library="blind")
        schemas = {name: writer.register_schema(f"aemd.v1.{name}", "protobuf", descriptor(name)) for name in FIELDS}
        raw = writer.register_channel(
            "/dmm/raw", "protobuf", schemas["Reading"], {"unit": "V", "nominal_rate_hz": repr(1 / interval_s)}
        )
        rows = [
            (to_ns(time_s), 1, raw, int(index), struct.pack("<BdBI", 0x09, value, 0x15, 0))
            for time_s, index, value in zip(record.time_s, record.index, record.value_V, strict=True)
        ]
        for name, (times_s, values) in record.witnesses.items():
            channel = writer.register_channel(f"/witness/{name}", "protobuf", schemas["Witness"])
            rows += [
                (to_ns(time_s), 0, channel, 0, struct.pack("<Bd", 0x09, value))
                for time_s, value in zip(times_s, values, strict=True)
            ]
        for t_ns, _, channel, sequence, payload in sorted(rows):
            writer.add_message(channel, log_time=t_ns, publish_time=t_ns, sequence=sequence, data=payload)
        writer.add_metadata("aemd.segment", {"first_index": "0", "interval_s": repr(interval_s)})
        if aperture_s is not None:
            writer.add_metadata("aemd.session", {"aperture_s": repr(aperture_s)})
        writer.finish()


def to_ns(time_s: float) -> int:
    return START_NS + round(time_s * 1e9)


def descriptor(name: str) -> bytes:
    file = FileDescriptorProto(name="blind.proto", package="aemd.v1", syntax="proto3")
    message = file.message_type.add(name=name)
    for number, (word, kind) in enumerate(FIELDS[name].items(), start=1):
        message.oneof_decl.add(name=f"_{word}")
        message.field.add(
            name=word,
            number=number,
            type=kind,
            label=FieldDescriptorProto.LABEL_OPTIONAL,
            proto3_optional=True,
            oneof_index=number - 1,
        )
    return FileDescriptorSet(file=[file]).SerializeToString()
