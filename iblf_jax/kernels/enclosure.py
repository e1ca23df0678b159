"""Enclosures of JAX functions over boxes, by interval arithmetic with outward rounding.

A function of one point, (d,), and of constants is lowered to a scalar program (`from_jaxpr`), which
a C++ compiler translates to operations on intervals (`c/interval.h`), for as many boxes at a time
as a vector has entries. The enclosures contain the values of the function in real arithmetic: every
bound is rounded outward, literals and constants count as the exact floating-point numbers that they
are, and nothing inexact is folded.
"""

from __future__ import annotations

import ctypes
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.kernels.caches import CACHES
from iblf_jax.kernels.compilation import scalar_program
from iblf_jax.kernels.emit_c import header
from iblf_jax.kernels.program import (
    SHARED,
    Node,
    Program,
    UnsupportedError,
    needed,
)
from iblf_jax.kernels.toolchain import ToolchainError, built, loaded

ENCLOSURE_FLAGS = ("-frounding-math",)
"""Flags of the compiler, after those of all kernels. A product and a sum that become one operation
are rounded once, which is upward, too."""
FUNCTIONS = frozenset(
    [
        *("add", "sub", "neg", "abs", "max", "min", "div", "sqrt", "rsqrt", "sign"),
        *("tan", "exp", "expm1", "log", "log1p", "atan", "sinh", "cosh", "tanh", "logistic"),
        *("upper", "lower", "hull", "meet"),
    ]
)
"""Operations on intervals that `c/interval.h` has as `i_<name>`."""
COMPARISONS = frozenset({"lt", "le", "gt", "ge", "eq", "ne"})
LOGIC = {
    "and": "t_and",
    "or": "t_or",
    "xor": "t_xor",
    "not": "t_not",
    "ne": "t_xor",
    "eq": "t_same",
}
"""Operations on truth values -> their C++ functions."""
FORMS = {
    "number": ("number", "{}"),
    "flag": ("flag", "{}"),
    "single": ("single", "factor_of({}.u)"),
    "several": ("several", "factors_of({})"),
    "reciprocal": ("several", "reciprocals_of({})"),
}
"""Form of what depends on constants only -> the member of `shared_number` and its value."""
SEEN = "const shared_number *table, const interval *x"
"""What every function that evaluates boxes reads."""
SEGMENT = 400
"""Operations of a function; the time of a compiler grows faster than its length."""
NOTHING: Mapping[int, str] = MappingProxyType({})
LARGEST_POWER = 64
"""Integer exponents up to which a power is computed by products."""


class Compiled(NamedTuple):
    """A function as a program on intervals."""

    program: Program
    sizes: tuple[int, ...]
    """Number of entries of each output array."""
    shapes: tuple[tuple[int, ...], ...]
    """Shape of each output array."""
    literals: tuple[float, ...]
    """Numbers of the program; the kernel receives them after the constants."""
    source: str


@CACHES.function(maxsize=64)
def compiled(function: Callable, dimension: int, shapes: tuple[tuple[int, ...], ...]) -> Compiled:
    """The program of a function on intervals, and its C++ source.

    Args:
      function: as `scalar_program`; the function object is the key of a cache.
      dimension: number of coordinates.
      shapes: shapes of the constants.

    Raises:
      UnsupportedError: an operation is not available on intervals.
    """
    lowered = scalar_program(function, dimension, shapes, exact=True)
    constants = sum(map(math.prod, shapes))
    # By their digits: 0.0 and -0.0 are equal, and each has its place.
    nodes = lowered.program.nodes
    floats = [node.value for node in nodes if node.op == "const" and node.kind == "f"]
    literals = tuple({value.hex(): value for value in floats}.values())
    emitter = _Emitter(lowered.program, constants, literals)
    sizes = {
        "DOUBLE": 1,
        "COORDINATES": dimension,
        "OUTPUTS": len(lowered.program.outputs),
        "ALTERNATIVES": lowered.sizes[0],
        "TABLE_SIZE": max(1, len(emitter.table)),
    }
    parts = [
        *(f"#define {name} {value}" for name, value in sizes.items()),
        header("vector.h"),
        header("interval.h"),
        emitter.shared_numbers(),
        emitter.evaluation(),
        header("boxes.h"),
    ]
    source = "\n".join(parts)
    return Compiled(*lowered, literals, source)


