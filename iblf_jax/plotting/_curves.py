"""Prepares runs for drawing: validates them, moves them to the host, truncates and thins them.

The simulator freezes a run whose state diverges; figures draw it up to that sample.  Thinning
loses no peak: every interval of the time axis keeps its first, lowest and highest sample.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.actuators import Ideal as IdealActuator
from iblf_jax.control.controllers.adaptive_parameters import (
    AdaptiveParameters,
    AdaptiveState,
    adapting_part,
)
from iblf_jax.control.sensors import Ideal as IdealSensor
from iblf_jax.core import checks
from iblf_jax.core.attributes import attributes
from iblf_jax.core.pytree import is_absent
from iblf_jax.core.status import FAILED, Status, describe
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.signals import has
from iblf_jax.simulation.units import status_words
from iblf_jax.world import plants
from iblf_jax.world.plants import Plant
from iblf_jax.world.robots import Robot

POINTS = 2400
"""Approximate number of points that a line of a figure can resolve."""

DERIVED = {
    "error_lower": lambda run: np.asarray(run.lower) - np.asarray(run.q_d),
    "error_upper": lambda run: np.asarray(run.upper) - np.asarray(run.q_d),
    "xi_lower": lambda run: -np.ones(run.q.shape),
    "xi_upper": lambda run: np.ones(run.q.shape),
    "estimate_error": (
        lambda run: np.asarray(run.disturbance) - np.asarray(run.disturbance_estimate)
    ),
    "measured_q": lambda run: _received(run, 0),
    "measured_dq": lambda run: _received(run, 1),
    "theta": lambda run: _adapting(run)[1].theta,
    "theta_lower": lambda run: _repeated(run, _adapting(run)[0].lower),
    "theta_upper": lambda run: _repeated(run, _adapting(run)[0].upper),
    "theta_of_plant": lambda run: _parameters_of_plant(run),
    "region_boundary": lambda run: np.zeros(np.shape(run.region_margin)),
}
"""Signals computed from those of a Rollout: the bounds -k_l and k_u of e1, the bounds of xi, the
error f - f_hat, the levels that the law received, the parameters that a law adapts with their
bounds and those of the plant, and the boundary of a region."""


def _adapting(run: Rollout) -> tuple[AdaptiveParameters, AdaptiveState]:
    """The law of a run that adapts parameters, and its state along the run."""
    found = adapting_part(run.scenario.controller, run.controller_state)
    if found is None:
        expected = "runs of a law that adapts parameters"
        remedy = "Such as iblf_jax.controllers.AdaptiveParameters."
        came = type(run.scenario.controller).__name__
        raise checks.fail("runs", f"a run of {came}", expected, remedy)
    return found


def adapting_law(run: Rollout) -> AdaptiveParameters:
    """The law of a run that adapts parameters.

    Raises:
      ValueError: a run of another law.
    """
    return _adapting(run)[0]


def _repeated(run: Rollout, values: np.ndarray) -> np.ndarray:
    """Constants, (p,), at every sample of a run, (T, p)."""
    return np.broadcast_to(values, (len(run.t), len(values)))


def _parameters_of_plant(run: Rollout) -> np.ndarray:
    """The parameters of the plant that the law adapts, (T, p)."""
    law, _ = _adapting(run)
    context = run.scenario.context._replace(plant=run.scenario.plant)
    values = jax.vmap(lambda t: law.true_parameters(t, context))(jnp.asarray(run.t))
    return np.asarray(values)


def _received(run: Rollout, i: int) -> Any:
    """A level, counted from 0, as the law received it: estimated or measured."""
    if has(run, "x_hat"):
        return np.asarray(run.x_hat)[:, i]
    return (run.measured.q, run.measured.dq)[i]


LEVEL_SIGNAL = re.compile(r"level_(\d+)(?:_(\w+))?")
"""A signal of one level, counted from 1: "level_3" is x_3; `LEVEL_PARTS` has the others."""

LEVEL_PARTS: dict[str | None, Callable[[Rollout, int], Any]] = {
    None: lambda run, i: run.x[:, i],
    "lower": lambda run, i: _row_if_any(run.level_lower, i),
    "upper": lambda run, i: _row_if_any(run.level_upper, i),
    "alpha": lambda run, i: _row(run.x, i) - _row_if_any(run.e, i),
    "received": lambda run, i: _row_if_any(run.x_hat, i),
    "d": lambda run, i: _row(run.disturbance, i),
    "estimate": lambda run, i: _row(run.disturbance_estimate, i),
    "estimate_error": (lambda run, i: _row(run.disturbance, i) - _row(run.disturbance_estimate, i)),
}
"""Part of the name of a signal of a level -> the signal, (T, n), given the index of the level from
0: the level, its bounds, the virtual control that it follows, its
estimate that the law received, and its disturbance with estimate and error."""


def _row_if_any(values: jax.Array, i: int) -> np.ndarray:
    """As `_row`; NaN for a level that the signal does not have."""
    if is_absent(values) or i < values.shape[1]:
        return _row(values, i)
    return np.full((1, 1), np.nan)


def _row(values: jax.Array, i: int) -> np.ndarray:
    """One row of a signal (T, m, n) with infinite entries as NaN; NaN for a run without it."""
    if is_absent(values):
        return np.full((1, 1), np.nan)
    row = np.asarray(values)[:, i]
    return np.where(np.isfinite(row), row, np.nan)


SAMPLED = {"tau", "alpha", "disturbance_estimate", "measured_q", "measured_dq"}
"""Signals that are constant between the samples of a sampled law."""
SAMPLED_PARTS = {"alpha", "estimate", "received"}
"""Parts of `LEVEL_PARTS` that are constant between the samples of a sampled law."""

EXTERNAL = {
    "t",
    "q_d",
    "dq_d",
    "lower",
    "upper",
    "error_lower",
    "error_upper",
    "xi_lower",
    "xi_upper",
    "dq_lower",
    "dq_upper",
    "region_boundary",
    "theta_lower",
    "theta_upper",
    "theta_of_plant",
}
"""Signals that do not depend on the state; figures draw them to the end of a failed run too."""

NEGLIGIBLE = 1e-6
"""A disturbance below this share of the largest rate of its level is not shown."""

SAME_SIGNAL = 0.03
"""Signals that differ by less than this fraction of their range are drawn once for all runs."""


BOUNDS_OF = {"q": ("lower", "upper"), "dq": ("dq_lower", "dq_upper")}
"""Signal -> its bounds; those of "level_3" are "level_3_lower" and "level_3_upper"."""
SAME_BOUNDS = {"e1": "q", "xi": "q"}
"""Signal -> the signal with whose bounds its own change."""
WITHOUT_JOINT = ("region_margin", "theta")
"""Signals whose entries are not joints."""


@dataclass(frozen=True, eq=False)
class Curve:
    """One run to draw: `curve["q"]` is an array (T, n), shorter than `curve.t` if the run was
    frozen before its end.

    A signal that the run's scenario does not have is NaN.
    """

    name: str
    """The caller's name of the run; empty for a single run."""
    run: Rollout
    samples: int
    """Number of samples before the state was frozen."""

    def __getitem__(self, field: str) -> np.ndarray:
        level = LEVEL_SIGNAL.fullmatch(field)
        if level is not None:
            values = LEVEL_PARTS[level[2]](self.run, int(level[1]) - 1)
            values = np.broadcast_to(values, self.run.q.shape)
        elif field in DERIVED:
            values = DERIVED[field](self.run)
        else:
            values = attributes(self.run, [field])[field]
        if is_absent(values):
            values = np.full(self.run.q.shape, np.nan)
        if field in EXTERNAL:
            return np.asarray(values)
        return np.asarray(values)[: self.samples]

    @property
    def t(self) -> np.ndarray:
        """Time, (T,) [s]."""
        return self["t"]

    def at(self, field: str, t: np.ndarray) -> np.ndarray:
        """A signal at other times t [s], linearly between its samples and constant after its end,
        (len(t), n).
        """
        values = self[field]
        return np.stack(
            [np.interp(t, self.t[: len(values)], column) for column in values.T], axis=-1
        )

    def is_sampled(self, field: str) -> bool:
        """Whether a signal is piecewise constant: the law is sampled, and for the torque the
        actuator is ideal.
        """
        scenario = self.run.scenario
        level = LEVEL_SIGNAL.fullmatch(field)
        is_of_law = field in SAMPLED if level is None else level[2] in SAMPLED_PARTS
        return (
            scenario.sampling is not None
            and is_of_law
            and (field != "tau" or isinstance(scenario.actuator, IdealActuator))
        )

    @property
    def is_measured(self) -> bool:
        """Whether the law received measurements or estimates that differ from the state."""
        return self.is_estimated or not isinstance(self.run.scenario.sensor, IdealSensor)

    @property
    def is_estimated(self) -> bool:
        """Whether the law received estimates of levels from an observer."""
        return has(self.run, "x_hat")

    def has_bounds(self, level: int) -> bool:
        """Whether a level, counted from 1, has bounds."""
        return bool(np.isfinite(_row_if_any(self.run.level_lower, level - 1)).any())

    @property
    def has_regions(self) -> bool:
        """Whether the scenario confines points of the robot to regions."""
        return has(self.run, "region_margin")

    @property
    def failed(self) -> bool:
        """Whether a status flag marks the run as failed."""
        return bool(int(self.run.status) & FAILED)

    @property
    def diverged(self) -> bool:
        """Whether the state diverged and was frozen."""
        return bool(int(self.run.status) & Status.NOT_FINITE)

    @property
    def status(self) -> str:
        """The run's status flags in words."""
        return describe(int(self.run.status), status_words(self.run.scenario))

    def disturbed_levels(self) -> list[int]:
        """The levels of a model in strict-feedback form, counted from 1, with a disturbance, or an
        estimate of one, that is more than the rounding of the levels' rates.
        """
        found = []
        for level in self.run.scenario.loop.model.uncertain_levels:
            sizes = [self[f"level_{level}_{part}"] for part in ("d", "estimate")]
            if np.nanmax(np.abs(sizes)) > NEGLIGIBLE * self.largest_rate(level):
                found.append(level)
        return found

    def largest_rate(self, level: int) -> float:
        """The largest rate of a level, counted from 1, over time and components, in its unit per
        second.
        """
        steps = np.diff(self.t[: self.samples])
        rates = np.diff(self[f"level_{level}"], axis=0) / steps[:, None]
        return float(np.nanmax(np.abs(rates), initial=0.0))

    def joint_label(self, joint: int) -> str:
        """The label of a joint in a figure."""
        return joint_labels(self.run.scenario.plant)[joint]

    def exit_index(self, field: str, entry: int) -> int | None:
        """The first sample at which the joint of a panel left the bounds that concern the panel;
        None if it stayed inside.

        The bounds are those of the panel's own quantity, or of every level of the joint for a
        quantity without bounds, such as the torque.  Of a run that diverged without leaving a bound
        it is the last sample, in every panel.

        Args:
          field: the signal of the panel.
          entry: the joint, or the region, of the panel.
        """
        # The signals of the run that have bounds: levels, and distances to regions.
        bounded = ["q"]
        if self.has_bounds(2):
            bounded.append("dq")
        order = plants.order_of(self.run.scenario.plant)
        bounded += [f"level_{level}" for level in range(3, order + 1)]
        if self.has_regions:
            bounded.append("region_margin")
        own = SAME_BOUNDS.get(field, field)
        concerned = [name for name in bounded if name not in WITHOUT_JOINT]
        if own in bounded:
            concerned = [own]
        elif own in WITHOUT_JOINT:
            concerned = []
        exits = []
        for name in concerned:
            outside = np.flatnonzero(self._outside(name)[:, entry])
            exits += outside[:1].tolist()
        if exits:
            return min(exits)
        has_exit = any(self._outside(name).any() for name in bounded)
        if self.diverged and not has_exit:
            return self.samples - 1
        return None

    def _outside(self, field: str) -> np.ndarray:
        """Whether a bounded signal touches or leaves its bounds, (T, n) bool."""
        values = self[field]
        if field == "region_margin":
            return values <= 0.0
        low_field, high_field = BOUNDS_OF.get(field, (f"{field}_lower", f"{field}_upper"))
        low, high = self[low_field][: self.samples], self[high_field][: self.samples]
        return (values <= low) | (values >= high)

    def largest(self, field: str) -> float:
        """The largest finite size of a signal over time and joints; 0 if there is none."""
        sizes = np.abs(self[field])
        return float(np.max(sizes, where=np.isfinite(sizes), initial=0.0))


