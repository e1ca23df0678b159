"""Level sets of plants in strict-feedback form: V' against the closed loop, bounds against points,
and proofs.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from iblf_jax.barriers import Integral, Quadratic, TransformedError

import iblf_jax as ij
from iblf_jax import controllers, disturbances, observers
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.kernels.enclosure import enclose
from iblf_jax.proofs.chains import chain_problem
from iblf_jax.proofs.search import search
from iblf_jax.simulation import closed_loop, levels
from iblf_jax.world.bounds import Bounds, Constant, Sinusoid
from iblf_jax.world.references import Sinusoid as SinusoidalReference


@component
class Lever:
    """x1' = x2,   J x2' = u - b x2 - m sin x1."""

    J: Leaf = leaf("1", sign="positive")
    b: Leaf = leaf("1", sign="nonnegative")
    m: Leaf = leaf("1")
    n: ClassVar[int] = 1
    order: ClassVar[int] = 2

    def drift(self, t, x):
        load = self.b * x[1] + self.m * jnp.sin(x[0])
        return jnp.stack([jnp.zeros_like(x[0]), -load / self.J])

    def gain(self, t, x):
        one = jnp.ones_like(x[0])
        return jnp.stack([one, one / self.J])

    def level_input(self, level, t, x, rate, torque):
        if level == 1:
            return rate
        return self.J * rate + self.b * x[1] + self.m * jnp.sin(x[0])


def lever(*law_barriers, kappa=(0.0, 40.0), **fields) -> ij.Scenario:
    both = law_barriers or (TransformedError(), TransformedError())
    law = controllers.BarrierBackstepping(k=(2.0, 8.0), barriers=both, weights=(89.0, 10.0))
    scenario = ij.Scenario(
        plant=Lever(J=1.2, b=0.3, m=2.0),
        reference=SinusoidalReference(offset=0.1, amplitude=0.4, frequency=1.0),
        bounds=(
            Bounds(lower=Constant(-0.8), upper=Sinusoid(offset=0.9, amplitude=0.1, frequency=2.0)),
            Bounds(lower=Constant(-2.0), upper=Constant(2.5)),
        ),
        disturbance=disturbances.Levels((None, disturbances.Sinusoids(0.3, 2.0))),
        controller=law,
        observer=observers.LevelObserver(gain=kappa),
        initial=ij.Initial(q=0.1, dq=0.0),
    )
    return dataclasses.replace(scenario, **fields)


def within(width: float, *names: str) -> dict:
    return {f"plant.{name}": ij.factor(ij.interval(1 - width, 1 + width)) for name in names}


def pendulum(law_barriers, **fields) -> ij.Scenario:
    """The pendulum with a motor, with gains for which uncertain parameters can be proved."""
    numbers = {"k": (3.12, 11.64, 188.6), "weights": (138.9, 6.265, 3.079)}
    law = controllers.BarrierBackstepping(barriers=law_barriers, **numbers)
    fields = {"observer": observers.LevelObserver(gain=(0.0, 38.2, 0.0)), **fields}
    return dataclasses.replace(ij.presets.motor_driven_pendulum(), controller=law, **fields)


LEVER = ("J", "b", "m")
PENDULUM = ("D", "B", "N", "M", "H", "Km")
PENDULUM_WEIGHT = 8.1


@jax.jit
def derivative_along_the_loop(scenario, weights):
    """V and its derivative along the closed loop at its start."""

    def energy(t, state):
        x, loop = state.x, scenario.loop
        d_hat = loop.observer.estimate(t, x, loop.model, state.observer)
        if d_hat.ndim == 1:
            d_hat = jnp.zeros_like(x)
        command, _ = scenario.controller.command(t, x, d_hat, scenario.context, ())
        d = loop.model.uncertain(t, x, levels.motion(scenario, t, x, command.tau), command.tau)
        return jnp.sum(command.V1) + 0.5 * jnp.sum(weights * (d - d_hat) ** 2)

    state = closed_loop.initial_state(scenario)
    return jax.jvp(energy, (0.0, state), (1.0, closed_loop.rate(scenario, 0.0, state)))


def check_points(scenario, parameters, level, count=6):
    """V' at random points against the closed loop that starts there."""
    problem = chain_problem(scenario, parameters)
    constants = problem.constants(1.0, level)
    numbers = jax.tree.unflatten(problem.bound.structure, constants)
    weights = np.where(np.array(problem.bound.observed)[:, None], numbers.weights, 0.0)
    points = problem.sample(1, count)
    for point, rate in zip(points, problem.rate(points, constants), strict=True):
        value, found = derivative_along_the_loop(problem.scenario_at(point, constants), weights)
        assert float(value) == pytest.approx(level, rel=1e-12)
        assert float(found) == pytest.approx(rate, rel=1e-10, abs=1e-10 * level)


LEVERS = {
    "TransformedError, the second level observed": lever(),
    "both levels observed": lever(kappa=(5.0, 30.0)),
    "Integral, no observer, another model": lever(
        Integral(), Integral(), observer=observers.NoObserver(), model=Lever(J=1.0, b=0.2, m=1.9)
    ),
}


SIMPLEST, BOTH_OBSERVED, UNOBSERVED = LEVERS


@pytest.mark.slow
@pytest.mark.parametrize("name", [SIMPLEST, UNOBSERVED])
def test_rate_of_v_is_that_of_the_closed_loop(name):
    check_points(LEVERS[name], within(0.2, *LEVER), 0.3)


