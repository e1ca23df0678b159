"""Messages about the levels of a plant in strict-feedback form: which one, when, and what to do."""

import dataclasses

import jax.numpy as jnp
import pytest
from plant_cases import ANGLES, body, pendulum, symmetric

import iblf_jax as ij
from iblf_jax.core.status import Status
from iblf_jax.engine import diagnosis
from iblf_jax.engine.diagnosis import SimulationWarning

TransformedError, Quadratic = ij.barriers.TransformedError, ij.barriers.Quadratic
WIDE = symmetric(999.0)


def law(*barriers):
    return ij.controllers.BarrierBackstepping(k=(3.0, 10.0, 30.0), barriers=barriers)


def message_of(scenario, duration=0.5, dt=1e-3) -> str:
    """The warning about a run, after those about the scenario."""
    with pytest.warns(SimulationWarning) as found:
        ij.simulate(scenario, duration=duration, dt=dt)
    (text,) = [str(w.message) for w in found if w.category is SimulationWarning]
    return text


@pytest.mark.slow
def test_a_violated_level_is_named_with_time_margin_unit_and_remedy():
    plain = law(TransformedError(), Quadratic(), Quadratic())
    text = message_of(pendulum(controller=plain, bounds=(ANGLES, WIDE, symmetric(2.0))))
    assert "Level 3 (current) of pendulum left its bounds first, at t = 0.0" in text
    assert " A. The law has barriers.Quadratic() on that level" in text
    assert "give it barriers.TransformedError() there" in text


@pytest.mark.slow
def test_a_violated_second_level_has_the_unit_of_the_level():
    plain = law(TransformedError(), Quadratic(), Quadratic())
    text = message_of(pendulum(controller=plain, bounds=(ANGLES, symmetric(0.1), WIDE)))
    assert "a bound of the second level was violated" in text
    assert "Level 2 (speed) of pendulum left its bounds first" in text
    assert "rad/s. The law has barriers.Quadratic()" in text
    assert "velocity bounds" not in text


@pytest.mark.slow
def test_a_virtual_control_outside_its_level_is_reported_like_assumption_2():
    plain = law(TransformedError(), Quadratic(), Quadratic())
    scenario = pendulum(controller=plain, bounds=(ANGLES, symmetric(3.0), symmetric(2.0)))
    run = None
    with pytest.warns(SimulationWarning, match="Assumption 2") as found:
        run = ij.simulate(scenario, duration=0.5, dt=1e-3)
    text = str(found[0].message)
    worst = -float(run.metrics.level_alpha_margin[0, 0])
    alpha = run.x[:, 2, 0] - run.e[:, 2, 0]
    first = float(run.t[jnp.argmax(jnp.abs(alpha) >= 2.0)])
    assert f"left the bounds by up to {worst:.3g} A, first at t = {first:.4g} s" in text
    assert "Alpha_2, the virtual control for level 3" in text
    assert "Alpha_1" not in text  # it stays inside the bounds of level 2
    assert "widen the bounds of the level or lower controller.k" in text


@pytest.mark.slow
def test_a_law_of_robots_is_told_who_keeps_the_bounds_of_levels():
    rigid = ij.presets.zhang_yan_2024()
    plant = ij.plants.FlexibleJoint(rigid.plant, stiffness=3e3, motor_inertia=0.02)
    scenario = ij.Scenario(
        plant=plant,
        model=rigid.plant,
        reference=rigid.reference,
        bounds=(rigid.bounds[0], None, None, symmetric(0.5)),
        controller=rigid.controller,
        initial=rigid.initial,
    )
    text = message_of(scenario, duration=0.05, dt=2e-4)
    assert "Level 4 (motor velocity) of joint" in text
    assert "controllers.BarrierBackstepping keeps them" in text


@pytest.mark.slow
def test_a_gain_that_becomes_singular_is_named():
    def gain(t, x):
        one = jnp.ones_like(x[0])
        return jnp.stack([one, jnp.where(x[0] > 0.45, 0.0, 1.0), one])

    plant = ij.plants.StrictFeedback(
        drift=lambda t, x: jnp.zeros_like(x), gain=gain, n=1, order=3, level_names=("a", "b", "c")
    )
    scenario = pendulum(
        plant=plant,
        bounds=ANGLES,
        controller=law(TransformedError(), Quadratic(), Quadratic()),
        disturbance=ij.disturbances.Nothing(),
    )
    with pytest.warns(SimulationWarning) as found:
        run = ij.simulate(scenario, duration=1.5, dt=1e-3)
    assert int(run.status) & Status.SINGULAR_GAIN
    text = str(found[0].message)
    assert "the law's input was not finite" in text
    assert "the gain of level 2 (b) is singular" in text
    assert "bound the levels so that they stay away" in text


