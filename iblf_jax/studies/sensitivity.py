"""Which uncertainty matters: Sobol indices of a metric by the parameters that are perturbed.

With y the metric and x_1 ... x_d independent parameters,

    S_i  = var(E[y | x_i]) / var(y)              first order: what x_i explains by itself
    ST_i = E[var(y | all but x_i)] / var(y)      total: with all its interactions; 0 if and only if
    x_i does not matter

estimated from n (d + 2) runs on a Sobol design by SciPy (`scipy.stats.sobol_indices`).

Source: A. Saltelli et al., Computer Physics Communications 181 (2010) 259-270.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from iblf_jax.core import checks, notices, tables
from iblf_jax.core.progress import bar
from iblf_jax.core.status import FAILED
from iblf_jax.engine import STUDY_MEMORY
from iblf_jax.simulation.metrics import Fold, metric_units
from iblf_jax.simulation.results import Metrics
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies import statistics
from iblf_jax.studies.blocks import block_size, checked_how, run_blocks
from iblf_jax.studies.designs import MOST_SOBOL, split
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.draws import sample_size
from iblf_jax.studies.setup import StudySetup, prepare

if TYPE_CHECKING:
    import xarray


TAILS = (0.025, 0.975)
"""Ends of an interval of 95 %."""


@dataclasses.dataclass(frozen=True, eq=False)
class Sensitivity:
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
    """What was explained."""
    runs: int
    """Runs that were made: n (d + 2)."""
    failed: int
    """How many of them failed; they are part of the estimate."""

    def to_xarray(self) -> xarray.Dataset:
        """The indices along the dimension `parameter`."""
        import xarray

        names = {"first_order": "S", "total_order": "ST"}
        variables: dict[str, Any] = {
            name: ("parameter", getattr(self, name), {"symbol": symbol})
            for name, symbol in names.items()
        }
        variables |= {
            f"{name}_interval": (("parameter", "end"), getattr(self, f"{name}_interval"))
            for name in names
        }
        coordinates = {"parameter": list(self.parameters), "end": ["low", "high"]}
        return xarray.Dataset(
            variables,
            coordinates,
            {"output": self.output, "runs": self.runs, "failed": self.failed},
        )

    def __repr__(self) -> str:
        rows = []
        for i in np.argsort(-self.total_order):
            low, high = self.total_order_interval[i]
            total = f"total {self.total_order[i]:6.3f} ({low:.3f} to {high:.3f})"
            rows.append(("", self.parameters[i], total, f"first {self.first_order[i]:6.3f}"))
        return "\n".join(
            [
                (
                    f"Sensitivity of {self.output} ({self.runs} runs, {self.failed} failed and part"
                    " of it)"
                ),
                *tables.as_text(rows),
            ]
        )


@notices.each_warning_once
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
    memory: float = STUDY_MEMORY,
    devices: Sequence[jax.Device] | None = None,
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
      backend: "auto", "native", "gpu", "xla" or "vmap".
      memory: bytes that runs in flight may take.
      devices: devices to use; all of this process if not given.
      progress: a progress bar; shown where somebody watches if not given.

    Returns:
      A `Sensitivity`, with bootstrap intervals.

    Raises:
      ValueError: bad arguments, or an output that is not finite in some run or the same in all.

    Source: A. Saltelli et al., Computer Physics Communications 181 (2010) 259-270.
    """
    points, how = (
        checks.positive_integer("points", points, most=MOST_SOBOL[1]),
        checked_how(None, memory, devices),
    )
    if points & (points - 1) or points < 2:
        raise checks.fail(
            "points",
            points,
            "a power of two",
            f"Take points={max(2, 1 << round(np.log2(points)))}.",
        )
    if not isinstance(output, str) and not callable(output):
        raise checks.fail("output", output, "the name of a metric, or a function of the metrics")
    if isinstance(perturbations, Mapping) and not perturbations:
        raise checks.fail("perturbations", perturbations, "at least one perturbation")
    timing: dict[str, Any] = {"duration": duration, "dt": dt, "method": method}
    setup = prepare(
        scenario, perturbations, 1, checks.seed(seed), metrics=metrics, backend=backend, **timing
    )
    if isinstance(output, str):
        checks.one_of("output", output, sorted(setup.shapes.metrics))
    shapes = sample_size(setup.study_run.targets, setup.shared.cases.perturbations)
    names = [
        path + "".join(f"[{i}]" for i in place)
        for path, shape in shapes.items()
        for place in np.ndindex(shape)
    ]
    checks.fits("points", points, (len(names) + 2) * (setup.bytes_a_case + 3 * 8.0 * len(names)))
    label = output if isinstance(output, str) else str(getattr(output, "__name__", "output"))
    failed, values = 0, list[np.ndarray]()
    with bar(progress, points * (len(names) + 2)) as shown:

        def evaluate(u: np.ndarray) -> np.ndarray:
            nonlocal failed
            y, bad = _evaluate(setup, u.T, shapes, output, how, shown)
            failed += bad
            values.append(y)
            # Twice, as if there were two outputs: of one number and one output SciPy makes scalars,
            # and then fails to write into them.
            return np.stack([y, y])

        from scipy import stats  # a second to import

        rng = np.random.default_rng(setup.seed)
        found = stats.sobol_indices(
            func=evaluate, n=points, dists=[stats.uniform()] * len(names), rng=rng
        )
        if (
            np.ptp(np.concatenate(values[:2])) == 0
        ):  # those of the runs whose variance all is divided by
            remedy = "Choose another output, wider distributions or more points."
            raise checks.fail(
                label, float(values[0][0]), "an output that is not the same in all runs", remedy
            )
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # where an index is the same in every resample SciPy warns and gives NaN for its interval
            ends = found.bootstrap(confidence_level=0.95)
    counts = (points * (len(names) + 2), failed)
    orders = (
        np.ravel(found.first_order[0]),
        np.ravel(found.total_order[0]),
        _ends(ends.first_order),
        _ends(ends.total_order),
    )
    return Sensitivity(tuple(names), *orders, label, *counts)


