"""`compare`: several laws on one scenario, at the gains they have and at equal effort.

Two questions hide in "which law is better".  At equal gains k1 and K2, a law whose barrier term is larger works harder and looks
better: the integral form's is twice the logarithmic one's (p = 1), identically.  So each law is also run at **equal effort**: its gains
are scaled by one factor, the one nearest 1 at which the RMS torque above gravity, sqrt(mean |tau - G0(q)|^2), is the first law's.

The factor is sought outward from 1 on a geometric grid, and then by SciPy's brentq inside the bracket nearest to 1; a law
for which there is none in the range is named with the reason.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from iblf_jax.controllers import KEEPERS, LAWS, Controller, Saturated, law_by_name
from iblf_jax.controllers.systems import observer_of
from iblf_jax.core import checks, notices
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.status import Status, describe
from iblf_jax.engine.simulate import simulate
from iblf_jax.observers import NoObserver
from iblf_jax.simulation.metrics import AboveGravity, standard, watched
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.comparison import NO_EFFORT, Comparison

RATIO = math.sqrt(2.0)
"""Grid of factors: powers of this."""
RINGS = 10
"""Powers tried on either side of 1: factors from 1/32 to 32."""
ROOT_TOLERANCE = 1e-7
EDGE_BISECTIONS = 4
"""How closely the edge of the factors that work is approached."""

NAMES = (*LAWS, *KEEPERS)
Laws = Sequence[str | Controller] | Mapping[str, str | Controller]


@notices.each_warning_once
def compare(
    scenario: Scenario,
    laws: Laws = LAWS,
    *,
    duration: float,
    dt: float = 1e-3,
    method: str = "rk4",
    record_every: int = 1,
    equal_effort: bool = True,
) -> Comparison:
    """Runs several laws on one scenario, at their gains and at equal effort.

        factor_i = the c nearest 1 with  rms|tau - G0(q)| of law i at gains c k1, c K2  =  that of the first law

    Args:
      scenario: plant, reference, bounds, disturbance, observer and start, shared by all laws; the k1, K2, o and reading of its own law
        are those of the laws that are given by name, and a torque limit around its law is put around them too.
      laws: names (`iblf_jax.controllers.LAWS` or `KEEPERS`) or laws, or a dict of either by the name to show.  The first one sets the
        effort.
      duration, dt, method, record_every: as `simulate`.
      equal_effort: whether to look for the factors; about ten further runs a law.

    Returns:
      A `Comparison`: prints as two tables and says what was held equal; `rollouts`, `equal_effort`, `factors`, `plot()`, `to_pandas()`.

    Raises:
      ValueError: an unknown law, no law, or bad arguments of `simulate`.

    Source: design of this package; the factor 2 is a fact about (3.1).
    """
    scenario, equal_effort = canonical(scenario), checks.flag("equal_effort", equal_effort)
    named = _named_laws(laws)
    scenarios = {name: _with_law(scenario, law) for name, law in named.items()}
    options: dict[str, Any] = {"duration": duration, "dt": dt, "method": method, "record_every": record_every}
    rollouts = {name: _run(one, options) for name, one in scenarios.items()}
    factors: dict[str, float] = {}
    reasons: dict[str, str] = {}
    equal: dict[str, Rollout] = {}
    if equal_effort:
        for name, one in scenarios.items():
            first, own = next(iter(rollouts.items())), rollouts[name]
            factors[name], reasons[name], run = (1.0, "", own) if name == first[0] else _at_effort_of(first, one, own, options)
            if run is not None:
                equal[name] = run
    gains = {name: _gains_in_words(one.controller) for name, one in scenarios.items()}
    return Comparison(rollouts, equal, factors, {name: why for name, why in reasons.items() if why}, gains)


def _named_laws(laws: Laws) -> dict[str, str | Controller]:
    """The laws by the name to show."""
    if isinstance(laws, str) or not isinstance(laws, Mapping | Sequence) or len(laws) == 0:
        raise checks.fail("laws", laws, "a list of names and laws, or a dict of them", f"Names are {', '.join(NAMES)}.")
    if isinstance(laws, Mapping):
        pairs = [(str(name), law) for name, law in laws.items()]
    else:
        pairs = [(law if isinstance(law, str) else _title(law), law) for law in laws]
    named: dict[str, str | Controller] = {}
    for name, law in pairs:
        if isinstance(law, str):
            checks.one_of("laws", law, NAMES)
        else:
            checks.conforms(f"laws[{name!r}]", law, Controller, f"Or a name: {', '.join(NAMES)}.")
        count = 2
        shown = name
        while shown in named:
            shown, count = f"{name} {count}", count + 1
        named[shown] = law
    return named


def _title(law: Controller) -> str:
    inner = unwrapped(law)
    barrier = getattr(inner, "barrier", None)
    text = type(inner).__name__ + (f"({type(barrier).__name__})" if barrier is not None else "")
    return text if inner is law else f"{type(law).__name__}({text})"


def _with_law(scenario: Scenario, law: str | Controller) -> Scenario:
    """The scenario under another law, with the observer that belongs to it."""
    if isinstance(law, str):
        own = unwrapped(scenario.controller)
        kept = {name: getattr(own, name) for name in ("k1", "K2", "o", "reading") if getattr(own, name, None) is not None}
        p = getattr(getattr(own, "barrier", None), "p", 1)
        controller = _limited_as(scenario.controller, law_by_name(law, p=p, **kept))
        observer = observer_of(law, scenario.observer)
    else:
        controller = law
        observer = scenario.observer if getattr(unwrapped(law), "uses_observer", True) else NoObserver()
    return dataclasses.replace(scenario, controller=controller, observer=observer)


def _limited_as(controller: Controller, law: Controller) -> Controller:
    """A law within the torque limits of another one."""
    if not isinstance(controller, Saturated):
        return law
    return dataclasses.replace(controller, law=_limited_as(controller.law, law))


def _run(scenario: Scenario, options: Mapping[str, Any]) -> Rollout:
    """One run; a failure is named in the table, not warned of."""
    with notices.muted(UserWarning):
        return simulate(scenario, metrics=(*standard(), *watched(scenario), AboveGravity()), **options)


def gain_names(law: Controller) -> tuple[str, ...]:
    """The leaves of a law that are scaled together: its class attribute `gains`, else those of k1 and K2 that it has."""
    inner = unwrapped(law)
    return tuple(getattr(inner, "gains", None) or (name for name in ("k1", "K2") if getattr(inner, name, None) is not None))


def _at_effort_of(
    first: tuple[str, Rollout], scenario: Scenario, own: Rollout, options: Mapping[str, Any]
) -> tuple[float, str, Rollout | None]:
    """The factor at which a law has the first one's effort, or NaN and the reason; and the run there."""
    title, reference = first
    if int(reference.status) & NO_EFFORT:
        return math.nan, f"the first law, {title}, failed itself, so it sets no effort", None
    names = gain_names(scenario.controller)
    if not names:
        return math.nan, "it has no gains to scale: no k1, K2, and no class attribute `gains`", None
    inner = unwrapped(scenario.controller)
    runs: dict[float, Rollout] = {1.0: own}

    def effort(factor: float) -> float:
        if factor not in runs:
            scaled = {f"controller.{name}": np.asarray(getattr(inner, name)) * factor for name in names}
            runs[factor] = _run(with_parameters(scenario, scaled), options)
        return math.nan if int(runs[factor].status) & NO_EFFORT else float(runs[factor].metrics.effort_above_gravity)

    factor = factor_nearest_one(effort, float(reference.metrics.effort_above_gravity))
    return (factor, "", runs[factor]) if math.isfinite(factor) else (factor, _why_not(runs, reference), None)