class _Emitter:
    """Writes the C++ of a program on intervals.

    Args:
      program: the program.
      constants: number of constants.
      literals: numbers of the program, in the order in which the kernel receives them.
    """

    def __init__(self, program: Program, constants: int, literals: tuple[float, ...]) -> None:
        self.nodes = program.nodes
        self.outputs = program.outputs
        self.place = {value.hex(): constants + k for k, value in enumerate(literals)}
        self.is_shared = [c == SHARED for c in program.classes()]
        read = {
            (self._form(i, a), a)
            for i, node in enumerate(self.nodes)
            if not self.is_shared[i]
            for a in node.args
            if self.is_shared[a]
        }
        read |= {("number", i) for i in self.outputs if self.is_shared[i]}
        self.table = {entry: k for k, entry in enumerate(sorted(read))}
        """Form and node of what depends on constants only -> its place in the table."""

    def _form(self, user: int, i: int) -> str:
        """The form in which a node that depends on the box reads one that does not (`FORMS`)."""
        node = self.nodes[i]
        users_op = self.nodes[user].op
        if node.kind == "b":
            return "flag"
        if users_op == "div" and self.nodes[user].args[1] == i:
            return "reciprocal"
        if node.op == "const" or users_op != "mul":
            return "number"
        if node.op == "shared":
            return "single"
        return "several"

    def shared_numbers(self) -> str:
        """The function that fills the table."""
        inputs = {
            i: self._place(node)
            for i, node in enumerate(self.nodes)
            if node.op == "shared" or (node.op == "const" and node.kind == "f")
        }
        lines = [f"  interval v{i} = at(all_lanes(shared[{k}]));" for i, k in inputs.items()]
        names = {i: f"v{i}" for i in inputs}
        lines += self.statements(names, needed(self.nodes, {i for _, i in self.table}, names))
        for (form, i), k in self.table.items():
            member, value = FORMS[form]
            lines.append(f"  table[{k}].{member} = {value.format(names[i])};")
        return function("shared_numbers", "const real *shared, shared_number *table", lines)

    def _place(self, node: Node) -> int:
        """The position of an input or a literal among the numbers that the kernel receives."""
        if node.op == "shared":
            return node.value
        return self.place[node.value.hex()]

    def evaluation(self) -> str:
        """The function `evaluate`, and those that it is divided into."""
        names = {i: self._in_table("number", i) for i, known in enumerate(self.is_shared) if known}
        names |= {i: f"x[{n.value}]" for i, n in enumerate(self.nodes) if n.op == "carry"}
        order = needed(self.nodes, self.outputs, names)
        parts = [order[k : k + SEGMENT] for k in range(0, len(order), SEGMENT)]
        memory = _Memory(self.nodes, self.outputs, parts)
        functions = []
        for k, part in enumerate(parts):
            stored = memory.stored(part)
            lines = self.statements(dict(names), part, stored)
            functions.append(function(f"part_{k}", f"{SEEN}, shared_number *m", lines))
            names |= stored
        lines = [f"  shared_number m[{memory.size + 1}];"]
        lines += [f"  part_{k}(table, x, m);" for k in range(len(parts))]
        lines += [f"  out[{k}] = {names[i]};" for k, i in enumerate(self.outputs)]
        return "\n".join([*functions, function("evaluate", f"{SEEN}, interval *out", lines)])

    def _in_table(self, form: str, i: int) -> str:
        """The C++ of an entry of the table; empty if there is none."""
        if (form, i) not in self.table:
            return ""
        return f"table[{self.table[form, i]}].{FORMS[form][0]}"

    def _arguments(self, i: int, names: dict[int, str]) -> list[str]:
        """The C++ of the arguments of a node."""
        return [
            self._in_table(self._form(i, a), a)
            if self.is_shared[a] and not self.is_shared[i]
            else names[a]
            for a in self.nodes[i].args
        ]

    def statements(
        self, names: dict[int, str], nodes: Sequence[int], stored: Mapping[int, str] = NOTHING
    ) -> list[str]:
        """The statements of nodes, of which some are stored at places; new names are added."""
        lines = []
        for i in nodes:
            node = self.nodes[i]
            if i not in names and node.op in ("sin", "cos"):
                lines.append(self._sine_and_cosine(i, nodes, names))
            if i not in names:
                lines.append(f"  {_type(node)} v{i} = {self.expression(i, names)};")
                names[i] = f"v{i}"
            if i in stored:
                lines.append(f"  {stored[i]} = {names[i]};")
        return lines

    def _sine_and_cosine(self, i: int, nodes: Sequence[int], names: dict[int, str]) -> str:
        """The statement of the sine and the cosine of one angle, of which some nodes need one."""
        (angle,) = self.nodes[i].args
        (text,) = self._arguments(i, names)
        for j in nodes:
            if self.nodes[j].op in ("sin", "cos") and self.nodes[j].args == (angle,):
                names[j] = f"a{angle}.{self.nodes[j].op}"
        return f"  sine_and_cosine a{angle} = i_sincos({text});"

    def expression(self, i: int, names: dict[int, str]) -> str:
        """The C++ of a node's operation."""
        node = self.nodes[i]
        nodes = [self.nodes[a] for a in node.args]
        args = self._arguments(i, names)
        listed = ", ".join(args)
        of_truths = bool(nodes) and nodes[0].kind == "b"
        if node.op == "const" and node.kind == "b":
            return f"certain({int(node.value)})"
        if node.op == "select":
            return f"{_type(node)[0]}_select({listed})"
        if of_truths and node.op == "convert" and node.kind == "f":
            return f"number_of({listed})"
        if of_truths and node.op in LOGIC:
            return f"{LOGIC[node.op]}({listed})"
        if node.op == "mul":
            return self._product(i, args)
        if node.op == "div" and self.is_shared[node.args[1]] and not self.is_shared[i]:
            return f"i_multiple({listed})"
        if node.op == "pow" and self.is_shared[node.args[1]]:
            exponent = nodes[1]
            if exponent.op != "const" or not exponent.value.is_integer():
                return f"i_pow({listed})"
            if 0 < exponent.value <= LARGEST_POWER:
                return f"i_power({args[0]}, {int(exponent.value)})"
            reason = f"the power {exponent.value:g} is not available on intervals"
            raise UnsupportedError(reason)
        if node.op == "is_finite":
            return f"t_is_finite({listed})"
        if node.op == "with_sign":
            return args[0]
        if node.op in COMPARISONS and not of_truths:
            return f"t_{node.op}({listed})"
        if node.op in FUNCTIONS and node.kind == "f":
            return f"i_{node.op}({listed})"
        raise UnsupportedError(f"the operation {node.op!r} is not available on intervals")

    def _product(self, i: int, args: Sequence[str]) -> str:
        """A product: a square, one with a literal or another shared number, or any other."""
        factors = self.nodes[i].args
        if factors[0] == factors[1]:
            return f"i_square({args[0]})"
        for one, other in ((0, 1), (1, 0)):
            factor = self.nodes[factors[one]]
            if factor.op == "const" and factor.value > 0:
                return f"i_scaled({args[other]}, {args[one]}.u)"
            if factor.op == "const" and factor.value < 0:
                return f"i_scaled(i_neg({args[other]}), {args[one]}.n)"
            is_literal = factor.op == "const"  # 0 or NaN here
            if self.is_shared[factors[one]] and not self.is_shared[i] and not is_literal:
                function = {"single": "i_times", "several": "i_multiple"}[
                    self._form(i, factors[one])
                ]
                return f"{function}({args[other]}, {args[one]})"
        return f"i_mul({', '.join(args)})"


