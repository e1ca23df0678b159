"""The sampled loop of a robot with sensors, delay and drive, against programs of SciPy."""

import itertools
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refused import refused
from scipy.integrate import solve_ivp

import iblf_jax as ij
from iblf_jax.core.status import Status
from iblf_jax.engine.period import radius_at
from iblf_jax.engine.step_size import start_and_along
from iblf_jax.simulation.closed_loop import run_sampled_law
from iblf_jax.simulation.noise import noise_key, normals
from iblf_jax.simulation.sampling import Instant, step_commands
from iblf_jax.simulation.scenario import canonical
from iblf_jax.tuning.parameters import layout
from iblf_jax.tuning.ranges import BY_COUNT, BY_PERIOD, TIMES, TOGETHER
from iblf_jax.tuning.result import AtLimit

PAPER = ij.presets.zhang_yan_2024(variant="corrected")
SLOW = ij.with_parameters(PAPER, {"controller.K2": 4.0, "observer.kf": 4.0})
"""Slow enough for a filter and a drive in the loop."""
LIMITS = {"limit": [15.0, 5.0], "stall": [14.0, 6.0], "no_load_speed": [6.0, 8.0]}
MOTOR = ij.actuators.Motor(bandwidth=600.0, rate_limit=900.0, **LIMITS)
OFFSET = np.array([1e-3, -2e-3])
FILTERED = ij.sensors.FilteredDifference(cutoff=700.0)
ENCODER = ij.sensors.Encoder(counts=65536, offset=OFFSET, velocity=FILTERED)


def sampled(base, period, delay=0.0, observer="exact", queue=None, **parts):
    sampling = ij.Sampling(period=period, delay=delay, observer=observer, queue=queue)
    return ij.with_parts(base, sampling=sampling, **parts)


class Independent:
    """A sampled loop by DOP853, from one change of the torque to the next."""

    def __init__(self, scenario):
        self.scenario = scenario
        plant, model, context = scenario.plant, scenario.model, scenario.context

        @jax.jit
        def law(t, q, dq, eta):
            f_hat = eta + scenario.observer.kf * (model.mass_matrix(q) @ dq)
            command, _ = scenario.controller.command(t, q, dq, f_hat, context, ())
            # (3.11), corrected, whose rate is linear in eta
            kf = scenario.observer.kf
            rest = command.tau - model.coriolis(q, dq, dq) - model.gravity(q)
            rest += kf * (model.mass_matrix(q) @ dq)
            moved = jax.jvp(model.mass_matrix, (q,), (dq,))[1] @ dq
            a = jnp.exp(-kf * scenario.sampling.period)
            return command.tau, a * eta - (1 - a) * (rest + moved)

        @jax.jit
        def acceleration(t, q, dq, tau):
            push = scenario.disturbance.torque(t, q, dq, plant, model)
            total = tau + push - plant.coriolis(q, dq, dq) - plant.gravity(q)
            return jnp.linalg.solve(plant.mass_matrix(q), total)

        self.law, self.acceleration = law, acceleration

    def told(self, q, dq):
        return q, dq

    def delivered(self, asked, y, dq):
        """Torque on the joint, and the rate of the drive's state y."""
        return asked, np.zeros(2)

    def run(self, duration, grid):
        s = self.scenario
        T, delay = float(s.sampling.period), float(s.sampling.delay)
        q0 = np.asarray(s.initial.q)
        x, eta = np.concatenate([q0, np.zeros(2), np.asarray(s.model.gravity(q0))]), np.zeros(2)
        commands, states, torques = [(-1.0, x[4:])], [], []
        for k in range(round(duration / T)):
            t = k * T
            u, eta = self.law(t, *self.told(x[:2], x[2:4]), eta)
            commands.append((t + delay, np.asarray(u)))
            changes = [*(c for c, _ in commands), *np.asarray(s.jump_times())]
            cuts = sorted({t, *(c for c in changes if t + 1e-12 < c < t + T - 1e-12), t + T})
            for a, b in itertools.pairwise(cuts):
                asked = [u for c, u in commands if c <= a + 1e-12][-1]

                def rate(t, x, asked=asked, a=a, b=b):
                    tau, dy = self.delivered(asked, x[4:], x[2:4])
                    t = np.clip(t, a + 1e-13, b - 1e-13)  # on this side of a jump
                    return np.concatenate([x[2:4], self.acceleration(t, x[:2], x[2:4], tau), dy])

                inside = grid[(grid >= a - 1e-12) & (grid < b - 1e-12)]
                how = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12}
                found = solve_ivp(rate, (a, b), x, t_eval=np.append(inside, b).clip(a, b), **how)
                new = list(found.y.T[: len(inside)])
                states += new
                torques += [self.delivered(asked, y[4:], y[2:4])[0] for y in new]
                x = found.y[:, -1]
        return np.array(states), np.array(torques)


