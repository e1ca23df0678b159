"""The pages "Benchmark of the field" and "What the literature printed, and what is correct".

The first one has the entries of `benchmarks/field/entries` and the results of
`benchmarks/field/measure.py`; the second one has the corrections of all entries. The numbers are
those of `benchmarks/field/results` and those that the gallery computed when it made the page of an
entry (`gallery.page`).
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path += [str(BENCHMARKS), str(BENCHMARKS / "field")]

import external
import gallery
import withdrawn
from entry import (
    CHECKS,
    FOUND_IN,
    KINDS,
    NOT_CONTACTED,
    PUBLISHED,
    READ,
    RESULTS,
    Correction,
    Entry,
    Published,
    filled,
    folders,
    is_reached,
    load,
)
from entry_tables import escaped, markdown_table

MANY = 100
"""The page names a published law as losing its accuracy with noise if the share of the best law
with noise is so many times smaller than that without."""
ERROR, NOISE = "error [", "error, noise ["
"""Beginnings of the columns of the largest error, and of that with noise."""
COLUMNS = {
    "factor": "of the gains of the law, so that its effort is that of the published law; 'own'"
    " where no factor from 1/32 to 32 gives this effort, and the law runs at its own gains",
    "effort": "of the law, as a share of the effort of the published law",
    "RMS error, error": "RMS and largest absolute value of $e_1$ over all components, in the second"
    " half of the run",
    "peak input": "largest input of the entire run",
    "margin": "least distance to any bound of the task over the entire run, for the first level as"
    " a share of the distance between the reference and that bound, for others of half the distance"
    " between the bounds; many runs have their least distance at the start",
    "..., parameters": "the worse of two plants whose uncertain parameters are 0.8 and 1.2 times"
    " those of the entry; the model of the law is the one of the entry",
    "..., sampled": "law and observer run once in 2 ms, or in the nearest whole number of steps,"
    " and read exact sensors; also where the task has a period of its own, which the other columns"
    " keep. The period is stated above each table",
    "..., noise": "the same with white noise on every level; its standard deviation is {noise:g}"
    " times half the least distance between the bounds, and on the further levels {noise:g} times"
    " their largest value in the published run",
}
"""Column of the tables -> its meaning."""
INTRODUCTIONS = {
    "publication": "Articles and theses, read in the edition that the table names.",
    "program": "Programs of the authors of a publication, and programs of others that follow one."
    " The publication may be right where the program is not: it is not concerned, unless its list"
    " above has it.",
}
"""Value of `found_in` of a correction -> the sentences above its list."""


class Part(NamedTuple):
    """An entry with what was computed for it."""

    name: str
    contents: Entry
    computed: dict[str, Any]
    """Of `gallery.page`."""
    result: dict[str, Any] | None
    """Of `measure.py`; None where there is no table."""
    external: tuple[dict[str, Any], ...] = ()
    """Rows of other programs on the task of the entry."""

    @property
    def is_withdrawn(self) -> bool:
        """Whether the table of the entry was removed, and it is not measured again yet."""
        return self.result is None and self.name in withdrawn.FIELD

    @property
    def link(self) -> str:
        """The entry's title, as a link to its page."""
        return f"[{escaped(self.contents.title)}](gallery/{self.name}.md)"

    @property
    def short_link(self) -> str:
        """The first author and the year, as a link to the entry's page."""
        source = self.contents.source
        author = escaped(source.authors.split(",")[0])
        return f"[{author} {source.year}](gallery/{self.name}.md)"


class Efforts(NamedTuple):
    """What was equal in the tables of some entries: numbers of laws beside the published ones."""

    tables: int
    laws: int
    equal: int
    """Laws with one factor on their gains, whose effort is the published law's within 1 %."""
    own: int
    """Laws that reach this effort with no factor from 1/32 to 32, and run at their own gains."""
    failed: int
    """Laws without an error of the run without sampling: they leave the bounds or diverge, or the
    step of the entry is too large for them."""
    compared: int
    """Laws with such a factor and an error."""

    @property
    def in_words(self) -> str:
        """The numbers, in a sentence."""
        return (
            f"of {self.laws} laws in {self.tables} tables {self.equal} have such a factor,"
            f" {self.own} have none and run at gains of their own, and"
            f" {self.failed} have no error, because they leave the bounds or diverge, or the time"
            f" step is too large for them; {self.compared} have both the factor and an error"
        )


def efforts(results: list[dict[str, Any]]) -> Efforts:
    """Counts what was equal in some results of `measure.py`."""
    laws, equal, failed, compared = 0, 0, 0, 0
    for result in results:
        error = column(result, ERROR)
        for row in result["rows"]:
            if row["law"] == PUBLISHED:
                continue
            is_equal, has_error = row["factor"] != "own", isinstance(row[error], float)
            laws += 1
            equal += is_equal
            failed += not has_error
            compared += is_equal and has_error
    return Efforts(len(results), laws, equal, laws - equal, failed, compared)


