"""What every figure must state: peaks with their sign and joint, the reason for a zoom, where a
joint left its bounds, that a quantity is zero, that a margin is that of the start.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import types
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
import study_cases as cases
from made_up_runs import chain, made_up, runaway, with_signals
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont
from matplotlib.text import Text
from stored_results import stored

import iblf_jax as ij
from iblf_jax import Status, plotting
from iblf_jax.plotting import _panels, _proofs, _scales, _style, _tuning, certificates
from iblf_jax.plotting._curves import curves_of, rounding_error
from iblf_jax.studies.statistics import scalar_samples
from iblf_jax.studies.summaries import LEVELS, initial_margins


def texts_of(axes):
    return [text.get_text() for text in axes.texts]


def drawn(figure):
    """Draws the figure; any warning of matplotlib's is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure._repr_png_()
    return figure


def changed(run, joint, sample, value, field="q", flag=Status.BOUND_VIOLATED):
    """The run with one sample of one joint changed, and a flag."""
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


def test_a_peak_of_a_region_names_no_joint():
    run = made_up(chain(1))
    margin = jnp.asarray(0.1 + 0.01 * np.sin(np.asarray(run.t)))[:, None]
    run = dataclasses.replace(run, region_margin=jnp.tile(margin, 3).at[50, 2].set(-9.0))
    pair = {"a": run, "b": dataclasses.replace(run, status=jnp.int32(Status.REGION_VIOLATED))}
    regions = [ij.regions.HalfSpace(normal=[1.0, 0.0], offset=1.0)] * 3
    for one in pair.values():
        object.__setattr__(one.scenario, "regions", regions)
    figure = plotting.region_margins(pair)
    assert "joint" not in "".join(text for axes in figure.axes for text in texts_of(axes))


def test_the_bars_of_a_tuning_have_the_signs_of_the_torques():
    run = made_up(chain(2))
    axes = Figure().subplots()
    _tuning._peaks(axes, curves_of({"before": run, "tuned": run}), np.array([40.0, 20.0]))
    heights = [bar.get_height() for bar in axes.patches]
    tau = np.asarray(run.tau)
    expected = [column[np.argmax(np.abs(column))] for column in tau.T]
    assert np.all(np.sign(expected) == -1.0)
    np.testing.assert_allclose(heights, expected * 2)
    assert texts_of(axes) == [f"{x:.3g}".replace("-", "\N{MINUS SIGN}") for x in expected] * 2
    limits = [line.get_ydata()[0] for line in axes.get_lines()[:4]]
    assert limits == [-40.0, 40.0, -20.0, 20.0]


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


def test_other_zooms_have_other_reasons():
    run = made_up(chain(2), duration=20.0)
    assert "first 0.1 s of a transient of " in zoom_titles(plotting.errors(run, zoom=0.1))[0]
    relative = zoom_titles(plotting.errors(run))[0]
    assert re.fullmatch(r".*then \$\|\\xi\| \\leq\$ [\d.e-]+", relative), relative  # without a unit
    still = dataclasses.replace(run, e=0.0 * run.e, xi=0.0 * run.xi)
    assert "no transient" in zoom_titles(plotting.errors(still))[0]
    bad = runaway(chain(2))
    assert "every run failed" in zoom_titles(plotting.positions(bad))[0]
    both = plotting.positions({"good": run, "bad": bad})
    assert "the transient (failed runs aside)" in zoom_titles(both)[0]


@pytest.mark.slow
def test_a_comparison_states_the_reason_for_each_window(paper):
    options = {"duration": 8.0, "dt": 2e-3, "equal_effort": False}
    compared = ij.compare(paper, ["integral", "log"], **options)
    in_print = compared.plot(style="paper").axes[:2]
    assert [axes.get_title() for axes in in_print] == ["gains as given", ""]
    error, torque = compared.plot().axes[:2]
    assert error.get_title().startswith("gains as given\nfirst ")
    assert "the transient" in error.get_title()
    assert torque.get_title().startswith(f"first {torque.get_xlim()[1]:.3g} s: the laws differ")


