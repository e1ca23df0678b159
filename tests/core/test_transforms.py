"""`simulate` under jit, vmap, grad and jacfwd; new gains do not recompile; runs of a batch do not
touch each other."""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SHORT
from made_up_runs import ALWAYS

import iblf_jax as ij
from iblf_jax.core.status import Status
from iblf_jax.engine import RunRequest, native, registry, single_run, thresholds, transformable
from iblf_jax.kernels import UnsupportedError
from iblf_jax.simulation.scenario import canonical

PATHS = (
    *("controller.k1", "controller.K2", "controller.o", "observer.kf", "plant.mass"),
    *("initial.q", "initial.dq", "disturbance.phase"),
)
NOMINAL = np.array([2.0, 20.0, 0.1, 20.0, 1.5, 0.8, 0.0, 0.0])
RUN = {"duration": 0.1, "dt": 1e-3}
STARTS = (0.34001, 0.36, 0.9, 1.03, 1.0399, 1.03999999, 1.04, 1.0400001, 3.0, 50.0, 0.34, -300.0)
"""Initial positions of both joints; the bounds of joint 0 are (0.34, 1.04) at t = 0, those of joint
1 (0.2, 0.9)."""


def loss(values, scenario):
    run = ij.simulate(ij.with_parameters(scenario, dict(zip(PATHS, values, strict=True))), **RUN)
    m = run.metrics
    parts = (m.rmse, m.iae, m.margin, m.xi_margin, m.estimate_rmse, run.q[-1], 0.1 * run.V[-1])
    parts += (0.01 * m.torque_rms, 0.01 * m.torque_variation)
    return sum(jnp.sum(x) for x in parts), run.status


@pytest.fixture(scope="module")
def gradients(paper):
    """Value, status, reverse gradient and forward derivative along a direction, of a batch of
    parameter vectors; compiled once, for rows that are filled up to SIZE."""

    def one(values, direction):
        (value, status), reverse = jax.value_and_grad(loss, has_aux=True)(values, paper)
        forward = jax.jvp(lambda v: loss(v, paper)[0], (values,), (direction,))[1]
        return value, status, reverse, forward

    compiled = jax.jit(jax.vmap(one))

    def run(rows, directions=()):
        pairs = (rows, NOMINAL), (directions, np.maximum(np.abs(NOMINAL), 0.1))
        full = (np.stack([*some, *[rest] * (SIZE - len(some))]) for some, rest in pairs)
        return map(np.asarray, compiled(*full))

    return run


@pytest.fixture(scope="module")
def batch(paper):
    def one(K2, q):
        changed = ij.with_parameters(paper, {"controller.K2": K2, "initial.q": q})
        return ij.simulate(changed, **SHORT)

    return jax.jit(jax.vmap(one))


SIZE = 32


def vector(path, value):
    return np.where(np.asarray(PATHS) == path, value, NOMINAL)


@pytest.mark.slow
def test_gradient_in_both_modes_is_the_finite_difference(gradients):
    n = len(PATHS)
    steps = 1e-5 * np.maximum(np.abs(NOMINAL), 0.1)
    shifted = [NOMINAL + sign * np.diag(steps)[i] for i in range(n) for sign in (1, -1)]
    value, status, reverse, forward = gradients([NOMINAL] * n + shifted, list(np.eye(n)))
    assert int(status[0]) == Status.OK
    np.testing.assert_allclose(reverse[0], forward[:n], rtol=1e-7, atol=1e-9)
    difference = (value[n : 3 * n : 2] - value[n + 1 : 3 * n : 2]) / (2 * steps)
    np.testing.assert_allclose(forward[:n], difference, rtol=2e-4, atol=2e-6)
    assert np.all(np.abs(forward[:n]) > 1e-9)  # every parameter matters


@pytest.mark.slow
def test_values_and_gradients_are_finite_wherever_a_run_starts_and_when_it_runs_away(gradients):
    """Near the wall, on it, past it, and thrown at it: numbers and both gradients stay finite."""
    changes = [("initial.q", q) for q in STARTS]
    unstable = [("controller.K2", k) for k in (200.0, 1e3, 1e4, 1e6)]
    unstable += [("observer.kf", k) for k in (1e4, 1e5)]
    changes += [*unstable, *(("initial.dq", v) for v in (30.0, -300.0, 9e3))]
    changes += [("plant.mass", m) for m in (1e-6, 1e6)]
    rows = [vector(*change) for change in changes]
    value, status, reverse, forward = gradients(rows)
    for name, numbers in (("value", value), ("reverse", reverse), ("forward", forward)):
        bad = np.flatnonzero(~np.all(np.isfinite(numbers.reshape(SIZE, -1)), axis=1))
        assert bad.size == 0, (name, [changes[i] for i in bad])
    outside = [not (0.34 < q < 0.9) for q in STARTS]
    assert np.all(status[: len(STARTS)][outside] & Status.BOUND_VIOLATED)
    assert np.all(status[len(STARTS) :][: len(unstable)] & Status.NOT_FINITE)