@pytest.mark.release
def test_rate_of_v_of_order_3():
    """With an observer of the second level, with one of all levels and with none."""
    every = {"observer": observers.LevelObserver(gain=(5.0, 20.0, 30.0))}
    for parts in ({}, every, {"observer": observers.NoObserver()}):
        scenario = pendulum((TransformedError(),) * 3, **parts)
        check_points(scenario, within(0.05, *PENDULUM), 0.2)


def points_of(problem, x):
    """The points (t, s, z) of coordinates with their patterns, (count, p)."""
    order = len(problem.bound.observed)
    angles = order + sum(problem.bound.observed) - 1
    rest = np.ones(len(x))
    shares = []
    for k in range(angles):
        shares.append(rest * np.cos(x[:, 1 + k]))
        rest = rest * np.sin(x[:, 1 + k])
    shares = np.stack([*shares, rest], axis=1)
    start = len(problem.lower)
    shares[:, :order] = np.abs(shares[:, :order]) * x[:, start : start + order]
    t = x[:, :1] + x[:, -1:]
    return np.concatenate([t, shares, x[:, 1 + angles : start]], axis=1)


def check_bounds(scenario, parameters, level):
    """Bounds of random boxes against a random point of each."""
    problem = chain_problem(scenario, parameters)
    constants = problem.constants(1.0, level)
    generator = np.random.default_rng(2)
    count = 2000
    size = problem.upper - problem.lower
    share = generator.uniform(0.0, 0.9, (count, len(size)))
    width = 10.0 ** generator.uniform(-6.0, -1.0, (count, 1))
    low = problem.lower + share * size
    high = low + width * size
    inside = low + generator.uniform(size=low.shape) * (high - low)
    patterns = problem.patterns[generator.integers(len(problem.patterns), size=count)]
    boxes = [np.concatenate([corner, patterns], axis=1) for corner in (low, high)]
    _, upper = enclose(problem.bound, *boxes, constants)
    bounds = np.asarray(upper[0]).reshape(-1)
    x = np.concatenate([inside, patterns], axis=1)
    rates = problem.rate(points_of(problem, x), constants)
    assert not np.any(bounds < rates - 1e-9 * (1.0 + np.abs(rates)))
    narrow = np.isfinite(bounds) & (width[:, 0] < 1e-5)
    assert narrow.sum() > 100 and np.median(bounds[narrow] - rates[narrow]) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", [BOTH_OBSERVED, UNOBSERVED])
def test_bounds_are_above_the_points_of_their_boxes(name):
    """`test_attacks` has those of the first loop, with more uncertain numbers."""
    check_bounds(LEVERS[name], within(0.1, *LEVER), 0.3)


@pytest.mark.release
@pytest.mark.parametrize("kind", [TransformedError, Quadratic])
def test_bounds_of_order_3(kind):
    check_bounds(pendulum((TransformedError(), kind(), kind())), within(0.05, *PENDULUM), 0.5)


def proved(problem, weight, level, max_boxes):
    constants = problem.constants(weight, level)
    options = {"patterns": problem.patterns, "max_boxes": max_boxes, "progress": False}
    found = search(problem.bound, problem.lower, problem.upper, constants, **options)
    return found, problem.rate(problem.sample(3, 20_000), constants).max()


@pytest.mark.slow
def test_lever_with_uncertain_parameters_is_proved():
    found, largest = proved(chain_problem(lever(), within(0.05, *LEVER)), 1.0, 0.3, 3_000_000)
    assert found.proved
    assert largest < 0.0
    scenario = lever(kappa=(0.0, 2.0))
    found, largest = proved(chain_problem(scenario, within(0.5, *LEVER)), 1.0, 0.3, 200_000)
    assert not found.proved
    assert largest > 0.0


@pytest.mark.release
def test_pendulum_with_a_motor_is_proved():
    scenario = pendulum((TransformedError(), Quadratic(), Quadratic()))
    problem = chain_problem(scenario, within(0.05, *PENDULUM))
    found, largest = proved(problem, PENDULUM_WEIGHT, 0.5, 500_000_000)
    assert found.proved
    assert largest < 0.0


def with_gains(**fields):
    return lever(controller=controllers.BarrierBackstepping(k=(2.0, 8.0), **fields))


OTHER_KIND = observers.StateObserver(bandwidth=30.0)
KEEPS_ESTIMATE = observers.LevelObserver(gain=(0.0, 9.0), eta0=(0.1, 0.0))
REFUSED = {
    "n": (ij.presets.vessel(), "one number per level"),
    "a robot inside": (ij.presets.motor_driven_two_link(), "without a robot inside"),
    "filters": (with_gains(filter=0.01), "exact derivatives"),
    "matrices": (with_gains(gain_matrices=[[[1.0]], [[2.0]]]), "matrices as gains or weights"),
    "an observer of another kind": (lever(observer=OTHER_KIND), "LevelObserver or NoObserver"),
    "an estimate that is kept": (lever(observer=KEEPS_ESTIMATE), "0 where the gain is 0"),
    "a rigid arm": (ij.presets.zhang_yan_2024(), "strict-feedback form"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_supported_is_refused(name):
    scenario, expected = REFUSED[name]
    with pytest.raises(ValueError, match=expected):
        chain_problem(scenario, {})
