"""A run says how accurate it is: its estimate against runs at a sixteenth of the step, its flags,
and the step that is recommended."""

import dataclasses
import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SHORT
from independent import Loop

import iblf_jax as ij
from iblf_jax.core import linalg
from iblf_jax.core.status import Status
from iblf_jax.engine import RunRequest, run_batch, step_size
from iblf_jax.simulation.error_estimate import RELATIVE, TOLERANCE
from iblf_jax.simulation.integrators import TABLEAUS
from iblf_jax.simulation.metrics import as_folds
from iblf_jax.simulation.scenario import canonical
from iblf_jax.studies import time_step

RUNS = 48
FINER = 16


@pytest.fixture(scope="module")
def shaken(paper):
    """The paper's scenario under a torque of 5 N m at 6283 rad/s, which goes through a whole period
    in a step of 1 ms."""
    torque = ij.disturbances.Sinusoids(amplitude=5.0, frequency=6283.0, phase=[1.0, 0.3])
    return dataclasses.replace(paper, disturbance=torque)


@pytest.fixture(scope="module")
def random_leaves(n=2):
    """Leaves of RUNS random scenarios: signals up to 3,000 rad/s, gains of all sizes, starts
    anywhere in the tube."""
    rng = np.random.default_rng(0)

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


def batches_of(scenario, steps, method):
    """Leaves and dt -> positions of a batch, widths of the tube, estimates and flags, at the
    instants of a step dt * FINER if the steps are many."""
    request = RunRequest(steps, method, FINER if steps > 500 else 1)
    folds = as_folds((), jnp.float64)

    @jax.jit
    def run(varied, dt):
        found = run_batch(scenario, varied, folds, dt, request)
        x, low, high = (found.records.signals[k] for k in ("x", "level_lower", "level_upper"))
        width = (high - low)[..., 0, :]
        return x[..., 0, :], width, found.metrics[RELATIVE], found.status

    return lambda varied, dt: map(np.asarray, run(jax.tree.map(jnp.asarray, varied), dt))


@pytest.fixture(scope="module")
def accurate(shaken, random_leaves):
    """Time step -> positions of the random runs, by a sixteenth of it."""
    finer = batches_of(canonical(shaken), 400 * FINER, "rk4")
    return {dt: next(finer(random_leaves, dt / FINER)) for dt in (1e-3, 2e-3, 5e-3)}


@pytest.mark.slow
@pytest.mark.parametrize("method", TABLEAUS)
def test_the_estimate_is_about_the_error(shaken, random_leaves, accurate, method):
    """At 1, 2 and 5 ms, too large for some: no run is off by more than the tolerance without its
    flag, and good ones are not flagged."""
    flagged = good = alarms = 0
    coarse = batches_of(canonical(shaken), 400, method)
    for dt, fine in accurate.items():
        q, width, estimate, status = coarse(random_leaves, dt)
        error = np.max(np.abs(q - fine) / width, axis=(1, 2))
        found = status & int(Status.INACCURATE | Status.STEP_TOO_LARGE) != 0
        assert np.all(found[error > TOLERANCE]), (dt, error[(error > TOLERANCE) & ~found])
        inaccurate = status & int(Status.INACCURATE) != 0
        np.testing.assert_array_equal(inaccurate, ~(estimate <= TOLERANCE))
        sound = status & int(Status.STEP_TOO_LARGE | Status.GUARD_ACTIVE) == 0
        big = (error > 1e-3) & (error < 0.1) & sound
        assert np.all(estimate[big] > 0.3 * error[big])
        fine_run = (error < TOLERANCE / 50) & sound
        flagged += np.sum(error > TOLERANCE)
        good += np.sum(fine_run)
        alarms += np.sum(fine_run & found)
    assert flagged > 0
    assert good > 0 or method == "euler"
    assert alarms <= {"rk4": 0.1, "heun": 0.4, "euler": 1.0}[method] * good


