"""Recordings of a robot under ROS 2: what a log and a run of them hold, and recordings that are
wrong.

The recordings are written by the writer of `rosbags`; two messages were serialised by rclpy.
"""

import re
import shutil
import sqlite3
import sys
import warnings

import bag_files
import numpy as np
import pytest
from bag_files import effort_message, messages_of, state_message, string_message, write_bag
from conftest import ROOT
from refused import assert_refused
from rosbags.rosbag2 import Writer

import iblf_jax as ij
from iblf_jax import cli
from iblf_jax.identification.bag import held_efforts
from iblf_jax.identification.log import read

ORIGIN = 1_700_000_000_123_456_789
NAMES = ("shoulder", "elbow")
PERIOD = 2e-3
FROM_RCLPY = {
    "state": (
        "0001000000f1536515cd5b07050000006261736500766434030000000200000062005a63080000006772697070"
        "657200020000006100660603000000000000000000d03f0000000000002240000000000000f8bf03000000647b"
        "6551000000000000e03f0000000000000000000000000000004003000000654919000000000000000840000000"
        "000000000000000000000010c0"
    ),
    "effort": "0001000000000000000000000200000064735f3a000000000000f43f00000000000004c0",
}
"""A joint state of the joints b, gripper and a, and an effort, serialised by rclpy 9.1."""


@pytest.fixture(scope="module")
def scenario():
    """The paper's arm, whose law runs every 2 ms with an encoder."""
    parts = {"controller": ij.controllers.Backstepping(k1=2.0, K2=10.0, o=0.1)}
    return ij.with_parts(ij.presets.zhang_yan_2024(), sampling=ij.Sampling(PERIOD), **parts)


@pytest.fixture(scope="module")
def motion():
    """t, q, dq and tau of 0.4 s at 500 Hz; any numbers."""
    return PERIOD * np.arange(200), *np.random.default_rng(0).normal(size=(3, 200, 2))


@pytest.fixture(scope="module")
def bag(motion, tmp_path_factory):
    """A recording of the positions and efforts, which no test changes."""
    t, q, _, tau = motion
    return recorded(tmp_path_factory.mktemp("motion") / "bag", (t, q, None, tau))


def recorded(folder, signals, storage="sqlite3", **options):
    """A recording of t, q, dq (or None) and tau."""
    t, q, dq, tau = signals
    return write_bag(folder, messages_of(t, NAMES, q, tau, dq, **options), storage)


def read_log(folder, scenario, **options):
    return ij.deployment.bag_log(folder, scenario, **({"joints": NAMES} | options))


def signals_of(run):
    """t, q, dq and tau of a run, as its robot reports them."""
    return [np.asarray(x) for x in (run.t, run.measured.q, run.measured.dq, run.tau)]


@pytest.mark.parametrize("storage", bag_files.STORAGES)
def test_a_recording_is_a_log(storage, scenario, motion, tmp_path):
    t, q, dq, tau = motion
    messages = messages_of(t, NAMES, q, tau, dq, origin=ORIGIN)
    messages.append(("/rosout", ORIGIN, string_message("a topic that is not read")))
    folder = write_bag(tmp_path / "bag", messages, storage)
    if storage == "sqlite3":
        (folder,) = (path for path in folder.iterdir() if path.suffix != ".yaml")
    log = read_log(folder, scenario)
    assert set(log) == {"t", "q", "dq", "tau"}
    np.testing.assert_allclose(log["t"], t, atol=1e-9)
    for name, values in (("q", q), ("dq", dq), ("tau", tau)):
        np.testing.assert_array_equal(log[name], values)


