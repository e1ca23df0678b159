"""The six figures of the paper and related ones, for a run or a dict of runs by name.

A figure against time has one row per panel; a second column magnifies the start of the run, so
that the magnification covers no curve.  Its titles state why it ends where it does, and the range
of the signal after it.  The user's panels, `ax=`, have no such column: they show the whole run, or
its start if `zoom` is given.

Source: Zhang & Yan 2024, figures 1 to 6.
"""

from __future__ import annotations

import dataclasses
import string
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.control.controllers.adaptive_parameters import THETA
from iblf_jax.core import checks
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import (
    POINTS,
    Curve,
    adapting_law,
    check_joint,
    curves_of,
    distinct,
    escaped,
)
from iblf_jax.plotting._panels import (
    QUANTITIES,
    PanelQuantity,
    Window,
    disturbance_quantity,
    level_quantity,
    quantity_of,
    range_after,
    run_style,
    show,
    transient_end,
)
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world import plants
from iblf_jax.world.regions import in_words

Runs = Rollout | Mapping[str, Rollout]

ZOOM_SHARE = 0.1
"""Share of the time that the zoom shows by default for runs without a transient."""
MIN_ZOOMED = 0.01
MAX_ZOOMED = 0.3
"""Smallest and largest share of the time that the zoom shows by default."""
TRANSIENTS = 2.5
"""Length of the zoom in transients, by default."""
COLUMNS = (2.1, 1.0)
"""Widths of the columns of the full time and of the zoom."""
TITLE_HEIGHT = 0.15
"""Height of the title of a zoom [in]."""


class PanelRow(NamedTuple):
    """One row of a figure: a quantity of a joint, and the label of the axis."""

    quantity: PanelQuantity
    joint: int
    label: str


def windows(
    curves: Sequence[Curve],
    rows: Sequence[PanelRow],
    zoom: float | None,
    transients: float = TRANSIENTS,
) -> tuple[Window, Window]:
    """The windows of the full time and of the zoom.

    Args:
      curves: the runs.
      rows: the quantities whose transients the zoom shows.
      zoom: end of the zoom [s]; if not given, a round number near the end of the transient times
        `transients`.
      transients: see `zoom`.

    Raises:
      ValueError: the zoom is not a positive number.
    """
    end = max(float(np.asarray(curve.run.t)[-1]) for curve in curves) or 1e-3
    if zoom is None:
        transient = _transient_of(curves, rows)
        zoom = ZOOM_SHARE * end
        if transient != 0:
            exact = min(max(transients * transient, MIN_ZOOMED * end), MAX_ZOOMED * end)
            zoom = float(f"{exact:.0e}")
            if zoom < transient <= exact:
                zoom = float(f"{exact:.1e}")
    return (0.0, end), (0.0, min(checks.positive_number("zoom", zoom, "s"), end))


def _transient_of(curves: Sequence[Curve], rows: Sequence[PanelRow]) -> float:
    """The end of the longest transient of some rows [s]."""
    return max(transient_end(curves, row.quantity, row.joint) for row in rows)


def zoom_reason(curves: Sequence[Curve], rows: Sequence[PanelRow], zoom: float) -> str:
    """The reason for which a window that ends at `zoom` [s] shows the start of some runs."""
    window = f"first {zoom:.3g} s"
    if all(curve.failed for curve in curves):
        return f"{window}: the start (every run failed)"
    others = ""
    if any(curve.failed for curve in curves):
        others = " (failed runs aside)"
    transient = _transient_of(curves, rows)
    if transient == 0.0:
        return f"{window}: the start; no transient{others}"
    if transient > zoom:
        return f"{window} of a transient of {transient:.3g} s{others}"
    return f"{window}: the transient{others}"


