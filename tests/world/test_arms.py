"""The arms that come with the package: their data, what follows from an arm's own numbers, and the
presets on them."""

from __future__ import annotations

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT

import iblf_jax as ij
from iblf_jax import bounds, controllers, references
from iblf_jax.core.status import describe
from iblf_jax.presets import arms
from iblf_jax.simulation.paths import get

RUN = {"duration": 1.0, "dt": 1e-3, "record_every": 4}
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
    loaded = ij.robots.load(ROOT / "tests" / "data" / "arms" / f"{name}.urdf", tip=PRESETS[name][2])
    shipped = arms.arm(name)
    assert jax.tree.structure(shipped) == jax.tree.structure(loaded)
    for one, other in zip(jax.tree.leaves(shipped), jax.tree.leaves(loaded), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=2e-14)
    assert shipped.n == PRESETS[name][1]


@pytest.mark.slow
def test_an_arm_is_like_what_its_maker_says():
    """Reach and weight, from the makers' data sheets: 0.85 m and 18.4 kg with the base; 0.82 m to
    the wrist and 29.9 kg."""
    ur5, iiwa = arms.arm("ur5"), arms.arm("iiwa14")
    stretched = ur5.skeleton(jnp.array([0.0, np.pi / 2, 0, 0, 0, 0]))
    assert float(jnp.linalg.norm(stretched[3] - stretched[1])) == pytest.approx(0.817, abs=0.11)
    assert float(ur5.mass.sum()) == pytest.approx(18.4, abs=2)
    upright = iiwa.skeleton(jnp.zeros(7))
    assert float(upright[5, 2] - upright[1, 2]) == pytest.approx(0.82, abs=0.01)
    assert float(iiwa.mass.sum()) == pytest.approx(29.9 - 5.0, abs=2)
    np.testing.assert_allclose(upright[:, :2], 0, atol=1e-12)


def test_unknown_arm():
    with pytest.raises(ValueError, match=r"arm: got 'ur6'.*'iiwa14'"):
        arms.arm("ur6")


# ----------------------------------------------------------------------------------- the presets


@pytest.mark.slow
def test_the_run_does_its_job():
    """That of the iiwa 14 is one of `test_digests.py`."""
    scenario = ij.presets.ur5()
    run = ij.simulate(scenario, **RUN)
    assert run.ok, describe(int(run.status))
    assert np.all(np.asarray(run.metrics.margin) > 0.1)
    assert np.all(np.abs(run.e1[-1]) < 0.08)
    assert float(run.metrics.rmse.max()) < 0.12
    assert np.all(np.asarray(run.metrics.peak_torque) < 0.6 * np.asarray(scenario.model.effort))
    assert ij.recommended_dt(scenario, duration=RUN["duration"]) >= RUN["dt"]


@pytest.mark.slow
def test_bounds_are_inside_the_joint_limits(scenario):
    """Strictly, at every time; other below than above; and they move."""
    t = jnp.linspace(0.0, 120.0, 12001)
    q_d = jax.vmap(scenario.reference.position)(t)
    lower, upper = (
        np.asarray(jax.vmap(side.at)(t, q_d))
        for side in (scenario.bounds[0].lower, scenario.bounds[0].upper)
    )
    limits = scenario.plant.limits
    assert np.all(np.asarray(limits.lower) < lower)
    assert np.all(upper < np.asarray(limits.upper))
    assert np.min(np.minimum(q_d - lower, upper - q_d)) > 0.2
    assert np.all(np.ptp(lower, axis=0) > 0.05)
    assert np.all(np.ptp(upper, axis=0) > 0.05)
    assert np.all(np.abs((q_d - lower) - (upper - q_d)).max(axis=0) > 0.05)


@pytest.mark.slow
def test_the_payload_is_in_the_plant_alone(name, scenario):
    assert float(scenario.plant.payload) > 0
    assert float(scenario.model.payload) == 0
    other = PRESETS[name][0](payload=0.0)
    assert float(other.plant.payload) == 0
    assert jax.tree.structure(other) == jax.tree.structure(scenario)
    with pytest.raises(ValueError, match="payload"):
        PRESETS[name][0](payload=-1.0)


@pytest.mark.release
def test_the_certificate_holds(name, scenario):
    """The corrected law, all the way: every line that applies."""
    certificate = ij.certify(scenario, ij.simulate(scenario, **RUN))
    assert certificate.verdict == "holds"
    assert certificate["weighted inequality, case 2"].margin > 0
    if name == "ur5":  # the last joint of the other one has a K2 below 1/2
        assert certificate["inequality, case 2"].margin > 0
    assert certificate["joints inside"].margin > 0.5


# ------------------------------------------------------------ what follows from an arm's numbers


