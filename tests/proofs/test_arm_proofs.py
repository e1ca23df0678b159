"""V_w' of rigid arms: against the closed loop, its bound over boxes, and what is refused."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_cases import random_arm
from by_numpy import computed
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.kernels.enclosure import enclose
from iblf_jax.proofs.arm_motion import Errors, position, side_of, velocity
from iblf_jax.proofs.arms import _parts_of, arm_problem
from iblf_jax.proofs.parameters import uncertain_coordinates
from iblf_jax.simulation import closed_loop
from iblf_jax.simulation.scenario import canonical

MASSES = {"plant.mass": ij.factor(ij.interval(0.97, 1.03))}
WEIGHT, LEVEL = 2e-3, 0.8
LEVELS = {"tan": 0.05}
"""Levels of barriers whose guard is active at LEVEL."""


def chain_loop(n, **parts):
    """A planar chain under the corrected law, without disturbance."""
    ones = np.ones(n)
    lower, upper = ij.bounds.Constant(-0.4), ij.bounds.Sinusoid(1.0, 0.1, 2.0, np.arange(n))
    given = {
        "plant": ij.robots.PlanarChain(ones, 0.4 * ones, 0.2 * ones, 0.02 * ones),
        "reference": ij.references.Sinusoid(0.3, 0.2, 1.0, np.arange(n)),
        "bounds": ij.bounds.Bounds(lower, upper),
        "controller": ij.controllers.Backstepping(k1=2.0, K2=3.0, variant="corrected"),
        "observer": ij.observers.Momentum(kf=100.0),
        "initial": ij.Initial(q=0.3 * ones),
    }
    return ij.Scenario(**given | parts)


def paper_loop(law="integral"):
    """The paper's arm with K2 = 3 and kf = 100, without disturbance."""
    scenario = ij.presets.zhang_yan_2024(law=law, variant="corrected")
    scenario = ij.with_parts(scenario, disturbance=ij.disturbances.Nothing())
    return ij.with_parameters(scenario, {"controller.K2": 3.0, "observer.kf": 100.0})


def general_loop(law):
    """The paper's loop with everything that the bound knows: another plant, friction, a disturbance
    that depends on the motion, and weights."""
    scenario = ij.presets.zhang_yan_2024(law=law, variant="corrected")
    disturbance = ij.disturbances.Sum((scenario.disturbance, ij.disturbances.Friction(0.1, 0.05)))
    values = {"plant.payload": 0.1, "plant.centre": [0.18, 0.16], "controller.weight": [0.7, 1.2]}
    return ij.with_parameters(ij.with_parts(scenario, disturbance=disturbance), values)


GENERAL = {
    "plant.payload": ij.offset(ij.interval(-0.05, 0.1)),
    "plant.centre[1]": ij.value(ij.interval(0.15, 0.17)),
    "disturbance.parts[1].viscous": ij.factor(ij.interval(0.5, 2.0), shared=True),
}
NAMES = ("integral", "log", "tan", "mapping", "prescribed_performance")
LOOPS = {
    **{name: lambda name=name: (general_loop(name), GENERAL) for name in NAMES},
    "pendulum": lambda: (chain_loop(1), {"plant.centre": ij.factor(ij.interval(0.9, 1.1))}),
    "chain": lambda: (chain_loop(3), MASSES),
}


def each(quick):
    """The loops by name; those whose programs take long to compile are for releases."""
    return [n if n in quick else pytest.param(n, marks=pytest.mark.release) for n in LOOPS]


def lyapunov(scenario, weight, t, state):
    """V_w of a state of the loop."""
    sample = closed_loop.evaluate(scenario, t, state)[1]
    law = scenario.controller
    V1 = law.weight * law.barrier.value(scenario.context.tube(t), state.q)
    f_tilde = sample.disturbance - sample.disturbance_estimate
    kinetic = sample.e2 @ scenario.model.mass_matrix(state.q) @ sample.e2
    return jnp.sum(V1) + 0.5 * kinetic + 0.5 * weight * f_tilde @ f_tilde


@jax.jit
def level_and_rate(scenario, weight):
    """V_w at the start of a run and its derivative along the loop."""
    start = jnp.zeros(()), closed_loop.initial_state(scenario)
    rates = jnp.ones(()), closed_loop.rate(scenario, *start)
    return jax.jvp(lambda t, state: lyapunov(scenario, weight, t, state), start, rates)


