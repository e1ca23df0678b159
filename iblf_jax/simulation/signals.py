"""What can be seen of a loop: every signal with its unit and its meaning, listed here and nowhere else."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple, get_type_hints

import jax.numpy as jnp
from jax import Array


class Recorded(NamedTuple):
    """Marks a signal that runs record: its SI unit, and what it is in words."""

    unit: str
    meaning: str


class Sample(NamedTuple):
    """The loop at one instant: what is recorded, and what else metrics fold over.  Vectors are (n,)."""

    t: Annotated[Array, Recorded("s", "time")]
    dt: Array
    """The time that this sample stands for in a sum over time, () [s]: the step, and 0 for the last sample."""
    q: Annotated[Array, Recorded("rad", "joint position")]
    dq: Annotated[Array, Recorded("rad/s", "joint velocity")]
    tau: Annotated[Array, Recorded("N m", "applied torque")]
    e1: Annotated[Array, Recorded("rad", "position error q - q_d")]
    e2: Annotated[Array, Recorded("rad/s", "velocity error dq - alpha")]
    xi: Annotated[Array, Recorded("1", "position error relative to its bound")]
    """Inside the bounds if |xi| < 1."""
    q_d: Annotated[Array, Recorded("rad", "reference position")]
    dq_d: Annotated[Array, Recorded("rad/s", "reference velocity")]
    lower: Annotated[Array, Recorded("rad", "lower bound of q")]
    upper: Annotated[Array, Recorded("rad", "upper bound of q")]
    alpha: Annotated[Array, Recorded("rad/s", "virtual velocity")]
    gravity: Array
    """G0(q), what holding the model still takes [N m]."""
    disturbance: Annotated[Array, Recorded("N m", "lumped uncertain term f")]
    """Of (2.1)."""
    disturbance_estimate: Annotated[Array, Recorded("N m", "estimate of the uncertain term")]
    V: Annotated[Array, Recorded("1", "Lyapunov function V2")]
    """Of (3.12), ()."""
    guard_active: Array
    saturated: Array
    dq_lower: Annotated[Any, Recorded("rad/s", "lower bound of dq")] = ()
    """`()` where velocities have no bounds."""
    dq_upper: Annotated[Any, Recorded("rad/s", "upper bound of dq")] = ()
    slack: Annotated[Any, Recorded("rad/s^2", "how far the law's filter broke its own conditions")] = ()
    """`()` under laws without a filter."""


def has_speed_limits(sample: Sample) -> bool:
    """Whether velocities have bounds."""
    return not isinstance(sample.dq_lower, tuple)


def speed_margin(sample: Sample, velocity: Array) -> Array:
    """Distance of a velocity to the nearer of its bounds, (n,) [rad/s]."""
    return jnp.minimum(velocity - sample.dq_lower, sample.dq_upper - velocity)


SIGNALS: dict[str, Recorded] = {
    name: hint.__metadata__[0] for name, hint in get_type_hints(Sample, include_extras=True).items() if hasattr(hint, "__metadata__")
}
"""Name of a recorded signal -> its unit and meaning, time first."""

OPTIONAL = tuple(name for name in SIGNALS if name in Sample._field_defaults)
"""Signals that some scenarios have: `()` in others."""
