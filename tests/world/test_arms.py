"""The arms that come with the package: their data, what follows from an arm's own numbers, and the
presets on them."""

from __future__ import annotations

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_cases import ARMS

import iblf_jax as ij
from iblf_jax import bounds, controllers, references
from iblf_jax.presets import arms
from iblf_jax.simulation.paths import get

PRESETS = {"ur5": (ij.presets.ur5, 6, "tool0"), "iiwa14": (ij.presets.iiwa14, 7, "iiwa_link_ee")}


@pytest.fixture(scope="module", params=PRESETS)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def scenario(name):
    return PRESETS[name][0]()


def test_the_data_are_what_the_file_says(name):
    """Every leaf, name and kind of joint, as `robots.load` reads them from the URDF."""
    pytest.importorskip("mujoco")
    loaded = ij.robots.load(ARMS / f"{name}.urdf", tip=PRESETS[name][2])
    shipped = arms.arm(name)
    assert jax.tree.structure(shipped) == jax.tree.structure(loaded)
    for one, other in zip(jax.tree.leaves(shipped), jax.tree.leaves(loaded), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=2e-14)
    assert shipped.n == PRESETS[name][1]


# ----------------------------------------------------------------------------------- the presets


@pytest.mark.slow
def test_the_payload_is_in_the_plant_alone(name, scenario):
    assert float(scenario.plant.payload) > 0
    assert float(scenario.model.payload) == 0
    other = PRESETS[name][0](payload=0.0)
    assert float(other.plant.payload) == 0
    assert jax.tree.structure(other) == jax.tree.structure(scenario)


# ------------------------------------------------------------ what follows from an arm's numbers


def test_joint_limits_become_bounds():
    arm = arms.arm("iiwa14")
    found = bounds.from_limits(arm, margin=0.1)
    np.testing.assert_allclose(found.lower.at(0.0, jnp.zeros(7)), arm.lower + 0.1)
    np.testing.assert_allclose(found.upper.at(3.0, jnp.zeros(7)), arm.upper - 0.1)


IIWA = arms.arm("iiwa14")
UNLIMITED = dataclasses.replace(IIWA, upper=IIWA.upper.at[3].set(jnp.inf))
UR5 = arms.arm("ur5")
MASSLESS = dataclasses.replace(UR5, mass=np.zeros(6), inertia=np.zeros((6, 6)))


