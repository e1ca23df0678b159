"""A funnel: bounds that converge to the reference, and a prescribed-performance law."""

import iblf_jax as ij
from iblf_jax import plotting

scenario = ij.presets.zhang_yan_2024_funnel(law="prescribed_performance")
run = ij.simulate(scenario, duration=5.0, dt=1e-3)
figure = plotting.positions(run)

# %% The relative error xi is 1 at the upper bound and -1 at the lower bound.
errors = plotting.errors(run)
