"""Algebra without branches: what each function promises, by NumPy."""

import numpy as np
import pytest
from by_numpy import computed

from iblf_jax.proofs import matrices


@pytest.mark.parametrize("n", [1, 2, 3])
def test_each_function_solves_its_equation(rng, n):
    root = rng.normal(size=(n, n))
    symmetric, near_one = root @ root.T + np.eye(n), np.eye(n) + 0.1 * root
    rhs = rng.normal(size=n)

    def all_of_them(symmetric, near_one, rhs):
        U = matrices.upper_factor(symmetric)
        return (
            matrices.solve_upper(U, rhs),
            matrices.solve_transposed(U, rhs),
            matrices.inverse(symmetric),
            matrices.solve_general(near_one, rhs),
            matrices.least_eigenvalue(symmetric),
            matrices.norm(rhs),
            matrices.sphere(list(rhs)),
        )

    a, b, inverse, general, least, norm, point = computed(all_of_them, symmetric, near_one, rhs)
    exchange = np.eye(n)[::-1]
    U = exchange @ np.linalg.cholesky(exchange @ symmetric @ exchange) @ exchange
    np.testing.assert_allclose(U @ a, rhs, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(U.T @ b, rhs, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(inverse, np.linalg.inv(symmetric), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(near_one @ general, rhs, rtol=1e-10, atol=1e-12)
    assert norm == pytest.approx(np.linalg.norm(rhs))
    cosines = np.append(np.cos(rhs), 1.0)
    np.testing.assert_allclose(point, cosines * np.append(1.0, np.cumprod(np.sin(rhs))))
    radii = np.sum(np.abs(symmetric), axis=1) - 2.0 * np.diag(symmetric)
    assert least == pytest.approx(np.linalg.eigvalsh(symmetric)[0] if n < 3 else -np.max(radii))
