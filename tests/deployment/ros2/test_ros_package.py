"""The generated ROS 2 package without ROS: its files, its library, and what is refused."""

import ast
import collections
import dataclasses
import importlib.util
import itertools
import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import types
import warnings
import xml.etree.ElementTree
from types import SimpleNamespace as Record
from typing import ClassVar
from unittest import mock

import jax
import members
import numpy as np
import pytest
import ros_package
import yaml
from conftest import ROOT
from refused import assert_refused

import iblf_jax as ij
from iblf_jax import cli
from iblf_jax.deployment.control_law import control_law
from iblf_jax.deployment.export import vectors
from iblf_jax.deployment.ros2 import simulated_robot
from iblf_jax.deployment.ros2.node.c_law import FLAGS, NOT_FINITE, CLaw, load_law, read_description
from iblf_jax.deployment.ros2.package import ros_options, write_package
from iblf_jax.deployment.ros2.ros2_control import ros2_control_files
from iblf_jax.deployment.write_c import Law, generate
from iblf_jax.simulation.scenario import canonical

if importlib.util.find_spec("setuptools") is None:
    pytest.skip("setuptools builds a package", allow_module_level=True)

NAME = ros_package.NAME
JOINTS = ["shoulder", "elbow"]


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    return ros_package.made_package(tmp_path_factory.mktemp("ros2"))


@pytest.fixture
def law(package) -> CLaw:
    return load_law(package.modules / NAME)


def test_balance_is_gravity_and_states_outside_of_the_bounds_are_reported(law, package):
    q, dq = [0.4, 0.9], [0.1, 0.2]
    law.init(q, dq)
    first, _ = law.step(0.0, q, dq)
    law.init(q, dq)
    gravity = package.scenario.model.gravity(jax.numpy.asarray(q))
    np.testing.assert_allclose(law.balance(q), gravity, rtol=1e-12)
    assert law.step(0.0, q, dq)[0] == first
    assert law.init([0.5, 0.5], [0.0, 0.0])
    assert law.step(0.0, [float("nan"), 0.5], [0.0, 0.0])[1] == NOT_FINITE
    assert law.step(0.0, [0.5, 0.5], [0.0, float("inf")])[1] == NOT_FINITE
    assert law.init([float("inf"), 0.5], [0.0, 0.0]) is False
    assert law.balance([float("nan"), 0.5]) == [0.0, 0.0]
    lower, _ = law.bounds(0.0)
    q = [lower[0] - 0.1, 0.5]
    law.init(q, [0.0, 0.0])
    assert law.step(0.0, q, [0.0, 0.0])[1] & FLAGS["outside"]


def test_gains_are_set_by_their_paths_within_their_ranges(law, package):
    scenario = package.scenario
    for values, words in (
        ([2.0], "got 1 numbers, expected 2"),
        ([0.9, 2.0], "got 0.9, expected a number from 1 to 4"),
        ([2.0, 3.6], "got 3.6, expected a number from 1.5 to 3.5"),
        ([float("nan"), 2.0], "got nan"),
    ):
        assert_refused(words, law.set_gain, "controller.K2", values)
    assert law.gain("controller.K2") == [2.0, 2.0] and law.gain("controller.k1") == [1.0]
    assert law.gain("observer.kf[1]") == [3.0]
    law.set_gain("controller.K2", [3.0, 2.5])
    law.set_gain("controller.k1", [2.0])
    law.set_gain("observer.kf[1]", [8.0])
    changed = {"controller.K2": [3.0, 2.5], "controller.k1": 2.0, "observer.kf[1]": 8.0}
    run = ij.simulate(ij.with_parameters(scenario, changed), duration=0.1, dt=1e-3, record_every=10)
    law.init(run.measured.q[0].tolist(), run.measured.dq[0].tolist())
    for k in range(10):
        q, dq = run.measured.q[k].tolist(), run.measured.dq[k].tolist()
        torque, status = law.step(float(run.t[k]), q, dq)
        assert status == 0
        np.testing.assert_allclose(torque, run.tau[k], rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"name": "other_law"}, "got no law 'other_law'"),
        ({"joints": ["a", "b", "c"]}, "got 2 joints, expected 3"),
        ({"period": 0.02}, "got the period 0.01 s, expected 0.02 s"),
        ({"gains": None}, "got no \\['gains'\\]"),
    ],
)
def test_a_library_of_another_law_is_refused(package, tmp_path, change, words):
    folder = tmp_path / NAME
    shutil.copytree(package.modules / NAME, folder)
    content = json.loads((folder / "law.json").read_text()) | change
    content = {name: value for name, value in content.items() if value is not None}
    (folder / "law.json").write_text(json.dumps(content))
    assert_refused(words, load_law, folder)