ROUNDING = 256.0
"""Values below this many units in the last place of the largest value from which a signal is
computed are rounding errors."""

COMPUTED_FROM: dict[str, tuple[str, ...]] = {
    "q": ("q", "q_d"),
    "e1": ("q", "q_d"),
    "dq": ("dq", "dq_d"),
    "e2": ("dq", "alpha"),
    "disturbance_estimate": ("tau", "disturbance"),
}
"""Signal -> the signals from whose size its rounding errors follow; of the others, that is the
signal itself, over all joints."""


def rounding_error(curves: Sequence[Curve], field: str) -> float:
    """The size below which a signal of these runs is a rounding error, in its unit.

    Args:
      curves: the runs.
      field: the signal; "xi" is relative to the bounds, so that its scale is 1.
    """
    level = LEVEL_SIGNAL.fullmatch(field)
    errors = []
    for curve in curves:
        # The size of the numbers from which the signal is computed.
        if field == "xi":
            size = 1.0
        elif level is not None and level[2] == "estimate":
            size = curve.largest_rate(int(level[1]))
        else:
            size = max(curve.largest(name) for name in COMPUTED_FROM.get(field, (field,)))
        unit_in_last_place = float(np.finfo(curve[field].dtype).eps)
        errors.append(ROUNDING * unit_in_last_place * size)
    return max(errors)


