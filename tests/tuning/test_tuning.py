"""Gain tuning: derivatives, objectives, coordinates, the loop, and the truth of its report."""

import dataclasses
import inspect
import itertools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.core import checks
from iblf_jax.engine import RunRequest
from iblf_jax.engine.batch import Batch, carry_shapes
from iblf_jax.engine.carry import Inputs
from iblf_jax.engine.step_size import fastest_along
from iblf_jax.engine.transformable import run_transformable
from iblf_jax.files.tuning import load_tuning_file
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.metrics import standard
from iblf_jax.simulation.scenario import canonical
from iblf_jax.tuning import LBFGS, SQP, Adam, Report, _tune, evaluation, starts
from iblf_jax.tuning.checkpoints import load_checkpoint, save_checkpoint
from iblf_jax.tuning.conflicts import conflicts_in_words
from iblf_jax.tuning.evaluation import Derivatives, Evaluator, Value
from iblf_jax.tuning.options import TuningRunOptions
from iblf_jax.tuning.parameters import Box, layout, squash, unsquash
from iblf_jax.tuning.problem import Candidate, TuningProblem
from iblf_jax.tuning.quantities import Peak, Quantities, TimeIntegral
from iblf_jax.tuning.ranges import BY_STEP, BY_THEOREM, STABILITY_FRACTION, TIMES, TOGETHER
from iblf_jax.tuning.result import STUCK
from iblf_jax.tuning.robust import Risk, combine
from iblf_jax.tuning.rollouts import fold_of
from iblf_jax.tuning.runs import in_groups
from iblf_jax.tuning.search import REPAIR, SECOND_SEARCH, Search, SearchState, Strategy
from iblf_jax.tuning.solvers import Constraints, SearchSpace, quadratic, sqp
from iblf_jax.tuning.solvers.sqp import subproblem
from iblf_jax.tuning.starts import (
    FAR,
    NEAR,
    Screening,
    distinct,
    number_of_starts,
    ranked,
    screened,
    spread_points,
)

jax.config.update("jax_enable_x64", True)

objectives = ij.objectives
SHORT = {"duration": 0.3, "dt": 1e-3, "method": "euler"}
GAINS = ["controller.k1", "controller.K2", "observer.kf"]
DRAWS = {
    "plant.mass[1]": ij.factor(ij.uniform(0.7, 1.3)),
    "initial.q": ij.offset(ij.uniform(-0.03, 0.03)),
}


def objective():
    return objectives.tracking() + 0.5 * objectives.effort() + 10 * objectives.peak_torque()


@pytest.fixture(scope="module")
def paper():
    return ij.presets.zhang_yan_2024()


@pytest.fixture(scope="module")
def nominal(paper):
    return TuningProblem.build(paper, GAINS, objective(), **SHORT)


def central(f, z, h=1e-5):
    return np.stack([(f(z + h * e) - f(z - h * e)) / (2 * h) for e in np.eye(len(z))])


# ----------------------------------------------------------------------------------- derivatives


@pytest.mark.slow
def test_forward_and_reverse_equal_finite_differences(nominal):
    z = nominal.box.z
    candidates = nominal.candidates(z[None])
    forward = evaluation.forward_derivatives(nominal, candidates)
    reverse = evaluation.reverse_derivatives(nominal, candidates)

    def loss(z):
        return np.asarray(evaluation.value(nominal, nominal.candidates(z[None])).loss[0])

    expected = central(loss, z)
    scale = np.max(np.abs(expected))
    assert np.max(np.abs(forward.gradient[0] - expected)) < 1e-6 * scale
    assert np.max(np.abs(reverse.gradient[0] - expected)) < 1e-6 * scale
    np.testing.assert_allclose(forward.gradient, reverse.gradient, rtol=1e-8, atol=1e-10 * scale)
    np.testing.assert_allclose(forward.value.loss, reverse.value.loss, rtol=1e-12)


@pytest.mark.slow
def test_the_gauss_newton_matrix_is_that_of_the_signals(paper, nominal):
    """The matrix of int |e1|^2 is 2 sum dt e1_u . e1_v (trapezoidal rule), with e1_u by finite
    differences of recorded runs."""
    candidates = nominal.candidates(nominal.box.z[None])
    found = evaluation.forward_derivatives(nominal, candidates)

    def errors(z):
        values = {p.path: np.exp(z[p.start : p.start + p.size]) for p in nominal.blocks}
        return np.asarray(ij.simulate(ij.with_parameters(paper, values), **SHORT).e1)

    J = central(errors, nominal.box.z)
    weights = np.full(J.shape[1], SHORT["dt"])
    weights[[0, -1]] /= 2
    expected = 2 * np.einsum("utn,t,vtn->uv", J, weights, J)
    only = ij.objectives.Objective((nominal.objective.terms[0],))
    single = dataclasses.replace(
        nominal, objective=only, piece_counts=(1, nominal.piece_counts[-1])
    )
    one = evaluation.forward_derivatives(single, candidates._replace(weights=np.ones((1, 1))))
    np.testing.assert_allclose(
        one.hessian[0] * only.terms[0].scale, expected, rtol=1e-5, atol=1e-9 * np.max(expected)
    )
    assert np.all(np.isfinite(found.hessian))


@pytest.mark.slow
def test_reverse_mode_remembers_few_states(paper):
    """Temporary memory of the gradient by the scan grows like the cube root of the number of steps,
    and stays below 2 sqrt(T) states.  (That of kernels: `tests/engine/test_adjoint.py`.)"""
    sizes = {}
    for steps in (500, 4000):
        built = TuningProblem.build(
            paper, GAINS, objective(), **{**SHORT, "duration": steps * 1e-3}, backend="vmap"
        )
        compiled = evaluation.reverse_derivatives.lower(
            built, built.candidates(built.box.z[None])
        ).compile()
        sizes[steps] = compiled.memory_analysis().temp_size_in_bytes
    folds = fold_of(built.objective, jnp.float64)
    inputs = Inputs(canonical(paper), folds, built.dt, built.dt)
    state = sum(
        x.size * x.dtype.itemsize
        for x in jax.tree.leaves(carry_shapes(Batch.of(inputs, None), "rk4"))
    )
    assert sizes[4000] - sizes[500] < 2 * (np.sqrt(4000) - np.sqrt(500)) * state


# ------------------------------------------------------------------------------------ quantities


@pytest.mark.slow
def test_quantities_are_what_numpy_makes_of_the_records(paper):
    parts = (
        TimeIntegral("error", weights=[1.0, 2.0], after=0.1),
        TimeIntegral("torque"),
        TimeIntegral("torque_rate"),
        TimeIntegral("outside", tolerance=0.05),
        Peak(10.0, "torque"),
        Peak(0.1, "deficit", smoothing=0.05, windows=[0.1, 0.2]),
        Peak(0.1, "error", after=0.1),
    )
    run = ij.simulate(paper, metrics=(Quantities(parts),), **SHORT)
    e1, tau, t = (np.asarray(x) for x in (run.e1, run.tau, run.t))
    margin = np.minimum(run.q - run.lower, run.upper - run.q)
    dt = SHORT["dt"]
    expected = [
        np.trapezoid((e1 * [1.0, 2.0])[t >= 0.1 - 1e-9] ** 2, dx=dt, axis=0).sum(),
        np.trapezoid(tau**2, dx=dt, axis=0).sum(),
        np.sum(np.diff(tau, axis=0) ** 2) / dt,
        np.trapezoid(1 / (1 + np.exp(-(np.abs(e1) - 0.05) / 0.005)), dx=dt, axis=0).sum(),
        np.max(np.abs(tau)),
        -np.min(margin),
        np.max(np.abs(e1[t >= 0.1 - 1e-9])),
    ]
    np.testing.assert_allclose(run.metrics["tuning_exact"], expected, rtol=1e-9)
    T = 0.1 * 0.05
    edges = [0.0, *np.asarray(parts[5].windows), np.inf]
    both = np.concatenate([run.lower - run.q, run.q - run.upper], axis=1)
    pieces = np.stack(
        [
            np.max(both[(t >= a - 1e-9) & (t < b - 1e-9)], axis=0)
            for a, b in itertools.pairwise(edges)
        ]
    )
    np.testing.assert_allclose(
        run.metrics["tuning_smooth"][5], T * np.logaddexp.reduce(np.ravel(pieces) / T), rtol=1e-9
    )
    first = 4 + 4  # the integrals, one each, and the torque of two joints with both signs
    np.testing.assert_allclose(
        run.metrics["tuning_pieces"][first : first + 12], pieces.ravel(), rtol=1e-9
    )
    assert np.all(
        np.asarray(run.metrics["tuning_smooth"])[4:] >= np.asarray(run.metrics["tuning_exact"])[4:]
    )


