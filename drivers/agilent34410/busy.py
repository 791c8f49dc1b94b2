"""Whether another program is reading the meter, which must be known before it is set up: that would end a recording.

A meter that samples and is not read was left behind by a program that has died. Only questions are asked, which disturb
nobody. An acquisition of ours writes another number with each question (`dialogue`), several times a second however
rare its readings are; of any other program the count of readings tells, which falls.
"""

from collections.abc import Callable
from dataclasses import dataclass

from aemd.acquire.instrument import BusyError
from agilent34410.link import Link

__all__ = ["MEASURING_OR_WAITING", "refuse_busy"]

MEASURING_OR_WAITING = 1 << 4 | 1 << 5  # Standard Operation condition: the trigger system is not idle
WATCH_S = 0.5  # twice the longest time between two looks that an acquisition chooses by itself
INTERVALS = 2.5  # in which a reading comes and is taken
LONGEST_WATCH_S = 5.0
GLANCES = 5


@dataclass(frozen=True, slots=True)
class _Glance:
    numbers: tuple[int, int]
    waiting: int
    interval_s: float


def refuse_busy(link: Link, sleep: Callable[[float], None]) -> None:
    """Make sure that nobody takes readings out of this meter; takes no time where it does not sample.

    Args:
        link: to a meter of the family, by which nothing else is said meanwhile.
        sleep: waits so many seconds.

    Raises:
        BusyError: somebody does.
        InstrumentError: the link failed.
    """
    before = _glance(link)
    for _ in range(GLANCES):
        if before is None:
            return
        sleep(min(max(WATCH_S, INTERVALS * before.interval_s), LONGEST_WATCH_S) / GLANCES)
        now = _glance(link)
        if now is not None and (now.numbers != before.numbers or now.waiting < before.waiting):
            raise BusyError(
                f"{link.resource}: another program is taking readings out of this meter; stop it first, because to set"
                " the meter up ends its recording"
            )
        before = now


def _glance(link: Link) -> _Glance | None:
    """Return the state of a meter that samples; None of any other."""
    answer = link.query("STAT:OPER:COND?;:STAT:QUES:ENAB?;:STAT:OPER:ENAB?;:DATA:POIN?;:SAMP:TIM?")
    try:
        condition, number, entry, waiting, interval_s = (float(field) for field in answer.split(";"))
        if int(condition) & MEASURING_OR_WAITING and interval_s > 0:
            return _Glance((int(number), int(entry)), int(waiting), interval_s)
    except (ValueError, OverflowError):
        pass  # who asks next says what is wrong with such an answer
    return None
