"""A run says how accurate it is: its estimate against runs at a sixteenth of the step, its flags, and the step that is recommended."""

from __future__ import annotations

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SHORT

import iblf_jax as ij
from iblf_jax.core import linalg
from iblf_jax.core.status import Status
from iblf_jax.engine import step_size
from iblf_jax.engine.execute import run_batch
from iblf_jax.engine.step import Run
from iblf_jax.simulation.accuracy import RELATIVE, TOLERANCE
from iblf_jax.simulation.integrators import TABLEAUS
from iblf_jax.simulation.metrics import as_folds
from iblf_jax.simulation.scenario import canonical

RUNS = 48
FINER = 16


@pytest.fixture(scope="module")
def shaken(paper):
    """The paper's scenario under a torque of 5 N m at 6283 rad/s, which goes through a whole period in a step of 1 ms."""
    torque = ij.disturbances.Sinusoids(amplitude=5.0, frequency=6283.0, phase=[1.0, 0.3])
    return dataclasses.replace(paper, disturbance=torque)


def random_leaves(rng, n=2):
    """Leaves of RUNS random scenarios: signals up to 3,000 rad/s, gains of all sizes, starts anywhere in the tube."""

    def between(low, high):
        return np.exp(rng.uniform(np.log(low), np.log(high), (RUNS, n)))

    return {
        "reference.frequency": between(0.3, 60.0),
        "reference.amplitude": between(0.005, 0.14),
        "disturbance.frequency": between(0.3, 3000.0),
        "disturbance.amplitude": between(0.1, 5.0),
        "controller.k1": between(0.5, 10.0),
        "controller.K2": between(2.0, 20.0),
        "observer.kf": between(2.0, 20.0),
        "initial.q": rng.uniform(0.45, 0.85, (RUNS, n)),
        "initial.dq": rng.normal(0.0, 0.5, (RUNS, n)),
    }


def positions(scenario, varied, dt, steps, method):
    """Positions of a batch and its verdicts, at the instants of a step dt * FINER."""
    folds = as_folds((), jnp.float64)
    every = FINER if steps > 500 else 1
    run = jax.jit(lambda varied, dt: run_batch(scenario, varied, folds, dt, Run(steps, method, every)))
    found = run({path: jnp.asarray(x) for path, x in varied.items()}, jnp.asarray(dt))
    arrays = found.records[0]
    return (
        np.asarray(arrays["q"]),
        np.asarray(arrays["upper"] - arrays["lower"]),
        np.asarray(found.metrics[RELATIVE]),
        np.asarray(found.status),
    )


@pytest.mark.slow
@pytest.mark.parametrize("method", TABLEAUS)
def test_the_estimate_is_about_the_error(shaken, rng, method):
    """At 1, 2 and 5 ms, too large for some: no run is off by more than the tolerance without its flag, and good ones are not flagged."""
    scenario, varied, flagged, good = canonical(shaken), random_leaves(rng), 0, 0
    alarms = 0
    for dt in (1e-3, 2e-3, 5e-3):
        q, width, estimate, status = positions(scenario, varied, dt, 400, method)
        fine = positions(scenario, varied, dt / FINER, 400 * FINER, "rk4")[0]
        error = np.max(np.abs(q - fine) / width, axis=(1, 2))
        found = status & int(Status.INACCURATE | Status.STEP_TOO_LARGE) != 0
        assert np.all(found[error > TOLERANCE]), (dt, error[(error > TOLERANCE) & ~found])
        np.testing.assert_array_equal(status & int(Status.INACCURATE) != 0, ~(estimate <= TOLERANCE))
        sound = status & int(Status.STEP_TOO_LARGE | Status.GUARD_ACTIVE) == 0
        fine_run = (error < TOLERANCE / 50) & sound
        big = (error > 1e-3) & (error < 0.1) & sound
        assert np.all(estimate[big] > 0.3 * error[big])
        flagged, good, alarms = flagged + np.sum(error > TOLERANCE), good + np.sum(fine_run), alarms + np.sum(fine_run & found)
    assert flagged > 0
    assert good > 0 or method == "euler"
    assert alarms <= {"rk4": 0.1, "heun": 0.4, "euler": 1.0}[method] * good


def test_a_good_run_says_how_good(short_run):
    assert set(short_run.metrics.units) >= {"numerical_error", RELATIVE}
    assert short_run.metrics.numerical_error.shape == (2,)
    assert 1e-8 < float(short_run.metrics[RELATIVE]) < TOLERANCE / 10
    assert "of the tube" in repr(short_run)


