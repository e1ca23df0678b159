"""Laws by name: the systems of the paper with their barriers, and the baselines with their gains.

All barrier laws take the same k1, K2 and o, so that they are compared at equal gains.  Computed
torque, PD and the laws for other constraints (full state, governor, filter) have their own gains.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import ArrayLike

from iblf_jax.control import barriers
from iblf_jax.control.controllers._base import RobotLaw, TrackingLaw
from iblf_jax.control.controllers.adaptive_rbf import AdaptiveRBF
from iblf_jax.control.controllers.backstepping import Backstepping
from iblf_jax.control.controllers.barrier_backstepping import BarrierBackstepping
from iblf_jax.control.controllers.computed_torque import ComputedTorque
from iblf_jax.control.controllers.dynamic_surface import DynamicSurface
from iblf_jax.control.controllers.pd_gravity import PDGravity
from iblf_jax.control.controllers.reference_governor import ReferenceGovernor
from iblf_jax.control.controllers.safety_filter import SafetyFilter
from iblf_jax.control.observers import DisturbanceObserver, NoObserver
from iblf_jax.core import checks

BARRIERS: dict[str, Callable[..., barriers.Barrier]] = {
    "integral": barriers.Integral,
    "log": barriers.Log,
    "tan": barriers.Tan,
    "state": barriers.StateBarrier,
    "prescribed_performance": barriers.PrescribedPerformance,
    "mapping": barriers.TransformedError,
    "backstepping": barriers.Quadratic,
}
"""System -> barrier of the backstepping law."""

BASELINES: dict[str, Callable[[], RobotLaw]] = {
    "computed_torque": lambda: ComputedTorque(Kp=25.0, Kd=10.0),
    "pd": lambda: PDGravity(Kp=60.0, Kd=20.0),
}
"""Laws outside the family.  ASSUMPTION: their gains are this package's, chosen to settle about as
fast as the paper's law."""

FILTER = 0.01
"""s.  ASSUMPTION: time constant of the dynamic surface by name; small beside 1/k1, and no stiffer
than K2 makes the loop."""

DAMPING = 8.0
"""rad^2/s^3.  ASSUMPTION: c of the second level of the law "full_state", as in
`presets.zhang_yan_2024_full_state`."""

SPEED = 10.0
"""rad/(N m s).  ASSUMPTION: eta of the governor by name, slow enough for steps of 1 ms beside the
paper's bounds."""

LAWS = (*BARRIERS, "adaptive_rbf", "dynamic_surface", *BASELINES)
"""Every system of the paper by the name that `law_by_name`, the presets and `compare` take."""
KEEPERS = ("full_state", "reference_governor", "safety_filter")
"""Further names that `law_by_name`, the presets and `compare` take: full state (for scenarios with
`bounds[1]`; K2 in 1/s), a reference governor around "pd", and a safety filter around the
unconstrained "backstepping"."""

_WITHOUT_OBSERVER = ("adaptive_rbf", "pd", "reference_governor")


def law_by_name(
    name: str,
    *,
    k1: ArrayLike = 2.0,
    K2: ArrayLike = 20.0,
    o: Any = 0.1,
    variant: str = "printed",
    p: int = 1,
    weight: ArrayLike = 1.0,
) -> TrackingLaw:
    """The law of a system.

    Args:
      name: one of `LAWS` or `KEEPERS`; "backstepping" is the unconstrained one.
      k1: gain of the virtual velocity, () or (n,) [1/s].
      K2: gain of the velocity error, () or (n,) [N m s/rad].
      o: margin under the root of kappa (3.7), () or (n,) [1/s^2], for the barriers that use it.
      variant: "printed" or "corrected", for the backstepping laws.
      p: exponent of the logarithmic barrier.
      weight: of the barrier, () or (n,), of the laws that have one; in the unit that the law
        states.

    Raises:
      ValueError: an unknown name or variant.
    """
    checks.one_of("law", name, (*LAWS, *KEEPERS))
    if name in BASELINES:
        return BASELINES[name]()
    if name == "adaptive_rbf":
        return AdaptiveRBF(k1=k1, K2=K2, o=o, barrier=barriers.Log(p=p), weight=weight)
    if name == "dynamic_surface":
        return DynamicSurface(k1=k1, K2=K2, o=o, filter=FILTER, weight=weight)
    if name == "full_state":
        both = (barriers.Integral(), barriers.Integral())
        c, weights = (0.0, DAMPING), (weight, 1.0)
        return BarrierBackstepping(k=(k1, K2), barriers=both, c=c, weights=weights, o=(o, o))
    if name == "reference_governor":
        return ReferenceGovernor(law=BASELINES["pd"](), eta=SPEED)
    if name == "safety_filter":
        law = law_by_name("backstepping", k1=k1, K2=K2, variant=variant, weight=weight)
        return SafetyFilter(law=law, nearest="acceleration")
    barrier = barriers.Log(p=p) if name == "log" else BARRIERS[name]()
    o = o if barrier.uses_o else None
    return Backstepping(k1=k1, K2=K2, o=o, barrier=barrier, variant=variant, weight=weight)


def observer_of(name: str, usual: DisturbanceObserver) -> DisturbanceObserver:
    """The observer that belongs to a system: `usual`, or none for the laws that are classical
    without one.
    """
    if checks.string("name", name, "the name of a law") in _WITHOUT_OBSERVER:
        return NoObserver()
    return usual
