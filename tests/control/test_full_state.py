"""`BarrierBackstepping` with bounds on velocities: formulas, jumps, (F.2) and the claim (F.3)."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from claim_terms import terms_at
from independent import Loop, sine
from members import two_barriers
from scipy.integrate import solve_ivp

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers
from iblf_jax.certificates.terms import rounding
from iblf_jax.simulation.closed_loop import initial_state

H = np.pi / 2


@dataclasses.dataclass
class FullLoop(Loop):
    """The independent loop under the full-state law with integral barriers; K2 in 1/s."""

    c: np.ndarray = dataclasses.field(default_factory=lambda: np.full(2, 1.0))
    slowest: tuple = ((-1.6, -1.4), (-0.1, 0.0), 1.0, 0.0)
    fastest: tuple = ((0.6, 0.5), (0.1, 0.0), 1.0, H)
    push: tuple = (0.0, 0.0)
    """A constant torque that the law does not know."""

    def full(self, t, x, above=None):
        """The rate of (q, q', eta), the torque, V1 + phi of each joint, and e2; `above`: the side
        of e2 = 0 of the torque, joint by joint, if it is not the state's own."""
        q, v, eta = x[:2], x[2:4], x[4:]
        M, C, G, dM = self.arm(q)
        e1, k, alpha, dalpha = self.virtual(t, q, v)
        s1, e2 = 2 * e1 / (k**2 - e1**2), v - alpha
        (vl, dvl, _), (vu, dvu, _) = sine(*self.slowest)(t), sine(*self.fastest)(t)
        Ku, Kl = vu - alpha, alpha - vl
        K = np.where(e2 > 0 if above is None else above, Ku, Kl)
        s2 = 2 * e2 / (K**2 - e2**2)
        kappa2 = np.sqrt(((dvu - dalpha) / Ku) ** 2 + ((dalpha - dvl) / Kl) ** 2 + self.o)
        w = -(self.K2 + kappa2) * e2 - s1 * (K**2 - e2**2) / 2 - self.c * s2
        f_hat = eta + self.kf * (M @ v)
        tau = C(v) @ v + G + M @ (dalpha + w) - f_hat
        ddq = self.acceleration(q, v, tau + self.disturbance(t, q, v) + self.push)
        deta = -self.kf * (f_hat + tau - C(v) @ v - G + dM * v[1] @ v)
        V1 = -np.log(1 - (e1 / k) ** 2) - np.log(1 - (e2 / K) ** 2)
        return np.concatenate([v, ddq, deta]), tau, V1, e2

    @classmethod
    def random(cls, rng, **given):
        ranges = {"k1": (1, 3), "K2": (8, 25), "c": (0.3, 2), "o": (0.05, 0.3)}
        gains = {name: rng.uniform(*ends, 2) for name, ends in ranges.items()}
        sizes = -rng.uniform(1.5, 2.0, 2), rng.uniform(-0.1, 0.1, 2)
        slowest = (*sizes, rng.uniform(0.5, 2.0), rng.uniform(0, 6, 2))
        fastest = (rng.uniform(0.9, 1.5, 2), rng.uniform(-0.1, 0.1, 2), 1.0, rng.uniform(0, 6, 2))
        lower = (rng.uniform(0.1, 0.2, 2), 0.14, 1.0, (H, 0.0))
        speeds = {"slowest": slowest, "fastest": fastest}
        return cls(**gains, kf=rng.uniform(10, 25, 2), lower=lower, **speeds, **given)

    @property
    def scenario(self):
        return dataclasses.replace(
            ij.presets.zhang_yan_2024(variant="corrected"),
            controller=two_barriers(self.k1, self.K2, self.c, o=(self.o, self.o)),
            observer=ij.observers.Momentum(kf=self.kf),
            bounds=(
                bounds.Bounds(bounds.Sinusoid(*self.lower), bounds.Sinusoid(*self.upper)),
                bounds.Bounds(bounds.Sinusoid(*self.slowest), bounds.Sinusoid(*self.fastest)),
            ),
            initial=ij.Initial(self.q0, self.dq0),
        )


def tubes_of(law, t, q, dq, context):
    """The tube of q around the reference, and that of q' around alpha."""
    return law.levels(t, jnp.stack([q, dq]), jnp.zeros(2), context, ())[1]


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0, 0, 0))
def states_at(scenario, t, xi, xi2, eta):
    """States at relative errors xi and xi2, and the distance of alpha from its bounds."""
    law, context = scenario.controller, scenario.context
    tube = context.tube(t)
    q = tube.q_d + xi * jnp.where(xi > 0, tube.k_u, tube.k_l)
    inner = tubes_of(law, t, q, jnp.zeros(2), context)[1]  # alpha and K do not depend on q'
    dq = inner.q_d + xi2 * jnp.where(xi2 > 0, inner.k_u, inner.k_l)
    state = initial_state(scenario)._replace(x=jnp.stack([q, dq]), observer=eta)
    return state, jnp.minimum(inner.q_d - inner.lower, inner.upper - inner.q_d)


