"""Default ranges of what is tuned: within the conditions of Theorem 2, and within the capabilities
of time step, sampling period and drive.

The lower end of a gain of a continuous law is k1 > 0, K2 > 1/2 (for a barrier of weight 1) or
kf > 1 where all its entries start there, otherwise its sign decides.  Theorem 2 does not hold for
sampled laws, and a light joint needs a smaller K2: there these gains may fall to x0 / MAX_FACTOR.

The upper end of a gain x is f x0 with the largest f <= MAX_FACTOR for which the loop without
perturbations, at the start and along its reference, satisfies

    dt |lambda|_max <= STABILITY_FRACTION R                     for a continuous law,
    rho(map from a period to the next) < 1                      for a sampled law,

where R is the stability range of the integrator, and, where there is a sensor, the drive at rest
can deliver each torque of |d tau / d y_j| r_j and (sum_kj (d tau / d w_kj)^2)^(1/2).  One count r_j
of a joint's encoder, and one standard deviation of all its noise w, are steps of the command that
the motion does not need.  Where such a step alone exceeds the torque of a drive, or its rate
(bandwidth times the step, behind a lag), the drive tracks the encoder.  A drive that the starting
gains already exceed sets no limit.

First each gain is examined with the others at their start.  Then all gains with default ranges are
scaled together, each to f_i^s x0, with the largest s up to 1 for which the same conditions hold.

Other leaves are examined one at a time, with everything else at the start:

| Leaf | Lower end | Upper end |
|---|---|---|
| cut-off or bandwidth w of the sensor | the conditions | the conditions, w <= pi / T |
| bandwidth w of the actuator | the conditions | the conditions, dt w <= STABILITY_FRACTION R |
| time constant of the law | the conditions | the conditions |
| period T of the sampling | the conditions, T >= dt, the queue | the conditions |
| delay of the sampling | 0 | the conditions, the queue |
| own positive number of a plant in strict-feedback form | the conditions | the conditions |
| constant upper bound of a level above the first | the start of the level | none |
| constant lower bound of a level above the first | none | the start of the level |

Numbers of a robot inside a plant have the ranges of a robot's.  The period is a whole number of
steps dt, and so are both ends of its range.  The queue of the sampling has to hold all commands in
transit, delay / T + 1 of them.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.sensors import Sensor
from iblf_jax.core import checks, programs
from iblf_jax.core.pytree import unwrapped
from iblf_jax.engine.period import radius_at
from iblf_jax.engine.step_size import fastest_along, start_and_along
from iblf_jax.simulation import paths
from iblf_jax.simulation.closed_loop import LoopState, run_sampled_law
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.levels import start_levels
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.sampling import commands_in_transit
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world import plants

THEOREM_LIMITS = {"controller.k1": 0.05, "controller.K2": 0.505, "observer.kf": 1.01}
"""Default lower limits: just inside Theorem 2's conditions (3.17), (3.25) on the gains of the
paper's law.  That on K2 holds for a barrier of weight 1."""
STABILITY_FRACTION = 0.7
"""Part of the integrator's stability range that gains may use by default."""
TIMES = np.linspace(0.0, 6.0, 7)
"""Along the reference, at which the loop is examined [s]."""
MAX_FACTOR = 1e2
"""Largest upper end of a gain by default, relative to its start."""
BISECTION_STEPS = 10
WHOLE_TOLERANCE = 1e-6
"""Distance [steps] at which a period is rounded to a whole number of steps."""
QUEUE_FRACTION = 0.999
"""Longest delay by default, relative to the one that the queue of the sampling no longer holds."""
LEAST_SHARE = 0.01
"""Upper end of a delay, as a share of the way to the longest one, where already the start violates
a condition; and the least distance of a bound to the start of its level, relative to that at the
start."""
FACTOR_BEYOND_CONDITION = 1.01
"""Upper end of a gain, relative to its start, where already the start violates a condition."""
AS_GIVEN = "as given"
BY_THEOREM = "the conditions of Theorem 2"
BY_SIGN = "its sign"
UNLIMITED = "none"
BY_FACTOR = f"{MAX_FACTOR:g} times its start"
BY_SMALL_FACTOR = f"{1 / MAX_FACTOR:g} times its start"
BY_STEP = "beyond it the step dt is too long for the loop"
BY_PERIOD = "beyond it the unperturbed loop is unstable at its sampling period"
AT_START = {
    BY_STEP: (
        "the step dt is too long for the loop already at the start, so this end is close to it;"
        " take a smaller dt, or give a range"
    ),
    BY_PERIOD: (
        "the sampled loop is unstable already at the start, so this end is close to it; start at"
        " gains of a stable loop, or give a range"
    ),
}
"""The reason of an end where already the start violates a condition."""
BY_COUNT = (
    "beyond it one count of the encoder commands more torque, or a higher rate of it, than the"
    " drive can deliver"
)
BY_NOISE = (
    "beyond it the sensor's noise commands more torque, or a higher rate of it, than the drive can"
    " deliver"
)
BY_NYQUIST = "the Nyquist frequency of the sampling"
BY_ONE_STEP = "one time step dt, of which a period is a whole multiple"
BY_LEVEL = "beyond it the run starts outside the bound"
BY_QUEUE = "beyond it more commands are in transit than Sampling.queue holds"
TOGETHER = ", with all gains at their upper ends"
K2 = "controller.K2"
PERIOD = "sampling.period"
DELAY = "sampling.delay"
FREQUENCY = re.compile(r"(sensor|actuator)\..*?(cutoff|bandwidth)(\[\d+\])*$")
"""Paths of cut-off frequencies and bandwidths."""
LEVEL_BOUND = re.compile(r"bounds\[([1-9]\d*)\]\.(lower|upper)\.value((?:\[\d+\])*)$")
"""Paths of constant bounds of the levels above the first."""

