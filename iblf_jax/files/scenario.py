"""Scenario files: a scenario as typed, validated TOML, and back with the same structure and
bit-identical numbers.

Written out in full, a file has one table a component, and `kind` names the member of the family:

    [robot]                         # plant and model alike; or [plant] and, if they differ, [model]
    kind = "two_link"
    mass = [2.0, 0.85]
    ...
    [reference]  [bounds.lower]  [bounds.upper]  [disturbance]  [controller]  [controller.barrier]
    [observer]  [initial]

or its robot is read from a URDF or MJCF, `robot.file = "arm.urdf"` (see `files.robot`), or it
starts from a preset and changes some of it:

    preset = "zhang_yan_2024"
    [arguments]                     # what the preset takes
    law = "log"
    [parameters]                    # path -> value, in full files too
    "controller.K2" = 30.0

`[run]` (duration, dt, method, record_every) is optional and says how to run it.  A scalar stands
for one number a joint.  `dtype` is there only if the scenario's precision differs from JAX's at the
time.  Everything is checked: an unknown table, key or kind, a wrong type or shape, a missing key
  each is a ValueError that names the file, the dotted key, what came, what was expected and the
  remedy.
"""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.pytree import astype
from iblf_jax.files.components import construct, decode_fields, encode_fields, field_hints
from iblf_jax.files.robot import names_a_file, with_robots_read
from iblf_jax.files.values import (
    Words,
    as_table,
    decode_static,
    did_you_mean,
    known_keys,
    numbers,
    toml_tables,
)
from iblf_jax.presets import PRESETS
from iblf_jax.simulation.integrators import TABLEAUS
from iblf_jax.simulation.paths import parameters, with_parameters
from iblf_jax.simulation.scenario import Scenario, check_values

COMPONENTS = ("robot", *(field.name for field in dataclasses.fields(Scenario)))
RUN = ("duration", "dt", "method", "record_every")
DTYPES = ("float64", "float32", "float16", "bfloat16")


class ScenarioFile(NamedTuple):
    """What a scenario file holds."""

    scenario: Scenario
    run: dict[str, Any]
    """What its [run] table says: any of duration [s], dt [s], method, record_every."""


def save_scenario(
    scenario: Scenario, path: str | os.PathLike, *, run: Mapping[str, Any] | None = None
) -> None:
    """Writes a scenario to a TOML file that `load_scenario` gives back equal.

    Args:
      scenario: one scenario (not a batch).
      path: the file; its folder must exist.
      run: what to write into [run]: duration [s], dt [s], method, record_every.

    Raises:
      ValueError: the scenario holds a class that is in no MEMBERS, a NaN, or a batch.
      OSError: the file cannot be written.
    """
    checks.file_to_write("path", path).write_text(
        scenario_to_toml(scenario, run=run), encoding="utf-8"
    )


def load_scenario(path: str | os.PathLike) -> Scenario:
    """The scenario that a TOML file describes.

    Args:
      path: a file in the format at the head of this module.

    Raises:
      ValueError: the file is not TOML or does not describe a scenario; the message names file, key
        and remedy.
      OSError: the file cannot be read.
    """
    return load_scenario_file(path).scenario


def load_scenario_file(path: str | os.PathLike) -> ScenarioFile:
    """Scenario and [run] table of a TOML file; raises as `load_scenario`."""
    data = read_toml(path)
    return from_dict(data, source=os.fspath(path), folder=Path(path).parent)


def read_toml(path: str | os.PathLike) -> dict[str, Any]:
    """The tables of a TOML file, unchecked; ValueError if it is not TOML, OSError if it cannot be
    read.
    """
    content = checks.file_to_read("path", path, "a TOML file").read_bytes()
    try:
        return toml_tables(content.decode("utf-8"))
    except ValueError as error:  # TOMLDecodeError and UnicodeDecodeError are ValueErrors
        raise checks.inside(
            path, ValueError(f"not a TOML file: {checks.line(str(error))}")
        ) from error


# --- to tables


