"""Objectives made of any metric, and the checker for objectives and for quantities of one's own."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.engine.metric_folds import folded
from iblf_jax.files.tuning import load_tuning_file
from iblf_jax.testing import ContractError
from iblf_jax.testing.metrics import samples
from iblf_jax.tuning import quantities
from iblf_jax.tuning.quantities import MetricResult, Quantities

TUNING = {"duration": 0.5, "dt": 1e-3, "method": "euler", "report": ij.tuning.Report(runs=1)}


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
    folds = (ij.metrics.Tracking(), Swing(), ij.metrics.Torque())
    tracking, swing, torque = (folded((fold,), run) for fold in folds)
    results = (("iae",), ("swing", [2.0, 0.5]), ("effort",))
    parts = tuple(MetricResult(fold, *x) for fold, x in zip(folds, results, strict=True))
    found = folded((Quantities(parts),), run)
    expected = [tracking["iae"].sum(), swing["swing"] @ np.array([2.0, 0.5]), torque["effort"]]
    np.testing.assert_allclose(found["tuning_exact"], expected, rtol=1e-12)
    np.testing.assert_array_equal(found["tuning_smooth"], found["tuning_exact"])


FILE = 'preset = "zhang_yan_2024"\n[tune]\nparameters = ["controller.k1"]\n[[objective]]\n'


def loaded(tmp_path, words, kind="metric"):
    (tmp_path / "tune.toml").write_text(f'{FILE}kind = "{kind}"\n{words}')
    return load_tuning_file(tmp_path / "tune.toml")["objective"]


OF_SETTLING = 'name = "overshoot"\nfold = { kind = "settling", tolerance = 0.02 }\n'


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ('name = "iaee"', r"objective\[0\].name: got 'iaee'.*Did you mean iae"),
        ('fold = "tracking"', r"objective\[0\].name: got nothing, expected the name of one of its"),
        ('fold = "traking"\nname = "iae"', r"objective\[0\].fold.kind.*Did you mean tracking"),
        ('fold = "margin"\nname = "iae"', "got 'iae', expected one of 'margin'"),
        ('name = "iae"', ij.objectives.metric(ij.metrics.Tracking(), "iae")),
        (
            'name = "effort_above_gravity"\nweight = 2.0',
            2.0 * ij.objectives.metric(ij.metrics.AboveGravity(), "effort_above_gravity"),
        ),
        (
            f"{OF_SETTLING}weights = [1.0, 0.0]\nscale = 0.1",
            ij.objectives.metric(
                ij.metrics.Settling(tolerance=0.02), "overshoot", weights=[1.0, 0.0], scale=0.1
            ),
        ),
    ],
)
def test_a_tuning_file_names_any_metric(words, expected, tmp_path):
    if isinstance(expected, str):
        assert_refused(expected, loaded, tmp_path, words)
        return
    found = loaded(tmp_path, words)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


@pytest.mark.slow
def test_a_metric_is_tuned_for_and_is_none_of_a_file(paper, tmp_path):
    goal, effort = ij.objectives.metric(Swing(), "swing"), ij.tuning.Effort(iterations=3)
    best = ij.tune(paper, ["controller.k1"], goal, effort=effort, **TUNING)
    # The objective of the scenario's own gains is 1.
    assert best.objective < 0.5 and "swing" in str(best.report)
    assert_refused("Swing", best.save, tmp_path / "mine")


def rejects(objective, *words, **options):
    # As in a session of a user's, where types are promoted.
    with jax.numpy_dtype_promotion("standard"), pytest.raises(ContractError) as caught:
        ij.testing.check_objective(objective, **options)
    for word in words:
        assert word in str(caught.value), str(caught.value)


@pytest.mark.slow
def test_objectives_and_a_quantity_of_ones_own_pass_and_a_term_without_a_scale_does_not(paper):
    o = ij.objectives
    goal = o.tracking() + 0.5 * o.effort() + o.torque_rate() + o.settle() + o.peak_torque()
    goal += o.margin() + o.metric(Swing(), "swing") + o.violation_probability_below(0.1)
    goal += o.error_below(0.05, after=1.0) + o.peak_torque_below(30.0) + o.margin_above(0.01)
    ij.testing.check_objective(goal)
    ij.testing.check_objective(ij.component(Square)(), duration=0.5)
    words = ("its value at the start", "scale of its own")
    rejects(o.tracking(after=1.0), *words, scenario=paper, duration=0.5)


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


BROKEN = {
    "bare": ("finish", lambda self, acc: acc, "(smooth value, exact value, pieces)"),
    "largest": ("finish", lambda self, acc: (acc, acc, 2 * acc[None]), "the largest of its pieces"),
    "grows": ("update", lambda self, acc, sample: acc + sample.dq, "which a scan carries"),
    "row": ("hessian", lambda self, products, *_: products[0], "hessian gives shape"),
    "triangle": ("hessian", lambda self, products, *_: jnp.triu(products), "not symmetric"),
    "root": (
        "finish",
        lambda self, acc: (jnp.sqrt(acc), acc, acc[None]),
        "derivative is NaN on a run without any error",
    ),
    "stopped": (
        "finish",
        lambda self, acc: (jax.lax.stop_gradient(acc), acc, acc[None]),
        "differs from its finite difference",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BROKEN)
def test_broken_quantities(name):
    method, function, words = BROKEN[name]
    mine = type("Mine", (Square,), {"__annotations__": {}, method: function})
    rejects(ij.component(mine)(), words, duration=0.5)


def test_what_cannot_be_tuned_for_is_rejected():
    rejects(3.0, "JAX does not know its class")
    rejects(ij.metrics.Tracking(), "finish(acc) gives dict")
    rejects(ij.tuning.objectives.Objective(), "neither terms nor requirements")
    words = ("finish(acc)", "a result that can be differentiated")
    rejects(ij.objectives.metric(Swing(), "samples"), *words)


def exact(objective, run):
    """The number of each term and requirement, from the samples of a run."""
    return np.asarray(jax.jit(folded)((Quantities(objective.quantities),), run)["tuning_exact"])


def excesses(requirements, run):
    """g of each requirement, from the samples of a run."""
    goal = ij.objectives.tracking()
    for requirement in requirements:
        goal += requirement
    return np.asarray(goal.excesses(jnp.asarray(exact(goal, run))))


@pytest.fixture(scope="module")
def three_joints():
    return samples(np.random.default_rng(11), 3, 0.01)


SELECTIONS = [((2, 0), [0, 2]), (np.array([0, 2]), [0, 2]), (1, [1]), (-1, [2]), (range(2), [0, 1])]
SELECTIONS += [(slice(1, None), [1, 2]), ("0:3:2", [0, 2]), (["joint 1", 2], [1, 2])]
SELECTIONS += [([True, False, True], [0, 2]), (np.array([False, True, False]), [1])]
SELECTIONS += [(None, [0, 1, 2])]


def test_joints_selects_joints_everywhere(three_joints):
    """Whole numbers are indices, never weights; against NumPy on the samples."""
    o, run, iae = ij.objectives, three_joints, (ij.metrics.Tracking(), "iae")
    terms, requirements = [], []
    for joints, _ in SELECTIONS:
        of = {"joints": joints}
        terms += [o.tracking(**of), o.effort(**of), o.metric(*iae, **of)]
        requirements += [o.peak_torque_below(5.0, **of), o.error_below(0.1, **of)]
        requirements += [o.margin_above(0.01, **of)]
    integrals, peaks = exact(sum(terms[1:] + requirements, terms[0]), run).reshape(2, -1, 3)
    tau, e, q, lower, upper = map(np.asarray, (run.tau, run.e, run.q, run.lower, run.upper))
    for (joints, chosen), found, largest in zip(SELECTIONS, integrals, peaks, strict=True):
        inside = np.minimum(q - lower, upper - q)[:, chosen]
        expected = [*(np.abs(x[:, chosen]).max() for x in (tau, e[:, 0])), -np.min(inside)]
        np.testing.assert_allclose(largest, expected, rtol=1e-10, err_msg=str(joints))
        # The integrals are those of a run in which the other joints stand still.
        some = np.isin(np.arange(3), chosen).astype(float)
        others = dataclasses.replace(run, e=e * some, tau=tau * some)
        expected = exact(o.tracking() + o.effort() + o.metric(*iae), others)
        np.testing.assert_allclose(found, expected, rtol=1e-10, err_msg=str(joints))


@pytest.mark.slow
def test_limits_of_single_joints_and_weights(three_joints):
    """A limit for each joint is broken by the joint that is nearest to its own, or beyond."""
    o, run = ij.objectives, three_joints
    peak, error = (np.abs(np.asarray(x)).max(axis=0) for x in (run.tau, run.e1))
    cases = np.array([[1.1, 1.2, 1.3], [1.1, 0.9, 1.3], [0.5, 2.0, 2.0]])
    of_all = [o.peak_torque_below(c * peak) for c in cases]
    of_all += [o.error_below(list(c * error)) for c in cases]
    expected = np.tile(np.max(1 / cases, axis=1) - 1, 2)
    np.testing.assert_allclose(excesses(of_all, run), expected, rtol=1e-9)
    # Of some joints: a limit for each of these, or for all.
    some = [o.peak_torque_below((c * peak)[[0, 2]], joints=[0, 2]) for c in cases]
    some += [o.peak_torque_below(c * peak, joints=[0, 2]) for c in cases]
    expected = np.tile(np.max(1 / cases[:, [0, 2]], axis=1) - 1, 2)
    np.testing.assert_allclose(excesses(some, run), expected, rtol=1e-9)
    # Margins, of positions that are inside their bounds.
    q = run.x[:, :1]
    kept = dataclasses.replace(run, level_lower=q - 0.2, level_upper=q + jnp.array([0.1, 0.3, 0.4]))
    margins = [o.margin_above([0.05, 0.1, 0.1]), o.margin_above([0.05, 0.25, 0.1])]
    margins += [o.margin_above([0.125, 0.1], joints=[0, 2])]
    np.testing.assert_allclose(excesses(margins, kept), [1 - 2.0, 1 - 0.8, 1 - 0.8], rtol=1e-9)
    goal = o.tracking(weights=[1.0, 0.5, 2.0]) + o.effort(joints=[0, 2], weights=[1.0, 3.0])
    e, tau = run.e * jnp.array([1.0, 0.5, 2.0]), run.tau * jnp.array([1.0, 0.0, 3.0])
    expected = exact(o.tracking() + o.effort(), dataclasses.replace(run, e=e, tau=tau))
    np.testing.assert_allclose(exact(goal, run), expected, rtol=1e-10)
    half = o.peak_torque(2.0 * peak).terms[0].value(jnp.asarray(0.5))
    np.testing.assert_allclose(half, np.log1p(np.exp(-10.0)) / 20.0, rtol=1e-9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda o: o.peak_torque_below(-5.0), r"below: limit: got -5.*> 0.*_below\(limit=140.0\)"),
        (lambda o: o.peak_torque_below("much"), r"peak_torque_below: limit: got 'much'"),
        (lambda o: o.velocity_margin_above(np.nan), "velocity_margin_above: limit"),
        (lambda o: o.margin(-0.1), "margin: target"),
        (lambda o: o.metric(Swing(), "swing", scale=-1.0), r"scale: .* numbers > 0"),
        (lambda o: o.metric("tracking", "rmse"), r"MetricResult.fold: got 'tracking', expected a"),
        (lambda o: o.violation_probability_below(1.5), "violation_probability_below: probability"),
        (lambda o: o.tracking(joints=[True, 1]), "tracking: joints.*cannot be mixed"),
        (lambda o: o.tracking(joints=True), "tracking: joints"),
        (lambda o: o.effort(joints=[1.0, 0.0]), r"effort: joints: got \[1.0.*weights="),
        (lambda o: o.effort(joints=2.0), "effort: joints: got 2.0.*weights="),
        (lambda o: o.tracking(joints=[]), "tracking: joints.*at least one joint"),
        (lambda o: o.peak_torque_below([1, 2], weights=[1, 2, 3]), "peak_torque_below: weights"),
        (lambda o: o.peak_torque_below(5.0, weights=-1.0), "below: weights: got -1.*>= 0"),
        (lambda o: o.tracking(weights=[0.0, 0.0]), "tracking: weights: got .*least one weight > 0"),
    ],
)
def test_errors_name_the_argument_of_the_function(call, message):
    with pytest.raises(ValueError, match=message) as caught:
        call(ij.objectives)
    assert "Peak." not in str(caught.value) and "Term." not in str(caught.value)


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (lambda o: o.tracking(joints=[0, 2]), "tracking: joints: got 2, .* index from 0 to 1"),
        (lambda o: o.tracking(joints=[1, 1]), "tracking: joints.*joint 1 twice.*weights="),
        (lambda o: o.tracking(joints=[True]), "tracking: joints.*2 truth values"),
        (lambda o: o.tracking(joints="joint 2"), "tracking: joints: got 'joint 2'.*Did you mean"),
        (lambda o: o.tracking(weights=[1, 2, 3]), r"tracking: weights.*\(3,\)"),
        (
            lambda o: o.tracking() + o.peak_torque_below([1, 2, 3]),
            r"peak_torque_below: limit: got \[1. 2. 3.\].*2, one for each",
        ),
    ],
)
def test_joints_that_the_robot_does_not_have(goal, message, paper):
    assert_refused(message, ij.tune, paper, ["controller.k1"], goal(ij.objectives), **TUNING)


def test_a_tuning_file_selects_joints_by_name_index_and_slice(tmp_path):
    """A file of the version before `weights` means what it meant."""

    def quantity(words):
        return loaded(tmp_path, words, kind="tracking").quantities[-1]

    assert quantity("joints = [1]").joints == (1,)
    assert quantity('joints = ["joint 0"]').joints == ("joint 0",)
    assert quantity('joints = "1:"').joints == ("1:",)
    torque = '[[requirement]]\nkind = "peak_torque_below"\nlimit = [14.0, 2.0]'
    limits = quantity(f"weights = [1.0, 0.5]\n{torque}")
    np.testing.assert_allclose(1 / limits.weights, [14.0, 2.0])
    assert quantity("joints = [0, 1]").joints == (0, 1)
    assert_refused(r"objective\[\d\].*joints.*weights=", quantity, "joints = [1.0, 0.5]")
    found = ij.load(ROOT / "tests" / "data" / "tuning_before_weights.json").setup.objective
    weights = [np.asarray(quantity.weights).tolist() for quantity in found.quantities]
    assert weights == [[1.0, 0.25], [1.0, 3.0], [0.0, 2.0], [0.0, 1.0], 1.0]
    assert all(quantity.joints is None for quantity in found.quantities)
