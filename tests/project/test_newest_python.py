"""The program that runs a command with the newest Python and JAX keeps environments apart."""

import os
import sys

import pytest
from conftest import ROOT
from test_release import module_of

tool = module_of(ROOT / "tools" / "newest_python", "newest_python")


@pytest.fixture
def machine(tmp_path):
    return tool.Machine(tmp_path, sys.executable)


def test_different_environments_have_different_keys(tmp_path, monkeypatch):
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    options = {"global.find-links": str(wheels)}

    def description(needed=("jax", "numpy"), python="3.13.1", options=options):
        paths = [path for value in options.values() for path in tool.paths_in(value)]
        return tool.description(list(needed), python, tool.PipConfiguration(options, paths))

    changes = [{}, {"needed": ["jax, numpy"]}, {"needed": ["jax", "numpy", "scipy"]}]
    changes += [{"python": "3.13.2"}, {"options": {}}]
    for kind in ("global", ":env:"):
        changes.append({"options": {**options, f"{kind}.index-url": "file:///nowhere"}})
    contents = [description(**change) for change in changes]
    (wheels / "jax.whl").write_bytes(b"a")
    contents.append(description())
    monkeypatch.setattr(tool, "__file__", str(tmp_path / "other"))
    (tmp_path / "other").write_text("another way to make it")
    contents.append(description())
    keys = [tool.key_of(content) for content in contents]
    assert len(set(keys)) == len(keys)
    assert tool.key_of(description()) == keys[-1]
    # The newest packages are looked for again every week.
    next_week = tool.datetime.date.today() + tool.datetime.timedelta(weeks=1)
    later = type("Later", (tool.datetime.date,), {"today": classmethod(lambda cls: next_week)})
    monkeypatch.setattr(tool.datetime, "date", later)
    assert tool.key_of(description()) != keys[-1]


def test_the_command_has_the_environment_of_the_copy(machine, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "/foreign")
    (tmp_path / "copy" / "tree").mkdir(parents=True)
    code = "import os, pathlib; pathlib.Path('seen').write_text(repr(dict(os.environ)))"
    command = [sys.executable, "-c", f"{code}; raise SystemExit(7)"]
    packages, copy = tmp_path / "packages", tmp_path / "copy"
    assert tool.run_command(machine, packages, copy, command) == 7
    seen = eval((copy / "tree" / "seen").read_text())
    assert "PYTHONPATH" not in seen
    first = [str(x / "venv" / "bin") for x in (copy, packages)]
    assert seen["PATH"].split(os.pathsep)[:2] == first


def test_an_environment_is_made_once_and_again_after_an_interruption(
    machine, tmp_path, monkeypatch
):
    content = {"python": "3.13", "requirements": ["jax"]}
    packages = tmp_path / "packages" / "key"
    steps = []

    def step(what, words, folder):
        steps.append(what)
        if len(steps) == 3:
            raise tool.UnavailableError("no network")
        return ""

    monkeypatch.setattr(machine, "run", step)
    with pytest.raises(tool.UnavailableError):
        tool.make_packages(machine, packages, content)
    (packages / "half").touch()
    tool.make_packages(machine, packages, content)
    assert not (packages / "half").exists()
    assert len(steps) == 6
    tool.make_packages(machine, packages, content)
    assert len(steps) == 6