class _Memory:
    """Places in memory of the numbers that one part of a program computes and another one reads.

    Args:
      nodes: all nodes.
      outputs: nodes that are read after the last part.
      parts: the nodes of each part.
    """

    def __init__(
        self, nodes: Sequence[Node], outputs: Sequence[int], parts: Sequence[Sequence[int]]
    ) -> None:
        self.nodes = nodes
        self.size = 0
        part_of = {i: k for k, part in enumerate(parts) for i in part}
        last = dict(part_of)
        for i, k in part_of.items():
            last |= {a: max(last[a], k) for a in nodes[i].args if a in last}
        last |= {i: len(parts) for i in outputs if i in last}
        self.places: dict[int, int] = {}
        free: list[int] = []
        for k, part in enumerate(parts):
            for i in (i for i in part if last[i] > k):
                self.places[i] = free.pop() if free else self.size
                self.size = max(self.size, self.places[i] + 1)
            free += [place for i, place in self.places.items() if last[i] == k]

    def stored(self, part: Sequence[int]) -> dict[int, str]:
        """Node -> C++ of its place, of those nodes of a part that are stored."""
        member = {"f": "number", "b": "flag"}
        return {
            i: f"m[{self.places[i]}].{member[self.nodes[i].kind]}" for i in part if i in self.places
        }


