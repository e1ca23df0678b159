"""Checks entries of the benchmark of the field: `python benchmarks/field/check.py [NAME ...]`.

For each entry: the format of `entry.toml`, the links, whether `example.py` runs, whether every
published number is reached within its tolerance, whether every claim holds, the figure and the
labels of its axes, `scenario.toml` and `independent.py` where they exist. Without names all entries
are checked. The exit code is the number of entries that need a repair. `--json FILE` writes what
was found and computed, with the versions and the commit; `benchmarks/field/checks` has such files.
"""

from __future__ import annotations

import argparse
import ast
import functools
import json
import math
import re
import runpy
import shlex
import sys
import traceback
import warnings
from pathlib import Path
from typing import Any, NamedTuple

sys.path += [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parents[1])]

import external
import matplotlib
import numpy as np
import tasks
from _timing import machine
from entry import (
    ENTRIES,
    NOT_CONTACTED,
    PLACEHOLDER,
    TEMPLATE,
    Entry,
    EntryError,
    Reproduction,
    execute,
    filled,
    folders,
    is_reached,
    load,
)
from matplotlib.figure import Figure

import iblf_jax as ij
from iblf_jax.files.scenario import load_scenario_file

NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*_\d{4}")
DOI = re.compile(r"10\.\d{4,9}/\S+")
MOST_LINES = 150
"""Of an example.py; shorter scripts are read."""
INDEPENDENT = 1e-4
"""Largest difference of the states from `independent.py`, unless it defines `TOLERANCE`."""


def faults_of(folder: Path) -> list[str]:
    """What has to be repaired, a sentence each; empty for a correct entry."""
    if not folder.is_dir():
        return [f"{folder} does not exist; `check.py` without a name checks all entries"]
    found = _faults_of_name(folder)
    try:
        entry = load(folder)
    except EntryError as error:
        return found + error.faults
    found += _faults_of_text(entry) + _faults_of_year(folder, entry) + _words_of_template(entry)
    script = folder / "example.py"
    if not script.exists():
        return [*found, "there is no example.py; copy the one of benchmarks/field/template"]
    found += _faults_of_script(script)
    try:
        made = execute(folder)
    except EntryError as error:
        return found + error.faults
    except Exception as error:  # whatever the script raises is reported to its author
        return [*found, f"example.py does not run: {_last_line(error, script)}"]
    found += _faults_of_runs(entry, made) + _faults_of_figure(made.figure)
    options = _faults_of_options(made)
    if options:
        return found + options
    found += _faults_of_numbers(entry, made) + _faults_of_evidence(entry, made)
    found += _faults_of_claims(entry, made)
    return found + _faults_of_scenario(folder, entry) + _faults_of_independent(folder)


def _faults_of_name(folder: Path) -> list[str]:
    if NAME.fullmatch(folder.name):
        return []
    return [
        f"the folder {folder.name!r} must be named after the first author and the year,"
        " such as liu_2018"
    ]


def _faults_of_year(folder: Path, entry: Entry) -> list[str]:
    if folder.name.endswith(f"_{entry.source.year}"):
        return []
    return [
        f"the folder {folder.name!r} must end in the year of entry.toml, [source] year ="
        f" {entry.source.year}"
    ]


def _words_of_template(entry: Entry) -> list[str]:
    """What the author has not replaced yet."""
    template = load(TEMPLATE)
    found = []
    if entry.title == template.title:
        found.append("entry.toml: title is that of the template")
    for name in ("authors", "title", "where", "doi"):
        value = vars(entry.source)[name]
        if value and value == vars(template.source)[name]:
            found.append(f"entry.toml: [source] {name} is that of the template")
    if set(entry.corrected) & set(template.corrected):
        found.append("entry.toml: [[corrected]] has the example of the template")
    return found


