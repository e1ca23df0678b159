"""Upper bounds of V_w' of a rigid arm whose law and observer are sampled, at all times.

Law and observer run every h seconds, and the torque of a sample is held.  V_w is that of the torque
u(X) that the law would command at the state X = (t, q, v, phi), where phi is the estimate of the
observer, interpolated between samples:

    u = M0 alpha' + C0 alpha + G0 - phi - K2 e2 - w s,   f_tilde = f(u(X)) - phi,
    phi' = g (p' - phi_k - tau_k - n_k),   p = M0 v,   n = M0' v - C0 v - G0                  (H.1)

phi is the discrete estimate at each sample, with g = (1 - exp(-kf h))/h for "poles" and g = kf for
"euler", and V_w is continuous there.  With the differences since the sample

    D = tau_k - u,   L = n - n_k + phi - phi_k,   A = M0 M^-1,   K = dM M0^-1,   A (I + K) = I,

    phi' = g (f_tilde - K A D + L),   u' = u_h' - phi',   L' = n' + phi',                     (H.2)
    V_w' = (rate of the continuous loop with the gain g) + e2^T A D
           + w_f f_tilde^T A [(F M0^-1 + g K) A D - g L],                                     (H.3)

where u_h = u + phi, and F is the derivative of f(u(X)) along e2 at a given f_tilde.  D and L follow
from their rates along the path since the sample, which are affine in f_tilde:

    D = -s (u0 + U f_tilde),   L = s (n0 + N f_tilde),   0 <= s <= h                          (H.4)

with means over the path.  (H.3) is affine in s for given means, and its maximum over f_tilde convex
in s: it is bounded at s = 0 and at s = h.

**The path.**  Bounds |u'| <= R_u, |L'| <= R_L and |f'| <= R_f on the whole set, under |D| <= h R_u
and |L| <= h R_L, hold along every run: D and L are 0 at a sample, and up to the first time at which
one of them reaches its bound, which is before the next sample, the rates are below theirs
(`rate_excess`).  With them, the motion backward from a box obeys a differential inclusion.  A box
that contains the end of each of its steps in its interior contains the path: `_path` inflates the
box by its rates and tests that.  Paths from boxes near e1 = 0 come from the other side of the tube;
there, `TwoSided` joins the values of the barrier's functions on both sides.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp

from iblf_jax.core.linalg import inner, matmul, matvec
from iblf_jax.kernels import hull, lower, meet, upper, with_sign
from iblf_jax.proofs import arm_motion
from iblf_jax.proofs.arm_bound import (
    Affine,
    ArmErrors,
    Constants,
    Coordinates,
    HeldTorque,
    arm_errors,
    bounds_from,
    coordinates,
    corners,
    differences,
    dissipation_bound,
    in_f_tilde,
    is_inside_guard,
    mass_along,
    mismatch,
    with_plant,
)
from iblf_jax.proofs.arm_motion import ArmParts, Errors, Kinematics, position, velocity
from iblf_jax.proofs.forms import along
from iblf_jax.proofs.matrices import norm, solve_general
from iblf_jax.proofs.uncertainty import Places
from iblf_jax.world.robots._base import energy_gradient

INFLATION = 0.5
"""By which the rates on a box are enlarged for the candidate of a path, in parts of them."""

LARGE = 1e300
"""A bound of nothing."""
GAIN_ERROR = 2.0**-45
"""Bound of the relative error of the gain (1 - exp(-kf h))/h, which is computed in double
precision: 256 times its distance from the next number."""


class PathRates(NamedTuple):
    """Bounds of rates on the whole set, (n,) each [N m/s]."""

    command: jax.Array
    """R_u."""
    lag: jax.Array
    """R_L."""
    mismatch: jax.Array
    """R_f."""


class TwoSided:
    """The functions of a barrier on one side of the tube, and on intervals that reach beyond e1 = 0
    the hull of those on both sides.

    Args:
      barrier: without a guard.
      sign: side of each joint, (n,).
    """

    def __init__(self, barrier: Any, sign: jax.Array) -> None:
        self.barrier = barrier
        self.sign = sign
        self.value_unit = barrier.value_unit

    def slope(self, tube: Any, q: jax.Array) -> jax.Array:
        """The slope dV1/de1."""
        return self._of_sides(lambda q: self.barrier.slope(tube, q), q)

    def virtual_velocity(self, tube: Any, q: jax.Array, k1: jax.Array, o: Any) -> jax.Array:
        """The virtual velocity alpha."""
        return self._of_sides(lambda q: self.barrier.virtual_velocity(tube, q, k1, o), q)

    def _of_sides(self, function: Any, q: jax.Array) -> jax.Array:
        sign = self.sign
        # The other side may be many times as wide as this one.
        here = function(with_sign(meet(q, hull(jnp.zeros_like(q), LARGE * sign)), sign))
        beyond = function(with_sign(meet(q, hull(jnp.zeros_like(q), -LARGE * sign)), -sign))
        # A comparison that an interval does not decide has the hull of both cases.
        return jnp.where(sign * q > 0.0, here, beyond)


def two_sided(parts: ArmParts, sign: jax.Array) -> ArmParts:
    """The parts with a barrier that is evaluated on both sides of the tube."""
    law = copy.copy(parts.law)
    object.__setattr__(law, "barrier", TwoSided(law.barrier, sign))
    return parts._replace(law=law)


def with_exact_gain(constants: Constants) -> Constants:
    """The constants with an interval that contains the exact gain g of the observer."""
    kf = constants.parts.kf
    exact = kf * (1.0 + symmetric(jnp.full_like(kf, GAIN_ERROR)))
    return constants._replace(parts=constants.parts._replace(kf=exact))


def period(parts: ArmParts) -> jax.Array:
    """The period of the samples, () [s]."""
    assert parts.period is not None
    return parts.period


# --- functions of the motion ---------------------------------------------------------------------


def free_torque(parts: ArmParts, at: Errors) -> jax.Array:
    """u_h = M0 alpha' + C0 alpha + G0 - K2 e2 - w s, (n,) [N m]."""
    model, q, v = parts.model, position(parts, at), velocity(parts, at)
    alpha = arm_motion.reference_rate(parts, at.t) + arm_motion.relative_alpha(parts, at.t, at.xi)
    inertial = matvec(model.mass_matrix(q), arm_motion.alpha_rate(parts, at))
    feedback = parts.law.K2 * at.e2 + arm_motion.slope(parts, at.t, at.xi)
    return inertial + model.coriolis(q, v, alpha) + model.gravity(q) - feedback


