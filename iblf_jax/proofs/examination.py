"""Which operations the functions of a scenario may have, read from their jaxprs.

A proof differentiates functions that users write.  The derivative of a function that jumps does not
contain the jump, and a derivative rule of a user's own may be wrong.  A function is therefore
admitted only if each of its operations is in a list (`SMOOTH`, `REARRANGING`, `KINKS`).  The lists
hold JAX's primitives themselves: another primitive of the same name is not one of them.

Only operations count that depend on what varies, and on which an output depends.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend import core
from jax.extend.core import primitives
from jax.typing import ArrayLike

from iblf_jax.core import checks
from iblf_jax.core.program_digest import hash_constants
from iblf_jax.kernels import jaxprs


def _primitives(names: str) -> frozenset[core.Primitive]:
    """JAX's primitives of these names, of those that this version has."""
    found = (getattr(primitives, f"{name}_p", None) for name in names.split())
    return frozenset(primitive for primitive in found if primitive is not None)


def _primitive_of(name: str, function: Callable, *inputs: ArrayLike) -> frozenset[core.Primitive]:
    """JAX's primitive of this name, which `jax.extend` does not export, from a function that has
    it.  In some versions the function may consist of other primitives, which are not taken.
    """
    eqns = jax.make_jaxpr(function)(*inputs).jaxpr.eqns
    return frozenset(eqn.primitive for eqn in eqns if eqn.primitive.name == name)


SMOOTH = _primitives(
    # entire functions
    "add add_jaxvals sub mul neg square sin cos sinh cosh tanh atan asinh exp exp2 expm1 logistic"
    " erf erfc one_minus_square"
    # sums and products of entries
    " dot_general reduce_sum reduce_prod cumsum cumprod"
    # smooth inside their domains; their derivatives have no bound at the ends of the domain, so
    # that no box that touches an end is proved
    " div integer_pow sqrt rsqrt log log1p log2 tan asin acos acosh atanh"
    # x^y with a y that is no whole number has a bounded derivative at x = 0 for y > 1; on intervals
    # it has no bound unless x >= 0 (`i_pow`)
    " pow"
)
"""Operations with derivatives of every order."""
REARRANGING = _primitives(
    "reshape squeeze expand_dims broadcast_in_dim transpose slice concatenate rev pad iota copy"
    " empty2"
    # Their indices do not vary: operations that give a varying integer are not in the lists.
    " gather dynamic_slice dynamic_update_slice scatter scatter_add"
)
REARRANGING |= _primitive_of("stack", lambda x: jnp.stack([x, x]), 0.0)
REARRANGING |= _primitive_of("unstack", lambda x: jnp.unstack(x), jnp.zeros(2))
REARRANGING |= _primitive_of("split", lambda x: jnp.split(x, 2), jnp.zeros(2))
"""Operations that only move numbers, without a numerical operation."""
KINKS = _primitives("abs max min clamp reduce_max reduce_min cummax cummin")
"""Continuous operations whose derivatives jump. On a box that touches the kink, their derivatives
contain those of both sides."""
CASES = _primitives(
    "select_n eq ne lt le gt ge sign is_finite and or xor not reduce_and reduce_or"
    " convert_element_type"  # of a truth value
)
"""Operations of `jnp.where`, `jnp.sign` and comparisons. Nothing shows that a function with one of
them is continuous."""
INNER = _primitives("jit closed_call call remat")
"""Primitives that call a function without a change; `jaxprs.called` knows which one. Functions with
derivative rules of their own are not among them."""
ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")
"""What the text of a jaxpr says of a function of Python beside its name."""


class Operations(NamedTuple):
    """The operations of a function that are not smooth, and the inputs on which its outputs
    depend.
    """

    kinks: frozenset[str]
    cases: frozenset[str]
    unknown: frozenset[str]
    """Those that are in no list."""
    inputs_of_kinks: frozenset[frozenset[int]]
    """Of each kink the positions of the inputs on which its place depends."""
    inputs: frozenset[int]
    """Positions of the inputs on which an output depends."""
    digest: str
    """Of the jaxpr and its constants. Programs of a function are kept under its class; the digest
    distinguishes those before and after a change of a number that it reads from elsewhere."""

    @property
    def are_smooth(self) -> bool:
        """Whether all are smooth."""
        return not self.kinks and not self.cases and not self.unknown


