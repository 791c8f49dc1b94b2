"""What viewers get: everything once, in order, whatever their pace; and what the state says of the acquisition."""

import json
import time
from typing import Any

import numpy as np
import pytest

from aemd.block import ESTIMATE, Batch, Event, Status, make_block
from aemd.live.feed import Place
from aemd.live.health import Health
from aemd.live.history import make_histogram
from aemd.live.inbox import Inbox
from aemd.live.metrics import METRICS, as_metrics
from aemd.live.pyramid import bin_ns
from tests.live.conftest import INTERVAL_NS, T0_NS, Bench

SPAN_NS = 60 * 10**9


def put_together(frames: list[dict[str, Any]]) -> dict[int, tuple[float, float]]:
    """What a page has after these frames: the newest word on every bin."""
    cells: dict[int, tuple[float, float]] = {}
    for frame in frames:
        columns = frame["readings"]
        cells |= dict(zip(columns["n"], zip(columns["lo"], columns["hi"], strict=True), strict=True))
    return cells


@pytest.mark.parametrize("pace", [1, 3, 40])
def test_a_viewer_of_any_pace_ends_up_with_every_extreme(pace: int, bench: Bench) -> None:
    values = np.random.default_rng(1).normal(size=200).tolist()
    place, frames = Place(), []
    for at, start in enumerate(range(0, 200, 2)):
        bench.read(values[start : start + 2])
        if at % pace == 0 or start == 198:
            body, place = bench.feed.frame(SPAN_NS, 200, place)
            frames.append(json.loads(body))

    width = round(frames[0]["bin_ms"] * 1e6)
    number = (T0_NS + np.arange(200) * INTERVAL_NS) // width
    expected = {
        n: (min(np.array(values)[number == n]), max(np.array(values)[number == n])) for n in np.unique(number).tolist()
    }
    assert put_together(frames) == expected
    assert [frame["fresh"] for frame in frames] == [True] + [False] * (len(frames) - 1)


def test_a_viewer_that_was_away_gets_no_more_than_its_span(bench: Bench) -> None:
    bench.read([0.0])
    _, place = bench.feed.frame(SPAN_NS, 200, Place())
    for _ in range(100):
        bench.read([1.0] * 100)

    columns = json.loads(bench.feed.frame(SPAN_NS, 200, place)[0])["readings"]

    assert len(columns["n"]) <= 201


def test_a_new_viewer_is_told_to_begin_anew_and_one_that_was_away_is_not(bench: Bench) -> None:
    bench.read([0.0])
    _, away = bench.feed.frame(SPAN_NS, 200, Place())
    for _ in range(20):
        bench.read([1.0] * 100)

    assert not json.loads(bench.feed.frame(SPAN_NS, 200, away)[0])["fresh"]
    assert json.loads(bench.feed.frame(SPAN_NS, 200, Place(second=away.second))[0])["fresh"]


def test_viewers_with_the_same_view_share_one_frame(bench: Bench) -> None:
    bench.read([1.0, 2.0])

    assert bench.feed.frame(SPAN_NS, 800, Place())[0] is bench.feed.frame(SPAN_NS, 800, Place())[0]


def test_a_frame_at_ten_thousand_readings_a_second_is_as_long_as_the_screen_and_not_as_the_stream(
    bench: Bench,
) -> None:
    value = np.random.default_rng(2).normal(size=100_000)
    block = make_block(value, t0_ns=T0_NS, interval_ns=1e5)
    bench.inbox.write(Batch(block), np.empty(0, ESTIMATE))
    bench.feed.tick()

    columns = json.loads(bench.feed.frame(10 * 10**9, 800, Place())[0])["readings"]

    assert len(columns["n"]) <= 801
    assert max(columns["hi"]) == value.max()
    assert min(columns["lo"]) == value.min()


def test_the_past_can_be_asked_for_more_finely_than_it_was_shown(bench: Bench) -> None:
    bench.read(list(np.arange(2000.0)))

    found = json.loads(bench.feed.window(T0_NS + 100 * INTERVAL_NS, T0_NS + 110 * INTERVAL_NS, 400))

    inside = [value for value in found["readings"]["hi"] if 100 <= value <= 110]
    assert inside == list(np.arange(100.0, 111.0))


