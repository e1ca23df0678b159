"""`excitation`: a reference that makes a log tell much (D-optimality), inside all bounds.

    maximise  log det( sum_k Y_k^T W Y_k + REST 1 ),      Y_k = de/dx at (q_d, q_d', q_d")(t_k), x
    in scales, W the inverse square torques

over the waypoints of a spline, by the gradients that the identification follows.  Bounds on
positions and velocities, and the joints' largest speeds and torques, have a price while the search
lasts; at its end the motion is drawn together until all are kept.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.pytree import astype
from iblf_jax.identification.coordinates import coordinates, scales
from iblf_jax.identification.replay import Place, slopes
from iblf_jax.simulation.closed_loop import torque_needed
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.world.references import WaypointSpline

SPACING = 0.8
"""Time between waypoints, unless their number is given [s]."""
SAMPLES, DENSE = 25, 8
"""Times at which the motion counts, by waypoint; and how many times as many at which it must be
inside."""
BASIS_COPIES = 8
"""Matrices of position, velocity and acceleration in memory at once, with room for their use."""
REST = 1e-4
MARGIN = 0.1
"""Part of the room between bounds that is kept free on each side, for the errors of the law."""
TORQUE = 0.6
"""Part of a joint's largest torque that the motion may need."""
PRICE = 300.0
START = 0.5
"""Part of the room that the first, random motion takes."""


class Basis(NamedTuple):
    """Position, velocity and acceleration of a spline at K times, as matrices (K, m) on its
    waypoints.
    """

    t: Any
    position: Any
    velocity: Any
    acceleration: Any


class Room(NamedTuple):
    """What a motion must keep, besides the scenario's bounds."""

    speed: Any
    """(n,) [rad/s]."""
    torque: Any
    """(n,) [N m]."""


@notices.each_warning_once
def excitation(
    scenario: Scenario,
    paths: list[str],
    *,
    duration: float = 10.0,
    waypoints: int | None = None,
    iterations: int = 60,
    seed: int = 0,
) -> WaypointSpline:
    """A reference inside all bounds that makes a log tell these parameters well.

        maximise  log det sum_k Y_k^T W Y_k,     Y = dtau/dx along the reference
        (D-optimality)

    It starts and ends at rest, at the scenario's start where that can be held, and keeps a tenth of
    the room to its bounds for the law.

    Args:
      scenario: on a robot of n joints, with its bounds; velocity bounds, largest speeds and torques
        are kept where there are any.
      paths: of the leaves that will be looked for, as for `identify`.
      duration: of the motion [s].
      waypoints: of the spline; one each 0.8 s if not given.
      iterations: steps of the search, at most.
      seed: of the random motion that it starts from.

    Returns:
      A `WaypointSpline`: `ij.with_parts(scenario, reference=...)` follows it.

    Raises:
      ValueError: a path that does not move the plant, or bounds in which nothing can rest.

    Source: J. Swevers et al., IEEE Trans. Robot. Autom. 13 (1997) 730-740, for the idea.
    """
    duration = checks.time_span("duration", duration)
    count = _waypoints(duration, waypoints)
    iterations = checks.positive_integer("iterations", iterations, most=checks.MOST_STEPS)
    seed = checks.seed(seed)
    with jax.enable_x64(True):
        dtype = jnp.asarray(scenario.initial.q).dtype if isinstance(scenario, Scenario) else None
        start = canonical(astype(canonical(scenario), "float64"))
        replayed, c = coordinates(start, paths, {})
        times = tuple(np.linspace(0.0, duration, count).tolist())
        basis, dense = _basis(times, SAMPLES * count), _basis(times, DENSE * SAMPLES * count)
        room, middle = _room(replayed), _middle(replayed, times)
        rng = np.random.default_rng(seed)
        lower, upper = _bounds(replayed, jnp.asarray(times), jnp.asarray(middle))
        width = np.where(np.isfinite(np.asarray(upper - lower)), np.asarray(upper - lower), 2.0)
        guess = middle + START * 0.5 * width * rng.uniform(-1.0, 1.0, middle.shape)
        guess[[0, -1]] = middle[[0, -1]]
        guess = _drawn_together(replayed, dense, room, middle, guess)
        found = _information(replayed, basis, jnp.asarray(c.x), jnp.asarray(guess), places=c.places)
        by_x, torque = np.asarray(found.by_x), np.asarray(found.torque)
        scale, size = scales(c, replayed, by_x, torque), np.sqrt(np.mean(torque**2, axis=0)) + 1e-9
        price = partial(
            _price,
            replayed,
            basis,
            room,
            jnp.asarray(c.x),
            jnp.asarray(scale),
            jnp.asarray(size),
            places=c.places,
        )
        best = _minimum(price, middle, guess, iterations)
        best = _drawn_together(replayed, dense, room, middle, best)
    return WaypointSpline(times, np.asarray(best, dtype))


