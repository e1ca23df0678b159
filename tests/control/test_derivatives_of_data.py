"""`BarrierBackstepping` refuses references and bounds with too few continuous derivatives, and the
message names what suffices."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
import pytest
from iblf_jax.barriers import Quadratic, TransformedError

import iblf_jax as ij
from iblf_jax import bounds, references
from iblf_jax.simulation.scenario import canonical

BASE = ij.presets.motor_driven_pendulum()


@ij.component
class Rounded:
    """A bound whose second derivative jumps at t = 0.3 s."""

    value: ij.Leaf = ij.leaf("rad")
    continuous_derivatives: ClassVar[int] = 1

    def at(self, t, q_d):
        late = jnp.maximum(t - 0.3, 0.0)
        return jnp.broadcast_to(self.value * (1.0 + 0.1 * late**2), q_d.shape)


def law(**options):
    return ij.controllers.BarrierBackstepping(k=(2.0, 15.0, 60.0), **options)


def with_reference(reference, **options):
    parts = {"reference": reference, "bounds": BASE.bounds[:1]}
    parts |= {"controller": law(**options), "initial": ij.Initial(q=0.0, dq=0.0)}
    return ij.with_parts(BASE, **parts)


def with_bounds(level, barriers):
    side = bounds.Bounds(lower=bounds.Constant(-2.4), upper=Rounded(2.4))
    first = BASE.bounds[0]
    levels = {1: (side,), 2: (first, side), 3: (first, None, side)}[level]
    return ij.with_parts(BASE, controller=law(barriers=barriers), bounds=levels)


@pytest.mark.parametrize(
    ("level", "name", "needed"), [(1, r"\[0\].upper", 3), (2, r"\[1\].upper", 2)]
)
def test_bounds_with_too_few_derivatives_are_refused(level, name, needed):
    barriers = (TransformedError(), TransformedError() if level == 2 else Quadratic(), Quadratic())
    expected = rf"{name}: got Rounded, which has 1, expected a side with {needed} continuous"
    with pytest.raises(ValueError, match=rf"{expected}.*Funnel are smooth"):
        canonical(with_bounds(level, barriers))


def test_what_needs_fewer_derivatives_is_accepted():
    """Bounds of the last level need one, those of a level without a barrier none, and a dynamic
    surface takes any reference."""
    canonical(with_bounds(3, (TransformedError(), Quadratic(), TransformedError())))
    canonical(with_bounds(2, (TransformedError(), Quadratic(), Quadratic())))
    canonical(with_reference(references.Quintic(0.0, 0.5, 1.0), filter=0.01))