def test_a_certificate_until_a_time_says_so():
    certificate = stored("Certificate_0")
    title = certificate.plot(until=0.04).get_suptitle()
    assert "until 0.04 s, as requested; the verdict is that of all 0.1 s" in title
    assert "as requested" not in certificate.plot().get_suptitle()


def assert_inside(x, limits):
    assert limits[0] < x.min() and x.max() < limits[1]


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
    assert_inside(x, axes.get_xlim())
    if name != "linear":
        scale = _scales.scale_of(x)
        assert middle_share(scale, x) > 2.0 * middle_share(_scales.LINEAR, x)
        np.testing.assert_allclose(scale.inverse(scale.forward(x)), x, rtol=1e-9)


@pytest.fixture(scope="module")
def study():
    return cases.study(64)


@pytest.mark.slow
def test_a_scatter_shows_every_run(study):
    margins = np.asarray(study.metrics["margin"]).copy()
    margins[3] = -1e4
    far = dataclasses.replace(
        study, metrics=ij.Metrics({"margin": margins}, study.metrics.unit_pairs)
    )
    worst = margins.min(axis=1)
    drawn_numbers = scalar_samples(study.samples).values()
    for axes, x in zip(plotting.scatter(far).axes, drawn_numbers, strict=True):
        assert axes.get_yscale() == "symlog"
        assert_inside(worst, axes.get_ylim())
        assert_inside(x, axes.get_xlim())


def test_a_run_that_diverged_does_not_squeeze_the_velocity_portrait():
    good = made_up(chain(2))
    alone = plotting.velocity_portrait(good).axes[0].get_ylim()
    both = plotting.velocity_portrait({"good": good, "bad": runaway(chain(2))}).axes[0].get_ylim()
    assert both == alone


def crosses_of(axes):
    """The marks of violations in a panel, by their times."""
    red = to_hex(_style.failure())
    lines = [line for line in axes.get_lines() if line.get_marker() == "x"]
    return [float(line.get_xdata()[0]) for line in lines if to_hex(line.get_color()) == red]


def test_only_the_joint_that_left_its_bounds_is_marked():
    run = changed(made_up(chain(3)), 1, 20, 9.0)
    for make in (plotting.positions, plotting.errors, plotting.torques, plotting.velocities):
        marks = [crosses_of(axes) for axes in make(run).axes]
        assert marks == [[], [], [0.2], [0.2], [], []], make.__name__
    assert [crosses_of(axes) for axes in run.plot().axes[:3]] == [[], [0.2], []]


def test_a_velocity_that_left_its_bounds_is_not_marked_among_the_positions():
    run = made_up(chain(2))
    lower, upper = (
        jnp.stack([row, jnp.full_like(row, limit)], axis=1)
        for row, limit in ((run.lower, -3.0), (run.upper, 3.0))
    )
    run = dataclasses.replace(run, level_lower=lower, level_upper=upper)
    run = changed(run, 0, 30, 5.0, "dq", Status.VELOCITY_VIOLATED)
    assert [crosses_of(axes) for axes in plotting.velocities(run).axes[::2]] == [[0.3], []]
    assert not any(crosses_of(axes) for axes in plotting.positions(run).axes)


def test_a_run_that_diverged_inside_its_bounds_is_marked_in_every_panel():
    run = made_up(chain(2), status=int(Status.NOT_FINITE))
    stopped = {
        name: getattr(run, name).at[100:].set(getattr(run, name)[100]) for name in ("q", "dq")
    }
    run = with_signals(run, **stopped)
    assert [crosses_of(axes) for axes in plotting.torques(run).axes[::2]] == [[1.0], [1.0]]


def test_a_refutation_is_red_for_the_joint_that_leaves_its_bounds():
    run = changed(made_up(chain(2)), 1, 20, 9.0)
    state = types.SimpleNamespace(t=0.0)
    found = types.SimpleNamespace(
        replay=lambda: run, violation=types.SimpleNamespace(state=state), duration=4.0
    )
    red = []
    for joint in range(2):
        axes = Figure().subplots()
        _proofs._draw_violation(axes, found, joint)
        red.append(to_hex(axes.get_lines()[0].get_color()) == to_hex(_style.failure()))
    assert red == [False, True]


