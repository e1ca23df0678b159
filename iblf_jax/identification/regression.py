"""The start: linear regression of the torques on the motion.

    tau(t - d) = e(x; q, q', q") + noise,    e linear in masses, first and second moments, friction,
    damping, armature, gravity

so that one Gauss-Newton step ends the search where all leaves are such, and a few do elsewhere.
The motion is smoothed (`smoothing`), and joints count by what is left of their torque.  Noise in q"
biases it, and the more so in a loop that reacts to the noise: it is a start, no more.

Here a log that does not belong to the scenario is told: what another unit or another order of its
  columns would explain is tried.
"""

from __future__ import annotations

import itertools
import re
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.identification.coordinates import Coordinates, scales, to_x, to_z
from iblf_jax.identification.log import Said
from iblf_jax.identification.replay import slopes
from iblf_jax.identification.search import WEAK, Around, search
from iblf_jax.identification.smoothing import Smoothed
from iblf_jax.world.robots import joint_names

ROUNDS = 3
LITTLE = 0.3
"""Share of the torques' variation below which the model explains nothing: the log does not belong
to it."""
POOR = 0.9
"""Share of any joint's below which it is looked whether units or columns are wrong."""
WRONG_SIZE = 30.0
"""Torques that are so many times what the scenario's numbers ask for are in another unit."""
OTHER_ROBOT = 5.0
"""Factor from which masses that all grew or shrank by it speak of another unit."""
OTHER_UNITS = {
    "with tau of the other sign": -1.0,
    "with tau in kgf m": 9.80665,
    "with tau in lbf ft": 1.35582,
    "with tau in lbf in": 0.112985,
}
"""Torques as they are logged too, and their factor to N m."""
SLOWEST = 0.02
"""Speed, root of the mean square over all joints, below which a robot stands still [rad/s]."""
FAR = 0.1
"""Motion that one who stands still does not make [rad]: if it is that slow, the times are in
another unit."""
OUTSIDE = 0.1
"""Part of a joint's range by which a log may be outside of it."""
LARGEST_DELAY = 0.1
"""[s]"""


class Start(NamedTuple):
    """What the regression found."""

    z: np.ndarray
    delay: float
    scale: np.ndarray
    """Of x, (p,)."""
    explained: np.ndarray
    """Share of each torque's variation, (n,)."""
    noise: np.ndarray
    """Of the positions, (n,) [rad]."""


def started(scenario: Any, c: Coordinates, seen: Smoothed, what: str, delay: float | None) -> Start:
    """Numbers to refine.

    Args:
      scenario: whose plant is looked for.
      c: the coordinates.
      seen: the logs, smoothed.
      what: the user's word for the log.
      delay: of the torque [s]; looked for if None.

    Raises:
      ValueError: the log does not belong to the scenario.
    """
    _moves(scenario, seen, what)
    first = _slopes(scenario, c, c.x, seen)
    _plausible(scenario, first.torque, seen, what)
    scale = scales(c, scenario, np.asarray(first.by_x), seen.tau)
    p, z0 = len(c.x), to_z(c, c.x)
    scale_z = np.append(coordinate_scales(c, scale), 0.01)
    sigma = np.sqrt(np.mean((seen.tau - np.mean(seen.tau, axis=0)) ** 2, axis=0)) + 1e-9
    fixed = 0.0 if delay is None else delay
    ends = (
        np.append(c.low, -LARGEST_DELAY if delay is None else fixed),
        np.append(c.high, LARGEST_DELAY if delay is None else fixed),
    )
    z, rest = np.append(z0, fixed), np.zeros_like(seen.tau)
    for _ in range(ROUNDS):

        def residual(torque, shift):
            return seen.tau - shift * seen.dtau - np.asarray(torque)

        def full(z, found, sigma=sigma):
            x, slope = to_x(c, z[:-1])
            found = _slopes(scenario, c, x, seen) if found is None else found
            r = residual(found.torque, z[-1]) / sigma
            J = (
                np.concatenate([-np.asarray(found.by_x) @ slope, -seen.dtau[..., None]], axis=-1)
                / sigma[:, None]
            )
            weak, away = 1.0 / (WEAK * scale_z) ** 2, z - np.append(z0, fixed)
            slope_ = np.einsum("pna,pn->a", J, r) + weak * away
            matrix = np.einsum("pna,pnb->ab", J, J) + np.diag(weak)
            return Around(0.5 * float(np.sum(r**2) + np.sum(weak * away**2)), slope_, matrix)

        def attempt(here, z, step):
            x, _ = to_x(c, (z + step)[:-1])
            found = _slopes(scenario, c, x, seen)
            return full(z + step, found).cost, found

        z, _, _ = search(full(z, None), z, ends, scale_z, attempt, full, 12)
        rest = residual(_slopes(scenario, c, to_x(c, z[:-1])[0], seen).torque, z[-1])
        sigma = np.sqrt(np.mean(rest**2, axis=0)) + 1e-3 * sigma
    explained = _explained(rest, seen.tau)
    if np.min(explained) < POOR:
        _say_what_is_wrong(scenario, c, seen, rest, what)
    _same_size(c, to_x(c, z[:-1])[0], what)
    return Start(z[:p], float(z[-1]), scale, explained, seen.noise)


