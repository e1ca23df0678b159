"""Reads and writes scenario files: validated TOML that gives a scenario back with the same
structure and bit-identical numbers.

A complete file has one table per component, and `kind` names the member of the family:

    [robot]                         # plant and model, or [plant]; both tables if they differ
    kind = "two_link"
    mass = [2.0, 0.85]
    ...
    [reference]  [bounds.lower]  [bounds.upper]  [disturbance]  [controller]  [controller.barrier]
    [observer]  [initial]

[bounds] is a list of tables, [[bounds]], where levels above the first have bounds too.
The robot may be read from a URDF or MJCF, `robot.file = "arm.urdf"` (see `files.robot`).  A file
may also start from a preset and change some of its parameters:

    preset = "zhang_yan_2024"
    [arguments]                     # arguments of the preset
    law = "log"
    [parameters]                    # path -> value; complete files may have this table too
    "controller.K2" = 30.0

or from another scenario file, whose tables it takes, and change [parameters] and [run] of it:

    scenario = "scenario.toml"      # relative to this file

The optional table `[run]` (duration, dt, method, record_every) describes a simulation.  A scalar
stands for one number per joint.  `dtype` is present only if the precision of the scenario differs
from JAX's default.  An unknown table, key or kind, a wrong type or shape, and a missing key raise a
ValueError that names the file, the dotted key, what came, what was expected and the remedy.
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
from numpy.typing import ArrayLike

from iblf_jax.core import checks
from iblf_jax.core.pytree import astype
from iblf_jax.files import earlier
from iblf_jax.files.components import (
    construct,
    decode_fields,
    encode_fields,
    field_hints,
)
from iblf_jax.files.modules import (
    needs_a_module,
    tables_of_modules,
    with_modules_read,
    with_weights_in_file,
)
from iblf_jax.files.robot import names_a_file, with_robots_read
from iblf_jax.files.values import (
    NONE,
    Words,
    as_table,
    by_path,
    decode_static,
    did_you_mean,
    dotted,
    known_keys,
    missing,
    numbers,
    toml_tables,
)
from iblf_jax.presets import PRESETS
from iblf_jax.simulation.integrators import METHODS
from iblf_jax.simulation.paths import full_path, parameters, parse, with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.scenario_rules import check_leaves

COMPONENTS = ("robot", *(field.name for field in dataclasses.fields(Scenario)))
RUN = ("duration", "dt", "method", "record_every")
WEIGHTS = ".weights.npz"
"""Ending of the file with the arrays of modules, in place of that of the scenario file."""
DTYPES = ("float64", "float32", "float16", "bfloat16")
COMMANDS = {
    "study": "montecarlo",
    "sweep": "sweep",
    "failure": "failure",
    "tune": "tune",
    "identify": "identify",
}
"""Table of a file that is no scenario file -> the command that reads it."""


class ScenarioFile(NamedTuple):
    """The content of a scenario file."""

    scenario: Scenario
    run: dict[str, Any]
    """The table [run]: any of duration [s], dt [s], method, record_every."""


def save_scenario(
    scenario: Scenario, path: str | os.PathLike, *, run: Mapping[str, Any] | None = None
) -> None:
    """Writes a scenario to a TOML file from which `load_scenario` returns an equal scenario.

    Args:
      scenario: one scenario (not a batch).
      path: the file; its folder must exist.  The arrays of modules of other libraries are written
        beside it, NAME.weights.npz for NAME.toml.
      run: content of the table [run]: duration [s], dt [s], method, record_every.

    Raises:
      ValueError: the scenario contains a class that is in no MEMBERS, or NaN, or is a batch.
      OSError: the file cannot be written.
    """
    target = checks.file_to_write("path", path)
    tables = scenario_to_dict(scenario)
    beside = target.with_suffix(WEIGHTS)
    weights = with_weights_in_file(tables, beside)
    text = _as_toml(tables, scenario, run)
    if weights is not None:
        checks.file_to_write("path", beside).write_bytes(weights)
    target.write_text(text, encoding="utf-8")


def load_scenario(path: str | os.PathLike, *, modules: Mapping[str, Any] | None = None) -> Scenario:
    """The scenario that a TOML file describes.

    Args:
      path: a file in the format that the docstring of this module describes.
      modules: dotted key of the file -> a module with the structure of the saved one, whose
        floating-point arrays are replaced by those of the file, {"controller.net": net}. Modules
        that a file cannot describe, such as those of Flax NNX, need it. Functions and settings are
        those of the module that is passed; they are not compared with the saved ones.

    Raises:
      ValueError: the file is not TOML or does not describe a scenario; the message names file, key
        and remedy.
      OSError: the file cannot be read.
    """
    return load_scenario_file(path, modules=modules).scenario


def load_scenario_file(
    path: str | os.PathLike, *, modules: Mapping[str, Any] | None = None
) -> ScenarioFile:
    """Scenario and [run] table of a TOML file; arguments and errors as `load_scenario`."""
    data = read_toml(path)
    return from_dict(data, source=os.fspath(path), folder=Path(path).parent, modules=modules)


def read_toml(path: str | os.PathLike) -> dict[str, Any]:
    """The tables of a TOML file, not validated.

    Raises:
      ValueError: the file is not TOML.
      OSError: the file cannot be read.
    """
    content = checks.file_to_read("path", path, "a TOML file").read_bytes()
    try:
        return toml_tables(content.decode("utf-8"))
    except ValueError as error:  # TOMLDecodeError and UnicodeDecodeError are ValueErrors
        found = ValueError(f"not a TOML file: {checks.one_line(str(error))}")
        raise checks.with_location(path, found) from error


# --- to tables


def scenario_to_dict(scenario: Scenario) -> dict[str, Any]:
    """The tables of a scenario file, as dicts, lists, numbers and strings.

    Args:
      scenario: one scenario (not a batch).

    Returns:
      Tables from which `from_dict` makes an equal scenario: same structure, bit-identical leaves.
      (Leaves of several precisions get the default precision, as in a run.)

    Raises:
      ValueError: as `save_scenario`.
    """
    if not isinstance(scenario, Scenario):
        remedy = "Make one with ij.presets or ij.Scenario."
        raise checks.fail("scenario", scenario, "a Scenario", remedy)
    if not checks.is_concrete(scenario):
        remedy = "Save it outside of jit, vmap and grad."
        raise checks.fail("scenario", Words("traced values"), "numbers", remedy)
    check_leaves(scenario)
    dtypes = {jnp.result_type(x) for x in jax.tree.leaves(scenario)}
    dtype = dtypes.pop() if len(dtypes) == 1 else jnp.result_type(float)
    scenario = astype(scenario, dtype)
    tables = encode_fields(scenario, "")
    while tables["bounds"][-1] == NONE:
        tables["bounds"].pop()
    if len(tables["bounds"]) == 1:
        [tables["bounds"]] = tables["bounds"]
    robots = {name: tables.pop(name) for name in ("plant", "model")}
    if _equal(scenario.plant, scenario.model):
        name = "robot" if scenario.loop.plant.robot is scenario.plant else "plant"
        robots = {name: robots["plant"]}
    tables = robots | tables
    if dtype != jnp.result_type(float):
        tables = {"dtype": str(dtype), **tables}
    _check_round_trip(scenario, tables)
    return tables


def _check_round_trip(scenario: Scenario, tables: dict[str, Any]) -> None:
    """Raises ValueError if the tables do not give an equal scenario."""
    expected = "one scenario that its tables reproduce"
    remedy = "Save the runs of a batch one by one."
    opaque = {}
    for path, table in tables_of_modules(tables):
        if not needs_a_module(table):
            continue
        part: Any = scenario
        for token in parse(re.sub(r"^robot\b", "plant", path)):
            part = part[token] if isinstance(token, int) else vars(part)[token]
        opaque[path] = part
    try:
        same = _equal(from_dict(tables, modules=opaque).scenario, scenario)
    except ValueError as error:
        came = Words(f"leaves that a scenario cannot have ({error})")
        raise checks.fail("scenario", came, expected, remedy) from error
    if not same:
        came = Words("leaves that a file does not reproduce")
        raise checks.fail("scenario", came, expected, remedy)


def scenario_to_toml(scenario: Scenario, *, run: Mapping[str, Any] | None = None) -> str:
    """The text of a scenario's file; arguments and errors as `save_scenario`."""
    return _as_toml(scenario_to_dict(scenario), scenario, run)


