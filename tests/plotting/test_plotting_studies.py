"""Figures of studies and sweeps show what their data hold."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import study_cases as cases

from iblf_jax import Status, plotting


@pytest.fixture(scope="module")
def study():
    return cases.study(512)


@pytest.fixture(scope="module")
def table():
    return cases.table()


def drawn(figure):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(figure._repr_png_()) > 5000
    return figure


@pytest.mark.slow
def test_study_at_a_glance(study):
    figure = drawn(study.plot(runs=256))
    assert len(figure.axes) == 2 + 1 + 3
    assert figure.axes[-1].get_xlabel() == "initial.q[1] [rad]"
    assert "512 runs" in figure.get_suptitle()
    assert f"{len(study.failed)} failed" in figure.get_suptitle()


@pytest.mark.slow
def test_bands_are_the_quantiles(study):
    figure = drawn(plotting.bands(study, runs=256))
    data = study.bands(runs=256)
    lines = {line.get_label(): line for line in figure.axes[0].get_lines()}
    np.testing.assert_array_equal(lines["50 %"].get_ydata(), data.q.sel(quantile=0.5).values[:, 0])
    assert "5 to 95 %" in [text.get_text() for text in figure.legends[0].get_texts()]


@pytest.mark.slow
def test_histograms_count_every_run(study):
    figure = drawn(plotting.histograms(study, ["margin", "first_violation_time"]))
    counted = sum(patch.get_height() for patch in figure.axes[0].patches)
    assert counted == len(study)
    assert "runs without a value" in figure.axes[1].get_title()
    assert drawn(plotting.histograms(study)).axes


def test_scatter_shows_the_correlation(study):
    figure = drawn(plotting.scatter(study))
    rho = float(
        study.correlations(["margin"]).correlation.sel(parameter="plant.mass[1]", metric="margin")
    )
    assert figure.axes[0].get_title() == f"rank correlation {rho:.2f}"


@pytest.mark.slow
def test_heat_maps_show_shares_and_medians(table):
    figure = drawn(plotting.heat_map(table, ["violated", "margin"]))
    maps = [axes for axes in figure.axes if axes.images and not axes.get_label()]
    shares, margins = (axes.images[0].get_array() for axes in maps)
    violated = (table.status & int(Status.BOUND_VIOLATED)) != 0
    np.testing.assert_array_equal(shares, violated.mean("run").T)
    np.testing.assert_array_equal(margins, table.margin.min("joint").median("run").T)
    assert maps[1].get_xlabel() == "controller.K2 [N m s/rad]"


def test_parallel_has_a_line_a_point(table):
    figure = drawn(plotting.parallel(table, "margin"))
    assert len(figure.axes[0].get_lines()) == 6
    assert len(figure.axes[0].get_xticks()) == 3


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda study, table: plotting.bands(table), "a Study"),
        (lambda study, table: plotting.histograms(study, ["speed"]), "margin"),
        (lambda study, table: plotting.heat_map(table, "speed"), "margin"),
        (lambda study, table: plotting.heat_map(table, "margin", x="nothing"), "two dimensions"),
        (lambda study, table: plotting.heat_map(table, **{"no.thing": 1.0}), "dimension"),
        (
            lambda study, table: plotting.heat_map(table.drop_attrs(deep=False)),
            "Dataset of a sweep",
        ),
    ],
)
def test_bad_figures_are_refused(study, table, draw, message):
    with pytest.raises(ValueError, match=message):
        draw(study, table)
