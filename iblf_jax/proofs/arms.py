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
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control import controllers, observers
from iblf_jax.control.actuators import Ideal
from iblf_jax.control.barriers import MEMBERS
from iblf_jax.control.barriers._base import barrier_member
from iblf_jax.control.decays._base import decay_member
from iblf_jax.core import checks
from iblf_jax.core.linalg import matvec
from iblf_jax.core.pytree import astype
from iblf_jax.core.time import as_at, jump_times_of
from iblf_jax.proofs import arm_motion, uncertainty
from iblf_jax.proofs.arm_bound import Constants, arm_bound
from iblf_jax.proofs.arm_motion import ArmParts, Errors, position
from iblf_jax.proofs.dependence import check_without_cases
from iblf_jax.proofs.matrices import solve_transposed, upper_factor
from iblf_jax.proofs.periods import AperiodicError, period_of, shifted
from iblf_jax.proofs.problem import LevelSetProblem, LevelState, length_of_part, patterns_of
from iblf_jax.proofs.uncertainty import Numbers, Places
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.draws import targets_of
from iblf_jax.world import plants
from iblf_jax.world.bounds import Tube, tube_at

ASSUMPTIONS = (
    "The equations hold in real numbers: the loop is continuous, and its parameters are the stored"
    " double-precision numbers.",
    "The torque of the law is applied as it is: without sampling, delay or saturation.",
    "The observer's error and the state are exactly those of the level set; measurements have no"
    " noise.",
)
INSTANTS = 1024
"""Times at which the tube is examined before a proof."""
SUPPORTED_PARTS = ("plant", "disturbance")
"""Parts of a scenario whose parameters may be uncertain."""
VECTORS = ("q", "dq", "f_tilde", "f_hat", "eta")
"""Vectors of a point in physical numbers, as in `LevelState`."""
MOST_CORNERS = 6
"""Largest number of uncertain coordinates: a bound has 2^m corners."""


@dataclasses.dataclass(frozen=True)
class ArmBound:
    """The bound of arms of one structure, as a hashable function."""

    structure: Any
    places: Places
    n: int

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

    def __call__(self, point: jax.Array, constants: list[jax.Array]) -> jax.Array:
        """V_w', () [N m rad/s]."""
        numbers = jax.tree.unflatten(self.structure, constants)
        found = point_of(self.places, self.n, jnp.asarray(point), numbers)
        return arm_motion.level_rate(
            found.parts, numbers.weight, found.errors, found.f_tilde, found.rate
        )


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
        """Raises ValueError if the level set reaches the guard of the barrier at one of some
        instants; the bound examines all times.
        """
        law: Any = self.scenario.controller
        barrier = law.barrier
        with jax.enable_x64(True):
            times = jnp.linspace(0.0, self.duration, INSTANTS)
            per_joint = level / self.parts.law.weight

            def reached(t):
                tube = tube_at(self.parts.reference, self.parts.bounds, t, acceleration=False)
                return barrier.xi_bound(per_joint, tube)

            xi = np.asarray(jax.vmap(reached)(times))
        if xi.max() < 1.0 - barrier.guard:
            return
        largest = f"{xi.max():.6g}"
        raise checks.fail(
            "level",
            level,
            f"a level inside the guard of the barrier, |xi| < {1.0 - barrier.guard:g}",
            f"It reaches |xi| = {largest}, where the law has another slope. Lower the level.",
        )

    def sample(self, seed: int, count: int) -> np.ndarray:
        """Random points, (count, 1 + 3 n + m)."""
        n = self.scenario.n
        low, high = self.uncertain.low, self.uncertain.high
        generator = np.random.default_rng(seed)
        t = generator.uniform(0.0, self.duration, (count, 1))
        s = generator.normal(size=(count, 3 * n))
        s /= np.linalg.norm(s, axis=1, keepdims=True)
        share = generator.uniform(size=(count, len(low)))
        share[::2] = np.round(share[::2])
        return np.concatenate([t, s, low + share * (high - low)], axis=1)

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
        bounds = scenario.bounds
        moved = dataclasses.replace(
            bounds, lower=shifted(bounds.lower, state.t), upper=shifted(bounds.upper, state.t)
        )
        initial = dataclasses.replace(scenario.initial, q=state.q, dq=state.dq)
        observer: Any = scenario.observer
        observer = dataclasses.replace(observer, eta0=state.eta, start="zero")
        return dataclasses.replace(
            scenario,
            initial=initial,
            observer=observer,
            bounds=moved,
            reference=shifted(scenario.reference, state.t),
            disturbance=shifted(scenario.disturbance, state.t),
        )


