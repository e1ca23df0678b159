"""`compare`: several laws on one scenario, at their own gains and at equal effort.

At equal gains k1 and K2, a law whose barrier term is larger uses more torque and has smaller
errors: the term of the integral form is exactly twice that of the logarithmic form (p = 1).  Each
law is therefore also run at **equal effort**: one factor scales its gains so that the RMS torque
above gravity, sqrt(mean |tau - G0(q)|^2), is the first law's.

The search evaluates a grid of factors from 1/32 to 32 in one batch and refines every crossing
(`equal_effort`): the effort need not grow with the factor, and trials may fail.  Of several
crossings it takes the one nearest to 1, by |ln factor|.  The result contains all trials, including
those that failed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.controllers import (
    KEEPERS,
    LAWS,
    BarrierBackstepping,
    Saturated,
    TrackingLaw,
    law_by_name,
)
from iblf_jax.control.controllers._base import check_law
from iblf_jax.control.controllers.systems import observer_of
from iblf_jax.control.observers import DisturbanceObserver, NoObserver
from iblf_jax.core import checks, notices, programs
from iblf_jax.core.attributes import attributes
from iblf_jax.core.progress import announced
from iblf_jax.core.pytree import field_values, layers, unwrapped
from iblf_jax.core.status import Status
from iblf_jax.core.units import INPUT
from iblf_jax.engine import Outcome, RunRequest, run_batch, takes_runs
from iblf_jax.engine.simulate import simulate
from iblf_jax.simulation.error_growth import errors_by_step
from iblf_jax.simulation.metrics import (
    AboveGravity,
    Fold,
    Settling,
    as_folds,
    optional_folds,
    standard,
)
from iblf_jax.simulation.noise import noise_values
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.simulation.units import status_words, unit_text
from iblf_jax.studies.comparison import Comparison
from iblf_jax.studies.equal_effort import NO_EFFORT, EffortSearch, Trials, grid, search
from iblf_jax.studies.time_step import needed_dt
from iblf_jax.world import plants

NAMES = (*LAWS, *KEEPERS)
Laws = Sequence[str | TrackingLaw] | Mapping[str, str | TrackingLaw]
ONLY_K = (
    "the factor scales k and not the weights: if the barriers of the laws have different units,"
    " choose the weights first (BarrierBackstepping, weights)"
)


@notices.each_warning_once
@announced("comparing laws")
@takes_runs
def compare(
    scenario: Scenario,
    laws: Laws = LAWS,
    *,
    duration: float,
    dt: float = 1e-3,
    method: str = "rk4",
    record_every: int = 1,
    metrics: Sequence[Fold] = (),
    equal_effort: bool = True,
) -> Comparison:
    """Runs several laws on one scenario, at their gains and at equal effort.

        factor_i = the c of [1/32, 32] nearest to 1, by |ln c|, with
                   rms|tau - G0(q)| of law i, every leaf in its `gains` times c
                   =  that of the first law

    Laws with barriers of different units, such as `TransformedError` and `PrescribedPerformance`,
    are different designs at equal weights: scale the weights before you compare them, see
    `BarrierBackstepping`.

    Args:
      scenario: plant, reference, bounds, disturbance, observer and start, shared by all laws; a law
        of robots takes the rigid limit of a plant in strict-feedback form as its model, that of a
        `FlexibleJoint` with the inertia of the motors, or the robot inside the plant.  The k1, K2,
        o and reading of its own law are those of the laws that are given by name, and a torque
        limit around its law is put around them too.
      laws: names (`iblf_jax.controllers.LAWS` or `KEEPERS`) or laws, or a dict of either by the
        name to show.  The first one sets the effort.  Names are laws of robots; for a plant
        without a robot give laws, such as {"mapping": BarrierBackstepping(...)}.
      duration, dt, method, record_every, runs_as: as `simulate`.
      metrics: folds besides the standard ones.  A fold replaces the standard one of its class:
        `ij.metrics.Settling(tolerance=0.001)` sets the error at which a law has settled.
      equal_effort: whether to look for the factors; a few batches of 89 further runs a law.

    Returns:
      A `Comparison`: prints as two tables and states what is equal in each; `rollouts`,
      `equal_effort` (`equal_effort[name].scenario` has the law with the scaled gains), `factors`,
      `searches` (which factors were tried, and which failed), `plot()`, `to_pandas()`.

    Raises:
      ValueError: an unknown law, no law, or bad arguments of `simulate`.

    Source: design of this package; the factor 2 is a fact about (3.1).
    """
    scenario, equal_effort = canonical(scenario), checks.boolean("equal_effort", equal_effort)
    named = _named_laws(laws)
    scenarios = {name: _with_law(scenario, law) for name, law in named.items()}
    options: dict[str, Any] = {
        "duration": duration,
        "dt": dt,
        "method": method,
        "record_every": record_every,
        "metrics": metrics,
    }
    settling = next(fold for fold in _folds(scenario, metrics) if isinstance(fold, Settling))
    rollouts = {name: _run(one, options) for name, one in scenarios.items()}
    gains = {}
    for name, one in scenarios.items():
        own = attributes(unwrapped(one.controller), gain_names(one.controller))
        words = [f"{gain} = {_shown(value)}" for gain, value in own.items()]
        gains[name] = ", ".join(words) or "no gains"
    if not equal_effort:
        return Comparison(rollouts, {}, {}, {}, gains, settling=settling)
    first = next(iter(rollouts))
    others = {name: one for name, one in scenarios.items() if name != first}
    equal = {first: _EqualEffort(1.0, rollouts[first])}
    for name, one in others.items():
        equal[name] = _at_effort_of(first, rollouts[first], rollouts[name], one, options)
    return Comparison(
        rollouts,
        {name: one.run for name, one in equal.items() if one.run is not None},
        {name: one.factor for name, one in equal.items()},
        {name: one.reason for name, one in equal.items() if one.reason},
        gains,
        {name: one.search for name, one in equal.items() if one.search is not None},
        settling,
    )


def _named_laws(laws: Laws) -> dict[str, str | TrackingLaw]:
    """The laws by the name to show."""
    if isinstance(laws, str) or not isinstance(laws, Mapping | Sequence) or len(laws) == 0:
        raise checks.fail(
            "laws",
            laws,
            "a list of names and laws, or a dict of them",
            f"Names are {', '.join(NAMES)}.",
        )
    pairs: list[tuple[str | None, Any]] = [(None, law) for law in laws]
    if isinstance(laws, Mapping):
        pairs = [(str(name), law) for name, law in laws.items()]
    named: dict[str, str | TrackingLaw] = {}
    for name, law in pairs:
        if isinstance(law, str):
            checks.one_of("laws", law, NAMES)
            title = law
        else:
            label = type(law).__name__ if name is None else name
            check_law(f"laws[{label!r}]", law, f"Or a name: {', '.join(NAMES)}.")
            title = _title(law)
        first = shown = title if name is None else name
        count = 1
        while shown in named:
            count += 1
            shown = f"{first} {count}"
        named[shown] = law
    return named


def _title(law: TrackingLaw) -> str:
    inner = unwrapped(law)
    barrier = inner.barrier
    text = type(inner).__name__
    if barrier is not None:
        text += f"({type(barrier).__name__})"
    if inner is law:
        return text
    return f"{type(law).__name__}({text})"


def _with_law(scenario: Scenario, law: str | TrackingLaw) -> Scenario:
    """The scenario under another law, with the observer that belongs to it."""
    if isinstance(law, str):
        own = unwrapped(scenario.controller)
        values = field_values(own)
        given = {name: values.get(name) for name in ("k1", "K2", "o", "variant")}
        if own.barriers and given["o"] is not None:
            given["o"] = given["o"][0]  # of the first level
        kept = {name: value for name, value in given.items() if value is not None}
        p = getattr(own.barrier, "p", 1)
        controller = _limited_as(scenario.controller, law_by_name(law, p=p, **kept))
        observer: DisturbanceObserver = observer_of(law, scenario.observer)
    else:
        controller = law
        observer = scenario.observer
        if not all(part.uses_observer for part in layers(law)):
            observer = NoObserver()
    model: Any = scenario.model
    if isinstance(law, str) or not unwrapped(law).receives_x:
        known = plants.as_plant(model)
        limit = known.rigid()
        robot = known.robot if limit is None else limit
        if robot is not None:
            model = robot
        elif isinstance(law, str):
            expected = (
                f"a law, as names are laws of robots and {type(model).__name__} contains none"
            )
            remedy = (
                f"Give {{{law!r}: controllers.BarrierBackstepping(...)}}, with a barrier a level."
            )
            raise checks.fail("laws", law, expected, remedy)
    return dataclasses.replace(scenario, controller=controller, observer=observer, model=model)


def _folds(scenario: Scenario, further: Sequence[Fold]) -> tuple[Fold, ...]:
    """The folds of a run: those of `further`, and of other classes the standard ones and those of
    the signals that runs with its law have.
    """
    if not isinstance(further, tuple | list):
        remedy = "Put one fold into brackets, metrics=(fold,)."
        raise checks.fail("metrics", further, "a tuple of folds", remedy)
    replaced = tuple(type(fold) for fold in further)
    usual = (*standard(), *optional_folds(scenario), AboveGravity())
    return (*(fold for fold in usual if not isinstance(fold, replaced)), *further)


def _limited_as(controller: TrackingLaw, law: TrackingLaw) -> TrackingLaw:
    """A law with the torque limits of another one."""
    if not isinstance(controller, Saturated):
        return law
    return dataclasses.replace(controller, law=_limited_as(controller.law, law))


def _run(scenario: Scenario, options: Mapping[str, Any]) -> Rollout:
    """One run; the table reports its failure, so there is no warning."""
    with notices.muted(UserWarning):
        folds = _folds(scenario, options["metrics"])
        return simulate(scenario, **{**options, "metrics": folds})


def gain_names(law: TrackingLaw) -> tuple[str, ...]:
    """The leaves of a law that are scaled together: those of its class attribute `gains`, or k1 and
    K2 by default.
    """
    inner = unwrapped(law)
    values = field_values(inner)
    return tuple(name for name in inner.gains if values.get(name) is not None)


@dataclasses.dataclass(frozen=True, eq=False)
class _EqualEffort:
    """A law at the effort of the first one, or the reason why no gain factor gives it."""

    factor: float
    run: Rollout | None = None
    reason: str = ""
    search: EffortSearch | None = None


def _at_effort_of(
    title: str, reference: Rollout, own: Rollout, scenario: Scenario, options: Mapping[str, Any]
) -> _EqualEffort:
    """Scales the gains of a law until its effort is that of the first law."""
    if int(reference.status) & NO_EFFORT:
        reason = f"the first law, {title}, failed itself, so it sets no effort"
        return _EqualEffort(float("nan"), reason=reason)
    names = gain_names(scenario.controller)
    if not names:
        reason = "it has no gains to scale: no k1, K2, and no class attribute `gains`"
        return _EqualEffort(float("nan"), reason=reason)
    target = float(reference.metrics.effort_above_gravity)

    def dt_for(trials: Trials) -> float | None:
        """The largest time step [s] at which none of these trials would be flagged."""
        dt, method = options["dt"], options["method"]
        return needed_dt(trials.status, trials.mode, trials.error, dt, method)

    inaccurate = bool((int(reference.status) | int(own.status)) & Status.INACCURATE)
    trials_of = _trials_of(scenario, names, options)
    unit, texts = unit_text(scenario, INPUT), status_words(scenario)
    found = search(trials_of, target, dt_for, inaccurate, unit, texts)
    for factor in found.crossings:
        run = _run(with_parameters(scenario, _scaled(scenario, names, factor)), options)
        if not int(run.status) & NO_EFFORT:
            return _EqualEffort(factor, run, search=found)
    reason = found.remark()
    if isinstance(unwrapped(scenario.controller), BarrierBackstepping):
        reason += f"; {ONLY_K}"
    return _EqualEffort(float("nan"), reason=reason, search=found)


def _scaled(scenario: Scenario, names: Sequence[str], factor: np.ndarray | float) -> dict[str, Any]:
    """Path -> gains times a factor, or times each of several factors, (N, ...)."""
    gains = attributes(unwrapped(scenario.controller), names)
    return {
        f"controller.{name}": np.multiply.outer(factor, np.asarray(gain))
        for name, gain in gains.items()
    }


def _trials_of(
    scenario: Scenario, names: Sequence[str], options: Mapping[str, Any]
) -> Callable[[np.ndarray], Trials]:
    """A function that runs all given factors, (N,), in one batch.  The batch has a fixed size, so
    that it is compiled once.
    """
    with notices.muted(UserWarning):
        scenario = canonical(scenario)
    dtype, size = scenario.initial.q.dtype, len(grid())
    folds = as_folds((AboveGravity(),), dtype, scenario)
    steps = checks.whole_steps(options["duration"], options["dt"])
    request = RunRequest.of(scenario, steps=steps, method=options["method"])
    noise = noise_values(scenario, jax.random.PRNGKey(0), 0)

    def trials(factors: np.ndarray) -> Trials:
        padded = np.resize(factors, size)
        varied = {
            path: jnp.asarray(x, dtype) for path, x in _scaled(scenario, names, padded).items()
        }
        varied |= {name: jnp.broadcast_to(x, (size, *x.shape)) for name, x in noise.items()}
        found = _batch(scenario, varied, folds, jnp.asarray(options["dt"], dtype), request=request)
        results = Trials(
            found.metrics["effort_above_gravity"],
            found.status,
            found.fastest_mode,
            np.asarray(errors_by_step(found.metrics)),
        )
        return Trials(*(np.asarray(x)[: len(factors)] for x in results))

    return trials


@programs.jit(static_argnames="request")
def _batch(
    scenario: Scenario,
    varied: dict[str, jax.Array],
    folds: tuple[Fold, ...],
    dt: jax.Array,
    *,
    request: RunRequest,
) -> Outcome:
    return run_batch(scenario, varied, folds, dt, request)


def factor_nearest_one(effort: Callable[[float], float], target: float) -> float:
    """The factor of [1/32, 32] nearest to 1, by |ln|, at which effort(factor) = target, or NaN if
    none was found.

    Args:
      effort: factor -> effort [N m], NaN for a run that failed.
      target: effort to reach [N m].
    """

    def trials(factors: np.ndarray) -> Trials:
        efforts = np.array([effort(float(factor)) for factor in factors], float)
        none = np.zeros(len(factors))
        return Trials(efforts, none.astype(int), none, none)

    return search(trials, target).factor


def _shown(value: object) -> str:
    values = np.unique(np.asarray(value))
    if values.size == 1:
        return f"{values[0]:g}"
    return np.array2string(np.squeeze(np.asarray(value)), precision=4)
