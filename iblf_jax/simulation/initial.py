"""The start of a run."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.core.units import HIGHER, POSITION, VELOCITY


@component
class Initial:
    """The state of the plant at the start of a run: position and velocity, or all levels.

    A plant in strict-feedback form with more than two levels takes x.  A flexible joint given by q
    and q' alone starts at the static equilibrium of its springs, and a drive with the current that
    holds gravity.

    Args:
      q: position, () or (n,) [rad].
      dq: velocity, () or (n,) [rad/s]; 0 if not given.
      higher: the levels from the third on, (r - 2, n) [1], in the units of the plant; the steady
        state if not given.  `Initial(x=...)` takes all levels, (r, n), in the place of q, dq and
        higher.
    """

    q: Leaf = leaf(POSITION)
    dq: Leaf = leaf(VELOCITY, default=0.0)
    higher: Leaf = leaf(HIGHER, shape="level", default=None)
    stacked: ClassVar[dict[str, tuple[str, ...]]] = {"x": ("q", "dq", "higher")}

    def __init__(self, q: Any = None, dq: Any = None, higher: Any = None, *, x: Any = None) -> None:
        if x is not None:
            if any(value is not None for value in (q, dq, higher)):
                expected = "either x, or q and dq"
                raise checks.fail("Initial.x", x, expected, "x is q, dq and the other levels.")
            levels = checks.as_floats("Initial.x", x)
            if levels.ndim != 2 or len(levels) < 2:
                expected = "one row a level, shape (r, n)"
                got = f"shape {levels.shape}"
                remedy = "Such as x=[[0.3], [0.0], [0.0]] for three levels of one number."
                raise checks.fail("Initial.x", got, expected, remedy)
            q, dq = levels[0], levels[1]
            if len(levels) > 2:
                higher = levels[2:]
        for name, value in (("q", q), ("dq", 0.0 if dq is None else dq), ("higher", higher)):
            object.__setattr__(self, name, value)

    @property
    def x(self) -> jax.Array:
        """All given levels, (2, n) or (r, n)."""
        first = jnp.stack(jnp.broadcast_arrays(self.q, self.dq))
        return first if self.higher is None else jnp.concatenate([first, self.higher])
