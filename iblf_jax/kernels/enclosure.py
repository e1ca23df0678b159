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
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.kernels.caches import CACHES
from iblf_jax.kernels.emit_c import header
from iblf_jax.kernels.from_jaxpr import closed
from iblf_jax.kernels.program import (
    SHARED,
    Builder,
    Node,
    Program,
    UnsupportedError,
    finished,
    needed,
)
from iblf_jax.kernels.toolchain import ToolchainError, built, loaded

FLAGS = ("-O2", "-frounding-math", "-ffp-contract=off")
"""Flags of the compiler, after those of all kernels."""
FUNCTIONS = frozenset(
    "add sub neg abs max min div sqrt rsqrt sign sin cos tan exp expm1 log log1p atan sinh cosh tanh"
    " logistic upper lower hull meet".split()
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
def compiled(
    function: Callable, dimension: int, shapes: tuple[tuple[int, ...], ...]
) -> Compiled:
    """The program of a function on intervals, and its C++ source.

    Args:
      function: function (x, constants) -> arrays, of one point, (dimension,), and of a list of
        constants. The function object is the key of a cache.
      dimension: number of coordinates.
      shapes: shapes of the constants.

    Raises:
      UnsupportedError: an operation is not available on intervals.
    """
    structs = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in shapes]
    with jax.enable_x64(True):
        jaxpr, out = jax.make_jaxpr(lambda x, c: jax.tree.leaves(function(x, c)), return_shape=True)(
            jax.ShapeDtypeStruct((dimension,), jnp.float64), structs
        )
    b = Builder(np.float64, sparse=True, exact=True)
    x = np.asarray([b.input("carry", i, "f") for i in range(dimension)], np.int64)
    operands = [x]
    first = 0
    for shape in shapes:
        size = math.prod(shape)
        ids = [b.input("shared", first + i, "f") for i in range(size)]
        operands.append(np.asarray(ids, np.int64).reshape(shape))
        first += size
    results = closed(b, jaxpr, operands)
    outputs = [int(i) for ids in results for i in ids.ravel()]
    program = finished(b, [], [], outputs)
    for output in program.outputs:
        if program.nodes[output].kind != "f":
            raise UnsupportedError("an output that is no floating-point number")
    literals = tuple(dict.fromkeys(_literals(program)))
    return Compiled(
        program,
        tuple(ids.size for ids in results),
        tuple(x.shape for x in out),
        literals,
        _source(program, dimension, first, literals, results[0].size),
    )


