"""The initial estimate: linear regression of the torques on the motion.

    tau(t - d) = e(x; q, q', q") + noise

e is linear in masses, first and second moments, friction, damping, armature and gravity.  One
Gauss-Newton step therefore solves the problem where all parameters are of these kinds, and a few
steps do otherwise.  The motion comes from smoothed positions (`smoothing`), and each joint is
weighted by its residual torque.  Noise in q" biases the estimate, most of all in a closed loop that
reacts to the noise; the estimate is the start of the search only.

This module also detects a log that does not belong to the scenario: it tests which other unit or
order of columns would explain the torques.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.identification.coordinates import (
    DELAY_SCALE,
    Coordinates,
    drive_limit,
    scales,
    to_x,
    to_z,
)
from iblf_jax.identification.levenberg_marquardt import (
    WEAK_PRIOR,
    QuadraticModel,
    levenberg_marquardt,
)
from iblf_jax.identification.replay import InverseDynamics, inverse_dynamics
from iblf_jax.identification.smoothing import SmoothedMotion
from iblf_jax.world.robots import joint_names

if TYPE_CHECKING:
    from iblf_jax.simulation.scenario import Scenario


WEIGHT_UPDATES, STEPS_PER_UPDATE = 3, 12
"""Estimates of the joints' weights, and steps of the search for each of them."""
BARELY_EXPLAINED = 0.3
"""Share of the torques' variation below which the log does not belong to the model."""
POORLY_EXPLAINED = 0.9
"""Share of the variation of any joint's torque below which other units and columns are tested."""
WRONG_SIZE = 30.0
"""Ratio of the logged torque to that of the scenario's robot from which the unit is wrong."""
OTHER_ROBOT = 5.0
"""Factor of all masses from which the unit of the torques is wrong."""
OTHER_UNITS = {
    "with tau of the other sign": -1.0,
    "with tau in kgf m": 9.80665,
    "with tau in lbf ft": 1.35582,
    "with tau in lbf in": 0.112985,
}
"""Other units in which torques are logged, and their factors to N m."""
STANDSTILL_SPEED = 0.02
"""Speed, root mean square over all joints, below which a robot is at standstill [rad/s]."""
STANDSTILL_RANGE = 0.1
"""Range of motion that a robot at standstill does not have [rad]; with it, a low speed means that
the times are in another unit."""
RANGE_TOLERANCE = 0.1
"""Share of a joint's range by which a log may be outside the range."""


class InitialEstimate(NamedTuple):
    """The result of the regression."""

    z: np.ndarray
    delay: float
    scale: np.ndarray
    """Scales of x, (p,)."""
    explained: np.ndarray
    """Explained share of the variation of each torque, (n,)."""
    noise: np.ndarray
    """Standard deviation of the noise of the positions, (n,) [rad]."""


def initial_estimate(
    scenario: Scenario,
    c: Coordinates,
    motion: SmoothedMotion,
    limits: tuple[np.ndarray, np.ndarray],
) -> InitialEstimate:
    """The parameters from which the search starts.

    Args:
      scenario: scenario whose plant is identified.
      c: the coordinates.
      motion: the smoothed logs.
      limits: lower and upper limits of z, (p + 1,) each, the delay last.

    Raises:
      ValueError: the log does not belong to the scenario.
    """
    _check_motion(scenario, motion)
    first = inverse_dynamics_along(scenario, c, c.x, motion)
    _check_torque_size(scenario, first.torque, motion)
    scale = scales(c, scenario, np.asarray(first.by_x), motion.tau)
    z = np.append(to_z(c, c.x), np.clip(0.0, limits[0][-1], limits[1][-1]))
    z_scale = np.append(coordinate_scales(c, scale), DELAY_SCALE)
    spread = np.sqrt(np.mean((motion.tau - np.mean(motion.tau, axis=0)) ** 2, axis=0))
    sigma = spread + 1e-9
    residual = np.zeros_like(motion.tau)
    start = z
    for _ in range(WEIGHT_UPDATES):
        regression = _Regression(scenario, c, motion, start, z_scale, sigma)
        z, _, _ = levenberg_marquardt(
            regression.linearized(z),
            z,
            limits,
            z_scale,
            regression.trial,
            regression.linearized,
            STEPS_PER_UPDATE,
        )
        residual = regression.residual(regression.dynamics(z), z)
        sigma = np.sqrt(np.mean(residual**2, axis=0)) + 1e-3 * sigma
    explained = _explained(residual, motion.tau)
    if np.min(explained) < POORLY_EXPLAINED:
        _check_explained(scenario, c, motion, residual)
    _check_masses(c, to_x(c, z[:-1])[0])
    return InitialEstimate(z[:-1], float(z[-1]), scale, explained, motion.noise)


