"""Tangents of a batch by coordinates that leaves depend on: the lowered sensitivities by the
leaves, and the chain rule.

A batch's leaves are functions x_b(z) of D coordinates, of another slope in every run.
`run_batch_jvp` moves leaves along fixed patterns p (one entry of a leaf, or all of them together),
so that its program does not depend on where it is called:

    dx_b/dz_d = sum_p C_bpd pattern_p,      dm_b/dz_d = sum_p C_bpd dm_b/dp,      N_b = C_b^T
    N_b(patterns) C_b.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.engine.derivatives import Tangents
from iblf_jax.engine.execute import run_batch_jvp
from iblf_jax.engine.step import Run
from iblf_jax.simulation.scenario import Scenario


def by_coordinates(
    scenario: Scenario,
    varied: Mapping[str, jax.Array],
    slopes: Mapping[str, jax.Array],
    folds,
    dt: jax.Array,
    run: Run,
    *,
    backend: str,
    nested: bool = False,
    together: Collection[str] = (),
) -> Tangents:
    """Runs a batch with its tangents along the coordinates; call it inside `jit`.

    Args:
      scenario: what all runs share, canonical.
      varied: path -> values, (B, ...).
      slopes: path -> dx/dz, (B, ..., D), for the paths that depend on the coordinates.
      folds: the metrics.
      dt: time step, () [s].
      run, backend, nested: static, as `run_batch`.
      together: paths all of whose entries have the same slope: one pattern instead of one an entry.

    Returns:
      `Tangents`, run axis first, along the D coordinates.
    """
    shapes = {path: x.shape[1:-1] for path, x in slopes.items()}
    patterns = {
        path: np.ones((1, *s)) if path in together else np.eye(int(np.prod(s))).reshape(-1, *s)
        for path, s in shapes.items()
    }
    counts = np.cumsum([0, *(len(x) for x in patterns.values())])
    directions = {
        path: np.concatenate(
            [
                np.zeros((before, *x.shape[1:])),
                x,
                np.zeros((counts[-1] - before - len(x), *x.shape[1:])),
            ]
        )
        for (path, x), before in zip(patterns.items(), counts, strict=False)
    }
    found = run_batch_jvp(
        scenario, varied, directions, folds, dt, run, backend=backend, nested=nested
    )
    flat = [
        x.reshape(len(x), -1, x.shape[-1])[:, : len(patterns[path])] for path, x in slopes.items()
    ]
    C = jnp.concatenate(flat, axis=1)
    tangents = jax.tree.map(lambda x: jnp.einsum("bpd,bp...->bd...", C, x), found.tangents)
    return Tangents(
        found.outcome,
        tangents,
        tuple(jnp.einsum("bpd,bpq,bqe->bde", C, N, C) for N in found.products),
    )
