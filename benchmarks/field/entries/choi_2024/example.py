"""An obstacle on the way of a double integrator (after Nguyen and Sreenath 2016): an exponential
barrier function of relative degree 2 and a Lyapunov function in a quadratic programme.

With h = |p - p_o|^2 - 4 the condition h'' + 4 h' + 3 h >= 0 has the poles -1 and -3. The start of
the program lies on the line through the target and the centre of the obstacle, where the programme
has no side to pass.
"""

import itertools

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

TARGET, CENTRE, RADIUS, LIMIT = np.array([10.0, 0.0]), np.array([5.0, 2.0]), 2.0, 7.0
GAMMA, RATE, CLF_RATE = 1.0, 3.0, 0.7
ROOT = np.sqrt(3.0)  # P of the regulator is [[ROOT, 1], [1, ROOT]] for each axis
STEP = 0.02


@ij.component
class Point:
    """Acceleration p'' = force/mass of a point in the plane."""

    mass: ij.Leaf = ij.leaf("kg", sign="positive", shape="scalar", default=1.0)
    n, order, units = 2, 2, ("m", "m/s", "N")
    level_names, component_names = ("position", "velocity"), ("x", "y")

    def drift(self, t, x):
        """Zero."""
        return jnp.zeros_like(x)

    def gain(self, t, x):
        """1 and 1/mass, (2, 2)."""
        return jnp.stack([jnp.ones_like(x[0]), jnp.ones_like(x[0]) / self.mass])


def obstacle(t, x):
    """The function h = |p - p_o|^2 - 4, (1,) [m^2]."""
    return jnp.sum((x[0] - CENTRE) ** 2, keepdims=True) - RADIUS**2


def barrier(x):
    """B = h' + h, () [m^2/s]."""
    return 2.0 * jnp.sum((x[0] - CENTRE) * x[1]) + GAMMA * obstacle(0.0, x)[0]


# %% The programme: least 5/2 |u|^2 + 1/2 delta^2 with V' <= -0.7 V + delta, B' >= -3 B and |u_i| <=
# 7. Its solution is the best of the points at which none, one or two of the five conditions on u
# are equalities, for either sign of delta.
@ij.component
class Programme(ij.controllers.Law):
    """u of the quadratic programme."""

    weight: ij.Leaf = ij.leaf("1", sign="positive", shape="scalar", default=5.0)
    uses_observer = False
    gains = ()

    def command(self, t, x, d_hat, context, state):
        """The force."""
        e, v = x[0] - TARGET, x[1]
        V = jnp.sum(ROOT * e**2 + 2.0 * e * v + ROOT * v**2)
        a = 2.0 * e + 2.0 * ROOT * v
        b = -jnp.sum((2.0 * ROOT * e + 2.0 * v) * v) - CLF_RATE * V
        away = 2.0 * (x[0] - CENTRE)
        room = 2.0 * jnp.sum(v**2) + GAMMA * jnp.sum(away * v) + RATE * barrier(x)
        rows = jnp.concatenate([-away[None], jnp.eye(2), -jnp.eye(2)])
        ends = jnp.concatenate([room[None], jnp.full(4, LIMIT)])
        unit = self.weight * jnp.eye(2)
        points = []
        for Q, q in ((unit, 0.0 * a), (unit + jnp.outer(a, a), b * a)):
            free = solved(Q, q)
            points.append(free)
            for row, end in zip(rows, ends, strict=True):
                across = solved(Q, row)
                points.append(free + across * (end - row @ free) / (row @ across))
        for i, j in itertools.combinations(range(5), 2):
            points.append(solved(jnp.stack([rows[i], rows[j]]), jnp.stack([ends[i], ends[j]])))
        points = jnp.stack(points)
        cost = 0.5 * self.weight * jnp.sum(points**2, axis=1)
        cost += 0.5 * jnp.maximum(points @ a - b, 0.0) ** 2
        fits = jnp.all(points @ rows.T <= ends + 1e-9, axis=1) & jnp.all(jnp.isfinite(points), 1)
        u = jnp.clip(points[jnp.argmin(jnp.where(fits, cost, jnp.inf))], -LIMIT, LIMIT)
        no = jnp.zeros(2, bool)
        return ij.controllers.Command(u, 0.0 * u, 0.0 * u, no, jnp.abs(u) >= LIMIT), ()


def solved(A, b):
    """The solution of two linear equations."""
    det = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    return jnp.stack([A[1, 1] * b[0] - A[0, 1] * b[1], A[0, 0] * b[1] - A[1, 0] * b[0]]) / det


constraints = {"square of the distance less that of the radius [m^2]": obstacle}
side = ij.bounds.Funnel
scenario = ij.Scenario(
    plant=Point(),
    reference=ij.references.Sinusoid(offset=TARGET, amplitude=0.0),
    bounds=ij.Bounds(lower=side(-12.0, -12.0, 0.0), upper=side(12.0, 12.0, 0.0)),
    controller=Programme(),
    initial=ij.Initial(x=[[0.0, 4.1], [0.0, 0.0]]),
    sampling=ij.Sampling(period=STEP),
)
printed = ij.with_parts(scenario, initial=ij.Initial(x=[[0.0, 4.0], [0.0, 0.0]]))
cases = {"start beside the line": scenario, "start of the program": printed}
runs = {name: ij.simulate(case, duration=30.0, dt=STEP) for name, case in cases.items()}

figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
angle = np.linspace(0.0, 2.0 * np.pi, 200)
axes[0].fill(CENTRE[0] + 2.0 * np.cos(angle), CENTRE[1] + 2.0 * np.sin(angle), color="0.8")
distance, h, B = {}, {}, {}
for name, run in runs.items():
    x = np.asarray(run.x)
    distance[name] = np.linalg.norm(x[:, 0] - TARGET, axis=1)
    h[name] = np.sum((x[:, 0] - CENTRE) ** 2, axis=1) - RADIUS**2
    B[name] = 2.0 * np.sum((x[:, 0] - CENTRE) * x[:, 1], axis=1) + GAMMA * h[name]
    axes[0].plot(x[:, 0, 0], x[:, 0, 1], label=name)
    axes[1].plot(run.t, distance[name])
    axes[2].plot(run.t, h[name])
    print(f"{name}: {distance[name][750]:.3f} m after 15 s, h >= {h[name].min():.2e} m^2")
axes[0].plot(*TARGET, "k+")
axes[0].set(xlabel="$x$ [m]", ylabel="$y$ [m]", aspect="equal")
axes[1].set(xlabel="time $t$ [s]", ylabel="distance to the target [m]")
axes[2].set(xlabel="time $t$ [s]", ylabel="$h$ [m$^2$]")
axes[0].legend(fontsize="x-small")

# %% What the manual states.
free, stuck = cases
holds = {
    "the target is reached: less than 0.7 m away after 15 s": bool(distance[free][750] < 0.7),
    "the obstacle is avoided": bool(min(h[free].min(), h[stuck].min()) >= 0.0),
    "B stays positive with a relative degree of 2": bool(B[free].min() > 0.0),
}