@_style.styled()
def _rows_with_zoom(
    title: str,
    curves: Sequence[Curve],
    rows: Sequence[PanelRow],
    zoom: float | None,
    height: float,
    *,
    transients: float = TRANSIENTS,
    columns: tuple[float, float] = COLUMNS,
    notes: Sequence[str] = (),
) -> Figure:
    """A figure of rows against time, with the start magnified in a second column."""
    full, start = windows(curves, rows, zoom, transients)
    given = _style.given_panels(len(rows))
    if given is not None:
        for axes, row in zip(given, rows, strict=True):
            show(axes, curves, row.quantity, row.joint, full if zoom is None else start)
            axes.set_ylabel(row.label)
        _style.time_axis(given[-1])
        figure = cast(Figure, given[0].figure)
        _style.set_title(figure, title, curves, notes=notes)
        _style.legend_below(figure)
        return figure
    figure = _style.new_figure(_style.WIDTH, 1.0 + (height + TITLE_HEIGHT) * len(rows))
    table = figure.subplots(len(rows), 2, sharex="col", squeeze=False, width_ratios=columns)
    for (main, inset), row in zip(table, rows, strict=True):
        show(main, curves, row.quantity, row.joint, full)
        show(inset, curves, row.quantity, row.joint, start, tight=True)
        main.set_ylabel(row.label)
        # A box in the main panel around the part that the inset shows.
        left, right = inset.get_xlim()
        low = max(inset.get_ylim()[0], main.get_ylim()[0])
        high = min(inset.get_ylim()[1], main.get_ylim()[1])
        colour = _style.blend(0.667)
        box = (left, low, right - left, high - low)
        main.indicate_inset(box, edgecolor=colour, alpha=1.0, linewidth=0.7)
        inset.spines[["top", "right"]].set_visible(True)
        for spine in inset.spines.values():
            spine.set_color(colour)
        lines = [range_after(curves, row.quantity, row.joint, start[1])]
        if inset is table[0, 1]:
            lines.insert(0, zoom_reason(curves, rows, start[1]))
        if _style.in_paper():
            continue
        inset.set_title(",\n".join(filter(None, lines)), fontsize=_style.size(8.0))
    for axes in table[-1]:
        _style.time_axis(axes)
    figure.align_ylabels(table[:, 0])
    _style.set_title(figure, title, curves, notes=notes)
    _style.legend_below(figure)
    return figure


def _every_joint(title: str, runs: Runs, field: str, zoom: float | None) -> Figure:
    """A figure with one row per joint."""
    curves = curves_of(runs)
    scenario = curves[0].run.scenario
    quantities = [quantity_of(scenario, field, joint) for joint in range(curves[0].run.n)]
    names = [curves[0].joint_label(joint) for joint in range(curves[0].run.n)]
    return _named_rows(title, curves, quantities, names, zoom)


def _named_rows(
    title: str,
    curves: Sequence[Curve],
    quantities: Sequence[PanelQuantity],
    names: Sequence[str],
    zoom: float | None,
    entries: Sequence[int] | None = None,
) -> Figure:
    """A figure with one row per entry of a signal, each with its quantity and its name; `entries`
    are the indices of the entries, 0, 1, ... if not given.
    """
    rows = []
    if entries is None:
        entries = range(len(names))
    for entry, quantity, name in zip(entries, quantities, names, strict=True):
        unit = _style.label(quantity.symbol, quantity.unit)
        rows.append(PanelRow(quantity, entry, f"{name}\n{unit}"))
    height = 1.75
    if len(rows) > 3:
        height = 1.25
    return _rows_with_zoom(title, curves, rows, zoom, height)