class _Regression(NamedTuple):
    """The least-squares problem of the torques for given weights of the joints."""

    scenario: Scenario
    coordinates: Coordinates
    motion: SmoothedMotion
    start: np.ndarray
    """z at the start, (p + 1,), the delay last."""
    scale: np.ndarray
    """Scales of z, (p + 1,)."""
    sigma: np.ndarray
    """Standard deviation of each joint's residual, (n,) [N m]."""

    def dynamics(self, z: np.ndarray) -> InverseDynamics:
        """The torques of the model at z, and their derivatives."""
        x, _ = to_x(self.coordinates, z[:-1])
        return inverse_dynamics_along(self.scenario, self.coordinates, x, self.motion)

    def residual(self, dynamics: InverseDynamics, z: np.ndarray) -> np.ndarray:
        """Logged less modelled torques, (P, n) [N m]."""
        return self.motion.tau - z[-1] * self.motion.dtau - np.asarray(dynamics.torque)

    def linearized(self, z: np.ndarray, dynamics: InverseDynamics | None = None) -> QuadraticModel:
        """The quadratic model at z; the dynamics there are computed if they are not given."""
        if dynamics is None:
            dynamics = self.dynamics(z)
        _, x_by_z = to_x(self.coordinates, z[:-1])
        r = self.residual(dynamics, z) / self.sigma
        by_z = -np.asarray(dynamics.by_x) @ x_by_z
        by_delay = -self.motion.dtau[..., None]
        J = np.concatenate([by_z, by_delay], axis=-1) / self.sigma[:, None]
        weak = 1.0 / (WEAK_PRIOR * self.scale) ** 2
        offset = z - self.start
        gradient = np.einsum("pna,pn->a", J, r) + weak * offset
        hessian = np.einsum("pna,pnb->ab", J, J) + np.diag(weak)
        cost = 0.5 * float(np.sum(r**2) + np.sum(weak * offset**2))
        return QuadraticModel(cost, gradient, hessian)

    def trial(self, here: QuadraticModel, z: np.ndarray, step: np.ndarray) -> tuple[float, Any]:
        """The objective after a step, and the dynamics there."""
        dynamics = self.dynamics(z + step)
        return self.linearized(z + step, dynamics).cost, dynamics


def coordinate_scales(c: Coordinates, scale: np.ndarray) -> np.ndarray:
    """The scales of z that follow from those of x."""
    scale = scale.copy()
    for first in c.bodies:
        scale[first : first + 6] = [1.0, 1.0, 1.0, *np.full(3, np.sqrt(scale[first]))]
    return scale


def inverse_dynamics_along(
    scenario: Scenario, c: Coordinates, x: np.ndarray, motion: SmoothedMotion
) -> InverseDynamics:
    """The torques that a smoothed motion needs with parameters x, and their derivatives."""
    points: list[Any] = [jnp.asarray(a) for a in (x, motion.t, motion.q, motion.dq, motion.ddq)]
    return inverse_dynamics(scenario, *points, places=c.places)