def test_the_status_has_the_newest_reading_to_the_bit_and_the_state_of_the_file(bench: Bench) -> None:
    bench.read([1 / 3, 2 / 3])

    status = json.loads(json.dumps(bench.feed.status()))

    assert status["last"]["value_V"] == 2 / 3
    assert status["last"]["time_s"] == pytest.approx((T0_NS + INTERVAL_NS) * 1e-9, abs=1e-6)
    assert status["estimate"]["value_V"] == 1 / 3
    assert (status["readings"], status["lost"], status["file_bytes"]) == (2, 0, 123)
    assert status["health"] == "ok"


def test_a_reading_without_a_value_is_null_and_counted_as_an_overload(bench: Bench) -> None:
    block = make_block([np.nan], t0_ns=T0_NS, status=int(Status.OVERLOAD_HIGH))
    bench.inbox.write(Batch(block), np.empty(0, ESTIMATE))
    bench.feed.tick()

    frame = json.loads(bench.feed.frame(SPAN_NS, 200, Place())[0])

    assert frame["readings"]["lo"] == [None]
    assert frame["readings"]["bad"] == [1.0]
    assert frame["now"]["value_V"] is None
    assert bench.feed.status()["overloads"] == 1


def test_what_happens_to_the_stream_is_told_and_the_clocks_ordinary_life_is_not(bench: Bench) -> None:
    events = (Event(T0_NS, "gap", "3 readings lost", 4, 6), Event(T0_NS, "clock", "fitted"))
    bench.inbox.write(Batch(make_block([]), events), np.empty(0, ESTIMATE))
    bench.feed.tick()

    assert [event["message"] for event in bench.feed.status()["events"]] == ["3 readings lost"]


def test_silence_of_the_meter_is_a_complaint_and_passes_when_it_speaks_again(bench: Bench) -> None:
    bench.read([1.0])
    assert bench.feed.complaint() == ""

    bench.now_ns += 6 * 10**9
    bench.feed.tick()
    silent = bench.feed.complaint()
    bench.read([1.0])

    assert silent.startswith("acquisition: no reading for 6 s")
    assert bench.feed.complaint() == ""


def test_a_lost_link_is_named_as_the_cause_of_silence_until_it_is_back(bench: Bench) -> None:
    complaints = []
    for message in ("lost: TCPIP0::x::SOCKET: no whole answer within 1 s", "back after 6.000 s: opened again"):
        bench.inbox.write(Batch(make_block([]), (Event(T0_NS, "link", message),)), np.empty(0, ESTIMATE))
        bench.now_ns += 6 * 10**9
        bench.feed.tick()
        complaints.append(bench.feed.complaint())

    assert "; the link is lost" in complaints[0]
    assert complaints[1] == "acquisition: no reading for 12 s"


def test_a_writer_that_stands_still_is_a_complaint_while_readings_come(bench: Bench) -> None:
    for second in range(8):
        bench.unwritten = second * 15
        bench.read([1.0] * 15)
    wedged = bench.feed.complaint()
    bench.unwritten = 0
    bench.read([1.0])

    assert wedged.startswith("writing: 105 readings wait, none written for")
    assert bench.feed.complaint() == ""


def test_readings_that_come_and_are_in_no_file_are_a_complaint_until_recording_goes_on(bench: Bench) -> None:
    bench.read([1.0])
    bench.not_written, bench.trouble = 12, "no space left on device"
    full = bench.feed.status()
    bench.trouble = ""
    after = bench.feed.status()

    assert full["health"] == "recording: stopped, 12 readings not written: no space left on device"
    assert "\naemd_not_written_readings_total 12.0\n" in as_metrics(full)
    assert "\naemd_healthy 0.0\n" in as_metrics(full)
    assert (after["health"], after["not_written"]) == ("ok", 12)


def test_a_live_view_that_stopped_ticking_does_not_call_itself_well(bench: Bench) -> None:
    bench.read([1.0])
    bench.now_ns += 20 * 10**9

    assert bench.feed.complaint().startswith("live view: no tick for 20 s")


