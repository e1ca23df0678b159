"""`parameters`: lists the numbers of a scenario that can be set, swept, perturbed or tuned."""

from __future__ import annotations

import argparse

from iblf_jax.cli._common import add_scenario_arguments, scenario_of


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = subparsers.add_parser(
        "parameters",
        help="list the parameters of a scenario: path, shape, unit, value",
        description=(
            "List every parameter of a scenario with the path by which --set, sweeps and tuning"
            " address it."
        ),
    )
    add_scenario_arguments(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from iblf_jax.simulation.paths import parameters

    print(repr(parameters(scenario_of(args).scenario)))
    return 0
