"""Figures of studies and sweeps show what their data hold."""

from functools import partial

import numpy as np
import pytest
import study_cases as cases
from drawing import drawn, lines_of
from refused import assert_refused
from stored_results import stored

from iblf_jax import Status, plotting


@pytest.fixture(scope="module")
def study():
    return cases.study(512)


@pytest.fixture(scope="module")
def table():
    return cases.table()


@pytest.mark.slow
def test_the_overview_of_a_study_its_quantiles_and_histograms_of_every_run(study):
    assert f"512 runs, {len(study.failed)} failed" in drawn(study.plot(runs=256)).get_suptitle()
    figure = drawn(plotting.bands(study, runs=256))
    (median,) = lines_of(figure.axes[0], "50 %")
    expected = study.bands(runs=256).q.sel(quantile=0.5).values[:, 0]
    np.testing.assert_array_equal(median.get_ydata(), expected)
    assert "5 to 95 %" in [text.get_text() for text in figure.legends[0].get_texts()]
    figure = drawn(plotting.histograms(study, ["margin", "first_violation_time"]))
    counted = sum(patch.get_height() for patch in figure.axes[0].patches)
    assert counted == len(study) and "runs without a value" in figure.axes[1].get_title()


@pytest.mark.slow
def test_heat_maps_show_shares_and_medians(table):
    figure = drawn(plotting.heat_map(table, ["violated", "margin"]))
    maps = [axes for axes in figure.axes if axes.images and not axes.get_label()]
    shares, margins = (axes.images[0].get_array() for axes in maps)
    violated = (table.status & int(Status.BOUND_VIOLATED)) != 0
    np.testing.assert_array_equal(shares, violated.mean("run").T)
    np.testing.assert_array_equal(margins, table.margin.min("joint").median("run").T)
    assert maps[1].get_xlabel() == "controller.K2 [N m s/rad]"


def test_bad_figures_are_refused(table):
    study = stored("Study_0")
    for message, draw, *arguments in (
        ("a Study", plotting.bands, table),
        ("margin", plotting.histograms, study, ["speed"]),
        ("margin", plotting.heat_map, table, "speed"),
        ("two dimensions", partial(plotting.heat_map, x="nothing"), table, "margin"),
        ("dimension", partial(plotting.heat_map, **{"no.thing": 1.0}), table),
        ("Dataset of a sweep", plotting.heat_map, table.drop_attrs(deep=False)),
    ):
        assert_refused(message, draw, *arguments)
