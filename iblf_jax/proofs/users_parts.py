"""What a proof requires of parts that users write, and what it assumes of them.

The classes of the package whose properties its tests verify are in tables here, the classes
themselves: a class of the same name, or one that a user has registered, is not one of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from iblf_jax.control import barriers
from iblf_jax.core import checks
from iblf_jax.core.families import is_default
from iblf_jax.core.time import TimeVarying
from iblf_jax.proofs.examination import Examined, Operations, operations, refuse_unknown
from iblf_jax.world import bounds, plants, references, robots

BARRIERS = frozenset(
    [
        *(
            barriers.Integral,
            barriers.Log,
            barriers.Tan,
            barriers.StateBarrier,
            barriers.TransformedError,
        ),
        *(barriers.PrescribedPerformance, barriers.Quadratic),
    ]
)
"""Barriers whose claims, slopes and continuity the tests verify."""
SMOOTH_IN_TIME = frozenset(
    [
        *(references.Sinusoid, references.Quintic, references.SmoothStep, references.Ellipse),
        *(bounds.Constant, bounds.Sinusoid, bounds.Funnel),
    ]
)
"""References and sides with as many continuous derivatives as they declare."""
ROBOTS = frozenset([robots.TwoLink, robots.PlanarChain, robots.Arm])
"""Robots whose methods agree with each other."""
PLANTS = frozenset([plants.DrivenPendulum])
"""Plants whose methods agree with each other."""
POINTS = 64
"""Points at which methods of one part are compared."""
ACCURACY = 1e-8
"""Largest relative difference of methods that agree."""


def check_constant(name: str, part: plants.Plant | robots.Robot) -> None:
    """Raises ValueError for a robot or plant with a method `at` that depends on the time."""
    if is_default(part.at, TimeVarying.at):
        return

    def leaves(t: jax.Array) -> list[Any]:
        return jax.tree.leaves(part.at(t))

    now = part.at(jnp.zeros(()))
    structures: list[Any] = [jax.tree.structure(x) for x in (now, part)]
    is_same = structures[0] == structures[1] and all(
        np.array_equal(x, y)
        for x, y in zip(jax.tree.leaves(now), jax.tree.leaves(part), strict=True)
    )
    found = operations(f"{name}.at(t)", leaves, [jnp.zeros(())])
    if is_same and not found.inputs and not found.unknown:
        return
    expected = "a part that does not change"
    reason = "Its method at(t) depends on the time, and the proof is about one plant."
    raise checks.fail(f"prove: {name}", type(part).__name__, expected, reason)


# --- references and bounds ------------------------------------------------------------------------


def check_time_functions(reference: Any, sides: Mapping[str, bounds.Side], n: int) -> Examined:
    """What is assumed of the reference and the sides of bounds.

    Args:
      reference: any.
      sides: name -> side.
      n: numbers of a level.

    Raises:
      ValueError: a part that may jump, or a kink or a case without a declared number of continuous
        derivatives.
    """
    t, q_d = jnp.zeros(()), jnp.zeros(n)
    assumed, digests = [], []
    for name, part in {"reference": reference, **sides}.items():
        if type(part) in SMOOTH_IN_TIME:
            continue
        if name == "reference":
            found = operations(name, part.position, [t])
        else:
            found = operations(name, part.at, [t, q_d])
        digests.append(found.digest)
        if not found.are_smooth:
            assumed.append(_declared(name, part, found))
    return Examined(assumed, digests)


def _declared(name: str, part: references.Reference | bounds.Side, found: Operations) -> str:
    """The sentence on a part with cases or kinks that declares its continuous derivatives."""
    refuse_unknown(f"scenario.{name}", found)
    kind = type(part).__name__
    number = float(part.continuous_derivatives)
    if np.isfinite(number):
        return f"The {name} {kind} has {number:g} continuous derivatives, as it declares."
    listed = ", ".join(sorted(found.cases | found.kinks))
    got = f"{kind}, which has operations that select a case or have a kink ({listed})"
    expected = "a smooth function of time, or a class with the attribute continuous_derivatives"
    remedy = (
        "Nothing shows that it does not jump. Declare the number of its continuous derivatives,"
        " which the proof then assumes."
    )
    raise checks.fail(f"prove: scenario.{name}", checks.Words(got), expected, remedy)


# --- robots ---------------------------------------------------------------------------------------


def agreement_of_robot(robot: robots.Robot) -> list[str]:
    """A sentence on the methods of a user's robot, which are compared at random points.

    Raises:
      ValueError: they disagree.
    """
    if _is_of_package(robot):
        return []
    generator = np.random.default_rng(0)
    n = robot.n
    q = generator.uniform(-np.pi, np.pi, (POINTS, n))
    v, u, a = generator.normal(size=(3, POINTS, n))
    for name, pair in jax.vmap(lambda *x: dict(_robot_pairs(robot, *x)))(q, v, u, a).items():
        check_agreement(f"scenario.plant.{name}", *pair)
    kind = type(robot).__name__
    return [
        f"M' - 2 C of {kind} is skew-symmetric, and its other methods agree with M, C and G:"
        f" compared at {POINTS} points."
    ]


def _is_of_package(robot: robots.Robot) -> bool:
    """Whether a robot is one of the package."""
    if type(robot) is robots.WithMotors:
        return _is_of_package(robot.robot)
    return type(robot) in ROBOTS


def _robot_pairs(
    robot: robots.Robot, q: jax.Array, v: jax.Array, u: jax.Array, a: jax.Array
) -> Iterator[tuple[str, tuple[jax.Array, jax.Array, jax.Array]]]:
    """Name of a method -> what it returns, what follows from M, C and G, and the size of the terms
    in it, of which a difference is a share.
    """
    M, rate = jax.jvp(robot.mass_matrix, (q,), (v,))
    C_u, C_v, C_a = (robot.coriolis(q, v, x) for x in (u, v, a))
    G = robot.gravity(q)
    # sqrt(M_ii M_jj) bounds M_ij in the units of M_ij, so that a light joint has a scale of its own
    inertia = jnp.sqrt(jnp.abs(jnp.outer(jnp.diag(M), jnp.diag(M))))
    # The terms of C u cancel where M is constant; they are of the size of M |v| |u|.
    speed = jnp.max(jnp.abs(v))
    turned_u, turned_v, turned_a = (speed * inertia @ jnp.abs(x) for x in (u, v, a))
    yield "mass_matrix", (M, M.T, inertia)
    size = jnp.dot(jnp.abs(u), jnp.abs(C_u) + turned_u)
    yield "coriolis", (2.0 * jnp.dot(u, C_u), jnp.dot(u, rate @ u), size)
    size = jnp.abs(C_u) + jnp.abs(C_a) + turned_u + turned_a
    yield "coriolis of a sum", (robot.coriolis(q, v, u + a), C_u + C_a, size)
    yield "momentum", (robot.momentum(q, v), M @ v, inertia @ jnp.abs(v))
    size = jnp.abs(C_v) + turned_v
    yield "energy_gradient", (robot.energy_gradient(q, v), rate @ v - C_v, size)
    size = jnp.abs(C_u) + jnp.abs(G) + inertia @ jnp.abs(a) + turned_u
    yield "inverse_dynamics", (robot.inverse_dynamics(q, v, u, a), C_u + G + M @ a, size)


def check_agreement(
    name: str,
    given: ArrayLike,
    expected: ArrayLike,
    size: ArrayLike = 0.0,
    accuracy: float = ACCURACY,
) -> None:
    """Raises ValueError where two arrays (points, ...) differ; entries that are not finite in both
    do not count.

    Args:
      name: of the method, for the message.
      given, expected: what is compared.
      size: of the terms in `expected` at each entry, at least |expected|; the unit of `expected`.
      accuracy: largest difference as a share of the size.

    Raises:
      ValueError: a larger difference.
    """
    given, expected = np.asarray(given), np.asarray(expected)
    are_finite = np.isfinite(given) & np.isfinite(expected)
    are_not_finite = ~np.isfinite(given) & ~np.isfinite(expected)
    size = np.where(np.isfinite(size), size, 0.0)
    scale = np.maximum(np.abs(expected), size)[are_finite]
    distance = np.abs(given[are_finite] - expected[are_finite])
    is_equal = np.all(distance <= accuracy * scale)
    if is_equal and np.all(are_finite | are_not_finite) and np.any(are_finite | (given.size == 0)):
        return
    got = f"a difference of {np.max(distance, initial=0.0):.3g}"
    words = "methods that agree with the formulas of `Robot`, `Plant` or `Barrier`"
    remedy = "The proof uses these formulas; ij.testing has a check of each family."
    raise checks.fail(f"prove: {name}", checks.Words(got), words, remedy)


# --- plants in strict-feedback form ---------------------------------------------------------------


def agreement_of_plant(plant: plants.Plant) -> list[str]:
    """A sentence on a user's plant in strict-feedback form: its methods are compared with drift and
    gain, and row i with itself at other levels above i, at random points.

    Raises:
      ValueError: they disagree.
    """
    if type(plant) in PLANTS:
        return []
    generator = np.random.default_rng(0)
    x = generator.normal(size=(POINTS, plant.order, plant.n))
    above = generator.normal(size=(POINTS, plant.n))
    for name, pair in jax.vmap(lambda *y: dict(_plant_pairs(plant, *y)))(x, above).items():
        check_agreement(f"scenario.plant.{name}", *pair)
    kind = type(plant).__name__
    return [
        f"The methods of {kind} agree with its drift and gain, of which row i depends on"
        f" x_1 ... x_i only: compared at {POINTS} points."
    ]


def _plant_pairs(
    plant: plants.Plant, x: jax.Array, above: jax.Array
) -> Iterator[tuple[str, tuple[jax.Array, jax.Array, jax.Array]]]:
    """Name of a method and a level -> what it returns, what follows from drift and gain, and the
    size of the terms in it.
    """
    t = jnp.zeros(())
    drift, gain = plant.drift(t, x), plant.gain(t, x)
    for level in range(1, plant.order + 1):
        G = gain[level - 1]
        G = G if G.ndim == 2 else jnp.diag(G)
        rate = drift[level - 1] + G @ above
        size = jnp.abs(drift[level - 1]) + jnp.abs(G) @ jnp.abs(above)
        found = plants.level_rate(plant, level, t, x, above)
        yield f"level_rate of level {level}", (found, rate, size)
        found = plants.level_input(plant, level, t, x, rate)
        yield (
            f"level_input of level {level}",
            (found, above, jnp.full_like(above, jnp.max(jnp.abs(above)))),
        )
        found = plants.transposed_gain(plant, level, t, x, above)
        terms = jnp.abs(G.T) @ jnp.abs(above)
        yield f"transposed_gain of level {level}", (found, G.T @ above, terms)
        up_to_level = jnp.where(jnp.arange(plant.order)[:, None] < level, x, 0.0)
        without_levels = plants.level_rate(plant, level, t, up_to_level, above)
        name = f"drift and gain of level {level} without the levels above"
        yield name, (without_levels, rate, size)
