"""Gain tuning: derivatives, objectives, coordinates, the loop, and the truth of its report."""

import dataclasses
import itertools
import os
import re
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
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.core import checks
from iblf_jax.engine.step_size import fastest_along
from iblf_jax.files.tuning import load_tuning_file
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.scenario import canonical
from iblf_jax.tuning import LBFGS, SQP, Adam, _tune, evaluation
from iblf_jax.tuning.checkpoints import load_checkpoint, save_checkpoint
from iblf_jax.tuning.conflicts import conflicts_in_words
from iblf_jax.tuning.evaluation import Derivatives, Evaluator, Value
from iblf_jax.tuning.parameters import Box, layout, squash, unsquash
from iblf_jax.tuning.problem import TuningProblem
from iblf_jax.tuning.quantities import Peak, Quantities, TimeIntegral
from iblf_jax.tuning.ranges import BY_STEP, BY_THEOREM, STABILITY_FRACTION, TIMES, TOGETHER
from iblf_jax.tuning.result import STUCK, UNCONFIRMED
from iblf_jax.tuning.robust import Risk, combine
from iblf_jax.tuning.search import (
    OPTIMISE,
    REPAIR,
    SEARCH_AROUND,
    SECOND_SEARCH,
    Search,
    SearchState,
    Strategy,
)
from iblf_jax.tuning.solvers import Constraints, SearchSpace
from iblf_jax.tuning.solvers.sqp import Subproblem, subproblems
from iblf_jax.tuning.starts import (
    SAME_OBJECTIVE,
    UNLIMITED,
    StepComparison,
    distinct,
    points_at_ends,
    ranked,
)

objectives = ij.objectives
SHORT = {"duration": 0.3, "dt": 1e-3, "method": "euler"}
GAINS = ["controller.k1", "controller.K2", "observer.kf"]
DRAWS = {"plant.mass[1]": ij.factor(ij.uniform(0.7, 1.3))}
DRAWS |= {"initial.q": ij.offset(ij.uniform(-0.03, 0.03))}


def objective():
    return objectives.tracking() + 0.5 * objectives.effort() + 10 * objectives.peak_torque()


def effort(iterations, **more):
    return ij.tuning.Effort(iterations=iterations, **more)


@pytest.mark.slow
def test_derivatives_in_both_modes_are_finite_differences(paper):
    """The matrix of int |e1|^2 is 2 sum dt e1_u . e1_v by the trapezoidal rule."""
    nominal = TuningProblem.build(paper, GAINS, objective(), **SHORT)
    h, z = 1e-5, nominal.box.z
    candidates = nominal.candidates(z[None])
    forward = evaluation.forward_derivatives(nominal, candidates)
    reverse = evaluation.reverse_derivatives(nominal, candidates)
    steps = np.concatenate([h * np.eye(len(z)), -h * np.eye(len(z))])
    losses = np.asarray(evaluation.value(nominal, nominal.candidates(z + steps)).loss)
    expected = (losses[: len(z)] - losses[len(z) :]) / (2 * h)
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(forward.gradient[0], expected, rtol=0, atol=1e-6 * scale)
    np.testing.assert_allclose(forward.gradient, reverse.gradient, rtol=1e-8, atol=1e-10 * scale)
    np.testing.assert_allclose(forward.value.loss, reverse.value.loss, rtol=1e-12)

    def errors(z):
        values = {p.path: np.exp(z[p.start : p.start + p.size]) for p in nominal.blocks}
        return np.asarray(ij.simulate(ij.with_parameters(paper, values), **SHORT).e1)

    J = np.stack([errors(z + h * e) - errors(z - h * e) for e in np.eye(len(z))]) / (2 * h)
    weights = np.full(J.shape[1], SHORT["dt"])
    weights[[0, -1]] /= 2
    expected = 2 * np.einsum("utn,t,vtn->uv", J, weights, J)
    only = objectives.Objective((nominal.objective.terms[0],))
    counts = (1, nominal.piece_counts[-1])
    single = dataclasses.replace(nominal, objective=only, piece_counts=counts)
    candidates = nominal.candidates(z[None])._replace(weights=np.ones((1, 1)))
    found = evaluation.forward_derivatives(single, candidates).hessian[0] * only.terms[0].scale
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-9 * np.max(expected))


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
    windows = [(t >= a - 1e-9) & (t < b - 1e-9) for a, b in itertools.pairwise(edges)]
    pieces = np.ravel([np.max(both[window], axis=0) for window in windows])
    smooth = np.asarray(run.metrics["tuning_smooth"])
    np.testing.assert_allclose(smooth[5], T * np.logaddexp.reduce(pieces / T), rtol=1e-9)
    first = 4 + 4  # the integrals, one each, and the torque of two joints with both signs
    np.testing.assert_allclose(run.metrics["tuning_pieces"][first:][:12], pieces, rtol=1e-9)
    assert np.all(smooth[4:] >= np.asarray(run.metrics["tuning_exact"])[4:])