def _literals(program: Program) -> list[float]:
    """The floating-point constants of a program."""
    return [node.value for node in program.nodes if node.op == "const" and node.kind == "f"]


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
        classes = program.classes()
        read = {a for i, node in enumerate(self.nodes) if classes[i] != SHARED for a in node.args}
        self.table = sorted(
            i for i in {*read, *self.outputs} if classes[i] == SHARED
        )
        """Nodes that depend on constants only and that the rest of the program reads."""

    def shared_numbers(self) -> list[str]:
        """The statements that fill the table."""
        names: dict[int, str] = {}
        lines = []
        for i in needed(self.nodes, self.table):
            node = self.nodes[i]
            if node.op == "shared":
                lines.append(f"  interval v{i} = at(all_lanes(shared[{node.value}]));")
                names[i] = f"v{i}"
            elif node.op == "const" and node.kind == "f":
                place = self.place[node.value.hex()]
                lines.append(f"  interval v{i} = at(all_lanes(shared[{place}]));")
                names[i] = f"v{i}"
        lines += self.statements(names, self.table)
        return lines + [f"  put(table + {k}, {names[i]});" for k, i in enumerate(self.table)]

    def evaluation(self) -> list[str]:
        """The statements that evaluate the outputs."""
        names = {i: f"v{i}" for i in self.table}
        lines = [
            f"  {_type(self.nodes[i])} v{i} = get_{_type(self.nodes[i])}(table + {k});"
            for k, i in enumerate(self.table)
        ]
        names |= {i: f"x[{n.value}]" for i, n in enumerate(self.nodes) if n.op == "carry"}
        lines += self.statements(names, self.outputs)
        return lines + [f"  out[{k}] = {names[i]};" for k, i in enumerate(self.outputs)]

    def statements(self, names: dict[int, str], outputs: Sequence[int]) -> list[str]:
        """The statements of the outputs and of what they depend on; new names are added."""
        lines = []
        waiting = needed(self.nodes, outputs, names)
        for i in waiting:
            node = self.nodes[i]
            if i in names:
                continue
            if node.op not in ("sin", "cos"):
                lines.append(f"  {_type(node)} v{i} = {self.expression(i, names)};")
                names[i] = f"v{i}"
                continue
            angle = node.args[0]
            lines.append(f"  sine_and_cosine a{angle} = i_sincos({names[angle]});")
            for j in waiting:
                if self.nodes[j].op in ("sin", "cos") and self.nodes[j].args == node.args:
                    names[j] = f"a{angle}.{self.nodes[j].op}"
        return lines

    def expression(self, i: int, names: dict[int, str]) -> str:
        """The C++ of a node's operation."""
        node = self.nodes[i]
        nodes = [self.nodes[a] for a in node.args]
        args = [names[a] for a in node.args]
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
            return self._product(node.args, args)
        if node.op == "pow" and nodes[1].op == "const":
            return self._power(args, nodes[1].value)
        if node.op == "with_sign":
            return args[0]
        if node.op in COMPARISONS and not of_truths:
            return f"t_{node.op}({listed})"
        if node.op in FUNCTIONS and node.kind == "f":
            return f"i_{node.op}({listed})"
        raise UnsupportedError(f"the operation {node.op!r} is not available on intervals")

    def _product(self, factors: Sequence[int], args: Sequence[str]) -> str:
        """A product: a square, one with a literal, or any other."""
        if factors[0] == factors[1]:
            return f"i_square({args[0]})"
        for k in (0, 1):
            factor = self.nodes[factors[k]]
            if factor.op == "const" and factor.value > 0:
                return f"i_scaled({args[1 - k]}, {args[k]}.u)"
            if factor.op == "const" and factor.value < 0:
                return f"i_scaled(i_neg({args[1 - k]}), {args[k]}.n)"
        return f"i_mul({', '.join(args)})"

    def _power(self, args: Sequence[str], exponent: float) -> str:
        """A power with a constant exponent."""
        if exponent.is_integer() and 0 < exponent <= LARGEST_POWER:
            return f"i_power({args[0]}, {int(exponent)})"
        return f"i_pow({', '.join(args)})"


def _type(node: Node) -> str:
    """The C++ type of a node."""
    if node.kind == "i":
        raise UnsupportedError(f"the operation {node.op!r} on integers that depend on the box")
    return {"f": "interval", "b": "truth"}[node.kind]


def _source(
    program: Program,
    dimension: int,
    constants: int,
    literals: tuple[float, ...],
    alternatives: int,
) -> str:
    """The C++ source of a program on intervals."""
    emitter = _Emitter(program, constants, literals)
    sizes = {
        "DOUBLE": 1,
        "COORDINATES": dimension,
        "OUTPUTS": len(program.outputs),
        "ALTERNATIVES": alternatives,
        "TABLE_SIZE": max(1, len(emitter.table)),
    }
    parts = [
        *(f"#define {name} {value}" for name, value in sizes.items()),
        header("vector.h"),
        header("interval.h"),
        "SEPARATE void shared_numbers(const real *shared, interval *table) {",
        *emitter.shared_numbers(),
        "}",
        "INLINE void evaluate(const interval *table, const interval *x, interval *out) {",
        *emitter.evaluation(),
        "}",
        header("boxes.h"),
    ]
    return "\n".join(parts)


@CACHES.function(maxsize=64)
def library(source: str) -> ctypes.CDLL:
    """The kernel of a source, whose rounding is verified.

    Raises:
      ToolchainError: there is no compiler, it fails, or it does not honour the rounding mode.
    """
    path, _ = built(source, FLAGS)
    found = loaded(path, "search_box", "enclose_boxes", "rounded_operations", "lanes")
    check_rounding(found)
    return found


