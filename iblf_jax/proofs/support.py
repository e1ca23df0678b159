"""Checks that the families of plants share: what a proof supports, its time interval and level."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators import Ideal
from iblf_jax.control.barriers import Barrier, Quadratic
from iblf_jax.control.controllers import TrackingLaw
from iblf_jax.control.controllers._base import position_barrier
from iblf_jax.control.decays import Exponential
from iblf_jax.core import checks
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.time import jump_times_of
from iblf_jax.proofs.examination import Examined, Operations, check_operations
from iblf_jax.proofs.parameters import Uncertain
from iblf_jax.proofs.periods import AperiodicError, period_of
from iblf_jax.proofs.users_barriers import check_barrier
from iblf_jax.proofs.users_parts import BARRIERS, check_constant, check_time_functions
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world import plants
from iblf_jax.world.bounds import Bounds, Tube

T = TypeVar("T")
INSTANTS = 1024
"""Times at which the tube is examined before a proof."""
REAL_NUMBERS = (
    "The equations hold in real numbers: the loop is continuous, and its parameters are the stored"
    " double-precision numbers."
)
"""The assumption of every proof of a continuous loop."""
SAMPLED_REAL_NUMBERS = (
    "The equations hold in real numbers: the robot moves in continuous time, and the parameters of"
    " the loop are the stored double-precision numbers."
)
"""The same of a sampled loop."""
CONTINUOUS = "The proof is one of the continuous loop, with an ideal sensor."


def unsupported(field: str, given: object, expected: str, reason: str) -> ValueError:
    """The error for a part of a scenario whose V_w' is not known."""
    return checks.fail(f"prove: scenario.{field}", given, expected, reason)


def check_unchanging(
    name: str, part: plants.Plant | plants.Robot, expected: str, reason: str
) -> None:
    """Raises ValueError for a plant that is replaced during the run, or depends on the time."""
    if part.nominal is not part or jnp.size(jump_times_of(name, part)):
        raise unsupported(name, type(part).__name__, expected, reason)
    check_constant(f"scenario.{name}", part)


def unit_tube() -> Tube:
    """The tube of one joint between -1 and 1, around a reference at rest."""
    zero, one = jnp.zeros(1), jnp.ones(1)
    return Tube(zero, zero, -one, one, zero, zero)


def check_same_structure(scenario: Scenario, expected: str) -> None:
    """Raises ValueError unless plant and model have the same parameters."""
    structures: list[Any] = [jax.tree.structure(part) for part in (scenario.plant, scenario.model)]
    if structures[0] == structures[1]:
        return
    reason = "The difference of their parameters is what the proof is about."
    raise unsupported("model", type(scenario.model).__name__, expected, reason)


def check_exponential(law: TrackingLaw, rate: str) -> None:
    """Raises ValueError for a law with other than exponential decays; `rate` is V_w' or V'."""
    if all(type(decay) is Exponential for decay in law.decays):
        return
    names = ", ".join(type(decay).__name__ for decay in law.decays)
    reason = f"{rate} with other decays is not known here."
    raise unsupported("controller.decays", names, "exponential decays", reason)


def check_absent(scenario: Scenario, reasons: Mapping[str, str], *, input: str, rate: str) -> None:
    """Raises ValueError for parts that a bound does not contain.

    Args:
      scenario: the loop.
      reasons: field of the scenario that must be None -> why.
      input: name of the input of the plant.
      rate: rate that is not defined at a jump.
    """
    for name, reason in reasons.items():
        part = vars(scenario)[name]
        if part is not None:
            raise unsupported(name, type(part).__name__, "None", reason)
    if type(scenario.actuator) is not Ideal:
        reason = f"The {input} of the law must be applied as it is."
        if input == "torque":
            reason += " Of a Motor, limit and lower_limit alone may be given."
        raise unsupported("actuator", type(scenario.actuator).__name__, "Ideal()", reason)
    if jnp.size(scenario.jump_times()):
        times = np.asarray(scenario.jump_times()).tolist()
        raise unsupported("jump_times()", times, "no jumps", f"{rate} is not defined at a jump.")


def claim_sentences(barriers: Sequence[Any]) -> list[str]:
    """Sentences on the claims of barriers that are not members of the package."""
    names = {type(barrier).__name__ for barrier in barriers if type(barrier) not in BARRIERS}
    return [
        f"The claims of {name} hold: its error_at, xi_bound and decay_rate; its slope is dV1/de1,"
        " and its virtual velocity has a continuous derivative at e1 = 0 (both compared at random"
        " points)."
        for name in sorted(names)
    ]


def has_delay(scenario: Scenario) -> bool:
    """Whether a delay keeps the first command from the actuator, so that V_w may grow before it."""
    return scenario.sampling is not None and float(scenario.sampling.delay) > 0.0


def step_within(scenario: Scenario, longest: float) -> float:
    """The longest time step of a run up to `longest`, both in [s]: a period of samples is a whole
    number of steps.
    """
    if scenario.sampling is None:
        return longest
    period = float(scenario.sampling.period)
    return period / math.ceil(period / longest * (1.0 - 1e-9))


