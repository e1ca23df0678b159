"""Tuning of many numbers: reverse mode, L-BFGS, optimisers of optax and mini-batches of runs."""

import types

import jax.numpy as jnp
import numpy as np
import optax
import pytest

import iblf_jax as ij
from iblf_jax import objectives
from iblf_jax.engine import thresholds
from iblf_jax.engine.derivatives import DerivativeSizes, choose_derivatives
from iblf_jax.tuning import LBFGS, Adam, Optax, SearchSpace, TuningProblem, evaluation
from iblf_jax.tuning.checkpoints import described_solver
from iblf_jax.tuning.evaluation import Derivatives, Value
from iblf_jax.tuning.parameters import Box
from iblf_jax.tuning.problem import Candidate
from iblf_jax.tuning.robust import Risk
from iblf_jax.tuning.solvers.optax_steps import CHECK_STEPS, runs_of_step

KNOTS = 52
DURATION = 0.4
DRAWS = {"plant.mass": ij.factor(ij.uniform(0.9, 1.1))}
RUN = {"duration": DURATION, "dt": 2e-3, "method": "heun", "perturbations": DRAWS, "runs": 3}
ENDS = {"controller.K": (1.0, 500.0), "controller.D": (0.1, 100.0)}
PATHS = [ij.tunable(path, *ends, scale="log") for path, ends in ENDS.items()]


@ij.component
class GainSchedule:
    """tau = G0 + K(t) (q_d - q) - D(t) (q' - q_d'), with gains that are linear between knots."""

    K: ij.Leaf = ij.leaf("N m/rad", sign="positive", shape="any")
    D: ij.Leaf = ij.leaf("N m s/rad", sign="positive", shape="any")

    def command(self, t, q, dq, f_hat, context, state):
        place = jnp.clip(t / DURATION, 0.0, 1.0) * (KNOTS - 1)
        weights = jnp.maximum(0.0, 1.0 - jnp.abs(place - np.arange(float(KNOTS))))
        tube, no = context.tube(t), jnp.zeros(q.shape, bool)
        tau = context.model.gravity(q) + (weights @ self.K) * (tube.q_d - q)
        tau = tau - (weights @ self.D) * (dq - tube.dq_d)
        return ij.controllers.Command(tau, tube.dq_d, 0.0 * q, no, no), ()


def goal():
    return objectives.tracking() + 0.1 * objectives.effort()


@pytest.mark.slow
def test_208_numbers_have_the_gradient_of_central_differences_and_are_tuned():
    law = GainSchedule(K=np.full((KNOTS, 2), 30.0), D=np.full((KNOTS, 2), 8.0))
    scheduled = ij.with_parts(ij.presets.zhang_yan_2024(law="pd"), controller=law)
    problem = TuningProblem.build(scheduled, PATHS, goal(), **RUN).for_solver(LBFGS())
    rng = np.random.default_rng(0)
    z = problem.box.z + 0.1 * rng.normal(size=problem.size)
    assert problem.size == 208
    gradient = evaluation.reverse_derivatives(problem, problem.candidates(z[None])).gradient[0]
    size, step = problem.size, 1e-4
    directions = np.concatenate([rng.normal(size=(2, size)), np.eye(size)[[3, 150]]])
    points = np.concatenate([z + step * directions, z - step * directions])
    losses = evaluation.values(problem, points).loss
    slopes = (losses[:4] - losses[4:]) / (2 * step)
    np.testing.assert_allclose(directions @ gradient, slopes, rtol=1e-5)
    options = RUN | {"report": ij.tuning.Report(runs=50), "effort": ij.tuning.Effort(iterations=8)}
    best = ij.tune(scheduled, PATHS, goal(), **options)
    assert (best.optimiser, best.mode) == ("lbfgs", "reverse")
    report = best.report
    objective = report.changes[0]
    assert objective.after < 0.8 * objective.before and objective.significant
    assert report.runs == 50 and report.violation[1].count == 0
    # Fewer than two gradients an iteration.
    assert best.evaluations < 16 and len(best.tuned) == 208
    assert np.ptp(np.asarray(best.scenario.controller.K / scheduled.controller.K)) > 0.1


