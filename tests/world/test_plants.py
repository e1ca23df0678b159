"""Plants in strict-feedback form: published numbers, balances of energy, and what is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loops_of_plants import band
from refused import refused

import iblf_jax as ij
from iblf_jax import plants
from iblf_jax.simulation.scenario import canonical

SHIP = ij.presets.cybership_ii()


def test_inertia_damping_and_coriolis_of_cybership_ii_are_the_published_ones():
    expected = [[25.8, 0.0, 0.0], [0.0, 33.8, 1.0948], [0.0, 1.0948, 2.76]]
    np.testing.assert_allclose(SHIP.inertia_matrix(), expected, rtol=1e-12)
    u, v, r = 0.4, -0.2, 0.3
    forces = np.asarray(SHIP.damping_matrix(jnp.asarray([u, v, r]))) @ [u, v, r]
    surge = 0.72253 * u + 1.32742 * abs(u) * u + 5.86643 * u**3
    sway = (0.88965 + 36.47287 * abs(v) + 0.805 * abs(r)) * v + (
        7.25 + 0.845 * abs(v) + 3.45 * abs(r)
    ) * r
    yaw = (-0.0313 - 3.95645 * abs(v) - 0.13 * abs(r)) * v + (
        1.9 - 0.08 * abs(v) + 0.75 * abs(r)
    ) * r
    np.testing.assert_allclose(forces, [surge, sway, yaw], rtol=1e-12)
    C = np.asarray(SHIP.coriolis_matrix(jnp.asarray([u, v, r])))
    c13, c23 = -(33.8 * v + 1.0948 * r), 25.8 * u
    np.testing.assert_allclose(C, [[0, 0, c13], [0, 0, c23], [-c13, -c23, 0]], rtol=1e-12)


def test_the_power_of_a_vessel_is_that_of_thrust_and_damping(rng):
    """nu^T M nu' = nu^T (u - D nu).  It moves north in surge with heading 0, and east at pi/2."""
    M = np.asarray(SHIP.inertia_matrix())
    flow = jax.jit(lambda x, u: plants.flow(SHIP, jnp.zeros(()), x, u))
    for _ in range(5):
        x, u = rng.normal(size=(2, 3)), rng.normal(size=3)
        rate = np.asarray(flow(x, u))
        D = np.asarray(SHIP.damping_matrix(jnp.asarray(x[1])))
        assert x[1] @ M @ rate[1] == pytest.approx(x[1] @ (u - D @ x[1]), rel=1e-10)
        speed = np.hypot(*rate[0, :2])
        assert speed == pytest.approx(np.hypot(*x[1, :2]), rel=1e-12)  # R turns only
        assert rate[0, 2] == pytest.approx(x[1, 2])
    for heading, expected in ((0.0, [0.5, 0.0, 0.0]), (0.5 * np.pi, [0.0, 0.5, 0.0])):
        moved = flow(jnp.asarray([[0.0, 0.0, heading], [0.5, 0.0, 0.0]]), jnp.zeros(3))[0]
        np.testing.assert_allclose(moved, expected, atol=1e-15)


def test_a_mooring_pulls_a_vessel_back_by_the_force_of_its_potential(rng):
    """nu^T g(eta) is the rate of 1/2 sum stiffness (eta - position)^2 along eta' = R nu."""
    stiffness, rest = np.array([3.0, 5.0, 0.8]), np.array([0.2, -0.1, 0.3])
    moored = dataclasses.replace(SHIP, restoring=ij.plants.Mooring(stiffness, rest))
    x = jnp.asarray(rng.normal(size=(2, 3)))
    rates = [ij.plants.level_rate(plant, 2, 0.0, x, jnp.zeros(3)) for plant in (SHIP, moored)]
    force = SHIP.inertia_matrix() @ (rates[0] - rates[1])
    power = stiffness * (x[0] - rest) @ (SHIP.rotation(x[0, 2]) @ x[1])
    np.testing.assert_allclose(x[1] @ force, power, rtol=1e-11)
    at_rest = ij.plants.level_rate(moored, 2, 0.0, jnp.stack([rest, jnp.zeros(3)]), jnp.zeros(3))
    np.testing.assert_array_equal(at_rest, 0.0)
    units = [p.unit for p in ij.parameters(moored) if "stiffness" in p.path]
    assert units == ["N/m, N/m, N m/rad"]


