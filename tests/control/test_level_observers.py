"""Observers of levels: their equations, their sampled forms, and output feedback of robots."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from arm_cases import loop_on
from iblf_jax.observers import StateObserver
from independent import Loop, sine
from refused import refused
from scipy.integrate import solve_ivp

import iblf_jax as ij
from iblf_jax.control.observers.state_observer import StateObserverValues, fading_memory_gains
from iblf_jax.core import notices
from iblf_jax.simulation.closed_loop import LoopState, evaluate, initial_state, rate
from iblf_jax.simulation.metrics import LevelEstimation, _positive_share
from iblf_jax.world import plants

ROBOT = ij.presets.customary_two_link()
PAPER = ij.presets.zhang_yan_2024()
PLANTS = {
    3: plants.ElectricDrive(
        ROBOT, torque_constant=[2.0, 1.5], inductance=0.02, resistance=1.0, back_emf=0.5
    ),
    4: plants.FlexibleJoint(ROBOT, stiffness=300.0, motor_inertia=0.02, motor_damping=0.1),
}
DISTURBANCE = ij.disturbances.Sinusoids(amplitude=[1.0, 0.5], frequency=3.0, offset=0.2)


def scenario(order, observer):
    law = ij.controllers.BarrierBackstepping(k=(3.0, 20.0, 60.0, 80.0)[:order])
    parts = {"reference": PAPER.reference, "bounds": PAPER.bounds[0], "initial": PAPER.initial}
    parts |= {"controller": law, "observer": observer, "disturbance": DISTURBANCE}
    return ij.Scenario(plant=PLANTS[order], **parts)


@pytest.mark.slow
def test_each_level_of_a_level_observer_obeys_its_equation(rng):
    """d_hat_j' = kappa_j d_tilde_j with the true d: d_tilde_j' = d_j' - kappa_j d_tilde_j."""
    loop = scenario(4, ij.observers.LevelObserver(gain=(3.0, [20.0, 10.0], 0.0, 60.0)))
    kappa, start, t = np.asarray(loop.observer.gain), initial_state(loop), jnp.asarray(0.4)

    @jax.jit
    def estimate_and_rate(state):
        """The observer's estimate, its rate along the closed loop, and the true disturbance d."""
        rate, sample = evaluate(loop, t, state)
        found, dot = jax.jvp(
            lambda x, memory: loop.observer.estimate(t, x, loop.model, memory),
            (state.x, state.observer),
            (rate.x, rate.observer),
        )
        return found, dot, sample.disturbance

    for _ in range(3):
        x = start.x + jnp.asarray(rng.normal(size=start.x.shape)) * 0.05
        memory = start.observer + jnp.asarray(rng.normal(size=start.observer.shape))
        d_hat, dot, d = estimate_and_rate(LoopState(x, start.controller, memory))
        np.testing.assert_allclose(dot, kappa * (d - d_hat), rtol=1e-9, atol=1e-8)
        assert np.max(np.abs(d[1])) > 1e-2


def test_the_start_of_a_level_observer():
    x, plant = jnp.ones((3, 2)), PLANTS[3]
    for start, expected in (("matched", 0.3), ("zero", np.array([[0.3], [2.3], [4.3]]))):
        gain = [[0.0, 0.0], [2.0, 2.0], [4.0, 4.0]]
        observer = ij.observers.LevelObserver(gain=gain, eta0=0.3, start=start)
        d_hat = observer.estimate(0.0, x, plant, observer.init(x, plant))
        np.testing.assert_allclose(d_hat, np.broadcast_to(expected, (3, 2)))


