"""What other tests find holds as users compile too: the tests' own settings (conftest.py) leave out
what compilers optimise.

An optimiser may add up in another order in another batch, and fails on functions of its own; so
these are the tests of the reference data, of bit-identity, of the functions of kernels, and of the
ways in which XLA is given a loop.
"""

import os
import subprocess
import sys
from pathlib import Path

import conftest
import pytest

ROOT = Path(__file__).parents[2]
AGAIN = {
    "the paper": [
        "simulation/test_paper.py::test_both_laws_at_one_millisecond[integral-printed]",
        "simulation/test_paper.py::test_what_the_paper_shows",
    ],
    "shapes": ["engine/test_loops.py::test_every_loop_makes_the_same_run"],
    "runs": [
        "core/test_transforms.py::test_a_failing_run_leaves_the_others_bit_identical",
        "core/test_transforms.py::test_the_same_run_twice_is_bit_identical",
        "studies/test_monte_carlo.py::test_chunk_changes_nothing[1]",
        "studies/test_monte_carlo.py::test_number_of_runs_changes_no_run[257]",
        "studies/test_monte_carlo.py::test_replay_is_bit_identical_and_has_the_trajectory",
        "kernels/test_operations.py::test_native_functions[float64]",
    ],
}
"""Name -> tests."""
SETTINGS = "project/test_users_settings.py::test_the_testers_own_flags_come_last"


def run_tests(*words: str, **variables: str) -> str:
    """What a run of tests prints that has nothing of this one in its environment."""
    own = ("PYTEST_", "SLOW_")
    plain = {name: value for name, value in os.environ.items() if not name.startswith(own)}
    options = ["-n", "0", "-p", "no:cacheprovider", "-m", "not release"]
    how = {"cwd": ROOT, "env": plain | variables, "timeout": 300}
    command = [sys.executable, "-m", "pytest", *options, *words]
    done = subprocess.run(command, capture_output=True, text=True, **how)
    assert done.returncode == 0, done.stdout[-3000:]
    return done.stdout


def test_the_testers_own_flags_come_last():
    flags, own = os.environ["XLA_FLAGS"], os.environ["TESTER_XLA_FLAGS"]
    as_users = bool(os.environ.get("TEST_AS_USERS"))
    assert flags == f"{'' if as_users else conftest.XLA_FLAGS} {own}".strip()
    assert (os.environ.get("CXX") == str(ROOT / "tests" / "quick_compiler")) == bool(
        os.environ["TESTER_CXX"] and not as_users
    )


MARKS = {"the paper": pytest.mark.slow}


@pytest.mark.parametrize(
    "what", [pytest.param(name, marks=MARKS.get(name, pytest.mark.release)) for name in AGAIN]
)
def test_the_same_as_users_compile(what):
    names = [str(ROOT / "tests" / name) for name in (SETTINGS, *AGAIN[what])]
    assert f"{len(names)} passed" in run_tests(*names, TEST_AS_USERS="1")


TWO_FILES = ("tests/project/test_select_tests.py", "tests/project/test_examples.py")
"""Files with default tests and slow ones, which are soon collected."""


def collected(files: str | None, *options: str) -> list[str]:
    """The tests that a run of two files has, in their order, with SLOW_FILES; None is without."""
    variables = {} if files is None else {"SLOW_FILES": files}
    paths = [str(ROOT / path) for path in TWO_FILES]
    printed = run_tests("--collect-only", *options, *paths, **variables)
    return [line for line in printed.splitlines() if "::" in line]


@pytest.mark.slow
def test_a_change_runs_the_slow_tests_of_the_files_that_it_reaches():
    """Those of the nearest file first; the default tests of all files run in any case."""
    one, other = TWO_FILES
    chosen, slow = collected(other), set(collected(None, "-m", "slow and not release"))
    assert slow - set(chosen) == {test for test in slow if test.startswith(one)} != set()
    assert any(test.startswith(one) for test in chosen) and slow & set(chosen)
    assert collected(f"{other} {one}")[0].startswith(other)


@pytest.mark.slow
def test_slow_tests_that_begin_late_are_skipped():
    names = "test_an_empty_base_selects_all or test_changes_of_this_package"
    file = str(ROOT / "tests" / "project" / "test_select_tests.py")
    printed = run_tests("-rs", "-k", names, file, SLOW_MINUTES="0")
    assert "slow, and not begun within 0 minutes" in printed
    assert "1 passed, 1 skipped" in printed
