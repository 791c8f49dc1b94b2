"""When a reading was taken: the instrument's own clock, held to the host's.

The instrument paces itself and stamps nothing. But each look into its memory tells exactly how many readings were
finished at one instant between the question and the answer, and that bounds the clock from both sides:

    finish(count - 1) <= answered        finish(count) > asked

where finish(i) = offset + i * interval * (1 + rate) within one timing epoch. The questions come at ever other phases
of the interval, so the bounds close in on the offset from both sides: the lower envelope of the answers, the upper
envelope of the questions. Between two looks the bounds drift apart by the uncertainty of the rate, which two pairs of
bounds far apart narrow in turn. So the stamp (the middle) and its uncertainty (half the distance) hold for any
latency; nothing is averaged, and the state is a handful of numbers however long it runs.

What could break the bounds is a rate beyond RATE_BOUND or one that changes faster than WANDER. Then they cross, which
is noticed: the fit begins anew with twice the bound, and `restarts` counts it.
"""

from dataclasses import dataclass
from math import ceil, floor, inf

import numpy as np
from numpy.typing import NDArray

__all__ = ["DeviceClock"]

RATE_BOUND = 200e-6  # two crystals, the instrument's and the host's, each within 100 ppm
WANDER_PER_S = 1e-8  # 1 ppm in 100 s: a crystal moves about 1 ppm/K, and a warming bench less than 1 K in 100 s
ANCHOR_NS = 180e9  # bounds 0.3 ms wide give the rate to 2 ppm over this span, and it wanders by 2 ppm meanwhile
CLOSEST = 0.25  # of an interval: two stamps are never nearer, however much a correction sets the clock back


@dataclass(slots=True)
class _Bounds:
    """Where the finish of one reading lies, in one timing epoch; ns after `origin_ns` + (index - first) * interval."""

    first_index: int
    """First reading of the epoch."""
    origin_ns: int
    index: int
    """The reading that the two bounds are of."""
    earliest_ns: float = -inf
    latest_ns: float = inf

    @property
    def middle_ns(self) -> float:
        return (self.earliest_ns + self.latest_ns) / 2

    @property
    def width_ns(self) -> float:
        return self.latest_ns - self.earliest_ns

    def copy(self) -> "_Bounds":
        return _Bounds(self.first_index, self.origin_ns, self.index, self.earliest_ns, self.latest_ns)