def parts(results: Path = RESULTS, made: Path = gallery.MADE) -> list[Part]:
    """All entries."""
    found = []
    for folder in folders():
        computed = json.loads((made / f"{folder.name}.json").read_text(encoding="utf-8"))
        file = results / f"{folder.name}.json"
        result = json.loads(file.read_text(encoding="utf-8")) if file.exists() else None
        others = tuple(external.rows_of(folder.name))
        found.append(Part(folder.name, load(folder), computed, result, others))
    return found


def write(folder: Path) -> None:
    """Writes both pages."""
    found = parts()
    (folder / "field.md").write_text(benchmark_page(found), encoding="utf-8")
    (folder / "literature_corrected.md").write_text(corrections_page(found), encoding="utf-8")


# ---------------------------------------------------------------------------- the benchmark


def benchmark_page(found: list[Part]) -> str:
    """The table of all entries, and the results of each."""
    numbers = [is_reached(x, part.computed["reached"][x.quantity]) for part, x in published(found)]
    holds = [value for part in found for value in part.computed["holds"].values()]
    corrected = sum(len(part.contents.corrected) for part in found)
    measured = [part for part in found if part.result]
    noise = measured[0].result["noise"] if measured else 0.0
    sections = [
        "# Benchmark of the field",
        f"{len(found)} published examples of barrier, prescribed-performance and constrained"
        " control, reproduced with the plants and laws of this package. Each entry has a page with"
        " the printed and the missing parameters, the script, and the published numbers beside"
        f" those that the script reaches: {sum(numbers)} of {len(numbers)} published numbers are"
        " reached within the accuracy to which they can be read, and"
        f" {sum(holds)} of {len(holds)} published statements hold."
        f" [A page of its own](literature_corrected.md) lists {corrected} corrections."
        " [Adding an entry](add_an_entry.md) describes the steps, and [the tasks](tasks.md) are"
        " files that programs in any language can run." + checked(),
        "## Entries",
        summary(found),
        "The last three columns name the law of the package that has the smallest error among"
        " those with a factor for the effort of the published law, sampled at about 500 Hz with"
        " noise, and its errors with and"
        " without noise as shares of those of the published law. Without noise many of these tasks"
        " have an exact model and no disturbance, so that errors tend to zero under every law and"
        " their ratio states how fast." + noisy_laws(measured),
        "## Comparison on each task",
        f"{len(measured)} of {len(found)} entries have a table. The published law sets the effort:"
        " the RMS input above the one that balances gravity, over the entire run, so that most of"
        " it may belong to the start. For"
        " a plant in strict-feedback form it is the RMS of all inputs, each in its unit, above the"
        " steady input of the plant, which is zero where the plant states none. One factor scales"
        " the gains of every other law to this effort. Before that, the laws have the rates of the"
        " published law, and boxes and limits at the scales of the published run"
        " (`benchmarks/field/measure.py`). Laws"
        " with several gains, or with a choice of the published gains for another purpose, could be"
        " tuned further; the tables compare laws at one ratio of their gains."
        " Not all laws were equal in this sense:"
        f" {efforts([x.result for x in measured]).in_words}.",
        markdown_table(
            ["column", "meaning"],
            [[name, meaning.format(noise=noise)] for name, meaning in COLUMNS.items()],
        ),
        '"left" is a run that leaves its bounds or diverges, and "step" one for which the time step'
        " of the entry is too large.",
        *(section(part) for part in measured),
        *without_table(found),
        *(of_other_programs(part) for part in found if part.external and not part.result),
    ]
    return "\n\n".join(sections) + "\n"


def checked() -> str:
    """What `check.py` found with each version, in sentences; "" if it was not noted."""
    sentences = []
    for path in sorted(CHECKS.glob("*.json")):
        result = json.loads(path.read_text(encoding="utf-8"))
        entries, machine = result["entries"], result["machine"]
        correct = sum(not found["to repair"] for found in entries.values())
        sentences.append(
            f" With Python {machine['python']} and JAX {machine['jax']} ({machine['date']}),"
            f" `benchmarks/field/check.py` found {correct} of {len(entries)} entries correct."
        )
    return "".join(sentences)


def published(found: list[Part]) -> list[tuple[Part, Published]]:
    """The published numbers of all entries."""
    return [(part, number) for part in found for number in part.contents.published]


