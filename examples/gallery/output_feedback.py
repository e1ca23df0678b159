"""Output feedback: the velocity from an observer, its bandwidth against noise and peaking.

A law whose sensors measure positions only needs an estimate of the velocity. A larger bandwidth of
the observer reduces the tracking error, because the observer also estimates the disturbance, and
turns more of the noise of the position sensor into torque.
"""

import numpy as np
from matplotlib.figure import Figure

import iblf_jax as ij

push = ij.disturbances.Sinusoids(amplitude=[0.5, 0.2], frequency=2.0)
base = ij.with_parts(
    ij.with_parameters(ij.presets.zhang_yan_2024(variant="corrected"), {"controller.K2": 4.0}),
    sampling=ij.Sampling(period=1e-3),
    disturbance=push,
)
tube = base.context.tube(np.zeros(()))
base = ij.with_parts(base, initial=ij.Initial(q=tube.q_d, dq=tube.dq_d))
START = np.array([[0.0, 0.0], [1.0, -1.0]])  # the observer's error at the start [rad], [rad/s]
BANDWIDTHS = np.geomspace(20.0, 400.0, 9)
NOISE = {"no noise": 0.0, "noise 1e-5 rad": 1e-5, "noise 1e-4 rad": 1e-4}


def observed(noise, bandwidth, **fields):
    """The loop that measures positions with this noise."""
    return ij.with_parts(
        base,
        sensor=ij.sensors.Levels((ij.sensors.Direct(noise=noise), None)),
        observer=ij.observers.StateObserver(bandwidth=bandwidth, **fields),
    )


figure = Figure(figsize=(9.0, 3.4), layout="constrained")
accuracy, chatter = figure.subplots(1, 2)
for name, noise in NOISE.items():
    scenario = observed(noise, 100.0)
    found = ij.sweep(
        scenario, {"observer.bandwidth": BANDWIDTHS}, duration=4.0, dt=1e-3, progress=False
    )
    accuracy.loglog(BANDWIDTHS, found["rmse"].max("joint").squeeze(), "o-", label=name)
    chatter.loglog(BANDWIDTHS, found["torque_variation"].max("joint").squeeze(), "o-", label=name)
measured = ij.simulate(
    ij.with_parts(base, observer=ij.observers.Momentum(kf=20.0)), duration=4.0, dt=1e-3
)
for axes, metric, words in (
    (accuracy, "rmse", "rmse of the worse joint [rad]"),
    (chatter, "torque_variation", "sum of torque changes [N m]"),
):
    level = float(np.max(measured.metrics[metric]))
    axes.axhline(level, color="0.4", linestyle="--", label="velocity measured, Momentum(kf=20)")
    axes.set_xticks([20, 50, 100, 200, 400], labels=["20", "50", "100", "200", "400"])
    axes.minorticks_off()
    axes.set_xlabel("bandwidth of the observer [1/s]")
    axes.set_ylabel(words)
accuracy.legend()

# %% Peaking: the error of the estimated velocity at the start becomes a peak of the estimated
# uncertain term, which grows with the bandwidth. A limit on the estimate that the law receives cuts
# the peak off and halves the peak torque.
unlimited = ij.simulate(observed(0.0, 200.0, offset=START), duration=1.0, dt=1e-3)
limited = ij.simulate(
    observed(0.0, 200.0, offset=START, disturbance_limit=15.0), duration=1.0, dt=1e-3
)
peaking = Figure(figsize=(9.0, 3.4), layout="constrained")
torque, estimate = peaking.subplots(1, 2)
for name, run in {"unlimited": unlimited, "limited to 15 rad/s²": limited}.items():
    start = run.t < 0.15
    torque.plot(run.t[start], run.tau[start, 0], label=name)
    estimate.plot(run.t[start], run.disturbance_estimate[start, 0], label=name)
torque.set_ylabel("torque of joint 1 [N m]")
estimate.set_ylabel("estimate of f that the law receives [N m]")
for axes, signal in ((torque, "tau"), (estimate, "disturbance_estimate")):
    late = [getattr(run, signal)[run.t >= 0.15, 0] for run in (unlimited, limited)]
    axes.set_title(f"first 0.15 s: the peak, then {np.min(late):.2g} to {np.max(late):.2g} N m")
    axes.set_xlabel("time [s]")
torque.legend()
for name, run in {"unlimited": unlimited, "limited": limited}.items():
    peaks = [column[np.argmax(np.abs(column))] for column in np.asarray(run.tau).T]
    print(f"{name}: peak torque {peaks[0]:.2f} N m of joint 1, {peaks[1]:.2f} N m of joint 2")
print("time of the limit [s]:", limited.metrics.limited_time)
