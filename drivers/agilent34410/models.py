"""Which instruments this driver speaks to, by their answer to *IDN?.

Every command that is sent is documented for the 34410A (Programmer's Reference Help). No meter has been on a wire yet:

    model    memory     commands checked against                          timing checked against
    34410A   50,000     its manual, the simulator, clients by others      the simulator
    34411A   1,000,000  the same manual (it is of 34410A and 34411A)      the simulator in this model's role
    L4411A   1,000,000  the same manual (a 34411A without a front panel)  the simulator in this model's role
    34465A   50,000     its family's manual (Truevolt), not page by page  nothing

Not verified of any: the step of the sample timer, the spacing at the end of a trigger's readings, whether the memory
outlives a lost link. `aemd doctor --characterise` finds out on the meter that is there.
"""

__all__ = ["LACKING", "MEMORY_READINGS"]

MEMORY_READINGS = {"34410A": 50_000, "34411A": 1_000_000, "L4411A": 1_000_000, "34465A": 50_000}
"""Models that know every command used here, and the readings that their memory holds."""

LACKING = {
    "34401A": "it has no sample timer (SAMP:TIM) and cannot give out readings while it takes further ones (R?)",
    "34461A": "it has no sample timer (public drivers note that SAMP:TIM is an undefined header to it)",
    "34460A": "it has no sample timer, as the 34461A",
    "3458A": "it speaks no SCPI",
}
"""Meters that one may well have, and why equal intervals without a gap cannot be had of them."""
