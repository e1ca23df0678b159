"""The result of a Monte-Carlo study: `Study`.

Per run it holds the metrics, the status and what was drawn; never a trajectory.  `study.replay(i)`
makes run i again in full.

Failed runs are part of every count and of every statistic, unless they are left out on request, and
then the answer says how many were.  Runs that could not be made (an inadmissible draw,
`Status.INADMISSIBLE_DRAW`) have no numbers; they are left out of statistics always, are counted,
and the answer says so.

A run whose start was drawn on or outside its bounds has violated them at t = 0, before any law
could act.  Its flag is the same; counts, `started_outside` and `replay` tell it apart.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.presentation import present
from iblf_jax.core.status import FAILED, Status, describe
from iblf_jax.core.status import VIOLATED as LEFT
from iblf_jax.engine import RunRequest, block_size, run_rollout
from iblf_jax.engine.simulate import SimulationWarning
from iblf_jax.simulation import paths
from iblf_jax.simulation.metrics import metric_units
from iblf_jax.simulation.noise import NOISE_NAME, noise_of
from iblf_jax.simulation.results import Metrics, Rollout
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies import statistics, summaries
from iblf_jax.studies.blocks import BlockResults, run_blocks
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.setup import PreparedStudy
from iblf_jax.studies.statistics import Probability
from iblf_jax.world.regions import in_words
from iblf_jax.world.robots import joint_names

if TYPE_CHECKING:
    import xarray

VIOLATED = LEFT | Status.NOT_FINITE
"""What `violation_probability` counts: a run that did not keep its bounds or regions, or that ran
away, after which it has no say."""


@dataclasses.dataclass(frozen=True, eq=False)
class OneRun:
    """One run of a study."""

    index: int
    metrics: Metrics
    status: int
    samples: dict[str, Any]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Study:
    """Many runs of one scenario with drawn parameters; arrays have N runs first.  `study[i]` is one
    run.
    """

    scenario: Scenario
    """The nominal scenario."""
    metrics: Metrics
    """Results of the folds, each (N,) or (N, n)."""
    status: Any
    """Bit flags of `Status`, (N,) int32; 0 is ok."""
    fastest_mode: Any
    """Largest measured mode of the closed loop, (N,) [1/s]."""
    samples: dict[str, Any]
    """Path -> the value of that leaf in each run, (N, ...), in the leaf's unit."""
    setup: PreparedStudy
    """The checked arguments and the program of the runs."""

    @classmethod
    def of(cls, setup: PreparedStudy, results: BlockResults) -> Study:
        """The study with these results."""
        units = metric_units(setup.shared.folds)
        order = {
            name: None for name, _ in units if name in results.metrics
        } | results.metrics  # theirs, not sorted as by jit
        metrics = Metrics({name: results.metrics[name] for name in order}, units)
        samples = {target.path: results.samples[target.path] for target in setup.program.targets}
        return cls(
            setup.shared.cases.scenario,
            metrics,
            results.status,
            results.fastest_mode,
            samples,
            setup,
        )

    @property
    def runs(self) -> int:
        """Number of runs N."""
        return self.setup.runs

    @property
    def perturbations(self) -> dict[str, Perturbation]:
        """Path -> perturbation, as they were given."""
        return self.setup.perturbations

    @property
    def seed(self) -> int:
        """The seed."""
        return self.setup.seed

    @property
    def backend(self) -> str:
        """The backend that computed the runs: "native", "gpu" or "vmap", not "auto"."""
        return self.setup.program.batch.backend

    @property
    def dt(self) -> float:
        """Time step [s]."""
        return float(self.setup.shared.dt)

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return self.setup.program.steps * self.dt

    def __len__(self) -> int:
        return self.runs

    def __getitem__(self, index: int) -> OneRun:
        """One run: its metrics, status and drawn values."""
        i = checks.entry("index", index, self.runs, "runs")
        return OneRun(
            i,
            jax.tree.map(lambda x: x[i], self.metrics),
            int(self.status[i]),
            {path: x[i] for path, x in self.samples.items()},
        )

    @property
    def failed(self) -> np.ndarray:
        """Numbers of the runs that did not do their job (`status.FAILED`)."""
        return np.flatnonzero(self.status & int(FAILED))

    @property
    def made(self) -> np.ndarray:
        """Whether each run was made, (N,) bool; False where a draw was inadmissible."""
        return self.status & int(Status.INADMISSIBLE_DRAW) == 0

    @cached_property
    def started_outside(self) -> np.ndarray:
        """Whether each run violated a bound or a region at t = 0 already, (N,) bool: drawn there,
        so that no law could keep it.
        """
        inside = [np.min(margins, axis=1) > 0 for margins in summaries.first_margins(self).values()]
        return self.made & (self.status & int(LEFT) != 0) & ~np.all(inside, axis=0)

    @property
    def status_counts(self) -> dict[str, int]:
        """How many runs there are of each kind.

        OK, FLAGGED and FAILED add up to all runs: no flag, flags that are no failure, and a flag of
        `status.FAILED`.  Then how many have each flag, of which a run may have several, and how
        many of those that violated a bound did so at t = 0 (`started_outside`).
        """
        failed, flagged = self.status & int(FAILED) != 0, self.status != 0
        counts = {
            "OK": int(np.sum(~flagged)),
            "FLAGGED": int(np.sum(flagged & ~failed)),
            "FAILED": int(np.sum(failed)),
        }
        counts |= {flag.name or "": int(np.sum(self.status & int(flag) != 0)) for flag in Status}
        return counts | {"STARTED_OUTSIDE": int(np.sum(self.started_outside))}

    @property
    def violation_probability(self) -> Probability:
        """How probable it is that a run leaves its bounds or regions, or runs away, with the 95 %
        Clopper-Pearson interval.

        Runs that started outside their bounds count, for they have violated them; `started_outside`
        says which they are.  That a law violates them has the probability
        `probability((study.status & VIOLATED != 0) & ~study.started_outside)`, with `VIOLATED =
        ij.status.VIOLATED | Status.NOT_FINITE`.
        """
        return self.probability(VIOLATED)

    def probability(
        self, event: Status | np.ndarray = VIOLATED, confidence: float = 0.95
    ) -> Probability:
        """The probability of an event over the runs that were made.

            [B(a/2; k, N - k + 1), B(1 - a/2; k + 1, N - k)],   a = 1 - confidence
            (Clopper-Pearson)

        Args:
          event: flags of `Status`, any of which counts, or (N,) bool such as `study.metrics.rmse[:,
            0] > 0.1`.
          confidence: of the interval, in (0, 1).

        Returns:
          Estimate, interval, count and runs.  For designs the interval comes from the replicates
          (Student t), and is None without.

        Raises:
          ValueError: an event of another shape, a confidence outside (0, 1).

        Source: C. J. Clopper, E. S. Pearson, Biometrika 26 (1934) 404-413.
        """
        try:
            happened = (
                self.status & int(event) != 0 if isinstance(event, int) else np.asarray(event)
            )
        except Exception:  # a number of more bits than flags, or nothing that is an array
            happened = np.zeros(0)
        if happened.shape != (self.runs,) or happened.dtype != bool:
            raise checks.fail("event", event, f"flags of Status, or {self.runs} booleans")
        confidence = statistics.check_confidence(confidence)
        return statistics.probability(
            happened, self.made, confidence, self.setup.sampler, self.setup.replicates
        )

    def worst(self, count: int = 10, metric: str = "margin") -> np.ndarray:
        """Numbers of the worst runs, worst first: smallest margin, or largest of another metric, of
        the worst joint.

        Args:
          count: how many, at most N.
          metric: name of a metric.

        Returns:
          Run numbers, of the runs that were made; give them to `replay`.

        Raises:
          ValueError: an unknown metric.

        Source: design of this package.
        """
        count = checks.positive_integer("count", count)
        values = statistics.one_number(self.metrics, metric)
        if metric not in statistics.SMALLER_IS_WORSE:
            values = -values
        order = np.argsort(values, kind="stable")
        return order[self.made[order]][:count]

    def parameter_unit(self, path: str) -> str:
        """SI unit of a drawn parameter, by the path of its leaf or of an entry."""
        return paths.unit_at(self.scenario, path)

    def chosen(self, exclude_failed: bool = False) -> tuple[np.ndarray, dict[str, Any]]:
        """Which runs a statistic is over, (N,) bool, and the counts that go with it."""
        exclude_failed = checks.flag("exclude_failed", exclude_failed)
        has_failed = self.status & int(FAILED) != 0
        used = self.made
        if exclude_failed:
            used = used & ~has_failed
        counts = {
            "runs": int(used.sum()),
            "excluded": int(self.runs - used.sum()),
            "failed_excluded": str(bool(exclude_failed)),
            "failed_included": int(np.sum(used & has_failed)),
        }
        return used, counts

    @property
    def included(self) -> str:
        """In words: which runs statistics are over, unless failed ones are left out."""
        _, counts = self.chosen()
        text = f"statistics are over {counts['runs']} runs, "
        if counts["failed_included"]:
            text += f"{counts['failed_included']} failed ones included (exclude_failed=True leaves"
            text += " them out)"
        else:
            text += "none of them failed"
        if counts["excluded"]:
            text += f"; {counts['excluded']} were not made"
        return text

    def quantiles(
        self, quantiles: Sequence[float] = (0.05, 0.5, 0.95), *, exclude_failed: bool = False
    ) -> xarray.Dataset:
        """Quantiles of every metric over the runs, an `xarray.Dataset` with the dimensions
        `quantile` and `joint`.

            Q(p) = min {y : at least p N of the runs have a value <= y}

        Args:
          quantiles: numbers p from 0 to 1.
          exclude_failed: leave out failed runs; the attributes `runs` and `excluded` say how many
            were used and left out.

        Raises:
          ValueError: numbers outside [0, 1].
        """
        return summaries.metric_quantiles(self, quantiles, exclude_failed)

    def correlations(
        self, metrics: Sequence[str] | None = None, *, exclude_failed: bool = False
    ) -> xarray.Dataset:
        """Spearman's rank correlation of every drawn parameter with every metric (its worst joint),
        and the p-value.

        Args:
          metrics: names; all if not given.
          exclude_failed: leave out failed runs, as in `quantiles`.

        Raises:
          ValueError: an unknown metric.
        """
        return summaries.correlations(self, metrics, exclude_failed)

    def bands(
        self,
        quantiles: Sequence[float] = (0.05, 0.5, 0.95),
        *,
        runs: int = 1024,
        samples: int = 200,
        exclude_failed: bool = False,
    ) -> xarray.Dataset:
        """The tube with the quantiles of the runs along time, (quantile, time, joint), from the
        first `runs` runs, made again.

        Args:
          quantiles: numbers from 0 to 1.
          runs: how many of the runs; their decimated trajectories are in memory together.
          samples: about how many times.
          exclude_failed: leave out failed runs, as in `quantiles`.

        Raises:
          ValueError: bad arguments, or no run that is left.
        """
        return summaries.bands(self, quantiles, runs, samples, exclude_failed)

    def to_xarray(self) -> xarray.Dataset:
        """All runs as an `xarray.Dataset`: metrics and status along `run` (and `joint`), the drawn
        values as coordinates.
        """
        return summaries.to_xarray(self)

    def plot(self, **options: Any) -> Any:
        """Overview figure: the tube with bands, margins, and margin against each parameter.
        Options as `plotting.study_overview`.
        """
        return present("study figure", self, **options)

    @notices.each_warning_once
    def replay(self, index: int, *, record_every: int = 1) -> Rollout:
        """Makes one run again, with its whole trajectory.

        Metrics, status and fastest mode are bit-identical to those of run `index`: its block is run
        again by the same compiled program.  The trajectory comes from the program for a single run,
        where XLA rounds differently: it agrees with the metrics to rounding, until a run that has
          left its bounds amplifies that.  A warning says if the run started outside its bounds.

        Args:
          index: run number.
          record_every: record every so-many-th step.

        Returns:
          A `Rollout`, with the drawn parameters in its scenario.

        Raises:
          ValueError: no such run (an IndexError too), or one that was not made because a draw was
            inadmissible.

        Source: design of this package.
        """
        i = checks.entry("index", index, self.runs, "runs")
        record_every = checks.recorded_every(record_every, self.setup.program.steps)
        if not self.made[i]:
            drawn = {path: np.asarray(x[i]).tolist() for path, x in self.samples.items()}
            raise checks.fail(
                f"run {i}", drawn, "admissible draws", "It was not made; see study.made."
            )
        block, place = divmod(i, block_size())
        ((_, again),) = run_blocks(self.setup, [block])
        again = jax.tree.map(lambda x: x[place], again)
        if not all(
            np.array_equal(x, self.metrics[name][i], equal_nan=True)
            for name, x in again.metrics.items()
        ):
            reason = "made on another machine or version"
            notices.warn(f"Run {i} gives other numbers here than in the study: {reason}.")
        drawn = {path: x[i] for path, x in self.samples.items()}
        scenario = paths.with_parameters(self.scenario, drawn)
        shared, program = self.setup.shared, self.setup.program
        request = RunRequest.of(
            scenario, steps=program.steps, method=program.method, record_every=record_every
        )
        number = self.setup.inputs_of(np.asarray([i])).index[0]
        noise = noise_of(self.scenario, shared.cases.key, number).get(NOISE_NAME)
        run = run_rollout(scenario, shared.folds, shared.dt, request, noise)
        self._warn_of_start(i)
        metrics = Metrics(again.metrics, self.metrics.unit_pairs)
        return dataclasses.replace(
            run, metrics=metrics, status=again.status, fastest_mode=again.fastest_mode
        )

    def _warn_of_start(self, i: int) -> None:
        if not self.started_outside[i]:
            return
        first = {unit: margins[i] for unit, margins in summaries.first_margins(self).items()}
        unit = next(unit for unit, margins in first.items() if not np.min(margins) > 0)
        worst, plant = int(np.argmin(first[unit])), self.scenario.plant
        name = (
            in_words(self.scenario.regions[worst], plant)
            if unit == "m"
            else joint_names(plant, self.scenario.n)[worst]
        )
        notices.warn(
            f"Run {i} started outside its bounds: {name} was drawn {-first[unit][worst]:.3g} {unit}"
            " beyond one at t = 0. That violation is the draw's, not the law's: narrow the"
            " perturbations of the start, or leave such runs out (study.started_outside).",
            SimulationWarning,
        )

    def __repr__(self) -> str:
        if not checks.is_concrete(self):
            return "Study(being traced)"
        counts = self.status_counts
        lines = [
            f"Study({self.runs} runs of {self.duration:g} s, dt = {self.dt:g} s, seed {self.seed},"
            f" {self.setup.sampler})"
        ]
        lines += [f"  bound violated or run away: {self.violation_probability}"]
        if counts["STARTED_OUTSIDE"]:
            lines += [
                f"    {counts['STARTED_OUTSIDE']} of them at t = 0, because they started outside:"
                " the draw's doing, not the law's"
            ]
        lines += [
            f"  failed: {counts['FAILED']}; flagged, but not failed: {counts['FLAGGED']}; ok:"
            f" {counts['OK']}"
        ]
        flags = [
            f"{count} {describe(flag)}" for flag in Status if (count := counts[flag.name or ""])
        ]
        if flags:
            lines.append(f"  flags, of which a run may have several: {'; '.join(flags)}")
        lines += [f"  {self.included}"]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return present("card", self)
