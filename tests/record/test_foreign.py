"""Files of other programs, written here by the mcap package's own writer, read as readings."""

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.records import Schema
from mcap.writer import CompressionType, IndexType, Writer

from aemd.block import Block, Status
from aemd.errors import RecordingError, UsageError
from aemd.record.foreign import ForeignRecording, Selection, TimeOf
from aemd.record.reader import Recording
from aemd.record.scalar import numbers_of
from aemd.record.source import open_readings

COUNT = 3000
STEP_NS = 1_000_000
VALUES = np.random.default_rng(7).standard_normal(COUNT)
VALUES[100], VALUES[200] = 0.0, math.nan


def _message(name: str, fields: dict[str, tuple[int, str]], *, optional: bool = False) -> Any:
    """Return the message class of a protobuf type made here: name -> number and type, `.Type` being a nested one."""
    file = FileDescriptorProto(name=f"{name}.proto", package="lab", syntax="proto3")
    nested = file.message_type.add(name="Sample")
    nested.field.add(name="celsius", number=1, type=FieldDescriptorProto.TYPE_FLOAT, label=1)
    nested.field.add(name="volts", number=20, type=FieldDescriptorProto.TYPE_DOUBLE, label=1)
    message = file.message_type.add(name=name)
    for place, (field, (number, kind)) in enumerate(fields.items()):
        added = message.field.add(name=field, number=number, label=1)
        if kind.startswith("."):
            added.type, added.type_name = FieldDescriptorProto.TYPE_MESSAGE, kind
        else:
            added.type = getattr(FieldDescriptorProto, f"TYPE_{kind.upper()}")
            if optional:
                added.proto3_optional, added.oneof_index = True, place
                message.oneof_decl.add(name=f"_{field}")
    if any(kind == ".google.protobuf.Timestamp" for _, kind in fields.values()):
        file.dependency.append("google/protobuf/timestamp.proto")
    pool = DescriptorPool()
    stamp = FileDescriptorProto()
    Timestamp.DESCRIPTOR.file.CopyToProto(stamp)
    pool.Add(stamp)
    pool.Add(file)
    kind = GetMessageClass(pool.FindMessageTypeByName(f"lab.{name}"))
    kind.schema_data = FileDescriptorSet(file=[file]).SerializeToString()
    return kind


def _write(
    path: Path,
    encoding: str,
    payloads: list[bytes],
    schema: tuple[str, bytes] = ("", b""),
    *,
    topic: str = "/volts",
    metadata: dict[str, str] | None = None,
    publish: bool = True,
    noise: bool = True,
    **options: Any,
) -> Path:
    with path.open("wb") as out:
        writer = Writer(out, **{"chunk_size": 20_000, **options})
        writer.start()
        number = writer.register_schema(schema[0], encoding, schema[1]) if schema[0] else 0
        other = writer.register_channel("/log", "text", 0)
        channel = writer.register_channel(topic, encoding, number, metadata or {})
        for place, payload in enumerate(payloads):
            t_ns = 10**18 + place * STEP_NS
            if noise and place % 7 == 0:
                writer.add_message(other, t_ns, b"x" * (place % 50), t_ns)
            writer.add_message(channel, t_ns + 500, payload, t_ns if publish else 0, place)
        writer.finish()
    return path


def _read(path: Path, topic: str | None = None, field: str | None = None, time: TimeOf | None = None) -> Block:
    with ForeignRecording(path, Selection(topic, field, time)) as recording:
        return np.concatenate([batch.readings for batch in recording.batches()])


def _assert_read(readings: Block, values: np.ndarray = VALUES) -> None:
    assert readings["index"].tolist() == list(range(COUNT))
    assert readings["t_ns"].tolist() == [10**18 + place * STEP_NS for place in range(COUNT)]
    np.testing.assert_array_equal(readings["value_V"], values)
    assert np.flatnonzero(readings["status"]).tolist() == [200]
    assert readings["status"][200] == Status.INVALID


@pytest.mark.parametrize("optional", [True, False], ids=["every field written", "zeros left out"])
@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.ZSTD},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.NONE, "use_chunking": False},
        {"use_statistics": False, "use_summary_offsets": False, "repeat_channels": False, "repeat_schemas": False},
        {"enable_crcs": False},
    ],
    ids=str,
)
def test_fixed_width_protobuf_reads_to_the_bit_however_it_is_packed(
    tmp_path: Path, options: dict[str, Any], optional: bool
) -> None:
    kind = _message("Volt", {"value": (1, "double")}, optional=optional)
    payloads = [kind(value=value).SerializeToString() for value in VALUES.tolist()]

    path = _write(tmp_path / "v.mcap", "protobuf", payloads, ("lab.Volt", kind.schema_data), **options)

    _assert_read(_read(path))


