"""Metrics, which are folds inside the compiled loop, against NumPy on the recorded run."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SHORT

import iblf_jax as ij
from iblf_jax.testing.metrics import folded, samples
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
        "settling_time": np.full(2, np.inf),
        "overshoot": np.zeros(2),
    }
    for name, value in expected.items():
        np.testing.assert_allclose(metrics[name], value, rtol=1e-9, err_msg=name)
    assert set(metrics) == {*expected, "numerical_error", "relative_numerical_error"}
    assert set(metrics.units) == set(metrics)


def sample_of(rows, i=0):
    return jax.tree.map(lambda x: x[i], rows)


def test_settling_counts_from_the_sample_after_the_last_one_outside():
    some = samples(np.random.default_rng(0))
    e1 = np.where(np.arange(40)[:, None] < [10, 40], 0.1, 0.01)
    some = dataclasses.replace(some, e=some.e.at[:, 0].set(e1))
    found = folded((ij.metrics.Settling(tolerance=0.05),), some)
    np.testing.assert_allclose(found["settling_time"], [0.1, np.inf])


@pytest.mark.parametrize(
    ("q", "slope"), [(0.84, -1.0), (0.86, -1.0), (2.0, -1.0), (0.19, 1.0), (-1.0, 1.0)]
)
def test_margins_go_on_through_zero(q, slope):
    """Bounds 0.2 and 0.85: past the wall the margin is negative and its gradient still says which
    way is back."""
    fold, sample = ij.metrics.Margin(), sample_of(samples(np.random.default_rng(0)))

    def margin(q):
        now = dataclasses.replace(sample, x=sample.x.at[0].set(jnp.stack([q, jnp.asarray(0.5)])))
        return fold.finish(fold.update(fold.init(now), now))["margin"][0]

    value, gradient = jax.value_and_grad(margin)(jnp.asarray(q))
    assert float(value) == pytest.approx(min(q - 0.2, 0.85 - q))
    assert float(gradient) == slope


@pytest.mark.parametrize(
    ("name", "fold", "place"),
    [
        ("violation", ij.metrics.Margin(), {"joint": 2}),
        ("velocity_violation", ij.metrics.VelocityMargin(), {"joint": 2}),
        ("level_violation", ij.metrics.LevelMargin(), {"level": 3, "component": 2}),
        ("region_violation", ij.metrics.RegionMargin(), {"region": 1}),
    ],
)
def test_the_first_violation_has_its_time_and_place(name, fold, place):
    """Component 2 of every level, and region 1, from the second instant on; at the third one all
    others."""
    some = jax.tree.map(lambda x: x[:3], samples(np.random.default_rng(0), 3))
    middle = 0.5 * (some.level_lower + some.level_upper)
    x = middle.at[1:, :, 2].add(5.0).at[2].add(6.0)
    walls = jnp.asarray([[0.1, 0.1], [0.1, -0.1], [-0.2, -0.2]])
    found = folded((fold,), dataclasses.replace(some, x=x, region_margin=walls))
    assert found[f"first_{name}_time"] == some.t[1]
    assert {key: int(found[f"first_{name}_{key}"]) for key in place} == place


def test_metrics_do_not_depend_on_what_is_recorded(paper, short_run):
    """7 does not divide 500: the last block is incomplete."""
    sparse = ij.simulate(paper, **SHORT, record_every=7)
    assert sparse.t.size == 500 // 7 + 1
    close = np.testing.assert_allclose
    for name in short_run.metrics:
        close(sparse.metrics[name], short_run.metrics[name], rtol=1e-10, err_msg=name)
    for name in ("t", "q", "dq", "tau", "e2", "V", "disturbance_estimate", "observer_state"):
        every = np.asarray(getattr(short_run, name))[::7]
        close(getattr(sparse, name), every, rtol=1e-9, atol=1e-12, err_msg=name)
    assert int(sparse.status) == int(short_run.status)


TWICE = (ij.metrics.Settling(tolerance=0.01), ij.metrics.Settling(tolerance=0.1))


@pytest.mark.parametrize(
    ("folds", "words"),
    [
        (TWICE, "settling_time"),
        (ij.metrics.Tracking(), "brackets"),
        (("rmse",), r"metrics\[0\]"),
        ((ij.metrics.Tracking,), "instance"),
        (3, "tuple"),
    ],
)
def test_folds_that_collide_or_are_not_folds_are_refused(paper, folds, words):
    with pytest.raises(ValueError, match=rf"(?s)metrics.*{words}|{words}.*metrics"):
        ij.simulate(paper, **SHORT, metrics=folds)


def test_access_by_name_and_by_attribute(short_run):
    metrics = short_run.metrics
    assert metrics.rmse is metrics["rmse"]
    assert "rmse" in metrics and "rmse" in dir(metrics) and "rad" in repr(metrics)
    with pytest.raises(KeyError, match="rmse"):
        metrics["nothing"]
    with pytest.raises(AttributeError, match="rmse"):
        _ = metrics.nothing


# --- integrals are of second order -----------------------------------------------


@pytest.mark.slow
def test_the_effort_above_gravity_by_hand(rng):
    some = samples(rng)
    square = np.sum((np.asarray(some.tau) - np.asarray(some.gravity)) ** 2, axis=1)
    expected = np.sqrt(np.sum(some.dt * square) / np.sum(some.dt))
    found = folded((ij.metrics.AboveGravity(),), some)["effort_above_gravity"]
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
INTEGRALS = (
    *("rmse", "ise", "iae", "itae", "estimate_rmse"),
    *("effort", "torque_rms", "effort_above_gravity"),
)


@pytest.mark.slow
@pytest.mark.parametrize("loop", LOOPS)
def test_integrals_are_of_second_order(loop):
    """Whatever jumps: the disturbance does at 0.0631 s, which is at no instant, and the command
    arrives within a step."""
    scenario, metrics = dataclasses.replace(SLOW, **LOOPS[loop]), ij.metrics
    folds = (metrics.Tracking(), metrics.Torque(), metrics.AboveGravity(), metrics.Estimation())

    def integrals(parts):
        options = {"metrics": folds, "record_every": 10_000}
        return ij.simulate(scenario, duration=0.12, dt=1e-2 / parts, **options).metrics

    coarse, fine, truth = (integrals(parts) for parts in (8, 32, 128))
    for name in INTEGRALS:
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


def test_the_text_of_metrics_says_none_for_what_did_not_happen():
    units = {"margin": "rad", "first_violation_time": "s", "first_violation_joint": "1"}
    values = {"margin": jnp.array([0.5, -1.0]), "first_violation_time": jnp.array(jnp.inf)}
    calm = ij.Metrics(values | {"first_violation_joint": jnp.int32(-1)}, tuple(units.items()))
    rows = [line.split() for line in repr(calm).split("\n")[1:-1]]
    assert rows[0] == ["margin", "[", "0.5", "-1.", "]", "rad"]
    assert rows[1:] == [["first_violation_time", "none"], ["first_violation_joint", "none"]]
    assert np.isinf(calm.first_violation_time) and calm.first_violation_joint == -1
    happened = {"first_violation_time": jnp.array([0.25, jnp.inf])}
    happened["first_violation_joint"] = jnp.array([1, -1])
    text = repr(ij.Metrics(happened, tuple(units.items())))
    assert "[0.25  none] s" in text and "[ 1 none] 1" in text
