"""Which requirements no evaluated gains keep, alone or together, where no gains keep all of them.

A search notes of every two requirements r and q the smallest value of max(G_r, G_q) over all points
that it has evaluated, and of every single one the smallest G_r.  If that of a single one is above
zero, no point keeps this requirement; if that of a pair is, while each of the two is kept
somewhere, the two are in conflict.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from iblf_jax.core.units import POSITION
from iblf_jax.simulation.units import unit_text
from iblf_jax.tuning.problem import TuningProblem
from iblf_jax.tuning.quantities import OF_LIMIT


def conflicts_in_words(problem: TuningProblem, least: np.ndarray) -> tuple[str, ...]:
    """A sentence for every requirement that no evaluated gains keep, and for every two that are
    kept alone but not together.

    Args:
      problem: what was tuned.
      least: the smallest larger excess of every two requirements, (R + 1, R + 1), those of single
        ones on the diagonal; the bounds are the last one.
    """
    names = [*(r.name for r in problem.objective.requirements), "the bounds"]
    in_words = [_excess_in_words(problem, r) for r in range(len(names))]
    is_kept = np.diag(least) <= 0
    lines = [
        f"no evaluated gains keep {names[r]}, whatever happens to the other requirements: they are"
        f" beyond the limit by {in_words[r](least[r, r])} or more"
        for r in np.flatnonzero(~is_kept)
    ]
    for r, q in itertools.combinations(np.flatnonzero(is_kept), 2):
        if least[r, q] > 0:
            lines.append(
                f"no evaluated gains keep {names[r]} and {names[q]} together, though some keep each"
                f" of them: the first is beyond its limit by {in_words[r](least[r, q])}, or the"
                f" second by {in_words[q](least[r, q])}, or more"
            )
    if not lines:
        lines = ["some evaluated gains keep every two requirements together, but none all of them"]
    return tuple(lines)


def _excess_in_words(problem: TuningProblem, r: int) -> Callable[[float], str]:
    """The excess of one requirement, in its scale, as a text with its unit."""
    requirements = problem.objective.requirements
    if r == len(requirements):
        return lambda excess: f"{excess:.3g} {unit_text(problem.scenario, POSITION)}"
    scale = float(requirements[r].scale)
    unit = requirements[r].measure[1]
    if unit == OF_LIMIT:
        return lambda excess: f"{100 * scale * excess:.3g} %"
    return lambda excess: f"{scale * excess:.3g} {unit_text(problem.scenario, unit)}".strip()
