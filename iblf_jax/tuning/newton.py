"""The default method for few gains: sequential quadratic programming with a Gauss-Newton matrix,
inside a trust region.

At z the objective is modelled by f + g.s + s.B.s/2 and every piece j of every requirement by e_j +
a_j.s + s.C_j.s/2, e_j = g_rj (`problem`) and a_j its exact slope: at an optimum several peaks are
at their limit at once, and each of them is then a constraint of its own.  The step solves, within
|s_i| <= delta and the limits of the gains,

    minimise  g.s + s.(B + sum_j y_j C_j).s/2 + rho sum_r v_r     subject to     c_j + a_j.s <= v_r,
    v_r >= 0      for the pieces j of r,

first with c_j = e_j, then, ROUNDS times, with c_j = e_j + s.C_j.s/2 at the step found; of these
steps the trial is the one at which the models promise most.  y are the multipliers of the programme
before.  A requirement that a share of B runs may break, k > 1 of them, has for its G_r the mean of
its k worst runs, which is exactly

    min over t of  t + sum_b max(0, max_j g_bj - t) / k,

so t and one u_b >= 0 a run are unknowns beside s.  rho is kept above the multipliers, so that the
trial is judged by the exact penalty function  f + rho sum_r max(0, G_r),  and is raised where that
lets the model break less: so requirements that cannot be kept together are broken as little as can
  be.

B = N + A: N is the Gauss-Newton matrix of this point, which forward mode gives for nothing.  A
makes up for what it leaves out, the second derivatives of the motion, and C_j is a piece's own;
both are learnt from changes of gradients by the symmetric rank-one update,

    A <- A + r r^T / (r.s),      r = (change of g) - B s;          C_j likewise, r = (change of a_j)
    - C_j s,

also after steps that are rejected.  Where runs are many, C_j is kept for the worst pieces of each
requirement alone.  delta grows and shrinks with how well the models foretold the penalty function.
A rejected step is tried again with c_j such that c_j + a_j.s is what was found (second-order
correction).  A trial that makes a run invalid is rejected and delta shrinks: numbers that are not
finite never reach z.

Source: R. Fletcher, Practical Methods of Optimization, 2nd ed., section 14.4 (the programme and its
  correction);
R. H. Byrd, J. Nocedal, R. A. Waltz, Optim. Methods Softw. 23 (2008) 645-665 (rho);
R. T. Rockafellar, S. Uryasev, J. Risk 2 (2000) 21-41 (the mean of the worst);
J. E. Dennis, D. M. Gay, R. E. Welsch, ACM Trans. Math. Softw. 7 (1981) 348-368 (A);
A. R. Conn, N. I. M. Gould, P. L. Toint, Math. Program. 50 (1991) 177-195 (rank-one updates in trust
regions).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from iblf_jax.core import checks
from iblf_jax.tuning import quadratic
from iblf_jax.tuning.parameters import Box
from iblf_jax.tuning.robust import worst_count

FIRST_RADIUS = 1.0
"""|s_i| of the first step: a factor e for a gain."""
LARGEST_RADIUS = 4.0
FLATTEST = 1e-6
"""Smallest eigenvalue of the model's matrix, relative to its largest."""
KEPT_BY = 1e-5
"""How far inside its limit a requirement is aimed at, in its scale: what is found shall keep it in
spite of rounding."""
LEAST_RHO, LARGEST_RHO, STEEPER = 2.0, 1e6, 10.0
"""rho, relative to the size of the objective, and by what it is raised."""
ROUNDS = 3
COLLAPSED = 1e-3
"""delta below which a start that would still go further is stuck: not even so near does the model
foretell anything."""
AT_END = 1e-6
"""Distance in z from the end of a range within which the end holds a gain."""
MOST_PIECES, MORE_RUNS = 200, 3
"""Pieces of one requirement in a programme, and runs where G_r is the mean of k of them, as a
multiple of k; the worst are taken."""
MOST_BENT = 4000
"""Pieces of one requirement whose curvature is kept.  With the 200 of a programme, 64 runs of two
joints took 26 values instead of 14."""


