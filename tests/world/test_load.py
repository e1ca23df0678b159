"""Arms from files: what is read and repaired, and that bad files only raise a ValueError."""

import contextlib
import os
import re
import struct
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_cases import ARMS, dynamics_of, without_constraints
from by_numpy import computed
from hypothesis import given, settings
from hypothesis import strategies as st
from refused import assert_refused
from scipy.spatial.transform import Rotation

import iblf_jax as ij
from iblf_jax.simulation.scenario_rules import check_start

mujoco = pytest.importorskip("mujoco")
SOLID = (
    '<inertial><origin xyz="0 0 0.1"/><mass value="1.5"/><inertia ixx="0.02" iyy="0.03" izz="0.01"'
    ' ixy="0" ixz="0" iyz="0"/></inertial>'
)
LIMIT = '<limit lower="-1" upper="2" effort="7" velocity="1"/>'


def link(name: str, inside: str = SOLID) -> str:
    return f'<link name="{name}">{inside}</link>'


def joint(name: str, parent: str, child: str, kind: str = "revolute", inside: str = LIMIT) -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return (
        f'<joint name="{name}" type="{kind}">{ends}<origin xyz="0 0 0.2" rpy="0.3 0 0"/><axis'
        f' xyz="0 1 0"/>{inside}</joint>'
    )


def robot(*parts: str) -> str:
    return f'<robot name="r">{"".join(parts)}</robot>'


FINGER = '<limit lower="0" upper="0.04" effort="3" velocity="1"/>'
GRIPPER = (
    *(link("base", ""), link("upper"), link("fore"), link("tool", ""), link("left"), link("right")),
    joint("shoulder", "base", "upper", inside=LIMIT + '<dynamics damping="0.4" friction="0.2"/>'),
    joint("elbow", "upper", "fore", "continuous", ""),
    joint("flange", "fore", "tool", "fixed", ""),
    joint("finger", "tool", "left", "prismatic", FINGER),
    joint("other", "tool", "right", "prismatic", FINGER + '<mimic joint="finger" multiplier="2"/>'),
)
"""Two joints, and a gripper with a finger that follows the other."""


@pytest.fixture
def file(tmp_path):
    def write(text: str, name: str = "arm.urdf") -> Path:
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def test_names_limits_and_friction(file):
    arm = ij.robots.load(file(robot(*GRIPPER)), tip="tool")
    assert arm.links == ("upper", "fore") and arm.joints == ("shoulder", "elbow")
    assert arm.kinds == ("revolute", "revolute")
    np.testing.assert_allclose(arm.damping, [0.4, 0.0])
    np.testing.assert_allclose(arm.friction, [0.2, 0.0])
    np.testing.assert_allclose(arm.effort, [7.0, np.inf])
    np.testing.assert_allclose(arm.speed, [1.0, np.inf])
    np.testing.assert_allclose(arm.limits.lower, [-1.0, -np.inf])
    np.testing.assert_allclose(arm.limits.upper, [2.0, np.inf])
    np.testing.assert_allclose(arm.mass, [1.5, 4.5])
    np.testing.assert_allclose(arm.g, [0, 0, -9.81])
    moon = ij.robots.load(file(robot(*GRIPPER)), tip="tool", gravity=[1.62, 0, 0])
    np.testing.assert_allclose(moon.g, [1.62, 0, 0])


def test_locked_joints_keep_their_links(file):
    """Those of the chain, too; a mimic follows, as in a file with that joint fixed there."""
    short = ij.robots.load(file(robot(*GRIPPER)), tip="tool", locked={"elbow": 0.5})
    assert short.joints == ("shoulder",)
    np.testing.assert_allclose(short.mass, [6.0])
    arm = ij.robots.load(file(robot(*GRIPPER)), tip="tool", locked={"finger": 0.03})
    fixed = []
    for name, child, along in (("finger", "left", 0.03), ("other", "right", 0.06)):
        place = f'xyz="0 {along * np.cos(0.3)} {0.2 + along * np.sin(0.3)}"'
        fixed.append(joint(name, "tool", child, "fixed", "").replace('xyz="0 0 0.2"', place))
    same = ij.robots.load(file(robot(*GRIPPER[:-2], *fixed)), tip="tool")
    for name in ("mass", "centre", "inertia", "position", "tip_position"):
        np.testing.assert_allclose(getattr(arm, name), getattr(same, name), atol=1e-12)


@pytest.mark.slow
def test_the_base_is_the_world_and_gravity_turns_with_it(file):
    whole = ij.robots.load(file(robot(*GRIPPER)), tip="tool")
    part = ij.robots.load(file(robot(*GRIPPER)), base="upper", tip="tool")
    assert part.joints == ("elbow",)
    np.testing.assert_allclose(part.g, [0, -9.81 * np.sin(0.3), -9.81 * np.cos(0.3)], atol=1e-12)
    q = np.array([0.0, 0.7])
    np.testing.assert_allclose(part.gravity(q[1:]), whole.gravity(q)[1:], atol=1e-12)