def test_objectives_and_risks_are_composed():
    terms = objectives.tracking(scale=1.0) + 3 * objectives.effort(scale=2.0)
    both = 2 * terms + objectives.margin_above(0.05)
    assert [t.name for t in both.terms] == ["tracking", "effort"]
    assert [float(t.weight) for t in both.terms] == [2.0, 6.0]
    names = [r.name for r in (objectives.error_below(0.01, after=1.0) + both).requirements]
    assert names == ["|e1| < 0.01 rad after 1 s", "margin > 0.05 rad"]
    np.testing.assert_allclose(both.values(jnp.array([1.0, 4.0, 0.0])), [2.0, 12.0])
    assert float(both.excesses(jnp.array([1.0, 4.0, -0.06]))[0]) == pytest.approx(-0.2)
    with pytest.raises(ValueError, match="an objective or a requirement"):
        objectives.tracking() + 3
    losses = jnp.arange(10.0)
    assert float(combine(Risk("mean"), losses)) == 4.5
    assert float(combine(Risk("worst"), losses)) == 9.0
    assert float(combine(ij.cvar(0.8), losses)) == 8.5
    assert_refused("between 0 and 1", ij.cvar, 1.0)


def test_bijections_keep_inside_and_invert_and_points_at_ends_differ_in_one_gain_or_two():
    low, high = np.array([[-1.0, 0.0, -np.inf, -np.inf], [2.0, np.inf, 3.0, np.inf]])
    box = Box(np.zeros(4), low, high)
    z = np.array([0.5, 0.7, 1.0, -5.0])
    np.testing.assert_allclose(squash(jnp.asarray(unsquash(z, box)), box), z, rtol=1e-12)
    for w in (-50.0, 50.0):
        inside = np.asarray(squash(jnp.full(4, w), box))
        assert np.all(inside >= box.low) and np.all(inside <= box.high)
    box = Box(np.zeros(3), np.array([-1.0, -2.0, -np.inf]), np.array([1.0, 2.0, 3.0]))
    z = np.array([0.5, 0.0, 0.2])
    points = points_at_ends(box, z, 100, seed=0)
    assert len(points) == len(np.unique(points, axis=0)) == 6 + 12
    moved = points != z
    assert sorted(np.sum(moved, axis=1).tolist()) == 6 * [1] + 12 * [2]
    ends = np.stack([box.low, box.high])
    ends[0, 2] = z[2] - UNLIMITED
    assert np.all(np.any(points == ends[:, None], axis=0)[moved])
    fewer = points_at_ends(box, z, 5, seed=0)
    assert len(fewer) == 5 and all(np.any(np.all(points == x, axis=1)) for x in fewer)


@pytest.mark.slow
def test_default_limits_keep_the_conditions_and_the_step(paper):
    tied = ij.tunable("controller.o", tied=True)
    blocks, box = layout(canonical(paper), [*GAINS, tied], 1e-3, "rk4")
    low, high = np.exp(box.low), np.exp(box.high)
    assert [b.path for b in blocks] == [*GAINS, "controller.o"] and blocks[-1].size == 1
    assert np.all(low[:2] > 0) and np.all(low[2:4] > 0.5)
    assert np.all(low[4:6] > 1.0)
    run = ij.simulate(ij.with_parameters(paper, {"controller.K2": high[2:4]}), duration=0.2)
    assert run.ok and 1e-3 * float(run.fastest_mode) > 1.2
    # Together they keep to a share of the step that each one would leave free.
    highest = {b.path: high[b.start : b.start + b.size] for b in blocks[:3]}
    mode = 1e-3 * fastest_along(canonical(ij.with_parameters(paper, highest)), TIMES)
    assert mode == pytest.approx(STABILITY_FRACTION * tableau("rk4").stability, rel=0.01)
    _, single = layout(canonical(paper), ["controller.K2"], 1e-3, "rk4")
    assert np.all(np.exp(single.high) > 1.001 * high[2:4])
    assert box.reasons[0] == (BY_THEOREM, BY_STEP + TOGETHER)
    assert single.reasons[0] == (BY_THEOREM, BY_STEP)
    with pytest.raises(ValueError, match="do not overlap"):
        layout(canonical(paper), ["controller.K2", "controller.K2[0]"], 1e-3, "rk4")
    with pytest.raises(ValueError, match="Widen the limits"):
        layout(canonical(paper), [ij.tunable("controller.k1", 3.0, 4.0)], 1e-3, "rk4")


def box_of(size, z=0.0):
    return Box(np.full(size, z), np.full(size, -4.0), np.full(size, 4.0))


def rows(*values, size=7):
    return np.stack([np.full(size, x) for x in values])


def found_at(z, loss, gradient, hessian, excess=None, slopes=None):
    """What an evaluator finds at z, (S, p): a loss, (S,), with its derivatives, and the excess of
    the piece of one requirement, (S,), with its slopes, (S, p)."""
    excess = z[:, :0] if excess is None else excess[:, None]
    slopes = z[:, :, None][:, :, :0] if slopes is None else slopes[:, :, None]
    value = Value(loss, loss, loss[:, None], excess, excess, np.ones(len(z)), np.isfinite(loss))
    hessian = np.broadcast_to(hessian, (len(z), *np.shape(hessian)[-2:]))
    return Derivatives(value, gradient, hessian, excess[:, None], slopes[:, None])


