"""The safety state machine of the generated node, without ROS: faults, policies, clocks and limits,
with a law whose torques a test chooses."""

import itertools
import math
from array import array

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iblf_jax.deployment.ros2.node import supervisor
from iblf_jax.deployment.ros2.node.c_law import NOT_FINITE
from iblf_jax.deployment.ros2.node.monitor import LoopMonitor
from iblf_jax.deployment.ros2.node.supervisor import NANOSECONDS, UNKNOWN, FaultKind, Mode, Sender

JOINTS = ("shoulder", "elbow", "wrist")
PERIOD = 0.01
T = round(PERIOD * NANOSECONDS)
EPOCH = 1_700_000_000 * NANOSECONDS
"""A stamp as wall clocks have them."""
LIMITS = (10.0, 5.0, 2.0)


class ChosenLaw:
    """A law whose torques, gravity and status a test sets; it records its calls."""

    def __init__(self):
        self.torque, self.gravity = [1.0, 2.0, 1.5], [3.0, 2.0, 1.0]
        self.status, self.starts = 0, True
        self.calls, self.inits = [], []

    def init(self, q, dq):
        self.inits.append((q, dq))
        return self.starts

    def step(self, t, q, dq):
        self.calls.append((t, q, dq))
        return list(self.torque), self.status

    def balance(self, q):
        return [g * math.cos(x) for g, x in zip(self.gravity, q, strict=True)]

    def bounds(self, t):
        return [-1.0] * 3, [1.0] * 3


HOLD = {"on_fault": "zero", "hold_stiffness": (4.0, 3.0, 2.0), "hold_damping": (0.4, 0.3, 0.2)}
START = {"start_automatically": False, "start_outside_bounds": False, "torque_limits": LIMITS}
TIMEOUTS = {"stamp_timeout": 2 * PERIOD, "arrival_timeout": 2 * PERIOD}
CONFIGURATION = supervisor.Configuration(
    JOINTS, PERIOD, reads_velocity=True, **HOLD, **START, **TIMEOUTS
)


class Bench:
    """A supervisor with a clock: the stamp of a state is its arrival unless a test chooses it."""

    def __init__(self, law=None, time_origin=None, **changes):
        self.law = law or ChosenLaw()
        configuration = CONFIGURATION._replace(**changes)
        self.supervisor = supervisor.Supervisor(self.law, configuration, time_origin)
        self.now = 0

    @property
    def clock(self):
        return EPOCH + self.now

    @property
    def mode(self):
        return self.supervisor.mode

    @property
    def fault(self):
        return self.supervisor.last_fault

    def state(self, q=(0.1, 0.2, 0.3), dq=(0.0,) * 3, names=JOINTS, stamp=None, sender=UNKNOWN):
        stamp = self.clock if stamp is None else stamp
        return self.supervisor.receive(list(names), q, dq, stamp, self.now, sender)

    def command(self):
        return self.supervisor.command(self.now, self.clock)

    def period(self, **state):
        """One period: a state, and the command that follows."""
        self.now += T
        self.state(**state)
        return self.command()

    def asked_to_start(self):
        return self.supervisor.start(self.now, self.clock)

    def start(self):
        started, message = self.asked_to_start()
        assert started, message
        return message

    def hold(self):
        return self.supervisor.hold(self.now, self.clock)

    def running(self):
        self.period()
        self.start()
        assert self.period().mode is Mode.RUNNING
        return self


