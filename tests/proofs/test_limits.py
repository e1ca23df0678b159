"""Limits of the torque that are active: V_w' and its bound against equations of their own."""

import dataclasses
import functools

import numpy as np
import pytest
from proof_cases import pendulum, within
from test_arm_proofs import coordinates_of, paper_loop
from test_sampled import KF, MASSES, WEIGHT, SampledPendulum, SampledTwoLinks, added
from test_torque import limited

import iblf_jax as ij
from iblf_jax.kernels.enclosure import enclose
from iblf_jax.proofs import Verdict
from iblf_jax.proofs.arms import arm_problem

Saturated = ij.controllers.Saturated
LEVEL = 0.5
HIGHEST, LOWEST = 12.0, -9.0
"""Limits of the pendulum in tests of the bound [N m]: they cut every second torque on the set."""
TWO_LIMITS = np.array([[-9.0, -5.0], [8.0, 4.5]])


@functools.cache
def pendulum_problem(percent):
    scenario = limited(pendulum(), HIGHEST, lower_limit=LOWEST)
    return arm_problem(scenario, within(percent)).with_active_limits


@functools.cache
def two_links_problem():
    scenario = paper_loop()
    scenario = dataclasses.replace(scenario, observer=dataclasses.replace(scenario.observer, kf=KF))
    scenario = limited(scenario, TWO_LIMITS[1], lower_limit=TWO_LIMITS[0])
    return arm_problem(scenario, MASSES).with_active_limits


CASES = {
    "pendulum": (lambda: pendulum_problem(30.0), SampledPendulum, 100.0, 0.3),
    "two links": (two_links_problem, SampledTwoLinks, KF, 0.01),
}
"""Problem, equations, gain and errors of the masses."""


def cut_sample(loop, problem, state):
    """Torque within the limits of a problem, estimate and n of a state."""
    tau, phi, n = loop.sample(state)
    return np.clip(tau, *problem.parts.torque_limits), phi, n


def states(loop, count, level, width, seed):
    """States of {V_w = level}, and the factors of their masses."""
    state, factor = loop.starts(count, level, seed)
    wanted = loop.f_tilde(*state, factor)
    choice = np.random.default_rng(seed + 100).choice([-1.0, -0.4, 0.0, 1.0], factor.shape)
    factor = 1.0 + width * choice
    return loop.with_f_tilde(state, wanted, factor), factor


def points_of(loop, state, factor):
    """The points and their coordinates, with times of the first period."""
    points, _ = loop.points(state, factor)
    points[:, 0] = np.mod(points[:, 0], 2.0 * np.pi)
    return points, np.array([coordinates_of(point, factor.shape[1]) for point in points])


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_rate_of_a_torque_within_limits_is_that_of_other_equations(name):
    make, links, kf, width = CASES[name]
    problem, loop = make(), links(kf)
    state, factor = states(loop, 400, LEVEL, width, 0)
    sample = cut_sample(loop, problem, state)
    assert 0.1 < np.mean(sample[0] != loop.sample(state)[0]) < 0.8
    points, _ = points_of(loop, state, factor)
    found = problem.rate(points, problem.constants(WEIGHT, LEVEL))
    expected = loop.rate_of_lyapunov(state, sample, factor)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)


def bounds_at(problem, x):
    """Bounds at coordinates."""
    return enclose(problem.bound, x, x, problem.constants(WEIGHT, LEVEL))[1][0][:, 0]


@pytest.mark.slow
def test_bound_of_a_pendulum_is_near_the_rate_at_the_worse_estimation_error():
    """Of one joint the direction of f_tilde is a sign: a term that is too small is found."""
    problem, loop = pendulum_problem(30.0), SampledPendulum(100.0)
    state, factor = states(loop, 1500, LEVEL, 0.3, 1)
    f_tilde = loop.f_tilde(*state, factor)
    rates, cuts = [], []
    for sign in (1.0, -1.0):
        other = loop.with_f_tilde(state, sign * f_tilde, factor)
        sample = cut_sample(loop, problem, other)
        rates.append(loop.rate_of_lyapunov(other, sample, factor))
        cuts.append(sample[0] - loop.sample(other)[0])
    worse = np.max(rates, axis=0)
    cut = np.choose(np.argmax(rates, axis=0), [x[:, 0] for x in cuts])
    assert np.mean(cut != 0.0) > 0.2
    _, x = points_of(loop, state, factor)
    gap = bounds_at(problem, x) - worse
    assert not np.any(gap < -1e-9 * (1.0 + np.abs(worse)))
    # D is that of all f_tilde in the term of the errors of the masses.
    assert np.median(gap / np.abs(worse)) < 0.02
    assert np.median((gap / np.abs(worse))[cut != 0.0]) < 0.1


