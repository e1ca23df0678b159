"""The stated error of loops that round or hold is never below the error, or it is flagged."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import iblf_jax as ij
from iblf_jax.core.status import Status
from iblf_jax.simulation import error_growth, stability
from iblf_jax.simulation.closed_loop import initial_state, integrated_part
from iblf_jax.simulation.error_estimate import RELATIVE, TOLERANCE, Accuracy
from iblf_jax.simulation.scenario import canonical

BASE = ij.with_parameters(
    ij.presets.zhang_yan_2024(variant="corrected"), {"controller.K2": 4.0, "observer.kf": 4.0}
)


def sampled(sensor=None, actuator=None, **timing):
    parts = {"sensor": sensor, "actuator": actuator}
    parts = {name: part for name, part in parts.items() if part is not None}
    return ij.with_parts(BASE, sampling=ij.Sampling(period=4e-3, **timing), **parts)


ENCODER = ij.sensors.Encoder(counts=1024.0, velocity=ij.sensors.FilteredDifference(cutoff=192.57))
TRACKING = ij.sensors.Encoder(counts=1024.0, velocity=ij.sensors.Tracking(bandwidth=150.0))
QUANTISER = ij.actuators.Quantiser(step=1.5)
BACKLASH = ij.actuators.Backlash(gap=0.5, bandwidth=150.0)
DIRECT = ij.sensors.Levels((ij.sensors.Direct(resolution=1e-3), ij.sensors.Direct()))
LOOPS = {
    "tracking": lambda: sampled(TRACKING),
    "two directs": lambda: sampled(DIRECT),
    "difference, quantiser and delay": lambda: sampled(ENCODER, QUANTISER, delay=1.3e-3),
    "limited motor": lambda: sampled(actuator=ij.actuators.Motor(bandwidth=150.0, limit=25.0)),
    "backlash": lambda: sampled(actuator=BACKLASH),
    "trigger": lambda: sampled(trigger=ij.EventTrigger(relative=0.05, absolute=0.5)),
    "continuous quantiser": lambda: ij.with_parts(BASE, actuator=QUANTISER),
    "continuous dead zone": lambda: ij.with_parts(
        BASE, actuator=ij.actuators.DeadZone(lower=-3.0, upper=3.0)
    ),
}
RUNS = 5
"""Random loops of each structure: 40 in all."""
SMOOTH = "limited motor"


def random_values(scenario, rng):
    def between(low, high):
        return np.exp(rng.uniform(np.log(low), np.log(high), 2))

    drawn = {
        "controller.K2": between(3.0, 8.0),
        "controller.k1": between(1.0, 4.0),
        "observer.kf": between(3.0, 8.0),
        "reference.frequency": between(0.5, 3.0),
        "reference.amplitude": between(0.02, 0.1),
        "initial.q": rng.uniform(0.6, 0.8, 2),
        "sensor.counts": np.round(between(500.0, 2.0**15)),
        "actuator.step": between(0.01, 2.0),
    }
    has = {parameter.path for parameter in ij.parameters(scenario)}
    return {path: x for path, x in drawn.items() if path in has}


def run(scenario, duration, dt, record_every=1):
    how = {"duration": duration, "dt": dt, "record_every": record_every, "seed": 3}
    with warnings.catch_warnings(action="ignore"):
        return ij.simulate(scenario, **how)


def assess(scenario):
    """A run, and its true error by a run at a sixteenth of the step, relative to the tube."""
    coarse, fine = run(scenario, 2.0, 2e-3), run(scenario, 2.0, 2e-3 / 16, 16)
    return coarse, float(np.max(np.abs(coarse.q - fine.q) / (fine.upper - fine.lower)))


def is_flagged(found):
    return bool(int(found.status) & Status.INACCURATE)


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPS)
def test_the_stated_error_holds(name, rng):
    loop, ratios = LOOPS[name](), []
    for _ in range(RUNS):
        scenario = ij.with_parameters(loop, random_values(loop, rng))
        found, error = assess(scenario)
        stated = float(found.metrics[RELATIVE])
        assert stated >= error or is_flagged(found), (error, stated)
        assert is_flagged(found) == (not stated <= TOLERANCE)
        ratios.append(stated / error)
    assert name != SMOOTH or np.median(ratios) < 1000.0


LIMIT_CYCLE = {
    "controller.K2": [5.41514, 1.61418],
    "controller.k1": [2.82538, 0.94105],
    "controller.weight": [0.06931, 0.24189],
    "observer.kf": [1.48999, 20.43248],
    "reference.frequency": [1.24512, 0.84695],
    "reference.amplitude": 1e-5,
    "initial.q": np.array([0.74958, 0.76142]),
    "sensor.counts": [298.0, 11409.0],
    "sensor.velocity.cutoff": 38.2525,
}
"""At rest a code of joint 1 alternates, and joint 2 swings by ten of its counts in resonance."""


@pytest.mark.slow
def test_a_limit_cycle_in_which_rounding_is_no_noise_is_covered():
    """The worst of a search: the difference is 6.5 times the root of the sum of squares."""
    scenario = ij.with_parameters(sampled(ENCODER), LIMIT_CYCLE)
    found = run(scenario, 6.4, 2e-3)
    stated = np.asarray(found.metrics.numerical_error)
    for k in range(4):
        moved = LIMIT_CYCLE["initial.q"] + np.array([1.0, -0.5]) * 2e-6 * (k + 1)
        other = run(ij.with_parameters(scenario, {"initial.q": moved}), 6.4, 2e-3)
        difference = np.max(np.abs(found.q - other.q), axis=0)
        assert np.all(difference < stated) and difference[1] > 4.0 * 2 * np.pi / 11409.0


@pytest.mark.slow
def test_a_loop_whose_codes_are_certain_has_the_error_of_the_open_loop():
    """At an eighth of the step no code can differ, and the estimate falls with the fourth power."""
    quantised = sampled(actuator=QUANTISER)
    words = r"rounds a reading.*actuator\.step.*dt=0\.0002"
    with pytest.warns(ij.SimulationWarning, match=words):
        coarse = ij.simulate(quantised, duration=2.0, dt=2e-3)
    fine = run(quantised, 2.0, 2.5e-4)
    assert is_flagged(coarse) and not is_flagged(fine)
    assert float(coarse.metrics[error_growth.BOUND]) > TOLERANCE
    assert float(fine.metrics[error_growth.BOUND]) == 0.0
    error = np.max(np.abs(fine.q[::8] - run(quantised, 2.0, 2e-3 / 32, 32).q))
    assert error < float(np.max(fine.metrics.numerical_error)) < 200.0 * error


def linearised(scenario):
    """A scenario, its start, the derivative there, what grows, the one-period map, and the size of
    the plant."""
    scenario = canonical(scenario)
    state = initial_state(scenario)

    @jax.jit
    def of_start(scenario, state):
        derivative = stability.jacobian(scenario, jnp.zeros(()), state)
        growth = error_growth.initial_growth(scenario, state, derivative)
        return derivative, growth, stability.period_map(scenario, state, derivative)

    size = ravel_pytree(integrated_part(state))[0].size
    return scenario, state, *of_start(scenario, state), size


def test_the_bounds_are_those_of_the_worst_and_of_random_rounding_errors():
    """The sums over periods, against some in NumPy, over a run of few periods and a long one."""
    scenario, state, derivative, growth, Phi, plant = linearised(sampled(ENCODER, QUANTISER))
    A, B = derivative[:plant, :plant], derivative[:plant, plant : plant + 2]
    by_torque = np.asarray(stability.linear_flow(A, B, scenario.sampling.period))[:, plant:]
    law = np.asarray(derivative[plant:, :2])
    by_reading = np.concatenate([by_torque @ law[:2], law[2:]]) * 2 * np.pi / 1024
    by_level = np.concatenate([by_torque, np.zeros_like(law[2:])]) * 1.5
    term, terms = np.concatenate([by_reading, by_level], axis=1), []
    for _ in range(8192):
        terms.append(term[:2])
        term = np.asarray(Phi) @ term
    terms = np.array(terms)

    @jax.jit
    def found(periods):
        given = (scenario, growth, state, derivative, Phi, periods)
        return *error_growth._bounds(*given), error_growth.bound(*given)

    worst = np.abs(terms).sum(axis=2)
    np.testing.assert_allclose(found(20.0)[0], worst[:20].sum(axis=0), rtol=1e-9)
    rigorous, probable, lower = (np.asarray(x) for x in found(5000.0))
    exact = worst[:5000].sum(axis=0)
    assert np.all(rigorous >= exact * (1 - 1e-9)) and np.all(rigorous < 2.0 * exact)
    constant = np.abs(terms.sum(axis=0)).sum(axis=1)
    deviations = np.sqrt((terms**2).sum(axis=(0, 2)))
    likely = np.sqrt(2 * np.log(2 * 2 * 5000 / error_growth.PROBABILITY)) * deviations
    np.testing.assert_allclose(probable, constant + likely, rtol=1e-9)
    np.testing.assert_array_equal(lower, np.minimum(rigorous, probable))


@pytest.mark.slow
def test_the_bound_covers_the_longest_run_and_may_be_infinite():
    """Of x' = tau, which forgets no rounding error, it is N times that of a period."""
    scenario, state, derivative, growth, _, plant = linearised(sampled(actuator=QUANTISER))

    def bound(derivative, periods):
        Phi = stability.period_map(scenario, state, derivative)
        return error_growth.bound(scenario, growth, state, derivative, Phi, jnp.asarray(periods))

    grown = bound(derivative + 100.0 * jnp.eye(len(derivative)), 1e6)
    assert np.all(np.isposinf(grown))
    still = jnp.zeros_like(derivative).at[:2, plant : plant + 2].set(jnp.eye(2))
    growth = error_growth.initial_growth(scenario, state, jnp.zeros_like(derivative))
    for periods in (2.0**15, 2.0**20, 2.0**31):
        np.testing.assert_allclose(bound(still, periods), periods * 4e-3 * 1.5, rtol=1e-9)


