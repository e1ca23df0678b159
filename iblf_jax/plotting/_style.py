"""How every figure of this package looks: sizes, colours, line styles, labels with units.

The user's style comes first: whatever of matplotlib's settings (`plt.style.use`, `rcParams`) is not
at its default stays as it is, and what this package chooses for itself follows it: greys lie
between the user's text and background, text keeps its proportion to `font.size`.  Colours are else
Okabe and Ito's (told apart with any colour vision); every colour goes with a line style of its own,
so that a figure also reads in black-and-white print.  The style is put on with a context manager,
never on matplotlib's global settings, and figures are objects of their own, not pyplot's: none
stays open behind a caller's back.
"""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb, to_rgba
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.rcsetup import cycler

from iblf_jax.plotting._curves import Curve

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#6F4E37")
DASHES: tuple[Any, ...] = (
    "-",
    (0, (5, 1.6)),
    (0, (4, 1.2, 1, 1.2)),
    (0, (1.2, 1.2)),
    (0, (7, 1.2, 1, 1.2, 1, 1.2)),
)
FAINT: dict[str, Any] = {"linewidth": 0.8, "alpha": 0.7, "zorder": 1.9}

WIDTH = 7.2
"""Width of a figure, the text width of a page [in]."""
FONT = 9.0
"""Size of the text that every size here is meant for [pt]."""
GROWTH = 0.75
"""With larger text figures grow by this power of it, so that it is larger in them too."""

SIZES = {
    "axes.labelsize": 9.0,
    "axes.titlesize": 9.0,
    "figure.titlesize": 10.0,
    "legend.fontsize": 8.5,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
}
"""Sizes of text that goes with FONT [pt]."""

SETTINGS: dict[str, Any] = {
    "legend.frameon": False,
    "legend.handlelength": 2.8,
    "lines.linewidth": 1.4,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.limits": [-3, 4],
    "axes.prop_cycle": cycler(color=COLOURS),
    "grid.linewidth": 0.5,
    "savefig.dpi": 200,
    "pdf.fonttype": 42,
}
"""What this package sets where the user has not."""

LOOK = (
    "axes",
    "axes3d",
    "figure",
    "font",
    "grid",
    "hatch",
    "image",
    "legend",
    "lines",
    "mathtext",
    "patch",
    "text",
    "xtick",
    "ytick",
)
"""The groups of settings that a figure keeps from when it was made, because matplotlib reads them
again when it draws."""


@contextmanager
def styled() -> Iterator[None]:
    """The context in which a figure of this package is made and saved; also a decorator,
    `@styled()`.
    """
    own, user = SETTINGS | {"font.size": FONT}, [name for name in SETTINGS if _chosen(name)]
    with matplotlib.rc_context({name: value for name, value in own.items() if not _chosen(name)}):  # type: ignore[misc]
        sizes = {name: size(points) for name, points in SIZES.items() if not _chosen(name)}
        panes = {f"axes3d.{axis}axis.panecolor": to_rgba(shade(0.05), 0.5) for axis in "xyz"}
        colours: dict[Any, Any] = {"grid.color": shade(0.114)} | panes
        if _chosen("grid.color") and "axes.grid" not in user:
            colours["grid.alpha"] = (
                0.35  # a colour for the few who ask for a grid; here every panel has one
            )
        with matplotlib.rc_context(
            sizes | {name: value for name, value in colours.items() if not _chosen(name)}
        ):  # type: ignore[operator]
            yield


def _chosen(name: Any) -> bool:
    """Whether the user's setting is not matplotlib's."""
    return matplotlib.rcParams[name] != matplotlib.rcParamsDefault[name]


def size(points: float) -> float:
    """A size of text [pt] that is `points` where text is of size FONT, in proportion to the
    user's.
    """
    return points * matplotlib.rcParams["font.size"] / FONT


