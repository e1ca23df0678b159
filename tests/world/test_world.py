"""References, bounds and disturbances against closed forms, SciPy and finite differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from independent import Loop
from scipy.interpolate import make_interp_spline

import iblf_jax as ij
from iblf_jax import disturbances, references
from iblf_jax.core.taylor import in_time
from iblf_jax.simulation import closed_loop

TWO_LINK = ij.presets.customary_two_link()


def derivatives(function, order):
    """A function of time with its first `order` derivatives."""
    return jax.jit(lambda t: in_time(function, t, order))


TIMES = (0.5, 1.0, 2.2, 3.0, 4.5)
POINTS = np.asarray([[0.0, 0.1], [0.4, 0.3], [0.2, 0.8], [0.6, 0.4], [0.5, 0.5]])


def test_spline_is_the_quintic_of_scipy_and_rests_outside():
    spline = references.WaypointSpline(TIMES, POINTS)
    at = derivatives(spline.position, 2)
    places = [at(t)[0] for t in (0.0, *TIMES, 20.0)]
    np.testing.assert_allclose(places, POINTS[[0, 0, 1, 2, 3, 4, 4]], atol=1e-12)
    for t, point in ((0.0, POINTS[0]), (0.5, POINTS[0]), (4.5, POINTS[-1]), (20.0, POINTS[-1])):
        np.testing.assert_allclose(at(t), [point, [0, 0], [0, 0]], atol=1e-9)
    rest = [(1, np.zeros(2)), (2, np.zeros(2))]
    expected = make_interp_spline(TIMES, POINTS, k=5, bc_type=(rest, rest))
    for t in [*TIMES[1:-1], *np.linspace(0.5, 4.5, 23)[1:-1]]:
        np.testing.assert_allclose(at(t), [expected(t, i) for i in range(3)], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("m", [1, 4])
def test_spline_with_more_derivatives_rests_at_its_ends(m):
    """Its first m derivatives vanish at the ends, where the next one jumps."""
    spline = references.WaypointSpline(TIMES, POINTS, derivatives=m)
    assert spline.continuous_derivatives == m
    at = derivatives(spline.position, m + 1)
    for t, point in zip(TIMES, POINTS, strict=True):
        np.testing.assert_allclose(at(t)[0], point, atol=1e-12)
    for t in (TIMES[0] + 1e-12, TIMES[-1] - 1e-12):
        _, *rates, next_one = at(t)
        np.testing.assert_allclose(rates, 0, atol=1e-7)
        assert np.max(np.abs(next_one)) > 0.5
    for t in TIMES[1:-1]:
        for order, (before, after) in enumerate(zip(at(t - 1e-9), at(t + 1e-9), strict=True)):
            np.testing.assert_allclose(before, after, atol=1e-5 * 10**order)


@pytest.mark.parametrize("m", [1, 2, 4])
def test_smooth_step_has_the_derivatives_that_it_states(m):
    """With two of them it is the quintic."""
    start, end, duration = np.asarray([0.1, 0.5]), np.asarray([0.9, -0.2]), 2.5
    step = references.SmoothStep(start, end, duration, derivatives=m)
    assert step.continuous_derivatives == m
    at = derivatives(step.position, m + 1)
    for t, expected in ((1e-12, start), (duration - 1e-12, end)):
        q, *rates, next_one = at(t)
        np.testing.assert_allclose(q, expected, atol=1e-14)
        np.testing.assert_allclose(rates, 0, atol=1e-8)
        assert np.max(np.abs(next_one)) > 0.1
    np.testing.assert_allclose(at(0.5 * duration)[0], (start + end) / 2, atol=1e-14)
    np.testing.assert_allclose(at(9.0)[0], end)
    quintic = references.Quintic(start, end, duration)
    for t in np.linspace(-0.5, 3.0, 15) if m == 2 else ():
        np.testing.assert_allclose(quintic.position(t), step.position(t), atol=1e-14)


@pytest.mark.parametrize("m", [0, 13, 2.5])
def test_numbers_of_derivatives_that_are_refused(m):
    with pytest.raises(ValueError, match=f"SmoothStep.derivatives: got {m}"):
        references.SmoothStep(0.0, 1.0, 1.0, derivatives=m)
    with pytest.raises(ValueError, match=f"WaypointSpline.derivatives: got {m}"):
        references.WaypointSpline((0.0, 1.0), [[0.0], [1.0]], derivatives=m)


def test_the_heading_on_an_ellipse_is_along_its_tangent():
    ellipse = references.Ellipse(axes=(5.0, 3.0), frequency=0.4, centre=(1.0, -2.0))
    at = derivatives(ellipse.position, 1)
    for t in np.linspace(0.0, 20.0, 41):
        (north, east, heading), rate = (np.asarray(x) for x in at(t))
        assert ((north - 1.0) / 5.0) ** 2 + ((east + 2.0) / 3.0) ** 2 == pytest.approx(1.0)
        speed = np.hypot(*rate[:2])
        np.testing.assert_allclose([np.cos(heading), np.sin(heading)], rate[:2] / speed, atol=1e-12)
        assert rate[2] > 0.0
    turn = 2.0 * np.pi / 0.4
    grown = ellipse.position(1.0 + turn)[2] - ellipse.position(1.0)[2]
    assert grown == pytest.approx(2.0 * np.pi)


def test_a_reference_needs_two_derivatives_and_no_third():
    """One from outside of JAX, say: it gives position, velocity and acceleration."""

    def outside(f):
        shape, how = jax.ShapeDtypeStruct((2,), float), {"vmap_method": "sequential"}
        return lambda t: jax.pure_callback(lambda t: np.asarray(f(float(t))), shape, t, **how)

    acceleration = outside(lambda t: [-0.1 * np.sin(t), -0.1 * np.cos(t)])
    velocity = jax.custom_jvp(outside(lambda t: [0.1 * np.cos(t), -0.1 * np.sin(t)]))
    position = jax.custom_jvp(outside(lambda t: [0.5 + 0.1 * np.sin(t), 0.5 + 0.1 * np.cos(t)]))
    velocity.defjvp(lambda t, dt: (velocity(*t), acceleration(*t) * dt[0]))
    position.defjvp(lambda t, dt: (position(*t), velocity(*t) * dt[0]))

    @ij.component
    class Outside:
        def position(self, t):
            return position(t)

    for law in ("integral", "computed_torque", "pd"):
        scenario = ij.with_parts(ij.presets.zhang_yan_2024(law=law), reference=Outside())
        start = closed_loop.initial_state(scenario)
        rate = jax.eval_shape(closed_loop.rate, scenario, jnp.asarray(0.3), start)
        assert rate.x.shape == (2, 2)


def torque(disturbance, t, q, dq, plant=TWO_LINK):
    return np.asarray(disturbance.torque(*map(jnp.asarray, (t, q, dq)), plant, TWO_LINK))


def test_disturbances_by_hand(rng):
    q, dq = rng.uniform(-1, 1, (2, 2))
    np.testing.assert_array_equal(torque(disturbances.Nothing(), 1.0, q, dq), 0)
    wave = disturbances.Sinusoids(amplitude=[1.0, 2.0], frequency=3.0, phase=0.4, offset=0.2)
    expected = 0.2 + np.asarray([1, 2]) * np.sin(2.7 + 0.4)
    np.testing.assert_allclose(torque(wave, 0.9, q, dq), expected)
    step = disturbances.Step(size=[1.0, -2.0], time=3.0)
    np.testing.assert_array_equal(torque(step, 2.999, q, dq), 0)
    np.testing.assert_array_equal(torque(step, 3.0, q, dq), [1.0, -2.0])
    np.testing.assert_array_equal(step.jump_times(), [3.0])
    friction = disturbances.Friction(viscous=0.5, coulomb=0.2, width=0.01)
    np.testing.assert_allclose(torque(friction, 0.0, q, np.asarray([2.0, -1.0])), [-1.2, 0.7])
    both = disturbances.Sum((friction, step, disturbances.Step(1.0, 5.0)))
    expected = torque(friction, 4.0, q, dq) + np.asarray([1.0, -2.0])
    np.testing.assert_allclose(torque(both, 4.0, q, dq), expected)
    np.testing.assert_array_equal(both.jump_times(), [3.0, 5.0])
    # That of the paper, (4.3), has the matrices of the model.
    f, heavy = ij.presets.zhang_yan_2024().disturbance, dataclasses.replace(TWO_LINK, mass=5.0)
    np.testing.assert_allclose(torque(f, 1.7, q, dq), Loop().disturbance(1.7, q, dq), rtol=1e-12)
    np.testing.assert_array_equal(torque(f, 1.7, q, dq, heavy), torque(f, 1.7, q, dq))


def test_tip_force_does_the_work_that_it_should(rng):
    """Virtual work: F . d tip = tau . dq."""
    push = disturbances.TipForce([3.0, -2.0], [1.0, 2.0], phase=0.3, offset=[0.0, -1.0])
    q, dq, t = rng.uniform(-1, 1, 2), rng.normal(size=2), 0.8
    force = np.array([3.0 * np.sin(t + 0.3), -1.0 - 2.0 * np.sin(2.0 * t + 0.3)])
    ahead, behind = (np.asarray(TWO_LINK.tip(q + h * dq)) for h in (1e-6, -1e-6))
    moved = (ahead - behind) / 2e-6
    assert torque(push, t, q, dq) @ dq == pytest.approx(force @ moved, rel=1e-8)
