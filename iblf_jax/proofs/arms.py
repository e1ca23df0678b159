"""The level set of V_w of a rigid arm as a `LevelSetProblem`.

The derivation is at the head of `arm_motion` and `arm_bound`.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control import controllers, observers
from iblf_jax.core import checks
from iblf_jax.core.linalg import matvec
from iblf_jax.core.pytree import astype
from iblf_jax.core.time import jump_times_of
from iblf_jax.proofs import arm_motion, uncertainty
from iblf_jax.proofs.arm_bound import Constants, arm_bound
from iblf_jax.proofs.arm_motion import ArmParts, Errors, position
from iblf_jax.proofs.examination import Examined, Operations, check_operations
from iblf_jax.proofs.matrices import solve_transposed, upper_factor
from iblf_jax.proofs.parameters import Uncertain, uncertain_coordinates
from iblf_jax.proofs.periods import shifted
from iblf_jax.proofs.problem import (
    LevelSetProblem,
    LevelState,
    length_of_part,
    patterns_of,
    random_points,
)
from iblf_jax.proofs.support import (
    CONTINUOUS,
    INSTANTS,
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
    agreement_of_robot,
    check_constant,
    check_time_functions,
)
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.world import plants
from iblf_jax.world.bounds import Tube, tube_at
from iblf_jax.world.references import WaypointSpline

ASSUMPTIONS = (
    REAL_NUMBERS,
    "The torque of the law is applied as it is: without sampling, delay or saturation.",
    "The observer's error and the state are exactly those of the level set; measurements have no"
    " noise.",
)
VECTORS = ("q", "dq", "f_tilde", "f_hat", "eta")
"""Vectors of a point in physical numbers, as in `LevelState`."""


@dataclasses.dataclass(frozen=True)
class ArmBound:
    """The bound of arms of one structure, as a hashable function."""

    structure: Any
    places: Places
    n: int
    digests: tuple[str, ...]
    """Of the functions that users wrote, so that a changed one has a program of its own."""

    def __call__(self, x: jax.Array, constants: list[jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Upper bounds of V_w' over a box, and no region."""
        numbers = jax.tree.unflatten(self.structure, constants)
        return arm_bound(self.places, self.n, x, numbers), jnp.zeros((0,))


@dataclasses.dataclass(frozen=True)
class ArmRate:
    """V_w' at a point of arms of one structure, as a hashable function."""

    structure: Any
    places: Places
    n: int
    digests: tuple[str, ...]
    """Of the functions that users wrote, so that a changed one has a program of its own."""

    def __call__(self, point: jax.Array, constants: list[jax.Array]) -> jax.Array:
        """V_w', () [N m rad/s]; infinite where the torque is not defined, such as log(-1)."""
        numbers = jax.tree.unflatten(self.structure, constants)
        found = point_of(self.places, self.n, jnp.asarray(point), numbers)
        rate = arm_motion.level_rate(
            found.parts, numbers.weight, found.errors, found.f_tilde, found.rate
        )
        now = arm_motion.motion(found.parts, found.errors, found.f_tilde).now
        return infinite_unless_defined(rate, arm_motion.required_torque(found.parts, now))


class ArmPoint(NamedTuple):
    """A point of the level set with its true plant."""

    parts: ArmParts
    errors: Errors
    f_tilde: jax.Array
    rate: jax.Array | float
    """Rate of the further disturbance, (n,) [N m/s]."""


def point_of(places: Places, n: int, point: jax.Array, constants: Constants) -> ArmPoint:
    """The errors, f_tilde and the plant at a point (t, s, z).

    s/|s| = (sqrt(w V1/c) with the signs of e1, U^T e2/sqrt(2c), sqrt(w_f/(2c)) f_tilde).
    """
    parts, level = constants.parts, constants.level
    t, s, z = point[0], point[1 : 1 + 3 * n], point[1 + 3 * n :]
    s = s / jnp.sqrt(jnp.sum(s**2))
    energy = level * s[:n] ** 2
    xi = arm_motion.error_at(parts, t, energy, s[:n])
    errors = Errors(t, xi, jnp.zeros(n))
    U = upper_factor(parts.model.mass_matrix(position(parts, errors)))
    size = jnp.sqrt(2.0 * level)
    e2 = solve_transposed(U, size * s[n : 2 * n])
    f_tilde = size / jnp.sqrt(constants.weight) * s[2 * n :]
    m = len(places.entries)
    uncertain = (parts.plant, parts.disturbance)
    plant, disturbance = uncertainty.leaves_at(places, constants.numbers, uncertain, z[:m])
    rate = z[m:] if places.rates else 0.0
    true = parts._replace(plant=plant, disturbance=disturbance)
    return ArmPoint(true, errors._replace(e2=e2), f_tilde, rate)


