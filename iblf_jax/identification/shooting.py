"""The refinement: simulation error over windows of the log, each with a start of its own (multiple
shooting).

    minimise over z, d and the starts s_w     1/2 sum_w sum_k sum_i rho((y_i(t_k) - q_i(t_k; s_w,
    x(z), d)) / sigma_i)

y are the logged positions, q the plant's under the logged torque, which is taken d seconds late.
The starts, 2 n numbers a window, are eliminated: with C = J_s^T W J_s, B = J_s^T W J_z of a window,

    A_w = J_z^T W J_z - B^T C^-1 B,     g_w = ... - B^T C^-1 h

are what it says of z, and sum over windows.  As noise is in y alone, not in q", nothing biases the
end; and what two windows say is independent but for z, so that the spread of the g_w says how well
z is known, whatever the noise is like within a window.

About the standstill of joints whose friction is looked for, torques may be free (`standstill`):
they are eliminated with the starts.

sigma_i is estimated in turn: what is left of joint i in a usual window (the median); in a window
  with more than STRANGE times that, what is
left there.  So windows in which the model lacks something (a contact, play) count for little where
others do without.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.identification.coordinates import Coordinates, to_x
from iblf_jax.identification.log import Log, Said
from iblf_jax.identification.replay import Slopes, Stretches, replayed, slopes_under, tangents
from iblf_jax.identification.search import WEAK, Around, search
from iblf_jax.identification.smoothing import around
from iblf_jax.identification.standstill import NONE, Free

HUBER = 1.345
"""Standard deviations beyond which a residual counts by its size, not its square ("huber"): 95 % as
good where noise is normal."""
FEWEST_STEPS = 8
USUAL_DELAY = 0.01
"""[s]; a stretch's first window begins so late, so that a torque that is late by less was
logged."""
MOVED = 0.02
"""Relative change of sigma at which it is settled."""
STRANGE = 1.5
ROUNDS, LATER = 6, 8
"""Times that sigma is estimated, and steps after the first."""
POINTS, STABLE = 200, 1.4
"""Points at which modes are looked at, and how many radians of the fastest one a step may take,
half of what RK4 bears."""


class Windows(NamedTuple):
    """The windows of all logs."""

    t: np.ndarray
    """(W, K + 1) [s]."""
    y: np.ndarray
    """(W, K + 1, n) [rad]."""
    log: np.ndarray
    """Which log, (W,)."""
    kept: np.ndarray
    """Which are fitted, (W,) bool; the others are held back."""
    q: np.ndarray
    """Starts, (W, n)."""
    dq: np.ndarray


class Torque:
    """The torque of a log as a function of time, integrated: held from sample to sample, or
    interpolated.
    """

    def __init__(self, log: Log, held: bool) -> None:
        dt = np.diff(log.t)[:, None]
        self.t, self.tau = log.t, log.tau
        rate = np.diff(log.tau, axis=0) / dt
        self.rate = np.concatenate(
            [np.zeros_like(rate) if held else rate, np.zeros((1, log.tau.shape[1]))]
        )
        steps = log.tau[:-1] * dt + 0.5 * self.rate[:-1] * dt**2
        self.sum = np.concatenate([np.zeros((1, log.tau.shape[1])), np.cumsum(steps, axis=0)])

    def until(self, t: np.ndarray) -> np.ndarray:
        """The integral from the first sample to t, (..., n)."""
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 1)
        s = (t - self.t[k])[..., None]
        return (
            self.sum[k] + self.tau[k] * s + 0.5 * self.rate[k] * np.maximum(s, 0.0) ** 2
        )  # before the first sample it was held

    def means(self, t: np.ndarray, delay: float) -> np.ndarray:
        """The mean torque of each step between times (..., K + 1), taken `delay` late, (..., K,
        n).
        """
        whole = self.until(t - delay)
        return np.diff(whole, axis=-2) / np.diff(t, axis=-1)[..., None]


def windows(logs: list[Log], length: float, held_back: list[float], held: bool) -> Windows:
    """Cuts logs into windows of one number of steps.

    Args:
      logs: checked.
      length: of a window [s].
      held_back: share of each log, at its end, that is not fitted.
      held: whether the torque is held.
    """
    steps = max(FEWEST_STEPS, round(length / max(log.step for log in logs)))
    t: list[Any] = []
    y, own, kept, q, dq = [], [], [], [], []
    for i, log in enumerate(logs):
        first = len(t)
        for stretch in log.stretches:
            for a in range(
                stretch.start + math.ceil(USUAL_DELAY / log.step), stretch.stop - steps, steps + 1
            ):
                now = slice(a, a + steps + 1)
                t.append(log.t[now])
                y.append(log.q[now])
                found, _, _ = around(log, stretch, float(log.t[a]), held)
                q.append(found[0])
                dq.append(found[1])
                own.append(i)
        count = len(t) - first
        back = round(held_back[i] * count)
        kept += [True] * (count - back) + [False] * back
    return Windows(*(np.array(x) for x in (t, y, own, kept, q, dq)))


class Told(NamedTuple):
    """What windows say at the end: per window, so that their spread can be seen."""

    residuals: np.ndarray
    """y - q, (W, K + 1, n)."""
    information: np.ndarray
    """A_w, (W, p + 1, p + 1), the last row and column of the delay."""
    scores: np.ndarray
    """g_w, (W, p + 1)."""


class Prior(NamedTuple):
    """What was known of x before."""

    mean: np.ndarray
    precision: np.ndarray
    """(p, p), zero where nothing was."""


class Refined(NamedTuple):
    """The end of the search."""

    z: np.ndarray
    """(p + 1,), the delay last."""
    told: Told
    left: np.ndarray
    """What is left of each joint over the windows that were fitted, had they no numbers of their
    own, (n,) [rad]."""
    free: Free
    """What was free in place of the law of friction."""
    steps: int


class Replay:
    """The problem of the head of this module, with its starts."""

    def __init__(
        self,
        scenario: Any,
        c: Coordinates,
        w: Windows,
        logs: list[Log],
        held: bool,
        loss: str,
        substeps: int,
        free: Free,
    ) -> None:
        self.scenario, self.c, self.w, self.loss, self.substeps, self.free = (
            scenario,
            c,
            w,
            loss,
            substeps,
            free,
        )
        self.torques = [Torque(log, held) for log in logs]
        self.step = min(log.step for log in logs)

    def torque(self, delay: float) -> np.ndarray:
        """Of each step, (W, K, n)."""
        found = np.empty((*self.w.t[:, 1:].shape, self.w.y.shape[-1]))
        for i, torque in enumerate(self.torques):
            own = self.w.log == i
            found[own] = torque.means(self.w.t[own], delay)
        return found

    def _numbers(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """x, with which the plant is replayed, and dx/dz; what is held does not depend on z."""
        x, slope = to_x(self.c, z[:-1])
        return np.where(self.free.held, NONE, x), np.where(self.free.held[:, None], 0.0, slope)

    def moved(self, z: np.ndarray, starts: np.ndarray) -> tuple[Stretches, np.ndarray, np.ndarray]:
        """The windows' motion: stretches, q and q' (W, K + 1, n)."""
        n, (x, _) = self.w.y.shape[-1], self._numbers(z)
        tau = (
            self.torque(z[-1])
            + self.free.by_x @ x
            + np.einsum("wknm,wm->wkn", self.free.torque, starts[:, 2 * n :])
        )
        stretches = Stretches(
            *(jnp.asarray(a) for a in (self.w.t, starts[:, :n], starts[:, n : 2 * n], tau))
        )
        q, dq = replayed(
            self.scenario, jnp.asarray(x), stretches, places=self.c.places, substeps=self.substeps
        )
        return stretches, np.asarray(q), np.asarray(dq)

    def weights(self, r: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """What each residual counts, (W, K + 1, n): 1 / sigma^2, less beyond HUBER sigma where that
        is asked for.
        """
        if self.loss == "squares":
            return np.broadcast_to(1.0 / sigma**2, r.shape)
        size = np.abs(r) / sigma
        return np.where(size > HUBER, HUBER / np.maximum(size, 1e-300), 1.0) / sigma**2

    def cost(self, r: np.ndarray, starts: np.ndarray, sigma: np.ndarray) -> float:
        """The sum of rho over the windows that are fitted, and of what their free torques cost."""
        size = (np.abs(r) / sigma)[self.w.kept]
        rho = (
            0.5 * size**2
            if self.loss == "squares"
            else np.where(size > HUBER, HUBER * (size - 0.5 * HUBER), 0.5 * size**2)
        )
        return float(np.sum(rho) + 0.5 * np.sum(starts[self.w.kept, 2 * self.w.y.shape[-1] :] ** 2))

    def refined(
        self,
        z: np.ndarray,
        ends: Any,
        scale: np.ndarray,
        sigma: np.ndarray,
        prior: Prior,
        most: int,
        hopeless: Any = np.inf,
    ) -> Refined:
        """The minimum.

        Args:
          z: where the search starts, (p + 1,), the delay last.
          ends: low and high of z.
          scale: of z.
          sigma: of the joints, to begin with, (n,) [rad].
          prior: what was known of x before.
          most: Gauss-Newton steps for each sigma.
          hopeless: what is left of a joint from which the search is given up, once it settled for
            the first sigma, (n,) [rad].

        Raises:
          ValueError: from the start on, the replay runs away from the log.
        """
        weak, z0 = 1.0 / (WEAK * scale) ** 2, z.copy()
        total = 0

        def full(z, found, sigma, known=None):
            _, stretches, q, dq = found
            r, (J, along) = self.w.y - q, known or self._slopes(z, stretches, q, dq)
            told, own, by_z = self._eliminated(r, J, sigma, found[0])
            x, slope = to_x(self.c, z[:-1])
            g, A = (
                np.sum(told.scores[self.w.kept], axis=0) + weak * (z - z0),
                np.sum(told.information[self.w.kept], axis=0) + np.diag(weak),
            )
            g[:-1] += slope.T @ prior.precision @ (x - prior.mean)
            A[:-1, :-1] += slope.T @ prior.precision @ slope
            return Around(
                cost(z, r, found[0], sigma),
                g,
                A,
                {"own": own, "by_z": by_z, "told": told, "known": (J, along), "found": found},
            )

        def cost(z, r, starts, sigma):
            away = to_x(self.c, z[:-1])[0] - prior.mean
            return self.cost(r, starts, sigma) + 0.5 * float(
                np.sum(weak * (z - z0) ** 2) + away @ prior.precision @ away
            )

        def attempt(here, z, step, sigma):
            after = here.carried["found"][0] + here.carried["by_z"] @ step + here.carried["own"]
            found = self.moved(z + step, after)
            return cost(z + step, self.w.y - found[1], after, sigma), (after, *found)

        starts, rest = self.best_starts(z, sigma)
        if not np.all(np.isfinite(rest)):
            raise checks.fail(
                "window",
                Said("windows in which the replay runs away"),
                "shorter ones",
                "Such as window=0.1.",
            )
        sigma = np.maximum(sigma, self._spread(rest))
        found, known = (starts, *self.moved(z, starts)), None
        for again in range(ROUNDS):
            here = full(z, found, sigma, known)
            most = LATER if again else most
            z, here, steps = search(
                here,
                z,
                ends,
                scale,
                partial(attempt, sigma=sigma),
                partial(full, sigma=sigma),
                most,
            )
            found, known, told = (
                here.carried["found"],
                here.carried["known"],
                here.carried["told"],
            )  # the same at another sigma
            before, sigma, total = sigma, self._spread(told.residuals), total + steps
            left = np.sqrt(
                np.mean((self._alone() * np.mean(told.residuals**2, axis=1))[self.w.kept], axis=0)
            )
            if np.any(left > hopeless):
                break
            finer, change = substeps_for(known[1], self.step), np.abs(sigma / before - 1.0)
            if finer > self.substeps:  # friction has become sharper
                self.substeps, found, known = finer, (found[0], *self.moved(z, found[0])), None
            elif max(np.median(change), np.mean(change)) < MOVED:
                break
        return Refined(z, told, left, self.free, total)

    def best_starts(self, z: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The starts that fit best with these numbers, (W, s), and what is left with them, (W, K +
        1, n).
        """
        starts = np.concatenate(
            [self.w.q, self.w.dq, np.zeros((len(self.w.q), self.free.torque.shape[-1]))], axis=1
        )
        for _ in range(2):
            stretches, q, dq = self.moved(z, starts)
            starts = (
                starts
                + self._eliminated(
                    self.w.y - q, self._slopes(z, stretches, q, dq)[0], sigma, starts
                )[1]
            )
        return starts, self.w.y - self.moved(z, starts)[1]

    def _spread(self, r: np.ndarray) -> np.ndarray:
        """What is left of each joint, window by window, (W, 1, n) [rad] (head of this module)."""
        own = (
            np.sqrt(self._alone() * np.mean(r**2, axis=1))
            if self.loss == "squares"
            else 1.4826 * np.median(np.abs(r), axis=1)
        )
        usual = np.median(own[self.w.kept], axis=0) + 1e-12
        return np.where(own > STRANGE * usual, own, usual)[:, None]

    def _alone(self) -> np.ndarray:
        """Mean square noise by what is left of it, (W, n): each window and joint has two numbers of
        its own, and its free torques.
        """
        K = self.w.y.shape[1]
        return K / np.maximum(K - 2.0 - self.free.pieces, 1.0)

    def _slopes(
        self, z: np.ndarray, stretches: Stretches, q: np.ndarray, dq: np.ndarray
    ) -> tuple[np.ndarray, Slopes]:
        """dq/d(start, z), (W, K + 1, n, s + p + 1), and what it is made of."""
        n, (x, slope) = q.shape[-1], self._numbers(z)
        h = np.diff(self.w.t)[..., None]
        tau = np.asarray(stretches.tau)
        middle = 0.5 * (q[:, 1:] + q[:, :-1]) - 0.125 * h * np.diff(dq, axis=1)
        points = (self.w.t[:, :-1] + 0.5 * h[..., 0], middle, 0.5 * (dq[:, 1:] + dq[:, :-1]), tau)
        flat = [jnp.asarray(a.reshape(-1, *a.shape[2:])) for a in points]
        along = slopes_under(self.scenario, jnp.asarray(x), *flat, places=self.c.places)
        along = along._replace(**{name: np.asarray(a) for name, a in along._asdict().items()})
        along = along._replace(by_x=along.by_x - self.free.by_x.reshape(along.by_x.shape))
        by_delay = (
            self.torque(z[-1] + 0.5 * self.step) - self.torque(z[-1] - 0.5 * self.step)
        ) / self.step
        J = tangents(
            stretches, along, np.concatenate([self.free.torque, by_delay[..., None]], axis=-1)
        )
        start, by_x, free, by_delay = np.split(J, [2 * n, 2 * n + len(x), J.shape[-1] - 1], axis=-1)
        return np.concatenate([start, free, by_x @ slope, by_delay], axis=-1), along

    def _eliminated(
        self, r: np.ndarray, J: np.ndarray, sigma: np.ndarray, starts: np.ndarray
    ) -> tuple[Told, np.ndarray, np.ndarray]:
        """What the windows say of z, the starts' own step (W, s), and how it follows z (W, s, p +
        1).
        """
        W, s, m = len(r), starts.shape[1], self.free.torque.shape[-1]
        w = np.sqrt(self.weights(r, sigma))
        wJ, wr = (w[..., None] * J).reshape(W, -1, J.shape[-1]), (w * r).reshape(W, -1)
        N = np.swapaxes(wJ, 1, 2) @ wJ
        g = -np.einsum("wma,wm->wa", wJ, wr)
        free = np.arange(s - m, s)
        N[:, free, free] += 1.0
        g[:, free] += starts[:, free]
        C, B, A = N[:, :s, :s], N[:, :s, s:], N[:, s:, s:]
        solved = np.linalg.solve(C, np.concatenate([B, g[:, :s, None]], axis=-1))
        by_z, own = -solved[..., :-1], -solved[..., -1]
        across = np.swapaxes(B, 1, 2)
        information = A + across @ by_z
        scores = g[:, s:] + np.einsum("wab,wb->wa", across, own)
        return Told(r, information, scores), own, by_z


