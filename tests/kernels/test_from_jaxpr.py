"""Scalar programs: a program does what the step that it came from does."""

import dataclasses
import warnings
from functools import partial

import gpu_on_cpu
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from by_numpy import evaluate
from scenarios_of_members import scenarios

import iblf_jax as ij
from iblf_jax.core.caches import CACHE
from iblf_jax.engine import RunRequest, compile, execute, native, thresholds
from iblf_jax.engine.batch import Batch
from iblf_jax.engine.carry import Inputs, StepOptions, initial_carry
from iblf_jax.engine.loops import program_of
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.kernels import passes, program
from iblf_jax.kernels.compilation import scalar_program
from iblf_jax.kernels.from_jaxpr import closed
from iblf_jax.kernels.layout import Layout
from iblf_jax.kernels.packed import Shapes, pack
from iblf_jax.kernels.passes import written_out
from iblf_jax.simulation import error_estimate
from iblf_jax.simulation.closed_loop import initial_state
from iblf_jax.simulation.metrics import standard
from iblf_jax.simulation.scenario import canonical

PRESET = ij.presets.zhang_yan_2024()
DT = 1e-3
STANDARD = standard()


@partial(jax.jit, static_argnames="method")
def carry_of(inputs, varied, method):
    """The carry before the first step; its Jacobian is made up: it has programs of its own."""

    def one(inputs):
        size = error_estimate.watched_indices(initial_state(inputs.scenario)).size
        dtype = inputs.dt.dtype
        waves = jnp.cos(jnp.arange(1.0, 1.0 + size * size, dtype=dtype)).reshape(size, size)
        return initial_carry(inputs, method, 0.1 * waves - jnp.eye(size, dtype=dtype))

    return Batch.of(inputs, varied).map_runs(one)


def carried(p: program.Program, shared, lane, carry, index):
    known = evaluate(p, {"shared": shared, "per_run": lane, "carry": carry}, index)
    return [known[o] for _, o in p.carry]


def numbers(leaves) -> list:
    return [x for leaf in leaves for x in np.asarray(leaf).ravel()]


def arrays_of(batch, carry, dtype="float64"):
    """The arrays of shared leaves, of per-run leaves and of the carry that a kernel takes."""

    @jax.jit
    def packed(shared, per_run, flat):
        joined = jnp.concatenate([jnp.ravel(x) for x in shared])
        lanes = pack(per_run, Shapes.of(per_run, 1), dtype, batch.runs).floats
        return joined, lanes, pack(flat, Shapes.of(flat, 1), dtype, batch.runs)

    return packed(batch.leaves.shared, batch.leaves.per_run, jax.tree.leaves(carry))


def stepped(program, shared, lane, carry, steps: int) -> np.ndarray:
    """The carry of one run after some steps, by NumPy, node by node."""
    layout, values = Layout.of(program), np.zeros(len(program.kinds), object)
    values[layout.floats] = list(np.asarray(carry.floats))
    values[layout.ints] = list(np.asarray(carry.ints))
    step, inputs = written_out(program), (np.asarray(shared), np.asarray(lane))
    for i in range(steps):
        values = carried(step, *inputs, list(values), i)
        values = [np.broadcast_to(v, np.shape(carry.floats)[1:]) for v in values]
    return np.asarray(values, float)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["disturbance sum", "reference waypoint_spline"])
