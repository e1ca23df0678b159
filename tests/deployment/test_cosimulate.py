"""A law against MuJoCo's robot: equal to `simulate` where the robots are equal."""

from pathlib import Path

import jax
import numpy as np
import pytest
from arm_cases import ARMS
from refused import assert_refused

import iblf_jax as ij

mujoco = pytest.importorskip("mujoco")
from iblf_jax.deployment.film import has_shapes
from iblf_jax.deployment.mujoco_plant import MujocoPlant

TIMING = {"duration": 0.4, "dt": 5e-4}
GAINS = {"controller.K2": 4.0, "observer.kf": 4.0}
PAPER = ij.with_parameters(ij.presets.zhang_yan_2024(variant="corrected"), GAINS)
"""Slow enough for a filter and a drive in the loop."""
LIMITS = {"limit": [15.0, 5.0], "stall": [14.0, 6.0], "no_load_speed": [6.0, 8.0]}
DRIVEN = ij.with_parts(
    PAPER,
    sampling=ij.Sampling(1e-3, delay=0.7e-3),
    sensor=ij.sensors.Encoder(ij.sensors.FilteredDifference(700.0), counts=65536, noise=1e-5),
    actuator=ij.actuators.Motor(bandwidth=600.0, rate_limit=900.0, **LIMITS),
)


def two_link(robot, *, inside: str = "", elbow: str = "", outside: str = "") -> str:
    """The planar arm as an MJCF: gravity along -y, hinges about z."""
    numbers = (robot.mass, robot.length, robot.centre, robot.inertia)
    m, length, centre, inertia = map(np.asarray, numbers)
    bodies = [
        f'<inertial pos="{centre[i]} 0 0" mass="{m[i]}" diaginertia="{inertia[i]} {inertia[i]}'
        f' {inertia[i]}"/><geom type="capsule" fromto="0 0 0 {length[i]} 0 0" size="0.03"'
        ' contype="0" conaffinity="0"/>'
        for i in (0, 1)
    ]
    return f"""<mujoco><compiler angle="radian"/>
      <option timestep="0.0008" gravity="0 -{float(robot.g)} 0"/><worldbody>
      <body name="upper"><joint name="shoulder" axis="0 0 1"/>{bodies[0]}
        <body name="fore" pos="{length[0]} 0 0"><joint name="elbow" axis="0 0 1" {elbow}/>
          {bodies[1]}{inside}</body></body>
      {outside}</worldbody></mujoco>"""


def spec_of(robot, **parts):
    return mujoco.MjSpec.from_string(two_link(robot, **parts))


def largest_difference(a, b) -> float:
    return float(np.max(np.abs(np.asarray(a) - np.asarray(b))))


@pytest.mark.slow
def test_on_the_nominal_arm_it_is_simulate():
    run = ij.simulate(DRIVEN, **TIMING, seed=3)
    other = ij.cosimulate(DRIVEN, spec_of(DRIVEN.plant), **TIMING, seed=3)
    assert largest_difference(run.measured.q, other.measured.q) < 1e-9
    assert largest_difference(run.observer_state, other.observer_state) < 1e-9
    assert np.isnan(other.fastest_mode) and "numerical_error" not in other.metrics
    assert other.method == "MuJoCo RK4"
    for name in ("q", "dq", "tau", "alpha", "disturbance", "disturbance_estimate", "V", "xi"):
        assert largest_difference(getattr(run, name), getattr(other, name)) < 1e-9, name
    for name in run.metrics.keys() & other.metrics.keys():
        left, right = other.metrics[name], run.metrics[name]
        np.testing.assert_allclose(left, right, rtol=1e-9, atol=1e-9, err_msg=name)
    # A co-simulation has no estimate of its error.
    assert int(other.status) == int(run.status) & ~int(ij.Status.INACCURATE)


