"""Questions and answers that cannot be taken for each other, and a journal of what left the meter's memory.

Every message gives itself a number in the enable mask of the Questionable Data register and asks it back at its end:

    STAT:QUES:ENAB 17;:DATA:POIN?;:STAT:QUES:EVEN?;:STAT:QUES:ENAB?      ->      +215;+0;+17

So an answer that comes late, twice, short or with bytes too many is not taken for the answer to the present question:
it lacks the present number, which was given to no other question of the last thousands.

`R? n` erases what it sends, so a link that fails in its course leaves in doubt whether n readings are gone. Before
reading, the same message therefore writes its own number into the enable mask of the Standard Operation register, which
nothing else writes: a message is obeyed in order and as a whole, so afterwards that register tells whether it was
obeyed. A meter that was switched off meanwhile answers 0, which is no number.

Neither register does anything unless a service request is enabled, which it is not; both are volatile, while those of
*ESE and *SRE may be kept over a power cycle, in a memory that wears. A meter may keep only the bits that it uses, so
only bits that were read back are counted with.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

from aemd.acquire.instrument import OtherInstrumentError, RefusedError
from aemd.errors import InstrumentError
from agilent34410.busy import refuse_busy
from agilent34410.link import Link

__all__ = ["Dialogue", "Look"]

ALL_BITS = 32_767
FEWEST_BITS = 5  # 31 numbers: more than exchanges that can be under way at once
BYTES_OF_A_READING = 8

MOST_MAY_COME = 8  # messages that were given up and may yet be obeyed; of older ones no line holds any

Answer = TypeVar("Answer")

_NUMBER = "STAT:QUES:ENAB"
_JOURNAL = "STAT:OPER:ENAB"


@dataclass(frozen=True, slots=True)
class Look:
    """The state of the memory, in one exchange."""

    waiting: int
    """Readings in the memory."""
    questionable: int
    """Questionable Data events since they were last asked for."""


class Dialogue:
    """A link whose every exchange is numbered; after a failed one nothing is exchanged until `restore`.

    Args:
        open_link: opens a new line to the same place.
        link: the one that is open, whose other end has said who it is.
        identity: its answer to *IDN?.
        salt: where the numbers begin; another for each program, so that two are not taken for each other.

    Raises:
        InstrumentError: the link failed, or the meter does not keep its masks.
    """

    def __init__(self, open_link: Callable[[], Link], link: Link, identity: str, salt: int = 0) -> None:
        self._open_link = open_link
        self._link = link
        self._identity = identity
        self._in_step = True
        self._numbers: tuple[int, ...] = ()
        self._journal_numbers: tuple[int, ...] = ()
        self._number = self._last_entry = salt
        self._entry = 0
        self._is_anothers = False
        self._in_doubt: tuple[int, int] | None = None
        self._may_come: dict[int, int] = {}
        self._torn = 0
        self._rung = 0
        self._learn_masks()

    @property
    def resource(self) -> str:
        """Of the link, for messages."""
        return self._link.resource

    @property
    def is_restarted(self) -> bool:
        """Whether the journal is empty: the meter was switched on since it was begun."""
        return self._entry == 0

    @property
    def is_anothers(self) -> bool:
        """Whether another program was found to have written the journal since: nothing in the memory is ours."""
        return self._is_anothers

    def refuse_busy(self, sleep: Callable[[float], None]) -> None:
        """Make sure that no other program is taking readings out of the meter.

        Raises:
            InstrumentError: one is (`BusyError`), or the link failed.
        """
        self._exchange(lambda link: refuse_busy(link, sleep))

    def ask(self, body: str) -> str:
        """Send one or more commands and questions as one message; return the answers, joined by `;`.

        Raises:
            InstrumentError: the link failed, or what came is not the answer.
        """
        number = self._next_number()
        separator = ";" if body.startswith("*") else ";:"
        answer = self._exchange(lambda link: link.query(f"{_NUMBER} {number}{separator}{body};:{_NUMBER}?"))
        found, _, echo = answer.rpartition(";")
        self._refuse_other(echo, number, body, answer)
        return found

    def command(self, command: str) -> None:
        """Send a command and make sure that the meter accepts it.

        Raises:
            InstrumentError: it refused, or the link failed.
        """
        refusal = self.ask(f"{command};:SYST:ERR?")
        if not is_no_error(refusal):
            raise RefusedError(f"{self.resource}: {command}: the meter refused: {refusal}; see its manual")

    def look(self) -> Look:
        """Ask how many readings wait and what went wrong; asking for the events clears them.

        Raises:
            InstrumentError: the link failed, what came is not the answer, or somebody took readings out of the memory.
        """
        body = f"{_JOURNAL}?;:DATA:POIN?;:STAT:QUES:EVEN?"
        answer = self.ask(body)
        entry, waiting, questionable = self._integers(answer, body, 3)
        if entry != self._entry:
            self._in_step = False
            raise InstrumentError(
                f"{self.resource}: the meter was switched off and on, or obeyed what was sent to it long ago, or"
                " another program uses it"
            )
        return Look(waiting, questionable)

    def take(self, count: int) -> bytes:
        """Take the oldest `count` readings out of the memory, in the meter's format.

        Raises:
            InstrumentError: the link failed, or not so many came; `take_torn` will know whether they are gone.
        """
        number = self._next_number()
        entry = self._next_entry()
        command = f"{_JOURNAL} {entry};:{_NUMBER} {number};:R? {count};:{_NUMBER}?"
        self._in_doubt = entry, count
        block, rest = self._exchange(lambda link: link.query_block(command, count * BYTES_OF_A_READING))
        self._refuse_other(rest.removeprefix(";"), number, f"R? {count}", rest)
        if len(block) != count * BYTES_OF_A_READING:
            self._in_step = False
            raise InstrumentError(
                f"{self.resource}: R? {count}: {len(block)} bytes came instead of {count * BYTES_OF_A_READING};"
                " is another program reading the meter's memory? close it"
            )
        self._in_doubt = None
        self._entry = entry
        return block

    def take_torn(self) -> int:
        """Return how many readings left the memory and never arrived, since the last call; known after `restore`."""
        torn, self._torn = self._torn, 0
        return torn

    def restore(self) -> str:
        """Try to get back into step, by the next rung of the ladder; return what did it.

        1. Drain: throw away what comes. The gentlest: the meter hears nothing of it.
        2. Clear: have the interface cleared. Only now, because a device clear may stop a meter that is measuring (as
           the 34401A's manual says of it).
        3. Open the line again. The new one first, then the old one closed, where both can be: a meter of this family
           was seen to clear itself when its last VXI-11 link goes.

        Every rung ends with two questions whose answers only this meter can give to them: who it is, and the number of
        the question. Each takes a few timeouts at most, so that whoever calls can stop in between.

        Raises:
            InstrumentError: not yet; the next call tries the next rung.
        """
        rung, self._rung = self._rung, self._rung + 1
        if not self._link.is_open or rung >= 2:
            self._reopen()
            how = "opened again"
        elif rung == 0:
            self._link.drain()
            how = "drained"
        else:
            self._link.clear()
            how = "cleared"
        self._in_step = True
        self._read_journal()
        self._rung = 0
        return how

    def begin_journal(self) -> None:
        """Write a first entry, for a meter whose memory is about to be begun anew.

        Raises:
            InstrumentError: the link failed.
        """
        entry = self._next_entry()
        self._may_come[entry] = 0  # should the answer be lost, it is known as ours
        self.ask(f"{_JOURNAL} {entry}")
        self._may_come.pop(entry)
        self._entry = entry
        self._is_anothers = False

    def farewell(self, command: str) -> None:
        """If it is ours still, stop the meter, leave the masks as at power on, and say one last thing."""
        if self._link.is_open and self._in_step:
            with suppress(InstrumentError):
                (entry,) = self._integers(self.ask(f"{_JOURNAL}?"), f"{_JOURNAL}?", 1)
                if entry == self._entry:
                    self._link.query(f"{_NUMBER} 0;:{_JOURNAL} 0;:ABOR;:DISP ON;*OPC?")  # heard before the link goes
                    self._link.write(command)
        self._link.close()

    def close(self) -> None:
        """Close the line without a word."""
        self._link.close()

    # ----------------------------------------------------------------------------------------------------------------

    def _learn_masks(self) -> None:
        question = f"{_NUMBER} {ALL_BITS};:{_JOURNAL} {ALL_BITS};:{_NUMBER}?;:{_JOURNAL}?"
        masks = self._integers(self._link.query(question), question, 2)
        self._numbers, self._journal_numbers = (_numbers_within(mask) for mask in masks)
        self._entry = masks[1]
        if min(len(self._numbers), len(self._journal_numbers)) < 1 << FEWEST_BITS:
            raise OtherInstrumentError(
                f"{self.resource}: {question}: the answer {masks} shows status registers without room for numbers;"
                " this is no meter of the family that it says it is of",
                self._identity,
            )

    def _next_number(self) -> int:
        self._number = self._number % (len(self._numbers) - 1) + 1  # never 0, which is what power on leaves
        return self._numbers[self._number]

    def _next_entry(self) -> int:
        self._last_entry = self._last_entry % (len(self._journal_numbers) - 1) + 1
        return self._journal_numbers[self._last_entry]

    def _exchange(self, talk: Callable[[Link], Answer]) -> Answer:
        if not self._in_step:
            raise InstrumentError(f"{self.resource}: the dialogue has lost its step; restore it")
        try:
            return talk(self._link)
        except InstrumentError:
            self._in_step = False
            raise

    def _refuse_other(self, echo: str, number: int, body: str, answer: str) -> None:
        try:
            if int(float(echo)) == number:
                return
        except (ValueError, OverflowError):
            pass
        self._in_step = False
        raise InstrumentError(
            f"{self.resource}: {body}: the answer {_shown(answer)} is not to this question, which is number {number}"
        )

    def _reopen(self) -> None:
        old = self._link
        if not old.resource.upper().startswith("TCPIP"):
            old.close()  # a USB or serial line is one person's at a time
        try:
            new = self._open_link()
        except InstrumentError:
            old.close()
            raise
        try:
            identity = new.query("*IDN?")  # and nothing more to a stranger
        except InstrumentError:
            new.close()
            old.close()  # it may be what keeps others out
            raise
        old.close()
        self._link = new
        if identity != self._identity:
            new.close()
            raise self._is_other(identity)

    def _read_journal(self) -> None:
        """Make sure of the step, and find out what became of the readings in doubt."""
        answer = self.ask(f"*IDN?;:{_JOURNAL}?")
        identity, _, entry_text = answer.rpartition(";")
        (entry,) = self._integers(entry_text, f"{_JOURNAL}?", 1)
        if identity != self._identity:
            self._in_step = False
            raise self._is_other(identity)
        if self._in_doubt is not None:
            doubtful, count = self._in_doubt
            self._may_come[doubtful] = count
            self._in_doubt = None
        self._is_anothers = entry not in (0, self._entry, *self._may_come)
        if not self._is_anothers:
            self._torn += self._may_come.pop(entry, 0)
            self._entry = entry
        while len(self._may_come) > MOST_MAY_COME:
            self._may_come.pop(next(iter(self._may_come)))

    def _is_other(self, identity: str) -> OtherInstrumentError:
        return OtherInstrumentError(
            f"{self.resource}: this is {_shown(identity)} now, not {self._identity!r}; a recording is of one meter:"
            " connect that one again, or stop and start anew",
            identity,
        )

    def _integers(self, answer: str, question: str, count: int) -> list[int]:
        try:
            numbers = [int(float(field)) for field in answer.split(";")]
            if len(numbers) != count or min(numbers) < 0:
                raise ValueError(answer)  # noqa: TRY301 - one message for every kind of nonsense
        except (ValueError, OverflowError) as error:
            self._in_step = False
            raise InstrumentError(
                f"{self.resource}: {question}: the answer {_shown(answer)} is not {count} numbers; look at its display"
            ) from error
        return numbers


def is_no_error(answer: str) -> bool:
    """Tell whether an answer to SYST:ERR? says that there is none."""
    return answer.lstrip("+").startswith("0,")


def _numbers_within(mask: int) -> tuple[int, ...]:
    """Return every number whose bits are all in the mask, ascending.

    >>> _numbers_within(0b1010)
    (0, 2, 8, 10)
    """
    numbers = [0]
    for bit in range(15):
        if mask >> bit & 1:
            numbers += [number | 1 << bit for number in numbers]
    return tuple(numbers)


def _shown(answer: str) -> str:
    return repr(answer if len(answer) <= 120 else answer[:117] + "...")
