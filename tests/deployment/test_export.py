"""Laws and loops out of Python: C against JAX, FMUs against FMPy, modules against wasmtime."""

import itertools
import re
import shutil
import subprocess
import sys
import warnings

import arm_cases
import jax
import jax.numpy as jnp
import members
import numpy as np
import pytest
from exported import Module, built_and_run, fmpy, run_fmu
from refused import assert_refused
from test_microcontrollers import MATH, MEMORY, names_needed_by

import iblf_jax as ij
from iblf_jax.deployment.c_names import number
from iblf_jax.deployment.control_law import SampleInputs, control_law, sample, start
from iblf_jax.deployment.write_c import CHECK_INTERVAL, Law, Vectors, generate
from iblf_jax.simulation.scenario import canonical

FMU3Slave = pytest.importorskip("fmpy.fmi3").FMU3Slave

SANE = ("-g", "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover")
SAMPLES = 40


def walk(scenario, dtype, seed=0):
    """Positions and velocities that wander in the tube and touch its bounds."""
    rng = np.random.default_rng(seed)
    t = jnp.asarray(np.arange(SAMPLES) * 1e-3, dtype)
    tube = jax.vmap(scenario.context.tube)(t)
    share = 0.5 + 0.6 * np.cumsum(rng.normal(size=(SAMPLES, scenario.n)), axis=0) / np.sqrt(SAMPLES)
    q = tube.lower + share.astype(dtype) * (tube.upper - tube.lower)
    return SampleInputs(t, q, jnp.asarray(0.3 * rng.normal(size=q.shape), dtype)), tube


@pytest.fixture(scope="module")
def base():
    paper = ij.presets.zhang_yan_2024()
    speeds = ij.Bounds(ij.bounds.Constant(-2.0), ij.bounds.Constant(2.5))
    return ij.with_parts(paper, sampling=ij.Sampling(1e-3), bounds=(paper.bounds[0], speeds))


FURTHER_FORMS = (
    "backstepping_corrected_log",
    "barrier_backstepping_matrices",
    "dynamic_surface_compensated",
)
"""Members whose parameters or state have another form than those of the first of their class."""
LAWS = [x for x in members.LAWS if x not in members.further(members.LAWS)]
OBSERVERS = [x for x in members.OBSERVERS if x not in members.further(members.OBSERVERS)]
CASES = [*zip((*LAWS, *FURTHER_FORMS), itertools.cycle(OBSERVERS[::-1]), strict=False)]
"""Pairs of every class of law, the further forms and every class of observer; that every member
becomes a program is tested in `kernels`."""


def against_jax(folder, scenario, *, external_reference=False, dtype="float64"):
    """Runs the self-test of a law, with its answers to a random walk, under the sanitizers."""
    scenario = canonical(ij.astype(scenario, dtype))
    inputs, tube = walk(scenario, dtype)
    if external_reference:
        inputs = inputs._replace(q_d=tube.q_d, dq_d=tube.dq_d, ddq_d=tube.ddq_d)
    first = jax.tree.map(lambda x: x[0], inputs)

    def answers(scenario, first, inputs):
        def one(memory, inputs):
            memory, outputs = sample(scenario, inputs, memory)
            return memory, outputs.tau

        return jax.lax.scan(one, start(scenario, first)[0], inputs)[1]

    tau = np.asarray(jax.jit(answers)(scenario, first, inputs))[::CHECK_INTERVAL]
    rows = [np.asarray(x) for x in inputs[1:] if not isinstance(x, tuple)]
    vectors = Vectors(tuple(x[0] for x in rows), rows[0], rows[1], tuple(rows[2:]), tau)
    programs = control_law(scenario, external_reference)
    joints = getattr(scenario.model, "joints", ())
    law = Law(scenario, programs, "iblf_law", external_reference, vectors, joints, None)
    generated = generate(law)
    folder.mkdir(exist_ok=True)
    for name, text in generated.files.items():
        (folder / name).write_text(text)
    built_and_run(folder, *SANE)
    return generated


@pytest.mark.slow
@pytest.mark.parametrize(("law", "observer"), CASES)
def test_every_law_and_observer_gives_in_c_what_it_gives_in_jax(base, tmp_path, law, observer):
    """And it needs nothing but memory and mathematics."""
    parts = {"controller": members.LAWS[law], "observer": members.OBSERVERS[observer]}
    against_jax(tmp_path, ij.with_parts(base, **parts))
    assert MEMORY <= names_needed_by("iblf_law", tmp_path, "-O0") <= MEMORY | MATH