SMOOTHING = re.compile(r"controller\.(law\.)*decays\[\d+\]\.(a|delta)(\[\d+\])*$")
"""Paths of the numbers of a decay whose small values make the gain at zero error large."""
LOWER_POWER = re.compile(r"controller\.(law\.)*decays\[\d+\]\.a(\[\d+\])*$")
UPPER_POWER = re.compile(r"controller\.(law\.)*decays\[\d+\]\.b(\[\d+\])*$")
BY_POWER = "beyond it the decay has no power on this side of 1"


class End(NamedTuple):
    """An end of the range of a leaf."""

    value: np.ndarray
    """One number for all entries, or one each, in the unit of the leaf."""
    reason: str
    """Why it is there, in words."""


class Conditions:
    """The conditions on the loop that default ranges keep.

    Args:
      scenario: canonical.
      dt, method: time step [s] and integrator of the runs.
    """

    def __init__(self, scenario: Scenario, dt: float, method: str):
        self.scenario = scenario
        self.dt = dt
        self.largest_mode = STABILITY_FRACTION * tableau(method).stability / dt
        """Of a mode that the integrator follows [1/s]."""

    @cached_property
    def limited_by_drive(self) -> bool:
        """Whether what the drive can deliver is a condition: whether it holds at the start."""
        return not drive_exceeded(self.scenario)

    def violated(self, values: dict[str, np.ndarray]) -> str:
        """Which condition is violated with these values of leaves; empty where none is."""
        arrays = {path: jnp.asarray(x) for path, x in values.items()}
        changed = with_parameters(self.scenario, arrays)
        if changed.sampling is None:
            return BY_STEP if fastest_along(changed, TIMES) > self.largest_mode else ""
        if sampled_too_slowly(changed):
            return BY_PERIOD
        return drive_exceeded(changed) if self.limited_by_drive else ""

    def reach(self, starts: dict[str, np.ndarray], logarithms: dict[str, float]) -> Reach:
        """How far leaves can be scaled together, each to start exp(s logarithm)."""

        def violated(s: float) -> str:
            return self.violated({p: starts[p] * np.exp(s * x) for p, x in logarithms.items()})

        return _reach(violated)