@_style.figure_function
def tube(scenario: Scenario, *, duration: float = 20.0) -> Figure:
    """Bounds, reference and initial position of every joint of a scenario.

    Args:
      scenario: one scenario.
      duration: time that the figure shows [s].

    Returns:
      The figure, one row per joint.

    Raises:
      ValueError: not one Scenario, or a duration that is not a positive number.
    """
    if not isinstance(scenario, Scenario) or scenario.initial.q.ndim != 1:
        remedy = "Make one with ij.presets or ij.Scenario."
        raise checks.fail("scenario", type(scenario).__name__, "one Scenario", remedy)
    t = np.linspace(0.0, checks.positive_number("duration", duration, "s"), POINTS)
    tube = jax.vmap(scenario.context.tube)(jnp.asarray(t, scenario.initial.q.dtype))
    figure, panels = _style.panels(7.2, 0.6 + 1.4 * scenario.n, scenario.n)
    names = plants.component_names(scenario.plant)
    start: dict[str, Any] = {
        "color": _style.colour(0),
        "clip_on": False,
        "zorder": 5,
        "label": "start",
    }
    for i, (axes, name) in enumerate(zip(panels, names, strict=True)):
        lower, upper = tube.lower[:, i], tube.upper[:, i]
        axes.fill_between(t, lower, upper, color=_style.tube(), linewidth=0, zorder=0)
        for side, text in ((lower, "bounds"), (upper, "_")):
            axes.plot(t, side, color=_style.bound(), linewidth=1.0, label=text)
        quantity = quantity_of(scenario, "q", i)
        axes.plot(t, tube.q_d[:, i], **_style.reference(), label=quantity.guide_label)
        axes.plot(0.0, scenario.initial.q[i], "o", **start)
        axes.set_ylabel(f"{name}\n{_style.label(quantity.symbol, quantity.unit)}")
        axes.margins(x=0)
    panels[-1].set_xlabel(_style.label("$t$", "s"))
    _style.legend_below(figure, 3, of=[panels[0]])
    return figure


@_style.figure_function
def joint(runs: Runs, joint: int | str = 0, *, zoom: float | None = None) -> Figure:
    """Position of one joint between its bounds, and its error e1 between -k_l and k_u: the paper's
    figures 1 and 2.  A single Axes, `ax=`, shows the position.

    Args:
      runs: one run, or a dict of runs by name.
      joint: which joint, from 0, or its name.
      zoom: length of the magnified start [s]; the transient if not given.

    Returns:
      The figure; a notebook shows it, `save` or its `savefig` writes it.

    Raises:
      ValueError: no run, a batch, no such joint, or a zoom that is not a positive number.
    """
    curves = curves_of(runs)
    joint = check_joint(curves, joint)
    scenario = curves[0].run.scenario
    quantities = [quantity_of(scenario, field, joint) for field in ("q", "e1")]
    rows = [PanelRow(quantity, joint, quantity.label) for quantity in quantities]
    signals = f"{quantities[0].name.capitalize()} and tracking error"
    if _style.count_of_given_panels() == 1:
        rows = rows[:1]
        signals = quantities[0].name.capitalize()
    title = f"{signals} of {curves[0].joint_label(joint)}"
    return _rows_with_zoom(title, curves, rows, zoom, 2.1)


@_style.figure_function
def positions(runs: Runs, *, zoom: float | None = None) -> Figure:
    """Position q [rad] of every joint between its bounds.

    Args:
      runs: one run, or a dict of runs by name.
      zoom: length of the magnified start [s]; the transient if not given.

    Returns:
      The figure, one row per joint.

    Raises:
      ValueError: no run, a batch, or a zoom that is not a positive number.
    """
    return _every_joint(_title_of(runs, "q"), runs, "q", zoom)


@_style.figure_function
def errors(runs: Runs, *, zoom: float | None = None) -> Figure:
    """Relative error xi [1] of every joint between its bounds -1 and 1.

    Args:
      runs: one run, or a dict of runs by name.
      zoom: length of the magnified start [s]; the transient if not given.

    Returns:
      The figure, one row per joint.

    Raises:
      ValueError: no run, a batch, or a zoom that is not a positive number.
    """
    return _every_joint("Error relative to the bounds", runs, "xi", zoom)