def test_the_package_is_complete_and_needs_neither_this_package_nor_jax(package):
    root = xml.etree.ElementTree.parse(package.source / "package.xml").getroot()
    assert root.findtext("name") == NAME and root.findtext("export/build_type") == "ament_python"
    assert (package.source / "resource" / NAME).read_text() == ""
    installed = package.prefix
    assert (installed / "share/ament_index/resource_index/packages" / NAME).is_file()
    for file in ("package.xml", f"launch/{NAME}.launch.py", f"config/{NAME}.yaml"):
        assert (installed / "share" / NAME / file).is_file()
    assert (installed / "lib" / NAME / "law_node").is_file()
    for path in (package.modules / NAME).glob("*.py"):
        assert "iblf_jax" not in path.read_text().replace("generated by iblf_jax", ""), path
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                assert str(node.module).split(".")[0] not in {"jax", "numpy"}
    content = yaml.safe_load((package.source / "config" / f"{NAME}.yaml").read_text())
    assert list(content) == ["/**"], "the file holds for a node in a namespace too"
    values = content["/**"]["ros__parameters"]
    expected = {"period": 0.01, "torque_limits": [40.0, 15.0], "joints": ["joint_1", "joint_2"]}
    expected |= {"controller.K2": [2.0, 2.0], "controller.k1": 1.0, "observer.kf[1]": 3.0}
    expected |= {"start_automatically": False, "start_outside_bounds": False}
    expected |= {"state_timeout": 0.02, "arrival_timeout": 0.5}
    assert {name: values[name] for name in expected} == expected
    assert values["time_origin"] != values["time_origin"]
    assert all(isinstance(x, float) for x in values["hold_stiffness"] + values["hold_damping"])
    assert_refused("got no shared library of the law", load_law, package.source / NAME)


@pytest.mark.slow
def test_the_own_test_of_the_package_passes(package):
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test"]
    environment = {"PYTHONPATH": str(package.modules), "PATH": "/usr/bin:/bin"}
    place = {"cwd": package.source, "env": environment}
    done = subprocess.run(command, capture_output=True, text=True, check=False, **place)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "4 passed" in done.stdout


def test_the_launch_file_starts_the_node(package, monkeypatch):
    """There is no wheel of `launch`: its classes are replaced by records of their arguments."""

    def record(name):
        return lambda *args, **options: (name, args, options)

    def module(name, **members):
        found = types.ModuleType(name)
        vars(found).update(members)
        monkeypatch.setitem(sys.modules, name, found)

    share = package.prefix / "share" / NAME
    module("ament_index_python.packages", get_package_share_directory=lambda name: str(share))
    module("launch", LaunchDescription=lambda actions: actions)
    module("launch.actions", DeclareLaunchArgument=record("argument"))
    module("launch.substitutions", LaunchConfiguration=record("configuration"))
    module("launch_ros.actions", Node=record("node"))
    namespace: dict = {}
    path = share / "launch" / f"{NAME}.launch.py"
    exec(compile(path.read_text(), str(path), "exec"), namespace)
    argument, *topics, node = namespace["generate_launch_description"]()
    assert argument[1] == ("parameters",)
    assert argument[2]["default_value"] == str(share / "config" / f"{NAME}.yaml")
    assert (share / "config" / f"{NAME}.yaml").is_file()
    assert (node[2]["package"], node[2]["executable"]) == (NAME, "law_node")
    assert node[2]["parameters"] == [("configuration", ("parameters",), {})]
    names = ["joint_states", "efforts", "diagnostics"]
    assert [(x[1][0], x[2]["default_value"]) for x in topics] == [(x, x) for x in names]
    assert node[2]["remappings"] == [(x, ("configuration", (x,), {})) for x in names]


class FakeNode:
    """A node of rclpy whose messages arrive at once."""

    parameters: ClassVar = {"joints": JOINTS, "trigger": "state"}
    topics: ClassVar = collections.defaultdict(mock.MagicMock)

    def __init__(self, name, **options):
        self.get_name, self.count_publishers, self.services = lambda: name, lambda topic: 1, {}

    def __getattr__(self, name):
        return mock.MagicMock()

    def declare_parameter(self, name, default, descriptor):
        return Record(value=self.parameters.get(name, default))

    def create_publisher(self, kind, topic, depth):
        return mock.MagicMock(publish=lambda message: self.topics[topic](message))

    def create_subscription(self, kind, topic, callback, quality):
        more = [{"publisher_gid": {"data": b"1"}}] if topic == "joint_states" else []
        self.topics[topic] = lambda message: callback(message, *more)
        return mock.MagicMock(topic_name=topic)

    def create_service(self, kind, name, callback):
        self.services[name] = callback