def _waypoints(duration: float, waypoints: int | None) -> int:
    """The number of waypoints; ValueError where the spline's matrices do not fit into the
    memory.
    """
    most = int((checks.memory() / (BASIS_COPIES * 8.0 * DENSE * SAMPLES)) ** 0.5)
    if waypoints is not None:
        return checks.positive_integer("waypoints", waypoints, least=4, most=most)
    if duration / SPACING > most:
        remedy = "Excite the robot by several shorter motions."
        raise checks.fail("duration", duration, f"at most {most * SPACING:g} s", remedy)
    return max(6, round(duration / SPACING))


def _basis(times: tuple[float, ...], count: int) -> Basis:
    """At `count` times."""
    t = jnp.linspace(0.0, times[-1], count)
    unit = WaypointSpline(times, np.eye(len(times)))

    def along(function):
        return lambda t: jax.jvp(function, (t,), (jnp.ones_like(t),))[1]

    velocity = along(unit.position)
    return Basis(t, *(jax.lax.map(x, t) for x in (unit.position, velocity, along(velocity))))


def _bounds(scenario: Scenario, t: jax.Array, q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Of positions at times t (K,), for a reference q (K, n); the arm's limits too."""
    bounds = scenario.bounds
    lower, upper = jax.vmap(bounds.lower.at)(t, q), jax.vmap(bounds.upper.at)(t, q)
    limits = getattr(scenario.plant, "limits", None)
    return (
        (lower, upper)
        if limits is None
        else (jnp.maximum(lower, limits.lower), jnp.minimum(upper, limits.upper))
    )


def _room(scenario: Scenario) -> Room:
    n = scenario.n
    speed, torque = (
        np.broadcast_to(np.asarray(getattr(scenario.plant, name, np.inf)), (n,))
        for name in ("speed", "effort")
    )
    return Room(jnp.asarray((1.0 - MARGIN) * speed), jnp.asarray(TORQUE * torque))


def _middle(scenario: Scenario, times: tuple[float, ...]) -> np.ndarray:
    """Waypoints of a motion that is surely inside: the start, where it can be held, else the middle
    of the bounds.
    """
    t = jnp.linspace(0.0, times[-1], 400)
    still = jnp.broadcast_to(scenario.initial.q, (len(t), scenario.n))
    lower, upper = _bounds(scenario, t, still)
    edge = MARGIN * jnp.where(jnp.isfinite(upper - lower), upper - lower, 0.0)
    if bool(jnp.all((still > lower + edge) & (still < upper - edge))):
        return np.broadcast_to(np.asarray(scenario.initial.q), (len(times), scenario.n)).copy()
    at = jnp.asarray(times)
    start = jnp.broadcast_to(scenario.initial.q, (len(times), scenario.n))
    lower, upper = _bounds(scenario, at, start)
    return np.asarray(jnp.where(jnp.isfinite(upper - lower), 0.5 * (lower + upper), start)).copy()


@partial(jax.jit, static_argnames="places")
def _information(
    scenario: Scenario,
    basis: Basis,
    x: jax.Array,
    waypoints: jax.Array,
    *,
    places: tuple[Place, ...],
) -> Any:
    motion = (
        basis.position @ waypoints,
        basis.velocity @ waypoints,
        basis.acceleration @ waypoints,
    )
    return slopes(scenario, x, basis.t, *motion, places=places)


def _beyond(
    scenario: Scenario, basis: Basis, room: Room, torque: jax.Array, waypoints: jax.Array
) -> list[jax.Array]:
    """By how much a motion is outside, in parts of the room, (K, n) each; negative inside."""
    q, dq = basis.position @ waypoints, basis.velocity @ waypoints
    lower, upper = _bounds(scenario, basis.t, q)
    width = jnp.where(jnp.isfinite(upper - lower), upper - lower, 1.0)
    found = [(lower - q) / width + MARGIN, (q - upper) / width + MARGIN]
    found += [
        jnp.where(jnp.isfinite(limit), jnp.abs(x) / limit - 1.0, -1.0)
        for x, limit in ((dq, room.speed), (torque, room.torque))
    ]
    if scenario.velocity_bounds is not None:
        bounds = scenario.velocity_bounds
        slow, fast = jax.vmap(bounds.lower.at)(basis.t, dq), jax.vmap(bounds.upper.at)(basis.t, dq)
        found += [(slow - dq) / (fast - slow) + MARGIN, (dq - fast) / (fast - slow) + MARGIN]
    return found


@partial(jax.jit, static_argnames="places")
def _price(scenario: Scenario, basis: Basis, room: Room, x, scale, size, waypoints, *, places):
    """What is minimised, and its gradient by the waypoints."""

    def price(waypoints):
        found = _information(scenario, basis, x, waypoints, places=places)
        Y = (found.by_x * scale / size[:, None]).reshape(-1, len(x))
        A = Y.T @ Y / len(basis.t) + REST * jnp.eye(len(x))
        outside = _beyond(scenario, basis, room, found.torque, waypoints)
        return -jnp.linalg.slogdet(A)[1] + PRICE * sum(
            jnp.mean(jnp.maximum(part, 0.0) ** 2) * len(x) for part in outside
        )

    return jax.value_and_grad(price)(waypoints)


def _minimum(price: Any, middle: np.ndarray, guess: np.ndarray, iterations: int) -> np.ndarray:
    from scipy.optimize import minimize

    def whole(inner):
        return np.concatenate([middle[:1], inner.reshape(-1, middle.shape[1]), middle[-1:]])

    def flat(inner):
        value, slope = price(jnp.asarray(whole(inner)))
        return float(value), np.asarray(slope)[1:-1].ravel()

    return whole(
        minimize(
            flat, guess[1:-1].ravel(), jac=True, method="L-BFGS-B", options={"maxiter": iterations}
        ).x
    )


@jax.jit
def _outside(scenario: Scenario, basis: Basis, room: Room, waypoints: jax.Array) -> jax.Array:
    motion = (
        basis.position @ waypoints,
        basis.velocity @ waypoints,
        basis.acceleration @ waypoints,
    )
    torque = jax.lax.map(lambda at: torque_needed(scenario, *at), (basis.t, *motion))
    return jnp.max(
        jnp.stack([jnp.max(part) for part in _beyond(scenario, basis, room, torque, waypoints)])
    )


def _drawn_together(
    scenario: Scenario, basis: Basis, room: Room, middle: np.ndarray, waypoints: np.ndarray
) -> np.ndarray:
    """The largest share of the motion about `middle` that is inside; raises ValueError if none
    is.
    """

    def inside(share):
        return (
            float(
                _outside(scenario, basis, room, jnp.asarray(middle + share * (waypoints - middle)))
            )
            <= 0.0
        )

    if inside(1.0):
        return waypoints
    low, high = 0.0, 1.0
    if not inside(low):
        raise checks.fail(
            "bounds",
            scenario.bounds,
            "room for a motion, with a tenth of it free on each side",
            "Widen the bounds, or change initial.q.",
        )
    for _ in range(math.ceil(math.log2(1e3))):
        share = 0.5 * (low + high)
        low, high = (share, high) if inside(share) else (low, share)
    return middle + low * (waypoints - middle)
