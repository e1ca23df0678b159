"""Parameters of a tuning: which leaves vary, within which limits, and in which coordinates.

A tuned number x has a coordinate z in which the loss is better conditioned: z = log x for a gain
that is positive, z = x otherwise.  Limits on x are limits on z, which are the box of SQP.  The
solvers of optax have no bounds, so they use an unbounded w that is squashed into the box,

    z = z_low + (z_high - z_low) sigmoid(w)                      with two limits,
    z = z_low + softplus(w)   or   z = z_high - softplus(w)      with one limit.

Default limits are those of `ranges`.

The sampling period is a whole number of time steps, so the loss is constant between two of them:
its coordinate z is rounded, the derivative by it is 0, and the loss has to be compared at its
multiples by values (`along`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.core import checks, notices
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.draws import check_paths
from iblf_jax.tuning.ranges import (
    AS_GIVEN,
    PERIOD,
    WHOLE_TOLERANCE,
    End,
    default_highs,
    default_lows,
)

LIMIT_DISTANCE = 1e-3
"""Smallest distance of the start of a squashed coordinate from a limit, relative to the box."""

PERIOD_NOTICE = (
    f"{PERIOD} is a whole number of steps dt, so that the loss has no derivative by it: periods are"
    " compared by values only, and a search that follows derivatives keeps the period that it"
    " begins with."
)


class Tunable(NamedTuple):
    """A leaf to tune; made by `tunable`."""

    path: str
    low: Any = None
    high: Any = None
    tied: bool = False
    scale: str | None = None


class Block(NamedTuple):
    """One leaf's share of the coordinates; static."""

    path: str
    shape: tuple[int, ...]
    start: int
    size: int
    log: bool
    step: float = 0.0
    """The leaf is a whole multiple of this; 0 if it takes any value."""


@partial(
    jax.tree_util.register_dataclass, data_fields=("z", "low", "high"), meta_fields=("reasons",)
)
@dataclasses.dataclass(frozen=True, eq=False)
class Box:
    """Start and range of a tuning, in the coordinates z, (p,) each."""

    z: np.ndarray
    low: np.ndarray
    high: np.ndarray
    reasons: tuple[tuple[str, str], ...] = ()
    """Why the lower and the upper end of each coordinate are there, in words."""


def _own_limit(path: str, side: str, value: ArrayLike | None) -> jax.Array | None:
    """A limit of a parameter as an array; None where there is none of the user's own."""
    if value is None:
        return None
    name = f"tunable({path!r}): {side}"
    limit = checks.as_floats(name, value)
    if limit.size == 0:
        raise checks.fail(name, value, "at least one number")
    if bool(jnp.any(jnp.isnan(limit))):
        raise checks.fail(name, value, "numbers", "Replace the NaN entries.")
    return limit


def tunable(
    path: str,
    low: ArrayLike | None = None,
    high: ArrayLike | None = None,
    *,
    tied: bool = False,
    scale: str | None = None,
) -> Tunable:
    """A leaf to tune, with limits of one's own.

        z = log x ("log") or z = x ("linear"),   low <= x <= high

    Args:
      path: of the leaf or entry, such as "controller.K2" or "controller.K2[0]".
      low, high: limits in the leaf's unit, one number or one an entry; the default ones if not
        given.
      tied: one number for all joints rather than one each.
      scale: "log" or "linear"; "log" for leaves that are positive, if not given.

    Returns:
      An entry for the list of parameters of `tune`.

    Raises:
      ValueError: an unknown scale, or low >= high.

    Source: design of this package.
    """
    if scale is not None:
        checks.one_of("tunable: scale", scale, ("log", "linear"))
    paths.parse(path)
    low, high = _own_limit(path, "low", low), _own_limit(path, "high", high)
    try:
        is_range = low is None or high is None or bool(jnp.all(low < high))
    except (TypeError, ValueError):  # shapes that do not fit each other
        is_range = False
    if not is_range:
        remedy = "Exchange or widen them."
        raise checks.fail(f"tunable({path!r})", (low, high), "low < high", remedy)
    return Tunable(path, low, high, checks.boolean("tunable: tied", tied), scale)


def as_tunable(name: str, given: object) -> Tunable:
    """An entry of a user's list of parameters; `name` is that of the entry in messages."""
    if isinstance(given, str):
        return Tunable(given)
    if isinstance(given, Tunable):
        return given
    remedy = 'Such as "controller.K2" or ij.tunable("controller.K2", 5.0, 50.0).'
    expected = "the path of a leaf, or ij.tunable(path, low, high)"
    raise checks.fail(name, given, expected, remedy)


