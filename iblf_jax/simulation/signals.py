"""The signals of a closed loop, with the only list of their names, units and meanings.

To add a signal: a field here and its value in `closed_loop.sample_at`; a law's signal also in
`Command` and `LawSignals`; figures show it by `LEVEL_PARTS`.
"""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any, NamedTuple, get_type_hints

import jax
import jax.numpy as jnp
from jax import Array

from iblf_jax.core.pytree import is_absent
from iblf_jax.core.units import (
    INPUT,
    LAST_LEVEL,
    LEVELS,
    POSITION,
    UNCERTAIN,
    VELOCITY,
    PlantUnit,
)

PER_LEVEL = ("level", "joint")
"""Dimensions of a signal or metric with one row per level of the plant, up to the last level that
has a value."""
PER_MODEL_LEVEL = ("model_level", "joint")
"""With one row per level of the model, which has fewer where a robot is the model of a plant of
higher order."""
PER_HIGHER_LEVEL = ("higher_level", "joint")
"""With one row per level from the third on."""
PER_REGION = ("region",)


class Recorded(NamedTuple):
    """SI unit, meaning and dimensions of a recorded signal."""

    unit: str
    """A `PlantUnit` where it depends on the plant."""
    meaning: str
    dimensions: tuple[str, ...] = ()
    """At an instant, where they are others than one number a joint."""
    missing: float | None = None
    """Value of the rows that a run lacks, for a signal of the levels that may have fewer rows."""


@dataclasses.dataclass(frozen=True, eq=False)
class Signals:
    """The recorded signals.  At an instant vectors are (n,), and signals of the levels have one row
    a level; the time axis of a run comes first.
    """

    t: Annotated[Array, Recorded("s", "time")]
    x: Annotated[Array, Recorded(LEVELS, "levels of the state", PER_LEVEL)]
    """(r, n); of a robot q and q'."""
    tau: Annotated[Array, Recorded(INPUT, "applied torque")]
    e: Annotated[Array, Recorded(LEVELS, "errors of the levels", PER_LEVEL)]
    """e_1 = x_1 - q_d and e_i = x_i - alpha_{i-1}, (r, n); (2, n) under a law of robots."""
    xi: Annotated[Array, Recorded("1", "position error relative to its bound")]
    """Inside the bounds if |xi| < 1."""
    q_d: Annotated[Array, Recorded(POSITION, "reference position")]
    dq_d: Annotated[Array, Recorded(VELOCITY, "reference velocity")]
    level_lower: Annotated[
        Array, Recorded(LEVELS, "lower bounds of the levels", PER_LEVEL, missing=-float("inf"))
    ]
    """Of the levels from the first to the last one with bounds, (m, n); -infinity for one
    without."""
    level_upper: Annotated[
        Array, Recorded(LEVELS, "upper bounds of the levels", PER_LEVEL, missing=float("inf"))
    ]
    alpha: Annotated[Array, Recorded(VELOCITY, "virtual velocity")]
    """alpha_1, the virtual control of level 2; alpha_{i-1} = x_i - e_i for rows that `e` has."""
    disturbance: Annotated[
        Array,
        Recorded(
            UNCERTAIN, "lumped disturbance f: disturbance, friction and model error", PER_LEVEL
        ),
    ]
    """Of (2.1), (n,); of a model in strict-feedback form d of (S.1), (r, n)."""
    disturbance_estimate: Annotated[
        Array, Recorded(UNCERTAIN, "estimate of the uncertain term", PER_LEVEL)
    ]
    V: Annotated[Array, Recorded("1", "Lyapunov function V2")]
    """Of (3.12), ()."""
    _: dataclasses.KW_ONLY
    slack: Annotated[
        Any, Recorded(PlantUnit("rad/s^2", "x2/s"), "violation of the safety filter's conditions")
    ] = ()
    """`()` under laws without a filter."""
    region_margin: Annotated[
        Any, Recorded("m", "distance of the regions' points to their boundaries", PER_REGION)
    ] = ()
    """One number a region; `()` where there are none."""
    region_slack: Annotated[
        Any,
        Recorded("m/s^2", "violation of the safety filter's conditions on the regions", PER_REGION),
    ] = ()
    """`()` without regions or without a filter."""
    auxiliary: Annotated[
        Any, Recorded(LAST_LEVEL, "auxiliary state lambda of the limited torque")
    ] = ()
    """`()` under laws without one."""
    events: Annotated[Any, Recorded("1", "number of commands that the event trigger has sent")] = ()
    """(); `()` without an event trigger."""
    x_hat: Annotated[Any, Recorded(LEVELS, "levels that the law received", PER_MODEL_LEVEL)] = ()
    """One row a level of the model; `()` without an observer that estimates levels."""

    @property
    def q(self) -> Array:
        """The first level, (n,)."""
        return self.x[..., 0, :]

    @property
    def dq(self) -> Array:
        """The second level, (n,)."""
        return self.x[..., 1, :]

    @property
    def e1(self) -> Array:
        """The error of the first level, (n,)."""
        return self.e[..., 0, :]

    @property
    def e2(self) -> Array:
        """The error of the second level, (n,)."""
        return self.e[..., 1, :]

    @property
    def lower(self) -> Array:
        """The lower bound of the first level, (n,)."""
        return self.level_lower[..., 0, :]

    @property
    def upper(self) -> Array:
        """The upper bound of the first level, (n,)."""
        return self.level_upper[..., 0, :]

    @property
    def dq_lower(self) -> Any:
        """The lower bound of the second level, (n,); `()` where only the first level has bounds."""
        return self.level_lower[..., 1, :] if has_velocity_level_bounds(self) else ()

    @property
    def dq_upper(self) -> Any:
        """As `dq_lower`."""
        return self.level_upper[..., 1, :] if has_velocity_level_bounds(self) else ()

    @property
    def higher_lower(self) -> Any:
        """The lower bounds of the levels from the third on, (m - 2, n); `()` where none of them has
        bounds.
        """
        return self.level_lower[..., 2:, :] if self.level_lower.shape[-2] > 2 else ()