def test_objectives_compose_and_messages_name_the_mend():
    both = 2 * (
        objectives.tracking(scale=1.0) + 3 * objectives.effort(scale=2.0)
    ) + objectives.margin_above(0.05)
    assert [t.name for t in both.terms] == ["tracking", "effort"]
    assert [float(t.weight) for t in both.terms] == [2.0, 6.0]
    assert [r.name for r in (objectives.error_below(0.01, after=1.0) + both).requirements] == [
        "|e1| < 0.01 rad after 1 s",
        "margin > 0.05 rad",
    ]
    np.testing.assert_allclose(both.values(jnp.array([1.0, 4.0, 0.0])), [2.0, 12.0])
    assert float(both.excesses(jnp.array([1.0, 4.0, -0.06]))[0]) == pytest.approx(-0.2)
    with pytest.raises(ValueError, match="an objective or a requirement"):
        objectives.tracking() + 3


def test_risks():
    losses = jnp.arange(10.0)
    assert float(combine(Risk("mean"), losses)) == 4.5
    assert float(combine(Risk("worst"), losses)) == 9.0
    assert float(combine(ij.cvar(0.8), losses)) == 8.5
    with pytest.raises(ValueError, match="between 0 and 1"):
        ij.cvar(1.0)


# ----------------------------------------------------------------------------------- coordinates


def test_bijections_keep_inside_and_invert():
    box = Box(
        np.zeros(4), np.array([-1.0, 0.0, -np.inf, -np.inf]), np.array([2.0, np.inf, 3.0, np.inf])
    )
    z = np.array([0.5, 0.7, 1.0, -5.0])
    np.testing.assert_allclose(squash(jnp.asarray(unsquash(z, box)), box), z, rtol=1e-12)
    for w in (-50.0, 50.0):
        inside = np.asarray(squash(jnp.full(4, w), box))
        assert np.all(inside >= box.low)
        assert np.all(inside <= box.high)


@pytest.mark.slow
def test_default_limits_keep_the_conditions_and_the_step(paper):
    blocks, box = layout(
        canonical(paper), [*GAINS, ij.tunable("controller.o", tied=True)], 1e-3, "rk4"
    )
    low, high = np.exp(box.low), np.exp(box.high)
    assert [b.path for b in blocks] == [*GAINS, "controller.o"]
    assert blocks[-1].size == 1
    assert np.all(low[:2] > 0)
    assert np.all(low[2:4] > 0.5)
    assert np.all(low[4:6] > 1.0)
    run = ij.simulate(ij.with_parameters(paper, {"controller.K2": high[2:4]}), duration=0.2)
    assert run.ok
    assert 1e-3 * float(run.fastest_mode) > 1.2
    # Together they keep to the same share of the step, which each one would leave free to a
    # larger range.
    together = ij.with_parameters(
        paper, {b.path: high[b.start : b.start + b.size] for b in blocks[:3]}
    )
    mode = 1e-3 * fastest_along(canonical(together), TIMES)
    assert mode == pytest.approx(STABILITY_FRACTION * tableau("rk4").stability, rel=0.01)
    _, single = layout(canonical(paper), ["controller.K2"], 1e-3, "rk4")
    assert np.all(np.exp(single.high) > 1.001 * high[2:4])
    assert box.reasons[0] == (BY_THEOREM, BY_STEP + TOGETHER) and single.reasons[0] == (
        BY_THEOREM,
        BY_STEP,
    )
    with pytest.raises(ValueError, match="do not overlap"):
        layout(canonical(paper), ["controller.K2", "controller.K2[0]"], 1e-3, "rk4")
    with pytest.raises(ValueError, match="Widen the limits"):
        layout(canonical(paper), [ij.tunable("controller.k1", 3.0, 4.0)], 1e-3, "rk4")


def test_a_quadratic_programme_is_solved_with_its_multipliers():
    rng = np.random.default_rng(0)
    programmes = []
    for rows in range(20):  # of several shapes
        root, c, A = rng.normal(size=(3, 5)), rng.normal(size=5), rng.normal(size=(rows, 5))
        H, A, b = (
            root.T @ root,
            np.concatenate([A, np.eye(5), -np.eye(5)]),
            np.concatenate([rng.uniform(0.1, 1, rows), np.full(10, 0.5)]),
        )
        programmes.append(quadratic.Programme(H, c, A, b))
    for (H, c, A, b), (x, y) in zip(programmes, quadratic.solve(programmes), strict=True):
        slack = b - A @ x
        np.testing.assert_allclose(H @ x + c + A.T @ y, 0.0, atol=1e-8)
        assert np.all(slack > -1e-9) and np.all(y >= 0) and np.max(y * slack) < 1e-8


SQUARE = Box(np.zeros(2), np.full(2, -4.0), np.full(2, 4.0))


class Evaluated:
    """What a solver needs of an evaluator, around a function of z."""

    def __init__(self, function, space, starts=1):
        self.function, self.space = function, space
        self.active = np.ones(starts, bool)

    def __call__(self, z):
        return self.function(z)


def steps_of_sqp(function, space, start, steps, tolerance):
    """The state of one start after some steps; one that has converged goes no further."""
    solver, evaluate = SQP(tolerance=tolerance), Evaluated(function, space)
    state = solver.init(space, np.array([start]))
    for _ in range(steps):
        solver.step(evaluate, state, tolerance)
        evaluate.active = ~solver.converged(state)
        if not evaluate.active.any():
            break
    return state[0]


class TwoPieces:
    """An evaluator of (z0 - 2)^2 + (z1 - 2)^2 with g = the larger of z0^2 + z1^2 - 1 and z0 -
    `most`, in each of two runs, the second of which is further from its limit."""

    def __init__(self, most):
        self.most = most

    def __call__(self, z):
        loss, slope, none = np.sum((z - 2) ** 2, axis=1), 2 * (z - 2), z[:, :0]
        g = np.stack([np.sum(z**2, axis=1) - 1, z[:, 0] - self.most], axis=1)
        a = np.stack([2 * z, np.stack([np.ones(len(z)), np.zeros(len(z))], axis=1)], axis=2)
        value = Value(loss, loss, loss[:, None], none, none, loss, loss < np.inf, none)
        two = np.stack([g, g - 0.5], axis=1), np.stack([a, a], axis=1)
        return Derivatives(value, slope, np.broadcast_to(2 * np.eye(2), (len(z), 2, 2)), *two)


