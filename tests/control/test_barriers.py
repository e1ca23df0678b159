"""Barriers against the paper's statements: Theorem 1, Lemma 1, kappa, and the guard.

Quadrature and limits, for every barrier, are in `test_barriers_systems.py`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from iblf_jax.barriers import Integral, Log, guard_is_active, guarded_error
from iblf_jax.bounds import Tube


def tube(k_l, k_u, dk_l=0.0, dk_u=0.0, q_d=0.0):
    """A tube of these widths and rates around q_d."""
    numbers = q_d, 0.0, q_d - k_l, q_d + k_u, -dk_l, dk_u
    return Tube(*np.broadcast_arrays(*(np.atleast_1d(np.asarray(x, float)) for x in numbers)))


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


@given(e=st.floats(-1e38, 1e38), k_l=st.floats(0, 10), k_u=st.floats(0, 10))
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
