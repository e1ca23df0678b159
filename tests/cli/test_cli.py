"""The command line: its output, its files and its error messages."""

import functools
import json
import os
import re
import signal
import subprocess
import sys
import tomllib

import jax
import numpy as np
import pytest
import tomli_w
from conftest import ROOT
from PIL import Image

import iblf_jax as ij
from iblf_jax import _start, cli
from iblf_jax.cli import _claims, _paper_figures, doctor
from iblf_jax.files import scenario as scenario_file
from iblf_jax.files.rollouts import load_datasets


@pytest.fixture
def command(capsys, monkeypatch, tmp_path):
    """Runs the CLI in a folder of its own; returns exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)

    def call(*argv: str) -> tuple[int, str, str]:
        code = cli.main(argv)
        return code, *capsys.readouterr()

    return call


def strict_json(path):
    def refuse(word):
        raise AssertionError(f"{word} in strict JSON")

    return json.loads(path.read_text(), parse_constant=refuse)


@pytest.mark.slow
def test_reproduce(command, tmp_path, monkeypatch):
    """The film has one picture a second here."""
    animate = functools.partial(ij.plotting.animate, fps=1.0)
    monkeypatch.setattr(ij.plotting, "animate", animate)
    code, out, err = command("reproduce", "--out", "out")
    assert code == 0, err
    figures = {f"figure_{i}.{ending}" for i in range(1, 7) for ending in ("pdf", "png")}
    sizes = {path.name: path.stat().st_size for path in (tmp_path / "out").iterdir()}
    assert sizes.keys() == figures | {"arm.gif", "metrics.json", "report.md", "rollouts.nc"}
    assert min(sizes.values()) > 1000
    assert Image.open(tmp_path / "out" / "figure_6.png").size[0] > 800
    words = ("settling_time", "0.993", "0.713", "1.077", "0.837", "N m", "Remark")
    for word in (*words, "with compilation", "without compilation"):
        assert word in out
    assert out.count("HELD ") == 8 and "DID NOT HOLD" not in out
    report = strict_json(tmp_path / "out" / "metrics.json")
    assert [claim["confirmed"] for claim in report["claims"]] == [True] * 8
    assert report["runs"]["integral BLF"]["metrics"]["first_violation_time"]["value"] is None
    text = (tmp_path / "out" / "report.md").read_text()
    assert text.count("The masses and lengths of the arm are assumed.") == 6
    for words in (" ".join(out.split()), text, report["assumed"]):
        assert "the paper prints no masses, lengths" in words and "ASSUME" in words
        assert "masses 2 / 0.85 kg, lengths 0.35 / 0.31 m" in words and "g = 9.81 m/s^2" in words
    torques = [(x["joint"], x["value"]) for x in report["peaks"]["integral BLF"]["tau"]]
    np.testing.assert_allclose(torques, [(0, -13.81), (1, -16.28)], atol=0.01)
    settling = report["runs"]["log-BLF"]["metrics"]["settling_time"]
    np.testing.assert_allclose(settling["value"], [1.077, 0.837], atol=2e-3)
    assert settling["unit"] == "s"
    data = load_datasets(tmp_path / "out" / "rollouts.nc")
    assert data["integral BLF"].sizes["time"] == 20_001


def test_the_assumed_numbers_are_those_of_the_runs(paper):
    heavier = ij.with_parameters(paper, {"robot.mass": [2.5, 0.75]})
    run = ij.simulate(heavier, duration=0.01, dt=1e-3)
    assert "masses 2.5 / 0.75 kg, lengths 0.35 / 0.31 m" in _claims.assumed({"a": run})


def test_the_report_compares_every_figure_with_the_paper(short_run):
    runs = {"integral BLF": short_run, "log-BLF": short_run}
    claims = _claims.paper_claims(runs)
    peaks = _paper_figures.peaks_table(runs)
    text = _paper_figures.as_markdown(claims, peaks, "assumed", "a remark")
    for number in range(1, 7):
        assert f"### Figure {number}. " in text
        assert f"](figure_{number}.png)" in text
    assert text.count("- What differs: ") == 6
    for number, claim in enumerate(claims, 1):
        assert f"\n{number}. {claim.claim} **" in text
    for one in _paper_figures.COMPARISONS:
        assert all(1 <= number <= len(claims) for number in one.claims)
    did_not_hold = sum(not claim.confirmed for claim in claims)
    assert text.count("**did not hold**") == did_not_hold > 0
    tau = np.asarray(short_run.tau)
    for joint in range(2):
        value = tau[np.argmax(np.abs(tau[:, joint])), joint]
        assert value < 0.0
        row = rf"^tau +(N m +)?integral BLF +(N m +)?joint {joint} +(N m +)?{value:.4g}\b"
        assert re.search(row, peaks, re.MULTILINE), peaks


def test_claims_can_fail(paper, short_run):
    """The same run twice is neither faster nor more accurate, and half a second is too short."""
    claims = _claims.paper_claims({"a": short_run, "b": short_run})
    confirmed = {claim.claim: claim.confirmed for claim in claims}
    assert confirmed["Neither law violates its time-varying asymmetric bounds."]
    for claim in (
        "Both laws track the reference.",
        "The integral form converges faster.",
        "The integral form is slightly more accurate.",
        "The integral form overshoots more in e2 at the start.",
        "The error signals tend to a very small neighbourhood of zero.",
    ):
        assert not confirmed[claim]
    outside = jax.tree.map(lambda x: x, short_run)
    object.__setattr__(outside, "x", short_run.x.at[:, 0].add(10.0))
    assert not _claims.theorem_1({"a": outside}).confirmed
    object.__setattr__(outside, "status", short_run.status | int(ij.Status.BOUND_VIOLATED))
    assert not _claims.bounds_kept({"a": outside}).confirmed


@pytest.mark.slow
def test_simulate_a_file(command, paper, tmp_path):
    ij.save_scenario(paper, tmp_path / "mine.toml", run={"duration": 0.05, "method": "heun"})
    changes = ["--set", "controller.K2=30", "--set", "initial.q=[0.7, 0.6]"]
    code, out, err = command("simulate", "mine.toml", *changes, "--out", "out")
    assert (code, err) == (0, "") and "status: ok" in out
    assert "mine.toml: 0.05 s, dt = 0.001 s, heun" in out
    names = {"metrics.json", "overview.png", "rollout.nc", "scenario.toml"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    again = scenario_file.load_scenario_file(tmp_path / "out" / "scenario.toml")
    assert again.run == {"duration": 0.05, "dt": 1e-3, "method": "heun", "record_every": 1}
    np.testing.assert_array_equal(again.scenario.controller.K2, [30.0, 30.0])
    run = ij.simulate(again.scenario, **again.run)
    report = strict_json(tmp_path / "out" / "metrics.json")
    assert report["status"] == "ok"
    assert report["metrics"]["rmse"]["value"] == np.asarray(run.metrics.rmse).tolist()
    np.testing.assert_array_equal(load_datasets(tmp_path / "out" / "rollout.nc")["run"].q, run.q)


@pytest.mark.slow
def test_a_seed_fixes_the_noise(command, paper, tmp_path):
    encoder = ij.sensors.Encoder(noise=1e-4, velocity=ij.sensors.Tracking(bandwidth=100.0))
    noisy = ij.with_parts(paper, sampling=ij.Sampling(2e-3), sensor=encoder)
    ij.save_scenario(noisy, tmp_path / "noisy.toml", run={"duration": 0.02})
    for folder, seed in (("a", "3"), ("b", "4")):
        command("simulate", "noisy.toml", "--seed", seed, "--out", folder)
    a, b = (strict_json(tmp_path / folder / "metrics.json") for folder in "ab")
    run = ij.simulate(noisy, duration=0.02, dt=1e-3, seed=3)
    assert a["metrics"]["rmse"]["value"] == np.asarray(run.metrics.rmse).tolist()
    assert a["seed"] == 3 and a["metrics"]["rmse"] != b["metrics"]["rmse"]


@pytest.mark.slow
def test_a_failed_run_exits_with_one(command, tmp_path):
    options = "--duration 0.05 --dt 0.001 --method heun --record-every 7 --out out"
    options += " --set controller.K2=500"
    code, out, err = command("simulate", "zhang_yan_2024", *options.split())
    assert code == 1 and "the time step is too large for the closed loop" in out
    assert err.startswith("iblf-jax: warning: The run failed")
    assert err.count("\n") == 1 and "Take dt=" in err
    report = strict_json(tmp_path / "out" / "metrics.json")
    assert "STEP_TOO_LARGE" in report["flags"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        ["--robot", f"{ROOT}/examples/arm.urdf", "--tip", "tool0"],
        pytest.param(["--preset", "zhang_yan_2024"], marks=pytest.mark.release),
        pytest.param(["--preset", "ur5"], marks=pytest.mark.release),
        pytest.param(["--preset", "iiwa14"], marks=pytest.mark.release),
    ],
)
def test_every_command_of_a_new_project_runs(command, monkeypatch, tmp_path, options):
    assert command("new", "mine", *options)[::2] == (0, "")
    folder = tmp_path / "mine"
    readme = (folder / "README.md").read_text()
    written = {"scenario.toml", "study.toml", "tune.toml", "project.ipynb", "README.md"}
    assert {path.name for path in folder.iterdir()} == written
    assert all(f"`{name}`" in readme for name in written - {"README.md"})
    monkeypatch.chdir(folder)
    named = re.findall(r"iblf-jax ([^`#\n]+)", readme)
    assert [words.split()[0] for words in named[:4]] == ["simulate", "montecarlo", "tune", "export"]
    drives = readme.split("```toml\n")[1].split("```")[0]
    (folder / "lab.toml").write_text((folder / "scenario.toml").read_text() + drives)
    assert isinstance(ij.load_scenario("lab.toml").actuator, ij.actuators.Motor)
    for words in named:
        code, out, _ = command(*words.split())
        assert code == 0, (words, out)
    cells = json.loads((folder / "project.ipynb").read_text())["cells"]
    names: dict = {}
    for cell in (x for x in cells if x["cell_type"] == "code"):
        exec("".join(cell["source"]), names)
    assert not len(names["study"].failed)


@pytest.mark.slow
def test_rotor_inertia_makes_a_project_of_a_robot_with_stiff_friction(command, tmp_path):
    file = ROOT / "tests" / "data" / "arms" / "xarm7.urdf"
    code, out, _ = command("new", "a", "--robot", str(file), "--rotor-inertia")
    assert code == 0 and "inertia added to the simulated robot [kg m^2]: joint1 0.015, " in out
    scenario = ij.load_scenario(tmp_path / "a" / "scenario.toml")
    arm = ij.robots.load(file)
    plant, model = scenario.plant, scenario.model
    added = np.asarray(plant.armature - arm.armature)
    assert "joint7 0.011 " in out.replace(";", " ")
    np.testing.assert_allclose(added, [0.015, 0.0, 0.0125, 0.0, 0.0125, 0.011, 0.011])
    # The law and the friction are those of the file.
    np.testing.assert_array_equal(model.armature, arm.armature)
    np.testing.assert_array_equal(plant.damping, arm.damping)
    np.testing.assert_array_equal(plant.friction, arm.friction)
    # The eigenvalues of M^-1 D, computed without the square root of D, at a step of 1 ms.
    slope = np.diag(np.asarray(arm.damping + arm.friction / arm.friction_width))
    for q in np.linspace(scenario.reference.start, scenario.reference.end, 9):
        decays = np.linalg.eigvals(np.linalg.solve(np.asarray(plant.mass_matrix(q)), slope))
        assert np.max(decays.real) * 1e-3 <= 2.0
    readme = (tmp_path / "a" / "README.md").read_text()
    assert "[kg m^2]: joint1 0.015, joint3 0.0125" in readme


def test_new_refuses_before_it_writes(command, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    text = (ROOT / "examples" / "arm.urdf").read_text()
    (tmp_path / "weak.urdf").write_text(text.replace('effort="60"', 'effort="3"'))
    for words, message in (
        (["full"], "FOLDER: got 'full', expected a folder that is new or empty"),
        (["a", "--robot", "none.urdf"], "none.urdf"),
        (["a", "--robot", "weak.urdf"], "of the limit 3 N m of the joint lift"),
        (["a", "--robot", "weak.urdf", "--preset", "ur5"], "either --robot or --preset"),
        (["a", "--preset", "vessel"], "--preset: got 'vessel'"),
        (["a", "--tip", "tool0"], "--tip: got 'tool0', expected --robot beside it"),
        (["a", "--rotor-inertia"], "--rotor-inertia: got True, expected --robot beside it"),
    ):
        code, _, err = command("new", *words)
        assert code == 2 and message in err
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["mine.txt"]
    assert not (tmp_path / "a").exists()


def test_doctor_names_what_is_missing(command, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(doctor, "_version_of", lambda package: "" if package == "mujoco" else "1.0")
    code, out, _ = command("doctor")
    names = ("Python ", "jax ", "jaxlib ", "devices ", "compiler ", str(tmp_path / "cache"))
    assert code == 0 and all(words in out for words in names)
    assert re.search(r"^extra robots +missing +without mujoco$", out, re.MULTILINE)
    assert '  extra robots: pip install "iblf_jax[robots]", or ".[robots]" in a clone' in out
    assert "extra export       ok" in out

    monkeypatch.setenv("CXX", "no-such-compiler")
    code, out, _ = command("doctor")
    assert code == 1 and "  compiler: there is no C++ compiler 'no-such-compiler' ($CXX)" in out
    versions = {"0.10.2": True, "0.12.9.dev1": True, "0.10.1": False, "0.13.0": False}
    assert {x: doctor._is_within(x, ">=0.10.2,<0.13") for x in versions} == versions


def test_presets_parameters_help_and_version_are_printed(command, paper):
    def printed(*words):
        code, out, _ = command(*words)
        assert code == 0, words
        return out

    assert re.match(r"zhang_yan_2024 +The simulation of the paper's section 4", printed("presets"))
    assert "--arg law=integral" in printed("presets", "zhang_yan_2024")
    out = printed("presets", "zhang_yan_2024", "--toml", "--arg", "law=log")
    law = scenario_file.from_dict(tomllib.loads(out)).scenario.controller
    assert isinstance(law.barrier, ij.barriers.Log)
    out = printed("parameters", "zhang_yan_2024", "--set", "robot.mass[1]=1.25")
    assert all(f"\n{parameter.path} " in out for parameter in ij.parameters(paper))
    assert out.count("1.25") == 2
    assert ij.__version__ in printed("--version")
    for words in (["--help"], *([name, "--help"] for name in cli.COMMANDS)):
        assert "usage: iblf-jax" in printed(*words)


REFUSALS = [
    ("", "required: COMMAND"),
    ("reproduce --out file.toml", "--out: got 'file.toml', expected a folder that can be written"),
    ("simulate zhang_yan", "Did you mean zhang_yan_2024"),
    ("simulate file.toml", "file.toml: contrller: got an unknown key"),
    ("simulate good.toml --arg law=log", "only presets take arguments"),
    ("simulate PAPER --duration 1 --dt 0.3", "Take duration=0.9"),
    ("simulate PAPER --set controller.K2", "--set: got 'controller.K2', expected NAME=VALUE"),
    ("simulate PAPER --set controller.K2=fast", "controller.K2: got 'fast'"),
    ("simulate PAPER --set initial.q=2", "q[0]: got 2.0, expected a start inside the bounds"),
    ("presets --toml", "expected the name of a preset"),
]


@pytest.mark.parametrize(("argv", "message"), REFUSALS)
def test_refusals_are_one_line_and_exit_with_two(argv, message, command, paper, tmp_path):
    tables = scenario_file.scenario_to_dict(paper)
    (tmp_path / "good.toml").write_text(tomli_w.dumps(tables))
    (tmp_path / "file.toml").write_text(tomli_w.dumps({**tables, "contrller": {}}))
    code, out, err = command(*argv.replace("PAPER", "zhang_yan_2024").split())
    assert (code, out) == (2, "")
    assert err.startswith("iblf-jax: error: ") and err.count("\n") == 1
    assert message in err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "started"), [("_start", "-m"), ("iblf_jax.cli", "-m"), ("jax", "script")]
)
def test_a_command_is_interrupted_quietly_while_python_imports(module, started, tmp_path):
    script = tmp_path / "iblf-jax"
    script.write_text("from iblf_jax.cli import entry\nentry()\n")
    words = ["-m", "iblf_jax"] if started == "-m" else [str(script)]
    process = subprocess.Popen(
        [sys.executable, "-X", "importtime", *words, "simulate", "zhang_yan_2024"],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    for line in process.stderr:
        if line.split("|")[-1].strip().endswith(module):
            break
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=60)
    messages = [line for line in errors.splitlines() if not line.startswith("import time:")]
    assert (process.returncode, out, messages) == (130, "", ["iblf-jax: error: interrupted"])


def test_only_a_command_replaces_the_interrupt_handler(monkeypatch):
    for argv, orig, command in (
        (["-m", "a"], ["python", "-X", "dev", "-m", "iblf_jax", "a"], True),
        (["-m"], ["python", "-miblf_jax"], True),
        (["/bin/iblf-jax", "a"], ["python", "/bin/iblf-jax", "a"], True),
        (["-m", "iblf_jax"], ["python", "-m", "other", "iblf_jax"], False),
        (["-c", "iblf_jax"], ["python", "-c", "import iblf_jax", "iblf_jax"], False),
        (["iblf_jax.py"], ["python", "iblf_jax.py"], False),
        ([""], ["python"], False),
        ([], [], False),
    ):
        monkeypatch.setattr(sys, "argv", argv)
        monkeypatch.setattr(sys, "orig_argv", orig)
        assert _start._is_a_command() == command, orig


def test_a_missing_extra_of_ros_is_named_without_a_traceback(monkeypatch, tmp_path, capsys):
    def missing(*_, **__):
        raise ImportError("This needs rclpy")

    monkeypatch.setattr("iblf_jax.deployment.ros2.demo.ros_packages", missing)
    assert cli.main(["ros", "demo", "--out", str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert "This needs rclpy" in err and "Traceback" not in err
