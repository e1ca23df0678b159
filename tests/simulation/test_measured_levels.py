"""Levels that are not measured, and the noise that an observer of levels amplifies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from iblf_jax.observers import StateObserver
from iblf_jax.sensors import Direct, Encoder, FilteredDifference, Levels, Tracking

import iblf_jax as ij
from iblf_jax.core import notices
from iblf_jax.simulation.measurement_noise import noise_advice, standard_deviations
from iblf_jax.simulation.scenario import canonical

LINK = ij.robots.PlanarChain(mass=[1.3], length=[0.4], centre=[0.2], inertia=[0.02])
FLEXIBLE = ij.plants.FlexibleJoint(LINK, stiffness=300.0, motor_inertia=0.03, motor_damping=0.1)
DRIVE = ij.plants.ElectricDrive(
    LINK, torque_constant=2.0, inductance=0.02, resistance=1.0, back_emf=0.5
)
GAINS = {3: (3.0, 20.0, 60.0), 4: (3.0, 20.0, 40.0, 60.0)}
FILTERED = Encoder(counts=65536, noise=2e-5, velocity=FilteredDifference(cutoff=500.0))
READING = StateObserver(bandwidth=200.0, measured=(1, 2))
TRACKED = Encoder(noise=1e-4, velocity=Tracking(bandwidth=300.0))


def loop(plant, **parts):
    """One joint that follows a sinusoid, sampled at 1 kHz."""
    values = {
        "controller": ij.controllers.BarrierBackstepping(k=GAINS[plant.order]),
        "initial": ij.Initial(q=0.5, dq=0.4),
        "sampling": ij.Sampling(period=1e-3),
        "disturbance": ij.disturbances.Sinusoids(amplitude=0.2, frequency=3.0, offset=0.1),
    } | parts
    return ij.Scenario(
        plant=plant,
        reference=ij.references.Sinusoid(offset=0.5, amplitude=0.2, frequency=2.0),
        bounds=ij.Bounds(lower=ij.bounds.Constant(0.1), upper=ij.bounds.Constant(0.9)),
        **values,
    )


def simulated(scenario, duration=0.5):
    with notices.muted():
        return ij.simulate(scenario, duration=duration, dt=5e-4, seed=3)


@pytest.mark.parametrize(
    ("parts", "observer", "text"),
    [
        ((FILTERED,), ij.observers.NoObserver(), "sensors of 2 levels.*sensors of 3 levels"),
        ((FILTERED, None), ij.observers.NoObserver(), "level 3.*StateObserver.*measured=.1, 2."),
        ((FILTERED, None), ij.observers.LevelObserver(gain=20.0), "level 3.*StateObserver"),
        ((None, Direct(), Direct()), ij.observers.NoObserver(), "level 1.*measure level 1"),
        ((Direct(), None, Direct()), READING, "level 2 measured, which StateObserver reads"),
    ],
)
def test_a_level_that_is_neither_measured_nor_estimated_is_refused(parts, observer, text):
    with pytest.raises(ValueError, match=rf"Scenario\.sensor.*{text}"):
        loop(DRIVE, sensor=Levels(parts), observer=observer)


@pytest.fixture(scope="module")
def all_measured():
    full = StateObserver(bandwidth=400.0, measured=(1, 2, 3, 4))
    return simulated(loop(FLEXIBLE, observer=full), duration=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("motor", [None, Direct()], ids=["link encoder", "link and motor encoder"])
def test_unmeasured_levels_of_a_flexible_joint(motor, all_measured):
    """Encoders without velocities track about as well as a measurement of all levels.  With that of
    the link alone its disturbance appears as one of the motor, and in theta as K (theta - q)."""
    measured = (1,) if motor is None else (1, 3)
    observer = StateObserver(bandwidth=400.0, measured=measured, offset=(0.0, 0.02, 0.0, 0.02))
    sensor = Levels((Direct(), None, motor, None))
    run = simulated(loop(FLEXIBLE, observer=observer, sensor=sensor), duration=1.0)
    late = slice(len(run.t) // 2, None, 2)
    errors = [float(np.max(np.abs(r.e1[late]))) for r in (all_measured, run)]
    assert errors[1] < 2.0 * errors[0] and errors[1] < 2e-3, errors
    np.testing.assert_allclose(run.measured.dq[late], run.dq[late], atol=5e-4)
    theta = run.x[late, 2]
    if motor is None:
        inertia = np.asarray(LINK.mass_matrix(jnp.zeros(1)))[0]
        theta = theta + inertia * run.disturbance[late, 1] / 300.0
    np.testing.assert_allclose(run.measured.higher[late, 0], theta, atol=1e-5)


FINE = Encoder(counts=2**18, noise=2e-5, velocity=FilteredDifference(cutoff=500.0))
"""Its noise exceeds a step, so that the rounding error of a joint at rest is white."""


@pytest.mark.slow
@pytest.mark.parametrize("encoder", [FINE, TRACKED], ids=["filtered", "tracking"])
def test_the_noise_of_measured_levels_is_that_of_many_samples(encoder, rng):
    """Against the standard deviation of 40,000 readings of a drive at rest, rounding included."""
    sensor = Levels((encoder, Direct(noise=0.03, resolution=0.05)))
    scenario = canonical(loop(DRIVE, sensor=sensor, initial=ij.Initial(q=0.5, dq=0.0)))
    found = standard_deviations(scenario)
    sensor, period = scenario.sensor, scenario.sampling.period

    @jax.jit
    def readings(x, normal):
        def sample(state, w):
            measured, state = sensor.measure(x, w, period, state)
            return state, jnp.concatenate([measured.q[None], measured.dq[None], measured.higher])

        return jax.lax.scan(sample, sensor.init(x, period), normal)[1]

    normal = jnp.asarray(rng.normal(size=(40_000, sensor.draws, 1)))
    many = readings(jnp.array([[0.5], [0.0], [1.0]]), normal)
    np.testing.assert_allclose(found, np.std(np.asarray(many)[200:], axis=0), rtol=0.03)


@pytest.mark.slow
def test_noise_through_a_level_observer_is_reported():
    """Of a gain for the current only; that of a run is the one that the warning states."""
    sensor = Levels((TRACKED, Direct(noise=0.02)))
    observer = ij.observers.LevelObserver(gain=(0.0, 0.0, 50.0))
    with pytest.warns(UserWarning, match="LevelObserver amplifies the sensor's noise"):
        scenario = canonical(loop(DRIVE, sensor=sensor, observer=observer))
    (text,) = noise_advice(scenario)
    assert "level 3: 0.02 A times 50 1/s give 1 A/s in d_hat_3" in text
    assert "level 2" not in text
    estimate = np.asarray(simulated(scenario).disturbance_estimate)[200::2, 2, 0]
    assert 0.8 < np.std(np.diff(estimate)) / np.sqrt(2.0) < 1.2
    for parts in ({"sensor": Levels((Direct(),) * 3)}, {"observer": ij.observers.NoObserver()}):
        assert noise_advice(canonical(ij.with_parts(scenario, **parts))) == []
