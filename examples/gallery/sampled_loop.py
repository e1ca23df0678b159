"""A sampled control loop: a law that runs once per period, an encoder and a motor."""

import iblf_jax as ij

lab = ij.with_parts(
    ij.with_parameters(ij.presets.zhang_yan_2024(), {"controller.K2": 4.0, "observer.kf": 4.0}),
    sampling=ij.Sampling(period=4e-3, delay=5e-4),
    sensor=ij.sensors.Encoder(
        counts=2.0**16, noise=1e-5, velocity=ij.sensors.FilteredDifference(cutoff=500.0)
    ),
    actuator=ij.actuators.Motor(bandwidth=1000.0, rate_limit=5000.0),
)
run = ij.simulate(lab, duration=1.0, dt=5e-4, seed=3)
figure = run.plot()
print(
    run.metrics.sampling_radius,
    "is the spectral radius of the one-period map; the loop is stable below 1",
)
