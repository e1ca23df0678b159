"""Upper bounds of V_w' of a rigid arm over boxes of the level set V_w = c.

**Coordinates.**  x = (t - t_0, theta_1..theta_n, psi, phi_1..phi_{n-1}, z_1..z_m, sign_1..sign_n,
t_0), with the start t_0 of a part of the time interval.  Angles divide the level among the
barriers, the velocity error and f_tilde:

    sqrt(w_i V1_i) = sqrt(c) sphere(theta)_i,   R = c sphere(theta)_{n+1}^2
    U^T e2 = sqrt(2R) cos(psi) sphere(phi),   M0 = U U^T,   sqrt(w_f) |f_tilde| = sqrt(2R) sin(psi)

so that every x lies on the level set.  sign_i is the side of the tube on which e1_i lies.

**f_tilde.**  With f' = f0 + H f_tilde of (P.3), b = |f_tilde| and the best direction of f_tilde,

    V_w' <= -D - e2^T K2 e2 + b |e2 + w_f f0| - w_f lambda b^2,                               (B.1)
    lambda = least eigenvalue of diag(kf) - (H + H^T)/2

**Parameters.**  For fixed derivatives in (U.1), f0 and H are affine in the coordinates z,

    f'(z) = f'(c) - sum_k (z_k - c_k) (I + dM(c) M0^-1)^-1 (W_k + M_k M0^-1 F)

with the centre c of the box of z.  F is f'(z) once more and is enclosed over the box; its product
with z - c is of second order in the size of the box.  (B.1) is convex in f0 and H, so that its
maximum over z is that at the corners of the box of z: V_w' is bounded at each corner.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.core.linalg import inner, matmul, matvec
from iblf_jax.kernels import lower, upper, with_sign
from iblf_jax.proofs import uncertainty
from iblf_jax.proofs.arm_motion import (
    ArmParts,
    Errors,
    dissipation,
    error_at,
    external_torque,
    inverse_mass,
    motion,
    position,
    rate_along_motion,
    required_torque,
)
from iblf_jax.proofs.forms import along, centre
from iblf_jax.proofs.matrices import (
    least_eigenvalue,
    norm,
    solve_general,
    solve_transposed,
    sphere,
    upper_factor,
)
from iblf_jax.proofs.uncertainty import Numbers, Places


class Constants(NamedTuple):
    """The numbers of a problem; a pytree."""

    parts: ArmParts
    coordinates: Numbers
    weight: jax.Array
    """w_f [rad/(N m)]."""
    level: jax.Array
    """c [N m rad]."""


class Coordinates(NamedTuple):
    """A point of the level set, or a box; see the head of this module."""

    t: jax.Array
    theta: list[jax.Array]
    psi: jax.Array
    phi: list[jax.Array]
    z: jax.Array
    sign: jax.Array


def coordinates(x: jax.Array, n: int, m: int) -> Coordinates:
    """The parts of a vector of coordinates, (2n + 1 + m + n + 1,)."""
    theta = [x[1 + i] for i in range(n)]
    phi = [x[2 + n + i] for i in range(n - 1)]
    start = 2 * n + 1
    z, sign = x[start : start + m], x[start + m : -1]
    return Coordinates(x[-1] + x[0], theta, x[1 + n], phi, z, sign)


class ArmErrors(NamedTuple):
    """What coordinates mean physically."""

    errors: Errors
    energy: jax.Array
    """w V1 of each joint, (n,) [N m rad]."""
    b: jax.Array
    """|f_tilde|, () [N m]."""


def arm_errors(constants: Constants, at: Coordinates) -> ArmErrors:
    """Errors and |f_tilde| at coordinates."""
    parts, level = constants.parts, constants.level
    *sides, rest = sphere(at.theta)
    energy = level * jnp.stack(sides) ** 2
    xi = with_sign(error_at(parts, at.t, energy, at.sign), at.sign)
    radius = jnp.sqrt(2.0 * level) * rest
    direction = jnp.stack(sphere(at.phi))
    scaled_e2 = radius * jnp.cos(at.psi) * direction
    errors = Errors(at.t, xi, scaled_e2)
    U = upper_factor(parts.model.mass_matrix(position(parts, errors)))
    errors = errors._replace(e2=solve_transposed(U, scaled_e2))
    b = radius * jnp.sin(at.psi) / jnp.sqrt(constants.weight)
    return ArmErrors(errors, energy, b)


class Affine(NamedTuple):
    """A vector that is affine in f_tilde."""

    value: jax.Array
    """At f_tilde = 0, (n,)."""
    slope: jax.Array
    """Its derivative, (n, n)."""


def in_f_tilde(function: Callable[[jax.Array], Any], n: int) -> Any:
    """A pytree of vectors that are affine in f_tilde, each as an `Affine`."""
    zero = jnp.zeros(n)
    values = function(zero)
    columns = [along(function, (zero,), (unit,)) for unit in jnp.eye(n)]
    slopes = jax.tree.map(lambda *columns: jnp.stack(columns, axis=-1), *columns)
    return jax.tree.map(Affine, values, slopes)


def add(left: Affine, right: Affine) -> Affine:
    """The sum."""
    return Affine(left.value + right.value, left.slope + right.slope)


def scaled(factor: jax.Array, vector: Affine) -> Affine:
    """The product of a number and a vector."""
    return Affine(factor * vector.value, factor * vector.slope)


def on_columns(function: Callable[[jax.Array], jax.Array], vector: Affine) -> Affine:
    """A linear function of a vector that is affine in f_tilde."""
    n = vector.slope.shape[-1]
    columns = [function(vector.slope[:, i]) for i in range(n)]
    return Affine(function(vector.value), jnp.stack(columns, axis=-1))


class Mismatch(NamedTuple):
    """f' as a function of the parameters: constant + sum_k (z_k - c_k) columns_k, c the centre."""

    constant: Affine
    columns: list[Affine]