@_style.figure_function
def velocity_errors(runs: Runs, *, zoom: float | None = None) -> Figure:
    """Velocity error e2 = q' - alpha [rad/s] of every joint: the paper's figure 3.

    Args:
      runs: one run, or a dict of runs by name.
      zoom: length of the magnified start [s]; the transient if not given.

    Returns:
      The figure, one row per joint.

    Raises:
      ValueError: no run, a batch, or a zoom that is not a positive number.
    """
    return _every_joint(f"{_title_of(runs, 'dq')} error", runs, "e2", zoom)


@_style.figure_function
def velocities(runs: Runs, *, zoom: float | None = None) -> Figure:
    """Velocity q' [rad/s] of every joint, with its bounds if the scenario has them.

    Args:
      runs: one run, or a dict of runs by name.
      zoom: length of the magnified start [s]; the transient if not given.

    Returns:
      The figure, one row per joint.

    Raises:
      ValueError: no run, a batch, or a zoom that is not a positive number.
    """
    return _every_joint(_title_of(runs, "dq"), runs, "dq", zoom)


@_style.figure_function
def region_margins(runs: Runs, *, zoom: float | None = None) -> Figure:
    """Distance [m] of every region's point to the region's boundary, for scenarios with `regions`.

    Args:
      runs: one run, or a dict of runs by name, all with the same number of regions.
      zoom: length of the magnified start [s]; the transient if not given.

    Returns:
      The figure, one row per region.

    Raises:
      ValueError: no run, a batch, runs that differ in the number of regions or have none, or a zoom
        that is not a positive number.
    """
    curves = curves_of(runs)
    counts = [len(curve.run.scenario.regions) for curve in curves]
    if len(set(counts)) > 1 or not counts[0]:
        came = f"runs with {', '.join(map(str, counts))} regions"
        raise checks.fail("runs", came, "runs with the same number of regions, at least one")
    scenario = curves[0].run.scenario
    robot = checks.given(scenario.loop.plant.robot)
    names = [escaped(in_words(region, robot)) for region in scenario.regions]
    quantities = [QUANTITIES["region_margin"]] * len(names)
    return _named_rows("Distance to the boundaries", curves, quantities, names, zoom)


@_style.figure_function
def adaptation(runs: Runs, *, zoom: float | None = None) -> Figure:
    """Every parameter that the law adapts (`controllers.AdaptiveParameters`), between its bounds,
    and the value of the plant.

    Args:
      runs: one run, or a dict of runs by name, all of laws that adapt the same parameters.
      zoom: length of the magnified start [s]; the transient if not given.

    Returns:
      The figure, one row per parameter.

    Raises:
      ValueError: no run, a batch, laws that adapt no parameters or different ones, or a zoom that
        is not a positive number.
    """
    curves = curves_of(runs)
    laws = [adapting_law(curve.run) for curve in curves]
    if len({law.parameters for law in laws}) > 1:
        came = " and ".join(str(law.parameters) for law in laws)
        raise checks.fail("runs", came, "runs of laws that adapt the same parameters")
    units = laws[0].unit_symbols(curves[0].run.scenario.model)[THETA]
    quantities = [dataclasses.replace(QUANTITIES["theta"], unit=unit) for unit in units]
    return _named_rows("Adapting parameters", curves, quantities, laws[0].parameters, zoom)


@_style.figure_function
def uncertain_terms(runs: Runs, *, zoom: float | None = None) -> Figure:
    """The uncertain term f [N m] of every joint and its estimate f_hat: the paper's figure 4; of a
    model in strict-feedback form the disturbance of every level and component.

    Args:
      runs: one run, or a dict of runs by name.
      zoom: length of the magnified start [s]; the transient if not given.

    Returns:
      The figure, one row per joint.

    Raises:
      ValueError: no run, a batch, or a zoom that is not a positive number.
    """
    curves = curves_of(runs)
    if all(curve.run.scenario.loop.model.uncertain_levels for curve in curves):
        return _disturbances(curves, zoom)
    return _every_joint(
        r"Uncertain term $f$ and its estimate $\hat f$", runs, "disturbance_estimate", zoom
    )


