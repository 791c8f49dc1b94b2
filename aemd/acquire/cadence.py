"""When to look at the instrument next: how often, at which phase, and more closely while its clock is ill known.

Looks that are frequent are spread evenly over the phases of the interval, so that sooner or later one comes right
before the finish of a reading and one right after. Looks that are rarer than readings are aimed at a finish instead:
each comes too soon or too late, and which of the two halves what is unknown of the offset.

So looks are frequent until the clock is known, and for every second reading from then on: a look that finds nothing
costs as much as one that finds something, and two readings at once cost little more than one.
"""

from math import ceil, inf

from aemd.acquire.clock import DeviceClock
from aemd.acquire.ledger import Ledger

__all__ = ["Cadence", "choose_calm_s", "choose_poll_s"]

GOLDEN = 0.618033988749895  # no other fraction of the interval spreads the looks' phases more evenly over it
SHORTEST_POLL_S = 0.010  # a look costs about 0.5 ms of a core
LONGEST_POLL_S = 0.25  # so soon a stop is heard and a failure is seen
EAGER_POLL_S = 0.002
EAGER_LOOKS = 500  # 1 s of them, after a start or a new epoch, until the offset is known
EAGER_BEFORE = 2  # readings before the end of an epoch; an aimed look comes up to one later than it is due
WELL_KNOWN_NS = 1_000_000
CALM_READINGS = 2  # for each look; with more of them the live page would not move evenly
LONGEST_CALM_S = 0.15  # readings of this age are in no file yet, beside those of the flush interval
AIMABLE = 1 / 16  # of the interval: what is known so well is halved by each look, and a slow link tells no better


def choose_poll_s(interval_s: float) -> float:
    """Return the time between two looks: a golden section of the interval, or a whole fraction of it if that is long.

    >>> [round(choose_poll_s(interval_s), 4) for interval_s in (1e-4, 0.1, 1.0)]
    [0.01, 0.0618, 0.206]
    """
    section_s = GOLDEN * interval_s
    return max(section_s / ceil(section_s / LONGEST_POLL_S), SHORTEST_POLL_S)


def choose_calm_s(interval_s: float) -> float:
    """Return the time between two looks once the instrument's clock is known.

    >>> [round(choose_calm_s(interval_s), 4) for interval_s in (1e-4, 0.02, 0.067, 0.1, 1.0)]
    [0.01, 0.04, 0.134, 0.0618, 0.206]
    """
    calm_s = CALM_READINGS * interval_s
    return max(calm_s if calm_s <= LONGEST_CALM_S else 0.0, choose_poll_s(interval_s))


class Cadence:
    """The times of one stream's looks.

    Args:
        fit: what is known of the instrument's clock.
        interval_s: nominal time between readings, s.
        epoch_readings: readings after which the instrument starts its timer anew; 0 for never.
        poll_s: time between two looks; None for a choice from the interval.
    """

    def __init__(self, fit: DeviceClock, interval_s: float, epoch_readings: int, poll_s: float | None) -> None:
        self.poll_s = choose_poll_s(interval_s) if poll_s is None else poll_s
        """Time between two looks where nothing is special, s."""
        self._calm_poll_s = choose_calm_s(interval_s) if poll_s is None else poll_s
        self._calm_within_ns = WELL_KNOWN_NS if poll_s else max(WELL_KNOWN_NS, AIMABLE * interval_s * 1e9)
        self._fit = fit
        self._interval_s = interval_s
        self._epoch_readings = epoch_readings
        self._is_rare = self.poll_s > interval_s
        self._lag_ns = 0
        self._epoch = (0, 0)
        self._eager_looks = EAGER_LOOKS

    def begin(self) -> None:
        """Sampling began, or began anew."""
        self._eager_looks = EAGER_LOOKS

    def note_lag(self, lag_ns: int) -> None:
        """Take the time from the begin of a look to the middle of the question that counts."""
        self._lag_ns = lag_ns

    def next_look_ns(self, now_ns: int, due_ns: int, ledger: Ledger) -> int:
        """Return the host instant of the next look.

        Args:
            now_ns: host monotonic time.
            due_ns: when the last look was due, so that the cadence holds; from now, if that would be over already.
            ledger: where the stream is.
        """
        since = ledger.next_index - ledger.run_index
        if self._is_eager(ledger.run_index, since):
            return max(now_ns, due_ns + round(min(self.poll_s, EAGER_POLL_S) * 1e9))
        poll_s = self._calm_s(since)
        next_ns = max(now_ns, due_ns + round(poll_s * 1e9))
        if not (self._is_rare or poll_s > self._interval_s):
            return next_ns
        # The nearest: what is known of the offset moves, and the next one may be due a little before this instant.
        half_ns = round(self._interval_s * 0.5e9)
        return max(now_ns, self._fit.next_finish(next_ns + self._lag_ns - half_ns) - self._lag_ns)

    def _calm_s(self, since: int) -> float:
        """Return the time until the next look; no look may jump over the last readings of a timing epoch.

        Looks that are asked for to be rare are, as long as the clock is well known.
        """
        poll_s = self._calm_poll_s
        if self._fit.uncertainty_ns > self._calm_within_ns:
            poll_s = min(poll_s, choose_poll_s(self._interval_s))
        if not self._epoch_readings:
            return poll_s
        left = self._epoch_readings - since % self._epoch_readings - EAGER_BEFORE
        return min(poll_s, max(EAGER_POLL_S, left * self._interval_s))

    def _is_eager(self, run_index: int, since: int) -> bool:
        """Tell whether to look often for a while: a timing epoch is about to begin or has begun and is ill known."""
        epoch = run_index, since // self._epoch_readings if self._epoch_readings else 0
        if epoch != self._epoch:
            self._epoch, self._eager_looks = epoch, EAGER_LOOKS
        near_its_end = (
            bool(self._epoch_readings) and self._epoch_readings - since % self._epoch_readings <= EAGER_BEFORE
        )
        if self._is_rare and self._fit.uncertainty_ns < inf and not near_its_end:
            return False  # they are aimed
        if self._eager_looks and (near_its_end or self._fit.uncertainty_ns > WELL_KNOWN_NS):
            self._eager_looks -= 1
            return True
        return False
