"""Runs with derivatives along the coordinates of a tuning (forward mode), and evaluation in groups
of one size.

The leaves of a batch are functions x_b(z) of D coordinates, of another Jacobian in every run.  The
engine moves leaves along fixed patterns p (one entry of a leaf, or all of them together), so that
its program does not depend on where it is called.  The chain rule does the rest,

    dx_b/dz_d = sum_p C_bpd pattern_p,      dm_b/dz_d = sum_p C_bpd dm_b/dp,
    N_b = C_b^T N_b(patterns) C_b.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.engine import RunRequest, Tangents, run_batch_jvp
from iblf_jax.simulation.scenario import Scenario

if TYPE_CHECKING:
    from iblf_jax.simulation.metrics import Fold

NUMBERS_A_RUN = 100
"""Approximate count of numbers that one run of a batch holds while it is computed: its state, its
stages, its folds."""


def in_groups(
    function: Callable[[np.ndarray], Any],
    count: int,
    size: int,
    advance: Callable[[int], object] = lambda rows: None,
) -> Any:
    """What a function of row numbers returns for rows 0 to `count` - 1, as NumPy arrays.

    It is called with `size` rows at a time, so that one shape is compiled; the last group is filled
    up with its last row, and a kernel of a CPU computes copies at the end of a batch once.

    Args:
      function: of row numbers, (size,).
      count: number of rows.
      size: number of rows of a group.
      advance: called with the number of rows of each group once it is computed.
    """
    parts = []
    for first in range(0, count, size):
        own = min(size, count - first)
        rows = np.minimum(np.arange(first, first + size), count - 1)
        parts.append(jax.tree.map(np.asarray, function(rows)))
        advance(own)
    return jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)


def tangents_of_runs(
    scenario: Scenario,
    varied: Mapping[str, jax.Array],
    jacobians: Mapping[str, jax.Array],
    folds: tuple[Fold, ...],
    dt: jax.Array,
    request: RunRequest,
    *,
    uniform: Collection[str] = (),
) -> Tangents:
    """Runs a batch with its tangents along the coordinates; call it inside `jit`.

    Args:
      scenario: what all runs share, canonical.
      varied: path -> values, (B, ...).
      jacobians: path -> dx/dz, (B, ..., D), for the paths that depend on the coordinates.
      folds: the metrics.
      dt: time step, () [s].
      request: what is run, static.
      uniform: paths all of whose entries have the same derivative: one pattern for the leaf.

    Returns:
      `Tangents`, run axis first, along the D coordinates.
    """
    patterns = {}
    for path, x in jacobians.items():
        shape = x.shape[1:-1]
        # A uniform leaf moves at once, and the entries of another one after one another.
        entries = np.eye(int(np.prod(shape))).reshape(-1, *shape)
        patterns[path] = np.ones((1, *shape)) if path in uniform else entries
    found = run_batch_jvp(scenario, varied, _directions(patterns), folds, dt, request)
    by_entry = {path: x.reshape(len(x), -1, x.shape[-1]) for path, x in jacobians.items()}
    C = jnp.concatenate([x[:, : len(patterns[path])] for path, x in by_entry.items()], axis=1)
    tangents = jax.tree.map(lambda x: jnp.einsum("bpd,bp...->bd...", C, x), found.tangents)
    products = tuple(jnp.einsum("bpd,bpq,bqe->bde", C, N, C) for N in found.products)
    return Tangents(found.outcome, tangents, products)


def _directions(patterns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Path -> (P, ...): the patterns of all leaves numbered one after the other, zero where a
    pattern belongs to another leaf.
    """
    total = sum(len(x) for x in patterns.values())
    directions = {}
    first = 0
    for path, pattern in patterns.items():
        after = total - first - len(pattern)
        of_entries = [(0, 0)] * (pattern.ndim - 1)
        directions[path] = np.pad(pattern, [(first, after), *of_entries])
        first += len(pattern)
    return directions
