"""V_w of states of a robot's loop: that of the torque which the law would command there."""

from __future__ import annotations

import dataclasses
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.observers import Momentum
from iblf_jax.control.sensors import Ideal
from iblf_jax.core import programs
from iblf_jax.core.linalg import inner, matvec
from iblf_jax.core.pytree import unwrapped
from iblf_jax.proofs.torque import without_limits
from iblf_jax.simulation import closed_loop
from iblf_jax.simulation.closed_loop import LoopState
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario


def before_sampling(scenario: Scenario) -> Scenario:
    """The loop whose law acts at a state as at a sample of a sampled loop, with the gain of its
    observer.

    The state of a sampled loop at the start has no torque and no estimate of a sample yet.
    """
    sampling, observer = scenario.sampling, cast(Momentum, scenario.observer)
    if sampling is None:
        return scenario
    if sampling.observer == "poles":
        observer = observer.at_period(sampling.period)
    return dataclasses.replace(scenario, sampling=None, observer=observer, sensor=Ideal())


def terms(scenario: Scenario, t: jax.Array, state: LoopState) -> tuple[jax.Array, jax.Array]:
    """V_w without the term of f_tilde, and |f_tilde|^2/2, at a state of a continuous loop."""
    _, sample = closed_loop.evaluate(scenario, t, state)
    law = unwrapped(scenario.controller)
    V1 = law.weight * law.barrier.value(scenario.context.tube(t), state.q)
    kinetic = inner(sample.e2, matvec(scenario.model.mass_matrix(state.q), sample.e2))
    f_tilde = sample.disturbance - sample.disturbance_estimate
    return jnp.sum(V1) + 0.5 * kinetic, 0.5 * inner(f_tilde, f_tilde)


@programs.jit
def _terms_at(
    scenario: Scenario, t: jax.Array, x: jax.Array, estimates: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """`terms` at states with these estimates, (T,) each."""
    start, model = closed_loop.initial_state(scenario), scenario.model
    observer = cast(Momentum, scenario.observer)

    def at(t: jax.Array, x: jax.Array, estimate: jax.Array) -> tuple[jax.Array, jax.Array]:
        eta = estimate - observer.kf * matvec(model.mass_matrix(x[0]), x[1])
        return terms(scenario, t, start._replace(x=x, observer=eta))

    return jax.vmap(at)(t, x, estimates)


def sampled_values(scenario: Scenario, run: Rollout, weight: float) -> np.ndarray:
    """V_w at recorded samples of a sampled loop, (T,) [N m rad].

    Args:
      scenario: of the run, with the torque of a sample applied from it on.
      run: of it, recorded at samples.
      weight: w [rad/(N m)].
    """
    loop = before_sampling(without_limits(scenario)[0])
    energy, half_square = _terms_at(loop, run.t, run.x, run.disturbance_estimate)
    return np.asarray(energy + weight * half_square)
