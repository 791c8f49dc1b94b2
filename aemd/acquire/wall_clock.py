"""The host's wall clock, held against its monotonic one: whoever sets it is told of and moves no stamp."""

from aemd.acquire.instrument import Clock

__all__ = ["WallClock"]

EVERY_NS = 1_000_000_000
STEP_NS = 20_000_000  # what happens between reading two clocks is less, else they are read again


class WallClock:
    """Notices that the wall clock was set.

    Args:
        clock: host monotonic time, ns.
        utc: the wall clock, ns since 1970.
    """

    def __init__(self, clock: Clock, utc: Clock) -> None:
        self.offset_ns = utc() - clock()
        """UTC minus host monotonic, taken once: what stamps are made of."""
        self._clock = clock
        self._utc = utc
        self._seen_ns = self.offset_ns
        self._due_ns = 0

    def news(self, now_ns: int) -> tuple[str, ...]:
        """Return by how much the wall clock was set since it was last looked at; nothing where it was not."""
        if now_ns < self._due_ns:
            return ()
        before_ns, utc_ns, after_ns = self._clock(), self._utc(), self._clock()
        if after_ns - before_ns > STEP_NS // 2:  # we were put to sleep in between
            return ()
        self._due_ns = now_ns + EVERY_NS
        offset_ns = utc_ns - before_ns
        step_ns, self._seen_ns = offset_ns - self._seen_ns, offset_ns
        if abs(step_ns) < STEP_NS:
            return ()
        ahead_s = (offset_ns - self.offset_ns) * 1e-9
        message = (
            f"the host's wall clock was set by {step_ns * 1e-9:+.3f} s; stamps go on by the monotonic clock and the"
            f" UTC of the start, and it is {ahead_s:+.3f} s ahead of them now"
        )
        return (message,)