MJCF = """<mujoco><compiler angle="degree"/>
<default><joint damping="1"/><default class="a"><joint armature="0.1" range="-90 90"/></default></default>
<worldbody><body name="b0" pos="0 0 .1"><body name="b1" pos="0 0 1" euler="0 30 0" childclass="a">
  <joint name="j1" axis="0 0 1" ref="20"/><geom type="capsule" size=".02" mass=".3" fromto="0 0 0 0 0 .3"/>
  <joint name="j1b" axis="0 1 0" pos="0 0 0.05"/>
  <body name="b2" pos="0 0 .3"><joint name="j2" axis="0 1 0" type="slide" range="-.1 .2" actuatorfrcrange="-5 6" frictionloss=".3"/>
    <inertial pos="0 0 .1" mass="1" diaginertia=".01 .01 .01"/><geom type="mesh" mesh="nowhere"/>
    <site name="ee" pos="0 0 .2" euler="0 90 0"/>
    <body name="f1" pos=".1 0 0">{finger}<geom type="box" size=".01 .01 .01" mass="0.2"/></body>
  </body></body></body></worldbody>
<actuator><motor joint="j1" gear="10" ctrlrange="-3 2"/><position joint="j1b" gear="2" forcerange="-7 7"/></actuator></mujoco>"""


def test_mjcf_with_classes_references_and_two_hinges_in_a_body(file):
    arm = ij.robots.load(file(MJCF.format(finger='<joint name="jf" axis="1 0 0"/>')), tip="ee")
    assert arm.links == ("b1:j1", "b1", "b2")
    assert arm.kinds == ("revolute", "revolute", "prismatic")
    np.testing.assert_allclose(arm.effort, [20.0, 14.0, 5.0])
    np.testing.assert_allclose(arm.friction, [0, 0, 0.3])
    np.testing.assert_allclose(arm.damping, 1.0)
    plain = MJCF.format(finger="").replace('<geom type="mesh" mesh="nowhere"/>', "")
    model = without_constraints(mujoco.MjModel.from_xml_string(plain))
    q, v = np.array([0.3, -0.4, 0.1]), np.array([1.0, -2.0, 0.5])
    M, bias, pose = computed(
        lambda q, v: (arm.mass_matrix(q), arm.coriolis(q, v, v) + arm.gravity(q), arm.pose(q)), q, v
    )
    for x, expected in zip((M, bias), dynamics_of(model, q, v), strict=True):
        np.testing.assert_allclose(x, expected, rtol=1e-9, atol=1e-12)
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(pose.rotation.ravel(), data.site("ee").xmat, atol=1e-12)


@pytest.mark.parametrize("balances", [True, False])
def test_an_inertia_that_mujoco_balances_is_no_fault(balances, file):
    body = '<inertial mass="1" pos="0 0 0" diaginertia="1 1 3"/>'
    text = mjcf(f'<body name="b" pos="0 0 1"><joint name="jb"/>{body}</body>')
    option = f'<mujoco><compiler balanceinertia="{str(balances).lower()}"/>'
    path = file(text.replace("<mujoco>", option))
    if not balances:
        assert_refused("body 'b'", ij.robots.load, path)
        return
    np.testing.assert_allclose(ij.robots.load(path).inertia[1, :3], 5 / 3)


CORNERS = np.array([(x, y, z) for x in (-0.1, 0.1) for y in (-0.2, 0.2) for z in (0.0, 0.3)])
FACES = ["013", "032", "467", "475", "045", "051", "237", "276", "026", "064", "157", "173"]
FACES = np.array([[int(corner) for corner in face] for face in FACES])
"""A box, its corners [m] and its triangles."""
MESHED = """<mujoco><compiler meshdir="meshes"/><default><mesh scale="0.5 0.5 0.5"/></default>
<asset><mesh file="box.obj"/><mesh name="cube" file="deep/box.stl" inertia="shell"/><mesh name="unused" file="nowhere.stl"/></asset>
<worldbody><geom type="mesh" mesh="unused"/>
<body name="a" pos="0 0 1"><joint name="ja" axis="0 1 0"/>
  <geom type="mesh" mesh="box" euler="0 20 0"/><geom size="0.05" pos="0 0 .2" mass="1"/>
  <geom type="mesh" mesh="unused" density="0"/>
  <body name="b" pos="0 0 .3"><joint name="jb" axis="1 0 0"/>
    <geom type="mesh" mesh="cube" mass="2"/><geom type="capsule" mesh="box"/>
    <body name="c" pos="0 .1 0"><inertial mass="1" pos="0 0 0" diaginertia=".1 .1 .1"/><geom type="mesh" mesh="unused"/>
    </body></body></body>
<body name="other"><joint name="jo"/><geom type="mesh" mesh="unused"/></body></worldbody></mujoco>"""


@pytest.fixture
def meshed(file, tmp_path):
    """An MJCF whose chain to "c" is weighed by meshes, of which another body's is not there."""
    (tmp_path / "meshes" / "deep").mkdir(parents=True)
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS] + [f"f {i} {j} {k}" for i, j, k in FACES + 1]
    file("\n".join(lines), "meshes/box.obj")
    triangles = b"".join(struct.pack("<12fH", 0, 0, 0, *CORNERS[face].ravel(), 0) for face in FACES)
    head = bytes(80) + struct.pack("<I", len(FACES))
    (tmp_path / "meshes" / "deep" / "box.stl").write_bytes(head + triangles)
    return file(MESHED)


