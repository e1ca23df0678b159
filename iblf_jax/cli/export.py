"""`export`: writes the law or the closed loop of a scenario as C99, an FMU or WebAssembly."""

from __future__ import annotations

import argparse

from iblf_jax.cli._common import add_scenario_arguments, output_folder, scenario_of

HELP = "write a law as C99 or an FMU, or a closed loop for a browser"
DESCRIPTION = (
    "Write the law of a scenario as C99 or an FMU, or its closed loop as an FMU or"
    " WebAssembly; print files, operations and sizes."
)
EPILOG = "Exit code 2 also if a compiler is missing or fails."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    add_scenario_arguments(parser)
    parser.add_argument("--out", required=True, metavar="DIR", help="the folder to write into")
    parser.add_argument(
        "--target", default="c", metavar="NAME", help="c, fmu, fmu-loop or wasm (default: c)"
    )
    parser.add_argument(
        "--period",
        type=float,
        metavar="S",
        help="sampling period of the law [s] (default: the scenario's)",
    )
    parser.add_argument(
        "--dtype", default="double", metavar="TYPE", help="double or float (default: double)"
    )
    parser.add_argument(
        "--reference",
        default="inside",
        metavar="WHERE",
        help="inside (a function of time) or given (an input at every sample) (default: inside)",
    )
    parser.add_argument(
        "--name",
        metavar="NAME",
        help="prefix of every name in the code (default: iblf_law or iblf_loop)",
    )
    parser.add_argument(
        "--dt",
        type=float,
        metavar="S",
        help="time step of a closed loop [s] (default: the file's, else 0.001)",
    )
    parser.add_argument(
        "--method",
        help="integrator of a closed loop: rk4, heun or euler (default: the file's, else rk4)",
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        metavar="N",
        help="seed of a closed loop's sensor noise (default: 0)",
    )


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from iblf_jax.cli import complain
    from iblf_jax.cli._common import given_options, run_options
    from iblf_jax.deployment.export import export
    from iblf_jax.kernels import ToolchainError

    file = scenario_of(args)
    options = run_options(args, file)
    names = ("target", "period", "dtype", "reference", "name", "seed")
    chosen = given_options(args, *names) | {key: options[key] for key in ("dt", "method")}
    try:
        print(export(file.scenario, output_folder(args.out), **chosen))
    except ToolchainError as error:
        complain(str(error))
        return 2
    return 0