def default_lows(
    scenario: Scenario, starts: dict[str, np.ndarray], dt: float, method: str
) -> dict[str, End]:
    """The lower ends of the ranges of some leaves.

    Args:
      scenario: canonical.
      starts: path -> start of the leaf.
      dt, method: time step [s] and integrator of the runs.
    """
    conditions = Conditions(scenario, dt, method)
    return {path: _default_low(conditions, path, start) for path, start in starts.items()}


def _default_low(conditions: Conditions, path: str, start: np.ndarray) -> End:
    scenario = conditions.scenario
    if LEVEL_BOUND.match(path) and ".upper." in path:
        return _bound_at_start(scenario, path, start)
    leaf = re.sub(r"(\[\d+\])+$", "", path)
    is_examined = _is_time(scenario, path) or _is_of_chain(scenario, path)
    if UPPER_POWER.match(path):
        return End(np.ones(()), BY_POWER)
    is_examined = is_examined or bool(SMOOTHING.match(path))
    if np.all(start > 0) and (is_examined or FREQUENCY.match(path)):
        return _single_end(conditions, path, start, 1.0 / MAX_FACTOR, BY_SMALL_FACTOR)
    if scenario.sampling is not None and leaf in THEOREM_LIMITS:
        return End(start / MAX_FACTOR, BY_SMALL_FACTOR)
    has_condition = leaf in THEOREM_LIMITS and (leaf != K2 or has_weight_of_the_paper(scenario))
    if has_condition and np.all(start >= THEOREM_LIMITS[leaf]):
        return End(np.asarray(THEOREM_LIMITS[leaf]), BY_THEOREM)
    if path == PERIOD:
        return _shortest_period(conditions, start)
    if paths.sign_at(scenario, path) in ("positive", "nonnegative"):
        return End(np.zeros(()), BY_SIGN)
    return End(np.asarray(-np.inf), UNLIMITED)


def has_weight_of_the_paper(scenario: Scenario) -> bool:
    """Whether the weight of the law's barrier is 1 on every joint, and its gain is K2; otherwise
    Theorem 2 has no condition on K2 alone.
    """
    fields = vars(unwrapped(scenario.controller))
    if fields.get("gain_matrix") is not None:
        return False
    weight = fields.get("weight", 1.0)
    return weight is None or bool(np.all(np.asarray(weight) == 1.0))


def _is_time(scenario: Scenario, path: str) -> bool:
    """Whether a leaf is a time constant of the law or of the observer."""
    of_law = path.startswith(("controller.", "observer."))
    return of_law and paths.unit_at(scenario, path) == "s"


def _is_of_chain(scenario: Scenario, path: str) -> bool:
    """Whether a leaf is a positive number of a plant or model outside of its robot, such as a
    stiffness or an inductance: the fastest mode of the loop depends on it.
    """
    part, _, own = path.partition(".")
    if part not in ("plant", "model") or own.startswith("robot."):
        return False
    owner = vars(scenario)[part]
    is_robot = plants.as_plant(owner).robot is owner
    return not is_robot and paths.sign_at(scenario, path) == "positive"


def _bound_at_start(scenario: Scenario, path: str, start: np.ndarray) -> End:
    """The end of the range of a constant bound of a level towards the start of the level."""
    found: Any = LEVEL_BOUND.match(path)
    level = np.asarray(start_levels(scenario))[int(found[1])]
    for entry in re.findall(r"\d+", found[3]):
        level = level[int(entry)]
    return End(level + LEAST_SHARE * (start - level), BY_LEVEL)


def default_highs(
    scenario: Scenario, starts: dict[str, np.ndarray], dt: float, method: str
) -> dict[str, End]:
    """The upper ends of the ranges of some leaves; arguments as `default_lows`."""
    conditions = Conditions(scenario, dt, method)
    # The positive gains of the law and of the observer may be scaled up together.
    gains = {
        path: x
        for path, x in starts.items()
        if path.startswith(("controller.", "observer.")) and not LOWER_POWER.match(path)
        if np.all(x > 0)
    }
    others = {path: x for path, x in starts.items() if path not in gains}
    ends = {path: _default_high(conditions, path, start) for path, start in others.items()}
    return ends | _highs_of_gains(conditions, gains)


