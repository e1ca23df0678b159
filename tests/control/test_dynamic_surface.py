"""The dynamic surface law: beside an independent program, and its start."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from independent import Loop, sine
from scipy.integrate import solve_ivp

import iblf_jax as ij
from iblf_jax import bounds, controllers

H = np.pi / 2


@dataclasses.dataclass
class FilteredLoop(Loop):
    """The independent loop with alpha filtered; its state is (q, q', eta, beta)."""

    mu: np.ndarray = dataclasses.field(default_factory=lambda: np.full(2, 0.02))

    def alpha_and_slope(self, t, q):
        (xd, dxd, _), (lo, dlo, _), (up, dup, _) = (
            sine(*s)(t) for s in (self.reference, self.lower, self.upper)
        )
        kl, ku, e1 = xd - lo, up - xd, q - xd
        kappa = np.sqrt(((dup - dxd) / ku) ** 2 + ((dxd - dlo) / kl) ** 2 + self.o)
        return dxd - (self.k1 + kappa) * e1, 2 * e1 / (np.where(e1 > 0, ku, kl) ** 2 - e1**2)

    def filtered(self, t, x):
        q, v, eta, beta = x[:2], x[2:4], x[4:6], x[6:]
        M, C, G, dM = self.arm(q)
        alpha, slope = self.alpha_and_slope(t, q)
        dbeta, f_hat = (alpha - beta) / self.mu, eta + self.kf * (M @ v)
        tau = C(v) @ beta + G + M @ dbeta - f_hat - self.K2 * (v - beta) - slope
        f = M @ sine(*self.force_a)(t)[0] + C(v) @ sine(*self.force_b)(t)[0]
        deta = -self.kf * (f_hat + tau - C(v) @ v - G + dM * v[1] @ v)
        return np.concatenate([v, np.linalg.solve(M, tau + f - C(v) @ v - G), deta, dbeta])


@pytest.mark.slow
def test_the_run_is_that_of_an_independent_program_at_random_gains_and_bounds(rng):
    for _ in range(2):
        draws = {
            name: rng.uniform(low, high, 2)
            for name, low, high in (
                ("k1", 1, 3),
                ("K2", 10, 25),
                ("o", 0.05, 0.3),
                ("mu", 0.01, 0.05),
            )
        }
        loop = FilteredLoop(
            **draws,
            q0=tuple(rng.uniform(0.4, 0.8, 2)),
            lower=(rng.uniform(0.1, 0.2, 2), 0.14, 1.0, (H, 0.0)),
        )
        t, alpha = np.linspace(0.0, 1.0, 21), loop.alpha_and_slope(0.0, np.array(loop.q0))[0]
        start = [*loop.q0, *np.zeros(4), *alpha]
        found = solve_ivp(
            loop.filtered, (0.0, 1.0), start, "DOP853", t_eval=t, rtol=1e-10, atol=1e-12
        )
        law = controllers.DynamicSurface(k1=loop.k1, K2=loop.K2, filter=loop.mu, o=loop.o)
        walls = bounds.Bounds(
            lower=bounds.Sinusoid(*loop.lower), upper=bounds.Sinusoid(*loop.upper)
        )
        scenario = ij.presets.zhang_yan_2024(variant="corrected")
        scenario = dataclasses.replace(
            scenario, controller=law, bounds=walls, initial=ij.Initial(loop.q0)
        )
        run = ij.simulate(scenario, duration=1.0, dt=2.5e-4, record_every=200)
        np.testing.assert_allclose(run.q, found.y[:2].T, atol=1e-8)
        np.testing.assert_allclose(run.alpha, found.y[6:].T, atol=1e-5)


@pytest.mark.slow
def test_it_starts_on_alpha_and_is_sampled_too():
    scenario = ij.presets.zhang_yan_2024(law="dynamic_surface")
    run = ij.simulate(scenario, duration=0.08, dt=1e-3)
    np.testing.assert_array_equal(run.alpha[0], run.controller_state[0])
    tube = scenario.context.tube(jnp.zeros(()))
    np.testing.assert_allclose(
        run.alpha[0],
        scenario.controller.barrier.virtual_velocity(tube, scenario.initial.q, 2.0, 0.1),
    )
    held = ij.with_parts(scenario, sampling=ij.Sampling(period=1e-3))
    held = ij.simulate(held, duration=0.08, dt=1e-3)
    assert held.ok
    np.testing.assert_allclose(held.q, run.q, atol=2e-3)
