"""Inputs and carry of a step: what a run is made from, and what goes from one step to the next.

`initial_carry` creates the carry before the first step.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.engine.metric_folds import initial_accumulators
from iblf_jax.simulation import error_estimate, error_growth, stability
from iblf_jax.simulation.closed_loop import (
    LoopState,
    evaluate,
    initial_state,
    perturbed_state,
)
from iblf_jax.simulation.noise import distances
from iblf_jax.simulation.scenario import Scenario

if TYPE_CHECKING:
    from iblf_jax.simulation.metrics import Fold


class Inputs(NamedTuple):
    """What a run is made from: its leaves are inputs of what is compiled, never constants (but see
    `engine.structural_constants`).
    """

    scenario: Scenario
    folds: tuple[Fold, ...]
    dt: jax.Array
    steps: jax.Array
    """(), a float: integers are not leaves of a scalar program."""
    noise_key: Any = ()
    """Key of the run's random numbers (`noise.noise_key`), where it has any."""
    direction: Any = ()
    """Tangents of leaves, where a step takes them as data."""


class Nearest(NamedTuple):
    """The instant at which a joint was nearest to its bound."""

    xi: jax.Array
    t: jax.Array
    state: Any
    """What `closed_loop.perturbed_state` gives there."""


class Carry(NamedTuple):
    """What goes from step to step."""

    state: LoopState
    accumulators: tuple
    status: jax.Array
    nearest: Nearest
    accuracy: error_estimate.Accuracy
    distances: Any
    """To the bounds at the last instant, `noise.distances`; empty without process noise."""


class StepOptions(NamedTuple):
    """How the code of a step is generated for an executor; the numbers do not depend on it."""

    rolled: bool = False
    """Whether the stages of the integrator are a loop."""
    scalar: bool = False
    """Whether the step becomes a scalar program, in which equal numbers are computed once."""


class Step:
    """A step of a run (head of `engine.time_step`), or of its derivatives."""

    is_derivative: ClassVar[bool] = False
    """Whether it computes derivatives."""
    __call__: Callable[..., tuple[Any, Any]]


def tree_where(condition, new, old):
    """`new` where the condition holds, leaf by leaf, else `old`."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


# inline, so that JAX traces it once for the shapes of a plan and for the program of the start
@partial(jax.jit, static_argnames="method", inline=True)
def initial_carry(inputs: Inputs, method: str, jacobian: jax.Array) -> Carry:
    """The carry before the first step; accumulators that begin with something of the first sample
    are blank until then.

    Args:
      inputs: of the run.
      method: the integrator.
      jacobian: what a `LinearizationStep` has found at the start.
    """
    state, zero = initial_state(inputs.scenario), jnp.zeros_like(inputs.dt)
    shapes = jax.eval_shape(evaluate, inputs.scenario, inputs.dt, state)[1]
    sample = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    blank = initial_accumulators(inputs.folds, sample)
    constant, jacobian = jax.lax.stop_gradient((state, jacobian))
    growth = error_growth.initial_growth(inputs.scenario, constant, jacobian)
    if inputs.scenario.sampling is not None:
        jacobian = stability.period_map_as_rate(
            jax.lax.stop_gradient(inputs.scenario), constant, jacobian
        )
    accuracy = error_estimate.initial_accuracy(method, jacobian, constant)._replace(
        error_growth=growth
    )
    return Carry(
        state,
        blank,
        jnp.int32(0),
        Nearest(-jnp.ones_like(zero), zero, perturbed_state(constant)),
        accuracy,
        distances(inputs.scenario, sample),
    )


def carry_without_accuracy(inputs: Inputs, method: str) -> Carry:
    """As `initial_carry`, without a linearization: its estimate of the accuracy has no meaning."""
    size = error_estimate.watched_indices(initial_state(inputs.scenario)).size
    return initial_carry(inputs, method, jnp.zeros((size, size), inputs.dt.dtype))