def _as_toml(tables: dict[str, Any], scenario: Scenario, run: Mapping[str, Any] | None) -> str:
    """The text of the tables of a scenario."""
    import tomli_w

    if run is not None:
        tables["run"] = _run_table(dict(checks.mapping("run", run, '{"duration": 20.0}')))
    text = tomli_w.dumps(tables)
    # tomli_w writes one number per line; this joins the numbers of a row.  Line breaks inside
    # strings are escaped, so the pattern matches no string.
    text = re.sub(
        r"\[\n(?:\s*[-+.\w]+,\n)+\s*\]",
        lambda row: "[" + ", ".join(re.findall(r"[-+.\w]+", row[0])) + "]",
        text,
    )
    units = {p.path: p.unit for p in parameters(scenario, named=False)}
    return _with_units(text, units | {"run.duration": "s", "run.dt": "s"})


def _with_units(text: str, units: Mapping[str, str]) -> str:
    """The text with the unit of each number as a comment behind it."""
    lines = []
    prefix = ""
    counts: dict[str, int] = {}
    # str.splitlines would also split at other Unicode line breaks.
    for line in text.removesuffix("\n").split("\n"):
        if header := re.fullmatch(r"(\[\[?)([\w.]+)\]\]?", line):
            prefix = _path_of_table(header[2].split("."), counts, is_entry=header[1] == "[[")
        key = re.match(r"(\w+) = [-+\d\[]", line)
        if key and not line.endswith("["):
            unit = units.get(full_path(f"{prefix}.{key[1]}"))
            if unit:
                line = f"{line}  # {unit}"
        lines.append(line)
    return "\n".join(lines) + "\n"


