"""A barrier on a surface, and a load (Cruz-Ancona et al. 2022): the known arm of two joints, with 2
kg that the law does not know.

C. D. Cruz-Ancona, M. A. Estrada, L. Fridman, Barrier function-based adaptive Lyapunov redesign for
systems without a priori bounded perturbations, IEEE Trans. Automatic Control 67(8) (2022)
3851-3862. The paper's text is not open; the numbers are those of a published script of its case of
study, whose author says that he "could not achieve the same results as the paper".

| printed | value | where |
| --- | --- | --- |
| lengths, centres | 0.45, 0.45 m; 0.091, 0.048 m | l, lc of the script |
| masses, inertias | 23.902, 3.88 kg; 1.266, 0.093 kg m^2 | m, I |
| load | 2 kg more in the second link | m2_bar |
| reference | (sin t, cos t) from the vertical | q_d |
| start | e1 = (1, -1) rad, e1' = 0 | x0 |
| disturbance | eta (1, 1), eta = 2 sin 4t, from 4 pi on 5 sin 4t, from 8 pi on 0.5 sin 4t N m | eta |
| surface | w = B^T P x, P of the Riccati equation with Q = 2 I, R = 0.503 I | varrho, P |
| the barrier's width | epsilon = 0.05 | epsilon |

**What it shows**, by the script's own plots: |x| and |w| over time, the latter to come below
epsilon and to stay.

**Not printed there:** how the load enters gravity and the Coriolis forces. In the script it changes
the inertia alone; here it is a heavier second link in all of them. The script's first program has
eta as above, its time loop a tenth of it; here it is whole.

**Their law is not in the package:** in the script its gain grows until |w| < epsilon/2 and is
|w|/(epsilon - |w|) from then on. This is their arm, load, reference, disturbance and surface under the package's `SurfaceBarrier`, which needs no model either, in a funnel that ends
where |w| < epsilon. Gain and funnel are ours. The three phases of eta are run each from the start.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij
from iblf_jax.files.scenario import load_scenario_file

scenario, options = load_scenario_file(Path(__file__).with_suffix(".toml"))
EPSILON, VARRHO = 0.05, 0.503
p12 = np.sqrt(2 * VARRHO)
p22 = np.sqrt(VARRHO * (2 + 2 * p12))
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
for eta in (2.0, 5.0, 0.5):
    run = ij.simulate(ij.with_parameters(scenario, {"disturbance.amplitude": eta}), **options)
    w = np.linalg.norm(p22 * np.asarray(run.dq - run.alpha), axis=1)
    axes[0].semilogy(run.t, w, label=f"$\\eta$ = {eta:g} sin 4t N m")
    inside = run.t[np.max(np.flatnonzero(w >= EPSILON))]
    print(
        f"eta = {eta:g}: {ij.Status(int(run.status))!r}, |w| < 0.05 from {float(inside):.1f} s on,"
        f" {w[run.t > 10].max():.4f} after 10 s,"
    )
    print(
        f"   |e1| {np.abs(run.e1[run.t > 10]).max():.4f} rad after 10 s, largest torque"
        f" {np.abs(run.tau).max(axis=0).round(1)} N m"
    )
    if eta == 2.0:
        axes[1].plot(run.t, run.e1, label=["joint 0", "joint 1"])
axes[0].axhline(EPSILON, color="k", linestyle=":", linewidth=0.8)
axes[0].set(xlabel="time $t$ [s]", ylabel="$|w|$", title=r"the surface, and $\epsilon$")
axes[1].set(xlabel="time $t$ [s]", ylabel="error $e_1$ [rad]", title=r"$\eta$ = 2 sin 4t")
for panel in axes:
    panel.legend(fontsize="small")

# %% The surface: the equation's solution, and the rate and the bound that the scenario has from it.
print(
    f"P12 = {p12:.6f}, P22 = {p22:.6f}; P12/P22 = {p12 / p22:.6f} 1/s and"
    f" {np.ravel(scenario.controller.a)[0]:.6f} in the scenario"
)
print(
    f"epsilon/(P22 sqrt 2) = {EPSILON / p22 / np.sqrt(2):.6f} rad/s and"
    f" {np.ravel(scenario.controller.surface.upper.final)[0]:.6f}"
)

# %% **Not reproduced:** the law and so its results, those of the paper, which the script's author
# did not meet either; eta's three phases in one run, as no disturbance of the package changes its
# amplitude; how the load enters, as above.
