"""What every estimator is: blocks of readings in, estimates out, the same bits however the stream was cut."""

from typing import Protocol

from aemd.block import Block, Estimates

__all__ = ["Estimator"]


class Estimator(Protocol):
    """An online estimator of the true input s_k.

    One estimate comes out for each reading that went in, in order; an estimator with a lag of L readings returns the
    estimate of reading k once reading k + L has come. For any cutting of a stream into blocks, the concatenated output
    of `push` and the final `flush` has the same bits.
    """

    @property
    def name(self) -> str:
        """The word that chooses it: `--estimator NAME`."""

    @property
    def lag(self) -> int:
        """Readings by which the estimate trails; 0 for a filter."""

    def push(self, block: Block) -> Estimates:
        """Take readings, array of READING (n,); return the estimates that are ready, array of ESTIMATE (m,)."""

    def flush(self) -> Estimates:
        """Return the estimates that the lag still holds back; the stream has ended."""