def _path_of_table(names: list[str], counts: dict[str, int], *, is_entry: bool) -> str:
    """The path of a table in the scenario.

    Args:
      names: the parts of the table's header.
      counts: path of a list of tables -> index of its last entry so far; updated.
      is_entry: whether the header begins an entry of a list, [[...]].
    """
    if names[0] == "robot":
        names = ["plant", *names[1:]]
    path = ""
    for depth, name in enumerate(names, 1):
        path = dotted(path, name)
        if is_entry and depth == len(names):
            counts[path] = counts.get(path, -1) + 1
        if path in counts:
            path += f"[{counts[path]}]"
    return path


def _equal(a: object, b: object) -> bool:
    """Whether two pytrees have the same structure, shapes, precisions and bits."""
    leaves_a, structure_a = jax.tree.flatten(a)
    leaves_b, structure_b = jax.tree.flatten(b)
    if structure_a != structure_b:  # type: ignore[operator]
        return False
    return all(map(_same_bits, leaves_a, leaves_b))


def _same_bits(x: ArrayLike, y: ArrayLike) -> bool:
    x, y = np.asarray(x), np.asarray(y)
    return x.shape == y.shape and x.dtype == y.dtype and x.tobytes() == y.tobytes()


# --- from tables


def from_dict(
    data: dict[str, Any],
    source: str = "",
    *,
    other_tables: Iterable[str] = (),
    folder: str | os.PathLike = "",
    modules: Mapping[str, Any] | None = None,
) -> ScenarioFile:
    """Scenario and [run] table from the tables of a file.

    Args:
      data: the tables of the TOML file.
      source: name of the file, for messages.
      other_tables: names of further tables that the caller reads (those of a sweep, for example).
      folder: folder of the file, to which the paths of robot files and of weights are relative.
      modules: modules of the caller's, as `load_scenario` takes them.

    Raises:
      ValueError: tables that do not fit; the message names source, dotted key and remedy.
    """
    try:
        others = set(other_tables)
        data = {key: x for key, x in as_table(data, "file").items() if key not in others}
        for table, command in COMMANDS.items():
            if table in data:
                remedy = f"The command `iblf-jax {command}` reads files with it."
                expected = "none in a file of this kind"
                raise checks.fail(table, checks.Words("a table"), expected, remedy)
        if "scenario" in data:
            data, folder = _with_scenario_read(data, folder)
        if "preset" in data:
            with_modules_read({}, folder, modules)  # A preset has none: refuses any that is given.
            scenario = _from_preset(data)
        else:
            scenario = _from_components(data, folder, modules)
        if "dtype" in data:
            dtype = data["dtype"]
            checks.one_of("dtype", dtype, DTYPES)
            if dtype == "float64" and jnp.result_type(float) != jnp.float64:
                call = 'jax.config.update("jax_enable_x64", True)'
                remedy = f"JAX's 64-bit mode is off: {call}, or leave dtype out."
                raise checks.fail("dtype", dtype, "float32", remedy)
            scenario = astype(scenario, jnp.dtype(dtype))
        changes = {"scenario": scenario, "values": numbers_by_path(data, "parameters")}
        scenario = construct(with_parameters, changes, "parameters")
        return ScenarioFile(scenario, _run_table(data.get("run", {})))
    except ValueError as error:
        raise checks.with_location(source, error) from error


