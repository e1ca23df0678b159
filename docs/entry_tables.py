"""Tables of the pages of the benchmark of the field: an `entry.toml` as Markdown."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1] / "benchmarks" / "field"))

from entry import READ, Entry, Reproduction, filled

from iblf_jax.world import plants

CODE_AND_FORMULAS = re.compile(r"(`[^`]*`|\$[^$]*\$)")
"""Parts of a text that Markdown does not interpret."""


def escaped(text: str) -> str:
    """A text in which stars, underscores and angle brackets are characters, outside of code and
    formulas.
    """
    parts = CODE_AND_FORMULAS.split(" ".join(text.split()))
    for i in range(0, len(parts), 2):
        parts[i] = re.sub(r"([*_<\[\]~])", r"\\\1", parts[i])
    return "".join(parts)


def markdown_table(headings: list[str], rows: list[list[str]]) -> str:
    """A table; cells are Markdown."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines)


def _cell(text: str) -> str:
    return re.sub(r"(?<!\\)\|", r"\\|", text)


def _records(items: tuple[Any, ...], headings: list[str]) -> str:
    """A table of dataclasses, a column a field."""
    rows = [[escaped(str(x)) for x in dataclasses.astuple(item)] for item in items]
    return markdown_table(headings, rows)


def source_in_words(entry: Entry) -> str:
    """The publication, its address, and what was read."""
    source = entry.source
    text = (
        f"{escaped(source.authors)}, {escaped(source.title)}, {escaped(source.where)}"
        f" ([{source.link.removeprefix('https://')}]({source.link}))."
    )
    if source.code:
        text += f" Public program: <{source.code}>."
    return f"{text} Source of the numbers: {READ[source.read]}, {escaped(source.edition)}."


def before_the_script(entry: Entry, made: Reproduction) -> list[str]:
    """What was published, and what had to be corrected and assumed."""
    parts = [source_in_words(entry), "## Printed"]
    parts.append(_records(entry.printed, ["quantity", "value", "where"]))
    if entry.corrected:
        parts += ["## Corrected", corrections(entry, made.evidence)]
    if entry.missing:
        parts += ["## Missing in the source", _records(entry.missing, ["quantity", "assumed here"])]
    if entry.chosen:
        parts += ["## Chosen by this entry", _records(entry.chosen, ["quantity", "chosen here"])]
    if entry.published:
        parts += ["## Published and reached", published(entry, made.reached)]
    if entry.claims:
        parts += ["## Published statements", claims(entry, made)]
    parts.append("## Script")
    return parts


def after_the_script(entry: Entry) -> list[str]:
    """What was not reproduced."""
    return ["## Not reproduced", escaped(entry.not_reproduced.text)]


def corrections(entry: Entry, evidence: dict[str, float]) -> str:
    """The corrections, with the computed numbers of their evidence, what was read, and whether
    somebody was asked.
    """
    rows = []
    for x in entry.corrected:
        texts = [x.printed, x.corrected, filled(x.evidence, evidence)]
        texts += [x.edition_of(entry.source), x.contact_in_words]
        rows.append([x.found_in, *map(escaped, texts)])
    headings = ["found in the", "printed", "corrected", "evidence", "read", "contact"]
    table = markdown_table(headings, rows)
    return f"{table}\n\nWho could be asked: {escaped(entry.source.contact)}."


def published(entry: Entry, reached: dict[str, float]) -> str:
    """The published numbers beside those of the run."""
    rows = [
        [
            escaped(x.quantity),
            f"{x.value:g}",
            f"{float(reached[x.quantity]):.5g}",
            f"{x.tolerance:g}",
            escaped(x.where),
        ]
        for x in entry.published
    ]
    return markdown_table(["quantity", "published", "reached", "tolerance", "where"], rows)


def claims(entry: Entry, made: Reproduction) -> str:
    """The published statements, whether they hold in the run, and, where the script gives them, the
    numbers that decide it.
    """
    rows = []
    for claim in entry.claims:
        answer = "yes" if made.holds[claim.statement] else "no"
        detail = made.details.get(claim.statement, "")
        rows.append([escaped(x) for x in (claim.statement, answer, detail, claim.where)])
    headings = ["statement", "holds", "numbers and criterion", "where"]
    if made.details:
        return markdown_table(headings, rows)
    without_details = [[*row[:2], row[3]] for row in rows]
    return markdown_table([*headings[:2], headings[3]], without_details)


def computed(made: Reproduction) -> str:
    """The numbers of a run as JSON, for the pages that list all entries."""
    return json.dumps(
        {
            "reached": {name: float(x) for name, x in made.reached.items()},
            "holds": {name: bool(x) for name, x in made.holds.items()},
            "evidence": {name: float(x) for name, x in made.evidence.items()},
            "levels": plants.order_of(made.scenario.plant),
        },
        indent=1,
    )
