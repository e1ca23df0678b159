"""Summaries of a study as labelled data: quantiles, rank correlations, quantile bands along time,
everything.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.status import FAILED, has_flag
from iblf_jax.engine import block_size
from iblf_jax.simulation.levels import start_levels
from iblf_jax.simulation.paths import get, unit_at, with_parameters
from iblf_jax.simulation.results import Metrics
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import dimension_names
from iblf_jax.simulation.units import signal_unit
from iblf_jax.studies import statistics
from iblf_jax.studies.blocks import run_blocks
from iblf_jax.studies.dataset import status_attributes
from iblf_jax.studies.options import LocalExecutor
from iblf_jax.studies.store_config import describe_component, values_of
from iblf_jax.studies.study_setup import PreparedStudy
from iblf_jax.world import plants
from iblf_jax.world.bounds import Funnel, bounds_at, tube_at
from iblf_jax.world.regions import margins

if TYPE_CHECKING:
    import xarray

BANDS = ("q", "e1")
"""Signals whose quantile bands are computed."""
ENVELOPES: dict[str, tuple[Any, str]] = {
    "lower": (np.max, "tightest lower bound"),
    "upper": (np.min, "tightest upper bound"),
    "q_d": (np.median, "median reference"),
}
"""Signal -> the function that reduces the curves of all runs to one, and its description."""


def check_quantiles(quantiles: Sequence[float]) -> np.ndarray:
    """Numbers in [0, 1], or a ValueError."""
    values = np.atleast_1d(np.asarray(checks.as_floats("quantiles", quantiles), float).round(7))
    if values.ndim != 1 or values.size == 0 or not np.all((values >= 0) & (values <= 1)):
        raise checks.fail(
            "quantiles", quantiles, "numbers from 0 to 1", "(0.05, 0.5, 0.95), for example."
        )
    return values


LEVELS = tuple(f"level {i:02d}" for i in range(1, plants.MAX_ORDER + 1))
"""Names of the levels in `initial_margins`, in an order that sorting keeps."""
REGIONS = "distance to regions"
"""Name of the regions in `initial_margins`."""


def initial_margins(scenario: Scenario, samples: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The margin of each run to its constraints at t = 0; positive where it starts inside them.

    By what is bounded: the levels that have bounds, by their name in `LEVELS`, (N, n), and
    `REGIONS`, (N, m) for m regions.  Bounds that follow a virtual control are left out.
    """
    return jax.tree.map(np.asarray, _initial_margins(scenario, samples))


@jax.jit
def _initial_margins(scenario: Scenario, samples: Mapping[str, Any]) -> dict[str, jax.Array]:
    def margins_of_run(drawn: Mapping[str, Any]) -> dict[str, jax.Array]:
        perturbed = with_parameters(scenario, drawn)
        q = perturbed.initial.q
        zero = jnp.zeros((), q.dtype)
        tube = tube_at(perturbed.reference, perturbed.bounds[0], zero)
        found = {LEVELS[0]: jnp.minimum(q - tube.lower, tube.upper - q)}
        x = start_levels(perturbed)
        for i, bounds in enumerate(perturbed.bounds[1:], start=1):
            if bounds is None:
                continue
            if i < perturbed.loop.plant.reference_levels:
                low, high = perturbed.context.speed_limits(zero)
            elif Funnel in (type(bounds.lower), type(bounds.upper)):
                continue  # around alpha, which the law computes
            else:
                low, high = bounds_at(bounds, zero, jnp.zeros_like(x[i]))
            found[LEVELS[i]] = jnp.minimum(x[i] - low, high - x[i])
        if perturbed.regions:
            robot = checks.given(perturbed.loop.plant.robot)
            found[REGIONS] = margins(perturbed.regions, robot, q)
        return found

    if not samples:
        # Every run has the same start, such as those that differ in their noise only.
        return jax.tree.map(lambda margin: margin[None], margins_of_run({}))
    return jax.vmap(margins_of_run)(samples)


def metric_quantiles(
    metrics: Metrics,
    n: int,
    quantiles: Sequence[float],
    used: np.ndarray,
    counts: Mapping[str, Any],
) -> xarray.Dataset:
    """Quantiles of every metric over the runs; see `Study.quantiles`.

    Args:
      metrics: of all runs.
      n: number of joints.
      quantiles: numbers from 0 to 1.
      used: the runs that count, (N,) bool.
      counts: attributes of the result.
    """
    import xarray

    levels = check_quantiles(quantiles)
    variables = {}
    for name, values in metrics.items():
        values = np.asarray(values)
        shape = values.shape[1:]
        result = np.full((len(levels), *shape), np.nan)
        if used.any():
            result = _quantile(values[used], levels)
        dims = ("quantile", *dimension_names(name, shape, n))
        variables[name] = (dims, result, {"units": metrics.units.get(name, "")})
    return xarray.Dataset(variables, {"quantile": levels}, counts)


