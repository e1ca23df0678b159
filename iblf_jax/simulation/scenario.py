"""A scenario: everything that defines a run except its duration and its time step.

The plant (the simulated robot) and the model (the robot that law and observer know) are separate
objects. By default the model is the plant; give `model`, or perturb leaves of `plant` only, to let
them differ.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators import Actuator
from iblf_jax.control.actuators import Ideal as IdealActuator
from iblf_jax.control.controllers import Law, LawContext, TrackingLaw
from iblf_jax.control.controllers._base import check_law, law_of_x
from iblf_jax.control.observers import DisturbanceObserver, NoObserver, Observer
from iblf_jax.control.observers import _base as observers
from iblf_jax.control.observers.none import observer_of_x
from iblf_jax.control.sensors import AnySensor, Sensor
from iblf_jax.control.sensors import Ideal as IdealSensor
from iblf_jax.control.sensors import _base as sensors
from iblf_jax.control.sensors._base import sensor_of_x
from iblf_jax.core import checks, modules, notices, programs
from iblf_jax.core.disk_cache import keep_programs
from iblf_jax.core.families import is_default, statements_of
from iblf_jax.core.modules import NUMBERS
from iblf_jax.core.presentation import present
from iblf_jax.core.pytree import (
    Leaf,
    astype,
    component,
    field_values,
    is_leaf_field,
    layers,
    leaf,
    note_code,
    rewrapped,
    unwrapped,
)
from iblf_jax.core.time import joined, jump_times_of
from iblf_jax.core.units import HIGHER, POSITION, VELOCITY, as_text
from iblf_jax.simulation.levels import has_speed_limits, start_levels
from iblf_jax.simulation.measurement_noise import noise_advice
from iblf_jax.simulation.sampling import PERIOD_TOLERANCE, Sampling
from iblf_jax.world import plants, process_noise, regions
from iblf_jax.world.bounds import Bounds, Funnel, Side, bounds_at, speed_limits_at
from iblf_jax.world.disturbances import Disturbance, Nothing
from iblf_jax.world.plants import Plant
from iblf_jax.world.process_noise import ProcessNoise
from iblf_jax.world.references import Reference
from iblf_jax.world.robots import Robot, WithMotors
from iblf_jax.world.robots._base import mass_matrix_at


@component
class Initial:
    """The state of the plant at the start of a run: position and velocity, or all levels.

    A plant in strict-feedback form with more than two levels takes x.  A flexible joint given by q
    and q' alone starts at the static equilibrium of its springs, and a drive with the current that
    holds gravity.

    Args:
      q: position, () or (n,) [rad].
      dq: velocity, () or (n,) [rad/s]; 0 if not given.
      higher: the levels from the third on, (r - 2, n) [1], in the units of the plant; the steady
        state if not given.  `Initial(x=...)` takes all levels, (r, n), in the place of q, dq and
        higher.
    """

    q: Leaf = leaf(POSITION)
    dq: Leaf = leaf(VELOCITY, default=0.0)
    higher: Leaf = leaf(HIGHER, shape="level", default=None)
    stacked: ClassVar[dict[str, tuple[str, ...]]] = {"x": ("q", "dq", "higher")}

    def __init__(self, q: Any = None, dq: Any = None, higher: Any = None, *, x: Any = None) -> None:
        if x is not None:
            if any(value is not None for value in (q, dq, higher)):
                expected = "either x, or q and dq"
                raise checks.fail("Initial.x", x, expected, "x is q, dq and the other levels.")
            q, dq, higher = _split_levels(x)
        for name, value in (("q", q), ("dq", 0.0 if dq is None else dq), ("higher", higher)):
            object.__setattr__(self, name, value)

    @property
    def x(self) -> jax.Array:
        """All given levels, (2, n) or (r, n)."""
        first = jnp.stack(jnp.broadcast_arrays(self.q, self.dq))
        return first if self.higher is None else jnp.concatenate([first, self.higher])


def _split_levels(x: Any) -> tuple[Any, Any, Any]:
    """The first two levels of a state (r, n), and the others; ValueError for another shape."""
    array = checks.as_floats("Initial.x", x)
    if array.ndim != 2 or len(array) < 2:
        expected = "one row a level, shape (r, n)"
        got = f"shape {array.shape}"
        remedy = "Such as x=[[0.3], [0.0], [0.0]] for three levels of one number."
        raise checks.fail("Initial.x", got, expected, remedy)
    return array[0], array[1], array[2:] if len(array) > 2 else None


ROBOTS = "iblf_jax.robots has them; write your own with from_energy."
PLANTS = "iblf_jax.plants has them; iblf_jax.testing.check_plant checks your own."
CONTRACTS: dict[str, tuple[Any, str]] = {
    "reference": (Reference, "iblf_jax.references has them."),
    "observer": (observers.contract_of, "iblf_jax.observers has them; NoObserver() for none."),
    "disturbance": (Disturbance, "iblf_jax.disturbances has them; Nothing() for none."),
    "sensor": (sensors.contract_of, "iblf_jax.sensors has them; Ideal() for none."),
    "actuator": (Actuator, "iblf_jax.actuators has them; Ideal() for none."),
}
"""Part of a scenario that a user may write -> its contract, or a function of the part that returns
it, and the remedy of an error message.
"""
LAWS = "iblf_jax.controllers has them; iblf_jax.testing.check_law checks your own."
CLASSES: dict[str, tuple[Any, str]] = {
    "initial": (Initial, "an Initial, such as Initial(q=[0.8, 0.8])"),
    "bounds": (
        Bounds | tuple | list,
        "a Bounds, such as Bounds(lower=Constant(0.1), upper=Constant(0.9)), or a tuple of one for"
        " each level",
    ),
    "sampling": (Sampling | None, "a Sampling, or None, such as ij.Sampling(period=2e-3)"),
    "regions": (
        tuple | list,
        "a tuple of regions, such as (ij.regions.HalfSpace(normal=[0, 1], offset=0.1),)",
    ),
}
"""Class of each other part, and its description in an error message."""

HOW_TO_MAKE = "Make one with ij.presets or ij.Scenario."


if TYPE_CHECKING:

    class BoundsOfLevels:
        """The type of `Scenario.bounds`: a tuple, for which the constructor takes one `Bounds`,
        too.
        """

        def __get__(
            self, scenario: Any, owner: Any
        ) -> tuple[Bounds, Bounds | None, *tuple[Bounds | None, ...]]:
            raise NotImplementedError

        def __set__(self, scenario: Any, bounds: Bounds | Sequence[Bounds | None]) -> None: ...

else:
    BoundsOfLevels = tuple[Bounds | None, ...]


class Loop(NamedTuple):
    """The parts of a scenario of which the closed loop knows one kind only: a robot is a plant of
    order 2, and parts of q and q' are parts of x.
    """

    plant: Plant
    model: Plant
    law: Law
    observer: Observer
    sensor: Sensor


@component
class Scenario:
    """The plant, the control system and the start of a run.

    Leaves with one number per joint may be given as a scalar; it is repeated for the plant's n
    joints.

    Args:
      plant: the simulated plant, any of `iblf_jax.robots` or `iblf_jax.plants`.
      reference: the desired trajectory, any of `iblf_jax.references`.
      bounds: constraints on the levels x_1, x_2, ... of the plant, a tuple of `bounds.Bounds`, or
        None for a level without; a single `Bounds` is that of x_1, which every scenario has.  The
        levels of a robot are its joint positions [rad] and velocities [rad/s]; the funnels of
        velocities follow q_d', and those of the levels of another plant the virtual control.  Runs
        record the margins of all levels under every law; `controllers.BarrierBackstepping`
        enforces those from the second level on.
      controller: the law, any of `iblf_jax.controllers`.
      initial: position and velocity at the start, an `Initial`.
      observer: estimator of f, any of `iblf_jax.observers`; `NoObserver()` if not given.
      disturbance: torque on the plant that is unknown to the law, any of `iblf_jax.disturbances`;
        `Nothing()` if not given.
      model: the robot or plant that law and observer know; the plant itself if not given.  A robot
        may be the model of a plant of higher order, under a law of robots; of an `ElectricDrive`
        the law then needs an input map (`controllers.WithDrive`).
      sampling: timing of law and observer, a `Sampling`; continuous time if not given.
      sensor: measurement of q and q', or of all levels of a plant (`sensors.Levels`), any of
        `iblf_jax.sensors`; `Ideal()` if not given.  Others need a sampling.  A level that is not
        measured needs an observer that estimates it, such as `observers.StateObserver`.
      actuator: map from command to torque, any of `iblf_jax.actuators`; `Ideal()` if not given.
      regions: sets in which points of the robot must stay, a tuple of any of `iblf_jax.regions`; ()
        if not given.  Runs record their margins under every law; `controllers.SafetyFilter`
        enforces them.
      process_noise: white noise on levels of the plant, any of `iblf_jax.process_noise`; none if
        not given.  Runs then need a method for stochastic differential equations.

    Raises:
      ValueError: if a leaf has the wrong number of joints, model and plant differ in theirs, or a
        sensor comes without a sampling.
    """

    plant: Annotated[Robot, Plant]
    reference: Reference
    bounds: BoundsOfLevels
    controller: TrackingLaw
    initial: Initial
    observer: DisturbanceObserver = NoObserver()
    disturbance: Disturbance = Nothing()
    model: Annotated[Robot, Plant] = None  # type: ignore[assignment]
    sampling: Sampling | None = None
    sensor: AnySensor = IdealSensor()
    actuator: Actuator = IdealActuator()
    regions: tuple[regions.Region, ...] = ()
    process_noise: ProcessNoise | None = None

    def check(self) -> None:
        """Checks the parts, makes the plant the model if none is given, and repeats scalars for the
        n joints.
        """
        if self.model is None:
            object.__setattr__(self, "model", plants.nominal_of(self.plant))
        for name in ("plant", "model"):
            check_plant_or_robot(f"Scenario.{name}", vars(self)[name])
        parts = field_values(self)
        check_law("Scenario.controller", self.controller, LAWS)
        for name, (contract, remedy) in CONTRACTS.items():
            base = contract if isinstance(contract, type) else contract(parts[name])
            checks.conforms(f"Scenario.{name}", parts[name], base, remedy)
        self._check_classes()
        self._fit_bounds()
        self._check_combination()
        check_levels(self)
        self._check_regions()
        _check_process_noise(self)
        _check_modes(self.plant)
        for name, part in field_values(self).items():
            object.__setattr__(self, name, fit_joints(part, self.plant.n, name))
        self._complete_law()

    def _complete_law(self) -> None:
        """Gives the law what it derives from its model and the start, such as weights."""
        law = unwrapped(self.controller)
        if is_default(law.completed, TrackingLaw.completed):
            return
        with jax.ensure_compile_time_eval():
            new = law.completed(self.context, start_levels(self)[: self.loop.model.order])
        if new is not law:
            object.__setattr__(self, "controller", rewrapped(self.controller, new))

    def _fit_bounds(self) -> None:
        """Makes a tuple of the bounds, one for each level."""
        given = (self.bounds,) if isinstance(self.bounds, Bounds) else tuple(self.bounds)
        order = plants.order_of(self.plant)
        for i, bounds in enumerate(given):
            if not isinstance(bounds, Bounds | None):
                expected = "a Bounds, or None for a level without bounds"
                raise checks.fail(f"Scenario.bounds[{i}]", bounds, expected)
        if any(bounds is not None for bounds in given[order:]):
            expected = f"at most {order}, for the levels 1 to {order}"
            raise checks.fail("Scenario.bounds", f"{len(given)} bounds", expected)
        if not given or given[0] is None:
            raise checks.fail("Scenario.bounds[0]", None, "the bounds of the first level")
        object.__setattr__(self, "bounds", given[:order] + (None,) * (order - len(given)))

    def _check_classes(self) -> None:
        """Raises ValueError for a part of the wrong class."""
        parts = field_values(self)
        for name, (kind, expected) in CLASSES.items():
            if not isinstance(parts[name], kind):
                raise checks.fail(f"Scenario.{name}", parts[name], expected)

    def _check_combination(self) -> None:
        """Raises ValueError for parts that do not fit together."""
        if self.model.n != self.plant.n:
            got = plants.counted_components(self.plant, self.model.n)
            expected = f"{plants.counted_components(self.plant, self.plant.n)}, as the plant has"
            raise checks.fail("Scenario.model", got, expected)
        law = unwrapped(self.controller)
        if self.bounds[1] is None and law.needs_velocity_bounds:
            expected = f"the bounds that {type(law).__name__} keeps"
            remedy = (
                "Such as bounds=(positions, Bounds(lower=Constant(-1.0), upper=Constant(1.0)))."
            )
            raise checks.fail("Scenario.bounds[1]", None, expected, remedy)
        if self.sampling is None and not isinstance(self.sensor, IdealSensor):
            got, expected = type(self.sensor).__name__, "an Ideal sensor where no law is sampled"
            remedy = "Add sampling=ij.Sampling(period=...): a sensor is read once a period."
            raise checks.fail("Scenario.sensor", got, expected, remedy)
        if self.sampling is not None and self.actuator.input_delay is not None:
            expected = "no Delay where the law is sampled"
            remedy = "Give ij.Sampling(period=..., delay=...) instead."
            raise checks.fail("Scenario.actuator", self.actuator, expected, remedy)

    def _check_regions(self) -> None:
        """Makes a tuple of the regions; raises ValueError for one that is no region, or does not
        fit plant and model.
        """
        object.__setattr__(self, "regions", tuple(self.regions))
        for i, region in enumerate(self.regions):
            name = f"Scenario.regions[{i}]"
            checks.conforms(name, region, regions.Region, "iblf_jax.regions has them.")
            for part in (self.plant, self.model):
                robot = plants.robot_of(part)
                if robot is None:
                    expected = "no regions, as this plant has no points in space"
                    raise checks.fail(name, region, expected, "Use bounds.")
                _check_region(name, region, robot)

    def symbols_of_part(self, field: str, index: int, symbols: Any) -> Any:
        """The units of the symbols in a part: bounds have the unit of their level."""
        if field != "bounds":
            return symbols
        return {**symbols, "x1": symbols[f"x{index + 1}"]}

    @property
    def loop(self) -> Loop:
        """The parts as the closed loop runs them, for a plant in strict-feedback form."""
        return Loop(
            plants.as_plant(self.plant),
            plants.as_plant(self.model),
            law_of_x(self.controller),
            observer_of_x(self.observer),
            sensor_of_x(self.sensor),
        )

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.plant.n

    def jump_times(self) -> jax.Array:
        """The times at which the right-hand side of the closed loop jumps, as its parts declare
        them, (m,) [s], unsorted.
        """
        parts: dict[str, Any] = {"plant": self.plant, "reference": self.reference}
        for i, bounds in enumerate(self.bounds):
            if bounds is not None:
                parts[f"bounds[{i}].lower"] = bounds.lower
                parts[f"bounds[{i}].upper"] = bounds.upper
        for i, law in enumerate(layers(self.controller)):
            parts[f"controller[{i}]"] = law
        parts["observer"] = self.observer
        parts["disturbance"] = self.disturbance
        parts["actuator"] = self.actuator
        dtype = jnp.result_type(self.initial.q)
        return joined([jump_times_of(name, part, dtype) for name, part in parts.items()], dtype)

    @property
    def context(self) -> LawContext:
        """The information of the law: model, reference, bounds and regions."""
        return LawContext(self.model, self.reference, self.bounds, self.regions)

    def _repr_html_(self) -> str:
        return present("card", self)


def _check_process_noise(scenario: Scenario) -> None:
    """Raises ValueError for something that is no process noise, or does not fit the plant."""
    noise, name = scenario.process_noise, "Scenario.process_noise"
    if noise is None:
        return
    checks.conforms(name, noise, ProcessNoise, "iblf_jax.process_noise has them.")
    process_noise.check_structure(noise)
    order = plants.order_of(scenario.plant)
    if noise.levels[-1] > order:
        expected = f"levels up to {order}, as the plant has"
        raise checks.fail(f"{name}.levels", noise.levels, expected)
    fitted: Any = fit_joints(noise, scenario.n, "process_noise")
    t, x = jnp.zeros(()), jnp.zeros((order, scenario.n))
    shape = (len(noise.levels), scenario.n)
    try:
        found = jax.eval_shape(fitted.diffusion, t, x).shape
    except Exception as error:
        got = f"{type(error).__name__}: {checks.one_line(str(error))}"
        raise checks.fail(f"{name}.diffusion(t, x)", got, f"shape {shape}") from error
    if found != shape:
        remedy = "One row for each of its levels."
        raise checks.fail(f"{name}.diffusion(t, x)", f"shape {found}", f"shape {shape}", remedy)


def _check_modes(plant: Any) -> None:
    """Raises ValueError for a part of the plant whose modes are a Markov chain: only the plant
    itself can be.
    """

    def draws_modes(part: Any) -> bool:
        return isinstance(part, plants.MarkovSwitched) and part is not plant

    inside = [part for part in jax.tree.leaves(plant, is_leaf=draws_modes) if draws_modes(part)]
    if inside:
        expected = "MarkovSwitched as the plant itself"
        remedy = "Such as MarkovSwitched(plant=FlexibleJoint(...), ...)."
        raise checks.fail("Scenario.plant", type(plant).__name__, expected, remedy)


def check_plant_or_robot(name: str, part: Any) -> None:
    """Raises ValueError for something that is neither a robot nor a plant in strict-feedback
    form.
    """
    if plants.is_chain(part):
        checks.conforms(name, part, Plant, PLANTS)
        plants.check_dimensions(name, part)
        return
    checks.conforms(name, part, Robot, f"{ROBOTS} {PLANTS}")


def check_levels(scenario: Scenario) -> None:
    """Raises ValueError for a model, a law, an observer or a start that does not fit the levels of
    the plant.
    """
    plant, model = scenario.plant, scenario.model
    order, known = plants.order_of(plant), plants.order_of(model)
    if known != order and known != 2:
        expected = f"a robot, or a plant of order {order}, as the plant is"
        raise checks.fail("Scenario.model", f"a plant of order {known}", expected)
    law = unwrapped(scenario.controller)
    kind = type(law).__name__
    if plants.is_chain(model) and not isinstance(law, Law):
        expected = f"a robot as the model of the law {kind}"
        robot = plants.robot_of(model)
        remedy = "Take controllers.BarrierBackstepping"
        remedy += "." if robot is None else ", or model=plant.robot."
        raise checks.fail("Scenario.model", type(model).__name__, expected, remedy)
    _check_input(scenario)
    _check_observer(scenario)
    _check_measured_levels(scenario)
    higher = scenario.initial.higher
    if higher is not None and len(higher) != order - 2:
        expected = f"{order} levels, as the plant has"
        raise checks.fail("Scenario.initial.x", f"{len(higher) + 2} levels", expected)
    if order > 2 and higher is None and not plants.has_steady_levels(plant):
        remedy = f"Give all levels: Initial(x=...), shape ({order}, {plant.n})."
        raise checks.fail("Scenario.initial", "q and dq", f"{order} levels", remedy)


def _check_observer(scenario: Scenario) -> None:
    """Raises ValueError for an observer of robots with a model that contains no robot, or one of
    levels with a model that does not fit its fields.
    """
    observer, model = scenario.observer, scenario.model
    if isinstance(observer, NoObserver):
        return
    if isinstance(observer, Observer):
        observer.check_model(plants.as_plant(model))
        return
    if plants.is_chain(model) and is_default(model.joint_torque, Plant.joint_torque):
        expected = "an observer of plants in strict-feedback form, such as LevelObserver"
        remedy = f"{type(model).__name__} contains no robot."
        raise checks.fail("Scenario.observer", type(observer).__name__, expected, remedy)


def _check_input(scenario: Scenario) -> None:
    """Raises ValueError for a law that commands another quantity than the plant's input: a torque
    for a voltage, say.
    """
    outermost, *wrapped = layers(scenario.controller)
    for law in wrapped:
        if law.input_unit is not None:
            kind = type(law).__name__
            expected = f"{kind} as the outermost law"
            remedy = f"Such as {kind}(law={type(outermost).__name__}(...), ...)."
            raise checks.fail("Scenario.controller", type(outermost).__name__, expected, remedy)
    needed = plants.units_of(scenario.plant)[-1]
    given = outermost.input_unit or plants.units_of(scenario.model)[-1]
    if given == needed or UNKNOWN_UNIT in (given, needed):
        return
    kind = type(scenario.plant).__name__
    expected = f"a law that commands the input of {kind} [{needed}]"
    remedy = "Take the plant as the model, with controllers.BarrierBackstepping."
    if isinstance(scenario.plant, plants.ElectricDrive):
        remedy = "Such as controllers.WithDrive(law, drive=plant), or model=plant."
    got = f"{type(outermost).__name__}, which commands [{given}]"
    raise checks.fail("Scenario.controller", got, expected, remedy)


UNKNOWN_UNIT = "1"
"""Unit of the levels and of the input of a plant that states none."""


def _check_measured_levels(scenario: Scenario) -> None:
    """Raises ValueError for levels that are neither measured nor estimated."""
    order = plants.order_of(scenario.plant)
    sensor, observer = sensor_of_x(scenario.sensor), observer_of_x(scenario.observer)
    covered = sensor.order
    if covered not in (None, order):
        expected = f"sensors of {order} levels, as the plant has"
        remedy = "None is for a level that is not measured."
        raise checks.fail("Scenario.sensor", f"sensors of {covered} levels", expected, remedy)
    every = tuple(range(1, plants.order_of(scenario.model) + 1))
    measured = sensor.measured or every
    needed = every
    if observer.completes:
        needed = observer.measured or every
    missing = [str(level) for level in needed if level not in measured]
    if not missing:
        return
    which = ", ".join(missing)
    expected = f"level {which} measured, which {type(scenario.observer).__name__} reads"
    if needed is every:
        expected = "every level of the model measured, or estimated by an observer"
    levels = tuple(level for level in every if level in measured)
    remedy = f"Such as observers.StateObserver(bandwidth=..., measured={levels})."
    if 1 not in levels:
        remedy = "The levels below a measured one do not follow from it: measure level 1."
    raise checks.fail("Scenario.sensor", f"no measurement of level {which}", expected, remedy)


def _check_region(name: str, region: regions.Region, robot: Robot) -> None:
    """Raises ValueError for a region whose point a robot does not have."""

    def distance():
        return region.distance(regions.position_of(robot, region.point, jnp.zeros(robot.n)))

    try:
        jax.eval_shape(distance)
    except Exception as error:
        kind = checks.with_article(type(robot).__name__)
        expected = f"a region for a point of {kind} of {robot.n} joints"
        reason = f"{type(error).__name__}: {checks.one_line(str(error))}"
        raise checks.fail(name, region, expected, reason) from error


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
        initial, sampling, sensor, actuator, regions, process_noise; each as `Scenario` takes it, so
        that a scalar stands for one number per joint.  A single `Bounds` replaces that of the first
        level and keeps the others.  Numbers take the scenario's floating-point type.

    Returns:
      A new Scenario; it runs like any other, and compiles where the structure is new.

    Raises:
      ValueError: an unknown name, `robot` beside plant or model, a part of the wrong kind, or parts
        that differ in their number of joints.
    """
    if not isinstance(scenario, Scenario):
        raise checks.fail("scenario", scenario, "a Scenario", HOW_TO_MAKE)
    names = ("robot", *(field.name for field in dataclasses.fields(Scenario)))
    for name in parts:
        if name not in names:
            remedy = f"{checks.nearest(name, names)} Leaves change by ij.with_parameters.".strip()
            raise checks.fail("part", name, f"the name of a part: {', '.join(names)}", remedy)
    parts = _with_both_robots(scenario, parts)
    if isinstance(parts.get("bounds"), Bounds):
        parts = {**parts, "bounds": (parts["bounds"], *scenario.bounds[1:])}
    new = dataclasses.replace(scenario, **parts)
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
        check_plant_or_robot("Scenario.plant", parts["plant"])
        n, joints = scenario.model.n, parts["plant"].n
        if joints != n:
            expected = f"{n} joints, as the model has"
            remedy = "Exchange plant and model together: robot=..."
            raise checks.fail("plant", f"{joints} joints", expected, remedy)
    return parts