def test_a_number_deep_in_a_message_of_fixed_width_is_taken_from_the_row(tmp_path: Path) -> None:
    kind = _message("Deep", {"seq": (1, "fixed32"), "sample": (3, ".lab.Sample"), "gain": (40, "float")})
    payloads = []
    for value in VALUES.tolist():
        message = kind(seq=7, gain=2.0)
        message.sample.celsius, message.sample.volts = 20.5, value
        payloads.append(message.SerializeToString())
    path = _write(tmp_path / "v.mcap", "protobuf", payloads, ("lab.Deep", kind.schema_data))

    row = numbers_of("protobuf", _schema("lab.Deep", kind.schema_data)).row("sample.volts")
    readings = _read(path, field="sample.volts")

    # By hand: 0d +4, 1a 0f (0d +4, a1 01 +8) -- two bytes of tag for field 20 --, then c5 02 +4.
    assert row is not None
    assert (len(row.template), row.offset) == (5 + 2 + 5 + 10 + 6, 5 + 2 + 5 + 2)
    _assert_read(readings)


def test_fields_in_another_order_than_the_schemas_are_found_all_the_same(tmp_path: Path) -> None:
    kind = _message("Pair", {"first": (1, "double"), "second": (2, "double")}, optional=True)
    payloads = [kind(first=value, second=-value).SerializeToString() for value in (1.0, 2.0)]
    payloads.append(payloads[1][9:] + payloads[1][:9])  # any order is valid protobuf
    path = _write(tmp_path / "v.mcap", "protobuf", payloads, ("lab.Pair", kind.schema_data))

    assert _read(path, field="first")["value_V"].tolist() == [1.0, 2.0, 2.0]


def _schema(name: str, data: bytes) -> Schema:
    return Schema(1, data, "protobuf", name)


def test_protobuf_of_varying_width_reads_to_the_bit(tmp_path: Path) -> None:
    fields = {"stamp": (1, ".google.protobuf.Timestamp"), "note": (2, "string"), "value": (3, "double")}
    kind = _message("Noted", fields)
    payloads = []
    for place, value in enumerate(VALUES.tolist()):
        message = kind(note="n" * (place % 5), value=value)
        message.stamp.FromNanoseconds(place * STEP_NS)
        payloads.append(message.SerializeToString())
    # The set leaves out timestamp.proto, as some writers do.
    path = _write(tmp_path / "v.mcap", "protobuf", payloads, ("lab.Noted", kind.schema_data))

    _assert_read(_read(path, field="value"))
    with pytest.raises(UsageError, match=r"among: /volts stamp\.seconds, /volts stamp\.nanos, /volts value$"):
        _read(path)


def test_json_reads_to_the_bit_and_what_is_no_number_is_no_value(tmp_path: Path) -> None:
    payloads = [json.dumps({"dmm": {"value": value, "ok": True}}).encode() for value in VALUES.tolist()]
    payloads[200] = b'{"dmm": {"value": "overload"}}'

    path = _write(tmp_path / "v.mcap", "json", payloads)

    _assert_read(_read(path))
    _assert_read(_read(path, "/volts", "dmm.value"))


@pytest.mark.parametrize("first", [1, 999, 2500])
def test_a_field_that_the_first_messages_leave_out_can_be_chosen_all_the_same(tmp_path: Path, first: int) -> None:
    payloads = [json.dumps({"a": place} | ({"b": {"c": -place}} if place >= first else {})) for place in range(COUNT)]
    path = _write(tmp_path / "late.mcap", "json", [text.encode() for text in payloads])

    readings = _read(path, field="b.c")

    assert np.flatnonzero(readings["status"]).tolist() == list(range(first))
    assert readings["value_V"][first:].tolist() == [-place for place in range(first, COUNT)]
    with pytest.raises(UsageError, match=r"--field c: no such number; choose by --topic and --field among: /volts a"):
        _read(path, field="c")


def test_the_stamp_is_publish_time_unless_that_is_missing_or_the_other_is_asked_for(tmp_path: Path) -> None:
    payloads = [b'{"v": 1}', b'{"v": 2}']
    both = _write(tmp_path / "both.mcap", "json", payloads)
    unpublished = _write(tmp_path / "log.mcap", "json", payloads, publish=False)

    assert _read(both)["t_ns"].tolist() == [10**18, 10**18 + STEP_NS]
    assert _read(both, time="log")["t_ns"].tolist() == [10**18 + 500, 10**18 + STEP_NS + 500]
    assert _read(unpublished)["t_ns"].tolist() == [10**18 + 500, 10**18 + STEP_NS + 500]
    with ForeignRecording(unpublished, Selection()) as recording:
        assert recording.description.session["time"] == "log_time"
        assert recording.description.interval_s == pytest.approx(1e-3)


def test_an_integer_is_a_number_and_the_channel_tells_its_unit(tmp_path: Path) -> None:
    kind = _message("Count", {"counts": (1, "sint64")})
    payloads = [kind(counts=number).SerializeToString() for number in (-5, 0, 7)]
    path = _write(
        tmp_path / "v.mcap", "protobuf", payloads, ("lab.Count", kind.schema_data), metadata={"unit": "counts"}
    )

    with ForeignRecording(path, Selection()) as recording:
        readings = np.concatenate([batch.readings for batch in recording.batches()])
        assert (recording.description.unit, recording.description.quantity) == ("counts", "reading")
    assert readings["value_V"].tolist() == [-5.0, 0.0, 7.0]


