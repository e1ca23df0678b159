"""Prescribed performance (Dimanidis 2018): a two-joint arm under a law without a model, compared
with points of the published curves. The law is the package's `SurfaceBarrier`: the printed
-2 k T(xi)/((1 - xi^2) rho) is -4 k times the slope of its barrier.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij
from iblf_jax.files.scenario import load_scenario_file

here = Path(__file__)
scenario, options = load_scenario_file(here.with_name("scenario.toml"))
run = ij.simulate(scenario, **options)
printed_gain = ij.with_parameters(scenario, {"controller.K": 4.0})
# The observer's peak takes 0.0068 rad/s from the velocity of joint 1, as stated below.
after_peak = ij.with_parameters(scenario, {"initial.dq[1]": scenario.initial.dq[1] - 0.0068})
runs = {
    "k = 6": run,
    "k = 1": ij.simulate(printed_gain, **options),
    "k = 6, after the peak": ij.simulate(after_peak, **options),
}
published = np.loadtxt(here.with_name("published.csv"), delimiter=",", skiprows=1)
figure, axes = plt.subplots(2, 2, figsize=(9, 4.6), sharex=True, layout="constrained")
sigma = np.asarray(run.dq - run.alpha)
rho = (30.0 - 0.035) * np.exp(-1.5 * run.t) + 0.035
for joint, (above, below) in enumerate(axes.T):
    points = published[published[:, 0] == joint]
    above.plot(run.t, run.e1[:, joint], label="here")
    above.plot(points[:, 1], points[:, 2], "o", markersize=4, fillstyle="none", label="published")
    above.set(title=f"joint {joint}", ylabel="error $e_1$ [rad]")
    below.plot(run.t, sigma[:, joint], label=r"$\sigma$")
    below.plot(run.t, np.stack([rho, -rho], axis=1), "k:", linewidth=0.8)
    below.set(xlabel="time $t$ [s]", ylabel=r"surface $\sigma$ [rad/s]", ylim=(-60, 60))
    below.set_yscale("symlog", linthresh=0.01)
axes[0, 0].legend()


# %% Comparison with the published points.
def distance(run, joint):
    """The largest distance of a run from the published points of a joint [rad]."""
    _, t, e1 = published[published[:, 0] == joint].T
    return float(np.abs(np.interp(t, run.t, run.e1[:, joint]) - e1).max())


for name, one in runs.items():
    print(f"{name}: {ij.Status(int(one.status))!r},", end=" ")
    print(f"differs by {distance(one, 0):.1e} and {distance(one, 1):.1e} rad")
late = float(np.abs(run.e1[run.t > 6.0]).max())
share = float(np.max(np.abs(sigma) / rho[:, None]))
print(f"after 6 s |e1| < {late:.1e} rad; largest |sigma|/rho: {share:.3f}")
print(f"largest torque: {np.max(np.abs(run.tau), axis=0).round(2)} N m")
reached = {
    "largest |e1| of joint 0 [rad]": float(np.abs(run.e1[:, 0]).max()),
    "largest |e1| of joint 1 [rad]": float(np.abs(run.e1[:, 1]).max()),
    "largest distance of joint 0 from the published points [rad]": distance(run, 0),
    "largest distance of joint 1 from the published points [rad]": distance(run, 1),
}
holds = {
    "the errors stay inside pi/180 rad after the transient": late < np.pi / 180,
    "the surface stays inside its funnel": share < 1.0,
}

# %% The remaining difference is due to the published high-gain observer: in the first 0.2 ms its
# estimate has a peak, and the velocity of joint 1 decreases from 1.0472 to 1.0395 rad/s in the
# published figure, 0.0068 rad/s more than in this run. With an initial velocity that is lower by
# this value, the difference is a tenth. The printed gain results in another motion, which also
# satisfies the prescribed bounds.
q, dq = np.asarray(run.q[0]), np.asarray(run.dq[0])
printed_sigma = dq[0] + 2 * (q[0] - np.pi / 2 - np.pi / 6)
evidence = {
    "best": max(distance(run, joint) for joint in (0, 1)),
    "gain": max(distance(runs["k = 1"], joint) for joint in (0, 1)),
    "torque": float(np.interp(0.066, run.t, run.tau[:, 0])),
    "sigma": float(sigma[0, 0]),
    "printed_sigma": float(printed_sigma),
    "late": late,
    "start": float(np.max(np.abs(sigma[0])) / 30.0),
}
print(evidence)