def _faults_of_text(entry: Entry) -> list[str]:
    """The links, the times and the numbers of an entry.toml."""
    found = []
    source = entry.source
    if not source.doi and not source.url:
        found.append('entry.toml: [source] needs doi = "10...." or url = "https://..."')
    if source.doi and not DOI.fullmatch(source.doi):
        found.append(f"entry.toml: [source] doi = {source.doi!r} must begin with 10., no address")
    for name in ("url", "code"):
        address = vars(source)[name]
        if address and not address.startswith("https://"):
            found.append(f"entry.toml: [source] {name} = {address!r} must begin with https://")
    if not 0.0 < entry.run.dt < entry.run.duration:
        found.append("entry.toml: [run] needs 0 < dt < duration, in seconds")
    if not entry.printed:
        found.append("entry.toml: no [[printed]]; list the numbers of the source, with their place")
    if not entry.published and not entry.claims:
        found.append(
            "entry.toml: no [[published]] and no [[claims]]; there is nothing to reproduce"
        )
    for number in entry.published:
        if not number.tolerance > 0.0:
            found.append(f"entry.toml: the tolerance of {number.quantity!r} must be positive")
    found += _faults_of_corrections(entry)
    keys = [x.quantity for x in entry.published] + [x.statement for x in entry.claims]
    for key in sorted({key for key in keys if keys.count(key) > 1}):
        found.append(f"entry.toml: {key!r} is there twice")
    return found


def _faults_of_corrections(entry: Entry) -> list[str]:
    """Every correction has a number as its evidence, and says what was asked or answered."""
    found = []
    for i, correction in enumerate(entry.corrected, 1):
        place = f"entry.toml: [[corrected]] number {i}"
        if not re.search(r"[0-9]|{\w", correction.evidence):
            found.append(f"{place}: the evidence needs a number")
        if (correction.contacted == NOT_CONTACTED) != (correction.answer == ""):
            found.append(
                f"{place}: answer = {correction.answer!r} does not agree with contacted ="
                f" {correction.contacted!r}; state what was asked or answered, with its date"
            )
    return found


def _faults_of_script(script: Path) -> list[str]:
    """The length and the docstring of a script."""
    text = script.read_text(encoding="utf-8")
    found = []
    count = len(text.splitlines())
    if count > MOST_LINES:
        found.append(
            f"example.py has {count} lines; shorten it to {MOST_LINES}: numbers can stand in"
            " scenario.toml or in a csv file, and checks of formulas in independent.py"
        )
    try:
        words = ast.get_docstring(ast.parse(text)) or ""
    except SyntaxError:
        return found  # reported when the script is run
    title, _, rest = words.partition(": ")
    if not title or not rest or "\n" in title:
        found.append('example.py must begin with a docstring """Title: one or two sentences."""')
    return found


def _last_line(error: Exception, script: Path) -> str:
    """An error, with the line of the script that raised it."""
    lines = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename == str(script)
    ]
    place = f"line {lines[-1]}: " if lines else ""
    return f"{place}{type(error).__name__}: {error}"


def _faults_of_runs(entry: Entry, made: Reproduction) -> list[str]:
    """The scenario, and the first run of it."""
    found = []
    if not isinstance(made.scenario, ij.Scenario):
        found.append("example.py: scenario must be an ij.Scenario")
    if not isinstance(made.runs, dict) or not made.runs:
        return [*found, "example.py: runs must be a dict of Rollouts by name, and not empty"]
    for name, run in made.runs.items():
        if not isinstance(run, ij.Rollout):
            found.append(f"example.py: runs[{name!r}] must be the Rollout of ij.simulate")
    if found:
        return found
    name, run = next(iter(made.runs.items()))
    if not math.isclose(float(run.t[-1]), entry.run.duration, rel_tol=1e-9):
        found.append(
            f"example.py: the first run, {name!r}, ends at {float(run.t[-1]):g} s, and"
            f" entry.toml: [run] has duration = {entry.run.duration:g}"
        )
    if not math.isclose(float(run.dt), entry.run.dt, rel_tol=1e-9):
        found.append(
            f"example.py: the first run, {name!r}, has the step {float(run.dt):g} s, and"
            f" entry.toml: [run] has dt = {entry.run.dt:g}"
        )
    return found


def _faults_of_options(made: Reproduction) -> list[str]:
    """The names that an example may define in addition."""
    found = []
    for name in ("reached", "holds", "evidence", "details", "not_applicable"):
        if not isinstance(getattr(made, name), dict):
            found.append(f"example.py: {name} must be a dict")
    if made.uncertain is None or not isinstance(made.scenario, ij.Scenario):
        return found
    known = {parameter.path for parameter in ij.parameters(made.scenario)}
    for path in made.uncertain:
        if path not in known or not path.startswith("plant."):
            found.append(f"example.py: uncertain has {path!r}, which is no parameter of the plant")
    return found


