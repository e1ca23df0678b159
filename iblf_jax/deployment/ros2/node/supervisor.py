"""The safety state machine around the law, without ROS.

    waiting -> stopped -> running <-> holding,    running, holding -> fault -> running

    waiting: no complete state yet, no command       stopped: zero torques
    running: the law's torques                       holding: the hold torques
    fault: zero torques or the hold torques, as the user chose; only `start` leaves it

    hold torques: g(q) + K (q_h - q) - D q'    while the states are valid and fresh
                  g(q)                         at the last valid position q otherwise
    q_h: the position at the hold or the fault; after an interruption of the states, the position
         of the first valid and fresh state, so that its return makes no step of the torques

Every command passes `Supervisor._limited`, which clips it to the torque limits.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from typing import NamedTuple

from iblf_jax.deployment.ros2.node.c_law import NOT_FINITE, CLaw

NANOSECONDS = 1_000_000_000
MIN_STAMP_SPACING = 0.75
"""Shortest distance of the stamps of two samples of a law that samples with the states, in periods.
A state that follows sooner, from a driver that is faster than the law, becomes the last state, but
the law does not answer it."""
STAMP_TOLERANCE = 0.01
"""Tolerance of the distance of two stamps, in periods."""
STALE_PERIODS = 2.0
"""Default of the parameter `state_timeout`, in periods."""
ARRIVAL_TIMEOUT = 0.5
"""Default of the parameter `arrival_timeout` [s]."""
PUBLISHER_TIMEOUT = 1.0
"""Time for which a publisher has to be the only one until its states are used again [s]."""


class Mode(enum.Enum):
    """The modes of the node."""

    WAITING = "waiting"
    STOPPED = "stopped"
    RUNNING = "running"
    HOLDING = "holding"
    FAULT = "fault"


class FaultKind(enum.Enum):
    """Why a state, or a torque of the law, is not used."""

    STALE = "stale state"
    NOT_FINITE = "state that is not finite"
    JOINTS = "joints that do not match"
    CLOCK = "clock that jumped"
    PUBLISHER = "states of several publishers"
    TORQUE = "torque that is not finite"


class Fault(NamedTuple):
    """A fault and its reason in words."""

    kind: FaultKind
    reason: str


class Sender(NamedTuple):
    """What the middleware reports about the publisher of a message."""

    identity: bytes | None = None
    """The same for all messages of a publisher; None if it is unknown."""
    number: int | None = None
    """Counts the messages of a publisher; None if it is unknown."""

    def may_follow(self, last: Sender) -> bool:
        """Whether this message can be a later one of the publisher of another message."""
        is_other = None not in (self.identity, last.identity) and self.identity != last.identity
        if is_other or self.number is None or last.number is None:
            return not is_other
        return self.number > last.number


UNKNOWN = Sender()
"""A publisher about which the middleware reports nothing."""


class JointSample(NamedTuple):
    """A complete and valid state of the joints, in the order of the law."""

    stamp: int
    """Stamp of the message [ns]."""
    received: int
    """Arrival by the steady clock [ns]."""
    position: tuple[float, ...]
    """[rad]."""
    velocity: tuple[float, ...] | None
    """[rad/s]; None if it is not measured."""


class Command(NamedTuple):
    """What the node publishes."""

    torque: list[float]
    """In the order of the law's joints, within the limits [N m]."""
    mode: Mode
    status: int
    """Status of the law; 0 if it did not run."""
    limited: bool
    """Whether a torque was clipped to its limit."""


class Configuration(NamedTuple):
    """Constants of a supervisor."""

    joints: tuple[str, ...]
    period: float
    """Sampling period of the law [s]."""
    reads_velocity: bool
    """Whether a state without velocities is incomplete."""
    torque_limits: tuple[float, ...]
    """[N m]."""
    on_fault: str
    """"hold" or "zero"."""
    hold_stiffness: tuple[float, ...]
    """[N m/rad]."""
    hold_damping: tuple[float, ...]
    """[N m s/rad]."""
    start_automatically: bool
    start_outside_bounds: bool
    """Whether the law may start while a joint is outside of its bounds."""
    stamp_timeout: float
    """Age by its stamp beyond which a state is stale [s]."""
    arrival_timeout: float
    """Time since the arrival beyond which a state is stale [s]."""


