"""Faults, dead zone, levels, play and delay of the input, against programs of their own."""

import itertools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from independent import Loop, sine
from refused import refused
from scipy.integrate import solve_ivp

import iblf_jax as ij
from iblf_jax.certificates.claims.theorem import THEOREM
from iblf_jax.core.status import Status
from iblf_jax.simulation.closed_loop import LoopState, evaluate
from iblf_jax.simulation.delays import STAGES, PieceCommands, arriving, with_step

LOOP = Loop(corrected=True, K2=np.full(2, 4.0), kf=np.full(2, 4.0))
SLOW = ij.with_parameters(
    ij.presets.zhang_yan_2024(variant="corrected"), {"controller.K2": 4.0, "observer.kf": 4.0}
)
DURATION = 0.1
RHO, BIAS = np.array([0.6, 0.8]), np.array([0.3, -0.2])
LOWER, UPPER, SLOPE = np.array([-0.3, -0.2]), np.array([0.5, 0.1]), np.array([0.9, 1.2])
GAP, BANDWIDTH = np.array([0.4, 0.2]), 300.0


def with_actuator(*parts, scenario=SLOW) -> ij.Scenario:
    actuator = parts[0] if len(parts) == 1 else ij.actuators.Chain(parts)
    return ij.with_parts(scenario, actuator=actuator)


def end_of(run) -> np.ndarray:
    return np.concatenate([run.q[-1], run.dq[-1]])


def faulty(u, failed):
    return RHO * u + BIAS if failed else u


def beyond(u, lower, upper):
    return np.where(u > upper, u - upper, np.where(u < lower, u - lower, 0.0))


def moved(t, x, deliver):
    """The rate of (q, q', eta) under a delivered torque, and the command that the observer has."""
    rate, out = LOOP.evaluate(t, x)
    M = LOOP.arm(x[:2])[0]
    rate[2:4] += np.linalg.solve(M, deliver(out["tau"]) - out["tau"])
    return rate, out["tau"]


