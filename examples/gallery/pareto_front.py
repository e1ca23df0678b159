"""A Pareto front: the trade-off between tracking error and torque."""

import iblf_jax as ij
from iblf_jax import plotting

scenario = ij.presets.zhang_yan_2024()
both = (ij.objectives.tracking(), ij.objectives.effort())
front = ij.pareto(
    scenario, ["controller.K2"], both, duration=1.0, dt=2e-3, points=6, progress=False
)
figure = plotting.pareto(front)