def test_a_period_of_a_level_observer_is_exact():
    """`advance` against the rate integrated with the same measurement and input; a gain is 0."""
    plant, t, period = PLANTS[3], jnp.asarray(0.0), jnp.asarray(0.05)
    gain = jnp.array([[0.0, 0.0], [20.0, 30.0], [50.0, 1e-9]])
    observer = ij.observers.LevelObserver(gain=gain)
    x = jnp.array([[0.3, 0.2], [0.1, -0.1], [1.0, 0.5]])
    u, eta = jnp.array([2.0, -1.0]), jnp.array([[0.0, 0.0], [1.0, 2.0], [3.0, 4.0]])

    @jax.jit
    def rate(t, z):
        return observer.derivative(t, x, u, plant, z.reshape(3, 2)).reshape(-1)

    found = solve_ivp(rate, (0.0, 0.05), eta.reshape(-1), rtol=1e-11, atol=1e-12)
    after = observer.advance(t, x, u, plant, eta, period)
    np.testing.assert_allclose(after, found.y[:, -1].reshape(3, 2), atol=1e-8)
    euler = observer.at_period(period)
    shift = (euler.gain - gain) * x  # the same d_hat belongs to another eta
    step = eta - shift + period * euler.derivative(t, x, u, plant, eta - shift)
    np.testing.assert_allclose(step + shift, after, atol=1e-8)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_the_gains_of_a_period_place_all_poles(count):
    """The polynomial of F - F L C is (z - a)^count; two gains are those of `sensors.Tracking`."""
    a, period = 0.8, 1e-3
    L = np.array(fading_memory_gains(jnp.asarray(a), count, jnp.asarray(period)))
    F = scipy.linalg.expm(period * np.eye(count, k=1))
    error = F - np.outer(F @ L, np.eye(count)[0])
    expected = np.poly(np.full(count, a))
    np.testing.assert_allclose(np.poly(error), expected, atol=1e-9 * np.max(np.abs(expected)))
    if count == 2:
        np.testing.assert_allclose(L, [1 - a**2, (1 - a) ** 2 / period], rtol=1e-12)


@pytest.mark.parametrize("measured", [(1,), (1, 3)])
def test_a_state_observer_converges_to_the_levels_and_the_disturbance(measured):
    """A flexible joint with a constant disturbance of the last level of each segment."""
    plant = PLANTS[4]
    ends = [*(level - 2 for level in measured[1:]), 3]
    d = np.zeros((4, 2))
    d[ends] = [2.0, -1.0]
    observer = StateObserver(bandwidth=jnp.full(2, 400.0), measured=measured)

    @jax.jit
    def rate(t, z):
        x, x_hat, d_hat = z.reshape(3, 4, 2)
        u = jnp.stack([0.5 * jnp.sin(5.0 * t), 0.2 * jnp.cos(3.0 * t)])
        state = StateObserverValues(x_hat, d_hat[jnp.array(ends)])
        moved = observer.derivative(t, x, u, plant, state)
        d_rate = jnp.zeros((4, 2)).at[jnp.array(ends)].set(moved.d_hat)
        return jnp.stack([plants.flow(plant, t, x, u) + d, moved.x_hat, d_rate]).reshape(-1)

    x = jnp.array([[0.3, 0.2], [0.1, -0.1], [0.31, 0.21], [0.1, -0.1]])
    start = jnp.stack([x, x.at[1].add(0.1).at[3].add(-0.1), jnp.zeros_like(x)]).reshape(-1)
    found = solve_ivp(rate, (0.0, 0.3), start, rtol=1e-9, atol=1e-10, method="LSODA")
    x, x_hat, d_hat = found.y[:, -1].reshape(3, 4, 2)
    np.testing.assert_allclose(x_hat[:2], x[:2], atol=1e-5)
    np.testing.assert_allclose(x_hat[2:], x[2:], atol=1e-4)
    np.testing.assert_allclose(d_hat, d, atol=1e-3)


def with_estimation(observer):
    return ij.simulate(loop(observer), duration=0.1, dt=1e-3, metrics=(LevelEstimation(),))


def of_states(**fields):
    return StateObserver(bandwidth=9.0, **fields)


test_fields_that_do_not_fit_are_refused = refused(
    (lambda: ij.observers.LevelObserver(gain=1.0, start="off"), "start"),
    (lambda: of_states(measured=(2, 3)), "measured"),
    (lambda: of_states(measured=(1, 1)), "measured"),
    (lambda: of_states(measured=()), "measured"),
    (lambda: of_states(disturbance=1), "disturbance"),
    (lambda: of_states(disturbance=False, disturbance_limit=1.0), "limit.*disturbance=False"),
    (lambda: scenario(3, ij.observers.LevelObserver((1.0, 2.0))), "observer.gain.*3 rows"),
    (lambda: scenario(3, of_states(measured=(1, 4))), "1 to 3"),
    (lambda: scenario(3, of_states(offset=(1.0, 2.0))), "observer.offset"),
    (lambda: scenario(3, of_states(limit=(1.0, 2.0))), r"observer\.limit.*3 rows"),
    (lambda: with_estimation(ij.observers.NoObserver()), "an observer of levels"),
)