@pytest.mark.parametrize(
    ("share", "shift"), [(0.0, 0.0), (1.0, 0.25)], ids=["every run", "the mean of both"]
)
@pytest.mark.parametrize("most", [0.2, 5.0], ids=["corner", "circle"])
def test_pieces_that_bind_are_found_with_their_multipliers(most, share, shift):
    """The optimum on a circle, and at the corner of a circle and a line; moved outwards where the
    mean of two runs counts."""
    box = Box(np.zeros(2), np.full(2, -4.0), np.full(2, 4.0))
    space = SearchSpace(box, Constraints.of((2,), (share,), 2))
    state = steps_of_sqp(TwoPieces(most), space, [3.0, -1.0], 12, 1e-10)
    radius, x = np.sqrt(1 + shift), most + shift
    point = (
        np.array([x, np.sqrt(radius**2 - x**2)])
        if x < radius / np.sqrt(2)
        else np.full(2, radius / np.sqrt(2))
    )
    np.testing.assert_allclose(state.z, point, atol=2e-5)
    gradients = np.array([2 * point, [1.0, 0.0]]).T
    y = np.linalg.lstsq(
        gradients if x < radius / np.sqrt(2) else gradients[:, :1], 2 * (2 - point), rcond=None
    )[0]
    assert state.multipliers[0] == pytest.approx(y.sum(), rel=1e-3)
    assert state.done and np.all(state.residuals < 1e-3)


def test_curvature_is_kept_for_the_worst_pieces_of_many(monkeypatch):
    """With room for one piece a requirement the one that leaves is forgotten, and the optimum is
    found all the same."""
    monkeypatch.setattr(sqp, "MAX_CURVATURES", 1)
    space = SearchSpace(SQUARE, Constraints.of((2,), (0.0,), 2))
    state = steps_of_sqp(TwoPieces(5.0), space, [3.0, -1.0], 20, 1e-10)
    assert state.curvatures.shape == (1, 2, 2)
    np.testing.assert_allclose(state.z, np.full(2, 0.5**0.5), atol=2e-5)
    np.testing.assert_array_equal(state.curved, np.argmax(state.here.pieces))


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["a slope", "a slope that points the wrong way"])
def test_a_region_that_has_collapsed_is_no_optimum(sign):
    """|z|^2 with its gradient, and with the opposite one: no decrease is predicted there, however
    short the step."""

    def evaluate(z):
        value = Value(np.sum(z**2, axis=1))
        return Derivatives(value, 2 * sign * z, np.zeros((len(z), 2, 2)))

    state = steps_of_sqp(evaluate, SearchSpace(SQUARE), [3.0, -1.0], 40, 1e-6)
    assert state.done
    if sign > 0:
        np.testing.assert_allclose(state.z, 0.0, atol=1e-3)
        assert state.residuals[0] < 1e-3
    else:
        assert state.residuals[0] > 1.0


def test_limits_that_cannot_be_kept_are_broken_as_little_as_can_be():
    """The circle and z0 > 1.5, another requirement: between them the sum of both is least at the
    end of the circle."""

    class Both(TwoPieces):
        def __call__(self, z):
            found = super().__call__(z)
            found.pieces[:, :, 1] = 1.5 - z[:, :1]
            found.piece_gradients[:, :, :, 1] = np.array([-1.0, 0.0])
            return found

    space = SearchSpace(SQUARE, Constraints.of((1, 1), (0.0, 0.0), 2))
    state = steps_of_sqp(Both(5.0), space, [0.3, -0.7], 40, 1e-8)
    assert state.done
    np.testing.assert_allclose(state.z, [1.0, 0.0], atol=1e-4)
    assert state.residuals[1] == pytest.approx(0.5, abs=1e-4)


class Valleys:
    """Seven coordinates and a requirement that does not bind; a broad valley at -1, a deeper one at
    1."""

    LOW, DEEP = 1.3, 1.0

    def __call__(self, z):
        a, b = self.LOW + np.sum((z + 1) ** 2, axis=1), self.DEEP + 3 * np.sum((z - 1) ** 2, axis=1)
        f, eye = np.minimum(a, b), np.eye(z.shape[1])
        gradient = np.where((a < b)[:, None], 2 * (z + 1), 6 * (z - 1))
        value = Value(
            f,
            f,
            f[:, None],
            -np.ones((len(z), 1)),
            -np.ones((len(z), 1)),
            np.ones(len(z)),
            np.ones(len(z), bool),
        )
        hessian = np.where((a < b)[:, None, None], 2 * eye, 6 * eye)
        return Derivatives(
            value, gradient, hessian, -np.ones((len(z), 1, 1)), np.zeros((len(z), 1, z.shape[1], 1))
        )


class Counted(Valleys):
    """As an `Evaluator`: only active starts are counted."""

    def __init__(self, space, starts):
        self.space = space
        self.evaluations, self.active = 0, np.ones(starts, bool)
        self.candidates = SimpleNamespace(
            index=np.zeros((starts, 1)), _replace=lambda **changes: self.candidates
        )
        self.problem = SimpleNamespace(
            allowed=(0.0,),
            objective=objectives.tracking(),
            box=space.box,
            blocks=(),
            size=len(space.box.z),
            options=SimpleNamespace(seed=0),
            sampled_too_slowly=lambda z: False,
        )

    def __call__(self, z):
        self.evaluations += int(self.active.sum())
        return super().__call__(z)

    def values(self, z):
        found = self(z).value
        self.on_values(z, found)
        return found


def test_points_are_spread_near_and_far_and_the_starts_differ():
    box = Box(np.full(7, -0.6), np.full(7, -4.0), np.full(7, 1.0))
    points = spread_points(box, 120, seed=0)
    distance = np.max(np.abs(points - box.z), axis=1)
    assert np.sum(distance <= NEAR) >= 40 and np.sum(distance <= FAR) >= 80
    at_ends = np.mean((points[2::3] == -4.0) | (points[2::3] == 1.0))
    assert 0.4 < at_ends < 0.6
    assert np.all(points <= 1.0)
    screening = ranked(points, Valleys()(points).value)
    order = screening.order()
    z = distinct(screening, [order], 5, box, lambda z: np.array_equal(z, points[order[0]]))
    assert not np.any(np.all(z == points[order[0]], axis=1))  # the best one is refused
    for i in range(5):
        for j in range(i):
            assert np.max(np.abs(z[i] - z[j])) >= 1.0


def test_a_search_from_several_starts_goes_on_in_the_deeper_valley():
    box = Box(np.full(7, -0.6), np.full(7, -4.0), np.full(7, 4.0))
    starts = np.stack([np.full(7, x) for x in (-1.6, -0.4, 0.5, 1.9)])
    evaluate = Counted(SearchSpace(box, Constraints.of((1,), (0.0,), 1)), 4)
    screening = ranked(starts, Valleys()(starts).value)
    search = Search(evaluate, SQP(), starts, Strategy(screening, selection=2, starts=len(starts)))
    assert search.run(60) == "converged"
    assert search.state.incumbent_key[1] == pytest.approx(Valleys.DEEP)
    np.testing.assert_allclose(search.state.incumbent_z, np.ones(7), atol=1e-3)
    assert search.state.retired.sum() >= 2 and search.state.phase == 0
    found = search.conditions()
    assert found.hold and np.max(np.abs(found.residuals)) < 1e-3