@pytest.mark.slow
@pytest.mark.parametrize("case", [*members.VELOCITIES, "measured with a reference from outside"])
def test_velocities_follow_by_the_filter_of_the_scenario(base, tmp_path, case):
    velocity, _, outside = case.partition(" with ")
    external_reference = bool(outside)
    sensor = ij.sensors.Encoder(counts=4096, velocity=members.VELOCITIES[velocity])
    lab = ij.with_parts(base, sensor=sensor, observer=members.OBSERVERS["momentum"])
    against_jax(tmp_path, lab, external_reference=external_reference)
    asks = "const iblf_law_real *q_d" in (tmp_path / "iblf_law.h").read_text()
    assert asks == external_reference
    assert ("NULL, " in (tmp_path / "selftest.c").read_text()) == (velocity != "measured")


@pytest.mark.slow
@pytest.mark.parametrize("step", ["euler", "poles"])
def test_floats_and_every_step_of_an_observer(base, tmp_path, step):
    sampling = ij.Sampling(1e-3, observer=step)
    lab = ij.with_parts(base, sampling=sampling, observer=members.OBSERVERS["momentum"])
    against_jax(tmp_path, lab, dtype="float32")


HOSTILE = (
    "*/ int main(void) { return 7; } /* ???/",
    'a\\\n#error no "); system(1); //',
    "??/\n\u00e9\u2028 $name ${joints} %s",
)


@pytest.mark.slow
def test_names_from_files_stay_in_comments(tmp_path):
    scenario = ij.Scenario(
        arm_cases.random_arm(len(HOSTILE), seed=2, joints=HOSTILE),
        ij.references.Sinusoid(0.1, 0.2),
        ij.Bounds(ij.bounds.Constant(-1.0), ij.bounds.Constant(1.0)),
        ij.controllers.Backstepping(k1=2.0, K2=20.0, o=0.1),
        ij.Initial(q=0.1),
        observer=ij.observers.Momentum(kf=20.0),
        sampling=ij.Sampling(1e-3),
    )
    assert against_jax(tmp_path, scenario).stack_bytes < 65_536
    text = (tmp_path / "iblf_law.h").read_text()
    assert text.isascii() and "int main" in text and "??" not in text


def law_of(torque):
    """A class of laws of a user: tau = torque(t, q, dq, gain, context)."""

    @ij.component
    class Own:
        gain: ij.Leaf = ij.leaf("N m/rad")
        uses_observer = False

        def init(self, q, dq, context):
            return ()

        def command(self, t, q, dq, f_hat, context, state):
            tau, no = torque(t, q, dq, self.gain, context), jnp.zeros(q.shape, bool)
            return ij.controllers.Command(tau, dq, 0.0 * q, no, no), ()

    return Own


def endless(t, q, dq, gain, context):
    """Its loop has no fixed length."""
    return jax.lax.while_loop(lambda x: x[0] < 1.0, lambda x: x + gain, q)


def whole(t, q, dq, gain, context):
    """It computes with whole numbers."""
    return gain * jnp.abs((9.0 * q).astype(jnp.int32)).astype(q.dtype)


def damped(t, q, dq, gain, context):
    """tau = G0 - gain (q - q_d) - q'."""
    return context.model.gravity(q) - gain * (q - context.tube(t).q_d) - dq


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the simulated run")
def test_what_cannot_be_written_says_why(base, tmp_path):
    several = jax.tree.map(lambda x: jnp.stack([x, x, x]), base)
    for scenario, options, words in (
        (ij.with_parts(base, controller=law_of(endless)(1.0)), {}, "no fixed length"),
        (ij.with_parts(base, controller=law_of(whole)(1.0)), {}, "scenario: got .*no abs of kind"),
        (ij.presets.zhang_yan_2024(), {}, "period"),
        *((several, {"target": target}, "one scenario") for target in ("c", "wasm")),
        (base, {"target": "wasm", "reference": "given"}, "reference"),
        (base, {"dtype": "half"}, "dtype"),
        (base, {"reference": "none"}, "reference"),
        *((base, {"name": x}, "name") for x in ("selftest", "Math", "test")),
    ):
        assert_refused(words, ij.export, scenario, tmp_path, **options)