@pytest.mark.parametrize("frequency", [6283.0, 4e3 * np.pi])
def test_a_signal_that_the_stages_cannot_see_is_flagged_with_a_step_that_will_do(shaken, frequency):
    """4000 pi rad/s goes through whole periods between the stages of a step of 1 ms: every stage sees one and the same torque."""
    scenario = ij.with_parameters(shaken, {"disturbance.frequency": frequency})
    with pytest.warns(ij.SimulationWarning, match=r"error is estimated at .* rad, .* % of the tube.* Take dt=0\.000[25]"):
        run = ij.simulate(scenario, **SHORT)
    assert int(run.status) == Status.INACCURATE
    dt = ij.recommended_dt(scenario, duration=SHORT["duration"])
    assert dt < SHORT["dt"]
    fine = ij.simulate(scenario, duration=SHORT["duration"], dt=5e-5, record_every=20)
    assert fine.ok
    error = np.max(np.abs(fine.q - run.q), axis=0)
    assert np.all(run.metrics.numerical_error > 0.5 * error)


def test_a_reference_between_the_stages_is_flagged(paper):
    fast = ij.with_parameters(paper, {"reference.frequency": 4e3 * np.pi, "reference.amplitude": 1e-3})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert int(ij.simulate(fast, **SHORT).status) & Status.INACCURATE


def test_the_guard_beyond_the_first_instant_is_told(paper):
    wide = dataclasses.replace(paper.controller, barrier=ij.barriers.Integral(guard=0.1))
    near = ij.with_parameters(dataclasses.replace(paper, controller=wide), {"initial.q": [1.03, 0.8]})
    with pytest.warns(ij.SimulationWarning, match=r"guard stayed active.*another law.*smaller guard"):
        run = ij.simulate(near, **SHORT)
    assert int(run.status) & Status.GUARD_STAYED


@pytest.mark.slow
def test_the_recommended_step_is_one_that_the_run_itself_is_content_with(paper):
    """A start just outside the guard: the barrier is a thousand times stiffer there than along the reference."""
    near = ij.with_parameters(paper, {"initial.q": [1.04 - 2e-5, 0.9 - 1e-4]})
    dt = ij.recommended_dt(near, duration=0.1)
    assert dt < 5e-4
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run = ij.simulate(near, duration=0.1, dt=dt)
    assert not int(run.status) & (Status.INACCURATE | Status.STEP_TOO_LARGE)


@pytest.mark.slow
def test_the_two_runs_side_by_side(shaken):
    """The difference that decides is that between the run and one at a sixteenth of the step, but for what the third leaves."""
    scenario = canonical(shaken)
    pair = step_size.side_by_side(scenario, 1e-3, 500, method="rk4")
    fine = ij.simulate(scenario, duration=0.5, dt=5e-5, record_every=20)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run = ij.simulate(scenario, **SHORT)
    error = np.max(np.abs(run.q - fine.q) / (run.upper - run.lower))
    assert float(pair.difference) == pytest.approx(error, rel=0.5)
    assert float(pair.estimate.relative) == pytest.approx(float(run.metrics[RELATIVE]), rel=0.05)
    np.testing.assert_allclose(pair.coarse[:2], run.q[-1], atol=1e-9)


def test_no_step_will_do(shaken, monkeypatch):
    """A torque that no affordable step resolves: the advice of the loop's modes, and a warning."""
    monkeypatch.setattr(step_size, "MOST_TRIED", 20_000)
    wild = ij.with_parameters(shaken, {"disturbance.frequency": 1e10, "disturbance.amplitude": 1e3})
    with pytest.warns(UserWarning, match="No step down to"):
        assert ij.recommended_dt(wild, duration=0.01) == 1e-3


