"""Objectives made of any metric, and the checker for objectives and for quantities of one's own."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.engine.step import folded
from iblf_jax.files.tuning import load_tuning_file
from iblf_jax.testing import ContractError
from iblf_jax.testing.metrics import samples
from iblf_jax.tuning import quantities
from iblf_jax.tuning.quantities import MetricResult, Quantities

TUNING = {"duration": 0.5, "dt": 1e-3, "report_runs": 1}


@ij.component
class Swing:
    """A fold of one's own: int |q'|^3 of each joint."""

    units: ClassVar[dict[str, str]] = {"swing": "rad^3/s^2", "samples": "1"}

    def init(self, sample):
        return jnp.zeros_like(sample.dq), jnp.int32(0)

    def update(self, acc, sample):
        return acc[0] + sample.dt * jnp.abs(sample.dq) ** 3, acc[1] + 1

    def finish(self, acc):
        return {"swing": acc[0], "samples": acc[1]}


def test_a_result_of_a_metric_is_weighted_and_summed(rng):
    """On the samples of a run, against the metrics themselves."""
    run = samples(rng)
    tracking, swing, torque = (folded((fold,), run) for fold in (ij.metrics.Tracking(), Swing(), ij.metrics.Torque()))
    parts = (
        MetricResult(ij.metrics.Tracking(), "iae"),
        MetricResult(Swing(), "swing", [2.0, 0.5]),
        MetricResult(ij.metrics.Torque(), "effort"),
    )
    found = folded((Quantities(parts),), run)
    expected = [tracking["iae"].sum(), swing["swing"] @ np.array([2.0, 0.5]), torque["effort"]]
    np.testing.assert_allclose(found["tuning_exact"], expected, rtol=1e-12)
    np.testing.assert_array_equal(found["tuning_smooth"], found["tuning_exact"])


FILE = 'preset = "zhang_yan_2024"\n[tune]\nparameters = ["controller.k1"]\n[[objective]]\nkind = "metric"\n'


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ('name = "iae"', ij.objectives.metric(ij.metrics.Tracking(), "iae")),
        ('name = "effort_above_gravity"\nweight = 2.0', 2.0 * ij.objectives.metric(ij.metrics.AboveGravity(), "effort_above_gravity")),
        (
            'name = "overshoot"\nfold = { kind = "settling", tolerance = 0.02 }\njoints = [1.0, 0.0]\nscale = 0.1',
            ij.objectives.metric(ij.metrics.Settling(tolerance=0.02), "overshoot", joints=[1.0, 0.0], scale=0.1),
        ),
    ],
)
def test_a_tuning_file_names_any_metric(words, expected, tmp_path):
    (tmp_path / "tune.toml").write_text(FILE + words)
    found = load_tuning_file(tmp_path / "tune.toml")["objective"]
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ('name = "iaee"', r"objective\[0\].name: got 'iaee'.*Did you mean iae"),
        ("weight = 2.0", r"objective\[0\].name: got nothing"),
        ('fold = "tracking"', r"objective\[0\].name: got nothing, expected the name of one of its results"),
        ('fold = "traking"\nname = "iae"', r"objective\[0\].fold.kind.*Did you mean tracking"),
        ('fold = "margin"\nname = "iae"', "got 'iae', expected one of 'margin'"),
    ],
)
def test_a_tuning_file_with_a_wrong_metric_is_refused(words, message, tmp_path):
    (tmp_path / "tune.toml").write_text(FILE + words)
    with pytest.raises(ValueError, match=message):
        load_tuning_file(tmp_path / "tune.toml")


def test_what_it_refuses():
    with pytest.raises(ValueError, match=r"MetricResult.name: got 'rmsee', expected one of 'rmse', 'ise'"):
        ij.objectives.metric(ij.metrics.Tracking(), "rmsee")
    with pytest.raises(ValueError, match=r"MetricResult.fold: got 'tracking', expected a component that fits iblf_jax.metrics.Fold"):
        ij.objectives.metric("tracking", "rmse")
    with pytest.raises(ValueError, match=r"scale: .* numbers > 0"):
        ij.objectives.metric(Swing(), "swing", scale=-1.0)


@pytest.mark.slow
def test_a_metric_is_tuned_for_and_its_result_saved(paper, tmp_path):
    best = ij.tune(paper, ["controller.k1"], ij.objectives.metric(Swing(), "swing"), iterations=3, **TUNING)
    losses = best.history["loss"]
    assert np.min(losses) < losses[0].min()
    assert "swing" in str(best.report)
    with pytest.raises(ValueError, match="Swing"):
        best.save(tmp_path / "mine.json")


@pytest.mark.release
def test_tuning_by_a_metric_is_tuning_by_the_objective_that_it_equals(paper, tmp_path):
    gains = ["controller.k1", "controller.K2"]
    by_metric = ij.tune(paper, gains, ij.objectives.metric(ij.metrics.Tracking(), "ise") + 0.1 * ij.objectives.effort(), **TUNING)
    by_name = ij.tune(paper, gains, ij.objectives.tracking() + 0.1 * ij.objectives.effort(), **TUNING)
    for name in ("loss", "gradient_norm"):
        np.testing.assert_allclose(by_metric.history[name][0], by_name.history[name][0], rtol=1e-8)
    by_metric.save(tmp_path / "tuned.json")
    assert ij.load_tuning(tmp_path / "tuned.json").values.keys() == by_metric.values.keys()


def rejects(objective, *words, **options):
    # As in a session of a user's, where types are promoted.
    with jax.numpy_dtype_promotion("standard"), pytest.raises(ContractError) as caught:
        ij.testing.check_objective(objective, **options)
    for word in words:
        assert word in str(caught.value), str(caught.value)


@pytest.mark.slow
def test_the_packages_own_objectives_pass():
    o = ij.objectives
    terms = o.tracking() + 0.5 * o.effort() + o.torque_rate() + o.settle() + o.peak_torque() + o.margin() + o.metric(Swing(), "swing")
    limits = o.error_below(0.05, after=1.0) + o.peak_torque_below(30.0) + o.margin_above(0.01) + o.violation_probability_below(0.1)
    ij.testing.check_objective(terms + limits)


class Square:
    """A quantity of one's own, int |q'|^2, with its matrix."""

    def init(self, sample):
        return jnp.zeros_like(sample.t)

    def update(self, acc, sample):
        return acc + sample.dt * jnp.sum(sample.dq**2)

    def finish(self, acc):
        return acc, acc, acc[None]

    def curvature(self, acc, sample):
        return quantities.Outer(sample.dq, 2 * sample.dt)

    def hessian(self, products, pieces, slopes):
        return products


def changed(**methods):
    return ij.component(type("Mine", (Square,), {"__annotations__": {}, **methods}))()


@pytest.mark.slow
def test_a_quantity_of_ones_own_passes():
    ij.testing.check_objective(ij.component(Square)(), duration=0.5)


@pytest.mark.parametrize(
    ("methods", "words"),
    [
        ({"finish": lambda self, acc: acc}, ("finish(acc)", "(smooth value, exact value, pieces)")),
        ({"finish": lambda self, acc: (acc, acc, acc)}, ("the pieces of finish(acc)", "shape ()")),
        ({"finish": lambda self, acc: (acc, acc, 2 * acc[None])}, ("the largest of its pieces", "is not its exact value")),
        ({"update": lambda self, acc, sample: acc + sample.dq}, ("update(acc, sample)", "carried by a scan")),
        ({"curvature": lambda self, acc, sample: sample.dq}, ("curvature(acc, sample)", "iblf_jax.engine.derivatives.Outer")),
        ({"hessian": lambda self, products, pieces, slopes: products[0]}, ("hessian gives shape", "(D, D)")),
        ({"hessian": lambda self, products, pieces, slopes: jnp.triu(products)}, ("not symmetric",)),
        ({"finish": lambda self, acc: (jnp.sqrt(acc), acc, acc[None])}, ("derivative is NaN on a run without any error",)),
        ({"finish": lambda self, acc: (jax.lax.stop_gradient(acc), acc, acc[None])}, ("differs from its finite difference",)),
        ({"init": lambda self, sample: jnp.zeros((), "float64")}, ("the smooth value is float64 for float32 arguments",)),
    ],
    ids=["bare", "pieces", "largest", "grows", "not-outer", "row", "triangle", "root", "stopped", "float64"],
)
def test_broken_quantities(methods, words):
    rejects(changed(**methods), *words, duration=0.5)


def test_what_is_no_objective_at_all():
    rejects(3.0, "JAX does not know its class")
    rejects(ij.metrics.Tracking(), "finish(acc) gives dict")
    rejects(ij.tuning.objectives.Objective(), "neither terms nor requirements")


def test_a_metric_that_cannot_be_tuned_for():
    rejects(ij.objectives.metric(Swing(), "samples"), "finish(acc)", "a result that can be differentiated")


@pytest.mark.slow
def test_a_term_without_a_scale_that_is_zero_at_the_start(paper):
    rejects(ij.objectives.tracking(after=1.0), "its value at the start", "scale of its own", scenario=paper, duration=0.5)
