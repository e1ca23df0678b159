"""Barriers: V1, its slope and the virtual velocity of each.  The contract is the
base class `Barrier`.

A barrier or a law of your own stays finite at the bound by `guarded_error`, and says so by
`guard_is_active`.
"""

from typing import TYPE_CHECKING

from iblf_jax.control.barriers._base import Barrier as Barrier
from iblf_jax.control.barriers._base import GuardedError as GuardedError
from iblf_jax.control.barriers._base import guard_is_active as guard_is_active
from iblf_jax.control.barriers._base import guarded_error as guarded_error
from iblf_jax.control.barriers.integral import Integral as Integral
from iblf_jax.control.barriers.log import Log as Log
from iblf_jax.control.barriers.prescribed_performance import (
    PrescribedPerformance as PrescribedPerformance,
)
from iblf_jax.control.barriers.quadratic import Quadratic as Quadratic
from iblf_jax.control.barriers.state_barrier import StateBarrier as StateBarrier
from iblf_jax.control.barriers.tan import Tan as Tan
from iblf_jax.control.barriers.transformed_error import TransformedError as TransformedError
from iblf_jax.core import former_names

if not TYPE_CHECKING:  # with it, a type checker would accept every name
    __getattr__ = former_names.explained(__name__)

MEMBERS = {
    "integral": Integral,
    "log": Log,
    "tan": Tan,
    "state": StateBarrier,
    "prescribed_performance": PrescribedPerformance,
    "mapping": TransformedError,
    "quadratic": Quadratic,
}
"""Every barrier by the name that a scenario file gives it."""

__all__ = [
    "MEMBERS",
    "Barrier",
    "GuardedError",
    "Integral",
    "Log",
    "PrescribedPerformance",
    "Quadratic",
    "StateBarrier",
    "Tan",
    "TransformedError",
    "guard_is_active",
    "guarded_error",
]
