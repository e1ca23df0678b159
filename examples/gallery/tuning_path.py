"""Gain tuning: a gradient search that starts at the paper's gains, with a cost on effort."""

import iblf_jax as ij

scenario = ij.presets.zhang_yan_2024()
goal = ij.objectives.tracking() + 0.3 * ij.objectives.effort()
best = ij.tune(
    scenario, ["controller.k1", "controller.K2"], goal, duration=2.0, dt=1e-3, progress=False
)
figure = best.plot()

# %% The improvement, also at half the time step.
print(best.report)