def fit_joints(part: Any, n: int, path: str) -> Any:
    """`part` with its per-joint scalars repeated n times; ValueError where a leaf has another
    number of joints.
    """
    if modules.is_module(part):
        return part
    if isinstance(part, tuple):
        parts = tuple(fit_joints(x, n, f"{path}[{i}]") for i, x in enumerate(part))
        unchanged = all(a is b for a, b in zip(parts, part, strict=True))
        return part if unchanged else parts
    if not dataclasses.is_dataclass(part) or isinstance(part, type):
        return part
    new: dict[str, Any] = {}
    values = field_values(part)
    own_joints = statements_of(part).own_joints
    for field in dataclasses.fields(part):
        old = values[field.name]
        name = f"{path}.{field.name}"
        if not is_leaf_field(field):
            value = fit_joints(old, own_joints.get(field.name, n), name)
        elif field.metadata["shape"] == "joint" and old is not None:
            value = _fit_leaf(old, n, name)
        elif field.metadata["shape"] == "level" and old is not None:
            value = _fit_rows(old, n, name)
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


def _fit_rows(value: Any, n: int, name: str) -> Any:
    """A leaf of one row a level, with n entries a row."""
    if jnp.ndim(value) == 0:
        return value  # the same number for all levels and components
    if jnp.ndim(value) == 1:
        rows = jnp.shape(value)
        return jnp.broadcast_to(jnp.asarray(value)[..., None], (*rows, n))
    if jnp.shape(value)[1] != n:
        expected = f"rows of one number, or of {n} (one a component)"
        raise checks.fail(name, value, expected, f"Its shape is {jnp.shape(value)}.")
    return value


