"""Upper bounds of V_w' of a rigid arm whose law and observer are sampled, at all times.

Law and observer run every h seconds, and the torque of a sample is held.  V_w is that of the torque
u(X) that the law would command at the state X = (t, q, v, phi), where phi is the estimate of the
observer, interpolated between samples:

    u = M0 alpha' + C0 alpha + G0 - phi - K2 e2 - w s,   f_tilde = f(u(X)) - phi,
    phi' = g (p' - phi_k - tau_k - n_k) + r p',   p = M0 v,   n = M0' v - C0 v - G0           (H.1)

phi is the discrete estimate at each sample, and V_w is continuous there:

    g = (1 - exp(-kf h))/h for "poles" and "exact",   g = kf for "euler",
    r = kf - g for "exact",   r = 0 for the others.

With the differences since the sample

    D = tau_k - u,   L = n - n_k + phi - phi_k,   A = M0 M^-1,   K = dM M0^-1,   A (I + K) = I,

    phi' = g (f_tilde - K A D + L) + r (u_h + n + f_tilde + A D),                             (H.2)
    u' = u_h' - phi',   L' = n' + phi',
    V_w' = (rate of the continuous loop with the gain g + r) + e2^T A D
           + w_f f_tilde^T A [(F M0^-1 + g K - r) A D - g L - r (u_h + n)],                   (H.3)

where u_h = u + phi, u_h + n + f_tilde = p' at D = 0, and F is the derivative of f(u(X)) along e2 at
a given f_tilde.  D and L follow from their rates along the path since the sample, which are affine
in f_tilde:

    D = -s (u0 + U f_tilde),   L = s (n0 + N f_tilde),   0 <= s <= h                          (H.4)

with means over the path.  (H.3) is affine in s for given means, and its maximum over f_tilde convex
in s: it is bounded at s = 0 and at s = h.  `ArmParts.kf` is g + r, and `ArmParts.innovation_gain`
is g where r is not 0.

**The path.**  Bounds |u'| <= R_u, |L'| <= R_L and |f'| <= R_f on the whole set, under |D| <= h R_u
and |L| <= h R_L, hold along every run: D and L are 0 at a sample, and up to the first time at which
one of them reaches its bound, which is before the next sample, the rates are below theirs
(`rate_excess`).  With them, the motion backward from a box obeys a differential inclusion.  A box
that contains the end of each of its steps in its interior contains the path: `_path` inflates the
box by its rates and tests that.  Paths from boxes near e1 = 0 come from the other side of the tube;
there, `TwoSided` joins the values of the barrier's functions on both sides.

**Errors of measurements.**  A sample reads q + dq with a bounded dq, and law and observer use f_hat
= eta + (g + r) M0 v at this position.  With phi = eta + (g + r) M0 v of the true state,
(H.1) holds with the values phi_k and n_k of the measured one, and so do (H.2) and (H.3).  At a
sample, D and L are not 0 then, but

    D_0 = d u_h - (g + r) d p,   L_0 = -(g + r) d p - d n,                                    (H.5)

where d is the difference between the measured state and the true one.  D and L in (H.4) begin with
D_0 and L_0, which are enclosed by the mean value theorem over a box of the path and of what may be
measured on it; |D_0| <= E_u and |L_0| <= E_L on the whole set, and the bounds of D and L in the
section above are h R_u + E_u and h R_L + E_L.

**Active limits.**  A sample commands tau_k = sat(u), and the observer receives it: (H.2) and (H.3)
hold with D_0 = sat(u) - u at the sample and L_0 = 0, which are enclosed as those of (H.5).  The
term e2^T A D is treated as in `arm_limits`: with c = A^T e2 and the P of (T.2), at any age

    c_i D_i <= max(-s c_i u_i', P_i),                                                         (H.6)

where P_i is that of u(X) at the age s, because a limit that cuts the command leaves D_i = limit -
u_i.  Each choice of one of both for every joint is affine in f_tilde and in s.

**Delays.**  Commands arrive in their order, each after a delay in [0, d], d <= h, which may differ
from sample to sample.  The active torque tau_a is that of the last sample or of the one before it,
and the observer has that of the last sample.  (H.2) and (H.3) hold with D = tau_a - u and L = n -
n_k + phi - phi_k + tau_a - tau_k.  If the command of the last sample has not arrived,

    D = -(s + h) u',   L = D + s (u_h' + n'),   0 <= s <= d,                                  (H.7)

with means over the path since either sample, because L - D = u_h + n - (u_h + n)_k.  Otherwise
(H.4) holds.  So V_w' is bounded at s = 0 and s = d of (H.7) as well.  The path is one of the length
h + d, and the bounds of the section above are |D| <= (h + d) R_u and |L| <= h R_L + h R_u.

Until the first command arrives, the torque is a foreign one.  If it differs from u at the start by
at most h R_u, these bounds hold from the start on, because then |D| <= (h + s) R_u at any time s <=
d, and |L| <= s R_L + h R_u.  With a bound V_w' <= R_V on the whole set for all such D and L, a run
that starts with V_w <= c - d R_V has V_w <= c when the first command arrives.  At an exit after it,
both samples are at or after the start, the path since them lies in {V_w <= c} with these bounds,
and V_w' < 0.
"""