@dataclasses.dataclass(frozen=True, eq=False)
class _Arm:
    """The functions of a problem that need its numbers."""

    scenario: Scenario
    parts: ArmParts
    uncertain: Uncertain
    function: ArmBound
    point_rate: ArmRate
    duration: float

    def constants(self, weight: float, level: float) -> list[np.ndarray]:
        """The constants of a weight w_f and a level.

        Raises:
          ValueError: a weight that is not positive, or a level at which the guard of the barrier is
            active.
        """
        weight = checks.positive_number("weight", weight, "1/(N m)^2 N m rad")
        level = checks.positive_number("level", level, "N m rad")
        self._check_level(level)
        parts, numbers = self.parts, self.uncertain.numbers
        leaves = [*jax.tree.leaves((parts, numbers)), weight, level]
        return [np.asarray(x, float) for x in leaves]

    def _check_level(self, level: float) -> None:
        """Raises ValueError if the level set reaches the guard of the barrier."""
        law: Any = self.scenario.controller

        def xi_bound(t: jax.Array) -> jax.Array:
            tube = tube_at(self.parts.reference, self.parts.bounds, t, acceleration=False)
            return law.barrier.xi_bound(level / law.weight, tube)  # type: ignore[no-any-return]

        check_level(level, xi_bound, law.barrier.guard, self.duration, "barrier")

    def sample(self, seed: int, count: int) -> np.ndarray:
        """Random points, (count, 1 + 3 n + m)."""
        ends = (self.uncertain.low, self.uncertain.high)
        return random_points(seed, count, self.duration, 3 * self.scenario.n, *ends)

    def state_of(self, point: Any, constants: Any) -> LevelState:
        """A point in physical numbers."""
        with jax.enable_x64(True):
            numbers = _physical(self.function, np.asarray(point, float), list(constants))
            z = np.asarray(point)[1 + 3 * self.scenario.n :]
            rates = self.function.places.rates
            return LevelState(
                t=float(numbers["t"]),
                **{name: np.asarray(numbers[name]) for name in VECTORS},
                parameters=self.uncertain.values(z),
                rate=np.broadcast_to(np.asarray(numbers["rate"]), (rates,)),
            )

    def scenario_at(self, point: Any, constants: Any) -> Scenario:
        """The scenario whose run starts at a point, with its parameters and moved in time.

        Raises:
          ValueError: a part that cannot be moved in time.
        """
        state = self.state_of(point, constants)
        scenario = paths.with_parameters(self.scenario, state.parameters)
        initial = dataclasses.replace(scenario.initial, q=state.q, dq=state.dq)
        observer: Any = scenario.observer
        observer = dataclasses.replace(observer, eta0=state.eta, start="zero")
        return dataclasses.replace(
            scenario,
            initial=initial,
            observer=observer,
            bounds=tuple(shifted(bounds, state.t) for bounds in scenario.bounds),
            reference=shifted(scenario.reference, state.t),
            disturbance=shifted(scenario.disturbance, state.t),
        )


@functools.partial(jax.jit, static_argnums=0)
def _physical(function: ArmBound, point: jax.Array, constants: list[jax.Array]) -> dict[str, Any]:
    """Time, position, velocity, f_tilde, f_hat, eta and the further rate at a point."""
    numbers = jax.tree.unflatten(function.structure, constants)
    found = point_of(function.places, function.n, point, numbers)
    parts, errors = found.parts, found.errors
    now = arm_motion.motion(parts, errors, found.f_tilde).now
    f_hat = arm_motion.mismatch_torque(parts, now) - found.f_tilde
    eta = f_hat - parts.kf * matvec(parts.model.mass_matrix(now.q), now.v)
    vectors = dict(zip(VECTORS, (now.q, now.v, found.f_tilde, f_hat, eta), strict=True))
    return {"t": errors.t, "rate": found.rate, **vectors}