def _disturbances(curves: Sequence[Curve], zoom: float | None) -> Figure:
    """The disturbance of every component and its estimate, for the levels that have one in a
    run.
    """
    scenario, n = curves[0].run.scenario, curves[0].run.n
    disturbed = {level for curve in curves for level in curve.disturbed_levels()}
    quantities, names, joints = [], [], []
    for level in sorted(disturbed) or scenario.loop.model.uncertain_levels:
        for joint in range(n):
            quantities.append(disturbance_quantity(scenario, level, joint))
            names.append(curves[0].joint_label(joint))
            joints.append(joint)
    title = "Disturbances of the levels and their estimates"
    return _named_rows(title, curves, quantities, names, zoom, joints)


@_style.figure_function
def levels(runs: Runs, joint: int | str = 0, *, zoom: float | None = None) -> Figure:
    """Every level of one component between its bounds, with the virtual control that it follows,
    and the input.

    Args:
      runs: one run, or a dict of runs by name, of plants with the same number of levels.
      joint: which component, from 0, or its name.
      zoom: length of the magnified start [s]; the transient if not given.

    Returns:
      The figure, one row per level and one for the input.

    Raises:
      ValueError: no run, a batch, plants that differ in their number of levels, no such component,
        or a zoom that is not a positive number.
    """
    curves = curves_of(runs)
    joint = check_joint(curves, joint)
    orders = {curve.name: plants.order_of(curve.run.scenario.plant) for curve in curves}
    if len(set(orders.values())) > 1:
        expected = "runs of plants with the same number of levels"
        raise checks.fail("runs", orders, expected, "Draw them one by one.")
    scenario = curves[0].run.scenario
    order = plants.order_of(scenario.plant)
    quantities = [level_quantity(scenario, level, joint) for level in range(1, order + 1)]
    quantities.append(quantity_of(scenario, "tau", joint))
    rows = [PanelRow(quantity, joint, quantity.label) for quantity in quantities]
    title = f"Levels and input: {curves[0].joint_label(joint)}"
    return _rows_with_zoom(title, curves, rows, zoom, 1.6)


def _title_of(runs: Runs, field: str) -> str:
    """The name of a signal of the plant, as a title."""
    return quantity_of(curves_of(runs)[0].run.scenario, field).name.capitalize()


@_style.figure_function
def torques(runs: Runs, *, zoom: float | None = None) -> Figure:
    """Torque [N m] of every joint: the paper's figure 5.

    Args:
      runs: one run, or a dict of runs by name.
      zoom: length of the magnified start [s]; the transient if not given.

    Returns:
      The figure, one row per joint.

    Raises:
      ValueError: no run, a batch, or a zoom that is not a positive number.
    """
    return _every_joint(_title_of(runs, "tau"), runs, "tau", zoom)


