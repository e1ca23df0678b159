"""`excitation`: a reference inside all bounds that makes parameters identifiable (D-optimality).

    maximise  log det( sum_k Y_k^T W Y_k + REGULARISATION 1 ),
    Y_k = de/dx at (q_d, q_d', q_d")(t_k), x in scales, W the inverse squares of the torques

over the waypoints of a spline, by the gradients that the identification uses.  Bounds on positions
and velocities, and the joints' largest speeds and torques, are penalised during the search.  At its
end the motion is scaled about a feasible one until it satisfies all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.progress import announced
from iblf_jax.core.pytree import astype
from iblf_jax.identification.coordinates import Coordinates, coordinates, drive_limit, scales
from iblf_jax.identification.replay import LeafSlice, inverse_dynamics
from iblf_jax.simulation.levels import torque_needed
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.world.references import WaypointSpline

WAYPOINT_SPACING = 0.8
"""Time between waypoints, unless their number is given [s]."""
SAMPLES_PER_WAYPOINT, CHECK_DENSITY = 25, 8
"""Times per waypoint at which the motion is evaluated, and the factor between these and the times
at which the bounds are checked."""
BASIS_COPIES = 8
"""Matrices of position, velocity and acceleration in memory at once, with room for their use."""
REGULARISATION = 1e-4
BOUND_MARGIN = 0.1
"""Share of the range between bounds that is left free on each side, for the errors of the law."""
TORQUE_SHARE = 0.6
"""Share of a joint's largest torque that the motion may need."""
PENALTY = 300.0
FIRST_SHARE = 0.5
"""Share of the range that the first, random motion covers."""


class Basis(NamedTuple):
    """Position, velocity and acceleration of a spline at K times, as matrices (K, m) on its
    waypoints.
    """

    t: jax.Array
    position: jax.Array
    velocity: jax.Array
    acceleration: jax.Array


class DriveLimits(NamedTuple):
    """Limits of the drives, which a motion satisfies besides the scenario's bounds."""

    speed: jax.Array
    """(n,) [rad/s]."""
    torque: jax.Array
    """(n,) [N m]."""


