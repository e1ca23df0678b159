"""Solvers of other libraries behind the same tuning problem."""

import importlib.util

import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax import objectives
from iblf_jax.tuning import CMAES, SOLVERS, DifferentialEvolution, TuningProblem, evaluation
from iblf_jax.tuning.evaluation import Evaluator
from iblf_jax.tuning.solvers.programme import INVALID_OBJECTIVE, Programme
from iblf_jax.tuning.solvers.sqp import TARGET_EXCESS

DERIVATIVES = ("slsqp", "trust-constr", "uno")
PACKAGES = {"cma": "cma", "optuna": "optuna", "uno": "unopy"}
GAINS = [ij.tunable(f"controller.{name}", tied=True) for name in ("k1", "K2")]
GAINS.append(ij.tunable("observer.kf", 1.0, 100.0, tied=True))
TIMING = {"duration": 0.4, "dt": 1e-3, "method": "euler"}
RUN = {**TIMING, "progress": False}
TORQUE = 0.9
"""Limits relative to the start."""
MARGIN = 0.99


@pytest.fixture(scope="module")
def reference(paper, goal):
    return ij.tune(paper, GAINS, goal, solver=ij.tuning.SQP(starts=1), **RUN)


@pytest.fixture(scope="module")
def before(paper):
    return ij.simulate(paper, **TIMING).metrics


@pytest.fixture(scope="module")
def goal(before):
    torque = TORQUE * float(np.max(before.peak_torque))
    margin = MARGIN * float(np.min(before.margin))
    wanted = objectives.tracking() + 0.3 * objectives.effort()
    return wanted + objectives.peak_torque_below(torque) + objectives.margin_above(margin)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*DERIVATIVES, "optuna"])
def test_it_reaches_the_optimum_and_keeps_the_requirements(paper, before, goal, reference, name):
    """Those without derivatives share what keeps requirements; `test_small_loop` has the others."""
    pytest.importorskip(PACKAGES.get(name, "scipy"))
    solver = ij.tuning.TrustConstr(starts=1) if name == "trust-constr" else name  # it takes long
    best = ij.tune(paper, GAINS, goal, solver=solver, **RUN)
    within = 1.005 if name in DERIVATIVES else 1.02
    assert best.optimiser == name and best.objective <= within * reference.objective
    after = ij.simulate(best.scenario, **TIMING).metrics
    assert np.max(after.peak_torque) <= TORQUE * np.max(before.peak_torque)
    assert np.min(after.margin) >= MARGIN * np.min(before.margin)
    tracking = np.sum(after.ise) / np.sum(before.ise)
    effort = float(after.effort / before.effort)
    np.testing.assert_allclose(best.objective, tracking + 0.3 * effort, rtol=1e-6)


OF_RUNS = {"perturbations": {"plant.mass": ij.factor(ij.uniform(0.8, 1.2))}, "runs": 8}


@pytest.fixture(scope="module")
def programmes(paper, before, goal):
    """Name -> a programme and its problem, at the start."""
    worst = objectives.peak_torque_below(float(np.max(before.peak_torque)), allowed=0.25)
    # The margin at t = 0 may be at its limit, and cannot be moved inside.
    at_start = objectives.margin_above(float(np.min(before.margin)))
    tracking = objectives.tracking()
    found = {}
    for name, wanted, study in (
        ("pieces", goal, {}),
        ("worst runs", tracking + worst, OF_RUNS),
        ("margin at the start", tracking + at_start, {}),
    ):
        problem = TuningProblem.build(paper, GAINS, wanted, **TIMING, **study)
        problem = problem.for_solver(SOLVERS["slsqp"]())
        z = problem.box.z
        space = problem.search_space(10)
        evaluate = Evaluator(problem, problem.candidates(z[None]), "forward", space)
        found[name] = Programme(evaluate, 0, z), problem
    return found


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pieces", "worst runs"])
def test_its_gradients_are_those_of_its_values(programmes, kind):
    programme, _ = programmes[kind]
    z = programme.z + np.array([0.1, -0.05, 0.02])
    assert programme.constraints > 0
    gradient, jacobian = programme.gradient(z), programme.jacobian(z)
    for i, direction in enumerate(np.eye(len(z))):
        ends = [z + 1e-5 * direction, z - 1e-5 * direction]
        up, down = (programme.objective(end) for end in ends)
        np.testing.assert_allclose(gradient[i], (up - down) / 2e-5, rtol=2e-4, atol=1e-6)
        up, down = (programme.excess(end) for end in ends)
        slopes = (up - down) / 2e-5
        # The sample at which a peak is largest may change between the two points.
        assert np.mean(np.isclose(jacobian[:, i], slopes, rtol=1e-3, atol=1e-4)) > 0.9


