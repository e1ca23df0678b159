"""The level set of V of a plant in strict-feedback form as a `LevelSetProblem`.

The derivation is at the head of `chain_motion` and `chain_bound`.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control import controllers, observers
from iblf_jax.control.barriers import Quadratic
from iblf_jax.control.barriers._base import has_ratio
from iblf_jax.core import checks
from iblf_jax.core.families import is_default
from iblf_jax.core.pytree import astype
from iblf_jax.core.time import jump_times_of
from iblf_jax.proofs import chain_motion
from iblf_jax.proofs.chain_bound import (
    Constants,
    LevelPoint,
    TruePlant,
    chain_bound,
    level_point,
    level_rate,
)
from iblf_jax.proofs.chain_motion import ChainParts
from iblf_jax.proofs.examination import Examined, check_operations, operations
from iblf_jax.proofs.parameters import Uncertain, uncertain_coordinates
from iblf_jax.proofs.periods import shifted
from iblf_jax.proofs.problem import (
    LevelSetProblem,
    length_of_part,
    patterns_of,
    random_points,
)
from iblf_jax.proofs.support import (
    CONTINUOUS,
    REAL_NUMBERS,
    check_absent,
    check_exponential,
    check_level,
    check_same_structure,
    claims_of,
    infinite_unless_defined,
    time_interval,
    unsupported,
)
from iblf_jax.proofs.uncertainty import Places
from iblf_jax.proofs.users_barriers import check_barrier
from iblf_jax.proofs.users_parts import (
    BARRIERS,
    agreement_of_plant,
    check_constant,
    check_time_functions,
)
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Initial, Scenario, canonical
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.world import plants
from iblf_jax.world.bounds import Tube, tube_at

ORDERS = (2, 3)
"""Numbers of levels for which the bound is small enough to be of use."""
ASSUMPTIONS = (
    REAL_NUMBERS,
    "The input of the law is applied as it is: without sampling, delay or saturation.",
    "The errors of the observer and the state are exactly those of the level set; measurements have"
    " no noise.",
)


class ChainBound(NamedTuple):
    """The bound of chains of one structure, as a hashable function."""

    structure: Any
    places: Places
    observed: tuple[bool, ...]
    digests: tuple[str, ...]
    """Of the functions that users wrote, so that a changed one has a program of its own."""

    def __call__(self, x: jax.Array, constants: list[jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Upper bounds of V' over a box, and no region."""
        numbers = jax.tree.unflatten(self.structure, constants)
        return chain_bound(self.places, self.observed, x, numbers), jnp.zeros((0,))


class ChainRate(NamedTuple):
    """V' at a point of chains of one structure, as a hashable function."""

    structure: Any
    places: Places
    observed: tuple[bool, ...]
    digests: tuple[str, ...]
    """Of the functions that users wrote, so that a changed one has a program of its own."""

    def __call__(self, point: jax.Array, constants: list[jax.Array]) -> jax.Array:
        """V', (); infinite where d is not defined."""
        numbers = jax.tree.unflatten(self.structure, constants)
        true, found = point_of(self.places, self.observed, jnp.asarray(point), numbers)
        rate = level_rate(numbers, self.observed, true, found)
        return infinite_unless_defined(rate, jnp.stack(found.now.d))


def point_of(
    places: Places, observed: tuple[bool, ...], point: jax.Array, constants: Constants
) -> tuple[TruePlant, LevelPoint]:
    """The plant and the motion at a point (t, s, z); s/|s| = (sqrt(w_i V_i/c) with the signs of
    e_i, sqrt(v_i/(2c)) d_tilde_i).
    """
    order = len(observed)
    terms = order + sum(observed)
    t, s, z = point[0], point[1 : 1 + terms], point[1 + terms :]
    shares = s / jnp.sqrt(jnp.sum(s**2))
    true = TruePlant(constants, places, z, is_box=False)
    signs = jnp.where(s[:order] > 0, 1.0, -1.0)
    return true, level_point(constants, observed, true, t, list(shares), signs)


class ChainLevelState(NamedTuple):
    """A point of the level set in physical numbers."""

    t: float
    """[s]."""
    x: np.ndarray
    """State of the plant, (r, 1)."""
    u: np.ndarray
    """Input, (1,)."""
    d_tilde: np.ndarray
    """Error of the estimate of each level, (r, 1)."""
    d_hat: np.ndarray
    """Estimate of each level, (r, 1)."""
    eta: np.ndarray
    """State of the observer, (r, 1)."""
    parameters: dict[str, float]
    """Path of each uncertain entry -> its value."""


