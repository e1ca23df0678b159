"""A barrier on a surface, and a load (after Cruz-Ancona et al. 2022): the common arm of two joints,
with a load of 2 kg that the model does not contain.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij
from iblf_jax.files.scenario import load_scenario_file

scenario, options = load_scenario_file(Path(__file__).with_name("scenario.toml"))
EPSILON, VARRHO = 0.05, 0.503
p12 = np.sqrt(2 * VARRHO)
p22 = np.sqrt(VARRHO * (2 + 2 * p12))


def under(eta):
    """The run with another amplitude of the disturbance."""
    return ij.simulate(ij.with_parameters(scenario, {"disturbance.amplitude": eta}), **options)


def surface(run):
    """|w| over the time."""
    return p22 * np.linalg.norm(run.dq - run.alpha, axis=1)


runs = {f"eta = {eta:g} sin 4t N m": under(eta) for eta in (2.0, 5.0, 0.5)}
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
for name, run in runs.items():
    axes[0].semilogy(run.t, surface(run), label=name)
first = next(iter(runs.values()))
axes[1].plot(first.t, first.e1, label=["joint 0", "joint 1"])
axes[0].axhline(EPSILON, color="k", linestyle=":", linewidth=0.8)
axes[0].set(xlabel="time $t$ [s]", ylabel="$|w|$ [1]", title=r"the surface, and $\epsilon$")
axes[1].set(xlabel="time $t$ [s]", ylabel="error $e_1$ [rad]", title=r"$\eta$ = 2 sin 4t")
for panel in axes:
    panel.legend(fontsize="small")

# %% The three phases.
below = []
for name, run in runs.items():
    w = surface(run)
    inside = run.t[np.max(np.flatnonzero(w >= EPSILON))]
    below.append(bool(np.all(w[run.t > 8.0] < EPSILON)))
    print(
        f"{name}: {ij.Status(int(run.status))!r}, |w| < 0.05 from {float(inside):.1f} s on,"
        f" {w[run.t > 10].max():.4f} after 10 s,"
    )
    print(
        f"   |e1| {np.abs(run.e1[run.t > 10]).max():.4f} rad after 10 s, largest torque"
        f" {np.abs(run.tau).max(axis=0).round(1)} N m"
    )
statement = "|w| falls below epsilon = 0.05 and remains there, in each phase of the disturbance"
holds = {statement: all(below)}

# %% The disturbance of the time loop of the script is a tenth of the printed one.
evidence = {
    "full": float(surface(first)[first.t > 10].max()),
    "tenth": float(surface(under(0.2))[first.t > 10].max()),
}

# %% The surface: the solution of the Riccati equation, and the rate and the bound of the scenario.
print(
    f"P12 = {p12:.6f}, P22 = {p22:.6f}; P12/P22 = {p12 / p22:.6f} 1/s and"
    f" {np.ravel(scenario.controller.a)[0]:.6f} in the scenario"
)
print(
    f"epsilon/(P22 sqrt 2) = {EPSILON / p22 / np.sqrt(2):.6f} rad/s and"
    f" {np.ravel(scenario.controller.surface.upper.final)[0]:.6f}"
)
