"""Every number of a short run of every preset, and every line of its certificate: what a change of
structure must not move.

`tests/data/digests.json` has them, with a SHA-256 digest of the bytes of each signal and metric.
The tests compare the numbers to 1e-9, which holds on every processor and with every supported
version of JAX.  To check a refactoring, compare bit by bit on one machine,

    python tests/engine/test_digests.py --write FILE          before the change,
    python tests/engine/test_digests.py --compare FILE        after it,

where the second one names every field of every preset that moved; names of presets after FILE
select some.  After a change that is meant to move numbers, `--write tests/data/digests.json`
writes the stored file anew.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import hashlib
import json
import math
import os
import sys
import warnings
from collections.abc import Iterable, Iterator
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
RUN: dict[str, Any] = {"duration": 0.2, "dt": 5e-4}
SIGNALS = ("q", "dq", "tau", "V")
RELATIVE, ABSOLUTE = 1e-9, 1e-12
PAPER = ("zhang_yan_2024", "printed_gap", "zhang_yan_2024_saturated", "zhang_yan_2024_funnel")
"""Presets whose scenario is made at once; the first two share the program of their runs."""
RELEASE = (
    *("flexible_joint_iiwa14", "iiwa14", "ur5"),
    *("printed_gap", "zhang_yan_2024_funnel", "zhang_yan_2024_full_state"),
    *("motor_driven_pendulum", "vessel"),
)
"""Presets whose certificate takes minutes to compile, or is one of `test_certificate_texts.py`."""

Fields = dict[str, Any]

# ------------------------------------------------------------ what is stored


def digest(values: np.ndarray) -> str:
    """SHA-256 of type, shape and bytes."""
    words = f"{values.dtype} {values.shape} ".encode()
    return hashlib.sha256(words + np.ascontiguousarray(values).tobytes()).hexdigest()


def signal(values: Any) -> Fields:
    """Digest, last value, mean and largest size over time, of each component."""
    values = np.asarray(values)
    return {
        "sha256": digest(values),
        "shape": values.shape,
        "last": values[-1].ravel().tolist(),
        "mean": values.mean(axis=0).ravel().tolist(),
        "largest": np.abs(values).max(axis=0).ravel().tolist(),
    }


def metric(values: Any) -> Fields:
    """Digest and values."""
    values = np.asarray(values)
    return {"sha256": digest(values), "shape": values.shape, "values": values.ravel().tolist()}


@functools.cache
def scenario_of(preset: str) -> ij.Scenario:
    """The scenario of a preset, with its defaults."""
    return ij.presets.PRESETS[preset]()


@functools.cache
def run_of(preset: str) -> ij.Rollout:
    """Its run with all samples."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ij.SimulationWarning)
        return ij.simulate(scenario_of(preset), **RUN)


def structure_fields(preset: str) -> Fields:
    """The paths of all parameters, and the scenario file."""
    scenario = scenario_of(preset)
    return {
        "paths": [row.path for row in ij.parameters(scenario)],
        "file": scenario_to_toml(scenario),
    }


def run_fields(preset: str) -> Fields:
    """Signals and metrics of the run."""
    run = run_of(preset)
    signals = {name: signal(getattr(run, name)) for name in SIGNALS}
    return signals | {f"metric {name}": metric(run.metrics[name]) for name in run.metrics}


def certificate_fields(preset: str) -> Fields:
    """The lines of the certificate of the run, or why there is none."""
    try:
        certificate = ij.certify(scenario_of(preset), run_of(preset))
    except ValueError as error:
        return {"certificate": str(error)}
    lines = {f"line {x.name}": dataclasses.asdict(x) for x in certificate.lines}
    return {"certificate": f"{certificate.headline} ({certificate.subject})"} | lines


GROUPS = {"structure": structure_fields, "run": run_fields, "certificate": certificate_fields}


def as_json(value: Any) -> Any:
    """A value as a file has it, with every digit."""
    return json.loads(json.dumps(value))


def fields_of(preset: str, groups: Iterable[str] = GROUPS) -> dict[str, Fields]:
    """Group -> name -> value."""
    return {group: as_json(GROUPS[group](preset)) for group in groups}


def as_text(table: dict[str, dict[str, Fields]]) -> str:
    """The file: a field a line, so that its difference names what moved."""
    presets = []
    for preset, groups in table.items():
        shown = []
        for group, fields in groups.items():
            rows = [f"   {json.dumps(name)}: {json.dumps(x)}" for name, x in fields.items()]
            shown.append(f"  {json.dumps(group)}: {{\n" + ",\n".join(rows) + "\n  }")
        presets.append(f" {json.dumps(preset)}: {{\n" + ",\n".join(shown) + "\n }")
    return "{\n" + ",\n".join(presets) + "\n}\n"


# ------------------------------------------------------------ what moved


def is_same(found: Any, stored: Any, slack: float) -> bool:
    """Whether two values are equal, but for rounding and the slack."""
    if isinstance(stored, dict):
        return found.keys() == stored.keys() and all(
            is_same(found[key], x, slack) for key, x in stored.items()
        )
    if isinstance(stored, list):
        pairs = zip(found, stored, strict=False)
        return len(found) == len(stored) and all(is_same(a, b, slack) for a, b in pairs)
    if isinstance(stored, float) and isinstance(found, float):
        if math.isnan(stored) or math.isnan(found):
            return math.isnan(stored) and math.isnan(found)
        return math.isclose(found, stored, rel_tol=RELATIVE, abs_tol=slack)
    if isinstance(stored, str) and isinstance(found, str):
        return same_text(found, stored)
    return type(found) is type(stored) and found == stored


