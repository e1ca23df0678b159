"""The laws beside the paper's: what each does, its weight, and paths through a wrapper."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from independent import Loop, sine
from refused import assert_refused, refused

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers
from iblf_jax.core.pytree import rewrapped, unwrapped

PD = controllers.PDGravity(Kp=1.0, Kd=1.0)
Q, DQ = jnp.array([0.7, 0.6]), jnp.array([0.4, -0.3])


def test_linear_laws_are_those_of_the_equations(rng):
    """PD with gravity and computed torque at gains of each joint, beside an independent arm."""
    arm, context = Loop(), ij.presets.zhang_yan_2024().context
    Kp, Kd = np.array([25.0, 16.0]), np.array([10.0, 7.0])
    laws = controllers.PDGravity(Kp, Kd), controllers.ComputedTorque(Kp, Kd)

    @jax.jit
    def commands(*arguments):
        return jnp.stack([law.command(*arguments, context, ())[0].tau for law in laws])

    for _ in range(10):
        t, q, (dq, f_hat) = rng.uniform(0.0, 5.0), rng.uniform(0.3, 0.7, 2), rng.normal(size=(2, 2))
        q_d, dq_d, ddq_d = sine(*arm.reference)(t)
        M, C, G, _ = arm.arm(q)
        asked = -Kp * (q - q_d) - Kd * (dq - dq_d)
        expected = G + asked - f_hat, M @ (ddq_d + asked) + C(dq) @ dq + G - f_hat
        found = commands(*map(jnp.asarray, (t, q, dq, f_hat)))
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_smooth_limit():
    dtype, zero = jnp.float32, jnp.zeros(2, jnp.float32)
    context = ij.astype(ij.presets.zhang_yan_2024(), dtype).context
    tau = jnp.asarray([0.0, 1e-30, 0.5, 0.999, 1.0, 1.001, 2.0, 1e8, 1e30], dtype)

    def limited(x):
        fixed = _Fixed(tau=jnp.stack([x, -x]))
        wrapped = controllers.Saturated(law=fixed, limit=jnp.ones(2, dtype), edge="smooth")
        return wrapped.command(zero[0], jnp.stack([zero, zero]), zero, context, ())[0].tau

    value, slope = jax.vmap(limited)(tau), jax.vmap(jax.jacfwd(limited))(tau)
    assert value.dtype == dtype
    np.testing.assert_allclose(value[:, 0], -value[:, 1])
    wide = np.asarray(tau, np.longdouble)
    exact, exact_slope = wide / (1 + wide**8) ** 0.125, (1 + wide**8) ** -1.125
    np.testing.assert_allclose(value[:, 0], exact.astype(float), rtol=1e-6)
    np.testing.assert_allclose(slope[:, 0], exact_slope.astype(float), rtol=1e-5, atol=1e-30)
    assert bool(jnp.all(jnp.isfinite(jax.vmap(jax.jacrev(limited))(tau))))
    assert bool(jnp.all(jnp.abs(value) <= 1.0))


@ij.component
class _Fixed:
    tau: jax.Array = ij.leaf("N m", shape="any")

    def command(self, t, q, dq, f_hat, context, state):
        never = jnp.zeros(q.shape, bool)
        return controllers.Command(self.tau, jnp.zeros_like(q), jnp.zeros_like(q), never, never), ()


def test_paths_reach_through_a_wrapper():
    scenario = ij.presets.zhang_yan_2024_saturated()
    paths = [p.path for p in ij.parameters(scenario)]
    assert {"controller.K2", "controller.limit"} <= {*paths}
    assert not any(".law." in path for path in paths)
    for path in ("controller.K2[1]", "controller.law.K2[1]"):
        other = ij.with_parameters(scenario, {path: 33.0})
        np.testing.assert_array_equal(other.controller.law.K2, [20.0, 33.0])
    assert_refused(r"controller\.K2", ij.with_parameters, scenario, {"controller.K3": 1.0})
    assert_refused("> 0", ij.with_parameters, scenario, {"controller.K2": -1.0})


def test_a_wrapper_in_a_wrapper_keeps_both_fields_apart():
    scenario = ij.presets.zhang_yan_2024_saturated()
    outer = controllers.Saturated(law=scenario.controller, limit=50.0, edge="smooth")
    twice = dataclasses.replace(scenario, controller=outer)
    values = {p.path: p.value for p in ij.parameters(twice)}
    np.testing.assert_array_equal(values["controller.limit"], [50.0, 50.0])
    np.testing.assert_array_equal(values["controller.law.limit"], [7.2, 1.5])
    np.testing.assert_array_equal(values["controller.k1"], [2.0, 2.0])
    other = ij.with_parameters(twice, {"controller.law.limit": 7.0, "controller.k1": 3.0})
    np.testing.assert_array_equal(other.controller.law.limit, [7.0, 7.0])
    np.testing.assert_array_equal(unwrapped(other.controller).k1, [3.0, 3.0])
    assert isinstance(rewrapped(outer, PD).law.law, controllers.PDGravity)


START, END, RATE = 6.0, 0.3, 1.0
FUNNEL = bounds.Bounds(bounds.Funnel(-START, -END, RATE), bounds.Funnel(START, END, RATE))


def on_a_surface(**changes):
    law = controllers.SurfaceBarrier(a=2.0, K=[4.0, 8.0], surface=FUNNEL)
    width = (START - END) / (2.0 - RATE) + 1.0
    sides = (bounds.Funnel(sign * width, sign * END / 2, RATE) for sign in (-1.0, 1.0))
    parts = {
        "controller": law,
        "observer": ij.observers.NoObserver(),
        "bounds": bounds.Bounds(*sides),
        "initial": ij.Initial([1.5, -0.4], [1.0, 0.5]),
    }
    return ij.with_parts(ij.presets.zhang_yan_2024(law="pd"), **(parts | changes))


def test_the_torque_of_a_barrier_on_a_surface_is_the_published_one():
    base, t = on_a_surface(), 0.7
    q, dq = np.array([0.9, 0.2]), np.array([0.3, -0.8])
    arguments = map(jnp.asarray, (t, q, dq, np.ones(2)))
    command, _ = base.controller.command(*arguments, base.context, ())
    q_d, dq_d, _ = sine(*Loop().reference)(t)
    sigma, rho = dq - dq_d + 2.0 * (q - q_d), (START - END) * np.exp(-RATE * t) + END
    x, k = sigma / rho, np.array([1.0, 2.0])
    expected = -2 * k * np.log((1 + x) / (1 - x)) / ((1 - x**2) * rho)
    np.testing.assert_allclose(command.tau, expected, rtol=1e-12)
    np.testing.assert_allclose(dq - command.alpha, sigma, rtol=1e-12)


@pytest.mark.slow
def test_the_funnel_of_the_surface_is_one_of_the_error():
    run = ij.simulate(on_a_surface(), duration=4.0, dt=1e-3)
    assert int(run.status) == 0
    sigma, t = np.asarray(run.dq - run.alpha), np.asarray(run.t)[:, None]
    assert np.all(np.abs(sigma) < (START - END) * np.exp(-RATE * t) + END)
    # e1' + a e1 = sigma, solved with |sigma| at its bound.
    fading, fast = np.exp(-t), np.exp(-2 * t)
    implied = fast * np.abs(run.e1[0]) + (START - END) * (fading - fast) + END / 2 * (1 - fast)
    assert np.all(np.abs(run.e1) <= implied + 1e-9)


def of(surface, **fields):
    return controllers.SurfaceBarrier(a=2.0, K=4.0, surface=surface, **fields)


def run_between(lower, upper):
    law = of(bounds.Bounds(bounds.Constant(lower), bounds.Constant(upper)))
    filtered = controllers.SafetyFilter(law=law)
    return ij.simulate(on_a_surface(controller=filtered), duration=0.1, dt=1e-3)


NOT_BETWEEN = r"SurfaceBarrier\.surface: .*expected lower < 0 < upper at t = 0"
test_refusals_name_what_is_expected = refused(
    (lambda: controllers.Saturated(PD, limit=1.0, edge="soft"), "hard"),
    (lambda: controllers.Saturated(3.0, limit=1.0), r"Saturated\.law"),
    (lambda: ij.observers.ExtendedState(), "bandwidth"),
    (lambda: ij.observers.ExtendedState(l1=1.0), "bandwidth"),
    (lambda: ij.observers.ExtendedState(bandwidth=1.0, l1=1.0, l2=1.0), "bandwidth"),
    (lambda: of(barriers.Log()), r"Barrier\.surface: .*expected an iblf_jax.bounds.Bounds"),
    (lambda: of(FUNNEL, barrier=FUNNEL), r"SurfaceBarrier\.barrier"),
    (lambda: run_between(1.0, [2.0, 3.0]), NOT_BETWEEN),
    (lambda: run_between(-1.0, [2.0, 0.0]), NOT_BETWEEN),
)
WEIGHTED = {
    "backstepping": controllers.Backstepping(k1=2.0, K2=20.0),
    "corrected_mapping": controllers.Backstepping(
        k1=2.0, K2=20.0, barrier=barriers.TransformedError(), variant="corrected"
    ),
    "dynamic_surface": controllers.DynamicSurface(k1=2.0, K2=20.0, filter=0.02),
    "adaptive_rbf": controllers.AdaptiveRBF(k1=2.0, K2=20.0, nodes=4),
}
WEIGHT = jnp.array([0.3, 2.5])


def weighted(name, weight=None):
    law = dataclasses.replace(WEIGHTED[name], weight=weight)
    return dataclasses.replace(ij.presets.zhang_yan_2024(), controller=law)


def commanded(scenario):
    law, context = scenario.controller, scenario.context
    f_hat, state = jnp.array([0.5, -0.2]), law.init(Q, DQ, context)
    return law.command(jnp.asarray(0.3), Q, DQ, f_hat, context, state)[0]


@pytest.mark.parametrize("name", WEIGHTED)
def test_the_weight_is_a_leaf_that_multiplies_slope_and_value_of_the_barrier(name):
    """It has the unit that its barrier gives it."""
    plain, other = (commanded(weighted(name, weight)) for weight in (None, WEIGHT))
    scenario = weighted(name)
    tube, barrier = scenario.context.tube(jnp.asarray(0.3)), scenario.controller.barrier
    added = (WEIGHT - 1.0) * barrier.slope(tube, Q)
    np.testing.assert_allclose(other.tau, plain.tau - added, rtol=1e-12)
    np.testing.assert_allclose(other.V1, WEIGHT * plain.V1, rtol=1e-9)
    np.testing.assert_array_equal(plain.tau, commanded(weighted(name, 1.0)).tau)
    np.testing.assert_array_equal(scenario.controller.weight, [1.0, 1.0])
    found = {p.path: p for p in ij.parameters(scenario)}["controller.weight"]
    assert (found.shape, found.unit) == ((2,), "N m/rad" if "mapping" in name else "N m rad")
    assert_refused(r"weight.*> 0", ij.with_parameters, scenario, {"controller.weight": [1.0, 0.0]})