class Evaluated:
    """An `Evaluator` of a function of z for solvers and searches; it counts the active starts."""

    def __init__(self, function, space, starts=1):
        self.function, self.space = function, space
        self.evaluations, self.active = 0, np.ones(starts, bool)
        same = {"_replace": lambda **changes: self.candidates}
        self.candidates = SimpleNamespace(index=np.zeros((starts, 1)), **same)
        parts = {"objective": objectives.tracking(), "options": SimpleNamespace(seed=0)}
        parts |= {"allowed": (0.0,), "box": space.box, "size": len(space.box.z), "blocks": ()}
        self.problem = SimpleNamespace(sampled_too_slowly=lambda z: False, **parts)

    def __call__(self, z):
        self.evaluations += int(self.active.sum())
        found = self.function(z)
        return found._replace(value=found.value._replace(valid=found.value.valid & self.active))

    def values(self, z):
        found = self.function(z).value
        self.on_values(z, found)
        return found


def steps_of(solver, evaluate, start, steps):
    """Points, values and the last state of one start; one that has converged goes no further."""
    state, seen = solver.init(evaluate.space, np.array([start])), []
    for _ in range(steps):
        z, found = solver.step(evaluate, state, solver.tolerance)
        seen.append((z[0], found.value))
        evaluate.active = ~solver.converged(state)
        if not evaluate.active.any():
            break
    return seen, state


def steps_of_sqp(function, start, steps, tolerance, constraints=None):
    """The state of one start in a square after some steps."""
    space = SearchSpace(box_of(2), constraints or Constraints.of((), (), 1))
    return steps_of(SQP(tolerance=tolerance), Evaluated(function, space), start, steps)[1][0]


def two_pieces(most, size=1.0):
    """size |z - 2|^2 with g = the larger of z0^2 + z1^2 - 1 and z0 - `most`, in each of
    two runs, the second of which is further from its limit."""

    def at(z):
        g = np.stack([np.sum(z**2, axis=1) - 1, z[:, 0] - most], axis=1)
        a = np.stack([2 * z, np.tile([1.0, 0.0], (len(z), 1))], axis=2)
        loss, gradient = size * np.sum((z - 2) ** 2, axis=1), 2 * size * (z - 2)
        found = found_at(z, loss, gradient, 2 * size * np.eye(2))
        two = {"pieces": np.stack([g, g - 0.5], axis=1), "piece_gradients": np.stack([a, a], 1)}
        return found._replace(**two)

    return at


@pytest.mark.parametrize(("share", "shift"), [(0.0, 0.0), (1.0, 0.25)], ids=["every run", "mean"])
@pytest.mark.parametrize("most", [0.2, 5.0], ids=["corner", "circle"])
def test_pieces_that_bind_are_found_with_their_multipliers(most, share, shift):
    """On a circle, and where it meets a line; moved outwards where the mean of two runs counts.
    The circle takes more steps without the correction of a rejected one, which is for that one."""
    constraints = Constraints.of((2,), (share,), 2)
    state = steps_of_sqp(two_pieces(most), [0.2, 0.1], 7, 1e-10, constraints)
    radius = np.sqrt(1 + shift)
    x = min(most + shift, radius / np.sqrt(2))
    point = np.array([x, np.sqrt(radius**2 - x**2)])
    np.testing.assert_allclose(state.z, point, atol=2e-5)
    gradients = np.array([2 * point, [1.0, 0.0]]).T[:, : 1 + (x == most + shift)]
    y = np.linalg.lstsq(gradients, 2 * (2 - point), rcond=None)[0]
    assert state.multipliers[0] == pytest.approx(y.sum(), rel=1e-3)
    assert state.done and not state.corrected and np.all(state.residuals < 1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["a slope", "a slope that points the wrong way"])
def test_a_region_that_has_collapsed_is_no_optimum(sign):
    """|z|^2 with the opposite gradient: no decrease is predicted, however short the step."""

    def evaluate(z):
        return found_at(z, np.sum(z**2, axis=1), 2 * sign * z, np.zeros((2, 2)))

    state = steps_of_sqp(evaluate, [3.0, -1.0], 40, 1e-6)
    assert state.done
    assert state.residuals[0] < 1e-3 if sign > 0 else state.residuals[0] > 1.0
    assert sign < 0 or np.all(np.abs(state.z) < 1e-3)


def test_a_start_ends_where_slopes_are_so_large_that_products_of_them_overflow():
    def chattering(z):
        found = two_pieces(5.0)(z)
        return found._replace(piece_gradients=1e305 * found.piece_gradients)

    with np.errstate(over="raise"):
        state = steps_of_sqp(chattering, [0.3, -0.7], 3, 1e-8, Constraints.of((2,), (0.0,), 2))
    assert state.done and state.z.tolist() == [0.3, -0.7]


@pytest.mark.parametrize("size", [1.0, 1e-6])
def test_limits_that_cannot_be_kept_are_broken_as_little_as_can_be(size):
    """The circle and z0 > 1.5, another requirement: between them the sum of both is least at the
    end of the circle.  A small objective beside large multipliers is an optimum, too, before the
    region collapses."""

    def both(z):
        found = two_pieces(5.0, size)(z)
        found.pieces[:, :, 1] = 1.5 - z[:, :1]
        found.piece_gradients[:, :, :, 1] = np.array([-1.0, 0.0])
        return found

    state = steps_of_sqp(both, [0.3, -0.7], 40, 1e-8, Constraints.of((1, 1), (0.0, 0.0), 2))
    assert state.done and state.radius > 1e-2
    np.testing.assert_allclose(state.z, [1.0, 0.0], atol=1e-4)
    assert state.residuals[1] == pytest.approx(0.5, abs=1e-4)


