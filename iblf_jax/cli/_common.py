"""Functions that several commands share.

They define the arguments that select, change and run a scenario, and they print and write results.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from iblf_jax.files.scenario import ScenarioFile
    from iblf_jax.simulation.results import Rollout

RUN_DEFAULTS: dict[str, Any] = {"duration": 20.0, "dt": 1e-3, "method": "rk4", "record_every": 1}
"""Options of a run that neither the command line nor the scenario file gives."""

FAILURES = "a bound was violated, the state diverged, or the step was too large."
"""The reasons for which a run fails, for help texts."""


def add_scenario_arguments(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """Adds SCENARIO (optional if there is a default), --arg and --set."""
    help_text = "a scenario file, or the name of a preset"
    optional: dict[str, Any] = {}
    if default:
        help_text += f" (default: {default})"
        optional = {"nargs": "?", "default": default}
    parser.add_argument("scenario", metavar="SCENARIO.toml|PRESET", help=help_text, **optional)
    add_preset_arguments(parser)
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="PATH=VALUE",
        help=(
            "the value of a parameter, such as controller.K2=30 or initial.q=[0.7,0.6]; may be"
            " repeated"
        ),
    )


def add_preset_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds --arg."""
    parser.add_argument(
        "--arg",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="an argument of the preset, such as law=log; may be repeated",
    )


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds --duration, --dt, --method and --record-every."""
    parser.add_argument(
        "--duration",
        type=float,
        metavar="S",
        help="length of the run [s] (default: the file's, else 20)",
    )
    parser.add_argument(
        "--dt", type=float, metavar="S", help="time step [s] (default: the file's, else 0.001)"
    )
    parser.add_argument("--method", help="rk4, heun or euler (default: the file's, else rk4)")
    parser.add_argument(
        "--record-every",
        type=int,
        metavar="N",
        help="record every N-th step (default: the file's, else 1)",
    )


def scenario_of(args: argparse.Namespace) -> ScenarioFile:
    """The scenario of the arguments with its changes, and the [run] table of its file."""
    from iblf_jax.files.scenario import ScenarioFile, from_dict, load_scenario_file
    from iblf_jax.files.values import did_you_mean, numbers
    from iblf_jax.presets import PRESETS
    from iblf_jax.simulation.paths import with_parameters

    arguments = assignments("--arg", args.arg)
    if args.scenario in PRESETS:
        source = ""
        if arguments:
            source = "--arg"
        file = from_dict({"preset": args.scenario, "arguments": arguments}, source=source)
    elif arguments:
        raise ValueError(
            f"--arg: {args.scenario} is not a preset, and only presets take arguments; use --set"
            " for parameters."
        )
    else:
        if not Path(args.scenario).is_file():
            remedy = did_you_mean(args.scenario, PRESETS)
            if args.scenario.endswith(".toml"):
                remedy = "Give the path of a scenario file."
            raise ValueError(f"{args.scenario}: no such file, and no such preset. {remedy}")
        file = load_scenario_file(args.scenario)
    changes = assignments("--set", args.set)
    try:
        changes = {path: numbers(value, path) for path, value in changes.items()}
        return ScenarioFile(with_parameters(file.scenario, changes), file.run)
    except ValueError as error:
        raise ValueError(f"--set: {error}") from error


def assignments(option: str, words: list[str]) -> dict[str, Any]:
    """The NAME=VALUE words of an option as a dict; a value that is not TOML is a string."""
    from iblf_jax.core import checks
    from iblf_jax.files.values import toml_tables

    values = {}
    for word in words:
        # The part of NAME in brackets is the name of a link, which can contain "=".
        found = re.fullmatch(
            r"""((?:\["(?:[^"\\]|\\.)*"\]|\[[^\]]*\]|[^=\[])*)=(.*)""", word, re.DOTALL
        )
        name = text = ""
        if found:
            name, text = found.groups()
        if not name.strip() or not text.strip():
            examples = {"--arg": "law=log", "--set": "controller.K2=30"}
            raise checks.fail(option, word, f"NAME=VALUE, such as {examples[option]}")
        try:
            values[name.strip()] = toml_tables(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            values[name.strip()] = text.strip()
        except ValueError as error:
            raise checks.fail(
                f"{option} {name.strip()}", text, "a value in TOML", f"It has {error}."
            ) from None
    return values


def run_options(args: argparse.Namespace, file: ScenarioFile) -> dict[str, Any]:
    """The options duration, dt, method and record_every of a run.

    The command line takes precedence over the file, and the file over the defaults.
    """
    return RUN_DEFAULTS | file.run | given_options(args, *RUN_DEFAULTS)


def given_options(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """The named options that have a value."""
    values = vars(args)
    return {name: values[name] for name in names if values.get(name) is not None}


def optional_folder(name: str | None) -> Path | None:
    """The folder of --out as `output_folder` returns it, or None without --out."""
    if not name:
        return None
    return output_folder(name)


def output_folder(name: str, argument: str = "--out") -> Path:
    """The folder of an argument, which is created if it does not exist.

    Raises:
      ValueError: the folder cannot be written.
    """
    folder = Path(name)
    reason = "no permission"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK | os.X_OK):
            return folder
    except OSError as error:
        reason = str(error.strerror)
    raise ValueError(f"{argument}: got {name!r}, expected a folder that can be written ({reason}).")


# ------------------------------------------------------------------------------- numbers as text


def write_json(path: Path, value: object) -> None:
    """Writes strict JSON."""
    from iblf_jax.core import tables

    path.write_text(
        json.dumps(tables.for_json(value), indent=2, allow_nan=False) + "\n", encoding="utf-8"
    )


def status_and_metrics(run: Rollout) -> dict[str, Any]:
    """The status and the metrics of one run, for JSON."""
    from iblf_jax.core.status import Status, describe
    from iblf_jax.simulation.units import status_words

    status = Status(int(run.status))
    return {
        "status": describe(status, status_words(run.scenario)),
        "flags": [flag.name for flag in Status if flag and flag in status],
        "fastest_mode": {"value": run.fastest_mode, "unit": "1/s"},
        "metrics": {
            name: {"value": value, "unit": run.metrics.units.get(name, "1")}
            for name, value in run.metrics.items()
        },
    }
