"""The paper's arm in its tube: two joints, bounds that move, and one of the two laws."""

import iblf_jax as ij

scenario = ij.presets.zhang_yan_2024()
run = ij.simulate(scenario, duration=20.0, dt=1e-3)
figure = run.plot()

# %% The metrics are folds over every step, whatever is recorded.
print(run.metrics)
