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
from iblf_jax.core.status import FAILED, Status
from iblf_jax.engine import block_size
from iblf_jax.simulation.paths import get, parameters, with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import SIGNALS, own_dims
from iblf_jax.studies import statistics
from iblf_jax.studies.blocks import run_blocks
from iblf_jax.studies.options import ThisProcess
from iblf_jax.studies.store_config import describe_component
from iblf_jax.world.bounds import tube_at
from iblf_jax.world.regions import margins

if TYPE_CHECKING:
    import xarray

    from iblf_jax.studies.study import Study

BANDS = ("q", "e1")
"""Signals that bands are made of."""


def check_quantiles(quantiles: Sequence[float]) -> np.ndarray:
    """Numbers in [0, 1], or a ValueError."""
    values = np.atleast_1d(np.asarray(checks.as_floats("quantiles", quantiles), float).round(7))
    if values.ndim != 1 or values.size == 0 or not np.all((values >= 0) & (values <= 1)):
        raise checks.fail(
            "quantiles", quantiles, "numbers from 0 to 1", "(0.05, 0.5, 0.95), for example."
        )
    return values


def first_margins(study: Study) -> dict[str, np.ndarray]:
    """How far each run is inside its constraints at t = 0; not above zero where it starts on or
    outside them.

    By unit: "rad" and, where velocities have bounds, "rad/s", (N, n); "m" where there are m
      regions, (N, m).
    """
    return {
        unit: np.asarray(x) for unit, x in _first_margins(study.scenario, study.samples).items()
    }


@jax.jit
def _first_margins(scenario: Scenario, samples: Mapping[str, Any]) -> dict[str, jax.Array]:
    def one(drawn: Mapping[str, Any]) -> dict[str, jax.Array]:
        made = with_parameters(scenario, drawn)
        q, dq, zero = made.initial.q, made.initial.dq, jnp.zeros((), made.initial.q.dtype)
        tube = tube_at(made.reference, made.bounds, zero)
        found = {"rad": jnp.minimum(q - tube.lower, tube.upper - q)}
        if made.velocity_bounds is not None:
            low, high = made.context.speed_limits(zero)
            found["rad/s"] = jnp.minimum(dq - low, high - dq)
        if made.regions:
            found["m"] = margins(made.regions, made.plant, q)
        return found

    return jax.vmap(one)(samples)


def metric_quantiles(
    study: Study, quantiles: Sequence[float], exclude_failed: bool
) -> xarray.Dataset:
    """Quantiles of every metric over the runs; see `Study.quantiles`."""
    import xarray

    levels = check_quantiles(quantiles)
    used, counts = study.chosen(exclude_failed)
    variables = {}
    for name, values in study.metrics.items():
        values = np.asarray(values)
        made = np.full((len(levels), *values.shape[1:]), np.nan)
        if used.any():
            made = _quantile(values[used], levels)
        variables[name] = (
            ("quantile", *own_dims(name, values.shape[1:], study.scenario.n)),
            made,
            {"units": study.metrics.units.get(name, "")},
        )
    return xarray.Dataset(variables, {"quantile": levels}, counts)


