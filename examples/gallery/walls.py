"""Regions for the tip: a law without constraints, and the same law in a safety filter."""

import iblf_jax as ij
from iblf_jax import plotting

regions = (
    ij.regions.HalfSpace(normal=[0.0, 1.0], offset=0.45),
    ij.regions.HalfSpace(normal=[-1.0, 0.0], offset=-0.5),
)
exact = ij.with_parts(
    ij.presets.zhang_yan_2024(law="computed_torque"), disturbance=ij.disturbances.Nothing()
)
bare = ij.with_parts(exact, regions=regions, initial=ij.Initial(q=[0.75, 0.75]))
filtered = ij.with_parts(bare, controller=ij.controllers.SafetyFilter(bare.controller))
runs = {
    name: ij.simulate(s, duration=4.0, dt=1e-3)
    for name, s in {"without filter": bare, "with filter": filtered}.items()
}
figure = plotting.workspace(runs)

# %% The distances from the boundaries of the regions.
margins = plotting.region_margins(runs)