class Uncertain(NamedTuple):
    """The uncertain coordinates of a problem."""

    places: Places
    numbers: Numbers
    low: np.ndarray
    high: np.ndarray
    names: tuple[str, ...]
    """Path of the entry of each coordinate, or of all its entries, joined by " and "."""
    paths: tuple[tuple[str, ...], ...]
    """Paths of the entries of each coordinate."""

    def values(self, z: Any) -> dict[str, float]:
        """Path -> value of the entries at coordinates."""
        found = {}
        for k, names in enumerate(self.paths):
            for i, name in enumerate(names):
                base, slope = float(self.numbers.base[k][i]), float(self.numbers.slope[k][i])
                found[name] = base + slope * float(z[k])
        return found

    def scales(self) -> dict[str, tuple[float, float]]:
        """Path of each uncertain entry -> its least and its greatest value."""
        low, high = self.values(self.low), self.values(self.high)
        return {name: (min(low[name], high[name]), max(low[name], high[name])) for name in low}


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
        length, is_period = _time_interval(scenario, duration, uncertain)
        _check_continuous(parts, uncertain, scenario.n)
        _check_tube(scenario, length)
        _check_mass_matrices(parts, uncertain)
        zero = jnp.zeros(())
        structure = jax.tree.structure(Constants(parts, uncertain.numbers, zero, zero))
    n = scenario.n
    function = ArmBound(structure, uncertain.places, n)
    point_rate = ArmRate(structure, uncertain.places, n)
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
        assumptions=(*ASSUMPTIONS, *claims_of([scenario.controller.barrier])),  # type: ignore[attr-defined]
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


def _unsupported(field: str, given: Any, expected: str, reason: str) -> ValueError:
    return checks.fail(f"prove: scenario.{field}", given, expected, reason)


def check_supported(scenario: Any) -> None:
    """Raises ValueError, with the reason, for a scenario whose V_w' is not known here."""
    if not isinstance(scenario, Scenario):
        raise checks.fail("scenario", scenario, "a Scenario", "Make one with ij.presets.")
    _check_plant(scenario)
    _check_law(scenario.controller)
    observer = scenario.observer
    if not isinstance(observer, observers.Momentum):
        reason = "The error of this observer does not obey f_tilde' = f' - kf f_tilde."
        raise _unsupported("observer", type(observer).__name__, "observers.Momentum", reason)
    _check_absent(scenario)
    smooth = arm_motion.smoothness(scenario.reference, scenario.bounds)
    if smooth < 2:
        reason = "f contains alpha', and with it two derivatives of reference and bounds."
        expected = "two continuous derivatives in time"
        raise _unsupported("reference and bounds", f"{smooth:g}", expected, reason)


def _check_plant(scenario: Scenario) -> None:
    for name in ("plant", "model"):
        part = vars(scenario)[name]
        if plants.is_chain(part):
            reason = "This bound is that of rigid arms."
            raise _unsupported(name, type(part).__name__, "a robot", reason)
        if jnp.size(jump_times_of(name, part)):
            reason = "A load that is picked up changes the plant during the run."
            raise _unsupported(name, type(part).__name__, "a robot that does not change", reason)
    structures: list[Any] = [jax.tree.structure(x) for x in (scenario.plant, scenario.model)]
    if structures[0] != structures[1]:
        reason = "The difference of their parameters is what the proof is about."
        expected = f"a robot of the structure of the plant, {type(scenario.plant).__name__}"
        raise _unsupported("model", type(scenario.model).__name__, expected, reason)


