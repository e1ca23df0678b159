"""Kernels on processors agree with the reference run, and runs do not touch each other."""

import re
import shutil
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_toolchain import ZIG_CACHE, ziglang_script

import iblf_jax as ij
from iblf_jax.engine import RunRequest, execute, loops, native, registry, thresholds
from iblf_jax.engine.batch import Batch
from iblf_jax.engine.carry import Inputs, initial_carry
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.kernels import Shapes, compile_step, cpu, packed
from iblf_jax.kernels.program import called_functions
from iblf_jax.simulation.metrics import as_folds, standard
from iblf_jax.simulation.scenario import canonical
from iblf_jax.tuning.quantities import Peak, Quantities, TimeIntegral

needs_compiler = pytest.mark.skipif(native.unavailable() is not None, reason="no C++ compiler")
pytestmark = needs_compiler
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


def part(outcome, runs):
    return jax.tree.map(lambda x: x[runs], outcome)


def assert_same(found, expected, tolerance):
    """Equal up to a tolerance relative to the size of each array; infinities in the same places."""

    def compare(x, y):
        x, y = np.asarray(x), np.asarray(y)
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        scale = 1 + np.max(np.abs(y[np.isfinite(y)]), initial=0)
        np.testing.assert_allclose(x, y, rtol=0, atol=tolerance * scale)

    jax.tree.map(compare, found, expected)


@pytest.fixture(scope="module")
def recorded_steps():
    """Steps of 19 runs with some records, as a function of a loop; and what the scan gives."""
    scenario, step = canonical(ij.presets.zhang_yan_2024()), TimeStep("euler")
    inputs = Inputs(scenario, (), jnp.asarray(1e-3), jnp.asarray(40.0))

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
    found = compiled(values)
    assert_same(found, expected, 1e-12)
    fewer = compiled({k: v[2:] for k, v in values.items()})
    jax.tree.map(np.testing.assert_array_equal, fewer, part(found, slice(2, None)))
    cpu.kernel.cache_clear()


@pytest.mark.slow
def test_results_do_not_depend_on_place_or_number_of_runs():
    values = draws(83)
    together = batch(values=values)
    for few in (slice(0, 5), slice(40, 45), slice(78, 83)):
        alone, some = batch(values={k: v[few] for k, v in values.items()}), part(together, few)
        jax.tree.map(np.testing.assert_array_equal, some, alone)


@pytest.mark.slow
def test_a_run_that_fails_does_not_touch_the_others():
    good, broken = batch(dt=4e-3), draws(5)
    broken["plant.mass[1]"][[1, 4]] = np.nan, 0.02
    broken["initial.q"][3] = 40.0
    found = batch(values=broken, dt=4e-3)
    jax.tree.map(np.testing.assert_array_equal, part(found, [0, 2]), part(good, [0, 2]))
    for run, flag in ((1, "NOT_FINITE"), (3, "BOUND_VIOLATED"), (4, "STEP_TOO_LARGE")):
        assert ij.Status[flag] in ij.Status(int(found.status[run]))
    np.testing.assert_array_equal(found.status, batch("vmap", broken, dt=4e-3).status)


@pytest.mark.slow
@pytest.mark.parametrize(("runs", "dtype"), [(1, "float64"), (65, "float32")])
def test_leaves_become_rows_and_leaves_again(runs, dtype):
    """As by JAX's own operations, for every type and shape that a carry may have."""
    rng = np.random.default_rng(runs)
    leaves = [
        jnp.asarray(rng.normal(size=(runs, *shape)) * 9).astype(kind)
        for kind in (dtype, "int32", "bool", dtype, "int64", "int16", "int8")
        for shape in ((), (2,), (3, 2), (0,), (2, 1, 5))
    ]
    leaves[0] = leaves[0].at[0].set(jnp.nan)
    shapes, number = packed.Shapes.of(leaves, 1), np.dtype(dtype)
    rows = jax.jit(lambda x: native.pack(x, shapes, number, runs))(leaves)
    again = jax.jit(lambda x: native.unpack(x, shapes, runs))(rows)
    expected = packed.pack(leaves, shapes, number, runs)
    for found, wanted in zip((*rows, *again), (*expected, *leaves), strict=True):
        np.testing.assert_array_equal(found, wanted, strict=True)


