"""Units, names, paths, signals and metrics of plants in strict-feedback form."""

import numpy as np
import pytest
from loops_of_plants import band, electric_drive, flexible_joint
from plant_cases import ANGLES, body, pendulum, symmetric
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.simulation.paths import get, unit_at
from iblf_jax.simulation.signals import FIELDS, SIGNALS, VIEWS

SHORT = {"duration": 0.02, "dt": 1e-3}
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
        assert_refused("expected the path of a leaf", get, scenario, path)


def test_margins_of_all_levels():
    run = ij.simulate(pendulum(), duration=0.5, dt=1e-3)
    metrics = run.metrics
    for x, of_level, of_velocity in (
        (run.x, metrics.level_margin, metrics.velocity_margin),
        (run.x - run.e, metrics.level_alpha_margin, metrics.alpha_margin),
    ):
        largest = np.max(np.abs(x), axis=0)
        assert np.allclose(of_level, 20.0 - largest[2:], rtol=1e-12)
        assert np.allclose(of_velocity, 3.0 - largest[1])
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


@pytest.mark.slow
@pytest.mark.parametrize("above", [(), (None, symmetric(90.0))])
def test_views_are_rows_and_bounds_end_with_the_last_level_that_has_some(above):
    law = ij.controllers.BarrierBackstepping(k=(3.0, 10.0, 30.0))
    run = ij.simulate(pendulum(controller=law, bounds=(ANGLES, *above)), **SHORT)
    samples = run.t.size
    assert run.x.shape == run.e.shape == (samples, 3, 1)
    assert run.level_lower.shape == run.level_upper.shape == (samples, 1 + len(above), 1)
    for name, view in VIEWS.items():
        rows = np.asarray(getattr(run, view.signal))
        expected = rows[:, view.row] if view.row < rows.shape[1] else ()
        np.testing.assert_array_equal(getattr(run, name), expected, err_msg=name)
    if above:
        assert np.all(np.isneginf(run.dq_lower)) and np.all(np.isposinf(run.dq_upper))
        np.testing.assert_array_equal(run.level_upper[:, 2], 90.0)


def test_the_errors_of_a_robot_have_two_rows_and_every_signal_a_unit_and_a_meaning():
    robot = ij.simulate(ij.presets.zhang_yan_2024(), **SHORT)
    assert robot.x.shape == robot.e.shape == (21, 2, 2)
    np.testing.assert_array_equal(robot.e1, robot.q - robot.q_d)
    np.testing.assert_allclose(robot.e2, robot.dq - robot.alpha, rtol=0, atol=1e-15)
    assert set(SIGNALS) == {*FIELDS, *VIEWS}
    assert all(signal.unit and signal.meaning for signal in SIGNALS.values())
