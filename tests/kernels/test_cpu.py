"""Backends: they agree with the reference run, runs do not touch each other, and what goes wrong
falls back."""

from __future__ import annotations

import os
import shutil
import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fallback import with_fallback
from test_toolchain import ZIG_CACHE, ziglang_script

import iblf_jax as ij
from iblf_jax.core.caches import CACHE
from iblf_jax.engine import RunRequest, compile, execute, loops, native, registry, thresholds
from iblf_jax.engine.batch import Batch
from iblf_jax.engine.carry import Inputs, initial_carry
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.kernels import cpu, packed
from iblf_jax.simulation.metrics import as_folds, standard
from iblf_jax.simulation.scenario import canonical
from iblf_jax.tuning.quantities import Peak, Quantities, TimeIntegral

needs_compiler = pytest.mark.skipif(native.unavailable() is not None, reason="no C++ compiler")
COMPILED = {}


def batch(backend="native", values=None, record_every=None, dt=1e-3):
    """The outcome of some runs of the paper's scenario; one compilation for each set of options."""
    scenario, varied = canonical(ij.presets.zhang_yan_2024()), values or draws(5)
    key = (backend, record_every)
    if key not in COMPILED:
        run = RunRequest(400, "heun", record_every, backend=backend)
        COMPILED[key] = jax.jit(lambda s, v, f, dt: execute.run_batch(s, v, f, dt, run))
    varied = {k: jnp.asarray(v) for k, v in varied.items()}
    return jax.tree.map(np.asarray, COMPILED[key](scenario, varied, standard(), jnp.asarray(dt)))


def draws(runs, seed=0):
    rng = np.random.default_rng(seed)
    return {
        "plant.mass[1]": rng.uniform(0.6, 1.1, runs),
        "initial.q": 0.8 + 0.02 * rng.standard_normal((runs, 2)),
    }


def assert_same(found, expected, tolerance):
    """Equal up to a tolerance relative to the size of each array; infinities in the same places."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        finite = np.isfinite(y)
        scale = 1 + np.max(np.abs(y[finite]), initial=0)
        np.testing.assert_allclose(x, y, rtol=0, atol=tolerance * scale)


@pytest.fixture(scope="module")
def recorded_steps():
    """Steps of 19 runs with a record of every fifth one, as a function of a loop; and what the scan
    gives."""
    inputs = Inputs(
        canonical(ij.presets.zhang_yan_2024()), (), jnp.asarray(1e-3), jnp.asarray(40.0)
    )
    step = TimeStep("euler")

    def steps(loop, values):
        batch = Batch.of(inputs, values)
        carry = batch.map_runs(lambda inputs: initial_carry(inputs, "euler", jnp.zeros((6, 6))))
        return loop(step, batch, carry, 40, 5)

    values = {k: jnp.asarray(v) for k, v in draws(19).items()}
    return steps, values, jax.jit(partial(steps, loops.scan))(values)


@pytest.mark.slow
@pytest.mark.parametrize(
    "family", ["g++", "clang++", pytest.param("ziglang", marks=pytest.mark.release)]
)
def test_every_compiler_gives_the_same_numbers(tmp_path, monkeypatch, recorded_steps, family):
    """Flags and pragmas suit GCC and Clang; the compilers optimise here, as a user's do."""
    if family == "ziglang":
        pytest.importorskip("ziglang")
        monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", ZIG_CACHE)
    elif not shutil.which(family):
        pytest.skip(f"there is no {family} here")
    monkeypatch.setenv("CXX", ziglang_script(tmp_path) if family == "ziglang" else family)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    steps, values, expected = recorded_steps
    cpu.kernel.cache_clear()
    compiled = jax.jit(partial(steps, loops.kernel_stepper(registry.NATIVE)))
    found = jax.tree.map(np.asarray, compiled(values))
    assert_same(found, jax.tree.map(np.asarray, expected), 1e-12)
    fewer = jax.tree.map(np.asarray, compiled({k: v[2:] for k, v in values.items()}))
    for x, y in zip(jax.tree.leaves(fewer), jax.tree.leaves(found), strict=True):
        np.testing.assert_array_equal(x, y[2:])
    cpu.kernel.cache_clear()


@pytest.mark.slow
@needs_compiler
def test_results_do_not_depend_on_place_or_number_of_runs():
    values = draws(83)
    together = batch(values=values)
    for few in (slice(0, 5), slice(40, 45), slice(78, 83)):
        alone = batch(values={k: v[few] for k, v in values.items()})
        for x, y in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_array_equal(x[few], y)


@pytest.mark.slow
@needs_compiler
def test_a_run_that_fails_does_not_touch_the_others():
    values = draws(5)
    good = batch(values=values)
    broken = {k: v.copy() for k, v in values.items()}
    broken["plant.mass[1]"][1] = np.nan
    broken["initial.q"][3] = 40.0
    found = batch(values=broken)
    others = [0, 2, 4]
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(good), strict=True):
        np.testing.assert_array_equal(x[others], y[others])
    assert ij.Status.NOT_FINITE in ij.Status(int(found.status[1]))
    assert ij.Status.BOUND_VIOLATED in ij.Status(int(found.status[3]))
    np.testing.assert_array_equal(found.status, batch(backend="vmap", values=broken).status)


