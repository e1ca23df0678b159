"""A surface vehicle on its path: barriers on both path following errors, a neural estimate and two
thrusters; the published curves are those of a vehicle whose yaw rate the program cuts.

The first of three vehicles follows the straight part of its path; x_e is along it, y_e across.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

ARM, INERTIA, LOOK_AHEAD, FILTER, T_MAX, T_MIN = 0.26, 17.21, 5.0, 0.1, 113.6775, -55.0
A, K, SCALE = np.array([1.0, 0.5]), np.array([4.0, 2.0]), np.array([1.0 / 50.5, ARM / INERTIA])
BOTH = np.array([[1.0, 1.0], [1.0, -1.0]])


@ij.component
class Path:
    """The point of the path (10, theta) with theta' = 0.3 - 0.5 (theta - theta_0), heading east."""

    def position(self, t):
        """(10, theta, pi/2), (3,) [m, m, rad]."""
        theta = 1.5 + 0.3 * t - 1.4 * jnp.exp(-0.5 * t)
        return jnp.stack([jnp.full_like(t, 10.0), theta, jnp.full_like(t, jnp.pi / 2)])


def wrapped(angle):
    """The angle in (-pi, pi]."""
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))


def barrier(e, width):
    """The printed width^2/(pi e) sin(z) cos(z), z = pi e^2/(2 width^2), finite at e = 0."""
    return 0.5 * e * jnp.sinc(e**2 / width**2)


# %% The law of the program. Its nine neurons are one, as they have one centre and one width.
# `share` is 1/2 for the printed v sin(psi_e/2) and 1 for v sin(psi_e).
@ij.component
class PathFollowing:
    """Guidance with barriers on x_e and y_e, and adaptive control of surge speed and yaw rate."""

    share: ij.Leaf = ij.leaf("1", sign="positive", shape="scalar", default=1.0)
    receives_x = True
    uses_observer = False
    gains = ()

    def guidance(self, t, x):
        """The desired u, the course from the path, and the slope of the barrier of y_e."""
        (north, east, psi), (u, v, _) = x[0], x[1]
        decay, lead = jnp.exp(-0.05 * t), jnp.exp(-0.5 * t)
        a, b, rate = 3.0 * decay + 0.8, 3.0 * decay + 0.5, -0.15 * decay
        x_e, y_e, psi_e = east - Path().position(t)[1], 10.0 - north, psi - jnp.pi / 2
        ratio, first = rate / b * jnp.hypot(0.3, v), barrier(y_e, b)
        rest = 1.0 - (ratio * y_e) ** 2
        k_y = (ratio**2 * first * y_e + ratio * jnp.sqrt(LOOK_AHEAD * rest + first**2)) / rest
        surge = 0.3 + 0.7 * lead - jnp.sqrt((rate / a) ** 2 + 2.0) * x_e - 2.0 * barrier(x_e, a)
        surge = surge + 2.0 * u * jnp.sin(psi_e / 2) ** 2 + v * jnp.sin(self.share * psi_e)
        course = -jnp.arctan2(v, u) - jnp.arctan2(first + k_y * y_e, LOOK_AHEAD)
        return surge, course, y_e / jnp.cos(jnp.pi * y_e**2 / (2.0 * b**2)) ** 2

    def desired(self, t, x, heading):
        """The desired (u, r), and the rate of the filtered heading."""
        surge, course, slope = self.guidance(t, x)
        rate = -wrapped(heading - jnp.pi / 2 - course) / FILTER
        z, g = wrapped(x[0, 2] - jnp.pi / 2 - course), course + jnp.arctan2(x[1, 1], x[1, 0])
        turned = 0.5 * z * jnp.sinc(z / (2.0 * jnp.pi)) ** 2
        rho = jnp.cos(g) * jnp.sinc(z / jnp.pi) - jnp.sin(g) * turned
        yaw = -5.0 * wrapped(x[0, 2] - heading) + rate
        return jnp.stack([surge, yaw - slope * jnp.hypot(x[1, 0], x[1, 1]) * rho]), rate

    def init(self, x, context):
        """Both filters begin at their inputs, the rest at 0, (7,)."""
        heading = jnp.pi / 2 + self.guidance(jnp.zeros(()), x)[1]
        wanted = self.desired(jnp.zeros(()), x, heading)[0]
        return jnp.concatenate([heading[None], wanted, jnp.zeros(4)])

    def command(self, t, x, d_hat, context, state):
        """The force and moment of the thrusters, and the rates of the states."""
        wanted, turn = self.desired(t, x, state[0])
        rate, phi = (wanted - state[1:3]) / FILTER, jnp.exp(-(x[1] @ x[1]) / 4.0)
        e = jnp.stack([x[1, 0], x[1, 2]]) - wanted - state[3:5]
        needed = (rate - A * state[3:5] - 9.0 * phi * state[5:7] - K * e) / SCALE
        T = 0.5 * (BOTH @ needed)
        smooth = jnp.where(T > 0.0, T_MAX * jnp.tanh(T / T_MAX), T_MIN * jnp.tanh(T / T_MIN))
        change = -A * state[3:5] - SCALE * (BOTH @ (T - smooth))
        rates = jnp.concatenate([turn[None], rate, change, phi * e - 0.005 * state[5:7]])
        force, yaw = BOTH @ jnp.clip(T, T_MIN, T_MAX)
        force = jnp.stack([force, jnp.zeros_like(force), ARM * yaw])
        zero, inside = jnp.zeros_like(force), jnp.zeros(3, bool)
        return ij.controllers.Command(force, zero, zero, inside, inside), rates


