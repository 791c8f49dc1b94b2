"""Which meter it is: what the members of the family have in common is simulated, what tells them apart is here.

    model    memory     samples  NPLC from  timer step  sources
    34410A   50,000     50,000   0.006      20 us       34410A manual, PRH 797, 1791; user's guide 51
    34411A   1,000,000  10^6     0.001      20 us       the same pages
    L4411A   1,000,000  10^6     0.001      20 us       the same pages: a 34411A without a front panel
    34461A   10,000     10^6     0.02       no timer    Truevolt guide, SAMPle:COUNt (306), SAMPle:SOURce (309)
    34465A   50,000     10^9     0.02       1 us        Truevolt guide, pages 306, 309 (timer), without the MEM option
    34401A   512        50,000   0.02       no timer    34401A user's guide; no R?, no DATA subsystem, no aperture

"samples" is the largest SAMPle:COUNt; for the 34410A and 34411A it is not in print and taken as the memory's size.
By the Truevolt guide, SAMPle:SOURce TIMer is for the 34465A and 34470A only. The noise of all of them
is that of the 34410A, and only the DC volts function exists. The USB product numbers of the 34410A (0957:0607) and the
34411A (0957:0A07) are those of libsigrok's udev rules; those of the Truevolt meters (2A8D:1301 the 34461A, 2A8D:0101
the 34465A) are from resource strings in users' public scripts.
"""

from dataclasses import dataclass

from aemd.errors import InstrumentError, not_among

__all__ = ["MODELS", "Member", "member"]

_NPLC = (0.006, 0.02, 0.06, 0.2, 1.0, 2.0, 10.0, 100.0)
_NO_TIMER = ("SAMP:SOUR", "SAMP:TIM")
_NO_MEMORY_COMMANDS = ("R", "DATA:LAST", "DATA:REM", "DATA:POIN:EVEN:THR", "FORM", "FORM:DATA", "FORM:BORD")
_NO_APERTURE = ("VOLT:APER", "VOLT:APER:ENAB")


@dataclass(frozen=True, slots=True)
class Member:
    """One model of the family."""

    memory_readings: int
    most_samples: int
    """The largest SAMPle:COUNt."""
    nplc: tuple[float, ...]
    """Integration times, power line cycles."""
    lacks: tuple[str, ...] = ()
    """Headers that it does not know, in their short form without the optional nodes [SENSe:] and [:DC]."""
    timer_step_ns: int = 20_000
    """Grid of SAMPle:TIMer."""
    usb: tuple[int, int] = (0x0957, 0x0607)
    """USB vendor and product."""
    needs_remote: bool = False
    """Whether a serial line has to send SYSTem:REMote before anything else."""


MODELS = {
    "34410A": Member(50_000, 50_000, _NPLC),
    "34411A": Member(1_000_000, 1_000_000, (0.001, 0.002, *_NPLC), usb=(0x0957, 0x0A07)),
    "L4411A": Member(1_000_000, 1_000_000, (0.001, 0.002, *_NPLC), usb=(0x0957, 0x0A07)),
    "34461A": Member(
        10_000, 1_000_000, (0.02, 0.2, 1.0, 10.0, 100.0), (*_NO_TIMER, *_NO_APERTURE), usb=(0x2A8D, 0x1301)
    ),
    "34465A": Member(
        50_000, 1_000_000_000, (0.02, 0.06, 0.2, 1.0, 10.0, 100.0), timer_step_ns=1_000, usb=(0x2A8D, 0x0101)
    ),
    "34401A": Member(
        512,
        50_000,
        (0.02, 0.2, 1.0, 10.0, 100.0),
        (*_NO_TIMER, *_NO_APERTURE, *_NO_MEMORY_COMMANDS),
        needs_remote=True,
    ),
}


def member(identity: str) -> Member:
    """Return the model that an answer to *IDN? names.

    Raises:
        InstrumentError: it names none that can be simulated.
    """
    fields = identity.split(",")
    model = fields[1].strip() if len(fields) > 1 else ""
    if model not in MODELS:
        raise InstrumentError(
            f"[simulator] identity = {identity!r}: no model to be simulated; {not_among(model, MODELS)}"
        )
    return MODELS[model]
