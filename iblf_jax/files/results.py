"""Saves and loads every result of the package: one file, arrays and a description of what they are.

A file is a zip archive, which `numpy.load` and `unzip` read too:

    result.json   {"format": "iblf_jax result", "version": 1, "written_by": ..., "result": node}
    0.npy ...     the arrays, in the format of NumPy, without pickled objects

A node is null, a boolean, a string or a finite number, or a table of one kind:

    {"float": "nan"}                                  a number that JSON cannot hold
    {"array": 0, "type": "float64", "shape": [2]}     an array of NumPy; likewise "jax", of JAX, and
                                                      "number", one number of NumPy
    {"tuple": [...]}, {"list": [...]}                 likewise "dict" and "counter", of pairs
    {"enum": "Status", "value": 4}, {"path": "a.c"}
    {"record": "Study", "fields": {...}}              a class of RECORDS
    {"member": "metrics.settling", "fields": {...}}   a class in a table of MEMBERS
    {"scenario": {...}, "leaves": [...]}              the tables of a scenario file, and all numbers

Numbers come back bit for bit.  What a result has computed on request (`cached_property`) is stored
if it was computed before.  What can be computed from the rest, such as the program of a study, is
not stored, but made again; CONVERTERS lists these classes.

An array keeps its precision where JAX is in its 32-bit mode, too.

Nothing is unpickled, and a file names no module: a class is found in RECORDS or, like those of
users, in the MEMBERS of its family.  The arrays have checksums, as every file of a zip archive.
Every error is a ValueError that names the file and the dotted key.
"""

from __future__ import annotations

import dataclasses
import enum
import importlib
import io
import itertools
import json
import math
import os
import types
import typing
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping
from functools import cached_property
from importlib.metadata import version
from operator import itemgetter
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.attributes import attributes
from iblf_jax.core.devices import on_device
from iblf_jax.core.pytree import field_values
from iblf_jax.core.whole_files import written_whole
from iblf_jax.engine import RunRequest
from iblf_jax.files import components, earlier, tuning
from iblf_jax.files.modules import tables_of_modules
from iblf_jax.files.rollouts import ARRAY_OF_ATTRIBUTES, load_rollouts
from iblf_jax.files.scenario import from_dict, load_scenario, scenario_to_dict
from iblf_jax.files.values import Words, as_table, dotted, known_keys, missing
from iblf_jax.simulation.closed_loop import initial_state
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.comparison import Comparison
from iblf_jax.studies.rare_events.result import LikelyFailure
from iblf_jax.studies.study import Study
from iblf_jax.studies.study_setup import prepare
from iblf_jax.studies.sweep import load_sweep

FORMAT, VERSION = "iblf_jax result", 1
DESCRIPTION = "result.json"
"""The file in the archive that describes the arrays."""
EXPECTED = "a file that a result's save wrote"
SAME_KIND = "a node of the form that iblf_jax.files.results describes"

