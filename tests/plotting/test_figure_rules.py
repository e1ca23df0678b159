"""What every figure must state: peaks, zooms, violations, zeros, and margins of the start."""

import dataclasses
import inspect
import re
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
import study_cases as cases
from drawing import drawn
from made_up_runs import chain, made_up, runaway, with_signals
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont
from matplotlib.text import Text
from refused import assert_refused
from stored_results import stored

import iblf_jax as ij
from iblf_jax import Status, plotting
from iblf_jax.plotting import _panels, _scales, _style
from iblf_jax.plotting._curves import curves_of, rounding_error
from iblf_jax.studies.summaries import LEVELS, initial_margins


def texts_of(axes):
    return [text.get_text() for text in axes.texts]


def changed(run, joint, sample, value, field="q", flag=Status.BOUND_VIOLATED):
    values = getattr(run, field).at[sample, joint].set(value)
    return with_signals(run, **{field: values}, status=jnp.int32(int(flag)))


def test_a_clipped_peak_has_its_sign_its_run_and_its_joint():
    calm = made_up(chain(2))
    runs = {"calm": calm, "dipped": changed(calm, 1, 50, -9.0)}
    first, _, second, _ = plotting.positions(runs).axes
    assert texts_of(first) == []
    assert texts_of(second) == ["peak \N{MINUS SIGN}9 rad, dipped, joint 1, t = 0.5 s"]
    for run, texts in ((calm, []), (changed(calm, 1, 3, -4321.5, "tau"), ["4321.5 N m, joint 1"])):
        (axes,) = [axes for axes in run.plot().axes if "torque" in axes.get_ylabel()]
        assert len(texts_of(axes)) == len(texts)
        assert all(x in y for x, y in zip(texts, texts_of(axes), strict=True))
        assert np.ptp(axes.get_ylim()) < 60


def zoom_titles(figure):
    return [axes.get_title().replace("\n", " ") for axes in figure.axes[1::2]]


def test_a_zoom_of_the_transient_says_so_and_bounds_what_follows():
    run = made_up(chain(2), duration=20.0)
    figure = plotting.velocity_errors(run)
    end = figure.axes[1].get_xlim()[1]
    later = np.abs(np.asarray(run.e2))[np.asarray(run.t) > end].max(axis=0)
    titles = zoom_titles(figure)
    assert titles[0].startswith(f"first {end:.3g} s: the transient, then $|e_2| \\leq$ ")
    assert titles[1].startswith("then $|e_2| \\leq$ ")
    for title, largest in zip(titles, later, strict=True):
        stated = float(title.split("\\leq$ ")[1].removesuffix(" rad/s"))
        assert largest <= stated <= 1.1 * largest
    figure = plotting.torques(run)
    later = np.asarray(run.tau)[np.asarray(run.t) > figure.axes[1].get_xlim()[1]]
    for title, torques in zip(zoom_titles(figure), later.T, strict=True):
        assert title.endswith(f"then {torques.min():.3g} to {torques.max():.3g} N m")


def test_a_certificate_until_a_time_says_so():
    certificate = stored("Certificate_0")
    title = certificate.plot(until=0.04).get_suptitle()
    assert "until 0.04 s, as requested; the verdict is that of all 0.1 s" in title
    assert "as requested" not in certificate.plot().get_suptitle()


def middle_share(scale, x):
    low, first, third, high = scale.forward(np.quantile(x, [0.0, 0.25, 0.75, 1.0]))
    return (third - first) / (high - low)


