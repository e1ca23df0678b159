"""Every number of a short run of every preset: what a change of structure must not move.

`tests/data/digests.json` has them, with a SHA-256 digest of the bytes of each signal and metric.
The tests compare the numbers to 1e-9, which holds on every processor and with every supported
version of JAX.  To check a refactoring, compare bit by bit on one machine: before and after it,

    python tests/engine/test_digests.py FILE

writes a file, in which each field is a line, so that `diff` names what moved.  After a change that
is meant to move numbers, `tests/data/digests.json` as FILE writes the stored file anew.
"""

import functools
import hashlib
import itertools
import json
import math
import os
import sys
import warnings
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")
TESTS = Path(__file__).parents[1]
if __name__ == "__main__":
    sys.path.insert(0, str(TESTS))

import numpy as np
import pytest
from compared_texts import same_text

import iblf_jax as ij
from iblf_jax.files.scenario import scenario_to_toml

FILE = TESTS / "data" / "digests.json"
SIGNALS = ("q", "dq", "tau", "V")
RELATIVE, ABSOLUTE = 1e-9, 1e-12
QUICK = ("zhang_yan_2024", "printed_gap")
"""Presets whose scenario is made at once; they share the program of their runs."""
SLOW = [pytest.param(x, marks=pytest.mark.slow) for x in ij.presets.PRESETS if x not in QUICK]


def with_digest(array: Any, **fields: Any) -> dict[str, Any]:
    """Fields of an array, with the SHA-256 of its type, shape and bytes."""
    words = f"{array.dtype} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes()
    numbers = {name: np.ravel(x).tolist() for name, x in fields.items()}
    return {"sha256": hashlib.sha256(words).hexdigest(), "shape": array.shape} | numbers


def signal(values: Any) -> dict[str, Any]:
    """Digest, last value, mean and largest size over time, of each component."""
    largest = np.abs(values).max(axis=0)
    return with_digest(values, last=values[-1], mean=values.mean(axis=0), largest=largest)


def structure_fields(preset: str) -> dict[str, Any]:
    scenario = ij.presets.PRESETS[preset]()
    paths = [row.path for row in ij.parameters(scenario)]
    return {"paths": paths, "file": scenario_to_toml(scenario)}


def run_fields(preset: str) -> dict[str, Any]:
    with warnings.catch_warnings(action="ignore", category=ij.SimulationWarning):
        run = ij.simulate(ij.presets.PRESETS[preset](), duration=0.2, dt=5e-4)
    signals = {name: signal(np.asarray(getattr(run, name))) for name in SIGNALS}
    metrics = {f"metric {name}": np.asarray(x) for name, x in run.metrics.items()}
    return signals | {name: with_digest(x, values=x) for name, x in metrics.items()}


GROUPS = {"structure": structure_fields, "run": run_fields}


def as_text(table: Any, depth: int = 3, indent: str = "") -> str:
    """The file: a field a line, so that its difference names what moved."""
    if not depth:
        return json.dumps(table)
    inner = indent + " "
    rows = [f"{inner}{json.dumps(key)}: {as_text(x, depth - 1, inner)}" for key, x in table.items()]
    return "{\n" + ",\n".join(rows) + f"\n{indent}}}"


def is_same(found: Any, stored: Any, slack: float = ABSOLUTE) -> bool:
    """Whether two values are equal but for rounding; a signal may differ by 1e-9 of its largest
    value."""
    if type(found) is not type(stored):
        return False
    if isinstance(stored, dict):
        slack = max(slack, RELATIVE * max(stored.get("largest", ()), default=0.0))
        return found.keys() == stored.keys() and all(
            is_same(found[key], x, slack) for key, x in stored.items() if key != "sha256"
        )
    if isinstance(stored, list):
        pairs = itertools.zip_longest(found, stored)
        return all(is_same(a, b, slack) for a, b in pairs)
    if isinstance(stored, float):
        both_nan = math.isnan(stored) and math.isnan(found)
        return both_nan or math.isclose(found, stored, rel_tol=RELATIVE, abs_tol=slack)
    return same_text(found, stored, digits=9) if isinstance(stored, str) else bool(found == stored)


def moved(found: dict[str, Any], stored: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """The fields that differ, or are in one of both only, with what was stored and found."""
    pairs = {name: (stored.get(name), found.get(name)) for name in stored | found}
    return {name: (a, b) for name, (a, b) in pairs.items() if not is_same(b, a)}


@functools.cache
def stored_file() -> dict[str, Any]:
    return json.loads(FILE.read_text())  # type: ignore[no-any-return]


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("preset", [*QUICK, *SLOW])
def test_what_is_stored_does_not_move(preset, group):
    found = json.loads(json.dumps(GROUPS[group](preset)))
    assert moved(found, stored_file()[preset][group]) == {}


def test_every_preset_is_stored():
    assert list(stored_file()) == list(ij.presets.PRESETS)


def test_a_change_is_named():
    stored = {"q": signal(np.array([[1.0], [2.0]])), "tau": signal(np.array([[1.0]]))}
    found, stored = json.loads(json.dumps([stored, stored]))
    found["q"]["sha256"] = "another"
    found["tau"]["mean"] = [1.0 + 1e-15]
    assert moved(found, stored) == {}
    found["tau"]["mean"] = [1.0 + 1e-6]
    assert moved(found, stored) == {"tau": (stored["tau"], found["tau"])}
    del found["q"]
    assert moved(found, stored).keys() == {"q", "tau"}


if __name__ == "__main__":
    from conftest import choose_compilers

    choose_compilers(plain=True)
    table = {x: {group: GROUPS[group](x) for group in GROUPS} for x in ij.presets.PRESETS}
    Path(sys.argv[1]).write_text(as_text(table) + "\n")
