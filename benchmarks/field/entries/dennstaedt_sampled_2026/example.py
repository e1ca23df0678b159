"""Sampled-data funnel control of a mass on a car: a law that is constant for a period, and zero
where the error is small, keeps a constant funnel; a theorem gives its gain and its period.

A mass of 2 kg slides on a ramp of pi/4 on a car of 1 kg, held by a spring and a damper. The
published curve of the input is not the input of the published simulation.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

CAR, MASS, SINE, COSINE = 1.0, 2.0, np.sin(np.pi / 4), np.cos(np.pi / 4)
WIDTH, THRESHOLD, START = 0.15, 0.75, -0.0925


# %% M y" = u - coupling F with F = s + s' for the extension s of the spring; w = s' + y' cos/sin^2
# has no input. The published internal states eta are 0 at the start, which gives s and w there.
@ij.component
@ij.robots.from_energy
class Output:
    """(mass + payload) y" = force."""

    mass: ij.Leaf = ij.leaf("kg", sign="positive", shape="scalar")
    payload: ij.Leaf = ij.leaf("kg", sign="nonnegative", shape="scalar", default=0.0)
    n, joints, kinds = 1, ("y",), ("prismatic",)

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
    """force = u - coupling F, s' = w - y' cos/sin^2, w' = -F/(mass sin^2); states (s, w)."""

    s: ij.Leaf = ij.leaf("m", shape="scalar")
    w: ij.Leaf = ij.leaf("m/s", shape="scalar")

    def init(self, tau):
        """The given state, (2, 1)."""
        return jnp.stack([self.s, self.w])[:, None] * jnp.ones_like(tau)

    def deliver(self, command, dq, state):
        """The force, and the rates of s and w."""
        rate = state[1] - dq * COSINE / SINE**2
        F = state[0] + rate
        force = command - CAR * COSINE / (MASS * SINE**2) * F
        free = jnp.zeros(command.shape, bool)
        return ij.actuators.Delivered(force, free, jnp.stack([rate, -F / (MASS * SINE**2)]))


# %% The law, with e_1 = e/psi and e_2 = e'/psi + e_1/(1 - e_1^2): u = -beta/e_2 where
# |e_2| >= 0.75, else 0, held for a period; for beta = 0 here the continuous -e_2/(1 - e_2^2).
@ij.component
class SampledFunnel:
    """u = -beta/e_2 where |e_2| >= threshold."""

    beta: ij.Leaf = ij.leaf("N", sign="nonnegative", shape="scalar")
    uses_observer = False
    gains = ()

    def command(self, t, q, dq, f_hat, context, state):
        """The force."""
        tube = context.tube(t)
        e1 = (q - tube.q_d) / WIDTH
        e2 = (dq - tube.dq_d) / WIDTH + e1 / (1.0 - e1**2)
        large = jnp.abs(e2) >= THRESHOLD
        held = jnp.where(large, -self.beta / jnp.where(large, e2, 1.0), 0.0)
        u = jnp.where(self.beta > 0.0, held, -e2 / (1.0 - e2**2))
        zero, inside = jnp.zeros_like(q), jnp.zeros(q.shape, bool)
        return ij.controllers.Command(u, tube.dq_d, zero, inside, inside), ()


# %% The theorem: bounds of the errors and of the vector field give beta and the period.
def theorem():
    """The gain [N] and the longest period [s] for y'' = y'/4 + S eta + u/4, eta' = Q eta + P y."""
    e1 = START / WIDTH
    e2 = abs(e1 / (1.0 - e1**2))
    v1 = max(abs(e1), np.sqrt(1.25) - 0.5)
    mu1 = 1.0 + v1 / (1.0 - v1**2)
    gamma = 2.0 * (v1 / (1.0 - v1**2)) ** 2 * mu1 + mu1 / (1.0 - v1**2)
    v2 = max(e2, np.sqrt(0.25 / gamma**2 + 1.0 / gamma) - 0.5 / gamma)
    # Q^T K + K Q = -1 for Q = (0 1; -1 -1) has the solution (1.5 0.5; 0.5 1).
    values = np.linalg.eigvalsh([[1.5, 0.5], [0.5, 1.0]])
    eta = np.sqrt(values[1] / values[0]) * 2.0 * values[1] * np.sqrt(3.0) * (WIDTH + 0.4)
    speed = (v2 + v1 / (1.0 - v1**2)) * WIDTH + 0.2 * np.pi
    field = round(0.25 * speed + np.sqrt(2.0) / np.sqrt(48.0) * eta, 1)
    kappa = (field + 0.1 * np.pi**2) / WIDTH + gamma
    beta = 2.0 * kappa * WIDTH / 0.25
    return beta, min(kappa / (kappa + 0.25 * beta / WIDTH / THRESHOLD) ** 2, 0.25 / kappa)


def case(gain, sampling=None):
    """The published task with a gain and a sampling."""
    return ij.Scenario(
        plant=Output(mass=(CAR + MASS * SINE**2) / SINE**2),
        reference=ij.references.Sinusoid(offset=0.0, amplitude=0.4, frequency=np.pi / 2),
        bounds=ij.Bounds(
            ij.bounds.Funnel(-WIDTH, -WIDTH, 0.0), ij.bounds.Funnel(WIDTH, WIDTH, 0.0)
        ),
        controller=SampledFunnel(gain),
        actuator=Spring(s=-np.sqrt(2.0) * START, w=np.sqrt(2.0) * START),
        sampling=sampling,
        initial=ij.Initial(q=[START], dq=[0.2 * np.pi]),
    )


beta, longest = theorem()
scenario = case(beta, ij.Sampling(period=1.0 / 310))
chosen = case(4.0, ij.Sampling(period=1.0 / 49))
runs = {"theorem": ij.simulate(scenario, duration=1.0, dt=1.0 / 1240)}
runs["chosen"] = ij.simulate(chosen, duration=1.0, dt=1.0 / 980)
runs["continuous"] = ij.simulate(case(0.0), duration=1.0, dt=1e-4)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
reached, inside, inputs = {}, [], {}
for name, run in runs.items():
    t, y, e = (np.asarray(part).squeeze() for part in (run.t, run.q, run.e1))
    s, w = np.moveaxis(np.asarray(run.actuator_state[..., 0]), -1, 0)
    rate = w - np.asarray(run.dq[:, 0]) * COSINE / SINE**2
    u = np.asarray(run.tau[:, 0]) + CAR * COSINE / (MASS * SINE**2) * (s + rate)
    reached |= {f"y at {at:g} s, {name} [m]": float(np.interp(at, t, y)) for at in (0.5, 1.0)}
    reached[f"least input, {name} [N]"] = float(u.min())
    inside.append(bool(np.abs(e).max() < WIDTH))
    inputs[name] = t, u
    axes[0].plot(t, e, label=name)
    axes[1].plot(t, u, linewidth=0.8)
axes[0].hlines([-WIDTH, WIDTH], 0.0, 1.0, "k", ":", linewidth=0.8)
axes[0].set(xlabel="time $t$ [s]", ylabel="error $y - y_{ref}$ [m]")
axes[1].set(xlabel="time $t$ [s]", ylabel="input $u$ [N]", ylim=(-45.0, 45.0))
axes[0].legend(fontsize="x-small")
holds = {"all errors stay inside the funnel": all(inside)}
t, u = inputs["theorem"]
evidence = {"beta": beta, "longest": longest, "period": 1.0 / 310, "largest": float(u.max())}
evidence["begins"] = float(t[u.argmax()])
print({name: round(number, 5) for name, number in (evidence | reached).items()})