def check_leaves(part: Any, path: str = "") -> None:
    """Raises ValueError for the first concrete leaf that is not finite or has the wrong sign, with
    its path.
    """
    if modules.is_module(part):
        for keys, leaf in jax.tree_util.tree_leaves_with_path(part):
            if modules.is_float_array(leaf):
                checks.check_values(path + jax.tree_util.keystr(keys), leaf, None)
        return
    if isinstance(part, tuple):
        for i, x in enumerate(part):
            check_leaves(x, f"{path}[{i}]")
        return
    if not dataclasses.is_dataclass(part) or isinstance(part, type):
        return
    values = field_values(part)
    for field in dataclasses.fields(part):
        if field.metadata.get("static"):
            continue
        name = f"{path}.{field.name}".lstrip(".")
        value = values[field.name]
        if isinstance(value, NUMBERS):
            checks.check_values(name, value, field.metadata.get("sign"))
        else:
            check_leaves(value, name)


def canonical(scenario: Scenario) -> Scenario:
    """The scenario with every leaf an array of one floating-point type, checked; every entry point
    calls this first.

    Raises:
      ValueError: a leaf is not finite or has the wrong sign, a mass matrix is not positive
        definite, the start is outside its bounds or faster than VELOCITY_LIMIT; the message names
        the field, the value and the remedy.
    """
    if not isinstance(scenario, Scenario):
        raise checks.fail("scenario", scenario, "a Scenario", HOW_TO_MAKE)
    keep_programs()
    check_leaves(scenario)
    note_code(scenario)
    scenario = _with_sufficient_queue(scenario)
    dtype = _shared_dtype(scenario)
    scenario = jax.tree.map(lambda x: _typed(x, dtype), scenario)
    if not checks.is_concrete(scenario):
        return scenario
    _check_start(scenario)
    for law in layers(scenario.controller):
        law.check_start(scenario.context)
    for text in advice_of(scenario):
        notices.warn(text)
    return scenario


