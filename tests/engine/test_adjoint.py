"""Reverse mode by kernels: its gradients are those of the scan and of tangents, whatever the
segments, the other runs and the threads, and its memory does not grow with the steps."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_cases import light_loop

import iblf_jax as ij
from iblf_jax.core.status import Status
from iblf_jax.engine import RunRequest, compile, execute, native, registry, thresholds
from iblf_jax.engine.adjoint import Adjoint, Cotangents, Form, ReverseRun
from iblf_jax.engine.batch import Batch, carry_shapes
from iblf_jax.engine.structural_constants import constants_of
from iblf_jax.kernels import PER_RUN, TIME, Shapes, UnsupportedError, compile_step, cpu, pack
from iblf_jax.simulation.metrics import as_folds
from iblf_jax.simulation.scenario import canonical
from iblf_jax.tuning.quantities import Peak, Quantities, TimeIntegral

pytestmark = pytest.mark.skipif(native.unavailable() is not None, reason="no C++ compiler")
GAINS = np.array([[20.0, 20.0], [12.0, 25.0], [30.0, 8.0], [18.0, 18.0], [22.0, 9.0]])
QUANTITIES = (TimeIntegral(), TimeIntegral("torque"), Peak(10.0))
"""Integrals, and a smooth maximum."""
METRICS = ("tuning_smooth", "tuning_exact")
"""The second one has the maximum itself."""
STEPS = 100


class Problem:
    """Runs of a scenario that differ in a gain, a mass and, for all of them equally, the start."""

    def __init__(self, scenario=None, *, gains=GAINS, dtype="float64", method="euler", steps=STEPS):
        scenario = canonical(scenario or ij.presets.zhang_yan_2024())
        self.constants = constants_of(scenario)
        cast = partial(jax.tree.map, lambda x: jnp.asarray(x, dtype))
        self.scenario, self.dt = cast(scenario), jnp.asarray(1e-3, dtype)
        self.folds = cast(as_folds((Quantities(QUANTITIES),), self.dt.dtype))
        scale = jnp.linspace(0.9, 1.1, len(gains), dtype=dtype)[:, None]
        self.varied = {
            "controller.K2": jnp.asarray(gains, dtype),
            "plant.mass": scale * self.scenario.plant.mass,
        }
        self.request = RunRequest(steps, method, constants=self.constants)
        self.compiled = {}

    def function(self, backend):
        """From the leaves to the outcome, and the gradient of the sum of all metrics."""
        request = self.request._replace(backend=backend)

        def gradient(varied):
            outcome, pullback = execute.run_batch_vjp(
                self.scenario, varied, list(varied), METRICS, self.folds, self.dt, request
            )
            ones = {name: jnp.ones_like(outcome.metrics[name]) for name in METRICS}
            return outcome, pullback(ones)

        return gradient

    def gradient(self, backend="native", varied=None):
        if backend not in self.compiled:
            self.compiled[backend] = jax.jit(self.function(backend))
        return jax.tree.map(np.asarray, self.compiled[backend](varied or self.varied))

    def traced(self, backend):
        return jax.make_jaxpr(self.function(backend))(self.varied).jaxpr


def assert_close(found, expected, rtol):
    """Relative to the largest entry of each leaf."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert np.all(np.isfinite(b)) and np.max(np.abs(b)) > 0
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * np.max(np.abs(b)))


@pytest.fixture(scope="module")
def problem():
    return Problem()


@pytest.fixture(scope="module")
def whole(problem):
    """Outcome and gradient in one segment."""
    return problem.gradient()


@pytest.mark.slow
def test_the_gradient_is_that_of_the_scan_and_of_tangents(problem, whole):
    outcome, gradient = whole
    by_scan, expected = problem.gradient("vmap")
    assert_close(gradient, expected, 1e-10)
    exact, others = (x.metrics["tuning_exact"] for x in (outcome, by_scan))
    np.testing.assert_allclose(exact, others, rtol=1e-10)
    np.testing.assert_array_equal(outcome.status, by_scan.status)
    along = {"controller.K2": np.eye(4, 2), "plant.mass": np.eye(4, 2, -2)}
    rest = (along, problem.folds, problem.dt, problem.request._replace(backend="native"))
    run = partial(execute.run_batch_jvp, problem.scenario)
    tangents = jax.jit(lambda x: run(x, *rest).tangents)(problem.varied)
    summed = sum(np.sum(tangents[name], axis=-1) for name in METRICS)
    found = np.concatenate([gradient["controller.K2"], gradient["plant.mass"]], axis=1)
    assert_close(found, summed, 1e-10)


