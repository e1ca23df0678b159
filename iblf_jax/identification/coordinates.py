"""The parameters x of an identification, and coordinates z in which every point is a rigid body.

A link's pseudo-inertia P = [[S + m c c^T, m c], [m c^T, m]] is positive definite where m > 0 and

    S = 1/2 tr(J) 1 - J = L L^T,
    L lower triangular with exp(z_1), exp(z_2), exp(z_3) on its diagonal,

S being the second moments about the centre of mass: this is the log-Cholesky form, block by block.
The six entries of an inertia have the coordinates z_1 ... z_6.  Masses and all other leaves are
their own coordinates, inside limits.

Each parameter has a scale, relative to which its uncertainty is measured: the start for masses and
moments of inertia; the mean length of the arm's links for lengths; for other parameters the value
that alone would need a torque as large as the logged one.

Source: C. Rucker, P. M. Wensing, IEEE Robotics and Automation Letters 7 (2022) 2645-2652.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from iblf_jax.core import checks
from iblf_jax.identification.replay import LeafSlice
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario, with_parts
from iblf_jax.studies.draws import check_paths, paths_overlap

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


MIN_POSITIVE_FACTOR = 1e-3
"""Default lower limit of a number that must be positive, by its start."""
MIN_FRICTION_WIDTH = 1e-3
"""[rad/s]: default lower limit of a friction's width; a narrower one cannot be distinguished from
dry friction."""
STARTING_GYRATION_RADIUS = 0.01
"""[m]: radius of gyration, along each axis, with which the search starts where an inertia is not
positive definite."""
DELAY_PATH = "sampling.delay"
"""The path of the torque's delay."""
DELAY_SCALE, LARGEST_DELAY = 0.01, 0.1
"""The scale of the delay, and its largest absolute value [s]."""
PARTS = ("plant", "model", "robot", "disturbance")


class Coordinates(NamedTuple):
    """The layout of x and z, and the start of the search."""

    places: tuple[LeafSlice, ...]
    """The leaves of the simulated scenario, and their entries of x; static."""
    paths: tuple[str, ...]
    """Paths as the user wrote them, one for each place, without that of the torque's delay."""
    names: tuple[str, ...]
    """Names of the parameters, (p,)."""
    units: tuple[str, ...]
    bodies: tuple[int, ...]
    """First index of each inertia in x and z."""
    x: np.ndarray
    low: np.ndarray
    """Lower limits of z; infinite for log-Cholesky coordinates."""
    high: np.ndarray
    has_delay_path: bool
    """Whether the path of the torque's delay was given."""


def scenario_of_plant(scenario: Scenario, given: list[str]) -> tuple[Scenario, list[str]]:
    """The scenario whose plant is identified, and the paths in it; for "model." paths it has the
    model in place of the plant.
    """
    roots = {paths.parse(path)[0] for path in given}
    for path in given:
        if path != DELAY_PATH and paths.parse(path)[0] not in PARTS:
            raise checks.fail(
                "paths",
                path,
                f"a leaf of robot, plant, model or disturbance, or {DELAY_PATH}",
                "Other leaves do not influence the motion under a logged torque.",
            )
    if "model" in roots and roots & {"plant", "robot"}:
        raise checks.fail(
            "paths", given, "plant or model", "robot. is both: the log is of one robot."
        )
    if "model" in roots:
        scenario = with_parts(scenario, plant=scenario.model)
    return scenario, [plant_path(path) for path in given]


def plant_path(path: str) -> str:
    """The path of a leaf of the robot or of the model in the plant."""
    if path.startswith(("robot.", "model.")):
        return "plant" + path[5:]
    return path


WIDTHS = {"friction": "friction_width", "coulomb": "width"}
"""Leaf of Coulomb friction -> leaf of its width, the speed over which it changes its sign."""


