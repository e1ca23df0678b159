"""The files in examples/ do what they say, through the command line, and what the documentation
names is there."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax import cli

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
COMMANDS = {
    "arm.toml": (["simulate", "--out", "out"], "status: ok"),
    "study.toml": (["montecarlo", "--quiet"], "512 runs"),
    "failure.toml": (["failure", "--quiet"], "Subset simulation with"),
    "sweep.toml": (["sweep", "--store", "sweep.zarr", "--quiet"], "768 runs"),
    "tune.toml": (["tune", "--quiet"], "peak torque < 14 N m"),
    "identify.toml": (["identify"], "6 of 6 numbers told"),
}
"""File -> the command that its first line names, with options, and what it prints."""
NEEDED = {"arm.toml": "mujoco", "sweep.toml": "zarr"}


def test_every_example_is_run_and_names_its_command():
    assert {path.name for path in EXAMPLES.glob("*.toml")} == set(COMMANDS)
    for name, ((command, *_), _) in COMMANDS.items():
        first, *_ = (EXAMPLES / name).read_text(encoding="utf-8").splitlines()
        assert f"iblf-jax {command} examples/{name}" in first


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_examples_run(name, tmp_path, monkeypatch, capsys, request):
    pytest.importorskip(NEEDED.get(name, "iblf_jax"))
    if name == "failure.toml":  # thousands of runs
        request.getfixturevalue("optimised_kernels")
    monkeypatch.chdir(tmp_path)
    (command, *options), words = COMMANDS[name]
    assert cli.main([command, str(EXAMPLES / name), *options]) == 0, capsys.readouterr().err
    assert words in capsys.readouterr().out


@pytest.mark.slow
def test_the_arm_of_the_examples_is_the_one_that_readme_speaks_of():
    pytest.importorskip("mujoco")
    arm = ij.robots.load(EXAMPLES / "arm.urdf", tip="tool0")
    reference = ij.references.Quintic(start=arm.lower * 0.2, end=arm.upper * 0.2, duration=2.0)
    scenario = ij.presets.arm_scenario(arm, reference)
    heavier = ij.with_parameters(scenario, {"plant.payload": 2.0, "plant.link[forearm].mass": 1.2})
    np.testing.assert_array_equal(heavier.plant.mass, [2.5, 1.8, 1.2])


def test_files_that_the_documentation_names_are_there():
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    texts = [path.read_text(encoding="utf-8") for path in pages]
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        texts += ["".join(cell["source"]) for cell in cells]
    named = {name for text in texts for name in re.findall(r"examples/[\w.]+\w", text)}
    assert {f"examples/{name}" for name in (*COMMANDS, "arm.urdf")} - named <= {"examples/arm.toml"}
    assert all((ROOT / name).exists() for name in named)
    lines = [line for text in texts for line in text.splitlines() if "Warning: " not in line]
    # pip finds the package in an index only once it is published there, and by its address before.
    forbidden = r"STUDY\.toml|SWEEP\.toml|TUNE\.toml|iblf_jax\[[\w,]*\](?! @ )"
    assert not [line for line in lines if re.search(forbidden, line)]


MATLAB_PAGE = (ROOT / "docs" / "how_to" / "from_matlab.md").read_text(encoding="utf-8")


def block_of(language: str) -> str:
    return re.findall(rf"```{language}\n(.*?)```", MATLAB_PAGE, re.DOTALL)[0]


def numbers_in(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"\d+\.\d{4,}", text)]


def test_the_page_compares_with_what_its_matlab_script_prints():
    compared = re.search(r"printed = \{(.*?)\n\}", MATLAB_PAGE, re.DOTALL)
    assert numbers_in(compared[1]) == numbers_in(block_of("text"))


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("octave"), reason="needs GNU Octave")
def test_the_matlab_script_prints_what_its_page_states(tmp_path):
    (tmp_path / "two_link_barrier.m").write_text(block_of("matlab"))
    command = ["octave", "--no-gui", "--quiet", "--eval", "two_link_barrier"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    np.testing.assert_allclose(numbers_in(done.stdout), numbers_in(block_of("text")), atol=2e-8)
