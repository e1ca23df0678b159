"""Gains are tuned for objectives, composed with + and weights, under requirements, which constrain
the tuning and get a verdict in the report.

    objective = ij.objectives.tracking() + 0.5 * ij.objectives.effort()
    objective += 10 * ij.objectives.peak_torque() + ij.objectives.margin_above(0.05)

A term is a smooth number of a run divided by its scale, so that terms are comparable:

    plain   weight value / scale
    above   weight softplus(sharpness (value - limit) / scale) / sharpness

`scale` and `limit`, if they are not given, are the value at the gains that tuning starts from (its
mean over perturbed runs).  A requirement holds where

    g = (value - limit) / scale < 0        (with the opposite sign for "above" requirements);

the tuning keeps g below zero (`solvers`), and in the report the requirement passes or fails, with a
confidence.

In all functions `joints=` selects the joints that count, by index, name, slice or one truth value
each (`core.joints`); `weights=` is one number, or one for each joint (or for each selected joint).
A limit may be one number for all joints, or one for each:

    ij.objectives.peak_torque_below([140, 140, 140, 27, 27, 27])
    ij.objectives.error_below(0.01, joints=["wrist_1", "wrist_2"])

Limits of single joints are one requirement on the largest ratio to the limit,
max_i |y_i| / limit_i < 1.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.core import checks, notices
from iblf_jax.core.joints import Joints, Selection, indices, selection
from iblf_jax.core.pytree import component, leaf, note_code, static
from iblf_jax.engine import Outer as Outer
from iblf_jax.simulation.metrics import Fold, Settling, Tracking, check_needs
from iblf_jax.simulation.scenario import Scenario, fit_joints
from iblf_jax.simulation.units import unit_text
from iblf_jax.studies.rare_events.result import FailureProbability
from iblf_jax.tuning.quantities import (
    SIGNAL_OF_MARGIN,
    TUNED_SIGNALS,
    MetricResult,
    Peak,
    TimeIntegral,
)
from iblf_jax.tuning.quantities import Quantity as Quantity
from iblf_jax.world import plants

A_SHARE = "a share of the runs, from 0 to 1"
UNSUITABLE_SCALES = (
    "objective: the scale of {names} is its value at the start, where a run leaves its bounds by"
    " {distance:.3g} {unit}. Such values are far larger than those of good gains, and so the"
    " terms are not comparable. Start from gains that keep the bounds, or give each term a scale=."
)


@component
class Term:
    """One weighted term of an objective.

    Args:
      quantity: the number of a run, any `Quantity`.
      weight: factor on the term, () [1], >= 0; 1 if not given.
      scale: () in the quantity's unit, > 0; its size at the start if not given.
      limit: for "above", () in the quantity's unit; its value at the start if not given.
      sharpness: of the corner at the limit, () [1], > 0; 20 if not given.
      shape: "plain" or "above"; "plain" if not given.
      name: in reports; "term" if not given.
    """

    quantity: Quantity
    weight: jax.Array = leaf("1", sign="nonnegative", shape="scalar", default=1.0)
    scale: jax.Array | None = leaf("", sign="positive", shape="scalar", default=None)
    limit: jax.Array | None = leaf("", shape="scalar", default=None)
    sharpness: jax.Array = leaf("1", sign="positive", shape="scalar", default=20.0)
    shape: str = static(default="plain")
    name: str = static(default="term")

    def check(self) -> None:
        """Raises ValueError for an unknown shape, or something that is not a quantity."""
        checks.conforms("Term.quantity", self.quantity, Quantity)
        checks.one_of("Term.shape", self.shape, ("plain", "above"))

    def value(self, x: jax.Array) -> jax.Array:
        """The term, from the quantity's value."""
        scale: Any = self.scale
        limit: Any = self.limit
        if self.shape == "plain":
            return self.weight * x / scale
        excess = (x - limit) / scale
        return self.weight * jax.nn.softplus(self.sharpness * excess) / self.sharpness

    @property
    def is_complete(self) -> bool:
        """Whether neither scale nor limit is missing."""
        return self.scale is not None and (self.limit is not None or self.shape == "plain")