@pytest.mark.slow
def test_bound_of_two_links_is_above_the_rate_for_each_direction_of_the_estimation_error():
    problem, loop = two_links_problem(), SampledTwoLinks(KF)
    state, factor = states(loop, 600, LEVEL, 0.01, 5)
    size = np.linalg.norm(loop.f_tilde(*state, factor), axis=1, keepdims=True)
    rates, cuts = [], []
    for angle in np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False):
        other = loop.with_f_tilde(state, size * [[np.cos(angle), np.sin(angle)]], factor)
        sample = cut_sample(loop, problem, other)
        rates.append(loop.rate_of_lyapunov(other, sample, factor))
        cuts.append(sample[0] != loop.sample(other)[0])
    worse = np.max(rates, axis=0)
    cut = np.array(cuts)[np.argmax(rates, axis=0), np.arange(len(worse))]
    # Of none, one and both joints.
    assert np.all(np.bincount(cut.sum(axis=1), minlength=3) > 10)
    _, x = points_of(loop, state, factor)
    gap = bounds_at(problem, x) - worse
    assert not np.any(gap < -1e-9 * (1.0 + np.abs(worse)))
    assert np.median(gap / np.abs(worse)) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_bound_over_boxes_is_above_the_rate_of_their_points(name):
    make, links, kf, width = CASES[name]
    problem, loop = make(), links(kf)
    state, factor = states(loop, 2000, LEVEL, width, 2)
    expected = loop.rate_of_lyapunov(state, cut_sample(loop, problem, state), factor)
    _, x = points_of(loop, state, factor)
    n, generator = factor.shape[1], np.random.default_rng(1)
    widths = np.concatenate([problem.upper - problem.lower, np.zeros(n + 1)])
    size = widths * generator.choice([0.0, 1e-6, 1e-3, 1e-2, 0.1], (len(x), 1))
    below, above = generator.uniform(size=(2, *x.shape)) * size
    low, high = x - below - 1e-12 * widths, x + above + 1e-12 * widths
    _, (bounds, _) = enclose(problem.bound, low, high, problem.constants(WEIGHT, LEVEL))
    assert not np.any(bounds[:, 0] < expected - 1e-9 * (1.0 + np.abs(expected)))
    assert np.all(np.isfinite(bounds[size[:, 0] <= 1e-3 * widths[0], 0]))


@pytest.mark.slow
def test_limits_that_no_torque_reaches_change_nothing():
    scenario = limited(pendulum(), 500.0)
    problem = arm_problem(scenario, within(3.0))
    points, constants = problem.sample(0, 200), problem.constants(WEIGHT, LEVEL)
    x = np.array([coordinates_of(point, 1) for point in points])
    width = 1e-3 * np.append(problem.upper - problem.lower, np.zeros(2))
    _, (expected, _) = enclose(problem.bound, x - width, x + width, constants)
    limits = problem.with_active_limits
    _, (bounds, _) = enclose(limits.bound, x - width, x + width, limits.constants(WEIGHT, LEVEL))
    np.testing.assert_allclose(bounds[:, 0], expected.min(axis=1), rtol=1e-9)


# --- verdicts -----------------------------------------------------------------------------------