@pytest.mark.slow
def test_segments_other_runs_and_threads_change_no_bit(problem, whole, monkeypatch):
    monkeypatch.setattr(thresholds, "SEGMENT_BYTES", 1)
    for threads, runs in ((1, slice(0, 5)), (2, slice(1, 3))):
        monkeypatch.setattr(native, "threads", lambda threads=threads: threads)
        varied, expected = jax.tree.map(lambda x, runs=runs: x[runs], (problem.varied, whole[1]))
        _, found = jax.jit(problem.function("native"))(varied)
        jax.tree.map(np.testing.assert_array_equal, found, expected)


@pytest.mark.slow
def test_a_run_that_stops_has_the_gradient_of_the_scan(problem, whole):
    """Also where a step that is not made has no finite derivative; the other runs do not change."""
    gains = GAINS.copy()
    gains[[1, 3]] = [[1e4], [np.inf]]
    varied = problem.varied | {"controller.K2": jnp.asarray(gains)}
    outcome, found = problem.gradient(varied=varied)
    by_scan, expected = problem.gradient("vmap", varied)
    np.testing.assert_array_equal(outcome.status, by_scan.status)
    assert np.all(outcome.status[[1, 3]] & int(Status.NOT_FINITE))
    for path, x in found.items():
        assert np.all(np.isfinite(x))
        np.testing.assert_allclose(x[1], expected[path][1], rtol=1e-8)
        np.testing.assert_array_equal(x[[0, 2, 4]], whole[1][path][[0, 2, 4]])


@pytest.mark.slow
def test_in_float32_and_of_a_sampled_loop(whole):
    _, found = Problem(dtype="float32").gradient()
    assert found["plant.mass"].dtype == np.float32
    assert_close(found, whole[1], 2e-3)
    weak = ij.with_parameters(ij.presets.zhang_yan_2024(), {"observer.kf": 4.0})
    sampled = ij.with_parts(weak, sampling=ij.Sampling(period=5e-3, delay=2e-3))
    problem = Problem(sampled, gains=0.2 * GAINS, method="heun")
    assert_close(problem.gradient()[1], problem.gradient("vmap")[1], 1e-10)


def programs(problem: Problem):
    inputs = compile.inputs_of(problem.scenario, problem.folds, problem.dt, problem.request)
    batch = Batch.of(inputs, problem.varied, constants=problem.constants)
    places = tuple(np.flatnonzero(batch.leaves.is_per_run).tolist())
    run = ReverseRun(registry.NATIVE, batch, places, problem.request)
    carry = carry_shapes(batch, problem.request.method)
    floats = [x for x in jax.tree.leaves((carry.state, carry.accumulators)) if x.dtype == float]
    adjoint = Adjoint(floats, batch.leaves.per_run)
    form = Form.of(carry)
    return run.recording_program(form), run.adjoint_program(form, adjoint, {})


@pytest.mark.slow
def test_the_adjoint_has_at_most_three_operations_for_each_of_the_step():
    """So a gradient takes less than six values: the run, the run once more, and its adjoint."""
    both = programs(Problem(method="rk4"))
    step, adjoint = (sum(program.counts()[PER_RUN | TIME].values()) for program in both)
    assert 1.5 * step < adjoint < 3 * step


def largest_array(jaxpr) -> int:
    """Entries of the largest array that a jaxpr computes, at any depth."""
    inner = jax.extend.core.jaxprs_in_params
    sizes = [v.aval.size for eqn in jaxpr.eqns for v in eqn.outvars if hasattr(v.aval, "size")]
    inside = [largest_array(x) for eqn in jaxpr.eqns for x in inner(eqn.params)]
    return max([*sizes, *inside], default=0)


@pytest.mark.slow
def test_the_memory_grows_as_the_square_root_of_the_steps(monkeypatch):
    monkeypatch.setattr(thresholds, "SEGMENT_BYTES", 1)
    small, large = (largest_array(Problem(steps=T).traced("native")) for T in (10_000, 40_000))
    assert small > 100 * len(GAINS)
    assert large < 2.05 * small


