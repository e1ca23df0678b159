"""The checkers for references, sides of the bounds, regions, and disturbances."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.testing._contract import (
    GRID,
    Findings,
    abstract_shape,
    call_has_shape,
    check_function,
    examine,
    find_jump,
    has_shape,
    in_dtype,
    shape_of,
)
from iblf_jax.testing.joints import (
    arm_of,
    check_joints_of,
    check_number,
    examine_joints,
    fitted_to,
    number_of_joints,
)
from iblf_jax.world.bounds import Side
from iblf_jax.world.disturbances import Disturbance
from iblf_jax.world.references import Reference
from iblf_jax.world.regions import Region
from iblf_jax.world.robots import Robot


def rates(
    function: Callable[[jax.Array], jax.Array], t: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A function of time with its first and second derivative, by jvp."""

    def first(t):
        return jax.jvp(function, (t,), (jnp.ones_like(t),))

    (value, rate), (_, second) = jax.jvp(first, (t,), (jnp.ones_like(t),))
    return value, rate, second


def _smooth_in_time(
    findings: Findings, label: str, function: Callable[[jax.Array], jax.Array], duration: float
) -> None:
    """Requires on [0, duration] a finite value, rate and second rate, the first two continuous."""
    names = (label, f"the rate of {label}", f"the second rate of {label}")
    at_times = jax.jit(jax.vmap(lambda t: rates(function, t)))
    times = np.linspace(0.0, duration, GRID)
    for name, numbers in zip(names, at_times(times), strict=True):
        finite = np.isfinite(np.asarray(numbers).reshape(GRID, -1)).all(axis=1)
        if not finite.all():
            findings.add(
                f"{name} is not finite at t = {times[np.argmin(finite)]:g} s",
                "The law differentiates it twice; look at sqrt, division and clip",
            )
    findings.stop_if_any()
    for part, name in enumerate(names[:2]):

        def values(times, part=part):
            return at_times(times)[part]

        jump = find_jump(values, 0.0, duration)
        if jump is not None:
            remedy = "It must be twice differentiable: blend the pieces smoothly"
            findings.add(f"{name} jumps at t = {jump:.6g} s", remedy)


def check_reference(reference: object, *, n: int | None = None, duration: float = 20.0) -> None:
    """Checks a reference: shape, derivatives, float32, and q_d, q_d', q_d" finite, the first two
    continuous.

    Args:
      reference: an instance.
      n: number of joints; that of its leaves if not given.
      duration: length of the tested time interval [s].

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: an invalid argument.
    """
    duration = checks.positive_number("duration", duration, "s")
    with examine_joints(reference, Reference, n, "reference") as (findings, fitted, joints):
        t = jnp.asarray(0.3217 * duration)
        got = shape_of(findings, "position(t)", fitted.position, t)
        expected = (joints,)
        if n is None and len(got.shape) == 1:
            expected = got.shape
        has_shape(findings, "position(t)", got, expected)
        findings.stop_if_any()

        def outputs(reference, t):
            names = ("position(t)", "its rate", "its second rate")
            return dict(zip(names, rates(reference.position, t), strict=True))

        check_function(findings, outputs, fitted, (t,))
        _smooth_in_time(findings, "position(t)", fitted.position, duration)


def check_side(side: object, *, n: int | None = None, duration: float = 20.0) -> None:
    """Checks one side of the bounds: shape, derivatives, float32, and the bound with its rates
    finite and continuous.

    Args:
      side: an instance.
      n: number of joints; that of its leaves if not given.
      duration: length of the tested time interval [s].

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: an invalid argument.
    """
    duration = checks.positive_number("duration", duration, "s")
    with examine_joints(side, Side, n, "side") as (findings, fitted, joints):
        t = jnp.asarray(0.3217 * duration)
        q_d = jnp.linspace(0.3, 0.7, joints)
        call_has_shape(findings, "at(t, q_d)", fitted.at, (t, q_d), (joints,))
        findings.stop_if_any()

        def along(side, t, q_d):
            return side.at(t, q_d + 0.1 * jnp.sin(t))

        def outputs(side, t, q_d):
            bound = rates(lambda t: along(side, t, q_d), t)
            return dict(zip(("at(t, q_d)", "its rate", "its second rate"), bound, strict=True))

        check_function(findings, outputs, fitted, (t, q_d))
        _smooth_in_time(findings, "at(t, q_d)", lambda t: along(fitted, t, q_d), duration)


POINTS = 64
"""Number of points at which a region is tested."""


def check_region(region: Region, *, dimensions: int | None = None, size: float = 2.0) -> None:
    """Checks a region: shapes, derivatives, float32, a distance of slope 1 at most, and a level
    with the same sign and, at the boundary, the same slope.

    Args:
      region: an instance.
      dimensions: 2 in the plane, 3 in space; the dimension that it accepts if not given.
      size: half the width of the tested cube around the origin of the base [m].

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: an invalid argument.
    """
    size = checks.positive_number("size", size, "m")
    known = [2, 3]
    if dimensions is not None:
        known = [checks.positive_integer("dimensions", dimensions, least=2, most=3)]
    with examine(region, "Region", Region) as findings:
        findings.require(
            isinstance(region.point, str | int),
            f"point is {region.point!r}",
            'It must be "tip", or a joint\'s name or number, in a static field',
        )
        fitted = in_dtype(region, "float64")
        d = next((d for d in known if _accepts(fitted, d)), known[-1])
        rng = np.random.default_rng(3)
        points = rng.uniform(-size, size, (POINTS, d))
        call_has_shape(findings, "distance(x)", fitted.distance, (points[0],), ())
        call_has_shape(findings, "level(x)", fitted.level, (points[0],), ())
        findings.stop_if_any()

        def outputs(region, x):
            return {
                "distance(x)": region.distance(x),
                "level(x)": region.level(x),
                "the slope of level(x)": jax.grad(region.level)(x),
            }

        check_function(findings, outputs, fitted, (points[0],))
        _distance_and_level(findings, fitted, points)


