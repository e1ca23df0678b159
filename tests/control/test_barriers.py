"""Every barrier against its definition, its claims, the guard and the singular points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from iblf_jax.barriers import Integral, Log, guard_is_active, guarded_error
from iblf_jax.bounds import Tube, tube_at
from scipy.integrate import quad

import iblf_jax as ij
from iblf_jax import barriers
from iblf_jax.control.barriers._series import log_remainder, sinc

K1 = jnp.array([1.3, 2.1])
MARGIN = jnp.array([0.1, 0.1])
BARRIERS = {name: cls() for name, cls in barriers.MEMBERS.items()} | {"log_p2": Log(p=2)}
KAPPA = {"integral", "log", "log_p2"}
"""Barriers whose alpha compensates a moving bound by kappa >= |k'/k|: V1' is bounded, not given."""
REFERENCE = ij.references.Sinusoid(0.5, 0.14, 1.0, [0.0, 1.5])
BOUNDS = {
    "breathing": ij.bounds.Bounds(
        ij.bounds.Sinusoid(0.1, 0.1, 1.3, [0.2, 2.0]), ij.bounds.Sinusoid(1.0, 0.2, 0.7, [0.0, 1.0])
    ),
    "funnel": ij.bounds.Bounds(ij.bounds.Funnel(-0.5, -0.05, 0.8), ij.bounds.Funnel(0.4, 0.1, 0.6)),
}
BREATHING = BOUNDS["breathing"]
"""Those of what a barrier states at an instant; its rate also knows the funnel."""
SIZES = (-0.97, -0.5, -1e-3, -1e-9, 0.0, 1e-9, 1e-3, 0.4, 0.95)
POINTS = tuple(np.ravel(x) for x in np.meshgrid((0.0, 0.4, 2.2), SIZES))
"""Times and relative errors."""


def tube_of(bounds, t):
    return tube_at(REFERENCE, bounds, jnp.asarray(t))


def position(tube, xi):
    return tube.q_d + xi * jnp.where(jnp.asarray(xi) > 0, tube.k_u, tube.k_l)


def simple_tube(k_l, k_u, dtype=None, dk_l=0.1, dk_u=-0.2, q_d=0.0, n=2):
    numbers = q_d, 0.3, q_d - k_l, q_d + k_u, 0.3 - dk_l, 0.3 + dk_u
    return Tube(*(x * jnp.ones(n, dtype) for x in numbers))


def rates(barrier, bounds, t, xi):
    """V1 and its total derivative along q' = alpha, joint by joint."""
    q = position(tube_of(bounds, t), xi)
    alpha = barrier.virtual_velocity(tube_of(bounds, t), q, K1, MARGIN)

    def value(t, q):
        return barrier.value(tube_of(bounds, t), q)

    return jax.jvp(value, (jnp.asarray(t), q), (jnp.ones(()), alpha))


@pytest.mark.parametrize("p", [1, 2, 4])
@pytest.mark.parametrize("e", [-0.25, -0.01, 0.02, 0.4])
def test_values_that_are_integrals_match_quadrature(e, p):
    k_l, k_u, q_d = 0.3, 0.5, 0.6
    tube, q = simple_tube(k_l, k_u, q_d=q_d), jnp.full(2, q_d + e)
    xi = abs(e) / (k_u if e > 0 else k_l)
    integral = quad(lambda s: 2 * s / (1 - s**2), 0, xi)[0]
    log = quad(lambda s: s ** (2 * p - 1) / (1 - s ** (2 * p)), 0, xi)[0]
    kc, y = (k_l + k_u) / 2, (k_l - k_u) / 2
    state = quad(lambda s: s * kc**2 / (kc**2 - (s + y) ** 2), 0, e)[0]
    expected = ((Integral(), integral), (Log(p=p), log), (barriers.StateBarrier(), state))
    for barrier, value in expected:
        np.testing.assert_allclose(barrier.value(tube, q), value, rtol=1e-10)


@pytest.mark.parametrize("bounds", BOUNDS)
@pytest.mark.parametrize("name", sorted(set(BARRIERS) - KAPPA))
def test_rate_of_V1_along_alpha_is_what_the_law_promises(name, bounds):
    barrier = BARRIERS[name]

    def both(t, xi):
        tube = tube_of(BOUNDS[bounds], t)
        q = position(tube, xi)
        V, dV = rates(barrier, BOUNDS[bounds], t, xi)
        if name != "state":
            return dV, -barrier.decay_rate(K1) * V
        kc, x = (tube.k_l + tube.k_u) / 2, q - (tube.lower + tube.upper) / 2
        return dV, -K1 * kc**2 * (q - tube.q_d) ** 2 / (kc**2 - x**2)

    rate, promised = jax.jit(jax.vmap(both))(*POINTS)
    np.testing.assert_allclose(rate, promised, rtol=1e-8, atol=1e-15)