def random_states(scenario, count=64, seed=0):
    """Times and states of the loop inside both pairs of bounds, e1 and e2 up to 0.95 of theirs."""
    rng = np.random.default_rng(seed)
    t, (xi, xi2) = rng.uniform(0, 10, count), rng.uniform(-0.95, 0.95, (2, count, 2))
    states, room = states_at(scenario, t, xi, xi2, rng.normal(size=(count, 2)))
    keep = np.min(room, axis=1) > 0.05
    return jnp.asarray(t[keep]), jax.tree.map(lambda x: x[keep], states)


@pytest.mark.slow
def test_the_torque_is_the_independent_one_at_random_gains_bounds_and_states(rng):
    @jax.jit
    @partial(jax.vmap, in_axes=(None, 0, 0))
    def torque(scenario, t, state):
        f_hat = scenario.observer.estimate(t, state.q, state.dq, scenario.model, state.observer)
        command = scenario.controller.command(t, state.x, f_hat, scenario.context, ())[0]
        return command.tau, command.V1

    for _ in range(5):
        loop = FullLoop.random(rng)
        scenario = loop.scenario
        t, states = random_states(scenario, seed=int(rng.integers(1 << 30)))
        tau, V1 = torque(scenario, t, states)
        rows = np.hstack([states.q, states.dq, states.observer])
        others = [loop.full(*x) for x in zip(np.asarray(t), rows, strict=True)]
        np.testing.assert_allclose(tau, [x[1] for x in others], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(V1, [x[2] for x in others], rtol=1e-9)


FAMILY = {name: cls() for name, cls in barriers.MEMBERS.items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second", "weight"),
    [("integral", "integral", 1.0), ("tan", "mapping", [0.2, 6.0])],
)
def test_any_two_barriers_keep_their_inequality_at_every_state(first, second, weight):
    """(F.2) with V1 = sum w_i V1_i, with the exact rates of the whole loop."""
    both = FAMILY[first], FAMILY[second]
    law = two_barriers([2.0, 1.5], [20.0, 12.0], [1.0, 0.3], *both, weight)
    scenario = dataclasses.replace(ij.presets.zhang_yan_2024_full_state(kf=20.0), controller=law)
    t, states = random_states(scenario)
    proof = jax.jit(jax.vmap(lambda t, state: terms_at(scenario, t, state)))(t, states)
    assert not np.any(proof.excluded)
    allowed = rounding("float64") * np.asarray(proof.size)
    assert np.all(proof.claims["matched"].left <= allowed)
    assert np.median(allowed / np.abs(proof.dV)) < 1e-10  # small beside what it judges

    @jax.jit
    @jax.vmap
    def values(t, q, dq):
        outer, inner = tubes_of(law, t, q, dq, scenario.context)
        return law.barriers[0].value(outer, q), law.barriers[1].value(inner, dq)

    V1, phi = values(t, states.q, states.dq)
    expected = np.sum(V1 * np.array(weight) + phi + 0.5 * proof.d_tilde**2, axis=1)
    np.testing.assert_allclose(proof.V, expected, rtol=1e-9)


class Pieces:
    """The independent loop from event to event of e2_i = 0: each joint above 0, below it, or (None)
    sliding along it; `push`: time and size of a torque that appears during the run."""

    def __init__(self, loop, duration, push=None):
        self.loop, self.passed = loop, []
        time, size = push or (duration, (0.0, 0.0))
        t, x = 0.0, np.concatenate([loop.q0, loop.dq0, np.zeros(4)])
        self.mode = [bool(e2) for e2 in loop.full(0.0, x[:6])[3] > 0]
        while t < time:
            t, x = self.until_an_event(t, x, time)
        self.loop = dataclasses.replace(loop, push=size)
        while t < duration:
            t, x = self.until_an_event(t, x, duration)
        self.q, self.dq, (self.ise, self.effort) = x[:2], x[2:4], x[6:]

    def at(self, t, x, above):
        """Rate of the state and of the integrals of |e1|^2 and |tau|^2."""
        rate, tau, _, _ = self.loop.full(t, x[:6], above)
        e1 = x[:2] - sine(*self.loop.reference)(t)[0]
        return np.concatenate([rate, [e1 @ e1, tau @ tau]])

    def e2(self, t, x):
        return self.loop.full(t, x[:6], np.zeros(2, bool))[3]

    def approach(self, t, x, rate, h=1e-6):
        return (self.e2(t + h, x + h * rate) - self.e2(t - h, x - h * rate)) / (2 * h)

    def rate(self, t, x, mode):
        """The rate in a mode, and of a sliding joint the share of that from above (Filippov)."""
        above = np.array([side is True for side in mode])
        below = self.at(t, x, above)
        if None not in mode:
            return below, None
        joint = mode.index(None)
        above[joint] = True
        beyond = self.at(t, x, above)
        toward = [self.approach(t, x, rate)[joint] for rate in (below, beyond)]
        share = toward[0] / (toward[0] - toward[1])
        return below + share * (beyond - below), share

    def until_an_event(self, t, x, duration):
        mode, events = self.mode, []

        def event(function, direction, joint, new):
            function.terminal, function.direction = True, direction
            events.append((function, joint, new))

        for joint, side in enumerate(mode):
            if side is None:
                event(lambda t, x: self.rate(t, x, mode)[1], -1, joint, False)
                event(lambda t, x: self.rate(t, x, mode)[1] - 1.0, 1, joint, True)
            else:
                event(lambda t, x, i=joint: self.e2(t, x)[i], -1 if side else 1, joint, not side)
        how = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-12, "max_step": 0.02}
        how["events"] = [e[0] for e in events]
        found = solve_ivp(lambda t, x: self.rate(t, x, mode)[0], (t, duration), x, **how)
        t, x = found.t[-1], found.y[:, -1]
        if t == duration:
            return t, x
        for (_, joint, new), times in zip(events, found.t_events, strict=True):
            if len(times):
                after = [*mode[:joint], new, *mode[joint + 1 :]]
                onwards = self.approach(t, x, self.rate(t, x, after)[0])[joint]
                slides = mode[joint] is not None and (onwards > 0) != new
                self.mode = [*mode[:joint], None, *mode[joint + 1 :]] if slides else after
                self.passed.append((joint, self.mode[joint]))
        beyond = min(t + 1e-7, duration)  # off the surface, where the event would be found again
        return beyond, x + (beyond - t) * self.rate(t, x, self.mode)[0]


