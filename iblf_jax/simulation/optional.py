"""Optional members of the parts of a scenario, and what the package assumes where one is missing.

The protocols of laws, barriers, observers, sensors, actuators and metrics list members that a class
may leave out. `simulation` and `certificates` read them through `optional_member` only, so a class
that a user wrote without such a member works with the default of this table.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

DEFAULTS: Mapping[str, Any] = MappingProxyType({
    # laws
    "includes_e2": False,
    "needs_velocity_bounds": False,
    "filters": False,
    "uses_observer": True,
    "reading": "",
    "weight": None,
    "barrier": None,
    "guard": -1.0,
    "K2": None,
    "check_start": None,
    "lyapunov": None,
    "decay": None,
    "disturbance_terms": None,
    # laws and observers: `advice()`; sensors: `advice(period)`
    "advice": None,
    # barriers
    "decay_rate": None,
    "xi_bound": None,
    # observers
    "advance": None,
    "at_period": None,
    "kf": None,
    # sensors and actuators
    "unrounded": None,
    "unlimited": None,
    # studies
    "made": True,
    "duration": None,
    "dt": None,
    # metrics
    "needs": None,
    "units": MappingProxyType({}),
    # components that wrap another one, have named rows, or units that depend on other fields
    "wraps": None,
    "rows": MappingProxyType({}),
    "leaf_units": None,
})  # fmt: skip
"""Name of an optional member -> its value for a class that does not have it."""


def optional_member(part: Any, name: str) -> Any:
    """The member `name` of a part (an instance or a class), or its default of `DEFAULTS`."""
    return getattr(part, name, DEFAULTS[name])