def layout(
    scenario: Scenario, parameters: Sequence[str | Tunable], dt: float, method: str
) -> tuple[tuple[Block, ...], Box]:
    """The coordinates of a list of parameters: blocks, and the box with the start in it.

    Args:
      scenario: canonical.
      parameters: paths or `Tunable`s.
      dt, method: of the runs, for the default limits (`ranges`).

    Raises:
      ValueError: an unknown or overlapping path, a start that is not finite, limits that exclude
        the start or are not admissible.
    """
    given = checks.nonempty_list("parameters", parameters, '["controller.k1", "controller.K2"]')
    tunables = [as_tunable(f"parameters[{i}]", x) for i, x in enumerate(given)]
    check_paths(scenario, [x.path for x in tunables], "parameters")
    starts = {item.path: _start_of(scenario, item) for item in tunables}
    lows = _starts_without(starts, [x.path for x in tunables if x.low is None])
    highs = _starts_without(starts, [x.path for x in tunables if x.high is None])
    default_ends = (
        default_lows(scenario, lows, dt, method),
        default_highs(scenario, highs, dt, method),
    )
    blocks: list[Block] = []
    parts = []
    reasons: list[tuple[str, str]] = []
    for item in tunables:
        start = starts[item.path]
        step = dt if item.path == PERIOD else 0.0
        low, high = _ends_of(item, start.value, step, default_ends)
        size = 1 if item.tied else start.value.size
        blocks.append(Block(item.path, start.value.shape, len(reasons), size, start.log, step))
        numbers = (start.value, low.value, high.value)
        parts.append([_coordinate(x.reshape(-1)[:size], start.log) for x in numbers])
        reasons += [(low.reason, high.reason)] * size
    if by_values(tuple(blocks)):
        notices.warn(PERIOD_NOTICE)
    z, lowest, highest = (np.concatenate(x) for x in zip(*parts, strict=True))
    return tuple(blocks), Box(z, lowest, highest, tuple(reasons))


class Start(NamedTuple):
    """The start of a leaf."""

    value: np.ndarray
    log: bool
    """Whether its coordinate is a logarithm."""


def _start_of(scenario: Scenario, item: Tunable) -> Start:
    """Value of a leaf at the start, and whether its coordinate is a logarithm."""
    value = np.asarray(paths.get(scenario, item.path), float)
    if not np.all(np.isfinite(value)):
        remedy = f'Such as ij.with_parameters(scenario, {{"{item.path}": 1.0}}).'
        raise checks.fail(item.path, value, "finite numbers that tuning can start from", remedy)
    log = paths.sign_at(scenario, item.path) == "positive"
    if item.scale:
        log = item.scale == "log"
    if log and not np.all(value > 0):
        expected = "values > 0 for a logarithmic scale"
        raise checks.fail(item.path, value, expected, 'Use scale="linear".')
    if item.tied and not np.all(value == value.flat[0]):
        common = np.exp(np.mean(np.log(value))) if log else np.mean(value)
        value = np.full_like(value, common)
    return Start(value, log)


def _starts_without(starts: dict[str, Start], names: list[str]) -> dict[str, np.ndarray]:
    """Path -> start of the leaves that have no limit of the user's own."""
    return {path: starts[path].value for path in names}


def _ends_of(
    item: Tunable, start: np.ndarray, step: float, default_ends: tuple[dict[str, End], ...]
) -> tuple[End, End]:
    """The lower and the upper end of a leaf's range, one number for each entry.

    A leaf with one number for all joints keeps the limits of every joint.
    """
    ends = []
    for name, given, defaults, tightest in (
        ("low", item.low, default_ends[0], np.max),
        ("high", item.high, default_ends[1], np.min),
    ):
        end = defaults.get(item.path, End(given, AS_GIVEN))
        limit = _limit(item, name, end.value, start)
        if item.tied:
            limit = np.full_like(limit, tightest(limit))
        ends.append(end._replace(value=limit))
    low, high = ends
    if step:
        # the outermost multiples of the time step within the range
        first = np.maximum(np.ceil(low.value / step - WHOLE_TOLERANCE), 1.0)
        last = np.floor(high.value / step + WHOLE_TOLERANCE)
        low = low._replace(value=first * step)
        high = high._replace(value=last * step)
    if np.all((low.value <= start) & (start <= high.value) & (low.value < high.value)):
        return low, high
    expected = f"a start between its limits {low.value.tolist()} and {high.value.tolist()}"
    if step:
        expected += f", and at least two multiples of dt = {step:g} s between these"
    remedy = "Widen the limits."
    if AS_GIVEN not in (low.reason, high.reason):
        remedy = f"Give limits of your own; the lower one is {low.reason}, the upper {high.reason}."
    raise checks.fail(f"tunable({item.path!r})", start, expected, remedy)


def _limit(item: Tunable, name: str, given: ArrayLike, value: np.ndarray) -> np.ndarray:
    field = f"tunable({item.path!r}): {name}"
    limit = np.asarray(checks.as_floats(field, given), float)
    if limit.shape not in ((), value.shape):
        raise checks.fail(field, given, f"one number, or shape {value.shape}")
    return np.broadcast_to(limit, value.shape)