class WithEncoder(Independent):
    """An encoder without noise and a filtered difference, and a drive with a lag."""

    def __init__(self, scenario):
        super().__init__(scenario)
        self.before, self.v = None, np.zeros(2)

    def told(self, q, dq):
        step = 2 * np.pi / 65536
        y = step * np.round((q + OFFSET) / step)
        T = float(self.scenario.sampling.period)
        a = np.exp(-700.0 * T)
        self.v = a * self.v + (1 - a) * (y - (y if self.before is None else self.before)) / T
        self.before = y
        return y, self.v

    def delivered(self, asked, y, dq):
        return y, 600.0 * (asked - y)


class WithDrive(Independent):
    """The drive `MOTOR`, with all its limits."""

    def delivered(self, asked, y, dq):
        line = np.maximum(np.array([14.0, 6.0]) * (1 - np.abs(dq) / [6.0, 8.0]), 0)
        return np.clip(y, -line, line), np.clip(
            600.0 * (np.clip(asked, [-15.0, -5.0], [15.0, 5.0]) - y), -900.0, 900.0
        )


def agree(scenario, program, duration=0.3, dt=5e-4, q=1e-7, tau=1e-5):
    run = ij.simulate(scenario, duration=duration, dt=dt)
    states, torques = program(scenario).run(duration, np.arange(round(duration / dt)) * dt)
    assert np.max(np.abs(run.q[:-1] - states[:, :2])) < q
    assert np.max(np.abs(run.dq[:-1] - states[:, 2:4])) < 100 * q
    assert np.max(np.abs(run.tau[:-1] - torques)) < tau
    return run


@pytest.mark.parametrize("delay", [0.0, 1.0, 2.6, 3.0, 4.0, 5.4, 8.0, 11.0])
def test_a_command_is_active_from_its_arrival_to_that_of_the_next(delay):
    """tau(t) = tau_k for t_k + delay <= t < t_(k+1) + delay; times in steps, of which a period has
    four, and every command is the number of its sample."""
    newest, dt = 5, 5e-4
    sampling = ij.Sampling(period=4 * dt, delay=delay * dt)
    commands = newest - jnp.arange(sampling.queue + 1.0)[:, None]
    for phase in range(4):
        now = Instant(jnp.int32(newest), jnp.int32(phase))
        found = step_commands(sampling, jnp.asarray(dt), now, commands)
        arrivals = 4.0 * np.arange(newest + 1) + delay - (4 * newest + phase)
        active = np.flatnonzero(arrivals <= 0.0)[-1]
        assert float(found.first[0]) == active
        (coming,) = np.nonzero((arrivals > 0.0) & (arrivals <= 1.0))
        assert bool(found.arrives) == (coming.size == 1)
        if coming.size:
            assert float(found.next[0]) == coming[0]
            assert float(found.arrival) == pytest.approx(arrivals[coming[0]])


@pytest.mark.slow
@pytest.mark.parametrize(("base", "delay"), [(PAPER, 1e-3), (SLOW, 2.7e-3)])
def test_a_sampled_loop_is_that_of_an_independent_program(base, delay):
    agree(sampled(base, 2e-3, delay), Independent)


@pytest.mark.slow
def test_a_disturbance_that_jumps_between_samples_is_that_of_an_independent_program():
    """In steps as long as the period: the jump is within one."""
    late = ij.disturbances.Step(size=[20.0, 5.0], time=0.2137)
    scenario = sampled(SLOW, 1e-2, 3.7e-3, disturbance=late)
    assert agree(scenario, Independent, dt=1e-2, q=1e-6, tau=1e-3).ok