def _with_sufficient_queue(scenario: Scenario) -> Scenario:
    """The scenario with a queue that is long enough for its delay, which may have changed since the
    sampling was constructed.
    """
    sampling = scenario.sampling
    if sampling is None or not checks.is_concrete(sampling) or sampling.queue >= sampling.needed:
        return scenario
    sampling = dataclasses.replace(sampling, queue=sampling.needed)
    return dataclasses.replace(scenario, sampling=sampling)


def advice_of(scenario: Scenario) -> list[str]:
    """The warnings of the parts about their parameter values."""
    advice = scenario.controller.advice()
    if all(part.uses_observer for part in layers(scenario.controller)):
        advice = advice + scenario.observer.advice()
    advice = advice + motors_advice(scenario)
    if scenario.sampling is not None:
        advice = advice + scenario.sensor.advice(scenario.sampling.period)
        advice = advice + noise_advice(scenario)
    return advice


def motors_advice(scenario: Scenario) -> list[str]:
    """A warning about a robot as the model of a flexible joint whose inertia lacks that of the
    motors.
    """
    plant, model = scenario.plant, scenario.model
    if not isinstance(plant, plants.FlexibleJoint) or plants.is_chain(model):
        return []
    if isinstance(model, WithMotors):
        return []
    q = scenario.initial.q
    links, known = (np.diag(mass_matrix_at(robot, q)) for robot in (plant.robot, model))
    inertia = np.asarray(plant.motor_inertia)
    share = float(np.min((known - links) / inertia))
    if share > LEAST_SHARE_OF_MOTORS:
        return []
    return [
        f"model: the inertia of this robot contains {max(share, 0.0):.0%} of that of the motors"
        f" (plant.motor_inertia = {inertia} kg m^2), although a law of robots commands their"
        " torque. Take model=plant.rigid(), whose inertia is M + diag(J)."
    ]


