"""One part of a stated model with other figures than stated: the rival of every mechanism when a model is criticised.

A white noise that is a third larger than stated bends the residuals' spectrum like a smoothing, tells on their squares
like a changing noise, and so on through the catalogue. So each part of the stated model is fitted beside the mechanisms
that could explain the same, and where it explains as much, no mechanism is invented.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import exp, inf, log
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aemd import model
from aemd.diagnose.given import Given
from aemd.diagnose.hypothesis import Bounds, Data, Parameter, Parts
from aemd.diagnose.terms.lines import amplitude_cost

__all__ = ["OtherFigures", "other_figures"]

Floats = NDArray[np.float64]

_FIGURES: dict[type, tuple[tuple[str, str], ...]] = {
    model.WhiteNoise: (("density_V_per_rt_hz", ""),),  # told as the deviation of a reading
    model.GaussMarkov: (("rate_V_per_rt_s", "V/rt s"), ("tau_s", "s")),
    model.Shocks: (("rate_per_s", "1/s"), ("sd_V", "V"), ("decay_s", "s")),
    model.Resonance: (("sd_V", "V"), ("quality", "")),
    model.FlickerNoise: (("amplitude_V", "V"),),
    model.DifferenceNoise: (("sd_V", "V"),),
    model.HeavyTails: (("sd_V", "V"),),
    model.SignalDependentNoise: (("fraction", ""),),
}
"""Figures that are fitted, each a factor on what is stated, and their units."""
_ODDS = log(20)
"""Of a figure that is not quite as stated, against a mechanism that nobody has stated. A judgement: figures are
measured another day, on another range, or read off a data sheet."""
_FACTOR: Bounds = (log(1e-3), log(1e3))


def other_figures(given: Given, n: int) -> Iterator["OtherFigures"]:
    """Yield each part of a stated model whose figures can be fitted, to `n` readings."""
    for number, part in enumerate((*given.stated.terms, *given.stated.effects)):
        keys = tuple(key for key, _ in _FIGURES.get(type(part), ()) if 0 < getattr(part, key) < inf)
        if isinstance(part, model.Level):
            yield OtherFigures(given, number, (), amplitude_cost(1, n) - _ODDS)
        for some in dict.fromkeys([*((key,) for key in keys), keys] if keys else []):
            yield OtherFigures(given, number, some, amplitude_cost(len(some), n) - _ODDS)


@dataclass(frozen=True, slots=True)
class OtherFigures:
    """The difference that other figures of one part make; free numbers the logarithms of their factors.

    Of a level, what is added to it.
    """

    given: Given
    number: int
    """Of the part, terms first and effects after them."""
    keys: tuple[str, ...]
    """Of the figures that are fitted; none of a level."""
    cost_nats: float

    @property
    def part(self) -> Any:
        """The part as stated."""
        return (*self.given.stated.terms, *self.given.stated.effects)[self.number]

    @property
    def what(self) -> str:
        """What the part is, in words."""
        name = str(getattr(self.part, "term", "") or getattr(self.part, "effect", "")).replace("_", " ")
        if isinstance(self.part, model.GaussMarkov):
            name = "signal" if self.part.role == "signal" else "internal drift"
        return name

    @property
    def cause(self) -> str:
        """A word of its own among its rivals; no mechanism of the catalogue."""
        return " ".join(("stated", self.what, str(self.number), *self.keys))

    @property
    def start(self) -> Floats:
        """As stated."""
        return np.zeros(max(len(self.keys), 1))

    @property
    def bounds(self) -> Sequence[Bounds]:
        """A factor of a thousand; a level is free."""
        return [_FACTOR] * len(self.keys) or [(-1e9, 1e9)]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Put the part with other figures in the place of the stated one."""
        if isinstance(self.part, model.Level):
            parts.mean += theta[0]
            return
        old, new = (self._alone(part, data) for part in (self.part, self.made(theta, data)))
        parts.mean += new.mean - old.mean
        parts.noise_var += new.noise_var - old.noise_var
        parts.extras = np.where(new.extras != old.extras, new.extras, parts.extras)
        if old.tails:  # there is one such noise at most
            parts.tails = new.tails
        count = len(old.states)
        for at in range(len(parts.states) - count + 1):
            if count and parts.states[at : at + count] == old.states:
                parts.states[at : at + count] = new.states
                break
        if isinstance(self.part, model.Shocks):
            parts.shocks = np.array([*new.shocks[:2], parts.shocks[2]])
            parts.struck = [0.0] * int(parts.shocks[2]) + new.struck

    def made(self, theta: Floats, data: Data) -> Any:
        """Return the part with these figures."""
        if isinstance(self.part, model.Level):
            return replace(self.part, level_V=self.part.level_V + float(theta[0]) * data.unit_V)
        changed = {key: getattr(self.part, key) * exp(value) for key, value in zip(self.keys, theta, strict=True)}
        return replace(self.part, **changed)

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the figures as fitted, in the part's own units."""
        part = self.part
        if isinstance(part, model.Level):
            return [Parameter("level_V", "V", lambda v: part.level_V + v[0] * data.unit_V, positive=False)]
        if isinstance(part, model.WhiteNoise):
            return [Parameter("sd_V", "V", lambda v: part.sd(self.given.aperture_s) * exp(v[0]))]
        units = dict(_FIGURES[type(part)])
        return [
            Parameter(key, units[key], lambda v, at=at, key=key: getattr(part, key) * exp(v[at]))  # type: ignore[misc] # binds the loop's
            for at, key in enumerate(self.keys)
        ]

    def _alone(self, part: Any, data: Data) -> Parts:
        """Return what one part gives to the filter."""
        alone = Parts(np.zeros(data.y.size), np.zeros(data.y.size), np.ones(data.y.size))
        effect = hasattr(part, "effect")
        stated = model.Model(() if effect else (part,), 1, (part,) if effect else ())
        replace(self.given, stated=stated).add(np.empty(0), data, alone)
        return alone