@pytest.mark.slow
def test_an_encoder_and_a_lag_are_those_of_an_independent_program():
    lag = ij.actuators.Motor(bandwidth=600.0)
    scenario = sampled(SLOW, 2e-3, 1.3e-3, sensor=ENCODER, actuator=lag)
    run = agree(scenario, WithEncoder, dt=1.25e-4, tau=2e-6)
    assert run.metrics.relative_numerical_error < 1e-5 and np.any(run.measured.q != run.q)


@pytest.mark.slow
def test_a_drive_with_limits_is_that_of_an_independent_program():
    """A limit that sets in within a step costs some accuracy."""
    scenario = sampled(SLOW, 2e-3, 7e-4, actuator=MOTOR)
    run = agree(scenario, WithDrive, dt=2.5e-4, q=1e-6, tau=1e-2)
    assert int(run.status) & int(Status.TORQUE_SATURATED)


@pytest.mark.slow
def test_noise_is_white_and_normal():
    keys = jax.vmap(lambda i: noise_key(jax.random.PRNGKey(3), i))(jnp.arange(100))
    of_steps = jax.vmap(lambda key, k: normals(key, k, 2, 2), in_axes=(None, 0))
    draw = jax.jit(jax.vmap(of_steps, in_axes=(0, None)))
    x = np.asarray(draw(keys, jnp.arange(4000))).reshape(100, 4000, 4)
    far = 5 / np.sqrt(x.size)
    assert abs(x.mean()) < far and abs(x.std() - 1) < far and abs(np.mean(x**4) - 3) < 10 * far
    for a, b in ((x[:, 1:], x[:, :-1]), (x[1:], x[:-1]), (x[..., 1:], x[..., :-1])):
        assert abs(np.mean(a * b)) < far and abs(np.mean((a**2 - 1) * (b**2 - 1))) < 3 * far


@pytest.mark.slow
def test_derivatives_are_differences():
    encoder = ij.sensors.Encoder(noise=1e-5, velocity=FILTERED)
    lag = ij.actuators.Motor(bandwidth=800.0)
    scenario = canonical(sampled(SLOW, 1e-3, 7e-4, sensor=encoder, actuator=lag))

    def loss(values):
        changed = ij.with_parameters(scenario, values)
        return jnp.sum(ij.simulate(changed, duration=0.1, dt=5e-4, seed=2).metrics.ise)

    steps = {"controller.K2": 1e-4, "sampling.delay": 1e-7}
    steps |= {"actuator.bandwidth": 1e-2, "sensor.velocity.cutoff": 1e-2}
    start = {path: ij.paths.get(scenario, path) for path in steps}
    slopes = jax.grad(loss)(start)
    for path, step in steps.items():
        ends = [float(loss({path: start[path] + sign * step})) for sign in (1, -1)]
        slope = float(jnp.sum(slopes[path]))
        assert np.isclose(slope, (ends[0] - ends[1]) / (2 * step), rtol=2e-4), path


