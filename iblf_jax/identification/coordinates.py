"""What is looked for: the numbers x of the leaves, and coordinates z in which whatever is tried is
a body.

A link's pseudo-inertia P = [[S + m c c^T, m c], [m c^T, m]] is positive definite where m > 0 and

    S = 1/2 tr(J) 1 - J = L L^T,    L lower triangular with exp(z_1), exp(z_2), exp(z_3) on its
    diagonal,

its second moments about the centre: the log-Cholesky form, block by block.  So the six numbers of
  an inertia have z_1 ... z_6, and masses
and all other leaves are their own coordinates, within limits.

Each number has a scale, that in which "well known" is measured: what it was for masses and moments
of inertia, the arm's mean length for lengths, else what would by itself need a torque as large as
the log's.

Source: C. Rucker, P. M. Wensing, IEEE Robotics and Automation Letters 7 (2022) 2645-2652.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.core import checks
from iblf_jax.identification.replay import Place
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario, with_parts
from iblf_jax.studies.draws import check_paths, same_place

SMALLEST = 1e-3
"""Default lower limit of a number that must be positive, by its start."""
SHARPEST = 1e-3
"""[rad/s]: default lower limit of a friction's width; below, what it does cannot be told from dry
friction's."""
POINT = 0.01
"""[m]: radius of gyration, along each axis, from which the inertia of a body that has none
starts."""
DELAY, OFFSET = "sampling.delay", 0.01
"""The path of the torque's delay, and its scale [s]."""
PARTS = ("plant", "model", "robot", "disturbance")


class Coordinates(NamedTuple):
    """The layout, and where the search starts."""

    places: tuple[Place, ...]
    """The leaves as the replay has them; static."""
    paths: tuple[str, ...]
    """As the user wrote them, one a place; the torque's delay, if it is looked for, is not among
    them."""
    names: tuple[str, ...]
    """What each number is called, (p,)."""
    units: tuple[str, ...]
    bodies: tuple[int, ...]
    """Where the six numbers of an inertia start in x and z."""
    x: np.ndarray
    low: np.ndarray
    """Of z; infinite for log-Cholesky coordinates."""
    high: np.ndarray
    delay: bool
    """Whether the torque's delay was asked for by its path."""


def replayed_scenario(scenario: Scenario, given: list[str]) -> tuple[Scenario, list[str]]:
    """The scenario whose plant is looked for, and the paths in it: of "model." paths, the model in
    the place of the plant.
    """
    roots = {paths.parse(path)[0] for path in given}
    for path in given:
        if path != DELAY and paths.parse(path)[0] not in PARTS:
            raise checks.fail(
                "paths",
                path,
                f"a leaf of robot, plant, model or disturbance, or {DELAY}",
                "What else there is does not move a robot whose torque was logged.",
            )
    if "model" in roots and roots & {"plant", "robot"}:
        raise checks.fail(
            "paths", given, "plant or model", "robot. is both: the log is of one robot."
        )
    moved = [
        "plant" + path[5:] if path.startswith(("robot.", "model.")) else path for path in given
    ]
    return (with_parts(scenario, plant=scenario.model) if "model" in roots else scenario), moved


WIDTHS = {"friction": "friction_width", "coulomb": "width"}
"""Coulomb friction, and the leaf beside it over which it changes its sign."""


def with_widths(scenario: Scenario, given: Any) -> Any:
    """The paths, and for each Coulomb friction among them that of its width."""
    if not isinstance(given, list | tuple) or not all(isinstance(path, str) for path in given):
        return given
    found = list(given)

    def new(path):
        try:
            return not any(same_place(scenario, path, other) for other in found)
        except ValueError:  # a path of something else
            return False

    for path in given:
        place = re.fullmatch(r"(.*\.)(friction|coulomb)((?:\[\d+\])?)", path)
        if place is None:
            continue
        width = f"{place[1]}{WIDTHS[place[2]]}{place[3]}"
        entries = (
            () if place[3] else (f"{width}[{j}]" for j in range(scenario.n))
        )  # some of them may have been asked for
        found += [width] if new(width) else [entry for entry in entries if new(entry)]
    return found


