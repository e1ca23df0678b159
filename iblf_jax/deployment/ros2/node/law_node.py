"""The ROS 2 node of an exported law.

    joint_states (sensor_msgs/JointState) -> law -> efforts (std_msgs/Float64MultiArray)

The torques in `efforts` are in the order of the parameter `joints`.  `~/start`, `~/stop` and
`~/hold` (std_srvs/Trigger) change the mode, and `diagnostics` (diagnostic_msgs/DiagnosticArray)
reports it ten times a second.
"""

from __future__ import annotations

import gc
import inspect
import math
import signal
import sys
from array import array
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import monotonic_ns
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from iblf_jax.deployment.ros2.node.c_law import FLAGS, CLaw, load_law, why_refused
from iblf_jax.deployment.ros2.node.monitor import LoopMonitor
from iblf_jax.deployment.ros2.node.supervisor import (
    ARRIVAL_TIMEOUT,
    NANOSECONDS,
    STALE_PERIODS,
    UNKNOWN,
    Command,
    Configuration,
    Fault,
    FaultKind,
    Mode,
    Sender,
    Supervisor,
)

DIAGNOSTICS_PERIOD = 0.1
"""[s]."""
LONGEST_TIMEOUT = 3600.0
"""Largest value of a timeout [s]."""
LARGEST_STAMP = 2.0**31
"""Stamps have 32 bits for the seconds [s]."""
PERIOD_TOLERANCE = 1e-9
"""Relative difference of the period from the exported one."""
FINAL_TIMEOUT = Duration(seconds=0.5)
"""Longest wait for the arrival of the last command."""
QUEUE_DEPTH = 10
"""Messages that a topic stores."""
SIGNALS = (signal.SIGTERM, signal.SIGINT)
"""They end the node."""
DECIMAL_POINT = "Numbers have a decimal point in YAML: 50.0."


class RefusedError(ValueError):
    """A parameter with which the node does not start."""


def refused(field: str, value: object, expected: str, remedy: str) -> RefusedError:
    """An error that names the parameter, its value, the expected value and the remedy."""
    return RefusedError(f"{field}: got {value}, expected {expected}. {remedy}")