@pytest.mark.slow
def test_an_inaccurate_run_names_the_unit_of_the_worst_component():
    text = message_of(body(), duration=10.0, dt=0.5)
    assert "the components of the first level are inaccurate" in text
    assert " m, " in text
    assert " rad, " not in text


@pytest.mark.slow
def test_errors_before_a_run_name_components():
    far = ij.references.Sinusoid(offset=0.0, amplitude=[4.0, 2.0, 3.0], frequency=1.0)
    with pytest.raises(ValueError, match="reference of heading"):
        ij.simulate(body(reference=far), duration=10.0, dt=1e-2)
    outside = ij.references.Sinusoid(offset=[9.0, 0.0, 0.0], amplitude=0.0)
    with pytest.raises(ValueError, match="reference of north"):
        ij.simulate(body(reference=outside), duration=1.0, dt=1e-2)
    with pytest.raises(ValueError, match=r"speeds below 1e\+12 m/s, m/s, rad/s"):
        ij.simulate(body(initial=ij.Initial(q=[0.5, 1.0, 0.2], dq=1e13)), duration=1.0, dt=1e-2)


@pytest.mark.slow
def test_a_run_that_starts_outside_a_level_is_named_in_a_study():
    draws = {"initial.x[2]": ij.offset(ij.uniform(24.0, 25.0))}
    study = ij.monte_carlo(pendulum(), draws, runs=2, duration=0.01, dt=1e-4)
    assert study.started_outside.all()
    with pytest.warns(SimulationWarning, match=r"current of pendulum was drawn 4\.\d* A beyond"):
        study.replay(0)


@pytest.mark.slow
def test_a_robot_keeps_its_words():
    robot = ij.presets.zhang_yan_2024()
    robot = ij.with_parts(robot, bounds=(robot.bounds[0], symmetric(0.1)))
    text = message_of(robot, duration=0.5)
    assert "a velocity bound was violated" in text
    assert "Joint 1 left its velocity bounds first" in text
    assert "2 joints" in repr(ij.simulate(ij.presets.zhang_yan_2024(), duration=0.02, dt=1e-3))
    assert "1 component," in repr(ij.simulate(pendulum(), duration=0.02, dt=1e-3))


@pytest.fixture(scope="module")
def run():
    """A run of 20 ms, with the metrics of violated bounds."""
    return ij.simulate(pendulum(), duration=0.02, dt=1e-3)


def message_for(run, status, **metrics) -> str:
    """The warning about a run with these flags and metrics."""
    values = run.metrics.values_by_name | {name: jnp.asarray(x) for name, x in metrics.items()}
    changed = dataclasses.replace(
        run,
        status=jnp.asarray(int(status)),
        metrics=dataclasses.replace(run.metrics, values_by_name=values),
    )
    with pytest.warns(SimulationWarning) as found:
        diagnosis.report(changed, 20, throw=False)
    return str(found[0].message)


CONSEQUENCES = Status.INACCURATE | Status.GUARD_STAYED | Status.INFINITE_SLOPE


@pytest.mark.slow
def test_the_consequences_of_a_divergence_are_left_out_of_its_message(run):
    text = message_for(run, Status.BOUND_VIOLATED | Status.NOT_FINITE | CONSEQUENCES)
    assert "a bound was violated" in text
    for consequence in ("inaccurate", "guard", "derivative"):
        assert consequence not in text
    assert "guard stayed active" in message_for(run, Status.BOUND_VIOLATED | Status.GUARD_STAYED)


@pytest.mark.slow
def test_the_first_violation_is_named_first(run):
    both = Status.BOUND_VIOLATED | Status.VELOCITY_VIOLATED
    times = {"first_violation_time": 0.01, "first_velocity_violation_time": 0.004}
    text = message_for(run, both, **times)
    assert text.index("Level 2 (speed)") < text.index("Level 1 (angle)")
    text = message_for(run, both, **(times | {"first_violation_time": 0.001}))
    assert text.index("Level 1 (angle)") < text.index("Level 2 (speed)")


def test_a_larger_step_is_no_remedy_for_an_inaccurate_run(run, monkeypatch):
    monkeypatch.setattr(diagnosis, "find_dt", lambda *_, **__: 5e-3)
    text = message_for(run, Status.INACCURATE)
    assert "Take dt" not in text
    assert "compare this run with one at a tenth of dt" in text
    monkeypatch.setattr(diagnosis, "find_dt", lambda *_, **__: 2e-4)
    assert "Take dt=0.0002" in message_for(run, Status.INACCURATE)


def test_an_infinite_slope_has_a_remedy_only_if_the_law_has_the_power(run):
    text = message_for(run, Status.INFINITE_SLOPE)
    assert "a square root at 0" in text
    assert "If the law has such a power, replace it" in text
