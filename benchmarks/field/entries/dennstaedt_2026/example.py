"""Funnel control of a mass on a car: the position of a mass on a ramp stays in a funnel around its
reference under a law that has no model.

The mass slides on a ramp of angle pi/4 on a car; a spring and a damper connect it to the car. The
force u acts on the car, and the output y is the horizontal position of the mass. The relative
degree is 2, and the spring with its damper makes stable internal dynamics.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

ANGLE, CAR, MASS = np.pi / 4, 4.0, 1.0
SINE, COSINE = np.sin(ANGLE), np.cos(ANGLE)


# %% With the extension s of the spring and F = k s + d s', the motion of both bodies is
# M y" = u - coupling F,   M = (car + mass sin^2)/sin^2,   coupling = car cos/(mass sin^2)
# w' = -F/(mass sin^2),   w = s' + y' cos/sin^2.   The input does not reach w, so (s, w) are
# internal dynamics that y' drives. This page has them as an actuator, whose force moves y.
@ij.component
@ij.robots.from_energy
class Output:
    """(mass + payload) y" = force."""

    mass: ij.Leaf = ij.leaf("kg", sign="positive", shape="scalar")
    payload: ij.Leaf = ij.leaf("kg", sign="nonnegative", shape="scalar", default=0.0)
    n = 1
    joints = ("y",)
    kinds = ("prismatic",)

    def mass_matrix(self, q):
        """The mass, (1, 1)."""
        return (self.mass + self.payload) * jnp.eye(1, dtype=q.dtype)

    def potential(self, q):
        """None."""
        return jnp.zeros_like(q[0])

    def tip(self, q):
        """The point (y, 0)."""
        return jnp.stack([q[0], jnp.zeros_like(q[0])])


@ij.component
class Spring:
    """force = u - coupling F,   s' = w - y' cos/sin^2,   w' = -F/(mass sin^2)."""

    stiffness: ij.Leaf = ij.leaf("N/m", sign="positive", shape="scalar")
    damping: ij.Leaf = ij.leaf("N s/m", sign="positive", shape="scalar")

    def init(self, tau):
        """The spring without load, everything at rest."""
        return jnp.zeros((2, *tau.shape))

    def deliver(self, command, dq, state):
        """The force, and the rates of s and w."""
        s, w = state
        rate = w - dq * COSINE / SINE**2
        F = self.stiffness * s + self.damping * rate
        force = command - CAR * COSINE / (MASS * SINE**2) * F
        free = jnp.zeros(command.shape, bool)
        return ij.actuators.Delivered(force, free, jnp.stack([rate, -F / (MASS * SINE**2)]))


# %% The law: with phi = 1/psi and a(z) = 1/(1 - z), w = phi e' + a(phi^2 e^2) phi e and
# u = -a(w^2) w. It needs the funnel psi, the error and its derivative, and nothing else.
@ij.component
class FunnelControl:
    """u = -w/(1 - w^2), w = e'/psi + (e/psi)/(1 - (e/psi)^2)."""

    uses_observer = False
    gains = ()

    def command(self, t, q, dq, f_hat, context, state):
        """The force."""
        tube = context.tube(t)
        psi = tube.upper - tube.q_d
        ratio = (q - tube.q_d) / psi
        virtual = tube.dq_d - psi * ratio / (1.0 - ratio**2)
        w = (dq - virtual) / psi
        inside = jnp.zeros(q.shape, bool)
        return ij.controllers.Command(
            -w / (1.0 - w**2), virtual, -0.5 * jnp.log(1.0 - ratio**2), inside, inside
        ), ()


scenario = ij.Scenario(
    plant=Output(mass=(CAR + MASS * SINE**2) / SINE**2),
    reference=ij.references.Sinusoid(offset=0.0, amplitude=1.0, phase=np.pi / 2),
    bounds=ij.Bounds(
        lower=ij.bounds.Funnel(-5.1, -0.1, 2.0), upper=ij.bounds.Funnel(5.1, 0.1, 2.0)
    ),
    controller=FunnelControl(),
    actuator=Spring(stiffness=2.0, damping=1.0),
    initial=ij.Initial(q=[0.0], dq=[0.0]),
)
runs = {"funnel control": ij.simulate(scenario, duration=10.0, dt=1e-3)}
run = runs["funnel control"]

# %% The error in its funnel, and the force.
t, e = np.asarray(run.t), np.asarray(run.e1[:, 0])
s, w = np.moveaxis(np.asarray(run.actuator_state[..., 0]), -1, 0)
F = 2.0 * s + (w - np.asarray(run.dq[:, 0]) * COSINE / SINE**2)
u = np.asarray(run.tau[:, 0]) + CAR * COSINE / (MASS * SINE**2) * F
psi = 5.0 * np.exp(-2.0 * t) + 0.1
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
axes[0].plot(t, e)
axes[0].plot(t, psi, "k--", t, -psi, "k--", linewidth=0.8)
axes[0].set(xlabel="time $t$ [s]", ylabel="error $y - y_{ref}$ [m]", ylim=(-1.0, 1.0))
axes[1].plot(t, u)
axes[1].set(xlabel="time $t$ [s]", ylabel="force $u$ [N]")

# %% The numbers that the curves of the publication give.
reached = {f"error at {time:g} s [m]": float(np.interp(time, t, e)) for time in (1.0, 2.0, 5.0)}
reached["largest error [m]"] = float(e.max())
reached["least force [N]"] = float(u.min())
reached["largest force [N]"] = float(u.max())
holds = {"the error stays inside the funnel": bool(np.all(np.abs(e) < psi))}
for name, number in reached.items():
    print(f"{name}: {number:.5f}")
print(f"least distance from the funnel {np.min(psi - np.abs(e)):.4f} m")