from __future__ import annotations

import copy
import functools
import itertools
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp

from iblf_jax.core import checks
from iblf_jax.core.linalg import inner, matmul, matvec
from iblf_jax.kernels import hull, lower, meet, upper, with_sign
from iblf_jax.proofs import arm_motion
from iblf_jax.proofs.arm_bound import (
    Affine,
    ArmErrors,
    Constants,
    Coordinates,
    HeldTorque,
    add,
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
    scaled,
    with_plant,
)
from iblf_jax.proofs.arm_motion import ArmParts, Errors, kinematics, position, velocity
from iblf_jax.proofs.arm_torque import cut, law_torque, power_of_cut, values_of
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
    """Bounds on the whole set, (n,) each, of rates [N m/s] and of differences at samples [N m]."""

    command: jax.Array
    """R_u."""
    lag: jax.Array
    """R_L."""
    mismatch: jax.Array
    """R_f."""
    first_command: jax.Array | None = None
    """E_u; None for exact measurements without active limits."""
    first_lag: jax.Array | None = None
    """E_L."""
    growth: jax.Array | None = None
    """R_V for each joint, equal entries [N m rad/s]; None without a delay."""

    def differences(self, parts: ArmParts) -> tuple[jax.Array, jax.Array]:
        """D and L at all ages."""
        h = period(parts)
        D, L = oldest_age(parts) * self.command, h * self.lag
        if parts.delay is not None:
            L = L + h * self.command
        if self.first_command is not None and self.first_lag is not None:
            D, L = D + self.first_command, L + self.first_lag
        return symmetric(D), symmetric(L)


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

    def enclosing(gain: jax.Array) -> jax.Array:
        return gain * (1.0 + symmetric(jnp.full_like(gain, GAIN_ERROR)))

    parts = constants.parts
    if parts.innovation_gain is None:
        return constants._replace(parts=parts._replace(kf=enclosing(parts.kf)))
    exact = enclosing(parts.innovation_gain)
    return constants._replace(parts=parts._replace(innovation_gain=exact))


def period(parts: ArmParts) -> jax.Array:
    """The period of the samples, () [s]."""
    assert parts.period is not None
    return parts.period


def oldest_age(parts: ArmParts) -> jax.Array:
    """The greatest age of an active torque, h + d, () [s]."""
    return period(parts) if parts.delay is None else period(parts) + parts.delay


def rate_limits(parts: ArmParts, rows: jax.Array) -> PathRates:
    """The bounds in the rows of the last constant of a problem."""
    if parts.delay is None:
        return PathRates(*rows)
    *rates, growth = rows
    return PathRates(*rates)._replace(growth=growth)


def innovation_gain(parts: ArmParts) -> jax.Array:
    """The gain g, (n,) [1/s]."""
    return parts.kf if parts.innovation_gain is None else parts.innovation_gain


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


def momentum_rate(parts: ArmParts, at: Errors) -> jax.Array:
    """The rate u_h + n of the momentum M0 v at f_tilde = 0 and D = 0, (n,) [N m]."""
    return free_torque(parts, at) + momentum_term(parts, at)


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
    p_rate: jax.Array
    """u_h + n, (n,) [N m]."""