@component
class Requirement:
    """A limit that all runs have to satisfy, except for an allowed share of them.

    Args:
      quantity: the number of a run, any `Quantity`.
      limit: upper limit, () in the quantity's unit.
      scale: a relevant difference, () in the quantity's unit, > 0.
      allowed: share of perturbed runs that may violate it, () [1], >= 0; 0.01 if not given.
      event: "value": violated where g >= 0; "violated": where the run left its bounds or diverged;
        "value" if not given.
      name: in reports; "requirement" if not given.
      function: the function that made it, for messages; "" if not given.
    """

    quantity: Quantity
    limit: jax.Array = leaf("", shape="scalar")
    scale: jax.Array = leaf("", sign="positive", shape="scalar")
    allowed: jax.Array = leaf("1", sign="nonnegative", shape="scalar", default=0.01)
    event: str = static(default="value")
    name: str = static(default="requirement")
    function: str = static(default="")

    def check(self) -> None:
        """Raises ValueError for a share above 1, another event, or something that is not a
        quantity.
        """
        checks.conforms("Requirement.quantity", self.quantity, Quantity)
        if checks.is_concrete(self.allowed) and self.allowed > 1:
            raise checks.fail("Requirement.allowed", self.allowed, A_SHARE)
        checks.one_of("Requirement.event", self.event, ("value", "violated"))

    def excess(self, x: jax.Array) -> jax.Array:
        """g: below zero where the requirement holds."""
        return (x - self.limit) / self.scale

    @property
    def measure(self) -> tuple[float, str]:
        """Sign and unit with which its numbers are shown: a deficit is shown as a margin."""
        if not isinstance(self.quantity, Peak):
            return 1.0, ""
        return self.quantity.sign, self.quantity.unit

    def __add__(self, other: object) -> Objective:
        return Objective((), (self,)) + other

    __radd__ = __add__


