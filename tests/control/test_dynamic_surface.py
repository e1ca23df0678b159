"""The dynamic surface law beside an independent program, and its start."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from independent import Loop

import iblf_jax as ij
from iblf_jax import bounds, controllers
from iblf_jax.simulation.closed_loop import LoopState, initial_state, rate


@dataclasses.dataclass
class FilteredLoop(Loop):
    """The independent loop with alpha filtered; its state is (q, q', eta, beta)."""

    mu: np.ndarray = dataclasses.field(default_factory=lambda: np.full(2, 0.02))

    def filtered(self, t, x):
        q, v, eta, beta = np.split(x, 4)
        M, C, G, dM = self.arm(q)
        e1, k, alpha, _ = self.virtual(t, q, v)
        dbeta, f_hat = (alpha - beta) / self.mu, eta + self.kf * (M @ v)
        slope = 2 * e1 / (k**2 - e1**2)
        tau = C(v) @ beta + G + M @ dbeta - f_hat - self.K2 * (v - beta) - slope
        deta = -self.kf * (f_hat + tau - C(v) @ v - G + dM * v[1] @ v)
        acceleration = self.acceleration(q, v, tau + self.disturbance(t, q, v))
        return np.concatenate([v, acceleration, deta, dbeta])


@pytest.mark.slow
def test_vector_field_and_start_are_those_of_an_independent_program(rng):
    field = jax.jit(rate)
    for _ in range(10):
        ranges = {"k1": (1, 3), "K2": (10, 25), "o": (0.05, 0.3), "mu": (0.01, 0.05)}
        draws = {name: rng.uniform(*ends, 2) for name, ends in ranges.items()}
        lower = (rng.uniform(0.1, 0.2, 2), 0.14, 1.0, (np.pi / 2, 0.0))
        loop = FilteredLoop(**draws, q0=tuple(rng.uniform(0.4, 0.8, 2)), lower=lower)
        scenario = ij.with_parts(
            ij.presets.zhang_yan_2024(variant="corrected"),
            controller=controllers.DynamicSurface(loop.k1, loop.K2, filter=loop.mu, o=loop.o),
            bounds=bounds.Bounds(bounds.Sinusoid(*loop.lower), bounds.Sinusoid(*loop.upper)),
            initial=ij.Initial(loop.q0),
        )
        start = loop.virtual(0.0, np.array(loop.q0), np.zeros(2)).alpha
        np.testing.assert_allclose(initial_state(scenario).controller, start, rtol=1e-12)
        t, q = rng.uniform(0.0, 5.0), rng.uniform(0.45, 0.55, 2)
        dq, eta, beta = rng.normal(size=(3, 2))
        state = LoopState(jnp.stack([q, dq]), jnp.asarray(beta), jnp.asarray(eta))
        found = field(scenario, jnp.asarray(t), state)
        expected = loop.filtered(t, np.concatenate([q, dq, eta, beta]))
        rates = np.concatenate([found.q, found.dq, found.observer, found.controller])
        np.testing.assert_allclose(rates, expected, atol=1e-12 * np.max(np.abs(expected)))
