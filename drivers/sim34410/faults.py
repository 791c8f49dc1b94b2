"""What goes wrong, and when: a schedule of faults, and the one place where a reply is spoilt on its way to a client."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import numpy as np
from annotated_types import Ge, Interval
from numpy.typing import NDArray

from sim34410.converter import OVERLOAD_V

__all__ = ["NOT_A_NUMBER_V", "Fault", "Kind", "Message", "ReadingFaults", "Spoiler", "draw_faults"]

NOT_A_NUMBER_V = 9.91e37
"""What SCPI-99 (volume 1, 7.2.1.5) has an instrument send for "not a number"."""

Kind = Literal[
    "refuse",  # new connections are refused
    "close",  # the meter hangs up on everybody
    "unplug",  # the cable is out: links end, none can be opened; the meter goes on and notices nothing
    "power",  # the mains fail for a moment: settings and readings are lost, and it boots for `lasts_s`
    "clear",  # the meter clears itself: sampling stops, the memory is empty
    "errors",  # `count` errors in the queue, spread over `lasts_s`
    "silent",  # what arrives is neither obeyed nor answered
    "lost",  # what arrives is obeyed, its reply never arrives
    "half",  # half of a reply arrives
    "garbage",  # noise arrives before a reply
    "late",  # a reply arrives `delay_s` later
    "length",  # a block announces `count` readings more than it has
    "nan",  # readings are not a number
    "overload",  # readings are beyond the range
]

LINKS = ("refuse", "unplug", "power")  # nobody can connect as long as they last
REPLIES = ("lost", "half", "garbage", "late", "length")
READINGS = ("nan", "overload")


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that goes wrong.

    Those of replies (`silent`, `lost`, `half`, `garbage`, `late`, `length`) hit every reply while they last, and at
    least the next one. `length` waits for a reply that is a block; the others take what comes.
    """

    kind: Kind
    at_s: Annotated[float, Ge(0)]
    """Host seconds since the meter was first switched on."""
    lasts_s: Annotated[float, Ge(0)] = 0.0
    """How long, s."""
    delay_s: Annotated[float, Ge(0)] = 3.0
    """Of `late`, s."""
    count: Annotated[int, Interval(ge=-1000, le=1000)] = 1
    """Errors of `errors`; readings of `length`, below 0 for fewer than the block has."""
    seed: Annotated[int, Ge(0)] = 1
    """Of the noise of `garbage`; of the sign of `overload`, positive where odd."""

    def __post_init__(self) -> None:
        """Refuse what would do nothing.

        Raises:
            ValueError: a fault of readings that lasts no time, or a count that its kind cannot have.
        """
        if self.kind in READINGS and not self.lasts_s:
            raise ValueError(f"fault {self.kind!r} at {self.at_s:g} s: lasts_s must be above 0; say how long")
        if (self.kind == "errors" and self.count < 1) or (self.kind == "length" and not self.count):
            raise ValueError(f"fault {self.kind!r} at {self.at_s:g} s: count = {self.count} would do nothing")

    @property
    def end_s(self) -> float:
        """Host seconds since the meter was first switched on."""
        return self.at_s + self.lasts_s


@dataclass(slots=True)
class Message:
    """A reply on its way."""

    due_ns: int
    """When it arrives."""
    content: bytearray
    whole: bool = True
    """Whether its end arrives."""