def test_a_second_search_begins_at_the_best_gains_and_at_the_best_points_around_them():
    box = Box(np.full(7, 0.5), np.full(7, -4.0), np.full(7, 4.0))
    starts = np.stack([np.full(7, x) for x in (0.5, 1.9)])
    evaluate = Counted(SearchSpace(box, Constraints.of((1,), (0.0,), 1)), 4)
    screening = ranked(starts, Valleys()(starts).value)
    strategy = Strategy(screening, 2, len(starts), second_points=60, second_starts=3)
    search = Search(evaluate, SQP(), starts[np.array([0, 1, 1, 1])], strategy)
    begun = []

    def note(search):
        if search.state.phase == SECOND_SEARCH:
            begun.append((search.history["z"][-1], search.state.best_key.copy()))

    assert search.run(60, note) == "converged"
    assert search.state.plain_values == 2 + 60
    z = begun[0][0]
    np.testing.assert_allclose(z[0], np.ones(7), atol=1e-3)
    distances = np.max(np.abs(z - z[0]), axis=1)
    assert np.all(distances[1:] >= 1.0) and np.all(np.isfinite(begun[0][1]))
    assert search.state.incumbent_key[1] == pytest.approx(Valleys.DEEP)


def test_starts_that_come_near_a_better_one_end_first_and_then_all_but_the_better_third():
    box = Box(np.full(7, -0.6), np.full(7, -4.0), np.full(7, 4.0))
    starts = np.random.default_rng(0).uniform(-4.0, 4.0, (12, 7))
    starts[1] = starts[0] + 0.1
    evaluate = Counted(SearchSpace(box, Constraints.of((1,), (0.0,), 1)), 12)
    strategy = Strategy(ranked(starts, Valleys()(starts).value), selection=2, starts=12)
    search = Search(evaluate, SQP(), starts, strategy)
    remaining, evaluations = [], []

    def note(search):
        remaining.append(int(np.sum(~search.state.retired)))
        evaluations.append(search.state.evaluations)

    search.run(60, note)
    assert remaining[:3] == [12, 11, 11] and remaining[3] <= 4
    assert evaluations[3] <= 2 * 12 + 2 * 11  # a start that is retired costs nothing


@pytest.mark.parametrize(
    ("starts", "runs", "solver", "expected"),
    [
        (32, 1, SQP(), 32),
        (32, 16, SQP(), 8),
        (32, 64, SQP(), 6),
        (96, 64, SQP(), 19),
        (4, 64, SQP(), 4),
        (32, 1, LBFGS(), 6),
    ],
)
def test_there_are_fewer_starts_where_each_takes_long(starts, runs, solver, expected):
    assert number_of_starts(starts, runs, solver) == expected


def test_starts_are_taken_from_rankings_with_several_weights_in_turn():
    """The point with the lowest objective breaks the requirement and is far down with weight
    200."""
    points = np.array([[0.0], [2.0], [4.0], [6.0]])
    excess = np.array([0.0, 0.0, 0.0, 0.05])
    objective = np.array([1.0, 1.1, 1.2, 0.5])
    screening = Screening(points, None, objective, excess)
    box = Box(np.zeros(1), np.full(1, -8.0), np.full(1, 8.0))
    orders = [screening.order(weight) for weight in (200.0, 1.0)]
    assert orders[0].tolist() == [0, 1, 2, 3] and orders[1].tolist() == [3, 0, 1, 2]
    z = distinct(screening, orders, 3, box, lambda z: False)
    assert z.ravel().tolist() == [0.0, 6.0, 2.0]
    z = distinct(screening, orders, 3, box, lambda z: z[0] == 6.0, others=np.array([[0.5]]))
    assert z.ravel().tolist() == [2.0, 4.0]


def test_requirements_that_no_gains_keep_are_named_alone_and_in_pairs(paper):
    names = ("torque", "margin", "rate")
    requirements = [SimpleNamespace(name=x, scale=10.0, measure=(1.0, "N m")) for x in names]
    goal = SimpleNamespace(requirements=requirements)
    problem = SimpleNamespace(objective=goal, scenario=paper)

    def words(excess, margin):
        count = len(excess)
        value = Value(np.zeros(count), exact_excess=np.array(excess), margin=np.array(margin))
        state = SearchState.first(None, np.zeros((1, 2)), 3)
        state.note_excess(value._replace(valid=np.arange(count) < 3))
        return conflicts_in_words(problem, state.least_excess)

    invalid = [-1.0, -1.0, -1.0]
    rows = [[-0.1, 0.3, 0.5], [0.2, -0.1, 0.4], [np.nan, -1.0, -1.0], invalid]
    alone, pair = words(rows, [0.01, 0.01, 0.01, 0.01])
    assert "keep rate, whatever" in alone and "by 4 N m or more" in alone
    assert "keep torque and margin together" in pair and "by 2 N m" in pair
    rows = [[0.1, -1.0, -1.0], [-1.0, 0.1, -1.0], [-1.0, -1.0, 0.1], invalid]
    (neither,) = words(rows, [0.01, 0.01, 0.01, 0.01])
    assert "every two requirements" in neither
    bounds = words(rows, [-0.02, -0.03, -0.04, 0.01])
    assert "keep the bounds, whatever" in bounds[0] and "by 0.02 rad or more" in bounds[0]


class Ring(Counted):
    """Feasible inside a small ball around 2 only, while the objective grows from 0: its minimum
    under a penalty of the requirement is elsewhere, as the excess is flat far away."""

    def __call__(self, z):
        self.evaluations += int(self.active.sum())
        size = z.shape[1]
        f, slope = 0.1 + np.sum(z**2, axis=1), 2 * z
        away = z - self.centre
        distance = np.sum(away**2, axis=1)
        excess = self.least + 1.0 - np.exp(-0.5 * distance)
        gradient = away * np.exp(-0.5 * distance)[:, None]
        valid = np.ones(len(z), bool)
        margin = np.ones(len(z))
        value = Value(f, f, f[:, None], excess[:, None], excess[:, None], margin, valid, margin)
        hessian = np.tile(2 * np.eye(size), (len(z), 1, 1))
        return Derivatives(value, slope, hessian, excess[:, None, None], gradient[:, None, :, None])


@pytest.mark.parametrize(("least", "feasible"), [(-0.01, True), (0.2, False)])
def test_the_excess_alone_is_minimised_before_requirements_are_called_infeasible(least, feasible):
    box = Box(np.full(3, -2.0), np.full(3, -4.0), np.full(3, 4.0))
    evaluate = Ring(SearchSpace(box, Constraints.of((1,), (0.0,), 1)), 3)
    evaluate.centre, evaluate.least = np.full(3, 1.5), least
    starts = np.stack([np.full(3, x) for x in (-3.0, -2.0, 0.3)])
    screening = ranked(starts, evaluate(starts).value)
    search = Search(evaluate, SQP(), starts, Strategy(screening, selection=2, starts=len(starts)))
    search.run(40)
    assert search.is_violated is not feasible
    if feasible:
        np.testing.assert_allclose(search.state.incumbent_z, evaluate.centre, atol=0.2)
        return
    assert search.state.phase == REPAIR
    assert search.state.incumbent_key[0] == pytest.approx(least, abs=1e-3)
    assert search.conditions().residuals[1] == pytest.approx(least, abs=1e-3)


