"""A limit of the torque in a shaft (Bemporad 2003): a direct-current motor turns a load
over a gear and an elastic shaft, whose torque is limited as well as the voltage.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.linalg
from scipy.optimize import LinearConstraint, minimize

import iblf_jax as ij

STIFFNESS = 81_500e6 * np.pi / 32.0 * 0.02**4
TORQUE = 50e6 * np.pi * 0.02**3 / 16.0
INERTIA = 25.0 + 0.5 * 0.01**2 * 7850.0 * np.pi * 0.01**2
GEAR, VOLTAGE, SET_POINT = 20.0, 220.0, np.pi


# %% With the torque T of the shaft as the third level the plant is in strict-feedback form, and the
# limit of T is the bound of a level.
@ij.component
class Servo:
    """q' = w, J w' = T - 25 w, T' = stiffness (W/gear - w), 0.5 W' = 10/20 u - T/gear - 5.1 W."""

    inertia: ij.Leaf = ij.leaf("kg m^2", sign="positive")
    stiffness: ij.Leaf = ij.leaf("N m/rad", sign="positive")
    n = 1
    order = 4
    units = ("rad", "rad/s", "N m", "rad/s", "V")
    level_names = ("load angle", "load speed", "shaft torque", "motor speed")

    def drift(self, t, x):
        """f_1 ... f_4."""
        load = -25.0 * x[1] / self.inertia
        motor = -(0.1 + 10.0**2 / 20.0) / 0.5 * x[3] - x[2] / (GEAR * 0.5)
        return jnp.stack([jnp.zeros_like(x[0]), load, -self.stiffness * x[1], motor])

    def gain(self, t, x):
        """G_1 ... G_4."""
        one = jnp.ones_like(x[0])
        return jnp.stack([one, one / self.inertia, one * self.stiffness / GEAR, one])


def between(low, high):
    """Constant bounds."""
    return ij.Bounds(lower=ij.bounds.Constant(low), upper=ij.bounds.Constant(high))


def task(k, barrier):
    """The set point from rest under backstepping with a barrier on the torque, within 220 V."""
    free = ij.barriers.Quadratic()
    barriers, weights = (free, free, barrier, free), (1.0, INERTIA, 5e-3, 1.0)
    law = ij.controllers.BarrierBackstepping(k=k, barriers=barriers, weights=weights)
    return ij.Scenario(
        plant=Servo(inertia=INERTIA, stiffness=STIFFNESS),
        reference=ij.references.Sinusoid(offset=SET_POINT, amplitude=0.0),
        bounds=(between(-1.0, 4.0), None, between(-TORQUE, TORQUE)),
        controller=ij.controllers.Saturated(law, limit=VOLTAGE),
        initial=ij.Initial(x=[[0.0]] * 4),
    )


gains = np.array([0.6, 1.0, 5.0, 20.0])
scenario = task(gains, ij.barriers.TransformedError())
unbounded = task(gains * [2.0, 2.0, 1.0, 1.0], ij.barriers.Quadratic())
cases = {"barrier on the torque": scenario, "faster, without a barrier": unbounded}
runs = {name: ij.simulate(case, duration=8.0, dt=1e-3) for name, case in cases.items()}


# %% The published law is a model predictive control with a period of 0.1 s, 10 steps and 2 free
# inputs, and the limits as hard constraints. The cost is that of the program of 2003.
def motion(x, u):
    """The derivative of the state, (4,)."""
    above = jnp.append(x[1:], u)[:, None]
    plant, column = scenario.plant, x[:, None]
    return (plant.drift(0.0, column) + plant.gain(0.0, column) * above)[:, 0]


A, B = (np.asarray(part) for part in jax.jacfwd(motion, (0, 1))(jnp.zeros(4), jnp.zeros(1)))


def sampled(period):
    """The matrices of the plant over a period with a constant input."""
    both = scipy.linalg.expm(period * np.block([[A, B], [np.zeros((1, 5))]]))
    return both[:4, :4], both[:4, 4]


def predictive(steps):
    """States and inputs at the instants of the predictive control, (steps, 5)."""
    Ad, Bd = sampled(0.1)
    free = [np.linalg.matrix_power(Ad, i) for i in range(11)]
    late = [sum((free[j] @ Bd for j in range(i - 1)), np.zeros(4)) for i in range(11)]
    forced = np.stack([[free[i - 1] @ Bd, late[i]] for i in range(1, 11)])
    box = [(-VOLTAGE, VOLTAGE)] * 2
    x, last, found = np.zeros(4), 0.0, []
    for _ in range(steps):
        base = np.stack([free[i] @ x for i in range(1, 11)])

        def cost(u, base=base, last=last):
            e = base[:, 0] + forced[:, :, 0] @ u - SET_POINT
            return 1000.0 * e @ e + 0.05 * ((u[0] - last) ** 2 + (u[1] - u[0]) ** 2)

        limits = LinearConstraint(forced[:, :, 2], -TORQUE - base[:, 2], TORQUE - base[:, 2])
        u = minimize(cost, [last, last], method="SLSQP", bounds=box, constraints=limits).x
        found.append((*x, u[0]))
        x, last = Ad @ x + Bd * u[0], u[0]
    return np.array(found)


mpc = predictive(80)
fine, (small, push) = [mpc[0, :4]], sampled(1e-3)
for u in np.repeat(mpc[:, 4], 100):
    fine.append(small @ fine[-1] + push * u)
fine = np.array(fine)
curves = {name: (run.t, run.x[:, 0], run.x[:, 2], run.tau) for name, run in runs.items()}
t = 1e-3 * np.arange(len(fine))
curves["predictive control"] = (t, fine[:, 0], fine[:, 2], np.repeat(mpc[:, 4], 100))

figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
labels = ("load angle [rad]", "torque of the shaft [N m]", "voltage [V]")
for name, (t, *signals) in curves.items():
    for panel, signal, label in zip(axes, signals, labels, strict=True):
        panel.plot(t[: len(signal)], signal, label=name)
        panel.set(xlabel="time $t$ [s]", ylabel=label)
axes[1].plot([0.0, 8.0], [[TORQUE, -TORQUE]] * 2, "k:")
axes[0].legend(fontsize="x-small")

# %% What the plant and the runs give.
poles = sorted(np.linalg.eigvals(A), key=lambda pole: pole.imag)
reached = {
    "torque limit [N m]": TORQUE,
    "real pole [1/s]": float(min(pole.real for pole in poles)),
    "real part of the pole pair [1/s]": float(poles[-1].real),
    "imaginary part of the pole pair [1/s]": float(poles[-1].imag),
}
at, all_time = np.abs(mpc[:, 2]).max(), np.abs(fine[:, 2])
holds = {
    "the torque is within its limit at the instants of the control": bool(at < TORQUE + 1e-6),
    "the load reaches its set point": bool(abs(fine[-1, 0] - SET_POINT) < 1e-3),
}
details = {
    "the torque is within its limit at the instants of the control": f"{at:.3f} N m there, of"
    f" {TORQUE:.3f} N m; {all_time.max():.2f} N m between, above for {sum(all_time > TORQUE)} ms",
    "the load reaches its set point": f"{abs(fine[-1, 0] - SET_POINT):.1e} rad away, < 1e-3 rad",
}
for name, (t, q, torque, _) in curves.items():
    away = np.flatnonzero(np.abs(np.asarray(q) - SET_POINT) > 0.02 * SET_POINT)[-1]
    print(f"{name}: |T| <= {np.abs(torque).max():.2f} N m, within 2 % from {t[away]:.2f} s on")
uncertain = ("plant.inertia", "plant.stiffness")
