"""Robots from files: a serial arm picked out of a URDF or MJCF.

The file is read and checked by `description`, `urdf` and `mjcf`; the `mujoco` package (extra `robots`) makes a tree of bodies of what is
left.  From the tree a chain is picked, from `base` to `tip`: its joints move, every other joint is locked, and each body is welded to the
link of the chain that carries it.  The arm's world is the frame of the base.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from iblf_jax import checks
from iblf_jax.robots import description, mjcf, urdf
from iblf_jax.robots.arm import Arm
from iblf_jax.robots.description import Shown
from iblf_jax.robots.tree import Tree


def load(
    path: str | os.PathLike,
    base: str | None = None,
    tip: str | None = None,
    *,
    locked: Mapping[str, float] | None = None,
    gravity: Any = None,
) -> Arm:
    """The serial arm of a URDF or MJCF file.

    Fixed joints are fused; joints that are not between base and tip are locked, and their links' masses and inertias stay, with the link
    that carries them.  Meshes are neither needed nor opened.

    Args:
      path: the file; `<robot>` is read as URDF, `<mujoco>` as MJCF, whatever its ending.
      base: name of the link (body) that is held still, and whose frame is the arm's world; the root if not given.
      tip: name of the link (body, or site of an MJCF) whose frame is the tip; the end of the chain if there is only one.
      locked: joint name -> position [rad or m] for joints that are not to move; a joint between base and tip may be among them.  Others
        that are left out are locked at 0 (an MJCF's at `ref`).
      gravity: (3,) [m/s^2] in the file's world; the file's own, (0, 0, -9.81) if it has none.

    Returns:
      An Arm, with the names of links and joints, limits, damping, friction, armature and efforts of the file; its `limits` and `effort`
      are infinite where the file has none.

    Raises:
      ValueError: what is wrong with the file or the chain; the message names the element and the mend.
      ImportError: the extra `robots` is not installed.

    Source: formats as defined by ROS (URDF) and MuJoCo (MJCF).
    """
    base, tip = (None if x is None else checks.word(what, x, "the name of a link") for what, x in (("base", base), ("tip", tip)))
    locked = checks.mapping("locked", {} if locked is None else locked, '{"gripper_joint": 0.02}')
    root = description.read(path)
    mimics: dict[str, urdf.Mimic] = {}
    if root.tag == "robot":
        description_ = urdf.checked(root)
        tree = Tree.compiled(description_.text, str(path), root=description_.root)
        mimics = description_.mimics
    else:
        tree = Tree.compiled(mjcf.checked(root), str(path), root="world")
    return _Chain.picked(tree, base, tip, dict(locked), mimics).arm(gravity)


class _Chain(NamedTuple):
    """What was picked of a tree."""

    tree: Tree
    base: int
    tip: int
    at_tip: tuple[np.ndarray, np.ndarray]
    """Position and orientation of the tip in the frame of its body."""
    joints: tuple[int, ...]
    """Joints that move, from the base on."""
    held: dict[int, float]
    """Joints that do not, and where they are."""

    @staticmethod
    def picked(tree: Tree, base: str | None, tip: str | None, locked: dict[str, float], mimics: dict[str, urdf.Mimic]) -> _Chain:
        """The chain from base to tip."""
        first = 0 if base is None else tree.body(base, "base")
        held = {tree.joint(name): _position(name, value) for name, value in locked.items()}
        last, at_tip = tree.frame(tip) if tip is not None else (tree.only_tip(first, held), (np.zeros(3), np.eye(3)))
        way = tree.way(first, last)
        if way is None:
            raise checks.fail("tip", tip, f"a link beyond the base {tree.bodies[first]!r}", "Another base or another tip.")
        joints = tuple(j for b in way for j in tree.joints_of(b) if j not in held)
        if not joints:
            expected = "a chain with a joint that moves"
            raise checks.fail("tip", tree.bodies[last], expected, f"Between it and {tree.bodies[first]!r} there is none.")
        for j in joints:
            tree.check_joint(j)
        chain = _Chain(tree, first, last, at_tip, joints, held)
        chain._follow(mimics)
        return chain

    def _follow(self, mimics: dict[str, urdf.Mimic]) -> None:
        """Locks joints that mimic locked ones where these take them; refuses mimics in the chain."""
        names = {self.tree.joint_names[j] for j in self.joints}
        for name, mimic in mimics.items():
            for moving in (name, mimic.master):
                if moving in names:
                    mend = f"Lock it: locked={{{moving!r}: 0.0}}, or take another tip."
                    raise checks.fail(
                        f"joint {name!r}", Shown(f"a mimic of {mimic.master!r} in the chain"), "joints that move by themselves", mend
                    )
        for name in mimics:
            joint = self.tree.joint(name)
            if joint not in self.held:
                self.held[joint] = self._mimicked(name, mimics)

    def _mimicked(self, name: str, mimics: dict[str, urdf.Mimic]) -> float:
        factor, offset, seen = 1.0, 0.0, {name}
        while name in mimics and self.tree.joint(name) not in self.held:
            mimic = mimics[name]
            offset, factor, name = offset + factor * mimic.offset, factor * mimic.multiplier, mimic.master
            if name in seen:
                raise checks.fail(f"joint {name!r}: mimic", Shown("a ring of mimics"), "a joint that leads")
            seen.add(name)
        return offset + factor * self.held.get(self.tree.joint(name), 0.0)

    def arm(self, gravity: Any) -> Arm:
        """The Arm, all bodies welded to the links that carry them."""
        tree = self.tree
        g = np.asarray(tree.gravity if gravity is None else checks.as_floats("gravity", gravity), float)
        checks.shape_is("gravity", g, (3,))
        _, upright = tree.pose(self.base, self.held)
        links = tree.welded(self.base, self.joints, self.held)
        links.check()
        tree.check_closed(links, self.joints)
        p, R = links.frames[self.tip]
        tip_p, tip_R = p + R @ self.at_tip[0], R @ self.at_tip[1]
        return Arm(
            **links.parameters(),
            **tree.of_joints(self.joints),
            tip_position=tip_p,
            tip_rotation=tree.quaternion(tip_R),
            g=upright.T @ g,
            links=links.names,
        )


def _position(name: str, value: Any) -> float:
    number = checks.as_floats(f"locked[{name!r}]", value)
    checks.check_values(f"locked[{name!r}]", number, None)
    if number.shape != ():
        raise checks.fail(f"locked[{name!r}]", value, "one number")
    return float(number)
