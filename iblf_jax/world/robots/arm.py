"""A serial chain of rigid links in space, with revolute and prismatic joints: the model of
arms that `iblf_jax.robots.load` reads from files.

Each joint i has a frame, placed in the frame of the link before it (of the base, for the first) by
`position` and `rotation`, and an axis in that frame; link i moves with it.  In the world's frame
(that of the base), with S_i = (z_i, p_i x z_i) for a revolute and (0, z_i) for a prismatic joint,
and I_i the inertia of link i about the world's origin:

    J_i = [S_1 ... S_i 0 ... 0],   M = sum_i J_i^T I_i J_i + diag(armature)
    M_ij = S_i . (I_j + ... + I_n) S_j  for i <= j          (composite bodies)
    U = - g . sum_i m_i c_i
    C = sum_i J_i^T (I_i J_i' + B(I_i, V_i) J_i),   V_i = J_i v
    B(I, V) u = 1/2 (V x* (I u) - I (V x u) + u x* (I V))

x and x* are the cross products of a motion with a motion and with a wrench (`spatial`).  Since
B + B^T = I', M' - 2 C is skew-symmetric; C is the one of the Christoffel symbols (Echeandia &
Wensing 2021).  All links are computed at once; only the positions of the frames go from link to
link.  The momentum and the force of a link are those about its centre, moved to the origin
(`spatial.momenta`, `spatial.inertial_forces`): there, a plant and a model whose masses differ have
the same rotational inertias and accelerations, and a scalar program computes these once.

Friction in the joints acts on the plant (`friction_torque`); the law's M0, C0, G0 hold none, so it
is part of f in (2.1).
"""

from __future__ import annotations

import copy
from functools import partial
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.attributes import attributes
from iblf_jax.core.linalg import sums_from, sums_to, symmetric
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.world.robots import spatial
from iblf_jax.world.robots._base import Limits, Robot, broadcast_fields, warn_of_degrees
from iblf_jax.world.robots.payload import Payload

KINDS = ("revolute", "prismatic")
"""Kinds of joints; a continuous joint is a revolute one with infinite limits."""


class Pose(NamedTuple):
    """Position and orientation of a frame."""

    position: jax.Array
    """(3,) [m]."""
    rotation: jax.Array
    """(3, 3); its columns are the frame's axes."""


traced_once = partial(jax.jit, inline=True)
"""Decorator of methods that are also called outside a compiled function: without it, JAX would
compile hundreds of programs of one operation each."""


class Frames(NamedTuple):
    """The frames and joint axes of the links in the world."""

    placement: jax.Array
    """[R, p] of each, (n, 3, 4)."""
    motion_subspaces: jax.Array
    """S, the motion of each link per unit of its joint's speed, (n, 2, 3)."""


NUMBERS_OF_A_JOINT = (
    *("armature", "damping", "friction", "friction_width"),
    *("lower", "upper", "effort", "speed"),
)
"""Fields with one number for each joint; a scalar is repeated."""


