"""Derivatives of runs, in three ways: tangents in a kernel, reverse mode in kernels, and the scan.

**Tangents in a kernel.**  A step with tangents is a step as any other, and every executor makes it.
Each direction u of the parameters has a tangent x_u of the state; a few tangents cost less than
reverse mode and need no memory along time.  A kernel carries the tangents in one of two layouts:

- All tangents of a run in one kernel (`DerivativeStep`, this module).  The tangents share the
  evaluation of the law.  The directions are compiled in, only metrics are differentiated, and the
  kernel grows with the number of tangents.
- One tangent per run (`columns`).  The directions are inputs, so one kernel serves any number of
  them; records are differentiated as well, and a tangent of a tangent is a second derivative.
  `jax.grad`, `jacfwd`, `jacrev` and `hessian` of `simulate` use this layout (`transformable`).

**Reverse mode in kernels** (`adjoint`).  The adjoint of a step is a step, too, and goes backwards
over the stored states.  Its time hardly depends on how many numbers it is by: a gradient takes
four to six times as long as the run.  `tune` by many numbers uses it, and `jax.grad` of `simulate`
(`direction`).

**The scan.**  JAX differentiates `loops.scan` or `loops.checkpointed` in forward or reverse mode.
This is the way for derivatives of third order, for large networks, and where no kernel can be
built.

`choose_derivatives` chooses.  Each way is needed.  16 runs of 1000 steps by 9 gains of a chain of
three joints take 0.025 s with all tangents in one kernel (8.6 s with compilation) and 0.064 s with
one tangent per run (5.5 s).  By 16 gains of `presets.iiwa14` they take 0.53 s (63 s) and 0.35 s
(35 s).  64 runs of 500 steps of the paper's loop by 4 gains take 0.006 s, 0.042 s, and 0.40 s by
the scan in forward mode.  The threshold `MAX_COLUMNS` has the measurement against reverse mode.

A fold may offer `curvature(acc, sample)`, a tuple of `curvatures` many `Outer`: vectors y with
weights w.  Their Gauss-Newton matrices

    N_uv = sum_k w(t_k) y_u(t_k) . y_v(t_k),      y_u = tangent of y,

are summed along the run at little cost.  With w = 2 dt they are the second-order information of
every integral of squares.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from iblf_jax.core.attributes import attributes
from iblf_jax.engine import thresholds
from iblf_jax.engine.batch import Batch, Stepper, finalize, initialize
from iblf_jax.engine.carry import Carry, Inputs, Step, StepOptions
from iblf_jax.engine.metric_folds import finished, split_floats
from iblf_jax.engine.outcome import Outcome
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.time_step import StepOutput, advance
from iblf_jax.simulation import error_estimate
from iblf_jax.simulation.closed_loop import evaluate, initial_state
from iblf_jax.simulation.paths import get, with_parameters
from iblf_jax.simulation.signals import Sample

FLAG_FIELDS = ("guard_active", "saturated")
"""Fields of a sample that are no numbers."""


class DerivativeSizes(NamedTuple):
    """What decides how a derivative is computed."""

    count_kept_numbers: Callable[[], int]
    """Counts the numbers of the derivative that are kept along the run, with one tangent per run.
    It traces a step, and is called only where the count decides."""
    order: int = 1
    reverses: bool = False
    """Whether the caller and its executor have reverse mode (`adjoint`)."""
    columns: int = 1
    """Numbers of a transformed run by which it is differentiated, the most of any order."""
    nodes_together: float = math.inf
    """Nodes of the kernel that carries all tangents; infinite where records are differentiated."""
    max_nodes: float | None = 0
    """Nodes up to which the executor compiles such a kernel (`Limits.derivative_nodes`)."""
    nodes_per_operation: float = 0.0
    """Nodes of a step without tangents for each operation of the closed loop; large where arrays
    are, such as the weights of a network."""


def choose_derivatives(sizes: DerivativeSizes) -> str:
    """How a derivative is computed where a kernel can be built: "together" (all tangents of a run
    in one kernel), "one per run", "reverse" or "scan".
    """
    if sizes.nodes_per_operation > thresholds.MAX_NODES_PER_OPERATION:
        return "scan"
    if thresholds.is_within(sizes.nodes_together, sizes.max_nodes):
        return "together"
    if sizes.order > thresholds.MAX_COLUMN_ORDER:
        return "scan"
    has_few = sizes.columns <= thresholds.MAX_COLUMNS
    if has_few and sizes.count_kept_numbers() <= thresholds.MAX_KEPT_NUMBERS:
        return "one per run"
    if sizes.reverses:
        return "reverse"
    return "scan"


class Outer(NamedTuple):
    """What one sample adds to a curvature matrix: N <- N + sum_i weight_i y_iu y_iv, y_u the
    tangent of `vector`.
    """

    vector: jax.Array
    """y, (m,)."""
    weight: jax.Array
    """(m,) or ()."""


class Tangents(NamedTuple):
    """Values and tangents of a batch; B runs, D directions."""

    outcome: Outcome
    """Metrics and status, (B, ...)."""
    tangents: dict[str, jax.Array]
    """Of the real-valued metrics, (B, D, ...)."""
    products: tuple[jax.Array, ...]
    """Curvature matrix of each `Outer` of each fold, (B, D, D)."""


class Directions(NamedTuple):
    """Tangents of leaves by path; hashable, the numbers are part of what is compiled."""

    items: tuple[tuple[str, tuple[int, ...], tuple[float, ...]], ...]

    @staticmethod
    def of(directions: Mapping[str, Any]) -> Directions:
        """From path -> (P, *shape of the leaf)."""
        arrays = {path: np.asarray(x, float) for path, x in directions.items()}
        return Directions(
            tuple((path, x.shape, tuple(x.ravel().tolist())) for path, x in arrays.items())
        )

    @property
    def tangents(self) -> int:
        """P."""
        return self.items[0][1][0]

    def moved(self, scenario, eps: jax.Array):
        """The scenario, its leaves moved by eps (P,) along the directions."""
        values = {}
        for path, shape, numbers in self.items:
            change = np.asarray(numbers, eps.dtype).reshape(shape)
            values[path] = get(scenario, path) + jnp.tensordot(eps, change, 1)
        return with_parameters(scenario, values)


class Differentiated(NamedTuple):
    """What goes from step to step: the carry, P tangents of state and accumulators, the products of
    each `Outer`.
    """

    carry: Carry
    tangents: list[jax.Array]
    products: list[jax.Array]
    """Upper triangles, row by row, (P (P + 1) / 2,) each."""


def floats_of_carry(carry: Carry) -> tuple[list[jax.Array], Callable]:
    """The numbers of a carry that have tangents, and the function that returns the carry with other
    numbers in their place.
    """
    floats, replaced = split_floats((carry.state, carry.accumulators))

    def with_floats(floats: list[jax.Array]) -> Carry:
        state, accumulators = replaced(floats)
        return carry._replace(state=state, accumulators=accumulators)

    return floats, with_floats


def pushed(
    function: Callable, directions: Directions, scenario, before: Differentiated | None, dtype
):
    """function(scenario, carry, eps) and its derivative along every direction.

    Args:
      function: of a scenario, a carry and how far it is moved along the directions; gives a list of
        floats and anything else.
      directions: P of them.
      scenario: where.
      before: carry and tangents, or None where the function takes no carry.
      dtype: of the tangents.
    """
    floats: list[jax.Array] = []
    tangents_before: list[jax.Array] = []
    replaced: Callable = lambda _: None  # noqa: E731
    if before is not None:
        floats, replaced = floats_of_carry(before.carry)
        tangents_before = before.tangents

    def of(eps, floats):
        return function(directions.moved(scenario, eps), replaced(floats), eps)

    def along(unit, tangents):
        value, tangent, rest = jax.jvp(
            of, (jnp.zeros_like(unit), floats), (unit, tangents), has_aux=True
        )
        return value, tangent, rest

    units = np.eye(directions.tangents, dtype=dtype)
    return jax.vmap(along, out_axes=(None, 0, None))(units, tangents_before)


def without_flags(sample: Sample) -> Any:
    """The numbers of a sample; its flags have no derivative."""
    return {name: x for name, x in vars(sample).items() if name not in FLAG_FIELDS}


def preaccumulated(scenario, directions: Directions, eps: jax.Array) -> Callable:
    """`closed_loop.evaluate`, its Jacobian by directions and state (of a sampled loop command and
    time too) worked out once and applied to every tangent.

    One tangent through the law costs as much as the law; applying the Jacobian costs a tenth of it.
    Of a sampled loop a stage is the plant alone: value and derivatives by 12 gains of `presets.ur5`
      take 4.0 times as long as the value, and 7.4 times without this.
    """
    jumps = scenario.jump_times().size > 0

    def evaluated(moved, t, state, command=None):
        # A stage's time moves where a command arrives within a step, or a jump time does.
        commands = tuple(x for x in (command,) if x is not None)
        times = tuple(x for x in (t,) if command is not None or jumps)
        leaves, structure = jax.tree.flatten((state, commands, times))
        real = [jnp.issubdtype(x.dtype, jnp.floating) for x in leaves]
        here, unravel = ravel_pytree([x for x, yes in zip(leaves, real, strict=True) if yes])
        flags = [x for x, yes in zip(leaves, real, strict=True) if not yes]

        # All that it reads is handed in: within a branch of JAX's it may close over nothing that is
        # traced.
        def numbers(flat, eps, scenario, flags, t):
            parts, rest = iter(unravel(flat)), iter(flags)
            state, command, time = jax.tree.unflatten(
                structure, [next(parts if yes else rest) for yes in real]
            )
            (t,) = time or (t,)
            slope, sample = evaluate(directions.moved(scenario, eps), t, state, *command)
            return (slope, without_flags(sample)), attributes(sample, FLAG_FIELDS)

        @jax.custom_jvp
        def floats(flat, eps, *rest):
            return numbers(flat, eps, *rest)[0]

        @floats.defjvp
        def _(primals, tangents):
            flat, eps, *rest = primals
            units = np.eye(flat.size + eps.size, dtype=flat.dtype)
            value = lambda x: numbers(x[: flat.size], x[flat.size :], *rest)[0]  # noqa: E731
            here, along = jnp.concatenate([flat, eps]), jnp.concatenate(tangents[:2])
            columns = jax.vmap(lambda unit: jax.jvp(value, (here,), (unit,))[1])(units)
            # Number by number: what a stage does not read of the sample is not computed.
            return floats(*primals), jax.tree.map(
                lambda column: jnp.tensordot(along, column, 1), columns
            )

        at = here, eps, scenario, flags, t
        slope, values = floats(*at)
        return slope, Sample(**values, **numbers(*jax.lax.stop_gradient(at))[1])

    return evaluated


def count_curvatures(folds: Any) -> int:
    """How many curvature matrices the folds have."""
    return sum(fold.curvatures for fold in folds)


def outers_of(folds, accumulators, sample) -> tuple[Outer, ...]:
    """What a sample adds to the curvature matrices of the folds that have them."""
    found: tuple[Outer, ...] = ()
    for fold, acc in zip(folds, accumulators, strict=True):
        found += tuple(fold.curvature(acc, sample))
    return found


def outers_of_step(folds, found: StepOutput) -> list[Outer]:
    """What all samples of a step add to them."""
    samples = []
    for seen in found.metric_samples:
        outers = outers_of(folds, seen.before, seen.sample)
        if seen.counts is not True:
            outers = tuple(Outer(y, jnp.where(seen.counts, weight, 0.0)) for y, weight in outers)
        samples.append([Outer(y, jnp.broadcast_to(weight, y.shape)) for y, weight in outers])
    return [
        Outer(*map(jnp.concatenate, zip(*same, strict=True))) for same in zip(*samples, strict=True)
    ]


@dataclasses.dataclass(frozen=True)
class DerivativeStep(Step):
    """One step of a run and of its tangents."""

    method: str
    directions: Directions
    is_derivative: ClassVar[bool] = True

    def __call__(
        self, inputs: Inputs, carry: Differentiated, index: jax.Array, options: StepOptions
    ):
        """The carry after the step; nothing is recorded."""
        rows, columns = np.triu_indices(self.directions.tangents)

        def one(scenario, before, eps):
            # On arrays a Jacobian for a few tangents would cost more than the tangents.
            function: Callable = evaluate
            if options.scalar:
                function = preaccumulated(inputs.scenario, self.directions, eps)
            found = advance(
                inputs._replace(scenario=scenario), before, index, self.method, options, function
            )
            outers = outers_of_step(inputs.folds, found)
            vectors = [outer.vector for outer in outers]
            weights = [outer.weight for outer in outers]
            return (floats_of_carry(found.carry)[0], vectors), (found.carry, weights)

        _, (tangents, vectors), (after, weights) = pushed(
            one, self.directions, inputs.scenario, carry, inputs.dt.dtype
        )
        terms = zip(carry.products, vectors, weights, strict=True)
        products = [N + jnp.sum(weight * y[rows] * y[columns], axis=-1) for N, y, weight in terms]
        return Differentiated(after, tangents, products), ()


def run_with_tangents(
    run_steps: Stepper, batch: Batch, directions: Directions, request: RunRequest
) -> Tangents:
    """All runs with their tangents, from the start to the outcome; `request` records nothing."""
    rows, columns = np.triu_indices(directions.tangents)

    def at_start(inputs, carry):
        def state(scenario, _, eps):
            return floats_of_carry(carry._replace(state=initial_state(scenario)))[0], ()

        count = count_curvatures(inputs.folds)
        _, tangents, _ = pushed(state, directions, inputs.scenario, None, inputs.dt.dtype)
        return Differentiated(carry, tangents, [jnp.zeros((len(rows),), inputs.dt.dtype)] * count)

    def at_end(inputs, before):
        def metrics(scenario, carry, eps):
            found: dict[str, jax.Array] = dict.fromkeys(
                (name for name, _ in error_estimate.ACCURACY_UNITS), jnp.zeros_like(inputs.dt)
            )
            found[error_estimate.ERROR] = jnp.zeros_like(carry.accuracy.error)
            results = finished(inputs.folds, carry.accumulators).items()
            return (
                found | {name: x for name, x in results if jnp.issubdtype(x.dtype, jnp.floating)},
                (),
            )

        _, tangents, _ = pushed(metrics, directions, inputs.scenario, before, inputs.dt.dtype)
        full = jnp.zeros((directions.tangents,) * 2, inputs.dt.dtype)
        return tangents, tuple(
            full.at[rows, columns].set(x).at[columns, rows].set(x) for x in before.products
        )

    carry, instant = initialize(run_steps, batch, request.method)
    before = batch.map_runs(at_start, carry)
    after, _ = run_steps(
        DerivativeStep(request.method, directions), batch, before, request.instants, None
    )
    tangents, products = batch.map_runs(at_end, after)
    return Tangents(finalize(run_steps, batch, request, after.carry, instant), tangents, products)