@component
class Objective:
    """A sum of terms and a set of requirements; made by the functions of this module and by + and
    *.

    Args:
      terms: what is minimised, a tuple of `Term`; () if not given.
      requirements: what must hold, a tuple of `Requirement`; () if not given.
    """

    terms: tuple[Term, ...] = ()
    requirements: tuple[Requirement, ...] = ()

    def __add__(self, other: object) -> Objective:
        if isinstance(other, Requirement):
            other = Objective((), (other,))
        if not isinstance(other, Objective):
            expected = "an objective or a requirement to add"
            raise checks.fail("objective", other, expected, "ij.objectives has them.")
        return Objective((*self.terms, *other.terms), (*self.requirements, *other.requirements))

    def __mul__(self, weight: ArrayLike) -> Objective:
        weight = checks.as_floats("weight", weight)
        checks.shape_is("weight", weight, ())
        terms = (dataclasses.replace(t, weight=weight * t.weight) for t in self.terms)
        return Objective(tuple(terms), self.requirements)

    __rmul__ = __mul__

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Those of the terms, then those of the requirements."""
        return (*(t.quantity for t in self.terms), *(r.quantity for r in self.requirements))

    def values(self, smooth: jax.Array) -> jax.Array:
        """Each term, (n_terms,), from the quantities (K,)."""
        return jnp.stack([t.value(smooth[i]) for i, t in enumerate(self.terms)])

    def excesses(self, smooth: jax.Array) -> jax.Array:
        """Excess g of each requirement, (n_requirements,)."""
        offset = len(self.terms)
        if not self.requirements:
            return jnp.zeros((0,), smooth.dtype)
        return jnp.stack([r.excess(smooth[offset + i]) for i, r in enumerate(self.requirements)])


WHAT_IT_IS = (
    "an objective with at least one term: a sum of terms of ij.objectives "
    "(tracking, effort, torque_rate, settle, peak_torque, margin, metric and others), "
    "each with a weight, to which requirements can be added"
)


def checked(objective: object) -> Objective:
    """The objective that the user composed, if it is one; ValueError otherwise."""
    if isinstance(objective, Requirement):
        objective = Objective((), (objective,))
    if isinstance(objective, Objective) and objective.terms:
        note_code(objective)
        return objective
    remedy = "Such as ij.objectives.tracking() + 0.1 * ij.objectives.effort()."
    if isinstance(objective, str):
        call = f"ij.objectives.metric(fold, {objective!r})"
        remedy = f"A name is not an objective; {call} makes a term of a metric. {remedy}"
    elif callable(objective):
        remedy = f"Call the function, with brackets. {remedy}"
    raise checks.fail("objective", objective, WHAT_IT_IS, remedy)


def _composed(objective: object) -> Objective:
    if isinstance(objective, Objective):
        return objective
    remedy = "Such as ij.objectives.tracking()."
    raise checks.fail("objective", objective, "an objective", remedy)


def is_complete(objective: Objective) -> bool:
    """Whether no scale or limit is missing."""
    return all(term.is_complete for term in objective.terms)


def complete(
    objective: Objective, start: ArrayLike, margin: float | None = None, unit: str = "rad"
) -> Objective:
    """The objective with every missing scale and limit set to the value at the start.

    Args:
      objective: as the user composed it.
      start: the exact values of the terms' quantities at the start, (n_terms,).
      margin: the smallest margin of the runs at the start [rad]; a negative one gives a warning, as
        the values of runs that leave their bounds are no scales.
      unit: of the margin.
    """
    values = np.asarray(checks.as_floats("start", start), float)
    checks.shape_is("start", values, (len(_composed(objective).terms),))
    missing = [term.name for term in objective.terms if not term.is_complete]
    if missing and margin is not None and margin < 0:
        names = ", ".join(missing)
        notices.warn(UNSUITABLE_SCALES.format(names=names, distance=-margin, unit=unit))
    terms = tuple(_completed(t, x) for t, x in zip(objective.terms, values, strict=True))
    return Objective(terms, objective.requirements)


def _completed(term: Term, x: Any) -> Term:
    if term.is_complete:
        return term
    if not (np.isfinite(x) and abs(x) > 0):
        field = f"{term.name}: its value at the start"
        remedy = "Give the term a scale of its own."
        raise checks.fail(field, x, "a finite number other than 0", remedy)
    if term.scale is None:
        quantity: Any = term.quantity
        if isinstance(quantity, Peak):
            quantity = dataclasses.replace(quantity, scale=abs(x))
        term = dataclasses.replace(term, quantity=quantity, scale=abs(x))
    if not term.is_complete:
        term = dataclasses.replace(term, limit=x)
    return term


def sharper(objective: Objective, factor: float) -> Objective:
    """The objective with the smoothing of every peak in its terms multiplied by a factor; its
    structure stays the same.
    """
    terms = []
    for term in _composed(objective).terms:
        smoothing = term.quantity.smoothing
        if smoothing is not None:
            quantity: Any = term.quantity
            quantity = dataclasses.replace(quantity, smoothing=factor * smoothing)
            term = dataclasses.replace(term, quantity=quantity)
        terms.append(term)
    return Objective(tuple(terms), objective.requirements)


def is_smoothed(objective: Objective) -> bool:
    """Whether a term of the objective is smoothed, so that `sharper` changes it."""
    return any(t.quantity.smoothing is not None for t in _composed(objective).terms)


def depends_on_torque(objective: Objective) -> bool:
    """Whether a term or a requirement increases with the torque; a user's own metric is assumed to
    do so.
    """
    return any(
        q.signal in ("torque", "torque_rate")
        for q in _composed(objective).quantities
        if not (isinstance(q, MetricResult) and isinstance(q.fold, Tracking | Settling))
    )


def tighter(objective: Objective, amounts: tuple[float, ...]) -> Objective:
    """The objective with the limit of each requirement tightened by an amount of its scale."""
    pairs = zip(objective.requirements, amounts, strict=True)
    requirements = (dataclasses.replace(r, limit=r.limit - x * r.scale) for r, x in pairs)
    return dataclasses.replace(objective, requirements=tuple(requirements))


def fitted(objective: Objective, scenario: Scenario) -> Objective:
    """The objective for the joints and signals of a scenario.

    Raises:
      ValueError: as `for_scenario`; or the objective is of signals that the scenario's runs do not
        have, such as margins of velocities or regions, or a slack.
    """
    objective = for_scenario(objective, scenario)
    for quantity in objective.quantities:
        check_needs("objective", quantity, scenario)
    fit_joints(objective, scenario.n, "objective")
    return objective


def for_scenario(objective: Objective, scenario: Scenario) -> Objective:
    """The objective with its selections of joints as indices of the scenario's robot, weights and
    limits checked.

    Args:
      objective: as the user composed it.
      scenario: of the n joints that names, slices and numbers of weights refer to.

    Raises:
      ValueError: a joint that the robot does not have, or another number of weights or limits; the
        message names the function.
    """
    names = plants.component_names(scenario.plant)
    terms = tuple(_part_of(t, t.name, names) for t in _composed(objective).terms)
    requirements = tuple(
        _in_units_of(scenario, _part_of(r, r.function or r.name, names))
        for r in objective.requirements
    )
    return Objective(terms, requirements)


def _in_units_of(scenario: Scenario, requirement: Requirement) -> Requirement:
    """A requirement whose name has the unit of the plant, and the names of its input and of its
    second level, in the place of those of a robot.
    """
    _, unit = requirement.measure
    name = requirement.name.replace(f" {unit}", f" {unit_text(scenario, unit)}")
    plant, quantity = scenario.loop.plant, requirement.quantity
    if isinstance(quantity, Peak):
        own = {
            "torque": f"peak {plants.input_name(plant)}",
            "velocity_deficit": f"{plants.level_names(plant)[1]} margin",
        }
        words = IN_WORDS[quantity.signal]
        name = name.replace(words, own.get(quantity.signal, words), 1)
    return dataclasses.replace(requirement, name=name)


def _part_of(part: Any, function: str, names: tuple[str, ...]) -> Any:
    """A term or a requirement whose quantity knows its joints."""
    quantity = part.quantity
    if not isinstance(quantity, TimeIntegral | Peak | MetricResult):
        return part  # one of the user's own
    if isinstance(quantity, Peak) and quantity.signal == "region_deficit":
        return part  # regions belong to no joint
    if isinstance(quantity, MetricResult):
        function = "metric"
        if quantity.joints is None:
            # its weights belong to the numbers of the metric, which need not be those of joints
            return part
    chosen = indices(f"{function}: joints", quantity.joints, names)
    shape = jnp.shape(quantity.weights)
    if shape not in ((), (len(chosen),), (len(names),)):
        name, came = "weights", quantity.weights
        if isinstance(quantity, Peak) and quantity.relative:
            name, came = NAME_OF_LIMIT.get(function, "limit"), 1.0 / quantity.weights
        expected = f"one number, or {len(chosen)}, one for each of the joints"
        raise checks.fail(f"{function}: {name}", came, expected, f"Its shape is {shape}.")
    if quantity.joints is None:
        return part
    return dataclasses.replace(part, quantity=dataclasses.replace(quantity, joints=chosen))


NAME_OF_LIMIT = {"margin": "target", "velocity_margin": "target", "region_margin": "target"}
"""Function -> name of its limit, where that is another one."""
IN_WORDS = {
    "error": "|e1|",
    "torque": "peak torque",
    "deficit": "margin",
    "velocity_deficit": "velocity margin",
    "region_deficit": "region margin",
}
"""Signal -> what the name of a requirement calls it."""


# ----------------------------------------------- arguments of the functions that users compose with


def _number(
    function: str, name: str, value: ArrayLike, sign: str | None = None, most: int = 0
) -> jax.Array:
    """An argument of one of these functions as an array of at most `most` dimensions; ValueError
    with the argument's name.
    """
    field = f"{function}: {name}"
    array = checks.as_floats(field, value)
    if array.ndim > most:
        expected = "one number, or one for each joint" if most else "one number"
        raise checks.fail(field, value, expected, f"Its shape is {array.shape}.")
    checks.check_values(field, array, sign)
    return array


def _limit(function: str, limit: ArrayLike, example: str) -> jax.Array:
    """The limit of a function, one number or one for each joint."""
    name = NAME_OF_LIMIT.get(function, "limit")
    try:
        array = _number(function, name, limit, "positive", most=1)
    except ValueError as error:
        raise ValueError(
            f"{error} Such as {function}({name}={example}), or one number for each joint."
        ) from error
    if not array.size:
        raise checks.fail(f"{function}: {name}", limit, "at least one number")
    return array


def _share(function: str, name: str, share: ArrayLike) -> jax.Array:
    number = _number(function, name, share, "nonnegative")
    if checks.is_concrete(number) and number > 1:
        raise checks.fail(f"{function}: {name}", share, A_SHARE)
    return number


def _selected(
    function: str, joints: Joints, weights: ArrayLike | None
) -> tuple[Selection, jax.Array]:
    """The joints that count, and their weights."""
    chosen = selection(f"{function}: joints", joints)
    given = 1.0 if weights is None else weights
    found = _number(function, "weights", given, "nonnegative", most=1)
    if checks.is_concrete(found) and not jnp.any(found > 0):
        raise checks.fail(f"{function}: weights", weights, "at least one weight > 0")
    return chosen, found


def _peak(
    function: str,
    signal: str,
    limit: Any,
    joints: Joints,
    weights: ArrayLike | None,
    after: ArrayLike = 0.0,
    smoothing: ArrayLike = 0.01,
) -> tuple[Peak, Any]:
    """The peak of a signal under a limit that is one number, or one for each joint; and the limit
    of that peak.
    """
    chosen, w = _selected(function, joints, weights)
    after = _number(function, "after", after)
    smoothing = _number(function, "smoothing", smoothing, "positive")
    if jnp.ndim(limit) == 0:
        return Peak(limit, signal, w, after, smoothing, joints=chosen), limit
    if jnp.ndim(w) == 1 and jnp.shape(w) != jnp.shape(limit):
        expected = f"one number, or {jnp.size(limit)}, as there are limits"
        raise checks.fail(f"{function}: weights", w, expected)
    one: Any = 1.0
    return Peak(one, signal, w / limit, after, smoothing, joints=chosen, relative=True), one


def _requirement(
    function: str,
    signal: str,
    limit: ArrayLike,
    example: str,
    allowed: ArrayLike,
    joints: Joints = None,
    weights: ArrayLike | None = None,
    after: ArrayLike = 0.0,
) -> Requirement:
    """The requirement that a peak is below its limit, or a margin, minus a peak, above it."""
    given = _limit(function, limit, example)
    peak, own_limit = _peak(function, signal, given, joints, weights, after)
    sides = {1.0: "<", -1.0: ">"}
    numbers = np.asarray(given)
    text = f"{numbers:g}" if not numbers.ndim else f"[{', '.join(f'{x:g}' for x in numbers)}]"
    name = f"{IN_WORDS[signal]}{_of_joints(peak.joints)} {sides[peak.sign]} {text}"
    name += f" {TUNED_SIGNALS[signal]}"
    if after:
        name += f" after {after:g} s"
    share = _share(function, "allowed", allowed)
    own = peak.sign * own_limit
    return Requirement(peak, own, own_limit, share, name=name, function=function)


def _of_joints(chosen: Selection) -> str:
    """Which joints a requirement is on, for its name."""
    if chosen is None:
        return ""
    if isinstance(chosen[0], bool):
        chosen = tuple(i for i, taken in enumerate(chosen) if taken)
    one = len(chosen) == 1 and ":" not in str(chosen[0])
    names = ", ".join(map(str, chosen))
    return f" of joint {names}" if one else f" of joints {names}"


def _soft(
    function: str,
    signal: str,
    limit: ArrayLike | None,
    example: str,
    sharpness: ArrayLike,
    smoothing: ArrayLike,
    joints: Joints = None,
    weights: ArrayLike | None = None,
) -> Objective:
    """A soft penalty on a peak above a limit, or on a margin below it.  Without a limit, the peak
    at the start will be scale and limit.
    """
    given = 1.0 if limit is None else _limit(function, limit, example)
    peak, scale = _peak(function, signal, given, joints, weights, smoothing=smoothing)
    sharpness = _number(function, "sharpness", sharpness, "positive")
    limited = {} if limit is None else {"scale": scale, "limit": peak.sign * scale}
    return Objective((Term(peak, sharpness=sharpness, shape="above", name=function, **limited),))


def _one_term(function: str, quantity: Quantity, scale: ArrayLike | None, name: str) -> Objective:
    if scale is not None:
        scale = _number(function, "scale", scale, "positive")
    return Objective((Term(quantity, scale=scale, name=name),))


def _integral(
    function: str,
    signal: str,
    joints: Joints,
    weights: ArrayLike | None,
    scale: ArrayLike | None,
    after: ArrayLike = 0.0,
    tolerance: jax.Array | None = None,
) -> Objective:
    chosen, w = _selected(function, joints, weights)
    quantity = TimeIntegral(signal, w, _number(function, "after", after), tolerance, chosen)
    return _one_term(function, quantity, scale, function)


# ---------------------------------------------------------------------------------------- terms


def tracking(
    *,
    joints: Joints = None,
    weights: ArrayLike | None = None,
    after: ArrayLike = 0.0,
    scale: ArrayLike | None = None,
) -> Objective:
    """Integral of the squared position error.

        int sum_i (w_i e1_i)^2 dt / scale

    Args:
      joints: which joints count: indices, names, a slice, or one truth value each; all if not
        given.
      weights: w, one number, one for each joint, or one for each selected joint; 1 if not given.
      after: count from this time on [s].
      scale: in rad^2 s; the value at the starting gains if not given.

    Returns:
      An `Objective`, to be weighted and added to others.

    Raises:
      ValueError: a scale that is not positive, or joints that are no selection.

    Source: the ISE criterion, textbook.
    """
    return _integral("tracking", "error", joints, weights, scale, after)


def effort(
    *, joints: Joints = None, weights: ArrayLike | None = None, scale: ArrayLike | None = None
) -> Objective:
    """Integral of the squared torque, int sum_i (w_i tau_i)^2 dt / scale; arguments as `tracking`,
    scale in N^2 m^2 s.

    The torque includes gravity.  The effort of `iblf_jax.compare` is the torque above gravity:
    `metric(iblf_jax.metrics.AboveGravity(), "effort_above_gravity")`.
    """
    return _integral("effort", "torque", joints, weights, scale)


def torque_rate(
    *, joints: Joints = None, weights: ArrayLike | None = None, scale: ArrayLike | None = None
) -> Objective:
    """Integral of the squared rate of the torque, int sum_i (w_i tau_i')^2 dt / scale; arguments as
    `tracking`, scale in N^2 m^2/s.

    A sampled loop needs an actuator whose torque is continuous, such as `actuators.Motor`: a held
    torque jumps at each sample, and the integral of a jump grows as 1/dt.
    """
    return _integral("torque_rate", "torque_rate", joints, weights, scale)


def settle(
    tolerance: ArrayLike = 0.01,
    *,
    joints: Joints = None,
    weights: ArrayLike | None = None,
    scale: ArrayLike = 1.0,
) -> Objective:
    """Time that the joints spend outside a tolerance, a smooth substitute for the settling time,
    summed over joints / scale.

        int sum_i w_i^2 sigmoid((|e1_i| - tolerance) / (0.1 tolerance)) dt / scale

    Args:
      tolerance: on |e1| [rad].
      joints, weights: as `tracking`.
      scale: in s.
    """
    tolerance = _number("settle", "tolerance", tolerance, "positive")
    return _integral("settle", "outside", joints, weights, scale, tolerance=tolerance)


def peak_torque(
    limit: ArrayLike | None = None,
    *,
    sharpness: ArrayLike = 20.0,
    smoothing: ArrayLike = 0.01,
    joints: Joints = None,
    weights: ArrayLike | None = None,
) -> Objective:
    """Soft penalty on the largest torque above a limit, with the smooth maximum p of w_i |tau_i|.

        softplus(sharpness (p / limit - 1)) / sharpness

    Args:
      limit: in N m, one number or one for each joint; the peak at the starting gains if not given.
      sharpness: of the corner at the limit.
      smoothing: of the maximum over time and joints, as a part of the limit.
      joints, weights: as `tracking`.
    """
    return _soft("peak_torque", "torque", limit, "140.0", sharpness, smoothing, joints, weights)


def margin(
    target: ArrayLike = 0.05,
    *,
    sharpness: ArrayLike = 5.0,
    smoothing: ArrayLike = 0.02,
    joints: Joints = None,
) -> Objective:
    """Soft penalty on a margin to the bounds below a target.

        softplus(sharpness (1 - margin / target)) / sharpness

    Args:
      target: in rad, one number or one for each joint.
      sharpness, smoothing: as `peak_torque`, relative to the target.
      joints: as `tracking`.
    """
    return _soft("margin", "deficit", target, "0.05", sharpness, smoothing, joints)


def velocity_margin(
    target: ArrayLike = 0.05,
    *,
    sharpness: ArrayLike = 5.0,
    smoothing: ArrayLike = 0.02,
    joints: Joints = None,
) -> Objective:
    """Soft penalty on a margin to the velocity bounds below a target; as `margin`, in rad/s, for
    scenarios with bounds of the second level.
    """
    return _soft(
        "velocity_margin", "velocity_deficit", target, "0.05", sharpness, smoothing, joints
    )


def region_margin(
    target: ArrayLike = 0.02, *, sharpness: ArrayLike = 5.0, smoothing: ArrayLike = 0.02
) -> Objective:
    """Soft penalty on a distance to the regions' boundaries below a target; as `margin`, in m, for
    scenarios with `regions`.
    """
    return _soft("region_margin", "region_deficit", target, "0.05", sharpness, smoothing)


def metric(
    fold: Fold,
    name: str,
    *,
    joints: Joints = None,
    weights: ArrayLike | None = None,
    scale: ArrayLike | None = None,
) -> Objective:
    """A result of any metric, `metric(ij.metrics.Tracking(), "iae")` or of a fold of your own,
    summed over the joints.

        sum_i w_i m_i / scale

    It has to be differentiable.  Integrals, rms values and peaks are; the time of an event has no
    derivative, and is infinite without the event (for the settling time use `settle`).
    `iblf_jax.testing.check_objective` checks it.

    Args:
      fold: the metric, such as `iblf_jax.metrics.Tracking()`.
      name: which of the fold's results; one of its `units`.
      joints: which of its numbers count, where it has one for each joint: indices, names, a slice,
        or one truth value each.
      weights: w, one number or as many as the result, or the selection, has; 1 if not given.
      scale: in the result's unit; the value at the starting gains if not given.

    Returns:
      An `Objective`, to be weighted and added to others.

    Raises:
      ValueError: something that is not a fold, a name that it does not return, a scale that is not
        positive.

    Source: design of this package.
    """
    name = checks.string("name", name, "the name of one of the fold's results")
    chosen = selection("metric: joints", joints)
    w: Any = 1.0 if weights is None else weights
    return _one_term("metric", MetricResult(fold, name, w, chosen), scale, name)


# ----------------------------------------------------------------------------------- requirements


def error_below(
    limit: ArrayLike,
    *,
    after: ArrayLike = 0.0,
    allowed: ArrayLike = 0.01,
    joints: Joints = None,
    weights: ArrayLike | None = None,
) -> Requirement:
    """|e1| < limit on every joint from a time on: `error_below(0.01, after=1.0)`.

        w_i |e1_i(t)| < limit_i     for t >= after

    Args:
      limit: in rad, one number or one for each joint (or for each selected joint).
      after: in s.
      allowed: share of perturbed runs that may violate it.
      joints: which joints count: indices, names, a slice, or one truth value each; all if not
        given.
      weights: w, one number or one for each joint; 1 if not given.
    """
    return _requirement("error_below", "error", limit, "0.01", allowed, joints, weights, after)


def peak_torque_below(
    limit: ArrayLike,
    *,
    allowed: ArrayLike = 0.01,
    joints: Joints = None,
    weights: ArrayLike | None = None,
) -> Requirement:
    """Largest |tau| < limit [N m], one number or one for each joint; arguments as `error_below`."""
    return _requirement("peak_torque_below", "torque", limit, "140.0", allowed, joints, weights)


def margin_above(
    limit: ArrayLike, *, allowed: ArrayLike = 0.01, joints: Joints = None
) -> Requirement:
    """Minimum over time and joints of min(q - lower, upper - q) > limit [rad]; `limit`, `allowed`
    and `joints` as `error_below`.
    """
    return _requirement("margin_above", "deficit", limit, "0.05", allowed, joints)


def velocity_margin_above(
    limit: ArrayLike, *, allowed: ArrayLike = 0.01, joints: Joints = None
) -> Requirement:
    """Minimum over time and joints of min(q' - v_l, v_u - q') > limit [rad/s], for scenarios with
    bounds of the second level; as `margin_above`.
    """
    return _requirement("velocity_margin_above", "velocity_deficit", limit, "0.05", allowed, joints)


def region_margin_above(limit: ArrayLike, *, allowed: ArrayLike = 0.01) -> Requirement:
    """Minimum over time and regions of the distance to the boundary > limit [m], for scenarios with
    `regions`; as `margin_above`.
    """
    return _requirement("region_margin_above", "region_deficit", limit, "0.05", allowed)


def violation_probability_below(
    probability: float | jax.Array, *, scale: ArrayLike = 0.05
) -> Requirement:
    """The probability that a run leaves its bounds or diverges is below a limit.

    While tuning, the margin of the worst `probability` share of the runs (at least of one) is kept
    above zero.

    Args:
      probability: the limit.
      scale: a relevant margin [rad].
    """
    function = "violation_probability_below"
    size = _number(function, "scale", scale, "positive")
    limit: Any = 0.0
    return Requirement(
        Peak(size, "deficit"),
        limit,
        size,
        _share(function, "probability", probability),
        event="violated",
        name=f"violation probability < {probability:g}",
        function=function,
    )


def failure_probability_below(
    probability: float | jax.Array, found: FailureProbability, *, scale: ArrayLike = 0.05
) -> Requirement:
    """The probability of a rare failure is below a limit, assessed on draws near failure.

        P(A) share(y <= limit) < probability,      A the set of the draws `found.rare_draws`

    Use it with `perturbations=found.rare_draws`: the runs of the tuning are draws from a set A
    whose probability P(A) is estimated by `found`, and a share probability / P(A) of them may fail.
    A share below 1 / runs means that none of them fails.  Neither the error of P(A) nor failures
    outside A, which other gains may have, are considered: estimate the probability anew for the
    tuned scenario, `ij.failure_probability(best.scenario, perturbations, **found.arguments)`.

    Args:
      probability: the limit [1].
      found: an estimate of `ij.failure_probability` in which samples failed.
      scale: a relevant margin, in the margin's unit.

    Raises:
      ValueError: not such an estimate, or one without failures.
    """
    function = "failure_probability_below"
    if not isinstance(found, FailureProbability) or found.is_upper_bound:
        expected = "an estimate of ij.failure_probability in which runs failed"
        raise checks.fail(f"{function}: found", found, expected)
    limit = _share(function, "probability", probability)
    size = _number(function, "scale", scale, "positive")
    share = jnp.minimum(limit / found.nearby_probability, 1.0)
    return Requirement(
        Peak(size, SIGNAL_OF_MARGIN[found.arguments["margin"]]),
        jnp.asarray(-found.arguments["limit"], share.dtype),
        size,
        share,
        name=f"failure probability < {probability:g} among rare draws",
        function=function,
    )