def test_the_node_moves_a_simulated_robot_as_its_law_does_in_mujoco(law, package, monkeypatch):
    """There are wheels of `rclpy` for one Python only: it is replaced."""
    mujoco = pytest.importorskip("mujoco")
    path = ROOT / "iblf_jax" / "deployment" / "ros2" / "node" / "law_node.py"
    ros = mock.MagicMock(Node=FakeNode, create_node=FakeNode, KeyValue=Record)
    ros.msg, ros.Float64MultiArray, ros.SetParametersResult = ros, Record, Record
    ros.JointState = lambda name: Record(name=name, header=Record(stamp=Record()))
    packages = r"rclpy|diagnostic_msgs|rcl_interfaces|sensor_msgs|std_msgs|std_srvs"
    for name in re.findall(rf"^from ((?:{packages})\.\w+) import", path.read_text(), re.MULTILINE):
        for module in (name, name.partition(".")[0], "rclpy.experimental"):
            monkeypatch.setitem(sys.modules, module, ros)
    monkeypatch.setattr(simulated_robot, "DISCOVERY_TIME", 0.0)
    node = runpy.run_path(str(path))["LawNode"](law)
    arm, start = ROOT / "examples" / "two_link.xml", ij.Initial(q=[0.55, 0.45])
    robot = ij.deployment.robot_node(arm, JOINTS, period=ros_package.PERIOD, dt=1e-3, initial=start)
    answer, states = node.topics["joint_states"], []

    def start_after_two(state):
        states.append(answer(state))
        if len(states) == 2:
            assert node.services["~/start"](None, Record()).success

    node.topics["joint_states"] = start_after_two
    motion = robot.run(0.1)
    model, own = mujoco.MjModel.from_xml_path(str(arm)), load_law(package.modules / NAME)
    model.opt.timestep, model.opt.integrator = 1e-3, mujoco.mjtIntegrator.mjINT_RK4
    data = mujoco.MjData(model)
    data.qpos[:] = start.q
    own.init(data.qpos.tolist(), [0.0, 0.0])
    for k in range(100):
        if k % 10 == 0:  # t = 0 is the last state before the start
            state = data.qpos.tolist(), data.qvel.tolist()
            data.qfrc_applied[:], _ = own.step(1e-3 * (k + 10), *state)
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(motion.q[motion.instant][-1], data.qpos, rtol=1e-9)
    node._publish_diagnostics()
    shown = {value.key: value.value for value in node._values}
    assert (shown["mode"], shown["samples"], shown["missed_periods"]) == ("running", "13", "0")
    assert node._status.level is ros.DiagnosticStatus.OK
    assert motion.origin == 2.0 * float(shown["time_origin [s]"]) == 2.0 * ros_package.PERIOD
    changes = [Record(name="controller.K2", value=x) for x in ([3.0, 2.5], [9.0, 9.0])]
    assert [node._refuse_parameters([x]).successful for x in changes] == [True, False]
    node._apply_parameters(changes[:1])
    assert law.gain("controller.K2") == [3.0, 2.5]
    for name, mode in (("hold", "holding"), ("stop", "stopped")):
        assert node.services[f"~/{name}"](None, Record()).success
        assert node.supervisor.mode.value == mode
    node.send_final_command()
    np.testing.assert_array_equal(robot.arrivals[-1].effort, [0.0, 0.0])


def plain() -> ij.Scenario:
    return ij.presets.zhang_yan_2024()


def tunable(*words, **options):
    return {"gains": [ij.tunable("controller.K2", *words, **options)]}