def mismatch_slope(constants: Constants, places: Places, at: Errors, z: jax.Array) -> jax.Array:
    """F, the derivative of f along e2 at a given f_tilde, (n, n) [N m s/rad]."""
    parts, n = constants.parts, at.xi.shape[-1]
    inside, directions, sizes = differences(constants, places, z)
    of_model = (parts.model, parts.disturbance)
    zero = jnp.zeros(n)

    def terms(at: Errors) -> tuple[jax.Array, list[jax.Array]]:
        now = kinematics(parts, at, zero)

        def required(p: Any) -> jax.Array:
            return arm_motion.required_torque(with_plant(parts, p), now)

        external = arm_motion.external_torque(with_plant(parts, of_model), now)
        return external, [along(required, (inside,), (direction,)) for direction in directions]

    columns = []
    for step in steps_of_e2(at):
        column, of_parameters = along(terms, (at,), (step,))
        for size, term in zip(sizes, of_parameters, strict=True):
            column = column - size * term
        columns.append(column)
    return jnp.stack(columns, axis=-1)


def steps_of_e2(at: Errors) -> list[Errors]:
    """The directions of the entries of e2."""
    zero = jax.tree.map(jnp.zeros_like, at)
    return [zero._replace(e2=unit) for unit in jnp.eye(len(at.e2))]