def test_nothing_is_published_before_the_first_complete_state():
    bench = Bench()
    for state in (
        None,
        {"names": ("gripper",), "q": (0.0,), "dq": (0.0,)},
        {"names": ("shoulder", "elbow"), "q": (0.0, 0.0), "dq": (0.0, 0.0)},
        {"q": (0.0, math.nan, 0.0)},
        {"dq": ()},
        {"q": (0.0, 0.0)},
        {"stamp": EPOCH},  # stale
    ):
        bench.now += T
        if state is not None:
            bench.state(**state)
        assert bench.command() is None
        assert bench.mode is Mode.WAITING
        assert bench.asked_to_start()[0] is False
        assert bench.hold()[0] is False
        assert bench.supervisor.stop()[0] is True
        assert bench.command() is None
        assert bench.supervisor.final_command() is None
    assert "old by its stamp" in bench.supervisor.note
    command = bench.period()
    assert (command.mode, command.torque) == (Mode.STOPPED, [0.0, 0.0, 0.0])
    bench.law.starts = False
    assert bench.asked_to_start()[0] is False
    assert bench.period().mode is Mode.STOPPED


@given(order=st.permutations((*JOINTS, "gripper", "camera")))
def test_joints_are_found_by_name_in_any_order(order):
    numbers = {name: (0.1 * i, 1.0 * i) for i, name in enumerate((*JOINTS, "gripper", "camera"))}
    reader = supervisor.JointReader(JOINTS, True)
    q = array("d", [numbers[name][0] for name in order])
    dq = array("d", [numbers[name][1] for name in order])
    for _ in range(2):  # the second message has the names of the first
        sample = reader.read(list(order), q, dq, 5, 7)
        assert sample == supervisor.JointSample(5, 7, (0.0, 0.1, 0.2), (0.0, 1.0, 2.0))


FOUR = {"q": (0.1, 0.2, 0.3, 0.4), "dq": (0.0,) * 4}
MISSING = {"names": ("shoulder", "wrist"), "q": (0.1, 0.3), "dq": (0.0, 0.0)}
BAD_STATES = {
    "NaN in a position": ({"q": (0.1, math.nan, 0.3)}, FaultKind.NOT_FINITE, "elbow"),
    "infinity in a velocity": ({"dq": (0.0, 0.0, math.inf)}, FaultKind.NOT_FINITE, "wrist"),
    "a missing joint": (MISSING, FaultKind.JOINTS, "elbow"),
    "an unknown name": ({"names": ("shoulder", "elbo", "wrist")}, FaultKind.JOINTS, "elbow"),
    "a joint that occurs twice": ({"names": (*JOINTS, "elbow")} | FOUR, FaultKind.JOINTS, "elbow"),
    "too few positions": ({"q": (0.1, 0.2)}, FaultKind.JOINTS, "2 positions"),
    "too many positions": ({"q": FOUR["q"]}, FaultKind.JOINTS, "4 positions"),
    "no velocities": ({"dq": ()}, FaultKind.JOINTS, "0 velocities"),
    "too few velocities": ({"dq": (0.0,)}, FaultKind.JOINTS, "1 velocities"),
    "a stamp before the last one": ({"stamp": EPOCH}, FaultKind.CLOCK, "jumped back"),
    "a stamp far after the last one": ({"stamp": EPOCH + 100 * T}, FaultKind.STALE, "apart"),
}


@pytest.mark.parametrize("policy", ["zero", "hold"])
@pytest.mark.parametrize("mode", [Mode.RUNNING, Mode.HOLDING])
@pytest.mark.parametrize("name", BAD_STATES)
def test_a_bad_state_is_a_fault_that_only_start_leaves(name, mode, policy):
    state, kind, words = BAD_STATES[name]
    bench = Bench(on_fault=policy).running()
    if mode is Mode.HOLDING:
        assert bench.hold()[0]
    calls = len(bench.law.calls)
    command = bench.period(**state)
    assert command.mode is Mode.FAULT
    assert bench.fault.kind is kind and words in bench.fault.reason
    assert (command.torque == [0.0, 0.0, 0.0]) == (policy == "zero")
    for _ in range(5):
        assert bench.period().mode is Mode.FAULT
    is_held, message = bench.hold()
    assert is_held is False
    assert message.startswith("Refused: in fault (") and words in message
    assert message.endswith("; the states are valid now. Only start leaves it.")
    assert bench.supervisor.stop()[0] is True
    assert bench.period().torque == [0.0, 0.0, 0.0]
    assert bench.mode is Mode.FAULT
    assert len(bench.law.calls) == calls, "the law rests in a fault"
    bench.start()
    assert bench.period().torque == bench.law.torque
    last = [0.0] * 3 if policy == "zero" else bench.law.balance((0.1, 0.2, 0.3))
    assert bench.supervisor.final_command().torque == pytest.approx(last)