REFUSED = [
    ({"torque_limits": None}, "torque_limits: got None.*`effort`"),
    ({"torque_limits": -1.0}, "torque_limits: got -1"),
    ({"torque_limits": [1.0, 0.0]}, "torque_limits: got"),
    ({"period": None}, "period: got None"),
    ({"on_fault": "brake"}, "on_fault: got 'brake'"),
    ({"gains": ["controller.K3"]}, "controller.K3.*Did you mean"),
    ({"gains": ["sampling.period"]}, "gains: got 'sampling.period'"),
    (tunable(50.0, 60.0), r"tunable\('controller.K2'\): got"),
    (tunable(-5.0, 60.0, scale="linear"), "controller.K2"),
    ({"gains": ["controller.K2", "controller.K2[0]"]}, "gains: got.*overlap"),
    ({"gains": [1.0]}, r"gains\[0\]: got 1.0"),
    ({"dtype": "float"}, "dtype: got 'float'"),
    ({"reference": "given"}, "reference: got 'given'"),
    # Options of a loop.
    *(({name: x}, f"{name}: got {x!r}") for name, x in (("method", "heun"), ("seed", 1))),
    ({"method": "euler"}, "method: got 'euler'"),
    # No names of a package of ROS; `json` is a module of Python.
    *(({"name": name}, f"name: got '{name}'") for name in ("ArmLaw", "arm__law", "json")),
    # Options of a node for other targets.
    *(
        ({"target": target, "torque_limits": None} | option, 'Only target="ros2" has this option')
        for target, option in (
            ("c", {"gains": ["controller.K2"]}),
            ("fmu", {"torque_limits": 5.0}),
            ("fmu-loop", {"on_fault": "zero"}),
            ("wasm", {"on_fault": "zero"}),
        )
    ),
]


def test_what_the_export_refuses_and_limits_below_gravity_are_reported(tmp_path):
    given = {"target": "ros2", "period": 0.01, "torque_limits": 100.0}
    for options, words in REFUSED:
        assert_refused(words, ij.export, plain(), tmp_path / "arm", **given | options)
    uneven = ij.with_parameters(plain(), {"controller.K2": [20.0, 30.0]})
    with pytest.raises(ValueError, match="equal numbers for a tied gain"):
        ij.export(uneven, tmp_path / "arm", **given, **tunable(5.0, 60.0, tied=True))
    assert not (tmp_path / "arm").exists()
    scenario = ros_package.law_scenario()
    assert np.abs(scenario.model.gravity(scenario.initial.q))[0] > 1.0
    with pytest.warns(UserWarning, match=r"gravity takes up to .* clips at \[ 1. 15.\]"):
        ij.export(scenario, tmp_path, target="ros2", torque_limits=[1.0, 15.0])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the simulated run")
def test_levels_beyond_q_and_dq_gains_of_the_plant_and_limits_above_the_model_are_refused(tmp_path):
    options = {"target": "ros2", "period": 0.01, "torque_limits": 100.0}
    with pytest.raises(ValueError, match=r"scenario.model: got .*a robot, whose state is q and q'"):
        ij.export(ij.presets.motor_driven_two_link(), tmp_path, **options)
    with pytest.raises(ValueError, match="gains: got"):
        ij.export(plain(), tmp_path, gains=[ij.tunable("plant.mass", 0.1, 9.0)], **options)
    scenario = canonical(ij.with_parts(ij.presets.iiwa14(), sampling=ij.Sampling(2e-3)))
    effort = np.asarray(scenario.model.effort)
    options = ros_options(scenario, None, None, "hold")
    np.testing.assert_allclose(options.torque_limits, effort)
    with pytest.raises(ValueError, match="at most the model's efforts"):
        ros_options(scenario, None, 1.01 * effort, "hold")


@pytest.mark.slow
def test_ranges_without_limits_are_those_of_tune_and_not_simulated(package):
    scenario = canonical(package.scenario)
    with pytest.warns(UserWarning, match=r"controller.K2: the range .* default end.*simulated"):
        options = ros_options(scenario, ["controller.K2"], 100.0, "zero")
    gain = options.gains[0]
    assert np.all(gain.low < gain.value) and np.all(gain.value < gain.high)
    assert np.all(np.isfinite(gain.high))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ros_options(scenario, [ij.tunable("controller.K2", 1.0, 4.0)], 100.0, "zero")


HOSTILE = {
    "quotes and backslashes": ("a\"b'c\\", '\\"""\\n'),
    "comments of C": ("*/ int x; /*", "// ??/ ??' \\"),
    "templates of Python and shells": ("${name}$(touch x)`touch y`", "{{a}}{% b %} %s {0}"),
    "YAML": ("a: b # c", "!!python/object/apply:os.system ['x']"),
    "more YAML": ("[1, 2", "- &a *b |"),
    "numbers and words of YAML": ("1e3", "null"),
    "tables and marks of Markdown": ("a | b \\| c", "**`` <b> ](x) &amp; $"),
    "spaces at the ends": (" a ", " "),
    "beyond ASCII": ("épaule_关节", "joint 😀 \U0002070e"),
    "the same as names of C": ("a-b", "a_b"),
    "long": ("x" * 450, "y|" * 225),
}
FINE_IN_C = ("YAML", "more YAML", "numbers and words of YAML", "spaces at the ends")
"""Cases whose names have nothing that is special in C."""


