"""The paper's simulation against an independent program, and the numbers that it must show."""

import numpy as np
import pytest
from conftest import PAPER

import iblf_jax as ij

PRINTED, LOG = ("integral", "printed"), ("log", "corrected")
"""Two of the four pairs; `test_closed_loop` has the others."""


def reference_of(data, law, variant):
    prefix = f"{'iblf' if law == 'integral' else 'log'}_{variant}."
    return {
        key.removeprefix(prefix): value for key, value in data.items() if key.startswith(prefix)
    }


def largest(a, b):
    return float(np.max(np.abs(np.asarray(a, float) - b)))


@pytest.mark.parametrize(("law", "variant"), [PRINTED, pytest.param(*LOG, marks=pytest.mark.slow)])
def test_both_laws_at_one_millisecond(reference_data, law, variant):
    run = ij.simulate(ij.presets.zhang_yan_2024(law=law, variant=variant), **PAPER)
    ref = reference_of(reference_data, law, variant)
    assert run.ok
    np.testing.assert_allclose(run.t, reference_data["t"], atol=1e-12)
    most = {"q": 1e-7, "tau": 5e-4, "e1": 1e-7, "xi": 1e-6, "dq": 1e-5, "e2": 1e-5}
    for name, size in most.items():
        assert largest(getattr(run, name), ref[name]) <= size, name
    assert largest(run.disturbance_estimate, ref["f_hat"]) <= 1e-5
    assert largest(run.disturbance, ref["f"]) <= 1e-5
    assert largest(run.observer_state, ref["eta"]) <= 1e-5 and largest(run.V, ref["V2"]) <= 1e-6


@pytest.mark.slow
def test_float32(reference_data, paper):
    run = ij.simulate(ij.astype(paper, "float32"), **PAPER)
    assert run.q.dtype == np.float32 and run.ok
    assert largest(run.q, reference_of(reference_data, *PRINTED)["q"]) <= 1e-4


def test_what_the_paper_shows(paper_run):
    """Section 5 of the theory page: the numbers of the paper's own law."""
    xi, e1 = np.abs(np.asarray(paper_run.xi)), np.asarray(paper_run.e1)
    assert np.max(xi) == pytest.approx(0.6154, abs=5e-5) and np.max(xi) == xi[0, 1]
    np.testing.assert_allclose(paper_run.metrics.settling_time, [0.99, 0.71], atol=5e-3)
    overshoot = np.max(-np.sign(e1[0]) * e1, axis=0)
    np.testing.assert_allclose(paper_run.metrics.overshoot, overshoot, rtol=1e-2)
    late = np.max(np.abs(e1[np.asarray(paper_run.t) >= 10.0]), axis=0)
    assert np.all(late <= [8.9e-5 * 1.01, 1.7e-5 * 1.03])
    np.testing.assert_allclose(np.max(np.abs(paper_run.tau), axis=0), [13.5, 16.3], atol=0.05)
    np.testing.assert_allclose(paper_run.metrics.peak_torque, [13.8, 16.3], atol=0.05)
    assert float(paper_run.V[0]) == pytest.approx(0.966, abs=5e-4)