class MismatchRate(NamedTuple):
    """The rates in (P.3), as functions of f_tilde."""

    external: Any
    """d0'."""
    columns: list[Any]
    """W_k without M_k M0^-1 (slow - K2 M0^-1 force)."""
    slow: Any
    force: Any
    """Parts of `Motion`."""


def mismatch(constants: Constants, places: Places, at: Errors, z: jax.Array) -> Mismatch:
    """The rate f' over a box of parameters; see the head of this module."""
    numbers, n = constants.coordinates, at.xi.shape[-1]
    external, columns, mass_ratios = torque_columns(constants, places, at, z)
    # The first ones belong to the difference of the scenario's plant from its model.
    fixed = len(columns) - places.coordinates

    def solution_at(z: jax.Array) -> tuple[jax.Array, Affine]:
        """I + dM M0^-1 and f' at coordinates z."""
        size = jnp.concatenate([jnp.ones(fixed), z - numbers.reference])
        total, right = jnp.eye(n), external
        for k, (column, ratio) in enumerate(zip(columns, mass_ratios, strict=True)):
            total = total + size[k] * ratio
            right = add(right, scaled(-size[k], column))
        return total, on_columns(lambda column: solve_general(total, column), right)

    total, constant = solution_at(centre(z))
    _, everywhere = solution_at(z)

    def affine_column(column: Affine, mass_ratio: jax.Array) -> Affine:
        product = on_columns(lambda column: matvec(mass_ratio, column), everywhere)
        force = scaled(jnp.asarray(-1.0), add(column, product))
        return on_columns(lambda column: solve_general(total, column), force)

    pairs = zip(columns[fixed:], mass_ratios[fixed:], strict=True)
    return Mismatch(constant, [affine_column(*pair) for pair in pairs])


class Differences(NamedTuple):
    """What (U.1) needs: g(p) - g(p0) = sum_k sizes_k times the derivative of g along direction k at
    `inside`.
    """

    inside: Any
    """Plant and disturbance with the hull of the model's parameters and those of the box."""
    directions: list[Any]
    """Of the fixed difference of the scenario's plant from its model first, where there is one,
    then of each coordinate; not of rates."""
    sizes: list[jax.Array]
    """1 for the fixed difference, z_k - r_k for the others."""


def differences(constants: Constants, places: Places, z: jax.Array) -> Differences:
    """The differences of the parameters in a box from those of the model."""
    parts, numbers = constants.parts, constants.coordinates
    nominal = (parts.plant, parts.disturbance)
    of_model = (parts.model, parts.disturbance)
    inside = uncertainty.between(places, numbers, nominal, of_model, z)
    fixed = uncertainty.fixed_difference(places, numbers, nominal, of_model)
    directions = uncertainty.directions(places, numbers, of_model)
    sizes = [z[k] - numbers.reference[k] for k in range(len(directions))]
    if fixed is None:
        return Differences(inside, directions, sizes)
    return Differences(inside, [fixed, *directions], [jnp.ones(()), *sizes])