class Peak(NamedTuple):
    """The value of a signal that is farthest from zero, with its sign, joint and time."""

    value: float
    joint: int
    t: float
    """s."""


def peak_of(curve: Curve, field: str, joints: Sequence[int]) -> Peak | None:
    """The peak of a signal over some joints of a run; None without a finite value."""
    values = curve[field][:, list(joints)]
    sizes = np.where(np.isfinite(values), np.abs(values), -1.0)
    sample, column = divmod(int(np.argmax(sizes)), sizes.shape[1])
    if sizes[sample, column] < 0.0:
        return None
    return Peak(float(values[sample, column]), joints[column], float(curve.t[sample]))


def joint_labels(plant: Robot | Plant) -> list[str]:
    """The labels of the joints of a robot, or of the components of a plant."""
    return [escaped(name) for name in plants.component_names(plant)]


def escaped(name: str) -> str:
    """A name that matplotlib shows unchanged: it would read $ as mathematics, and leave names that
    begin with _ out of legends.
    """
    if name.startswith("_"):
        name = f" {name}"
    return name.replace("$", r"\$")


def check_class(argument: str, value: object, cls: type, remedy: str) -> None:
    """Raises ValueError if the value is not an object of this class."""
    if not isinstance(value, cls):
        raise checks.fail(argument, type(value).__name__, checks.with_article(cls.__name__), remedy)


