"""Centred forms: enclosures whose error is of second order in the width of an interval."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from iblf_jax.control.barriers import Barrier
from iblf_jax.kernels import lower, meet, upper


def centre(x: jax.Array) -> jax.Array:
    """The middle of an interval; x itself, of a number."""
    return 0.5 * (lower(x) + upper(x))


def derivative(function: Callable) -> Callable:
    """The derivative of a function of one number."""

    def rate(t: jax.Array) -> Any:
        return jax.jvp(function, (t,), (jnp.ones_like(t),))[1]

    return rate


def along(function: Callable, point: tuple, rates: tuple) -> Any:
    """The derivative of a function along rates of its arguments."""
    return jax.jvp(function, point, rates)[1]


def degree(barrier: Barrier) -> int:
    """d: V1 is homogeneous of this degree in lengths."""
    return 2 if barrier.value_unit == "rad^2" else 0


def enclosed(function: Callable, continuous_derivatives: float = math.inf) -> Callable:
    """A function of one number t with a narrow enclosure, also of its derivatives.

        g(t) in g(c) + (t - c) (g'(c) + 1/2 g"(T) (t - c)),   c the centre of the interval T of t

    and in the natural extension g(T), of which the common part is taken.  On numbers it is the
    function itself.  The form needs a continuous g'; the natural extension g" of a function with
    cases contains the derivatives of all of them.  Derivatives that jump have the natural extension
    alone.

    Args:
      function: t, () -> pytree of arrays.
      continuous_derivatives: their number.
    """
    if continuous_derivatives < 1:
        return function
    rate = derivative(function)

    @jax.custom_jvp
    def form(t: jax.Array) -> Any:
        c = centre(t)
        away = t - c

        def narrower(natural, value, slope, curvature):
            return meet(natural, value + away * (slope + 0.5 * curvature * away))

        return jax.tree.map(narrower, function(t), function(c), rate(c), derivative(rate)(t))

    @form.defjvp
    def form_jvp(primals: tuple, tangents: tuple) -> tuple:
        (t,), (dt,) = primals, tangents
        slopes = enclosed(rate, continuous_derivatives - 1)(t)
        return form(t), jax.tree.map(lambda slope: slope * dt, slopes)

    return form
