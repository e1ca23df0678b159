"""The style of all figures: sizes, colours, line styles, labels with units.

The user's style has precedence.  Every matplotlib parameter (`plt.style.use`, `rcParams`) that
differs from its default stays as it is, and the parameters that this package sets follow it: greys
lie between the user's text and background, and text sizes are proportional to `font.size`.  The
default colours are those of Okabe and Ito, which readers with any colour vision can distinguish.
Each colour has its own line style, so that a figure is readable in black-and-white print.  A
context manager applies the style and leaves matplotlib's global parameters unchanged.  Figures are
not registered with pyplot, so none stays open.

`style="paper"` replaces this by what IEEE and Elsevier ask for: the width of a column or of two, a
serif font of 8 pt, and no titles, which the caption of a paper has.  `figure_function` adds this
choice, and that of a figure or of panels to draw into, to every public function.  Title and legend
of runs at equal effort name the laws that have none.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import io
import math
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from types import MappingProxyType
from typing import Any, TypeVar, cast

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.colors import to_hex, to_rgb, to_rgba
from matplotlib.figure import Figure, SubFigure
from matplotlib.gridspec import SubplotSpec
from matplotlib.lines import Line2D
from matplotlib.rcsetup import cycler
from matplotlib.text import Text
from matplotlib.typing import ColorType

from iblf_jax.core import checks
from iblf_jax.plotting._curves import Curve, escaped
from iblf_jax.studies.comparison import RunsAtEqualEffort

F = TypeVar("F", bound=Callable)

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
"""Font size for which all sizes in this module are chosen [pt]."""
SIZE_EXPONENT = 0.75
"""Exponent with which figures grow with the font size."""

SIZES = {
    "axes.labelsize": 9.0,
    "axes.titlesize": 9.0,
    "figure.titlesize": 10.0,
    "legend.fontsize": 8.5,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
}
"""Text sizes for a font of size FONT [pt]."""

DEFAULTS: dict[str, Any] = {
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
"""Parameters that this package sets unless the user has set them."""

STYLE_GROUPS = (
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
"""Groups of parameters that a figure keeps from its creation, because matplotlib reads them again
when it draws."""


@dataclasses.dataclass(frozen=True)
class Paper:
    """The style of a figure for print; style="paper" is one column of IEEE.

    Args:
      publisher: "ieee" or "elsevier", which have columns of 3.5 and 3.543 in (90 mm).
      columns: 1, or 2 for the width of the page, 7.16 and 7.48 in (190 mm).

    Source: IEEE Author Center, Resolution and size; Elsevier, Artwork and media instructions.
    """

    publisher: str = "ieee"
    columns: int = 1

    def __post_init__(self) -> None:
        checks.one_of("publisher", self.publisher, ("ieee", "elsevier"))
        checks.positive_integer("columns", self.columns, most=2)

    @property
    def width(self) -> float:
        """[in]."""
        return PAPER_WIDTHS[self.publisher, self.columns]


PAPER_WIDTHS = {
    ("ieee", 1): 3.5,
    ("ieee", 2): 7.16,
    ("elsevier", 1): 90 / 25.4,
    ("elsevier", 2): 190 / 25.4,
}
"""Publisher and number of columns -> width [in]."""
PAPER_HEIGHT = 9.0
"""Largest height, that of a page with a caption [in]."""
PAPER_FONT = 8.0
"""[pt]."""
PAPER_DEFAULTS: dict[str, Any] = DEFAULTS | {
    "font.family": ["STIXGeneral"],
    "font.size": PAPER_FONT,
    "mathtext.fontset": "stix",
    "lines.linewidth": 1.0,
    "svg.fonttype": "none",
    **dict.fromkeys(SIZES, PAPER_FONT),
}
"""Parameters of the style of a paper.  The font, a Times, comes with matplotlib, so that a figure
is the same everywhere; text of an SVG stays text."""

_PAPER: ContextVar[Paper | None] = ContextVar("paper", default=None)
"""The style of the paper in which figures are made now."""
_GIVEN: ContextVar[Figure | SubFigure | list[Axes] | None] = ContextVar("figure", default=None)
"""The figure, or the panels, of the user that the next figure is drawn into."""

_MISSING: ContextVar[Mapping[str, str]] = ContextVar("missing", default=MappingProxyType({}))
"""Law -> why the figure that is made now has no run of it."""


def figure_function(function: F) -> F:
    """Decorator of a public function that returns a figure: adds the arguments style, figure and
    ax.

    style: "paper" or a `Paper` for print; "screen" (the default) otherwise.
    figure: a matplotlib Figure or SubFigure to draw into, which is returned.
    ax: a matplotlib Axes, or one for each panel, to draw into, which is returned.
    """

    @functools.wraps(function)
    def styled_function(
        *args: Any, style: Any = "screen", figure: Any = None, ax: Any = None, **options: Any
    ):
        paper = _checked_style(style)
        given = _checked_place(figure, ax)
        subject = args[0] if args else next(iter(options.values()), None)
        missing = subject.reasons if isinstance(subject, RunsAtEqualEffort) else {}
        tokens = _PAPER.set(paper), _GIVEN.set(given), _MISSING.set(missing)
        try:
            with styled():
                made = function(*args, **options)
            return made if ax is None else ax
        finally:
            _PAPER.reset(tokens[0])
            _GIVEN.reset(tokens[1])
            _MISSING.reset(tokens[2])

    signature = inspect.signature(function)
    keyword = inspect.Parameter.KEYWORD_ONLY
    added = [
        inspect.Parameter("style", keyword, default="screen", annotation="str | Paper"),
        inspect.Parameter("figure", keyword, default=None, annotation="Figure | SubFigure | None"),
        inspect.Parameter("ax", keyword, default=None, annotation="Axes | Sequence[Axes] | None"),
    ]
    parameters = [*signature.parameters.values(), *added]
    styled_function.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=sorted(parameters, key=lambda x: x.kind)
    )
    return cast(F, styled_function)


def _checked_style(style: object) -> Paper | None:
    if isinstance(style, Paper):
        return style
    checks.one_of("style", style, ("screen", "paper"))
    if style == "paper":
        return Paper()
    return None


def _checked_place(figure: Any, ax: Any) -> Figure | SubFigure | list[Axes] | None:
    """What the user gives to draw into."""
    if ax is None:
        if figure is not None and not isinstance(figure, Figure | SubFigure):
            remedy = "Such as plt.figure() or one of figure.subfigures(1, 2)."
            raise checks.fail("figure", figure, "a matplotlib Figure or SubFigure", remedy)
        return figure
    if figure is not None:
        raise checks.fail("figure, ax", "both", "one of them", "Panels belong to their figure.")
    if isinstance(ax, np.ndarray):
        panels = list(ax.flat)
    elif isinstance(ax, list | tuple):
        panels = list(ax)
    else:
        panels = [ax]
    if not panels or not all(isinstance(axes, Axes) for axes in panels):
        remedy = "Such as the second value of plt.subplots()."
        raise checks.fail("ax", ax, "a matplotlib Axes, or one for each panel", remedy)
    return panels


@contextmanager
def styled(paper: Paper | None = None) -> Iterator[None]:
    """The context in which figures are made and saved; also a decorator, `@styled()`.

    Args:
      paper: the style of a paper; that in which figures are made now if not given.
    """
    if paper is not None or in_paper():
        parameters: dict[Any, Any] = PAPER_DEFAULTS | {"grid.color": blend(0.114)}
        with matplotlib.rc_context(parameters):
            yield
        return
    user_sets_grid = _set_by_user("axes.grid")
    with matplotlib.rc_context(_unset(DEFAULTS | {"font.size": FONT})):
        panes = {f"axes3d.{axis}axis.panecolor": to_rgba(blend(0.05), 0.5) for axis in "xyz"}
        sizes = {name: size(points) for name, points in SIZES.items()}
        derived = sizes | panes | {"grid.color": blend(0.114)}
        if _set_by_user("grid.color") and not user_sets_grid:
            # The user chose the colour for figures that mostly have no grid; here all panels do.
            derived["grid.alpha"] = 0.35
        with matplotlib.rc_context(_unset(derived)):
            yield


def _unset(parameters: dict[str, Any]) -> dict[Any, Any]:
    """The parameters that the user has not set."""
    return {name: value for name, value in parameters.items() if not _set_by_user(name)}


def _set_by_user(name: Any) -> bool:
    return matplotlib.rcParams[name] != matplotlib.rcParamsDefault[name]


def size(points: float) -> float:
    """A text size [pt] that is `points` for a font of size FONT, scaled to the user's font; in a
    paper all text has one size.
    """
    if in_paper():
        return PAPER_FONT
    return points * matplotlib.rcParams["font.size"] / FONT


class StyledFigure(Figure):
    """A figure that keeps the style of its creation, and that a notebook shows as a cell's
    value.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._fitted = False
        self._paper = _PAPER.get()
        self._style_of_creation = {
            name: matplotlib.rcParams[name]
            for name in matplotlib.rcParams
            if name.split(".")[0] in STYLE_GROUPS
        }

    def draw(self, renderer: RendererBase) -> None:
        """Draws the figure in the style of its creation."""
        with matplotlib.rc_context(self._style_of_creation), ticks_updated_once(self):
            if not self._fitted:
                self._fitted = True
                self._fit_labels(renderer)
            super().draw(renderer)

    def _fit_labels(self, renderer: RendererBase) -> None:
        """Breaks every title and label that is longer than its panel.

        The first pass lays the panels out without the labels, further ones with the broken labels,
        until no label changes: a layout takes half a second for twelve panels.
        """
        labels = []
        for axes in self.axes:
            for text in (axes.title, axes.xaxis.label, axes.yaxis.label):
                if text.get_text():
                    labels.append((axes, text))
        unbroken = [text.get_text() for _, text in labels]
        if all(length <= room for length, room in self._lengths(labels, renderer, True)):
            return
        for in_layout in (False, True, True):
            lengths = self._lengths(labels, renderer, in_layout)
            before = [text.get_text() for _, text in labels]
            for (_, text), words, (length, room) in zip(labels, unbroken, lengths, strict=True):
                if length > room > 0:
                    longest = max(map(len, text.get_text().split("\n")))
                    most = max(6, int(longest * room / length))
                    text.set_text("\n".join(wrapped(line, most) for line in words.split("\n")))
            if in_layout and before == [text.get_text() for _, text in labels]:
                return

    def _lengths(
        self, labels: list[tuple[Axes, Text]], renderer: RendererBase, in_layout: bool
    ) -> list[tuple[float, float]]:
        """The length of every label and the room that its panel has for it."""
        for _, text in labels:
            text.set_in_layout(in_layout)
        engine = self.get_layout_engine()
        if engine is not None:
            engine.execute(self)
        found = []
        for axes, text in labels:
            box = axes.get_window_extent(renderer)
            extent = text.get_window_extent(renderer)
            if text is axes.yaxis.label:  # It is rotated.
                found.append((extent.height, box.height))
            else:
                found.append((extent.width, box.width))
        return found

    def savefig(self, *args: Any, **kwargs: Any) -> None:
        """Saves the figure in this package's style."""
        with styled(self._paper):
            super().savefig(*args, **kwargs)

    def _repr_png_(self) -> bytes:
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=120)
        return picture.getvalue()


