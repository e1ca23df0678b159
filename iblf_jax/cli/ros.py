"""`ros`: a simulated robot as a node of ROS 2, and a demonstration of a law that controls it."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from iblf_jax.cli._common import (
    add_scenario_arguments,
    given_options,
    output_folder,
    scenario_of,
)

if TYPE_CHECKING:
    from iblf_jax.deployment.ros2.robot_motion import RobotMotion
    from iblf_jax.simulation.scenario import Scenario

HELP = "run a simulated robot, or a law with a simulated robot, under ROS 2"
DESCRIPTION = "A robot that MuJoCo simulates as a node of ROS 2, and a law that controls it."
EPILOG = "Both commands need the extras `ros` and `robots`."

ENDLESS = 1e6
"""Length of a motion that only a signal ends [s]."""
DEMO_PERIOD = 2e-3
"""Period of the law in a demonstration of a scenario that has none [s]."""
ROBOT_OPTIONS = (
    "period",
    "dt",
    "integrator",
    "delay",
    "state_dropout",
    "effort_dropout",
    "effort_timeout",
    "brake",
    "seed",
)
"""Options of `robot_node` that have the same name on the command line."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the commands `robot` and `demo`."""
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    words = "Simulate the robot of a scenario as a node of ROS 2, until it is interrupted."
    robot = commands.add_parser("robot", help="run a simulated robot", description=words)
    _add_robot_arguments(robot)
    robot.add_argument(
        "--duration", type=float, metavar="S", help="length of the motion [s] (default: endless)"
    )
    robot.add_argument("--out", metavar="DIR", help="folder for the recorded motion")
    robot.add_argument(
        "--ros-args",
        nargs=argparse.REMAINDER,
        metavar="ARG",
        help="arguments of ROS, such as -r efforts:=/arm/efforts; the last option",
    )
    robot.set_defaults(run_ros=run_robot)
    words = (
        "Export the law of a scenario as a ROS 2 package, compile it, run its node with a simulated"
        " robot, and print accuracy, missed periods and latency."
    )
    demo = commands.add_parser("demo", help="run a law with a robot", description=words)
    _add_robot_arguments(demo, default="zhang_yan_2024")
    demo.add_argument(
        "--duration",
        type=float,
        default=10.0,
        metavar="S",
        help="length of the motion [s] (default: 10)",
    )
    demo.add_argument(
        "--out",
        default="ros_demo",
        metavar="DIR",
        help="folder for package and results (default: ros_demo)",
    )
    demo.add_argument(
        "--torque-limits",
        type=float,
        nargs="+",
        metavar="NM",
        help="limits of the torques [N m] (default: the model's, else 3 times what a run needs)",
    )
    demo.add_argument(
        "--state-timeout",
        type=float,
        metavar="S",
        help="age beyond which the law takes a state for stale [s] (default: two periods)",
    )
    demo.add_argument(
        "--priority",
        type=int,
        metavar="N",
        help="real-time priority of both processes, 1 to 99, by `chrt` (default: none)",
    )
    demo.set_defaults(run_ros=run_demo)


