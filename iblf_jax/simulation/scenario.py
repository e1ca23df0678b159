"""A scenario: everything that defines a run except its length and its step.

The plant (the simulated robot) and the model (the robot that law and observer know) are separate
objects. By default the model is the plant; give `model`, or perturb leaves of `plant` only, to let
them differ.
"""

from __future__ import annotations

import copy
import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators import Actuator
from iblf_jax.control.actuators import Ideal as IdealActuator
from iblf_jax.control.controllers import Controller, LawContext
from iblf_jax.control.observers import NoObserver, Observer
from iblf_jax.control.sensors import Ideal as IdealSensor
from iblf_jax.control.sensors import Sensor
from iblf_jax.core import checks, notices
from iblf_jax.core.disk_cache import keep_programs
from iblf_jax.core.presentation import present
from iblf_jax.core.pytree import (
    Leaf,
    astype,
    component,
    field_values,
    is_leaf_field,
    layers,
    leaf,
    unwrapped,
)
from iblf_jax.core.status import VELOCITY_LIMIT
from iblf_jax.core.time import joined, jump_times_of
from iblf_jax.simulation.optional import optional_member
from iblf_jax.simulation.sampling import Sampling, with_sufficient_queue
from iblf_jax.world import regions
from iblf_jax.world.bounds import Bounds, speed_limits_at, tube_at
from iblf_jax.world.disturbances import Disturbance, Nothing
from iblf_jax.world.references import Reference
from iblf_jax.world.robots import Robot
from iblf_jax.world.robots._base import mass_matrix_at


@component
class Initial:
    """Initial position and velocity of a run.

    Args:
      q: position, () or (n,) [rad].
      dq: velocity, () or (n,) [rad/s]; 0 if not given.
    """

    q: Leaf = leaf("rad")
    dq: Leaf = leaf("rad/s", default=0.0)


PARTS = (
    ("plant", Robot, "iblf_jax.robots has them; write your own with from_energy.", ("skeleton",)),
    ("model", Robot, "iblf_jax.robots has them; write your own with from_energy.", ("skeleton",)),
    ("reference", Reference, "iblf_jax.references has them.", ()),
    (
        "controller",
        Controller,
        "iblf_jax.controllers has them; iblf_jax.testing.check_law looks at your own.",
        (),
    ),
    ("observer", Observer, "iblf_jax.observers has them; NoObserver() for none.", ()),
    ("disturbance", Disturbance, "iblf_jax.disturbances has them; Nothing() for none.", ()),
    ("sensor", Sensor, "iblf_jax.sensors has them; Ideal() for none.", ()),
    ("actuator", Actuator, "iblf_jax.actuators has them; Ideal() for none.", ()),
)
"""Field, protocol, remedy and members that may be missing, for each part of a scenario that a user
may write."""

OF_VELOCITY = {
    "units": dict.fromkeys(("value", "offset", "amplitude", "initial", "final"), "rad/s")
}
"""Units of the leaves of bounds on velocities: leaf -> unit."""