def first_rates(constants: Constants, places: Places, at: Errors, z: jax.Array) -> FirstRates:
    """The rates of u_h and n, and F, at errors."""
    parts, n = constants.parts, at.xi.shape[-1]

    def functions(at: Errors) -> tuple[jax.Array, jax.Array]:
        return free_torque(parts, at), momentum_term(parts, at)

    torque, momentum = along(functions, (at,), (path_rates(parts, at, jnp.zeros(n), 0.0),))
    columns = [along(functions, (at,), (step,)) for step in steps_of_e2(at)]
    of_torque, of_momentum = (jnp.stack(rows, axis=-1) for rows in zip(*columns, strict=True))
    return FirstRates(
        Affine(torque, of_torque),
        Affine(momentum, of_momentum),
        mismatch_slope(constants, places, at, z),
        momentum_rate(parts, at),
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
    """The box of a path backward from `point`, up to the greatest age; see the head of this
    module.
    """
    parts = constants.parts
    h, g, at = oldest_age(parts), parts.kf, point.errors
    sign = cast(TwoSided, parts.law.barrier).sign
    D, L = limits.differences(parts)

    # u_h + n = u + phi + n changes along the path as u and L do.
    p_rate = momentum_rate(parts, at) + symmetric(h * (limits.command + limits.lag))

    def estimate_term(at: Errors) -> tuple[jax.Array, jax.Array]:
        """Of f_tilde' all but -g f_tilde as a magnitude, and the acceleration by D."""
        error = mass_error(constants, places, at, z)
        size = jnp.abs(change_of_f_tilde(parts, error, p_rate, limits, D, L))
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


class AgingRates(NamedTuple):
    """Rates along the path as functions of f_tilde."""

    command: Affine
    """u' [N m/s]."""
    lag: Affine
    """n' + phi', which is L' between samples without a delay."""
    p_rate: Affine
    """u_h' + n'."""


def rates_under(
    parts: ArmParts, error: MassError, rates: FirstRates, D: jax.Array, L: jax.Array
) -> AgingRates:
    """The rates under differences D and L."""
    AD = matvec(error.ratio, D)
    push, estimate = matvec(error.inverse, AD), estimate_rate(parts, error, rates.p_rate, AD, L)

    def under(rate: Affine) -> Affine:
        slope = matmul(rate.slope, error.inverse)
        return Affine(rate.value + matvec(rate.slope, push), slope)

    command, momentum = under(rates.torque), under(rates.momentum)
    decay = jnp.diag(parts.kf)
    return AgingRates(
        Affine(command.value - estimate, command.slope - decay),
        Affine(momentum.value + estimate, momentum.slope + decay),
        add(command, momentum),
    )


def estimate_rate(
    parts: ArmParts, error: MassError, p_rate: jax.Array, AD: jax.Array, L: jax.Array
) -> jax.Array:
    """The rate phi' of the estimate but for (g + r) f_tilde, (n,) [N m/s]; `p_rate` is u_h + n."""
    g = innovation_gain(parts)
    rate = g * (L - matvec(error.relative, AD))
    if parts.innovation_gain is None:
        return rate
    return rate + (parts.kf - g) * (p_rate + AD)


def change_of_f_tilde(
    parts: ArmParts,
    error: MassError,
    p_rate: jax.Array,
    limits: PathRates,
    D: jax.Array,
    L: jax.Array,
) -> jax.Array:
    """The rate of f_tilde but for its own decay, f_tilde' + (g + r) f_tilde, (n,) [N m/s]."""
    AD = matvec(error.ratio, D)
    return symmetric(limits.mismatch) - estimate_rate(parts, error, p_rate, AD, L)


class FirstDifferences(NamedTuple):
    """D and L at a sample, (n,) each [N m]."""

    D: jax.Array
    """D_0 of (H.5)."""
    L: jax.Array
    """L_0."""
    is_inside: jax.Array | bool
    """Whether no guard of the barrier is active at what is measured, ()."""
    commands: jax.Array | None = None
    """u of samples, (n,) [N m], where limits may be active."""


def cut_differences(parts: ArmParts, commands: jax.Array) -> FirstDifferences:
    """D_0 of commands that limits cut; L_0 is 0."""
    limits = parts.torque_limits
    assert limits is not None
    D = cut(commands, limits)
    return FirstDifferences(D, jnp.zeros_like(D), is_inside=True, commands=commands)


def first_sizes(parts: ArmParts, at: Errors) -> tuple[jax.Array, jax.Array]:
    """Bounds of |D_0| and |L_0| by the mean value theorem, (n,) each [N m], at errors that contain
    the true ones and those that are measured.
    """
    assert parts.measurement_error is not None
    zero, k = jnp.zeros_like(at.xi), arm_motion.side_of(parts, at.t, at.xi).k

    def functions(at: Errors) -> tuple[jax.Array, jax.Array]:
        q = position(parts, at)
        momentum = parts.kf * matvec(parts.model.mass_matrix(q), velocity(parts, at))
        return free_torque(parts, at) - momentum, momentum + momentum_term(parts, at)

    D = L = zero
    for size, unit in zip(parts.measurement_error, jnp.eye(len(zero)), strict=True):
        # e2 = v - alpha at a given v
        dxi = unit / k
        alpha = along(lambda xi: arm_motion.relative_alpha(parts, at.t, xi), (at.xi,), (dxi,))
        step = Errors(jnp.zeros_like(at.t), dxi, -alpha)
        command, lag = along(functions, (at,), (step,))
        D = D + size * jnp.abs(command)
        L = L + size * jnp.abs(lag)
    return D, L


def first_differences(parts: ArmParts, at: Errors) -> FirstDifferences:
    """D_0 and L_0 of samples in a box of errors; the barrier of `parts` is two-sided."""
    assert parts.measurement_error is not None
    sign = cast(TwoSided, parts.law.barrier).sign
    side = arm_motion.side_of(parts, at.t, at.xi)
    dxi = symmetric(parts.measurement_error / side.k)
    xi = with_sign(at.xi + dxi, sign)
    alpha = along(lambda xi: arm_motion.relative_alpha(parts, at.t, xi), (xi,), (dxi,))
    e2 = at.e2 + symmetric(jnp.abs(alpha))
    D, L = first_sizes(parts, Errors(at.t, xi, e2))
    free = 1.0 - parts.guard
    # Beyond e1 = 0, xi is in parts of the width on this side.
    other = jnp.where(sign > 0.0, -side.scaled.lower, side.scaled.upper)
    is_inside = jnp.all((sign * xi < free) & (-sign * xi < free * other))
    return FirstDifferences(symmetric(D), symmetric(L), is_inside)


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
    parts: ArmParts,
    path: Path,
    error: MassError,
    rates: FirstRates,
    limits: PathRates,
    first: FirstDifferences | None = None,
) -> PathMeans:
    """The means over a path of any age."""
    h, g = oldest_age(parts), parts.kf
    D, L = limits.differences(parts)
    change = change_of_f_tilde(parts, error, rates.p_rate, limits, D, L)
    # The mean of a difference that grows from 0 on at such a rate has half of the age.
    half = up_to(0.5 * h)
    rest = half * (g * (up_to(h) * (g * path.f_tilde - change)) - change)
    if parts.delay is not None:
        # On the path, commands are active that are older than it.
        return PathMeans(D, L, 1.0 + half * g, rest)
    # The rates on the path, within the bounds on the whole set.
    under = rates_under(parts, error, rates, D, L)
    u_rate, L_rate = (
        meet(rate.value + matvec(rate.slope, path.f_tilde), symmetric(limit))
        for rate, limit in ((under.command, limits.command), (under.lag, limits.lag))
    )
    mean_D, mean_L = -half * u_rate, half * L_rate
    if first is not None:
        mean_D, mean_L = first.D + mean_D, first.L + mean_L
    return PathMeans(mean_D, mean_L, 1.0 + half * g, rest)


