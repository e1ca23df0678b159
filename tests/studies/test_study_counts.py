"""What a study says about its runs adds up: counts, starts outside, statistics, progress."""

import dataclasses
import sys
import time
import types
import warnings

import numpy as np
import pytest
import study_cases as cases

import iblf_jax as ij
from iblf_jax import Status
from iblf_jax.core import progress
from iblf_jax.core.status import FAILED
from iblf_jax.kernels import messages


@pytest.fixture(scope="module")
def study():
    """600 runs, some of which start outside their bounds, and some with flags of every kind."""
    found = cases.study()
    status = np.array(found.status)
    calm = np.flatnonzero(status == 0)
    status[calm[:5]] |= int(Status.TORQUE_SATURATED)
    status[calm[5:9]] |= int(Status.GUARD_ACTIVE | Status.STEP_TOO_LARGE)
    status[calm[9:12]] |= int(Status.BOUND_VIOLATED)
    return dataclasses.replace(found, status=status)


def test_the_counts_add_up_and_what_statistics_are_over_is_said(study):
    counts = study.status_counts
    assert counts["OK"] + counts["FLAGGED"] + counts["FAILED"] == len(study)
    np.testing.assert_array_equal(study.failed, np.flatnonzero(study.status & int(FAILED)))
    assert counts["FLAGGED"] == np.sum((study.status != 0) & (study.status & int(FAILED) == 0)) >= 5
    kinds = "failed: {FAILED}; flagged, but not failed: {FLAGGED}; ok: {OK}"
    assert kinds.format(**counts) in repr(study)
    failed = counts["FAILED"]
    words = f"statistics are over 600 runs, {failed} failed ones included (exclude_failed=True"
    assert f"{words} leaves them out)" in repr(study)
    said = study.quantiles().attrs
    assert (said["runs"], said["failed_included"], said["excluded"]) == (600, failed, 0)
    said = study.quantiles(exclude_failed=True).attrs
    assert (said["runs"], said["failed_included"], said["excluded"]) == (600 - failed, 0, failed)
    assert np.all(study.quantiles((0.0,), exclude_failed=True).margin > 0)
    least = study.quantiles((0.0,)).margin.sel(quantile=0.0)
    np.testing.assert_allclose(least, study.metrics.margin.min(0))


def test_starts_outside_are_told_from_violations_of_the_law(study):
    q = np.asarray(study.samples["initial.q"])
    tube = ij.bounds.tube_at(study.scenario.reference, study.scenario.bounds[0], 0.0)
    outside = np.any((q <= np.asarray(tube.lower)) | (q >= np.asarray(tube.upper)), axis=1)
    assert outside.any()
    np.testing.assert_array_equal(study.started_outside, outside)
    assert np.all(np.asarray(study.metrics.first_violation_time)[outside] == 0)
    counts = study.status_counts
    assert counts["STARTED_OUTSIDE"] == outside.sum() == counts["BOUND_VIOLATED"] - 3
    assert f"{outside.sum()} of them at t = 0, because they started outside" in repr(study)
    title = study.plot(runs=256).get_suptitle().replace("\n", " ")
    assert f"{outside.sum()} of them because they started outside" in title
    words = "joint 1 was drawn .* rad beyond one at t = 0.*not the law's"
    with pytest.warns(ij.SimulationWarning, match=words):
        study.replay(int(np.flatnonzero(outside)[0]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        study.replay(int(np.flatnonzero(study.status == 0)[0]))


def test_the_line_of_a_notebook_is_replaced_and_not_in_stored_outputs(monkeypatch, capsys):
    shown = []

    class Handle:
        def update(self, content, raw):
            shown.append(content["text/plain"])

    def display(content, raw, display_id):
        shown.append(content["text/plain"])
        return Handle()

    shell = types.SimpleNamespace(kernel=None)
    of_display = types.SimpleNamespace(display=display)
    ipython = types.SimpleNamespace(get_ipython=lambda: shell, display=of_display)
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "ipykernel", types.SimpleNamespace())
    monkeypatch.setattr(messages, "SLOW", 0.05)
    with messages.announce_if_slow("tuning"):
        time.sleep(0.2)
    assert shown == ["iblf_jax: tuning", ""]
    monkeypatch.setenv("IBLF_JAX_PROGRESS", "0")
    with messages.announce_if_slow("tuning"):
        time.sleep(0.2)
    assert len(shown) == 2 and capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("options", "has_bar", "shown"),
    [
        ({}, False, True),
        ({"progress": None}, False, True),
        ({"progress": False}, False, False),
        ({}, True, False),
    ],
)
def test_a_slow_call_prints_one_line_or_a_bar(monkeypatch, capsys, options, has_bar, shown):
    """The functions that it calls print none."""
    monkeypatch.setattr(messages, "SLOW", 0.1)
    monkeypatch.setattr(messages, "has_reader", lambda: True)

    @progress.announced("counting")
    def inner():
        time.sleep(0.3)

    @progress.announced("adding up")
    def outer(progress=None):
        inner()
        return "sum"

    @progress.announced("adding up")
    def with_bar():
        with progress.bar(False, 3) as bar:
            time.sleep(0.3)
            bar.update(3)
        return "sum"

    assert (with_bar() if has_bar else outer(**options)) == "sum"
    assert capsys.readouterr().err == ("iblf_jax: adding up\n" if shown else "")