LOW, DEEP = 1.3, 1.0


def valleys(z):
    """A broad valley at -1, a deeper one at 1, and a requirement that does not bind."""
    a, b = LOW + np.sum((z + 1) ** 2, axis=1), DEEP + 3 * np.sum((z - 1) ** 2, axis=1)
    is_broad = (a < b)[:, None]
    gradient = np.where(is_broad, 2 * (z + 1), 6 * (z - 1))
    hessian = np.where(is_broad[..., None], 2.0, 6.0) * np.eye(z.shape[1])
    return found_at(z, np.minimum(a, b), gradient, hessian, -np.ones(len(z)), 0.0 * z)


def evaluator_of(function, starts, z=0.0):
    """An evaluator of a function with one requirement, for these starts."""
    space = SearchSpace(box_of(starts.shape[1], z), Constraints.of((1,), (0.0,), 1))
    return Evaluated(function, space, len(starts))


def search_from(function, starts, selection=2, z=0.0, begin=None, **more):
    """A search after a screening of the starts, which begins at some of them, or at all."""
    begin = starts if begin is None else begin
    strategy = Strategy(ranked(starts, function(starts).value), selection, len(starts), **more)
    return Search(evaluator_of(function, begin, z), SQP(), begin, strategy)


def test_a_search_from_several_starts_goes_on_in_the_deeper_valley():
    search = search_from(valleys, rows(-1.6, -0.4, 0.5, 1.9), z=-0.6)
    assert search.run(60) == "converged"
    assert search.state.incumbent_key[1] == pytest.approx(DEEP)
    np.testing.assert_allclose(search.state.incumbent_z, np.ones(7), atol=1e-3)
    assert search.state.retired.sum() >= 2 and search.state.phase == 0
    found = search.conditions()
    assert found.hold and np.max(np.abs(found.residuals)) < 1e-3


@pytest.mark.parametrize("deep", [[1.9], [1.9, 0.5]])
def test_a_second_search_follows_where_only_one_of_many_starts_came_near_the_best(deep):
    search = search_in_valleys(*deep, others=8)
    search.run(60)
    assert search.state.incumbent_key[1] == pytest.approx(DEEP)
    assert search.state.valleys[2] == len(deep) and search.reached_by_one_start == (len(deep) == 1)
    assert (search.state.phase == SECOND_SEARCH) == search.reached_by_one_start
    starts = len(deep) + 8
    second = search.reached_by_one_start * (starts // 3)
    assert search.state.plain_values == starts + second


def test_requirements_that_no_gains_keep_are_named_alone_and_in_pairs(paper):
    names = ("torque", "margin", "rate")
    requirements = [SimpleNamespace(name=x, scale=10.0, measure=(1.0, "N m")) for x in names]
    problem = SimpleNamespace(objective=SimpleNamespace(requirements=requirements), scenario=paper)

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


CENTRE = np.full(3, 1.5)


def ring(least):
    """Feasible inside a small ball around `CENTRE` only, while the objective grows from 0: its
    minimum under a penalty of the requirement is elsewhere, as the excess is flat far away."""

    def at(z):
        away = z - CENTRE
        near = np.exp(-0.5 * np.sum(away**2, axis=1))
        objective, excess = 0.1 + np.sum(z**2, axis=1), least + 1.0 - near
        return found_at(z, objective, 2 * z, 2 * np.eye(3), excess, away * near[:, None])

    return at


@pytest.mark.parametrize(("least", "feasible"), [(-0.01, True), (0.2, False)])
def test_the_excess_alone_is_minimised_before_requirements_are_called_infeasible(least, feasible):
    search = search_from(ring(least), rows(-3.0, -2.0, 0.3, size=3), z=-2.0)
    search.run(40)
    assert search.is_violated is not feasible
    if feasible:
        np.testing.assert_allclose(search.state.incumbent_z, CENTRE, atol=0.2)
        return
    assert search.state.phase == REPAIR
    assert search.state.incumbent_key[0] == pytest.approx(least, abs=1e-3)
    assert search.conditions().residuals[1] == pytest.approx(least, abs=1e-3)


def roof(sign):
    """|z|^2 above a roof: one piece, the larger of two slopes that meet at z0 = 0 and z1 = 1."""

    def at(z):
        side = np.where(z[:, 0] > 0, 1.0, -1.0)
        slopes = np.stack([3.0 * side, -np.ones(len(z)), np.zeros(len(z))], axis=1)
        f, excess = np.sum(z**2, axis=1), np.sum(slopes * z, axis=1) + 1.0
        return found_at(z, f, sign * 2 * z, 2 * np.eye(3), excess, slopes)

    return at


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["gradients", "gradients that are wrong"])
def test_the_gradients_of_points_around_a_kink_decide_whether_it_is_an_optimum(sign):
    """Beside the ridge, where the solver's own pieces are those of one side only."""
    beside = np.array([[0.06, 1.3, 0.0]])
    evaluate = evaluator_of(roof(sign), beside)
    search = Search(evaluate, SQP(), beside)
    search.consider_values(beside, evaluate(beside).value)
    search.history["evaluations"] = [0]
    found = search.conditions()
    assert found.hold is (sign > 0)
    if sign > 0:
        assert found.at_kink
        np.testing.assert_allclose(search.state.incumbent_z, [0.0, 1.0, 0.0], atol=0.01)


