"""Comparison of laws: four laws at equal gains and at equal effort."""

import iblf_jax as ij

scenario = ij.presets.zhang_yan_2024()
found = ij.compare(scenario, ["integral", "log", "tan", "pd"], duration=5.0, dt=1e-3)
figure = found.plot()

# %% The tables state what was held equal.
print(found)
