"""A surface vessel in the horizontal plane: a plant of order 2."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.core import checks
from iblf_jax.core.linalg import matvec, solve_spd
from iblf_jax.core.pytree import Leaf, component, leaf
from iblf_jax.world.plants._base import Plant, Units
from iblf_jax.world.plants.restoring import Restoring

EXCHANGE_RATE = 0.1
"""Square of the frequency at which the levels exchange energy in the default weights [1/s^2]: slow
against gains of 0.3 to 1 1/s, which suit a model ship.  A larger ship is slower, by the square root
of its length, and needs weights of its own."""


@component
class Vessel(Plant):
    """eta' = R(psi) nu,   M nu' + C(nu) nu + D(nu) nu + g(eta) = u   (3 degrees of freedom).

    The levels are eta = (north, east, heading psi) and nu = (surge u, sway v, yaw rate r) in the
    axes of the body; the input is the force and moment of the thrusters in these axes.

        M = [m11 0 0; 0 m22 m23; 0 m23 m33]
        m11 = mass - X_du,   m22 = mass - Y_dv,   m23 = mass centre - Y_dr
        m33 = yaw_inertia - N_dr
        C(nu) nu = (-(m22 v + m23 r) r,   m11 u r,   (m22 v + m23 r) u - m11 u v)
        D(nu) nu = -(X_u + X_uu |u| + X_uuu u^2) u                                      in surge
                   -(Y_v + Y_vv |v| + Y_rv |r|) v - (Y_r + Y_vr |v| + Y_rr |r|) r       in sway
                   -(N_v + N_vv |v| + N_rv |r|) v - (N_r + N_vr |v| + N_rr |r|) r       in yaw

    The names of the hydrodynamic derivatives are those of SNAME: X_du is the surge force per
    surge acceleration, Y_rv the factor of |r| v in the sway force.  C is skew-symmetric, so that
    nu^T M nu' = nu^T (u - D(nu) nu - g(eta)).  `presets.cybership_ii` has the numbers of a model
    ship.

    Args:
      mass: of the vessel, () [kg], > 0.
      yaw_inertia: moment of inertia about the origin of the body, () [kg m^2], > 0.
      centre: distance of the centre of mass ahead of the origin, () [m]; 0 if not given.
      X_du: added mass in surge, usually < 0, () [kg]; 0 if not given.
      Y_dv: added mass in sway, usually < 0, () [kg]; 0 if not given.
      Y_dr: added mass that couples sway and yaw, the same in both equations, () [kg m]; 0 if not
        given.
      N_dr: added moment of inertia in yaw, usually < 0, () [kg m^2]; 0 if not given.
      X_u: linear damping in surge, () [N s/m]; 0 if not given.
      X_uu: quadratic damping in surge, () [N s^2/m^2]; 0 if not given.
      X_uuu: cubic damping in surge, () [N s^3/m^3]; 0 if not given.
      Y_v: linear damping in sway, () [N s/m]; 0 if not given.
      Y_vv: quadratic damping in sway, () [N s^2/m^2]; 0 if not given.
      Y_rv: sway force by |r| v, () [N s^2/(m rad)]; 0 if not given.
      Y_r: sway force by the yaw rate, () [N s/rad]; 0 if not given.
      Y_vr: sway force by |v| r, () [N s^2/(m rad)]; 0 if not given.
      Y_rr: sway force by |r| r, () [N s^2/rad^2]; 0 if not given.
      N_v: yaw moment by the sway velocity, () [N s]; 0 if not given.
      N_vv: yaw moment by |v| v, () [N s^2/m]; 0 if not given.
      N_rv: yaw moment by |r| v, () [N s^2/rad]; 0 if not given.
      N_r: linear damping in yaw, () [N m s/rad]; 0 if not given.
      N_vr: yaw moment by |v| r, () [N s^2/rad]; 0 if not given.
      N_rr: quadratic damping in yaw, () [N m s^2/rad^2]; 0 if not given.
      length: of the hull, for drawings only, () [m], > 0; 1 if not given.
      beam: width of the hull, for drawings only, () [m], > 0; 0.25 if not given.
      restoring: g(eta), any of `iblf_jax.plants.RESTORING`; none if not given.

    Source: T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2011,
      chapters 6 and 7; R. Skjetne, O. Smogeli, T. I. Fossen, Modeling, Identification and Control
      25 (2004) 3-27 (damping).
    """

    mass: Leaf = leaf("kg", sign="positive", shape="scalar")
    yaw_inertia: Leaf = leaf("kg m^2", sign="positive", shape="scalar")
    centre: Leaf = leaf("m", shape="scalar", default=0.0)
    X_du: Leaf = leaf("kg", shape="scalar", default=0.0)
    Y_dv: Leaf = leaf("kg", shape="scalar", default=0.0)
    Y_dr: Leaf = leaf("kg m", shape="scalar", default=0.0)
    N_dr: Leaf = leaf("kg m^2", shape="scalar", default=0.0)
    X_u: Leaf = leaf("N s/m", shape="scalar", default=0.0)
    X_uu: Leaf = leaf("N s^2/m^2", shape="scalar", default=0.0)
    X_uuu: Leaf = leaf("N s^3/m^3", shape="scalar", default=0.0)
    Y_v: Leaf = leaf("N s/m", shape="scalar", default=0.0)
    Y_vv: Leaf = leaf("N s^2/m^2", shape="scalar", default=0.0)
    Y_rv: Leaf = leaf("N s^2/(m rad)", shape="scalar", default=0.0)
    Y_r: Leaf = leaf("N s/rad", shape="scalar", default=0.0)
    Y_vr: Leaf = leaf("N s^2/(m rad)", shape="scalar", default=0.0)
    Y_rr: Leaf = leaf("N s^2/rad^2", shape="scalar", default=0.0)
    N_v: Leaf = leaf("N s", shape="scalar", default=0.0)
    N_vv: Leaf = leaf("N s^2/m", shape="scalar", default=0.0)
    N_rv: Leaf = leaf("N s^2/rad", shape="scalar", default=0.0)
    N_r: Leaf = leaf("N m s/rad", shape="scalar", default=0.0)
    N_vr: Leaf = leaf("N s^2/rad", shape="scalar", default=0.0)
    N_rr: Leaf = leaf("N m s^2/rad^2", shape="scalar", default=0.0)
    length: Leaf = leaf("m", sign="positive", shape="scalar", default=1.0)
    beam: Leaf = leaf("m", sign="positive", shape="scalar", default=0.25)
    restoring: Restoring | None = None
    n: ClassVar[int] = 3
    order: ClassVar[int] = 2
    known_structure = True
    units: ClassVar[tuple[Units, ...]] = (
        ("m", "m", "rad"),
        ("m/s", "m/s", "rad/s"),
        ("N", "N", "N m"),
    )
    level_names: ClassVar[tuple[str, ...]] = ("position", "velocity")
    input_name: ClassVar[str] = "thrust"
    component_names: ClassVar[tuple[str, ...]] = ("north", "east", "heading")

    def check(self) -> None:
        """Raises ValueError for an inertia matrix that is not positive definite, or something that
        is no restoring force.
        """
        if self.restoring is not None:
            remedy = "iblf_jax.plants.RESTORING has them."
            checks.conforms("Vessel.restoring", self.restoring, Restoring, remedy)
        if not checks.is_concrete(self):
            return
        m11, m22, m23, m33 = (float(x) for x in self._inertias())
        if m11 > 0.0 and m22 > 0.0 and m22 * m33 > m23**2:
            return
        got = f"m11 = {m11:g}, m22 = {m22:g}, m23 = {m23:g}, m33 = {m33:g}"
        expected = "m11 > 0, m22 > 0 and m22 m33 > m23^2, a positive definite inertia matrix"
        remedy = "Added masses (X_du, Y_dv, N_dr) are negative numbers in this convention."
        raise checks.fail("Vessel", checks.Words(got), expected, remedy)

    def outline(self, eta: jax.Array) -> jax.Array:
        """Corners of the hull in the plane (east, north), the bow first, (5, 2) [m]."""
        ahead = 0.5 * self.length * jnp.array([1.0, 0.4, -1.0, -1.0, 0.4])
        aside = 0.5 * self.beam * jnp.array([0.0, 1.0, 1.0, -1.0, -1.0])
        north, east, heading = eta[0], eta[1], eta[2]
        s, c = jnp.sin(heading), jnp.cos(heading)
        return jnp.stack([east + ahead * s + aside * c, north + ahead * c - aside * s], axis=-1)

    # --- matrices -----------------------------------------------------------------------------

    def inertia_matrix(self) -> jax.Array:
        """M, (3, 3) [kg, kg m, kg m^2], rigid body and added mass."""
        m11, m22, m23, m33 = self._inertias()
        zero = jnp.zeros_like(m11)
        rows = [[m11, zero, zero], [zero, m22, m23], [zero, m23, m33]]
        return jnp.stack([jnp.stack(row) for row in rows])

    def _inertias(self) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """The entries m11 [kg], m22 [kg], m23 [kg m] and m33 [kg m^2] of M."""
        m23 = self.mass * self.centre - self.Y_dr
        return self.mass - self.X_du, self.mass - self.Y_dv, m23, self.yaw_inertia - self.N_dr

    def coriolis_matrix(self, nu: jax.Array) -> jax.Array:
        """C(nu), (3, 3), skew-symmetric, of rigid body and added mass."""
        momentum = matvec(self.inertia_matrix(), nu)
        zero = jnp.zeros_like(momentum[0])
        rows = [
            [zero, zero, -momentum[1]],
            [zero, zero, momentum[0]],
            [momentum[1], -momentum[0], zero],
        ]
        return jnp.stack([jnp.stack(row) for row in rows])

    def damping_matrix(self, nu: jax.Array) -> jax.Array:
        """D(nu), (3, 3); its symmetric part need not be positive definite."""
        surge, sway, yaw = jnp.abs(nu[0]), jnp.abs(nu[1]), jnp.abs(nu[2])
        zero = jnp.zeros_like(surge)
        d11 = self.X_u + self.X_uu * surge + self.X_uuu * nu[0] ** 2
        d22 = self.Y_v + self.Y_vv * sway + self.Y_rv * yaw
        d23 = self.Y_r + self.Y_vr * sway + self.Y_rr * yaw
        d32 = self.N_v + self.N_vv * sway + self.N_rv * yaw
        d33 = self.N_r + self.N_vr * sway + self.N_rr * yaw
        rows = [[d11, zero, zero], [zero, d22, d23], [zero, d32, d33]]
        return -jnp.stack([jnp.stack(row) for row in rows])

    def rotation(self, heading: jax.Array) -> jax.Array:
        """R(psi), (3, 3) [1], from the axes of the body to north, east and heading."""
        cosine, sine = jnp.cos(heading), jnp.sin(heading)
        zero, one = jnp.zeros_like(cosine), jnp.ones_like(cosine)
        rows = [[cosine, -sine, zero], [sine, cosine, zero], [zero, zero, one]]
        return jnp.stack([jnp.stack(row) for row in rows])

    def _resistance(self, x: jax.Array) -> jax.Array:
        """C(nu) nu + D(nu) nu + g(eta), (3,) [N, N, N m], for x, (2, 3)."""
        force = matvec(self.coriolis_matrix(x[1]) + self.damping_matrix(x[1]), x[1])
        if self.restoring is None:
            return force
        return force + self.restoring.forces(x[0])

    # --- the plant ------------------------------------------------------------------------------

    def drift(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """f, (2, 3): 0 and -M^-1 (C nu + D nu + g)."""
        zero = jnp.zeros_like(x[0])
        return jnp.stack([zero, self.level_rate(2, t, x, zero, 0.0)])

    def gain(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """G, (2, 3, 3): R(psi), M^-1."""
        M = self.inertia_matrix()
        columns = [solve_spd(M, column) for column in jnp.eye(3, dtype=x.dtype)]
        return jnp.stack([self.rotation(x[0, 2]), jnp.stack(columns, axis=-1)])

    def level_rate(
        self, level: int, t: jax.Array, x: jax.Array, above: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """x_i', (3,); `torque` is added to the forces, (3,) [N, N, N m]."""
        if level == 1:
            return matvec(self.rotation(x[0, 2]), above)
        return solve_spd(self.inertia_matrix(), above + torque - self._resistance(x))

    def level_input(
        self, level: int, t: jax.Array, x: jax.Array, rate: jax.Array, torque: jax.Array | float
    ) -> jax.Array:
        """The velocity nu, or the forces, (3,), for which x_i' is `rate`."""
        if level == 1:
            return matvec(self.rotation(x[0, 2]).T, rate)
        return matvec(self.inertia_matrix(), rate) + self._resistance(x) - torque

    def transposed_gain(self, level: int, t: jax.Array, x: jax.Array, s: jax.Array) -> jax.Array:
        """G_i^T s, (3,)."""
        if level == 1:
            return matvec(self.rotation(x[0, 2]).T, s)
        return solve_spd(self.inertia_matrix(), s)

    def steady_levels(self, q: jax.Array, dq: jax.Array) -> jax.Array:
        """There are no levels above the second, (0, 3)."""
        return jnp.zeros((0, 3), q.dtype)

    def weights(self, x: jax.Array) -> jax.Array:
        """(0.1 1/s^2) M and M, (2, 3), with the diagonal of M."""
        m11, m22, _, m33 = self._inertias()
        diagonal = jnp.stack([m11, m22, m33])
        return jnp.stack([EXCHANGE_RATE * diagonal, diagonal])
