"""Texts in place of figures, for readers who do not see them."""

from __future__ import annotations

import re
from collections.abc import Iterable

from matplotlib.axes import Axes
from matplotlib.figure import Figure

LONGEST = 400
"""Largest number of characters of a text, which a screen reader reads in one piece."""


def describe(figure: Figure) -> str:
    """What a figure shows: the quantities of its panels, the names of its curves, and what its
    colours mean.
    """
    bars = [axes for axes in figure.axes if axes.get_label() == "<colorbar>"]
    panels = [axes for axes in figure.axes if axes.get_visible() and axes not in bars]
    texts = _different(_panel(axes) for axes in panels)
    names = _different(name for axes in panels for name in _legend(axes))
    colours = _different(_words(axes.get_ylabel() or axes.get_xlabel()) for axes in bars)
    noun = "Plot" if len(panels) == 1 else f"{len(panels)} plots"
    parts = [_words(figure.get_suptitle()), f"{noun} of {'; '.join(texts)}" if texts else noun]
    parts += [f"Legend: {', '.join(names)}"] if names else []
    parts += [f"Colours: {', '.join(colours)}"] if colours else []
    return _shortened(". ".join(part for part in parts if part))


def _different(texts: Iterable[str]) -> list[str]:
    """The texts that are not empty, each once."""
    return list(dict.fromkeys(text for text in texts if text))


def _panel(axes: Axes) -> str:
    """The title of a panel, and its quantities: the vertical one over the horizontal one."""
    title, x, y = map(_words, (axes.get_title(), axes.get_xlabel(), axes.get_ylabel()))
    quantities = f"{y} over {x}" if x and y else y
    if title and quantities:
        return f"{title} ({quantities})"
    return title or quantities or _categories(axes)


def _categories(axes: Axes) -> str:
    """The names at the ticks of a panel without titles, "" if these are numbers."""
    names = [_words(tick.get_text()) for tick in axes.get_xticklabels()]
    return ", ".join(name for name in names if re.search("[A-Za-z]{2}", name))


def _legend(axes: Axes) -> list[str]:
    legend = axes.get_legend()
    return [_words(text.get_text()) for text in legend.get_texts()] if legend else []


def _words(text: str) -> str:
    """A label on one line, without the marks of mathematical text and of Markdown."""
    text = re.sub(r"\\(hat|tilde|bar)\s*\{?(\w)\}?", r"\2_\1", text)
    text = re.sub(r"\\dot\{?(\w)\}?", r"\1'", text)
    text = re.sub(r"\\ddot\{?(\w)\}?", r"\1''", text)
    text = re.sub(r"\\(?:mathrm|text|partial)\b\s*", "", text).strip()
    text = re.sub(r",?\n", ", ", text)
    text = re.sub(r"\\(?:leq|le)\b|<=", " at most ", text)
    text = re.sub(r"\\(?:geq|ge)\b|>=", " at least ", text)
    text = re.sub(r"\|([^|\s][^|]*)\|", r"abs(\1)", text)
    text = text.replace("[", "(").replace("]", ")")
    return " ".join(re.sub(r"[$\\{}|`*<>]", " ", text).split())


def _shortened(text: str) -> str:
    """A text that ends after a word, before it is too long."""
    if len(text) <= LONGEST:
        return text
    return text[:LONGEST].rsplit(" ", 1)[0].rstrip(",;") + " and others"