GAINS = {"k1": 2.0, "K2": 12.0, "c": 1.0, "kf": 100.0}
PATHS = ("controller.k[0]", "controller.k[1]", "controller.c[1]", "observer.kf")


def pieces(duration, **gains):
    """The run in pieces at these gains, the same on both joints."""
    gains = {name: np.full(2, x) for name, x in (GAINS | gains).items()}
    return Pieces(FullLoop(q0=(0.62, 0.55), dq0=(-0.3, 0.2), **gains), duration)


def slopes_in_pieces(duration, **gains):
    """Differences of runs in pieces by k1, K2, c and kf; of |e1|^2's integral, |tau|^2's, and q."""
    found = []
    for name, x in (GAINS | gains).items():
        ends = [pieces(duration, **gains | {name: x + h}) for h in (1e-3 * x, -1e-3 * x)]
        assert ends[0].passed == ends[1].passed
        up, down = (np.array([end.ise, end.effort, *end.q]) for end in ends)
        found.append((up - down) / (2e-3 * x))
    return np.array(found).T


def outcome_by(duration, dt):
    scenario = FullLoop(q0=(0.62, 0.55), dq0=(-0.3, 0.2)).scenario

    def outcome(gains):
        values = {path: jnp.full(2, x) for path, x in zip(PATHS, gains, strict=True)}
        run = ij.simulate(ij.with_parameters(scenario, values), duration=duration, dt=dt)
        ise = jnp.trapezoid(jnp.sum(run.e1**2, axis=1), dx=dt)
        return jnp.array([ise, run.metrics["effort"], *run.q[-1]])

    return outcome


