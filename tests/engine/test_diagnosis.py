"""Messages about the levels of a plant in strict-feedback form: which one, when, and what to do."""

import dataclasses

import jax.numpy as jnp
import pytest
from plant_cases import ANGLES, body, pendulum, symmetric
from stored_results import stored

import iblf_jax as ij
from iblf_jax.core.status import Status
from iblf_jax.engine import diagnosis
from iblf_jax.engine.diagnosis import SimulationWarning

WIDE = symmetric(999.0)
QUADRATIC, QUIET = ij.barriers.Quadratic(), ij.disturbances.Nothing()
PLAIN = ij.controllers.BarrierBackstepping(
    k=(3.0, 10.0, 30.0), barriers=(ij.barriers.TransformedError(), QUADRATIC, QUADRATIC)
)
ROBOT = ij.presets.zhang_yan_2024()


def singular_gain(t, x):
    one = jnp.ones_like(x[0])
    return jnp.stack([one, jnp.where(x[0] > 0.45, 0.0, 1.0), one])


SINGULAR = ij.plants.StrictFeedback(
    lambda t, x: jnp.zeros_like(x), singular_gain, n=1, order=3, level_names=("a", "b", "c")
)
MESSAGES = {
    "a level with its time, margin, unit and remedy": (
        lambda: pendulum(controller=PLAIN, bounds=(ANGLES, WIDE, symmetric(2.0))),
        {},
        "Level 3 (current) of pendulum left its bounds first, at t = 0.0",
        " A. The law has barriers.Quadratic() on that level",
        "give it barriers.TransformedError() there",
    ),
    "the second level of a robot": (
        lambda: ij.with_parts(ROBOT, bounds=(ROBOT.bounds[0], symmetric(0.1))),
        {},
        "a velocity bound was violated",
        "Joint 1 left its velocity bounds first",
    ),
    "a singular gain": (
        lambda: pendulum(plant=SINGULAR, bounds=ANGLES, controller=PLAIN, disturbance=QUIET),
        {"duration": 1.5},
        "the law's input was not finite",
        "the gain of level 2 (b) is singular",
        "bound the levels so that they stay away",
    ),
    "the unit of the worst component": (
        body,
        {"duration": 10.0, "dt": 0.5},
        "the components of the first level are inaccurate",
        " m, ",
    ),
}
ABSENT = {"the unit of the worst component": " rad, "}


@pytest.mark.slow
@pytest.mark.parametrize("case", MESSAGES)
def test_the_warning_names(case):
    make, options, *words = MESSAGES[case]
    with pytest.warns(SimulationWarning) as found:
        run = ij.simulate(make(), **({"duration": 0.5, "dt": 1e-3} | options))
    (text,) = [str(w.message) for w in found if w.category is SimulationWarning]
    assert all(x in text for x in words) and ABSENT.get(case, "nothing of it") not in text, text
    assert bool(int(run.status) & Status.SINGULAR_GAIN) == (case == "a singular gain")


@pytest.mark.slow
def test_a_virtual_control_outside_its_level_is_reported_like_assumption_2():
    bounds = (ANGLES, symmetric(3.0), symmetric(2.0))
    with pytest.warns(SimulationWarning, match="Assumption 2") as found:
        run = ij.simulate(pendulum(controller=PLAIN, bounds=bounds), duration=0.5, dt=1e-3)
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
    """It has no virtual controls of higher levels, and no margins of them."""
    parts = {
        "plant": ij.plants.FlexibleJoint(ROBOT.plant, stiffness=3e3, motor_inertia=0.02),
        "bounds": (ROBOT.bounds[0], None, None, symmetric(0.5)),
        "observer": ij.observers.NoObserver(),
    }
    scenario = ij.with_parts(ROBOT, disturbance=QUIET, **parts)
    with pytest.warns(SimulationWarning, match=r"Level 4 \(motor velocity\) of joint") as found:
        run = ij.simulate(scenario, duration=0.05, dt=2e-4)
    assert any("controllers.BarrierBackstepping keeps them" in str(w.message) for w in found)
    assert "level_margin" in run.metrics and "level_alpha_margin" not in run.metrics
    assert run.metrics.units["estimate_rmse"] == "N m"
    assert jnp.all(jnp.isinf(run.metrics.level_margin[0]))  # level 3 has no bounds


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "part", "words"),
    [
        ("reference", ij.references.Sinusoid(0.0, [4.0, 2.0, 3.0], 1.0), "reference of heading"),
        ("reference", ij.references.Sinusoid([9.0, 0.0, 0.0], 0.0), "reference of north"),
        ("initial", ij.Initial([0.5, 1.0, 0.2], 1e13), r"speeds below 1e\+12 m/s, m/s, rad/s"),
    ],
)
def test_errors_before_a_run_name_components(name, part, words):
    with pytest.raises(ValueError, match=words):
        ij.simulate(body(**{name: part}), duration=10.0, dt=1e-2)


@pytest.mark.slow
def test_a_run_that_starts_outside_a_level_is_named_in_a_study():
    draws = {"initial.x[2]": ij.offset(ij.uniform(24.0, 25.0))}
    study = ij.monte_carlo(pendulum(), draws, runs=2, duration=0.01, dt=1e-4)
    assert study.started_outside.all()
    with pytest.warns(SimulationWarning, match=r"current of pendulum was drawn 4\.\d* A beyond"):
        study.replay(0)


@pytest.fixture(scope="module")
def run():
    return stored("Rollout_1")


def message_for(run, status, **metrics) -> str:
    values = run.metrics.values_by_name | {name: jnp.asarray(x) for name, x in metrics.items()}
    metrics = dataclasses.replace(run.metrics, values_by_name=values)
    changed = dataclasses.replace(run, status=jnp.asarray(int(status)), metrics=metrics)
    with pytest.warns(SimulationWarning) as found:
        diagnosis.report(changed, 20, throw=False)
    return str(found[0].message)


CONSEQUENCES = Status.INACCURATE | Status.GUARD_STAYED | Status.INFINITE_SLOPE


def test_the_consequences_of_a_divergence_are_left_out_of_its_message(run):
    text = message_for(run, Status.BOUND_VIOLATED | Status.NOT_FINITE | CONSEQUENCES)
    assert "a bound was violated" in text
    assert not [x for x in ("inaccurate", "guard", "derivative") if x in text]
    assert "guard stayed active" in message_for(run, Status.BOUND_VIOLATED | Status.GUARD_STAYED)


def test_the_first_violation_is_named_first(run):
    both = Status.BOUND_VIOLATED | Status.VELOCITY_VIOLATED
    for time, is_second in ((0.01, True), (0.001, False)):
        times = {"first_violation_time": time, "first_velocity_violation_time": 0.004}
        text = message_for(run, both, **times)
        assert (
            text.index("Level 2 (angular velocity)") < text.index("Level 1 (angle)")
        ) == is_second


def test_a_remedy_is_named_only_where_it_helps(run, monkeypatch):
    monkeypatch.setattr(diagnosis, "find_dt", lambda *_, **__: 5e-3)
    text = message_for(run, Status.INACCURATE)
    assert "Take dt" not in text
    assert "compare this run with one at a tenth of dt" in text
    monkeypatch.setattr(diagnosis, "find_dt", lambda *_, **__: 2e-4)
    assert "Take dt=0.0002" in message_for(run, Status.INACCURATE)
    text = message_for(run, Status.INFINITE_SLOPE)
    assert "a square root at 0" in text and "If the law has such a power, replace it" in text
