"""The result of `ij.prove`."""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.controllers._base import position_barrier
from iblf_jax.core import checks, tables
from iblf_jax.core.first_use import xarray
from iblf_jax.core.presentation import Content, Result, present
from iblf_jax.core.pytree import astype, unwrapped
from iblf_jax.engine.simulate import simulate
from iblf_jax.proofs.problem import LevelSetProblem
from iblf_jax.proofs.proposal import LevelChoice
from iblf_jax.proofs.support import has_delay, step_within
from iblf_jax.proofs.torque import TorqueRange, without_limits
from iblf_jax.proofs.undecided import REACHED, SMALLER_LEVEL
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.world import plants

INSTANTS = 512
"""Times of a guaranteed tube."""
CONSTANT = 1e-9
"""Relative variation of the bound of |xi| below which it does not depend on the time."""
DOWN, UP = 1.0 - 1e-12, 1.0 + 1e-12
"""Factors by which numbers that are computed in double precision are rounded down and up."""
CANDIDATES = 64
"""Points that are drawn for each start of a loop with a delay, of which few may be starts."""
AT_REST = 5.0
"""Time that is shown if reference and bounds are constant, so that there is no period [s]."""


class Verdict(enum.StrEnum):
    """What `ij.prove` found."""

    PROVED = "proved"
    """V_w' < 0 at every point of V_w = level, for all times and parameters; with limits of the
    torque, either the law's torque is within them on the whole set, or V_w' is that of the loop
    whose limits are active."""
    NOT_PROVED = "not proved"
    """Every weight that was tried has a point of the level set with V_w' > 0, or with a torque of
    the law beyond a limit."""
    REFUTED = "refuted"
    """A run that starts in the set violates the bounds or, of a sampled loop, has V_w > level at a
    sample."""
    UNDECIDED = "undecided"
    """Neither a proof nor a counterexample was found with the given number of boxes."""


class GrowthPoint(NamedTuple):
    """A point of the level set, and V_w' there in floating-point numbers."""

    weight: float
    """w."""
    rate: float
    """V_w', in the unit of V_w per second."""
    state: Any
    """Time, state, estimation error and parameters in physical numbers."""

    def __repr__(self) -> str:
        entries = self.state._asdict().items()
        parts = [f"{name} = {_numbers(value)}" for name, value in entries if np.size(value)]
        return f"V_w' = {self.rate:+.4g} at w = {self.weight:.3g}: {', '.join(parts)}"


class WorstBox(NamedTuple):
    """The box on which the upper bound of V_w' is furthest from a proof."""

    intervals: dict[str, tuple[float, float]]
    """Coordinate -> its ends; coordinates without a unit are those of the level set."""
    bound: float
    """Upper bound of V_w' on the box."""
    value: float
    """Upper bound at the centre of the box."""
    narrowed: dict[str, float]
    """Uncertain number -> the bound if its interval is replaced by its centre."""

    @property
    def decisive(self) -> str | None:
        """The uncertain number whose width raises the bound most; None if no width raises it."""
        if not self.narrowed:
            return None
        name = min(self.narrowed, key=self.narrowed.__getitem__)
        return name if self.narrowed[name] < self.bound else None


class GuaranteedTube(NamedTuple):
    """Positions in {V_w <= level}, and the bounds, over time."""

    t: np.ndarray
    """Times, (T,) [s]."""
    reference: np.ndarray
    """(T, n), in the unit of the position."""
    lower: np.ndarray
    """Least position in the set, (T, n)."""
    upper: np.ndarray
    """Greatest position in the set, (T, n)."""
    lower_bound: np.ndarray
    """Lower bound of the position, (T, n)."""
    upper_bound: np.ndarray
    """Upper bound of the position, (T, n)."""
    xi: np.ndarray
    """Bound of |xi|, (T, n) [1]."""


class DelayedStart(NamedTuple):
    """The starts of a loop with a delay about which a proof is."""

    level: float
    """Largest V_w at the start, in the unit of V_w."""
    torque: np.ndarray
    """Largest difference between the torque before the first command and that of the law at the
    start, (n,) [N m]."""


class Attempt(NamedTuple):
    """One proof of a bisection."""

    value: float
    """Level, factor of the widths of the intervals, or period [s]."""
    verdict: Verdict
    boxes: int
    seconds: float


