"""Adaptation to a payload: an unknown load of 0.5 kg at the tip, with adaptive parameters, with a
momentum observer, and with approximators that use no model.
"""

import dataclasses

import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij
from iblf_jax import controllers, observers, plotting

scenario = ij.presets.zhang_yan_2024(variant="corrected")
law = scenario.controller
adaptive = controllers.AdaptiveParameters(
    law=law, parameters=("payload",), Gamma=2.0, lower=-0.1, upper=2.0
)
nothing = observers.NoObserver()
laws = {
    "model as it is": (law, nothing),
    "adaptive payload": (adaptive, nothing),
    "momentum observer": (law, observers.Momentum(kf=20.0)),
    "Gaussians": (controllers.AdaptiveRBF(k1=law.k1, K2=law.K2), nothing),
    "fuzzy system": (
        controllers.AdaptiveRBF(
            k1=law.k1, K2=law.K2, normalised=True, Gamma=2000.0, sigma=1e-4, width=1.0
        ),
        nothing,
    ),
    "hidden layer": (controllers.AdaptiveNetwork(k1=law.k1, K2=law.K2), nothing),
}
cases = {
    "load": {"disturbance.acceleration_amplitude": 0.0, "disturbance.velocity_amplitude": 0.0},
    "load and disturbance": {"disturbance.acceleration_amplitude": 5.0},
    "load, fast reference": {
        "disturbance.acceleration_amplitude": 0.0,
        "disturbance.velocity_amplitude": 0.0,
        "reference.frequency": 3.0,
    },
}
loaded = dataclasses.replace(
    scenario, plant=dataclasses.replace(scenario.plant, payload=0.5), model=scenario.model
)


def simulated(name, changes):
    """The run of a law in a case."""
    controller, observer = laws[name]
    changed = ij.with_parameters(loaded, changes)
    part = ij.with_parts(changed, controller=controller, observer=observer)
    return ij.simulate(part, duration=12.0, dt=1e-3, record_every=10)


runs = {case: {name: simulated(name, changes) for name in laws} for case, changes in cases.items()}

# %% The error of the position, and the estimate of the payload. Adaptation removes the error that
# the load causes. With a disturbance that no parameter explains, the estimate follows it, and the
# observer leaves the smallest error.
figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
for axis, case in zip(axes[:2], ("load", "load and disturbance"), strict=True):
    for name, run in runs[case].items():
        axis.semilogy(run.t, np.linalg.norm(run.e1, axis=1), label=name, linewidth=1.0)
    axis.set(title=case, xlabel="t [s]", ylabel="|e1| [rad]", ylim=(1e-7, 1.0))
axes[1].legend(fontsize=7, loc="lower left")
for case in cases:
    run = runs[case]["adaptive payload"]
    axes[2].plot(run.t, run.controller_state.theta[:, 0], label=case, linewidth=1.0)
axes[2].axhline(0.5, color="black", linewidth=0.6, linestyle="--")
axes[2].set(title="estimate of the payload", xlabel="t [s]", ylabel="theta_hat [kg]")
axes[2].legend(fontsize=7)

# %% The estimate of the load alone, between its bounds: it tends to the value of the plant.
estimates = plotting.adaptation(runs["load"]["adaptive payload"])

# %% The root mean square of |e1| in the last six seconds [rad]. Adaptation is the best choice where
# the error is one of parameters, also for a fast reference; the observer is where it is not. The
# approximators need no model. The leak that bounds their weights leaves an error.
print(f"{'':20s}" + "".join(f"{case:>24s}" for case in cases))
for name in laws:
    late = [runs[case][name].e1[-600:] for case in cases]
    errors = [np.sqrt(np.mean(np.sum(e1**2, axis=1))) for e1 in late]
    print(f"{name:20s}" + "".join(f"{error:24.2e}" for error in errors))
