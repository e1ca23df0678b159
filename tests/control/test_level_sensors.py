"""Sensors of the levels of a plant: each part measures its own levels with its own noise."""

import jax
import jax.numpy as jnp
import numpy as np
from iblf_jax.sensors import (
    Direct,
    Encoder,
    FilteredDifference,
    Ideal,
    Levels,
    Measured,
    Unmeasured,
)
from refused import assert_refused

PERIOD = jnp.asarray(1e-3)
ENCODER = Encoder(
    counts=4096, noise=1e-3, offset=0.1, velocity=Measured(noise=jnp.array([0.01, 0.02]))
)
FILTERED = Encoder(noise=1e-3, velocity=FilteredDifference(cutoff=700.0))


def test_the_parts_measure_their_levels_with_their_normal_numbers(rng):
    """Two encoders and a current sensor, against the parts called one by one."""
    current = Direct(noise=0.5, resolution=0.25, offset=0.1)
    sensor = Levels((ENCODER, FILTERED, current))
    x, normal = jnp.asarray(rng.normal(size=(5, 2))), jnp.asarray(rng.normal(size=(4, 2)))
    assert (sensor.draws, sensor.order, sensor.measured) == (4, 5, (1, 2, 3, 4, 5))
    measured, after = sensor.measure(x, normal, PERIOD, sensor.init(x, PERIOD))
    first, _ = ENCODER.measure(x[0], x[1], normal[:2], PERIOD, ())
    before = FILTERED.init(x[2], x[3], PERIOD)
    second, values = FILTERED.measure(x[2], x[3], normal[2:3], PERIOD, before)
    third = 0.25 * np.round((x[4] + 0.1 + 0.5 * normal[3]) / 0.25)
    np.testing.assert_array_equal(measured.q, first.q)
    np.testing.assert_array_equal(measured.dq, first.dq)
    np.testing.assert_allclose(measured.higher, [second.q, second.dq, third], rtol=1e-15)
    jax.tree.map(np.testing.assert_array_equal, after, ((), values, ()))


def test_what_is_not_rounded_and_what_a_step_is():
    sensor = Levels((ENCODER, None, Direct(resolution=0.25)))
    step = 2.0 * np.pi / 4096
    np.testing.assert_allclose(sensor.resolution, [[step], [0.0], [0.0], [0.25]])
    smooth = sensor.unrounded
    np.testing.assert_array_equal(smooth.resolution, np.zeros((4, 1)))
    x = jnp.full((4, 2), 0.3)
    found = smooth.measure(x, jnp.zeros((2, 2)), PERIOD, smooth.init(x, PERIOD))[0]
    np.testing.assert_allclose(found.q, 0.4)
    np.testing.assert_allclose(found.higher, [[0.0, 0.0], [0.3, 0.3]])


def test_the_derivative_of_a_rounded_reading_is_1():
    direct, encoder = Direct(resolution=0.25), Encoder(counts=100, velocity=Measured())
    for read in (
        lambda x: direct.measure_level(x, None, PERIOD, ())[0],
        lambda x: encoder.measure(x, x, jnp.zeros((1, 2)), PERIOD, ())[0].q,
    ):
        slope = jax.grad(lambda x, read=read: read(x).sum())(jnp.array([0.3, -0.1]))
        np.testing.assert_array_equal(slope, [1.0, 1.0])


def test_levels_that_are_not_measured_advice_that_names_the_part_and_what_is_no_sensor():
    sensor = Levels((Ideal(), None, Unmeasured(), Direct()))
    assert sensor.measured == (1, 2, 5) and isinstance(sensor.parts[1], Unmeasured)
    fast = Encoder(velocity=FilteredDifference(cutoff=1e5))
    (text,) = Levels((Direct(), fast)).advice(PERIOD)
    assert text.startswith("sensor.parts[1].velocity.cutoff = 100000 rad/s")
    for parts in ((), ENCODER, (3.0,), (Levels((ENCODER,)),), (Measured(),)):
        assert_refused(r"Levels\.parts", Levels, parts)