@pytest.mark.slow
def test_a_users_law_is_registered_before_an_export_is_repeated(tmp_path, monkeypatch):
    monkeypatch.setattr("iblf_jax.deployment.export.VECTORS_DURATION", 0.02)
    Own = law_of(damped)
    scenario = ij.with_parts(ij.presets.zhang_yan_2024(), controller=Own([30.0, 20.0]))
    without = ij.export(scenario, tmp_path / "without", period=2e-3)
    assert "scenario.toml" not in without.files
    assert "scenario.toml left out: controller: got an object of class Own" in repr(without)

    monkeypatch.setitem(ij.controllers.MEMBERS, "own", Own)
    named = ij.export(scenario, tmp_path / "named", period=2e-3)
    assert "left out" not in repr(named) and "controller.gain" in named.parameters
    readme = (named.folder / "README.md").read_text()
    assert "in a program that first registers Own" in readme
    assert "iblf-jax export scenario.toml" not in readme
    (call,) = re.findall(r"`(ij\.export\(.*?)` repeats", readme)
    first = (named.folder / "iblf_law.c").read_text()
    monkeypatch.chdir(named.folder)
    eval(call, {"ij": ij})
    assert (named.folder / "iblf_law.c").read_text() == first

    own = ij.export(ij.presets.zhang_yan_2024(), tmp_path / "own", period=2e-3)
    assert "`iblf-jax export scenario.toml" in (own.folder / "README.md").read_text()
    with pytest.warns(UserWarning, match="recommended_period"):
        ij.export(ij.presets.zhang_yan_2024(), tmp_path / "slow", period=0.05)


@pytest.mark.slow
def test_memories_may_hold_whole_numbers_and_flags(base, tmp_path):
    @ij.component
    class Counting:
        """An observer of Euler that waits for its third sample."""

        kf: ij.Leaf = ij.leaf("1/s")

        def init(self, q, dq, model):
            return jnp.zeros_like(q), jnp.zeros((), jnp.int32), jnp.zeros((), bool)

        def estimate(self, t, q, dq, model, state):
            return jnp.where(state[2], state[0] * state[1].astype(q.dtype), 0.0)

        def derivative(self, t, q, dq, tau, model, state):
            return tau, state[1], state[2]

        def advance(self, t, q, dq, tau, model, state, period):
            return state[0] + self.kf * period * tau, state[1] + 1, state[1] > 1

    parts = {"observer": Counting(0.1), "controller": members.LAWS["pd_gravity"]}
    against_jax(tmp_path, ij.with_parts(base, **parts))


MAIN = """
#include "arm_law.h"
#include <stdio.h>
int main(void) {
  arm_law_parameters p = arm_law_defaults;
  arm_law_state s;
  const double q[2] = {0.75, 0.7}, dq[2] = {0.1, -0.2};
  double tau[2];
  int k, status = 0;
  p.controller.K2[0] = 33.0;
  p.model.mass[1] = 1.5;
  p.bounds.part_0.upper.offset[0] = 0.6;
  if (arm_law_init(&p, &s, q, dq)) return 1;
  for (k = 0; k < 3; k++) status = arm_law_step(&p, &s, 0.002 * k, q, dq, tau);
  printf("%.17g %.17g %d\\n", tau[0], tau[1], status);
  return 0;
}
"""


@pytest.mark.slow
def test_a_folder_is_complete_and_its_parameters_are_those_of_the_paths(tmp_path):
    scenario = ij.presets.zhang_yan_2024()
    generated = ij.export(scenario, tmp_path / "first", period=2e-3, name="arm_law")
    shutil.move(generated.folder, tmp_path / "moved")
    folder = tmp_path / "moved"
    assert sorted(x.name for x in folder.iterdir()) == sorted(generated.files)
    assert "A robot gives its first readings" in (folder / "vectors.h").read_text()
    assert "`arm_law_init` with the first readings" in (folder / "README.md").read_text()
    assert "ok: torque within" in built_and_run(folder, "-O2", name="arm_law")
    zig = (sys.executable, "-m", "ziglang", "cc")
    assert "ok: torque within" in built_and_run(folder, "-O2", name="arm_law", compiler=zig)
    if shutil.which("cmake"):
        for command in ("cmake -B build", "cmake --build build", "build/selftest"):
            subprocess.run(command.split(), cwd=folder, check=True, capture_output=True)

    gcc = ["gcc", "-std=c99"]
    subprocess.run([*gcc, "-O0", "-fstack-usage", "-c", "arm_law.c"], cwd=folder, check=True)
    rows = [row.split() for row in (folder / "arm_law.su").read_text().splitlines()]
    frames = {row[0].split(":")[-1]: int(row[1]) for row in rows}
    stack = generated.sizes["stack, without optimisation"]
    least = frames["arm_law_step"] + frames["arm_law_sample"]
    assert least < stack < 2 * sum(frames.values())

    (folder / "main.c").write_text(MAIN)
    command = [*gcc, "-O1", "arm_law.c", "main.c", "-lm", "-o", "main"]
    subprocess.run(command, cwd=folder, check=True)
    done = subprocess.run(["./main"], cwd=folder, check=True, capture_output=True, text=True)
    *tau, status = map(float, done.stdout.split())
    assert int(status) & 2, "the second bound was put below the position"

    changed = {"controller.K2[0]": 33.0, "model.mass[1]": 1.5, "bounds[0].upper.offset[0]": 0.6}
    lab = ij.with_parameters(canonical(ij.load_scenario(folder / "scenario.toml")), changed)
    inputs = SampleInputs(jnp.zeros(()), jnp.asarray([0.75, 0.7]), jnp.asarray([0.1, -0.2]))
    memory = start(lab, inputs)[0]
    for k in range(3):
        memory, outputs = sample(lab, inputs._replace(t=jnp.asarray(0.002 * k)), memory)
    np.testing.assert_allclose(tau, outputs.tau, rtol=1e-12)


