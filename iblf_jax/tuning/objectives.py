"""What gains are tuned for: objectives, composed with + and weights, and requirements, which are penalty and verdict at once.

    objective = ij.objectives.tracking() + 0.5 * ij.objectives.effort() + 10 * ij.objectives.peak_torque()
    objective += ij.objectives.margin_above(0.05)

A term is a smooth number of a run over its scale, so that terms are comparable:

    plain   weight value / scale                 above   weight softplus(sharpness (value - limit) / scale) / sharpness

`scale` and `limit`, where they are not given, are the value at the gains that tuning starts from (its mean over perturbed
runs).  A requirement holds where

    g = (value - limit) / scale < 0        (its sign turned for "above" requirements);

the tuning keeps g below zero (`newton`), in the report it passes or fails, with a confidence.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.pytree import component, leaf, static
from iblf_jax.engine.derivatives import Outer as Outer
from iblf_jax.simulation.metrics import Fold, Settling, Tracking, check_needs
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.tuning.quantities import DEFICITS, MetricResult, Peak, TimeIntegral
from iblf_jax.tuning.quantities import Quantity as Quantity


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
      name: what reports call it; "term" if not given.
    """

    quantity: Quantity
    weight: jax.Array = leaf("1", sign="nonnegative", shape="scalar", default=1.0)
    scale: jax.Array | None = leaf("", sign="positive", shape="scalar", default=None)
    limit: jax.Array | None = leaf("", shape="scalar", default=None)
    sharpness: jax.Array = leaf("1", sign="positive", shape="scalar", default=20.0)
    shape: str = static(default="plain")
    name: str = static(default="term")

    def check(self) -> None:
        """Raises ValueError for an unknown shape."""
        checks.one_of("Term.shape", self.shape, ("plain", "above"))

    def value(self, x: jax.Array) -> jax.Array:
        """The term, from the quantity's value."""
        scale: Any = self.scale
        limit: Any = self.limit
        if self.shape == "plain":
            return self.weight * x / scale
        return self.weight * jax.nn.softplus(self.sharpness * (x - limit) / scale) / self.sharpness


@component
class Requirement:
    """A limit that every run, but for an allowed share of them, has to keep.

    Args:
      quantity: the number of a run, any `Quantity`.
      limit: what it must stay below, () in the quantity's unit.
      scale: the size that matters, () in the quantity's unit, > 0.
      allowed: share of perturbed runs that may break it, () [1], >= 0; 0.01 if not given.
      event: "value": broken where g >= 0; "violated": broken where the run left its bounds or ran away; "value" if not given.
      name: what reports call it; "requirement" if not given.
    """

    quantity: Quantity
    limit: jax.Array = leaf("", shape="scalar")
    scale: jax.Array = leaf("", sign="positive", shape="scalar")
    allowed: jax.Array = leaf("1", sign="nonnegative", shape="scalar", default=0.01)
    event: str = static(default="value")
    name: str = static(default="requirement")

    def check(self) -> None:
        """Raises ValueError for a share above 1, or another event."""
        if checks.is_concrete(self.allowed) and self.allowed > 1:
            raise checks.fail("Requirement.allowed", self.allowed, "a share of the runs, from 0 to 1")
        checks.one_of("Requirement.event", self.event, ("value", "violated"))

    def excess(self, x: jax.Array) -> jax.Array:
        """g: below zero where the requirement holds."""
        return (x - self.limit) / self.scale

    @property
    def measure(self) -> tuple[float, str]:
        """Sign and unit with which its numbers are shown: a deficit is shown as a margin."""
        signal = getattr(self.quantity, "signal", "")
        return -1.0 if signal in DEFICITS else 1.0, getattr(self.quantity, "units", {}).get(signal, "")

    def __add__(self, other: Any) -> Objective:
        return Objective((), (self,)) + other

    __radd__ = __add__