def momentum_term(parts: ArmParts, at: Errors) -> jax.Array:
    """The term n = M0' v - C0 v - G0 of the momentum's rate, (n,) [N m]."""
    q = position(parts, at)
    return energy_gradient(parts.model, q, velocity(parts, at)) - parts.model.gravity(q)


def kinematics(parts: ArmParts, at: Errors, f_tilde: jax.Array) -> Kinematics:
    """The motion under the law's torque."""
    a = arm_motion.alpha_rate(parts, at) + arm_motion.velocity_error_rate(parts, at, f_tilde)
    return Kinematics(at.t, position(parts, at), velocity(parts, at), a)


def path_rates(parts: ArmParts, at: Errors, f_tilde: jax.Array, push: jax.Array | float) -> Errors:
    """The rates of t, xi and e2 with a further acceleration `push`, (n,) [rad/s^2]."""
    rates = arm_motion.rates_of_errors(parts, at, f_tilde)
    return rates._replace(e2=rates.e2 + push)


class MassError(NamedTuple):
    """The error of the mass matrix over a box of parameters."""

    inverse: jax.Array
    """M0^-1, (n, n)."""
    relative: jax.Array
    """K = dM M0^-1, (n, n)."""
    ratio: jax.Array
    """A = M0 M^-1, (n, n)."""

    @property
    def push(self) -> jax.Array:
        """M^-1, (n, n)."""
        return matmul(self.inverse, self.ratio)


