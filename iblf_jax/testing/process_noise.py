"""The checker for process noise: the contract is `iblf_jax.process_noise.ProcessNoise`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.testing._contract import Findings, call_has_shape, check_function
from iblf_jax.testing.joints import examine_joints
from iblf_jax.world.process_noise import ProcessNoise, check_structure

LABEL = "diffusion(t, x)"
TIMES, SIZES = (0.0, 0.3, 4.0), (0.0, 1.0, 30.0)
"""Times, and largest sizes of x, at which the noise is evaluated."""
LEAST_ORDER = 2
"""Least number of levels of a plant."""


def check_process_noise(noise: object, *, n: int | None = None) -> None:
    """Checks process noise: its levels, shapes, derivatives, float32; finite everywhere; whether
    `additive` is true.

        dx_i = (...) dt + sigma_i(t, x) dW_i,   additive: d sigma/dx = 0

    Args:
      noise: an instance.
      n: number of components of a level; that of its leaves if not given, 2 if these are scalars.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: `n` is not a number of joints, or not that of the leaves.
    """
    with examine_joints(noise, ProcessNoise, n, "process_noise") as (findings, fitted, n):
        _structure(findings, fitted)
        order = max(LEAST_ORDER, *fitted.levels)
        x = jnp.asarray(np.random.default_rng(4).uniform(0.3, 1.0, (order, n)))
        t = jnp.asarray(0.4)
        call_has_shape(findings, LABEL, _diffusion, (fitted, t, x), (len(fitted.levels), n))
        findings.stop_if_any()
        check_function(findings, lambda *args: {LABEL: _diffusion(*args)}, fitted, (t, x))
        _values(findings, fitted, x)


def _diffusion(noise: ProcessNoise, t: jax.Array, x: jax.Array) -> jax.Array:
    return noise.diffusion(t, x)  # type: ignore[no-any-return]


def _structure(findings: Findings, noise: ProcessNoise) -> None:
    """Requires increasing levels, a number of substeps, and a Boolean `additive`."""
    try:
        check_structure(noise)
        checks.boolean(f"{type(noise).__name__}.additive", noise.additive)
    except ValueError as error:
        findings.stop(str(error))


def _values(findings: Findings, noise: ProcessNoise, x: jax.Array) -> None:
    """Requires finite values at many states, and, of additive noise, values that do not depend on
    the state.
    """
    signs = np.where(np.indices(x.shape).sum(axis=0) % 2, -1.0, 1.0)
    states = np.stack([sign * size * np.asarray(x) for size in SIZES for sign in (1.0, signs)])
    at_states = jax.vmap(lambda t, x: _diffusion(noise, t, x), (None, 0))
    found = np.asarray(jax.jit(jax.vmap(at_states, (0, None)))(jnp.asarray(TIMES), states))
    findings.require(np.all(np.isfinite(found)), f"{LABEL} is not finite somewhere")
    if noise.additive:
        findings.require(
            np.all(found == found[:, :1]),
            f"additive is True, and {LABEL} depends on x",
            "Leave `additive` out: methods of strong order 1 would converge to another solution",
        )