def test_records_have_the_axis_of_runs_first_and_then_that_of_time():
    rows = np.arange(24.0).reshape(3, 4, 2)  # instants, numbers, runs
    (found,) = packed.unpacked_records([jax.ShapeDtypeStruct((2, 2), "float64")], [rows])
    np.testing.assert_array_equal(found[1, 2], rows[2, :, 1].reshape(2, 2))


def test_rows_of_another_size_are_an_error_and_no_crash():
    """What XLA is told of the shapes is checked where memory is written."""
    for rows, integers, words in ((2, 0, "does not fit"), (5, 0, "without an array")):
        shapes = [((rows, 4), jnp.float64), ((integers, 4), jnp.int32)]
        call = jax.ffi.ffi_call(
            cpu.array_function("pack"), [jax.ShapeDtypeStruct(*x) for x in shapes]
        )
        with pytest.raises(jax.errors.JaxRuntimeError, match=words):
            jax.block_until_ready(call(jnp.ones((4, 3))))


@pytest.mark.slow
def test_a_long_step_is_cut_into_functions(monkeypatch):
    """Of fifty operations, and with stages as calls: some products with sums have other places."""
    whole = batch(record_every=100)
    limits = thresholds.LOWERING_LIMITS._replace(written_out=10)
    monkeypatch.setattr(thresholds, "MAX_C_FUNCTION_NODES", 0)
    monkeypatch.setattr(thresholds, "SEGMENT_NODES", 50)
    monkeypatch.setattr(thresholds, "LOWERING_LIMITS", limits)
    monkeypatch.delitem(COMPILED, ("native", 100))
    for known in (cpu.kernel, cpu.c_source):
        known.cache_clear()
    cut = batch(record_every=100)
    for known in (cpu.kernel, cpu.c_source):
        known.cache_clear()
    # The mode comes from differences of rates, which magnify the last digit.
    np.testing.assert_allclose(cut.fastest_mode, whole.fastest_mode, rtol=1e-9)
    assert_same(cut._replace(fastest_mode=whole.fastest_mode), whole, 1e-12)


def test_a_place_is_used_again_when_no_later_function_reads_its_number():
    def step(shared, per_run, carry, index):
        (x,) = carry
        for _ in range(40):
            x = jnp.sin(x) * x + 1.0
        return [x], ()

    number = np.dtype("float64")
    program = compile_step(step, number, Shapes(()), Shapes(()), Shapes((((), number),))).program
    places = re.findall(r"F x\[(\d+)\]", cpu.c_source(program, 0, 0, 2))
    assert places and 1 < max(map(int, places)) < 10


DIRECTIONS = {"controller.K2": np.eye(3, 2), "observer.kf": np.eye(3, 2, -1)}


def pushed(backend):
    """A batch of runs with three tangents: outcome, tangents, and what folds of a loss give."""
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
@pytest.mark.parametrize("by_columns", [False, True])
def test_forward_sensitivities(monkeypatch, pushed_by_vmap, by_columns):
    if by_columns:
        limits = thresholds.LOWERING_LIMITS._replace(written_out=10)
        monkeypatch.setattr(thresholds, "LOWERING_LIMITS", limits)
        executor = registry.EXECUTORS["native"]
        limits = executor.limits._replace(derivative_nodes=0)
        monkeypatch.setitem(registry.EXECUTORS, "native", executor._replace(limits=limits))
        monkeypatch.setattr(execute, "run_with_tangents", None)
    found = pushed("auto" if by_columns else "native")
    assert_same(found, pushed_by_vmap, 1e-10)
    _, tangents, products = found
    assert tangents["rmse"].shape == (3, 3, 2)
    assert [x.shape for x in products] == [(3, 3, 3)] * 2


@pytest.mark.slow
def test_a_long_run_in_several_calls_is_the_same_run(monkeypatch):
    """Python sees Ctrl-C between them; the numbers are bit for bit those of one call."""
    options = {"method": "euler", "record_every": 7, "backend": "native"}
    run = partial(ij.simulate, ij.presets.zhang_yan_2024(), duration=0.5, dt=1e-3, **options)
    whole, calls = run(), []

    def steps_per_call(nodes, steps, every):
        calls.append(nodes)
        return 21 * 7

    monkeypatch.setattr(thresholds, "OPERATIONS_PER_CALL", 1.0)
    monkeypatch.setattr(thresholds, "steps_per_call", steps_per_call)
    jax.tree.map(np.testing.assert_array_equal, run(), whole)
    assert len(calls) == 1 and calls[0] > 500  # the nodes, not the steps


