"""Units of quantities that depend on the plant.

A signal, a metric or a parameter of a robot is in rad, rad/s or N m; those of another plant are in
the units of its levels and of its input.  Such a quantity declares a `PlantUnit`: the text of its
unit for a robot, and a formula in these symbols.

    x1 ... xr       units of the levels
    last            unit of the last level
    levels, higher  units of all levels, and of those from the third on, one a level
    rates           units of the rates of all levels, one a level
    u               unit of the input
    f               unit of the uncertain term: a torque, or the rates
    tau             unit of a disturbance's torque
    energy          unit of sum w_i V_i

`resolved` evaluates the formula with the units of one plant, and `as_text` writes the result.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction
from typing import Any, TypeAlias

from iblf_jax.core.caches import memoised

Exponents: TypeAlias = dict[str, Fraction]
"""Name of a factor of a unit -> its exponent."""
TEXTS = 512
"""Results that are kept of each function of texts: the metrics of a run have some fifty.  Tuples of
units are no keys: a `ByLevel` equals a tuple of the same entries."""


class ByLevel(tuple):
    """One unit for each of several levels."""

    __slots__ = ()


class PlantUnit(str):
    """A unit that depends on the plant; as a text it is the unit for a robot.

    Args:
      of_robot: the unit for a robot, such as "rad^2 s".
      formula: the same unit in symbols (head of this module), such as "x1^2 s".
    """

    formula: str

    def __new__(cls, of_robot: str, formula: str) -> PlantUnit:
        """The text with its formula."""
        unit = super().__new__(cls, of_robot)
        unit.formula = formula
        return unit

    def __getnewargs__(self) -> tuple[str, str]:  # type: ignore[override]
        """The arguments with which a copy is made."""
        return str(self), self.formula


Unit: TypeAlias = str | tuple[Any, ...]
"""One unit for all components, one for each component, or, as a `ByLevel`, either of these for each
level."""

POSITION = PlantUnit("rad", "x1")
VELOCITY = PlantUnit("rad/s", "x2")
LAST_LEVEL = PlantUnit("rad/s", "last")
INPUT = PlantUnit("N m", "u")
UNCERTAIN = PlantUnit("N m", "f")
TORQUE = PlantUnit("N m", "tau")
HIGHER = PlantUnit("1", "higher")
LEVELS = PlantUnit("1", "levels")
RATES = PlantUnit("1", "rates")

ROBOT: Mapping[str, Unit] = {
    "x1": "rad",
    "x2": "rad/s",
    "last": "rad/s",
    "levels": ByLevel(("rad", "rad/s")),
    "higher": "1",
    "rates": ByLevel(("rad/s", "rad/s^2")),
    "u": "N m",
    "f": "N m",
    "tau": "N m",
    "energy": "N m rad",
}
"""The units of a robot, by symbol."""


def resolved(unit: Unit, units: Mapping[str, Unit]) -> Unit:
    """A unit with the symbols of its formula replaced; a plain text stays as it is.

    Args:
      unit: a text, a `PlantUnit`, or several of them.
      units: symbol -> its unit for the plant.
    """
    if isinstance(unit, tuple):
        return type(unit)(resolved(entry, units) for entry in unit)
    if not isinstance(unit, PlantUnit):
        return unit
    found: Unit = "1"
    for name, exponent in _symbols(unit.formula):
        found = product(found, power(units.get(name, name), exponent))
    return found


def power(unit: Unit, exponent: int | Fraction) -> Unit:
    """A unit to a power."""
    if isinstance(unit, tuple):
        return type(unit)(power(entry, exponent) for entry in unit)
    return _power_of_text(str(unit), Fraction(exponent))


@memoised(TEXTS)
def _power_of_text(unit: str, exponent: Fraction) -> str:
    """A unit of one text to a power."""
    return written({name: exponent * k for name, k in exponents(unit).items()})


def product(first: Unit, second: Unit) -> Unit:
    """The product of two units, for each level and each component that one of them has."""
    # A level may have components, and never the reverse: levels are divided first.
    for kind in (ByLevel, tuple):
        several = [unit for unit in (first, second) if isinstance(unit, kind)]
        if several:
            count = len(several[0])
            rows = zip(_entries(first, kind, count), _entries(second, kind, count), strict=True)
            return kind(product(a, b) for a, b in rows)
    return _product_of_texts(str(first), str(second))


@memoised(TEXTS)
def _product_of_texts(first: str, second: str) -> str:
    """The product of two units of one text each."""
    total = exponents(first)
    for name, exponent in exponents(second).items():
        total[name] = total.get(name, Fraction(0)) + exponent
    return written(total)


def _entries(unit: Unit, kind: type, count: int) -> tuple:
    """The entries of a unit of this kind; another unit is repeated."""
    if isinstance(unit, tuple) and isinstance(unit, kind):
        return unit
    return (unit,) * count


def per_second(unit: Unit) -> Unit:
    """The unit of a rate."""
    return product(unit, "1/s")


@memoised(TEXTS)
def _symbols(formula: str) -> tuple[tuple[str, Fraction], ...]:
    """The symbols of a formula and their exponents."""
    return tuple(exponents(formula).items())


def exponents(unit: str) -> Exponents:
    """The factors of a unit such as "N m s/rad" or "m^0.5", with their exponents."""
    found: Exponents = {}
    numerator, _, denominator = unit.partition("/")
    for sign, factors in ((1, numerator), (-1, denominator)):
        for factor in re.split(r"[\s()/]+", factors):
            name, caret, exponent = factor.rpartition("^")
            if not caret or not re.fullmatch(r"\d+(\.\d+)?", exponent):
                name, exponent = factor, "1"
            if name not in ("", "1"):
                found[name] = found.get(name, Fraction(0)) + sign * Fraction(exponent)
    return found


def written(factors: Exponents) -> str:
    """A unit from its factors, those with negative exponents after a "/"."""
    above = " ".join(_factor(name, k) for name, k in factors.items() if k > 0)
    below = [_factor(name, -k) for name, k in factors.items() if k < 0]
    if not below:
        return above or "1"
    denominator = below[0]
    if len(below) > 1:
        denominator = f"({' '.join(below)})"
    return f"{above or '1'}/{denominator}"


def _factor(name: str, exponent: Fraction) -> str:
    """A factor with its exponent, such as "s^2" or "m^0.5"."""
    if exponent == 1:
        return name
    return f"{name}^{float(exponent):g}"


def as_text(unit: Unit) -> str:
    """A unit for tables and axes: components that differ are joined by ", ", levels by "; "."""
    if isinstance(unit, str):
        return str(unit)
    texts = [as_text(entry) for entry in unit]
    if not texts:
        return "1"
    if len(set(texts)) == 1:
        return texts[0]
    if isinstance(unit, ByLevel):
        return "; ".join(texts)
    return ", ".join(texts)


def of_component(unit: Unit, component: int) -> Unit:
    """The unit of one component, of one level or of every level."""
    if isinstance(unit, ByLevel):
        return ByLevel(of_component(entry, component) for entry in unit)
    if isinstance(unit, str):
        return unit
    return unit[component]


def of_entry(unit: Unit, index: tuple[int, ...], dimensions: int) -> Unit:
    """The unit of an entry, or of a row, of an array.

    Args:
      unit: of the array.
      index: of the entry, along the first axes.
      dimensions: number of axes of the array, of which the last one counts components.
    """
    if isinstance(unit, ByLevel) and index:
        unit = unit[index[0]]
    if len(index) < dimensions or not index:
        return unit
    return of_component(unit, index[-1])
