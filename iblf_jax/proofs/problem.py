"""What a proof of a level set needs of a family of plants: coordinates, bounds and points."""

from __future__ import annotations

import abc
import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import PyTreeDef

from iblf_jax.control import observers
from iblf_jax.core import checks, programs
from iblf_jax.proofs.parameters import Uncertain
from iblf_jax.proofs.periods import shifted
from iblf_jax.proofs.support import check_level
from iblf_jax.proofs.uncertainty import Places
from iblf_jax.simulation import paths
from iblf_jax.simulation.initial import Initial
from iblf_jax.simulation.scenario import Scenario

PARTS_OF_TIME = 32
"""Parts of the time interval, each of which is searched on its own: over a long part a tube may
have no positive width, so that no bisection would be better than another."""


TIME_SCALE = 4.0
"""Width of the time at which `search` counts it as wide as an angle of a quarter turn or more, in
parts of its interval."""
PARAMETER_SCALE = 10.0
"""The same of a parameter, in parts of its interval."""


class LevelSetState(NamedTuple):
    """A point of the level set in physical numbers."""

    t: float
    """[s]."""
    q: np.ndarray
    """Position, (n,) [rad]."""
    dq: np.ndarray
    """Velocity, (n,) [rad/s]."""
    f_tilde: np.ndarray
    """Error of the observer's estimate, (n,) [N m]."""
    f_hat: np.ndarray
    """The estimate, (n,) [N m]."""
    eta: np.ndarray
    """State of the observer, (n,) [N m]."""
    parameters: dict[str, float]
    """Path of each uncertain entry -> its value."""
    rate: np.ndarray
    """Rate of the further disturbance, (n,) [N m/s]; (0,) if there is none."""