def _checked(name: str, run: Any, argument: str) -> Curve:
    check_class(argument, run, Rollout, "Draw what ij.simulate returns, or a dict of such runs.")
    if not checks.is_concrete(run):
        remedy = "Draw outside of jit, vmap and grad."
        raise checks.fail(argument, "a traced run", "a run that holds numbers", remedy)
    if run.is_batch:
        came = f"a batch of {len(run)} runs"
        raise checks.fail(argument, came, "one run", "Select a run: run[0].")
    # Of NumPy: JAX compiles programs for the index of each new shape.
    run = replace(jax.tree.map(np.asarray, run), scenario=run.scenario)
    q, dq = run.q, run.dq
    samples = len(q)
    if int(run.status) & Status.NOT_FINITE and len(q) > 1:
        # The run diverged: the samples before its state was frozen.
        moved = np.any((np.diff(q, axis=0) != 0) | (np.diff(dq, axis=0) != 0), axis=1)
        last = np.flatnonzero(moved & np.isfinite(q).all(axis=1)[1:])
        if last.size:
            samples = int(last[-1]) + 2
    return Curve(name, run, samples)


def curves_of(runs: Rollout | Mapping[str, Rollout]) -> list[Curve]:
    """The runs to draw, in the given order.

    Args:
      runs: one run, or a dict of runs by name; they may differ in length and in the recorded
        samples.

    Raises:
      ValueError: an empty dict, a batch, an object that is not a Rollout, or runs of robots with
        different numbers of joints.
    """
    if not isinstance(runs, Mapping):
        return [_checked("", runs, "run")]
    if not runs:
        raise checks.fail("runs", runs, "at least one run")
    curves = [_checked(str(name), run, f"runs[{str(name)!r}]") for name, run in runs.items()]
    joints = {curve.name: curve.run.n for curve in curves}
    if len(set(joints.values())) > 1:
        remedy = "Draw the robots one by one."
        raise checks.fail("runs", joints, "runs with one number of joints", remedy)
    return curves


