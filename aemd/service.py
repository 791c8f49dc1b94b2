"""What a process owes whoever started it: to stop when told, to say that it is ready, and to be restarted if it hangs.

systemd is told by its notification protocol: datagrams of `NAME=value` lines to the socket that $NOTIFY_SOCKET names
(sd_notify(3)). Its watchdog is fed only while every stage of the pipeline moves: a timer that feeds it by itself would
keep a process alive whose disk or whose link is wedged.
"""

import os
import signal
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from threading import Event, Thread
from types import FrameType

__all__ = ["Notifier", "Pulse", "Watchdog", "stopping_on_signals", "watched"]

STATUS_EVERY_S = 1.0
EXTEND_US = 30_000_000
"""Asked for at the end, on top of the unit's time: a file's summary is written and a slow disk waited for."""


@contextmanager
def stopping_on_signals(stop: Callable[[], None], *, is_service: bool = False) -> Iterator[None]:
    """While inside, let SIGINT and SIGTERM call `stop`; a second SIGINT interrupts as usual.

    SIGHUP means two things. To a program on a terminal: the terminal has gone, so it stops. To a service: read your
    config again; that would change what the recording is of in its middle, so it is told what to do instead.

    To be entered on the main thread; handlers run between its bytecodes, so `stop` must only set a flag. A second
    SIGTERM is for the patient: whoever sent it can still kill.
    """

    def handle(number: int, _frame: FrameType | None) -> None:
        if number == signal.SIGINT:
            signal.signal(number, before[signal.SIGINT])
        if number == signal.SIGHUP and is_service:
            os.write(2, b"event=reload ignored: a recording keeps the config it began with; restart the service\n")
            return
        stop()

    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, handle) for number in signals if not _is_ignored(number)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_ignored(number: int) -> bool:
    """Tell whether whoever started us wants this signal ignored, as nohup does; SIGINT of a background job is ours."""
    return number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN


class Notifier:
    """Tells systemd what this process is doing; says nothing where nobody listens."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address  # `@`: Linux's abstract namespace
        pid = environment.get("WATCHDOG_PID", "")
        is_for_us = not pid or pid == str(os.getpid())
        micros = environment.get("WATCHDOG_USEC", "")
        self.watchdog_s = int(micros) * 1e-6 if is_for_us and micros.isdigit() else 0.0
        """Within which the watchdog wants to hear of us, s; 0 where there is none."""
        self._status = ""

    @property
    def is_service(self) -> bool:
        """Whether somebody listens."""
        return bool(self._address)

    def ready(self, status: str, patience_s: float = 0.0) -> None:
        """Say that the start has succeeded; ask for a watchdog this patient where the unit's is less so."""
        more = [f"WATCHDOG_USEC={round(patience_s * 1e6)}"] if 0 < self.watchdog_s < patience_s else []
        self._send("READY=1", f"STATUS={_one_line(status)}", *more)

    def status(self, text: str) -> None:
        """Say what `systemctl status` shows; only where it changed."""
        if text != self._status:
            self._status = text
            self._send(f"STATUS={_one_line(text)}")

    def alive(self) -> None:
        """Feed the watchdog."""
        self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """Say that the end has begun, and that finishing a file may take its time."""
        self._send("STOPPING=1", f"EXTEND_TIMEOUT_USEC={EXTEND_US}")

    def _send(self, *lines: str) -> None:
        if not self._address:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel:
            channel.settimeout(0.5)  # a notification is never worth a standstill
            channel.sendto("\n".join(lines).encode(), self._address)


@dataclass(frozen=True, slots=True)
class Pulse:
    """Counters that grow while their stage lives."""

    acquiring: int
    """Turns of the thread that speaks to the instrument, attempts to reach it again included."""
    delivered: int
    """Readings that the estimator's thread has taken."""
    waiting: int
    """Readings that wait for it."""
    writing: int
    """Turns of the thread that writes, those with nothing to write included."""


class Watchdog:
    """Decides, look by look, whether every stage has moved since the watchdog was last fed."""

    def __init__(self, first: Pulse) -> None:
        self._fed = first

    def is_alive(self, now: Pulse) -> bool:
        """Tell whether each stage has moved; a stage with nothing to do may rest."""
        before = self._fed
        delivers = now.delivered > before.delivered or not now.waiting
        if now.acquiring > before.acquiring and now.writing > before.writing and delivers:
            self._fed = now
            return True
        return False


@contextmanager
def watched(notifier: Notifier, pulse: Callable[[], Pulse], status: Callable[[], str]) -> Iterator[None]:
    """While inside, keep systemd informed from a thread: the status each second, the watchdog as long as all is well.

    Args:
        notifier: where to.
        pulse: the counters now; asked from that thread.
        status: one line for `systemctl status`; asked from that thread.
    """
    if not notifier.is_service:
        yield
        return
    over = Event()
    period_s = min(STATUS_EVERY_S, notifier.watchdog_s / 4) if notifier.watchdog_s else STATUS_EVERY_S

    def attend() -> None:
        watchdog = Watchdog(pulse())
        while not over.wait(period_s):
            try:
                notifier.status(status())
            except Exception as error:  # noqa: BLE001 - what is said of the stages must not stand for how they fare
                notifier.status(f"state unknown: {error}")
            if watchdog.is_alive(pulse()):
                notifier.alive()

    thread = Thread(target=attend, name="aemd-watchdog", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        notifier.stopping()


def _one_line(text: str) -> str:
    return " ".join(text.split())
