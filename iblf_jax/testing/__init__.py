"""Checkers for members of every family: does this class fit the package, and if not, what is
missing?

The contract of a family is the Protocol in its `_base.py` (or at the head of its file).  Each
checker here takes an instance, a user's own from a notebook cell too, and either returns None or
raises a `ContractError` that lists everything it found, each with the remedy:

    @ij.component
    class MyLaw:
        ...

    ij.testing.check_law(MyLaw(gain=3.0))

All look at the same things: the methods are there; shapes, types and state structures are as
  promised; numbers are finite;
the member works under `jit` and `vmap`; derivatives in both modes are those of finite differences;
float32 stays float32. Then comes what the mathematics of the family asks for.  The package's own
contract tests are these functions. They compute in float64 whatever the session's setting is, and
leave the setting as it was.
"""

from iblf_jax.testing._contract import ContractError as ContractError
from iblf_jax.testing.barriers import check_barrier as check_barrier
from iblf_jax.testing.devices import check_actuator as check_actuator
from iblf_jax.testing.devices import check_sensor as check_sensor
from iblf_jax.testing.laws import check_law as check_law
from iblf_jax.testing.metrics import check_fold as check_fold
from iblf_jax.testing.objectives import check_objective as check_objective
from iblf_jax.testing.observers import check_observer as check_observer
from iblf_jax.testing.robots import check_robot as check_robot
from iblf_jax.testing.world import check_disturbance as check_disturbance
from iblf_jax.testing.world import check_reference as check_reference
from iblf_jax.testing.world import check_region as check_region
from iblf_jax.testing.world import check_side as check_side

__all__ = [
    "ContractError",
    "check_actuator",
    "check_barrier",
    "check_disturbance",
    "check_fold",
    "check_law",
    "check_objective",
    "check_observer",
    "check_reference",
    "check_region",
    "check_robot",
    "check_sensor",
    "check_side",
]
