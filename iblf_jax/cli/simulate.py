"""`simulate`: runs a scenario file or preset once; prints and writes its status and metrics."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from iblf_jax.cli._common import (
    FAILURES,
    add_run_arguments,
    add_scenario_arguments,
    optional_folder,
    run_options,
    scenario_of,
    status_and_metrics,
    write_json,
)

if TYPE_CHECKING:
    from pathlib import Path

    from iblf_jax.simulation.results import Rollout


HELP = "run a scenario once"
DESCRIPTION = "Run a scenario once; print its status and metrics."
EPILOG = f"Exit code 1 if the run failed: {FAILURES}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    add_scenario_arguments(parser)
    add_run_arguments(parser)
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="seed of the sensor noise (default: 0)"
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="write rollout.nc, metrics.json, overview.png and scenario.toml into this folder",
    )


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from iblf_jax.core.status import FAILED, describe, has_flag
    from iblf_jax.engine.simulate import simulate
    from iblf_jax.reports import metrics_table
    from iblf_jax.simulation.units import status_words

    file = scenario_of(args)
    options = run_options(args, file)
    folder = optional_folder(args.out)
    result = simulate(file.scenario, **options, seed=args.seed)
    failed = has_flag(int(result.status), FAILED)
    print(
        f"{args.scenario}: {options['duration']:g} s, dt = {options['dt']:g} s, {options['method']}"
    )
    print(f"status: {describe(int(result.status), status_words(result.scenario))}")
    print("", *metrics_table({"": result}).lines(), sep="\n")
    if folder is not None:
        _write(folder, args.scenario, result, options, args.seed)
    return int(failed)


def _write(folder: Path, source: str, result: Rollout, options: dict[str, Any], seed: int) -> None:
    import iblf_jax
    from iblf_jax import plotting
    from iblf_jax.files.rollouts import save_rollouts
    from iblf_jax.files.scenario import save_scenario

    save_scenario(result.scenario, folder / "scenario.toml", run=options)
    save_rollouts(result, folder / "rollout.nc")
    head = {
        "source": source,
        "run": options,
        "seed": seed,
        "iblf_jax_version": iblf_jax.__version__,
    }
    write_json(folder / "metrics.json", head | status_and_metrics(result))
    plotting.save({"overview": plotting.overview(result)}, folder, formats=("png",))
    print(f"\nwritten to {folder}: rollout.nc, metrics.json, overview.png, scenario.toml")
