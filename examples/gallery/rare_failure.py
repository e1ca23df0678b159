"""Rare failures: the probability that an arm with random parameters leaves its bounds, which no
study of 10,000 runs would show.
"""

import iblf_jax as ij

scenario = ij.with_parameters(
    ij.presets.zhang_yan_2024(law="pd"), {"controller.Kp": 40.0, "controller.Kd": 10.0}
)
perturbations = {
    "plant.payload": ij.value(ij.uniform(0.0, 1.5)),
    "plant.mass": ij.factor(ij.normal(1.0, 0.08)),
    "initial.q": ij.offset(ij.normal(0.0, 0.01)),
    "initial.dq": ij.offset(ij.normal(0.0, 0.3)),
}
risk = ij.failure_probability(
    scenario, perturbations, duration=4.0, dt=2e-3, runs=2000, progress=False
)
figure = risk.plot()

# %% The estimate, its interval, and the draw that leads to failure with the highest probability.
print(risk)

# %% The run with these parameters touches a bound; the nominal run does not.
runs = {
    "nominal": ij.simulate(scenario, duration=4.0, dt=2e-3),
    "most likely failure": risk.most_likely_failure.replay(),
}
positions = ij.plotting.positions(runs)