def _default_high(conditions: Conditions, path: str, start: np.ndarray) -> End:
    """The upper end of the range of a leaf that is no gain."""
    if path == PERIOD:
        return _longest_period(conditions, start)
    if LOWER_POWER.match(path):
        return End(np.ones(()), BY_POWER)
    if path == DELAY:
        return _longest_delay(conditions, start)
    if LEVEL_BOUND.match(path) and ".lower." in path:
        return _bound_at_start(conditions.scenario, path, start)
    if np.all(start > 0) and _is_of_chain(conditions.scenario, path):
        return _single_end(conditions, path, start, MAX_FACTOR, BY_FACTOR)
    if not FREQUENCY.match(path):
        return End(np.full(start.shape, np.inf), UNLIMITED)
    end = _single_end(conditions, path, start, MAX_FACTOR, BY_FACTOR)
    sampling: Any = conditions.scenario.sampling
    if path.startswith("actuator."):
        limit = End(np.asarray(conditions.largest_mode), BY_STEP)
    else:
        limit = End(np.asarray(np.pi / float(sampling.period)), BY_NYQUIST)
    if np.all(end.value <= limit.value):
        return end
    least = FACTOR_BEYOND_CONDITION * start
    return End(np.maximum(np.minimum(end.value, limit.value), least), limit.reason)


def _single_end(
    conditions: Conditions, path: str, start: np.ndarray, factor: float, by_factor: str
) -> End:
    """The end of a range at most `factor` times the start, with everything else at its start."""
    reach = conditions.reach({path: start}, {path: float(np.log(factor))})
    found = factor**reach.share
    if factor > 1:
        found = max(found, FACTOR_BEYOND_CONDITION)
    else:
        found = min(found, 1.0 / FACTOR_BEYOND_CONDITION)
    return End(found * start, reach.reason or by_factor)


def _highs_of_gains(conditions: Conditions, gains: dict[str, np.ndarray]) -> dict[str, End]:
    """The upper ends of the ranges of gains, each examined alone and then all together."""
    furthest = float(np.log(MAX_FACTOR))
    logarithms: dict[str, float] = {}
    why: dict[str, str] = {}
    for path in gains:
        single = conditions.reach(gains, {path: furthest})
        logarithms[path] = single.share * furthest
        why[path] = single.reason or BY_FACTOR
    together = Reach(1.0, "")
    if len(gains) > 1:
        together = conditions.reach(gains, logarithms)
    ends = {}
    for path, x in gains.items():
        if together.reason and logarithms[path] > 0:
            why[path] = together.reason + TOGETHER
        factor = max(np.exp(together.share * logarithms[path]), FACTOR_BEYOND_CONDITION)
        ends[path] = End(factor * x, why[path])
    return ends


def _shortest_period(conditions: Conditions, start: np.ndarray) -> End:
    """The shortest period that keeps the conditions, a whole number of steps."""
    sampling: Any = conditions.scenario.sampling
    dt = conditions.dt
    steps, reason = 1, BY_ONE_STEP
    while commands_in_transit(float(sampling.delay), steps * dt) > sampling.queue:
        steps, reason = steps + 1, BY_QUEUE
    # Periods for which the queue is too short are not examined.
    end = _single_end(conditions, PERIOD, start, float(steps * dt / start), reason)
    shortest = np.ceil(end.value / dt - WHOLE_TOLERANCE) * dt
    return End(np.minimum(shortest, start), end.reason)


def _longest_period(conditions: Conditions, start: np.ndarray) -> End:
    """The longest period that keeps the conditions, a whole number of steps."""
    dt = conditions.dt
    end = _single_end(conditions, PERIOD, start, MAX_FACTOR, BY_FACTOR)
    steps = np.floor(end.value / dt + WHOLE_TOLERANCE)
    return End(np.maximum(steps * dt, start), end.reason)


