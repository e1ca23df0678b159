"""Confirms by fresh runs that tuned gains fail with a small probability.

A fresh run, which the search did not use, fails if it leaves its bounds, diverges or breaks a
requirement.  The claim P(a run fails) < p is made in rounds.  Round j = 1, 2, ... draws the
smallest number N_j of runs that is sufficient if none of them fails,

    (1 - p)^N_j <= a_j,     a_j = (1 - confidence) / 2^j,

so that gains whose probability of failure is p or more pass round j with a probability of at most
a_j.  The sum of all a_j is at most 1 - confidence: the confidence holds for all rounds together.
The first round needs as many runs as the two-sided interval of a report.

If a run fails, the limit of every broken requirement is tightened by TIGHTENING times the largest
excess of the fresh runs.  The search then continues from its result, and the next round draws new
runs.  After a change by the largest excess itself, about one of N_j new runs would still break the
limit, and the next round would fail in two of three cases.

Source: C. J. Clopper, E. S. Pearson, Biometrika 26 (1934) 404-413 (the limit of a probability).
"""

from __future__ import annotations

import dataclasses
from typing import Self

import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.presentation import Content, Result
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.statistics import Probability, probability, runs_without_event
from iblf_jax.tuning.objectives import Objective
from iblf_jax.tuning.options import TuningRunOptions
from iblf_jax.tuning.runs import NUMBERS_A_RUN
from iblf_jax.tuning.samples import SampleRequest, is_random, sample_runs

MOST_ROUNDS = 6
"""Largest number of rounds."""
TIGHTENING = 2.0
"""Factor of the largest excess by which a limit is tightened."""


@dataclasses.dataclass(frozen=True, repr=False)
class Confirmation(Result):
    """Rounds of fresh runs by which tuned gains were confirmed, or not; prints as text."""

    limit: float
    """The claim: a run fails with a smaller probability [1]."""
    confidence: float
    """Of the claim, over all rounds."""
    requirements: tuple[str, ...] = ()
    """Their names, (R,)."""
    rounds: tuple[Probability, ...] = ()
    """The probability of a failure in each round, with the interval of this round."""
    seeds: tuple[int, ...] = ()
    """Of the draws of each round."""
    excess: tuple[float, ...] = ()
    """The largest finite excess of each requirement in the last round, in its scale, (R,)."""
    tightened: tuple[float, ...] = ()
    """The amounts by which the limits were tightened for the gains of the last round, (R,)."""

    @property
    def is_confirmed(self) -> bool:
        """Whether the claim holds for the gains of the last round."""
        high = self.rounds[-1].high
        return high is not None and high <= self.limit

    def after_round(
        self, request: SampleRequest, gains: Scenario, tightened: tuple[float, ...]
    ) -> Self:
        """The confirmation with one more round.

        Args:
          request: what is run; the round has its own number of runs, and its own seed from that of
            the request.
          gains: the scenario with the gains that are tested.
          tightened: the amounts by which the limits were tightened for these gains, (R,).
        """
        number = len(self.rounds) + 1
        confidence = 1 - 2 * (1 - self.confidence) / 2**number  # of a two-sided interval
        needed = runs_without_event(self.limit, confidence)
        # Neither the search nor a report draws with this seed.
        seed = int(np.random.default_rng([request.seed, 6, number]).integers(2**32))
        request = request._replace(runs=needed, seed=seed)
        (sample,) = sample_runs(request, [gains])
        missing = needed - int(np.sum(sample.admissible))
        if missing:  # draws that cannot be run do not count, so that more are needed
            share = max(needed - missing, 1) / needed
            request = request._replace(runs=int(np.ceil((needed + 3 * np.sqrt(missing)) / share)))
            (sample,) = sample_runs(request, [gains])
        requirements = range(len(request.objective.requirements))
        broken = [sample.is_broken(request.objective, r) for r in requirements]
        failed = np.any([sample.left_bounds(), *broken], axis=0)
        excesses = [sample.excess(request.objective, r)[sample.admissible] for r in requirements]
        found = probability(failed, sample.admissible, confidence, "independent", 1)
        return dataclasses.replace(
            self,
            rounds=(*self.rounds, found),
            seeds=(*self.seeds, seed),
            excess=tuple(float(np.max(x[np.isfinite(x)], initial=0.0)) for x in excesses),
            tightened=tightened,
        )

    @property
    def next_tightening(self) -> tuple[float, ...] | None:
        """The amounts by which the limits are tightened for the next round, (R,).

        None if the gains are confirmed, if there was the last round, or if no requirement limits
        what failed.
        """
        if self.is_confirmed or len(self.rounds) == MOST_ROUNDS or not any(self.excess):
            return None
        pairs = zip(self.tightened, self.excess, strict=True)
        return tuple(before + TIGHTENING * excess for before, excess in pairs)

    def __str__(self) -> str:
        last = self.rounds[-1]
        count = len(self.rounds)
        verdict = "confirmed" if self.is_confirmed else "WARNING: NOT confirmed"
        text = (
            f"{verdict} with {self.confidence:.0%} confidence: a run fails with a probability below"
            f" {self.limit:g}; {last.count} of {last.runs} fresh runs failed"
        )
        if count > 1:
            text += f" in round {count}"
        named = zip(self.requirements, self.tightened, strict=True)
        changes = [f"{name} by {x:.2g}" for name, x in named if x]
        if changes:
            text += f"; limits that were tightened, in their scales: {', '.join(changes)}"
        if not (self.is_confirmed or any(self.excess)):
            text += "; no requirement limits what failed: add one on the margin"
        return text

    def _content(self) -> Content:
        return [str(self)]


def confirmation_of(
    confirm: object, confidence: float, objective: Objective, options: TuningRunOptions
) -> Confirmation:
    """A confirmation before its first round.

    Args:
      confirm: the claim, P(a run fails) < confirm [1].
      confidence: of the claim.
      objective: with its requirements.
      options: of the runs of the tuning.

    Raises:
      ValueError: not a number in (0, 1), or below the share of the runs that may break a
        requirement; or nothing is drawn.
    """
    limit = checks.positive_number("confirm", confirm, "1")
    if limit >= 1:
        remedy = "0.01, for example."
        raise checks.fail("confirm", confirm, "a number between 0 and 1", remedy)
    if not is_random(options):
        remedy = "All runs would be the same: give perturbations."
        raise checks.fail("confirm", confirm, "None without perturbations", remedy)
    for requirement in objective.requirements:
        allowed = float(requirement.allowed)
        if allowed > limit * (1 + 1e-6):  # beyond the rounding of a share in single precision
            expected = f"{allowed:g} or more, which is the share that may break {requirement.name}"
            remedy = f"Give this requirement allowed={limit:g}."
            raise checks.fail("confirm", confirm, expected, remedy)
    most = runs_without_event(limit, confidence)
    remedy = "ij.failure_probability estimates smaller probabilities."
    checks.fits_memory("runs for confirm", most, 8.0 * NUMBERS_A_RUN, remedy)
    names = tuple(r.name for r in objective.requirements)
    return Confirmation(limit, confidence, names, tightened=(0.0,) * len(names))
