"""Steps of any optimiser of optax, on coordinates that are squashed into the box, with mini-batches
of runs.  `Adam` and `Optax` are these steps with different options.

A step to a point with an invalid run, or without a finite gradient, is rejected: the start goes
back towards its last valid point, and its rate stays halved.

With `batch`, a step evaluates and differentiates only so many of the runs.  An epoch goes through a
permutation of the runs that depends on the seed and the number of the epoch; the remainder of a
division of the runs by `batch` is left out, and is another one in each epoch.  With `resample`,
each step has new runs.  Either way a low loss may be due to the runs of a step.  So every
CHECK_STEPS steps, and at the last one, the search gets the value on all of the tuning's own runs,
without derivatives; other steps are not candidates for the result.

What a mini-batch minimises, for the losses L_b of all runs:

    mean            the gradient is unbiased
    worst, cvar     the mean over the mini-batches of their worst runs, which lies below the worst
                    of all runs
    requirements    the gradient is that of the worst runs of the mini-batch; the multipliers follow
                    from the violation on all runs

Which result is kept is decided by the given risk and requirements on all runs.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax

from iblf_jax.core import checks, notices
from iblf_jax.tuning.parameters import squashed, unsquash
from iblf_jax.tuning.solvers._base import SearchSpace, Solver, check_options, where_rows

if TYPE_CHECKING:
    from iblf_jax.tuning.evaluation import Derivatives, Evaluator
    from iblf_jax.tuning.problem import TuningProblem

CHECK_STEPS = 5
"""Steps from one value on all runs to the next, where the runs of the steps differ; at most the
patience."""
SEED_OF_BATCHES = 6
"""Distinguishes the draws of mini-batches from others of the same seed."""


@dataclasses.dataclass(frozen=True)
class Optax(Solver):
    """Any optimiser of optax, such as `Optax(optax.lion(1e-3))`; requirements are penalties.

    Gradient clipping, weight decay and schedules are parts of the optimiser:
    `optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(1e-3))`.  Each start has an own state
    of it.  The parameters that it gets are the coordinates: the logarithms of gains, and numbers
    without a sign, such as weights of a network, as they are.

    In reverse mode the memory of a gradient grows with the cube root of the number of steps: 64
    runs of 5,000 steps of the paper's loop with 499 weights take 1 MB besides the compiled program.

    Args:
      optimiser: an `optax.GradientTransformation` that needs gradients, parameters and the loss
        only, and no random key; `optax.adam(1e-2)` if not given.
      batch: number of the runs that a step evaluates; all of them if not given.  A mini-batch of
        the worst runs or of requirements is biased, see the head of this module; the result is
        chosen on all runs.
      resample: whether the runs are drawn anew at every step.
      mode: "forward", "reverse", or "auto": forward up to 32 numbers.
      starts: number of starting points.
      patience: steps without a better result after which the search ends.
      tolerance: relative change of the objective that counts as a better result.
    """

    optimiser: object = None
    batch: int | None = None
    resample: bool = False
    mode: str = "auto"
    starts: int = 1
    patience: int = 15
    tolerance: float = 1e-5
    name: ClassVar[str] = "optax"
    handles_requirements: ClassVar[bool] = False
    sharpenings = 0

    def __post_init__(self) -> None:
        check_options(self)

    def transformation(self, iterations: int) -> optax.GradientTransformation:
        """The optimiser."""
        if self.optimiser is None:
            return optax.adam(1e-2)
        return self.optimiser

    def init(self, space: SearchSpace, z: np.ndarray) -> dict[str, Any]:
        """As `Solver.init`."""
        return init(self, space, z)

    def step(
        self, evaluate: Any, state: dict[str, Any], tolerance: float
    ) -> tuple[np.ndarray, Any]:
        """As `Solver.step`."""
        return step(self, evaluate, state)

    def restart(
        self, space: SearchSpace, state: dict[str, Any], start: int, z: np.ndarray | None = None
    ) -> None:
        """As `Solver.restart`; a change of the loss makes nothing in the state wrong."""
        restart(self, space, state, start, z)

    def converged(self, state: dict[str, Any]) -> np.ndarray:
        """Never: the search ends by the number of iterations, or without a better result."""
        return np.zeros(len(state["w"]), bool)


def init(solver: Any, space: SearchSpace, z: np.ndarray) -> dict[str, Any]:
    """The state of S starts at z, (S, p).

    Args:
      solver: an `Optax`, or another class with its options and `transformation`.
      space: what the solver knows of the problem.
      z: where.

    Raises:
      ValueError: a mini-batch of more than all runs, or beside `resample`; an optimiser that needs
        more than gradients, parameters and the loss.
    """
    if solver.batch is not None and solver.resample:
        came = checks.Words(f"{solver.batch} with resample=True")
        raise checks.fail("batch", came, "one of them", "New runs need no mini-batches.")
    runs = space.constraints.runs
    if solver.batch is not None and solver.batch > runs:
        remedy = "Lower it, or give tune more runs."
        raise checks.fail("batch", solver.batch, f"at most the number of runs, {runs}", remedy)
    w = np.stack([unsquash(x, space.box) for x in z])
    try:
        inner = jax.vmap(solver.transformation(space.iterations).init)(jnp.asarray(w))
        jax.eval_shape(partial(_updated, solver, space.iterations), w, inner, w, w[:, 0])
        inner = jax.tree.map(np.array, inner)
    except Exception as error:
        remedy = (
            f"It raised {type(error).__name__}: {error}. For a line search take ij.tuning.LBFGS();"
            " noise comes from batch=... and resample=True, not from a random key in its state."
        )
        expected = "an optimiser that needs gradients, parameters and the loss only"
        raise checks.fail("optimiser", solver.optimiser, expected, remedy) from error
    return {
        "w": w,
        "last_valid": w.copy(),
        "inner": inner,
        "rate": np.ones(len(z)),
        "steps": np.asarray(0),
    }


def restart(
    solver: Any, space: SearchSpace, state: dict[str, Any], start: int, z: np.ndarray | None
) -> None:
    """As `Solver.restart`."""
    if z is None:
        return
    new = init(solver, space, z[None])
    for name in ("w", "last_valid", "inner", "rate"):
        jax.tree.map(lambda old, x: old.__setitem__(start, x[0]), state[name], new[name])


def step(solver: Any, evaluate: Evaluator, state: dict[str, Any]) -> tuple[np.ndarray, Derivatives]:
    """One step of every active start, as `Solver.step`."""
    space = evaluate.space
    number = int(state["steps"])
    z, pull = squashed(space.box, state["w"])
    found = _evaluated(solver, evaluate, z, number)
    gradient = pull(found.gradient)
    valid = np.isfinite(found.value.loss) & np.all(np.isfinite(gradient), axis=1)
    finite = np.where(valid[:, None], gradient, 0.0)
    loss = np.where(valid, found.value.loss, 0.0)
    move, inner = _update(solver, space.iterations, finite, state["inner"], state["w"], loss)
    move = np.asarray(move)
    valid &= np.all(np.isfinite(move), axis=1)
    state["inner"] = jax.tree.map(partial(where_rows, valid), inner, state["inner"])
    state["rate"] = np.where(valid, state["rate"], 0.5 * state["rate"])
    state["last_valid"] = where_rows(valid, state["w"], state["last_valid"])
    with np.errstate(invalid="ignore"):
        forward = state["w"] + state["rate"][:, None] * move
    back = 0.5 * (state["w"] + state["last_valid"])
    state["w"] = where_rows(valid, forward, back)
    state["steps"] = state["steps"] + 1
    if solver.batch is None and not solver.resample:
        return z, found
    is_last = number + 1 >= space.iterations
    if number % min(CHECK_STEPS, solver.patience) and not is_last:
        value = found.value._replace(valid=np.zeros_like(found.value.valid))
    else:
        value = evaluate.values(z)  # on all runs
        value = value._replace(valid=value.valid & evaluate.active)
    return z, found._replace(value=value)


def _evaluated(solver: Any, evaluate: Evaluator, z: np.ndarray, number: int) -> Derivatives:
    """The derivatives at z on the runs of a step."""
    if solver.batch is None:
        return evaluate(z)
    if number == 0:
        _warn_of_bias(solver, evaluate.problem)
    everything = evaluate.candidates
    seed = int(evaluate.problem.options.seed)
    chosen = runs_of_step(everything.index.shape[1], solver.batch, seed, number)
    evaluate.candidates = everything._replace(index=everything.index[:, chosen])
    try:
        return evaluate(z)
    finally:
        evaluate.candidates = everything


def runs_of_step(runs: int, batch: int, seed: int, number: int) -> np.ndarray:
    """Which of the runs a step evaluates, (batch,): without replacement within an epoch.

    Args:
      runs: number of all runs.
      batch: number of runs of a step.
      seed: of the tuning.
      number: of the step.
    """
    epoch, place = divmod(number, runs // batch)
    order = np.random.default_rng([seed, SEED_OF_BATCHES, epoch]).permutation(runs)
    return np.sort(order[place * batch : (place + 1) * batch])


def _warn_of_bias(solver: Any, problem: TuningProblem) -> None:
    """Warns of a risk whose worst runs a mini-batch does not represent."""
    risk = problem.options.risk
    if risk.kind == "mean" or solver.batch == problem.runs:
        return
    if risk.kind == "cvar" and solver.batch * (1 - risk.level) >= 1:
        return
    notices.warn(
        f"batch={solver.batch} with risk {risk.kind!r}: a step lowers the worst run of its"
        f" mini-batch, which is mostly not among the worst of all {problem.runs} runs. The result"
        ' is chosen on all runs. Take a larger batch, or risk="mean".'
    )


def _updated(
    solver: Any, iterations: int, gradient: jax.Array, inner: Any, w: jax.Array, loss: jax.Array
) -> Any:
    optimiser = optax.with_extra_args_support(solver.transformation(iterations))

    def of_start(gradient: jax.Array, inner: Any, w: jax.Array, loss: jax.Array) -> Any:
        return optimiser.update(gradient, inner, w, value=loss)

    with jax.numpy_dtype_promotion("standard"):  # optax mixes integers of several types
        return jax.vmap(of_start)(gradient, inner, w, loss)


_update = jax.jit(_updated, static_argnums=(0, 1))