def split_point(point: jax.Array, terms: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Time, s/|s| and z of a point (t, s, z)."""
    t, s, z = point[0], point[1 : 1 + terms], point[1 + terms :]
    return t, s / jnp.sqrt(jnp.sum(s**2)), z


@dataclasses.dataclass(frozen=True)
class OfStructure:
    """A hashable function of the constants of problems of one structure."""

    structure: PyTreeDef
    places: Places
    digests: tuple[str, ...]
    """Of the functions that users wrote, so that a changed one has a program of its own."""


class TorqueFunctions(NamedTuple):
    """Functions of the torque of the law, and its limits."""

    at_point: Callable[[jax.Array, Any], jax.Array]
    """The torque at a point, (n,) [N m], in plain floating-point numbers."""
    excess: Callable
    """A hashable function for `search.search`: the bound of the distance by which the torque leaves
    an interval, the ends of which are the last two constants.  Behind the parameters it has a
    coordinate share in [0, 1]: V_w = level share^2."""
    limits: np.ndarray | None
    """Least and greatest torque of the loop, (2, n) [N m]; None without limits."""


class HeldFunctions(NamedTuple):
    """Functions of the rates with which a held torque and a sampled estimate become old.

    The last constant of `LevelSetProblem.bound` then are bounds of these rates on the whole set,
    (k, n).
    """

    at_point: Callable[[jax.Array, Any], jax.Array]
    """The rates at a point, (k, n) [N m/s], in plain floating-point numbers."""
    excess: Callable
    """A hashable function for `search.search`: the bound of the rates in parts of those in the last
    constant, minus 1.  It has the coordinate share of `TorqueFunctions.excess`."""
    growth: Callable[[jax.Array, Any], jax.Array] | None
    """Of a loop with a delay, the largest V_w' at a point before the first command, with bounds of
    the rates as last constant; None without a delay."""


@dataclasses.dataclass(frozen=True, eq=False)
class LevelSetProblem(abc.ABC):
    """Is V_w' < 0 at every point of V_w = level, at every time and for all parameters of a box?

    A box is one of coordinates x = (`lower`, `upper`) together with a row of `patterns`, which are
    the last coordinates and are not divided.  `bound(x, constants)` returns upper bounds of V_w'
    over the box, (k,); the box is proved if any is negative.  It also returns an empty region
    (`search.search`).

    A point is a vector (t, s, z) with s of any length: s/|s| divides the level among the terms
    of V_w, and z are the parameters.
    """

    scenario: Scenario
    """The loop, canonical in double precision."""
    uncertain: Uncertain
    bound: Callable
    """A hashable function (x, constants) for `search.search`."""
    point_rate: Callable[[jax.Array, Any], jax.Array]
    """V_w' at a point in plain floating-point numbers, to be compiled and differentiated."""
    torque: TorqueFunctions | None
    """None where the torque is not bounded."""
    held_torque: HeldFunctions | None
    """None for a continuous loop."""
    duration: float
    """Length of the time interval of the proof [s]."""
    is_period: bool
    """Whether the time interval is a period, so that the proof is for all times."""
    assumptions: tuple[str, ...]
    """What was assumed, as sentences."""
    with_active_limits: LevelSetProblem | None = dataclasses.field(default=None, kw_only=True)
    """The same statement of the loop whose limits of the torque may be active; None without limits,
    and where its V_w' is not known."""
    units: ClassVar[tuple[str, str]]
    """Of a weight and of a level."""
    first_barrier: ClassVar[str]
    """The barrier of the positions in words."""

    @property
    def limits_may_be_active(self) -> bool:
        """Whether the statement is that of a loop whose limits of the torque may be active."""
        return False

    @property
    @abc.abstractmethod
    def angles(self) -> list[tuple[str, float, float]]:
        """Name, least and greatest value of each angle; ends are rounded outward."""

    @property
    @abc.abstractmethod
    def sign_count(self) -> int:
        """Number of errors with a sign."""

    @property
    @abc.abstractmethod
    def term_count(self) -> int:
        """Number of terms of V_w, the length of s."""

    @abc.abstractmethod
    def constants_of(self, weight: float, level: float) -> Any:
        """The constants of a weight and a level, as a pytree."""

    @abc.abstractmethod
    def state_of(self, point: np.ndarray, constants: Sequence[np.ndarray]) -> Any:
        """A point in physical numbers, with t, eta and parameters."""

    @abc.abstractmethod
    def initial(self, state: Any) -> Initial:
        """The start of a run in a state of `state_of`."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the coordinates and of the patterns."""
        angles = [name for name, _, _ in self.angles]
        sides = [f"side[{i}]" for i in range(self.sign_count)]
        return ("time since start", *angles, *self.uncertain.names, *sides, "start")

    @property
    def lower(self) -> np.ndarray:
        """Lower ends of the coordinates, (b,)."""
        return np.array([0.0, *(low for _, low, _ in self.angles), *self.uncertain.low])

    @property
    def upper(self) -> np.ndarray:
        """Upper ends of the coordinates, (b,): parts of the time interval overlap by more than the
        rounding of their starts.
        """
        part = self.duration / PARTS_OF_TIME * (1.0 + 1e-9)
        return np.array([part, *(high for _, _, high in self.angles), *self.uncertain.high])

    @property
    def scales(self) -> np.ndarray:
        """Widths at which coordinates count as equally wide, (b,).

        Time and parameters vary little within their intervals, and an angle of a full turn counts
        as one of half a turn (docs/theory/guarantees.md has measurements).
        """
        width = self.upper - self.lower
        angles = slice(1, 1 + len(self.angles))
        scales = PARAMETER_SCALE * width
        scales[0] = TIME_SCALE * width[0]
        scales[angles] = np.minimum(width[angles], math.pi)
        # A number that does not vary has a width of 0, and is not bisected.
        return np.where(width > 0.0, scales, 1.0)

    @property
    def patterns(self) -> np.ndarray:
        """The signs of the errors and the start of each part of the time interval, (p, signs +
        1).
        """
        sides = itertools.product((-1.0, 1.0), repeat=self.sign_count)
        starts = np.arange(PARTS_OF_TIME) * (self.duration / PARTS_OF_TIME)
        return np.array([[*side, start] for side in sides for start in starts])

    @jax.enable_x64(True)
    def constants(self, weight: float, level: float) -> list[np.ndarray]:
        """The constants of a weight and a level.

        Raises:
          ValueError: a number that is not positive, or a level that reaches the guard of the
            barrier of the positions; the bound examines those of further levels.
        """
        weight = checks.positive_number("weight", weight, self.units[0])
        level = checks.positive_number("level", level, self.units[1])
        check_level(level, self.scenario, self.duration, self.first_barrier)
        return [np.asarray(x, float) for x in jax.tree.leaves(self.constants_of(weight, level))]

    @jax.enable_x64(True)
    def rate(self, points: np.ndarray, constants: Sequence[np.ndarray]) -> np.ndarray:
        """V_w' at points, (count, p) -> (count,), in the unit of V_w per second and in plain
        floating-point numbers.
        """
        return np.asarray(_at_points(self.point_rate, np.asarray(points, float), list(constants)))

    @jax.enable_x64(True)
    def torques(self, points: np.ndarray, constants: Sequence[np.ndarray]) -> np.ndarray:
        """The torque of the law at points, (count, p) -> (count, n) [N m], in plain floating-point
        numbers.
        """
        assert self.torque is not None
        function = self.torque.at_point
        return np.asarray(_at_points(function, np.asarray(points, float), list(constants)))

    @jax.enable_x64(True)
    def held_rates(self, points: np.ndarray, constants: Sequence[np.ndarray]) -> np.ndarray:
        """The rates of a held torque at points, (count, p) -> (count, k, n) [N m/s], in plain
        floating-point numbers.
        """
        assert self.held_torque is not None
        function = self.held_torque.at_point
        return np.asarray(_at_points(function, np.asarray(points, float), list(constants)))

    @jax.enable_x64(True)
    def growth(self, points: np.ndarray, constants: Sequence[np.ndarray]) -> np.ndarray:
        """The largest V_w' before the first command at points, (count, p) -> (count,), in plain
        floating-point numbers; bounds of the rates are the last constant.
        """
        assert self.held_torque is not None
        function = checks.given(self.held_torque.growth)
        return np.asarray(_at_points(function, np.asarray(points, float), list(constants)))

    @property
    def whole_set(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lower and upper ends and scales for a search over the whole set."""
        lower, upper = np.append(self.lower, 0.0), np.append(self.upper, 1.0)
        return lower, upper, np.append(self.scales, 1.0)

    def sample(self, seed: int, count: int) -> np.ndarray:
        """Random points (t, s, z), (count, 1 + terms + m); every second one has its parameters at a
        corner.
        """
        low, high = self.uncertain.low, self.uncertain.high
        generator = np.random.default_rng(seed)
        t = generator.uniform(0.0, self.duration, (count, 1))
        s = generator.normal(size=(count, self.term_count))
        s /= np.linalg.norm(s, axis=1, keepdims=True)
        share = generator.uniform(size=(count, len(low)))
        share[::2] = np.round(share[::2])
        return np.concatenate([t, s, low + share * (high - low)], axis=1)

    def scenario_at(self, point: np.ndarray, constants: Sequence[np.ndarray]) -> Scenario:
        """The scenario whose run starts at a point, with its parameters and moved in time.

        Raises:
          ValueError: a part that cannot be moved in time, unless the time is 0.
        """
        state = self.state_of(point, constants)
        scenario = paths.with_parameters(self.scenario, state.parameters)
        observer = scenario.observer
        if isinstance(observer, observers.Momentum | observers.LevelObserver):
            observer = dataclasses.replace(observer, eta0=state.eta, start="zero")
        return dataclasses.replace(
            scenario,
            initial=self.initial(state),
            observer=observer,
            bounds=tuple(shifted(bounds, state.t) for bounds in scenario.bounds),
            reference=shifted(scenario.reference, state.t),
            disturbance=shifted(scenario.disturbance, state.t),
        )


@partial(programs.jit, static_argnums=0, options=programs.SHORTEST_TO_COMPILE)
def _at_points(function: Callable, points: jax.Array, constants: list[jax.Array]) -> jax.Array:
    return jax.vmap(function, (0, None))(points, constants)
