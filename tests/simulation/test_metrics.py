"""Metrics, which are folds inside the compiled loop, against NumPy on the recorded run."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SHORT
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.core.status import Status
from iblf_jax.engine.status_flags import sample_status
from iblf_jax.testing.metrics import folded, samples
from iblf_jax.tuning.quantities import Quantities


def integral(x):
    """Over the short run, by the trapezoidal rule."""
    return np.trapezoid(x, dx=SHORT["dt"], axis=0)


def test_integrals_and_peaks(short_run):
    run, metrics, seconds = short_run, short_run.metrics, SHORT["duration"]
    size, tau = np.abs(run.e1), np.asarray(run.tau)
    expected = {
        "ise": integral(size**2),
        "iae": integral(size),
        "itae": integral(np.asarray(run.t)[:, None] * size),
        "rmse": np.sqrt(integral(size**2) / seconds),
        "peak_error": np.max(size, 0),
        "margin": np.min(np.minimum(run.q - run.lower, run.upper - run.q), 0),
        "xi_margin": 1 - np.max(np.abs(run.xi), 0),
        "effort": np.sum(integral(tau**2)),
        "torque_rms": np.sqrt(integral(tau**2) / seconds),
        "peak_torque": np.max(np.abs(tau), 0),
        "torque_variation": np.sum(np.abs(np.diff(tau, axis=0)), 0),
        "estimate_rmse": np.sqrt(
            integral((run.disturbance - run.disturbance_estimate) ** 2) / seconds
        ),
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


def test_settling_counts_from_the_sample_after_the_last_one_outside():
    some = samples(np.random.default_rng(0))
    e1 = np.where(np.arange(40)[:, None] < [10, 40], 0.1, 0.01)
    some = dataclasses.replace(some, e=some.e.at[:, 0].set(e1))
    found = folded((ij.metrics.Settling(tolerance=0.05),), some)
    np.testing.assert_allclose(found["settling_time"], [0.1, np.inf])


def test_margins_go_on_through_zero():
    """Bounds 0.2 and 0.85: beyond, the gradient still says which way is back."""
    fold = ij.metrics.Margin()
    sample = jax.tree.map(lambda x: np.asarray(x)[0], samples(np.random.default_rng(0)))

    def margin(q):
        now = dataclasses.replace(sample, x=jnp.asarray(sample.x).at[0].set(jnp.stack([q, 0.5])))
        return fold.finish(fold.update(fold.init(now), now))["margin"][0]

    q = np.array([0.84, 0.86, 2.0, 0.19, -1.0])
    value, gradient = jax.jit(jax.vmap(jax.value_and_grad(margin)))(q)
    np.testing.assert_allclose(value, np.minimum(q - 0.2, 0.85 - q), rtol=1e-6)
    np.testing.assert_array_equal(gradient, [-1.0, -1.0, -1.0, 1.0, 1.0])


VIOLATIONS = int(Status.BOUND_VIOLATED | Status.VELOCITY_VIOLATED)
VIOLATIONS |= int(Status.STATE_BOUND_VIOLATED | Status.REGION_VIOLATED)


def test_the_first_violation_has_its_time_and_place():
    """Component 2 and region 1 from the second instant on; at the third one all others.  Only what
    is violated has a flag."""
    some = jax.tree.map(lambda x: np.asarray(x)[:3], samples(np.random.default_rng(0), 3))
    x = 0.5 * (some.level_lower + some.level_upper)
    x[1:, :, 2] += 5.0
    x[2] += 6.0
    walls = np.asarray([[0.1, 0.1], [0.1, -0.1], [-0.2, -0.2]])
    some = dataclasses.replace(some, x=x, region_margin=walls)
    m = ij.metrics
    folds = (m.Margin(), m.VelocityMargin(), m.LevelMargin(), m.RegionMargin())
    found, flags = jax.jit(lambda x: (folded(folds, x), jax.vmap(sample_status)(x)))(some)
    assert [int(x) & VIOLATIONS for x in flags] == [0, VIOLATIONS, VIOLATIONS]
    for name in ("violation", "velocity_violation", "level_violation", "region_violation"):
        assert found[f"first_{name}_time"] == some.t[1]
    places = {"violation_joint": 2, "velocity_violation_joint": 2, "region_violation_region": 1}
    places |= {"level_violation_level": 3, "level_violation_component": 2}
    assert {place: int(found[f"first_{place}"]) for place in places} == places


def test_metrics_do_not_depend_on_what_is_recorded(paper, short_run):
    """7 does not divide 500: the last block is incomplete."""
    sparse = ij.simulate(paper, **SHORT, record_every=7)
    assert sparse.t.size == 500 // 7 + 1
    close = np.testing.assert_allclose
    for name in short_run.metrics:
        close(sparse.metrics[name], short_run.metrics[name], rtol=1e-10, err_msg=name)
    for name in ("t", "q", "dq", "tau", "e2", "V", "disturbance_estimate", "observer_state"):
        every = getattr(short_run, name)[::7]
        close(getattr(sparse, name), every, rtol=1e-9, atol=1e-12, err_msg=name)
    assert int(sparse.status) == int(short_run.status)


def test_folds_that_collide_or_are_not_folds_are_refused(paper):
    for folds, words in (
        ([ij.metrics.Settling(tolerance=x) for x in (0.01, 0.1)], "settling_time"),
        (ij.metrics.Tracking(), "brackets"),
        (("rmse",), r"metrics\[0\]"),
        ((ij.metrics.Tracking,), "instance"),
        (3, "tuple"),
    ):
        either = rf"(?s)metrics.*{words}|{words}.*metrics"
        assert_refused(either, ij.simulate, paper, **SHORT, metrics=folds)


def test_access_by_name_and_by_attribute_and_a_text_with_none_for_what_did_not_happen(short_run):
    metrics = short_run.metrics
    assert metrics.rmse is metrics["rmse"]
    assert "rmse" in metrics and "rmse" in dir(metrics) and "rad" in repr(metrics)
    with pytest.raises(KeyError, match="rmse"):
        metrics["nothing"]
    with pytest.raises(AttributeError, match="rmse"):
        _ = metrics.nothing
    units = {"margin": "rad", "first_violation_time": "s", "first_violation_joint": "1"}
    values = {"margin": jnp.array([0.5, -1.0]), "first_violation_time": jnp.array(jnp.inf)}
    calm = ij.Metrics(values | {"first_violation_joint": jnp.int32(-1)}, tuple(units.items()))
    rows = [line.split() for line in repr(calm).split("\n")[1:-1]]
    assert rows[0] == ["margin", "[", "0.5", "-1.", "]", "rad"]
    assert rows[1:] == [["first_violation_time", "none"], ["first_violation_joint", "none"]]
    assert np.isinf(calm.first_violation_time) and calm.first_violation_joint == -1
    times = jnp.array([0.25, jnp.inf])
    happened = {"first_violation_time": times, "first_violation_joint": jnp.array([1, -1])}
    text = repr(ij.Metrics(happened, tuple(units.items())))
    assert "[0.25  none] s" in text and "[ 1 none] 1" in text


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
"""Parts of scenarios in which torque and law signals jump, and the disturbance, too."""
INTEGRALS = (
    *("rmse", "ise", "iae", "itae", "estimate_rmse"),
    *("effort", "torque_rms", "effort_above_gravity"),
)


@pytest.mark.slow
@pytest.mark.parametrize("loop", LOOPS)
def test_integrals_are_of_second_order(loop):
    """The disturbance jumps at no instant, and the command arrives within a step."""
    scenario, metrics = dataclasses.replace(SLOW, **LOOPS[loop]), ij.metrics
    folds = (metrics.Tracking(), metrics.Torque(), metrics.AboveGravity(), metrics.Estimation())

    def integrals(parts):
        options = {"metrics": folds, "record_every": 10_000}
        return ij.simulate(scenario, duration=0.12, dt=1e-2 / parts, **options).metrics

    coarse, fine, truth = (integrals(parts) for parts in (8, 32, 128))
    for name in INTEGRALS:
        errors = [np.max(np.abs(x[name] / truth[name] - 1.0)) for x in (coarse, fine)]
        assert errors[0] < 6e-3, (name, errors)
        # Where the leading terms cancel, a smaller one, of the cell that the jump divides, is all
        # that is left.
        assert errors[1] < 1e-7 or np.log2(errors[0] / errors[1]) / 2 > 1.9, (name, errors)


@pytest.mark.slow
def test_one_definition_serves_runs_batches_and_losses():
    """Under a sampled law, where a disturbance jumps within a step."""
    scenario = dataclasses.replace(SLOW, **LOOPS["sampled and disturbed"])
    timing = {"duration": 0.12, "dt": 1e-2}
    objective = ij.objectives.tracking() + ij.objectives.effort()
    folds = (ij.metrics.Tracking(), ij.metrics.Torque(), Quantities(objective.quantities))
    run = ij.simulate(scenario, metrics=folds, **timing)
    draws = {"disturbance.time": ij.value(ij.uniform(0.05, 0.07))}
    study = ij.monte_carlo(scenario, draws, runs=3, progress=False, **timing)
    replayed = study.replay(1)
    for name in ("ise", "effort", "estimate_rmse"):
        expected = replayed.metrics[name]
        np.testing.assert_allclose(study.metrics[name][1], expected, rtol=1e-12, err_msg=name)
    both = np.sum(run.metrics.ise), run.metrics.effort
    np.testing.assert_allclose(run.metrics["tuning_exact"], both, rtol=1e-12)
