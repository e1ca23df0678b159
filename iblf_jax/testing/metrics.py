"""The checker for metrics: the contract is `iblf_jax.metrics.Fold`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.engine import folded
from iblf_jax.simulation.metrics import Fold
from iblf_jax.simulation.signals import Sample, has
from iblf_jax.testing._contract import (
    Findings,
    check_function,
    in_both_types,
    is_float,
    same_structure,
    shape_of,
)
from iblf_jax.testing.joints import examine_joints

LENGTH, REGIONS = 40, 1


def check_fold(fold: Fold, *, n: int | None = None) -> None:
    """Checks a metric: the accumulator's structure, names and units, derivatives, float32, no NaN.

    Args:
      fold: an instance.
      n: number of joints; that of its leaves if not given, 2 if these are scalars.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: `n` is not a number of joints, or not that of the leaves.
    """
    with examine_joints(fold, Fold, n, "metric") as (findings, fold, joints):
        units = fold.units
        findings.require(
            isinstance(units, Mapping)
            and all(isinstance(x, str) for x in (*units, *units.values())),
            f"units is {units!r}",
            'It must be a dict from name to SI unit, {"rmse": "rad"}',
        )
        some = samples(np.random.default_rng(4), joints)
        in_both_types(findings, _structure, fold, some)

        numbers, flags = parts(some)
        result = jax.jit(folded)((fold,), some)
        for name, value in result.items():
            findings.require(not np.any(np.isnan(value)), f"{name} is NaN on an ordinary run")
        finite = [
            name for name, value in result.items() if np.all(np.isfinite(value)) and is_float(value)
        ]

        def outputs(fold, numbers):
            found = folded((fold,), Sample(**numbers, **flags))
            return {name: found[name] for name in finite}

        check_function(findings, outputs, fold, (numbers,))
        at_rest(findings, fold, some)


def samples(rng: np.random.Generator, n: int = 2, step: float = 0.01) -> Sample:
    """A synthetic run of n joints, (LENGTH, ...), with a time step [s], in which all numbers
    differ.
    """
    index = np.arange(LENGTH)
    t = index * step
    dt = np.full(LENGTH, step)
    dt[[0, -1]] = 0.5 * step
    since = np.where(index > 0, step, 0.0)
    angle = 0.08 * index[:, None]

    def wave(size):
        phase, speed = rng.uniform(0, 6, (2, 1, n))
        return (
            size * np.sin((1 + speed) * angle + phase) + rng.uniform(-0.1, 0.1, (LENGTH, n)) * size
        )

    q_d, e1, tau = 0.5 + wave(0.1), wave(0.2), wave(5.0)
    dq, e2 = wave(1.0), wave(1.0)
    names = ("dq_d", "alpha", "disturbance", "disturbance_estimate", "gravity")
    signals = {name: wave(1.0) for name in names}
    lower, upper = (
        np.broadcast_to(np.array(rows)[:, None], (LENGTH, 3, n))
        for rows in ((0.2, -0.9, -0.9), (0.85, 1.1, 1.1))
    )
    signals |= {
        "slack": np.abs(wave(0.1)),
        "x": np.stack([q_d + e1, dq, wave(1.0)], axis=1),
        "e": np.stack([e1, e2, wave(0.2)], axis=1),
        "level_lower": lower,
        "level_upper": upper,
        "x_hat": np.stack([wave(0.2), wave(1.0)], axis=1),
        "level_error": np.stack([wave(0.01), wave(0.1)], axis=1),
        "limit_excess": wave(1.0)[:, 0],
        "region_margin": 0.3 + wave(0.2)[:, :REGIONS],
        "region_slack": np.abs(wave(0.1))[:, :REGIONS],
        "xi": e1 / np.where(e1 > 0, upper[:, 0] - q_d, q_d - lower[:, 0]),
        "q_d": q_d,
        "tau": tau,
        "V": np.abs(wave(1.0))[:, 0],
        "t": t,
        "dt": dt,
        "step": since,
    }
    signals["events"] = 1.0 + np.floor(np.sqrt(index))  # intervals that differ
    signals["auxiliary"] = 0.1 * np.cos(angle) * e2
    for name in ("guard_active", "saturated"):
        signals[name] = rng.uniform(size=(LENGTH, n)) < 0.3
    return Sample(**jax.tree.map(jnp.asarray, signals))


def parts(samples: Sample) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
    """The floating-point signals of a run, and its flags."""
    flags = dict(vars(samples))
    names = [name for name, x in vars(samples).items() if has(samples, name) and is_float(x)]
    numbers = {name: flags.pop(name) for name in names}
    return numbers, flags


def _structure(findings: Findings, fold: Fold, samples: Sample) -> None:
    first = jax.tree.map(lambda x: np.asarray(x)[0], samples)
    acc = accumulates(findings, fold, first)
    result = shape_of(findings, "finish(acc)", fold.finish, acc)
    remedy = "It must be a dict from name to array"
    findings.result_is(isinstance(result, dict), "finish(acc)", result, remedy)
    findings.require(
        set(result) == set(fold.units),
        f"finish(acc) returns {sorted(result)}, units names {sorted(fold.units)}",
        "Every name needs a unit, and every unit a name",
    )


def accumulates(findings: Findings, fold: Any, sample: Sample) -> Any:
    """The shapes of an accumulator; requires that `update` keeps them."""
    acc = shape_of(findings, "init(sample)", fold.init, sample)
    label = "update(acc, sample)"
    same_structure(findings, label, shape_of(findings, label, fold.update, acc, sample), acc)
    return acc


def at_rest(findings: Findings, fold: Fold, samples: Sample) -> None:
    """Requires that no result and no derivative is NaN on a run without errors and torques."""
    kept = {
        name: vars(samples)[name]
        for name in ("t", "dt", "step", "level_lower", "level_upper", "q_d")
    }
    zeros = jax.tree.map(np.zeros_like, samples)
    zeros.x[:, 0] = samples.q_d
    numbers, flags = parts(dataclasses.replace(zeros, **kept))

    @jax.jit
    def both(fold, numbers):
        def floats(fold, numbers):
            result = folded((fold,), Sample(**numbers, **flags))
            return {k: v for k, v in result.items() if is_float(v)}

        values, pull = jax.vjp(floats, fold, numbers)
        finite = {k: jnp.where(jnp.isfinite(v), jnp.ones_like(v), 0.0) for k, v in values.items()}
        return values, pull(finite)

    values, gradient = both(fold, numbers)
    for name, value in values.items():
        findings.require(
            not np.any(np.isnan(value)),
            f"{name} is NaN on a run without any error",
            "Guard divisions and roots by zero",
        )
    clean = all(not np.any(np.isnan(x)) for x in jax.tree.leaves(gradient))
    findings.require(
        clean,
        "its derivative is NaN on a run without any error",
        "sqrt(0) has no derivative: use a double jnp.where",
    )
