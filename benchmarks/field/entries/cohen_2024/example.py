"""A double pendulum that falls between two walls: a barrier function made from the kinematics keeps
the tip between them, also with the correct Coriolis forces.

Two masses on rods of 1 m fall from the upright position, with joint damping as the desired torque.
The tip must stay between walls at x = -1.5 m and x = 1.5 m, although the rods reach 2 m.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

WALL = 1.5


@ij.component
@ij.robots.from_energy
class DoublePendulum:
    """Two rods of 1 m with a point mass at each end; q_1 from the downward vertical."""

    mass: ij.Leaf = ij.leaf("kg", sign="positive", shape="scalar")
    payload: ij.Leaf = ij.leaf("kg", sign="nonnegative", shape="scalar", default=0.0)
    n = 2

    def tip(self, q):
        """The second mass, (2,) [m]."""
        absolute = q[0] + q[1]
        across = jnp.sin(q[0]) + jnp.sin(absolute)
        return jnp.stack([across, -jnp.cos(q[0]) - jnp.cos(absolute)])

    def mass_matrix(self, q):
        """M(q), (2, 2)."""
        outer, c = self.mass + self.payload, jnp.cos(q[1])
        coupling = outer * (1.0 + c)
        first = self.mass + outer * (2.0 + 2.0 * c)
        return jnp.stack([jnp.stack([first, coupling]), jnp.stack([coupling, outer])])

    def coriolis(self, q, v, u):
        """C(q, v) u, for which M' - 2 C is skew-symmetric."""
        h = (self.mass + self.payload) * jnp.sin(q[1])
        return h * jnp.stack([-v[1] * u[0] - (v[0] + v[1]) * u[1], v[0] * u[0]])

    def potential(self, q):
        """U(q) [J], with the printed g = 9.8 m/s^2."""
        return 9.8 * ((self.mass + self.payload) * self.tip(q)[1] - self.mass * jnp.cos(q[0]))


@ij.component
class PrintedPendulum(DoublePendulum):
    """The same with the Coriolis matrix of the program: the entry C_21 has the wrong sign."""

    def coriolis(self, q, v, u):
        """C(q, v) u as printed."""
        h, rate = self.mass * jnp.sin(q[1]), 2.0 * v[0] + v[1]
        return -h * jnp.stack([rate * u[1], 0.5 * rate * u[0] + 0.5 * v[0] * u[1]])


def wall(q, model):
    """h0 = 1.5^2 - x_tip^2 [m^2]."""
    return WALL**2 - model.tip(q)[0] ** 2


def barrier(q, dq, model):
    """The barrier h0 - (q' - k0)^T M (q' - k0)/20, with a smooth k0 that keeps h0' >= -h0."""
    h0, slope = jax.value_and_grad(wall)(q, model)
    square = jnp.maximum(slope @ slope, 1e-12)
    e = dq - 0.1 * jax.nn.softplus(-h0 / (0.1 * square)) * slope
    return h0 - 0.05 * e @ (model.mass_matrix(q) @ e)


# %% The law: the torque nearest to the damping -1.2 q' with h' >= -5 h.
@ij.component
class ReducedOrderFilter:
    """tau = tau_d + max(0, -a/|b|^2) b, where h' + 5 h = a + b^T (tau - tau_d)."""

    uses_observer = False
    gains = ()

    def init(self, q, dq, context):
        """The law has no state."""
        return ()

    def command(self, t, q, dq, f_hat, context, state):
        """The torque."""
        model = context.model
        M, desired = model.mass_matrix(q), -1.2 * dq
        h, (along_q, along_dq) = jax.value_and_grad(barrier, (0, 1))(q, dq, model)
        forces = desired - model.coriolis(q, dq, dq) - model.gravity(q)
        a = along_q @ dq + along_dq @ jnp.linalg.solve(M, forces) + 5.0 * h
        b = jnp.linalg.solve(M, along_dq)
        tau = desired + jnp.maximum(0.0, -a / jnp.maximum(b @ b, 1e-12)) * b
        zero, inside = jnp.zeros_like(q), jnp.zeros(q.shape, bool)
        return ij.controllers.Command(tau, zero, zero, inside, inside), ()


true, wrong = DoublePendulum(mass=2.0), PrintedPendulum(mass=2.0)
scenario = ij.Scenario(
    plant=true,
    reference=ij.references.Sinusoid(offset=[2.0 * np.pi, 0.0], amplitude=0.0),
    bounds=ij.Bounds(lower=ij.bounds.Constant(-20.0), upper=ij.bounds.Constant(20.0)),
    regions=(
        ij.regions.HalfSpace(normal=[1.0, 0.0], offset=-WALL),
        ij.regions.HalfSpace(normal=[-1.0, 0.0], offset=-WALL),
    ),
    controller=ReducedOrderFilter(),
    initial=ij.Initial(q=[np.pi + 0.1, 0.0], dq=0.0),
)
cases = {
    "corrected": scenario,
    "as printed": ij.with_parts(scenario, plant=wrong, model=wrong),
    "printed model, true plant": ij.with_parts(scenario, model=wrong),
}
runs = {name: ij.simulate(case, duration=15.0, dt=1e-3) for name, case in cases.items()}
t = np.asarray(runs["corrected"].t)
h0 = {name: np.asarray(jax.vmap(lambda q: wall(q, true))(run.q)) for name, run in runs.items()}
barriers = jax.vmap(lambda q, v: barrier(q, v, true))
h = {name: np.asarray(barriers(run.q, run.dq)) for name, run in runs.items()}
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
for panel, curves, label in zip(axes, (h0, h), ("$h_0$ [m$^2$]", "$h$ [m$^2$]"), strict=True):
    for name, curve in curves.items():
        panel.plot(t, curve, label=name)
    panel.axhline(0.0, color="k", linestyle=":", linewidth=0.8)
    panel.set(xlabel="time $t$ [s]", ylabel=label)
axes[0].legend(fontsize="x-small")


# %% The energy grows by the work of the torque, and by nothing else, if the matrix is correct.
def surplus(run):
    """The largest energy that is not of the start and not the work of the torque, [J]."""
    plant, q, dq = run.scenario.plant, run.q, run.dq
    kinetic = 0.5 * jnp.einsum("ti,tij,tj->t", dq, jax.vmap(plant.mass_matrix)(q), dq)
    energy = np.asarray(kinetic + jax.vmap(plant.potential)(q))
    power = np.sum(np.asarray(run.tau * dq), axis=1)
    work = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(t))])
    return float(np.abs(energy - energy[0] - work).max())


evidence = {"least_h": float(h["printed model, true plant"].min())}
for key, name in (("printed", "as printed"), ("corrected", "corrected")):
    evidence[f"energy_{key}"] = surplus(runs[name])
    evidence[f"h0_{key}"] = float(np.interp(1.0, t, h0[name]))
    evidence[f"leaves_{key}"] = float(t[np.flatnonzero(h0[name] < 0.1).max()])
curve = h0["as printed"]
reached = {f"h0 at {s} s, as printed [m^2]": float(np.interp(s, t, curve)) for s in (1, 2)}
reached["least h0, as printed [m^2]"] = float(curve.min())
reached["time of the least h0, as printed [s]"] = float(t[curve.argmin()])
holds = {"the tip stays between the walls": bool(h0["corrected"].min() > 0.0)}
print({name: round(number, 4) for name, number in (evidence | reached).items()})
