"""Metrics of a run; each is a fold over its samples.

A metric is a `Fold`: an object that has `init(sample)`, `update(acc, sample)` and `finish(acc)`.
It receives every step, whatever the run records, so the same definition serves one recorded run, a
million runs that store no trajectory, and a tuning loss.

Integrals are sums by the trapezoidal rule, of second order in the step,

    int_0^T g dt = sum_k dt_k g(t_k),
    dt_k = dt, and dt/2 for the first and the last sample  (`Sample.dt`).

Where signals jump (at a sample of a sampled law, at the arrival of a command, or at a jump time of
the scenario) the fold receives both limits as samples of one time, so the rule applies to each
smooth part separately.

A fold is a component: its thresholds are leaves. Its `units` name the results of `finish`.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.observers.none import observer_of_x
from iblf_jax.core import checks
from iblf_jax.core.families import Part, attribute
from iblf_jax.core.pytree import Leaf, component, is_absent, layers, leaf, note_code
from iblf_jax.core.status import Status
from iblf_jax.core.units import (
    HIGHER,
    INPUT,
    LAST_LEVEL,
    LEVELS,
    POSITION,
    UNCERTAIN,
    VELOCITY,
    PlantUnit,
    as_text,
    resolved,
)
from iblf_jax.simulation.error_estimate import ACCURACY_UNITS
from iblf_jax.simulation.scenario import Scenario, fit_joints
from iblf_jax.simulation.signals import Sample as Sample
from iblf_jax.simulation.signals import (
    has,
    higher_alpha_margins,
    least_higher_margins,
    least_margin,
    least_xi_margin,
    margin_of,
)
from iblf_jax.simulation.units import symbols_of
from iblf_jax.world import plants


class Fold(Part):
    """The contract of a metric."""

    units: ClassVar[Mapping[str, str]]
    """Name -> SI unit of everything that `finish` returns."""
    needs: ClassVar[str | None] = None
    """The optional signal, one of `SIGNAL_SOURCES`, that the metric reads and not every scenario
    has."""

    @attribute
    def curvatures(self) -> int:
        """The number of `Outer` that `curvature` returns (`engine.derivatives`)."""
        return 0

    @abc.abstractmethod
    def init(self, sample: Sample) -> Any:
        """The accumulator before the first sample; `sample` is that first sample, for shapes and
        types.
        """

    @abc.abstractmethod
    def update(self, acc: Any, sample: Sample) -> Any:
        """The accumulator after one more sample; same structure, shapes and types."""

    @abc.abstractmethod
    def finish(self, acc: Any) -> dict[str, jax.Array]:
        """The named results."""

    def curvature(self, acc: Any, sample: Sample) -> tuple[Any, ...]:
        """What one more sample adds to the matrices of second derivatives of the results."""
        return ()


def _root_mean_square(integral: jax.Array, time: jax.Array) -> jax.Array:
    """sqrt(integral / time), with a finite gradient at 0."""
    mean = integral / time
    return jnp.where(mean > 0, jnp.sqrt(jnp.where(mean > 0, mean, 1.0)), 0.0)


class _TrackingSums(NamedTuple):
    time: jax.Array
    ise: jax.Array
    iae: jax.Array
    itae: jax.Array
    peak: jax.Array


@component
class Tracking(Fold):
    """Integrals and peak of the position error e1, joint by joint.

    ISE = int e1^2, IAE = int |e1|, ITAE = int t |e1|, rmse = sqrt(ISE / duration), peak_error = max
    |e1|.
    """

    units: ClassVar[dict[str, str]] = {
        "rmse": POSITION,
        "ise": PlantUnit("rad^2 s", "x1^2 s"),
        "iae": PlantUnit("rad s", "x1 s"),
        "itae": PlantUnit("rad s^2", "x1 s^2"),
        "peak_error": POSITION,
    }

    def init(self, sample: Sample) -> _TrackingSums:
        """Zeros."""
        zero = jnp.zeros_like(sample.e1)
        return _TrackingSums(jnp.zeros_like(sample.t), zero, zero, zero, zero)

    def update(self, acc: _TrackingSums, sample: Sample) -> _TrackingSums:
        """Adds one sample."""
        size = jnp.abs(sample.e1)
        return _TrackingSums(
            acc.time + sample.dt,
            acc.ise + sample.dt * size**2,
            acc.iae + sample.dt * size,
            acc.itae + sample.dt * sample.t * size,
            jnp.maximum(acc.peak, size),
        )

    def finish(self, acc: _TrackingSums) -> dict[str, jax.Array]:
        """rmse, ise, iae, itae, peak_error, each (n,)."""
        return {
            "rmse": _root_mean_square(acc.ise, acc.time),
            "ise": acc.ise,
            "iae": acc.iae,
            "itae": acc.itae,
            "peak_error": acc.peak,
        }


class _SettlingState(NamedTuple):
    outside: jax.Array
    since: jax.Array
    """Time of the first sample inside after the last one outside."""
    overshoot: jax.Array
    side: jax.Array


@component
class Settling(Fold):
    """Settling time and overshoot of e1.

    settling_time: the first sample time from which on |e1| < tolerance; infinite if the run ends
      outside.
    overshoot: the largest |e1| on the side of zero opposite to the start's.

    Args:
      tolerance: below which |e1| counts as settled, () or (n,) [rad], > 0; 0.01 if not given.
    """

    tolerance: Leaf = leaf(POSITION, sign="positive", default=0.01)
    units: ClassVar[dict[str, str]] = {"settling_time": "s", "overshoot": POSITION}

    def init(self, sample: Sample) -> _SettlingState:
        """Settled since the start, until a sample is outside."""
        zero = jnp.zeros_like(sample.e1)
        return _SettlingState(jnp.zeros(sample.e1.shape, bool), zero, zero, jnp.sign(sample.e1))

    def update(self, acc: _SettlingState, sample: Sample) -> _SettlingState:
        """Adds one sample."""
        outside = ~(jnp.abs(sample.e1) < self.tolerance)
        since = jnp.where(acc.outside & ~outside, sample.t, acc.since)
        return _SettlingState(
            outside, since, jnp.maximum(acc.overshoot, -acc.side * sample.e1), acc.side
        )

    def finish(self, acc: _SettlingState) -> dict[str, jax.Array]:
        """settling_time and overshoot, each (n,)."""
        return {
            "settling_time": jnp.where(acc.outside, jnp.inf, acc.since),
            "overshoot": acc.overshoot,
        }


class _MarginState(NamedTuple):
    smallest: tuple[jax.Array, ...]
    """Smallest margins so far. Only the first entry decides about violations."""
    time: jax.Array
    """Of the first violation; infinite before."""
    first: jax.Array
    """Joint, or region, of the first violation; -1 before."""


def _no_violation(t: jax.Array, *margins: jax.Array) -> _MarginState:
    """The state before the first sample, for margins of these shapes."""
    smallest = tuple(jnp.full_like(margin, jnp.inf) for margin in margins)
    return _MarginState(smallest, jnp.full_like(t, jnp.inf), jnp.int32(-1))


def _with_margins(acc: _MarginState, t: jax.Array, *margins: jax.Array) -> _MarginState:
    """The state after an instant with these margins."""
    decisive = margins[0]
    is_first = jnp.any(~(decisive > 0)) & (acc.first < 0)
    return _MarginState(
        tuple(map(jnp.minimum, acc.smallest, margins)),
        jnp.where(is_first, t, acc.time),
        jnp.where(is_first, jnp.argmin(decisive).astype(jnp.int32), acc.first),
    )


@component
class Margin(Fold):
    """Smallest distance of the joints to their bounds, and the first violation.

    margin = min(q - lower, upper - q), continuous through zero; xi_margin = 1 - max |xi|;
    first_violation_time is infinite and first_violation_joint -1 on a run that keeps its bounds.
    The margins are those at the instants of the steps; where process noise acts on the first level
    they contain the excursions between two instants (`noise.least_distances`), and an exit counts
    at the end of its step.
    """

    units: ClassVar[dict[str, str]] = {
        "margin": POSITION,
        "xi_margin": "1",
        "first_violation_time": "s",
        "first_violation_joint": "1",
    }

    def init(self, sample: Sample) -> _MarginState:
        """Infinitely far from the bounds."""
        return _no_violation(sample.t, sample.q, sample.q)

    def update(self, acc: _MarginState, sample: Sample) -> _MarginState:
        """Adds one sample."""
        margin, xi_margin = least_margin(sample, 1), least_xi_margin(sample)
        return _with_margins(acc, sample.t, margin, xi_margin)

    def finish(self, acc: _MarginState) -> dict[str, jax.Array]:
        """The margins, each (n,); first_violation_time and first_violation_joint, ()."""
        return {
            "margin": acc.smallest[0],
            "xi_margin": acc.smallest[1],
            "first_violation_time": acc.time,
            "first_violation_joint": acc.first,
        }


@component
class FirstExit(Fold):
    """Time at which each joint first reaches or leaves its bounds: first_exit_time.

    It is infinite for a joint that keeps its bounds.  Bounds are compared at the instants of the
    steps, so an excursion between two instants is not seen; where process noise acts on the first
    level it is, as in `Margin`.
    """

    units: ClassVar[dict[str, str]] = {"first_exit_time": "s"}

    def init(self, sample: Sample) -> jax.Array:
        """No exit."""
        return jnp.full_like(sample.q, jnp.inf)

    def update(self, acc: jax.Array, sample: Sample) -> jax.Array:
        """Adds one sample."""
        margin = least_margin(sample, 1)
        return jnp.where(margin > 0, acc, jnp.minimum(acc, sample.t))

    def finish(self, acc: jax.Array) -> dict[str, jax.Array]:
        """first_exit_time, (n,)."""
        return {"first_exit_time": acc}


class _ValueSums(NamedTuple):
    time: jax.Array
    integral: jax.Array
    last: jax.Array


@component
class LyapunovValue(Fold):
    """The law's Lyapunov function: mean_V = int V / duration, and final_V at the end of the run.

    Under process noise no bound on V is claimed: means over the runs of a study estimate E[V].
    """

    units: ClassVar[dict[str, str]] = {
        "mean_V": PlantUnit("N m rad", "energy"),
        "final_V": PlantUnit("N m rad", "energy"),
    }

    def init(self, sample: Sample) -> _ValueSums:
        """Zeros."""
        zero = jnp.zeros_like(sample.t)
        return _ValueSums(zero, zero, zero)

    def update(self, acc: _ValueSums, sample: Sample) -> _ValueSums:
        """Adds one sample."""
        integral = acc.integral + sample.dt * sample.V
        return _ValueSums(acc.time + sample.dt, integral, sample.V)

    def finish(self, acc: _ValueSums) -> dict[str, jax.Array]:
        """mean_V and final_V, ()."""
        return {"mean_V": acc.integral / acc.time, "final_V": acc.last}


@component
class VelocityMargin(Fold):
    """Smallest distance of the velocities, and of the virtual velocity alpha, to the velocity
    bounds, and the first violation.

    velocity_margin = min(q' - v_l, v_u - q') and alpha_margin = min(alpha - v_l, v_u - alpha), both
    continuous through zero; a law that follows an alpha outside the bounds cannot keep them.
    first_velocity_violation_time is infinite and first_velocity_violation_joint -1 on a run that
    keeps them.  Only for scenarios with bounds of the second level (`bounds[1]`), whose runs
    carry it by default.
    """

    units: ClassVar[dict[str, str]] = {
        "velocity_margin": VELOCITY,
        "alpha_margin": VELOCITY,
        "first_velocity_violation_time": "s",
        "first_velocity_violation_joint": "1",
    }
    needs: ClassVar[str] = "dq_lower"

    def init(self, sample: Sample) -> _MarginState:
        """Infinitely far from the bounds."""
        return _no_violation(sample.t, sample.dq, sample.dq)

    def update(self, acc: _MarginState, sample: Sample) -> _MarginState:
        """Adds one sample."""
        of_alpha = margin_of(sample, 2, sample.alpha)
        return _with_margins(acc, sample.t, least_margin(sample, 2), of_alpha)

    def finish(self, acc: _MarginState) -> dict[str, jax.Array]:
        """velocity_margin and alpha_margin, each (n,); first_velocity_violation_time and
        first_velocity_violation_joint, ().
        """
        return {
            "velocity_margin": acc.smallest[0],
            "alpha_margin": acc.smallest[1],
            "first_velocity_violation_time": acc.time,
            "first_velocity_violation_joint": acc.first,
        }


@component
class LevelMargin(Fold):
    """Smallest distance of the levels from the third on, and of the virtual controls that they
    follow, to the bounds of these levels, and the first violation.

    level_margin = min(x_i - lower_i, upper_i - x_i) and level_alpha_margin = min(alpha_{i-1} -
    lower_i, upper_i - alpha_{i-1}) have one row a level, the first of them for level 3.  Both are
    continuous through zero, and infinite for a level without bounds; a law that follows an
    alpha_{i-1} outside the bounds cannot keep them.
    first_level_violation_time is infinite, first_level_violation_level (counted from 1) and
    first_level_violation_component (from 0) are -1 on a run that keeps them.  Only for scenarios
    with bounds of such levels, whose runs carry it by default.
    """

    units: ClassVar[dict[str, str]] = {
        "level_margin": HIGHER,
        "level_alpha_margin": HIGHER,
        "first_level_violation_time": "s",
        "first_level_violation_level": "1",
        "first_level_violation_component": "1",
    }
    needs: ClassVar[str] = "higher_lower"

    def init(self, sample: Sample) -> _MarginState:
        """Infinitely far from the bounds."""
        return _no_violation(sample.t, *_level_margins(sample))

    def update(self, acc: _MarginState, sample: Sample) -> _MarginState:
        """Adds one sample."""
        return _with_margins(acc, sample.t, *_level_margins(sample))

    def finish(self, acc: _MarginState) -> dict[str, jax.Array]:
        """level_margin, (r - 2, n), and level_alpha_margin, the same, under a law with virtual
        controls of these levels; the others ().
        """
        found = dict(zip(("level_margin", "level_alpha_margin"), acc.smallest, strict=False))
        n = acc.smallest[0].shape[-1]
        level, component = acc.first // n + 3, acc.first % n
        return {
            **found,
            "first_level_violation_time": acc.time,
            "first_level_violation_level": jnp.where(acc.first < 0, -1, level),
            "first_level_violation_component": jnp.where(acc.first < 0, -1, component),
        }


def _level_margins(sample: Sample) -> list[jax.Array]:
    """The margins of the levels from the third on, and of the virtual controls for them, (r - 2, n)
    each; the latter only under a law that has them.
    """

    def for_all_levels(margins: jax.Array) -> jax.Array:
        # JAX answers an index behind the last row with the last row: every level has a row.
        missing = len(sample.x) - 2 - len(margins)
        return jnp.pad(margins, ((0, missing), (0, 0)), constant_values=jnp.inf)

    of_alphas = higher_alpha_margins(sample)
    found = [for_all_levels(least_higher_margins(sample))]
    return found if of_alphas is None else [*found, for_all_levels(of_alphas)]


@component
class RegionMargin(Fold):
    """Smallest distance of the robot's points to the boundaries of their regions, and the first
    violation.

    region_margin = min over time of the distance to the boundary, region by region, continuous
    through zero.  first_region_violation_time is infinite and first_region_violation_region -1 on a
    run that stays in all of them.  Only for scenarios with `regions`, whose runs carry it by
    default.
    """

    units: ClassVar[dict[str, str]] = {
        "region_margin": "m",
        "first_region_violation_time": "s",
        "first_region_violation_region": "1",
    }
    needs: ClassVar[str] = "region_margin"

    def init(self, sample: Sample) -> _MarginState:
        """Infinitely far from the boundaries."""
        return _no_violation(sample.t, sample.region_margin)

    def update(self, acc: _MarginState, sample: Sample) -> _MarginState:
        """Adds one sample."""
        return _with_margins(acc, sample.t, sample.region_margin)

    def finish(self, acc: _MarginState) -> dict[str, jax.Array]:
        """region_margin, (m,) for m regions; first_region_violation_time and
        first_region_violation_region, ().
        """
        return {
            "region_margin": acc.smallest[0],
            "first_region_violation_time": acc.time,
            "first_region_violation_region": acc.first,
        }


@component
class Slack(Fold):
    """Largest violation of a safety filter's own conditions on the joints: largest_slack.

    Only for laws with a filter (`controllers.SafetyFilter`), whose runs carry it by default.
    """

    units: ClassVar[dict[str, str]] = {"largest_slack": PlantUnit("rad/s^2", "x2/s")}
    needs: ClassVar[str] = "slack"

    def init(self, sample: Sample) -> jax.Array:
        """Zero."""
        return jnp.zeros_like(sample.slack)

    def update(self, acc: jax.Array, sample: Sample) -> jax.Array:
        """Adds one sample."""
        return jnp.maximum(acc, sample.slack)

    def finish(self, acc: jax.Array) -> dict[str, jax.Array]:
        """largest_slack, (n,)."""
        return {"largest_slack": acc}


@component
class RegionSlack(Fold):
    """Largest violation of a safety filter's own conditions on the regions: largest_region_slack.

    Only for laws with a filter in scenarios with regions, whose runs carry it by default.
    """

    units: ClassVar[dict[str, str]] = {"largest_region_slack": "m/s^2"}
    needs: ClassVar[str] = "region_slack"

    def init(self, sample: Sample) -> jax.Array:
        """Zero."""
        return jnp.zeros_like(sample.region_slack)

    def update(self, acc: jax.Array, sample: Sample) -> jax.Array:
        """Adds one sample."""
        return jnp.maximum(acc, sample.region_slack)

    def finish(self, acc: jax.Array) -> dict[str, jax.Array]:
        """largest_region_slack, (m,) for m regions."""
        return {"largest_region_slack": acc}


class _TorqueSums(NamedTuple):
    time: jax.Array
    square: jax.Array
    peak: jax.Array
    variation: jax.Array
    last: jax.Array
    saturated: jax.Array


@component
class Torque(Fold):
    """Size and variation of the torque, or of another plant's input.

    effort = int |tau|^2 over all joints; and joint by joint torque_rms, peak_torque,
    torque_variation = sum |tau_k+1 - tau_k| (chatter), and saturated_share, the fraction of the
    time in which the torque was limited.
    """

    units: ClassVar[dict[str, str]] = {
        "effort": PlantUnit("N^2 m^2 s", "u^2 s"),
        "torque_rms": INPUT,
        "peak_torque": INPUT,
        "torque_variation": INPUT,
        "saturated_share": "1",
    }

    def init(self, sample: Sample) -> _TorqueSums:
        """Zeros; the first torque has no predecessor but itself."""
        zero = jnp.zeros_like(sample.tau)
        return _TorqueSums(jnp.zeros_like(sample.t), zero, zero, zero, sample.tau, zero)

    def update(self, acc: _TorqueSums, sample: Sample) -> _TorqueSums:
        """Adds one sample."""
        return _TorqueSums(
            acc.time + sample.dt,
            acc.square + sample.dt * sample.tau**2,
            jnp.maximum(acc.peak, jnp.abs(sample.tau)),
            acc.variation + jnp.abs(sample.tau - acc.last),
            sample.tau,
            acc.saturated + jnp.where(sample.saturated, sample.dt, jnp.zeros_like(sample.dt)),
        )

    def finish(self, acc: _TorqueSums) -> dict[str, jax.Array]:
        """effort, (); the others (n,)."""
        return {
            "effort": jnp.sum(acc.square),
            "torque_rms": _root_mean_square(acc.square, acc.time),
            "peak_torque": acc.peak,
            "torque_variation": acc.variation,
            "saturated_share": acc.saturated / acc.time,
        }


class _SquareSums(NamedTuple):
    time: jax.Array
    square: jax.Array


@component
class AboveGravity(Fold):
    """Torque beyond gravity compensation: effort_above_gravity = sqrt(mean |tau - G0(q)|^2) over
    all joints.

    `compare` scales the gains of laws so that they are equal in it.
    """

    units: ClassVar[dict[str, str]] = {"effort_above_gravity": INPUT}

    def init(self, sample: Sample) -> _SquareSums:
        """Zeros."""
        return _SquareSums(jnp.zeros_like(sample.t), jnp.zeros_like(sample.t))

    def update(self, acc: _SquareSums, sample: Sample) -> _SquareSums:
        """Adds one sample."""
        return _SquareSums(
            acc.time + sample.dt,
            acc.square + sample.dt * jnp.sum((sample.tau - sample.gravity) ** 2),
        )

    def finish(self, acc: _SquareSums) -> dict[str, jax.Array]:
        """The effort above gravity, ()."""
        return {"effort_above_gravity": _root_mean_square(acc.square, acc.time)}


@component
class Estimation(Fold):
    """Error of the observer: estimate_rmse = sqrt(mean f_tilde^2), f_tilde = f - f_hat, or the
    same of d_1 ... d_r of a model in strict-feedback form.
    """

    units: ClassVar[dict[str, str]] = {"estimate_rmse": UNCERTAIN}

    def init(self, sample: Sample) -> _SquareSums:
        """Zeros."""
        return _SquareSums(jnp.zeros_like(sample.t), jnp.zeros_like(sample.disturbance))

    def update(self, acc: _SquareSums, sample: Sample) -> _SquareSums:
        """Adds one sample."""
        f_tilde = sample.disturbance - sample.disturbance_estimate
        return _SquareSums(acc.time + sample.dt, acc.square + sample.dt * f_tilde**2)

    def finish(self, acc: _SquareSums) -> dict[str, jax.Array]:
        """estimate_rmse, (n,), or (r, n) for a model in strict-feedback form."""
        return {"estimate_rmse": _root_mean_square(acc.square, acc.time)}


class _LevelErrorState(NamedTuple):
    peak: jax.Array
    time: jax.Array
    """For which a limit was active [s]."""
    t: jax.Array
    """Time of the last sample [s]."""
    excess: Any
    """Of the last sample."""


@component
class LevelEstimation(Fold):
    """Error of the levels that the law receives from an observer, and the time of their limits.

    peak_level_error = max |x_hat - x| of each level, at the instants at which the law runs, with
    the x_hat that it receives, within the limits of the observer; of a measured level it is the
    error of the sensor.  limited_time is the time for which a limit of the
    estimates was active, with its ends interpolated linearly between samples.  Only for scenarios
    whose observer estimates levels (`observers.StateObserver`), whose runs carry it by default.
    """

    units: ClassVar[dict[str, str]] = {"peak_level_error": LEVELS, "limited_time": "s"}
    needs: ClassVar[str] = "x_hat"

    def init(self, sample: Sample) -> _LevelErrorState:
        """Zeros."""
        zero = jnp.zeros_like(sample.t)
        peak = jnp.zeros_like(sample.level_error)
        return _LevelErrorState(peak, zero, sample.t, sample.limit_excess)

    def update(self, acc: _LevelErrorState, sample: Sample) -> _LevelErrorState:
        """Adds one sample."""
        time = acc.time
        if has(sample, "limit_excess"):
            share = _positive_share(acc.excess, sample.limit_excess)
            time = time + (sample.t - acc.t) * share
        peak = jnp.maximum(acc.peak, jnp.abs(sample.level_error))
        return _LevelErrorState(peak, time, sample.t, sample.limit_excess)

    def finish(self, acc: _LevelErrorState) -> dict[str, jax.Array]:
        """peak_level_error, (r, n); limited_time, (), where the estimates have limits."""
        if is_absent(acc.excess):
            return {"peak_level_error": acc.peak}
        return {"peak_level_error": acc.peak, "limited_time": acc.time}


def _positive_share(first: jax.Array, last: jax.Array) -> jax.Array:
    """Share of an interval in which a function with these values at its ends is positive, if it is
    linear between them.
    """
    high, low = jnp.maximum(first, last), jnp.minimum(first, last)
    crosses = (high > 0) & (low < 0)
    width = jnp.where(crosses, high - low, 1.0)
    return jnp.where(crosses, high / width, jnp.where(high > 0, 1.0, 0.0))


@component
class Auxiliary(Fold):
    """Largest size of the auxiliary state of a limited torque: largest_auxiliary = max |lambda|.

    Only for laws that have one (`controllers.Saturated` with `auxiliary`), whose runs carry it by
    default.
    """

    units: ClassVar[dict[str, str]] = {"largest_auxiliary": LAST_LEVEL}
    needs: ClassVar[str] = "auxiliary"

    def init(self, sample: Sample) -> jax.Array:
        """Zero."""
        return jnp.zeros_like(sample.auxiliary)

    def update(self, acc: jax.Array, sample: Sample) -> jax.Array:
        """Adds one sample."""
        return jnp.maximum(acc, jnp.abs(sample.auxiliary))

    def finish(self, acc: jax.Array) -> dict[str, jax.Array]:
        """largest_auxiliary, (n,)."""
        return {"largest_auxiliary": acc}


class _EventTimes(NamedTuple):
    events: jax.Array
    """Commands sent so far."""
    first: jax.Array
    """Time of the first event."""
    last: jax.Array
    """Time of the latest event."""
    shortest: jax.Array


@component
class Events(Fold):
    """Number of the commands that an event trigger sent, and the intervals between them.

    shortest_interval and mean_interval are those between consecutive events, infinite on a run with
    fewer than two.  Only for scenarios with `Sampling(trigger=...)`, whose runs carry it by
    default.
    """

    units: ClassVar[dict[str, str]] = {
        "event_count": "1",
        "shortest_interval": "s",
        "mean_interval": "s",
    }
    needs: ClassVar[str] = "events"

    def init(self, sample: Sample) -> _EventTimes:
        """No event."""
        zero, infinite = jnp.zeros_like(sample.t), jnp.full_like(sample.t, jnp.inf)
        return _EventTimes(zero, zero, zero, infinite)

    def update(self, acc: _EventTimes, sample: Sample) -> _EventTimes:
        """Adds one sample."""
        # The numbers are integers of floating-point type.
        is_event = sample.events > acc.events + 0.5
        is_first = is_event & (acc.events < 0.5)
        is_later = is_event & (acc.events > 0.5)
        interval = jnp.where(is_later, sample.t - acc.last, jnp.inf)
        return _EventTimes(
            sample.events,
            jnp.where(is_first, sample.t, acc.first),
            jnp.where(is_event, sample.t, acc.last),
            jnp.minimum(acc.shortest, interval),
        )

    def finish(self, acc: _EventTimes) -> dict[str, jax.Array]:
        """event_count, shortest_interval and mean_interval, () each."""
        intervals = acc.events - 1.0
        mean = (acc.last - acc.first) / jnp.maximum(intervals, 1.0)
        return {
            "event_count": acc.events,
            "shortest_interval": acc.shortest,
            "mean_interval": jnp.where(intervals > 0.5, mean, jnp.inf),
        }


class SignalSource(NamedTuple):
    """What gives runs an optional signal."""

    part: str
    """The part of a scenario that the signal needs, with an example."""
    is_in: Callable[[Scenario], bool]
    """Whether a scenario has it."""


def _has_filter(scenario: Scenario) -> bool:
    return any(law.has_slack for law in layers(scenario.controller))


SIGNAL_SOURCES = {
    "x_hat": SignalSource(
        "an observer of levels, such as ij.observers.StateObserver(bandwidth=100.0)",
        lambda scenario: observer_of_x(scenario.observer).completes,
    ),
    "dq_lower": SignalSource(
        "bounds of the second level, such as bounds=(positions, velocities)",
        lambda scenario: scenario.bounds[1] is not None,
    ),
    "higher_lower": SignalSource(
        "bounds of a level from the third on",
        lambda scenario: any(bounds is not None for bounds in scenario.bounds[2:]),
    ),
    "region_margin": SignalSource(
        "regions, such as (ij.regions.HalfSpace(normal=[0, 1], offset=0.1),)",
        lambda scenario: bool(scenario.regions),
    ),
    "slack": SignalSource(
        "a law with a filter, such as ij.controllers.SafetyFilter(law)", _has_filter
    ),
    "region_slack": SignalSource(
        "regions and a law with a filter, such as ij.controllers.SafetyFilter(law)",
        lambda scenario: bool(scenario.regions) and _has_filter(scenario),
    ),
    "auxiliary": SignalSource(
        "an auxiliary state, such as ij.controllers.Saturated(law, limit, auxiliary=5.0)",
        lambda scenario: any(law.has_auxiliary for law in layers(scenario.controller)),
    ),
    "events": SignalSource(
        "a trigger, such as ij.Sampling(period, trigger=ij.EventTrigger(relative=0.1))",
        lambda scenario: scenario.sampling is not None and scenario.sampling.trigger is not None,
    ),
}
"""Optional signal -> where it comes from."""


def check_needs(field: str, fold: Any, scenario: Scenario) -> None:
    """Raises ValueError for a fold, or a quantity of a tuning, that reads a signal which runs of
    the scenario do not have.
    """
    needs = fold.needs
    if needs is None:
        return
    checks.one_of(f"{field}.needs", needs, SIGNAL_SOURCES)
    source = SIGNAL_SOURCES[needs]
    if not source.is_in(scenario):
        got = f"{checks.with_article(type(fold).__name__)} that reads {needs}"
        raise checks.fail(field, got, f"a scenario with {source.part}")


def as_folds(
    metrics: Sequence[Fold] | None, dtype: jax.typing.DTypeLike, scenario: Scenario | None = None
) -> tuple[Fold, ...]:
    """The requested folds (None: the standard ones), checked, their numbers in one floating-point
    type.

    Args:
      metrics: the folds, or None.
      dtype: of their numbers.
      scenario: of the run, if it is known.

    Raises:
      ValueError: something that is not a fold, one that needs a signal that the scenario does not
        have, units that are not strings, fields that are not numbers, or two folds that return the
        same name.
    """
    if metrics is None:
        folds = standard()
        if scenario is not None:
            folds += optional_folds(scenario)
        return tuple(_in_type("metrics", fold, dtype) for fold in folds)
    if not isinstance(metrics, tuple | list):
        remedy = "Put one fold into brackets, metrics=(fold,)."
        raise checks.fail("metrics", metrics, "a tuple of folds", remedy)
    owner: dict[str, str] = {name: "every run" for name, _ in ACCURACY_UNITS}
    for i, fold in enumerate(metrics):
        field = f"metrics[{i}]"
        checks.conforms(field, fold, Fold, _class_with(fold))
        if scenario is not None:
            fit_joints(fold, scenario.n, field)
            check_needs(field, fold, scenario)
        units = checks.mapping(f"{field}.units", fold.units, '{"rmse": "rad"}')
        for name, unit in units.items():
            checks.string(f"{field}.units[{name!r}]", unit, "a unit in words")
            if name in owner:
                remedy = f"{owner[name]} returns {name!r} too."
                raise checks.fail(field, fold, "names that no other fold returns", remedy)
            owner[name] = field
    note_code(metrics)
    return tuple(_in_type(f"metrics[{i}]", fold, dtype) for i, fold in enumerate(metrics))


def _in_type(name: str, fold: Fold, dtype: jax.typing.DTypeLike) -> Fold:
    """The fold with its numbers in one floating-point type."""
    try:
        return jax.tree.map(lambda x: jnp.asarray(x, dtype), fold)
    except Exception as error:
        remedy = "Other things belong in a static field."
        raise checks.fail(name, fold, "a fold whose fields are numbers", remedy) from error


def metric_units(folds: Sequence[Fold], scenario: Scenario) -> tuple[tuple[str, str], ...]:
    """Name and unit of every result of a run of a scenario with these folds, its accuracy results
    included.
    """
    pairs = [pair for fold in folds for pair in fold.units.items()]
    if plants.has_modes(scenario.plant):
        pairs += plants.SWITCHING_UNITS.items()
    symbols = symbols_of(scenario)
    each = (*pairs, *ACCURACY_UNITS)
    return tuple((name, as_text(resolved(unit, symbols))) for name, unit in each)


def _class_with(name: object) -> str:
    """The remedy for something in place of a fold, such as the name of a result."""
    classes = Fold.__subclasses__() if isinstance(name, str) else []
    for cls in classes:
        units = vars(cls).get("units")  # a property where it depends on the fold
        if isinstance(units, dict) and name in units:
            return f"ij.metrics.{cls.__name__}() returns it."
    return "Such as ij.metrics.Margin(); ij.metrics.standard() returns the usual ones."


def standard() -> tuple[Fold, ...]:
    """The folds that every run carries by default; some scenarios add `optional_folds`.

    They are constructed on the call: an array made at import would start JAX's backend and fix its
    precision before a user can choose.
    """
    return (Tracking(), Settling(), Margin(), Torque(), Estimation())


VIOLATION_TIMES = {
    Status.BOUND_VIOLATED: "first_violation_time",
    Status.VELOCITY_VIOLATED: "first_velocity_violation_time",
    Status.STATE_BOUND_VIOLATED: "first_level_violation_time",
    Status.REGION_VIOLATED: "first_region_violation_time",
}
"""Flag of a violated constraint -> metric with the time at which it was violated first."""

OPTIONAL: tuple[type[Any], ...] = (
    VelocityMargin,
    LevelMargin,
    RegionMargin,
    Slack,
    RegionSlack,
    LevelEstimation,
    Auxiliary,
    Events,
)
"""The folds that read an optional signal."""


def optional_folds(scenario: Scenario) -> tuple[Fold, ...]:
    """The folds that runs of a scenario carry besides the standard ones: margins of bounds of
    further levels and of regions, slacks of a filter, errors of estimated levels, the auxiliary
    state of a limited torque, and the events of a trigger.
    """
    return tuple(fold() for fold in OPTIONAL if SIGNAL_SOURCES[fold.needs].is_in(scenario))


MEMBERS = {
    "tracking": Tracking,
    "settling": Settling,
    "margin": Margin,
    "first_exit": FirstExit,
    "lyapunov_value": LyapunovValue,
    "velocity_margin": VelocityMargin,
    "level_margin": LevelMargin,
    "region_margin": RegionMargin,
    "slack": Slack,
    "region_slack": RegionSlack,
    "auxiliary": Auxiliary,
    "events": Events,
    "torque": Torque,
    "above_gravity": AboveGravity,
    "estimation": Estimation,
    "level_estimation": LevelEstimation,
}
"""Every fold by its name in a saved tuning result."""