class StyledFigure(Figure):
    """A figure that is drawn in the style that it was made in, and that a notebook shows when a
    cell returns it.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._fitted = False
        self._look = {
            name: matplotlib.rcParams[name]
            for name in matplotlib.rcParams
            if name.split(".")[0] in LOOK
        }

    def draw(self, renderer: Any) -> None:
        """As matplotlib's, in the style that the figure was made in."""
        with matplotlib.rc_context(self._look):
            if not self._fitted:
                self._fitted = True
                self._fit_labels(renderer)
            super().draw(renderer)

    def _fit_labels(self, renderer: Any) -> None:
        """Breaks every title and label that is longer than its panel, by the places that the panels
        have without them, then with them.
        """
        engine = self.get_layout_engine()
        labels = [
            (axes, text)
            for axes in self.axes
            for text in (axes.title, axes.xaxis.label, axes.yaxis.label)
            if text.get_text()
        ]
        words = [text.get_text() for _, text in labels]

        def laid_out(counted: bool) -> list[tuple[float, float]]:
            """The length of every label and the room that it has."""
            for _, text in labels:
                text.set_in_layout(counted)
            if engine is not None:
                engine.execute(self)
            found = []
            for axes, text in labels:
                upright, box, extent = (
                    text is axes.yaxis.label,
                    axes.get_window_extent(renderer),
                    text.get_window_extent(renderer),
                )
                found.append((extent.height, box.height) if upright else (extent.width, box.width))
            return found

        if all(length <= room for length, room in laid_out(counted=True)):
            return
        for counted in (False, True, True):
            for (_, text), whole, (length, room) in zip(
                labels, words, laid_out(counted), strict=True
            ):
                if length > room > 0:
                    most = int(max(map(len, text.get_text().split("\n"))) * room / length)
                    text.set_text(
                        "\n".join(wrapped(line, max(6, most)) for line in whole.split("\n"))
                    )

    def savefig(self, *args: Any, **kwargs: Any) -> None:
        """As matplotlib's, in this package's style."""
        with styled():
            super().savefig(*args, **kwargs)

    def _repr_png_(self) -> bytes:
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=120)
        return picture.getvalue()


def new_figure(width: float, height: float) -> StyledFigure:
    """An empty figure whose parts make room for each other; sizes in inches, which grow with text
    larger than FONT, but less.
    """
    growth = max(1.0, size(1.0)) ** GROWTH
    return StyledFigure(figsize=(width * growth, height * growth), layout="constrained")


# ----------------------------------------------------------------------------------------------------------------- colours


def ink() -> str:
    """The colour of text."""
    return to_hex(matplotlib.rcParams["text.color"])


def paper() -> str:
    """The colour behind a panel; white where there is none."""
    for name in ("axes.facecolor", "figure.facecolor"):
        if to_rgba(matplotlib.rcParams[name])[3] > 0:
            return to_hex(matplotlib.rcParams[name])
    return "#ffffff"


def is_light(colour: Any) -> bool:
    """Whether dark marks are seen on this colour better than light ones."""
    red, green, blue = to_rgb(colour)
    return 0.299 * red + 0.587 * green + 0.114 * blue > 0.5


def shade(share: float, of: str | None = None) -> str:
    """Between paper (0) and text, or another colour (1)."""
    (r, g, b), (red, green, blue) = to_rgb(paper()), to_rgb(of or ink())
    return to_hex((r + share * (red - r), g + share * (green - g), b + share * (blue - b)))


def bound() -> str:
    """The colour of bounds, and of all that is there to be compared with."""
    return shade(0.459)


def tube() -> str:
    """The colour between bounds."""
    return shade(0.055)


def alarm() -> str:
    """The colour of what failed."""
    return "#a00000" if is_light(paper()) else "#ff6b60"


def broken() -> str:
    """The colour of where something would be broken."""
    return shade(0.12, alarm())


def reference() -> dict[str, Any]:
    """Look of a reference."""
    return {"color": ink(), "linestyle": (0, (1, 1.6)), "linewidth": 1.1}


def pale() -> dict[str, Any]:
    """Look of a signal that others estimate, drawn under them."""
    return {"color": shade(0.212), "linestyle": "-", "linewidth": 4.0}


def colour(index: int) -> str:
    """Colour of the index-th run, or joint, of a figure: of the user's cycle, if there is one."""
    cycle = matplotlib.rcParams["axes.prop_cycle"].by_key().get("color", COLOURS)
    return to_hex(cycle[index % len(cycle)])