def coordinates(
    scenario: Scenario, given: Any, limits: Mapping[str, Any]
) -> tuple[Scenario, Coordinates]:
    """The scenario to replay, and the coordinates of a list of paths.

    Args:
      scenario: canonical.
      given: paths.
      limits: path -> (low, high), in the leaf's unit.

    Raises:
      ValueError: an unknown or overlapping path, one that does not move the plant, or limits that
        exclude the start.
    """
    wanted = [
        checks.word("paths", path, "a path")
        for path in checks.listed("paths", given, '["plant.mass", "plant.damping"]')
    ]
    if DELAY in wanted and scenario.sampling is None:
        raise checks.fail(
            "paths",
            DELAY,
            "a scenario with a sampling, which holds it",
            "Leave it out: known.delay is found in any case.",
        )
    check_paths(scenario, wanted, "paths")
    scenario, moved = replayed_scenario(scenario, wanted)
    for path in limits:
        if path not in wanted:
            raise checks.fail("limits", path, f"one of the paths: {', '.join(wanted)}")
    places, names, units, parts, start = [], [], [], [], 0
    bodies: list[int] = []
    for path, own in zip(wanted, moved, strict=True):
        if path == DELAY:
            continue
        value = np.asarray(paths.get(scenario, own), float)
        if not np.all(np.isfinite(value)):
            raise checks.fail(path, value, "a finite number to start from")
        low, high = _limits(path, value, paths.sign_at(scenario, own), limits.get(path))
        if is_inertia(scenario, own, value) and path not in limits:
            first = len(bodies)
            bodies += [start + 6 * i for i in range(value.size // 6)]
            value = np.array(
                [
                    _a_body(J, m)
                    for J, m in zip(
                        value.reshape(-1, 6),
                        _masses(scenario, own, len(bodies) - first),
                        strict=True,
                    )
                ]
            ).reshape(value.shape)
        places.append(Place(own, value.shape, start, value.size))
        parts.append((value.ravel(), low.ravel(), high.ravel()))
        names += [path + "".join(f"[{i}]" for i in index) for index in np.ndindex(value.shape)]
        units += [paths.unit_at(scenario, own)] * value.size
        start += value.size
    x, low, high = (
        np.concatenate(part) if part else np.zeros(0)
        for part in (zip(*parts, strict=True) if parts else ((), (), ()))
    )
    kept = tuple(path for path in wanted if path != DELAY)
    return scenario, Coordinates(
        tuple(places),
        kept,
        tuple(names),
        tuple(units),
        tuple(bodies),
        x,
        low,
        high,
        DELAY in wanted,
    )


def is_inertia(scenario: Scenario, path: str, value: np.ndarray) -> bool:
    """Whether a leaf holds the six moments of inertia of bodies in space."""
    return (
        value.shape[-1:] == (6,) and paths.unit_at(scenario, path) == "kg m^2" and "inertia" in path
    )


def _masses(scenario: Scenario, path: str, count: int) -> np.ndarray:
    """The masses of the bodies whose inertias are at a path."""
    (place,) = paths.places(scenario, path)
    where = place.index("inertia")
    owner = "".join(f"[{x}]" if isinstance(x, int) else f".{x}" for x in place[:where]).lstrip(".")
    rest = "".join(f"[{x}]" for x in place[where + 1 :])
    return np.broadcast_to(np.asarray(paths.get(scenario, f"{owner}.mass{rest}"), float), (count,))


def _a_body(J: np.ndarray, mass: float) -> np.ndarray:
    """An inertia to start from: itself, or where no body has it, the nearest of a body that is
    thick enough.
    """
    S, least = moments(J), max(mass, 1e-3) * POINT**2
    size, axes = np.linalg.eigh(S)
    if size[0] > 1e-9 * max(size[-1], least):
        return J
    return inertia((axes * np.maximum(size, least)) @ axes.T)


def _limits(
    path: str, value: np.ndarray, sign: str | None, given: Any
) -> tuple[np.ndarray, np.ndarray]:
    least = SHARPEST if "width" in path else SMALLEST * value
    low = {
        "positive": np.broadcast_to(np.minimum(least, value), value.shape),
        "nonnegative": np.zeros_like(value),
    }.get(sign or "", np.full_like(value, -np.inf))
    if "mass" in path:
        low = SMALLEST * value  # a link of no mass is none
    high = np.full_like(value, np.inf)
    if given is not None:
        if not isinstance(given, tuple | list) or len(given) != 2:
            raise checks.fail(
                f"limits[{path!r}]", given, "(low, high), each a number, one an entry, or None"
            )
        ends = [
            (
                end
                if x is None
                else np.broadcast_to(
                    np.asarray(checks.as_floats(f"limits[{path!r}]", x), float), value.shape
                )
            )
            for x, end in zip(given, (low, high), strict=True)
        ]
        low, high = ends
    if not np.all((low <= value) & (value <= high)) or not np.all(low < high):
        raise checks.fail(
            f"limits[{path!r}]",
            value,
            f"a start between {low.tolist()} and {high.tolist()}",
            "Widen the limits, or change the scenario's value.",
        )
    return low, high


# -------------------------------------------------------------------------------------------------------------- inertias


def moments(J: np.ndarray) -> np.ndarray:
    """S (3, 3) of (xx, yy, zz, xy, xz, yz)."""
    xx, yy, zz, xy, xz, yz = J
    full = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return 0.5 * np.trace(full) * np.eye(3) - full


def inertia(S: np.ndarray) -> np.ndarray:
    """(xx, yy, zz, xy, xz, yz) of S."""
    full = np.trace(S) * np.eye(3) - S
    return np.array([full[0, 0], full[1, 1], full[2, 2], full[0, 1], full[0, 2], full[1, 2]])


LOWER = np.tril_indices(3, -1)


def to_z(c: Coordinates, x: np.ndarray) -> np.ndarray:
    """Coordinates of numbers."""
    z = x.copy()
    for at in c.bodies:
        L = np.linalg.cholesky(moments(x[at : at + 6]))
        z[at : at + 6] = [*np.log(np.diag(L)), *L[LOWER]]
    return z


def to_x(c: Coordinates, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers at coordinates z, and their derivative dx/dz, (p, p)."""
    x, slope = z.copy(), np.eye(len(z))
    for at in c.bodies:
        own = slice(at, at + 6)
        L = np.diag(np.exp(z[at : at + 3]))
        L[LOWER] = z[at + 3 : at + 6]
        x[own] = inertia(L @ L.T)
        for i in range(6):
            dL = np.zeros((3, 3))
            if i < 3:
                dL[i, i] = L[i, i]
            else:
                dL[LOWER[0][i - 3], LOWER[1][i - 3]] = 1.0
            slope[own, at + i] = inertia(dL @ L.T + L @ dL.T)
    return x, slope


def scales(c: Coordinates, scenario: Scenario, by_x: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """The scale of each number (head of this module).

    Args:
      c: the coordinates.
      scenario: whose plant is looked for.
      by_x: derivative of the torque, (P, n, p) [N m by unit].
      torque: of the log, (P, n).
    """
    size = np.sqrt(np.mean(torque**2, axis=0)) + 1e-9 * np.max(np.abs(torque))
    effect, start = (
        np.sqrt(np.sum(np.mean((by_x / size[:, None]) ** 2, axis=0), axis=0)),
        np.abs(c.x),
    )
    alone = 1.0 / np.where(effect > 1e-12, effect, 1.0)
    scale = alone.copy()
    for i, unit in enumerate(c.units):
        if unit in ("kg", "kg m^2") and start[i] > 0:
            scale[i] = start[i]
        elif unit == "m":
            joints = (
                np.asarray(scenario.plant.skeleton(scenario.initial.q))
                if hasattr(scenario.plant, "skeleton")
                else np.zeros((1, 3))
            )
            length = (
                float(np.mean(np.linalg.norm(np.diff(joints, axis=0), axis=1)))
                if len(joints) > 1
                else 0.0
            )
            scale[i] = min(alone[i], length) if length > 0 else alone[i]
    for at in c.bodies:
        scale[at : at + 6] = np.sum(c.x[at : at + 3])
    return scale
