"""Optional members that certificates read, and what they assume where one is missing.

The defaults of laws and barriers are those of their families; only what certificates alone read is
declared here.
"""

from __future__ import annotations

from iblf_jax.control.controllers._base import law_member
from iblf_jax.core.optional import OptionalMembers

optional_member = OptionalMembers(
    **law_member.defaults,
    # laws that state a claim of their own, and fields of laws, barriers and observers
    lyapunov=None,
    decay=None,
    guard=-1.0,
    K2=None,
    kf=None,
    # studies
    scenario=None,
    made=True,
    duration=None,
    dt=None,
)
"""Reads a member of a part, or its default."""
