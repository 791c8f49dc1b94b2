"""The topics over Foxglove's WebSocket protocol, heard by a client that we did not write."""

import json
import struct
import sys
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from aemd.block import ESTIMATE, Batch, Event, make_block
from aemd.errors import UsageError
from aemd.live.access import Address
from aemd.live.foxglove import Foxglove, encode_rows
from aemd.record.schema import FILTERED, RAW, SCHEMA_DATA, SCHEMAS

LISTEN = Address(port=0)
T0_NS = 1_795_345_851_596_318_191


def decode(name: str, payload: bytes) -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(SCHEMA_DATA).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name)).FromString(payload)


def test_a_payload_is_the_recordings_message() -> None:
    estimates = np.zeros(2, ESTIMATE)
    estimates["value_V"], estimates["window"] = [0.25, 1 / 3], [15, 5]

    raw = [decode(SCHEMAS[RAW], payload) for payload in encode_rows(RAW, make_block([1 / 3, np.nan], status=[0, 1]))]
    filtered = [decode(SCHEMAS[FILTERED], payload) for payload in encode_rows(FILTERED, estimates)]

    assert raw[0].value == 1 / 3
    assert np.isnan(raw[1].value)
    assert [message.status for message in raw] == [0, 1]
    assert [(message.value, message.window) for message in filtered] == [(0.25, 15), (1 / 3, 5)]


def test_a_viewer_hears_the_topics() -> None:
    pytest.importorskip("foxglove", reason="no foxglove-sdk: the extra is not installed")
    websocket = pytest.importorskip("websocket", reason="no websocket-client, which comes with selenium")
    view = Foxglove(LISTEN)
    client = websocket.create_connection(view.url, subprotocols=["foxglove.sdk.v1"], timeout=10)
    try:
        channels: dict[str, Any] = {}
        while len(channels) < len(SCHEMAS):
            said = json.loads(client.recv())
            if said["op"] == "advertise":
                channels |= {channel["topic"]: channel for channel in said["channels"]}
        assert channels.keys() == SCHEMAS.keys()
        wanted = [{"id": number, "channelId": channels[topic]["id"]} for number, topic in enumerate(SCHEMAS)]
        client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        heard: dict[str, tuple[int, Any]] = {}
        events = (Event(T0_NS, "gap", "3 readings lost", 4, 6),)
        for _ in range(200):
            view.inbox.write(Batch(make_block([0.125], t0_ns=T0_NS), events), np.zeros(1, ESTIMATE))
            view.pass_on()
            client.settimeout(0.05)
            try:
                while len(heard) < len(SCHEMAS):
                    code, body = client.recv_data()
                    if code == websocket.ABNF.OPCODE_BINARY and body[0] == 1:
                        _, number, t_ns = struct.unpack_from("<BIQ", body)
                        topic = list(SCHEMAS)[number]
                        heard[topic] = (t_ns, decode(SCHEMAS[topic], body[13:]))
            except websocket.WebSocketTimeoutException:
                continue
            break
    finally:
        client.close()
        view.close()

    assert heard.keys() == SCHEMAS.keys()
    assert heard[RAW][0] == T0_NS
    assert heard[RAW][1].value == 0.125
    assert heard["/dmm/event"][1].message == "3 readings lost"


def test_without_the_package_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)

    with pytest.raises(UsageError, match=r"pip install aemd\[foxglove\]"):
        Foxglove(LISTEN)


def test_it_is_not_for_other_machines_and_says_what_is() -> None:
    with pytest.raises(UsageError, match="ssh -L 8765:localhost:8765"):
        Foxglove(Address("0.0.0.0", 8765))


def test_a_taken_port_is_one_line_with_a_way_out() -> None:
    pytest.importorskip("foxglove", reason="no foxglove-sdk: the extra is not installed")
    view = Foxglove(LISTEN)
    try:
        with pytest.raises(UsageError, match=r"address already in use.*name another port"):
            Foxglove(Address(port=int(view.url.rpartition(":")[2])))
    finally:
        view.close()