def _distance_and_level(findings: Findings, region: Region, points: np.ndarray) -> None:
    """Requires a distance of slope 1 at most, and a level with the same sign and boundary."""
    distance_and_slope = jax.jit(jax.vmap(jax.value_and_grad(region.distance)))
    level_and_slope = jax.jit(jax.vmap(jax.value_and_grad(region.level)))
    distance, slope = map(np.asarray, distance_and_slope(points))
    square = np.sum(slope**2, axis=1)
    steepest = float(np.sqrt(np.max(square)))
    findings.require(
        steepest < 1 + 1e-6,
        f"distance(x) changes by {steepest:.4g} m per metre",
        "It must be a distance: 1 at most",
    )
    # A step along the slope by the distance leads from a point to the boundary.
    projected = points - slope * (distance / np.maximum(square, 1e-12))[:, None]
    level, level_slope = map(np.asarray, level_and_slope(projected))
    rest, rest_slope = map(np.asarray, distance_and_slope(projected))
    on_boundary = np.abs(rest) < 1e-6
    same_value = np.allclose(level[on_boundary], rest[on_boundary], atol=1e-5)
    same_slope = np.allclose(level_slope[on_boundary], rest_slope[on_boundary], atol=1e-4)
    findings.require(
        same_value and same_slope,
        "level(x) and distance(x) differ in their boundary, or in their slope at it",
        "Both are 0 there, of slope 1",
    )
    findings.require(
        np.all((np.asarray(level_and_slope(points)[0]) > 0) == (distance > 0)),
        "level(x) and distance(x) differ in sign",
        "Positive is inside",
    )


def _accepts(region: Region, dimensions: int) -> bool:
    """Whether a region accepts points of the plane (2) or of space (3)."""
    try:
        return jax.eval_shape(region.distance, jnp.zeros(dimensions)).shape == ()
    except Exception:  # A shape that does not fit may raise any exception.
        return False


def check_disturbance(
    disturbance: Disturbance,
    *,
    plant: Robot | None = None,
    model: Robot | None = None,
    duration: float = 20.0,
    n: int | None = None,
) -> None:
    """Checks a disturbance: shapes, derivatives, float32, and that every jump is declared in
    `jump_times`.

    Args:
      disturbance: an instance.
      plant: the robot that it acts on; an arm of n joints if not given.
      model: the robot that the law knows; the plant if not given.
      duration: length of the tested time interval [s].
      n: number of joints, if no plant is given; that of its leaves if not given, 2 if these are
        scalars.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: an invalid argument, or a plant with another number of joints than `n`.
    """
    check_number(n)
    duration = checks.positive_number("duration", duration, "s")
    for name, robot in (("plant", plant), ("model", model)):
        if robot is not None:
            checks.conforms(name, robot, Robot)
    with examine(disturbance, "Disturbance", Disturbance) as findings:
        if plant is None:
            plant = model
        if plant is None:
            plant = arm_of(number_of_joints(findings, disturbance, n))
        check_joints_of(n, plant, "plant")
        plant = in_dtype(plant, "float64")
        model = plant if model is None else in_dtype(model, "float64")
        n, t = plant.n, jnp.asarray(0.3217 * duration)
        fitted = fitted_to(in_dtype(disturbance, "float64"), n, "disturbance")
        rng = np.random.default_rng(2)
        q, dq = jnp.asarray(rng.uniform(-1, 1, (2, n)))
        label = "torque(t, q, dq, plant, model)"
        arguments = (t, q, dq, plant, model)
        call_has_shape(findings, label, fitted.torque, arguments, (n,))
        jumps = shape_of(findings, "jump_times()", fitted.jump_times)
        one_axis = abstract_shape(jumps)[:1] or (0,)
        has_shape(findings, "jump_times()", jumps, one_axis)
        findings.stop_if_any()
        check_function(findings, lambda d, *args: {label: d.torque(*args)}, fitted, arguments)
        times = np.asarray(fitted.jump_times(), float)
        remedy = "Return finite times, or an empty array"
        findings.require(np.all(np.isfinite(times)), f"jump_times() has {times}", remedy)
        findings.stop_if_any()
        at_times = jax.jit(jax.vmap(lambda t: fitted.torque(t, *arguments[1:])))
        jump = find_jump(at_times, 0.0, duration, tuple(times))
        if jump is not None:
            remedy = "Return that time in jump_times(): steps of a run are divided there"
            problem = f"the torque jumps at t = {jump:.6g} s, which is not one of jump_times()"
            findings.add(problem, remedy)
