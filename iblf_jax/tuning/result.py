"""What a tuning gives back: `TuneResult`."""

from __future__ import annotations

import dataclasses
import os
from functools import cached_property, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.presentation import present
from iblf_jax.core.status import UNTRUSTED
from iblf_jax.simulation import paths
from iblf_jax.simulation.metrics import as_folds
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.tuning.evaluation import NUMBERS_A_RUN
from iblf_jax.tuning.objectives import Objective, has_price_on_torque
from iblf_jax.tuning.quantities import Quantities
from iblf_jax.tuning.report import TuningReport, make_report
from iblf_jax.tuning.robust import Risk
from iblf_jax.tuning.runs import Run, known_of, run_batch, simulate_unchecked, values_together

FAR = 100.0
"""A gain that ended so many times above or below its start is worth a warning."""
STUCK = (
    "the steps became too small: the model of objective and requirements does not hold near these"
    " gains"
)
"""Why a tuning stopped whose trust region has collapsed before the conditions of an optimum were
met."""
NEAR = 0.01
"""A number is at a limit if it differs from it by no more than this part of it (of the range, where
the limit is 0)."""


class AtLimit(NamedTuple):
    """A tuned number at an end of its range; prints as words."""

    value: float
    side: str
    """"lower" or "upper"."""
    limit: float
    reason: str = ""
    """What set this end; empty where that is not known."""

    def __str__(self) -> str:
        return f"= {self.value:.5g} is at the {self.side} end of its range, {self.limit:.5g}" + (
            f" ({self.reason})" if self.reason else ""
        )


@partial(jax.jit, static_argnames=("run", "backend"))
def _slice(scenario, changes, folds, dt, *, run, backend):
    return run_batch(scenario, changes, folds, dt, run, backend=backend)


@dataclasses.dataclass(frozen=True, eq=False)
class TuneSetup:
    """What a tuning was asked for, as far as its report needs it."""

    objective: Objective
    """With all scales and limits."""
    perturbations: dict[str, Perturbation]
    risk: Risk
    runs: int
    seed: int
    duration: float
    dt: float
    method: str
    backend: str
    report_runs: int
    report_seed: int
    confidence: float
    limits: tuple[tuple[float, float], ...] = ()
    """Lower and upper limit of each tuned number, (p, 2), in its unit; empty in results that were
    saved without."""
    reasons: tuple[tuple[str, str], ...] = dataclasses.field(default=(), kw_only=True)
    """What set them, in words, (p, 2); empty in results that were saved without."""


