"""Planar robots against the closed form, energies from positions, and products of matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from iblf_jax.robots import PlanarChain, TwoLink

import iblf_jax as ij
from iblf_jax.core.linalg import solve_spd


def random_links(n, rng):
    mass, length = rng.uniform(0.5, 2, n), rng.uniform(0.2, 0.5, n)
    numbers = {"mass": mass, "length": length, "centre": length * rng.uniform(0.3, 0.7, n)}
    return numbers | {"inertia": mass * length**2 / 12, "payload": rng.uniform(0, 1)}


@jax.jit
def everything(robot, q, v, u):
    parts = robot.mass_matrix, robot.gravity, robot.potential, robot.tip, robot.jacobian
    return robot.coriolis(q, v, u), robot.skeleton(q), *(part(q) for part in parts)


def test_chain_of_two_is_the_closed_form_with_its_lumped_parameters(rng):
    for _ in range(5):
        links = random_links(2, rng)
        q, v, u = rng.uniform(-3, 3, (3, 2))
        pair = (everything(kind(**links), q, v, u) for kind in (PlanarChain, TwoLink))
        for a, b in zip(*pair, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
    p = ij.presets.customary_two_link().lumped()
    np.testing.assert_allclose(p, [0.226625, 0.0408425, 0.0461125, 0.6475, 0.13175], rtol=1e-12)


def test_kinetic_and_potential_energy_from_positions(rng):
    """q'^T M q' = sum m |velocity of the centre|^2 + I omega^2, from where the centres are."""
    links = random_links(4, rng)
    robot = PlanarChain(**links)
    q, v = rng.uniform(-3, 3, (2, 4))

    def centres(q):
        theta = np.cumsum(q)
        joints = np.concatenate([[0j], np.cumsum(links["length"] * np.exp(1j * theta))])
        return np.append(joints[:-1] + links["centre"] * np.exp(1j * theta), joints[-1])

    masses = np.append(links["mass"], links["payload"])
    speed = (centres(q + 1e-6 * v) - centres(q - 1e-6 * v)) / 2e-6
    kinetic = 0.5 * masses @ np.abs(speed) ** 2 + 0.5 * links["inertia"] @ np.cumsum(v) ** 2
    of_robot = jax.jit(lambda q: (robot.mass_matrix(q), robot.potential(q), robot.tip(q)))
    inertia, potential, tip = map(np.asarray, of_robot(q))
    assert 0.5 * v @ inertia @ v == pytest.approx(kinetic, rel=1e-8)
    assert float(potential) == pytest.approx(9.81 * masses @ centres(q).imag, rel=1e-12)
    np.testing.assert_allclose(tip, [centres(q)[-1].real, centres(q)[-1].imag], atol=1e-12)


@pytest.mark.parametrize("n", [2, 7])
def test_small_algebra_against_numpy(n, rng):
    A = rng.normal(size=(n, n))
    A = A @ A.T + 0.1 * np.eye(n)
    b = rng.normal(size=n)
    np.testing.assert_allclose(jax.jit(solve_spd)(A, b), np.linalg.solve(A, b), rtol=1e-9)
    assert np.all(np.isnan(solve_spd(jnp.asarray(-A), b)))
