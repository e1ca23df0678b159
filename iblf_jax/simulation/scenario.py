"""A scenario: everything that defines a run except its duration and its time step.

The plant (the simulated robot) and the model (the robot that law and observer know) are separate
objects. By default the model is the plant; give `model`, or perturb leaves of `plant` only, to let
them differ.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators import Actuator
from iblf_jax.control.actuators import Ideal as IdealActuator
from iblf_jax.control.controllers import Law, LawContext, TrackingLaw
from iblf_jax.control.controllers._base import law_of_x
from iblf_jax.control.observers import DisturbanceObserver, NoObserver, Observer
from iblf_jax.control.observers.none import observer_of_x
from iblf_jax.control.sensors import AnySensor, Sensor
from iblf_jax.control.sensors import Ideal as IdealSensor
from iblf_jax.control.sensors._base import sensor_of_x
from iblf_jax.core import checks, modules, notices
from iblf_jax.core.disk_cache import keep_programs
from iblf_jax.core.families import is_default, statements_of
from iblf_jax.core.modules import NUMBERS
from iblf_jax.core.presentation import present
from iblf_jax.core.pytree import (
    astype,
    component,
    field_values,
    is_leaf_field,
    layers,
    note_code,
    rewrapped,
    unwrapped,
)
from iblf_jax.core.time import joined, jump_times_of
from iblf_jax.simulation import scenario_rules as rules
from iblf_jax.simulation.advice import advice_of
from iblf_jax.simulation.initial import Initial
from iblf_jax.simulation.levels import start_levels
from iblf_jax.simulation.sampling import PERIOD_TOLERANCE, Sampling
from iblf_jax.world import plants, regions
from iblf_jax.world.bounds import Bounds
from iblf_jax.world.disturbances import Disturbance, Nothing
from iblf_jax.world.plants import Plant
from iblf_jax.world.process_noise import ProcessNoise
from iblf_jax.world.references import Reference
from iblf_jax.world.robots import Robot

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
        rules.check_parts(self)
        self._fit_bounds()
        rules.check_combination(self)
        object.__setattr__(self, "regions", tuple(self.regions))
        rules.check_regions(self)
        noise, order = self.process_noise, plants.order_of(self.plant)
        if noise is not None:
            rules.check_process_noise(noise, order)
            rules.check_diffusion(fit_joints(noise, self.n, "process_noise"), order, self.n)
        rules.check_modes(self.plant)
        for name, part in field_values(self).items():
            object.__setattr__(self, name, fit_joints(part, self.plant.n, name))
        # The law gets what it derives from its model and the start, such as weights.
        law = unwrapped(self.controller)
        if is_default(law.with_defaults, TrackingLaw.with_defaults):
            return
        with jax.ensure_compile_time_eval():
            new = law.with_defaults(self.context, start_levels(self)[: self.loop.model.order])
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
        plants.check_part("Scenario.plant", parts["plant"])
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
    rules.check_leaves(scenario)
    note_code(scenario)
    sampling = scenario.sampling
    if sampling is not None and checks.is_concrete(sampling) and sampling.queue < sampling.needed:
        # The delay may have changed since the sampling was constructed.
        sampling = dataclasses.replace(sampling, queue=sampling.needed)
        scenario = dataclasses.replace(scenario, sampling=sampling)
    dtype = _shared_dtype(scenario)
    scenario = jax.tree.map(lambda x: _typed(x, dtype), scenario)
    if not checks.is_concrete(scenario):
        return scenario
    rules.check_start(scenario)
    for law in layers(scenario.controller):
        law.check_start(scenario.context)
    for text in advice_of(scenario):
        notices.warn(text)
    return scenario


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
