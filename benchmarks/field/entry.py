"""Entries of the benchmark of the field: `entry.toml` as dataclasses, and the run of `example.py`.

An entry is a folder of `entries/`. README.md in this folder describes its files.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
import io
import math
import re
import runpy
import tomllib
import typing
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import pyplot
from scipy.integrate import solve_ivp

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parents[1]
ENTRIES = FOLDER / "entries"
RESULTS = FOLDER / "results"
CHECKS = FOLDER / "checks"
TEMPLATE = FOLDER / "template"

OWN = "law of the entry"
"""The law of an entry's `scenario`, whose effort is the unit of the limits, in the results of
`equal_budget.py`; `Entry.law_in_words` says whose law it is."""
FAMILIES = ("robot", "flexible joint", "drive", "vessel", "vehicle", "strict feedback")
METHODS = ("barrier", "prescribed performance", "constrained")
READ = {
    "article": "article",
    "program": "program of the authors",
    "thesis": "thesis",
    "group": "program of an author's group",
    "secondary": "program of others",
}
"""Value of `source.read` -> what was read, in words."""
KINDS = {
    "formula": "Terms and signs of formulas",
    "number": "Printed numbers that do not give the published result",
    "program": "Programs that differ from their text or from their plant",
    "condition": "Conditions and claims",
    "figure": "Figures that show something else",
    "other": "Others",
}
"""Value of `kind` of a correction -> heading of its group on the page of all corrections."""
FOUND_IN = {"publication": "Corrections of publications", "program": "Corrections of programs"}
"""Value of `found_in` of a correction -> heading of its list on the page of all corrections."""
NOT_CONTACTED = "not contacted"
CONTACTED = (NOT_CONTACTED, "asked", "confirmed", "disputed")
"""Values of `contacted` of a correction."""


class EntryError(ValueError):
    """An entry that cannot be used; `faults` has one sentence for each repair."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__(faults)
        self.faults = faults

    def __str__(self) -> str:
        return "; ".join(self.faults)


def _one_of(values: typing.Iterable[str], **options: Any) -> Any:
    """A field whose value is one of a list."""
    return dataclasses.field(metadata={"one_of": tuple(values)}, **options)


@dataclasses.dataclass(frozen=True)
class Source:
    """The publication."""

    authors: str
    title: str
    where: str
    year: int
    edition: str
    """The commit, or the edition, that was read."""
    contact: str
    """Who could be asked about the corrections."""
    read: str = _one_of(READ)
    doi: str = ""
    url: str = ""
    code: str = ""

    @property
    def link(self) -> str:
        """The address of the publication."""
        return f"https://doi.org/{self.doi}" if self.doi else self.url


@dataclasses.dataclass(frozen=True)
class Printed:
    """A number of the source."""

    quantity: str
    value: str
    where: str


@dataclasses.dataclass(frozen=True)
class Correction:
    """What had to be corrected to reproduce the result."""

    printed: str
    corrected: str
    evidence: str
    """At least one number."""
    found_in: str = _one_of(FOUND_IN)
    kind: str = _one_of(KINDS, default="other")
    edition: str = ""
    """Where it is another one than that of the source."""
    contacted: str = _one_of(CONTACTED, default=NOT_CONTACTED)
    answer: str = ""
    """What was asked or answered, with its date; not empty if somebody was contacted."""

    def edition_of(self, source: Source) -> str:
        """The commit, or the edition, that was read."""
        return self.edition or source.edition

    @property
    def contact_in_words(self) -> str:
        """Whether somebody was contacted, and the answer."""
        return f"{self.contacted}: {self.answer}" if self.answer else self.contacted


@dataclasses.dataclass(frozen=True)
class Assumed:
    """What the source does not state, or what an entry chooses otherwise or in addition."""

    quantity: str
    assumed: str


@dataclasses.dataclass(frozen=True)
class Published:
    """A published number that the example must reach."""

    quantity: str
    value: float
    tolerance: float
    where: str


@dataclasses.dataclass(frozen=True)
class Claim:
    """A published statement without a number."""

    statement: str
    where: str


@dataclasses.dataclass(frozen=True)
class NotReproduced:
    """What the example does not show."""

    text: str


@dataclasses.dataclass(frozen=True)
class InputLimit:
    """Limits of the input that every law of the task keeps."""

    lower: float
    upper: float
    where: str


@dataclasses.dataclass(frozen=True)
class Run:
    """Duration and time step."""

    duration: float
    dt: float


