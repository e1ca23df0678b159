"""A law that controls a simulated robot through ROS 2, both as processes of one machine."""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from iblf_jax.control.actuators import Ideal
from iblf_jax.core import checks
from iblf_jax.deployment.build import build, c_compiler
from iblf_jax.deployment.cosimulate import cosimulate, with_period
from iblf_jax.deployment.export import export
from iblf_jax.deployment.mujoco_plant import with_payload
from iblf_jax.deployment.ros2.robot_model import planar_mjcf, plant_of
from iblf_jax.deployment.ros2.robot_motion import RobotMotion
from iblf_jax.deployment.ros2.simulated_robot import ros_packages
from iblf_jax.files.results import load
from iblf_jax.files.scenario import save_scenario
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.sampling import commands_in_transit
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world.disturbances import Nothing

LIMIT_FACTOR = 3.0
"""Torque limits of a model that has none, relative to the largest torques of a simulated run."""
STOP_TIME = 10.0
"""Time that a process has to end after an interrupt [s]."""
START_TIME = 60.0
"""Time that both processes have to start, in addition to the duration of the motion [s]."""
SLOWEST = 50.0
"""Longest wall-clock time of a lock-step, relative to the duration of the motion."""
LAST_LINES = 8
"""Lines of a process's output in an error."""


@dataclasses.dataclass(frozen=True)
class Demonstration:
    """The result of `demonstrate`; prints as lines."""

    rollout: Rollout
    """The run of the robot, with the scenario's metrics."""
    motion: RobotMotion
    cosimulated: Rollout
    """The same scenario by `cosimulate`, without dropouts."""
    diagnostics: dict[str, str]
    """The last diagnostics of the law node."""
    files: tuple[Path, ...]
    """The package, the motion and the figure."""

    @property
    def distance(self) -> float:
        """Largest distance of the positions from those of `cosimulate` [rad]."""
        found = self.motion.q[self.motion.instant]
        expected = np.asarray(self.cosimulated.q)
        if self.motion.dt != float(self.cosimulated.dt):
            return float("nan")
        count = min(len(found), len(expected))
        return float(np.max(np.abs(found[:count] - expected[:count])))

    @property
    def ok(self) -> bool:
        """Whether the run reached its end within the bounds."""
        return self.rollout.ok

    def __repr__(self) -> str:
        rmse = np.array2string(np.asarray(self.rollout.metrics.rmse), precision=4)
        lines = [
            repr(self.rollout),
            f"rmse: {rmse} rad",
            f"distance from cosimulate: {self.distance:.3g} rad",
        ]
        names = ("mode", "last_fault", "missed_share", "latency_99 [s]", "longest_latency [s]")
        lines += [f"law, {x}: {self.diagnostics[x]}" for x in names if x in self.diagnostics]
        if "stale" in self.diagnostics.get("last_fault", ""):
            lines.append(
                "The computer was too slow for the states of two periods; a real-time priority or a"
                " longer state_timeout avoids this fault."
            )
        lines += [f"written: {path}" for path in self.files]
        return "\n".join(lines)


def demonstrate(
    scenario: Scenario,
    folder: Path,
    *,
    plant: Any = None,
    joints: Sequence[str] | None = None,
    period: float,
    duration: float,
    real_time: bool = False,
    torque_limits: Sequence[float] | None = None,
    state_timeout: float | None = None,
    priority: int | None = None,
    **robot: Any,
) -> Demonstration:
    """Exports a scenario's law as a ROS 2 package, builds it, and runs its node with a simulated
    robot.

    The disturbance of the scenario is left out, as the robot has its own: a payload, for example.

    Args:
      scenario: the scenario.
      folder: receives the package, the recorded motion and a figure.
      plant: MJCF or URDF of the robot; that of the scenario's planar arm if not given.
      joints: names of the joints in the file; those of the scenario if not given.
      period: of the law [s].
      duration: of the motion [s].
      real_time: as in `robot_node`.
      torque_limits: (n,) [N m]; those of the scenario's robot, or LIMIT_FACTOR times the largest
        torques of a simulated run, if not given.
      state_timeout: age beyond which the law node takes a state for stale [s]; two periods if not
        given.
      priority: of both processes under the real-time policy "first in, first out" of Linux, 1 to
        99; the ordinary policy if not given.
      robot: further options of `robot_node`.

    Returns:
      A `Demonstration`.

    Raises:
      ValueError: bad arguments.
      ChildProcessError: a process ended early; the message has its last lines.
      TimeoutError: the motion did not end in time.
      ToolchainError: the package could not be compiled.
      ImportError: mujoco or rclpy is not installed.
    """
    ros_packages()
    scenario = with_period(without_parts_of_the_robot(scenario), period)
    if plant is None:
        plant = folder / "robot.xml"
        plant.write_text(planar_mjcf(scenario.plant) + "\n", encoding="utf-8")
    plant, names = plant_of(scenario, plant, joints)
    expected = cosimulated(scenario, plant, names, duration, robot)
    effort = scenario.model.effort
    if torque_limits is None and (effort is None or not np.all(np.isfinite(np.asarray(effort)))):
        torque_limits = (LIMIT_FACTOR * np.max(np.abs(np.asarray(expected.tau)), axis=0)).tolist()
    package = folder / "package"
    name = export_and_build(scenario, package, torque_limits=torque_limits)
    parameters = {"trigger": "state"}
    if real_time:
        parameters["trigger"] = "timer"
    if state_timeout is not None:
        parameters["state_timeout"] = repr(float(state_timeout))
    prefix = priority_command(priority)
    law = prefix + law_command(package, name, names, **parameters)
    command = prefix + robot_command(scenario, plant, names, duration, folder, real_time, robot)
    motion, diagnostics = run_nodes(law, command, folder, START_TIME + SLOWEST * duration)
    rollout = motion.rollout(scenario)
    rollout.plot().savefig(folder / "run.png", dpi=120)
    files = (package, folder / "motion.npz", folder / "run.png")
    return Demonstration(rollout, motion, expected, diagnostics, files)