def mean_rates(
    parts: ArmParts, error: MassError, rates: FirstRates, means: PathMeans
) -> AgingRates:
    """The means of the rates over the path, as functions of f_tilde at its end."""

    def over_path(rate: Affine) -> Affine:
        return Affine(rate.value + matvec(rate.slope, means.rest), rate.slope * means.growth)

    return AgingRates(*map(over_path, rates_under(parts, error, rates, means.D, means.L)))


def held_terms(
    constants: Constants,
    places: Places,
    point: ArmErrors,
    z: jax.Array,
    path: Path,
    limits: PathRates,
    first: FirstDifferences | None,
) -> list[HeldTorque | None]:
    """What the held torque adds at the ages between which V_w' is affine, and with limits for each
    choice of (H.6).
    """
    parts, e2 = constants.parts, point.errors.e2
    limits_of_torque = parts.torque_limits
    error = mass_error(constants, places, path.at, z)
    rates = first_rates(constants, places, path.at, z)
    means = path_means(parts, path, error, rates, limits, first)
    mean = mean_rates(parts, error, rates, means)
    h = period(parts)
    # The choices add e2^T A D.
    in_sum = e2 if limits_of_torque is None else jnp.zeros_like(e2)

    def added(D: Affine, L: Affine) -> HeldTorque:
        return added_terms(constants, in_sum, error, rates.mismatch, D, L)

    aged = scaled(-h, mean.command)
    old = added(aged, scaled(h, mean.lag))
    if parts.delay is not None:
        late = scaled(-oldest_age(parts), mean.command)
        return [
            None,
            old,
            added(aged, aged),
            added(late, add(late, scaled(parts.delay, mean.p_rate))),
        ]
    if first is None:
        return [None, old]
    fresh = first_terms(constants, in_sum, error, rates.mismatch, first)
    old = HeldTorque(fresh.power + old.power, fresh.push + old.push, old.slope)
    if limits_of_torque is None:
        return [fresh, old]
    c = matvec(error.ratio.T, e2)
    torque = law_torque(constants, places, point.errors, z)
    power = power_of_cut(c, torque, checks.given(first.commands), limits_of_torque)
    none = Affine(jnp.zeros_like(e2), jnp.zeros_like(error.ratio))
    aging = Affine(c * aged.value, c[:, None] * aged.slope)
    return [*with_powers(fresh, none, power), *with_powers(old, aging, power)]


def with_powers(rest: HeldTorque, *powers: Affine) -> list[HeldTorque]:
    """The terms with e2^T A D, for each choice of one of some powers for every joint."""
    n = len(rest.push)
    terms = []
    for chosen in itertools.product(powers, repeat=n):
        value, push = rest.power, rest.push
        for i, power in enumerate(chosen):
            value, push = value + power.value[i], push + power.slope[i]
        terms.append(HeldTorque(value, push, rest.slope))
    return terms


def weight_of_command(parts: ArmParts, error: MassError, F: jax.Array) -> jax.Array:
    """The matrix F M0^-1 + g K - r of (H.3), (n, n) [1/s]."""
    g = innovation_gain(parts)
    matrix = matmul(F, error.inverse) + g[:, None] * error.relative
    if parts.innovation_gain is None:
        return matrix
    return matrix - jnp.diag(parts.kf - g)


