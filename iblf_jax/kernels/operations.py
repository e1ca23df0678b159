"""The operations of scalar programs, one row each: how they are folded, how XLA and C write them,
and what they cost.

A new operation that a jaxpr applies entry by entry is a row here and, if C has no operator for it,
a function `f_<name>` in `c/mathlib.h`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jax import lax


class Operation(NamedTuple):
    """One operation on numbers."""

    numpy: Callable[..., Any] | None
    """Folds constants; None where it depends on more than their values."""
    lax: Callable[..., Any] | None
    """The function of XLA. It is no function of jnp: those are jitted, and each would be a call
    within a function that XLA may not inline."""
    cost: int | None
    """Approximate number of vector instructions; None for a call of the C library for every run."""
    c: Mapping[str, str] | None = None
    """Kind of the first argument -> the C, with {} for each argument; None for `f_<name>`, which
    takes floats only."""
    cheap: bool = False
    """Whether it is one instruction of a CPU in XLA."""
    commutes: bool = False
    """Whether op(x, y) equals op(y, x) for all numbers."""
    primitives: tuple[str, ...] | None = None
    """The primitives of jaxprs that apply it entry by entry; None for the one of the same name."""

    def in_c(self, name: str, kind: str, args: list[str]) -> str | None:
        """The C of the operation on these expressions; None if there is none for this kind."""
        if self.c is None and kind == "f":
            return f"f_{name}({', '.join(args)})"
        if self.c is None or kind not in self.c:
            return None
        return self.c[kind].format(*args)


def _reciprocal_root(x):
    return 1 / np.sqrt(x)


def _logistic(x):
    return 1 / (1 + np.exp(-x))


def _round_even(x):
    return lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN)


def _arithmetic(numpy: Callable, xla: Callable, sign: str, cost: int = 1, **more: Any) -> Operation:
    return Operation(numpy, xla, cost, dict.fromkeys("fi", f"{{}} {sign} {{}}"), **more)


def _comparison(
    numpy: Callable, xla: Callable, sign: str, of_flags: str | None = None, **more: Any
) -> Operation:
    c = dict.fromkeys("fi", f"MASK({{}} {sign} {{}})")
    if of_flags:
        c["b"] = of_flags
    return Operation(numpy, xla, 1, c, cheap=True, **more)


def _logic(numpy: Callable, xla: Callable, sign: str) -> Operation:
    return Operation(
        numpy, xla, 1, dict.fromkeys("ib", f"{{}} {sign} {{}}"), cheap=True, commutes=True
    )


OPERATIONS: dict[str, Operation] = {
    "add": _arithmetic(
        np.add, lax.add, "+", cheap=True, commutes=True, primitives=("add", "add_any")
    ),
    "sub": _arithmetic(np.subtract, lax.sub, "-", cheap=True),
    "mul": _arithmetic(np.multiply, lax.mul, "*", cheap=True, commutes=True),
    "div": _arithmetic(np.divide, lax.div, "/", cost=8),
    "rem": Operation(np.fmod, lax.rem, None),
    "neg": Operation(np.negative, lax.neg, 1, {"f": "-{}", "i": "-{}"}, cheap=True),
    "abs": Operation(np.abs, lax.abs, 1, cheap=True),
    "max": Operation(
        np.maximum, lax.max, 3, {"f": "f_max({}, {})", "i": "i_max({}, {})"}, cheap=True
    ),
    "min": Operation(
        np.minimum, lax.min, 3, {"f": "f_min({}, {})", "i": "i_min({}, {})"}, cheap=True
    ),
    "sign": Operation(np.sign, lax.sign, 4),
    "floor": Operation(np.floor, lax.floor, 1),
    "ceil": Operation(np.ceil, lax.ceil, 1),
    "round_even": Operation(np.rint, _round_even, 1, primitives=()),
    "sqrt": Operation(np.sqrt, lax.sqrt, 8),
    "rsqrt": Operation(_reciprocal_root, lax.rsqrt, 16),
    "cbrt": Operation(np.cbrt, lax.cbrt, None),
    "sin": Operation(np.sin, lax.sin, 18),
    "cos": Operation(np.cos, lax.cos, 18),
    "tan": Operation(np.tan, lax.tan, 40),
    "asin": Operation(np.arcsin, lax.asin, None),
    "acos": Operation(np.arccos, lax.acos, None),
    "atan": Operation(np.arctan, lax.atan, 26),
    "atan2": Operation(np.arctan2, lax.atan2, 40),
    "sinh": Operation(np.sinh, lax.sinh, None),
    "cosh": Operation(np.cosh, lax.cosh, None),
    "tanh": Operation(np.tanh, lax.tanh, 32),
    "asinh": Operation(np.arcsinh, lax.asinh, None),
    "acosh": Operation(np.arccosh, lax.acosh, None),
    "atanh": Operation(np.arctanh, lax.atanh, None),
    "exp": Operation(np.exp, lax.exp, 20),
    "exp2": Operation(np.exp2, lax.exp2, None),
    "expm1": Operation(np.expm1, lax.expm1, 22),
    "log": Operation(np.log, lax.log, 24),
    "log1p": Operation(np.log1p, lax.log1p, 32),
    "pow": Operation(np.power, lax.pow, None, primitives=()),
    "erf": Operation(np.vectorize(math.erf, otypes=[float]), lax.erf, None),
    "erfc": Operation(np.vectorize(math.erfc, otypes=[float]), lax.erfc, None),
    "logistic": Operation(_logistic, lax.logistic, 30),
    "is_finite": Operation(np.isfinite, lax.is_finite, 2),
    "eq": _comparison(np.equal, lax.eq, "==", of_flags="~({} ^ {})", commutes=True),
    "ne": _comparison(np.not_equal, lax.ne, "!=", of_flags="({} ^ {})", commutes=True),
    "lt": _comparison(np.less, lax.lt, "<"),
    "le": _comparison(np.less_equal, lax.le, "<="),
    "gt": _comparison(np.greater, lax.gt, ">"),
    "ge": _comparison(np.greater_equal, lax.ge, ">="),
    "and": _logic(np.bitwise_and, lax.bitwise_and, "&"),
    "or": _logic(np.bitwise_or, lax.bitwise_or, "|"),
    "xor": _logic(np.bitwise_xor, lax.bitwise_xor, "^"),
    "not": Operation(np.bitwise_not, lax.bitwise_not, 1, {"i": "~{}", "b": "~{}"}, cheap=True),
    "select": Operation(np.where, lax.select, 1, {"b": "{} ? {} : {}"}, cheap=True, primitives=()),
    "convert": Operation(None, None, 1, {}, cheap=True, primitives=()),
    "lookup": Operation(None, None, 24, {}, primitives=()),
}
"""The operations of a program, besides constants and inputs. The effect of "convert" depends on
both kinds, and a "lookup" has a table."""