@component
class Arm(Robot):
    """Serial arm in space with n revolute or prismatic joints; all its parameters are leaves, one
    row a link.

    "plant.link[forearm].mass" and "plant.joint[elbow].damping" address one link or joint by its
    name or number.

    Args:
      mass: mass of each link, (n,) [kg], >= 0.
      centre: centres of mass in the links' frames, (n, 3) [m].
      inertia: about the centres, along the links' axes, (n, 6): xx, yy, zz, xy, xz, yz [kg m^2].
      position: origin of each joint's frame in the frame of the link before, (n, 3) [m].
      rotation: orientation of each joint's frame there, quaternions (w, x, y, z), (4,) or (n, 4)
        [1]; their length does not matter; the identity if not given.
      axis: axes of the joints in their frames, (3,) or (n, 3) [1]; their length does not matter; z
        if not given.
      armature: inertia of the rotors seen from the joints, added to the diagonal of M, () or (n,)
        [kg m^2], >= 0; 0 if not given.
      damping: viscous friction of each joint, () or (n,) [N m s/rad], >= 0; 0 if not given.
      friction: Coulomb friction of each joint, () or (n,) [N m], >= 0; 0 if not given.
      friction_width: speed over which the Coulomb friction changes its sign, () or (n,) [rad/s], >
        0; smaller is sharper and stiffer; 0.05 if not given.
      tip_position: origin of the tip's frame in the frame of the last link, (3,) [m]; the same
        origin if not given.
      tip_rotation: orientation of the tip's frame there, a quaternion (w, x, y, z), (4,) [1]; the
        identity if not given.
      g: acceleration of gravity in the base's frame, (3,) [m/s^2], which depends on the mounting;
        (0, 0, -9.81) if not given.
      payload: point mass at the tip, () [kg], >= 0; 0 if not given.
      lower: lower ends of the joints' ranges, () or (n,) [rad]; the dynamics do not depend on
        them; -infinite if not given.
      upper: upper ends of the joints' ranges, () or (n,) [rad]; infinite if not given.
      effort: largest torques (forces) of the actuators, () or (n,) [N m], > 0; the dynamics do
        not depend on them; infinite if not given.
      speed: largest speeds of the joints, () or (n,) [rad/s], > 0; the dynamics do not depend on
        them; infinite if not given.
      carried: a load with an extent of its own, which may be picked up at a time, a `Payload`;
        nothing if not given.
      kinds: "revolute" or "prismatic", one a joint, (n,); all revolute if not given.
      links: names of the links, from the first that moves, (n,); link1 ... if not given.
      joints: names of the joints, (n,); joint1 ... if not given.
      repaired: what `load(..., repair=True)` changed, a line a link or joint; nothing if not given.

    Source: Featherstone, Rigid Body Dynamics Algorithms, 2008; Echeandia & Wensing 2021 for C; see
      the head of this module.
    """

    mass: Leaf = leaf("kg", sign="nonnegative")
    centre: Leaf = leaf("m", shape="any")
    inertia: Leaf = leaf("kg m^2", shape="any")
    position: Leaf = leaf("m", shape="any")
    rotation: Leaf = leaf("1", shape="any", default=(1.0, 0.0, 0.0, 0.0))
    axis: Leaf = leaf("1", shape="any", default=(0.0, 0.0, 1.0))
    armature: Leaf = leaf("kg m^2", sign="nonnegative", default=0.0)
    damping: Leaf = leaf("N m s/rad", sign="nonnegative", default=0.0)
    friction: Leaf = leaf("N m", sign="nonnegative", default=0.0)
    friction_width: Leaf = leaf("rad/s", sign="positive", default=0.05)
    tip_position: Leaf = leaf("m", shape="any", default=(0.0, 0.0, 0.0))
    tip_rotation: Leaf = leaf("1", shape="any", default=(1.0, 0.0, 0.0, 0.0))
    g: Leaf = leaf("m/s^2", shape="any", default=(0.0, 0.0, -9.81))
    payload: Leaf = leaf("kg", sign="nonnegative", shape="scalar", default=0.0)
    lower: Leaf = leaf("rad", sign="limit", default=-np.inf)
    upper: Leaf = leaf("rad", sign="limit", default=np.inf)
    effort: Leaf = leaf("N m", sign="positive limit", default=np.inf)
    speed: Leaf = leaf("rad/s", sign="positive limit", default=np.inf)
    carried: Payload = None  # type: ignore[assignment]
    kinds: tuple[str, ...] = static(default=())
    links: tuple[str, ...] = static(default=())
    joints: tuple[str, ...] = static(default=())
    repaired: tuple[str, ...] = static(default=())

    geometry_fields: ClassVar[tuple[str, ...]] = (
        "centre",
        "inertia",
        "position",
        "rotation",
        "axis",
        "tip_position",
        "tip_rotation",
        "g",
    )
    """Fields of which zeros, ones, minus ones and equal numbers may be compiled in
    (`engine.structural_constants`)."""
    named_rows: ClassVar[dict[str, tuple[str, tuple[str, ...]]]] = {
        "link": ("links", ("mass", "centre", "inertia")),
        "joint": ("joints", ("position", "rotation", "axis", *NUMBERS_OF_A_JOINT)),
    }
    """Elements that a path may address by name: word -> (field of the names, fields with one row
    per name)."""

    def check(self) -> None:
        """Gives every field one row a link, and names; raises ValueError if the fields do not fit
        together.
        """
        if jnp.ndim(self.mass) != 1 or not len(self.mass):
            raise checks.fail("Arm.mass", self.mass, "one number a link, (n,)")
        n = self.mass.shape[0]
        widths = {"centre": 3, "inertia": 6, "position": 3, "rotation": 4, "axis": 3}
        for name, value in attributes(self, ("rotation", "axis")).items():
            if value.shape == (widths[name],):
                object.__setattr__(self, name, jnp.broadcast_to(value, (n, widths[name])))
        for name, value in attributes(self, widths).items():
            checks.shape_is(f"Arm.{name}", value, (n, widths[name]))
        broadcast_fields(self, NUMBERS_OF_A_JOINT, (n,))
        checks.shape_is("Arm.tip_position", self.tip_position, (3,))
        checks.shape_is("Arm.tip_rotation", self.tip_rotation, (4,))
        checks.shape_is("Arm.g", self.g, (3,))
        for name, value in attributes(self, ("rotation", "axis", "tip_rotation")).items():
            if checks.is_concrete(value) and not np.all(
                np.linalg.norm(np.asarray(value), axis=-1) > 1e-6
            ):
                raise checks.fail(f"Arm.{name}", value, "directions of a length above 0")
        if checks.is_concrete((self.lower, self.upper)) and not np.all(
            np.asarray(self.lower) < np.asarray(self.upper)
        ):
            raise checks.fail(
                "Arm.lower", self.lower, f"ranges below Arm.upper, {np.asarray(self.upper)}"
            )
        if self.carried is None:
            object.__setattr__(self, "carried", Payload())
        elif not isinstance(self.carried, Payload):
            raise checks.fail(
                "Arm.carried",
                self.carried,
                "a Payload",
                "Such as Payload(mass=1.5, centre=[0, 0, 0.1]).",
            )
        self._check_names(n)
        if checks.is_concrete((self.lower, self.upper)):
            turns = np.array([kind == "revolute" for kind in self.kinds])
            names = [f"joint {name}" for name in self.joints]
            lower, upper = (np.where(turns, end, np.inf) for end in self.limits)
            warn_of_degrees(names, lower, upper)

    def _check_names(self, n: int) -> None:
        defaults = {
            "kinds": ("revolute",) * n,
            "links": _numbered("link", n),
            "joints": _numbered("joint", n),
        }
        for name, given in attributes(self, defaults).items():
            default = defaults[name]
            if isinstance(given, tuple) and not given:
                object.__setattr__(self, name, default)
            elif (
                not isinstance(given, tuple)
                or len(given) != n
                or not all(isinstance(x, str) and x for x in given)
            ):
                raise checks.fail(f"Arm.{name}", given, f"{n} words, one a link")
            elif name != "kinds" and len(set(given)) < n:
                raise checks.fail(f"Arm.{name}", given, "names that differ")
        for i, kind in enumerate(self.kinds):
            checks.one_of(f"Arm.kinds[{i}]", kind, KINDS)

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.kinds)

    @property
    def limits(self) -> Limits:
        """The joints' ranges, (n,) each [rad or m]; infinite where a joint has none."""
        return Limits(self.lower, self.upper)

    def at(self, t: jax.Array) -> Arm:
        """The arm with the load that it carries at time t [s]."""
        if self.carried.start is None:
            return self
        now = copy.copy(self)
        object.__setattr__(now, "carried", self.carried.at(t))
        return now

    def jump_times(self) -> jax.Array:
        """Times at which the arm begins and ends to pick up its load, (2,) [s]; (0,) if it picks up
        none.
        """
        return self.carried.jump_times()

    @traced_once
    def _frames(self, q: jax.Array) -> Frames:
        """Frames of the links and directions of the joints at q."""
        is_revolute = np.array([kind == "revolute" for kind in self.kinds])
        a, fixed = spatial.unit(self.axis), spatial.rotation(self.rotation)
        axis = spatial.apply(fixed, a)
        along = axis[:, :, None] * a[:, None, :]
        angle = q
        if not is_revolute.all():
            angle = jnp.where(is_revolute, q, jnp.zeros_like(q))
        sine, cosine = jnp.sin(angle)[:, None, None], jnp.cos(angle)[:, None, None]
        turned = along + cosine * (fixed - along) + sine * spatial.cross(fixed, a[:, None, :])
        shifted = self.position
        if not is_revolute.all():
            shifted = shifted + jnp.where(is_revolute, jnp.zeros_like(q), q)[:, None] * axis
        H = spatial.chained(spatial.placement(turned, shifted))
        z = spatial.apply(H[:, :, :3], a)
        w, v = z, spatial.cross(H[:, :, 3], z)
        if not is_revolute.all():
            w = jnp.where(is_revolute[:, None], w, jnp.zeros_like(z))
            v = jnp.where(is_revolute[:, None], v, z)
        return Frames(H, jnp.stack([w, v], axis=1))

    @traced_once
    def _bodies(self, frames: Frames) -> spatial.Bodies:
        """The links in the world, each about its centre; the last with the load at the tip."""
        R, p = frames.placement[..., :3], frames.placement[..., 3]
        load = self._load()
        own = spatial.pseudo_inertia(jnp.zeros_like(self.mass), self.centre, self.inertia)
        second = spatial.with_last(own[:, :3, :3], load[:3, :3])
        turned = spatial.product(
            spatial.product(R, spatial.rotational_inertia(second)), jnp.swapaxes(R, -1, -2)
        )
        return spatial.Bodies(
            p + spatial.apply(R, self.centre),
            spatial.with_last(self.mass[:, None], load[3:, 3]),
            symmetric(turned),
            spatial.apply(R[-1], load[:3, 3]),
        )

    def _load(self) -> jax.Array:
        """Pseudo-inertia of the load at the tip, (4, 4), about the centre of the last link, along
        this link's axes.
        """
        P = self.carried.moments()
        corner = jnp.asarray(np.diag([0.0, 0.0, 0.0, 1.0]), P.dtype) * self.payload
        tip = self._tip_placement()
        tip = spatial.placement(tip[:, :3], tip[:, 3] - self.centre[-1])
        tip = jnp.concatenate([tip, jnp.asarray([[0.0, 0.0, 0.0, 1.0]], P.dtype)])
        return spatial.product(spatial.product(tip, P + corner), tip.T)

    @traced_once
    def _tip_placement(self) -> jax.Array:
        """[R, p] of the tip in the last link's frame, (3, 4)."""
        return spatial.placement(spatial.rotation(self.tip_rotation), self.tip_position)

    @traced_once
    def pose(self, q: jax.Array) -> Pose:
        """Position and orientation of the tip's frame in the base's."""
        H = spatial.joined(self._frames(q).placement[-1], self._tip_placement())
        return Pose(H[:, 3], H[:, :3])

    def tip(self, q: jax.Array) -> jax.Array:
        """Position of the tip, (3,) [m]."""
        return self.pose(q).position

    @traced_once
    def skeleton(self, q: jax.Array) -> jax.Array:
        """Origins of the joints' frames, then the tip, (n + 1, 3) [m]."""
        return jnp.concatenate([self._frames(q).placement[:, :, 3], self.tip(q)[None]])

    def jacobian(self, q: jax.Array) -> jax.Array:
        """D tip / dq, (3, n) [m/rad]: the tip's velocity per unit of joint speed."""
        return self.twist_jacobian(q)[:3]

    def twist_jacobian(self, q: jax.Array) -> jax.Array:
        """The tip's velocity (first three rows) and angular velocity (last three) per unit of joint
        speed, (6, n).
        """
        w, v = jnp.unstack(self._frames(q).motion_subspaces, axis=1)
        return jnp.concatenate([(v + spatial.cross(w, self.tip(q)[None])).T, w.T])

    @traced_once
    def mass_matrix(self, q: jax.Array) -> jax.Array:
        """M(q), (n, n) [kg m^2]."""
        frames = self._frames(q)
        composite = spatial.Inertia(*map(sums_from, spatial.inertia(self._bodies(frames))))
        S = frames.motion_subspaces
        upper = jnp.sum(S[:, None] * spatial.momentum(composite, S), axis=(-1, -2))
        return symmetric(upper) + jnp.where(
            np.eye(self.n, dtype=bool), self.armature, jnp.zeros_like(upper)
        )

    def coriolis(self, q: jax.Array, v: jax.Array, u: jax.Array) -> jax.Array:
        """C(q, v) u, (n,) [N m], with the C of the Christoffel symbols."""
        return self._inertial_torque(q, v, u, None)

    def inverse_dynamics(
        self, q: jax.Array, v: jax.Array, u: jax.Array, acceleration: jax.Array
    ) -> jax.Array:
        """C(q, v) u + G + M acceleration, (n,) [N m], without M."""
        return self._inertial_torque(q, v, u, acceleration) + self.gravity(q)

    def _inertial_torque(
        self, q: jax.Array, v: jax.Array, u: jax.Array, acceleration: jax.Array | None
    ) -> jax.Array:
        """C(q, v) u + M acceleration, (n,) [N m]; None for no acceleration."""
        frames = self._frames(q)
        S, bodies = frames.motion_subspaces, self._bodies(frames)
        V = U = _velocities(S, v)
        rates = _velocities(spatial.motion_cross(V, S), u)
        pairs = [(V, V)]
        if u is not v:
            U = _velocities(S, u)
            rates = rates - 0.5 * spatial.motion_cross(V, U)
            pairs = [(V, U), (U, V)]
        torque = jnp.zeros_like(q)
        if acceleration is not None:
            rates = rates + _velocities(S, acceleration)
            torque = self.armature * acceleration
        return torque + _joint_torques(S, spatial.inertial_forces(bodies, rates, pairs))

    @traced_once
    def momentum(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """M(q) v, (n,) [N m s], without M."""
        frames = self._frames(q)
        S = frames.motion_subspaces
        links = spatial.momenta(self._bodies(frames), _velocities(S, v))
        return _joint_torques(S, links) + self.armature * v

    @traced_once
    def energy_gradient(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """dT/dq with T = 1/2 v^T M v, (n,) [N m]: the rate of each joint's motion subspace times
        the momentum of all links beyond it.
        """
        frames = self._frames(q)
        S, bodies = frames.motion_subspaces, self._bodies(frames)
        V = _velocities(S, v)
        return _joint_torques(spatial.motion_cross(V, S), spatial.momenta(bodies, V))

    @traced_once
    def potential(self, q: jax.Array) -> jax.Array:
        """U(q) = - g . sum_i m_i c_i, () [J]; zero with all mass at the base's origin."""
        return -jnp.sum(self.g * spatial.inertia(self._bodies(self._frames(q))).first)

    @traced_once
    def gravity(self, q: jax.Array) -> jax.Array:
        """G(q), (n,) [N m]: the weight of all links beyond each joint."""
        frames = self._frames(q)
        links = spatial.inertia(self._bodies(frames))
        first, mass = sums_from(links.first), sums_from(links.mass)
        weight = jnp.stack([spatial.cross(first, self.g), mass * self.g], axis=1)
        return -jnp.sum(frames.motion_subspaces * weight, axis=(-1, -2))

    def friction_torque(self, dq: jax.Array) -> jax.Array:
        """Joint friction, -(damping q' + friction tanh(q' / friction_width)), (n,) [N m]."""
        return -(self.damping * dq + self.friction * jnp.tanh(dq / self.friction_width))


def _numbered(word: str, n: int) -> tuple[str, ...]:
    return tuple(f"{word}{i + 1}" for i in range(n))


def _velocities(S: jax.Array, speeds: jax.Array) -> jax.Array:
    """J_i u, the motion of every link when the joints move at `speeds`, (n, 2, 3)."""
    return sums_to(S * speeds[:, None, None])


def _joint_torques(S: jax.Array, forces: jax.Array) -> jax.Array:
    """sum_i J_i^T F_i, (n,): the joint torques that correspond to wrenches on the links."""
    return jnp.sum(S * sums_from(forces), axis=(-1, -2))