def _faults_of_figure(figure: object) -> list[str]:
    """The figure, and the labels of its axes."""
    if not isinstance(figure, Figure):
        return ["example.py: figure must be a matplotlib figure"]
    drawn = [axes for axes in figure.axes if axes.get_visible() and axes.has_data()]
    if not drawn:
        return ["example.py: the figure has no curves"]
    found = []
    for number, axes in enumerate(drawn, 1):
        for which in ("x", "y"):
            shared = getattr(axes, f"get_shared_{which}_axes")().get_siblings(axes)
            labels = [getattr(other, f"get_{which}label")() for other in shared]
            if not any(labels):
                found.append(
                    f"example.py: panel {number} of the figure has no label of its {which} axis"
                )
    return found


def _is_number(value: object) -> bool:
    """Whether a value is one number, of Python, NumPy or JAX."""
    return not isinstance(value, str) and np.ndim(value) == 0 and value is not None


def _faults_of_numbers(entry: Entry, made: Reproduction) -> list[str]:
    """Every published number is reached."""
    found = []
    for number in entry.published:
        if number.quantity not in made.reached:
            found.append(f"example.py: reached lacks {number.quantity!r}, which is [[published]]")
            continue
        value = made.reached[number.quantity]
        if not _is_number(value):
            found.append(f"example.py: reached[{number.quantity!r}] must be one number")
            continue
        value = float(value)
        if not is_reached(number, value):
            found.append(
                f"{number.quantity!r} is not reached: published {number.value:g}, here {value:.6g},"
                f" a difference of {abs(value - number.value):.3g} where {number.tolerance:g} is"
                " allowed"
            )
    for key in sorted(set(made.reached) - {number.quantity for number in entry.published}):
        found.append(f"entry.toml: no [[published]] has the quantity {key!r} of reached")
    return found


def _faults_of_evidence(entry: Entry, made: Reproduction) -> list[str]:
    """Every number of `evidence` is one, and is used; every {name} of the texts is one of them."""
    found = []
    for key, value in made.evidence.items():
        if not _is_number(value):
            found.append(f"example.py: evidence[{key!r}] must be one number")
    if found:
        return found
    texts = "\n".join(correction.evidence for correction in entry.corrected)
    try:
        filled(texts, made.evidence)
    except EntryError as error:
        return error.faults
    used = {match[1] for match in PLACEHOLDER.finditer(texts)}
    for key in sorted(set(made.evidence) - used):
        found.append(f"entry.toml: no evidence of [[corrected]] contains {{{key}}}")
    for key in sorted(used - set(made.evidence)):
        found.append(f"example.py: evidence lacks {key!r}, which a [[corrected]] contains")
    return found


def _faults_of_claims(entry: Entry, made: Reproduction) -> list[str]:
    """Every claim holds."""
    found = []
    for claim in entry.claims:
        if claim.statement not in made.holds:
            found.append(f"example.py: holds lacks {claim.statement!r}, which is in [[claims]]")
        elif not isinstance(made.holds[claim.statement], bool | np.bool_):
            found.append(
                f"example.py: holds[{claim.statement!r}] must be True or False; use bool(np.all())"
            )
        elif not made.holds[claim.statement]:
            found.append(
                f"the claim {claim.statement!r} does not hold; if the publication is wrong, move it"
                " to [[corrected]]"
            )
    statements = {claim.statement for claim in entry.claims}
    for name, found_in in (("holds", made.holds), ("details", made.details)):
        for key in sorted(set(found_in) - statements):
            found.append(f"entry.toml: no [[claims]] has the statement {key!r} of {name}")
    return found


def _faults_of_scenario(folder: Path, entry: Entry) -> list[str]:
    """The scenario file, where there is one."""
    path = folder / "scenario.toml"
    if not path.exists():
        return []
    place = f"benchmarks/field/entries/{folder.name}/scenario.toml"
    command = f"python -m iblf_jax simulate {place}"
    found = []
    if not path.read_text(encoding="utf-8").split("\n", 1)[0].endswith(command):
        found.append(f"scenario.toml: the first line must be a comment that ends in: {command}")
    try:
        options = load_scenario_file(path).run
    except ValueError as error:
        return [*found, f"scenario.toml: {error}"]
    if (options.get("duration"), options.get("dt")) != (entry.run.duration, entry.run.dt):
        found.append("scenario.toml: [run] must have the duration and dt of entry.toml")
    return found


