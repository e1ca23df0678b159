"""Process noise: how soon does white noise on the acceleration drive an arm out of its bounds? Two
laws are compared at equal effort.
"""

import numpy as np

import iblf_jax as ij
from iblf_jax import plotting

DURATION, DT = 4.0, 2e-3
NOISE = ij.process_noise.Additive(3.0)


def study_of(controller):
    """400 runs of the paper's arm with noise on both accelerations."""
    scenario = ij.with_parts(
        ij.presets.zhang_yan_2024(),
        controller=controller,
        observer=ij.observers.NoObserver(),
        process_noise=NOISE,
    )
    return ij.monte_carlo(
        scenario,
        {},
        runs=400,
        duration=DURATION,
        dt=DT,
        method="stochastic_heun",
        metrics=(ij.metrics.Margin(), ij.metrics.AboveGravity()),
        progress=False,
    )


# %% The barrier law has the gains of the paper.
barrier = ij.controllers.Backstepping(k1=2.0, K2=20.0, o=0.1)
found = {"integral barrier": study_of(barrier)}
effort = float(np.median(found["integral barrier"].metrics["effort_above_gravity"]))

# %% The stiffness of the PD law is chosen so that both have the same median effort.
low, high = 5.0, 400.0
for _ in range(8):
    stiffness = float(np.sqrt(low * high))
    study = study_of(ij.controllers.PDGravity(Kp=stiffness, Kd=0.25 * stiffness))
    if float(np.median(study.metrics["effort_above_gravity"])) < effort:
        low = stiffness
    else:
        high = stiffness
found["PD and gravity"] = study

# %% The curves show the share of runs that have left their bounds, with 95 % intervals.
exits = {name: each.first_exit() for name, each in found.items()}
for name, each in found.items():
    used = float(np.median(each.metrics["effort_above_gravity"]))
    print(f"{name}: median effort {used:.3g} N m, {exits[name]}")
figure = plotting.first_exit(exits)

# %% The state under one path of the noise, for the law with the barrier
run = found["integral barrier"].replay(0)
tube = plotting.positions(run)
