"""Elementary functions of the backends against NumPy in higher precision."""

import ctypes
import inspect
import platform

import gpu_on_cpu
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from test_cpu import needs_compiler

from iblf_jax.engine import native
from iblf_jax.kernels import emit_c, toolchain, vector_bytes
from iblf_jax.kernels.identities import fold
from iblf_jax.kernels.operations import OPERATIONS
from iblf_jax.kernels.packed import Packed
from iblf_jax.kernels.program import Builder, finished, kind_of

LINE = np.linspace(-30, 30, 4001)
UNIT = np.linspace(-0.999, 0.999, 4001)
SPREAD = np.concatenate([10.0 ** np.linspace(-30, 30, 3001), np.linspace(0.4, 2.5, 3001)])
TURNS = np.concatenate([LINE, 1e3 * LINE, np.pi / 2 * np.arange(-500, 500)])
FUNCTIONS = {
    "sin": (np.sin, TURNS, 1.5),
    "cos": (np.cos, TURNS, 1.5),
    "tan": (np.tan, LINE, 5),
    "exp": (np.exp, 2.8 * LINE, 3),
    "expm1": (np.expm1, np.concatenate([LINE, 0.01 * LINE, 1e-6 * LINE]), 3),
    "tanh": (np.tanh, np.concatenate([LINE, 0.01 * LINE]), 5),
    "logistic": (scipy.special.expit, LINE, 5),
    "log": (np.log, SPREAD, 3),
    "log1p": (np.log1p, np.concatenate([UNIT, 1e-3 * UNIT, 1e-8 * UNIT, SPREAD]), 3),
    "atan": (np.arctan, np.concatenate([LINE, UNIT, 1e4 * UNIT]), 3),
    "sqrt": (np.sqrt, SPREAD, 0.5),
    "cbrt": (np.cbrt, SPREAD, 3),
    "erf": (scipy.special.erf, LINE / 10, 3),
}
FAR = {np.float32: 38, np.float64: 308}
"""Exponent of the largest numbers."""
EDGES = [0.0, -0.0, np.inf, -np.inf, np.nan, -1.0, 1.0, 1e-310, 1e300]


def spread(dtype):
    """Numbers of every size, some of them as near to a zero of sin or cos as there are."""
    x = 10.0 ** np.linspace(0, FAR[dtype], 4001)
    steps = np.round(x / (np.pi / 2)).astype(np.longdouble)
    return np.concatenate([x, -x, (steps * (np.pi / np.longdouble(2))).astype(np.float64)])


def kernel(dtype, flags=()):
    """The C library behind one function per name, `f(in, out, count)`."""
    entries = "".join(
        f'extern "C" __attribute__((visibility("default"))) void v_{name}(const real *x, real *y,'
        f" long n) {{ for (long i = 0; i < n; i += W) store(y + i, f_{name}(load(x + i))); }}\n"
        for name in FUNCTIONS
    )
    entries += 'extern "C" __attribute__((visibility("default"))) int width() { return W; }\n'
    headers = emit_c.header("vector.h") + emit_c.header("mathlib.h")
    source = f"#define DOUBLE {int(dtype == np.float64)}\n{headers}{entries}"
    return toolchain.loaded(toolchain.built(source, flags)[0])


def native_value(library, name, x):
    padded = np.concatenate([x, np.zeros(-len(x) % 64, x.dtype)])
    y = np.empty_like(padded)
    pointers = [ctypes.c_void_p(a.ctypes.data) for a in (padded, y)]
    getattr(library, f"v_{name}")(*pointers, ctypes.c_long(len(padded)))
    return y[: len(x)]


def worst_error(library, name, f, x):
    """The largest error at some points in units of the last place, beside the highest precision at
    hand; near a zero of sin, of the argument's own precision."""
    try:
        exact = f(x.astype(np.longdouble))
    except TypeError:
        exact = f(x.astype(np.float64)).astype(np.longdouble)
    size = np.maximum(np.abs(exact.astype(x.dtype)), np.finfo(x.dtype).tiny)
    error = native_value(library, name, x).astype(np.longdouble) - exact
    return np.max(np.abs(error) / np.spacing(size))


@needs_compiler
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_native_functions(dtype):
    library, edges = kernel(dtype), np.asarray(EDGES, np.float64).astype(dtype)
    assert library.width() == vector_bytes() // np.dtype(dtype).itemsize
    rounding = {"rtol": 4 * np.finfo(dtype).eps, "atol": np.finfo(dtype).tiny}
    for name, (f, points, limit) in FUNCTIONS.items():
        x = points.astype(dtype)
        x = x[np.abs(x) < 85] if name == "exp" and dtype == np.float32 else x
        x = np.concatenate([x, spread(dtype).astype(dtype)]) if name in ("sin", "cos") else x
        worst = worst_error(library, name, f, x)
        assert worst <= limit + 0.6, f"{name} is off by {worst} ulp"
        with np.errstate(all="ignore"):
            found, expected = native_value(library, name, edges), f(edges)
        np.testing.assert_allclose(found, expected, err_msg=name, **rounding)


