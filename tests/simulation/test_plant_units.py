"""Units, names and paths of plants in strict-feedback form, in parameters, signals and metrics."""

import numpy as np
import pytest
from plant_cases import ANGLES, body, pendulum

import iblf_jax as ij
from iblf_jax.presets.paper import customary_two_link as two_link
from iblf_jax.simulation.paths import get, unit_at
from iblf_jax.simulation.units import signal_meanings, signal_unit


@pytest.fixture(scope="module")
def pendulum_run():
    return ij.simulate(pendulum(), duration=0.5, dt=1e-3)


@pytest.fixture(scope="module")
def body_run():
    return ij.simulate(body(), duration=1.0, dt=1e-2)


PENDULUM_UNITS = {
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
}


def test_units_at_paths():
    scenario = pendulum()
    assert {path: unit_at(scenario, path) for path in PENDULUM_UNITS} == PENDULUM_UNITS


def test_units_of_components():
    scenario = body()
    assert unit_at(scenario, "reference.amplitude") == "m, m, rad"
    assert unit_at(scenario, "reference.amplitude[2]") == "rad"
    assert unit_at(scenario, "bounds.upper.value[0]") == "m"
    assert unit_at(scenario, "controller.weights[1][2]") == "s^2/rad^2"
    table = {p.path: p.unit for p in ij.parameters(scenario)}
    assert table["initial.dq"] == "m/s, m/s, rad/s"
    assert table["plant.mass"] == "kg"


def test_weights_of_a_plant_with_a_robot_are_energies():
    plant = ij.plants.FlexibleJoint(two_link(), stiffness=300.0, motor_inertia=0.02)
    law = ij.controllers.BarrierBackstepping(k=(3.0, 20.0, 60.0, 150.0))
    scenario = ij.Scenario(
        plant=plant,
        reference=ij.references.Sinusoid(offset=0.5, amplitude=0.3),
        bounds=ij.Bounds(lower=ij.bounds.Constant(-0.2), upper=ij.bounds.Constant(1.2)),
        controller=law,
        initial=ij.Initial(q=[0.7, 0.3]),
    )
    expected = "N m/rad; N m s^2/rad; N m/rad; N m s^2/rad"
    assert unit_at(scenario, "controller.weights") == expected


def test_an_estimate_has_the_units_of_the_levels_per_second():
    scenario = pendulum(observer=ij.observers.LevelObserver(gain=20.0, eta0=[0.0, 0.1, 0.0]))
    assert unit_at(scenario, "observer.eta0") == "rad/s; rad/s^2; A/s"
    assert unit_at(scenario, "observer.eta0[2]") == "A/s"


def test_a_barrier_without_a_unit_changes_the_units_of_c_and_weights():
    barriers = (ij.barriers.PrescribedPerformance(), *[ij.barriers.Quadratic()] * 2)
    law = ij.controllers.BarrierBackstepping(k=(3.0, 10.0, 30.0), barriers=barriers)
    scenario = pendulum(controller=law)
    assert unit_at(scenario, "controller.c") == "rad^2/s; 1/s; 1/s"
    assert unit_at(scenario, "controller.weights") == "1; s^2/rad^2; 1/A^2"


def test_levels_of_the_start_are_addressed_and_replaced():
    scenario = pendulum()
    changed = ij.with_parameters(scenario, {"initial.x[0]": 0.1, "initial.x[2][0]": 0.4})
    assert np.array_equal(changed.initial.x, [[0.1], [0.0], [0.4]])
    assert get(changed, "initial.x[2]").shape == (1,)
    assert "initial.x[2]" in [p.path for p in ij.parameters(scenario)]
    assert "initial.x[2]" not in [p.path for p in ij.parameters(scenario, named=False)]
    for path in ("initial.x[3]", "initial.x", "initial.x[0][1]"):
        with pytest.raises(ValueError, match="expected the path of a leaf"):
            get(scenario, path)


def test_a_robot_has_no_stacked_levels():
    paths = [p.path for p in ij.parameters(ij.presets.zhang_yan_2024())]
    assert not [path for path in paths if path.startswith("initial.x")]


