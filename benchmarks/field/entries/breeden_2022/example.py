"""Docking of a spacecraft: a quadratic programme of barrier functions drives it along its orbit to
the target, in a corridor of 3 cm, and touches at a speed between 0.07 and 0.12 m/s.

The chaser starts 10 km behind the target on the same circular orbit of 400 km altitude. x_1 is the
radial and x_2 the tangential distance in the rotating frame of the target.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

RATE = float(np.sqrt(398600e9 / 6778e3**3))
U_MAX, W_U, W_X, SLOWEST, FASTEST, CORRIDOR, V_MAX = 0.082, 0.002, 0.001, 0.07, 0.12, 0.03, 10.0
BRAKING = U_MAX - 2.0 * RATE * V_MAX - W_U
SIDEWAYS = U_MAX - 2.0 * RATE * V_MAX - 3.0 * RATE**2 * 10e3
DELTA = FASTEST**2 / 2.0
EPSILON = (DELTA - 0.5 * (2.0 * W_X + SLOWEST) ** 2) / BRAKING / 2.0
ANGLE = 2.0 * np.arcsin(5e3 / 6778e3)
START = 6778e3 * np.array([np.cos(ANGLE) - 1.0, -np.sin(ANGLE)])


@ij.component
class RelativeMotion:
    """The motion relative to a target on a circular orbit; the thrust is that for a mass of 1."""

    mass: ij.Leaf = ij.leaf("1", sign="positive", shape="scalar", default=1.0)
    n, order, units = 2, 2, ("m", "m/s", "m/s^2")

    def drift(self, t, x):
        """Zero, and the accelerations of the rotating frame."""
        radial = 3.0 * RATE**2 * x[0, 0] + 2.0 * RATE * x[1, 1]
        return jnp.stack([jnp.zeros_like(x[0]), jnp.stack([radial, -2.0 * RATE * x[1, 0]])])

    def gain(self, t, x):
        """1 and 1/mass."""
        return jnp.stack([jnp.ones_like(x[0]), jnp.ones_like(x[0]) / self.mass])


# %% Every constraint of the published quadratic programme concerns one component of the thrust, so
# its solution is the nominal thrust, cut to an interval. A side is H <= 0 with the distance that
# braking needs; H' may grow by no more than worst (-H/width), whatever the disturbances are.
def braked(h, speed, braking, width, natural, delta=0.0):
    """The largest acceleration towards a side, for h and h' = speed, and H [m]."""
    fast = speed + W_X
    H = h + fast * jnp.abs(fast) / (2.0 * braking) - delta / braking
    share = jnp.abs(fast) / braking
    worst = share * W_U + W_X
    room = worst * (-H / width - 1.0) - speed - share * natural
    return jnp.where(share > 0.0, room / jnp.where(share > 0.0, share, 1.0), jnp.inf), H


@ij.component
class DockingProgramme:
    """u nearest to u_nom with H_i' <= alpha_i(-H_i) for all disturbances, and |u_i| <= U_MAX."""

    receives_x = True
    uses_observer = False
    gains = ()

    def command(self, t, x, d_hat, context, state):
        """The thrust."""
        (radial, along), v = x[0], x[1]
        natural = context.model.drift(t, x)[1]
        dock, _ = braked(along, v[1], BRAKING, EPSILON, natural[1], DELTA)
        right, H_right = braked(radial - CORRIDOR, v[0], SIDEWAYS, 0.005, natural[0])
        left, H_left = braked(-radial - CORRIDOR, -v[0], SIDEWAYS, 0.005, -natural[0])
        left = jnp.where((H_left <= 0.0) & (H_right <= 0.0), left, jnp.inf)
        speed = W_U * ((V_MAX - v) / 0.05 - 1.0) - natural
        slow = W_U * ((V_MAX + v) / 0.05 - 1.0) + natural
        none = jnp.full_like(left, -jnp.inf)
        highest = jnp.minimum(jnp.minimum(speed, jnp.stack([right, dock])), U_MAX)
        lowest = jnp.maximum(jnp.maximum(-slow, jnp.stack([-left, none])), -U_MAX)
        u = jnp.clip(jnp.stack([-0.1 * radial, dock]), lowest, highest)
        zero, inside = jnp.zeros_like(u), jnp.zeros(u.shape, bool)
        return ij.controllers.Command(u, zero, zero, inside, jnp.abs(u) >= U_MAX), ()


