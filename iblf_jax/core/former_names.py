"""Public names of earlier versions: an error says what to write in their place.

They are no aliases: code that uses one does not run.  Files of earlier versions are read
(`files.earlier`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

NAMES = {
    "iblf_jax": {"Attack": "WorstCase", "Front": "ParetoFront"},
    "iblf_jax.control.barriers": {"Mapping": "TransformedError", "State": "StateBarrier"},
    "iblf_jax.control.controllers": {
        "Controller": "RobotLaw, for a law of q and q', or Law, for a law of the state x",
        "FullState": "BarrierBackstepping, with k=(k1, K2), barriers=(barrier, velocity_barrier)",
        "Setting": "LawContext",
    },
    "iblf_jax.control.observers": {"Printed": "AsPublished"},
    "iblf_jax.control.sensors": {"LEVELS": "LEVEL_SENSORS", "Part": "AnySensor"},
    "iblf_jax.studies": {"ThisProcess": "LocalExecutor"},
}
"""Module -> former name -> what to write in its place."""

ARGUMENTS = {
    "reading": ("variant", "variant=..."),
    "state_bounds": ("bounds", "bounds=(level 1, level 2, ...)"),
    "velocity_bounds": ("bounds", "bounds=(positions, velocities)"),
}
"""Former name of an argument -> the present one, and how it is given."""

ATTRIBUTES_OF_LAWS = {"completed": "with_defaults", "filters": "has_slack"}
"""Former name of an optional member of a user's law -> the present one."""


def no_attribute(module: str, name: str) -> AttributeError:
    """The error of a name that a module does not have."""
    text = f"module {module!r} has no attribute {name!r}"
    present = NAMES.get(module, {}).get(name)
    return AttributeError(f"{text}. It is now named {present}." if present else text)


def explained(module: str) -> Callable[[str], Any]:
    """`__getattr__` of a module, for names that it does not have."""

    def get(name: str) -> Any:
        raise no_attribute(module, name)

    return get
