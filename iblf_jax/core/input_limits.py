"""The limits of an input: an upper one, and a lower one that is its opposite if not given."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks


def check_lower_limit(owner: str, lower: Any, upper: Any) -> None:
    """Raises ValueError for a lower limit without an upper one, or not below it."""
    if lower is None:
        return
    name = f"{owner}.lower_limit"
    if upper is None:
        raise checks.fail(name, lower, "a limit, too", "Such as limit=5.0, lower_limit=0.0.")
    if checks.is_concrete((lower, upper)) and not np.all(np.less(lower, upper)):
        raise checks.fail(name, lower, f"less than the limit, {np.asarray(upper)}")


def lower_or_opposite(lower: Any, upper: Any) -> Any:
    """The lower limit, or the opposite of the upper one if there is none."""
    if lower is None:
        return -upper
    return lower


def is_beyond(x: jax.Array, lower: Any, upper: Any) -> jax.Array:
    """Whether an input is outside its limits; symmetric limits need one comparison only."""
    if lower is None:
        return jnp.abs(x) > upper
    return (x < lower) | (x > upper)
