"""Units that follow the plant: their algebra, and the texts that robots keep."""

import dataclasses
import pickle

import iblf_jax as ij
from iblf_jax.core import units
from iblf_jax.simulation import metrics
from iblf_jax.simulation.error_estimate import ACCURACY_UNITS
from iblf_jax.simulation.signals import SIGNALS
from iblf_jax.tuning.quantities import TUNED_SIGNALS, TimeIntegral

VESSEL = {"x1": ("m", "m", "rad"), "u": ("N", "N", "N m")}
OF_SEVERAL_LEVELS = ("higher", "levels", "rates")


def _declared() -> list[tuple[str, units.PlantUnit]]:
    """Where a `PlantUnit` is declared in this package, and the unit."""
    found = [(name, signal.unit) for name, signal in SIGNALS.items()]
    found += [pair for fold in metrics.MEMBERS.values() for pair in fold.units.items()]
    found += [*ACCURACY_UNITS, *TUNED_SIGNALS.items(), *TimeIntegral.units.items()]
    families = (ij.references, ij.bounds, ij.disturbances, ij.sensors, ij.actuators, ij.controllers)
    kinds = [kind for family in families for kind in vars(family).values()]
    for kind in [*kinds, ij.Initial, metrics.Settling]:
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            fields = dataclasses.fields(kind)
            found += [(f"{kind.__name__}.{f.name}", f.metadata.get("unit", "")) for f in fields]
    return [(name, unit) for name, unit in found if isinstance(unit, units.PlantUnit)]


def test_every_formula_gives_the_unit_of_a_robot():
    declared = _declared()
    assert len(declared) > 50
    for name, unit in declared:
        if unit.formula not in OF_SEVERAL_LEVELS:
            assert units.as_text(units.resolved(unit, units.ROBOT)) == str(unit), name


def test_a_unit_is_read_and_written_and_has_products_powers_and_rates():
    for unit in ("1", "rad", "N m s/rad", "N^2 m^2 s", "rad/(N m s)", "1/s"):
        assert units.written(units.exponents(unit)) == unit
    assert units.product("N m s", "1/s") == "N m"
    assert units.power("rad/s", 2) == "rad^2/s^2"
    assert units.per_second(("m", "rad")) == ("m/s", "rad/s")
    by_level = units.ByLevel(("m", ("m/s", "rad/s")))
    assert units.product(by_level, ("s", "A")) == units.ByLevel((("m s", "m A"), ("m", "rad A/s")))
    assert units.per_second("m^0.5") == "m^0.5/s"
    assert [units.power("m^0.5", n) for n in (2, -2)] == ["m", "1/m"]
    assert units.product("m^0.5", "m^0.5/s") == "m/s"
    assert units.power("m^1.5", 3) == "m^4.5"


def test_components_levels_and_entries_are_resolved_and_shown():
    ise = units.resolved(units.PlantUnit("rad^2 s", "x1^2 s"), VESSEL)
    assert ise == ("m^2 s", "m^2 s", "rad^2 s")
    assert units.as_text(ise) == "m^2 s, m^2 s, rad^2 s"
    assert units.as_text(units.resolved(units.INPUT, VESSEL)) == "N, N, N m"
    assert units.as_text(units.ByLevel((("m", "rad"), "A"))) == "m, rad; A"
    assert units.as_text(("A", "A")) == "A"
    assert units.resolved("rad", VESSEL) == "rad"  # a plain text is a unit of its own
    assert pickle.loads(pickle.dumps(units.INPUT)) == units.INPUT and units.INPUT.formula == "u"
    weights = units.ByLevel((("m", "rad"), ("m/s", "rad/s")))
    assert units.of_entry(weights, (1,), 2) == ("m/s", "rad/s")
    assert units.of_entry(weights, (1, 1), 2) == "rad/s"
    assert units.of_entry(("m", "rad"), (1,), 1) == "rad"
    assert units.of_entry(("m", "rad"), (3,), 2) == ("m", "rad")  # a row of waypoints
