"""Files of earlier versions, as this version reads them.

Earlier versions had the bounds of levels above the first in `Scenario.velocity_bounds` and
`Scenario.state_bounds`, and recorded the levels of a run as `q`, `dq` and `higher`, their errors
and bounds likewise. Some members, fields and arguments had other names or forms.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.files.values import NONE, Words
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import VIEWS

FIELDS_OF_BOUNDS = ("velocity_bounds", "state_bounds")
LEVEL_SIGNALS = {
    signal: tuple(name for name, view in VIEWS.items() if view.signal == signal)
    for signal in ("x", "e", "level_lower", "level_upper")
}
"""Signal of the levels -> the views of its first rows, which files contain."""
LEVELS_ABOVE = {
    "x": "higher",
    "e": "e_higher",
    "level_lower": "higher_lower",
    "level_upper": "higher_upper",
}
"""Signal of the levels -> the earlier variable with the rows from the third on."""


def _of_full_state(table: dict[str, Any]) -> dict[str, Any]:
    """The table of `FullState`, the law of order 2 of earlier versions, as one of
    `BarrierBackstepping`.
    """
    integral = {"kind": "integral"}
    given = dict(table)
    found: dict[str, Any] = {
        "kind": "barrier_backstepping",
        "k": _rows(given.pop("k1", NONE), given.pop("K2", NONE)),
        "barriers": [given.pop("barrier", integral), given.pop("velocity_barrier", integral)],
        "c": _rows(0.0, given.pop("c", NONE)),
        "weights": _rows(given.pop("weight", 1.0), 1.0),
    }
    o = given.pop("o", NONE)
    if o != NONE:
        found["o"] = _rows(o, o)
    return given | found


def _rows(first: Any, second: Any) -> list[Any]:
    """The values of two levels, of as many joints each."""
    joints = max((len(x) for x in (first, second) if isinstance(x, list)), default=0)
    if joints == 0:
        return [first, second]
    return [x if isinstance(x, list) else [x] * joints for x in (first, second)]


FORMER_MEMBERS: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "full_state": _of_full_state,
}
"""Name of a member of earlier versions, which files may contain -> its table as that of a member
of today."""

FORMER_NAMES = {"reading": "variant"}
"""Name of a field or an argument in files of earlier versions -> the present one."""


def with_present_names(table: Mapping[str, Any], known: Container[str]) -> dict[str, Any]:
    """A table with the present names of fields and arguments that earlier versions named
    otherwise.
    """
    return {key if key in known else FORMER_NAMES.get(key, key): x for key, x in table.items()}


def with_bounds_of_levels(data: Mapping[str, Any]) -> dict[str, Any]:
    """The tables of a scenario with all bounds in `bounds`."""
    data = dict(data)
    velocities, above = data.pop("velocity_bounds", NONE), data.pop("state_bounds", [])
    if not isinstance(above, list):
        raise checks.fail("state_bounds", above, "a list")
    second, *others = above or [NONE]
    if velocities != NONE and second != NONE:
        expected = "either velocity_bounds or state_bounds[0]"
        remedy = "Both are the bounds of the second level."
        raise checks.fail("state_bounds", Words("bounds of the second level"), expected, remedy)
    levels = [second if velocities == NONE else velocities, *others]
    if levels == [NONE] or "bounds" not in data:
        return data
    return {**data, "bounds": [data["bounds"], *levels]}


def has_other_leaves(tables: Mapping[str, Any]) -> bool:
    """Whether a scenario with these tables had other leaves when it was stored: its law was a
    FullState, which is a BarrierBackstepping now.
    """
    law = tables.get("controller", {})
    while law.get("kind") != "full_state" and isinstance(law.get("law"), Mapping):
        law = law["law"]
    return law.get("kind") == "full_state"


def order_of_leaves(tables: Mapping[str, Any], scenario: Scenario) -> list[int]:
    """The numbers of a scenario's leaves in the order in which a file with these tables has them.

    Earlier versions had the bounds of the levels above the first behind the actuator, those of a
    robot before the regions and those of another plant after them.
    """
    places: list[Any] = [path for path, _ in jax.tree_util.tree_leaves_with_path(scenario)]
    numbers = list(range(len(places)))
    if not any(field in tables for field in FIELDS_OF_BOUNDS):
        return numbers
    fields = list(Scenario.__dataclass_fields__)
    is_of_robot = "velocity_bounds" in tables
    behind = fields.index("regions") + (-0.5 if is_of_robot else 0.5)

    def position(number: int) -> float:
        field, index = places[number][0].name, getattr(places[number][1], "idx", 0)
        is_above = field == "bounds" and index > 0
        return behind if is_above else float(fields.index(field))

    return sorted(numbers, key=position)


def levels(found: Mapping[str, Any], signal: str) -> np.ndarray:
    """A signal of the levels, (..., r, n), of those that a file contains."""
    if signal in found:
        return np.asarray(found[signal])
    given = [found.get(name, ()) for name in LEVEL_SIGNALS[signal]]
    rows = [np.asarray(x) for x in given if np.size(x)]
    stacked = np.stack(rows, axis=-2)
    above = found.get(LEVELS_ABOVE[signal], ())
    if not np.size(above):
        return stacked
    if len(rows) == 1:  # bounds of the first level and of some from the third on
        infinite = np.full_like(stacked, -np.inf if signal == "level_lower" else np.inf)
        stacked = np.concatenate([stacked, infinite], axis=-2)
    return np.concatenate([stacked, np.asarray(above)], axis=-2)


def fields_of_run(stored: dict[str, Any]) -> dict[str, Any]:
    """The fields of a stored Rollout."""
    if "x" in stored:
        return stored
    earlier = {*VIEWS, *LEVELS_ABOVE.values()}
    others = {name: x for name, x in stored.items() if name not in earlier}
    as_stored = jnp.asarray if isinstance(stored["q"], jax.Array) else np.asarray
    return {**others, **{signal: as_stored(levels(stored, signal)) for signal in LEVEL_SIGNALS}}


def fields_of_line(stored: dict[str, Any]) -> dict[str, Any]:
    """The fields of a stored line of a certificate.  Its name said what it is in earlier versions,
    which named two of its fields otherwise.
    """
    if "role" in stored:
        return stored
    # Imported here, as scenarios are read without certificates.
    from iblf_jax.certificates.lines import Role

    former = {"counts": "enters_verdict", "first": "first_broken"}
    present = {former.get(name, name): x for name, x in stored.items()}
    name = str(stored.get("name"))
    role = Role.OTHER
    if name == "inequality, own V":
        role = Role.OWN_INEQUALITY
    elif name.startswith("weighted"):
        role = Role.WEIGHTED_INEQUALITY if "inequality" in name else Role.WEIGHTED
    elif "inequality" in name:
        role = Role.INEQUALITY
    return present | {"role": role}
