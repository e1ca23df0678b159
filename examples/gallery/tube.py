"""The paper's example: two joints between time-varying bounds, under the proposed law.

[Time-varying asymmetric bounds](zhang_yan_2024.md) compares this run with a logarithmic barrier and
checks the statements of the paper.
"""

import iblf_jax as ij

scenario = ij.presets.zhang_yan_2024()
run = ij.simulate(scenario, duration=20.0, dt=1e-3)
figure = run.plot()

# %% The metrics use every time step, whatever is recorded.
print(run.metrics)