@pytest.mark.parametrize("name", [*BAD_STATES][:-1])
def test_a_bad_state_while_stopped_changes_nothing_but_the_note(name):
    bench = Bench()
    bench.period()
    assert bench.period(**BAD_STATES[name][0]).mode is Mode.STOPPED
    assert BAD_STATES[name][2] in bench.supervisor.note


SENDERS = {
    "identities": (b"driver", b"other", None, None),
    "identities and numbers": (b"driver", b"other", 1, 10**6),
    "numbers of publishers that began together": (None, None, 1, 1),
    "numbers of publishers that began one after the other": (None, None, 1000, 1),
}
"""What the middleware reports about two publishers: identities, and their first numbers."""


def senders(identity, number):
    """A function that makes the sender of the next message of a publisher."""
    numbers = itertools.repeat(None) if number is None else itertools.count(number)
    return lambda: Sender(identity, next(numbers))


@pytest.mark.parametrize("policy", ["zero", "hold"])
@pytest.mark.parametrize("mode", [Mode.RUNNING, Mode.HOLDING])
@pytest.mark.parametrize("case", SENDERS)
def test_a_second_publisher_is_a_fault_and_its_states_are_not_used(case, mode, policy):
    first, second, number, other_number = SENDERS[case]
    driver, other = senders(first, number), senders(second, other_number)
    bench = Bench(on_fault=policy)
    bench.period(sender=driver())
    bench.start()
    if mode is Mode.HOLDING:
        assert bench.hold()[0]
    assert bench.period(sender=driver()).mode is mode
    far = {"q": (0.9, -0.9, 0.9)}
    command = bench.period(sender=other(), **far)
    assert command.mode is Mode.FAULT
    assert bench.fault.kind is FaultKind.PUBLISHER
    assert "a second publisher sends states" in bench.fault.reason
    balance = [0.0] * 3 if policy == "zero" else bench.law.balance((0.1, 0.2, 0.3))
    assert command.torque == balance
    for _ in range(200):  # two seconds, in which both send
        assert bench.period(sender=driver()).torque == balance
        assert bench.period(sender=other(), **far).torque == balance
    started, message = bench.asked_to_start()
    assert not started and "a second publisher" in message
    assert all(q == (0.1, 0.2, 0.3) for _, q, _ in bench.law.calls)
    for _ in range(round(supervisor.PUBLISHER_TIMEOUT / PERIOD) + 1):
        bench.period(sender=driver())
    bench.start()
    assert bench.period(sender=driver()).mode is Mode.RUNNING


def test_publishers_of_other_joints_and_lost_messages_are_no_fault():
    """A lower number is that of a second publisher, and so is a bad state of another identity."""
    bench = Bench().running()
    for number in (1, 2, 5, 6, 100):
        gripper = {"names": ("gripper",), "q": (0.0,), "dq": (0.0,)}
        bench.state(sender=Sender(b"gripper", 3), **gripper)
        assert bench.period(sender=Sender(b"driver", number)).mode is Mode.RUNNING
    assert bench.period(sender=Sender(b"driver", 3)).mode is Mode.FAULT
    assert bench.fault.kind is FaultKind.PUBLISHER
    bench = Bench()
    bench.period(sender=Sender(b"driver", 1))
    bench.start()
    for bad in ({"q": (0.1, math.nan, 0.3)}, {"stamp": EPOCH}):
        bench.period(sender=Sender(b"other", 1), **bad)
        assert bench.fault.kind is FaultKind.PUBLISHER
    # States of other joints alone leave the own ones stale.
    bench = Bench().running()
    other = {"names": ("gripper",), "q": (math.nan,), "dq": (0.0,)}
    modes = [bench.period(**other).mode for _ in range(3)]
    assert modes == [Mode.RUNNING, Mode.RUNNING, Mode.FAULT]
    assert bench.fault.kind is FaultKind.STALE


