"""The metrics along a run: their accumulators begin with the first sample, every sample updates
them, and the results follow from the last ones.

A fold is a metric as `simulation.metrics` defines it (`init`, `update`, `finish`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from iblf_jax.kernels import jaxprs
from iblf_jax.simulation.signals import Sample

if TYPE_CHECKING:
    from iblf_jax.simulation.metrics import Fold


def initial_accumulators(folds: tuple[Fold, ...], sample: Sample) -> tuple:
    """The accumulators before a first sample."""
    return tuple(fold.init(sample) for fold in folds)


def initialised_at(
    index: jax.Array, folds: tuple[Fold, ...], sample: Sample, accumulators: tuple
) -> tuple:
    """At index 0, the accumulators that depend on the first sample are initialised from it; all
    others pass through unchanged.
    """
    traced, shapes = jax.make_jaxpr(initial_accumulators, return_shape=True)(folds, sample)
    depends = jaxprs.depend_on_last(traced, len(jax.tree.leaves(sample)))
    chosen = jax.tree.unflatten(jax.tree.structure(shapes), depends)

    def of_first(depends_on_sample, new, old):
        if not depends_on_sample:
            return old
        return jnp.where(index > 0, old, new)

    return jax.tree.map(
        of_first,
        chosen,
        initial_accumulators(folds, sample),
        accumulators,
    )


def updated(folds: tuple[Fold, ...], accumulators: tuple, sample: Sample) -> tuple:
    """The accumulators after a sample."""
    return tuple(fold.update(acc, sample) for fold, acc in zip(folds, accumulators, strict=True))


def weighed(sample: Sample, t: jax.Array, weight: jax.Array, step: jax.Array) -> Sample:
    """A sample with its time, its weight in integrals, and the time since the instant before."""
    return dataclasses.replace(sample, t=t, dt=weight, step=step)


def split_floats(tree: object) -> tuple[list[jax.Array], Callable]:
    """The floating-point numbers of a tree, and the function that puts others in their place."""
    leaves, treedef = jax.tree.flatten(tree)
    places = [i for i, x in enumerate(leaves) if jnp.issubdtype(jnp.result_type(x), jnp.floating)]

    def replaced(floats):
        new = list(leaves)
        for i, x in zip(places, floats, strict=True):
            new[i] = x
        return jax.tree.unflatten(treedef, new)

    return [leaves[i] for i in places], replaced


def finished(folds: tuple[Fold, ...], accumulators: tuple) -> dict[str, jax.Array]:
    """The results of all folds."""
    found: dict[str, jax.Array] = {}
    for fold, acc in zip(folds, accumulators, strict=True):
        found |= fold.finish(acc)
    return found


def folded(folds: tuple[Fold, ...], samples: Sample) -> dict[str, jax.Array]:
    """The results of all folds over a run that is over, its samples with time first."""
    first = jax.tree.map(lambda x: x[0], samples)
    return finished(
        folds,
        jax.lax.scan(
            lambda acc, sample: (updated(folds, acc, sample), None),
            initial_accumulators(folds, first),
            samples,
        )[0],
    )