class JointReader:
    """Reads messages with joints in any order, and further joints.

    Args:
      joints: names of the law's joints, in its order.
      reads_velocity: whether a message without velocities is incomplete.
    """

    def __init__(self, joints: Sequence[str], reads_velocity: bool) -> None:
        self.joints = tuple(joints)
        self.reads_velocity = reads_velocity
        self._names: list[str] = []
        self._places: tuple[int, ...] = ()
        """Places of the joints in a message with these names."""

    def read(
        self,
        names: list[str],
        position: Sequence[float],
        velocity: Sequence[float],
        stamp: int,
        received: int,
    ) -> JointSample | Fault | None:
        """The state in a message, the reason why it is not valid, or None for other joints.

        Args:
          names: names of the joints in the message.
          position: their positions [rad].
          velocity: their velocities [rad/s]; empty if they are not measured.
          stamp: stamp of the message [ns].
          received: arrival by the steady clock [ns].
        """
        if names != self._names:
            fault = self._find(names)
            if fault is not None:
                return fault
        if not self._places:
            return None
        if len(position) != len(names):
            reason = f"the state has {len(names)} names and {len(position)} positions"
            return Fault(FaultKind.JOINTS, reason)
        is_without = len(velocity) == 0 and not self.reads_velocity
        if len(velocity) != len(names) and not is_without:
            reason = f"the state has {len(names)} names and {len(velocity)} velocities"
            return Fault(FaultKind.JOINTS, reason)
        q = tuple([position[i] for i in self._places])
        dq = None
        if len(velocity):
            dq = tuple([velocity[i] for i in self._places])
        for name, numbers in (("position", q), ("velocity", dq or ())):
            for joint, x in zip(self.joints, numbers, strict=False):
                if not math.isfinite(x):
                    reason = f"the {name} of {joint} is {x}"
                    return Fault(FaultKind.NOT_FINITE, reason)
        return JointSample(stamp, received, q, dq)

    def _find(self, names: list[str]) -> Fault | None:
        """Finds the joints in a message with other names than the last one."""
        self._names, self._places = [], ()
        known = set(self.joints).intersection(names)
        if known:
            missing = [name for name in self.joints if name not in known]
            if missing:
                reason = f"the state has no joints {', '.join(missing)}"
                return Fault(FaultKind.JOINTS, reason)
            repeated = [name for name in self.joints if names.count(name) > 1]
            if repeated:
                reason = f"the state has several joints {', '.join(repeated)}"
                return Fault(FaultKind.JOINTS, reason)
            self._places = tuple(names.index(name) for name in self.joints)
        self._names = list(names)
        return None