@component
class Scenario:
    """Plant, model, reference, bounds, disturbance, law, observer and start of a run; and sampling,
    sensor and actuator of the law.

    Leaves with one number per joint may be given as a scalar; it is repeated for the plant's n
    joints.

    Args:
      plant: the simulated robot, any of `iblf_jax.robots`.
      reference: the desired trajectory, any of `iblf_jax.references`.
      bounds: constraints on the joint positions, a `bounds.Bounds`.
      controller: the law, any of `iblf_jax.controllers`.
      initial: position and velocity at the start, an `Initial`.
      observer: estimator of f, any of `iblf_jax.observers`; `NoObserver()` if not given.
      disturbance: torque on the plant that the law does not know, any of `iblf_jax.disturbances`;
        `Nothing()` if not given.
      model: the robot that law and observer know; the plant itself if not given.
      sampling: timing of law and observer, a `Sampling`; continuous time if not given.
      sensor: measurement of q and q', any of `iblf_jax.sensors`; `Ideal()` if not given.  Others
        need a sampling.
      actuator: from the command to the torque, any of `iblf_jax.actuators`; `Ideal()` if not given.
      velocity_bounds: constraints on the joint velocities, a `bounds.Bounds` [rad/s] whose funnels
        follow q_d'; none if not given.  Runs record their margins under every law;
        `controllers.FullState` enforces them.
      regions: where points of the robot must stay, a tuple of any of `iblf_jax.regions`; () if not
        given.  Runs record their margins under every law; `controllers.SafetyFilter` enforces them.

    Raises:
      ValueError: if a leaf has the wrong number of joints, model and plant differ in theirs, or a
        sensor comes without a sampling.
    """

    plant: Robot
    reference: Reference
    bounds: Bounds
    controller: Controller
    initial: Initial
    observer: Observer = NoObserver()
    disturbance: Disturbance = Nothing()
    model: Robot = None  # type: ignore[assignment]
    sampling: Sampling | None = None
    sensor: Sensor = IdealSensor()
    actuator: Actuator = IdealActuator()
    velocity_bounds: Bounds | None = dataclasses.field(default=None, metadata=OF_VELOCITY)
    regions: tuple[regions.Region, ...] = ()

    def check(self) -> None:
        """Completes the model, checks the parts, and gives every leaf with one number per joint its
        n entries.
        """
        if self.model is None:
            object.__setattr__(self, "model", self.plant)
        parts = field_values(self)
        for name, protocol, remedy, optional in PARTS:
            checks.conforms(f"Scenario.{name}", parts[name], protocol, remedy, optional)
        self._check_kinds()
        if self.model.n != self.plant.n:
            got, expected = f"{self.model.n} joints", f"{self.plant.n} joints, as the plant has"
            raise checks.fail("Scenario.model", got, expected)
        self._check_velocity_bounds()
        self._check_sampling()
        self._check_regions()
        for name, part in field_values(self).items():
            object.__setattr__(self, name, fit_joints(part, self.plant.n, name))

    def _check_kinds(self) -> None:
        """Raises ValueError for a part of the wrong class."""
        of_speeds = "Such as Bounds(lower=Constant(-1.0), upper=Constant(1.0)), in rad/s."
        kinds: tuple[tuple[str, Any, str, str], ...] = (
            ("initial", Initial, "an Initial", "Such as Initial(q=[0.8, 0.8])."),
            (
                "bounds",
                Bounds,
                "a Bounds",
                "Such as Bounds(lower=Constant(0.1), upper=Constant(0.9)).",
            ),
            ("velocity_bounds", Bounds | None, "a Bounds, or None", of_speeds),
            (
                "sampling",
                Sampling | None,
                "a Sampling, or None",
                "Such as ij.Sampling(period=2e-3).",
            ),
        )
        parts = field_values(self)
        for name, kind, expected, remedy in kinds:
            value = parts[name]
            if not isinstance(value, kind):
                raise checks.fail(f"Scenario.{name}", value, expected, remedy)

    def _check_velocity_bounds(self) -> None:
        """Raises ValueError for a law that needs velocity bounds in a scenario without them."""
        law = unwrapped(self.controller)
        if self.velocity_bounds is None and optional_member(law, "needs_velocity_bounds"):
            expected = f"the bounds that {type(law).__name__} keeps"
            remedy = "Such as velocity_bounds=Bounds(lower=Constant(-1.0), upper=Constant(1.0))."
            raise checks.fail("Scenario.velocity_bounds", None, expected, remedy)

    def _check_sampling(self) -> None:
        """Raises ValueError for a sensor in a scenario without a sampling."""
        if self.sampling is None and not isinstance(self.sensor, IdealSensor):
            got, expected = type(self.sensor).__name__, "an Ideal sensor where no law is sampled"
            remedy = "Add sampling=ij.Sampling(period=...): a sensor is read once a period."
            raise checks.fail("Scenario.sensor", got, expected, remedy)

    def _check_regions(self) -> None:
        """Makes a tuple of the regions; raises ValueError for one that is no region, or does not
        fit plant and model.
        """
        if not isinstance(self.regions, tuple | list):
            remedy = "Such as (ij.regions.HalfSpace(normal=[0, 1], offset=0.1),)."
            raise checks.fail("Scenario.regions", self.regions, "a tuple of regions", remedy)
        object.__setattr__(self, "regions", tuple(self.regions))
        for i, region in enumerate(self.regions):
            name = f"Scenario.regions[{i}]"
            checks.conforms(name, region, regions.Region, "iblf_jax.regions has them.")
            for robot in (self.plant, self.model):
                _check_region(name, region, robot)

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.plant.n

    def jump_times(self) -> jax.Array:
        """The times at which the right-hand side of the closed loop jumps, as its parts declare
        them, (m,) [s], unsorted.
        """
        parts: dict[str, Any] = {"plant": self.plant, "reference": self.reference}
        for name, bounds in (("bounds", self.bounds), ("velocity_bounds", self.velocity_bounds)):
            if bounds is not None:
                parts |= {f"{name}.lower": bounds.lower, f"{name}.upper": bounds.upper}
        parts |= {f"controller[{i}]": layer for i, layer in enumerate(layers(self.controller))}
        parts |= {
            "observer": self.observer,
            "disturbance": self.disturbance,
            "actuator": self.actuator,
        }
        dtype = jnp.result_type(self.initial.q)
        return joined([jump_times_of(name, part, dtype) for name, part in parts.items()], dtype)

    @property
    def context(self) -> LawContext:
        """The information of the law: model, reference, bounds and regions."""
        return LawContext(
            self.model, self.reference, self.bounds, self.velocity_bounds, self.regions
        )

    @property
    def setting(self) -> LawContext:
        """The name that earlier versions gave `context`."""
        return self.context

    def _repr_html_(self) -> str:
        return present("card", self)


