"""The state as Prometheus text (exposition format 0.0.4): base units, a HELP and a TYPE line for each metric."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

__all__ = ["CONTENT_TYPE", "as_metrics"]

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"


class _Metric(NamedTuple):
    name: str
    kind: str
    help: str
    path: tuple[str, ...]
    """Where it stands in the status."""


METRICS = (
    _Metric("aemd_readings_total", "counter", "Readings that came through the estimator.", ("readings",)),
    _Metric("aemd_lost_readings_total", "counter", "Readings of the meter that never came.", ("lost",)),
    _Metric("aemd_not_written_readings_total", "counter", "Readings that came and are in no file.", ("not_written",)),
    _Metric("aemd_gaps_total", "counter", "Places where readings are missing.", ("gaps",)),
    _Metric("aemd_overloads_total", "counter", "Readings beyond the meter's range.", ("overloads",)),
    _Metric(
        "aemd_readings_per_second",
        "gauge",
        "Readings per second of the last seconds, by their own instants.",
        ("rate_hz",),
    ),
    _Metric("aemd_interval_seconds", "gauge", "Time between readings, as the meter has it.", ("interval_s",)),
    _Metric("aemd_unwritten_readings", "gauge", "Readings that wait to be written.", ("unwritten",)),
    _Metric("aemd_recording_bytes", "gauge", "Length of the recording's present file.", ("file_bytes",)),
    _Metric("aemd_disk_free_bytes", "gauge", "Room left on the recording's disk.", ("disk_free_bytes",)),
    _Metric("aemd_start_time_seconds", "gauge", "When the acquisition began, since 1970 (UTC).", ("started_s",)),
    _Metric("aemd_last_reading_volts", "gauge", "The last reading; NaN where it has no value.", ("last", "value_V")),
    _Metric("aemd_last_reading_time_seconds", "gauge", "Instant of the last reading.", ("last", "time_s")),
    _Metric("aemd_estimate_volts", "gauge", "The newest estimate of the true input.", ("estimate", "value_V")),
    _Metric("aemd_estimate_sigma_volts", "gauge", "Standard deviation of that estimate.", ("estimate", "sigma_V")),
    _Metric("aemd_disturbance_volts", "gauge", "The newest estimate of the disturbance.", ("estimate", "u_V")),
    _Metric("aemd_window_readings", "gauge", "Readings in the estimator's window.", ("estimate", "window")),
    _Metric("aemd_live_viewers", "gauge", "Live views that are open.", ("viewers",)),
    _Metric("aemd_live_skipped_readings_total", "counter", "Readings that live views left out.", ("skipped_by_view",)),
)


def as_metrics(status: Mapping[str, Any]) -> str:
    """Return a feed's status as Prometheus reads it."""
    lines = []
    for metric in METRICS:
        value: Any = status
        for key in metric.path:
            value = value[key]
        lines += _lines(metric.name, metric.kind, metric.help, "", value)
    lines += _lines("aemd_healthy", "gauge", "1 while readings come and are written.", "", status["health"] == "ok")
    labels = {name: status[name] for name in ("instrument", "estimator", "unit")} | {"version": status["aemd"]}
    written = ",".join(f'{name}="{_escape(str(value))}"' for name, value in labels.items())
    lines += _lines("aemd_info", "gauge", "What is acquired, as labels.", f"{{{written}}}", 1)
    return "\n".join(lines) + "\n"


def _lines(name: str, kind: str, text: str, labels: str, value: float) -> list[str]:
    number = repr(float(value)) if math.isfinite(value) else "NaN"
    return [f"# HELP {name} {text}", f"# TYPE {name} {kind}", f"{name}{labels} {number}"]


def _escape(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
