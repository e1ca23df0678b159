"""What functions of a plant depend on, and whether they may jump, read from their programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

from iblf_jax.core import checks
from iblf_jax.kernels import interval_program

CASES = frozenset({"sign", "lt", "le", "gt", "ge", "lookup"})
"""Operations that select a case: with them, a function may jump, which its derivative does not
contain."""


def depends_on(function: Callable[[jax.Array], jax.Array], size: int, k: int) -> bool:
    """Whether a function of (size,) depends on entry k of its argument."""
    return any(node.op == "carry" and node.value == k for node in _nodes(function, size))


def check_without_cases(function: Callable[[jax.Array], jax.Array], size: int) -> None:
    """Raises ValueError if a function of (size,) selects a case by its argument.

    Args:
      function: what plant and disturbance add to f or d, of time, state and parameters.
      size: of its argument.
    """
    found = sorted({node.op for node in _nodes(function, size) if node.op in CASES})
    if not found:
        return
    raise checks.fail(
        "prove: scenario.plant and disturbance",
        f"operations that select a case ({', '.join(found)})",
        "functions without cases, such as jnp.sign or jnp.where of a comparison",
        "A derivative does not contain a jump. Take a smooth function, such as jnp.tanh.",
    )


def _nodes(function: Callable[[jax.Array], jax.Array], size: int) -> tuple[Any, ...]:
    """The operations of a function of (size,)."""
    return interval_program(lambda x, constants: function(x), size).program.nodes
