"""Tables of words, as text in columns and as HTML for notebooks."""

from __future__ import annotations

import html
from collections.abc import Collection, Iterable, Sequence


def as_text(rows: Sequence[Sequence[str]], left: Collection[int] | None = None) -> list[str]:
    """The rows as lines of text in columns.

    Args:
      rows: cells, as many in each row; the heading is the first.
      left: numbers of the columns that begin at the left, the others end at the right; None for all.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]

    def cell(i: int, text: str) -> str:
        return text.ljust(widths[i]) if left is None or i in left else text.rjust(widths[i])

    return ["  ".join(cell(i, text) for i, text in enumerate(row)).rstrip() for row in rows]


def as_html(heading: Sequence[str], rows: Iterable[Sequence[str]], bold: Collection[int] = ()) -> str:
    """The rows as an HTML table.

    Args:
      heading: what the columns are called.
      rows: cells.
      bold: numbers of the rows that stand out.
    """
    head = "".join(f"<th>{html.escape(x)}</th>" for x in heading)
    body = []
    for i, row in enumerate(rows):
        weight = ' style="font-weight:bold"' if i in bold else ""
        body.append(f"<tr{weight}>" + "".join(f'<td style="text-align:left">{html.escape(x)}</td>' for x in row) + "</tr>")
    return f"<table><tr>{head}</tr>{''.join(body)}</table>"