@pytest.mark.slow
def test_meshes_weigh_what_they_weigh_in_mujoco(meshed):
    arm = ij.robots.load(meshed, tip="c")
    spec = mujoco.MjSpec.from_file(str(meshed))
    for body in spec.bodies:
        for geom in [x for x in body.geoms if x.meshname == "unused"]:
            spec.delete(geom)
    spec.delete(spec.mesh("unused"))
    spec.delete(spec.body("other"))
    q, v = np.array([0.3, -0.4]), np.array([1.0, -2.0])
    M, bias = dynamics_of(without_constraints(spec.compile()), q, v)
    np.testing.assert_allclose(arm.mass_matrix(q), M, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(arm.coriolis(q, v, v) + arm.gravity(q), bias, rtol=1e-9, atol=1e-12)


WRONG_SIZE = "box.stl, expected a surface around a volume.*wrong size.*<inertial>"
MESHES = {
    "got '.*deep/box.stl'.*Nothing is there.*<inertial>": lambda path: path.unlink(),
    WRONG_SIZE: lambda path: path.write_bytes(path.read_bytes()[:-1]),
    "empty": lambda path: path.write_bytes(b""),
    "not a file": lambda path: (path.unlink(), os.mkfifo(path)),
    "a directory": lambda path: (path.unlink(), path.mkdir()),
}


@pytest.mark.parametrize("message", MESHES)
def test_a_mesh_that_cannot_be_weighed_is_a_fault_of_its_body_alone(meshed, tmp_path, message):
    MESHES[message](tmp_path / "meshes" / "deep" / "box.stl")
    assert_refused(f"body 'b': mesh 'cube': .*{message}", ij.robots.load, meshed, tip="c")
    words = r"body 'other': mesh 'unused': got .*nowhere.stl', .*Nothing is there"
    assert_refused(words, ij.robots.load, meshed, tip="other")


def test_meshes_under_their_bare_names_and_of_a_limited_size(meshed, tmp_path, monkeypatch):
    (tmp_path / "meshes" / "deep" / "box.stl").rename(tmp_path / "meshes" / "box.stl")
    meshed.write_text(MESHED.replace("<compiler", '<compiler strippath="true"'))
    assert ij.robots.load(meshed, tip="c").n == 2
    monkeypatch.setattr("iblf_jax.robots.meshes.LARGEST_MESHES", 700)
    assert_refused("meshes of at most", ij.robots.load, meshed, tip="c")


def test_mjcf_without_gravity_and_with_a_compensation_which_is_mended_only_if_asked(file):
    off = '<option gravity="0 0 -1"><flag gravity="disable"/></option><worldbody>'
    assert not np.any(ij.robots.load(file(mjcf("").replace("<worldbody>", off)), tip="a").g)
    path = file(mjcf('<body name="b" gravcomp="0.5"><joint/><geom size="0.1" mass="1"/></body>'))
    with pytest.warns(UserWarning, match="'b': gravcomp: from 0.5 to 0: gravity acts"):
        arm = ij.robots.load(path, repair=True)
    assert np.any(np.asarray(arm.g))


TABLE = "<mujoco><worldbody><body name='table' pos='1 0 0'/></worldbody></mujoco>"


def including(name: str) -> str:
    return MJCF.format(finger="").replace("<worldbody>", f'<include file="{name}"/><worldbody>')


@pytest.mark.parametrize("name", ["more.xml", "parts/more.xml", "./parts/../parts/more.xml"])
def test_an_include_in_the_folder_of_the_file_or_below_is_read(name, file, tmp_path):
    (tmp_path / "parts").mkdir()
    file(TABLE, name)
    assert ij.robots.load(file(including(name)), tip="ee").n == 3
    file('<mujoco><include file="more.xml"/></mujoco>', name)
    with pytest.raises(ValueError, match=r"include itself|Nothing is there"):
        ij.robots.load(file(including(name)), tip="ee")


OUTSIDE = {
    "up": "../more.xml",
    "link": "link.xml",
    "linked folder": "folder/more.xml",
    "deep": "parts/../../more.xml",
}


@pytest.mark.parametrize("leads", [*OUTSIDE, "absolute"])
def test_an_include_outside_the_folder_of_the_file_is_refused(leads, tmp_path):
    (tmp_path / "arm" / "parts").mkdir(parents=True)
    outside, path = tmp_path / "more.xml", tmp_path / "arm" / "arm.xml"
    outside.write_text(TABLE)
    (tmp_path / "arm" / "link.xml").symlink_to(outside)
    (tmp_path / "arm" / "folder").symlink_to(tmp_path)
    path.write_text(including(OUTSIDE.get(leads, str(outside))))
    words = r"arm\.xml: <include>: file: got .*, expected a file in the folder of the.*Copy"
    assert_refused(words, ij.robots.load, path, tip="ee")


PLAIN = (link("base", ""), link("a"), link("b"))
CHAIN = (joint("ja", "base", "a"), joint("jb", "a", "b"))
MASS_ONLY = '<inertial><mass value="1"/></inertial>'
WEIGHTLESS = '<inertial><mass value="0"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'


def one_link(inside: str) -> str:
    return robot(link("base", ""), link("a", inside), joint("ja", "base", "a"))


def bad_inertia(text: str) -> str:
    return one_link(SOLID.replace('ixx="0.02" iyy="0.03" izz="0.01"', text))


BAD = {
    "no inertia": (one_link(MASS_ONLY), "link 'a'.*no <inertia>"),
    "zero inertia": (bad_inertia('ixx="0" iyy="0" izz="0"'), "link 'a'.*positive definite"),
    "indefinite inertia": (bad_inertia('ixx="0.02" iyy="-0.03" izz="0.01"'), "link 'a'.*positive definite"),
    "impossible inertia": (bad_inertia('ixx="0.02" iyy="0.09" izz="0.01"'), "link 'a'.*sum of the two others"),
    "missing moment": (bad_inertia('ixx="0.02" iyy="0.09"'), "link 'a': inertia izz"),
    "nan": (bad_inertia('ixx="nan" iyy="0.09" izz="0.01"'), "link 'a': inertia ixx.*finite"),
    "inertia without mass": (one_link(WEIGHTLESS), "link 'a'.*without a mass"),
    "negative mass": (one_link(SOLID.replace("1.5", "-1.5")), "link 'a': mass"),
    "no mass that moves": (robot(link("base", ""), link("a", ""), link("b"), *CHAIN), "'a'"),
    "no mass at the end": (robot(link("base", ""), link("a"), link("b", ""), *CHAIN), "'b'"),
    "mimic": (robot(*PLAIN, CHAIN[0], joint("jb", "a", "b", inside=LIMIT + '<mimic joint="ja"/>')), "joint 'jb'.*mimic"),
    "mimic of nothing": (robot(*PLAIN, CHAIN[0], joint("jb", "a", "b", inside=LIMIT + '<mimic joint="x"/>')), "joint 'jb': mimic"),
    "two parents": (robot(*PLAIN, *CHAIN, joint("jc", "base", "b")), "link 'b'.*two parents"),
    "ring": (robot(*PLAIN, joint("ja", "b", "a"), joint("jb", "a", "b")), "ring of joints"),
    "two roots": (robot(*PLAIN, CHAIN[0]), "links without a parent: 'base', 'b'"),
    "unknown parent": (robot(*PLAIN, CHAIN[0], joint("jb", "x", "b")), "joint 'jb': parent"),
    "no child": (robot(*PLAIN, CHAIN[0], '<joint name="jb" type="fixed"><parent link="a"/></joint>'), "joint 'jb': child"),
    "two links of a name": (robot(*PLAIN, link("a"), *CHAIN), "link 'a'.*two of this name"),
    "two joints of a name": (robot(*PLAIN, CHAIN[0], joint("ja", "a", "b")), "joint 'ja'.*two of this name"),
    "unnamed link": (robot(link("")), "<link>"),
    "floating": (robot(*PLAIN, CHAIN[0], joint("jb", "a", "b", "floating")), "joint 'jb': type.*serial"),
    "no type": (robot(*PLAIN, CHAIN[0], joint("jb", "a", "b", "")), "joint 'jb': type"),
    "no range": (robot(*PLAIN, CHAIN[0], joint("jb", "a", "b", inside="")), "joint 'jb': limit"),
    "empty range": (robot(*PLAIN, CHAIN[0], joint("jb", "a", "b", inside='<limit lower="1" upper="1"/>')), "joint 'jb': limit"),
    "no axis": (robot(*PLAIN, CHAIN[0], joint("jb", "a", "b").replace("0 1 0", "0 0 0")), "joint 'jb': axis"),
    "short vector": (robot(*PLAIN, CHAIN[0], joint("jb", "a", "b").replace("0 1 0", "0 1")), "joint 'jb': axis.*3 numbers"),
    "negative damping": (robot(*PLAIN, CHAIN[0], joint("jb", "a", "b", inside=LIMIT + '<dynamics damping="-1"/>')), "joint 'jb': damping"),
    "nothing that moves": (robot(link("base"), link("a"), joint("ja", "base", "a", "fixed", "")), "end at: none"),
    "two ends": (robot(*PLAIN, CHAIN[0], joint("jb", "base", "b")), "'a', 'b'"),
    "no links": ("<robot/>", "no <link>"),
    "macro": ('<robot xmlns:xacro="x"><xacro:arm/></robot>', "xacro"),
    "sdf": ("<sdf><model/></sdf>", "It is SDF"),
    "another document": ("<html/>", "root element is <html>"),
    "malformed": ("<robot><link name='a'></robot>", "line 1 of.*malformed"),
    "no XML": ("solid arm", "malformed"),
    "empty": ("", "malformed"),
    "bomb": ('<!DOCTYPE x [<!ENTITY a "aaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]><robot name="&b;"/>', "entities"),
    "external entity": ('<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/hostname">]><robot>&a;</robot>', "entities"),
    "deep": ("<robot>" + "<a>" * 5000 + "</a>" * 5000 + "</robot>", "levels"),
    "many elements": ("<robot>" + "<a/>" * 200_000 + "</robot>", "elements"),
    "many links": (robot(*(link(f"l{i}", "") for i in range(2000))), "2000 links"),
}  # fmt: skip
SPHERE = '<geom size="0.1" mass="1"/>'


def mjcf(inside: str, outside: str = "") -> str:
    body = f'<body name="a"><joint name="ja"/>{SPHERE}{inside}</body>'
    return f"<mujoco><worldbody>{body}</worldbody>{outside}</mujoco>"


BAD_MJCF = {
    "no bodies": ("<mujoco/>", "no <body>"),
    "ball": (mjcf(f'<body name="b"><joint name="jb" type="ball"/>{SPHERE}</body>'), "joint 'jb'.*ball"),
    "free": (f'<mujoco><worldbody><body name="a"><freejoint name="f"/>{SPHERE}</body></worldbody></mujoco>', "joint 'f'.*free"),
    "mesh": (mjcf('<body name="b"><joint/><geom type="mesh" mesh="m"/></body>'), "body 'b'.*mesh"),
    "missing mesh": (mjcf('<body name="b"><joint/><geom type="mesh" mesh="m"/></body>', '<asset><mesh name="m" file="m.stl"/></asset>'), "body 'b': mesh 'm': got .*m.stl'.*Nothing is there.*<inertial>"),
    "height field": (mjcf('<body name="b"><joint/><geom type="hfield" hfield="h"/></body>'), "body 'b'.*height field 'h'"),
    "compensated gravity": (mjcf(f'<body name="b" gravcomp="1"><joint/>{SPHERE}</body>'), "body 'b': gravcomp: got 1.0.*repair=True"),
    "no mass": (mjcf('<body name="b"><joint/></body>'), "'b'"),
    "spring": (mjcf(f'<body name="b"><joint name="jb" stiffness="3"/>{SPHERE}</body>'), "joint 'jb': stiffness"),
    "connect": (mjcf(f'<body name="b"><joint/>{SPHERE}</body>', '<equality><connect name="c" body1="a" body2="b" anchor="0 0 0"/></equality>'), "equality 'c'.*tied together"),
    "weld": (mjcf("", '<equality><weld name="c" body1="a"/></equality>'), "equality 'c'.*tied together"),
    "coupled": (mjcf("", '<equality><joint name="c" joint1="ja"/></equality>'), "equality 'c'.*'ja' tied"),
    "replicate": ('<mujoco><worldbody><replicate count="1000000000"><body/></replicate></worldbody></mujoco>', "replicate"),
    "repeated": (mjcf(f'<body name="a">{SPHERE}</body>'), "repeated name 'a'"),
    "infinite": (mjcf(f'<body name="b" pos="0 inf 0">{SPHERE}</body>'), "body 'b': pos.*finite"),
    "no such include": ('<mujoco><include file="nowhere.xml"/></mujoco>', "nowhere.xml"),
}  # fmt: skip


@pytest.mark.parametrize("name", [*BAD, *BAD_MJCF])
def test_bad_files_are_refused_by_name(name, file):
    text, message = {**BAD, **BAD_MJCF}[name]
    path = file(text)
    with pytest.raises(ValueError, match=message) as caught:
        ij.robots.load(path)
    assert str(caught.value).count(str(path)) == 1


STRANGE_NUMBERS = (
    *("2_5", "1_000.0", "\u0661\u0662", "\uff11.5", "1\u00a0", "infinity", "-inf", "nan", "NaN"),
    *("0x10", "1e", "1,5", "1f", "--1"),
)
PLACES = {
    "link 'a': mass": one_link(SOLID.replace('"1.5"', '"{}"')),
    "link 'a': inertia iyy": one_link(SOLID.replace('"0.03"', '"{}"')),
    "link 'a': inertial: origin xyz": one_link(SOLID.replace("0 0 0.1", "0 {} 0.1")),
    "joint 'ja': limit upper": one_link(SOLID).replace('upper="2"', 'upper="{}"'),
    "body 'b': pos": mjcf(f'<body name="b" pos="0 {{}} 0">{SPHERE}</body>'),
}


@pytest.mark.parametrize("text", STRANGE_NUMBERS)
def test_numbers_that_are_not_decimal_are_refused_with_file_element_and_attribute(text, file):
    for place, description in PLACES.items():
        path = file(description.format(text))
        assert_refused(f"arm.urdf: {place}: got .*, expected .*finite", ij.robots.load, path)


@pytest.mark.parametrize("text", ["2.5", "+2.5", "25e-1", "2.5E+0", ".25e1", "\n\t2.5 "])
def test_decimal_numbers_are_read(text, file):
    arm = ij.robots.load(file(one_link(SOLID.replace('"1.5"', f'"{text}"'))))
    np.testing.assert_array_equal(arm.mass, [2.5])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"base": "bases"}, "base: got 'bases'.*'base'"),
        ({"base": "foo"}, "There are 'base', 'upper'"),
        ({"tip": "tol"}, "tip: got 'tol'.*'tool'"),
        ({"tip": "base"}, "expected a chain with a joint that moves"),
        ({"base": "left", "tip": "upper"}, "expected a link beyond the base 'left'"),
        ({"tip": "left"}, "joint 'other'.*mimic of 'finger'"),
        ({"tip": "tool", "locked": {"elbows": 0.0}}, "locked: got 'elbows'.*'elbow'"),
        ({"tip": "tool", "locked": {"elbow": np.nan}}, r"locked\['elbow'\]"),
        ({"tip": "tool", "gravity": 9.81}, "gravity"),
        ({}, "Chains beyond 'base' end at: 'left', 'right'"),
    ],
)
def test_bad_arguments_are_refused(arguments, message, file):
    with pytest.raises(ValueError, match=message) as caught:
        ij.robots.load(file(robot(*GRIPPER)), **arguments)
    assert "arm.urdf" in str(caught.value)


