"""Six joints in space: the UR5 of the presets with 2 kg in its hand."""

import iblf_jax as ij
from iblf_jax import plotting

scenario = ij.presets.ur5()
run = ij.simulate(scenario, duration=4.0, dt=2e-3, record_every=10)
film = plotting.animate(run, "ur5.gif", fps=10)

# %% All six in their tubes.
figure = plotting.positions(run)