def _check_region(name: str, region: regions.Region, robot: Robot) -> None:
    """Raises ValueError for a region whose point a robot does not have."""

    def distance():
        return region.distance(regions.position_of(robot, region.point, jnp.zeros(robot.n)))

    try:
        jax.eval_shape(distance)
    except Exception as error:
        kind = checks.with_article(type(robot).__name__)
        expected = f"a region for a point of {kind} of {robot.n} joints"
        reason = f"{type(error).__name__}: {checks.line(str(error))}"
        raise checks.fail(name, region, expected, reason) from error


def _check_is_scenario(scenario: Any) -> None:
    """Raises ValueError for something that is no scenario."""
    if not isinstance(scenario, Scenario):
        remedy = "Make one with ij.presets or ij.Scenario."
        raise checks.fail("scenario", scenario, "a Scenario", remedy)


def with_parts(scenario: Scenario, **parts: Any) -> Scenario:
    """A copy of the scenario with some parts replaced by name: `with_parts(scenario,
    observer=Momentum(kf=20.0), disturbance=Step(1.0, 5.0))`.

    `robot` stands for plant and model together, as in paths.  `plant` alone keeps the model, also
    where the model was the plant itself: then plant and model differ from here on.  `model=None`
    makes the model the plant itself.  A law inside a `Saturated` is replaced with it: give the
    whole controller.

    Args:
      scenario: the original; it stays as it is.
      parts: any of plant, model, robot, reference, bounds, controller, observer, disturbance,
        initial, sampling, sensor, actuator, velocity_bounds, regions; each as `Scenario` takes it,
        so that a scalar stands for one number per joint.  Numbers take the scenario's
        floating-point type.

    Returns:
      A new Scenario; it runs like any other, and compiles where the structure is new.

    Raises:
      ValueError: an unknown name, `robot` beside plant or model, a part of the wrong kind, or parts
        that differ in their number of joints.
    """
    _check_is_scenario(scenario)
    names = ("robot", *(field.name for field in dataclasses.fields(Scenario)))
    for name in parts:
        if name not in names:
            remedy = f"{checks.nearest(name, names)} Leaves change by ij.with_parameters.".strip()
            raise checks.fail("part", name, f"the name of a part: {', '.join(names)}", remedy)
    new = dataclasses.replace(scenario, **_with_both_robots(scenario, parts))
    dtype = _shared_dtype(scenario)
    if _shared_dtype(new) == dtype:
        return new
    return astype(new, dtype)


