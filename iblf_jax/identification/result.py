"""What `identify` gives back: an `Identification`, which prints as a table."""

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
from iblf_jax.identification.coordinates import DELAY, OFFSET, Coordinates, to_x
from iblf_jax.identification.problem import IdentificationProblem, missing_terms
from iblf_jax.identification.regression import Start
from iblf_jax.identification.shooting import Refined, Windows
from iblf_jax.identification.statistics import UNKNOWN, Known, Whiteness, in_words, known, whiteness
from iblf_jax.identification.structure import LeftOut, biased, remedy_for
from iblf_jax.identification.structure import in_words as in_words_of
from iblf_jax.simulation import paths
from iblf_jax.simulation.paths import parameters, with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.distributions import Perturbation, joint_normal, value
from iblf_jax.world.robots import joint_names

WHITE, SLIGHT = 1e-3, 0.05
"""Probability (Ljung and Box) below which residuals count as coloured, if an autocorrelation is
above the second."""
LACKS, FINEST = 1.5, 1e-5
"""Times the positions' noise from which what is left is not noise, and the least noise that counts
[rad]."""
MORE_THAN_NOISE = 1.05
"""Times the positions' noise from which terms are looked for that the fit lacks."""
CLEARLY = 1.1
"""Times that standard errors are widened from which it is told."""
SEEN = 1e-8
"""Part of the best known combination's information from which one counts in what the log would do
without limits."""
AT_END = 1e-6
"""Distance from a limit, in scales, within which a number is at it."""


class Number(NamedTuple):
    """One number that was looked for."""

    name: str
    unit: str
    start: float
    value: float | None
    """None where the log cannot tell it."""
    error: float | None
    """Standard error."""
    verdict: str
    """"told", "cannot be told", "at its limit", "left free": the width of a friction that is not of
    this law, or "biased": a term that was left out of the fit moves it by more than its standard
    error, or by more than 5 % of it."""
    bias: float | None = None
    """What the terms that were left out add to it, where it is biased."""

    @property
    def digits(self) -> str:
        """The value, to the second digit of its error."""
        if self.value is None or not self.error:
            return "" if self.value is None else f"{self.value:.5g}"
        return f"{self.value:.{min(max(1 - math.floor(math.log10(self.error)), 0), 12)}f}"


class Fit(NamedTuple):
    """What is left of one joint's positions, root of the mean square over windows, each from the
    start that fits it best.
    """

    joint: str
    before: float
    """With the numbers of the start [rad]."""
    after: float
    held_back: float
    """On windows that were not fitted [rad]; NaN without any."""
    correlation: float
    """The largest autocorrelation of what is left, in size."""
    white: float
    """Probability of one as large in white noise."""
    explained: float
    """Share of the torque's variation that the regression explained."""
    noise: float
    """What smooth curves leave of the logged positions: noise and counts of the encoder [rad]."""

    @property
    def lacking(self) -> float:
        """How many times the noise of the positions is left."""
        return self.after / max(self.noise, FINEST)

    @property
    def has_structure(self) -> bool:
        """Whether what is left may follow something: it is more than the positions' noise, or
        coloured and no rounding.
        """
        return self.lacking > MORE_THAN_NOISE or (not self.is_white and self.after > FINEST)

    @property
    def is_white(self) -> bool:
        """Whether what is left is noise: no correlation that is both certain and of a size."""
        return self.white >= WHITE or self.correlation < SLIGHT