@pytest.mark.slow
def test_the_radius_is_that_of_the_map():
    """Against differences of whole periods, by an independent program of the same loop."""
    scenario = canonical(sampled(PAPER, 2e-3, 1e-3))
    program, q0 = Independent(scenario), np.asarray(scenario.initial.q)

    def after(z):
        q, dq, eta, old = z[:2], z[2:4], z[4:6], z[6:]
        u, eta = program.law(0.0, q, dq, eta)
        x = z[:4]
        for a, b, tau in ((0.0, 1e-3, old), (1e-3, 2e-3, np.asarray(u))):

            def rate(t, x, tau=tau):
                return np.concatenate([x[2:], program.acceleration(t, x[:2], x[2:], tau)])

            x = solve_ivp(rate, (a, b), x, method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
        return np.concatenate([x, eta, u])

    eta, dq = np.zeros(2), np.zeros(2)
    u, _ = program.law(0.0, q0, dq, eta)
    z = np.concatenate([q0, dq, eta, u])
    J = np.array([(after(z + e) - after(z - e)) / 2e-6 for e in 1e-6 * np.eye(8)]).T
    found = radius_at(scenario, 2e-3, np.zeros(0))
    assert np.isclose(found, np.max(np.abs(np.linalg.eigvals(J))), rtol=1e-4)


@pytest.mark.slow
def test_what_is_sampled_too_slowly_says_so():
    assert ij.simulate(sampled(PAPER, 2e-3), duration=0.5, dt=5e-4).ok
    for bad, words in (
        (sampled(PAPER, 2e-3, 2e-3), r"sampling.period is 0.002 s \(in Python, ij.recommended_"),
        (sampled(PAPER, 4e-3), r"sampling.period is 0.004 s \("),
    ):
        with pytest.warns(ij.engine.simulate.SimulationWarning, match=words):
            run = ij.simulate(bad, duration=0.5, dt=5e-4)
        flags = Status.SAMPLING_TOO_SLOW | Status.BOUND_VIOLATED
        assert Status(int(run.status)) & flags == flags
    with pytest.warns(match="had run once until then: sampling.period is 0.5 s. Make it shorter"):
        ij.simulate(sampled(PAPER, 0.5), duration=0.5, dt=5e-4)
    assert ij.recommended_period(PAPER) == 5e-4 and ij.recommended_period(SLOW) > 1e-3


LAGGING = sampled(
    SLOW,
    1e-3,
    1e-3,
    sensor=ij.sensors.Encoder(velocity=ij.sensors.FilteredDifference(cutoff=400.0)),
    actuator=ij.actuators.Motor(bandwidth=20.0),
    initial=ij.Initial(q=[0.55, 0.6]),
)
LIMITED = {
    "controller.weight": ij.with_parameters(
        sampled(SLOW, 2e-3, 1e-3), {"controller.weight": [60.0, 20.0]}
    ),
    "observer.kf": ij.with_parameters(
        sampled(SLOW, 2e-3, observer="euler"), {"observer.kf": 1200.0}
    ),
    "sampling.delay": sampled(SLOW, 2e-3, 12e-3),
    "actuator.bandwidth": LAGGING,
}
NAMED = (*LIMITED, "controller.K2", "controller.k1", "sensor.velocity.cutoff")


@pytest.mark.slow
@pytest.mark.parametrize("limiting", LIMITED)
def test_the_warning_names_the_one_term_that_limits_the_loop(limiting):
    """Changed as the warning says it stabilises the loop, and no other term by a smaller change."""
    scenario = LIMITED[limiting]

    def radius(path=limiting, scale=1.0):
        value = np.asarray(ij.simulation.paths.get(scenario, path)) * scale
        moved, times = ij.with_parameters(scenario, {path: value}), np.array([0.0, 0.025, 0.05])
        return radius_at(canonical(moved), float(scenario.sampling.period), times)

    with pytest.warns(ij.SimulationWarning, match="limits this loop") as caught:
        ij.simulate(scenario, duration=0.05, dt=1e-3)
    text = next(str(w.message) for w in caught if "limits this loop" in str(w.message))
    assert [path for path in NAMED if path in text] == [limiting]
    direction, factor = re.search(r"(lower|raise) \S+ to (\S+) times its value", text).groups()
    assert direction == ("raise" if limiting == "actuator.bandwidth" else "lower")
    assert radius() > 1 and radius(scale=float(factor)) < 1
    share = min(float(factor), 1.0 / float(factor))
    for other in ("controller.K2", "observer.kf", "controller.weight", "controller.k1"):
        assert other == limiting or radius(other, 1.5 * share) > 1, other


test_bad_parts_are_refused = refused(
    (lambda: ij.Sampling(period=1e-3, delay=3e-3, queue=1), "at least 4"),
    (lambda: ij.Sampling(period=1e-3, observer="rk4"), "exact"),
    (lambda: ij.sensors.Encoder(velocity=3.0), "Encoder.velocity"),
    (lambda: ij.actuators.Motor(rate_limit=1.0), "bandwidth"),
    (lambda: ij.actuators.Motor(stall=1.0), "no_load_speed"),
    (lambda: ij.with_parts(PAPER, sensor=ENCODER), "Sampling"),
    (lambda: ij.with_parts(PAPER, sampling=2e-3), "Sampling"),
    (lambda: ij.vector_field(sampled(PAPER, 1e-3)), "at every instant"),
    (
        lambda: ij.simulate(sampled(PAPER, 1e-3), duration=0.1, dt=4e-4),
        r"Take dt=0.000333",
    ),
)


@pytest.mark.slow
def test_a_study_may_not_lengthen_the_delay_beyond_the_queue():
    draws = {"sampling.delay": ij.value(ij.uniform(2.1e-3, 2.9e-3))}
    for queue in (None, 3):
        scenario = sampled(SLOW, 1e-3, 1e-3, queue=queue)
        study = ij.monte_carlo(scenario, draws, runs=2, duration=0.05, dt=1e-3)
        failed = np.asarray(study.status) & int(Status.NOT_FINITE) != 0
        assert np.all(failed == (queue is None))


def driven(rate_limit):
    return ij.actuators.Motor(bandwidth=600.0, rate_limit=rate_limit)


@pytest.mark.slow
def test_ranges_end_where_a_count_is_more_than_the_drive_gives():
    sensor = ij.sensors.Encoder(counts=65536, velocity=FILTERED)
    scenario = sampled(SLOW, 1e-3, sensor=sensor, actuator=driven(900.0))
    gains = ["controller.k1", "controller.K2", "observer.kf"]
    blocks, box = layout(canonical(scenario), gains, 1e-3, "rk4")
    assert box.reasons[0][1] == BY_COUNT + TOGETHER
    assert TOGETHER in str(AtLimit(1.0, "upper", 1.0, box.reasons[0][1]))

    def rate_for_a_count(factor):
        """The largest rate that is asked for when one joint moves on by a rounded count."""
        values = {b.path: factor * np.exp(box.high[b.start : b.start + b.size]) for b in blocks}
        changed = canonical(ij.with_parameters(scenario, values))
        count, rates = 2 * np.pi / 65536, []
        states = start_and_along(changed, jnp.asarray(TIMES))
        for i, t in enumerate([0.0, *TIMES]):
            state = jax.tree.map(lambda x, i=i: x[i], states)
            places = state.q + count * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
            moved = [state._replace(x=state.x.at[0].set(q)) for q in places]
            after = [run_sampled_law(changed, t, x, jnp.zeros((0, 2))) for x in moved]
            commands = [x.sampled.commands[0] for x in after]
            rates.append(600.0 * np.max(np.abs(np.stack(commands[1:]) - commands[0])))
        return max(rates)

    assert rate_for_a_count(0.98) < 900.0 < rate_for_a_count(1.02)
    # Half the rate allows less, and a drive that the start already asks too much of sets no limit.
    slower = ij.with_parts(scenario, actuator=driven(450.0))
    assert np.all(layout(canonical(slower), gains, 1e-3, "rk4")[1].high < box.high)
    hopeless = ij.with_parts(scenario, actuator=driven(1.0))
    assert layout(canonical(hopeless), gains, 1e-3, "rk4")[1].reasons[0][1] == BY_PERIOD + TOGETHER


@pytest.mark.slow
def test_a_step_with_the_poles_has_no_bias():
    """f_hat lags otherwise.  Its poles are in `control/test_observers`."""
    scenario = ij.with_parts(SLOW, observer=ij.observers.ExtendedState(l1=100.0, l2=6000.0))
    exact, poles, euler = (
        np.max(ij.simulate(loop, duration=0.3, dt=1e-3).metrics.estimate_rmse)
        for loop in (sampled(scenario, 2e-3, observer=x) for x in ("exact", "poles", "euler"))
    )
    assert poles < 0.5 * exact and poles < 1.2 * euler


@pytest.mark.parametrize(
    "velocity",
    [ij.sensors.FilteredDifference(cutoff=[300.0, 2000.0]), ij.sensors.Tracking(bandwidth=2000.0)],
)
def test_a_filter_above_the_nyquist_frequency_is_told_with_the_number(velocity):
    scenario = sampled(SLOW, 2e-3, sensor=ij.sensors.Encoder(velocity=velocity))
    words = r"2000 rad/s is above the Nyquist frequency of sampling.period, 1571 rad/s"
    with pytest.warns(UserWarning, match=words):
        canonical(scenario)
    with warnings.catch_warnings(action="error"):
        canonical(ij.with_parameters(scenario, {"sampling.period": 1e-3}))
