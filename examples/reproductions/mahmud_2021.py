"""Bounds on positions and velocities (Mahmud et al. 2021): the benchmark arm with friction, from a
corner of its bounds, under another law.

S. M. N. Mahmud, S. A. Nivison, Z. I. Bell, R. Kamalapurkar, Safe model-based reinforcement learning
for systems with parametric uncertainties, Frontiers in Robotics and AI 8 (2021) 733104, section
7.2. The authors' program is public (github.com/scc-lab/publications-code, 2021-Frontiers-BT-MBRL).

| printed | value | where |
| --- | --- | --- |
| inertia | p1 = 3.473, p2 = 0.196, p3 = 0.242 kg m^2; M_11 = p1 + 2 p3 cos q2 | main.m |
| friction | 5.3, 1.1 N m s/rad and 8.45, 2.35 tanh(q') N m | theta in main.m; unknown to the law |
| bounds | -7 < q < 5 rad, -5 < q' < 7 rad/s, both joints | a1 ... A4 in main.m |
| start | q = (-5, -5) rad, q' = (5, 5) rad/s | x0 in main.m |
| task | stabilise the origin | the same |

**Published result**, according to its plotting script: the states and their bounds over time, the
transformed states compared with an optimal control (GPOPS II), the weights of the law, and its
estimates of the friction. The source of this example is the program, not the article.

**Not printed:** masses and lengths, which p1 ... p3 replace; the scenario has values that result in
these numbers. There is no gravity.

**The package does not contain the published law:** it transforms each state by
b(x) = ln[A (a - x)/(a (A - x))], which is infinite at the bounds, and learns an optimal law in the
transformed coordinates. This example has the published arm, bounds and initial state with the law
`FullState` of the package and a momentum observer in place of the estimate of the friction. The
gains are choices of this example.
"""

from pathlib import Path

import numpy as np

import iblf_jax as ij
from iblf_jax import plotting
from iblf_jax.files.scenario import load_scenario_file

scenario, options = load_scenario_file(Path(__file__).with_suffix(".toml"))
run = ij.simulate(scenario, **options)
figure = plotting.velocity_portrait(run, joint=0)

# %% The complete run.
overview = run.plot()

# %% The states must stay inside their bounds and converge to the origin. The results of this run:
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

# %% **Not reproduced:** the law, its weights, its estimates of the friction, and the optimal
# control (GPOPS II). The published curves are not available as numbers.