@dataclasses.dataclass(frozen=True, eq=False)
class _Chain:
    """The functions of a problem that need its numbers."""

    scenario: Scenario
    parts: ChainParts
    uncertain: Uncertain
    observed: tuple[bool, ...]
    structure: Any
    duration: float

    @property
    def terms(self) -> int:
        """Number of terms of V."""
        return len(self.observed) + sum(self.observed)

    @jax.enable_x64(True)
    def constants(self, weight: float, level: float) -> list[np.ndarray]:
        """The constants of a weight and a level.

        Args:
          weight: v_i = weight w_i s_i'(0)/(k_i kappa_i), a number without unit.
          level: c, in the unit of w_i V_i.

        Raises:
          ValueError: a number that is not positive, or a level that reaches the guard of the first
            barrier; the bound examines those of the other levels.
        """
        weight = checks.positive_number("weight", weight, "1")
        level = checks.positive_number("level", level, "energy")
        self._check_level(level)
        weights = weight * self._scales_of_weights()
        numbers = Constants(
            self.parts,
            self.scenario.plant,
            self.scenario.disturbance,
            self.uncertain.numbers,
            jnp.asarray(weights),
            jnp.asarray(level),
        )
        return [np.asarray(x, float) for x in jax.tree.leaves(numbers)]

    def _check_level(self, level: float) -> None:
        """Raises ValueError if the level set reaches the guard of the first barrier."""
        law: Any = self.scenario.controller
        barrier = law.barriers[0]
        if isinstance(barrier, Quadratic):
            return
        value = level / self.parts.law.weights[0] * jnp.ones(1)

        def xi_bound(t: jax.Array) -> jax.Array:
            tube = tube_at(self.parts.reference, self.scenario.bounds[0], t, acceleration=False)
            return barrier.xi_bound(value, tube)  # type: ignore[no-any-return]

        check_level(level, xi_bound, barrier.guard, self.duration, "first barrier")

    def _scales_of_weights(self) -> np.ndarray:
        """w_i s_i'(0)/(k_i kappa_i) of each observed level at t = 0, 1 of the others, (r, 1)."""
        law, order = self.parts.law, len(self.observed)
        scales = np.ones((order, 1))
        for i in range(order):
            if not self.observed[i]:
                continue
            slope = _slope_at_centre(self.parts, i)
            gains = law.k[i] * self.parts.kappa[i]
            scales[i] = np.asarray(law.weights[i] * slope / gains)
        return scales

    def sample(self, seed: int, count: int) -> np.ndarray:
        """Random points, (count, 1 + terms + m)."""
        ends = (self.uncertain.low, self.uncertain.high)
        return random_points(seed, count, self.duration, self.terms, *ends)

    def state_of(self, point: Any, constants: Any) -> ChainLevelState:
        """A point in physical numbers."""
        with jax.enable_x64(True):
            numbers = jax.tree.unflatten(self.structure, list(map(jnp.asarray, constants)))
            _, found = point_of(
                self.uncertain.places, self.observed, jnp.asarray(point, float), numbers
            )
            y = found.now.y
            d_hat = np.stack(y.d_hat)
            x = np.asarray(found.x)
            return ChainLevelState(
                float(y.t),
                x,
                np.asarray(found.u),
                np.stack(found.now.d_tilde),
                d_hat,
                d_hat - np.asarray(self.parts.kappa) * x,
                self.uncertain.values(np.asarray(point)[1 + self.terms :]),
            )

    def scenario_at(self, point: Any, constants: Any) -> Scenario:
        """The scenario whose run starts at a point, with its parameters and moved in time."""
        state = self.state_of(point, constants)
        scenario = paths.with_parameters(self.scenario, state.parameters)
        observer = scenario.observer
        if isinstance(observer, observers.LevelObserver):
            observer = dataclasses.replace(observer, eta0=state.eta, start="zero")
        return dataclasses.replace(
            scenario,
            initial=Initial(x=state.x),
            observer=observer,
            bounds=tuple(shifted(bounds, state.t) for bounds in scenario.bounds),
            reference=shifted(scenario.reference, state.t),
            disturbance=shifted(scenario.disturbance, state.t),
        )