TICKS = ("_update_ticks", "_get_ticklabel_bboxes")
"""Methods of an axis of matplotlib that update its ticks, and measure their labels."""


@contextmanager
def ticks_updated_once(figure: Figure) -> Iterator[None]:
    """Context manager in which the ticks of an axis are updated and measured once for limits and
    place of its panel.

    A layout does so four to eight times between two changes, which takes most of its time.  Nothing
    else that ticks depend on, such as locators and fonts, changes while a figure is drawn.
    """
    panels = [axes for axes in figure.axes if axes.name == "rectilinear"]
    both: list[Any] = [axis for axes in panels for axis in (axes.xaxis, axes.yaxis)]
    replaced = [(axis, name) for axis in both for name in TICKS if hasattr(axis, name)]
    for axis, name in replaced:
        setattr(axis, name, _called_once(axis, getattr(axis, name)))
    try:
        yield
    finally:
        for axis, name in replaced:
            delattr(axis, name)


def _called_once(axis: Any, method: Callable[..., Any]) -> Callable[..., Any]:
    """A method of an axis that is called again only if its arguments, the limits or the place of
    the panel have changed.
    """
    last: Any = None
    found: Any = None

    def called(*args: Any) -> Any:
        nonlocal last, found
        now = (*args, *axis.get_view_interval(), *axis.axes.bbox.bounds)
        if now != last:
            found = method(*args)
            last = now
        return found

    return called


