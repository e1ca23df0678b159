"""Bounds on velocities: a law that knows them beside one that does not."""

import iblf_jax as ij
from iblf_jax import plotting

speeds = ij.Bounds(lower=ij.bounds.Constant(-0.8), upper=ij.bounds.Constant(0.6))
knows = ij.with_parts(ij.presets.zhang_yan_2024_full_state(), velocity_bounds=speeds)
ignores = ij.with_parts(knows, controller=ij.controllers.Backstepping(k1=2.0, K2=10.0, o=0.1))
runs = {
    name: ij.simulate(s, duration=3.0, dt=1e-3)
    for name, s in {"full state": knows, "positions only": ignores}.items()
}
figure = plotting.velocities(runs)

# %% The box that the velocities have to stay in.
portrait = plotting.velocity_portrait(runs, joint=1)
