"""Evaluates the nodes of a scalar program on arrays, in operations of XLA.

On CPU it says to XLA where to stop fusing: what is used several times is computed once, and a long program is cut into parts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata

from iblf_jax.engine import plan, vector_math
from iblf_jax.lowering.program import Node, Program

STORED = 8
"""Cost from which a number with several uses is stored on CPU.  XLA would compute it again for each use."""

FUNCTIONS: dict[str, Callable] = {
    "add": lax.add, "sub": lax.sub, "mul": lax.mul, "div": lax.div, "rem": lax.rem, "neg": lax.neg, "abs": lax.abs, "max": lax.max,
    "min": lax.min, "sqrt": lax.sqrt, "rsqrt": lax.rsqrt, "cbrt": lax.cbrt, "sign": lax.sign, "floor": lax.floor, "ceil": lax.ceil,
    "round_even": lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN), "sin": lax.sin, "cos": lax.cos, "tan": lax.tan,
    "asin": lax.asin, "acos": lax.acos, "atan": lax.atan, "sinh": lax.sinh, "cosh": lax.cosh, "tanh": lax.tanh, "asinh": lax.asinh,
    "acosh": lax.acosh, "atanh": lax.atanh, "exp": lax.exp, "exp2": lax.exp2, "expm1": lax.expm1, "log": lax.log, "log1p": lax.log1p,
    "pow": lax.pow, "atan2": lax.atan2, "erf": lax.erf, "erfc": lax.erfc, "logistic": lax.logistic, "is_finite": lax.is_finite,
    "eq": lax.eq, "ne": lax.ne, "lt": lax.lt, "le": lax.le, "gt": lax.gt, "ge": lax.ge, "and": lax.bitwise_and, "or": lax.bitwise_or,
    "xor": lax.bitwise_xor, "not": lax.bitwise_not, "select": lax.select,
}  # fmt: skip
"""No function of jnp: those are jitted, and within a function that XLA may not inline each would be a call."""
POLYNOMIALS = {"sin": vector_math.sin, "cos": vector_math.cos}
"""In place of functions that XLA's CPU backend does not vectorise."""
CHEAP = frozenset(
    ("add", "sub", "mul", "neg", "abs", "max", "min", "select", "convert", "and", "or", "xor", "not", "lt", "le", "gt", "ge", "eq", "ne")
)
"""Operations of one instruction; others count as eight."""


class Entry(NamedTuple):
    """One number of a row of the table, not yet read: what uses it reads it, rather than each number being copied out."""

    part: str
    place: int

    def read(self, row: Table) -> jax.Array:
        """The number, ()."""
        return lax.squeeze(lax.slice(getattr(row, self.part), (self.place,), (self.place + 1,)), (0,))


class Table(NamedTuple):
    """What time decides, one row a step: floats, and whole numbers or flags as int32."""

    floats: jax.Array
    ints: jax.Array


class Evaluator:
    """Evaluates nodes of a program on arrays of one shape."""

    def __init__(self, program: Program, shape: tuple[int, ...]) -> None:
        self.program = program
        self.shape = shape
        self.bordered = on_cpu() and bool(shape)
        self.functions = FUNCTIONS | (POLYNOMIALS if self.bordered else {})
        self.types = {"f": program.dtype, "i": np.dtype(np.int32), "b": np.dtype(np.bool_)}

    def compute(self, known: dict[int, Any], wanted: Iterable[int], row: Table | None = None) -> None:
        """Adds `wanted`, and what it needs, to `known` (node -> array, or entry of `row`)."""
        nodes, needed, stack = self.program.nodes, set(), list(wanted)
        while stack:
            i = stack.pop()
            if i not in known and i not in needed:
                needed.add(i)
                stack.extend(nodes[i].args)
        known |= {i: np.asarray(nodes[i].value, self.types[nodes[i].kind]) for i in needed if nodes[i].op == "const"}
        order = sorted(i for i in needed if nodes[i].op != "const")
        stored = self._stored(order, wanted)
        size = plan.XLA_SEGMENT if self.bordered else max(len(order), 1)
        for start in range(0, len(order), size):
            self._segment(known, order[start : start + size], order[start + size :], stored, row)

    def _stored(self, order: list[int], wanted: Iterable[int]) -> set[int]:
        """The nodes of `order` to be stored: what is wanted, and what costs more to compute again than to read."""
        nodes, cost, stored = self.program.nodes, dict.fromkeys(order, 0), set(wanted)
        uses = Counter([a for i in order for a in nodes[i].args] + list(stored))
        for i in order:
            here = (1 if nodes[i].op in CHEAP else 8) + sum(cost.get(a, 0) for a in nodes[i].args if a not in stored)
            cost[i] = here
            if uses[i] > 1 and here >= STORED:
                stored.add(i)
        return stored

    def _segment(self, known: dict[int, Any], order: list[int], later: list[int], stored: set[int], row: Table | None) -> None:
        """Adds the nodes of `order` to `known`.

        On CPU in a function of its own: XLA computes each of its results once, and nothing across its border.  The barrier keeps
        results that nobody reads, which are there to be stored only.
        """
        nodes, here = self.program.nodes, set(order)
        read_later = {a for i in later for a in nodes[i].args}
        outputs = [i for i in order if i in read_later or i in stored]
        inputs = sorted({a for i in order for a in nodes[i].args} - here)
        tables: dict[tuple, list[int]] = {}
        for i in order:
            if nodes[i].op == "lookup":
                tables.setdefault((nodes[i].args, len(nodes[i].value)), []).append(i)
        entries = {i: known[i] for i in inputs if isinstance(known[i], Entry)}
        arrays = {i: known[i] for i in inputs if i not in entries}

        def body(row, arrays):
            local = arrays | {i: x.read(row) for i, x in entries.items()}
            for i in order:
                if nodes[i].op != "lookup":
                    local[i] = self._value(nodes[i], [local[a] for a in nodes[i].args])
                elif i not in local:
                    together = tables[nodes[i].args, len(nodes[i].value)]
                    local |= zip(together, self._looked_up(together, local[nodes[i].args[0]]), strict=True)
            return [local[i] for i in outputs]

        results = lax.optimization_barrier(as_function(body)(row, arrays)) if self.bordered else body(row, arrays)
        known |= zip(outputs, results, strict=True)

    def _value(self, node: Node, args: list[Any]) -> Any:
        args = [jnp.broadcast_to(x, self.shape) for x in args]
        if node.op == "convert":
            return lax.convert_element_type(args[0], self.types[node.kind])
        return self.functions[node.op](*args)

    def _looked_up(self, lookups: list[int], index: Any) -> jax.Array:
        """The values of lookups by one index, in one gather: XLA makes a loop of each.

        The barriers keep it from computing index and rows again for every use.
        """
        tables = jnp.asarray([self.program.nodes[i].value for i in lookups], self.program.dtype)
        columns = lax.GatherDimensionNumbers(offset_dims=(0,), collapsed_slice_dims=(1,), start_index_map=(1,))
        index = lax.optimization_barrier(jnp.broadcast_to(index, self.shape))
        places = lax.expand_dims(index, (len(self.shape),))
        return lax.optimization_barrier(lax.gather(tables, places, columns, (len(lookups), 1), mode=lax.GatherScatterMode.CLIP))


def on_cpu() -> bool:
    """Whether arrays live on CPU."""
    return jax.default_backend() == "cpu"


def as_function(f):
    """`f` as a function that XLA does not inline: fusion stops at its border."""
    return set_xla_metadata(inlineable="false")(jax.jit(f))
