"""What a process owes whoever started it: to stop cleanly when told."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["stopping_on_signals"]


@contextmanager
def stopping_on_signals(stop: Callable[[], None]) -> Iterator[None]:
    """While inside, let SIGINT and SIGTERM call `stop`; a second SIGINT interrupts as usual.

    To be entered on the main thread; handlers run between its bytecodes, so `stop` must only set a flag. A second
    SIGTERM is for the patient: whoever sent it can still kill.
    """

    def handle(number: int, _frame: FrameType | None) -> None:
        if number == signal.SIGINT:
            signal.signal(number, before[signal.SIGINT])
        stop()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
