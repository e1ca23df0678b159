"""Evaluates the nodes of a scalar program on arrays, in operations of XLA.

On CPU it says to XLA where to stop fusing: what is used several times is computed once, and a long
  program is cut into parts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata

from iblf_jax.core import devices
from iblf_jax.engine import plan, vector_math
from iblf_jax.kernels import OPERATIONS, Node, Program, needed


class Entry(NamedTuple):
    """One number of a row of the table, not yet read: what uses it reads it, rather than each
    number being copied out.
    """

    part: str
    place: int

    def read(self, row: Table) -> jax.Array:
        """The number, ()."""
        return lax.squeeze(
            lax.slice(getattr(row, self.part), (self.place,), (self.place + 1,)), (0,)
        )


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
        self.sines = frozenset(vector_math.XLA_OWN) if self.bordered else frozenset()
        self.types = {"f": program.dtype, "i": np.dtype(np.int32), "b": np.dtype(np.bool_)}

    def compute(
        self, known: dict[int, Any], outputs: Iterable[int], row: Table | None = None
    ) -> None:
        """Adds `outputs`, and what they need, to `known` (node -> array, or entry of `row`)."""
        nodes = self.program.nodes
        missing = needed(nodes, outputs, known)
        known |= {
            i: np.asarray(nodes[i].value, self.types[nodes[i].kind])
            for i in missing
            if nodes[i].op == "const"
        }
        order = [i for i in missing if nodes[i].op != "const"]
        stored = self._stored(order, outputs)
        size = plan.XLA_SEGMENT if self.bordered else max(len(order), 1)
        for start in range(0, len(order), size):
            self._segment(known, order[start : start + size], order[start + size :], stored, row)

    def _stored(self, order: list[int], outputs: Iterable[int]) -> set[int]:
        """The nodes of `order` to be stored: the outputs, and what costs more to compute again
        than to read.
        """
        nodes, cost, stored = self.program.nodes, dict.fromkeys(order, 0), set(outputs)
        uses = Counter([a for i in order for a in nodes[i].args] + list(stored))
        for i in order:
            here = (1 if OPERATIONS[nodes[i].op].cheap else plan.XLA_DEAR) + sum(
                cost.get(a, 0) for a in nodes[i].args if a not in stored
            )
            cost[i] = here
            if uses[i] > 1 and here >= plan.XLA_STORED:
                stored.add(i)
        return stored

    def _segment(
        self,
        known: dict[int, Any],
        order: list[int],
        later: list[int],
        stored: set[int],
        row: Table | None,
    ) -> None:
        """Adds the nodes of `order` to `known`.

        On CPU in a function of its own: XLA computes each of its results once, and nothing across
        its border.  The barrier keeps results that nobody reads, which are there to be stored only.
        """
        nodes, here = self.program.nodes, set(order)
        read_later = {a for i in later for a in nodes[i].args}
        outputs = [i for i in order if i in read_later or i in stored]
        inputs = sorted({a for i in order for a in nodes[i].args} - here)
        tables: dict[tuple, list[int]] = {}
        for i in order:
            if nodes[i].op == "lookup":
                tables.setdefault((nodes[i].args, len(nodes[i].value)), []).append(i)
        rounds = self._rounds(order)
        entries = {i: known[i] for i in inputs if isinstance(known[i], Entry)}
        arrays = {i: known[i] for i in inputs if i not in entries}

        def body(row, arrays):
            local = arrays | {i: x.read(row) for i, x in entries.items()}
            for others, sines in rounds:
                for i in others:
                    if nodes[i].op != "lookup":
                        local[i] = self._value(nodes[i], [local[a] for a in nodes[i].args])
                    elif i not in local:
                        together = tables[nodes[i].args, len(nodes[i].value)]
                        local |= zip(
                            together,
                            self._looked_up(together, local[nodes[i].args[0]]),
                            strict=True,
                        )
                if sines:
                    angles = [jnp.broadcast_to(local[nodes[i].args[0]], self.shape) for i in sines]
                    local |= zip(
                        sines, vector_math.sines([nodes[i].op for i in sines], angles), strict=True
                    )
            return [local[i] for i in outputs]

        results = (
            lax.optimization_barrier(as_function(body)(row, arrays))
            if self.bordered
            else body(row, arrays)
        )
        known |= zip(outputs, results, strict=True)

    def _rounds(self, order: list[int]) -> list[tuple[list[int], list[int]]]:
        """`order` as rounds: nodes, then the sines and cosines that these and earlier rounds allow,
        which are computed together.
        """
        nodes, done = self.program.nodes, dict[int, int]()
        rounds: list[tuple[list[int], list[int]]] = [([], [])]
        for i in order:
            first = max((done.get(a, 0) for a in nodes[i].args), default=0)
            is_sine = nodes[i].op in self.sines
            rounds[first][is_sine].append(i)
            done[i] = first + is_sine
            if done[i] == len(rounds):
                rounds.append(([], []))
        return rounds

    def _value(self, node: Node, args: list[Any]) -> Any:
        args = [jnp.broadcast_to(x, self.shape) for x in args]
        if node.op == "convert":
            return lax.convert_element_type(args[0], self.types[node.kind])
        function = OPERATIONS[node.op].lax
        assert function is not None, node.op
        return function(*args)

    def _looked_up(self, lookups: list[int], index: Any) -> jax.Array:
        """The values of lookups by one index, in one gather: XLA makes a loop of each.

        The barriers keep it from computing index and rows again for every use.
        """
        tables = jnp.asarray([self.program.nodes[i].value for i in lookups], self.program.dtype)
        columns = lax.GatherDimensionNumbers(
            offset_dims=(0,), collapsed_slice_dims=(1,), start_index_map=(1,)
        )
        index = lax.optimization_barrier(jnp.broadcast_to(index, self.shape))
        places = lax.expand_dims(index, (len(self.shape),))
        return lax.optimization_barrier(
            lax.gather(tables, places, columns, (len(lookups), 1), mode=lax.GatherScatterMode.CLIP)
        )


def on_cpu() -> bool:
    """Whether arrays live on CPU."""
    return devices.platform() == "cpu"


def as_function(f):
    """`f` as a function that XLA does not inline: fusion stops at its border."""
    return set_xla_metadata(inlineable="false")(jax.jit(f))
