"""A recording of the law node and the simulated robot: what it holds is their true motion."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from ros_package import take_domain

import iblf_jax as ij

pytest.importorskip("mujoco", reason='needs the extra "robots"')
pytest.importorskip("rclpy", reason='needs the extra "ros" (Python 3.11)')
pytest.importorskip("rosbags", reason='needs the extra "ros"')
from iblf_jax.deployment.ros2.demo import demonstrate

take_domain()
HERE = Path(__file__).parent
PERIOD = 2e-3


@pytest.fixture
def recorder(tmp_path):
    """A process that records into the folder `bag`."""
    command = [sys.executable, str(HERE / "bag_recorder.py"), str(tmp_path / "bag")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline().strip() == "ready"
        yield process
        process.kill()


@pytest.mark.slow
def test_a_recording_of_the_demo_is_the_motion_of_the_robot(recorder, tmp_path):
    """The recorder may find the nodes late; what it has received is complete."""
    scenario = ij.with_parts(ij.presets.zhang_yan_2024(), sampling=ij.Sampling(PERIOD))
    (tmp_path / "demo").mkdir()
    found = demonstrate(scenario, tmp_path / "demo", period=PERIOD, duration=3.0)
    recorder.terminate()
    assert recorder.wait(timeout=60) == 0
    motion = found.motion
    options = {"joints": motion.joints, "time_origin": motion.origin}
    log = ij.deployment.bag_log(tmp_path / "bag", scenario, **options)
    assert len(log["t"]) > 100
    states = np.round((log["t"] - motion.state_t[0]) / PERIOD).astype(int)
    np.testing.assert_array_equal(log["q"], motion.measured_q[states])
    np.testing.assert_array_equal(log["dq"], motion.measured_dq[states])
    # The torque that acts from a state on is the answer to it: the robot waits for it.
    rows = np.searchsorted(motion.t, log["t"][:-1] + 1e-6)
    wrong = np.any(log["tau"][:-1] != motion.tau[rows], axis=1)
    # A busy computer exchanges messages, of which not all are assigned as they were.
    assert np.mean(wrong) < 0.1
    run = ij.deployment.read_bag(tmp_path / "bag", scenario, **options)
    known = np.asarray(found.rollout.alpha)
    places = np.searchsorted(np.asarray(found.rollout.t), np.asarray(run.t) - 1e-6)
    np.testing.assert_allclose(run.alpha, known[places], atol=1e-9)
    assert int(run.status) == int(found.rollout.status)
