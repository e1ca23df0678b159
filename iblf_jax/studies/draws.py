"""From perturbations to the parameters of run i.

Run i draws, for the leaf that is addressed by `path`,

    u = uniform(fold_in(fold_in(key(seed), i), crc32(path))),    value = perturbation(nominal,
    F^-1(u))

so a draw depends on seed, run and path only: not on the device, the number of runs or the other
perturbations.  u lies in the open interval (0, 1), in the middle of the cells that the generator's
uniform numbers start.  Leaves that vary together share it, under the name of their group.  `robot.`
perturbs plant and model with the same u, each about its own nominal value.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.distributions import Perturbation

_SIGNS = {"positive": "> 0", "nonnegative": ">= 0"}


class Target(NamedTuple):
    """One leaf (or entry) that is perturbed; static."""

    path: str
    """Where the value goes."""
    source: str
    """The path that the user wrote: it names the draw."""
    shape: tuple[int, ...]
    sign: str | None


class Cases(NamedTuple):
    """What is needed to draw the parameters of any run: shared by all blocks, traced."""

    scenario: Scenario
    perturbations: dict[str, Perturbation]
    """Path of the target -> perturbation."""
    key: jax.Array


class CaseInputs(NamedTuple):
    """What differs between the cases of a block, case axis first."""

    index: Any
    """Run number: what the draw depends on, (B,) uint32."""
    points: dict[str, Any]
    """Path -> values that replace the scenario's before the perturbation (a sweep's point)."""
    u: dict[str, Any]
    """Path of the user -> designed uniform numbers; empty when draws are independent."""


def same_place(scenario: Scenario, path: str, other: str) -> bool:
    """Whether two paths address an entry in common."""
    pairs = [(a, b) for a in paths.places(scenario, path) for b in paths.places(scenario, other)]
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
            if same_place(scenario, path, other):
                raise checks.fail(
                    what,
                    (other, path),
                    "paths that do not overlap",
                    "Both would set the same number: keep one of them.",
                )
        seen.append(path)


def targets_of(
    scenario: Scenario, perturbations: Any, what: str = "perturbations", *, signs: bool = True
) -> tuple[tuple[Target, ...], dict[str, Perturbation]]:
    """Checks a user's perturbations; returns the targets, and target path -> perturbation.

    Args:
      scenario: what is perturbed.
      perturbations: path -> perturbation.
      what: the user's word for them.
      signs: whether distributions that can leave the admissible range by design are refused.

    Raises:
      ValueError: not a mapping of perturbations, an unknown or overlapping path, a distribution
        that does not fit the leaf or can only leave its admissible range by design (a factor from
        -1 to 1 on a mass).
    """
    if not isinstance(perturbations, Mapping):
        raise checks.fail(
            what,
            perturbations,
            'a mapping such as {"plant.mass[1]": ij.factor(ij.uniform(0.7, 1.3))}',
        )
    check_paths(scenario, perturbations, what)
    targets, by_path = [], {}
    for source, perturbation in perturbations.items():
        if not isinstance(perturbation, Perturbation):
            expected = "ij.factor(...), ij.offset(...) or ij.value(...)"
            raise checks.fail(
                f"{what}[{source!r}]", perturbation, expected, _remedy_for(perturbation)
            )
        for path in _targets(scenario, source, perturbation):
            nominal = np.asarray(paths.get(scenario, path))
            target = Target(path, source, nominal.shape, paths.sign_at(scenario, path))
            _check_fit(
                target._replace(sign=target.sign if signs else None), perturbation, nominal, what
            )
            targets.append(target)
            by_path[path] = perturbation
    return tuple(targets), by_path


def _remedy_for(given: Any) -> str:
    """The remedy for a range or a distribution in the place of a perturbation, with the user's
    numbers.
    """
    if isinstance(given, tuple | list) and len(given) == 2 and checks.is_concrete(given):
        low, high = (
            checks.shown(np.asarray(x).tolist() if isinstance(x, np.ndarray | jax.Array) else x)
            for x in given
        )
        return (
            "Say how the draw acts on the leaf: for values between two ends"
            f" ij.value(ij.uniform({low}, {high}))."
        )
    return "Say how the draw acts on the leaf: ij.value(ij.uniform(low, high)), for example."


def _targets(scenario: Scenario, source: str, perturbation: Perturbation) -> list[str]:
    """The source itself, or plant and model apart where their nominal values differ."""
    full = paths.expand(source)
    nominal = [np.asarray(paths.get(scenario, path)) for path in full]
    same = perturbation.kind == "value" or all(np.array_equal(x, nominal[0]) for x in nominal)
    if same:
        return [source]
    return full


def _check_fit(target: Target, perturbation: Perturbation, nominal: np.ndarray, what: str) -> None:
    name = f"{what}[{target.source!r}]"
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
    bounded = np.isfinite(low)
    bad = {"positive": low <= 0, "nonnegative": low < 0}.get(
        target.sign or "", np.zeros(nominal.shape, bool)
    )
    if np.any(bad & bounded):
        worst = float(np.min(np.where(bounded, low, np.inf)))
        raise checks.fail(
            name,
            f"values down to {worst:g}",
            f"values {_SIGNS[target.sign or '']} only, as {target.path} needs",
            "Narrow the distribution.",
        )


def sample_size(
    targets: tuple[Target, ...], perturbations: Mapping[str, Perturbation]
) -> dict[str, tuple[int, ...]]:
    """Name of the draws -> shape of their u: path of the user, the leaf's or () where one draw is
    shared; or a group, and its size.
    """
    return {
        drawn_as(t, perturbations[t.path]): _shape_of_u(t, perturbations[t.path]) for t in targets
    }


def drawn_as(target: Target, perturbation: Perturbation) -> str:
    """The name of a target's draws: the path that the user wrote, or the group of leaves that vary
    together.
    """
    return getattr(perturbation.distribution, "group", "") or target.source


def _shape_of_u(target: Target, perturbation: Perturbation) -> tuple[int, ...]:
    if getattr(perturbation.distribution, "group", ""):
        return (perturbation.distribution.draws,)  # type: ignore[attr-defined]
    if perturbation.shared:
        return ()
    return target.shape


def uniform_numbers(
    key: jax.Array, index: jax.Array, source: str, shape: tuple[int, ...], dtype
) -> jax.Array:
    """The u of one run and one path, in (0, 1)."""
    own = jax.random.fold_in(jax.random.fold_in(key, index), zlib.crc32(source.encode()))
    return jax.random.uniform(own, shape, dtype) + jnp.finfo(dtype).eps / 2


def draw(
    cases: Cases,
    targets: tuple[Target, ...],
    index: jax.Array,
    point: Mapping[str, Any],
    u: Mapping[str, Any],
):
    """The perturbed leaves of one run.

    Args:
      cases: scenario, perturbations and key.
      targets: what is perturbed, static.
      index: run number, () uint32.
      point: path -> value that replaces the scenario's first.
      u: designed uniform numbers, or empty.

    Returns:
      Path -> value for the targets, with the nominal value where the draw was inadmissible; path ->
      value as drawn; and whether all draws were admissible.
    """
    scenario = paths.with_parameters(cases.scenario, point)
    dtype = scenario.initial.q.dtype
    numbers = u or {
        source: uniform_numbers(cases.key, index, source, shape, dtype)
        for source, shape in sample_size(targets, cases.perturbations).items()
    }
    made, drawn, admissible = {}, {}, jnp.asarray(True)
    for target in targets:
        nominal = jnp.asarray(paths.get(scenario, target.path))
        perturbation = cases.perturbations[target.path]
        value = perturbation.apply(nominal, numbers[drawn_as(target, perturbation)].astype(dtype))
        fine = jnp.all(jnp.isfinite(value))
        if target.sign is not None:
            fine &= jnp.all(value > 0 if target.sign == "positive" else value >= 0)
        admissible &= fine
        drawn[target.path] = value
        made[target.path] = jnp.where(fine, value, nominal)
    return made, drawn, admissible


def merge(scenario: Scenario, point: Mapping[str, Any], made: Mapping[str, Any]) -> dict[str, Any]:
    """What a run replaces, from its point and its draws: each place once, whole leaves where the
    two overlap.
    """
    overlapping = [p for p in point if any(same_place(scenario, p, m) for m in made)]
    if not overlapping:
        return {**point, **made}
    changed = paths.with_parameters(paths.with_parameters(scenario, point), made)
    meeting = [
        *overlapping,
        *(m for m in made if any(same_place(scenario, m, p) for p in overlapping)),
    ]
    touched = {leaf for p in meeting for leaf in paths.leaves(scenario, p)}
    rest = {
        p: v
        for p, v in {**point, **made}.items()
        if not any(same_place(scenario, p, leaf) for leaf in touched)
    }
    return {**rest, **{leaf: paths.get(changed, leaf) for leaf in touched}}