@needs_compiler
@pytest.mark.skipif(
    platform.machine() != "x86_64", reason="other processors have fused multiply-adds"
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sin_and_cos_without_a_fused_multiply_add(dtype):
    library = kernel(dtype, ("-march=nehalem",))
    x = np.concatenate([LINE, UNIT, spread(dtype)]).astype(dtype)
    for name, f in (("sin", np.sin), ("cos", np.cos)):
        assert worst_error(library, name, f, x) <= 2.1


LAX = {
    "round_even": jax.lax.round,
    **{name: getattr(jax.lax, f"bitwise_{name}") for name in ("and", "or", "xor", "not")},
}
"""The operations that `jax.lax` has by another name."""


def all_operations(dtype, runs=256):
    """A program of all rows on all kinds of C, its inputs, what NumPy makes of it, and names."""
    rng, b = np.random.default_rng(0), Builder(dtype)
    sizes = 10.0 ** rng.uniform(-3, 1, (3, runs)) * rng.choice([-1, 1], (3, runs))
    moderate = rng.uniform(-3, 3, (3, runs))
    floats = np.where(rng.random((3, runs)) < 0.5, sizes, moderate).astype(dtype)
    floats[:, :3] = 1e9  # sin and cos on their seldom way
    values = {
        "f": floats,
        "i": rng.integers(1, 9, (3, runs)) * rng.choice([-1, 1], (3, runs)),
        "b": rng.random((3, runs)) < 0.5,
    }
    types = {"f": np.dtype(dtype), "i": np.dtype(np.int32), "b": np.dtype(np.bool_)}
    inputs = {
        kind: [b.input("carry", 3 * k + i, kind) for i in range(3)] for k, kind in enumerate("fib")
    }
    outputs = [i for kind in "fib" for i in inputs[kind]]
    expected, names = [row for kind in "fib" for row in values[kind]], ["input"] * 9

    def add(op, kinds, result):
        columns = [values[kind][place].tolist() for place, kind in enumerate(kinds)]
        rows, args = zip(*columns, strict=True), [inputs[x][i] for i, x in enumerate(kinds)]
        if op == "lookup":
            node = b.lookup((7.0, 8.0, 9.0, 10.0, 11.0), *args)
            folded = [7 + min(max(x, 0), 4) for (x,) in rows]
        else:
            node = b.emit(op, *args, kind=result)
            folded = [fold(op, list(xs), list(kinds), result, types["f"]) for xs in rows]
        outputs.append(node)
        expected.append(np.asarray(folded, types[result]))
        names.append(f"{op} of {kinds}")

    for op in (x for x in OPERATIONS if x not in ("convert", "lookup")):
        function = LAX.get(op) or getattr(jax.lax, op)
        arity = sum(p.default is p.empty for p in inspect.signature(function).parameters.values())
        for first in OPERATIONS[op].c or "f":
            same = [(first,) * arity]
            for kinds in [(first, *2 * kind) for kind in "fib"] if op == "select" else same:
                dummies = [jax.ShapeDtypeStruct((), types[kind]) for kind in kinds]
                result = jax.eval_shape(lambda *x, f=function: f(*x), *dummies)
                add(op, kinds, kind_of(result.dtype))
    for source, target in ("if", "bf", "bi", "fi"):
        add("convert", (source,), target)
    add("lookup", ("i",), "f")
    program = finished(b, outputs[:9] + [-1] * len(outputs[9:]), outputs, [])
    carry = np.asarray([*values["f"]]), np.asarray([*values["i"], *values["b"]])
    return program, carry, expected, names


def test_constants_are_folded_as_jax_computes_them():
    """Every operation on numbers that JAX has by the same name, with numbers of both signs."""
    x, y = np.array([[-3.5, -0.4, 0.3, 2.5, 0.0], [1.5, -0.7, 0.2, -2.0, -1.0]])
    folds = {
        name: operation.numpy
        for name, operation in OPERATIONS.items()
        if operation.numpy and hasattr(jax.lax, name) and name != "select"
    }
    assert {"rem", "sub", "atan2", "sign", "lt", "pow"} <= folds.keys()
    arguments = {name: (x, y)[: getattr(fold, "nin", 1)] for name, fold in folds.items()}

    @jax.jit
    def computed(arguments):
        return {name: getattr(jax.lax, name)(*given) for name, given in arguments.items()}

    found = computed(arguments)
    with np.errstate(all="ignore"):
        for name, given in arguments.items():
            np.testing.assert_allclose(folds[name](*given), found[name], rtol=1e-12, err_msg=name)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("run", [native.run, gpu_on_cpu.run], ids=["native", "gpu"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_operation_is_the_same_everywhere(run, dtype):
    program, (floats, ints), expected, names = all_operations(dtype)
    assert {name.partition(" ")[0] for name in names[9:]} == set(OPERATIONS)
    kinds, runs, number = program.kinds, floats.shape[1], np.finfo(dtype)

    def filled(rows, kind, to):
        results = sum((x == "f") == (kind == "f") for x in kinds) - len(rows)
        return jnp.asarray(np.concatenate([rows, np.zeros((results, runs))]), to)

    packed = Packed(filled(floats, "f", dtype), filled(ints, "i", jnp.int32))
    none = jnp.zeros(1, dtype), jnp.zeros((1, runs), dtype)
    after = jax.jit(lambda carry: run(program, *none, carry, 1, None)[0])(packed)
    rows = {"f": iter(np.asarray(after.floats)), "i": iter(np.asarray(after.ints))}
    for name, kind, exact in zip(names, kinds, expected, strict=True):
        found = next(rows["f" if kind == "f" else "i"])
        allowed = {"rtol": 16 * number.eps, "atol": number.tiny} if kind == "f" else {"rtol": 0}
        np.testing.assert_allclose(found, exact, err_msg=name, **allowed)