LEAST_SHARE_OF_MOTORS = 0.5
"""Share of the inertia of a motor below which a model counts as one of the links alone.  A robot
may contain that inertia in other ways than `WithMotors`, such as the armature of an `Arm`."""


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
    types = set()
    for path, x in jax.tree_util.tree_leaves_with_path(scenario):
        if not isinstance(x, NUMBERS):
            name = jax.tree_util.keystr(path).lstrip(".")
            expected = "a component, numbers, or a module of arrays that JAX can take apart"
            raise checks.fail(name, x, expected, HOW_TO_HOLD)
        # `result_type` would not see the type of a weakly typed array.
        types.add(x.dtype if isinstance(x, jax.Array) else jnp.result_type(x))
    supported = {jnp.dtype("float32"), jnp.dtype("float64")}
    floats = {x for x in types if jnp.issubdtype(x, jnp.floating)}
    if len(floats) == 1 and floats <= supported:
        return floats.pop()
    if floats and not floats & supported:
        got = f"numbers of type {floats.pop()}"
        remedy = 'Use iblf_jax.astype(scenario, "float32").'
        raise checks.fail("scenario", got, "float32 or float64", remedy)
    return jnp.result_type(float)


HOW_TO_HOLD = (
    "Declare a function or a setting with iblf_jax.static(); register the class of an object with"
    " arrays with JAX (jax.tree_util.register_dataclass), or decorate it with iblf_jax.component."
)
"""The remedy for a field that JAX cannot take apart."""