def draw_phase_portrait(axes: Axes, curves: Sequence[Curve], joints: tuple[int, int]) -> None:
    """Draws one joint's position against another's, with reference and starts; limits follow the
    reference and the successful runs.
    """
    shown = []
    positions = [quantity_of(curves[0].run.scenario, "q", joint) for joint in joints]
    for i, curve in enumerate(distinct(curves, ["q_d"], joints)):
        path = curve["q_d"][:, joints]
        style = _style.reference() | {"zorder": 3, "label": positions[0].guide_label}
        if i > 0:
            style |= {"color": _style.colour(curves.index(curve)), "alpha": 0.6}
        axes.plot(*path.T, **style)
        shown.append(path)
    starts = np.stack([curve["q"][0, joints] for curve in curves])
    dots: dict[str, Any] = {"marker": "o", "markersize": 6, "linestyle": "none", "zorder": 4}
    dots |= {"color": _style.text_colour(), "markerfacecolor": _style.background()}
    axes.plot(*starts.T, label="start", **dots)
    for i, curve in enumerate(curves):
        path = curve["q"][:, joints]
        thin = path[:: max(1, len(path) // POINTS)]
        axes.plot(*thin.T, label=curve.name or positions[0].symbol, **run_style(curves, i))
        if curve.failed:
            path = path[:1]
        shown.append(path)
    points = np.concatenate(shown)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        points = np.zeros((1, 2))
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.55 * max(float(np.max(high - low)), 1e-3)
    middle = 0.5 * (low + high)
    for axis, joint, quantity, centre in zip("xy", joints, positions, middle, strict=True):
        name = f"{quantity.name} of {curves[0].joint_label(joint)}"
        text = _style.label(name, quantity.unit)
        axes.set(**{f"{axis}lim": (centre - half, centre + half), f"{axis}label": text})
    axes.set_aspect("equal")


@_style.figure_function
def phase_portrait(runs: Runs, joints: tuple[int | str, int | str] = (0, 1)) -> Figure:
    """Position of one joint against another's, with the reference: the paper's figure 6.

    Args:
      runs: one run, or a dict of runs by name.
      joints: which two joints, each by its index, from 0, or its name.

    Returns:
      The figure.

    Raises:
      ValueError: no run, a batch, or not two joints that the robot has.
    """
    curves = curves_of(runs)
    expected = "two different joints, such as (0, 1)"
    if not isinstance(joints, tuple | list) or len(joints) != 2:
        raise checks.fail("joints", joints, expected)
    first, second = (check_joint(curves, joint, "joints") for joint in joints)
    if first == second:
        raise checks.fail("joints", joints, expected)
    title = curves[0].run.scenario.loop.plant.notation.portrait
    return _portrait(curves, (first, second), title)


@_style.styled()
def _portrait(
    curves: Sequence[Curve],
    joints: tuple[int, int],
    title: str,
    names: tuple[str, str] | None = None,
    notes: Sequence[str] = (),
) -> Figure:
    """The figure of a phase portrait; `names` are those of the axes, if they are not those of the
    joints.
    """
    if curves[0].run.n < 2:
        expected = "runs of at least two joints"
        raise checks.fail("runs", "runs of one joint", expected, "A phase portrait has two axes.")
    figure, (axes,) = _style.panels(4.6, 4.9)
    draw_phase_portrait(axes, curves, joints)
    if names is not None:
        units = [quantity_of(curves[0].run.scenario, "q", joint).unit for joint in joints]
        axes.set_xlabel(_style.label(names[0], units[0]))
        axes.set_ylabel(_style.label(names[1], units[1]))
        axes.get_lines()[0].set_label("reference $x_d$")
    _style.set_title(figure, title, curves, notes=notes)
    _style.legend_below(figure, 4)
    return figure


@_style.figure_function
def velocity_portrait(runs: Runs, joint: int | str = 0) -> Figure:
    """Velocity [rad/s] of one joint against its position [rad], with the reference and the box of
    its bounds.

    For bounds that vary with time, a solid box shows the initial bounds and a dotted box all values
    that they take.

    Args:
      runs: one run, or a dict of runs by name.
      joint: which joint, from 0, or its name.

    Returns:
      The figure.

    Raises:
      ValueError: no run, a batch, or no such joint.
    """
    curves = curves_of(runs)
    joint = check_joint(curves, joint)
    figure, (axes,) = _style.panels(4.9, 4.6)
    for curve in distinct(curves, BOX, [joint]):
        _draw_box(axes, curve, joint)
    for curve in distinct(curves, ["q_d", "dq_d"], [joint]):
        path = (curve["q_d"][:, joint], curve["dq_d"][:, joint])
        axes.plot(*path, **_style.reference(), label="reference")
    for i in sorted(range(len(curves)), key=lambda i: curves[i].diverged):
        curve, style = curves[i], run_style(curves, i)
        if curve.diverged and not curves[0].diverged:
            axes.axis(axes.axis())  # A run that diverged does not set the limits of the others.
        q, dq = curve["q"][:, joint], curve["dq"][:, joint]
        axes.plot(q, dq, label=curve.name or "run", **style)
        axes.plot(q[0], dq[0], marker="o", color=style["color"], linestyle="none", label="_")
    scenario = curves[0].run.scenario
    position, velocity = (quantity_of(scenario, field, joint) for field in ("q", "dq"))
    of_joint = f"{position.name} of {curves[0].joint_label(joint)}"
    axes.set_xlabel(_style.label(of_joint, position.unit))
    axes.set_ylabel(velocity.label)
    title = f"{velocity.name.capitalize()} against {position.name}"
    _style.set_title(figure, title, curves)
    _style.legend_below(figure, 4)
    return figure


BOX = ("lower", "upper", "dq_lower", "dq_upper")
"""The signals that bound position and velocity."""


def _draw_box(axes: Axes, curve: Curve, joint: int) -> None:
    """Draws the initial bounds of one joint's position and velocity as a box, and all values that
    they take as a dotted box if they vary.
    """
    left, right, low, high = (curve[name][:, joint] for name in BOX)
    first = (left[0], right[0], low[0], high[0])
    reached = (left.min(), right.max(), low.min(), high.max())
    boxes = [(first, "-", "bounds")]
    if not np.allclose(first, reached, equal_nan=True):
        boxes.append((reached, ":", "_"))
    for (x0, x1, y0, y1), line, label in boxes:
        style: dict[str, Any] = {"color": _style.bound(), "linewidth": 1.0, "linestyle": line}
        if curve.has_bounds(2):
            axes.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], label=label, **style)
        else:
            axes.axvline(x0, label=label, **style)
            axes.axvline(x1, **style)


