"""The signals of a closed loop, with the only list of their names, units and meanings."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any, NamedTuple, get_type_hints

import jax
import jax.numpy as jnp
from jax import Array

from iblf_jax.core.units import (
    HIGHER,
    INPUT,
    LAST_LEVEL,
    LEVELS,
    POSITION,
    UNCERTAIN,
    VELOCITY,
    PlantUnit,
)


class Recorded(NamedTuple):
    """SI unit and meaning of a recorded signal."""

    unit: str
    """A `PlantUnit` where it depends on the plant."""
    meaning: str


@dataclasses.dataclass(frozen=True, eq=False)
class Signals:
    """The recorded signals.  At an instant vectors are (n,); the time axis of a run comes first."""

    t: Annotated[Array, Recorded("s", "time")]
    q: Annotated[Array, Recorded(POSITION, "joint position")]
    dq: Annotated[Array, Recorded(VELOCITY, "joint velocity")]
    tau: Annotated[Array, Recorded(INPUT, "applied torque")]
    e1: Annotated[Array, Recorded(POSITION, "position error q - q_d")]
    e2: Annotated[Array, Recorded(VELOCITY, "velocity error dq - alpha")]
    xi: Annotated[Array, Recorded("1", "position error relative to its bound")]
    """Inside the bounds if |xi| < 1."""
    q_d: Annotated[Array, Recorded(POSITION, "reference position")]
    dq_d: Annotated[Array, Recorded(VELOCITY, "reference velocity")]
    lower: Annotated[Array, Recorded(POSITION, "lower bound of q")]
    upper: Annotated[Array, Recorded(POSITION, "upper bound of q")]
    alpha: Annotated[Array, Recorded(VELOCITY, "virtual velocity")]
    disturbance: Annotated[Array, Recorded(UNCERTAIN, "lumped uncertain term f")]
    """Of (2.1)."""
    disturbance_estimate: Annotated[Array, Recorded(UNCERTAIN, "estimate of the uncertain term")]
    V: Annotated[Array, Recorded("1", "Lyapunov function V2")]
    """Of (3.12), ()."""
    _: dataclasses.KW_ONLY
    dq_lower: Annotated[Any, Recorded(VELOCITY, "lower bound of dq")] = ()
    """`()` where velocities have no bounds."""
    dq_upper: Annotated[Any, Recorded(VELOCITY, "upper bound of dq")] = ()
    slack: Annotated[
        Any, Recorded(PlantUnit("rad/s^2", "x2/s"), "violation of the safety filter's conditions")
    ] = ()
    """`()` under laws without a filter."""
    region_margin: Annotated[
        Any, Recorded("m", "distance of the regions' points to their boundaries")
    ] = ()
    """One number a region; `()` where there are none."""
    region_slack: Annotated[
        Any, Recorded("m/s^2", "violation of the safety filter's conditions on the regions")
    ] = ()
    """`()` without regions or without a filter."""
    auxiliary: Annotated[
        Any, Recorded(LAST_LEVEL, "auxiliary state lambda of the limited torque")
    ] = ()
    """`()` under laws without one."""
    events: Annotated[Any, Recorded("1", "number of commands that the event trigger has sent")] = ()
    """(); `()` without an event trigger."""
    higher: Annotated[Any, Recorded(HIGHER, "levels of the state from the third on")] = ()
    """One row a level; `()` for robots."""
    e_higher: Annotated[Any, Recorded(HIGHER, "errors x_i - alpha_{i-1} of these levels")] = ()
    """`()` for robots, and under laws without virtual controls for these levels."""
    higher_lower: Annotated[Any, Recorded(HIGHER, "lower bounds of these levels")] = ()
    """-infinity for a level without bounds; `()` where none has bounds."""
    higher_upper: Annotated[Any, Recorded(HIGHER, "upper bounds of these levels")] = ()
    x_hat: Annotated[Any, Recorded(LEVELS, "levels that the law received")] = ()
    """One row a level; `()` without an observer that estimates levels."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Sample(Signals):
    """The loop at one instant: the recorded signals, and further ones that metrics use."""

    dt: Array
    """Weight of this sample in an integral over time, sum dt g, () [s].

    The weights are those of the trapezoidal rule: the step, and half of it for the first and the
    last sample.  Where signals jump there are two samples of one time, the limits from either side,
    each with half of the time to its neighbour.
    """
    gravity: Array
    """The input that balances the gravity of the model: the torque G0(q) [N m] of a robot, of
    another plant its own `steady_input`, 0 if it states none."""
    guard_active: Array
    saturated: Array
    step: Any = dataclasses.field(default=0.0, kw_only=True)
    """Time since the previous instant, () [s]; 0 for the first instant and the two samples at a
    jump."""
    level_error: Any = dataclasses.field(default=(), kw_only=True)
    """`x_hat` less the levels at the instant at which the law ran, (r, n); `()` without it."""
    limit_excess: Any = dataclasses.field(default=(), kw_only=True)
    """Positive where a limit of an observer's estimates is active, () [1]; `()` without limits."""
    q_sides: Any = dataclasses.field(default=(), kw_only=True)
    """Smallest distances of q to its lower and its upper bound since the instant before, (2, n),
    where process noise acts on the first level (`noise.least_distances`); `()` elsewhere, as in the
    two fields below."""
    dq_sides: Any = dataclasses.field(default=(), kw_only=True)
    """The same of dq, (2, n)."""
    higher_sides: Any = dataclasses.field(default=(), kw_only=True)
    """The same of the levels from the third on, (2, r - 2, n)."""


