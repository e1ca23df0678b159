"""`.ci/run` fails where one of its steps does, shows why, and leaves nothing running.

It runs here in a folder in which every program that it calls is a short script.
"""

import os
import re
import select
import shutil
import subprocess
from pathlib import Path

import pytest
from conftest import ROOT

SCRIPT = """#!/bin/sh
echo "$0 $*" >> calls
if [ "$0 $*" = "$STAYS" ]; then exec 3> pipe; sleep 30 & echo 1 > ready; wait; fi
if [ "$0 $*" = "$FAILS" ]; then cat ready; echo "the reason"; exit 3; fi
"""
"""A program: it notes its call, and then waits with a child that holds a pipe, fails once that
child runs, or succeeds."""
NEWEST = "tools/newest_python"
TESTS_OF_NEWEST = f"{NEWEST} python -m pytest -m not release and not site and (not slow or members)"
LOSSES = ".venv-test/bin/python benchmarks/losses.py --quick --fail 15"
SITE = ".venv-test/bin/python docs/build.py --draft"
LINT = ".venv-test/bin/ruff check ."
SLOW_TESTS = ".venv-test/bin/python -m pytest -m slow and not site and not members and not release"
TESTS_OF_ROS = ".venv-ros/bin/python -m pytest -n 2 --dist loadfile " + " ".join(
    f"tests/deployment/ros2/test_{name}.py"
    for name in ("law_node", "simulated_robot", "demo", "recorded_demo")
)
INSTALLATION_OF_ROS = (
    ".venv-ros/bin/pip install -q -c constraints.txt -e .[ros,robots] pytest pytest-xdist"
    " hypothesis"
)
STEPS = (LOSSES, TESTS_OF_NEWEST, SITE, LINT, SLOW_TESTS, INSTALLATION_OF_ROS, TESTS_OF_ROS)


def write_program(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with `.ci/run` and the programs that it calls."""
    programs = [NEWEST, "path/python3", "readme_command"]
    programs += [f".venv-test/bin/{name}" for name in ("python", "ruff", "mypy")]
    programs += [f".venv-ros/bin/{name}" for name in ("python", "pip")]
    for name in programs:
        write_program(tmp_path / name, SCRIPT)
    (tmp_path / ".ci").mkdir()
    shutil.copy(ROOT / ".ci" / "run", tmp_path / ".ci" / "run")
    (tmp_path / ".ci" / "base").write_text("a_commit\n")
    command = "<!-- test command -->\n```bash\n./readme_command\n```\n"
    (tmp_path / "README.md").write_text(command)
    os.mkfifo(tmp_path / "ready")
    return tmp_path


def ci(folder: Path, **variables: str) -> subprocess.CompletedProcess:
    path = os.pathsep.join([str(folder / "path"), os.environ["PATH"]])
    # The tests may run in a run of CI, which has its own.
    kept = {name: x for name, x in os.environ.items() if name not in ("BASE", "MINUTES")}
    environment = kept | {"PATH": path, "FAILS": "", "STAYS": ""} | variables
    output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.run(["bash", ".ci/run"], cwd=folder, env=environment, timeout=60, **output)


def test_every_step_is_called_and_a_change_may_reach_no_slow_test(folder):
    done = ci(folder)
    assert done.returncode == 0, done.stdout
    calls = {line.strip() for line in (folder / "calls").read_text().splitlines()}
    assert calls >= {NEWEST, *STEPS}
    none_collected = '#!/bin/sh\ncase "$*" in *"slow and"*) exit 5 ;; esac\n'
    write_program(folder / ".venv-test" / "bin" / "python", none_collected)
    assert ci(folder).returncode == 0


def test_the_slow_tests_are_those_that_the_change_reaches(folder):
    write_program(folder / "path" / "python3", '#!/bin/sh\necho "reached by $*"\n')
    noted = '#!/bin/sh\n[ -z "$SLOW_MINUTES" ] || echo "$SLOW_FILES, $SLOW_MINUTES" > slow\n'
    write_program(folder / ".venv-test" / "bin" / "python", noted)
    for variables, expected in (
        ({}, "reached by tools/select_tests.py a_commit, 38"),
        ({"BASE": "another", "MINUTES": "50"}, "reached by tools/select_tests.py another, 50"),
        ({"BASE": "", "MINUTES": "inf"}, "reached by tools/select_tests.py, inf"),
        ({"MINUTES": "0"}, "reached by tools/select_tests.py a_commit, 5"),
    ):
        assert ci(folder, **variables).returncode == 0
        assert (folder / "slow").read_text().strip() == expected


@pytest.mark.parametrize("step", [f"{NEWEST} ", *STEPS])
def test_a_step_that_fails_is_shown(folder, step):
    (folder / "ready").unlink()
    (folder / "ready").write_text("")
    done = ci(folder, FAILS=step)
    assert done.returncode not in (0, 127)
    assert "the reason" in done.stdout


@pytest.mark.parametrize("background", [f"{NEWEST} ", INSTALLATION_OF_ROS, TESTS_OF_ROS])
def test_what_runs_in_the_background_ends_with_a_failure(folder, background):
    """The failure comes when the job in the background has a child, which holds a pipe open."""
    os.mkfifo(folder / "pipe")
    pipe = os.open(folder / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    step = "./readme_command " if background == f"{NEWEST} " else LINT
    done = ci(folder, FAILS=step, STAYS=background)
    assert done.returncode == 3
    assert "the reason" in done.stdout
    assert select.select([pipe], [], [], 10.0)[0], "the child is still there"
    assert os.read(pipe, 1) == b""
    os.close(pipe)
    assert not re.search("Terminated|Killed", done.stdout)
