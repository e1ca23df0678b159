"""`sweep`: runs a scenario over many values of its parameters; a store makes it resumable."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from iblf_jax.cli._studies import STUDY_EPILOG, add_study_arguments, run_study, write_netcdf
from iblf_jax.core.tables import as_text, number

if TYPE_CHECKING:
    import xarray

MAX_ROWS = 40


HELP = "run a scenario over many values of its parameters"
DESCRIPTION = (
    "Run the sweep that a file describes (a scenario file with [run], [grid], [sweep] and,"
    " if runs are perturbed, [perturbations]).  With --store it is written unit by unit;"
    " killed or interrupted, the same command computes the rest."
)
EPILOG = STUDY_EPILOG


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    parser.add_argument("file", metavar="SWEEP.toml", help="the sweep file")
    parser.add_argument(
        "--store", metavar="FOLDER.zarr", help="write to this store, and compute what it lacks"
    )
    parser.add_argument(
        "--shared",
        action="store_true",
        help="several processes run this command on the same store at the same time",
    )
    add_study_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""

    def work(execution: dict[str, Any]) -> int:
        from iblf_jax.core.status import FAILED, has_flag
        from iblf_jax.files.study import load_study_file
        from iblf_jax.studies import StoreOptions
        from iblf_jax.studies.sweep import sweep

        file = load_study_file(args.file, "sweep")
        options = dict(file.options)
        unit = options.pop("unit", None)
        store = None
        if args.store is not None:
            store = StoreOptions(args.store, unit, shared=args.shared)
        data = sweep(
            file.scenario,
            file.grid,
            perturbations=file.perturbations,
            store=store,
            **options | execution,
        )
        print(report(data))
        write_netcdf(data, args.out)
        return int(has_flag(data.status, FAILED).any())

    return run_study(args, work)


def report(data: xarray.Dataset) -> str:
    """One line per point: how many runs failed, the worst and the median of the smallest margin."""
    import json

    import numpy as np

    from iblf_jax.core.status import FAILED, has_flag

    config = json.loads(data.attrs["config"])
    runs = config["runs"]
    failed = has_flag(data.status, FAILED).values.reshape(-1, runs).sum(1)
    rows = [[*(config["points"] or ["point"]), "failed"]]
    margin = None
    if "margin" in data:
        margin = data["margin"].min("joint").values.reshape(-1, runs)
        rows[0] += ["worst margin [rad]", "median margin [rad]"]
    for point, indices in enumerate(np.ndindex(*config["dims"].values())):
        index = dict(zip(config["dims"], indices, strict=True))
        values = [_tick(p["values"][index[p["along"]]]) for p in config["points"].values()]
        cells = [*(values or ["nominal"]), f"{failed[point]} of {runs}"]
        if margin is not None:
            cells += [number(np.nanmin(margin[point])), number(np.nanmedian(margin[point]))]
        rows.append(cells)
    more = []
    if len(rows) > MAX_ROWS + 1:
        more = [f"... and {len(rows) - 1 - MAX_ROWS} more points"]
    head = (
        f"{data.attrs['cases']} runs of {data.attrs['duration']:g} s, dt = {data.attrs['dt']:g} s,"
        f" seed {data.attrs['seed']}"
    )
    return "\n".join([head, "", *as_text(rows[: MAX_ROWS + 1], left=(0,)), *more])


def _tick(value: object) -> str:
    if isinstance(value, list):
        return " ".join(f"{x:.4g}" for x in value)
    return f"{value:.4g}"