def factor_nearest_one(effort: Callable[[float], float], target: float) -> float:
    """The factor nearest 1, by |ln|, at which effort(factor) = target, or NaN if there is none in the range.

    Args:
      effort: factor -> effort [N m], NaN for a run that failed.
      target: effort to reach [N m].
    """
    if effort(1.0) == target:
        return 1.0
    excess = functools.partial(_excess, effort, target)
    start = excess(0.0)
    ends: dict[int, float | None] = {1: start, -1: start}
    for ring in range(1, RINGS + 1):
        roots = []
        for sign, last in ends.items():
            if last is None:  # beyond a run that failed
                continue
            power, here = float(sign * ring), excess(sign * ring)
            ends[sign] = here
            if here is None:
                power, here = _last_sound(excess, sign * (ring - 1), last, sign * ring)
            if last * here <= 0.0:
                roots += _root(excess, sign * (ring - 1), power)
        if roots:
            return RATIO ** min(roots, key=abs)
    return math.nan


def _excess(effort: Callable[[float], float], target: float, power: float) -> float | None:
    """What the effort at RATIO^power is above the target, or None for a run that failed."""
    value = effort(RATIO**power) - target
    return value if math.isfinite(value) else None


def _last_sound(excess: Callable[[float], float | None], inner: float, value: float, outer: float) -> tuple[float, float]:
    """The outermost power, by bisection between one that works and one that fails, that works; and the excess there."""
    for _ in range(EDGE_BISECTIONS):
        middle = 0.5 * (inner + outer)
        here = excess(middle)
        if here is None:
            outer = middle
        else:
            inner, value = middle, here
    return inner, value


def _root(excess: Callable[[float], float | None], a: float, b: float) -> list[float]:
    """The root in a bracket, or none if a run inside it fails."""
    from scipy.optimize import brentq

    def sound(power: float) -> float:
        value = excess(power)
        if value is None:
            raise FloatingPointError
        return value

    try:
        return [brentq(sound, a, b, xtol=ROOT_TOLERANCE)]
    except FloatingPointError:
        return []


def _why_not(runs: Mapping[float, Rollout], reference: Rollout) -> str:
    """Why no factor was found, in words."""
    target = float(reference.metrics.effort_above_gravity)
    sound = {factor: run for factor, run in runs.items() if not int(run.status) & NO_EFFORT}
    if not sound:
        return "every run failed: " + describe(int(runs[1.0].status) & NO_EFFORT)
    efforts = [float(run.metrics.effort_above_gravity) for run in sound.values()]
    side = "stays below" if max(efforts) < target else "stays above" if min(efforts) > target else "misses"
    where = f"{side} {target:.4g} N m ({min(efforts):.4g} to {max(efforts):.4g})"
    text = f"its effort {where} for factors {min(sound):.3g} to {max(sound):.3g}"
    failed = sorted((factor for factor in runs if factor not in sound), key=lambda factor: abs(math.log(factor)))
    if failed:
        status = Status(int(runs[failed[0]].status) & NO_EFFORT)
        text += f"; at {failed[0]:.3g} the run fails: {describe(status)}"
        text += " (a smaller dt may reach further)" if status & Status.STEP_TOO_LARGE else ""
    return text


def _gains_in_words(law: Controller) -> str:
    inner = unwrapped(law)
    return ", ".join(f"{name} = {_shown(getattr(inner, name))}" for name in gain_names(law)) or "no gains"


def _shown(value: Any) -> str:
    values = np.unique(np.asarray(value))
    return f"{values[0]:g}" if values.size == 1 else np.array2string(np.asarray(value), precision=4)