def with_widths(scenario: Scenario, given: object) -> Any:
    """The paths, and the path of the width for each Coulomb friction among them."""
    if not isinstance(given, list | tuple) or not all(isinstance(path, str) for path in given):
        return given
    found = list(given)

    def new(path):
        try:
            return not any(paths_overlap(scenario, path, other) for other in found)
        except ValueError:  # the scenario has no such width
            return False

    for path in given:
        place = re.fullmatch(r"(.*\.)(friction|coulomb)((?:\[\d+\])?)", path)
        if place is None:
            continue
        width = f"{place[1]}{WIDTHS[place[2]]}{place[3]}"
        if new(width):
            found.append(width)
        elif not place[3]:  # the user may have given some of the entries
            entries = [f"{width}[{j}]" for j in range(scenario.n)]
            found += [entry for entry in entries if new(entry)]
    return found


def _check_robot(scenario: Scenario) -> None:
    """Raises ValueError for a plant in strict-feedback form: a log holds the positions of joints
    and the torques on them.
    """
    robot = scenario.loop.plant.robot
    if robot is scenario.plant:
        return
    remedy = "Its equation of motion gives the torques of a log."
    if robot is not None:
        remedy = (
            "Identify the robot inside from torques on its joints, in a scenario with"
            " plant=scenario.plant.robot."
        )
    kind = type(scenario.plant).__name__
    raise checks.fail("scenario.plant", kind, "a robot", remedy)


