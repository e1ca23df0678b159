"""Which uncertainty matters: Sobol indices of a metric by the parameters that are perturbed.

With y the metric and x_1 ... x_d independent parameters,

    S_i  = var(E[y | x_i]) / var(y)              first order: what x_i explains by itself
    ST_i = E[var(y | all but x_i)] / var(y)      total: with all its interactions

ST_i is 0 if and only if x_i does not matter.  SciPy estimates both from n (d + 2) runs on a Sobol
design (`scipy.stats.sobol_indices`).

Source: A. Saltelli et al., Computer Physics Communications 181 (2010) 259-270.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from typing import Any

import numpy as np

from iblf_jax.core import checks, notices, tables
from iblf_jax.core.first_use import xarray
from iblf_jax.core.presentation import Content, Result
from iblf_jax.core.progress import announced, bar
from iblf_jax.core.pytree import field_values
from iblf_jax.core.status import FAILED, has_flag
from iblf_jax.engine import takes_runs
from iblf_jax.simulation.metrics import Fold, metric_units
from iblf_jax.simulation.results import Metrics
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies import statistics
from iblf_jax.studies.blocks import case_bytes, result_shapes
from iblf_jax.studies.designs import MAX_SOBOL, split
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.draws import draw_shapes
from iblf_jax.studies.execution import run_all_cases
from iblf_jax.studies.options import LocalExecutor, RunOptions, executor_of
from iblf_jax.studies.study_setup import PreparedStudy, prepare

TAILS = (0.025, 0.975)
"""Ends of an interval of 95 %."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Sensitivity(Result):
    """Sobol indices, one for each number that is perturbed."""

    parameters: tuple[str, ...]
    """Their paths, d of them."""
    first_order: np.ndarray
    """S_i, (d,)."""
    total_order: np.ndarray
    """ST_i, (d,)."""
    first_order_interval: np.ndarray
    """95 % bootstrap interval, (d, 2)."""
    total_order_interval: np.ndarray
    """95 % bootstrap interval, (d, 2)."""
    output: str
    """Name of the metric or function."""
    runs: int
    """Number of runs: n (d + 2)."""
    failed: int
    """Number of failed runs, which the estimate includes."""

    def to_xarray(self) -> xarray.Dataset:
        """The indices along the dimension `parameter`."""
        names = {"first_order": "S", "total_order": "ST"}
        values = field_values(self)
        variables: dict[str, Any] = {
            name: ("parameter", values[name], {"symbol": symbol}) for name, symbol in names.items()
        }
        variables |= {
            f"{name}_interval": (("parameter", "end"), values[f"{name}_interval"]) for name in names
        }
        coordinates = {"parameter": list(self.parameters), "end": ["low", "high"]}
        return xarray.Dataset(
            variables,
            coordinates,
            {"output": self.output, "runs": self.runs, "failed": self.failed},
        )

    def _content(self) -> Content:
        rows = []
        for i in np.argsort(-self.total_order):
            low, high = self.total_order_interval[i]
            total = f"total {self.total_order[i]:6.3f} ({low:.3f} to {high:.3f})"
            rows.append(("", self.parameters[i], total, f"first {self.first_order[i]:6.3f}"))
        runs = f"{self.runs} runs, {self.failed} failed and part of it"
        return [f"Sensitivity of {self.output} ({runs})", *tables.as_text(rows)]


@notices.each_warning_once
@checks.known_keywords
@announced("compiling the program of a sensitivity analysis")
@takes_runs
def sensitivity(
    scenario: Scenario,
    perturbations: Mapping[str, Perturbation],
    *,
    duration: float,
    dt: float = 1e-3,
    output: str | Callable[[Metrics], Any] = "margin",
    points: int = 256,
    seed: int = 0,
    method: str = "rk4",
    metrics: Sequence[Fold] | None = None,
    backend: str = "auto",
    executor: LocalExecutor | Executor | None = None,
    progress: bool | None = None,
) -> Sensitivity:
    """Which of the perturbed parameters matter for a metric: first-order and total Sobol indices.

        S_i = var(E[y | x_i]) / var(y),   ST_i = E[var(y | x_~i)] / var(y)

    Args:
      scenario: what to run, of n joints.
      perturbations: path -> `factor`, `offset` or `value` of a distribution; each entry of a vector
        leaf counts by itself.
      duration: length of a run [s].
      dt: time step [s].
      output: y: a metric's name (its worst joint), or a function of the metrics (N, ...) that
        returns (N,).
      points: n, a power of two; n (d + 2) runs are made for d perturbed numbers.
      seed: whole number that fixes the design.
      method: "rk4", "heun" or "euler".
      metrics: the folds to run; None for `iblf_jax.metrics.standard()`.
      backend: "auto", "native", "gpu" or "vmap".
      executor: where the runs are computed, as in `monte_carlo`.
      progress: a progress bar; by default it is shown on a terminal.
      runs_as: an `ij.Runs`, in place of its fields.

    Returns:
      A `Sensitivity`, with bootstrap intervals.

    Raises:
      ValueError: bad arguments, or an output that is not finite in some run or the same in all.

    Source: A. Saltelli et al., Computer Physics Communications 181 (2010) 259-270.
    """
    executor = executor_of(executor)
    points = checks.positive_integer("points", points, most=MAX_SOBOL[1])
    if points & (points - 1) or points < 2:
        nearest = max(2, 1 << round(np.log2(points)))
        raise checks.fail("points", points, "a power of two", f"Take points={nearest}.")
    if not isinstance(output, str) and not callable(output):
        raise checks.fail("output", output, "the name of a metric, or a function of the metrics")
    if isinstance(perturbations, Mapping) and not perturbations:
        raise checks.fail("perturbations", perturbations, "at least one perturbation")
    options = RunOptions(duration, dt, method, backend, seed, runs=1)
    prepared = prepare(scenario, perturbations, options, metrics)
    if isinstance(output, str):
        checks.one_of("output", output, sorted(result_shapes(prepared).metrics))
    shapes = draw_shapes(prepared.program.targets, prepared.shared.uncertain.perturbations)
    names = [name for path, shape in shapes.items() for name in statistics.entry_paths(path, shape)]
    runs = points * (len(names) + 2)
    checks.fits_memory(
        "points", points, (len(names) + 2) * (case_bytes(prepared) + 3 * 8.0 * len(names))
    )
    with bar(progress, runs) as shown:
        evaluation = _Evaluation(prepared, shapes, output, executor, shown.update)
        indices, ends = _indices(evaluation, points, len(names))
    return Sensitivity(
        tuple(names),
        np.ravel(indices.first_order[0]),
        np.ravel(indices.total_order[0]),
        _ends(ends.first_order),
        _ends(ends.total_order),
        evaluation.label,
        runs,
        evaluation.failed,
    )