ROUNDED = (1.0, 3.0, 0.1, 0.2, 2.0**-60, 2.0, -0.7, -3.3, 1e-310, 1e300, 1e-200, 7.0)
"""Numbers whose sums, differences, products and quotients are verified."""


def check_rounding(kernel: ctypes.CDLL) -> None:
    """Compares the bounds that a kernel computes for single operations with exact arithmetic.

    Raises:
      ToolchainError: a bound is on the wrong side of the exact result, or the bounds are further
        apart than two neighbouring numbers.
    """
    lanes = kernel.lanes()
    pairs = [(x, y) for x in ROUNDED for y in ROUNDED]
    pairs += [pairs[-1]] * (-len(pairs) % lanes)
    for first in range(0, len(pairs), lanes):
        x, y = (np.array(column) for column in zip(*pairs[first : first + lanes], strict=True))
        lower = np.empty((5, lanes))
        upper = np.empty((5, lanes))
        failed = kernel.rounded_operations(*map(pointer, (x, y, lower, upper)))
        for lane in range(lanes):
            found = list(zip(lower[:, lane].tolist(), upper[:, lane].tolist(), strict=True))
            if failed or not _are_rounded(x[lane].item(), y[lane].item(), found):
                raise ToolchainError(
                    "the compiler does not honour the rounding mode, which enclosures need:"
                    " install GCC 10 or later, or set $CXX to it"
                )


def _are_rounded(x: float, y: float, found: list[tuple[float, float]]) -> bool:
    """Whether bounds of x + y, x - y, x y, x / y and sqrt(x) are the nearest ones of the exact
    results.
    """
    a, b = Fraction(x), Fraction(y)
    exact = (a + b, a - b, a * b, a / b)
    for value, (low, high) in zip(exact, found[:-1], strict=True):
        if not _encloses(low, high, value):
            return False
    low, high = found[-1]
    if x < 0:
        return high == math.inf
    return Fraction(low) ** 2 <= a <= Fraction(high) ** 2 and high - low <= 5e-16 * high


def _encloses(low: float, high: float, value: Fraction) -> bool:
    """Whether the bounds are the nearest floating-point numbers on both sides of a number."""
    if high == math.inf:
        return value > Fraction(sys.float_info.max)
    return low <= value <= high and high <= math.nextafter(low, math.inf)


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    """The address of an array's numbers."""
    return ctypes.c_void_p(array.ctypes.data)


def enclose(
    function: Callable, lower: Any, upper: Any, constants: Sequence[Any] = ()
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
      UnsupportedError: an operation is not available on intervals.
      ToolchainError: no compiler, or one that does not honour the rounding mode.
    """
    kernel = kernel_of(function, np.shape(lower)[1], constants)
    low, high = (np.ascontiguousarray(x, np.float64) for x in (lower, upper))
    size = sum(kernel.compiled.sizes)
    bounds = np.empty((2, len(low), size))
    kernel.library.enclose_boxes(
        pointer(kernel.numbers),
        ctypes.c_int64(len(low)),
        *map(pointer, (low, high, bounds[0], bounds[1])),
    )
    ends = np.cumsum(kernel.compiled.sizes)[:-1]
    below, above = (
        [
            part.reshape(len(low), *shape)
            for part, shape in zip(np.split(x, ends, axis=1), kernel.compiled.shapes, strict=True)
        ]
        for x in bounds
    )
    return below, above


class Kernel(NamedTuple):
    """A kernel with its constants."""

    library: ctypes.CDLL
    numbers: np.ndarray
    """Constants and literals, one after the other."""
    compiled: Compiled


def kernel_of(
    function: Callable, dimension: int, constants: Sequence[Any]
) -> Kernel:
    """The kernel of a function.

    Args:
      function: see `compiled`.
      dimension: number of coordinates.
      constants: numbers and arrays.
    """
    arrays = [np.asarray(c, np.float64) for c in constants]
    found = compiled(function, dimension, tuple(a.shape for a in arrays))
    numbers = np.concatenate([*(a.ravel() for a in arrays), np.array(found.literals), [0.0]])
    return Kernel(library(found.source), numbers, found)