@pytest.mark.slow
def test_a_step_whose_adjoint_does_not_lower_is_differentiated_by_the_scan(problem, monkeypatch):
    def refused(*args):
        raise UnsupportedError("made up")

    monkeypatch.setattr(ReverseRun, "adjoint_program", refused)
    compile.CACHE.clear(compile.WARNINGS)
    with pytest.warns(compile.BackendWarning, match="made up"):
        problem.traced("native")


SHORT = {"duration": 0.05, "dt": 1e-3, "method": "euler", "record_every": 7}


def simulated(scenario, backend="auto"):
    def loss(values):
        changed = ij.with_parameters(scenario, values)
        run = ij.simulate(changed, **SHORT, metrics=[ij.metrics.Tracking()], backend=backend)
        return jnp.mean(run.e1**2) + jnp.sum(run.tau[-1]) * 1e-3 + jnp.sum(run.metrics.rmse)

    return loss


@pytest.fixture
def in_reverse(monkeypatch):
    """Single runs are differentiated in reverse mode by any number of leaves; counts the calls."""
    calls = []

    def backward(run, stored, cotangents: Cotangents, original=ReverseRun.backward):
        calls.append(run.runs)
        return original(run, stored, cotangents)

    monkeypatch.setattr(thresholds, "MAX_COLUMNS", 1)
    monkeypatch.setattr(ReverseRun, "backward", backward)
    return calls


LIGHT = light_loop()


@pytest.mark.slow
def test_runs_that_jax_batches_are_one_call(in_reverse):
    """Their gradient, and those of each of them."""
    loss, by_scan = simulated(LIGHT), simulated(LIGHT, "vmap")
    Kp = jnp.asarray([60.0, 50.0])
    masses = jnp.asarray([[1.5, 1.2], [1.4, 1.3], [1.6, 1.1]])

    def mean(Kp, loss):
        return jnp.mean(jax.vmap(lambda m: loss({"controller.Kp": Kp, "plant.mass": m}))(masses))

    batched = jax.jit(jax.grad(partial(mean, loss=loss)))(Kp)
    assert in_reverse == [3]
    wanted = jax.jit(jax.grad(partial(mean, loss=by_scan)))(Kp)
    np.testing.assert_allclose(batched, wanted, rtol=1e-10)
    of_mass = jax.grad(lambda m: loss({"controller.Kp": Kp, "plant.mass": m}))
    each = jax.jit(jax.vmap(of_mass))(masses)
    np.testing.assert_allclose(each, list(map(jax.jit(of_mass), masses)), rtol=1e-10)


@pytest.mark.slow
def test_derivatives_of_the_gradient_are_those_of_the_scan(in_reverse):
    def of_gain(loss):
        return lambda Kp: loss({"controller.Kp": Kp})

    Kp, gradient = jnp.asarray([60.0, 50.0]), jax.grad(of_gain(simulated(LIGHT)))
    expected = jax.jit(jax.hessian(of_gain(simulated(LIGHT, "vmap"))))(Kp)
    gradient(Kp)
    assert in_reverse == [1]
    np.testing.assert_allclose(jax.jit(jax.jacfwd(gradient))(Kp), expected, rtol=1e-9)
    np.testing.assert_allclose(jax.jit(jax.jacrev(gradient))(Kp), expected, rtol=1e-9)


@pytest.mark.parametrize("segment", [None, 2])
def test_a_step_reads_a_series_from_its_last_row(segment):
    """For a number of runs that fills no vector, in several tiles of steps."""

    def step(shared, per_run, series, carry, index):
        (x,), (weight,), (total,) = series, per_run, carry
        return [0.5 * total + weight * x[0] + x[1] * index.astype(number)], ()

    number = np.dtype("float64")
    one, two = Shapes((((), number),)), Shapes((((2,), number),))
    program = compile_step(step, number, Shapes(()), one, one, series=two).program
    rng = np.random.default_rng(0)
    runs, steps = 11, 300
    series, weight = rng.normal(size=(steps, 2, runs)), rng.normal(size=runs)
    start = pack([jnp.zeros(runs)], one, number, runs)
    options = {"series": jnp.asarray(series), "build": cpu.Build(segment), "threads": 2}
    per_run = jnp.asarray(weight[None])
    end, _ = cpu.run(program, jnp.zeros(0), per_run, start, steps, **options)
    expected = np.zeros(runs)
    for k, row in enumerate(series[::-1]):
        expected = 0.5 * expected + weight * row[0] + row[1] * k
    np.testing.assert_allclose(end.floats[0], expected, rtol=1e-13)