def test_paths_that_are_no_files_and_a_gigabyte_are_refused(tmp_path, monkeypatch):
    """Without the extra the message says how to get it."""
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "big.urdf").open("wb") as big:
        big.truncate(1 << 30)
    for path, message in (
        (tmp_path / "x.urdf", "Nothing is there"),
        (tmp_path, "a directory"),
        (3, "the path of"),
        ("", "directory|Nothing"),
        (tmp_path / "pipe", "not a file"),
        (tmp_path / "big.urdf", "at most 8 MiB"),
    ):
        assert_refused(message, ij.robots.load, path)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert_refused(r"\.\[robots\]", ij.robots.load, ARMS / "ur5.urdf", error=ImportError)


SOURCES = [
    (ARMS / "ur5.urdf").read_text(),
    robot(*GRIPPER),
    MJCF.format(finger='<joint name="jf" axis="1 0 0"/>'),
]
NUMBER = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")
VALUES = ["nan", "inf", "-1", "0", "1e308", "1e-308", "1e400", "", "abc", "0 0", "1 2 3 4 5"]
VALUES += ["9" * 400, "1e9", "-1e-3", "true"]


@st.composite
def mutated(draw) -> bytes:
    """A description with bytes, numbers, passages or elements changed, lost, doubled or moved."""
    text = draw(st.sampled_from(SOURCES))
    for _ in range(draw(st.integers(1, 3))):
        kind = draw(st.sampled_from(["bytes", "number", "passage", "element"]))
        place = draw(st.integers(0, len(text) - 1))
        if kind == "bytes":
            text = text[:place] + draw(st.text(max_size=3)) + text[place + 1 :]
        elif kind == "number":
            found = list(NUMBER.finditer(text))
            if found:
                one = found[place % len(found)]
                text = text[: one.start()] + draw(st.sampled_from(VALUES)) + text[one.end() :]
        elif kind == "passage":
            passage = text[place : place + draw(st.integers(1, 200))]
            target = draw(st.integers(0, len(text) - 1))
            doubled = text[:target] + passage + text[target:]
            text = draw(st.sampled_from([doubled, text.replace(passage, "", 1)]))
        else:
            text = _element_changed(draw, text, place)
        text = text or " "
    return text.encode("utf-8", "replace")


