"""Where nobody's law of friction need hold: about the standstill of a joint, where the log decides.

    tau_j - coulomb_j sign(q_j')    while joint j moves,          tau_j + s_j u_a    about its
    standstill, on its piece a,    u_a ~ N(0, 1)

in place of tau_j - coulomb_j tanh(q_j' / width_j).  Dry friction is Coulomb's away from standstill
alone: there a joint sticks, creeps, breaks away, or acts through a bristle.  So while a joint is
  slower than SLOW, and AROUND before and after, a torque that is constant over
each PIECE is free in the place of its Coulomb friction, with s as large as the joint's torque;
elsewhere the log says the direction of the friction.  The row of a joint that hardly moves then
tells nothing, as its friction is not known; the rows of the other joints do.  And the replay has no
jumps: it is found from any start.  The free torques are eliminated with the starts of the windows
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

SLOW, AROUND, PIECE = (0.05, 0.1, 0.2), 0.01, 0.01
"""[rad/s], the next where the one before leaves more than noise; [s] and [s]."""
BETTER = 0.9
"""Part of what is left from which a larger SLOW is worth what it leaves open."""
HALF = 0.02
"""Half of the time over which a speed is looked at [s]: at 500 Hz it is then known to 20 1/s times
the noise of a position."""
WORSE, HOPELESS = 1.02, 1.3
"""Times what is left with free torques: the law of friction holds where it leaves no more than the
first, and is given up at the second."""
NONE = 1e6
"""[rad/s]: Coulomb friction over this width is none."""


class Free(NamedTuple):
    """What takes the place of the law of friction in W windows of K steps."""

    by_x: np.ndarray
    """Torque of each step and joint for one unit of each number, (W, K, n, p): the direction of the
    motion, for Coulomb friction."""
    torque: np.ndarray
    """The same for each of the m free torques of a window, (W, K, n, m) [N m]."""
    pieces: np.ndarray
    """How many of these are of each joint, (W, n)."""
    held: np.ndarray
    """Which numbers are not looked for: the widths, (p,) bool."""
    slow: float = 0.0
    """Speed below which joints are about standstill [rad/s]."""

    @property
    def share(self) -> np.ndarray:
        """Part of the time in which each joint is free, (n,)."""
        return np.mean(np.any(self.torque != 0.0, axis=-1), axis=(0, 1))


def by_the_law(shape: tuple[int, ...], p: int) -> Free:
    """Where nothing is free: for windows of positions (W, K + 1, n)."""
    W, K, n = shape[0], shape[1] - 1, shape[2]
    return Free(np.zeros((W, K, n, p)), np.zeros((W, K, n, 0)), np.zeros((W, n)), np.zeros(p, bool))


def free_about_standstill(
    scenario: Scenario, c: Coordinates, w: Any, logs: list[Log], size: np.ndarray, slow: float
) -> Free:
    """What is free of the joints whose Coulomb friction and its width are looked for.

    Args:
      scenario: that is replayed.
      c: its coordinates.
      w: the windows.
      logs: all.
      size: s, (n,) [N m].
      slow: speed below which a joint is about standstill [rad/s].
    """
    found, joints = by_the_law(w.y.shape, len(c.x)), list(_joints(scenario, c))
    W, K, n = found.torque.shape[:3]
    direction = np.empty((W, K, n))
    for i, log in enumerate(logs):
        own = w.log == i
        direction[own] = _direction(log, slow)[np.searchsorted(log.t, w.t[own][:, :-1])]
    length = max(2, round(PIECE / float(np.mean(np.diff(w.t)))))
    free = sorted({j for *_, j in joints})
    parts = [
        [(j, part) for j in free for part in _parts(direction[i, :, j] == 0.0, length)]
        for i in range(W)
    ]
    found = found._replace(torque=np.zeros((W, K, n, max(map(len, parts), default=0))), slow=slow)
    for i, own in enumerate(parts):
        for a, (j, part) in enumerate(own):
            found.torque[i, part, j, a] = size[j]
            found.pieces[i, j] += 1
    for coulomb, width, j in joints:
        found.by_x[:, :, j, coulomb], found.held[width] = -direction[:, :, j], True
    return found


def _joints(scenario: Scenario, c: Coordinates) -> Iterator[tuple[int, int, int]]:
    """The numbers of Coulomb friction and of its width, and the joint, where both are looked
    for.
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


def _direction(log: Log, slow: float) -> np.ndarray:
    """In which direction each joint moves, 1 or -1, and 0 about standstill, (N, n)."""
    found = np.zeros(log.q.shape)
    for stretch in log.stretches:
        if stretch.stop - stretch.start < 2:  # a row by itself has no speed
            continue
        t = log.t[stretch]
        speed = _speed(t, log.q[stretch], log.step)
        still = _before(np.abs(speed) < slow)
        first, last = np.searchsorted(t, t - AROUND), np.searchsorted(t, t + AROUND, side="right")
        found[stretch] = np.where(still[last] > still[first], 0.0, np.sign(speed))
    return found


def _speed(t: np.ndarray, q: np.ndarray, step: float) -> np.ndarray:
    """Slope of the line through the positions around each time, (N, n)."""
    half = max(HALF, 2.5 * step)
    k = np.arange(len(t))  # the neighbours, however far away they are
    first = np.minimum(np.searchsorted(t, t - half), np.maximum(k - 1, 0))
    last = np.maximum(np.searchsorted(t, t + half, side="right"), np.minimum(k + 2, len(t)))
    t, q = (t - t[0])[:, None], q - q[0]
    count = (last - first)[:, None]
    st, sq, stt, stq = (x[last] - x[first] for x in map(_before, (t, q, t * t, t * q)))
    return (count * stq - st * sq) / (count * stt - st**2)


def _before(x: np.ndarray) -> np.ndarray:
    """The sum of what is before each row, and of all."""
    return np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, axis=0)])


def _parts(slow: np.ndarray, length: int) -> list[Any]:
    """The steps of each piece."""
    steps = np.flatnonzero(slow)
    runs = np.split(steps, np.flatnonzero(np.diff(steps) > 1) + 1) if len(steps) else []
    return [part for run in runs for part in np.array_split(run, max(1, round(len(run) / length)))]
