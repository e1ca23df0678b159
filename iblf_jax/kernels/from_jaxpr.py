"""Interprets a jaxpr number by number: every array becomes a NumPy array of node numbers.

Primitives that only rearrange numbers (reshape, slice, gather) are applied to the node numbers at
once, and primitives that compute add one node per number. Nested functions are inlined, and short
scans are unrolled. A primitive without a rule raises `UnsupportedError`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend import core

from iblf_jax.kernels.functions import apply
from iblf_jax.kernels.program import Builder, Ids, UnsupportedError, constants
from iblf_jax.kernels.rules import RULES

INLINED = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vjp_call_jaxpr": "fun_jaxpr",
    "checkpoint": "jaxpr",
    "remat": "jaxpr",
    "remat2": "jaxpr",
}
"""Primitive that calls an inner function -> the parameter that holds it."""
MAX_REINTERPRETED = 50
"""Equations up to which an inner function is interpreted at each call: a cache would not be
faster."""


def interpret(b: Builder, jaxpr: Any, consts: Sequence[Ids], inputs: Sequence[Ids]) -> list[Ids]:
    """The outputs of a jaxpr, given its constants and inputs as node numbers."""
    known: dict[Any, Ids] = dict(
        zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *inputs], strict=True)
    )

    def read(atom):
        if isinstance(atom, core.Literal):
            return constants(b, atom.val)
        return known[atom]

    live = _live(jaxpr)
    uses = {id(eqn): tuple(v in live for v in eqn.outvars) for eqn in jaxpr.eqns}
    calls: dict[int, list] = {}
    for eqn in jaxpr.eqns:
        if eqn.primitive.name == "jit":
            calls.setdefault(id(eqn.params["jaxpr"]), []).append(uses[id(eqn)])

    for eqn in jaxpr.eqns:
        if not any(uses[id(eqn)]):
            continue
        name = eqn.primitive.name
        operands = [read(v) for v in eqn.invars]
        results: Sequence[Ids | None]
        if name == "jit" and len(eqn.params["jaxpr"].eqns) > MAX_REINTERPRETED:
            results = apply(
                b,
                eqn.params["jaxpr"],
                operands,
                uses[id(eqn)],
                calls[id(eqn.params["jaxpr"])],
                closed,
            )
        elif name in INLINED:
            results = closed(b, eqn.params[INLINED[name]], operands)
        elif name in CONTROL:
            results = CONTROL[name](b, eqn, operands, uses[id(eqn)])
        elif name in RULES:
            for v in eqn.outvars:
                _check_float(b, v.aval.dtype, eqn)
            results = _several(RULES[name](b, eqn, *operands))
        else:
            raise UnsupportedError(f"the primitive {name!r} is not lowered")
        for v, ids in zip(eqn.outvars, results, strict=True):
            if ids is None:
                continue
            if ids.shape != v.aval.shape:
                raise UnsupportedError(
                    f"the rule for {name!r} gave shape {ids.shape}, not {v.aval.shape}"
                )
            known[v] = ids
    return [read(v) for v in jaxpr.outvars]


def _several(found: Any) -> list[Ids | None]:
    """The results of a rule, of which a single one is an array or a NumPy scalar."""
    if isinstance(found, list | tuple):
        return list(found)
    return [found]


def _live(jaxpr: Any) -> set:
    """The variables that the outputs depend on."""
    live = {v for v in jaxpr.outvars if isinstance(v, core.Var)}
    for eqn in reversed(jaxpr.eqns):
        if any(v in live for v in eqn.outvars):
            live.update(v for v in eqn.invars if isinstance(v, core.Var))
    return live


def _check_float(b: Builder, dtype, eqn) -> None:
    """Refuses floats of another type than the program's, except constants, which are rounded."""
    if np.issubdtype(dtype, np.floating) and dtype != b.dtype and eqn.invars:
        raise UnsupportedError(f"it mixes {dtype} with {b.dtype} ({eqn.primitive.name})")


def closed(b: Builder, function: Any, operands: Sequence[Ids]) -> list[Ids]:
    """The outputs of an inner jaxpr, closed or not."""
    inner = getattr(function, "jaxpr", function)
    consts = [constants(b, c) for c in getattr(function, "consts", ())]
    return interpret(b, inner, consts, operands)


def parts_of_scan(params: dict[str, Any]) -> tuple[int, int]:
    """The numbers of constants and of carried arrays among the operands of a scan."""
    if "num_consts" in params:  # before jax 0.11
        return params["num_consts"], params["num_carry"]
    consts, carry, _ = params["ft_in"].unpack()
    return len(consts), len(carry)


def _scan(b: Builder, eqn, operands, used):
    params = eqn.params
    length = params["length"]
    n_const, n_carry = parts_of_scan(params)
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
    results = _last(b, branches, which, rest, used)
    for i in reversed(range(len(branches) - 1)):
        condition = _is_at_most(b, which, i)
        others = closed(b, branches[i], rest)
        results = [choose(b, condition, yes, no) for yes, no in zip(others, results, strict=True)]
    return results


def _is_at_most(b: Builder, which: int, branch: int) -> int:
    """The node of "the index of the branch is at most `branch`"."""
    if b.nodes[which].kind == "b":
        return b.emit("not", which, kind="b")
    return b.emit("le", which, b.constant(branch, "i"), kind="b")


def _last(
    b: Builder, branches: Sequence[Any], which: int, operands: Sequence[Ids], used: tuple[bool, ...]
) -> list[Ids | None]:
    """The used results of the last branch.

    If all runs take the same branch, the last one is computed only in steps that take it.
    """
    if not b.is_shared(which):
        return list(closed(b, branches[-1], operands))
    taken = which
    if b.nodes[which].kind != "b":
        taken = b.emit("ge", which, b.constant(len(branches) - 1, "i"), kind="b")
    return apply(b, branches[-1], operands, used, [used], closed, taken)


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


def _read_of_scan(params: dict[str, Any]) -> tuple:
    return params["length"], params["reverse"], params["jaxpr"], parts_of_scan(params)


def _read_of_inlined(name: str) -> Callable[[dict[str, Any]], tuple]:
    return lambda params: (params[INLINED[name]],)


PARAMETERS: dict[str, Callable[[dict[str, Any]], tuple]] = {
    "scan": _read_of_scan,
    "cond": lambda params: (params["branches"],),
    "while": lambda params: (),
    **{name: _read_of_inlined(name) for name in INLINED},
}
"""Primitive with inner functions -> function (parameters) -> those that are read here."""
