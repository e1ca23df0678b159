"""Seven joints: the iiwa 14 and the relative errors of its joints."""

import iblf_jax as ij
from iblf_jax import plotting

run = ij.simulate(ij.presets.iiwa14(), duration=4.0, dt=2e-3, record_every=10)
film = plotting.animate(run, "iiwa14.gif", fps=10)

# %% The relative error is 1 at the upper bound and -1 at the lower bound.
figure = plotting.errors(run)