def function(name: str, parameters: str, lines: Sequence[str]) -> str:
    """A C++ function."""
    return "\n".join([f"SEPARATE void {name}({parameters}) {{", *lines, "}"])


def _type(node: Node) -> str:
    """The C++ type of a node."""
    if node.kind == "i":
        raise UnsupportedError(f"the operation {node.op!r} on integers that depend on the box")
    return {"f": "interval", "b": "truth"}[node.kind]


@CACHES.function(maxsize=64)
def library(source: str) -> ctypes.CDLL:
    """The kernel of a source, whose rounding is verified.

    Raises:
      ToolchainError: there is no compiler, it fails, or it does not honour the rounding mode.
    """
    path, _ = built(source, ENCLOSURE_FLAGS)
    found = loaded(path, "search_box", "enclose_boxes", "rounded_operations", "vector_size")
    check_rounding(found)
    return found


ROUNDED = (1.0, 3.0, 0.1, 0.2, 2.0**-60, 2.0, -0.7, -3.3, 1e300, 1e-200, 7.0)
"""Numbers whose sums, differences, products and quotients are verified."""


def check_rounding(kernel: ctypes.CDLL) -> None:
    """Compares the bounds that a kernel computes for single operations with exact arithmetic.

    Raises:
      ToolchainError: a bound is on the wrong side of the exact result, or the bounds are further
        apart than two neighbouring numbers.
    """
    width = kernel.vector_size()
    pairs = [(x, y) for x in ROUNDED for y in ROUNDED]
    pairs += [pairs[-1]] * (-len(pairs) % width)
    for first in range(0, len(pairs), width):
        x, y = (np.array(column) for column in zip(*pairs[first : first + width], strict=True))
        lower = np.empty((7, width))
        upper = np.empty((7, width))
        failed = kernel.rounded_operations(*map(pointer, (x, y, lower, upper)))
        for k in range(width):
            found = list(zip(lower[:, k].tolist(), upper[:, k].tolist(), strict=True))
            if failed or not _are_rounded(x[k].item(), y[k].item(), found):
                raise ToolchainError(
                    "the compiler does not honour the rounding mode, which enclosures need:"
                    " install GCC 10 or later, or set $CXX to it"
                )


