"""Metrics, which are folds inside the compiled loop, against NumPy on the recorded run."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SHORT

import iblf_jax as ij
from iblf_jax.tuning.quantities import Quantities


@pytest.fixture(scope="module")
def recorded(short_run):
    """The recorded run as NumPy arrays, and the weight of each sample in an integral by the
    trapezoidal rule."""
    fields = {name: np.asarray(getattr(short_run, name)) for name in RECORDED}
    weights = np.full(fields["t"].size, SHORT["dt"])
    weights[[0, -1]] = SHORT["dt"] / 2
    return fields, weights[:, None]


RECORDED = ("t", "q", "tau", "e1", "xi", "lower", "upper", "disturbance", "disturbance_estimate")


@pytest.mark.slow
def test_integrals_and_peaks(short_run, recorded):
    r, dt = recorded
    metrics, size, t = short_run.metrics, np.abs(r["e1"]), r["t"][:, None]
    f_tilde = r["disturbance"] - r["disturbance_estimate"]
    expected = {
        "ise": np.sum(dt * size**2, 0),
        "iae": np.sum(dt * size, 0),
        "itae": np.sum(dt * t * size, 0),
        "rmse": np.sqrt(np.sum(dt * size**2, 0) / SHORT["duration"]),
        "peak_error": np.max(size, 0),
        "margin": np.min(np.minimum(r["q"] - r["lower"], r["upper"] - r["q"]), 0),
        "xi_margin": 1 - np.max(np.abs(r["xi"]), 0),
        "effort": np.sum(dt * r["tau"] ** 2),
        "torque_rms": np.sqrt(np.sum(dt * r["tau"] ** 2, 0) / SHORT["duration"]),
        "peak_torque": np.max(np.abs(r["tau"]), 0),
        "torque_variation": np.sum(np.abs(np.diff(r["tau"], axis=0)), 0),
        "estimate_rmse": np.sqrt(np.sum(dt * f_tilde**2, 0) / SHORT["duration"]),
        "first_violation_time": np.inf,
        "first_violation_joint": -1,
        "saturated_share": np.zeros(2),
    }
    for name, value in expected.items():
        np.testing.assert_allclose(metrics[name], value, rtol=1e-9, err_msg=name)
    assert set(metrics) == {
        *expected,
        "settling_time",
        "overshoot",
        "numerical_error",
        "relative_numerical_error",
    }


def test_every_metric_has_a_unit(short_run):
    assert set(short_run.metrics.units) == set(short_run.metrics)


@pytest.mark.slow
def test_settling_and_overshoot(paper_run, short_run):
    """On a run that settles, and on one that ends outside."""
    metrics = ij.simulate(paper_run.scenario, duration=20.0, dt=1e-3, record_every=10).metrics
    e1, t = np.asarray(paper_run.e1), np.asarray(paper_run.t)
    last = np.asarray([t[np.flatnonzero(np.abs(e1[:, i]) >= 0.01)[-1]] for i in range(2)])
    assert np.all((metrics.settling_time > last) & (metrics.settling_time <= last + 0.011))
    np.testing.assert_allclose(metrics.overshoot, np.max(-np.sign(e1[0]) * e1, axis=0), rtol=1e-2)
    assert np.all(np.isinf(np.asarray(short_run.metrics.settling_time)))


def test_settling_counts_from_the_sample_after_the_last_one_outside():
    from iblf_jax.testing.metrics import samples

    some = samples(np.random.default_rng(0))
    fold = ij.metrics.Settling(tolerance=0.05)
    e1 = np.where(np.arange(40)[:, None] < [10, 40], 0.1, 0.01)
    some = dataclasses.replace(some, e=some.e.at[:, 0].set(e1))
    acc = fold.init(_row(some, 0))
    for i in range(40):
        acc = fold.update(acc, _row(some, i))
    np.testing.assert_allclose(fold.finish(acc)["settling_time"], [0.1, np.inf])


@pytest.mark.parametrize(
    ("q", "slope"), [(0.84, -1.0), (0.86, -1.0), (2.0, -1.0), (0.19, 1.0), (-1.0, 1.0)]
)
def test_margins_go_on_through_zero(q, slope):
    """Bounds 0.2 and 0.85: past the wall the margin is negative and its gradient still says which
    way is back."""
    from iblf_jax.testing.metrics import samples

    fold, sample = ij.metrics.Margin(), _row(samples(np.random.default_rng(0)), 0)

    def margin(q):
        now = dataclasses.replace(sample, x=sample.x.at[0].set(jnp.stack([q, jnp.asarray(0.5)])))
        return fold.finish(fold.update(fold.init(now), now))["margin"][0]

    value, gradient = jax.value_and_grad(margin)(jnp.asarray(q))
    assert float(value) == pytest.approx(min(q - 0.2, 0.85 - q))
    assert float(gradient) == slope


def _row(samples, i):
    return jax.tree.map(lambda x: x[i], samples)


def test_metrics_do_not_depend_on_what_is_recorded(paper, short_run):
    """7 does not divide 500: the last block is incomplete."""
    sparse = ij.simulate(paper, **SHORT, record_every=7)
    assert sparse.t.size == 500 // 7 + 1
    for name in short_run.metrics:
        np.testing.assert_allclose(
            sparse.metrics[name], short_run.metrics[name], rtol=1e-10, err_msg=name
        )
    for name in ("t", "q", "dq", "tau", "e2", "V", "disturbance_estimate", "observer_state"):
        np.testing.assert_allclose(
            getattr(sparse, name),
            np.asarray(getattr(short_run, name))[::7],
            rtol=1e-9,
            atol=1e-12,
            err_msg=name,
        )
    assert int(sparse.status) == int(short_run.status)


def test_recorded_fields_agree_with_each_other(short_run):
    r = short_run
    np.testing.assert_allclose(r.e1, r.q - r.q_d, atol=1e-15)
    np.testing.assert_allclose(r.e2, r.dq - r.alpha, atol=1e-13)
    np.testing.assert_allclose(r.t, np.arange(501) * 1e-3, atol=1e-12)
    xi = np.where(r.e1 > 0, r.e1 / (r.upper - r.q_d), r.e1 / (r.q_d - r.lower))
    np.testing.assert_allclose(r.xi, xi, rtol=1e-12)
    assert r.controller_state == ()
    assert r.observer_state.shape == r.q.shape


def test_folds_that_collide_or_are_not_folds_are_refused(paper):
    twice = (ij.metrics.Settling(tolerance=0.01), ij.metrics.Settling(tolerance=0.1))
    for bad, word in (
        (twice, "settling_time"),
        (ij.metrics.Tracking(), "brackets"),
        (("rmse",), "metrics[0]"),
        ((ij.metrics.Tracking,), "instance"),
        (3, "tuple"),
    ):
        with pytest.raises(ValueError, match="metrics") as caught:
            ij.simulate(paper, **SHORT, metrics=bad)
        assert word in str(caught.value)


def test_access_by_name_and_by_attribute(short_run):
    metrics = short_run.metrics
    assert metrics.rmse is metrics["rmse"]
    assert "rmse" in metrics
    assert "rmse" in dir(metrics)
    assert "rad" in repr(metrics)
    with pytest.raises(KeyError, match="rmse"):
        metrics["nothing"]
    with pytest.raises(AttributeError, match="rmse"):
        _ = metrics.nothing


# --- integrals are of second order -----------------------------------------------


@pytest.mark.slow
def test_the_effort_above_gravity_by_hand(rng):
    fold, samples = ij.metrics.AboveGravity(), ij.testing.metrics.samples(rng)
    start = fold.init(jax.tree.map(lambda x: x[0], samples))
    total, _ = jax.lax.scan(lambda acc, x: (fold.update(acc, x), None), start, samples)
    square = np.sum((np.asarray(samples.tau) - np.asarray(samples.gravity)) ** 2, axis=1)
    expected = np.sqrt(np.sum(samples.dt * square) / np.sum(samples.dt))
    found = fold.finish(total)["effort_above_gravity"]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


SLOW = ij.with_parameters(
    ij.presets.zhang_yan_2024(variant="corrected"), {"controller.K2": 4.0, "observer.kf": 4.0}
)
STEP = ij.disturbances.Step(size=[8.0, 3.0], time=0.0631)
LOOPS = {
    "sampled": {"sampling": ij.Sampling(period=1e-2, delay=0.0037)},
    "sampled and disturbed": {"disturbance": STEP, "sampling": ij.Sampling(period=1e-2)},
}
"""Parts of scenarios in which torque and law signals jump, and in which the disturbance does,
too."""
INTEGRALS = ("rmse", "ise", "iae", "itae", "effort", "torque_rms", "effort_above_gravity")


@pytest.mark.slow
@pytest.mark.parametrize("loop", LOOPS)
def test_integrals_are_of_second_order(loop):
    """Whatever jumps: the disturbance does at 0.0631 s, which is at no instant, and the command
    arrives within a step."""
    scenario = dataclasses.replace(SLOW, **LOOPS[loop])
    folds = (
        ij.metrics.Tracking(),
        ij.metrics.Torque(),
        ij.metrics.AboveGravity(),
        ij.metrics.Estimation(),
    )

    def integrals(parts):
        return ij.simulate(
            scenario, duration=0.12, dt=1e-2 / parts, metrics=folds, record_every=10_000
        ).metrics

    coarse, fine, truth = (integrals(parts) for parts in (8, 32, 128))
    for name in (*INTEGRALS, "estimate_rmse"):
        errors = [
            np.max(np.abs(x[name] - truth[name]) / np.abs(truth[name])) for x in (coarse, fine)
        ]
        assert errors[0] < 6e-3, (name, errors)
        # Where the leading terms cancel, a smaller one, of the cell that the jump divides, is all
        # that is left.
        assert errors[1] < 1e-7 or np.log2(errors[0] / errors[1]) / 2 > 1.9, (name, errors)


@pytest.mark.slow
def test_one_definition_serves_runs_batches_and_losses():
    """A disturbance that jumps within a step, under a sampled law: the numbers of a run, a batch
    and a loss are the same."""
    scenario = dataclasses.replace(SLOW, **LOOPS["sampled and disturbed"])
    timing = {"duration": 0.12, "dt": 1e-2}
    objective = ij.objectives.tracking() + ij.objectives.effort()
    folds = (ij.metrics.Tracking(), ij.metrics.Torque(), Quantities(objective.quantities))
    run = ij.simulate(scenario, metrics=folds, **timing)
    draws = {"disturbance.time": ij.value(ij.uniform(0.05, 0.07))}
    study = ij.monte_carlo(scenario, draws, runs=3, progress=False, **timing)
    replayed = study.replay(1)
    for name in ("ise", "effort", "estimate_rmse"):
        np.testing.assert_allclose(
            study.metrics[name][1], replayed.metrics[name], rtol=1e-12, err_msg=name
        )
    np.testing.assert_allclose(
        run.metrics["tuning_exact"], [np.sum(run.metrics.ise), run.metrics.effort], rtol=1e-12
    )
