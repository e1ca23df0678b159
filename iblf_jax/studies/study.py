"""The result of a Monte-Carlo study: `Study`.

A study holds the metrics, the status and the draws of each run, and no trajectory.
`study.replay(i)` computes run i again with its trajectory.

Failed runs are part of every count and of every statistic.  A statistic that leaves them out on
request reports how many there were.  Runs that could not be made (an inadmissible draw,
`Status.INADMISSIBLE_DRAW`) have no numbers: they are counted, and no statistic includes them.

A run whose start was drawn on or outside its bounds has violated them at t = 0, before any law
could act.  Its flag is the same; `started_outside` says which runs these are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import jax
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.first_use import xarray
from iblf_jax.core.presentation import Content, Result, present
from iblf_jax.core.progress import announced
from iblf_jax.core.status import FAILED, Status, describe, has_flag
from iblf_jax.core.status import VIOLATED as CONSTRAINT_VIOLATED
from iblf_jax.engine import RunRequest, block_size_in_memory, run_rollout
from iblf_jax.engine.simulate import SimulationWarning
from iblf_jax.simulation import paths
from iblf_jax.simulation.metrics import metric_units
from iblf_jax.simulation.noise import NOISE_NAME, noise_values
from iblf_jax.simulation.results import Metrics, Rollout
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.stability import RADIUS, growth_in_words
from iblf_jax.simulation.units import status_words, unit_text
from iblf_jax.studies import statistics, summaries
from iblf_jax.studies.blocks import BlockResults, run_blocks
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.first_exit import INSTANTS, FirstExit, first_exit_of
from iblf_jax.studies.statistics import Probability
from iblf_jax.studies.study_setup import PreparedStudy
from iblf_jax.world import plants
from iblf_jax.world.regions import in_words

VIOLATED = CONSTRAINT_VIOLATED | Status.NOT_FINITE
"""The flags that `violation_probability` counts: a bound or region was violated, or the run
diverged, so that it is unknown whether its bounds would have held."""

REMARKABLE_RATIO = 10.0
"""Largest tracking error over the runs, relative to the median, above which a study says so."""
ROUNDING = 1e-4
"""Largest excess of a spectral radius over 1 that is a rounding error: a state of the law that
integrates has the radius 1."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class OneRun(Result):
    """One run of a study."""

    index: int
    metrics: Metrics
    status: int
    samples: dict[str, Any]

    def _content(self) -> Content:
        drawn = [f"  {path}: {np.asarray(x)}" for path, x in self.samples.items()]
        return [
            f"OneRun({self.index}; status: {describe(self.status)})",
            *drawn,
            repr(self.metrics),
        ]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Study(Result):
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
        """Builds the study from its checked arguments and the results of its runs."""
        units = metric_units(setup.shared.folds, setup.scenario)
        # jit sorts the names; here they are in the order of the folds.
        names = [name for name, _ in units if name in results.metrics]
        metrics = {name: results.metrics[name] for name in names} | results.metrics
        samples = {target.path: results.samples[target.path] for target in setup.program.targets}
        return cls(
            setup.scenario,
            Metrics(metrics, units),
            results.status,
            results.fastest_mode,
            samples,
            setup,
        )

    @property
    def runs(self) -> int:
        """Number of runs N."""
        return self.setup.options.runs

    @property
    def perturbations(self) -> dict[str, Perturbation]:
        """Path -> perturbation, as they were given."""
        return self.setup.perturbations

    @property
    def seed(self) -> int:
        """The seed."""
        return self.setup.options.seed

    @property
    def backend(self) -> str:
        """The backend that computed the runs: "native", "gpu" or "vmap", not "auto"."""
        return self.setup.backend

    @property
    def dt(self) -> float:
        """Time step [s]."""
        return self.setup.dt

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return self.setup.duration

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
        """Indices of the runs with a flag of `status.FAILED`."""
        return np.flatnonzero(has_flag(self.status, FAILED))

    @property
    def made(self) -> np.ndarray:
        """Whether each run was made, (N,) bool; False where a draw was inadmissible."""
        return ~has_flag(self.status, Status.INADMISSIBLE_DRAW)

    @cached_property
    def started_outside(self) -> np.ndarray:
        """Whether each run violated a bound or a region at t = 0 already, (N,) bool: drawn there,
        so that no law could keep it.
        """
        first = summaries.initial_margins(self.scenario, self.samples)
        inside = [np.min(margins, axis=1) > 0 for margins in first.values()]
        return self.made & has_flag(self.status, CONSTRAINT_VIOLATED) & ~np.all(inside, axis=0)

    @property
    def status_counts(self) -> dict[str, int]:
        """The number of runs with each status.

        OK (no flag), FAILED (a flag of `status.FAILED`) and FLAGGED (other flags only) add up to
        all runs.  The other entries count the runs with each flag, of which a run may have several,
        and STARTED_OUTSIDE those that violated a bound at t = 0 already (`started_outside`).
        """
        flagged = self.status != 0
        failed = has_flag(self.status, FAILED)
        masks = {"OK": ~flagged, "FLAGGED": flagged & ~failed, "FAILED": failed}
        masks |= {flag.name or "": has_flag(self.status, flag) for flag in Status}
        masks["STARTED_OUTSIDE"] = self.started_outside
        return {name: int(np.sum(mask)) for name, mask in masks.items()}

    @property
    def violation_probability(self) -> Probability:
        """The probability that a run violates its bounds or regions, or diverges, with the 95 %
        Clopper-Pearson interval.

        Runs that started outside their bounds count as violations; `started_outside` marks them.
        The probability without them is `probability((study.status & VIOLATED != 0) &
        ~study.started_outside)`, with `VIOLATED = ij.status.VIOLATED | Status.NOT_FINITE`.
        """
        return self.probability(VIOLATED)

    def first_exit(
        self, *, joint: int | str | None = None, instants: int = INSTANTS, confidence: float = 0.95
    ) -> FirstExit:
        """The distribution of the time at which a run first leaves its bounds.

        Bounds are compared at the instants of the steps, so an excursion between two of them is not
        seen, unless process noise acts on the positions themselves (`metrics.Margin`).

        Args:
          joint: of this joint, by index or name, from `metrics.FirstExit`; of any joint if None,
            from `metrics.Margin`.
          instants: number of instants from 0 to the end at which it is given.
          confidence: of the interval at each instant, in (0, 1).

        Returns:
          A `FirstExit`, with a method `plot`.

        Raises:
          ValueError: a study without the metric, or an argument that is not valid.

        Source: E. L. Kaplan, P. Meier, J. American Statistical Association 53 (1958) 457-481.
        """
        return first_exit_of(self, joint, instants, confidence)

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
            happened = np.asarray(event)
            if isinstance(event, int):
                happened = has_flag(self.status, event)
        except Exception:  # more bits than there are flags, or not convertible to an array
            happened = np.zeros(0)
        if happened.shape != (self.runs,) or happened.dtype != bool:
            raise checks.fail("event", event, f"flags of Status, or {self.runs} booleans")
        confidence = statistics.check_confidence(confidence)
        options = self.setup.options
        return statistics.probability(
            happened, self.made, confidence, options.sampler, options.replicates
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
        values = statistics.worst_joint(self.metrics, metric)
        if metric not in statistics.SMALLER_IS_WORSE:
            values = -values
        order = np.argsort(values, kind="stable")
        return order[self.made[order]][:count]

    def parameter_unit(self, path: str) -> str:
        """SI unit of a drawn parameter, by the path of its leaf or of an entry."""
        return paths.unit_at(self.scenario, path)

    def chosen(self, exclude_failed: bool = False) -> tuple[np.ndarray, dict[str, Any]]:
        """The runs that a statistic includes, (N,) bool, and their counts."""
        exclude_failed = checks.boolean("exclude_failed", exclude_failed)
        has_failed = has_flag(self.status, FAILED)
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
        """A sentence that states which runs the statistics include by default."""
        _, counts = self.chosen()
        failed = "none of them failed"
        if counts["failed_included"]:
            failed = f"{counts['failed_included']} failed ones included"
            failed += " (exclude_failed=True leaves them out)"
        text = f"statistics are over {counts['runs']} runs, {failed}"
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
        used, counts = self.chosen(exclude_failed)
        return summaries.metric_quantiles(self.metrics, self.scenario.n, quantiles, used, counts)

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
        used, counts = self.chosen(exclude_failed)
        return summaries.correlations(self.metrics, self.samples, metrics, used, counts)

    def bands(
        self,
        quantiles: Sequence[float] = (0.05, 0.5, 0.95),
        *,
        runs: int = 1024,
        samples: int = 200,
        exclude_failed: bool = False,
    ) -> xarray.Dataset:
        """The tube and the quantiles of position and error along time, (quantile, time, joint),
        from the first `runs` runs, which are computed again.

        Args:
          quantiles: numbers from 0 to 1.
          runs: how many of the runs; their decimated trajectories are in memory together.
          samples: approximate number of recorded times.
          exclude_failed: leave out failed runs, as in `quantiles`.

        Raises:
          ValueError: bad arguments, or every run was excluded.
        """
        used, _ = self.chosen(exclude_failed)
        failed = has_flag(self.status, FAILED)
        return summaries.bands(self.setup, quantiles, runs, samples, used, failed)

    def to_xarray(self) -> xarray.Dataset:
        """All runs as an `xarray.Dataset`: metrics and status along `run` (and `joint`), the drawn
        values as coordinates.
        """
        return summaries.to_xarray(
            self.setup, self.metrics, self.status, self.fastest_mode, self.samples
        )

    def plot(self, **options: Any) -> Any:
        """Overview figure: the tube with bands, margins, and margin against each parameter.
        Options as `plotting.study_overview`.
        """
        return present("study figure", self, **options)

    @notices.each_warning_once
    @announced("simulating a run of a study again")
    def replay(self, index: int, *, record_every: int = 1) -> Rollout:
        """Computes one run again, with its whole trajectory.

        Metrics, status and fastest mode are bit-identical to those of run `index`: its block is run
        again by the same compiled program.  The trajectory comes from the program for a single run,
        which rounds differently.  It agrees with the metrics to rounding; a run that has left its
        bounds may amplify the difference.  A warning says if the run started outside its bounds.

        Args:
          index: run number.
          record_every: steps between two records.

        Returns:
          A `Rollout`, with the drawn parameters in its scenario.

        Raises:
          ValueError: no such run (an IndexError too), or one that was not made because a draw was
            inadmissible.

        Source: design of this package.
        """
        i = checks.entry("index", index, self.runs, "runs")
        setup, options = self.setup, self.setup.options
        record_every = checks.recorded_every(record_every, options.steps)
        if not self.made[i]:
            drawn = {path: np.asarray(x[i]).tolist() for path, x in self.samples.items()}
            raise checks.fail(
                f"run {i}", drawn, "admissible draws", "It was not made; see study.made."
            )
        again = self._recompute(i)
        drawn = {path: x[i] for path, x in self.samples.items()}
        scenario = paths.with_parameters(self.scenario, drawn)
        request = RunRequest.of(
            scenario, steps=options.steps, method=options.method, record_every=record_every
        )
        number = setup.inputs_of(np.asarray([i])).index[0]
        noise = noise_values(self.scenario, setup.shared.uncertain.key, number).get(NOISE_NAME)
        run = run_rollout(scenario, setup.shared.folds, setup.shared.dt, request, noise)
        self._warn_of_start(i)
        metrics = Metrics(again.metrics, self.metrics.unit_pairs)
        return dataclasses.replace(
            run, metrics=metrics, status=again.status, fastest_mode=again.fastest_mode
        )

    def _recompute(self, i: int) -> BlockResults:
        """The results of run i, from its block; warns if they differ from those of the study."""
        # The size that a study in memory has by default: its program is compiled already.
        size = block_size_in_memory(self.setup.cases, self.setup.options.steps)
        block, place = divmod(i, size)
        ((_, results),) = run_blocks(self.setup, [block], size=size)
        again = jax.tree.map(lambda x: x[place], results)
        if not all(
            np.array_equal(x, self.metrics[name][i], equal_nan=True)
            for name, x in again.metrics.items()
        ):
            notices.warn(
                f"Run {i} gives other numbers here than in the study: made on another machine or"
                " version."
            )
        return again

    def _warn_of_start(self, i: int) -> None:
        if not self.started_outside[i]:
            return
        margins = summaries.initial_margins(self.scenario, self.samples)
        first = {bounded: x[i] for bounded, x in margins.items()}
        bounded = next(bounded for bounded, x in first.items() if not np.min(x) > 0)
        worst, plant = int(np.argmin(first[bounded])), self.scenario.loop.plant
        if bounded == summaries.REGIONS:
            name, unit = in_words(self.scenario.regions[worst], checks.given(plant.robot)), "m"
        else:
            level = summaries.LEVELS.index(bounded)
            name = plant.notation.component(level + 1, worst)
            unit = unit_text(self.scenario, plants.units_of(plant)[level], worst)
        notices.warn(
            f"Run {i} started outside its bounds: {name} was drawn {-first[bounded][worst]:.3g}"
            f" {unit} beyond one at t = 0. That violation is the draw's, not the law's: narrow the"
            " perturbations of the start, or leave such runs out (study.started_outside).",
            SimulationWarning,
        )

    def _content(self) -> Content:
        if not checks.is_concrete(self):
            return ["Study(being traced)"]
        counts = self.status_counts
        lines = [
            f"Study({self.runs} runs of {self.duration:g} s, dt = {self.dt:g} s, seed {self.seed},"
            f" {self.setup.options.sampler})",
            f"  bound violated or run away: {self.violation_probability}",
        ]
        if counts["STARTED_OUTSIDE"]:
            lines.append(
                f"    {counts['STARTED_OUTSIDE']} of them at t = 0, because they started outside:"
                " the draw's doing, not the law's"
            )
        lines.append(
            f"  failed: {counts['FAILED']}; flagged, but not failed: {counts['FLAGGED']}; ok:"
            f" {counts['OK']}"
        )
        texts = status_words(self.scenario)
        flags = [
            f"{describe(flag, texts)} ({count})"
            for flag in Status
            if (count := counts[flag.name or ""])
        ]
        if flags:
            lines.append(f"  flags, of which a run may have several: {'; '.join(flags)}")
        return [*lines, *self._remarks(), f"  {self.included}"]

    def _remarks(self) -> list[str]:
        """What is remarkable although no flag says it, in words."""
        lines = []
        if RADIUS in self.metrics:
            worst = self.worst(1, RADIUS)
            radius = float(np.max(self.metrics[RADIUS][worst], initial=0.0))
            if radius > 1.0 + ROUNDING:
                lines.append(
                    f"  largest sampling_radius: {radius:.6g} (run {worst[0]}): at one of its"
                    " assessed states a deviation grows from one period to the next, by"
                    f" {growth_in_words(radius)}"
                )
        if "rmse" in self.metrics:
            errors = statistics.worst_joint(self.metrics, "rmse")
            median = float(np.median(errors[self.made])) if self.made.any() else np.nan
            worst = self.worst(1, "rmse")
            ratio = float(np.max(errors[worst], initial=0.0)) / median if median > 0 else 0.0
            if np.isfinite(ratio) and ratio > REMARKABLE_RATIO:
                lines.append(
                    f"  the largest rmse is {ratio:.3g} times the median (run {worst[0]}):"
                    " study.correlations() says with which parameters it grows"
                )
        return lines
