"""What a jaxpr is in each version of JAX: the only module that knows how its equations are stored.

Before JAX 0.11 a function is a `ClosedJaxpr`, which has the values of its constants and a `Jaxpr`.
From 0.11 on both are one class, in which `jaxpr.jaxpr is jaxpr`.  Functions here take either.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from jax.extend import core

CALLED = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "call": "call_jaxpr",
    "eval_jaxpr": "call_jaxpr",  # from JAX 0.12 on, for the three above
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vjp_call_jaxpr": "fun_jaxpr",
    "checkpoint": "jaxpr",
    "remat": "jaxpr",
    "remat2": "jaxpr",
}
"""Primitive that calls an inner function once -> the parameter that holds its jaxpr."""


def called(equation: core.JaxprEqn) -> Any:
    """The function that an equation calls; None for an equation that calls none, or by rules of its
    own (a loop, a branch).
    """
    name = equation.primitive.name
    if name not in CALLED:
        return None
    return equation.params[CALLED[name]]


def opened(function: core.ClosedJaxpr | core.Jaxpr) -> tuple[Any, Sequence[Any]]:
    """The equations of a function, with their variables, and the values of its constants."""
    return getattr(function, "jaxpr", function), getattr(function, "consts", ())


def is_variable(atom: core.Var | core.Literal) -> bool:
    """Whether an operand or an output is a variable; otherwise it is a literal with its `val`."""
    return isinstance(atom, core.Var)


def scan_sizes(params: dict[str, Any]) -> tuple[int, int]:
    """The numbers of constants and of carried arrays among the operands of a scan."""
    if "num_consts" in params:  # before JAX 0.11
        return params["num_consts"], params["num_carry"]
    consts, carry, _ = params["ft_in"].unpack()
    return len(consts), len(carry)


def count_operations(function: core.ClosedJaxpr) -> int:
    """The number of operations of a function and of its inner functions, each counted once."""
    return sum(len(jaxpr.eqns) for jaxpr, _ in nested(function))


def count_executed_operations(function: core.ClosedJaxpr) -> int:
    """The number of operations of a function, with those of an inner function at each of its calls
    in the place of the call.
    """
    # By `id`: the function holds all of its inner ones, so none of them ends meanwhile.
    counts: dict[int, int] = {}

    def count(jaxpr: core.Jaxpr) -> int:
        if id(jaxpr) not in counts:
            counts[id(jaxpr)] = sum(map(count_of, jaxpr.eqns))
        return counts[id(jaxpr)]

    def count_of(equation: core.JaxprEqn) -> int:
        bodies = list(core.jaxprs_in_params(equation.params))
        if not bodies:
            return 1
        return sum(count(opened(body)[0]) for body in bodies)

    return count(opened(function)[0])


def needed(function: core.ClosedJaxpr | core.Jaxpr) -> set[Any]:
    """The variables that the outputs depend on."""
    jaxpr, _ = opened(function)
    found = {x for x in jaxpr.outvars if is_variable(x)}
    for equation in reversed(jaxpr.eqns):
        if not found.isdisjoint(equation.outvars):
            found.update(x for x in equation.invars if is_variable(x))
    return found


def uses_of_calls(function: core.ClosedJaxpr) -> dict[Any, tuple[tuple[bool, ...], ...]]:
    """Function of `jit` inside a function, at any depth -> which of its results each of its calls
    uses.
    """
    found: dict[Any, tuple[tuple[bool, ...], ...]] = {}
    for jaxpr, _ in nested(function):
        live = needed(jaxpr)
        for equation in jaxpr.eqns:
            used = tuple([x in live for x in equation.outvars])
            if equation.primitive.name == "jit" and any(used):
                inner = called(equation)
                found[inner] = (*found.get(inner, ()), used)
    return found


def depend_on_last(function: core.ClosedJaxpr, count: int) -> list[bool]:
    """Which outputs depend on the last `count` inputs."""
    jaxpr, _ = opened(function)
    found = set(jaxpr.invars[len(jaxpr.invars) - count :])
    for equation in jaxpr.eqns:
        if any(is_variable(x) and x in found for x in equation.invars):
            found.update(equation.outvars)
    return [is_variable(x) and x in found for x in jaxpr.outvars]


def entry_of_stack(function: core.ClosedJaxpr, index: int) -> Any:
    """A Python function that returns one entry of the array that a traced function stacks along its
    first axis at its end, without the computation of the others; None if it does not do so.
    """
    jaxpr, _ = opened(function)
    if not jaxpr.eqns or jaxpr.eqns[-1].outvars != jaxpr.outvars:
        return None
    last = jaxpr.eqns[-1]
    if last.primitive.name != "stack" or last.params["axis"] != 0:
        return None
    one = jaxpr.replace(eqns=jaxpr.eqns[:-1], outvars=[last.invars[index]])
    evaluate = core.jaxpr_as_fun(function.replace(jaxpr=one))
    return lambda *operands: evaluate(*operands)[0]


def inner_functions(equation: core.JaxprEqn) -> Iterator[Any]:
    """The functions among the parameters of an equation, with their constants."""
    for value in equation.params.values():
        parts = value if isinstance(value, tuple | list) else (value,)
        yield from (x for x in parts if isinstance(x, core.Jaxpr | core.ClosedJaxpr))


def nested(function: core.ClosedJaxpr | core.Jaxpr) -> Iterator[tuple[Any, Sequence[Any]]]:
    """A function and all functions inside it, as `opened`, in the order of their first calls.

    A function that is called several times occurs once: a chain of n functions, each of which calls
    the next one twice, has 2^n calls.
    """
    # The values keep what the keys are the identities of: nothing else can get one of these.
    found: dict[tuple[int, ...], Any] = {}

    def visit(function: core.ClosedJaxpr | core.Jaxpr) -> Iterator[tuple[Any, Sequence[Any]]]:
        jaxpr, constants = opened(function)
        key = (id(jaxpr), *map(id, constants))
        if key in found:
            return
        found[key] = function
        yield jaxpr, constants
        for equation in jaxpr.eqns:
            for inner in inner_functions(equation):
                yield from visit(inner)

    return visit(function)


def primitives(function: core.ClosedJaxpr) -> set[str]:
    """The names of all primitives of a function."""
    return {equation.primitive.name for jaxpr, _ in nested(function) for equation in jaxpr.eqns}


def constants(function: core.ClosedJaxpr) -> Iterator[Any]:
    """The values of all constants and literals of a function."""
    for jaxpr, values in nested(function):
        yield from values
        for equation in jaxpr.eqns:
            yield from (x.val for x in equation.invars if not is_variable(x))