@pytest.mark.slow
def test_both_modes_have_the_same_gradient_of_a_sampled_loop_with_noise_and_a_requirement(paper):
    sensor = ij.sensors.Encoder(noise=1e-4, velocity=ij.sensors.Measured(noise=1e-3))
    scenario = ij.with_parts(paper, sensor=sensor, sampling=ij.Sampling(2e-3))
    gains, wanted = ["controller.K2", "controller.k1"], goal() + objectives.peak_torque_below(5.0)
    options = {"duration": 0.1, "dt": 1e-3, "method": "euler", "perturbations": DRAWS, "runs": 3}
    problem = TuningProblem.build(scenario, gains, wanted, **options).for_solver(LBFGS())
    candidates = problem.candidates(problem.box.z[None])
    reverse = evaluation.reverse_derivatives(problem, candidates)
    forward = evaluation.forward_derivatives(problem, candidates)
    np.testing.assert_allclose(reverse.gradient, forward.gradient, rtol=1e-10)
    np.testing.assert_allclose(reverse.value.loss, forward.value.loss, rtol=1e-12)


class Bowls:
    """An evaluator of the mean of |z - c_b|^2 over runs b, as `tuning.evaluation.Evaluator`."""

    def __init__(self, runs=12, risk="mean", iterations=60):
        self.centres = np.random.default_rng(3).normal(size=(runs, 2))
        box = Box(np.zeros(2), np.full(2, -np.inf), np.full(2, np.inf))
        constraints = SearchSpace(box).constraints._replace(runs=runs)
        self.space = SearchSpace(box, constraints, iterations=iterations)
        options = types.SimpleNamespace(seed=np.uint32(7), risk=Risk(risk))
        self.problem = types.SimpleNamespace(options=options, runs=runs)
        index = np.arange(runs, dtype=np.uint32)[None]
        self.candidates = Candidate(np.zeros((1, 2)), index, *[np.zeros((1, 0))] * 3)
        self.active = np.ones(1, bool)
        self.evaluated_runs = []

    def _value(self, z, runs):
        loss = np.sum((z[:, None] - self.centres[runs]) ** 2, axis=2).mean(axis=1)
        empty = z[:, :0]
        valid = np.isfinite(loss)
        return Value(np.where(valid, loss, np.inf), loss, empty, empty, empty, loss, valid, loss)

    def values(self, z):
        return self._value(z, np.arange(len(self.centres)))

    def __call__(self, z):
        runs = self.candidates.index[0]
        self.evaluated_runs.append(runs)
        gradient = 2 * (z - self.centres[runs].mean(axis=0))
        return Derivatives(self._value(z, runs), gradient, np.zeros((len(z), 2, 2)))


def steps(solver, evaluate, state, count):
    found = [solver.step(evaluate, state, solver.tolerance) for _ in range(count)]
    return np.concatenate([z for z, _ in found]), [x.value for _, x in found]


def test_an_epoch_goes_through_the_runs_and_resampled_runs_do_not_choose_the_result():
    epoch = [runs_of_step(12, 4, 5, number) for number in range(3)]
    assert sorted(np.concatenate(epoch)) == list(range(12))
    following = [runs_of_step(12, 4, 5, number) for number in range(3, 6)]
    assert sorted(np.concatenate(following)) == list(range(12))
    assert any(list(a) != list(b) for a, b in zip(epoch, following, strict=True))
    assert all(len(runs_of_step(10, 4, 5, number)) == 4 for number in range(9))
    solver = Adam(resample=True)
    evaluate = Bowls()
    own = evaluate.candidates
    evaluate.candidates = own._replace(index=own.index[:, ::-1][:, :4])
    z, found = steps(solver, evaluate, solver.init(evaluate.space, np.ones((1, 2))), 2)
    assert [bool(value.valid[0]) for value in found] == [True, False]
    assert found[0].loss == evaluate.values(z[:1]).loss


@pytest.mark.slow
@pytest.mark.parametrize("solver", [Adam(0.2, batch=4), Optax(optax.sgd(0.05), batch=4)])
def test_a_mini_batch_finds_the_optimum_of_all_runs_and_values_compare_all_of_them(solver):
    evaluate = Bowls(iterations=70)
    z, found = steps(solver, evaluate, solver.init(evaluate.space, np.full((1, 2), 3.0)), 70)
    assert np.max(np.abs(z[-1] - evaluate.centres.mean(axis=0))) < 0.15
    assert {len(runs) for runs in evaluate.evaluated_runs} == {4}
    valid = [number for number, value in enumerate(found) if value.valid[0]]
    assert valid == sorted({*range(0, 70, CHECK_STEPS), 69})
    for number in valid:
        assert found[number].loss == evaluate.values(z[number : number + 1]).loss
    assert evaluate.candidates.index.shape == (1, 12)