def _element_changed(draw, text: str, place: int) -> str:
    try:
        root = ET.fromstring(text)
    except ET.ParseError:
        return text
    elements = list(root.iter())
    parents = {child: parent for parent in elements for child in parent}
    if not parents:
        return text
    one, other = elements[1 + place % (len(elements) - 1)], draw(st.sampled_from(elements))
    what = draw(st.sampled_from(["lost", "doubled", "moved", "exchanged"]))
    if what == "lost":
        parents[one].remove(one)
    elif what == "doubled":
        parents[one].append(one)
    elif what == "moved" and one not in other.iter() and other not in one.iter():
        parents[one].remove(one)
        other.append(one)
    elif what == "exchanged" and one.attrib:
        name = draw(st.sampled_from(sorted(one.attrib)))
        one.set(name, draw(st.sampled_from(VALUES + [x.get(name, "") for x in elements])))
    return ET.tostring(root, encoding="unicode")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Inertia matrix is too close to singular")
@settings(max_examples=200)
@given(data=mutated())
def test_mutated_files_load_or_are_refused(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "mutated.xml"
    path.write_bytes(data)
    with contextlib.suppress(ValueError):
        assert np.all(np.isfinite(np.asarray(ij.robots.load(path).mass)))


def weighing(inertia: str, mass: str = "1.5", place: str = "0 0 0.1", also: str = "0 0 0") -> str:
    xy, xz, yz = also.split()
    xx, yy, zz = inertia.split()
    return (
        f'<inertial><origin xyz="{place}" rpy="0.3 0.2 0.1"/><mass value="{mass}"/>'
        f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="{xy}" ixz="{xz}" iyz="{yz}"/></inertial>'
    )


def arm_with(*more: str, a: str = SOLID, ja: str = LIMIT) -> str:
    """A chain base - a - b, and what is to hang on it."""
    first, second = joint("ja", "base", "a", inside=ja), joint("jb", "a", "b")
    return robot(link("base", ""), link("a", a), link("b"), first, second, *more)


NO_INERTIA, NEGATIVE = weighing("0 0 0"), weighing("0.02 -0.03 0.01")
IMPOSSIBLE = weighing("0.02 0.09 0.01")
NO_MATTER = {
    "inertia of what the base carries": arm_with(link("x", IMPOSSIBLE), joint("jx", "base", "x", "fixed", "")),
    "inertia on another branch": arm_with(link("x", NEGATIVE), joint("jx", "base", "x")),
    "numbers on another branch": arm_with(link("x", SOLID.replace("0.02", "nan")), joint("jx", "base", "x").replace("0.3 0 0", "$(x)")),
    "no range on another branch": arm_with(link("x"), joint("jx", "base", "x", inside='<limit lower="0" upper="0" effort="-1"/>')),
    "a free body on another branch": arm_with(link("x"), joint("jx", "base", "x", "floating", "")),
    "no range of a finger": arm_with(link("x", weighing("0 0 0", "0")), joint("jx", "b", "x", "prismatic", "")),
    "a point welded on": arm_with(link("x", NO_INERTIA.replace("1.5", "0.2")), joint("jx", "b", "x", "fixed", "")),
    "a moment of rounding": arm_with(link("x", weighing("-2e-35 0.01 0.01")), joint("jx", "b", "x", "fixed", "")),
    "a rod that moves": arm_with(a=weighing("-2e-35 0.01 0.01")),
    "a speck": arm_with(link("x", weighing("1e-22 1e-22 1e-22", "1e-18")), joint("jx", "b", "x", "fixed", "")),
    "an endless wheel": arm_with(ja='<limit lower="-1e16" upper="1e16" effort="7"/>'),
}  # fmt: skip


@pytest.mark.parametrize("name", NO_MATTER)
def test_what_does_not_matter_refuses_no_file(name, file, recwarn):
    plain = ij.robots.load(file(arm_with()), tip="b")
    arm = ij.robots.load(file(NO_MATTER[name]), tip="b")
    assert not recwarn.list and arm.repaired == ()
    if not any(word in name for word in ("point", "moment", "rod")):  # their weight counts
        np.testing.assert_allclose(arm.mass, plain.mass, rtol=1e-15)
        np.testing.assert_allclose(arm.inertia, plain.inertia, rtol=0, atol=1e-17)


BY_ITSELF = "one that moves by itself"
WITH_REPAIR = {
    "impossible inertia": (arm_with(a=IMPOSSIBLE), "link 'a': inertia: from principal moments 0.01, 0.02, 0.09 to"),
    "negative inertia": (arm_with(a=NEGATIVE), "link 'a': inertia: from principal moments -0.03, 0.01, 0.02 to"),
    "no inertia": (arm_with(a=NO_INERTIA), "link 'a': inertia: from principal moments 0, 0, 0 to"),
    "no <inertia>": (arm_with(link("x", MASS_ONLY), joint("jx", "b", "x", "fixed", "")), "link 'x': inertia: from nothing to that of a point"),
    "inertia without mass": (arm_with(link("x", WEIGHTLESS), joint("jx", "b", "x", "fixed", "")), "link 'x'.*without a mass to"),
    "no mass between": (arm_with(a="").replace('"0 1 0"', '"1 0 0"', 1), "link 'a': from no mass to no mass, as it is"),
    "no range": (arm_with(ja='<limit lower="0" upper="0"/>'), r"joint 'ja': limit: from \(0.0, 0.0\) to no limits"),
    "no <limit>": (arm_with(ja=""), "joint 'ja': limit: from nothing to no limits"),
    "negative torque": (arm_with(ja=LIMIT.replace("7", "-1")), "joint 'ja': effort: from -1.0 to no limit"),
    "negative speed": (arm_with(ja=LIMIT.replace('velocity="1"', 'velocity="-1"')), "joint 'ja': velocity: from -1.0 to no limit"),
    "mimic of nothing": (arm_with(ja=LIMIT + '<mimic joint="x"/>'), f"joint 'ja': from a mimic of 'x' in the chain to {BY_ITSELF}"),
    "mimic": (arm_with(ja=LIMIT + '<mimic joint="jb"/>'), f"joint 'ja': from a mimic of 'jb' in the chain to {BY_ITSELF}"),
    "spring": (BAD_MJCF["spring"][0], "joint 'jb': stiffness: from 3.0 to 0"),
    "coupled": (BAD_MJCF["coupled"][0], f"joint 'ja': from one tied to another by equality 'c' to {BY_ITSELF}"),
    "tendon": (mjcf("", '<tendon><fixed name="t"><joint joint="ja" coef="1"/></fixed></tendon><equality><tendon name="e" tendon1="t"/></equality>'), f"joint 'ja': from one tied to another by tendon 'e' to {BY_ITSELF}"),
    "motion capture": (mjcf("", '<equality><weld name="w" body1="m" body2="a"/></equality>').replace("<worldbody>", '<worldbody><body name="m" mocap="true"/>'), "equality 'w': from 'm' and 'a' tied together to no tie"),
    "mjcf inertia": (mjcf('<body name="b"><joint/><inertial pos="0 0 .1" euler="0 30 0" mass="1" diaginertia=".01 .01 .03"/></body>'), "body 'b': inertia: from principal moments 0.01, 0.01, 0.03 to principal moments 0.015, 0.015, 0.03"),
}  # fmt: skip


@pytest.mark.parametrize("name", WITH_REPAIR)
def test_repair_mends_and_lists(name, file):
    text, line = WITH_REPAIR[name]
    assert_refused("Or load it with repair=True, which makes of it: ", ij.robots.load, file(text))
    with pytest.warns(UserWarning, match=f"repaired: .*{line}"):
        arm = ij.robots.load(file(text), repair=True)
    assert any(re.match(line, one) for one in arm.repaired)
    M = computed(arm.mass_matrix, np.full(arm.n, 0.3))
    assert np.linalg.eigvalsh(M)[0] > 0
    assert jax.tree.structure(jax.tree.map(lambda x: x, arm)) == jax.tree.structure(arm)


def test_a_warning_names_ranges_and_bounds_that_seem_to_be_degrees(file, recwarn):
    """Not ranges in metres, those that mean none, and two turns."""
    ends = {
        "revolute": (-170, 90),
        "wrist": (-12.5, 12.5),
        "none": (-1e9, 1e9),
        "prismatic": (0, 90),
    }
    parts, last = [link("base", "")], "base"
    for name, (low, high) in ends.items():
        limit = f'<limit lower="{low}" upper="{high}" effort="7" velocity="1"/>'
        kind = "prismatic" if name == "prismatic" else "revolute"
        parts += [link(f"of {name}"), joint(name, last, f"of {name}", kind, limit)]
        last = f"of {name}"
    ij.robots.load(file(robot(*parts)))
    (loaded,) = recwarn
    assert "joint revolute: the range from -170 to 90 rad" in str(loaded.message)
    assert "write -2.967 and 1.571 (numpy.deg2rad converts)." in str(loaded.message)
    recwarn.clear()
    ninety = ij.bounds.Constant(jnp.array([0.9, 90.0]))
    bounds = ij.Bounds(lower=ij.bounds.Constant(0.1), upper=ninety)
    check_start(ij.with_parts(ij.presets.zhang_yan_2024(), bounds=bounds))
    (typed,) = recwarn
    assert "joint 1: the range from 0.1 to 90 rad" in str(typed.message)


ALSO = "0.01 -0.02 0.03"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("inertia", "also"),
    [("0.02 0.09 0.01", "0 0 0"), ("0.02 -0.03 0.01", ALSO), ("-1 -2 -3", ALSO)],
)
def test_the_change_is_the_smallest(inertia, also, file):
    """No positive matrix is nearer to the second moments of the file, and mass and centre stay."""
    solid = weighing(inertia, also=also)
    path = file(arm_with(link("x", solid), joint("jx", "b", "x", "fixed", "")))
    with pytest.warns(UserWarning, match="repaired"):
        arm = ij.robots.load(path, tip="b", repair=True)
    assert len(arm.repaired) == 1
    plain = ij.robots.load(file(arm_with()), tip="b")
    numbers = ("mass", "centre", "inertia")
    after, before = (
        np.asarray(ij.robots.spatial.pseudo_inertia(*(getattr(x, name)[1] for name in numbers)))
        for x in (arm, plain)
    )
    turned, place = np.eye(4), np.eye(4)
    turned[:3, :3] = Rotation.from_euler("xyz", [0.3, 0.2, 0.1]).as_matrix()
    place[:3, :3] = Rotation.from_euler("x", 0.3).as_matrix()
    turned[:3, 3], place[:3, 3] = [0, 0, 0.1], [0, 0, 0.2]
    back = np.linalg.inv(place @ turned)
    P = back @ (after - before) @ back.T
    np.testing.assert_allclose(P[3], [0, 0, 0, 1.5], atol=1e-14)
    (xx, yy, zz), (xy, xz, yz) = (map(float, x.split()) for x in (inertia, also))
    J = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    S, mended = 0.5 * np.trace(J) * np.eye(3) - J, P[:3, :3]
    # the nearest point X of a convex cone to S: X in it, X - S in its dual (here the same cone),
    # and the two orthogonal
    assert np.linalg.eigvalsh(mended)[0] > -1e-14 and np.linalg.eigvalsh(mended - S)[0] > -1e-14
    assert abs(np.sum(mended * (mended - S))) < 1e-14


