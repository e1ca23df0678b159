"""`parameters`: lists the numbers of a scenario that can be set, swept, perturbed or tuned."""

from __future__ import annotations

import argparse

from iblf_jax.cli._common import add_scenario_arguments, scenario_of

HELP = "list the parameters of a scenario: path, shape, unit, value"
DESCRIPTION = (
    "List every parameter of a scenario with the path by which --set, sweeps and tuning address it."
)
EPILOG = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    add_scenario_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from iblf_jax.simulation.paths import parameters

    print(repr(parameters(scenario_of(args).scenario)))
    return 0
