"""Adaptive cruise control by a zeroing barrier function (after Ames et al. 2017): a quadratic
programme holds the speed of a car as far as a barrier function of the distance to a slower car
permits.

The car starts 100 m behind a car of 14 m/s with 20 m/s. The programme asks that V = (v - 24)^2
does not grow, and that h = z - 1.8 v - (14 - v)^2/(2 . 0.3 g) decays with at most 0.1 1/s. The
results of the program are vector graphics, from which speeds can be read to 1e-5 m/s.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

LEAD, WANTED, HEADWAY, MASS, RATE, STEP = 14.0, 24.0, 1.8, 1650.0, 0.1, 0.02
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

    def drift(self, t, x):
        """Zero, and the resistance over the mass."""
        resistance = self.f0 + self.f1 * x[1] + self.f2 * x[1] ** 2
        return jnp.stack([jnp.zeros_like(x[0]), -resistance / self.mass])

    def gain(self, t, x):
        """1 and 1/mass."""
        return jnp.stack([jnp.ones_like(x[0]), jnp.ones_like(x[0]) / self.mass])


@ij.component
class Behind:
    """The position at the distance HEADWAY LEAD = 25.2 m."""

    def position(self, t):
        """(1,) [m]."""
        return jnp.stack([100.0 - HEADWAY * LEAD + LEAD * t])


def room(t, x):
    """The distance less 1.8 v, (1,) [m]."""
    return 100.0 + LEAD * t - x[0] - HEADWAY * x[1]


# %% The programme has one unknown beside delta, so that its solution is that without conditions on
# the distance, cut to their limits.
@ij.component
class CruiseProgramme:
    """u of the quadratic programme, with either condition on the distance or both."""

    sign: ij.Leaf = ij.leaf("1", shape="scalar", default=0.0)  # of 14 - v; 0 without the condition
    ahead: ij.Leaf = ij.leaf("1", shape="scalar", default=1.0)  # whether h contains the braking
    braking: bool = ij.static(default=True)  # the condition with the braking distance
    receives_x = True
    uses_observer = False
    gains = ()

    def command(self, t, x, d_hat, context, state):
        """The wheel force."""
        v, mass, natural = x[1], context.model.mass, context.model.drift(t, x)[1]
        slope, excess = 2.0 * (v - WANTED), 2.0 * (v - WANTED) * natural
        u = -mass * jnp.where(excess > 0.0, 10.0 * slope * excess / (1.0 + 10.0 * slope**2), 0.0)
        h = room(t, x) - self.ahead * (LEAD - v) ** 2 / (2.0 * BRAKING)
        distance = (self.sign * (LEAD - v) + RATE * h) / HEADWAY - natural
        u = jnp.where(self.sign == 0.0, u, jnp.minimum(u, mass * distance))
        if self.braking:
            ahead = HEADWAY + (v - LEAD) / BRAKING
            u = jnp.minimum(u, mass * ((LEAD - v + RATE * h) / ahead - natural))
        u = jnp.clip(u, -LIMIT, LIMIT)
        no = jnp.zeros(u.shape, bool)
        return ij.controllers.Command(u, context.tube(t).dq_d, 0.0 * u, no, jnp.abs(u) >= LIMIT), ()


constraints = {"distance less 1.8 v [m]": room}
side, reach = ij.bounds.Funnel, HEADWAY * LEAD
scenario = ij.Scenario(
    plant=Car(),
    reference=Behind(),
    bounds=ij.Bounds(lower=side(-150.0, -150.0, 0.0), upper=side(reach, reach, 0.0)),
    controller=CruiseProgramme(),
    initial=ij.Initial(x=[[0.0], [20.0]]),
    sampling=ij.Sampling(period=STEP),
)
laws = {
    "the condition with braking": CruiseProgramme(),
    "first case of the program": CruiseProgramme(sign=-1.0),
    "second case, as its results": CruiseProgramme(ahead=0.0),
    "second case, sign corrected": CruiseProgramme(sign=1.0, ahead=0.0, braking=False),
    "second case, as programmed": CruiseProgramme(sign=-1.0, ahead=0.0, braking=False),
}
cases = {name: ij.with_parts(scenario, controller=law) for name, law in laws.items()}
options = {"duration": 100.0, "dt": STEP, "method": "euler"}
runs = {name: ij.simulate(case, **options) for name, case in cases.items()}

# %% The speed, the distance beyond 1.8 v, and the force.
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
speed, least, force = {}, {}, {}
for name, run in runs.items():
    t, v, u = (np.asarray(part).squeeze() for part in (run.t, run.x[:, 1], run.tau))
    free = 100.0 + LEAD * t - np.asarray(run.x[:, 0, 0]) - HEADWAY * v
    speed[name], least[name], force[name] = v, free.min(), u
    for panel, curve in zip(axes, (v, free, u), strict=True):
        panel.plot(t, curve, label=name)
    print(f"{name}: least z - 1.8 v {free.min():.4f} m, v after 10 s {v[500]:.5f} m/s")
axes[0].plot([10.0, 20.0, 10.0], [16.99355, 15.01478, 17.08039], "ko", fillstyle="none")
axes[0].set(ylabel="speed $v$ [m/s]", ylim=(13.0, 21.0))
axes[1].set(ylabel="$z - 1.8 v$ [m]", ylim=(-5.0, 70.0))
axes[2].set(ylabel="wheel force $u$ [N]", ylim=(-700.0, 300.0))
plt.setp(axes, xlabel="time $t$ [s]", xlim=(0.0, 40.0))
axes[0].legend(fontsize="x-small")

first, second = "first case of the program", "second case, as its results"
reached = {
    "speed after 10 s [m/s]": speed[first][500],
    "speed after 20 s [m/s]": speed[first][1000],
    "least wheel force [N]": force[first][:5000].min(),
    "speed after 10 s, second case [m/s]": speed[second][500],
    "least wheel force, second case [N]": force[second][:5000].min(),
}
largest = max(np.abs(force[name]).max() for name in (first, second))
holds = {
    "the distance stays above 1.8 v": bool(min(least[first], least[second]) > 0.0),
    "the wheel force stays within 0.3 m g": bool(largest <= LIMIT),
}
h = 100.0 - HEADWAY * 20.0 - 36.0 / (2.0 * BRAKING)
evidence = {
    "least_printed": least["second case, as programmed"],
    "least_corrected": least["second case, sign corrected"],
    "first_case": np.abs(speed[first] - speed["the condition with braking"]).max(),
    "off_shown": speed[second][500],
    "off_corrected": speed["second case, sign corrected"][500],
    "h_start": h,
    "B_start": -np.log(h / (1.0 + h)),
    "B_end": np.sqrt(2.0 * RATE * 90.0),
}
