"""A map of violations: the gains for which PD control with gravity compensation violates the
bounds.
"""

import numpy as np

import iblf_jax as ij
from iblf_jax import plotting

scenario = ij.presets.zhang_yan_2024(law="pd")
grid = {"controller.Kp": np.geomspace(2.0, 128.0, 7), "controller.Kd": np.geomspace(0.25, 16.0, 7)}
unknown = {"plant.payload": ij.value(ij.uniform(0.0, 1.0))}
table = ij.sweep(
    scenario, grid, perturbations=unknown, runs=32, duration=3.0, dt=1e-3, progress=False
)
figure = plotting.heat_map(table, ["violated", "margin"])