def _explained(residual: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Explained share of the variation of each torque, (n,)."""
    spread = np.sum((tau - tau.mean(axis=0)) ** 2, axis=0)
    return 1.0 - np.sum(residual**2, axis=0) / np.maximum(spread, 1e-300)


def _unexplained_share(residual: np.ndarray, tau: np.ndarray) -> float:
    """Unexplained share of the torques' variation, averaged over the joints, so that a wrong column
    of a small joint counts as well.
    """
    return float(np.mean(np.minimum(1.0 - _explained(residual, tau), 1.0)))


# ----------------------------------------------------------------- checks of the log


def _check_motion(scenario: Scenario, motion: SmoothedMotion) -> None:
    """Raises ValueError for a robot at standstill, or for a motion that is impossible."""
    speed = np.sqrt(np.mean(motion.dq**2, axis=0))
    _check_speed(motion, float(np.sqrt(np.sum(speed**2))))
    names = joint_names(scenario.plant, scenario.n)
    _check_positions(scenario, motion, names)
    logged = np.isfinite(motion.measured).all(axis=1)
    if not logged.any():
        return
    difference = np.sqrt(np.mean((motion.measured - motion.dq)[logged] ** 2, axis=0))
    worst = int(np.argmax(difference / (speed + 1e-6)))
    if difference[worst] > 0.5 * speed[worst] + 0.05:
        rms = np.sqrt(np.mean(motion.measured[logged, worst] ** 2))
        raise checks.fail(
            f"log: dq[{worst}] ({names[worst]})",
            checks.Words(f"{rms:.3g} rad/s (root mean square)"),
            f"the rate of q[{worst}], {speed[worst]:.3g} rad/s",
            "Check units and the order of the columns.",
        )


def _check_speed(motion: SmoothedMotion, speed: float) -> None:
    """Raises ValueError for a robot at standstill; `speed` is the root mean square [rad/s]."""
    if speed >= STANDSTILL_SPEED:
        return
    far, duration = float(np.max(np.ptp(motion.q, axis=0))), float(np.ptp(motion.t))
    if far > STANDSTILL_RANGE:
        raise checks.fail(
            "log: t",
            checks.Words(f"{far:.3g} rad of motion in {duration:.4g} s"),
            f"times in s, and motion of at least {STANDSTILL_SPEED:g} rad/s",
            "Divide times in ms by 1000.",
        )
    raise checks.fail(
        "log",
        checks.Words(
            f"a robot that stands still: its joints move at {speed:.2g} rad/s (root mean square)"
        ),
        f"motion of at least {STANDSTILL_SPEED:g} rad/s",
        "Log while it follows ij.excitation(scenario, paths).",
    )


def _check_positions(scenario: Scenario, motion: SmoothedMotion, names: tuple[str, ...]) -> None:
    """Raises ValueError for positions outside the ranges of the joints."""
    kinds = scenario.plant.kinds or ("revolute",) * scenario.n
    for range_name, limits in _ranges(scenario).items():
        for j, (low, high) in enumerate(limits):
            least, most = float(motion.q[:, j].min()), float(motion.q[:, j].max())
            tolerance = RANGE_TOLERANCE * (high - low)
            low_end, high_end = low - tolerance, high + tolerance
            if low_end <= least and most <= high_end:
                continue
            remedy = "Check units and the order of the columns."
            fits_in_degrees = low_end <= np.radians(least) and np.radians(most) <= high_end
            if kinds[j] == "revolute" and fits_in_degrees:
                remedy = "It would fit in degrees: convert it to rad."
            raise checks.fail(
                f"log: q[{j}] ({names[j]})",
                checks.Words(f"{least:.4g} to {most:.4g} rad"),
                f"positions inside {range_name}, {low:.4g} to {high:.4g} rad",
                remedy,
            )


def _ranges(scenario: Scenario) -> dict[str, np.ndarray]:
    """The ranges of the joints, (n, 2) each: the arm's limits, if it has any, and the bounds with a
    margin of 8 times their width.
    """
    found = {}
    limits = scenario.plant.limits
    if limits is not None:
        ends = np.stack([np.asarray(limits.lower), np.asarray(limits.upper)], axis=1)
        found["the arm's limits"] = np.where(np.isfinite(ends), ends, [-1e9, 1e9])
    tube = scenario.context.tube(jnp.zeros((), scenario.initial.q.dtype))
    low, high = np.asarray(tube.lower), np.asarray(tube.upper)
    wide = np.where(np.isfinite(high - low), np.maximum(1.0, high - low), np.inf)
    found["the scenario's bounds and 8 times their width around them"] = np.stack(
        [low - 8 * wide, high + 8 * wide], axis=1
    )
    return found


def _check_torque_size(scenario: Scenario, modelled: Any, motion: SmoothedMotion) -> None:
    """Raises ValueError for torques in another unit; `modelled` are those of the scenario's
    robot.
    """
    logged_rms, model_rms = (
        np.sqrt(np.sum(np.mean(np.asarray(x) ** 2, axis=0))) for x in (motion.tau, modelled)
    )
    ratio = logged_rms / max(model_rms, 1e-12)
    if ratio > WRONG_SIZE or ratio < 1.0 / WRONG_SIZE:
        raise checks.fail(
            "log: tau",
            checks.Words(
                f"{logged_rms:.3g} N m (root mean square), {ratio:.3g} times what the scenario's"
                " robot needs for this motion"
            ),
            f"about {model_rms:.3g} N m",
            "Convert it to N m (from N mm, from a motor's side of its gear, from amperes), or"
            " check q.",
        )
    effort = np.broadcast_to(drive_limit(scenario.plant.effort), (scenario.n,))
    most = np.max(np.abs(motion.tau), axis=0)
    if np.any(most > 3.0 * effort):
        j = int(np.argmax(most / effort))
        raise checks.fail(
            f"log: tau[{j}]",
            checks.Words(f"up to {most[j]:.4g} N m"),
            f"at most the joint's largest torque, {effort[j]:.4g} N m",
            "Convert it to N m.",
        )


def _check_masses(c: Coordinates, x: np.ndarray) -> None:
    """Raises ValueError for torques of a very different robot, all masses of which are many times
    larger or smaller.
    """
    links = [
        i
        for i, unit in enumerate(c.units)
        if unit == "kg" and c.x[i] > 0 and not re.search("payload|carried", c.names[i])
    ]
    factor = x[links] / c.x[links]
    if len(links) and (np.min(factor) > OTHER_ROBOT or np.max(factor) < 1.0 / OTHER_ROBOT):
        raise checks.fail(
            "log: tau",
            checks.Words(
                f"torques of a robot whose masses are {np.min(factor):.3g} to {np.max(factor):.3g}"
                " times the scenario's"
            ),
            f"masses within a factor of {OTHER_ROBOT:g}",
            "Convert tau to N m; or give the scenario masses that are nearer.",
        )


def _check_explained(
    scenario: Scenario, c: Coordinates, motion: SmoothedMotion, residual: np.ndarray
) -> None:
    """Raises ValueError if other columns or units explain the torques, or if nothing does."""
    unexplained = _unexplained_share(residual, motion.tau)
    best, best_reading = unexplained, ""
    same = inverse_dynamics_along(scenario, c, c.x, motion)
    for reading, other in _alternative_readings(motion):
        dynamics = same
        if other.q is not motion.q:
            dynamics = inverse_dynamics_along(scenario, c, c.x, other)
        # After one step of the linear regression.
        J = np.asarray(dynamics.by_x)
        r = other.tau - np.asarray(dynamics.torque)
        A = J.reshape(-1, J.shape[-1])
        weight = np.tile(1.0 / (other.tau.std(axis=0) + 1e-9), len(r))
        step = np.linalg.lstsq(A * weight[:, None], r.ravel() * weight, rcond=1e-6)[0]
        share = _unexplained_share(r - J @ step, other.tau)
        if share < min(0.5 * best, 1.0 - BARELY_EXPLAINED):
            best, best_reading = share, reading
    if best_reading:
        raise checks.fail(
            "log",
            checks.Words(
                f"torques of which these parameters explain {1.0 - unexplained:.0%}, the mean over"
                f" joints; {best_reading}, they would explain {1.0 - best:.0%}"
            ),
            "columns in order and SI units",
            "Check the log.",
        )
    spread = np.sum((motion.tau - motion.tau.mean(axis=0)) ** 2)
    explained = 1.0 - np.sum(residual**2) / spread
    if explained < BARELY_EXPLAINED:
        raise checks.fail(
            "log",
            checks.Words(f"torques of which these parameters explain {max(explained, 0.0):.0%}"),
            f"at least {BARELY_EXPLAINED:.0%}",
            "Check that the log is of this robot, its units and columns; or identify more"
            " parameters.",
        )


def _alternative_readings(motion: SmoothedMotion) -> Iterator[tuple[str, SmoothedMotion]]:
    """Other units, signs and orders of the columns: the description, and the log with them."""
    n = motion.q.shape[1]

    def changed(change: Any) -> SmoothedMotion:
        return motion._replace(q=change(motion.q), dq=change(motion.dq), ddq=change(motion.ddq))

    yield "with q in degrees", changed(np.radians)
    for words, factor in OTHER_UNITS.items():
        yield words, motion._replace(tau=factor * motion.tau)
    if n == 1:
        return
    for j in range(n):
        sign = np.where(np.arange(n) == j, -1.0, 1.0)
        turned, tau = changed(lambda x, sign=sign: sign * x), sign * motion.tau
        yield f"with tau[{j}] of the other sign", motion._replace(tau=tau)
        yield f"with q[{j}] of the other sign", turned
        yield f"with q[{j}] and tau[{j}] of the other sign", turned._replace(tau=tau)
    for i, j in itertools.combinations(range(n), 2):
        order = np.arange(n)
        order[[i, j]] = j, i
        moved, tau = changed(lambda x, order=order: x[:, order]), motion.tau[:, order]
        yield f"with tau[{i}] and tau[{j}] exchanged", motion._replace(tau=tau)
        yield f"with q[{i}] and q[{j}] exchanged", moved
        yield f"with joints {i} and {j} exchanged, q and tau", moved._replace(tau=tau)