class Pieces(NamedTuple):
    """The requirements, as the method sees them; host."""

    owner: np.ndarray
    """Which requirement a piece is of, (M,)."""
    worst: tuple[int, ...]
    """Of how many of the worst runs G_r is the mean, for each requirement."""

    @staticmethod
    def of(counts: tuple[int, ...], shares: tuple[float, ...], runs: int) -> Pieces:
        """From the number of pieces of each requirement and the share of the runs that may break
        it.
        """
        return Pieces(
            np.repeat(np.arange(len(counts)), counts),
            tuple(worst_count(runs, share) for share in shares),
        )

    def broken(self, excess: np.ndarray) -> np.ndarray:
        """G_r, (R,), from the pieces' excess (B, M)."""
        found = [
            np.sort(np.max(excess[:, self.owner == r], axis=1))[-k:].mean()
            for r, k in enumerate(self.worst)
        ]
        return np.asarray(found).reshape(-1)


class Planned(NamedTuple):
    """A step, and what belongs to it."""

    step: np.ndarray
    change: float
    """Of f, as the model foretells it."""
    broken: np.ndarray
    """What the programme foretells for each requirement: v_r, (R,)."""
    duals: np.ndarray
    """Multiplier of each piece in each run, (B, M)."""
    prices: np.ndarray
    """Multiplier of each requirement, (R,)."""
    slope: np.ndarray
    """Gradient of the Lagrangian, (p,)."""


def definite(matrix: np.ndarray) -> np.ndarray:
    """The matrix with its eigenvalues raised to where it is safely positive definite."""
    size, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    size = np.maximum(size, FLATTEST * max(float(np.max(np.abs(size))), 1e-12))
    return (vectors * size) @ vectors.T


def planned(gradient, matrix, low, high, limits: Pieces, excess, slopes, rho: float) -> Planned:
    """The step of the head of this module.

    Args:
      gradient, matrix: g and B, made positive definite.
      low, high: of the step, (p,): trust region and limits of the gains.
      limits: what the pieces are.
      excess, slopes: e (B, M) and a (B, p, M).
      rho: price of breaking a requirement.
    """
    size, R = len(gradient), len(limits.worst)
    low, high = np.minimum(low, -1e-12), np.maximum(high, 1e-12)
    chosen = [_that_may_bind(limits, r, excess, slopes, np.maximum(-low, high)) for r in range(R)]
    counts = [
        len(np.unique(b)) if k > 1 else 0 for (b, _), k in zip(chosen, limits.worst, strict=True)
    ]
    # The unknowns: s, v, and t and u of the requirements that are means.
    own = np.cumsum([size + R, *(1 + n if n else 0 for n in counts)])
    width, table, right, signed = int(own[-1]), [], [], list(range(size, size + R))
    for r, ((b, m), k) in enumerate(zip(chosen, limits.worst, strict=True)):
        rows = np.zeros((len(b), width))
        rows[:, :size] = slopes[b, :, m]
        rows[:, own[r] if k > 1 else size + r] = -1.0
        table.append(rows)
        right.append(-excess[b, m] - KEPT_BY)
        if k > 1:
            rows[np.arange(len(b)), own[r] + 1 + np.unique(b, return_inverse=True)[1]] = -1.0
            signed += range(own[r] + 1, own[r + 1])
    for r, k in enumerate(limits.worst):
        if k > 1:
            mean = np.zeros((1, width))
            mean[0, own[r]], mean[0, own[r] + 1 : own[r + 1]], mean[0, size + r] = (
                1.0,
                1.0 / k,
                -1.0,
            )
            table.append(mean)
            right.append(np.zeros(1))
    table += [-np.eye(width)[signed], np.eye(size, width), -np.eye(size, width)]
    H, c = (
        np.zeros((width, width)),
        np.concatenate([gradient, np.full(R, rho), np.zeros(width - size - R)]),
    )
    H[:size, :size] = matrix
    x, y = quadratic.solve(
        H, c, np.concatenate(table), np.concatenate([*right, np.zeros(len(signed)), high, -low])
    )
    step, duals, prices, first = np.clip(x[:size], low, high), np.zeros_like(excess), np.zeros(R), 0
    for r, (b, m) in enumerate(chosen):
        duals[b, m] = y[first : first + len(b)]
        prices[r], first = duals[b, m].sum(), first + len(b)
    lagrangian = gradient + np.einsum("bm,bpm->p", duals, slopes)
    return Planned(
        step,
        float(gradient @ step + 0.5 * step @ matrix @ step),
        np.maximum(x[size : size + R], 0.0),
        duals,
        prices,
        lagrangian,
    )