def mass_error(constants: Constants, places: Places, at: Errors, z: jax.Array) -> MassError:
    """K and A at errors; A by one step from a first enclosure, A = I - K A."""
    parts, n = constants.parts, at.xi.shape[-1]
    inside, directions, sizes = differences(constants, places, z)
    q, inverse = position(parts, at), arm_motion.inverse_mass(parts, at)
    K = jnp.zeros((n, n))
    for size, direction in zip(sizes, directions, strict=True):
        K = K + size * matmul(mass_along(inside, direction, q), inverse)
    one = jnp.eye(n)
    ratio = jnp.stack([solve_general(one + K, unit) for unit in one], axis=-1)
    return MassError(inverse, K, one - matmul(K, ratio))


class FirstRates(NamedTuple):
    """Rates along the path at f_tilde = 0 and without D, and derivatives along e2."""

    torque: Affine
    """Of u_h, (n,) [N m/s] and (n, n) [N m s/rad]."""
    momentum: Affine
    """Of n."""
    mismatch: jax.Array
    """F, (n, n) [N m s/rad]."""


def first_rates(constants: Constants, places: Places, at: Errors, z: jax.Array) -> FirstRates:
    """The rates of u_h and n, and F, at errors."""
    parts, n = constants.parts, at.xi.shape[-1]
    inside, directions, sizes = differences(constants, places, z)
    of_model = (parts.model, parts.disturbance)
    zero = jnp.zeros(n)

    def functions(at: Errors) -> tuple[jax.Array, jax.Array]:
        return free_torque(parts, at), momentum_term(parts, at)

    def terms(at: Errors) -> tuple[jax.Array, list[jax.Array]]:
        now = kinematics(parts, at, zero)

        def required(p: Any) -> jax.Array:
            return arm_motion.required_torque(with_plant(parts, p), now)

        external = arm_motion.external_torque(with_plant(parts, of_model), now)
        return external, [along(required, (inside,), (direction,)) for direction in directions]

    torque, momentum = along(functions, (at,), (path_rates(parts, at, zero, 0.0),))
    torque_columns, momentum_columns, mismatch_columns = [], [], []
    for unit in jnp.eye(n):
        step = Errors(jnp.zeros_like(at.t), jnp.zeros_like(at.xi), unit)
        along_torque, along_momentum = along(functions, (at,), (step,))
        column, of_parameters = along(terms, (at,), (step,))
        for size, term in zip(sizes, of_parameters, strict=True):
            column = column - size * term
        torque_columns.append(along_torque)
        momentum_columns.append(along_momentum)
        mismatch_columns.append(column)

    def matrix(columns: Sequence[jax.Array]) -> jax.Array:
        return jnp.stack(columns, axis=-1)

    return FirstRates(
        Affine(torque, matrix(torque_columns)),
        Affine(momentum, matrix(momentum_columns)),
        matrix(mismatch_columns),
    )


# --- enclosures ----------------------------------------------------------------------------------


def symmetric(size: jax.Array) -> jax.Array:
    """[-size, size]; a number is 0."""
    zero, largest = jnp.zeros_like(size), upper(size)
    return hull(zero, largest) + hull(zero, -largest)


def up_to(size: jax.Array | float) -> jax.Array:
    """[0, size]; a number is 0."""
    return hull(jnp.zeros_like(jnp.asarray(size)), size)


class Path(NamedTuple):
    """A box of the path since the sample."""

    at: Errors
    f_tilde: jax.Array
    """(n,) [N m]."""
    is_enclosed: jax.Array
    """Whether the box is shown to contain the path, ()."""


