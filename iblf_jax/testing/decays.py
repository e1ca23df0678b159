"""The checker for decays: the contract is `iblf_jax.decays.Decay`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.decays import Decay
from iblf_jax.testing._contract import call_has_shape, check_function, has_shape
from iblf_jax.testing.joints import examine_joints

TIMES = (0.0, 0.3, 1.0, 3.0, 30.0)
VALUES = (0.0, 1e-12, 1e-6, 1e-3, 0.1, 1.0, 30.0, 1e3)
"""Times and values of V at which every decay is evaluated."""
LABEL = "effective_gain(t, k, V)"


def check_decay(decay: object, *, n: int | None = None) -> None:
    """Checks a decay: shapes, derivatives, float32; finite everywhere; never below k; joints apart.

        k(t, V) >= k   for t >= 0, V >= 0

    Args:
      decay: an instance.
      n: number of joints; that of its leaves if not given, 2 if these are scalars.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: `n` is not a number of joints, or not that of the leaves.
    """
    with examine_joints(decay, Decay, n, "decay") as (findings, fitted, joints):
        k = jnp.asarray(np.resize([2.0, 3.0], joints))
        t, V = jnp.asarray(0.4), jnp.asarray(np.resize([0.02, 0.7], joints))
        call_has_shape(findings, LABEL, _gain, (fitted, t, k, V), (joints,))
        findings.stop_if_any()
        check_function(findings, lambda *args: {LABEL: _gain(*args)}, fitted, (t, k, V))
        jacobian = jax.jit(jax.jacfwd(lambda V: _gain(fitted, t, k, V)))(V)
        findings.require(
            np.all(np.diag(np.diag(jacobian)) == jacobian),
            f"{LABEL} mixes joints",
            "The gain of a joint is a function of the V of that joint",
        )
        grid = jnp.meshgrid(jnp.asarray(TIMES), jnp.asarray(VALUES))
        for constant in (k, jnp.zeros_like(k)):

            def at(t, V, constant=constant):
                return _gain(fitted, t, constant, jnp.full_like(constant, V))

            found = np.asarray(jax.jit(jax.vmap(at))(*map(jnp.ravel, grid)))
            findings.require(np.all(np.isfinite(found)), f"{LABEL} is not finite somewhere")
            findings.require(
                np.all(found >= np.asarray(constant) * (1.0 - 1e-12)),
                f"{LABEL} is below k",
                "Add a positive gain to k: the claims of a law for k must remain true",
            )
        for name, stated in (("band", fitted.band()), ("deadline", fitted.deadline())):
            if stated is not None:
                has_shape(findings, f"{name}()", stated, (joints,))
                findings.require(np.all(np.asarray(stated) > 0), f"{name}() is not positive")


def _gain(decay: Decay, t: jax.Array, k: jax.Array, V: jax.Array) -> jax.Array:
    return decay.effective_gain(t, k, V)  # type: ignore[no-any-return]
