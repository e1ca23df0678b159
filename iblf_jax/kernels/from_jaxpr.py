"""Interprets a jaxpr number by number: every array becomes a NumPy array of node numbers.

Primitives that only rearrange numbers (reshape, slice, gather) are applied to the node numbers at
once, and primitives that compute add one node per number. Nested functions are inlined, and short
scans are unrolled. A primitive without a rule is computed where its operands are constants, and
raises `UnsupportedError` elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.kernels import jaxprs
from iblf_jax.kernels.functions import apply
from iblf_jax.kernels.program import Builder, Ids, UnsupportedError, constants
from iblf_jax.kernels.rules import RULES

if TYPE_CHECKING:
    from jax.extend import core


MAX_REINTERPRETED = 50
"""Equations up to which an inner function is interpreted at each call: a cache would not be
faster."""


def interpret(b: Builder, jaxpr: Any, consts: Sequence[Ids], inputs: Sequence[Ids]) -> list[Ids]:
    """The outputs of a jaxpr, given its constants and inputs as node numbers."""
    known: dict[Any, Ids] = dict(
        zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *inputs], strict=True)
    )

    def read(atom):
        if not jaxprs.is_variable(atom):
            return constants(b, atom.val)
        return known[atom]

    live = jaxprs.needed(jaxpr)
    for eqn in jaxpr.eqns:
        used = tuple([v in live for v in eqn.outvars])
        if not any(used):
            continue
        name = eqn.primitive.name
        function = jaxprs.called(eqn)
        operands = [read(v) for v in eqn.invars]
        results: Sequence[Ids | None]
        if name == "jit" and len(function.eqns) > MAX_REINTERPRETED:
            results = apply(b, function, operands, used, closed)
        elif function is not None:
            results = closed(b, function, operands)
        elif name in CONTROL:
            results = CONTROL[name](b, eqn, operands, used)
        elif name in RULES:
            for v in eqn.outvars:
                _check_float(b, v.aval.dtype, eqn)
            found = RULES[name](b, eqn, *operands)
            results = found if isinstance(found, list | tuple) else [found]
        else:
            results = folded(b, eqn, operands)
        for v, ids in zip(eqn.outvars, results, strict=True):
            if ids is None:
                continue
            if ids.shape != v.aval.shape:
                raise UnsupportedError(
                    f"the rule for {name!r} gave shape {ids.shape}, not {v.aval.shape}"
                )
            known[v] = ids
    return [read(v) for v in jaxpr.outvars]


def folded(b: Builder, eqn, operands: Sequence[Ids]) -> list[Ids]:
    """The results of a primitive without a rule whose operands are constants, as JAX computes them:
    such as the inverse of a matrix of numbers.
    """
    known = [[b.value(int(i)) for i in x.ravel()] for x in operands]
    if b.exact or eqn.effects or any(value is None for row in known for value in row):
        raise UnsupportedError(f"the primitive {eqn.primitive.name!r} is not lowered")
    arrays = [
        np.array(row, v.aval.dtype).reshape(v.aval.shape)
        for row, v in zip(known, eqn.invars, strict=True)
    ]
    with jax.ensure_compile_time_eval():
        results = eqn.primitive.bind(*map(jnp.asarray, arrays), **eqn.params)
    if not eqn.primitive.multiple_results:
        results = [results]
    return [constants(b, result) for result in results]


def _check_float(b: Builder, dtype, eqn) -> None:
    """Refuses floats of another type than the program's, except constants, which are rounded."""
    if dtype != b.dtype and np.issubdtype(dtype, np.floating) and eqn.invars:
        raise UnsupportedError(f"it mixes {dtype} with {b.dtype} ({eqn.primitive.name})")


def closed(b: Builder, function: core.ClosedJaxpr, operands: Sequence[Ids]) -> list[Ids]:
    """The outputs of a function, given its operands as node numbers."""
    jaxpr, values = jaxprs.opened(function)
    return interpret(b, jaxpr, [constants(b, value) for value in values], operands)


def _scan(b: Builder, eqn, operands, used):
    params = eqn.params
    length = params["length"]
    n_const, n_carry = jaxprs.scan_sizes(params)
    if length > b.limits.scan:
        raise UnsupportedError(
            f"an inner loop of {length} steps is too long to unroll (at most {b.limits.scan})"
        )
    const = operands[:n_const]
    carry = operands[n_const : n_const + n_carry]
    xs = operands[n_const + n_carry :]
    stacked: list[list[Ids]] = []
    indices = list(range(length))
    if params["reverse"]:
        indices.reverse()
    for i in indices:
        out = closed(b, params["jaxpr"], [*const, *carry, *(x[i] for x in xs)])
        carry = out[:n_carry]
        stacked.append(out[n_carry:])
    if params["reverse"]:
        stacked.reverse()
    ys = [np.stack(column) for column in zip(*stacked, strict=True)]
    if not stacked:
        ys = [np.zeros(v.aval.shape, np.int64) for v in eqn.outvars[n_carry:]]
    return [*carry, *ys]


def _cond(b: Builder, eqn, operands, used):
    index, *rest = operands
    branches = eqn.params["branches"]
    which = int(index)
    value = b.value(which)
    if value is not None:
        return closed(b, branches[min(max(int(value), 0), len(branches) - 1)], rest)
    is_truth = b.nodes[which].kind == "b"
    if b.is_shared(which):
        # All runs take the same branch: the last one is computed only in steps that take it.
        taken = which
        if not is_truth:
            taken = b.emit("ge", which, b.constant(len(branches) - 1, "i"), kind="b")
        results = apply(b, branches[-1], rest, used, closed, taken)
    else:
        results = list(closed(b, branches[-1], rest))
    for i in reversed(range(len(branches) - 1)):
        if is_truth:
            condition = b.emit("not", which, kind="b")
        else:
            condition = b.emit("le", which, b.constant(i, "i"), kind="b")
        others = closed(b, branches[i], rest)
        results = [choose(b, condition, yes, no) for yes, no in zip(others, results, strict=True)]
    return results


def _while(b: Builder, eqn, operands, used):
    raise UnsupportedError("a while loop inside a step has no fixed length")


def choose(b: Builder, condition: int, yes: Ids, no: Ids | None) -> Ids | None:
    """`yes` where a scalar condition holds, else `no`, entry by entry; None if `no` is not used."""
    if no is None:
        return None
    flat = [
        b.emit("select", condition, int(x), int(y), kind=b.nodes[int(x)].kind)
        for x, y in zip(yes.ravel(), no.ravel(), strict=True)
    ]
    return np.asarray(flat, np.int64).reshape(yes.shape)


CONTROL = {"scan": _scan, "cond": _cond, "while": _while}
