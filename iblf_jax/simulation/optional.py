"""Optional members of the parts of a scenario, and what the package assumes where one is missing.

The protocols of laws, barriers, observers, sensors and metrics list members that a class may leave
out. `simulation` and `certificates` read them through `optional_member` only, so a class that a
user wrote without such a member works with the default of this table.
"""

from __future__ import annotations

from types import MappingProxyType

from iblf_jax.core.optional import OptionalMembers

optional_member = OptionalMembers(
    # laws
    includes_e2=False,
    needs_velocity_bounds=False,
    filters=False,
    uses_observer=True,
    reading="",
    weight=None,
    barrier=None,
    guard=-1.0,
    K2=None,
    check_start=None,
    lyapunov=None,
    decay=None,
    disturbance_terms=None,
    # laws and observers: `advice()`; sensors: `advice(period)`
    advice=None,
    # barriers
    decay_rate=None,
    xi_bound=None,
    # observers
    advance=None,
    at_period=None,
    kf=None,
    # studies
    scenario=None,
    made=True,
    duration=None,
    dt=None,
    # metrics
    needs=None,
    units=MappingProxyType({}),
    # components that wrap another one, have named rows, or units that depend on other fields
    wraps=None,
    rows=MappingProxyType({}),
    leaf_units=None,
)
"""Reads a member of a part (an instance or a class), or its default."""
