"""Units of the inputs and outputs of exported code, which has one unit for all components of a
level.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def one_unit(unit: Any) -> str:
    """The unit that all components of a level have; "1" where they differ."""
    if isinstance(unit, str):
        return unit
    return unit[0] if len(set(unit)) == 1 else "1"


def per_time(unit: str, power: int) -> str:
    """A unit divided by s^power."""
    numerator, _, denominator = unit.partition("/")
    factors = denominator.split()
    for factor in factors:
        if factor == "s" or factor.startswith("s^"):
            power += int(factor[2:] or 1)
    others = [factor for factor in factors if factor != "s" and not factor.startswith("s^")]
    if power == 0:
        return unit
    others.append("s" if power == 1 else f"s^{power}")
    return f"{numerator}/({' '.join(others)})" if len(others) > 1 else f"{numerator}/{others[0]}"


def rate_units(name: str, units: Sequence[str]) -> dict[str, str]:
    """Names "name_1", "name_2", ... -> the units of the rates of the levels.

    Args:
      name: of the quantity.
      units: of the levels and of the input.
    """
    return {f"{name}_{i}": per_time(unit, 1) for i, unit in enumerate(units[:-1], start=1)}
