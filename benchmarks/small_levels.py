"""Proofs at small levels by one matrix inequality for each time and parameter: boxes and seconds.

    python benchmarks/small_levels.py [--quick] [--json FILE] [--points 1e5] [--boxes 2e4]

On {V_w <= c} the rate f' of arm_motion is affine in f_tilde. By the mean value theorem along the
ray from 0 to y = (xi, e2),

    f' = f0 + J y + H f_tilde,   f0 = f' at y = 0 and f_tilde = 0,                             (S.1)

where J encloses the mean of df'/dy on the ray, and H is enclosed, over the box Y of (xi, e2) that
contains the set. With w V1 >= q xi^2 on Y, the decay kappa w V1 of the barriers and any multiplier
0 < mu < kappa, V_w' = V_w' + mu (V_w - c) on V_w = c is at most -(1, y, f_tilde) A (1, y, f_tilde),

    A = [ mu c                                        ]
        [ 0        (kappa - mu) q                     ]
        [ 0        0               K2 - mu M0/2       ]                                        (S.2)
        [ -w f0/2  -w J_xi/2       -(I + w J_e2)/2    w (kf - mu/2 - (H + H^T)/2) ]

of which the lower triangle is shown. If A is positive definite for each time, parameter and side of
the tube of each joint, V_w' < 0 everywhere on V_w = c. The search bisects time and parameters only.
The seconds are processor time; those of the first case of a number of joints include the program.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _timing import report
from proofs import MASSES, chain, percent

from iblf_jax.kernels import enclose, hull, meet, upper, with_sign
from iblf_jax.proofs import arm_motion
from iblf_jax.proofs.arm_bound import Constants, mismatch
from iblf_jax.proofs.arm_motion import Errors
from iblf_jax.proofs.arms import ArmProblem, arm_problem
from iblf_jax.proofs.forms import along
from iblf_jax.proofs.matrices import inverse
from iblf_jax.proofs.uncertainty import Places

COLUMNS = ["case", "masses", "level", "w", "verdict", "boxes", "seconds", "largest V_w'/c found"]
SHARES = (0.03, 0.1, 0.25, 0.5, 0.75)
"""Multipliers mu that are tried on each box, in parts of the least kappa."""
ROUNDING = 1e-13
"""Bound of the relative error of the sums of products below, of at most 100 terms each."""
MOST_BISECTIONS = 14
"""Bisections of a box, after which the level counts as not proved."""


class Coefficients:
    """The coefficients of (S.2) over a box x = (t - t_0, z, direction of y, signs, t_0)."""

    def __init__(self, structure: Any, places: Places) -> None:
        self.structure = structure
        self.places = places

    def __call__(self, x: jax.Array, constants: list[jax.Array]) -> tuple[jax.Array, ...]:
        """f0 and J along the direction, (1 + m, n) each, H, (1 + m, n, n), M0, (n, n), q and the
        largest xi, (n,) each; of what depends on the parameters first the value at the centre of
        their box, then the derivative by each of them.
        """
        numbers: Constants = jax.tree.unflatten(self.structure, constants)
        parts, level = numbers.parts, numbers.level
        n, m = parts.kf.shape[0], self.places.coordinates
        t, z, sign = x[-1] + x[0], x[1 : 1 + m], x[-1 - n : -1]
        direction = (x[1 + m : 1 + m + n], x[1 + m + n : 1 + m + 2 * n])
        one, zero = jnp.ones(n), jnp.zeros(n)
        most = arm_motion.error_at(parts, t, level * one, sign)
        reach = hull(zero, most)
        xi, start = with_sign(reach, sign), with_sign(zero * sign, sign)
        M0 = parts.model.mass_matrix(arm_motion.position(parts, Errors(t, xi, zero)))
        M0_inverse = inverse(M0)
        size = jnp.sqrt(2.0 * level * jnp.stack([upper(M0_inverse[i, i]) for i in range(n)]))
        e2 = hull(-size, size)

        def barrier_slope(xi: jax.Array) -> jax.Array:
            return along(lambda xi: arm_motion.weighted_barrier(parts, t, xi), (xi,), (one,))

        def rate(xi: jax.Array, e2: jax.Array) -> jax.Array:
            found = mismatch(numbers, self.places, Errors(t, xi, e2), z)
            return jnp.stack([found.constant.value, *(each.value for each in found.columns)])

        def column(xi: jax.Array, e2: jax.Array) -> jax.Array:
            return along(rate, (xi, e2), direction)

        everywhere = mismatch(numbers, self.places, Errors(t, xi, e2), z)
        H = jnp.stack([everywhere.constant.slope, *(each.slope for each in everywhere.columns)])
        # The mean of J on the ray is J(0) and half of a mean of its derivative along y.
        change = along(column, (xi, e2), (0.5 * reach, 0.5 * e2))
        J = meet(column(xi, e2), column(start, zero) + change)
        q = 0.5 * along(barrier_slope, (xi,), (one,))
        return rate(start, zero), J, H, M0, q, most


class Enclosed(NamedTuple):
    """Numbers of boxes in intervals: middle and radius, (k, ...) each."""

    middle: np.ndarray
    radius: np.ndarray


def enclosed(lower: np.ndarray, upper: np.ndarray) -> Enclosed:
    """Intervals with these ends."""
    middle = 0.5 * (lower + upper)
    radius = np.maximum(upper - middle, middle - lower)
    return Enclosed(middle, radius * (1.0 + ROUNDING) + ROUNDING * np.abs(middle))


class BoxCoefficients(NamedTuple):
    """The coefficients of (S.2) of boxes."""

    f0: Enclosed
    J: Enclosed
    H: Enclosed
    M0: Enclosed
    q: np.ndarray
    """Lower bounds, (k, n)."""
    is_inside: np.ndarray
    """Whether the set is inside the guard of the barrier, (k,)."""


def coefficients(
    problem: ArmProblem,
    function: Callable,
    constants: list[np.ndarray],
    boxes: tuple[np.ndarray, np.ndarray],
) -> BoxCoefficients:
    """The coefficients of boxes of (t - t_0, z, signs, t_0), (k, d) each."""
    n, m = problem.scenario.n, problem.uncertain.places.coordinates
    columns = []
    for unit in np.eye(2 * n):
        low, high = (
            np.concatenate([end[:, : 1 + m], np.tile(unit, (len(end), 1)), end[:, 1 + m :]], axis=1)
            for end in boxes
        )
        lower, upper_ends = enclose(function, low, high, constants)
        columns.append(enclosed(lower[1], upper_ends[1]))
    J = Enclosed(
        np.stack([each.middle for each in columns], axis=-1),
        np.stack([each.radius for each in columns], axis=-1),
    )
    f0, H, M0 = (enclosed(lower[i], upper_ends[i]) for i in (0, 2, 3))
    most = np.maximum(np.abs(lower[5]), np.abs(upper_ends[5]))
    guard = float(problem.parts.guard)
    return BoxCoefficients(f0, J, H, M0, lower[4], most.max(axis=1) < 1.0 - guard)


def at_corner(terms: Enclosed, corner: np.ndarray) -> Enclosed:
    """What is affine in the parameters, at their differences from the centre, (k, m)."""
    factors = np.concatenate([np.ones((len(corner), 1)), corner], axis=1)
    factors = factors.reshape(*factors.shape, *[1] * (terms.middle.ndim - 2))
    middle = np.sum(factors * terms.middle, axis=1)
    size = np.sum(np.abs(factors * terms.middle), axis=1)
    radius = np.sum(np.abs(factors) * terms.radius, axis=1)
    return Enclosed(middle, radius * (1.0 + ROUNDING) + ROUNDING * size)


def matrix(
    problem: ArmProblem,
    found: BoxCoefficients,
    corner: np.ndarray,
    mu: float,
    weight: float,
    level: float,
) -> Enclosed:
    """A of (S.2) at a corner of the parameters, (k, 3n + 1, 3n + 1)."""
    n, law = problem.scenario.n, problem.parts.law
    f0, J, H = (at_corner(x, corner) for x in (found.f0, found.J, found.H))
    kappa = np.asarray(law.barrier.decay_rate(law.k1)) * np.ones(n)
    kf = np.asarray(problem.parts.kf) * np.ones(n)
    size = 3 * n + 1
    middle, radius = np.zeros((2, len(corner), size, size))
    i = np.arange(n)
    xi, e2, f = (slice(1 + k * n, 1 + (k + 1) * n) for k in range(3))
    middle[:, 0, 0] = mu * level
    middle[:, xi, xi][:, i, i] = (kappa - mu) * found.q
    middle[:, e2, e2] = -0.5 * mu * found.M0.middle
    middle[:, e2, e2][:, i, i] += np.asarray(law.K2) * np.ones(n)
    radius[:, e2, e2] = 0.5 * mu * found.M0.radius
    middle[:, f, 0] = -0.5 * weight * f0.middle
    radius[:, f, 0] = 0.5 * weight * f0.radius
    middle[:, f, 1 : 1 + 2 * n] = -0.5 * weight * J.middle
    radius[:, f, 1 : 1 + 2 * n] = 0.5 * weight * J.radius
    middle[:, f, e2][:, i, i] -= 0.5
    middle[:, f, f] = -0.5 * weight * (H.middle + H.middle.swapaxes(1, 2))
    middle[:, f, f][:, i, i] += weight * (kf - 0.5 * mu)
    radius[:, f, f] = 0.5 * weight * (H.radius + H.radius.swapaxes(1, 2))
    above = (slice(None), slice(0, 1 + 2 * n), f)
    middle[above], radius[above] = (x[:, f, : 1 + 2 * n].swapaxes(1, 2) for x in (middle, radius))
    # The sums above have at most three terms, none of which is larger than these.
    largest = np.abs(middle) + max(1.0, *np.ravel(law.K2), *(weight * kf))
    largest[:, xi, xi] += (kappa * found.q).max(axis=1)[:, None, None]
    largest[:, f, f] += weight * (np.abs(H.middle) + np.abs(H.middle).swapaxes(1, 2))
    return Enclosed(middle, radius * (1.0 + ROUNDING) + ROUNDING * largest)


def are_definite(A: Enclosed) -> np.ndarray:
    """Whether all symmetric matrices of intervals are positive definite, (k,).

    P A P^T has dominant diagonal entries, with the inverse P of an approximate Cholesky factor of
    the middle. For whatever P, this shows that P is regular and A positive definite.
    """
    P = np.zeros_like(A.middle)
    for k, middle in enumerate(A.middle):
        try:
            P[k] = np.linalg.inv(np.linalg.cholesky(middle))
        except np.linalg.LinAlgError:
            continue
    P_T = P.swapaxes(1, 2)
    middle = P @ A.middle @ P_T
    # Rounding of the products is in it.
    size = np.abs(P) @ (A.radius + ROUNDING * np.abs(A.middle)) @ np.abs(P_T)
    i = np.arange(middle.shape[1])
    diagonal = middle[:, i, i]
    others = np.abs(middle).sum(axis=2) - np.abs(diagonal) + size.sum(axis=2)
    return np.nan_to_num(diagonal - others * (1.0 + ROUNDING), nan=-1.0).min(axis=1) > 1e-9


class Result(NamedTuple):
    """The result of a search."""

    proved: bool
    boxes: int
    seconds: float


def searched(
    problem: ArmProblem, function: Callable, weight: float, level: float, max_boxes: int
) -> Result:
    """Whether (S.2) is positive definite for all times, parameters and sides."""
    begin = time.process_time()
    constants = problem.constants(weight, level)
    law, m = problem.parts.law, problem.uncertain.places.coordinates
    least = float(np.min(np.asarray(law.barrier.decay_rate(law.k1))))
    part = problem.upper[0]
    lower = np.array([0.0, *problem.uncertain.low])
    upper_ends = np.array([part, *problem.uncertain.high])
    patterns = problem.patterns
    low, high = (
        np.concatenate([np.tile(end, (len(patterns), 1)), patterns], axis=1)
        for end in (lower, upper_ends)
    )
    boxes = 0
    for generation in range(MOST_BISECTIONS):
        boxes += len(low)
        if boxes > max_boxes:
            break
        found = coefficients(problem, function, constants, (low, high))
        half = 0.5 * (high - low)[:, 1 : 1 + m] * (1.0 + 1e-9)
        is_done = found.is_inside.copy()
        # A is affine in the parameters and mu together, so that mu may differ between corners.
        for signs in itertools.product((-1.0, 1.0), repeat=m):
            is_definite = np.zeros(len(low), bool)
            for share in SHARES:
                A = matrix(problem, found, signs * half, share * least, weight, level)
                is_definite |= are_definite(A)
            is_done &= is_definite
        low, high = low[~is_done], high[~is_done]
        if len(low) == 0:
            return Result(True, boxes, time.process_time() - begin)
        # Bisection of the time, or of the widest parameter in its turn.
        k = 1 + generation // 4 % m if generation % 4 == 3 and m > 0 else 0
        left, right = high.copy(), low.copy()
        left[:, k] = right[:, k] = 0.5 * (low[:, k] + high[:, k])
        low, high = np.concatenate([low, right]), np.concatenate([left, high])
    return Result(False, boxes, time.process_time() - begin)


# --- the cases -----------------------------------------------------------------------------------


class Case(NamedTuple):
    """A level of an arm of equal motions, with one shared factor of all masses and inertias."""

    joints: int
    width: float
    """Of the interval of the masses, +- per cent."""
    weight: float
    """w [rad/(N m)]."""
    level: float
    """c [N m rad]."""


QUICK = [Case(1, 1.0, 2e-3, 0.01)]
CASES = [
    *QUICK,
    Case(3, 0.05, 4e-3, 8e-4),
    Case(3, 0.2, 4e-3, 1e-4),
    Case(3, 0.2, 4e-3, 3e-4),
    Case(3, 0.2, 4e-3, 4e-4),
    Case(3, 1.0, 4e-3, 6e-5),
    Case(3, 1.0, 4e-3, 8e-5),
    Case(3, 5.0, 4e-3, 1e-5),
]


def problem_of(case: Case) -> ArmProblem:
    """The proof problem of a case."""
    return arm_problem(chain(case.joints), percent(MASSES, case.width, shared=True))


def largest_rate(problem: ArmProblem, weight: float, level: float, count: int) -> float:
    """The largest V_w'/c at random points of V_w = c, by equations of their own."""
    constants = problem.constants(weight, level)
    part = 100_000
    rates = [
        problem.rate(problem.sample(seed, min(part, count)), constants).max()
        for seed in range(math.ceil(count / part))
    ]
    return float(max(rates)) / level


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json")
    parser.add_argument("--points", type=float, default=1e5, help="random points of each level")
    parser.add_argument("--boxes", type=float, default=2e4, help="largest number of boxes")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    functions: dict[int, Coefficients] = {}
    for case in QUICK if args.quick else CASES:
        problem = problem_of(case)
        structure, places = problem.bound.structure, problem.bound.places
        function = functions.setdefault(case.joints, Coefficients(structure, places))
        found = searched(problem, function, case.weight, case.level, int(args.boxes))
        rate = largest_rate(problem, case.weight, case.level, int(args.points))
        words = f"{case.joints} links"
        verdict = "proved" if found.proved else "not proved"
        seconds = round(found.seconds, 1)
        row = [words, f"{case.width:g} %", case.level, case.weight, verdict, found.boxes, seconds]
        rows.append([*row, round(rate, 2)])
    report("Proofs at small levels", COLUMNS, rows, args.json)


if __name__ == "__main__":
    main()
