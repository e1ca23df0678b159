"""The period of a scenario whose time-varying parts are constants and sinusoids."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from iblf_jax.world import bounds, disturbances, references

LARGEST_RATIO = 1000
"""Largest quotient of a frequency by the common one for which a common period is used."""

FREQUENCIES: dict[type, tuple[tuple[str, str], ...]] = {
    references.Sinusoid: (("amplitude", "frequency"),),
    bounds.Sinusoid: (("amplitude", "frequency"),),
    disturbances.Sinusoids: (("amplitude", "frequency"),),
    disturbances.TipForce: (("amplitude", "frequency"),),
    disturbances.ModelShaped: (
        ("acceleration_amplitude", "acceleration_frequency"),
        ("velocity_amplitude", "velocity_frequency"),
    ),
}
"""Periodic members -> their fields of amplitudes and frequencies."""
CONSTANT = (bounds.Constant, disturbances.Nothing, disturbances.Friction, type(None))
"""Members that do not depend on time, and the type of a part that is missing."""


class AperiodicError(ValueError):
    """A part of a scenario has no period, or none in common with the others."""


def period_of(parts: dict[str, Any], uncertain: Sequence[str] = ()) -> float:
    """The common period of parts of a scenario [s]; 0 if none depends on time.

        2 pi / w,   w the greatest common divisor of all frequencies

    Frequencies are compared as the exact numbers that they are.

    Args:
      parts: name -> reference, bounds, or disturbance.
      uncertain: paths of uncertain numbers.  All frequencies of a part with one of them count,
        because its amplitudes may be uncertain.

    Raises:
      AperiodicError: a part that is neither constant nor a sinusoid, an uncertain frequency, or
        frequencies without a common divisor; the message says which.
    """
    for path in uncertain:
        if "frequency" in path.rpartition(".")[2]:
            raise AperiodicError(f"the frequency {path} is uncertain")
    varied = {path.split(".")[0] for path in uncertain}
    frequencies = {
        Fraction(w)
        for name, part in parts.items()
        for w in _frequencies(name, part, all_count=name in varied)
        if w
    }
    if not frequencies:
        return 0.0
    denominator = math.lcm(*(w.denominator for w in frequencies))
    common = Fraction(math.gcd(*(int(w * denominator) for w in frequencies)), denominator)
    if max(frequencies) / common > LARGEST_RATIO:
        listed = ", ".join(f"{float(w):g}" for w in sorted(frequencies))
        raise AperiodicError(f"the frequencies {listed} rad/s have no common divisor")
    return 2.0 * math.pi / float(common)


def _frequencies(name: str, part: Any, *, all_count: bool) -> Iterator[float]:
    """The absolute frequencies of a part whose amplitude is not zero, or all of them."""
    if type(part) is disturbances.Sum:
        for i, inner in enumerate(part.parts):
            yield from _frequencies(f"{name}.parts[{i}]", inner, all_count=all_count)
        return
    if type(part) is disturbances.Levels:
        for i, of_level in enumerate(part.parts):
            yield from _frequencies(f"{name}.parts[{i}]", of_level, all_count=all_count)
        return
    if type(part) is bounds.Bounds:
        for side in ("lower", "upper"):
            yield from _frequencies(f"{name}.{side}", vars(part)[side], all_count=all_count)
        return
    if type(part) in CONSTANT:
        return
    if type(part) not in FREQUENCIES:
        raise AperiodicError(f"the period of {name} ({type(part).__name__}) is not known")
    for fields in FREQUENCIES[type(part)]:
        amplitude, frequency = (np.asarray(getattr(part, field)) for field in fields)
        for size, w in np.broadcast(amplitude, frequency):
            if size or all_count:
                yield abs(float(w))


def shifted(part: Any, t: float) -> Any:
    """A part of `period_of` as it is t [s] later: part at time s is the result at time s - t.  Any
    part is its own after 0 s.
    """
    if t == 0.0:
        return part
    if type(part) is disturbances.Sum:
        return disturbances.Sum(tuple(shifted(inner, t) for inner in part.parts))
    if type(part) is disturbances.Levels:
        return disturbances.Levels(tuple(shifted(inner, t) for inner in part.parts))
    if type(part) is bounds.Bounds:
        lower, upper = shifted(part.lower, t), shifted(part.upper, t)
        return dataclasses.replace(part, lower=lower, upper=upper)
    if type(part) in CONSTANT:
        return part
    if type(part) not in FREQUENCIES:
        raise AperiodicError(f"{type(part).__name__} cannot be moved in time")
    phases = {
        frequency.replace("frequency", "phase"): frequency
        for _, frequency in FREQUENCIES[type(part)]
    }
    fields = vars(part)
    new = {phase: fields[phase] + fields[frequency] * t for phase, frequency in phases.items()}
    return dataclasses.replace(part, **new)
