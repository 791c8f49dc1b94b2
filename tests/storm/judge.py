"""Whether what was recorded is what happened: every claim of a storm, each with its own count of breaches.

The input rises without end and the meter adds nothing, so a value names the reading that it is.
"""

import re
from dataclasses import dataclass, fields

import numpy as np

from aemd.block import NOT_A_VALUE, Status
from tests.storm.weather import UTC_OFFSET_NS, Passed

WITHIN_NS = 2_000_000
SETTLE_NS = 2_000_000_000
"""After a start and after an outage the offset of the meter's clock is found in a second of frequent looks."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Breaches by claim, all 0 if it holds, and the worst error of a stamp."""

    invented: int
    """Values that the meter never made."""
    repeated: int
    """Values out of order, or that came twice."""
    misnumbered: int
    """Readings whose number does not count those that the meter made before, within one run and outside an overflow."""
    unaccounted: int
    """Readings made, not recorded, and in no gap record by their instant."""
    gaps_wrong: int
    """Index jumps without their gap record, gap records over recorded readings, counts that disagree."""
    late: int
    """Stamps more than 2 ms from the truth, outside outages."""
    worst_ns: int
    """Largest error of a stamp outside outages."""
    worst_inside_ns: int
    """Largest error of a stamp of a reading made during an outage, or in the 2 s after it or after a start."""

    @property
    def breaches(self) -> int:
        """Of all claims."""
        return sum(getattr(self, item.name) for item in fields(self) if not item.name.startswith("worst"))


def judge(passed: Passed) -> Verdict:
    """Hold the recorded readings and events against the meter's truth."""
    readings, truth, gaps = passed.readings, passed.truth, passed.gaps
    valid = (readings["status"] & NOT_A_VALUE) == 0
    order = np.argsort(truth["value_V"], kind="stable")
    ordered = truth["value_V"][order]
    at = np.clip(np.searchsorted(ordered, readings["value_V"]), 0, truth.size - 1)
    known = ordered[at] == readings["value_V"]
    invented = int(np.count_nonzero(valid & ~known))
    row = np.where(valid & known, order[at], -1)
    middle_ns = truth["middle_ns"]
    row = _fill(row, readings["t_ns"] - UTC_OFFSET_NS, middle_ns)
    invented += int(np.count_nonzero(~valid & ~_is_alike(readings["status"], truth["value_V"][row])))

    step, jump = np.diff(row), np.diff(readings["index"])
    repeated = int(np.count_nonzero(step <= 0))
    same_run = truth["run"][row[1:]] == truth["run"][row[:-1]]
    tolerance = np.zeros(jump.size, dtype=np.int64)
    for gap in gaps:
        within = re.search(r"give or take (\d+)", gap.message)
        where = np.searchsorted(readings["index"], gap.first_index) - 1
        if within and 0 <= where < tolerance.size:
            tolerance[where] += int(within[1])
    misnumbered = int(np.count_nonzero(same_run & (np.abs(step - jump) > tolerance)))

    recorded = np.zeros(truth.size, dtype=bool)
    recorded[row] = True
    missing = np.flatnonzero(~recorded & (middle_ns < passed.ended_ns))
    # What was made before the first look of a run that was begun anew at once is in the gap before it.
    inside = np.zeros(missing.size, dtype=bool)
    for begin_ns, end_ns in _spans(passed):
        inside |= (middle_ns[missing] >= begin_ns) & (middle_ns[missing] <= end_ns)
    unaccounted = int(np.count_nonzero(~inside))

    error_ns = np.abs(readings["t_ns"] - UTC_OFFSET_NS - middle_ns[row])
    outside = ~_in_outage(passed, middle_ns[row], row)
    return Verdict(
        invented=invented,
        repeated=repeated,
        misnumbered=misnumbered,
        unaccounted=unaccounted,
        gaps_wrong=_wrong_gaps(passed),
        late=int(np.count_nonzero(error_ns[outside] > WITHIN_NS)),
        worst_ns=int(error_ns[outside].max(initial=0)),
        worst_inside_ns=int(error_ns[~outside].max(initial=0)),
    )


def _fill(row: np.ndarray, t_ns: np.ndarray, middle_ns: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    """Give a reading without a value the row nearest in time: half an interval is far more than a stamp errs."""
    after = np.clip(np.searchsorted(middle_ns, t_ns), 1, middle_ns.size - 1)
    nearest = np.where(t_ns - middle_ns[after - 1] < middle_ns[after] - t_ns, after - 1, after)
    return np.where(row >= 0, row, nearest)


def _is_alike(status: np.ndarray, value_V: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    high, low, invalid = (status & bit != 0 for bit in (Status.OVERLOAD_HIGH, Status.OVERLOAD_LOW, Status.INVALID))
    return np.where(high, value_V == 9.9e37, np.where(low, value_V == -9.9e37, invalid & (value_V == 9.91e37)))


def _spans(passed: Passed) -> list[tuple[int, int]]:
    """Return each gap's begin and end, host ns: from its record's instant to the next reading's."""
    readings = passed.readings
    slack_ns = round(passed.stream.fit.interval_ns)
    spans = []
    for gap in passed.gaps:
        after = int(np.searchsorted(readings["index"], gap.last_index, side="right"))
        end_ns = int(readings["t_ns"][after]) if after < readings.size else passed.ended_ns + UTC_OFFSET_NS
        spans.append((gap.t_ns - UTC_OFFSET_NS - slack_ns, end_ns - UTC_OFFSET_NS + slack_ns))
    return spans


def _wrong_gaps(passed: Passed) -> int:
    index, wrong, after = passed.readings["index"], 0, -1
    for gap in passed.gaps:
        wrong += gap.first_index <= after or gap.last_index < gap.first_index
        after = gap.last_index
        first, last = np.searchsorted(index, (gap.first_index, gap.last_index + 1))
        wrong += first != last
    counted = sum(gap.last_index - gap.first_index + 1 for gap in passed.gaps)
    total = max(int(index[-1]) if index.size else -1, passed.gaps[-1].last_index if passed.gaps else -1) + 1
    wrong += counted != total - index.size
    wrong += counted != passed.stream.ledger.lost
    wrong += counted != passed.tally.counts.lost
    return int(wrong)


def _in_outage(passed: Passed, middle_ns: np.ndarray, row: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    """Tell which readings were made while the link was lost, or within 2 s of its return or of a start."""
    within = np.zeros(middle_ns.size, dtype=bool)
    lost_ns = None
    for event in passed.events:
        if event.kind != "link":
            continue
        if not event.message.startswith("back"):
            lost_ns = lost_ns or event.t_ns
        elif lost_ns is not None:
            begin_ns, end_ns, lost_ns = lost_ns - UTC_OFFSET_NS, event.t_ns - UTC_OFFSET_NS + SETTLE_NS, None
            within |= (middle_ns >= begin_ns - SETTLE_NS) & (middle_ns <= end_ns)
    run = passed.truth["run"][row]
    for number in np.unique(run):
        first_ns = middle_ns[run == number].min()
        within |= (middle_ns >= first_ns) & (middle_ns <= first_ns + SETTLE_NS)
    return within