def without_parts_of_the_robot(scenario: Scenario) -> Scenario:
    """The scenario without what only its own plant has."""
    return dataclasses.replace(
        scenario, disturbance=Nothing(), actuator=Ideal(), process_noise=None
    )


def cosimulated(
    scenario: Scenario,
    plant: Any,
    names: tuple[str, ...],
    duration: float,
    robot: Mapping[str, Any],
) -> Rollout:
    """The run without ROS, with the delay, the noise and the payload of the robot."""
    sampling: Any = scenario.sampling
    period, delay = float(sampling.period), robot.get("delay", 0.0)
    sampling = dataclasses.replace(
        sampling, delay=delay, queue=max(sampling.queue, commands_in_transit(delay, period))
    )
    if robot.get("payload") is not None:
        plant = with_payload(plant, names, robot["payload"])
    options = {name: robot[name] for name in ("dt", "integrator", "seed") if name in robot}
    scenario = dataclasses.replace(scenario, sampling=sampling)
    return cosimulate(scenario, plant, duration=duration, **options)


# ------------------------------------------------------------------------------------- package


def export_and_build(
    scenario: Scenario,
    package: Path,
    *,
    torque_limits: Sequence[float] | None = None,
    **options: Any,
) -> str:
    """Writes the ROS 2 package of a scenario's law and compiles the law in its place.

    Args:
      scenario: sampled.
      package: folder of the package.
      torque_limits: as in `export`.
      options: further options of `export`.

    Returns:
      The name of the package.

    Raises:
      ValueError: as `export`.
      ToolchainError: there is no C compiler, or it failed.
    """
    name = options.setdefault("name", "iblf_law")
    export(scenario, package, target="ros2", torque_limits=torque_limits, **options)
    c_compiler()
    build([sys.executable, "setup.py", "-q", "build_ext", "--inplace"], package)
    return str(name)


# ------------------------------------------------------------------------------------- processes


def priority_command(priority: int | None) -> list[str]:
    """The words before a command that run it with a real-time priority; none for None."""
    if priority is None:
        return []
    checks.positive_integer("priority", priority, most=99)
    return ["chrt", "-f", str(priority)]