@pytest.mark.slow
def test_metrics_have_the_units_of_the_plant(pendulum_run, body_run):
    units = pendulum_run.metrics.units
    assert units["ise"] == "rad^2 s"
    assert units["effort"] == "V^2 s"
    assert units["peak_torque"] == "V"
    assert units["estimate_rmse"] == "rad/s; rad/s^2; A/s"
    assert units["level_margin"] == "A"
    units = body_run.metrics.units
    assert units["ise"] == "m^2 s, m^2 s, rad^2 s"
    assert units["effort"] == "N^2 s, N^2 s, N^2 m^2 s"
    assert units["numerical_error"] == "m, m, rad"
    assert "m, m, rad" in repr(body_run.metrics)


@pytest.mark.slow
def test_signals_have_the_units_and_names_of_the_plant(pendulum_run):
    scenario = pendulum_run.scenario
    assert signal_unit(scenario, "tau") == "V"
    assert signal_unit(scenario, "x") == "rad; rad/s; A"
    assert signal_unit(body(), "e1", 2) == "rad"
    meanings = signal_meanings(scenario)
    assert meanings["q"] == "angle"
    assert meanings["dq_upper"] == "upper bound of speed"
    robot = ij.presets.zhang_yan_2024()
    assert signal_meanings(robot)["q"] == "joint position"
    assert signal_unit(robot, "disturbance") == "N m"


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
def test_the_violated_level_and_its_first_time():
    plain = ij.controllers.BarrierBackstepping(k=(3.0, 10.0, 30.0))
    bounds = ij.Bounds(lower=ij.bounds.Constant(-2.0), upper=ij.bounds.Constant(2.0))
    with pytest.warns(UserWarning, match="level 3|Level 3"):
        run = ij.simulate(
            pendulum(controller=plain, bounds=(ANGLES, None, bounds)), duration=0.5, dt=1e-3
        )
    current = np.asarray(run.x)[:, 2, 0]
    first = float(run.t[np.argmax(np.abs(current) >= 2.0)])
    assert run.metrics.first_level_violation_time == pytest.approx(first, abs=1e-9)
    assert run.metrics.first_level_violation_level == 3
    assert run.metrics.first_level_violation_component == 0
    assert run.metrics.level_margin[0, 0] == pytest.approx(2.0 - np.max(np.abs(current)))


@pytest.mark.slow
def test_a_law_of_robots_has_no_margin_of_higher_virtual_controls():
    robot = two_link()
    plant = ij.plants.FlexibleJoint(robot, stiffness=3e3, motor_inertia=0.02)
    rigid = ij.presets.zhang_yan_2024()
    wide = ij.Bounds(lower=ij.bounds.Constant(-5.0), upper=ij.bounds.Constant(5.0))
    scenario = ij.Scenario(
        plant=plant,
        model=robot,
        reference=rigid.reference,
        bounds=(rigid.bounds[0], None, wide),
        controller=rigid.controller,
        initial=ij.Initial(q=[0.8, 0.8]),
    )
    with pytest.warns(UserWarning, match="a bound was violated"):
        run = ij.simulate(scenario, duration=0.05, dt=2e-4)
    assert "level_margin" in run.metrics
    assert "level_alpha_margin" not in run.metrics
    assert run.metrics.units["estimate_rmse"] == "N m"
    assert np.all(np.isinf(run.metrics.level_margin[1]))  # level 4 has no bounds


@pytest.mark.slow
def test_the_input_above_gravity_is_that_of_the_plant():
    robot = two_link()
    motor = {"torque_constant": 0.5, "inductance": 0.01, "resistance": 0.5, "back_emf": 0.1}
    plant = ij.plants.ElectricDrive(robot, **motor)
    at_rest = ij.references.Sinusoid(offset=0.5, amplitude=0.0)
    scenario = ij.Scenario(
        plant=plant,
        reference=at_rest,
        bounds=ij.Bounds(lower=ij.bounds.Constant(-0.2), upper=ij.bounds.Constant(1.2)),
        controller=ij.controllers.BarrierBackstepping(k=(3.0, 20.0, 60.0)),
        initial=ij.Initial(q=[0.5, 0.5]),
    )
    folds = (ij.metrics.AboveGravity(), ij.metrics.Torque())
    run = ij.simulate(scenario, duration=0.1, dt=1e-3, metrics=folds)
    assert run.metrics.units["effort_above_gravity"] == "V"
    assert float(run.metrics.effort_above_gravity) < 1e-9 * float(np.max(run.metrics.torque_rms))