def _check_law(law: Any) -> None:
    if not isinstance(law, controllers.Backstepping):
        reason = "V_w' is known for the paper's law with one of its barriers."
        raise _unsupported("controller", type(law).__name__, "controllers.Backstepping", reason)
    if law.reading != "corrected":
        reason = "The printed law leaves 1/2 e2^T M0' e2 in V_w', and its proof fails."
        raise _unsupported("controller.reading", law.reading, '"corrected"', reason)
    if not all(decay_member(decay, "constant") for decay in law.decays):
        reason = "V_w' with other decays is not known here."
        names = ", ".join(type(decay).__name__ for decay in law.decays)
        raise _unsupported("controller.decays", names, "exponential decays", reason)
    barrier = law.barrier
    zero, one = jnp.zeros(1), jnp.ones(1)
    tube = Tube(zero, zero, -one, one, zero, zero)
    known = barrier_member(barrier, "error_at")(zero, tube, zero > 0)
    claims = (
        barrier_member(barrier, "decay_rate")(one),
        barrier_member(barrier, "xi_bound")(one, tube),
    )
    if known is None or any(claim is None for claim in claims):
        reason = "The level set needs the error at which V1 has a value, in closed form."
        expected = "a barrier with error_at, xi_bound and decay_rate"
        raise _unsupported("controller.barrier", type(barrier).__name__, expected, reason)
    if type(barrier) not in MEMBERS.values() and not _is_homogeneous(barrier, law.o):
        reason = "The bound divides all lengths by the width of the tube."
        expected = "a barrier without a length of its own"
        raise _unsupported("controller.barrier", type(barrier).__name__, expected, reason)


def _is_homogeneous(barrier: Any, o: Any) -> bool:
    """Whether V1, s and alpha of a barrier scale as powers of all lengths, at one point of each
    side.
    """
    degree = arm_motion.degree(barrier)
    o = None if o is None else jnp.max(o) * jnp.ones(2)

    def scaled_back(size: float) -> jax.Array:
        width = size * jnp.ones(2)
        tube = Tube(0.0 * width, 0.0 * width, -0.7 * width, 1.3 * width, 0.2 * width, -0.1 * width)
        e = width * jnp.array([-0.3, 0.4])
        alpha = barrier.virtual_velocity(tube, e, jnp.ones(2), o) / size
        slope = barrier.slope(tube, e) / size ** (degree - 1)
        return jnp.stack([barrier.value(tube, e) / size**degree, slope, alpha])

    return bool(jnp.allclose(scaled_back(1.0), scaled_back(3.0), rtol=1e-3))


def claims_of(barriers: Sequence[Any]) -> list[str]:
    """Sentences on the claims of barriers that are not members of the package."""
    names = {
        type(barrier).__name__ for barrier in barriers if type(barrier) not in MEMBERS.values()
    }
    return [
        f"The claims of {name} hold: its error_at, xi_bound and decay_rate."
        for name in sorted(names)
    ]


def _check_absent(scenario: Scenario) -> None:
    """Raises ValueError for parts that the bound does not contain."""
    reasons = {
        "sampling": "The proof is one of the continuous loop, with an ideal sensor.",
        "velocity_bounds": "The level set bounds positions only.",
        "process_noise": "V_w' of a stochastic loop has further terms.",
    }
    for name, reason in reasons.items():
        part = vars(scenario)[name]
        if part is not None:
            raise _unsupported(name, type(part).__name__, "None", reason)
    if not isinstance(scenario.actuator, Ideal):
        reason = "The torque of the law must be applied as it is."
        raise _unsupported("actuator", type(scenario.actuator).__name__, "Ideal()", reason)
    if scenario.regions:
        names = ", ".join(type(region).__name__ for region in scenario.regions)
        reason = "The level set bounds positions of joints only."
        raise _unsupported("regions", names, "()", reason)
    if jnp.size(scenario.jump_times()):
        times = np.asarray(scenario.jump_times()).tolist()
        reason = "f' is not defined at a jump."
        raise _unsupported("jump_times()", times, "no jumps", reason)


# --- time, tube and mass matrix ------------------------------------------------------------------


def _time_interval(
    scenario: Scenario, duration: float | None, uncertain: Uncertain
) -> tuple[float, bool]:
    """The length of the time interval [s], and whether it is a period."""
    if duration is not None:
        return checks.positive_number("duration", duration, "s"), False
    varying = {
        "reference": scenario.reference,
        "bounds.lower": scenario.bounds.lower,
        "bounds.upper": scenario.bounds.upper,
        "disturbance": scenario.disturbance,
    }
    try:
        return period_of(varying, [path for paths in uncertain.paths for path in paths]), True
    except AperiodicError as error:
        remedy = f"Give a duration [s]: {error}."
        raise checks.fail("duration", None, "a duration", remedy) from None


def _parts_of(scenario: Scenario) -> ArmParts:
    """The parts of V_w', with a barrier without a guard."""
    law: Any = copy.copy(scenario.controller)
    barrier, observer = copy.copy(law.barrier), cast(Any, scenario.observer)
    # The constructor refuses such a guard: only inside the guard is the barrier evaluated.
    object.__setattr__(barrier, "guard", -math.inf)
    object.__setattr__(law, "barrier", barrier)
    zero = jnp.zeros(())
    return ArmParts(
        as_at(scenario.model, zero),
        as_at(scenario.plant, zero),
        scenario.disturbance,
        law,
        jnp.broadcast_to(observer.kf, (scenario.n,)),
        scenario.reference,
        scenario.bounds,
        jnp.asarray(scenario.controller.barrier.guard),  # type: ignore[attr-defined]
    )


