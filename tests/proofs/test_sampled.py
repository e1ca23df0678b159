"""Sampled loops with a held torque: V_w' and its bound against equations of their own."""

import dataclasses
import functools
import re
from collections import namedtuple
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from proof_cases import pendulum, within
from test_arm_proofs import coordinates_of, paper_loop
from test_torque import TwoLinks, limited

import iblf_jax as ij
from iblf_jax.kernels.enclosure import enclose
from iblf_jax.proofs import Verdict, arm_held, arm_motion
from iblf_jax.proofs.arm_bound import arm_errors, coordinates, scaled
from iblf_jax.proofs.arms import arm_problem, point_of
from iblf_jax.proofs.problem import OfStructure
from iblf_jax.proofs.proposal import start_of
from iblf_jax.proofs.support import without_guard
from iblf_jax.world.bounds import Tube

WEIGHT, LEVEL, PERIOD, DELAY = 3e-3, 0.1, 1e-3, 0.25e-3
KF = np.array([100.0, 60.0])
UNEVEN = 0.75 * np.pi
"""The time at which the widths of the tube on both sides differ most, by a factor of 5.9."""
MASSES = {"plant.mass, plant.inertia": ij.factor(ij.interval(0.99, 1.01))}
EULER, POLES, EXACT = STEPS = "euler", "poles", "exact"


def sampled(scenario, period=PERIOD, observer=POLES, **parts):
    return dataclasses.replace(scenario, sampling=ij.Sampling(period, observer=observer, **parts))


def encoder(counts=None, noise=None, offset=0.0, velocity=None):
    velocity = ij.sensors.Measured() if velocity is None else velocity
    return ij.sensors.Encoder(velocity=velocity, counts=counts, noise=noise, offset=offset)


READING = 1e-3
"""Largest error of the encoder of the tests, half of its step [rad]."""
ROUGH = encoder(counts=np.pi / READING)


@functools.cache
def problem_of_paper_loop(observer=POLES, sensor=None):
    scenario = sampled(paper_loop(), observer=observer)
    observer, sensor = dataclasses.replace(scenario.observer, kf=KF), sensor or ij.sensors.Ideal()
    return arm_problem(dataclasses.replace(scenario, observer=observer, sensor=sensor), MASSES)


def read_by(sensor, observer=POLES):
    return dataclasses.replace(sampled(pendulum(), observer=observer), sensor=sensor)


def delayed():
    return sampled(pendulum(), delay=DELAY)


def test_a_sampling_that_is_missing_or_that_the_bound_does_not_know_is_refused():
    filtered = ij.sensors.FilteredDifference(100.0)
    for text, scenario in {
        "scenario.sampling.trigger": sampled(pendulum(), trigger=ij.EventTrigger(relative=0.1)),
        "Normal noise has no bound": read_by(encoder(noise=1e-4)),
        "scenario.sensor.velocity.noise": read_by(encoder(velocity=ij.sensors.Measured(0.1))),
        "positions of several samples": read_by(encoder(velocity=filtered)),
        "with torque limits": limited(read_by(ROUGH), 100.0),
        "at most a period": sampled(pendulum(), delay=1.1 * PERIOD),
        "sensors.Ideal with a delay": dataclasses.replace(delayed(), sensor=ROUGH),
        "0 s with torque limits": limited(delayed(), 100.0),
    }.items():
        with pytest.raises(ValueError, match=re.escape(text)):
            arm_problem(scenario, within(1.0))
    with pytest.raises(ValueError, match="None with a sampling"):
        arm_problem(sampled(pendulum()), within(1.0), disturbance_rate=1.0)
    with pytest.raises(ValueError, match=r"scenario\.sampling: got None.*ij\.Sampling\(period"):
        ij.largest_period(pendulum(), level=0.5, parameters={}, between=(1e-3, 2e-3))


