"""Scenario, study and tuning files that name a robot's own file; what is saved needs it no more."""

import shutil
import sys

import jax
import numpy as np
import pytest
from conftest import ROOT
from iblf_jax.controllers import Saturated
from refused import assert_refused

import iblf_jax as ij

pytest.importorskip("mujoco")
REFERENCE = """
[reference]
kind = "sinusoid"
offset = [0.0, -1.2, 1.6, -1.4, -1.57, 0.0]
amplitude = 0.3
frequency = 1.0
phase = 1.5708
"""
ROBOT = '[robot]\nfile = "ur5.urdf"\ntip = "tool0"\n'


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the arm's file and scenario files; the caller is somewhere else."""
    shutil.copy(ROOT / "tests" / "data" / "arms" / "ur5.urdf", tmp_path)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    return tmp_path


def loaded(folder, text):
    (folder / "scenario.toml").write_text(text + REFERENCE)
    return ij.load_scenario(folder / "scenario.toml")


@pytest.mark.slow
def test_what_the_file_leaves_out_follows_from_the_arm(folder):
    scenario = loaded(folder, ROBOT)
    arm = ij.robots.load(folder / "ur5.urdf", tip="tool0")
    np.testing.assert_array_equal(scenario.bounds[0].lower.value, arm.lower)
    assert isinstance(scenario.controller, Saturated)
    np.testing.assert_array_equal(scenario.controller.limit, arm.effort)
    np.testing.assert_allclose(scenario.initial.q, scenario.reference.position(np.zeros(())))
    assert jax.tree.structure(scenario.plant) == jax.tree.structure(arm)
    near = ""
    for side, distance in (("lower", -0.35), ("upper", 0.35)):
        value = (np.array([0.0, -1.2, 1.6, -1.4, -1.57, 0.0]) + distance).tolist()
        near += f"[bounds.{side}]\nkind = 'constant'\nvalue = {value}\n"
    bounded = loaded(folder, ROBOT + near)
    expected = ij.presets.arm_scenario(arm, bounded.reference, bounds=bounded.bounds[0])
    weight = bounded.controller.law.weight
    np.testing.assert_array_equal(weight, expected.controller.law.weight)
    assert np.min(weight) < np.min(scenario.controller.law.weight)


def test_what_it_says_counts_and_joints_have_one_name_in_paths_and_messages(folder):
    text = ROBOT + '[controller]\nkind = "computed_torque"\nKp = 30.0\nKd = 11.0\n'
    text += "[initial]\nq = [0.1, -1, 1.4, -1.2, -1.5, 0.2]\n"
    text += '[parameters]\n"plant.payload" = 2.0\n"plant.link[forearm_link].mass" = 3.0\n'
    scenario = loaded(folder, text)
    assert scenario.controller.law.Kp[3] == 30.0 and scenario.initial.q[0] == 0.1
    assert (float(scenario.plant.payload), float(scenario.model.payload)) == (2.0, 0.0)
    assert (float(scenario.plant.mass[2]), float(scenario.model.mass[2])) == (3.0, 2.275)
    scenario = loaded(folder, ROBOT + '[parameters]\n"controller.K2[elbow_joint]" = 9.0\n')
    assert scenario.controller.law.K2[2] == 9.0
    for path, value, words in (
        ('initial.q["elbow_joint"]', 4.0, r"^initial\.q\[elbow_joint\]: got 4"),
        ("bounds.lower.value[elbow_joint]", 5.0, r"^bounds of joint elbow_joint: got"),
    ):
        with pytest.raises(ValueError, match=words):
            ij.simulate(ij.with_parameters(scenario, {path: value}), duration=0.01)
    assert scenario.loop.plant.notation.left_bounds(1, 2) == "Joint elbow_joint left its bounds"


@pytest.mark.slow
def test_plant_and_model_from_two_files_a_locked_joint_and_repair(folder):
    believed = (folder / "ur5.urdf").read_text().replace("2.275", "2.0")
    (folder / "believed.urdf").write_text(believed)
    locked = 'tip = "tool0"\nlocked = { wrist_3_joint = 0.3 }\n'
    text = f'[plant]\nfile = "ur5.urdf"\n{locked}[model]\nfile = "believed.urdf"\n{locked}'
    (folder / "both.toml").write_text(text + REFERENCE.replace(", 0.0]", "]"))
    scenario = ij.load_scenario(folder / "both.toml")
    assert scenario.n == 5
    assert (float(scenario.plant.mass[2]), float(scenario.model.mass[2])) == (2.275, 2.0)
    text = (folder / "ur5.urdf").read_text()
    (folder / "ur5.urdf").write_text(text.replace('ixx="0.049443313556"', 'ixx="9"'))
    assert_refused("repair=True", loaded, folder, ROBOT)
    with pytest.warns(UserWarning, match="repaired: link 'forearm_link': inertia"):
        scenario = loaded(folder, ROBOT + "repair = true\n")
    assert len(scenario.plant.repaired) == 1
    ij.save_scenario(scenario, folder / "saved.toml")
    assert ij.load_scenario(folder / "saved.toml").plant.repaired == scenario.plant.repaired


def test_the_plant_may_have_other_rotors_and_what_is_saved_needs_no_other_file(folder):
    tables = '[plant]\nfile = "ur5.urdf"\narmature = 0.01\n[model]\nfile = "ur5.urdf"\n'
    rotors, scenario = loaded(folder, tables), loaded(folder, ROBOT)
    np.testing.assert_array_equal(rotors.plant.armature, 0.01)
    np.testing.assert_array_equal(rotors.model.armature, scenario.plant.armature)
    np.testing.assert_array_equal(rotors.controller.law.K2, scenario.controller.law.K2)
    (folder / "ur5.urdf").unlink()
    ij.save_scenario(scenario, folder / "saved.toml")
    again = ij.load_scenario(folder / "saved.toml")
    assert jax.tree.structure(again) == jax.tree.structure(scenario)
    jax.tree.map(np.testing.assert_array_equal, again, scenario)
    assert "urdf" not in (folder / "saved.toml").read_text()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[robot]\nfile = "nothing.urdf"\n', r"robot\.file: .*nothing\.urdf"),
        ('[robot]\nfile = "ur5.urdf"\ntip = "hand"\n', r"robot\.file: tip: got 'hand'"),
        ('[robot]\nfile = "ur5.urdf"\nmass = 2.0\n', r"robot\.mass: got an unknown key"),
        ("[robot]\nfile = 3\n", r"robot\.file: got 3, expected a string"),
        (ROBOT + "locked = { elbow = 0.1 }\n", r"robot\.file: .*elbow"),
        (ROBOT + "repair = 1\n", r"robot\.repair: got 1, expected true or false"),
        (ROBOT + 'armature = "a"\n', r"robot\.armature: got 'a', expected .*kg m\^2"),
        (ROBOT + "armature = [0.1, 0.2]\n", r"robot: .*armature"),
        (ROBOT + "armature = -0.1\n", r"robot: .*armature"),
        (ROBOT + '[plant]\nfile = "ur5.urdf"\n', "beside"),
        ('[model]\nfile = "ur5.urdf"\n', "plant: got nothing"),
    ],
)
def test_what_is_wrong_is_said(folder, text, message):
    with pytest.raises(ValueError, match=message) as error:
        loaded(folder, text)
    assert "scenario.toml" in str(error.value)


def test_without_the_extra_it_says_so(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert_refused(r"robot\.file: .*\.\[robots\]", loaded, folder, ROBOT)