def _slope_at_centre(parts: ChainParts, i: int) -> jax.Array:
    """s_i' at e_i = 0 and t = 0 in the tube around the middle of the bounds, (1,)."""
    zero, one = jnp.zeros(1), jnp.ones(1)
    tube = Tube(zero, zero, -one, one, zero, zero)
    bounds = parts.bounds[i]
    if bounds is not None:
        lower, upper = (side.at(jnp.zeros(()), zero) for side in (bounds.lower, bounds.upper))
        half = 0.5 * (upper - lower) * one
        tube = Tube(zero, zero, -half, half, zero, zero)
    return chain_motion.along(lambda e: parts.law.barriers[i].slope(tube, e), (zero,), (one,))


def chain_problem(
    scenario: Scenario,
    parameters: Mapping[str, Perturbation],
    *,
    duration: float | None = None,
) -> LevelSetProblem:
    """The proof problem of a plant in strict-feedback form of order 2 or 3, with one number per
    level, under `controllers.BarrierBackstepping` with exact derivatives.

    Args:
      scenario: the loop; its plant may differ from its model.
      parameters: path -> `factor`, `offset` or `value` of an `interval`.  Paths that are joined by
        commas ("plant.D, plant.N") vary together.
      duration: length of the time interval from t = 0 on [s]; a period of the scenario if not
        given.

    Raises:
      ValueError: a scenario or a parameter that is not supported; the message says why.
    """
    check_supported(scenario)
    with jax.enable_x64(True):
        scenario = canonical(astype(scenario, jnp.float64))
        parts = _parts_of(scenario)
        uncertain = uncertain_coordinates(scenario, parameters, None)
        length, is_period = time_interval(_varying(scenario), duration, uncertain)
        examined = _examined(scenario, parts, uncertain)
        zero = jnp.zeros(())
        numbers = Constants(
            parts, scenario.plant, scenario.disturbance, uncertain.numbers, zero, zero
        )
        structure = jax.tree.structure(numbers)
    observed = tuple(bool(gain > 0.0) for gain in np.asarray(parts.kappa)[:, 0])
    chain = _Chain(scenario, parts, uncertain, observed, structure, length)
    names, lower, upper = _coordinates(observed, length, uncertain)
    order = len(observed)
    digests = tuple(examined.digests)
    function: Any = ChainBound(structure, uncertain.places, observed, digests)
    point_rate: Any = ChainRate(structure, uncertain.places, observed, digests)
    return LevelSetProblem(
        names=names,
        lower=lower,
        upper=upper,
        patterns=patterns_of(order, length),
        bound=function,
        constants=chain.constants,
        point_rate=point_rate,
        sample=chain.sample,
        state_of=chain.state_of,  # type: ignore[arg-type]
        scenario_at=chain.scenario_at,
        scales=uncertain.scales(),
        duration=length,
        is_period=is_period,
        assumptions=(
            *ASSUMPTIONS,
            *claims_of(parts.law.barriers),
            *_without_claim(scenario),
            *examined.assumed,
        ),
    )


def _without_claim(scenario: Scenario) -> list[str]:
    """A sentence on the bounds about which a proof claims nothing; none where it claims all."""
    law: Any = scenario.controller
    levels = [
        f"x_{i + 1}"
        for i, (barrier, side) in enumerate(zip(law.barriers, scenario.bounds, strict=False))
        if isinstance(barrier, Quadratic) and side is not None
    ]
    if not levels:
        return []
    names = ", ".join(levels)
    return [f"Nothing is claimed about the bounds of {names}: a Quadratic barrier has none."]