class SampledTwoLinks(TwoLinks):
    """The sampled loop without the package; derivatives are those of analytic functions by complex
    steps. A state is (t, q, v, phi); factors are those of the true masses."""

    step, joints, weight, ends = 1e-30, 2, WEIGHT, (-np.inf, np.inf)

    def __init__(self, gain, momentum_gain=0.0, measured=None):
        self.gain, self.momentum_gain = gain, momentum_gain
        self.measured = measured or (lambda q: q)

    def along(self, function, state, rates):
        """The derivative of a function along rates of its arguments."""
        moved = [x + 1j * self.step * rate for x, rate in zip(state, rates, strict=True)]
        return np.imag(function(*moved)) / self.step

    def alpha_rate(self, t, q, v):
        q_d, dq_d, ddq_d, k_l, k_u, dk_l, dk_u = self.tube(t)
        # The rates of the widths, differentiated once more, are -0.14 sin of the same arguments.
        wave = q_d - 0.5
        side = 0.3 + wave - k_l
        bend = wave - side
        r_l, r_u = dk_l / k_l, dk_u / k_u
        kappa = np.sqrt(r_u**2 + r_l**2 + self.o)
        rate = (r_u * (bend / k_u - r_u**2) + r_l * (-bend / k_l - r_l**2)) / kappa
        return ddq_d - rate * (q - q_d) - (self.k1 + kappa) * (v - dq_d)

    def errors(self, t, q, v):
        """e1, its width, and e2."""
        q_d, _, _, k_l, k_u, _, _ = self.tube(t)
        e1 = q - q_d
        return e1, np.where(e1.real > 0.0, k_u, k_l), v - self.alpha(t, q)

    def law(self, t, q, v, phi):
        """u, and the terms n of the momentum's rate."""
        e1, k, e2 = self.errors(t, q, v)
        M0, h0, G0 = self.dynamics(q, np.ones_like(q))
        alpha = self.alpha(t, q)
        feedback = self.K2 * e2 + 2.0 * e1 / (k**2 - e1**2)
        inertial = np.einsum("bij,bj->bi", M0, self.alpha_rate(t, q, v))
        return inertial + self.coriolis(h0, v, alpha) + G0 - phi - feedback

    def momentum_term(self, q, v):
        """n = M0' v - C0 v - G0 = C0^T v - G0."""
        _, h0, G0 = self.dynamics(q, np.ones_like(q))
        # C = [[-h v2, -h (v1 + v2)], [h v1, 0]]
        first = -h0 * v[:, 1] * v[:, 0] + h0 * v[:, 0] * v[:, 1]
        second = -h0 * v.sum(axis=1) * v[:, 0]
        return np.stack([first, second], -1) - G0

    def acceleration(self, q, v, tau, factor):
        M, h, G = self.dynamics(q, factor)
        force = tau - self.coriolis(h, v, v) - G
        return np.linalg.solve(M, force[..., None])[..., 0]

    def f_tilde(self, t, q, v, phi, factor):
        u = self.law(t, q, v, phi)
        a = self.acceleration(q, v, u, factor)
        M0, h0, G0 = self.dynamics(q, np.ones_like(q))
        return np.einsum("bij,bj->bi", M0, a) + self.coriolis(h0, v, v) + G0 - u - phi

    def lyapunov(self, t, q, v, phi, factor):
        e1, k, e2 = self.errors(t, q, v)
        M0, _, _ = self.dynamics(q, np.ones_like(q))
        f_tilde = self.f_tilde(t, q, v, phi, factor)
        barrier = -np.log(1.0 - (e1 / k) ** 2).sum(axis=1)
        kinetic = np.einsum("bi,bij,bj->b", e2, M0, e2)
        return barrier + 0.5 * kinetic + 0.5 * self.weight * (f_tilde**2).sum(axis=1)

    def rates(self, state, sample, factor):
        """The rates of a state, after a sample (tau_k, phi_k, n_k)."""
        t, q, v, _ = state
        tau, phi_k, n_k = sample
        a = self.acceleration(q, v, tau, factor)

        def momentum(q, v):
            M0, _, _ = self.dynamics(q, np.ones_like(q))
            return np.einsum("bij,bj->bi", M0, v)

        p_rate = self.along(momentum, (q, v), (v, a))
        estimate = self.gain * (p_rate - phi_k - tau - n_k) + self.momentum_gain * p_rate
        return np.ones_like(t), v, a, estimate

    def sample(self, state):
        """Torque, estimate and n of what is measured."""
        t, q, v, phi = state
        read = self.measured(q)
        M0, _, _ = self.dynamics(q, np.ones_like(q))
        M0_read, _, _ = self.dynamics(read, np.ones_like(q))
        estimate = phi + (self.gain + self.momentum_gain) * np.einsum("bij,bj->bi", M0_read - M0, v)
        command = np.clip(self.law(t, read, v, estimate), *self.ends)
        return command, estimate, self.momentum_term(read, v)

    def moved(self, state, sample, factor, age, steps=8):
        """The state some time after the sample, by Runge and Kutta's method."""
        dt = age / steps
        for _ in range(steps):
            k1 = self.rates(state, sample, factor)
            k2 = self.rates(added(state, k1, 0.5 * dt), sample, factor)
            k3 = self.rates(added(state, k2, 0.5 * dt), sample, factor)
            k4 = self.rates(added(state, k3, dt), sample, factor)
            for k, part in ((k1, 1.0), (k2, 2.0), (k3, 2.0), (k4, 1.0)):
                state = added(state, k, dt * part / 6.0)
        return state

    def period_with_delay(self, state, factor, active, delay, period=PERIOD):
        """States of a period with the samples that act there, at its ends and where the command
        arrives, and the command; a sample has the torque of the plant, and n_k that of the observer
        as well."""
        u, phi, n = now = self.sample(state)
        before = (active, phi, n + u - active)
        arrived = self.moved(state, before, factor, delay, steps=2)
        end = self.moved(arrived, now, factor, period - delay, steps=2)
        return [(state, before), (arrived, before), (arrived, now), (end, now)], u

    def rate_of_lyapunov(self, state, sample, factor):
        rates = self.rates(state, sample, factor)
        return self.along(lambda *x: self.lyapunov(*x, factor), state, rates)

    def starts(self, count, level, seed, *, near=0.0):
        """States of {V_w <= level} and factors; with `near`, of small position errors where the
        sides of the tube differ most."""
        generator, n = np.random.default_rng(seed), self.joints
        t = generator.uniform(0.0, 2.0 * np.pi, count)
        s = generator.normal(size=(count, 3 * n))
        if near:
            t = UNEVEN + 0.1 * (t - np.pi) + np.pi * generator.integers(0, 2, count)
            s[:, :n] *= near
        s /= np.linalg.norm(s, axis=1, keepdims=True)
        q, e2, f_tilde = self.states(t, s, level, self.weight)
        factor = 1.0 + 0.01 * generator.choice([-1.0, -0.3, 0.0, 1.0], (count, n))
        state = (t, q, self.alpha(t, q) + e2, np.zeros_like(q))
        return self.with_f_tilde(state, f_tilde, factor), factor

    def without_errors(self, state):
        _, q, v, phi = state
        return self.law(*state), phi, self.momentum_term(q, v)

    def differences(self, state, sample):
        (u, phi, n), (tau, phi_k, n_k) = self.without_errors(state), sample
        return tau - u, n - n_k + phi - phi_k

    def with_f_tilde(self, state, f_tilde, factor):
        """The state with the estimate that gives f_tilde, which is affine in it with the slope -M0
        M^-1."""
        t, q, v, phi = state
        M0, _, _ = self.dynamics(q, np.ones_like(q))
        M, _, _ = self.dynamics(q, factor)
        difference = self.f_tilde(*state, factor) - f_tilde
        change = np.einsum("bij,bj->bi", M, np.linalg.solve(M0, difference[..., None])[..., 0])
        return t, q, v, phi + change

    def held_rates(self, state, sample, factor):
        """The rates of u, L and f, (3, count, 2)."""
        rates = self.rates(state, sample, factor)
        command = self.along(self.law, state, rates)
        momentum = self.along(self.momentum_term, state[1:3], rates[1:3])
        f_tilde = self.along(lambda *x: self.f_tilde(*x, factor), state, rates)
        return np.stack([command, momentum + rates[3], f_tilde + rates[3]])

    def points(self, state, factor):
        """States as points (t, s, z) of the level sets on which they are, and the levels."""
        t, q, v, _ = state
        level = self.lyapunov(*state, factor)
        e1, k, e2 = self.errors(t, q, v)
        V1 = -np.log(1.0 - (e1 / k) ** 2)
        M0, _, _ = self.dynamics(q, np.ones_like(q))
        # U U^T = M0 with an upper triangular U
        flipped = np.linalg.cholesky(M0[:, ::-1, ::-1])[:, ::-1, ::-1]
        scaled = np.einsum("bji,bj->bi", flipped, e2)
        f_tilde = self.f_tilde(*state, factor)
        roots = np.sqrt([1.0 / level, 0.5 / level, 0.5 * self.weight / level])[:, :, None]
        s = roots * [np.sign(e1) * np.sqrt(V1), scaled, f_tilde]
        return np.concatenate([t[:, None], *s, factor], axis=1), level