def test_joint_limits_become_bounds():
    arm = arms.arm("iiwa14")
    found = bounds.from_limits(arm, margin=0.1)
    np.testing.assert_allclose(found.lower.at(0.0, jnp.zeros(7)), arm.lower + 0.1)
    np.testing.assert_allclose(found.upper.at(3.0, jnp.zeros(7)), arm.upper - 0.1)


def test_joints_without_limits_need_a_word():
    arm = dataclasses.replace(arms.arm("iiwa14"), upper=arms.arm("iiwa14").upper.at[3].set(jnp.inf))
    with pytest.raises(ValueError, match="unlimited"):
        bounds.from_limits(arm)
    assert float(bounds.from_limits(arm, unlimited=6.0).upper.value[3]) == 6.0
    with pytest.raises(ValueError, match="margin: got 5"):
        bounds.from_limits(arms.arm("iiwa14"), margin=5.0)
    with pytest.raises(ValueError, match="joint limits"):
        bounds.from_limits(ij.presets.customary_two_link())


def test_efforts_become_saturation():
    law, arm = controllers.ComputedTorque(Kp=25.0, Kd=10.0), arms.arm("ur5")
    np.testing.assert_array_equal(controllers.within_effort(law, arm).limit, arm.effort)
    assert controllers.within_effort(law, arm, edge="smooth").edge == "smooth"
    assert controllers.within_effort(law, dataclasses.replace(arm, effort=jnp.inf)) is law
    assert controllers.within_effort(law, ij.presets.customary_two_link()) is law
    some = controllers.within_effort(
        law, dataclasses.replace(arm, effort=arm.effort.at[0].set(jnp.inf))
    )
    assert float(some.limit[0]) == 1e6
    assert float(some.limit[1]) == 150


def test_gains_follow_the_inertia():
    arm = arms.arm("iiwa14")
    q = jnp.array([0.0, 0.6, 0.0, -1.1, 0.0, 0.9, 0.0])
    K2 = arms.inertial_gain(arm, q, rate=30.0)
    np.testing.assert_allclose(K2[:4], 30.0 * jnp.diagonal(arm.mass_matrix(q))[:4])
    assert float(K2.min()) == arms.MIN_K2


@pytest.mark.slow
@pytest.mark.parametrize("law", ["computed_torque", "pd"])
def test_other_laws_on_the_arm(law):
    """The yardsticks at gains that suit its wrist, too."""
    run = ij.simulate(ij.presets.ur5(law=law, payload=0.5), duration=0.08, dt=1e-3)
    assert run.ok


def test_a_scenario_from_an_arm_alone():
    arm = arms.arm("ur5")
    reference = references.Quintic(
        start=[0.0, -1.2, 1.6, -1.4, -1.57, 0.0],
        end=[0.5, -1.0, 1.2, -1.0, -1.57, 0.5],
        duration=2.0,
    )
    scenario = arms.arm_scenario(arm, reference)
    np.testing.assert_array_equal(scenario.bounds[0].upper.value, arm.upper)
    np.testing.assert_allclose(scenario.initial.q, reference.start)
    with pytest.raises(ValueError, match="variant"):
        arms.arm_scenario(arm, reference, variant="wrong")


# -------------------------------------------------------------- joints of small inertia, sampled

LAB = {"sampling": ij.Sampling(period=2e-3, delay=1e-3)}
"""500 Hz, and half a period late."""
MIDDLE, AMPLITUDE = [0.3, -0.6, 1.0, 0.2, 0.4, 0.1], [0.3, 0.2, 0.3, 0.4, 0.3, 0.5]
FREQUENCY = [1.0, 0.8, 1.1, 1.3, 0.9, 1.2]


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
    arm = ij.robots.load(
        ROOT / "tests" / "data" / "arms" / "light_wrist.urdf", tip="hand", locked=held
    )
    reference = references.Sinusoid(
        offset=MIDDLE[-joints:], amplitude=AMPLITUDE[-joints:], frequency=FREQUENCY[-joints:]
    )
    return arms.arm_scenario(arm, reference, bounds=narrow(width))


@pytest.mark.slow
@pytest.mark.parametrize("joints", [2, pytest.param(6, marks=pytest.mark.release)])
def test_a_light_wrist_keeps_narrow_bounds_at_500_hz_and_did_not_with_the_papers_weight(joints):
    scenario = ij.with_parts(light_wrist(joints), **LAB)
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


SLOW_PARTS = {
    "sensor": ij.sensors.Encoder(
        counts=131072, velocity=ij.sensors.FilteredDifference(cutoff=400.0)
    ),
    "actuator": ij.actuators.Motor(bandwidth=400.0),
}
"""Filter and drive with a lag of 2.5 ms each."""


