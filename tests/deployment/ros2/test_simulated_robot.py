"""The simulated robot as a node, with a law of its own on the other side of ROS 2."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from ros_package import take_domain

import iblf_jax as ij

mujoco = pytest.importorskip("mujoco", reason='needs the extra "robots"')
rclpy = pytest.importorskip("rclpy", reason='needs the extra "ros" (Python 3.11)')
from pd_law import torque

take_domain()

ARM = ROOT / "examples" / "two_link.xml"
LAW = Path(__file__).with_name("pd_law.py")
JOINTS = ["shoulder", "elbow"]
PERIOD, DT = 2e-3, 5e-4
START = ij.Initial(q=[0.4, 0.7])


@contextmanager
def pd_law(*arguments: str, program: tuple[str, ...] = (str(LAW),)):
    """The proportional-derivative law in a process of its own."""
    process = subprocess.Popen([sys.executable, *program, *arguments], stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.kill()
        process.wait()


def robot(**options):
    settings = {"period": PERIOD, "dt": DT, "initial": START} | options
    return ij.deployment.robot_node(ARM, JOINTS, **settings)


def expected(periods: int, *, answered=None, origin=0.0) -> np.ndarray:
    """Positions at the time steps, by MuJoCo and the formula of the law alone."""
    model = mujoco.MjModel.from_xml_path(str(ARM))
    model.opt.timestep, model.opt.integrator = DT, mujoco.mjtIntegrator.mjINT_RK4
    data = mujoco.MjData(model)
    data.qpos[:] = START.q
    positions = [data.qpos.copy()]
    for k in range(periods):
        if answered is None or answered[k]:
            data.qfrc_applied[:] = torque(origin + k * PERIOD, data.qpos, data.qvel)
        for _ in range(round(PERIOD / DT)):
            mujoco.mj_step(model, data)
            positions.append(data.qpos.copy())
    return np.array(positions)


def test_in_lock_step_the_motion_is_that_of_mujoco_with_the_law():
    """With topics of other names."""
    names = ["--ros-args", "-r", "joint_states:=/arm/joint_states", "-r", "efforts:=/arm/efforts"]
    with pd_law(*names), robot(ros_args=names) as node:
        motion = node.run(0.5)
        with pytest.raises(ValueError, match=r"robot: got .*Make a new one"):
            node.run(0.01)
    np.testing.assert_allclose(motion.q[motion.instant], expected(250), atol=1e-9)
    assert motion.origin == 0.0
    assert motion.missed_share == 0.0
    assert len(motion.state_t) == 251


def test_lost_states_leave_the_last_effort_and_their_pattern_is_fixed_by_the_seed():
    lost = []
    for _ in range(2):
        with pd_law(), robot(state_dropout=0.3, seed=5) as node:
            motion = node.run(0.2)
        lost.append(~motion.published)
        wanted = expected(100, answered=motion.published)
        np.testing.assert_allclose(motion.q[motion.instant], wanted, atol=1e-9)
    np.testing.assert_array_equal(lost[0], lost[1])
    assert 15 < lost[0].sum() < 45
    assert not lost[0][0]


def test_lost_efforts_are_counted_and_leave_the_last_one():
    with pd_law(), robot(effort_dropout=0.3, seed=1) as node:
        motion = node.run(0.2)
    assert 15 < motion.counts["dropped efforts"] < 45
    changes = np.any(np.diff(motion.tau[motion.instant], axis=0) != 0, axis=1)
    assert changes.sum() == 100 - motion.counts["dropped efforts"]


def test_efforts_of_a_wrong_length_or_not_finite_are_refused_with_a_message(capfd):
    with pd_law("--wrong-length"), robot() as node:
        motion = node.run(0.1)
    np.testing.assert_allclose(motion.q[motion.instant], expected(50), atol=1e-9)
    assert motion.counts["refused efforts"] == 3
    words = "efforts: got [1000.0], expected 2 finite numbers, one for each of shoulder, elbow"
    assert words in capfd.readouterr().err


def test_a_law_that_ends_is_replaced_by_another_which_continues():
    first_and_second = "import os, subprocess, sys; law = [sys.executable, sys.argv[1]]; "
    first_and_second += "subprocess.run([*law, '--samples', '40']); os.execv(law[0], law)"
    with robot() as node, pd_law(str(LAW), program=("-c", first_and_second)):
        motion = node.run(0.2)
    np.testing.assert_allclose(motion.q[motion.instant], expected(100), atol=1e-9)


def test_in_real_time_the_stamps_are_the_wall_clock_and_the_run_takes_its_time():
    before = time.time()
    with pd_law(), robot(real_time=True) as node:
        motion = node.run(1.0)
    after = time.time()
    assert before < motion.origin < after - 1.0
    assert motion.state_t[-1] == pytest.approx(1.0)
    assert len(motion.state_t) + motion.counts["skipped states"] == 501
    timing = motion.timing()
    assert 0.0 < timing["latency, median"] < 0.1
    assert np.all(motion.lateness >= 0.0)
    # Before the first effort the robot stands still; then the torque is that of the law.
    assert np.all(motion.q[motion.t == 0.0] == np.asarray(START.q))
    assert np.all(np.isfinite(motion.tau))
    wanted = expected(500, origin=motion.origin)[-1]
    np.testing.assert_allclose(motion.q[-1], wanted, atol=0.1)


def test_without_a_law_the_run_ends_with_an_error_that_names_the_remedy():
    for real_time in (False, True):
        with (
            robot(real_time=real_time) as node,
            pytest.raises(TimeoutError, match=r"joint_states.* and `efforts`"),
        ):
            node.run(0.1, patience=0.3)
    # Torques of zero do not release the brake.
    with pd_law("--zero"), robot() as node, pytest.raises(TimeoutError, match="~/start"):
        node.run(0.1, patience=8.0)


def test_bad_arguments_name_the_field():
    for options, words in (
        ({"dt": 3e-4}, r"dt: got 0.0003, expected a step that divides the period.*Take dt=0.00028"),
        ({"period": -1.0}, "period: got -1.0"),
        ({"state_dropout": 1.5}, "state_dropout: got 1.5, expected a number from 0 to 1"),
        ({"effort_dropout": float("nan")}, "effort_dropout: got nan"),
        ({"initial": [0.1, 0.2]}, "initial: got .* expected an ij.Initial"),
        ({"initial": ij.Initial(q=[0.1, 0.2, 0.3])}, r"initial.q: got .*\(3,\)"),
        ({"integrator": "rk4"}, "integrator"),
        ({"effort_timeout": 0.0}, "effort_timeout: got 0.0"),
        ({"payload": 1.0}, "payload: got 1.0"),
        ({"brake": True}, "brake: got True, expected"),
    ):
        with pytest.raises(ValueError, match=words):
            robot(**options)
    with pytest.raises(ValueError, match="wrist"):
        ij.deployment.robot_node(ARM, ["shoulder", "wrist"], period=PERIOD)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_ends_cleanly_on_a_signal(number, tmp_path):
    command = [sys.executable, "-m", "iblf_jax", "ros", "robot", "zhang_yan_2024"]
    command += ["--plant", str(ARM), "--joints", *JOINTS, "--period", str(PERIOD), "--real-time"]
    command += ["--out", str(tmp_path)]
    with pd_law():
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        line = process.stdout.readline()
        assert line.startswith("in motion, t = 0 at "), line
        time.sleep(0.5)
        process.send_signal(number)
        output, _ = process.communicate(timeout=30)
    assert process.returncode == 0, output
    assert "latency" in output
    assert (tmp_path / "motion.npz").exists()
