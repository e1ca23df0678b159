"""Barriers against the paper's statements: Theorem 1, Lemma 1, kappa, and the guard.

Quadrature and limits, for every barrier, are in `test_barriers_systems.py`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from iblf_jax.barriers import Integral, Log, guard_is_active, guarded_error
from iblf_jax.bounds import Tube

from iblf_jax.control.barriers._base import paper_virtual_velocity

INSIDE = st.floats(-0.998, 0.998)
WIDTH = st.floats(1e-3, 1e3)
RATE = st.floats(-1e3, 1e3)


def tube(k_l, k_u, dk_l=0.0, dk_u=0.0, q_d=0.0):
    """A tube of these widths and rates around q_d."""
    shaped = np.broadcast_arrays(
        *(
            np.atleast_1d(np.asarray(x, float))
            for x in (q_d, 0.0, q_d - k_l, q_d + k_u, -dk_l, dk_u)
        )
    )
    return Tube(*shaped)


def compiled(function):
    """`function` under jit, for arguments that may be lists of numbers."""
    inner = jax.jit(function)
    return lambda part, *args: inner(
        part, *(x if isinstance(x, Tube) else np.asarray(x, float) for x in args)
    )


value = compiled(lambda barrier, tube, q: barrier.value(tube, q))
slope = compiled(lambda barrier, tube, q: barrier.slope(tube, q))
alpha = compiled(lambda barrier, tube, q, k1, o: barrier.virtual_velocity(tube, q, k1, o))
derivative = compiled(
    lambda barrier, tube, q: jax.grad(lambda q: jnp.sum(barrier.slope(tube, q)))(q)
)
xi_of = compiled(lambda tube, q: tube.xi(q))
# alpha = q_d' - (k1 + kappa) e1 for k1 = 0 and e1 = 1.
kappa_of = compiled(
    lambda tube, o: tube.dq_d - paper_virtual_velocity(tube, tube.q_d + 1.0, 0.0, o)
)


@given(xi=INSIDE)
def test_theorem_1(xi):
    """xi^2 / 2 <= V1 <= xi^2 / (1 - xi^2) on |xi| < 1."""
    V1 = float(value(Integral(), tube(0.3, 0.5), [xi * (0.5 if xi > 0 else 0.3)])[0])
    rounding = 1e-12 * V1 + 1e-300
    assert xi**2 / 2 - rounding <= V1 <= xi**2 / (1 - xi**2) + rounding


@given(e1=st.floats(-3, 3), k_l=st.floats(0.01, 2), k_u=st.floats(0.01, 2))
def test_lemma_1(e1, k_l, k_u):
    """|xi| < 1 if and only if -k_l < e1 < k_u."""
    assume(min(abs(e1 + k_l), abs(e1 - k_u)) > 1e-12)
    assert (abs(float(xi_of(tube(k_l, k_u), [e1])[0])) < 1) == (-k_l < e1 < k_u)


@given(k_l=WIDTH, k_u=WIDTH, dk_l=RATE, dk_u=RATE, o=st.floats(1e-6, 10))
def test_kappa_outweighs_the_motion_of_the_bound(k_l, k_u, dk_l, dk_u, o):
    """kappa + k'/k >= 0 on both sides for every o > 0 (which needs the root that the printed text
    lost)."""
    kappa = float(kappa_of(tube(k_l, k_u, dk_l, dk_u), o)[0])
    largest = max(1.0, abs(dk_u / k_u), abs(dk_l / k_l))
    assert kappa + dk_u / k_u >= -1e-12 * largest
    assert kappa + dk_l / k_l >= -1e-12 * largest


def test_without_the_root_kappa_fails_on_the_papers_bounds():
    """The text as printed, o = 0.1: the inequality before (3.9) is false 22 % of the time for each
    joint."""
    t = np.linspace(0, 2 * np.pi, 20001)
    k_u = np.stack([0.4 + 0.14 * (np.cos(t) - np.sin(t)), 0.4 + 0.14 * (np.sin(t) - np.cos(t))])
    k_l = np.stack([0.3 + 0.14 * (np.sin(t) - np.cos(t)), 0.3 + 0.14 * (np.cos(t) - np.sin(t))])
    u, low = np.gradient(k_u, t, axis=1) / k_u, np.gradient(k_l, t, axis=1) / k_l
    printed = u**2 + low**2 + 0.1
    assert np.mean((printed + u < 0) | (printed + low < 0)) == pytest.approx(0.22, abs=0.005)
    kappa = kappa_of(tube(k_l.ravel(), k_u.ravel(), (low * k_l).ravel(), (u * k_u).ravel()), 0.1)
    assert np.all(np.asarray(kappa) + u.ravel() > 0)


def test_the_guard_is_exact_inside_and_tangent_beyond():
    barrier, t = Integral(guard=0.01), tube(0.3, 0.5)
    inside, edge, beyond = 0.98 * 0.5, 0.99 * 0.5, 0.7
    e = np.asarray([inside])
    np.testing.assert_allclose(slope(barrier, t, e), 2 * e / (0.25 - e**2), rtol=1e-13)
    held = float(slope(barrier, t, [edge])[0])
    assert float(slope(barrier, t, [beyond])[0]) == pytest.approx(held)
    assert float(slope(barrier, t, [100.0])[0]) == pytest.approx(held)
    rise = float(value(barrier, t, [beyond])[0] - value(barrier, t, [edge])[0])
    assert rise == pytest.approx(held * (beyond - edge))


def test_the_guarded_error_on_both_sides():
    """e = min(|e1|, (1 - guard) k) sign(e1) and the rest beyond, with the width and the rate of the
    side that e1 is on."""
    t = tube(*np.array([[0.3] * 4, [0.5] * 4]), dk_l=0.1, dk_u=-0.2, q_d=1.0)
    e1 = np.array([-0.4, -0.1, 0.49, 0.7])
    got = guarded_error(t, jnp.asarray(1.0 + e1), 0.1)
    np.testing.assert_allclose(got.e, [-0.27, -0.1, 0.45, 0.45], rtol=1e-12)
    np.testing.assert_allclose(got.e + got.beyond, e1, rtol=1e-12)
    np.testing.assert_allclose(got.k, [0.3, 0.3, 0.5, 0.5], rtol=1e-12)
    np.testing.assert_allclose(got.dk, [0.1, 0.1, -0.2, -0.2], rtol=1e-12)
    assert list(guard_is_active(t, jnp.asarray(1.0 + e1), 0.1)) == [True, False, True, True]


@given(
    e=st.floats(allow_nan=False, allow_infinity=False, width=32),
    k_l=st.floats(0, 10),
    k_u=st.floats(0, 10),
)
def test_finite_for_any_error_and_any_width(e, k_l, k_u):
    """Widths of zero too: a reference on its bound is flagged, not divided by."""
    t = tube(k_l, k_u, 0.3, -0.4)
    for barrier in (Integral(), Log(p=2)):
        numbers = [
            value(barrier, t, [e]),
            slope(barrier, t, [e]),
            alpha(barrier, t, [e], 2.0, 0.1),
            derivative(barrier, t, [e]),
        ]
        assert np.all(np.isfinite(np.concatenate(numbers))), numbers