def has(sample: Signals, signal: str) -> bool:
    """Whether a sample or a run has an optional signal: bounds of the velocities, a slack, margins
    of regions.
    """
    return not isinstance(getattr(sample, signal), tuple)


def least_position_margin(sample: Sample) -> Array:
    """Smallest distance of the positions to the nearer of their bounds since the instant before,
    (n,): that at the instant where no noise acts on them.
    """
    if has(sample, "q_sides"):
        return jnp.minimum(sample.q_sides[0], sample.q_sides[1])
    return jnp.minimum(sample.q - sample.lower, sample.upper - sample.q)


def least_xi_margin(sample: Sample) -> Array:
    """The same distance relative to that of the reference to the bound, 1 - |xi|, (n,) [1]."""
    if has(sample, "q_sides"):
        below, above = sample.q_d - sample.lower, sample.upper - sample.q_d
        return jnp.minimum(sample.q_sides[0] / below, sample.q_sides[1] / above)
    return 1.0 - jnp.abs(sample.xi)


def least_speed_margin(sample: Sample) -> Array:
    """As `least_position_margin`, of the velocities."""
    if has(sample, "dq_sides"):
        return jnp.minimum(sample.dq_sides[0], sample.dq_sides[1])
    return speed_margin(sample, sample.dq)


def least_level_margin(sample: Sample) -> Array:
    """As `least_position_margin`, of the levels from the third on, (r - 2, n)."""
    if has(sample, "higher_sides"):
        return jnp.minimum(sample.higher_sides[0], sample.higher_sides[1])
    return level_margin(sample, sample.higher)


def level_margin(sample: Sample, levels: Array) -> Array:
    """Distances of levels from the third on to the nearer of their bounds, (r - 2, n)."""
    return jnp.minimum(levels - sample.higher_lower, sample.higher_upper - levels)


def speed_margin(sample: Sample, velocity: Array) -> Array:
    """Distance of a velocity to the nearer of its bounds, (n,) [rad/s]."""
    return jnp.minimum(velocity - sample.dq_lower, sample.dq_upper - velocity)


PER_REGION = ("region_margin", "region_slack", "largest_region_slack")
"""Signals and metrics with one number per region."""
PER_LEVEL = (
    "disturbance",
    "disturbance_estimate",
    "estimate_rmse",
    "x_hat",
    "peak_level_error",
)
"""Signals and metrics with one row per level: the estimates of levels of every model, and the
others of a model in strict-feedback form."""
PER_HIGHER_LEVEL = (
    "higher",
    "e_higher",
    "higher_lower",
    "higher_upper",
    "level_margin",
    "level_alpha_margin",
)
"""Signals and metrics with one row per level from the third on."""


def dimension_names(name: str, shape: tuple[int, ...], joints: int) -> tuple[str, ...]:
    """Names of the dimensions of a signal at one instant, or of a metric of one run: "joint" for
    (n,), "level" or "higher_level" and "joint" for one row per level, "region" for one number per
    region, else names of its own.
    """
    if name in PER_REGION:
        return ("region",)
    if shape == (joints,):
        return ("joint",)
    if len(shape) == 2 and name in PER_LEVEL:
        return ("level", "joint")
    if name in PER_HIGHER_LEVEL:
        return ("higher_level", "joint")
    return tuple(f"{name}_axis_{i}" for i in range(len(shape)))


SIGNALS: dict[str, Recorded] = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(Signals, include_extras=True).items()
    if name != "_"
}
"""Name of a recorded signal -> its unit and meaning, time first."""
