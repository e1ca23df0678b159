"""A spacecraft turns by 135 degrees and its sensor avoids four cones: logarithmic barriers on the
rotation group, and an estimate of a constant disturbance.

The states are roll, pitch and yaw, R = R_3(yaw) R_2(pitch) R_1(roll), and the angular velocity.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij


def symmetric(diagonal, xy, xz, yz):
    """The matrix with this diagonal and these entries beside it."""
    return np.diag(diagonal) + np.array([[0.0, xy, xz], [xy, 0.0, yz], [xz, yz, 0.0]])


def unit_axes(second):
    """The axes of the four cones, where this is the second of them, as unit vectors."""
    axes = np.array([FIRST, second, [-0.853, 0.436, -0.286], [-0.122, -0.14, -0.983]])
    return axes / np.linalg.norm(axes, axis=1)[:, None]


J = 1e-7 * symmetric([55710.50413, 55757.4605, 105053.7595], 617.6577, -250.2846, 100.676)
J_PRINTED = 1e-3 * symmetric([5.5, 5.5, 0.1], 0.06, -0.03, 0.01)
FIRST = [0.174, -0.934, -0.034]
ANGLES, COS = np.array([40.0, 40.0, 40.0, 20.0]), np.cos(np.radians([40.0, 40.0, 40.0, 20.0]))
K_R, K_RATE, ALPHA, C = 0.4, 0.296, 15.0, 1.0


def rotation(angles):
    """R, (3, 3)."""
    (s1, s2, s3), (c1, c2, c3) = jnp.sin(angles), jnp.cos(angles)
    first = [c3 * c2, c3 * s2 * s1 - s3 * c1, c3 * s2 * c1 + s3 * s1]
    second = [s3 * c2, s3 * s2 * s1 + c3 * c1, s3 * s2 * c1 - c3 * s1]
    return jnp.array([first, second, [-s2, c2 * s1, c2 * c1]])


@ij.component
class RigidBody:
    """J w' + w x J w = u, with the rates of roll, pitch and yaw that belong to w."""

    inertia: ij.Leaf = ij.leaf("kg m^2", shape="any")
    n, order, units = 3, 2, ("rad", "rad/s", "N m")

    def drift(self, t, x):
        """0 and -J^-1 (w x J w)."""
        turning = jnp.linalg.inv(self.inertia) @ jnp.cross(x[1], self.inertia @ x[1])
        return jnp.stack([jnp.zeros_like(x[0]), -turning])

    def gain(self, t, x):
        """The matrix of the rates of the angles, and J^-1."""
        s, c, tan = jnp.sin(x[0, 0]), jnp.cos(x[0, 0]), jnp.tan(x[0, 1])
        one, zero, up = jnp.ones_like(s), jnp.zeros_like(s), 1.0 / jnp.cos(x[0, 1])
        rows = [one, s * tan, c * tan], [zero, c, -s], [zero, s * up, c * up]
        return jnp.stack([jnp.array(rows), jnp.linalg.inv(self.inertia)])


@ij.component
class ConstrainedAttitude:
    """u = -k_R e_R - k_w w + w x J w - D, with D' = k_D (w + c e_R)."""

    weights: ij.Leaf = ij.leaf("1", shape="any")
    axes: ij.Leaf = ij.leaf("1", shape="any")
    k_D: ij.Leaf = ij.leaf("1", sign="nonnegative", shape="scalar", default=0.5)
    receives_x = True
    uses_observer = False
    gains = ()

    def error(self, angles):
        """The error function and e_R."""
        R, G = rotation(angles), jnp.diag(self.weights)
        attract = 0.5 * jnp.trace(G @ (jnp.eye(3) - R))
        skew, room = 0.5 * (G @ R - R.T @ G), COS - self.axes @ R[:, 0]
        avoid = 1.0 - jnp.sum(jnp.log(room / (1.0 + COS))) / ALPHA
        push = jnp.cross((self.axes @ R) / room[:, None], jnp.array([-1.0, 0.0, 0.0])) / ALPHA
        e = jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]])
        return attract * avoid, avoid * e + attract * jnp.sum(push, axis=0)

    def init(self, x, context):
        """D = 0."""
        return jnp.zeros(3)

    def command(self, t, x, d_hat, context, state):
        """The torque, and D'."""
        e, spin = self.error(x[0])[1], context.model.inertia @ x[1]
        u = -K_R * e - K_RATE * x[1] + jnp.cross(x[1], spin) - state
        zero, inside = jnp.zeros_like(u), jnp.zeros(3, bool)
        return ij.controllers.Command(u, zero, zero, inside, inside), self.k_D * (x[1] + C * e)