def _coordinate(x: np.ndarray, log: bool) -> np.ndarray:
    if not log:
        return x
    with np.errstate(divide="ignore"):
        return np.log(np.maximum(x, 0.0))


def values_at(blocks: tuple[Block, ...], z: jax.Array) -> dict[str, jax.Array]:
    """Path -> value of the leaf at coordinates z, (p,); differentiable, with the derivative 0 of a
    constant where the leaf is a multiple of a step.
    """
    values = {}
    for block in blocks:
        part = z[block.start : block.start + block.size]
        if block.log:
            part = jnp.exp(part)
        if block.step:
            part = block.step * jnp.maximum(jnp.round(part / block.step), 1.0)
        if block.size == 1:
            part = jnp.broadcast_to(part[0], block.shape)
        values[block.path] = part.reshape(block.shape)
    return values


def in_units(blocks: tuple[Block, ...], z: np.ndarray) -> np.ndarray:
    """Coordinates z, (..., p), as numbers in the units of their leaves."""
    log = np.concatenate([np.full(b.size, b.log) for b in blocks])
    numbers = np.where(log, np.exp(np.where(log, z, 0.0)), z)
    step = np.concatenate([np.full(b.size, b.step) for b in blocks])
    divisor = np.where(step > 0, step, 1.0)
    multiples = divisor * np.maximum(np.round(numbers / divisor), 1.0)
    return np.where(step > 0, multiples, numbers)


def by_values(blocks: tuple[Block, ...]) -> list[int]:
    """The coordinates by which the loss has no derivative: the leaf is a multiple of a step, so
    that the loss is constant between two of them.
    """
    return [block.start for block in blocks if block.step]


def along(blocks: tuple[Block, ...], box: Box, z: np.ndarray, most: int) -> np.ndarray:
    """Points at which every coordinate of `by_values` takes other multiples within its range, with
    all else as at z: (k, p), the nearest multiples first, at most `most` for each coordinate.
    """
    points = [np.empty((0, len(z)))]
    for block in blocks:
        if not block.step:
            continue
        i = block.start
        first, here, last = (
            round(float(in_units(blocks, x)[i]) / block.step) for x in (box.low, z, box.high)
        )
        every = np.arange(first, last + 1, dtype=float)
        others = every[every != here]
        nearest = np.argsort(np.abs(np.log(others / here)), kind="stable")
        steps = others[nearest[:most]]
        rows = np.repeat(z[None], len(steps), axis=0)
        rows[:, i] = _coordinate(steps * block.step, block.log)
        points.append(rows)
    return np.concatenate(points)


def names_of(blocks: tuple[Block, ...]) -> list[str]:
    """The name of each coordinate: "controller.K2[0]", or the path if it is tied or has one
    entry.
    """
    names = []
    for block in blocks:
        indices = np.ndindex(block.shape) if block.size > 1 else [()]
        names += [block.path + "".join(f"[{i}]" for i in index) for index in indices]
    return names


def squash(w: jax.Array, box: Box) -> jax.Array:
    """Coordinates z inside the box for any real w, (p,)."""
    low, high = jnp.asarray(box.low), jnp.asarray(box.high)
    has_low, has_high = jnp.isfinite(low), jnp.isfinite(high)
    low = jnp.where(has_low, low, 0.0)
    high = jnp.where(has_high, high, 0.0)
    with_both = low + (high - low) * jax.nn.sigmoid(w)
    with_low = low + jax.nn.softplus(w)
    with_high = high - jax.nn.softplus(w)
    conditions = [has_low & has_high, has_low, has_high]
    return jnp.select(conditions, [with_both, with_low, with_high], w)


def squashed(box: Box, w: np.ndarray) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Coordinates z of rows w, (S, p), and the function from gradients by z to gradients by w."""
    z, pull = jax.vjp(jax.vmap(partial(squash, box=box)), jnp.asarray(w))
    return np.asarray(z), lambda g: np.asarray(pull(jnp.asarray(g, z.dtype))[0])


def unsquash(z: np.ndarray, box: Box) -> np.ndarray:
    """The w whose `squash` is z; a z at a limit is moved inside by LIMIT_DISTANCE."""
    w = np.array(z, float)
    for i, (x, low, high) in enumerate(zip(w, box.low, box.high, strict=True)):
        if np.isfinite(low) and np.isfinite(high):
            share = np.clip((x - low) / (high - low), LIMIT_DISTANCE, 1 - LIMIT_DISTANCE)
            w[i] = np.log(share / (1 - share))
        elif np.isfinite(low):
            w[i] = np.log(np.expm1(max(x - low, LIMIT_DISTANCE)))
        elif np.isfinite(high):
            w[i] = np.log(np.expm1(max(high - x, LIMIT_DISTANCE)))
    return w