def test_a_good_run_says_how_good(short_run):
    assert set(short_run.metrics.units) >= {"numerical_error", RELATIVE}
    assert short_run.metrics.numerical_error.shape == (2,)
    assert 1e-8 < float(short_run.metrics[RELATIVE]) < TOLERANCE / 10
    assert "of the tube" in repr(short_run)


@pytest.mark.slow
def test_a_signal_that_the_stages_cannot_see_is_flagged_with_a_step_that_will_do(shaken):
    """4000 pi rad/s goes through whole periods between the stages of a step of 1 ms: every stage
    sees one and the same torque."""
    scenario = ij.with_parameters(shaken, {"disturbance.frequency": 4e3 * np.pi})
    words = r"error is estimated at .* rad, .* % of the tube.* Take dt=0\.000[25]"
    with pytest.warns(ij.SimulationWarning, match=words):
        run = ij.simulate(scenario, **SHORT)
    assert int(run.status) == Status.INACCURATE
    dt = ij.recommended_dt(scenario, duration=SHORT["duration"])
    assert dt < SHORT["dt"]
    fine = ij.simulate(scenario, duration=SHORT["duration"], dt=5e-5, record_every=20)
    assert fine.ok
    error = np.max(np.abs(fine.q - run.q), axis=0)
    assert np.all(run.metrics.numerical_error > 0.5 * error)


@pytest.mark.slow
def test_the_guard_beyond_the_first_instant_is_told(paper):
    law = dataclasses.replace(paper.controller, barrier=ij.barriers.Integral(guard=0.1))
    near = ij.with_parts(paper, controller=law, initial=ij.Initial(q=[1.03, 0.8]))
    words = r"guard stayed active.*another law.*smaller guard"
    with pytest.warns(ij.SimulationWarning, match=words):
        assert int(ij.simulate(near, **SHORT).status) & Status.GUARD_STAYED


@pytest.mark.slow
def test_the_recommended_step_is_one_that_the_run_itself_is_content_with(paper):
    """A start just outside the guard: the barrier is a thousand times stiffer there than along the
    reference."""
    near = ij.with_parameters(paper, {"initial.q": [1.04 - 2e-5, 0.9 - 1e-4]})
    dt = ij.recommended_dt(near, duration=0.1)
    assert dt < 5e-4
    with warnings.catch_warnings(action="ignore"):
        run = ij.simulate(near, duration=0.1, dt=dt)
    assert not int(run.status) & (Status.INACCURATE | Status.STEP_TOO_LARGE)


@pytest.mark.slow
def test_no_step_will_do(shaken, monkeypatch):
    """A torque that no affordable step resolves: the advice of the loop's modes, and a warning."""
    monkeypatch.setattr(step_size, "MAX_TRIED", 20_000)
    wild = ij.with_parameters(shaken, {"disturbance.frequency": 1e10, "disturbance.amplitude": 1e3})
    with pytest.warns(UserWarning, match="No step down to"):
        assert ij.recommended_dt(wild, duration=0.01) == 1e-3


@pytest.mark.slow
def test_a_study_names_the_step_that_its_runs_need(paper):
    perturbations = {"controller.K2": ij.factor(ij.uniform(0.5, 6.0))}
    words = r"dt = 0\.001 s is too large for \d+ of 256 runs.* Take dt=0\.000[12]; ij\.recommend"
    with pytest.warns(UserWarning, match=words):
        ij.monte_carlo(paper, perturbations, runs=256, duration=0.1)
    dt = ij.recommended_dt(paper, duration=0.1, perturbations=perturbations)
    assert dt in (1e-4, 2e-4)
    with warnings.catch_warnings(action="error"):
        study = ij.monte_carlo(paper, perturbations, runs=256, duration=0.1, dt=dt)
    assert study.metrics[RELATIVE].shape == (256,)
    assert study.status_counts["STEP_TOO_LARGE"] == 0


KEPT = int(Status.STEP_TOO_LARGE)
FAILED = int(Status.STEP_TOO_LARGE | Status.BOUND_VIOLATED)


