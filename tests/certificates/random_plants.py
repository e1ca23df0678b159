"""Random smooth plants in strict-feedback form with coupled gains, and random states of their
loops.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

import iblf_jax as ij
from iblf_jax.simulation.closed_loop import LoopState
from iblf_jax.simulation.scenario import canonical
from iblf_jax.world.bounds import Tube

N = 2
STATES = 32


@ij.component
class RandomPlant:
    """f_i = sin(A_i (x_1..x_i) + 0.3 t), G_i = I + 0.3 sin(B_i (x_1..x_i) + 0.2 t)."""

    A: ij.Leaf = ij.leaf("1", shape="any")
    B: ij.Leaf = ij.leaf("1", shape="any")
    order: int = ij.static()
    n: ClassVar[int] = N

    def _inner(self, numbers, i, x):
        return jnp.tensordot(numbers[i, ..., : i + 1, :], x[: i + 1], axes=2)

    def drift(self, t, x):
        rows = [jnp.sin(self._inner(self.A, i, x) + 0.3 * t) for i in range(self.order)]
        return jnp.stack(rows)

    def gain(self, t, x):
        rows = [jnp.sin(self._inner(self.B, i, x) + 0.2 * t) for i in range(self.order)]
        return jnp.eye(N) + 0.3 * jnp.stack(rows)


def bounds_between(lower, upper):
    """Bounds that oscillate, each side with its own frequency."""
    return ij.bounds.Bounds(
        lower=ij.bounds.Sinusoid(offset=-lower, amplitude=0.04 * lower, frequency=0.9),
        upper=ij.bounds.Sinusoid(offset=upper, amplitude=0.05 * upper, frequency=1.4),
    )


def tube_widths(order):
    """Both sides of every level's bounds, (order, 2)."""
    above = [(60.0 * 30.0**i, 90.0 * 30.0**i) for i in range(order - 1)]
    return np.array([(1.5, 2.5), *above])


def energy_scales(barriers, widths):
    """e/s of every barrier at the middle of its tube, (order, 1), so that w_i V_i is about e^2."""
    zero = jnp.zeros(1)
    ratios = [
        barrier.error_over_slope(Tube(zero, zero, zero - lower, zero + upper, zero, zero), zero)
        for barrier, (lower, upper) in zip(barriers, widths, strict=True)
    ]
    return np.stack(ratios)


def random_scenario(order: int, barriers: Any, seed: int) -> ij.Scenario:
    """A loop with a random plant, weights, gains, disturbances and estimates."""
    rng, widths = np.random.default_rng(seed), tube_widths(order)
    A = rng.normal(0.0, 0.5, (order, N, order, N))
    plant = RandomPlant(A, B=rng.normal(0.0, 0.3, (order, N, N, order, N)), order=order)
    controller = ij.controllers.BarrierBackstepping(
        k=rng.uniform(1.0, 3.0, (order, N)),
        barriers=barriers,
        c=rng.uniform(0.0, 0.3, (order, N)),
        weights=10 ** rng.uniform(-1.0, 0.5, (order, N)) * energy_scales(barriers, widths),
    )
    parts = tuple(
        ij.disturbances.Sinusoids(rng.normal(0.0, 0.5, N), rng.uniform(0.5, 2.0, N))
        for _ in range(order)
    )
    scenario = ij.Scenario(
        plant=plant,
        reference=ij.references.Sinusoid(offset=[0.2, -0.1], amplitude=[0.3, 0.2]),
        bounds=tuple(bounds_between(*sides) for sides in widths),
        controller=controller,
        observer=ij.observers.LevelObserver(gain=rng.uniform(1.0, 5.0, (order, N))),
        disturbance=ij.disturbances.Levels(parts),
        initial=ij.Initial(x=np.zeros((order, N))),
    )
    return canonical(scenario)


def random_states(scenario: ij.Scenario, seed: int):
    """Times, (STATES,), and states of the loop inside the tubes of all levels, batched."""
    rng, order = np.random.default_rng(seed), scenario.model.order
    t = rng.uniform(0.0, 10.0, STATES)
    xi = rng.uniform(-0.6, 0.6, (STATES, order, N))
    d_hat = rng.normal(0.0, 0.5, (STATES, order, N))

    @jax.jit
    @jax.vmap
    def states(t, xi, d_hat):
        law, x = scenario.controller, jnp.zeros((order, N))
        for i in range(order):
            tube = law.levels(t, x, d_hat, scenario.context, ())[1][i]
            x = x.at[i].set(tube.q_d + xi[i] * jnp.where(xi[i] > 0, tube.k_u, tube.k_l))
        return LoopState(x, (), d_hat - scenario.observer.gain * x)

    return t, states(t, xi, d_hat)
