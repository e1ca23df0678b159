"""Noise of the sensor of a sampled law: standard normal numbers that depend only on the run and the
sample.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.simulation.scenario import Scenario

NOISE_NAME = "noise"
"""Name of the noise key among the replaced values of a run; no leaf of a scenario has this name."""
NOISE_STREAM = 0x6E6F6973
"""Folded into a key so that the noise is independent of the draws of a study."""
ROUNDS = 10
MULTIPLIERS = (0x6A09, 0x5BB7)
"""Odd, below 2^15."""
WEYL = (0x9E37, 0xBB67)
WORD = 1 << 16
"""The generator works on words of 16 bits, whose products fit the integers of every backend."""


def noise_key(key: jax.Array, run: int | jax.Array = 0) -> jax.Array:
    """Four words of 16 bits, as floats, for the noise of one run of a study whose seed gave `key`;
    (4,) float32.
    """
    own = jax.random.fold_in(jax.random.fold_in(key, run), NOISE_STREAM)
    return jax.random.bits(own, (4,), jnp.uint16).astype(jnp.float32)


def has_noise(scenario: Scenario) -> bool:
    """Whether the sensor of a scenario draws noise."""
    return scenario.sampling is not None and scenario.sensor.draws > 0


def noise_values(scenario: Scenario, key: jax.Array, run: int | jax.Array) -> dict[str, jax.Array]:
    """`NOISE_NAME` -> the noise key of one run of a study, which replaces that of the run as leaves
    are replaced; empty for a scenario without noise.
    """
    if not has_noise(scenario):
        return {}
    return {NOISE_NAME: noise_key(key, run)}


def normals(key: jax.Array, sample: jax.Array, draws: int, n: int) -> jax.Array:
    """Independent standard normal numbers of one sample, (draws, n); they depend on key, sample and
    index only.

    The generator is counter-based, like Philox: in ten rounds, the halves of products are exchanged
    and combined with the key; then follows the Box-Muller transform. JAX's own generator cannot be
    compiled to the scalar programs of `kernels`.

    Args:
      key: of the run, four words of 16 bits.
      sample: number of the sample, () int.
      draws: numbers a joint.
      n: number of joints.
    """
    words = [w.astype(jnp.int32) for w in key]
    count = draws * n
    flat: list[jax.Array] = []
    for pair in range((count + 1) // 2):
        flat += _pair(words, sample.astype(jnp.int32), pair, key.dtype)
    if not count:
        return jnp.zeros((0, n), key.dtype)
    return jnp.stack(flat[:count]).reshape(draws, n)


def _pair(key: list[jax.Array], sample: jax.Array, pair: int, dtype) -> list[jax.Array]:
    """Two independent standard normal numbers."""
    low = WORD - 1
    x = [sample & low, _upper(sample) & low, key[2] ^ pair, key[3]]
    k = [key[0], key[1]]
    for _ in range(ROUNDS):
        a, b = MULTIPLIERS[0] * x[0], MULTIPLIERS[1] * x[2]
        x = [_upper(b) ^ x[1] ^ k[0], b & low, _upper(a) ^ x[3] ^ k[1], a & low]
        k = [(k[0] + WEYL[0]) & low, (k[1] + WEYL[1]) & low]

    def uniform(high: jax.Array, low: jax.Array) -> jax.Array:
        return (high.astype(dtype) * WORD + low.astype(dtype) + 0.5) / float(WORD * WORD)

    first = uniform(x[0], x[1])
    second = uniform(x[2], x[3])
    size = jnp.sqrt(-2.0 * jnp.log(first))
    angle = 2.0 * np.pi * second
    return [size * jnp.cos(angle), size * jnp.sin(angle)]


def _upper(x: jax.Array) -> jax.Array:
    """The bits of an integer above its lowest word."""
    return jax.lax.div(x, jnp.asarray(WORD, x.dtype))