def new_figure(width: float, height: float) -> Any:
    """An empty figure with a constrained layout, or the figure that the user has given.

    Args:
      width, height: size for a font of size FONT [in]; larger fonts enlarge the figure, and a paper
        has a width of its own.
    """
    given = _GIVEN.get()
    if isinstance(given, list):
        expected = "figure= in its place, because this figure arranges panels of several kinds"
        remedy = "Such as plt.figure() or one of figure.subfigures(1, 2)."
        raise checks.fail("ax", given[0], expected, remedy)
    if given is not None:
        parent: Any = given if isinstance(given, Figure) else given.figure
        if parent.get_layout_engine() is None:
            parent.set_layout_engine("constrained")
        return given
    paper = _PAPER.get()
    if paper is not None:
        share = min(1.0, max(paper.width / width, 0.8))
        size_in_paper = (paper.width, min(share * height, PAPER_HEIGHT))
        return StyledFigure(figsize=size_in_paper, layout="constrained")
    growth = max(1.0, size(1.0)) ** SIZE_EXPONENT
    return StyledFigure(figsize=(width * growth, height * growth), layout="constrained")


def count_of_given_panels() -> int:
    """Number of the panels that the user has given as `ax=`."""
    given = _GIVEN.get()
    return len(given) if isinstance(given, list) else 0