def _coordinates(
    observed: tuple[bool, ...], duration: float, uncertain: Uncertain
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Names and ends of the coordinates; ends of angles are rounded outward."""
    order, estimates = len(observed), sum(observed)
    right, half = np.nextafter(0.5 * math.pi, 2.0), np.nextafter(math.pi, 4.0)
    count = order + estimates - 1
    lower, upper = np.zeros(count), np.full(count, right)
    # Terms of d_tilde have both signs, and those of the barriers the signs of a pattern.
    if estimates == 1:
        lower[-1] = -right
    if estimates > 1:
        upper[order:] = half
        lower[-1] = -half
    names = ["time since start", *(f"theta[{i}]" for i in range(count)), *uncertain.names]
    names += [*(f"side[{i}]" for i in range(order)), "start"]
    part = length_of_part(duration)
    lower = np.concatenate([[0.0], lower, uncertain.low])
    upper = np.concatenate([[part], upper, uncertain.high])
    return tuple(names), lower, upper


def _parts_of(scenario: Scenario) -> ChainParts:
    """The parts of V', with barriers without a guard."""
    law: Any = copy.copy(scenario.controller)
    guards = [[0.0 if isinstance(x, Quadratic) else x.guard] for x in law.barriers]
    barriers = []
    for barrier in law.barriers:
        free = copy.copy(barrier)
        if not isinstance(barrier, Quadratic):
            # The constructor refuses such a guard: only inside the guard is the barrier evaluated.
            object.__setattr__(free, "guard", -math.inf)
        barriers.append(free)
    object.__setattr__(law, "barriers", tuple(barriers))
    order = law.order
    gain: Any = jnp.zeros(())
    if isinstance(scenario.observer, observers.LevelObserver):
        gain = scenario.observer.gain
    bounds = scenario.bounds[:order]
    model = scenario.model.at(jnp.zeros(()))
    return ChainParts(
        model, law, _rows(gain, order), scenario.reference, bounds, jnp.asarray(guards)
    )


def _rows(value: jax.Array, order: int) -> jax.Array:
    """One number, one for each level or a column, as a column (order, 1)."""
    return jnp.broadcast_to(jnp.reshape(value, (-1, 1)), (order, 1))


def _varying(scenario: Scenario) -> dict[str, Any]:
    """The parts that may depend on time, by name."""
    given = {f"bounds[{i}]": bounds for i, bounds in enumerate(scenario.bounds)}
    return {"reference": scenario.reference, "disturbance": scenario.disturbance, **given}


def _sides_of(scenario: Scenario) -> dict[str, Any]:
    """The sides of all bounds, by name."""
    return {
        f"bounds[{i}].{side}": vars(bounds)[side]
        for i, bounds in enumerate(scenario.bounds)
        if bounds is not None
        for side in ("lower", "upper")
    }


# --- what is supported -------------------------------------------------------------------------


def check_supported(scenario: Any) -> None:
    """Raises ValueError, with the reason, for a scenario whose V' is not known here."""
    if not isinstance(scenario, Scenario):
        raise checks.fail("scenario", scenario, "a Scenario", "Make one with ij.presets.")
    _check_plant(scenario)
    _check_law(scenario)
    _check_observer(scenario)
    reasons = {
        "sampling": CONTINUOUS,
        "process_noise": "V' of a stochastic loop has further terms.",
    }
    check_absent(scenario, reasons, input="input", rate="d'")


def _check_plant(scenario: Scenario) -> None:
    for name in ("plant", "model"):
        part = vars(scenario)[name]
        kind = type(part).__name__
        if not plants.is_chain(part):
            reason = "This bound is that of plants with drift and gain."
            raise unsupported(name, kind, "a plant in strict-feedback form", reason)
        if plants.robot_of(part) is not None:
            reason = "Its disturbances are torques on a robot, which this bound does not contain."
            raise unsupported(name, kind, "a plant without a robot inside", reason)
        if part.n != 1:
            reason = "The signs of the errors and the level set of several numbers are not here."
            raise unsupported(f"{name}.n", part.n, "one number per level", reason)
        if part.order not in ORDERS:
            reason = "The derivatives of the law grow with each level."
            raise unsupported(f"{name}.order", part.order, "order 2 or 3", reason)
        if plants.nominal_of(part) is not part or jnp.size(jump_times_of(name, part)):
            reason = "The plant changes during the run."
            raise unsupported(name, kind, "a plant that does not change", reason)
        check_constant(f"scenario.{name}", part)
        functions = _functions_of(part)
        inputs = [jnp.zeros(()), jnp.zeros((part.order, 1))]
        if any(0 in operations(name, function, inputs).inputs for function in functions.values()):
            reason = "Its drift or its gain depends on the time, with a period that is not known."
            raise unsupported(name, kind, "a plant that does not depend on the time", reason)
    check_same_structure(scenario, f"a plant of the structure of {type(scenario.plant).__name__}")


def _functions_of(plant: Any) -> dict[str, Callable]:
    """Name and level -> what the law reads of a plant there, as a function of (t, x)."""
    one = jnp.ones(1)
    members = ["level_rate", "transposed_gain", "level_input"]
    if is_default(plant.level_input, plants.Plant.level_input):
        # That of the package is a function of drift and gain, which are in level_rate.
        members.remove("level_input")

    def at_level(member: str, level: int) -> Callable:
        def function(t: jax.Array, x: jax.Array) -> jax.Array:
            return vars(plants)[member](plant, level, t, x, one)  # type: ignore[no-any-return]

        return function

    levels = range(1, plant.order + 1)
    return {f"{member} of level {i}": at_level(member, i) for member in members for i in levels}


def _examined(scenario: Scenario, parts: ChainParts, uncertain: Uncertain) -> Examined:
    """What is assumed of the parts of a scenario.

    Raises:
      ValueError: a part that may jump, or one that contradicts its contract.
    """
    digests = _check_operations(scenario, uncertain)
    in_time = check_time_functions(scenario.reference, _sides_of(scenario), 1)
    for i, barrier in enumerate(parts.law.barriers):
        if type(barrier) not in BARRIERS:
            name = f"scenario.controller.barriers[{i}]"
            o = None if parts.law.o is None else parts.law.o[i]
            digests += check_barrier(name, barrier, o, n=1, homogeneous=False)
    assumed = [*in_time.assumed, *agreement_of_plant(scenario.plant)]
    return Examined(assumed, [*digests, *in_time.digests])


def _check_operations(scenario: Scenario, uncertain: Uncertain) -> list[str]:
    """The digests of plant and disturbance, with which d must not jump, and V with it.

    The law differentiates what it reads of the levels below the last one.
    """
    order = plants.order_of(scenario.plant)
    known = (scenario.plant, scenario.disturbance, scenario.model)
    leaves, structure = jax.tree.leaves(known), jax.tree.structure(known)
    inputs = [jnp.zeros(()), jnp.zeros((order, 1)), *leaves]
    varying = [0, 1, *(2 + leaf for leaf in uncertain.places.varying_leaves)]
    name = "scenario.plant and disturbance"

    def external(t: jax.Array, x: jax.Array, *numbers: jax.Array) -> Any:
        plant, disturbance, model = jax.tree.unflatten(structure, numbers)
        return chain_motion.external_at(disturbance, t, x, plant, model)

    digests = [check_operations(name, external, inputs, varying, kinks=True).digest]
    for method in _functions_of(scenario.plant):

        def function(t: jax.Array, x: jax.Array, *numbers: jax.Array, method=method) -> Any:
            plant, _, _ = jax.tree.unflatten(structure, numbers)
            return _functions_of(plant)[method](t, x)

        is_last = method.endswith(f"level {order}")
        found = check_operations(name, function, inputs, varying, kinks=is_last)
        digests.append(found.digest)
    return digests


def _check_law(scenario: Scenario) -> None:
    law: Any = scenario.controller
    if type(law) is not controllers.BarrierBackstepping:
        reason = "V' is known for barrier backstepping with exact derivatives."
        raise unsupported(
            "controller", type(law).__name__, "controllers.BarrierBackstepping", reason
        )
    if law.filter is not None:
        reason = "With filters V' has the errors of the filters, which are not in V."
        raise unsupported("controller.filter", law.filter, "exact derivatives (None)", reason)
    check_exponential(law, "V'")
    one = jnp.ones(1)
    tube = Tube(0.0 * one, 0.0 * one, -one, one, 0.0 * one, 0.0 * one)
    for i, barrier in enumerate(law.barriers):
        name, kind = f"controller.barriers[{i}]", type(barrier).__name__
        if barrier.decay_rate(one) is None:
            raise unsupported(name, kind, "a barrier with decay_rate", "V' contains its decay.")
        if i > 0 and not has_ratio(barrier):
            reason = "The law needs e/s above the first level."
            raise unsupported(name, kind, "a barrier with error_over_slope", reason)
        if isinstance(barrier, Quadratic):
            continue
        if barrier.error_at(one, tube, one > 0) is None:
            reason = "The level set needs the error at which V_i has a value, in closed form."
            raise unsupported(name, kind, "a barrier with error_at", reason)


def _check_observer(scenario: Scenario) -> None:
    observer = scenario.observer
    if type(observer) is observers.NoObserver:
        return
    if type(observer) is not observers.LevelObserver:
        reason = "V contains d_tilde of observers with d_tilde' = d' - kappa d_tilde only."
        expected = "observers.LevelObserver or NoObserver"
        raise unsupported("observer", type(observer).__name__, expected, reason)
    order = plants.order_of(scenario.plant)
    gain, eta0 = (np.asarray(_rows(x, order)) for x in (observer.gain, observer.eta0))
    if np.any(eta0[gain == 0.0]):
        reason = "A level without a gain keeps this estimate, which is taken as 0."
        raise unsupported("observer.eta0", observer.eta0, "0 where the gain is 0", reason)
