"""Scalar programs that NumPy runs, operation by operation: no compiler is needed."""

import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from iblf_jax.kernels import OPERATIONS, Program, scalar_program, written_out


def evaluate(program: Program, inputs: dict[str, Any], index: int) -> list[Any]:
    """The numbers of all nodes at a step; inputs: "shared", "per_run" and "carry"."""
    known: list[Any] = []
    types = {"f": program.dtype, "i": np.dtype(int), "b": np.dtype(bool)}
    with np.errstate(all="ignore"):
        for node in program.nodes:
            args = [known[a] for a in node.args]
            if node.op == "const":
                known.append(np.asarray(node.value, types[node.kind]))
            elif node.op == "index":
                known.append(np.asarray(index))
            elif node.op in inputs:
                known.append(inputs[node.op][node.value])
            elif node.op == "convert":
                known.append(np.asarray(args[0]).astype(types[node.kind]))
            elif node.op == "lookup":
                table = np.asarray(node.value, program.dtype)
                known.append(table[np.clip(args[0], 0, len(table) - 1)])
            elif (node.op, node.kind) == ("div", "i"):
                known.append(np.floor_divide(*args))
            else:
                known.append(OPERATIONS[node.op].numpy(*args))
    return known


def computed(function: Callable[..., Any], *args: Any, runs: bool = False) -> Any:
    """What a function of floating-point arrays returns: it costs its tracing, and no compiler.

    Args:
      function: function of one point; its arguments and its result are pytrees.
      args: its arguments.
      runs: whether every leaf of the arguments, and so of the result, has a leading axis of points.
    """
    leaves, structure = jax.tree.flatten(args)
    leaves = [np.asarray(x, float) for x in leaves]
    shapes = [x.shape[runs:] for x in leaves]
    places = np.cumsum([0, *(math.prod(shape) for shape in shapes)])
    structures = []

    def of_numbers(x: jax.Array, _: Any) -> list[jax.Array]:
        parts = [x[a:b].reshape(s) for a, b, s in zip(places, places[1:], shapes, strict=False)]
        results, found = jax.tree.flatten(function(*structure.unflatten(parts)))
        structures.append(found)
        return results

    program, sizes, shapes_of_results = scalar_program(of_numbers, int(places[-1]))
    program = written_out(program)
    points = len(leaves[0]) if runs else 1
    carry = np.concatenate([x.reshape(points, -1) for x in leaves], axis=1).T
    known = evaluate(program, {"carry": list(carry), "shared": []}, 0)
    rows = np.array([np.broadcast_to(known[i], points) for i in program.outputs]).T
    ends = np.cumsum([0, *sizes])
    results = [
        rows[:, a:b].reshape((points, *shape)) if runs else rows[0, a:b].reshape(shape)
        for a, b, shape in zip(ends, ends[1:], shapes_of_results, strict=False)
    ]
    return structures[-1].unflatten(results)
