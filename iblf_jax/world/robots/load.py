"""Robots from files: a serial arm selected from a URDF or MJCF.

`description`, `urdf` and `mjcf` read and check the file; the `mujoco` package (extra `robots`)
makes a tree of bodies from the checked copy.  `load` selects the chain of this tree from `base` to
`tip`: its joints move, every other joint is locked, and each body is welded to the link of the
chain that carries it.  The arm's world is the frame of the base.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.core import checks, notices
from iblf_jax.world.robots import description, mjcf, urdf
from iblf_jax.world.robots.arm import Arm
from iblf_jax.world.robots.description import Shown
from iblf_jax.world.robots.links import quaternion
from iblf_jax.world.robots.repair import Fault, Repairs
from iblf_jax.world.robots.tree import Tree


def load(
    path: str | os.PathLike,
    base: str | None = None,
    tip: str | None = None,
    *,
    locked: Mapping[str, float] | None = None,
    gravity: ArrayLike | None = None,
    repair: bool = False,
) -> Arm:
    """The serial arm of a URDF or MJCF file.

    Fixed joints are fused; joints that are not between base and tip are locked, and their links'
    masses and inertias are added to the link that carries them.  A mesh is opened only where a body
    of an MJCF takes its weight from it.  Faults of links that the chain does not
    carry and of joints that do not move in it are ignored, and so are errors of moments of inertia
    within rounding, 1e-6 of them or m (1 um)^2.

    With `repair` the other faults are corrected where a rule exists, with the least change, and
    listed: with J = V diag(...) V^T an inertia about the centre of mass m,

        S = 1/2 tr(J) 1 - J = V diag(s) V^T,   S' = V diag(max(s, f)) V^T,   J' = tr(S') 1 - S',

    is the nearest inertia that a body can have, with f = 0, or f = m (L / 100)^2 for a moving link
    that adds no inertia to its joint, where L is the length of the longest link.  No mass is
    invented: a link without mass is kept if the mass matrix is positive definite nevertheless, and
    refused otherwise.  Invalid ranges and negative torques or speeds are replaced by no limits, and
    negative friction by 0.  Springs and MuJoCo's gravity compensation are left out.  A joint of the
    chain that is coupled to another one (a mimic) moves independently.

    Args:
      path: the file; `<robot>` is read as URDF, `<mujoco>` as MJCF, whatever its ending.
      base: name of the link (body) that is fixed, and whose frame is the arm's world; the root
        if not given.
      tip: name of the link (body, or site of an MJCF) whose frame is the tip; the end of the chain
        if there is only one.
      locked: joint name -> position [rad or m] of locked joints, which may be between base and tip.
        All other joints outside the chain are locked at 0 (those of an MJCF at `ref`).
      gravity: (3,) [m/s^2] in the file's world; the file's own, (0, 0, -9.81) if it has none.
      repair: whether to correct the faults that have a rule; a warning and the arm's `repaired`
        then list the changes, a line a link or joint.

    Returns:
      An Arm, with the names of links and joints, limits, damping, friction, armature, efforts and
      speeds of the file; its `limits`, `effort` and `speed` are infinite where the file has none
      (an MJCF has no speeds).  A warning names the joints whose limits seem to be degrees.

    Raises:
      ValueError: a fault of the file or the chain; the message names the element and the
        remedy.
      ImportError: the extra `robots` is not installed.

    Source: formats as defined by ROS (URDF) and MuJoCo (MJCF).
    """
    for name, link in (("base", base), ("tip", tip)):
        if link is not None:
            checks.string(name, link, "the name of a link")
    if locked is None:
        locked = {}
    checks.mapping("locked", locked, '{"gripper_joint": 0.02}')
    repairs = Repairs(checks.boolean("repair", repair))
    root = description.read(path)
    try:
        file = _checked(root, Path(path).parent)
        tree = Tree.compiled(file, str(path))
        chain = _Chain.picked(tree, base, tip, dict(locked), repairs)
        if isinstance(file, urdf.Urdf):
            chain = chain.following(file, repairs)
        arm = chain.arm(gravity, file, repairs)
    except ValueError as error:
        raise description.of_file(path, error) from error
    if arm.repaired:
        notices.warn(f"{path}: repaired: " + "; ".join(arm.repaired) + ".")
    return arm


def _checked(root: ET.Element, folder: Path) -> urdf.Urdf | mjcf.Mjcf:
    """The checked copy of a description in a folder."""
    if root.tag == "robot":
        return urdf.checked(root)
    return mjcf.checked(root, folder)


class _Chain(NamedTuple):
    """The chain from base to tip in a tree of bodies."""

    tree: Tree
    base: int
    tip: int
    at_tip: tuple[np.ndarray, np.ndarray]
    """Position and orientation of the tip in the frame of its body."""
    joints: tuple[int, ...]
    """Joints that move, from the base on."""
    locked: dict[int, float]
    """Locked joints -> their positions."""

    @staticmethod
    def picked(
        tree: Tree, base: str | None, tip: str | None, locked: dict[str, float], repairs: Repairs
    ) -> _Chain:
        """The chain from base to tip."""
        first = 0
        if base is not None:
            first = tree.body(base, "base")
        positions = {
            tree.joint(name): locked_position(name, value) for name, value in locked.items()
        }
        if tip is None:
            last, at_tip = tree.only_tip(first, positions), (np.zeros(3), np.eye(3))
        else:
            last, at_tip = tree.frame(tip)
        path = tree.path(first, last)
        if path is None:
            expected = f"a link beyond the base {tree.bodies[first]!r}"
            raise checks.fail("tip", tip, expected, "Another base or another tip.")
        joints = tuple(j for b in path for j in tree.joints_of(b) if j not in positions)
        if not joints:
            expected = "a chain with a joint that moves"
            remedy = f"Between it and {tree.bodies[first]!r} there is none."
            raise checks.fail("tip", tree.bodies[last], expected, remedy)
        for j in joints:
            tree.check_joint(j, repairs)
        return _Chain(tree, first, last, at_tip, joints, positions)

    def following(self, file: urdf.Urdf, repairs: Repairs) -> _Chain:
        """The chain, with each mimic joint outside it locked at the position that its master gives;
        handles the faults of the chain's joints.
        """
        tree, locked = self.tree, dict(self.locked)
        free = {tree.joint_names[j] for j in self.joints}
        for name in file.mimics:
            if name not in free and tree.joint(name) not in locked:
                locked[tree.joint(name)] = self._mimicked(name, file.mimics)
        displaced = [j for j, position in locked.items() if position]
        for j in (*self.joints, *displaced):
            name = tree.joint_names[j]
            if name in file.axis_faults:
                repairs.handle(file.axis_faults[name])
            if name in free:
                for fault in file.motion_faults[name]:
                    repairs.handle(fault)
        for name, mimic in file.mimics.items():
            if name in free or mimic.master in free:
                coupled, repaired = mimic.master, "one that is locked"
                if name in free:
                    coupled, repaired = name, "one that moves by itself"
                remedy = f"Lock it: locked={{{coupled!r}: 0.0}}, or take another tip."
                error = checks.fail(
                    f"joint {name!r}", Shown(mimic.shown), "joints that move by themselves", remedy
                )
                repairs.handle(Fault(f"joint {name!r}", mimic.shown, error, repaired))
        path = tree.path(0, self.tip) or []
        for b in range(1, tree.model.nbody):
            ancestors = tree.path(0, b) or ()
            carried = any(j in self.joints for c in ancestors for j in tree.joints_of(c))
            if tree.bodies[b] in file.pose_faults and (carried or b in path):
                repairs.handle(file.pose_faults[tree.bodies[b]])
        return self._replace(locked=locked)

    def _mimicked(self, name: str, mimics: dict[str, urdf.Mimic]) -> float:
        """The position of a joint that follows others, of which the last is locked."""
        factor, offset, seen = 1.0, 0.0, {name}
        at = {self.tree.joint_names[j]: position for j, position in self.locked.items()}
        while name in mimics and name not in at:
            mimic = mimics[name]
            offset += factor * mimic.offset
            factor *= mimic.multiplier
            name = mimic.master
            if name in seen:
                field, ring = f"joint {name!r}: mimic", Shown("a ring of mimics")
                raise checks.fail(field, ring, "a joint that leads")
            seen.add(name)
        return offset + factor * at.get(name, 0.0)

    def arm(self, gravity: ArrayLike | None, file: urdf.Urdf | mjcf.Mjcf, repairs: Repairs) -> Arm:
        """The Arm, in which each body is welded to the link that carries it."""
        tree = self.tree
        g = tree.gravity
        if gravity is not None:
            g = np.asarray(checks.as_floats("gravity", gravity), float)
        checks.shape_is("gravity", g, (3,))
        _, upright = tree.pose(self.base, self.locked)
        joints = tree.joint_fields(self.joints)
        links = tree.welded(self.base, self.joints, self.locked, repairs)
        tree.handle_constraints(links, self.joints, file.tendons, repairs)
        links = links.repaired(joints, repairs)
        p, R = links.frames[self.tip]
        tip_p, tip_R = p + R @ self.at_tip[0], R @ self.at_tip[1]
        return Arm(
            **links.parameters(),
            **joints,
            tip_position=tip_p,
            tip_rotation=quaternion(tip_R),
            g=upright.T @ g,
            speed=np.array([file.speeds.get(name, np.inf) for name in joints["joints"]]),
            links=links.names,
            repaired=tuple(repairs.lines),
        )


def locked_position(name: str, value: object) -> float:
    """The checked position of a locked joint [rad or m]."""
    number = checks.as_floats(f"locked[{name!r}]", value)
    checks.check_values(f"locked[{name!r}]", number, None)
    if number.shape != ():
        raise checks.fail(f"locked[{name!r}]", value, "one number")
    return float(number)
