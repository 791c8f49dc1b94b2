"""Driver of the Agilent/Keysight 34410A: DC volts at equal intervals, drained without a gap."""

from agilent34410.characterise import characterise
from agilent34410.meter import open_instrument
from agilent34410.options import Options

__all__ = ["Options", "characterise", "open_instrument"]