class Spoiler:
    """The faults of replies that are under way."""

    def __init__(self) -> None:
        self._armed: list[tuple[Fault, int]] = []
        self._struck: set[int] = set()

    def arm(self, fault: Fault, end_ns: int) -> None:
        """Begin a fault that lasts until `end_ns`."""
        self._armed.append((fault, end_ns))

    def is_deaf(self, now_ns: int) -> bool:
        """Return whether what arrives now is neither obeyed nor answered."""
        return self._strike(now_ns, lambda fault: fault.kind == "silent") is not None

    def spoil(self, reply: bytes, now_ns: int) -> Message | None:
        """Return what becomes of a reply, which ends with a newline; None when nothing arrives."""
        is_block = reply[:1] == b"#"
        fault = self._strike(now_ns, lambda one: one.kind in REPLIES and (is_block or one.kind != "length"))
        message = Message(now_ns, bytearray(reply))
        if fault is None:
            return message
        if fault.kind == "lost":
            return None
        if fault.kind == "half":
            message.content, message.whole = bytearray(reply[: len(reply) // 2]), False
        elif fault.kind == "garbage":
            message.content[:0] = _noise(fault.seed)
        elif fault.kind == "length":
            message.content = _mislabelled(reply, 8 * fault.count)
        else:
            message.due_ns += round(fault.delay_s * 1e9)
        return message

    def _strike(self, now_ns: int, hits: Callable[[Fault], bool]) -> Fault | None:
        """Return the first fault under way that hits, and end those that have struck and are over."""
        found: Fault | None = None
        left: list[tuple[Fault, int]] = []
        for fault, end_ns in self._armed:
            struck = id(fault) in self._struck
            if struck and end_ns < now_ns:
                self._struck.discard(id(fault))
                continue
            if found is None and hits(fault):
                found = fault
                self._struck.add(id(fault))
                if end_ns <= now_ns:
                    self._struck.discard(id(fault))
                    continue
            left.append((fault, end_ns))
        self._armed = left
        return found


def _noise(seed: int) -> bytes:
    """Return up to 16 bytes that no number and no block begins with, so that no other answer can come of them."""
    rng = np.random.default_rng(seed)
    allowed = np.array([byte for byte in range(256) if byte not in b"+-.0123456789#eE"], dtype=np.uint8)
    return rng.choice(allowed, rng.integers(1, 17)).tobytes()


def _mislabelled(block: bytes, more: int) -> bytearray:
    """Return a block whose header announces so many bytes more than come."""
    begin = 2 + int(block[1:2])
    announced = str(max(int(block[2:begin]) + more, 0)).encode()
    return bytearray(b"#%d%s%s" % (len(announced), announced, block[begin:]))


class ReadingFaults:
    """The faults of readings: those begun in a window of host time are replaced."""

    def __init__(self, faults: Iterable[Fault], on_ns: int) -> None:
        """Take the faults, and the host instant at which the meter was switched on, ns."""
        own = sorted((fault for fault in faults if fault.kind in READINGS), key=lambda fault: fault.at_s)
        self._begin_ns = np.array([on_ns + round(fault.at_s * 1e9) for fault in own], dtype=np.int64)
        self._end_ns = np.array([on_ns + round(fault.end_s * 1e9) for fault in own], dtype=np.int64)
        self._longest_ns = int((self._end_ns - self._begin_ns).max(initial=0))
        overload_V = [OVERLOAD_V if fault.seed % 2 else -OVERLOAD_V for fault in own]
        self._value_V = [
            NOT_A_NUMBER_V if fault.kind == "nan" else value_V for fault, value_V in zip(own, overload_V, strict=True)
        ]

    def disturb(self, begin_ns: NDArray[np.int64], value_V: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return readings, V, shape (n,), whose apertures begin at these host instants, ns, as they are stored."""
        first = int(np.searchsorted(self._begin_ns, begin_ns[0] - self._longest_ns))
        last = int(np.searchsorted(self._begin_ns, begin_ns[-1], side="right"))
        for row in range(first, last):
            hit = (begin_ns >= self._begin_ns[row]) & (begin_ns < self._end_ns[row])
            value_V = np.where(hit, self._value_V[row], value_V)
        return value_V


def draw_faults(
    seed: int, count: int, length_s: float, kinds: tuple[Kind, ...] = get_args(Kind), longest_s: float = 30.0
) -> tuple[Fault, ...]:
    """Return a storm: faults of random kinds at random instants of (5 s, length), in their order.

    Args:
        seed: of the storm; the same one makes the same storm.
        count: how many.
        length_s: time over which they are strewn evenly, s.
        kinds: those that may come, equally often.
        longest_s: durations are drawn between 0.05 s and this, evenly in their logarithm.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0xFA017,)))
    faults = []
    for at_s in np.sort(rng.uniform(5.0, length_s, count)):
        kind = kinds[int(rng.integers(len(kinds)))]
        lasts_s = float(np.exp(rng.uniform(np.log(0.05), np.log(longest_s))))
        faults.append(
            Fault(
                kind,
                at_s=round(float(at_s), 6),
                lasts_s=0.0 if kind in REPLIES and rng.random() < 0.5 else round(lasts_s, 6),
                delay_s=round(float(rng.uniform(0.1, 10.0)), 6),
                count=int(rng.choice([-2, -1, 1, 2])) if kind == "length" else int(rng.integers(1, 40)),
                seed=int(rng.integers(1, 1 << 31)),
            )
        )
    return tuple(faults)
