"""A bound on the output (Author 2020): one or two sentences of introduction; the tables of the page
come from entry.toml.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

K_B = 0.51


def drift(t, x):
    """f_1 and f_2."""
    return jnp.stack([jnp.zeros_like(x[0]), -25.0 * x[1]])


def gain(t, x):
    """G_1 and G_2."""
    return jnp.stack([jnp.ones_like(x[0]), jnp.full_like(x[0], 133.0)])


side = ij.bounds.Funnel
scenario = ij.Scenario(
    plant=ij.plants.StrictFeedback(drift, gain, n=1, order=2, units=("rad", "rad/s", "V")),
    reference=ij.references.Sinusoid(offset=0.0, amplitude=1.0),
    bounds=ij.Bounds(lower=side(-K_B, -K_B, 0.0), upper=side(K_B, K_B, 0.0)),
    controller=ij.controllers.BarrierBackstepping(
        k=(10.0, 10.0), barriers=(ij.barriers.Log(), ij.barriers.Quadratic())
    ),
    initial=ij.Initial(x=[[0.5], [0.0]]),
)
printed_gain = ij.with_parameters(scenario, {"controller.k[0]": 1.0})
runs = {
    "corrected": ij.simulate(scenario, duration=2.0, dt=1e-3),
    "as printed": ij.simulate(printed_gain, duration=2.0, dt=1e-3),
}
figure, axes = plt.subplots(1, 1, figsize=(6, 3), layout="constrained")
for name, run in runs.items():
    axes.plot(run.t, run.e1, label=name)
axes.set(xlabel="time $t$ [s]", ylabel="error $e_1$ [rad]")
axes.legend()

# %% What the publication states, and what this run gives.
run = runs["corrected"]
reached = {"largest error [rad]": float(np.abs(run.e1).max())}
holds = {"the output stays inside its bounds": bool(np.all(np.asarray(run.metrics.margin) > 0))}
evidence = {"printed": float(np.interp(0.5, runs["as printed"].t, runs["as printed"].e1[:, 0]))}
print(f"status: {ij.Status(int(run.status))!r}, largest error {np.abs(run.e1).max():.4f} rad")
