"""Attacks on the proofs: cases in which a bound was, or might be, below V', and what is refused."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from proof_cases import pendulum
from test_arm_proofs import chain_loop, coordinates_of
from test_chains import LEVER, check_bounds, lever, within
from test_chains import pendulum as pendulum_with_motor

import iblf_jax as ij
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.kernels.enclosure import enclose
from iblf_jax.proofs.arms import MOST_NUMBERS, arm_problem
from iblf_jax.proofs.chains import chain_problem
from iblf_jax.proofs.forms import enclosed
from iblf_jax.proofs.search import search

WEIGHT, LEVEL = 2e-3, 0.8
TransformedError, Quadratic = ij.barriers.TransformedError, ij.barriers.Quadratic


@pytest.mark.slow
def test_entries_with_one_value_differ_from_the_model_at_the_reference_value():
    """At the reference value, the mass of 2, the inertia of 0.06 becomes 2."""
    together = {"plant.mass, plant.inertia": ij.value(ij.interval(1.99, 2.01))}
    problem = arm_problem(pendulum(), together)
    constants = problem.constants(WEIGHT, LEVEL)
    points = problem.sample(2, 300)
    x = np.array([coordinates_of(point, 1) for point in points])
    _, (bounds, _) = enclose(problem.bound, x, x, constants)
    rate = problem.rate(points, constants)
    assert np.all(bounds >= rate[:, None] - 1e-9 * np.abs(rate[:, None]))


@pytest.mark.slow
def test_levels_of_a_disturbance_with_one_value_differ_from_what_is_known():
    """Beside as many other uncertain numbers as only a chain may have."""
    waves = tuple(ij.disturbances.Sinusoids(*x) for x in ((0.3, 2.0, 0.5, 0.1), (0.1, 1.0, 0.2)))
    scenario = lever(disturbance=ij.disturbances.Levels((None, ij.disturbances.Sum(waves))))
    one, other = (f"disturbance.parts[1].parts[{i}]" for i in range(2))
    others = (f"{one}.phase", f"{other}.amplitude", f"{other}.phase")
    uncertain = {path: ij.factor(ij.interval(0.9, 1.1)) for path in others}
    uncertain[f"{one}.amplitude, {one}.offset"] = ij.value(ij.interval(0.2, 0.4))
    uncertain |= within(0.1, *LEVER)
    assert len(uncertain) > MOST_NUMBERS
    check_bounds(scenario, uncertain, 0.3)


def narrow_between_samples():
    """A loop whose tube is widest at every sampled instant of its time interval."""
    side = {"phase": [0.5 * np.pi], "frequency": 1.0, "amplitude": [0.25]}
    upper, barrier = ij.bounds.Sinusoid(offset=[0.45], **side), ij.barriers.Tan(guard=0.2)
    return chain_loop(
        1,
        reference=ij.references.Sinusoid(0.0, 0.0, 1.0),
        bounds=ij.Bounds(lower=ij.bounds.Constant([-0.7]), upper=upper),
        controller=ij.controllers.Backstepping(2.0, 3.0, variant="corrected", barrier=barrier),
    )


@pytest.mark.slow
def test_the_guard_is_examined_between_the_sampled_instants():
    problem = arm_problem(narrow_between_samples(), {}, duration=1023 * 2 * np.pi)
    constants = problem.constants(WEIGHT, 0.2)
    # At theta = 0 the first error has the whole level.
    wide, narrow = ([t, 0.0, 0.0, 1.0, 0.0] for t in (0.0, np.pi))
    _, (bounds, _) = enclose(problem.bound, [wide, narrow], [wide, narrow], constants)
    assert np.all(np.isfinite(bounds[0])) and np.all(np.isinf(bounds[1]))


def test_a_derivative_that_jumps_is_enclosed_across_its_jump():
    """max(t, 0)^3 has two continuous derivatives; the third one jumps from 0 to 6."""

    def third(x, constants):
        function = enclosed(lambda t: jnp.maximum(t, 0.0) ** 3, continuous_derivatives=2)
        for _ in range(3):
            function = (lambda f: lambda t: jax.jvp(f, (t,), (jnp.ones_like(t),))[1])(function)
        return function(x[0])[None]

    (below,), (above,) = enclose(third, [[-1.0], [-0.1]], [[0.5], [1.0]])
    assert np.all(below <= 0.0) and np.all(above >= 6.0)


@component
class Loaded:
    """x1' = x2,   x2' = u - load(t, x, size)."""

    size: Leaf = leaf("1")
    load: Any = static()
    n: ClassVar[int] = 1
    order: ClassVar[int] = 2

    def drift(self, t, x):
        return jnp.stack([jnp.zeros_like(x[0]), -self.load(t, x, self.size)])

    def gain(self, t, x):
        return jnp.ones_like(x)


def aging(t, x, size):
    """The load grows with the time, although everything else is periodic."""
    return size * jnp.sin(x[0]) * (1.0 + 0.01 * t)


def with_threshold(t, x, size):
    """The load has another sign where a parameter is below 1."""
    return jnp.where(size > 1.0, 1.0, -1.0) * jnp.sin(x[0])


def with_moved_kink(t, x, size):
    """The rate of the load jumps with the parameter: at 20 of 3000 points a bound was below V'."""
    return jnp.clip(x[1], -size, size)


