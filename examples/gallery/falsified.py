"""Falsification: a gradient search for the arm within its tolerances with the smallest margin."""

import iblf_jax as ij
from iblf_jax import plotting

scenario = ij.with_parameters(
    ij.presets.zhang_yan_2024(law="pd"), {"controller.Kp": 30.0, "controller.Kd": 10.0}
)
tolerance = {
    "plant.payload": ij.value(ij.uniform(0.0, 1.5)),
    "plant.mass": ij.factor(ij.uniform(0.8, 1.2)),
    "initial.q": ij.offset(ij.uniform(-0.05, 0.05)),
    "initial.dq": ij.offset(ij.uniform(-2.0, 2.0)),
}
attack = ij.falsify(
    scenario, tolerance, duration=4.0, dt=1e-3, starts=8, iterations=6, progress=False
)
runs = {
    name: ij.simulate(s, duration=4.0, dt=1e-3)
    for name, s in {"nominal": scenario, "worst": attack.scenario}.items()
}
figure = plotting.positions(runs)

# %% The parameters of this arm.
print(attack)
