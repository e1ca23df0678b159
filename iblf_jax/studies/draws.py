"""From perturbations to the parameters of run i.

Run i draws, for the leaf that is addressed by `path`,

    u = uniform(fold_in(fold_in(key(seed), i), crc32(path))),
    value = perturbation(nominal, F^-1(u))

so a draw depends on seed, run and path only: not on the device, the number of runs or the other
perturbations.  The generator returns the lower ends of equal cells of [0, 1); u is the middle of
such a cell, so it lies in the open interval (0, 1).  Leaves that vary together share u, under the
name of their group.  A path that begins with `robot.` perturbs plant and model with the same u,
each about its own nominal value.
"""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.distributions import (
    Distribution,
    JointSamples,
    Perturbation,
    is_interval,
)

_SIGNS = {"positive": "> 0", "nonnegative": ">= 0"}


class Target(NamedTuple):
    """One leaf (or entry) that is perturbed; static."""

    path: str
    """The leaf that the value replaces."""
    source: str
    """The path that the user wrote; the draw depends on it."""
    shape: tuple[int, ...]
    sign: str | None


class UncertainScenario(NamedTuple):
    """A scenario with perturbed parameters, from which any run is drawn; traced."""

    scenario: Scenario
    perturbations: dict[str, Perturbation]
    """Path of the target -> perturbation."""
    key: jax.Array


class CaseInputs(NamedTuple):
    """The inputs that differ between the cases of a block, case axis first."""

    index: Any
    """Run number: what the draw depends on, (B,) uint32."""
    points: dict[str, Any]
    """Path -> values that replace the scenario's before the perturbation (a sweep's point)."""
    u: dict[str, Any]
    """Path of the user -> designed uniform numbers; empty when draws are independent."""


def case_inputs(
    cases: np.ndarray,
    runs: int,
    points: Mapping[str, np.ndarray],
    designed: Mapping[str, np.ndarray],
) -> CaseInputs:
    """The inputs of the cases with these numbers.

    Args:
      cases: numbers, case = point * runs + run.
      runs: runs at each point.
      points: path -> value at every point.
      designed: path -> designed uniform numbers of every run.
    """
    point, run = np.divmod(cases, runs)
    return CaseInputs(
        run.astype(np.uint32),
        {path: values[point] for path, values in points.items()},
        {path: u[run] for path, u in designed.items()},
    )


def paths_overlap(scenario: Scenario, path: str, other: str) -> bool:
    """Whether two paths address an entry in common."""
    pairs = itertools.product(paths.places(scenario, path), paths.places(scenario, other))
    return any(all(x == y for x, y in zip(a, b, strict=False)) for a, b in pairs)


def check_paths(scenario: Scenario, chosen: Iterable[str], what: str) -> None:
    """Raises ValueError for a path that is unknown, negative in an index, or overlaps another."""
    seen: list[str] = []
    for path in chosen:
        for full in paths.expand(path):
            paths.get(scenario, full)
            if any(isinstance(token, int) and token < 0 for token in paths.parse(full)):
                raise checks.fail(f"{what}: path", path, "an index >= 0", "Count from the front.")
        for other in seen:
            if paths_overlap(scenario, path, other):
                raise checks.fail(
                    what,
                    (other, path),
                    "paths that do not overlap",
                    "Both would set the same number: keep one of them.",
                )
        seen.append(path)