def _check_continuous(parts: ArmParts, uncertain: Uncertain, n: int) -> None:
    """Raises ValueError for a plant or a disturbance with cases: f may jump, and V_w with it."""
    m = len(uncertain.paths)

    def torque(x: jax.Array) -> jax.Array:
        t, motion, z = x[0], x[1 : 1 + 3 * n], x[1 + 3 * n :]
        nominal = (parts.plant, parts.disturbance)
        plant, disturbance = uncertainty.leaves_at(uncertain.places, uncertain.numbers, nominal, z)
        true = parts._replace(plant=plant, disturbance=disturbance)
        now = arm_motion.Kinematics(t, *jnp.split(motion, 3))
        return arm_motion.required_torque(true, now)

    check_without_cases(torque, 1 + 3 * n + m)


def _check_tube(scenario: Scenario, duration: float) -> None:
    """Raises ValueError if the reference is not inside the bounds at one of some instants.

    Between them it is inside, too, where a search succeeds: its bounds divide by the widths of the
    tube, and so are infinite on a box of times in which a width is 0.
    """
    times = jnp.linspace(0.0, duration, INSTANTS)

    def distances(t):
        tube = tube_at(scenario.reference, scenario.bounds, t, acceleration=False)
        return jnp.minimum(tube.q_d - tube.lower, tube.upper - tube.q_d)

    least = np.asarray(jax.vmap(distances)(times))
    if least.min() > 0.0:
        return
    i, joint = np.unravel_index(least.argmin(), least.shape)
    raise checks.fail(
        "prove: scenario.bounds",
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


# --- uncertain parameters --------------------------------------------------------------------


def uncertain_coordinates(
    scenario: Scenario, parameters: Mapping[str, Perturbation], disturbance_rate: Any
) -> Uncertain:
    """The coordinates of parameters that a user gives.

    Raises:
      ValueError: not a mapping of intervals, a path that is unknown, overlaps another or is not one
        of the plant or the disturbance, an interval that reaches inadmissible values.
    """
    example = '{"plant.mass[1]": ij.factor(ij.interval(0.97, 1.03))}'
    checks.mapping("parameters", parameters, example)
    separate = {
        path.strip(): perturbation
        for group, perturbation in parameters.items()
        for path in str(group).split(",")
    }
    for path in separate:
        _check_part(path)
    targets_of(scenario, separate, "parameters", intervals=True)
    index = _places_of_entries(scenario)
    entries, bases, slopes, references, low, high, names = [], [], [], [], [], [], []
    for group, perturbation in parameters.items():
        for together in _entries_together(scenario, str(group), perturbation):
            values = [float(np.asarray(paths.get(scenario, path))) for path in together]
            ends = _ends(scenario, str(group), together[0], perturbation)
            base, slope, reference = _line(perturbation.kind, values)
            entries.append(tuple(index[path] for path in together))
            bases.append(jnp.asarray(base))
            slopes.append(jnp.asarray(slope))
            references.append(reference)
            low.append(ends[0])
            high.append(ends[1])
            names.append(tuple(together))
    rates = _disturbance_rates(disturbance_rate, scenario.n)
    references += [0.0] * len(rates)
    low, high = [*low, *(-rates)], [*high, *rates]
    if len(low) > MOST_CORNERS:
        expected = f"at most {MOST_CORNERS} uncertain numbers, those of disturbance_rate included"
        remedy = "Let numbers vary together: shared=True, or paths joined by commas."
        raise checks.fail("parameters", f"{len(low)} numbers", expected, remedy)
    labels = [" and ".join(x) for x in names]
    labels += [f"disturbance_rate[{i}]" for i in range(len(rates))]
    numbers = Numbers(tuple(bases), tuple(slopes), jnp.asarray(references, float))
    at_reference = _values_at_reference(entries, numbers)
    places = Places(tuple(entries), _differing(scenario, at_reference), len(rates))
    return Uncertain(
        places, numbers, np.array(low, float), np.array(high, float), tuple(labels), tuple(names)
    )


def _disturbance_rates(given: Any, n: int) -> np.ndarray:
    if given is None:
        return np.zeros(0)
    rates = np.asarray(checks.as_floats("disturbance_rate", given), float)
    if rates.shape not in ((), (n,)) or not np.all(np.isfinite(rates)) or np.any(rates < 0):
        raise checks.fail("disturbance_rate", given, f"one number >= 0, or {n}, in N m/s")
    return np.broadcast_to(rates, (n,))


def _check_part(path: str) -> None:
    """Raises ValueError unless a path is one of the plant or the disturbance."""
    first = path.split(".")[0].split("[")[0]
    if first in SUPPORTED_PARTS:
        return
    expected = "a parameter of the plant or the disturbance, such as plant.mass"
    remedy = "Law and observer know their model and gains exactly."
    raise checks.fail("parameters: path", path, expected, remedy)


def _entries_of(scenario: Scenario, path: str) -> list[str]:
    """The paths of the numbers at a path."""
    shape = np.shape(paths.get(scenario, path))
    indices = itertools.product(*map(range, shape))
    return [path + "".join(f"[{i}]" for i in index) for index in indices]


def _entries_together(
    scenario: Scenario, group: str, perturbation: Perturbation
) -> list[list[str]]:
    """The entries of paths that vary together, for each coordinate."""
    columns = [_entries_of(scenario, path.strip()) for path in group.split(",")]
    if perturbation.shared:
        return [[entry for column in columns for entry in column]]
    if len({len(column) for column in columns}) > 1:
        expected = "paths with equally many numbers"
        remedy = "With shared=True all of them vary together."
        raise checks.fail("parameters: path", group, expected, remedy)
    return [list(row) for row in zip(*columns, strict=True)]


def _ends(
    scenario: Scenario, group: str, entry: str, perturbation: Perturbation
) -> tuple[float, float]:
    """The ends of z for an entry of a path."""
    first = group.split(",")[0].strip()
    shape = np.shape(paths.get(scenario, first))
    k = _entries_of(scenario, first).index(entry)
    low, high = (np.broadcast_to(x, shape).ravel()[k] for x in perturbation.distribution.support())
    return float(low), float(high)


def _line(kind: str, values: list[float]) -> tuple[list[float], list[float], float]:
    """Base and slope of the entries with these nominal values, and z of the nominal values."""
    if kind == "factor":
        return [0.0] * len(values), values, 1.0
    if kind == "offset":
        return values, [1.0] * len(values), 0.0
    return [0.0] * len(values), [1.0] * len(values), values[0]


def _places_of_entries(scenario: Scenario) -> dict[str, uncertainty.Place]:
    """Path of each number of plant and disturbance -> its place among the leaves."""
    found: dict[str, uncertainty.Place] = {}
    parts = (scenario.plant, scenario.disturbance)
    keyed, _ = jax.tree_util.tree_flatten_with_path(parts)
    for leaf, (keys, value) in enumerate(keyed):
        name = SUPPORTED_PARTS[keys[0].idx] + jax.tree_util.keystr(keys[1:])
        for entry, index in enumerate(np.ndindex(np.shape(value))):
            found[name + "".join(f"[{i}]" for i in index)] = (leaf, entry)
    return found


def _values_at_reference(
    entries: list[tuple[uncertainty.Place, ...]], numbers: Numbers
) -> dict[uncertainty.Place, float]:
    """The entries at the reference value of their coordinate."""
    found: dict[uncertainty.Place, float] = {}
    for k, together in enumerate(entries):
        values = numbers.base[k] + numbers.slope[k] * numbers.reference[k]
        found |= dict(zip(together, np.asarray(values).tolist(), strict=True))
    return found


def _differing(
    scenario: Scenario, at_reference: dict[uncertainty.Place, float]
) -> tuple[uncertainty.Place, ...]:
    """The entries that differ from those that the law knows.

    An entry of a coordinate is compared at the coordinate's reference value: entries that a `value`
    sets together have one value there, although their nominal values may differ.
    """
    actual = jax.tree.leaves((scenario.plant, scenario.disturbance))
    known = jax.tree.leaves((scenario.model, scenario.disturbance))
    found = []
    for leaf, pair in enumerate(zip(actual, known, strict=True)):
        values, expected = (np.ravel(np.asarray(x)).tolist() for x in pair)
        for entry, value in enumerate(values):
            place = (leaf, entry)
            if at_reference.get(place, value) != expected[entry]:
                found.append(place)
    return tuple(found)
