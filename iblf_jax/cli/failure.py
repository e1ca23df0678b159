"""`failure`: estimates the probability that a run with random parameters fails."""

from __future__ import annotations

import argparse
from typing import Any

from iblf_jax.cli._studies import add_study_arguments, run_study, write_netcdf

HELP = "estimate the probability of rare failures"
DESCRIPTION = (
    "Estimate the probability that a run fails, as a file describes it (a scenario file with"
    " [run], [perturbations] and [failure]), by subset simulation, importance sampling or"
    " Monte-Carlo simulation; print the estimate with its interval, and the most likely failure."
)
EPILOG = (
    "Exit codes: 0 done; 1 no sample failed, so that the estimate is an upper bound; 2 bad"
    " arguments or files; 3 not finished (worker lost); 130 interrupted."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    parser.add_argument("file", metavar="FAILURE.toml", help="the file")
    parser.add_argument(
        "--estimator",
        metavar="NAME",
        help="subset, importance or monte_carlo (default: the file's)",
    )
    parser.add_argument(
        "--runs", type=int, metavar="N", help="number of runs (default: the file's, else chosen)"
    )
    parser.add_argument("--seed", type=int, metavar="N", help="seed (default: the file's, else 0)")
    add_study_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""

    def work(execution: dict[str, Any]) -> int:
        from iblf_jax.cli._common import given_options
        from iblf_jax.files.study import load_study_file
        from iblf_jax.tuning import failure_probability

        file = load_study_file(args.file, "failure")
        options = file.options | given_options(args, "estimator", "runs", "seed") | execution
        found = failure_probability(file.scenario, file.perturbations, **options)
        print(repr(found))
        write_netcdf(found.to_xarray(), args.out)
        return int(found.is_upper_bound)

    return run_study(args, work)
