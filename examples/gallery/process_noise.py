"""Process noise: white noise on the acceleration drives an arm towards its bounds. At equal effort
a law with a barrier keeps them, where a PD law does not.
"""

import numpy as np

import iblf_jax as ij
from iblf_jax import plotting

paper = ij.presets.zhang_yan_2024()


def study_of(controller):
    """300 runs of the paper's arm with noise on both accelerations."""
    scenario = ij.with_parts(
        paper,
        controller=controller,
        observer=ij.observers.NoObserver(),
        process_noise=ij.process_noise.Additive(5.0),
    )
    return ij.monte_carlo(
        scenario,
        {},
        runs=300,
        duration=4.0,
        dt=1e-3,
        method="stochastic_heun",
        metrics=(ij.metrics.Margin(), ij.metrics.AboveGravity()),
        progress=False,
    )


def effort_of(study):
    """Median over the runs [N m]."""
    return float(np.median(study.metrics["effort_above_gravity"]))


# %% The law with the barrier has a lower gain K2 than that of the paper.
barrier = study_of(ij.controllers.Backstepping(k1=2.0, K2=3.0, o=0.1))

# %% The stiffness of the PD law is chosen so that the median effort is the same.
low, high = 15.0, 40.0
for _ in range(6):
    stiffness = 0.5 * (low + high)
    pd = study_of(ij.controllers.PDGravity(Kp=stiffness, Kd=0.25 * stiffness))
    if effort_of(pd) < effort_of(barrier):
        low = stiffness
    else:
        high = stiffness

# %% The share of runs that have left their bounds, with the interval of 95 % at each time
found = {"integral barrier": barrier, "PD and gravity": pd}
exits = {name: study.first_exit() for name, study in found.items()}
for name, study in found.items():
    print(f"{name}: median effort {effort_of(study):.3g} N m, {exits[name]}")
figure = plotting.first_exit(exits)

# %% The barrier is the better choice for a given effort. A PD law of twice the stiffness keeps the
# bounds as well, with more effort and no stiff barrier, so that it needs a less small time step.
stiff = study_of(ij.controllers.PDGravity(Kp=2 * stiffness, Kd=0.5 * stiffness))
print(f"twice the stiffness: median effort {effort_of(stiff):.3g} N m, {stiff.first_exit()}")

# %% One run under each law: the same path of the noise
runs = {name: study.replay(0) for name, study in found.items()}
positions = plotting.positions(runs)
