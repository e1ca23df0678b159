"""Gain tuning: from the paper's gains to better ones by gradient, with a price on effort."""

import iblf_jax as ij

scenario = ij.presets.zhang_yan_2024()
goal = ij.objectives.tracking() + 0.3 * ij.objectives.effort()
best = ij.tune(
    scenario, ["controller.k1", "controller.K2"], goal, duration=2.0, dt=1e-3, progress=False
)
figure = best.plot()

# %% What it is worth, on a run at half the step too.
print(best.report)
