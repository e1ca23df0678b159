"""The level set of V_w of a rigid arm as a `LevelSetProblem`.

The derivation is at the head of `arm_motion` and `arm_bound`.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.control import controllers, observers, sensors
from iblf_jax.control.actuators import Ideal
from iblf_jax.core import checks
from iblf_jax.core.linalg import matvec
from iblf_jax.core.pytree import astype
from iblf_jax.proofs import arm_held, arm_motion, uncertainty
from iblf_jax.proofs.arm_bound import Constants, arm_bound
from iblf_jax.proofs.arm_limits import limited_bound
from iblf_jax.proofs.arm_motion import ArmParts, Errors, position
from iblf_jax.proofs.arm_torque import cut, torque_excess
from iblf_jax.proofs.matrices import solve_transposed, upper_factor
from iblf_jax.proofs.parameters import Uncertain, uncertain_coordinates
from iblf_jax.proofs.problem import (
    HeldFunctions,
    LevelSetProblem,
    LevelSetState,
    OfStructure,
    TorqueFunctions,
    split_point,
)
from iblf_jax.proofs.support import (
    INSTANTS,
    REAL_NUMBERS,
    SAMPLED_REAL_NUMBERS,
    bounds_of,
    check_absent,
    check_exponential,
    check_same_structure,
    check_unchanging,
    claim_sentences,
    examined,
    has_delay,
    infinite_unless_defined,
    operations_of_plant,
    time_interval,
    unit_tube,
    unsupported,
    without_guard,
)
from iblf_jax.proofs.torque import without_limits
from iblf_jax.proofs.uncertainty import Places
from iblf_jax.proofs.users_parts import agreement_of_robot
from iblf_jax.simulation.initial import Initial
from iblf_jax.simulation.sampling import Sampling
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.world import plants
from iblf_jax.world.bounds import tube_at
from iblf_jax.world.disturbances import Disturbance
from iblf_jax.world.references import WaypointSpline
from iblf_jax.world.robots import Robot

APPLIED = "The torque {torque} is applied as it is: without {parts} or delay."
HELD_TORQUE = (
    "Law and observer read {readings} at the same instant every {period:g} s, and their"
    " torque is held from this instant to the next one; the observer makes a step of the kind"
    ' "{observer}" meanwhile.'
)
DELAYED_TORQUE = (
    "Law and observer read {readings} at the same instant every {period:g} s; their torque arrives"
    " at most {delay:g} s later, at all joints at once and by a delay that may differ from sample"
    " to sample, and is held until the next one arrives; the observer makes a step of the kind"
    ' "{observer}" with it from its sample on.'
)
STARTS_AT_SAMPLE = (
    "A run starts at a sample, so that each torque is one that the law commanded inside the set."
)
STARTS_WITH_DELAY = (
    "A run starts at a sample, with a torque of the actuator, constant until the first command"
    " arrives, near that of the law as stated above."
)
BETWEEN_SAMPLES = (
    "V_w of a state between samples is that of the torque that the law would command there, and of"
    " the estimate interpolated by (G.6)."
)
ACTIVE_LIMITS = (
    "The limits cut the torque of the law, and the observer receives what is left. V_w is that of"
    " the torque before the limits."
)
"""What is added where limits of the torque may be active."""
ENCODERS = (
    "V_w is that of the true state, and of the estimate that the observer would give with the true"
    " momentum; a torque on the set differs from the law's one at the true state by what the errors"
    " of the measurement change."
)
"""What is added for errors of measurements."""
ROUNDING = 1.0 + 1e-12
"""Factor of the bound of such an error, which is computed in double precision."""
EXACT = (
    "The observer's error and the state are exactly those of the level set; measurements have no"
    " noise."
)
MOST_NUMBERS = 6
"""Largest number m of uncertain numbers: the bound has a copy of its terms for each of 2^m corners.
Plants in strict-feedback form have a bound without corners."""
VECTORS = ("q", "dq", "f_tilde", "f_hat", "eta")
"""Vectors of a point in physical numbers, as in `LevelSetState`."""


class ArmBound(OfStructure):
    """The bound of arms of one structure."""

    def __call__(self, x: jax.Array, constants: list[jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Upper bounds of V_w' over a box, and no region."""
        numbers: Constants = jax.tree.unflatten(self.structure, constants)
        n = numbers.parts.kf.shape[0]
        return arm_bound(self.places, n, x, numbers), jnp.zeros((0,))