@pytest.mark.slow
@needs_compiler
def test_a_step_that_is_too_large_is_seen_by_every_backend():
    values = {
        "plant.mass[1]": np.asarray([0.85, 0.05, 0.02, 0.85, 0.9]),
        "initial.q": np.full((5, 2), 0.8),
    }
    found, expected = batch(values=values, dt=4e-3), batch(values=values, dt=4e-3, backend="vmap")
    np.testing.assert_array_equal(found.status, expected.status)
    assert np.any(found.status & ij.Status.STEP_TOO_LARGE)


@pytest.mark.slow
@needs_compiler
def test_one_run_and_threads():
    one = batch(values=draws(1))
    os.environ["IBLF_JAX_THREADS"] = "3"
    try:
        assert native.threads() == 3
    finally:
        del os.environ["IBLF_JAX_THREADS"]
    assert one.status.shape == (1,)
    assert_same(
        one,
        jax.tree.map(
            lambda x: x[:1],
            batch(values=draws(5) | {k: np.repeat(v, 5, 0) for k, v in draws(1).items()}),
        ),
        1e-12,
    )


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(("runs", "dtype"), [(1, "float64"), (65, "float32")])
def test_leaves_become_rows_and_leaves_again(runs, dtype):
    """As by JAX's own operations, for every type and shape that a carry may have."""
    rng, leaves = np.random.default_rng(runs), []
    for kind in (dtype, "int32", "bool", dtype, "int64", "int16", "int8"):
        for shape in ((), (2,), (3, 2), (0,), (2, 1, 5)):
            leaves.append(jnp.asarray(rng.normal(size=(runs, *shape)) * 9).astype(kind))
    leaves[0] = leaves[0].at[0].set(jnp.nan)
    shapes = packed.Shapes.of(leaves, 1)
    rows = jax.jit(lambda x: native.pack(x, shapes, np.dtype(dtype), runs))(leaves)
    for found, expected in zip(
        rows, packed.pack(leaves, shapes, np.dtype(dtype), runs), strict=True
    ):
        np.testing.assert_array_equal(found, expected, strict=True)
    for found, expected in zip(
        jax.jit(lambda x: native.unpack(x, shapes, runs))(rows), leaves, strict=True
    ):
        np.testing.assert_array_equal(found, expected, strict=True)


@needs_compiler
def test_rows_of_another_size_are_an_error_and_no_crash():
    """What XLA is told of the shapes is checked where memory is written."""
    leaf, rows = (
        jnp.ones((4, 3)),
        [jax.ShapeDtypeStruct((n, 4), t) for n, t in ((2, jnp.float64), (0, jnp.int32))],
    )
    with pytest.raises(jax.errors.JaxRuntimeError, match="does not fit"):
        jax.block_until_ready(jax.ffi.ffi_call(cpu.rows_function("pack"), rows)(leaf))
    with pytest.raises(jax.errors.JaxRuntimeError, match="without an array"):
        jax.block_until_ready(
            jax.ffi.ffi_call(
                cpu.rows_function("pack"), [jax.ShapeDtypeStruct((5, 4), jnp.float64), rows[1]]
            )(leaf)
        )


def forget_kernels():
    """What this process knows of kernels and their text."""
    cpu.kernel.cache_clear()
    cpu.c_source.cache_clear()


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(("parts", "record_every"), [("functions", 100), ("both", 100)])
def test_a_long_step_is_cut_into_functions(monkeypatch, parts, record_every):
    """Cut into pieces of fifty operations, and with its stages as calls, the numbers stay: the
    places of some products with sums differ."""
    whole = batch(record_every=record_every)
    monkeypatch.setattr(thresholds, "MAX_C_FUNCTION_NODES", 0)
    monkeypatch.setattr(thresholds, "SEGMENT_NODES", 50)
    if parts == "both":
        limits = thresholds.LOWERING_LIMITS._replace(written_out=10)
        monkeypatch.setattr(thresholds, "LOWERING_LIMITS", limits)
    forget_kernels()
    monkeypatch.delitem(COMPILED, ("native", record_every))
    cut = batch(record_every=record_every)
    forget_kernels()
    # The mode comes from differences of rates, which magnify the last digit.
    np.testing.assert_allclose(cut.fastest_mode, whole.fastest_mode, rtol=1e-9)
    assert_same(cut._replace(fastest_mode=whole.fastest_mode), whole, 1e-12)


DIRECTIONS = {"controller.K2": np.eye(3, 2), "observer.kf": np.eye(3, 2, -1)}