def first_terms(
    constants: Constants, e2: jax.Array, error: MassError, F: jax.Array, first: FirstDifferences
) -> HeldTorque:
    """The terms of (H.3) with D_0 and L_0."""
    parts, A = constants.parts, error.ratio
    AD = matvec(A, first.D)
    inside = matvec(weight_of_command(parts, error, F), AD) - innovation_gain(parts) * first.L
    push = constants.weight * matvec(A, inside)
    return HeldTorque(inner(e2, AD), push, jnp.zeros_like(A))


def added_terms(
    constants: Constants, e2: jax.Array, error: MassError, F: jax.Array, D: Affine, L: Affine
) -> HeldTorque:
    """The terms of (H.3) with D and L."""
    weight, g = constants.weight, innovation_gain(constants.parts)
    K, A = error.relative, error.ratio
    G = weight_of_command(constants.parts, error, F)
    # A D and the bracket of (H.3).
    value = D.value - matvec(K, matvec(A, D.value))
    slope = matmul(A, D.slope)
    inside = matvec(G, value) - g * L.value
    of_f_tilde = matmul(G, slope) - g[:, None] * L.slope
    push = matvec(slope.T, e2) + weight * matvec(A, inside)
    return HeldTorque(inner(e2, value), push, matmul(A, of_f_tilde))


def bias(constants: Constants, places: Places, at: Errors, z: jax.Array) -> jax.Array:
    """The term A r (u_h + n) of (H.3), (n,) [N m/s]."""
    parts = constants.parts
    error = mass_error(constants, places, at, z)
    return matvec(error.ratio, (parts.kf - innovation_gain(parts)) * momentum_rate(parts, at))


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
    if constants.parts.innovation_gain is not None:
        shift = bias(constants, places, point.errors, at.z)
        vertices = [vertex._replace(value=vertex.value - shift) for vertex in vertices]
    losses = dissipation_bound(constants, point)
    both = constants._replace(parts=two_sided(constants.parts, at.sign))
    path = _path(both, places, point, at.z, limits)
    first = None
    if both.parts.measurement_error is not None:
        first = first_differences(both.parts, path.at)
    elif both.parts.torque_limits is not None:
        torque = law_torque(both, places, path.at, at.z)
        commands = torque.value + matvec(torque.slope, path.f_tilde)
        first = cut_differences(both.parts, commands)
    bounds = [
        jnp.min(bounds_from(constants, point, losses, vertices, terms))
        for terms in held_terms(both, places, point, at.z, path, limits, first)
    ]
    # A box of which the path is not enclosed may have a narrower one inside.
    bound = functools.reduce(jnp.maximum, bounds)
    bound = jnp.where(path.is_enclosed, bound, hull(jnp.inf, -LARGE))
    if first is not None:
        bound = jnp.where(first.is_inside, bound, hull(jnp.inf, -LARGE))
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
    is_inside = is_inside_guard(constants, point)
    first = None
    if constants.parts.measurement_error is not None:
        first = first_differences(two_sided(constants.parts, at.sign), point.errors)
    elif constants.parts.torque_limits is not None:
        torque = law_torque(constants, places, point.errors, at.z)
        first = cut_differences(constants.parts, values_of(torque, point.b))
    if first is not None:
        sizes += [jnp.abs(first.D), jnp.abs(first.L)]
        is_inside = is_inside & first.is_inside
    if limits.growth is not None:
        sizes.append(growth_bound(constants, places, point, at.z, limits) * jnp.ones(n))
    given = [limit for limit in limits if limit is not None]
    excess = jnp.max(jnp.stack([s / most for s, most in zip(sizes, given, strict=True)]))
    return jnp.where(is_inside, excess - 1.0, jnp.inf)[None]


def growth_bound(
    constants: Constants, places: Places, point: ArmErrors, z: jax.Array, limits: PathRates
) -> jax.Array:
    """An upper bound of V_w' for all D, L and f' within their bounds, () [N m rad/s]."""
    parts, at, b, weight = constants.parts, point.errors, point.b, constants.weight
    error = mass_error(constants, places, at, z)
    D, L = limits.differences(parts)
    AD = matvec(error.ratio, D)
    # f_tilde' + (g + r) f_tilde
    change = change_of_f_tilde(parts, error, momentum_rate(parts, at), limits, D, L)
    drive = inner(at.e2, AD - parts.law.K2 * at.e2) + b * norm(at.e2 + weight * change)
    return drive - dissipation_bound(constants, point) - weight * jnp.min(parts.kf) * b**2