def assessed(jumped, bounds, error=1e-3):
    """The stated error, the bound, and the error by the step, of a run in a tube of width 1."""
    none = jnp.zeros(2)
    growth = error_growth.ErrorGrowth((), jnp.asarray(jumped), none, none[0], ())
    accuracy = Accuracy((), none, none, jnp.full(2, error), jnp.asarray(error), growth)
    found, more = error_growth.with_growth(accuracy, jnp.full(2, bounds), jnp.ones(2))
    metrics = {RELATIVE: found.relative, **more}
    by_step = error_growth.errors_by_step(metrics)
    return [float(x) for x in (found.relative, more[error_growth.BOUND], by_step)]


BY_STEP = (0.02, 1e-3, 0.0), (0.02, 1e-5, 0.0), (0.02, 0.01, 0.01), (np.inf, 1e-3, 0.0)


@pytest.mark.parametrize(("bounds", "error", "by_step"), [*BY_STEP, (0.003, 0.004, 0.007)])
def test_a_smaller_step_reduces_what_is_no_bound_of_a_jump(bounds, error, by_step):
    expected = [pytest.approx(x, rel=1e-9) for x in (bounds + error, bounds, by_step)]
    assert assessed(1.0, bounds, error) == expected
    assert assessed(0.0, bounds, error)[:2] == [pytest.approx(error), 0.0]


def test_distance_to_the_next_level():
    command, none = jnp.array([0.2, 0.7]), jnp.zeros(2)
    part = ij.actuators.Quantiser(step=jnp.array([1.0, 0.5]))
    np.testing.assert_allclose(part.distance_to_jump(command, none, ()), [0.3, 0.05])
    lag = ij.actuators.Motor(bandwidth=100.0)
    first = ij.actuators.Chain((part, lag))
    np.testing.assert_allclose(first.distance_to_jump(command, none, first.init(none)), [0.3, 0.05])
    behind = ij.actuators.Chain((lag, part))
    np.testing.assert_allclose(behind.distance_to_jump(command, none, behind.init(none)), 0.0)
    assert behind.deviation is part.step or np.all(behind.deviation == part.step)


def test_smooth_loops_have_no_growing_error():
    assert not any(map(error_growth.is_interrupted, (sampled(), LOOPS[SMOOTH]())))
    rough = [LOOPS[name]() for name in ("continuous dead zone", "trigger")]
    rough += [sampled(ENCODER), ij.with_parts(BASE, actuator=BACKLASH)]
    assert all(map(error_growth.is_interrupted, rough))
    assert error_growth.rounds_continuously(LOOPS["continuous quantiser"]())