@pytest.mark.parametrize(
    "text",
    [
        arm_with(a=SOLID.replace("1.5", "-1.5")),
        arm_with(ja='<limit lower="nan" upper="0"/>'),
        robot(link("base", ""), link("a"), link("b", ""), *CHAIN),
        robot(
            link("base", ""),
            link("a", weighing("0 0 0", place="0 0 0")),
            joint("ja", "base", "a").replace("0 0 0.2", "0 0 0"),
        ),
        arm_with(a="").replace("0.3 0 0", "0 0 0").replace("0 0 0.2", "0 0 0"),
        BAD_MJCF["connect"][0],
        BAD_MJCF["mesh"][0],
        BAD_MJCF["ball"][0],
    ],
)
def test_what_no_rule_mends_is_refused(text, file):
    for repair in (False, True):
        with pytest.raises(ValueError, match="expected") as error:
            ij.robots.load(file(text), repair=repair)
        assert "repair=True" not in str(error.value)


def test_mjcf_what_is_not_on_the_chain_refuses_no_file(file, recwarn):
    beside = """<body name="x"><joint name="jx" stiffness="3" damping="1e11"/><geom type="mesh" mesh="m"/></body>
      <body name="y"><joint name="jy" type="ball"/><inertial pos="0 0 0" mass="0" diaginertia="0 0 0"/></body>
      <body name="z"><joint name="jz"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 9"/><geom type="mesh" mesh="m"/></body>"""
    outside = """<tendon><fixed name="t"><joint joint="jx" coef="1"/><joint joint="jz" coef="1"/></fixed></tendon>
      <equality><tendon tendon1="t"/></equality><actuator><motor tendon="t"/><motor joint="ja" ctrlrange="-2 2"/></actuator>
      <default><default class="seen"><geom type="mesh" density="0"/></default>
      <default class="drawn"><geom type="capsule" fromto="0 0 0 0 0 1" size="0.1" mass="0"/></default></default>"""
    seen = """<body name="b"><joint name="jb" axis="0 1 0" range="-1 1"/><geom class="seen" mesh="m"/>
      <geom size="0.2" pos="0 0 1"/>{}</body>"""
    drawn = seen.format('<geom class="drawn"/>')
    path = file(mjcf(drawn, outside).replace("<worldbody>", f"<worldbody>{beside}"))
    arm = ij.robots.load(path, tip="b")
    undrawn = seen.format("").replace('<geom class="seen" mesh="m"/>', "")
    plain = ij.robots.load(file(mjcf(undrawn), "plain.xml"), tip="b")
    assert not recwarn.list
    np.testing.assert_array_equal(arm.mass, plain.mass)
    np.testing.assert_array_equal(arm.inertia, plain.inertia)
    np.testing.assert_allclose(arm.effort, [2.0, np.inf])
    assert_refused(r"body 'x'.*mesh", ij.robots.load, path, tip="x", repair=True)