def with_plant(parts: ArmParts, plant_and_disturbance: Any) -> ArmParts:
    """The parts with another plant and disturbance."""
    plant, disturbance = plant_and_disturbance
    return parts._replace(plant=plant, disturbance=disturbance)


def mass_along(inside: Any, direction: Any, q: jax.Array) -> jax.Array:
    """The derivative of the mass matrix along a direction of the parameters, (n, n)."""
    return along(lambda p: p[0].mass_matrix(q), (inside,), (direction,))


class TorqueColumns(NamedTuple):
    """What f' consists of, by coordinate: (I + dM M0^-1) f' = external - sum_k size_k column_k."""

    external: Affine
    """d0'."""
    columns: list[Affine]
    """W_k with j0, of the fixed difference first, where there is one."""
    mass_ratios: list[jax.Array]
    """M_k M0^-1 of each."""


def torque_columns(constants: Constants, places: Places, at: Errors, z: jax.Array) -> TorqueColumns:
    """The columns of f' over a box of parameters."""
    parts, n = constants.parts, at.xi.shape[-1]
    inside, directions, _ = differences(constants, places, z)
    of_model = (parts.model, parts.disturbance)
    q, M0_inverse = position(parts, at), inverse_mass(parts, at)

    def rates(f_tilde: jax.Array) -> MismatchRate:
        moved = motion(parts, at, f_tilde)

        def torque_rate(p: Any) -> jax.Array:
            return rate_along_motion(
                required_torque, with_plant(parts, p), moved.now, moved.alpha_jerk
            )

        external = rate_along_motion(
            external_torque, with_plant(parts, of_model), moved.now, moved.alpha_jerk
        )
        columns = [along(torque_rate, (inside,), (direction,)) for direction in directions]
        return MismatchRate(external, columns, moved.slow, moved.force)

    affine = in_f_tilde(rates, n)
    # M_k M0^-1, of which the inverse is a narrow interval where q is one
    mass_ratios = [matmul(mass_along(inside, x, q), M0_inverse) for x in directions]

    def torque_column(column: Affine, mass_ratio: jax.Array) -> Affine:
        fast = matmul(mass_ratio * parts.law.K2, M0_inverse)
        with_slow = add(column, on_columns(lambda slow: matvec(mass_ratio, slow), affine.slow))
        return add(with_slow, on_columns(lambda force: -matvec(fast, force), affine.force))

    columns = list(map(torque_column, affine.columns, mass_ratios))
    # The rate of a further disturbance is a coordinate without entries.
    columns += [Affine(-unit, jnp.zeros((n, n))) for unit in jnp.eye(n)[: places.rates]]
    mass_ratios += [jnp.zeros((n, n))] * places.rates
    return TorqueColumns(affine.external, columns, mass_ratios)


def corners(f_rate: Mismatch, z: jax.Array) -> list[Affine]:
    """The rate f' at each corner of the box of parameters."""
    size = z - centre(z)
    ends = [(lower(size[k]), upper(size[k])) for k in range(len(f_rate.columns))]
    vertices = []
    for choice in itertools.product(*ends):
        vertex = f_rate.constant
        for factor, column in zip(choice, f_rate.columns, strict=True):
            vertex = add(vertex, scaled(factor, column))
        vertices.append(vertex)
    return vertices


class Corner(NamedTuple):
    """The terms of (B.1) at a corner of the box of parameters."""

    force: jax.Array
    """|f0|, () [N m/s]; with a held torque |push|/w_f."""
    gain: jax.Array
    """lambda, () [1/s]."""
    coupling: jax.Array
    """b |e2 + w_f f0| - w_f lambda b^2, () [N m rad/s]."""
    square: jax.Array
    """The same from a completed square, for an upper bound: D b - m b^2 = D^2/(4m) - m (b -
    D/(2m))^2 with D = |e2 + w_f f0| and m = w_f lambda."""
    directed: jax.Array
    """-K |e2|^2 + the same = -K (D - b/(2K))^2 - mu b^2 + K w_f f0 . (2 e2 + w_f f0), with K =
    min K2 and mu = m - 1/(4K)."""


class HeldTorque(NamedTuple):
    """What a held torque adds to (B.1), as a function of f_tilde (`arm_held`)."""

    power: jax.Array
    """Of V_w' at f_tilde = 0, () [N m rad/s]."""
    push: jax.Array
    """Of the coefficients of f_tilde, (n,) [rad/s]."""
    slope: jax.Array
    """Of H, (n, n) [1/s]."""