def check_joint(curves: Sequence[Curve], joint: object, field: str = "joint") -> int:
    """The index of a joint that is given by its index or its name.

    Raises:
      ValueError: the robot has no such joint.
    """
    n = curves[0].run.n
    plant = curves[0].run.scenario.plant
    names = plants.component_names(plant)
    if isinstance(joint, str) and joint in names:
        return names.index(joint)
    if isinstance(joint, bool) or not isinstance(joint, int | np.integer) or not 0 <= joint < n:
        noun = checks.with_article(plants.component_noun(plant))
        remedy = checks.did_you_mean(joint, names) if isinstance(joint, str) else ""
        raise checks.fail(field, joint, f"{noun}, 0 to {n - 1}, or its name", remedy)
    return int(joint)


def distinct(curves: Sequence[Curve], fields: Sequence[str], joints: Sequence[int]) -> list[Curve]:
    """The curves that differ in these fields during the time that they share, longest first."""
    kept: list[Curve] = []
    for curve in sorted(curves, key=lambda c: -float(c.t[-1])):
        if all(_differ(curve, other, fields, joints) for other in kept):
            kept.append(curve)
    return kept


def _differ(a: Curve, b: Curve, fields: Sequence[str], joints: Sequence[int]) -> bool:
    t = np.linspace(0.0, min(a.t[-1], b.t[-1]), 400)
    for field in fields:
        for joint in joints:
            one, two = (c.at(field, t)[:, joint] for c in (a, b))
            tolerance = SAME_SIGNAL * np.nan_to_num(np.ptp(one)) + 1e-9
            if not np.allclose(one, two, rtol=0.0, atol=tolerance, equal_nan=True):
                return True
    return False


def thinned(t: np.ndarray, y: np.ndarray, points: int = POINTS) -> tuple[np.ndarray, np.ndarray]:
    """At most about `points` of the samples (t, y), every peak included.

    Args:
      t: time, (T,) [s].
      y: signal, (T,).
      points: approximate number of samples to keep.
    """
    if len(t) <= points:
        return t, y
    width = int(np.ceil(3 * len(t) / points))
    end = len(t) // width * width
    intervals = np.nan_to_num(y[:end], posinf=np.inf, neginf=-np.inf).reshape(-1, width)
    starts = np.arange(0, end, width)
    lowest = starts + intervals.argmin(axis=1)
    highest = starts + intervals.argmax(axis=1)
    rest = np.append(np.arange(end, len(t)), len(t) - 1)
    index = np.unique(np.concatenate([starts, lowest, highest, rest]))
    return t[index], y[index]
