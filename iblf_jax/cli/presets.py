"""`presets`: lists the predefined scenarios, or prints one of them as a scenario file."""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Callable
from typing import Any

from iblf_jax.cli._common import add_preset_arguments, assignments

HELP = "list the predefined scenarios"
DESCRIPTION = "List the presets, describe one, or print it as a scenario file."
EPILOG = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    parser.add_argument("name", nargs="?", metavar="PRESET", help="describe this one")
    parser.add_argument(
        "--toml", action="store_true", help="print it as a scenario file, to be edited"
    )
    add_preset_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from iblf_jax.core import tables
    from iblf_jax.files.scenario import preset_scenario, scenario_to_toml
    from iblf_jax.presets import PRESETS

    if args.name is None:
        if args.toml or args.arg:
            raise ValueError(
                "--toml and --arg: expected the name of a preset before them; `presets` lists the"
                " names."
            )
        rows = [(name, _summary(preset)) for name, preset in PRESETS.items()]
        print(*tables.as_text(rows), sep="\n")
        return 0
    scenario = preset_scenario(args.name, assignments("--arg", args.arg))
    if args.toml:
        print(scenario_to_toml(scenario, run={"duration": 20.0, "dt": 1e-3}), end="")
    else:
        arguments = inspect.signature(PRESETS[args.name]).parameters.values()
        options = " ".join(f"--arg {argument.name}={argument.default}" for argument in arguments)
        print(f"{args.name} {options}\n\n{inspect.getdoc(PRESETS[args.name])}")
    return 0


def _summary(preset: Callable[..., Any]) -> str:
    """The first paragraph of the docstring in one line."""
    paragraph = (inspect.getdoc(preset) or "").partition("\n\n")[0]
    return " ".join(paragraph.split())