# %% Other laws need a reference: from rest to 9.95 m/s and back to rest at the target.
@ij.component
class Approach:
    """x_2 = -10 km + 9.95 m/s (the time since 72 s, and until 1077 s), smooth over 20 s."""

    def position(self, t):
        """(0, x_2(t)) [m]."""
        since, until = (jnp.logaddexp(0.0, (t - time) / 20.0) for time in (72.0, 1077.0))
        return jnp.stack([jnp.zeros_like(t), -10e3 + 9.95 * 20.0 * (since - until)])


def funnel(first, last):
    """Bounds from the start to the corridor, and +- 150 m on the way."""
    return ij.bounds.Funnel(
        initial=[first, last], final=[np.sign(last) * CORRIDOR, last], rate=0.05
    )


corridor = ij.Bounds(lower=funnel(-9.0, -150.0), upper=funnel(9.0, 150.0))
speeds = ij.Bounds(ij.bounds.Constant(-V_MAX), ij.bounds.Constant(V_MAX))
scenario = ij.Scenario(
    plant=RelativeMotion(),
    reference=Approach(),
    bounds=(corridor, speeds),
    controller=DockingProgramme(),
    initial=ij.Initial(x=[START, [0.0, 0.0]]),
)
parts = [ij.disturbances.Sinusoids(w, frequency=0.3, phase=[np.pi / 2, 0.0]) for w in (W_X, W_U)]
disturbed = ij.with_parts(scenario, disturbance=ij.disturbances.Levels(parts))
cases = {"undisturbed": scenario, "disturbed": disturbed}
runs = {name: ij.simulate(case, duration=1155.0, dt=0.05) for name, case in cases.items()}

# %% The motion until the target, x_2 = 0, is reached.
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
found = {}
for name, run in runs.items():
    t, x, v, u = (np.asarray(part) for part in (run.t, run.x[:, 0], run.x[:, 1], run.tau))
    docked = float(np.interp(0.0, x[:, 1], t))
    way = t <= docked
    aligned = float(t[way & (np.abs(x[:, 0]) > CORRIDOR)].max())
    found[name] = {
        "time of docking [s]": docked,
        "in the corridor from [s]": aligned,
        "largest speed [m/s]": float(np.abs(v[way]).max()),
        "x2 at 500 s [m]": float(np.interp(500.0, t, x[:, 1])),
        "x1 at 500 s [m]": float(np.interp(500.0, t, x[:, 0])),
        "speed of docking [m/s]": float(np.interp(docked, t, v[:, 1])),
        "largest distance from the axis [m]": float(np.abs(x[way & (t > aligned + 0.1), 0]).max()),
    }
    for panel, curve in zip(axes, (x[:, 0], v[:, 1], u), strict=True):
        labels = name if curve.ndim == 1 else [f"$u_{i}$, {name}" for i in (1, 2)]
        panel.plot(t[way], curve[way], label=labels, linewidth=0.8)
    print(f"{name}: {found[name]}")
for panel, label in zip(axes, ("$x_1$ [m]", "$x_2'$ [m/s]", "$u$ [m/s$^2$]"), strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label)
axes[0].set(ylim=(-0.04, 0.04))
axes[0].hlines([-CORRIDOR, CORRIDOR], 0.0, 1155.0, "k", ":", linewidth=0.8)
axes[1].legend(fontsize="x-small")
axes[2].legend(fontsize="x-small")
reached = dict(list(found["undisturbed"].items())[:5])
*_, fastest, _, _, touch, side = zip(*(case.values() for case in found.values()), strict=True)
inside = SLOWEST <= min(touch) <= max(touch) <= FASTEST
holds = {
    "the speed of docking is between 0.07 and 0.12 m/s": inside,
    "the chaser stays in the corridor": max(side) <= CORRIDOR,
    "no speed exceeds 10 m/s": max(fastest) <= V_MAX,
}