class Independent(NamedTuple):
    """What the program without the package found."""

    difference: float
    """Of the states from those of `example.py`."""
    allowed: float


@functools.cache
def independent(folder: Path) -> Independent | None:
    """Runs the `independent.py` of a folder, once a process; None where there is none.

    Raises:
      EntryError: it does not define `compare`.
    """
    path = folder / "independent.py"
    if not path.exists():
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        names = runpy.run_path(str(path))
        if "compare" not in names:
            raise EntryError(["independent.py must define compare() -> float"])
        difference = float(names["compare"]())
    return Independent(difference, names.get("TOLERANCE", INDEPENDENT))


def _faults_of_independent(folder: Path) -> list[str]:
    """The program without the package, where there is one."""
    try:
        found = independent(folder)
    except EntryError as error:
        return error.faults
    except Exception as error:  # whatever the script raises is reported to its author
        return [f"independent.py does not run: {_last_line(error, folder / 'independent.py')}"]
    if found is None or found.difference <= found.allowed:
        return []
    return [
        f"independent.py: compare() gives {found.difference:.3g}, where {found.allowed:g} is"
        " allowed"
    ]


def computed_numbers(folder: Path) -> list[str]:
    """What the scripts of a correct entry computed, one line each."""
    made = execute(folder)
    numbers = {**made.reached, **made.evidence}
    return [
        *(f"{name} = {float(value):.6g}" for name, value in numbers.items()),
        *(f"{statement}: {text}" for statement, text in made.details.items()),
    ]


def result_of(folder: Path, found: list[str]) -> dict[str, Any]:
    """What `--json` writes of an entry; only what has to be repaired if that is anything."""
    if found:
        return {"to repair": found}
    made = execute(folder)
    result = {
        "to repair": [],
        "reached": {name: float(value) for name, value in made.reached.items()},
        "holds": {statement: bool(value) for statement, value in made.holds.items()},
        "evidence": {name: float(value) for name, value in made.evidence.items()},
    }
    compared = independent(folder)
    if compared:
        result["independent"] = compared._asdict()
    return result


def add_result(name: str, file: Path, law: str) -> int:
    """Puts a result of another program into the table of an entry; 1 if it is refused."""
    try:
        row = external.add(name, file, law)
    except (OSError, ValueError) as error:
        print(f"{name}: {file} is refused: {error}")
        return 1
    print(f"{name}: {file} is accepted")
    for key, value in row.items():
        print(f"  - {key}: {value}")
    return 0


def main() -> int:
    """Checks the named entries, or adds a result."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="entries; all if none is given")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the results go")
    parser.add_argument("--result", nargs=2, metavar=("NAME", "FILE"), help="of another program")
    parser.add_argument("--law", metavar="TEXT", help="the law of this result, and its program")
    args = parser.parse_args()
    if args.result and not args.law:
        parser.error("--result needs --law, the law and its program in words")
    if args.result:
        name, file = args.result
        return add_result(name, Path(file), args.law)
    import jax

    jax.config.update("jax_enable_x64", True)
    matplotlib.use("Agg")
    chosen = [ENTRIES / name for name in args.names] or folders()
    command = shlex.join(["python", "benchmarks/field/check.py", *args.names])
    results: dict[str, Any] = {"command": command, "machine": machine(), "entries": {}}
    faulty = 0
    for folder in chosen:
        found = faults_of(folder) or tasks.faults_of(folder)
        faulty += bool(found)
        print(f"{folder.name}: {'correct' if not found else f'{len(found)} to repair'}", flush=True)
        for line in found or computed_numbers(folder):
            print(f"  - {line}")
        results["entries"][folder.name] = result_of(folder, found)
        if args.json:
            # After each entry, so that a check that stops has not been for nothing.
            args.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    print(f"{len(chosen) - faulty} of {len(chosen)} entries are correct")
    return faulty


if __name__ == "__main__":
    sys.exit(main())
