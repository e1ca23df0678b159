"""What a proof requires of barriers that users write.

A barrier of the class must be smooth on each side of e1 = 0: it may select by the sign of e1, and
by nothing else.  The bound of arms divides all lengths by the width of the tube (`arm_motion`), so
that V1, slope and virtual velocity must be homogeneous in lengths.  Both are read from the jaxprs:
each number has a degree d, its unit is rad^d, and an operation on numbers of different degrees,
such as 1 + e1, shows a length that the barrier has of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jax.extend.core import primitives

from iblf_jax.control.barriers import Barrier
from iblf_jax.core import checks
from iblf_jax.kernels import jaxprs
from iblf_jax.proofs.chain_motion import OpenTube
from iblf_jax.proofs.examination import (
    CASES,
    KINKS,
    REARRANGING,
    SMOOTH,
    digest_of,
    interpreted,
    traced,
)
from iblf_jax.proofs.forms import degree
from iblf_jax.proofs.users_parts import ACCURACY, check_agreement

SAMPLES = 256
"""Tubes and errors at which methods of a barrier are compared."""
NEAR_ZERO = 1e-7
"""Share of the width at which the two sides of e1 = 0 are compared."""
JUMP = 1e-4
"""Difference of the two sides that counts as a jump."""

COMPARISONS = frozenset([primitives.lt_p, primitives.le_p, primitives.gt_p, primitives.ge_p])
LOGIC = frozenset([primitives.and_p, primitives.or_p, primitives.xor_p, primitives.not_p])
SUMS = frozenset([primitives.add_p, primitives.add_jaxvals_p, primitives.sub_p])
PRODUCTS = frozenset([primitives.mul_p, primitives.dot_general_p])
OF_ONE_UNIT = frozenset([primitives.neg_p, primitives.reduce_sum_p, primitives.cumsum_p])
POWERS: dict[Any, Any] = {primitives.square_p: 2, primitives.sqrt_p: Fraction(1, 2)}
POWERS |= {primitives.rsqrt_p: Fraction(-1, 2)}


class _UnitError(Exception):
    """An operation with a length of its own, or one that selects a case; a line for the user."""


class _Quantity(NamedTuple):
    """What is known of an array."""

    degree: Fraction | int | None = None
    """Its unit is rad^degree; None for zeros, which have every unit."""
    is_error: bool = False
    """Whether it is e1 or -e1."""
    is_side: bool = False
    """Whether it is a truth value that the sign of e1 decides, or one that does not vary."""


ZERO, NUMBER = _Quantity(), _Quantity(0)


def check_barrier(
    name: str, barrier: Barrier, o: jax.Array | None, *, n: int, homogeneous: bool
) -> list[str]:
    """The digests of the methods of a user's barrier (`Operations.digest`).

    Args:
      name: of the barrier, for the message.
      barrier: without its guard.
      o: gain of the law, or None.
      n: number of joints.
      homogeneous: whether a length of its own is refused.

    Raises:
      ValueError: a case besides the sign of e1, a length of its own, joints that mix, or methods
        that contradict each other.
    """

    def rule(eqn: core.JaxprEqn, operands: list[_Quantity]) -> list[_Quantity]:
        if not homogeneous:  # Lengths do not matter: all units are equal.
            operands = [x if x.degree is None else x._replace(degree=0) for x in operands]
        return [_result(eqn, operands)] * len(eqn.outvars)

    digests = []
    for method, function, inputs, expected in _methods(barrier, o, n):
        jaxpr = traced(f"{name}.{method}", function, [jnp.ones(n) for _ in inputs])
        digests.append(digest_of(jaxpr))
        try:
            outputs = interpreted(jaxpr, inputs, rule, _of_constant)
            if homogeneous:
                _unit_of([*outputs, _Quantity(expected)])
        except _UnitError as error:
            got = checks.Words(f"{type(barrier).__name__}.{method} with {error}")
            words = "a barrier without a length of its own, smooth on each side of e1 = 0"
            reason = "The bound divides all lengths by the width of the tube."
            raise checks.fail(f"prove: {name}", got, words, reason) from None
        _check_joints(f"{name}.{method}", function, inputs, n)
    _check_samples(name, barrier, o, n)
    return digests


def _tube(lower: jax.Array, upper: jax.Array, dlower: jax.Array, dupper: jax.Array) -> OpenTube:
    """A tube in the frame of the reference."""
    zero = jnp.zeros_like(lower)
    return OpenTube(zero, zero, lower, upper, dlower, dupper)


def _methods(
    barrier: Barrier, o: jax.Array | None, n: int
) -> Iterator[tuple[str, Callable, list[_Quantity], int]]:
    """Name, function, inputs and degree of the result of each method of a barrier."""
    d = degree(barrier)
    length, of_tube = _Quantity(1), [_Quantity(1)] * 4
    error, gain = length._replace(is_error=True), NUMBER
    gain_o = None if o is None else jnp.max(o)
    at_error = [*of_tube, error]
    yield "value", lambda *x: barrier.value(_tube(*x[:4]), x[4]), at_error, d
    yield "slope", lambda *x: barrier.slope(_tube(*x[:4]), x[4]), at_error, d - 1

    def virtual_velocity(*x: jax.Array) -> Any:
        own = None if gain_o is None else gain_o * x[6]
        return barrier.virtual_velocity(_tube(*x[:4]), x[4], x[5], own)

    yield "virtual_velocity", virtual_velocity, [*at_error, gain, gain], 1

    def error_over_slope(*x: jax.Array) -> Any:
        return barrier.error_over_slope(_tube(*x[:4]), x[4])

    yield "error_over_slope", error_over_slope, at_error, 2 - d
    for above in (True, False):

        def error_at(*x: jax.Array, above: bool = above) -> Any:
            return barrier.error_at(x[4], _tube(*x[:4]), jnp.full(n, above))

        yield "error_at", error_at, [*of_tube, _Quantity(d)], 1


def _of_constant(value: object) -> _Quantity:
    """A constant: zeros have every unit, and a truth value does not vary."""
    is_truth = np.asarray(value).dtype == bool
    if not is_truth and not np.any(np.asarray(value)):
        return ZERO
    return _Quantity(0, is_side=is_truth)


def _unit_of(quantities: list[_Quantity]) -> Fraction | int | None:
    """The degree of quantities of one unit."""
    found = {x.degree for x in quantities if x.degree is not None}
    if len(found) > 1:
        raise _UnitError("a length of its own")
    return found.pop() if found else None


def _result(eqn: core.JaxprEqn, operands: list[_Quantity]) -> _Quantity:
    """The result of an operation."""
    primitive, first = eqn.primitive, operands[0] if operands else NUMBER
    if primitive in COMPARISONS:
        one, other = operands
        is_error_with_zero = one.is_error and other.degree is None
        if is_error_with_zero or (other.is_error and one.degree is None):
            return _Quantity(0, is_side=True)
    if primitive in LOGIC and all(x.is_side for x in operands):
        return _Quantity(0, is_side=True)
    if primitive is primitives.select_n_p and first.is_side:
        return _Quantity(_unit_of(operands[1:]))
    if primitive is primitives.abs_p and first.is_error:
        return _Quantity(first.degree)
    if primitive is primitives.sign_p and first.is_error:
        return NUMBER
    if primitive in REARRANGING:
        return _moved(eqn, operands)
    is_conversion = primitive is primitives.convert_element_type_p
    if is_conversion:
        # Integers do not vary, because no admitted operation gives one that does.
        pair = (eqn.invars[0], eqn.outvars[0])
        before, after = (v.aval.dtype for v in pair)  # type: ignore[attr-defined]
        if before == after or jnp.issubdtype(before, jnp.integer):
            return first
    if primitive in SUMS:
        is_error = any(x.is_error for x in operands) and any(x.degree is None for x in operands)
        return _Quantity(_unit_of(operands), is_error)
    if primitive in OF_ONE_UNIT:
        return first._replace(is_error=first.is_error and primitive is primitives.neg_p)
    if primitive in CASES | KINKS and not is_conversion:
        raise _UnitError(f"{primitive.name}, which is no case of the sign of e1")
    if primitive not in SMOOTH:
        raise _UnitError(f"{primitive.name}, which a proof does not know")
    return _Quantity(_degree(eqn, operands))


def _moved(eqn: Any, operands: list[_Quantity]) -> _Quantity:
    """The result of an operation that moves numbers."""
    floats = [
        x
        for x, v in zip(operands, eqn.invars, strict=True)
        if not jnp.issubdtype(v.aval.dtype, jnp.integer)
    ]
    if not floats:
        return NUMBER
    is_same = all(x == floats[0] for x in floats)
    return floats[0] if is_same else _Quantity(_unit_of(floats))


def _degree(eqn: Any, operands: list[_Quantity]) -> Any:
    """The degree of the result of a product, a power or a function."""
    primitive, degrees = eqn.primitive, [x.degree for x in operands]
    if primitive is primitives.div_p and degrees[1] is not None:
        return None if degrees[0] is None else degrees[0] - degrees[1]
    if primitive in PRODUCTS:
        return None if None in degrees else sum(degrees)
    if primitive in POWERS:
        return None if degrees[0] is None else degrees[0] * POWERS[primitive]
    if primitive is primitives.integer_pow_p and eqn.params["y"] > 0:
        return None if degrees[0] is None else degrees[0] * eqn.params["y"]
    if primitive is primitives.integer_pow_p and degrees[0] is not None:
        return degrees[0] * eqn.params["y"]
    if primitive is primitives.pow_p and not jaxprs.is_variable(eqn.invars[1]):
        exponent = Fraction(float(eqn.invars[1].val))
        return 0 if degrees[0] is None else degrees[0] * exponent
    if any(degrees):
        raise _UnitError("a length of its own")
    return 0


# --- at random points -----------------------------------------------------------------------------


class _Samples(NamedTuple):
    """Tubes and errors inside them, (SAMPLES, n)."""

    lower: np.ndarray
    upper: np.ndarray
    dlower: np.ndarray
    dupper: np.ndarray
    e: np.ndarray


def _samples(n: int) -> _Samples:
    """Random tubes of n joints, and an error of each joint on a random side."""
    generator = np.random.default_rng(0)
    k_l, k_u = np.exp(generator.normal(size=(2, SAMPLES, n)))
    dlower, dupper = generator.normal(size=(2, SAMPLES, n))
    share = generator.uniform(-0.9, 0.9, (SAMPLES, n))
    e = np.where(share > 0.0, share * k_u, share * k_l)
    return _Samples(-k_l, k_u, dlower, dupper, e)


@jax.enable_x64(True)
def _check_joints(name: str, function: Callable, inputs: list[_Quantity], n: int) -> None:
    """Raises ValueError if the result of a joint depends on an input of another joint."""
    if n == 1:
        return
    samples = _samples(n)
    positive = np.exp(np.random.default_rng(1).normal(size=(SAMPLES, n)))
    error_or_value = samples.e if inputs[4].is_error else positive
    x = [*samples[:4], error_or_value, positive, positive][: len(inputs)]

    def results(*y: jax.Array) -> list[jax.Array]:
        return [jnp.broadcast_to(found, (n,)) for found in jax.tree.leaves(function(*y))]

    jacobian = jax.vmap(jax.jacfwd(results, argnums=tuple(range(len(x)))))
    for found in jax.tree.leaves(jacobian(*x)):
        size = np.max(np.abs(found), axis=(1, 2))
        others = np.max(np.abs(np.where(np.eye(n), 0.0, found)), axis=(1, 2))
        if not np.all(others <= ACCURACY * size):
            got = checks.Words("a result of a joint that depends on another joint")
            reason = "The bound adds one V1 for each joint."
            raise checks.fail(f"prove: {name}", got, "joints that do not mix", reason)


@jax.enable_x64(True)
def _check_samples(name: str, barrier: Barrier, o: jax.Array | None, n: int) -> None:
    """Raises ValueError for methods that contradict each other at a random point."""
    one = jnp.ones(n)
    gain_o = None if o is None else jnp.max(o) * one

    def pairs(*x):
        *sides, e = x
        tube = _tube(*sides)
        V = barrier.value(tube, e)
        slope = jax.jvp(lambda q: barrier.value(tube, q), (e,), (one,))[1]
        found = {"slope": (barrier.slope(tube, e), slope)}
        back = barrier.error_at(V, tube, e > 0)
        if back is not None:
            found["error_at"] = (back, e)
        ratio = barrier.error_over_slope(tube, e)
        if ratio is not None:
            found["error_over_slope"] = (ratio * slope, e)
        return found

    def functions(*x):
        """V1, slope, alpha and the derivative of alpha at an error; e1/s if it states that it does
        not jump.
        """
        *sides, e = x
        tube = _tube(*sides)
        alpha, rate = jax.jvp(
            lambda q: barrier.virtual_velocity(tube, q, one, gain_o), (e,), (one,)
        )
        found = (barrier.value(tube, e), barrier.slope(tube, e), alpha, rate)
        ratio = barrier.error_over_slope(tube, e)
        return found if ratio is None or barrier.ratio_jumps else (*found, ratio)

    samples = _samples(n)
    for method, pair in jax.vmap(pairs)(*samples).items():
        check_agreement(f"{name}.{method}", *pair)
    width = np.minimum(-samples.lower, samples.upper)
    shares = (-0.5, -NEAR_ZERO, NEAR_ZERO, 0.5)
    found = [jax.vmap(functions)(*samples[:4], share * width) for share in shares]
    for left, below, above, right in zip(*found, strict=True):
        size = np.maximum(np.abs(left), np.abs(right))
        check_agreement(f"{name} at e1 = 0", below, above, size, JUMP)