def test_the_rate_is_that_of_the_last_ten_seconds(bench: Bench) -> None:
    for _ in range(300):
        bench.read([1.0])

    assert bench.feed.status()["rate_hz"] == pytest.approx(1e9 / INTERVAL_NS, rel=1e-3)


def test_an_inbox_that_nobody_empties_is_bounded_and_counts_what_it_leaves_out() -> None:
    inbox = Inbox(most_rows=1000)
    for _ in range(100):
        inbox.write(Batch(make_block(np.zeros(100))), np.zeros(100, ESTIMATE))

    kept = sum(len(batch.readings) for batch, _ in inbox.take())
    assert kept <= 500
    assert inbox.skipped == 100 * 100 - kept
    inbox.write(Batch(make_block(np.zeros(100))), np.zeros(100, ESTIMATE))
    assert len(inbox.take()) == 1


def test_a_batch_costs_the_pipeline_the_same_whatever_its_length() -> None:
    inbox = Inbox(most_rows=1 << 40)

    def cost(size: int) -> float:
        batch, estimates = Batch(make_block(np.zeros(size))), np.zeros(size, ESTIMATE)
        began = time.process_time()
        for _ in range(20_000):
            inbox.write(batch, estimates)
        return time.process_time() - began

    cost(1)
    assert min(cost(100_000) for _ in range(3)) < 3 * min(cost(1) for _ in range(3))


def test_prometheus_gets_a_help_and_a_type_line_for_each_metric_and_base_units(bench: Bench) -> None:
    bench.read([0.25])

    lines = as_metrics(bench.feed.status()).splitlines()

    samples = {line.split("{")[0].split(" ")[0]: line for line in lines if not line.startswith("#")}
    assert len(samples) == len(METRICS) + 2
    for name, line in samples.items():
        assert any(other.startswith(f"# HELP {name} ") for other in lines)
        kind = next(other.split()[-1] for other in lines if other.startswith(f"# TYPE {name} "))
        assert kind == ("counter" if name.endswith("_total") else "gauge")
        float(line.rpartition(" ")[2])
    assert samples["aemd_readings_total"] == "aemd_readings_total 1.0"
    assert samples["aemd_last_reading_volts"] == "aemd_last_reading_volts 0.25"
    assert 'instrument="34410A MY1"' in samples["aemd_info"]


def test_a_histogram_keeps_its_shape_beside_a_shock_and_loses_no_reading() -> None:
    values = np.random.default_rng(3).normal(1.0, 1e-3, 4000)
    values[17] = 1e6

    found = make_histogram(values)

    assert sum(found["counts"]) == 4000
    assert found["spread_V"] == pytest.approx(1e-3, rel=0.05)
    edges = found["from_V"] + found["step_V"] * np.arange(42)
    inner = np.histogram(values, edges)[0][1:-1]
    assert found["counts"][1:-1] == inner.tolist()


def test_bins_of_the_finest_level_are_a_millisecond() -> None:
    assert bin_ns(0) == pytest.approx(1e6, rel=0.05)


def test_the_rate_is_that_of_the_readings_own_instants_since_they_come_and_falls_while_none_does() -> None:
    """However long the instrument took to begin, and however they are bunched when they come."""
    health = Health(0.07, now_ns=0)
    for tick in range(100):
        came = max(0, 2 * ((tick - 20) // 3))
        health.see(came, waiting=0, now_ns=tick * 10**8, newest_ns=round(came * 0.07e9))
    rate_hz = health.rate_hz
    for tick in range(100, 150):
        health.see(came, waiting=0, now_ns=tick * 10**8, newest_ns=round(came * 0.07e9))

    assert rate_hz == pytest.approx(1 / 0.07)
    assert 0 < health.rate_hz < 0.6 / 0.07


def test_the_rate_of_a_reading_a_minute_is_that_at_every_look() -> None:
    health = Health(60.0, now_ns=0)
    rates = []
    for second in range(600):
        came = second // 60
        health.see(came, waiting=0, now_ns=second * 10**9, newest_ns=came * 60 * 10**9)
        rates.append(health.rate_hz)

    assert rates[200:] == pytest.approx([1 / 60] * 400)
