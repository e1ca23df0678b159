"""`identify`: estimates parameters of a robot from its log.

It writes the scenario with the estimates, a report and a figure.
"""

from __future__ import annotations

import argparse
import json

HELP = "estimate parameters of a robot from its log"
DESCRIPTION = (
    "Estimate the parameters that an identification file names (its format:"
    " iblf_jax.files.identification) from the log that it names; print values, standard"
    " errors and the parameters that the log does not identify."
)
EPILOG = "Exit code 1 if the log does not identify one of the parameters."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    parser.add_argument("file", metavar="IDENTIFY.toml", help="an identification file")
    parser.add_argument(
        "--log",
        action="append",
        metavar="FILE",
        help=(
            "use this log, .csv, .nc or the folder of a rosbag2 recording, instead of the file's;"
            " may be repeated"
        ),
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        help=(
            "write scenario.toml, identification.npz, identification.json, identification.html and"
            " .png into this folder"
        ),
    )


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from iblf_jax.cli._common import given_options, optional_folder
    from iblf_jax.files.identification import identify_file

    folder = optional_folder(args.out)
    result = identify_file(args.file, **given_options(args, "log"))
    print(result)
    if folder is not None:
        from iblf_jax import plotting
        from iblf_jax.files.scenario import save_scenario
        from iblf_jax.reports import report

        save_scenario(result.scenario, folder / "scenario.toml")
        result.save(folder / "identification.npz")
        text = json.dumps(result.to_dict(), indent=1, allow_nan=False)
        (folder / "identification.json").write_text(text, encoding="utf-8")
        report(result, folder / "identification.html")
        plotting.save({"identification": result.plot()}, folder, formats=("png",))
        print(
            f"\nwritten to {folder}: scenario.toml, identification.npz, identification.json,"
            " identification.html, identification.png"
        )
    return int(any(number.value is None for number in result.requested_numbers))