RECORDS: dict[str, tuple[str, str]] = {
    "Attack": ("tuning._falsify", "WorstCase"),
    "Attempt": ("proofs.result", "Attempt"),
    "AtLimit": ("tuning.result", "AtLimit"),
    "Block": ("tuning.parameters", "Block"),
    "Certificate": ("certificates.result", "Certificate"),
    "Change": ("tuning.report", "Change"),
    "ChainLevelState": ("proofs.chains", "ChainLevelSetState"),
    "Comparison": ("studies.comparison", "Comparison"),
    "Confirmation": ("tuning.confirmation", "Confirmation"),
    "Counterexample": ("certificates._counterexample", "Counterexample"),
    "EffortSearch": ("studies.equal_effort", "EffortSearch"),
    "Explanation": ("engine.explain", "Explanation"),
    "FailedRuns": ("tuning.failures", "FailedRuns"),
    "Influence": ("tuning.failures", "Influence"),
    "FailureProbability": ("studies.rare_events.result", "FailureProbability"),
    "FailureSamples": ("studies.rare_events.result", "FailureSamples"),
    "FirstExit": ("studies.first_exit", "FirstExit"),
    "Fit": ("identification.result", "Fit"),
    "Front": ("tuning._pareto", "ParetoFront"),
    "GrowthPoint": ("proofs.result", "GrowthPoint"),
    "GuaranteedGains": ("proofs.gains", "GuaranteedGains"),
    "GuaranteedTube": ("proofs.result", "GuaranteedTube"),
    "Identification": ("identification.result", "Identification"),
    "Interval": ("studies.distributions", "Interval"),
    "Level": ("studies.rare_events.limit_state", "Level"),
    "LevelChoice": ("proofs.proposal", "LevelChoice"),
    "LevelLabel": ("certificates.result", "LevelLabel"),
    "LevelState": ("proofs.problem", "LevelSetState"),
    "LevelTraces": ("certificates.result", "LevelTraces"),
    "LikelyFailure": ("studies.rare_events.result", "LikelyFailure"),
    "Line": ("certificates.lines", "Line"),
    "LineRole": ("certificates.lines", "Role"),
    "Measurement": ("control.sensors._base", "Measurement"),
    "Metrics": ("simulation.results", "Metrics"),
    "Number": ("identification.result", "Number"),
    "Objective": ("tuning.objectives", "Objective"),
    "OneRun": ("studies.study", "OneRun"),
    "Perturbation": ("studies.distributions", "Perturbation"),
    "Probability": ("studies.statistics", "Probability"),
    "Proof": ("proofs.result", "Proof"),
    "ProofVerdict": ("proofs.result", "Verdict"),
    "Report": ("tuning.options", "Report"),
    "ReportedQuantities": ("tuning.step_check", "ReportedQuantities"),
    "Requirement": ("tuning.objectives", "Requirement"),
    "RequirementAtSteps": ("tuning.step_check", "RequirementAtSteps"),
    "RequirementVerdict": ("tuning.report", "Verdict"),
    "Risk": ("tuning.robust", "Risk"),
    "RobotMotion": ("deployment.ros2.robot_motion", "RobotMotion"),
    "Rollout": ("simulation.results", "Rollout"),
    "Runs": ("engine.runs", "Runs"),
    "RunOptions": ("studies.options", "RunOptions"),
    "Sensitivity": ("studies.sensitivity", "Sensitivity"),
    "Status": ("core.status", "Status"),
    "StepCheck": ("tuning.step_check", "StepCheck"),
    "Study": ("studies.study", "Study"),
    "Term": ("tuning.objectives", "Term"),
    "TorqueRange": ("proofs.torque", "TorqueRange"),
    "Traces": ("certificates.result", "Traces"),
    "TuneResult": ("tuning.result", "TuneResult"),
    "TuneSetup": ("tuning.result", "TuneSetup"),
    "TuningReport": ("tuning.report", "TuningReport"),
    "Violation": ("proofs.result", "Violation"),
    "WorstBox": ("proofs.result", "WorstBox"),
}
"""Name of a class in files, which never changes -> the module of the package and the class."""


