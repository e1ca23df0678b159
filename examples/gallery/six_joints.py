"""Six joints in space: the UR5 of the presets with a payload of 2 kg."""

import iblf_jax as ij
from iblf_jax import plotting

scenario = ij.presets.ur5()
run = ij.simulate(scenario, duration=4.0, dt=2e-3, record_every=10)
film = plotting.animate(run, "ur5.gif", fps=10)

# %% The positions of all joints between their bounds.
figure = plotting.positions(run)