def test_the_velocity_at_time_and_errors_is_that_of_the_loop(rng):
    """From a state of the loop to its errors and back; the barrier is inside its guard."""
    scenario = canonical(chain_loop(1))
    parts = _parts_of(scenario)
    t, q, dq = rng.uniform(0.0, 5.0, 6), rng.uniform(0.0, 0.6, (6, 1)), rng.normal(size=(6, 1))

    def of_loop(t, q, dq):
        tube = scenario.context.tube(t)
        side = side_of(parts, t, q - tube.q_d)
        law = scenario.controller
        alpha = law.barrier.virtual_velocity(tube, q, law.k1, law.o)
        at = Errors(t, (q - tube.q_d) / side.k, dq - alpha)
        return position(parts, at), velocity(parts, at)

    for found, expected in zip(computed(of_loop, t, q, dq, runs=True), (q, dq), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", each({"integral"}))
def test_rate_is_that_of_the_closed_loop_from_the_scenario_of_a_point(name):
    scenario, parameters = LOOPS[name]()
    problem = arm_problem(scenario, parameters)
    expected_level = LEVELS.get(name, LEVEL)
    constants = problem.constants(WEIGHT, expected_level)
    points = problem.sample(0, 6)
    for point, expected in zip(points, problem.rate(points, constants), strict=True):
        level, rate = level_and_rate(problem.scenario_at(point, constants), WEIGHT)
        np.testing.assert_allclose(level, expected_level, rtol=1e-12)
        np.testing.assert_allclose(rate, expected, rtol=1e-10, atol=1e-10)


def coordinates_of(point, n):
    """The coordinates of a point of the level set, with its signs and the start 0."""
    s = point[1 : 1 + 3 * n] / np.linalg.norm(point[1 : 1 + 3 * n])
    ends = [*np.abs(s[:n]), np.linalg.norm(s[n:])]
    theta = [np.arctan2(np.linalg.norm(ends[i + 1 :]), ends[i]) for i in range(n)]
    y, b = s[n : 2 * n], np.linalg.norm(s[2 * n :])
    if n == 1:
        psi, phi = np.arctan2(b, y[0]), []
    else:
        psi = np.arctan2(b, np.linalg.norm(y))
        phi = [np.arctan2(np.linalg.norm(y[i + 1 :]), y[i]) for i in range(n - 2)]
        phi.append(np.arctan2(y[-1], y[-2]) % (2 * np.pi))
    return np.array([point[0], *theta, psi, *phi, *point[1 + 3 * n :], *np.sign(s[:n]), 0.0])


@pytest.mark.slow
@pytest.mark.parametrize("name", each({"pendulum"}))
def test_bound_over_boxes_is_above_the_rate_of_their_points(name):
    scenario, parameters = LOOPS[name]()
    problem = arm_problem(scenario, parameters)
    n, generator = scenario.n, np.random.default_rng(1)
    constants = problem.constants(WEIGHT, LEVELS.get(name, LEVEL))
    points = problem.sample(2, 2000)
    x = np.array([coordinates_of(point, n) for point in points])
    width = np.concatenate([problem.upper - problem.lower, np.zeros(n + 1)])
    size = width * generator.choice([0.0, 1e-6, 1e-3, 1e-2, 0.1], (len(x), 1))
    below, above = generator.uniform(size=(2, *x.shape)) * size
    _, (bounds, _) = enclose(problem.bound, x - below - 1e-12 * width, x + above, constants)
    rate = problem.rate(points, constants)
    # NaN is no bound.
    assert not np.any(bounds < rate[:, None] - 1e-9 * np.abs(rate[:, None]))
    # At the best direction of f_tilde and narrow boxes the bound is near the rate.
    assert np.nanmin((bounds.min(1) - rate) / np.abs(rate)) < 0.1


@pytest.mark.slow
def test_rate_of_a_further_disturbance_enters_at_its_corners():
    scenario = chain_loop(1)
    problem = arm_problem(scenario, {}, disturbance_rate=2.0)
    constants = problem.constants(WEIGHT, LEVEL)
    points = problem.sample(0, 1000)
    plain = arm_problem(scenario, {})
    without = plain.rate(points[:, :-1], plain.constants(WEIGHT, LEVEL))
    s = points[:, 1:4] / np.linalg.norm(points[:, 1:4], axis=1, keepdims=True)
    f_tilde = np.sqrt(2 * LEVEL / WEIGHT) * s[:, 2]
    expected = without + WEIGHT * f_tilde * points[:, -1]
    np.testing.assert_allclose(problem.rate(points, constants), expected, rtol=1e-9, atol=1e-9)
    assert problem.names[-3:] == ("disturbance_rate[0]", "side[0]", "start")


def with_parts(**parts):
    return lambda: dataclasses.replace(ARM, **parts)


def with_law(**fields):
    return with_parts(controller=dataclasses.replace(ARM.controller, **fields))


def widely(*names, low=0.9):
    return {f"plant.{name}": ij.factor(ij.interval(low, 1.1)) for name in names}


ARM = paper_loop()
OTHER_ARM = ij.robots.PlanarChain([2.0, 0.85], [0.35, 0.31], centre=[0.17, 0.15], inertia=0.05)
MOTOR = ij.actuators.Motor(limit=50.0, stall=60.0, no_load_speed=10.0)
SPLINE = ij.references.WaypointSpline((0.0, 1.0), [[0.5, 0.5], [0.6, 0.6]])
REFUSED_LOOPS = {
    "controller.variant": ij.presets.zhang_yan_2024,
    "controller": with_parts(controller=ij.controllers.PDGravity(Kp=1.0, Kd=1.0)),
    "controller.gain_matrix": with_law(gain_matrix=[[1.0, 0.2], [0.2, 1.0]]),
    "controller.decays": with_law(decays=(ij.decays.FiniteTime(k_a=2.0),) * 2),
    "controller.barrier": with_law(barrier=ij.barriers.StateBarrier(), o=None),
    "observer": with_parts(observer=ij.observers.NoObserver()),
    "actuator": with_parts(actuator=MOTOR),
    "sampling.delay": with_parts(sampling=ij.Sampling(period=1e-3, delay=2e-3)),
    "jump_times": with_parts(disturbance=ij.disturbances.Step(1.0, 2.0)),
    "model": with_parts(model=OTHER_ARM),
    "duration": with_parts(reference=ij.references.Quintic(0.4, 0.6, 2.0)),
    "a reference without pieces": with_parts(reference=SPLINE),
    "bounds": with_parts(reference=ij.references.Sinusoid(0.5, 0.9)),
}
REFUSED_PARAMETERS = {
    "a parameter of the plant": {"model.mass": ij.factor(ij.interval(0.9, 1.1))},
    "an interval": {"plant.mass": ij.factor(ij.uniform(0.9, 1.1))},
    "plant.mass": widely("mass", low=-0.9),
    "positive definite": widely("inertia", "centre", low=0.0),
    "uncertain numbers": widely("mass", "length", "inertia", "centre"),
}
REFUSED = {text: (scenario, MASSES) for text, scenario in REFUSED_LOOPS.items()}
REFUSED |= {text: (paper_loop, numbers) for text, numbers in REFUSED_PARAMETERS.items()}


@pytest.mark.parametrize("text", REFUSED)
def test_what_the_bound_does_not_know_is_refused_with_the_reason(text):
    scenario, parameters = REFUSED[text]
    assert_refused(re.escape(text), arm_problem, scenario(), parameters)


def test_a_link_of_a_box_can_be_named_and_a_level_at_the_guard_is_refused():
    """`ij.parameters` lists a row by its name and by its number."""
    arm = dataclasses.replace(random_arm(2, 0, prismatic=0.0), links=("upper", "fore arm"))
    scenario = dataclasses.replace(paper_loop(), plant=arm, model=arm)

    def of(path):
        return uncertain_coordinates(scenario, {path: ij.factor(ij.interval(0.8, 1.2))}, None)

    for named, numbered in {
        "plant.link[upper].mass": "plant.mass[0]",
        'plant.link["fore arm"].centre': "plant.centre[1]",
        "plant.link[upper].mass, plant.link[fore arm].mass": "plant.mass[0], plant.mass[1]",
    }.items():
        assert (of(named).places, of(named).names) == (of(numbered).places, of(numbered).names)
    problem = arm_problem(paper_loop(), MASSES)
    assert_refused("guard", problem.constants, WEIGHT, 8.0)