@contextmanager
def interrupts_raised() -> Iterator[None]:
    """Context in which SIGINT and SIGTERM raise KeyboardInterrupt, so that the contexts inside it
    stop their processes.
    """

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {x: signal.signal(x, interrupt) for x in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run_nodes(
    law: Sequence[str], robot: Sequence[str], folder: Path, longest: float
) -> tuple[RobotMotion, dict[str, str]]:
    """Runs both nodes until the robot's motion has ended.

    Args:
      law: command of the law node.
      robot: command of the robot, which writes `motion.npz` into the folder.
      folder: receives the logs of both processes.
      longest: time after which the processes are given up [s].

    Returns:
      The motion, and the last diagnostics of the law node before the end of the motion.

    Raises:
      ChildProcessError: one of the processes failed, or the law ended first.
      TimeoutError: the robot is still running after this time.
    """
    with (
        interrupts_raised(),
        ProcessOfNode(robot, folder / "robot.log") as robot_process,
        ProcessOfNode(law, folder / "law.log") as law_process,
        DiagnosticsListener() as listener,
    ):
        listener.listen(robot_process, law_process, longest)
    motion = load(folder / "motion.npz")
    return motion, listener.last_before(motion.ended)


def law_command(package: Path, name: str, joints: Sequence[str], **parameters: str) -> list[str]:
    """The command of the law node of a built package, which starts with the first state.

    Args:
      package: its folder.
      name: of the package.
      joints: names of the joints in the messages.
      parameters: further parameters of the node, as YAML.
    """
    given = {"joints": json.dumps(list(joints)), "start_automatically": "true"} | parameters
    command = [sys.executable, "-c", LAUNCHER.format(folder=str(package), name=name)]
    command += ["--ros-args", "--params-file", str(package / "config" / f"{name}.yaml")]
    for key, value in given.items():
        command += ["-p", f"{key}:={value}"]
    return command


LAUNCHER = (
    "import sys; sys.path.insert(0, {folder!r}); from {name}.law_node import main; sys.exit(main())"
)
"""A program that runs the node of a package which is not installed."""


def robot_command(
    scenario: Scenario,
    plant: Any,
    joints: Sequence[str],
    duration: float,
    folder: Path,
    real_time: bool,
    options: Mapping[str, Any],
) -> list[str]:
    """The command `iblf-jax ros robot` of a robot; writes the scenario into the folder."""
    save_scenario(scenario, folder / "scenario.toml")
    command = [sys.executable, "-m", "iblf_jax", "ros", "robot", str(folder / "scenario.toml")]
    command += ["--plant", str(plant), "--joints", *joints]
    sampling: Any = scenario.sampling
    command += ["--period", repr(float(sampling.period)), "--duration", repr(duration)]
    command += ["--out", str(folder)]
    if real_time:
        command.append("--real-time")
    for name, value in options.items():
        if name in ("initial", "sensor") or value is None:
            continue  # The scenario has them.
        text = str(value)
        if name == "payload":
            numbers = [value.mass, *np.asarray(value.centre), *np.asarray(value.inertia)]
            text = ",".join(repr(float(x)) for x in numbers)
        command.append(f"--{name.replace('_', '-')}={text}")
    return command


class ProcessOfNode:
    """A node in a process of its own; a context that stops it at the end.

    Args:
      command: of the process.
      log: file for its output.
    """

    def __init__(self, command: Sequence[str], log: Path) -> None:
        self.log = log
        with log.open("w", encoding="utf-8") as file:
            self.process = subprocess.Popen(
                list(command), stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL
            )

    def __enter__(self) -> ProcessOfNode:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def has_ended(self) -> bool:
        """Whether the process has ended."""
        return self.process.poll() is not None

    def stop(self) -> int:
        """Interrupts the process and returns its exit code; ends it if it does not stop."""
        if not self.has_ended():
            self.process.send_signal(signal.SIGINT)
        try:
            return self.process.wait(STOP_TIME)
        except subprocess.TimeoutExpired:
            return self.kill()

    def kill(self) -> int:
        """Ends the process at once and returns its exit code."""
        self.process.kill()
        return self.process.wait()

    def last_lines(self) -> str:
        """The last lines of its output."""
        return " ".join(self.log.read_text(encoding="utf-8").splitlines()[-LAST_LINES:])


class DiagnosticsListener:
    """Keeps the values of the topic `diagnostics`; a context."""

    def __init__(self) -> None:
        rclpy = ros_packages()[0]
        import diagnostic_msgs.msg

        self.history: list[tuple[float, dict[str, str]]] = []
        """Stamp [s] and values of each message."""
        self._rclpy = rclpy
        self._context = rclpy.context.Context()
        rclpy.init(args=[], context=self._context)
        self.node = rclpy.create_node("diagnostics_listener", context=self._context)
        self._executor = rclpy.executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        kind = diagnostic_msgs.msg.DiagnosticArray
        self._subscription = self.node.create_subscription(kind, "diagnostics", self._keep, 10)

    def __enter__(self) -> DiagnosticsListener:
        return self

    def __exit__(self, *error: object) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.shutdown()

    def _keep(self, message: Any) -> None:
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        for status in message.status:
            self.history.append((stamp, {pair.key: pair.value for pair in status.values}))

    def last_before(self, time: float) -> dict[str, str]:
        """The last values with a stamp before a time of the clock [s]."""
        found = [values for stamp, values in self.history if stamp < time]
        if not found:
            return {}
        return found[-1]

    def listen(self, robot: ProcessOfNode, law: ProcessOfNode, longest: float) -> None:
        """Receives until the robot's process ends.

        Args:
          robot: process of the robot.
          law: process of the law.
          longest: time after which the processes are given up [s].

        Raises:
          ChildProcessError: one of the processes failed, or the law ended first.
          TimeoutError: the robot is still running.
        """
        end = time.monotonic() + longest
        while not robot.has_ended():
            self._executor.spin_once(timeout_sec=0.1)
            if law.has_ended():
                raise ChildProcessError(f"the law node ended: {law.last_lines()}")
            if time.monotonic() > end:
                raise TimeoutError(
                    f"the robot did not end within {longest:g} s: {robot.last_lines()}"
                )
        if robot.process.returncode:
            raise ChildProcessError(f"the robot node ended: {robot.last_lines()}")
