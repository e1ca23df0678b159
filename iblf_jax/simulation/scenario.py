"""A scenario: everything that defines a run except its length and its step.

The plant (the truth) and the model (what law and observer know) are apart.  By default they are the
same robot; give `model` to let them differ, or perturb leaves of `plant` alone.
"""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

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
from iblf_jax.core.cache import keep_programs
from iblf_jax.core.presentation import present
from iblf_jax.core.pytree import Leaf, astype, component, is_leaf_field, layers, leaf, unwrapped
from iblf_jax.core.status import VELOCITY_LIMIT
from iblf_jax.core.time import joined, jump_times_of
from iblf_jax.simulation.sampling import Sampling, with_sufficient_queue
from iblf_jax.world import regions
from iblf_jax.world.bounds import Bounds, speed_limits_at, tube_at
from iblf_jax.world.disturbances import Disturbance, Nothing
from iblf_jax.world.references import Reference
from iblf_jax.world.robots import Robot
from iblf_jax.world.robots._base import mass_matrix_at


@component
class Initial:
    """Where a run starts.

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
"""Field, protocol, remedy and what may be missing, for each part of a scenario that may be a user's
own."""

OF_VELOCITY = {
    "units": dict.fromkeys(("value", "offset", "amplitude", "initial", "final"), "rad/s")
}
"""What bounds are measured in where they bound velocities: leaf -> unit."""


@component
class Scenario:
    """Plant, model, reference, bounds, disturbance, law, observer and start of a run; and how the
    law is sampled, told and driven.

    Leaves that hold one number a joint may be given as a scalar; they are repeated for the plant's
    n joints.

    Args:
      plant: the robot that moves, any of `iblf_jax.robots`.
      reference: what it should follow, any of `iblf_jax.references`.
      bounds: what its joints must keep, a `bounds.Bounds`.
      controller: the law, any of `iblf_jax.controllers`.
      initial: where it starts, an `Initial`.
      observer: what estimates f, any of `iblf_jax.observers`; `NoObserver()` if not given.
      disturbance: what acts on the plant and the law does not know, any of `iblf_jax.disturbances`;
        `Nothing()` if not given.
      model: the robot that law and observer know; the plant itself if not given.
      sampling: when law and observer run, a `Sampling`; at every instant if not given.
      sensor: what they are told of q and q', any of `iblf_jax.sensors`; `Ideal()` if not given.
        Others need a sampling.
      actuator: what becomes of the torque, any of `iblf_jax.actuators`; `Ideal()` if not given.
      velocity_bounds: what the joints' velocities must keep, a `bounds.Bounds` [rad/s] whose
        funnels follow q_d'; none if not given. They are watched whatever the law;
        `controllers.FullState` keeps them.
      regions: where points of the robot must stay, a tuple of any of `iblf_jax.regions`; () if not
        given.  They are watched whatever the law; `controllers.SafetyFilter` keeps them.

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
        """Completes the model, checks what the parts are, and gives every joint-wise leaf its n
        entries.
        """
        if self.model is None:
            object.__setattr__(self, "model", self.plant)
        for name, protocol, remedy, optional in PARTS:
            checks.conforms(f"Scenario.{name}", getattr(self, name), protocol, remedy, optional)
        if not isinstance(self.initial, Initial):
            raise checks.fail(
                "Scenario.initial", self.initial, "an Initial", "Such as Initial(q=[0.8, 0.8])."
            )
        if not isinstance(self.bounds, Bounds):
            raise checks.fail(
                "Scenario.bounds",
                self.bounds,
                "a Bounds",
                "Such as Bounds(lower=Constant(0.1), upper=Constant(0.9)).",
            )
        if not isinstance(self.velocity_bounds, Bounds | None):
            remedy = "Such as Bounds(lower=Constant(-1.0), upper=Constant(1.0)), in rad/s."
            raise checks.fail(
                "Scenario.velocity_bounds", self.velocity_bounds, "a Bounds, or None", remedy
            )
        law = unwrapped(self.controller)
        if self.velocity_bounds is None and getattr(law, "needs_velocity_bounds", False):
            remedy = "Such as velocity_bounds=Bounds(lower=Constant(-1.0), upper=Constant(1.0))."
            raise checks.fail(
                "Scenario.velocity_bounds",
                None,
                f"the bounds that {type(law).__name__} keeps",
                remedy,
            )
        if not isinstance(self.sampling, Sampling | None):
            raise checks.fail(
                "Scenario.sampling",
                self.sampling,
                "a Sampling, or None",
                "Such as ij.Sampling(period=2e-3).",
            )
        if self.sampling is None and not isinstance(self.sensor, IdealSensor):
            remedy = "Add sampling=ij.Sampling(period=...): a sensor is read once a period."
            raise checks.fail(
                "Scenario.sensor",
                type(self.sensor).__name__,
                "an Ideal sensor where no law is sampled",
                remedy,
            )
        if self.model.n != self.plant.n:
            raise checks.fail(
                "Scenario.model",
                f"{self.model.n} joints",
                f"{self.plant.n} joints, as the plant has",
            )
        self._check_regions()
        for field in dataclasses.fields(self):
            object.__setattr__(
                self, field.name, fit_joints(getattr(self, field.name), self.plant.n, field.name)
            )

    def _check_regions(self) -> None:
        """Makes a tuple of the regions; raises ValueError for what is none, or does not fit plant
        and model.
        """
        if not isinstance(self.regions, tuple | list):
            remedy = "Such as (ij.regions.HalfSpace(normal=[0, 1], offset=0.1),)."
            raise checks.fail("Scenario.regions", self.regions, "a tuple of regions", remedy)
        object.__setattr__(self, "regions", tuple(self.regions))
        for i, region in enumerate(self.regions):
            name = f"Scenario.regions[{i}]"
            checks.conforms(name, region, regions.Region, "iblf_jax.regions has them.")
            for robot in (self.plant, self.model):
                try:
                    jax.eval_shape(
                        lambda r=robot, x=region: x.distance(
                            regions.position_of(r, x.point, jnp.zeros(r.n))
                        )
                    )
                except Exception as error:
                    kind = checks.with_article(type(robot).__name__)
                    what = f"a region for a point of {kind} of {robot.n} joints"
                    raise checks.fail(
                        name, region, what, f"{type(error).__name__}: {checks.line(str(error))}"
                    ) from error

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.plant.n

    def jump_times(self) -> jax.Array:
        """The times at which the right-hand side of the closed loop jumps, (m,) [s], in no order:
        those that its parts declare.
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
        """What the law knows: model, reference, bounds and regions."""
        return LawContext(
            self.model, self.reference, self.bounds, self.velocity_bounds, self.regions
        )

    @property
    def setting(self) -> LawContext:
        """The name that earlier versions gave `context`."""
        return self.context

    def _repr_html_(self) -> str:
        return present("card", self)


def with_parts(scenario: Scenario, **parts: Any) -> Scenario:
    """The scenario with whole parts exchanged by name: `with_parts(scenario,
    observer=Momentum(kf=20.0), disturbance=Step(1.0, 5.0))`.

    `robot` stands for plant and model together, as in paths.  `plant` alone leaves the model as it
    is, what the law knew before, also where the model was the plant itself: then plant and model
    differ from here on.  `model=None` is the plant itself.  A law that stands in a `Saturated` goes
    with it: exchange the whole controller.

    Args:
      scenario: what to change; it stays as it is.
      parts: any of plant, model, robot, reference, bounds, controller, observer, disturbance,
        initial, sampling, sensor, actuator, velocity_bounds, regions; each as `Scenario` takes it,
        so that one number stands for one number a joint.  Numbers take the scenario's
        floating-point type.

    Returns:
      A new Scenario; it runs like any other, and compiles where the structure is new.

    Raises:
      ValueError: an unknown name, `robot` beside plant or model, a part of the wrong kind, or parts
        that differ in their number of joints.
    """
    if not isinstance(scenario, Scenario):
        raise checks.fail(
            "scenario", scenario, "a Scenario", "Make one with ij.presets or ij.Scenario."
        )
    names = [field.name for field in dataclasses.fields(Scenario)]
    for name in parts:
        if name not in (*names, "robot"):
            known = ("robot", *names)
            remedy = f"{checks.nearest(name, known)} Leaves change by ij.with_parameters.".strip()
            raise checks.fail("part", name, f"the name of a part: {', '.join(known)}", remedy)
    if "robot" in parts:
        for name in ("plant", "model"):
            if name in parts:
                raise checks.fail(
                    name,
                    parts[name],
                    "robot alone, or plant and model",
                    "`robot` is plant and model together.",
                )
        robot = parts.pop("robot")
        parts |= {"plant": robot, "model": robot}
    elif (
        "plant" in parts
        and "model" not in parts
        and getattr(parts["plant"], "n", scenario.n) != scenario.model.n
    ):
        got = f"{parts['plant'].n} joints"
        raise checks.fail(
            "plant",
            got,
            f"{scenario.model.n} joints, as the model has",
            "Exchange plant and model together: robot=...",
        )
    new = dataclasses.replace(scenario, **parts)
    dtype = _shared_dtype(scenario)
    return new if _shared_dtype(new) == dtype else astype(new, dtype)


def fit_joints(part: Any, n: int, path: str) -> Any:
    """`part` with its joint-wise scalars repeated n times; ValueError where a leaf has another
    number of joints.
    """
    if isinstance(part, tuple):
        parts = tuple(fit_joints(x, n, f"{path}[{i}]") for i, x in enumerate(part))
        return part if all(a is b for a, b in zip(parts, part, strict=True)) else parts
    if not dataclasses.is_dataclass(part) or isinstance(part, type):
        return part
    new: dict[str, Any] = {}
    for field in dataclasses.fields(part):
        old, name = getattr(part, field.name), f"{path}.{field.name}"
        value = old
        if is_leaf_field(field) and field.metadata["shape"] == "joint" and value is not None:
            if jnp.ndim(value) == 0:
                value = jnp.broadcast_to(value, (n,))
            elif jnp.shape(value) != (n,):
                raise checks.fail(
                    name,
                    value,
                    f"one number, or {n} (one a joint)",
                    f"Its shape is {jnp.shape(value)}.",
                )
        elif not is_leaf_field(field):
            value = fit_joints(value, n, name)
        if value is not old:
            new[field.name] = value
    if not new:
        return part
    fitted = copy.copy(part)
    for key, value in new.items():
        object.__setattr__(fitted, key, value)
    return fitted


NUMBERS = (jax.Array, np.ndarray, np.generic, float, int)
"""What a leaf may be."""


def check_values(part: Any, path: str = "") -> None:
    """Raises ValueError for the first concrete leaf that is not finite or has the wrong sign, with
    its path.
    """
    if isinstance(part, tuple):
        for i, x in enumerate(part):
            check_values(x, f"{path}[{i}]")
    elif dataclasses.is_dataclass(part) and not isinstance(part, type):
        for field in dataclasses.fields(part):
            name = f"{path}.{field.name}" if path else field.name
            if not field.metadata.get("static"):
                value = getattr(part, field.name)
                if isinstance(value, NUMBERS):
                    checks.check_values(name, value, field.metadata.get("sign"))
                else:
                    check_values(value, name)


def canonical(scenario: Scenario) -> Scenario:
    """The scenario with every leaf an array of one floating-point type, checked: what every entry
    point calls first.

    Raises:
      ValueError: a leaf is not finite or has the wrong sign, a mass matrix is not positive
        definite, the start is outside its bounds or faster than VELOCITY_LIMIT; the message names
        the field, the value and the remedy.
    """
    if not isinstance(scenario, Scenario):
        raise checks.fail(
            "scenario", scenario, "a Scenario", "Make one with ij.presets or ij.Scenario."
        )
    keep_programs()
    check_values(scenario)
    scenario = with_sufficient_queue(scenario)
    dtype = _shared_dtype(scenario)
    scenario = jax.tree.map(lambda x: _typed(x, dtype), scenario)
    if checks.is_concrete(scenario):
        _check_start(scenario)
        for law in layers(scenario.controller):
            getattr(law, "check_start", lambda context: None)(scenario.context)
        advice = [
            text
            for part in (scenario.controller, scenario.observer)
            for text in getattr(part, "advice", list)()
        ]
        if scenario.sampling is not None:
            advice += getattr(scenario.sensor, "advice", lambda period: [])(
                scenario.sampling.period
            )
        for text in advice:
            notices.warn(text)
    return scenario


def _typed(x: Any, dtype) -> jax.Array:
    """A leaf as an array of a type; numbers of the host are copied there, as JAX compiles a program
    for every new shape.
    """
    if isinstance(x, jax.Array):
        return (
            x
            if x.dtype == dtype and not x.weak_type
            else jax.lax.convert_element_type(x, np.dtype(dtype))
        )
    return jnp.asarray(np.array(x, dtype))


def _shared_dtype(scenario: Scenario) -> jax.typing.DTypeLike:
    """float32 if all numbers are float32, else JAX's default."""
    leaves = jax.tree.leaves(scenario)
    if not all(isinstance(x, NUMBERS) for x in leaves):
        path, value = next(
            (path, x)
            for path, x in jax.tree_util.tree_leaves_with_path(scenario)
            if not isinstance(x, NUMBERS)
        )
        name = jax.tree_util.keystr(path).lstrip(".")
        raise checks.fail(
            name, value, "an array of numbers", "Other things belong in a static field."
        )
    types = {x.dtype if isinstance(x, jax.Array) else jnp.result_type(x) for x in leaves}
    floats = {x for x in types if jnp.issubdtype(x, jnp.floating)}
    if len(floats) == 1 and floats <= {jnp.dtype("float32"), jnp.dtype("float64")}:
        return floats.pop()
    if floats and not floats & {jnp.dtype("float32"), jnp.dtype("float64")}:
        raise checks.fail(
            "scenario",
            f"numbers of type {floats.pop()}",
            "float32 or float64",
            'Use iblf_jax.astype(scenario, "float32").',
        )
    return jnp.result_type(float)


