"""Time-varying parts of a scenario: their values at an instant, and the times at which they jump.

A time-varying part has `at(t)`, which returns the part as it is at time t [s]. A part that is
discontinuous in time declares the instants by `jump_times()`, and steps of a run are divided there.
"""

from __future__ import annotations

from typing import Self

import jax
import jax.numpy as jnp

from iblf_jax.core import checks
from iblf_jax.core.families import Part


class Timed(Part):
    """The base of the families whose members may be discontinuous in time."""

    def jump_times(self) -> jax.Array:
        """The times at which the part or its rate jumps, (m,) [s]; steps of a run are divided
        there.
        """
        return no_times()


class TimeVarying(Timed):
    """The base of the families whose members may change during a run."""

    def at(self, t: jax.Array) -> Self:
        """The part as it is at time t [s]."""
        return self


def no_times(dtype: jax.typing.DTypeLike | None = None) -> jax.Array:
    """The jump times of a part without jumps, (0,) [s]."""
    return jnp.zeros((0,), dtype)


def jump_times_of(name: str, part: Timed, dtype: jax.typing.DTypeLike | None = None) -> jax.Array:
    """The jump times of a part, (m,) [s] in a floating-point type.

    Args:
      name: of the part, for the error message.
      part: of a scenario.
      dtype: of the times; JAX's default if not given.

    Raises:
      ValueError: `jump_times` fails, or does not return times.
    """
    expected = "times [s], one number or (m,), made of the fields by jnp"
    try:
        times = jnp.asarray(part.jump_times(), dtype)
    except Exception as error:
        got = f"{type(error).__name__}: {checks.one_line(str(error))}"
        remedy = (
            "Their number may not depend on the numbers of the fields; return jnp.zeros(0) for"
            " none."
        )
        raise checks.fail(f"{name}.jump_times()", got, expected, remedy) from error
    if times.ndim > 1 or not jnp.issubdtype(times.dtype, jnp.floating):
        raise checks.fail(f"{name}.jump_times()", times, expected)
    return times.reshape(-1)


def joined(times: list[jax.Array], dtype: jax.typing.DTypeLike | None = None) -> jax.Array:
    """Jump times of several parts together, (m,) [s]."""
    some = [x for x in times if x.size]
    if not some:
        return no_times(dtype)
    return jnp.concatenate(some)
