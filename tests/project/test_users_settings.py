"""What other tests find holds as users compile too: the tests' own settings (conftest.py) leave out
what compilers optimise.

An optimiser may add up in another order in another batch, and fails on functions of its own; so
these are the tests of the reference data, of bit-identity, of the functions of kernels, and of the
ways in which XLA is given a loop.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import conftest
import pytest

ROOT = Path(__file__).parents[2]
AGAIN = {
    "the paper": [
        "simulation/test_paper.py::test_all_four_variants_at_one_millisecond[integral-printed]",
        "simulation/test_paper.py::test_what_the_paper_shows",
    ],
    "shapes": ["engine/test_loops.py::test_every_loop_makes_the_same_run[euler-None]"],
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


def plain_environment() -> dict[str, str]:
    """The environment without what this run of the tests has put into it."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}


def test_the_testers_own_flags_come_last():
    flags, own = os.environ["XLA_FLAGS"], os.environ["TESTER_XLA_FLAGS"]
    as_users = bool(os.environ.get("TEST_AS_USERS"))
    assert flags == f"{'' if as_users else conftest.XLA_FLAGS} {own}".strip()
    assert (os.environ.get("CXX") == str(ROOT / "tests" / "quick_compiler")) == bool(
        os.environ["TESTER_CXX"] and not as_users
    )


@pytest.mark.parametrize(
    "what",
    [
        pytest.param(name, marks=pytest.mark.slow if name == "the paper" else pytest.mark.release)
        for name in AGAIN
    ],
)
def test_the_same_as_users_compile(what):
    plain = plain_environment()
    names = [str(ROOT / "tests" / name) for name in (SETTINGS, *AGAIN[what])]
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-n",
        "0",
        "-p",
        "no:cacheprovider",
        "-m",
        "not release",
        *names,
    ]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=plain | {"TEST_AS_USERS": "1", "TEST_PART": ""},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout[-3000:]
    assert f"{len(names)} passed" in done.stdout


def slow_tests(part: str) -> set[str]:
    """The slow tests of a file that a run with this TEST_PART has."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-n", "0", "-m", "slow"]
    done = subprocess.run(
        [*command, str(ROOT / "tests" / "control" / "test_laws.py")],
        cwd=ROOT,
        env=plain_environment() | {"TEST_PART": part},
        capture_output=True,
        text=True,
        check=True,
    )
    return {line for line in done.stdout.splitlines() if "::" in line}


@pytest.mark.slow
def test_the_parts_of_the_slow_tests_are_disjoint_and_complete():
    every, first, second = slow_tests(""), slow_tests("0/2"), slow_tests("1/2")
    assert first and second and not first & second
    assert first | second == every