def test_states_are_stale_by_their_age_their_stamps_or_gaps_of_stamps():
    """A law that samples with the states has no clock but gaps of stamps."""
    bench = Bench().running()
    bench.now += 2 * T
    assert bench.command().mode is Mode.RUNNING
    bench.now += 1
    assert bench.command().mode is Mode.FAULT
    assert bench.fault.kind is FaultKind.STALE
    for age, words in ((-3, "in the future"), (3, "old by its stamp")):
        bench = Bench(stamp_timeout=2 * PERIOD).running()
        for k in range(1, 6):  # the stamps drift away from the clock, each within two periods
            bench.now += T
            bench.state(stamp=bench.clock - round(age * T * k / 5))
            command = bench.command()
        assert command.mode is Mode.FAULT
        assert words in bench.fault.reason
    bench = Bench(arrival_timeout=0.5).running()
    stamp = bench.clock
    for gap, mode in ((T, Mode.RUNNING), (2 * T, Mode.RUNNING), (3 * T, Mode.FAULT)):
        stamp += gap
        bench.now += 20 * T  # as slow as a simulator may be
        assert bench.state(stamp=stamp)
        assert bench.supervisor.command(bench.now).mode is mode
    assert bench.supervisor.missed == 3
    # It notices that none arrive.
    bench = Bench(arrival_timeout=0.5).running()
    bench.now += round(0.5 * NANOSECONDS)
    assert not bench.supervisor.is_stale(bench.now)
    bench.now += 1
    assert bench.supervisor.is_stale(bench.now)
    assert bench.supervisor.command(bench.now).mode is Mode.FAULT