def fitted_to_step(scenario: Scenario, dt: float) -> Scenario:
    """The scenario with a history of commands that is long enough for the delay of its input, for
    steps dt [s].

    Raises:
      ValueError: the sampling period is not a whole number of steps, or the delay of the input is
        shorter than a step.
    """
    check_step(scenario, dt)
    return with_history(scenario, dt)


def with_history(scenario: Scenario, dt: float) -> Scenario:
    """`fitted_to_step` without the check of the sampling period."""
    actuator = scenario.actuator.with_history(dt)
    if actuator is scenario.actuator:
        return scenario
    return dataclasses.replace(scenario, actuator=actuator)


def check_step(scenario: Scenario, dt: float) -> None:
    """Raises ValueError where the sampling period is not a whole number of steps dt [s]."""
    sampling = scenario.sampling
    if sampling is None or not checks.is_concrete(sampling):
        return
    period = float(sampling.period)
    steps = period / dt
    if round(steps) < 1 or abs(steps - round(steps)) > PERIOD_TOLERANCE * steps:
        fitting = period / max(math.ceil(steps - 1e-9), 1)
        expected = f"a whole number of steps in sampling.period = {period:g} s"
        raise checks.fail("dt", dt, expected, f"Take dt={fitting:.6g}.")


# --- checks of the start -------------------------------------------------------------------------


class _InitialValues(NamedTuple):
    """Reference, bounds and margins at t = 0."""

    q_d: Any
    lower: Any
    upper: Any
    speed_limits: Any
    """Lower and upper, (n,) each [rad/s]; None if there are none."""
    region_margins: Any