@pytest.mark.parametrize(
    ("nodes", "steps", "every"),
    [(1800, 20_001, 1), (1800, 20_000_001, 1000), (1800, 20_000_001, None), (60_000, 10**6, 10**5)],
)
def test_a_call_is_short_and_whole(nodes, steps, every):
    length = thresholds.steps_per_call(nodes, steps, every)
    assert length == steps or length % (every or 1) == 0
    assert length * nodes <= max(thresholds.OPERATIONS_PER_CALL, nodes * (every or 1))
    assert (length == steps) == (steps * nodes < thresholds.OPERATIONS_PER_CALL)


def test_copies_at_the_end_of_a_batch_have_the_results_of_their_runs():
    """The kernel does not compute blocks of copies; a copy of a run is not one of its neighbour."""

    def step(shared, per_run, carry, index):
        (k,), (x, count) = per_run, carry
        return [x - 0.1 * k * x, count + (k > 2.0).astype(count.dtype)], []

    leaf = Shapes((((), np.dtype("float64")),))
    numbers = Shapes((*leaf.items, ((), np.dtype("int32"))))
    program = compile_step(step, np.dtype("float64"), Shapes(()), leaf, numbers).program
    rng = np.random.default_rng(0)
    k = rng.uniform(1.0, 3.0, 20)
    x = np.concatenate([rng.uniform(1.0, 2.0, 17), np.full(3, np.nan)])

    def ends(rows):
        columns = [jnp.asarray(x[rows]), jnp.zeros(64, jnp.int32)]
        carry = packed.pack(columns, numbers, np.dtype("float64"), runs=64)
        return cpu.run(program, jnp.zeros(0), jnp.asarray(k[rows])[None], carry, 7)[0]

    each = ends(np.resize(np.arange(20), 64))
    for distinct, last in ((1, 1), (2, 2), (9, 1), (12, 2), (16, 1), (16, 2), (20, 1), (17, 3)):
        copies = np.resize(np.arange(distinct - last, distinct), 64 - distinct)
        rows = np.concatenate([np.arange(distinct), copies])
        found = ends(rows)
        np.testing.assert_array_equal(found.floats, each.floats[:, rows])
        np.testing.assert_array_equal(found.ints, each.ints[:, rows])


@jax.jit
def rate(k, x, u):
    """A rate and a sample, long enough to be a function of its own."""
    for _ in range(30):
        x = jnp.sin(x) * k + u
    return x, jnp.cos(x) * k


@pytest.mark.parametrize("segment", [None, 20])
def test_a_branch_calls_the_function_that_the_step_calls(segment):
    def step(shared, per_run, carry, index):
        (k,), (u,), (x,) = shared, per_run, carry

        def further(x):
            y = rate(k, x, u)[0]
            return rate(k, x + y, u)[0], rate(k, 0.5 * x, u)[1]

        x, sample = rate(k, x, u)
        x, other = jax.lax.cond(index > 1, further, lambda x: (x, 2.0 * x), x)
        return [x], [sample + other]

    leaf = Shapes((((), np.dtype("float64")),))
    limits = thresholds.LOWERING_LIMITS._replace(written_out=10, under_condition=10)
    compiled = compile_step(step, np.dtype("float64"), leaf, leaf, leaf, limits).program
    inner, branch = called_functions(compiled)
    assert [sum(x.op == "call" for x in p.nodes) for p in (compiled, branch, inner)] == [2, 3, 0]
    k, u, x = jnp.asarray([0.9]), jnp.linspace(0.1, 0.5, 7), jnp.linspace(-1.0, 1.0, 7)
    carry = packed.pack([x], leaf, np.dtype("float64"), runs=7)
    build = cpu.Build(segment=segment)
    after, (samples,) = cpu.run(compiled, k, u[None], carry, 5, 1, build=build)
    run = jax.jit(jax.vmap(lambda u, x, i: step([k[0]], [u], [x], i), in_axes=(0, 0, None)))
    for i in range(5):
        (x,), (sample,) = run(u, x, jnp.int32(i))
        np.testing.assert_allclose(samples[i, 0], sample, rtol=1e-13)
    np.testing.assert_allclose(after.floats[0], x, rtol=1e-13)
