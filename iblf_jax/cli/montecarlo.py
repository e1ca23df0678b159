"""`montecarlo`: runs one scenario many times with random parameters."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from iblf_jax.cli._studies import STUDY_EPILOG, add_study_arguments, run_study, write_netcdf
from iblf_jax.core.tables import as_text, number

if TYPE_CHECKING:
    from iblf_jax.studies.study import Study


HELP = "run a scenario many times with random parameters"
DESCRIPTION = (
    "Run the study that a file describes (a scenario file with [run], [perturbations] and"
    " [study]); print how often the bounds were violated, quantiles of the metrics, the"
    " worst runs, and which parameters correlate with the margin."
)
EPILOG = STUDY_EPILOG


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    parser.add_argument("file", metavar="STUDY.toml", help="the study file")
    parser.add_argument(
        "--runs", type=int, metavar="N", help="number of runs (default: the file's)"
    )
    parser.add_argument("--seed", type=int, metavar="N", help="seed (default: the file's, else 0)")
    add_study_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""

    def work(execution: dict[str, Any]) -> int:
        from iblf_jax.cli._common import given_options
        from iblf_jax.files.study import load_study_file
        from iblf_jax.studies.monte_carlo import monte_carlo

        file = load_study_file(args.file, "study")
        options = file.options | given_options(args, "runs", "seed") | execution
        study = monte_carlo(file.scenario, file.perturbations, **options)
        print(report(study))
        write_netcdf(study.to_xarray(), args.out)
        return int(len(study.failed) > 0)

    return run_study(args, work)


def report(study: Study) -> str:
    """The results of a study as text."""
    from iblf_jax.reports import quantiles_table

    found = study.correlations(["margin"]).correlation.sel(metric="margin")
    correlations = [(str(p), number(found.sel(parameter=p))) for p in found.parameter.values]
    lines = [
        repr(study),
        "",
        *quantiles_table(study).lines(),
        "",
        f"worst runs (smallest margin first): {', '.join(map(str, study.worst(5)))}",
        "",
        *as_text([("parameter", "rank correlation with the margin"), *correlations], left=(0,)),
    ]
    return "\n".join(lines)