class Roof(Counted):
    """|z|^2 above a roof: one piece, the largest of two slopes that meet at z0 = 0 and z1 = 1, with
    the gradient of the larger one."""

    sign = 1.0

    def __call__(self, z):
        self.evaluations += int(self.active.sum())
        f = np.sum(z**2, axis=1)
        side = np.where(z[:, :1] > 0, 1.0, -1.0)
        slope = np.concatenate([3.0 * side, -np.ones_like(side), np.zeros_like(side)], axis=1)
        excess = np.sum(slope * z, axis=1) + 1.0
        valid = np.ones(len(z), bool)
        margin = np.ones(len(z))
        value = Value(f, f, f[:, None], excess[:, None], excess[:, None], margin, valid, margin)
        hessian = np.tile(2 * np.eye(3), (len(z), 1, 1))
        gradient = self.sign * 2 * z
        return Derivatives(value, gradient, hessian, excess[:, None, None], slope[:, None, :, None])


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["gradients", "gradients that are wrong"])
def test_the_gradients_of_points_around_a_kink_decide_whether_it_is_an_optimum(sign):
    """Beside the ridge, where the solver's own pieces are those of one side only."""
    box = Box(np.zeros(3), np.full(3, -4.0), np.full(3, 4.0))
    beside = np.array([[0.06, 1.3, 0.0]])
    evaluate = Roof(SearchSpace(box, Constraints.of((1,), (0.0,), 1)), 1)
    evaluate.sign = sign
    search = Search(evaluate, SQP(), beside)
    search.consider_values(beside, evaluate(beside).value)
    search.history["evaluations"] = [0]
    found = search.conditions()
    assert found.hold is (sign > 0)
    if sign > 0:
        assert found.at_kink
        np.testing.assert_allclose(search.state.incumbent_z, [0.0, 1.0, 0.0], atol=0.01)


def test_a_feasible_point_without_derivatives_is_never_lost():
    box = Box(np.full(3, -2.0), np.full(3, -4.0), np.full(3, 4.0))
    evaluate = Ring(SearchSpace(box, Constraints.of((1,), (0.0,), 1)), 1)
    evaluate.centre, evaluate.least = np.full(3, 1.5), -0.01
    points = np.stack([np.full(3, -3.0), evaluate.centre])
    search = Search(evaluate, SQP(), points[:1])
    search.run(2)
    assert search.is_violated
    evaluate.on_values(points, evaluate(points).value)
    assert not search.is_violated
    np.testing.assert_array_equal(search.state.incumbent_z, evaluate.centre)


# -------------------------------------------------------------------------------------- the loop


@pytest.mark.slow
def test_tuning_lowers_the_loss_and_keeps_to_its_limits(paper):
    parameters = [
        ij.tunable("controller.k1", 0.1, 100),
        ij.tunable("controller.K2", 0.6, 40),
        ij.tunable("observer.kf", 1.01, 100),
    ]
    best = ij.tune(paper, parameters, objective(), effort=ij.tuning.Effort(iterations=25), **SHORT)
    assert best.report.changes[0].after < 0.75 * best.report.changes[0].before
    x = best.history["x"]
    assert np.all(x[..., 2:4] >= 0.6 - 1e-12)
    assert np.all(x[..., 0:2] <= 100 + 1e-9)
    np.testing.assert_allclose(
        best.values["controller.K2"], np.asarray(best.scenario.controller.K2)
    )
    assert "one nominal run" in str(best.report)
    assert best.report.improved
    again = ij.simulate(best.scenario, **SHORT).metrics
    before = ij.simulate(paper, **SHORT).metrics
    assert best.report.changes[1].after == pytest.approx(
        float(again.ise.sum() / before.ise.sum()), rel=1e-9
    )


@pytest.mark.slow
def test_an_infeasible_start_finds_its_way_in(paper):
    weak = ij.with_parameters(
        paper, {"controller.k1": 0.3, "controller.K2": 1.0, "initial.dq": [10.0, 10.0]}
    )
    assert int(plain_status(weak)) & ij.Status.BOUND_VIOLATED
    goal = (
        objectives.effort()
        + objectives.margin_above(0.06)
        + objectives.violation_probability_below(0.01)
    )
    best = ij.tune(
        weak,
        ["controller.k1", "controller.K2"],
        goal,
        effort=ij.tuning.Effort(iterations=60),
        **SHORT,
    )
    assert int(plain_status(best.scenario)) & ij.Status.BOUND_VIOLATED == 0
    assert best.report.passed, best.report
    assert best.report.margin[0] < 0 < 0.06 < best.report.margin[1]


@pytest.mark.slow
def test_a_start_that_breaks_a_requirement_finds_its_way_in(paper):
    """Nothing leaves the bounds, but the torque is too large: the multipliers make it feasible, and
    just so."""
    goal = objectives.tracking() + 0.05 * objectives.effort() + objectives.peak_torque_below(12.0)
    best = ij.tune(
        paper,
        ["controller.k1", "controller.K2"],
        goal,
        effort=ij.tuning.Effort(iterations=60),
        **SHORT,
    )
    assert best.report.verdicts[0].before.count == 1 and best.report.passed, best.report
    assert 11.0 < float(np.max(ij.simulate(best.scenario, **SHORT).metrics.peak_torque)) < 12.0


@pytest.mark.slow
def test_a_multiplier_is_what_a_looser_limit_is_worth(paper):
    """Against the optima themselves, with the limit moved by 1 % to both sides; few values are
    needed for each."""
    gains = ["controller.k1", "controller.K2"]

    def tuned(limit):
        goal = (
            objectives.tracking() + 0.05 * objectives.effort() + objectives.peak_torque_below(limit)
        )
        return ij.tune(paper, gains, goal, solver=SQP(1e-7), **SHORT)

    tight, best, loose = (tuned(9.0 * factor) for factor in (0.99, 1.0, 1.01))
    price = (tight.objective - loose.objective) / 0.18
    assert best.limit_multipliers == pytest.approx({"peak torque < 9 N m": price}, rel=0.02)
    assert price > 1e-3 and best.stopped == "converged"
    assert best.evaluations <= 250  # 189: of 32 starts, a third of which goes on every five steps
    assert 8.99 < float(np.max(ij.simulate(best.scenario, **SHORT).metrics.peak_torque)) < 9.0
    assert f"would fall by {best.limit_multipliers['peak torque < 9 N m']:.3g} for each N m" in str(
        best.report
    )
    gradient, excess, complementarity = best.residuals
    assert gradient < 1e-2 * best.objective and excess == 0 and complementarity < 1e-4
    assert "dt / 2: objective" in str(best.report)


@pytest.mark.slow
def test_a_requirement_that_breaks_at_half_the_step_is_polished_there(paper):
    """Euler's method at 1 ms: the error binds there, and is larger at half the step."""
    goal = objectives.effort() + objectives.error_below(0.01, after=0.4)
    options = {"duration": 0.8, "method": "euler", "progress": False}
    best = ij.tune(paper, ["controller.k1", "controller.K2"], goal, dt=1e-3, **options)
    assert best.setup.dt == 5e-4 and "steps at dt / 2 followed" in str(best.report)
    run = ij.simulate(best.scenario, duration=0.8, dt=5e-4, method="euler")
    error = np.max(np.abs(run.e1[np.asarray(run.t) >= 0.4]))
    assert 0.0099 < error <= 0.01
    assert best.history["valid"].shape[0] == len(best.history["evaluations"])


@pytest.mark.slow
def test_requirements_that_cannot_be_kept_are_named_with_how_much(paper):
    """Gravity takes more than 2 N m.  Beside it, what else a reader is warned of."""
    goal = objectives.tracking() + 0.3 * objectives.effort() + objectives.peak_torque_below(2.0)
    best = ij.tune(paper, ["controller.k1", "controller.K2"], goal, **SHORT)
    peak = float(np.max(ij.simulate(best.scenario, **SHORT).metrics.peak_torque))
    assert best.stopped == "the requirements cannot be kept together near these gains"
    assert f"fail; {peak:.5g} N m, {peak - 2:.3g} N m above the limit" in str(best.report)
    for factor in (0.9, 1.1):  # no gains near these break them less
        for path, value in best.values.items():
            near = np.maximum(value * factor, 0.505)
            assert (
                np.max(
                    ij.simulate(
                        ij.with_parameters(best.scenario, {path: near}), **SHORT
                    ).metrics.peak_torque
                )
                > peak - 1e-3
            )
    assert best.limit_multipliers == {}
    priceless = ij.tune(
        paper,
        ["controller.k1"],
        objectives.tracking(),
        effort=ij.tuning.Effort(iterations=1),
        **SHORT,
    )
    assert any("no price on torque" in line for line in priceless.notes)
    assert any(
        'not converged after 2 steps: take effort="thorough"' in line for line in priceless.notes
    )
    assert any(
        "WARNING: better gains may exist: the slope of the objective" in line
        for line in dataclasses.replace(priceless, stopped=STUCK).notes
    )
    far = dataclasses.replace(priceless, values={"controller.k1": np.array([2.0, 210.0])})
    assert [line for line in far.notes if "controller.k1[1] ended at 105 times its start" in line]