def corner_terms(
    constants: Constants,
    point: ArmErrors,
    vertices: list[Affine],
    held_torque: HeldTorque | None = None,
) -> list[Corner]:
    """The terms of (B.1) at each corner of the box of parameters, from f' there."""
    parts, weight, b = constants.parts, constants.weight, point.b
    e2 = point.errors.e2
    kf, K = jnp.diag(parts.kf), jnp.min(parts.law.K2)
    terms = []
    for vertex in vertices:
        push, slope, force = weight * vertex.value, vertex.slope, norm(vertex.value)
        if held_torque is not None:
            push, slope = push + held_torque.push, slope + held_torque.slope
            force = norm(push) / weight
        gain = least_eigenvalue(kf - 0.5 * (slope + slope.T))
        drive = norm(e2 + push)
        m = weight * gain
        largest, least = upper(drive), lower(m)
        square = largest**2 / (4.0 * least) - least * (b - largest / (2.0 * least)) ** 2
        mu = lower(m - 1.0 / (4.0 * K))
        directed = inner(push, 2.0 * e2 + push) * K - K * (drive - b / (2.0 * K)) ** 2 - mu * b**2
        terms.append(Corner(force, gain, b * drive - m * b**2, square, directed))
    return terms


def dissipation_bound(constants: Constants, point: ArmErrors) -> jax.Array:
    """A lower bound of the dissipation of the barriers, ()."""
    parts = constants.parts
    exact = dissipation(parts, point.errors)
    claimed = parts.law.barrier.decay_rate(parts.law.k1) * point.energy  # type: ignore[operator]
    return jnp.sum(jnp.maximum(exact, claimed))


def arm_bound(places: Places, n: int, x: jax.Array, constants: Constants) -> jax.Array:
    """Upper bounds of V_w' over the box x, (3,) [N m rad/s]; infinite where the barrier's guard may
    be active.
    """
    at = coordinates(x, n, places.coordinates)
    point = arm_errors(constants, at)
    vertices = corners(mismatch(constants, places, point.errors, at.z), at.z)
    bounds = bounds_from(constants, point, dissipation_bound(constants, point), vertices)
    return jnp.where(is_inside_guard(constants, point), bounds, jnp.inf)


def bounds_from(
    constants: Constants,
    point: ArmErrors,
    losses: jax.Array,
    vertices: list[Affine],
    held_torque: HeldTorque | None = None,
) -> jax.Array:
    """Upper bounds of V_w' from lower bounds of the dissipation and f' at the corners of the box
    of parameters, (3,) [N m rad/s].
    """
    e2, b = point.errors.e2, point.b
    if held_torque is not None:
        losses = losses - held_torque.power
    terms = corner_terms(constants, point, vertices, held_torque)
    coupling = jnp.max(jnp.stack([jnp.minimum(term.coupling, term.square) for term in terms]))
    direct = coupling - losses - inner(e2, constants.parts.law.K2 * e2)
    directed = jnp.max(jnp.stack([term.directed for term in terms])) - losses
    squares = _squares(constants, norm(e2), b, terms) - losses
    return jnp.stack([direct, squares, directed])


def is_inside_guard(constants: Constants, point: ArmErrors) -> jax.Array:
    """Whether the barrier's guard is not active, () bool."""
    return jnp.max(jnp.abs(point.errors.xi)) < 1.0 - constants.parts.guard


def _squares(constants: Constants, a: jax.Array, b: jax.Array, terms: list[Corner]) -> jax.Array:
    """A bound of (B.1) without D from completed squares, ().

    -K a^2 + a b + w_f |f0| b - w_f lambda b^2
        = -K (a - b/(2K))^2 - mu (b - w_f |f0|/(2 mu))^2 + (w_f |f0|)^2/(4 mu),
    mu = w_f lambda - 1/(4K),   K = min K2,   a = |e2|
    """
    K = jnp.min(constants.parts.law.K2)
    bounds = []
    for term in terms:
        mu = lower(constants.weight * term.gain) - 1.0 / (4.0 * K)
        push = upper(constants.weight * term.force)
        bounds.append(push**2 / (4.0 * mu) - mu * (b - push / (2.0 * mu)) ** 2)
    return jnp.max(jnp.stack(bounds)) - K * (a - b / (2.0 * K)) ** 2
