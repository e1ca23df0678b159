"""Process noise: an independent program, known moments, and statistics of the first exit."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refused import assert_refused, refused
from scipy import linalg

import iblf_jax as ij
from iblf_jax import bounds, controllers, process_noise, references
from iblf_jax.engine.step_size import NOISY_PHASES
from iblf_jax.simulation import integrators
from iblf_jax.simulation.discontinuities import Span, divide_step
from iblf_jax.simulation.noise import (
    brownian_increment,
    least_distances,
    noise_key,
    with_noise_rates,
)
from iblf_jax.simulation.scenario import canonical

HEUN = "stochastic_heun"
INERTIA = 0.05 + 0.8 * 0.3**2
START, SPEED = 0.2, 0.5


def link(noise=None, stiffness: float = 1.2, damping: float = 0.4, g: float = 0.0, **parts):
    """One link under a PD law about a constant reference at 0: q" = (-Kp q - Kd q')/I + noise."""
    return ij.Scenario(
        plant=ij.robots.PlanarChain(mass=[0.8], length=[0.5], centre=[0.3], inertia=[0.05], g=g),
        reference=references.Sinusoid(offset=0.0, amplitude=0.0, frequency=1.0),
        bounds=bounds.Bounds(lower=bounds.Constant(-1.0), upper=bounds.Constant(1.0)),
        controller=controllers.PDGravity(Kp=stiffness, Kd=damping),
        initial=ij.Initial(q=[START], dq=[SPEED]),
        process_noise=noise,
        **parts,
    )


def independent_path(method, sigma, dW, dt):
    """The same loop in NumPy: gravity in plant and law cancels, so only the PD terms remain."""
    q, v = START, SPEED
    found = [(q, v)]

    def drift(q, v):
        return (-1.2 * q - 0.4 * v) / INERTIA

    for k, w in enumerate(dW):
        t = k * dt
        q1, v1 = q + v * dt, v + drift(q, v) * dt + sigma(t, v) * w
        if method == HEUN:
            v_end = v + 0.5 * dt * (drift(q, v) + drift(q1, v1))
            v_end += 0.5 * (sigma(t, v) + sigma(t + dt, v1)) * w
            q, v = q + 0.5 * dt * (v + v1), v_end
        else:
            q, v = q1, v1
        found.append((q, v))
    return np.array(found)


def wave(t, xp):
    return 0.5 + 0.3 * xp.sin(4.0 * t)


CASES = {
    "euler_maruyama": (process_noise.Additive([[0.7]]), lambda t, v: 0.7),
    HEUN: (
        process_noise.Diffusion(lambda t, x: wave(t, jnp) * jnp.ones_like(x[1:]), additive=True),
        lambda t, v: wave(t, np),
    ),
    "euler_maruyama, of Ito": (process_noise.Proportional(0.6), lambda t, v: 0.6 * v),
}


def increments(substeps, count):
    """Of steps of a length that is its argument."""
    noise = process_noise.Additive([[0.3], [0.2]], levels=(1, 2), substeps=substeps)
    key = noise_key(jax.random.PRNGKey(0), 0).astype(float)
    draw = jax.vmap(partial(brownian_increment, link(noise), key), in_axes=(0, None))
    return jax.jit(lambda dt: draw(jnp.arange(count, dtype=jnp.int32), dt)[..., 0])


