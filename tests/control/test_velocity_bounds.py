"""Bounds on the velocities: watched by metrics and status, whatever the law knows of them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from refused import refused

import iblf_jax as ij
from iblf_jax import bounds
from iblf_jax.simulation import metrics

SHORT = {"duration": 1.0, "dt": 1e-3}


def speeds(low=(-1.6, -1.4), high=(0.6, 0.5), amplitude=(0.1, 0.0)):
    return bounds.Bounds(
        lower=bounds.Sinusoid(offset=low, amplitude=[-x for x in amplitude]),
        upper=bounds.Sinusoid(offset=high, amplitude=amplitude, phase=np.pi / 2),
    )


PAPER = ij.presets.zhang_yan_2024(variant="corrected")
UR5 = ij.presets.arms.arm("ur5")
WIDE = speeds()


def paper(velocities=WIDE, **parts):
    return ij.with_parts(PAPER, bounds=(PAPER.bounds[0], velocities), **parts)


@pytest.mark.slow
def test_what_is_watched_is_what_the_samples_say():
    run = ij.simulate(paper(), **SHORT)
    t = np.asarray(run.t)
    low = np.stack([-1.6 - 0.1 * np.sin(t), np.full_like(t, -1.4)], axis=1)
    high = np.stack([0.6 + 0.1 * np.cos(t), np.full_like(t, 0.5)], axis=1)
    np.testing.assert_allclose(run.dq_lower, low, atol=1e-15)
    np.testing.assert_allclose(run.dq_upper, high, atol=1e-15)
    assert run.ok
    for name, signal in (("velocity_margin", run.dq), ("alpha_margin", run.alpha)):
        expected = np.minimum(signal - low, high - signal).min(axis=0)
        np.testing.assert_allclose(run.metrics[name], expected, rtol=1e-12)
    assert np.isinf(run.metrics.first_velocity_violation_time)
    assert int(run.metrics.first_velocity_violation_joint) == -1
    data = run.to_xarray()
    assert data.dq_lower.units == "rad/s"
    np.testing.assert_array_equal(data.dq_upper, run.dq_upper)


def test_a_funnel_of_velocities_follows_the_reference():
    funnel = bounds.Bounds(lower=bounds.Funnel(-1.0, -0.2, 2.0), upper=bounds.Funnel(1.5, 0.2, 2.0))
    context, t = paper(funnel).context, jnp.asarray(0.7)
    slow, fast = context.speed_limits(t)
    dq_d, r = context.tube(t).dq_d, np.exp(-1.4)
    np.testing.assert_allclose(fast, dq_d + 1.3 * r + 0.2, rtol=1e-12)
    np.testing.assert_allclose(slow, dq_d - 0.8 * r - 0.2, rtol=1e-12)


def test_limits_of_a_robot():
    found = bounds.from_speed_limits(UR5, share=0.5)
    np.testing.assert_allclose(found.upper.value, 0.5 * np.array([3.15, 3.15, 3.15, 3.2, 3.2, 3.2]))
    np.testing.assert_allclose(found.lower.value, -np.asarray(found.upper.value))


def run_with(*velocities, metrics=None, **parts):
    return ij.simulate(paper(*velocities, **parts), **SHORT, metrics=metrics)


test_bad_ones_are_refused = refused(
    (lambda: run_with(3.0), r"bounds\[1\]: got 3\.0?, .*a Bounds, or None"),
    (lambda: run_with(speeds((-1.6, -1.4), (-1.7, 0.5), (0, 0))), r"bounds\[1\] of joint 0"),
    (lambda: run_with(initial=ij.Initial([0.8, 0.8], [0.0, 0.6])), r"initial\.dq\[1\]"),
    (lambda: run_with(speeds((-1.6,) * 3, (0.6,) * 3, (0.1,) * 3)), "2 .one a joint."),
    (lambda: run_with(None, metrics=(metrics.VelocityMargin(),)), "bounds of the second level"),
    (lambda: bounds.from_speed_limits(PAPER.plant), "speed limits"),
    (lambda: bounds.from_speed_limits(dataclasses.replace(UR5, speed=np.inf)), "unlimited"),
)
