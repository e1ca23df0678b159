"""The pages "Benchmark of the field" and "Corrections of publications and programs".

The first one has the entries of `benchmarks/field/entries`, the second one their corrections. The
numbers are those that the gallery computed when it made the page of an entry (`gallery.page`).
`field_budget.py` makes the page that compares laws on the tasks of entries.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path += [str(BENCHMARKS), str(BENCHMARKS / "field")]

import external
import field_budget
import gallery
import not_readable
from entry import (
    CHECKS,
    FOUND_IN,
    KINDS,
    NOT_CONTACTED,
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

INTRODUCTIONS = {
    "publication": "Articles and theses, read in the edition that the table names.",
    "program": "Programs of the authors of a publication or of a group of theirs, and programs of"
    " others that follow one. The publication may be right where the program is not: it is not"
    " concerned, unless its list above has it.",
}
"""Value of `found_in` of a correction -> the sentences above its list."""


class Part(NamedTuple):
    """An entry with what was computed for it."""

    name: str
    contents: Entry
    computed: dict[str, Any]
    """Of `gallery.page`."""
    is_compared: bool
    """Whether `equal_budget.py` has a result."""
    external: tuple[dict[str, Any], ...] = ()
    """Rows of other programs on the task of the entry."""

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


def parts(results: Path = RESULTS, made: Path = gallery.MADE) -> list[Part]:
    """All entries."""
    found = []
    for folder in folders():
        computed = json.loads((made / f"{folder.name}.json").read_text(encoding="utf-8"))
        is_compared = (results / f"{folder.name}.json").exists()
        others = tuple(external.rows_of(folder.name))
        found.append(Part(folder.name, load(folder), computed, is_compared, others))
    return found


def write(folder: Path) -> None:
    """Writes both pages."""
    found = parts()
    (folder / "field.md").write_text(benchmark_page(found), encoding="utf-8")
    (folder / "literature_corrected.md").write_text(corrections_page(found), encoding="utf-8")


# ---------------------------------------------------------------------------- the benchmark


def benchmark_page(found: list[Part]) -> str:
    """The table of all entries, and the results of other programs."""
    numbers = [is_reached(x, part.computed["reached"][x.quantity]) for part, x in published(found)]
    holds = [value for part in found for value in part.computed["holds"].values()]
    corrected = sum(len(part.contents.corrected) for part in found)
    compared = sum(part.is_compared for part in found)
    sections = [
        "# Benchmark of the field",
        f"{len(found)} published examples of barrier, prescribed-performance and constrained"
        " control, reproduced with the plants and laws of this package. Each entry has a page with"
        " the printed and the missing parameters, the script, and the published numbers beside"
        f" those that the script reaches: {sum(numbers)} of {len(numbers)} published numbers are"
        " reached within the tolerances of the entries, most of which are the accuracy to which a"
        " figure can be read, and a few that of the published program's solver, and"
        f" {sum(holds)} of {len(holds)} published statements hold."
        f" [A page of its own](literature_corrected.md) lists {corrected} corrections."
        " [Adding an entry](add_an_entry.md) describes the steps, and [the tasks](tasks.md) are"
        " files that programs in any language can run." + checked({part.name for part in found}),
        f"On {compared} of the {len(found)} tasks [laws are compared with the same budget of"
        f" tuning]({field_budget.NAME}.md), the law of the entry among them.",
        "## Entries",
        summary(found),
        works_without_entry(found),
        *(of_other_programs(part) for part in found if part.external),
    ]
    return "\n\n".join(sections) + "\n"


def checked(names: set[str]) -> str:
    """What `check.py` found with each version, in sentences, and which of these entries it did not
    read; "" if nothing was noted.
    """
    sentences = []
    for path in sorted(CHECKS.glob("*.json")):
        result = json.loads(path.read_text(encoding="utf-8"))
        entries, machine = result["entries"], result["machine"]
        correct = sum(not found["to repair"] for found in entries.values())
        sentences.append(
            f" With Python {machine['python']} and JAX {machine['jax']} ({machine['date']}),"
            f" `benchmarks/field/check.py` found {correct} of {len(entries)} entries correct."
        )
        if later := sorted(names - set(entries)):
            words = escaped(", ".join(later))
            sentences.append(f" It did not read {words}, which are later entries.")
    return "".join(sentences)


def works_without_entry(found: list[Part]) -> str:
    """The works that could not be read, with the entries that are nearest to them."""
    links = {part.name: part.link for part in found}
    items = []
    for work in not_readable.NOT_READABLE:
        near = ", ".join(links[name] for name in work.entries)
        item = f"- {work.reference}. Found: {work.found}."
        items.append(f"{item} Nearest: {near}." if near else item)
    return (
        "Not readable: of the following works neither a text with all parameters nor a program of"
        f" the authors could be read ({not_readable.SEARCHED}), so that they have no entry of their"
        " own. That is a statement about this search, and not about the works. The entries named"
        " are the nearest in method; their pages state what was read.\n\n" + "\n".join(items)
    )


def published(found: list[Part]) -> list[tuple[Part, Published]]:
    """The published numbers of all entries."""
    return [(part, number) for part in found for number in part.contents.published]


def summary(found: list[Part]) -> str:
    """One row for each entry."""
    headings = ["entry", "plant", "method", "levels", "read", "published and reached", "compared"]
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
                "yes" if part.is_compared else "",
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
        " have no common budget of tuning. The numbers are those at the rows of the files: errors"
        " of the second half of the run, and the effort as a share of that of the law of the entry."
    )
    headings = ["law (external)", *numbers, "left", "SHA-256 of the file", "date"]
    return f"{words}\n\n{markdown_table(headings, rows)}"


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
        "# Corrections of publications and programs",
        f"{count} corrections, found while {concerned} of the {len(found)} published examples of"
        " the [benchmark of the field](field.md) were reproduced:"
        f" {len(lists['publication'])} of publications and {len(lists['program'])} of programs."
        " An entry has the name of whoever made what was read. Each correction states the commit or"
        " the edition that was read, its evidence, and whether somebody was asked:"
        f" {contacted} of {count} were. The"
        " numbers of the evidence were computed by the script of the entry when this page was made,"
        " unless they are cited. Not every correction is one of an error: some state what limits a"
        " result or what causes it, and some change no number; the evidence states which."
        " The page"
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