@notices.each_warning_once
@announced("searching for a trajectory that makes the parameters identifiable")
def excitation(
    scenario: Scenario,
    paths: list[str],
    *,
    duration: float = 10.0,
    waypoints: int | None = None,
    iterations: int = 60,
    seed: int = 0,
) -> WaypointSpline:
    """A reference inside all bounds whose log identifies these parameters well.

        maximise  log det sum_k Y_k^T W Y_k,     Y = dtau/dx along the reference
        (D-optimality)

    It starts and ends at rest, at the scenario's start where that can be held, and keeps a tenth of
    the drive to its bounds for the law.

    Args:
      scenario: on a robot of n joints, with its bounds; velocity bounds, largest speeds and torques
        are kept where there are any.
      paths: paths of the leaves to identify, as for `identify`.
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
    iterations = checks.positive_integer("iterations", iterations, most=checks.MAX_STEPS)
    seed = checks.seed(seed)
    with jax.enable_x64(True):
        dtype = jnp.asarray(scenario.initial.q).dtype if isinstance(scenario, Scenario) else None
        start = canonical(astype(canonical(scenario), "float64"))
        plant, c = coordinates(start, paths, {})
        times = tuple(np.linspace(0.0, duration, count).tolist())
        basis, dense = (
            _basis(times, SAMPLES_PER_WAYPOINT * count),
            _basis(times, CHECK_DENSITY * SAMPLES_PER_WAYPOINT * count),
        )
        limits = (plant.plant.speed, plant.plant.effort)
        speed, torque = (jnp.broadcast_to(jnp.asarray(drive_limit(x)), (plant.n,)) for x in limits)
        drive = DriveLimits((1.0 - BOUND_MARGIN) * speed, TORQUE_SHARE * torque)
        centre = _centre_motion(plant, times)
        # The search begins at random waypoints about a feasible motion.
        lower, upper = _bounds(plant, jnp.asarray(times), jnp.asarray(centre))
        width = np.asarray(upper - lower)
        width = np.where(np.isfinite(width), width, 2.0)
        shares = np.random.default_rng(seed).uniform(-1.0, 1.0, centre.shape)
        guess = centre + FIRST_SHARE * 0.5 * width * shares
        guess[[0, -1]] = centre[[0, -1]]
        guess = _scaled_to_fit(plant, dense, drive, centre, guess)
        objective = _scaled_objective(plant, basis, drive, c, guess)
        best = _minimum(objective, centre, guess, iterations)
        best = _scaled_to_fit(plant, dense, drive, centre, best)
    return WaypointSpline(times, np.asarray(best, dtype))


def _scaled_objective(
    scenario: Scenario, basis: Basis, drive: DriveLimits, c: Coordinates, guess: np.ndarray
) -> Callable:
    """The objective and its gradient as a function of the waypoints, in the scales of a guess."""
    x = jnp.asarray(c.x)
    found = _information(scenario, basis, x, jnp.asarray(guess), places=c.places)
    torque = np.asarray(found.torque)
    scale = scales(c, scenario, np.asarray(found.by_x), torque)
    size = np.sqrt(np.mean(torque**2, axis=0)) + 1e-9
    return partial(
        _objective,
        scenario,
        basis,
        drive,
        x,
        jnp.asarray(scale),
        jnp.asarray(size),
        places=c.places,
    )


def _waypoints(duration: float, waypoints: int | None) -> int:
    """The number of waypoints; ValueError where the spline's matrices do not fit into the
    memory.
    """
    most = int(
        (checks.memory() / (BASIS_COPIES * 8.0 * CHECK_DENSITY * SAMPLES_PER_WAYPOINT)) ** 0.5
    )
    if waypoints is not None:
        return checks.positive_integer("waypoints", waypoints, least=4, most=most)
    if duration / WAYPOINT_SPACING > most:
        remedy = "Excite the robot by several shorter motions."
        raise checks.fail("duration", duration, f"at most {most * WAYPOINT_SPACING:g} s", remedy)
    return max(6, round(duration / WAYPOINT_SPACING))


def _basis(times: tuple[float, ...], count: int) -> Basis:
    """At `count` times."""
    t = jnp.linspace(0.0, times[-1], count)
    unit = WaypointSpline(times, np.eye(len(times)))

    def along(function):
        return lambda t: jax.jvp(function, (t,), (jnp.ones_like(t),))[1]

    velocity = along(unit.position)
    return Basis(t, *(jax.lax.map(x, t) for x in (unit.position, velocity, along(velocity))))


def _bounds(scenario: Scenario, t: jax.Array, q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Bounds of positions at times t (K,), for a reference q (K, n), and the arm's limits."""
    lower = jax.vmap(scenario.bounds[0].lower.at)(t, q)
    upper = jax.vmap(scenario.bounds[0].upper.at)(t, q)
    limits = scenario.plant.limits
    if limits is None:
        return lower, upper
    return jnp.maximum(lower, limits.lower), jnp.minimum(upper, limits.upper)


def _centre_motion(scenario: Scenario, times: tuple[float, ...]) -> np.ndarray:
    """Waypoints of a feasible motion: rest at the start if it is feasible throughout, else the
    middle of the bounds.
    """
    t = jnp.linspace(0.0, times[-1], 400)
    rest = jnp.broadcast_to(scenario.initial.q, (len(t), scenario.n))
    lower, upper = _bounds(scenario, t, rest)
    edge = BOUND_MARGIN * jnp.where(jnp.isfinite(upper - lower), upper - lower, 0.0)
    start = jnp.broadcast_to(scenario.initial.q, (len(times), scenario.n))
    if bool(jnp.all((rest > lower + edge) & (rest < upper - edge))):
        return np.asarray(start).copy()
    lower, upper = _bounds(scenario, jnp.asarray(times), start)
    return np.asarray(jnp.where(jnp.isfinite(upper - lower), 0.5 * (lower + upper), start)).copy()


def _motion(basis: Basis, waypoints: jax.Array) -> tuple[jax.Array, ...]:
    """Position, velocity and acceleration at the times of a basis, (K, n) each."""
    return (
        basis.position @ waypoints,
        basis.velocity @ waypoints,
        basis.acceleration @ waypoints,
    )


@partial(jax.jit, static_argnames="places")
def _information(
    scenario: Scenario,
    basis: Basis,
    x: jax.Array,
    waypoints: jax.Array,
    *,
    places: tuple[LeafSlice, ...],
) -> Any:
    motion = _motion(basis, waypoints)
    return inverse_dynamics(scenario, x, basis.t, *motion, places=places)