def test_program_and_kernel_do_what_the_step_does(name, monkeypatch):
    """As one function, and with its stages as calls.  `test_programs_of_members` runs the kernels
    of all members on CPUs, `test_cuda`, on a GPU, those for GPUs, and `test_operations` each
    operation of either."""
    scenario = canonical(scenarios()[name]())
    index, step = jnp.int32(3), TimeStep("heun")
    starts = scenario.initial.q + jnp.asarray([[0.0], [0.01], [-0.02]])
    varied = {"initial.q": starts, "plant.mass[1]": jnp.asarray([0.9, 0.7, 0.8])}
    whole = Inputs(scenario, STANDARD, jnp.asarray(DT), jnp.asarray(10.0))
    run, carries = Batch.of(whole, varied), carry_of(whole, varied, "heun")
    carry, lane = (
        jax.tree.map(lambda x: np.asarray(x)[0], x) for x in (carries, run.leaves.per_run)
    )
    inputs = run.leaves.unflatten(run.leaves.shared, lane)
    expected = jax.jit(lambda c: step(inputs, c, index, StepOptions(rolled=True))[0])(carry)
    p, _ = program_of(step, run, carries)
    limits = thresholds.LOWERING_LIMITS._replace(written_out=10)
    monkeypatch.setattr(thresholds, "LOWERING_LIMITS", limits)
    called, _ = program_of(step, run, carries)
    # One for each stage, and one for the further piece of a step that a jump time divides.
    assert sum(node.op == "call" for node in called.nodes) == 2 + scenario.jump_times().size
    for each in (p, called):
        values = (numbers(x) for x in (run.leaves.shared, lane, jax.tree.leaves(carry)))
        found = np.asarray(carried(written_out(each), *values, index), float)
        wanted = np.asarray(numbers(jax.tree.leaves(expected)), float)
        np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-12)
    if native.unavailable() or name != "disturbance sum":  # whose stages are called in pieces
        return
    arrays, layout = arrays_of(run, carries), Layout.of(called)
    (floats, ints), _ = gpu_on_cpu.run(called, *arrays, 5, None)
    after = stepped(called, *arrays, 5)
    np.testing.assert_allclose(floats, after[layout.floats], rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(ints, after[layout.ints])


def lowered_function(f, *arrays):
    """The outputs of `f` by its scalar program, with constants for inputs."""
    b = program.Builder(np.float64, limits=thresholds.LOWERING_LIMITS)
    operands, values = [], []
    for x in arrays:
        kind = "f" if np.issubdtype(x.dtype, np.floating) else "i"
        inputs = [b.input("carry", len(values) + i, kind) for i in range(x.size)]
        operands.append(np.asarray(inputs).reshape(x.shape))
        values += map(np.asarray, x.ravel().tolist())
    (out,) = closed(b, jax.make_jaxpr(f)(*arrays), operands)
    carry = tuple((-1, int(i)) for i in out.ravel())
    p = dataclasses.replace(program.finished(b, [], [], []), nodes=tuple(b.nodes), carry=carry)
    return np.asarray(carried(p, [], [], values, 0)).reshape(out.shape)


X, Y = np.linspace(-1.4, 1.3, 6).reshape(2, 3), np.linspace(0.2, 0.9, 6).reshape(3, 2)
K = np.arange(3)
TABLE = np.linspace(3.0, 4.0, 400).reshape(2, 200)
ACTIVATIONS = ("relu", "gelu", "softplus", "silu", "elu", "mish", "leaky_relu", "softmax")


def powers(x):
    return x**7 + x**-2 + jnp.abs(x) ** 1.5 + jnp.float_power(2.0, x)


def elementary(y):
    logarithms = jnp.log1p(y) + jnp.log2(y) + jax.nn.sigmoid(y)
    return jnp.tanh(y) + jnp.arctan2(y, 1 - y) + jax.scipy.special.erf(y) + logarithms


def derivatives(y):
    def function(y):
        return jnp.tanh(y) + jnp.arcsin(y) + jnp.arctanh(y) + jnp.log2(y)

    return jax.jvp(function, (y,), (y,))[1]


def own_index(x, k):
    return x[:, k[1]] + jax.lax.dynamic_slice(x, (k[0], k[1]), (1, 1))[0, 0]


def from_a_table(k):
    table = jnp.asarray(TABLE)
    return table[:, 90 * k[2]] * jax.lax.dynamic_slice(table, (1, 70 * k[1]), (1, 2))[0]


def from_tables(k):
    table = jnp.asarray(TABLE)
    return jax.vmap(lambda i: table[:, 90 * i])(k) + table[1, 60 * k][:, None]


def outside_of_a_table(k):
    return jnp.asarray(TABLE)[0, 900 * k[2]] + jnp.asarray(TABLE)[0, -900 * k[2]]


def update_at_an_index_of_the_run(x, k):
    return jax.lax.dynamic_update_slice(jnp.zeros(5), x[0, 1:2], (k[1],))


def zeros_of_either_sign(k):
    return sum(jnp.exp(-1 / jnp.asarray([zero, 1.0])[k[0]]) for zero in (0.0, -0.0))


def scanned(x):
    return jax.lax.scan(lambda c, r: (c + r, c * r), jnp.zeros(3), x, reverse=True)[1]


def where_and_round(x):
    rounded = jnp.where(x > 0, jnp.round(x * 3), jnp.floor(x))
    return rounded + jnp.sign(x) * jnp.clip(x, -0.5, 0.5)


def activations(x):
    found = [getattr(jax.nn, name)(x) for name in ACTIVATIONS]
    return jnp.stack([*found, jax.nn.gelu(x, approximate=False), jax.nn.standardize(x)])


CASES = {
    "matmul": (lambda x, y: x @ y, X, Y),
    "einsum": (lambda x, y: jnp.einsum("ij,jk->ki", x, y), X, Y),
    "cumsum": (lambda x: jnp.cumsum(x[:, ::-1], axis=1), X),
    "reductions": (lambda x: jnp.stack([x.sum(), x.max(), x.min(), x.prod(), x.mean()]), X),
    "argmin": (lambda x: jnp.argmin(x, axis=0) + jnp.argmax(x, axis=0), X),
    "argmin of nan": (lambda x: jnp.argmin(x.at[1, 1].set(jnp.nan), axis=1), X),
    "updates": (lambda x: x.at[1, 0].set(7.0).at[0, 1:].add(2.0).at[1].mul(3.0), X),
    "powers": (powers, X),
    "elementary": (elementary, Y),
    "derivatives": (derivatives, Y),
    "unstack": (lambda x: sum(jnp.unstack(x, axis=1)), X),
    "pad and stack": (lambda x: jnp.stack([jnp.pad(x, 1), jnp.pad(x, ((0, 2), (1, 1)))]), X),
    "own index": (own_index, X, K),
    "table": (from_a_table, K),
    "table, outside": (outside_of_a_table, K),
    "update at an index of the run": (update_at_an_index_of_the_run, X, K),
    "zeros of either sign": (zeros_of_either_sign, K),
    "tables": (from_tables, K),
    "filled gather": (lambda x: jnp.take(x, jnp.asarray([0, 2]), axis=1), X),
    "scan": (scanned, X),
    "cond": (lambda x: jax.lax.cond(x[0, 0] > 0, jnp.sin, jnp.cos, x), X),
    "switch": (lambda x, k: jax.lax.switch(k[2], [jnp.sin, jnp.cos, jnp.exp], x), X, K),
    "where and round": (where_and_round, X),
    "gradient": (lambda x: jax.grad(lambda x: jnp.sum(jnp.sin(x) @ jnp.cos(x).T))(x), X),
    "gradient of a gather": (lambda x: jax.grad(lambda x: jnp.sum(x[0, :2] * x[1, 1:]))(x), X),
    "activations of networks": (activations, X),
    "norm": (lambda x: jnp.linalg.norm(x, axis=1), X),
}


@pytest.mark.parametrize("name", CASES)
def test_primitives(name):
    f, *arrays = CASES[name]
    # In one program XLA may lose the sign of a zero.
    by_jax = f if name == "zeros of either sign" else jax.jit(f)
    found, expected = lowered_function(f, *arrays), by_jax(*map(jnp.asarray, arrays))
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


REFUSED = {
    "while": lambda x: jax.lax.while_loop(lambda c: c < 3, lambda c: c + 1, x[0, 0]),
    "too long": lambda x: jax.lax.scan(lambda c, _: (c * 2, None), x[0, 0], length=1000)[0],
    "sort": lambda x: jnp.sort(x)[0],
    "too many": lambda x: jnp.tile(x[0], 30)[x[0, 0].astype(jnp.int32)],
    "filled": lambda x: jnp.take(x[0], x[0, 0].astype(jnp.int32)),
    "float32": lambda x: x.astype(jnp.float32)[0, 0] * 2,
    "uint32": lambda x: jnp.sum(x).astype(jnp.uint32) * jnp.uint32(2),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_lower_says_why_in_one_line(name):
    with pytest.raises(program.UnsupportedError, match=r"\A.+\Z"):
        lowered_function(REFUSED[name], X)


def test_a_primitive_without_a_rule_is_computed_on_constants():
    """Not where the program must be exact in real arithmetic, nor on what is no constant."""

    def inverse(x, matrices):
        matrix = jnp.array([[2.0, 1.0], [0.5, 3.0]]) if not matrices else matrices[0]
        return jnp.linalg.inv(matrix) @ x

    lowered = scalar_program(inverse, 2)
    assert {node.op for node in lowered.program.nodes} == {"carry", "const", "mul", "add"}
    constants = [node.value for node in lowered.program.nodes if node.op == "const"]
    np.testing.assert_allclose(sorted(constants), np.sort([3, -1, -0.5, 2]) / 5.5, rtol=1e-14)
    for arguments, options in (((), {"exact": True}), ([((2, 2),)], {})):
        with pytest.raises(program.UnsupportedError, match="the primitive 'lu' is not lowered"):
            scalar_program(inverse, 2, *arguments, **options)


def test_identities_keep_nan_and_infinity():
    b = program.Builder(np.float64)
    x = b.input("carry", 0, "f")
    zero, one = b.constant(0.0, "f"), b.constant(1.0, "f")
    pairs = ("mul", one), ("add", zero), ("sub", zero), ("div", one)
    assert {b.emit(op, x, neutral) for op, neutral in pairs} == {x}
    assert b.emit("mul", x, zero) != zero != b.emit("sub", x, x)
    assert b.emit("div", x, x) != one and b.emit("eq", x, x, kind="b") != b.constant(True, "b")
    assert b.emit("add", one, x) == b.emit("add", x, one)


def test_a_sum_is_finite_where_its_logarithms_have_a_value_and_the_rest_is():
    def whether(x, y):
        parts = (
            -jnp.log1p(y),
            0.5 * (x - 0.5 * jnp.log1p(-(y**2))) + y,
            jnp.log1p(y) - 2.0 * x + x,
            0.5 * (x + jnp.log1p(y)) - (y - x),
        )
        return jnp.stack([jnp.isfinite(part) for part in parts])

    big = np.finfo(np.float64).max
    numbers = [0.0, 0.5, -0.5, 1.0, -1.0, -1.5, 1e150, -1e150, np.inf, -np.inf, np.nan]
    numbers += [0.6 * big, -0.6 * big, big]
    x, y = np.stack(np.meshgrid(numbers, numbers)).reshape(2, -1)
    expected = whether(jnp.asarray(x), jnp.asarray(y))
    np.testing.assert_array_equal(lowered_function(whether, x, y), expected)
    b = program.Builder(np.float64)
    v = b.emit("sub", b.input("carry", 0, "f"), b.emit("log1p", b.input("carry", 1, "f")))
    p = program.finished(b, [], [], [b.emit("is_finite", v, kind="b")])
    assert {"log1p", "sub"}.isdisjoint(node.op for node in p.nodes)


@pytest.mark.parametrize("terms", [12, 2000])
def test_long_sums_are_asked_whether_they_are_finite(terms):
    """A chain as long as a `reduce_sum` makes it, and sums that each take the one before twice."""

    def whether(x):
        doubled = jnp.log1p(x[0])
        for _ in range(terms // 100 + 25):
            doubled = doubled + 0.5 * doubled
        return jnp.isfinite(jnp.sum(x)) & jnp.isfinite(doubled)

    rest = np.full(terms - 1, 0.5)
    for x in (np.r_[rest, 0.5], np.r_[rest, np.inf], np.r_[-2.0, rest]):
        np.testing.assert_array_equal(lowered_function(whether, x), whether(jnp.asarray(x)))


def test_a_call_for_samples_alone_does_not_write_over_what_the_carry_reads():
    """It may overwrite what nobody reads: the order for a processor must not change that."""

    def chain(length, extra):
        b = program.Builder(np.float64)
        a = b.input("argument", 0, "f")
        x = b.emit("sin", a)
        for _ in range(length):
            x = b.emit("add", b.emit("mul", x, b.constant(0.5, "f")), b.constant(0.1, "f"))
        more = (b.emit("add", a, b.constant(100.0 + k, "f")) for k in range(extra))
        return program.finished(b, [], [], [x, *more])

    b = program.Builder(np.float64)
    x = b.input("carry", 0, "f")
    kept = b.result(b.call(chain(4, 0), [x]), 0)
    sample = b.result(b.call(chain(60, 3), [x]), 0)
    for _ in range(80):
        sample = b.emit("sin", sample)
    p = program.finished(b, [x], [kept], [sample], (1,))
    order = [node.value.size for node in passes.scheduled(p).nodes if node.op == "call"]
    assert order == [node.value.size for node in p.nodes if node.op == "call"] and len(order) == 2


@ij.component
class Sorting(ij.observers.NoObserver):
    def estimate(self, t, q, dq, model, state):
        return jnp.sort(q) * 0


@pytest.mark.slow
def test_a_step_that_does_not_lower_runs_on_vmap_and_says_so():
    scenario = canonical(dataclasses.replace(PRESET, observer=Sorting()))
    varied, request = {"plant.mass[1]": jnp.asarray([0.8, 0.9])}, RunRequest(3, "euler")
    CACHE.clear(compile.WARNINGS)

    def run():
        batch = partial(execute.run_batch, scenario, varied, (), request=request)
        return jax.jit(batch)(jnp.asarray(DT))

    with pytest.warns(compile.BackendWarning, match="vmap.*'sort'"):
        assert run().status.shape == (2,)
    with warnings.catch_warnings(action="error"):
        run()