@pytest.fixture(scope="module")
def lab():
    return ij.with_parts(
        ij.with_parameters(ij.presets.zhang_yan_2024(), {"controller.K2": 4.0, "observer.kf": 4.0}),
        sampling=ij.Sampling(2e-3, delay=5e-4),
        sensor=ij.sensors.Encoder(ij.sensors.FilteredDifference(300.0), counts=8192, noise=1e-4),
        actuator=ij.actuators.Motor(bandwidth=300.0, limit=60.0),
    )


RUN = {"duration": 0.08, "dt": 1e-3, "seed": 4, "record_every": 10}


@pytest.mark.slow
def test_a_closed_loop_as_an_fmu_is_simulate(lab, tmp_path):
    ij.export(lab, tmp_path, target="fmu-loop", dt=1e-3, seed=4)
    file = tmp_path / "iblf_loop.fmu"
    run = ij.simulate(lab, **RUN)
    names = {"q": run.q, "tau": run.tau, "f_hat": run.disturbance_estimate, "lower": run.lower}
    found = run_fmu(file, [*names, "status"], 0.08, 1e-2, step_size=1e-3)
    for name, expected in names.items():
        np.testing.assert_allclose(found[name], expected, atol=1e-10, err_msg=name)
    changed = run_fmu(file, "q", 0.08, 1e-2, start_values={"controller.K2": [5.0, 4.0]})
    other = ij.simulate(ij.with_parameters(lab, {"controller.K2": [5.0, 4.0]}), **RUN)
    np.testing.assert_allclose(changed["q"], other.q, atol=1e-10)
    with pytest.raises(Exception, match=r"fmi3DoStep|error"):
        run_fmu(file, "q", 0.08, 1.5e-3, step_size=1e-3)


@pytest.mark.slow
def test_a_law_as_an_fmu_gives_the_torque_of_simulate(lab, tmp_path):
    lab = ij.with_parts(lab, sampling=ij.Sampling(2e-3), actuator=ij.actuators.Ideal())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ij.export(lab, tmp_path, target="fmu")
    file = str(tmp_path / "iblf_law.fmu")
    run = ij.simulate(lab, duration=0.16, dt=2e-3)
    inputs = {"time": run.t, "q": run.measured.q, "dq": run.measured.dq}
    found = run_fmu(file, ["tau", "f_hat"], 0.16, 2e-3, inputs)
    np.testing.assert_allclose(found["tau"][1:], run.tau[:-1], atol=1e-9)

    about = fmpy.read_model_description(file)
    places = {v.name: [v.valueReference] for v in about.modelVariables}
    folder = fmpy.extract(file, str(tmp_path / "unzipped"))
    fmu = FMU3Slave(guid=about.guid, unzipDirectory=folder, modelIdentifier="iblf_law")
    fmu.instantiate()
    fmu.enterInitializationMode()
    fmu.setFloat64(places["q"], [0.7, 0.75])
    still = fmu.getFloat64(places["tau"], nValues=2)
    np.testing.assert_allclose(still, lab.model.gravity(jnp.asarray([0.7, 0.75])), rtol=1e-12)
    fmu.exitInitializationMode()
    for t, q0, status in ((0.0, np.nan, 1.0), (2e-3, 0.7, 0.0)):
        fmu.setFloat64(places["q"], [q0, 0.75])
        fmu.doStep(t, 2e-3)
        assert (fmu.getFloat64(places["tau"], nValues=2) == still) == (status == 1.0)
        assert fmu.getFloat64(places["status"]) == [status]
    fmu.freeInstance()


