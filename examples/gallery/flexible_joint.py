"""A flexible arm: a rigid design and a law that knows the springs."""

import warnings

import iblf_jax as ij
from iblf_jax import plotting

plant = ij.plants.FlexibleJoint(
    ij.presets.customary_two_link(), stiffness=180.0, motor_inertia=0.02, motor_damping=1.0
)
paper = ij.with_parts(
    ij.presets.zhang_yan_2024(),
    disturbance=ij.disturbances.Nothing(),
    observer=ij.observers.NoObserver(),
)
rigid = ij.with_parts(
    paper,
    plant=plant,
    model=plant.rigid(),
    controller=ij.controllers.Backstepping(k1=2.0, K2=0.9, variant="corrected"),
)
order_4 = ij.with_parts(
    paper, robot=plant, controller=ij.controllers.BarrierBackstepping(k=(3.0, 20.0, 60.0, 150.0))
)
with warnings.catch_warnings():  # the rigid design is inaccurate near its limit
    warnings.simplefilter("ignore")
    runs = {
        "rigid design": ij.simulate(rigid, duration=6.0, dt=2e-4, record_every=10),
        "law of order 4": ij.simulate(order_4, duration=6.0, dt=4e-4, record_every=5),
    }
figure = plotting.positions(runs)

# %% The levels of the flexible arm under the law of order 4: links, motors, and their bounds.
levels = plotting.levels(runs["law of order 4"])