def test_vector_field_of_a_chain_at_random_states(rng):
    time, step = 0.5, np.array([0.03, 0.05])
    scenario = with_actuator(
        ij.actuators.Fault(RHO, BIAS, time),
        ij.actuators.DeadZone(LOWER, UPPER, SLOPE),
        ij.actuators.Quantiser(step),
        ij.actuators.Backlash(GAP, BANDWIDTH),
    )
    times = rng.uniform(0.0, 2 * time, 40)
    desired = np.array([sine(*LOOP.reference)(t)[0] for t in times])
    q = desired + rng.uniform(-0.1, 0.1, (40, 2))
    dq, eta = rng.uniform(-1.0, 1.0, (2, 40, 2))
    y = rng.uniform(-2.0, 2.0, (40, 2))

    def rate_at(t, q, dq, eta, y):
        return evaluate(scenario, t, LoopState(jnp.stack([q, dq]), (), eta, ((), (), (), y)))[0]

    found = jax.jit(jax.vmap(rate_at))(times, q, dq, eta, y)
    rates = np.hstack([found.q, found.dq, found.observer, found.actuator[3]])
    for i, t in enumerate(times):
        rate, u = moved(t, np.concatenate([q[i], dq[i], eta[i]]), lambda _, i=i: y[i])
        v = step * np.round(SLOPE * beyond(faulty(u, t >= time), LOWER, UPPER) / step)
        y_rate = BANDWIDTH * beyond(v - y[i], -GAP / 2, GAP / 2)
        np.testing.assert_allclose(rates[i], [*rate, *y_rate], rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("lower", [None, -3.0])
def test_a_motor_delivers_at_most_its_limits_in_both_directions(lower):
    motor = ij.actuators.Motor(limit=[5.0, 8.0], lower_limit=lower)
    lowest = np.array([-5.0, -8.0]) if lower is None else np.full(2, lower)
    highest = np.array([5.0, 8.0])
    for command in ([-20.0, -20.0], [20.0, 20.0], [-20.0, 20.0], [1.0, -2.0]):
        delivered = motor.deliver(jnp.asarray(command), jnp.zeros(2), ())
        np.testing.assert_array_equal(delivered.tau, np.clip(command, lowest, highest))
        is_beyond = (command < lowest) | (command > highest)
        np.testing.assert_array_equal(delivered.limited, is_beyond)


@pytest.mark.slow
def test_fault_between_two_instants_against_scipy():
    time = 0.0503
    scenario = with_actuator(ij.actuators.Fault(RHO, BIAS, time))
    run = ij.simulate(scenario, duration=DURATION, dt=1e-3)
    x, how = np.concatenate([LOOP.q0, LOOP.dq0, np.zeros(2)]), {"rtol": 1e-11, "atol": 1e-13}
    for a, b in itertools.pairwise([0.0, time, DURATION]):

        def rate(t, x, a=a):
            return moved(t, x, lambda u: faulty(u, a >= time))[0]

        x = solve_ivp(rate, (a, b), x, "DOP853", **how).y[:, -1]
    np.testing.assert_allclose(end_of(run), x[:4], rtol=0, atol=1e-7)
    # The estimate of the observer, which receives the command, contains the lost torque.
    expected = LOOP.evaluate(DURATION, x)[1]
    np.testing.assert_allclose((run.tau[-1] - BIAS) / RHO, expected["tau"], atol=1e-5)
    np.testing.assert_allclose(run.disturbance_estimate[-1], expected["f_hat"], atol=1e-5)


def delayed_end(delay: float, failing: float = np.inf) -> np.ndarray:
    """(q, q') at the end under a delayed input, by the method of steps."""
    balance = LOOP.arm(np.array(LOOP.q0))[2]
    x, before, begin = np.concatenate([LOOP.q0, LOOP.dq0, np.zeros(2)]), None, 0.0
    while begin < DURATION - 1e-12:
        end = min(begin + delay, DURATION)
        middle = [failing] if begin < failing < end else []
        pieces = []
        for a, b in itertools.pairwise([begin, *middle, end]):

            def rate(t, x, a=a, before=before):
                u = balance if before is None else command(before, t - delay)
                return moved(t, x, lambda _: faulty(u, a >= failing))[0]

            solution = solve_ivp(
                rate, (a, b), x, "DOP853", rtol=1e-12, atol=1e-14, dense_output=True
            )
            pieces.append((b, solution.sol))
            x = solution.y[:, -1]
        before, begin = pieces, end
    return x[:4]


def command(pieces, t):
    at = next((sol for b, sol in pieces if t <= b), pieces[-1][1])
    return LOOP.evaluate(t, at(t))[1]["tau"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("delay", "steps", "largest", "ratio"),
    [(4e-3, 2.0, 2e-6, (13.0, 20.0)), (4.3e-3, 4.3, 3e-4, (3.0, 5.0))],
)
def test_a_delay_of_whole_steps_keeps_the_order_of_the_method(delay, steps, largest, ratio):
    """Others are of the second order."""
    scenario, expected = with_actuator(ij.actuators.Delay(delay)), delayed_end(delay)
    errors = []
    for dt in (delay / steps, delay / steps / 2):
        run = ij.simulate(scenario, duration=DURATION, dt=dt)
        errors.append(np.max(np.abs(end_of(run) - expected)))
    assert errors[0] < largest and ratio[0] < errors[0] / errors[1] < ratio[1]


@pytest.mark.slow
def test_delay_and_fault_against_scipy():
    scenario = with_actuator(ij.actuators.Delay(4e-3), ij.actuators.Fault(RHO, BIAS, 0.05))
    run = ij.simulate(scenario, duration=DURATION, dt=5e-4)
    np.testing.assert_allclose(end_of(run), delayed_end(4e-3, 0.05), rtol=0, atol=1e-7)
    assert np.all(run.tau[run.t < 4e-3 - 1e-9] == run.tau[0])
    np.testing.assert_allclose(run.tau[0], LOOP.arm(np.array(LOOP.q0))[2], atol=1e-14)


@pytest.mark.slow
def test_derivative_by_the_delay_and_by_the_time_of_a_fault():
    def end(values, dt=1e-3, history=5):
        scenario = with_actuator(
            ij.actuators.Delay(values[0], history=history), ij.actuators.Fault(RHO, BIAS, values[1])
        )
        return ij.simulate(scenario, duration=0.05, dt=dt).q[-1]

    # Under a delay of one step, the first command arrives at the end of the step in which the law
    # computed it.
    h, time = jnp.asarray([0.0, 1e-5]), 0.0203
    for delay in (4e-3, 1e-3):
        values = jnp.asarray([delay, time])
        slopes = np.asarray(jax.jacfwd(end)(values))
        by_time = (end(values + h) - end(values - h)) / 2e-5
        np.testing.assert_allclose(slopes[:, 1], by_time, rtol=1e-5)
        ahead, behind = (end([delay + sign * 1e-4, time], 1e-4, 43) for sign in (1, -1))
        np.testing.assert_allclose(slopes[:, 0], (ahead - behind) / 2e-4, rtol=3e-2)


def test_a_long_run_in_float32_has_the_delay_of_a_short_one():
    scenario = with_actuator(ij.actuators.Delay(4.45e-3, history=5))
    commands, dt = jnp.zeros((5, STAGES, 2), jnp.float32), jnp.float32(1e-3)
    for number in (10, 1_000_000):
        found = arriving(ij.astype(scenario, "float32"), "rk4", dt, jnp.float32(number), commands)
        assert not found.is_whole
        np.testing.assert_allclose(found.shift, 0.55, rtol=1e-5)
    # Of a step that jumps divide, a line between its ends is kept.
    rows = np.float32([[1.0, 9.0, 9.0, 9.0], [9.0, 9.0, 9.0, 3.0], [9.0, 9.0, 9.0, 9.0]])
    pieces = [
        PieceCommands(found.start, 0.4 * dt, i < 2, [jnp.full(2, x) for x in row])
        for i, row in enumerate(rows)
    ]
    kept = jax.jit(lambda: with_step(commands + 5.0, "rk4", found, pieces))()
    np.testing.assert_allclose(kept[0], np.outer([1.0, 2.0, 2.0, 3.0], [1.0, 1.0]), rtol=1e-6)
    assert kept.shape == commands.shape and np.all(kept[1:] == 5.0)


def study_of(low, high):
    """Two runs with random delays, of at most six steps."""
    scenario = with_actuator(ij.actuators.Delay(3e-3, history=6))
    how = {"runs": 2, "progress": False, "duration": 0.05, "dt": 1e-3}
    with warnings.catch_warnings(action="ignore"):
        return ij.monte_carlo(scenario, {"actuator.delay": ij.value(ij.uniform(low, high))}, **how)


@pytest.mark.slow
def test_delays_of_a_study_are_those_of_single_runs_or_flagged():
    study = study_of(2e-3, 6e-3)
    for i in (0, 1):
        run = study.replay(i)
        assert 2e-3 <= float(run.scenario.actuator.delay) <= 6e-3
        np.testing.assert_allclose(study.metrics["rmse"][i], run.metrics["rmse"], rtol=1e-9)
    for beyond in ((6.5e-3, 8e-3), (1e-4, 9e-4)):
        assert np.all(np.asarray(study_of(*beyond).status) & int(Status.NOT_FINITE))


IDEAL = ij.actuators.Ideal()
DELAYED = with_actuator(ij.actuators.Delay(0.01))


def run_delayed(scenario=DELAYED, **options):
    return ij.simulate(scenario, **({"duration": 0.1, "dt": 1e-3} | options))


def noisy(noise):
    return run_delayed(ij.with_parts(DELAYED, process_noise=noise), method="euler_maruyama")


def end_by(delay):
    return run_delayed(with_actuator(ij.actuators.Delay(delay))).q[-1].sum()


test_refusals_name_the_field_and_the_remedy = refused(
    (lambda: ij.actuators.DeadZone(lower=0.1, upper=0.2), "DeadZone.lower"),
    (lambda: with_actuator(IDEAL, ij.actuators.Delay(0.01)), "a Delay as the first part only"),
    (lambda: ij.with_parts(DELAYED, sampling=ij.Sampling(period=1e-3)), "Sampling"),
    (lambda: ij.vector_field(DELAYED), "past states"),
    (lambda: run_delayed(dt=0.02), "at least one time step"),
    (lambda: run_delayed(method="euler"), "heun"),
    (lambda: ij.recommended_dt(DELAYED, duration=0.1, method="euler"), "heun"),
    (lambda: noisy(ij.process_noise.Additive(0.1)), 'expected "stochastic_heun"'),
    (lambda: noisy(ij.process_noise.Proportional(0.1)), "process_noise: got 'Proportional'"),
    (lambda: jax.grad(end_by)(0.01), "Delay.history"),
)


@pytest.mark.slow
def test_certificate_of_a_delayed_run_claims_nothing(tmp_path):
    scenario = with_actuator(ij.actuators.Delay(2e-3))
    ij.save_scenario(scenario, tmp_path / "delayed.toml")
    run = ij.simulate(ij.load_scenario(tmp_path / "delayed.toml"), duration=0.05, dt=1e-3)
    assert int(run.scenario.actuator.history) == 2
    certificate = ij.certify(scenario, run=run)
    assert {line.verdict for line in certificate.lines} == {"not applicable"}
    assert certificate["V2, delayed less continuous"].value > 0


def test_theorem_claims_nothing_about_a_torque_that_is_not_the_command():
    fault = ij.actuators.Fault(effectiveness=0.9, time=0.02)
    for actuator in (fault, ij.actuators.DeadZone(lower=-0.1, upper=0.1)):
        assert type(actuator).__name__ in THEOREM.why_not(with_actuator(actuator))