def given_panels(count: int, projection: str = "rectilinear") -> list[Axes] | None:
    """The panels that the user has given as `ax=`, if any.

    Args:
      count: how many the figure needs.
      projection: matplotlib's name of their projection.
    """
    given = _GIVEN.get()
    if not isinstance(given, list):
        return None
    if len(given) != count:
        remedy = f"Such as plt.subplots({count})[1]."
        raise checks.fail("ax", f"{len(given)} Axes", f"{count}, one for each panel", remedy)
    for axes in given:
        if axes.name != projection:
            remedy = f'Such as figure.add_subplot(projection="{projection}").'
            raise checks.fail("ax", axes.name, f"an Axes with projection {projection!r}", remedy)
    return given


def panels(
    width: float, height: float, rows: int = 1, projection: str = "rectilinear"
) -> tuple[Any, list[Axes]]:
    """A figure of panels one below the other, or the user's panels and their figure.

    Args:
      width, height: size as of `new_figure`.
      rows: number of panels.
      projection: matplotlib's name of their projection.
    """
    given = given_panels(rows, projection)
    if given is not None:
        return given[0].figure, given
    figure, kind = new_figure(width, height), {"projection": projection}
    return figure, list(figure.subplots(rows, sharex=True, squeeze=False, subplot_kw=kind)[:, 0])


def in_paper() -> bool:
    """Whether the figure that is made now is one of a paper: its caption has what titles say."""
    return _PAPER.get() is not None


def is_narrow() -> bool:
    """Whether the figure that is made now has the width of one column of a paper."""
    paper = _PAPER.get()
    return paper is not None and paper.columns == 1


def width_of(part: Figure | SubFigure | Axes) -> float:
    """The width of a figure, or of a part of one [in]."""
    root: Any = part.figure
    return float(part.bbox.width / root.dpi)


# --- colours


def text_colour() -> str:
    """The colour of text."""
    return to_hex(matplotlib.rcParams["text.color"])