class SampledPendulum(SampledTwoLinks):
    """The pendulum, whose reference and bounds are those of the first of two links."""

    joints = 1

    def tube(self, t):
        return [x[:, :1] for x in super().tube(t)]

    def dynamics(self, q, factor):
        inertia = 2.0 * factor * 0.175**2 + 0.06
        return inertia[..., None], None, 2.0 * factor * 0.175 * self.g * np.cos(q)

    def coriolis(self, h, v, u):
        return np.zeros_like(v)

    def momentum_term(self, q, v):
        return -self.dynamics(q, np.ones_like(q))[2]


def added(state, rates, size):
    """state + size rates; `size` is a number, or one for each run, (count, 1)."""
    sizes = [np.squeeze(size), size, size, size]
    return tuple(x + h * rate for x, rate, h in zip(state, rates, sizes, strict=True))


def own_loop(observer, kf=KF, period=PERIOD, measured=None, links=SampledTwoLinks):
    gain = kf if observer == EULER else -np.expm1(-kf * period) / period
    return links(gain, momentum_gain=kf - gain if observer == EXACT else 0.0, measured=measured)


@functools.cache
def rough_pendulum(observer):
    return arm_problem(read_by(ROUGH, observer), within(1.0))


@functools.partial(jax.jit, static_argnums=0)
def compiled_rates(places, constants, points, levels, D, L):
    def one(point, level, D, L):
        at = point_of(places, point, constants._replace(level=level))
        fresh = arm_motion.lyapunov_rate(at.parts, WEIGHT, at.errors, at.f_tilde)
        fresh = fresh + arm_held.bias_addition(at.parts, WEIGHT, at.errors, at.f_tilde)
        added = arm_held.held_addition(at.parts, WEIGHT, at.errors, at.f_tilde, D, L)
        return fresh + added, arm_held.rates_at(at.parts, at.errors, at.f_tilde)

    return jax.vmap(one)(points, levels, D, L)


def rates_of_package(problem, points, levels, D, L):
    """V_w' of the package at points with D and L, and the rates of u and L."""
    constants = problem.constants_of(WEIGHT, 1.0)
    return compiled_rates(problem.bound.places, constants, points, levels, D, L)


@pytest.mark.slow
@pytest.mark.parametrize("observer", STEPS)
def test_rate_of_a_held_torque_is_that_of_other_equations(observer):
    problem = problem_of_paper_loop(observer)
    loop = own_loop(observer)
    state, factor = loop.starts(200, 1.0, 0)
    generator = np.random.default_rng(1)
    tau, phi_k, n_k = now = loop.sample(state)
    sample = [x + generator.normal(size=x.shape) for x in now]
    D, L = sample[0] - tau, n_k - sample[2] + phi_k - sample[1]
    points, levels = loop.points(state, factor)
    found, _ = rates_of_package(problem, points, levels, D, L)
    expected = loop.rate_of_lyapunov(state, sample, factor)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("observer", [POLES, EXACT])
def test_first_order_in_the_age_is_exact(observer):
    problem = problem_of_paper_loop(observer)
    loop = own_loop(observer)
    start, factor = loop.starts(200, 0.1, 2)
    # At e1 = 0 the rates jump, and the remainder is of first order.
    is_far = np.all(np.abs(loop.errors(*start[:3])[0]) > 1e-3, axis=1)
    # As many as in the test above, with which this one shares a program.
    chosen = np.resize(np.flatnonzero(is_far), 200)
    start, factor = tuple(x[chosen] for x in start), factor[chosen]
    sample = loop.sample(start)
    errors = []
    for age in (4e-5, 2e-5, 1e-5):
        state = loop.moved(start, sample, factor, age)
        points, levels = loop.points(state, factor)
        zero = np.zeros_like(factor)
        _, rates = rates_of_package(problem, points, levels, zero, zero)
        D, L = -age * np.asarray(rates.command), age * np.asarray(rates.lag)
        first, _ = rates_of_package(problem, points, levels, D, L)
        errors.append(np.asarray(first) - loop.rate_of_lyapunov(state, sample, factor))
    sizes = np.linalg.norm(errors, axis=1)
    np.testing.assert_allclose(sizes[:-1] / sizes[1:], 4.0, rtol=0.05)


