"""An arm with electric drives: a law of order 3 with bounds on velocities and currents."""

import iblf_jax as ij
from iblf_jax import plotting

run = ij.simulate(ij.presets.motor_driven_two_link(), duration=6.0, dt=1e-3)
figure = plotting.levels(run)
