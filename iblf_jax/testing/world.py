"""The checkers for references, sides of the bounds, regions, and disturbances."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.testing._contract import (
    Findings,
    examine,
    find_jump,
    has_shape,
    in_dtype,
    probe,
    shape_of,
)
from iblf_jax.testing.joints import arm_of, check_number, fitted_to, joints_of, number_of_joints
from iblf_jax.world.bounds import Side
from iblf_jax.world.disturbances import Disturbance
from iblf_jax.world.references import Reference
from iblf_jax.world.regions import Region
from iblf_jax.world.robots import Robot


def rates(function: Any, t: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A function of time with its first and second derivative, by jvp."""

    def first(t):
        return jax.jvp(function, (t,), (jnp.ones_like(t),))

    (value, rate), (_, second) = jax.jvp(first, (t,), (jnp.ones_like(t),))
    return value, rate, second


def _surroundings(n: int | None, duration: float) -> tuple[int | None, float]:
    """Number of joints, if given, and duration of a checker's arguments; ValueError where they are
    none.
    """
    check_number(n)
    return n, checks.positive_number("duration", duration, "s")


def _smooth_in_time(findings: Findings, label: str, function: Any, duration: float) -> None:
    """Value, rate and second rate are finite, the first two without jumps, on [0, duration]."""
    times = jnp.linspace(0.0, duration, 401)
    value, rate, second = jax.jit(jax.vmap(lambda t: rates(function, t)))(times)
    for name, numbers in (
        (label, value),
        (f"the rate of {label}", rate),
        (f"the second rate of {label}", second),
    ):
        bad = np.flatnonzero(
            ~np.all(np.isfinite(np.asarray(numbers).reshape(times.size, -1)), axis=1)
        )
        where = f"t = {float(times[bad[0]]):g} s" if bad.size else ""
        findings.require(
            bad.size == 0,
            f"{name} is not finite at {where}",
            "The law differentiates it twice; mind sqrt, division and clip",
        )
    findings.stop_if_any()
    for name, part in ((label, 0), (f"the rate of {label}", 1)):
        jump = find_jump(lambda t, part=part: rates(function, t)[part], 0.0, duration)
        at = "" if jump is None else f"{jump:.6g}"
        findings.require(
            jump is None,
            f"{name} jumps at t = {at} s",
            "It must be twice differentiable: blend the pieces smoothly",
        )


def check_reference(reference: Any, *, n: int | None = None, duration: float = 20.0) -> None:
    """Checks a reference: shape, derivatives, float32, and q_d, q_d', q_d" finite, the first two
    continuous.

    Args:
      reference: an instance.
      n: number of joints; found from its leaves if not given.
      duration: stretch of time to look at [s].

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: an argument beside the reference that is none.
    """
    n, duration = _surroundings(n, duration)
    with examine(reference, "Reference", Reference) as findings:
        t = jnp.asarray(0.3217 * duration)
        fitted = fitted_to(
            in_dtype(reference, "float64"), number_of_joints(findings, reference, n), "reference"
        )
        got = shape_of(findings, "position(t)", fitted.position, t)
        expected = (
            got.shape
            if n is None and got is not None and len(got.shape) == 1
            else (n or joints_of(reference),)
        )
        has_shape(findings, "position(t)", got, expected)
        findings.stop_if_any()
        probe(
            findings,
            lambda r, t: dict(
                zip(
                    ("position(t)", "its rate", "its second rate"),
                    rates(r.position, t),
                    strict=True,
                )
            ),
            fitted,
            (t,),
        )
        _smooth_in_time(findings, "position(t)", fitted.position, duration)


def check_side(side: Any, *, n: int | None = None, duration: float = 20.0) -> None:
    """Checks one side of the bounds: shape, derivatives, float32, and the bound with its rates
    finite and continuous.

    Args:
      side: an instance.
      n: number of joints; found from its leaves if not given.
      duration: stretch of time to look at [s].

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: an argument beside the side that is none.
    """
    n, duration = _surroundings(n, duration)
    with examine(side, "Side", Side) as findings:
        n = number_of_joints(findings, side, n)
        t = jnp.asarray(0.3217 * duration)
        fitted = fitted_to(in_dtype(side, "float64"), n, "side")
        q_d = jnp.linspace(0.3, 0.7, n)
        has_shape(findings, "at(t, q_d)", shape_of(findings, "at(t, q_d)", fitted.at, t, q_d), (n,))
        findings.stop_if_any()

        def along(side, t, q_d):
            return side.at(t, q_d + 0.1 * jnp.sin(t))

        def outputs(side, t, q_d):
            bound = rates(lambda t: along(side, t, q_d), t)
            return dict(zip(("at(t, q_d)", "its rate", "its second rate"), bound, strict=True))

        probe(findings, outputs, fitted, (t, q_d))
        _smooth_in_time(findings, "at(t, q_d)", lambda t: along(fitted, t, q_d), duration)


POINTS = 64
"""Where a region is looked at."""


