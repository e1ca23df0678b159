"""`failure_probability`: the probability that a run leaves its bounds, also where no study of
10,000 runs shows a failure.

The perturbations are functions of d independent standard normal numbers z, and a run fails where
its margin y(z) is not above a limit, or where it diverges.  Subset simulation and Monte-Carlo need
margins only; importance sampling begins at the design points, which are found by the gradients of
the margin of each joint, side and window of time (`margins.pieces_of_margins`).
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.progress import announced, bar
from iblf_jax.core.pytree import astype
from iblf_jax.core.status import UNTRUSTED, Status, has_flag
from iblf_jax.engine import RunRequest, differentiates_forward, takes_runs
from iblf_jax.simulation.metrics import Margin, RegionMargin, VelocityMargin, check_needs
from iblf_jax.simulation.noise import check_method, has_noise
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.simulation.units import unit_text
from iblf_jax.studies.designs import MAX_RUNS
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.options import LocalExecutor, RunOptions, executor_of
from iblf_jax.studies.rare_events.crude import crude_monte_carlo
from iblf_jax.studies.rare_events.design_points import Pieces, design_points
from iblf_jax.studies.rare_events.importance import importance_sampling
from iblf_jax.studies.rare_events.limit_state import (
    NO_RUN,
    Estimate,
    Samples,
    log_normal_interval,
)
from iblf_jax.studies.rare_events.normal_space import MARGINS as METRICS
from iblf_jax.studies.rare_events.normal_space import (
    NormalSpace,
    check_varied,
    is_discrete,
)
from iblf_jax.studies.rare_events.result import (
    FailureProbability,
    FailureSamples,
    LikelyFailure,
)
from iblf_jax.studies.rare_events.subset import subset_simulation
from iblf_jax.studies.statistics import check_confidence
from iblf_jax.studies.study_setup import prepare
from iblf_jax.studies.summaries import initial_margins
from iblf_jax.tuning.margins import pieces_of_margins
from iblf_jax.tuning.quantities import DEFICITS, SIGNAL_OF_MARGIN, Peak
from iblf_jax.tuning.rollouts import WINDOWS
from iblf_jax.tuning.runs import in_groups

RUNS = {"subset": 4000, "importance": 4096, "monte_carlo": 10_000}
"""Estimator -> default of `runs`."""
LEAST_RUNS = {"subset": 100, "importance": 100, "monte_carlo": 1}
"""Estimator -> least number of `runs`: 10 chains in each level of subset simulation, and enough
weights for a fit of their tail."""
FOLDS: dict[str, type[Any]] = {
    "positions": Margin,
    "velocities": VelocityMargin,
    "regions": RegionMargin,
}
"""What may fail -> the fold that has its margin."""
LEVEL_PROBABILITY = 0.1
"""Conditional probability of the levels of subset simulation."""
MAX_LEVELS = 20
"""Largest number of levels: probabilities down to 1e-20."""
SEARCHES_TOGETHER = 16
"""Points whose gradients are computed in one batch."""
COARSE_RUNS = 500
"""Samples of a level of the subset simulation from whose failures searches for design points
start."""
COARSE_CONFIDENCE = 0.999
"""Confidence of its interval in the check of importance sampling.  An interval of 95 % from so few
samples is above the probability in 3 % of the calls."""
CHECK_RUNS = 1024
"""Number of runs of importance sampling that check an estimate of subset simulation."""
NEAREST = 8
"""Number of sampled failures, the nearest ones, at which searches for design points start."""
RAYS = 4
"""Number of points of each kind along whose rays the most likely failure is searched."""
FRACTIONS = np.linspace(0.25, 1.0625, 53)
"""Where on a ray, in units of its point: steps of 1/64, so that one of them is 1, the sampled
failure itself."""
NOMINAL_FAILS = (
    "The run at the medians of all draws fails already (margin {margin:.3g} {unit} above the"
    " limit), so failures are no rare events here."
)
NO_DESIGN_POINT = (
    "The search by gradients found no failure, so the samples are distributed around the nominal"
    " run, as in Monte-Carlo simulation."
)
MISSED_BY_IMPORTANCE = (
    "A subset simulation with few samples gave {coarse:.2g}, and even the lower end of its interval"
    " at {confidence:.1%} confidence, {low:.2g}, is larger: the design points probably do not"
    " represent all failures. Use estimator='subset'."
)
NOT_REACHED_BY_IMPORTANCE = (
    "No sample around the design points failed; the subset simulation with few samples from which"
    " they were searched is reported instead. Use estimator='subset' or take more runs."
)
NOISE = (
    "The random numbers of the noise are drawn anew for each point, which the Markov chains of"
    " subset simulation cannot follow: where noise contributes to failures, the interval is too"
    " narrow. Compare with estimator='monte_carlo' at a probability that it can show."
)
MISSED = (
    "Subset simulation gave {subset:.3g} and missed failures near a design point, because its"
    " levels went towards other failures; importance sampling around the design points is"
    " reported instead."
)
DISAGREE = (
    "Importance sampling around the design points gave {other:.2g}, which is larger, but from"
    " degenerate weights: one of the two misses failures. Take more runs."
)
UNSAMPLED = (
    "None of the sampled failures is near the design point at distance {distance:.2f}, which has"
    " about {share:.0%} of the probability if the limits are planes: the samples may miss these"
    " failures. Compare with estimator='importance'."
)
LARGE_SHARE = 0.1
"""Share of the probability from which on a design point without sampled failures is named."""
NOT_REACHED = (
    "Subset simulation reached no failure (upper bound {subset:.2g}); importance sampling around"
    " the design points is reported instead."
)


class FailureOptions(NamedTuple):
    """The checked arguments of `failure_probability` that are not those of runs."""

    estimator: str
    margin: str
    limit: float
    confidence: float
    runs: int


@notices.each_warning_once
@announced("compiling the programs of an estimate of a failure probability")
@takes_runs
def failure_probability(
    scenario: Scenario,
    perturbations: Mapping[str, Perturbation],
    *,
    duration: float,
    dt: float = 1e-3,
    estimator: str = "subset",
    runs: int | None = None,
    margin: str = "positions",
    limit: float = 0.0,
    confidence: float = 0.95,
    seed: int = 0,
    method: str = "rk4",
    backend: str = "auto",
    executor: LocalExecutor | Executor | None = None,
    progress: bool | None = None,
) -> FailureProbability:
    """The probability that a run with random parameters fails, down to 1e-8 and below.

        p = P(min over t and joints of min(q - lower, upper - q) <= limit, or the run diverges)

    Args:
      scenario: what to run, of n joints.
      perturbations: path -> `factor`, `offset` or `value` of a distribution.
      duration: length of a run [s], a whole number of steps.
      dt: time step [s].
      estimator: "subset", subset simulation, for any margin; "importance", importance sampling
        around the failures nearest to the nominal run, which are found by gradients: fewer runs
        where few such points represent all failures; a note says where the samples show that they
        do not;
        "monte_carlo", independent draws.
      runs: number of runs; for "subset" of each level, of which there is one for each factor of
        ten; at least 100, for "monte_carlo" 1.  4000, 4096 and 10,000 if not given.  The search
        for design points, the check of the estimate and the search for the most likely failure take
        some 2000 runs more.
      margin: which margin fails: of the "positions", the "velocities" or the "regions".
      limit: margin at which a run fails, in its unit.
      confidence: of the interval, in (0, 1).
      seed: whole number that fixes all draws.
      method: "rk4", "heun" or "euler", "euler_maruyama" or "stochastic_heun" with process noise.
      backend: "auto", "native", "gpu" or "vmap".
      executor: where the runs are computed, as in `monte_carlo`.
      progress: a progress bar; by default it is shown on a terminal.
      runs_as: an `ij.Runs`, in place of its fields.

    Returns:
      A `FailureProbability`: estimate, interval, coefficient of variation, levels, the most likely
      failure.  If no sample failed, the estimate is an upper bound.  Draws that cannot be run are
      excluded and counted; runs that diverge are failures.  The probability includes the noise of a
      scenario, which subset simulation represents less well than Monte-Carlo simulation.

    Raises:
      ValueError: bad arguments, or a discrete distribution with estimator="importance".
      ij.studies.WorkerError: as `monte_carlo`.

    Source: S. K. Au, J. L. Beck, Probabilistic Engineering Mechanics 16 (2001) 263-277; the modules
      of `iblf_jax.studies.rare_events`.
    """
    options = _checked(estimator, margin, limit, confidence, runs)
    scenario = canonical(scenario)
    check_method(scenario, method)
    executor = executor_of(executor)
    run_options = RunOptions(duration, dt, method, backend, seed, runs=options.runs)
    check_varied(perturbations)
    check_needs("margin", FOLDS[margin], scenario)
    prepared = prepare(scenario, perturbations, run_options, (FOLDS[margin](),))
    if options.estimator == "importance" and is_discrete(prepared.perturbations):
        expected = "continuous distributions, as gradients are needed"
        remedy = "Use estimator='subset', which needs none."
        raise checks.fail("perturbations", "a discrete distribution", expected, remedy)
    expected_runs = {"subset": 5 * options.runs}.get(options.estimator, options.runs)
    with bar(progress, expected_runs) as shown:
        space = NormalSpace(prepared, METRICS[margin], options.limit, executor, shown.update)
        checks.fits_memory("runs", options.runs, 8.0 * 4 * space.size)
        found = _found(space, options)
    space.warn()
    arguments: dict[str, Any] = {
        "duration": run_options.duration,
        "dt": run_options.dt,
        "method": method,
        "estimator": options.estimator,
        "runs": options.runs,
        "margin": options.margin,
        "limit": options.limit,
        "confidence": options.confidence,
        "seed": run_options.seed,
        "backend": backend,
    }
    return _result(space, options, found, arguments)


def _checked(
    estimator: str, margin: str, limit: float, confidence: float, runs: int | None
) -> FailureOptions:
    checks.one_of("estimator", estimator, tuple(RUNS))
    checks.one_of("margin", margin, tuple(FOLDS))
    number = float(checks.number_between("limit", limit, -1e9, 1e9, "the margin's unit"))
    confidence = check_confidence(confidence)
    if runs is None:
        runs = RUNS[estimator]
    runs = checks.positive_integer("runs", runs, least=LEAST_RUNS[estimator], most=MAX_RUNS)
    return FailureOptions(estimator, margin, number, confidence, runs)


class _Checked(NamedTuple):
    """An estimate with what its check saw."""

    estimate: Estimate
    points: np.ndarray
    """The design points, nearest first, (K, d)."""
    check: str
    """What a second method found, in a sentence."""


class _Found(NamedTuple):
    """The estimate and what was found with it."""

    checked: _Checked
    nominal: float
    """Margin at z = 0."""
    likely: np.ndarray | None
    """The most likely failure, (d,)."""
    likely_margin: float
    likely_status: int
    gradient_runs: int


def _found(space: NormalSpace, options: FailureOptions) -> _Found:
    """The estimate by the method, and the most likely failure."""
    seed = space.prepared.options.seed
    origin = np.zeros((1, space.size))
    nominal = float(space(origin)[0])
    pieces = PiecesOfMargin(space, options)
    if options.estimator == "importance":
        checked = _by_importance(space, options, pieces, nominal)
    elif options.estimator == "subset":
        estimate = _by_subset(space, options, options.runs)
        checked = _checked_by_importance(space, options, pieces, estimate, nominal)
    else:
        estimate = crude_monte_carlo(
            space, space.size, runs=options.runs, seed=seed, confidence=options.confidence
        )
        checked = _Checked(estimate, np.zeros((0, space.size)), "Independent draws need no check.")
    if nominal <= 0:
        likely, margin, status = origin[0], nominal, int(space.status[0][0])
        return _Found(checked, nominal, likely, margin, status, pieces.runs)
    likely, margin, status = _most_likely(space, checked.estimate.failures, checked.points)
    return _Found(checked, nominal, likely, margin, status, pieces.runs)


class PiecesOfMargin:
    """The margins of the joints and sides of runs in windows of time, with gradients, at points z;
    NaN for points that cannot be run.

    Args:
      space: the runs by standard normal numbers.
      options: which margin fails, and at which limit.
    """

    def __init__(self, space: NormalSpace, options: FailureOptions):
        prepared = space.prepared
        self.space = space
        self.limit = options.limit
        self.dtype = prepared.scenario.initial.q.dtype
        one: Any = 1.0
        run = prepared.options
        windows: Any = np.arange(1, WINDOWS) / WINDOWS * run.duration
        self.peak = astype(Peak(one, SIGNAL_OF_MARGIN[options.margin], windows=windows), self.dtype)
        self.request = run.request(prepared.scenario)
        self.runs = 0
        """Runs with gradients until now."""

    @property
    def is_available(self) -> bool:
        """Whether the margin has a gradient that is computed in forward mode."""
        has_gradient = not is_discrete(self.space.prepared.perturbations)
        return has_gradient and differentiates_forward(self.space.size)

    def __call__(self, z: np.ndarray) -> Pieces:
        self.runs += len(z)
        cube, step = self.space.cube, self.space.prepared.shared.dt

        def of_rows(rows: np.ndarray) -> Any:
            points = jnp.asarray(z[rows], self.dtype)
            return pieces_of_margins(cube, self.peak, step, points, request=self.request)

        margins, gradients, status = in_groups(of_rows, len(z), SEARCHES_TOGETHER)
        is_valid = self.space.admissible(z) & ~has_flag(status, UNTRUSTED)
        margins = np.where(is_valid[:, None], margins - self.limit, np.nan)
        return Pieces(margins.astype(float), gradients.astype(float))


def _by_importance(
    space: NormalSpace, options: FailureOptions, pieces: PiecesOfMargin, nominal: float
) -> _Checked:
    """The estimate by importance sampling, with the subset simulation that checks it.

    The searches start at the origin and at the nearest failures of a subset simulation with few
    samples: gradients at the origin alone miss failures where a margin saturates on the way.
    """
    origin, points = np.zeros((1, space.size)), np.zeros((0, space.size))
    notes: tuple[str, ...] = ()
    coarse: Estimate | None = None
    if not nominal <= 0:  # also for NaN, a median draw that cannot be run
        coarse = _by_subset(space, options, COARSE_RUNS)
        points, _ = design_points(pieces, _nearest(coarse.failures))
        notes = () if len(points) else (NO_DESIGN_POINT,)
    centres = points if len(points) else origin
    estimate = _importance_estimate(space, options, centres, options.runs)
    if coarse is None:
        check = "Not checked: the run at the medians of all draws fails."
        return _Checked(estimate._replace(notes=(*notes, *estimate.notes)), points, check)
    place = _points_in_words(points) if len(points) else "the medians of all draws"
    check = (
        f"The samples are around {place}. Check: a subset simulation with"
        f" {COARSE_RUNS} samples a level gave {_in_words(coarse, options)}."
    )
    if not coarse.is_upper_bound:
        if estimate.is_upper_bound and NO_RUN not in estimate.notes:
            notes = (NOT_REACHED_BY_IMPORTANCE, *notes, *coarse.notes)
            return _Checked(coarse._replace(notes=notes), points, check)
        notes = (*notes, *_missed_by_importance(estimate, coarse))
    return _Checked(estimate._replace(notes=(*notes, *estimate.notes)), points, check)


def _points_in_words(points: np.ndarray) -> str:
    """How many design points there are, and how far."""
    radius = np.linalg.norm(points, axis=1)
    if len(radius) == 1:
        return f"one design point at distance {radius[0]:.2f}"
    return f"{len(radius)} design points at distances {radius[0]:.2f} to {radius[-1]:.2f}"


def _in_words(estimate: Estimate, options: FailureOptions) -> str:
    """The probability of an estimate with its interval."""
    if estimate.is_upper_bound:
        return f"no failure, a probability of at most {estimate.probability:.2g}"
    interval = f"{100 * options.confidence:g}% interval {estimate.low:.2g} to {estimate.high:.2g}"
    return f"{estimate.probability:.2g} ({interval})"


def _unsampled(points: np.ndarray, failures: Samples) -> tuple[str, ...]:
    """A note for each design point with a large share of the probability to which no sampled
    failure is the nearest.
    """
    from scipy.special import ndtr

    if not len(failures.z):
        return ()
    radius = np.linalg.norm(points, axis=1)
    shares = ndtr(-radius) / np.sum(ndtr(-radius))
    # Failures beyond the limit of a design point are those whose direction is most like its own.
    nearest = np.argmax(failures.z @ (points / radius[:, None]).T / radius, axis=1)
    return tuple(
        UNSAMPLED.format(distance=radius[k], share=shares[k])
        for k in range(len(points))
        if shares[k] >= LARGE_SHARE and not np.any(nearest == k)
    )


def _missed_by_importance(estimate: Estimate, coarse: Estimate) -> tuple[str, ...]:
    """A note if a subset simulation with few samples shows that an estimate is too small."""
    variation = coarse.coefficient_of_variation
    low, _ = log_normal_interval(coarse.probability, variation, COARSE_CONFIDENCE)
    if low <= estimate.high:
        return ()
    return (
        MISSED_BY_IMPORTANCE.format(
            coarse=coarse.probability, confidence=COARSE_CONFIDENCE, low=low
        ),
    )


def _by_subset(space: NormalSpace, options: FailureOptions, runs: int) -> Estimate:
    return subset_simulation(
        space,
        space.size,
        runs=runs,
        share=LEVEL_PROBABILITY,
        levels=MAX_LEVELS,
        seed=space.prepared.options.seed,
        confidence=options.confidence,
    )


def _importance_estimate(
    space: NormalSpace, options: FailureOptions, points: np.ndarray, runs: int
) -> Estimate:
    return importance_sampling(
        space,
        points,
        runs=runs,
        seed=space.prepared.options.seed,
        confidence=options.confidence,
        runnable=space.runnable_share(),
    )


def _nearest(failures: Samples) -> np.ndarray:
    """The sampled failures nearest to the origin, (k, d)."""
    order = np.argsort(np.linalg.norm(failures.z, axis=1), kind="stable")
    return failures.z[order[:NEAREST]]


def _checked_by_importance(
    space: NormalSpace,
    options: FailureOptions,
    pieces: PiecesOfMargin,
    estimate: Estimate,
    nominal: float,
) -> _Checked:
    """The estimate of subset simulation, or one of importance sampling if that shows that failures
    were missed.

    Samples of intermediate levels go where most margins are small, which need not be where most
    failures are.  Nothing in the samples shows this; design points do.
    """
    none = np.zeros((0, space.size))
    if nominal <= 0:
        return _Checked(estimate, none, "Not checked: the run at the medians of all draws fails.")
    if not pieces.is_available:
        check = "Not checked: the margin has no gradient by the draws, as those of a choice."
        return _Checked(estimate, none, check)
    points, _ = design_points(pieces, _nearest(estimate.failures))
    if not len(points):
        check = "Not checked: searches by gradients for the nearest failures found none."
        return _Checked(estimate, points, check)
    if estimate.estimator != "subset":
        check = f"The searches by gradients found {_points_in_words(points)}."
        return _Checked(estimate, points, check)
    second = _importance_estimate(space, options, points, CHECK_RUNS)
    check = (
        f"Check: {CHECK_RUNS} samples around {_points_in_words(points)} gave"
        f" {_in_words(second, options)}."
    )
    notes = (*estimate.notes, *_unsampled(points, estimate.failures))
    estimate = estimate._replace(notes=notes)
    if second.is_upper_bound or (not estimate.is_upper_bound and second.low <= estimate.high):
        return _Checked(estimate, points, check)
    note = MISSED.format(subset=estimate.probability)
    if estimate.is_upper_bound:
        note = NOT_REACHED.format(subset=estimate.probability)
    elif second.notes:
        note = DISAGREE.format(other=second.probability)
        return _Checked(estimate._replace(notes=(*estimate.notes, note)), points, check)
    return _Checked(second._replace(notes=(note, *second.notes)), points, check)


def _most_likely(
    space: NormalSpace, failures: Samples, points: np.ndarray
) -> tuple[np.ndarray | None, float, int]:
    """The failure nearest to the origin, its margin and status, on the rays through design points
    and the nearest sampled failures.
    """
    ends = np.concatenate([points[:RAYS], _nearest(failures)[:RAYS]])
    fractions = FRACTIONS
    best: np.ndarray | None = None
    margin = np.nan
    status = 0
    for _ in range(2):
        if not len(ends):
            break
        z = (fractions[:, None, None] * ends).reshape(-1, space.size)
        margins = space(z)
        flags = space.status[-1]
        radius = np.where(margins <= 0, np.linalg.norm(z, axis=1), np.inf)
        i = int(np.argmin(radius))
        if not np.isfinite(radius[i]):
            break
        if best is None or radius[i] < np.linalg.norm(best):
            best, margin, status = z[i], float(margins[i]), int(flags[i])
        # The second pass is between the nearest failure and the last point before it.
        spacing = fractions[1] - fractions[0]
        first = 1 - spacing / fractions[i // len(ends)]
        ends, fractions = best[None], np.linspace(first, 1.0, len(FRACTIONS))
    return best, margin, status


def _result(
    space: NormalSpace, options: FailureOptions, found: _Found, arguments: dict[str, Any]
) -> FailureProbability:
    estimate = found.checked.estimate
    unit = unit_text(space.prepared.scenario, DEFICITS[SIGNAL_OF_MARGIN[options.margin]])
    notes = list(estimate.notes)
    if found.nominal <= 0:
        notes.insert(0, NOMINAL_FAILS.format(margin=found.nominal, unit=unit))
    if estimate.estimator == "subset" and has_noise(space.prepared.scenario):
        notes.append(NOISE)
    status = np.concatenate(space.status)
    failures = _samples(space, estimate.failures)
    return FailureProbability(
        estimate=estimate.probability,
        interval=(estimate.low, estimate.high),
        confidence=options.confidence,
        coefficient_of_variation=estimate.coefficient_of_variation,
        is_upper_bound=estimate.is_upper_bound,
        runs=space.runs + found.gradient_runs,
        levels=estimate.levels,
        most_likely_failure=_likely(space, found),
        failures=failures,
        nearby=_samples(space, estimate.nearby),
        nearby_probability=estimate.nearby_probability,
        names=tuple(space.names()),
        nominal_margin=found.nominal,
        effective_samples=estimate.effective_samples,
        excluded=int(np.sum(has_flag(status, Status.INADMISSIBLE_DRAW))),
        diverged=int(np.sum(has_flag(status, Status.NOT_FINITE))),
        started_outside=_started_outside(space, failures),
        notes=tuple(notes),
        check=found.checked.check,
        design_points=found.checked.points,
        estimator=estimate.estimator,
        unit=unit,
        arguments=arguments,
    )


def _samples(space: NormalSpace, samples: Samples) -> FailureSamples:
    return FailureSamples(samples.z, space.values(samples.z), samples.margins, samples.weights)


def _likely(space: NormalSpace, found: _Found) -> LikelyFailure | None:
    if found.likely is None:
        return None
    values = {path: x[0] for path, x in space.values(found.likely[None]).items()}
    prepared = space.prepared
    scenario = with_parameters(prepared.scenario, values)
    run = prepared.options
    return LikelyFailure(
        scenario=scenario,
        values=values,
        z=found.likely,
        names=tuple(space.names()),
        margin=found.likely_margin,
        status=found.likely_status,
        request=RunRequest.of(scenario, steps=run.steps, method=run.method, record_every=1),
        dt=prepared.shared.dt,
        noise=space.noise(found.likely),
    )


def _started_outside(space: NormalSpace, failures: FailureSamples) -> int:
    """Number of failures that were drawn outside their bounds at t = 0."""
    if not len(failures):
        return 0
    first = initial_margins(space.prepared.scenario, jax.tree.map(jnp.asarray, failures.values))
    inside = [np.min(margins, axis=1) > 0 for margins in first.values()]
    return int(np.sum(~np.all(inside, axis=0)))