@pytest.mark.slow
def test_a_study_names_the_step_that_its_runs_need(paper):
    perturbations = {"controller.K2": ij.factor(ij.uniform(0.5, 6.0))}
    with pytest.warns(UserWarning, match=r"dt = 0\.001 s is too large for \d+ of 256 runs.* Take dt=0\.000[12]; ij\.recommended_dt"):
        ij.monte_carlo(paper, perturbations, runs=256, duration=0.1)
    dt = ij.recommended_dt(paper, duration=0.1, perturbations=perturbations)
    assert dt in (1e-4, 2e-4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        study = ij.monte_carlo(paper, perturbations, runs=256, duration=0.1, dt=dt)
    assert study.metrics[RELATIVE].shape == (256,)
    assert study.status_counts["STEP_TOO_LARGE"] == 0


def test_folds_may_not_take_its_names(paper):
    @ij.component
    class Mine:
        units = {RELATIVE: "1"}  # noqa: RUF012
        init = update = finish = None

    with pytest.raises(ValueError, match="every run returns"):
        ij.simulate(paper, **SHORT, metrics=(Mine(),))


def test_round_steps():
    assert [step_size.round_down(x) for x in (1e-3, 9.99e-4, 2.1e-3, 0.05, 1.7)] == [1e-3, 5e-4, 2e-3, 0.05, 1.0]
    assert step_size.smaller(1e-3, 1.1, 4) == 5e-4
    assert step_size.smaller(1e-3, np.inf, 4) == 1e-4


@pytest.mark.parametrize("size", [1, 4, 14])
def test_solve(rng, size):
    matrix, rhs = rng.normal(size=(size, size)), rng.normal(size=(size, 3))
    matrix[0, 0] = 0.0 if size > 1 else 2.0  # so that it has to pivot
    np.testing.assert_allclose(linalg.solve(jnp.asarray(matrix), jnp.asarray(rhs)), np.linalg.solve(matrix, rhs), rtol=1e-9)


@pytest.mark.parametrize("method", ["rk4", "heun"])
@pytest.mark.parametrize("actuator", [ij.actuators.Ideal(), ij.actuators.Motor(bandwidth=600.0)], ids=["ideal", "lag"])
def test_a_sampled_run_says_how_accurate_it_is(method, actuator):
    """The torque jumps from step to step: the stages of each step tell its error, which is never told too small."""
    scenario = ij.with_parameters(ij.presets.zhang_yan_2024(reading="corrected"), {"controller.K2": 4.0, "observer.kf": 5.0})
    scenario = ij.with_parts(scenario, sampling=ij.Sampling(period=4e-3, delay=1.3e-3), actuator=actuator)
    for dt in (2e-3, 1e-3):
        run, fine = (ij.simulate(scenario, duration=0.5, dt=step, method=method, record_every=round(4e-3 / step)) for step in (dt, dt / 8))
        error = np.max(np.abs(run.q - fine.q) / (run.upper - run.lower))
        told = float(run.metrics.relative_numerical_error)
        assert told > error
        assert told < 200 * error or told < 1e-6


@ij.component
class PowerOfE2:
    """tau = ... - K2 e2 - c |e2|^0.6 sign(e2): its derivative is infinite at e2 = 0."""

    K2: jax.Array = ij.leaf("N m s/rad", sign="positive")
    c: jax.Array = ij.leaf("N m", sign="positive")

    def init(self, q, dq, setting):
        return ()

    def command(self, t, q, dq, f_hat, setting, state):
        tube, model = setting.tube(t), setting.model
        alpha = tube.dq_d - 2.0 * (q - tube.q_d)
        e2, wanted = dq - alpha, tube.ddq_d - 2.0 * (dq - tube.dq_d)
        tau = model.coriolis(q, dq, dq) + model.gravity(q) + model.mass_matrix(q) @ wanted
        tau = tau - self.K2 * e2 - self.c * jnp.sign(e2) * jnp.abs(e2) ** 0.6
        none = jnp.zeros(q.shape, bool)
        return ij.controllers.Command(tau, alpha, (q - tube.q_d) ** 2, none, none), ()


def test_an_infinite_slope_at_one_instant_is_no_fast_mode(paper):
    scenario = ij.with_parts(paper, controller=PowerOfE2(K2=5.0, c=2.0), observer=ij.observers.NoObserver())
    tube = scenario.setting.tube(jnp.zeros(()))
    scenario = ij.with_parts(scenario, initial=ij.Initial(tube.q_d, tube.dq_d))  # e2 = 0
    with pytest.warns(ij.SimulationWarning, match=r"respect to e2.*delta\^2"):
        run = ij.simulate(scenario, duration=0.5, dt=1e-3, record_every=100)
    assert int(run.status) == int(ij.Status.INFINITE_SLOPE)
    assert float(run.fastest_mode) < 2000.0
    assert ij.recommended_dt(scenario, duration=0.5) >= 5e-4
    with pytest.warns(ij.SimulationWarning, match="time step is too large"):
        run = ij.simulate(scenario, duration=0.5, dt=1e-2, record_every=50)
    assert int(run.status) & ij.Status.STEP_TOO_LARGE
