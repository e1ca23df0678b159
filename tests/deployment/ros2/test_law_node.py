"""The node of a generated package as a process of its own, and a client of rclpy in this one: the
law of a simulated run in lock-step, faults, limits, gains that change, and restarts."""

from __future__ import annotations

import array
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import pytest
import ros_package

import iblf_jax as ij
from iblf_jax.deployment.ros2.node.c_law import load_law

REASON = "rclpy is not installed: pip install '.[ros]' has wheels for Python 3.11 on Linux x86-64"
rclpy = pytest.importorskip("rclpy", reason=REASON)
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

NAME, PERIOD = ros_package.NAME, ros_package.PERIOD
LIMITS = (40.0, 15.0)
JOINTS = ("joint_1", "joint_2")
INSIDE = (0.55, 0.45)
"""Positions inside of the bounds at t = 0."""
TIMEOUT = 20.0
"""Longest wait for something that must happen [s]."""
DEFAULT = object()
"""Leaves a parameter as the exported file has it."""


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    return ros_package.made_package(tmp_path_factory.mktemp("ros2"))


@pytest.fixture(scope="module")
def context():
    ros_package.take_domain()
    rclpy.init()
    yield
    rclpy.shutdown()


class Client:
    """What a robot's driver and its user do: states, efforts, services and parameters."""

    def __init__(self):
        self.node = rclpy.create_node("robot")
        self.states = self.node.create_publisher(JointState, "joint_states", 10)
        self.efforts: list[list[float]] = []
        self.diagnostics: dict[str, str] = {}
        self.level = b"\0"
        self.message = ""
        self.clients = {}
        self.node.create_subscription(Float64MultiArray, "efforts", self._effort, 10)
        self.node.create_subscription(DiagnosticArray, "diagnostics", self._diagnostic, 10)

    def reset(self) -> None:
        self.spin(0.05)
        self.efforts.clear()
        self.diagnostics = {}

    def _effort(self, message):
        effort = list(message.data)
        assert all(-limit <= x <= limit for x, limit in zip(effort, LIMITS, strict=True))
        self.efforts.append(effort)

    def _diagnostic(self, message):
        status = message.status[0]
        self.level = status.level
        self.message = status.message
        self.diagnostics = {value.key: value.value for value in status.values}

    def spin(self, duration: float) -> None:
        end = time.monotonic() + duration
        while time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.005)

    def wait(self, condition: Callable[[], object], what: str) -> None:
        end = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < end, f"{what}; {self.diagnostics}"
            rclpy.spin_once(self.node, timeout_sec=0.005)

    def connect(self) -> None:
        """Waits until the node reports a message of this client, with other joints than its own.

        The endpoints of a killed process are known for 20 s, so that counts of them say nothing.
        """
        other = {"names": ("gripper",), "q": (0.0,), "dq": (0.0,)}
        self.diagnostics = {}
        self.drive(lambda: "none of" in self.diagnostics.get("note", ""), "no node", **other)

    def state(self, q=INSIDE, dq=(0.0, 0.0), names=JOINTS, stamp=None) -> None:
        """Publishes a state, with the present time as its stamp unless one is given [s]."""
        message = JointState(name=list(names), position=list(q), velocity=list(dq))
        message.header.stamp = self.node.get_clock().now().to_msg()
        if stamp is not None:
            nanoseconds = round(stamp * 1e9)
            message.header.stamp.sec = nanoseconds // 10**9
            message.header.stamp.nanosec = nanoseconds % 10**9
        self.states.publish(message)

    def drive(self, until: Callable[[], object], what: str, **state) -> None:
        end = time.monotonic() + TIMEOUT
        while not until():
            assert time.monotonic() < end, f"{what}; {self.diagnostics}"
            self.state(**state)
            self.spin(PERIOD)

    def drive_for(self, duration: float, **state) -> None:
        end = time.monotonic() + duration
        self.drive(lambda: time.monotonic() > end, "time", **state)

    def _called(self, kind, name, request, drives=True):
        client = self.clients.get(name)
        if client is None:
            client = self.clients[name] = self.node.create_client(kind, name)
        assert client.wait_for_service(TIMEOUT)
        for _ in range(10):  # a request that reaches an ended process has no answer
            future = client.call_async(request)
            until = time.monotonic() + 2.0
            while not future.done() and time.monotonic() < until:
                if drives:
                    self.state()
                self.spin(PERIOD)
            if future.done():
                return future.result()
            client.remove_pending_request(future)
        raise AssertionError(f"{name} does not answer; {self.diagnostics}")

    def call(self, service: str, drives=True):
        """Calls a service of the node, while states go on."""
        return self._called(Trigger, f"/{NAME}/{service}", Trigger.Request(), drives)

    def set(self, name: str, value, drives=True) -> tuple[bool, str]:
        """Sets a parameter of the node; whether that succeeded, and the reason."""
        number = ParameterValue(type=ParameterType.PARAMETER_DOUBLE)
        if isinstance(value, float):
            number.double_value = value
        else:
            number.type = ParameterType.PARAMETER_DOUBLE_ARRAY
            number.double_array_value = array.array("d", value)
        request = SetParameters.Request(parameters=[Parameter(name=name, value=number)])
        service = f"/{NAME}/set_parameters"
        result = self._called(SetParameters, service, request, drives).results[0]
        return result.successful, result.reason

    def get(self, name: str) -> list[float]:
        request = GetParameters.Request(names=[name])
        value = self._called(GetParameters, f"/{NAME}/get_parameters", request).values[0]
        return list(value.double_array_value) or [value.double_value]

    @property
    def mode(self) -> str:
        return self.diagnostics.get("mode", "")

    def reach(self, mode: str, **state) -> None:
        self.drive(lambda: self.mode == mode, f"not {mode}", **state)