@pytest.mark.slow
def test_a_joint_that_touches_its_stop_a_run_that_flies_away_and_meshes_that_are_not_there():
    scenario = ij.with_parts(PAPER, sampling=ij.Sampling(1e-3))
    free = ij.cosimulate(scenario, spec_of(PAPER.plant), **TIMING)
    # The start is 0.8 and the reference leads downwards: a stop lies in the way.
    stop = 0.5 * (float(free.q[0, 1]) + float(np.min(free.q[:, 1])))
    held = ij.cosimulate(scenario, spec_of(PAPER.plant, elbow=f'range="{stop} 3"'), **TIMING)
    assert float(np.min(free.q[:, 1])) < stop - 0.05 and float(np.min(held.q[:, 1])) > stop - 0.02
    before = np.argmax(np.asarray(free.q[:, 1]) < stop) - 1
    assert largest_difference(held.q[:before], free.q[:before]) < 1e-12
    # What the law does not know of, the stop's push, is in f.
    pushed, own = (np.abs(run.disturbance[before:]).max() for run in (held, free))
    assert pushed > 2 * own
    wild = ij.with_parameters(PAPER, {"controller.K2": 2000.0})
    with pytest.warns(ij.SimulationWarning, match="ran away|not finite|bound"):
        run = ij.cosimulate(wild, spec_of(PAPER.plant), period=5e-3, **TIMING)
    assert int(run.status) & int(ij.Status.BOUND_VIOLATED)
    with pytest.raises(ij.SimulationError):
        ij.cosimulate(wild, spec_of(PAPER.plant), period=5e-3, throw=True, **TIMING)
    mesh = '<mesh filename="package://nowhere/link.stl"/>'
    shape = f"<collision><geometry>{mesh}</geometry></collision></link>"
    text = (ARMS / "ur5.urdf").read_text().replace("</link>", shape)
    scenario = ij.with_parts(ij.presets.ur5(), sampling=ij.Sampling(1e-3))
    with pytest.warns(UserWarning, match="shapes are left out"):
        MujocoPlant(_written("meshed.urdf", text), tuple(scenario.plant.joints), 6, {}, "RK4")


FINGER = """<body name="finger" pos="0.1 0 0"><joint name="grip" type="slide" axis="0 1 0"/>
  <geom size="0.01" mass="0.2"/></body>"""


@pytest.mark.slow
def test_a_locked_joint_in_a_frame_is_held_where_it_is():
    held = f"""<frame pos="0.05 0 0" euler="0 0 0.9"><frame pos="0 0.02 0" euler="0 0 0.4">
      <body name="palm" pos="0.03 0 0" euler="0 0 -0.3"><joint name="wrist" axis="0 0 1"/>
      <geom size="0.02" pos="0.1 0 0" mass="0.2"/>{FINGER}</body></frame></frame>"""
    locked = {"wrist": 0.7, "grip": 0.1}
    file = _written("arm.xml", two_link(PAPER.plant, inside=held))
    arm = ij.robots.load(file, tip="fore", locked=locked)
    scenario = ij.with_parts(PAPER, robot=arm, sampling=ij.Sampling(1e-3))
    found = ij.cosimulate(scenario, "arm.xml", locked=locked, **TIMING)
    expected = ij.simulate(scenario, **TIMING)
    assert largest_difference(found.q, expected.q) < 1e-9
    elsewhere = ij.cosimulate(scenario, "arm.xml", locked={"wrist": 0.0, "grip": 0.1}, **TIMING)
    assert largest_difference(elsewhere.q, expected.q) > 1e-5


@pytest.fixture(autouse=True)
def _in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def _written(name: str, text: str) -> str:
    Path(name).write_text(text)
    return name


DRIVES = """<tendon><fixed name="wire"><joint joint="elbow" coef="1"/></fixed></tendon><actuator>
  <position joint="elbow" kp="50"/> <position jointinparent="elbow" kp="50"/>
  <position tendon="wire" kp="50"/> <motor joint="turntable"/>
  <general site="hand" gear="0 1 0 0 0 0" biastype="affine" biasprm="5 0 0"/></actuator>"""