def named_scenario(joints, links=("upper", "lower")):
    arm = ij.robots.Arm(
        mass=[2.0, 1.0],
        centre=[[0.0, 0.0, 0.1]] * 2,
        inertia=[[0.02, 0.02, 0.02, 0.0, 0.0, 0.0]] * 2,
        position=[[0.0, 0.0, 0.3], [0.4, 0.0, 0.0]],
        axis=[0.0, 1.0, 0.0],
        joints=joints,
        links=links,
    )
    parts = {"observer": ij.observers.NoObserver(), "sampling": ij.Sampling(ros_package.PERIOD)}
    scenario = ij.with_parts(plain(), controller=ij.controllers.PDGravity(Kp=5.0, Kd=1.0), **parts)
    return canonical(dataclasses.replace(scenario, plant=arm, model=arm))


@pytest.fixture(scope="module")
def named():
    """The law of the arm with names; its program does not depend on them."""
    scenario = named_scenario(("a", "b"))
    return control_law(scenario, False), vectors(scenario, False)


def rendered_rows(text):
    """The texts of the cells of the tables in a Markdown page, row by row."""
    tokens = pytest.importorskip("markdown_it").MarkdownIt("commonmark").enable("table").parse(text)
    rows = [[]]
    for before, token in itertools.pairwise(tokens):
        if token.type == "tr_open":
            rows.append([])
        if before.type in ("td_open", "th_open"):
            assert {x.type for x in token.children} <= {"text", "code_inline", "html_inline"}
            tags = [x.content for x in token.children if x.type == "html_inline"]
            assert tags == ["<code>", "</code>"] * (len(tags) // 2)
            plain = [x.content for x in token.children if x.type != "html_inline"]
            rows[-1].append("".join(plain))
    return rows


@pytest.mark.slow
@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_names_of_joints_and_links_stay_text(case, named, tmp_path):
    joints = HOSTILE[case]
    # A link's name is a part of a path, in which brackets have a meaning.
    links = tuple("link" + re.sub(r"[\[\],]", "", x) for x in joints)
    scenario = named_scenario(joints, links)
    programs, recorded = named
    law = Law(scenario, programs, "hostile_law", False, recorded, joints, None)
    path = f"model.link[{links[0]}].mass"
    options = ros_options(scenario, [ij.tunable(path, 1.0, 4.0)], 50.0, "zero")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        files = write_package(law, generate(law), options, tmp_path)
    controller = tmp_path / "hostile_law_controller"
    configuration = (tmp_path / "config" / "hostile_law.yaml").read_text(encoding="utf-8")
    values = yaml.safe_load(configuration)["/**"]["ros__parameters"]
    assert values["joints"] == list(joints) and values[path] == 2.0
    text = (controller / "config" / "controllers.yaml").read_text(encoding="utf-8")
    values = yaml.safe_load(text)["hostile_law_controller"]["ros__parameters"]
    assert values["joints"] == list(joints) and values[path] == [2.0]
    assert read_description(tmp_path / "hostile_law" / "law.json").joints == joints
    for file in files:
        if file.endswith(".py"):
            compile((tmp_path / file).read_text(encoding="utf-8"), file, "exec")
        if file.endswith(".xml"):
            xml.etree.ElementTree.parse(tmp_path / file)
    readme = (tmp_path / "README.md").read_text(encoding="utf-8")
    rows = rendered_rows(readme)
    assert [row[0] for row in rows[-2:]] == list(joints)
    assert [len(row) for row in rows[-2:]] == [3, 3]
    rows = rendered_rows((controller / "README.md").read_text(encoding="utf-8"))
    (row,) = [row for row in rows if row[:1] == ["commands"]]
    assert row[1] == f"effort of {', '.join(joints)}"
    (command,) = [x for x in readme.splitlines() if x.startswith("    ros2 param set")]
    assert shlex.split(command)[3:] == ["/hostile_law", path, "2.0"]
    source = controller / "src"
    law_c = (tmp_path / "c" / "hostile_law.c").read_text(encoding="utf-8")
    assert (source / "hostile_law.c").read_text(encoding="utf-8") == law_c
    if case in FINE_IN_C:
        return
    flags = ["-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fsyntax-only", "-trigraphs"]
    sources = sorted((tmp_path / "c").glob("*.c"))
    subprocess.run(["cc", "-std=c99", *flags, "-Wno-trigraphs", *sources], check=True)
    include = controller / "include"
    flags += ["-I", include, "-I", include / "hostile_law_controller"]
    flags += ["-isystem", ROOT / "tests" / "deployment" / "ros2" / "stubs"]
    subprocess.run(["c++", "-std=c++17", *flags, source / "law_controller.cpp"], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*(f"a{x}b" for x in "\n\t\0\x7f\u2028\ud83d\u202e"), "x" * 501])
