"""`falsify`: attack a scenario before it is believed, by its derivatives, over start, disturbance
and plant within stated ends.

Random runs seldom meet the worst case: in d dimensions its corner of the set is small.  Here the
  uniform number u in [0, 1]^d behind
each perturbation is the unknown, and every one of S attacks, started at random, solves

    minimise  margin(u) = min over time and joints of min(q - lower, upper - q)     subject to     0
    <= u <= 1

(or the margin of the velocities, or of the regions),

by the method of `newton`: the exact margin and its slope, which are those of the joint, side and
  instant that come nearest, a
curvature learnt from their changes, and a trust region.  An attack that has arrived starts anew
somewhere else.  All run in one batch, derivatives by forward mode.  What comes back is the run with
the smallest margin that was seen, so it is never better news than its own starting points.

What cannot be run is no answer: a start outside its bounds, a mass matrix that is not positive
  definite, a reference that leaves the
bounds.  Attacks start at admissible points, and one that steps out goes back towards where it came
from.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.progress import bar
from iblf_jax.core.pytree import astype
from iblf_jax.core.status import VIOLATED, Status, describe
from iblf_jax.engine.mechanism import known_of
from iblf_jax.engine.plan import BACKENDS
from iblf_jax.engine.simulate import simulate
from iblf_jax.engine.step import Run
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.metrics import check_needs
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.sampling import check_step
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.cube import Cube, bounded
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.tuning.newton import Newton
from iblf_jax.tuning.parameters import Box
from iblf_jax.tuning.problem import NUMBERS_A_RUN, Slope, Value
from iblf_jax.tuning.quantities import DEFICITS, Peak, Quantities
from iblf_jax.tuning.tangents import by_coordinates

MARGINS = {"positions": "deficit", "velocities": "velocity_deficit", "regions": "region_deficit"}
"""What may be attacked -> the deficit that is minus its margin."""
FIRST_RADIUS = 0.5
"""Of the first step, in u."""
TOLERANCE = 1e-4
"""An attack has arrived where its model promises less, relative to the margin."""
HALVINGS = 8
"""How often a step that leads out of what is admissible is halved before the attack stays where it
is."""
NO_ANSWER = Status.INFEASIBLE_REFERENCE | Status.STEP_TOO_LARGE
"""Flags of runs that say nothing about the law: no law could keep the bounds, or the integrator is
to blame."""


@dataclasses.dataclass(frozen=True, eq=False)
class Attack:
    """The worst run that `falsify` found."""

    scenario: Scenario
    """With the worst parameters in it."""
    values: dict[str, np.ndarray]
    """Path -> worst value, in the leaf's unit."""
    margin: float
    """Its smallest margin, in `unit`; negative if a bound was violated."""
    first_margin: float
    """The smallest margin of the random starting points."""
    status: int
    """Flags of `Status` of that run."""
    history: np.ndarray
    """Margin of every attack's trial at every step, (iterations + 1, starts); NaN for runs that are
    no answer (`NO_ANSWER`)."""
    runs: int
    """Rollouts with derivatives that were made."""
    timing: dict[str, Any]
    unit: str = dataclasses.field(default="rad", kw_only=True)
    """Of the margins."""

    @property
    def violated(self) -> bool:
        """Whether the scenario was falsified: a run within the sets did not keep its bounds or
        regions, or ran away.
        """
        return bool(self.status & int(VIOLATED | Status.NOT_FINITE))

    def replay(self, record_every: int = 1) -> Rollout:
        """The worst run, in full."""
        return simulate(self.scenario, record_every=record_every, **self.timing)

    def __repr__(self) -> str:
        word = "FALSIFIED" if self.violated else "not falsified"
        lines = [
            f"Attack({word}: smallest margin {self.margin:.4g} {self.unit}, {self.first_margin:.4g}"
            f" at random; {self.runs} runs)"
        ]
        lines += [f"  status: {describe(self.status)}"]
        lines += [
            f"  {path}: {np.array2string(np.asarray(x), precision=5)}"
            for path, x in self.values.items()
        ]
        return "\n".join(lines)