def paper_figures(runs: Runs, *, zoom: float | None = None, note: str = "") -> dict[str, Figure]:
    """The figures of the paper by name, "figure_1" to "figure_6", for runs of two joints or more.

    Titles and panels have the paper's names: x_11 is the position of the first joint, e_21 its
    velocity error.

    Args:
      runs: one run, or a dict of runs by name.
      zoom: length of the magnified start [s]; each figure's transient if not given.
      note: a sentence for the title of every figure.

    Returns:
      The figures, ready for `save`.

    Raises:
      ValueError: no run, a batch, or a robot of one joint, which has no phase portrait.
    """
    curves = curves_of(runs)
    n = curves[0].run.n
    e2 = " and ".join(f"$e_{{2{joint + 1}}}$" for joint in range(n))
    notes = [note] if checks.string("note", note, "a sentence") else []
    found = {}
    for joint in range(min(n, 2)):
        number = joint + 1
        caption = f"The trajectories of $x_{{1{number}}}$ and $e_{{1{number}}}$"
        fields = [("q", joint), ("e1", joint)]
        found[number] = _paper_figure(number, caption, curves, fields, zoom, notes)
    for number, caption, field in (
        (3, f"The trajectories of {e2}", "e2"),
        (4, "The uncertain terms", "disturbance_estimate"),
        (5, "The control inputs", "tau"),
    ):
        fields = [(field, joint) for joint in range(n)]
        found[number] = _paper_figure(number, caption, curves, fields, zoom, notes)
    title = "Figure 6. The phase portrait of $x_{11}$ and $x_{12}$"
    found[6] = _portrait(curves, (0, 1), title, ("$x_{11}$", "$x_{12}$"), notes)
    return {f"figure_{number}": figure for number, figure in found.items()}


MAGNIFIED = (3, 5)
"""Numbers of the paper's figures whose transient is a small part of the run: the zoom shows little
more than the transient, in a column as wide as that of the full time."""


