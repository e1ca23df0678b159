"""Free torques in place of the friction law near the standstill of a joint.

    tau_j - coulomb_j sign(q_j')    while joint j moves,
    tau_j + s_j u_a                 near its standstill, on piece a,    u_a ~ N(0, 1)

replace tau_j - coulomb_j tanh(q_j' / width_j).  Dry friction obeys Coulomb's law only away from
standstill.  Near standstill a joint sticks, creeps, breaks away or deflects a bristle, so no
friction law is assumed: while a joint is slower than a threshold, and for TIME_MARGIN before and
after, a free torque replaces its Coulomb friction.  This torque is constant over pieces of
PIECE_DURATION, and its standard deviation s_j is that of the joint's torque.  Elsewhere the
direction of friction is that of the logged motion.

A joint that hardly moves then contributes no information by its own equation of motion, because its
friction is unknown, but the equations of the other joints do.  The simulation has no jumps, so the
search converges from any start.  The free torques are eliminated with the starts of the windows
(`shooting`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.identification.coordinates import WIDTHS, Coordinates
from iblf_jax.identification.log import Log
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario

SPEED_THRESHOLDS, TIME_MARGIN, PIECE_DURATION = (0.05, 0.1, 0.2), 0.01, 0.01
"""[rad/s], a larger threshold being used if the smaller one leaves more than noise; [s]; [s]."""
WORTHWHILE_RATIO = 0.9
"""A larger threshold is accepted if it reduces the residual to less than this share."""
HALF_WINDOW = 0.02
"""Half of the time over which a speed is estimated [s]: at 500 Hz its standard deviation is then
20 1/s times that of a position."""
ACCEPTED_RATIO, REJECTED_RATIO = 1.02, 1.3
"""Residual of the friction law relative to that of free torques: up to the first the law is
accepted, and at the second its search stops."""
NO_FRICTION_WIDTH = 1e6
"""[rad/s]: a width for which Coulomb friction is negligible."""


class FreeTorques(NamedTuple):
    """The terms that replace the friction law in W windows of K steps."""

    by_x: np.ndarray
    """Derivative of the torque of each step and joint by the parameters, (W, K, n, p): minus the
    direction of motion for Coulomb friction, else 0."""
    torque: np.ndarray
    """Derivative of the same torque by the m free torques u of a window, (W, K, n, m) [N m]."""
    pieces: np.ndarray
    """Number of free torques of each joint, (W, n)."""
    fixed: np.ndarray
    """Parameters that are not estimated: the widths, (p,) bool."""
    speed_threshold: float = 0.0
    """Speed below which a joint is near standstill [rad/s]."""

    @property
    def share(self) -> np.ndarray:
        """Share of the time in which each joint has free torques, (n,)."""
        return np.mean(np.any(self.torque != 0.0, axis=-1), axis=(0, 1))


def no_free_torques(shape: tuple[int, ...], p: int) -> FreeTorques:
    """No free torques, for windows of positions (W, K + 1, n) and p parameters."""
    W, K, n = shape[0], shape[1] - 1, shape[2]
    return FreeTorques(
        np.zeros((W, K, n, p)), np.zeros((W, K, n, 0)), np.zeros((W, n)), np.zeros(p, bool)
    )


def free_torques_at_standstill(
    scenario: Scenario,
    c: Coordinates,
    w: Any,
    logs: list[Log],
    size: np.ndarray,
    speed_threshold: float,
) -> FreeTorques:
    """The free torques of the joints whose Coulomb friction and its width are identified.

    Args:
      scenario: scenario that is simulated.
      c: its coordinates.
      w: the windows.
      logs: all.
      size: s, (n,) [N m].
      speed_threshold: speed below which a joint is near standstill [rad/s].
    """
    found = no_free_torques(w.y.shape, len(c.x))
    pairs = list(friction_pairs(scenario, c))
    W, K, n = found.torque.shape[:3]
    direction = np.empty((W, K, n))
    for i, log in enumerate(logs):
        of_log = w.log == i
        samples = np.searchsorted(log.t, w.t[of_log][:, :-1])
        direction[of_log] = _motion_direction(log, speed_threshold)[samples]
    length = max(2, round(PIECE_DURATION / float(np.mean(np.diff(w.t)))))
    free = sorted({j for *_, j in pairs})
    parts = [
        [(j, part) for j in free for part in _pieces(direction[i, :, j] == 0.0, length)]
        for i in range(W)
    ]
    found = found._replace(
        torque=np.zeros((W, K, n, max(map(len, parts), default=0))), speed_threshold=speed_threshold
    )
    for i, own in enumerate(parts):
        for a, (j, part) in enumerate(own):
            found.torque[i, part, j, a] = size[j]
            found.pieces[i, j] += 1
    for coulomb, width, j in pairs:
        found.by_x[:, :, j, coulomb] = -direction[:, :, j]
        found.fixed[width] = True
    return found


def friction_pairs(scenario: Scenario, c: Coordinates) -> Iterator[tuple[int, int, int]]:
    """The indices of Coulomb friction and of its width, and the joint, where both are
    identified.
    """
    at = {}
    for place in c.places:
        for k, index in enumerate(np.ndindex(place.shape)):
            (tokens,) = paths.places(scenario, place.path + "".join(f"[{i}]" for i in index))
            at[tuple(tokens)] = place.start + k
    for (*owner, name, j), coulomb in at.items():
        width = at.get((*owner, WIDTHS.get(str(name), ""), j))
        if width is not None:
            yield coulomb, width, int(j)


def _motion_direction(log: Log, speed_threshold: float) -> np.ndarray:
    """The direction of motion of each joint, 1 or -1, and 0 near standstill, (N, n)."""
    found = np.zeros(log.q.shape)
    for segment in log.segments:
        if segment.stop - segment.start < 2:  # a single sample has no speed
            continue
        t = log.t[segment]
        speed = _speed(t, log.q[segment], log.step)
        slow_samples = _cumulative(np.abs(speed) < speed_threshold)
        first, last = (
            np.searchsorted(t, t - TIME_MARGIN),
            np.searchsorted(t, t + TIME_MARGIN, side="right"),
        )
        found[segment] = np.where(slow_samples[last] > slow_samples[first], 0.0, np.sign(speed))
    return found


def _speed(t: np.ndarray, q: np.ndarray, step: float) -> np.ndarray:
    """Slope of the line through the positions around each time, (N, n)."""
    half = max(HALF_WINDOW, 2.5 * step)
    k = np.arange(len(t))  # the neighbours, however far away they are
    first = np.minimum(np.searchsorted(t, t - half), np.maximum(k - 1, 0))
    last = np.maximum(np.searchsorted(t, t + half, side="right"), np.minimum(k + 2, len(t)))
    t, q = (t - t[0])[:, None], q - q[0]
    count = (last - first)[:, None]
    st, sq, stt, stq = (x[last] - x[first] for x in map(_cumulative, (t, q, t * t, t * q)))
    return (count * stq - st * sq) / (count * stt - st**2)


def _cumulative(x: np.ndarray) -> np.ndarray:
    """The sum of the rows before each row, and of all rows."""
    return np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, axis=0)])


def _pieces(slow: np.ndarray, length: int) -> list[Any]:
    """The steps of each piece."""
    steps = np.flatnonzero(slow)
    runs = np.split(steps, np.flatnonzero(np.diff(steps) > 1) + 1) if len(steps) else []
    return [part for run in runs for part in np.array_split(run, max(1, round(len(run) / length)))]
