"""Checkers that test whether a component satisfies the contract of its family.

The contract of a family is the base class in its `_base.py` (or at the top of its file).  A checker
takes an instance, for example of a class from a notebook cell, and raises a `ContractError` that
lists all problems with their remedies:

    @ij.component
    class MyLaw:
        ...

    ij.testing.check_law(MyLaw(gain=3.0))

Every checker tests that the methods exist; that shapes, types and state structures follow the
contract; that numbers are finite; that the component works under `jit` and `vmap`; that derivatives
in both modes agree with finite differences; and that float32 stays float32.  It then tests the
mathematical properties of the family.  The contract tests of this package call the same functions.
The checkers compute in float64 and leave the configuration of JAX unchanged.
"""

from iblf_jax.testing._contract import ContractError as ContractError
from iblf_jax.testing.barriers import check_barrier as check_barrier
from iblf_jax.testing.decays import check_decay as check_decay
from iblf_jax.testing.devices import check_actuator as check_actuator
from iblf_jax.testing.devices import check_sensor as check_sensor
from iblf_jax.testing.laws import check_law as check_law
from iblf_jax.testing.metrics import check_fold as check_fold
from iblf_jax.testing.objectives import check_objective as check_objective
from iblf_jax.testing.observers import check_observer as check_observer
from iblf_jax.testing.plants import check_plant as check_plant
from iblf_jax.testing.process_noise import check_process_noise as check_process_noise
from iblf_jax.testing.robots import check_robot as check_robot
from iblf_jax.testing.world import check_disturbance as check_disturbance
from iblf_jax.testing.world import check_reference as check_reference
from iblf_jax.testing.world import check_region as check_region
from iblf_jax.testing.world import check_side as check_side

__all__ = [
    "ContractError",
    "check_actuator",
    "check_barrier",
    "check_decay",
    "check_disturbance",
    "check_fold",
    "check_law",
    "check_objective",
    "check_observer",
    "check_plant",
    "check_process_noise",
    "check_reference",
    "check_region",
    "check_robot",
    "check_sensor",
    "check_side",
]