def _paper_figure(
    number: int,
    caption: str,
    curves: Sequence[Curve],
    fields: Sequence[tuple[str, int]],
    zoom: float | None,
    notes: Sequence[str],
) -> Figure:
    """A figure of the paper against time: one lettered panel per signal and joint."""
    rows = []
    for letter, (field, joint) in zip(string.ascii_lowercase, fields, strict=False):
        quantity = _paper_quantity(curves[0].run.scenario, field, joint)
        symbol = PAPER_SYMBOLS[field].format(joint + 1)
        rows.append(PanelRow(quantity, joint, _style.label(f"({letter}) {symbol}", quantity.unit)))
    options: dict[str, Any] = {}
    if number in MAGNIFIED:
        options = {"transients": 1.1, "columns": (1.0, 1.0)}
    title = f"Figure {number}. {caption}"
    return _rows_with_zoom(title, curves, rows, zoom, 1.9, notes=notes, **options)


PAPER_SYMBOLS = {
    "q": "$x_{{1{}}}$",
    "e1": "$e_{{1{}}}$",
    "e2": "$e_{{2{}}}$",
    "disturbance_estimate": r"$f_{{s\_un,{}}}$",
    "tau": r"$\tau_{{{}}}$",
}
"""Signal -> its symbol in the paper, for a joint that is counted from 1."""


def _paper_quantity(scenario: Scenario, field: str, joint: int) -> PanelQuantity:
    """The panel of a signal with the symbols of the paper."""
    number = joint + 1
    symbols: dict[str, dict[str, Any]] = {
        "q": {
            "bounds_label": f"$k_{{lc{number}}}$, $k_{{uc{number}}}$",
            "guide_label": f"reference $x_{{d{number}}}$",
            "transient_symbol": PAPER_SYMBOLS["e1"].format(number),
        },
        "e1": {"bounds_label": rf"$-k_{{l\_q{number}}}$, $k_{{u\_q{number}}}$"},
        "e2": {},
        "disturbance_estimate": {
            "symbol": r"$f_{s\_un}$",
            "transient_symbol": r"$f_{s\_un} - \hat f_{s\_un}$",
        },
        "tau": {},
    }
    changed: dict[str, Any] = {"symbol": PAPER_SYMBOLS[field].format(number)} | symbols[field]
    return dataclasses.replace(quantity_of(scenario, field, joint), **changed)


def save(
    figures: Mapping[str, Figure], folder: str | Path, formats: Sequence[str] = ("png", "pdf")
) -> list[Path]:
    """Writes figures as `folder/name.format`; creates the folder if it does not exist.

    Args:
      figures: figures by name, as from `paper_figures`.
      folder: the folder.
      formats: file endings that matplotlib can write.

    Returns:
      The paths of the files.

    Raises:
      ValueError: an unknown format.
    """
    if isinstance(formats, str):
        formats = (formats,)
    for ending in checks.nonempty_list("formats", formats, '("png", "pdf")'):
        checks.one_of("formats", ending, sorted(Figure().canvas.get_supported_filetypes()))
    for name, figure in checks.mapping("figures", figures, '{"overview": run.plot()}').items():
        if not isinstance(figure, Figure):
            raise checks.fail(f"figures[{name!r}]", figure, "a matplotlib Figure")
        checks.file_path("figures: name", name)
    folder = checks.file_path("folder", folder, "a folder")
    if any(part.exists() and not part.is_dir() for part in (folder, *folder.parents)):
        remedy = "It, or a part of it, is a file."
        raise checks.fail("folder", str(folder), "the path of a folder", remedy)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in figures.items():
        engine = figure.get_layout_engine()
        for ending in formats:
            paths.append(folder / f"{name}.{ending}")
            figure.savefig(paths[-1], format=ending)
            figure.set_layout_engine("none")  # Further formats keep the layout of the first.
        figure.set_layout_engine(engine)
    return paths