@functools.cache
def proof(limit=None, motor=None, sampling=None, **options):
    scenario = dataclasses.replace(pendulum(), sampling=sampling)
    more = {"auxiliary": options.pop("auxiliary")} if "auxiliary" in options else {}
    if limit is not None:
        scenario = limited(scenario, limit, **more)
    if motor is not None:
        scenario = dataclasses.replace(scenario, actuator=ij.actuators.Motor(limit=motor))
    given = {"level": LEVEL, "weight": WEIGHT, "parameters": within(1.0), "progress": False}
    return ij.prove(scenario, **given | options)


def largest_torque():
    found = proof(runs=0)
    return float(np.max(np.abs([found.torque.found_lowest, found.torque.found_highest])))


def most_limited(loop, problem, count, level, width):
    """The states of the boundary whose torque is cut most, and all others."""
    state, factor = states(loop, 4 * count, level, width, 9)
    cut = np.abs(cut_sample(loop, problem, state)[0] - loop.sample(state)[0]).max(axis=1)
    order = np.argsort(-cut)[np.r_[: count // 2, 2 * count : 2 * count + count // 2]]
    assert np.sum(cut > 0.0) > 20
    return tuple(x[order] for x in state), factor[order]


@pytest.mark.slow
def test_a_set_on_which_limits_are_active_is_proved_and_no_run_leaves_it():
    limit = 0.8 * largest_torque()
    found = proof(limit)
    assert found.proved and found.has_active_limits
    text = repr(found)
    assert "with its limits of the torque, which may be active" in text
    assert "V_w is that of the torque before the limits" in text
    assert "stays within its limits" not in text
    loop = SampledPendulum(100.0)
    state, factor = most_limited(loop, found.problem, 1000, LEVEL, 0.01)
    np.testing.assert_allclose(loop.lyapunov(*state, factor), LEVEL, rtol=1e-9)
    step = 5e-4

    def now(state):
        return loop.rates(state, cut_sample(loop, found.problem, state), factor)

    for _ in range(400):
        middle = added(state, now(state), 0.5 * step)
        state = added(state, now(middle), step)
        assert np.all(loop.lyapunov(*state, factor) < LEVEL)
    for run in found.adversarial_runs(8):
        assert not int(run.status) & (ij.Status.BOUND_VIOLATED | ij.Status.INACCURATE)
        assert np.max(np.abs(run.tau)) <= limit
        assert np.max(np.abs(run.xi)) <= found.tube.xi.max()


@pytest.mark.slow
def test_a_set_of_a_held_torque_with_active_limits_is_proved_and_no_run_leaves_it():
    period = 1e-3
    limit = 0.85 * largest_torque()
    found = proof(limit, sampling=ij.Sampling(period, observer="poles"))
    assert found.proved and found.has_active_limits and found.held_rates.shape == (5, 1)
    assert "without" not in " ".join(found.assumptions[:2])
    loop = SampledPendulum(-np.expm1(-100.0 * period) / period)
    state, factor = most_limited(loop, found.problem, 1000, LEVEL, 0.01)
    loop.ends = (-limit, limit)
    for _ in range(200):
        sample = loop.sample(state)
        for _ in range(2):
            state = loop.moved(state, sample, factor, 0.5 * period, steps=2)
            assert np.all(loop.lyapunov(*state, factor) < LEVEL)
    for run in found.adversarial_runs(4, duration=0.2):
        assert run.ok and np.max(np.abs(run.tau)) <= limit
        assert np.max(np.abs(run.xi)) <= found.tube.xi.max()


@pytest.mark.slow
def test_limits_that_are_too_small_or_not_those_of_the_law_are_not_proved():
    largest = largest_torque()
    found = proof(0.1 * largest)
    assert found.verdict in (Verdict.NOT_PROVED, Verdict.REFUTED) and found.has_active_limits
    if found.verdict == Verdict.NOT_PROVED:
        assert found.point.rate > 0.0
    for options in ({"motor": 0.8 * largest}, {"limit": 0.8 * largest, "auxiliary": 50.0}):
        found = proof(runs=0, **options)
        assert found.verdict == Verdict.NOT_PROVED and not found.has_active_limits
        assert "Saturated without an auxiliary state may be active" in repr(found)
    # The motor cuts less than the law.
    assert proof(0.8 * largest, motor=0.9 * largest).has_active_limits