def coordinate_scales(c: Coordinates, scale: np.ndarray) -> np.ndarray:
    """Scales of z, from those of x."""
    scale = scale.copy()
    for at in c.bodies:
        scale[at : at + 6] = [1.0, 1.0, 1.0, *np.full(3, np.sqrt(scale[at]))]
    return scale


def _slopes(scenario: Any, c: Coordinates, x: np.ndarray, seen: Smoothed) -> Any:
    arrays = (jnp.asarray(a) for a in (x, seen.t, seen.q, seen.dq, seen.ddq))
    return slopes(scenario, *arrays, places=c.places)


def _explained(rest: np.ndarray, tau: np.ndarray) -> np.ndarray:
    spread = np.sum((tau - tau.mean(axis=0)) ** 2, axis=0)
    return 1.0 - np.sum(rest**2, axis=0) / np.maximum(spread, 1e-300)


def _left(rest: np.ndarray, tau: np.ndarray) -> float:
    """Share of the torques' variation that is left, the mean over the joints: a small joint whose
    column is wrong is seen too.
    """
    return float(np.mean(np.minimum(1.0 - _explained(rest, tau), 1.0)))


# ------------------------------------------------------------------------------------------------------------ does it belong?


def _moves(scenario: Any, seen: Smoothed, what: str) -> None:
    """Raises ValueError for a robot that stands still, or that is where it cannot be."""
    speed = np.sqrt(np.mean(seen.dq**2, axis=0))
    if np.sqrt(np.sum(speed**2)) < SLOWEST:
        far, long = float(np.max(np.ptp(seen.q, axis=0))), float(np.ptp(seen.t))
        if far > FAR:
            raise checks.fail(
                f"{what}: t",
                Said(f"{far:.3g} rad of motion in {long:.4g} s"),
                f"times in s, and motion of at least {SLOWEST:g} rad/s",
                "Divide times in ms by 1000.",
            )
        raise checks.fail(
            what,
            Said(
                f"a robot that stands still: its joints move at {np.sqrt(np.sum(speed**2)):.2g}"
                " rad/s (root of the mean square)"
            ),
            f"motion of at least {SLOWEST:g} rad/s",
            "Log while it follows ij.excitation(scenario, paths).",
        )
    names = joint_names(scenario.plant, scenario.n)
    turns = [
        kind == "revolute" for kind in getattr(scenario.plant, "kinds", ("revolute",) * scenario.n)
    ]
    for name, row in _ranges(scenario).items():
        for j, (low, high) in enumerate(row):
            least, most = float(seen.q[:, j].min()), float(seen.q[:, j].max())
            room = OUTSIDE * (high - low)
            if least < low - room or most > high + room:
                degrees = (
                    turns[j] and low - room <= np.radians(least) and np.radians(most) <= high + room
                )
                remedy = (
                    "It would fit in degrees: convert it to rad."
                    if degrees
                    else "Check units and the order of the columns."
                )
                raise checks.fail(
                    f"{what}: q[{j}] ({names[j]})",
                    Said(f"{least:.4g} to {most:.4g} rad"),
                    f"positions inside {name}, {low:.4g} to {high:.4g} rad",
                    remedy,
                )
    logged = np.isfinite(seen.measured).all(axis=1)
    if logged.any():
        apart = np.sqrt(np.mean((seen.measured - seen.dq)[logged] ** 2, axis=0))
        worst = int(np.argmax(apart / (speed + 1e-6)))
        if apart[worst] > 0.5 * speed[worst] + 0.05:
            raise checks.fail(
                f"{what}: dq[{worst}] ({names[worst]})",
                Said(
                    f"{np.sqrt(np.mean(seen.measured[logged, worst] ** 2)):.3g} rad/s (root of the"
                    " mean square)"
                ),
                f"the rate of q[{worst}], {speed[worst]:.3g} rad/s",
                "Check units and the order of the columns.",
            )


def _ranges(scenario: Any) -> dict[str, np.ndarray]:
    """Where the joints can be: within the arm's limits, if it has any, and within a turn and a half
    of the bounds.
    """
    found = {}
    limits = getattr(scenario.plant, "limits", None)
    if limits is not None:
        found["the arm's limits"] = np.stack(
            [np.asarray(limits.lower), np.asarray(limits.upper)], axis=1
        )
        found = {
            name: np.where(np.isfinite(x), x, np.array([-1e9, 1e9])) for name, x in found.items()
        }
    tube = scenario.context.tube(jnp.zeros((), scenario.initial.q.dtype))
    low, high = np.asarray(tube.lower), np.asarray(tube.upper)
    wide = np.where(np.isfinite(high - low), np.maximum(1.0, high - low), np.inf)
    found["the scenario's bounds and 8 times their width around them"] = np.stack(
        [low - 8 * wide, high + 8 * wide], axis=1
    )
    return found