def summary(found: list[Part]) -> str:
    """One row for each entry."""
    headings = [
        "entry",
        "plant",
        "method",
        "levels",
        "read",
        "published and reached",
        "best law",
        "error, noise",
        "error",
    ]
    rows = []
    for part in sorted(found, key=lambda part: (part.contents.source.year, part.name)):
        contents = part.contents
        rows.append(
            [
                part.short_link,
                contents.plant,
                contents.method,
                str(part.computed["levels"]),
                READ[contents.source.read],
                published_and_reached(part),
                *best_law(part),
            ]
        )
    return markdown_table(headings, rows)


def published_and_reached(part: Part) -> str:
    """The first published number and the reached one, and how many numbers and statements there
    are.
    """
    numbers = part.contents.published
    holds = part.computed["holds"].values()
    texts = []
    if numbers:
        first = numbers[0]
        value = part.computed["reached"][first.quantity]
        texts.append(f"{escaped(first.quantity)}: {first.value:g}, reached {value:.4g}")
    if len(numbers) > 1:
        reached = [is_reached(x, part.computed["reached"][x.quantity]) for x in numbers]
        texts.append(f"{sum(reached)} of {len(numbers)} numbers")
    if holds:
        texts.append(f"{sum(holds)} of {len(holds)} statements hold")
    return "; ".join(texts)


def best_law(part: Part) -> tuple[str, str, str]:
    """The law with the smallest error with noise among those with a factor, and its errors with and
    without noise as shares of those of the published law.
    """
    if part.is_withdrawn:
        return "withdrawn", "", ""
    if part.result is None:
        return "not measured", "", ""
    best = _name_of_best(part.result)
    if best is None:
        return "none has a factor", "", ""
    rows = {row["law"]: row for row in part.result["rows"]}
    columns = [column(part.result, start) for start in (NOISE, ERROR)]
    shares = [_share(rows[best][name], rows[PUBLISHED][name]) for name in columns]
    # The place at which a narrow column may break the name.
    return best.replace("(", "\u200b("), *shares


def _name_of_best(result: dict[str, Any]) -> str | None:
    """The law with a factor that has the smallest error with noise; None if there is none."""
    with_noise = column(result, NOISE)
    inside = {
        row["law"]: row[with_noise]
        for row in result["rows"]
        if row["law"] != PUBLISHED and isinstance(row[with_noise], float) and row["factor"] != "own"
    }
    if not inside:
        return None
    return min(inside, key=lambda name: inside[name])


def noisy_laws(measured: list[Part]) -> str:
    """The rows whose share with noise is many times smaller than that without, and the errors of
    the published law that cause it, in a sentence; "" if there are none.
    """
    listed = [text for part in measured if (text := _loss_with_noise(part))]
    if not listed:
        return ""
    return (
        f" If the share with noise is more than {MANY} times smaller than that without, the"
        " published law is accurate only without sampling and noise, and the best law also with"
        " them:"
        f" {'; '.join(listed)}."
    )


def _loss_with_noise(part: Part) -> str:
    """The errors of a published law that loses its accuracy with noise, "" for other laws."""
    best = _name_of_best(part.result)
    rows = {row["law"]: row for row in part.result["rows"]}
    if best is None:
        return ""
    noise, error = (column(part.result, start) for start in (NOISE, ERROR))
    values = [rows[law][name] for law in (PUBLISHED, best) for name in (noise, error)]
    if not all(isinstance(value, float) for value in values):
        return ""
    own_noise, own_error, best_noise, best_error = values
    if MANY * best_noise * own_error >= best_error * own_noise:
        return ""
    unit = error.removeprefix(ERROR).rstrip("]")
    return (
        f"the published law of {part.short_link} has an error of {own_noise:.3g} {unit} with noise"
        f" and {own_error:.2g} {unit} without"
    )


def _share(value: Any, own: Any) -> str:
    """An error as a share of that of the published law."""
    if not isinstance(own, float):
        return f"the published law {own}"
    if not isinstance(value, float):
        return str(value)
    return f"{value / own:.2g}"


def column(result: dict[str, Any], start: str) -> str:
    """The column whose name begins so."""
    return next(name for name in result["rows"][0] if name.startswith(start))


def section(part: Part) -> str:
    """The table of an entry that is measured."""
    heading = f"### {part.contents.title}"
    result = part.result
    columns = list(result["rows"][0])
    rows = [[_cell(row[name]) for name in columns] for row in result["rows"]]
    words = [
        f"{part.link}; {result['duration']:g} s with a step of {result['dt']:g} s; the effort is"
        f" that of the {result['input']}. The sampled runs have a period of"
        f" {1e3 * result['period']:.4g} ms.",
        _uncertain(result),
    ]
    reasons = [f"{name}: {escaped(why)}" for name, why in result["not_applicable"].items()]
    if reasons:
        words.append("Not in the table: " + "; ".join(reasons) + ".")
    for pair in part.contents.equal_rows:
        words.append(f"{pair.law} and {pair.other} agree. {escaped(pair.reason)}")
    machine = result["machine"]
    where = (
        f"`{result['command']}`; {machine['processor']}, {machine['cores']} cores, Python"
        f" {machine['python']}, jax {machine['jax']}, {machine['date']}."
    )
    parts = [heading, " ".join(words), markdown_table(columns, rows), where]
    if part.external:
        parts.append(of_other_programs(part))
    return "\n\n".join(parts)