def _with_scenario_read(
    data: dict[str, Any], folder: str | os.PathLike
) -> tuple[dict[str, Any], Path]:
    """The tables of the file that `scenario` names, changed by [parameters] and [run] of this
    file, and the folder of that file.

    Raises:
      ValueError: another key beside `scenario`, or a file that is no scenario file.
      OSError: the file cannot be read.
    """
    known_keys(data, "", ("scenario", "parameters", "run"))
    name = checks.string("scenario", data["scenario"], "the path of a scenario file")
    path = Path(folder, name)
    tables = read_toml(path)
    known_keys(tables, name, (*COMPONENTS, "preset", "arguments", "parameters", "run", "dtype"))
    changed = {
        key: as_table(tables.get(key, {}), key) | as_table(data[key], key)
        for key in ("parameters", "run")
        if key in data
    }
    return tables | changed, path.parent


def _from_components(
    data: dict[str, Any], folder: str | os.PathLike, modules: Mapping[str, Any] | None
) -> Scenario:
    data = earlier.with_bounds_of_levels(data)
    known_keys(data, "", (*COMPONENTS, "preset", "parameters", "run", "dtype"))
    tables = {key: value for key, value in data.items() if key in COMPONENTS}
    for present, absent in (("plant", "model"), ("model", "plant")):
        if "robot" in tables and present in tables:
            came = Words("this table besides [robot]")
            remedy = f"Rename [robot] to [{absent}]."
            raise checks.fail(present, came, "only [robot], or [plant] and [model]", remedy)
    tables = with_modules_read(tables, folder, modules)
    if names_a_file(tables):
        tables = with_robots_read(tables, folder)
    robot = tables.pop("robot", None)
    if robot is None:
        if "plant" not in tables:
            remedy = "Add it, or start from preset = ..."
            raise missing("robot", "a table [robot], or [plant] and [model]", remedy)
        return decode_fields(Scenario, tables, "")
    try:
        return decode_fields(Scenario, {"plant": robot, **tables}, "")
    except ValueError as error:
        text = re.sub(r"^plant\b", "robot", str(error)).replace("[plant]", "[robot]")
        raise ValueError(text) from error


def _from_preset(data: dict[str, Any]) -> Scenario:
    for name in COMPONENTS:
        if name in data:
            remedy = (
                "Change its numbers in [parameters], or take the full text: iblf-jax presets"
                f" {data['preset']} --toml."
            )
            came = Words("this table besides preset")
            raise checks.fail(name, came, "a preset, or a complete scenario", remedy)
    known_keys(data, "", ("preset", "arguments", "parameters", "run", "dtype"))
    return preset_scenario(data["preset"], as_table(data.get("arguments", {}), "arguments"))


def preset_scenario(name: object, arguments: dict[str, Any]) -> Scenario:
    """The scenario of a preset; validates the preset's name and arguments.

    Args:
      name: a key of `presets.PRESETS`.
      arguments: arguments of the preset, by name.

    Raises:
      ValueError: an unknown preset or argument, or an invalid value of an argument.
    """
    as_table(arguments, "arguments")
    if not isinstance(name, str) or name not in PRESETS:
        raise checks.fail("preset", name, "the name of a preset", did_you_mean(name, PRESETS))
    preset = PRESETS[name]
    taken = inspect.signature(preset).parameters
    arguments = earlier.with_present_names(arguments, taken)
    known_keys(arguments, "arguments", taken)
    hints = field_hints(preset)
    for key, parameter in taken.items():
        if parameter.default is parameter.empty and key not in arguments:
            raise missing(f"arguments.{key}", f"a value; the preset {name} needs it")
    values = {
        key: decode_static(value, hints.get(key, Any), f"arguments.{key}")
        for key, value in arguments.items()
    }
    return construct(preset, values, "arguments")


def numbers_by_path(data: dict[str, Any], name: str) -> dict[str, Any]:
    """Path -> numbers of the table [name] of a file, which may be missing."""
    table = as_table(data.get(name, {}), name)
    entries = by_path(table, lambda value: not isinstance(value, dict))
    return {path: numbers(value, f"{name}.{path}") for path, value in entries.items()}


def _run_table(table: Any) -> dict[str, Any]:
    """The validated table [run]."""
    known_keys(as_table(table, "run"), "run", RUN)
    values = {}
    for key, value in table.items():
        if isinstance(value, np.generic):
            value = value.item()
        if key == "method":
            checks.one_of("run.method", value, METHODS)
        elif key == "record_every":
            value = checks.positive_integer("run.record_every", value)
        else:
            value = checks.positive_number(f"run.{key}", value, "s")
        values[key] = value
    return values
