"""Objectives made of any metric, and the checker for objectives and for quantities of one's own."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.engine.metric_folds import folded
from iblf_jax.files.tuning import load_tuning_file
from iblf_jax.testing import ContractError
from iblf_jax.testing.metrics import samples
from iblf_jax.tuning import quantities
from iblf_jax.tuning.objectives import for_scenario
from iblf_jax.tuning.quantities import MetricResult, Quantities

TUNING = {"duration": 0.5, "dt": 1e-3, "report": ij.tuning.Report(runs=1)}


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
    tracking, swing, torque = (
        folded((fold,), run) for fold in (ij.metrics.Tracking(), Swing(), ij.metrics.Torque())
    )
    parts = (
        MetricResult(ij.metrics.Tracking(), "iae"),
        MetricResult(Swing(), "swing", [2.0, 0.5]),
        MetricResult(ij.metrics.Torque(), "effort"),
    )
    found = folded((Quantities(parts),), run)
    expected = [tracking["iae"].sum(), swing["swing"] @ np.array([2.0, 0.5]), torque["effort"]]
    np.testing.assert_allclose(found["tuning_exact"], expected, rtol=1e-12)
    np.testing.assert_array_equal(found["tuning_smooth"], found["tuning_exact"])


FILE = (
    'preset = "zhang_yan_2024"\n[tune]\nparameters = ["controller.k1"]\n[[objective]]\nkind ='
    ' "metric"\n'
)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ('name = "iae"', ij.objectives.metric(ij.metrics.Tracking(), "iae")),
        (
            'name = "effort_above_gravity"\nweight = 2.0',
            2.0 * ij.objectives.metric(ij.metrics.AboveGravity(), "effort_above_gravity"),
        ),
        (
            (
                'name = "overshoot"\nfold = { kind = "settling", tolerance = 0.02 }\n'
                "weights = [1.0, 0.0]\nscale = 0.1"
            ),
            ij.objectives.metric(
                ij.metrics.Settling(tolerance=0.02), "overshoot", weights=[1.0, 0.0], scale=0.1
            ),
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
        (
            'fold = "tracking"',
            r"objective\[0\].name: got nothing, expected the name of one of its results",
        ),
        ('fold = "traking"\nname = "iae"', r"objective\[0\].fold.kind.*Did you mean tracking"),
        ('fold = "margin"\nname = "iae"', "got 'iae', expected one of 'margin'"),
    ],
)
def test_a_tuning_file_with_a_wrong_metric_is_refused(words, message, tmp_path):
    (tmp_path / "tune.toml").write_text(FILE + words)
    with pytest.raises(ValueError, match=message):
        load_tuning_file(tmp_path / "tune.toml")


def test_what_it_refuses():
    with pytest.raises(
        ValueError, match=r"MetricResult.name: got 'rmsee', expected one of 'rmse', 'ise'"
    ):
        ij.objectives.metric(ij.metrics.Tracking(), "rmsee")
    with pytest.raises(
        ValueError,
        match=(
            r"MetricResult.fold: got 'tracking', expected a component that fits"
            r" iblf_jax.metrics.Fold"
        ),
    ):
        ij.objectives.metric("tracking", "rmse")
    with pytest.raises(ValueError, match=r"scale: .* numbers > 0"):
        ij.objectives.metric(Swing(), "swing", scale=-1.0)


@pytest.mark.slow
def test_a_metric_is_tuned_for_and_its_result_saved(paper, tmp_path):
    best = ij.tune(
        paper,
        ["controller.k1"],
        ij.objectives.metric(Swing(), "swing"),
        effort=ij.tuning.Effort(iterations=3),
        **TUNING,
    )
    # The objective of the scenario's own gains is 1.
    assert best.objective < 0.5
    assert "swing" in str(best.report)
    with pytest.raises(ValueError, match="Swing"):
        best.save(tmp_path / "mine")


@pytest.mark.release
def test_tuning_by_a_metric_is_tuning_by_the_objective_that_it_equals(paper, tmp_path):
    gains = ["controller.k1", "controller.K2"]
    by_metric = ij.tune(
        paper,
        gains,
        ij.objectives.metric(ij.metrics.Tracking(), "ise") + 0.1 * ij.objectives.effort(),
        **TUNING,
    )
    by_name = ij.tune(
        paper, gains, ij.objectives.tracking() + 0.1 * ij.objectives.effort(), **TUNING
    )
    # Starts of nearly equal merit may be numbered in another order.
    order, other_order = (np.argsort(best.history["loss"][0]) for best in (by_metric, by_name))
    for name in ("loss", "gradient_norm"):
        first, second = by_metric.history[name][0][order], by_name.history[name][0][other_order]
        np.testing.assert_allclose(first, second, rtol=1e-8)
    by_metric.save(tmp_path / "tuned")
    assert ij.load(tmp_path / "tuned").values.keys() == by_metric.values.keys()


def rejects(objective, *words, **options):
    # As in a session of a user's, where types are promoted.
    with jax.numpy_dtype_promotion("standard"), pytest.raises(ContractError) as caught:
        ij.testing.check_objective(objective, **options)
    for word in words:
        assert word in str(caught.value), str(caught.value)


@pytest.mark.slow
def test_the_packages_own_objectives_pass():
    o = ij.objectives
    terms = (
        o.tracking()
        + 0.5 * o.effort()
        + o.torque_rate()
        + o.settle()
        + o.peak_torque()
        + o.margin()
        + o.metric(Swing(), "swing")
    )
    limits = (
        o.error_below(0.05, after=1.0)
        + o.peak_torque_below(30.0)
        + o.margin_above(0.01)
        + o.violation_probability_below(0.1)
    )
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("methods", "words"),
    [
        ({"finish": lambda self, acc: acc}, ("finish(acc)", "(smooth value, exact value, pieces)")),
        ({"finish": lambda self, acc: (acc, acc, acc)}, ("the pieces of finish(acc)", "shape ()")),
        (
            {"finish": lambda self, acc: (acc, acc, 2 * acc[None])},
            ("the largest of its pieces", "is not its exact value"),
        ),
        (
            {"update": lambda self, acc, sample: acc + sample.dq},
            ("update(acc, sample)", "which a scan carries"),
        ),
        (
            {"curvature": lambda self, acc, sample: sample.dq},
            ("curvature(acc, sample)", "iblf_jax.engine.derivatives.Outer"),
        ),
        (
            {"hessian": lambda self, products, pieces, slopes: products[0]},
            ("hessian gives shape", "(D, D)"),
        ),
        (
            {"hessian": lambda self, products, pieces, slopes: jnp.triu(products)},
            ("not symmetric",),
        ),
        (
            {"finish": lambda self, acc: (jnp.sqrt(acc), acc, acc[None])},
            ("derivative is NaN on a run without any error",),
        ),
        (
            {"finish": lambda self, acc: (jax.lax.stop_gradient(acc), acc, acc[None])},
            ("differs from its finite difference",),
        ),
        (
            {"init": lambda self, sample: jnp.zeros((), "float64")},
            ("the smooth value is float64 for float32 arguments",),
        ),
    ],
    ids=[
        "bare",
        "pieces",
        "largest",
        "grows",
        "not-outer",
        "row",
        "triangle",
        "root",
        "stopped",
        "float64",
    ],
)
def test_broken_quantities(methods, words):
    rejects(changed(**methods), *words, duration=0.5)


def test_what_is_no_objective_at_all():
    rejects(3.0, "JAX does not know its class")
    rejects(ij.metrics.Tracking(), "finish(acc) gives dict")
    rejects(ij.tuning.objectives.Objective(), "neither terms nor requirements")


def test_a_metric_that_cannot_be_tuned_for():
    rejects(
        ij.objectives.metric(Swing(), "samples"),
        "finish(acc)",
        "a result that can be differentiated",
    )


@pytest.mark.slow
def test_a_term_without_a_scale_that_is_zero_at_the_start(paper):
    rejects(
        ij.objectives.tracking(after=1.0),
        "its value at the start",
        "scale of its own",
        scenario=paper,
        duration=0.5,
    )


# --------------------------------------------------------- which joints, weights, limits of each


def exact(objective, run):
    """Each term's and requirement's number, from the samples of a run."""
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


SELECTIONS = [
    ([0, 2], [0, 2]),
    ((2, 0), [0, 2]),
    (np.array([0, 2]), [0, 2]),
    (1, [1]),
    (-1, [2]),
    (slice(1, None), [1, 2]),
    ("0:3:2", [0, 2]),
    (["joint 1", 2], [1, 2]),
    ([True, False, True], [0, 2]),
    (np.array([False, True, False]), [1]),
    (range(2), [0, 1]),
    (None, [0, 1, 2]),
]


@pytest.mark.parametrize(
    ("joints", "expected"), SELECTIONS, ids=[str(joints) for joints, _ in SELECTIONS]
)
def test_joints_selects_joints_everywhere(joints, expected, three_joints):
    """Whole numbers are indices, never weights; against NumPy on the samples."""
    o, run = ij.objectives, three_joints
    parts = (
        o.tracking(joints=joints)
        + o.effort(joints=joints)
        + o.metric(ij.metrics.Tracking(), "iae", joints=joints)
    )
    parts += (
        o.peak_torque_below(5.0, joints=joints)
        + o.error_below(0.1, joints=joints)
        + o.margin_above(0.01, joints=joints)
    )
    tau, e1 = (np.abs(np.asarray(x))[:, expected] for x in (run.tau, run.e1))
    inside = np.minimum(run.q - run.lower, run.upper - run.q)[:, expected]
    found = exact(parts, run)
    np.testing.assert_allclose(found[3:], [tau.max(), e1.max(), -np.min(inside)], rtol=1e-10)
    # The integrals are those of a run in which the other joints stand still.
    chosen = np.isin(np.arange(3), expected).astype(float)
    others = dataclasses.replace(run, e=run.e * chosen, tau=run.tau * chosen)
    separate = exact(o.tracking() + o.effort() + o.metric(ij.metrics.Tracking(), "iae"), others)
    np.testing.assert_allclose(found[:3], separate, rtol=1e-10)


@pytest.mark.slow
def test_limits_of_single_joints_and_weights(three_joints):
    """A requirement with a limit for each joint is broken by the joint that is nearest to its own,
    or beyond."""
    o, run = ij.objectives, three_joints
    peak, error = (np.abs(np.asarray(x)).max(axis=0) for x in (run.tau, run.e1))
    cases = np.array([[1.1, 1.2, 1.3], [1.1, 0.9, 1.3], [0.5, 2.0, 2.0]])
    np.testing.assert_allclose(
        excesses(
            [o.peak_torque_below(c * peak) for c in cases]
            + [o.error_below(list(c * error)) for c in cases],
            run,
        ),
        np.tile(np.max(1 / cases, axis=1) - 1, 2),
        rtol=1e-9,
    )
    # Of some joints: a limit for each of these, or for all.
    some = [o.peak_torque_below((c * peak)[[0, 2]], joints=[0, 2]) for c in cases]
    same = [o.peak_torque_below(c * peak, joints=[0, 2]) for c in cases]
    np.testing.assert_allclose(
        excesses(some + same, run), np.tile(np.max(1 / cases[:, [0, 2]], axis=1) - 1, 2), rtol=1e-9
    )
    # Margins, of positions that are inside their bounds.
    q = run.x[:, :1]
    upper = q + jnp.array([0.1, 0.3, 0.4])
    kept = dataclasses.replace(run, level_lower=q - 0.2, level_upper=upper)
    found = excesses(
        [
            o.margin_above([0.05, 0.1, 0.1]),
            o.margin_above([0.05, 0.25, 0.1]),
            o.margin_above([0.125, 0.1], joints=[0, 2]),
        ],
        kept,
    )
    np.testing.assert_allclose(found, [1 - 2.0, 1 - 0.8, 1 - 0.8], rtol=1e-9)
    weighted = exact(
        o.tracking(weights=[1.0, 0.5, 2.0]) + o.effort(joints=[0, 2], weights=[1.0, 3.0]), run
    )
    scaled = dataclasses.replace(
        run, e=run.e * jnp.array([1.0, 0.5, 2.0]), tau=run.tau * jnp.array([1.0, 0.0, 3.0])
    )
    np.testing.assert_allclose(weighted, exact(o.tracking() + o.effort(), scaled), rtol=1e-10)
    term = o.peak_torque(2.0 * peak).terms[0]
    np.testing.assert_allclose(
        term.value(jnp.asarray(0.5)), np.log1p(np.exp(-10.0)) / 20.0, rtol=1e-9
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda o: o.peak_torque_below(-5.0),
            r"peak_torque_below: limit: got -5.*> 0.*peak_torque_below\(limit=140.0\)",
        ),
        (lambda o: o.peak_torque_below("much"), r"peak_torque_below: limit: got 'much'"),
        (lambda o: o.error_below([0.1, 0.0]), r"error_below: limit: got \[0.1"),
        (lambda o: o.margin_above(0.0), "margin_above: limit"),
        (lambda o: o.velocity_margin_above(np.nan), "velocity_margin_above: limit"),
        (lambda o: o.peak_torque(0.0), "peak_torque: limit"),
        (lambda o: o.margin(-0.1), "margin: target"),
        (lambda o: o.effort(scale=0.0), "effort: scale"),
        (lambda o: o.error_below(0.1, allowed=2.0), "error_below: allowed"),
        (lambda o: o.violation_probability_below(1.5), "violation_probability_below: probability"),
        (lambda o: o.tracking(joints=[True, 1]), "tracking: joints.*cannot be mixed"),
        (lambda o: o.tracking(joints=True), "tracking: joints"),
        (lambda o: o.effort(joints=[1.0, 0.0]), r"effort: joints: got \[1.0.*weights="),
        (lambda o: o.effort(joints=np.array([0.5])), "effort: joints: got .*weights="),
        (lambda o: o.effort(joints=2.0), "effort: joints: got 2.0.*weights="),
        (lambda o: o.tracking(joints=[]), "tracking: joints.*at least one joint"),
        (lambda o: o.tracking(joints={0}), "tracking: joints"),
        (lambda o: o.tracking(weights=[[1.0]]), "tracking: weights"),
        (
            lambda o: o.peak_torque_below([1.0, 2.0], weights=[1.0, 2.0, 3.0]),
            "peak_torque_below: weights",
        ),
        (
            lambda o: o.peak_torque_below(5.0, weights=-1.0),
            "peak_torque_below: weights: got -1.*>= 0",
        ),
        (
            lambda o: o.tracking(weights=[0.0, 0.0]),
            "tracking: weights: got .*at least one weight > 0",
        ),
    ],
)
def test_errors_name_the_argument_of_the_function(call, message):
    with pytest.raises(ValueError, match=message) as caught:
        call(ij.objectives)
    assert "Peak." not in str(caught.value) and "Term." not in str(caught.value)


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (
            lambda o: o.tracking(joints=[0, 2]),
            "tracking: joints: got 2, expected an index from 0 to 1",
        ),
        (lambda o: o.tracking(joints=[1, 1]), "tracking: joints.*joint 1 twice.*weights="),
        (lambda o: o.tracking(joints=[True]), "tracking: joints.*2 truth values"),
        (lambda o: o.tracking(joints="joint 2"), "tracking: joints: got 'joint 2'.*Did you mean"),
        (lambda o: o.tracking(joints="2:"), "tracking: joints.*at least one joint"),
        (lambda o: o.tracking(weights=[1, 2, 3]), r"tracking: weights.*\(3,\)"),
        (
            lambda o: o.tracking() + o.peak_torque_below([1, 2, 3]),
            r"peak_torque_below: limit: got \[1. 2. 3.\].*2, one for each",
        ),
        (lambda o: o.tracking() + o.error_below(0.1, joints=3), "error_below: joints: got 3"),
    ],
)
def test_joints_that_the_robot_does_not_have(goal, message, paper):
    with pytest.raises(ValueError, match=message):
        ij.tune(paper, ["controller.k1"], goal(ij.objectives), **TUNING)


def test_the_name_of_a_requirement_calls_a_slice_joints():
    below = ij.objectives.error_below
    assert "of joints 0:2 <" in below(0.1, joints=slice(0, 2)).name
    assert "of joint 1 <" in below(0.1, joints=1).name


@pytest.mark.slow
def test_names_of_joints_become_indices():
    scenario = ij.presets.ur5()
    names = scenario.plant.joints
    goal = ij.objectives.tracking(joints=[names[1], names[4]]) + ij.objectives.peak_torque_below(
        [140, 27], joints=list(names[2:4])
    )
    known = for_scenario(goal, scenario)
    assert [quantity.joints for quantity in known.quantities] == [(1, 4), (2, 3)]
    assert (
        goal.requirements[0].name == f"peak torque of joints {names[2]}, {names[3]} < [140, 27] N m"
    )


WITH_JOINTS = FILE.replace('kind = "metric"', 'kind = "tracking"\n')


def test_a_tuning_file_selects_joints_by_name_index_and_slice(tmp_path):
    def loaded(words):
        (tmp_path / "tune.toml").write_text(WITH_JOINTS + words)
        return load_tuning_file(tmp_path / "tune.toml")["objective"].quantities[-1]

    assert loaded("joints = [1]").joints == (1,)
    assert loaded('joints = ["joint 0"]').joints == ("joint 0",)
    assert loaded('joints = "1:"').joints == ("1:",)
    limits = loaded(
        'weights = [1.0, 0.5]\n[[requirement]]\nkind = "peak_torque_below"\nlimit = [14.0, 2.0]'
    )
    np.testing.assert_allclose(1 / limits.weights, [14.0, 2.0])
    assert loaded("joints = [0, 1]").joints == (0, 1)
    with pytest.raises(ValueError, match=r"objective\[\d\].*joints.*weights="):
        loaded("joints = [1.0, 0.5]")


def test_a_result_that_was_saved_with_weights_as_joints_means_what_it_meant():
    """A file of the version before `weights`: tracking, peak_torque, a metric, and two
    requirements."""
    found = ij.load(
        Path(__file__).parents[1] / "data" / "tuning_before_weights.json"
    ).setup.objective
    weights = [np.asarray(quantity.weights).tolist() for quantity in found.quantities]
    assert weights == [[1.0, 0.25], [1.0, 3.0], [0.0, 2.0], [0.0, 1.0], 1.0]
    assert all(quantity.joints is None for quantity in found.quantities)


@pytest.mark.release
def test_tuning_and_a_front_under_limits_of_single_joints(paper, tmp_path):
    o = ij.objectives
    limits = [16.0, 14.0]
    goal = (
        o.tracking(joints=[0])
        + 0.1 * o.effort()
        + o.peak_torque_below(limits)
        + o.margin_above([0.02, 0.05])
    )
    best = ij.tune(
        paper,
        ["controller.k1", "controller.K2"],
        goal,
        effort=ij.tuning.Effort(iterations=25),
        **TUNING,
    )
    peaks = np.asarray(ij.simulate(best.scenario, duration=0.5, dt=1e-3).metrics.peak_torque)
    assert np.all(peaks < np.array(limits) * 1.001)
    assert "peak torque < [16, 14] N m" in str(best.report) and "% of its limit" in str(best.report)
    best.save(tmp_path / "tuned")
    again = ij.load(tmp_path / "tuned")
    assert jax.tree.structure(again.setup.objective) == jax.tree.structure(best.setup.objective)
    assert again.report.verdicts == best.report.verdicts
    pair = (o.tracking(joints=[0]), o.effort() + o.peak_torque_below(limits))
    front = ij.pareto(
        paper, ["controller.k1", "controller.K2"], pair, points=4, duration=0.5, dt=1e-3
    )
    for i in range(len(front)):
        assert np.all(
            np.asarray(ij.simulate(front.scenario(i), duration=0.5, dt=1e-3).metrics.peak_torque)
            < np.array(limits) * 1.001
        )
    ij.testing.check_objective(goal, scenario=paper, duration=0.5)