@pytest.mark.parametrize(
    ("x", "name"),
    [
        (np.linspace(0.001, 0.5, 200), "linear"),
        (np.linspace(-1.0, 3.0, 200), "linear"),
        (np.geomspace(1e-3, 1e3, 200), "log"),
        (np.concatenate([np.linspace(0.01, 0.1, 195), np.geomspace(-1e4, -1.0, 5)]), "symlog"),
        (np.full(7, 0.1), "linear"),
        (np.zeros(3), "linear"),
    ],
)
def test_an_axis_shows_all_values_and_squeezes_none(x, name):
    axes = Figure().subplots()
    _scales.follow(axes, "x", np.append(x, np.nan))
    assert axes.get_xscale() == name
    low, high = axes.get_xlim()
    assert low < x.min() and x.max() < high
    if name != "linear":
        scale = _scales.scale_of(x)
        assert middle_share(scale, x) > 2.0 * middle_share(_scales.LINEAR, x)
        np.testing.assert_allclose(scale.inverse(scale.forward(x)), x, rtol=1e-9)


def test_ticks_that_are_updated_once_follow_the_limits_and_change_no_pixel(monkeypatch):
    def pictures():
        figure = _style.new_figure(6.0, 2.5)
        left, right = figure.subplots(1, 2)
        left.plot([0.0, 1.0], [1e-3, 3e4])
        left.set_ylabel("a label that is longer than its panel")
        right.semilogy([0.0, 1.0], [1e-3, 3e4])
        first = figure._repr_png_()
        left.set(xlim=(-9.0, 7e3), ylim=(0.1, 0.2))
        return first, figure._repr_png_()

    kept = pictures()
    monkeypatch.setattr(_style, "TICKS", ())
    assert pictures() == kept


@pytest.fixture(scope="module")
def study():
    return cases.study(64)


def crosses_of(axes):
    """The marks of violations in a panel, by their times."""
    red = to_hex(_style.failure())
    lines = [line for line in axes.get_lines() if line.get_marker() == "x"]
    return [float(line.get_xdata()[0]) for line in lines if to_hex(line.get_color()) == red]


def test_the_joint_that_left_its_bounds_is_marked_and_where_a_run_diverged_every_panel():
    run = changed(made_up(chain(3)), 1, 20, 9.0)
    for make in (plotting.positions, plotting.errors, plotting.torques, plotting.velocities):
        marks = [crosses_of(axes) for axes in make(run).axes]
        assert marks == [[], [], [0.2], [0.2], [], []], make.__name__
    assert [crosses_of(axes) for axes in run.plot().axes[:3]] == [[], [0.2], []]
    run = made_up(chain(2), status=int(Status.NOT_FINITE))
    stopped = {
        name: getattr(run, name).at[100:].set(getattr(run, name)[100]) for name in ("q", "dq")
    }
    run = with_signals(run, **stopped)
    assert [crosses_of(axes) for axes in plotting.torques(run).axes[::2]] == [[1.0], [1.0]]
    # It does not squeeze the velocity portrait.
    good = made_up(chain(2))
    alone, both = map(plotting.velocity_portrait, (good, {"good": good, "bad": runaway(chain(2))}))
    assert both.axes[0].get_ylim() == alone.axes[0].get_ylim()


def noise(run, size):
    return jnp.asarray(size * np.random.default_rng(0).standard_normal(run.q.shape))


@pytest.mark.parametrize("size", [0.0, 1e-17, 1e-6])
def test_a_panel_of_rounding_errors_says_zero(size):
    run = made_up(chain(2))
    run = dataclasses.replace(run, disturbance=0.0 * run.q, disturbance_estimate=noise(run, size))
    for axes in plotting.uncertain_terms(run).axes:
        says_zero = [text for text in texts_of(axes) if text.startswith("zero")]
        largest = np.abs(np.asarray(run.disturbance_estimate)).max()
        is_rounding = largest <= rounding_error(curves_of(run), "disturbance_estimate")
        assert is_rounding == (size < 1e-6) and bool(says_zero) == is_rounding
        if is_rounding:
            assert axes.get_yticks().tolist() == [0.0]
            assert np.ptp(axes.get_ylim()) > 1e6 * largest
            assert ("rounding" in says_zero[0]) == (size > 0.0)


