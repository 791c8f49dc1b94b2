"""When to look at the instrument next: how often, at which phase, and more closely while its clock is ill known.

Looks that are frequent are spread evenly over the phases of the interval, so that sooner or later one comes right
before the finish of a reading and one right after. Looks that are rarer than readings are aimed at a finish instead:
each comes too soon or too late, and which of the two halves what is unknown of the offset.
"""

from math import ceil, inf

from aemd.acquire.clock import DeviceClock
from aemd.acquire.ledger import Ledger

__all__ = ["Cadence", "choose_poll_s"]

GOLDEN = 0.618033988749895  # no other fraction of the interval spreads the looks' phases more evenly over it
SHORTEST_POLL_S = 0.010  # a look costs about 0.5 ms of a core
LONGEST_POLL_S = 0.25  # so soon a stop is heard and a failure is seen
EAGER_POLL_S = 0.002
EAGER_LOOKS = 500  # 1 s of them, after a start or a new epoch, until the offset is known
EAGER_BEFORE = 2  # readings before the end of an epoch; an aimed look comes up to one later than it is due
WELL_KNOWN_NS = 1_000_000


def choose_poll_s(interval_s: float) -> float:
    """Return the time between two looks: a golden section of the interval, or a whole fraction of it if that is long.

    >>> [round(choose_poll_s(interval_s), 4) for interval_s in (1e-4, 0.1, 1.0)]
    [0.01, 0.0618, 0.206]
    """
    section_s = GOLDEN * interval_s
    return max(section_s / ceil(section_s / LONGEST_POLL_S), SHORTEST_POLL_S)


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
        next_ns = max(now_ns, due_ns + round(self._calm_s(since) * 1e9))
        return self._fit.next_finish(next_ns + self._lag_ns) - self._lag_ns if self._is_rare else next_ns

    def _calm_s(self, since: int) -> float:
        """Return the time until the next look; no look may jump over the last readings of a timing epoch.

        Looks that are asked for to be rare are, as long as the clock is well known.
        """
        poll_s = self.poll_s
        if self._fit.uncertainty_ns > WELL_KNOWN_NS:
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
