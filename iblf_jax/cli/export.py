"""`export`: writes the law or the closed loop of a scenario as C99, an FMU, WebAssembly or a ROS 2
package.
"""

from __future__ import annotations

import argparse
from typing import Any

from iblf_jax.cli._common import add_scenario_arguments, output_folder, scenario_of

HELP = "write a law as C99, an FMU or a ROS 2 package, or a closed loop for a browser"
DESCRIPTION = (
    "Write the law of a scenario as C99, an FMU or a ROS 2 package, or its closed loop as an FMU or"
    " WebAssembly; print files, operations and sizes."
)
EPILOG = "Exit code 2 also if a compiler is missing or fails."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    add_scenario_arguments(parser)
    parser.add_argument("--out", required=True, metavar="DIR", help="the folder to write into")
    parser.add_argument(
        "--target", default="c", metavar="NAME", help="c, fmu, fmu-loop, wasm or ros2 (default: c)"
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
        help="prefix of every name in the code, and name of a ROS 2 package (default: iblf_law or"
        " iblf_loop)",
    )
    _add_ros_arguments(parser)
    parser.add_argument(
        "--dt",
        type=float,
        metavar="S",
        help="time step of a closed loop, and the longest one of the self-test's run of a law [s]"
        " (default: the file's, else 0.001)",
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


def _add_ros_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--gain",
        dest="gains",
        action="append",
        metavar="PATH[=LOW:HIGH]",
        help="ros2: a gain that can be changed while the node runs (default range: that of tune);"
        " may be repeated",
    )
    parser.add_argument(
        "--torque-limits",
        type=float,
        nargs="+",
        metavar="TAU",
        help="ros2: largest torque of every joint, or one for all [N m] (default: the model's)",
    )
    parser.add_argument(
        "--on-fault",
        metavar="POLICY",
        help="ros2: torques of a fault, hold or zero (default: hold)",
    )


def _tunable(text: str) -> Any:
    """A gain as `export` takes it, from PATH or PATH=LOW:HIGH."""
    from iblf_jax.core import checks
    from iblf_jax.tuning import tunable

    path, equals, limits = text.partition("=")
    if not equals:
        return path
    try:
        low, high = map(float, limits.split(":"))
    except ValueError:
        remedy = "Such as --gain controller.K2=5:50."
        raise checks.fail("--gain", text, "PATH or PATH=LOW:HIGH", remedy) from None
    return tunable(path, low, high)


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from iblf_jax.cli import complain
    from iblf_jax.cli._common import given_options, run_options
    from iblf_jax.deployment.export import export
    from iblf_jax.kernels import ToolchainError

    file = scenario_of(args)
    names = ("target", "period", "dtype", "reference", "name", "seed")
    chosen = given_options(args, *names, "torque_limits", "on_fault")
    if len(chosen.get("torque_limits", ())) == 1:
        chosen["torque_limits"] = chosen["torque_limits"][0]
    if args.gains is not None:
        chosen["gains"] = [_tunable(text) for text in args.gains]
    options = run_options(args, file)
    chosen["dt"] = options["dt"]
    # A law has no integrator: only what the user gave is checked, not what the file has.
    of_loop = {"method": options["method"]}
    chosen |= given_options(args, "method") if args.target == "ros2" else of_loop
    try:
        print(export(file.scenario, output_folder(args.out), **chosen))
    except ToolchainError as error:
        complain(str(error))
        return 2
    return 0
