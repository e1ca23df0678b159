"""Prescribed performance with a prescribed limit of the input (after Mishra and Jagtap): the speed
of a direct-current motor goes to a set point under a law that does not know the motor.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.signal

import iblf_jax as ij

SET_POINT, LIMIT = 0.1, 18.0


@ij.component
class Motor:
    """Inertia w' = Kt i - friction w, inductance i' = u - resistance i - Kb w, with the speed w and
    the acceleration w' as the levels.
    """

    inertia: ij.Leaf = ij.leaf("kg m^2", sign="positive")
    friction: ij.Leaf = ij.leaf("N m s/rad", sign="nonnegative")
    resistance: ij.Leaf = ij.leaf("ohm", sign="positive")
    inductance: ij.Leaf = ij.leaf("H", sign="positive")
    Kt: ij.Leaf = ij.leaf("N m/A", sign="positive")
    Kb: ij.Leaf = ij.leaf("V s/rad", sign="positive")
    n = 1
    order = 2
    units = ("rad/s", "rad/s^2", "V")
    level_names = ("speed", "acceleration")

    def drift(self, t, x):
        """f_1 and f_2."""
        both = self.inertia * self.inductance
        stiffness = (self.resistance * self.friction + self.Kb * self.Kt) / both
        damping = self.resistance / self.inductance + self.friction / self.inertia
        return jnp.stack([jnp.zeros_like(x[0]), -stiffness * x[0] - damping * x[1]])

    def gain(self, t, x):
        """G_1 and G_2."""
        one = jnp.ones_like(x[0])
        return jnp.stack([one, one * self.Kt / (self.inertia * self.inductance)])


# %% The law limits its input by construction. The error of the speed is filtered, r = e' + a e, and
# r inside psi_r = (a - mu) psi_0 exp(-mu t) + a psi_inf implies |e| < psi_0 exp(-mu t) + psi_inf.
# The program has r = a^2 e in the place of e' + a e, with the same psi_r.
@ij.component
class InputLimit:
    """u = -(2 v/pi) arctan(pi/(2 v) tan(pi r/(2 psi_r))): |u| < v."""

    a: ij.Leaf = ij.leaf("1/s", sign="positive")
    mu: ij.Leaf = ij.leaf("1/s", sign="positive")
    start: ij.Leaf = ij.leaf("rad/s", sign="positive")
    end: ij.Leaf = ij.leaf("rad/s", sign="positive")
    as_printed: bool = ij.static(default=False)
    uses_observer = False
    receives_x = True
    includes_e2 = True
    gains = ("a",)

    def command(self, t, x, d_hat, context, state):
        """The voltage."""
        tube = context.tube(t)
        e, de = x[0] - tube.q_d, x[1] - tube.dq_d
        r = self.a**2 * e if self.as_printed else de + self.a * e
        psi = (self.a - self.mu) * self.start * jnp.exp(-self.mu * t) + self.a * self.end
        u = (
            -2.0
            * LIMIT
            / jnp.pi
            * jnp.arctan(jnp.pi / (2.0 * LIMIT) * jnp.tan(jnp.pi / 2 * r / psi))
        )
        outside = jnp.abs(r) >= psi
        return ij.controllers.Command(u, x[1] - r, 0.5 * (r / psi) ** 2, outside, outside), ()


def task(initial, final, **law):
    """A set point of 0.1 rad/s from rest, with the funnel of the error that the law implies."""
    side = ij.bounds.Funnel
    return ij.Scenario(
        plant=Motor(inertia=1.0, friction=0.1, resistance=0.2, inductance=0.01, Kt=1.0, Kb=1.0),
        reference=ij.references.Sinusoid(offset=SET_POINT, amplitude=0.0),
        bounds=ij.Bounds(lower=side(-initial, -final, 7.0), upper=side(initial, final, 7.0)),
        controller=InputLimit(a=8.0, mu=7.0, start=2.0 * np.pi, end=0.1, **law),
        initial=ij.Initial(x=[[0.0], [0.0]]),
    )


scenario = task(2.0 * np.pi + 0.1, 0.1)
printed = task((2.0 * np.pi + 0.8) / 64.0, 0.8 / 64.0, as_printed=True)
runs = {
    "r = e' + a e": ij.simulate(scenario, duration=2.0, dt=5e-4),
    "as printed, r = a^2 e": ij.simulate(printed, duration=2.0, dt=5e-4),
}


# %% The program compares the law with PID control of the motor, but the motor of that comparison
# (new.m) has a damping of 2.01 1/s where the other files have 20.1 1/s.
def pid_step(damping):
    """Time and speed of the motor under the PID law of new.m, for the set point."""
    kp, ki, kd = 14.1, 286.0, 0.173
    numerator = 100.0 * np.array([kd, kp, ki])
    loop = np.array([1.0, damping, 102.0, 0.0]) + np.concatenate([[0.0], numerator])
    t, speed = scipy.signal.step((numerator, loop), T=np.linspace(0.0, 2.0, 4001))
    return t, SET_POINT * speed


pid = {f"PID, damping {d:g}": pid_step(d) for d in (20.1, 2.01)}
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
for name, run in runs.items():
    axes[0].plot(run.t, run.x[:, 0], label=name)
    axes[1].plot(run.t, run.tau, label=name)
for name, (t, speed) in pid.items():
    axes[0].plot(t, speed, ":", label=name)
axes[0].set(xlabel="time $t$ [s]", ylabel="speed [rad/s]", xlim=(0.0, 1.5))
axes[1].set(xlabel="time $t$ [s]", ylabel="voltage $u$ [V]", xlim=(0.0, 1.5))
axes[0].legend(fontsize="x-small")

# %% What the runs give.
right, wrong = runs.values()
evidence = {
    "right_end": float(right.e1[-1, 0]),
    "wrong_end": float(wrong.e1[-1, 0]),
    "right_peak": float(np.asarray(right.x[:, 0]).max()),
    "wrong_peak": float(np.asarray(wrong.x[:, 0]).max()),
    "right_input": float(np.abs(right.tau).max()),
    "wrong_input": float(np.abs(wrong.tau).max()),
    "pid_right": float(pid["PID, damping 20.1"][1].max()),
    "pid_wrong": float(pid["PID, damping 2.01"][1].max()),
}
holds = {
    "the input stays below 18 V": all(bool(np.abs(run.tau).max() < LIMIT) for run in runs.values()),
    "the error stays inside its funnel": all(
        bool(np.asarray(run.metrics.margin).min() > 0) for run in runs.values()
    ),
}
for name, run in runs.items():
    print(f"{name}: error at 2 s {run.e1[-1, 0]:.5f} rad/s,", end=" ")
    print(f"u from {run.tau.min():.3f} to {run.tau.max():.3f} V, speed <= {run.x[:, 0].max():.4f}")
print({name: f"largest speed {speed.max():.4f} rad/s" for name, (_, speed) in pid.items()})
uncertain = ("plant.inertia",)
