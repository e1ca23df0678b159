"""The level set of V of a plant in strict-feedback form as a `LevelSetProblem`.

The derivation is at the head of `chain_motion` and `chain_bound`.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control import controllers, observers
from iblf_jax.control.barriers import Quadratic
from iblf_jax.control.barriers._base import has_ratio
from iblf_jax.core.families import is_default
from iblf_jax.core.pytree import astype
from iblf_jax.proofs import chain_motion
from iblf_jax.proofs.chain_bound import (
    ChainMotionPoint,
    Constants,
    TruePlant,
    chain_bound,
    chain_motion_point,
    lyapunov_rate,
)
from iblf_jax.proofs.chain_motion import ChainParts
from iblf_jax.proofs.examination import operations
from iblf_jax.proofs.forms import along
from iblf_jax.proofs.parameters import Uncertain, uncertain_coordinates
from iblf_jax.proofs.problem import LevelSetProblem, OfStructure, split_point
from iblf_jax.proofs.support import (
    CONTINUOUS,
    REAL_NUMBERS,
    bounds_of,
    check_absent,
    check_exponential,
    check_same_structure,
    check_unchanging,
    claim_sentences,
    examined,
    infinite_unless_defined,
    operations_of_plant,
    time_interval,
    unit_tube,
    unsupported,
    without_guard,
)
from iblf_jax.proofs.uncertainty import Places
from iblf_jax.proofs.users_parts import agreement_of_plant
from iblf_jax.simulation.initial import Initial
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.world import plants
from iblf_jax.world.disturbances import Disturbance

ORDERS = (2, 3)
"""Numbers of levels for which the bound is small enough to be of use."""
ASSUMPTIONS = (
    REAL_NUMBERS,
    "The input of the law is applied as it is: without sampling, delay or saturation.",
    "The errors of the observer and the state are exactly those of the level set; measurements have"
    " no noise.",
)


@dataclasses.dataclass(frozen=True)
class ChainBound(OfStructure):
    """The bound of chains of one structure."""

    observed: tuple[bool, ...]

    def __call__(self, x: jax.Array, constants: list[jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Upper bounds of V' over a box, and no region."""
        numbers: Constants = jax.tree.unflatten(self.structure, constants)
        return chain_bound(self.places, self.observed, x, numbers), jnp.zeros((0,))


@dataclasses.dataclass(frozen=True)
class ChainRate(OfStructure):
    """V' at a point of chains of one structure."""

    observed: tuple[bool, ...]

    def __call__(self, point: jax.Array, constants: list[jax.Array]) -> jax.Array:
        """V', (); infinite where d is not defined."""
        numbers: Constants = jax.tree.unflatten(self.structure, constants)
        true, at = point_of(self.places, self.observed, jnp.asarray(point), numbers)
        rate = lyapunov_rate(numbers, self.observed, true, at)
        return infinite_unless_defined(rate, jnp.stack(at.now.d))


def point_of(
    places: Places, observed: tuple[bool, ...], point: jax.Array, constants: Constants
) -> tuple[TruePlant, ChainMotionPoint]:
    """The plant and the motion at a point (t, s, z); s/|s| = (sqrt(w_i V_i/c) with the signs of
    e_i, sqrt(v_i/(2c)) d_tilde_i).
    """
    order = len(observed)
    t, s, z = split_point(point, order + sum(observed))
    true = TruePlant(constants, places, z, is_box=False)
    signs = jnp.where(s[:order] > 0, 1.0, -1.0)
    return true, chain_motion_point(constants, observed, true, t, list(s), signs)