def background() -> str:
    """The colour behind a panel; white where there is none."""
    for name in ("axes.facecolor", "figure.facecolor"):
        if to_rgba(matplotlib.rcParams[name])[3] > 0:
            return to_hex(matplotlib.rcParams[name])
    return "#ffffff"


def is_light(colour: ColorType) -> bool:
    """Whether dark marks contrast with this colour better than light ones."""
    red, green, blue = to_rgb(colour)
    return 0.299 * red + 0.587 * green + 0.114 * blue > 0.5


def blend(share: float, of: str | None = None) -> str:
    """The colour between the background (share 0) and text, or another colour (share 1)."""
    ends = zip(to_rgb(background()), to_rgb(of or text_colour()), strict=True)
    red, green, blue = (low + share * (high - low) for low, high in ends)
    return to_hex((red, green, blue))


def bound() -> str:
    """The colour of bounds and of other lines for comparison."""
    return blend(0.459)


def tube() -> str:
    """The colour between bounds."""
    return blend(0.055)


def failure() -> str:
    """The colour of failures."""
    if is_light(background()):
        return "#a00000"
    return "#ff6b60"


def forbidden() -> str:
    """The colour of the area in which a requirement is violated."""
    return blend(0.12, failure())


def reference() -> dict[str, Any]:
    """The line style of a reference."""
    return {"color": text_colour(), "linestyle": (0, (1, 1.6)), "linewidth": 1.1}


def underlay() -> dict[str, Any]:
    """The line style of a signal that is drawn under its estimates."""
    return {"color": blend(0.212), "linestyle": "-", "linewidth": 4.0}


def colour(index: int) -> str:
    """Colour of the index-th run, or joint, of a figure, from the user's cycle if there is one."""
    cycle = matplotlib.rcParams["axes.prop_cycle"].by_key().get("color", COLOURS)
    return to_hex(cycle[index % len(cycle)])


def series(index: int) -> dict[str, Any]:
    """Colour and line style of the index-th run, or joint, of a figure."""
    return {"color": colour(index), "linestyle": DASHES[index % len(DASHES)]}


def colour_map(name: str) -> str:
    """The user's colour map, or this one if the user has set none."""
    if _set_by_user("image.cmap"):
        return matplotlib.rcParams["image.cmap"]
    return name


# --- labels and layout


def label(name: str, unit: str) -> str:
    """An axis label: the quantity, and its unit in brackets."""
    return f"{name} [{unit}]"


def time_axis(axes: Axes, window: tuple[float, float] | None = None) -> None:
    """Labels the horizontal axis as time, and limits it to a window if one is given."""
    axes.set_xlabel(label("time $t$", "s"))
    if window is not None:
        axes.set_xlim(*window)


PIECES = re.compile(r"\\.|\$[^$]*\$|(?:[^\s._\]$\\]|\.(?=\d))+[\s._\]]*|[\s._\]]+|[$\\]")
"""Pieces between which a label may be broken: escaped characters, formulas, and words with the
separators that follow them."""


def wrapped(label: str, room: int) -> str:
    """A label on lines of about `room` characters; it breaks at spaces, in paths after a dot,
    bracket or underscore, and not in a unit.
    """
    found: Any = re.fullmatch(r"(.*?)( \[[^\[\]]*\])?", label, re.DOTALL)
    text, unit = found.groups("")
    lines = [""]
    for part in [*PIECES.findall(text), unit]:
        pieces = [part]
        if len(part) > room and part != unit and "$" not in part:
            pieces = [part[i : i + room] for i in range(0, len(part), room)]
        for piece in pieces:
            if lines[-1].strip() and len((lines[-1] + piece).rstrip()) > room:
                lines.append("")
            lines[-1] += piece
    return "\n".join(line.strip() for line in lines)