def _indices(evaluation: _Evaluation, points: int, dimension: int) -> tuple[Any, Any]:
    """SciPy's indices of `dimension` uniform numbers, and their bootstrap intervals."""
    from scipy import stats  # its import takes a second

    def evaluate(u: np.ndarray) -> np.ndarray:
        y = evaluation(u.T)
        # SciPy fails for a single number with a single output, so the output is given twice.
        return np.stack([y, y])

    indices = stats.sobol_indices(
        func=evaluate,
        n=points,
        dists=[stats.uniform()] * dimension,
        rng=np.random.default_rng(evaluation.prepared.options.seed),
    )
    # The variance of the first two evaluations is the denominator of all indices.
    if np.ptp(np.concatenate(evaluation.values[:2])) == 0:
        raise checks.fail(
            evaluation.label,
            float(evaluation.values[0][0]),
            "an output that is not the same in all runs",
            "Choose another output, wider distributions or more points.",
        )
    with warnings.catch_warnings():
        # Where an index is the same in every resample, SciPy warns and gives NaN for its interval.
        warnings.simplefilter("ignore")
        return indices, indices.bootstrap(confidence_level=0.95)


def _ends(bootstrapped: Any) -> np.ndarray:
    """The BCa interval of each index, (d, 2); percentiles of the resamples where not finite."""
    interval = bootstrapped.confidence_interval
    ends = np.stack([np.ravel(interval.low[0]), np.ravel(interval.high[0])], -1)
    resampled = np.atleast_2d(bootstrapped.bootstrap_distribution[0])
    percentiles = np.stack(
        [np.nanquantile(np.where(np.isfinite(x), x, np.nan), TAILS) for x in resampled]
    )
    return np.where(np.isfinite(ends), ends, percentiles)


@dataclasses.dataclass(eq=False)
class _Evaluation:
    """The output as a function of points of the unit cube."""

    prepared: PreparedStudy
    shapes: dict[str, tuple[int, ...]]
    """Name of the draws -> shape of their uniform numbers."""
    output: str | Callable[[Metrics], Any]
    executor: LocalExecutor | Executor
    advance: Callable[[int], None]
    failed: int = 0
    """Number of runs that failed until now."""
    values: list[np.ndarray] = dataclasses.field(default_factory=list)
    """The outputs of all evaluations until now."""

    @property
    def name(self) -> str:
        """The output in error messages."""
        if isinstance(self.output, str):
            return self.output
        return "output"

    @property
    def label(self) -> str:
        """The output in the result."""
        return str(getattr(self.output, "__name__", self.name))

    def __call__(self, u: np.ndarray) -> np.ndarray:
        """The outputs at points u, (N, d) -> (N,)."""
        dtype = self.prepared.scenario.initial.q.dtype
        designed = split(u, self.shapes, dtype)
        options = dataclasses.replace(self.prepared.options, runs=len(u))
        prepared = dataclasses.replace(self.prepared, options=options, designed=designed)
        results = run_all_cases(prepared, self.executor, self.advance)
        y = self._output_of(results.metrics)
        if y.shape != (len(u),) or y.dtype.kind not in "fiub":
            raise checks.fail(
                self.name,
                y,
                f"one number a run, shape ({len(u)},)",
                f"Its shape is {y.shape}, its type {y.dtype}.",
            )
        invalid = int(np.sum(~np.isfinite(y)))
        if invalid:
            raise checks.fail(
                self.name,
                f"{invalid} of {len(u)} runs without a finite value",
                "finite numbers",
                "Choose another output or narrower distributions.",
            )
        self.failed += int(np.sum(has_flag(results.status, FAILED)))
        self.values.append(y.astype(float))
        return self.values[-1]

    def _output_of(self, metrics: dict[str, Any]) -> np.ndarray:
        if isinstance(self.output, str):
            return statistics.worst_joint(metrics, self.output)
        try:
            units = metric_units(self.prepared.shared.folds, self.prepared.scenario)
            return np.asarray(self.output(Metrics(metrics, units)))
        except Exception as error:
            expected = "a function of the metrics that returns one number a run"
            raise checks.fail("output", f"{type(error).__name__}: {error}", expected) from error
