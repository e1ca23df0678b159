"""What a proof requires of parts that users write, and what it assumes of them.

The classes of the package whose properties its tests verify are in tables here, the classes
themselves: a class of the same name, or one that a user has registered, is not one of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control import barriers
from iblf_jax.core import checks
from iblf_jax.core.optional import has_members
from iblf_jax.core.time import as_at
from iblf_jax.proofs.examination import Examined, Operations, operations, refuse_unknown
from iblf_jax.world import bounds, plants, references, robots
from iblf_jax.world.robots._base import robot_member

BARRIERS = frozenset(
    [
        *(barriers.Integral, barriers.Log, barriers.Tan, barriers.State, barriers.Mapping),
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


def check_constant(name: str, part: Any) -> None:
    """Raises ValueError for a robot or plant with a method `at` that depends on the time."""
    if not has_members(part, "at"):
        return

    def leaves(t: jax.Array) -> list[Any]:
        return jax.tree.leaves(as_at(part, t))

    now = as_at(part, jnp.zeros(()))
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


def check_time_functions(reference: Any, sides: dict[str, Any], n: int) -> Examined:
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


def _declared(name: str, part: Any, found: Operations) -> str:
    """The sentence on a part with cases or kinks that declares its continuous derivatives."""
    refuse_unknown(f"scenario.{name}", found)
    kind = type(part).__name__
    if has_members(part, "continuous_derivatives"):
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


def agreement_of_robot(robot: Any) -> list[str]:
    """A sentence on the methods of a user's robot, which are compared at random points.

    Raises:
      ValueError: they disagree.
    """
    if _is_known(robot):
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


def _is_known(robot: Any) -> bool:
    """Whether a robot is one of the package."""
    if type(robot) is robots.WithMotors:
        return _is_known(robot.robot)
    return type(robot) in ROBOTS


def _robot_pairs(
    robot: Any, q: jax.Array, v: jax.Array, u: jax.Array, a: jax.Array
) -> Iterator[tuple[str, tuple[jax.Array, jax.Array]]]:
    """Name of a method -> what it returns, and what follows from M, C and G."""
    M, rate = jax.jvp(robot.mass_matrix, (q,), (v,))
    C_u = robot.coriolis(q, v, u)
    yield "mass_matrix", (M, M.T)
    yield "coriolis", (2.0 * jnp.dot(u, C_u), jnp.dot(u, rate @ u))
    yield "coriolis of a sum", (robot.coriolis(q, v, u + a), C_u + robot.coriolis(q, v, a))
    own = robot_member(robot, "momentum")
    if own is not None:
        yield "momentum", (own(q, v), M @ v)
    own = robot_member(robot, "energy_gradient")
    if own is not None:
        yield "energy_gradient", (own(q, v), rate @ v - robot.coriolis(q, v, v))
    own = robot_member(robot, "inverse_dynamics")
    if own is not None:
        yield "inverse_dynamics", (own(q, v, u, a), C_u + robot.gravity(q) + M @ a)


def check_agreement(name: str, given: Any, expected: Any, accuracy: float = ACCURACY) -> None:
    """Raises ValueError where two arrays (points, ...) differ; entries that are not finite in both
    do not count.
    """
    given, expected = np.asarray(given), np.asarray(expected)
    is_known = np.isfinite(given) & np.isfinite(expected)
    is_unknown = ~np.isfinite(given) & ~np.isfinite(expected)
    scale = max(1.0, np.max(np.abs(expected[is_known]), initial=0.0))
    distance = np.abs(given[is_known] - expected[is_known])
    is_equal = np.max(distance, initial=0.0) <= accuracy * scale
    if is_equal and np.all(is_known | is_unknown) and np.any(is_known | (given.size == 0)):
        return
    got = f"a difference of {np.max(distance, initial=0.0):.3g}"
    words = "methods that agree with the formulas of `Robot` or `Plant`"
    remedy = "The proof uses these formulas; ij.testing has a check of each family."
    raise checks.fail(f"prove: {name}", checks.Words(got), words, remedy)


# --- plants in strict-feedback form ---------------------------------------------------------------


def agreement_of_plant(plant: Any) -> list[str]:
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
    plant: Any, x: jax.Array, above: jax.Array
) -> Iterator[tuple[str, tuple[jax.Array, jax.Array]]]:
    """Name of a method and a level -> what it returns, and what follows from drift and gain."""
    t = jnp.zeros(())
    drift, gain = plant.drift(t, x), plant.gain(t, x)
    for level in range(1, plant.order + 1):
        G = gain[level - 1]
        product = G @ above if G.ndim == 2 else G * above
        transposed = G.T @ above if G.ndim == 2 else product
        rate = drift[level - 1] + product
        found = plants.level_rate(plant, level, t, x, above)
        yield f"level_rate of level {level}", (found, rate)
        found = plants.level_input(plant, level, t, x, rate)
        yield f"level_input of level {level}", (found, above)
        found = plants.transposed_gain(plant, level, t, x, above)
        yield f"transposed_gain of level {level}", (found, transposed)
        known = jnp.where(jnp.arange(plant.order)[:, None] < level, x, 0.0)
        alone = plants.level_rate(plant, level, t, known, above)
        yield f"drift and gain of level {level} without the levels above", (alone, rate)