@component
class Ramp:
    """A position whose acceleration jumps at 1 s."""

    continuous_derivatives: ClassVar[int] = 1

    def position(self, t):
        return 0.5 + 0.05 * jnp.maximum(t - 1.0, 0.0)[None] ** 2


def test_plants_with_time_cases_or_moved_kinks_and_a_reference_that_jumps_are_refused():
    for load, words, duration in (
        (aging, "does not depend on the time", None),
        (aging, "does not depend on the time", 2.0),
        (with_threshold, "select a case", None),
        (with_moved_kink, "jumps where a parameter says", None),
    ):
        plant = Loaded(1.0, load)
        with pytest.raises(ValueError, match=words):
            chain_problem(lever(plant=plant, model=plant), within(0.1, "size"), duration=duration)
    with pytest.raises(ValueError, match="two continuous derivatives"):
        arm_problem(pendulum(reference=Ramp()), {}, duration=2.0)


@pytest.mark.slow
def test_a_mass_matrix_that_is_singular_inside_the_box_is_not_proved():
    """The mass of the model is far from zero, that of the box is zero at an inner point."""
    problem = arm_problem(pendulum(), {"plant.mass": ij.factor(ij.interval(0.9, 1.1))})
    low, high = problem.lower.copy(), problem.upper.copy()
    k = problem.names.index("plant.mass[0]")
    low[k], high[k] = -2.0, 1.1
    constants = problem.constants(WEIGHT, LEVEL)
    box = {"patterns": problem.patterns, "progress": False, "max_boxes": 20_000}
    assert not search(problem.bound, low, high, constants, **box).proved


@pytest.mark.slow
def test_nothing_is_claimed_about_bounds_without_a_barrier():
    claimed = chain_problem(lever(), within(0.1, *LEVER)).assumptions
    assert not any("Nothing is claimed" in sentence for sentence in claimed)
    mixed = pendulum_with_motor((TransformedError(), Quadratic(), Quadratic()))
    assert any("the bounds of x_2, x_3" in x for x in chain_problem(mixed, {}).assumptions)
    free = dataclasses.replace(mixed, bounds=mixed.bounds[0])
    assert not any("Nothing" in x for x in chain_problem(free, {}).assumptions)


@pytest.mark.slow
def test_an_uncertain_wave_does_not_end_with_the_period_of_the_others():
    """An amplitude that is 0 in the scenario, and a frequency, may be any number of the box."""
    rest = {
        "reference": ij.references.Sinusoid(0.5, 0.0, 1.0),
        "bounds": ij.Bounds(lower=ij.bounds.Constant([0.1]), upper=ij.bounds.Constant([1.0])),
    }
    silent = pendulum(disturbance=ij.disturbances.Sinusoids([0.0], [2.0]), **rest)
    assert arm_problem(silent, {}).duration == 0.0
    loud = {"disturbance.amplitude": ij.offset(ij.interval(-1.0, 1.0))}
    assert arm_problem(silent, loud).duration == pytest.approx(np.pi)
    faster = {"disturbance.parts[1].frequency": ij.factor(ij.interval(0.9, 1.1))}
    with pytest.raises(ValueError, match="is uncertain"):
        chain_problem(lever(), faster)
    assert not chain_problem(lever(), faster, duration=2.0).is_period
