"""A disturbance and its estimates (Zhang 2022): three joints under computed torque, disturbed for
one second. The law uses no estimate, because the publication does not feed the estimate back.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij
from iblf_jax.files.scenario import load_scenario_file

scenario, options = load_scenario_file(Path(__file__).with_name("scenario.toml"))
run = ij.simulate(scenario, **options)
observed = {
    "momentum": ij.with_parts(scenario, observer=ij.observers.Momentum(kf=100.0, start="matched")),
    "extended state": ij.with_parts(scenario, observer=ij.observers.ExtendedState(bandwidth=100.0)),
}
observers = {name: ij.simulate(part, **options) for name, part in observed.items()}
runs = {"published law": run, **observers}
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
for joint in range(3):
    left.plot(run.t, 1e3 * run.e1[:, joint], color=f"C{joint}", label=f"joint {joint}")
    left.plot(run.t, 1e3 * observers["momentum"].e1[:, joint], color=f"C{joint}", linestyle=":")
    right.plot(run.t, run.disturbance[:, joint], color="0.8", linewidth=4)
    for found, style in zip(observers.values(), (":", "--"), strict=True):
        right.plot(
            found.t, found.disturbance_estimate[:, joint], color=f"C{joint}", linestyle=style
        )
left.set(
    xlim=(5.8, 7.6),
    xlabel="time $t$ [s]",
    ylabel="error $e_1$ [mrad]",
    title="published law; dotted: with a momentum observer",
)
right.set(
    xlim=(5.9, 6.3),
    xlabel="time $t$ [s]",
    ylabel="disturbance and estimates [N m]",
    title="dotted: momentum, dashed: extended state",
)
left.legend()

# %% Under the published law the disturbance causes an error of M^-1 d/1500. With the feedback of an
# observer's estimate the error is transient.
pushed = (run.t > 6.5) & (run.t < 6.99)
for name, found in runs.items():
    sizes = ", ".join(f"{x:.1e}" for x in np.abs(found.e1[pushed]).max(axis=0))
    print(f"{name}: {ij.Status(int(found.status))!r}, |e1| up to {sizes} rad while it acts")
M = np.asarray(scenario.plant.mass_matrix(run.q[(run.t > 6.9)][0]))
ratio = np.abs(np.linalg.solve(M, [0.15, 0.18, 0.12]) / 1500)
print(f"M^-1 d/1500: {', '.join(f'{x:.1e}' for x in ratio)} rad")
settled = {}
for name, found in observers.items():
    off = np.abs(found.disturbance - found.disturbance_estimate)
    settled[name] = float(off[(found.t > 6.1) & (found.t < 6.99)].max())
    print(
        f"{name}: the error of the estimate is {off[found.t < 5.99].max():.1e} N m before,"
        f" {settled[name]:.1e} N m from 0.1 s after the start of the disturbance"
    )
print(f"torque from {run.tau.min(axis=0).round(2)} to {run.tau.max(axis=0).round(2)} N m")
holds = {
    "the torques stay inside -2 to 3 N m, the axis of the published figure": bool(
        np.all((run.tau > -2.0) & (run.tau < 3.0))
    ),
    "the estimates agree with the disturbance from 0.1 s after its start": max(settled.values())
    < 0.01 * 0.12,
}

# %% The number of M_22 that differs: q'^T (M'/2 - C) q' with it, which is zero for an arm.
q, dq = np.asarray(run.q), np.asarray(run.dq)
power = 0.5 * (0.05618 - 0.0519) * np.sin(q[:, 2]) * dq[:, 2] * dq[:, 1] ** 2
evidence = {"power": float(np.abs(power).max())}
print(evidence)