def save(result: object, path: str | os.PathLike) -> Path:
    """Writes a result to a file from which `load` returns an equal one.

    Args:
      result: a result of this package.
      path: the file; its folder must exist.  Its name may have any ending.

    Returns:
      The path.

    Raises:
      ValueError: the result holds a class that no file can name, or values that JAX traces.
      OSError: the file cannot be written.
    """
    target = checks.file_to_write("path", path)
    if not checks.is_concrete(result):
        remedy = "Save it outside of jit, vmap and grad."
        raise checks.fail("result", Words("traced values"), "numbers", remedy)
    writer = _Writer()
    name = type(result).__name__
    description = {
        "format": FORMAT,
        "version": VERSION,
        "written_by": {"iblf_jax": version("iblf_jax"), "jax": jax.__version__},
        "result": writer.node(result, name),
    }
    with (
        written_whole(target) as file,
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        archive.writestr(DESCRIPTION, json.dumps(description, allow_nan=False, indent=1))
        for number, array in enumerate(writer.arrays):
            content = io.BytesIO()
            np.save(content, array, allow_pickle=False)
            archive.writestr(f"{number}.npy", content.getbuffer())
    return target


def load(path: str | os.PathLike, *, modules: Mapping[str, Any] | None = None) -> Any:
    """What a file of this package holds.

    Args:
      path: a file that `save` of a result wrote; a scenario (".toml"); runs that `save_rollouts`
        wrote; a tuning that an earlier version wrote (".json"); or the store of a sweep.
      modules: modules that the file cannot describe, as `load_scenario` takes them.

    Returns:
      The result, equal to the saved one.  Of `save_rollouts` the Rollout, or a dict of Rollouts by
      name; of a store the `xarray.Dataset` of `load_sweep`.

    Raises:
      ValueError: another file, or a damaged one; the message names the file and the key.
      OSError: the file cannot be read.
    """
    if checks.file_path("path", path).is_dir():
        return load_sweep(path)
    place = checks.file_to_read("path", path)
    if place.suffix.lower() == ".toml":
        return load_scenario(place, modules=modules)
    with place.open("rb") as file:
        start = file.read(3)
    if start == b"CDF":
        return load_rollouts(place, modules=modules)
    if start[:1] == b"{":
        return tuning.load_tuning(place, modules=modules)
    try:
        with _opened(place) as archive:
            if ARRAY_OF_ATTRIBUTES not in archive.namelist():
                description = _described(archive)
                reader = _Reader(archive, dict(modules or {}))
                result = reader.value(description["result"], "result")
                reader.check_modules()
                return result
    except ValueError as error:
        raise checks.with_location(place, error) from error
    return load_rollouts(place, modules=modules)


# --- to nodes


class Converter(NamedTuple):
    """How a class is stored that holds more than a file can, or than it has to."""

    stored: Callable[[Any], dict[str, Any]]
    """The object -> what is stored of it, by name."""
    restored: Callable[[dict[str, Any]], dict[str, Any]]
    """What is stored -> the fields of the object."""


class _Writer:
    """Makes the nodes of a result, and collects its arrays."""

    def __init__(self) -> None:
        self.arrays: list[np.ndarray] = []

    def node(self, value: Any, key: str) -> Any:
        """The node of a value.

        Args:
          value: a result, or what it holds.
          key: dotted key of the value, for messages.
        """
        # A number of NumPy may be a float, and an entry of an enumeration a string or an integer.
        if isinstance(value, np.generic):
            return self.array(value, "number", key)
        if isinstance(value, enum.Enum):
            return {"enum": self.name_of(type(value), key), "value": value.value}
        if isinstance(value, float) and not math.isfinite(value):
            return {"float": repr(value)}
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if isinstance(value, np.ndarray):
            return self.array(value, "array", key)
        if isinstance(value, jax.Array):
            return self.array(value, "jax", key)
        if isinstance(value, PurePath):
            return {"path": str(value)}
        if isinstance(value, Scenario):
            return self.scenario(value, key)
        for name, cls in MAPPINGS.items():
            if type(value) is cls:
                return {name: [self.pair(k, x, key) for k, x in value.items()]}
        for name, cls in SEQUENCES.items():
            if type(value) is cls:
                return {name: [self.node(x, f"{key}[{i}]") for i, x in enumerate(value)]}
        return self.object(value, key)

    def pair(self, name: Any, value: Any, key: str) -> list[Any]:
        """The nodes of an entry of a dict: of its name and of its value."""
        if not isinstance(name, KEY_OF_DICT):
            came = Words(f"a dict with the key {name!r}")
            raise checks.fail(key, came, "keys of type str, int or float")
        return [self.node(name, key), self.node(value, f"{key}[{name}]")]

    def array(self, value: Any, kind: str, key: str) -> dict[str, Any]:
        """The node of an array."""
        if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            expected = "a key that jax.random.PRNGKey made"
            raise checks.fail(key, Words("a typed key of JAX"), expected)
        array = np.asarray(value)
        described = {"type": str(array.dtype), "shape": list(array.shape)}
        if array.dtype.hasobject:
            raise checks.fail(key, Words("an array of objects"), "numbers, booleans or texts")
        if array.dtype == jnp.bfloat16:  # the format of NumPy does not know it
            array = array.view(np.uint16)
        elif array.dtype.kind == "V" or array.dtype.isbuiltin == DEFINED_BY_A_LIBRARY:
            expected = "numbers of NumPy or bfloat16, booleans or texts"
            remedy = "Convert them to a type of NumPy, such as float32, before saving."
            raise checks.fail(key, Words(f"an array of type {array.dtype}"), expected, remedy)
        self.arrays.append(array)
        return {kind: len(self.arrays) - 1, **described}

    @jax.enable_x64(True)
    def scenario(self, scenario: Scenario, key: str) -> dict[str, Any]:
        """The node of a scenario; of many, whose leaves have leading axes, the tables of the first
        one and the leaves of all.
        """
        axes = np.ndim(scenario.initial.q) - 1
        first = jax.tree.map(lambda x: x[(0,) * axes], scenario)
        try:
            tables = scenario_to_dict(first)
        except ValueError as error:
            raise checks.with_location(key, error) from error
        leaves = enumerate(jax.tree.leaves(scenario))
        return {
            "scenario": tables,
            "leaves": [self.node(x, f"{key}.leaves[{i}]") for i, x in leaves],
        }

    def object(self, value: Any, key: str) -> dict[str, Any]:
        """The node of an object of a class that a file can name."""
        cls = type(value)
        for family in components.FAMILIES.values():
            for member, known in family.members.items():
                if known is cls:
                    fields = self.fields(field_values(value), key)
                    return {"member": f"{family.module}.{member}", "fields": fields}
        name = self.name_of(cls, key)
        stored = CONVERTERS[name].stored if name in CONVERTERS else _fields_of
        node = {"record": name, "fields": self.fields(stored(value), key)}
        computed = {x: vars(value)[x] for x in _computed_names(cls) if x in vars(value)}
        if computed:
            node["computed"] = self.fields(computed, key)
        return node

    def fields(self, values: Mapping[str, Any], key: str) -> dict[str, Any]:
        """The nodes of fields."""
        return {name: self.node(x, dotted(key, name)) for name, x in values.items()}

    def name_of(self, cls: type, key: str) -> str:
        """The name of a class of the package in files."""
        own = (cls.__module__.removeprefix("iblf_jax."), cls.__qualname__)
        for name, place in RECORDS.items():
            if place == own:
                return name
        expected = "a class that a file can name"
        remedy = (
            "Add a class of your own to the MEMBERS of its family before saving and loading, such"
            f' as iblf_jax.metrics.MEMBERS["my_name"] = {cls.__name__}.'
        )
        raise checks.fail(key, Words(f"an object of class {cls.__name__}"), expected, remedy)


def _fields_of(value: Any) -> dict[str, Any]:
    """The fields of a dataclass or a NamedTuple by name."""
    if isinstance(value, tuple):
        named: Any = value
        return named._asdict()
    return field_values(value)


def _computed_names(cls: type) -> list[str]:
    """The properties of a class that are computed once and kept, without those of MADE_AGAIN."""
    owners = reversed(cls.__mro__)
    members = [member for owner in owners for member in vars(owner).items()]
    names = [name for name, x in members if isinstance(x, cached_property)]
    return [name for name in names if (cls.__name__, name) not in MADE_AGAIN]


MADE_AGAIN = {("Proof", "problem")}
"""Class and name of the properties that hold functions, which no file can."""
MAPPINGS: dict[str, Any] = {"dict": dict, "counter": Counter}
KEY_OF_DICT = str | float | int
DEFINED_BY_A_LIBRARY = 2
"""The value of `numpy.dtype.isbuiltin` of types that NumPy does not define, such as float8_e5m2."""
SEQUENCES: dict[str, Any] = {"tuple": tuple, "list": list}


# --- from nodes


def _opened(place: Path) -> zipfile.ZipFile:
    """The archive in a file."""
    try:
        return zipfile.ZipFile(place)
    except Exception as error:  # A damaged directory raises errors of many kinds.
        found = f"{type(error).__name__}: {error}"
        raise checks.fail("file", Words("no archive"), EXPECTED, found) from error


def _described(archive: zipfile.ZipFile) -> dict[str, Any]:
    """The description of an archive, whose format and version are known."""
    if DESCRIPTION not in archive.namelist():
        raise missing(DESCRIPTION, EXPECTED)
    try:
        description = json.loads(archive.read(DESCRIPTION))
    except Exception as error:  # zipfile and json raise errors of many kinds.
        found = f"{type(error).__name__}: {error}"
        raise checks.fail(DESCRIPTION, Words("damaged text"), EXPECTED, found) from error
    as_table(description, DESCRIPTION)
    if description.get("format") != FORMAT:
        raise checks.fail("format", description.get("format"), repr(FORMAT))
    if description.get("version") != VERSION:
        remedy = "Read it with the version of iblf_jax that wrote it, or a newer one."
        raise checks.fail("version", description.get("version"), str(VERSION), remedy)
    known_keys(description, "", ("format", "version", "written_by", "result"))
    if "result" not in description:
        raise missing("result", EXPECTED)
    return description


class _Reader:
    """Makes a result from its nodes.

    Args:
      archive: the file.
      modules: modules of the caller's by dotted key, as `load_scenario` takes them.
    """

    def __init__(self, archive: zipfile.ZipFile, modules: dict[str, Any]) -> None:
        self.archive, self.modules = archive, modules
        self.used_modules: set[str] = set()
        self.depth = 0

    def value(self, node: Any, key: str) -> Any:
        """The value of a node; `key` is its dotted key, for messages."""
        if node is None or isinstance(node, bool | int | float | str):
            return node
        kinds = [kind for kind in self.kinds if isinstance(node, dict) and kind in node]
        if len(kinds) != 1:
            raise checks.fail(key, node, SAME_KIND)
        make, others = self.kinds[kinds[0]]
        known_keys(node, key, (kinds[0], *others))
        if self.depth > MAX_NODES_INSIDE:
            raise checks.fail(key, node, f"at most {MAX_NODES_INSIDE} nodes inside each other")
        self.depth += 1
        try:
            return make(self, node, key)
        finally:
            self.depth -= 1

    @jax.enable_x64(True)
    def array(self, node: dict[str, Any], key: str) -> Any:
        """An array of NumPy or JAX, or one number of NumPy."""
        kind = next(kind for kind in ARRAYS if kind in node)
        number = checks.positive_integer(key, node[kind], least=0)
        try:
            content = io.BytesIO(self.archive.read(f"{number}.npy"))
            array = np.load(content, allow_pickle=False)
        except Exception as error:  # NumPy and zipfile raise errors of many kinds.
            found = Words(f"no array that can be read ({type(error).__name__})")
            raise checks.fail(key, found, f"an array {number}.npy", str(error)) from error
        expected = (node.get("type"), node.get("shape"))
        if expected[0] == "bfloat16" and array.dtype == np.uint16:
            array = array.view(jnp.bfloat16)
        if expected != (str(array.dtype), list(array.shape)):
            came = Words(f"an array of type {array.dtype} and shape {list(array.shape)}")
            raise checks.fail(key, came, f"type {expected[0]} and shape {expected[1]}")
        if kind == "number":
            return array[()]
        return on_device(array) if kind == "jax" else array

    def number(self, node: dict[str, Any], key: str) -> float:
        """A number that JSON cannot hold."""
        checks.one_of(key, node["float"], ("nan", "inf", "-inf"))
        return float(node["float"])

    def path(self, node: dict[str, Any], key: str) -> Path:
        """The path of a file."""
        return Path(checks.string(key, node["path"], "a path"))

    def sequence(self, node: dict[str, Any], key: str) -> Any:
        """A tuple or a list."""
        ((kind, nodes),) = node.items()
        return SEQUENCES[kind](
            self.value(x, f"{key}[{i}]") for i, x in enumerate(_listed(nodes, key))
        )

    def mapping(self, node: dict[str, Any], key: str) -> Any:
        """A dict or a Counter."""
        ((kind, pairs),) = node.items()
        found = {}
        for pair in _listed(pairs, key):
            if len(_listed(pair, key)) != 2:
                raise checks.fail(key, pair, "a pair of a name and a value")
            name = self.value(pair[0], key)
            if not isinstance(name, KEY_OF_DICT):
                raise checks.fail(key, name, "a name or a number")
            found[name] = self.value(pair[1], f"{key}[{name}]")
        return MAPPINGS[kind](found)

    def member_of_enum(self, node: dict[str, Any], key: str) -> Any:
        """An entry of an enumeration."""
        cls = _class_of(node["enum"], key)
        try:
            return cls(node.get("value"))
        except (ValueError, TypeError) as error:
            raise checks.fail(key, node.get("value"), checks.with_article(cls.__name__)) from error

    @jax.enable_x64(True)
    def scenario(self, node: dict[str, Any], key: str) -> Scenario:
        """A scenario, or many with leading axes."""
        tables = as_table(node["scenario"], key)
        known = {path for path, _ in tables_of_modules(tables)}
        given = {path: module for path, module in self.modules.items() if path in known}
        self.used_modules |= set(given)
        first = from_dict(tables, key, modules=given).scenario
        expected, structure = jax.tree.flatten(first)
        stored = [
            self.value(x, f"{key}.leaves[{i}]")
            for i, x in enumerate(_listed(node.get("leaves"), key))
        ]
        if earlier.has_other_leaves(tables):
            if np.ndim(stored[0]) == np.ndim(expected[0]):
                return first  # its tables have the same numbers
            remedy = "save_rollouts of the version that wrote it makes a file that is read."
            raise checks.fail(key, Words("many scenarios of a FullState"), "one scenario", remedy)
        if len(stored) != len(expected):
            raise checks.fail(f"{key}.leaves", len(stored), f"{len(expected)} arrays")
        numbers = earlier.order_of_leaves(tables, first)
        stored = [x for _, x in sorted(zip(numbers, stored, strict=True), key=itemgetter(0))]
        for i, (x, leaf) in enumerate(zip(stored, expected, strict=True)):
            shape = np.shape(x)[np.ndim(x) - np.ndim(leaf) :]
            if shape != np.shape(leaf) or not np.issubdtype(np.asarray(x).dtype, np.floating):
                came = Words(f"{np.asarray(x).dtype} numbers of shape {np.shape(x)}")
                raise checks.fail(f"{key}.leaves[{i}]", came, f"numbers of shape {np.shape(leaf)}")
        return jax.tree.unflatten(structure, stored)

    def member(self, node: dict[str, Any], key: str) -> Any:
        """An object of a class in a table of members."""
        name = checks.string(key, node["member"], "the name of a class")
        known: dict[str, type] = {}
        for family in components.FAMILIES.values():
            known |= {f"{family.module}.{x}": cls for x, cls in family.members.items()}
        if name not in known:
            module, _, own = name.rpartition(".")
            remedy = (
                f"{checks.nearest(name, known)} If it is your own class, register it first:"
                f' iblf_jax.{module}.MEMBERS["{own}"] = TheClass.'
            )
            raise checks.fail(key, name, "the name of a class that is registered", remedy)
        return self.made(known[name], self.fields(node, key), key)

    def record(self, node: dict[str, Any], key: str) -> Any:
        """An object of a class of the package."""
        cls = _class_of(node["record"], key)
        values = self.fields(node, key)
        if node["record"] in CONVERTERS:
            restored = CONVERTERS[node["record"]].restored
            values = components.construct(restored, {"stored": values}, key)
        result = self.made(cls, values, key)
        computed = as_table(node.get("computed", {}), key)
        known_keys(computed, key, _computed_names(cls))
        for name, x in computed.items():
            vars(result)[name] = self.value(x, dotted(key, name))
        return result

    def fields(self, node: dict[str, Any], key: str) -> dict[str, Any]:
        """The values of the fields of an object."""
        nodes = as_table(node.get("fields"), key)
        return {name: self.value(x, dotted(key, name)) for name, x in nodes.items()}

    @jax.enable_x64(True)
    def made(self, cls: Any, values: dict[str, Any], key: str) -> Any:
        """An object of a dataclass or a NamedTuple, with checked fields."""
        required = _required_fields(cls)
        known_keys(values, key, required)
        for name, is_required in required.items():
            if is_required and name not in values:
                raise missing(dotted(key, name), f"a field of {cls.__name__}")
        hints = components.field_hints(cls)
        for name, value in values.items():
            hint = hints.get(name, Any)
            if not _fits(value, hint):
                came = Words(f"an object of class {type(value).__name__}")
                expected = hint.__name__ if isinstance(hint, type) else str(hint)
                raise checks.fail(dotted(key, name), came, f"one of type {expected}")
        return components.construct(cls, values, key)

    def check_modules(self) -> None:
        """Raises ValueError for a module of the caller's that belongs to no part of the result."""
        for path in self.modules.keys() - self.used_modules:
            raise checks.fail("modules", path, "the dotted key of a module in the file")

    kinds: typing.ClassVar[dict[str, tuple[Callable, tuple[str, ...]]]] = {
        "float": (number, ()),
        "array": (array, ("type", "shape")),
        "jax": (array, ("type", "shape")),
        "number": (array, ("type", "shape")),
        "path": (path, ()),
        "tuple": (sequence, ()),
        "list": (sequence, ()),
        "dict": (mapping, ()),
        "counter": (mapping, ()),
        "enum": (member_of_enum, ("value",)),
        "scenario": (scenario, ("leaves",)),
        "member": (member, ("fields",)),
        "record": (record, ("fields", "computed")),
    }
    """Kind of a table -> what makes its value, and the other keys that it may have."""


ARRAYS = ("array", "jax", "number")
MAX_NODES_INSIDE = 64
"""Largest depth of nodes, so that a file cannot exhaust the stack."""


def _class_of(name: object, key: str) -> Any:
    """The class of a name in RECORDS."""
    if not isinstance(name, str) or name not in RECORDS:
        raise checks.fail(key, name, "the name of a result", checks.nearest(name, RECORDS))
    module, own = RECORDS[name]
    return getattr(importlib.import_module(f"iblf_jax.{module}"), own)


def _listed(nodes: object, key: str) -> list[Any]:
    """`nodes` if they are a list, else a ValueError."""
    if isinstance(nodes, list):
        return nodes
    raise checks.fail(key, nodes, "a list")


def _required_fields(cls: Any) -> dict[str, bool]:
    """Name of a field of a dataclass or a NamedTuple -> whether it has no default."""
    if not dataclasses.is_dataclass(cls):
        return {name: name not in cls._field_defaults for name in cls._fields}
    none = dataclasses.MISSING
    return {
        field.name: field.default is none and field.default_factory is none
        for field in dataclasses.fields(cls)
        if field.init
    }


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is one of an annotation, as far as annotations say: arrays of any kind, and
    numbers of Python or NumPy.
    """
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if origin is typing.Annotated:
        # A field of a component may hold a member of further families.
        return _fits(value, hint.__origin__) or any(_fits(value, x) for x in hint.__metadata__)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, x) for x in arguments)
    if origin is tuple and arguments:
        is_long = arguments[-1] is Ellipsis
        entries = arguments[:1] * len(value) if is_long and isinstance(value, tuple) else arguments
        fits = isinstance(value, tuple) and len(value) == len(entries)
        return fits and all(map(_fits, value, entries))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        fits = isinstance(value, Mapping)
        return fits and all(map(_fits, value.values(), itertools.repeat(arguments[-1])))
    if hint in KINDS:
        return isinstance(value, KINDS[hint]) and (hint is bool or not isinstance(value, bool))
    try:
        return isinstance(value, hint)
    except TypeError:  # Any, a type variable, or a protocol that says nothing at run time
        return True


KINDS: dict[Any, tuple[Any, ...]] = {
    float: (float, int, np.floating, np.integer),
    int: (int, np.integer),
    bool: (bool, np.bool_),
    np.ndarray: (np.ndarray, np.generic, jax.Array),
    jax.Array: (np.ndarray, np.generic, jax.Array),
}
"""Annotation -> the classes of the values that it stands for."""


# --- what is made again


def _stored_rollout(run: Rollout) -> dict[str, Any]:
    """The states as lists of arrays: their structure is that of the scenario's parts."""
    return _fields_of(run) | {
        name: jax.tree.leaves(x) for name, x in attributes(run, STATES).items()
    }


def _restored_rollout(stored: dict[str, Any]) -> dict[str, Any]:
    stored = earlier.fields_of_run(stored)
    scenario = stored["scenario"]
    axes = np.ndim(scenario.initial.q) - 1
    start = jax.eval_shape(initial_state, jax.tree.map(lambda x: x[(0,) * axes], scenario))
    states = attributes(start, STATES.values())
    restored = {
        name: jax.tree.unflatten(jax.tree.structure(states[part]), stored[name])
        for name, part in STATES.items()
        if stored[name]
    }
    return stored | dict.fromkeys(STATES, ()) | restored


STATES = {
    "controller_state": "controller",
    "observer_state": "observer",
    "actuator_state": "actuator",
}
"""Field of a Rollout -> the part of the state of the closed loop that it records."""


def _stored_study(study: Study) -> dict[str, Any]:
    """The study without its program, which is made again."""
    setup = study.setup
    options = attributes(setup, ("perturbations", "options", "points"))
    stored = _fields_of(study) | options | {"folds": setup.shared.folds}
    del stored["setup"]
    return stored


def _restored_study(stored: dict[str, Any]) -> dict[str, Any]:
    options = [stored.pop(name) for name in ("perturbations", "options", "folds", "points")]
    return stored | {"setup": prepare(stored["scenario"], *options)}


def _stored_failure(failure: LikelyFailure) -> dict[str, Any]:
    """The failure with the arguments of its request."""
    request = failure.request
    stored = _fields_of(failure) | {"steps": request.steps, "method": request.method}
    del stored["request"]
    return stored


def _restored_failure(stored: dict[str, Any]) -> dict[str, Any]:
    steps = stored.pop("steps")
    method = stored.pop("method")
    scenario = stored["scenario"]
    request = RunRequest.of(scenario, steps=steps, method=method, record_every=1)
    return stored | {"request": request}


def _stored_comparison(comparison: Comparison) -> dict[str, Any]:
    """The runs at equal effort as a dict: what their class adds follows from the reasons."""
    return _fields_of(comparison) | {"equal_effort": dict(comparison.equal_effort)}


CONVERTERS: dict[str, Converter] = {
    "Comparison": Converter(_stored_comparison, lambda stored: stored),
    "Line": Converter(_fields_of, earlier.fields_of_line),
    "LikelyFailure": Converter(_stored_failure, _restored_failure),
    "Rollout": Converter(_stored_rollout, _restored_rollout),
    "Study": Converter(_stored_study, _restored_study),
}
"""Name in RECORDS -> the converter of a class whose fields are not all stored as they are."""