def _with_both_robots(scenario: Scenario, parts: dict[str, Any]) -> dict[str, Any]:
    """The parts, with `robot` replaced by plant and model; ValueError where these do not fit."""
    if "robot" in parts:
        for name in ("plant", "model"):
            if name in parts:
                expected = "either robot, or plant and model"
                remedy = "`robot` is plant and model together."
                raise checks.fail(name, parts[name], expected, remedy)
        others = {name: part for name, part in parts.items() if name != "robot"}
        return {**others, "plant": parts["robot"], "model": parts["robot"]}
    if "plant" in parts and "model" not in parts:
        n, joints = scenario.model.n, getattr(parts["plant"], "n", scenario.n)
        if joints != n:
            expected = f"{n} joints, as the model has"
            remedy = "Exchange plant and model together: robot=..."
            raise checks.fail("plant", f"{joints} joints", expected, remedy)
    return parts


def fit_joints(part: Any, n: int, path: str) -> Any:
    """`part` with its per-joint scalars repeated n times; ValueError where a leaf has another
    number of joints.
    """
    if isinstance(part, tuple):
        parts = tuple(fit_joints(x, n, f"{path}[{i}]") for i, x in enumerate(part))
        unchanged = all(a is b for a, b in zip(parts, part, strict=True))
        return part if unchanged else parts
    if not dataclasses.is_dataclass(part) or isinstance(part, type):
        return part
    new: dict[str, Any] = {}
    values = field_values(part)
    for field in dataclasses.fields(part):
        old = values[field.name]
        name = f"{path}.{field.name}"
        if not is_leaf_field(field):
            value = fit_joints(old, n, name)
        elif field.metadata["shape"] == "joint" and old is not None:
            value = _fit_leaf(old, n, name)
        else:
            value = old
        if value is not old:
            new[field.name] = value
    if not new:
        return part
    fitted = copy.copy(part)
    for key, value in new.items():
        object.__setattr__(fitted, key, value)
    return fitted


def _fit_leaf(value: Any, n: int, name: str) -> Any:
    """A per-joint leaf with its n entries."""
    if jnp.ndim(value) == 0:
        return jnp.broadcast_to(value, (n,))
    if jnp.shape(value) != (n,):
        expected = f"one number, or {n} (one a joint)"
        raise checks.fail(name, value, expected, f"Its shape is {jnp.shape(value)}.")
    return value


NUMBERS = (jax.Array, np.ndarray, np.generic, float, int)
"""Types of leaves."""


def check_values(part: Any, path: str = "") -> None:
    """Raises ValueError for the first concrete leaf that is not finite or has the wrong sign, with
    its path.
    """
    if isinstance(part, tuple):
        for i, x in enumerate(part):
            check_values(x, f"{path}[{i}]")
        return
    if not dataclasses.is_dataclass(part) or isinstance(part, type):
        return
    prefix = f"{path}." if path else ""
    values = field_values(part)
    for field in dataclasses.fields(part):
        if field.metadata.get("static"):
            continue
        name = prefix + field.name
        value = values[field.name]
        if isinstance(value, NUMBERS):
            checks.check_values(name, value, field.metadata.get("sign"))
        else:
            check_values(value, name)


def canonical(scenario: Scenario) -> Scenario:
    """The scenario with every leaf an array of one floating-point type, checked; every entry point
    calls this first.

    Raises:
      ValueError: a leaf is not finite or has the wrong sign, a mass matrix is not positive
        definite, the start is outside its bounds or faster than VELOCITY_LIMIT; the message names
        the field, the value and the remedy.
    """
    _check_is_scenario(scenario)
    keep_programs()
    check_values(scenario)
    scenario = with_sufficient_queue(scenario)
    dtype = _shared_dtype(scenario)
    scenario = jax.tree.map(lambda x: _typed(x, dtype), scenario)
    if checks.is_concrete(scenario):
        _check_start(scenario)
        for law in layers(scenario.controller):
            check = optional_member(law, "check_start")
            if check is not None:
                check(scenario.context)
        for text in _advice(scenario):
            notices.warn(text)
    return scenario


def _advice(scenario: Scenario) -> list[str]:
    """The warnings of the parts about their numbers."""
    advice: list[str] = []
    for part in (scenario.controller, scenario.observer):
        of_part = optional_member(part, "advice")
        if of_part is not None:
            advice += of_part()
    of_sensor = optional_member(scenario.sensor, "advice")
    if scenario.sampling is not None and of_sensor is not None:
        advice += of_sensor(scenario.sampling.period)
    return advice