@pytest.fixture(scope="module")
def robot(context):
    """One node for all tests: to destroy one while a process of the graph ends may fail in DDS."""
    return Client()


@pytest.fixture
def client(robot):
    robot.reset()
    return robot


class Nodes:
    """Processes of the node, with a timeout of states that a busy machine does not exceed."""

    def __init__(self, package):
        self.environment = dict(os.environ)
        paths = [str(package.modules), os.environ.get("PYTHONPATH", "")]
        self.environment["PYTHONPATH"] = os.pathsep.join(paths)
        self.file = package.prefix / "share" / NAME / "config" / f"{NAME}.yaml"
        self.processes: list[subprocess.Popen] = []

    def begin(self, program=("-m", f"{NAME}.law_node"), remap=(), **parameters) -> subprocess.Popen:
        command = [sys.executable, *program, "--ros-args", "--params-file", str(self.file)]
        for rule in remap:
            command += ["-r", rule]
        for name, value in ({"state_timeout": 0.5} | parameters).items():
            if value is not DEFAULT:
                command += ["-p", f"{name}:={value}"]
        process = subprocess.Popen(command, env=self.environment, stderr=subprocess.PIPE, text=True)
        self.processes.append(process)
        return process


@pytest.fixture
def nodes(package, context):
    made = Nodes(package)
    yield made
    for process in made.processes:
        process.terminate()
    for process in made.processes:
        process.communicate(timeout=TIMEOUT)


def test_in_lock_step_the_efforts_are_those_of_the_simulation(client, nodes, package):
    """The states of a simulated run with other joints and in another order: the node repeats its
    torques."""
    names = ["gripper", "joint_2", "camera", "joint_1"]
    run = ij.simulate(package.scenario, duration=3.0, dt=1e-3, record_every=10)
    nodes.begin(trigger="state", start_automatically="true")
    client.connect()
    for k in range(len(run.t) - 1):
        q, dq = run.measured.q[k].tolist(), run.measured.dq[k].tolist()
        state = {"q": (9.0, q[1], 8.0, q[0]), "dq": (7.0, dq[1], 6.0, dq[0])}
        client.state(stamp=1000.0 + k * PERIOD, names=names, **state)
        client.wait(lambda: len(client.efforts) == k + 1, f"no answer {k}")  # noqa: B023
    np.testing.assert_allclose(client.efforts, run.tau[:-1], rtol=0, atol=1e-6)
    client.spin(0.3)
    assert client.mode == "running"
    assert client.diagnostics["missed_periods"] == "0"
    assert client.diagnostics["samples"] == str(len(run.t) - 1)


