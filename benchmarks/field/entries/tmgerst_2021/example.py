"""Limits of joint angles behind springs: a barrier function of relative degree four filters the
torque of a feedback linearisation whose reference leaves the limits of both joints.

The arm has two links of 1 m and 1 kg, motors of 1 kg m^2 and springs of 1 N m/rad. The torque is
computed once in 10 ms. The published derivatives of the Coriolis forces have errors, and one of
the four barrier functions has a wrong sign.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

LIMIT = np.array([3 * np.pi / 4, np.pi / 2])
GAMMA, BETA = 16.0, np.pi / 10
FEEDBACK = (1e4, 1e3, 300.0, 10.0)


# %% The derivatives of M(q) and of n(q, q') = C(q, q') q' + G(q) along q', q'' and q'''. `wrong`
# adds what the published formulas have in addition to the exact ones.
def derivatives(plant, x, wrong):
    """q'', q''' and the fourth derivative for u = 0, and M/(K/J) as a matrix, for D = 0."""
    robot, K, J = plant.robot, plant.stiffness, plant.motor_inertia
    q, v, theta, rate = x

    def n(q, v):
        return robot.coriolis(q, v, v) + robot.gravity(q)

    def dM(q, v):
        return jax.jvp(robot.mass_matrix, (q,), (v,))[1]

    def dn(q, v, a):
        return jax.jvp(n, (q, v), (v, a))[1]

    M = robot.mass_matrix(q)
    a = jnp.linalg.solve(M, K * (theta - q) - n(q, v))
    p, s, c, (v1, v2) = wrong * robot.lumped().p3, jnp.sin(q[1]), jnp.cos(q[1]), v
    dn_wrong = p * c * jnp.stack([v2**3 - q[1] ** 3 + 2 * v1 * (v2**2 - a[1]), 0.0 * v1])
    jerk = jnp.linalg.solve(M, K * (rate - v) - dM(q, v) @ a - dn(q, v, a) - dn_wrong)
    ddM = jax.jvp(dM, (q, v), (v, a))[1]
    ddM += p * c * (v2**2 - v2) * jnp.array([[2.0, 1.0], [1.0, 0.0]])
    printed = 2 * s * v2 * a[1] * v1 - 2 * c * (a[0] * a[1] + v1 * jerk[1])
    exact = 2 * s * v2**3 * v1 - 2 * c * (a[0] * v2**2 + 2 * v1 * v2 * a[1])
    ddn_wrong = p * jnp.stack([printed - exact, c * v1**2 * (v2 - a[1])])
    ddn = jax.jvp(dn, (q, v, a), (v, a, jerk))[1] + ddn_wrong
    rest = K / J * (M @ a + n(q, v)) + ddM @ a + 2 * dM(q, v) @ jerk + ddn + K * a
    return a, jerk, -jnp.linalg.solve(M, rest), M * J / K


# %% The law: w is the fourth derivative of q that the feedback asks for. Each barrier function
# B = gamma^3 h + 3 gamma^2 h' + 3 gamma h'' + h''' - beta with B' + B >= 0 limits one component of
# w, and the torque is the one nearest to that of the feedback.
@ij.component
class ElasticFilter:
    """u of least |u - u_nom| with lowest <= w <= highest, w the fourth derivative of q."""

    wrong: ij.Leaf = ij.leaf("1", shape="scalar", default=0.0)
    sign: ij.Leaf = ij.leaf("1", shape="scalar", default=1.0)
    filtered: bool = ij.static(default=True)
    receives_x, has_slack, uses_observer, gains = True, True, False, ()

    def command(self, t, x, d_hat, context, state):
        """The torque of the motors."""
        a, jerk, f, M = derivatives(context.model, x, self.wrong)
        wanted = [context.reference.position]
        for _ in range(4):
            wanted.append(jax.jacfwd(wanted[-1]))
        now = (x[0], x[1], a, jerk)
        w = wanted[4](t)
        w += sum(g * (r(t) - y) for g, r, y in zip(FEEDBACK, wanted, now, strict=False))
        slack = jnp.zeros_like(w)
        if self.filtered:
            slope = GAMMA**3 * x[1] + 3 * GAMMA**2 * a + 3 * GAMMA * jerk
            level = GAMMA**3 * x[0] + 3 * GAMMA**2 * x[1] + 3 * GAMMA * a
            signs = jnp.stack([jnp.ones_like(t), self.sign])
            highest = GAMMA**3 * LIMIT - level - jerk - BETA - slope
            lowest = -(GAMMA**3 * LIMIT + level + signs * jerk - BETA) - slope
            slack = jnp.maximum(lowest - highest, 0.0) / 2
            w = nearest(w, M.T @ M, lowest, highest)
        u = M @ (w - f)
        no = jnp.zeros(u.shape, bool)
        return ij.controllers.Command(u, 0.0 * u, 0.0 * u, no, no, slack=slack), ()