class Enclosures(OfStructure):
    """What the bound consists of: the path, means over it and rates, of one structure."""

    def __call__(self, x, constants):
        *leaves, limits, D, L = constants
        numbers = jax.tree.unflatten(self.structure, leaves)
        limits, n = arm_held.PathRates(*limits), numbers.parts.kf.shape[0]
        at = coordinates(x, n, self.places.coordinates)
        point = arm_errors(numbers, at)
        on_set = arm_held._rates(numbers, self.places, point, at, limits)
        numbers = numbers._replace(parts=arm_held.two_sided(numbers.parts, at.sign))
        parts = numbers.parts
        path = arm_held._path(numbers, self.places, point, at.z, limits)
        error = arm_held.mass_error(numbers, self.places, path.at, at.z)
        rates = arm_held.first_rates(numbers, self.places, path.at, at.z)
        no_error = arm_held.FirstDifferences(jnp.zeros(n), jnp.zeros(n), True)
        first = None
        if parts.measurement_error is not None:
            first = arm_held.first_differences(parts, path.at)
        means = arm_held.path_means(parts, path, error, rates, limits, first)
        of_path = arm_held.mean_rates(parts, error, rates, means)
        under = arm_held.rates_under(parts, error, rates, D, L)
        e2 = point.errors.e2
        D_and_L = scaled(-jnp.ones(()), under.command), under.lag
        added = arm_held.added_terms(numbers, e2, error, rates.mismatch, *D_and_L)
        outputs = [(path.at.xi, path.at.e2, path.f_tilde), means, of_path, under, added, on_set]
        outputs.append((first or no_error)[:2])
        given = arm_held.FirstDifferences(D, L, True)
        outputs.append(arm_held.first_terms(numbers, e2, error, rates.mismatch, given)[:2])
        enclosed = jnp.where(path.is_enclosed, 0.0, jnp.nan)
        return [jnp.ravel(leaf) + enclosed for leaf in jax.tree.leaves(outputs)]


OUTPUTS = (
    *("xi", "e2", "f_tilde", "D", "L", "growth", "rest"),
    *("command", "command_slope", "lag", "lag_slope", "p_rate", "p_rate_slope"),
    *("under_command", "under_command_slope", "under_lag", "under_lag_slope"),
    *("under_p_rate", "under_p_rate_slope"),
    *("power", "push", "slope"),
    *("set_command", "set_command_slope", "set_lag", "set_lag_slope"),
    *("set_mismatch", "set_mismatch_slope"),
    *("first_D", "first_L", "first_power", "first_push"),
)
Found = namedtuple("Found", OUTPUTS)
"""Lower or upper ends of `Enclosures`, one row for each box."""


OwnRuns = namedtuple("OwnRuns", "problem loop start sample factor age end levels x path limits")
"""Runs of `SampledTwoLinks` within a period, with nine states on each path, the coordinates of
their ends, and a little more than the largest rates on each path, (count, 3, 2); with errors of
measurements also than D and L at its sample, (count, 5, 2)."""


def enclosed(runs, function, size, generator, *, period=PERIOD, more=()):
    """The lower and upper ends of a function over boxes that contain the ends of the runs."""
    problem = runs.problem
    width = np.append(problem.upper - problem.lower, np.zeros(problem.sign_count + 1))
    below, above = generator.uniform(size=(2, *runs.x.shape)) * size + 1e-12
    low, high = runs.x - below * width, runs.x + above * width
    found = []
    for k, level in enumerate(runs.levels):
        constants = problem.constants_of(WEIGHT, level)
        parts = constants.parts._replace(period=jnp.asarray(period))
        leaves = jax.tree.leaves(constants._replace(parts=parts))
        constants = [*map(np.asarray, leaves), runs.limits[k], *(array[k] for array in more)]
        ends = enclose(function, low[k : k + 1], high[k : k + 1], constants)
        found.append([[leaf[0] for leaf in some] for some in ends])
    return [list(map(np.array, zip(*some, strict=True))) for some in zip(*found, strict=True)]


@functools.cache
def own_runs(near=0.0, ends_without_f_tilde=False, count=60, observer=POLES, rough=False):
    """With `near`, runs begin near e1 = 0 where the sides of the tube differ most, and paths cross
    it; one can choose that the runs end with f_tilde = 0. With rounded positions they are those of
    the pendulum."""
    generator = np.random.default_rng(3)
    problem, loop = problem_of_paper_loop(observer), own_loop(observer)
    if rough:
        shift = READING * np.random.default_rng(7).choice([-1.0, -0.5, 1.0], (count, 1))
        problem = rough_pendulum(observer)
        loop = own_loop(observer, 100.0, measured=lambda q: q + shift, links=SampledPendulum)
    start, factor = loop.starts(count, LEVEL, 4, near=near)
    age = PERIOD * generator.choice([0.01, 0.3, 1.0, 1.0], (count, 1))
    for _ in range(4 * ends_without_f_tilde):
        end = loop.moved(start, loop.sample(start), factor, age)
        wanted = loop.f_tilde(*start, factor) - loop.f_tilde(*end, factor)
        start = loop.with_f_tilde(start, wanted, factor)
    sample = loop.sample(start)
    path = [loop.moved(start, sample, factor, part * age) for part in np.linspace(0.0, 1.0, 9)]
    end = path[-1]
    sides = [np.sign(loop.errors(*x[:3])[0]) for x in (start, end)]
    assert not near or np.any(sides[0] != sides[1], axis=1).mean() > 0.1
    limits = np.abs([loop.held_rates(state, sample, factor) for state in path]).max(axis=0)
    if rough:
        limits = np.concatenate([limits, np.abs(loop.differences(start, sample))])
    limits = 1.05 * np.moveaxis(limits, 1, 0)
    points, levels = loop.points(end, factor)
    # The times are those of the first period.
    points[:, 0] = np.mod(points[:, 0], 2.0 * np.pi)
    x = np.array([coordinates_of(point, problem.sign_count) for point in points])
    return OwnRuns(problem, loop, start, sample, factor, age, end, levels, x, path, limits)


KINDS = [(POLES, False), (EXACT, True)]
"""Steps of the observer, and whether the runs are those of a pendulum with rounded positions."""


@pytest.mark.slow
@pytest.mark.parametrize(("observer", "rough"), KINDS)
@pytest.mark.parametrize("near", [0.0, 0.02])
def test_bound_over_boxes_is_above_the_rate_of_runs_between_samples(near, observer, rough):
    """Boxes contain the end of a path of an own run."""
    runs = own_runs(near, observer=observer, rough=rough)
    expected = runs.loop.rate_of_lyapunov(runs.end, runs.sample, runs.factor)
    generator, gaps = np.random.default_rng(1), []
    for size in (0.0, 1e-3, 1e-2, 0.03):
        bounds = enclosed(runs, runs.problem.bound, size, generator)[1][0][:, 0]
        assert not np.any(bounds < expected - 1e-9)
        if size <= 1e-3:
            assert np.all(np.isfinite(bounds))
        gaps.append(np.median(bounds - expected))
    assert gaps == sorted(gaps)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [POLES, EXACT, "limits"])
