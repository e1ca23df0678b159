"""One run that a user transforms: differentiated, batched, or compiled as a part of something
larger.

The run itself is plain JAX (`scan`).  Its first derivatives are a kernel's, where there is one,

    out' = J leaves',       J = d (records, metrics) / d leaves,

each column of J a run with one tangent (`columns`).  JAX transposes the product, so both modes have
it.  J's own derivative is made in the same way.  Third derivatives are the scan's, and those by the
step, by a metric's parameters, or of more records than are kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero

from iblf_jax.core import checks, devices
from iblf_jax.engine import execute, plan
from iblf_jax.engine.batch import Batch, Leaves, run_all
from iblf_jax.engine.columns import ACCURACY, Places, columns, floats_of, numbers_of
from iblf_jax.engine.executors import scan
from iblf_jax.engine.mechanism import known_of
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.step import Outcome, recorded
from iblf_jax.kernels import ToolchainError, UnsupportedError
from iblf_jax.simulation.scenario import Scenario


class Runs(NamedTuple):
    """What is run on lists of leaves; static."""

    treedef: Any
    """Of the `Inputs`."""
    run: RunRequest
    executor: str
    is_lane: tuple[bool, ...]
    """Which leaves have a run axis."""
    runs: int = 1

    def batch(self, leaves: tuple) -> Batch:
        """Of all runs."""
        shared, lane = (
            [x for x, yes in zip(leaves, self.is_lane, strict=True) if yes is which]
            for which in (False, True)
        )
        return Batch(
            Leaves(self.treedef, self.is_lane, shared, lane),
            self.runs,
            mechanism=self.run.constants,
        )


def run_transformable(
    scenario: Scenario,
    folds: Any,
    dt: jax.Array,
    run: RunRequest,
    *,
    backend: str = "auto",
    noise: Any = None,
) -> Outcome:
    """One run that may be batched and differentiated from outside.

    Args:
      scenario, folds, dt, run, noise: as `execute.run_one`.
      backend: what its derivatives are computed on: "xla" for plain JAX, else kernels where they
        can be built.
    """
    leaves, treedef = jax.tree.flatten(execute.inputs_of(scenario, folds, dt, run, noise))
    name, reason = execute.automatic()
    request = run._replace(constants=known_of(scenario), backend="auto")
    runs = Runs(treedef, request, name, (False,) * len(leaves))
    return (
        _differentiable(runs)(*leaves)
        if backend != "xla" and reason is None
        else _plain(runs, *leaves)
    )


@partial(jax.jit, static_argnums=0)
def _plain(runs: Runs, *leaves: jax.Array) -> Outcome:
    """The run by the scan."""
    inputs = jax.tree.unflatten(runs.treedef, leaves)
    shape = plan.scan_shape(devices.platform(), execute.operations(inputs), None, nested=True)
    return run_all(scan, Batch.of(inputs, None, shape), runs.run)


@lru_cache(maxsize=64)
def _differentiable(runs: Runs, is_asked: bool = False) -> Callable:
    """`_plain` with the kernel's derivatives; `is_asked`: the value beside a derivative is the
    kernel's too.
    """
    whole = jax.custom_jvp(partial(_value if is_asked else _plain, runs))

    def rule(leaves, tangents):
        places, moves = _moves(tangents)
        by_kernel = _by_kernel(runs, (places,), leaves)
        if by_kernel is not None:
            try:
                found = _differentiable(runs, True)(*leaves)
                return found, _in_form_of(found, *_times(by_kernel, moves, 0))
            except (UnsupportedError, ToolchainError):
                pass
        return jax.jvp(
            lambda *moved: _plain(runs, *_put(leaves, places, moved)),
            [leaves[i] for i in places],
            moves,
        )

    whole.defjvp(rule, symbolic_zeros=True)
    return whole


def _moves(tangents: tuple) -> tuple[tuple[int, ...], list[jax.Array]]:
    """Which leaves move, and how."""
    places = tuple(i for i, x in enumerate(tangents) if not isinstance(x, SymbolicZero))
    return places, [tangents[i] for i in places]


def _times(J: Any, moves: list[jax.Array], axis: int) -> Any:
    """A derivative times how far the leaves move."""
    direction = jnp.concatenate([jnp.ravel(x) for x in moves])
    return jax.tree.map(lambda x: jnp.tensordot(x, direction, ((axis,), (0,))), J)


def _put(leaves: tuple, places: tuple[int, ...], moved: Sequence[jax.Array]) -> tuple:
    """The leaves, some of them replaced."""
    new = dict(zip(places, moved, strict=True))
    return tuple(new.get(i, x) for i, x in enumerate(leaves))


def _value(runs: Runs, *leaves: jax.Array) -> Outcome:
    """The run by the kernel."""
    if checks.is_concrete(leaves):
        inputs = jax.tree.unflatten(runs.treedef, leaves)
        run = runs.run._replace(constants=known_of(inputs.scenario))
        return execute.run_one(inputs.scenario, inputs.folds, inputs.dt, run, noise=inputs.noise)
    return jax.tree.map(lambda x: x[0], _over_runs(_values, runs)(*leaves))


def _by_kernel(runs: Runs, places: Places, leaves: tuple) -> Any:
    """A derivative of records and metrics by the kernel, differentiable; None where there is
    none.
    """
    scenario = len(jax.tree.leaves(jax.tree.unflatten(runs.treedef, runs.is_lane).scenario))
    if not all(i < scenario for level in places for i in level) or not plan.keeps_columns(
        len(places), _size(runs, places, leaves)
    ):
        return None
    kernel = jax.custom_jvp(
        lambda *leaves: jax.tree.map(lambda x: x[0], _over_runs(_columns, runs, places)(*leaves))
    )

    def rule(leaves, tangents):
        more, moves = _moves(tangents)
        second = _by_kernel(runs, (*places, more), leaves)
        if second is None:
            return jax.jvp(
                lambda *moved: _by_scan(runs, places, _put(leaves, more, moved)),
                [leaves[i] for i in more],
                moves,
            )
        return kernel(*leaves), _times(second, moves, len(places))

    kernel.defjvp(rule, symbolic_zeros=True)
    try:
        return kernel(*leaves)
    except (UnsupportedError, ToolchainError):
        return None


def _by_scan(runs: Runs, places: Places, leaves: tuple) -> Any:
    """As `_by_kernel`, by the scan."""
    if not places:
        found = _plain(runs, *leaves)
        folded = {name: x for name, x in found.metrics.items() if name not in ACCURACY}
        return floats_of(found.records), {
            name: x for name, x in folded.items() if jnp.issubdtype(x.dtype, jnp.floating)
        }
    level, shapes = places[-1], [jnp.shape(leaves[i]) for i in places[-1]]
    ends = np.cumsum([math.prod(shape) for shape in shapes])

    def along(unit):
        parts = [
            x.reshape(shape) for x, shape in zip(jnp.split(unit, ends[:-1]), shapes, strict=True)
        ]
        return jax.jvp(
            lambda *moved: _by_scan(runs, places[:-1], _put(leaves, level, moved)),
            [leaves[i] for i in level],
            parts,
        )[1]

    return jax.vmap(along, out_axes=len(places) - 1)(
        jnp.eye(ends[-1], dtype=leaves[level[0]].dtype)
    )


def _size(runs: Runs, places: Places, leaves: tuple) -> int:
    """Numbers of a derivative of one run's records."""
    every, inputs = runs.run.record_every, jax.tree.unflatten(runs.treedef, leaves)
    numbers = 0 if every is None else numbers_of(inputs, recorded) * (runs.run.steps // every + 1)
    return numbers * math.prod(sum(jnp.size(leaves[i]) for i in level) for level in places)


def _over_runs(function: Callable, runs: Runs, *static: Any) -> Callable:
    """function(runs, *static, leaves) for many runs at once where JAX batches it: more runs of one
    call.
    """
    batched = custom_vmap(lambda *leaves: function(runs, *static, leaves))

    @batched.def_vmap
    def rule(size, is_batched, *leaves):
        def widened(x, new, lane):
            if not (new or lane):
                return x
            x = x if new else jnp.broadcast_to(x, (size, *x.shape))
            return x.reshape(-1, *x.shape[2:]) if lane else jnp.repeat(x, runs.runs, axis=0)

        lane = tuple(map(bool.__or__, is_batched, runs.is_lane))
        wide = [widened(*each) for each in zip(leaves, is_batched, runs.is_lane, strict=True)]
        found = _over_runs(function, runs._replace(is_lane=lane, runs=size * runs.runs), *static)(
            *wide
        )
        found = jax.tree.map(lambda x: x.reshape(size, runs.runs, *x.shape[1:]), found)
        return found, jax.tree.map(lambda _: True, found)

    return batched


@partial(jax.jit, static_argnums=0)
def _values(runs: Runs, leaves: tuple) -> Outcome:
    return execute.run_lowered(runs.executor, runs.batch(leaves), runs.run)


@partial(jax.jit, static_argnums=(0, 1))
def _columns(runs: Runs, places: Places, leaves: tuple) -> Any:
    return columns(execute.executor_named(runs.executor), runs.batch(leaves), places, runs.run)


def _in_form_of(found: Outcome, records: list[jax.Array], metrics: dict[str, jax.Array]) -> Outcome:
    """Tangents in the form of an outcome."""
    each = iter(records)
    return Outcome(
        jax.tree.map(
            lambda x: next(each) if jnp.issubdtype(x.dtype, jnp.floating) else _no_tangent(x),
            found.records,
        ),
        {
            name: metrics[name] if name in metrics else _no_tangent(x)
            for name, x in found.metrics.items()
        },
        _no_tangent(found.status),
        _no_tangent(found.fastest_mode),
    )


def _no_tangent(x: jax.Array) -> Any:
    """The tangent of what does not depend on any leaf, or cannot."""
    return (
        jnp.zeros_like(x)
        if jnp.issubdtype(x.dtype, jnp.floating)
        else np.zeros(jnp.shape(x), jax.dtypes.float0)
    )
