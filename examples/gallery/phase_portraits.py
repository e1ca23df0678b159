"""Phase portraits: one arm from three initial states, in the plane of its positions."""

import iblf_jax as ij
from iblf_jax import plotting

scenario = ij.presets.zhang_yan_2024()
starts = {"high": [0.8, 0.8], "low": [0.45, 0.4], "crossed": [0.85, 0.35]}
runs = {
    name: ij.simulate(ij.with_parameters(scenario, {"initial.q": q}), duration=8.0, dt=1e-3)
    for name, q in starts.items()
}
figure = plotting.phase_portrait(runs)

# %% Position against velocity of the second joint.
velocities = plotting.velocity_portrait(runs, joint=1)
