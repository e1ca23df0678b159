"""A payload is picked up: after two seconds the UR5 carries 4 kg that its model does not
contain.
"""

import iblf_jax as ij
from iblf_jax import plotting

scenario = ij.presets.ur5(payload=0.0)
load = ij.robots.Payload(mass=4.0, centre=[0.0, 0.0, 0.1], start=2.0)
arm = scenario.plant
gripped = ij.with_parts(scenario, plant=type(arm)(**{**vars(arm), "carried": load}), model=arm)
run = ij.simulate(gripped, duration=4.0, dt=2e-3, record_every=5)
figure = plotting.joint(run, 1)

# %% The observer estimates the weight.
estimates = plotting.uncertain_terms(run)