@pytest.mark.slow
def test_constraints_are_excesses_that_gains_change_and_finite(programmes, monkeypatch):
    programme, problem = programmes["worst runs"]
    z = programme.z + 0.3
    value = evaluation.values(problem, z[None])
    assert programme.constraints == 1
    np.testing.assert_allclose(programme.excess(z), value.exact_excess[0] + TARGET_EXCESS)
    programme, problem = programmes["margin at the start"]
    assert programme.constraints < sum(problem.piece_counts)
    assert np.all(np.any(np.abs(programme.jacobian(programme.z)) > 0, axis=1))
    programme, _ = programmes["pieces"]
    real = programme.evaluate

    class Diverged:
        active = real.active

        def __call__(self, z):
            found = real(z)
            no = found.value._replace(loss=np.array([np.inf]), valid=np.array([False]))
            return found._replace(value=no, gradient=np.nan * found.gradient)

    monkeypatch.setattr(programme, "evaluate", Diverged())
    z, best = programme.z + 0.2, programme.best[1].tolist()
    count = programme.constraints
    assert programme.objective(z) == INVALID_OBJECTIVE
    np.testing.assert_array_equal(programme.excess(z), np.ones(count))
    np.testing.assert_array_equal(programme.jacobian(z), np.zeros((count, len(z))))
    assert np.all(programme.gradient(z) == 0) and programme.best[1].tolist() == best


@pytest.mark.slow
@pytest.mark.parametrize("make", [DifferentialEvolution, CMAES])
def test_a_search_that_was_stopped_goes_on_to_the_same_result(paper, goal, tmp_path, make):
    pytest.importorskip(PACKAGES.get(make.name, "scipy"))
    options = {**RUN, "solver": make(population=8), "effort": ij.tuning.Effort(iterations=5)}

    def stop(search):
        if search.state.iteration == 3:
            raise InterruptedError

    file = tmp_path / "state.npz"
    with pytest.raises(InterruptedError):
        ij.tune(paper, GAINS, goal, checkpoint=file, **options | {"progress": stop})
    resumed = ij.tune(paper, GAINS, goal, checkpoint=file, **options)
    whole = ij.tune(paper, GAINS, goal, **options)
    np.testing.assert_array_equal(resumed.history["z"], whole.history["z"])
    assert resumed.objective == whole.objective and resumed.probes == whole.probes


@pytest.mark.parametrize("name", sorted(PACKAGES))
def test_a_missing_package_is_named_with_its_extra(monkeypatch, name):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=rf'{PACKAGES[name]} .*pip install "iblf_jax\[tuning\]"'):
        SOLVERS[name]()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: DifferentialEvolution(population=4), "population: got 4"),
        (lambda: ij.tuning.Optuna(sampler="grid"), "sampler: got 'grid', expected one of 'tpe'"),
        (lambda: SOLVERS["uno"](preset="knitro"), "preset: got 'knitro'"),
        (lambda: CMAES(step_size=-1.0), "step_size: got -1"),
    ],
)
def test_wrong_options_are_named(make, words):
    with pytest.raises(ValueError, match=words):
        make()
