"""The result of `identify`: an `Identification`, which prints as a table."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.core import checks, tables
from iblf_jax.core.presentation import present
from iblf_jax.identification.coordinates import (
    DELAY_PATH,
    DELAY_SCALE,
    Coordinates,
    plant_path,
    to_x,
)
from iblf_jax.identification.problem import IdentificationProblem, missing_terms_of_fit
from iblf_jax.identification.regression import InitialEstimate
from iblf_jax.identification.shooting import Refinement, Windows
from iblf_jax.identification.statistics import (
    IDENTIFIABLE_BELOW,
    Uncertainty,
    Whiteness,
    describe_direction,
    uncertainty,
    whiteness,
)
from iblf_jax.identification.structure import MissingTerms, biased, describe_finding, remedy_for
from iblf_jax.simulation import paths
from iblf_jax.simulation.paths import parameters, with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.distributions import Perturbation, joint_normal, value
from iblf_jax.world.robots import joint_names

COLOURED_PROBABILITY, MIN_AUTOCORRELATION = 1e-3, 0.05
"""Probability (Ljung and Box) below which residuals count as coloured, if an autocorrelation is
above the second."""
INCOMPLETE_RATIO, MIN_NOISE = 1.5, 1e-5
"""Residual relative to the positions' noise above which the model is incomplete, and the smallest
noise that is assumed [rad]."""
MORE_THAN_NOISE = 1.05
"""Residual relative to the positions' noise above which missing terms are searched."""
REPORTED_RATIO = 1.1
"""Ratio of standard errors to those for white noise above which a note reports it."""
MIN_INFORMATION = 1e-8
"""Information of a combination, relative to the best one, above which it enters the step without
limits."""
AT_END = 1e-6
"""Distance from a limit, in scales, within which a number is at it."""


class Number(NamedTuple):
    """One identified parameter."""

    name: str
    unit: str
    start: float
    value: float | None
    """None where the log does not identify it."""
    error: float | None
    """Standard error."""
    verdict: str
    """One of the constants below: `IDENTIFIED`, `NOT_IDENTIFIABLE`, `LIMITED`, `NOT_ESTIMATED` for
    the width of a friction that does not obey this law, or `BIASED` where a missing term moves the
    value by more than its standard error or by more than 5 %."""
    bias: float | None = None
    """The bias by missing terms, where it is biased."""

    @property
    def digits(self) -> str:
        """The value, to the second digit of its error."""
        if self.value is None or not self.error:
            return "" if self.value is None else f"{self.value:.5g}"
        return f"{self.value:.{min(max(1 - math.floor(math.log10(self.error)), 0), 12)}f}"


class Fit(NamedTuple):
    """Residuals of one joint's positions, root mean square over windows with their best starts."""

    joint: str
    before: float
    """With the parameters of the start [rad]."""
    after: float
    held_back: float
    """On windows that were held back [rad]; NaN without any."""
    correlation: float
    """The largest absolute autocorrelation of the residuals."""
    white: float
    """Probability of such an autocorrelation in white noise."""
    explained: float
    """Share of the torque's variation that the regression explained."""
    noise: float
    """Logged positions about smooth curves: noise and quantisation of the encoder [rad]."""

    @property
    def lacking(self) -> float:
        """The residual relative to the noise of the positions."""
        return self.after / max(self.noise, MIN_NOISE)

    @property
    def has_structure(self) -> bool:
        """Whether the residuals may have a cause: they are larger than the positions' noise, or
        coloured and no rounding.
        """
        return self.lacking > MORE_THAN_NOISE or (not self.is_white and self.after > MIN_NOISE)

    @property
    def is_white(self) -> bool:
        """Whether the residuals are white: no significant correlation of more than
        MIN_AUTOCORRELATION.
        """
        return self.white >= COLOURED_PROBABILITY or self.correlation < MIN_AUTOCORRELATION