def _rates(
    constants: Constants, places: Places, point: ArmErrors, at: Coordinates, limits: PathRates
) -> list[Affine]:
    """u', n' + phi' and f' as functions of f_tilde."""
    parts, errors = constants.parts, point.errors
    n = errors.xi.shape[-1]
    inside, directions, sizes = differences(constants, places, at.z)
    error = mass_error(constants, places, errors, at.z)
    D, L = limits.differences(parts)
    AD = matvec(error.ratio, D)
    push = matvec(error.inverse, AD)
    lagging = estimate_rate(parts, error, momentum_rate(parts, errors), AD, L)
    of_model = (parts.model, parts.disturbance)

    def rates(f_tilde: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        step = path_rates(parts, errors, f_tilde, push)
        estimate = parts.kf * f_tilde + lagging
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


def biased_rate(parts: ArmParts, at: Errors) -> jax.Array:
    """The part r (u_h + n) of phi', (n,) [N m/s]."""
    if parts.innovation_gain is None:
        return jnp.zeros_like(parts.kf)
    return (parts.kf - parts.innovation_gain) * momentum_rate(parts, at)


def mass_ratio(parts: ArmParts, at: Errors, vector: jax.Array) -> jax.Array:
    """A times a vector for the true plant in `parts`, (n,)."""
    q = position(parts, at)
    M0, M = parts.model.mass_matrix(q), parts.plant.mass_matrix(q)
    return matvec(M0, jnp.linalg.solve(M, vector))


def differences_of_ages(parts: ArmParts, rates: HeldRates) -> list[tuple[jax.Array, jax.Array]]:
    """D and L to first order at the ages between which V_w' is affine, but for those of 0."""
    h = period(parts)
    aged = -h * rates.command
    found = [(aged, h * rates.lag)]
    if parts.delay is None:
        return found
    late = -oldest_age(parts) * rates.command
    return [*found, (aged, aged), (late, late + parts.delay * (rates.command + rates.lag))]


def rates_at(
    parts: ArmParts, at: Errors, f_tilde: jax.Array, D: jax.Array | None = None
) -> HeldRates:
    """The rates of u, L and f at the age 0, of the true plant in `parts`; with a D there, that of f
    is an estimate.
    """
    step, bias = arm_motion.rates_of_errors(parts, at, f_tilde), biased_rate(parts, at)
    if D is not None:
        AD, g = mass_ratio(parts, at, D), innovation_gain(parts)
        push = matvec(arm_motion.inverse_mass(parts, at), AD)
        step = step._replace(e2=step.e2 + push)
        bias = bias + g * (AD - D) + (parts.kf - g) * AD
    estimate = parts.kf * f_tilde + bias
    torque = along(lambda at: free_torque(parts, at), (at,), (step,))
    momentum = along(lambda at: momentum_term(parts, at), (at,), (step,))
    # f' contains K A phi', and K A = I - A.
    change = arm_motion.mismatch_rate(parts, at, f_tilde) + bias - mass_ratio(parts, at, bias)
    return HeldRates(torque - estimate, momentum + estimate, change)


def bias_addition(parts: ArmParts, weight: jax.Array, at: Errors, f_tilde: jax.Array) -> jax.Array:
    """What r (u_h + n) adds to V_w' by (H.3), for numbers and the true plant in `parts`,
    () [N m rad/s].
    """
    return -weight * inner(f_tilde, mass_ratio(parts, at, biased_rate(parts, at)))


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
    push, g = jnp.linalg.solve(M, D), innovation_gain(parts)
    AD = matvec(M0, push)
    step = Errors(jnp.zeros_like(at.t), jnp.zeros_like(at.xi), push)

    def mismatch_at(at: Errors) -> jax.Array:
        return arm_motion.mismatch_torque(parts, kinematics(parts, at, f_tilde))

    change = along(mismatch_at, (at,), (step,))
    inside = change + g * (matvec(M, push) - AD - L) - (parts.kf - g) * AD
    return inner(at.e2, AD) + weight * inner(f_tilde, mass_ratio(parts, at, inside))
