"""Error queue and status registers, as SCPI-99 and IEEE 488.2 define them."""

from collections import deque

__all__ = ["ERROR_TEXTS", "ErrorQueue", "EventRegister", "ScpiError", "standard_event_bit"]

ERROR_TEXTS = {
    0: "No error",
    -101: "Invalid character",
    -102: "Syntax error",
    -104: "Data type error",
    -108: "Parameter not allowed",
    -109: "Missing parameter",
    -113: "Undefined header",
    -131: "Invalid suffix",
    -151: "Invalid string data",
    -211: "Trigger ignored",
    -213: "Init ignored",
    -214: "Trigger deadlock",
    -221: "Settings conflict",
    -222: "Data out of range",
    -224: "Illegal parameter value",
    -230: "Data corrupt or stale",
    -350: "Queue overflow",
    -363: "Input buffer overrun",
    -410: "Query INTERRUPTED",
    -420: "Query UNTERMINATED",
    550: "Command not allowed in local",
}
"""Texts of SCPI-99, chapter 21, of the errors that this meter reports; 550 is the 34401A's own."""

QUEUE_LENGTH = 20
"""Errors that the meter keeps."""


class ScpiError(Exception):
    """A command that cannot be obeyed; its code goes into the error queue."""

    def __init__(self, code: int) -> None:
        super().__init__(ERROR_TEXTS[code])
        self.code = code


def standard_event_bit(code: int) -> int:
    """Return the bit of the Standard Event register that an error of this code sets.

    >>> standard_event_bit(-113), standard_event_bit(-222), standard_event_bit(-350), standard_event_bit(-410)
    (32, 16, 8, 4)
    """
    return {1: 32, 2: 16, 4: 4}.get(-code // 100, 8)


class ErrorQueue:
    """First in, first out; when the queue is full its last entry becomes "Queue overflow" and newer ones are lost."""

    def __init__(self) -> None:
        self._codes: deque[int] = deque()

    def __len__(self) -> int:
        return len(self._codes)

    def push(self, code: int) -> None:
        """Add an error."""
        if len(self._codes) < QUEUE_LENGTH:
            self._codes.append(code)
        else:
            self._codes[-1] = -350

    def pop(self) -> str:
        """Remove the oldest error and return it as SYSTem:ERRor? answers it."""
        code = self._codes.popleft() if self._codes else 0
        return f'{code:+d},"{ERROR_TEXTS[code]}"'

    def clear(self) -> None:
        """Forget all errors."""
        self._codes.clear()


class EventRegister:
    """Condition, event and enable of one SCPI status group; an event stays until it is read."""

    def __init__(self) -> None:
        self.condition = 0
        self.enable = 0
        self._event = 0

    @property
    def summary(self) -> bool:
        """Whether an enabled event is waiting to be read."""
        return bool(self._event & self.enable)

    def reset(self) -> None:
        """Forget everything, as at power on."""
        self.condition = self.enable = self._event = 0

    def happened(self, bits: int) -> None:
        """Set event bits."""
        self._event |= bits

    def become(self, condition: int) -> None:
        """Set the condition; a bit that rises is an event."""
        self._event |= condition & ~self.condition
        self.condition = condition

    def take(self) -> int:
        """Return the events and clear them."""
        event, self._event = self._event, 0
        return event
