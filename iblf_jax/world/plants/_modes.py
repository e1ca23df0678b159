"""Modes of a plant: the values of its parameters in each mode, and the times between switches."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.component_paths import replaced, resolve
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.world.plants._base import Plant, is_chain
from iblf_jax.world.robots import Robot

NEVER = 1e30
"""Time of a switch that does not happen [s]; an infinite one has no rounding error."""

P = TypeVar("P")
RobotOrPlant = Annotated[Robot, Plant]


@component
class ModeValues:
    """The values of one parameter of a plant, one for each mode.

    Args:
      path: of the parameter in the plant, such as "mass[1]" or "robot.payload".
      values: in the unit of the parameter, (modes,), or (modes, ...) with the shape of the
        parameter [unit of the parameter].
    """

    path: str = static()
    values: Leaf = leaf("unit of the parameter", shape="any")


def member_of_inner(part: Any, name: str) -> Any:
    """`__getattr__` of a plant with modes: a member that it does not define is that of the inner
    plant, such as names, units, limits and methods.
    """
    if name.startswith("__") or name == "plant":
        raise AttributeError(name)
    return getattr(part.plant, name)


def fit_modes(part: Any) -> int:
    """Checks `plant` and `parameters` of a plant with modes, and stores the parameters as a tuple.

    Args:
      part: a `Switched` or `MarkovSwitched` under construction.

    Returns:
      The number of modes.

    Raises:
      ValueError: an inner plant that is neither a robot nor a plant, or parameters that do not fit
        it.
    """
    owner = type(part).__name__
    if is_chain(part.plant):
        checks.conforms(f"{owner}.plant", part.plant, Plant, "iblf_jax.plants has them.")
    else:
        checks.conforms(f"{owner}.plant", part.plant, Robot, "iblf_jax.robots has them.")
    name, parameters = f"{owner}.parameters", part.parameters
    if isinstance(parameters, dict):
        parameters = [ModeValues(path, values) for path, values in parameters.items()]
    is_tuple = isinstance(parameters, tuple | list) and len(parameters) > 0
    if not is_tuple or not all(isinstance(one, ModeValues) for one in parameters):
        expected = 'path -> one value a mode, such as {"mass[1]": (0.85, 1.5)}'
        raise checks.fail(name, parameters, expected)
    for one in parameters:
        try:
            old = resolve(part.plant, one.path)[1]
        except LookupError:
            expected = f"the path of a parameter of {type(part.plant).__name__}, such as mass[1]"
            raise checks.fail(name, one.path, expected) from None
        shape = jnp.shape(one.values)
        if not shape or shape[1:] not in ((), jnp.shape(old)):
            expected = f"one value of shape {jnp.shape(old)} for each mode"
            got = f"shape {shape}"
            raise checks.fail(f"{name}[{one.path!r}]", got, expected)
        for value in one.values:
            # Raises for a value that the parameter may not have.
            changed(part.plant, one.path, value)
    counts = {len(one.values) for one in parameters}
    if len(counts) > 1:
        expected = "the same number of modes for every parameter"
        raise checks.fail(name, f"{sorted(counts)} values", expected)
    object.__setattr__(part, "parameters", tuple(parameters))
    return counts.pop()


def changed(plant: P, path: str, value: jax.Array) -> P:
    """A copy of a plant with one parameter replaced."""
    return replaced(plant, resolve(plant, path)[0], value, path, None)


def piecewise_constant(values: jax.Array, times: jax.Array, t: jax.Array) -> jax.Array:
    """A function of time that is constant between switches: values[k] for t_k <= t < t_{k+1}, with
    t_0 = -inf.

    Args:
      values: (k + 1, ...).
      times: of the switches, t_1 ... t_k, increasing, (k,) [s].
      t: () [s].
    """
    found = values[0]
    for k in range(len(times)):
        found = jnp.where(t >= times[k], values[k + 1], found)
    return found


def value_of_mode(values: jax.Array, mode: jax.Array) -> jax.Array:
    """The value of a mode, values[mode].

    Args:
      values: (modes, ...).
      mode: from 0, a whole number of floating-point type, () [1].
    """
    found = values[0]
    for k in range(1, len(values)):
        found = jnp.where(mode >= k - 0.5, values[k], found)
    return found


SWITCHING_UNITS = {"switches": "1", "shortest_dwell_time": "s", "mean_dwell_time": "s"}
"""Name and unit of the results about the modes of a run."""


def switching_results(times: jax.Array, end: jax.Array) -> dict[str, jax.Array]:
    """The number of switches of a run, and its shortest and its mean dwell time.

    A dwell time is the time between two switches, or from the start to the first switch.  The time
    from the last switch to the end does not count, as the end of the run cuts it off.  Both dwell
    times are infinite for a run without switches.

    Args:
      times: increasing, (k,) [s].
      end: of the run, () [s].
    """
    starts = jnp.concatenate([jnp.zeros_like(times[:1]), times[:-1]])
    happens = times < end
    count = jnp.sum(happens.astype(times.dtype))
    dwell = jnp.where(happens, times - starts, jnp.inf)
    total = jnp.max(jnp.where(happens, times, 0.0))
    mean = jnp.where(count > 0, total / jnp.maximum(count, 1.0), jnp.inf)
    return {
        "switches": count,
        "shortest_dwell_time": jnp.min(dwell),
        "mean_dwell_time": mean,
    }


def check_times(name: str, times: Any) -> None:
    """Raises ValueError for times that are not one row of increasing positive numbers."""
    if jnp.ndim(times) != 1:
        raise checks.fail(name, times, "one row of times [s], such as (2.0, 5.0)")
    if not checks.is_concrete(times):
        return
    values = np.asarray(times)
    if not np.all(np.diff(np.concatenate([[0.0], values])) > 0):
        raise checks.fail(name, values, "positive increasing times [s]")