class ChainLevelSetState(NamedTuple):
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
class ChainProblem(LevelSetProblem):
    """The proof problem of a plant in strict-feedback form."""

    bound: ChainBound
    parts: ChainParts
    units: ClassVar[tuple[str, str]] = ("1", "energy")
    first_barrier: ClassVar[str] = "first barrier"

    @property
    def angles(self) -> list[tuple[str, float, float]]:
        """One fewer than terms of V.

        Terms of d_tilde have both signs, and those of the barriers the signs of a pattern.
        """
        right, half = np.nextafter(0.5 * math.pi, 2.0), np.nextafter(math.pi, 4.0)
        count, estimates = self.term_count - 1, self.term_count - self.sign_count
        lower, upper = np.zeros(count), np.full(count, right)
        if estimates == 1:
            lower[-1] = -right
        if estimates > 1:
            upper[self.sign_count :] = half
            lower[-1] = -half
        return [(f"theta[{i}]", lower[i], upper[i]) for i in range(count)]

    @property
    def sign_count(self) -> int:
        """Order of the plant: the error of each level has a sign."""
        return self.parts.order

    @property
    def term_count(self) -> int:
        """Number of levels and of estimates."""
        return self.sign_count + sum(self.bound.observed)

    def constants_of(self, weight: float, level: float) -> Constants:
        """The constants of a weight, with v_i = weight w_i s_i'(0)/(k_i kappa_i), and a level."""
        law = self.parts.law
        # The weight of a level that is not observed is `weight`.
        scales = np.ones((self.sign_count, 1))
        t, zero, one = jnp.zeros(()), jnp.zeros(1), jnp.ones(1)
        for i in np.flatnonzero(self.bound.observed).tolist():
            # s_i' at e_i = 0 and t = 0 in the tube around the middle of the bounds.
            tube, bounds = unit_tube(), self.parts.bounds[i]
            if bounds is not None:
                width = bounds.upper.at(t, zero) - bounds.lower.at(t, zero)
                half = 0.5 * width * one
                tube = tube._replace(lower=-half, upper=half)
            slope = along(partial(law.barriers[i].slope, tube), (zero,), (one,))
            scales[i] = np.asarray(law.weights[i] * slope / (law.k[i] * self.parts.kappa[i]))
        return Constants(
            self.parts,
            cast(plants.Plant, self.scenario.plant),
            self.scenario.disturbance,
            self.uncertain.numbers,
            jnp.asarray(weight * scales),
            jnp.asarray(level),
        )

    @jax.enable_x64(True)
    def state_of(self, point: np.ndarray, constants: Sequence[np.ndarray]) -> ChainLevelSetState:
        """A point in physical numbers."""
        numbers: Constants = jax.tree.unflatten(
            self.bound.structure, list(map(jnp.asarray, constants))
        )
        x = jnp.asarray(point, float)
        _, at = point_of(self.uncertain.places, self.bound.observed, x, numbers)
        y = at.now.y
        d_hat = np.stack(y.d_hat)
        return ChainLevelSetState(
            t=float(y.t),
            x=np.asarray(at.x),
            u=np.asarray(at.u),
            d_tilde=np.stack(at.now.d_tilde),
            d_hat=d_hat,
            eta=d_hat - np.asarray(self.parts.kappa) * np.asarray(at.x),
            parameters=self.uncertain.values(np.asarray(point)[1 + self.term_count :]),
        )

    def initial(self, state: ChainLevelSetState) -> Initial:
        """All levels of a state."""
        return Initial(x=state.x)