def targets_of(
    scenario: Scenario,
    perturbations: Any,
    what: str = "perturbations",
    *,
    signs: bool = True,
    intervals: bool = False,
) -> tuple[tuple[Target, ...], dict[str, Perturbation]]:
    """Checks a user's perturbations; returns the targets, and target path -> perturbation.

    Args:
      scenario: what is perturbed.
      perturbations: path -> perturbation.
      what: their name in error messages.
      signs: whether to refuse bounded distributions that reach inadmissible values.
      intervals: whether the perturbations are sets without probabilities (`ij.interval`) and not
        distributions.

    Raises:
      ValueError: not a mapping of perturbations, an unknown or overlapping path, an interval in
        place of a distribution or the reverse, a distribution that does not fit the leaf or reaches
        inadmissible values (a factor from -1 to 1 on a mass), or leaves that cannot share the draws
        of their group.
    """
    checks.mapping(what, perturbations, '{"plant.mass[1]": ij.factor(ij.uniform(0.7, 1.3))}')
    check_paths(scenario, perturbations, what)
    targets, by_path = [], {}
    for source, perturbation in perturbations.items():
        if not isinstance(perturbation, Perturbation):
            expected = "ij.factor(...), ij.offset(...) or ij.value(...)"
            raise checks.fail(
                f"{what}[{source!r}]", perturbation, expected, _remedy_for(perturbation)
            )
        _check_kind(f"{what}[{source!r}]", perturbation, intervals)
        # Plant and model are separate targets where their nominal values differ.
        full = paths.expand(source)
        values = [np.asarray(paths.get(scenario, path)) for path in full]
        if perturbation.kind == "value" or all(np.array_equal(x, values[0]) for x in values):
            full = [source]
        for path in full:
            nominal = np.asarray(paths.get(scenario, path))
            sign = paths.sign_at(scenario, path)
            target = Target(path, source, nominal.shape, sign)
            _check_fit(f"{what}[{source!r}]", perturbation, nominal)
            if signs and sign is not None:
                _check_sign(f"{what}[{source!r}]", target, perturbation, nominal)
            targets.append(target)
            by_path[path] = perturbation
    first: dict[str, tuple[str, Any]] = {}
    for path, perturbation in by_path.items():
        group = perturbation.group
        distribution: Any = perturbation.distribution
        other_path, other = first.setdefault(group, (path, distribution))
        if group and not _can_share_draws(other, distribution):
            expected = "the same number of draws, and the same weights of samples"
            remedy = "Give the leaves that do not vary together groups of other names."
            raise checks.fail(f"{what}: group {group!r}", (other_path, path), expected, remedy)
    return tuple(targets), by_path


def _can_share_draws(a: Distribution, b: Distribution) -> bool:
    """Whether the draws of a group serve both: d numbers, or one of a list of samples."""
    if a.draws != b.draws:
        return False
    if not isinstance(a, JointSamples) or not isinstance(b, JointSamples):
        return True
    if a.weights.shape != b.weights.shape:
        return False
    if not checks.is_concrete((a.weights, b.weights)):
        return True
    return np.array_equal(np.asarray(a.weights), np.asarray(b.weights))


def _remedy_for(given: object) -> str:
    """The remedy for a range or a distribution that was given instead of a perturbation."""
    if isinstance(given, tuple | list) and len(given) == 2 and checks.is_concrete(given):
        ends = [
            np.asarray(x).tolist() if isinstance(x, np.ndarray | jax.Array) else x for x in given
        ]
        low, high = map(checks.shown, ends)
        return (
            "Say how the draw acts on the leaf: for values between two ends"
            f" ij.value(ij.uniform({low}, {high}))."
        )
    return "Say how the draw acts on the leaf: ij.value(ij.uniform(low, high)), for example."


def _check_kind(name: str, perturbation: Perturbation, intervals: bool) -> None:
    """Raises ValueError for an interval where runs are drawn, or a distribution where all values
    of a set are meant.
    """
    if is_interval(perturbation) == intervals:
        return
    if intervals:
        expected = "an interval: a proof holds for all values of a set, without probabilities"
        ends = perturbation.distribution.support()
        listed = "low, high"
        if np.all(np.isfinite(np.stack(np.broadcast_arrays(*ends)))):
            listed = ", ".join(str(np.asarray(end).tolist()) for end in ends)
        remedy = f"Write ij.{perturbation.kind}(ij.interval({listed}))."
    else:
        expected = "a distribution: an interval is a set of values without probabilities"
        remedy = f"Write ij.{perturbation.kind}(ij.uniform(low, high)) for equal probabilities."
    raise checks.fail(name, perturbation.distribution, expected, remedy)


def _check_fit(name: str, perturbation: Perturbation, nominal: np.ndarray) -> None:
    try:
        low, _ = perturbation.range(nominal)
        fits = np.broadcast_shapes(np.shape(low), nominal.shape) == nominal.shape
    except ValueError:
        fits = False
    if not fits:
        raise checks.fail(
            name, perturbation.distribution, f"numbers that fit the leaf's shape {nominal.shape}"
        )
    if perturbation.kind == "factor" and not np.any(nominal):
        raise checks.fail(
            name,
            "a factor of a leaf that is 0",
            "a nominal value that is not 0",
            "Use ij.offset or ij.value.",
        )