def test_an_observer_of_levels_needs_no_further_method():
    @ij.component
    class Still:
        receives_x = True

        def init(self, x, model):
            return ()

        def estimate(self, t, x, model, state):
            return 0.0 * x

        def derivative(self, t, x, u, model, state):
            return ()

    observer = Still()
    ij.testing.check_observer(observer)
    assert not observer.advances and not observer.completes and observer.at_period(1e-3) is observer


ARM = Loop(mass=(1.2, 0.7), length=(0.4, 0.3), centre=(0.2, 0.16), inertia=(0.02, 0.01))
KP, KD = np.array([40.0, 25.0]), np.array([12.0, 10.0])


def loop(observer, **parts):
    law = ij.controllers.ComputedTorque(Kp=KP, Kd=KD)
    return loop_on(ARM, law, observer=observer, **parts)


def reference_rate(w, limit, push, t, z):
    """The rate of (q, q', q_hat, v_hat, d_hat) of this loop, from its equations."""
    q, v, q_hat, v_hat, d_hat = z.reshape(5, 2)
    q_d, dq_d, ddq_d = sine(0.3, 0.2, 1.5, (0.0, 0.4))(t)
    used = np.clip(d_hat, -limit, limit)
    commanded = ddq_d - KD * (v_hat - dq_d) - KP * (q - q_d) - used
    tau = ARM.inverse_dynamics(q, v_hat, commanded)
    e = q - q_hat
    return np.concatenate([
        v,
        ARM.acceleration(q, v, tau + push),
        v_hat + 3.0 * w * e,
        ARM.acceleration(q, v_hat, tau) + d_hat + 3.0 * w**2 * e,
        w**3 * e,
    ])  # fmt: skip


def test_the_vector_field_at_random_states(rng):
    """To 1e-12 of its largest entry, with limits that are active at some states."""
    push = np.array([0.3, -0.2])
    pushed = ij.disturbances.Step(size=push, time=0.0)
    field = jax.jit(rate)
    for _ in range(20):
        w, limit = rng.uniform(10.0, 200.0, 2), rng.uniform(1.0, 4.0)
        observer = StateObserver(bandwidth=w, disturbance_limit=limit)
        scenario = loop(observer, disturbance=pushed)
        z, t = rng.normal(size=(5, 2)), rng.uniform(0.0, 3.0)
        z[4] *= 3.0
        state = initial_state(scenario)
        inner = state.observer._replace(x_hat=jnp.asarray(z[2:4]), d_hat=jnp.asarray(z[4])[None])
        state = state._replace(x=jnp.asarray(z[:2]), observer=inner)
        found = field(scenario, jnp.asarray(t), state)
        x_hat, d_hat = found.observer
        rates = np.concatenate([found.q, found.dq, *np.asarray(x_hat), d_hat[0]])
        expected = reference_rate(w, limit, push, t, z.reshape(-1))
        np.testing.assert_allclose(rates, expected, atol=1e-12 * np.max(np.abs(expected)))


@pytest.mark.slow
def test_a_run_reports_for_how_long_a_limit_acted_and_the_largest_error_of_an_estimate():
    """Beside the estimates that it recorded."""
    limit, offset = 5.0, np.array([[0.0, 0.0], [0.4, -0.3]])
    scenario = loop(StateObserver(bandwidth=60.0, offset=offset, disturbance_limit=limit))
    with notices.muted():
        run = ij.simulate(scenario, duration=0.4, dt=2.5e-4)
    active = np.mean(np.max(np.abs(run.observer_state.d_hat), axis=(1, 2)) > limit) * 0.4
    assert active > 0.02
    np.testing.assert_allclose(run.metrics["limited_time"], active, atol=5e-4)
    error = np.max(np.abs(run.x_hat - run.x), axis=0)
    np.testing.assert_allclose(run.metrics["peak_level_error"], error, rtol=1e-4)
    assert error[1].min() > 0.2
    assert dict(run.metrics.units)["peak_level_error"] == "rad; rad/s"


def test_the_share_of_an_interval_with_a_positive_function():
    first = jnp.array([1.0, -3.0, 2.0, -1.0, 0.0, 0.0])
    last = jnp.array([-3.0, 1.0, 1.0, -2.0, -1.0, 2.0])
    np.testing.assert_allclose(_positive_share(first, last), [0.25, 0.25, 1.0, 0.0, 0.0, 1.0])