def check_region(region: Any, *, dimensions: int | None = None, size: float = 2.0) -> None:
    """Checks a region: shapes, derivatives, float32, a distance that is one, and a level with its
    sign and, at the wall, its slope.

    Args:
      region: an instance.
      dimensions: 2 in the plane, 3 in space; whichever it takes if not given.
      size: of the surroundings of the base's origin to look at [m].

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: an argument beside the region that is none.
    """
    size = checks.positive_number("size", size, "m")
    known = (
        (2, 3)
        if dimensions is None
        else (checks.positive_integer("dimensions", dimensions, least=2, most=3),)
    )
    with examine(region, "Region", Region) as findings:
        ok = isinstance(region.point, str | int)
        findings.require(
            ok,
            f"point is {region.point!r}",
            'It must be "tip", or a joint\'s name or number, in a static field',
        )
        made = in_dtype(region, "float64")
        d = next((d for d in known if _takes(made, d)), known[-1])
        rng = np.random.default_rng(3)
        points = jnp.asarray(rng.uniform(-size, size, (POINTS, d)))
        for label, function in (("distance(x)", made.distance), ("level(x)", made.level)):
            has_shape(findings, label, shape_of(findings, label, function, points[0]), ())
        findings.stop_if_any()

        def outputs(region, x):
            return {
                "distance(x)": region.distance(x),
                "level(x)": region.level(x),
                "the slope of level(x)": jax.grad(region.level)(x),
            }

        probe(findings, outputs, made, (points[0],))
        distance, slope = jax.jit(jax.vmap(jax.value_and_grad(made.distance)))(points)
        steep = float(jnp.max(jnp.sqrt(jnp.sum(slope**2, axis=1))))
        findings.require(
            steep < 1 + 1e-6,
            f"distance(x) changes by {steep:.4g} m a metre",
            "It must be a distance: 1 at most",
        )
        # At the wall: along the slope from each point by its distance.
        wall = points - slope * (distance / jnp.maximum(jnp.sum(slope**2, axis=1), 1e-12))[:, None]
        left, turned = jax.jit(jax.vmap(jax.value_and_grad(made.level)))(wall)
        found, along = jax.jit(jax.vmap(jax.value_and_grad(made.distance)))(wall)
        there = np.asarray(jnp.abs(found) < 1e-6)
        same = np.allclose(left[there], found[there], atol=1e-5) and np.allclose(
            turned[there], along[there], atol=1e-4
        )
        findings.require(
            same,
            "level(x) has another wall, or another slope at it, than distance(x)",
            "Both are 0 there, of slope 1",
        )
        level = jax.jit(jax.vmap(made.level))(points)
        findings.require(
            bool(jnp.all((level > 0) == (distance > 0))),
            "level(x) and distance(x) differ in sign",
            "Positive is inside",
        )


def _takes(region: Any, dimensions: int) -> bool:
    """Whether a region is one of the plane (2) or of space (3)."""
    try:
        return jax.eval_shape(region.distance, jnp.zeros(dimensions)).shape == ()
    except Exception:  # whatever a shape that does not fit raises
        return False


def check_disturbance(
    disturbance: Any,
    *,
    plant: Any = None,
    model: Any = None,
    duration: float = 20.0,
    n: int | None = None,
) -> None:
    """Checks a disturbance: shapes, derivatives, float32, and that every jump is declared in
    `jump_times`.

    Args:
      disturbance: an instance.
      plant: robot that it acts on; an arm of n joints if not given.
      model: what the law knows of it; the plant if not given.
      duration: stretch of time to look at [s].
      n: number of joints, if no plant is given; found from its leaves if not given, 2 if these are
        scalars.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: an argument beside the disturbance that is none, or a plant with another number of
        joints than `n`.
    """
    n, duration = _surroundings(n, duration)
    for name, robot in (("plant", plant), ("model", model)):
        if robot is not None:
            checks.conforms(name, robot, Robot)
    with examine(disturbance, "Disturbance", Disturbance) as findings:
        if plant is None:
            plant = (
                model if model is not None else arm_of(number_of_joints(findings, disturbance, n))
            )
        if n not in (None, plant.n):
            raise checks.fail(
                "n", n, f"{plant.n}, the joints of the plant", "Leave one of the two out."
            )
        plant = in_dtype(plant, "float64")
        model = plant if model is None else in_dtype(model, "float64")
        n, t = plant.n, jnp.asarray(0.3217 * duration)
        fitted = fitted_to(in_dtype(disturbance, "float64"), n, "disturbance")
        rng = np.random.default_rng(2)
        q, dq = jnp.asarray(rng.uniform(-1, 1, (2, n)))
        label = "torque(t, q, dq, plant, model)"
        has_shape(
            findings, label, shape_of(findings, label, fitted.torque, t, q, dq, plant, model), (n,)
        )
        jumps = shape_of(findings, "jump_times()", fitted.jump_times)
        if jumps is not None:
            has_shape(
                findings,
                "jump_times()",
                jumps,
                (jumps.shape[0],) if getattr(jumps, "ndim", 0) else (0,),
            )
        findings.stop_if_any()
        probe(findings, lambda d, *args: {label: d.torque(*args)}, fitted, (t, q, dq, plant, model))
        known = np.asarray(fitted.jump_times(), float)
        findings.require(
            np.all(np.isfinite(known)),
            f"jump_times() has {known}",
            "Give finite times, or an empty array",
        )
        findings.stop_if_any()
        jump = find_jump(
            lambda t: fitted.torque(t, q, dq, plant, model), 0.0, duration, tuple(known)
        )
        at = "" if jump is None else f"{jump:.6g}"
        remedy = "Return that time in jump_times(): steps of a run are divided there"
        findings.require(
            jump is None, f"the torque jumps at t = {at} s, which jump_times() does not say", remedy
        )
