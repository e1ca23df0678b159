"""The loop of a tuning: steps of a method, multipliers, sharper and sharper peaks, the best so far,
early stop, checkpoint and resume.

The default method (`newton`) takes the requirements as they are.  Methods that know one loss only
(`penalised`) have them driven in by an augmented Lagrangian: whenever a start has converged (or
  after INNER steps),

    lam <- max(0, lam + mu G),     mu <- 5 mu where the largest G has not fallen to a quarter,

so a start that breaks them finds its way in while the penalty stays finite everywhere.  The best so
far is the one with the lowest objective among those that keep the requirements and the bounds, or,
while none does, the one that breaks them least, their G added up.

A peak in the objective is smoothed in the loss.  The smooth maximum lies above the maximum by
smoothing times a logarithm, so its bottom is not where the maximum's is; but it is soon found, and
narrow valleys are not in it.  So the loss is followed while it is made sharper: once all starts
have converged at the tolerance ROUGH (or after INNER steps, HASTY where several are left to choose
from), the smoothing is divided by SHARPER, the better half of the starts goes on and the others are
given up.  What counts as the best is judged without smoothing throughout.

Under limits, a single start takes turns with a second one (`probes`): it is followed to the
tolerance ROUGH, then, if that took no more than SOON values with derivatives, the second one, until
LONG values are spent; then the better of them goes on to the end.

A checkpoint holds the whole state after each step, written to a temporary file that is then
renamed.  A run that was killed goes on from there and gives the same numbers, bit by bit, as one
that was not.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from iblf_jax.core import checks
from iblf_jax.engine.plan import starts_together
from iblf_jax.tuning import problem
from iblf_jax.tuning.objectives import is_smoothed, sharper
from iblf_jax.tuning.problem import Formulation, Lane, ProblemInputs, Slope

INNER = 12
"""Steps at most between two updates of the multipliers, for methods that settle; others take this
many."""
FIRST_MU = 10.0
LARGEST_MU = 1e6
OUTER = 12
"""Updates of the multipliers at most."""
SHARPER = 4.0
ROUGH, HASTY = 1e-3, 6
"""Tolerance before the last sharpening, and steps at most of several starts without requirements:
what is found there is a place to go on from, and good enough to choose by."""

SOON, LONG = 25, 40
"""Values with derivatives of two searches that take turns: after how many at most the second
begins, and with how many both end."""


class CountedProblem:
    """The compiled problem on the host: coordinates in, NumPy arrays out; counts what it did."""

    def __init__(self, formulation: Formulation, shared: ProblemInputs, lanes: Lane, mode: str):
        self.formulation, self.shared, self.lanes = formulation, shared, lanes
        self.derive = Derive(problem.slope if mode == "forward" else problem.gradient, formulation)
        self.evaluations = 0
        starts, runs = lanes.index.shape
        self.group = starts_together(starts, runs)
        self.needed = np.ones(starts, bool)
        """Which starts are evaluated; the others come back invalid."""

    def __call__(self, z: np.ndarray) -> Slope:
        """Value and derivatives at z, (S, p), a group of needed starts at a time, so that all calls
        are of one compiled shape.
        """
        wanted = np.flatnonzero(self.needed)
        self.evaluations += len(wanted)
        lanes = self.lanes._replace(z=np.asarray(z, self.shared.dt.dtype))
        parts = []
        for first in range(0, len(wanted), self.group):
            rows = np.resize(wanted[first : first + self.group], self.group)
            found = self.derive(
                self.shared, jax.tree.map(lambda x, rows=rows: np.asarray(x)[rows], lanes)
            )
            parts.append(jax.tree.map(np.asarray, found))
        found = jax.tree.map(lambda *x: np.concatenate(x)[: len(wanted)], *parts)
        return found if len(wanted) == len(z) else _spread(found, wanted, len(z))

    def row(self, s: int) -> tuple[ProblemInputs, Lane]:
        """What belongs to one start."""
        return self.shared, jax.tree.map(lambda x: np.asarray(x)[s : s + 1], self.lanes)


def _spread(found: Slope, rows: np.ndarray, starts: int) -> Slope:
    """What was found for some starts, among all of them; the others are invalid, with losses that
    are infinite.
    """

    def placed(x: np.ndarray) -> np.ndarray:
        whole = np.full(
            (starts, *x.shape[1:]), np.nan if np.issubdtype(x.dtype, np.floating) else 0, x.dtype
        )
        whole[rows] = x
        return whole

    found = jax.tree.map(placed, found)
    found.value.loss[~found.value.valid] = np.inf
    return found


class Derive:
    """A compiled problem with its formulation; hashable by both, so that it can be static."""

    def __init__(self, function: Callable, formulation: Formulation):
        self.function, self.formulation = function, formulation

    def __call__(self, shared: ProblemInputs, lanes: Lane) -> Slope:
        """Value and derivatives of every lane."""
        return self.function(shared, lanes, formulation=self.formulation)

    def __hash__(self) -> int:
        return hash((self.function, self.formulation))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Derive) and (self.function, self.formulation) == (
            other.function,
            other.formulation,
        )


class Loop:
    """State of a tuning, all of it arrays in `state`; `run` goes on from wherever it is."""

    def __init__(
        self,
        evaluator: CountedProblem,
        method: Any,
        z: np.ndarray,
        *,
        resample: bool = False,
        sharpenings: int = 0,
    ):
        self.evaluator, self.method, self.resample = evaluator, method, resample
        self.smoothest, self.sharpenings = evaluator.shared.objective, sharpenings
        starts, count = len(z), len(evaluator.formulation.shares)
        terms = len(evaluator.shared.objective.terms)
        self.runs = evaluator.lanes.index.shape[1]
        self.state: dict[str, Any] = {
            "method": method.init(z),
            "iteration": np.asarray(0),
            "evaluations": np.asarray(0),
            "lam": np.zeros((starts, count)),
            "mu": np.full(starts, FIRST_MU),
            "since": np.zeros(starts, int),
            "outer": np.zeros(starts, int),
            "worst": np.full(starts, np.inf),
            "finished": np.zeros(starts, bool),
            "retired": np.zeros(starts, bool),
            "waiting": np.zeros(starts, bool),
            "stale": np.asarray(0),
            "stage": np.asarray(0),
            "stage_steps": np.asarray(0),
            "best_z": z.copy(),
            "best_key": np.full((starts, 2), np.inf),
            "best_terms": np.full((starts, terms), np.nan),
            "best_excess": np.full((starts, count), np.nan),
        }
        self.penalised = method.penalised
        self.history: dict[str, list[np.ndarray]] = {}
        self.second: Callable[[np.ndarray], np.ndarray | None] | None = None
        """Called where the first start began and ended, (2, p); where the second begins, or
        None."""

    def take_turns(self, second: Callable[[np.ndarray], np.ndarray | None]) -> None:
        """Of two starts, the second waits until the first has arrived, and begins where `second`
        says.
        """
        self.second = second
        self.sharpenings = max(self.sharpenings, 1)
        self.state["waiting"][1] = self.state["finished"][1] = True
        self.method.retire(self.state["method"], 1)

    def run(
        self, iterations: int, *, tolerance: float, patience: int, on_step: Callable[[Loop], None]
    ) -> str:
        """Steps until done; returns why it stopped."""
        state = self.state
        while int(state["iteration"]) < iterations:
            done, stale = bool(np.all(state["finished"])), int(state["stale"]) >= patience
            if int(state["stage"]) < self.sharpenings:
                most = HASTY if np.sum(~state["retired"]) > 1 else INNER
                many = state["lam"].shape[1] == 0 and int(state["stage_steps"]) >= most
                if done or stale or many:
                    self._sharpen()
            elif done or stale:
                return "converged" if done else f"no improvement in {patience} steps"
            self._enter(tolerance)
            self._step(tolerance)
            on_step(self)
        return "converged" if np.all(state["finished"]) else "iterations used up"

    @property
    def best(self) -> int:
        """The start that found the best so far."""
        return min(
            range(len(self.state["best_key"])), key=lambda s: tuple(self.state["best_key"][s])
        )

    def _enter(self, tolerance: float) -> None:
        """Makes loss and tolerance those of the stage that the state says."""
        stage = int(self.state["stage"])
        if self.sharpenings:
            objective = sharper(self.smoothest, SHARPER**-stage)
            self.evaluator.shared = self.evaluator.shared._replace(objective=objective)
            self.method.tolerance = (
                tolerance if stage == self.sharpenings else max(tolerance, ROUGH)
            )

    def _sharpen(self) -> None:
        """On to a sharper loss, with the better half of the starts that are left."""
        state = self.state
        left = np.flatnonzero(~state["retired"])
        order = sorted(left.tolist(), key=lambda s: tuple(state["best_key"][s]))
        for s in order[: -(-len(order) // 2)]:
            state["finished"][s] = False
            state["since"][s], state["outer"][s] = 0, 0
            if is_smoothed(self.smoothest):
                self.method.restart(state["method"], s)
            else:
                self.method.go_on(state["method"], s)
        for s in order[-(-len(order) // 2) :]:
            state["finished"][s] = state["retired"][s] = True
            self.method.retire(state["method"], s)
        state["stage"], state["stage_steps"], state["stale"] = (
            state["stage"] + 1,
            np.asarray(0),
            np.asarray(0),
        )

    def _step(self, tolerance: float) -> None:
        state, evaluator = self.state, self.evaluator
        index = evaluator.lanes.index
        if self.resample:
            index = np.broadcast_to(
                np.arange(self.runs, dtype=np.uint32)
                + np.uint32(self.runs * int(state["iteration"])),
                index.shape,
            )
        evaluator.lanes = evaluator.lanes._replace(
            lam=state["lam"].copy(), mu=state["mu"].copy(), index=index
        )
        before, evaluator.needed = evaluator.evaluations, ~state["finished"]
        z, found = self.method.step(evaluator, state["method"])
        state["evaluations"] = state["evaluations"] + (evaluator.evaluations - before)
        improved = self._keep_best(z, found, tolerance)
        state["stale"] = np.asarray(0) if improved else state["stale"] + 1
        self._record(z, found)
        for s in range(len(z)):
            self._outer(s, found)
        if self.second is not None and not state["stage"]:
            self._turn(self.second)
        state["iteration"], state["stage_steps"] = state["iteration"] + 1, state["stage_steps"] + 1

    def _turn(self, second: Callable[[np.ndarray], np.ndarray | None]) -> None:
        """Lets the second start begin where the first has soon arrived, and ends it where it takes
        long.
        """
        state = self.state
        if state["waiting"][1]:
            if not state["finished"][0]:
                return
            state["waiting"][1] = False
            begins = (
                second(np.stack([self.history["z"][0][0], state["method"]["z"][0]]))
                if state["evaluations"] <= SOON
                else None
            )
            if begins is not None:
                self.method.begin(state["method"], 1, begins)
                state["finished"][1], state["since"][1], state["stale"] = False, 0, np.asarray(0)
        elif state["evaluations"] >= LONG:
            state["finished"][1] = True

    def _keep_best(self, z: np.ndarray, found: Slope, tolerance: float) -> bool:
        state, improved = self.state, False
        for s in range(len(z)):
            if not found.value.valid[s]:
                continue
            excess = found.value.exact_excess[s]
            broken = float(np.sum(np.maximum(excess, 0.0))) + max(
                -float(found.value.margin[s]), 0.0
            )
            key = (broken, float(found.value.objective[s]))
            old = state["best_key"][s]
            if not np.isfinite(key[1]) or key >= tuple(old):
                continue
            overall = tuple(min(map(tuple, state["best_key"])))
            small = tolerance * max(1e-3, abs(key[1]))
            improved |= key[0] < overall[0] - tolerance or key[1] < overall[1] - small
            state["best_key"][s], state["best_z"][s] = key, z[s]
            state["best_terms"][s], state["best_excess"][s] = found.value.terms[s], excess
        return improved

    def _record(self, z: np.ndarray, found: Slope) -> None:
        value = found.value
        entries = {
            "z": z,
            "loss": value.loss,
            "objective": value.objective,
            "terms": value.terms,
            "excess": value.exact_excess,
            "margin": value.margin,
            "gradient_norm": np.linalg.norm(found.gradient, axis=-1),
            "valid": value.valid,
            "evaluations": self.state["evaluations"],
        }
        for name, x in entries.items():
            self.history.setdefault(name, []).append(np.array(x))

    def _outer(self, s: int, found: Slope) -> None:
        """Updates the multipliers of one start when it is time, or marks it finished."""
        state = self.state
        done = bool(state["method"]["done"][s])
        state["since"][s] += 1
        if state["finished"][s] or not (done or state["since"][s] >= INNER):
            return
        if not self.penalised or state["lam"].shape[1] == 0 or not found.value.valid[s]:
            state["finished"][s] = done
            return
        excess = found.value.excess[s]
        new = np.maximum(0.0, state["lam"][s] + state["mu"][s] * excess)
        worst = float(np.max(np.maximum(excess, -state["lam"][s] / state["mu"][s])))
        if done and (abs(worst) < 1e-3 or state["outer"][s] >= OUTER):
            state["finished"][s] = True
            return
        if max(worst, 0.0) > 0.25 * state["worst"][s]:
            state["mu"][s] = min(5 * state["mu"][s], LARGEST_MU)
        state["lam"][s], state["worst"][s] = new, max(worst, 0.0)
        state["since"][s], state["outer"][s] = 0, state["outer"][s] + 1
        state["stale"] = np.asarray(0)
        self.method.restart(state["method"], s)


# ---------------------------------------------------------------------------------------------------------------- checkpoints


def fingerprint(formulation: Formulation, shared: ProblemInputs, options: Any) -> str:
    """A hash of everything that a checkpoint must agree with."""
    leaves, structure = jax.tree.flatten(shared)
    digest = hashlib.sha256(repr((formulation, structure, options)).encode())
    for x in leaves:
        digest.update(np.asarray(x).tobytes() + str(np.shape(x)).encode())
    return digest.hexdigest()


def save_checkpoint(loop: Loop, path: str | os.PathLike, mark: str) -> None:
    """Writes the state of a loop, whole or not at all."""
    leaves = jax.tree.leaves(loop.state)
    arrays = {f"state_{i:03d}": np.asarray(x) for i, x in enumerate(leaves)}
    arrays |= {f"history_{name}": np.stack(x) for name, x in loop.history.items()}
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.partial")
    with open(temporary, "wb") as file:
        np.savez(file, allow_pickle=False, fingerprint=np.asarray(mark), **arrays)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, target)


def load_checkpoint(path: str | os.PathLike, loop: Loop, mark: str) -> None:
    """Puts a loop where its checkpoint left it.

    Raises:
      ValueError: the file is not a checkpoint, or one of another problem.
    """
    place = checks.file_to_read("checkpoint", path)
    try:
        with np.load(place) as file:
            arrays = {name: file[name] for name in file.files}
    except Exception as error:  # torn, another kind of file, or one that only looks like a zip
        remedy = (
            f"It cannot be read ({type(error).__name__}: {error}): delete it or name another file."
        )
        raise checks.fail("checkpoint", str(path), "a checkpoint of tune", remedy) from error
    if str(arrays.get("fingerprint")) != mark:
        raise checks.fail(
            "checkpoint",
            str(path),
            "a checkpoint of this very problem",
            "Scenario, objective or options differ: delete it or name another file.",
        )
    leaves, structure = jax.tree.flatten(loop.state)
    found = [np.array(arrays[name]) for name in sorted(arrays) if name.startswith("state_")]
    if [(x.shape, x.dtype) for x in found] != [(np.shape(x), np.asarray(x).dtype) for x in leaves]:
        raise checks.fail(
            "checkpoint",
            str(path),
            "a whole checkpoint",
            "Something is missing in it: delete it or name another file.",
        )
    loop.state = jax.tree.unflatten(structure, found)
    loop.history = {name[8:]: list(x) for name, x in arrays.items() if name.startswith("history_")}