def nearest(w, W, lowest, highest):
    """The y of a box with the least (y - w)^T W (y - w): w, or the best point of the four edges."""
    points = [w]
    for i, j in ((0, 1), (1, 0)):
        for edge in (lowest[i], highest[i]):
            other = jnp.clip(w[j] - W[i, j] / W[j, j] * (edge - w[i]), lowest[j], highest[j])
            points.append(jnp.stack([edge, other] if i == 0 else [other, edge]))
    points = jnp.stack(points)
    cost = jnp.einsum("ki,ij,kj->k", points - w, W, points - w)
    outside = jnp.any((w < lowest) | (w > highest))
    return points[jnp.argmin(cost.at[0].set(jnp.where(outside, jnp.inf, 0.0)))]


def case(**law):
    """The published task under a variant of the law."""
    arm = ij.robots.TwoLink(mass=1.0, length=1.0, centre=0.5, inertia=1 / 3, g=9.81)
    return ij.Scenario(
        plant=ij.plants.FlexibleJoint(robot=arm, stiffness=1.0, motor_inertia=1.0),
        reference=ij.references.Sinusoid(0.0, np.pi, np.pi / 15),
        bounds=ij.Bounds(ij.bounds.Constant(-LIMIT), ij.bounds.Constant(LIMIT)),
        controller=ElasticFilter(**law),
        sampling=ij.Sampling(period=0.01),
        initial=ij.Initial(x=[[0.0] * 2, [np.pi**2 / 15] * 2, [0.0] * 2, [0.0] * 2]),
    )


PRINTED = {"wrong": 1.0, "sign": -1.0}
scenario = case(**PRINTED)
cases = {
    "as printed": scenario,
    "corrected": case(),
    "as printed, without filter": case(**PRINTED, filtered=False),
    "corrected, without filter": case(filtered=False),
}
runs = {name: ij.simulate(one, duration=15.0, dt=2e-3) for name, one in cases.items()}
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
for joint, panel in enumerate(axes):
    for name in ("as printed", "as printed, without filter"):
        run = runs[name]
        panel.plot(run.t, run.x[:, 0, joint], label=name)
    panel.axhline(LIMIT[joint], color="k", linestyle=":", linewidth=0.8)
    panel.set(xlabel="time $t$ [s]", ylabel=f"$q_{joint + 1}$ [rad]")
axes[0].legend(fontsize="x-small")

# %% The statements, and what the errors of the program change.
inside = {name: bool(np.all(np.abs(run.x[:, 0]) <= LIMIT)) for name, run in runs.items()}
error = {name: float(np.abs(run.e1[run.t > 5.0]).max()) for name, run in runs.items()}
outside = not inside["as printed, without filter"]
holds = {
    "the angles stay inside their limits": inside["as printed"],
    "the reference leaves the limits, and the filter keeps the angles inside": outside
    and inside["as printed"],
}
evidence = {
    "error_printed": error["as printed, without filter"],
    "error_exact": error["corrected, without filter"],
    "change": float(np.abs(runs["as printed"].x - runs["corrected"].x)[:, 0].max()),
}
for name, run in runs.items():
    print(f"{name}: {ij.Status(int(run.status))!r}, largest q {run.x[:, 0].max(axis=0)} rad")
