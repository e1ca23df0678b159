"""One run that a user differentiates, batches, or compiles as a part of a larger program.

The run itself is plain JAX (`scan`).  A kernel computes its first derivatives where one can be
built,

    out' = J leaves',       J = d (records, metrics) / d leaves,

where each column of J is a run with one tangent (`columns`).  JAX transposes the product, so both
forward and reverse mode use J, and the derivative of J is computed in the same way.  For many
numbers, and for more records than are kept, J is not computed: J leaves' is a primitive whose
transpose is computed by kernels that go backwards in time (`direction`).  The scan computes all
other derivatives: those of third order, by the time step and by parameters of a metric
(`derivatives.choose_derivatives`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero

from iblf_jax.core import checks, programs
from iblf_jax.core.caches import CACHE
from iblf_jax.engine import registry
from iblf_jax.engine.batch import Batch, run_all
from iblf_jax.engine.columns import ACCURACY, Places, columns, floats_of, numbers_of
from iblf_jax.engine.compile import (
    first_that_works,
    inputs_of,
    run_by_executor,
    scan_of,
)
from iblf_jax.engine.derivatives import DerivativeSizes, choose_derivatives
from iblf_jax.engine.direction import TracedRuns, derivative
from iblf_jax.engine.loops import kernel_stepper
from iblf_jax.engine.outcome import Outcome
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.single_run import run_one
from iblf_jax.engine.structural_constants import constants_of
from iblf_jax.engine.time_step import recorded
from iblf_jax.simulation.scenario import Scenario

if TYPE_CHECKING:
    from iblf_jax.simulation.metrics import Fold


def run_transformable(
    scenario: Scenario,
    folds: tuple[Fold, ...],
    dt: jax.Array,
    request: RunRequest,
    noise_key: jax.Array | None = None,
) -> Outcome:
    """One run that may be batched and differentiated from outside.

    Args:
      scenario, folds, dt, noise_key: as `single_run.run_one`.
      request: its backend is that of the derivatives: "vmap" for plain JAX, else kernels where they
        can be built.
    """
    leaves, treedef = jax.tree.flatten(inputs_of(scenario, folds, dt, request, noise_key))
    backend, reason = registry.default_backend()
    compiles = request.backend != "vmap" and reason is None
    request = request._replace(constants=constants_of(scenario), backend="auto")
    runs = TracedRuns(treedef, request, backend, (False,) * len(leaves))
    if compiles:
        return _differentiable(runs)(*leaves)
    return _run_by_scan(runs, *leaves)


@programs.jit(static_argnums=0)
def _run_by_scan(runs: TracedRuns, *leaves: jax.Array) -> Outcome:
    """The run by the scan."""
    inputs = jax.tree.unflatten(runs.treedef, leaves)
    run_steps = scan_of(inputs)
    return run_all(run_steps, Batch.of(inputs, None), runs.request)


@CACHE.memoised(64)
def _differentiable(runs: TracedRuns, beside_derivative: bool = False) -> Callable:
    """The run, with derivatives by the kernel.

    Args:
      runs: what is run.
      beside_derivative: whether the value is computed beside a derivative, and so by the kernel,
        too.
    """
    value: Callable = _run_by_scan
    if beside_derivative:
        value = _run_by_kernel
    run: Any = jax.custom_jvp(partial(value, runs))

    def rule(leaves, tangents):
        places, nonzero = _nonzero_tangents(tangents)

        def by_scan(_=None):
            moved = partial(_replaced, leaves, places)
            return jax.jvp(
                lambda *values: _run_by_scan(runs, *moved(values)),
                [leaves[i] for i in places],
                nonzero,
            )

        if not _is_by_scenario(runs, (places,)):
            return by_scan()
        method = choose_derivatives(_derivative_sizes(runs, (places,), leaves))
        by_kernel = None
        if method == "one per run":
            by_kernel = _by_kernel(runs, (places,), leaves)
        if by_kernel is None and method != "reverse":
            return by_scan()

        def attempt(_):
            found = _differentiable(runs, True)(*leaves)
            if method == "reverse":
                return found, _in_form_of(found, *derivative(runs, places, leaves, nonzero))
            return found, _in_form_of(found, *_times(by_kernel, nonzero, 0))

        return first_that_works(runs.plan, attempt, by_scan)

    run.defjvp(rule, symbolic_zeros=True)
    return run


def _nonzero_tangents(tangents: tuple) -> tuple[tuple[int, ...], list[jax.Array]]:
    """Which leaves move, and how."""
    places = tuple(i for i, x in enumerate(tangents) if not isinstance(x, SymbolicZero))
    return places, [tangents[i] for i in places]


def _times(J: Any, nonzero: list[jax.Array], axis: int) -> Any:
    """A derivative times how far the leaves move."""
    direction = jnp.concatenate([jnp.ravel(x) for x in nonzero])
    return jax.tree.map(lambda x: jnp.tensordot(x, direction, ((axis,), (0,))), J)


def _replaced(leaves: tuple, places: tuple[int, ...], moved: Sequence[jax.Array]) -> tuple:
    """The leaves, some of them replaced."""
    new = dict(zip(places, moved, strict=True))
    return tuple(new.get(i, x) for i, x in enumerate(leaves))


def _run_by_kernel(runs: TracedRuns, *leaves: jax.Array) -> Outcome:
    """The run by the kernel."""
    if checks.is_concrete(leaves):
        inputs = jax.tree.unflatten(runs.treedef, leaves)
        request = runs.request._replace(constants=constants_of(inputs.scenario))
        return run_one(inputs.scenario, inputs.folds, inputs.dt, request, inputs.noise_key)
    return jax.tree.map(lambda x: x[0], _over_runs(_values, runs)(*leaves))


def _is_by_scenario(runs: TracedRuns, places: Places) -> bool:
    """Whether all leaves at these places belong to the scenario."""
    scenario = jax.tree.unflatten(runs.treedef, runs.is_per_run).scenario
    number_of_leaves = len(jax.tree.leaves(scenario))
    return all(i < number_of_leaves for of_order in places for i in of_order)


def _by_kernel(runs: TracedRuns, places: Places, leaves: tuple) -> Any:
    """A derivative of records and metrics by the kernel, differentiable; None where there is
    none.
    """
    is_by_scenario = _is_by_scenario(runs, places)
    if (
        not is_by_scenario
        or choose_derivatives(_derivative_sizes(runs, places, leaves)) != "one per run"
    ):
        return None
    kernel = jax.custom_jvp(
        lambda *leaves: jax.tree.map(lambda x: x[0], _over_runs(_columns, runs, places)(*leaves))
    )

    def rule(leaves, tangents):
        more, nonzero = _nonzero_tangents(tangents)
        second = _by_kernel(runs, (*places, more), leaves)
        if second is not None:
            return kernel(*leaves), _times(second, nonzero, len(places))
        return jax.jvp(
            lambda *moved: _by_scan(runs, places, _replaced(leaves, more, moved)),
            [leaves[i] for i in more],
            nonzero,
        )

    kernel.defjvp(rule, symbolic_zeros=True)
    return first_that_works(runs.plan, lambda _: kernel(*leaves), lambda: None)


def _by_scan(runs: TracedRuns, places: Places, leaves: tuple) -> Any:
    """As `_by_kernel`, by the scan."""
    if not places:
        found = _run_by_scan(runs, *leaves)
        folded = {name: x for name, x in found.metrics.items() if name not in ACCURACY}
        return floats_of(found.records), {
            name: x for name, x in folded.items() if jnp.issubdtype(x.dtype, jnp.floating)
        }
    of_order = places[-1]
    shapes = [jnp.shape(leaves[i]) for i in of_order]
    ends = np.cumsum([math.prod(shape) for shape in shapes])

    def along(unit):
        parts = jnp.split(unit, ends[:-1])
        directions = [x.reshape(shape) for x, shape in zip(parts, shapes, strict=True)]
        return jax.jvp(
            lambda *moved: _by_scan(runs, places[:-1], _replaced(leaves, of_order, moved)),
            [leaves[i] for i in of_order],
            directions,
        )[1]

    units = jnp.eye(ends[-1], dtype=leaves[of_order[0]].dtype)
    return jax.vmap(along, out_axes=len(places) - 1)(units)


def _derivative_sizes(runs: TracedRuns, places: Places, leaves: tuple) -> DerivativeSizes:
    """The sizes that decide how a derivative of one run's records and metrics is computed."""
    every = runs.request.record_every
    columns = [sum(jnp.size(leaves[i]) for i in of_order) for of_order in places]

    def count_kept_numbers() -> int:
        if every is None:
            return 0
        samples = runs.request.steps // every + 1
        inputs = jax.tree.unflatten(runs.treedef, leaves)
        return numbers_of(inputs, recorded) * samples * math.prod(columns)

    reverses = len(places) == 1 and registry.EXECUTORS[runs.backend].accepts_series
    return DerivativeSizes(
        count_kept_numbers, order=len(places), reverses=reverses, columns=max(columns)
    )