@pytest.mark.slow
def test_a_models_own_drives_are_off_and_a_gripper_goes_with_all_that_moves_it():
    joint = '<joint name="turntable" axis="0 0 1"/><geom size="0.1"/>'
    aside = f'<body name="table" pos="3 0 0">{joint}</body>'
    site = '<site name="hand" pos="0.2 0 0"/>'
    arm = ij.robots.load(_written("arm.xml", two_link(PAPER.plant)))
    scenario = ij.with_parts(PAPER, robot=arm)
    text = two_link(PAPER.plant, inside=site, outside=aside)
    text = text.replace("</worldbody>", f"</worldbody>{DRIVES}")
    driven = ij.cosimulate(scenario, _written("driven.xml", text), period=1e-3, **TIMING)
    plain = ij.cosimulate(scenario, "arm.xml", period=1e-3, **TIMING)
    assert largest_difference(driven.q, plain.q) < 1e-12
    text = two_link(PAPER.plant, inside=GRIPPER).replace("</worldbody>", f"</worldbody>{AROUND}")
    arm = ij.robots.load(_written("gripper.xml", text), tip="fore", locked={"l": 0.02, "r": 0.02})
    scenario = ij.with_parts(PAPER, robot=arm, sampling=ij.Sampling(1e-3))
    expected = ij.simulate(scenario, **TIMING)
    found = ij.cosimulate(scenario, "gripper.xml", locked={"l": 0.02, "r": 0.02}, **TIMING)
    assert largest_difference(found.q, expected.q) < 1e-9
    tied = text.replace('joint="r" coef="0.5"', 'joint="elbow" coef="0.5"')
    with pytest.raises(ValueError, match=r"tendon 'split'.*one or the other"):
        ij.cosimulate(scenario, _written("tied.xml", tied), duration=0.1)


GRIPPER = "".join(
    f'<body name="{name}" pos="0.1 0 0"><joint name="{name[0]}" type="slide" axis="0 {along} 0"/>'
    '<geom size="0.01" mass="0.1"/></body>'
    for name, along in (("left", 1), ("right", -1))
)
AROUND = """<tendon><fixed name="split"><joint joint="l" coef="0.5"/>
  <joint joint="r" coef="0.5"/></fixed></tendon><sensor><jointpos joint="l"/></sensor>
  <equality><joint joint1="l" joint2="r"/></equality>
  <actuator><position tendon="split"/><position jointinparent="l"/></actuator>
  <keyframe><key name="home" qpos="0 0 0.01 0.01"/></keyframe>"""


@pytest.mark.slow
def test_models_and_callbacks_stay_and_other_integrators_come_near():
    model = spec_of(PAPER.plant).compile()
    # 0.8 ms do not divide 1 ms: the step is the next shorter one that does.
    found = ij.cosimulate(PAPER, model, duration=0.4, period=1e-3)
    assert float(found.dt) == 5e-4
    assert model.opt.timestep == 0.0008
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    coarse, fine = (
        ij.cosimulate(PAPER, model, duration=0.4, period=1e-3, dt=dt, integrator=None)
        for dt in (5e-4, 2.5e-4)
    )
    errors = [largest_difference(run.q[-1], found.q[-1]) for run in (coarse, fine)]
    assert errors[1] == pytest.approx(0.5 * errors[0], rel=0.1)
    seen = []
    mujoco.set_mjcb_control(lambda model, data: seen.append(data.time))
    try:
        ij.cosimulate(PAPER, model, period=1e-3, duration=0.01, dt=1e-3)
        assert seen
        count = len(seen)
        mujoco.mj_forward(model, mujoco.MjData(model))
        assert len(seen) == count + 1
    finally:
        mujoco.set_mjcb_control(None)
    slow = ij.with_parts(PAPER, sampling=ij.Sampling(4e-3, delay=4e-3))
    run = ij.cosimulate(slow, spec_of(PAPER.plant), period=1e-3, duration=0.02, dt=1e-3)
    quick = ij.with_parts(PAPER, sampling=ij.Sampling(1e-3, delay=4e-3))
    assert largest_difference(run.q, ij.simulate(quick, duration=0.02, dt=1e-3).q) < 1e-12