@pytest.mark.parametrize("trigger", ["timer", "state"])
def test_a_best_effort_driver_reaches_the_trigger_timer_only(client, nodes, trigger):
    quality = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    driver = client.node.create_publisher(JointState, "joint_states", quality)
    nodes.begin(trigger=trigger)
    client.connect()
    reliable, client.states = client.states, driver
    try:
        if trigger == "timer":
            client.reach("stopped")
        client.drive_for(0.5)
    finally:
        client.states = reliable
    assert client.mode == ("stopped" if trigger == "timer" else "waiting")


def test_the_parameter_file_holds_in_a_namespace_and_under_another_name(client, nodes, tmp_path):
    """Lowered limits of torques are not ignored there."""
    text = nodes.file.read_text()
    assert "torque_limits: [40.0, 15.0]" in text
    nodes.file = tmp_path / "lowered.yaml"
    nodes.file.write_text(text.replace("[40.0, 15.0]", "[5.0, 3.0]"))
    topics = [f"{topic}:=/{topic}" for topic in ("joint_states", "efforts", "diagnostics")]
    names = ["__ns:=/left", "__node:=other_law"]
    nodes.begin(remap=[*names, *topics], start_automatically="true")
    client.connect()
    client.reach("running")
    # At and outside of the bounds the law uses all torque.
    rng = np.random.default_rng(0)
    for _ in range(100):
        client.state(q=rng.normal(0.5, 1.0, 2).tolist(), dq=rng.normal(0.0, 20.0, 2).tolist())
        client.spin(PERIOD)
    np.testing.assert_array_equal(np.abs(client.efforts).max(axis=0), [5.0, 3.0])


def test_without_states_the_policy_takes_over(client, nodes):
    """The law may start outside of the bounds here."""
    nodes.begin(on_fault="hold", start_automatically="true", start_outside_bounds="true")
    client.connect()
    client.reach("running", q=(5.0, INSIDE[1]))
    client.wait(lambda: client.mode == "fault", "no fault")
    count = len(client.efforts)
    client.wait(lambda: len(client.efforts) > count, "no torques of the policy")
    assert client.efforts[-1] != [0.0, 0.0]
    assert "stale" in client.diagnostics["last_fault"]


def test_the_trigger_state_with_default_timeouts_compares_stamps_and_then_arrivals(client, nodes):
    """Gaps of two periods between stamps are tolerated, three are not; nor is half a second without
    a state.  The torques of the policy are zero, and the law starts again after each fault.
    """
    nodes.begin(trigger="state", on_fault="zero", start_automatically="true", state_timeout=DEFAULT)
    client.connect()
    stamp = 1000.0

    def step(periods):
        nonlocal stamp
        stamp += periods * PERIOD
        count = len(client.efforts)
        client.state(stamp=stamp)
        client.wait(lambda: len(client.efforts) > count, "no answer")
        return client.efforts[-1]

    for periods in (1, 1, 2, 1, 2):
        assert step(periods) != [0.0, 0.0]
    assert step(3) == [0.0, 0.0]
    client.wait(lambda: client.mode == "fault", "no fault")
    assert "the stamps of two states are 0.03 s apart" in client.diagnostics["last_fault"]
    assert step(1) == [0.0, 0.0]
    assert client.call("start", drives=False).success
    assert step(1) != [0.0, 0.0]
    last, count = time.monotonic(), len(client.efforts)
    client.wait(lambda: len(client.efforts) > count, "no torques of the policy")
    assert time.monotonic() - last > 0.49
    assert client.efforts[-1] == [0.0, 0.0]
    client.wait(lambda: client.mode == "fault", "no fault")
    assert "no valid state has arrived for 0." in client.diagnostics["last_fault"]