def test_an_incumbent_whose_derivatives_overflow_is_no_optimum_at_a_kink():
    """It was found by a value; a start that has converged near it leads to the examination."""

    def overflowing(z):
        value, *others = roof(1.0)(z)
        return Derivatives(value, *(np.full_like(x, np.nan) for x in others))

    beside = np.array([[0.06, 1.3, 0.0]])
    evaluate = evaluator_of(overflowing, beside)
    search = Search(evaluate, SQP(), beside)
    search.consider_values(beside, evaluate(beside).value)
    search.history["evaluations"] = [0]
    assert not search._holds_at_kink()


def test_a_feasible_point_without_derivatives_is_never_lost():
    points = np.stack([np.full(3, -3.0), CENTRE])
    evaluate = evaluator_of(ring(-0.01), points[:1])
    search = Search(evaluate, SQP(), points[:1])
    search.run(2)
    assert search.is_violated
    evaluate.on_values(points, evaluate(points).value)
    assert not search.is_violated
    np.testing.assert_array_equal(search.state.incumbent_z, CENTRE)


@pytest.mark.slow
def test_a_multiplier_is_what_a_looser_limit_is_worth(paper):
    """Against the optima themselves, with the limit moved by 1 % to both sides; few values are
    needed for each.  The start breaks the limit, and the optimum keeps it just so."""

    def tuned(limit):
        wanted = objectives.tracking() + 0.05 * objectives.effort()
        goal = wanted + objectives.peak_torque_below(limit)
        return ij.tune(paper, GAINS[:2], goal, solver=SQP(1e-7), **SHORT)

    tight, best, loose = (tuned(9.0 * factor) for factor in (0.99, 1.0, 1.01))
    price = (tight.objective - loose.objective) / 0.18
    assert best.limit_multipliers == pytest.approx({"peak torque < 9 N m": price}, rel=0.02)
    assert price > 1e-3 and best.stopped == "converged"
    assert best.report.verdicts[0].before.count == 1 and best.report.passed, best.report
    assert best.evaluations <= 250  # 189: of 32 starts, a third of which goes on every five steps
    assert 8.99 < float(np.max(ij.simulate(best.scenario, **SHORT).metrics.peak_torque)) < 9.0
    words = f"would fall by {best.limit_multipliers['peak torque < 9 N m']:.3g} for each N m"
    assert words in str(best.report)
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
    assert 0.0099 < np.max(np.abs(run.e1[np.asarray(run.t) >= 0.4])) <= 0.01
    assert best.history["valid"].shape[0] == len(best.history["evaluations"])


@pytest.mark.slow
def test_requirements_that_cannot_be_kept_are_named_with_how_much(paper):
    """Gravity takes more than 2 N m."""
    goal = objectives.tracking() + 0.3 * objectives.effort() + objectives.peak_torque_below(2.0)
    best = ij.tune(paper, GAINS[:2], goal, **SHORT)

    def peak_of(scenario):
        return float(np.max(ij.simulate(scenario, **SHORT).metrics.peak_torque))

    peak = peak_of(best.scenario)
    assert best.stopped == "the requirements cannot be kept together near these gains"
    assert f"fail; {peak:.5g} N m, {peak - 2:.3g} N m above the limit" in str(best.report)
    for factor in (0.9, 1.1):  # no gains near these break them less
        for path, value in best.values.items():
            near = {path: np.maximum(value * factor, 0.505)}
            assert peak_of(ij.with_parameters(best.scenario, near)) > peak - 1e-3
    assert best.limit_multipliers == {}


@pytest.mark.slow
def test_notes_warn_of_what_a_search_leaves_open_also_with_a_users_solver(paper):
    once = effort(1, values=0, starts=1)
    found = ij.tune(paper, ["controller.k1"], objectives.tracking(), effort=once, **SHORT)
    far = {"controller.k1": np.array([2.0, 210.0])}
    for changes, words in (
        ({}, "no price on torque"),
        ({}, 'not converged after 2 steps: take effort="thorough"'),
        ({"stopped": STUCK}, "WARNING: better gains may exist: the slope of the objective"),
        ({"values": far}, "controller.k1[1] ended at 105 times its start"),
    ):
        notes = dataclasses.replace(found, **changes).notes
        assert any(words in line for line in notes), words
    best = ij.tune(paper, ["controller.k1"], objectives.tracking(), solver=Halving(), **SHORT)
    # It says that it has converged, but the gradient is not small.
    assert (best.optimiser, best.stopped) == ("halving", STUCK) and best.residuals[0] > 1e-2
    assert len(best.history["loss"]) == 3