@dataclasses.dataclass(frozen=True, eq=False)
class Identification:
    """Parameters from a log: values, standard errors, and what the log does not identify."""

    scenario: Scenario
    """The scenario with the new parameters, in plant and model for paths of the robot or the plant;
    parameters that are not identifiable have values that agree with the identifiable ones."""
    start: Scenario
    paths: tuple[str, ...]
    """The requested paths, and after them the widths of friction that were identified as well."""
    asked: int
    """Number of requested paths."""
    numbers: tuple[Number, ...]
    covariance: np.ndarray
    """Of the parameters, (p, p); zero where one is not identifiable."""
    delay: float
    """Delay of the logged torque [s]."""
    delay_error: float | None
    """Its standard error, infinite if it is not identifiable; None if it was given."""
    singular_values: np.ndarray
    """Of the combinations, in decreasing order; their inverses are the standard errors, in the
    parameters' scales, (p,)."""
    combinations: tuple[str, ...]
    """The combinations of parameters in their scales, as text with their paths."""
    untold: tuple[str, ...]
    """The combinations that the log does not identify."""
    scales: np.ndarray
    """(p,), in the parameters' units."""
    fit: tuple[Fit, ...]
    residuals: np.ndarray
    """Logged less simulated positions, (W, K + 1, n) [rad]."""
    times: np.ndarray
    """(W, K + 1) [s]."""
    kept: np.ndarray
    """Which windows were fitted, (W,)."""
    autocorrelations: np.ndarray
    """Of the residuals, lags 1, 2, ..., (n, L)."""
    notes: tuple[str, ...]
    logs: tuple[str, ...]
    steps: int
    seconds: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, (p,)."""
        return tuple(number.name for number in self.numbers)

    @property
    def wanted(self) -> tuple[Number, ...]:
        """The requested parameters, without the added widths."""
        return self.numbers[
            : sum(
                math.prod(np.shape(paths.get(self.start, path)))
                for path in self.paths[: self.asked]
            )
        ]

    @cached_property
    def values(self) -> dict[str, np.ndarray]:
        """Path -> value in the leaf's unit, NaN where it is not identifiable."""
        return self._by_path(
            [math.nan if number.value is None else number.value for number in self.numbers]
        )

    @cached_property
    def standard_errors(self) -> dict[str, np.ndarray]:
        """Path -> standard error in the leaf's unit, infinite where it is not identifiable."""
        return self._by_path(
            [math.inf if number.error is None else number.error for number in self.numbers]
        )

    @property
    def correlation(self) -> np.ndarray:
        """Of the numbers' errors, (p, p); NaN where one is not identifiable."""
        size = np.sqrt(np.diag(self.covariance))
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.covariance / size[:, None] / size

    def _by_path(self, x: list[float]) -> dict[str, np.ndarray]:
        found, first = {}, 0
        for path in self.paths:
            shape = np.shape(paths.get(self.start, path))
            size = math.prod(shape)
            found[path] = np.array(x[first : first + size]).reshape(shape)
            first += size
        return found

    @cached_property
    def perturbations(self) -> dict[str, Perturbation]:
        """The remaining uncertainty for `monte_carlo`, `sweep` and `tune`: the identified
        parameters of the plant, jointly normal.

        x = value + L w,   L L^T = covariance,   w standard normal, the same for all paths
        """
        identified = [
            i
            for i, number in enumerate(self.wanted)
            if number.error is not None and number.verdict == IDENTIFIED
        ]
        size, axes = np.linalg.eigh(self.covariance[np.ix_(identified, identified)])
        factor = np.zeros((len(self.numbers), len(identified)))
        factor[identified] = axes * np.sqrt(np.maximum(size, 0.0))
        found, first = {}, 0
        for path in self.paths[: self.asked]:
            own, shape = plant_path(path), np.shape(paths.get(self.start, path))
            these = range(first, first + math.prod(shape))
            first += len(these)
            if all(i in identified for i in these):
                mean = np.array([self.numbers[i].value for i in these]).reshape(shape)
                found[own] = value(
                    joint_normal(mean, factor[list(these)].reshape(*shape, -1), GROUP)
                )
                continue
            for i in these:
                if i in identified:
                    entry = plant_path(self.numbers[i].name)
                    found[entry] = value(joint_normal(self.numbers[i].value, factor[i], GROUP))
        return found

    def __repr__(self) -> str:
        return "\n".join(
            [
                self._heading(),
                *tables.as_text([HEADING, *self._rows()]),
                "",
                *tables.as_text([FIT, *self._fits()]),
                *self._lines(),
            ]
        )

    def _repr_html_(self) -> str:
        return present("card", self)

    def words(self) -> list[str]:
        """The text besides the tables, line by line."""
        return [self._heading(), *(line.strip() for line in self._lines())]

    def tables_html(self) -> dict[str, str]:
        """Its tables as HTML, with parameters that are not identifiable or biased in bold."""
        bold = [
            i
            for i, number in enumerate(self.numbers)
            if number.verdict in (NOT_IDENTIFIABLE, BIASED)
        ]
        return {
            "Numbers": tables.as_html(HEADING, self._rows(), bold),
            "Fit": tables.as_html(FIT, self._fits()),
        }

    def _heading(self) -> str:
        W, back = int(np.sum(self.kept)), int(np.sum(~self.kept))
        length = float(np.mean(self.times[:, -1] - self.times[:, 0]))
        looked = [number for number in self.numbers if number.verdict != NOT_ESTIMATED]
        count = sum(number.value is not None for number in looked)
        windows = f"{W} windows of {length:.3g} s fitted, {back} held back"
        return (
            f"Identification: {count} of {len(looked)} numbers told; {windows}; {self.steps} steps,"
            f" {self.seconds:.3g} s"
        )

    def _rows(self) -> list[tuple[str, ...]]:
        rows: list[tuple[str, ...]] = []
        for x in self.numbers:
            found = (
                x.digits,
                *(
                    ("", "")
                    if x.error is None or x.value is None
                    else (f"{x.error:.2g}", _share(x.error, x.value))
                ),
            )
            rows.append((x.name, x.unit, f"{x.start:.5g}", *found, x.verdict))
        return rows

    def _fits(self) -> list[tuple[str, ...]]:
        return [
            (
                f.joint,
                *(f"{x:.3g}" for x in (f.before, f.after, f.held_back)),
                f"{f.correlation:.2g}",
                "white" if f.is_white else "coloured",
                f"{f.explained:.1%}",
            )
            for f in self.fit
        ]

    def _lines(self) -> list[str]:
        lines = [f"  cannot be told: {words}" for words in self.untold]
        delay = f"  the logged torque {self._delay_in_words()}"
        return [*lines, delay, *(f"  {note}" for note in self.notes)]

    def _delay_in_words(self) -> str:
        if self.delay_error == math.inf:
            return "is late by what the log cannot tell"
        error = "given"
        if self.delay_error is not None:
            error = f"+- {1e3 * self.delay_error:.2g} ms"
        if self.delay < -3.0 * (self.delay_error or 0.0):
            return f"acts {-1e3 * self.delay:.3g} ms before its time ({error})"
        return f"acts {1e3 * self.delay:.3g} ms late ({error})"

    def to_dict(self) -> dict[str, Any]:
        """Everything but the residuals as plain numbers, strings and lists, for strict JSON (no
        NaN, no infinity).
        """
        return _for_json({
            "what": "iblf_jax identification",
            "logs": self.logs,
            "numbers": [number._asdict() for number in self.numbers],
            "covariance": self.covariance,
            "correlation": self.correlation,
            "delay": self.delay,
            "delay_error": self.delay_error,
            "singular_values": self.singular_values,
            "combinations": self.combinations,
            "untold": self.untold,
            "scales": self.scales,
            "fit": [fit._asdict() for fit in self.fit],
            "autocorrelations": self.autocorrelations,
            "windows": {"fitted": int(np.sum(self.kept)), "held_back": int(np.sum(~self.kept))},
            "notes": self.notes,
            "steps": self.steps,
            "seconds": self.seconds,
        })  # fmt: skip

    def save(self, path: str | os.PathLike) -> None:
        """Writes the report: numbers as JSON, or numbers and figure as one page of HTML; the
        ending, ".json" or ".html", decides.

        Raises:
          ValueError: another ending.
          OSError: the file cannot be written.
        """
        target = checks.file_to_write("path", path, "a file that ends in .json or .html")
        ending = target.suffix.lower()
        if ending not in (".json", ".html"):
            raise checks.fail("path", str(target), "a file that ends in .json or .html")
        if ending == ".json":
            target.write_text(
                json.dumps(self.to_dict(), indent=1, allow_nan=False), encoding="utf-8"
            )
            return
        present("report", self, target)

    def plot(self, **options):
        """Figure: values with standard errors, combinations, and residuals.  Options as
        `plotting.identification`.
        """
        return present("identification figure", self, **options)