ELSEWHERE = (INSIDE[0] + 0.15, INSIDE[1] - 0.15)
"""Positions of a second publisher, also inside of the bounds."""
HIDES_EXECUTOR = "sys.modules['rclpy.experimental'] = None"
HIDES_IDENTITY = "law_node._sender = lambda x: Sender(None, x['publication_sequence_number'])"
HIDES_SENDER = "law_node._sender = lambda x: Sender()"


def node_with(change: str) -> list[str]:
    """A program of the node with a change of its modules before the start."""
    start = f"from {NAME} import law_node; from {NAME}.supervisor import Sender"
    first = [change, start] if change is HIDES_EXECUTOR else [start, change]
    return ["-c", "; ".join(["import sys", *first, "sys.exit(law_node.main())"])]


@pytest.mark.parametrize(
    ("trigger", "policy", "change"),
    [
        pytest.param("state", "hold", "pass", id="state"),
        pytest.param("timer", "hold", HIDES_EXECUTOR, id="executor in Python"),
        pytest.param("timer", "zero", HIDES_IDENTITY, id="numbers only"),
    ],
)
def test_a_second_publisher_of_joint_states_is_a_fault(
    client, nodes, package, trigger, policy, change
):
    program = node_with(change)
    process = nodes.begin(
        program=program, trigger=trigger, on_fault=policy, start_automatically="true"
    )
    client.connect()
    client.reach("running")
    client.drive_for(0.2)
    node = rclpy.create_node("second_driver")
    second, first = node.create_publisher(JointState, "joint_states", 10), client.states

    def both_send(until):
        while not until():
            client.states = second
            client.state(q=ELSEWHERE)
            client.states = first
            client.state()
            client.spin(PERIOD)

    try:
        end = time.monotonic() + TIMEOUT
        both_send(lambda: client.mode == "fault" or time.monotonic() > end)
        assert client.diagnostics["last_fault"].startswith("states of several publishers: a second")
        assert client.level == b"\2"
        assert int(client.diagnostics["publishers"]) >= 2
        count = len(client.efforts)
        end = time.monotonic() + 0.5
        both_send(lambda: time.monotonic() > end)
        # Both send on: the torques of the fault are constant.
        law = load_law(package.modules / NAME)
        balance = law.balance(INSIDE) if policy == "hold" else [0.0, 0.0]
        np.testing.assert_allclose(client.efforts[count:], [balance] * len(client.efforts[count:]))
        refused = client.call("start", drives=False)
        assert not refused.success and "second publisher" in refused.message
    finally:
        node.destroy_node()
    client.drive_for(1.2)
    assert client.call("start").success
    client.reach("running")
    process.terminate()
    _, log = process.communicate(timeout=TIMEOUT)
    # The name of a node may arrive later than its messages.
    assert re.search("publishers of joint_states: .*, ", log)


def test_publishers_that_the_middleware_does_not_tell_apart_are_counted(client, nodes):
    nodes.begin(program=node_with(HIDES_SENDER), start_automatically="true")
    client.connect()
    client.reach("running")
    assert client.level == b"\0" or "does not tell apart" in client.message
    node = rclpy.create_node("second_driver")
    publisher = node.create_publisher(JointState, "joint_states", 10)
    try:
        client.drive(lambda: int(client.diagnostics["publishers"]) >= 2, "one publisher")
        client.drive(lambda: client.level == b"\1", "no warning")
        assert "publishers, which the middleware does not tell apart" in client.message
        assert client.mode == "running"
    finally:
        node.destroy_publisher(publisher)
        node.destroy_node()