@dataclasses.dataclass(frozen=True)
class Entry:
    """The contents of an `entry.toml`."""

    title: str
    plant: str
    source: Source
    run: Run
    not_reproduced: NotReproduced
    family: str = _one_of(FAMILIES)
    method: str = _one_of(METHODS)
    law: str = ""
    """Which law `scenario` has, where it is not the published one."""
    printed: tuple[Printed, ...] = ()
    corrected: tuple[Correction, ...] = ()
    missing: tuple[Assumed, ...] = ()
    """What the publication or the program needs and what was read does not state."""
    chosen: tuple[Assumed, ...] = ()
    """What this entry has otherwise, needs for laws of others, or has not read."""
    published: tuple[Published, ...] = ()
    claims: tuple[Claim, ...] = ()
    input_limits: tuple[InputLimit, ...] = ()
    """One for each component, or one for all."""

    @property
    def law_in_words(self) -> str:
        """Which law `scenario` has."""
        of_source = "law of a program of others" if self.source.read == "secondary" else ""
        return self.law or of_source or "published law"


class Reproduction(NamedTuple):
    """What an `example.py` defines."""

    scenario: Any
    runs: dict[str, Any]
    figure: Any
    reached: dict[str, float]
    holds: dict[str, bool]
    evidence: dict[str, float]
    """Numbers that the texts of the corrections refer to, by their name in braces."""
    details: dict[str, str]
    """Statement of a claim -> the numbers and the criterion that decide it."""
    not_applicable: dict[str, str]
    """Law -> why `equal_budget.py` leaves it out."""
    uncertain: tuple[str, ...] | None
    """Paths of the plant parameters that `equal_budget.py` varies."""
    constraints: dict[str, Callable[..., Any]]
    """Name with unit -> function (t, x) whose numbers must not become negative; x is (r, n)."""


REQUIRED_NAMES = ("scenario", "runs", "figure")
DEFAULTS: dict[str, Any] = {
    "reached": {},
    "holds": {},
    "evidence": {},
    "details": {},
    "not_applicable": {},
    "uncertain": None,
    "constraints": {},
}
"""Names that an `example.py` may leave out -> their value."""


TYPES = {str: "a text", float: "a number", int: "a whole number"}
"""Type of a value -> its name in a message."""


def folders() -> list[Path]:
    """The folders of all entries."""
    return sorted(path.parent for path in ENTRIES.glob("*/entry.toml"))


def load(folder: Path) -> Entry:
    """The contents of the `entry.toml` of a folder.

    Raises:
      EntryError: a key is missing or unknown, or has a value of the wrong kind.
    """
    path = folder / "entry.toml"
    if not path.exists():
        raise EntryError(["there is no entry.toml; copy the one of benchmarks/field/template"])
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise EntryError([f"entry.toml is not valid TOML: {error}"]) from None
    faults: list[str] = []
    entry = _record(Entry, table, "the head of the file", faults)
    if faults:
        raise EntryError([f"entry.toml: {fault}" for fault in faults])
    return entry


def _record(kind: Any, table: Any, place: str, faults: list[str]) -> Any:
    """A dataclass from a table; None, and further faults, where that is not possible."""
    if not isinstance(table, dict):
        faults.append(f"{place} must be a table")
        return None
    count = len(faults)
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for name in sorted(set(table) - set(fields)):
        faults.append(f"{place} has the unknown key {name!r}; known are {', '.join(fields)}")
    hints = typing.get_type_hints(kind)
    values = {}
    for name, field in fields.items():
        if name in table:
            values[name] = _value(hints[name], table[name], field, place, faults)
        elif field.default is dataclasses.MISSING:
            faults.append(f"{place} lacks {_in_words(name, hints[name])}")
    if len(faults) > count:
        return None
    return kind(**values)


def _in_words(name: str, kind: Any) -> str:
    """A key or a table, as a message names it."""
    return f"the table [{name}]" if dataclasses.is_dataclass(kind) else f"the key {name!r}"


def _value(kind: Any, value: Any, field: dataclasses.Field, place: str, faults: list[str]) -> Any:
    """A value of the declared type; further faults where it is none."""
    name = field.name
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, list):
            faults.append(f"{name} must be a list of tables, each with the heading [[{name}]]")
            return ()
        item = typing.get_args(kind)[0]
        places = (f"[[{name}]] number {i}" for i in range(1, len(value) + 1))
        return tuple(
            _record(item, part, where, faults) for where, part in zip(places, value, strict=True)
        )
    if dataclasses.is_dataclass(kind):
        return _record(kind, value, f"[{name}]", faults)
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind:
        faults.append(f"{place}: {name} = {value!r} must be {TYPES[kind]}")
    allowed = field.metadata.get("one_of")
    if allowed and value not in allowed:
        faults.append(f"{place}: {name} = {value!r} must be one of {', '.join(allowed)}")
    if kind is str and value == "" and field.default is dataclasses.MISSING:
        faults.append(f"{place}: {name} is empty")
    return value