# %% Other laws follow a way around the first cone, close to that of the published run.
WAY = np.array([[0, 0, -135], [13, -1, -124], [16, -30, -112], [5, -43, -78], [-8, -28, -37]])
WAY, WIDE = np.radians([*WAY, [-4, -7, -14], [0, 0, 0]]), np.array([0.75, 0.75, 1.2])
funnel = ij.bounds.Funnel
scenario = ij.Scenario(
    plant=RigidBody(J),
    reference=ij.references.WaypointSpline((0.0, 1.0, 2.0, 2.5, 3.0, 4.0, 8.0), WAY),
    bounds=ij.Bounds(funnel(-WIDE, -0.9 * WIDE, 0.1), funnel(WIDE, 0.9 * WIDE, 0.1)),
    controller=ConstrainedAttitude([0.9, 1.0, 1.1], unit_axes([0.4, 0.7071, 0.7071])),
    disturbance=ij.disturbances.Sinusoids(0.0, 1.0, offset=[0.2, 0.2, 0.2]),
    initial=ij.Initial(x=[WAY[0], [0.0, 0.0, 0.0]]),
)
cases = {
    "with the update law": {},
    "without the update law": {"controller.k_D": 0.0},
    "printed inertia": {"plant.inertia": J_PRINTED},
    "printed weights": {"controller.weights": [0.9, 1.1, 1.0]},
    "printed second cone": {"controller.axes": unit_axes([0.0, 0.7071, 0.7071])},
}
runs, errors, found = {}, {}, {}
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
for name, values in cases.items():
    case = ij.with_parameters(scenario, values)
    run = ij.simulate(case, duration=10.0, dt=5e-4 if "inertia" in name else 1e-3)
    runs[name], R = run, np.asarray(jax.vmap(rotation)(run.x[:, 0]))
    errors[name] = np.asarray(jax.vmap(case.controller.error)(run.x[:, 0])[0])
    found[name] = np.degrees(np.arccos(R[:, :, 0] @ np.asarray(case.controller.axes).T))
    axes[1].plot(run.t, errors[name], label=name, linewidth=0.8)
    print(f"{name}: least angles {np.round(found[name].min(0), 2)} degrees")
first, bare = "with the update law", "without the update law"
t, cones, estimate = runs[first].t, found[first], np.asarray(runs[first].controller_state)
for panel, curves in ((axes[0], cones), (axes[2], estimate)):
    panel.plot(t, curves, label=[f"${i + 1}$" for i in range(curves.shape[1])])
axes[0].hlines(ANGLES[[0, 3]], 0.0, 10.0, "k", ":", linewidth=0.8)
for panel, label in zip(axes, ("angle to the axis [deg]", "error [1]", "$D$ [N m]"), strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label)
    panel.legend(fontsize="x-small")
reached = {
    "error at 0": float(errors[first][0]),
    "least angle to the first cone [deg]": float(cones[:, 0].min()),
    "least angle to the fourth cone [deg]": float(cones[:, 3].min()),
    "largest D_1 [N m]": float(estimate[:, 0].max()),
    "error at 10 s without the update law": float(errors[bare][-1]),
}
holds = {
    "no cone is entered": all(bool((found[name] > ANGLES).all()) for name in (first, bare)),
    "the estimate converges": float(np.abs(estimate[-1] - 0.2).max()) < 1e-3,
    "without the update law the error does not converge to 0": bool(errors[bare][-1] > 0.1),
}
evidence = {
    "excess": float(np.linalg.eigvalsh(J_PRINTED) @ [-1.0, -1.0, 1.0]),
    "inertia": float(np.abs(found["printed inertia"][::2] - cones).max()),
    "weights": float(errors["printed weights"][0]),
    "second": float(found["printed second cone"][0, 1]),
    "second_true": float(cones[0, 1]),
    "unit": float(np.degrees(np.arccos(R[0, :, 0] @ FIRST))),
}