def test_a_gain_changes_while_the_law_runs_and_is_refused_outside_of_its_range(client, nodes):
    nodes.begin(start_automatically="true", time_origin=0.0)
    client.connect()
    moving = {"dq": (0.3, -0.4)}
    client.reach("running", **moving)
    for name, value, words in (
        ("controller.K2", [4.5, 2.0], "got 4.5, expected a number from 1 to 4"),
        ("controller.K2", [2.0], ""),
        ("controller.K2", [math.nan, 2.0], ""),
        ("controller.k1", 4.1, ""),
        ("time_origin", -math.inf, "time_origin: got -inf, expected a stamp"),
        ("time_origin", 1e300, "NaN is the stamp at the start"),
        # These are read-only.
        ("torque_limits", [1.0, 1.0], ""),
        ("period", 0.02, ""),
        ("state_timeout", math.inf, ""),
        ("arrival_timeout", math.inf, ""),
    ):
        succeeded, reason = client.set(name, value)
        assert not succeeded and words in reason, name
    assert client.get("controller.K2") == [2.0, 2.0]
    assert client.set("controller.K2", [4.0, 3.5]) == (True, "")
    assert client.set("controller.k1", 2.0) == (True, "")
    assert client.get("controller.K2") == [4.0, 3.5]
    client.drive_for(0.2, **moving)
    assert client.mode == "running"


def test_a_gain_takes_effect_between_two_samples(client, nodes, package):
    """The law's library in this process with the same change at the same sample."""
    law, unchanged = (load_law(package.modules / NAME) for _ in range(2))
    rng = np.random.default_rng(1)
    positions = np.asarray(INSIDE) + 0.001 * np.cumsum(rng.normal(size=(30, 2)), axis=0)
    velocities = rng.normal(0.0, 0.5, (30, 2))
    nodes.begin(trigger="state", start_automatically="true")
    client.connect()
    differences = []
    for k, (q, dq) in enumerate(zip(positions.tolist(), velocities.tolist(), strict=True)):
        if k == 0:
            assert law.init(q, dq)
            assert unchanged.init(q, dq)
        if k == 15:
            assert client.set("controller.K2", [4.0, 3.5], drives=False) == (True, "")
            law.set_gain("controller.K2", [4.0, 3.5])
        expected, _ = law.step(k * PERIOD, q, dq)
        client.state(stamp=1000.0 + k * PERIOD, q=q, dq=dq)
        client.wait(lambda: len(client.efforts) == k + 1, f"no answer {k}")  # noqa: B023
        np.testing.assert_allclose(client.efforts[-1], expected, rtol=0, atol=1e-6)
        differences.append(np.abs(np.subtract(expected, unchanged.step(k * PERIOD, q, dq)[0])))
    assert np.max(differences[:15]) == 0
    assert np.min(np.max(differences[15:], axis=1)) > 1e-3


def test_a_killed_node_goes_on_with_the_reference(client, nodes, package):
    """The second process runs from the middle of the run, with the origin of the first."""
    run = ij.simulate(package.scenario, duration=2.0, dt=1e-3, record_every=10)
    begin = {"trigger": "state", "start_automatically": "true", "time_origin": 1000.0}

    def replay(rows):
        client.connect()
        client.efforts.clear()
        for count, k in enumerate(rows, start=1):
            q, dq = run.measured.q[k].tolist(), run.measured.dq[k].tolist()
            client.state(stamp=1000.0 + k * PERIOD, q=q, dq=dq)
            client.wait(lambda: len(client.efforts) == count, f"no answer {k}")  # noqa: B023
        return np.asarray(client.efforts)

    first = nodes.begin(**begin)
    np.testing.assert_allclose(replay(range(100)), run.tau[:100], atol=1e-6)
    first.kill()
    first.wait()
    nodes.begin(**begin)
    after = replay(range(120, 200))
    # The observer starts again; the reference does not.
    assert np.abs(after[-40:] - run.tau[160:200]).max() < 0.2
    origin = "1000.000000000"
    client.wait(lambda: client.diagnostics["time_origin [s]"] == origin, "another origin")


@pytest.mark.parametrize(("policy", "number"), [("zero", signal.SIGINT), ("hold", signal.SIGTERM)])
def test_a_node_that_ends_sends_the_torques_of_its_policy(client, nodes, policy, number):
    process = nodes.begin(on_fault=policy, start_automatically="true", trigger="state")
    client.connect()
    client.reach("running")
    count = len(client.efforts)
    process.send_signal(number)
    client.wait(lambda: len(client.efforts) > count, "no last torques")
    assert process.wait(TIMEOUT) == 0
    assert (client.efforts[-1] == [0.0, 0.0]) == (policy == "zero")