def _shaped(name: str, call, *shape: int) -> jax.Array:
    """What `call()` returns, or a ValueError that names it if it raises or has another shape."""
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


@jax.jit
def _start(scenario: Scenario):
    """Reference and bounds at the start.  Shapes are checked while this is traced, once a
    structure.
    """
    n, q, dq, zero = (
        scenario.n,
        scenario.initial.q,
        scenario.initial.dq,
        jnp.zeros((), scenario.initial.q.dtype),
    )
    q_d = _shaped("reference.position(t)", lambda: scenario.reference.position(zero), n)
    _shaped("bounds.lower.at(t, q_d)", lambda: scenario.bounds.lower.at(zero, q_d), n)
    _shaped("bounds.upper.at(t, q_d)", lambda: scenario.bounds.upper.at(zero, q_d), n)
    tube = tube_at(scenario.reference, scenario.bounds, zero)
    for name, robot in (("plant", scenario.plant), ("model", scenario.model)):
        _shaped(f"{name}.mass_matrix(q)", lambda r=robot: r.mass_matrix(q), n, n)
        _shaped(f"{name}.coriolis(q, v, u)", lambda r=robot: r.coriolis(q, dq, dq), n)
        _shaped(f"{name}.gravity(q)", lambda r=robot: r.gravity(q), n)
    _shaped(
        "disturbance.torque(t, q, dq, plant, model)",
        lambda: scenario.disturbance.torque(zero, q, dq, scenario.plant, scenario.model),
        n,
    )
    limits = _speed_limits(scenario, zero)
    return (
        tube.q_d,
        tube.lower,
        tube.upper,
        limits,
        regions.margins(scenario.regions, scenario.plant, q) if scenario.regions else q[:0],
    )


