"""The contract of a plant in strict-feedback form, and what follows from it.

    x_i' = f_i(t, x_1..x_i) + G_i(t, x_1..x_i) x_{i+1} + d_i,   i = 1..r,   x_{r+1} = u      (S.1)

A plant has r levels (`order`) of n numbers each; the state x is (r, n), and level i is x[i - 1].
The output x_1 tracks the reference, and every gain G_i is invertible.  A robot is a plant of order
2, x = (q, q') with f_2 = -M^-1 (C q' + G) and G_2 = M^-1: `as_plant` wraps it as a `RobotPlant`.

Functions of this module take the number of a level, which counts from 1.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple, TypeGuard

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.attributes import has_members
from iblf_jax.core.families import adopt, attribute, is_default
from iblf_jax.core.linalg import matvec, solve_gain, solve_spd
from iblf_jax.core.pytree import is_absent
from iblf_jax.core.status import VELOCITY_LIMIT
from iblf_jax.core.units import ByLevel, Unit, per_second, product
from iblf_jax.kernels import jaxprs
from iblf_jax.world.robots import Dynamics, Robot, joint_names
from iblf_jax.world.robots._base import has_mass_matrix

Units = str | tuple[str, ...]
"""The unit of a level: one for all its components, or one for each."""

MAX_ORDER = 12
"""Largest number of levels; every level adds an order to the derivatives of the law."""

EXCHANGE_RATE = 10.0
"""Square of the frequency at which neighbouring levels exchange energy, in the default weights of
this package's plants [1/s^2]: slow against the gains that a tracking task needs."""

ROUNDING = 1e-9
"""Derivatives below this share of the largest one are rounding errors."""

LIMIT_WITHOUT_ROBOT = 1e12
"""As `status.VELOCITY_LIMIT`, for plants without a robot, whose levels may have any units."""