def _quantile(values: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Quantiles that are values of some run, so that infinite ones do no harm."""
    return np.quantile(values, levels, axis=0, method="inverted_cdf")


def correlations(
    study: Study, metrics: Sequence[str] | None, exclude_failed: bool
) -> xarray.Dataset:
    """Spearman's rank correlation of every drawn parameter with metrics; see
    `Study.correlations`.
    """
    import xarray

    used, counts = study.chosen(exclude_failed)
    names = (
        list(study.metrics)
        if metrics is None
        else checks.listed("metrics", metrics, '["margin", "rmse"]')
    )
    drawn = statistics.columns(study.samples)
    found = np.full((len(drawn), len(names), 2), np.nan)
    for j, name in enumerate(names):
        y = statistics.one_number(study.metrics, name)[used]
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
        counts | {"of": "the worst joint of each metric"},
    )


def bands(
    study: Study, quantiles: Sequence[float], runs: int, samples: int, exclude_failed: bool
) -> xarray.Dataset:
    """Quantiles along time of position and error; see `Study.bands`."""
    import xarray

    levels, setup, size = check_quantiles(quantiles), study.setup, block_size()
    exclude_failed = checks.flag("exclude_failed", exclude_failed)
    count = min(checks.positive_integer("runs", runs), study.runs)
    record_every = max(1, setup.program.steps // checks.positive_integer("samples", samples))
    parts, times = [], np.zeros(0)
    one_block_at_a_time = ThisProcess(chunk=size)
    for _, (arrays, t, _, _) in run_blocks(
        setup, range(-(-count // size)), one_block_at_a_time, record_every=record_every
    ):
        parts.append(arrays)
        times = t[0]
    recorded = {name: np.concatenate([part[name] for part in parts])[:count] for name in parts[0]}
    used = study.chosen(exclude_failed)[0][:count]
    if not used.any():
        raise checks.fail(
            "runs",
            count,
            "at least one run that is not left out",
            "Take more runs, or exclude_failed=False.",
        )
    dims = ("quantile", "time", "joint")
    variables: dict[str, Any] = {
        name: (dims, _quantile(recorded[name][used], levels), {"units": SIGNALS[name].unit})
        for name in BANDS
    }
    edges: dict[str, Any] = {"lower": np.max, "upper": np.min, "q_d": np.median}
    for name, edge in edges.items():
        words = {
            "lower": "tightest lower bound",
            "upper": "tightest upper bound",
            "q_d": "median reference",
        }[name]
        variables[name] = (
            dims[1:],
            edge(recorded[name][used], axis=0),
            {"units": "rad", "description": f"{words} of the runs"},
        )
    failed = int(np.sum(used & (study.status[:count] & int(FAILED) != 0)))
    attributes = {
        "runs": int(used.sum()),
        "excluded": int(count - used.sum()),
        "failed_included": failed,
        "of_runs": study.runs,
    }
    return xarray.Dataset(
        variables, {"quantile": levels, "time": ("time", times, {"units": "s"})}, attributes
    )


def to_xarray(study: Study) -> xarray.Dataset:
    """Metrics, status and samples of all runs; see `Study.to_xarray`."""
    import xarray

    import iblf_jax

    n = study.scenario.n
    variables: dict[str, Any] = {}
    for name, values in study.metrics.items():
        variables[name] = (
            ("run", *own_dims(name, np.shape(values)[1:], n)),
            np.asarray(values),
            {"units": study.metrics.units.get(name, "")},
        )
    flags = [flag for flag in Status if flag]
    masks = {
        "flag_masks": np.array([int(f) for f in flags], np.int32),
        "flag_meanings": " ".join((f.name or "").lower() for f in flags),
    }
    variables["status"] = (
        "run",
        study.status,
        {"units": "1", "description": "bit flags; 0 is ok"} | masks,
    )
    variables["fastest_mode"] = ("run", study.fastest_mode, {"units": "1/s"})
    coordinates: dict[str, Any] = {"run": np.arange(study.runs)}
    for path, values in study.samples.items():
        unit = study.parameter_unit(path)
        coordinates[path] = (
            ("run", *own_dims(path, values.shape[1:], n)),
            values,
            {"units": unit, "nominal": np.asarray(get(study.scenario, path)).tolist()},
        )
    setup = study.setup
    attributes: dict[str, Any] = {
        "runs": study.runs,
        "failed": int(np.sum(study.status & int(FAILED) != 0)),
        "seed": study.seed,
    }
    attributes |= {
        "duration": study.duration,
        "dt": study.dt,
        "method": setup.program.method,
        "sampler": setup.sampler,
    }
    attributes |= {"backend": study.backend, "iblf_jax_version": iblf_jax.__version__}
    attributes["perturbations"] = json.dumps(
        {path: describe_component(p) for path, p in study.perturbations.items()}
    )
    attributes["parameters"] = json.dumps(
        {p.path: np.asarray(p.value).tolist() for p in parameters(study.scenario, named=False)}
    )
    return xarray.Dataset(variables, coordinates, attributes)