def _path(
    constants: Constants, places: Places, point: ArmErrors, z: jax.Array, limits: PathRates
) -> Path:
    """The box of a path backward from `point`, up to the period; see the head of this module."""
    parts = constants.parts
    h, g, at = period(parts), parts.kf, point.errors
    sign = cast(TwoSided, parts.law.barrier).sign
    D, L = symmetric(h * limits.command), symmetric(h * limits.lag)

    def estimate_term(at: Errors) -> tuple[jax.Array, jax.Array]:
        """Of f_tilde' all but -g f_tilde as a magnitude, and the acceleration by D."""
        error = mass_error(constants, places, at, z)
        size = jnp.abs(change_of_f_tilde(parts, error, limits, D, L))
        return upper(size), matvec(error.inverse, matvec(error.ratio, D))

    def on_side(box: Errors) -> Errors:
        # Beyond e1 = 0, xi is still in parts of the width on the side of the point.
        return box._replace(xi=with_sign(box.xi, sign))

    def moved(rates: Errors) -> Errors:
        back = up_to(h)
        return on_side(jax.tree.map(lambda x, rate: x - back * rate, at, rates))

    def spread(box: Errors, rates: Errors) -> Errors:
        more = INFLATION * h
        return on_side(
            jax.tree.map(lambda x, rate: x + symmetric(more * jnp.abs(rate)), box, rates)
        )

    def all_f_tilde(size: jax.Array) -> jax.Array:
        # |f_tilde_i|' <= g |f_tilde_i| + size backward in time
        return symmetric(jnp.exp(g * h) * (point.b + h * size))

    size, push = estimate_term(at)
    size = upper((1.0 + INFLATION) * size)
    f_tilde = all_f_tilde(size)
    rates = path_rates(parts, at, f_tilde, push)
    candidate = spread(moved(rates), rates)
    # The rate of xi varies with e2.
    rates = rates._replace(xi=arm_motion.xi_rate(parts, candidate._replace(xi=at.xi)))
    candidate = candidate._replace(xi=spread(moved(rates), rates).xi)
    size_there, push = estimate_term(candidate)
    rates = path_rates(parts, candidate, f_tilde, push)
    found = moved(rates)

    def is_inside(x: jax.Array, y: jax.Array) -> jax.Array:
        return (lower(y) < lower(x)) & (upper(x) < upper(y))

    errors = (is_inside(found.xi, candidate.xi), is_inside(found.e2, candidate.e2))
    is_enclosed = jnp.all(jnp.stack([*errors, size_there <= size]))
    return Path(found, f_tilde, is_enclosed)


def rates_under(
    parts: ArmParts, error: MassError, rates: FirstRates, D: jax.Array, L: jax.Array
) -> tuple[Affine, Affine]:
    """The rates of u and L under differences D and L, as functions of f_tilde."""
    g = parts.kf
    AD = matvec(error.ratio, D)
    push, estimate = matvec(error.inverse, AD), g * (L - matvec(error.relative, AD))

    def under(rate: Affine) -> Affine:
        slope = matmul(rate.slope, error.inverse)
        return Affine(rate.value + matvec(rate.slope, push), slope)

    command, momentum = under(rates.torque), under(rates.momentum)
    decay = jnp.diag(g)
    return (
        Affine(command.value - estimate, command.slope - decay),
        Affine(momentum.value + estimate, momentum.slope + decay),
    )


def change_of_f_tilde(
    parts: ArmParts, error: MassError, limits: PathRates, D: jax.Array, L: jax.Array
) -> jax.Array:
    """The rate of f_tilde but for its own decay, f_tilde' + g f_tilde, (n,) [N m/s]."""
    KAD = matvec(error.relative, matvec(error.ratio, D))
    return symmetric(limits.mismatch) + parts.kf * (KAD - L)


class PathMeans(NamedTuple):
    """Means over the path since the sample."""

    D: jax.Array
    """(n,) [N m]."""
    L: jax.Array
    """(n,) [N m]."""
    growth: jax.Array
    """The mean of f_tilde is growth f_tilde + rest, with f_tilde at the end of the path, (n,)."""
    rest: jax.Array
    """(n,) [N m]."""


def path_means(
    parts: ArmParts, path: Path, error: MassError, rates: FirstRates, limits: PathRates
) -> PathMeans:
    """The means over a path of any age up to the period."""
    h, g = period(parts), parts.kf
    D, L = symmetric(h * limits.command), symmetric(h * limits.lag)
    # The rates on the path, within the bounds on the whole set.
    u_rate, L_rate = (
        meet(rate.value + matvec(rate.slope, path.f_tilde), symmetric(limit))
        for rate, limit in zip(
            rates_under(parts, error, rates, D, L), (limits.command, limits.lag), strict=True
        )
    )
    change = change_of_f_tilde(parts, error, limits, D, L)
    # The mean of a difference that grows from 0 on at such a rate has half of the age.
    half = up_to(0.5 * h)
    rest = half * (g * (up_to(h) * (g * path.f_tilde - change)) - change)
    return PathMeans(-half * u_rate, half * L_rate, 1.0 + half * g, rest)


