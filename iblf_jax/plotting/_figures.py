"""The six figures of the paper, on any run or any dict of runs by name, for any number of joints.

Every figure against time is a table of panels, one a row, with the start of the run magnified in a
column beside it: an inset of its own that covers no curve.  Source: Zhang & Yan 2024, figures 1 to
  6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.core import checks
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import POINTS, Curve, check_joint, curves_of, distinct, plain
from iblf_jax.plotting._panels import QUANTITIES, Plotted, Window, show, transient_end
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world.regions import in_words
from iblf_jax.world.robots import joint_names

Runs = Rollout | Mapping[str, Rollout]

ZOOM_SHARE = 0.1
"""The part of the time that the zoom shows if the caller does not say and the runs have no
transient."""
MOST_ZOOMED = 0.3
"""The part of the time that it shows at most: more would magnify nothing."""


class PanelRow(NamedTuple):
    """One row of a figure: a quantity of a joint, and the label of its axis."""

    quantity: Plotted
    joint: int
    label: str


def windows(
    curves: Sequence[Curve], rows: Sequence[PanelRow], zoom: float | None
) -> tuple[Window, Window]:
    """The whole time and the zoom's, by default two and a half transients in a round number;
    ValueError if the zoom is no time.
    """
    end = max(float(np.asarray(curve.run.t)[-1]) for curve in curves) or 1e-3
    if zoom is None:
        wanted = 2.5 * max(transient_end(curves, row.quantity, row.joint) for row in rows)
        zoom = (
            float(f"{min(max(wanted, 0.01 * end), MOST_ZOOMED * end):.0e}")
            if wanted
            else ZOOM_SHARE * end
        )
    return (0.0, end), (0.0, min(checks.positive_number("zoom", zoom, "s"), end))


@_style.styled()
def _rows_with_zoom(
    title: str, curves: Sequence[Curve], rows: Sequence[PanelRow], zoom: float | None, height: float
) -> Figure:
    """A figure of rows against time, with the start magnified in a second column."""
    whole, start = windows(curves, rows, zoom)
    figure = _style.new_figure(_style.WIDTH, 1.0 + height * len(rows))
    table = figure.subplots(len(rows), 2, sharex="col", squeeze=False, width_ratios=(2.1, 1))
    for (main, inset), row in zip(table, rows, strict=True):
        show(main, curves, row.quantity, row.joint, whole)
        show(inset, curves, row.quantity, row.joint, start, tight=True)
        main.set_ylabel(row.label)
        _outline(main, inset)
    for axes in table[-1]:
        axes.set_xlabel(_style.label("time $t$", "s"))
    table[0, 1].set_title(f"the first {start[1]:.3g} s, magnified")
    figure.align_ylabels(table[:, 0])
    _style.entitle(figure, title, curves)
    _style.legend_below(figure)
    return figure


def _outline(main: Axes, inset: Axes) -> None:
    """A box in the main panel around what the inset shows."""
    (left, right), (low, high) = inset.get_xlim(), inset.get_ylim()
    floor, ceiling = main.get_ylim()
    low, high = max(low, floor), min(high, ceiling)
    main.indicate_inset(
        (left, low, right - left, high - low),
        edgecolor=_style.shade(0.667),
        alpha=1.0,
        linewidth=0.7,
    )
    inset.spines[["top", "right"]].set_visible(True)
    for spine in inset.spines.values():
        spine.set_color(_style.shade(0.667))


def _every_joint(title: str, runs: Runs, field: str, zoom: float | None) -> Figure:
    """A figure with one row a joint."""
    curves = curves_of(runs)
    n, quantity = curves[0].run.n, QUANTITIES[field]
    rows = [
        PanelRow(
            quantity,
            joint,
            f"{curves[0].called(joint)}\n{_style.label(quantity.symbol, quantity.unit)}",
        )
        for joint in range(n)
    ]
    return _rows_with_zoom(title, curves, rows, zoom, 1.75 if n <= 3 else 1.25)


@_style.styled()
def tube(scenario: Scenario, *, duration: float = 20.0) -> Figure:
    """Reference and start of every joint in its tube, before anything is run.

    Args:
      scenario: one scenario.
      duration: how much of it [s].

    Returns:
      The figure, one row a joint.

    Raises:
      ValueError: something that is no scenario, or a duration that is no time.
    """
    if not isinstance(scenario, Scenario) or scenario.initial.q.ndim != 1:
        raise checks.fail(
            "scenario",
            type(scenario).__name__,
            "one Scenario",
            "Make one with ij.presets or ij.Scenario.",
        )
    t = np.linspace(0.0, checks.positive_number("duration", duration, "s"), POINTS)
    tube = jax.vmap(scenario.context.tube)(jnp.asarray(t, scenario.initial.q.dtype))
    figure = _style.new_figure(7.2, 0.6 + 1.4 * scenario.n)
    panels = figure.subplots(scenario.n, 1, sharex=True, squeeze=False)[:, 0]
    for i, (axes, name) in enumerate(
        zip(panels, joint_names(scenario.plant, scenario.n), strict=True)
    ):
        axes.fill_between(
            t, tube.lower[:, i], tube.upper[:, i], color=_style.tube(), linewidth=0, zorder=0
        )
        for k, side in enumerate((tube.lower, tube.upper)):
            axes.plot(
                t, side[:, i], color=_style.bound(), linewidth=1.0, label="_" if k else "bounds"
            )
        axes.plot(t, tube.q_d[:, i], **_style.reference(), label="reference $q_d$")
        axes.plot(
            0.0,
            scenario.initial.q[i],
            "o",
            color=_style.colour(0),
            clip_on=False,
            zorder=5,
            label="start",
        )
        axes.set_ylabel(f"{name}\n{_style.label('$q$', 'rad')}")
        axes.margins(x=0)
    panels[-1].set_xlabel(_style.label("$t$", "s"))
    _style.legend_below(figure, 3, of=[panels[0]])
    return figure


def joint(runs: Runs, joint: int = 0, *, zoom: float | None = None) -> Figure:
    """Position of one joint in its tube, and its error e1 between -k_l and k_u: the paper's figures
    1 and 2.

    Args:
      runs: one run, or a dict of runs by name.
      joint: which joint, from 0.
      zoom: how much of the start is magnified [s]; the transient if not given.

    Returns:
      The figure; a notebook shows it, `save` or its `savefig` writes it.

    Raises:
      ValueError: no run, a batch, no such joint, or a zoom that is no time.
    """
    curves = curves_of(runs)
    joint = check_joint(curves, joint)
    rows = [
        PanelRow(quantity, joint, quantity.label)
        for quantity in (QUANTITIES["q"], QUANTITIES["e1"])
    ]
    return _rows_with_zoom(
        f"Position and tracking error of {curves[0].called(joint)}", curves, rows, zoom, 2.1
    )


def positions(runs: Runs, *, zoom: float | None = None) -> Figure:
    """Position q [rad] of every joint in its tube.

    Args:
      runs: one run, or a dict of runs by name.
      zoom: how much of the start is magnified [s]; the transient if not given.

    Returns:
      The figure, one row a joint.

    Raises:
      ValueError: no run, a batch, or a zoom that is no time.
    """
    return _every_joint("Position", runs, "q", zoom)


def errors(runs: Runs, *, zoom: float | None = None) -> Figure:
    """Relative error xi [1] of every joint between its walls: how near to its bounds it comes.

    Args:
      runs: one run, or a dict of runs by name.
      zoom: how much of the start is magnified [s]; the transient if not given.

    Returns:
      The figure, one row a joint.

    Raises:
      ValueError: no run, a batch, or a zoom that is no time.
    """
    return _every_joint("Error relative to the bounds", runs, "xi", zoom)


def velocity_errors(runs: Runs, *, zoom: float | None = None) -> Figure:
    """Velocity error e2 = q' - alpha [rad/s] of every joint: the paper's figure 3.

    Args:
      runs: one run, or a dict of runs by name.
      zoom: how much of the start is magnified [s]; the transient if not given.

    Returns:
      The figure, one row a joint.

    Raises:
      ValueError: no run, a batch, or a zoom that is no time.
    """
    return _every_joint("Velocity error", runs, "e2", zoom)


def velocities(runs: Runs, *, zoom: float | None = None) -> Figure:
    """Velocity q' [rad/s] of every joint, in the tube of its bounds where it has some
    (`Scenario.velocity_bounds`).

    Args:
      runs: one run, or a dict of runs by name.
      zoom: how much of the start is magnified [s]; the transient if not given.

    Returns:
      The figure, one row a joint.

    Raises:
      ValueError: no run, a batch, or a zoom that is no time.
    """
    return _every_joint("Velocity", runs, "dq", zoom)


def region_margins(runs: Runs, *, zoom: float | None = None) -> Figure:
    """Distance [m] of every region's point to its wall, at 0, for runs of scenarios with `regions`.

    Args:
      runs: one run, or a dict of runs by name, with as many regions each.
      zoom: how much of the start is magnified [s]; the transient if not given.

    Returns:
      The figure, one row a region.

    Raises:
      ValueError: no run, a batch, runs that differ in the number of regions or have none, or a zoom
        that is no time.
    """
    curves = curves_of(runs)
    counts = [len(curve.run.scenario.regions) for curve in curves]
    if len(set(counts)) > 1 or not counts[0]:
        raise checks.fail(
            "runs",
            f"runs with {', '.join(map(str, counts))} regions",
            "runs with as many regions each, at least one",
        )
    plant, quantity = curves[0].run.scenario.plant, QUANTITIES["region_margin"]
    names = [plain(in_words(region, plant)) for region in curves[0].run.scenario.regions]
    rows = [
        PanelRow(quantity, i, f"{name}\n{_style.label(quantity.symbol, quantity.unit)}")
        for i, name in enumerate(names)
    ]
    return _rows_with_zoom(
        "Distance to the walls", curves, rows, zoom, 1.75 if len(rows) <= 3 else 1.25
    )


def uncertain_terms(runs: Runs, *, zoom: float | None = None) -> Figure:
    """The uncertain term f [N m] of every joint and its estimate f_hat: the paper's figure 4.

    Args:
      runs: one run, or a dict of runs by name.
      zoom: how much of the start is magnified [s]; the transient if not given.

    Returns:
      The figure, one row a joint.

    Raises:
      ValueError: no run, a batch, or a zoom that is no time.
    """
    return _every_joint(
        r"Uncertain term $f$ and its estimate $\hat f$", runs, "disturbance_estimate", zoom
    )


def torques(runs: Runs, *, zoom: float | None = None) -> Figure:
    """Torque [N m] of every joint: the paper's figure 5.

    Args:
      runs: one run, or a dict of runs by name.
      zoom: how much of the start is magnified [s]; the transient if not given.

    Returns:
      The figure, one row a joint.

    Raises:
      ValueError: no run, a batch, or a zoom that is no time.
    """
    return _every_joint("Torque", runs, "tau", zoom)


def draw_phase_portrait(axes: Axes, curves: Sequence[Curve], joints: tuple[int, int]) -> None:
    """Draws one joint's position against another's, with reference and starts; limits follow the
    reference and sound runs.
    """
    frame = []
    for i, curve in enumerate(distinct(curves, ["q_d"], joints)):
        path = curve["q_d"][:, joints]
        own = {"color": _style.series(curves.index(curve))["color"], "alpha": 0.6} if i else {}
        axes.plot(*path.T, **(_style.reference() | {"zorder": 3, "label": "reference $q_d$"} | own))
        frame.append(path)
    starts = np.stack([curve["q"][0, joints] for curve in curves])
    axes.plot(
        *starts.T,
        marker="o",
        color=_style.ink(),
        markerfacecolor=_style.paper(),
        markersize=6,
        linestyle="none",
        zorder=4,
        label="start",
    )
    for i, curve in enumerate(curves):
        path = curve["q"][:, joints]
        look = _style.series(i) | (_style.FAINT if curve.failed and len(curves) > 1 else {})
        axes.plot(*path[:: max(1, len(path) // POINTS)].T, label=curve.name or "$q$", **look)
        frame.append(path[:1] if curve.failed else path)
    points = np.concatenate(frame)
    points = (
        points[np.isfinite(points).all(axis=1)] if np.isfinite(points).any() else np.zeros((1, 2))
    )
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.55 * max(float(np.max(high - low)), 1e-3)
    middle = 0.5 * (low + high)
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
    axes.set_aspect("equal")
    axes.set_xlabel(_style.label(f"position of {curves[0].called(joints[0])}", "rad"))
    axes.set_ylabel(_style.label(f"position of {curves[0].called(joints[1])}", "rad"))


@_style.styled()
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
    pair = (check_joint(curves, joints[0], "joints"), check_joint(curves, joints[1], "joints"))
    if pair[0] == pair[1]:
        raise checks.fail("joints", joints, expected)
    figure = _style.new_figure(4.6, 4.9)
    draw_phase_portrait(figure.subplots(), curves, pair)
    _style.entitle(figure, "Phase portrait of the positions", curves)
    _style.legend_below(figure, 4)
    return figure


@_style.styled()
def velocity_portrait(runs: Runs, joint: int = 0) -> Figure:
    """Velocity [rad/s] of one joint against its position [rad], with the reference, and the box of
    its bounds.

    Bounds that move are a box at the start and one, dotted, around all that they reach.

    Args:
      runs: one run, or a dict of runs by name.
      joint: which joint, from 0.

    Returns:
      The figure.

    Raises:
      ValueError: no run, a batch, or no such joint.
    """
    curves = curves_of(runs)
    joint = check_joint(curves, joint)
    figure = _style.new_figure(4.9, 4.6)
    axes = figure.subplots()
    for i, curve in enumerate(
        distinct(curves, ["lower", "upper", "dq_lower", "dq_upper"], [joint])
    ):
        _box(axes, curve, joint, "bounds" if i == 0 else "_")
    for i, curve in enumerate(distinct(curves, ["q_d", "dq_d"], [joint])):
        axes.plot(
            curve["q_d"][:, joint],
            curve["dq_d"][:, joint],
            **(_style.reference() | {"label": "_" if i else "reference"}),
        )
    for i, curve in enumerate(curves):
        look = _style.series(i) | (_style.FAINT if curve.failed and len(curves) > 1 else {})
        axes.plot(curve["q"][:, joint], curve["dq"][:, joint], label=curve.name or "run", **look)
        axes.plot(
            curve["q"][0, joint],
            curve["dq"][0, joint],
            marker="o",
            color=look["color"],
            linestyle="none",
            label="_",
        )
    axes.set_xlabel(_style.label(f"position of {curves[0].called(joint)}", "rad"))
    axes.set_ylabel(_style.label(r"velocity $\dot q$", "rad/s"))
    _style.entitle(figure, "Velocity against position", curves)
    _style.legend_below(figure, 4)
    return figure


def _box(axes: Axes, curve: Curve, joint: int, label: str) -> None:
    """The bounds of one joint's position and velocity at the start as a box; dotted what they
    reach, if they move.
    """
    left, right, low, high = (
        curve[name][:, joint] for name in ("lower", "upper", "dq_lower", "dq_upper")
    )
    first = (left[0], right[0], low[0], high[0])
    ends = (left.min(), right.max(), low.min(), high.max())
    for (x0, x1, y0, y1), line in (
        (first, "-"),
        *([(ends, ":")] if not np.allclose(first, ends, equal_nan=True) else []),
    ):
        look: dict[str, Any] = {
            "color": _style.bound(),
            "linewidth": 1.0,
            "linestyle": line,
            "label": label if line == "-" else "_",
        }
        if curve.has_speed_limits:
            axes.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], **look)
        else:
            for i, x in enumerate((x0, x1)):
                axes.axvline(x, **(look | ({"label": "_"} if i else {})))


def paper_figures(runs: Runs, *, zoom: float | None = None) -> dict[str, Figure]:
    """The figures of the paper by name, "figure_1" to "figure_6", for runs of two joints or more.

    Args:
      runs: one run, or a dict of runs by name.
      zoom: how much of the start is magnified [s]; each figure's transient if not given.

    Returns:
      The figures, ready for `save`.

    Raises:
      ValueError: no run, a batch, or a robot of one joint, which has no phase portrait.
    """
    return {
        "figure_1": joint(runs, 0, zoom=zoom),
        "figure_2": joint(runs, 1, zoom=zoom),
        "figure_3": velocity_errors(runs, zoom=zoom),
        "figure_4": uncertain_terms(runs, zoom=zoom),
        "figure_5": torques(runs, zoom=zoom),
        "figure_6": phase_portrait(runs),
    }


def save(
    figures: Mapping[str, Figure], folder: str | Path, formats: Sequence[str] = ("png", "pdf")
) -> list[Path]:
    """Writes figures as `folder/name.format`; the folder is made if it is not there.

    Args:
      figures: figures by name, as from `paper_figures`.
      folder: where to.
      formats: file endings that matplotlib can write.

    Returns:
      The paths of the files.

    Raises:
      ValueError: an unknown format.
    """
    formats = (
        (formats,)
        if isinstance(formats, str)
        else tuple(checks.listed("formats", formats, '("png", "pdf")'))
    )
    for ending in formats:
        checks.one_of("formats", ending, sorted(Figure().canvas.get_supported_filetypes()))
    for name, figure in checks.mapping("figures", figures, '{"overview": run.plot()}').items():
        if not isinstance(figure, Figure):
            raise checks.fail(f"figures[{name!r}]", figure, "a matplotlib Figure")
        checks.file_path("figures: name", name)
    folder = checks.file_path("folder", folder, "a folder")
    if any(part.exists() and not part.is_dir() for part in (folder, *folder.parents)):
        raise checks.fail(
            "folder", str(folder), "the path of a folder", "It, or a part of it, is a file."
        )
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in figures.items():
        engine = (
            figure.get_layout_engine()
        )  # set aside after the first format: parts keep the places that it gave them
        for ending in formats:
            paths.append(folder / f"{name}.{ending}")
            figure.savefig(paths[-1], format=ending)
            figure.set_layout_engine("none")
        figure.set_layout_engine(engine)
    return paths
