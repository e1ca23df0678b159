"""Functions that users write for plants and noises; by their names, which a pickle needs."""

import jax
import jax.numpy as jnp


def coupled_drift(t: jax.Array, x: jax.Array) -> jax.Array:
    return jnp.stack([x[0] * x[0, ::-1], jnp.sin(x[0] * x[1]) - 0.2 * t])


def coupled_gain(t: jax.Array, x: jax.Array) -> jax.Array:
    return jnp.stack([jnp.diag(2.0 + x[0] ** 2), jnp.eye(2, dtype=x.dtype) + 0.1 * x[1, 0]])


def diagonal_drift(t: jax.Array, x: jax.Array) -> jax.Array:
    return jnp.stack([jnp.cos(x[0]), x[0] * x[1], -x[2]])


def diagonal_gain(t: jax.Array, x: jax.Array) -> jax.Array:
    return jnp.stack([jnp.ones_like(x[0]), 2.0 + x[1] ** 2, jnp.exp(x[0])])


def fading_noise(t: jax.Array, x: jax.Array) -> jax.Array:
    return jnp.exp(-t) * jnp.cos(x[:1])


def periodic_noise(t: jax.Array, x: jax.Array) -> jax.Array:
    return (2.0 + jnp.sin(t)) * jnp.ones_like(x[:1])
