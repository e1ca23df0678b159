"""The result of `identify`: an `Identification`, which prints as a table."""

from __future__ import annotations

import dataclasses
import math
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.core.presentation import Content, Result, present
from iblf_jax.core.tables import Table, for_json
from iblf_jax.identification.coordinates import plant_path
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.distributions import Perturbation, joint_normal, value

COLOURED_PROBABILITY, MIN_AUTOCORRELATION = 1e-3, 0.05
"""Probability (Ljung and Box) below which residuals count as coloured, if an autocorrelation is
above the second."""
INCOMPLETE_RATIO, MIN_NOISE = 1.5, 1e-5
"""Residual relative to the positions' noise above which the model is incomplete, and the smallest
noise that is assumed [rad]."""
MORE_THAN_NOISE = 1.05
"""Residual relative to the positions' noise above which missing terms are searched."""
IDENTIFIED = "told"
NOT_IDENTIFIABLE = "cannot be told"
LIMITED = "at its limit"
NOT_ESTIMATED = "left free"
BIASED = "biased"
GROUP = "identified"
"""Name of the draws that all identified numbers share."""
HEADING = ("number", "unit", "start", "value", "standard error", "relative", "verdict")
FIT = (
    "joint",
    "rms before [rad]",
    "rms after [rad]",
    "rms held back [rad]",
    "autocorrelation",
    "residuals",
    "torque explained",
)


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
    """One of the constants above: `IDENTIFIED`, `NOT_IDENTIFIABLE`, `LIMITED`, `NOT_ESTIMATED` for
    the width of a friction that does not obey this law, or `BIASED` where a missing term moves the
    value by more than its standard error or by more than 5 %."""
    bias: float | None = None
    """The bias by missing terms, where it is biased."""

    @property
    def digits(self) -> str:
        """The value, to the second digit of its error."""
        if self.value is None:
            return ""
        if not self.error:
            return f"{self.value:.5g}"
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
    """Standard deviation of the logged positions about smooth curves, caused by noise and by the
    quantisation of the encoder [rad]."""

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


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Identification(Result):
    """Parameters from a log: values, standard errors, and what the log does not identify."""

    scenario: Scenario
    """The scenario with the new parameters, in plant and model for paths of the robot or the plant;
    parameters that are not identifiable have values that agree with the identifiable ones."""
    start: Scenario
    paths: tuple[str, ...]
    """The requested paths, and after them the widths of friction that were identified as well."""
    requested: int
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
    def requested_numbers(self) -> tuple[Number, ...]:
        """The requested parameters, without the added widths."""
        leaves = self._leaves()[: self.requested]
        return self.numbers[: sum(len(entries) for _, _, entries in leaves)]

    def _leaves(self) -> list[tuple[str, tuple[int, ...], range]]:
        """Path, shape, and indices of the parameters of each leaf."""
        found, first = [], 0
        for path in self.paths:
            shape = np.shape(paths.get(self.start, path))
            entries = range(first, first + math.prod(shape))
            found.append((path, shape, entries))
            first = entries.stop
        return found

    @cached_property
    def values(self) -> dict[str, np.ndarray]:
        """Path -> value in the leaf's unit, NaN where it is not identifiable."""
        return self._by_path("value", math.nan)

    @cached_property
    def standard_errors(self) -> dict[str, np.ndarray]:
        """Path -> standard error in the leaf's unit, infinite where it is not identifiable."""
        return self._by_path("error", math.inf)

    def _by_path(self, field: str, unknown: float) -> dict[str, np.ndarray]:
        """Path -> a field of its numbers, with another value in place of None."""
        column = [number._asdict()[field] for number in self.numbers]
        x = np.array([unknown if value is None else value for value in column])
        return {path: x[list(entries)].reshape(shape) for path, shape, entries in self._leaves()}

    @property
    def correlation(self) -> np.ndarray:
        """Of the numbers' errors, (p, p); NaN where one is not identifiable."""
        size = np.sqrt(np.diag(self.covariance))
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.covariance / size[:, None] / size

    @cached_property
    def perturbations(self) -> dict[str, Perturbation]:
        """The remaining uncertainty for `monte_carlo`, `sweep` and `tune`: the identified
        parameters of the plant, jointly normal.

        x = value + L w,   L L^T = covariance,   w standard normal, the same for all paths
        """
        identified = [
            i
            for i, number in enumerate(self.requested_numbers)
            if number.error is not None and number.verdict == IDENTIFIED
        ]
        size, axes = np.linalg.eigh(self.covariance[np.ix_(identified, identified)])
        factor = np.zeros((len(self.numbers), len(identified)))
        factor[identified] = axes * np.sqrt(np.maximum(size, 0.0))
        found = {}
        for path, shape, entries in self._leaves()[: self.requested]:
            if all(i in identified for i in entries):
                mean = np.array([self.numbers[i].value for i in entries]).reshape(shape)
                spread = factor[list(entries)].reshape(*shape, -1)
                found[plant_path(path)] = value(joint_normal(mean, spread, GROUP))
                continue
            for i in entries:
                if i in identified:
                    number = self.numbers[i]
                    draws = joint_normal(number.value, factor[i], GROUP)
                    found[plant_path(number.name)] = value(draws)
        return found

    def _content(self) -> Content:
        W, back = int(np.sum(self.kept)), int(np.sum(~self.kept))
        length = float(np.mean(self.times[:, -1] - self.times[:, 0]))
        estimated = [number for number in self.numbers if number.verdict != NOT_ESTIMATED]
        count = sum(number.value is not None for number in estimated)
        windows = f"{W} windows of {length:.3g} s fitted, {back} held back"
        verdicts = [number.verdict for number in self.numbers]
        bold = [i for i, verdict in enumerate(verdicts) if verdict in (NOT_IDENTIFIABLE, BIASED)]
        return [
            f"Identification: {count} of {len(estimated)} numbers told; {windows};"
            f" {self.steps} steps, {self.seconds:.3g} s",
            Table(HEADING, self._rows(), "Numbers", bold=bold),
            Table(FIT, self._fits(), "Fit"),
            *(f"  cannot be told: {words}" for words in self.untold),
            f"  the logged torque {self._delay_in_words()}",
            *(f"  {note}" for note in self.notes),
        ]

    def _rows(self) -> list[tuple[str, ...]]:
        rows: list[tuple[str, ...]] = []
        for x in self.numbers:
            error, share = "", ""
            if x.error is not None and x.value is not None:
                error = f"{x.error:.2g}"
                if x.value:
                    share = f"{100 * x.error / abs(x.value):.2g} %"
            rows.append((x.name, x.unit, f"{x.start:.5g}", x.digits, error, share, x.verdict))
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

    def _delay_in_words(self) -> str:
        if self.delay_error == math.inf:
            return "has a delay that the log does not identify"
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
        return for_json({
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

    def plot(self, **options):
        """Figure: values with standard errors, combinations, and residuals.  Options as
        `plotting.identification`.
        """
        return present("identification figure", self, **options)
