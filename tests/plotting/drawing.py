"""What the tests of figures look at."""

import warnings

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D


def drawn(figure: Figure) -> Figure:
    """The figure, after it was drawn; any warning of matplotlib's is an error."""
    with warnings.catch_warnings(action="error"):
        assert len(figure._repr_png_()) > 5000
    return figure


def lines_of(axes: Axes, name: str) -> list[Line2D]:
    """The lines of a panel with a label."""
    return [line for line in axes.get_lines() if line.get_label() == name]