def _typed(x: Any, dtype) -> jax.Array:
    """A leaf as an array of a type. Numbers of the host are converted there, because JAX compiles a
    program for every new shape.
    """
    if not isinstance(x, jax.Array):
        return jnp.asarray(np.array(x, dtype))
    if x.dtype == dtype and not x.weak_type:
        return x
    return jax.lax.convert_element_type(x, np.dtype(dtype))


def _shared_dtype(scenario: Scenario) -> jax.typing.DTypeLike:
    """float32 if all numbers are float32, else JAX's default."""
    leaves = jax.tree.leaves(scenario)
    if not all(isinstance(x, NUMBERS) for x in leaves):
        raise _not_a_number(scenario)
    # `result_type` would not see the type of a weakly typed array.
    types = {x.dtype if isinstance(x, jax.Array) else jnp.result_type(x) for x in leaves}
    supported = {jnp.dtype("float32"), jnp.dtype("float64")}
    floats = {x for x in types if jnp.issubdtype(x, jnp.floating)}
    if len(floats) == 1 and floats <= supported:
        return floats.pop()
    if floats and not floats & supported:
        got = f"numbers of type {floats.pop()}"
        remedy = 'Use iblf_jax.astype(scenario, "float32").'
        raise checks.fail("scenario", got, "float32 or float64", remedy)
    return jnp.result_type(float)


def _not_a_number(scenario: Scenario) -> ValueError:
    """The error about the first leaf that is not an array of numbers."""
    path, value = next(
        (path, x)
        for path, x in jax.tree_util.tree_leaves_with_path(scenario)
        if not isinstance(x, NUMBERS)
    )
    name = jax.tree_util.keystr(path).lstrip(".")
    remedy = "Other things belong in a static field."
    return checks.fail(name, value, "an array of numbers", remedy)


# --- checks of the start -------------------------------------------------------------------------


def _shaped(name: str, call, *shape: int) -> jax.Array:
    """The value of `call()`, or a ValueError that names it if it raises or has another shape."""
    try:
        value = call()
    except Exception as error:
        raise checks.fail(
            name, f"{type(error).__name__}: {error}", f"an array of shape {shape}"
        ) from error
    if jnp.shape(value) != shape:
        raise checks.fail(
            name, f"shape {jnp.shape(value)}", f"shape {shape}", f"The plant has {shape[0]} joints."
        )
    return value


class _Start(NamedTuple):
    """Reference, bounds and margins at t = 0."""

    q_d: Any
    lower: Any
    upper: Any
    velocity_bounds: Any
    """Lower and upper, (n,) each [rad/s]; None if there are none."""
    region_margins: Any


@jax.jit
def _at_start(scenario: Scenario) -> _Start:
    """Reference and bounds at the start. Shapes are checked while this is traced, once per
    structure.
    """
    n, q, dq = scenario.n, scenario.initial.q, scenario.initial.dq
    t = jnp.zeros((), q.dtype)
    q_d = _shaped("reference.position(t)", lambda: scenario.reference.position(t), n)
    _shaped("bounds.lower.at(t, q_d)", lambda: scenario.bounds.lower.at(t, q_d), n)
    _shaped("bounds.upper.at(t, q_d)", lambda: scenario.bounds.upper.at(t, q_d), n)
    tube = tube_at(scenario.reference, scenario.bounds, t)
    for name, robot in (("plant", scenario.plant), ("model", scenario.model)):
        _shaped(f"{name}.mass_matrix(q)", lambda r=robot: r.mass_matrix(q), n, n)
        _shaped(f"{name}.coriolis(q, v, u)", lambda r=robot: r.coriolis(q, dq, dq), n)
        _shaped(f"{name}.gravity(q)", lambda r=robot: r.gravity(q), n)
    _shaped(
        "disturbance.torque(t, q, dq, plant, model)",
        lambda: scenario.disturbance.torque(t, q, dq, scenario.plant, scenario.model),
        n,
    )
    velocity_bounds = _velocity_bounds(scenario, t)
    margins = q[:0]
    if scenario.regions:
        margins = regions.margins(scenario.regions, scenario.plant, q)
    return _Start(tube.q_d, tube.lower, tube.upper, velocity_bounds, margins)