@pytest.mark.parametrize(
    ("runs", "words"),
    [
        (((KEPT, 5e4), (FAILED, 1e12)), r"Take dt=2e-05;.* 1 of them left their bounds"),
        (((FAILED, 1e12), (0, 1.0)), r"Take dt=0.0001;.* 1 of them left their bounds"),
        (((KEPT, 5e3),), r"1 of 1 runs(?!.*left their bounds)"),
    ],
)
def test_failed_runs_reduce_the_step_at_most_ten_times(runs, words):
    status, modes = map(np.array, zip(*runs, strict=True))
    with pytest.warns(UserWarning, match=words):
        time_step.warn_of_step(status, modes, np.zeros(len(runs)), 1e-3, "rk4")


def test_folds_may_not_take_its_names(paper):
    members = {"units": {RELATIVE: "1"}} | dict.fromkeys(("init", "update", "finish"))
    mine = ij.component(type("Mine", (), members))()
    with pytest.raises(ValueError, match="every run returns"):
        ij.simulate(paper, **SHORT, metrics=(mine,))


def test_round_steps():
    rounded = [step_size.round_down(x) for x in (1e-3, 9.99e-4, 2.1e-3, 0.05, 1.7)]
    assert rounded == [1e-3, 5e-4, 2e-3, 0.05, 1.0]
    assert step_size.smaller(1e-3, 1.1, 4) == 5e-4
    assert step_size.smaller(1e-3, np.inf, 4) == 1e-4


@pytest.mark.parametrize("size", [1, 4, 14])
def test_solve(rng, size):
    matrix, rhs = rng.normal(size=(size, size)), rng.normal(size=(size, 3))
    matrix[0, 0] = 0.0 if size > 1 else 2.0  # so that it has to pivot
    found = linalg.solve(jnp.asarray(matrix), jnp.asarray(rhs))
    np.testing.assert_allclose(found, np.linalg.solve(matrix, rhs), rtol=1e-9)


@ij.component
class PowerOfE2:
    """tau = ... - K2 e2 - c |e2|^a sign(e2): its derivative is infinite at e2 = 0."""

    c: jax.Array = ij.leaf("N m", sign="positive")
    a: jax.Array = ij.leaf("1", sign="positive", default=0.6)

    def command(self, t, q, dq, f_hat, context, state):
        tube, model = context.tube(t), context.model
        alpha = tube.dq_d - 2.0 * (q - tube.q_d)
        e2, wanted = dq - alpha, tube.ddq_d - 2.0 * (dq - tube.dq_d)
        tau = model.coriolis(q, dq, dq) + model.gravity(q) + model.mass_matrix(q) @ wanted
        tau = tau - 5.0 * e2 - self.c * jnp.sign(e2) * jnp.abs(e2) ** self.a
        none = jnp.zeros(q.shape, bool)
        return ij.controllers.Command(tau, alpha, (q - tube.q_d) ** 2, none, none), ()


@pytest.mark.slow
def test_an_infinite_slope_at_one_instant_is_no_fast_mode(paper):
    """Nor is a slope beside an infinite one: at the instant that is looked at in the second run e2
    is 1e-4, and differences of 6e-6 and 6e-5 both give the local slope."""
    law, run = PowerOfE2(c=2.0), partial(ij.simulate, duration=0.5, record_every=50)
    scenario = ij.with_parts(paper, controller=law, observer=ij.observers.NoObserver())
    beside = ij.with_parameters(scenario, {"controller.c": 1.5, "controller.a": 0.5})
    assert run(beside, dt=1e-3).ok
    tube = scenario.context.tube(jnp.zeros(()))
    scenario = ij.with_parts(scenario, initial=ij.Initial(tube.q_d, tube.dq_d))  # e2 = 0
    good = run(scenario, dt=1e-3)
    assert good.ok and float(good.fastest_mode) < 2000.0
    assert ij.recommended_dt(scenario, duration=0.5) >= 5e-4
    words = r"time step is too large.*respect to e2.*delta\^2"
    with pytest.warns(ij.SimulationWarning, match=words):
        status = int(run(scenario, dt=1e-2).status)
    assert status & ij.Status.STEP_TOO_LARGE and status & ij.Status.INFINITE_SLOPE