@programs.jit
def _initial_values(scenario: Scenario) -> _InitialValues:
    """The values at the start. Their shapes are checked while this is traced, once per
    structure.
    """
    n, q, dq = scenario.n, scenario.initial.q, scenario.initial.dq
    t, plant, model = jnp.zeros((), q.dtype), scenario.plant, scenario.model
    reference, (positions, velocities, *_) = scenario.reference, scenario.bounds
    q_d = _shaped("reference.position(t)", partial(reference.position, t), n)

    def limit(name: str, side: Side) -> jax.Array:
        return _shaped(name, partial(side.at, t, q_d), n)

    lower = limit("bounds[0].lower.at(t, q_d)", positions.lower)
    upper = limit("bounds[0].upper.at(t, q_d)", positions.upper)
    parts: dict[str, Any] = {"plant": plant, "model": model}
    for name, part in parts.items():
        robot = plants.robot_of(part)
        if plants.is_chain(part):
            x = start_levels(scenario)[: part.order]
            _check_shapes_of_plant(name, part, t, x)
        if robot is not None:
            _shaped(f"{name}.mass_matrix(q)", partial(robot.mass_matrix, q), n, n)
            _shaped(f"{name}.coriolis(q, v, u)", partial(robot.coriolis, q, dq, dq), n)
            _shaped(f"{name}.gravity(q)", partial(robot.gravity, q), n)
    disturbed = [part if (r := plants.robot_of(part)) is None else r for part in (plant, model)]
    torque = partial(scenario.disturbance.torque, t, q, dq, *disturbed)
    _shaped("disturbance.torque(t, q, dq, plant, model)", torque, n)
    speed_limits = None
    if velocities is not None and has_speed_limits(scenario):
        limit("bounds[1].lower.at(t, dq_d)", velocities.lower)
        limit("bounds[1].upper.at(t, dq_d)", velocities.upper)
        speed_limits = speed_limits_at(reference, velocities, t)
    margins = q[:0]
    if scenario.regions:
        margins = regions.margins(scenario.regions, plants.robot_of(plant), q)
    return _InitialValues(q_d, lower, upper, speed_limits, margins)


def _check_shapes_of_plant(name: str, plant: Plant, t: jax.Array, x: jax.Array) -> None:
    """Raises ValueError where drift or gain of a plant has another shape than its state."""
    order, n = x.shape
    _shaped(f"{name}.drift(t, x)", partial(plant.drift, t, x), order, n)
    diagonal = jnp.ndim(jax.eval_shape(plant.gain, t, x)) == 2
    shape = (order, n) if diagonal else (order, n, n)
    _shaped(f"{name}.gain(t, x)", partial(plant.gain, t, x), *shape)


def _shaped(name: str, call: Callable[[], jax.Array], *shape: int) -> jax.Array:
    """The value of `call()`, or a ValueError that names it if it raises or has another shape."""
    try:
        value = call()
    except Exception as error:
        got = f"{type(error).__name__}: {error}"
        raise checks.fail(name, got, f"an array of shape {shape}") from error
    if jnp.shape(value) != shape:
        remedy = f"The plant has {shape[0]} joints."
        raise checks.fail(name, f"shape {jnp.shape(value)}", f"shape {shape}", remedy)
    return value


def _check_start(scenario: Scenario) -> None:
    """Raises ValueError for a start outside its bounds or too fast, or a mass matrix there that is
    not positive definite.
    """
    start = jax.tree.map(np.asarray, _initial_values(scenario))
    q, dq = np.asarray(scenario.initial.q), np.asarray(scenario.initial.dq)
    finite = {"reference": start.q_d, "bounds[0].lower": start.lower}
    finite["bounds[0].upper"] = start.upper
    for name, values in finite.items():
        if not np.all(np.isfinite(values)):
            raise checks.fail(name, values, "finite values at t = 0")
    noun = plants.component_noun(scenario.plant)
    positions: Any = scenario.bounds[0]
    _check_order(f"bounds of {noun}", start.lower, start.upper, positions)
    remedy = _funnel_remedy(positions)
    remedy = remedy or "Move the reference or widen the bounds (Assumption 2)."
    _check_inside(
        f"reference of {noun} {{}}", "bounds", start.q_d, start.lower, start.upper, remedy
    )
    remedy = "Move the start or widen the bounds."
    _check_inside("initial.q[{}]", "bounds", q, start.lower, start.upper, remedy)
    if start.speed_limits is not None:
        slowest, fastest = start.speed_limits
        _check_order("bounds[1] of joint", slowest, fastest, scenario.bounds[1])
        _check_inside("initial.dq[{}]", "velocity bounds", dq, slowest, fastest, remedy)
    for region, margin in zip(scenario.regions, start.region_margins, strict=True):
        if not margin > 0:
            point = regions.in_words(region, plants.robot_of(scenario.plant))
            got = f"{point} {-margin:.4g} m beyond its boundary"
            expected = "a start inside all regions"
            raise checks.fail("initial.q", got, expected, "Move the start or the region.")
    _check_levels_at_start(scenario)
    limit = plants.speed_limit(scenario.plant)
    if not np.all(np.abs(dq) < limit):
        unit = as_text(plants.units_of(scenario.plant)[1])
        expected = f"speeds below {limit:g} {unit}"
        raise checks.fail("initial.dq", dq, expected, "A run that fast counts as diverged.")
    for name, part in (("plant", scenario.plant), ("model", scenario.model)):
        robot = plants.robot_of(part)
        if robot is None:
            continue
        matrix = np.asarray(mass_matrix_at(robot, scenario.initial.q))
        _check_mass_matrix(f"{name}.mass_matrix(initial.q)", matrix)


