"""The Jacobian of the closed loop at a state, computed in steps like those of a run.

An executor makes these steps, so that the closed loop is compiled by the executor and not once more
by XLA.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from iblf_jax.engine.carry import Inputs, Step, StepOptions, tree_where
from iblf_jax.kernels import MIN_TERMS_OF_CALL
from iblf_jax.simulation import error_estimate, stability
from iblf_jax.simulation.closed_loop import (
    LoopState,
    PerturbedState,
    initial_state,
    integrated_part,
    perturbed_rate,
    perturbed_state,
)
from iblf_jax.simulation.scenario import Scenario


class Linearization(NamedTuple):
    """The carry of a `LinearizationStep`: a state around which the closed loop is linearized.

    The state does not change, so what it decides is computed once.
    """

    time: jax.Array
    state: jax.Array
    """(m,)."""
    power_iteration: stability.PowerIteration
    lengths: Any
    """Lengths of the columns of `jacobian` that are found, (3, m') [1/s], where a power iteration
    reads them; `()` elsewhere."""
    unresolved: error_estimate.UnresolvedSignals
    """Of the run; its torque is turned into what it accelerates, as that takes the robot's mass
    matrix."""
    jacobian: Any = ()
    """Of the rate by the m' numbers that `error_estimate` watches, by differences of three sizes,
    (3, m', m') [1/s]; `stability.resolved_jacobian` makes one matrix of the three.  It is `()`
    until all steps are made: each step records its column, because m'^2 numbers in the carry would
    make most of the program."""

    def with_columns(self, columns: jax.Array) -> Linearization:
        """The linearization after its steps, which recorded these columns, (..., steps, m')."""
        size = columns.shape[-1]
        by_size = columns[..., : 3 * size, :].reshape(*columns.shape[:-2], 3, size, size)
        return self._replace(jacobian=jnp.swapaxes(by_size, -1, -2))


@dataclasses.dataclass(frozen=True)
class LinearizationStep(Step):
    """The closed loop's derivative along one direction after the other.

    The directions are at first the unit vectors of the numbers that `error_estimate` watches.
    Where these are the complete state, the modes follow from them; otherwise a power iteration adds
    more directions.
    """

    def __call__(
        self, inputs: Inputs, carry: Linearization, index: jax.Array, options: StepOptions
    ):
        """The carry after the step, and its column of the Jacobian, (m',)."""
        start = initial_state(inputs.scenario)
        watched, x = error_estimate.watched_indices(start), carry.state
        as_state = ravel_pytree(perturbed_state(start))[1]
        iteration = index - 3 * watched.size
        count = jnp.asarray(watched.size, index.dtype)
        size_index = jax.lax.div(index, count)
        number = index - size_index * count
        rank = np.full(x.size, -1, index.dtype)
        rank[watched] = np.arange(watched.size)
        unit = (jnp.asarray(rank) == number).astype(x.dtype)
        direction = jnp.where(iteration < 0, unit, carry.power_iteration.direction)

        def rate_at(y):
            return ravel_pytree(perturbed_rate(inputs.scenario, carry.time, as_state(y)))[0]

        plant = as_state(x)
        if inputs.scenario.sampling is not None:
            plant = plant.plant
        rooms = stability.largest_difference_sizes(inputs.scenario, carry.time, plant, x.size)
        room = jnp.where(
            iteration < 0, jnp.sum(rooms * unit), jnp.asarray(stability.THIRD_SIZE, x.dtype)
        )
        sizes = stability.difference_sizes(x, direction, room)
        widest = size_index == 2
        if len(watched) < x.size:
            # A power iteration follows, across infinite slopes by the widest differences.
            is_sampled = inputs.scenario.sampling is not None
            is_steep = jnp.any(stability.is_infinite(carry.lengths, is_sampled))
            widest |= (iteration >= 0) & is_steep
        is_second = (size_index == 1) & (iteration < 0)
        size = jnp.where(widest, sizes[2], jnp.where(is_second, sizes[1], sizes[0]))
        w = stability.directional_derivative(rate_at, x, direction, size)
        column = jnp.stack([w[i] for i in watched])
        power_iteration, lengths = carry.power_iteration, carry.lengths
        if len(watched) < x.size:
            power_iteration = tree_where(
                iteration < 0,
                power_iteration,
                stability.power_iteration_step(power_iteration, w, iteration),
            )
            columns = jnp.arange(watched.size, dtype=index.dtype) == number
            chosen = (jnp.arange(3, dtype=index.dtype) == size_index)[:, None] & columns
            lengths = jnp.where(chosen, jnp.sum(jnp.abs(column)), lengths)
        unresolved = tree_where(
            index == 0,
            error_estimate.with_acceleration(inputs.scenario, carry.unresolved),
            carry.unresolved,
        )
        return Linearization(carry.time, x, power_iteration, lengths, unresolved), column


def linearization_steps(scenario: Scenario) -> int:
    """Steps of a `LinearizationStep`."""
    state = initial_state(scenario)
    watched = error_estimate.watched_indices(state).size
    if watched == ravel_pytree(perturbed_state(state))[0].size:
        return 3 * watched
    return 3 * watched + stability.POWER_ITERATIONS


def jacobian_carry(scenario: Scenario, time: jax.Array, state: LoopState) -> Linearization:
    """The carry of a `LinearizationStep` of which only the Jacobian at a state is of interest."""
    watched = error_estimate.watched_indices(state).size
    no_estimate = error_estimate.UnresolvedSignals.zero(scenario.n, state.x.dtype)
    return linearization_at(time, perturbed_state(state), watched, no_estimate)


def fastest_modes(scenario: Scenario, found: Linearization) -> jax.Array:
    """The modes that `LinearizationStep`s have found, (...) [1/s]: of what a step integrates.

    Args:
      scenario: the structure of the loops.
      found: linearizations, with leading axes (...).
    """
    jacobian = stability.resolved_jacobian(found.jacobian, scenario.sampling is not None)
    if scenario.sampling is not None:
        size = ravel_pytree(integrated_part(initial_state(scenario)))[0].size
        jacobian = jacobian[..., :size, :size]
    is_complete = jacobian.shape[-1] == found.state.shape[-1]
    if is_complete or scenario.sampling is not None:
        if jacobian.shape[-1] >= MIN_TERMS_OF_CALL:
            return jnp.vectorize(stability.growth_rate_of_matrix, signature="(m,m)->()")(jacobian)
        # (..., m, m) -> (m, m, ...) with the axis of the runs last.
        runs_last = jnp.swapaxes(jacobian.T, 0, 1)
        return stability.growth_rate_of_matrix(runs_last).T
    return stability.growth_rate(found.power_iteration)


def linearization_at(
    time: jax.Array,
    state: LoopState | PerturbedState,
    watched: int,
    unresolved: error_estimate.UnresolvedSignals,
) -> Linearization:
    """The carry of a `LinearizationStep` at a state, as `perturbed_state` gives it, of which
    `error_estimate` watches so many numbers.
    """
    x = ravel_pytree(state)[0]
    lengths: Any = ()
    if watched < x.size:
        lengths = jnp.zeros((3, watched), x.dtype)
    return jax.lax.stop_gradient(
        Linearization(
            time,
            x,
            stability.power_iteration_start(x),
            lengths,
            unresolved,
        )
    )