def _plausible(scenario: Any, needed: Any, seen: Smoothed, what: str) -> None:
    """Raises ValueError for torques in another unit."""
    own, asked = (np.sqrt(np.sum(np.mean(np.asarray(x) ** 2, axis=0))) for x in (seen.tau, needed))
    ratio = own / max(asked, 1e-12)
    if ratio > WRONG_SIZE or ratio < 1.0 / WRONG_SIZE:
        raise checks.fail(
            f"{what}: tau",
            Said(
                f"{own:.3g} N m (root of the mean square), {ratio:.3g} times what the scenario's"
                " robot needs for this motion"
            ),
            f"about {asked:.3g} N m",
            "Convert it to N m (from N mm, from a motor's side of its gear, from amperes), or"
            " check q.",
        )
    effort = np.asarray(getattr(scenario.plant, "effort", np.full(scenario.n, np.inf)))
    most = np.max(np.abs(seen.tau), axis=0)
    if np.any(most > 3.0 * effort):
        j = int(np.argmax(most / effort))
        raise checks.fail(
            f"{what}: tau[{j}]",
            Said(f"up to {most[j]:.4g} N m"),
            f"what the joint can give, {effort[j]:.4g} N m",
            "Convert it to N m.",
        )


def _same_size(c: Coordinates, x: np.ndarray, what: str) -> None:
    """Raises ValueError for torques that ask for quite another robot: all of its masses many times
    larger, or smaller.
    """
    links = [
        i
        for i, unit in enumerate(c.units)
        if unit == "kg" and c.x[i] > 0 and not re.search("payload|carried", c.names[i])
    ]
    factor = x[links] / c.x[links]
    if len(links) and (np.min(factor) > OTHER_ROBOT or np.max(factor) < 1.0 / OTHER_ROBOT):
        raise checks.fail(
            f"{what}: tau",
            Said(
                f"torques of a robot whose masses are {np.min(factor):.3g} to {np.max(factor):.3g}"
                " times the scenario's"
            ),
            f"masses within a factor of {OTHER_ROBOT:g}",
            "Convert tau to N m; or give the scenario masses that are nearer.",
        )


def _say_what_is_wrong(
    scenario: Any, c: Coordinates, seen: Smoothed, rest: np.ndarray, what: str
) -> None:
    """Raises ValueError if other columns or units explain the torques, or if nothing does."""
    spread = np.sum((seen.tau - seen.tau.mean(axis=0)) ** 2)
    share = 1.0 - np.sum(rest**2) / spread
    own, words = _left(rest, seen.tau), ""
    best = own
    same = _slopes(scenario, c, c.x, seen)
    for said, other in _otherwise(seen):
        found = same if other.q is seen.q else _slopes(scenario, c, c.x, other)
        J, r = np.asarray(found.by_x), other.tau - np.asarray(found.torque)
        A = J.reshape(-1, J.shape[-1])
        weight = np.tile(1.0 / (other.tau.std(axis=0) + 1e-9), len(r))
        step = np.linalg.lstsq(A * weight[:, None], r.ravel() * weight, rcond=1e-6)[0]
        left = _left(r - J @ step, other.tau)
        if left < min(0.5 * best, 1.0 - LITTLE):
            best, words = left, said
    if words:
        raise checks.fail(
            what,
            Said(
                f"torques of which these parameters explain {1.0 - own:.0%}, the mean over joints; "
                f"{words}, they would explain {1.0 - best:.0%}"
            ),
            "columns in order and SI units",
            "Check the log.",
        )
    if share < LITTLE:
        raise checks.fail(
            what,
            Said(f"torques of which these parameters explain {max(share, 0.0):.0%}"),
            f"at least {LITTLE:.0%}",
            "Check that the log is of this robot, its units and columns; or look for more"
            " parameters.",
        )


def _otherwise(seen: Smoothed) -> Any:
    """The log read in other ways, in words."""
    n = seen.q.shape[1]
    turn = np.pi / 180.0
    yield (
        "with q in degrees",
        seen._replace(q=seen.q * turn, dq=seen.dq * turn, ddq=seen.ddq * turn),
    )
    for words, factor in OTHER_UNITS.items():
        yield words, seen._replace(tau=factor * seen.tau)
    for j in range(n if n > 1 else 0):
        sign = np.where(np.arange(n) == j, -1.0, 1.0)
        yield f"with tau[{j}] of the other sign", seen._replace(tau=sign * seen.tau)
        turned = seen._replace(q=sign * seen.q, dq=sign * seen.dq, ddq=sign * seen.ddq)
        yield f"with q[{j}] of the other sign", turned
        yield f"with q[{j}] and tau[{j}] of the other sign", turned._replace(tau=sign * seen.tau)
    for i, j in itertools.combinations(range(n), 2):
        order = list(range(n))
        order[i], order[j] = j, i
        yield f"with tau[{i}] and tau[{j}] exchanged", seen._replace(tau=seen.tau[:, order])
        moved = seen._replace(q=seen.q[:, order], dq=seen.dq[:, order], ddq=seen.ddq[:, order])
        yield f"with q[{i}] and q[{j}] exchanged", moved
        yield (
            f"with joints {i} and {j} exchanged, q and tau",
            moved._replace(tau=seen.tau[:, order]),
        )