class LimitedArmBound(OfStructure):
    """The bound of arms of one structure whose limits of the torque may be active."""

    def __call__(self, x: jax.Array, constants: list[jax.Array]) -> tuple[jax.Array, jax.Array]:
        """The upper bound of V_w' over a box, and no region."""
        numbers: Constants = jax.tree.unflatten(self.structure, constants)
        n = numbers.parts.kf.shape[0]
        return limited_bound(self.places, n, x, numbers), jnp.zeros((0,))


class ArmRate(OfStructure):
    """V_w' at a point of arms of one structure."""

    def __call__(self, point: jax.Array, constants: list[jax.Array]) -> jax.Array:
        """V_w', () [N m rad/s]; infinite where the torque is not defined, such as log(-1)."""
        numbers: Constants = jax.tree.unflatten(self.structure, constants)
        at = point_of(self.places, jnp.asarray(point), numbers)
        rate = arm_motion.lyapunov_rate(at.parts, numbers.weight, at.errors, at.f_tilde, at.rate)
        rate = infinite_unless_defined(rate, torque_of(at))
        D = cut_of(at)
        return rate if D is None else rate + addition(at, numbers.weight, D, jnp.zeros_like(D))


class SampledArmBound(OfStructure):
    """The bound of sampled arms of one structure."""

    def __call__(self, x: jax.Array, constants: list[jax.Array]) -> tuple[jax.Array, jax.Array]:
        """The upper bound of V_w' over a box, and no region; the last constant are bounds of the
        rates.
        """
        *leaves, limits = constants
        numbers: Constants = jax.tree.unflatten(self.structure, leaves)
        n = numbers.parts.kf.shape[0]
        rates = arm_held.rate_limits(numbers.parts, limits)
        return arm_held.held_bound(self.places, n, x, numbers, rates), jnp.zeros((0,))