def _check_levels_at_start(scenario: Scenario) -> None:
    """Raises ValueError for a start outside the bounds of a level from the second on, or a gain
    that is singular there.
    """
    if not plants.is_chain(scenario.plant):
        return
    x = start_levels(scenario)
    t = jnp.zeros((), x.dtype)
    if not np.all(np.isfinite(x)):
        raise checks.fail("initial.x", x, "finite levels at the start")
    for i, bounds in enumerate(scenario.bounds[1:], start=1):
        if bounds is None:
            continue
        lower, upper = (np.asarray(side) for side in bounds_at(bounds, t, jnp.zeros_like(x[0])))
        if isinstance(bounds.lower, Funnel) or isinstance(bounds.upper, Funnel):
            continue  # around alpha, which the law computes
        noun = plants.component_noun(scenario.plant)
        _check_order(f"bounds[{i}] of {noun}", lower, upper, bounds)
        remedy = "Move the start or widen the bounds."
        if i == 1 and not np.any(x[1]):
            remedy = f"{remedy} {WITHOUT_DQ}"
        level = f"initial.x[{i}][{{}}]"
        _check_inside(level, f"bounds of level {i + 1}", np.asarray(x[i]), lower, upper, remedy)
    parts: dict[str, Any] = {"plant": scenario.plant, "model": scenario.model}
    for name, plant in parts.items():
        if plants.is_chain(plant):
            levels = x[: plant.order]
            _check_gains(name, np.asarray(plant.gain(t, levels)), np.asarray(levels))
            filtered = name == "model" and plant.needs_filters
            if not filtered and not isinstance(plant, plants.OF_KNOWN_STRUCTURE):
                plants.check_dependence(name, _dependence_near(plant, t, levels))


WITHOUT_DQ = "x_2 is 0 if Initial has no dq: Initial(x=...) takes all levels."
"""The remedy for a start of a plant whose second level may have been left out."""


@programs.jit
def _dependence_near(plant: Plant, t: jax.Array, x: jax.Array) -> Any:
    """The dependence of drift and gain on the levels at the start and at a state near it, where
    even functions of a level that starts at 0 have a slope.
    """
    nearby = x + 0.1 * (1.0 + jnp.abs(x))
    points = jnp.stack([x, nearby])
    return jax.vmap(partial(plants.dependence_on_levels, plant, t))(points)


def _check_gains(name: str, gains: np.ndarray, x: np.ndarray) -> None:
    """Raises ValueError for a gain of a level that is singular or not finite at the start x."""
    remedy = f"The start is x = {x.tolist()}, and every level must act on the level below it there."
    if not x[1].any():
        remedy += f" {WITHOUT_DQ}"
    for i, gain in enumerate(gains):
        matrix = np.diag(gain) if gain.ndim == 1 else gain
        expected = f"an invertible gain of level {i + 1} at the start"
        if not np.all(np.isfinite(matrix)) or np.linalg.matrix_rank(matrix) < len(matrix):
            raise checks.fail(f"{name}.gain(t, x)[{i}]", matrix, expected, remedy)


def _funnel_remedy(bounds: Any) -> str:
    """The remedy for a Funnel with the sign of the other side; empty if none has it."""
    lower, upper = bounds.lower, bounds.upper
    if isinstance(lower, Funnel) and np.any(np.asarray(lower.initial) > 0):
        return (
            "A Funnel is a signed distance from the reference: as a lower side it takes negative"
            " numbers, such as Funnel(-0.3, -0.1, 1.0)."
        )
    if isinstance(upper, Funnel) and np.any(np.asarray(upper.initial) < 0):
        return (
            "A Funnel is a signed distance from the reference: as an upper side it takes positive"
            " numbers, such as Funnel(0.3, 0.1, 1.0)."
        )
    return ""


def _check_order(name: str, lower: np.ndarray, upper: np.ndarray, bounds: Any) -> None:
    """Raises ValueError where a lower bound is not below its upper bound at t = 0."""
    remedy = _funnel_remedy(bounds) or "Exchange or widen them."
    for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
        if not low < high:
            expected = "finite lower < upper at t = 0"
            raise checks.fail(f"{name} {i}", (low, high), expected, remedy)


def _check_inside(
    name: str, bounds: str, values: np.ndarray, lower: np.ndarray, upper: np.ndarray, remedy: str
) -> None:
    """Raises ValueError for a value that is not between its bounds; `{}` in the name is replaced by
    the index of the joint.
    """
    for i, (value, low, high) in enumerate(zip(values, lower, upper, strict=True)):
        if not low < value < high:
            expected = f"a start inside the {bounds} ({low:.6g}, {high:.6g}) at t = 0"
            raise checks.fail(name.format(i), value, expected, remedy)


def _check_mass_matrix(name: str, matrix: np.ndarray) -> None:
    """Raises ValueError for a mass matrix that is not finite, symmetric and positive definite."""
    remedy = "Check the masses, lengths and inertias."
    is_finite = np.all(np.isfinite(matrix))
    if not is_finite or np.ptp(matrix - matrix.T) > 1e-4 * np.max(np.abs(matrix)):
        raise checks.fail(name, matrix, "a finite symmetric matrix", remedy)
    eigenvalues = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))
    if eigenvalues[0] <= len(matrix) * np.finfo(matrix.dtype).eps * eigenvalues[-1]:
        raise checks.fail(name, matrix, "a positive definite matrix", remedy)
