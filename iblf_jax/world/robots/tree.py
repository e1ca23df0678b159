"""The tree of bodies that `mujoco` makes of a file, and the fields of an `Arm` that follow from it.

Quantities are NumPy arrays in float64.  A pose is (position, rotation matrix).
"""

from __future__ import annotations

import difflib
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from iblf_jax.core import checks
from iblf_jax.world.robots.description import Shown
from iblf_jax.world.robots.links import Links, Pose
from iblf_jax.world.robots.mjcf import Mjcf, Tendons
from iblf_jax.world.robots.repair import Fault, Repairs, Weight, fault, second_moments
from iblf_jax.world.robots.urdf import Urdf

if TYPE_CHECKING:
    import mujoco

FREE, BALL, SLIDE, HINGE = range(4)
KINDS = {HINGE: "revolute", SLIDE: "prismatic"}
CONNECT, WELD, COUPLED = range(3)
JOINT, FIXED, NO_BIAS = 0, 0, 0
"""The library's numbers for kinds of joints, of constraints, and of an actuator's transmission,
gain and bias."""


def mujoco_package() -> Any:
    """The package `mujoco`; ImportError with a remedy if it is not installed."""
    try:
        import mujoco
    except ImportError as error:
        raise ImportError(
            'This needs the mujoco package: pip install mujoco, or ".[robots]" in a clone.'
        ) from error
    return mujoco