def test_bound_over_boxes_is_above_the_rate_of_runs_with_delays_or_limits(kind):
    """After three periods, with an active torque that is up to a period and a delay old."""
    loop = own_loop(EXACT if kind == EXACT else POLES, 100.0, links=SampledPendulum)
    longest = 0.0 if kind == "limits" else DELAY
    if kind == "limits":
        loop.ends = (-9.0, 12.0)
        scenario = limited(sampled(pendulum()), loop.ends[1], lower_limit=loop.ends[0])
        problem = arm_problem(scenario, within(1.0)).with_active_limits
    else:
        problem = arm_problem(sampled(pendulum(), observer=kind, delay=DELAY), within(1.0))
    state, factor = loop.starts(60, 0.5, 4)
    active, generator, states = loop.sample(state)[0], np.random.default_rng(2), []
    for _ in range(3):
        delay = longest * generator.choice([0.0, 0.4, 1.0, 1.0], (60, 1))
        some, active = loop.period_with_delay(state, factor, active, delay)
        state = some[-1][0]
        states += some if longest else some[2:]
    rows = np.abs([loop.held_rates(*some, factor) for some in states]).max(axis=0)
    more = np.ones((1, *factor.shape))
    if kind == "limits":
        more = np.max([np.abs(loop.differences(*some)) for some in states[::2]], axis=0)
        assert 0.3 < np.mean(more[0] > 0.0) < 0.9
    limits = 1.05 * np.moveaxis(np.concatenate([rows, more]), 1, 0)
    for end, sample in states[-4:]:
        expected = loop.rate_of_lyapunov(end, sample, factor)
        points, levels = loop.points(end, factor)
        points[:, 0] = np.mod(points[:, 0], 2.0 * np.pi)
        x = np.array([coordinates_of(point, 1) for point in points])
        runs = OwnRuns(problem, loop, None, None, factor, None, end, levels, x, None, limits)
        for size in (0.0, 1e-2):
            bounds = enclosed(runs, problem.bound, size, np.random.default_rng(1))[1][0][:, 0]
            assert not np.any(bounds < expected - 1e-9)
            assert size or np.isfinite(bounds).mean() > 0.9


def enclosures_of(runs, size, *, period=PERIOD, D=None, L=None):
    """Lower and upper ends of `Enclosures` over boxes that contain the ends of runs."""
    bound = runs.problem.bound
    function = Enclosures(bound.structure, bound.places, ())
    zero = np.zeros_like(runs.factor)
    more = [zero if x is None else x for x in (D, L)]
    ends = enclosed(runs, function, size, np.random.default_rng(1), period=period, more=more)
    low, high = (Found(*some) for some in ends)
    # The bounds of rates of a single run are too small to enclose some paths.
    assert np.isnan(low.xi).any(axis=1).mean() < 0.1
    return low, high


def assert_inside(value, low, high, slack=0.0):
    """Whether enclosures contain a value, but for `slack` of its largest size; NaN is none."""
    slack = slack * np.abs(value).max() + 1e-9
    assert not np.any((low > value + slack) | (value - slack > high))


