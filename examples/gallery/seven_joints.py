"""Seven joints: the iiwa 14, and how far each is from its bounds."""

import iblf_jax as ij
from iblf_jax import plotting

run = ij.simulate(ij.presets.iiwa14(), duration=4.0, dt=2e-3, record_every=10)
film = plotting.animate(run, "iiwa14.gif", fps=10)

# %% Relative errors: 1 is the upper bound, -1 the lower.
figure = plotting.errors(run)