@pytest.mark.parametrize(
    ("solver", "words"),
    [
        (lambda: Adam(batch=13), "12"),
        (lambda: Adam(batch=4, resample=True), "resample"),
        (lambda: Optax("lion"), "optax.GradientTransformation"),
        (lambda: Optax(optax.lbfgs()), "LBFGS"),
        (lambda: Optax(optax.add_noise(0.1, 0.5, key=1)), "random key"),
    ],
)
def test_options_that_do_not_fit_are_refused(solver, words):
    with pytest.raises(ValueError, match=words):
        solver().init(Bowls().space, np.zeros((1, 2)))


@pytest.mark.parametrize("risk", ["worst", "cvar"])
def test_a_mini_batch_without_the_worst_runs_warns(risk):
    solver, evaluate = Adam(batch=4), Bowls(risk=risk)
    with pytest.warns(UserWarning, match="batch=4"):
        solver.step(evaluate, solver.init(evaluate.space, np.ones((1, 2))), 0.0)


def test_a_checkpoint_knows_the_numbers_of_an_optimiser():
    for make, *numbers in [
        (lambda x: optax.chain(optax.clip(1.0), optax.lion(x)), 1e-3, 2e-3),
        (lambda x: optax.adagrad(0.1, initial_accumulator_value=x), 0.1, 0.5),
        (lambda x: optax.inject_hyperparams(optax.adam)(x), 0.1, 0.2),
    ]:
        one, again, other = (described_solver(Optax(make(x)), 60) for x in (numbers[0], *numbers))
        assert one == again != other


@pytest.mark.slow
def test_a_tuning_by_mini_batches_continues_from_a_checkpoint(paper, tmp_path):
    solver = Optax(optax.chain(optax.clip_by_global_norm(1.0), optax.lion(0.1)), batch=4)
    options = RUN | {"duration": 0.2, "method": "euler", "runs": 8}

    def tuned(iterations, checkpoint=None):
        search = {"effort": ij.tuning.Effort(iterations=iterations), "checkpoint": checkpoint}
        search |= {"solver": solver, "progress": False}
        return ij.tune(paper, ["controller.K2"], goal(), **search, **options)

    complete = tuned(12)
    tuned(6, tmp_path / "search.npz")
    resumed = tuned(12, tmp_path / "search.npz")
    np.testing.assert_array_equal(resumed.history["z"], complete.history["z"])
    assert complete.objective < complete.history["objective"][0, 0]
    # The objective of the result is that of all runs.
    problem = TuningProblem.build(paper, ["controller.K2"], complete.setup.objective, **options)
    here = evaluation.values(problem, np.log(complete.tuned)[None])
    np.testing.assert_allclose(complete.objective, here.objective[0], rtol=1e-9)


@pytest.mark.parametrize(
    ("columns", "kept", "order", "reverses", "expected"),
    [
        (thresholds.MAX_COLUMNS, 0, 1, True, "one per run"),
        (thresholds.MAX_COLUMNS + 1, 0, 1, True, "reverse"),
        (thresholds.MAX_COLUMNS + 1, 0, 1, False, "scan"),
        (1, thresholds.MAX_KEPT_NUMBERS + 1, 1, True, "reverse"),
        (1, thresholds.MAX_KEPT_NUMBERS + 1, 1, False, "scan"),
        (1, 0, thresholds.MAX_COLUMN_ORDER + 1, True, "scan"),
    ],
)
def test_many_numbers_are_differentiated_in_reverse_mode(columns, kept, order, reverses, expected):
    """And no kernel is built that writes out large arrays."""
    sizes = DerivativeSizes(lambda: kept, order=order, columns=columns, reverses=reverses)
    assert choose_derivatives(sizes) == expected
    for share, kind in ((1.0, "together"), (1.01, "scan")):
        sizes = {"nodes_together": 20_000, "max_nodes": 150_000}
        sizes["nodes_per_operation"] = share * thresholds.MAX_NODES_PER_OPERATION
        assert choose_derivatives(DerivativeSizes(lambda: 0, **sizes)) == kind