def affine(found, name, f_tilde):
    """The ends of an affine function of f_tilde."""
    values = [getattr(some, name) for some in found]
    n = f_tilde.shape[1]
    slopes = [getattr(some, f"{name}_slope").reshape(-1, n, n) for some in found]
    products = [slope * f_tilde[:, None, :] for slope in slopes]
    least = values[0] + np.minimum(*products).sum(axis=-1)
    return least, values[1] + np.maximum(*products).sum(axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize(("observer", "rough"), KINDS)
@pytest.mark.parametrize(("near", "ends_without_f_tilde"), [(0.0, False), (0.02, True)])
def test_enclosures_contain_paths_and_means_of_runs(near, ends_without_f_tilde, observer, rough):
    """The bounds of the rates are hardly above those of each run."""
    runs = own_runs(near, ends_without_f_tilde, observer=observer, rough=rough)
    loop, end, age = runs.loop, runs.end, runs.age
    f_tildes, differences, values = [], [], []
    for state in runs.path:
        e1, _, e2 = loop.errors(*state[:3])
        # xi is in parts of the width on the side of the end of the path.
        _, _, _, k_l, k_u, _, _ = loop.tube(state[0])
        width = np.where(loop.errors(*end[:3])[0] > 0.0, k_u, k_l)
        f_tildes.append(loop.f_tilde(*state, runs.factor))
        differences.append(loop.differences(state, runs.sample))
        values.append((e1 / width, e2))
    (D_0, L_0), (D, L) = differences[0], differences[-1]
    paths = [f_tildes, *zip(*differences, strict=True)]
    mean_f_tilde, mean_D, mean_L = (np.tensordot(SIMPSON, np.array(path), 1) for path in paths)
    for size in (0.0, 1e-3, 1e-2):
        low, high = enclosures_of(runs, size)
        for (xi, e2), f_tilde in zip(values, f_tildes, strict=True):
            assert_inside(xi, low.xi, high.xi)
            assert_inside(e2, low.e2, high.e2)
            assert_inside(f_tilde, low.f_tilde, high.f_tilde)
        # Means of Simpson's rule have an error where a path crosses e1 = 0.
        slack = 1e-2 if near else 1e-6
        assert_inside(mean_D, low.D, high.D, slack)
        assert_inside(mean_L, low.L, high.L, slack)
        products = [some.growth * f_tildes[-1] for some in (low, high)]
        least, most = np.minimum(*products) + low.rest, np.maximum(*products) + high.rest
        assert_inside(mean_f_tilde, least, most, slack)
        assert_inside(D_0, low.first_D, high.first_D)
        assert_inside(L_0, low.first_L, high.first_L)
        changes = (D_0 - D) / age, (L - L_0) / age
        for name, rate in zip(("command", "lag", "p_rate"), (*changes, sum(changes)), strict=True):
            least, most = affine((low, high), name, f_tildes[-1])
            assert_inside(rate, least, most, 1e-6)


SIMPSON = np.array([1.0, 4.0, 2.0, 4.0, 2.0, 4.0, 2.0, 4.0, 1.0]) / 24.0


@pytest.mark.slow
@pytest.mark.parametrize(("observer", "rough"), KINDS)
def test_terms_of_the_bound_are_those_of_other_equations(observer, rough):
    """Over points and for a short period, enclosures are narrow."""
    runs = own_runs(observer=observer, rough=rough)
    loop, short = runs.loop, 1e-12
    u, phi, n = now = loop.without_errors(runs.end)
    sample = [x + np.random.default_rng(5).normal(size=x.shape) for x in now]
    D, L = loop.differences(runs.end, sample)
    found = enclosures_of(runs, 0.0, period=short, D=D, L=L)
    command, lag, _ = loop.held_rates(runs.end, sample, runs.factor)
    f_tilde = loop.f_tilde(*runs.end, runs.factor)
    for name, rate in (("under_command", command), ("under_lag", lag)):
        ends = affine(found, name, f_tilde)
        assert_inside(rate, *ends)
        assert np.max(ends[1] - ends[0]) < 1e-3 * np.abs(rate).max()
    # What D = -u' and L = L' add to V_w'.
    added = loop.rate_of_lyapunov(runs.end, [u - command, phi - lag, n], runs.factor)
    added = (added - loop.rate_of_lyapunov(runs.end, now, runs.factor))[:, None]
    values = [some.power for some in found]
    slopes = [some.push[:, None, :] for some in found]
    joints = f_tilde.shape[1]
    squares = [some.slope.reshape(-1, joints, joints) * WEIGHT for some in found]
    products = [f_tilde[:, None, :] * x for x in slopes]
    pairs = [np.einsum("bi,bij,bj->bij", f_tilde, x, f_tilde) for x in squares]
    least = values[0] + np.minimum(*products).sum(axis=2)
    least = least + np.minimum(*pairs).sum(axis=(1, 2))[:, None]
    most = values[1] + np.maximum(*products).sum(axis=2)
    most = most + np.maximum(*pairs).sum(axis=(1, 2))[:, None]
    assert_inside(added, least, most)
    assert np.max(most - least) < 1e-2 * np.abs(added).max()
    # What the D and L at the sample add.
    added = loop.rate_of_lyapunov(runs.end, sample, runs.factor)
    added = added - loop.rate_of_lyapunov(runs.end, now, runs.factor)
    products = [f_tilde * some.first_push for some in found]
    least = found[0].first_power[:, 0] + np.minimum(*products).sum(axis=1)
    most = found[1].first_power[:, 0] + np.maximum(*products).sum(axis=1)
    assert_inside(added, least, most)
    assert np.max(most - least) < 1e-2 * np.abs(added).max()


@pytest.mark.slow
def test_rates_on_the_set_contain_those_of_other_equations():
    """Over points, the ends are near the rates under some D and L of the largest size."""
    runs = own_runs()
    u, phi, n = runs.loop.without_errors(runs.end)
    sizes = PERIOD * runs.limits[:, :2]
    rates = []
    for signs in np.array(np.meshgrid(*[[-1.0, 1.0]] * 4)).reshape(4, -1).T:
        sample = (u + signs[:2] * sizes[:, 0], phi - signs[2:] * sizes[:, 1], n)
        rates.append(runs.loop.held_rates(runs.end, sample, runs.factor))
    found = enclosures_of(runs, 0.0)
    f_tilde = runs.loop.f_tilde(*runs.end, runs.factor)
    width = np.ptp(rates, axis=0)
    for k, name in enumerate(("set_command", "set_lag", "set_mismatch")):
        ends = affine(found, name, f_tilde)
        for some in rates:
            assert_inside(some[k], *ends)
        if k < 2:
            assert np.nanmedian((ends[1] - ends[0]) / width[k]) < 1.5


class BothSides(NamedTuple):
    """Slope and virtual velocity of a barrier on both sides of a tube."""

    ratio: float

    def __call__(self, x, constants):
        error, sign = x[:1], x[1:]
        barrier = arm_held.TwoSided(without_guard(ij.barriers.Integral()), sign)
        width, zero = jnp.ones(1), jnp.zeros(1)
        tube = Tube(zero, zero, -width, self.ratio * width, 0.3 * width, -0.2 * width)

        def functions(error):
            alpha = barrier.virtual_velocity(tube, error, width, 0.1 * width)
            return jnp.concatenate([barrier.slope(tube, error), alpha])

        return jax.jvp(functions, (error,), (width,))


@pytest.mark.slow
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_barrier_on_both_sides_contains_its_values_on_each(sign):
    """Also further from the reference than twice the width of the other side."""
    ratio = 5.0
    for ends in ((-1e-3, 1e-3), (-0.9, 4.5), (-0.02, 0.9), (-0.5, 0.1), (-1e-9, 3.0)):
        low, high = (np.array([[end, sign]]) for end in ends)
        lower, upper = enclose(BothSides(ratio), low, high)
        e = np.linspace(*ends, 1001)
        k = np.where(e > 0.0, ratio, 1.0)
        slope, bend = 2.0 * e / (k**2 - e**2), 2.0 * (k**2 + e**2) / (k**2 - e**2) ** 2
        for values, of_slope in ((slope, 0), (bend, 1)):
            least, most = lower[of_slope][0, 0], upper[of_slope][0, 0]
            assert least <= values.min() and values.max() <= most


def rounded(q):
    return 2.0 * READING * np.round(q / (2.0 * READING))


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [*STEPS, f"{POLES} with rounded positions", f"{EXACT} with a delay"]
)
def test_runs_of_the_package_are_those_of_other_equations(case):
    """A run from a point of the level set, with the estimate of its last sample."""
    observer, _, more = case.partition(" with ")
    sensor, measured = (ROUGH, rounded) if more == "rounded positions" else (None, None)
    delay = DELAY if more == "a delay" else 0.0
    problem, loop = problem_of_paper_loop(observer, sensor), own_loop(observer, measured=measured)
    state, factor = loop.starts(1, LEVEL, 5)
    points, level = loop.points(state, factor)
    scenario = problem.scenario_at(points[0], problem.constants(WEIGHT, level[0]))
    scenario = dataclasses.replace(
        scenario, sampling=ij.Sampling(PERIOD, delay=delay, observer=observer)
    )
    run = ij.simulate(scenario, duration=6 * PERIOD, dt=PERIOD / 4)
    # The torque before the first command is that which balances the model's gravity.
    active = loop.dynamics(state[1], np.ones_like(factor))[2]
    for k in range(6):
        np.testing.assert_allclose(run.q[4 * k], state[1][0], rtol=1e-8)
        estimate = loop.sample(state)[1][0]
        np.testing.assert_allclose(run.disturbance_estimate[4 * k], estimate, rtol=1e-6)
        states, active = loop.period_with_delay(state, factor, active, delay)
        state = states[-1][0]


