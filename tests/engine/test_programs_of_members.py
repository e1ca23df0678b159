"""Every member gets its own program: in one process with all others, whatever their order, and in a
process of its own with what all others have left on the disk.

Where plain JAX ends is in a file, because XLA's programs of all members take longer than all else:
`python tests/engine/test_programs_of_members.py` computes it anew.
"""

import json
import os
import pickle
import random
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.engine import native

TESTS = Path(__file__).parents[1]
STORED = TESTS / "data" / "member_runs.json"
METHOD = "euler"
"""Its programs are compiled in a third of the time of those of "rk4"; a loop that does not admit it
has another (`member_runs.fitting`)."""
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
    command = [sys.executable, str(TESTS / "member_runs.py"), str(folder), *options]
    text = "\n".join(lines)
    done = subprocess.run(command, input=text, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = [json.loads(line) for line in done.stdout.splitlines()]
    return {(x["name"], x["backend"]): x["end"] for x in found}


def scenarios() -> dict[str, Callable[[], ij.Scenario]]:
    import scenarios_of_members  # it computes, and not all tests here need it

    return scenarios_of_members.scenarios()


def write_pickles(names: list[str], folder: Path) -> None:
    """A process that made its scenario itself would compile the operations of all others first."""
    folder.mkdir(exist_ok=True)
    make = scenarios()
    for name in names:
        (folder / f"{name}.pickle").write_bytes(pickle.dumps(make[name]()))


def in_any_order(lines: list[str]) -> list[str]:
    return random.Random(0 if os.environ.get("CI") else None).sample(lines, len(lines))


def check_ends(found: dict[tuple[str, str], list], expected: dict[str, np.ndarray]) -> None:
    for name, end in expected.items():
        atol = 1e-9 * max(1.0, np.abs(end).max())
        one = np.ravel(found[name, "native"])
        np.testing.assert_allclose(one, end, rtol=0, atol=atol, err_msg=name)


@pytest.mark.slow
def test_laws_that_are_alike_have_their_own_programs(tmp_path):
    write_pickles(ALIKE, tmp_path)
    lines = [f"{backend} rk4 {name}" for name in ALIKE for backend in ("native", "vmap")]
    together = answers(in_any_order(lines), tmp_path)
    check_ends(together, {name: np.ravel(together[name, "vmap"]) for name in ALIKE})
    apart = answers([f"native rk4 {name}" for name in ALIKE], tmp_path, "--apart")
    assert apart == {key: end for key, end in together.items() if key[1] == "native"}


@pytest.mark.slow
@pytest.mark.members
@pytest.mark.parametrize("part", range(8))
def test_every_member_has_its_own_program(tmp_path_factory, part):
    """In eight parts, with one folder in common if one process runs them."""
    folder = tmp_path_factory.getbasetemp() / "cache of members"
    names = sorted(scenarios())
    random.Random(1).shuffle(names)
    names = names[part::8]
    write_pickles(names, folder)
    lines = [f"native {METHOD} {name}" for name in names]
    together = answers(in_any_order(lines), folder)
    stored = json.loads(STORED.read_text())
    check_ends(together, {name: np.array(stored[name]) for name in names})
    assert answers(lines, folder, "--apart") == together


def write() -> None:
    names = sorted(scenarios())
    with tempfile.TemporaryDirectory() as folder:
        write_pickles(names, Path(folder))
        found = answers([f"vmap {METHOD} {name}" for name in names], Path(folder))
    ends = {name: np.ravel(end).tolist() for (name, _), end in found.items()}
    lines = [f" {json.dumps(name)}: {json.dumps(end)}" for name, end in ends.items()]
    STORED.write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    write()