class Definition(NamedTuple):
    """What an `example.py` defines before it simulates."""

    scenario: Any
    constraints: dict[str, Callable[..., Any]]


@functools.cache
def definition(folder: Path) -> Definition:
    """Runs the `example.py` of a folder up to the last statement that defines `scenario` or
    `constraints`, once a process.
    """
    script = folder / "example.py"
    statements = ast.parse(script.read_text(encoding="utf-8")).body
    wanted = set(Definition._fields)
    last = max(i for i, one in enumerate(statements) if wanted & _assigned(one))
    module = ast.Module(statements[: last + 1], type_ignores=[])
    names: dict[str, Any] = {"__name__": "__main__", "__file__": str(script)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exec(compile(module, str(script), "exec", dont_inherit=True), names)
    return Definition(names["scenario"], names.get("constraints", {}))


def _assigned(statement: ast.stmt) -> set[str]:
    """The names that a statement assigns."""
    if not isinstance(statement, ast.Assign):
        return set()
    names = (node for target in statement.targets for node in ast.walk(target))
    return {node.id for node in names if isinstance(node, ast.Name)}


REPRODUCTIONS: dict[Path, Reproduction] = {}
"""Folder -> what its `example.py` defined when it was run in this process."""


def execute(folder: Path) -> Reproduction:
    """Runs the `example.py` of a folder, once a process.

    Raises:
      EntryError: a name is missing.
    """
    if folder in REPRODUCTIONS:
        return REPRODUCTIONS[folder]
    before = set(pyplot.get_fignums())
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            # Runs that leave their bounds are part of some examples.
            warnings.simplefilter("ignore")
            made = reproduction(runpy.run_path(str(folder / "example.py")))
    finally:
        # A figure that is closed can still be saved and drawn.
        for number in set(pyplot.get_fignums()) - before:
            pyplot.close(number)
    REPRODUCTIONS[folder] = made
    return made


def reproduction(names: dict[str, Any]) -> Reproduction:
    """What a script has defined."""
    lacking = [name for name in REQUIRED_NAMES if name not in names]
    if lacking:
        raise EntryError([f"example.py does not define {name!r}" for name in lacking])
    defined = {name: names[name] for name in Reproduction._fields if name in names}
    return Reproduction(**(DEFAULTS | defined))


PLACEHOLDER = re.compile(r"\{(\w+)(?::([^{}]*))?\}")
"""{name} or {name:format} in the text of a correction, for a number of `evidence`."""


def filled(text: str, numbers: dict[str, float]) -> str:
    """A text in which {name} and {name:format} are replaced by computed numbers.

    Raises:
      EntryError: no number can be written in a format.
    """

    def number(match: re.Match[str]) -> str:
        name, spec = match[1], match[2]
        if name not in numbers:
            return match[0]
        try:
            return format(float(numbers[name]), spec or ".4g")
        except ValueError:
            fault = (
                f"entry.toml: {match[0]} must have the format of a number, such as {{{name}:.3g}}"
            )
            raise EntryError([fault]) from None

    return PLACEHOLDER.sub(number, text)


def is_reached(published: Published, value: float) -> bool:
    """Whether a value is the published one within its tolerance."""
    return abs(value - published.value) <= published.tolerance * (1 + 1e-9)


def largest_difference(
    run: Any,
    rate: Callable[[float, np.ndarray], Any],
    *,
    x0: Sequence[float] | None = None,
    start: float = 0.0,
    end: float = math.inf,
    every: int = 1,
    components: int | None = None,
    method: str = "DOP853",
    rtol: float = 1e-9,
    atol: float = 1e-11,
    **options: Any,
) -> float:
    """The largest difference of a run's states from those that SciPy integrates.

    Args:
      run: a `Rollout`.
      rate: (t, x) -> x'; x has the states of the run, level after level, and then further ones,
        such as those of filters and observers.
      x0: x at `start`; the run's own states if not given.
      start, end: what is compared [s].
      every: compares one of so many recorded samples.
      components: how many of the states are compared; None for all states of the run.
      method, rtol, atol, options: as `scipy.integrate.solve_ivp`.
    """
    t = np.asarray(run.t)[::every]
    own = np.asarray(run.x)[::every].reshape(len(t), -1)
    # Half a step of the grid: decimal times are not exact.
    compared = (t > start - 0.5 * run.dt) & (t < end + 0.5 * run.dt)
    t, own = t[compared], own[compared]
    first = own[0] if x0 is None else x0
    solution = solve_ivp(
        rate, (t[0], t[-1]), first, method, t_eval=t, rtol=rtol, atol=atol, **options
    )
    if not solution.success:
        raise ValueError(f"the integration by SciPy failed: {solution.message}")
    found = solution.y.T
    count = own.shape[1] if components is None else components
    return float(np.abs(found[:, :count] - own[:, :count]).max())
