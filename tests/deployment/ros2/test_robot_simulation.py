"""A simulated robot without ROS: equal to `cosimulate` where the law answers at once."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.deployment.control_law import SampleInputs, sample, start
from iblf_jax.simulation.scenario import canonical

mujoco = pytest.importorskip("mujoco", reason='needs the extra "robots"')
from iblf_jax.deployment.mujoco_plant import MujocoPlant
from iblf_jax.deployment.ros2.robot_model import plant_of
from iblf_jax.deployment.ros2.robot_motion import RobotMotion, recorded
from iblf_jax.deployment.ros2.robot_simulation import RobotSimulation

ARM = ROOT / "examples" / "two_link.xml"
JOINTS = ("shoulder", "elbow")
PERIOD, DT = 2e-3, 5e-4
PAPER = ij.with_parts(
    ij.with_parameters(ij.presets.zhang_yan_2024(), {"controller.K2": 6.0, "observer.kf": 6.0}),
    disturbance=ij.disturbances.Nothing(),
    sampling=ij.Sampling(PERIOD),
)
VELOCITY = ij.sensors.FilteredDifference(cutoff=400.0)
NOISY = ij.with_parts(
    PAPER,
    sampling=ij.Sampling(PERIOD, delay=2.7e-3),
    sensor=ij.sensors.Encoder(counts=65536, noise=1e-5, velocity=VELOCITY),
)


def robot(q=(0.8, 0.8), *, payload=None, **options) -> RobotSimulation:
    plant = MujocoPlant(ARM, JOINTS, 2, {}, "RK4", payload)
    settings = {"period": PERIOD, "dt": DT, "sensor": ij.sensors.Ideal(), "delay": 0.0}
    settings |= {"effort_timeout": 0.1, "brake": "start", "seed": 0}
    return RobotSimulation(plant, np.array(q), np.zeros(2), **(settings | options))


def motion_of(simulation: RobotSimulation) -> RobotMotion:
    simulation.finish()
    samples = simulation.samples
    known = {"joints": JOINTS, "period": PERIOD, "dt": DT, "origin": 0.0, "ended": 0.0}
    known |= {name: np.zeros(len(samples)) for name in ("latency", "lateness")}
    known |= {"published": np.ones(len(samples), bool), "diverged": simulation.diverged}
    known["effort_t"] = np.array(simulation.efforts.times) - simulation.efforts.delay
    known["counts"] = {"expired efforts": simulation.timeouts}
    return recorded(simulation.robot, simulation.rows, samples, **known)


law = jax.jit(sample)


def closed_with_law(simulation: RobotSimulation, scenario, periods: int) -> RobotMotion:
    """The motion of a robot whose every reading the law answers at once, as a node would."""
    scenario, state = canonical(scenario), None
    for k in range(periods + 1):
        reading = simulation.measure()
        inputs = SampleInputs(*(jnp.asarray(x) for x in (reading.t, reading.q, reading.dq)))
        if state is None:
            state = start(scenario, inputs)[0]
        state, outputs = law(scenario, inputs, state)
        simulation.receive(reading.t, np.asarray(outputs.tau))
        if k < periods:
            simulation.advance()
    return motion_of(simulation)


@pytest.mark.slow
@pytest.mark.parametrize("scenario", [PAPER, NOISY], ids=["exact", "noise and delay"])
def test_a_robot_answered_at_once_moves_as_in_cosimulate(scenario):
    simulation = robot(sensor=scenario.sensor, delay=float(scenario.sampling.delay), seed=3)
    motion = closed_with_law(simulation, scenario, periods=100)
    run = ij.cosimulate(scenario, ARM, duration=0.2, dt=DT, seed=3)
    np.testing.assert_allclose(motion.q[motion.instant], run.q, atol=1e-9)
    rollout = motion.rollout(scenario)
    for name in ("q", "dq", "alpha", "disturbance_estimate", "t"):
        left, right = getattr(rollout, name), getattr(run, name)
        np.testing.assert_allclose(left, right, atol=2e-7, err_msg=name)
    # The brake, and not a torque, holds the robot until the first effort acts.
    acts = np.asarray(run.t) > scenario.sampling.delay
    for name in ("tau", "disturbance", "V"):
        left, right = getattr(rollout, name)[acts], getattr(run, name)[acts]
        np.testing.assert_allclose(left, right, atol=2e-7, err_msg=name)
    if scenario is PAPER:
        for name, value in run.metrics.items():
            left = rollout.metrics[name]
            np.testing.assert_allclose(left, value, rtol=1e-6, atol=1e-6, err_msg=name)
    assert int(rollout.status) == int(run.status)


@pytest.mark.slow
def test_a_motion_survives_its_file(tmp_path):
    motion = closed_with_law(robot(), PAPER, periods=5)
    last = robot()
    last.is_recording = False
    np.testing.assert_array_equal(closed_with_law(last, PAPER, 5).q, motion.q[-1:])
    assert len(last.rows) == len(last.samples) == 1
    motion.save(tmp_path / "motion.npz")
    loaded = ij.load(tmp_path / "motion.npz")
    assert loaded.joints == JOINTS and loaded.counts == motion.counts
    assert loaded.timing() == pytest.approx(motion.timing(), nan_ok=True)
    np.testing.assert_array_equal(loaded.rollout(PAPER).V, motion.rollout(PAPER).V)


def test_the_timing_of_a_motion_is_that_of_its_messages():
    motion = closed_with_law(robot(), PAPER, periods=5)
    latency = np.array([0.5, 0.7, np.nan, 0.5, 0.9, np.nan]) * 1e-3
    lateness = np.array([0.0, 0.1, 0.0, 0.0, 0.3, 0.0]) * 1e-3
    # Five periods from the first to the last effort, one of them without an effort.
    arrivals = np.array([0.5, 2.8, 6.5, 9.2, 10.6]) * 1e-3
    changes = {"latency": latency, "lateness": lateness, "effort_t": arrivals}
    timing = dataclasses.replace(motion, **changes).timing()
    expected = {"missed": 0.2, "gap": 3.7e-3, "latency, longest": 0.9e-3}
    expected |= {"lateness, longest": 0.3e-3, "jitter, median": 0.65e-3}
    assert {name: timing[name] for name in expected} == pytest.approx(expected)


def test_without_efforts_the_brake_holds_and_without_brake_the_torque_is_zero():
    model = mujoco.MjModel.from_xml_path(str(ARM))
    model.opt.timestep, model.opt.integrator = DT, mujoco.mjtIntegrator.mjINT_RK4
    data = mujoco.MjData(model)
    data.qpos[:] = 0.8
    mujoco.mj_step(model, data, nstep=round(10 * PERIOD / DT))
    held, free = robot(brake="start"), robot(brake="never")
    for _ in range(10):
        held.measure()
        held.advance()
        free.advance()
    np.testing.assert_array_equal(held.robot.q, [0.8, 0.8])
    np.testing.assert_allclose(free.robot.q, data.qpos, atol=1e-12)
    assert np.max(np.abs(free.robot.q - 0.8)) > 1e-3
    np.testing.assert_array_equal(motion_of(held).ddq, 0.0)


def test_an_effort_acts_from_its_arrival_for_the_effort_timeout_and_then_no_torque_or_the_brake():
    simulation = robot(effort_timeout=0.0137)
    simulation.measure()
    simulation.receive(0.0, np.array([20.0, 5.0]))
    for _ in range(10):
        simulation.advance()
    motion = motion_of(simulation)
    acts = motion.tau[:, 0] != 0
    assert motion.t[acts][-1] == pytest.approx(0.0137, abs=1e-9)
    np.testing.assert_array_equal(motion.tau[motion.t > 0.0137 + 1e-9], 0.0)
    assert motion.counts["expired efforts"] == 1
    simulation = robot()
    simulation.measure()
    simulation.receive(0.0, np.array([20.0, 5.0]))
    simulation.receive(1.3e-3, np.array([-3.0, 1.0]))
    simulation.advance()
    motion = motion_of(simulation)
    before, after = motion.t < 1.3e-3 - 1e-9, motion.t > 1.3e-3 + 1e-9
    np.testing.assert_array_equal(motion.tau[before], [[20.0, 5.0]] * before.sum())
    np.testing.assert_array_equal(motion.tau[after], [[-3.0, 1.0]] * after.sum())
    simulation = robot(effort_timeout=0.01, brake="always")
    simulation.measure()
    simulation.receive(0.0, np.array([20.0, 5.0]))
    simulation.receive(0.03, np.array([20.0, 5.0]))
    for _ in range(20):
        simulation.advance()
    motion = motion_of(simulation)
    stopped = (motion.t > 0.01 + 1e-9) & (motion.t < 0.03 - 1e-9)
    assert stopped.sum() > 30
    np.testing.assert_array_equal(np.ptp(motion.q[stopped], axis=0), 0.0)
    np.testing.assert_array_equal(motion.dq[stopped], 0.0)
    np.testing.assert_array_equal(motion.ddq[stopped], 0.0)
    assert np.all(motion.q[stopped][0] != 0.8)
    assert np.max(np.abs(motion.dq[motion.t > 0.031])) > 1e-3


@pytest.mark.slow
def test_a_payload_changes_the_motion_as_that_of_the_plant_does_and_a_file_may_be_needed():
    length = float(PAPER.plant.length[1])
    loaded = robot(payload=ij.robots.Payload(mass=0.3, centre=[length, 0.0, 0.0]))
    motion = closed_with_law(loaded, PAPER, periods=100)
    run = ij.simulate(ij.with_parameters(PAPER, {"plant.payload": 0.3}), duration=0.2, dt=DT)
    np.testing.assert_allclose(motion.q[motion.instant], run.q, atol=1e-7)
    assert np.max(np.abs(np.asarray(ij.simulate(PAPER, duration=0.2, dt=DT).q - run.q))) > 1e-3
    assert_refused(r"plant: got 'Arm'.*--plant", plant_of, ij.presets.ur5(), None, None)


def test_a_payload_that_mujoco_does_not_have_is_refused_and_joints_have_the_names_of_a_file():
    compiled = mujoco.MjModel.from_xml_path(str(ARM))
    for model, payload, words in (
        (ARM, 0.3, "payload: got 0.3, expected an iblf_jax.robots.Payload"),
        (ARM, ij.robots.Payload(mass=0.3, start=1.0), "payload.start: got"),
        (compiled, ij.robots.Payload(mass=0.3), r"payload: got .* Give the file or an MjSpec"),
    ):
        assert_refused(words, MujocoPlant, model, JOINTS, 2, {}, "RK4", payload)
    assert plant_of(PLAIN, ARM, None) == (ARM, ("shoulder", "elbow"))
    assert plant_of(PLAIN, ARM, ["elbow", "shoulder"]) == (ARM, ("elbow", "shoulder"))
    assert_refused(r"joints: got .*--joints", plant_of, PLAIN, ARM, ["elbow"])


PLAIN = ij.with_parts(ij.presets.zhang_yan_2024(), sampling=ij.Sampling(1e-3))
NUMBERS = {"mass": [2.0, 0.8], "length": [0.4, 0.3], "centre": [0.2, 0.1], "inertia": [0.05, 0.01]}
CHAIN = ij.with_parts(PLAIN, robot=ij.robots.PlanarChain(**NUMBERS))


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "payload"), [(PLAIN, 0.4), (CHAIN, 0.0)])
def test_a_planar_arm_moves_in_mujoco_as_in_simulate(scenario, payload):
    scenario = ij.with_parameters(scenario, {"plant.payload": payload})
    plant, joints = plant_of(scenario, None, None)
    assert joints == ("joint_1", "joint_2")
    run = ij.simulate(scenario, duration=0.2, dt=1e-3)
    other = ij.cosimulate(scenario, plant, duration=0.2, dt=1e-3)
    np.testing.assert_allclose(other.q, run.q, atol=1e-8)
    np.testing.assert_allclose(other.disturbance, run.disturbance, atol=1e-7)
    if payload:  # of which the law does not know
        light = ij.simulate(PLAIN, duration=0.2, dt=1e-3)
        assert np.max(np.abs(np.asarray(light.q - run.q))) > 1e-3