def chain_problem(
    scenario: Scenario,
    parameters: Mapping[str, Perturbation],
    *,
    duration: float | None = None,
) -> ChainProblem:
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
        law = parts.law
        uncertain = uncertain_coordinates(scenario, parameters, None)
        varying = {
            "reference": scenario.reference,
            "disturbance": scenario.disturbance,
            **bounds_of(scenario),
        }
        length, is_period = time_interval(varying, duration, uncertain)
        gains = [None] * law.order if law.o is None else law.o
        barriers = {
            f"barriers[{i}]": pair for i, pair in enumerate(zip(law.barriers, gains, strict=True))
        }
        digests = _digests(scenario, uncertain)
        examination = examined(scenario, digests, agreement_of_plant, barriers, homogeneous=False)
        observed = tuple(bool(gain > 0.0) for gain in np.asarray(parts.kappa)[:, 0])
        true = (cast(plants.Plant, scenario.plant), scenario.disturbance)
        zero = jnp.zeros(())
        structure = jax.tree.structure(Constants(parts, *true, uncertain.numbers, zero, zero))
    of_structure = (structure, uncertain.places, tuple(examination.digests), observed)
    claims = (*claim_sentences(law.barriers), *_without_claim(scenario))
    assumptions = (*ASSUMPTIONS, *claims, *examination.assumed)
    functions = (ChainBound(*of_structure), ChainRate(*of_structure), None)
    return ChainProblem(
        scenario, uncertain, *functions, None, length, is_period, assumptions, parts
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


def _parts_of(scenario: Scenario) -> ChainParts:
    """The parts of V', with barriers without a guard."""
    law = cast(controllers.BarrierBackstepping, copy.copy(scenario.controller))
    guards = [[0.0 if isinstance(x, Quadratic) else x.guard] for x in law.barriers]
    object.__setattr__(law, "barriers", tuple(map(without_guard, law.barriers)))
    gain = jnp.zeros(())
    if isinstance(scenario.observer, observers.LevelObserver):
        gain = scenario.observer.gain
    order = law.order
    return ChainParts(
        cast(plants.Plant, scenario.model).at(jnp.zeros(())),
        law,
        _rows(gain, order),
        scenario.reference,
        scenario.bounds[:order],
        jnp.asarray(guards),
    )


def _rows(value: jax.Array, order: int) -> jax.Array:
    """One number, one for each level or a column, as a column (order, 1)."""
    return jnp.broadcast_to(jnp.reshape(value, (-1, 1)), (order, 1))


# --- what is supported -------------------------------------------------------------------------


def check_supported(scenario: Scenario) -> None:
    """Raises ValueError, with the reason, for a scenario whose V' is not known here."""
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
        robot = plants.as_plant(part).robot
        if robot is part:
            reason = "This bound is that of plants with drift and gain."
            raise unsupported(name, kind, "a plant in strict-feedback form", reason)
        if robot is not None:
            reason = "Its disturbances are torques on a robot, which this bound does not contain."
            raise unsupported(name, kind, "a plant without a robot inside", reason)
        if part.n != 1:
            reason = "The signs of the errors and the level set of several numbers are not here."
            raise unsupported(f"{name}.n", part.n, "one number per level", reason)
        if part.order not in ORDERS:
            reason = "The derivatives of the law grow with each level."
            raise unsupported(f"{name}.order", part.order, "order 2 or 3", reason)
        reason = "The plant changes during the run."
        check_unchanging(name, part, "a plant that does not change", reason)
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


def _digests(scenario: Scenario, uncertain: Uncertain) -> list[str]:
    """The digests of plant and disturbance, with which d must not jump, and V with it.

    The law differentiates what it reads of the levels below the last one.
    """
    order = plants.order_of(scenario.plant)
    parts = (scenario.plant, scenario.disturbance, scenario.model)
    inputs = [jnp.zeros(()), jnp.zeros((order, 1))]

    def external(
        t: jax.Array,
        x: jax.Array,
        plant: plants.Plant,
        disturbance: Disturbance,
        model: plants.Plant,
    ) -> chain_motion.External:
        return chain_motion.external_at(disturbance, t, x, plant, model)

    digests = [operations_of_plant(external, inputs, parts, uncertain).digest]
    for method in _functions_of(scenario.plant):

        def function(
            t: jax.Array, x: jax.Array, plant: plants.Plant, *others: Any, method: str = method
        ) -> jax.Array:
            return _functions_of(plant)[method](t, x)  # type: ignore[no-any-return]

        kinks = method.endswith(f"level {order}")
        found = operations_of_plant(function, inputs, parts, uncertain, kinks=kinks)
        digests.append(found.digest)
    return digests


def _check_law(scenario: Scenario) -> None:
    law = scenario.controller
    if type(law) is not controllers.BarrierBackstepping:
        reason = "V' is known for barrier backstepping with exact derivatives."
        raise unsupported(
            "controller", type(law).__name__, "controllers.BarrierBackstepping", reason
        )
    if law.filter is not None:
        reason = "With filters V' has the errors of the filters, which are not in V."
        raise unsupported("controller.filter", law.filter, "exact derivatives (None)", reason)
    if law.addition:
        reason = "V' is known for (S.2) alone."
        raise unsupported("controller", law.addition, "nothing beside (S.2)", reason)
    check_exponential(law, "V'")
    one, tube = jnp.ones(1), unit_tube()
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
