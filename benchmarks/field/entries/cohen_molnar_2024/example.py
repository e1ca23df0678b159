"""A double pendulum that falls between two lines (Cohen, Molnar, Ames 2024): a control barrier
function of a reduced model keeps the tip within 1.5 m of the vertical line through the base.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

LIMIT = 1.5
NUMBERS = {"mass": 2.0, "length": 1.0, "centre": 1.0, "inertia": 0.0, "g": 9.8}
ARM = ij.robots.TwoLink(**NUMBERS)


@ij.component
class PublishedArm(ij.robots.TwoLink):
    """The arm with the second row of C of the program, -c (q1'^2 + q1' q2') in place of c q1'^2."""

    def coriolis(self, q, v, u):
        """C(q, v) u, with c = m2 l1 lc2 sin q2."""
        c = self.lumped().p3 * jnp.sin(q[1])
        second = -0.5 * c * ((2.0 * v[0] + v[1]) * u[0] + v[0] * u[1])
        return jnp.stack([-c * (2.0 * v[0] + v[1]) * u[1], second])


def h0(model, q):
    """1.5^2 - x^2 with the horizontal position x of the tip."""
    return LIMIT**2 - model.tip(q)[0] ** 2


@ij.component
class ReducedOrderBarrier:
    """u = k_d + max(0, -a/|b|^2) b with a = h' at k_d + alpha h, b = L_g h,
    h = h0 - 1/(2 mu) |q' - k0|_M^2, k0 = sigma ln(1 + exp(-h0/(sigma |dh0|^2))) dh0.
    """

    mu: ij.Leaf = ij.leaf("1", sign="positive", shape="scalar")
    sigma: ij.Leaf = ij.leaf("1", sign="positive", shape="scalar")
    alpha: ij.Leaf = ij.leaf("1/s", sign="positive", shape="scalar")
    damping: ij.Leaf = ij.leaf("N m s/rad", shape="scalar")

    def barrier(self, model, q, dq):
        """The barrier function h."""
        slope = jax.grad(lambda q: h0(model, q))(q)
        square = slope @ slope + 1e-12  # 0 where the tip is on the vertical line
        k0 = self.sigma * jax.nn.softplus(-h0(model, q) / (self.sigma * square)) * slope
        return h0(model, q) - 0.5 / self.mu * (dq - k0) @ (model.mass_matrix(q) @ (dq - k0))

    def command(self, t, q, dq, f_hat, context, state):
        """The filtered damping torque."""
        model = context.model
        h, (dh_q, dh_v) = jax.value_and_grad(
            lambda q, dq: self.barrier(model, q, dq), argnums=(0, 1)
        )(q, dq)
        inverse = jnp.linalg.inv(model.mass_matrix(q))
        nominal = -self.damping * dq
        b = dh_v @ inverse
        bias = model.coriolis(q, dq, dq) + model.gravity(q)
        a = dh_q @ dq + b @ (nominal - bias) + self.alpha * h
        tau = nominal + jnp.maximum(0.0, -a / (b @ b + 1e-12)) * b
        no = jnp.zeros(q.shape, bool)
        return ij.controllers.Command(tau, 0.0 * dq, 0.0 * q, no, no), ()


def scenario_of(plant, model):
    """The published task; q_1 is measured from the horizontal, in the publication from below."""
    wide = ij.Bounds(ij.bounds.Constant([0.5, -2.5]), ij.bounds.Constant([6.5, 2.5]))
    return ij.Scenario(
        plant=plant,
        model=model,
        reference=ij.references.Sinusoid(offset=[1.5 * np.pi, 0.0], amplitude=0.0),
        bounds=wide,
        controller=ReducedOrderBarrier(mu=10.0, sigma=0.1, alpha=5.0, damping=1.2),
        regions=(
            ij.regions.HalfSpace(normal=[1.0, 0.0], offset=-LIMIT),
            ij.regions.HalfSpace(normal=[-1.0, 0.0], offset=-LIMIT),
        ),
        initial=ij.Initial(q=[np.pi / 2 + 0.1, 0.0]),
    )


scenario = scenario_of(ARM, ARM)
published = PublishedArm(**NUMBERS)
options = {"duration": 15.0, "dt": 1e-3}
runs = {
    "corrected": ij.simulate(scenario, **options),
    "as published": ij.simulate(scenario_of(published, published), **options),
    "published filter, true arm": ij.simulate(scenario_of(ARM, published), **options),
}


# %% The barrier function of the reduced model. The points are read from the published figure.
def level(run):
    """h0 of a run."""
    return LIMIT**2 - np.asarray(jax.vmap(run.scenario.plant.tip)(run.q))[:, 0] ** 2


levels = {name: level(run) for name, run in runs.items()}
points = np.loadtxt(Path(__file__).with_name("figure.csv"), delimiter=",", skiprows=1)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
for name, run in runs.items():
    axes[0].plot(run.t, levels[name], label=name)
    axes[1].plot(run.t, run.tau[:, 0], label=name)
axes[0].plot(*points.T, "o", markersize=3, fillstyle="none", color="k", label="published figure")
axes[0].axhline(0.0, color="k", linestyle=":", linewidth=0.8)
axes[0].set(xlabel="time $t$ [s]", ylabel=r"$h_0 = 1.5^2 - x^2$ [m$^2$]")
axes[1].set(xlabel="time $t$ [s]", ylabel="torque of joint 0 [N m]", xlim=(0.0, 8.0))
axes[0].legend(fontsize="x-small")


# %% What the publication shows, and what the runs give.
def distance(name, end=4.0):
    """The largest distance of a run from the points of the figure up to a time."""
    t, h = points[points[:, 0] <= end].T
    return float(np.abs(np.interp(t, runs[name].t, levels[name]) - h).max())


def rate_of_energy(robot):
    """q'^T (M'/2 - C) q', which is 0 for every robot, at q2 = 1 rad and q' = (1, 2) rad/s [W]."""
    q, dq = jnp.array([0.3, 1.0]), jnp.array([1.0, 2.0])
    _, dM = jax.jvp(robot.mass_matrix, (q,), (dq,))
    return float(dq @ (0.5 * dM @ dq - robot.coriolis(q, dq, dq)))


at = {second: float(np.interp(second, *points.T)) for second in (1.0, 2.0, 3.0, 4.0)}
reached = {
    f"h0 at {second:g} s [m^2]": float(
        np.interp(second, runs["as published"].t, levels["as published"])
    )
    for second in at
} | {"least h0 [m^2]": levels["as published"].min()}
holds = {"the tip stays between the lines": all(h.min() > 0.0 for h in levels.values())}
evidence = {
    "published_distance": distance("as published"),
    "corrected_distance": distance("corrected"),
    "published_power": rate_of_energy(published),
    "corrected_power": rate_of_energy(ARM),
    "mixed_least": levels["published filter, true arm"].min(),
}
for name, run in runs.items():
    print(f"{name}: {ij.Status(int(run.status))!r}, least h0 {levels[name].min():.5f} m^2,")
    print(f"   largest torques {np.abs(run.tau).max(axis=0).round(1)} N m")