def plain_status(scenario):
    return jax.jit(
        lambda s: (
            run_transformable(s, standard(), jnp.asarray(1e-3), RunRequest(300, "euler")).status
        )
    )(scenario)


class Cliff:
    """An evaluator whose loss is not finite beyond z = 1, where it would go on falling."""

    def __call__(self, z):
        loss = np.where(z[:, 0] > 1, np.nan, -z[:, 0])
        valid = np.isfinite(loss)
        value = Value(
            np.where(valid, loss, np.inf),
            loss,
            loss[:, None],
            z[:, :0],
            z[:, :0],
            loss,
            valid,
            loss,
        )
        return Derivatives(
            value, np.where(valid[:, None], -np.ones_like(z), np.nan), np.zeros((len(z), 1, 1))
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver", [SQP(1e-6), Adam(learning_rate=0.5)], ids=lambda solver: solver.name
)
def test_steps_that_are_not_finite_are_rejected(solver):
    space = SearchSpace(Box(np.zeros(1), np.array([-1.0]), np.array([3.0])), iterations=60)
    evaluate = Evaluated(Cliff(), space)
    state, reached = solver.init(space, np.zeros((1, 1))), -np.inf
    for _ in range(60):
        z, found = solver.step(evaluate, state, solver.tolerance)
        evaluate.active = ~solver.converged(state)
        assert np.all(np.isfinite(z))
        reached = max(reached, z[0, 0]) if found.value.valid[0] else reached
    assert 0.9 < reached <= 1.0


class Bowl:
    """An evaluator of a narrow bent valley with its bottom at `BOTTOM`, not finite where z0 > 1."""

    evaluations = 0
    active = np.ones(1, bool)
    bottom = np.array([0.4, -0.3])

    @staticmethod
    def derivatives(problem, candidates):
        def loss(z):
            x = z - Bowl.bottom
            return jnp.where(z[0] > 1, jnp.nan, x[0] ** 2 + 30 * (x[1] - x[0] ** 2) ** 2)

        value, gradient = jax.vmap(jax.value_and_grad(loss))(candidates.z)
        valid = jnp.isfinite(value)
        empty = candidates.z[:, :0]
        found = Value(
            jnp.where(valid, value, jnp.inf), value, empty, empty, empty, value, valid, empty
        )
        return Derivatives(found, gradient, jnp.zeros((len(value), 2, 2)))

    def row(self, s):
        return None, Candidate(
            jnp.zeros((1, 2)), jnp.zeros((1, 1)), jnp.ones((1, 1)), jnp.zeros((1, 0)), jnp.ones(1)
        )

    def __call__(self, z):
        self.evaluations += 1
        candidates = self.row(0)[1]._replace(z=jnp.asarray(z))
        return jax.tree.map(np.asarray, self.derivatives(None, candidates))


@pytest.mark.slow
def test_lbfgs_finds_the_bottom_of_a_valley_beside_a_wall():
    box = Box(np.array([-1.0, 2.0]), np.array([-3.0, -3.0]), np.array([3.0, 3.0]))
    solver, bowl = LBFGS(tolerance=1e-12), Bowl()
    bowl.space = SearchSpace(box)
    state = solver.init(bowl.space, box.z[None])
    for _ in range(40):
        z, found = solver.step(bowl, state, solver.tolerance)
        bowl.active = ~solver.converged(state)
        assert found.value.valid[0]
    np.testing.assert_allclose(z[0], Bowl.bottom, atol=1e-6)
    assert solver.converged(state)[0] and 10 < bowl.evaluations < 400


class Corner:
    """An evaluator of max(x, -2 x), x = z - 0.3, smoothed as its objective says: the smooth maximum
    has its bottom elsewhere."""

    def __init__(self, space, starts):
        self.space = space
        self.problem = self
        self.objective = jax.tree.map(jnp.asarray, objectives.peak_torque(1.0, smoothing=0.2))
        self.allowed = ()
        self.candidates = Candidate(
            np.zeros((starts, 1)),
            np.zeros((starts, 1), np.uint32),
            np.ones((starts, 1)),
            np.zeros((starts, 0)),
            1.0,
        )
        self.active, self.evaluations = np.ones(starts, bool), 0

    def with_objective(self, objective):
        self.objective = objective
        return self

    def __call__(self, z):
        T = float(self.objective.terms[0].quantity.smoothing)
        y, slope = np.concatenate([z - 0.3, -2 * (z - 0.3)], axis=1), np.array([1.0, -2.0])
        exact, weight = y.max(axis=1), np.exp((y - y.max(axis=1, keepdims=True)) / T)
        loss = exact + T * np.log(weight.sum(axis=1))
        weight /= weight.sum(axis=1, keepdims=True)
        mean = weight @ slope
        curved = (weight @ slope**2 - mean**2) / T
        self.evaluations += int(self.active.sum())
        none = np.zeros((len(z), 0))
        value = Value(
            loss,
            exact,
            exact[:, None],
            none,
            none,
            np.ones(len(z)),
            self.active.copy(),
            exact[:, None],
        )
        return Derivatives(value, mean[:, None], curved[:, None, None])


def followed(starts, sharpenings, steps=60, resumed=None, stop=None):
    space = SearchSpace(Box(np.zeros(1), np.full(1, -3.0), np.full(1, 3.0)))
    solver = SQP(1e-6, sharpenings=sharpenings, patience=60)
    search = Search(Corner(space, len(starts)), solver, np.asarray(starts)[:, None])
    if resumed:
        load_checkpoint(resumed, search, "mark")
    search.run(stop or steps)
    return search


def test_a_smoothed_peak_is_followed_to_where_the_peak_itself_is_lowest(tmp_path):
    starts = [1.0, -0.5, 2.0, -2.0]
    blurred, sharp = followed(starts[:1], 0), followed(starts, 4)
    assert abs(blurred.state.best_z[0, 0] - 0.3) > 0.02
    assert abs(sharp.state.best_z[np.argmin(sharp.state.best_key[:, 1]), 0] - 0.3) < 2e-3
    assert sharp.state.retired.sum() == 3 and sharp.state.stage == 4
    assert sharp.evaluate.evaluations < 0.6 * len(starts) * len(sharp.history["loss"])
    half = followed(starts, 4, stop=len(sharp.history["loss"]) // 2)
    assert 0 < half.state.stage < 4
    save_checkpoint(half, tmp_path / "half.npz", "mark")
    again = followed(starts, 4, resumed=tmp_path / "half.npz")
    np.testing.assert_array_equal(again.history["z"], sharp.history["z"])
    np.testing.assert_array_equal(again.history["loss"], sharp.history["loss"])


def test_a_checkpoint_that_cannot_be_written_leaves_the_one_before(tmp_path, monkeypatch):
    search, path = followed([1.0], 0, steps=1), tmp_path / "search.npz"
    save_checkpoint(search, path, "mark")
    before = path.read_bytes()

    def full(file, **arrays):
        file.write(b"half")
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="no space"):
        save_checkpoint(search, path, "mark")
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.slow
@pytest.mark.parametrize(("most", "group"), [(None, 16), (8, 8)])
def test_only_active_starts_are_evaluated_in_groups_of_one_shape(nominal, most, group):
    candidates = nominal.candidates(np.arange(20.0)[:, None] * np.ones(6))
    evaluator = Evaluator(nominal, candidates, "forward", nominal.search_space(60), most)
    shapes = set()

    def derivatives(problem, candidates):
        shapes.add(candidates.z.shape)
        z, valid = np.asarray(candidates.z), np.ones(len(candidates.z), bool)
        return Derivatives(Value(*[z[:, 0]] * 6, valid, z), z, z[:, :, None])

    evaluator.derivatives = derivatives
    evaluator.active[[3, 7]] = False
    found = evaluator(candidates.z)
    assert shapes == {(group, 6)} and evaluator.evaluations == 18
    np.testing.assert_array_equal(
        found.value.loss, np.where(evaluator.active, np.arange(20.0), np.inf)
    )
    np.testing.assert_array_equal(found.value.valid, evaluator.active)