class Violation(NamedTuple):
    """A run that starts in the level set and violates the bounds, or leaves the set."""

    scenario: Scenario
    """With the start and the parameters in it; its time 0 is the time of the start."""
    state: Any
    """The start in physical numbers."""
    duration: float
    """[s]."""
    dt: float
    """[s]."""
    margin: float
    """Least distance from the bounds, in the unit of the position; negative outside."""
    value: float | None = None
    """The largest V_w at a sample [N m rad], of a run that leaves the set and not the bounds; None
    otherwise."""

    @property
    def statement(self) -> str:
        """What it refutes, in words."""
        return "not inside the bounds forever" if self.value is None else "not invariant"

    @property
    def found(self) -> str:
        """What the run does, in words."""
        if self.value is None:
            return f"violates the bounds by {-self.margin:.3g}"
        return f"has V_w = {self.value:.6g} at a sample, and stays inside the bounds"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Proof(Result):
    """Whether {V_w <= level} is invariant for all times and parameters; printed as sentences."""

    verdict: Verdict
    scenario: Scenario
    parameters: Mapping[str, Perturbation]
    """Path -> `factor`, `offset` or `value` of an interval."""
    ranges: dict[str, tuple[float, float]]
    """Path of each uncertain number -> its least and its greatest value."""
    level: float
    """c, in the unit of V_w."""
    weight: float
    """w of the proof; of the weights that were tried, the one with the least largest V_w'."""
    duration: float
    """Length of the time interval [s]."""
    is_period: bool
    """Whether the time interval is a period, so that the statement is about all times."""
    seconds: float
    """Time that the call took [s]."""
    rates: dict[float, float]
    """Weight w that was tried -> the largest V_w' that was found."""
    violation: Violation | None
    """None unless the verdict is REFUTED."""
    assumptions: tuple[str, ...]
    """What the statement assumes, in sentences."""
    growth_points: tuple[GrowthPoint, ...] = ()
    """For each weight a point with V_w' > 0, if every weight has one; () otherwise."""
    torque: TorqueRange | None = None
    """The torque of the law on the set, with bounds if the verdict is PROVED; None for a plant in
    strict-feedback form, with `disturbance_rate` or errors of measurements, and where V_w' > 0
    at each weight."""
    held_rates: np.ndarray | None = None
    """Of a sampled loop, proved bounds on the set of the rates of the law's torque, of the lag of
    the observer, and of f of the law's torque, (3, n) [N m/s]; with errors of measurements or
    active limits two rows more, by how much they change torque and lag at a sample [N m]; with a
    delay one more, of V_w' before the first command [N m rad/s], the same for each joint; None
    without a proof of them, and of a continuous loop."""
    has_active_limits: bool = False
    """Whether the statement is that of the loop whose limits of the torque are active where the law
    commands more."""
    boxes: int = 0
    """Number of boxes that were evaluated for V_w'."""
    done: float = 0.0
    """Part of the volume on which V_w' < 0 is proved."""
    expected_boxes: tuple[float, float] | None = None
    """Number of boxes that random descents estimated before the search, infinite if one of them
    ended at a box that cannot be bisected, and the standard error of the number; None without an
    estimate."""
    worst_box: WorstBox | None = None
    """Of a proof that is not complete; None otherwise."""
    units_left: tuple[int, int] = (0, 0)
    """Units of work of the search that are not proved, which includes those that were not begun,
    and all units."""
    negative_shares: Mapping[float, float] = dataclasses.field(default_factory=dict)
    """Width of boxes at random points of these units, in parts of each coordinate -> share of those
    on which V_w' < 0 is shown; empty unless the search ended without a proof."""
    left_width: float | None = None
    """The least of these widths with boxes to which `left_intervals` belongs."""
    left_intervals: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Coordinate -> interval of the middle 90 % of the boxes of this width on which V_w' < 0 is not
    shown."""
    left_value: float | None = None
    """The largest upper bound of V_w' at the random points."""
    smaller_level_share: float | None = None
    """Share of boxes of the width 1/64 at the random points on which V_w' < 0 is shown at a quarter
    of the level."""
    level_choice: LevelChoice | None = None
    """Between which levels `prove` chose; None if the caller gave the level."""
    disturbance_rate: Any = None
    """Bound of the rate of a further disturbance, () or (n,) [N m/s]; None without one."""
    history: tuple[Attempt, ...] = ()
    """The proofs of a bisection, in their order; () for a single one."""
    searched: str = "values"
    """What the bisection varied, in words with the unit."""

    @property
    def proved(self) -> bool:
        """Whether the set is proved to be invariant."""
        return self.verdict == Verdict.PROVED

    @cached_property
    def problem(self) -> LevelSetProblem:
        """Coordinates, bounds and points of the level set."""
        from iblf_jax.proofs._prove import problem_of

        duration = None if self.is_period else self.duration
        problem = problem_of(self.scenario, self.parameters, duration, self.disturbance_rate)
        if not self.has_active_limits:
            return problem
        return checks.given(problem.with_active_limits)

    @property
    def start(self) -> DelayedStart | None:
        """The starts of a proved loop with a delay; None without a delay: all of the set, at a
        sample.
        """
        if not self.proved or not has_delay(self.scenario):
            return None
        sampling, rates = checks.given(self.scenario.sampling), checks.given(self.held_rates)
        growth = float(sampling.delay) * float(rates[-1][0])
        torque = DOWN * float(sampling.period) * rates[0]
        return DelayedStart(DOWN * (self.level - UP * growth), torque)

    @property
    def torque_limits(self) -> np.ndarray | None:
        """Least and greatest torque of the loop, (2, n) [N m]; None without limits."""
        return without_limits(self.scenario)[1]

    @property
    def point(self) -> GrowthPoint | None:
        """The point with V_w' > 0 at the best weight; None if there is none."""
        return min(self.growth_points, key=lambda point: point.rate, default=None)

    @property
    def tube(self) -> GuaranteedTube:
        """Positions in {V_w <= level} over the time interval.

        w_i V1_i <= V_w, so that e1_i is between the two errors at which V1_i = level/w_i.
        """
        return tube_of_level(self.scenario, self.level, self.duration)

    def replay(self, record_every: int = 1) -> Rollout:
        """The run that refutes the statement.

        Args:
          record_every: steps between two records.

        Raises:
          ValueError: the verdict is not REFUTED.
        """
        if self.violation is None:
            remedy = "Only a refuted statement has a run that contradicts it."
            raise checks.fail("verdict", str(self.verdict), str(Verdict.REFUTED), remedy)
        found = self.violation
        with jax.enable_x64(True):
            return simulate(
                found.scenario, duration=found.duration, dt=found.dt, record_every=record_every
            )

    def adversarial_runs(
        self, count: int, *, duration: float | None = None, dt: float = 1e-3, seed: int = 0
    ) -> list[Rollout]:
        """Runs that start at t = 0 at points of V_w = level with parameters at the ends of their
        intervals.

        A loop with a delay starts on the level of `start`, at points with an admitted torque; there
        may be fewer.

        Args:
          count: number of runs.
          duration: length of each run [s]; the time interval of the proof if not given.
          dt: time step [s]; a shorter one, where a period of samples is no multiple of it.
          seed: of the random points.
        """
        count = checks.positive_integer("count", count, least=0)
        dt = step_within(self.scenario, dt)
        steps = math.ceil((duration or self.duration or AT_REST) / dt)
        start = self.start
        level = self.level if start is None else start.level
        constants = self.problem.constants(self.weight, level)
        candidates = count if start is None else CANDIDATES * count
        points = self.problem.sample(seed, 2 * candidates)[::2]
        points[:, 0] = 0.0
        if start is not None:
            points = self._near_balance(points, constants, start)[:count]
        every = max(1, steps // INSTANTS)
        with jax.enable_x64(True):
            return [
                simulate(
                    self.problem.scenario_at(point, constants),
                    duration=steps * dt,
                    dt=dt,
                    record_every=every,
                )
                for point in points
            ]

    def _near_balance(
        self, points: np.ndarray, constants: list[np.ndarray], start: DelayedStart
    ) -> np.ndarray:
        """Points at which the torque before the first command, G0(q), is near that of the law."""
        torques = self.problem.torques(points, constants)
        model = checks.given(plants.as_plant(self.scenario.model).robot)
        with jax.enable_x64(True):
            q = [self.problem.state_of(point, constants).q for point in points]
            gravity = np.array([model.gravity(x) for x in q])
        return points[np.all(np.abs(torques - gravity) <= start.torque, axis=1)]

    def plot(self, **options: Any) -> Any:
        """The tube over the reference with the bounds; see `plotting.guaranteed_tube`."""
        return present("proof figure", self, **options)

    def to_xarray(self) -> xarray.Dataset:
        """Tube, verdict and numbers as a dataset."""
        return present("proof dataset", self)

    def _content(self) -> Content:
        return [self.sentence(), *self.details()]

    def sentence(self) -> str:
        """The statement and its verdict as one sentence."""
        times = f"0 <= t <= {self.duration:.4g} s"
        if self.is_period:
            times = "all t"
        uncertain = "the plant as given"
        if self.ranges:
            uncertain = "every plant of the box of parameters"
        within = ""
        if self.proved and self.torque_limits is not None:
            within = ", and the torque stays within its limits"
            if self.has_active_limits:
                within = " with its limits of the torque, which may be active"
        sampled = ""
        if self.scenario.sampling is not None:
            sampled = f" of the loop sampled every {float(self.scenario.sampling.period):.4g} s"
        statement = _STATEMENTS.get(self.verdict)
        if has_delay(self.scenario):
            delay = float(checks.given(self.scenario.sampling).delay)
            sampled = f"{sampled} with delays up to {delay:.4g} s"
            if self.start is not None:
                statement = f"not left by runs from {{V_w <= {self.start.level:.4g}}}"
        if self.violation is not None:
            statement = self.violation.statement
        return (
            f"{self.verdict.upper()}: {{V_w <= {self.level:.4g}}}{sampled} is"
            f" {statement} for {times} and {uncertain}{within}."
        )

    def details(self) -> list[str]:
        """What was found, as lines."""
        lines = list(tables.as_text(_rows(self.ranges), left=(0, 1)))
        if self.level_choice is not None:
            lines.append(
                f"The level was chosen: the start has V_w <= {self.level_choice.start:.4g}, and up"
                f" to {self.level_choice.largest:.4g} no point with V_w' > 0 was found."
            )
        if self.proved:
            xi = self.tube.xi.max(axis=0)
            texts = ", ".join(f"{math.ceil(x * 1e4) / 1e4:.4g}" for x in xi)
            names = ", ".join(plants.component_names(self.scenario.plant))
            if np.any(np.ptp(self.tube.xi, axis=0) > CONSTANT * xi):
                names += f", the largest of {INSTANTS} instants"
            starts = "every start in the set" if self.start is None else "these starts"
            lines.append(f"Guaranteed for {starts}: |xi| <= {texts} ({names}).")
            lines += self._about_start()
        lines += self._about_torque()
        if self.verdict == Verdict.NOT_PROVED and self.point is not None:
            tried = len(self.growth_points)
            order = ""
            if self.scenario.sampling is not None:
                order = ", to first order in the period,"
            lines.append(
                f"For each of the {tried} weights tried, V_w' > 0{order} at a point of the level"
                " set."
            )
            lines.append(f"  {self.point!r}")
            lines.append("This refutes the Lyapunov function, not the bounds.")
        if self.violation is not None:
            found = self.violation
            entries = found.state._asdict().items()
            named = (f"{name} = {_numbers(value)}" for name, value in entries if np.size(value))
            lines.append(
                f"The run of {found.duration:.4g} s from {', '.join(named)} {found.found};"
                " replay() returns it."
            )
        if self.verdict == Verdict.UNDECIDED:
            lines += self._why_undecided()
        expected = ""
        if self.expected_boxes is not None:
            boxes, error = self.expected_boxes
            expected = f" ({boxes:.2g} expected, standard error {error:.1g})"
            if not math.isfinite(boxes):
                expected = " (no number is enough, by random descents)"
        lines.append(
            f"w = {self.weight:.3g}, {self.boxes:,} boxes{expected}, {self.seconds:.3g} s."
        )
        if self.history:
            lines += self._about_search()
        lines += [f"Assumed: {sentence}" for sentence in self.assumptions if self.proved]
        return lines

    def _about_search(self) -> list[str]:
        """Which values a bisection tried, and of which others nothing is known."""
        values = ", ".join(f"{x.value:.4g} {x.verdict}" for x in self.history)
        tried = f"Tried {self.searched}: {values}."
        proved = [x.value for x in self.history if x.verdict == Verdict.PROVED]
        if not proved:
            return [tried, "The least value of the range is not proved; no greater one was tried."]
        largest = max(proved)
        beyond = [x for x in self.history if x.value > largest]
        if not beyond:
            return [tried, "The greatest value of the range is proved; none beyond it was tried."]
        next_one = min(beyond, key=lambda x: x.value)
        return [
            tried,
            f"The greatest value with a proof is {largest:.4g}, the next one that was tried is"
            f" {next_one.value:.4g} ({next_one.verdict}). Nothing is claimed of values that were"
            " not tried.",
        ]

    def _about_start(self) -> list[str]:
        """The torque before the first command of a loop with a delay."""
        if self.start is None:
            return []
        names = plants.component_names(self.scenario.plant)
        sizes = zip(names, self.start.torque, strict=True)
        # rounded down
        listed = ", ".join(f"{name} {math.floor(size * 1e3) / 1e3:.6g}" for name, size in sizes)
        return [
            "Starts are those at which the torque before the first command differs from the law's"
            f" one by at most [N m]: {listed}."
        ]

    def _about_torque(self) -> list[str]:
        """The torque on the set, and what it means for limits."""
        found, limits = self.torque, self.torque_limits
        if found is None:
            return []
        names = plants.component_names(self.scenario.plant)
        ends = zip(names, found.found_lowest, found.found_highest, strict=True)
        listed = ", ".join(f"{name} {low:.3g} to {high:.3g}" for name, low, high in ends)
        lines = [f"Torque that was found on the level set [N m]: {listed}."]
        if found.is_proved:
            largest = zip(names, found.largest, strict=True)
            # rounded up
            texts = (f"{name} {math.ceil(size * 1e3) / 1e3:.6g}" for name, size in largest)
            where = "on the whole set" if self.start is None else "from the first command on"
            lines.append(f"Guaranteed {where} [N m]: |tau| <= {', '.join(texts)}.")
        if limits is None:
            return lines
        if self.has_active_limits:
            ends = zip(names, *limits, strict=True)
            listed = ", ".join(f"{name} {low:.4g} to {high:.4g}" for name, low, high in ends)
            lines.append(
                f"That is the torque of the law before its limits, {listed} N m, cut it; V_w' is"
                " that of the loop with these limits."
            )
        elif found.excess(limits) > 0.0:
            lines.append(
                "That is beyond the limits at this weight, and at every other one with V_w' < 0."
                " A smaller level, larger limits, or gains with less torque help. Limits of"
                " Saturated without an auxiliary state may be active."
            )
        elif self.done == 1.0 and not found.is_proved:
            lines.append(
                f"It is not proved to stay within its limits with {found.boxes:,} boxes: increase"
                " max_boxes, or the limits."
            )
        return lines

    def _why_undecided(self) -> list[str]:
        if self.scenario.sampling is not None and self.held_rates is None:
            return [
                "The rate of the law's torque on the set has no proved bound, which the statement"
                " needs: a shorter period or delay, a smaller level, more boxes or other gains"
                " help."
            ]
        lines = [f"V_w' < 0 is proved on {100.0 * self.done:.3g} % of the volume."]
        lines += self._what_is_left()
        box = self.worst_box
        if box is None:
            return lines
        lines.append(f"Worst box: V_w' <= {box.bound:+.4g}, {box.value:+.4g} at its centre:")
        lines += tables.as_text(_rows(box.intervals), left=(0, 1))
        if box.decisive is not None and box.bound >= 0.0:
            lines.append(
                f"The width of {box.decisive} raises the bound most: it is"
                f" {box.narrowed[box.decisive]:+.4g} without it."
            )
        return lines

    def _what_is_left(self) -> list[str]:
        """Where the boxes are that are left, and what is likely to help."""
        if self.left_width is None or self.left_value is None:
            return []
        left, units = self.units_left
        lines = [
            f"{left:,} of {units:,} units of work are not finished or not begun. At random points"
            f" of them V_w' <= {self.left_value:+.4g}, and of boxes around the points this share"
            " has a negative bound, by their width in parts of each coordinate:"
        ]
        shares = self.negative_shares.items()
        lines.append("  " + ", ".join(f"1/{1.0 / w:.0f}: {_percent(share)}" for w, share in shares))
        if self.left_intervals:
            lines.append(
                f"The middle 90 % of the others of width 1/{1.0 / self.left_width:.0f} are at:"
            )
            lines += tables.as_text(_rows(self.left_intervals), left=(0, 1))
        return [*lines, self._remedy()]

    def _remedy(self) -> str:
        """What is likely to help."""
        narrower = f"A smaller level, {self._changes()} help."
        if self.left_value is not None and self.left_value >= 0.0:
            return (
                f"The bound is not negative at a point, so that more boxes do not help. {narrower}"
            )
        negative = [width for width, share in self.negative_shares.items() if share == 1.0]
        widest = max(negative, default=0.0)
        if widest >= REACHED:
            return f"All of width 1/{1.0 / widest:.0f} are negative: increase max_boxes."
        return (
            f"Some of width 1/{1.0 / REACHED:.0f} are not negative, which takes many more boxes."
            f" {self._about_smaller_level()}"
        )

    def _changes(self) -> str:
        """What else than a level and boxes may be changed, in words."""
        changes = ["narrower intervals"]
        if self.scenario.sampling is not None:
            changes.append("a shorter period")
        if self.has_active_limits:
            changes.append("larger limits")
        return f"{', '.join(changes)} or other gains"

    def _about_smaller_level(self) -> str:
        """Whether a smaller level is likely to help, from the same boxes at such a level."""
        share, now = self.smaller_level_share, self.negative_shares[REACHED]
        at = f"level={SMALLER_LEVEL * self.level:.4g}"
        if share == 1.0:
            return f"All of them are negative with {at}, which is likely to be proved."
        if share is None or share <= now:
            return f"No more of them are negative with {at}: {self._changes()} help."
        return (
            f"With {at}, {_percent(share)} of them are negative: a level below it,"
            f" {self._changes()} help."
        )


_STATEMENTS = {
    Verdict.PROVED: "invariant",
    Verdict.NOT_PROVED: "not shown to be invariant by V_w",
    Verdict.UNDECIDED: "neither proved nor refuted to be invariant",
}


def _rows(intervals: Mapping[str, tuple[float, float]]) -> list[tuple[str, str, str]]:
    """Intervals as rows of a table."""
    return [("", name, f"{low:.6g} to {high:.6g}") for name, (low, high) in intervals.items()]


def _percent(share: float) -> str:
    """A share in per cent, which is 100 only if it is 1."""
    return f"{math.floor(1000.0 * share) / 10.0:g} %"


def _numbers(value: np.ndarray | float | Mapping[str, float]) -> str:
    """Numbers as text."""
    if isinstance(value, Mapping):
        return ", ".join(f"{path} {number:.5g}" for path, number in value.items())
    texts = [f"{x:.5g}" for x in np.ravel(value)]
    return texts[0] if np.ndim(value) == 0 else f"({', '.join(texts)})"


@jax.enable_x64(True)
def tube_of_level(scenario: Scenario, level: float, duration: float) -> GuaranteedTube:
    """Positions in {V_w <= level} over time."""
    scenario = canonical(astype(scenario, jnp.float64))
    barrier, weight = position_barrier(unwrapped(scenario.controller))
    times = jnp.linspace(0.0, duration or AT_REST, INSTANTS)

    def ends(t):
        tube = scenario.context.tube(t)
        values = jnp.broadcast_to(level / weight, tube.q_d.shape)
        below = barrier.error_at(values, tube, jnp.zeros(values.shape, bool))
        above = barrier.error_at(values, tube, jnp.ones(values.shape, bool))
        assert below is not None
        assert above is not None
        xi = jnp.maximum(-below / tube.k_l, above / tube.k_u)
        return tube.q_d, tube.q_d + below, tube.q_d + above, tube.lower, tube.upper, xi

    found = jax.vmap(ends)(times)
    return GuaranteedTube(np.asarray(times), *(np.asarray(x) for x in found))