def _add_robot_arguments(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    add_scenario_arguments(parser, default)
    parser.add_argument(
        "--plant",
        metavar="FILE",
        help="MJCF or URDF of the robot (default: the planar arm of the scenario)",
    )
    parser.add_argument(
        "--joints", nargs="+", metavar="NAME", help="joints in FILE (default: the scenario's)"
    )
    parser.add_argument(
        "--period",
        type=float,
        metavar="S",
        help="of the states [s] (default: the scenario's; in a demonstration else 0.002)",
    )
    parser.add_argument(
        "--real-time",
        action="store_true",
        help="follow the clock of the computer instead of lock-step",
    )
    parser.add_argument("--dt", type=float, metavar="S", help="step of MuJoCo [s]")
    parser.add_argument("--integrator", metavar="NAME", help="of MuJoCo (default: RK4)")
    parser.add_argument(
        "--delay", type=float, metavar="S", help="until an effort acts [s] (default: 0)"
    )
    parser.add_argument(
        "--state-dropout", type=float, metavar="P", help="probability of a lost state (default: 0)"
    )
    parser.add_argument(
        "--effort-dropout", type=float, metavar="P", help="and of a lost effort (default: 0)"
    )
    parser.add_argument(
        "--payload",
        metavar="KG[,X,Y,Z]",
        help="mass on the last body [kg], and its centre in the frame of this body [m]",
    )
    parser.add_argument(
        "--effort-timeout",
        type=float,
        metavar="S",
        help="longest time that an effort acts [s] (default: 0.1)",
    )
    parser.add_argument(
        "--brake",
        metavar="WHEN",
        help="start (until the first torque), always (also after the time-out) or never (default:"
        " start)",
    )
    parser.add_argument("--seed", type=int, metavar="N", help="of noise and dropouts (default: 0)")


def run(args: argparse.Namespace) -> int:
    """Runs the command; 2 where a package of the extras is missing."""
    from iblf_jax.cli import complain

    try:
        return args.run_ros(args)  # type: ignore[no-any-return]
    except ImportError as error:
        complain(str(error))
        return 2


def run_robot(args: argparse.Namespace) -> int:
    """Runs the robot until its duration has passed or a signal ends it."""
    from iblf_jax.cli import complain
    from iblf_jax.deployment.ros2.robot_model import plant_of
    from iblf_jax.deployment.ros2.simulated_robot import robot_node
    from iblf_jax.simulation.scenario import canonical

    file = scenario_of(args)
    scenario = canonical(file.scenario)
    folder = None
    if args.out:
        folder = output_folder(args.out)
    plant, joints = plant_of(scenario, args.plant, args.joints)
    options = _robot_options(args, scenario)
    ros_arguments = ["--ros-args", *args.ros_args] if args.ros_args else []
    node = robot_node(plant, joints, **options, ros_args=ros_arguments)
    periods = round((args.duration or ENDLESS) / options["period"])
    try:
        with node, _stopped_by_signals(node.stop):
            motion = node.run(
                periods * options["period"],
                patience=ENDLESS,
                record=folder is not None,
                on_release=lambda: print(f"in motion, t = 0 at {node.origin} ns", flush=True),
            )
    except TimeoutError as error:
        complain(str(error))
        return 1
    print(_report_of(motion))
    if folder is not None:
        motion.save(folder / "motion.npz")
    return int(motion.diverged)


def run_demo(args: argparse.Namespace) -> int:
    """Runs the demonstration."""
    from iblf_jax.cli import complain
    from iblf_jax.deployment.ros2.demo import demonstrate
    from iblf_jax.kernels import ToolchainError
    from iblf_jax.simulation.scenario import canonical

    scenario = canonical(scenario_of(args).scenario)
    options = _robot_options(args, scenario, DEMO_PERIOD)
    try:
        found = demonstrate(
            scenario,
            output_folder(args.out),
            plant=args.plant,
            joints=args.joints,
            duration=args.duration,
            torque_limits=args.torque_limits,
            state_timeout=args.state_timeout,
            priority=args.priority,
            **options,
        )
    except (ToolchainError, TimeoutError, ChildProcessError) as error:
        complain(str(error))
        return 2
    print(found)
    print(_report_of(found.motion))
    return int(not found.ok)


def _robot_options(
    args: argparse.Namespace, scenario: Scenario, period: float | None = None
) -> dict[str, Any]:
    """The arguments of `robot_node` for a scenario and the command line; `period` is that of the
    law where neither has one.
    """
    from iblf_jax.core import checks
    from iblf_jax.world.robots.payload import Payload

    options = given_options(args, *ROBOT_OPTIONS)
    options["initial"], options["sensor"] = scenario.initial, scenario.sensor
    options["real_time"] = args.real_time
    if scenario.sampling is not None:
        period = float(scenario.sampling.period)
    options.setdefault("period", period)
    if options["period"] is None:
        remedy = "Give one: --period 0.002."
        raise checks.fail("--period", None, "the period of the law [s]", remedy)
    if args.payload:
        numbers = _numbers("--payload", args.payload)
        if len(numbers) not in (1, 4, 10):
            expected = "KG, KG,X,Y,Z or these with the six numbers of the inertia"
            raise checks.fail("--payload", args.payload, expected, "Such as 0.3,0.31,0,0.")
        numbers += [0.0] * (10 - len(numbers))
        options["payload"] = Payload(mass=numbers[0], centre=numbers[1:4], inertia=numbers[4:])
    return options


def _numbers(option: str, text: str) -> list[float]:
    """The numbers of an option, separated by commas."""
    from iblf_jax.core import checks

    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise checks.fail(option, text, "numbers separated by commas") from None


@contextmanager
def _stopped_by_signals(stop: Callable[[], object]) -> Iterator[None]:
    """Context in which an interrupt or a request to terminate calls `stop`."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda *_: stop()) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _report_of(motion: RobotMotion) -> str:
    """Timing and events of a motion as lines."""
    timing = motion.timing()
    lines = [f"missed periods: {100 * timing['missed']:.3g} %"]
    for name in ("latency", "lateness", "jitter"):
        parts = [
            f"{label} {1e3 * timing[f'{name}, {label}']:.3g} ms"
            for label in ("median", "99 %", "longest")
        ]
        lines.append(f"{name}: {', '.join(parts)}")
    lines += [f"{name}: {count}" for name, count in motion.counts.items() if count]
    return "\n".join(lines)
