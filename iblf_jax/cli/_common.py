"""What the commands share: how a scenario is named, changed and run, how results are printed and
written.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from iblf_jax.files.scenario import ScenarioFile
    from iblf_jax.simulation.results import Rollout

RUN_DEFAULTS: dict[str, Any] = {"duration": 20.0, "dt": 1e-3, "method": "rk4", "record_every": 1}
"""How a scenario is run if neither the command line nor its file says."""


def add_scenario_arguments(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """SCENARIO (which may be left out if there is a default), --arg and --set."""
    words = "a scenario file, or the name of a preset"
    optional: dict[str, Any] = {}
    if default:
        words += f" (default: {default})"
        optional = {"nargs": "?", "default": default}
    parser.add_argument("scenario", metavar="SCENARIO.toml|PRESET", help=words, **optional)
    parser.add_argument(
        "--arg",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="an argument of the preset, such as law=log; may be repeated",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="PATH=VALUE",
        help=(
            "another value for a parameter, such as controller.K2=30 or initial.q=[0.7,0.6]; may be"
            " repeated"
        ),
    )


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """--duration, --dt, --method, --record-every."""
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
    """The scenario that the arguments name, with their changes, and the [run] table of its file."""
    from iblf_jax.files.scenario import ScenarioFile, from_dict, load_scenario_file
    from iblf_jax.files.values import numbers
    from iblf_jax.presets import PRESETS
    from iblf_jax.simulation.paths import with_parameters

    words = assignments("--arg", args.arg)
    if args.scenario in PRESETS:
        source = ""
        if words:
            source = "--arg"
        file = from_dict({"preset": args.scenario, "arguments": words}, source=source)
    elif words:
        raise ValueError(
            f"--arg: {args.scenario} is not a preset, and only presets take arguments; use --set"
            " for parameters."
        )
    else:
        _check_exists(args.scenario)
        file = load_scenario_file(args.scenario)
    changes = assignments("--set", args.set)
    try:
        changes = {path: numbers(value, path) for path, value in changes.items()}
        return ScenarioFile(with_parameters(file.scenario, changes), file.run)
    except ValueError as error:
        raise ValueError(f"--set: {error}") from error


def _check_exists(name: str) -> None:
    from iblf_jax.files.values import did_you_mean
    from iblf_jax.presets import PRESETS

    if not Path(name).is_file():
        remedy = did_you_mean(name, PRESETS)
        if name.endswith(".toml"):
            remedy = "Give the path of a scenario file."
        raise ValueError(f"{name}: no such file, and no such preset. {remedy}")


def assignments(option: str, words: list[str]) -> dict[str, Any]:
    """NAME=VALUE words as a dict; values are TOML, and a bare word is a string."""
    from iblf_jax.core import checks
    from iblf_jax.files.values import toml_tables

    values = {}
    for word in words:
        # Of NAME the part in brackets, the name of a link, may hold an = itself.
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
    """Duration, dt, method and record_every: the command line's, else the file's, else the
    defaults.
    """
    given = {
        key: getattr(args, key) for key in RUN_DEFAULTS if getattr(args, key, None) is not None
    }
    return RUN_DEFAULTS | file.run | given


def optional_folder(name: str | None) -> Path | None:
    """As `output_folder`; None without --out."""
    if not name:
        return None
    return output_folder(name)


def output_folder(name: str) -> Path:
    """The folder of --out, made if it does not exist; ValueError if it cannot be written."""
    folder = Path(name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(
            f"--out: got {name!r}, expected a folder that can be written ({error.strerror})."
        ) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(
            f"--out: got {name!r}, expected a folder that can be written (no permission)."
        )
    return folder


# ------------------------------------------------------------------------------- numbers as text


def strict(value: Any) -> Any:
    """`value` in what strict JSON has: arrays become lists, NaN and infinities null."""
    if isinstance(value, Mapping):
        return {str(key): strict(x) for key, x in value.items()}
    if isinstance(value, str | bool | int) or value is None:
        return value
    if isinstance(value, list | tuple):
        return [strict(x) for x in value]
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        return value
    return strict(np.asarray(value).tolist())


def write_json(path: Path, value: Any) -> None:
    """Writes strict JSON."""
    path.write_text(json.dumps(strict(value), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def verdict(run: Rollout) -> dict[str, Any]:
    """Status and metrics of one run, for JSON."""
    from iblf_jax.core.status import Status, describe

    status = Status(int(run.status))
    return {
        "status": describe(status),
        "flags": [flag.name for flag in Status if flag and flag in status],
        "fastest_mode": {"value": run.fastest_mode, "unit": "1/s"},
        "metrics": {
            name: {"value": value, "unit": run.metrics.units.get(name, "1")}
            for name, value in run.metrics.items()
        },
    }


def number(value: Any) -> str:
    """A number in four significant digits; a dash for what never happened."""
    value = float(value)
    if not math.isfinite(value):
        return "-"
    return f"{value:.4g}"


def metrics_table(runs: Mapping[str, Rollout]) -> str:
    """Metrics of runs side by side, one column a joint, with units."""
    from iblf_jax.core import tables
    from iblf_jax.simulation.signals import OF_REGIONS
    from iblf_jax.world.robots import joint_names

    first = next(iter(runs.values()))
    joints = joint_names(first.scenario.plant, first.n)
    rows = [["metric", "unit", *(cell for _ in runs for cell in joints)]]
    for name, unit in first.metrics.units.items():
        values = [np.ravel(run.metrics[name]) for run in runs.values()]
        # One row a region: there may be more of them than joints.
        lines = [(name, values)]
        if name in OF_REGIONS:
            lines = [
                (f"{name}[{i}]", [x[i : i + 1] for x in values]) for i in range(values[0].size)
            ]
        is_index = name.endswith(("violation_joint", "violation_region"))
        for shown, numbers in lines:
            row = [shown, unit]
            for x in numbers:
                cells = [number(math.nan if is_index and y < 0 else y) for y in x]
                row += [*cells, *[""] * (first.n - len(cells))]
            rows.append(row)
    if any(runs):  # a name, over the first of its joints
        rows.insert(0, ["", "", *(cell for name in runs for cell in [name, *[""] * (first.n - 1)])])
    return "\n".join(tables.as_text(rows, left=(0, 1)))