def noise(run, size=1e-17):
    values = size * np.random.default_rng(0).standard_normal(run.q.shape)
    return jnp.asarray(values)


@pytest.mark.parametrize("size", [0.0, 1e-17, 1e-6])
def test_a_panel_of_rounding_errors_says_zero(size):
    run = made_up(chain(2))
    run = dataclasses.replace(run, disturbance=0.0 * run.q, disturbance_estimate=noise(run, size))
    for axes in plotting.uncertain_terms(run).axes:
        says_zero = [text for text in texts_of(axes) if text.startswith("zero")]
        largest = np.abs(np.asarray(run.disturbance_estimate)).max()
        is_rounding = largest <= rounding_error(curves_of(run), "disturbance_estimate")
        assert is_rounding == (size < 1e-6)
        assert bool(says_zero) == is_rounding
        if is_rounding:
            assert axes.get_yticks().tolist() == [0.0]
            assert np.ptp(axes.get_ylim()) > 1e6 * largest
            assert ("rounding" in says_zero[0]) == (size > 0.0)


@pytest.mark.slow
def test_the_overview_says_zero():
    run = made_up(chain(2))
    still = dataclasses.replace(run, disturbance=0.0 * run.q, disturbance_estimate=noise(run))
    (axes,) = [axes for axes in drawn(still.plot()).axes if "broad" in axes.get_ylabel()]
    assert texts_of(axes)[0].startswith("zero\n($|f| \\leq$ ")
    assert not any("zero" in text for axes in run.plot().axes for text in texts_of(axes))


def test_a_constant_has_no_axis_that_magnifies_rounding_errors():
    run = made_up(chain(2))
    run = dataclasses.replace(run, tau=5.0 + noise(run, 1e-15))
    for axes in drawn(plotting.torques(run)).axes:
        assert axes.yaxis.get_offset_text().get_text() == ""
        assert np.ptp(axes.get_ylim()) > 0.1


T = np.linspace(0.0, 1.0, 50)


def bounded(axes, size):
    signal = certificates.Bounded("estimation error", r"$|\tilde f|$", "N m")
    certificates._draw_bounded(axes, T, np.full(50, size), np.full(50, 2.0), signal)
    assert axes.get_yscale() == ("log" if size == 1e-3 else "linear")


def inequality(axes, size):
    traces = types.SimpleNamespace(t=T, left=np.full(50, -size), V=np.exp(-T))
    certificates._draw_inequality(axes, traces, 0.0 * T, "terms")


def disturbances(axes, size):
    columns = np.stack([np.exp(-T), np.exp(-2.0 * T)], axis=1)[:, :, None]
    traces = types.SimpleNamespace(t=T, d_tilde=np.full((50, 2), size), error=columns)
    certificates._disturbances(axes, traces)


@pytest.mark.parametrize("draw", [bounded, inequality, disturbances])
def test_a_certificate_says_zero(draw):
    for size in (0.0, 1e-17, 1e-3):
        axes = Figure().subplots()
        draw(axes, size)
        assert any(text.startswith("zero") for text in texts_of(axes)) == (size < 1e-3)


def test_a_zoom_of_rounding_errors_has_no_transient():
    run = made_up(chain(2))
    decaying = 1e-15 * np.exp(-5.0 * np.asarray(run.t))[:, None] * np.ones(2)
    run = dataclasses.replace(
        run, disturbance=0.0 * run.q, disturbance_estimate=jnp.asarray(decaying)
    )
    titles = zoom_titles(plotting.uncertain_terms(run))
    assert "no transient, then zero" in titles[0]
    assert titles[1] == "then zero"


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
    assert texts_of(figure.axes[0]) == ["0.1 rad in every run"]
    assert not figure.axes[0].patches
    peaks = np.linspace(1.0, 2.0, 128).reshape(64, 2)
    metrics = ij.Metrics({"peak_torque": peaks}, (("peak_torque", "N m"),))
    figure = plotting.histograms(dataclasses.replace(study, metrics=metrics))
    assert figure.axes[0].get_xlabel() == "peak torque (absolute value) [N m]"