IDENTIFIED, NOT_IDENTIFIABLE, LIMITED, NOT_ESTIMATED, BIASED = (
    "told",
    "cannot be told",
    "at its limit",
    "left free",
    "biased",
)
"""Verdicts."""
GROUP = "identified"
"""Name of the draws that all identified numbers share."""
HEADING = ("number", "unit", "start", "value", "standard error", "relative", "verdict")
FIT = (
    "joint",
    "rms before [rad]",
    "rms after [rad]",
    "rms held back [rad]",
    "autocorrelation",
    "what is left is",
    "torque explained",
)


def _share(error: float, of: float) -> str:
    if not of:
        return ""
    return f"{100 * error / abs(of):.2g} %"


def _for_json(x: Any) -> Any:
    if isinstance(x, dict):
        return {str(key): _for_json(y) for key, y in x.items()}
    if isinstance(x, list | tuple):
        return [_for_json(y) for y in x]
    if isinstance(x, np.ndarray | np.generic):
        return _for_json(x.tolist())
    if isinstance(x, float) and not math.isfinite(x):
        return None
    return x


def assessed(
    problem: IdentificationProblem,
    guess: InitialEstimate,
    end: Refinement,
    before: np.ndarray,
    friction_ratio: float,
    seconds: float,
) -> Identification:
    """The result of a fit, with its statistics.

    Args:
      problem: what was identified from which data.
      guess: the regression.
      end: the fit.
      before: residuals with the parameters of the start.
      friction_ratio: residual of the friction law relative to that of free torques near standstill;
        0 without free torques.
      seconds: computing time.
    """
    start, c, windows = problem.start, problem.coordinates, problem.windows
    white = [
        whiteness(end.statistics.residuals[windows.kept][:, :, j])
        for j in range(windows.y.shape[-1])
    ]
    fit = _fits(start, windows, end, before, white, guess)
    scale = np.append(guess.scale, DELAY_SCALE)
    statistics = _statistics(problem, end, scale, max(one.lacking for one in fit))
    x = np.where(end.free.fixed, c.x, to_x(c, end.z[:-1])[0])
    missing = MissingTerms((), np.zeros(len(x)))
    if any(one.has_structure for one in fit):
        fitted = statistics.estimated & ~_at_limits(end, problem.limits, scale)
        missing = missing_terms_of_fit(problem.simulated, c, problem.smooth, end.z, fitted)
    bias = biased(missing, x, statistics.errors[:-1])
    numbers = tuple(
        _number(
            c,
            i,
            float(x[i]),
            float(statistics.errors[i]),
            statistics.beyond[i],
            end,
            problem.limits,
            scale,
            float(bias[i]),
        )
        for i in range(len(x))
    )
    scenario, scenario_notes = _with_numbers(start, c, x, end.z[-1])
    notes = (
        *_left_out_in_words(start, missing, numbers),
        *scenario_notes,
        *_note_on_early_torque(c, end, statistics.errors[-1]),
        *_limited(c, numbers, statistics.beyond, problem.limits),
        *_notes(statistics.uncertainty, numbers, fit),
        *_freed(start, end, friction_ratio),
    )
    return Identification(
        scenario=scenario,
        start=start,
        paths=c.paths,
        asked=problem.requested,
        numbers=numbers,
        covariance=statistics.covariance[:-1, :-1],
        delay=float(end.z[-1]),
        delay_error=float(statistics.errors[-1]) if problem.estimates_delay else None,
        singular_values=statistics.uncertainty.singular,
        combinations=statistics.combinations,
        untold=statistics.unidentifiable,
        scales=scale[:-1],
        fit=fit,
        residuals=end.statistics.residuals,
        times=windows.t,
        kept=windows.kept,
        autocorrelations=np.array([one.correlations for one in white]),
        notes=notes,
        logs=tuple(log.name for log in problem.logs),
        steps=end.steps,
        seconds=seconds,
    )


