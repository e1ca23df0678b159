"""A step of a whole closed loop as a scalar program: robot, disturbance, sensor, law, observer,
actuator, as `simulate` steps them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.deployment.control_law import as_floats, of_floats, program_of
from iblf_jax.engine.step import Inputs, StepOptions, advance, start
from iblf_jax.kernels import Program
from iblf_jax.simulation import accuracy
from iblf_jax.simulation.closed_loop import initial_state
from iblf_jax.simulation.sampling import has_noise
from iblf_jax.simulation.scenario import Scenario

OUTPUTS = {
    "q": "rad",
    "dq": "rad/s",
    "tau": "N m",
    "e1": "rad",
    "q_d": "rad",
    "lower": "rad",
    "upper": "rad",
    "f": "N m",
    "f_hat": "N m",
}
"""What a step tells of its start, one number a joint: name -> unit."""
OF_SAMPLE = {"f": "disturbance", "f_hat": "disturbance_estimate"}
"""Outputs that a `Sample` calls otherwise."""
ENDLESS = 2.0**52
"""Steps of a run that does not end by itself."""


class Settings(NamedTuple):
    """What a run is given besides its scenario."""

    dt: jax.Array
    noise: Any
    """The key of a sensor's noise, (4,); empty without noise."""


class Loop(NamedTuple):
    """The programs of a closed loop; leaves of the scenario are shared, numbers of `Settings` are a
    lane's.
    """

    start: Program
    """Its samples are the memory before the first step."""
    step: Program
    """It carries the memory; its samples are OUTPUTS and the status, at the start of the step."""
    size: int
    """Numbers of the memory."""


def loop_program(scenario: Scenario, method: str) -> Loop:
    """The programs of a scenario's closed loop.

    Args:
      scenario: canonical.
      method: the integrator.

    Raises:
      UnsupportedError: it does not lower; the message says why.
    """
    dtype = scenario.initial.q.dtype
    settings = Settings(jnp.zeros((), dtype), jnp.zeros((4,), dtype) if has_noise(scenario) else ())
    like = (initial_state(scenario), jnp.int32(0))

    def first(scenario, settings, carry, index):
        return (), as_floats((initial_state(scenario), jnp.int32(0)), dtype)

    def step(scenario, settings, carry, index):
        state, status = of_floats(carry, like)
        noise = (
            settings.noise
            if has_noise(scenario)
            else ()
            if scenario.sampling is None
            else jnp.zeros((4,), dtype)
        )
        inputs = Inputs(scenario, (), settings.dt, jnp.asarray(ENDLESS, dtype), noise)
        size = accuracy.watched_indices(state).size
        blank = start(inputs, method, jnp.zeros((size, size), dtype))
        done = advance(
            inputs,
            blank._replace(state=state, status=status),
            index,
            method,
            StepOptions(scalar=True),
        )
        told = [getattr(done.sample, OF_SAMPLE.get(name, name)) for name in OUTPUTS]
        return as_floats((done.carry.state, done.carry.status), dtype), (
            *told,
            done.carry.status.astype(dtype),
        )

    shapes = as_floats(like, dtype)
    begin = program_of(first, scenario, settings, ())
    return Loop(
        begin,
        program_of(step, scenario, settings, shapes),
        sum(x.size for x in jax.tree.leaves(shapes)),
    )
