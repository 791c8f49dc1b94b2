"""What no manual says and only a meter can answer, asked of the one that is there. It takes about a minute.

The meter is set up and measured with, so what it was doing is over; nothing is changed that *RST does not undo.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from math import isfinite

import numpy as np

from aemd.acquire.instrument import Clock
from aemd.errors import InstrumentError
from agilent34410.busy import refuse_busy
from agilent34410.link import Link, open_link
from agilent34410.models import MEMORY_READINGS
from agilent34410.options import Options

__all__ = ["Answer", "characterise"]

FAST = ("VOLT:DC:NPLC 0.006", "VOLT:DC:ZERO:AUTO OFF", "TRIG:DEL 0", "DISP OFF")


@dataclass(frozen=True, slots=True)
class Answer:
    """One open question, and what this meter answers."""

    question: str
    answer: str


def characterise(
    resource: str,
    options: Options,
    clock: Clock,
    sleep: Callable[[float], None],
    open_line: Callable[[], Link] | None = None,
) -> list[Answer]:
    """Return what this meter answers to the open questions, or why it did not.

    Args:
        resource: the meter's VISA resource.
        options: of the link; the settings are this function's own.
        clock: host monotonic time, ns.
        sleep: waits so many seconds.
        open_line: opens a line to it; None for pyvisa's.

    Raises:
        InstrumentError: nobody answers, it is another instrument, or another program is reading it.
    """
    opener = open_line or (lambda: open_link(resource, options.timeout_s, options.serial_line))
    link = opener()
    try:
        identity = link.query("*IDN?")
        if not any(f",{model}," in identity for model in MEMORY_READINGS):
            raise InstrumentError(  # noqa: TRY301 - the link is closed in one place
                f"{resource}: this is {identity!r}, not one of {', '.join(MEMORY_READINGS)}"
            )
        refuse_busy(link, sleep)
    except InstrumentError:
        link.close()
        raise
    bench = _Bench(link, opener, clock, sleep)
    answers = [Answer("*IDN?", identity)]
    for question, ask in _QUESTIONS.items():
        try:
            bench.make_ready()
            answer = ask(bench)
        except (InstrumentError, ValueError) as error:
            answer = f"no answer: {error}"
            bench.has_failed = True
        answers.append(Answer(question, answer))
    with suppress(InstrumentError):
        bench.make_ready()
        bench.link.query("ABOR;*RST;*CLS;:DISP ON;*OPC?")
        bench.link.write("SYST:LOC")
    bench.link.close()
    return answers


class _Bench:
    def __init__(self, link: Link, opener: Callable[[], Link], clock: Clock, sleep: Callable[[float], None]) -> None:
        self.link = link
        self.clock = clock
        self.sleep = sleep
        self.has_failed = False
        self._opener = opener

    def make_ready(self) -> None:
        """Open another link where a question failed; one that cannot be opened costs that question, and no other."""
        if self.has_failed:
            self.reopen()
            self.has_failed = False

    def reopen(self) -> None:
        """Close the link and open another."""
        self.link.close()
        self.link = self._opener()

    def set_up(self, *commands: str, interval_s: float, samples: str = "MAX") -> None:
        """Configure for timed readings, fast ones unless told otherwise."""
        for command in (
            "*CLS", "ABOR", "*RST", "CONF:VOLT:DC 10", *FAST, "TRIG:SOUR IMM", "TRIG:COUN INF", "SAMP:SOUR TIM",
            f"SAMP:TIM {interval_s:.9g}", f"SAMP:COUN {samples}", "FORM:DATA REAL,64", *commands,
        ):  # fmt: skip
            refusal = self.link.query(f"{command};:SYST:ERR?")
            if not refusal.lstrip("+").startswith("0,"):
                raise ValueError(f"{command}: {refusal}")

    def waiting(self) -> int:
        """Return how many readings are in the memory."""
        return int(_number(self.link.query("DATA:POIN?")))

    def finish(self, count: int, at_most_s: float) -> tuple[int, int]:
        """Return between which two instants, ns, the reading of that count was finished, and be quick about it."""
        end_ns = self.clock() + round(at_most_s * 1e9)
        asked_before_ns = self.clock()
        while True:
            asked_ns = self.clock()
            if self.waiting() >= count:
                return asked_before_ns, self.clock()
            asked_before_ns = asked_ns
            if self.clock() > end_ns:
                raise ValueError(f"{count} readings did not come within {at_most_s:g} s")


def _timer_grid(bench: _Bench) -> str:
    bench.set_up(interval_s=1e-3)
    asked_s = 1e-3 + np.arange(0, 101) * 1e-6
    kept_s = np.array(
        [_number(bench.link.query(f"SAMP:TIM {value:.9g};:SAMP:TIM?")) for value in asked_s], dtype=np.float64
    )
    steps_s = np.diff(np.unique(np.round(kept_s, 10)))
    if not steps_s.size:
        return f"one value, {kept_s[0]:.9g} s, for all from 1.000 ms to 1.100 ms"
    return (
        f"steps of {np.median(steps_s) * 1e6:.3f} us ({steps_s.min() * 1e6:.3f} to {steps_s.max() * 1e6:.3f}) between"
        f" 1.000 ms and 1.100 ms; kept minus asked {(kept_s - asked_s).min() * 1e6:+.3f} to"
        f" {(kept_s - asked_s).max() * 1e6:+.3f} us"
    )


def _largest_count(bench: _Bench) -> str:
    return bench.link.query("SAMP:COUN? MAX")


def _boundary(bench: _Bench) -> str:
    """The time from one trigger's last reading to the next trigger's first, beyond an interval, of many boundaries."""
    interval_s, samples, boundaries = 2e-3, 50, 40
    bench.set_up(interval_s=interval_s, samples=str(samples))
    bench.link.write("INIT")
    first = bench.finish(1, 2.0)
    last = bench.finish(samples * boundaries + 1, 30.0)
    bench.link.query("ABOR;:SYST:ERR?")
    least_s = (last[0] - first[1]) * 1e-9 / boundaries - samples * interval_s
    largest_s = (last[1] - first[0]) * 1e-9 / boundaries - samples * interval_s
    return f"between {least_s * 1e3:+.3f} and {largest_s * 1e3:+.3f} ms longer than an interval of {interval_s:g} s"


def _empty(bench: _Bench) -> str:
    bench.set_up(interval_s=1e-2)
    try:
        block, _ = bench.link.query_block("R? 1", 8)
    except InstrumentError as error:
        answer = f"no block ({error})"
        bench.has_failed = True
        with suppress(InstrumentError):  # the answer stands without what the queue says of it
            bench.make_ready()
            answer += f"; error queue {bench.link.query('SYST:ERR?')}"
        return answer
    return f"a block of {len(block)} bytes; error queue {bench.link.query('SYST:ERR?')}"


def _abort(bench: _Bench) -> str:
    bench.set_up(interval_s=1e-2)
    bench.link.write("INIT")
    bench.sleep(0.5)
    before = bench.waiting()
    bench.link.query("ABOR;:SYST:ERR?")
    return f"{before} readings before ABOR, {bench.waiting()} after"


def _lost_link(bench: _Bench) -> str:
    bench.set_up(interval_s=1e-2)
    bench.link.write("INIT")
    bench.sleep(0.5)
    before = bench.waiting()
    left_ns = bench.clock()
    bench.link.close()
    bench.sleep(5.0)
    bench.reopen()
    after = bench.waiting()
    expected = before + round((bench.clock() - left_ns) * 1e-7)
    state = "still sampling" if int(_number(bench.link.query("STAT:OPER:COND?"))) & 0x30 else "sampling no more"
    return f"{before} readings when the link was closed for 5 s, {after} after ({expected} if nothing stops); {state}"


def _disturbance(bench: _Bench) -> str:
    counts = []
    for polls in (0, 100):
        bench.set_up(interval_s=1e-3)
        bench.link.query("STAT:QUES:EVEN?")
        bench.link.write("INIT")
        begun_ns = bench.clock()
        bench.sleep(0.1)
        for _ in range(polls):
            bench.waiting()
            bench.sleep(0.01)
        bench.sleep(max(0.0, 2.0 - (bench.clock() - begun_ns) * 1e-9))
        made = bench.waiting()
        took_s = (bench.clock() - begun_ns) * 1e-9
        late = int(_number(bench.link.query("STAT:QUES:EVEN?"))) & 4
        counts.append(f"{made / took_s:.1f} readings/s, timing violation {'yes' if late else 'no'}")
    return f"without questions {counts[0]}; asked every 10 ms {counts[1]}"


def _block_and_more(bench: _Bench) -> str:
    bench.set_up(interval_s=1e-2)
    bench.link.write("INIT")
    bench.sleep(0.2)
    count = bench.waiting()
    block, rest = bench.link.query_block(f"STAT:QUES:ENAB 17;:R? {count};:STAT:QUES:ENAB?", 8 * count)
    return f"{len(block) // 8} readings of {count}, then {rest!r}"


def _number(answer: str) -> float:
    """Return the number that an answer is; 9.9E400 and nan are none.

    Raises:
        ValueError: it is none.
    """
    number = float(answer)
    if not isfinite(number):
        raise ValueError(f"the answer {answer!r} is not a number")
    return number


_QUESTIONS: dict[str, Callable[[_Bench], str]] = {
    "step of the sample timer": _timer_grid,
    "largest SAMP:COUN": _largest_count,
    "from the last reading of a trigger to the first of the next": _boundary,
    "R? on an empty memory": _empty,
    "whether ABOR keeps the memory": _abort,
    "what a lost link clears": _lost_link,
    "whether DATA:POIN? disturbs sampling at 1,000 readings/s": _disturbance,
    "a block and a further answer in one message": _block_and_more,
}
