"""`tune`: tunes the gains of a tuning file; writes the tuned scenario, a report and a figure."""

from __future__ import annotations

import argparse
import dataclasses
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from iblf_jax.tuning import TuningReport


HELP = "tune gains by gradient"
DESCRIPTION = (
    "Tune the parameters of a tuning file (its format: iblf_jax.files.tuning); print the"
    " report, on new random runs if there are perturbations."
)
EPILOG = (
    "Exit code 1 if a bound is violated (more often than a requirement allows, if there is one), a"
    " requirement failed, also at half the time step, the objective did not decrease, or the claim"
    " `confirm` of the file was not confirmed."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    parser.add_argument("file", metavar="TUNE.toml", help="a tuning file")
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="write scenario.toml, tuning.npz, report.txt and tuning.png into this folder",
    )
    parser.add_argument(
        "--checkpoint",
        metavar="FILE",
        help="save the state to this file after each step, and resume from it if it exists",
    )
    parser.add_argument(
        "--effort",
        choices=("quick", "normal", "thorough"),
        help="how much is evaluated at most (default: the file's, else normal)",
    )
    parser.add_argument(
        "--iterations",
        type=int,
        metavar="N",
        help="largest number of steps of the solver (default: that of the effort)",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from iblf_jax.cli._common import given_options, optional_folder
    from iblf_jax.files.tuning import tune_file
    from iblf_jax.tuning.options import effort_of

    folder = optional_folder(args.out)
    options = given_options(args, "checkpoint", "effort")
    if args.iterations is not None:
        effort = effort_of(args.effort or "normal")
        options["effort"] = dataclasses.replace(effort, iterations=args.iterations)
    if args.quiet:
        options["progress"] = False
    result = tune_file(args.file, **options)
    print(result.report)
    print(result)
    if folder is not None:
        from iblf_jax import plotting
        from iblf_jax.files.scenario import save_scenario

        timing = {
            "duration": result.setup.duration,
            "dt": result.setup.dt,
            "method": result.setup.method,
        }
        save_scenario(result.scenario, folder / "scenario.toml", run=timing)
        result.save(folder / "tuning.npz")
        (folder / "report.txt").write_text(f"{result.report}\n{result}\n", encoding="utf-8")
        plotting.save({"tuning": result.plot()}, folder, formats=("png",))
        print(f"\nwritten to {folder}: scenario.toml, tuning.npz, report.txt, tuning.png")
    is_refuted = result.confirmation is not None and not result.confirmation.is_confirmed
    return int(is_refuted or _has_failed(result.report))


def _has_failed(report: TuningReport) -> bool:
    """Whether bounds or requirements failed, or the objective went up although not all requirements
    pass.
    """
    if report.failed:
        return True
    if report.verdicts and report.passed:
        return False
    objective = report.changes[0]
    return objective.after > objective.before
