"""A law node and a robot node as processes, and the commands that start them."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from ros_package import take_domain

import iblf_jax as ij
from iblf_jax import cli

pytest.importorskip("mujoco", reason='needs the extra "robots"')
pytest.importorskip("rclpy", reason='needs the extra "ros" (Python 3.11)')
from iblf_jax.deployment.ros2.demo import (
    DiagnosticsListener,
    ProcessOfNode,
    demonstrate,
    export_and_build,
    law_command,
)

take_domain()

PAPER = ij.with_parts(ij.presets.zhang_yan_2024(), sampling=ij.Sampling(2e-3))


def test_the_law_node_moves_the_robot_as_cosimulate_in_lock_step(tmp_path):
    found = demonstrate(PAPER, tmp_path, period=2e-3, duration=0.4)
    assert found.distance < 1e-9
    assert found.ok
    assert found.diagnostics["last_fault"] == "none"
    assert (tmp_path / "run.png").stat().st_size > 10_000
    assert "distance from cosimulate" in repr(found)


@pytest.mark.slow
def test_noise_and_delay_are_those_of_cosimulate(tmp_path):
    sensor = ij.sensors.Encoder(
        counts=65536, noise=1e-5, velocity=ij.sensors.FilteredDifference(cutoff=300.0)
    )
    slow = ij.with_parameters(PAPER, {"controller.K2": 5.0, "observer.kf": 5.0})
    scenario = ij.with_parts(slow, sensor=sensor)
    options = {"sensor": sensor, "delay": 1.3e-3, "seed": 4, "dt": 1e-3}
    found = demonstrate(scenario, tmp_path, period=2e-3, duration=0.4, **options)
    assert found.distance < 1e-9
    exact = ij.cosimulate(PAPER, tmp_path / "robot.xml", duration=0.4, dt=1e-3)
    assert np.max(np.abs(np.asarray(exact.q - found.rollout.q))) > 1e-4


@pytest.mark.slow
def test_an_arm_from_its_file_has_its_own_joints_and_limits(tmp_path):
    scenario = ij.load_scenario(ROOT / "examples" / "arm.toml")
    arm = ij.with_parameters(scenario, {"plant.payload": 0.0})
    plant = ROOT / "examples" / "arm.urdf"
    found = demonstrate(arm, tmp_path, plant=plant, period=1e-3, duration=0.3, dt=1e-3)
    assert found.motion.joints == ("turn", "lift", "bend")
    assert found.distance < 1e-9


@pytest.mark.slow
def test_the_page_runs_with_a_law_node(tmp_path):
    export_and_build(PAPER, tmp_path / "package", torque_limits=[60.0, 20.0])
    parameters = {"trigger": "timer", "state_timeout": "1.0"}
    law = law_command(tmp_path / "package", "iblf_law", ["shoulder", "elbow"], **parameters)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    page = ROOT / "docs" / "how_to" / "ros2_demo.md"
    command = [sys.executable, str(ROOT / "tests" / "run_page.py"), str(page)]
    with ProcessOfNode(law, tmp_path / "law.log") as process:
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert not process.has_ended(), process.last_lines()
    assert done.returncode == 0, done.stderr[-3000:]
    assert "latency, median" in done.stdout


@pytest.mark.slow
def test_a_law_that_does_not_start_is_reported_with_its_message(tmp_path):
    with pytest.raises(ChildProcessError, match="state_timeout"):
        demonstrate(PAPER, tmp_path, period=2e-3, duration=0.1, state_timeout=-1.0)


def test_diagnostics_are_those_before_the_end():
    with DiagnosticsListener() as listener:
        listener.history = [(1.0, {"mode": "running"}), (2.0, {"mode": "fault"})]
        assert listener.last_before(1.5) == {"mode": "running"}
        assert listener.last_before(0.5) == {}


def test_the_command_prints_accuracy_missed_periods_and_latency(tmp_path, capsys):
    words = ["ros", "demo", "--duration", "0.2", "--effort-dropout", "0.1"]
    assert cli.main([*words, "--out", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    for part in (
        "rmse",
        "distance from cosimulate",
        "missed periods",
        "latency",
        "dropped efforts",
    ):
        assert part in output, output
    assert {path.name for path in tmp_path.iterdir()} >= {"package", "motion.npz", "run.png"}


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("robot zhang_yan_2024", "--period: got None"),
        ("demo --period 0.002 --payload 1,2 --out OUT", "--payload: got '1,2'"),
        ("demo --torque-limits 60 --out OUT", "torque_limits"),
        ("robot ur5 --period 0.002", "plant: got 'Arm'"),
        ("", "required"),
    ],
)
def test_bad_words_are_named(words, expected, tmp_path, capsys):
    assert cli.main(["ros", *words.replace("OUT", str(tmp_path)).split()]) == 2
    assert expected in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_demonstration_leaves_no_process(number, tmp_path):
    command = [sys.executable, "-m", "iblf_jax", "ros", "demo", "--period", "0.002"]
    command += ["--real-time", "--duration", "60", "--state-timeout", "1", "--out", str(tmp_path)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    log = tmp_path / "robot.log"
    while not log.exists() or "in motion" not in log.read_text():
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.1)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    nodes = children.read_text().split()
    assert len(nodes) == 2
    process.send_signal(number)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "interrupted" in error
    assert not any(Path(f"/proc/{node}").exists() for node in nodes)
