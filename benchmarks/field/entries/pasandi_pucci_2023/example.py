"""Limits of positions and velocities by a change of the state (Pasandi, Pucci 2023): a two-link arm
under a torque law in coordinates that are infinite at the limits.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

Q_MIN, Q_MAX = np.array([-np.pi / 4, -np.pi / 2]), np.array([np.pi / 2, np.pi / 2])
V_MIN, V_MAX = np.array([-np.pi / 2, -np.pi / 2]), np.array([np.pi / 2, np.pi])
Q_MEAN, Q_HALF = (Q_MAX + Q_MIN) / 2.0, (Q_MAX - Q_MIN) / 2.0
V_MEAN, V_HALF = (V_MAX + V_MIN) / 2.0, (V_MAX - V_MIN) / 2.0
POWER = 15.0
EDGE = 1e-3  # where the program cuts q and q' before the law receives them


def smoothed(y):
    """y/(1 + |y|^p)^(1/p), which is below 1."""
    return y / (1.0 + jnp.abs(y) ** POWER) ** (1.0 / POWER)


@ij.component
class ExogenousStates:
    """u = C q' + G + M J_s (s_r' - k1/k2 V/J_z (tanh s - tanh s_r) - k2 e_z - k3 (s - s_r)/J_s).

    z = atanh((q - q_m)/Q), s = atanh((q' - v_m)/V), J_z = dq/dz, J_s = dq'/ds, e_z = z - z_d,
    and s_r is that of the velocity J_z(z)/J_z(z_d) q_d', smoothed.
    """

    k1: ij.Leaf = ij.leaf("1")
    k2: ij.Leaf = ij.leaf("1")
    k3: ij.Leaf = ij.leaf("1")
    exact: bool = ij.static(default=True)
    uses_observer = False

    def desired(self, t, q, context):
        """The components of tanh s_r before the smoothing."""
        tube = context.tube(t)
        gaps = 1.0 - ((jnp.stack([q, tube.q_d]) - Q_MEAN) / Q_HALF) ** 2
        return (gaps[0] / gaps[1] * tube.dq_d - V_MEAN) / V_HALF

    def command(self, t, q, dq, f_hat, context, state):
        """The torque."""
        tube, model = context.tube(t), context.model
        seen = jnp.clip(q, Q_MIN + EDGE, Q_MAX - EDGE)
        speed = jnp.clip(dq, V_MIN + EDGE, V_MAX - EDGE)
        x, x_d, y = (
            (seen - Q_MEAN) / Q_HALF,
            (tube.q_d - Q_MEAN) / Q_HALF,
            (speed - V_MEAN) / V_HALF,
        )
        J_z, J_s = Q_HALF * (1.0 - x**2), V_HALF * (1.0 - y**2)
        raw, rate = jax.jvp(lambda t, q: self.desired(t, q, context), (t, seen), (1.0, speed))
        y_r, smooth_rate = jax.jvp(smoothed, (raw,), (rate,))
        rate = (smooth_rate if self.exact else rate) / (1.0 - y_r**2)
        e_z, e_s = jnp.arctanh(x) - jnp.arctanh(x_d), jnp.arctanh(y) - jnp.arctanh(y_r)
        coupling = self.k1 / self.k2 * V_HALF / J_z * (y - y_r)
        a = J_s * (rate - coupling - self.k2 * e_z - self.k3 / J_s * e_s)
        tau = model.coriolis(seen, speed, speed) + model.gravity(seen) + model.mass_matrix(seen) @ a
        return ij.controllers.Command(tau, tube.dq_d, 0.0 * q, q != q, q != q), ()


@ij.component
class PublishedModel(ij.robots.TwoLink):
    """The arm with m2 l2 lc2 in the place of m2 l1 lc2 in C_21."""

    def coriolis(self, q, v, u):
        """C(q, v) u."""
        c = self.lumped().p3 * jnp.sin(q[1])
        second = self.length[1] / self.length[0] * c * v[0] * u[0]
        return jnp.stack([-c * (v[1] * u[0] + (v[0] + v[1]) * u[1]), second])


NUMBERS = {"mass": [2.0, 1.5], "length": [0.5, 0.35], "centre": [0.25, 0.175]}
RODS = {"inertia": [2.0 * 0.5**2 / 12.0, 1.5 * 0.35**2 / 12.0], "g": 9.81}
REFERENCE = {"offset": [np.pi / 4, 0.0], "amplitude": [np.pi / 4 - 0.09, 0.09 - np.pi / 2]}
REFERENCE |= {"frequency": [1.9, 0.9], "phase": [0.0, np.pi / 2]}
GAINS = {"k1": [22.0, 505.0], "k2": [20.0, 50.0], "k3": [10.0, 5.0]}
positions = ij.Bounds(ij.bounds.Constant(Q_MIN), ij.bounds.Constant(Q_MAX))
velocities = ij.Bounds(ij.bounds.Constant(V_MIN), ij.bounds.Constant(V_MAX))
scenario = ij.Scenario(
    plant=ij.robots.TwoLink(**NUMBERS, **RODS),
    reference=ij.references.Sinusoid(**REFERENCE),
    bounds=(positions, velocities),
    controller=ExogenousStates(**GAINS),
    initial=ij.Initial(q=[0.0, 0.0]),
)
plant = ij.robots.TwoLink(**NUMBERS, inertia=0.0, g=9.80665)
printed = PublishedModel(**NUMBERS, **RODS)
printed_law = ExogenousStates(**GAINS, exact=False)
cases = {
    "corrected": scenario,
    "as published": ij.with_parts(scenario, plant=plant, model=printed, controller=printed_law),
    "derivative corrected": ij.with_parts(scenario, plant=plant, model=printed),
    "derivative and C_21 corrected": ij.with_parts(scenario, plant=plant, model=scenario.plant),
}
runs = {name: ij.simulate(case, duration=20.0, dt=2e-4) for name, case in cases.items()}
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
for name in ("corrected", "as published"):
    run = runs[name]
    for panel, curve in zip(axes, (run.q, run.dq, run.tau), strict=True):
        panel.plot(run.t, curve[:, 0], label=name)
axes[0].plot(run.t, run.q_d[:, 0], "k--", linewidth=0.8, label="reference")
axes[1].hlines([V_MIN[0], V_MAX[0]], 0.0, 5.0, "k", linestyle=":", linewidth=0.8)
labels = ("position $q$ [rad]", r"velocity $\dot q$ [rad/s]", "torque [N m]")
for panel, label in zip(axes, labels, strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=f"{label}, joint 0", xlim=(0.0, 5.0))
axes[0].legend(fontsize="x-small")

# %% What the publication shows, and what the runs give.
late = np.asarray(runs["corrected"].t) > 10.0
least = {name: float(run.tau[:, 0].min()) for name, run in runs.items()}
error = {name: 1e3 * float(np.abs(run.e1[late, 1]).max()) for name, run in runs.items()}
reached = {"largest torque of joint 0 [N m]": float(runs["as published"].tau[:, 0].max())}
corrected = runs["corrected"].metrics
holds = {
    "the positions stay inside their limits": bool((corrected.margin > 0.0).all()),
    "the velocities stay inside their limits": bool((corrected.velocity_margin > 0.0).all()),
}


def power(robot):
    """q'^T (M'/2 - C) q' at q2 = 1 rad and q' = (1, 1) rad/s [W], 0 for every robot."""
    q, dq = jnp.array([0.0, 1.0]), jnp.array([1.0, 1.0])
    _, rate = jax.jvp(robot.mass_matrix, (q,), (dq,))
    return float(dq @ (0.5 * rate @ dq - robot.coriolis(q, dq, dq)))


evidence = {
    "velocity_printed": float(runs["as published"].dq[:, 0].min()),
    "velocity_limit": float(V_MIN[0]),
    "velocity_derivative": float(runs["derivative corrected"].dq[:, 0].min()),
    "torque_printed": least["as published"],
    "torque_derivative": least["derivative corrected"],
    "power_printed": power(printed),
    "power_corrected": power(scenario.plant),
    "error_printed": error["derivative corrected"],
    "error_coriolis": error["derivative and C_21 corrected"],
    "error_corrected": error["corrected"],
}
for name, run in runs.items():
    print(f"{name}: {ij.Status(int(run.status))!r}, least torque of joint 0 {least[name]:.1f} N m,")
    print(f"   margins {run.metrics.margin} rad, {run.metrics.velocity_margin} rad/s")