def coordinates(
    scenario: Scenario, given: object, limits: Mapping[str, Any]
) -> tuple[Scenario, Coordinates]:
    """The scenario to replay, and the coordinates of a list of paths.

    Args:
      scenario: canonical.
      given: paths.
      limits: path -> (low, high), in the leaf's unit.

    Raises:
      ValueError: a plant that is no robot, an unknown or overlapping path, one that does not move
        the plant, or limits that exclude the start.
    """
    _check_robot(scenario)
    requested = checks.nonempty_list("paths", given, '["plant.mass", "plant.damping"]')
    requested = [checks.string("paths", path, "a path") for path in requested]
    if DELAY_PATH in requested and scenario.sampling is None:
        expected = "a scenario with a sampling, which has this leaf"
        remedy = "Leave it out: the delay is estimated in any case."
        raise checks.fail("paths", DELAY_PATH, expected, remedy)
    check_paths(scenario, requested, "paths")
    scenario, plant_paths = scenario_of_plant(scenario, requested)
    for path in limits:
        if path not in requested:
            raise checks.fail("limits", path, f"one of the paths: {', '.join(requested)}")
    places, names, units, parts = [], [], [], []
    bodies: list[int] = []
    start = 0
    for path, own in zip(requested, plant_paths, strict=True):
        if path == DELAY_PATH:
            continue
        value = np.asarray(paths.get(scenario, own), float)
        if not np.all(np.isfinite(value)):
            raise checks.fail(path, value, "a finite number to start from")
        low, high = _limits(path, value, paths.sign_at(scenario, own), limits.get(path))
        if is_inertia(scenario, own, value) and path not in limits:
            count = value.size // 6
            bodies += [start + 6 * i for i in range(count)]
            bodies_of_leaf = zip(value.reshape(-1, 6), _masses(scenario, own, count), strict=True)
            value = np.reshape([_rigid_body(J, mass) for J, mass in bodies_of_leaf], value.shape)
        places.append(LeafSlice(own, value.shape, start, value.size))
        parts.append((value.ravel(), low.ravel(), high.ravel()))
        names += [path + "".join(f"[{i}]" for i in index) for index in np.ndindex(value.shape)]
        units += [paths.unit_at(scenario, own)] * value.size
        start += value.size
    empty = (np.zeros(0),) * 3
    x, low, high = (np.concatenate(column) for column in zip(empty, *parts, strict=True))
    return scenario, Coordinates(
        places=tuple(places),
        paths=tuple(path for path in requested if path != DELAY_PATH),
        names=tuple(names),
        units=tuple(units),
        bodies=tuple(bodies),
        x=x,
        low=low,
        high=high,
        has_delay_path=DELAY_PATH in requested,
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


def _rigid_body(J: np.ndarray, mass: float) -> np.ndarray:
    """An inertia, or the nearest one of a rigid body of a least thickness if it belongs to none."""
    S = moments(J)
    least = max(mass, 1e-3) * STARTING_GYRATION_RADIUS**2
    size, axes = np.linalg.eigh(S)
    if size[0] > 1e-9 * max(size[-1], least):
        return J
    return inertia((axes * np.maximum(size, least)) @ axes.T)


def _limits(
    path: str, value: np.ndarray, sign: str | None, given: Any
) -> tuple[np.ndarray, np.ndarray]:
    """The lower and upper limits of a leaf: the given ones, or those that its sign implies."""
    low, high = _default_lower_limit(path, value, sign), np.full_like(value, np.inf)
    if given is not None:
        name = f"limits[{path!r}]"
        if not isinstance(given, tuple | list) or len(given) != 2:
            expected = "(low, high), each a number, one an entry, or None"
            raise checks.fail(name, given, expected)
        low, high = (
            _limit(name, x, default) for x, default in zip(given, (low, high), strict=True)
        )
    if not np.all((low <= value) & (value <= high)) or not np.all(low < high):
        raise checks.fail(
            f"limits[{path!r}]",
            value,
            f"a start between {low.tolist()} and {high.tolist()}",
            "Widen the limits, or change the scenario's value.",
        )
    return low, high


def _default_lower_limit(path: str, value: np.ndarray, sign: str | None) -> np.ndarray:
    if "mass" in path:  # a link without mass has no motion
        return MIN_POSITIVE_FACTOR * value
    if sign == "positive":
        least = MIN_FRICTION_WIDTH if "width" in path else MIN_POSITIVE_FACTOR * value
        return np.broadcast_to(np.minimum(least, value), value.shape)
    if sign == "nonnegative":
        return np.zeros_like(value)
    return np.full_like(value, -np.inf)


def _limit(name: str, given: object, default: np.ndarray) -> np.ndarray:
    """One limit of all entries of a leaf."""
    if given is None:
        return default
    return np.broadcast_to(np.asarray(checks.as_floats(name, given), float), default.shape)


# ----------------------------------------------------------------- inertias


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
    """The coordinates of parameters x."""
    z = x.copy()
    for first in c.bodies:
        L = np.linalg.cholesky(moments(x[first : first + 6]))
        z[first : first + 6] = [*np.log(np.diag(L)), *L[LOWER]]
    return z


def to_x(c: Coordinates, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The parameters at coordinates z, and their derivative dx/dz, (p, p)."""
    x, x_by_z = z.copy(), np.eye(len(z))
    for first in c.bodies:
        body = slice(first, first + 6)
        L = np.diag(np.exp(z[first : first + 3]))
        L[LOWER] = z[first + 3 : first + 6]
        x[body] = inertia(L @ L.T)
        for i in range(6):
            dL = np.zeros((3, 3))
            if i < 3:
                dL[i, i] = L[i, i]
            else:
                dL[LOWER[0][i - 3], LOWER[1][i - 3]] = 1.0
            x_by_z[body, first + i] = inertia(dL @ L.T + L @ dL.T)
    return x, x_by_z


def scales(c: Coordinates, scenario: Scenario, by_x: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """The scale of each parameter, as the docstring of this module defines it.

    Args:
      c: the coordinates.
      scenario: scenario whose plant is identified.
      by_x: derivative of the torque, (P, n, p) [N m by unit].
      torque: torque of the log, (P, n) [N m].
    """
    size = np.sqrt(np.mean(torque**2, axis=0)) + 1e-9 * np.max(np.abs(torque))
    effect = np.sqrt(np.sum(np.mean((by_x / size[:, None]) ** 2, axis=0), axis=0))
    by_torque = 1.0 / np.where(effect > 1e-12, effect, 1.0)
    start = np.abs(c.x)
    scale = by_torque.copy()
    for i, unit in enumerate(c.units):
        if unit in ("kg", "kg m^2") and start[i] > 0:
            scale[i] = start[i]
        elif unit == "m":
            joints = scenario.plant.skeleton(scenario.initial.q)
            if joints is not None and len(joints) > 1:
                links = np.linalg.norm(np.diff(np.asarray(joints), axis=0), axis=1)
                length = float(np.mean(links))
                scale[i] = min(by_torque[i], length) if length > 0 else scale[i]
    for first in c.bodies:
        scale[first : first + 6] = np.sum(c.x[first : first + 3])
    return scale


def drive_limit(limit: ArrayLike | None) -> np.ndarray:
    """The largest speed or torque of a robot's joints; infinite if unknown."""
    return np.asarray(np.inf if limit is None else limit)
