"""Texts in place of figures, for readers who do not see them."""

from __future__ import annotations

import re

from matplotlib.axes import Axes
from matplotlib.figure import Figure

LONGEST = 400
"""Largest number of characters of a text; what a screen reader reads without a pause."""


def describe(figure: Figure) -> str:
    """What a figure shows: the quantities of its panels, and the names of its curves."""
    panels = [axes for axes in figure.axes if axes.get_visible() and not _is_colour_bar(axes)]
    heading = _words(figure.get_suptitle())
    texts = list(dict.fromkeys(text for axes in panels if (text := _panel(axes))))
    names = list(dict.fromkeys(name for axes in panels for name in _legend(axes)))
    noun = "Plot" if len(panels) == 1 else f"{len(panels)} plots"
    parts = [f"{noun} of {'; '.join(texts)}" if texts else noun]
    if heading:
        parts.insert(0, heading)
    if names:
        parts.append(f"Legend: {', '.join(names)}")
    return _shortened(". ".join(parts))


def _is_colour_bar(axes: Axes) -> bool:
    return axes.get_label() == "<colorbar>"


def _panel(axes: Axes) -> str:
    """The title of a panel, and its quantities: the vertical one over the horizontal one."""
    title, y, x = (_words(text) for text in (axes.get_title(), axes.get_ylabel(), axes.get_xlabel()))
    quantities = f"{y} over {x}" if x and y else y or x
    return f"{title} ({quantities})" if title and quantities else title or quantities


def _legend(axes: Axes) -> list[str]:
    legend = axes.get_legend()
    return [_words(text.get_text()) for text in legend.get_texts()] if legend else []


def _words(text: str) -> str:
    """A label without the marks of mathematical text, on one line."""
    text = re.sub(r"\\(?:mathrm|text|dot|ddot|hat|tilde|bar|partial)\b\s*", "", text)
    return " ".join(re.sub(r"[$\\{}\[\]|`*<>]", " ", text.replace("[", "(").replace("]", ")")).split())


def _shortened(text: str) -> str:
    """A text that ends after a word, before it is too long."""
    if len(text) <= LONGEST:
        return text
    return text[:LONGEST].rsplit(" ", 1)[0].rstrip(",;") + " and others"
