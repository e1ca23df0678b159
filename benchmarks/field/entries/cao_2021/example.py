"""Bounds on errors and velocities, and a settling time (Cao 2021): a two-link arm under a neural
law in coordinates that are infinite at the bounds.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

WIDTH, SPEED, TIME, ACCURACY = 0.3, 3.0, 2.0, 0.02
R1, R2, R3, R4, FILTER = 2.0, 10.0, 2.0, 25.0, 1e-3
FINAL, UNKNOWN = ACCURACY / (np.sqrt(2.0) * WIDTH), -0.1 * np.tanh(np.pi / 4)
# The centres of the network: MATLAB's rand after rng('default'), column by column.
CENTRES = 5.0 * (2.0 * np.random.RandomState(5489).random_sample((1000, 8)) - 1.0)


def regulator(t):
    """The factor beta(t) of the bounds, 1 at t = 0 and b from T on."""
    left = jnp.maximum(TIME - t, 0.0) / TIME
    return (1.0 - FINAL) * left**3 + FINAL


@ij.component
class Shrinking:
    """A bound at the distance width beta(t) from the reference."""

    width: ij.Leaf = ij.leaf("rad")

    def at(self, t, q_d):
        """The bound."""
        return q_d + self.width * regulator(t)


def output_gap(s):
    """1 at s = 0, 0 at |s| = 1 with two derivatives there: the divisor of the errors."""
    s = jnp.minimum(jnp.abs(s), 1.0 - 1e-4)
    return 1.0 - 10.0 * s**3 + 15.0 * s**4 - 6.0 * s**5


def speed_gap(s):
    """The same with one derivative, for the velocities."""
    s = jnp.minimum(jnp.abs(s), 1.0 - 1e-4)
    return 1.0 - 3.0 * s**2 + 2.0 * s**3


def output(t, e):
    """z1 = e/h1."""
    return e / output_gap(e / (WIDTH * regulator(t)))


def slope(function, x):
    """Its derivative, component by component."""
    return jax.jvp(function, (x,), (jnp.ones_like(x),))[1]


@ij.component
class SettlingTimeLaw:
    """u = -(k2 z2 + mu1 h2 z1 + r2 a Phi z2)/mu2, a' = -r3 a + r4 Phi |z2|^2; z1 = e/h1, z2 = q'/h2
    - alpha_f, w alpha_f' = alpha - alpha_f, alpha = -(k1 + r1 phi) z1/(mu1 h2); mu1 = dz1/de, mu2 =
    dz2/dq'.
    """

    k1: ij.Leaf = ij.leaf("1", shape="scalar")
    k2: ij.Leaf = ij.leaf("1", shape="scalar")
    speed_factor: ij.Leaf = ij.leaf("1", shape="scalar")  # 1; F as printed
    uses_observer = False

    def init(self, q, dq, context):
        """The filter and the estimate begin at 0."""
        return jnp.zeros_like(q), jnp.zeros(())

    def command(self, t, q, dq, f_hat, context, state):
        """The torque, and the rates of filter and estimate."""
        (alpha_f, estimate), tube = state, context.tube(t)
        e = q - tube.q_d
        z1, mu1 = output(t, e), slope(lambda e: output(t, e), e)
        v1 = jax.jacfwd(lambda t: output(t, e))(t)
        h2, dh2 = speed_gap(dq / SPEED), slope(speed_gap, dq / SPEED)
        mu2 = 1.0 / h2 - self.speed_factor * dh2 * dq / (SPEED * h2**2)
        phi = jnp.max(jnp.abs(mu1)) ** 2 * (jnp.max(h2) ** 2 + tube.q_d @ tube.q_d) + v1 @ v1
        alpha, z2 = -(self.k1 + R1 * phi) * z1 / (mu1 * h2), dq / h2 - alpha_f
        inputs = jnp.concatenate([q, tube.q_d, output_gap(e / (WIDTH * regulator(t))), h2])
        size = jnp.linalg.norm(jnp.exp(-jnp.sum((inputs - CENTRES) ** 2, axis=1) / 9.0))
        u = -(self.k2 * z2 + mu1 * h2 * z1 + R2 * estimate * size * z2) / mu2
        rates = ((alpha - alpha_f) / FILTER, R4 * size * (z2 @ z2) - R3 * estimate)
        return ij.controllers.Command(u, tube.dq_d, 0.0 * q, q != q, q != q), rates


def arm(centre, inertia):
    """The arm, with the first centre of mass and the first moment of inertia."""
    numbers = {"mass": [2.0, 0.85], "length": [0.35, 0.31], "g": 9.8}
    return ij.robots.TwoLink(centre=[centre, 0.31], inertia=[inertia, 0.02042], **numbers)


positions = ij.Bounds(lower=Shrinking(-WIDTH), upper=Shrinking(WIDTH))
speeds = ij.Bounds(ij.bounds.Constant(-SPEED), ij.bounds.Constant(SPEED))
scenario = ij.Scenario(
    plant=arm(0.35, 0.06125),
    reference=ij.references.Sinusoid(offset=0.0, amplitude=0.3, phase=[0.0, np.pi / 2]),
    bounds=(positions, speeds),
    controller=SettlingTimeLaw(k1=4.0, k2=15.0, speed_factor=1.0),
    disturbance=ij.disturbances.Sinusoids([0.0, -0.1], 1.0, np.pi / 2, [UNKNOWN, 0.0]),
    initial=ij.Initial(q=[0.15, 0.4]),
)
printed_law = ij.with_parameters(scenario, {"controller.speed_factor": SPEED})
# The weight m1 l2 of the program is that of a centre of mass at l2; the inertia m1 l1^2 stays.
printed_arm = arm(0.31, 0.061125 + 2.0 * (0.35**2 - 0.31**2))
cases = {
    "corrected": scenario,
    "law as printed": printed_law,
    "law and arm as printed": ij.with_parts(printed_law, plant=printed_arm),
}
runs = {k: ij.simulate(x, duration=5.0, dt=2e-4, backend="vmap") for k, x in cases.items()}
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
for name, run in runs.items():
    axes[0].semilogy(run.t, np.linalg.norm(run.e1, axis=1), label=name)
    axes[1].plot(run.t, run.dq[:, 0])
    axes[2].plot(run.t, run.tau[:, 0])
axes[0].plot(run.t, np.sqrt(2.0) * WIDTH * regulator(run.t), "k:", linewidth=0.8, label="bound")
axes[0].set(xlabel="time $t$ [s]", ylabel=r"$|e_1|$ [rad]", ylim=(1e-3, 1.0))
axes[1].set(xlabel="time $t$ [s]", ylabel=r"velocity $\dot q$ of joint 0 [rad/s]")
axes[2].set(xlabel="time $t$ [s]", ylabel="torque of joint 0 [N m]", xlim=(0.0, 1.0))
axes[0].legend(fontsize="x-small")

# %% What the publication states, and what the runs give.
after = {name: np.linalg.norm(x.e1[x.t >= TIME], axis=1).max() for name, x in runs.items()}
holds = {
    "the norm of the error is below 0.02 rad from 2 s on": max(after.values()) < ACCURACY,
    "the errors stay inside their bounds": all((x.metrics.margin > 0).all() for x in runs.values()),
    "the velocities stay within 3 rad/s": all(np.abs(x.dq).max() < SPEED for x in runs.values()),
}
torques = {name: float(run.tau[:, 0].max()) for name, run in runs.items()}
estimates = {name: np.asarray(run.controller_state[1]) for name, run in runs.items()}
gap, derivative = float(speed_gap(0.5)), float(jax.grad(lambda v: v / speed_gap(v / SPEED))(1.5))
evidence = {
    "derivative": derivative,
    "mu2_printed": 1.0 / gap + SPEED * (derivative - 1.0 / gap),
    "torque_corrected": torques["corrected"],
    "torque_printed": torques["law as printed"],
    "arm_effect": torques["law as printed"] - torques["law and arm as printed"],
    "estimate_corrected": estimates["corrected"].max(),
    "estimate_printed": estimates["law as printed"].max(),
    "pattern_1": 2.0 * 0.35**2 / 4.0,
    "pattern_2": 0.85 * 0.31**2 / 4.0,
}
for name, run in runs.items():
    print(f"{name}: {ij.Status(int(run.status))!r}, |e1| <= {after[name]:.4f} rad after 2 s,")
    print(f"   |q'| <= {np.abs(run.dq).max(axis=0).round(3)} rad/s, torque {torques[name]:.1f} N m")
