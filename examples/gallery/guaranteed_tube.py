"""A guaranteed tube: positions that no start of a level set and no mass of an interval leave."""

import numpy as np

import iblf_jax as ij

wave = {"amplitude": [0.14], "frequency": 1.0}
scenario = ij.Scenario(
    plant=ij.robots.PlanarChain(mass=[2.0], length=0.35, centre=0.175, inertia=0.06),
    reference=ij.references.Sinusoid(offset=[0.5], **wave),
    bounds=ij.Bounds(
        lower=ij.bounds.Sinusoid(offset=[0.2], phase=[np.pi / 2], **wave),
        upper=ij.bounds.Sinusoid(offset=[0.9], phase=[np.pi / 2], **wave),
    ),
    controller=ij.controllers.Backstepping(k1=2.0, K2=3.0, variant="corrected"),
    observer=ij.observers.Momentum(kf=100.0),
    initial=ij.Initial(q=[0.8], dq=[0.0]),
)

# %% The greatest level that is proved for every mass within 10 %, by bisection.
proof = ij.largest_level(
    scenario,
    parameters={"plant.mass": ij.factor(ij.interval(0.9, 1.1))},
    between=(0.25, 4.0),
    accuracy=0.2,
    max_boxes=300_000,
    progress=False,
)
figure = proof.plot()

# %% The statement is about all times, all starts of the set and all masses; the runs are examples.
print(proof)