@component
class Objective:
    """A sum of terms and a set of requirements; made by the functions of this module and by + and *.

    Args:
      terms: what is minimised, a tuple of `Term`; () if not given.
      requirements: what must hold, a tuple of `Requirement`; () if not given.
    """

    terms: tuple[Term, ...] = ()
    requirements: tuple[Requirement, ...] = ()

    def __add__(self, other: Any) -> Objective:
        if isinstance(other, Requirement):
            other = Objective((), (other,))
        if not isinstance(other, Objective):
            raise checks.fail("objective", other, "an objective or a requirement to add", "ij.objectives has them.")
        return Objective((*self.terms, *other.terms), (*self.requirements, *other.requirements))

    def __mul__(self, weight: Any) -> Objective:
        weight = checks.as_floats("weight", weight)
        checks.shape_is("weight", weight, ())
        terms = tuple(Term(t.quantity, weight * t.weight, t.scale, t.limit, t.sharpness, t.shape, t.name) for t in self.terms)
        return Objective(terms, self.requirements)

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
        found = [r.excess(smooth[offset + i]) for i, r in enumerate(self.requirements)]
        return jnp.stack(found) if found else jnp.zeros((0,), smooth.dtype)


WHAT_IT_IS = (
    "an objective with at least one term: a sum of terms of ij.objectives "
    "(tracking, effort, torque_rate, settle, peak_torque, margin, metric and others), "
    "each with a weight, to which requirements can be added"
)


def checked(objective: Any) -> Objective:
    """The objective that the user composed, if it is one; ValueError otherwise."""
    if isinstance(objective, Requirement):
        objective = Objective((), (objective,))
    if not isinstance(objective, Objective) or not objective.terms:
        raise checks.fail("objective", objective, WHAT_IT_IS, _remedy(objective))
    return objective


def _remedy(given: Any) -> str:
    """How an objective is written, for what a user gave in its place."""
    example = "Such as ij.objectives.tracking() + 0.1 * ij.objectives.effort()."
    if isinstance(given, str):
        call = f"ij.objectives.metric(fold, {given!r})"
        return f"A name is none; a metric is made a term by {call}. {example}"
    if isinstance(given, type) or callable(given):
        return f"Terms are made by a call, with brackets. {example}"
    return example


def is_complete(objective: Objective) -> bool:
    """Whether no scale or limit is missing."""
    return all(t.scale is not None and (t.limit is not None or t.shape == "plain") for t in _composed(objective).terms)


def _composed(objective: Any) -> Objective:
    if not isinstance(objective, Objective):
        raise checks.fail("objective", objective, "an objective", "Such as ij.objectives.tracking().")
    return objective


def complete(objective: Objective, start: Any) -> Objective:
    """The objective with every missing scale and limit set to the value at the start.

    Args:
      objective: as the user composed it.
      start: the exact values of the terms' quantities at the start, (n_terms,).
    """
    values = np.asarray(checks.as_floats("start", start), float)
    checks.shape_is("start", values, (len(_composed(objective).terms),))
    terms = tuple(_completed(t, x) for t, x in zip(objective.terms, values, strict=True))
    return Objective(terms, objective.requirements)


def _completed(t: Term, x: Any) -> Term:
    missing = t.scale is None or (t.limit is None and t.shape == "above")
    if missing and not (np.isfinite(x) and abs(x) > 0):
        raise checks.fail(f"{t.name}: its value at the start", x, "a finite number other than 0", "Give the term a scale of its own.")
    scale = abs(x) if t.scale is None else t.scale
    limit = x if t.limit is None and t.shape == "above" else t.limit
    quantity = t.quantity
    if isinstance(quantity, Peak) and t.scale is None:
        quantity = Peak(scale, quantity.signal, quantity.joints, quantity.after, quantity.smoothing)
    return Term(quantity, t.weight, scale, limit, t.sharpness, t.shape, t.name)


def sharper(objective: Objective, factor: float) -> Objective:
    """The objective with the smoothing of every peak in its terms multiplied by a factor; all else, and the structure, stays."""

    def mended(part: Any) -> Any:
        smoothing = getattr(part.quantity, "smoothing", None)
        if smoothing is None:
            return part
        return dataclasses.replace(part, quantity=dataclasses.replace(part.quantity, smoothing=factor * smoothing))

    objective = _composed(objective)
    return Objective(tuple(map(mended, objective.terms)), objective.requirements)


def is_smoothed(objective: Objective) -> bool:
    """Whether a term of the objective is smoothed, so that `sharper` changes it."""
    return any(getattr(term.quantity, "smoothing", None) is not None for term in _composed(objective).terms)


