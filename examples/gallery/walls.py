"""Walls for the tip: a law that does not know them, and the same law behind a safety filter."""

import iblf_jax as ij
from iblf_jax import plotting

walls = (
    ij.regions.HalfSpace(normal=[0.0, 1.0], offset=0.45),
    ij.regions.HalfSpace(normal=[-1.0, 0.0], offset=-0.5),
)
known = ij.with_parts(
    ij.presets.zhang_yan_2024(law="computed_torque"), disturbance=ij.disturbances.Nothing()
)
bare = ij.with_parts(known, regions=walls, initial=ij.Initial(q=[0.75, 0.75]))
filtered = ij.with_parts(bare, controller=ij.controllers.SafetyFilter(bare.controller))
runs = {
    name: ij.simulate(s, duration=4.0, dt=1e-3)
    for name, s in {"bare": bare, "filtered": filtered}.items()
}
figure = plotting.workspace(runs)

# %% What is left to the walls.
margins = plotting.region_margins(runs)