def test_joints_are_found_by_their_names_or_their_order(scenario, bag, motion, tmp_path):
    """The order differs between the messages, other joints are in them, and another robot publishes
    on the same topic.  An exported node has names for a robot without any."""
    t, q, dq, tau = motion
    messages = []
    for k, (topic, received, message) in enumerate(messages_of(t, NAMES, q, tau, dq)):
        if topic == "/joint_states":
            order = [("elbow", "gripper", "shoulder"), NAMES][k % 4 // 2]
            row = {"gripper": 9.0} | dict(zip(NAMES, q[k // 2], strict=True))
            rate = {"gripper": 9.0} | dict(zip(NAMES, dq[k // 2], strict=True))
            stamp = round(t[k // 2] * 1e9)
            values = ([x[name] for name in order] for x in (row, rate))
            message = state_message(stamp, order, *values)
            messages.append((topic, received + 1, state_message(stamp, ("wheel",), [1.0])))
        messages.append((topic, received, message))
    log = read_log(write_bag(tmp_path / "bag", messages), scenario)
    for name, values in (("q", q), ("dq", dq), ("tau", tau)):
        np.testing.assert_array_equal(log[name], values)
    with pytest.warns(UserWarning, match="order of the first message: shoulder, elbow"):
        (log,) = read(bag, 2)
    np.testing.assert_array_equal(log.q, q)
    assert log.dq is None
    # The names that an exported node has for such a robot.
    folder = write_bag(tmp_path / "numbered", messages_of(t, ("joint_2", "joint_1"), q, tau))
    (numbered,) = read(folder, 2)
    np.testing.assert_array_equal(numbered.q, q[:, ::-1])
    (swapped,) = read(bag, 2, joints=("elbow", "shoulder"))
    np.testing.assert_array_equal(swapped.q, q[:, ::-1])


def test_an_effort_belongs_to_the_joint_state_that_it_answers():
    """Receive times in units of the period; None where the effort is unknown."""
    cases = [
        # a latency of 0.3 periods, and one of 1.3 periods
        ([0, 1, 2, 3], [0.3, 1.3, 2.3, 3.3], [0, 1, 2, 3]),
        ([0, 1, 2, 3], [1.3, 2.3, 3.3], [None, 0, 1, 2]),
        # joint states twice as often as efforts: the torque is constant in between
        ([0, 0.5, 1, 1.5, 2, 2.5], [0.1, 1.1, 2.1], [0, 0, 1, 1, 2, None]),
        # no effort for 5 periods, and none after 37
        (
            [*range(40)],
            [k + 0.3 for k in range(38) if not 20 <= k < 24],
            [*range(20), *[None] * 4, *range(20, 34), None, None],
        ),
        # one effort is missing: the torque before it goes on
        ([*range(5)], [0.3, 1.3, 3.3, 4.3], [0, 1, 1, 2, 3]),
        ([0, 1], [], [None, None]),
        ([0, 1], [0.3], [0, None]),
    ]
    for states, efforts, expected in cases:
        index, is_known = held_efforts(1000 * np.array(states), 1000 * np.array(efforts))
        found = [int(k) if known else None for k, known in zip(index, is_known, strict=True)]
        assert found == expected, (states, efforts)


def test_messages_that_a_recorder_exchanged_are_assigned_by_their_number():
    """A busy recorder stores messages later than they arrived, and those of one topic together."""
    rng = np.random.default_rng(1)
    count = 2000
    states = 1000.0 * np.arange(count) + rng.uniform(-50, 50, count)
    efforts = states + rng.uniform(200, 400, count)
    for k in np.flatnonzero(rng.random(count) < 0.2):
        # The answer is stored just before its joint state.
        states[k] = efforts[k] + rng.uniform(1, 30)
    index, is_known = held_efforts(np.sort(states).astype(int), np.sort(efforts).astype(int))
    np.testing.assert_array_equal(index, np.arange(count))
    assert is_known.all()
    # Five joint states, and then their answers; and the other way round.
    states, efforts = 1000 * np.arange(40), 1000 * np.arange(40) + 300
    late = 14_350 + np.arange(5)
    for a, b in ((late, late + 10), (late + 10, late)):
        states[10:15], efforts[10:15] = a, b
        index, is_known = held_efforts(states, efforts)
        np.testing.assert_array_equal(index, np.arange(40))
    # Two efforts a joint state, and one that is missing, are no exchange.
    states, efforts = 1000 * np.arange(40), 500 * np.arange(80) + 100
    index, _ = held_efforts(states, np.delete(efforts, [20, 21]))
    np.testing.assert_array_equal(index[:10], 2 * np.arange(10) + 1)
    assert index[10] == 19 and index[11] == 21


def test_gaps_of_either_topic_and_a_clock_that_jumps_back(scenario, motion, tmp_path):
    t, q, _, tau = motion
    messages = messages_of(t, NAMES, q, tau)
    lost = {"/joint_states": range(50, 60), "/efforts": range(120, 140)}
    kept = [x for x in messages if round((x[1] * 1e-9) // PERIOD) not in lost[x[0]]]
    (log,) = read(write_bag(tmp_path / "bag", kept), 2, joints=NAMES)
    rows = np.round(log.t / PERIOD).astype(int)
    ends = [(rows[s.start], rows[s.stop - 1]) for s in log.segments]
    assert ends == [(0, 49), (60, 119), (140, 199)]
    follows = np.diff(rows) == 1
    np.testing.assert_array_equal(log.tau[:-1][follows], tau[rows[:-1]][follows])
    messages = messages_of(t, NAMES, q, tau, origin=10**9)
    again = messages_of(t, NAMES, q, tau, origin=0)
    second = [(topic, received + 2 * 10**9, message) for topic, received, message in again]
    folder = write_bag(tmp_path / "clock", messages + second)
    with pytest.raises(ValueError, match=r"0.398 s and then -1 s.*duration=0.398 selects") as error:
        read_log(folder, scenario)
    duration = float(re.search(r"duration=([\d.]+)", str(error.value))[1])
    np.testing.assert_array_equal(read_log(folder, scenario, duration=duration)["q"], q[:199])


def test_times_and_a_part_are_selected(scenario, motion, tmp_path):
    t, q, _, tau = motion
    folder = recorded(tmp_path / "bag", motion, origin=ORIGIN)
    part = read_log(folder, scenario, start=0.1, duration=0.2)
    np.testing.assert_array_equal(part["q"], q[50:150])
    np.testing.assert_allclose(part["t"], t[50:150], atol=1e-9)
    later = read_log(folder, scenario, time_origin=ORIGIN * 1e-9 - 5.0)
    np.testing.assert_allclose(later["t"], t + 5.0, atol=1e-6)
    # The float of the first stamp is another instant, after which the first row would be lost.
    same = read_log(folder, scenario, time_origin=ORIGIN / 10**9)
    np.testing.assert_array_equal(same["t"], read_log(folder, scenario)["t"])
    # stamps that do not advance: the driver did not set them
    broken = messages_of(t, NAMES, q, tau)
    unset = [state_message(0, NAMES, x) for x in q]
    broken[::2] = [(*x[:2], y) for x, y in zip(broken[::2], unset, strict=True)]
    folder = write_bag(tmp_path / "zero", broken)
    assert_refused(r'stamps: got 0 s and then 0 s.*times="receive"', read_log, folder, scenario)
    np.testing.assert_allclose(read_log(folder, scenario, times="receive")["t"], t, atol=1e-9)


def test_states_that_come_twice_efforts_of_states_and_namespaces(scenario, motion, tmp_path):
    t, q, dq, tau = motion
    messages = messages_of(t, NAMES, q, tau)
    messages += [(topic, at + 9, x) for topic, at, x in messages if topic == "/joint_states"]
    log = read_log(write_bag(tmp_path / "bag", messages), scenario)
    np.testing.assert_array_equal(log["q"], q)
    np.testing.assert_array_equal(log["tau"], tau)
    stamps, values = np.round(t * 1e9), zip(q, dq, tau, strict=True)
    states = [state_message(t, NAMES, *x) for t, x in zip(stamps, values, strict=True)]
    messages = [("/joint_states", k, x) for k, x in enumerate(states)]
    folder = write_bag(tmp_path / "states", messages)
    log = read_log(folder, scenario, efforts=None)
    np.testing.assert_array_equal(log["tau"], tau)
    words = r"efforts: got no topics .*topics: /joint_states.*efforts=None"
    assert_refused(words, read_log, folder, scenario)
    messages = [(f"/left{topic}", at, x) for topic, at, x in messages_of(t, NAMES, q, tau)]
    log = read_log(write_bag(tmp_path / "one", messages), scenario)
    np.testing.assert_array_equal(log["q"], q)
    messages += [(f"/right{topic}", at, x) for topic, at, x in messages_of(t, NAMES, -q, tau)]
    folder = write_bag(tmp_path / "two", messages)
    words = r"got 2 topics .*/left/joint_states .*/right/joint_states"
    assert_refused(words, read_log, folder, scenario)
    log = read_log(folder, scenario, joint_states="right/joint_states", efforts="/right/efforts")
    np.testing.assert_array_equal(log["q"], -q)


def test_messages_that_rclpy_serialised_are_read(scenario, tmp_path):
    """A recording of 100 times the same two messages."""
    folder, raw = tmp_path / "bag", {x: bytes.fromhex(text) for x, text in FROM_RCLPY.items()}
    with Writer(folder, version=9, storage_plugin=bag_files.STORAGES["mcap"]) as writer:
        kinds = {"/joint_states": bag_files.JOINT_STATE, "/efforts": bag_files.ARRAY}
        topics = [writer.add_connection(x, y, typestore=bag_files.STORE) for x, y in kinds.items()]
        for k in range(100):
            writer.write(topics[0], 10 * k, raw["state"])
            writer.write(topics[1], 10 * k + 1, raw["effort"])
    log = ij.deployment.bag_log(folder, scenario, joints=("a", "b"), times="receive", duration=9e-7)
    np.testing.assert_array_equal(log["q"][0], [-1.5, 0.25])
    np.testing.assert_array_equal(log["dq"][0], [2.0, 0.5])
    np.testing.assert_array_equal(log["tau"][0], [1.25, -2.5])
    stamped = {"joints": ("a", "b"), "efforts": None, "time_origin": 1_700_000_000.0}
    log = ij.deployment.bag_log(folder, scenario, **stamped)
    np.testing.assert_array_equal(log["tau"], [[-4.0, 3.0]])  # the same stamp is the same state
    np.testing.assert_allclose(log["t"], [0.123456789], atol=1e-9)


@pytest.mark.slow
def test_the_latency_of_the_efforts_is_estimated(tmp_path):
    """The robot receives each effort 2 ms after the stamp of the joint state, as the recorder."""
    scenario = bag_files.example_scenario()
    late = ij.with_parts(scenario, sampling=ij.Sampling(4e-3, delay=2e-3))
    late = ij.with_parameters(late, bag_files.EXAMPLE)
    t, q, _, tau = signals_of(ij.simulate(late, duration=3.0, dt=1e-3))
    messages = messages_of(t[::4], NAMES, q[::4], [*tau[2::4], tau[-1]], latency=2_000_000)
    log = read_log(write_bag(tmp_path / "bag", messages), scenario)
    known = ij.identify(scenario, log, ["robot.mass", "disturbance.viscous"], widths=False)
    np.testing.assert_allclose(known.delay, 2e-3, atol=5e-5)
    true = np.concatenate([*bag_files.EXAMPLE.values()])
    np.testing.assert_allclose([x.value for x in known.requested_numbers], true, rtol=1e-3)


@pytest.mark.slow
def test_the_command_line_and_the_recording_of_the_examples(tmp_path, capsys):
    rows = np.loadtxt(ROOT / "examples" / "log.csv", delimiter=",", skiprows=1)
    t, q, tau = rows[:, 0], rows[:, 1:3], rows[:, 3:5]
    write_bag(tmp_path / "run_bag", messages_of(t, NAMES, q, tau, origin=ORIGIN))
    file = shutil.copy(ROOT / "examples" / "identify.toml", tmp_path)
    assert cli.main(["identify", file, "--log", str(tmp_path / "run_bag")]) == 0
    shown = capsys.readouterr()
    assert "6 of 6 numbers" in shown.out and "no joint names" in shown.err
    scenario = bag_files.example_scenario()
    log = read_log(ROOT / "examples" / "run_bag", scenario)
    again = read_log(write_bag(tmp_path / "bag", bag_files.example_messages()), scenario)
    for name in ("t", "q", "dq", "tau"):
        np.testing.assert_allclose(log[name], again[name], atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [None, "encoder"])
def test_a_recorded_run_is_the_simulated_run(sensor, scenario, tmp_path):
    """Law and observer run on the recorded readings as they ran on the robot."""
    if sensor is not None:
        velocity = ij.sensors.FilteredDifference(cutoff=200.0)
        encoder = ij.sensors.Encoder(counts=65536, velocity=velocity)
        scenario = ij.with_parts(scenario, sensor=encoder)
    run = ij.simulate(scenario, duration=1.0, dt=PERIOD)
    folder = recorded(tmp_path / "bag", signals_of(run), "mcap", origin=ORIGIN)
    found = ij.deployment.read_bag(folder, scenario, joints=NAMES)
    assert found.method == "recorded" and found.steps == run.steps
    assert int(found.status) == int(run.status)
    np.testing.assert_array_equal(found.q, run.measured.q)
    np.testing.assert_array_equal(found.tau, run.tau)
    for name in ("alpha", "disturbance_estimate"):
        np.testing.assert_allclose(getattr(found, name), getattr(run, name), atol=1e-9)
    np.testing.assert_allclose(found.lower, run.lower, atol=1e-9)
    if sensor is None:
        for name in ("rmse", "margin", "xi_margin", "iae", "peak_torque", "torque_rms", "effort"):
            np.testing.assert_allclose(found.metrics[name], run.metrics[name], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(found.metrics.estimate_rmse, run.metrics.estimate_rmse, rtol=0.1)
    assert found.plot() is not None


@pytest.mark.slow
def test_a_recorded_law_has_its_own_period_and_gaps_are_not_integrated(scenario, tmp_path):
    """Joint states at 1 kHz, the law at 500 Hz: the signals change at every second row only."""
    run = ij.simulate(scenario, duration=0.2, dt=1e-3)
    folder = recorded(tmp_path / "fast", signals_of(run))
    found = ij.deployment.read_bag(folder, scenario, joints=NAMES)
    np.testing.assert_allclose(found.alpha, run.alpha, atol=1e-9)
    np.testing.assert_allclose(found.dt, 1e-3)
    run = ij.simulate(scenario, duration=0.4, dt=PERIOD)
    t, q, dq, tau = signals_of(run)
    messages = messages_of(t, NAMES, q, tau, dq)
    kept = [x for x in messages if not 0.1e9 <= x[1] < 0.3e9]
    whole = ij.deployment.read_bag(write_bag(tmp_path / "whole", messages), scenario, joints=NAMES)
    found = ij.deployment.read_bag(write_bag(tmp_path / "bag", kept), scenario, joints=NAMES)
    e1 = np.abs(np.asarray(whole.e1))
    expected = sum(PERIOD * np.sum((x[1:] + x[:-1]) / 2, axis=0) for x in (e1[:50], e1[150:]))
    np.testing.assert_allclose(found.metrics.iae, expected, rtol=1e-6)


@pytest.mark.slow
def test_another_law_or_origin_of_time_is_reported(scenario, tmp_path):
    """The law of a recording that began 0.5 s after it has its own time.  The observer, which
    starts with the recording, forgets its start."""
    scenario = ij.with_parts(scenario, observer=ij.observers.Momentum(kf=20.0))
    run = ij.simulate(scenario, duration=1.5, dt=PERIOD)
    folder = recorded(tmp_path / "bag", [x[250:] for x in signals_of(run)], origin=10**9)
    with pytest.warns(UserWarning, match="other torques .* Give time_origin"):
        ij.deployment.read_bag(folder, scenario, joints=NAMES)
    other = ij.with_parameters(scenario, {"reference.amplitude": 0.02})
    with pytest.warns(UserWarning, match="other torques"):
        ij.deployment.read_bag(folder, other, joints=NAMES, time_origin=1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = ij.deployment.read_bag(folder, scenario, joints=NAMES, time_origin=1.0)
    np.testing.assert_allclose(found.q_d, run.q_d[250:], atol=1e-9)
    np.testing.assert_allclose(found.alpha, run.alpha[250:], atol=1e-9)


@pytest.mark.parametrize("storage", bag_files.STORAGES)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_recording_is_refused(storage, share, scenario, motion, tmp_path):
    folder = recorded(tmp_path / "bag", motion, storage)
    (path,) = (path for path in folder.iterdir() if path.suffix != ".yaml")
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    words = r"expected a complete rosbag2 recording.*ros2 bag reindex"
    assert_refused(words, read_log, folder, scenario)


def test_incomplete_and_other_paths_are_refused(scenario, motion, bag, tmp_path, monkeypatch):
    folder = shutil.copytree(bag, tmp_path / "bag")
    with sqlite3.connect(folder / "bag.db3") as database:
        database.execute("DELETE FROM messages WHERE id > 350")
    assert_refused(r"got 50 messages less than its metadata count", read_log, folder, scenario)
    # A single byte is missing at the end.
    data = (bag / "bag.db3").read_bytes()
    (folder / "bag.db3").write_bytes(data[:-1])
    words = rf"got {len(data) - 1} bytes of bag\.db3, which had {len(data)}"
    for path in (folder, folder / "bag.db3"):
        assert_refused(words, read_log, path, scenario)
    (folder / "bag.db3").write_bytes(data)
    (folder / "metadata.yaml").unlink()
    assert_refused(r"ros2 bag reindex .*, or read the file bag.db3", read_log, folder, scenario)
    np.testing.assert_array_equal(read_log(folder / "bag.db3", scenario)["q"], motion[1])
    assert_refused(r"without metadata.yaml.*\.csv or \.nc", read, tmp_path, 2)
    (tmp_path / "log.csv").write_text("t\n")
    csv = r"path: got .*log.csv.*\.db3 or \.mcap"
    for name, words in (("none", "Nothing is there"), ("log.csv", csv)):
        assert_refused(words, read_log, tmp_path / name, scenario)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert_refused(r"rosbags.*\.\[ros\]", read_log, tmp_path, scenario, error=ImportError)


def one_state(names=NAMES, q=(0.0, 0.0), dq=(), stamp=0):
    return [("/joint_states", 0, state_message(stamp, names, q, dq))]


EFFORT = [("/efforts", 1, effort_message([0.0, 0.0]))]
ONE = one_state() + EFFORT
NO_STATE = ("/joint_states", 0, string_message("x"))
NO_TYPE = "with messages std_msgs/msg/String, expected sensor_msgs/msg/JointState"
THREE = [("/efforts", 1, effort_message([0.0, 0.0, 0.0]))]
BEFORE = [("/efforts", 0, EFFORT[0][2]), ("/joint_states", 9, one_state()[0][2])]
WRONG = [
    (EFFORT, {}, r"got no topics joint_states, expected .*: /efforts \("),
    ([NO_STATE, *EFFORT], {}, f"/joint_states {NO_TYPE}"),
    (one_state(("a", "b")) + EFFORT, {}, "got joint states of a, b, expected joi"),
    (one_state(("elbow", "wrist")) + EFFORT, {}, "got the joints elbow, wrist, expected all of sh"),
    (one_state(q=(0.0,)) + EFFORT, {}, "got 1 numbers as position"),
    (one_state() + THREE, {}, "effort 0: got 3 numbers, expected 2, one for each joint"),
    (BEFORE, {}, "no joint state with an effort.*ros2 bag record"),
    (ONE, {"start": 5.0}, "no joint state in all from 5 s"),
    (EFFORT, {"joints": "ab"}, "joints: got 'ab', expected a list of 2 different names"),
    (EFFORT, {"time_origin": -1.0}, "time_origin: got -1"),
    (EFFORT, {"times": "sent"}, "times: got 'sent'"),
    (EFFORT, {"efforts": 3}, "efforts: got 3"),
]


def test_what_is_wrong_and_numbers_that_are_not_finite_are_refused(scenario, motion, tmp_path):
    for number, (messages, options, words) in enumerate(WRONG):
        folder = write_bag(tmp_path / f"bag_{number}", messages)
        assert_refused(words, read_log, folder, scenario, **options)
    t, q, _, tau = motion
    q = q.copy()
    q[7, 1] = np.nan
    folder = recorded(tmp_path / "bag", (t, q, None, tau))
    words = r"q that is not finite: got 1 of 200 rows, .* t = 0.014 s"
    assert_refused(words, read, folder, 2, joints=NAMES)
    assert_refused(r"q that is not finite", ij.deployment.read_bag, folder, scenario, joints=NAMES)