class HeldRatesExcess(OfStructure):
    """The bound of the rates of sampled arms of one structure, in parts of their limits."""

    def __call__(self, x: jax.Array, constants: list[jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Its upper bound over a box, and no region; the last constant are the limits."""
        *leaves, limits = constants
        numbers: Constants = jax.tree.unflatten(self.structure, leaves)
        rates = arm_held.rate_limits(numbers.parts, limits)
        return arm_held.rate_excess(self.places, x, numbers, rates), jnp.zeros((0,))


class HeldRates(OfStructure):
    """The rates of a held torque at a point of sampled arms of one structure."""

    def __call__(self, point: jax.Array, constants: list[jax.Array]) -> jax.Array:
        """Those at the age 0, (3, n) [N m/s], and with errors of measurements or active limits E_u
        and E_L below them [N m].
        """
        numbers: Constants = jax.tree.unflatten(self.structure, constants)
        at = point_of(self.places, jnp.asarray(point), numbers)
        D = cut_of(at)
        rates = [*arm_held.rates_at(at.parts, at.errors, at.f_tilde, D)]
        if at.parts.measurement_error is not None:
            rates += arm_held.first_sizes(at.parts, at.errors)
        if D is not None:
            rates += [D, jnp.zeros_like(D)]
        return jnp.stack(rates)


class HeldGrowth(OfStructure):
    """The largest V_w' at a point of sampled arms of one structure while the torque is foreign."""

    def __call__(self, point: jax.Array, constants: list[jax.Array]) -> jax.Array:
        """That for all D, L and f' within the bounds of the last constant, () [N m rad/s]."""
        *leaves, rows = constants
        numbers: Constants = jax.tree.unflatten(self.structure, leaves)
        at = point_of(self.places, jnp.asarray(point), numbers)
        limits = arm_held.PathRates(*rows)
        h, d = arm_held.period(at.parts), arm_held.oldest_age(at.parts)
        sizes = (d * limits.command, h * (limits.lag + limits.command))
        zero = jnp.zeros_like(at.f_tilde)
        # It is affine in D and L.
        slopes = jax.grad(lambda *x: addition(at, numbers.weight, *x), (0, 1))(zero, zero)
        rate = arm_motion.lyapunov_rate(at.parts, numbers.weight, at.errors, at.f_tilde)
        rate = rate + arm_held.bias_addition(at.parts, numbers.weight, at.errors, at.f_tilde)
        for slope, size in zip(slopes, sizes, strict=True):
            rate = rate + jnp.sum(jnp.abs(slope) * size)
        more = numbers.weight * jnp.sum(jnp.abs(at.f_tilde) * limits.mismatch)
        return rate + more


class SampledArmRate(OfStructure):
    """V_w' at a point of sampled arms of one structure, to first order in the period."""

    def __call__(self, point: jax.Array, constants: list[jax.Array]) -> jax.Array:
        """The largest one of those at the ages of the torque between which it is affine, without
        errors of measurements, () [N m rad/s].
        """
        numbers: Constants = jax.tree.unflatten(self.structure, constants)
        at = point_of(self.places, jnp.asarray(point), numbers)
        rate = arm_motion.lyapunov_rate(at.parts, numbers.weight, at.errors, at.f_tilde)
        rate = rate + arm_held.bias_addition(at.parts, numbers.weight, at.errors, at.f_tilde)
        zero, limits, u = jnp.zeros_like(at.f_tilde), at.parts.torque_limits, torque_of(at)
        rates = arm_held.rates_at(at.parts, at.errors, at.f_tilde, cut_of(at))
        ages = [(zero, zero), *arm_held.differences_of_ages(at.parts, rates)]
        D, L = (jnp.stack(rows) for rows in zip(*ages, strict=True))
        if limits is not None:
            # A limit cuts the command u + D of the sample.
            D = D + cut(u + D, limits)
        # The program of all ages in turn would be several times as long.
        found = jax.vmap(lambda D, L: addition(at, numbers.weight, D, L))(D, L)
        return infinite_unless_defined(rate + jnp.max(found), u)


class ArmTorqueExcess(OfStructure):
    """The distance of the torque of arms of one structure from an interval."""

    def __call__(self, x: jax.Array, constants: list[jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Its upper bound over a box, and no region; the last two constants are the ends."""
        *leaves, lowest, highest = constants
        numbers: Constants = jax.tree.unflatten(self.structure, leaves)
        return torque_excess(self.places, x, numbers, lowest, highest), jnp.zeros((0,))


class ArmTorque(OfStructure):
    """The torque at a point of arms of one structure."""

    def __call__(self, point: jax.Array, constants: list[jax.Array]) -> jax.Array:
        """The torque that the true plant needs, which is that of the law, (n,) [N m]."""
        numbers: Constants = jax.tree.unflatten(self.structure, constants)
        return torque_of(point_of(self.places, jnp.asarray(point), numbers))


class ArmPoint(NamedTuple):
    """A point of the level set with its true plant."""

    parts: ArmParts
    errors: Errors
    f_tilde: jax.Array
    rate: jax.Array | float
    """Rate of the further disturbance, (n,) [N m/s]."""


def cut_of(at: ArmPoint) -> jax.Array | None:
    """What limits cut from the torque of the law at a point, (n,) [N m]; None without active
    limits.
    """
    limits = at.parts.torque_limits
    return None if limits is None else cut(torque_of(at), limits)


def addition(at: ArmPoint, weight: jax.Array, D: jax.Array, L: jax.Array) -> jax.Array:
    """What D and L add to V_w' at a point by (H.3), () [N m rad/s]."""
    return arm_held.held_addition(at.parts, weight, at.errors, at.f_tilde, D, L)


def torque_of(at: ArmPoint) -> jax.Array:
    """The torque of the law at a point, which the true plant needs for the motion, (n,) [N m]."""
    now = arm_motion.kinematics(at.parts, at.errors, at.f_tilde)
    return arm_motion.required_torque(at.parts, now)


def point_of(places: Places, point: jax.Array, constants: Constants) -> ArmPoint:
    """The errors, f_tilde and the plant at a point (t, s, z).

    s/|s| = (sqrt(w V1/c) with the signs of e1, U^T e2/sqrt(2c), sqrt(w_f/(2c)) f_tilde).
    """
    parts, level = constants.parts._replace(is_at_numbers=True), constants.level
    n = parts.kf.shape[0]
    t, s, z = split_point(point, 3 * n)
    energy = level * s[:n] ** 2
    xi = arm_motion.error_at(parts, t, energy, s[:n])
    errors = Errors(t, xi, jnp.zeros(n))
    U = upper_factor(parts.model.mass_matrix(position(parts, errors)))
    size = jnp.sqrt(2.0 * level)
    e2 = solve_transposed(U, size * s[n : 2 * n])
    f_tilde = size / jnp.sqrt(constants.weight) * s[2 * n :]
    m = len(places.entries)
    uncertain = (parts.plant, parts.disturbance)
    plant, disturbance = uncertainty.leaves_at(places, constants.coordinates, uncertain, z[:m])
    rate = z[m:] if places.rates else 0.0
    true = parts._replace(plant=plant, disturbance=disturbance)
    return ArmPoint(true, errors._replace(e2=e2), f_tilde, rate)


@dataclasses.dataclass(frozen=True, eq=False)
class ArmProblem(LevelSetProblem):
    """The proof problem of an arm."""

    bound: ArmBound | SampledArmBound | LimitedArmBound
    parts: ArmParts
    units: ClassVar[tuple[str, str]] = ("rad/(N m)", "N m rad")
    first_barrier: ClassVar[str] = "barrier"

    @property
    def limits_may_be_active(self) -> bool:
        """Whether the statement is that of a loop whose limits of the torque may be active."""
        return self.parts.torque_limits is not None

    @property
    def angles(self) -> list[tuple[str, float, float]]:
        """The theta of V1, psi, and the phi of e2."""
        n = self.sign_count
        right, full = np.nextafter(0.5 * math.pi, 2.0), np.nextafter(2.0 * math.pi, 7.0)
        theta = [(f"theta[{i}]", 0.0, right) for i in range(n)]
        if n == 1:
            return [*theta, ("psi", 0.0, 2.0 * right)]
        ends = [*[2.0 * right] * (n - 2), full]
        phi = [(f"phi[{i}]", 0.0, end) for i, end in enumerate(ends)]
        return [*theta, ("psi", 0.0, right), *phi]

    @property
    def sign_count(self) -> int:
        """Number of joints: each e1 has a sign."""
        return self.scenario.n

    @property
    def term_count(self) -> int:
        """3 n: those of V1, of e2 and of f_tilde."""
        return 3 * self.scenario.n

    def constants_of(self, weight: float, level: float) -> Constants:
        """The constants of a weight w_f and a level."""
        coordinates = self.uncertain.numbers
        return Constants(self.parts, coordinates, jnp.asarray(weight), jnp.asarray(level))

    def state_of(self, point: np.ndarray, constants: Sequence[np.ndarray]) -> LevelSetState:
        """A point in physical numbers."""
        with jax.enable_x64(True):
            numbers = _physical(self.bound, np.asarray(point, float), list(constants))
            return LevelSetState(
                t=float(numbers["t"]),
                **{name: np.asarray(numbers[name]) for name in VECTORS},
                parameters=self.uncertain.values(np.asarray(point)[1 + self.term_count :]),
                rate=np.broadcast_to(np.asarray(numbers["rate"]), (self.bound.places.rates,)),
            )

    def initial(self, state: LevelSetState) -> Initial:
        """Position and velocity of a state."""
        return Initial(q=state.q, dq=state.dq)


@functools.partial(jax.jit, static_argnums=0)
def _physical(
    bound: OfStructure, point: jax.Array, constants: list[jax.Array]
) -> dict[str, jax.Array]:
    """Time, position, velocity, f_tilde, f_hat, eta and the further rate at a point."""
    at = point_of(bound.places, point, jax.tree.unflatten(bound.structure, constants))
    parts, errors = at.parts, at.errors
    now = arm_motion.kinematics(parts, errors, at.f_tilde)
    f_hat = arm_motion.mismatch_torque(parts, now) - at.f_tilde
    eta = f_hat - parts.kf * matvec(parts.model.mass_matrix(now.q), now.v)
    vectors = dict(zip(VECTORS, (now.q, now.v, at.f_tilde, f_hat, eta), strict=True))
    return {"t": errors.t, "rate": jnp.asarray(at.rate), **vectors}


def arm_problem(
    scenario: Scenario,
    parameters: Mapping[str, Perturbation],
    *,
    duration: float | None = None,
    disturbance_rate: ArrayLike | None = None,
) -> ArmProblem:
    """The proof problem of a rigid arm under the corrected backstepping law.

    Args:
      scenario: the loop; its plant may differ from its model.
      parameters: path -> `factor`, `offset` or `value` of an `interval`.  Paths that are joined by
        commas ("plant.mass[0], plant.inertia[0]") vary together.
      duration: length of the time interval from t = 0 on [s]; a period of the scenario if not
        given.
      disturbance_rate: bound of the rate of a further disturbance, which is in f, () or (n,)
        [N m/s]; none if not given.

    Raises:
      ValueError: a scenario or a parameter that is not supported; the message says why.
    """
    check_supported(without_limits(scenario)[0])
    with jax.enable_x64(True):
        scenario = canonical(astype(scenario, jnp.float64))
        free, limits = without_limits(scenario)
        _check_rate(disturbance_rate, limits, scenario.sampling)
        _check_limits(limits, scenario)
        parts = _parts_of(free)
        uncertain = uncertain_coordinates(scenario, parameters, disturbance_rate)
        _check_count(len(uncertain.low))
        varying = {
            "reference": scenario.reference,
            **bounds_of(scenario),
            "disturbance": scenario.disturbance,
        }
        length, is_period = time_interval(varying, duration, uncertain)
        digests = _digests(parts, uncertain)
        barriers = {"barrier": (parts.law.barrier, parts.law.o)}
        examination = examined(scenario, digests, agreement_of_robot, barriers, homogeneous=True)
        _check_tube(scenario, length)
        _check_mass_matrices(parts, uncertain)
        limited_parts = None
        if limits is not None and _law_has_limits(scenario, limits):
            limited_parts = parts._replace(torque_limits=jnp.asarray(limits))
    claims = claim_sentences([parts.law.barrier])
    has_torque = disturbance_rate is None and parts.measurement_error is None

    def problem(parts: ArmParts, more: Sequence[str], **fields: Any) -> ArmProblem:
        """The problem of a loop with these parts."""
        zero = jnp.zeros(())
        structure = jax.tree.structure(Constants(parts, uncertain.numbers, zero, zero))
        of_structure = (structure, uncertain.places, tuple(examination.digests))
        within = limits if parts.torque_limits is None else None
        torque = TorqueFunctions(ArmTorque(*of_structure), ArmTorqueExcess(*of_structure), within)
        bound: ArmBound | SampledArmBound | LimitedArmBound = ArmBound(*of_structure)
        rate: ArmRate | SampledArmRate = ArmRate(*of_structure)
        held_torque = None
        if parts.torque_limits is not None:
            bound = LimitedArmBound(*of_structure)
        if scenario.sampling is not None:
            bound, rate = SampledArmBound(*of_structure), SampledArmRate(*of_structure)
            growth = None if parts.delay is None else HeldGrowth(*of_structure)
            held_torque = HeldFunctions(
                HeldRates(*of_structure), HeldRatesExcess(*of_structure), growth
            )
        return ArmProblem(
            scenario,
            uncertain,
            bound,
            rate,
            torque if has_torque else None,
            held_torque,
            length,
            is_period,
            (
                *_timing(scenario, limits, parts),
                *more,
                EXACT,
                *claims,
                *examination.assumed,
            ),
            parts,
            **fields,
        )

    active = None if limited_parts is None else problem(limited_parts, [ACTIVE_LIMITS])
    return problem(parts, [], with_active_limits=active)


def _law_has_limits(scenario: Scenario, limits: np.ndarray) -> bool:
    """Whether the law itself cuts the torque at the limits, so that the observer receives what is
    applied, and nothing else changes with it.
    """
    law = scenario.controller
    if type(law) is not controllers.Saturated or law.has_auxiliary:
        return False
    without_motor = dataclasses.replace(scenario, actuator=Ideal())
    return bool(np.array_equal(np.asarray(without_limits(without_motor)[1]), limits))


# --- what is supported -------------------------------------------------------------------------


def check_supported(scenario: Scenario) -> None:
    """Raises ValueError, with the reason, for a scenario without limits of the torque whose V_w' is
    not known here.
    """
    _check_plant(scenario)
    # It comes before the law, whose claims are compiled.
    _check_sampling(scenario)
    _check_law(scenario.controller)
    observer = scenario.observer
    if type(observer) is not observers.Momentum:
        reason = "The error of this observer does not obey f_tilde' = f' - kf f_tilde."
        raise unsupported("observer", type(observer).__name__, "observers.Momentum", reason)
    reasons = {"process_noise": "V_w' of a stochastic loop has further terms."}
    check_absent(scenario, reasons, input="torque", rate="f'")
    if scenario.bounds[1] is not None:
        reason = "The level set bounds positions only."
        raise unsupported("bounds[1]", "Bounds", "None", reason)
    if scenario.regions:
        names = ", ".join(type(region).__name__ for region in scenario.regions)
        reason = "The level set bounds positions of joints only."
        raise unsupported("regions", names, "()", reason)
    if isinstance(scenario.reference, WaypointSpline):
        reason = "The piece of a spline depends on the time, which is an interval here."
        expected = "a reference without pieces, such as references.Quintic"
        raise unsupported("reference", "WaypointSpline", expected, reason)
    smooth = arm_motion.smoothness(scenario.reference, scenario.bounds[0])
    if smooth < 2:
        reason = "f contains alpha', and with it two derivatives of reference and bounds."
        expected = "two continuous derivatives in time"
        raise unsupported("reference and bounds", f"{smooth:g}", expected, reason)


def _check_sampling(scenario: Scenario) -> None:
    """Raises ValueError for samples of which the age of the torque, or what the law reads, is not
    known here.
    """
    sampling = scenario.sampling
    if sampling is None:
        return
    _check_sensor(scenario.sensor)
    if sampling.trigger is not None:
        reason = "A command that is not sent leaves an old torque, whose age has no bound."
        raise unsupported("sampling.trigger", type(sampling.trigger).__name__, "None", reason)
    delay, period = float(sampling.delay), float(sampling.period)
    if delay > period:
        reason = "The bound is that of the last command or the one before it."
        raise unsupported("sampling.delay", delay, f"at most a period, {period:g} s", reason)
    if has_delay(scenario) and type(scenario.sensor) is not sensors.Ideal:
        reason = "The bound of a delayed torque is that of exact measurements."
        expected = "sensors.Ideal with a delay"
        raise unsupported("sensor", type(scenario.sensor).__name__, expected, reason)


def _check_sensor(sensor: sensors.AnySensor) -> None:
    """Raises ValueError for a sensor whose errors have no bound by those of a single sample."""
    if type(sensor) is sensors.Ideal:
        return
    expected = "sensors.Ideal, or an Encoder with velocity=sensors.Measured() and without noise"
    if type(sensor) is not sensors.Encoder:
        reason = "The errors of this sensor have no bound here."
        raise unsupported("sensor", type(sensor).__name__, expected, reason)
    if type(sensor.velocity) is not sensors.Measured:
        reason = "A velocity from positions of several samples has an error that the bound lacks."
        raise unsupported("sensor.velocity", type(sensor.velocity).__name__, expected, reason)
    for name, noise in (("noise", sensor.noise), ("velocity.noise", sensor.velocity.noise)):
        if noise is not None and np.any(np.asarray(noise) > 0.0):
            reason = "Normal noise has no bound, so that no set is invariant under it."
            raise unsupported(f"sensor.{name}", np.asarray(noise).tolist(), expected, reason)


def _measurement_error(sensor: sensors.AnySensor, n: int) -> jax.Array | None:
    """Bound of the errors of positions, (n,) [rad]; None if they are exact."""
    if type(sensor) is not sensors.Encoder:
        return None
    # Half of a count, and the offset, which the law does not know.
    size = ROUNDING * (0.5 * sensor.resolution + jnp.abs(jnp.asarray(sensor.offset)))
    if not np.any(np.asarray(size) > 0.0):
        return None
    return jnp.broadcast_to(size, (n,))


def _check_limits(limits: np.ndarray | None, scenario: Scenario) -> None:
    """Raises ValueError for limits of a torque that is not the law's one at a state of the set."""
    if limits is None:
        return
    sensor, sampling = scenario.sensor, scenario.sampling
    if type(sensor) is not sensors.Ideal:
        reason = "The bound of the torque is that of exact measurements. Leave out the limits."
        expected = "sensors.Ideal with torque limits"
        raise unsupported("sensor", type(sensor).__name__, expected, reason)
    if sampling is not None and has_delay(scenario):
        reason = "The torque before the first command is not one of the law. Leave out the limits."
        raise unsupported("sampling.delay", float(sampling.delay), "0 s with torque limits", reason)


def _timing(scenario: Scenario, limits: np.ndarray | None, parts: ArmParts) -> list[str]:
    """Sentences on time and on how the torque is applied."""
    sampling, error = scenario.sampling, parts.measurement_error
    if sampling is None:
        if parts.torque_limits is not None:
            return [REAL_NUMBERS, APPLIED.format(torque="that the limits leave", parts="sampling")]
        without = "sampling, saturation" if limits is None else "sampling"
        return [REAL_NUMBERS, APPLIED.format(torque="of the law", parts=without)]
    readings = "exact measurements"
    more: list[str] = []
    if error is not None:
        sizes = ", ".join(f"{size:.3g}" for size in np.asarray(error))
        readings = f"positions with errors of at most {sizes} rad, and exact velocities,"
        more = [ENCODERS]
    torque, start = HELD_TORQUE, STARTS_AT_SAMPLE
    if parts.delay is not None:
        torque, start = DELAYED_TORQUE, STARTS_WITH_DELAY
    numbers = {
        "period": float(sampling.period),
        "delay": float(sampling.delay),
        "observer": sampling.observer,
    }
    of_samples = torque.format(readings=readings, **numbers)
    return [SAMPLED_REAL_NUMBERS, of_samples, f"{start} {BETWEEN_SAMPLES}", *more]


def _check_rate(
    disturbance_rate: ArrayLike | None, limits: np.ndarray | None, sampling: Sampling | None
) -> None:
    """Raises ValueError for a disturbance without a bound, where one is needed."""
    if disturbance_rate is None:
        return
    if sampling is not None:
        remedy = (
            "The bound of a sampled loop does not have it. Add a disturbance with an uncertain"
            " parameter to the scenario."
        )
        raise checks.fail("disturbance_rate", disturbance_rate, "None with a sampling", remedy)
    if limits is None:
        return
    remedy = (
        "A disturbance of which only the rate is bounded may need any torque. Add a disturbance"
        " with an uncertain parameter to the scenario, or leave out the limits of the torque."
    )
    raise checks.fail("disturbance_rate", disturbance_rate, "None with torque limits", remedy)


def _check_count(count: int) -> None:
    """Raises ValueError for too many uncertain numbers."""
    if count <= MOST_NUMBERS:
        return
    expected = f"at most {MOST_NUMBERS} uncertain numbers, those of disturbance_rate included"
    remedy = "Let numbers vary together: shared=True, or paths joined by commas."
    raise checks.fail("parameters", f"{count} numbers", expected, remedy)


def _check_plant(scenario: Scenario) -> None:
    for name in ("plant", "model"):
        part = vars(scenario)[name]
        robot = plants.as_plant(part).robot
        if robot is None or robot is not part:
            reason = "This bound is that of rigid arms."
            raise unsupported(name, type(part).__name__, "a robot", reason)
        reason = "A load that is picked up changes the plant during the run."
        check_unchanging(name, robot, "a robot that does not change", reason)
    expected = f"a robot of the structure of the plant, {type(scenario.plant).__name__}"
    check_same_structure(scenario, expected)


def _check_law(law: controllers.TrackingLaw) -> None:
    if type(law) is not controllers.Backstepping:
        reason = "V_w' is known for the paper's law with one of its barriers."
        raise unsupported("controller", type(law).__name__, "controllers.Backstepping", reason)
    if law.variant != "corrected":
        reason = "The printed law leaves 1/2 e2^T M0' e2 in V_w', and its proof fails."
        raise unsupported("controller.variant", law.variant, '"corrected"', reason)
    if law.gain_matrix is not None:
        reason = "The bound of V_w' is that of a diagonal gain."
        raise unsupported("controller.gain_matrix", "a matrix", "None", reason)
    check_exponential(law, "V_w'")
    barrier, tube = law.barrier, unit_tube()
    zero, one = jnp.zeros(1), jnp.ones(1)
    claims = (
        barrier.error_at(zero, tube, zero > 0),
        barrier.decay_rate(one),
        barrier.xi_bound(one, tube),
    )
    if any(claim is None for claim in claims):
        reason = "The level set needs the error at which V1 has a value, in closed form."
        expected = "a barrier with error_at, xi_bound and decay_rate"
        raise unsupported("controller.barrier", type(barrier).__name__, expected, reason)


# --- time, tube and mass matrix ------------------------------------------------------------------


def _parts_of(scenario: Scenario) -> ArmParts:
    """The parts of V_w', with a barrier without a guard."""
    law = cast(controllers.Backstepping, copy.copy(scenario.controller))
    guard = jnp.asarray(law.barrier.guard)
    object.__setattr__(law, "barrier", without_guard(law.barrier))
    zero = jnp.zeros(())
    observer, period, gain = cast(observers.Momentum, scenario.observer), None, None
    delay = None
    if scenario.sampling is not None:
        period = scenario.sampling.period
        if has_delay(scenario):
            delay = scenario.sampling.delay
        discrete = observer.at_period(period)
        if scenario.sampling.observer == "poles":
            observer = discrete
        elif scenario.sampling.observer == "exact":
            gain = jnp.broadcast_to(discrete.kf, (scenario.n,))
    return ArmParts(
        cast(Robot, scenario.model).at(zero),
        cast(Robot, scenario.plant).at(zero),
        scenario.disturbance,
        law,
        jnp.broadcast_to(observer.kf, (scenario.n,)),
        scenario.reference,
        scenario.bounds[0],
        guard,
        period,
        gain,
        _measurement_error(scenario.sensor, scenario.n),
        delay,
    )


def _digests(parts: ArmParts, uncertain: Uncertain) -> list[str]:
    """The digests of plant and disturbance, with which f must not jump, and V_w with it."""

    def torque(
        t: jax.Array,
        q: jax.Array,
        v: jax.Array,
        a: jax.Array,
        plant: Robot,
        disturbance: Disturbance,
        model: Robot,
    ) -> jax.Array:
        true = parts._replace(plant=plant, disturbance=disturbance, model=model)
        return arm_motion.required_torque(true, arm_motion.Kinematics(t, q, v, a))

    vector = jnp.zeros(parts.kf.shape)
    inputs = [jnp.zeros(()), vector, vector, vector]
    leaves = (parts.plant, parts.disturbance, parts.model)
    return [operations_of_plant(torque, inputs, leaves, uncertain).digest]


def _check_tube(scenario: Scenario, duration: float) -> None:
    """Raises ValueError if the reference is not inside the bounds at one of some instants.

    Between them it is inside, too, where a search succeeds: its bounds divide by the widths of the
    tube, and so are infinite on a box of times in which a width is 0.
    """
    times = jnp.linspace(0.0, duration, INSTANTS)

    def distances(t):
        tube = tube_at(scenario.reference, scenario.bounds[0], t, acceleration=False)
        return jnp.minimum(tube.q_d - tube.lower, tube.upper - tube.q_d)

    least = np.asarray(jax.vmap(distances)(times))
    if least.min() > 0.0:
        return
    i, joint = np.unravel_index(least.argmin(), least.shape)
    raise checks.fail(
        "prove: scenario.bounds[0]",
        f"a distance of {least.min():g} rad at t = {float(times[i]):g} s of"
        f" {plants.components_in_words(scenario.plant)[joint]}",
        "bounds with the reference strictly inside at all times",
    )


def _check_mass_matrices(parts: ArmParts, uncertain: Uncertain) -> None:
    """Raises ValueError if a mass matrix at a corner of the box of parameters is not positive
    definite at some positions.

    Inside the box all are positive definite where a search succeeds: its bounds are infinite on a
    box that has a singular mass matrix.
    """
    n = parts.kf.shape[0]
    generator = np.random.default_rng(0)
    q = generator.uniform(-math.pi, math.pi, (64, n))
    ends = list(zip(uncertain.low, uncertain.high, strict=True))[: len(uncertain.paths)]
    for corner in itertools.product(*ends):
        part = (parts.plant, parts.disturbance)
        z = jnp.asarray(corner, float)
        plant, _ = uncertainty.leaves_at(uncertain.places, uncertain.numbers, part, z)
        values = np.linalg.eigvalsh(np.asarray(jax.vmap(plant.mass_matrix)(jnp.asarray(q))))
        if values.min() <= 1e-9 * values.max():
            given = ", ".join(f"{k} = {v:g}" for k, v in uncertain.values(corner).items())
            expected = "parameters with a positive definite mass matrix"
            raise checks.fail("parameters", given, expected, "Narrow the intervals.")