def arm_problem(
    scenario: Scenario,
    parameters: Mapping[str, Perturbation],
    *,
    duration: float | None = None,
    disturbance_rate: Any = None,
) -> LevelSetProblem:
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
    check_supported(scenario)
    with jax.enable_x64(True):
        scenario = canonical(astype(scenario, jnp.float64))
        parts = _parts_of(scenario)
        uncertain = uncertain_coordinates(scenario, parameters, disturbance_rate)
        varying = {
            "reference": scenario.reference,
            "bounds": scenario.bounds[0],
            "disturbance": scenario.disturbance,
        }
        length, is_period = time_interval(varying, duration, uncertain)
        examined = _examined(scenario, parts, uncertain)
        _check_tube(scenario, length)
        _check_mass_matrices(parts, uncertain)
        zero = jnp.zeros(())
        structure = jax.tree.structure(Constants(parts, uncertain.numbers, zero, zero))
    n = scenario.n
    function = ArmBound(structure, uncertain.places, n, tuple(examined.digests))
    point_rate = ArmRate(structure, uncertain.places, n, tuple(examined.digests))
    arm = _Arm(scenario, parts, uncertain, function, point_rate, length)
    names, lower, upper = _coordinates(n, length, uncertain)
    return LevelSetProblem(
        names=names,
        lower=lower,
        upper=upper,
        patterns=patterns_of(n, length),
        bound=function,
        constants=arm.constants,
        point_rate=point_rate,
        sample=arm.sample,
        state_of=arm.state_of,
        scenario_at=arm.scenario_at,
        scales=uncertain.scales(),
        duration=length,
        is_period=is_period,
        assumptions=(*ASSUMPTIONS, *claims_of([parts.law.barrier]), *examined.assumed),
    )


