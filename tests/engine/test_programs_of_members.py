"""Every member gets its own program: in one process with all others, whatever their order, and in a
process of its own with what all others have left on the disk.
"""

from __future__ import annotations

import json
import os
import pickle
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.engine import native

TESTS = Path(__file__).parents[1]
ALIKE = ["barrier tan", "barrier mapping"]
"""Members whose programs differ in nothing but their operations."""

pytestmark = pytest.mark.skipif(native.unavailable() is not None, reason="no C++ compiler")


def answers(lines: list[str], folder: Path, *options: str) -> dict[tuple[str, str], list]:
    """(member, backend) -> what `member_runs.py` answers, with the pickles and the cache in
    `folder`."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(TESTS), str(TESTS.parent)]),
        "XDG_CACHE_HOME": str(folder),
        "JAX_ENABLE_COMPILATION_CACHE": "1",
        "PYTHONWARNINGS": "ignore",
    }
    done = subprocess.run(
        [sys.executable, str(TESTS / "member_runs.py"), str(folder), *options],
        input="\n".join(lines),
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    found = [json.loads(line) for line in done.stdout.splitlines()]
    return {(x["name"], x["backend"]): x["end"] for x in found}


def scenarios() -> dict[str, Callable[[], ij.Scenario]]:
    """Name of a member -> function that makes its scenario."""
    import scenarios_of_members  # it computes, and not all tests here need it

    return scenarios_of_members.scenarios()


def check(names: list[str], method: str, folder: Path) -> None:
    """Compares the compiled run with plain JAX, in one process and in one process a member."""
    # A process that made its scenario itself would compile the operations of all others first.
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / f"{name}.pickle").write_bytes(pickle.dumps(scenarios()[name]()))
    order = [f"{backend} {method} {name}" for name in names for backend in ("native", "vmap")]
    random.Random(0 if os.environ.get("CI") else None).shuffle(order)
    together = answers(order, folder)
    assert len(together) == len(order)
    for name in names:
        one, other = (np.concatenate(together[name, x], axis=None) for x in ("native", "vmap"))
        scale = max(1.0, np.abs(other).max())
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9 * scale, err_msg=name)
    apart = answers([f"native {method} {name}" for name in names], folder, "--apart")
    assert apart == {key: end for key, end in together.items() if key[1] == "native"}


@pytest.mark.slow
def test_laws_that_are_alike_have_their_own_programs(tmp_path):
    check(ALIKE, "rk4", tmp_path)


@pytest.mark.slow
@pytest.mark.members
@pytest.mark.parametrize("part", range(8))
def test_every_member_has_its_own_program(tmp_path_factory, part):
    """In eight parts, with one folder in common if one process runs them; by Euler's method, whose
    programs are compiled in a third of the time, where the loop admits it."""
    folder = tmp_path_factory.getbasetemp() / "cache of members"
    names = sorted(scenarios())
    random.Random(1).shuffle(names)
    check(names[part::8], "euler", folder)