@pytest.mark.slow
def test_a_closed_loop_in_webassembly_is_simulate(lab, tmp_path):
    ij.export(lab, tmp_path, target="wasm", dt=1e-3, seed=4)
    loop = Module(tmp_path)
    expected = ij.simulate(lab, **RUN)
    found = loop.run(81, 10)
    np.testing.assert_allclose(found["q"], expected.q, atol=1e-10)
    np.testing.assert_allclose(found["tau"], expected.tau, atol=1e-10)
    skeletons = jax.vmap(lab.plant.skeleton)(expected.q).reshape(len(expected.q), -1)
    np.testing.assert_allclose(found["points"], skeletons, atol=1e-10)

    loop.call("start")
    for steps, recorded in ((5, 1), (5, 0), (1, 1)):
        assert loop.call("run", steps, 10) == recorded, "steps 0 and 10 of those from 0 to 10"

    k1 = next(x for x in loop.table["parameters"] if x["path"] == "controller.k1")
    loop.put(loop.call("parameters") + 8 * k1["offset"], [3.0, 1.5])
    slower = ij.simulate(ij.with_parameters(lab, {"controller.k1": [3.0, 1.5]}), **RUN)
    np.testing.assert_allclose(loop.run(81, 10)["q"], slower.q, atol=1e-10)


@pytest.mark.slow
def test_the_command_line_exports(tmp_path, capsys):
    from iblf_jax.cli import main

    words = ["export", "zhang_yan_2024", "--out", str(tmp_path)]
    options = ["--period", "0.002", "--dtype", "float", "--reference", "given"]
    assert main([*words, *options]) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    assert lines[0] == f"the law as C99 in {tmp_path}: 7 files; README.md describes them"
    assert re.search(r"stack, without optimisation \d+ bytes", lines[2])
    step = last.removeprefix("next: compare the code with a simulated run: ")
    ran = subprocess.run(step, shell=True, capture_output=True, text=True, check=True)
    assert "ok: torque within" in ran.stdout
    assert "ok: torque within" in built_and_run(tmp_path, "-O2")
    assert main([*words, "--target", "exe"]) == 2
    assert "target" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "size", "options"),
    [
        ("controller.K2", 1e308, {}),
        ("controller.K2", 3e37, {"dtype": "float", "reference": "given"}),
        ("controller.k1", 1e308, {"target": "wasm", "period": None}),
    ],
)
def test_a_law_that_yields_no_numbers_is_refused(tmp_path, monkeypatch, path, size, options):
    """Its self-test would hold `nan`, which no compiler of C takes."""
    monkeypatch.setattr("iblf_jax.deployment.export.VECTORS_DURATION", 0.02)
    scenario = ij.with_parameters(ij.presets.zhang_yan_2024(), {path: size})
    expected = rf"{path}: got .*e\+3.*finite numbers\. With it the torque tau\[.\] is (nan|-?inf)"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match=expected):
            ij.export(scenario, tmp_path / "out", **{"period": 2e-3} | options)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_parameter_of_ordinary_size_is_not_blamed(tmp_path, monkeypatch):
    monkeypatch.setattr("iblf_jax.deployment.export.VECTORS_DURATION", 0.02)

    class Broken(ij.presets.zhang_yan_2024().controller.__class__):
        """A law that forgets a guard."""

        def command(self, t, *more):
            command, rate = super().command(t, *more)
            return command._replace(tau=command.tau / jnp.where(t > 0.005, 0.0, 1.0)), rate

    law = ij.presets.zhang_yan_2024().controller
    broken = ij.component(Broken)(law.k1, law.K2, law.o)
    scenario = ij.with_parts(ij.presets.zhang_yan_2024(), controller=broken)
    words = r"scenario: got .*yields no numbers: the torque tau\[0\] is -?inf at t = 0\.006 s"
    assert_refused(words, ij.export, scenario, tmp_path, period=2e-3)


@pytest.mark.parametrize("is_float", [False, True])
def test_every_number_is_a_literal_of_c(is_float):
    found = [number(x, is_float) for x in (np.nan, np.inf, -np.inf, 1e300, 0.1)]
    large, tenth = ("INFINITY", "0.10000000149011612f") if is_float else ("1e+300", "0.1")
    assert found == ["NAN", "INFINITY", "-INFINITY", large, tenth]
