"""The program that runs a command with the newest Python and JAX keeps environments apart, passes
the configuration of pip on, and says clearly when it cannot make an environment.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys

import pytest
from conftest import ROOT
from test_release import module_of

tool = module_of(ROOT / "tools" / "newest_python", "newest_python")
NO_OPTIONS = tool.PipConfiguration({}, [])


@pytest.fixture
def machine(tmp_path):
    return tool.Machine(tmp_path, sys.executable)


def call(*words, **variables):
    command = [sys.executable, str(ROOT / "tools" / "newest_python"), *words]
    return subprocess.run(
        command, env=os.environ | variables, capture_output=True, text=True, check=False
    )


# --- keys ----------------------------------------------------------------------------------------


def test_different_environments_have_different_keys(tmp_path, monkeypatch):
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    options = {"global.find-links": str(wheels)}

    def description(needed=("jax", "numpy"), python="3.13.1", options=options):
        paths = [path for value in options.values() for path in tool.paths_in(value)]
        return tool.description(list(needed), python, tool.PipConfiguration(options, paths))

    contents = [
        description(),
        description(needed=["jax, numpy"]),
        description(needed=["jax", "numpy", "scipy"]),
        description(python="3.13.2"),
        description(options={}),
        description(options={**options, "global.index-url": "file:///nowhere"}),
        description(options={**options, ":env:.index-url": "file:///nowhere"}),
    ]
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


# --- the copy ------------------------------------------------------------------------------------


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


# --- calls at the same time, and calls that were interrupted -------------------------------------


def test_what_a_step_has_started_ends_with_the_call(tmp_path):
    """Here the step itself ends the call, once its child runs; the child holds a pipe open."""

    def terminate(number, frame):
        raise SystemExit(128 + number)

    os.mkfifo(tmp_path / "pipe")
    pipe = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    handler = signal.signal(signal.SIGTERM, terminate)
    step = "exec 3> pipe; sleep 30 & kill -TERM $PPID; wait"
    try:
        with pytest.raises(SystemExit):
            tool.run("a step", ["sh", "-c", step], folder=tmp_path)
    finally:
        signal.signal(signal.SIGTERM, handler)
    assert select.select([pipe], [], [], 10.0)[0], "the child is still there"
    assert os.read(pipe, 1) == b""
    os.close(pipe)


def test_only_what_no_call_uses_is_removed(machine, tmp_path):
    folders = [tmp_path / "copies" / name for name in ("used", "left")]
    folders += [tmp_path / "packages" / name for name in ("old", "old_in_use", "new")]
    for folder in folders:
        folder.mkdir(parents=True)
        tool.lock_of(folder).touch()
        if folder.name.startswith("old"):
            os.utime(tool.lock_of(folder), (0, 0))
    used = [tool.lock_of(folders[0]), tool.lock_of(folders[3])]
    with tool.locked(used[0]), tool.locked(used[1], shared=True):
        tool.remove_unused(machine)
    assert [x.name for x in folders if x.exists()] == ["used", "old_in_use", "new"]
    tool.remove_unused(machine)
    assert [x.name for x in folders if x.exists()] == ["new"]
    assert sorted(x.name for x in tmp_path.rglob("*.lock")) == ["new.lock"]


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


# --- where it cannot be made ---------------------------------------------------------------------


def test_a_python_that_cannot_be_used_is_named(tmp_path):
    done = call("true", NEWEST_PYTHON="/no/such/python", NEWEST_PYTHON_FOLDER=str(tmp_path))
    assert done.returncode == tool.UNAVAILABLE
    assert (
        "the environment cannot be made: /no/such/python is no Python that starts and has venv and"
        " ensurepip; it must be Python 3.13 or 3.12." in done.stderr
    )


def test_without_any_python_and_root_it_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setattr(tool.os, "geteuid", lambda: 1000)
    with pytest.raises(tool.UnavailableError, match=r"no python3\.13 .* name it by --python PATH"):
        tool.debian(tmp_path, NO_OPTIONS)
