"""Adaptive cruise control by a quadratic programme: a car approaches its desired speed as far as a
barrier function of the distance to a slower car and the limits of the wheel force allow.

The car starts 100 m behind a car of 14 m/s with 20 m/s and wants 24 m/s. The condition z >= 1.8 v
on the distance z is tightened by the distance that braking with 0.3 g to 14 m/s needs.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

LEAD, WANTED, HEADWAY, MASS = 14.0, 24.0, 1.8, 1650.0
BRAKING = 0.3 * 9.81
LIMIT = MASS * BRAKING


@ij.component
class Car:
    """mass v' = u - f0 - f1 v - f2 v^2."""

    mass: ij.Leaf = ij.leaf("kg", sign="positive", shape="scalar", default=MASS)
    f0: ij.Leaf = ij.leaf("N", shape="scalar", default=0.1)
    f1: ij.Leaf = ij.leaf("N s/m", shape="scalar", default=5.0)
    f2: ij.Leaf = ij.leaf("N s^2/m^2", shape="scalar", default=0.25)
    n, order, units, input_name = 1, 2, ("m", "m/s", "N"), "wheel force"
    level_names = ("position", "speed")

    def resistance(self, v):
        """The resistance of the road and of the air, (1,) [N]."""
        return self.f0 + self.f1 * v + self.f2 * v**2

    def drift(self, t, x):
        """Zero, and the resistance over the mass."""
        return jnp.stack([jnp.zeros_like(x[0]), -self.resistance(x[1]) / self.mass])

    def gain(self, t, x):
        """1 and 1/mass."""
        return jnp.stack([jnp.ones_like(x[0]), jnp.ones_like(x[0]) / self.mass])


@ij.component
class Behind:
    """The position at the distance HEADWAY LEAD = 25.2 m."""

    def position(self, t):
        """(1,) [m]."""
        return jnp.stack([100.0 - HEADWAY * LEAD + LEAD * t])


# %% The programme: least (u/mass)^2 + delta^2/100 with V' <= -5 V + delta for V = (v - 24)^2,
# B' >= -5 B for B = z - 1.8 v - (14 - v)^2/(2 . 0.3 g), and |u| <= 0.3 mass g. It has one unknown
# besides delta, so its solution is that without the barrier, cut to an interval.
def barrier(x, t, braking=BRAKING):
    """B, (1,) [m]; without the distance of braking for an infinite braking."""
    return 100.0 + LEAD * t - x[0] - HEADWAY * x[1] - (LEAD - x[1]) ** 2 / (2.0 * braking)


@ij.component
class CruiseProgramme:
    """u of the quadratic programme, with or without the distance of braking in B."""

    clf_rate: ij.Leaf = ij.leaf("1/s", sign="positive", shape="scalar", default=5.0)
    rate: ij.Leaf = ij.leaf("1/s", sign="positive", shape="scalar", default=5.0)
    braking: ij.Leaf = ij.leaf("m/s^2", sign="positive", shape="scalar", default=BRAKING)
    limited: bool = ij.static(default=True)
    receives_x = True
    uses_observer = False
    gains = ()

    def command(self, t, x, d_hat, context, state):
        """The wheel force."""
        v, mass, natural = x[1], context.model.mass, context.model.drift(t, x)[1]
        slope = 2.0 * (v - WANTED)
        excess = slope * natural + self.clf_rate * (v - WANTED) ** 2
        u = -mass * jnp.where(excess > 0.0, slope * excess / (100.0 + slope**2), 0.0)
        per_speed = HEADWAY + (v - LEAD) / self.braking
        needed = LEAD - v + self.rate * barrier(x, t, self.braking)
        u = jnp.minimum(u, mass * (needed / per_speed - natural))
        if self.limited:
            u = jnp.clip(u, -LIMIT, LIMIT)
        zero, inside = jnp.zeros_like(u), jnp.zeros(u.shape, bool)
        return ij.controllers.Command(
            u, context.tube(t).dq_d, zero, inside, jnp.abs(u) >= LIMIT
        ), ()


constraints = {"distance less 1.8 v [m]": lambda t, x: barrier(x, t, jnp.inf)}
reach = HEADWAY * LEAD
scenario = ij.Scenario(
    plant=Car(),
    reference=Behind(),
    bounds=ij.Bounds(
        lower=ij.bounds.Funnel(-150.0, -150.0, 0.0), upper=ij.bounds.Funnel(reach, reach, 0.0)
    ),
    controller=CruiseProgramme(),
    initial=ij.Initial(x=[[0.0], [20.0]]),
)
short = {"controller.braking": 1e9}
cases = {
    "published barrier": scenario,
    "z >= 1.8 v alone, limited": ij.with_parameters(scenario, short),
    "z >= 1.8 v alone, any force": ij.with_parameters(
        ij.with_parts(scenario, controller=CruiseProgramme(limited=False)), short
    ),
}
runs = {name: ij.simulate(case, duration=15.0, dt=1e-3) for name, case in cases.items()}

# %% The speed, the distance beyond 1.8 v, and the force.
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
room, force = {}, {}
for name, run in runs.items():
    t, v, u = (np.asarray(part).squeeze() for part in (run.t, run.x[:, 1], run.tau))
    free = 100.0 + LEAD * t - np.asarray(run.x[:, 0, 0]) - HEADWAY * v
    room[name], force[name] = free.min(), u
    for panel, curve in zip(axes, (v, free, u / (MASS * 9.81)), strict=True):
        panel.plot(t, curve, label=name)
    print(f"{name}: least z - 1.8 v {free.min():.4f} m, v to {v.max():.3f}, at the end", end=" ")
    print(
        f"{v[-1]:.4f} m/s, u/(m g) from {u.min() / MASS / 9.81:.4f} to {u.max() / MASS / 9.81:.4f}"
    )
labels = "$v$ [m/s]", "$z - 1.8 v$ [m]", "$u/(m g)$ [1]"
for panel, label in zip(axes, labels, strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label)
axes[2].set(ylim=(-0.45, 0.45))
axes[1].legend(fontsize="x-small")
reached = {}
published = "published barrier"
holds = {
    "the distance stays above 1.8 v": bool(room[published] >= 0.0),
    "the wheel force stays within 0.3 m g": bool(np.abs(force[published]).max() <= 1.0001 * LIMIT),
}