class _Statistics(NamedTuple):
    """The uncertainty of a fit; arrays have the p parameters and the delay."""

    estimated: np.ndarray
    """Entries that are estimated, (p + 1,) bool."""
    uncertainty: Uncertainty
    errors: np.ndarray
    """Standard errors, (p + 1,); infinite where an entry is not estimated."""
    covariance: np.ndarray
    """(p + 1, p + 1); zero where an entry is not estimated."""
    beyond: np.ndarray
    """The step that the log suggests without limits, (p + 1,)."""
    combinations: tuple[str, ...]
    """The combinations of parameters, from the best one on."""

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """The combinations that the log does not identify."""
        pairs = zip(self.combinations, self.uncertainty.singular, strict=True)
        return tuple(text for text, size in pairs if not size > 1.0 / IDENTIFIABLE_BELOW)


def _statistics(
    problem: IdentificationProblem, end: Refinement, scale: np.ndarray, lacking: float
) -> _Statistics:
    """The statistics of a fit.

    Args:
      problem: what was identified from which data.
      end: the fit.
      scale: of the parameters and the delay, (p + 1,).
      lacking: the largest residual, relative to the noise of the positions.
    """
    kept = problem.windows.kept
    x, slope = to_x(problem.coordinates, end.z[:-1])
    p = len(x)
    z_by_x = np.eye(p + 1)
    z_by_x[:p, :p] = np.linalg.inv(slope)
    estimated = np.append(~end.free.fixed, problem.estimates_delay)
    both = np.ix_(estimated, estimated)
    information = (z_by_x.T @ end.statistics.information[kept] @ z_by_x)[:, estimated][
        :, :, estimated
    ]
    scores = (end.statistics.scores[kept] @ z_by_x)[:, estimated]
    precision = np.zeros((p + 1, p + 1))
    precision[:p, :p] = problem.prior.precision
    if lacking <= INCOMPLETE_RATIO:  # the residuals are noise
        lacking = 1.0
    found = uncertainty(information, scores, precision[both], scale[estimated], lacking)
    errors = np.full(p + 1, np.inf)
    errors[estimated] = found.errors
    covariance = np.zeros((p + 1, p + 1))
    covariance[both] = found.covariance
    from_prior = precision @ np.append(x - problem.prior.mean, 0.0)
    all_scores = scores + from_prior[estimated] / len(scores)
    beyond = np.zeros(p + 1)
    beyond[estimated] = _without_limits(information, all_scores, scale[estimated])
    names = np.array([*problem.coordinates.names, "the torque's delay"])[estimated]
    combinations = tuple(
        describe_direction(direction, tuple(names)) for direction in found.directions.T
    )
    return _Statistics(estimated, found, errors, covariance, beyond, combinations)