def test_a_joint_without_a_limit_gets_the_one_that_is_given():
    assert float(bounds.from_limits(UNLIMITED, unlimited=6.0).upper.value[3]) == 6.0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: arms.arm("ur6"), r"arm: got 'ur6'.*'iiwa14'"),
        (lambda: bounds.from_limits(UNLIMITED), "unlimited"),
        (lambda: bounds.from_limits(IIWA, margin=5.0), "margin: got 5"),
        (lambda: bounds.from_limits(ij.presets.customary_two_link()), "joint limits"),
        (lambda: ij.presets.ur5(payload=-1.0), "payload"),
        (lambda: arms.arm_scenario(arms.arm("ur5"), HOLD, variant="wrong"), "variant"),
        (lambda: arms.arm_scenario(arms.arm("ur5"), HOLD, bounds=3), "bounds: got 3"),
        (lambda: arms.arm_scenario(MASSLESS, HOLD), r"positive definite.*at t = 0 s.*masses"),
    ],
)
def test_refusals_name_what_is_expected(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_efforts_become_saturation():
    law, arm = controllers.ComputedTorque(Kp=25.0, Kd=10.0), arms.arm("ur5")
    np.testing.assert_array_equal(controllers.within_effort(law, arm).limit, arm.effort)
    assert controllers.within_effort(law, arm, edge="smooth").edge == "smooth"
    assert controllers.within_effort(law, dataclasses.replace(arm, effort=jnp.inf)) is law
    assert controllers.within_effort(law, ij.presets.customary_two_link()) is law
    some = dataclasses.replace(arm, effort=arm.effort.at[0].set(jnp.inf))
    some = controllers.within_effort(law, some)
    assert float(some.limit[0]) == 1e6
    assert float(some.limit[1]) == 150


def test_gains_follow_the_inertia():
    arm = arms.arm("iiwa14")
    q = jnp.array([0.0, 0.6, 0.0, -1.1, 0.0, 0.9, 0.0])
    K2 = arms.inertial_gain(arm, q, rate=30.0)
    np.testing.assert_allclose(K2[:4], 30.0 * jnp.diagonal(arm.mass_matrix(q))[:4])
    assert float(K2.min()) == arms.MIN_K2


def test_a_scenario_from_an_arm_alone():
    arm = arms.arm("ur5")
    scenario = arms.arm_scenario(arm, HOLD)
    np.testing.assert_array_equal(scenario.bounds[0].upper.value, arm.upper)
    np.testing.assert_allclose(scenario.initial.q, MIDDLE)


# -------------------------------------------------------------- joints of small inertia, sampled

LAB = {"sampling": ij.Sampling(period=2e-3, delay=1e-3)}
"""500 Hz, and half a period late."""
MIDDLE, AMPLITUDE = [0.3, -0.6, 1.0, 0.2, 0.4, 0.1], [0.3, 0.2, 0.3, 0.4, 0.3, 0.5]
FREQUENCY = [1.0, 0.8, 1.1, 1.3, 0.9, 1.2]
HOLD = references.Quintic(start=MIDDLE, end=MIDDLE, duration=1.0)


LIGHT_WRIST = ARMS / "light_wrist.urdf"


def narrow(width):
    """Bounds at this distance from the reference."""
    return bounds.Bounds(
        lower=bounds.Funnel(initial=-width, final=-width, rate=1.0),
        upper=bounds.Funnel(initial=width, final=width, rate=1.0),
    )


def light_wrist(joints=6, width=0.12):
    """The last joints of an arm of six whose last one turns 0.002 kg m^2, between narrow bounds."""
    pytest.importorskip("mujoco")
    held = dict.fromkeys(("turn", "lift", "bend", "roll", "pitch", "twist")[: 6 - joints], 0.0)
    arm = ij.robots.load(LIGHT_WRIST, tip="hand", locked=held)
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
    assert np.all(np.asarray(K2 / inertia) <= 100.0 * (1 + 1e-12))
    assert np.all(np.asarray(K2 / inertia) >= 25.0 * (1 - 1e-12))
    np.testing.assert_allclose(weight, np.minimum(1.0, inertia * 12.5**2 * 0.12**2 / 2))
    brief = {"duration": 0.3, "dt": 1e-3, "record_every": 20}
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # neither a failure nor advice on gains
        run = ij.simulate(scenario, **brief)
    assert int(run.status) == 0
    assert float(run.metrics.sampling_radius) < 0.995
    assert float(run.metrics.margin.min()) > 0.09
    for factor in (0.3, 0.1, 0.03):
        # All but 1, which would be compiled in: a program of its own.
        papers = {
            "controller.K2": factor * jnp.maximum(25.0 * inertia, 0.6),
            "controller.weight": 1.0 - 1e-9,
        }
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
        scenario = arms.arm_scenario(arms.arm("ur5"), HOLD, law=law, bounds=narrow(0.3))
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
    ids=["below", "above", "short motion"],
)
def test_the_weight_is_that_of_the_nearest_bound(reference, below, above):
    """The slope of the integral barrier at e1 = 0 has two derivatives, 2/k_l^2 and 2/k_u^2."""
    arm, middle = arms.arm("ur5"), np.asarray(MIDDLE)
    tube = bounds.Bounds(bounds.Constant(middle - below), bounds.Constant(middle + above))
    scenario = arms.arm_scenario(arm, reference, bounds=tube)
    inertia = jnp.diagonal(arm.mass_matrix(reference.position(jnp.zeros(()))))
    expected = np.minimum(1.0, inertia * 12.5**2 * 0.15**2 / 2)
    assert float(np.min(expected)) < 0.5
    np.testing.assert_allclose(get(scenario, "controller.weight"), expected, rtol=1e-6)


@pytest.mark.parametrize("name", ["ur5", "iiwa14"])
def test_joints_that_move_against_each_other_get_no_fast_mode(name):
    """Axes of an arm are nearly parallel in some positions: with gains up to 100 M_ii, M^-1 K2 of
    the iiwa14 had a mode of 2195 1/s."""
    scenario = getattr(ij.presets, name)()
    taken = np.asarray(get(scenario, "controller.K2"))

    def inertia(t):
        return np.asarray(scenario.model.mass_matrix(scenario.reference.position(jnp.asarray(t))))

    start = inertia(0.0)
    without = 25.0 * np.minimum(np.abs(start).sum(axis=1), 4.0 * np.diagonal(start))
    assert np.all(taken <= without * (1 + 1e-9))

    def fastest(gains):
        return max(
            np.abs(np.linalg.eigvals(np.linalg.solve(inertia(t), np.diag(gains)))).max()
            for t in np.arange(0.0, 20.0, 2.5)
        )

    assert 50.0 < fastest(taken) < 200.0
    assert fastest(without) > 200.0
