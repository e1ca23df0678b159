"""Several plants on a graph: leader and followers in the coordinates of their consensus errors.

Agent i measures its position relative to its neighbours and, where b_i > 0, to the leader x_0:

    e_i = sum_j a_ij (p_i - p_j) + b_i (p_i - x_0),   e = (H kron I)(p - 1 x_0),   H = L + diag(b),

with the Laplacian L = diag(sum_j a_ij) - A of the graph.  H is nonsingular exactly where the leader
reaches every agent.  The stack of the agents has the levels

    y = (H kron I) p,   v,   z, ...

of relative positions and of the agents' own levels from the second on.  It is again a plant in
strict-feedback form, with G_1 = (H kron I) diag(G_1 of each agent).  The reference of y is
(H kron I) 1 x_0 = b kron x_0, because L 1 = 0.

`Agents` is the stack.  `NeighbourModel` is the model of a distributed law, in which each agent uses
numbers of its neighbours only.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.core import checks, sparse
from iblf_jax.core.pytree import component, static
from iblf_jax.core.time import joined, jump_times_of
from iblf_jax.world.plants._base import (
    Plant,
    Units,
    check_dimensions,
    component_names,
    input_name,
    is_chain,
    level_input,
    level_names,
    level_rate,
    robot_of,
    transposed_gain,
    units_of,
)
from iblf_jax.world.plants.rigid import Rigid
from iblf_jax.world.references import Leader, Reference
from iblf_jax.world.robots import friction_torque


@component
class Agents(Plant):
    """y' = (H kron I) p',   the agents' own levels above,   y = (H kron I) p,   H = L + diag(b).

    A law for plants in strict-feedback form then bounds the consensus errors e = y - b kron x_0:
    `reference` gives the reference of y, and `positions` the agents' positions p.

    Args:
      agents: N plants, or robots, of equal order, with the same number of components and the same
        unit of the first level.
      adjacency: a_ij, the weight with which agent i measures its position relative to agent j, N
        rows of N numbers, >= 0, with a zero diagonal.
      leader: b_i, the weight with which agent i measures its position relative to the leader, N
        numbers, >= 0.

    The zeros of the graph cost nothing: the positions p follow from a sparse factorisation of H.

    Source: F. L. Lewis, H. Zhang, K. Hengster-Movric, A. Das, Cooperative Control of Multi-Agent
      Systems, 2014, chapters 2 and 3.
    """

    agents: tuple[Plant, ...]
    adjacency: tuple[tuple[float, ...], ...] = static()
    leader: tuple[float, ...] = static()

    def check(self) -> None:
        """Replaces robots by `Rigid` plants; raises ValueError for agents that do not fit together
        or to which no path leads from the leader.
        """
        if not isinstance(self.agents, tuple | list) or not self.agents:
            raise checks.fail("Agents.agents", self.agents, "a tuple of plants or robots")
        agents: list[Any] = list(self.agents)
        for i, part in enumerate(agents):
            name = f"Agents.agents[{i}]"
            if is_chain(part):
                checks.conforms(name, part, Plant, "iblf_jax.plants has them.")
                continue
            try:
                agents[i] = Rigid(part)
            except ValueError as error:
                raise checks.fail(name, part, "a plant or a robot") from error
        object.__setattr__(self, "agents", tuple(agents))
        count = len(agents)
        adjacency = _weights("Agents.adjacency", self.adjacency, (count, count))
        leader = _weights("Agents.leader", self.leader, (count,))
        object.__setattr__(self, "adjacency", tuple(tuple(row) for row in adjacency.tolist()))
        object.__setattr__(self, "leader", tuple(leader.tolist()))
        if np.any(np.diag(adjacency) != 0.0):
            remedy = "An agent has no position relative to itself."
            raise checks.fail("Agents.adjacency", self.adjacency, "a zero diagonal", remedy)
        _check_reached(adjacency, leader)
        first = agents[0]
        for i, agent in enumerate(agents):
            for name, got, expected in (
                ("order", agent.order, first.order),
                ("n", agent.n, first.n),
                ("units[0]", units_of(agent)[0], units_of(first)[0]),
            ):
                if got != expected:
                    expected = f"{expected!r}, as agents[0] has"
                    raise checks.fail(f"Agents.agents[{i}].{name}", got, expected)
        check_dimensions("Agents", self)

    # --- the graph --------------------------------------------------------------------------------

    @property
    def matrix(self) -> tuple[tuple[float, ...], ...]:
        """H = L + diag(b), N rows of N numbers."""
        adjacency = np.asarray(self.adjacency)
        H = np.diag(adjacency.sum(axis=1) + np.asarray(self.leader)) - adjacency
        return tuple(tuple(row) for row in H.tolist())

    def relative_positions(self, positions: ArrayLike) -> jax.Array:
        """The relative positions y = (H kron I) p, (..., N m), of the agents at p, (..., N, m)."""
        p = jnp.asarray(positions)
        rows = sparse.times(self.matrix, [p[..., i, :] for i in range(len(self.agents))])
        return jnp.concatenate(rows, axis=-1)

    def positions(self, relative: ArrayLike) -> jax.Array:
        """The positions p = (H kron I)^-1 y, (..., N, m), of the first level y, (..., N m), such as
        `run.q`.
        """
        return jnp.stack(self._positions(jnp.asarray(relative)), axis=-2)

    def reference(self, leader: Reference, offsets: ArrayLike = 0.0) -> Leader:
        """The reference of y with which each agent follows the leader, p_i -> x_0 + offset_i.

        Args:
          leader: x_0(t), a reference of m components.
          offsets: of each agent from the leader in a formation, (N, m); 0 if not given.
        """
        shape = len(self.agents), self.agents[0].n
        offset = self.relative_positions(jnp.broadcast_to(jnp.asarray(offsets, float), shape))
        return Leader(motion=leader, weights=self.leader, components=shape[1], offset=offset)

    def neighbours(self) -> NeighbourModel:
        """The model of a distributed law, which uses numbers of each agent's neighbours only."""
        return NeighbourModel(self)

    def _positions(self, y: jax.Array) -> list[jax.Array]:
        """The position of each agent, (..., m)."""
        return sparse.solve(self.matrix, self._parts(y))

    def _parts(self, v: Any) -> list[Any]:
        """The components of each agent in a vector of the stack; a scalar applies to all agents."""
        if jnp.ndim(v) == 0:
            return [v] * len(self.agents)
        m = self.agents[0].n
        return [v[..., i * m : (i + 1) * m] for i in range(len(self.agents))]

    def _states(self, x: jax.Array) -> list[jax.Array]:
        """The state of each agent, (order, m), in its own coordinates."""
        rows = [self._positions(x[0]), *[self._parts(level) for level in x[1:]]]
        return [jnp.stack(levels) for levels in zip(*rows, strict=True)]

    # --- the plant --------------------------------------------------------------------------------

    @property
    def n(self) -> int:
        """Numbers per level, those of all agents."""
        return sum(agent.n for agent in self.agents)

    @property
    def order(self) -> int:
        """Number of levels of each agent."""
        return self.agents[0].order

    @property
    def own_joints(self) -> Mapping[str, int]:
        """The number of components for which the leaves of the agents are given."""
        return {"agents": self.agents[0].n}

    @property
    def units(self) -> tuple[Units, ...]:
        """The units of the levels and of the input."""
        found: list[Units] = []
        for of_level in zip(*map(units_of, self.agents), strict=True):
            of_components: list[str] = []
            for agent, unit in zip(self.agents, of_level, strict=True):
                of_components += [unit] * agent.n if isinstance(unit, str) else unit
            is_same = len(set(of_components)) == 1
            found.append(of_components[0] if is_same else tuple(of_components))
        return tuple(found)

    @property
    def level_names(self) -> tuple[str, ...]:
        """Names of the levels, those of the first agent above the first."""
        return ("relative position", *level_names(self.agents[0])[1:])

    @property
    def input_name(self) -> str:
        """The name of the first agent's input."""
        return input_name(self.agents[0])

    @property
    def component_names(self) -> tuple[str, ...]:
        """The agents' names of their components, such as "agent 1: joint 1"."""
        return tuple(
            f"agent {i + 1}: {name}"
            for i, agent in enumerate(self.agents)
            for name in component_names(agent)
        )

    def drift(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """f, (order, n)."""
        states = self._states(x)
        rows = [agent.drift(t, z) for agent, z in zip(self.agents, states, strict=True)]
        first = sparse.times(self.matrix, [row[0] for row in rows])
        others = jnp.concatenate([row[1:] for row in rows], axis=1)
        return jnp.stack([jnp.concatenate(first), *others])

    def gain(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """G, (order, n, n): (H kron I) diag(G_1 of the agents), and block-diagonal ones above."""
        states = self._states(x)
        gains = []
        for agent, z in zip(self.agents, states, strict=True):
            gain = agent.gain(t, z)
            if gain.ndim == 2:
                gain = gain[:, :, None] * jnp.eye(gain.shape[1], dtype=gain.dtype)
            gains.append(gain)
        first = []
        for row in self.matrix:
            blocks = [h * gain[0] for h, gain in zip(row, gains, strict=True)]
            first.append(jnp.concatenate(blocks, axis=1))
        levels = [jnp.concatenate(first)]
        for i in range(1, self.order):
            levels.append(jax.scipy.linalg.block_diag(*[gain[i] for gain in gains]))
        return jnp.stack(levels)

    def level_rate(
        self, level: int, t: jax.Array, x: jax.Array, above: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """x_i', (n,)."""
        parts = self._each(level_rate, level, t, x, above, torque)
        if level == 1:
            parts = sparse.times(self.matrix, parts)
        return jnp.concatenate(parts)

    def level_input(
        self, level: int, t: jax.Array, x: jax.Array, rate: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """x_{i+1}, or u for the last level, (n,), for which x_i' is `rate`."""
        if level == 1:
            rate = jnp.concatenate(sparse.solve(self.matrix, self._parts(rate)))
        return jnp.concatenate(self._each(level_input, level, t, x, rate, torque))

    def transposed_gain(self, level: int, t: jax.Array, x: jax.Array, s: jax.Array) -> jax.Array:
        """G_i^T s, (n,)."""
        if level == 1:
            transposed = tuple(zip(*self.matrix, strict=True))
            s = jnp.concatenate(sparse.times(transposed, self._parts(s)))
        return jnp.concatenate(self._each(transposed_gain, level, t, x, s))

    def _each(
        self,
        function: Callable,
        level: int,
        t: jax.Array,
        x: jax.Array,
        *vectors: Any,
    ):
        """A function of a plant and a level for each agent, in its own coordinates."""
        split = zip(*map(self._parts, vectors), strict=True)
        return [
            function(agent, level, t, z, *own)
            for agent, z, own in zip(self.agents, self._states(x), split, strict=True)
        ]

    def friction_torque(self, x: jax.Array) -> jax.Array:
        """The friction of the joints of the agents' robots, (n,) [N m]; 0 for other agents."""
        parts = []
        for agent, dq in zip(self.agents, self._parts(x[1]), strict=True):
            robot = robot_of(agent)
            parts.append(jnp.zeros_like(dq) if robot is None else friction_torque(robot, dq))
        return jnp.concatenate(parts)

    def steady_levels(self, q: jax.Array, dq: jax.Array) -> jax.Array | None:
        """The agents' levels from the third on for given y and v; None where one has no method."""
        states = zip(self.agents, self._positions(q), self._parts(dq), strict=True)
        return _joined([agent.steady_levels(p, v) for agent, p, v in states], axis=1)

    def steady_input(self, q: jax.Array) -> jax.Array | None:
        """The input that holds the agents at y; None where one has no method."""
        states = zip(self.agents, self._positions(q), strict=True)
        return _joined([agent.steady_input(p) for agent, p in states], axis=0)

    def weights(self, x: jax.Array) -> jax.Array:
        """The scales of the agents' energies, (order, n), that of y divided by H_ii^2: with p_i
        alone, y_i is H_ii p_i.  An agent without the method has 1.
        """
        columns = []
        for i, (agent, z) in enumerate(zip(self.agents, self._states(x), strict=True)):
            scale = agent.weights(z)
            if scale is None:
                scale = jnp.ones_like(z)
            columns.append(jnp.concatenate([scale[:1] / self.matrix[i][i] ** 2, scale[1:]]))
        return jnp.concatenate(columns, axis=1)

    def at(self, t: jax.Array) -> Agents:
        """The agents at time t [s]."""
        return dataclasses.replace(self, agents=tuple(agent.at(t) for agent in self.agents))

    def jump_times(self) -> jax.Array:
        """The times at which an agent jumps, (m,) [s]."""
        times = [jump_times_of(f"agents[{i}]", agent) for i, agent in enumerate(self.agents)]
        return joined(times)


@component
class NeighbourModel(Plant):
    """y_i' = (d_i + b_i) p_i' - sum_j a_ij p_j',   with the neighbours' p_j' as measured signals.

    The model of a distributed law: its motion is that of `Agents`, but only agent i's own velocity
    counts as the virtual input of y_i,

        G_1 = diag(d_i + b_i) diag(G_1 of each agent),   f_1 = the part of the neighbours,

    d_i = sum_j a_ij, so that agent i uses what it and its neighbours measure.  f_1 depends on the
    second level.  Its derivative would contain the neighbours' inputs, which in turn contain that
    of agent i; the law therefore needs filters, `BarrierBackstepping(filter=...)`.  The filters'
    errors z_i obey (z/mu)' = -(1/mu) (D + diag(b))^-1 H (z/mu) + bounded terms.  The matrix is a
    nonsingular M-matrix, so that they decay for all mu_i > 0, and the errors are ultimately bounded
    by a multiple of mu.

    Args:
      stack: the agents with their graph.

    Source: D. Swaroop, J. K. Hedrick, P. P. Yip, J. C. Gerdes, IEEE Trans. Automatic Control 45
      (2000) 1893-1899 (filters); the distributed form follows from (S.2).
    """

    stack: Agents
    needs_filters: ClassVar[bool] = True

    def check(self) -> None:
        """Raises ValueError for a stack that is not an `Agents`."""
        if not isinstance(self.stack, Agents):
            raise checks.fail("NeighbourModel.stack", self.stack, "an Agents")

    @property
    def n(self) -> int:
        """Numbers per level, those of all agents."""
        return self.stack.n

    @property
    def order(self) -> int:
        """Number of levels of each agent."""
        return self.stack.order

    @property
    def units(self) -> tuple[Units, ...]:
        """The units of the levels and of the input."""
        return self.stack.units

    @property
    def level_names(self) -> tuple[str, ...]:
        """As `Agents`."""
        return self.stack.level_names

    @property
    def input_name(self) -> str:
        """As `Agents`."""
        return self.stack.input_name

    @property
    def component_names(self) -> tuple[str, ...]:
        """As `Agents`."""
        return self.stack.component_names

    def positions(self, relative: ArrayLike) -> jax.Array:
        """As `Agents.positions`."""
        return self.stack.positions(relative)

    def drift(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """f, (order, n); the first row contains the neighbours' velocities."""
        zero = jnp.zeros_like(x[0])
        first = self.level_rate(1, t, x, zero, 0.0)
        return jnp.concatenate([first[None], self.stack.drift(t, x)[1:]])

    def gain(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """G, (order, n, n), block-diagonal."""
        m = self.stack.agents[0].n
        same = jnp.ones((m, m), x.dtype)
        blocks = jnp.kron(jnp.eye(len(self.stack.agents), dtype=x.dtype), same)
        gain = self.stack.gain(t, x)
        return jnp.concatenate([(gain[0] * blocks)[None], gain[1:]])

    def level_rate(
        self, level: int, t: jax.Array, x: jax.Array, above: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """x_i', (n,); for the first level the neighbours' velocities are those of x."""
        if level > 1:
            return self.stack.level_rate(level, t, x, above, torque)
        own = self.stack._each(level_rate, 1, t, x, above, torque)
        scaled = [h * rate for h, rate in zip(self._degrees, own, strict=True)]
        return jnp.concatenate(scaled) + self._neighbours_part(t, x, torque)

    def level_input(
        self, level: int, t: jax.Array, x: jax.Array, rate: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """x_{i+1}, or u for the last level, (n,), for which x_i' is `rate`."""
        if level > 1:
            return self.stack.level_input(level, t, x, rate, torque)
        rest = self.stack._parts(rate - self._neighbours_part(t, x, torque))
        own = [part / h for h, part in zip(self._degrees, rest, strict=True)]
        inputs = self.stack._each(level_input, 1, t, x, jnp.concatenate(own), torque)
        return jnp.concatenate(inputs)

    def transposed_gain(self, level: int, t: jax.Array, x: jax.Array, s: jax.Array) -> jax.Array:
        """G_i^T s, (n,)."""
        if level == 1:
            parts = zip(self._degrees, self.stack._parts(s), strict=True)
            s = jnp.concatenate([h * part for h, part in parts])
            return jnp.concatenate(self.stack._each(transposed_gain, 1, t, x, s))
        return self.stack.transposed_gain(level, t, x, s)

    @property
    def _degrees(self) -> list[float]:
        """d_i + b_i of each agent."""
        return [row[i] for i, row in enumerate(self.stack.matrix)]

    def _neighbours_part(self, t: jax.Array, x: jax.Array, torque: jax.Array | float) -> jax.Array:
        """-sum_j a_ij p_j', (n,), with the second level of x as the agents' velocities."""
        rates = self.stack._each(level_rate, 1, t, x, x[1], torque)
        sums = sparse.times(self.stack.adjacency, rates)
        parts = [jnp.broadcast_to(total, rates[0].shape) for total in sums]
        return -jnp.concatenate(parts)

    def steady_input(self, q: jax.Array) -> jax.Array:
        """The input that holds the agents at y, (n,); 0 if an agent has no such method."""
        of_stack = self.stack.steady_input(q)
        return jnp.zeros_like(q) if of_stack is None else of_stack

    def weights(self, x: jax.Array) -> jax.Array:
        """As `Agents.weights`."""
        return self.stack.weights(x)

    def at(self, t: jax.Array) -> NeighbourModel:
        """The model at time t [s]."""
        return NeighbourModel(self.stack.at(t))

    def jump_times(self) -> jax.Array:
        """As `Agents.jump_times`."""
        return self.stack.jump_times()


# --- checks ---------------------------------------------------------------------------------------


def _weights(name: str, value: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """The weights of a graph as an array; ValueError for others than finite numbers >= 0."""
    expected = f"finite numbers >= 0, shape {shape}, one for each of {shape[0]} agents"
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError) as error:
        raise checks.fail(name, value, expected) from error
    if array.shape != shape or not np.all(np.isfinite(array)) or np.any(array < 0.0):
        raise checks.fail(name, value, expected)
    return array


def _check_reached(adjacency: np.ndarray, leader: np.ndarray) -> None:
    """Raises ValueError for agents to which no path leads from the leader."""
    reached = leader > 0.0
    for _ in range(len(leader)):
        reached = reached | ((adjacency > 0.0) @ reached)
    if np.all(reached):
        return
    numbers = ", ".join(str(i + 1) for i in np.flatnonzero(~reached))
    got = checks.Words(f"no path from the leader to agent {numbers}")
    expected = "a path from the leader to every agent, as H = L + diag(b) is singular otherwise"
    remedy = "adjacency[i][j] > 0 is a path from agent j + 1 to agent i + 1, leader[i] > 0 one from"
    raise checks.fail("Agents.adjacency", got, expected, f"{remedy} the leader to agent i + 1.")


# --- small functions ------------------------------------------------------------------------------


def _joined(parts: list[jax.Array | None], axis: int) -> jax.Array | None:
    """The parts of all agents in one array; None where one is missing."""
    known = [part for part in parts if part is not None]
    if len(known) < len(parts):
        return None
    return jnp.concatenate(known, axis=axis)
