"""`BarrierBackstepping` refuses references and bounds with too few continuous derivatives, and the
message names what suffices."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from iblf_jax.barriers import Quadratic, TransformedError

import iblf_jax as ij
from iblf_jax import bounds, references

BASE = ij.presets.motor_driven_pendulum()
SHORT = {"duration": 0.5, "dt": 2e-3}


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
    return ij.with_parts(
        BASE,
        reference=reference,
        bounds=BASE.bounds[:1],
        controller=law(**options),
        initial=AT_REST,
    )


AT_REST = ij.Initial(q=0.0, dq=0.0)


@pytest.mark.parametrize(
    ("reference", "has"),
    [
        (references.Quintic(0.0, 0.5, 1.0), 2),
        (references.WaypointSpline((0.0, 1.0), [[0.0], [0.5]]), 2),
        (references.SmoothStep(0.0, 0.5, 1.0, derivatives=2), 2),
    ],
    ids=["quintic", "spline", "step"],
)
def test_a_reference_with_too_few_derivatives_is_refused(reference, has):
    name = type(reference).__name__
    expected = rf"reference: got {name}, which has {has}, expected .* 3 continuous derivatives"
    with pytest.raises(ValueError, match=rf"{expected}.*derivatives=3.*filter="):
        ij.simulate(with_reference(reference), **SHORT)


@pytest.mark.slow
@pytest.mark.parametrize(
    "reference",
    [
        references.SmoothStep(0.0, 0.5, 1.0, derivatives=3),
        references.WaypointSpline((0.0, 1.0), [[0.0], [0.5]], derivatives=3),
    ],
    ids=["step", "spline"],
)
def test_a_reference_with_enough_derivatives_gives_a_continuous_input(reference):
    run = ij.simulate(with_reference(reference), duration=1.2, dt=1e-3)
    assert int(run.status) == 0
    jumps = np.abs(np.diff(np.asarray(run.tau[:, 0])))
    assert jumps.max() < 0.1  # of 4 V


@pytest.mark.slow
def test_a_dynamic_surface_takes_any_reference():
    chain = ij.plants.StrictFeedback(
        drift=lambda t, x: -x, gain=lambda t, x: jnp.ones_like(x), n=1, order=3
    )
    scenario = ij.Scenario(
        plant=chain,
        reference=references.Quintic(0.0, 0.5, 1.0),
        bounds=BASE.bounds[0],
        controller=law(filter=0.01),
        initial=ij.Initial(x=[[0.0], [0.0], [0.0]]),
    )
    assert int(ij.simulate(scenario, **SHORT).status) == 0


def with_bounds(level, barriers):
    side = bounds.Bounds(lower=bounds.Constant(-2.4), upper=Rounded(2.4))
    first = BASE.bounds[0]
    levels = {1: (side,), 2: (first, side), 3: (first, None, side)}[level]
    return ij.with_parts(BASE, controller=law(barriers=barriers), bounds=levels)


@pytest.mark.parametrize(
    ("level", "name", "needed"), [(1, r"bounds\[0\].upper", 3), (2, r"bounds\[1\].upper", 2)]
)
def test_bounds_with_too_few_derivatives_are_refused(level, name, needed):
    barriers = (TransformedError(), TransformedError() if level == 2 else Quadratic(), Quadratic())
    expected = rf"{name}: got Rounded, which has 1, expected a side with {needed} continuous"
    with pytest.raises(ValueError, match=rf"{expected}.*Funnel are smooth"):
        ij.simulate(with_bounds(level, barriers), **SHORT)


@pytest.mark.slow
def test_bounds_of_the_last_level_need_one_derivative():
    scenario = with_bounds(3, (TransformedError(), Quadratic(), TransformedError()))
    assert int(ij.simulate(scenario, **SHORT).status) == 0


@pytest.mark.slow
def test_bounds_of_a_level_without_a_barrier_need_none():
    scenario = with_bounds(2, (TransformedError(), Quadratic(), Quadratic()))
    assert int(ij.simulate(scenario, **SHORT).status) == 0