def _note_on_early_torque(c: Coordinates, end: Refinement, delay_error: float) -> list[str]:
    """A note where the delay of the torque is estimated to be negative."""
    if not c.delay or not end.z[-1] < -3.0 * delay_error:
        return []
    return [
        "The logged torque acts before its time: it is not the command, and the scenario's"
        " delay is 0."
    ]


def _without_limits(information: np.ndarray, scores: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """The Gauss-Newton step without limits."""
    A, g = np.sum(information, axis=0) * scale[:, None] * scale, np.sum(scores, axis=0) * scale
    return -scale * np.linalg.lstsq(A, g, rcond=MIN_INFORMATION)[0]


def _at_limits(end: Refinement, ends: tuple[np.ndarray, ...], scale: np.ndarray) -> np.ndarray:
    """Which parameters, the delay last, are at a limit, (p + 1,) bool."""
    return np.any([np.abs(end.z - side) < AT_END * scale for side in ends], axis=0)


def _left_out_in_words(
    start: Scenario, lacks: MissingTerms, numbers: tuple[Number, ...]
) -> list[str]:
    """Notes on missing terms, remedies, and the parameters that they bias."""
    joints = joint_names(start.plant, start.n)
    available = [
        p.path
        for p in parameters(start, named=False)
        if p.path.startswith(("plant.", "disturbance."))
    ]
    names = tuple(number.name for number in numbers)
    lines = [
        describe_finding(one, joints[one.joint], remedy_for(one, available, names))
        for one in lacks.findings
    ]
    moved = [f"{x.name} by about {x.bias:+.2g} {x.unit}" for x in numbers if x.verdict == BIASED]
    if moved:
        lines.append(
            f"These numbers make up for what was left out, and are biased: {', '.join(moved)}."
        )
    return lines


def _number(
    c: Coordinates,
    i: int,
    x: float,
    error: float,
    beyond: float,
    end: Refinement,
    ends: tuple[np.ndarray, ...],
    scale: np.ndarray,
    bias: float = 0.0,
) -> Number:
    def number(value, error, verdict):
        return Number(c.names[i], c.units[i], float(c.x[i]), value, error, verdict)

    if end.free.fixed[i]:
        return number(None, None, NOT_ESTIMATED)
    at_low, at_high = (abs(end.z[i] - side[i]) < AT_END * scale[i] for side in ends)
    if not np.isfinite(error):
        tolerance = AT_END * scale[i]
        if (at_low and beyond < -tolerance) or (at_high and beyond > tolerance):
            return number(x, None, LIMITED)
        return number(None, None, NOT_IDENTIFIABLE)
    if at_low or at_high:
        return number(x, error, LIMITED)
    if bias:
        return number(x, error, BIASED)._replace(bias=bias)
    return number(x, error, IDENTIFIED)


def _fits(
    start: Scenario,
    w: Windows,
    end: Refinement,
    before: np.ndarray,
    white: list[Whiteness],
    guess: InitialEstimate,
) -> tuple[Fit, ...]:
    def rms(r, windows):
        if not np.any(windows):
            return np.full(r.shape[-1], np.nan)
        return np.sqrt(np.mean(r[windows] ** 2, axis=(0, 1)))

    residuals = end.statistics.residuals
    first = rms(before, w.kept)
    fitted = rms(residuals, w.kept)
    others = rms(residuals, ~w.kept)
    return tuple(
        Fit(
            joint=name,
            before=float(first[j]),
            after=float(fitted[j]),
            held_back=float(others[j]),
            correlation=float(np.max(np.abs(white[j].correlations))),
            white=white[j].p,
            explained=float(guess.explained[j]),
            noise=float(guess.noise[j]),
        )
        for j, name in enumerate(joint_names(start.plant, start.n))
    )


def _notes(found: Uncertainty, numbers: tuple[Number, ...], fit: tuple[Fit, ...]) -> list[str]:
    notes = []
    widest = float(np.max(found.widened))
    if not all(one.is_white for one in fit) and widest > REPORTED_RATIO:
        notes.append(
            f"What is left is coloured: standard errors are up to {widest:.2g} times those of white"
            " noise."
        )
    worst = max(fit, key=lambda one: one.lacking)
    bound = any(number.verdict == LIMITED for number in numbers)
    likely = (
        f"{'what a limit excludes, ' if bound else ''}dry friction that is not looked for, play, a"
        " torque in between samples"
    )
    if worst.lacking > INCOMPLETE_RATIO:
        notes.append(
            f"What is left of {worst.joint} is {worst.lacking:.2g} times the noise of its"
            f" positions: the model lacks something ({likely}), and all standard errors are that"
            " much larger for it"
            + (
                "; a model that fits tells more."
                if any(number.value is None for number in numbers)
                else "."
            )
        )
    return notes


def _limited(
    c: Coordinates, numbers: tuple[Number, ...], beyond: np.ndarray, ends: tuple[np.ndarray, ...]
) -> list[str]:
    """Notes on active limits, and the values that the log suggests."""
    notes = []
    for place, path in zip(c.places, c.paths, strict=True):
        for i in range(place.start, place.start + place.size):
            x = numbers[i]
            if x.verdict == LIMITED and x.value is not None:
                side = "lower" if abs(x.value - ends[0][i]) < abs(x.value - ends[1][i]) else "upper"
                notes.append(
                    f"{x.name} is at its limit, {x.value:.4g} {x.unit}, and the log asks for about"
                    f" {x.value + beyond[i]:.4g}: its standard error says nothing, and other"
                    f" numbers make up for it.  The {side} end of limits[{path!r}] moves it."
                )
    return notes


def _freed(start: Scenario, end: Refinement, worse: float) -> list[str]:
    """A note on free torques near standstill."""
    share = end.free.share
    if not np.any(share):
        return []
    names = [
        name for name, part in zip(joint_names(start.plant, start.n), share, strict=True) if part
    ]
    whose = ", ".join(names)
    if len(names) == start.n:
        whose = "all joints"
    least, most = _percent(share[share > 0].min()), _percent(share.max())
    parts = " to ".join(dict.fromkeys((least, most))) + " %"
    return [
        f"About standstill (slower than {end.free.slow:g} rad/s: {parts} of the time) torques were"
        f" free in place of the friction of {whose}: coulomb tanh(q' / width) leaves {worse:.2g}"
        " times as much.  The widths are the scenario's."
    ]


def _percent(share: float) -> str:
    digits = int(share <= 0.1)
    return f"{100 * share:.{digits}f}"


def _with_numbers(
    start: Scenario, c: Coordinates, x: np.ndarray, delay: float
) -> tuple[Scenario, list[str]]:
    """The scenario with the new parameters."""
    scenario, notes = start, []
    for path, place in zip(c.paths, c.places, strict=True):
        own = x[place.start : place.start + place.size].reshape(place.shape)
        targets = [path]
        if path.startswith(("robot.", "plant.")):
            targets = ["plant" + path[5:], "model" + path[5:]]
        for target in targets:
            try:
                scenario = with_parameters(scenario, {target: own})
            except ValueError:
                if target == path or target.startswith("plant"):
                    raise
                notes.append(f"The model has no {target}: only the plant has this parameter.")
    if c.delay:
        scenario = with_parameters(scenario, {DELAY_PATH: max(delay, 0.0)})
    return scenario, notes
