"""The derivative of runs along one direction, as a primitive of JAX.

The derivative is linear in the direction.  In forward mode a kernel carries one tangent in every
run (`columns`); in reverse mode JAX transposes the primitive, and kernels go backwards in time
(`adjoint`).  Batched directions or leaves are more runs of one call.  The scan computes derivatives
of the primitive, and everything that no kernel can.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from iblf_jax.core import programs
from iblf_jax.core.caches import CACHE
from iblf_jax.engine import registry
from iblf_jax.engine.adjoint import Cotangents, ReverseRun
from iblf_jax.engine.batch import Batch, Leaves, run_all
from iblf_jax.engine.columns import ACCURACY, along_direction, floats_of
from iblf_jax.engine.compile import building, first_that_works, shapes_of
from iblf_jax.engine.loops import kernel_stepper, scan
from iblf_jax.engine.plan import ExecutionPlan
from iblf_jax.engine.registry import Executor
from iblf_jax.engine.request import RunRequest
from iblf_jax.kernels import UnsupportedError, is_zero, new_primitive, without_symbol

if TYPE_CHECKING:
    from jax.tree_util import PyTreeDef


class TracedRuns(NamedTuple):
    """Runs of lists of leaves inside a transformation of JAX; static."""

    treedef: PyTreeDef
    """Of the `Inputs`."""
    request: RunRequest
    backend: str
    """Of the derivatives."""
    is_per_run: tuple[bool, ...]
    """Which leaves have a run axis."""
    runs: int = 1

    def batch(self, leaves: Sequence[jax.Array]) -> Batch:
        """Of all runs."""
        groups = Leaves.of(self.treedef, self.is_per_run, leaves)
        return Batch(groups, self.runs, constants=self.request.constants)

    @property
    def plan(self) -> ExecutionPlan:
        """One executor; no warning reports the scan, which gives the same derivatives."""
        return ExecutionPlan((self.backend,), reports_unsupported=False)

    def repeated(
        self, size: int, operands: Sequence[jax.Array], is_batched: Sequence[bool]
    ) -> tuple[TracedRuns, list[jax.Array]]:
        """All runs for every entry of a batch axis.

        Args:
          size: entries of the axis.
          operands: leaves, and after them arrays with a run axis; each with the batch axis first
            where `is_batched`.
          is_batched: which operands have the batch axis.
        """
        others = len(operands) - len(self.is_per_run)
        wide = [
            with_more_runs(x, size, self.runs, is_new, is_per_run)
            for x, is_new, is_per_run in zip(
                operands, is_batched, self.is_per_run + (True,) * others, strict=True
            )
        ]
        # The operands after the leaves are not leaves of the runs.
        is_per_run = tuple(map(bool.__or__, map(bool, is_batched), self.is_per_run))
        return self._replace(is_per_run=is_per_run, runs=size * self.runs), wide

    def with_batch_axis(self, outputs: Sequence[jax.Array], size: int) -> list[jax.Array]:
        """What `repeated` runs return, with the batch axis before the run axis."""
        return [x.reshape(size, self.runs, *x.shape[1:]) for x in outputs]


def with_more_runs(
    x: jax.Array, size: int, runs: int, is_batched: bool, is_per_run: bool
) -> jax.Array:
    """A leaf of `runs` runs for each of `size` entries of a batch axis, if it differs at all."""
    if not (is_batched or is_per_run):
        return x
    if not is_batched:
        x = jnp.broadcast_to(x, (size, *x.shape))
    if is_per_run:
        return x.reshape(-1, *x.shape[2:])
    return jnp.repeat(x, runs, axis=0)


def derivative(
    runs: TracedRuns,
    places: tuple[int, ...],
    leaves: Sequence[jax.Array],
    tangents: Sequence[jax.Array],
) -> tuple[list[jax.Array], dict[str, jax.Array]]:
    """The derivative of a single run's records and metrics along a direction.

    Args:
      runs: what is run, once.
      places: indices of the leaves that move.
      leaves: all leaves.
      moves: how far each leaf at `places` moves.

    Returns:
      Of each float that is recorded, and by name of each metric that is a float.
    """
    # A leaf that moves is a leaf of the run, so that batches of directions are batches of runs.
    is_per_run = tuple(i in places for i in range(len(leaves)))
    own = [x[None] if differs else x for x, differs in zip(leaves, is_per_run, strict=True)]
    runs = runs._replace(is_per_run=is_per_run)
    directions = [x[None] for x in tangents]
    flat = [x[0] for x in _primitive.bind(*own, *directions, runs=runs, places=places)]
    names = _names(runs, shapes_of(own))
    count = len(flat) - len(names)
    return flat[:count], dict(zip(names, flat[count:], strict=True))


def _outputs(runs: TracedRuns, leaves: Sequence[jax.Array]) -> tuple[list[jax.Array], dict]:
    """The floats that are recorded, and the metrics that have derivatives, by the scan."""
    outcome = run_all(scan, runs.batch(leaves), runs.request)
    metrics = {
        name: x
        for name, x in outcome.metrics.items()
        if name not in ACCURACY and jnp.issubdtype(x.dtype, jnp.floating)
    }
    return floats_of(outcome.records), metrics


@CACHE.memoised(64)
def _shapes(runs: TracedRuns, shapes: tuple) -> Any:
    """The shapes of `_outputs`, for leaves of these shapes and types (`shapes_of`)."""
    structs = [jax.ShapeDtypeStruct(*shape) for shape in shapes]
    return jax.eval_shape(partial(_outputs, runs), structs)


def _names(runs: TracedRuns, shapes: tuple) -> list[str]:
    """The names of the metrics that have derivatives, in the order of the outputs."""
    return sorted(_shapes(runs, shapes)[1])


def _divided(runs: TracedRuns, operands: Sequence[Any]) -> tuple[list, list]:
    """The leaves and the moves among the operands of the primitive."""
    count = len(runs.is_per_run)
    return list(operands[:count]), list(operands[count:])


def _function_of(
    runs: TracedRuns, places: tuple[int, ...], leaves: Sequence[jax.Array]
) -> tuple[Callable, list[jax.Array]]:
    """All outputs by the scan as a function of the leaves at `places`, and these leaves."""

    def function(*moved: jax.Array) -> list[jax.Array]:
        values = list(leaves)
        for place, x in zip(places, moved, strict=True):
            values[place] = x
        return jax.tree.leaves(_outputs(runs, values))

    return function, [leaves[place] for place in places]


def _along(*operands: jax.Array, runs: TracedRuns, places: tuple[int, ...]) -> list[jax.Array]:
    """The outputs of the primitive."""
    leaves, tangents = _divided(runs, operands)

    def by_kernel(executor: Executor) -> list[jax.Array]:
        batch = runs.batch(leaves)
        run_steps = kernel_stepper(executor)
        return jax.tree.leaves(along_direction(run_steps, batch, places, tangents, runs.request))

    return first_that_works(
        runs.plan, by_kernel, lambda: _along_by_scan(*operands, runs=runs, places=places)
    )


def _along_by_scan(
    *operands: jax.Array, runs: TracedRuns, places: tuple[int, ...]
) -> list[jax.Array]:
    """As `_along`."""
    leaves, tangents = _divided(runs, operands)
    function, at = _function_of(runs, places, leaves)
    return jax.jvp(function, at, tangents)[1]


def _gradient(
    runs: TracedRuns,
    places: tuple[int, ...],
    which: tuple[int, ...],
    leaves: Sequence[jax.Array],
    cotangents: Sequence[jax.Array],
) -> list[jax.Array]:
    """The gradient of every run by the leaves at `places`, for cotangents of some outputs.

    Args:
      runs, places, leaves: of the primitive.
      which: indices of the outputs that have cotangents.
      cotangents: of these outputs.
    """
    count = len(leaves)

    def by_kernel(*operands: jax.Array) -> list[jax.Array]:
        return _batched_gradient(runs, places, which)(*operands)

    def by_scan(*operands: jax.Array) -> list[jax.Array]:
        function, at = _function_of(runs, places, operands[:count])
        _, pullback = jax.vjp(lambda *moved: [function(*moved)[i] for i in which], *at)
        return list(pullback(list(operands[count:])))

    kernel = jax.custom_jvp(by_kernel)
    kernel.defjvp(lambda primals, tangents: jax.jvp(by_scan, primals, tangents))
    return first_that_works(
        runs.plan,
        lambda _: kernel(*leaves, *cotangents),
        lambda: by_scan(*leaves, *cotangents),
    )


def _batched_gradient(
    runs: TracedRuns, places: tuple[int, ...], which: tuple[int, ...]
) -> Callable:
    """The gradient by kernels as a function of leaves and cotangents, for one batch axis more where
    JAX batches it.
    """

    @custom_vmap
    def gradient(*operands: jax.Array) -> list[jax.Array]:
        return _gradient_by_kernel(runs, places, which, operands)

    @gradient.def_vmap
    def rule(size, is_batched, *operands):
        more, wide = runs.repeated(size, operands, is_batched)
        found = runs.with_batch_axis(_batched_gradient(more, places, which)(*wide), size)
        return found, [True] * len(found)

    return gradient


@programs.jit(static_argnums=(0, 1, 2))
def _gradient_by_kernel(
    runs: TracedRuns, places: tuple[int, ...], which: tuple[int, ...], operands: Sequence[jax.Array]
) -> list[jax.Array]:
    leaves, cotangents = _divided(runs, operands)
    records, metrics = _shapes(runs, shapes_of(leaves))
    names = sorted(metrics)
    of_metrics: dict[str, jax.Array] = {}
    of_records: dict[int, jax.Array] = {}
    for i, x in zip(which, cotangents, strict=True):
        if i < len(records):
            of_records[i] = x
        else:
            of_metrics[names[i - len(records)]] = x
    run = ReverseRun(registry.EXECUTORS[runs.backend], runs.batch(leaves), places, runs.request)
    if not run.is_supported():
        raise UnsupportedError("its step is too long to compile the adjoint")
    with building():
        return run.backward(run.stored()[0], Cotangents(of_metrics, of_records))


# ------------------------------------------------------------------------------- rules of JAX


def _abstract(*operands: Any, runs: TracedRuns, places: tuple[int, ...]) -> list:
    leaves, _ = _divided(runs, operands)
    shapes = _shapes(runs, shapes_of(leaves))
    return [jax.core.ShapedArray(x.shape, x.dtype) for x in jax.tree.leaves(shapes)]


def _jvp(primals, tangents, *, runs, places):
    leaves, _ = _divided(runs, primals)
    of_leaves, of_tangents = _divided(runs, tangents)
    value = _primitive.bind(*primals, runs=runs, places=places)
    instantiated = [without_symbol(x) for x in of_tangents]
    if all(map(is_zero, of_leaves)):
        return value, _primitive.bind(*leaves, *instantiated, runs=runs, places=places)
    by_scan = partial(_along_by_scan, runs=runs, places=places)
    all_tangents = [*map(without_symbol, of_leaves), *instantiated]
    return value, jax.jvp(by_scan, primals, all_tangents)[1]


def _transpose(cotangents, *operands, runs, places):
    leaves, _ = _divided(runs, operands)
    which = tuple(i for i, x in enumerate(cotangents) if not is_zero(x))
    gradient = _gradient(runs, places, which, leaves, [cotangents[i] for i in which])
    return [None] * len(leaves) + gradient


def _batch(operands, axes, *, runs, places):
    is_batched = [axis is not None for axis in axes]
    first = [
        jnp.moveaxis(x, axis, 0) if is_new else x
        for x, axis, is_new in zip(operands, axes, is_batched, strict=True)
    ]
    size = next(len(x) for x, is_new in zip(first, is_batched, strict=True) if is_new)
    more, wide = runs.repeated(size, first, is_batched)
    found = runs.with_batch_axis(_primitive.bind(*wide, runs=more, places=places), size)
    return found, [0] * len(found)


_primitive = new_primitive(
    "iblf_jax_derivative_of_runs",
    _along,
    shapes=_abstract,
    jvp=_jvp,
    batch=_batch,
    transpose=_transpose,
    called=programs.jit(_along, static_argnames=("runs", "places")),
    several_results=True,
)