def has_price_on_torque(objective: Objective) -> bool:
    """Whether a term or a requirement grows with the torque; a metric of the user's own is taken for one that does."""
    quantities = _composed(objective).quantities
    return any(getattr(q, "signal", "torque") in ("torque", "torque_rate") for q in quantities if not _of_the_error(q))


def check_signals(objective: Objective, scenario: Scenario) -> None:
    """Raises ValueError for an objective of what the scenario's runs do not have: margins of velocities or regions, a slack."""
    for quantity in _composed(objective).quantities:
        check_needs("objective", quantity, scenario)


def _of_the_error(quantity: Quantity) -> bool:
    return isinstance(quantity, MetricResult) and isinstance(quantity.fold, Tracking | Settling)


def _one_term(name: str, quantity: Quantity, scale: Any) -> Objective:
    return Objective((Term(quantity, scale=scale, name=name),))


def tracking(*, joints: Any = 1.0, after: Any = 0.0, scale: Any = None) -> Objective:
    """Integral of the squared position error.

        int |e1|^2 dt / scale

    Args:
      joints: weight of each joint's error, one number or (n,).
      after: count from this time on [s].
      scale: in rad^2 s; the value at the starting gains if not given.

    Returns:
      An `Objective`, to be weighted and added to others.

    Raises:
      ValueError: a scale that is not positive.

    Source: the ISE criterion, textbook.
    """
    return _one_term("tracking", TimeIntegral("error", joints, after), scale)


def effort(*, joints: Any = 1.0, scale: Any = None) -> Objective:
    """Integral of the squared torque, int |tau|^2 dt / scale; arguments as `tracking`, scale in N^2 m^2 s."""
    return _one_term("effort", TimeIntegral("torque", joints), scale)


def torque_rate(*, joints: Any = 1.0, scale: Any = None) -> Objective:
    """Integral of the squared rate of the torque, int |tau'|^2 dt / scale; arguments as `tracking`, scale in N^2 m^2/s."""
    return _one_term("torque_rate", TimeIntegral("torque_rate", joints), scale)


def settle(tolerance: Any = 0.01, *, joints: Any = 1.0, scale: Any = 1.0) -> Objective:
    """Time that the joints spend outside a tolerance, the smooth twin of the settling time, sum over joints / scale.

        int sigmoid((|e1| - tolerance) / (0.1 tolerance)) dt / scale

    Args:
      tolerance: on |e1| [rad].
      joints: weight of each joint, one number or (n,).
      scale: in s.
    """
    return _one_term("settle", TimeIntegral("outside", joints, tolerance=tolerance), scale)


def peak_torque(limit: Any = None, *, sharpness: Any = 20.0, smoothing: Any = 0.01, joints: Any = 1.0) -> Objective:
    """Soft penalty on the largest torque above a limit, with the smooth maximum p.

        softplus(sharpness (p / limit - 1)) / sharpness

    Args:
      limit: in N m; the peak at the starting gains if not given.
      sharpness: of the corner at the limit.
      smoothing: of the maximum over time and joints, as a part of the limit.
      joints: weight of each joint's torque, one number or (n,).
    """
    scale: Any = 1.0 if limit is None else limit
    quantity = Peak(scale, "torque", joints, smoothing=smoothing)
    return Objective((Term(quantity, scale=limit, limit=limit, sharpness=sharpness, shape="above", name="peak_torque"),))


def margin(target: Any = 0.05, *, sharpness: Any = 5.0, smoothing: Any = 0.02) -> Objective:
    """Soft penalty on coming nearer to a bound than a target, softplus(sharpness (1 - margin / target)) / sharpness.

    Args:
      target: in rad.
      sharpness, smoothing: as `peak_torque`, relative to the target.
    """
    quantity = Peak(target, "deficit", smoothing=smoothing)
    return Objective((Term(quantity, scale=target, limit=-target, sharpness=sharpness, shape="above", name="margin"),))


def velocity_margin(target: Any = 0.05, *, sharpness: Any = 5.0, smoothing: Any = 0.02) -> Objective:
    """Soft penalty on velocities that come nearer to a bound than a target; as `margin`, in rad/s, for scenarios with `velocity_bounds`."""
    quantity = Peak(target, "velocity_deficit", smoothing=smoothing)
    return Objective((Term(quantity, scale=target, limit=-target, sharpness=sharpness, shape="above", name="velocity_margin"),))


