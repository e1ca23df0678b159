"""A limited torque with an auxiliary state: a claim that covers the limited torque."""

import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

scenario = ij.with_parts(
    ij.presets.zhang_yan_2024(reading="corrected"),
    observer=ij.observers.Momentum(kf=20.0, start="matched"),
)
limit = [6.0, 1.2]
runs = {}
for name, k in {"limit alone": None, "k = 5 1/s": 5.0, "k = 500 1/s": 500.0}.items():
    law = ij.controllers.Saturated(scenario.controller, limit=limit, auxiliary=k)
    runs[name] = ij.simulate(ij.with_parts(scenario, controller=law), duration=3.0, dt=5e-4)

figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.4), layout="constrained")
for name, run in runs.items():
    (line,) = left.plot(run.t, run.e1[:, 1], label=name)
    if run.scenario.controller.auxiliary is not None:
        right.plot(run.t, run.auxiliary[:, 1], label=name, color=line.get_color())
left.set(xlabel="time [s]", ylabel="e1 of joint 2 [rad]", xlim=(0.0, 1.5))
right.set(xlabel="time [s]", ylabel="lambda of joint 2 [rad/s]", xlim=(0.0, 1.5))
left.legend()
right.legend()

# %% The limit alone tracks at least as well here: the observer receives the limited torque and does
# not wind up. What the auxiliary state gives is a Lyapunov rate, with the term w s . lambda, that
# holds while the torque is limited. A small k returns slowly, a large k stays at the limit longer.
for name, run in runs.items():
    print(
        f"{name}: rmse {np.round(np.asarray(run.metrics.rmse), 4)} rad, margin"
        f" {np.round(np.asarray(run.metrics.margin), 3)} rad, limited for"
        f" {np.round(100 * np.asarray(run.metrics.saturated_share), 1)} % of the time"
    )
certificate = ij.certify(runs["k = 5 1/s"].scenario, runs["k = 5 1/s"])
line = certificate["inequality, limited torque"]
print(f"{line.name}: {line.verdict}, {line.note}")