def _check_sign(name: str, target: Target, perturbation: Perturbation, nominal: np.ndarray) -> None:
    """Raises ValueError if a bounded distribution reaches values that the leaf does not admit."""
    low, _ = perturbation.range(nominal)
    lowest = float(np.min(low, where=np.isfinite(low), initial=np.inf))
    if lowest < 0 or (target.sign == "positive" and lowest == 0):
        raise checks.fail(
            name,
            f"values down to {lowest:g}",
            f"values {_SIGNS[target.sign or '']} only, as {target.path} needs",
            "Narrow the distribution.",
        )


def draw_shapes(
    targets: tuple[Target, ...], perturbations: Mapping[str, Perturbation]
) -> dict[str, tuple[int, ...]]:
    """Name of each draw -> shape of its u.

    The name is the path that the user wrote, with the shape of the leaf, or () where its entries
    share one draw; or it is that of a group, with the number of its draws.
    """
    shapes = {}
    for target in targets:
        perturbation = perturbations[target.path]
        shape = target.shape
        distribution: Any = perturbation.distribution
        if perturbation.group:
            shape = (distribution.draws,)
        elif perturbation.shared:
            shape = ()
        shapes[perturbation.group or target.source] = shape
    return shapes


def uniform_numbers(
    key: jax.Array, index: jax.Array, source: str, shape: tuple[int, ...], dtype
) -> jax.Array:
    """The u of one run and one path, in (0, 1)."""
    own = jax.random.fold_in(jax.random.fold_in(key, index), zlib.crc32(source.encode()))
    return jax.random.uniform(own, shape, dtype) + jnp.finfo(dtype).eps / 2


def draw(
    uncertain: UncertainScenario,
    targets: tuple[Target, ...],
    index: jax.Array,
    point: Mapping[str, Any],
    u: Mapping[str, Any],
):
    """The perturbed leaves of one run.

    Args:
      uncertain: scenario, perturbations and key.
      targets: what is perturbed, static.
      index: run number, () uint32.
      point: path -> value that replaces the scenario's first.
      u: designed uniform numbers, or empty.

    Returns:
      Path -> value for the targets, with the nominal value where the draw was inadmissible; path ->
      value as drawn; and whether all draws were admissible.
    """
    scenario = paths.with_parameters(uncertain.scenario, point)
    dtype = scenario.initial.q.dtype
    numbers = u or {
        source: uniform_numbers(uncertain.key, index, source, shape, dtype)
        for source, shape in draw_shapes(targets, uncertain.perturbations).items()
    }
    used, drawn, admissible = {}, {}, jnp.asarray(True)
    for target in targets:
        nominal = jnp.asarray(paths.get(scenario, target.path))
        perturbation = uncertain.perturbations[target.path]
        u_of_target = numbers[perturbation.group or target.source]
        value = perturbation.apply(nominal, u_of_target.astype(dtype))
        is_admissible = jnp.all(jnp.isfinite(value))
        if target.sign == "positive":
            is_admissible &= jnp.all(value > 0)
        elif target.sign is not None:
            is_admissible &= jnp.all(value >= 0)
        admissible &= is_admissible
        drawn[target.path] = value
        used[target.path] = jnp.where(is_admissible, value, nominal)
    return used, drawn, admissible


def replaced_leaves(
    scenario: Scenario, point: Mapping[str, Any], drawn: Mapping[str, Any]
) -> dict[str, Any]:
    """Path -> value of everything that a run replaces, from its point and its draws.

    Where a path of the point and one of the draws overlap, the whole leaf is replaced, so that no
    entry is set twice.
    """
    overlapping: set[str] = set()
    for pair in itertools.product(point, drawn):
        if paths_overlap(scenario, *pair):
            overlapping.update(pair)
    replaced = {**point, **drawn}
    if not overlapping:
        return replaced
    changed = paths.with_parameters(paths.with_parameters(scenario, point), drawn)
    leaves = {
        leaf for path in replaced if path in overlapping for leaf in paths.leaves(scenario, path)
    }
    rest = {
        path: value
        for path, value in replaced.items()
        if not any(paths_overlap(scenario, path, leaf) for leaf in leaves)
    }
    return {**rest, **{leaf: paths.get(changed, leaf) for leaf in leaves}}
