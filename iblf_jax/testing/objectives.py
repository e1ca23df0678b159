"""The checker for objectives.

The contract is `iblf_jax.tuning.quantities.Quantity`: terms and requirements consist of quantities.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.engine import Outer, folded
from iblf_jax.engine.simulate import simulate
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import Sample
from iblf_jax.testing._contract import (
    Findings,
    abstract_shape,
    check_function,
    examine,
    first_line,
    has_shape,
    in_both_types,
    in_dtype,
    shape_of,
)
from iblf_jax.testing.joints import check_scenario, joints_of, scenario_for
from iblf_jax.testing.metrics import LENGTH, accumulates, at_rest, parts, samples
from iblf_jax.tuning.objectives import Objective, Requirement, complete, for_scenario
from iblf_jax.tuning.quantities import (
    MetricResult,
    Peak,
    Quantities,
    Quantity,
    TimeIntegral,
    has_curvature,
    has_hessian,
)

DIRECTIONS = 3
"""Number of directions in which second derivatives are tested."""


def check_objective(
    objective: Objective | Requirement | Quantity,
    *,
    scenario: Scenario | None = None,
    duration: float = 2.0,
    n: int | None = None,
) -> None:
    """Checks an objective of tuning: accumulators, derivatives, float32, no NaN, and its scales on
    a short run.

        g = d(smooth value) / d(samples) by both modes and by finite differences,   N = N^T,
        the value at the start is finite and not 0

    Args:
      objective: an objective, a requirement, or a quantity of which these are composed.
      scenario: the scenario of the run; if not given the paper's simulation, or a similar one for
        the number of joints of the leaves.
      duration: duration of the run [s], the same as for `tune`.
      n: number of joints, if no scenario is given; that of its leaves if not given, 2 if these
        are scalars.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: not a Scenario, one with another number of joints than `n`, or a duration that is
        not positive.
    """
    check_scenario(scenario, n)
    duration = checks.positive_number("duration", duration, "s")
    if isinstance(objective, Requirement):
        objective = Objective((), (objective,))
    elif not isinstance(objective, Objective):
        limit: Any = 1.0
        with examine(objective, "Quantity", Quantity):
            objective = Objective((), (Requirement(objective, limit, limit),))
    with examine(objective, "Objective", Objective) as findings:
        scenario = scenario_for(findings, objective, scenario, n)
    with examine(objective, "Objective", Objective) as findings:
        try:
            objective = for_scenario(objective, scenario)
        except ValueError as error:  # It selects joints that the scenario does not have.
            findings.add(str(error))
    for quantity in objective.quantities:
        selects = isinstance(quantity, TimeIntegral | Peak | MetricResult)
        joints = scenario.n if selects else joints_of(quantity)
        with examine(quantity, "Quantity", Quantity) as findings:
            _quantity(findings, in_dtype(quantity, "float64"), duration, joints)
    with examine(objective, "Objective", Objective) as findings:
        findings.require(
            objective.quantities,
            "it has neither terms nor requirements",
            "Pass for example ij.objectives.tracking()",
        )
        findings.stop_if_any()
        _on_a_run(findings, in_dtype(objective, "float64"), scenario, duration)


def _quantity(findings: Findings, quantity: Quantity, duration: float, n: int) -> None:
    step = duration / LENGTH
    some = samples(np.random.default_rng(4), n, step)
    # Half a step later, so that no sample is at the time from which a quantity counts.
    some = dataclasses.replace(some, t=some.t + 0.5 * step)
    in_both_types(findings, _structure, quantity, jax.tree.map(lambda x: x[0], some))
    numbers, flags = parts(some)
    # Nothing is differentiated with respect to the grid of the samples.
    flags |= {name: numbers.pop(name) for name in ("t", "dt")}
    fold = Quantities((quantity,))

    def outputs(fold, numbers):
        run = Sample(**numbers, **in_dtype(flags, numbers["x"].dtype))
        return {"the smooth value": folded((fold,), run)["tuning_smooth"]}

    exact = jax.jit(folded)((fold,), some)["tuning_exact"]
    findings.require(
        np.all(np.isfinite(exact)),
        f"the exact value is not finite on an ordinary run: {np.asarray(exact)}",
    )
    check_function(findings, outputs, fold, (numbers,))
    at_rest(findings, fold, some)
    largest = np.max(jax.jit(folded)((fold,), some)["tuning_pieces"])
    findings.require(
        np.allclose(largest, exact),
        f"the largest of its pieces, {largest}, is not its exact value, {np.asarray(exact)}",
    )
    if has_hessian(quantity):
        _second_order(findings, quantity, numbers, flags)


def _structure(findings: Findings, quantity: Quantity, first: Any) -> None:
    acc = accumulates(findings, quantity, first)
    result = shape_of(findings, "finish(acc)", quantity.finish, acc)
    three = isinstance(result, tuple) and len(result) == 3
    remedy = "It must be (smooth value, exact value, pieces)"
    findings.result_is(three, "finish(acc)", result, remedy)
    for name, value in zip(("smooth value", "exact value"), result[:2], strict=True):
        has_shape(findings, f"the {name} of finish(acc)", value, ())
    shape = abstract_shape(result[2])
    findings.require(
        len(shape) == 1,
        f"the pieces of finish(acc) have shape {shape}",
        "They must be (m,): value[None] if it is one",
    )
    if not has_curvature(quantity):
        return
    findings.require(
        has_hessian(quantity),
        "it has `curvature` without `hessian`",
        "Second-order methods need both",
    )
    label = "curvature(acc, sample)"
    outer = shape_of(findings, label, quantity.curvature, acc, first)
    remedy = "It must be an iblf_jax.engine.derivatives.Outer"
    findings.result_is(isinstance(outer, Outer), label, outer, remedy)
    size, weight = abstract_shape(outer.vector), abstract_shape(outer.weight)
    findings.require(len(size) == 1, f"Outer.vector has shape {size}", "It must be (m,)")
    findings.require(
        weight in ((), size), f"Outer.weight has shape {weight}", f"It must be () or {size}"
    )


def _second_order(
    findings: Findings,
    quantity: Quantity,
    numbers: dict[str, jax.Array],
    flags: dict[str, jax.Array],
) -> None:
    """Requires a square, symmetric and finite Gauss-Newton matrix along some directions of the
    samples.
    """
    rng = np.random.default_rng(6)
    samples = [
        jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), numbers)
        for _ in range(DIRECTIONS)
    ]
    directions = jax.tree.map(lambda *x: jnp.stack(x), *samples)
    matrix = jax.jit(lambda quantity, *args: _gauss_newton(quantity, flags, *args))
    try:
        found = np.asarray(matrix(quantity, numbers, directions))
    except Exception as error:
        findings.add(f"hessian(products, pieces, slopes) raised {first_line(error)}")
        return
    if not findings.require(
        found.shape == (DIRECTIONS, DIRECTIONS),
        f"hessian gives shape {found.shape}",
        "It must be (D, D) for products (D, D)",
    ):
        return
    finite = findings.require(
        np.all(np.isfinite(found)), "the matrix of hessian is not finite on an ordinary run"
    )
    off = float(np.max(np.abs(found - found.T)))
    symmetric = not finite or off <= 1e-9 * max(1.0, float(np.max(np.abs(found))))
    findings.require(
        symmetric,
        f"the matrix of hessian is not symmetric (by {off:.2g})",
        "It is a matrix of second derivatives",
    )


def _gauss_newton(
    quantity: Any,
    flags: dict[str, jax.Array],
    numbers: dict[str, jax.Array],
    directions: dict[str, jax.Array],
) -> jax.Array:
    """The Gauss-Newton matrix of a quantity along directions of the samples, (D, D)."""

    def accumulate(acc, sample):
        outer = Outer(jnp.zeros_like(sample.e1), jnp.zeros_like(sample.e1))
        if has_curvature(quantity):
            outer = quantity.curvature(acc, sample)
        weight = jnp.broadcast_to(outer.weight, outer.vector.shape)
        return quantity.update(acc, sample), (outer.vector, weight)

    def run(numbers):
        samples = Sample(**numbers, **flags)
        start = quantity.init(jax.tree.map(lambda x: x[0], samples))
        acc, (vectors, weights) = jax.lax.scan(accumulate, start, samples)
        pieces = quantity.finish(acc)[2]
        return (pieces, vectors), (weights, pieces)

    def along(direction):
        _, pushed, rest = jax.jvp(run, (numbers,), (direction,), has_aux=True)
        return pushed, rest

    (slopes, vectors), (weights, pieces) = jax.vmap(along, out_axes=(0, None))(directions)
    products = jnp.einsum("utm,vtm,tm->uv", vectors, vectors, weights)
    return quantity.hessian(products, pieces, slopes)


def _on_a_run(
    findings: Findings, objective: Objective, scenario: Scenario, duration: float
) -> None:
    """Requires that a run gives finite numbers and the scale of every term."""
    try:
        with notices.muted():
            metrics = simulate(
                scenario,
                duration=duration,
                dt=1e-3,
                record_every=1000,
                metrics=(Quantities(objective.quantities),),
            ).metrics
    except (TypeError, ValueError) as error:
        findings.add(f"it cannot be computed from a run ({first_line(error)})")
        return
    for name, value in (("smooth", metrics["tuning_smooth"]), ("exact", metrics["tuning_exact"])):
        findings.require(
            np.all(np.isfinite(value)),
            f"its {name} values on a run are {np.asarray(value)}",
            "They must be finite",
        )
    findings.stop_if_any()
    try:
        goal = complete(objective, np.asarray(metrics["tuning_exact"])[: len(objective.terms)])
    except ValueError as error:
        findings.add(
            str(error).rstrip("."),
            "Or pass the scenario and the duration of `tune` to check_objective",
        )
        return
    smooth = jnp.asarray(metrics["tuning_smooth"])
    numbers = list(goal.excesses(smooth))
    if goal.terms:
        numbers = [*goal.values(smooth), *numbers]
    findings.require(
        np.all(np.isfinite(numbers)),
        f"its terms and requirements on a run are {[float(x) for x in numbers]}",
    )
