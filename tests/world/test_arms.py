"""The arms that come with the package, their presets, and what follows from their numbers."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_cases import ARMS
from by_numpy import computed
from refused import refused

import iblf_jax as ij
from iblf_jax import bounds, controllers, references
from iblf_jax.presets import arms
from iblf_jax.simulation.paths import get

IIWA, UR5 = arms.arm("iiwa14"), arms.arm("ur5")
UNLIMITED = dataclasses.replace(IIWA, upper=IIWA.upper.at[3].set(jnp.inf))
MASSLESS = dataclasses.replace(UR5, mass=np.zeros(6), inertia=np.zeros((6, 6)))
LAB = {"sampling": ij.Sampling(period=2e-3, delay=1e-3)}
"""500 Hz, and half a period late."""
MIDDLE, AMPLITUDE = [0.3, -0.6, 1.0, 0.2, 0.4, 0.1], [0.3, 0.2, 0.3, 0.4, 0.3, 0.5]
FREQUENCY = [1.0, 0.8, 1.1, 1.3, 0.9, 1.2]
HOLD = references.Quintic(start=MIDDLE, end=MIDDLE, duration=1.0)
PRESETS = {"ur5": (ij.presets.ur5, 6, "tool0"), "iiwa14": (ij.presets.iiwa14, 7, "iiwa_link_ee")}


@pytest.fixture(scope="module", params=PRESETS)
def name(request):
    return request.param


def test_the_data_are_what_the_file_says(name):
    """Every leaf, name and kind of joint, as `robots.load` reads them from the URDF."""
    pytest.importorskip("mujoco")
    loaded = ij.robots.load(ARMS / f"{name}.urdf", tip=PRESETS[name][2])
    shipped = arms.arm(name)
    assert jax.tree.structure(shipped) == jax.tree.structure(loaded)
    for one, other in zip(jax.tree.leaves(shipped), jax.tree.leaves(loaded), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=2e-14)
    assert shipped.n == PRESETS[name][1]


@pytest.mark.slow
def test_the_payload_is_in_the_plant_alone(name):
    scenario, other = PRESETS[name][0](), PRESETS[name][0](payload=0.0)
    assert float(scenario.plant.payload) > 0 == float(scenario.model.payload)
    assert float(other.plant.payload) == 0
    assert jax.tree.structure(other) == jax.tree.structure(scenario)


test_refusals_name_what_is_expected = refused(
    (lambda: arms.arm("ur6"), r"arm: got 'ur6'.*'iiwa14'"),
    (lambda: bounds.from_limits(UNLIMITED), "unlimited"),
    (lambda: bounds.from_limits(IIWA, margin=5.0), "margin: got 5"),
    (lambda: bounds.from_limits(ij.presets.customary_two_link()), "joint limits"),
    (lambda: ij.presets.ur5(payload=-1.0), "payload"),
    (lambda: arms.arm_scenario(UR5, HOLD, variant="wrong"), "variant"),
    (lambda: arms.arm_scenario(UR5, HOLD, bounds=3), "bounds: got 3"),
    (lambda: arms.arm_scenario(MASSLESS, HOLD), r"positive definite.*at t = 0 s.*masses"),
)


def test_limits_become_bounds_efforts_saturation_and_inertia_gains_of_an_arm():
    """A joint without a limit gets the one that is given."""
    found = bounds.from_limits(IIWA, margin=0.1)
    np.testing.assert_allclose(found.lower.at(0.0, jnp.zeros(7)), IIWA.lower + 0.1)
    np.testing.assert_allclose(found.upper.at(3.0, jnp.zeros(7)), IIWA.upper - 0.1)
    assert float(bounds.from_limits(UNLIMITED, unlimited=6.0).upper.value[3]) == 6.0
    law, within = controllers.ComputedTorque(Kp=25.0, Kd=10.0), controllers.within_effort
    np.testing.assert_array_equal(within(law, UR5).limit, UR5.effort)
    assert within(law, UR5, edge="smooth").edge == "smooth"
    assert within(law, dataclasses.replace(UR5, effort=jnp.inf)) is law
    assert within(law, ij.presets.customary_two_link()) is law
    some = within(law, dataclasses.replace(UR5, effort=UR5.effort.at[0].set(jnp.inf)))
    np.testing.assert_array_equal(some.limit[:2], [1e6, 150.0])
    q = jnp.array([0.0, 0.6, 0.0, -1.1, 0.0, 0.9, 0.0])
    K2 = arms.inertial_gain(IIWA, q, rate=30.0)
    np.testing.assert_allclose(K2[:4], 30.0 * np.diagonal(computed(IIWA.mass_matrix, q))[:4])
    assert float(K2.min()) == arms.MIN_K2
    scenario = arms.arm_scenario(UR5, HOLD)
    np.testing.assert_array_equal(scenario.bounds[0].upper.value, UR5.upper)
    np.testing.assert_allclose(scenario.initial.q, MIDDLE)


def narrow(width):
    return bounds.Bounds(*(bounds.Funnel(x, x, rate=1.0) for x in (-width, width)))


def light_wrist(joints=6, width=0.12):
    """The last joints of an arm of six whose last one turns 0.002 kg m^2, between narrow bounds."""
    pytest.importorskip("mujoco")
    held = dict.fromkeys(("turn", "lift", "bend", "roll", "pitch", "twist")[: 6 - joints], 0.0)
    arm = ij.robots.load(ARMS / "light_wrist.urdf", tip="hand", locked=held)
    reference = references.Sinusoid(
        offset=MIDDLE[-joints:], amplitude=AMPLITUDE[-joints:], frequency=FREQUENCY[-joints:]
    )
    return arms.arm_scenario(arm, reference, bounds=narrow(width))


@pytest.mark.slow
def test_a_light_wrist_keeps_narrow_bounds_at_500_hz_and_did_not_with_the_papers_weight():
    scenario = ij.with_parts(light_wrist(joints=2), **LAB)
    inertia = jnp.diagonal(scenario.model.mass_matrix(scenario.initial.q))
    K2, weight = get(scenario, "controller.K2"), get(scenario, "controller.weight")
    assert float(inertia[-1]) < 0.0021
    np.testing.assert_array_less(np.abs(K2 / inertia - 62.5), 37.5 + 2e-11)
    np.testing.assert_allclose(weight, np.minimum(1.0, inertia * 12.5**2 * 0.12**2 / 2))
    brief = {"duration": 0.3, "dt": 1e-3, "record_every": 20}
    with warnings.catch_warnings(action="error"):  # neither a failure nor advice on gains
        run = ij.simulate(scenario, **brief)
    assert int(run.status) == 0 and float(run.metrics.sampling_radius) < 0.995
    assert float(run.metrics.margin.min()) > 0.09
    for factor in (0.3, 0.1, 0.03):
        # All but 1, which would be compiled in: a program of its own.
        papers = {"controller.weight": 1.0 - 1e-9}
        papers["controller.K2"] = factor * jnp.maximum(25.0 * inertia, 0.6)
        with pytest.warns(UserWarning, match="sampled too slowly"):
            run = ij.simulate(ij.with_parameters(scenario, papers), **brief)
        assert float(run.metrics.sampling_radius) > 1.05


@pytest.mark.slow
def test_the_weight_makes_every_barrier_as_stiff_at_the_reference():
    """ds/de1 at e1 = 0 is that of the barrier: 2/k^2 of the integral one, 1 of the tangent."""
    for law, stiffness in (
        ("integral", 2 / 0.3**2),
        ("log", 1 / 0.3**2),
        ("mapping", 1.0),
        ("dynamic_surface", 2 / 0.3**2),
    ):
        scenario = arms.arm_scenario(UR5, HOLD, law=law, bounds=narrow(0.3))
        inertia = jnp.diagonal(scenario.model.mass_matrix(scenario.initial.q))
        expected = np.minimum(1.0, inertia * 12.5**2 / stiffness)
        np.testing.assert_allclose(get(scenario, "controller.weight"), expected, rtol=1e-9)


SHORT_MOTION = references.WaypointSpline(
    times=(0.0, 0.1, 0.2), waypoints=np.asarray(MIDDLE) + np.array([[0.0], [0.5], [0.0]])
)
"""It comes nearest to bounds above it at 0.1 s."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reference", "below", "above"),
    [(HOLD, 0.15, 1.0), (HOLD, 1.0, 0.15), (SHORT_MOTION, 1.0, 0.65)],
)
def test_the_weight_is_that_of_the_nearest_bound(reference, below, above):
    """The slope of the integral barrier at e1 = 0 has two derivatives, 2/k_l^2 and 2/k_u^2."""
    middle = np.asarray(MIDDLE)
    tube = bounds.Bounds(bounds.Constant(middle - below), bounds.Constant(middle + above))
    scenario = arms.arm_scenario(UR5, reference, bounds=tube)
    inertia = jnp.diagonal(UR5.mass_matrix(reference.position(jnp.zeros(()))))
    expected = np.minimum(1.0, inertia * 12.5**2 * 0.15**2 / 2)
    assert float(np.min(expected)) < 0.5
    np.testing.assert_allclose(get(scenario, "controller.weight"), expected, rtol=1e-6)


@pytest.mark.parametrize("name", ["ur5", "iiwa14"])
def test_joints_that_move_against_each_other_get_no_fast_mode(name):
    """With gains up to 100 M_ii, M^-1 K2 of the iiwa14 had a mode of 2195 1/s."""
    scenario = getattr(ij.presets, name)()
    taken = np.asarray(get(scenario, "controller.K2"))

    @jax.jit
    def inertia(t):
        return scenario.model.mass_matrix(scenario.reference.position(t))

    start = inertia(0.0)
    without = 25.0 * np.minimum(np.abs(start).sum(axis=1), 4.0 * np.diagonal(start))
    assert np.all(taken <= without * (1 + 1e-9))

    def fastest(gains):
        return max(
            np.abs(np.linalg.eigvals(np.linalg.solve(inertia(t), np.diag(gains)))).max()
            for t in np.arange(0.0, 20.0, 2.5)
        )

    assert 50.0 < fastest(taken) < 200.0 and fastest(without) > 200.0
