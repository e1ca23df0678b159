"""Products and solutions with a constant sparse matrix, whose zeros cost nothing.

The matrix is known when a program is traced.  The factors are computed then, by NumPy, and the
program contains one operation for each of their nonzero entries.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.core.caches import memoised

Rows = tuple[tuple[float, ...], ...]
"""A matrix as a tuple of rows, which can be hashed."""


class Factors(NamedTuple):
    """L U = P A P^T, where L has a unit diagonal and P reorders the rows."""

    order: tuple[int, ...]
    """Row k of the reordered matrix is row order[k] of A."""
    lower: np.ndarray
    upper: np.ndarray


def times(matrix: Rows, parts: Sequence[Any]) -> list[Any]:
    """The product of a matrix and a vector whose entries are arrays of one shape.

    Args:
      matrix: A, m rows of k numbers.
      parts: the k entries of the vector.
    """
    return [_combination(row, parts) for row in matrix]


def solve(matrix: Rows, parts: Sequence[Any]) -> list[Any]:
    """The solution of A z = b, for a matrix whose factorisation needs no pivoting.

    The diagonally dominant matrices of graphs (nonsingular M-matrices) are such matrices: every
    pivot is positive (A. Berman, R. J. Plemmons, Nonnegative Matrices in the Mathematical Sciences,
    1994, theorem 6.2.3).

    Args:
      matrix: A, m rows of m numbers.
      parts: the m entries of b, arrays of one shape.
    """
    factors = factorised(matrix)
    found: list[Any] = []
    for k, row in enumerate(factors.lower):
        known = _combination(row[:k], found)
        found.append(parts[factors.order[k]] - known)
    for k in reversed(range(len(found))):
        row = factors.upper[k]
        rest = found[k] - _combination(row[k + 1 :], found[k + 1 :])
        found[k] = rest / float(row[k])
    solution: list[Any] = [None] * len(found)
    for k, place in enumerate(factors.order):
        solution[place] = found[k]
    return solution


@memoised(64)
def factorised(matrix: Rows) -> Factors:
    """The factors of a matrix, with the rows in an order that keeps most zeros."""
    full = np.asarray(matrix, float)
    order = _elimination_order(full != 0.0)
    upper = full[np.ix_(order, order)]
    lower = np.eye(len(order))
    for k in range(len(order)):
        lower[k + 1 :, k] = upper[k + 1 :, k] / upper[k, k]
        upper[k + 1 :, k:] -= np.outer(lower[k + 1 :, k], upper[k, k:])
    return Factors(tuple(order), lower, upper)


def _elimination_order(pattern: np.ndarray) -> list[int]:
    """The order in which each row fills few entries: that of the smallest product of off-diagonal
    entries in row and column first (H. M. Markowitz, Management Science 3 (1957) 255-269).
    """
    filled = pattern | np.eye(len(pattern), dtype=bool)
    remaining = list(range(len(pattern)))
    order = []
    while remaining:
        part = filled[np.ix_(remaining, remaining)]
        fill = (part.sum(axis=0) - 1) * (part.sum(axis=1) - 1)
        chosen = remaining.pop(int(np.argmin(fill)))
        order.append(chosen)
        filled |= np.outer(filled[:, chosen], filled[chosen])
    return order


def _combination(row: Sequence[float], parts: Sequence[Any]) -> Any:
    """The sum of row[j] parts[j] over the nonzero entries of a row; 0.0 for none."""
    total: Any = 0.0
    for weight, part in zip(row, parts, strict=True):
        if weight == 0.0:
            continue
        term = part if weight == 1.0 else float(weight) * part
        total = term if isinstance(total, float) else total + term
    return total
