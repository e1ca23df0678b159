"""`compare`: runs several laws on one scenario, at their given gains and at equal effort."""

from __future__ import annotations

import argparse
import re
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

    from iblf_jax.studies.comparison import Comparison


HELP = "run several laws side by side"
DESCRIPTION = (
    "Run several laws on one scenario, at their given gains and at equal effort (RMS torque"
    " above gravity), and print one table for each."
)
EPILOG = f"Exit code 1 if a run at the given gains failed: {FAILURES}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    add_scenario_arguments(parser, default="zhang_yan_2024")
    add_run_arguments(parser)
    parser.add_argument(
        "--laws",
        nargs="+",
        metavar="LAW",
        help="the laws, the first of which sets the effort (default: the paper's)",
    )
    parser.add_argument(
        "--gains-only", action="store_true", help="skip the comparison at equal effort"
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="write comparison.txt, .csv and .json, figures and rollouts.nc into this folder",
    )


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from iblf_jax.control.controllers import LAWS
    from iblf_jax.studies.compare import compare

    file = scenario_of(args)
    options = run_options(args, file)
    folder = optional_folder(args.out)
    words = ",".join(args.laws or LAWS).split(",")
    laws = [name for name in words if name]
    result = compare(file.scenario, laws, equal_effort=not args.gains_only, **options)
    print(f"{args.scenario}\n{result!r}")
    if folder is not None:
        _write(folder, args.scenario, result, options)
    return int(bool(result.failed))


def _write(folder: Path, source: str, result: Comparison, options: dict[str, Any]) -> None:
    import iblf_jax
    from iblf_jax import plotting
    from iblf_jax.files.rollouts import save_rollouts
    from iblf_jax.world.plants import component_names

    (folder / "comparison.txt").write_text(f"{result!r}\n", encoding="utf-8")
    result.to_pandas().to_csv(folder / "comparison.csv")
    report = {
        "source": source,
        "run": options,
        "iblf_jax_version": iblf_jax.__version__,
        "notes": result.notes,
        "factors": result.factors,
        "searches": {name: found.to_dict() for name, found in result.searches.items()},
        "gains": {name: status_and_metrics(one) for name, one in result.rollouts.items()},
        "effort": {name: status_and_metrics(one) for name, one in result.equal_effort.items()},
    }
    write_json(folder / "comparison.json", report)
    joints = enumerate(component_names(result.scenario.plant))
    figures = {
        f"comparison_{re.sub(r'[^-.a-zA-Z0-9]+', '_', name)}": plotting.comparison(result, i)
        for i, name in joints
    }
    plotting.save(figures, folder, formats=("png", "pdf"))
    save_rollouts(result.rollouts, folder / "rollouts.nc")
    names = ", ".join(figures)
    print(
        f"\nwritten to {folder}: comparison.txt, comparison.csv, comparison.json, {names} (.png,"
        " .pdf), rollouts.nc"
    )