def substeps_for(along: Slopes, step: float) -> int:
    """Steps of RK4 from sample to sample that keep the fastest mode of the plant well inside its
    stability range: a power of two.

    Args:
      along: at points of the motion; a few of them are looked at.
      step: from sample to sample [s].
    """
    n, count = along.mass.shape[-1], len(along.mass)
    chosen = np.linspace(0, count - 1, min(POINTS, count)).astype(int)
    mass, by_q, by_dq = (np.asarray(x)[chosen] for x in (along.mass, along.by_q, along.by_dq))
    stiffest = np.argmax(np.max(np.abs(np.asarray(along.by_dq)), axis=(1, 2)))
    mass, by_q, by_dq = (
        np.append(x, np.asarray(y)[stiffest, None], axis=0)
        for x, y in ((mass, along.mass), (by_q, along.by_q), (by_dq, along.by_dq))
    )
    F = np.zeros((len(mass), 2 * n, 2 * n))
    F[:, :n, n:] = np.eye(n)
    F[:, n:] = -np.linalg.solve(mass, np.concatenate([by_q, by_dq], axis=-1))
    fastest = float(np.max(np.abs(np.linalg.eigvals(F))))
    return 2 ** int(np.clip(np.ceil(np.log2(step * fastest / STABLE)), 0, 5))