class Examined(NamedTuple):
    """What an examination of parts found."""

    assumed: list[str]
    """Sentences on what is assumed of them."""
    digests: list[str]
    """Of their functions, as `Operations.digest`."""


Value = Any
"""What is known of an array: a set of inputs, or a physical dimension."""


def interpreted(
    function: core.ClosedJaxpr | core.Jaxpr,
    inputs: Sequence[Value],
    rule: Callable,
    constant: Callable[[Any], Value],
) -> list[Value]:
    """What is known of the outputs of a jaxpr.

    Args:
      function: the jaxpr, closed or not.
      inputs: what is known of its inputs.
      rule: function (equation, values of its operands) -> values of its results.
      constant: function of a constant -> its value.
    """
    jaxpr, values = jaxprs.opened(function)
    constants = [constant(x) for x in values]
    by_variable = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *inputs], strict=True))

    def read(atom: Any) -> Value:
        return by_variable[atom] if jaxprs.is_variable(atom) else constant(atom.val)

    live = jaxprs.needed(jaxpr)
    for eqn in jaxpr.eqns:
        if not any(v in live for v in eqn.outvars):
            continue
        operands = [read(v) for v in eqn.invars]
        if eqn.primitive in INNER:
            results = interpreted(jaxprs.called(eqn), operands, rule, constant)
        else:
            results = rule(eqn, operands)
        by_variable.update(zip(eqn.outvars, results, strict=True))
    return [read(v) for v in jaxpr.outvars]


def traced(name: str, function: Callable, inputs: Sequence[Any]) -> Any:
    """The jaxpr of a function of arrays.

    Raises:
      ValueError: the function decides by the value of an input in Python.
    """
    try:
        return jax.make_jaxpr(lambda *x: jax.tree.leaves(function(*x)))(*inputs)
    except (jax.errors.JAXTypeError, jax.errors.JAXIndexError) as error:
        got = f"a function that cannot be traced ({checks.one_line(str(error))})"
        expected = "a function of jnp operations, without `if` and `float` of its inputs"
        raise checks.fail(name, checks.Words(got), expected) from error


def digest_of(jaxpr: core.ClosedJaxpr) -> str:
    """The digest of a function: of its text without addresses, and of all its constants.

    No text holds what a function of Python computes while a program runs.  A jaxpr that calls one
    has another digest each time.
    """
    found = hashlib.sha256(ADDRESS.sub("", str(jaxpr)).encode())
    hash_constants(found, jaxpr)
    if any("callback" in name for name in jaxprs.primitives(jaxpr)):
        found.update(os.urandom(32))
    return found.hexdigest()


def operations(
    name: str, function: Callable, inputs: Sequence[Any], varying: Iterable[int] | None = None
) -> Operations:
    """The operations of a function.

    Args:
      name: of the function, for the message of an error.
      function: of arrays, which returns a pytree of arrays.
      inputs: arrays of the shapes of its inputs.
      varying: positions of the inputs that vary; all if not given.
    """
    found: dict[str, set[str]] = {"kinks": set(), "cases": set(), "unknown": set()}
    inputs_of_kinks: set[frozenset] = set()

    def rule(eqn: core.JaxprEqn, operands: list[frozenset]) -> list[frozenset]:
        seen: frozenset = frozenset().union(*operands)
        if eqn.primitive is primitives.scan_p and seen:
            return _of_scan(eqn, operands, rule, constant)
        if eqn.primitive is primitives.cond_p and not operands[0]:
            # A result depends on what it depends on in one of the branches; the choice is fixed.
            branches = eqn.params["branches"]
            results = [interpreted(branch, operands[1:], rule, constant) for branch in branches]
            return [frozenset().union(*each) for each in zip(*results, strict=True)]
        kind = _kind(eqn, operands) if seen else None
        if kind is not None:
            found[kind].add(eqn.primitive.name)
        if kind == "kinks":
            inputs_of_kinks.add(seen)
        return [seen] * len(eqn.outvars)

    def constant(value: object) -> frozenset:
        return frozenset()

    jaxpr = traced(name, function, inputs)
    numbers = set(range(len(inputs)) if varying is None else varying)
    values = [frozenset({i} & numbers) for i in range(len(inputs))]
    outputs = interpreted(jaxpr, values, rule, constant)
    sets = {kind: frozenset(names) for kind, names in found.items()}
    return Operations(
        **sets,
        inputs_of_kinks=frozenset(inputs_of_kinks),
        inputs=frozenset().union(*outputs),
        digest=digest_of(jaxpr),
    )