@pytest.mark.slow
def test_derivatives_across_the_jumps_are_those_of_runs_in_pieces():
    assert pieces(0.2).passed == [(0, True), (1, True), (0, False)]
    true, gains = slopes_in_pieces(0.2), jnp.array([*GAINS.values()])
    outcome = outcome_by(0.2, 1e-3)
    found = np.asarray(jax.jacfwd(outcome)(gains))
    np.testing.assert_allclose(jax.grad(lambda x: outcome(x)[0])(gains), found[0], rtol=1e-12)
    np.testing.assert_allclose(found[0], true[0], rtol=0.01)
    np.testing.assert_allclose(found[1], true[1], rtol=0.03, atol=5e-4 * np.max(np.abs(true[1])))
    np.testing.assert_allclose(found[2:], true[2:], rtol=0.01, atol=2e-3 * np.max(np.abs(true[2:])))


@pytest.mark.slow
def test_a_disturbance_and_the_command_jump_in_one_step():
    """Joint 0 crosses e2 = 0 at 3.3 ms, in the step of 1 ms in which a disturbance appears."""
    time, size = 0.00366, (3.0, -1.0)
    loop = FullLoop(q0=(0.62, 0.55), dq0=(-0.3, 0.2), K2=np.full(2, 12.0), kf=np.full(2, 100.0))
    scenario, step = loop.scenario, ij.disturbances.Step(size=list(size), time=time)
    both = ij.disturbances.Sum((scenario.disturbance, step))
    scenario = ij.with_parts(scenario, disturbance=both)

    def integrals(values):
        k1 = {"controller.k[0]": jnp.full(2, values[1])}
        changed = ij.with_parameters(scenario, {"disturbance.parts[1].time": values[0]} | k1)
        metrics = ij.simulate(changed, duration=0.03, dt=1e-3).metrics
        return jnp.array([jnp.sum(metrics.ise), metrics.effort])

    def true(time, k1):
        run = Pieces(dataclasses.replace(loop, k1=np.full(2, k1)), 0.03, (time, size))
        assert run.passed == [(0, True)]
        return np.array([run.ise, run.effort])

    by_time = (true(time + 2e-6, 2.0) - true(time - 2e-6, 2.0)) / 4e-6
    by_k1 = (true(time, 2.002) - true(time, 1.998)) / 4e-3
    found = jax.jacfwd(integrals)(jnp.array([time, 2.0]))
    np.testing.assert_allclose(found, np.stack([by_time, by_k1], axis=1), rtol=0.02)


@pytest.mark.slow
def test_where_e2_slides_along_0_derivatives_are_those_of_the_sliding_motion():
    assert pieces(0.25, kf=20.0).passed == [(0, True), (1, None), (1, True)]
    true = slopes_in_pieces(0.25, kf=20.0)
    found = jax.jacfwd(outcome_by(0.25, 1e-3))(jnp.array([*(GAINS | {"kf": 20.0}).values()]))
    np.testing.assert_allclose(found[0], true[0], rtol=0.02)
    np.testing.assert_allclose(found[1], true[1], rtol=0.1)


@pytest.mark.parametrize("name", sorted(FAMILY.keys() - {"quadratic"}))
def test_a_barrier_states_whether_its_ratio_jumps(name):
    tube = bounds.Tube(*np.array([[0.0], [0.0], [-1.0], [2.0], [0.0], [0.0]]))
    ratio = jax.jit(FAMILY[name].error_over_slope)
    left, right = (ratio(tube, np.array([e])) for e in (-1e-9, 1e-9))
    assert bool(abs(left - right)[0] > 1e-6) == FAMILY[name].ratio_jumps
    law = two_barriers(second=FAMILY[name])
    scenario = ij.with_parts(ij.presets.zhang_yan_2024_full_state(), controller=law)
    x = jnp.stack([scenario.initial.q, scenario.initial.dq])
    for each in (law, controllers.Saturated(law=law, limit=50.0)):
        found = jax.eval_shape(each.switching, 0.0, x, x[0], scenario.context, ())
        assert (found is not None) == FAMILY[name].ratio_jumps