def series(index: int) -> dict[str, Any]:
    """Colour and line style of the index-th run, or joint, of a figure."""
    return {"color": colour(index), "linestyle": DASHES[index % len(DASHES)]}


def colour_map(name: str) -> str:
    """The user's colour map, or this one."""
    return matplotlib.rcParams["image.cmap"] if _chosen("image.cmap") else name


# -------------------------------------------------------------------------------------------------------------- words, places


def label(words: str, unit: str) -> str:
    """An axis label: what it is, and its unit in brackets."""
    return f"{words} [{unit}]"


PIECES = re.compile(r"\\.|\$[^$]*\$|(?:[^\s._\]$\\]|\.(?=\d))+[\s._\]]*|[\s._\]]+|[$\\]")
"""What a label may be broken between: escaped characters, formulas, and words with what separates
them from the next."""


def wrapped(words: str, room: int) -> str:
    """A label on lines of about `room` characters; it breaks at spaces, in paths after a dot,
    bracket or underscore, and not in a unit.
    """
    text, unit = re.fullmatch(r"(.*?)( \[[^\[\]]*\])?", words, re.DOTALL).groups("")  # type: ignore[union-attr]
    lines = [""]
    for part in [*PIECES.findall(text), unit]:
        whole = len(part) <= room or part == unit or "$" in part
        for piece in [part] if whole else [part[i : i + room] for i in range(0, len(part), room)]:
            if lines[-1].strip() and len((lines[-1] + piece).rstrip()) > room:
                lines.append("")
            lines[-1] += piece
    return "\n".join(line.strip() for line in lines)


def entitle(figure: Figure, words: str, curves: Sequence[Curve], *, always: bool = False) -> None:
    """The title of a figure, with the status of every run that has a flag (of every run with
    `always`), once for runs that share it.
    """
    named: dict[str, list[str]] = {}
    for curve in curves:
        if always or not curve.ok:
            named.setdefault(curve.status, []).append(curve.name or "status")
    verdicts = [f"{', '.join(names)}: {status}" for status, names in named.items()]
    failed = any(curve.failed for curve in curves)
    head(figure, [words, *verdicts], color=alarm() if failed else ink())


def head(figure: Figure, lines: Sequence[str], **options: Any) -> None:
    """The title of a figure, line by line, each broken where it is too long."""
    room = int(12 * figure.get_figwidth() * 9.0 / size(9.0))
    figure.suptitle(
        "\n".join(part for line in lines for part in textwrap.wrap(line, room) or [""]), **options
    )


def legend_below(figure: Figure, columns: int = 5, of: Sequence[Axes] | None = None) -> None:
    """One legend for the whole figure (or for these panels) under it, each label once, in as many
    columns as there is room for.
    """
    entries: dict[str, Any] = {}
    for axes in figure.axes if of is None else of:
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(text, handle)
    if entries:
        room = figure.get_figwidth() * 72 / (size(8.5) * (4.5 + 0.56 * max(map(len, entries))))
        rows = math.ceil(len(entries) / max(1, min(columns, int(room))))
        figure.legend(
            list(entries.values()),
            list(entries),
            loc="outside lower center",
            ncols=math.ceil(len(entries) / rows),
        )


def spread(
    figure: Figure, count: int, most: int, where: SubplotSpec | None = None, **options: Any
) -> list[list[Axes]]:
    """Panels in rows of at most `most`, as many in one row as in another (one more or less), each
    row over the whole width.

    Args:
      figure: where they are made.
      count: how many panels.
      most: side by side at most.
      where: the part of the figure; all of it if not given.
      options: of the panels.

    Returns:
      The panels, row by row.
    """
    sizes = row_sizes(count, most)
    grid = figure.add_gridspec(len(sizes), 1) if where is None else where.subgridspec(len(sizes), 1)
    rows = []
    for r, k in enumerate(sizes):
        places = grid[r].subgridspec(
            1, k
        )  # of its own: columns that all rows share would be too narrow for their labels
        rows.append([figure.add_subplot(places[c], **options) for c in range(k)])
    return rows


def row_sizes(count: int, most: int) -> list[int]:
    """How many of `count` panels go into each row, at most `most`; the fuller rows first."""
    rows = -(-count // most)
    return [count // rows + (r < count % rows) for r in range(rows)]