# ---------------------------------------------------------------------- what jumps within a step

SLOW = ij.with_parameters(ij.presets.zhang_yan_2024(), {"controller.K2": 4.0, "observer.kf": 4.0})
LATE = 0.2137
MANY = (
    *((0.0, (3.0, 1.0)), (0.1, (-4.0, 2.0)), (LATE, (20.0, 5.0))),
    *((0.2151, (-9.0, -3.0)), (7.0, (50.0, 50.0))),
)
"""At the start, at the edge of a step, two within one step of 4 ms, and after the end."""


def with_steps(scenario, steps):
    parts = tuple(ij.disturbances.Step(size=list(size), time=time) for time, size in steps)
    return dataclasses.replace(scenario, disturbance=ij.disturbances.Sum(parts))


def split(steps, **fields):
    """The end of the loop `SLOW` under steps, by a program that shares nothing with the package."""
    four, still = np.full(2, 4.0), (0.0, 0.0, 1.0, 0.0)
    return Loop(K2=four, kf=four, force_a=still, force_b=still, steps=steps, **fields).end(0.4)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["heun", "rk4"])
def test_jumps_cost_no_order(method):
    """The error is that of a smooth loop, and the estimate is not below it."""
    scenario, truth = with_steps(SLOW, MANY), split(MANY)
    simulated = partial(ij.simulate, scenario, duration=0.4, method=method)
    run = {dt: simulated(dt=dt) for dt in (4e-3, 2e-3, 2.5e-4)}
    error = {dt: np.abs(x.q[-1] - truth[:2]) for dt, x in run.items()}
    assert np.all(np.log2(error[2e-3] / error[2.5e-4]) / 3 > TABLEAUS[method].order - 0.25)
    assert np.all(run[4e-3].metrics.numerical_error > 0.3 * error[4e-3])
    if method == "rk4":
        assert run[4e-3].ok and np.all(error[4e-3] < 1e-7)


@pytest.mark.slow
def test_more_jumps_than_a_step_is_divided_at_are_flagged():
    """But not those that come together, which are one cut, nor where the step is recommended."""
    steps = tuple((0.2 + 1e-3 * (k + 0.5), (1.0, -1.0)) for k in range(6))
    scenario = with_steps(SLOW, steps)
    with warnings.catch_warnings(action="ignore"):
        assert int(ij.simulate(scenario, duration=0.3, dt=1e-2).status) & Status.INACCURATE
    assert not int(ij.simulate(scenario, duration=0.3, dt=2e-3).status) & Status.INACCURATE
    together = tuple((LATE, (5.0 - k, 0.5)) for k in range(6))
    run = ij.simulate(with_steps(SLOW, together), duration=0.4, dt=4e-3)
    np.testing.assert_allclose(run.q[-1], split(together)[:2], atol=1e-6)
    assert run.ok
    near = with_steps(SLOW, tuple((0.02 + 1e-5 * k, (1.0, -1.0)) for k in range(9)))
    dt = ij.recommended_dt(near, duration=0.04)
    assert not int(ij.simulate(near, duration=0.04, dt=dt).status) & Status.INACCURATE