def test_names_that_are_not_printable_are_refused(name):
    words = "got .*expected at most 500 characters.*printable.*Rename the"
    with pytest.raises(ValueError, match=f"joints: {words} joint") as error:
        ros_options(named_scenario(("a", name)), None, 50.0, "zero")
    assert repr(name)[:20] in str(error.value)
    gains = [ij.tunable(f"model.link[link{name}].mass", 1.0, 4.0)]
    with pytest.raises(ValueError, match=f"gains: {words} link"):
        ros_options(named_scenario(("a", "b"), ("c", f"link{name}")), gains, 50.0, "zero")


@pytest.mark.slow
def test_a_law_that_filters_velocities_needs_none_also_from_the_command_line(tmp_path, capsys):
    encoder = ij.sensors.Encoder(counts=4096, velocity=members.VELOCITIES["filtered_difference"])
    scenario = ij.with_parts(plain(), sensor=encoder, sampling=ij.Sampling(0.01))
    ij.export(scenario, tmp_path / "src", target="ros2", name="encoder_law", torque_limits=100.0)
    ros_package.install(tmp_path / "src", tmp_path / "install")
    law = load_law(ros_package.site_packages(tmp_path / "install") / "encoder_law")
    assert law.description.reads_velocity is False
    assert law.init([0.5, 0.5], None)
    torque, status = law.step(0.0, [0.5, 0.5], None)
    assert status == 0 and np.all(np.isfinite(torque))
    words = f"export zhang_yan_2024 --target ros2 --period 0.01 --name cli_law --out {tmp_path}"
    words += " --torque-limits 400 90 --on-fault zero --gain controller.K2=5"
    assert cli.main(words.split()) == 2
    assert "PATH or PATH=LOW:HIGH" in capsys.readouterr().err
    assert cli.main(f"{words}:50".split()) == 0
    found = json.loads((tmp_path / "cli_law" / "law.json").read_text())
    assert (found["torque_limits"], found["on_fault"]) == ([400.0, 90.0], "zero")
    assert found["gains"][0]["high"] == [50.0, 50.0]


NO_PARAMETERS = types.SimpleNamespace(fields=())
NO_C = types.SimpleNamespace(files={"arm.h": "", "arm.c": ""}, parameters=NO_PARAMETERS)
DESCRIPTION = {"joints": ["shoulder", "elbow"], "has_joint_names": True, "reads_velocity": False}
DESCRIPTION |= {"torque_limits": [50.0, 20.0], "on_fault": "hold", "gains": []}
DESCRIPTION |= {"hold_stiffness": [3.0, 2.0], "hold_damping": [0.5, 0.25]}


@pytest.mark.parametrize(("period", "rate"), [(1e-3, 1000), (2e-3, 500), (0.02, 50), (1 / 3, 3)])
def test_period_rate_joints_and_limits_are_those_of_the_law(period, rate):
    scenario = ij.with_parts(ij.presets.zhang_yan_2024(), sampling=ij.Sampling(period))
    law = types.SimpleNamespace(name="arm", scenario=scenario)
    found = ros2_control_files(law, NO_C, DESCRIPTION)
    source = found["src/law_controller.cpp"]
    assert f"kPeriod = {period!r};" in source
    assert f"kPeriodNanoseconds = {round(period * 1e9)};" in source
    assert f"kRate = {rate};" in source and 'kNames = {"shoulder", "elbow"};' in source
    assert "kTorqueLimits = {50.0, 20.0};" in source and "kHoldStiffness = {3.0, 2.0};" in source
    assert "kHoldDamping = {0.5, 0.25};" in source and "kReadsVelocity = false;" in source
    parameters = found["config/controllers.yaml"]
    assert parameters.count(f"update_rate: {rate}\n") == 2
    assert "torque_limits: [50.0, 20.0]" in parameters
