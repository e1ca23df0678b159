"""Bounds on velocities: a law that satisfies them and a law that does not use them."""

import iblf_jax as ij
from iblf_jax import plotting

speeds = ij.Bounds(lower=ij.bounds.Constant(-0.8), upper=ij.bounds.Constant(0.6))
preset = ij.presets.zhang_yan_2024_full_state()
bounded = ij.with_parts(preset, bounds=(preset.bounds[0], speeds))
unbounded = ij.with_parts(bounded, controller=ij.controllers.Backstepping(k1=2.0, K2=10.0, o=0.1))
runs = {
    name: ij.simulate(s, duration=3.0, dt=1e-3)
    for name, s in {"full state": bounded, "positions only": unbounded}.items()
}
figure = plotting.velocities(runs)

# %% Position and velocity with their bounds.
portrait = plotting.velocity_portrait(runs, joint=1)
