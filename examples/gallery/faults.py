"""Actuator faults: what each law keeps under a loss of effectiveness, a dead zone and a delay."""

import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

paper = ij.presets.zhang_yan_2024(variant="corrected")
pd = ij.with_parts(
    paper,
    controller=ij.controllers.PDGravity(Kp=60.0, Kd=20.0),
    observer=ij.observers.NoObserver(),
)
laws = {"barrier and observer": paper, "PD with gravity": pd}
actuators = {
    "ideal": ij.actuators.Ideal(),
    "half of the torque from 1 s on": ij.actuators.Fault(effectiveness=0.5, time=1.0),
    "dead zone of 1 N m": ij.actuators.DeadZone(lower=-1.0, upper=1.0),
    "levels of 0.5 N m": ij.actuators.Quantiser(step=0.5),
    "delay of 1 ms": ij.actuators.Delay(delay=1e-3),
    "delay of 2 ms": ij.actuators.Delay(delay=2e-3),
}
runs = {
    (law, name): ij.simulate(ij.with_parts(scenario, actuator=actuator), duration=3.0, dt=5e-4)
    for law, scenario in laws.items()
    for name, actuator in actuators.items()
}
figure, axes = plt.subplots(1, 2, figsize=(11, 4), sharey=True, layout="constrained")
for axis, law in zip(axes, laws, strict=True):
    for i, name in enumerate(actuators):
        run = runs[law, name]
        axis.plot(run.t, run.xi[:, 0], label=name, zorder=len(actuators) - i)
    for bound in (-1.0, 1.0):
        axis.axhline(bound, color="black", linestyle="--", linewidth=0.8)
    axis.set(title=law, xlabel="time [s]", ylim=(-1.2, 1.2))
axes[0].set_ylabel("normalised error of joint 1, bounds at -1 and 1")
axes[1].legend(fontsize="small")

# %% The smallest distance to a bound, and the error after the fault. The observer replaces the lost
# torque and what the dead zone holds back; a PD law has no term that does. No law here is made for
# a delay: at 2 ms both loops are unstable, as their gains act on a small inertia.
print(f"{'actuator':32s} {'law':22s} {'margin [rad]':>13s} {'rms error after 2 s [rad]':>26s}")
for (law, name), run in runs.items():
    late = np.asarray(run.e1)[np.asarray(run.t) > 2.0]
    margin = float(np.min(run.metrics["margin"]))
    print(f"{name:32s} {law:22s} {margin:13.4f} {np.sqrt(np.mean(late**2)):26.2e}")

# %% `falsify` searches between an effectiveness and 1 for one at which a law leaves its bounds, and
# bisection finds the smallest one from which on the search finds none: it lies between the last two
# columns.
print(f"{'law':22s} {'leaves above':>12s} {'keeps from':>11s}")
for law, scenario in laws.items():
    faulty = ij.with_parts(scenario, actuator=ij.actuators.Fault(effectiveness=1.0, time=1.0))
    low, high = 0.0, 1.0
    for _ in range(4):
        middle = 0.5 * (low + high)
        attack = ij.falsify(
            faulty,
            {"actuator.effectiveness": ij.value(ij.uniform(middle, 1.0))},
            duration=2.0,
            dt=1e-3,
            starts=4,
            iterations=3,
            progress=False,
        )
        if attack.margin < 0:
            low = middle
        else:
            high = middle
    print(f"{law:22s} {low:12.3f} {high:11.3f}")
