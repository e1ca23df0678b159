"""A funnel: bounds that shrink onto the reference, and a law made for them."""

import iblf_jax as ij
from iblf_jax import plotting

scenario = ij.presets.zhang_yan_2024_funnel(law="prescribed_performance")
run = ij.simulate(scenario, duration=5.0, dt=1e-3)
figure = plotting.positions(run)

# %% How near each joint comes to its bounds: xi is 1 at the upper one, -1 at the lower.
errors = plotting.errors(run)
