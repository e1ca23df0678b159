"""The demonstration without ROS: its commands, its processes, and what it prints."""

import math
import sys
import time
from types import SimpleNamespace

import numpy as np
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.deployment.ros2 import demo

LOOP = ij.with_parts(ij.presets.zhang_yan_2024(), sampling=ij.Sampling(2e-3))


def test_commands_have_the_options_that_are_given(tmp_path):
    law = demo.law_command(tmp_path, "some_law", ["a", "b"], trigger="timer")
    assert "from some_law.law_node import main" in law[2] and str(tmp_path) in law[2]
    words = ["-p", 'joints:=["a", "b"]', "-p", "start_automatically:=true", "-p", "trigger:=timer"]
    parameters = tmp_path / "config" / "some_law.yaml"
    assert law[3:] == ["--ros-args", "--params-file", str(parameters), *words]
    payload = ij.robots.Payload(0.5, centre=[0.1, 0.0, 0.2])
    options = {"delay": 1e-3, "payload": payload, "seed": None, "initial": LOOP.initial}
    robot = demo.robot_command(LOOP, "arm.xml", ("a", "b"), 0.4, tmp_path, True, options)
    expected = f"-m iblf_jax ros robot {tmp_path}/scenario.toml --plant arm.xml --joints a b"
    expected += f" --period 0.002 --duration 0.4 --out {tmp_path} --real-time --delay=0.001"
    assert robot[1:] == [*expected.split(), "--payload=0.5,0.1,0.0,0.2" + 6 * ",0.0"]
    assert (tmp_path / "scenario.toml").exists()
    own = demo.without_parts_of_the_robot(LOOP)
    assert isinstance(own.disturbance, ij.disturbances.Nothing) and own.sampling == LOOP.sampling
    assert demo.priority_command(None) == [] and demo.priority_command(99) == ["chrt", "-f", "99"]
    assert_refused("priority: got 100", demo.priority_command, 100)


def test_a_node_that_ends_is_reported_and_one_that_runs_is_stopped(tmp_path):
    listener = object.__new__(demo.DiagnosticsListener)
    listener._executor = SimpleNamespace(spin_once=lambda timeout_sec: time.sleep(0.01))
    header = SimpleNamespace(stamp=SimpleNamespace(sec=2, nanosec=500_000_000))
    status = SimpleNamespace(values=[SimpleNamespace(key="mode", value="running")])
    listener.history = []
    listener._keep(SimpleNamespace(header=header, status=[status]))
    assert listener.history == [(2.5, {"mode": "running"})]
    assert listener.last_before(2.5) == {} and listener.last_before(2.6) == {"mode": "running"}

    def node(name: str, code: str) -> demo.ProcessOfNode:
        return demo.ProcessOfNode([sys.executable, "-c", code], tmp_path / name)

    ends = "print(*range(20), sep='\\n'); raise SystemExit(3)"
    with node("law", "import time; time.sleep(60)") as law, node("robot", ends) as robot:
        words = "the robot node ended: 12 13 14 15 16 17 18 19"
        assert_refused(words, listener.listen, robot, law, 60.0, error=ChildProcessError)
        assert_refused("the law node ended", listener.listen, law, robot, 60.0, error=OSError)
        words = "did not end within 0.05 s"
        assert_refused(words, listener.listen, law, law, 0.05, error=TimeoutError)
        assert not law.has_ended()
    assert law.has_ended() and law.stop() != 0 and robot.stop() == 3


def test_a_demonstration_prints_its_distance_and_faults():
    q = np.array([[0.0, 1.0], [9.0, 9.0], [0.5, 1.5], [0.6, 1.7]])
    instant = np.array([True, False, True, True])
    motion = SimpleNamespace(q=q, instant=instant, dt=1e-3)
    there = SimpleNamespace(q=[[0.0, 1.0], [0.5, 1.25]], dt=1e-3)
    run = SimpleNamespace(metrics=SimpleNamespace(rmse=[0.1, 0.2]), ok=True)
    diagnostics = {"mode": "fault", "last_fault": "stale state"}
    found = demo.Demonstration(run, motion, there, diagnostics, ("run.png",))
    assert found.distance == 0.25 and found.ok
    assert repr(found).splitlines()[1:5] == [
        "rmse: [0.1 0.2] rad",
        "distance from cosimulate: 0.25 rad",
        "law, mode: fault",
        "law, last_fault: stale state",
    ]
    assert "too slow" in repr(found) and repr(found).endswith("written: run.png")
    there.dt = 2e-3
    assert math.isnan(found.distance)