class DeviceClock:
    """The fit of one acquisition. Instants are ns of the host's monotonic clock; counts are of readings since start.

    Args:
        interval_s: nominal time between readings as the instrument says, s.
        sample_delay_s: from the middle of a reading's aperture to its finish, s.
        epoch_readings: readings after which the instrument starts its timer anew, at an unknown offset; 0 for never.
    """

    def __init__(self, interval_s: float, sample_delay_s: float = 0.0, epoch_readings: int = 0) -> None:
        self.interval_ns = interval_s * 1e9
        self.restarts = 0
        self._delay_ns = sample_delay_s * 1e9
        self._epoch_readings = epoch_readings
        self._rate_bound = RATE_BOUND
        self._slowest, self._fastest = -RATE_BOUND, RATE_BOUND
        self._run_index = 0
        self._before: _Bounds | None = None
        self._now: _Bounds | None = None
        self._anchor: _Bounds | None = None
        self._stamped: _Bounds | None = None  # as they were when all that was finished had been stamped
        self._last_t_ns: int | None = None
        self._stamped_within_ns = 0.0

    @property
    def rate(self) -> float:
        """Relative error of the interval: positive when the instrument's clock runs slow."""
        return (self._slowest + self._fastest) / 2

    @property
    def rate_uncertainty(self) -> float:
        """Largest error of `rate`."""
        return (self._fastest - self._slowest) / 2

    @property
    def uncertainty_ns(self) -> float:
        """Largest error of a stamp of the newest reading now, ns; infinite before the first of an epoch."""
        return inf if self._now is None else self._now.width_ns / 2

    @property
    def stamped_within_ns(self) -> float:
        """Largest error of the stamps that `stamp` gave last, ns."""
        return self._stamped_within_ns

    def observe(self, count: int, asked_ns: int, answered_ns: int) -> None:
        """Take one look: at some instant from asked to answered, exactly `count` readings were finished."""
        since = count - self._run_index
        first = count - (since % self._epoch_readings if self._epoch_readings else since)
        now = self._now
        if now is None or now.first_index != first:
            if now is not None:  # whatever the new epoch is like, the last reading of the old one was finished by then
                self._age(now, first - 1)
                now.latest_ns = min(now.latest_ns, self._since_ns(now, first - 1, answered_ns))
            self._before, now = now, _Bounds(first, origin_ns=asked_ns, index=count)
            self._now, self._anchor = now, None
        self._age(now, count)
        earliest_ns = self._since_ns(now, count, asked_ns)
        latest_ns = inf
        if count > first:
            latest_ns = self._since_ns(now, count - 1, answered_ns) + self._fastest * self.interval_ns
        now.earliest_ns = max(now.earliest_ns, earliest_ns)
        now.latest_ns = min(now.latest_ns, latest_ns)
        self._narrow_rate(now)
        if now.width_ns < 0 or self._fastest < self._slowest:
            self.restarts += 1
            self._rate_bound *= 2
            self._slowest, self._fastest = -self._rate_bound, self._rate_bound
            now.earliest_ns, now.latest_ns = earliest_ns, latest_ns
            self._anchor = self._stamped = None

    def restart(self, index: int, asked_ns: int, answered_ns: int) -> None:
        """Sampling began anew between the two instants, with `index` as its first reading's number.

        What is known of the rate is kept, as far as it cannot have wandered since: the crystals are the same.
        """
        if self._now is not None:
            away_ns = self._since_ns(self._now, self._now.index, asked_ns) - self._now.earliest_ns
            wander = WANDER_PER_S * max(0.0, away_ns) * 1e-9
            self._slowest = max(self._slowest - wander, -self._rate_bound)
            self._fastest = min(self._fastest + wander, self._rate_bound)
        self._run_index = index
        self._before, self._now = None, _Bounds(index, origin_ns=asked_ns, index=index)
        self._anchor = self._stamped = None
        self.observe(index, asked_ns, answered_ns)

    def forget_offset(self) -> None:
        """Begin with the next look as if nothing were known but the rate."""
        self._before = self._now = self._anchor = self._stamped = None

    def instant(self, index: int) -> int:
        """Return the middle of the aperture of one reading, past or to come, as far as is known now."""
        now = self._now
        if now is None:
            return 0
        before = self._before
        bounds = before if before is not None and index < now.first_index else now
        middle_ns = bounds.middle_ns if bounds.width_ns < inf else bounds.earliest_ns
        nominal_ns = bounds.origin_ns + (index - bounds.first_index) * self.interval_ns - self._delay_ns
        return round(nominal_ns + middle_ns + self.rate * (index - bounds.index) * self.interval_ns)

    def next_finish(self, after_ns: int) -> int:
        """Return when the first reading from then on is expected to be finished; `after_ns` where nothing is known."""
        now = self._now
        if now is None or now.width_ns == inf:
            return after_ns
        finish_ns = now.origin_ns + (now.index - now.first_index) * self.interval_ns + now.middle_ns
        interval_ns = self.interval_ns * (1 + self.rate)
        return round(finish_ns + ceil((after_ns - finish_ns) / interval_ns) * interval_ns)

    def stamp(self, first_index: int, count: int) -> NDArray[np.int64]:
        """Return the middles of the apertures of consecutive readings, shape (count,); strictly increasing over calls.

        The readings must be among those that `observe` was told of.
        """
        stamps_ns = np.empty(count, dtype=np.int64)
        if self._now is None or count == 0:
            return stamps_ns
        self._stamped_within_ns = 0.0
        older = 0 if self._before is None else min(max(self._now.first_index - first_index, 0), count)
        if self._before is not None and older:
            stamps_ns[:older] = self._stamp(self._before, first_index, older)
        if older < count:
            stamps_ns[older:] = self._stamp(self._now, first_index + older, count - older)
        if first_index + count >= self._now.index:
            self._stamped = self._now.copy()
        return stamps_ns

    def finished(self, asked_ns: int, answered_ns: int) -> tuple[int, int]:
        """Return the least and the largest count of readings that can have been finished by the instant of a look."""
        now = self._now
        if now is None:
            return 0, 0
        latest_ns = now.latest_ns if now.latest_ns < inf else now.earliest_ns + self.interval_ns
        since_asked_ns = self._since_ns(now, now.index, asked_ns)
        since_answered_ns = self._since_ns(now, now.index, answered_ns)
        # An epoch that was first seen in its middle has bounds far from 0: what has passed since is the difference.
        drift_ns = _drift_ns(since_answered_ns - now.earliest_ns)
        latest_ns += self._fastest * (since_asked_ns - latest_ns) + drift_ns
        earliest_ns = now.earliest_ns + self._slowest * (since_answered_ns - now.earliest_ns) - drift_ns
        least = now.index + 1 + floor((since_asked_ns - latest_ns) / self.interval_ns)
        largest = now.index + 1 + floor((since_answered_ns - earliest_ns) / self.interval_ns)
        return least, largest

    def doubt(self, readings: int) -> None:
        """Allow for a count that may be wrong by so many readings either way, after a gap of uncertain length."""
        if self._now is not None:
            self._now.earliest_ns -= readings * self.interval_ns
            self._now.latest_ns += readings * self.interval_ns
            self._anchor = self._stamped = None

    def _since_ns(self, bounds: _Bounds, index: int, t_ns: int) -> float:
        """Return an instant relative to the nominal finish of a reading, in the frame of the bounds."""
        return (t_ns - bounds.origin_ns) - (index - bounds.first_index) * self.interval_ns

    def _age(self, bounds: _Bounds, index: int) -> None:
        """Carry the bounds from their reading to a later one; they drift apart as the rate is uncertain."""
        span_ns = (index - bounds.index) * self.interval_ns
        drift_ns = _drift_ns(span_ns)
        bounds.earliest_ns += self._slowest * span_ns - drift_ns
        bounds.latest_ns += self._fastest * span_ns + drift_ns
        bounds.index = index
        wander = WANDER_PER_S * span_ns * 1e-9
        self._slowest = max(self._slowest - wander, -self._rate_bound)
        self._fastest = min(self._fastest + wander, self._rate_bound)

    def _narrow_rate(self, now: _Bounds) -> None:
        """Hold the mean rate since the anchor against the bounds; take a better or a newer anchor."""
        anchor = self._anchor
        span_ns = 0.0 if anchor is None else (now.index - anchor.index) * self.interval_ns
        if anchor is not None and span_ns > 0:
            wander = WANDER_PER_S * span_ns * 1e-9
            self._slowest = max(self._slowest, (now.earliest_ns - anchor.latest_ns) / span_ns - wander)
            self._fastest = min(self._fastest, (now.latest_ns - anchor.earliest_ns) / span_ns + wander)
        if now.width_ns < inf and (anchor is None or now.width_ns < anchor.width_ns / 2 or span_ns > ANCHOR_NS):
            self._anchor = now.copy()

    def _stamp(self, bounds: _Bounds, first_index: int, count: int) -> NDArray[np.int64]:
        index = np.arange(first_index, first_index + count)
        offset_ns = (index - bounds.first_index) * self.interval_ns
        rate, within_ns = self._between(bounds, first_index, int(index[-1]))
        offset_ns += bounds.middle_ns + rate * (index - bounds.index) * self.interval_ns - self._delay_ns
        stamps_ns: NDArray[np.int64] = bounds.origin_ns + np.rint(offset_ns).astype(np.int64)
        held_back_ns = 0
        if self._last_t_ns is not None:
            soonest_ns = self._last_t_ns + max(1, ceil(CLOSEST * self.interval_ns))
            held_back_ns = max(0, soonest_ns - int(stamps_ns[0]))
            stamps_ns += held_back_ns
        self._last_t_ns = int(stamps_ns[-1])
        self._stamped_within_ns = max(self._stamped_within_ns, within_ns + held_back_ns)
        return stamps_ns

    def _between(self, bounds: _Bounds, first: int, last: int) -> tuple[float, float]:
        """Return the rate to carry the middle of the bounds back to the readings with, and the stamps' largest error.

        What waited while nobody looked lies between two pairs of bounds; where the rate is ill known, the straight line
        from the one to the other errs less.
        """
        farthest_ns = max(abs(first - bounds.index), abs(last - bounds.index)) * self.interval_ns
        within_ns = bounds.width_ns / 2 + farthest_ns * self.rate_uncertainty
        before = self._stamped
        if before is None or before.first_index != bounds.first_index or not before.index <= first <= bounds.index:
            return self.rate, within_ns
        span_ns = (bounds.index - before.index) * self.interval_ns
        between_ns = max(before.width_ns, bounds.width_ns) / 2 + _drift_ns(span_ns) / 4
        if span_ns == 0 or not between_ns < within_ns:
            return self.rate, within_ns
        return (bounds.middle_ns - before.middle_ns) / span_ns, between_ns


def _drift_ns(span_ns: float) -> float:
    """Return how far a rate that wanders takes the offset off in a span, beyond the rate at its begin: W s^2 / 2."""
    return 0.5 * WANDER_PER_S * (span_ns * 1e-9) ** 2 * 1e9
