"""Tables of words, as text in columns and as HTML for notebooks; data for a script of a page."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

UNSAFE_IN_SCRIPT = "<>&\u2028\u2029"
"""Characters that can end or change a script element, or a line of it, wherever they are."""


def as_text(rows: Sequence[Sequence[str]], left: Collection[int] | None = None) -> list[str]:
    """The rows as lines of text in columns.

    Args:
      rows: cells, the same number in each row; the first row is the heading.
      left: indices of the columns that are aligned left; the others are aligned right. None aligns
        all of them left.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]

    def cell(i: int, text: str) -> str:
        if left is None or i in left:
            return text.ljust(widths[i])
        return text.rjust(widths[i])

    return ["  ".join(cell(i, text) for i, text in enumerate(row)).rstrip() for row in rows]


def as_html(
    heading: Sequence[str], rows: Iterable[Sequence[str]], bold: Collection[int] = ()
) -> str:
    """The rows as an HTML table.

    Args:
      heading: names of the columns.
      rows: cells.
      bold: indices of the rows in bold type.
    """
    head = "".join(f"<th>{html.escape(x)}</th>" for x in heading)
    body = []
    for i, row in enumerate(rows):
        weight = ' style="font-weight:bold"' if i in bold else ""
        body.append(
            f"<tr{weight}>"
            + "".join(f'<td style="text-align:left">{html.escape(x)}</td>' for x in row)
            + "</tr>"
        )
    return f"<table><tr>{head}</tr>{''.join(body)}</table>"


def number(value: Any) -> str:
    """A number in four significant digits; a dash for NaN and infinity (no event)."""
    value = float(value)
    if not math.isfinite(value):
        return "-"
    return f"{value:.4g}"


class Table(NamedTuple):
    """A table of a result."""

    heading: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    """Printed above it, after an empty line; a table without one follows the line before it."""
    notes: Sequence[str] = ()
    """Lines below it."""
    left: Collection[int] | None = None
    """As in `as_text`."""
    bold: Collection[int] = ()
    """As in `as_html`."""

    def lines(self) -> list[str]:
        """Title, columns and notes as lines of text."""
        head = ["", self.title] if self.title else []
        return [*head, *as_text([self.heading, *self.rows], self.left), *self.notes]

    def html(self) -> str:
        """Columns and notes as HTML."""
        notes = "".join(f"<p>{html.escape(note)}</p>" for note in self.notes)
        return as_html(self.heading, self.rows, self.bold) + notes


def for_json(value: object) -> Any:
    """A value for strict JSON: arrays as lists, NumPy numbers as Python's, and None for a number
    that is not finite.
    """
    if isinstance(value, Mapping):
        return {str(key): for_json(x) for key, x in value.items()}
    if isinstance(value, str | bool | int) or value is None:
        return value
    if isinstance(value, list | tuple):
        return [for_json(x) for x in value]
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        return value
    return for_json(np.asarray(value).tolist())


def as_script_data(value: object) -> str:
    r"""A value as JSON for a script element of an HTML page, whatever its strings hold.

    A browser looks for "</script" and "<!--" before it reads the script, inside strings too.  So
    their characters are escaped; JSON.parse and JavaScript read the escaped text as the same value.

    Args:
      value: numbers, strings, lists and dicts.

    Returns:
      JSON in ASCII, with each of `UNSAFE_IN_SCRIPT` written as \uXXXX.

    Raises:
      ValueError: the value holds a NaN or an infinity, which JSON cannot represent.

    Source: the HTML standard, section 4.12.1.3 (restrictions for contents of script elements).
    """
    text = json.dumps(value, allow_nan=False)
    for character in UNSAFE_IN_SCRIPT:
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text