def mean_rates(
    parts: ArmParts, error: MassError, rates: FirstRates, means: PathMeans
) -> tuple[Affine, Affine]:
    """The means of u' and L' over the path, as functions of f_tilde at its end, (H.4)."""

    def over_path(rate: Affine) -> Affine:
        return Affine(rate.value + matvec(rate.slope, means.rest), rate.slope * means.growth)

    command, lag = rates_under(parts, error, rates, means.D, means.L)
    return over_path(command), over_path(lag)


def held_terms(
    constants: Constants,
    places: Places,
    point: ArmErrors,
    z: jax.Array,
    path: Path,
    limits: PathRates,
) -> HeldTorque:
    """What the held torque adds at the age h."""
    parts = constants.parts
    error = mass_error(constants, places, path.at, z)
    rates = first_rates(constants, places, path.at, z)
    means = path_means(parts, path, error, rates, limits)
    command, lag = mean_rates(parts, error, rates, means)
    return added_terms(constants, point.errors.e2, error, rates.mismatch, command, lag)


def added_terms(
    constants: Constants,
    e2: jax.Array,
    error: MassError,
    F: jax.Array,
    command: Affine,
    lag: Affine,
) -> HeldTorque:
    """The terms of (H.3) with D = -h u' and L = h L', for means u' (`command`) and L' (`lag`)."""
    parts, weight = constants.parts, constants.weight
    h, g = period(parts), parts.kf
    K, A = error.relative, error.ratio
    G = matmul(F, error.inverse) + g[:, None] * K
    # A D and the bracket of (H.3), in parts of -h.
    value = command.value - matvec(K, matvec(A, command.value))
    slope = matmul(A, command.slope)
    inside = matvec(G, value) + g * lag.value
    of_f_tilde = matmul(G, slope) + g[:, None] * lag.slope
    push = matvec(slope.T, e2) + weight * matvec(A, inside)
    return HeldTorque(-h * inner(e2, value), -h * push, -h * matmul(A, of_f_tilde))


def held_bound(
    places: Places, n: int, x: jax.Array, constants: Constants, limits: PathRates
) -> jax.Array:
    """An upper bound of V_w' over the box x at all ages of the torque, (1,) [N m rad/s]; infinite
    where the barrier's guard may be active, or where the path is not enclosed.
    """
    constants = with_exact_gain(constants)
    at = coordinates(x, n, places.coordinates)
    point = arm_errors(constants, at)
    vertices = corners(mismatch(constants, places, point.errors, at.z), at.z)
    losses = dissipation_bound(constants, point)
    both = constants._replace(parts=two_sided(constants.parts, at.sign))
    path = _path(both, places, point, at.z, limits)
    held_torque = held_terms(both, places, point, at.z, path, limits)
    fresh = jnp.min(bounds_from(constants, point, losses, vertices))
    old = jnp.min(bounds_from(constants, point, losses, vertices, held_torque))
    # A box of which the path is not enclosed may have a narrower one inside.
    bound = jnp.where(path.is_enclosed, jnp.maximum(fresh, old), hull(jnp.inf, -LARGE))
    return jnp.where(is_inside_guard(constants, point), bound, jnp.inf)[None]


def rate_excess(places: Places, x: jax.Array, constants: Constants, limits: PathRates) -> jax.Array:
    """Upper bounds of the rates of u, L and f in parts of their limits, minus 1, over the box x of
    the whole set, (1,) [1]; negative where all are below them.

    x has the coordinates of `arm_torque.torque_excess`.
    """
    constants = with_exact_gain(constants)
    n, m = constants.parts.kf.shape[0], places.coordinates
    share = x[2 * n + 1 + m]
    at = coordinates(jnp.concatenate([x[: 2 * n + 1 + m], x[2 * n + 2 + m :]]), n, m)
    point = arm_errors(constants._replace(level=constants.level * share**2), at)
    found = _rates(constants, places, point, at, limits)
    sizes = [
        jnp.stack([jnp.abs(rate.value[i]) + point.b * norm(rate.slope[i]) for i in range(n)])
        for rate in found
    ]
    excess = jnp.max(jnp.stack([s / most for s, most in zip(sizes, limits, strict=True)]))
    return jnp.where(is_inside_guard(constants, point), excess - 1.0, jnp.inf)[None]