def of_other_programs(part: Part) -> str:
    """The table of results that other programs reached on the task of an entry."""
    task = external.digest(external.TASKS / f"{part.name}.json")
    numbers = ("RMS error", "error", "effort", "peak input", "margin")
    rows = []
    for row in part.external:
        law, left = escaped(row["law"]), "; ".join(row["left"])
        cells = [_cell(row[name]) for name in numbers]
        if row["sha256 of the task"] != task:
            cells, left = ["another task"] * len(numbers), "the task has changed since"
        rows.append([law, *cells, escaped(left), f"`{row['sha256'][:12]}`", row["date"]])
    words = (
        f"Results of other programs on {part.link}, files that `check.py --result` accepted. They"
        " are no part of the other tables: their numbers are those at the rows of the files, and"
        " the effort is a share of that of the published law."
    )
    headings = ["law (external)", *numbers, "left", "SHA-256 of the file", "date"]
    return f"{words}\n\n{markdown_table(headings, rows)}"


def without_table(found: list[Part]) -> list[str]:
    """Which entries have no table, and why; empty if all have one."""
    lines = []
    removed = [part.link for part in found if part.is_withdrawn]
    if removed:
        lines.append(
            f"- The tables of {len(removed)} entries are withdrawn, because they were"
            f" {withdrawn.REASON}; they will be measured again: {'; '.join(removed)}."
        )
    for part in found:
        if part.result or part.is_withdrawn:
            continue
        reason = part.contents.not_measured
        words = f" is not measured: {reason}" if reason else " is not measured yet."
        lines.append(f"- {part.link}{words}")
    return ["### Entries without a table", "\n".join(lines)] if lines else []


def _uncertain(result: dict[str, Any]) -> str:
    """Which parameters are uncertain, in a sentence."""
    if not result["uncertain"]:
        return "No parameter of the plant is uncertain."
    return "Uncertain parameters: " + ", ".join(f"`{path}`" for path in result["uncertain"]) + "."


def _cell(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


# ---------------------------------------------------------------------------- the corrections


def corrections_page(found: list[Part]) -> str:
    """All corrections: a list of those of publications and one of those of programs, each grouped
    by what was wrong.
    """
    lists: dict[str, list[tuple[Part, Correction]]] = {place: [] for place in FOUND_IN}
    for part in found:
        for correction in part.contents.corrected:
            lists[correction.found_in].append((part, correction))
    count = sum(len(corrections) for corrections in lists.values())
    concerned = sum(bool(part.contents.corrected) for part in found)
    contacted = sum(
        correction.contacted != NOT_CONTACTED
        for corrections in lists.values()
        for _, correction in corrections
    )
    sections = [
        "# What the literature printed, and what is correct",
        f"{count} corrections, found while {concerned} of the {len(found)} published examples of"
        " the [benchmark of the field](field.md) were reproduced:"
        f" {len(lists['publication'])} of publications and {len(lists['program'])} of programs."
        " An entry has the name of whoever made what was read. Each correction states the commit or"
        " the edition that was read, its evidence, and whether somebody was asked:"
        f" {contacted} of {count} were. The"
        " numbers of the evidence were computed by the script of the entry when this page was made,"
        " unless they are cited. The page"
        " [Printed and corrected](theory/printed_and_corrected.md) derives the corrections of the"
        " law and of the observer of the paper that this package is built on.",
    ]
    for place, corrections in lists.items():
        sections += [f"## {FOUND_IN[place]}", INTRODUCTIONS[place]]
        for kind in KINDS:
            group = [pair for pair in corrections if pair[1].kind == kind]
            if group:
                sections += [f"### {KINDS[kind]}", corrections_table(group)]
    return "\n\n".join(sections) + "\n"


def corrections_table(group: list[tuple[Part, Correction]]) -> str:
    """The corrections of a group."""
    rows = []
    for part, correction in group:
        source = part.contents.source
        read = f"{READ[source.read]}, {correction.edition_of(source)}"
        texts = [
            read,
            correction.printed,
            correction.corrected,
            filled(correction.evidence, part.computed["evidence"]),
            source.contact,
            correction.contact_in_words,
        ]
        rows.append([part.short_link, *map(escaped, texts)])
    headings = ["entry", "read", "printed", "corrected", "evidence", "who could be asked"]
    return markdown_table([*headings, "contact"], rows)