def test_state_rate_is_the_best_constant():
    # Reference near the wall, position nearer: V1' / V1 comes as near to -k1 as one likes.
    tube = simple_tube(1.0, 1e-5, dk_l=0.0, dk_u=0.0)
    barrier, e = barriers.StateBarrier(), jnp.full(2, -1e-2)
    ratio = barrier.slope(tube, e) * e / barrier.value(tube, e)
    assert float(jnp.max(ratio)) < 1.02 and float(jnp.min(ratio)) >= 1.0


@pytest.mark.parametrize("name", sorted(set(BARRIERS) - {"quadratic"}))
def test_xi_bound_holds_and_is_reached_on_the_worse_side(name):
    barrier = BARRIERS[name]

    def claims(t, size):
        tube = tube_of(BREATHING, t)
        values = [barrier.value(tube, position(tube, side * size)) for side in (1, -1)]
        return jnp.stack([barrier.xi_bound(V, tube) for V in values])

    t, size = (np.ravel(x) for x in np.meshgrid([0.0, 1.1], [1e-3, 0.3, 0.9, 0.99]))
    bound, size = jax.jit(jax.vmap(claims))(t, size), size[:, None]
    assert bool(jnp.all(bound >= size[:, None] * (1 - 1e-6)))
    np.testing.assert_allclose(jnp.min(bound, axis=1), np.broadcast_to(size, (8, 2)), rtol=1e-6)


@pytest.mark.parametrize("name", sorted(set(BARRIERS) - {"quadratic", "state"}))
def test_error_at_is_the_error_at_which_the_barrier_has_a_value(name):
    barrier = BARRIERS[name]

    def error(t, xi):
        tube = tube_of(BREATHING, t)
        q = position(tube, jnp.full(2, xi))
        return q - tube.q_d, barrier.error_at(barrier.value(tube, q), tube, jnp.asarray(xi > 0))

    away = np.abs(POINTS[1]) > 1e-6  # V1 of a smaller error is below the rounding of 1 - xi^2
    expected, found = jax.jit(jax.vmap(error))(*(column[away] for column in POINTS))
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_the_guarded_error_on_both_sides():
    """e = min(|e1|, (1 - guard) k) sign(e1) and the rest beyond, with the width and the rate of the
    side that e1 is on; without a guard it is e1 up to the bound."""
    tube, e1 = simple_tube(0.3, 0.5, q_d=1.0, n=4), np.array([-0.4, -0.1, 0.49, 0.7])
    found = guarded_error(tube, jnp.asarray(1.0 + e1), 0.1)
    np.testing.assert_allclose(found.e, [-0.27, -0.1, 0.45, 0.45], rtol=1e-12)
    np.testing.assert_allclose(found.e + found.beyond, e1, rtol=1e-12)
    np.testing.assert_allclose(found.k, [0.3, 0.3, 0.5, 0.5], rtol=1e-12)
    np.testing.assert_allclose(found.dk, [0.1, 0.1, -0.2, -0.2], rtol=1e-12)
    assert list(guard_is_active(tube, jnp.asarray(1.0 + e1), 0.1)) == [True, False, True, True]
    found = guarded_error(simple_tube(0.5, 0.8), jnp.array([0.79999, -0.49999]), -np.inf)
    np.testing.assert_allclose(found.e, [0.79999, -0.49999])
    np.testing.assert_allclose(found.beyond, 0.0)


@jax.jit
def numbers_of(barrier, e, k_l, k_u):
    """V1, its slope and the derivative of that, and alpha."""
    tube, q = simple_tube(k_l, k_u, dk_l=0.3, dk_u=-0.4), e * jnp.ones(2)
    derivative = jax.grad(lambda q: jnp.sum(barrier.slope(tube, q)))(q)
    alpha = barrier.virtual_velocity(tube, q, K1, MARGIN)
    return jnp.stack([barrier.value(tube, q), barrier.slope(tube, q), derivative, alpha])


