"""How every figure of this package looks: sizes, colours, line styles, labels with units.

Colours are Okabe and Ito's (told apart with any colour vision); every colour goes with a line style of its own, so that a
figure also reads in black-and-white print.  The style is put on with a context manager, never on matplotlib's global
settings, and figures are objects of their own, not pyplot's: none stays open behind a caller's back.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from iblf_jax.plotting._curves import Curve

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#6F4E37")
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.6)), (0, (4, 1.2, 1, 1.2)), (0, (1.2, 1.2)), (0, (7, 1.2, 1, 1.2, 1, 1.2)))
REFERENCE: dict[str, Any] = {"color": "black", "linestyle": (0, (1, 1.6)), "linewidth": 1.1}
PALE: dict[str, Any] = {"color": "#c9c9c9", "linestyle": "-", "linewidth": 4.0}
BOUND = "#8a8a8a"
TUBE = "#f1f1f1"
FAINT: dict[str, Any] = {"linewidth": 0.8, "alpha": 0.7, "zorder": 1.9}
ALARM = "#a00000"

WIDTH = 7.2
"""Width of a figure, the text width of a page [in]."""

SETTINGS: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.labelsize": 9.0,
    "axes.titlesize": 9.0,
    "figure.titlesize": 10.0,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "legend.handlelength": 2.8,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "lines.linewidth": 1.4,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.limits": (-3, 4),
    "grid.color": "#e2e2e2",
    "grid.linewidth": 0.5,
    "figure.facecolor": "white",
    "savefig.dpi": 200,
    "pdf.fonttype": 42,
}


@contextmanager
def styled() -> Iterator[None]:
    """The context in which a figure of this package is made and drawn; also a decorator, `@styled()`."""
    with matplotlib.rc_context(SETTINGS):
        yield


class StyledFigure(Figure):
    """A figure that is drawn in this package's style, and that a notebook shows when a cell returns it."""

    def savefig(self, *args: Any, **kwargs: Any) -> None:
        """As matplotlib's, in this package's style."""
        with styled():
            super().savefig(*args, **kwargs)

    def _repr_png_(self) -> bytes:
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=120)
        return picture.getvalue()


def new_figure(width: float, height: float) -> StyledFigure:
    """An empty figure whose parts make room for each other; sizes in inches."""
    return StyledFigure(figsize=(width, height), layout="constrained")


def series(index: int) -> dict[str, Any]:
    """Colour and line style of the index-th run, or joint, of a figure."""
    return {"color": COLOURS[index % len(COLOURS)], "linestyle": DASHES[index % len(DASHES)]}


def label(words: str, unit: str) -> str:
    """An axis label: what it is, and its unit in brackets."""
    return f"{words} [{unit}]"


def entitle(figure: Figure, words: str, curves: Sequence[Curve], *, always: bool = False) -> None:
    """The title of a figure, with the status of every run that has a flag (of every run with `always`)."""
    verdicts = [(f"{curve.name}: " if curve.name else "status: ") + curve.status for curve in curves if always or not curve.ok]
    room = int(12 * figure.get_figwidth())
    lines = [words, *(line for verdict in verdicts for line in textwrap.wrap(verdict, room))]
    failed = any(curve.failed for curve in curves)
    figure.suptitle("\n".join(lines), color=ALARM if failed else "black")


def legend_below(figure: Figure, columns: int = 5) -> None:
    """One legend for the whole figure under it, each label once."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(text, handle)
    if entries:
        rows = math.ceil(len(entries) / columns)
        figure.legend(list(entries.values()), list(entries), loc="outside lower center", ncols=math.ceil(len(entries) / rows))