def scenario_to_dict(scenario: Scenario) -> dict[str, Any]:
    """The tables of a scenario file, as plain dicts, lists, numbers and strings.

    Args:
      scenario: one scenario (not a batch).

    Returns:
      What `from_dict` turns back into an equal scenario: same structure, bit-identical leaves.
        (Leaves of several precisions
      become the default one's, as in a run.)

    Raises:
      ValueError: as `save_scenario`.
    """
    if not isinstance(scenario, Scenario):
        raise checks.fail(
            "scenario", scenario, "a Scenario", "Make one with ij.presets or ij.Scenario."
        )
    if not checks.is_concrete(scenario):
        raise checks.fail(
            "scenario", Words("traced values"), "numbers", "Save it outside of jit, vmap and grad."
        )
    check_values(scenario)
    dtypes = {jnp.result_type(x) for x in jax.tree.leaves(scenario)}
    dtype = dtypes.pop() if len(dtypes) == 1 else jnp.result_type(float)
    scenario = astype(scenario, dtype)
    tables = encode_fields(scenario, "")
    plant, model = tables.pop("plant"), tables.pop("model")
    robots = (
        {"robot": plant}
        if _equal(scenario.plant, scenario.model)
        else {"plant": plant, "model": model}
    )
    tables = {**robots, **tables}
    if dtype != jnp.result_type(float):
        tables = {"dtype": str(dtype), **tables}
    _check_round_trip(scenario, tables)
    return tables


def _check_round_trip(scenario: Scenario, tables: dict[str, Any]) -> None:
    """Raises ValueError if the tables do not give the scenario back."""
    expected, remedy = (
        "one scenario that its tables give back",
        "Save the runs of a batch one by one.",
    )
    try:
        same = _equal(from_dict(tables).scenario, scenario)
    except ValueError as error:
        raise checks.fail(
            "scenario", Words(f"leaves that a scenario cannot have ({error})"), expected, remedy
        ) from error
    if not same:
        raise checks.fail("scenario", Words("leaves that change on the way"), expected, remedy)


def scenario_to_toml(scenario: Scenario, *, run: Mapping[str, Any] | None = None) -> str:
    """The text of a scenario's file; arguments and errors as `save_scenario`."""
    import tomli_w

    tables = scenario_to_dict(scenario)
    if run is not None:
        tables["run"] = _run_table(dict(checks.mapping("run", run, '{"duration": 20.0}')))
    text = tomli_w.dumps(tables)
    # tomli_w writes one number a line; a row a line reads better.  A line break inside a string is
    # escaped, so this is safe.
    text = re.sub(
        r"\[\n(?:\s*[-+.\w]+,\n)+\s*\]",
        lambda m: "[" + ", ".join(re.findall(r"[-+.\w]+", m[0])) + "]",
        text,
    )
    return _with_units(
        text,
        {p.path: p.unit for p in parameters(scenario, named=False)}
        | {"run.duration": "s", "run.dt": "s"},
    )


def _with_units(text: str, units: Mapping[str, str]) -> str:
    """The text with the unit of each number behind it, as a comment."""
    lines, prefix, counts = [], "", dict[str, int]()
    for line in text.removesuffix("\n").split(
        "\n"
    ):  # and at no other character that is a line break to Unicode
        if header := re.fullmatch(r"(\[\[?)([\w.]+)\]\]?", line):
            prefix, names = "", header[2].split(".")
            for depth, name in enumerate(names):
                prefix = f"{prefix}.{name}" if depth else "plant" if name == "robot" else name
                if header[1] == "[[" and depth == len(names) - 1:
                    counts[prefix] = counts.get(prefix, -1) + 1
                prefix += f"[{counts[prefix]}]" if prefix in counts else ""
        key = re.match(r"(\w+) = [-+\d\[]", line)
        unit = units.get(f"{prefix}.{key[1]}") if key else None
        lines.append(f"{line}  # {unit}" if unit and not line.endswith("[") else line)
    return "\n".join(lines) + "\n"


def _equal(a: Any, b: Any) -> bool:
    """Same structure, shapes, precisions and bits."""
    leaves_a, structure_a = jax.tree.flatten(a)
    leaves_b, structure_b = jax.tree.flatten(b)
    if structure_a != structure_b:  # type: ignore[operator]
        return False
    pairs = [(np.asarray(x), np.asarray(y)) for x, y in zip(leaves_a, leaves_b, strict=True)]
    return all(
        x.shape == y.shape and x.dtype == y.dtype and x.tobytes() == y.tobytes() for x, y in pairs
    )


# --- from tables


def from_dict(
    data: dict[str, Any],
    source: str = "",
    *,
    other_tables: Iterable[str] = (),
    folder: str | os.PathLike = "",
) -> ScenarioFile:
    """Scenario and [run] table from the tables of a file.

    Args:
      data: tables as read from TOML.
      source: name of the file, for messages.
      other_tables: names of further tables that the caller reads himself (a sweep's, say).
      folder: of the file, which the paths of robots' files are relative to.

    Raises:
      ValueError: anything that does not fit; the message names source, dotted key and remedy.
    """
    try:
        data = {
            key: value
            for key, value in as_table(data, "file").items()
            if key not in set(other_tables)
        }
        scenario = _from_preset(data) if "preset" in data else _from_components(data, folder)
        if "dtype" in data:
            scenario = astype(scenario, _dtype(data["dtype"]))
        changes = by_path(as_table(data.get("parameters", {}), "parameters"), "parameters")
        scenario = construct(
            with_parameters, {"scenario": scenario, "values": changes}, "parameters"
        )
        return ScenarioFile(scenario, _run_table(data.get("run", {})))
    except ValueError as error:
        raise checks.inside(source, error) from error


