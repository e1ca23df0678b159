"""A Monte-Carlo study: quantiles and margins of 512 arms with random masses and payloads."""

import iblf_jax as ij
from iblf_jax import plotting

scenario = ij.presets.zhang_yan_2024()
unknown = {
    "plant.mass": ij.factor(ij.uniform(0.7, 1.3)),
    "plant.payload": ij.value(ij.uniform(0.0, 0.5)),
    "initial.q": ij.offset(ij.uniform(-0.08, 0.08)),
}
study = ij.monte_carlo(scenario, unknown, runs=512, duration=3.0, dt=1e-3, progress=False)
figure = plotting.bands(study)

# %% The dependence on each parameter.
margins = plotting.scatter(study, "rmse")
print(study)