def cliff(z):
    """It falls up to z = 1, beyond which it is not finite."""
    inside = z <= 1
    loss, slope = np.where(inside, -z, np.inf), np.where(inside, -1.0, np.nan)
    return found_at(z, loss[:, 0], slope, np.zeros((1, 1)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver", [SQP(1e-6), Adam(0.5), LBFGS(tolerance=1e-12)], ids=lambda solver: solver.name
)
def test_steps_that_are_not_finite_are_rejected(solver):
    space = SearchSpace(Box(np.zeros(1), np.array([-1.0]), np.array([3.0])), iterations=60)
    seen, _ = steps_of(solver, Evaluated(cliff, space), [0.0], 60)
    assert np.all(np.isfinite([z for z, _ in seen]))
    assert 0.9 < max(z[0] for z, value in seen if value.valid[0]) <= 1.0


class Corner(Evaluated):
    """max(x, -2 x), x = z - 0.3, smoothed as the objective says: that has its bottom elsewhere."""

    def __init__(self, space, starts):
        super().__init__(self.smoothed, space, starts)
        self.problem = self
        self.objective = jax.tree.map(jnp.asarray, objectives.peak_torque(1.0, smoothing=0.2))
        self.allowed = ()

    def with_objective(self, objective):
        self.objective = objective
        return self

    def smoothed(self, z):
        T = float(self.objective.terms[0].quantity.smoothing)
        y, slope = np.concatenate([z - 0.3, -2 * (z - 0.3)], axis=1), np.array([1.0, -2.0])
        exact, weight = y.max(axis=1), np.exp((y - y.max(axis=1, keepdims=True)) / T)
        loss = exact + T * np.log(weight.sum(axis=1))
        weight /= weight.sum(axis=1, keepdims=True)
        mean = weight @ slope
        curved = (weight @ slope**2 - mean**2) / T
        found = found_at(z, loss, mean[:, None], curved[:, None, None])
        exactly = {"objective": exact, "terms": exact[:, None], "valid": self.active.copy()}
        return found._replace(value=found.value._replace(**exactly))


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
    assert_refused("no space", save_checkpoint, search, path, "mark", error=OSError)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.slow
def test_infeasible_and_stiff_starts_are_brought_in_or_refused(paper, monkeypatch):
    stiff = ij.with_parameters(paper, {"controller.K2": 60.0})
    best = ij.tune(stiff, GAINS, objective(), effort=effort(2, values=0, starts=1), **SHORT)
    assert best.history["valid"].all()
    # An error does not wait for derivatives: it follows from values.
    with monkeypatch.context() as patch:
        patch.setitem(evaluation.DERIVATIVES, "forward", None)
        with pytest.raises(ValueError, match=r"Take dt=\S+, not 0.001 s"):
            ij.tune(stiff, ["controller.k1"], objective(), effort=effort(2), **SHORT)
    values = {"controller.k1": 0.3, "controller.K2": 1.0, "initial.dq": [10.0, 10.0]}
    goal = objectives.effort() + objectives.margin_above(0.06)
    goal += objectives.violation_probability_below(0.01)
    best = ij.tune(ij.with_parameters(paper, values), GAINS[:2], goal, effort=effort(60), **SHORT)
    assert best.report.passed, best.report
    assert best.report.margin[0] < 0 < 0.06 < best.report.margin[1]


@pytest.mark.slow
def test_the_report_has_warnings_about_the_tuned_gains_and_intervals_on_fresh_runs(paper):
    options = {"perturbations": DRAWS, "runs": 8, "risk": ij.cvar(0.75), "effort": effort(8)}
    options |= {"report": ij.tuning.Report(runs=256)} | SHORT
    robust = ij.tune(paper, GAINS, objectives.tracking(), **options)
    assert not any("Theorem 2" in note for note in robust.notes)
    weak = ij.with_parameters(robust.scenario, {"observer.kf": 0.4})
    notes = dataclasses.replace(robust, scenario=weak).notes
    assert any(note.startswith("WARNING: observer.kf = [0.4 0.4]: Theorem 2") for note in notes)
    report = robust.report
    assert report.runs == 256 and report.seed != robust.setup.seed
    change = report.changes[0]
    assert change.name == "objective (cvar 0.75)"
    assert change.low < change.after - change.before < change.high < 0
    assert "significant" in str(report) and "NOT" not in str(report.changes[0])
    assert_refused("fresh", robust.check, seed=robust.setup.seed)


@pytest.mark.slow
def test_common_random_numbers(paper):
    """The same draws for every start and every step; other seeds give others."""

    def losses(seed):
        options = SHORT | {"perturbations": DRAWS, "runs": 4, "seed": seed}
        built = TuningProblem.build(paper, GAINS, objectives.tracking(scale=1.0), **options)
        candidates = built.candidates(np.stack([built.box.z] * 2))
        return Evaluator(built, candidates, "forward", built.search_space(60))(candidates.z)

    one, again, other = (losses(seed).value.loss for seed in (0, 0, 1))
    assert one[0] == one[1] == again[0] != other[0]


@dataclasses.dataclass(frozen=True)
class Halving(Adam):
    """Adam that halves its learning rate at each step, and soon ends."""

    name = "halving"

    def step(self, evaluate, state, tolerance):
        found = super().step(evaluate, state, tolerance)
        state["rate"] = 0.5 * state["rate"]
        return found

    def converged(self, state):
        return state["rate"] < 0.2


OF_POPULATION = '[tune.solver]\nkind = "differential-evolution"\npopulation = 16\nreach = 2.0'


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ('solver = "lbfgs"', LBFGS()),
        ('[tune.solver]\nkind = "trust-constr"\nstarts = 2', ij.tuning.TrustConstr(starts=2)),
        (OF_POPULATION, ij.tuning.DifferentialEvolution(population=16, reach=2.0)),
        ("[tune.report]\nruns = 20\nseed = 5", ij.tuning.Report(20, 5)),
        ("confirm = 0.01", 0.01),
        ('solver = "sgd"', "tune.solver.kind: got 'sgd', expected one of 'sqp'"),
        ('[tune.solver]\nkind = "sqp"\nmemory = 4', "tune.solver.memory: got an unknown key"),
        ('[tune.solver]\nkind = "sqp"\nstarts = 0', "tune.solver.*starts: got 0"),
        ("[tune.report]\nrun = 20", "tune.report.run: got an unknown key.*runs"),
        ("iterations = 20", "tune.iterations: got an unknown key.*effort.*report"),
    ],
)
def test_a_tuning_file_has_the_options_as_tables(tmp_path, table, expected):
    """What the file sets, or the words of the refusal."""
    file, option = tmp_path / "tune.toml", re.match(r"\[tune\.(\w+)|(\w+)", table)
    head = f'preset = "zhang_yan_2024"\n[tune]\nparameters = ["controller.k1"]\n{table}\n'
    file.write_text(f'{head}[[objective]]\nkind = "tracking"\n')
    if isinstance(expected, str):
        assert_refused(expected, load_tuning_file, file)
    else:
        assert load_tuning_file(file)[option[1] or option[2]] == expected


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

    def start(*words):
        return subprocess.Popen([sys.executable, "-c", KILLED, *words], cwd=tmp_path, env=env)

    killed, checkpoint = start("a.npz", "slow", "never.npz"), tmp_path / "a.npz"
    deadline = time.monotonic() + 300
    while not checkpoint.exists():
        assert killed.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    time.sleep(0.6)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    with np.load(checkpoint) as half:
        assert 1 <= len(half["history_loss"]) < 12
    assert start("a.npz", "fast", "resumed.npz").wait() == 0
    words = ["-c", f"{tmp_path}/b.npz", "fast", f"{tmp_path}/complete.npz"]
    monkeypatch.setattr(sys, "argv", words)
    exec(KILLED, {})
    resumed, complete = (dict(np.load(tmp_path / f"{x}.npz")) for x in ("resumed", "complete"))
    assert set(resumed) == set(complete)
    for name, expected in complete.items():
        assert resumed[name].tobytes() == expected.tobytes(), name