class LawNode(Node):  # type: ignore[misc]
    """The node of a law.

    Args:
      law: the law.
      options: further arguments of `rclpy.node.Node`.

    Raises:
      RefusedError: a parameter does not fit the exported law.
    """

    def __init__(self, law: CLaw, **options: Any) -> None:
        super().__init__(law.description.name, **options)
        self.law = law
        self.gains = {gain.path: gain for gain in law.description.gains}
        configuration = self._configuration()
        origin = self._declared("time_origin", math.nan, "stamp that is t = 0 [s], NaN for start")
        reason = _why_refused_origin(origin)
        if reason:
            raise RefusedError(reason)
        self.supervisor = Supervisor(law, configuration, _origin(origin))
        self._declare_gains()
        self.monitor = LoopMonitor()
        self._answered: int | None = None
        """Arrival of the last state that a command has answered [ns]."""
        self._missed_before = 0
        self._logged_mode = Mode.WAITING
        self._tick: int | None = None
        self._period = round(configuration.period * NANOSECONDS)
        self._efforts = Float64MultiArray(data=array("d", [0.0] * len(configuration.joints)))
        self._publisher = self.create_publisher(Float64MultiArray, "efforts", QUEUE_DEPTH)
        self._create_diagnostics(configuration.joints)
        for name, action in (("start", self._start), ("stop", self._stop), ("hold", self._hold)):
            self.create_service(Trigger, f"~/{name}", _service(action))
        self.add_on_set_parameters_callback(self._refuse_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self._subscribe()

    def _declared(self, name: str, default: Any, description: str, read_only: bool = False) -> Any:
        """Declares a parameter and returns its value."""
        descriptor = ParameterDescriptor(description=description, read_only=read_only)
        try:
            return self.declare_parameter(name, default, descriptor).value
        except InvalidParameterTypeException as error:
            expected = f"a value such as {default}"
            raise refused(name, error, expected, DECIMAL_POINT) from None

    def _configuration(self) -> Configuration:
        """The constants of the supervisor from the parameters."""
        known = self.law.description
        joints = self._joints()
        n = len(joints)
        period = self._declared("period", known.period, "sampling period [s]", True)
        if not abs(period - known.period) <= PERIOD_TOLERANCE * known.period:
            remedy = "Export the law with this period, or set the exported one."
            raise refused("period", period, f"the exported period {known.period} s", remedy)
        on_fault = self._declared(
            "on_fault", known.on_fault, "torques of a fault: hold or zero", True
        )
        _one_of("on_fault", on_fault, ("hold", "zero"))
        self.trigger = self._declared("trigger", "timer", "sample by: timer or state", True)
        _one_of("trigger", self.trigger, ("timer", "state"))
        stiffness = self._declared("hold_stiffness", list(known.hold_stiffness), "[N m/rad]", True)
        damping = self._declared("hold_damping", list(known.hold_damping), "[N m s/rad]", True)
        automatic = self._declared("start_automatically", False, "start with the first state", True)
        outside = self._declared(
            "start_outside_bounds", False, "start while a joint is outside of its bounds", True
        )
        meaning = "longest age of a state, or distance of two stamps with the trigger state [s]"
        stamp_timeout = self._timeout("state_timeout", STALE_PERIODS * known.period, meaning)
        meaning = "longest time without a state with the trigger state [s]"
        arrival_timeout = self._timeout("arrival_timeout", ARRIVAL_TIMEOUT, meaning)
        if self.trigger == "timer":
            arrival_timeout = stamp_timeout
        return Configuration(
            joints=joints,
            period=known.period,
            reads_velocity=known.reads_velocity,
            torque_limits=self._torque_limits(n),
            on_fault=on_fault,
            hold_stiffness=_nonnegative("hold_stiffness", stiffness, n),
            hold_damping=_nonnegative("hold_damping", damping, n),
            start_automatically=automatic,
            start_outside_bounds=outside,
            stamp_timeout=stamp_timeout,
            arrival_timeout=arrival_timeout,
        )

    def _joints(self) -> tuple[str, ...]:
        """The names of the joints in the messages."""
        known = self.law.description
        names = tuple(self._declared("joints", list(known.joints), "names of the joints", True))
        if len(set(names)) != len(known.joints) or len(names) != len(known.joints):
            remedy = f"The law has the joints {', '.join(known.joints)}."
            raise refused("joints", list(names), f"{len(known.joints)} different names", remedy)
        if known.has_joint_names and names != known.joints:
            expected = f"the joints of the exported law, {list(known.joints)}, in this order"
            remedy = "Rename the joints of the robot's driver, or export with its robot file."
            raise refused("joints", list(names), expected, remedy)
        return names

    def _torque_limits(self, n: int) -> tuple[float, ...]:
        """The largest torques [N m], at most those of the export."""
        largest = self.law.description.torque_limits
        limits = self._declared("torque_limits", list(largest), "largest torques [N m]", True)
        expected = f"{n} numbers > 0, at most {list(largest)} N m"
        remedy = "Give the limits of the robot's drives; export again if the limits have changed."
        if len(limits) != n:
            raise refused("torque_limits", list(limits), expected, remedy)
        for limit, most in zip(limits, largest, strict=True):
            # NaN is not between the limits either.
            if not 0 < limit <= most:
                raise refused("torque_limits", list(limits), expected, remedy)
        return tuple(limits)

    def _timeout(self, name: str, default: float, description: str) -> float:
        """A time after which states are stale [s]."""
        value = self._declared(name, default, description, True)
        # NaN is not between the limits either.
        if 0 < value <= LONGEST_TIMEOUT:
            return value
        expected = f"a time > 0 and at most {LONGEST_TIMEOUT:g} s"
        raise refused(name, value, expected, f"The default is {default:g} s.")

    def _declare_gains(self) -> None:
        """Declares the gains with their ranges; their defaults are those of the law."""
        for gain in self.gains.values():
            values = self.law.gain(gain.path)
            default: Any = values[0] if gain.is_scalar else values
            # The descriptor of an array has one range, which contains those of its numbers.
            span = FloatingPointRange(from_value=min(gain.low), to_value=max(gain.high))
            text = f"[{gain.unit}], from {list(gain.low)} to {list(gain.high)}"
            descriptor = ParameterDescriptor(description=text, floating_point_range=[span])
            try:
                value = self.declare_parameter(gain.path, default, descriptor).value
            except (InvalidParameterTypeException, InvalidParameterValueException) as error:
                limits = f"values from {list(gain.low)} to {list(gain.high)} [{gain.unit}]"
                raise refused(gain.path, error, limits, DECIMAL_POINT) from None
            numbers = _numbers(value)
            reason = why_refused(gain, numbers)
            if reason:
                raise RefusedError(reason)
            self.law.set_gain(gain.path, numbers)

    def _refuse_parameters(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Refuses values of gains outside of their ranges, and a time that is no stamp."""
        for parameter in parameters:
            reason = ""
            gain = self.gains.get(parameter.name)
            if gain is not None:
                reason = why_refused(gain, _numbers(parameter.value))
            if parameter.name == "time_origin":
                reason = _why_refused_origin(parameter.value)
            if reason:
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters: Sequence[Parameter]) -> None:
        """Applies changed gains; the executor runs this between two samples."""
        for parameter in parameters:
            if parameter.name in self.gains:
                self.law.set_gain(parameter.name, _numbers(parameter.value))
            if parameter.name == "time_origin":
                self.supervisor.time_origin = _origin(parameter.value)

    def _subscribe(self) -> None:
        """Subscribes the states, and creates the timers of the loop."""
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        quality = QoSProfile(depth=QUEUE_DEPTH)
        if self.trigger == "state":
            # A lost state would stop a simulator in lock-step: this one is reliable.
            self._states = self.create_subscription(
                JointState, "joint_states", _with_information(self._on_state), quality
            )
            period = self.supervisor.configuration.arrival_timeout / 2
            self.create_timer(period, self._on_watchdog, clock=steady)
        else:
            # Drivers publish with either reliability; this one receives from both.
            quality.reliability = ReliabilityPolicy.BEST_EFFORT
            self._states = self.create_subscription(
                JointState, "joint_states", _with_information(self._receive), quality
            )
            period = self.supervisor.configuration.period
            self._timer = self.create_timer(period, self._on_timer, clock=steady)
        self.create_timer(DIAGNOSTICS_PERIOD, self._publish_diagnostics, clock=steady)

    def _receive(self, message: JointState, information: Mapping[str, Any]) -> bool:
        """Takes a state; returns whether it is a new sample or not valid."""
        stamp = message.header.stamp
        return self.supervisor.receive(
            message.name,
            message.position,
            message.velocity,
            stamp.sec * NANOSECONDS + stamp.nanosec,
            monotonic_ns(),
            _sender(information),
        )

    def _on_state(self, message: JointState, information: Mapping[str, Any]) -> None:
        """One sample of the law for each state that is a new sample."""
        if not self._receive(message, information):
            return
        command = self.supervisor.command(monotonic_ns())
        if command is None:
            return
        missed = self.supervisor.missed - self._missed_before
        self._missed_before = self.supervisor.missed
        self._publish(command, missed)

    def _on_watchdog(self) -> None:
        """Publishes the torques of the fault while no states arrive."""
        now = monotonic_ns()
        if not self.supervisor.is_stale(now):
            return
        command = self.supervisor.command(now)
        if command is not None:
            self._send(command)

    def _on_timer(self) -> None:
        """A command a period; the law computes new torques if a new state has arrived."""
        now = monotonic_ns()
        # The timer keeps its own grid: what remains until the next tick gives the tick's place.
        place = now + self._timer.time_until_next_call()
        before, self._tick = self._tick, place
        missed = 0
        if before is not None:
            missed = max(round((place - before) / self._period) - 1, 0)
        self._catch_up()
        command = self.supervisor.command(monotonic_ns(), self._clock_of_stamps())
        if command is not None:
            self._publish(command, missed)

    def _catch_up(self) -> None:
        """Takes the states that wait in the queue, if the last one is stale: this process may have
        been suspended.  A law that samples with the states answers each of them instead.
        """
        if self.trigger == "state":
            return
        if not self.supervisor.is_stale(monotonic_ns(), self._clock_of_stamps()):
            return
        for _ in range(QUEUE_DEPTH):
            with self._states.handle:
                taken = self._states.handle.take_message(JointState, False)
            if taken is None:
                return
            self._receive(*taken)

    def _clock_of_stamps(self) -> int | None:
        """The clock with which stamps are compared [ns]; None for states that are the clock."""
        if self.trigger == "state":
            return None
        return self.get_clock().now().nanoseconds

    def _publish(self, command: Command, missed: int) -> None:
        """Publishes a command of the loop and counts it."""
        self._send(command)
        self.monitor.count_sample(missed)
        received = self.supervisor.state_received
        if received is not None and received != self._answered:
            self._answered = received
            self.monitor.add_latency(monotonic_ns() - received)

    def _send(self, command: Command) -> None:
        self._efforts.data[:] = array("d", command.torque)
        self._publisher.publish(self._efforts)
        mode = command.mode
        if mode is self._logged_mode:
            return
        self._logged_mode = mode
        fault = self.supervisor.last_fault
        if mode is not Mode.FAULT or fault is None:
            self.get_logger().info(f"The mode is {mode.value}.")
            return
        text = _fault_text(fault)
        if fault.kind is FaultKind.PUBLISHER:
            # Nodes that have ended are among these for some seconds.
            found = self.get_publishers_info_by_topic(self._states.topic_name)
            nodes = [f"{x.node_namespace.rstrip('/')}/{x.node_name}" for x in found]
            text += f" (publishers of joint_states: {', '.join(nodes)})"
        policy = self.supervisor.configuration.on_fault
        self.get_logger().error(f"{text}; torques by the policy {policy!r}.")

    def send_final_command(self) -> None:
        """Publishes the torques of the fault policy before the node ends."""
        command = self.supervisor.final_command()
        if command is not None:
            self._send(command)

    def wait_for_efforts(self) -> None:
        """Waits for the arrival of the last command."""
        self._publisher.wait_for_all_acked(FINAL_TIMEOUT)

    def _start(self) -> tuple[bool, str]:
        self._catch_up()
        started, message = self.supervisor.start(monotonic_ns(), self._clock_of_stamps())
        if started:
            self.get_logger().info(f"{message} time_origin is {self._origin_text()} s.")
        return started, message

    def _stop(self) -> tuple[bool, str]:
        return self.supervisor.stop()

    def _hold(self) -> tuple[bool, str]:
        self._catch_up()
        return self.supervisor.hold(monotonic_ns(), self._clock_of_stamps())

    def _origin_text(self) -> str:
        """The stamp that is t = 0, with which a restarted node continues the reference [s]."""
        origin = self.supervisor.started_at
        if origin is None:
            return "not set"
        return f"{origin // NANOSECONDS}.{origin % NANOSECONDS:09d}"

    def _create_diagnostics(self, joints: Sequence[str]) -> None:
        """The message of diagnostics, of which only the values change."""
        names = ["mode", "last_fault", "note", *FLAGS, "limited"]
        names += [f"margin.{joint} [rad]" for joint in joints]
        names += ["samples", "missed_periods", "missed_share", "periods_without_new_state"]
        names += ["longest_latency [s]", "latency_99 [s]", "time_origin [s]", "publishers"]
        self._values = [KeyValue(key=name) for name in names]
        self._status = DiagnosticStatus(
            name=f"{self.get_name()}: law", hardware_id=self.get_name(), values=self._values
        )
        self._diagnostics = DiagnosticArray(status=[self._status])
        self._diagnostics_publisher = self.create_publisher(
            DiagnosticArray, "diagnostics", QUEUE_DEPTH
        )

    def _publish_diagnostics(self) -> None:
        supervisor, monitor = self.supervisor, self.monitor
        fault = supervisor.last_fault
        texts = [supervisor.mode.value, "none" if fault is None else _fault_text(fault)]
        texts.append(supervisor.note)
        texts += [_boolean(supervisor.status & bit) for bit in FLAGS.values()]
        texts.append(_boolean(supervisor.limited))
        texts += [f"{x:.6g}" for x in supervisor.margin]
        texts += [str(monitor.samples), str(monitor.missed), f"{monitor.missed_share:.3g}"]
        texts.append(str(supervisor.repeated))
        texts.append(f"{monitor.longest_latency * 1e-9:.6f}")
        texts += [f"{monitor.latency_quantile(0.99):.6f}", self._origin_text()]
        publishers = self.count_publishers(self._states.topic_name)
        texts.append(str(publishers))
        for value, text in zip(self._values, texts, strict=True):
            value.value = text
        reason = supervisor.note
        if supervisor.mode is Mode.FAULT and fault is not None:
            reason = fault.reason
        self._status.level = self._level()
        if publishers > 1 and supervisor.sender == UNKNOWN:
            self._status.level = max(self._status.level, DiagnosticStatus.WARN)
            reason += f"; {publishers} publishers, which the middleware does not tell apart"
        self._status.message = f"{supervisor.mode.value}: {reason}".removesuffix(": ")
        self._diagnostics.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics_publisher.publish(self._diagnostics)
        supervisor.reset_extremes()

    def _level(self) -> bytes:
        """The level of the diagnostics."""
        supervisor = self.supervisor
        if supervisor.mode is Mode.FAULT:
            return DiagnosticStatus.ERROR
        is_warning = supervisor.mode is Mode.WAITING or supervisor.status or supervisor.limited
        return DiagnosticStatus.WARN if is_warning else DiagnosticStatus.OK


def _fault_text(fault: Fault) -> str:
    return f"{fault.kind.value}: {fault.reason}"


def _boolean(flag: int) -> str:
    return str(bool(flag)).lower()


def _with_information(receive: Callable[[JointState, Mapping[str, Any]], Any]) -> Any:
    """The callback of a subscription that receives messages with their information.

    rclpy knows such a callback by its signature.  Its executors in Python call it with two
    arguments, and that in C++ with a tuple of the two.
    """

    def callback(*given: Any) -> None:
        message, information = given[0] if len(given) == 1 else given
        receive(message, information)

    vars(callback)["__signature__"] = inspect.signature(receive)
    return callback


def _sender(information: Mapping[str, Any]) -> Sender:
    """The publisher of a message; rclpy before ROS 2 Kilted does not report its identity, and not
    every middleware counts its messages.
    """
    identity = information.get("publisher_gid")
    return Sender(identity and identity["data"], information.get("publication_sequence_number"))


def _service(action: Callable[[], tuple[bool, str]]) -> Callable[..., Any]:
    """The callback of a service that calls an action."""

    def callback(request: Any, response: Any) -> Any:
        response.success, response.message = action()
        return response

    return callback


def _numbers(value: Any) -> list[float]:
    """The value of a parameter as numbers; empty for another type."""
    if isinstance(value, float):
        return [value]
    if isinstance(value, (list, tuple, array)):
        return [float(x) for x in value]
    return []


def _why_refused_origin(value: object) -> str:
    """Why a value of `time_origin` is refused; empty if it is valid."""
    if isinstance(value, float) and (math.isnan(value) or abs(value) < LARGEST_STAMP):
        return ""
    expected = f"a stamp below {LARGEST_STAMP:.0f} s, or NaN"
    return f"time_origin: got {value}, expected {expected}. NaN is the stamp at the start."


def _origin(seconds: float) -> int | None:
    """A stamp [ns] from seconds; None for NaN."""
    return None if math.isnan(seconds) else round(seconds * NANOSECONDS)


def _one_of(name: str, value: str, allowed: Sequence[str]) -> None:
    if value not in allowed:
        raise refused(name, value, f"one of {list(allowed)}", "Correct the parameter file.")


def _nonnegative(name: str, values: Sequence[float], n: int) -> tuple[float, ...]:
    if len(values) == n and all(0 <= x < math.inf for x in values):
        return tuple(values)
    remedy = "The exported parameter file has default values."
    raise refused(name, list(values), f"{n} finite numbers >= 0", remedy)


def _executor() -> Any:
    """An executor of rclpy: the one in C++ where rclpy has it, which needs less processor time."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def _spin(executor: Any) -> None:
    """Runs the callbacks of an executor until a signal asks the process to end."""
    ended = [False]

    def end(*_: object) -> None:
        ended[0] = True

    for number in SIGNALS:
        signal.signal(number, end)
    while not ended[0]:
        executor.spin_once(timeout_sec=DIAGNOSTICS_PERIOD)


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node until it is interrupted; returns the exit code, 2 for refused parameters."""
    # The final command is published after a signal, so rclpy must not end the context first.
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = LawNode(load_law(Path(__file__).resolve().parent))
    except (ValueError, OSError) as error:
        rclpy.logging.get_logger("law_node").fatal(str(error))
        rclpy.try_shutdown()
        return 2
    executor = _executor()
    executor.add_node(node)
    # The first message of a log takes 8 ms, in which a running law would miss periods.
    node.get_logger().info(f"The mode is {node.supervisor.mode.value}.")
    # Objects of the start are not searched for garbage again.
    gc.collect()
    gc.freeze()
    try:
        _spin(executor)
    finally:
        node.send_final_command()
        # Another signal ends the process at once from now on.
        for number in SIGNALS:
            signal.signal(number, signal.SIG_DFL)
        # The process ends after this; without waiting, the command may be lost.
        node.wait_for_efforts()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