@pytest.mark.slow
def test_the_driven_pendulum_is_an_electric_drive_on_a_pendulum(rng):
    """With M = L/Kt, H = R/Kt and the motor's torque Kt i as the third level."""
    link = ij.robots.PlanarChain(mass=[0.9], length=[0.4], centre=[0.3], inertia=[0.02], g=9.81)
    D = float(link.mass_matrix(jnp.zeros(1))[0, 0])
    drive = plants.ElectricDrive(
        link, torque_constant=0.8, inductance=0.02, resistance=4.0, back_emf=0.7
    )
    pendulum = plants.DrivenPendulum(
        D=[D], B=[0.0], N=[0.9 * 0.3 * 9.81], M=[0.02 / 0.8], H=[4.0 / 0.8], Km=[0.7]
    )
    x, u = rng.normal(size=(3, 1)), rng.normal(size=1)
    of_drive = plants.flow(drive, 0.0, jnp.asarray(x), u)
    # The angle of the chain counts from the horizontal.
    shifted = np.stack([x[0] + 0.5 * np.pi, x[1], 0.8 * x[2]])
    of_pendulum = plants.flow(pendulum, 0.0, jnp.asarray(shifted), u)
    np.testing.assert_allclose(of_pendulum[:2], of_drive[:2], rtol=1e-12)
    np.testing.assert_allclose(of_pendulum[2], 0.8 * of_drive[2], rtol=1e-12)


def made(plant):
    parts = {"controller": ij.controllers.BarrierBackstepping(k=(3.0, 10.0, 30.0))}
    parts["reference"] = ij.references.Sinusoid(offset=0.0, amplitude=0.5)
    walls, start = band(-0.8, 0.9), ij.Initial(x=[[0.3], [0.0], [0.0]])
    return canonical(ij.Scenario(plant=plant, bounds=walls, initial=start, **parts))


def with_drift(*rows):
    return plants.StrictFeedback(
        lambda t, x: jnp.stack([row(x) for row in rows]), lambda t, x: jnp.ones_like(x), 1, order=3
    )


COUPLED = plants.StrictFeedback(lambda t, x: -x, lambda t, x: 1.0 + x[::-1] ** 2, n=1, order=3)
test_what_does_not_fit_is_refused = refused(
    (
        lambda: made(with_drift(lambda x: x[1], lambda x: -x[0], lambda x: -x[2])),
        "plant.drift.*row 0.*x.1.*belongs in row 0 of the gain",
    ),
    (
        # Its derivative is 0 at the start.
        lambda: made(with_drift(lambda x: -x[0], lambda x: x[2] ** 2, lambda x: -x[2])),
        "plant.drift.*row 1 that depends on x.2.",
    ),
    (
        lambda: made(with_drift(lambda x: x[2] * x[0], lambda x: -x[1], lambda x: -x[2])),
        "plant.drift.*row 0.*x.2.*other levels",
    ),
    (lambda: made(COUPLED), r"plant.gain\(t, x\): got row 0 that depends on x\[2\]"),
    (
        lambda: plants.Vessel(mass=23.0, yaw_inertia=1.7, X_du=10.0, Y_dv=30.0),
        r"Vessel: got m11 = 13.*m22 = -7.*negative numbers",
    ),
    (lambda: dataclasses.replace(SHIP, restoring=3.0), r"Vessel\.restoring.*RESTORING"),
)


def test_a_robot_as_a_plant_picks_up_its_load_when_the_robot_does():
    load = ij.robots.Payload(mass=2.0, start=1.0, rise=0.1)
    arm = dataclasses.replace(ij.presets.ur5().plant, carried=load)
    plant = plants.Rigid(arm)
    np.testing.assert_allclose(plant.jump_times(), [1.0, 1.1])
    q = jnp.asarray([0.3, -0.8, 0.5, 0.1, -0.2, 0.4])
    before, after = (np.asarray(plant.at(jnp.asarray(t)).steady_input(q)) for t in (0.5, 2.0))
    np.testing.assert_allclose(before, arm.at(jnp.asarray(0.5)).gravity(q))
    np.testing.assert_allclose(after, arm.at(jnp.asarray(2.0)).gravity(q))
    assert np.max(np.abs(after - before)) > 1.0  # the load's torque [N m]