def set_title(
    figure: Figure,
    title: str,
    curves: Sequence[Curve],
    *,
    always: bool = False,
    notes: Sequence[str] = (),
) -> None:
    """Sets the title of a figure, with the status of the runs that have a flag.

    Args:
      figure: the figure.
      title: the first line.
      curves: the runs; those with the same status share a line.
      always: state the status of the other runs too.
      notes: further lines.
    """
    named: dict[str, list[str]] = {}
    for curve in curves:
        if always or not curve.run.ok:
            named.setdefault(curve.status, []).append(curve.name or "status")
    lines = [title, *(f"{', '.join(names)}: {status}" for status, names in named.items())]
    lines += [f"{law}: no run at equal effort; {why}" for law, why in _MISSING.get().items()]
    lines += notes
    colour = text_colour()
    if any(curve.failed for curve in curves):
        colour = failure()
    set_heading(figure, lines, color=colour)


def set_heading(figure: Figure, lines: Sequence[str], **options: Any) -> None:
    """Sets the title of a figure from its lines; lines that are too long are broken.  In a paper
    the caption says it, and over the user's panels it is the title of the first one.
    """
    if in_paper():
        return
    given = _GIVEN.get()
    if isinstance(given, list):
        room = int(12 * width_of(given[0]) * 9.0 / size(9.0))
        given[0].set_title("\n".join(textwrap.fill(line, room) for line in lines), **options)
        return
    room = int(12 * width_of(figure) * 9.0 / size(9.0))
    figure.suptitle("\n".join(textwrap.fill(line, room) for line in lines), **options)


def legend_below(figure: Figure, columns: int = 5, of: Sequence[Axes] | None = None) -> None:
    """Puts one legend under a figure, with each label once; into the first of the user's panels.
    A law without a run at equal effort has an entry without a line.

    Args:
      figure: the figure.
      columns: largest number of columns; there are fewer if the labels are long.
      of: panels whose labels it shows; all panels if not given.
    """
    entries: dict[str, Any] = {}
    given = _GIVEN.get()
    if isinstance(given, list):
        of = given
    for axes in of or figure.axes:
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(text, handle)
    if not entries:
        return
    for law in _MISSING.get():
        entries[f"{escaped(law)}: no factor"] = Line2D([], [], linestyle="none")
    if isinstance(given, list):
        given[0].legend(entries.values(), entries.keys())
        return
    characters = 4.5 + 0.56 * max(map(len, entries))  # line and label, in units of the text size
    room = int(width_of(figure) * 72 / (size(8.5) * characters))
    rows = math.ceil(len(entries) / max(1, min(columns, room)))
    columns = math.ceil(len(entries) / rows)
    handles, labels = list(entries.values()), list(entries)
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)


def name_ticks(axes: Axes, names: Sequence[str], room: int) -> None:
    """Names the horizontal ticks; rotates the names if they need more than `room` characters."""
    style: dict[str, Any] = {}
    if max(map(len, names)) * len(names) > room:
        style = {"rotation": 40, "ha": "right"}
    axes.set_xticks(range(len(names)), names, **style)


def panel_rows(
    figure: Figure, count: int, most: int, where: SubplotSpec | None = None, **options: Any
) -> list[list[Axes]]:
    """Panels in rows of nearly equal length, each row over the full width.

    Args:
      figure: the figure.
      count: number of panels.
      most: largest number of panels in a row.
      where: the part of the figure; all of it if not given.
      options: options of the panels.

    Returns:
      The panels, row by row.
    """
    sizes = row_sizes(count, most)
    grid: Any = (
        figure.add_gridspec(len(sizes), 1) if where is None else where.subgridspec(len(sizes), 1)
    )
    rows = []
    for cell, k in zip(grid, sizes, strict=True):
        # Each row has its own grid: shared columns would be too narrow for the labels.
        row = cell.subgridspec(1, k)
        rows.append([figure.add_subplot(place, **options) for place in row])
    return rows


def row_sizes(count: int, most: int) -> list[int]:
    """Number of panels in each row, at most `most`, in one column of a paper one; the fuller rows
    first.
    """
    if is_narrow():
        most = 1
    rows = math.ceil(count / most)
    size, remainder = divmod(count, rows)
    return [size + 1] * remainder + [size] * (rows - remainder)