@pytest.mark.slow
def test_a_failing_run_leaves_the_others_bit_identical(batch):
    calm = batch(jnp.asarray([20.0, 20.0, 12.0]), jnp.asarray([0.8, 0.8, 0.7]))
    for K2, q in ((1e6, 0.8), (20.0, 5.0), (20.0, np.nan), (np.inf, 0.8)):
        troubled = batch(jnp.asarray([20.0, K2, 12.0]), jnp.asarray([0.8, q, 0.7]))
        assert int(troubled.status[1]) & (Status.NOT_FINITE | Status.BOUND_VIOLATED)
        for i in (0, 2):
            assert int(troubled.status[i]) == 0
            assert jax.tree.all(jax.tree.map(np.array_equal, calm[i], troubled[i]))


@pytest.mark.slow
def test_jit_and_vmap_give_what_simulate_gives(paper, short_run, batch):
    runs = batch(jnp.asarray([20.0, 12.0, 30.0]), jnp.full(3, 0.8))
    assert runs.is_batch and len(runs) == 3 and runs.q.shape == (3, 501, 2)
    close = partial(np.testing.assert_allclose, rtol=1e-7, atol=1e-9)
    for name in ("q", "dq", "tau", "V", "e2", "disturbance_estimate"):
        close(getattr(runs[0], name), getattr(short_run, name), err_msg=name)
    for name in short_run.metrics:
        close(runs[0].metrics[name], short_run.metrics[name], atol=0.0, err_msg=name)
    close(runs[1].q, ij.simulate(ij.with_parameters(paper, {"controller.K2": 12.0}), **SHORT).q)


needs_compiler = pytest.mark.skipif(native.unavailable() is not None, reason="no C++ compiler")
LEAVES = (
    *("controller.K2", "observer.kf", "plant.mass", "plant.g", "initial.q"),
    *("disturbance.phase", "bounds[0].upper"),
)
"""Gains, the robot, the start, the world: one of every kind of leaf."""
FEW = (ij.metrics.Tracking(), ij.metrics.Torque())
LIGHT = {"duration": 0.03, "dt": 1e-3, "method": "euler", "metrics": FEW}
"""A run whose derivatives by the scan compile soon."""


def everything(scenario, **options):
    """Records and metrics of a run, the floats of them, as a function of the leaves LEAVES."""
    start = {
        path: x for path, _, _, x in ij.parameters(scenario, named=False) if path.startswith(LEAVES)
    }

    def floats(values):
        made = ij.simulate(ij.with_parameters(scenario, values), **LIGHT, **options)
        found = {name: x for name, x in vars(made).items() if name in ALWAYS} | {**made.metrics}
        return {name: x for name, x in found.items() if jnp.issubdtype(x.dtype, jnp.floating)}

    return floats, start


def no_scan(*arguments):
    """In the place of the scan, which nothing may take."""
    raise AssertionError("the scan")


@pytest.mark.slow
@needs_compiler
def test_derivatives_are_the_kernels_and_equal_those_of_plain_jax(paper, monkeypatch):
    """Of all that is recorded and measured, by leaves of every kind, in both modes, in a batch and
    inside jit."""
    plain, start = everything(paper, backend="vmap")
    expected, value = jax.jacfwd(plain)(start), plain(start)
    assert len(start) >= 10 and len(expected) > 20
    monkeypatch.setattr(transformable, "_run_by_scan", no_scan)
    run, _ = everything(paper)

    def all_close(found, wanted):
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            atol = 1e-9 * np.max(np.abs(b), initial=1.0)
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=atol)

    all_close(jax.jacfwd(run)(start), expected)
    found, pulled = jax.vjp(run, start)
    all_close(found, value)
    ones, along = (jax.tree.map(jnp.ones_like, x) for x in (value, start))
    pushed = jax.jvp(run, (start,), (along,))[1]
    trees = (pushed, pulled(ones)[0])
    together, transposed = (sum(map(jnp.sum, jax.tree.leaves(tree))) for tree in trees)
    np.testing.assert_allclose(together, transposed, rtol=1e-9)
    other = jax.tree.map(lambda x: x * (1 + 1e-3), start)
    two = jax.tree.map(lambda *x: jnp.stack(x), start, other)
    batched = jax.jit(jax.vmap(lambda values: jax.jvp(run, (values,), (along,))[1]))(two)
    for i, wanted in enumerate((pushed, jax.jvp(run, (other,), (along,))[1])):
        all_close(jax.tree.map(lambda x, i=i: x[i], batched), wanted)


@pytest.mark.slow
@needs_compiler
def test_second_derivatives_are_the_kernels(paper, monkeypatch):
    monkeypatch.setattr(transformable, "_run_by_scan", no_scan)

    def ise(values):
        leaves = {"controller.K2": values[:2], "plant.mass": values[2:]}
        return ij.simulate(ij.with_parameters(paper, leaves), **LIGHT).metrics.ise.sum()

    at, width = jnp.asarray([20.0, 15.0, 1.5, 1.2]), 1e-4
    hessian = jax.hessian(ise)(at)
    moved = [at + sign * width * unit for unit in np.eye(4) for sign in (1, -1)]
    slopes = np.asarray([jax.grad(ise)(x) for x in moved])
    differences = (slopes[::2] - slopes[1::2]) / (2 * width)
    np.testing.assert_allclose(hessian, differences, rtol=1e-5, atol=1e-10)
    np.testing.assert_allclose(jax.jacrev(jax.grad(ise))(at), hessian, rtol=1e-9, atol=1e-14)


