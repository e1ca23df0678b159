"""Adaptive cruise control, sampled (Xiao and Belta 2022): a force that is held for 0.1 s keeps the
distance to a slower car, and a term for braking in the barrier function keeps the force small.

The car starts 100 m behind a car of 13.89 m/s with 20 m/s and wants 30 m/s.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

LEAD, WANTED, HEADWAY, MASS, START = 13.89, 30.0, 1.8, 1650.0, 100.0
WEIGHT = MASS * 9.81
SHARE = 0.4


@ij.component
class Car:
    """x' = v, mass v' = u."""

    mass: ij.Leaf = ij.leaf("kg", sign="positive", shape="scalar", default=MASS)
    n, order, units, input_name = 1, 2, ("m", "m/s", "N"), "wheel force"
    level_names = ("position", "speed")

    def drift(self, t, x):
        """Zero."""
        return jnp.zeros_like(x)

    def gain(self, t, x):
        """1 and 1/mass."""
        one = jnp.ones_like(x[0])
        return jnp.stack([one, one / self.mass])


@ij.component
class Behind:
    """The position at the distance HEADWAY LEAD = 25.0 m."""

    def position(self, t):
        """(1,) [m]."""
        return jnp.stack([START - HEADWAY * LEAD + LEAD * t])


# %% The programme: least (u/mass)^2 + delta^2 with V' <= -10 V + delta for V = (v - 30)^2, b' >= -b
# and u <= 0.4 mass g. Its least cost over delta is convex in u, so that the solution is the one
# without the other conditions, cut to an interval.
@ij.component
class CruiseProgramme:
    """u of the quadratic programme; an infinite `braking` leaves its distance out of b."""

    braking: ij.Leaf = ij.leaf("m/s^2", sign="positive", shape="scalar", default=SHARE * 9.81)
    receives_x = True
    uses_observer = False
    gains = ()

    def command(self, t, x, d_hat, context, state):
        """The wheel force."""
        v, mass = x[1], context.model.mass
        z, faster = START + LEAD * t - x[0], v - LEAD
        slope = 2.0 * (v - WANTED)
        wanted = -10.0 * slope * (v - WANTED) ** 2 / (1.0 + slope**2)
        b = z - HEADWAY * v - faster**2 / (2.0 * self.braking)
        highest = jnp.minimum((b - faster) / (HEADWAY + faster / self.braking), SHARE * 9.81)
        u = mass * jnp.minimum(wanted, highest)
        zero, inside = jnp.zeros_like(u), jnp.zeros(u.shape, bool)
        cut = u >= SHARE * WEIGHT
        return ij.controllers.Command(u, context.tube(t).dq_d, zero, inside, cut), ()


constraints = {
    "distance less 1.8 v [m]": lambda t, x: START + LEAD * t - x[0] - HEADWAY * x[1],
}
reach = HEADWAY * LEAD
scenario = ij.Scenario(
    plant=Car(),
    reference=Behind(),
    bounds=ij.Bounds(
        lower=ij.bounds.Funnel(-150.0, -150.0, 0.0), upper=ij.bounds.Funnel(reach, reach, 0.0)
    ),
    controller=CruiseProgramme(),
    sampling=ij.Sampling(period=0.1),
    initial=ij.Initial(x=[[0.0], [20.0]]),
)
cases = {
    "with the distance for braking": scenario,
    "without": ij.with_parameters(scenario, {"controller.braking": 1e9}),
}
runs = {name: ij.simulate(case, duration=30.0, dt=2e-3) for name, case in cases.items()}

# %% The speed, the force, and the distance beyond 1.8 v, as in the figure of the program.
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
room, share, speed = {}, {}, {}
for name, run in runs.items():
    t, v, u = (np.asarray(part).squeeze() for part in (run.t, run.x[:, 1], run.tau))
    speed[name], share[name] = v, u / WEIGHT
    room[name] = START + LEAD * t - np.asarray(run.x[:, 0, 0]) - HEADWAY * v
    for panel, curve in zip(axes, (v, share[name], room[name]), strict=True):
        panel.plot(t, curve, label=name)
    print(
        f"{name}: {ij.Status(int(run.status))!r}, v to {v.max():.4f}, at the end {v[-1]:.5f} m/s,"
    )
    print(f"   u/(m g) from {share[name].min():.4f} to {share[name].max():.4f},", end=" ")
    print(f"least z - 1.8 v {room[name].min():.2e} m")
for panel, lines in zip(axes, ((LEAD, WANTED), (-SHARE, SHARE), (0.0,)), strict=True):
    for line in lines:
        panel.axhline(line, color="k", linestyle=":", linewidth=0.8)
labels = "$v$ [m/s]", "$u/(m g)$ [1]", "$z - 1.8 v$ [m]"
for panel, label in zip(axes, labels, strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label, xlim=(0.0, 20.0))
axes[0].legend(fontsize="x-small")

published = "with the distance for braking"
distance = "the distance stays above 1.8 v in both modes"
limited = "with the distance for braking the force stays within 0.4 m g"
slow = "the speed stays below the desired speed and ends at that of the leading car"
holds = {
    distance: all(free.min() >= 0.0 for free in room.values()),
    limited: bool(np.abs(share[published]).max() <= SHARE * (1.0 + 1e-9)),
    slow: all(v.max() < WANTED and abs(v[-1] - LEAD) < 1e-3 for v in speed.values()),
}
details = {
    distance: f"least z - 1.8 v: {min(free.min() for free in room.values()):.1e} m",
    limited: f"u/(m g) from {share[published].min():.4f} to {share[published].max():.4f}; without"
    f" the distance from {share['without'].min():.4f}",
    slow: f"at the end within {max(abs(v[-1] - LEAD) for v in speed.values()):.1e} m/s of 13.89",
}
