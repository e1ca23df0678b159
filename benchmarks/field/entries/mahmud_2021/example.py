"""Bounds on positions and velocities (Mahmud et al. 2021): the benchmark arm with friction, from a
corner of its bounds, under another law.
"""

from pathlib import Path

import numpy as np

import iblf_jax as ij
from iblf_jax import plotting
from iblf_jax.files.scenario import load_scenario_file

scenario, options = load_scenario_file(Path(__file__).with_name("scenario.toml"))
run = ij.simulate(scenario, **options)
runs = {"BarrierBackstepping with a momentum observer": run}
figure = plotting.velocity_portrait(run, joint=0)

# %% The complete run.
overview = run.plot()

# %% The numbers of the run.
M = np.asarray(scenario.plant.mass_matrix(np.zeros(2)))
print(
    f"M(0) = {M.round(3).tolist()} kg m^2, p1 + 2 p3 = {3.473 + 2 * 0.242:.3f}, p2 + p3 ="
    f" {0.196 + 0.242:.3f}"
)
print(f"status: {ij.Status(int(run.status))!r}")
print(
    f"least distance from the bounds: {np.asarray(run.metrics.margin).round(3)} rad,"
    f" {np.asarray(run.metrics.velocity_margin).round(3)} rad/s"
)
last = np.abs(run.q) > 0.05
margins = (run.metrics.margin, run.metrics.velocity_margin)
holds = {
    "all states stay inside their bounds": all(bool(np.all(m > 0)) for m in margins),
    "the states converge to the origin": bool(np.all(np.abs(run.q[run.t > 6.0]) < 0.05)),
}
print(f"|q| < 0.05 rad from {float(run.t[np.max(np.flatnonzero(last.any(axis=1)))]):.1f} s on")
print(
    f"friction at the start {np.asarray(run.disturbance[0]).round(2)} N m, largest torque"
    f" {np.abs(run.tau).max(axis=0).round(1)} N m"
)

# %% The transformed states of the publication.
low, high = np.array([-7.0, -5.0]), np.array([5.0, 7.0])
states = np.stack([np.asarray(run.q), np.asarray(run.dq)], axis=-1)
transformed = np.log(high * (low - states) / (low * (high - states)))
print(
    f"at the start b(q) = {transformed[0, 0, 0]:.3f}, b(q') = {transformed[0, 0, 1]:.3f}; largest"
    f" |b| {np.abs(transformed).max():.3f}"
)
