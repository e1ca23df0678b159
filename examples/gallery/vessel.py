"""A vessel on an ellipse: three components with units of their own."""

import iblf_jax as ij
from iblf_jax import plotting

run = ij.simulate(ij.presets.vessel(), duration=100.0, dt=0.02, record_every=5)
figure = plotting.levels(run)

# %% The path of the bow, with the hull.
path = plotting.workspace(run)
