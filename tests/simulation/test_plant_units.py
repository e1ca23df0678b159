"""Units, names and paths of plants in strict-feedback form, in parameters, signals and metrics."""

import numpy as np
import pytest
from loops_of_plants import band, electric_drive, flexible_joint
from plant_cases import body, pendulum

import iblf_jax as ij
from iblf_jax.simulation.paths import get, unit_at


@pytest.fixture(scope="module")
def pendulum_run():
    return ij.simulate(pendulum(), duration=0.5, dt=1e-3)


UNITLESS = ij.controllers.BarrierBackstepping(
    k=(3.0, 10.0, 30.0),
    barriers=(ij.barriers.PrescribedPerformance(), *[ij.barriers.Quadratic()] * 2),
)
"""A law whose first barrier has no unit, which changes those of c and of the weights."""
UNITS = {
    "pendulum": (
        lambda: pendulum(observer=ij.observers.LevelObserver(gain=20.0, eta0=[0.0, 0.1, 0.0])),
        {
            "reference.amplitude": "rad",
            "reference.phase": "rad",
            "bounds.lower.value": "rad",
            "bounds[0].lower.value": "rad",
            "bounds[1].lower.value": "rad/s",
            "bounds[2].upper.value[0]": "A",
            "disturbance.parts[1].amplitude": "rad/s^2",
            "disturbance.parts[1].frequency": "rad/s",
            "controller.k[2][0]": "1/s",
            "controller.weights[2]": "1/A^2",
            "initial.higher": "A",
            "initial.x[1]": "rad/s",
            "initial.x[2][0]": "A",
            "initial.x[-1]": "A",
            "observer.eta0": "rad/s; rad/s^2; A/s",
            "observer.eta0[2]": "A/s",
        },
    ),
    "body": (
        body,
        {
            "reference.amplitude": "m, m, rad",
            "reference.amplitude[2]": "rad",
            "bounds.upper.value[0]": "m",
            "controller.weights[1][2]": "s^2/rad^2",
            "initial.dq": "m/s, m/s, rad/s",
            "plant.mass": "kg",
        },
    ),
    "a robot with springs": (
        flexible_joint,
        {"controller.weights": "N m/rad; N m s^2/rad; N m/rad; N m s^2/rad"},
    ),
    "a barrier without a unit": (
        lambda: pendulum(controller=UNITLESS),
        {"controller.c": "rad^2/s; 1/s; 1/s", "controller.weights": "1; s^2/rad^2; 1/A^2"},
    ),
}


@pytest.mark.parametrize("case", UNITS)
def test_units_at_paths(case):
    make, units = UNITS[case]
    scenario = make()
    assert {path: unit_at(scenario, path) for path in units} == units
    table = {p.path: p.unit for p in ij.parameters(scenario)}
    assert all(table[path] == unit for path, unit in units.items() if path in table)


def test_levels_of_the_start_are_addressed_and_replaced():
    scenario = pendulum()
    changed = ij.with_parameters(scenario, {"initial.x[0]": 0.1, "initial.x[2][0]": 0.4})
    assert np.array_equal(changed.initial.x, [[0.1], [0.0], [0.4]])
    assert get(changed, "initial.x[2]").shape == (1,)
    assert "initial.x[2]" in [p.path for p in ij.parameters(scenario)]
    robot = ij.parameters(ij.presets.zhang_yan_2024())
    for table in (robot, ij.parameters(scenario, named=False)):
        assert not [p.path for p in table if p.path.startswith("initial.x[")]
    for path in ("initial.x[3]", "initial.x", "initial.x[0][1]"):
        with pytest.raises(ValueError, match="expected the path of a leaf"):
            get(scenario, path)


def test_margins_of_all_levels(pendulum_run):
    x, alpha = np.asarray(pendulum_run.x), np.asarray(pendulum_run.x - pendulum_run.e)
    metrics = pendulum_run.metrics
    margin = np.min(20.0 - np.abs(x[:, 2:]), axis=0)
    assert np.allclose(metrics.level_margin, margin, rtol=1e-12)
    of_alpha = np.min(20.0 - np.abs(alpha[:, 2:]), axis=0)
    assert np.allclose(metrics.level_alpha_margin, of_alpha, rtol=1e-12)
    assert np.allclose(metrics.velocity_margin, np.min(3.0 - np.abs(x[:, 1]), axis=0))
    assert np.allclose(metrics.alpha_margin, np.min(3.0 - np.abs(alpha[:, 1]), axis=0))
    assert metrics.first_level_violation_time == np.inf
    assert metrics.first_level_violation_level == -1


@pytest.mark.slow
def test_the_input_above_gravity_is_that_of_the_plant():
    """A motor-driven arm at rest takes the voltage that holds it, and nothing above."""
    law = ij.controllers.BarrierBackstepping(k=(3.0, 20.0, 60.0))
    at_rest = ij.references.Sinusoid(offset=0.5, amplitude=0.0)
    parts = {"reference": at_rest, "bounds": band(-0.2, 1.2), "initial": ij.Initial(q=[0.5, 0.5])}
    folds = (ij.metrics.AboveGravity(), ij.metrics.Torque())
    scenario = electric_drive(controller=law, **parts)
    metrics = ij.simulate(scenario, duration=0.1, dt=1e-3, metrics=folds).metrics
    assert metrics.units["effort_above_gravity"] == "V"
    assert float(metrics.effort_above_gravity) < 1e-9 * float(np.max(metrics.torque_rms))