def _ends(bootstrapped: Any) -> np.ndarray:
    """The interval of each index, (d, 2); where all resamples have the same, or BCa has none for
    another reason, their percentiles.
    """
    interval = bootstrapped.confidence_interval
    ends = np.stack([np.ravel(interval.low[0]), np.ravel(interval.high[0])], -1)
    resampled = np.atleast_2d(bootstrapped.bootstrap_distribution[0])
    percentiles = np.stack(
        [np.nanquantile(np.where(np.isfinite(x), x, np.nan), TAILS) for x in resampled]
    )
    return np.where(np.isfinite(ends), ends, percentiles)


def _called(output: Callable[[Metrics], Any], metrics: Metrics) -> np.ndarray:
    try:
        return np.asarray(output(metrics))
    except Exception as error:
        expected = "a function of the metrics that returns one number a run"
        raise checks.fail("output", f"{type(error).__name__}: {error}", expected) from error


def _evaluate(
    setup: StudySetup, u: np.ndarray, shapes: dict, output: Any, how: dict[str, Any], shown: Any
) -> tuple[np.ndarray, int]:
    """The output of every row of the unit cube, and how many of these runs failed."""
    dtype = setup.shared.cases.scenario.initial.q.dtype
    designed = dataclasses.replace(setup, runs=len(u), designed=split(u, shapes, dtype))
    parts: list[Any] = []
    for _, part in run_blocks(
        setup.study_run, setup.shared, designed.lanes, range(-(-len(u) // block_size())), **how
    ):
        shown.update(min(block_size(), len(u) - len(parts) * block_size()))
        parts.append(part)
    metrics: dict[str, Any] = {
        name: np.concatenate([p.metrics[name] for p in parts])[: len(u)]
        for name in parts[0].metrics
    }
    status = np.concatenate([p.status for p in parts])[: len(u)]
    if isinstance(output, str):
        y = statistics.one_number(metrics, output)
    else:
        y = _called(output, Metrics(metrics, metric_units(setup.shared.folds)))
    name = output if isinstance(output, str) else "output"
    if y.shape != (len(u),) or y.dtype.kind not in "fiub":
        raise checks.fail(
            name,
            y,
            f"one number a run, shape ({len(u)},)",
            f"Its shape is {y.shape}, its type {y.dtype}.",
        )
    if not np.all(np.isfinite(y)):
        bad = int(np.sum(~np.isfinite(y)))
        raise checks.fail(
            name,
            f"{bad} of {len(u)} runs without a finite value",
            "finite numbers",
            "Choose another output or narrower distributions.",
        )
    return y.astype(float), int(np.sum(status & int(FAILED) != 0))