def test_a_constant_has_no_axis_that_magnifies_rounding_errors():
    run = made_up(chain(2))
    run = dataclasses.replace(run, tau=5.0 + noise(run, 1e-15))
    for axes in drawn(plotting.torques(run)).axes:
        assert axes.yaxis.get_offset_text().get_text() == "" and np.ptp(axes.get_ylim()) > 0.1


def with_margins(study, margins):
    metrics = ij.Metrics({"margin": margins}, study.metrics.unit_pairs)
    return dataclasses.replace(study, metrics=metrics)


def test_a_study_says_when_the_start_sets_every_margin(study):
    starts = initial_margins(study.scenario, study.samples)[LEVELS[0]].copy()
    of_start = with_margins(study, starts.copy())
    figure = drawn(plotting.histograms(of_start, ["margin"]))
    assert "says nothing about the law" in figure.get_suptitle().replace("\n", " ")
    assert "that of the start" in figure.axes[0].get_title()
    scatter = plotting.scatter(of_start).get_suptitle().replace("\n", " ")
    assert "The least margin of every run is that of its start (t = 0)" in scatter
    starts[5] -= 1e-6
    assert "law" not in plotting.histograms(with_margins(study, starts), ["margin"]).get_suptitle()


def test_histograms_name_one_margin_for_all_runs_and_peaks_as_sizes(study):
    figure = drawn(plotting.histograms(with_margins(study, np.full((64, 2), 0.1)), ["margin"]))
    assert texts_of(figure.axes[0]) == ["0.1 rad in every run"] and not figure.axes[0].patches
    peaks = np.linspace(1.0, 2.0, 128).reshape(64, 2)
    metrics = ij.Metrics({"peak_torque": peaks}, (("peak_torque", "N m"),))
    figure = plotting.histograms(dataclasses.replace(study, metrics=metrics))
    assert figure.axes[0].get_xlabel() == "peak torque (absolute value) [N m]"


PUBLIC = sorted(
    name
    for name in dir(plotting)
    if inspect.isfunction(getattr(plotting, name))
    and name not in ("animate", "paper_figures", "save")
)
OF_RUNS = {
    *("errors", "joint", "levels", "overview", "phase_portrait", "positions", "torques"),
    *("uncertain_terms", "velocities", "velocity_errors", "velocity_portrait", "workspace"),
}
"""Functions that draw any run."""
OF_SWEEPS = {"heat_map", "parallel"}
OF_STUDIES = {"bands", "histograms", "scatter", "study_overview", "tube"} | OF_SWEEPS
"""Functions that draw a study, a sweep or, one of them, a scenario."""
OF_RESULTS = {
    *("comparison", "failure_probability", "first_exit", "guaranteed_tube", "identification"),
    *("pareto", "tuning"),
}
"""The methods `plot` of results, which `test_results` calls with a figure."""
ELSEWHERE = {"adaptation", "paths", "region_margins"}
"""The tests of adaptive laws, of searches and of regions call them with a figure."""
OF_SEVERAL_KINDS = {"overview", "comparison", "failure_probability", "identification", "tuning"}
"""Figures that refuse `ax=`; the test below and `test_results` call them."""


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(OF_RUNS | OF_STUDIES))
def test_a_figure_is_drawn_into_the_users_figure_and_returned(name, short_run, study):
    """Into a Figure, a SubFigure that leaves the other half alone, and panels of the user."""
    subject = short_run if name in OF_RUNS else study.scenario if name == "tube" else study
    draw = partial(getattr(plotting, name), cases.table() if name in OF_SWEEPS else subject)
    left, right = Figure(figsize=(12.0, 9.0)).subfigures(1, 2)
    assert draw(figure=left) is left
    assert left.axes and not right.axes
    alone = Figure()
    assert draw(figure=alone) is alone and alone.axes
    panels = Figure().subplots(20)
    if name in OF_SEVERAL_KINDS:
        assert_refused("expected figure= in its place", draw, ax=panels)
        return
    with pytest.raises(ValueError, match="ax: got '20 Axes'") as refusal:
        draw(ax=panels)
    chosen = panels[: int(re.search(r"expected (\d+)", str(refusal.value))[1])]
    assert draw(ax=chosen) is chosen
    assert all(axes.has_data() for axes in chosen)
    assert not any(axes.has_data() for axes in panels[len(chosen) :])


