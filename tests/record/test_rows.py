"""Messages of several channels in one run of bytes: in the order of their instants, each whole."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aemd.record.rows import Track, merge
from aemd.record.schema import RAW, SCHEMA_DATA, SCHEMAS, WITNESS, make_layout


def _track(channel: int, schema: str, t_ns: list[int], first: float) -> Track:
    layout = make_layout(SCHEMA_DATA, schema, ["value"])
    assert layout is not None
    rows = layout.make_rows(len(t_ns), channel)
    rows["publish_time"], rows["sequence"], rows["value"] = t_ns, range(len(t_ns)), first + np.arange(len(t_ns))
    return Track(channel, np.array(t_ns, np.int64), rows)


def _records(octets: bytes) -> list[tuple[int, int, int, bytes]]:
    """Return channel, log time, publish time and payload of each Message record, from the MCAP specification alone."""
    found, at = [], 0
    while at < len(octets):
        end = at + 9 + int.from_bytes(octets[at + 1 : at + 9], "little")
        numbers = [int.from_bytes(octets[at + a : at + b], "little") for a, b in ((9, 11), (15, 23), (23, 31))]
        found.append((*numbers, octets[at + 31 : end]))
        at = end
    return found


@pytest.mark.parametrize("jitter", [False, True], ids=["in turns", "any instants"])
@given(times=st.lists(st.integers(1, 60), min_size=1, max_size=30), not_before=st.integers(0, 30))
def test_messages_stand_in_the_order_of_their_instants_and_a_track_comes_first_where_they_are_alike(
    jitter: bool, times: list[int], not_before: int
) -> None:
    rising = sorted(set(times))
    tracks = [_track(1, SCHEMAS[RAW], rising, 0.5), _track(2, WITNESS, times if jitter else rising, 1000.5)]

    rows = merge(tracks, not_before)

    found = _records(rows.octets.tobytes())
    wanted, log_ns = [], not_before
    everything = []
    for number, track in enumerate(tracks):
        latest = 0
        for place, t_ns in enumerate(track.t_ns.tolist()):
            latest = max(latest, t_ns)  # within a track the order stays
            everything.append((latest, number, place, t_ns))
    for instant, number, place, t_ns in sorted(everything):
        log_ns = max(log_ns, instant)
        payload = bytes(tracks[number].messages[place].tobytes()[31:])  # type: ignore[union-attr]
        wanted.append((number + 1, log_ns, t_ns, payload))
    assert found == wanted
    assert rows.log_time.tolist() == [log for _, log, _, _ in wanted]
    assert rows.channel.tolist() == [channel for channel, _, _, _ in wanted]
    assert rows.start.tolist() == np.cumsum([0, *(31 + len(row[3]) for row in wanted[:-1])]).tolist()