class Plant(Dynamics):
    """The contract of a plant in strict-feedback form.  All methods are pure functions of one
    state.
    """

    robot: Robot | None = None
    """The robot inside a plant whose first two levels are its q and q'.  Disturbances, friction and
    observers of robots then act on it, as the torque that is added to it."""
    reference_levels: ClassVar[int] = 1
    """Number of first levels whose bounds follow the reference or its derivative; those of the
    other levels follow the virtual controls."""
    known_structure: ClassVar[bool] = False
    """Whether drift and gain have the structure of (S.1) for all numbers of the leaves."""
    needs_filters: ClassVar[bool] = False
    """Whether the drift depends on a later level whose derivatives no law may form.  Such a plant
    is the model of a law with filters, and never the plant of a scenario."""
    loses_input: ClassVar[bool] = True
    """Whether a gain may become singular, so that the law's input has no value."""

    @attribute
    @abc.abstractmethod
    def order(self) -> int:
        """Number of levels r, at least 2."""

    @attribute
    def uncertain_levels(self) -> tuple[int, ...]:
        """The levels whose rates contain a row of the uncertain term, all of them; () where it is
        one torque.
        """
        return tuple(range(1, self.order + 1))

    @attribute
    def estimate_shape(self) -> tuple[int, ...]:
        """The shape of an estimate of the uncertain term, (order, n)."""
        return self.order, self.n

    @attribute
    def units(self) -> tuple[Units, ...] | None:
        """The units of the levels and of the input, order + 1 of them; None if they have none."""
        return None

    @attribute
    def level_names(self) -> tuple[str, ...] | None:
        """Names of the levels, for figures and tables; None for "level 1", "level 2", ..."""
        return None

    @attribute
    def input_name(self) -> str:
        """The name of the input, for figures and tables."""
        return "input"

    @attribute
    def component_names(self) -> tuple[str, ...]:
        """Names of the n components; () for those of the joints of `robot`, or for numbers."""
        return ()

    @attribute
    def notation(self) -> Notation:
        """How figures, tables and messages write the quantities of the plant."""
        return Notation(self)

    @abc.abstractmethod
    def drift(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """f_1 ... f_r, (order, n), in the unit of each level per second.  Row i may depend on t and
        on x[0] ... x[i] only.

        Args:
          t: time, () [s].
          x: state, (order, n).
        """

    @abc.abstractmethod
    def gain(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """G_1 ... G_r, (order, n, n), or (order, n) for diagonal gains; dependence as `drift`."""

    def level_rate(
        self, level: int, t: jax.Array, x: jax.Array, above: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """f_i + G_i above, (n,); a member may have a shorter formula than `drift` and `gain`.
        `torque`, (n,) [N m], is added to a robot; 0.0 for none.
        """
        gain = _row(self.gain, t, x, level)
        return _row(self.drift, t, x, level) + _times(gain, above)

    def level_input(
        self, level: int, t: jax.Array, x: jax.Array, rate: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """The inverse of `level_rate`: the x_{i+1}, (n,), for which x_i' is `rate`."""
        gain = _row(self.gain, t, x, level)
        rest = rate - _row(self.drift, t, x, level)
        if gain.ndim == 2:
            return solve_gain(gain, rest)
        # NaN, as `solve_gain` gives; a division by 0 would give an infinite input.
        return rest / jnp.where(gain == 0.0, jnp.nan, gain)

    def transposed_gain(self, level: int, t: jax.Array, x: jax.Array, s: jax.Array) -> jax.Array:
        """G_i^T s, (n,)."""
        return _times(_row(self.gain, t, x, level).T, s)

    def uncertain(self, t: jax.Array, x: jax.Array, rate: jax.Array, u: jax.Array) -> jax.Array:
        """The uncertain term of a model for which x' is `rate` under the input u: d, (order, n)."""
        return rate - flow(self, t, x, u)

    def as_uncertain(self, x: jax.Array, estimate: jax.Array) -> jax.Array:
        """An estimate as one of d, (order, n): M^-1 f_hat in the second level for a torque f_hat,
        (n,), on the robot inside.
        """
        if estimate.ndim == 2:
            return estimate
        return torque_as_rates(self, x, estimate)

    def energy_of_errors(
        self, x: jax.Array, e2: jax.Array | None, error: jax.Array
    ) -> jax.Array | None:
        """What V of a sample adds to the law's V, (); None for nothing.

        Args:
          x: state, (order, n).
          e2: error of the last level, (n,); None if the law's V contains it.
          error: of the estimate of the uncertain term.
        """
        return None

    def outline(self, x1: jax.Array) -> jax.Array | None:
        """Corners of the plant's shape in the plane at a first level, (k, 2) [m], for figures; the
        first corner is drawn as its path.
        """
        return None

    def rigid(self) -> Robot | None:
        """The robot to which the plant tends in its rigid limit, such as that for a large
        stiffness: the model of a law of robots, where it is not `robot`.
        """
        return None

    def joint_torque(self, x: jax.Array, u: jax.Array) -> jax.Array | None:
        """The torque on the joints of the robot, (n,) [N m]; None without a robot."""
        return None

    def steady_levels(self, q: jax.Array, dq: jax.Array) -> jax.Array | None:
        """The levels from the third on, (order - 2, n), of a plant that starts with given q and q';
        without it a start needs all levels, `Initial(x=...)`.
        """
        return None

    def steady_input(self, q: jax.Array) -> jax.Array | None:
        """The input that holds the plant at q, (n,)."""
        return None

    def weights(self, x: jax.Array) -> jax.Array | None:
        """The scale of each level's energy, (order, n); `BarrierBackstepping` weighs its barriers
        with it.
        """
        return None

    def friction_torque(self, x: jax.Array) -> jax.Array | None:
        """Of a plant with several robots inside, the friction of their joints, (n,) [N m], which
        belongs to the plant only and is passed to `level_rate` as its torque.
        """
        return None


class Notation:
    """How figures, tables and messages write the quantities of a plant: by the names of its levels
    and of its input.

    The `effort` of a comparison is that in figures; it has a heading of columns and a formula, too.
    `levels` are the names that tables and files list.

    Args:
      plant: any.
    """

    symbols: ClassVar[tuple[str, str]] = ("x_1", "x_2")
    """Of the first two levels, in figures."""
    reference: ClassVar[str] = "x_d"
    input: ClassVar[str] = "u"
    alpha: ClassVar[str] = "virtual control of the second level"
    difference: ClassVar[str] = "(in the unit of each level)"
    """The unit of a difference of the state."""

    def __init__(self, plant: Plant) -> None:
        name = input_name(plant)
        self.plant = plant
        self.levels = level_names(plant)
        self.portrait = f"Phase portrait: {self.levels[0]}"
        self.input_column = name
        self.effort_column = f"{name} above u_0"
        self.effort = f"{name} above $u_0$"
        self.effort_formula = f"{name} above its steady_input u_0(q), sqrt(mean |u - u_0(q)|^2)"

    def component(self, level: int, index: int) -> str:
        """A component of a level, such as "speed of pendulum"."""
        return f"{level_names(self.plant)[level - 1]} of {component_names(self.plant)[index]}"

    def numbered(self, level: int) -> str:
        """A level by its number, and by its name if it has one."""
        name = level_names(self.plant)[level - 1]
        return name if name == f"level {level}" else f"level {level} ({name})"

    def numbered_component(self, level: int, index: int) -> str:
        """A component of a level, such as "Level 2 (speed) of pendulum"."""
        return f"{self.numbered(level).capitalize()} of {component_names(self.plant)[index]}"

    def left_bounds(self, level: int, index: int) -> str:
        """That a component of a level left its bounds."""
        return f"{self.numbered_component(level, index)} left its bounds"


def state_of_levels(q: jax.Array, dq: jax.Array, above_second: Any) -> jax.Array:
    """The state x of a plant, (r, n), from its first two levels and the others."""
    first = jnp.stack([q, dq])
    return first if is_absent(above_second) else jnp.concatenate([first, above_second])


def is_chain(part: Any) -> TypeGuard[Plant]:
    """Whether a part has the methods of a plant in strict-feedback form.  A robot has them only
    inside a `RobotPlant`, which `as_plant` makes of it.  A class without the base class is adopted.
    """
    if isinstance(part, type) or not has_members(part, "drift", "gain", "order"):
        return False
    adopt(type(part), Plant)
    return True


ROBOTS = "iblf_jax.robots has them; write your own with from_energy."
PLANTS = "iblf_jax.plants has them; iblf_jax.testing.check_plant checks your own."


def check_part(name: str, part: Any) -> None:
    """Raises ValueError for something that is neither a robot nor a plant in strict-feedback form;
    adopts its class.
    """
    if is_chain(part):
        checks.conforms(name, part, Plant, PLANTS)
        check_dimensions(name, part)
        return
    checks.conforms(name, part, Robot, f"{ROBOTS} {PLANTS}")


def order_of(part: Any) -> int:
    """Number of levels of a plant; 2 for a robot."""
    if is_chain(part):
        return int(part.order)
    return 2


def nominal_of(part: Any) -> Any:
    """The plant that laws know: the part itself, or the plant inside one with modes."""
    if is_chain(part) or has_mass_matrix(part):
        return part.nominal
    return part


def has_modes(part: Any) -> bool:
    """Whether a robot or a plant has results about its modes."""
    return not is_default(part.switching, Dynamics.switching)


def has_steady_levels(plant: Any) -> bool:
    """Whether a plant states the levels of a start with given q and q'."""
    rest = jnp.zeros(plant.n)
    return jax.eval_shape(plant.steady_levels, rest, rest) is not None


def robot_of(part: Any) -> Any:
    """The robot itself, the robot inside a plant, or None."""
    if is_chain(part):
        return part.robot
    return part


def robot_or_plant(part: Any) -> Any:
    """The robot of a part, as the torque of a disturbance receives it; a plant without a robot
    itself.
    """
    robot = robot_of(part)
    return part if robot is None else robot


def declared_joints(part: Any) -> tuple[str, ...]:
    """The names that a robot, or the robot inside a plant, gives its joints; () without names."""
    robot = robot_of(part)
    return tuple(robot.joints) if has_mass_matrix(robot) else ()


def level_rate(
    plant: Plant,
    level: int,
    t: jax.Array,
    x: jax.Array,
    above: jax.Array,
    torque: jax.Array | float = 0.0,
) -> jax.Array:
    """x_i' = f_i + G_i above of a level, (n,), without a disturbance.

    Args:
      plant: any.
      level: i, from 1 to order.
      t: time, () [s].
      x: state, (order, n).
      above: x_{i+1}, or the input u for the last level, (n,).
      torque: added to the robot inside the plant, (n,) [N m]; 0.0 for none.
    """
    adopt(type(plant), Plant)
    return plant.level_rate(level, t, x, above, torque)


def level_input(
    plant: Plant,
    level: int,
    t: jax.Array,
    x: jax.Array,
    rate: jax.Array,
    torque: jax.Array | float = 0.0,
) -> jax.Array:
    """G_i^-1 (rate - f_i) of a level, (n,): the inverse of `level_rate`.  A singular gain gives
    NaN.
    """
    adopt(type(plant), Plant)
    return plant.level_input(level, t, x, rate, torque)


def gain_times(plant: Plant, level: int, t: jax.Array, x: jax.Array, v: jax.Array) -> jax.Array:
    """G_i v of a level, (n,): the derivative of x_i' along the level above."""

    def rate(above: jax.Array) -> jax.Array:
        return level_rate(plant, level, t, x, above)

    return jax.jvp(rate, (jnp.zeros_like(v),), (v,))[1]


def transposed_gain(
    plant: Plant, level: int, t: jax.Array, x: jax.Array, s: jax.Array
) -> jax.Array:
    """G_i^T s of a level, (n,)."""
    adopt(type(plant), Plant)
    return plant.transposed_gain(level, t, x, s)


def _row(
    function: Callable[[jax.Array, jax.Array], jax.Array], t: jax.Array, x: jax.Array, level: int
) -> jax.Array:
    """One row of drift or gain, without the computation of the others.

    Most plants stack their rows.  The row is taken before it is stacked, so that it depends only on
    what its own equation contains: a proof admits operations in the last level that it does not
    admit in the others.
    """
    row = jaxprs.entry_of_stack(jax.make_jaxpr(function)(t, x), level - 1)
    if row is None:
        return function(t, x)[level - 1]
    return row(t, x)  # type: ignore[no-any-return]


def _times(gain: jax.Array, v: jax.Array) -> jax.Array:
    """The product of a gain, (n, n) or its diagonal (n,), and a vector."""
    if gain.ndim == 2:
        return matvec(gain, v)
    return gain * v


def flow(
    plant: Plant,
    t: jax.Array,
    x: jax.Array,
    u: jax.Array,
    torque: jax.Array | float = 0.0,
) -> jax.Array:
    """The rate x' without a disturbance, (order, n); arguments as `level_rate`, u is the input."""
    rows = []
    for level, above in enumerate([*x[1:], u], start=1):
        rows.append(level_rate(plant, level, t, x, above, torque))
    return jnp.stack(rows)


def torque_as_rates(plant: Plant, x: jax.Array, torque: jax.Array) -> jax.Array:
    """What a torque on the robot inside a plant adds to x', (order, n): M^-1 torque in the second
    level.
    """
    rate = solve_spd(robot_of(plant).mass_matrix(x[0]), torque)
    zero = jnp.zeros_like(rate)
    return jnp.stack([zero, rate, *[zero] * (plant.order - 2)])


class Dependence(NamedTuple):
    """The largest derivatives of f_i and G_i by the components of each level, (order, order) each;
    row i, column j is that of f_i by x_j.
    """

    drift: jax.Array
    gain: jax.Array


def dependence_on_levels(plant: Plant, t: jax.Array, x: jax.Array) -> Dependence:
    """On which levels f_i and G_i depend at a state, by their Jacobians.

    Args:
      plant: any.
      t: time, () [s].
      x: state, (order, n).
    """

    def largest(function: Callable) -> jax.Array:
        slopes = jnp.abs(jax.jacfwd(function, argnums=1)(t, x))
        rows = slopes.reshape(x.shape[0], -1, *x.shape)
        return jnp.max(rows, axis=(1, 3))

    return Dependence(largest(plant.drift), largest(plant.gain))


def check_dependence(name: str, dependence: Dependence) -> None:
    """Raises ValueError for a row of drift or gain that depends on a later level.

    Args:
      name: of the plant, for the message.
      dependence: of `dependence_on_levels`, at one or more states, (..., order, order).
    """
    for function, slopes in dependence._asdict().items():
        sizes = np.asarray(slopes)
        known = np.where(np.isfinite(sizes), sizes, 0.0).reshape(-1, *sizes.shape[-2:])
        later = np.triu(np.max(known, axis=0), k=1)
        if not np.any(later > ROUNDING * np.max(known)):
            continue
        i, j = np.unravel_index(np.argmax(later), later.shape)
        got = f"row {i} that depends on x[{j}]"
        expected = f"row {i} to depend on x[0] ... x[{i}] only (strict-feedback form)"
        if i == 0:
            expected = "row 0 to depend on x[0] only (strict-feedback form)"
        remedy = "Choose other levels, or other coordinates."
        if function == "drift" and j == i + 1:
            remedy = f"The factor of x[{j}] in x[{i}]' belongs in row {i} of the gain."
        raise checks.fail(f"{name}.{function}(t, x)", checks.Words(got), expected, remedy)


def units_of(part: Any) -> tuple[Units, ...]:
    """The units of the levels of a plant and of its input: order + 1 of them."""
    if not is_chain(part):
        return ("rad", "rad/s", "N m")
    if part.units is None:
        return ("1",) * (order_of(part) + 1)
    return tuple(part.units)


def unit_symbols(plant: Any, model: Any) -> Mapping[str, Unit]:
    """The unit of each symbol of `core.units`, for a plant under a law that knows a model."""
    *levels, of_input = units_of(plant)
    rates = ByLevel(per_second(unit) for unit in levels)
    torque: Unit = "N m"
    if robot_of(plant) is None:
        torque = of_input
    energy: Unit = "1"
    if robot_of(plant) is not None or not is_default(plant.weights, Plant.weights):
        energy = product(torque, levels[0])
    uncertain: Unit = rates if is_chain(model) else "N m"
    return {
        **{f"x{i + 1}": unit for i, unit in enumerate(levels)},
        "last": levels[-1],
        "levels": ByLevel(levels),
        "higher": ByLevel(levels[2:]),
        "rates": rates,
        "u": of_input,
        "f": uncertain,
        "tau": torque,
        "energy": energy,
    }


def level_names(part: Any) -> tuple[str, ...]:
    """Names of the levels: those that the plant states, else "level 1", "level 2", ..."""
    if not is_chain(part):
        return ("position", "velocity")
    if part.level_names is None:
        return tuple(f"level {i + 1}" for i in range(order_of(part)))
    return tuple(part.level_names)


def input_name(part: Any) -> str:
    """The name of the input: "torque" of a robot."""
    if is_chain(part):
        return str(part.input_name)
    return "torque"


def component_names(part: Any) -> tuple[str, ...]:
    """Names of the n components of a level: those that the plant states, else those of the joints
    of the robot or of the robot inside the plant, else "component 0", "component 1", ...
    """
    if is_chain(part) and part.component_names:
        return tuple(part.component_names)
    robot = robot_of(part)
    if robot is not None:
        return joint_names(robot, part.n)
    return tuple(f"component {i}" for i in range(part.n))


def components_in_words(part: Any) -> tuple[str, ...]:
    """The n components of a level as a sentence names them: "joint elbow" and "joint shoulder"
    where a robot names its joints, else "joint 0", "joint 1", ... or the names that a plant states.
    """
    names = component_names(part)
    if not declared_joints(part):
        return names
    return tuple(f"joint {name}" for name in names)


def component_noun(part: Any) -> str:
    """The word for a component of a level: "joint" where there is a robot."""
    if robot_of(part) is None:
        return "component"
    return "joint"


def counted_components(part: Any, n: int) -> str:
    """The number n of components of a level in words, such as "1 component" or "2 joints"."""
    if n == 1:
        return f"1 {component_noun(part)}"
    return f"{n} {component_noun(part)}s"


def speed_limit(part: Any) -> float:
    """The size of the second level above which a run counts as diverged: of a robot
    `status.VELOCITY_LIMIT`; other plants may have any units.
    """
    if robot_of(part) is None:
        return LIMIT_WITHOUT_ROBOT
    return VELOCITY_LIMIT


def check_dimensions(name: str, plant: Plant) -> None:
    """Raises ValueError for numbers of components and levels that are no whole numbers, or units
    that do not fit them.
    """
    adopt(type(plant), Plant)
    checks.positive_integer(f"{name}.n", plant.n, most=checks.MAX_JOINTS)
    checks.positive_integer(f"{name}.order", plant.order, least=2, most=MAX_ORDER)
    _check_texts(f"{name}.level_names", plant.level_names, plant.order)
    _check_texts(f"{name}.component_names", plant.component_names or None, plant.n)
    if not isinstance(plant.units, tuple | list | None):
        expected = "a tuple of units, of every level and of the input"
        raise checks.fail(f"{name}.units", plant.units, expected)
    units = units_of(plant)
    if len(units) != plant.order + 1:
        expected = f"{plant.order + 1} units, of {plant.order} levels and of the input"
        raise checks.fail(f"{name}.units", units, expected)
    for unit in units:
        is_tuple = isinstance(unit, tuple | list) and all(isinstance(x, str) for x in unit)
        if not isinstance(unit, str) and not (is_tuple and len(unit) == plant.n):
            raise checks.fail(f"{name}.units", unit, f"one unit, or {plant.n} (one a component)")


def _check_texts(name: str, value: Any, count: int) -> None:
    """Raises ValueError for something that is neither None nor a tuple of so many texts."""
    if value is None:
        return
    is_tuple = isinstance(value, tuple | list)
    if not is_tuple or len(value) != count or not all(isinstance(x, str) for x in value):
        raise checks.fail(name, value, f"a tuple of {count} texts")
