"""`simulate` under jit, vmap, grad and jacfwd; new gains do not recompile; runs of a batch do not
touch each other."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import PAPER, SHORT
from made_up_runs import ALWAYS

import iblf_jax as ij
from iblf_jax.core.caches import CACHE
from iblf_jax.core.status import Status
from iblf_jax.engine import (
    compile,
    native,
    registry,
    request,
    single_run,
    thresholds,
    time_step,
    transformable,
)
from iblf_jax.kernels import UnsupportedError, cpu
from iblf_jax.simulation.scenario import canonical

PATHS = (
    "controller.k1",
    "controller.K2",
    "controller.o",
    "observer.kf",
    "plant.mass",
    "initial.q",
    "initial.dq",
    "disturbance.phase",
)
NOMINAL = (2.0, 20.0, 0.1, 20.0, 1.5, 0.8, 0.0, 0.0)
RUN = {"duration": 0.1, "dt": 1e-3}

STARTS = (0.34001, 0.36, 0.9, 1.03, 1.0399, 1.03999999, 1.04, 1.0400001, 3.0, 50.0, 0.34, -300.0)
"""Initial positions of both joints; the bounds of joint 0 are (0.34, 1.04) at t = 0, those of joint
1 (0.2, 0.9)."""


def loss(values, scenario):
    """Something of everything that a tuning loss may use."""
    run = ij.simulate(ij.with_parameters(scenario, dict(zip(PATHS, values, strict=True))), **RUN)
    m = run.metrics
    parts = (
        m.rmse,
        m.iae,
        m.margin,
        m.xi_margin,
        0.01 * m.torque_rms,
        0.01 * m.torque_variation,
        m.estimate_rmse,
        run.q[-1],
        0.1 * run.V[-1],
    )
    return sum(jnp.sum(x) for x in parts), run.status


@pytest.fixture(scope="module")
def gradients(paper):
    """Value, status, reverse gradient and forward derivative along a direction, of a batch of
    parameter vectors; compiled once.

    The compiler's optimisations are off: what takes long here is compiling, and the numbers are the
    same.
    """

    def one(values, direction):
        (value, status), reverse = jax.value_and_grad(loss, has_aux=True)(values, paper)
        forward = jax.jvp(lambda v: loss(v, paper)[0], (values,), (direction,))[1]
        return value, status, reverse, forward

    compiled = jax.jit(jax.vmap(one), compiler_options={"xla_backend_optimization_level": 0})

    def run(rows, directions=()):
        return compiled(
            filled(rows, vector()), filled(directions, np.maximum(np.abs(NOMINAL), 0.1))
        )

    return run


@pytest.fixture(scope="module")
def batch(paper):
    """A batch of three short runs of given gains and starts, compiled once."""

    def one(K2, q):
        return ij.simulate(
            ij.with_parameters(paper, {"controller.K2": K2, "initial.q": q}), **SHORT
        )

    return jax.jit(jax.vmap(one))


def filled(rows, rest):
    """Rows, filled up to SIZE, so that every test runs the one compiled program."""
    return np.stack([*rows, *[rest] * (SIZE - len(rows))])


SIZE = 32


def vector(**changes):
    values = np.asarray(NOMINAL)
    for path, value in changes.items():
        values[PATHS.index(path.replace("__", "."))] = value
    return values


@pytest.mark.slow
def test_gradient_in_both_modes_is_the_finite_difference(gradients):
    n = len(PATHS)
    steps = 1e-5 * np.maximum(np.abs(NOMINAL), 0.1)
    shifted = [vector() + sign * np.diag(steps)[i] for i in range(n) for sign in (1, -1)]
    value, status, reverse, forward = (
        np.asarray(x) for x in gradients([vector()] * n + shifted, list(np.eye(n)))
    )
    assert int(status[0]) == Status.OK
    np.testing.assert_allclose(reverse[0], forward[:n], rtol=1e-7, atol=1e-9)
    difference = (value[n : 3 * n : 2] - value[n + 1 : 3 * n : 2]) / (2 * steps)
    np.testing.assert_allclose(forward[:n], difference, rtol=2e-4, atol=2e-6)
    assert np.all(np.abs(forward[:n]) > 1e-9)  # every parameter matters


@pytest.mark.slow
def test_values_and_gradients_are_finite_wherever_a_run_starts(gradients):
    """Near the wall, on it, past it, and thrown at it: numbers and both gradients stay finite."""
    rows = [vector(initial__q=q) for q in STARTS]
    rows += [vector(initial__dq=v) for v in (30.0, -300.0, 9e3)]
    value, status, reverse, forward = gradients(rows)
    for name, numbers in (("value", value), ("reverse", reverse), ("forward", forward)):
        bad = np.flatnonzero(~np.all(np.isfinite(np.asarray(numbers).reshape(SIZE, -1)), axis=1))
        assert bad.size == 0, (name, [rows[i] for i in bad])
    violated = np.asarray(status)[: len(STARTS)] & Status.BOUND_VIOLATED != 0
    outside = [not (0.34 < q < 0.9) for q in STARTS]
    assert all(v for v, o in zip(violated, outside, strict=True) if o)


@pytest.mark.slow
def test_run_away_states_have_finite_gradients(gradients):
    rows = [vector(controller__K2=k) for k in (200.0, 1e3, 1e4, 1e6)] + [
        vector(observer__kf=k) for k in (1e4, 1e5)
    ]
    rows += [vector(plant__mass=m) for m in (1e-6, 1e6)]
    value, status, reverse, forward = (np.asarray(x) for x in gradients(rows))
    assert np.all(status[:6] & Status.NOT_FINITE)
    assert np.all(np.isfinite(np.concatenate([value[:, None], reverse, forward[:, None]], axis=1)))


@pytest.mark.slow
def test_a_failing_run_leaves_the_others_bit_identical(batch):
    calm = batch(jnp.asarray([20.0, 20.0, 12.0]), jnp.asarray([0.8, 0.8, 0.7]))
    for K2, q in ((1e6, 0.8), (20.0, 5.0), (20.0, np.nan), (np.inf, 0.8)):
        troubled = batch(jnp.asarray([20.0, K2, 12.0]), jnp.asarray([0.8, q, 0.7]))
        assert int(troubled.status[1]) & (Status.NOT_FINITE | Status.BOUND_VIOLATED)
        for i in (0, 2):
            assert int(troubled.status[i]) == 0
            same = jax.tree.map(lambda a, b: bool(np.array_equal(a, b)), calm[i], troubled[i])
            assert all(jax.tree.leaves(same))


@pytest.mark.slow
def test_jit_and_vmap_give_what_simulate_gives(paper, short_run, batch):
    runs = batch(jnp.asarray([20.0, 12.0, 30.0]), jnp.full(3, 0.8))
    assert runs.is_batch
    assert len(runs) == 3
    assert runs.q.shape == (3, 501, 2)
    for name in ("q", "dq", "tau", "V", "e2", "disturbance_estimate"):
        np.testing.assert_allclose(
            getattr(runs[0], name), getattr(short_run, name), rtol=1e-7, atol=1e-9, err_msg=name
        )
    for name in short_run.metrics:
        np.testing.assert_allclose(
            runs[0].metrics[name], short_run.metrics[name], rtol=1e-7, err_msg=name
        )
    alone = ij.simulate(ij.with_parameters(paper, {"controller.K2": 12.0}), **SHORT)
    np.testing.assert_allclose(runs[1].q, alone.q, rtol=1e-7, atol=1e-9)


needs_compiler = pytest.mark.skipif(native.unavailable() is not None, reason="no C++ compiler")

LEAVES = (
    "controller.K2",
    "observer.kf",
    "plant.mass",
    "plant.g",
    "initial.q",
    "disturbance.phase",
    "bounds[0].upper",
)
"""Gains, the robot, the start, the world: one of every kind of leaf."""
LIGHT = {
    "duration": 0.03,
    "dt": 1e-3,
    "method": "euler",
    "metrics": [ij.metrics.Tracking(), ij.metrics.Torque()],
}
"""A run whose derivatives by the scan compile soon."""


def everything(scenario, **options):
    """Records and metrics of a run, the floats of them, as a function of the leaves LEAVES."""
    start = {
        path: x for path, _, _, x in ij.parameters(scenario, named=False) if path.startswith(LEAVES)
    }

    def run(values):
        made = ij.simulate(ij.with_parameters(scenario, values), **LIGHT, **options)
        recorded = set(ALWAYS)
        return {
            name: x
            for name, x in {**vars(made), **made.metrics}.items()
            if name in recorded or name in made.metrics
        }

    def floats(values):
        return {name: x for name, x in run(values).items() if jnp.issubdtype(x.dtype, jnp.floating)}

    return floats, start


@pytest.mark.slow
@needs_compiler
def test_derivatives_are_the_kernels_and_equal_those_of_plain_jax(paper, monkeypatch):
    """Of all that is recorded and measured, by leaves of every kind, in both modes, in a batch and
    inside jit."""
    plain, start = everything(paper, backend="vmap")
    expected, value = jax.jacfwd(plain)(start), plain(start)
    assert len(start) >= 10 and len(expected) > 20
    calls = []
    monkeypatch.setattr(
        transformable,
        "_run_by_scan",
        lambda *args: calls.append(1) or (_ for _ in ()).throw(AssertionError("the scan")),
    )
    run, _ = everything(paper)

    def all_close(found, wanted, rtol=1e-9):
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            np.testing.assert_allclose(
                a, b, rtol=rtol, atol=1e-9 * max(1.0, float(np.max(np.abs(b), initial=0.0)))
            )

    all_close(jax.jacfwd(run)(start), expected)
    found, pulled = jax.vjp(run, start)
    all_close(found, value)
    ones = jax.tree.map(jnp.ones_like, value)
    along = jax.tree.map(jnp.ones_like, start)
    pushed = jax.jvp(run, (start,), (along,))[1]
    together = sum(float(jnp.sum(x)) for x in jax.tree.leaves(pushed))
    transposed = sum(float(jnp.sum(x)) for x in jax.tree.leaves(pulled(ones)[0]))
    np.testing.assert_allclose(together, transposed, rtol=1e-9)
    two = jax.tree.map(lambda x: jnp.stack([x, x * (1 + 1e-3)]), start)
    batched = jax.jit(jax.vmap(lambda values: jax.jvp(run, (values,), (along,))[1]))(two)
    all_close(jax.tree.map(lambda x: x[0], batched), pushed)
    all_close(
        jax.tree.map(lambda x: x[1], batched),
        jax.jvp(run, (jax.tree.map(lambda x: x[1], two),), (along,))[1],
    )
    assert calls == []


@pytest.mark.slow
@needs_compiler
def test_second_derivatives_are_the_kernels(paper, monkeypatch):
    monkeypatch.setattr(
        transformable,
        "_run_by_scan",
        lambda *args: (_ for _ in ()).throw(AssertionError("the scan")),
    )

    def ise(values):
        return ij.simulate(
            ij.with_parameters(paper, {"controller.K2": values[:2], "plant.mass": values[2:]}),
            **LIGHT,
        ).metrics.ise.sum()

    at, width = jnp.asarray([20.0, 15.0, 1.5, 1.2]), 1e-4
    hessian = jax.hessian(ise)(at)
    moved = [at + sign * width * unit for unit in np.eye(4) for sign in (1, -1)]
    slopes = np.asarray([jax.grad(ise)(x) for x in moved]).reshape(4, 2, 4)
    np.testing.assert_allclose(
        hessian, (slopes[:, 0] - slopes[:, 1]) / (2 * width), rtol=1e-5, atol=1e-10
    )
    np.testing.assert_allclose(jax.jacrev(jax.grad(ise))(at), hessian, rtol=1e-9, atol=1e-14)


@needs_compiler
@pytest.mark.slow
def test_where_kernels_cannot_the_scan_differentiates(paper, monkeypatch):
    """And says the same: by the step, by higher orders, without a compiler, and where a step does
    not lower."""

    def last(K2, dt):
        scenario = canonical(ij.with_parameters(paper, {"controller.K2": K2}))
        return jnp.sum(
            transformable.run_transformable(
                scenario, (), dt, request.RunRequest(30, "euler", 1)
            ).records.signals["x"][-1, 0]
        )

    K2, dt, calls = jnp.asarray([20.0, 15.0]), jnp.asarray(1e-3), []
    expected, original = jax.grad(last)(K2, dt), transformable._run_by_scan
    monkeypatch.setattr(
        transformable, "_run_by_scan", lambda *args: calls.append(1) or original(*args)
    )
    np.testing.assert_array_equal(jax.grad(last)(K2, dt), expected)
    assert calls == []
    slope = jax.grad(last, 1)(K2, dt)
    np.testing.assert_allclose(
        slope, (last(K2, dt * 1.001) - last(K2, dt * 0.999)) / (2e-3 * dt), rtol=1e-5
    )

    def no_kernel(*args):
        raise UnsupportedError("made up")

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


def test_new_numbers_do_not_recompile(paper, paper_run, monkeypatch):
    """Once a structure, a length and a method are compiled, every other value runs the same
    program."""
    ij.simulate(paper, **PAPER)
    traces = []
    original = time_step.advance
    monkeypatch.setattr(
        time_step,
        "advance",
        lambda *args, **options: traces.append(1) or original(*args, **options),
    )
    parts = (single_run._initialize, single_run._all_steps, single_run._finalize)
    before = [part._cache_size() for part in parts]
    for changes in (
        {"controller.K2": 30.0},
        {"plant.mass[1]": 1},
        {"robot.g": 1.62},
        {"initial.q": np.asarray([0.7, 0.6])},
        {"disturbance.phase": 0.5},
    ):
        assert ij.simulate(ij.with_parameters(paper, changes), **PAPER).ok
    fresh = ij.presets.zhang_yan_2024()
    ij.simulate(fresh, **PAPER)
    ij.simulate(fresh, **PAPER, throw=True)
    assert traces == []
    assert [part._cache_size() for part in parts] == before


def test_a_new_structure_does_recompile(paper, monkeypatch):
    """So that the test above can fail."""
    traces = []
    single_run._initialize.clear_cache()
    monkeypatch.setattr(
        single_run,
        "initialize",
        lambda *args: traces.append(1) or (_ for _ in ()).throw(KeyboardInterrupt),
    )
    with pytest.raises(KeyboardInterrupt):
        ij.simulate(paper, **SHORT, metrics=(ij.metrics.Torque(),))
    assert traces == [1]


@pytest.mark.slow
@needs_compiler
def test_another_length_compiles_the_steps_alone(paper):
    def compiled():
        return [
            part._cache_size()
            for part in (single_run._initialize, single_run._all_steps, single_run._finalize)
        ]

    ij.simulate(paper, **SHORT, backend="native")
    before = compiled()
    longer = ij.simulate(paper, duration=0.537, dt=1e-3, record_every=3, backend="native")
    assert [new - old for new, old in zip(compiled(), before, strict=True)] == [0, 1, 0]
    again = ij.simulate(paper, **SHORT, backend="native")
    np.testing.assert_array_equal(longer.q[:150], again.q[:450:3])


@pytest.mark.slow
@needs_compiler
def test_a_run_alone_falls_back_where_its_kernel_cannot_be_built(paper, tmp_path, monkeypatch):
    """With one warning, after which the process does not try again, whatever the length is; with
    a compiler that works the kernel is built."""
    broken = tmp_path / "g++"
    broken.write_text(
        '#!/bin/sh\n[ "$1" = --version ] && echo broken 1.0 && exit 0\necho "error: no"'
        " >&2\nexit 1\n"
    )
    broken.chmod(0o755)
    few = {"duration": 0.05, "dt": 1e-3, "method": "euler", "metrics": (ij.metrics.Margin(),)}
    expected = ij.simulate(paper, **few, backend="vmap")
    CACHE.clear(compile.WARNINGS)
    CACHE.clear(single_run.FAILED_BUILDS)
    cpu.kernel.cache_clear()
    cpu.rows_function.cache_clear()
    with monkeypatch.context() as patch:
        patch.setenv("CXX", str(broken))
        with pytest.warns(compile.BackendWarning, match="native backend is not available .*failed"):
            found = ij.simulate(paper, **few, backend="native")
        np.testing.assert_array_equal(found.q, expected.q)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            ij.simulate(paper, **few | {"duration": 0.06}, backend="native")
            np.testing.assert_array_equal(ij.simulate(paper, **few).q, expected.q)
    CACHE.clear(single_run.FAILED_BUILDS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        built = ij.simulate(paper, **few, backend="native")
    np.testing.assert_allclose(built.q, expected.q, rtol=1e-12)


@pytest.mark.slow
def test_the_same_run_twice_is_bit_identical(paper, short_run):
    again = ij.simulate(paper, **SHORT)
    for name in ("q", "tau", "V"):
        np.testing.assert_array_equal(getattr(again, name), getattr(short_run, name))


def test_no_warning_on_a_good_run(paper):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ij.simulate(paper, **SHORT)


@pytest.mark.slow
def test_a_rollout_is_a_pytree_and_indexes_runs(short_run):
    doubled = jax.tree.map(lambda x: jnp.stack([x, x]), short_run)
    assert len(doubled) == 2
    np.testing.assert_array_equal(doubled[1].q, short_run.q)
    assert "2 runs" in repr(doubled)
    assert "status: ok" in repr(short_run)
    with pytest.raises(TypeError, match="one run"):
        short_run[0]
    with pytest.raises(TypeError, match="one run"):
        len(short_run)