def _are_rounded(x: float, y: float, found: list[tuple[float, float]]) -> bool:
    """Whether bounds of x + y, x - y, x y and x / y are the nearest ones of the exact results, and
    those of sqrt(x), sin(x) and exp(x) are close to it.
    """
    from fractions import Fraction  # takes several milliseconds

    a, b = Fraction(x), Fraction(y)
    exact = (a + b, a - b, a * b, a / b)
    for value, (low, high) in zip(exact, found[:4], strict=True):
        is_nearest = low <= value <= high <= math.nextafter(low, math.inf)
        if high == math.inf:
            is_nearest = value > sys.float_info.max
        if not is_nearest:
            return False
    root, sine, exponential = found[4:]
    if abs(x) < 10 and not (_is_close(sine, math.sin(x)) and _is_close(exponential, math.exp(x))):
        return False
    if x < 0:
        return root[1] == math.inf
    return Fraction(root[0]) ** 2 <= a <= Fraction(root[1]) ** 2 and _is_close(root, math.sqrt(x))


def _is_close(bounds: tuple[float, float], value: float) -> bool:
    """Whether bounds contain a value of the C library, but for its error, and are close to it."""
    low, high = bounds
    margin = 1e-14 * max(1.0, abs(value))
    return value - margin <= low < high <= value + margin


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    """The address of an array's numbers."""
    return ctypes.c_void_p(array.ctypes.data)


def enclose(
    function: Callable, lower: np.ndarray, upper: np.ndarray, constants: Sequence[Any] = ()
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Bounds of a function on boxes, rounded outward.

    Args:
      function: function (x, constants) -> array or arrays, of one point, (d,), and of a list of
        constants.
      lower: lower corners of the boxes, (k, d).
      upper: upper corners, (k, d).
      constants: numbers and arrays of the function, which count as exact.

    Returns:
      Lower and upper bounds of the arrays that the function returns, each (k, *shape).

    Raises:
      ValueError: a lower bound is above the upper one, or a constant is not finite.
      UnsupportedError: an operation is not available on intervals.
      ToolchainError: no compiler, or one that does not honour the rounding mode.
    """
    kernel = interval_kernel(function, np.shape(lower)[1], constants)
    low, high = (np.ascontiguousarray(x, np.float64) for x in (lower, upper))
    if low.shape != high.shape or not (low <= high).all():
        raise ValueError("lower, upper: got a lower bound above the upper one, or two shapes.")
    size = sum(kernel.compiled.sizes)
    bounds = np.empty((2, len(low), size))
    failed = kernel.library.enclose_boxes(
        pointer(kernel.numbers),
        ctypes.c_int64(len(low)),
        *map(pointer, (low, high, bounds[0], bounds[1])),
    )
    if failed:
        raise ToolchainError("the processor refuses the rounding mode that enclosures need")
    ends = np.cumsum(kernel.compiled.sizes)[:-1]
    below, above = (
        [
            part.reshape(len(low), *shape)
            for part, shape in zip(np.split(x, ends, axis=1), kernel.compiled.shapes, strict=True)
        ]
        for x in bounds
    )
    return below, above


class IntervalKernel(NamedTuple):
    """A kernel with its constants."""

    library: ctypes.CDLL
    numbers: np.ndarray
    """Constants and literals, one after the other."""
    compiled: Compiled


def interval_kernel(function: Callable, dimension: int, constants: Sequence[Any]) -> IntervalKernel:
    """The kernel of a function.

    Args:
      function: see `compiled`.
      dimension: number of coordinates.
      constants: numbers and arrays, which must be finite.

    Raises:
      ValueError: a constant that is not finite.
      UnsupportedError: an operation is not available on intervals.
      ToolchainError: no compiler, or one that does not honour the rounding mode.
    """
    arrays = [np.asarray(c, np.float64) for c in constants]
    for k, array in enumerate(arrays):
        if not np.isfinite(array).all():
            raise ValueError(f"constants[{k}]: got {array!r}, expected finite numbers.")
    found = compiled(function, dimension, tuple(a.shape for a in arrays))
    numbers = np.concatenate([*(a.ravel() for a in arrays), np.array(found.literals), [0.0]])
    return IntervalKernel(library(found.source), numbers, found)