@dataclasses.dataclass(frozen=True, eq=False)
class Identification:
    """Parameters from a log: values, how well they are known, and what the log cannot tell."""

    scenario: Scenario
    """With the new numbers, in plant and model alike where the paths were the robot's or the
    plant's; what the log cannot tell is left where it agrees with what it can."""
    start: Scenario
    paths: tuple[str, ...]
    """As asked for, and after them the widths of friction that were looked for with it."""
    asked: int
    """How many of the paths were asked for."""
    numbers: tuple[Number, ...]
    covariance: np.ndarray
    """Of the numbers, (p, p); zero where one cannot be told."""
    delay: float
    """How late the logged torque acts [s]."""
    delay_error: float | None
    """Its standard error, infinite if it cannot be told; None if it was given."""
    singular_values: np.ndarray
    """How well each combination is known, from the best on: their inverse is its standard error, in
    the numbers' scales, (p,)."""
    combinations: tuple[str, ...]
    """The combinations, each number in its scale, by their paths."""
    untold: tuple[str, ...]
    """Those that the log cannot tell."""
    scales: np.ndarray
    """(p,), in the numbers' units."""
    fit: tuple[Fit, ...]
    residuals: np.ndarray
    """Logged less replayed positions, (W, K + 1, n) [rad]."""
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
        """What each number is called, (p,)."""
        return tuple(number.name for number in self.numbers)

    @property
    def wanted(self) -> tuple[Number, ...]:
        """The numbers that were asked for."""
        return self.numbers[
            : sum(
                math.prod(np.shape(paths.get(self.start, path)))
                for path in self.paths[: self.asked]
            )
        ]

    @cached_property
    def values(self) -> dict[str, np.ndarray]:
        """Path -> value in the leaf's unit, NaN where the log cannot tell it."""
        return self._by_path(
            [math.nan if number.value is None else number.value for number in self.numbers]
        )

    @cached_property
    def standard_errors(self) -> dict[str, np.ndarray]:
        """Path -> standard error in the leaf's unit, infinite where the log cannot tell it."""
        return self._by_path(
            [math.inf if number.error is None else number.error for number in self.numbers]
        )

    @property
    def correlation(self) -> np.ndarray:
        """Of the numbers' errors, (p, p); NaN where one cannot be told."""
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
        """What the log leaves open, for `monte_carlo`, `sweep` and `tune`: the told numbers of the
        plant, jointly normal.

        x = value + L w,   L L^T = covariance,   w standard normal, the same for all paths
        """
        told = [
            i
            for i, number in enumerate(self.wanted)
            if number.error is not None and number.verdict == TOLD
        ]
        size, axes = np.linalg.eigh(self.covariance[np.ix_(told, told)])
        factor = np.zeros((len(self.numbers), len(told)))
        factor[told] = axes * np.sqrt(np.maximum(size, 0.0))
        found, first = {}, 0
        for path in self.paths[: self.asked]:
            own, shape = _of_plant(path), np.shape(paths.get(self.start, path))
            these = range(first, first + math.prod(shape))
            first += len(these)
            if all(i in told for i in these):
                mean = np.array([self.numbers[i].value for i in these]).reshape(shape)
                found[own] = value(
                    joint_normal(mean, factor[list(these)].reshape(*shape, -1), GROUP)
                )
                continue
            for i in these:
                if i in told:
                    entry = _of_plant(self.numbers[i].name)
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
        """What there is to say besides the tables, line by line."""
        return [self._heading(), *(line.strip() for line in self._lines())]

    def tables_html(self) -> dict[str, str]:
        """Its tables as HTML, numbers that the log cannot tell, or that are biased, in bold."""
        bold = [i for i, number in enumerate(self.numbers) if number.verdict in (UNTOLD, BIASED)]
        return {
            "Numbers": tables.as_html(HEADING, self._rows(), bold),
            "Fit": tables.as_html(FIT, self._fits()),
        }

    def _heading(self) -> str:
        W, back = int(np.sum(self.kept)), int(np.sum(~self.kept))
        length = float(np.mean(self.times[:, -1] - self.times[:, 0]))
        looked = [number for number in self.numbers if number.verdict != FREE]
        told = sum(number.value is not None for number in looked)
        windows = f"{W} windows of {length:.3g} s fitted, {back} held back"
        return (
            f"Identification: {told} of {len(looked)} numbers told; {windows}; {self.steps} steps,"
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
        error = "given" if self.delay_error is None else f"+- {1e3 * self.delay_error:.2g} ms"
        early = self.delay < -3.0 * (self.delay_error or 0.0)
        late = (
            f"acts {1e3 * (-self.delay if early else self.delay):.3g} ms"
            f" {'before its time' if early else 'late'} ({error})"
        )
        late = late if self.delay_error != math.inf else "is late by what the log cannot tell"
        return [*lines, f"  the logged torque {late}", *(f"  {note}" for note in self.notes)]

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
        """Figure: values with their errors, what is known how well, and what is left.  Options as
        `plotting.identification`.
        """
        return present("identification figure", self, **options)


TOLD, UNTOLD, LIMITED, FREE, BIASED = (
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
    return f"{100 * error / abs(of):.2g} %" if of else ""


def _of_plant(path: str) -> str:
    return "plant" + path[5:] if path.startswith(("robot.", "model.")) else path


def _for_json(x: Any) -> Any:
    if isinstance(x, dict):
        return {str(key): _for_json(y) for key, y in x.items()}
    if isinstance(x, list | tuple):
        return [_for_json(y) for y in x]
    if isinstance(x, np.ndarray | np.generic):
        return _for_json(x.tolist())
    return x if not isinstance(x, float) or math.isfinite(x) else None


def assessed(
    problem: IdentificationProblem,
    guess: Start,
    end: Refined,
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
        whiteness(end.told.residuals[windows.kept][:, :, j]) for j in range(windows.y.shape[-1])
    ]
    fit = _fits(start, windows, end, before, white, guess)
    scale = np.append(guess.scale, OFFSET)
    statistics = _statistics(problem, end, scale, max(one.lacking for one in fit))
    x = np.where(end.free.held, c.x, to_x(c, end.z[:-1])[0])
    missing = LeftOut((), np.zeros(len(x)))
    if any(one.has_structure for one in fit):
        fitted = statistics.estimated & ~_at_limits(end, problem.limits, scale)
        missing = missing_terms(problem.simulated, c, problem.smoothed, end.z, fitted)
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
        *_notes(statistics.known, numbers, fit),
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
        singular_values=statistics.known.singular,
        combinations=statistics.combinations,
        untold=statistics.unidentifiable,
        scales=scale[:-1],
        fit=fit,
        residuals=end.told.residuals,
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
    known: Known
    errors: np.ndarray
    """Standard errors, (p + 1,); infinite where an entry is not estimated."""
    covariance: np.ndarray
    """(p + 1, p + 1); zero where an entry is not estimated."""
    beyond: np.ndarray
    """The step that the log suggests without limits, (p + 1,)."""
    combinations: tuple[str, ...]
    """The combinations of parameters, from the best known one on."""

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """The combinations that the log does not identify."""
        pairs = zip(self.combinations, self.known.singular, strict=True)
        return tuple(text for text, size in pairs if not size > 1.0 / UNKNOWN)


def _statistics(
    problem: IdentificationProblem, end: Refined, scale: np.ndarray, lacking: float
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
    estimated = np.append(~end.free.held, problem.estimates_delay)
    both = np.ix_(estimated, estimated)
    information = (z_by_x.T @ end.told.information[kept] @ z_by_x)[:, estimated][:, :, estimated]
    scores = (end.told.scores[kept] @ z_by_x)[:, estimated]
    precision = np.zeros((p + 1, p + 1))
    precision[:p, :p] = problem.prior.precision
    widening = lacking if lacking > LACKS else 1.0
    found = known(information, scores, precision[both], scale[estimated], widening)
    errors = np.full(p + 1, np.inf)
    errors[estimated] = found.errors
    covariance = np.zeros((p + 1, p + 1))
    covariance[both] = found.covariance
    from_prior = precision @ np.append(x - problem.prior.mean, 0.0)
    all_scores = scores + from_prior[estimated] / len(scores)
    beyond = np.zeros(p + 1)
    beyond[estimated] = _without_limits(information, all_scores, scale[estimated])
    names = np.array([*problem.coordinates.names, "the torque's delay"])[estimated]
    combinations = tuple(in_words(direction, tuple(names)) for direction in found.directions.T)
    return _Statistics(estimated, found, errors, covariance, beyond, combinations)


def _note_on_early_torque(c: Coordinates, end: Refined, delay_error: float) -> list[str]:
    """A note where the delay of the torque is estimated to be negative."""
    if not c.delay or not end.z[-1] < -3.0 * delay_error:
        return []
    return [
        "The logged torque acts before its time: it is not the command, and the scenario's"
        " delay is 0."
    ]


def _without_limits(information: np.ndarray, scores: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """How far the log would move each number if there were no limits: one Gauss-Newton step."""
    A, g = np.sum(information, axis=0) * scale[:, None] * scale, np.sum(scores, axis=0) * scale
    return -scale * np.linalg.lstsq(A, g, rcond=SEEN)[0]


def _at_limits(end: Refined, ends: tuple[np.ndarray, ...], scale: np.ndarray) -> np.ndarray:
    """Which numbers, the delay last, are at an end of their range, (p + 1,) bool."""
    return np.any([np.abs(end.z - side) < AT_END * scale for side in ends], axis=0)


def _left_out_in_words(start: Scenario, lacks: LeftOut, numbers: tuple[Number, ...]) -> list[str]:
    """What was left out, what to do, and which numbers make up for it."""
    joints = joint_names(start.plant, start.n)
    available = [
        p.path
        for p in parameters(start, named=False)
        if p.path.startswith(("plant.", "disturbance."))
    ]
    names = tuple(number.name for number in numbers)
    lines = [
        in_words_of(one, joints[one.joint], remedy_for(one, available, names))
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
    end: Refined,
    ends: tuple[np.ndarray, ...],
    scale: np.ndarray,
    bias: float = 0.0,
) -> Number:
    def number(value, error, verdict):
        return Number(c.names[i], c.units[i], float(c.x[i]), value, error, verdict)

    if end.free.held[i]:
        return number(None, None, FREE)
    at_low, at_high = (abs(end.z[i] - side[i]) < AT_END * scale[i] for side in ends)
    if not np.isfinite(error):
        pushed = (at_low and beyond < -AT_END * scale[i]) or (
            at_high and beyond > AT_END * scale[i]
        )
        return number(x, None, LIMITED) if pushed else number(None, None, UNTOLD)
    if bias and not (at_low or at_high):
        return number(x, error, BIASED)._replace(bias=bias)
    return number(x, error, LIMITED if at_low or at_high else TOLD)


def _fits(
    start: Scenario,
    w: Windows,
    end: Refined,
    before: np.ndarray,
    white: list[Whiteness],
    guess: Start,
) -> tuple[Fit, ...]:
    def size(r, windows):
        return (
            np.sqrt(np.mean(r[windows] ** 2, axis=(0, 1)))
            if np.any(windows)
            else np.full(r.shape[-1], np.nan)
        )

    first, fitted, others = (
        size(before, w.kept),
        size(end.told.residuals, w.kept),
        size(end.told.residuals, ~w.kept),
    )
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


def _notes(found: Known, numbers: tuple[Number, ...], fit: tuple[Fit, ...]) -> list[str]:
    notes = []
    widest = float(np.max(found.widened))
    if not all(one.is_white for one in fit) and widest > CLEARLY:
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
    if worst.lacking > LACKS:
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
    """Which limits bind, and what the log asks for."""
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


def _freed(start: Scenario, end: Refined, worse: float) -> list[str]:
    """What was left to the log, and why."""
    share = end.free.share
    if not np.any(share):
        return []
    names = [
        name for name, part in zip(joint_names(start.plant, start.n), share, strict=True) if part
    ]
    whose = "all joints" if len(names) == start.n else ", ".join(names)
    least, most = (
        f"{100 * part:.{0 if part > 0.1 else 1}f}" for part in (share[share > 0].min(), share.max())
    )
    parts = f"{least} %" if least == most else f"{least} to {most} %"
    return [
        f"About standstill (slower than {end.free.slow:g} rad/s: {parts} of the time) torques were"
        f" free in place of the friction of {whose}: coulomb tanh(q' / width) leaves {worse:.2g}"
        " times as much.  The widths are the scenario's."
    ]


def _with_numbers(
    start: Scenario, c: Coordinates, x: np.ndarray, delay: float
) -> tuple[Scenario, list[str]]:
    """The scenario with the new numbers."""
    scenario, notes = start, []
    for path, place in zip(c.paths, c.places, strict=True):
        own = x[place.start : place.start + place.size].reshape(place.shape)
        targets = (
            ["plant" + path[5:], "model" + path[5:]]
            if path.startswith(("robot.", "plant."))
            else [path]
        )
        for target in targets:
            try:
                scenario = with_parameters(scenario, {target: own})
            except ValueError:
                if target == path or target.startswith("plant"):
                    raise
                notes.append(f"The model has no {target}: its number is the plant's alone.")
    if c.delay:
        scenario = with_parameters(scenario, {DELAY: max(delay, 0.0)})
    return scenario, notes
