"""`robot_node`: a robot that MuJoCo simulates, as a node of ROS 2."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.control.sensors import Ideal
from iblf_jax.control.sensors._base import AnySensor
from iblf_jax.core import checks
from iblf_jax.deployment.cosimulate import own_step
from iblf_jax.deployment.mujoco_plant import INTEGRATORS, MujocoPlant
from iblf_jax.deployment.ros2.robot_motion import RobotMotion, recorded
from iblf_jax.deployment.ros2.robot_simulation import Reading, RobotSimulation
from iblf_jax.simulation.initial import Initial
from iblf_jax.simulation.sampling import PERIOD_TOLERANCE
from iblf_jax.world.robots.payload import Payload

REPUBLISH_INTERVAL = 0.1
"""In lock-step, time after which a state that no effort has answered is published again [s]: a law
node that has started meanwhile has not received it."""
BRAKES = ("start", "always", "never")
DISCOVERY_TIME = 1.0
"""Time from the discovery of a publisher of efforts to the first state [s], in which the law node
discovers this node: an effort that it publishes before is lost."""
NANOSECONDS = 1_000_000_000


def ros_packages() -> tuple[Any, Any, Any]:
    """`rclpy` and the modules of sensor and standard messages; ImportError with a remedy if one is
    not installed.
    """
    try:
        import rclpy
        import rclpy.executors
        import sensor_msgs.msg
        import std_msgs.msg
    except ImportError as error:
        raise ImportError(
            "This needs rclpy, sensor_msgs and std_msgs: source the setup file of a ROS 2"
            ' installation, or pip install ".[ros]" in a clone (Python 3.11).'
        ) from error
    return rclpy, sensor_msgs.msg, std_msgs.msg


def robot_node(
    plant: Any,
    joints: Sequence[str],
    *,
    period: float,
    initial: Initial | None = None,
    real_time: bool = False,
    dt: float | None = None,
    integrator: str | None = "RK4",
    sensor: AnySensor | None = None,
    delay: float = 0.0,
    state_dropout: float = 0.0,
    effort_dropout: float = 0.0,
    payload: Payload | None = None,
    effort_timeout: float = 0.1,
    brake: str = "start",
    seed: int = 0,
    ros_args: Sequence[str] = (),
) -> SimulatedRobot:
    """A robot that MuJoCo simulates, as the ROS 2 node `simulated_robot`.

    It publishes `joint_states` (sensor_msgs/JointState: stamp, names, positions, velocities and the
    torques that act) once a period, and applies `efforts` (std_msgs/Float64MultiArray, in the order
    of `joints`).  Its torque is zero before the first effort.  An effort acts until the next one,
    and at most for `effort_timeout`; then the torque is zero.  Efforts of a wrong length, or that
    are not finite, are refused with a message in the log.

    In lock-step the stamps are simulation time, and every state waits for the effort that answers
    it, so that the result does not depend on the speed of the computer.  In real time the stamps
    are wall-clock time, and an effort acts from the instant at which it arrives.

    Args:
      plant: path of an MJCF or URDF, a `mujoco.MjSpec` or a `mujoco.MjModel`.
      joints: names of the driven joints in MuJoCo's model and in the messages.
      period: of the states [s].
      initial: initial positions and velocities; the model's own positions at rest if not given.
      real_time: whether the simulation follows the clock of the computer, instead of lock-step.
      dt: step of MuJoCo [s], which divides the period.  If not given, the model's own step, or the
        next shorter one that divides the period.
      integrator: "RK4", "Euler", "implicit" or "implicitfast"; None for the model's own.
      sensor: of the states, such as `ij.sensors.Encoder`; exact if not given.
      delay: from the arrival of an effort until it acts [s].
      state_dropout: probability that a state is not published [1]; the first one always is.
      effort_dropout: probability that an effort is lost [1]; the first one never is.
      payload: a body that is fixed to the body which the last joint moves, in its frame.
      effort_timeout: longest time that an effort acts [s].
      brake: "start": the robot keeps its initial state until the first effort that is not zero,
        and time of the motion counts from the state which that effort answers; "always": a brake
        also stops it at the time-out of an effort, until the next such effort; "never": no brake.
      seed: fixes the dropouts, and the noise of the sensor as in `cosimulate`.
      ros_args: arguments of ROS, such as ["--ros-args", "-r", "joint_states:=/arm/joint_states"].

    Returns:
      A `SimulatedRobot`: `robot.run(duration)` runs it and returns its `RobotMotion`.

    Raises:
      ValueError: bad arguments; the message names the field, the value and the remedy.
      ImportError: mujoco or rclpy is not installed.

    Source: design of this package.
    """
    names = tuple(
        checks.string("joints", name, "names of joints")
        for name in checks.nonempty_list("joints", joints, '["shoulder", "elbow"]')
    )
    if integrator is not None:
        checks.one_of("integrator", integrator, INTEGRATORS)
    checks.one_of("brake", brake, BRAKES)
    period = checks.time_span("period", period)
    robot = MujocoPlant(plant, names, len(names), {}, integrator, payload)
    if dt is None:
        dt = own_step(period, robot)
    dt = checks.time_span("dt", dt)
    steps = round(period / dt)
    if steps < 1 or abs(steps * dt - period) > PERIOD_TOLERANCE * dt:
        remedy = f"Take dt={period / max(steps, 1):.12g}."
        raise checks.fail("dt", dt, f"a step that divides the period of {period:g} s", remedy)
    q, dq = _initial_state(initial, robot, len(names))
    simulation = RobotSimulation(
        robot,
        q,
        dq,
        period=period,
        dt=period / steps,
        sensor=Ideal() if sensor is None else sensor,
        delay=checks.time_span("delay", delay, zero=True),
        effort_timeout=checks.time_span("effort_timeout", effort_timeout),
        brake=brake,
        seed=checks.seed(seed),
    )
    dropouts = Dropouts(
        checks.number_between("state_dropout", state_dropout, 0.0, 1.0, "1"),
        checks.number_between("effort_dropout", effort_dropout, 0.0, 1.0, "1"),
        seed,
    )
    return SimulatedRobot(
        simulation, names, dropouts, checks.boolean("real_time", real_time), ros_args
    )


def _initial_state(
    initial: Initial | None, robot: MujocoPlant, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """Initial positions and velocities, (n,) each."""
    if initial is None:
        return robot.q, robot.dq
    if not isinstance(initial, Initial):
        raise checks.fail("initial", initial, "an ij.Initial, or None", "scenario.initial is one.")
    state = []
    for name, value in (("q", initial.q), ("dq", initial.dq)):
        array = np.asarray(value, float)
        if array.shape not in ((), (n,)):
            came = f"shape {array.shape}"
            raise checks.fail(f"initial.{name}", came, f"() or ({n},)", "One number a joint.")
        state.append(np.broadcast_to(array, (n,)).copy())
    return state[0], state[1]


class Dropouts:
    """Which states and which efforts are lost; each has its own random numbers."""

    def __init__(self, states: float, efforts: float, seed: int) -> None:
        """Probabilities of a loss [1], and the seed of the random numbers."""
        self.probabilities = {"states": states, "efforts": efforts}
        streams = np.random.SeedSequence(seed).spawn(2)
        self.random = {
            "states": np.random.default_rng(streams[0]),
            "efforts": np.random.default_rng(streams[1]),
        }

    def is_lost(self, kind: str) -> bool:
        """Whether the next of the "states" or of the "efforts" is lost."""
        return bool(self.random[kind].random() < self.probabilities[kind])


class Arrival(NamedTuple):
    """An effort that arrived."""

    clock: float
    """Of the process, `time.perf_counter()` [s]."""
    effort: np.ndarray | None
    """(n,) [N m]; None if it is lost."""


class SimulatedRobot:
    """The node of `robot_node`; a context that shuts the node down at its end."""

    def __init__(
        self,
        simulation: RobotSimulation,
        joints: tuple[str, ...],
        dropouts: Dropouts,
        real_time: bool,
        ros_args: Sequence[str],
    ) -> None:
        rclpy, sensor_messages, standard_messages = ros_packages()
        self.simulation = simulation
        self.joints = joints
        self.dropouts = dropouts
        self.real_time = real_time
        self.arrivals: list[Arrival] = []
        self.counts = dict.fromkeys(
            ("dropped efforts", "refused efforts", "expired efforts", "skipped states"),
            0,
        )
        self.origin = 0
        """Stamp of the state at t = 0 [ns]."""
        self.published: list[bool] = []
        self.clocks: list[float] = []
        """Clock of the process at each publication [s]."""
        self.latency: list[float] = []
        self.lateness: list[float] = []
        self._stops = False
        self._has_received = False
        self._context = rclpy.context.Context()
        rclpy.init(args=list(ros_args), context=self._context)
        self.node = rclpy.create_node("simulated_robot", context=self._context)
        self._executor = _executor(rclpy, self._context)
        self._executor.add_node(self.node)
        self._message = sensor_messages.JointState(name=list(joints))
        self._publisher = self.node.create_publisher(sensor_messages.JointState, "joint_states", 10)
        self._subscription = self.node.create_subscription(
            standard_messages.Float64MultiArray, "efforts", self._receive, 10
        )

    def __enter__(self) -> SimulatedRobot:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Shuts the node down."""
        if not self._context.ok():
            return
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.shutdown()

    def stop(self) -> None:
        """Ends a run after the present period; a signal handler or another thread may call it."""
        self._stops = True

    def run(
        self,
        duration: float,
        *,
        patience: float = 30.0,
        record: bool = True,
        on_release: Callable[[], object] = lambda: None,
    ) -> RobotMotion:
        """Runs the robot.

        Args:
          duration: of the motion [s], a whole number of periods.
          patience: longest time of the computer that a lock-step waits for the effort which answers
            a state, and that the brake waits for the first effort [s].
          record: whether the motion is recorded, which takes about 3 GB an hour; without it, the
            result has the last instant only, and the timing.
          on_release: called when the first effort has arrived.

        Returns:
          The `RobotMotion`; shorter than the duration after `stop`, or if the motion diverged.

        Raises:
          ValueError: bad arguments, or a second call: a robot runs once.
          TimeoutError: no effort arrived within `patience`.
        """
        simulation = self.simulation
        if self.published:
            raise checks.fail("robot", "one that has run", "one that has not", "Make a new one.")
        periods = checks.whole_steps(duration, simulation.period, dt_is_free=False)
        patience = checks.time_span("patience", patience)
        simulation.is_recording = checks.boolean("record", record)
        was_enabled = gc.isenabled()
        gc.collect()
        gc.disable()  # A collection takes longer than a period.
        try:
            self._wait_for_law(patience)
            if self.real_time:
                self._run_in_real_time(periods, patience, on_release)
            else:
                self._run_in_lock_step(periods, patience, on_release)
        finally:
            if was_enabled:
                gc.enable()
        ended = time.time()
        if not self.published:  # It was stopped before a law was found.
            self._replace_first_state()
            simulation.measure()
        simulation.finish()
        return self._motion(ended)

    def _motion(self, ended: float) -> RobotMotion:
        simulation = self.simulation
        self.counts["expired efforts"] = simulation.timeouts
        return recorded(
            simulation.robot,
            simulation.rows,
            simulation.samples,
            joints=self.joints,
            period=simulation.period,
            dt=simulation.dt,
            origin=self.origin / NANOSECONDS,
            ended=ended,
            published=np.array(self.published),
            latency=np.array(self.latency),
            lateness=np.array(self.lateness),
            effort_t=np.array(simulation.efforts.times) - simulation.efforts.delay,
            counts=dict(self.counts),
            diverged=simulation.diverged,
        )

    def _wait_for_law(self, patience: float) -> None:
        """Waits until a node publishes efforts, and has discovered this one."""
        end = time.perf_counter() + patience
        while not self._stops and self.node.count_publishers(self._subscription.topic_name) == 0:
            self._spin(time.perf_counter() + REPUBLISH_INTERVAL)
            if time.perf_counter() > end:
                raise TimeoutError(self._no_effort(patience))
        settled = time.perf_counter() + DISCOVERY_TIME
        while not self._stops and time.perf_counter() < settled:
            self._spin(settled)
        self.arrivals.clear()

    # Lock-step

    def _run_in_lock_step(
        self, periods: int, patience: float, on_release: Callable[[], object]
    ) -> None:
        simulation = self.simulation
        # The initial state is exchanged until an effort releases the brake; the stamps advance.
        end = time.perf_counter() + patience
        while not self._stops:
            self._replace_first_state()
            self._exchange(simulation.measure(), patience)
            if simulation.is_released:
                break
            self.origin += round(simulation.period * NANOSECONDS)
            if time.perf_counter() > end:
                raise TimeoutError(self._no_release(patience))
        on_release()
        while not self._stops and not simulation.diverged and simulation.index < periods:
            simulation.advance()
            reading = simulation.measure()
            is_lost = self.dropouts.is_lost("states")
            self._begin_state(is_published=not is_lost, lateness=0.0)
            if not is_lost:
                self._exchange(reading, patience)

    def _exchange(self, reading: Reading, patience: float) -> None:
        """Publishes a state until an effort answers it."""
        self.arrivals.clear()
        end = time.perf_counter() + patience
        while not self.arrivals and not self._stops:
            self._publish(reading)
            again = time.perf_counter() + REPUBLISH_INTERVAL
            while not self.arrivals and time.perf_counter() < again:
                self._spin(again)
            if time.perf_counter() > end:
                raise TimeoutError(self._no_effort(patience))
        for arrival in self.arrivals:
            self._take(arrival, reading.t)
        self.arrivals.clear()

    # Real time

    def _run_in_real_time(
        self, periods: int, patience: float, on_release: Callable[[], object]
    ) -> None:
        simulation = self.simulation
        # The initial state is published every period until an effort releases the brake.
        end = time.perf_counter() + patience
        while True:
            self.origin = time.time_ns()
            start = time.perf_counter()  # the clock of the process at t = 0 [s]
            self._replace_first_state()
            self._publish(simulation.measure())
            due = start + simulation.period
            while time.perf_counter() < due and not simulation.efforts.commands:
                self._spin(due)
                self._take_arrivals_of_clock(start)
            if self._stops or simulation.is_released:
                break
            if time.perf_counter() > end:
                raise TimeoutError(self._no_release(patience))
        on_release()
        while simulation.index < periods and not self._stops and not simulation.diverged:
            due = start + (simulation.index + 1) * simulation.period
            while time.perf_counter() < due:
                self._spin(due)
            self._take_arrivals_of_clock(start)
            behind = int((time.perf_counter() - start) / simulation.period)
            last = min(max(behind, simulation.index + 1), periods)
            self.counts["skipped states"] += last - simulation.index - 1
            while simulation.index < last:
                simulation.advance()
            reading = simulation.measure()
            is_lost = self.dropouts.is_lost("states")
            nominal = start + simulation.index * simulation.period
            self._begin_state(is_published=not is_lost, lateness=time.perf_counter() - nominal)
            if not is_lost:
                self._publish(reading)

    def _take_arrivals_of_clock(self, start: float) -> None:
        """Passes the efforts on to the robot at the times at which they arrived."""
        for arrival in self.arrivals:
            self._take(arrival, arrival.clock - start)
        self.arrivals.clear()

    # Messages

    def _begin_state(self, *, is_published: bool, lateness: float) -> None:
        self.published.append(is_published)
        self.latency.append(np.nan)
        self.lateness.append(lateness)
        self.clocks.append(time.perf_counter())

    def _replace_first_state(self) -> None:
        for series in (self.published, self.latency, self.lateness, self.clocks):
            series.clear()
        self._begin_state(is_published=True, lateness=0.0)

    def _publish(self, reading: Reading) -> None:
        message = self._message
        stamp = self.origin + round(reading.t * NANOSECONDS)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, NANOSECONDS)
        message.position = reading.q.tolist()
        message.velocity = reading.dq.tolist()
        message.effort = reading.effort.tolist()
        self.clocks[-1] = time.perf_counter()
        self._publisher.publish(message)

    def _spin(self, until: float) -> None:
        """Handles one message, or waits until a clock of the process [s]."""
        self._executor.spin_once(timeout_sec=max(until - time.perf_counter(), 0.0))

    def _receive(self, message: Any) -> None:
        clock = time.perf_counter()
        effort = np.array(message.data, float)
        if effort.shape != (len(self.joints),) or not np.all(np.isfinite(effort)):
            self.counts["refused efforts"] += 1
            self.node.get_logger().warning(
                f"efforts: got {effort.tolist()}, expected {len(self.joints)} finite numbers, one"
                f" for each of {', '.join(self.joints)}; the message is ignored",
                throttle_duration_sec=1.0,
            )
            return
        if self.simulation.efforts.commands and self.dropouts.is_lost("efforts"):
            self.counts["dropped efforts"] += 1
            self.arrivals.append(Arrival(clock, None))
            return
        self.arrivals.append(Arrival(clock, effort))

    def _take(self, arrival: Arrival, t: float) -> None:
        """Passes an effort on to the robot at time t [s]; zero torques do not release the brake."""
        if np.isnan(self.latency[-1]):
            self.latency[-1] = arrival.clock - self.clocks[-1]
        if arrival.effort is None:
            return
        self._has_received = True
        if self.simulation.is_braked and not np.any(arrival.effort):
            return
        self.simulation.receive(t, arrival.effort)

    def _no_release(self, patience: float) -> str:
        """Why the brake was not released."""
        if not self._has_received:
            return self._no_effort(patience)
        return (
            f"all efforts were zero for {patience:g} s. Start the law: its parameter"
            " `start_automatically`, or its service `~/start`."
        )

    def _no_effort(self, patience: float) -> str:
        refused = self.counts["refused efforts"]
        return (
            f"no effort answered the state within {patience:g} s ({refused} were refused). Start"
            " the law node in the same ROS domain, and remap `joint_states` and `efforts` to the"
            " same names."
        )


def _executor(rclpy: ModuleType, context: object) -> Any:
    """An executor of callbacks; the one of events has a quarter of the latency."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return rclpy.executors.SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)
