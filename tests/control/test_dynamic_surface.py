"""The dynamic surface law: beside an independent program, and its limit."""

import dataclasses

import jax
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
        t, start = (
            np.linspace(0.0, 3.0, 61),
            [
                *loop.q0,
                0,
                0,
                0,
                0,
                *loop.alpha_and_slope(0.0, np.array(loop.q0))[0],
            ],
        )
        found = solve_ivp(
            loop.filtered, (0.0, 3.0), start, "DOP853", t_eval=t, rtol=1e-10, atol=1e-12
        )
        law = controllers.DynamicSurface(k1=loop.k1, K2=loop.K2, filter=loop.mu, o=loop.o)
        walls = bounds.Bounds(
            lower=bounds.Sinusoid(*loop.lower), upper=bounds.Sinusoid(*loop.upper)
        )
        scenario = ij.presets.zhang_yan_2024(variant="corrected")
        scenario = dataclasses.replace(
            scenario, controller=law, bounds=walls, initial=ij.Initial(loop.q0)
        )
        run = ij.simulate(scenario, duration=3.0, dt=2.5e-4, record_every=200)
        np.testing.assert_allclose(run.q, found.y[:2].T, atol=1e-8)
        np.testing.assert_allclose(run.alpha, found.y[6:].T, atol=1e-5)


@pytest.mark.slow
def test_it_tends_to_the_backstepping_law_at_the_first_order_of_its_filter():
    paper = ij.presets.zhang_yan_2024(variant="corrected")
    exact = ij.simulate(paper, duration=2.0, dt=1e-4, record_every=100)

    def off(mu):
        scenario = ij.with_parts(
            paper, controller=controllers.DynamicSurface(k1=2.0, K2=20.0, filter=mu)
        )
        return np.max(
            np.abs(ij.simulate(scenario, duration=2.0, dt=1e-4, record_every=100).q - exact.q)
        )

    far, near, nearer = (off(mu) for mu in (0.016, 0.004, 0.001))
    assert far / near == pytest.approx(4.0, rel=0.3)
    assert near / nearer == pytest.approx(4.0, rel=0.1)
    assert nearer < 5e-4


def test_it_costs_less_than_what_differentiates():
    """Operations of a step, as the state of the filter is more and alpha' less."""
    paper = ij.presets.zhang_yan_2024(variant="corrected")
    counts = [
        sum(sum(c.values()) for c in ij.explain(s).counts.values())
        for s in (paper, ij.presets.zhang_yan_2024(law="dynamic_surface"))
    ]
    assert counts[1] < counts[0]


@pytest.mark.slow
def test_it_starts_on_alpha_and_is_sampled_too():
    scenario = ij.presets.zhang_yan_2024(law="dynamic_surface")
    run = ij.simulate(scenario, duration=0.1, dt=1e-3)
    np.testing.assert_array_equal(run.alpha[0], run.controller_state[0])
    tube = scenario.context.tube(jnp.zeros(()))
    np.testing.assert_allclose(
        run.alpha[0],
        scenario.controller.barrier.virtual_velocity(tube, scenario.initial.q, 2.0, 0.1),
    )
    held = ij.simulate(
        ij.with_parts(scenario, sampling=ij.Sampling(period=1e-3)), duration=0.5, dt=5e-4
    )
    continuous = ij.simulate(scenario, duration=0.5, dt=5e-4)
    assert held.ok
    np.testing.assert_allclose(held.q, continuous.q, atol=2e-3)


@pytest.mark.slow
def test_theorem_2_claims_nothing_of_it():
    certificate = ij.certify(
        ij.presets.zhang_yan_2024(law="dynamic_surface"), duration=0.1, dt=1e-3
    )
    assert {
        line.verdict for line in certificate.lines if line.name.startswith(("inequality", "rho"))
    } == {"not applicable"}


@pytest.mark.slow
def test_a_gradient_by_the_filter_is_the_difference():
    def loss(mu):
        scenario = ij.with_parameters(
            ij.presets.zhang_yan_2024(law="dynamic_surface"), {"controller.filter": mu}
        )
        return jnp.sum(ij.simulate(scenario, duration=0.2, dt=1e-3, record_every=200).metrics.ise)

    found, h = jax.grad(loss)(0.02), 1e-6
    assert float(found) == pytest.approx(
        (float(loss(0.02 + h)) - float(loss(0.02 - h))) / (2 * h), rel=1e-5
    )