def _rates(
    constants: Constants, places: Places, point: ArmErrors, at: Coordinates, limits: PathRates
) -> list[Affine]:
    """The rates of u, L and f as functions of f_tilde."""
    parts, errors = constants.parts, point.errors
    h, g, n = period(parts), parts.kf, errors.xi.shape[-1]
    inside, directions, sizes = differences(constants, places, at.z)
    error = mass_error(constants, places, errors, at.z)
    AD = matvec(error.ratio, symmetric(h * limits.command))
    push, KAD = matvec(error.inverse, AD), matvec(error.relative, AD)
    L = symmetric(h * limits.lag)
    of_model = (parts.model, parts.disturbance)

    def rates(f_tilde: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        step = path_rates(parts, errors, f_tilde, push)
        estimate = g * (f_tilde - KAD + L)
        torque = along(lambda at: free_torque(parts, at), (errors,), (step,))
        momentum = along(lambda at: momentum_term(parts, at), (errors,), (step,))
        now, change = jax.jvp(lambda at: kinematics(parts, at, f_tilde), (errors,), (step,))

        def required(p: Any) -> jax.Array:
            plant = with_plant(parts, p)
            return along(lambda now: arm_motion.required_torque(plant, now), (now,), (change,))

        model = with_plant(parts, of_model)
        force = along(lambda now: arm_motion.external_torque(model, now), (now,), (change,))
        for size, direction in zip(sizes, directions, strict=True):
            force = force - size * along(required, (inside,), (direction,))
        force = force + matvec(error.relative, estimate)
        return torque - estimate, momentum + estimate, matvec(error.ratio, force)

    return list(in_f_tilde(rates, n))


# --- numbers -------------------------------------------------------------------------------------


class HeldRates(NamedTuple):
    """Rates at a point, in plain floating-point numbers, at the age 0 of the torque."""

    command: jax.Array
    """u', (n,) [N m/s]."""
    lag: jax.Array
    """L', (n,) [N m/s]."""
    mismatch: jax.Array
    """f', (n,) [N m/s]."""


def rates_at(parts: ArmParts, at: Errors, f_tilde: jax.Array) -> HeldRates:
    """The rates of u, L and f at the age 0, of the true plant in `parts`."""
    step = arm_motion.rates_of_errors(parts, at, f_tilde)
    estimate = parts.kf * f_tilde
    torque = along(lambda at: free_torque(parts, at), (at,), (step,))
    momentum = along(lambda at: momentum_term(parts, at), (at,), (step,))
    change = arm_motion.mismatch_rate(parts, at, f_tilde)
    return HeldRates(torque - estimate, momentum + estimate, change)


def held_addition(
    parts: ArmParts,
    weight: jax.Array,
    at: Errors,
    f_tilde: jax.Array,
    D: jax.Array,
    L: jax.Array,
) -> jax.Array:
    """What D and L add to V_w' by (H.3), for numbers and the true plant in `parts`,
    () [N m rad/s].
    """
    now = kinematics(parts, at, f_tilde)
    M0, M = parts.model.mass_matrix(now.q), parts.plant.mass_matrix(now.q)
    push = jnp.linalg.solve(M, D)
    step = Errors(jnp.zeros_like(at.t), jnp.zeros_like(at.xi), push)

    def mismatch_at(at: Errors) -> jax.Array:
        return arm_motion.mismatch_torque(parts, kinematics(parts, at, f_tilde))

    change = along(mismatch_at, (at,), (step,))
    inside = change + parts.kf * (matvec(M - M0, push) - L)
    direction = matvec(M0, jnp.linalg.solve(M, inside))
    return inner(at.e2, matvec(M0, push)) + weight * inner(f_tilde, direction)