@given(e=st.floats(-1e38, 1e38), k_l=st.floats(0, 10), k_u=st.floats(0, 10))
def test_finite_for_any_error_and_any_width(e, k_l, k_u):
    """Widths of zero too: a reference on its bound is flagged, not divided by."""
    for barrier in (Integral(), Log(p=2)):
        numbers = numbers_of(barrier, e, k_l, k_u)
        assert np.all(np.isfinite(numbers)), numbers


def test_symmetric_forms_are_those_of_the_literature():
    k, e = 0.4, jnp.array([0.1, -0.3])
    tube = simple_tube(k, k, dk_l=0.0, dk_u=0.0)
    fixed = tube._replace(dlower=jnp.zeros(2), dupper=jnp.zeros(2))
    # y = 0: the state's barrier is the error's, and alpha = q_d' (kc^2 - e^2)/kc^2 rho - k1 e
    rho = k / (2 * e) * jnp.log((k + e) / (k - e))
    alpha = fixed.dq_d * (k**2 - e**2) / k**2 * rho - K1 * e
    state, slope = barriers.StateBarrier(), e * k**4 * (k**2 + e**2) / (k**2 - e**2) ** 3
    for found, expected in (
        (barriers.PrescribedPerformance().value(tube, e), 0.5 * jnp.arctanh(e / k) ** 2),
        (barriers.Tan().value(tube, e), k**2 / np.pi * jnp.tan(np.pi * e**2 / (2 * k**2))),
        (barriers.Quadratic().value(tube, e), 0.5 * e**2),
        (barriers.TransformedError().slope(tube, e), slope),
        (state.value(tube, e), -0.5 * k**2 * jnp.log(1 - (e / k) ** 2)),
        (state.virtual_velocity(fixed, e, K1, None), alpha),
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", BARRIERS)
def test_singular_points_are_finite(name):
    """In float32, whose range is the smaller one."""
    dtype = jnp.float32
    barrier, tube = BARRIERS[name], simple_tube(0.3, 0.5, dtype)
    k1, o = K1.astype(dtype), MARGIN.astype(dtype)

    def everything(tube, q, k1):
        alpha = barrier.virtual_velocity(tube, q, k1, o)
        return barrier.value(tube, q), barrier.slope(tube, q), alpha

    def total(tube, q, k1):
        return sum(jnp.sum(x) for x in everything(tube, q, k1))

    def at(q):
        tangents = jax.tree.map(jnp.ones_like, (tube, q, k1))
        (values, forward), (_, second) = jax.jvp(
            lambda *x: jax.jvp(everything, x, tangents), (tube, q, k1), tangents
        )
        reverse = jax.grad(total, argnums=(0, 1, 2))(tube, q, k1)
        return values, forward, second, reverse

    tiny = float(jnp.finfo(dtype).tiny)
    beside = (-0.3, 0.5, 0.4995, -0.2997, 0.49999, -0.29999, 0.51, -0.4)
    e = [0.0, -0.0, tiny, -tiny, 1e-20, 1e-7, *beside, 3.0, -1e3]
    results = jax.jit(jax.vmap(at))(jnp.asarray(e, dtype)[:, None] * jnp.ones(2, dtype))
    for part in jax.tree.leaves(results):
        assert part.dtype == dtype and bool(jnp.all(jnp.isfinite(part)))
    _, forward, _, reverse = results
    products = jnp.concatenate(jax.tree.leaves(reverse), axis=-1)
    rounding = 1e4 * jnp.finfo(dtype).eps * jnp.sum(jnp.abs(products), axis=-1)
    difference = jnp.abs(jnp.sum(products, axis=-1) - sum(jnp.sum(x, axis=-1) for x in forward))
    assert bool(jnp.all(difference <= rounding + 1e-6))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_removable_singularities_are_accurate(dtype):
    beside = [0.0, 1e-9, -1e-9, 0.2499, 0.2501, -0.2499, -0.2501, 0.0299, 0.0301]
    u = np.asarray([*np.linspace(-3, 0.99, 500), *beside], dtype).astype(np.longdouble)
    exact = [np.where(u == 0, 1, np.sin(u) / np.where(u == 0, 1, u))]
    small = np.abs(u) < 0.05
    series = sum(u**n / (n + 2) for n in range(40))
    exact.append(np.where(small, series, (-np.log1p(-u) - u) / np.where(small, 1, u) ** 2))
    for function, wanted in zip((sinc, log_remainder), exact, strict=True):
        tolerance = 600 * float(jnp.finfo(dtype).eps)  # XLA's log1p itself is good to some 100 eps
        np.testing.assert_allclose(
            function(jnp.asarray(u.astype(float), dtype)), wanted.astype(float), rtol=tolerance
        )