class FirstEnclosures(OfStructure):
    """D and L at a sample, of one structure."""

    def __call__(self, x, constants):
        numbers = jax.tree.unflatten(self.structure, constants[:-1])
        at = coordinates(x, 2, self.places.coordinates)
        parts = arm_held.two_sided(numbers.parts, at.sign)
        first = arm_held.first_differences(parts, arm_errors(numbers, at).errors)
        return [first.D, first.L + jnp.where(first.is_inside, 0.0, jnp.nan)]


@pytest.mark.slow
def test_differences_at_samples_of_two_links_contain_those_of_other_equations():
    """Over points, the ends are near the differences under the largest errors."""
    problem, loop = problem_of_paper_loop(EXACT, ROUGH), own_loop(EXACT)
    for near in (0.0, 0.02):
        state, factor = loop.starts(60, LEVEL, 9, near=near)
        points, levels = loop.points(state, factor)
        points[:, 0] = np.mod(points[:, 0], 2.0 * np.pi)
        x = np.array([coordinates_of(point, 2) for point in points])
        limits = np.ones((60, 5, 2))
        runs = OwnRuns(problem, loop, state, None, factor, None, state, levels, x, None, limits)
        function = FirstEnclosures(problem.bound.structure, problem.bound.places, ())
        low, high = enclosed(runs, function, 0.0, np.random.default_rng(1))
        largest = np.zeros((2, 60, 2))
        for signs in np.array(np.meshgrid(*[[-1.0, -0.4, 0.4, 1.0]] * 2)).reshape(2, -1).T:
            loop.measured = lambda q, shift=READING * signs: q + shift
            found = loop.differences(state, loop.sample(state))
            for k in range(2):
                assert_inside(found[k], low[k], high[k])
            largest = np.maximum(largest, np.abs(found))
        for k in range(2):
            assert np.median(high[k] / largest[k]) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("observer", STEPS)
def test_level_of_the_start_is_that_of_the_first_sample(observer):
    """The observer starts with eta = 0, so that its estimate is the gain times the momentum."""
    loop = pendulum(initial=ij.Initial(q=[0.8], dq=[1.0]))
    expected = start_of(arm_problem(loop, {}))
    found = start_of(arm_problem(sampled(loop, 5e-3, observer), {}))
    np.testing.assert_allclose(found.energy, expected.energy, rtol=1e-12)
    momentum = 2.0 * 0.175**2 + 0.06
    loop = own_loop(observer, kf=100.0, period=5e-3)
    estimate = (loop.gain + loop.momentum_gain) * momentum
    np.testing.assert_allclose(found.half_square, 0.5 * estimate**2, rtol=1e-12)


@functools.cache
def proof(period, observer=POLES, counts=None, delay=0.0, **options):
    given = {"level": 0.5, "weight": WEIGHT, "parameters": within(1.0), "progress": False}
    scenario = sampled(pendulum(), period, observer, delay=delay)
    if counts is not None:
        scenario = dataclasses.replace(scenario, sensor=encoder(counts))
    return ij.prove(scenario, **given | options)


@pytest.mark.slow
def test_a_sampled_pendulum_is_proved_and_its_runs_stay_inside_the_bounds():
    found = proof(PERIOD)
    assert found.proved and found.torque.is_proved
    text = repr(found)
    assert "of the loop sampled every 0.001 s is invariant" in text
    assert "A run starts at a sample" in text
    assert "continuous" not in found.sentence() and np.all(found.held_rates > 0.0)
    for run in found.adversarial_runs(8, duration=0.5):
        assert run.ok and np.max(np.abs(run.xi)) <= found.tube.xi.max()


@pytest.mark.release
def test_runs_of_two_links_stay_in_a_proved_set_at_all_times():
    scenario = sampled(paper_loop(), 0.5 * PERIOD)
    assert ij.prove(scenario, level=LEVEL, weight=WEIGHT, parameters=MASSES, progress=False).proved
    loop = own_loop(POLES, kf=100.0, period=0.5 * PERIOD)
    state, factor = loop.starts(10_000, LEVEL, 6)
    for _ in range(600):
        sample = loop.sample(state)
        for _ in range(2):
            state = loop.moved(state, sample, factor, 0.25 * PERIOD, steps=2)
            assert np.all(loop.lyapunov(*state, factor) <= LEVEL)