@pytest.mark.parametrize("factor", [1, 3, 10])
def test_of_a_burst_or_of_faster_states_than_samples_one_a_period_is_answered(factor):
    """States that waited in a queue arrive together, and some twice."""
    bench = Bench().running()
    new = []
    for stamp in (1.0, 1.0, 1.3, 1.6, 2.0, 2.0, 3.0):
        new.append(bench.state(stamp=bench.clock + round(stamp * T)))
    assert new == [True, False, False, False, True, False, True]
    assert bench.mode is Mode.RUNNING and bench.supervisor.missed == 0
    bench = Bench(arrival_timeout=0.5)
    stamps = [EPOCH + k * T // factor for k in range(10 * factor)]
    answered = [stamp for stamp in stamps if bench.state(stamp=stamp)]
    assert answered == [EPOCH + k * T for k in range(10)]
    assert bench.supervisor.missed == 0


def test_times_of_the_law_are_those_of_the_stamps_after_a_restart_too():
    """A reference that has not begun is refused."""
    first = Bench().running()
    for _ in range(3):
        first.period()
    assert [t for t, _, _ in first.law.calls] == pytest.approx([PERIOD * k for k in (1, 2, 3, 4)])
    second = Bench(time_origin=first.supervisor.started_at)
    second.now = 700 * T
    second.period()
    assert second.start() == f"The law runs from t = {700 * PERIOD:g} s."
    second.period()
    assert second.law.calls[0][0] == pytest.approx(701 * PERIOD)
    bench = Bench(time_origin=EPOCH + 1000 * T)
    bench.period()
    started, message = bench.asked_to_start()
    assert not started and "time_origin is 9.99 s after" in message
    assert bench.mode is Mode.STOPPED


OUTSIDE = "elbow at 1.5 rad, bounds -1 to 1 rad; wrist at -1 rad, bounds -1 to 1 rad."


def test_a_start_outside_of_the_bounds_is_refused_unless_it_is_allowed():
    outside, bench = {"q": (0.0, 1.5, -1.0)}, Bench(start_outside_bounds=True)
    bench.period(**outside)
    assert OUTSIDE in bench.start()
    assert bench.period(**outside).mode is Mode.RUNNING
    bench = Bench(start_automatically=True)
    assert bench.period(**outside).mode is Mode.STOPPED
    assert OUTSIDE in bench.supervisor.note
    assert bench.period().mode is Mode.STOPPED
    bench = Bench()
    bench.period(**outside)
    started, message = bench.asked_to_start()
    assert not started
    assert OUTSIDE in message and "Move the robot, or" in message
    assert bench.law.inits == []
    assert bench.period().mode is Mode.STOPPED
    bench.start()
    assert bench.period(q=(0.0, 1.5, 0.0)).mode is Mode.RUNNING, "only the start is refused"


def test_an_automatic_start_needs_no_service_and_does_not_leave_a_fault():
    """It is cancelled by a stop while the node waits."""
    bench = Bench(start_automatically=True)
    assert bench.period().mode is Mode.RUNNING
    assert bench.period(q=(math.nan,) * 3).mode is Mode.FAULT
    for _ in range(5):
        assert bench.period().mode is Mode.FAULT
    bench.now += 3 * T
    _, message = bench.hold()
    assert "in fault (the position of shoulder is nan); no valid state has arrived for" in message
    bench = Bench(start_automatically=True)
    assert bench.command() is None
    assert "automatic start is cancelled" in bench.supervisor.stop()[1]
    for _ in range(3):
        assert bench.period().mode is Mode.STOPPED
    assert bench.law.inits == []
    bench.start()
    assert bench.period().mode is Mode.RUNNING


def test_a_period_without_a_new_state_repeats_the_torques_but_not_those_of_an_earlier_run():
    bench = Bench().running()
    bench.law.status = 4
    first = bench.period()
    calls = len(bench.law.calls)
    bench.law.torque = [0.1, 0.2, 0.3]
    stamp = bench.clock
    bench.now += T // 2
    assert bench.command() == first
    bench.state(q=(0.4, 0.4, 0.4), stamp=stamp)  # the same stamp once more is no new state
    bench.now += T // 2
    assert bench.command() == first
    assert len(bench.law.calls) == calls and bench.supervisor.repeated == 2
    assert bench.period().torque == [0.1, 0.2, 0.3]
    assert len(bench.law.calls) == calls + 1 and bench.supervisor.repeated == 2
    bench = Bench().running()
    assert "already" in bench.start()
    assert len(bench.law.inits) == 1, "a running law is not reset"
    bench.supervisor.stop()
    assert bench.command().torque == [0.0, 0.0, 0.0]
    bench.start()
    calls = len(bench.law.calls)
    bench.command()
    assert len(bench.law.calls) == calls + 1 and bench.supervisor.repeated == 0


def test_a_torque_that_is_not_finite_is_a_fault_and_torques_are_clipped():
    bench = Bench(on_fault="zero").running()
    bench.law.status = NOT_FINITE
    command = bench.period()
    assert (command.mode, command.torque) == (Mode.FAULT, [0.0, 0.0, 0.0])
    assert bench.fault.kind is FaultKind.TORQUE
    for torque, expected in (
        ([11.0, -6.0, 1.0], [10.0, -5.0, 1.0]),
        ([math.inf, -math.inf, math.nan], [10.0, -5.0, 0.0]),
        ([10.0, -5.0, 2.0], [10.0, -5.0, 2.0]),
    ):
        bench = Bench().running()
        bench.law.torque = torque
        command = bench.period()
        assert command.torque == expected
        assert command.limited == bench.supervisor.limited == (torque != expected)


def test_hold_is_gravity_with_stiffness_and_damping_about_the_position():
    """Without measured velocities it damps the difference quotient."""
    bench = Bench().running()
    assert bench.hold()[0]
    q, dq = (0.2, 0.1, 0.5), (1.0, -1.0, 0.5)
    command = bench.period(q=q, dq=dq)
    held = (0.1, 0.2, 0.3)
    rows = zip(bench.law.balance(q), held, q, dq, (4.0, 3.0, 2.0), (0.4, 0.3, 0.2), strict=True)
    expected = [g + k * (h - x) - d * v for g, h, x, v, k, d in rows]
    assert command.mode is Mode.HOLDING and command.torque == pytest.approx(expected)
    bench = Bench(reads_velocity=False)
    bench.period(dq=())
    bench.start()
    assert bench.period(dq=()).mode is Mode.RUNNING
    assert bench.law.calls[0][2] is None
    bench.hold()
    command = bench.period(q=(0.11, 0.2, 0.3), dq=())
    gravity = bench.law.balance((0.11, 0.2, 0.3))
    assert command.torque[0] == pytest.approx(gravity[0] - 4.0 * 0.01 - 0.4 * 0.01 / PERIOD)


@pytest.mark.parametrize("is_holding", [False, True])
def test_states_that_return_after_an_outage_make_no_step_of_the_torques(is_holding):
    """The first of them is the position that is held from then on."""
    bench = Bench(on_fault="hold").running()
    bench.period(dq=(1.0, 1.0, 1.0))
    if is_holding:
        bench.hold()
    bench.now += 3 * T
    command = bench.command()
    assert command.mode is Mode.FAULT
    # Without fresh states there is gravity alone.
    assert command.torque == pytest.approx(bench.law.balance((0.1, 0.2, 0.3)))
    first = (0.3, 0.2, 0.3)
    assert bench.period(q=first).torque == pytest.approx(bench.law.balance(first))
    gravity = bench.law.balance((0.4, 0.2, 0.3))
    later = bench.period(q=(0.4, 0.2, 0.3))
    assert later.torque == pytest.approx([gravity[0] - 4.0 * 0.1, *gravity[1:]])


def test_invalid_messages_and_outages_move_the_position_of_the_hold_and_late_commands_do_not():
    """With the trigger "state" the last valid state is fresh for `arrival_timeout`, and no command
    may fall into an outage.  States that wait while the process is suspended are no interruption:
    a position that moved at each of them would let a loaded arm sink step by step."""
    bench = Bench(on_fault="hold", arrival_timeout=0.5).running()
    moved = (0.15, 0.25, 0.35)
    bench.period(q=moved, dq=(1.0, 1.0, 1.0))
    gravity = bench.law.balance(moved)
    for _ in range(5):
        bench.now += 4 * T
        bench.state(q=(math.nan,) * 3)
        command = bench.supervisor.command(bench.now)
        assert command.mode is Mode.FAULT and command.torque == pytest.approx(gravity)
    first, second = (0.3, 0.2, 0.3), (0.3, 0.3, 0.3)
    assert bench.period(q=first).torque == pytest.approx(bench.law.balance(first))
    gravity = bench.law.balance(second)
    expected = [gravity[0], gravity[1] - 3.0 * 0.1, gravity[2]]
    assert bench.period(q=second).torque == pytest.approx(expected)
    # One invalid message is an interruption, too, as one lost message is.
    bench = Bench(on_fault="hold").running()
    bench.period(q=(math.nan,) * 3)
    assert bench.period(q=first).torque == pytest.approx(bench.law.balance(first))
    bench = Bench(on_fault="hold", arrival_timeout=0.5).running()
    bench.period(q=(math.nan,) * 3)
    bench.period()
    bench.now += 4 * T
    bench.state(q=(0.3, 0.2, 0.3))
    command = bench.supervisor.command(bench.now)
    assert command.mode is Mode.FAULT
    assert command.torque == pytest.approx(bench.law.balance((0.3, 0.2, 0.3)))
    bench = Bench().running()
    bench.hold()
    bench.now += 3 * T
    for k in (-2, -1, 0):
        bench.state(q=(0.3, 0.2, 0.3), stamp=bench.clock + k * T)
    command = bench.command()
    assert command.mode is Mode.HOLDING
    gravity = bench.law.balance((0.3, 0.2, 0.3))
    assert command.torque == pytest.approx([gravity[0] - 4.0 * 0.2, *gravity[1:]])


def test_start_and_hold_need_a_fresh_state_and_a_valid_last_message_and_stop_is_for_one_fault():
    bench = Bench(arrival_timeout=0.5)
    bench.period()
    bench.now += 3 * T
    for action in (bench.supervisor.start, bench.supervisor.hold):
        assert not action(bench.now, bench.clock)[0]
    bench.state(q=(math.nan, 0.0, 0.0))
    for action in (bench.supervisor.start, bench.supervisor.hold):
        done, message = action(bench.now)
        assert not done and "the position of shoulder is nan" in message
    assert bench.period().mode is Mode.STOPPED
    bench.start()
    bench = Bench(on_fault="hold").running()
    bench.period(q=(math.nan,) * 3)
    bench.supervisor.stop()
    assert bench.period().torque == [0.0, 0.0, 0.0]
    bench.start()
    bench.period()
    assert bench.period(q=(math.nan,) * 3).torque != [0.0, 0.0, 0.0]


def test_margins_and_flags_are_the_worst_of_an_interval_and_latencies_have_quantiles():
    bench = Bench().running()
    for states, margin, flags in (
        ({4: (0.9, 0.0, -0.95), 2: (0.0, 0.0, 0.0)}, [0.1, 0.8, 0.05], 6),
        ({0: (0.5, 0.5, 0.5)}, [0.5, 0.5, 0.5], 0),
    ):
        for status, q in states.items():
            bench.law.status = status
            bench.period(q=q)
        assert bench.supervisor.margin == pytest.approx(margin)
        assert bench.supervisor.status == flags
        bench.supervisor.reset_extremes()
    monitor = LoopMonitor()
    assert monitor.missed_share == 0.0
    for missed in (0, 0, 1, 0):
        monitor.count_sample(missed)
    assert (monitor.samples, monitor.missed, monitor.missed_share) == (4, 1, 0.2)
    assert monitor.latency_quantile(0.99) == 0.0
    for latency in itertools.chain([3_000_000_000], [105_000] * 98, [405_000]):
        monitor.add_latency(latency)
    assert monitor.longest_latency == 3_000_000_000
    assert monitor.latency_quantile(0.5) == pytest.approx(110e-6)
    assert monitor.latency_quantile(0.99) == pytest.approx(410e-6)
    assert monitor.latency_quantile(1.0) == pytest.approx(3.0)


TORQUE = st.floats(allow_nan=True, allow_infinity=True)
STATE = st.fixed_dictionaries(
    {},
    optional={
        "q": st.lists(TORQUE, min_size=2, max_size=4),
        "dq": st.lists(TORQUE, max_size=4),
        "names": st.permutations((*JOINTS, "gripper")),
    },
)
ACTION = st.sampled_from(["state", "state", "state", "none", "start", "stop", "hold", "late"])


@given(
    events=st.lists(st.tuples(ACTION, STATE, st.tuples(TORQUE, TORQUE, TORQUE)), max_size=30),
    gravity=st.tuples(TORQUE, TORQUE, TORQUE),
    policy=st.sampled_from(["hold", "zero"]),
    automatic=st.booleans(),
)
def test_no_torque_is_ever_beyond_its_limit(events, gravity, policy, automatic):
    """Whatever law, states, services and clocks do."""

    def is_within(command):
        return all(-m <= x <= m for x, m in zip(command.torque, LIMITS, strict=True))

    bench = Bench(on_fault=policy, start_automatically=automatic)
    actions = {"start": bench.asked_to_start, "stop": bench.supervisor.stop, "hold": bench.hold}
    bench.law.gravity = list(gravity)
    bench.law.balance = lambda q: list(gravity)
    bench.period()
    for action, state, torque in events:
        bench.law.torque = list(torque)
        bench.now += (4 if action == "late" else 1) * T
        if action == "state":
            bench.state(**state)
        elif action in actions:
            actions[action]()
        assert is_within(bench.command())
    assert is_within(bench.supervisor.final_command())