def _velocity_bounds(scenario: Scenario, t: jax.Array):
    """Bounds on the velocities at time t, their shapes checked; None if there are none."""
    bounds, n = scenario.velocity_bounds, scenario.n
    if bounds is None:
        return None
    dq_d = jnp.zeros((n,), t.dtype)
    for name, side in (("lower", bounds.lower), ("upper", bounds.upper)):
        _shaped(f"velocity_bounds.{name}.at(t, dq_d)", lambda side=side: side.at(t, dq_d), n)
    return speed_limits_at(scenario.reference, bounds, t)


def _check_start(scenario: Scenario) -> None:
    """Raises ValueError for a start outside its bounds or too fast, or a mass matrix there that is
    not positive definite.
    """
    start = jax.tree.map(np.asarray, _at_start(scenario))
    initial = scenario.initial
    masses = {
        name: np.asarray(mass_matrix_at(robot, initial.q))
        for name, robot in (("plant", scenario.plant), ("model", scenario.model))
    }
    finite = (
        ("reference", start.q_d),
        ("bounds.lower", start.lower),
        ("bounds.upper", start.upper),
    )
    for name, values in finite:
        if not np.all(np.isfinite(values)):
            raise checks.fail(name, values, "finite values at t = 0")
    _check_positions(np.asarray(initial.q), start)
    if start.velocity_bounds is not None:
        _check_speeds(np.asarray(initial.dq), *start.velocity_bounds)
    for region, margin in zip(scenario.regions, start.region_margins, strict=True):
        if not margin > 0:
            name = regions.in_words(region, scenario.plant)
            got, expected = (
                f"{name} {-margin:.4g} m beyond its boundary",
                "a start inside all regions",
            )
            raise checks.fail("initial.q", got, expected, "Move the start or the region.")
    if not np.all(np.abs(initial.dq) < VELOCITY_LIMIT):
        expected = f"speeds below {VELOCITY_LIMIT:g} rad/s"
        raise checks.fail("initial.dq", initial.dq, expected, "A run that fast counts as diverged.")
    for name, matrix in masses.items():
        _check_mass_matrix(f"{name}.mass_matrix(initial.q)", matrix)


def _check_positions(q: np.ndarray, start: _Start) -> None:
    """Raises ValueError for bounds that leave no room at t = 0, or a reference or a start outside
    of them.
    """
    for i, (low, high) in enumerate(zip(start.lower, start.upper, strict=True)):
        interval = f"inside the bounds ({low:.6g}, {high:.6g}) at t = 0"
        if not low < high:
            expected, remedy = "lower < upper at t = 0", "Exchange or widen them."
            raise checks.fail(f"bounds of joint {i}", (low, high), expected, remedy)
        if not low < start.q_d[i] < high:
            remedy = "Move the reference or widen the bounds (Assumption 2)."
            name, expected = f"reference of joint {i}", f"a value {interval}"
            raise checks.fail(name, start.q_d[i], expected, remedy)
        if not low < q[i] < high:
            remedy = "Move the start or widen the bounds."
            raise checks.fail(f"initial.q[{i}]", q[i], f"a start {interval}", remedy)


def _check_speeds(dq: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
    """Raises ValueError for bounds on the velocities that leave no room at t = 0, or a start
    outside of them.
    """
    for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
        if not low < high:
            expected, remedy = "finite lower < upper at t = 0", "Exchange or widen them."
            raise checks.fail(f"velocity_bounds of joint {i}", (low, high), expected, remedy)
        if not low < dq[i] < high:
            expected = f"a start inside the velocity bounds ({low:.6g}, {high:.6g}) at t = 0"
            remedy = "Change the start or widen the bounds."
            raise checks.fail(f"initial.dq[{i}]", dq[i], expected, remedy)


def _check_mass_matrix(name: str, matrix: np.ndarray) -> None:
    """Raises ValueError for a mass matrix that is not finite, symmetric and positive definite."""
    remedy = "Check the masses, lengths and inertias."
    is_finite = np.all(np.isfinite(matrix))
    if not is_finite or np.ptp(matrix - matrix.T) > 1e-4 * np.max(np.abs(matrix)):
        raise checks.fail(name, matrix, "a finite symmetric matrix", remedy)
    eigenvalues = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))
    if eigenvalues[0] <= len(matrix) * np.finfo(matrix.dtype).eps * eigenvalues[-1]:
        raise checks.fail(name, matrix, "a positive definite matrix", remedy)
