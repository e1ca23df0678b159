"""Sensors of all levels of a plant in strict-feedback form."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.sensors._base import (
    LevelSensor,
    Measurement,
    RobotSensor,
    Sensor,
    State,
    contract_of,
    measurement_of,
)
from iblf_jax.control.sensors.unmeasured import Unmeasured
from iblf_jax.core import checks
from iblf_jax.core.attributes import has_members
from iblf_jax.core.pytree import component


class Span(NamedTuple):
    """A part, and its share of the levels and of the normal random numbers."""

    part: Any
    levels: slice
    """Its rows of x."""
    draws: slice
    """Its rows of the normal random numbers."""


@component
class Levels(Sensor):
    """One sensor after the other, for the levels of a plant in their order.

    An ordinary sensor, such as `Encoder`, measures two levels: a position and its velocity.  The
    sensor of a single level, such as `Direct`, measures one.  A flexible joint with encoders on
    link and motor has `Levels((Encoder(...), Encoder(...)))`, and a drive with a current sensor
    `Levels((Encoder(...), Direct(noise=0.01)))`.

    Args:
      parts: any of `iblf_jax.sensors.MEMBERS` or `iblf_jax.sensors.LEVEL_SENSORS`; None for a level
        that is not measured.

    Source: none; the construction is common.
    """

    parts: tuple[Annotated[LevelSensor, RobotSensor], ...]

    def check(self) -> None:
        """Raises ValueError for a part that is no sensor; replaces None by `Unmeasured()`."""
        name, remedy = "Levels.parts", "iblf_jax.sensors.MEMBERS and LEVEL_SENSORS have them."
        if not isinstance(self.parts, tuple | list) or not self.parts:
            raise checks.fail(name, self.parts, "a tuple of sensors", remedy)
        parts = tuple(Unmeasured() if part is None else part for part in self.parts)
        for i, part in enumerate(parts):
            if contract_of(part) is Sensor:
                expected = "a sensor of one or two levels"
                raise checks.fail(f"{name}[{i}]", type(part).__name__, expected, remedy)
            is_of_level = has_members(part, "levels") and part.levels == 1
            base = LevelSensor if is_of_level else RobotSensor
            checks.conforms(f"{name}[{i}]", part, base, remedy)
        object.__setattr__(self, "parts", parts)

    def spans(self) -> Iterator[Span]:
        """The parts with their levels and their normal random numbers."""
        level, draw = 0, 0
        for part in self.parts:
            next_level = level + part.levels
            next_draw = draw + part.draws
            yield Span(part, slice(level, next_level), slice(draw, next_draw))
            level, draw = next_level, next_draw

    @property
    def order(self) -> int:
        """Number of levels."""
        return sum(part.levels for part in self.parts)

    @property
    def measured(self) -> tuple[int, ...]:
        """The levels that are measured, counted from 1."""
        found: list[int] = []
        for span in self.spans():
            if span.part.is_measured:
                found += range(span.levels.start + 1, span.levels.stop + 1)
        return tuple(found)

    @property
    def draws(self) -> int:
        """The normal random numbers of a sample: those of all parts."""
        return sum(part.draws for part in self.parts)

    @property
    def unrounded(self) -> Levels:
        """The same without rounding."""
        parts = tuple(span.part.unrounded for span in self.spans())
        return dataclasses.replace(self, parts=parts)

    @property
    def resolution(self) -> jax.Array:
        """Step of the readings of each level, (r, 1) or (r, n); 0 for a level without rounding."""
        rows: list[Any] = [0.0] * self.order
        for span in self.spans():
            step = span.part.resolution
            if step is not None:
                # A sensor of two levels rounds the position; its velocity follows from it.
                rows[span.levels.start] = step
        return jnp.stack(jnp.broadcast_arrays(*map(jnp.atleast_1d, rows)))

    def advice(self, period: jax.Array) -> list[str]:
        """The warnings of the parts."""
        found: list[str] = []
        for i, part in enumerate(self.parts):
            texts = part.advice(period)
            found += [text.replace("sensor.", f"sensor.parts[{i}].", 1) for text in texts]
        return found

    def init(self, x: jax.Array, period: jax.Array) -> State:
        """The states of the parts."""
        states = []
        for span in self.spans():
            levels = x[span.levels]
            if len(levels) == 1:
                states.append(span.part.init_level(levels[0], period))
            else:
                states.append(span.part.init(levels[0], levels[1], period))
        return tuple(states)

    def measure(
        self, x: jax.Array, normal: jax.Array, period: jax.Array, state: State
    ) -> tuple[Measurement, State]:
        """The measurements of the parts, and their next states."""
        rows: list[jax.Array] = []
        states = []
        for span, before in zip(self.spans(), state, strict=True):
            levels, own = x[span.levels], normal[span.draws]
            if len(levels) == 1:
                y, after = span.part.measure_level(levels[0], own, period, before)
                rows.append(y)
            else:
                found, after = span.part.measure(levels[0], levels[1], own, period, before)
                rows += [found.q, found.dq]
            states.append(after)
        return measurement_of(jnp.stack(rows)), tuple(states)