def _over_runs(function: Callable, runs: TracedRuns, *static: Any) -> Callable:
    """function(runs, *static, leaves) for many runs at once where JAX batches it: more runs of one
    call.
    """
    batched = custom_vmap(lambda *leaves: function(runs, *static, leaves))

    @batched.def_vmap
    def rule(size, is_batched, *leaves):
        more, wide = runs.repeated(size, leaves, is_batched)
        found = _over_runs(function, more, *static)(*wide)
        found = jax.tree.map(lambda x: x.reshape(size, runs.runs, *x.shape[1:]), found)
        return found, jax.tree.map(lambda _: True, found)

    return batched


@programs.jit(static_argnums=0)
def _values(runs: TracedRuns, leaves: tuple) -> Outcome:
    def run(run_steps, batch):
        return run_all(run_steps, batch, runs.request)

    executor = registry.EXECUTORS[runs.backend]
    return run_by_executor(executor, runs.batch(leaves), runs.request, run)


@programs.jit(static_argnums=(0, 1))
def _columns(runs: TracedRuns, places: Places, leaves: tuple) -> Any:
    run_steps = kernel_stepper(registry.EXECUTORS[runs.backend])
    return columns(run_steps, runs.batch(leaves), places, runs.request)


def _in_form_of(found: Outcome, records: list[jax.Array], metrics: dict[str, jax.Array]) -> Outcome:
    """Tangents in the form of an outcome."""
    each = iter(records)

    def of_record(x: jax.Array) -> Any:
        if jnp.issubdtype(x.dtype, jnp.floating):
            return next(each)
        return _no_tangent(x)

    no_tangents = {name: _no_tangent(x) for name, x in found.metrics.items()}
    return Outcome(
        jax.tree.map(of_record, found.records),
        no_tangents | metrics,
        _no_tangent(found.status),
        _no_tangent(found.fastest_mode),
    )


def _no_tangent(x: jax.Array) -> Any:
    """The tangent of what does not depend on any leaf, or cannot."""
    if jnp.issubdtype(x.dtype, jnp.floating):
        return jnp.zeros_like(x)
    return np.zeros(jnp.shape(x), jax.dtypes.float0)