def _that_may_bind(
    limits: Pieces, r: int, excess: np.ndarray, slopes: np.ndarray, most: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Run and piece of those pieces of a requirement that may count within steps of |s_i| <= most,
    the worst of them.
    """
    own, k = np.flatnonzero(limits.owner == r), limits.worst[r]
    reach = np.einsum("bpm,p->bm", np.abs(slopes[:, :, own]), most)
    high, low = excess[:, own] + reach, np.max(excess[:, own] - reach, axis=1, keepdims=True)
    may = high >= (low if k > 1 else np.maximum(low, -KEPT_BY))
    if k > 1:
        may[np.argsort(-np.max(excess[:, own], axis=1), kind="stable")[MORE_RUNS * k :]] = False
    b, m = np.nonzero(may)
    # A mean of k runs needs k runs: the worst piece of each comes before all others.
    further = (m != np.argmax(np.where(may, excess[:, own], -np.inf), axis=1)[b]) & (k > 1)
    room = max(MOST_PIECES, int(np.sum(~further)) if k > 1 else 0)
    worst = np.lexsort((-excess[b, own[m]], further))[:room]
    return b[worst], own[m[worst]]


class Newton:
    """The method, for S starts at once; its state is a dict of arrays."""

    converges = True
    """Whether it knows by itself when it is done."""
    penalised = False
    """Whether it wants the requirements in the loss."""

    def __init__(
        self,
        box: Box,
        tolerance: float = 1e-5,
        radius: float = FIRST_RADIUS,
        limits: Pieces | None = None,
        runs: int = 1,
    ):
        self.box, self.tolerance, self.radius, self.runs = box, tolerance, radius, runs
        self.limits = Pieces(np.zeros(0, int), ()) if limits is None else limits

    def _most_bent(self) -> list[int]:
        """Of how many pieces of each requirement the curvature is kept."""
        return [
            min(self.runs * int(np.sum(self.limits.owner == r)), MOST_BENT)
            for r in range(len(self.limits.worst))
        ]

    def init(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """The state before the first evaluation.

        Raises:
          ValueError: more runs than the memory holds, as each has a slope for every piece.
        """
        starts, size = z.shape
        pieces, R = len(self.limits.owner), len(self.limits.worst)
        bent = sum(self._most_bent())
        checks.fits("runs", self.runs, 8.0 * starts * size * (bent * size + self.runs * pieces))
        square = np.zeros((starts, size, size))
        return {
            "z": z.copy(),
            "loss": np.full(starts, np.inf),
            "gradient": np.zeros_like(z),
            "matrix": square,
            "secant": square.copy(),
            "excess": np.zeros((starts, self.runs, pieces)),
            "slopes": np.zeros((starts, self.runs, size, pieces)),
            "duals": np.zeros((starts, self.runs, pieces)),
            "places": np.zeros((starts, bent), int),
            "bends": np.zeros((starts, bent, size, size)),
            "prices": np.zeros((starts, R)),
            "rho": np.zeros(starts),
            "radius": np.full(starts, self.radius),
            "trial": z.copy(),
            "foretold": np.zeros(starts),
            "corrected": np.zeros(starts, bool),
            "residuals": np.full((starts, 3), np.nan),
            "fresh": np.zeros(starts, bool),
            "done": np.zeros(starts, bool),
            "stuck": np.zeros(starts, bool),
        }

    def restart(self, state: dict[str, np.ndarray], start: int) -> None:
        """After a change of the loss: evaluate again at the same z before the next step."""
        state["fresh"][start], state["done"][start] = False, False
        state["secant"][start], state["trial"][start] = 0.0, state["z"][start]
        state["radius"][start] = max(state["radius"][start], 0.1 * self.radius)

    def go_on(self, state: dict[str, np.ndarray], start: int) -> None:
        """After a change of the tolerance: the trial that was planned last is made."""
        state["done"][start] = False

    def begin(self, state: dict[str, np.ndarray], start: int, z: np.ndarray) -> None:
        """One start begins anew, at another z (p,)."""
        for name, x in self.init(z[None]).items():
            state[name][start] = x[0]

    def retire(self, state: dict[str, np.ndarray], start: int) -> None:
        """One start is given up: no more trials."""
        state["done"][start] = True

    def step(self, evaluate: Any, state: dict[str, np.ndarray]):
        """One trial for every start.

        Args:
          evaluate: function of z (S, p) -> `Slope` as NumPy arrays; of its value the loss is
            enough.
          state: changed in place.

        Returns:
          The trials (S, p) and what they gave.
        """
        trial = state["trial"].copy()
        found = evaluate(trial)
        for s in range(len(trial)):
            if not state["done"][s]:
                self._judge(state, s, trial[s], found)
        return trial, found

    def _merit(self, state, s: int, loss: float, excess: np.ndarray) -> float:
        return loss + state["rho"][s] * float(
            np.sum(np.maximum(self.limits.broken(excess) + KEPT_BY, 0.0))
        )

    def _judge(self, state, s: int, trial: np.ndarray, found) -> None:
        """Takes the trial of one start or leaves it, and plans the next."""
        none = np.zeros((self.runs, 0)), np.zeros((self.runs, len(trial), 0))
        excess, slopes = (found.excess[s], found.slopes[s]) if len(self.limits.owner) else none
        here = {
            "loss": float(found.value.loss[s]),
            "gradient": found.gradient[s],
            "matrix": found.hessian[s],
        }
        here |= {"excess": excess, "slopes": slopes}
        valid = all(np.all(np.isfinite(x)) for x in here.values())
        if not state["fresh"][s]:
            state["fresh"][s], state["done"][s] = True, not valid
            if valid:
                self._move(state, s, trial, here)
                self._plan(state, s)
            return
        step = trial - state["z"][s]
        size, foretold, gain = float(np.max(np.abs(step))), state["foretold"][s], -np.inf
        if valid:
            gain = self._merit(state, s, state["loss"][s], state["excess"][s]) - self._merit(
                state, s, here["loss"], excess
            )
            gain = gain / foretold if foretold > 0 else -np.inf
            self._learn(state, s, step, here)
        if gain > 1e-4:
            self._move(state, s, trial, here)
        elif valid and not state["corrected"][s] and self._correct(state, s, step, excess):
            return
        if gain < 0.25:
            state["radius"][s] = 0.4 * size
        elif gain > 0.7 and size > 0.9 * state["radius"][s]:
            state["radius"][s] = min(2 * state["radius"][s], LARGEST_RADIUS)
        self._plan(state, s)

    def _move(self, state, s: int, trial: np.ndarray, here: dict[str, Any]) -> None:
        state["z"][s] = trial
        for name, x in here.items():
            state[name][s] = x
        old, bends = state["places"][s].copy(), state["bends"][s].copy()
        chosen = [
            np.sort(self._worst(r, here["excess"], n)) for r, n in enumerate(self._most_bent())
        ]
        new = np.concatenate([np.zeros(0, int), *chosen])
        known, where = np.isin(new, old), np.argsort(old, kind="stable")
        state["places"][s] = new
        state["bends"][s] = 0.0
        state["bends"][s][known] = bends[where[np.searchsorted(old, new[known], sorter=where)]]

    def _worst(self, r: int, excess: np.ndarray, count: int) -> np.ndarray:
        """Places, in all pieces of all runs one after the other, of the worst pieces of a
        requirement.
        """
        own = np.flatnonzero(np.tile(self.limits.owner == r, self.runs))
        return own[np.argsort(-excess.ravel()[own], kind="stable")[:count]]

    def _bent(self, state, s: int, step: np.ndarray) -> np.ndarray:
        """s.C_j.s/2 of every piece, (B, M)."""
        found = np.zeros_like(state["excess"][s])
        found.flat[state["places"][s]] = 0.5 * np.einsum(
            "p,kpq,q->k", step, state["bends"][s], step
        )
        return found

    def _ends(self, state, s: int) -> tuple[np.ndarray, np.ndarray]:
        z, reach = state["z"][s], state["radius"][s]
        return np.maximum(self.box.low - z, -reach), np.minimum(self.box.high - z, reach)

    def _model(self, state, s: int, excess: np.ndarray, rho: float) -> Planned:
        bent = np.einsum(
            "k,kpq->pq", state["duals"][s].ravel()[state["places"][s]], state["bends"][s]
        )
        matrix = definite(state["matrix"][s] + state["secant"][s] + bent)
        return planned(
            state["gradient"][s],
            matrix,
            *self._ends(state, s),
            self.limits,
            excess,
            state["slopes"][s],
            rho,
        )

    def _foretold(self, state, s: int, step: np.ndarray) -> float:
        """By how much the penalty function falls, by the quadratic models of objective and
        pieces.
        """
        excess = (
            state["excess"][s]
            + np.einsum("p,bpm->bm", step, state["slopes"][s])
            + self._bent(state, s, step)
        )
        change = float(
            state["gradient"][s] @ step
            + 0.5 * step @ (state["matrix"][s] + state["secant"][s]) @ step
        )
        return self._merit(state, s, 0.0, state["excess"][s]) - self._merit(
            state, s, change, excess
        )

    def _plan(self, state, s: int) -> None:
        """The next trial of one start, or the end."""
        size = max(1e-3, abs(state["loss"][s]))
        excess = state["excess"][s]
        rho = min(
            max(2.0 * float(np.max(state["prices"][s], initial=0.0)), LEAST_RHO * size),
            LARGEST_RHO * size,
        )
        found = self._model(state, s, excess, rho)
        while found.broken.sum() > KEPT_BY and rho < LARGEST_RHO * size:
            other = self._model(state, s, excess, STEEPER * rho)
            if found.broken.sum() - other.broken.sum() < 0.01 * found.broken.sum():
                break
            found, rho = other, STEEPER * rho
        state["rho"][s] = (
            max(rho, 2.0 * float(np.max(found.prices, initial=0.0)))
            if found.broken.sum() <= KEPT_BY
            else rho
        )
        now = np.maximum(self.limits.broken(excess) + KEPT_BY, 0.0)
        promised = -found.change + state["rho"][s] * float(np.sum(now) - np.sum(found.broken))
        z, step = state["z"][s], found.step
        state["duals"][s], state["prices"][s] = found.duals, found.prices
        most, other = self._foretold(state, s, step), found
        for _ in range(ROUNDS if excess.size else 0):
            other = self._model(state, s, excess + self._bent(state, s, other.step), rho)
            told = self._foretold(state, s, other.step)
            if told > most:
                most, step = told, other.step
        state["trial"][s] = np.clip(z + step, self.box.low, self.box.high)
        state["foretold"][s], state["corrected"][s] = (
            (most if most > 0.1 * promised else promised),
            False,
        )
        held = ((z < self.box.low + AT_END) & (found.slope > 0)) | (
            (z > self.box.high - AT_END) & (found.slope < 0)
        )
        along = np.sum(found.duals * excess, axis=0)
        slack = sum(
            abs(float(np.sum(along[self.limits.owner == r]))) for r in range(len(self.limits.worst))
        )
        worst = float(np.max(self.limits.broken(excess), initial=-np.inf))
        state["residuals"][s] = (
            float(np.max(np.abs(np.where(held, 0.0, found.slope)))),
            max(worst, 0.0),
            slack,
        )
        kept = np.sum(now) <= KEPT_BY or np.sum(now) - np.sum(found.broken) < 1e-3 * np.sum(now)
        small = np.max(np.abs(found.step)) < 1e-7
        state["done"][s] = bool(small or (kept and promised < self.tolerance * size))
        held_back = np.max(np.abs(found.step)) > 0.9 * state["radius"][s]
        state["stuck"][s] = bool(state["done"][s] and held_back and state["radius"][s] < COLLAPSED)

    def _correct(self, state, s: int, step: np.ndarray, excess: np.ndarray) -> bool:
        """A second trial with the pieces' values as they were found; whether there is one."""
        if not len(self.limits.owner):
            return False
        found = self._model(
            state, s, excess - np.einsum("p,bpm->bm", step, state["slopes"][s]), state["rho"][s]
        )
        state["trial"][s] = np.clip(state["z"][s] + found.step, self.box.low, self.box.high)
        state["corrected"][s] = True
        return bool(
            np.max(np.abs(state["trial"][s] - state["z"][s] - step)) > 1e-3 * np.max(np.abs(step))
        )

    def _learn(self, state, s: int, step: np.ndarray, here: dict[str, Any]) -> None:
        """The symmetric rank-one updates."""
        _update(
            state["secant"][s],
            here["gradient"] - state["gradient"][s] - state["matrix"][s] @ step,
            step,
        )
        change = np.swapaxes(here["slopes"] - state["slopes"][s], 1, 2).reshape(-1, len(step))
        _update(state["bends"][s], change[state["places"][s]], step)


def _update(matrix: np.ndarray, change: np.ndarray, step: np.ndarray) -> None:
    """Makes matrix.step the change of a gradient, (..., p), where that is well determined; in
    place.
    """
    error = change - matrix @ step
    along = error @ step
    fine = np.abs(along) > 1e-8 * np.linalg.norm(error, axis=-1) * np.linalg.norm(step)
    error *= np.sqrt(np.where(fine, 1 / np.where(fine, np.abs(along), 1.0), 0.0))[..., None]
    matrix += np.sign(along)[..., None, None] * error[..., :, None] * error[..., None, :]
