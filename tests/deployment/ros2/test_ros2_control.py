"""The generated controller of ros2_control, compiled against stubs of its headers and driven by a
harness: torques of the package, limits, faults, parameters, and no allocation in `update`."""

import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import jax
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.deployment.control_law import control_law, inputs_at_start, sample, start
from iblf_jax.deployment.export import vectors
from iblf_jax.deployment.ros2.ros2_control import cpp_string, ros2_control_files
from iblf_jax.deployment.write_c import CHECK_INTERVAL, Law, generate
from iblf_jax.simulation.scenario import canonical

HERE = Path(__file__).parent
FLAGS = ("-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wconversion", "-Wshadow")
SANE = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover")
PERIOD = 2e-3
NANOSECONDS = 2_000_000
JOINTS = ("joint_1", "joint_2")
JUMP = 3 * NANOSECONDS
UNTOUCHED = 123.5
"""What an effort of the harness is before the first command."""

HAS_COMPILERS = shutil.which("c++") and shutil.which("cc")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not HAS_COMPILERS, reason="there is no compiler of C and C++"),
]


class Built:
    """A law, its package, and the harness around its controller."""

    def __init__(self, folder, scenario, *, flags=(), like=None, **changes):
        """`like` is one for the same scenario, whose law and self-test vectors are used again."""
        self.scenario = canonical(scenario)
        if like is None:
            self.vectors = vectors(self.scenario, False)
            programs = control_law(self.scenario, False)
            self.law = Law(self.scenario, programs, "iblf_law", False, self.vectors, (), None)
            self.generated = generate(self.law)
        else:
            self.vectors, self.law, self.generated = like.vectors, like.law, like.generated
        fields = self.generated.parameters.fields
        number = [field.path for field in fields].index("controller.K2")
        first = sum(field.value.size for field in fields[:number])
        gain = {"path": "controller.K2", "unit": "N m s/rad", "offsets": [[first], [first + 1]]}
        self.description = {
            "joints": list(JOINTS),
            "has_joint_names": False,
            "reads_velocity": "dq" not in self.law.unread_levels,
            "torque_limits": [500.0, 400.0],
            "on_fault": "hold",
            "hold_stiffness": [3.0, 2.0],
            "hold_damping": [0.5, 0.25],
            "gains": [gain | {"low": [5.0, 5.0], "high": [20.0, 20.0]}],
            **changes,
        }
        self.files = ros2_control_files(self.law, self.generated, self.description)
        self.package = folder / "package"
        for name, text in self.files.items():
            (self.package / name).parent.mkdir(parents=True, exist_ok=True)
            (self.package / name).write_text(text, encoding="utf-8")
        self.program = folder / "harness"
        include = self.package / "include"
        own = ("-I", include / "iblf_law_controller")
        paths = [*own, "-I", include, "-isystem", HERE / "stubs"]
        objects = [folder / "law.o", folder / "controller.o"]
        sources = self.package / "src"
        compiler = ["c++", "-std=c++17", *flags]
        harness = HERE / "ros2_control_harness.cpp"
        for command in (
            ["cc", "-std=c99", "-O1", *own, "-c", sources / "iblf_law.c", "-o", objects[0]],
            [*compiler, *FLAGS, *paths, "-c", sources / "law_controller.cpp", "-o", objects[1]],
            [*compiler, *paths, harness, *objects, "-o", self.program],
        ):
            subprocess.run(command, check=True)

    def states(self, q, dq):
        pairs = zip(q, dq, strict=True) if self.description["reads_velocity"] else ((x,) for x in q)
        return " ".join(f"{float(x)!r}" for pair in pairs for x in pair)

    def activated(self, *parameters):
        kinds = ("position", "velocity") if self.description["reads_velocity"] else ("position",)
        names = " ".join(f"{x}/{kind}" for x in JOINTS for kind in kinds)
        names += "".join(f" {x}/effort" for x in JOINTS)
        return ["rate 500", *parameters, "init", "configure", f"activate {names}"]

    def update_commands(self, updates):
        return [f"update {t} {self.states(q, dq)}" for t, q, dq in updates]

    def answers(self, commands):
        given = "\n".join(commands) + "\n"
        done = subprocess.run([self.program], input=given, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    def efforts(self, updates, *parameters):
        """The efforts of updates (time [ns], q, dq), (K, n)."""
        commands = [*self.activated(*parameters), *self.update_commands(updates)]
        return efforts_of(self.answers(commands))

    def law_torques(self, updates, **values):
        """The torques of the package for the same samples, by JAX, (K, n)."""
        scenario = ij.with_parameters(self.scenario, values)
        t, q, dq = (np.array(x) for x in zip(*updates, strict=True))
        first = inputs_at_start(scenario)._replace(q=q[0], dq=dq[0])
        state, found, step = start(scenario, first)[0], [], jax.jit(sample)
        for k in range(len(t)):
            inputs = first._replace(t=1e-9 * (t[k] - t[0]), q=q[k], dq=dq[k])
            state, outputs = step(scenario, inputs, state)
            found.append(np.asarray(outputs.tau))
        return np.array(found)


def efforts_of(lines):
    """The efforts of all updates, which must not allocate."""
    rows = [line.split() for line in lines if line.startswith("update ")]
    assert all(row[1] == "OK" and row[-2:] == ["allocations", "0"] for row in rows), lines
    return np.array([[float(x) for x in row[2:-2]] for row in rows])


def logged(lines):
    return [line.removeprefix("log ") for line in lines if line.startswith("log ")]


@pytest.fixture(scope="module")
def scenario():
    parts = {"controller": ij.controllers.Backstepping(k1=2.0, K2=10.0, o=0.1)}
    return ij.with_parts(ij.presets.zhang_yan_2024(), sampling=ij.Sampling(PERIOD), **parts)


@pytest.fixture(scope="module")
def built(scenario, tmp_path_factory):
    return Built(tmp_path_factory.mktemp("controller"), scenario, flags=SANE)


@pytest.fixture(scope="module")
def updates(built):
    v = built.vectors
    return [(10**15 + NANOSECONDS * k, v.q[k], v.dq[k]) for k in range(3000)]


def test_the_efforts_are_the_torques_of_the_package(scenario, built, updates, tmp_path):
    """Those of the self-test, whose start is not rounded, and those of the samples by JAX."""
    found = built.efforts(updates)
    expected = built.vectors.tau[: len(updates) // CHECK_INTERVAL]
    largest = np.abs(expected).max()
    np.testing.assert_allclose(found[::CHECK_INTERVAL], expected, atol=1e-5 * largest)
    np.testing.assert_allclose(found[:500], built.law_torques(updates[:500]), atol=1e-11 * largest)
    humble = Built(tmp_path, scenario, flags=["-DSTUB_OF_HUMBLE"], like=built)
    np.testing.assert_array_equal(humble.efforts(updates[:50]), built.efforts(updates[:50]))


def test_a_law_that_does_not_read_velocities_does_not_claim_them(scenario, tmp_path):
    encoder = ij.sensors.Encoder(counts=65536, velocity=ij.sensors.FilteredDifference(cutoff=200.0))
    built = Built(tmp_path, ij.with_parts(scenario, sensor=encoder))
    assert not built.description["reads_velocity"]
    lines = built.answers(["rate 500", "init", "configure", "names"])
    claimed = [line.removeprefix("names ").split() for line in lines if line.startswith("names")]
    assert claimed == [[f"{x}/effort" for x in JOINTS], [f"{x}/position" for x in JOINTS]]
    updates = [(NANOSECONDS * k, x, np.zeros(2)) for k, x in enumerate(built.vectors.q[:200])]
    found, expected = built.efforts(updates), built.law_torques(updates)
    np.testing.assert_allclose(found, expected, atol=1e-11 * np.abs(expected).max())
    assert "velocity`" not in built.files["README.md"]


def test_interfaces_in_any_order_give_complete_states_at_new_times(built, updates):
    lines = built.answers(["rate 500", "init", "configure", "names"])
    assert lines[2:] == [
        "names joint_1/effort joint_2/effort",
        "names joint_1/position joint_1/velocity joint_2/position joint_2/velocity",
    ]
    lines = built.answers(["rate 500", "init", "configure", "activate joint_1/effort"])
    assert "activate ERROR" in lines
    assert any("joint_2/effort: got no such interface" in line for line in lines)
    names = "joint_2/velocity joint_1/position joint_2/position joint_1/velocity"
    efforts = "joint_2/effort joint_1/effort"
    commands = ["rate 500", "init", "configure", f"activate {names} {efforts}"]
    for t, q, dq in updates[:20]:
        values = " ".join(repr(float(x)) for x in (dq[1], q[0], q[1], dq[0]))
        commands.append(f"update {t} {values}")
    found = efforts_of(built.answers(commands))
    np.testing.assert_array_equal(found[:, ::-1], built.efforts(updates[:20]))
    nan = float("nan")
    _, q, dq = updates[0]
    before = [(0, [nan, q[1]], dq), (1, q, [dq[0], nan]), (2, [q[0], np.inf], dq)]
    found = built.efforts([*before, *updates[:10]])
    np.testing.assert_array_equal(found[:3], UNTOUCHED)
    np.testing.assert_array_equal(found[3:], built.efforts(updates[:10]))
    found = built.efforts([x for x in updates[:10] for _ in range(2)])
    np.testing.assert_array_equal(found[::2], built.efforts(updates[:10]))
    np.testing.assert_array_equal(found[1::2], found[::2])


def hold_torque(built, q, q_hold, dq, is_fresh):
    tau = np.asarray(built.scenario.model.gravity(np.asarray(q)))
    if is_fresh:
        stiffness, damping = (built.description[f"hold_{x}"] for x in ("stiffness", "damping"))
        tau = tau + np.array(stiffness) * (np.array(q_hold) - q) - np.array(damping) * dq
    return tau


def faulty(updates):
    """Faults with updates whose last four are in fault."""
    nan, velocity = ([[t, q.copy(), dq.copy()] for t, q, dq in updates[:20]] for _ in range(2))
    nan[16][1][0] = np.nan
    velocity[16][2][1] = -np.inf
    before, after = updates[:16], updates[16:20]
    late, back = ([*before, *((t + jump, q, dq) for t, q, dq in after)] for jump in (JUMP, -JUMP))
    not_finite = [("a state is not finite", x) for x in (nan, velocity)]
    return [*not_finite, ("more than two periods passed", late), ("the time jumped back", back)]


@pytest.mark.parametrize("case", range(4))
@pytest.mark.parametrize("policy", ["hold", "zero"])
def test_a_fault_leads_to_the_torques_of_the_policy(case, policy, built, updates):
    reason, samples = faulty(updates)[case]
    steps = [*built.update_commands(samples), "timer", "timer"]
    lines = built.answers([*built.activated(f"text on_fault {policy}"), *steps])
    found = efforts_of(lines)
    np.testing.assert_array_equal(found[:16], built.efforts(updates[:16]))
    (message,) = logged(lines)
    assert message.startswith(f"fault: {reason}")
    if policy == "zero":
        np.testing.assert_array_equal(found[16:], 0.0)
        return
    last = np.asarray(samples[15][1])
    hold = last if case < 2 else np.asarray(samples[16][1])
    for k in range(16, 20):
        q, dq = np.asarray(samples[k][1]), np.asarray(samples[k][2])
        is_finite = bool(np.all(np.isfinite([*q, *dq])))
        expected = hold_torque(built, q if is_finite else last, hold, dq, is_finite)
        np.testing.assert_allclose(found[k], expected, atol=1e-12)


def test_a_torque_that_is_not_finite_is_a_fault(built, updates):
    """Positions of 1e300 rad are finite, but not the law at them; gravity is."""
    samples = [list(x) for x in updates[:6]]
    samples[3][2] = np.array([1e300, 1e300])
    steps = built.update_commands(samples)
    lines = built.answers([*built.activated("text on_fault zero"), *steps, "timer"])
    np.testing.assert_array_equal(efforts_of(lines)[3:], 0.0)
    assert logged(lines)[0].startswith("fault: the law has no finite torque")
    held = efforts_of(built.answers([*built.activated(), *steps]))
    assert np.all(np.isfinite(held)) and np.all(np.abs(held) <= [500.0, 400.0])


@pytest.mark.parametrize("policy", ["hold", "zero"])
def test_a_start_outside_of_the_bounds_is_a_fault(policy, built, updates):
    """The first sample is outside by 1 rad, the later ones are inside."""
    samples = [(t, np.asarray(q), np.asarray(dq)) for t, q, dq in updates[:6]]
    samples[0] = (samples[0][0], samples[0][1] + [0.0, 1.0], samples[0][2])
    steps = built.update_commands(samples)
    lines = built.answers([*built.activated(f"text on_fault {policy}"), *steps, "timer"])
    (message,) = logged(lines)
    assert message.startswith("fault: a joint is outside of its bounds at the start. Move")
    expected = np.zeros((6, 2))
    if policy == "hold":
        held = samples[0][1]
        expected = [hold_torque(built, q, held, dq, True) for _, q, dq in samples]
    np.testing.assert_allclose(efforts_of(lines), expected, atol=1e-12)
    lines = built.answers([*built.activated("flag start_outside_bounds"), *steps, "timer"])
    assert not logged(lines)
    torques = np.clip(built.law_torques(samples), [-500.0, -400.0], [500.0, 400.0])
    np.testing.assert_allclose(efforts_of(lines), torques, rtol=1e-9, atol=1e-9)


def test_torques_are_clipped_last_and_only_a_new_activation_leaves_a_fault(built, updates):
    free = built.efforts(updates[:400])
    limits = 0.5 * np.abs(free).max(axis=0)
    text = " ".join(f"{x!r}" for x in limits.tolist())
    found = built.efforts(updates[:400], f"numbers torque_limits {text}")
    np.testing.assert_array_equal(found, np.clip(free, -limits, limits))
    assert np.any(np.abs(free) > limits)
    # The torques of a fault too.
    _, samples = faulty(updates)[2]
    found = built.efforts(samples, "numbers torque_limits 0.1 0.01")
    np.testing.assert_array_equal(np.abs(found[16:]), [[0.1, 0.01]] * 4)
    samples = [list(x) for x in updates[:6]]
    samples[3][1] = np.array([np.nan, 0.5])
    steps = built.update_commands(samples)
    good = built.update_commands(updates[:10])
    commands = built.activated("text on_fault zero")
    lines = built.answers([*commands, *steps, "deactivate", commands[-1], *good])
    assert "efforts 0 0" in lines
    found = efforts_of(lines)
    np.testing.assert_array_equal(found[3:6], 0.0)
    np.testing.assert_array_equal(found[6:], built.efforts(updates[:10]))


def test_parameters_are_read_when_the_controller_is_configured_only(built, updates):
    changed = built.efforts(updates[:50], "numbers controller.K2 6.0 15.0")
    assert not np.allclose(changed, built.efforts(updates[:50]))
    expected = built.law_torques(updates[:50], **{"controller.K2": np.array([6.0, 15.0])})
    np.testing.assert_allclose(changed, expected, atol=1e-11 * np.abs(expected).max())
    commands = built.activated()
    change = "change controller.K2 6.0 15.0"
    limits, other = "change torque_limits 1.0 1.0", "change use_sim_time 1.0"
    lines = built.answers([*commands, change, limits, other, "deactivate", change])
    changes = [line for line in lines if line.startswith("change")]
    reason = ": it is read when the controller is configured. Deactivate it and clean it up first."
    refused = f"change ERROR controller.K2{reason}"
    assert changes == [refused, f"change ERROR torque_limits{reason}", "change SUCCESS", refused]
    steps = built.update_commands(updates[:10])
    again = ["deactivate", "cleanup", change, "configure", commands[-1]]
    lines = built.answers([*commands, *again, *steps])
    assert "change SUCCESS" in lines
    np.testing.assert_array_equal(efforts_of(lines), changed[:10])


REFUSED = [
    ("rate 0", "update_rate: got 0 Hz, expected 500 Hz, the rate of the exported period. Set"),
    ("texts joints a a", "joints: got [a, a], expected 2 different names"),
    ("numbers torque_limits 1 nan", "torque_limits: got [1.000000, nan], expected"),
    ("numbers torque_limits 1 0", "torque_limits: got [1.000000, 0.000000], expected"),
    ("numbers torque_limits 600 1", "torque_limits: got [600.000000, 1.000000], expected at most"),
    ("text on_fault stop", "on_fault: got stop, expected hold or zero"),
    ("numbers hold_stiffness -1 1", "hold_stiffness: got [-1.000000, 1.000000]"),
    ("numbers hold_damping 1", "hold_damping: got [1.000000]"),
    ("numbers controller.K2 4 10", "controller.K2: got [4.000000, 10.000000], expected 2 numbers"),
    ("numbers controller.K2 nan 10", "controller.K2: got [nan, 10.000000]"),
]


def test_parameters_and_names_that_do_not_fit_are_refused(scenario, built, tmp_path):
    for command, words in REFUSED:
        lines = built.answers(["rate 500", command, "init", "configure"])
        assert "configure ERROR" in lines and logged(lines)[0].startswith(words)
    names = ['a "b" \\', "\u00e9??/"]
    built = Built(tmp_path, scenario, like=built, joints=names, has_joint_names=True)
    lines = built.answers(["rate 500", "texts joints a b", "init", "configure"])
    (message,) = logged(lines)
    assert "in this order. Rename the joints" in message and names[0] in message
    assert built.answers(["rate 500", "init", "configure"])[-1] == "configure SUCCESS"
    assert cpp_string('"?\n') == '"\\042\\077\\012"'


def test_the_files_fit_together_and_a_period_without_a_whole_rate_has_none(scenario, built):
    package = "iblf_law_controller"
    assert ElementTree.fromstring(built.files["package.xml"]).findtext("name") == package
    plugin = ElementTree.fromstring(built.files["law_controller.xml"])
    assert plugin.attrib["path"] == package
    assert plugin[0].attrib["type"] == f"{package}::LawController"
    cmake = built.files["CMakeLists.txt"]
    assert "${PROJECT_NAME}" in cmake and "src/law_controller.cpp src/iblf_law.c" in cmake
    scenario = canonical(ij.with_parts(scenario, sampling=ij.Sampling(3e-3)))
    law = Law(scenario, control_law(scenario, False), "iblf_law", False, built.vectors, (), None)
    with pytest.warns(UserWarning, match=r"period = 0.003 s is not the period of a whole number"):
        assert ros2_control_files(law, generate(law), built.description) == {}