fast = ij.disturbances.Sinusoids([2.5, 1.5, 2.5], 0.23, offset=[5.0, 3.0, 5.0])
slow = ij.disturbances.Sinusoids([-2.5, 1.5, 2.5], 0.07)
near, far = np.array([3.5, 3.8, 3.2]), np.array([0.5, 0.8, 3.2])
scenario = ij.Scenario(
    plant=ij.plants.Vessel(50.5, INERTIA, Y_dv=-33.86, X_u=-151.57, Y_v=-132.5, N_r=-34.56),
    reference=Path(),
    bounds=ij.Bounds(ij.bounds.Funnel(-near, -far, 0.05), ij.bounds.Funnel(near, far, 0.05)),
    controller=PathFollowing(),
    disturbance=ij.disturbances.Sum((fast, slow)),
    initial=ij.Initial(x=[[10.0, 0.0, -np.pi / 6], [0.1, 0.1, 0.1]]),
)
half = ij.with_parameters(scenario, {"controller.share": 0.5})
runs = {"corrected": ij.simulate(scenario, duration=60.0, dt=2e-3)}
runs["printed v sin(psi_e/2)"] = ij.simulate(half, duration=60.0, dt=2e-3)


# %% The program: steps of 0.04 s, and a yaw rate that is cut at 0.5 rad/s before each of them.
def program(limit):
    """The state at the steps, (1500, 2, 3)."""
    law, plant = half.controller, half.plant

    def step(carry, t):
        x, state, force = carry
        x = x.at[1, 2].set(jnp.clip(x[1, 2], -limit, limit))
        f, G = plant.drift(t, x), plant.gain(t, x)
        u = force + half.disturbance.torque(t, x[0], x[1], plant, plant)
        x = x + 0.04 * jnp.stack([f[0] + G[0] @ x[1], f[1] + G[1] @ u])
        command, rate = law.command(t, x, None, None, state)
        return (x, state + 0.04 * rate, command.tau), x

    start = half.initial.x, law.init(half.initial.x, None), jnp.zeros(3)
    return np.asarray(jax.lax.scan(step, start, 0.04 * jnp.arange(1500.0))[1])


t, steps = np.asarray(runs["corrected"].t), 0.04 * np.arange(1500)
curves = {name: (t, np.asarray(run.x)) for name, run in runs.items()}
curves |= {"the program": (steps, program(0.5)), "the program, not cut": (steps, program(np.inf))}
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
least = {}
for name, (at, x) in curves.items():
    x_e, y_e = x[:, 0, 1] - np.asarray(jax.vmap(Path().position)(at))[:, 1], 10.0 - x[:, 0, 0]
    room = 3.0 * np.exp(-0.05 * at) + np.array([[0.8], [0.5]]) - np.abs([x_e, y_e])
    least[name] = [float(number) for number in (x_e.min(), y_e.min(), room.min())]
    for panel, curve in zip(axes, (x_e, y_e, x[:, 1, 2]), strict=True):
        panel.plot(at, curve, label=name)
    print(f"{name}: least x_e, y_e and margin {np.round(least[name], 3)} m")
for panel, label in zip(axes, ("$x_e$ [m]", "$y_e$ [m]", "$r$ [rad/s]"), strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label, xlim=(0.0, 20.0))
axes[1].legend(fontsize="x-small")
reached = dict(zip(("least x_e [m]", "least y_e [m]"), least["the program"], strict=False))
holds = {"the errors stay inside their bounds": min(case[2] for case in least.values()) > 0.0}
x = curves["printed v sin(psi_e/2)"][1]
psi_e, evidence = x[:, 0, 2] - np.pi / 2, {"free": least["the program, not cut"][1]}
evidence["left"] = float(np.abs(x[:, 1, 1] * (np.sin(psi_e) - np.sin(psi_e / 2.0))).max())
evidence["cut"] = least["the program"][1]