def test_a_bar_states_what_a_search_will_evaluate_and_counts_the_points():
    problem = SimpleNamespace(runs=64)
    text = _tune._cost_in_words(problem, 782, 6, ij.tuning.Effort())
    assert text == (
        "782 points of 64 runs without derivatives, then 6 starts of 64 runs with them, up to 60"
        " steps"
    )
    counted = []
    rows = in_groups(lambda rows: rows, 35, 16, counted.append)
    assert counted == [16, 16, 3] and rows.tolist() == list(range(35))


@pytest.mark.slow
def test_lbfgs_tunes_the_paper_as_well_as_sqp(paper):
    best = ij.tune(
        paper, GAINS, objective(), solver=LBFGS(), effort=ij.tuning.Effort(iterations=40), **SHORT
    )
    by_sqp = ij.tune(paper, GAINS, objective(), effort="quick", **SHORT)
    assert best.optimiser == "lbfgs"
    assert best.objective < 1.01 * by_sqp.objective


@pytest.mark.slow
def test_a_start_too_stiff_for_the_step_is_brought_in_or_refused(paper, monkeypatch):
    stiff = ij.with_parameters(paper, {"controller.K2": 60.0})
    assert (
        ij.tune(stiff, GAINS, objective(), effort=ij.tuning.Effort(0, 1, iterations=2), **SHORT)
        .history["valid"]
        .all()
    )
    # An error does not wait for derivatives: it follows from values.
    monkeypatch.setitem(evaluation.DERIVATIVES, "forward", None)
    with pytest.raises(ValueError, match=r"Take dt=\S+, not 0.001 s"):
        ij.tune(
            stiff, ["controller.k1"], objective(), effort=ij.tuning.Effort(iterations=2), **SHORT
        )


@pytest.mark.slow
def test_a_start_of_which_some_runs_are_too_stiff_says_how_many(nominal, monkeypatch):
    """The nominal run may be fine where some perturbed ones are not: dry friction of a narrow width
    is what no gain makes slower."""
    candidate = jax.tree.map(lambda x: x[0], nominal.candidates(nominal.box.z[None]))
    status = np.array([0, int(ij.Status.STEP_TOO_LARGE), 0, int(ij.Status.BOUND_VIOLATED)])
    smooth = np.ones((4, len(nominal.objective.quantities) + 1))
    smooth[2, 0] = np.nan
    found = evaluation.value_of_start(nominal, candidate, smooth, smooth, status)
    assert not found.valid and float(found.trusted) == 0.5
    options = dataclasses.replace(nominal.options, runs=4)
    perturbed = dataclasses.replace(nominal, options=options)
    seen = jax.tree.map(lambda x: np.asarray(x)[None], found)
    monkeypatch.setattr(TuningProblem, "suggested_dt", lambda self: 2e-4)
    monkeypatch.setattr(starts, "values", lambda problem, z: seen)
    with pytest.raises(
        ValueError, match=r"only 2 of 4 runs can be integrated.*Take dt=0.0002, not 0.001 s"
    ):
        screened(perturbed, 0, nominal.box.z[None])


# ---------------------------------------------------------------------------------------- robust


@pytest.fixture(scope="module")
def robust(paper):
    return ij.tune(
        paper,
        GAINS,
        objectives.tracking(),
        perturbations=DRAWS,
        runs=8,
        risk=ij.cvar(0.75),
        effort=ij.tuning.Effort(iterations=8),
        report=ij.tuning.Report(runs=256),
        **SHORT,
    )


@pytest.mark.slow
def test_the_report_repeats_the_warnings_about_the_tuned_gains(robust):
    assert not any("Theorem 2" in note for note in robust.notes)
    weak = ij.with_parameters(robust.scenario, {"observer.kf": 0.4})
    notes = dataclasses.replace(robust, scenario=weak).notes
    assert any(note.startswith("WARNING: observer.kf = [0.4 0.4]: Theorem 2") for note in notes)


@pytest.mark.slow
def test_the_report_is_on_fresh_runs_and_gives_intervals(robust):
    report = robust.report
    assert report.runs == 256
    assert report.seed != robust.setup.seed
    change = report.changes[0]
    assert change.name == "objective (cvar 0.75)"
    assert change.low < change.after - change.before < change.high < 0
    assert "significant" in str(report)
    assert "NOT" not in str(report.changes[0])
    with pytest.raises(ValueError, match="fresh"):
        robust.check(seed=robust.setup.seed)


@pytest.mark.slow
def test_a_change_that_is_not_significant_is_called_so(robust, paper):
    from iblf_jax.tuning.report import ReportRequest, make_report

    request = ReportRequest(
        before=paper,
        after=paper,
        tuned=tuple(robust.values),
        objective=robust.setup.objective,
        run=TuningRunOptions(perturbations=DRAWS, risk=Risk("mean"), **SHORT),
        report=Report(runs=256, seed=5),
    )
    report = make_report(request)
    assert report.changes[0].significant is False
    assert "NOT significant" in str(report)
    assert "do not show that tuning helped" in str(report)
    assert not report.improved


@pytest.mark.slow
def test_starts_run_as_one_batch_and_adam_resamples(paper):
    best = ij.tune(
        paper,
        GAINS,
        objectives.tracking(),
        perturbations=DRAWS,
        runs=4,
        solver=Adam(starts=2, resample=True),
        effort=ij.tuning.Effort(iterations=3),
        **SHORT,
    )
    assert best.optimiser == "adam"
    assert best.history["loss"].shape == (3, 2)


@pytest.mark.slow
def test_common_random_numbers(paper):
    """The same draws for every start and every step; other seeds give others."""
    built = [
        TuningProblem.build(
            paper,
            GAINS,
            objectives.tracking(scale=1.0),
            perturbations=DRAWS,
            runs=4,
            seed=seed,
            **SHORT,
        )
        for seed in (0, 0, 1)
    ]
    z = np.stack([built[0].box.z] * 2)
    losses = [
        Evaluator(p, p.candidates(z), "forward", p.search_space(60))(z).value.loss for p in built
    ]
    assert losses[0][0] == losses[0][1] == losses[1][0] != losses[2][0]


# ---------------------------------------------------------------------------------- the options