@pytest.mark.slow
def test_more_peaks_than_the_memory_holds_are_refused(paper, monkeypatch):
    """A requirement on a peak has a matrix for each piece of it in each run."""
    monkeypatch.setattr(checks, "memory", lambda: 1_400_000)
    goal = ij.objectives.tracking(scale=1.0) + ij.objectives.peak_torque_below(20.0)
    perturbed = {"plant.mass[1]": ij.factor(ij.uniform(0.9, 1.1))}
    with pytest.raises(ValueError, match=r"runs: got 200.*at most"):
        ij.tune(paper, GAINS, goal, perturbations=perturbed, runs=200, **SHORT)


@pytest.mark.slow
@pytest.mark.parametrize(("runs", "share"), [(300, 0.3), (60, 0.1)])
def test_a_share_of_many_runs_is_in_the_programme(runs, share):
    """All runs break g = z + 0.2 < 0: the step has to go down, whatever the number of the worst."""
    constraints, one = Constraints.of((1,), (share,), runs), np.ones(1)
    pieces = {"pieces": np.full((runs, 1), 0.2), "piece_gradients": np.ones((runs, 1, 1))}
    problem = Subproblem(-one, np.eye(1), -one, one, penalty=10.0, **pieces)
    (found,) = subproblems(constraints, [problem])
    np.testing.assert_allclose(found.step, -0.2, atol=1e-4)
    # 1 - z is the slope of the objective there.
    np.testing.assert_allclose(found.multipliers, 1.2, rtol=1e-3)


def search_in_valleys(*deep, others=6, function=valleys, **more):
    """A search of which these starts lead to the deep valley."""
    starts = rows(*deep, *np.linspace(-3.9, -1.6, others))
    return search_from(function, starts, 3, z=-0.6, **more)


@pytest.mark.parametrize(("reach", "lost", "best"), [(0.3, 3, LOW), (0.1, 4, 1.04)])
def test_gains_that_are_good_at_one_time_step_only_do_not_count(reach, lost, best):
    """The bottom of the deep valley runs away at a quarter of the step, also at points without
    derivatives.  Starts that come there begin anew beside it, where it is above LOW or below."""

    def at_quarter_step(z):
        return np.where(np.max(np.abs(z - 1.0), axis=1) < reach, 1e30, valleys(z).value.objective)

    comparison = StepComparison(at_quarter_step)
    search = search_in_valleys(1.9, 0.5, comparison=comparison)
    assert search.run(60) == "converged"
    search.consider_values(np.ones((1, 7)), valleys(np.ones((1, 7))).value)
    assert search.state.unresolved == lost and comparison.largest_change == SAME_OBJECTIVE
    assert search.conditions().hold == (best == LOW)
    assert search.state.incumbent_key[1] == pytest.approx(best, rel=0.02)
    assert np.max(np.abs(search.state.incumbent_z - 1.0)) > reach
    assert any(line.startswith(f"{lost} searches came to") for line in _tune._tried(search))
    # No search begins there: the next best points take their place.
    z = rows(1.1, 0.9, -1.5, -2.9, 3.1)
    screening = ranked(z, valleys(z).value)
    box = search.evaluate.space.box
    chosen = distinct(screening, [screening.order()], 2, box, lambda z: False, comparison)
    np.testing.assert_array_equal(chosen, z[2:4])


