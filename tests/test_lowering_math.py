"""Elementary functions of the backends against NumPy in higher precision."""

from __future__ import annotations

import ctypes

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from test_lowering_backends import needs_compiler

from iblf_jax.engine import vector_math
from iblf_jax.lowering import emit_c, toolchain

LINE = np.linspace(-30, 30, 4001)
UNIT = np.linspace(-0.999, 0.999, 4001)
SPREAD = np.concatenate([10.0 ** np.linspace(-30, 30, 3001), np.linspace(0.4, 2.5, 3001)])
FUNCTIONS = {
    "sin": (np.sin, np.concatenate([LINE, 1e3 * LINE, np.pi / 2 * np.arange(-500, 500)]), 1.5),
    "cos": (np.cos, np.concatenate([LINE, 1e3 * LINE, np.pi / 2 * np.arange(-500, 500)]), 1.5),
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
EDGES = [0.0, -0.0, np.inf, -np.inf, np.nan, -1.0, 1.0, 1e-310, 1e300]


def kernel(dtype):
    """The C library behind one function per name, `f(in, out, count)`."""
    entries = "".join(
        f'extern "C" __attribute__((visibility("default"))) void v_{name}(const real *x, real *y, long n) '
        f"{{ for (long i = 0; i < n; i += W) store(y + i, f_{name}(load(x + i))); }}\n"
        for name in FUNCTIONS
    )
    source = f"#define DOUBLE {int(dtype == np.float64)}\n" + emit_c.header("vector.h") + emit_c.header("mathlib.h") + entries
    return toolchain.loaded(toolchain.built(source)[0])


def native_value(library, name, x):
    padded = np.concatenate([x, np.zeros(-len(x) % 64, x.dtype)])
    y = np.empty_like(padded)
    pointers = [ctypes.c_void_p(a.ctypes.data) for a in (padded, y)]
    getattr(library, f"v_{name}")(*pointers, ctypes.c_long(len(padded)))
    return y[: len(x)]


def ulps(found, exact, dtype):
    """Error in units of the last place of `dtype`; near a zero of sin, of the argument's own precision."""
    return np.abs(found.astype(np.longdouble) - exact) / np.spacing(np.maximum(np.abs(exact.astype(dtype)), np.finfo(dtype).tiny))


def exactly(f, x):
    """f in the highest precision at hand."""
    try:
        return f(x.astype(np.longdouble))
    except TypeError:
        return f(x.astype(np.float64)).astype(np.longdouble)


@needs_compiler
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_native_functions(dtype):
    library = kernel(dtype)
    for name, (f, points, limit) in FUNCTIONS.items():
        x = points.astype(dtype)
        x = x[np.abs(x) < 85] if name == "exp" and dtype == np.float32 else x
        worst = np.max(ulps(native_value(library, name, x), exactly(f, x), dtype))
        assert worst <= limit + 0.6, f"{name} is off by {worst} ulp"


@needs_compiler
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_native_functions_at_the_edges(dtype):
    library = kernel(dtype)
    x = np.asarray(EDGES, np.float64).astype(dtype)
    with np.errstate(all="ignore"):
        for name, (f, _, _) in FUNCTIONS.items():
            found, expected = native_value(library, name, x), f(x)
            if name in ("sin", "cos", "tan"):
                found, expected = found[:-1], expected[:-1]
            np.testing.assert_allclose(found, expected, rtol=4 * np.finfo(dtype).eps, atol=np.finfo(dtype).tiny, err_msg=name)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sin_and_cos_of_the_xla_backend(dtype):
    limit = vector_math.LIMIT[np.dtype(dtype)]
    x = np.concatenate([LINE, limit * UNIT, np.pi / 2 * np.arange(-500, 500)]).astype(dtype)
    for ours, exact in ((vector_math.sin, np.sin), (vector_math.cos, np.cos)):
        found = np.asarray(jax.jit(ours)(jnp.asarray(x)))
        error = np.abs(found.astype(np.longdouble) - exact(x.astype(np.longdouble)))
        size = np.spacing(np.abs(found))
        assert np.max(np.minimum(error / size, error / (np.finfo(dtype).eps / 2))) <= 2
        assert np.all(np.isnan(ours(jnp.asarray([2 * limit, np.inf, np.nan], dtype))))