def test_signature_of_tune_is_short_and_solvers_fit_their_protocol():
    own = inspect.signature(ij.tune).parameters.keys() - {
        "runs_as"
    }  # which stands for five of them
    assert len(own) <= 17
    members = [name for name in vars(ij.tuning.Solver) if not name.startswith("_")]
    assert {"init", "step", "converged"} <= set(members)
    for name, solver in ij.tuning.SOLVERS.items():
        assert solver.name == name
        assert [member for member in members if not hasattr(solver, member)] == []


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"report_run": 3}, TypeError, "unexpected keyword argument 'report_run'.*report"),
        ({"solver": "newton"}, ValueError, "solver: got 'newton', expected one of 'auto', 'sqp'"),
        ({"solver": object()}, ValueError, "a solver: one of 'sqp'.*It lacks"),
        ({"report": {"runs": 7}}, ValueError, r"report: got .*ij.tuning.Report\(runs=200\)"),
    ],
)
def test_options_that_do_not_exist_or_fit_are_errors(paper, options, error, words):
    with pytest.raises(error, match=words):
        ij.tune(paper, ["controller.k1"], objectives.tracking(scale=1.0), **options, **SHORT)


@dataclasses.dataclass(frozen=True)
class Halving(Adam):
    """A user's solver: Adam that halves its learning rate at each step, and soon ends."""

    name = "halving"

    def step(self, evaluate, state, tolerance):
        found = super().step(evaluate, state, tolerance)
        state["rate"] = 0.5 * state["rate"]
        return found

    def converged(self, state):
        return state["rate"] < 0.2


@pytest.mark.slow
def test_a_solver_of_the_users_own(paper):
    best = ij.tune(paper, ["controller.k1"], objectives.tracking(), solver=Halving(), **SHORT)
    # It says that it has converged, but the gradient is not small.
    assert (best.optimiser, best.stopped) == ("halving", STUCK)
    assert best.residuals[0] > 1e-2
    assert len(best.history["loss"]) == 3


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ('solver = "lbfgs"', {"solver": LBFGS()}),
        ('[tune.solver]\nkind = "sqp"\nstarts = 4', {"solver": SQP(starts=4)}),
        ("[tune.report]\nruns = 20\nseed = 5", {"report": ij.tuning.Report(20, 5)}),
        ("confirm = 0.01", {"confirm": 0.01}),
    ],
)
def test_a_tuning_file_has_the_options_as_tables(tmp_path, table, expected):
    file = tmp_path / "tune.toml"
    file.write_text(
        f'preset = "zhang_yan_2024"\n[tune]\nparameters = ["controller.k1"]\n{table}\n'
        '[[objective]]\nkind = "tracking"\n'
    )
    arguments = load_tuning_file(file)
    assert {name: arguments[name] for name in expected} == expected


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ('solver = "sgd"', "tune.solver.kind: got 'sgd', expected one of 'sqp'"),
        ('[tune.solver]\nkind = "sqp"\nmemory = 4', "tune.solver.memory: got an unknown key"),
        ('[tune.solver]\nkind = "sqp"\nstarts = 0', "tune.solver.*starts: got 0"),
        ("[tune.report]\nrun = 20", "tune.report.run: got an unknown key.*runs"),
        ("iterations = 20", "tune.iterations: got an unknown key.*effort.*report"),
    ],
)
def test_wrong_options_in_a_tuning_file_are_named(tmp_path, table, words):
    file = tmp_path / "tune.toml"
    file.write_text(
        f'preset = "zhang_yan_2024"\n[tune]\nparameters = ["controller.k1"]\n{table}\n'
        '[[objective]]\nkind = "tracking"\n'
    )
    with pytest.raises(ValueError, match=words):
        load_tuning_file(file)


# ---------------------------------------------------------------------------------------- resume

KILLED = """
import sys, jax
jax.config.update("jax_enable_x64", True)
import numpy as np, iblf_jax as ij
o = ij.objectives
slow = (lambda search: __import__("time").sleep(0.4)) if sys.argv[2] == "slow" else None
goal = o.tracking() + 10 * o.peak_torque() + o.margin_above(0.11)
best = ij.tune(ij.presets.zhang_yan_2024(), ["controller.k1", "controller.K2"], goal,
               duration=0.1, method="euler", effort=ij.tuning.Effort(iterations=12),
               checkpoint=sys.argv[1], progress=slow)
np.savez(sys.argv[3], **best.history, **{k.replace(".", "_"): v for k, v in best.values.items()})
"""


@pytest.mark.slow
def test_a_killed_tuning_goes_on_bit_identically(tmp_path, monkeypatch):
    """As one that nobody stops, in another process."""
    env = os.environ | {"PYTHONPATH": str(Path(ij.__file__).parents[1])}

    def start(checkpoint, pace, out):
        return subprocess.Popen(
            [sys.executable, "-c", KILLED, str(tmp_path / checkpoint), pace, str(tmp_path / out)],
            env=env,
        )

    killed = start("a.npz", "slow", "never.npz")
    deadline = time.monotonic() + 300
    while not (tmp_path / "a.npz").exists():
        assert killed.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    time.sleep(0.6)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    with np.load(tmp_path / "a.npz") as half:
        assert 1 <= len(half["history_loss"]) < 12
    assert start("a.npz", "fast", "resumed.npz").wait() == 0
    monkeypatch.setattr(
        sys, "argv", ["-c", str(tmp_path / "b.npz"), "fast", str(tmp_path / "complete.npz")]
    )
    exec(KILLED, {})
    with (
        np.load(tmp_path / "resumed.npz") as resumed,
        np.load(tmp_path / "complete.npz") as complete,
    ):
        assert set(resumed.files) == set(complete.files)
        for name in complete.files:
            assert resumed[name].tobytes() == complete[name].tobytes(), name


@pytest.mark.slow
def test_a_checkpoint_of_another_problem_is_refused(paper, tmp_path):
    file = tmp_path / "c.npz"
    ij.tune(
        paper, GAINS, objective(), effort=ij.tuning.Effort(iterations=2), checkpoint=file, **SHORT
    )
    with pytest.raises(ValueError, match="this very problem"):
        ij.tune(
            paper,
            GAINS,
            2 * objective(),
            effort=ij.tuning.Effort(iterations=2),
            checkpoint=file,
            **SHORT,
        )


@pytest.mark.slow
def test_more_peaks_than_the_memory_holds_are_refused(paper, monkeypatch):
    """A requirement on a peak has a matrix for each piece of it in each run."""
    monkeypatch.setattr(checks, "memory", lambda: 1_400_000)
    goal = ij.objectives.tracking(scale=1.0) + ij.objectives.peak_torque_below(20.0)
    paths = ["controller.k1", "controller.K2", "observer.kf"]
    perturbed = {"plant.mass[1]": ij.factor(ij.uniform(0.9, 1.1))}
    with pytest.raises(ValueError, match=r"runs: got 200.*at most"):
        ij.tune(paper, paths, goal, perturbations=perturbed, runs=200, **SHORT)


@pytest.mark.slow
@pytest.mark.parametrize(("runs", "share"), [(300, 0.3), (60, 0.1)])
def test_a_share_of_many_runs_is_in_the_programme(runs, share):
    """All runs break g = z + 0.2 < 0, and the objective pulls z up: the step has to go down,
    whatever the number of the worst."""
    task = subproblem(
        np.array([-1.0]),
        np.eye(1),
        np.array([-1.0]),
        np.array([1.0]),
        Constraints.of((1,), (share,), runs),
        pieces=np.full((runs, 1), 0.2),
        piece_gradients=np.ones((runs, 1, 1)),
        penalty=10.0,
    )
    (found,) = quadratic.together([task])
    np.testing.assert_allclose(found.step, -0.2, atol=1e-4)
    np.testing.assert_allclose(
        found.multipliers, 1.2, rtol=1e-3
    )  # 1 - z, what the objective's slope is there