def _violations(
    scenario: Scenario, basis: Basis, drive: DriveLimits, torque: jax.Array, waypoints: jax.Array
) -> list[jax.Array]:
    """By how much a motion is outside, in parts of the drive, (K, n) each; negative inside."""
    q, dq = basis.position @ waypoints, basis.velocity @ waypoints
    lower, upper = _bounds(scenario, basis.t, q)
    width = jnp.where(jnp.isfinite(upper - lower), upper - lower, 1.0)
    found = [(lower - q) / width + BOUND_MARGIN, (q - upper) / width + BOUND_MARGIN]
    found += [
        jnp.where(jnp.isfinite(limit), jnp.abs(x) / limit - 1.0, -1.0)
        for x, limit in ((dq, drive.speed), (torque, drive.torque))
    ]
    bounds = scenario.bounds[1]
    if bounds is not None:
        slow, fast = jax.vmap(bounds.lower.at)(basis.t, dq), jax.vmap(bounds.upper.at)(basis.t, dq)
        found += [
            (slow - dq) / (fast - slow) + BOUND_MARGIN,
            (dq - fast) / (fast - slow) + BOUND_MARGIN,
        ]
    return found


@partial(jax.jit, static_argnames="places")
def _objective(
    scenario: Scenario, basis: Basis, drive: DriveLimits, x, scale, size, waypoints, *, places
):
    """The objective to minimise, and its gradient by the waypoints."""

    def objective(waypoints):
        found = _information(scenario, basis, x, waypoints, places=places)
        Y = (found.by_x * scale / size[:, None]).reshape(-1, len(x))
        A = Y.T @ Y / len(basis.t) + REGULARISATION * jnp.eye(len(x))
        outside = _violations(scenario, basis, drive, found.torque, waypoints)
        return -jnp.linalg.slogdet(A)[1] + PENALTY * sum(
            jnp.mean(jnp.maximum(part, 0.0) ** 2) * len(x) for part in outside
        )

    return jax.value_and_grad(objective)(waypoints)


def _minimum(
    objective: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
    centre: np.ndarray,
    guess: np.ndarray,
    iterations: int,
) -> np.ndarray:
    from scipy.optimize import minimize

    def with_ends(inner):
        return np.concatenate([centre[:1], inner.reshape(-1, centre.shape[1]), centre[-1:]])

    def flat(inner):
        value, gradient = objective(jnp.asarray(with_ends(inner)))
        return float(value), np.asarray(gradient)[1:-1].ravel()

    return with_ends(
        minimize(
            flat, guess[1:-1].ravel(), jac=True, method="L-BFGS-B", options={"maxiter": iterations}
        ).x
    )


@jax.jit
def _largest_violation(
    scenario: Scenario, basis: Basis, drive: DriveLimits, waypoints: jax.Array
) -> jax.Array:
    motion = _motion(basis, waypoints)
    torque = jax.lax.map(lambda at: torque_needed(scenario, *at), (basis.t, *motion))
    return jnp.max(
        jnp.stack(
            [jnp.max(part) for part in _violations(scenario, basis, drive, torque, waypoints)]
        )
    )


def _scaled_to_fit(
    scenario: Scenario, basis: Basis, drive: DriveLimits, centre: np.ndarray, waypoints: np.ndarray
) -> np.ndarray:
    """The motion scaled about `centre` by the largest factor up to 1 that satisfies all limits;
    raises ValueError if there is none.
    """

    def is_feasible(factor):
        scaled = jnp.asarray(centre + factor * (waypoints - centre))
        return float(_largest_violation(scenario, basis, drive, scaled)) <= 0.0

    if is_feasible(1.0):
        return waypoints
    low, high = 0.0, 1.0
    if not is_feasible(low):
        raise checks.fail(
            "bounds",
            scenario.bounds,
            "room for a motion, with a tenth of it free on each side",
            "Widen the bounds, or change initial.q.",
        )
    for _ in range(math.ceil(math.log2(1e3))):
        factor = 0.5 * (low + high)
        if is_feasible(factor):
            low = factor
        else:
            high = factor
    return centre + low * (waypoints - centre)