class Supervisor:
    """Decides from the states, the services and the clocks which torque is published.

    Args:
      law: the law; its state belongs to the supervisor.
      configuration: the constants.
      time_origin: stamp at which reference and bounds begin [ns]; None for the stamp of the state
        with which the law starts.
    """

    def __init__(
        self, law: CLaw, configuration: Configuration, time_origin: int | None = None
    ) -> None:
        self.law = law
        self.configuration = configuration
        self.time_origin = time_origin
        self.mode = Mode.WAITING
        self.last_fault: Fault | None = None
        self.note = "no joint state has arrived"
        """What the node waits for, or the last message that it did not use."""
        self.started_at: int | None = None
        """Stamp that is t = 0 of the running law [ns]."""
        self.missed = 0
        """Samples without a state of their own, counted by the stamps."""
        self.margin = [math.inf] * len(configuration.joints)
        """Smallest distances to the bounds since `reset_extremes` [rad]."""
        self.status = 0
        """Flags of the law since `reset_extremes`."""
        self.limited = False
        """Whether a torque was clipped since `reset_extremes`."""
        self.repeated = 0
        """Periods without a new state, in which the law's last torques were published again."""
        self.sender: Sender | None = None
        """Of the last message with the joints."""
        self._reader = JointReader(configuration.joints, configuration.reads_velocity)
        self._state: JointSample | None = None
        """The last valid state."""
        self._previous: JointSample | None = None
        self._last_stamp: int | None = None
        self._due_stamp: int | None = None
        self._alone_from: float = 0.0
        """Time by the steady clock from which on a publisher counts as the only one [ns]."""
        self._why_invalid: str | None = None
        """Why the last message with the joints is not valid; None if it is."""
        self._law_stamp: int | None = None
        """Stamp of the state of the running law's last step [ns]."""
        self._law_result: tuple[list[float], int] = ([], 0)
        """Torques and status of this step."""
        self._starts_automatically = configuration.start_automatically
        self._hold_position: tuple[float, ...] | None = None
        """None if the next valid and fresh state is to be held."""
        self._zero_in_fault = False
        """Whether `stop` replaced the torques of the mode fault by zeros."""
        self._period = round(configuration.period * NANOSECONDS)
        self._stamp_timeout = _nanoseconds(configuration.stamp_timeout)
        self._arrival_timeout = _nanoseconds(configuration.arrival_timeout)
        self._zero = [0.0] * len(configuration.joints)

    def receive(
        self,
        names: list[str],
        position: Sequence[float],
        velocity: Sequence[float],
        stamp: int,
        received: int,
        sender: Sender = UNKNOWN,
    ) -> bool:
        """Takes a joint state.

        Args:
          names, position, velocity, stamp, received: as `JointReader.read`.
          sender: the publisher of the message.

        Returns:
          Whether a law that samples with the states has to answer: the stamp is that of a new
          sample, or the state is not valid.
        """
        found = self._reader.read(names, position, velocity, stamp, received)
        if found is None:
            self.note = f"a state has none of the joints {', '.join(self.configuration.joints)}"
            return False
        fault = self._publisher_fault(sender, received)
        if isinstance(found, Fault):
            fault = fault or found
        elif fault is None:
            fault = self._clock_fault(stamp)
            if fault is None:
                return self._accept(found)
        self._why_invalid = fault.reason
        self._report(fault)
        return True

    def _publisher_fault(self, sender: Sender, received: int) -> Fault | None:
        """A fault for a state of another publisher than the last one, and for all states after it
        until one publisher has been the only one for `PUBLISHER_TIMEOUT`.
        """
        last = self.sender
        self.sender = sender
        if last is not None and not sender.may_follow(last):
            self._alone_from = received + PUBLISHER_TIMEOUT * NANOSECONDS
        if received >= self._alone_from:
            return None
        reason = "a second publisher sends states of the joints, or the only one was restarted"
        return Fault(FaultKind.PUBLISHER, reason)

    def _clock_fault(self, stamp: int) -> Fault | None:
        """A fault for a stamp before the last one; the later states are compared with this one."""
        last = self._last_stamp
        if last is None or stamp >= last:
            return None
        self._last_stamp = self._due_stamp = stamp
        backward = (last - stamp) / NANOSECONDS
        return Fault(FaultKind.CLOCK, f"the stamps jumped back by {backward:g} s")

    def _accept(self, state: JointSample) -> bool:
        """Keeps a valid state; whether it is a new sample."""
        last, before = self._last_stamp, self._state
        if state.stamp == last and before is not None:
            return False
        self._previous, self._state = before, state
        self._last_stamp = state.stamp
        self._why_invalid = None
        spacing = MIN_STAMP_SPACING * self._period
        if last is not None:
            gap = state.stamp - last
            if gap > self._stamp_timeout + STAMP_TOLERANCE * self._period:
                self._hold_position = None
                reason = f"the stamps of two states are {gap / NANOSECONDS:g} s apart"
                self._report(Fault(FaultKind.STALE, reason))
            # Of the states of a faster driver, the one closest to a whole period is answered.
            spacing = max(spacing, self._period - gap / 2)
        due = self._due_stamp
        if due is not None and state.stamp - due < spacing:
            return False
        if due is not None:
            self.missed += max(round((state.stamp - due) / self._period) - 1, 0)
        self._due_stamp = state.stamp
        return True

    def _report(self, fault: Fault) -> None:
        """A fault of a state; it changes the mode only while torques depend on the states."""
        self.note = fault.reason
        if self.mode in (Mode.RUNNING, Mode.HOLDING):
            self._enter_fault(fault)

    def _enter_fault(self, fault: Fault) -> None:
        self.mode = Mode.FAULT
        self.last_fault = fault
        self.note = fault.reason
        self._zero_in_fault = False
        if self._state is not None:
            self._hold_position = self._state.position

    def command(self, now: int, clock: int | None = None) -> Command | None:
        """The command of this instant, one for each sample of the law; None before the first
        complete state.

        Args:
          now: the steady clock [ns].
          clock: the clock of the stamps [ns]; None if the stamps are not compared with a clock.
        """
        if self.mode is Mode.WAITING and not self._leave_waiting(now, clock):
            return None
        problem = self._staleness(now, clock)
        if problem is not None and self.mode in (Mode.RUNNING, Mode.HOLDING):
            self._enter_fault(Fault(FaultKind.STALE, problem))
        if self.mode is Mode.RUNNING and self._state is not None:
            torque, status = self._law_torque(self._state)
            # The law may have failed, which changes the mode.
            if self.mode is Mode.RUNNING:
                return self._limited(torque, status)
        is_current = problem is None and self._why_invalid is None
        return self._limited(self._torque_without_law(is_current), 0)

    def _leave_waiting(self, now: int, clock: int | None) -> bool:
        """Leaves the mode waiting with the first complete and fresh state."""
        if self._state is None:
            return False
        problem = self._why_not_current(now, clock)
        if problem is not None:
            self.note = problem
            return False
        self.mode = Mode.STOPPED
        self.note = ""
        if self._starts_automatically:
            started, reason = self.start(now, clock)
            if not started:
                self.note = reason
        return True

    def _why_not_current(self, now: int, clock: int | None) -> str | None:
        """Why the last valid state is not the present one; None if it is, or if there is none."""
        return self._why_invalid or self._staleness(now, clock)

    def _staleness(self, now: int, clock: int | None) -> str | None:
        """Why the last state is stale; None if it is fresh, or if there is none."""
        state = self._state
        if state is None:
            return None
        age = now - state.received
        if age > self._arrival_timeout:
            return f"no valid state has arrived for {age / NANOSECONDS:.4g} s"
        if clock is None:
            return None
        age = clock - state.stamp
        if age > self._stamp_timeout:
            return f"the last state is {age / NANOSECONDS:.4g} s old by its stamp"
        if -age > self._stamp_timeout:
            return f"the stamp of the last state is {-age / NANOSECONDS:.4g} s in the future"
        return None

    def _law_torque(self, state: JointSample) -> tuple[list[float], int]:
        """The torques of the law for a state, and its status.

        A state that the law has used already gives the torques of that step again: another step
        with the same measurement would distort the velocity filter and the observer.
        """
        if state.stamp == self._law_stamp:
            self.repeated += 1
            torque, status = self._law_result
            return list(torque), status
        if self.started_at is None:
            raise RuntimeError("started_at: got None, expected a stamp while the law runs.")
        t = (state.stamp - self.started_at) / NANOSECONDS
        torque, status = self.law.step(t, state.position, state.velocity)
        if status & NOT_FINITE:
            self._enter_fault(
                Fault(FaultKind.TORQUE, f"the law has no finite torque at t = {t:g} s")
            )
            return torque, status
        self._law_stamp = state.stamp
        self._law_result = (list(torque), status)
        self.status |= status
        lower, upper = self.law.bounds(t)
        margin = self.margin
        for i, x in enumerate(state.position):
            margin[i] = min(margin[i], x - lower[i], upper[i] - x)
        return torque, status

    def _torque_without_law(self, is_current: bool) -> list[float]:
        """The torques of the modes without the law.

        Args:
          is_current: whether the last valid state is the present one.
        """
        holds_on_fault = self.configuration.on_fault == "hold" and not self._zero_in_fault
        if self.mode is Mode.HOLDING or (self.mode is Mode.FAULT and holds_on_fault):
            return self._hold_torque(is_current)
        return list(self._zero)

    def _hold_torque(self, is_current: bool) -> list[float]:
        """The torques that hold the position of the hold."""
        state = self._state
        if state is None:
            return list(self._zero)
        torque = self.law.balance(state.position)
        if not is_current:
            self._hold_position = None
            return torque
        if self._hold_position is None:
            self._hold_position = state.position
        # Without a measured velocity, the difference quotient of the last two states.
        velocity: Sequence[float] | None = state.velocity
        before = self._previous
        if velocity is None:
            velocity = self._zero
            if before is not None and state.stamp > before.stamp:
                duration = (state.stamp - before.stamp) / NANOSECONDS
                pairs = zip(state.position, before.position, strict=True)
                velocity = [(x - y) / duration for x, y in pairs]
        for i, q in enumerate(state.position):
            torque[i] += self.configuration.hold_stiffness[i] * (self._hold_position[i] - q)
            torque[i] -= self.configuration.hold_damping[i] * velocity[i]
        return torque

    def _limited(self, torque: list[float], status: int) -> Command:
        """The command with every torque within its limits; NaN becomes 0."""
        limited = False
        for i, limit in enumerate(self.configuration.torque_limits):
            x = torque[i]
            if -limit <= x <= limit:
                continue
            limited = True
            torque[i] = 0.0
            if not math.isnan(x):
                torque[i] = math.copysign(limit, x)
        self.limited |= limited
        return Command(torque, self.mode, status, limited)

    def start(self, now: int, clock: int | None = None) -> tuple[bool, str]:
        """Starts the law with the last state.

        Args:
          now, clock: as `command`.

        Returns:
          Whether the law runs, and the reason in words.
        """
        if self.mode is Mode.RUNNING:
            return True, "The law is running already."
        state, problem = self._state, self._why_not_current(now, clock)
        if state is None:
            return False, f"Refused: {self.note}. A complete joint state is needed."
        if problem is not None:
            return False, f"Refused: {problem}. Valid and fresh joint states are needed."
        origin = state.stamp
        if self.time_origin is not None:
            origin = self.time_origin
        if state.stamp < origin:
            ahead = (origin - state.stamp) / NANOSECONDS
            reason = f"time_origin is {ahead:g} s after the stamp of the last state"
            return False, f"Refused: {reason}. Set it to the start of an earlier run, or to NaN."
        t = (state.stamp - origin) / NANOSECONDS
        outside = self._outside(state, t)
        if outside and not self.configuration.start_outside_bounds:
            remedy = "Move the robot, or restart the node with start_outside_bounds: true."
            return False, f"Refused: outside of its bounds: {outside}. {remedy}"
        if not self.law.init(state.position, state.velocity):
            return False, "Refused: the law has no finite state at these positions and velocities."
        self.started_at = origin
        self.mode = Mode.RUNNING
        self.note = ""
        self._law_stamp = None
        message = f"The law runs from t = {t:g} s."
        if outside:
            message += f" Outside of its bounds: {outside}."
        return True, message

    def _outside(self, state: JointSample, t: float) -> str:
        """The joints outside of their bounds, with positions and bounds; empty if there are none.

        Args:
          state: the positions.
          t: time since the start of reference and bounds [s].
        """
        lower, upper = self.law.bounds(t)
        rows = zip(self.configuration.joints, lower, state.position, upper, strict=True)
        return "; ".join(
            f"{name} at {q:.6g} rad, bounds {low:.6g} to {high:.6g} rad"
            for name, low, q, high in rows
            if not low < q < high
        )

    def stop(self) -> tuple[bool, str]:
        """Zero torques, and no automatic start; the mode fault stays until `start`."""
        if self.mode is Mode.WAITING and self._starts_automatically:
            self._starts_automatically = False
            return True, "No command has been sent yet. The automatic start is cancelled."
        if self.mode is Mode.WAITING:
            return True, "No command has been sent yet."
        if self.mode is Mode.FAULT:
            self._zero_in_fault = True
            return True, "The torques are zero. The fault stays until the law is started."
        self.mode = Mode.STOPPED
        return True, "The torques are zero."

    def hold(self, now: int, clock: int | None = None) -> tuple[bool, str]:
        """Holds the present position.

        Args:
          now, clock: as `command`.

        Returns:
          Whether the position is held, and the reason in words.
        """
        state, problem = self._state, self._why_not_current(now, clock)
        if self.mode is Mode.WAITING or state is None:
            return False, f"Refused: {self.note}. A complete joint state is needed."
        fault = self.last_fault
        if self.mode is Mode.FAULT and fault is not None:
            present = problem or "the states are valid now"
            return False, f"Refused: in fault ({fault.reason}); {present}. Only start leaves it."
        if problem is not None:
            return False, f"Refused: {problem}. Valid and fresh joint states are needed."
        self.mode = Mode.HOLDING
        self._hold_position = state.position
        return True, "The position is held."

    def is_stale(self, now: int, clock: int | None = None) -> bool:
        """Whether the last state is stale; arguments as `command`."""
        return self._staleness(now, clock) is not None

    @property
    def state_received(self) -> int | None:
        """Arrival of the last valid state by the steady clock [ns]."""
        return None if self._state is None else self._state.received

    def final_command(self) -> Command | None:
        """The last command before the node ends: the torques of a fault by the user's policy."""
        if self.mode is Mode.WAITING:
            return None
        if self.mode in (Mode.RUNNING, Mode.HOLDING):
            self._enter_fault(Fault(FaultKind.STALE, "the node ends"))
        return self._limited(self._torque_without_law(False), 0)

    def reset_extremes(self) -> None:
        """Begins a new interval of `margin`, `status` and `limited`."""
        self.margin = [math.inf] * len(self.configuration.joints)
        self.status = 0
        self.limited = False


def _nanoseconds(seconds: float) -> float:
    """Seconds, possibly infinite, in nanoseconds."""
    return seconds * NANOSECONDS