@pytest.mark.parametrize(
    ("selection", "complaint"),
    [
        (Selection(), r"holds several numbers; choose by --topic and --field among: /volts a, /volts b\.c$"),
        (Selection(field="x"), r"--field x: no such number; choose by --topic and --field among: /volts a, /volts b"),
        (Selection(topic="/volt"), r"--topic /volt: no such topic; did you mean '/volts'\? there are: /log, /volts"),
        (Selection(topic="/log"), r"holds no number that could be a reading: topic /log is encoded as 'text'"),
    ],
)
def test_what_could_mean_several_numbers_or_none_lists_what_there_is(
    tmp_path: Path, selection: Selection, complaint: str
) -> None:
    path = _write(tmp_path / "v.mcap", "json", [b'{"a": 1, "b": {"c": 2, "d": "e"}, "f": true}'])

    with pytest.raises((UsageError, RecordingError), match=r"v\.mcap: " + complaint) as refused:
        _read(path, selection.topic, selection.field)
    assert "\n" not in str(refused.value)


def _damage(octets: bytes) -> bytes:
    return octets.replace(b'{"v": 12}', b'{"v": 13}')


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (_damage, r"is damaged: its chunk at byte \d+ has a wrong CRC"),
        (lambda octets: octets[:-40], r"is unfinished: it has no footer; `mcap recover` makes it whole"),
        (lambda octets: octets[:30] + octets[-60:], r"is damaged|holds no number"),
    ],
)
def test_a_damaged_foreign_file_is_one_line(tmp_path: Path, damage: Callable[[bytes], bytes], complaint: str) -> None:
    path = _write(tmp_path / "v.mcap", "json", [b'{"v": 12}'] * 50, compression=CompressionType.NONE)
    path.write_bytes(damage(path.read_bytes()))

    with pytest.raises(RecordingError, match=r"v\.mcap: " + complaint) as refused:
        _read(path)
    assert "\n" not in str(refused.value)


def test_a_message_that_is_none_of_its_schema_is_damage_and_not_a_value(tmp_path: Path) -> None:
    kind = _message("Volt", {"value": (1, "double")})
    payloads = [kind(value=1.0).SerializeToString(), b"\x09\x00\x00"]

    with pytest.raises(RecordingError, match=r"is damaged: a message of /volts from byte \d+ on is none of its schema"):
        _read(_write(tmp_path / "v.mcap", "protobuf", payloads, ("lab.Volt", kind.schema_data)))
    with pytest.raises(RecordingError, match=r"is damaged: a message of /volts from byte \d+ on is no JSON"):
        _read(_write(tmp_path / "j.mcap", "json", [b'{"v": 1}', b"{"]))


def test_a_stamp_that_steps_back_is_refused_with_the_way_out(tmp_path: Path) -> None:
    with (tmp_path / "v.mcap").open("wb") as out:
        writer = Writer(out)
        writer.start()
        channel = writer.register_channel("/v", "json", 0)
        for log_ns, publish_ns in ((1, 10), (2, 9)):
            writer.add_message(channel, log_ns, b'{"v": 1}', publish_ns)
        writer.finish()

    with pytest.raises(RecordingError, match=r"message 1 of /v is earlier than the one before; take the other time by"):
        _read(tmp_path / "v.mcap")
    assert _read(tmp_path / "v.mcap", time="log")["t_ns"].tolist() == [1, 2]


def test_ros_messages_are_refused_with_the_package_that_would_read_them(tmp_path: Path) -> None:
    payload = struct.pack("<4xd", 1.0)
    path = _write(tmp_path / "v.mcap", "cdr", [payload], ("std_msgs/msg/Float64", b"float64 data"))

    with pytest.raises(RecordingError, match=r"is encoded as 'cdr'; install the package mcap-ros2-support to read it"):
        _read(path)


def test_ours_is_told_from_others_by_its_topic_and_a_selection_reads_ours_as_any_other(tmp_path: Path) -> None:
    ours = Path(__file__).parents[2] / "replay_data" / "static.mcap"
    other = _write(tmp_path / "v.mcap", "json", [b'{"v": 1}'] * 3)

    with open_readings(ours) as recording:
        assert isinstance(recording, Recording)
        expected = np.concatenate([batch.readings for batch in recording.batches()])
    with open_readings(other) as recording:
        assert isinstance(recording, ForeignRecording)
    with open_readings(ours, Selection("/dmm/raw", "value")) as recording:
        assert isinstance(recording, ForeignRecording)
        found = np.concatenate([batch.readings for batch in recording.batches()])
    assert found["value_V"].tobytes() == expected["value_V"].tobytes()
    assert found["t_ns"].tobytes() == expected["t_ns"].tobytes()