@notices.each_warning_once
@checks.renamed(sets="perturbations")
def falsify(
    scenario: Scenario,
    perturbations: Mapping[str, Perturbation],
    *,
    duration: float,
    dt: float = 1e-3,
    method: str = "rk4",
    backend: str = "auto",
    starts: int = 16,
    iterations: int = 12,
    seed: int = 0,
    margin: str = "positions",
    progress: bool | None = None,
) -> Attack:
    """Looks for the run with the smallest margin within stated sets.

        minimise over u in [0, 1]^d:   min over t and joints of min(q - lower, upper - q)     (or of
        velocities or regions, `margin`)

    Args:
      scenario: what to attack, with its tuned gains say.
      perturbations: path -> `factor`, `offset` or `value` of a distribution, as in `monte_carlo`,
        that has two ends: the set.
      duration: length of a run [s], a whole number of steps.
      dt: time step [s].
      method: integrator.
      backend: as `tune`.
      starts: attacks, each from its own random point, in one batch; one that has arrived starts
        anew from another point.
      iterations: steps of each of them.
      seed: fixes the starting points.
      margin: which one is looked at: of the "positions", the "velocities" or the "regions".
      progress: a progress bar; shown where somebody watches if not given.

    Returns:
      An `Attack`: the worst run found, and whether it left its bounds.  Not to have found one
        proves nothing.

    Raises:
      ValueError: a perturbation without ends (a normal distribution), no such margin, perturbations
        in which nothing admissible was found, or bad arguments.

    Source: head of this module.
    """
    tableau(method)
    checks.one_of("backend", backend, BACKENDS)
    steps, scenario = checks.whole_steps(duration, dt), canonical(scenario)
    check_step(scenario, dt)
    starts = checks.positive_integer("starts", starts)
    checks.fits("starts", starts, 8.0 * NUMBERS_A_RUN)
    iterations = checks.positive_integer("iterations", iterations, most=checks.MOST_STEPS)
    seed = checks.seed(seed)
    checks.fits("iterations", iterations, 8 * starts)
    cube, dtype = bounded(scenario, perturbations), scenario.initial.q.dtype
    checks.fits("starts", starts, 8.0 * (1 + cube.size) * NUMBERS_A_RUN)
    checks.one_of("margin", margin, MARGINS)
    one: Any = 1.0
    peak = Peak(one, MARGINS[margin])
    check_needs("margin", peak, scenario)
    run, unit = Run(steps, method, mechanism=known_of(scenario)), DEFICITS[peak.signal]
    push = partial(
        _push, cube, astype(peak, dtype), jnp.asarray(dt, dtype), run=run, backend=backend
    )
    searcher = Newton(
        Box(np.full(cube.size, 0.5), np.zeros(cube.size), np.ones(cube.size)),
        TOLERANCE,
        FIRST_RADIUS,
    )
    state, best, history = searcher.init(cube.admissible_points(starts, [seed, 3])), None, []

    def attack(u: np.ndarray) -> Slope:
        nonlocal best
        margins, slope, status = (np.asarray(x) for x in push(jnp.asarray(u, dtype)))
        fine = np.isfinite(margins) & (status & int(NO_ANSWER) == 0)
        history.append(np.where(fine, margins, np.nan))
        s = int(np.argmin(np.where(fine, margins, np.inf)))
        if fine[s] and (best is None or margins[s] < best[0]):
            best = (float(margins[s]), u[s].copy(), int(status[s]))
        return Slope(
            Value(np.where(fine, margins, np.inf)), slope, np.zeros((starts, cube.size, cube.size))
        )

    with bar(progress, iterations + 1, unit="steps") as shown:
        for step in range(iterations + 1):
            state["trial"] = np.stack(
                [
                    _back(cube.refused, *pair)
                    for pair in zip(state["z"], state["trial"], strict=True)
                ]
            )
            searcher.step(attack, state)
            arrived = np.flatnonzero(state["done"])
            anew = cube.admissible_points(starts, [seed, 3, step + 1]) if len(arrived) else ()
            for s in arrived.tolist():
                searcher.begin(state, s, anew[s])
            shown.update(1)
            shown.set_postfix_str("" if best is None else f"margin {best[0]:.4g} {unit}")
    if best is None:
        remedy = (
            "In every run that was tried the reference leaves the bounds (Assumption 2) or the step"
            " is too large: narrow the perturbations, widen the bounds, or take a smaller dt."
        )
        raise cube.nothing(remedy)
    values = {path: np.asarray(x) for path, x in cube.values(jnp.asarray(best[1], dtype)).items()}
    timing = {"duration": duration, "dt": dt, "method": method}
    worst = with_parameters(scenario, values)
    first = next(float(np.nanmin(row)) for row in history if not np.all(np.isnan(row)))
    return Attack(
        worst,
        values,
        best[0],
        first,
        best[2],
        np.stack(history),
        starts * (iterations + 1),
        timing,
        unit=unit,
    )


def _back(
    refused: Callable[[np.ndarray], str], last_valid: np.ndarray, ahead: np.ndarray
) -> np.ndarray:
    """`ahead`, or the first of the points halfway back to `last_valid` that is admissible."""
    for _ in range(HALVINGS):
        if not refused(ahead):
            return ahead
        ahead = 0.5 * (last_valid + ahead)
    return last_valid


@partial(jax.jit, static_argnames=("run", "backend"))
def _push(cube: Cube, peak: Peak, dt, u, *, run, backend):
    """Smallest margin (S,), minus the peak of a deficit, its slope by u (S, d) and the status of
    each attack.
    """
    varied = jax.vmap(cube.values)(u)
    slopes = jax.vmap(jax.jacfwd(cube.values))(u)
    found = by_coordinates(
        cube.cases.scenario, varied, slopes, (Quantities((peak,)),), dt, run, backend=backend
    )
    deficits, moved = found.outcome.metrics["tuning_pieces"], found.tangents["tuning_pieces"]
    worst = jnp.argmax(deficits, axis=1)
    margin = -jnp.take_along_axis(deficits, worst[:, None], axis=1)[:, 0]
    return (
        margin,
        -jnp.take_along_axis(moved, worst[:, None, None], axis=2)[:, :, 0],
        found.outcome.status,
    )