def _coordinates(
    n: int, duration: float, uncertain: Uncertain
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Names and ends of the coordinates; ends of angles are rounded outward."""
    right, full = np.nextafter(0.5 * math.pi, 2.0), np.nextafter(2.0 * math.pi, 7.0)
    names = ["time since start", *(f"theta[{i}]" for i in range(n)), "psi"]
    names += [f"phi[{i}]" for i in range(n - 1)]
    lower = [0.0] * (2 * n + 1)
    phi = [2.0 * right] * (n - 1)
    if n > 1:
        phi[-1] = full
    psi = right if n > 1 else 2.0 * right
    upper = [length_of_part(duration), *[right] * n, psi, *phi]
    names += [*uncertain.names, *(f"side[{i}]" for i in range(n)), "start"]
    return (
        tuple(names),
        np.concatenate([lower, uncertain.low]),
        np.concatenate([upper, uncertain.high]),
    )


# --- what is supported -------------------------------------------------------------------------


def check_supported(scenario: Any) -> None:
    """Raises ValueError, with the reason, for a scenario whose V_w' is not known here."""
    if not isinstance(scenario, Scenario):
        raise checks.fail("scenario", scenario, "a Scenario", "Make one with ij.presets.")
    _check_plant(scenario)
    _check_law(scenario.controller)
    observer = scenario.observer
    if type(observer) is not observers.Momentum:
        reason = "The error of this observer does not obey f_tilde' = f' - kf f_tilde."
        raise unsupported("observer", type(observer).__name__, "observers.Momentum", reason)
    _check_absent(scenario)
    if isinstance(scenario.reference, WaypointSpline):
        reason = "The piece of a spline depends on the time, which is an interval here."
        expected = "a reference without pieces, such as references.Quintic"
        raise unsupported("reference", "WaypointSpline", expected, reason)
    smooth = arm_motion.smoothness(scenario.reference, scenario.bounds[0])
    if smooth < 2:
        reason = "f contains alpha', and with it two derivatives of reference and bounds."
        expected = "two continuous derivatives in time"
        raise unsupported("reference and bounds", f"{smooth:g}", expected, reason)


def _check_plant(scenario: Scenario) -> None:
    for name in ("plant", "model"):
        part = vars(scenario)[name]
        if plants.is_chain(part):
            reason = "This bound is that of rigid arms."
            raise unsupported(name, type(part).__name__, "a robot", reason)
        if jnp.size(jump_times_of(name, part)):
            reason = "A load that is picked up changes the plant during the run."
            raise unsupported(name, type(part).__name__, "a robot that does not change", reason)
        check_constant(f"scenario.{name}", part)
    expected = f"a robot of the structure of the plant, {type(scenario.plant).__name__}"
    check_same_structure(scenario, expected)


def _check_law(law: Any) -> None:
    if type(law) is not controllers.Backstepping:
        reason = "V_w' is known for the paper's law with one of its barriers."
        if isinstance(law, controllers.Saturated):
            reason += " Without its limit: with_parts(s, controller=s.controller.law)."
        raise unsupported("controller", type(law).__name__, "controllers.Backstepping", reason)
    if law.reading != "corrected":
        reason = "The printed law leaves 1/2 e2^T M0' e2 in V_w', and its proof fails."
        raise unsupported("controller.reading", law.reading, '"corrected"', reason)
    check_exponential(law, "V_w'")
    barrier = law.barrier
    zero, one = jnp.zeros(1), jnp.ones(1)
    tube = Tube(zero, zero, -one, one, zero, zero)
    known = barrier.error_at(zero, tube, zero > 0)
    claims = (
        barrier.decay_rate(one),
        barrier.xi_bound(one, tube),
    )
    if known is None or any(claim is None for claim in claims):
        reason = "The level set needs the error at which V1 has a value, in closed form."
        expected = "a barrier with error_at, xi_bound and decay_rate"
        raise unsupported("controller.barrier", type(barrier).__name__, expected, reason)


def _check_absent(scenario: Scenario) -> None:
    """Raises ValueError for parts that the bound does not contain."""
    reasons = {
        "sampling": CONTINUOUS,
        "process_noise": "V_w' of a stochastic loop has further terms.",
    }
    check_absent(scenario, reasons, input="torque", rate="f'")
    if scenario.bounds[1] is not None:
        reason = "The level set bounds positions only."
        raise unsupported("bounds[1]", "Bounds", "None", reason)
    if scenario.regions:
        names = ", ".join(type(region).__name__ for region in scenario.regions)
        reason = "The level set bounds positions of joints only."
        raise unsupported("regions", names, "()", reason)


# --- time, tube and mass matrix ------------------------------------------------------------------


def _parts_of(scenario: Scenario) -> ArmParts:
    """The parts of V_w', with a barrier without a guard."""
    law: Any = copy.copy(scenario.controller)
    barrier, observer = copy.copy(law.barrier), cast(Any, scenario.observer)
    # The constructor refuses such a guard: only inside the guard is the barrier evaluated.
    object.__setattr__(barrier, "guard", -math.inf)
    object.__setattr__(law, "barrier", barrier)
    zero = jnp.zeros(())
    return ArmParts(
        scenario.model.at(zero),
        scenario.plant.at(zero),
        scenario.disturbance,
        law,
        jnp.broadcast_to(observer.kf, (scenario.n,)),
        scenario.reference,
        scenario.bounds[0],
        jnp.asarray(scenario.controller.barrier.guard),  # type: ignore[union-attr]
    )


def _examined(scenario: Scenario, parts: ArmParts, uncertain: Uncertain) -> Examined:
    """What is assumed of the parts of a scenario.

    Raises:
      ValueError: a part that may jump, or one that contradicts its contract.
    """
    digests = [_check_operations(parts, uncertain, scenario.n).digest]
    sides = {f"bounds[0].{name}": vars(scenario.bounds[0])[name] for name in ("lower", "upper")}
    in_time = check_time_functions(scenario.reference, sides, scenario.n)
    if type(parts.law.barrier) not in BARRIERS:
        name = "scenario.controller.barrier"
        digests += check_barrier(
            name, parts.law.barrier, parts.law.o, n=scenario.n, homogeneous=True
        )
    assumed = [*in_time.assumed, *agreement_of_robot(scenario.plant)]
    return Examined(assumed, [*digests, *in_time.digests])


def _check_operations(parts: ArmParts, uncertain: Uncertain, n: int) -> Operations:
    """The operations of plant and disturbance, with which f must not jump, and V_w with it."""
    places = uncertain.places
    known = (parts.plant, parts.disturbance, parts.model)
    leaves = jax.tree.leaves(known)
    structure = jax.tree.structure(known)

    def torque(t: jax.Array, q: jax.Array, v: jax.Array, a: jax.Array, *x: jax.Array) -> jax.Array:
        plant, disturbance, model = jax.tree.unflatten(structure, x)
        true = parts._replace(plant=plant, disturbance=disturbance, model=model)
        return arm_motion.required_torque(true, arm_motion.Kinematics(t, q, v, a))

    vector = jnp.zeros(n)
    inputs = [jnp.zeros(()), vector, vector, vector]
    varying = [*range(4), *(4 + leaf for leaf in places.varying_leaves)]
    name = "scenario.plant and disturbance"
    return check_operations(name, torque, [*inputs, *leaves], varying, kinks=True)


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
        f"a distance of {least.min():g} rad at t = {float(times[i]):g} s of joint {joint}",
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