def region_margin(target: Any = 0.02, *, sharpness: Any = 5.0, smoothing: Any = 0.02) -> Objective:
    """Soft penalty on coming nearer to a region's wall than a target; as `margin`, in m, for scenarios with `regions`."""
    quantity = Peak(target, "region_deficit", smoothing=smoothing)
    return Objective((Term(quantity, scale=target, limit=-target, sharpness=sharpness, shape="above", name="region_margin"),))


def metric(fold: Fold, name: str, *, joints: Any = 1.0, scale: Any = None) -> Objective:
    """A result of any metric, `metric(ij.metrics.Tracking(), "iae")` or of a fold of your own, summed over the joints.

        sum_i joints_i m_i / scale

    It has to be differentiable: integrals, rms values and peaks are; a time at which something happens has no slope, and is infinite
    where it does not happen (for the settling time there is `settle`).  `iblf_jax.testing.check_objective` looks at it.

    Args:
      fold: the metric, such as `iblf_jax.metrics.Tracking()`.
      name: which of the fold's results; one of its `units`.
      joints: weight of each of its numbers, one number or as many as the result has.
      scale: in the result's unit; the value at the starting gains if not given.

    Returns:
      An `Objective`, to be weighted and added to others.

    Raises:
      ValueError: something that is not a fold, a name that it does not return, a scale that is not positive.

    Source: design of this package.
    """
    return _one_term(checks.word("name", name, "the name of one of the fold's results"), MetricResult(fold, name, joints), scale)


def error_below(limit: Any, *, after: Any = 0.0, allowed: Any = 0.01, joints: Any = 1.0) -> Requirement:
    """|e1| < limit on every joint from a time on: `error_below(0.01, after=1.0)`.

    Args:
      limit: in rad.
      after: in s.
      allowed: share of perturbed runs that may break it.
      joints: weight of each joint's error; 0 leaves a joint out.
    """
    quantity = Peak(limit, "error", joints, after)
    return Requirement(quantity, limit, limit, allowed, name=f"|e1| < {limit:g} rad" + (f" after {after:g} s" if after else ""))


def peak_torque_below(limit: Any, *, allowed: Any = 0.01, joints: Any = 1.0) -> Requirement:
    """Largest |tau| < limit [N m]; arguments as `error_below`."""
    return Requirement(Peak(limit, "torque", joints), limit, limit, allowed, name=f"peak torque < {limit:g} N m")


def margin_above(limit: Any, *, allowed: Any = 0.01) -> Requirement:
    """Minimum over time and joints of min(q - lower, upper - q) > limit [rad]; `allowed` as `error_below`."""
    return Requirement(Peak(limit, "deficit"), -limit, limit, allowed, name=f"margin > {limit:g} rad")


def velocity_margin_above(limit: Any, *, allowed: Any = 0.01) -> Requirement:
    """Minimum over time and joints of min(q' - v_l, v_u - q') > limit [rad/s], for scenarios with `velocity_bounds`; as `margin_above`."""
    return Requirement(Peak(limit, "velocity_deficit"), -limit, limit, allowed, name=f"velocity margin > {limit:g} rad/s")


def region_margin_above(limit: Any, *, allowed: Any = 0.01) -> Requirement:
    """Minimum over time and regions of the distance to the wall > limit [m], for scenarios with `regions`; as `margin_above`."""
    return Requirement(Peak(limit, "region_deficit"), -limit, limit, allowed, name=f"region margin > {limit:g} m")


def violation_probability_below(probability: Any, *, scale: Any = 0.05) -> Requirement:
    """The probability that a run leaves its bounds or runs away is below a limit.

    In the loss: the margin of the worst `probability` share of the runs (at least of one) is driven above zero.

    Args:
      probability: the limit.
      scale: the margin that matters [rad].
    """
    made = Requirement(Peak(scale, "deficit"), checks.as_floats("limit", 0.0), scale, probability, event="violated")
    return dataclasses.replace(made, name=f"violation probability < {probability:g}")