def _longest_delay(conditions: Conditions, start: np.ndarray) -> End:
    """The longest delay that keeps the conditions and whose commands the queue holds."""
    sampling: Any = conditions.scenario.sampling
    fits = QUEUE_FRACTION * sampling.queue * np.asarray(float(sampling.period))

    def violated(s: float) -> str:
        return conditions.violated({DELAY: start + s * (fits - start)})

    if fits <= start:
        expected = "a queue that holds the commands of longer delays"
        remedy = f"Such as ij.Sampling(..., queue={sampling.queue + 1})."
        raise checks.fail("Sampling.queue", sampling.queue, expected, remedy)
    reach = _reach(violated)
    if not reach.reason:
        return End(fits, BY_QUEUE)
    return End(start + max(reach.share, LEAST_SHARE) * (fits - start), reach.reason)


class Reach(NamedTuple):
    """How far a range reaches from its start."""

    share: float
    """The largest share up to 1 for which no condition is violated, 0 if there is none."""
    reason: str
    """The condition that is violated beyond it, or at the start; empty where none is."""


def _reach(violated: Callable[[float], str]) -> Reach:
    """The reach in a function of the share that returns which condition is violated."""
    reason = violated(1.0)
    if not reason:
        return Reach(1.0, "")
    at_start = violated(0.0)
    if at_start:
        return Reach(0.0, AT_START.get(at_start, at_start))
    low = 0.0
    high = 1.0
    for _ in range(BISECTION_STEPS):
        middle = 0.5 * (low + high)
        found = violated(middle)
        if found:
            high = middle
            reason = found
        else:
            low = middle
    return Reach(low, reason)


def sampled_too_slowly(scenario: Scenario) -> bool:
    """Whether the law is sampled and its loop therefore grows from one period to the next."""
    sampling = scenario.sampling
    return sampling is not None and not radius_at(scenario, float(sampling.period), TIMES) < 1.0


def drive_exceeded(scenario: Scenario) -> str:
    """Why the sensor, by a count or by its noise, commands more than the actuator can deliver from
    rest; empty where it does not.
    """
    actuator = scenario.actuator
    if scenario.sampling is None or actuator.unlimited is actuator:
        return ""
    commands = _command_steps(scenario, jnp.asarray(TIMES, scenario.initial.q.dtype))
    zero = jnp.zeros_like(scenario.initial.q)
    rest = actuator.init(zero)
    deliver = jax.vmap(lambda tau: actuator.deliver(tau, zero, rest).limited)
    for reason, torques in zip((BY_COUNT, BY_NOISE), commands, strict=True):
        if bool(jnp.any(deliver(torques.reshape(-1, scenario.n)))):
            return reason
    return ""


@programs.jit(options=programs.SHORTEST_TO_COMPILE, kept=True)
def _command_steps(scenario: Scenario, times: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Steps of the command by one count of each joint, or of each level and component of a sensor
    of levels (T + 1, m, n), and the standard deviation by the noise (T + 1, n), [N m].
    """
    sensor = scenario.sensor
    # A sensor without rounding or resolution has no counts.
    smooth = dataclasses.replace(scenario, sensor=sensor.unrounded)
    resolution = jnp.asarray(sensor.resolution, times.dtype)

    def command(t: jax.Array, state: LoopState, y: jax.Array, normal: jax.Array) -> jax.Array:
        # The sensor receives the levels, (r, n), or q alone, (n,).
        x = state.x.at[0].set(y) if y.ndim == 1 else y
        return run_sampled_law(smooth, t, state._replace(x=x), normal).sampled.commands[0]

    def at(t: jax.Array, state: LoopState) -> tuple[jax.Array, jax.Array]:
        normal = jnp.zeros((sensor.draws, scenario.n), times.dtype)
        y = state.x if isinstance(sensor, Sensor) else state.q
        by_y, by_noise = jax.jacfwd(partial(command, t, state), argnums=(0, 1))(y, normal)
        by_count = (by_y * jnp.broadcast_to(resolution, y.shape)).reshape(scenario.n, -1).T
        return by_count, jnp.sqrt(jnp.sum(by_noise**2, axis=(1, 2)))

    from_start = jnp.concatenate([jnp.zeros_like(times[:1]), times])
    return jax.vmap(at)(from_start, start_and_along(scenario, times))
