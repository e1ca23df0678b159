"""Terminal sliding mode: settling in finite time, against backstepping at equal effort.

The terminal sliding mode settles faster into its band. It does not keep bounds: where the errors
must stay between bounds, take a law with a barrier.
"""

import numpy as np
from matplotlib.figure import Figure

import iblf_jax as ij

scenario = ij.with_parts(
    ij.presets.zhang_yan_2024(variant="corrected"),
    disturbance=ij.disturbances.Sinusoids(amplitude=[0.5, 0.2], frequency=2.0),
)
laws = {
    "terminal sliding mode": ij.controllers.TerminalSlidingMode(beta=2.0, K=20.0, layer=0.02),
    "backstepping, integral barrier": scenario.controller,
    "computed torque": ij.controllers.ComputedTorque(Kp=25.0, Kd=10.0),
}
found = ij.compare(scenario, laws, duration=4.0, dt=5e-4)
figure = Figure(figsize=(9.0, 3.4), layout="constrained")
error, torque = figure.subplots(1, 2)
for name, run in found.equal_effort.items():
    error.semilogy(run.t, np.max(np.abs(run.e1), axis=1), label=name)
    torque.plot(run.t[run.t < 0.5], run.tau[run.t < 0.5, 0], label=name)
error.set_ylabel("largest position error [rad]")
torque.set_ylabel("torque of joint 1 [N m]")
for axes in (error, torque):
    axes.set_xlabel("time [s]")
error.legend()
late = [run.tau[run.t >= 0.5, 0] for run in found.equal_effort.values()]
low, high = np.min(late), np.max(late)
torque.set_title(f"first 0.5 s: the transient, then {low:.3g} to {high:.3g} N m")
print(found)

# %% The same laws from a start near the upper bound of joint 1, with a velocity towards it.
# The terminal sliding mode violates the bound, which it does not know.
tube = scenario.context.tube(np.zeros(()))
q = np.array(scenario.initial.q)
q[0] = tube.upper[0] - 0.02
start = ij.Initial(q=q, dq=[2.5, 0.0])
runs = {
    name: ij.simulate(ij.with_parts(run.scenario, initial=start), duration=1.0, dt=2e-4)
    for name, run in found.equal_effort.items()
}
bounds = ij.plotting.joint(runs, 0)
for name, run in runs.items():
    print(f"{name}: smallest distance to the bound {run.metrics.margin[0]:.4f} rad")
