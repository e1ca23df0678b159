"""What functions of a plant depend on, and whether they may jump, read from their programs."""

from __future__ import annotations

from collections.abc import Callable

import jax

from iblf_jax.kernels.enclosure import compiled

CASES = frozenset({"sign", "lt", "le", "gt", "ge", "lookup"})
"""Operations that select a case: with them, a function may jump, which its derivative does not
contain."""


def depends_on(function: Callable[[jax.Array], jax.Array], size: int, k: int) -> bool:
    """Whether a function of (size,) depends on entry k of its argument."""
    nodes = compiled(lambda x, constants: function(x), size, ()).program.nodes
    return any(node.op == "carry" and node.value == k for node in nodes)


def cases_of(function: Callable[[jax.Array], jax.Array], size: int) -> list[str]:
    """The operations of a function of (size,) that select a case by its argument."""
    program = compiled(lambda x, constants: function(x), size, ()).program
    return sorted({node.op for node in program.nodes if node.op in CASES})