@needs_compiler
@pytest.mark.slow
def test_where_kernels_cannot_the_scan_differentiates(paper, monkeypatch):
    """And says the same: by the step, by higher orders, without a compiler, and where a step does
    not lower."""

    def last(K2, dt):
        scenario = canonical(ij.with_parameters(paper, {"controller.K2": K2}))
        options = RunRequest(30, "euler", 1)
        run = transformable.run_transformable(scenario, (), dt, options)
        return jnp.sum(run.records.signals["x"][-1, 0])

    K2, dt, calls = jnp.asarray([20.0, 15.0]), jnp.asarray(1e-3), []
    expected, original = jax.grad(last)(K2, dt), transformable._run_by_scan

    def counted(*arguments):
        calls.append(1)
        return original(*arguments)

    def no_kernel(*arguments):
        raise UnsupportedError("made up")

    monkeypatch.setattr(transformable, "_run_by_scan", counted)
    np.testing.assert_array_equal(jax.grad(last)(K2, dt), expected)
    assert calls == []
    difference = (last(K2, dt * 1.001) - last(K2, dt * 0.999)) / (2e-3 * dt)
    np.testing.assert_allclose(jax.grad(last, 1)(K2, dt), difference, rtol=1e-5)
    for place, name, value in (
        (thresholds, "MAX_COLUMN_ORDER", 0),
        (registry, "default_backend", lambda: registry.Availability("vmap", "no compiler")),
        (transformable, "_columns", no_kernel),
    ):
        calls.clear()
        with monkeypatch.context() as patch:
            patch.setattr(place, name, value)
            np.testing.assert_allclose(jax.grad(last)(K2, dt), expected, rtol=1e-9)
        assert calls, name


PARTS = (single_run._initialize, single_run._all_steps, single_run._finalize)


def test_new_numbers_do_not_recompile(paper, short_run, monkeypatch):
    """Once a structure, a length and a method are compiled, every other value runs the same
    program."""
    ij.simulate(paper, **SHORT)
    monkeypatch.setattr("iblf_jax.engine.time_step.advance", no_scan)
    before = [part._cache_size() for part in PARTS]
    for changes in (
        {"controller.K2": 30.0},
        {"plant.mass[1]": 1},
        {"robot.g": 1.62},
        {"initial.q": np.asarray([0.7, 0.6])},
        {"disturbance.phase": 0.5},
    ):
        assert ij.simulate(ij.with_parameters(paper, changes), **SHORT).ok
    for throw in (False, True):
        ij.simulate(ij.presets.zhang_yan_2024(), **SHORT, throw=throw)
    assert [part._cache_size() for part in PARTS] == before


def test_a_new_structure_does_recompile(paper, monkeypatch):
    single_run._initialize.clear_cache()
    monkeypatch.setattr(single_run, "initialize", no_scan)
    with pytest.raises(AssertionError, match="the scan"):
        ij.simulate(paper, **SHORT, metrics=(ij.metrics.Torque(),))


@pytest.mark.slow
@needs_compiler
def test_another_length_compiles_the_steps_alone(paper):
    ij.simulate(paper, **SHORT, backend="native")
    before = [part._cache_size() for part in PARTS]
    longer = ij.simulate(paper, duration=0.537, dt=1e-3, record_every=3, backend="native")
    after = [part._cache_size() for part in PARTS]
    assert [new - old for new, old in zip(after, before, strict=True)] == [0, 1, 0]
    again = ij.simulate(paper, **SHORT, backend="native")
    np.testing.assert_array_equal(longer.q[:150], again.q[:450:3])


@pytest.mark.slow
def test_the_same_run_twice_is_bit_identical(paper, short_run):
    again = ij.simulate(paper, **SHORT)
    for name in ("q", "tau", "V"):
        np.testing.assert_array_equal(getattr(again, name), getattr(short_run, name))


def test_no_warning_on_a_good_run(paper):
    with warnings.catch_warnings(action="error"):
        ij.simulate(paper, **SHORT)


@pytest.mark.slow
def test_a_rollout_is_a_pytree_and_indexes_runs(short_run):
    doubled = jax.tree.map(lambda x: jnp.stack([x, x]), short_run)
    assert len(doubled) == 2
    np.testing.assert_array_equal(doubled[1].q, short_run.q)
    assert "2 runs" in repr(doubled) and "status: ok" in repr(short_run)
    for use, words in ((lambda run: run[0], "one run"), (len, "one run"), (bool, r"run\.ok")):
        with pytest.raises(TypeError, match=words):
            use(short_run)