def _speed_limits(scenario: Scenario, zero: jax.Array):
    """Bounds on the velocities at the start, their shapes checked; None if there are none."""
    bounds, n = scenario.velocity_bounds, scenario.n
    if bounds is None:
        return None
    dq_d = jnp.zeros((n,), zero.dtype)
    for name, side in (("lower", bounds.lower), ("upper", bounds.upper)):
        _shaped(f"velocity_bounds.{name}.at(t, dq_d)", lambda side=side: side.at(zero, dq_d), n)
    return speed_limits_at(scenario.reference, bounds, zero)


def _check_speeds(dq: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
    """Raises ValueError for bounds on the velocities that leave no room at t = 0, or a start
    outside of them.
    """
    for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
        if not low < high:
            raise checks.fail(
                f"velocity_bounds of joint {i}",
                (low, high),
                "finite lower < upper at t = 0",
                "Exchange or widen them.",
            )
        if not low < dq[i] < high:
            expected = f"a start inside the velocity bounds ({low:.6g}, {high:.6g}) at t = 0"
            raise checks.fail(
                f"initial.dq[{i}]", dq[i], expected, "Change the start or widen the bounds."
            )


def _check_start(scenario: Scenario) -> None:
    q = np.asarray(scenario.initial.q)
    q_d, lower, upper, speeds, rooms = jax.tree.map(np.asarray, _start(scenario))
    M = [
        np.asarray(mass_matrix_at(robot, scenario.initial.q))
        for robot in (scenario.plant, scenario.model)
    ]
    for name, values in (("reference", q_d), ("bounds.lower", lower), ("bounds.upper", upper)):
        if not np.all(np.isfinite(values)):
            raise checks.fail(name, values, "finite values at t = 0")
    for i in range(scenario.n):
        if not lower[i] < upper[i]:
            raise checks.fail(
                f"bounds of joint {i}",
                (lower[i], upper[i]),
                "lower < upper at t = 0",
                "Exchange or widen them.",
            )
        if not lower[i] < q_d[i] < upper[i]:
            raise checks.fail(
                f"reference of joint {i}",
                q_d[i],
                f"a value inside the bounds ({lower[i]:.6g}, {upper[i]:.6g}) at t = 0",
                "Move the reference or widen the bounds (Assumption 2).",
            )
        if not lower[i] < q[i] < upper[i]:
            raise checks.fail(
                f"initial.q[{i}]",
                q[i],
                f"a start inside the bounds ({lower[i]:.6g}, {upper[i]:.6g}) at t = 0",
                "Move the start or widen the bounds.",
            )
    if speeds is not None:
        _check_speeds(np.asarray(scenario.initial.dq), *speeds)
    for region, room in zip(scenario.regions, rooms, strict=True):
        if not room > 0:
            got = f"{regions.in_words(region, scenario.plant)} {-room:.4g} m beyond its wall"
            raise checks.fail(
                "initial.q", got, "a start inside all regions", "Move the start or the region."
            )
    if not np.all(np.abs(scenario.initial.dq) < VELOCITY_LIMIT):
        raise checks.fail(
            "initial.dq",
            scenario.initial.dq,
            f"speeds below {VELOCITY_LIMIT:g} rad/s",
            "A run that fast counts as diverged.",
        )
    for name, matrix in zip(("plant", "model"), M, strict=True):
        symmetric = 0.5 * (matrix + matrix.T)
        if not np.all(np.isfinite(matrix)) or np.ptp(matrix - matrix.T) > 1e-4 * np.max(
            np.abs(matrix)
        ):
            raise checks.fail(
                f"{name}.mass_matrix(initial.q)",
                matrix,
                "a finite symmetric matrix",
                "Check the masses, lengths and inertias.",
            )
        modes = np.linalg.eigvalsh(symmetric)
        if modes[0] <= scenario.n * np.finfo(matrix.dtype).eps * modes[-1]:
            raise checks.fail(
                f"{name}.mass_matrix(initial.q)",
                matrix,
                "a positive definite matrix",
                "Check the masses, lengths and inertias.",
            )
