"""The quadratic programme of fixed length: beside a maintained solver, where there is no solution,
and its derivatives."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.sparse import csc_matrix

from iblf_jax.core.qp import quadratic_program

qpsolvers = pytest.importorskip("qpsolvers")
SOLVED = jax.jit(jax.vmap(quadratic_program))
TIGHT = {"tol_gap_abs": 1e-13, "tol_gap_rel": 1e-13, "tol_feas": 1e-13}


def random_programs(rng, count, n, m):
    """Programmes with a solution; scales of H, of the rows and of the distances over two to three
    decades."""
    A = rng.normal(size=(count, n, n)) * 10 ** rng.uniform(-0.5, 1, (count, 1, 1))
    H = np.einsum("bij,bkj->bik", A, A) + 0.1 * np.eye(n)
    G = rng.normal(size=(count, m, n)) * 10 ** rng.uniform(-1, 2, (count, m, 1))
    inside = rng.normal(size=(count, n)) * 10 ** rng.uniform(-1, 2, (count, 1))
    room = np.abs(rng.normal(size=(count, m))) * np.linalg.norm(G, axis=2)
    room *= 10 ** rng.uniform(-2, 1, (count, 1))
    return H, G, np.einsum("bij,bj->bi", G, inside) + room


def elsewhere(H, g, G, h):
    """The solution by Clarabel, or None where it gives up."""
    H, G = map(csc_matrix, (H, G))
    with warnings.catch_warnings(action="ignore"):
        return qpsolvers.solve_qp(H, g, G, h, solver="clarabel", **TIGHT)


@pytest.mark.parametrize(
    ("n", "m", "count"), [(2, 8, 300), pytest.param(7, 30, 500, marks=pytest.mark.slow)]
)
def test_random_programs_have_the_solution_of_a_maintained_solver(n, m, count, rng):
    H, G, h = random_programs(rng, count, n, m)
    soft = np.tile(np.arange(m) % 2, (count, 1)).astype(float)
    found = SOLVED(H, G, h, soft)
    assert np.all(np.asarray(found.slack) == 0)
    others = [elsewhere(H[i], np.zeros(n), G[i], h[i]) for i in range(count)]
    solved = [i for i, x in enumerate(others) if x is not None]
    assert len(solved) > 0.97 * count
    x, expected = np.asarray(found.x)[solved], np.stack([others[i] for i in solved])
    assert np.all(np.abs(x - expected) <= 1e-8 * (1 + np.abs(expected).max(axis=1, keepdims=True)))
    active = np.einsum("bij,bj->bi", G[solved], expected) > h[solved] - 1e-6
    assert np.mean(np.any(active, axis=1)) > 0.3  # not all of them are free


@pytest.mark.parametrize(("n", "rows"), [(2, 6), pytest.param(7, 16, marks=pytest.mark.slow)])
def test_what_has_no_solution_is_the_least_breaking_and_says_so(n, rows, rng):
    """Soft rows near and far within a hard box: no point breaks the same rows less (by bounded
    least squares)."""
    A = rng.normal(size=(200, rows, n))
    A /= np.linalg.norm(A, axis=2, keepdims=True)
    room = rng.uniform(-1.5, 0.5, (200, rows)) * 10 ** rng.uniform(-2, 2, (200, 1))
    box = np.broadcast_to(np.concatenate([np.eye(n), -np.eye(n)]), (200, 2 * n, n))
    G, h = np.concatenate([A, box], axis=1), np.concatenate([room, np.ones((200, 2 * n))], axis=1)
    soft = np.broadcast_to(np.r_[np.ones(rows), np.zeros(2 * n)], h.shape)
    found = SOLVED(np.broadcast_to(np.eye(n), (200, n, n)), G, h, soft)
    x = np.asarray(found.x)
    assert np.max(np.abs(x)) <= 1 + 1e-9  # the box is never broken
    broken = np.einsum("bij,bj->bi", A, x) - room
    np.testing.assert_allclose(found.slack[:, :rows], np.maximum(broken, 0.0), atol=1e-6)
    lost = np.flatnonzero(np.any(broken > 1e-6, axis=1))
    for k in lost:
        active = broken[k] > 1e-9
        best = lsq_linear(A[k][active], room[k][active], (-1 - 1e-12, 1 + 1e-12), tol=1e-14).cost
        assert 0.5 * np.sum(broken[k][active] ** 2) <= best * (1 + 1e-6) + 1e-12
    assert len(lost) > 100


@pytest.mark.slow
def test_derivatives_are_those_of_the_solution(rng):
    H, G, h = (jnp.asarray(x[0]) for x in random_programs(rng, 1, 3, 8))
    soft = jnp.ones(8)
    assert np.any(G @ jax.jit(quadratic_program)(H, G, h, soft).x > h - 1e-6)  # some are active
    dH, dG, dh = (jnp.asarray(rng.normal(size=x.shape)) for x in (H, G, h))
    dH = dH + dH.T

    @jax.jit
    def x(e):
        return quadratic_program(H + e * dH, G + e * dG, h + e * dh, soft).x

    @jax.jit
    def by_e(e):
        return jax.jvp(x, (e,), (1.0,))[1]

    moved = by_e(0.0)
    assert float(jnp.max(jnp.abs(moved))) > 0.1
    step = 1e-6
    np.testing.assert_allclose(moved, (x(step) - x(-step)) / (2 * step), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.jacrev(x))(0.0), moved, rtol=1e-9)
    second, slope = jax.jit(jax.jacfwd(by_e))(0.0), (by_e(step) - by_e(-step)) / (2 * step)
    np.testing.assert_allclose(second, slope, rtol=1e-4, atol=1e-3 * np.max(np.abs(second)))


def test_float32_is_finite_and_near(rng):
    H, G, h = random_programs(rng, 200, 2, 8)
    arguments = (H, G, h, np.ones(h.shape))
    exact, near = (
        np.asarray(SOLVED(*(jnp.asarray(x, dtype) for x in arguments)).x)
        for dtype in ("float64", "float32")
    )
    assert near.dtype == np.float32
    scale = 1 + np.max(np.abs(h) / np.linalg.norm(G, axis=2), axis=1)
    off = np.max(np.abs(exact - near), axis=1) / scale
    assert np.max(off) < 1e-2
    assert np.median(off) < 1e-5


def test_rows_of_zeros_bind_nothing():
    G, h = jnp.diag(jnp.array([1.0, 0.0])), jnp.array([-1.0, 3.0])
    found = quadratic_program(jnp.eye(2), G, h, jnp.ones(2))
    np.testing.assert_allclose(found.x, [-1.0, 0.0], atol=1e-9)