def _from_components(data: dict[str, Any], folder: str | os.PathLike) -> Scenario:
    known_keys(data, "", (*COMPONENTS, "preset", "parameters", "run", "dtype"))
    tables = {key: value for key, value in data.items() if key in COMPONENTS}
    for other in ("plant", "model"):
        if "robot" in tables and other in tables:
            raise checks.fail(
                other,
                Words("this table beside [robot]"),
                "[robot] alone, or [plant] and [model]",
                f"Rename [robot] to [{_OTHER[other]}].",
            )
    if names_a_file(tables):
        tables = with_robots_read(tables, folder)
    robot = tables.pop("robot", None)
    if robot is None:
        if "plant" not in tables:
            raise checks.fail(
                "robot",
                Words("nothing"),
                "a table [robot], or [plant] and [model]",
                "Add it, or start from preset = ...",
            )
        return decode_fields(Scenario, tables, "")
    try:
        return decode_fields(Scenario, {"plant": robot, **tables}, "")
    except ValueError as error:
        raise ValueError(
            re.sub(r"^plant\b", "robot", str(error)).replace("[plant]", "[robot]")
        ) from error


_OTHER = {"plant": "model", "model": "plant"}


def _from_preset(data: dict[str, Any]) -> Scenario:
    for name in COMPONENTS:
        if name in data:
            remedy = (
                "Change its numbers in [parameters], or take the full text: python -m iblf_jax"
                f" presets {data['preset']} --toml."
            )
            raise checks.fail(
                name,
                Words("this table beside preset"),
                "a preset, or a scenario written out",
                remedy,
            )
    known_keys(data, "", ("preset", "arguments", "parameters", "run", "dtype"))
    return preset_scenario(data["preset"], as_table(data.get("arguments", {}), "arguments"))


def preset_scenario(name: Any, arguments: dict[str, Any]) -> Scenario:
    """The scenario of a preset, its name and its arguments checked.

    Args:
      name: a key of `presets.PRESETS`.
      arguments: the preset's own, by name.

    Raises:
      ValueError: an unknown preset or argument, or a value that the preset refuses.
    """
    as_table(arguments, "arguments")
    if not isinstance(name, str) or name not in PRESETS:
        raise checks.fail("preset", name, "the name of a preset", did_you_mean(name, PRESETS))
    preset = PRESETS[name]
    taken = inspect.signature(preset).parameters
    known_keys(arguments, "arguments", taken)
    hints = field_hints(preset)
    for key, parameter in taken.items():
        if parameter.default is parameter.empty and key not in arguments:
            raise checks.fail(
                f"arguments.{key}", Words("nothing"), f"a value; the preset {name} needs it"
            )
    values = {
        key: decode_static(value, hints.get(key, Any), f"arguments.{key}")
        for key, value in arguments.items()
    }
    return construct(preset, values, "arguments")


def by_path(table: dict[str, Any], name: str, prefix: str = "") -> dict[str, Any]:
    """Path -> numbers of a table [name]: `"controller.K2" = 1` and `controller.K2 = 1` mean the
    same.
    """
    found: dict[str, Any] = {}
    for key, value in table.items():
        path = f"{prefix}.{key}" if prefix else key
        found |= (
            by_path(value, name, path)
            if isinstance(value, dict)
            else {path: numbers(value, f"{name}.{path}")}
        )
    return found


def _dtype(name: Any) -> Any:
    checks.one_of("dtype", name, DTYPES)
    if name == "float64" and jnp.result_type(float) != jnp.float64:
        raise checks.fail(
            "dtype",
            name,
            "float32",
            'JAX\'s 64-bit mode is off: jax.config.update("jax_enable_x64", True), or leave dtype'
            " out.",
        )
    return jnp.dtype(name)


def _run_table(table: Any) -> dict[str, Any]:
    """The [run] table, checked."""
    known_keys(as_table(table, "run"), "run", RUN)
    values = {
        key: value.item() if isinstance(value, np.generic) else value
        for key, value in table.items()
    }
    for key, unit in (("duration", "s"), ("dt", "s")):
        if key in values:
            values[key] = checks.positive_number(f"run.{key}", values[key], unit)
    if "method" in values:
        checks.one_of("run.method", values["method"], tuple(TABLEAUS))
    if "record_every" in values:
        values["record_every"] = checks.positive_integer("run.record_every", values["record_every"])
    return values