def has_velocity_level_bounds(sample: Signals) -> bool:
    """Whether the second level, or one above it, has bounds."""
    return sample.level_lower.shape[-2] > 1


FIELDS = tuple(field.name for field in dataclasses.fields(Signals))
"""What a run records."""


class View(NamedTuple):
    """A row of a signal of the levels that has a name of its own."""

    signal: str
    row: int
    recorded: Recorded


VIEWS = {
    "q": View("x", 0, Recorded(POSITION, "joint position")),
    "dq": View("x", 1, Recorded(VELOCITY, "joint velocity")),
    "e1": View("e", 0, Recorded(POSITION, "position error q - q_d")),
    "e2": View("e", 1, Recorded(VELOCITY, "velocity error dq - alpha")),
    "lower": View("level_lower", 0, Recorded(POSITION, "lower bound of q")),
    "upper": View("level_upper", 0, Recorded(POSITION, "upper bound of q")),
    "dq_lower": View("level_lower", 1, Recorded(VELOCITY, "lower bound of dq")),
    "dq_upper": View("level_upper", 1, Recorded(VELOCITY, "upper bound of dq")),
}
"""Properties of `Signals` -> what they show."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Sample(Signals):
    """The loop at one instant: the recorded signals, and further ones that metrics use."""

    dt: Array
    """Weight of the sample in an integral over time, sum dt g, () [s]; `step` is the time since the
    instant before.

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
    least_distances: Any = dataclasses.field(default=(), kw_only=True)
    """Smallest distances of the levels to their lower and their upper bounds since the instant
    before, (2, m, n), under process noise (`noise.least_distances`); `()` without."""


def has(sample: Signals, signal: str) -> bool:
    """Whether a sample or a run has an optional signal: bounds of the velocities, a slack, margins
    of regions.
    """
    return not is_absent(getattr(sample, signal))


def least_margin(sample: Sample, level: int) -> Array:
    """Smallest distance of a level, counted from 1, to the nearer of its bounds since the instant
    before, (n,): that at the instant where no noise acts.
    """
    i = level - 1
    if has(sample, "least_distances"):
        return jnp.minimum(sample.least_distances[0, i], sample.least_distances[1, i])
    return margin_of(sample, level, sample.x[i])


def least_xi_margin(sample: Sample) -> Array:
    """The same distance of the first level, relative to that of the reference to the bound,
    1 - |xi|, (n,) [1].
    """
    if has(sample, "least_distances"):
        below, above = sample.q_d - sample.lower, sample.upper - sample.q_d
        distances = sample.least_distances
        return jnp.minimum(distances[0, 0] / below, distances[1, 0] / above)
    return 1.0 - jnp.abs(sample.xi)


def margin_of(sample: Sample, level: int, value: Array) -> Array:
    """Distance of a value to the nearer of the bounds of a level, counted from 1, (n,)."""
    i = level - 1
    return jnp.minimum(value - sample.level_lower[i], sample.level_upper[i] - value)


def least_higher_margins(sample: Sample) -> Array:
    """`least_margin` of the levels from the third to the last one with bounds, (m - 2, n)."""
    levels = range(3, len(sample.level_lower) + 1)
    return jnp.stack([least_margin(sample, level) for level in levels])


def higher_alpha_margins(sample: Sample) -> Array | None:
    """`margin_of` the virtual controls for these levels, (m - 2, n); None under a law without."""
    levels = range(3, len(sample.level_lower) + 1)
    _, *alphas = virtual_controls(sample)
    if not alphas:
        return None
    return jnp.stack([margin_of(sample, *pair) for pair in zip(levels, alphas, strict=False)])


def virtual_controls(sample: Sample) -> list[Array]:
    """alpha_1, alpha_2, ..., (n,) each, as many as the law has."""
    others = sample.x[2 : len(sample.e)] - sample.e[2:]
    return [sample.alpha, *others]


SIGNALS: dict[str, Recorded] = {
    **{
        name: hint.__metadata__[0]
        for name, hint in get_type_hints(Signals, include_extras=True).items()
        if name in FIELDS
    },
    **{name: view.recorded for name, view in VIEWS.items()},
}
"""Name of a signal -> what is known of it, time first."""

METRIC_DIMENSIONS = {
    "estimate_rmse": PER_LEVEL,
    "peak_level_error": PER_MODEL_LEVEL,
    "level_margin": PER_HIGHER_LEVEL,
    "level_alpha_margin": PER_HIGHER_LEVEL,
    "largest_region_slack": PER_REGION,
}
"""Dimensions of the metrics that have others than one number a joint."""


def dimension_names(name: str, shape: tuple[int, ...], joints: int) -> tuple[str, ...]:
    """Names of the dimensions of a signal at one instant, or of a metric of one run: those that it
    declares where it has as many, else "joint" for (n,), and else names of its own.
    """
    declared = METRIC_DIMENSIONS.get(name, ())
    if name in SIGNALS:
        declared = SIGNALS[name].dimensions
    if declared and len(shape) == len(declared):
        return declared
    if shape == (joints,):
        return ("joint",)
    return tuple(f"{name}_axis_{i}" for i in range(len(shape)))