def test_a_tuning_says_when_the_start_sets_its_margin(paper):
    start = float(initial_margins(paper, {})[LEVELS[0]].min())
    for margins, is_start in (([start, np.nan, start], True), ([start, start - 1e-6], False)):
        history = {"margin": np.array(margins)[:, None]}
        result = types.SimpleNamespace(history=history, best_start=0, scenario=paper)
        axes = Figure().subplots()
        _tuning._margin(axes, result)
        assert ("that of the start" in axes.get_title()) == is_start


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
OF_STUDIES = {
    "bands": lambda study, table: (study,),
    "heat_map": lambda study, table: (table,),
    "histograms": lambda study, table: (study,),
    "parallel": lambda study, table: (table,),
    "scatter": lambda study, table: (study,),
    "study_overview": lambda study, table: (study,),
    "tube": lambda study, table: (study.scenario,),
}
"""Functions that draw a study, a sweep or a scenario -> their arguments."""
OF_RESULTS = {
    *("comparison", "failure_probability", "first_exit", "guaranteed_tube", "identification"),
    *("pareto", "tuning"),
}
"""The methods `plot` of results, which `test_results` calls with a figure."""
ELSEWHERE = {"adaptation", "paths", "region_margins"}
"""The tests of adaptive laws, of searches and of regions call them with a figure."""


def test_every_figure_function_is_called_with_a_figure():
    assert set(PUBLIC) == OF_RUNS | set(OF_STUDIES) | OF_RESULTS | ELSEWHERE


@pytest.mark.slow
@pytest.mark.parametrize("name", [*sorted(OF_RUNS), *OF_STUDIES])
def test_a_figure_is_drawn_into_the_users_figure_and_returned(name, short_run, study):
    """Into a Figure, and into a SubFigure that leaves the other half alone."""
    function, arguments = getattr(plotting, name), (short_run,)
    if name in OF_STUDIES:
        arguments = OF_STUDIES[name](study, cases.table())
    whole = Figure(figsize=(12.0, 9.0))
    left, right = whole.subfigures(1, 2)
    assert function(*arguments, figure=left) is left
    assert left.axes and not right.axes
    alone = Figure()
    assert function(*arguments, figure=alone) is alone and alone.axes


def test_a_lyapunov_function_that_is_a_noise_is_a_band():
    run = made_up(chain(2), duration=20.0)
    noise = np.exp(np.random.default_rng(0).normal(0.0, 1.0, len(run.t)))
    for V, is_band in ((run.V, False), (jnp.asarray(noise), True)):
        axes = plotting.overview(with_signals(run, V=V)).axes[-1]
        assert axes.get_ylabel().startswith("Lyapunov function")
        assert bool(axes.collections) is is_band
        if is_band:
            assert len(axes.get_lines()[0].get_xdata()) == _panels.NOISE_BLOCKS
            (band,) = axes.collections
            low, high = np.nanmin(noise), np.nanmax(noise)
            ends = band.get_paths()[0].vertices[:, 1]
            np.testing.assert_allclose([ends.min(), ends.max()], [low, high])


def test_every_figure_function_takes_a_style_and_a_figure():
    for name in PUBLIC:
        parameters = inspect.signature(getattr(plotting, name)).parameters
        assert {"style", "figure"} <= set(parameters), name
    for options, message in (
        ({"style": "print"}, "style: got 'print'"),
        ({"figure": 3}, "figure: got 3, expected a matplotlib Figure"),
    ):
        with pytest.raises(ValueError, match=message):
            plotting.positions(made_up(chain(1)), **options)
    with pytest.raises(ValueError, match="publisher: got 'acm'"):
        plotting.Paper("acm")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("style", "width", "figures"),
    [
        ("paper", 3.5, (plotting.torques, plotting.overview)),
        (plotting.Paper("elsevier", 2), 190 / 25.4, (plotting.phase_portrait,)),
    ],
    ids=["IEEE, one column", "Elsevier, two columns"],
)
def test_a_figure_for_print_has_the_size_and_the_font_of_the_journal(
    style, width, figures, tmp_path
):
    run = made_up(chain(2))
    for number, make in enumerate(figures):
        figure = drawn(make(run, style=style))
        assert figure.get_figwidth() == pytest.approx(width)
        assert figure.get_figheight() <= 9.0
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