def _quantile(values: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Quantiles without interpolation, which infinite values would make NaN."""
    return np.quantile(values, levels, axis=0, method="inverted_cdf")


def correlations(
    metrics: Metrics,
    samples: Mapping[str, Any],
    names: Sequence[str] | None,
    used: np.ndarray,
    counts: Mapping[str, Any],
) -> xarray.Dataset:
    """Spearman's rank correlation of every drawn parameter with the metrics `names`; other
    arguments as `metric_quantiles`, see `Study.correlations`.
    """
    import xarray

    if names is None:
        names = list(metrics)
    names = checks.nonempty_list("metrics", names, '["margin", "rmse"]')
    drawn = statistics.scalar_samples(samples)
    found = np.full((len(drawn), len(names), 2), np.nan)
    for j, name in enumerate(names):
        y = statistics.worst_joint(metrics, name)[used]
        for i, x in enumerate(drawn.values()):
            found[i, j] = statistics.rank_correlation(x[used], y)
    dims = ("parameter", "metric")
    variables = {
        "correlation": (dims, found[..., 0], {"units": "1"}),
        "p_value": (dims, found[..., 1], {"units": "1"}),
    }
    return xarray.Dataset(
        variables,
        {"parameter": list(drawn), "metric": names},
        {**counts, "of": "the worst joint of each metric"},
    )


def bands(
    prepared: PreparedStudy,
    quantiles: Sequence[float],
    runs: int,
    samples: int,
    used: np.ndarray,
    failed: np.ndarray,
) -> xarray.Dataset:
    """Quantiles along time of position and error; see `Study.bands`.

    Args:
      prepared: the study, whose first runs are made again.
      quantiles, runs, samples: as `Study.bands`.
      used, failed: the runs that count, and those that failed, (N,) bool.
    """
    import xarray

    levels = check_quantiles(quantiles)
    count = min(checks.positive_integer("runs", runs), prepared.options.runs)
    samples = checks.positive_integer("samples", samples, most=checks.MAX_STEPS)
    record_every = max(1, prepared.options.steps // samples)
    used = used[:count]
    if not used.any():
        raise checks.fail(
            "runs",
            count,
            "at least one run that is not left out",
            "Take more runs, or exclude_failed=False.",
        )
    size = block_size()
    blocks = range(checks.ceil_div(count, size))
    one_block_at_a_time = LocalExecutor(chunk=size)
    parts = [
        (arrays, t[0])
        for _, (arrays, t) in run_blocks(
            prepared, blocks, one_block_at_a_time, record_every=record_every
        )
    ]
    first, times = parts[0]
    recorded = {
        name: np.concatenate([arrays[name] for arrays, _ in parts])[:count][used] for name in first
    }
    dims = ("quantile", "time", "joint")
    variables: dict[str, Any] = {}
    for name in BANDS:
        attributes = {"units": signal_unit(prepared.scenario, name)}
        variables[name] = (dims, _quantile(recorded[name], levels), attributes)
    for name, (reduce, words) in ENVELOPES.items():
        attributes = {
            "units": signal_unit(prepared.scenario, name),
            "description": f"{words} of the runs",
        }
        variables[name] = (dims[1:], reduce(recorded[name], axis=0), attributes)
    counts = {
        "runs": int(used.sum()),
        "excluded": int(count - used.sum()),
        "failed_included": int(np.sum(used & failed[:count])),
        "of_runs": prepared.options.runs,
    }
    coordinates = {"quantile": levels, "time": ("time", times, {"units": "s"})}
    return xarray.Dataset(variables, coordinates, counts)


def to_xarray(
    prepared: PreparedStudy,
    metrics: Metrics,
    status: np.ndarray,
    fastest_mode: np.ndarray,
    samples: Mapping[str, Any],
) -> xarray.Dataset:
    """Metrics, status and samples of all runs; see `Study.to_xarray`."""
    import xarray

    import iblf_jax

    scenario, options = prepared.scenario, prepared.options
    variables: dict[str, Any] = {}
    for name, values in metrics.items():
        dims = ("run", *dimension_names(name, np.shape(values)[1:], scenario.n))
        variables[name] = (dims, np.asarray(values), {"units": metrics.units.get(name, "")})
    variables["status"] = ("run", status, status_attributes("0 is ok"))
    variables["fastest_mode"] = ("run", fastest_mode, {"units": "1/s"})
    coordinates: dict[str, Any] = {"run": np.arange(options.runs)}
    for path, values in samples.items():
        dims = ("run", *dimension_names(path, values.shape[1:], scenario.n))
        nominal = np.asarray(get(scenario, path)).tolist()
        unit = unit_at(scenario, path)
        coordinates[path] = (dims, values, {"units": unit, "nominal": nominal})
    attributes = {
        "runs": options.runs,
        "failed": int(np.sum(has_flag(status, FAILED))),
        "seed": options.seed,
        "duration": prepared.duration,
        "dt": prepared.dt,
        "method": options.method,
        "sampler": options.sampler,
        "backend": prepared.backend,
        "iblf_jax_version": iblf_jax.__version__,
        "perturbations": json.dumps(
            {path: describe_component(p) for path, p in prepared.perturbations.items()}
        ),
        "parameters": json.dumps(values_of(scenario)),
    }
    return xarray.Dataset(variables, coordinates, attributes)
