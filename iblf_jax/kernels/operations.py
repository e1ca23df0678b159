"""The operations of scalar programs, one row each: how they are folded, how C writes them, and what
they cost.

A new operation that a jaxpr applies entry by entry is a row here and, if C has no operator for it,
a function `f_<name>` in `c/mathlib.h`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np


class Operation(NamedTuple):
    """One operation on numbers."""

    numpy: Callable[..., Any] | None
    """Folds constants; None where it depends on more than their values."""
    cost: int | None
    """Approximate number of vector instructions; None for a call of the C library for every run."""
    c: Mapping[str, str] | None = None
    """Kind of the first argument -> the C, with {} for each argument; None for `f_<name>`, which
    takes floats only."""
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


def _arithmetic(numpy: Callable, sign: str, cost: int = 1, **more: Any) -> Operation:
    return Operation(numpy, cost, dict.fromkeys("fi", f"{{}} {sign} {{}}"), **more)


def _comparison(numpy: Callable, sign: str, of_flags: str | None = None, **more: Any) -> Operation:
    c = dict.fromkeys("fi", f"MASK({{}} {sign} {{}})")
    if of_flags:
        c["b"] = of_flags
    return Operation(numpy, 1, c, **more)


def _logic(numpy: Callable, sign: str) -> Operation:
    return Operation(numpy, 1, dict.fromkeys("ib", f"{{}} {sign} {{}}"), commutes=True)


OPERATIONS: dict[str, Operation] = {
    "add": _arithmetic(np.add, "+", commutes=True, primitives=("add", "add_any")),
    "sub": _arithmetic(np.subtract, "-"),
    "mul": _arithmetic(np.multiply, "*", commutes=True),
    "div": _arithmetic(np.divide, "/", cost=8),
    "rem": Operation(np.fmod, None),
    "neg": Operation(np.negative, 1, {"f": "-{}", "i": "-{}"}),
    "abs": Operation(np.abs, 1),
    "max": Operation(np.maximum, 3, {"f": "f_max({}, {})", "i": "i_max({}, {})"}),
    "min": Operation(np.minimum, 3, {"f": "f_min({}, {})", "i": "i_min({}, {})"}),
    "sign": Operation(np.sign, 4),
    "floor": Operation(np.floor, 1),
    "ceil": Operation(np.ceil, 1),
    "round_even": Operation(np.rint, 1, primitives=()),
    "sqrt": Operation(np.sqrt, 8),
    "rsqrt": Operation(lambda x: 1 / np.sqrt(x), 16),
    "cbrt": Operation(np.cbrt, None),
    "sin": Operation(np.sin, 18),
    "cos": Operation(np.cos, 18),
    "tan": Operation(np.tan, 40),
    "asin": Operation(np.arcsin, None),
    "acos": Operation(np.arccos, None),
    "atan": Operation(np.arctan, 26),
    "atan2": Operation(np.arctan2, 40),
    "sinh": Operation(np.sinh, None),
    "cosh": Operation(np.cosh, None),
    "tanh": Operation(np.tanh, 32),
    "asinh": Operation(np.arcsinh, None),
    "acosh": Operation(np.arccosh, None),
    "atanh": Operation(np.arctanh, None),
    "exp": Operation(np.exp, 20),
    "exp2": Operation(np.exp2, None),
    "expm1": Operation(np.expm1, 22),
    "log": Operation(np.log, 24),
    "log1p": Operation(np.log1p, 32),
    "pow": Operation(np.power, None, primitives=()),
    "erf": Operation(np.vectorize(math.erf, otypes=[float]), None),
    "erfc": Operation(np.vectorize(math.erfc, otypes=[float]), None),
    "logistic": Operation(lambda x: 1 / (1 + np.exp(-x)), 30),
    "is_finite": Operation(np.isfinite, 2),
    "eq": _comparison(np.equal, "==", of_flags="~({} ^ {})", commutes=True),
    "ne": _comparison(np.not_equal, "!=", of_flags="({} ^ {})", commutes=True),
    "lt": _comparison(np.less, "<"),
    "le": _comparison(np.less_equal, "<="),
    "gt": _comparison(np.greater, ">"),
    "ge": _comparison(np.greater_equal, ">="),
    "and": _logic(np.bitwise_and, "&"),
    "or": _logic(np.bitwise_or, "|"),
    "xor": _logic(np.bitwise_xor, "^"),
    "not": Operation(np.bitwise_not, 1, {"i": "~{}", "b": "~{}"}),
    "select": Operation(np.where, 1, {"b": "{} ? {} : {}"}, primitives=()),
    "convert": Operation(None, 1, {}, primitives=()),
    "lookup": Operation(None, 24, {}, primitives=()),
}
"""The operations of a program, besides constants and inputs. The effect of "convert" depends on
both kinds, and a "lookup" has a table."""
ON_INTERVALS = ("upper", "lower", "hull", "meet", "with_sign")
"""Operations that only programs on intervals have (`interval_primitives`)."""
COMMUTING = frozenset(name for name, operation in OPERATIONS.items() if operation.commutes)
