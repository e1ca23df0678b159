"""Four arms and a leader: consensus errors in tubes, and when a shared reference is better."""

import numpy as np

import iblf_jax as ij
from iblf_jax import bounds, plotting

arm = ij.presets.customary_two_link()
robots = [ij.with_parameters(arm, {"mass": arm.mass * factor}) for factor in (1.0, 1.2, 0.8, 1.1)]
stack = ij.plants.Agents(
    agents=robots,
    # Only agent 1 sees the leader; agents 2, 3 and 4 see the agent before them.
    adjacency=((0, 0, 0, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0)),
    leader=(1, 0, 0, 0),
)
leader = ij.references.Sinusoid(offset=[0.5, 0.6], amplitude=[0.3, 0.2], frequency=1.0)
start = np.array([[0.65, 0.5], [0.5, 0.65], [0.6, 0.55], [0.45, 0.7]])
tube = ij.Bounds(
    lower=bounds.Funnel(initial=-0.4, final=-0.05, rate=1.0),
    upper=bounds.Funnel(initial=0.4, final=0.05, rate=1.0),
)
graph = ij.Scenario(
    plant=stack,
    reference=stack.reference(leader),
    bounds=tube,
    controller=ij.controllers.BarrierBackstepping(k=(2.0, 20.0)),
    initial=ij.Initial(q=stack.relative_positions(start), dq=0.0),
)
run = ij.simulate(graph, duration=8.0, dt=1e-3, record_every=5)
figure = plotting.positions(run)
