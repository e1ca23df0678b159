"""Torque limits: the same law with sufficient and with insufficient torque."""

import iblf_jax as ij
from iblf_jax import plotting

scenario = ij.presets.zhang_yan_2024()
limits = {"no limit": None, "9 and 4 N m": [9.0, 4.0], "4 and 1 N m": [4.0, 1.0]}
runs = {}
for name, limit in limits.items():
    law = (
        scenario.controller
        if limit is None
        else ij.controllers.Saturated(scenario.controller, limit=limit)
    )
    runs[name] = ij.simulate(ij.with_parts(scenario, controller=law), duration=3.0, dt=1e-3)
figure = plotting.torques(runs)

# %% A flag reports an active limit. A limit below the weight of the arm violates the bounds.
positions = plotting.positions(runs)
for name, run in runs.items():
    print(f"{name}: {ij.Status(int(run.status))!r}")