@pytest.mark.slow
def test_records_and_films_which_may_follow_each_other(tmp_path):
    """Without a display MuJoCo's renderer fails once, and ends the process at the second try."""
    short = {"duration": 0.2, "dt": 1e-3, "period": 1e-3}
    every = ij.cosimulate(DRIVEN, spec_of(PAPER.plant), **short)
    some = ij.cosimulate(DRIVEN, spec_of(PAPER.plant), record_every=10, **short)
    assert some.t.shape == (21,)
    np.testing.assert_array_equal(some.q, every.q[::10])
    np.testing.assert_array_equal(some.actuator_state, every.actuator_state[::10])
    np.testing.assert_array_equal(some.metrics.rmse, every.metrics.rmse)
    some.to_xarray()
    ij.save_rollouts(some, tmp_path / "run.nc")
    from PIL import Image

    run = {"period": 1e-3, "duration": 0.08, "dt": 1e-3}
    for ending in ("gif", "html"):
        film = tmp_path / f"arm.{ending}"
        ij.cosimulate(PAPER, spec_of(PAPER.plant), film=film, **run)
        assert film.stat().st_size > 1000
    with Image.open(tmp_path / "arm.gif") as film:
        assert film.n_frames == 3


def test_an_arm_without_shapes_is_drawn_as_its_skeleton():
    shapes = spec_of(PAPER.plant)
    bare = mujoco.MjModel.from_xml_path(str(ARMS / "iiwa14.urdf"))
    assert has_shapes(shapes.compile()) and not has_shapes(bare)
    shapes.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0.1, 0.1])
    for geom in shapes.geoms:
        geom.group = 0 if geom.parent == shapes.worldbody else 3
    assert not has_shapes(shapes.compile()), "a table does not move, and other groups are not drawn"


BRIEF = {"duration": 0.1, "period": 1e-3}
BAD = [
    ({"period": None}, "period"),
    ({"dt": 3e-4}, "Take dt=0.00025"),
    ({"locked": {"wrist": 0.0}}, "wrist.*shoulder"),
    ({"locked": {"elbow": 0.0}}, "1 joints that move.*Only hinges"),
    ({"film": "arm.mp4"}, "film.*gif"),
    ({"locked": {"elbow": float("nan")}}, "locked"),
    ({"period": 7e-4}, r"Take duration=0\.10\d*\.$"),
]


def test_what_does_not_fit_is_named():
    text = two_link(PAPER.plant)
    arm = ij.with_parts(PAPER, robot=ij.robots.load(_written("arm.xml", text)))
    many = jax.tree.map(lambda x: np.stack([x, x]), PAPER)
    bad = "<mujoco><worldbody><body pos='a'/></worldbody></mujoco>"
    base = '<body name="base"><freejoint/><geom size="0.1"/><body name="upper">'
    floating = text.replace('<body name="upper">', base)
    floating = floating.replace("</body></body>", "</body></body></body>")
    with_finger = spec_of(PAPER.plant, inside=FINGER)
    for options, words in BAD:
        assert_refused(words, ij.cosimulate, PAPER, spec_of(PAPER.plant), **BRIEF | options)
    for scenario, plant, words in (
        (many, spec_of(PAPER.plant), "one scenario"),
        (PAPER, with_finger, "3 joints that move"),
        (PAPER, "nowhere.xml", r"nowhere\.xml"),
        (PAPER, _written("bad.xml", bad), "body"),
        (arm, _written("other.xml", text.replace("elbow", "elbows")), r"elbow.*elbows"),
        (arm, _written("floating.xml", floating), "base that stands still"),
        (arm, with_finger.compile(), "MjModel"),
    ):
        assert_refused(words, ij.cosimulate, scenario, plant, **BRIEF)