@pytest.mark.parametrize("change", [2.0, np.nan])
def test_an_objective_that_depends_on_the_step_everywhere_is_compared_as_it_is(change):
    """With the rate of a held torque, or a reading that is rounded: no start is better resolved."""
    comparison = StepComparison(lambda z: change * valleys(z).value.objective)
    search = search_in_valleys(1.9, 0.5, comparison=comparison)
    search.run(60)
    assert search.state.unresolved == 0 and comparison.largest_change > 1.0
    assert search.state.incumbent_key[1] == pytest.approx(DEEP)


def valleys_beside_a_plain(z):
    """Lower than both valleys below -3.8, where a requirement is broken, whatever the step."""
    found, far = valleys(z), z[:, 0] < -3.8
    loss, excess = np.where(far, 0.9, found.value.loss), np.where(far, 0.03, -1.0)
    return found_at(z, loss, found.gradient * ~far[:, None], found.hessian, excess, 0.0 * z)


@pytest.mark.parametrize(("others", "below"), [(6, 0), (7, 0), (6, 1)])
def test_a_third_of_the_starts_near_the_best_and_none_below_it_confirm_it(others, below):
    function = valleys_beside_a_plain if below else valleys
    search = search_in_valleys(1.9, 1.3, 0.5, others=others, function=function)
    outcome = _tune._outcome(search, search.run(60))
    assert search.state.valleys[2:].tolist() == [3, below]
    assert outcome.stopped == ("converged" if others + below == 6 else UNCONFIRMED)
    assert any("had a lower objective" in line for line in outcome.tried) == below


@pytest.mark.slow
def test_a_sliding_mode_that_chatters_at_the_time_step_is_found_at_a_quarter_of_it(paper):
    law = ij.controllers.TerminalSlidingMode(beta=1.0, K=[20.0, 20.0], layer=[0.05, 0.05])
    scenario = ij.with_parts(paper, controller=law)
    goal = objectives.tracking() + objectives.effort()
    gains = ["controller.K", "controller.layer"]
    problem = TuningProblem.build(scenario, gains, goal, duration=0.3, dt=1e-3)
    z = problem.box.z + np.array([[0.0, 0.0, 0.0, 0.0], [3.0, 3.0, -4.0, -4.0]])
    full = evaluation.values(problem, z)
    fine = evaluation.objective_at_quarter_step(problem, z)
    assert np.all(full.valid) and fine[0] == pytest.approx(full.objective[0], rel=SAME_OBJECTIVE)
    assert not abs(fine[1] - full.objective[1]) <= SAME_OBJECTIVE * full.objective[1]


def test_a_search_that_converged_goes_on_from_the_ends_of_the_ranges():
    """All starts end in the broad valley; with both gains at their upper ends the deep one is
    nearer.  The start that converged takes no further steps."""
    box = Box(np.zeros(2), np.full(2, -1.5), np.full(2, 1.5))
    begin = np.array([[-0.9, -1.0], [-1.1, -0.9], [-0.5, -0.8]])
    evaluate = Evaluated(valleys, SearchSpace(box, Constraints.of((1,), (0.0,), 1)), len(begin))
    screening = ranked(np.tile(begin, (9, 1)), valleys(np.tile(begin, (9, 1))).value)
    search = Search(evaluate, SQP(), begin, Strategy(screening, 2, len(begin), starts_at_ends=2))
    begun = []

    def note(search):
        if search.state.phase == SECOND_SEARCH:
            begun.append((search.history["z"][-1], search.state.best_key[:, 1].copy()))

    search.run(60, note)
    z, keys = begun[0]
    assert np.any(np.all(z == 1.5, axis=1)) and np.min(keys) == pytest.approx(LOW)
    assert search.state.incumbent_key[1] == pytest.approx(DEEP)
    assert search.conditions().hold and search.state.valleys[2] == 1


@pytest.mark.parametrize("deep", [[1.9, 0.5], [1.9, 0.5, 0.8]])
def test_a_search_around_the_best_gains_follows_where_few_starts_came_near_them(deep):
    """It begins after the phases that the search has without it, and adds to what they found."""
    starts = rows(*deep, *np.linspace(-3.9, -1.6, 15))
    search = search_from(valleys, starts, selection=3, z=-0.6, starts_around=2)
    phases = []
    search.run(60, lambda x: phases.append(x.state.phase))
    few = len(deep) == 2
    assert search.state.phases_around == few and (SEARCH_AROUND in phases) == few
    assert search.state.incumbent_key[1] == pytest.approx(DEEP)
    assert search.conditions().hold and search.state.valleys[2] == len(deep)
    spread = few * (len(starts) // 3)
    assert search.state.plain_values == len(starts) + spread
    without = search_from(valleys, starts, selection=3, z=-0.6)
    without.run(60)
    steps = phases.count(OPTIMISE)
    assert len(without.history["z"]) == steps and len(search.history["z"]) == len(phases)
    np.testing.assert_array_equal(without.history["z"], search.history["z"][:steps])
