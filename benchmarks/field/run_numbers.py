"""Error and effort of a run on the task of an entry, and what the run does not keep, in words.

`equal_budget.py` tunes laws by these numbers.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from task_laws import Task

import iblf_jax as ij
from iblf_jax.core.units import INPUT, POSITION


class Sums(NamedTuple):
    """Integrals over the time, and maxima."""

    square: jax.Array
    """Of e1 and of the input above the steady one, in the parts of the run, (2, 3) [s]."""
    time: jax.Array
    """(3,) [s]."""
    peak: jax.Array
    violation: jax.Array


@ij.component
class Numbers(ij.metrics.Fold):
    """Error and effort, apart for the start (t < `start`), for the middle and for the second half
    (t >= `half`), the largest input, and the largest violation of the task.

    A violation is that of a constraint, in its unit, or of the bounds of a further level, in halves
    of their distance; it is not positive in a run that keeps them.
    """

    start: ij.Leaf = ij.leaf("s", shape="scalar")
    half: ij.Leaf = ij.leaf("s", shape="scalar")
    constraints: tuple = ij.static(default=())
    bounded: tuple = ij.static(default=())
    """Further levels that have bounds in the task, counted from 0."""

    units: ClassVar[dict[str, Any]] = {
        "error": POSITION,
        "late_error": POSITION,
        "effort": INPUT,
        "start_effort": INPUT,
        "rest_effort": INPUT,
        "peak_input": INPUT,
        "violation": "1",
    }

    def init(self, sample):
        """Zeros."""
        zero = jnp.zeros_like(sample.t)
        return Sums(jnp.zeros((2, 3)) + zero, jnp.zeros(3) + zero, zero, zero - jnp.inf)

    def update(self, acc, sample):
        """Adds one sample."""
        t = sample.t
        parts = jnp.stack([t < self.start, (t >= self.start) & (t < self.half), t >= self.half])
        weight = sample.dt * parts
        values = jnp.stack([jnp.mean(sample.e1**2), jnp.sum((sample.tau - sample.gravity) ** 2)])
        found = [acc.violation, *(-jnp.min(one(t, sample.x)) for one in self.constraints)]
        for i in self.bounded:
            lower, upper, x = sample.level_lower[i], sample.level_upper[i], sample.x[i]
            beyond = jnp.maximum(lower - x, x - upper) / (0.5 * (upper - lower))
            found.append(jnp.max(beyond))
        peak = jnp.maximum(acc.peak, jnp.max(jnp.abs(sample.tau)))
        square = acc.square + values[:, None] * weight
        return Sums(square, acc.time + weight, peak, jnp.max(jnp.stack(found)))

    def finish(self, acc):
        """The numbers, each ()."""
        total, time = jnp.sum(acc.square, axis=1), jnp.sum(acc.time)
        rest = jnp.sum(acc.square[1, 1:]) / jnp.sum(acc.time[1:])
        return {
            "error": jnp.sqrt(total[0] / time),
            "late_error": jnp.sqrt(acc.square[0, 2] / acc.time[2]),
            "effort": jnp.sqrt(total[1] / time),
            "start_effort": jnp.sqrt(acc.square[1, 0] / acc.time[0]),
            "rest_effort": jnp.sqrt(rest),
            "peak_input": acc.peak,
            "violation": acc.violation,
        }


def measured(scenario: ij.Scenario, task: Task, fold: Numbers, seed: int = 0) -> dict[str, Any]:
    """The numbers of a run, and what it does not keep in words; "" if it keeps all."""
    run = ij.simulate(scenario, metrics=(fold,), seed=seed, **task.options)
    found = {name: float(getattr(run.metrics, name)) for name in Numbers.units}
    violation = found.pop("violation")  # -inf in a task without constraints
    return {**found, "left": failure_of(run, violation, bool(task.scenario.regions))}


def failure_of(run: ij.Rollout, violation: float, has_regions: bool) -> str:
    """What a run does not keep, in words; "" if it keeps all."""
    status = int(run.status)
    flags = ij.Status
    if status & int(flags.NOT_FINITE | flags.SINGULAR_GAIN):
        return "diverges"
    if status & int(flags.BOUND_VIOLATED):
        return "leaves the bounds"
    if has_regions and status & int(flags.REGION_VIOLATED):
        return "enters a region"
    if violation > 0.0:
        return "violates a constraint or the bounds of a further level"
    return "the time step is too large" if status & int(flags.STEP_TOO_LARGE) else ""