@pytest.mark.slow
def test_a_pendulum_with_the_exact_step_and_rounded_positions_is_proved():
    """Own runs, with any errors up to half of a count, do not leave the set at any time."""
    counts = 10_000.0
    found = proof(PERIOD, EXACT, counts)
    assert found.proved and 'a step of the kind "exact"' in repr(found)
    assert "positions with errors of at most 0.000314 rad, and exact velocities" in repr(found)
    assert found.torque is None and found.held_rates.shape == (5, 1)
    error, generator = np.pi / counts, np.random.default_rng(8)
    signs = generator.choice([-1.0, 1.0], (400, 1))

    def measured(q):
        # A quarter of the runs has errors of a constant sign, and others at random.
        random = generator.uniform(-1.0, 1.0, q.shape)
        return q + error * np.where(np.arange(len(q))[:, None] % 4, random, signs)

    loop = own_loop(EXACT, 100.0, measured=measured, links=SampledPendulum)
    state, factor = loop.starts(400, 0.5, 6)
    np.testing.assert_allclose(loop.lyapunov(*state, factor), 0.5, rtol=1e-9)
    for _ in range(300):
        sample = loop.sample(state)
        for _ in range(2):
            state = loop.moved(state, sample, factor, 0.5 * PERIOD, steps=2)
            assert np.all(loop.lyapunov(*state, factor) < 0.5)
    for run in found.adversarial_runs(2, duration=0.2):
        assert run.ok and np.max(np.abs(run.xi)) <= found.tube.xi.max()


@pytest.mark.slow
def test_a_pendulum_with_delays_is_proved_and_no_run_leaves_the_set():
    """Own runs, with any delays up to the longest one and any admitted torque before."""
    found = proof(PERIOD, delay=DELAY)
    assert found.proved and 0.0 < found.start.level < 0.5
    text = repr(found)
    assert "with delays up to 0.00025 s is not left by runs from {V_w <= 0." in text
    assert "Starts are those at which the torque before the first command differs" in text
    assert "Guaranteed from the first command on [N m]: |tau| <=" in text
    assert found.to_xarray().start_torque == found.start.torque
    loop, generator = own_loop(POLES, 100.0, links=SampledPendulum), np.random.default_rng(8)
    state, factor = loop.starts(400, found.start.level, 6)
    active = loop.sample(state)[0]
    active = active + found.start.torque * generator.choice([-1.0, -0.3, 1.0], (400, 1))
    constant = DELAY * generator.uniform(size=(400, 1))
    constant[::2] = DELAY
    for _ in range(300):
        random = DELAY * generator.choice([0.0, 0.5, 1.0], (400, 1))
        delays = np.where(np.arange(400)[:, None] % 4, constant, random)
        states, active = loop.period_with_delay(state, factor, active, delays)
        assert all(np.all(loop.lyapunov(*some, factor) < 0.5) for some, _ in states)
        state = states[-1][0]
    # V_w' for all D and L that are allowed before the first command, everywhere in the set.
    R_u, R_L, _, growth = found.held_rates
    for level in (0.5, 0.1, 0.02):
        state, factor = loop.starts(400, level, 9)
        u, phi, n = loop.sample(state)
        D = (PERIOD + DELAY) * R_u * generator.choice([-1.0, 0.5, 1.0], (400, 1))
        L = PERIOD * (R_L + R_u) * generator.choice([-1.0, 0.5, 1.0], (400, 1))
        assert np.all(loop.rate_of_lyapunov(state, (u + D, phi, n - L), factor) < growth)
    runs = found.adversarial_runs(2, duration=0.2)
    assert len(runs) > 0
    for run in runs:
        assert run.ok and np.max(np.abs(run.xi)) <= found.tube.xi.max()
    with pytest.raises(ValueError, match="a level of V_w with a delay"):
        proof(PERIOD, delay=DELAY, level=None)


@pytest.mark.slow
def test_a_run_that_leaves_the_set_refutes_it():
    """V_w of the run by equations of its own."""
    period = 20e-3
    found = proof(period, runs=4)
    assert found.verdict == Verdict.REFUTED and "is not invariant for all t" in found.sentence()
    assert "at a sample, and stays inside the bounds; replay() returns it." in repr(found)
    with pytest.warns(ij.SimulationWarning, match="sampled too slowly"):
        run = found.replay(record_every=round(period / found.violation.dt))
    assert not int(run.status) & (ij.Status.BOUND_VIOLATED | ij.Status.INACCURATE)
    mass, model_mass = found.violation.state.parameters["plant.mass[0]"], 2.0
    inertia, model_inertia = (0.175**2 * m + 0.06 for m in (mass, model_mass))
    # The plant and the model have the same gravity but for the factor of the mass.
    gravity = np.asarray([run.scenario.model.gravity(q) for q in run.q])
    u, estimate = np.asarray(run.tau), np.asarray(run.disturbance_estimate)
    acceleration = (u - mass / model_mass * gravity) / inertia
    f_tilde = model_inertia * acceleration + gravity - u - estimate
    barrier = -np.log(1.0 - np.asarray(run.xi) ** 2)
    V = (barrier + 0.5 * model_inertia * run.e2**2 + 0.5 * WEIGHT * f_tilde**2)[:, 0]
    np.testing.assert_allclose(V[0], 0.5, rtol=1e-9)
    np.testing.assert_allclose(V.max(), found.violation.value, rtol=1e-4)
    assert found.violation.value > 0.5


@pytest.mark.slow
def test_the_longest_period_is_proved_next_to_one_that_is_not():
    options = {"level": 0.5, "weight": WEIGHT, "parameters": within(1.0), "progress": False}
    options |= {"accuracy": 0.5, "max_boxes": 20_000}
    loop = sampled(pendulum(), 1.0)
    found = ij.largest_period(loop, between=(PERIOD, 8 * PERIOD), **options)
    periods = [x.value for x in found.history]
    assert found.proved and periods[:2] == [PERIOD, 8 * PERIOD]
    proved = [x.value for x in found.history if x.verdict == Verdict.PROVED]
    longest, next_one = max(proved), min(set(periods) - set(proved))
    assert found.scenario.sampling.period == longest < next_one <= 1.5 * longest
    text = repr(found)
    assert "Tried periods [s]: 0.001 proved, 0.008" in text
    assert f"{longest:.4g}, the next one that was tried is {next_one:.4g} (" in text

    def within_one_step(low):
        return repr(ij.largest_period(loop, between=(low, 1.2 * low), **options))

    assert "The greatest value of the range is proved; none beyond it" in within_one_step(PERIOD)
    assert "The least value of the range is not proved; no greater" in within_one_step(8e-3)