def pushed(backend):
    """A batch of the paper's runs with three tangents: outcome, tangents, and what the folds of a
    loss give."""
    scenario, dt = canonical(ij.presets.zhang_yan_2024()), jnp.asarray(1e-3)
    varied = {k: jnp.asarray(v) for k, v in draws(3).items()}
    losses = Quantities((TimeIntegral(), TimeIntegral("torque"), Peak(10.0)))
    folds = (*standard()[:1], *as_folds((losses,), jnp.float64))
    request = RunRequest(60, "euler", backend=backend)
    return jax.jit(lambda s, v: execute.run_batch_jvp(s, v, DIRECTIONS, folds, dt, request))(
        scenario, varied
    )


@pytest.fixture(scope="module")
def pushed_by_vmap():
    return pushed("vmap")


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(
    ("written_out", "by_columns"), [(thresholds.LOWERING_LIMITS.written_out, False), (10, True)]
)
def test_forward_sensitivities(monkeypatch, pushed_by_vmap, written_out, by_columns):
    limits = thresholds.LOWERING_LIMITS._replace(written_out=written_out)
    monkeypatch.setattr(thresholds, "LOWERING_LIMITS", limits)
    if by_columns:
        executor = registry.EXECUTORS["native"]
        limits = executor.limits._replace(derivative_nodes=0)
        monkeypatch.setitem(registry.EXECUTORS, "native", executor._replace(limits=limits))
        monkeypatch.setattr(execute, "run_with_tangents", None)
    outcome, tangents, products = pushed("auto" if by_columns else "native")
    reference, expected, exact = pushed_by_vmap
    assert_same(jax.tree.map(np.asarray, tangents), jax.tree.map(np.asarray, expected), 1e-10)
    assert_same(jax.tree.map(np.asarray, outcome), jax.tree.map(np.asarray, reference), 1e-10)
    assert tangents["rmse"].shape == (3, 3, 2)
    assert_same(products, exact, 1e-10)
    assert [x.shape for x in products] == [(3, 3, 3)] * 2


def test_without_a_compiler_it_runs_on_vmap_with_one_warning(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    CACHE.clear(compile.WARNINGS)
    cpu.kernel.cache_clear()
    called = []
    with pytest.warns(compile.BackendWarning, match="no-such-compiler.*vmap"):
        with_fallback("auto", called.append, lambda: called.append("vmap"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with_fallback("auto", called.append, lambda: called.append("vmap"))
    assert called == ["vmap"] * 2


@pytest.mark.slow
def test_one_run_on_the_native_backend_is_the_run(paper):
    """Records, metrics and status of `simulate(backend="native")` are those of vmap; another value
    of a leaf builds nothing new."""
    for scenario in (
        paper,
        ij.with_parameters(paper, {"controller.K2": 30.0, "plant.mass[1]": 1.1}),
    ):
        one, other = (
            ij.simulate(scenario, duration=0.5, dt=1e-3, record_every=7, backend=backend)
            for backend in ("vmap", "native")
        )
        np.testing.assert_allclose(one.q, other.q, rtol=0, atol=1e-10)
        np.testing.assert_allclose(one.tau, other.tau, rtol=0, atol=1e-9)
        np.testing.assert_allclose(one.observer_state, other.observer_state, rtol=0, atol=1e-9)
        assert int(one.status) == int(other.status) == 0
        for name in one.metrics:
            np.testing.assert_allclose(
                one.metrics[name], other.metrics[name], rtol=1e-9, atol=1e-12
            )
    with pytest.raises(ValueError, match="backend"):
        ij.simulate(paper, duration=0.5, dt=1e-3, backend="fortran")


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("every", [1, 7])
def test_a_long_run_in_several_calls_is_the_same_run(monkeypatch, every):
    """Python sees Ctrl-C between them; the numbers are bit for bit those of one call."""
    options = {
        "duration": 0.5,
        "dt": 1e-3,
        "record_every": every,
        "method": "euler",
        "backend": "native",
    }
    scenario = ij.presets.zhang_yan_2024()
    whole = ij.simulate(scenario, **options)
    calls = []
    monkeypatch.setattr(thresholds, "OPERATIONS_PER_CALL", 1.0)
    monkeypatch.setattr(
        thresholds, "steps_per_call", lambda nodes, steps, every: calls.append(nodes) or 21 * 7
    )
    parts = ij.simulate(scenario, **options)
    assert len(calls) == 1
    assert calls[0] > 100
    for x, y in zip(jax.tree.leaves(parts), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


@pytest.mark.parametrize(
    ("nodes", "steps", "every"),
    [(1800, 20_001, 1), (1800, 20_000_001, 1000), (1800, 20_000_001, None), (60_000, 10**6, 10**5)],
)
def test_a_call_is_short_and_whole(nodes, steps, every):
    length = thresholds.steps_per_call(nodes, steps, every)
    assert length == steps or length % (every or 1) == 0
    assert length * nodes <= max(thresholds.OPERATIONS_PER_CALL, nodes * (every or 1))
    assert (length == steps) == (steps * nodes < thresholds.OPERATIONS_PER_CALL)
