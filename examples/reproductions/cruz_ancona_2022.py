"""A barrier on a surface, and a load (Cruz-Ancona et al. 2022): the common arm of two joints, with
a load of 2 kg that the model does not contain.

C. D. Cruz-Ancona, M. A. Estrada, L. Fridman, Barrier function-based adaptive Lyapunov redesign for
systems without a priori bounded perturbations, IEEE Trans. Automatic Control 67(8) (2022)
3851-3862. The text of the paper is not openly accessible. The numbers are those of a published
script of its case study, whose author states that he "could not achieve the same results as the
paper".

| printed | value | where |
| --- | --- | --- |
| lengths, centres | 0.45, 0.45 m; 0.091, 0.048 m | l, lc of the script |
| masses, inertias | 23.902, 3.88 kg; 1.266, 0.093 kg m^2 | m, I |
| load | 2 kg more in the second link | m2_bar |
| reference | (sin t, cos t) from the vertical | q_d |
| start | e1 = (1, -1) rad, e1' = 0 | x0 |
| disturbance | eta (1, 1), eta = 2 sin 4t, from 4 pi on 5 sin 4t, from 8 pi on 0.5 sin 4t N m | eta |
| surface | w = B^T P x, P of the Riccati equation with Q = 2 I, R = 0.503 I | varrho, P |
| width of the barrier | epsilon = 0.05 | epsilon |

**Published result**, according to the plots of the script: |x| and |w| over time; |w| falls below
epsilon and remains there.

**Not printed:** how the load enters gravity and the Coriolis forces. In the script it changes the
inertia only; in this example it increases the mass of the second link in all terms. The first part
of the script has eta as above, and its time loop a tenth of it; this example uses the full value.

**The package does not contain the published law:** in the script its gain increases until |w| <
epsilon/2 and is
|w|/(epsilon - |w|) afterwards. This example has the published arm, load, reference, disturbance and
surface with the package's `SurfaceBarrier`, which needs no model either, in a funnel that converges
to |w| < epsilon. Gain and funnel are choices of this example. Each of the three phases of eta is a
separate run from the start.
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

# %% The surface: the solution of the Riccati equation, and the rate and the bound of the scenario.
print(
    f"P12 = {p12:.6f}, P22 = {p22:.6f}; P12/P22 = {p12 / p22:.6f} 1/s and"
    f" {np.ravel(scenario.controller.a)[0]:.6f} in the scenario"
)
print(
    f"epsilon/(P22 sqrt 2) = {EPSILON / p22 / np.sqrt(2):.6f} rad/s and"
    f" {np.ravel(scenario.controller.surface.upper.final)[0]:.6f}"
)

# %% **Not reproduced:** the law and its results, which the author of the script did not reproduce
# either; the three phases of eta in one run, because no disturbance of the package changes its
# amplitude; the effect of the load, as above.