@pytest.mark.slow
@pytest.mark.parametrize("time", [LATE, 0.2], ids=["within a step", "at its end"])
def test_derivatives_by_a_jump_time_are_those_of_the_split_flow(time):
    """By time and size, against differences of the independent program."""
    scenario = with_steps(SLOW, ((time, (20.0, 5.0)),))

    def end(time, size):
        values = {"disturbance.parts[0].time": time, "disturbance.parts[0].size": size}
        changed = ij.with_parameters(scenario, values)
        return ij.simulate(changed, duration=0.4, dt=4e-3, record_every=100).q[-1]

    by_time, by_size = jax.jacfwd(end, (0, 1))(jnp.asarray(time), jnp.array([20.0, 5.0]))
    ends = [split(((time + h, (20.0, 5.0)),))[:2] for h in (1e-5, -1e-5)]
    np.testing.assert_allclose(by_time, (ends[0] - ends[1]) / 2e-5, rtol=1e-5)
    ends = [split(((time, (20.0 + h, 5.0)),))[:2] for h in (0.01, -0.01)]
    np.testing.assert_allclose(by_size[:, 0], (ends[0] - ends[1]) / 0.02, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_every_run_of_a_batch_has_its_own_jumps():
    """Also under a sampled law whose command arrives within a step; one run jumps at a sample, one
    after the end."""
    sampled = dataclasses.replace(SLOW, sampling=ij.Sampling(period=1e-2, delay=0.0037))
    scenario, path = canonical(with_steps(sampled, MANY[2:3])), "disturbance.parts[0].time"
    folds, times = as_folds(None, jnp.float64), np.array([LATE, 0.1, 0.0537, 0.9])
    request = RunRequest(30, backend="native")
    run = jax.jit(lambda v: run_batch(scenario, {path: v}, folds, jnp.asarray(1e-2), request))
    with warnings.catch_warnings(action="ignore"):  # no compiler
        together = run(jnp.asarray(times))
    for i, time in enumerate(times):
        one = ij.simulate(ij.with_parameters(scenario, {path: time}), duration=0.3, dt=1e-2)
        for name in ("rmse", "effort", "peak_torque", "torque_variation", "numerical_error"):
            found, alone = together.metrics[name][i], one.metrics[name]
            np.testing.assert_allclose(found, alone, rtol=1e-9, atol=1e-14, err_msg=name)


@ij.component
class Switched:
    """A reference that jumps, with its velocity, at a time."""

    before: jax.Array = ij.leaf("rad")
    after: jax.Array = ij.leaf("rad")
    time: jax.Array = ij.leaf("s", shape="scalar")

    def position(self, t):
        return jnp.where(t >= self.time, self.after + 0.02 * jnp.sin(2.0 * t), self.before)

    def jump_times(self):
        return self.time


MOTOR = ij.actuators.Motor(bandwidth=300.0)
PARTS = {
    "reference": Switched(before=[0.7, 0.7], after=[0.72, 0.69], time=0.0537),
    "actuator": ij.actuators.Chain((ij.actuators.Fault(0.8, time=0.0537), MOTOR)),
}


@pytest.mark.slow
@pytest.mark.parametrize("part", PARTS)
def test_every_part_may_jump(part):
    """What is switched at 0.0537 s costs no order: the errors at 4 and 1 ms are those of a smooth
    loop."""
    parts = {"disturbance": ij.disturbances.Nothing(), "model": SLOW.plant, part: PARTS[part]}
    quiet = dataclasses.replace(SLOW, **parts)
    ends = [ij.simulate(quiet, duration=0.12, dt=dt).q[-1] for dt in (1.25e-4, 4e-3, 1e-3)]
    coarse, fine = (np.max(np.abs(end - ends[0])) for end in ends[1:])
    assert fine < 1e-8
    assert np.log2(coarse / fine) / 2 > 3.5, (coarse, fine)


def with_times(cls, times):
    """A part whose jumps come at times that it does not say."""
    return ij.component(type("Other", (cls,), {"jump_times": lambda self: times}))


def test_jump_times_that_are_none_are_refused():
    never = with_times(ij.references.Sinusoid, "never")(0.5, 0.1)
    with pytest.raises(ValueError, match=r"reference.jump_times\(\).*expected times \[s\]"):
        ij.simulate(dataclasses.replace(SLOW, reference=never), duration=0.01, dt=1e-3)


@pytest.mark.slow
def test_a_disturbance_that_does_not_declare_its_jump_is_still_counted():
    """The estimate sees it in the rates, as it saw every jump before."""
    undeclared = with_times(ij.disturbances.Step, jnp.zeros(0))
    steps = [cls(size=[20.0, 5.0], time=LATE) for cls in (undeclared, ij.disturbances.Step)]
    scenarios = [dataclasses.replace(SLOW, disturbance=step) for step in steps]
    runs = [ij.simulate(x, duration=0.4, dt=1e-3) for x in scenarios]
    hidden, known = (np.max(run.metrics.numerical_error) for run in runs)
    assert hidden > 5 * known
