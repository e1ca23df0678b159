"""Time-varying asymmetric bounds (Zhang and Yan 2024): the paper's law with an integral barrier and
a disturbance observer, and its comparison with a logarithmic barrier.
"""

import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

scenario = ij.presets.zhang_yan_2024()
compared = ij.compare(scenario, ["integral", "log"], duration=20.0, dt=1e-3)
integral, log = (compared.rollouts[name] for name in ("integral", "log"))
runs = {"integral barrier": integral, "logarithmic barrier": log}
figure, axes = plt.subplots(2, 2, figsize=(9, 4.6), layout="constrained")
for joint, (above, below) in enumerate(axes.T):
    for name, run in runs.items():
        above.plot(run.t, run.e1[:, joint], label=name)
        below.plot(run.t, run.e2[:, joint])
    for side in (integral.upper, integral.lower):
        above.plot(run.t, (side - integral.q_d)[:, joint], "k:", linewidth=0.8)
    above.set(title=f"joint {joint}", ylabel="error $e_1$ [rad]", xlim=(0.0, 5.0))
    below.set(xlabel="time $t$ [s]", ylabel="error $e_2$ [rad/s]", xlim=(0.0, 2.0))
    above.set(xlabel="time $t$ [s]")
axes[0, 0].legend()

# %% The statements of the paper. "Late" is the second half of a run, the start its first second.
late = integral.t >= 10.0


def overshoot(run):
    """How far e2 goes beyond zero in the first second, joint by joint [rad/s]."""
    e2 = np.asarray(run.e2[run.t <= 1.0])
    return np.maximum(0.0, (-np.sign(e2[0]) * e2).max(axis=0))


def is_small(values):
    """Whether the late values are below 1 % of the peak, for all joints."""
    sizes = np.abs(values)
    return bool(np.all(sizes[late].max(axis=0) < 0.01 * sizes.max(axis=0)))


times = [np.asarray(run.metrics.settling_time) for run in (integral, log)]
errors = [np.asarray(run.metrics.rmse) for run in (integral, log)]
holds = {
    "neither law violates the time-varying bounds": all(
        bool(np.all(run.metrics.margin > 0)) for run in runs.values()
    ),
    "the integral law converges faster than the logarithmic one": bool(np.all(times[0] < times[1])),
    "the integral law is slightly more accurate": bool(np.all(errors[0] < errors[1])),
    "the integral law overshoots more in e2 at the start": bool(
        np.all(overshoot(integral) > overshoot(log))
    ),
    "e1 and e2 tend to a very small neighbourhood of zero": all(
        is_small(values) for run in runs.values() for values in (run.e1, run.e2)
    ),
}
print(compared)

# %% The gap of the printed proof: gains and a start that meet its conditions, without disturbance.
gaps = {
    reading: ij.simulate(ij.presets.printed_gap(reading=reading), duration=0.1, dt=1e-5)
    for reading in ("printed", "corrected")
}
V2 = {reading: np.asarray(run.V) for reading, run in gaps.items()}
for reading, values in V2.items():
    print(f"{reading}: V2 starts at {values[0]:.4f}, largest {values.max():.4f}")

# %% The estimate of a disturbance of zero, on a faster motion.
motion = {
    "reference.frequency": 3.0,
    "disturbance.acceleration_amplitude": 0.0,
    "disturbance.velocity_amplitude": 0.0,
}
estimates = {}
for name, observer in {
    "printed": ij.observers.Printed(kf=20.0),
    "with M0' q'": ij.observers.Momentum(kf=20.0),
}.items():
    faster = ij.with_parameters(ij.with_parts(scenario, observer=observer), motion)
    run = ij.simulate(faster, duration=20.0, dt=1e-3)
    estimates[name] = float(np.abs(run.disturbance_estimate[late]).max())
print(estimates)


# %% The two barriers along the run of the integral law.
def value_of(barrier):
    """V1 of a barrier along the run."""
    tubes = [(scenario.context.tube(t), q) for t, q in zip(integral.t, integral.q, strict=True)]
    return np.array([barrier.value(tube, q) for tube, q in tubes[::200]])


identity = np.abs(value_of(ij.barriers.Integral()) - 2 * value_of(ij.barriers.Log())).max()
ratios = [
    float(np.linalg.norm(pair["log"].metrics.rmse) / np.linalg.norm(pair["integral"].metrics.rmse))
    for pair in (compared.rollouts, compared.equal_effort)
]
evidence = {
    "start": float(V2["printed"][0]),
    "printed": float(V2["printed"].max()),
    "corrected": float(V2["corrected"].max()),
    "without_term": estimates["printed"],
    "with_term": estimates["with M0' q'"],
    "identity": float(identity),
    "equal_gains": ratios[0],
    "equal_effort": ratios[1],
}
print(evidence)