def test_increments_of_steps_are_independent_and_have_their_length_as_variance():
    """Those of several substeps are on the path of short steps."""
    one, four = increments(1, 4096), increments(4, 4096)
    for found in (one(0.01), four(0.01)):
        pairs = np.concatenate([found[:-1], found[1:]], axis=1)
        np.testing.assert_allclose(np.cov(pairs.T) / 0.01, np.eye(4), atol=5 * np.sqrt(2 / 4096))
    of_substeps = np.reshape(one(0.01), (1024, 4, 2)).sum(axis=1)
    np.testing.assert_allclose(four(0.04)[:1024], of_substeps, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_trajectories_against_an_independent_program(case):
    noise, sigma = CASES[case]
    method, scenario = case.split(",")[0], link(noise, g=9.81)
    run = ij.simulate(scenario, duration=0.5, dt=5e-3, method=method, seed=4, backend="vmap")
    key = noise_key(jax.random.PRNGKey(4)).astype(float)
    noisy = canonical(scenario)
    increment = jax.vmap(lambda k: brownian_increment(noisy, key, k, jnp.asarray(5e-3)))
    dW = np.asarray(increment(jnp.arange(100)))[:, 0, 0]
    path = independent_path(method, sigma, dW, 5e-3)
    assert np.ptp(dW) > 0.1
    np.testing.assert_allclose(run.x[:, :, 0], path, atol=1e-12)
    assert np.all(np.isnan(run.metrics["numerical_error"]))
    assert not int(run.status) & int(ij.Status.INACCURATE)


@pytest.mark.parametrize("method", NOISY_PHASES)
def test_the_variance_of_a_mode_is_right_to_five_per_cent(method):
    def after(x, noise_rate):
        def rate(t, x):
            return -x + noise_rate, ()

        return float(integrators.step(method, rate, 0.0, jnp.asarray(x), z).state)

    z = NOISY_PHASES[method]
    own, of_noise = after(1.0, 0.0), after(0.0, 1.0 / z)
    variance = of_noise**2 * z / (1 - own**2)
    assert 0.03 < abs(variance / 0.5 - 1) < 0.05


@pytest.mark.slow
def test_the_recommended_step_is_that_of_a_noisy_mode():
    scenario = link(process_noise.Additive(0.7), stiffness=3.0, damping=2.0)
    dt = ij.recommended_dt(scenario, duration=1.0, method=HEUN)
    run = ij.simulate(scenario, duration=0.1, dt=dt, method=HEUN, backend="vmap")
    assert 0.1 < dt * float(run.fastest_mode) <= NOISY_PHASES["stochastic_heun"]
    coarse = 2.1 / float(run.fastest_mode)
    with pytest.warns(ij.SimulationWarning, match=f"Take dt={dt:g}"):
        run = ij.simulate(scenario, duration=2 * coarse, dt=coarse, method=HEUN, backend="vmap")
    assert int(run.status) & int(ij.Status.STEP_TOO_LARGE)
    assert_refused("has process noise", ij.recommended_dt, scenario, duration=1.0)


@pytest.mark.slow
def test_a_divided_step_has_the_increment_of_the_step():
    scenario, dt = canonical(link(process_noise.Additive(1.0))), jnp.asarray(0.1)
    times = jnp.asarray([0.13, 0.16])

    def increments(key):
        pieces = divide_step(times, Span(dt, 2 * dt, dt)).pieces
        noisy = with_noise_rates(scenario, key, jnp.int32(1), dt, pieces)
        parts = [piece.noise_rate[0, 0] * piece.length for piece in noisy]
        return jnp.stack([*parts, brownian_increment(scenario, key, jnp.int32(1), dt)[0, 0]])

    keys = jax.vmap(lambda i: noise_key(jax.random.PRNGKey(1), i))(jnp.arange(20_000))
    *parts, total = np.asarray(jax.jit(jax.vmap(increments))(keys.astype(float))).T
    np.testing.assert_allclose(sum(parts), total, atol=1e-15)
    covariance = np.cov(parts)
    np.testing.assert_allclose(covariance, np.diag([0.03, 0.03, 0.04]), atol=2e-3)


@pytest.fixture(scope="module")
def study():
    """An Ornstein-Uhlenbeck process of second order that is stationary at the end."""
    scenario = link(process_noise.Additive(2.6), stiffness=0.6, damping=0.5)
    options = {"duration": 4.0, "dt": 1e-2, "method": HEUN, "progress": False}
    options["metrics"] = (ij.metrics.Margin(), ij.metrics.FirstExit())
    return ij.monte_carlo(scenario, {}, runs=1500, **options)


@pytest.mark.slow
def test_first_exit(study):
    assert np.unique(study.metrics["margin"]).size == len(study)
    found = study.first_exit(joint="joint 0", instants=9)
    times = np.asarray(study.metrics["first_exit_time"])[:, 0]
    expected = [np.mean(times <= t) for t in found.t]
    assert 0.05 < expected[-1] < 0.95
    np.testing.assert_allclose(found.probability, expected)
    assert np.all(found.low <= found.probability) and np.all(found.probability <= found.high)
    np.testing.assert_array_equal(study.first_exit(instants=9).probability, found.probability)
    assert found.plot().axes[0].get_xlabel() == "time [s]"
    replayed, margin = study.replay(3), study.metrics["margin"][3]
    np.testing.assert_allclose(replayed.metrics["margin"], margin, atol=1e-12)


def first_exits(study, times, **changes):
    never = np.full(len(study) - len(times), np.inf, times.dtype)
    metrics = dict(study.metrics) | {"first_violation_time": np.append(times, never)}
    return dataclasses.replace(study, metrics=metrics, **changes).first_exit(instants=3)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_exit_at_the_last_instant_counts_in_every_precision(study, dtype):
    """k dt, rounded to the precision of a run, may exceed the end of the study."""
    end = round(study.duration / study.dt) * study.dt
    found = first_exits(study, np.full(600, np.nextafter(dtype(end), dtype(np.inf))))
    np.testing.assert_allclose(found.probability, [0.0, 0.0, 600 / len(study)])


def test_a_run_that_diverged_counts_at_the_end_and_a_missing_metric_is_named(study):
    status = np.where(np.arange(len(study)) < 3, np.int32(ij.Status.NOT_FINITE), np.int32(0))
    found = first_exits(study, np.array([1.0]), status=status)
    assert found.diverged == 2
    np.testing.assert_array_equal(found.times[:4], [1.0, 4.0, 4.0, np.inf])
    np.testing.assert_allclose(found.probability * len(study), [0.0, 1.0, 3.0])
    bare = dataclasses.replace(study, metrics={})
    for joint, missing in ((None, "Margin"), (0, "FirstExit")):
        assert_refused(rf"ij\.metrics\.{missing}\(\)", bare.first_exit, joint=joint)


@pytest.mark.slow
def test_pathwise_derivative_by_the_intensity():
    scenario = link(process_noise.Additive([[0.7]]))

    def end(intensity):
        noisy = ij.with_parameters(scenario, {"process_noise.intensity": intensity})
        run = ij.simulate(noisy, duration=0.2, dt=1e-2, method=HEUN, backend="vmap")
        return run.q[-1, 0]

    slope = jax.grad(end)(0.7)
    assert float(slope) == pytest.approx(float(end(0.8) - end(0.6)) / 0.2, rel=1e-8)
    assert abs(float(slope)) > 1e-4


def simulated(noise, method):
    return ij.simulate(link(noise), duration=0.1, dt=1e-2, method=method)


test_noise_or_a_method_that_does_not_fit_is_refused = refused(
    (lambda: simulated(None, "euler_maruyama"), "has no process noise"),
    (lambda: simulated(process_noise.Additive(0.1), "rk4"), "has process noise"),
    (lambda: simulated(process_noise.Proportional(0.1), HEUN), "depends on the state"),
    (lambda: process_noise.Additive(0.1, levels=()), "levels"),
    (lambda: process_noise.Additive(0.1, levels=(2, 1)), "increasing"),
    (lambda: process_noise.Additive([[0.1], [0.2]]), "rows"),
    (lambda: process_noise.Diffusion(3.0), "function"),
    (lambda: link(process_noise.Additive(0.1, levels=(3,))), "levels up to 2"),
    (lambda: link(process_noise.Diffusion(lambda t, x: x)), "shape"),
    (lambda: link(3.0), "ProcessNoise"),
)
WALL, EXIT_SIGMA, EXIT_RATE, EXIT_RUNS = 0.1, 0.1, 2.0, 20_000


def probability_of_exit(rate: float, duration: float, size: int = 400) -> float:
    """That dx = -rate x dt + sigma dW from 0 leaves (-WALL, WALL) before the duration: one minus
    the solution of the backward equation u_t = sigma^2/2 u_xx - rate x u_x, u = 0 at the walls."""
    x, h = np.linspace(-WALL, WALL, size + 1)[1:-1], 2 * WALL / size
    diffusion, drift = 0.5 * EXIT_SIGMA**2 / h**2, 0.5 * rate * x / h
    generator = np.diag(np.full(size - 1, -2 * diffusion))
    generator += np.diag(diffusion - drift[:-1], 1) + np.diag(diffusion + drift[1:], -1)
    return 1.0 - (linalg.expm(duration * generator) @ np.ones(size - 1))[size // 2 - 1]


def exits(rate: float, level: int) -> ij.Study:
    """Runs whose position is Brownian, or whose velocity is an Ornstein-Uhlenbeck process."""
    noise = process_noise.Additive(EXIT_SIGMA, levels=(level,))
    far, near = (bounds.Bounds(bounds.Constant(-x), bounds.Constant(x)) for x in (5.0, WALL))
    scenario = ij.with_parts(
        link(noise, stiffness=1e-9, damping=rate * INERTIA),
        initial=ij.Initial(q=[0.0], dq=[0.0]),
        bounds=(near, None) if level == 1 else (far, near),
    )
    how = {"duration": 1.0, "dt": 4e-3, "method": HEUN, "progress": False}
    return ij.monte_carlo(scenario, {}, runs=EXIT_RUNS, **how)


@pytest.mark.slow
@pytest.mark.parametrize(("level", "rate"), [(1, 0.0), (2, EXIT_RATE)], ids=["Brownian", "OU"])
def test_exits_between_two_instants_count(level, rate):
    exact = probability_of_exit(rate, 1.0)
    # Without a rate a small damping lets the velocity stay 0.
    study = exits(rate or 1.0, level)
    found = np.asarray(study.violation_probability.estimate)
    deviation = np.sqrt(exact * (1 - exact) / EXIT_RUNS)
    assert 0.2 < exact < 0.8 and abs(found - exact) < 3.5 * deviation
    name = {1: "margin", 2: "velocity_margin"}[level]
    margins = np.asarray(study.metrics[name])[:, 0]
    np.testing.assert_array_equal(margins <= 0, np.asarray(study.status) & 1025 != 0)
    # The instants alone miss exits: the walls seem to be 0.58 sigma sqrt(dt) farther away.
    if level == 1:
        reached = np.asarray(study.metrics["peak_error"])[:, 0]
        missed = exact - np.mean(reached >= WALL)
        assert missed > 4 * deviation


def test_the_smallest_distance_has_the_distribution_of_the_bridge():
    before, now, variance = 0.3, 0.5, 0.04
    uniform = jnp.asarray((np.arange(4000) + 0.5) / 4000)
    least = np.asarray(least_distances(jnp.asarray(before), jnp.asarray(now), variance, uniform))
    assert np.all(least <= before + 1e-6)
    for y in (-0.1, 0.0, 0.2):
        exact = np.exp(-2 * (before - y) * (now - y) / variance)
        assert np.mean(least < y) == pytest.approx(exact, abs=1e-3)
    ends = jnp.asarray([[0.3, jnp.inf], [0.5, jnp.inf]])
    none = least_distances(*ends, 0.0, uniform[:2])
    np.testing.assert_allclose(none, [0.3, np.inf], rtol=1e-6)