def is_close(name: str, found: Any, stored: Any) -> bool:
    """Whether a field is equal to rounding.

    A signal may differ by 1e-9 of its largest value.  The margin of a line that is within the
    line's tolerance is rounding: it may differ by the tolerance, and its place is not compared.
    """
    if name == "file":  # its gains may be computed
        return same_text(found, stored, digits=9)
    if not (isinstance(found, dict) and isinstance(stored, dict)):
        return is_same(found, stored, ABSOLUTE)
    slack, ignored = ABSOLUTE, {"sha256"}
    if "largest" in stored:
        slack = max(slack, RELATIVE * max(stored["largest"], default=0.0))
    if "tolerance" in stored:
        ignored.add("tolerance")
        if stored["margin"] is not None and abs(stored["margin"]) <= stored["tolerance"]:
            slack = max(slack, stored["tolerance"])
            ignored |= {"joint", "time", "first_broken"}
    kept = [{key: x for key, x in field.items() if key not in ignored} for field in (found, stored)]
    return is_same(*kept, slack)


def is_equal(name: str, found: Any, stored: Any) -> bool:
    """Whether a field is equal bit by bit."""
    return json.dumps(found) == json.dumps(stored)


def in_words(name: str, found: Any, stored: Any) -> str:
    """What differs in a field."""
    if name in ("paths", "file"):
        rows = [x.splitlines() if isinstance(x, str) else x for x in (stored, found)]
        gone = [f"- {x}" for x in rows[0] if x not in rows[1]]
        new = [f"+ {x}" for x in rows[1] if x not in rows[0]]
        return "; ".join([*gone, *new]) or "another order"
    if isinstance(found, dict) and isinstance(stored, dict):
        keys = [key for key in found | stored if key != "sha256"]
        parts = [
            f"{key} {stored.get(key)} -> {found.get(key)}"
            for key in keys
            if not is_equal(name, found.get(key), stored.get(key))
        ]
        return "; ".join(parts) or "other values between the first and the last"
    return f"{stored} -> {found}"


def moved(found: Fields, stored: Fields, same: Any) -> Iterator[str]:
    """The fields that differ, in words."""
    for name in stored | found:
        if name not in found:
            yield f"{name}: no longer there"
        elif name not in stored:
            yield f"{name}: new"
        elif not same(name, found[name], stored[name]):
            yield f"{name}: {in_words(name, found[name], stored[name])}"


@functools.cache
def stored_file() -> dict[str, dict[str, Fields]]:
    """The stored numbers."""
    return json.loads(FILE.read_text())  # type: ignore[no-any-return]


def check(preset: str, group: str) -> None:
    """Compares the fields of a group with the stored ones."""
    found = fields_of(preset, (group,))[group]
    differences = list(moved(found, stored_file()[preset][group], is_close))
    assert not differences, "\n".join([f"{preset}:", *differences])


def presets(quick: Iterable[str], release: Iterable[str] = ()) -> list[Any]:
    """All presets; those that are not quick have a mark."""
    marks = dict.fromkeys(ij.presets.PRESETS, pytest.mark.slow)
    marks |= dict.fromkeys(release, pytest.mark.release)
    return [x if x in quick else pytest.param(x, marks=marks[x]) for x in ij.presets.PRESETS]


def test_every_preset_is_stored():
    assert list(stored_file()) == list(ij.presets.PRESETS)


@pytest.mark.parametrize("preset", presets(PAPER))
def test_paths_and_file(preset):
    check(preset, "structure")


@pytest.mark.parametrize("preset", presets(PAPER[:2]))
def test_run(preset):
    check(preset, "run")


@pytest.mark.parametrize("preset", presets((), RELEASE))
def test_certificate(preset):
    check(preset, "certificate")


def test_a_change_is_named():
    stored = {"q": signal(np.array([[1.0], [2.0]])), "line rho": {"margin": 1.0, "tolerance": 0.0}}
    found = as_json(stored)
    assert list(moved(found, as_json(stored), is_equal)) == []
    found["q"]["sha256"] = "another"
    found["line rho"]["margin"] = 1.0 + 1e-15
    assert list(moved(found, as_json(stored), is_close)) == []
    assert [x.split(":")[0] for x in moved(found, as_json(stored), is_equal)] == ["q", "line rho"]
    found["line rho"]["margin"] = 1.0 + 1e-6
    del found["q"]
    named = ["q: no longer there", "line rho: margin 1.0 -> 1.000001"]
    assert list(moved(found, as_json(stored), is_close)) == named


# ------------------------------------------------------------ bit by bit


def main() -> int:
    """Writes a file, or compares with one; the number of fields that moved."""
    from conftest import choose_compilers

    parser = argparse.ArgumentParser(description="Numbers of all presets, compared bit by bit.")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--write", metavar="FILE", type=Path)
    what.add_argument("--compare", metavar="FILE", type=Path)
    parser.add_argument("presets", nargs="*", help="some presets only; with --compare")
    options = parser.parse_args()
    choose_compilers(plain=True)
    if options.write:
        if options.presets:
            parser.error("--write takes all presets")
        options.write.write_text(as_text({x: fields_of(x) for x in ij.presets.PRESETS}))
        return 0
    stored, count = json.loads(options.compare.read_text()), 0
    for preset in options.presets or stored.keys() | ij.presets.PRESETS.keys():
        if preset not in stored or preset not in ij.presets.PRESETS:
            print(f"{preset}: only in one of both", flush=True)
            count += 1
            continue
        for group, fields in fields_of(preset).items():
            for difference in moved(fields, stored[preset][group], is_equal):
                print(f"{preset}: {difference}", flush=True)
                count += 1
    print(f"{count} fields moved")
    return min(count, 1)


if __name__ == "__main__":
    sys.exit(main())
