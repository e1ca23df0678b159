"""A pendulum with its motor: bounds on the angle, the velocity and the torque of the motor."""

import iblf_jax as ij

run = ij.simulate(ij.presets.motor_driven_pendulum(), duration=10.0, dt=2e-3)
figure = run.plot()