@pytest.mark.slow
def test_a_light_wrist_keeps_its_bounds_whatever_its_masses_are():
    unknown = {
        "plant.mass": ij.factor(ij.uniform(0.8, 1.25)),
        "initial.q": ij.offset(ij.uniform(-0.04, 0.04)),
    }
    scenario = ij.with_parts(light_wrist(), **LAB, **SLOW_PARTS)
    study = ij.monte_carlo(
        scenario, unknown, runs=16, seed=0, duration=1.0, dt=1e-3, progress=False
    )
    assert not len(study.failed)
    # In most runs the bound (A.5) on what one count of the encoder changes is just above 0.5 %.
    assert not np.any(np.asarray(study.status) & ~int(ij.Status.INACCURATE))
    assert float(np.min(study.metrics["margin"])) > 0.03


@pytest.mark.slow
def test_the_weight_makes_every_barrier_as_stiff_at_the_reference():
    """ds/de1 at e1 = 0 is that of the barrier: 2/k^2 of the integral one, 1 of the tangent."""
    for law, stiffness in (
        ("integral", 2 / 0.3**2),
        ("log", 1 / 0.3**2),
        ("mapping", 1.0),
        ("dynamic_surface", 2 / 0.3**2),
    ):
        scenario = arms.arm_scenario(
            arms.arm("ur5"),
            references.Quintic(start=MIDDLE, end=AMPLITUDE, duration=1.0),
            law=law,
            bounds=narrow(0.3),
        )
        inertia = jnp.diagonal(scenario.model.mass_matrix(scenario.initial.q))
        np.testing.assert_allclose(
            get(scenario, "controller.weight"),
            np.minimum(1.0, inertia * 12.5**2 / stiffness),
            rtol=1e-9,
        )
    with pytest.raises(ValueError, match="bounds: got 3"):
        arms.arm_scenario(
            arms.arm("ur5"), references.Quintic(start=MIDDLE, end=AMPLITUDE, duration=1.0), bounds=3
        )


def test_the_weight_is_that_of_the_nearer_bound_whichever_side_it_is_on():
    """The slope of the integral barrier at e1 = 0 has two derivatives, 2/k_l^2 and 2/k_u^2."""
    arm, k = arms.arm("ur5"), 0.15
    hold = references.Quintic(start=MIDDLE, end=MIDDLE, duration=1.0)
    inertia = jnp.diagonal(arm.mass_matrix(hold.position(jnp.zeros(()))))
    expected = np.minimum(1.0, inertia * 12.5**2 * k**2 / 2)
    assert float(np.min(expected)) < 0.5
    for below, above in ((k, 1.0), (1.0, k)):
        tube = bounds.Bounds(
            lower=bounds.Constant(np.asarray(MIDDLE) - below),
            upper=bounds.Constant(np.asarray(MIDDLE) + above),
        )
        scenario = arms.arm_scenario(arm, hold, bounds=tube)
        np.testing.assert_allclose(get(scenario, "controller.weight"), expected, rtol=1e-9)


@pytest.mark.slow
def test_the_weight_is_that_of_the_nearest_bound_of_a_short_motion():
    """A motion of 0.2 s comes nearest to its bounds at 0.1 s."""
    arm, k = arms.arm("ur5"), 0.15
    there = np.asarray(MIDDLE) + 0.5
    spline = references.WaypointSpline(
        times=(0.0, 0.1, 0.2), waypoints=np.array([MIDDLE, there, MIDDLE])
    )
    tube = bounds.Bounds(
        lower=bounds.Constant(np.asarray(MIDDLE) - 1.0), upper=bounds.Constant(there + k)
    )
    scenario = arms.arm_scenario(arm, spline, bounds=tube)
    inertia = jnp.diagonal(arm.mass_matrix(spline.position(jnp.zeros(()))))
    np.testing.assert_allclose(
        get(scenario, "controller.weight"), np.minimum(1.0, inertia * 12.5**2 * k**2 / 2), rtol=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_light_wrist_near_either_end_of_its_range_is_stable_at_500_hz(side):
    pytest.importorskip("mujoco")
    arm = ij.robots.load(ROOT / "tests" / "data" / "arms" / "light_wrist.urdf", tip="hand")
    pose = np.array([0.3, -0.6, 1.0, 0.2, 1.8 * side, 2.65 * side])
    hold = references.Quintic(start=pose, end=pose, duration=1.0)
    scenario = ij.with_parts(arms.arm_scenario(arm, hold), **LAB)
    for offset in (-0.02, 0.02):
        moved = ij.Initial(q=pose + offset * np.array([0, 0, 0, 0, 1, 1]))
        run = ij.simulate(ij.with_parts(scenario, initial=moved), duration=0.1, dt=1e-3)
        assert int(run.status) == 0
        assert float(run.metrics.sampling_radius) < 0.996


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