class Tree:
    """A compiled model whose bodies, joints and sites are found by name."""

    def __init__(
        self, model: mujoco.MjModel, mujoco: ModuleType, root: str, weights: dict[int, Weight]
    ):
        self.model = model
        self.weights = weights
        """Body -> its mass and inertia in its inertial frame, where these are not the model's."""

        def names(kind: Any, count: int) -> list[str | None]:
            return [mujoco.mj_id2name(model, kind, i) for i in range(count)]

        objects = mujoco.mjtObj
        self.bodies = [
            name or f"body{i}" for i, name in enumerate(names(objects.mjOBJ_BODY, model.nbody))
        ]
        self.bodies[0] = root
        self.joint_names = [
            name or f"{self.bodies[model.jnt_bodyid[j]]}_joint"
            for j, name in enumerate(names(objects.mjOBJ_JOINT, model.njnt))
        ]
        self.sites = names(objects.mjOBJ_SITE, model.nsite)
        self.equalities = names(objects.mjOBJ_EQUALITY, model.neq)
        self.site_type = objects.mjOBJ_SITE
        self.gravity = np.array(model.opt.gravity, float)
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
            self.gravity = np.zeros(3)

    @staticmethod
    def compiled(file: Urdf | Mjcf, path: str) -> Tree:
        """The tree of a checked description.

        Args:
          file: the description.
          path: of the file, for messages.

        Raises:
          ValueError: what the library does not accept, in its words.
          ImportError: it is not installed.
        """
        mujoco = mujoco_package()
        try:
            spec = mujoco.MjSpec.from_string(file.text)
            spec.compiler.fusestatic = False
            weights = file.separate_weights(spec)
            model = spec.compile()
        except ValueError as error:
            words = " ".join(str(error).split())
            raise ValueError(f"{path}: {words}") from None
        return Tree(model, mujoco, file.root, {body.id: weight for body, weight in weights})

    def body(self, name: str, what: str) -> int:
        """The body of a name."""
        if name in self.bodies:
            return self.bodies.index(name)
        raise unknown(what, name, "the name of a link", self.bodies)

    def joint(self, name: str) -> int:
        """The joint of a name."""
        if name in self.joint_names:
            return self.joint_names.index(name)
        raise unknown("locked", name, "names of joints", self.joint_names)

    def frame(self, name: str) -> tuple[int, Pose]:
        """The body of a body or site, and its pose in the body's frame."""
        if name in self.sites and name not in self.bodies:
            i = self.sites.index(name)
            return int(self.model.site_bodyid[i]), (
                np.array(self.model.site_pos[i]),
                matrix(self.model.site_quat[i]),
            )
        if name in self.bodies:
            return self.bodies.index(name), (np.zeros(3), np.eye(3))
        raise unknown(
            "tip", name, "the name of a link or site", [*self.bodies, *filter(None, self.sites)]
        )

    def joints_of(self, body: int) -> range:
        """The joints between a body and its parent, in their order."""
        start = int(self.model.body_jntadr[body])
        return range(start, start + int(self.model.body_jntnum[body]))

    def path(self, first: int, last: int) -> list[int] | None:
        """The bodies after `first` up to `last`; None if `last` is no descendant of `first`."""
        path = []
        while last != first:
            if last == 0:
                return None
            path.append(last)
            last = int(self.model.body_parentid[last])
        return path[::-1]

    def only_tip(self, first: int, locked: dict[int, float]) -> int:
        """The body at the end of the only moving chain beyond `first`.

        It is the last body of the chain, or the link that the last joint moves if the bodies branch
        beyond this joint.
        """
        m = self.model
        beyond = [b for b in range(m.nbody) if self.path(first, b) is not None]
        moved = [
            b for b in beyond if b != first and any(j not in locked for j in self.joints_of(b))
        ]
        ends = [b for b in moved if not any(b != c and self.path(b, c) is not None for c in moved)]
        if len(ends) != 1:
            found = ", ".join(repr(self.bodies[b]) for b in ends[:8]) or "none"
            expected = "the name of a link: the chain must have one end"
            raise checks.fail(
                "tip", None, expected, f"Chains beyond {self.bodies[first]!r} end at: {found}."
            )
        parents = {int(m.body_parentid[b]) for b in beyond if b}
        leaves = [b for b in beyond if b not in parents and self.path(ends[0], b) is not None]
        if len(leaves) == 1:
            return leaves[0]
        return ends[0]

    def check_joint(self, j: int, repairs: Repairs) -> None:
        """Handles the properties of a joint that an Arm does not have."""
        m, name = self.model, self.joint_names[j]
        if m.jnt_type[j] not in (HINGE, SLIDE):
            kind, remedy = "ball", "Write it as three hinges."
            if m.jnt_type[j] == FREE:
                kind, remedy = "free", "Take a base beyond it."
            expected = "a hinge or slide between base and tip"
            raise checks.fail(f"joint {name!r}", Shown(f"a {kind} joint"), expected, remedy)
        stiffness = float(m.jnt_stiffness[j])
        if stiffness:
            expected, repaired = "0: springs are not modelled", "0: the spring is left out"
            where = f"joint {name!r}: stiffness"
            repairs.handle(fault(where, stiffness, expected, repaired, remedy="Remove it."))

    def placed(self, body: int) -> Pose:
        """Pose of a body in its parent's frame, with its joints at their reference positions."""
        return np.array(self.model.body_pos[body]), matrix(self.model.body_quat[body])

    def _after_locked(self, pose: Pose, j: int, locked: dict[int, float]) -> Pose:
        """`pose` of a body after the motion of its locked joint j."""
        m = self.model
        if m.jnt_type[j] not in (HINGE, SLIDE):
            return pose
        reference = float(m.qpos0[m.jnt_qposadr[j]])
        move, axis = locked.get(j, reference) - reference, np.array(m.jnt_axis[j])
        if m.jnt_type[j] == SLIDE:
            return joined(pose, (axis * move, np.eye(3)))
        anchor, R = np.array(m.jnt_pos[j]), turn(axis, move)
        return joined(pose, (anchor - R @ anchor, R))

    def pose(self, body: int, locked: dict[int, float]) -> Pose:
        """Pose of a body in the world, with every joint locked."""
        pose: Pose = (np.zeros(3), np.eye(3))
        for b in self.path(0, body) or ():
            pose = joined(pose, self.placed(b))
            for j in self.joints_of(b):
                pose = self._after_locked(pose, j, locked)
        return pose

    def welded(
        self, base: int, joints: tuple[int, ...], locked: dict[int, float], repairs: Repairs
    ) -> Links:
        """The links that `joints` move, with the bodies beyond the base that they carry."""
        m, origin = self.model, (np.zeros(3), np.eye(3))
        names, position, rotation, between = [], [], [], []
        frames: dict[int, Pose] = {base: origin}
        carrier: dict[int, int] = {base: -1}
        for b in range(m.nbody):
            parent = int(m.body_parentid[b])
            if b in (0, base) or parent not in frames:
                continue
            link, pose = carrier[parent], joined(frames[parent], self.placed(b))
            own = [j for j in self.joints_of(b) if j in joints]
            for j in self.joints_of(b):
                if j not in joints:
                    pose = self._after_locked(pose, j, locked)
                    continue
                anchor, axis = np.array(m.jnt_pos[j]), np.array(m.jnt_axis[j])
                reference = float(m.qpos0[m.jnt_qposadr[j]])
                p, R = joined(pose, (anchor, np.eye(3)))
                if m.jnt_type[j] == HINGE:
                    R = R @ turn(axis, -reference)
                else:
                    p = p - R @ axis * reference
                position.append(p)
                rotation.append(R)
                between.append(j != own[-1])
                name = self.bodies[b]
                if between[-1]:
                    name = f"{name}:{self.joint_names[j]}"
                names.append(name)
                link, pose = len(names) - 1, (-anchor, np.eye(3))
            frames[b], carrier[b] = pose, link
        moments = np.zeros((len(names), 4, 4))
        for b, link in carrier.items():
            if link >= 0:
                moments[link] += self._moments(b, frames[b], repairs)
        return Links(
            tuple(names),
            np.array(position),
            np.array(rotation),
            moments,
            tuple(between),
            frames,
            carrier,
        )

    def _moments(self, body: int, pose: Pose, repairs: Repairs) -> np.ndarray:
        """Pseudo-inertia of a body in the frame of `pose`."""
        m = self.model
        p, R = joined(pose, (np.array(m.body_ipos[body]), matrix(m.body_iquat[body])))
        own = self.weights.get(body) or Weight(
            float(m.body_mass[body]), np.diag(m.body_inertia[body])
        )
        mass, inertia, *_ = own.repaired(repairs)
        compensated = float(m.body_gravcomp[body])
        if compensated and mass:
            where = f"body {self.bodies[body]!r}: gravcomp"
            expected = "0: compensation of gravity is not modelled, it is the law's to do"
            repaired = "0: gravity acts on it"
            repairs.handle(fault(where, compensated, expected, repaired, remedy="Remove it."))
        second = R @ second_moments(inertia) @ R.T + mass * np.outer(p, p)
        return np.block([[second, mass * p[:, None]], [mass * p[None, :], np.array([[mass]])]])

    def joint_fields(self, joints: tuple[int, ...]) -> dict[str, Any]:
        """The fields of an Arm that describe its joints."""
        m, at = self.model, list(joints)
        dofs = m.jnt_dofadr[at]
        limited, driven = m.jnt_limited[at].astype(bool), m.jnt_actfrclimited[at].astype(bool)
        effort = np.where(driven, np.min(np.abs(m.jnt_actfrcrange[at]), axis=1), np.inf)
        effort = np.minimum(effort, [self._actuators(j) for j in joints])
        return {
            "axis": np.array(m.jnt_axis[at]),
            "armature": np.array(m.dof_armature[dofs]),
            "damping": np.array(m.dof_damping[dofs]),
            "friction": np.array(m.dof_frictionloss[dofs]),
            "lower": np.where(limited, m.jnt_range[at, 0], -np.inf),
            "upper": np.where(limited, m.jnt_range[at, 1], np.inf),
            "effort": np.where(effort > 0, effort, np.inf),
            "kinds": tuple(KINDS[int(m.jnt_type[j])] for j in joints),
            "joints": tuple(self.joint_names[j] for j in joints),
        }

    def _actuators(self, j: int) -> float:
        """The largest sum of torques (forces) of a joint's actuators; infinite if one has no limit
        or there are none.
        """
        m, total = self.model, 0.0
        on_it = [
            a for a in range(m.nu) if m.actuator_trntype[a] == JOINT and m.actuator_trnid[a, 0] == j
        ]
        if not on_it:
            return np.inf
        for a in on_it:
            limit = np.inf
            if m.actuator_forcelimited[a]:
                limit = float(np.min(np.abs(m.actuator_forcerange[a])))
            is_torque = m.actuator_gaintype[a] == FIXED and m.actuator_biastype[a] == NO_BIAS
            if m.actuator_ctrllimited[a] and is_torque:
                largest_input = np.min(np.abs(m.actuator_ctrlrange[a]))
                limit = min(limit, float(largest_input * abs(m.actuator_gainprm[a, 0])))
            total += limit * abs(float(m.actuator_gear[a, 0]))
        return total

    def handle_constraints(
        self, links: Links, joints: tuple[int, ...], tendons: Tendons, repairs: Repairs
    ) -> None:
        """Handles constraints between bodies of different links, and between a joint of the chain
        and another joint.

        Args:
          links, joints: the chain.
          tendons: constraints on tendons, label -> (joints, sites).
          repairs: meets a coupled joint; a closed chain is refused.
        """
        m = self.model
        for e in range(m.neq):
            first, second = int(m.eq_obj1id[e]), int(m.eq_obj2id[e])
            if not m.eq_active0[e]:
                continue
            where = f"equality {self.equalities[e] or f'number {e}'!r}"
            if m.eq_type[e] == COUPLED:
                self._handle_coupling(where, {first, second} & set(joints), repairs)
            if m.eq_type[e] in (CONNECT, WELD):
                bodies = [first, second]
                if m.eq_objtype[e] == self.site_type:
                    bodies = [int(m.site_bodyid[site]) for site in bodies]
                self._handle_tie(where, bodies, links, repairs)
        for where, (named, sites) in tendons.items():
            self._handle_coupling(
                where, {j for j in joints if self.joint_names[j] in named}, repairs
            )
            tied = [int(m.site_bodyid[i]) for i, site in enumerate(self.sites) if site in sites]
            self._handle_tie(where, tied, links, repairs)

    def _handle_coupling(self, where: str, coupled: set[int], repairs: Repairs) -> None:
        for j in sorted(coupled):
            name = self.joint_names[j]
            remedy = f"Lock it: locked={{{name!r}: 0.0}}, or remove the constraint."
            tied = Shown(f"joint {name!r} tied to another")
            error = checks.fail(where, tied, "joints that move by themselves", remedy)
            got, repaired = f"one tied to another by {where}", "one that moves by itself"
            repairs.handle(Fault(f"joint {name!r}", got, error, repaired))

    def _handle_tie(self, where: str, bodies: list[int], links: Links, repairs: Repairs) -> None:
        """Handles a constraint between bodies: with a motion-capture body it drives the arm,
        between links of the arm it closes the chain.
        """
        if len({links.carrier.get(b, -1) for b in bodies}) > 1:
            tied = f"{' and '.join(repr(self.bodies[b]) for b in bodies)} tied together"
            remedy = "A closed chain has no serial one: cut it open, or lock its joints."
            repaired = ""
            if any(self.model.body_mocapid[b] >= 0 for b in bodies):
                repaired = "no tie: a motion-capture body is no link"
            repairs.handle(fault(where, Shown(tied), "an open chain", repaired, remedy=remedy))


def unknown(what: str, name: str, expected: str, known: list[str]) -> ValueError:
    """An error that lists similar names, or the first names if none is similar."""
    known = list(dict.fromkeys(known))  # the root and a body of the file may have the same name
    near = difflib.get_close_matches(str(name), known, n=3) or known[:12]
    names = ", ".join(map(repr, near))
    if len(known) > 12:
        names += " ..."
    return checks.fail(what, name, expected, f"There are {names}.")


def matrix(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion (w, x, y, z) of length one."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


def turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation about a unit axis."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(angle * axis).as_matrix()


def joined(outer: Pose, inner: Pose) -> Pose:
    """Composition of poses: `inner` is given in the frame of `outer`."""
    return outer[0] + outer[1] @ inner[0], outer[1] @ inner[1]
