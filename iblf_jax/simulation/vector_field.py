"""The closed loop as x' = field(t, x) over one flat vector x, for solvers of other libraries:
diffrax, SciPy, optimistix.

The loop's own state is a pytree, and contains an empty tuple for a law without memory, which some
solvers do not accept (diffrax: "Only arrays can be treated as buffers"). Here its numbers are
concatenated in the order of `iblf_jax.simulation.closed_loop.LoopState`:

    x = (state of the plant, of the law, of the observer, of the actuator),   (m,)

The state of a robot is q, then q'.

`VectorField.names` names the entries; `unpack` and `pack` convert between the two forms.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, programs
from iblf_jax.core.pytree import component
from iblf_jax.simulation.closed_loop import LoopState, evaluate, initial_state
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.simulation.signals import Sample


@component
class VectorField:
    """x' = field(t, x), the closed loop of a scenario over a flat state x, (m,); made by
    `vector_field`.

    It is a pytree whose leaves are the scenario's: pass it through `jit`, `vmap` and `grad` like
    one.

    Args:
      scenario: what runs, a `Scenario`; canonical, as `vector_field` makes it.
    """

    scenario: Scenario

    def check(self) -> None:
        """Raises ValueError for something that is not a scenario."""
        if not isinstance(self.scenario, Scenario):
            raise checks.fail(
                "VectorField.scenario",
                self.scenario,
                "a Scenario",
                "Make the field with ij.vector_field(scenario).",
            )

    def __call__(self, t: Any, x: Any, args: Any = None) -> jax.Array:
        """The rate of the state.

            x' = (q', q", rate of the law's state, rate of the observer's)
            (2.1), (3.14), (3.11)

        Args:
          t: time, () [s].
          x: state, (m,).
          args: not used; solvers that pass a third argument may (diffrax).

        Returns:
          (m,), in the units of x a second.

        Raises:
          ValueError: a t or x that is no array of real numbers, or of another shape.
        """
        return _rate(self.scenario, *_numbers(t, x))

    @property
    def start(self) -> jax.Array:
        """The state at t = 0, (m,): `scenario.initial`, and the states of law and observer that
        belong to it.
        """
        return _start(self.scenario)

    @property
    def names(self) -> tuple[str, ...]:
        """What each entry of x is, m names: "q[0]" [rad], "dq[0]" [rad/s], "controller..." and
        "observer..." in units of their own, and "x[2, 0]" for the levels from the third on of a
        plant in strict-feedback form.
        """
        found = []
        for path, leaf in jax.tree_util.tree_leaves_with_path(_layout(self.scenario)):
            name = jax.tree_util.keystr(path).lstrip(".")
            for index in np.ndindex(leaf.shape):
                if name == "x" and index[0] < 2:
                    found.append(f"{('q', 'dq')[index[0]]}[{index[1]}]")
                    continue
                entry = ", ".join(map(str, index))
                found.append(f"{name}[{entry}]" if index else name)
        return tuple(found)

    def pack(self, state: LoopState) -> jax.Array:
        """The flat vector of a state.

        Args:
          state: x, (r, n), and the states of law and observer, with the same leading axes each, or
            none.

        Returns:
          (..., m).

        Raises:
          ValueError: a state of another structure or shape.
        """
        return _pack(self.scenario, state)

    def unpack(self, x: Any) -> LoopState:
        """The states of plant, law and observer from flat vectors: of one instant, or of a
        trajectory.

        Args:
          x: (..., m); SciPy's `solution.y` has time last, so give `solution.y.T`.

        Returns:
          `iblf_jax.simulation.closed_loop.LoopState`: x (..., r, n), with q and dq of it, and the
          states of law and observer, leading axes first.

        Raises:
          ValueError: another last axis.
        """
        return _unpack(self.scenario, checks.as_floats("x", x))

    def sample(self, t: Any, x: Any) -> Sample:
        """All signals at one instant: tau, e1, xi, the bounds, f and f_hat, V ...; of a trajectory
        by `jax.vmap`.

        Args:
          t: time, () [s].
          x: state, (m,).

        Returns:
          `iblf_jax.simulation.signals.Sample`; its vectors are (n,).

        Raises:
          ValueError: as the field itself.
        """
        return _sample(self.scenario, *_numbers(t, x))


def vector_field(scenario: Scenario) -> VectorField:
    """The closed loop of a scenario for solvers of other libraries: a function of time and of one
    flat state.

        x' = field(t, x),   x(0) = field.start,   x = (state of the plant, of the law, of the
        observer)

    It takes (t, x) for SciPy and (t, x, args) for diffrax, works under `jit`, `vmap`, `grad` and
    `jacfwd`, and is differentiable by every leaf of the scenario: make it inside the function that
    you differentiate.  Nothing stops or freezes a run that leaves its bounds: metrics, status and
    warnings belong to `simulate`.  An adaptive solver has to know where the right-hand side jumps:
    `scenario.jump_times()`.

    Args:
      scenario: what runs, of n joints.

    Returns:
      A `VectorField`: called for the rate; `start`, `names`, `pack`, `unpack` and `sample` for the
        rest.

    Raises:
      ValueError: as `simulate`, for a scenario that cannot run, a law that is sampled, or an
        input with a delay; the message names the field, the value and the remedy.

    Source: design of this package; the closed loop is Zhang & Yan 2024, section 3.
    """
    field = VectorField(canonical(scenario))
    if field.scenario.sampling is not None:
        raise checks.fail(
            "scenario.sampling",
            "a sampled law",
            "a law that runs at every instant",
            "Its torque jumps: use ij.simulate.",
        )
    if field.scenario.actuator.input_delay is not None:
        raise checks.fail(
            "scenario.actuator",
            "a Delay",
            "a loop without a delay of its input",
            "Its rate depends on past states, and no function (t, x) gives it: use ij.simulate.",
        )
    return field


def _layout(scenario: Scenario) -> LoopState:
    """Shapes and types of the state, without computing it."""
    return jax.eval_shape(initial_state, scenario)


def _pack(scenario: Scenario, state: LoopState) -> jax.Array:
    leaves, structure = jax.tree.flatten(_layout(scenario))
    shapes = [x.shape for x in leaves]
    expected = (
        f"a LoopState whose arrays have the shapes {shapes}, behind leading axes that all share"
    )
    if jax.tree.structure(state) != structure:  # type: ignore[operator]
        raise checks.fail("state", state, expected)
    given = [checks.as_floats("state", x) for x in jax.tree.leaves(state)]
    lead = given[0].shape[: given[0].ndim - len(shapes[0])]
    if [x.shape for x in given] != [(*lead, *shape) for shape in shapes]:
        raise checks.fail("state", [x.shape for x in given], expected)
    return jnp.concatenate(
        [x.reshape(*lead, math.prod(shape)) for x, shape in zip(given, shapes, strict=True)],
        axis=-1,
    )


def _unpack(scenario: Scenario, x: jax.Array) -> LoopState:
    leaves, structure = jax.tree.flatten(_layout(scenario))
    ends = np.cumsum([math.prod(leaf.shape) for leaf in leaves])
    if x.ndim < 1 or x.shape[-1] != ends[-1]:
        remedy = (
            "VectorField.names says what its entries are; of a SciPy solution give solution.y.T."
        )
        raise checks.fail("x", x, f"shape (..., {ends[-1]})", f"Its shape is {x.shape}. {remedy}")
    parts = jnp.split(x, ends[:-1], axis=-1)
    return jax.tree.unflatten(
        structure,
        [
            part.reshape(*x.shape[:-1], *leaf.shape)
            for part, leaf in zip(parts, leaves, strict=True)
        ],
    )


def _numbers(t: Any, x: Any) -> tuple[jax.Array, jax.Array]:
    """Time and state as arrays, or a ValueError."""
    time = checks.as_floats("t", t)
    checks.shape_is("t", time, ())
    return time, checks.as_floats("x", x)


def _at(scenario: Scenario, t: jax.Array, x: jax.Array) -> tuple[jax.Array, LoopState]:
    """Time and state in the scenario's floating-point type."""
    dtype = scenario.initial.q.dtype
    return t.astype(dtype), _unpack(scenario, x.astype(dtype))


@programs.jit
def _start(scenario: Scenario) -> jax.Array:
    return _pack(scenario, initial_state(scenario))


@programs.jit
def _rate(scenario: Scenario, t: jax.Array, x: jax.Array) -> jax.Array:
    return _pack(scenario, evaluate(scenario, *_at(scenario, t, x))[0])


@programs.jit
def _sample(scenario: Scenario, t: jax.Array, x: jax.Array) -> Sample:
    return evaluate(scenario, *_at(scenario, t, x))[1]
