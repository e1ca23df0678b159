"""The checks of a scenario: tables of rules about its parts, and about its values at the start.

The order of a table is the order of the checks.  A check that calls a user's code stays a function
where its message quotes the error, which is then its cause; one that the part itself makes stays a
method of the part.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators import Actuator
from iblf_jax.control.controllers import TrackingLaw
from iblf_jax.control.controllers._base import check_law
from iblf_jax.control.observers import NoObserver, Observer
from iblf_jax.control.observers import _base as observers
from iblf_jax.control.observers.none import observer_of_x
from iblf_jax.control.sensors import Ideal as IdealSensor
from iblf_jax.control.sensors import _base as sensors
from iblf_jax.control.sensors._base import sensor_of_x
from iblf_jax.core import checks, modules, programs
from iblf_jax.core.families import is_default
from iblf_jax.core.modules import NUMBERS
from iblf_jax.core.pytree import field_values, layers, unwrapped
from iblf_jax.core.units import as_text, of_component
from iblf_jax.simulation.initial import Initial
from iblf_jax.simulation.levels import disturbance_torque, has_speed_limits, start_levels
from iblf_jax.simulation.sampling import Sampling
from iblf_jax.world import plants, process_noise, regions
from iblf_jax.world.bounds import Bounds, Funnel, Side, bounds_at, speed_limits_at
from iblf_jax.world.disturbances import Disturbance
from iblf_jax.world.plants import Plant
from iblf_jax.world.process_noise import ProcessNoise
from iblf_jax.world.references import Reference
from iblf_jax.world.robots import Robot
from iblf_jax.world.robots._base import mass_matrix_at, warn_of_degrees

if TYPE_CHECKING:
    from iblf_jax.simulation.scenario import Scenario

T = TypeVar("T")


class Rule(NamedTuple):
    """What must hold.  The texts name facts as `{s.name}`, and words of a `Found` as `{name}`."""

    field: str
    broken: Callable[[Any], Any]
    """facts -> None where the rule holds, else the value that the message quotes, or a `Found`."""
    expected: str
    remedy: str = ""


class Found(NamedTuple):
    """A value that breaks a rule, with words for the texts of the rule."""

    got: Any
    words: Mapping[str, Any]


def check(rules: Iterable[Rule], facts: Any) -> None:
    """Raises ValueError for the first rule that the facts break."""
    for rule in rules:
        found = rule.broken(facts)
        if found is None:
            continue
        got, words = found if isinstance(found, Found) else (found, {})
        texts = (rule.field, rule.expected, rule.remedy)
        field, expected, remedy = (text.format(s=facts, **words) for text in texts)
        raise checks.fail(field, got, expected, remedy)


def unless(holds: bool, got: T) -> T | checks.Words | None:
    """What `Rule.broken` returns: None where the rule holds, else the value that came."""
    if holds:
        return None
    return checks.Words(None) if got is None else got


# --- each part ------------------------------------------------------------------------------------

LAWS = "iblf_jax.controllers has them; iblf_jax.testing.check_law checks your own."
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
CLASSES = (
    Rule(
        "Scenario.initial",
        lambda s: unless(isinstance(s.initial, Initial), s.initial),
        "an Initial, such as Initial(q=[0.8, 0.8])",
    ),
    Rule(
        "Scenario.bounds",
        lambda s: unless(isinstance(s.bounds, Bounds | tuple | list), s.bounds),
        "a Bounds, such as Bounds(lower=Constant(0.1), upper=Constant(0.9)), or a tuple of one for"
        " each level",
    ),
    Rule(
        "Scenario.sampling",
        lambda s: unless(isinstance(s.sampling, Sampling | None), s.sampling),
        "a Sampling, or None, such as ij.Sampling(period=2e-3)",
    ),
    Rule(
        "Scenario.regions",
        lambda s: unless(isinstance(s.regions, tuple | list), s.regions),
        "a tuple of regions, such as (ij.regions.HalfSpace(normal=[0, 1], offset=0.1),)",
    ),
)


def check_parts(scenario: Scenario) -> None:
    """Raises ValueError for a part of the wrong kind; adopts the classes of the others."""
    for name in ("plant", "model"):
        plants.check_part(f"Scenario.{name}", vars(scenario)[name])
    check_law("Scenario.controller", scenario.controller, LAWS)
    parts = field_values(scenario)
    for name, (contract, remedy) in CONTRACTS.items():
        base = contract if isinstance(contract, type) else contract(parts[name])
        checks.conforms(f"Scenario.{name}", parts[name], base, remedy)
    check(CLASSES, scenario)


# --- the combination of parts ---------------------------------------------------------------------


class Combination(NamedTuple):
    """The parts of a scenario as the rules about their combination read them."""

    scenario: Scenario
    plant: Plant
    """As the closed loop runs it, like the model."""
    model: Plant
    law: TrackingLaw
    """The innermost one."""
    law_kind: str
    model_kind: str
    levels: int | None
    """Number of levels at the start, where all are given."""


def _other_components(s: Combination) -> Found | None:
    if s.model.n == s.plant.n:
        return None
    got, expected = (plants.counted_components(s.plant, x.n) for x in (s.model, s.plant))
    return Found(got, {"components": expected})


def _law_without_robot(s: Combination) -> Found | None:
    if s.model.is_robot:
        return None
    others = "" if s.model.robot is None else ", or model=plant.robot"
    for law in layers(s.scenario.controller):
        if law.needs_robot:
            return Found(s.model_kind, {"kind": type(law).__name__, "others": others})
    return None


def _wrapped_drive(s: Combination) -> Found | None:
    outermost, *wrapped = layers(s.scenario.controller)
    for law in wrapped:
        if law.input_unit is not None:
            words = {"kind": type(law).__name__, "outermost": type(outermost).__name__}
            return Found(type(outermost).__name__, words)
    return None


def _other_centre(s: Combination) -> checks.Words | None:
    bounds = s.scenario.bounds[1]
    if bounds is None or s.model.reference_levels == s.plant.reference_levels:
        return None
    follows = isinstance(bounds.lower, Funnel) or isinstance(bounds.upper, Funnel)
    return checks.Words("a Funnel") if follows else None


UNKNOWN_UNIT = "1"
"""Unit of the levels and of the input of a plant that states none."""


def _other_input(s: Combination) -> Found | None:
    law, needed = s.scenario.controller, plants.units_of(s.plant)[-1]
    given = law.input_unit or plants.units_of(s.model)[-1]
    if given == needed or UNKNOWN_UNIT in (given, needed):
        return None
    words = {"kind": type(s.scenario.plant).__name__, "unit": needed}
    return Found(f"{type(law).__name__}, which commands [{given}]", words)


COMBINATION = (
    Rule("Scenario.model", _other_components, "{components}, as the plant has"),
    Rule(
        "Scenario.bounds[1]",
        lambda s: unless(s.scenario.bounds[1] is not None or not s.law.needs_velocity_bounds, None),
        "the bounds that {s.law_kind} keeps",
        "Such as bounds=(positions, Bounds(lower=Constant(-1.0), upper=Constant(1.0))).",
    ),
    Rule(
        "Scenario.sensor",
        lambda s: unless(
            s.scenario.sampling is not None or isinstance(s.scenario.sensor, IdealSensor),
            type(s.scenario.sensor).__name__,
        ),
        "an Ideal sensor where no law is sampled",
        "Add sampling=ij.Sampling(period=...): a sensor is read once a period.",
    ),
    Rule(
        "Scenario.actuator",
        lambda s: unless(
            s.scenario.sampling is None or s.scenario.actuator.input_delay is None,
            s.scenario.actuator,
        ),
        "no Delay where the law is sampled",
        "Give ij.Sampling(period=..., delay=...) instead.",
    ),
    Rule(
        "Scenario.model",
        lambda s: unless(s.model.order in (s.plant.order, 2), f"a plant of order {s.model.order}"),
        "a robot, or a plant of order {s.plant.order}, as the plant is",
    ),
    Rule(
        "Scenario.model",
        _law_without_robot,
        "a robot as the model of the law {kind}",
        "Take controllers.BarrierBackstepping{others}.",
    ),
    Rule(
        "Scenario.bounds[1]",
        _other_centre,
        "no Funnel: it follows q_d' for a robot and alpha_1 for another plant, and only one of"
        " plant and model is a robot",
        "Take the plant as the model, or other bounds, such as Constant.",
    ),
    Rule(
        "Scenario.controller",
        _wrapped_drive,
        "{kind} as the outermost law",
        "Such as {kind}(law={outermost}(...), ...).",
    ),
    Rule(
        "Scenario.controller",
        lambda s: _other_input(s) if isinstance(s.scenario.plant, plants.ElectricDrive) else None,
        "a law that commands the input of {kind} [{unit}]",
        "Such as controllers.WithDrive(law, drive=plant), or model=plant.",
    ),
    Rule(
        "Scenario.controller",
        _other_input,
        "a law that commands the input of {kind} [{unit}]",
        "Take the plant as the model, with controllers.BarrierBackstepping.",
    ),
)


def _torque_observer(s: Combination) -> str | None:
    observer = s.scenario.observer
    if isinstance(observer, NoObserver | Observer):
        return None
    has_torque = not is_default(s.model.joint_torque, Plant.joint_torque)
    return unless(has_torque, type(observer).__name__)


def _sensor_of_other_levels(s: Combination) -> str | None:
    count = sensor_of_x(s.scenario.sensor).order
    return unless(count in (None, s.plant.order), f"sensors of {count} levels")


def _unmeasured_levels(s: Combination) -> Found | None:
    sensor, observer = sensor_of_x(s.scenario.sensor), observer_of_x(s.scenario.observer)
    every = tuple(range(1, s.model.order + 1))
    measured = sensor.measured or every
    needed = observer.measured if observer.completes else None
    missing = [str(level) for level in needed or every if level not in measured]
    if not missing:
        return None
    which = ", ".join(missing)
    expected = "every level of the model measured, or estimated by an observer"
    if needed:
        expected = f"level {which} measured, which {type(s.scenario.observer).__name__} reads"
    levels = tuple(level for level in every if level in measured)
    remedy = f"Such as observers.StateObserver(bandwidth=..., measured={levels})."
    if 1 not in levels:
        remedy = "The levels below a measured one do not follow from it: measure level 1."
    return Found(f"no measurement of level {which}", {"expected": expected, "remedy": remedy})


LEVELS = (
    Rule(
        "Scenario.observer",
        _torque_observer,
        "an observer of plants in strict-feedback form, such as LevelObserver",
        "{s.model_kind} contains no robot.",
    ),
    Rule(
        "Scenario.sensor",
        _sensor_of_other_levels,
        "sensors of {s.plant.order} levels, as the plant has",
        "None is for a level that is not measured.",
    ),
    Rule("Scenario.sensor", _unmeasured_levels, "{expected}", "{remedy}"),
    Rule(
        "Scenario.initial.x",
        lambda s: unless(s.levels in (None, s.plant.order), f"{s.levels} levels"),
        "{s.plant.order} levels, as the plant has",
    ),
    Rule(
        "Scenario.initial",
        lambda s: unless(
            s.plant.order == 2 or s.levels is not None or plants.has_steady_levels(s.plant),
            "q and dq",
        ),
        "{s.plant.order} levels",
        "Give all levels: Initial(x=...), shape ({s.plant.order}, {s.plant.n}).",
    ),
)


def check_combination(scenario: Scenario) -> None:
    """Raises ValueError for parts that do not fit together."""
    plant = model = plants.as_plant(scenario.plant)
    if scenario.model is not scenario.plant:
        model = plants.as_plant(scenario.model)
    law, higher = unwrapped(scenario.controller), scenario.initial.higher
    levels = None if higher is None else 2 + len(higher)
    kinds = type(law).__name__, type(scenario.model).__name__
    facts = Combination(scenario, plant, model, law, *kinds, levels)
    check(COMBINATION, facts)
    if isinstance(scenario.observer, Observer):
        scenario.observer.check_model(model)
    check(LEVELS, facts)


# --- regions, noise and modes ---------------------------------------------------------------------


def check_regions(scenario: Scenario) -> None:
    """Raises ValueError for a region that is none, or that does not fit plant and model."""
    if not scenario.regions:
        return
    plant, model, *_ = scenario.loop
    for i, region in enumerate(scenario.regions):
        name = f"Scenario.regions[{i}]"
        checks.conforms(name, region, regions.Region, "iblf_jax.regions has them.")
        for robot in (plant.robot, model.robot):
            if robot is None:
                expected = "no regions, as this plant has no points in space"
                raise checks.fail(name, region, expected, "Use bounds.")
            _check_region(name, region, robot)


def _check_region(name: str, region: regions.Region, robot: Robot) -> None:
    """Raises ValueError for a region whose point a robot does not have."""

    def distance() -> jax.Array:
        return region.distance(regions.position_of(robot, region.point, jnp.zeros(robot.n)))

    try:
        jax.eval_shape(distance)
    except Exception as error:
        kind = checks.with_article(type(robot).__name__)
        expected = f"a region for a point of {kind} of {robot.n} joints"
        reason = f"{type(error).__name__}: {checks.one_line(str(error))}"
        raise checks.fail(name, region, expected, reason) from error


def check_process_noise(noise: ProcessNoise, order: int) -> None:
    """Raises ValueError for something that is no process noise, or is of levels that a plant of
    this order does not have.
    """
    name = "Scenario.process_noise"
    checks.conforms(name, noise, ProcessNoise, "iblf_jax.process_noise has them.")
    process_noise.check_structure(noise)
    if noise.levels[-1] > order:
        expected = f"levels up to {order}, as the plant has"
        raise checks.fail(f"{name}.levels", noise.levels, expected)


def check_diffusion(noise: ProcessNoise, order: int, n: int) -> None:
    """Raises ValueError for process noise without one row for each of its levels."""
    name = "Scenario.process_noise.diffusion(t, x)"
    t, x = jnp.zeros(()), jnp.zeros((order, n))
    shape = (len(noise.levels), n)
    try:
        found = jax.eval_shape(noise.diffusion, t, x).shape
    except Exception as error:
        got = f"{type(error).__name__}: {checks.one_line(str(error))}"
        raise checks.fail(name, got, f"shape {shape}") from error
    if found != shape:
        remedy = "One row for each of its levels."
        raise checks.fail(name, f"shape {found}", f"shape {shape}", remedy)


def check_modes(plant: Any) -> None:
    """Raises ValueError for a part of the plant whose modes are a Markov chain: only the plant
    itself can be.
    """

    def draws_modes(part: Any) -> bool:
        return isinstance(part, plants.MarkovSwitched) and part is not plant

    if any(draws_modes(part) for part in jax.tree.leaves(plant, is_leaf=draws_modes)):
        expected = "MarkovSwitched as the plant itself"
        remedy = "Such as MarkovSwitched(plant=FlexibleJoint(...), ...)."
        raise checks.fail("Scenario.plant", type(plant).__name__, expected, remedy)


# --- numbers --------------------------------------------------------------------------------------


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


# --- values at the start --------------------------------------------------------------------------


class InitialValues(NamedTuple):
    """Start, reference, bounds and margins at t = 0."""

    q: jax.Array
    dq: jax.Array
    q_d: jax.Array
    limits: tuple[jax.Array, jax.Array]
    """Lower and upper bounds of the first level, (n,) each."""
    speed_limits: tuple[jax.Array, jax.Array] | None
    """Of the velocities of a robot, (n,) each [rad/s]; None if there are none."""
    region_margins: jax.Array


@programs.jit(kept=True)
def _initial_values(scenario: Scenario) -> InitialValues:
    """The values at the start. Their shapes are checked while this is traced, once per
    structure.
    """
    n, q, dq = scenario.n, scenario.initial.q, scenario.initial.dq
    t, (plant, model, *_) = jnp.zeros((), q.dtype), scenario.loop
    reference, (positions, velocities, *_) = scenario.reference, scenario.bounds
    q_d = _shaped("reference.position(t)", partial(reference.position, t), n)

    def limit(name: str, side: Side) -> jax.Array:
        return _shaped(name, partial(side.at, t, q_d), n)

    lower = limit("bounds[0].lower.at(t, q_d)", positions.lower)
    upper = limit("bounds[0].upper.at(t, q_d)", positions.upper)
    for name, part in (("plant", plant), ("model", model)):
        if not part.is_robot:
            x = start_levels(scenario)[: part.order]
            shape = x.shape
            words = f"{len(x)} levels of {plants.counted_components(part, shape[1])}"
            remedy = f"The {name} has {words}."
            _shaped(f"{name}.drift(t, x)", partial(part.drift, t, x), *shape, remedy=remedy)
            if jnp.ndim(jax.eval_shape(part.gain, t, x)) != 2:
                shape = (*shape, shape[1])
            _shaped(f"{name}.gain(t, x)", partial(part.gain, t, x), *shape, remedy=remedy)
        if part.robot is not None:
            _shaped(f"{name}.mass_matrix(q)", partial(part.robot.mass_matrix, q), n, n)
            _shaped(f"{name}.coriolis(q, v, u)", partial(part.robot.coriolis, q, dq, dq), n)
            _shaped(f"{name}.gravity(q)", partial(part.robot.gravity, q), n)
    torque = partial(disturbance_torque, scenario, t, q, dq)
    _shaped("disturbance.torque(t, q, dq, plant, model)", torque, n)
    speed_limits = None
    if velocities is not None and has_speed_limits(scenario):
        limit("bounds[1].lower.at(t, dq_d)", velocities.lower)
        limit("bounds[1].upper.at(t, dq_d)", velocities.upper)
        speed_limits = speed_limits_at(reference, velocities, t)
    margins = q[:0]
    if scenario.regions and plant.robot is not None:
        margins = regions.margins(scenario.regions, plant.robot, q)
    return InitialValues(q, dq, q_d, (lower, upper), speed_limits, margins)


def _shaped(name: str, call: Callable[[], jax.Array], *shape: int, remedy: str = "") -> jax.Array:
    """The value of `call()`, or a ValueError that names it if it raises or has another shape."""
    try:
        value = call()
    except Exception as error:
        got = f"{type(error).__name__}: {error}"
        raise checks.fail(name, got, f"an array of shape {shape}") from error
    if jnp.shape(value) != shape:
        remedy = remedy or f"The plant has {shape[0]} joints."
        raise checks.fail(name, f"shape {jnp.shape(value)}", f"shape {shape}", remedy)
    return value


FINITE = "finite values at t = 0"
ORDERED = "finite lower < upper at t = 0"
INSIDE = "a start inside the {bounds} {interval} at t = 0"
MOVE_START = "Move the start or widen the bounds."
WITHOUT_DQ = "x_2 is 0 if Initial has no dq: Initial(x=...) takes all levels."
"""The remedy for a start of a plant whose second level may have been left out."""


def _funnel_remedy(bounds: Bounds) -> str:
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


class Start(NamedTuple):
    """What the rules about the start read."""

    scenario: Scenario
    components: tuple[str, ...]
    """The components of a level in words."""
    at: InitialValues
    """On the host."""


def _infinite(values: jax.Array) -> jax.Array | None:
    return None if np.all(np.isfinite(values)) else values


Limits = tuple[jax.Array, jax.Array] | None
"""Lower and upper bounds, (n,) each; None without."""


def _crossed(s: Start | BoundedLevel, bounds: Bounds | None, limits: Limits) -> Found | None:
    """The first component whose lower bound is not below its upper bound."""
    if bounds is None or limits is None:
        return None
    for i, (low, high) in enumerate(zip(*limits, strict=True)):
        if not low < high:
            remedy = _funnel_remedy(bounds) or "Exchange or widen them."
            return Found(np.array([low, high]), {"component": s.components[i], "remedy": remedy})
    return None


def _outside(
    s: Start | BoundedLevel, values: jax.Array, limits: Limits, bounds: str = "bounds"
) -> Found | None:
    """The first component that is not between its bounds."""
    if limits is None:
        return None
    for i, (value, low, high) in enumerate(zip(values, *limits, strict=True)):
        if not low < value < high:
            interval = f"({low:.6g}, {high:.6g})"
            component = s.components[i]
            entry = component.removeprefix("joint ").removeprefix("component ")
            words = {"entry": entry, "bounds": bounds, "interval": interval, "component": component}
            return Found(value, words)
    return None


def _reference_outside(s: Start) -> Found | None:
    found = _outside(s, s.at.q_d, s.at.limits)
    if found is None:
        return None
    remedy = _funnel_remedy(s.scenario.bounds[0])
    remedy = remedy or "Move the reference or widen the bounds (Assumption 2)."
    return Found(found.got, {**found.words, "remedy": remedy})


def _outside_region(s: Start) -> str | None:
    robot: Any = s.scenario.loop.plant.robot
    for region, margin in zip(s.scenario.regions, s.at.region_margins, strict=True):
        if not margin > 0:
            return f"{regions.in_words(region, robot)} {-margin:.4g} m beyond its boundary"
    return None


START = (
    Rule("reference", lambda s: _infinite(s.at.q_d), FINITE),
    Rule("bounds[0].lower", lambda s: _infinite(s.at.limits[0]), FINITE),
    Rule("bounds[0].upper", lambda s: _infinite(s.at.limits[1]), FINITE),
    Rule(
        "bounds of {component}",
        lambda s: _crossed(s, s.scenario.bounds[0], s.at.limits),
        ORDERED,
        "{remedy}",
    ),
    Rule("reference of {component}", _reference_outside, INSIDE, "{remedy}"),
    Rule("initial.q[{entry}]", lambda s: _outside(s, s.at.q, s.at.limits), INSIDE, MOVE_START),
    Rule(
        "bounds[1] of {component}",
        lambda s: _crossed(s, s.scenario.bounds[1], s.at.speed_limits),
        ORDERED,
        "{remedy}",
    ),
    Rule(
        "initial.dq[{entry}]",
        lambda s: _outside(s, s.at.dq, s.at.speed_limits, "velocity bounds"),
        INSIDE,
        MOVE_START,
    ),
    Rule(
        "initial.q", _outside_region, "a start inside all regions", "Move the start or the region."
    ),
)


class BoundedLevel(NamedTuple):
    """A level of a plant at the start, from the second one on, with its bounds."""

    level_index: int
    """From 0, as in a path."""
    components: tuple[str, ...]
    x: jax.Array
    bounds: Bounds
    limits: Limits
    without_dq: str


BOUNDED_LEVEL = (
    Rule(
        "bounds[{s.level_index}] of {component}",
        lambda s: _crossed(s, s.bounds, s.limits),
        ORDERED,
        "{remedy}",
    ),
    Rule(
        "initial.x[{s.level_index}][{entry}]",
        lambda s: _outside(s, s.x, s.limits, f"bounds of level {s.level_index + 1}"),
        INSIDE,
        MOVE_START + "{s.without_dq}",
    ),
)


def _check_levels(scenario: Scenario) -> None:
    """Raises ValueError for a start outside the bounds of a level from the second on, or a gain
    that is singular there.
    """
    state = start_levels(scenario)
    x, t = np.asarray(state), jnp.zeros((), state.dtype)
    without_dq = "" if x[1].any() else f" {WITHOUT_DQ}"
    if not np.all(np.isfinite(x)):
        raise checks.fail("initial.x", x, "finite levels at the start")
    components = plants.components_in_words(scenario.plant)
    for i, bounds in enumerate(scenario.bounds[1:], start=1):
        if bounds is None or isinstance(bounds.lower, Funnel) or isinstance(bounds.upper, Funnel):
            continue  # a funnel is around alpha, which the law computes
        limits = jax.tree.map(np.asarray, bounds_at(bounds, t, jnp.zeros_like(state[0])))
        remedy = without_dq if i == 1 else ""
        check(BOUNDED_LEVEL, BoundedLevel(i, components, x[i], bounds, limits, remedy))
    plant, model, *_ = scenario.loop
    for name, part in (("plant", plant), ("model", model)):
        if part.is_robot:
            continue
        levels = state[: part.order]
        _check_gains(name, np.asarray(part.gain(t, levels)), levels, without_dq)
        if not part.known_structure and not (name == "model" and part.needs_filters):
            plants.check_dependence(name, _dependence_near(part, t, levels))


@programs.jit(kept=True)
def _dependence_near(plant: Plant, t: jax.Array, x: jax.Array) -> plants.Dependence:
    """The dependence of drift and gain on the levels at the start and at a state near it, where
    even functions of a level that starts at 0 have a slope.
    """
    nearby = x + 0.1 * (1.0 + jnp.abs(x))
    points = jnp.stack([x, nearby])
    return jax.vmap(partial(plants.dependence_on_levels, plant, t))(points)


def _check_gains(name: str, gains: np.ndarray, x: jax.Array, without_dq: str) -> None:
    """Raises ValueError for a gain of a level that is singular or not finite at the start x."""
    remedy = f"The start is x = {x.tolist()}, and every level must act on the level below it there."
    for i, gain in enumerate(gains):
        matrix = np.diag(gain) if gain.ndim == 1 else gain
        expected = f"an invertible gain of level {i + 1} at the start"
        if not np.all(np.isfinite(matrix)) or np.linalg.matrix_rank(matrix) < len(matrix):
            raise checks.fail(f"{name}.gain(t, x)[{i}]", matrix, expected, remedy + without_dq)


def _warn_of_degrees(plant: Plant, limits: tuple[np.ndarray, np.ndarray]) -> None:
    """Warns of bounds of angles that seem to be degrees."""
    unit, robot = plants.units_of(plant)[0], plant.robot
    kinds = None if robot is None else robot.kinds
    turns = np.array(
        [
            of_component(unit, i) == "rad" and (kinds is None or kinds[i] == "revolute")
            for i in range(plant.n)
        ]
    )
    lower, upper = (np.where(turns, limit, np.inf) for limit in limits)
    warn_of_degrees(plants.components_in_words(plant), lower, upper)


def check_start(scenario: Scenario) -> None:
    """Raises ValueError for a start outside its bounds or too fast, or a mass matrix there that is
    not positive definite; warns of bounds that seem to be degrees.
    """
    at = jax.tree.map(np.asarray, _initial_values(scenario))
    plant, model, *_ = scenario.loop
    _warn_of_degrees(plant, at.limits)
    check(START, Start(scenario, plants.components_in_words(plant), at))
    if not plant.is_robot:
        _check_levels(scenario)
    limit = plants.speed_limit(plant)
    if not np.all(np.abs(at.dq) < limit):
        expected = f"speeds below {limit:g} {as_text(plants.units_of(plant)[1])}"
        raise checks.fail("initial.dq", at.dq, expected, "A run that fast counts as diverged.")
    for name, part in (("plant", plant), ("model", model)):
        if part.robot is None:
            continue
        matrix = np.asarray(mass_matrix_at(part.robot, scenario.initial.q))
        label = f"{name}.mass_matrix(initial.q)"
        remedy = "Check the masses, lengths and inertias."
        is_finite = np.all(np.isfinite(matrix))
        if not is_finite or np.ptp(matrix - matrix.T) > 1e-4 * np.max(np.abs(matrix)):
            raise checks.fail(label, matrix, "a finite symmetric matrix", remedy)
        eigenvalues = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))
        if eigenvalues[0] <= len(matrix) * np.finfo(matrix.dtype).eps * eigenvalues[-1]:
            raise checks.fail(label, matrix, "a positive definite matrix", remedy)
