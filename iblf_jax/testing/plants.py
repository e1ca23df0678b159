"""The checker for plants in strict-feedback form: the contract is `iblf_jax.plants.Plant`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.core import checks, taylor
from iblf_jax.core.families import is_default
from iblf_jax.simulation.scenario import fit_joints
from iblf_jax.testing._contract import (
    Findings,
    StoppedCheckError,
    at_each,
    call_has_shape,
    check_function,
    examine,
    has_shape,
    in_both_types,
    in_dtype,
    shape_of,
    traced_methods,
)
from iblf_jax.world import plants
from iblf_jax.world.plants import Plant

POINTS = 4
"""Number of random states at which a plant is tested."""
TOLERANCE = 1e-9
"""Relative, float64: two formulas of one quantity agree to rounding."""
SMALLEST_RATIO = 1e-12
"""Least ratio of the singular values of a gain that counts as invertible."""
PART = (
    "For a plant that is defined in a part of the space only, give states there:"
    " check_plant(plant, x=...), shape (m, order, n)"
)
"""The remedy for a plant that has no value at a random state."""
Numbers = dict[str, Any]


def check_plant(plant: Plant, *, x: ArrayLike | None = None) -> None:
    """Checks a plant in strict-feedback form: shapes, derivatives, float32, the dependence of drift
    and gain on the levels, invertible gains, units, and optional members that agree with both.

        x_i' = f_i(t, x_1..x_i) + G_i(t, x_1..x_i) x_{i+1},   i = 1..r,   x_{r+1} = u       (S.1)

    Args:
      plant: an instance.
      x: states of the test, (m, order, n), in the units of the levels; random ones between -1 and 1
        if not given.  Give states for a plant that is defined in a part of the space only.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: `x` is not an array of shape (m, order, n).
    """
    with examine(plant, "Plant", Plant) as findings:
        try:
            plants.check_dimensions(type(plant).__name__, plant)
        except ValueError as error:
            findings.stop(str(error).removesuffix("."))
        plant = fit_joints(in_dtype(plant, "float64"), plant.n, "plant")
        points = np.asarray(_points(plant, x))
        t = jnp.asarray(0.7)
        method = traced_methods()
        in_both_types(findings, partial(_shapes, method=method), plant, t, points[0])
        vectors = np.random.default_rng(2).normal(size=(2, plant.n))
        at_state = jax.jit(partial(_at_state, method))
        found = at_each(lambda x: at_state(plant, t, x, *vectors), points)
        _structure(findings, plant, points, found)
        check_function(findings, partial(_functions, method), plant, (t, points[0]))
        # Optional members must agree with drift and gain.
        for name, difference in found.identities.items():
            problem, remedy = REMEDIES[name]
            off = float(np.max(np.abs(difference)))
            findings.require(off <= TOLERANCE, f"{problem} (by {off:.2g})", remedy)


def _points(plant: Plant, x: ArrayLike | None) -> jax.Array:
    """The states of the test, (m, order, n)."""
    shape = (plant.order, plant.n)
    if x is None:
        rng = np.random.default_rng(1)
        return jnp.asarray(rng.uniform(-1.0, 1.0, (POINTS, *shape)))
    points = checks.as_floats("x", x)
    checks.check_values("x", points, None)
    points = points[None] if points.ndim == 2 else points
    if points.ndim != 3 or points.shape[1:] != shape or not len(points):
        expected = f"states, shape (m, {plant.order}, {plant.n})"
        raise checks.fail("x", points, expected, f"Its shape is {points.shape}.")
    return points


Method = Callable[..., Callable[..., Any]]
"""name -> a method of a plant, of (plant, ...), as JAX has traced it."""


def _shapes(
    findings: Findings, plant: Plant, t: jax.Array, x: jax.Array, *, method: Method
) -> None:
    """Requires the shapes of drift, gain and the optional members."""
    order, n = x.shape
    call_has_shape(findings, "drift(t, x)", method("drift"), (plant, t, x), (order, n))
    gain = shape_of(findings, "gain(t, x)", method("gain"), plant, t, x)
    problem = f"gain(t, x) has shape {gain.shape}"
    remedy = f"It must be {(order, n, n)}, or {(order, n)} for diagonal gains"
    findings.require(gain.shape in ((order, n), (order, n, n)), problem, remedy)
    v = np.asarray(x)[0]
    optional: dict[str, tuple[tuple[jax.Array, ...], tuple[int, ...]]] = {
        "weights": ((x,), (order, n)),
        "steady_levels": ((v, v), (order - 2, n)),
        "steady_input": ((v,), (n,)),
        "joint_torque": ((x, v), (n,)),
    }
    for name, (args, shape) in optional.items():
        with suppress(StoppedCheckError):
            found = shape_of(findings, name, method(name), plant, *args)
            if found is not None:
                has_shape(findings, name, found, shape)
    arguments = {
        "level_rate": (t, x, v, 0.0),
        "level_input": (t, x, v, 0.0),
        "transposed_gain": (t, x, v),
    }
    for name, of_level in _own_by_level(plant).items():
        for level in range(1, order + 1):
            at_level = partial(of_level, level)
            call_has_shape(findings, f"{name}({level}, ...)", at_level, arguments[name], (n,))


def _own_by_level(plant: Plant) -> dict[str, Any]:
    """The methods of a level that do not follow from drift and gain, by name."""
    pairs = {
        "level_rate": (plant.level_rate, Plant.level_rate),
        "level_input": (plant.level_input, Plant.level_input),
        "transposed_gain": (plant.transposed_gain, Plant.transposed_gain),
    }
    return {name: own for name, (own, default) in pairs.items() if not is_default(own, default)}


class AtState(NamedTuple):
    """What is tested of a plant at a state, or at several states along a leading axis."""

    gain: Any
    slopes: Any
    """The derivatives of drift and gain along a straight line, in one vector."""
    dependence: Any
    """On which levels drift and gain depend; None for the model of a law with filters."""
    identities: Numbers
    """The differences between optional members and what follows from drift and gain."""


def _at_state(
    method: Method, plant: Plant, t: jax.Array, x: jax.Array, v: jax.Array, s: jax.Array
) -> AtState:
    """What is tested at a state, all in one program."""
    dependence = None
    if not plant.needs_filters:
        dependence = plants.dependence_on_levels(plant, t, x)
    slopes = _derivatives_along(method, plant, t, x)
    gain = method("gain")(plant, t, x)
    return AtState(gain, slopes, dependence, _identities(method, plant, t, x, v, s))


def _structure(findings: Findings, plant: Plant, points: np.ndarray, found: AtState) -> None:
    """Requires rows that depend on no later level, except for the model of a law with filters;
    invertible gains, and finite derivatives.
    """
    if found.dependence is not None:
        try:
            plants.check_dependence(type(plant).__name__, found.dependence)
        except ValueError as error:
            findings.stop(str(error).removesuffix("."))
    gains = found.gain
    finite = np.isfinite(gains).reshape(*gains.shape[:2], -1).all(axis=-1)
    if not finite.all():
        point, row = np.argwhere(~finite)[0]
        state = np.array2string(points[point].ravel(), precision=4, threshold=8)
        problem = f"row {row} of gain(t, x) is not finite at x = {state}"
        findings.stop(problem, f"Look at roots and divisions. {PART}")
    for i in range(plant.order):
        matrices = gains[:, i]
        if gains.ndim == 3:
            matrices = matrices[:, None, :] * np.eye(plant.n)
        values = np.linalg.svd(matrices, compute_uv=False)
        invertible = np.all(values[:, -1] > SMALLEST_RATIO * values[:, 0])
        problem = f"row {i} of gain(t, x) is singular"
        findings.require(invertible, problem, "Every level must act on the level below it")
    findings.stop_if_any()
    problem = f"a derivative of order up to {plant.order - 1} of drift or gain is not finite"
    remedy = f"Laws differentiate them that often: look at roots, norms and divisions. {PART}"
    findings.require(np.isfinite(found.slopes).all(), problem, remedy)


def _derivatives_along(method: Method, plant: Plant, t: jax.Array, x: jax.Array) -> jax.Array:
    """The Taylor coefficients of drift and gain along a straight line, all in one vector."""
    constant = [(jnp.zeros_like(t), jnp.zeros_like(x))] * (plant.order - 2)
    curve = [(t, x), (jnp.ones_like(t), jnp.ones_like(x)), *constant]
    drift, gain = method("drift"), method("gain")
    found = taylor.along(lambda t, x: (drift(plant, t, x), gain(plant, t, x)), curve)
    return jnp.concatenate([jnp.ravel(value) for value in jax.tree.leaves(found)])


def _functions(method: Method, plant: Plant, t: jax.Array, x: jax.Array) -> Numbers:
    """The functions of a plant whose derivatives are tested."""
    values = {f"{name}(t, x)": method(name)(plant, t, x) for name in ("drift", "gain")}
    arguments = {"weights": (x,), "steady_input": (x[0],), "joint_torque": (x, x[-1])}
    if plant.order > 2:
        arguments["steady_levels"] = (x[0], x[1])
    stated = {name: method(name)(plant, *given) for name, given in arguments.items()}
    return values | {name: value for name, value in stated.items() if value is not None}


def _identities(
    method: Method, plant: Plant, t: jax.Array, x: jax.Array, v: jax.Array, s: jax.Array
) -> Numbers:
    """The differences between optional members and what follows from drift and gain, one array a
    member, relative to its size.
    """
    found: Numbers = {}
    drift, gain = method("drift")(plant, t, x), method("gain")(plant, t, x)
    matrices = gain if gain.ndim == 3 else gain[:, None, :] * jnp.eye(plant.n)
    levels = range(1, plant.order + 1)
    rates = jnp.stack([drift[i] + matrices[i] @ v for i in range(plant.order)])
    own_methods = _own_by_level(plant)
    if "level_rate" in own_methods:
        own = jnp.stack([plant.level_rate(i, t, x, v, 0.0) for i in levels])
        found["level_rate"] = _relative(own, rates)
    if "level_input" in own_methods:
        own = jnp.stack([plant.level_input(i, t, x, rates[i - 1], 0.0) for i in levels])
        found["level_input"] = _relative(own, jnp.broadcast_to(v, own.shape))
    if "transposed_gain" in own_methods:
        own = jnp.stack([plant.transposed_gain(i, t, x, s) for i in levels])
        found["transposed_gain"] = _relative(own, jnp.swapaxes(matrices, 1, 2) @ s)
    weights, rest = method("weights")(plant, x), jnp.zeros_like(x[0])
    if weights is not None:
        found["weights"] = jnp.maximum(-weights, 0.0)
    steady_levels = method("steady_levels")(plant, x[0], rest)
    steady_input = method("steady_input")(plant, x[0])
    if steady_levels is not None and steady_input is not None:
        state = jnp.concatenate([jnp.stack([x[0], rest]), steady_levels])
        rate = plants.flow(plant, t, state, steady_input)
        found["steady_input"] = rate / (1.0 + jnp.abs(plants.flow(plant, t, x, v)))
    if plant.robot is not None and "level_rate" in found:
        added = plant.level_rate(2, t, x, v, s) - plant.level_rate(2, t, x, v, 0.0)
        found["torque"] = _relative(added, plants.torque_as_rates(plant, x, s)[1])
    return found


def _relative(found: jax.Array, expected: jax.Array) -> jax.Array:
    """The difference of two rows of vectors, relative to the size of each row."""
    size = jnp.max(jnp.abs(expected), axis=-1, keepdims=True)
    return (found - expected) / (1e-12 + size)


REMEDIES = {
    "level_rate": ("level_rate is not f_i + G_i x_{i+1}", "Let it follow from drift and gain"),
    "level_input": ("level_input is not the inverse of f_i + G_i x_{i+1}", "Solve it for x_{i+1}"),
    "transposed_gain": ("transposed_gain is not G_i^T s", "Transpose the gain"),
    "weights": ("weights has negative entries", "The scale of an energy is positive"),
    "steady_input": (
        "steady_input and steady_levels do not hold the plant at q",
        "With them and q' = 0 all rates are 0",
    ),
    "torque": (
        "level_rate does not add the torque to the robot",
        "A torque adds M^-1 torque to the second level",
    ),
}
"""Optional member -> the problem where it does not agree with the others, and the remedy."""