def _kind(eqn: Any, operands: list[frozenset]) -> str | None:
    """The list of an operation on numbers that vary; None for a smooth one."""
    primitive = eqn.primitive
    if primitive is primitives.convert_element_type_p:
        # A float of fewer digits is rounded, an integer jumps.
        before, after = (v.aval.dtype for v in (eqn.invars[0], eqn.outvars[0]))
        if before == after:
            return None
        is_truth = before == jnp.bool_ and after == jnp.float64
        return "cases" if is_truth else "unknown"
    if primitive is primitives.select_n_p and not operands[0]:
        return None
    if primitive in SMOOTH or primitive in REARRANGING:
        return None
    if primitive in KINKS:
        return "kinks"
    return "cases" if primitive in CASES else "unknown"


def _of_scan(
    eqn: core.JaxprEqn, operands: list[frozenset], rule: Callable, constant: Callable
) -> list[frozenset]:
    """The inputs on which the results of a loop of fixed length depend: its body is interpreted
    until what is carried no longer changes.
    """
    constants, carried = jaxprs.scan_sizes(eqn.params)
    values = list(operands)
    carry = slice(constants, constants + carried)
    while True:
        results = interpreted(eqn.params["jaxpr"], values, rule, constant)
        merged = [x | y for x, y in zip(values[carry], results[:carried], strict=True)]
        if merged == values[carry]:
            return [*merged, *results[carried:]]
        values[carry] = merged


ADVICE = (
    "The derivative does not contain a jump, and a rule of a user's own may be wrong. Take"
    " operations with derivatives, such as jnp.tanh; docs/how_to/prove.md has the list."
)


def check_operations(
    name: str,
    function: Callable,
    inputs: Sequence[Any],
    varying: Iterable[int] | None = None,
    *,
    kinks: bool,
    parameters: Iterable[int] = (),
) -> Operations:
    """The operations of a function that may not jump, and whose derivative is that of JAX.

    Where the place of a kink depends on a parameter, the derivative by time or state jumps with the
    parameter, so that the mean value theorem says nothing of its difference.

    Args:
      name: of the part, for the message.
      function, inputs, varying: as `operations`.
      kinks: whether the derivative may jump.
      parameters: positions of the inputs that are uncertain parameters, which move no kink.

    Raises:
      ValueError: an operation that is not admitted.
    """
    found = operations(name, function, inputs, varying)
    refuse_unknown(name, found)
    if found.cases:
        got = f"operations that select a case ({', '.join(sorted(found.cases))})"
        expected = "functions without cases, such as jnp.sign or jnp.where of a comparison"
        raise checks.fail(f"prove: {name}", checks.Words(got), expected, ADVICE)
    if found.kinks and not kinks:
        got = f"operations whose derivative jumps ({', '.join(sorted(found.kinks))})"
        raise checks.fail(f"prove: {name}", checks.Words(got), "a smooth function", ADVICE)
    uncertain = frozenset(parameters)
    if any(x & uncertain and x - uncertain for x in found.inputs_of_kinks):
        listed = ", ".join(sorted(found.kinks))
        got = f"operations whose derivative jumps where a parameter says ({listed})"
        expected = "kinks at the same states for all uncertain parameters"
        remedy = "Where the parameter is a factor, write it in front: p * jnp.abs(x)."
        raise checks.fail(f"prove: {name}", checks.Words(got), expected, remedy)
    return found


def refuse_unknown(name: str, found: Operations) -> None:
    """Raises ValueError for operations that are in no list."""
    if not found.unknown:
        return
    got = f"operations that a proof does not know ({', '.join(sorted(found.unknown))})"
    expected = "operations of the list in docs/how_to/prove.md"
    raise checks.fail(f"prove: {name}", checks.Words(got), expected, ADVICE)