def test_every_figure_function_takes_a_style_and_a_figure_and_is_called_with_one():
    assert set(PUBLIC) == OF_RUNS | OF_STUDIES | OF_RESULTS | ELSEWHERE
    for name in PUBLIC:
        parameters = inspect.signature(getattr(plotting, name)).parameters
        assert {"style", "figure", "ax"} <= set(parameters), name
    for options, message in (
        ({"style": "print"}, "style: got 'print'"),
        ({"figure": 3}, "figure: got 3, expected a matplotlib Figure"),
        ({"ax": 3}, "ax: got 3, expected a matplotlib Axes"),
        ({"ax": Figure().subplots(), "figure": Figure()}, "figure, ax: got 'both'"),
    ):
        assert_refused(message, plotting.positions, made_up(chain(1)), **options)
    assert_refused("publisher: got 'acm'", plotting.Paper, "acm")


JOURNALS = {
    "IEEE, one column": ("paper", 3.5, plotting.torques, plotting.overview),
    "Elsevier, two columns": (plotting.Paper("elsevier", 2), 190 / 25.4, plotting.phase_portrait),
}


@pytest.mark.slow
@pytest.mark.parametrize("journal", JOURNALS)
def test_a_figure_for_print_has_the_size_and_the_font_of_the_journal(journal, tmp_path):
    run, (style, width, *figures) = made_up(chain(2)), JOURNALS[journal]
    for number, make in enumerate(figures):
        figure = drawn(make(run, style=style))
        assert figure.get_figwidth() == pytest.approx(width) and figure.get_figheight() <= 9.0
        assert figure._suptitle is None
        texts = [text for text in figure.findobj(Text) if text.get_text() and text.get_visible()]
        assert {text.get_fontsize() for text in texts} == {8.0}
        files = {findfont(text.get_fontproperties()) for text in texts}
        assert all("STIXGeneral" in file for file in files), files
        plotting.save({str(number): figure}, tmp_path, formats=("pdf", "svg"))
        document = (tmp_path / f"{number}.pdf").read_bytes()
        box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ", document)
        assert box is not None and float(box[1]) == pytest.approx(72 * width, abs=0.1)
        assert b"/Type3" not in document  # Publishers ask for TrueType.
        assert "<text" in (tmp_path / f"{number}.svg").read_text()
    assert plotting.torques(run).get_figwidth() == pytest.approx(_style.WIDTH)


def test_a_noise_is_a_band_and_a_motion_is_a_line():
    t = np.linspace(0.0, 1.0, 2001)
    noise = np.random.default_rng(0).normal(0.0, 0.2, t.size)
    assert _panels.noise_band(t, np.sin(9.0 * t)) is None
    assert _panels.noise_band(t, np.sin(9.0 * t) + 1e-3 * noise) is None
    times, low, high, mean = _panels.noise_band(t, np.sin(9.0 * t) + noise)
    assert times[0] < 0.02 and times[-1] > 0.98
    assert np.all((low < mean) & (mean < high))
    np.testing.assert_allclose(mean, np.sin(9.0 * times), atol=0.2)
    held = np.repeat(noise[:1001], 2)[: t.size]  # a noise that a sampled law holds
    assert _panels.noise_band(t, held) is not None
    fine = np.linspace(0.0, 1.0, 4 * (t.size - 1) + 1)
    smooth = np.interp(fine, t, noise)  # four steps in one direction a sample
    assert _panels.noise_band(fine, smooth) is not None
    assert _panels.noise_band(t, np.sin(400.0 * t) * np.sin(9.0 * t)) is None