@dataclasses.dataclass(frozen=True, eq=False)
class TuneResult:
    """A tuned scenario, how it was found, and what it is worth: on runs that tuning never saw,
    where something is perturbed.
    """

    scenario: Scenario
    """With the tuned gains."""
    start: Scenario
    """With the gains that tuning started from."""
    values: dict[str, np.ndarray]
    """Path -> tuned value, in the leaf's unit."""
    names: tuple[str, ...]
    """What each coordinate is called, (p,)."""
    history: dict[str, np.ndarray]
    """Per step, (steps, starts, ...), two starts where two searches took turns: loss, objective,
    terms, excess of the requirements, margin [rad], gradient_norm, valid, z and x (the gains tried,
    in their units); evaluations is (steps,)."""
    best_start: int
    """Which of the starts won."""
    stopped: str
    """Why it stopped."""
    optimiser: str
    mode: str
    """"forward" or "reverse"."""
    seconds: float
    setup: TuneSetup
    multipliers: tuple[float, ...] = ()
    """Of each requirement: by how much the objective would fall if its limit were moved by one
    `scale`; none where one is broken, NaN where the gains are not those at which the search
    ended."""
    residuals: tuple[float, ...] = ()
    """At the end, of "newton": the largest entry of the Lagrangian's gradient by the coordinates z
    that no limit of a gain holds, the largest excess g of a requirement, and the sum of multipliers
    times distances from the limits; all 0 at an optimum."""
    probes: int = 0
    """Values without derivatives that were computed to find where to start, each of `setup.runs`
    rollouts."""

    @property
    def objective(self) -> float:
        """The objective at the tuned gains, on the runs that it was tuned on."""
        rounding = 100 * np.finfo(self.tuned.dtype).eps * np.abs(self.tuned)
        valid = self.history["valid"] & np.all(
            np.abs(self.history["x"] - self.tuned) <= rounding, axis=-1
        )
        return float(np.min(np.where(valid, self.history["objective"], np.inf)))

    @property
    def tuned(self) -> np.ndarray:
        """The tuned numbers, (p,), in the order of `names`."""
        flat = []
        for path, value in self.values.items():
            own = sum(name == path or name.startswith(path + "[") for name in self.names)
            flat.append(np.ravel(value)[:own])
        return np.concatenate(flat)

    @property
    def evaluations(self) -> int:
        """Values with derivatives that were computed, each of `setup.runs` rollouts."""
        return int(self.history["evaluations"][-1])

    @property
    def at_limits(self) -> dict[str, AtLimit]:
        """The tuned numbers that sit at an end of their range, by name: a wider range, or a price
        on what they cost, would move them.
        """
        found = {}
        why = self.setup.reasons or (("", ""),) * len(self.names)
        for name, x, ends, reasons in zip(
            self.names, self.tuned, self.setup.limits, why, strict=False
        ):
            width = ends[1] - ends[0] if np.isfinite(ends[1] - ends[0]) else 1.0
            for side, end, reason in zip(("lower", "upper"), ends, reasons, strict=True):
                if np.isfinite(end) and abs(x - end) <= NEAR * (abs(end) or width):
                    found[name] = AtLimit(float(x), side, float(end), reason)
        return found

    @property
    def prices(self) -> dict[str, float]:
        """By the name of a requirement: how much the objective would fall if its limit were
        loosened by one of its unit; for a violation probability, by one radian of the margin that
        its worst runs keep.
        """
        pairs = zip(self.setup.objective.requirements, self.multipliers, strict=False)
        return {r.name: price / float(r.scale) for r, price in pairs}

    @property
    def notes(self) -> tuple[str, ...]:
        """What to know before these gains are believed, in words: how the search ended, gains far
        from their start, no price on torque.
        """
        lines = [f"stopped: {self.stopped}"]
        if self.residuals:
            numbers = "gradient of the Lagrangian {:.2g}, largest excess {:.2g}, complementarity {:.2g}".format(
                *self.residuals
            )
            lines[0] += f" ({numbers}; objective {self.objective:.5g})"
        if self.setup.objective.requirements and not self.multipliers:
            lines.append(
                "WARNING: these gains break the requirements as little as was found: loosen one, or"
                " add parameters or starts"
            )
        if self.stopped == "iterations used up":
            steps = len(self.history["evaluations"])
            lines.append(
                f"WARNING: not converged: give more iterations than {steps}, or several starts"
            )
        if self.stopped == STUCK:
            lines.append(
                "WARNING: no optimum: give several starts, a smaller dt, or an objective whose"
                " slope does not jump"
            )
        first = np.concatenate([np.ravel(paths.get(self.start, path)) for path in self.values])
        last = np.concatenate([np.ravel(value) for value in self.values.values()])
        for name, before, after in zip(self._entries, first, last, strict=True):
            factor = after / before if before * after > 0 else 1.0
            if not 1 / FAR < factor < FAR:
                lines.append(
                    f"WARNING: {name} ended at {factor:.3g} times its start: the objective hardly"
                    " feels it, or puts no price on it"
                )
        if not has_price_on_torque(self.setup.objective):
            lines.append(
                "WARNING: this objective has no price on torque: add effort(), torque_rate() or"
                " peak_torque_below(limit)"
            )
        return tuple(lines)

    @property
    def _entries(self) -> list[str]:
        """A name for each number of `values`."""
        sizes = {path: np.shape(value) for path, value in self.values.items()}
        return [
            path + "".join(f"[{i}]" for i in index)
            for path, shape in sizes.items()
            for index in np.ndindex(shape)
        ]

    @cached_property
    def nominal(self) -> tuple[Rollout, Rollout]:
        """The nominal run before and after, in full."""
        setup = self.setup
        dtype, steps = self.start.initial.q.dtype, checks.whole_steps(setup.duration, setup.dt)
        folds, step = as_folds(None, dtype, self.start), jnp.asarray(setup.dt, dtype)
        run = partial(
            simulate_unchecked,
            folds=folds,
            dt=step,
            steps=steps,
            method=setup.method,
            record_every=1,
        )
        return run(canonical(self.start)), run(canonical(self.scenario))

    @cached_property
    def report(self) -> TuningReport:
        """Before and after, requirement by requirement: on fresh draws where something is
        perturbed, else on the one nominal run.
        """
        return self.check()

    @notices.each_warning_once
    def check(self, runs: int | None = None, seed: int | None = None) -> TuningReport:
        """The report with another number of fresh runs, or another seed.

        Args:
          runs: how many fresh runs; as in `report` if not given.
          seed: of their draws; never the one that was tuned on.

        Returns:
          A `TuningReport`, which prints as text; without perturbations it is on the one nominal run,
          whatever `runs` and `seed` say.

        Raises:
          ValueError: the seed of the tuning itself.

        Source: `iblf_jax.tuning.report`.
        """
        setup = self.setup
        seed = setup.report_seed if seed is None else checks.seed(seed)
        if setup.perturbations and seed == setup.seed:
            raise checks.fail(
                "seed", seed, "another seed than the tuning's", "Held-out runs must be fresh."
            )
        timing = {"duration": setup.duration, "dt": setup.dt, "method": setup.method}
        return make_report(
            self.start,
            self.scenario,
            tuple(self.values),
            setup.objective,
            setup.perturbations,
            runs=setup.report_runs if runs is None else checks.positive_integer("runs", runs),
            seed=seed,
            risk=setup.risk,
            confidence=setup.confidence,
            timing=timing,
            backend=setup.backend,
            together=(
                setup.runs * values_together(setup.runs) if self.probes or setup.runs > 1 else 1
            ),
            at_limits=(
                tuple(f"{name} {end}" for name, end in self.at_limits.items())
                if setup.limits
                else None
            ),
            prices=tuple(self.prices.values()),
            notes=self.notes,
        )

    def landscape(
        self, first: str, second: str, *, points: int = 13, span: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The objective of the nominal run on a slice through the optimum.

        Args:
          first, second: two of `names`.
          points: on each axis.
          span: each axis reaches from exp(-span) to exp(span) times the tuned number.

        Returns:
          Values of the first (points,), of the second (points,), and the objective (points,
          points), infinite where a run is invalid.

        Raises:
          ValueError: an unknown name.

        Source: design of this package.
        """
        for name in (first, second):
            checks.one_of("landscape: name", name, self.names)
        points, span = (
            checks.positive_integer("points", points),
            checks.positive_number("span", span, "1"),
        )
        checks.fits("points", points, 8 * points * NUMBERS_A_RUN)
        factor = np.exp(np.linspace(-span, span, points))
        a, b = (self.tuned[self.names.index(name)] * factor for name in (first, second))
        return a, b, self.on_slice(first, second, a, b)[0]

    def on_slice(
        self, first: str, second: str, a: np.ndarray, b: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Objective and largest excess of a requirement of the nominal run, (A, B) each, at values
        of two of `names` (A,), (B,).

        The objective is infinite where a run is invalid; without requirements the excess is -inf.
        """
        grid = {first: np.repeat(a, len(b)), second: np.tile(b, len(a))}
        # A name that is a whole leaf's stands for one number for all of its entries.
        shapes = {name: np.shape(self.values[name]) if name in self.values else () for name in grid}
        changes = {
            k: np.broadcast_to(x.reshape(-1, *(1,) * len(shapes[k])), (len(x), *shapes[k]))
            for k, x in grid.items()
        }
        setup, scenario = self.setup, canonical(self.scenario)
        dtype = scenario.initial.q.dtype
        folds = as_folds((Quantities(setup.objective.quantities),), dtype, scenario)
        run = Run(
            checks.whole_steps(setup.duration, setup.dt), setup.method, mechanism=known_of(scenario)
        )
        outcome = _slice(
            scenario, changes, folds, jnp.asarray(setup.dt, dtype), run=run, backend=setup.backend
        )
        values = jax.vmap(setup.objective.values)(outcome.metrics["tuning_exact"]).sum(axis=1)
        valid = np.asarray(outcome.status) & int(UNTRUSTED) == 0
        excess = np.asarray(jax.vmap(setup.objective.excesses)(outcome.metrics["tuning_exact"]))
        worst = np.max(excess, axis=1, initial=-np.inf)
        return tuple(
            np.where(valid, x, np.inf).reshape(len(a), len(b)) for x in (np.asarray(values), worst)
        )  # type: ignore[return-value]

    def plot(self, **options):
        """Figure of the tuning: loss, gains, margin, torque and tubes before and after.  Options as
        `plotting.tuning`.
        """
        return present("tuning figure", self, **options)

    def save(self, path: str | os.PathLike) -> None:
        """Writes everything to one file, from which `load_tuning` gives the result back with the
        same report.

        Raises:
          ValueError: the scenario, the objective or a perturbation holds a class that no file can
            name.
          OSError: the file cannot be written.
        """
        present("tuning file", self, path)

    def __repr__(self) -> str:
        probes = f", {self.probes} probes" if self.probes else ""
        steps, how = len(self.history["evaluations"]), f"{self.optimiser}, {self.mode} mode"
        lines = [
            f"TuneResult({how}, {steps} steps, {self.evaluations} evaluations{probes},"
            f" {self.seconds:.3g} s; {self.stopped})"
        ]
        for path, value in self.values.items():
            before = np.array2string(np.asarray(paths.get(self.start, path)), precision=5)
            lines.append(f"  {path}: {before} -> {np.array2string(np.asarray(value), precision=5)}")
        lines += [f"  {name} {end}" for name, end in self.at_limits.items()]
        peaks = [np.max(np.asarray(run.metrics.peak_torque)) for run in self.nominal]
        lines.append(f"  peak torque of the nominal run: {peaks[0]:.5g} -> {peaks[1]:.5g} N m")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return present("card", self)