def time_interval(
    varying: dict[str, Any], duration: float | None, uncertain: Uncertain
) -> tuple[float, bool]:
    """The length of the time interval [s], and whether it is a period.

    Args:
      varying: name -> part of the scenario that may depend on time.
      duration: length that the caller gives [s]; None for a period.
      uncertain: parameters.

    Raises:
      ValueError: neither a duration nor a period.
    """
    if duration is not None:
        return checks.positive_number("duration", duration, "s"), False
    try:
        return period_of(varying, uncertain.entries), True
    except AperiodicError as error:
        remedy = f"Give a duration [s]: {error}."
        raise checks.fail("duration", None, "a duration", remedy) from None


@jax.enable_x64(True)
def check_level(level: float, scenario: Scenario, duration: float, of: str) -> None:
    """Raises ValueError if a level set reaches the guard of the barrier of the positions at one of
    some instants; the bound examines all times.

    Args:
      level: c.
      scenario: the loop.
      duration: length of the time interval [s].
      of: the barrier in words.
    """
    barrier, weight = position_barrier(unwrapped(scenario.controller))
    if isinstance(barrier, Quadratic):
        return
    value = level / weight * jnp.ones(scenario.n)

    def xi_bound(t: jax.Array) -> jax.Array:
        return barrier.xi_bound(  # type: ignore[return-value]
            value, scenario.context.tube(t, acceleration=False)
        )

    xi = float(jnp.max(jax.vmap(xi_bound)(jnp.linspace(0.0, duration, INSTANTS))))
    if xi < 1.0 - barrier.guard:
        return
    expected = f"a level inside the guard of the {of}, |xi| < {1.0 - barrier.guard:g}"
    remedy = f"It reaches |xi| = {xi:.6g}, where the law has another slope. Lower the level."
    raise checks.fail("level", level, expected, remedy)


def without_guard(barrier: T) -> T:
    """A barrier without its guard: only inside the guard is it evaluated."""
    free = copy.copy(barrier)
    # The constructor refuses such a guard.
    object.__setattr__(free, "guard", -math.inf)
    return free


def bounds_of(scenario: Scenario) -> dict[str, Bounds | None]:
    """The bounds of all levels, by name."""
    return {f"bounds[{i}]": bounds for i, bounds in enumerate(scenario.bounds)}


def examined(
    scenario: Scenario,
    digests: Sequence[str],
    agreement: Callable[[Any], list[str]],
    barriers: Mapping[str, tuple[Barrier, jax.Array | None]],
    *,
    homogeneous: bool,
) -> Examined:
    """What is assumed of the parts of a scenario.

    Args:
      scenario: the loop.
      digests: of plant and disturbance.
      agreement: function that compares the methods of a user's plant.
      barriers: field of the law -> barrier without its guard, and the gain o with it.
      homogeneous: whether a barrier with a length of its own is refused.

    Raises:
      ValueError: a part that may jump, or one that contradicts its contract.
    """
    sides = {
        f"{name}.{side}": vars(bounds)[side]
        for name, bounds in bounds_of(scenario).items()
        if bounds is not None
        for side in ("lower", "upper")
    }
    n = scenario.n
    in_time = check_time_functions(scenario.reference, sides, n)
    found = [*digests]
    for field, (barrier, o) in barriers.items():
        if type(barrier) not in BARRIERS:
            name = f"scenario.controller.{field}"
            found += check_barrier(name, barrier, o, n=n, homogeneous=homogeneous)
    assumed = [*in_time.assumed, *agreement(scenario.plant)]
    return Examined(assumed, [*found, *in_time.digests])


def operations_of_plant(
    function: Callable,
    inputs: Sequence[jax.Array],
    parts: tuple[Any, ...],
    uncertain: Uncertain,
    *,
    kinks: bool = True,
) -> Operations:
    """The operations of a function of plant and disturbance, which must not jump.

    Args:
      function: of the inputs, plant, disturbance and model.
      inputs: arrays of the shapes of its first arguments, all of which vary.
      parts: plant, disturbance and model.
      uncertain: parameters.
      kinks: whether its derivative may jump.
    """
    leaves, structure = jax.tree.flatten(parts)
    count = len(inputs)

    def of_numbers(*x: jax.Array) -> Any:
        return function(*x[:count], *jax.tree.unflatten(structure, x[count:]))

    uncertain_leaves = [count + leaf for leaf in uncertain.places.varying_leaves]
    return check_operations(
        "scenario.plant and disturbance",
        of_numbers,
        [*inputs, *leaves],
        [*range(count), *uncertain_leaves],
        kinks=kinks,
        parameters=uncertain_leaves,
    )


def infinite_unless_defined(rate: jax.Array, values: jax.Array) -> jax.Array:
    """V_w' at a point, and infinity where functions of the plant have no value there.

    Their derivatives may have one: that of log(x) is 1/x, also for x < 0.  On boxes it has no bound
    where the domain ends, so that in a connected set one point with a value shows all of them.
    """
    is_defined = jnp.all(jnp.isfinite(values)) | ~jnp.isfinite(rate)
    return jnp.where(is_defined, rate, jnp.inf)