def test_a_second_signal_ends_the_node_at_once(client, nodes):
    """While it waits for the arrival of its last command, here for a minute."""
    change = "import time; law_node.LawNode.wait_for_efforts = lambda self: time.sleep(60)"
    process = nodes.begin(program=node_with(change), state_timeout=TIMEOUT)
    client.connect()
    client.reach("stopped")
    process.send_signal(signal.SIGTERM)
    client.spin(1.0)
    assert process.poll() is None
    before = time.monotonic()
    process.send_signal(signal.SIGTERM)
    assert process.wait(TIMEOUT) == -signal.SIGTERM
    assert time.monotonic() - before < 30.0


def test_a_node_whose_callback_fails_sends_the_torques_of_its_policy(client, nodes, package):
    """The law's function raises an error at its thirtieth call."""
    program = (
        f"import sys; from {NAME} import c_law; from {NAME}.law_node import main\n"
        "step, calls = c_law.CLaw.step, []\n"
        "def failing(self, *args):\n"
        "    calls.append(1)\n"
        "    if len(calls) == 30: raise ZeroDivisionError('an error of the test')\n"
        "    return step(self, *args)\n"
        "c_law.CLaw.step = failing\n"
        "sys.exit(main())"
    )
    process = nodes.begin(program=["-c", program], on_fault="hold", start_automatically="true")
    client.connect()
    client.drive(lambda: process.poll() is not None, "the process goes on")
    assert process.returncode == 1
    assert "an error of the test" in process.stderr.read()
    client.spin(0.2)
    balance = load_law(package.modules / NAME).balance(INSIDE)
    np.testing.assert_allclose(client.efforts[-1], balance)
    assert len(client.efforts) >= 30
    assert np.abs(client.efforts[-2]).max() > 0


REFUSED = {
    "another period": ({"period": 0.02}, "period: got 0.02, expected the exported period 0.01 s"),
    "too few joints": ({"joints": "[joint_1]"}, "joints: got ['joint_1'], expected 2 different"),
    "a limit above the export": ({"torque_limits": "[41.0, 1.0]"}, "at most [40.0, 15.0] N m"),
    "integers": ({"torque_limits": "[10, 1]"}, "decimal point"),
    "a policy": ({"on_fault": "brake"}, "on_fault: got brake, expected one of ['hold', 'zero']"),
    "a negative stiffness": ({"hold_stiffness": "[-1.0, 1.0]"}, "hold_stiffness: got [-1.0"),
    "an infinite wait with the trigger state": (
        {"arrival_timeout": ".inf", "trigger": "state"},
        "arrival_timeout: got inf, expected a time > 0 and at most 3600 s. The default is 0.5 s.",
    ),
    "a gain": ({"controller.K2": "[9.0, 2.0]"}, "controller.K2: got 9, expected a number from 1"),
}


def test_joints_of_a_named_model_keep_their_names(nodes, package, tmp_path):
    """The driver's names have to be those of the exported law, in its order."""
    shutil.copytree(package.modules / NAME, tmp_path / NAME)
    description = json.loads((tmp_path / NAME / "law.json").read_text())
    (tmp_path / NAME / "law.json").write_text(json.dumps(description | {"has_joint_names": True}))
    nodes.environment["PYTHONPATH"] = str(tmp_path)
    for joints in ("[joint_2, joint_1]", "[shoulder, elbow]"):
        process = nodes.begin(joints=joints)
        _, errors = process.communicate(timeout=TIMEOUT)
        assert process.returncode == 2
        assert "expected the joints of the exported law, ['joint_1', 'joint_2']" in errors


@pytest.mark.parametrize("name", REFUSED)
def test_a_node_with_bad_parameters_does_not_start(nodes, name):
    parameters, words = REFUSED[name]
    process = nodes.begin(**parameters)
    _, errors = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 2
    assert words in errors
