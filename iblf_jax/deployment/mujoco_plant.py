"""A robot that MuJoCo moves: with its own model, contacts, stops and integrator.

The joints of a scenario are found in MuJoCo's model by their names, or by their order where the
scenario's have none.  What else moves on the same arm, such as the fingers of a gripper, is locked
as `robots.load` locks it; what stands apart moves freely.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.world.robots.description import Shown, read
from iblf_jax.world.robots.load import locked_position
from iblf_jax.world.robots.tree import HINGE, SLIDE, Tree, mujoco_package, unknown

INTEGRATORS = ("RK4", "Euler", "implicit", "implicitfast")

Push = Callable[[float, np.ndarray, np.ndarray], np.ndarray]
"""Torque of the joints, (n,) [N m], at a time [s], q and q'."""


class MujocoPlant:
    """A compiled model, of which some joints are driven."""

    def __init__(
        self,
        plant: Any,
        names: tuple[str, ...],
        n: int,
        locked: Mapping[str, float],
        integrator: str | None,
    ) -> None:
        """What `cosimulate` is given.

        Args:
          plant: path of an MJCF or URDF, a `mujoco.MjSpec` or a `mujoco.MjModel`; the last two stay
            as they are.
          names: of the joints to drive; none to take the model's in their order.
          n: how many there are.
          locked: joint -> position [rad or m].
          integrator: MuJoCo's; None for the model's own.

        Raises:
          ValueError: joints that are not there, or what MuJoCo does not accept.
          ImportError: the extra `robots` is not installed.
        """
        self.mujoco = mujoco = mujoco_package()
        if isinstance(plant, mujoco.MjModel):
            model = copy.copy(plant)
            joints, others = _joints(Tree(model, mujoco, "world", {}), names, n, locked)
            if others:
                remedy = "Give the file or an MjSpec, in which they can be locked."
                raise checks.fail(
                    "plant",
                    Shown("an MjModel in which more moves"),
                    f"one whose arm has {n} joints that move",
                    remedy,
                )
        else:
            model, joints = _locked(mujoco, _specification(mujoco, plant), plant, names, n, locked)
        self.model = model
        self.positions, self.speeds = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        arm = {int(model.body_rootid[model.jnt_bodyid[j]]) for j in joints}
        for a in range(model.nu):  # the law takes the place of the model's own drives
            if arm & {int(model.body_rootid[body]) for body in _driven_bodies(mujoco, model, a)}:
                model.actuator_gear[a] = model.actuator_gainprm[a] = model.actuator_biasprm[a] = 0.0
        if integrator is not None:
            model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
        # Else it would begin again from its first state where it fails, and no result would say so.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.data = mujoco.MjData(model)

    @property
    def timestep(self) -> float:
        """The model's own step [s]."""
        return float(self.model.opt.timestep)

    @property
    def q(self) -> np.ndarray:
        """Positions of the driven joints, (n,)."""
        return self.data.qpos[self.positions]

    @property
    def dq(self) -> np.ndarray:
        """Their velocities, (n,)."""
        return self.data.qvel[self.speeds]

    def place(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Puts the driven joints there."""
        self.data.qpos[self.positions], self.data.qvel[self.speeds] = q, dq

    @contextmanager
    def driven(self, push: Push) -> Iterator[None]:
        """Inside, MuJoCo asks `push` for the torque whenever it needs one: at every stage of its
        integrator.
        """
        mujoco, before = self.mujoco, self.mujoco.get_mjcb_control()

        def control(model: Any, data: Any) -> None:
            if before is not None:
                before(model, data)
            if data is self.data:  # the function is one for all models of the process
                data.qfrc_applied[self.speeds] = push(data.time, self.q, self.dq)

        mujoco.set_mjcb_control(control)
        try:
            yield
        finally:
            mujoco.set_mjcb_control(before)

    def acceleration(self, t: float) -> np.ndarray:
        """What MuJoCo accelerates the joints by at time t [s], as they are, (n,)."""
        self.data.time = t
        self.mujoco.mj_forward(self.model, self.data)
        return self.data.qacc[self.speeds]

    def step(self, t: float, h: float) -> None:
        """Goes on from time t for h [s]."""
        self.data.time, self.model.opt.timestep = t, h
        self.mujoco.mj_step(self.model, self.data)


class Stages:
    """What has a rate of its own, integrated along with MuJoCo's stages."""

    def __init__(
        self,
        rate: Callable[[float, np.ndarray, np.ndarray, Any], tuple[np.ndarray, Any]],
        state: Any,
    ) -> None:
        """`rate` gives torque and rate of the state at a time, q, q' and state."""
        self.rate, self.state = rate, state
        self.begin(0.0)

    def begin(self, t: float) -> None:
        """The next call is the first of a step from time t [s]."""
        self.start = t
        self.slopes: list[Any] = []

    def __call__(self, t: float, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """The torque at a stage: each begins where the slope of the one before it leads."""
        torque, slope = self.rate(t, q, dq, self.moved(t - self.start, self.slopes[-1:], (1.0,)))
        self.slopes.append(slope)
        return torque

    def finish(self, h: float) -> None:
        """The step is over, h [s] long."""
        weights = (1 / 6, 1 / 3, 1 / 3, 1 / 6) if len(self.slopes) == 4 else (1.0,)
        self.state = self.moved(h, self.slopes, weights)

    def moved(self, h: float, slopes: list, weights: tuple[float, ...]) -> Any:
        """The state after h [s]."""
        steps = [h * weight for weight in weights[: len(slopes)]]
        return jax.tree.map(
            lambda x, *rates: x + sum(w * rate for w, rate in zip(steps, rates, strict=True)),
            self.state,
            *slopes,
        )


# ------------------------------------------------------------------------------------------------------- the model and its joints


def _driven_bodies(mujoco: Any, model: Any, a: int) -> list[int]:
    """The bodies that an actuator of the model acts on."""
    kind, target = mujoco.mjtTrn(int(model.actuator_trntype[a])), int(model.actuator_trnid[a, 0])
    if kind in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT):
        return [model.jnt_bodyid[target]]
    if kind == mujoco.mjtTrn.mjTRN_BODY:
        return [target]
    if kind != mujoco.mjtTrn.mjTRN_TENDON:
        return [model.site_bodyid[target]]
    start, bodies, wraps = model.tendon_adr[target], [], mujoco.mjtWrap
    of = {wraps.mjWRAP_JOINT: model.jnt_bodyid, wraps.mjWRAP_SITE: model.site_bodyid}
    for w in range(start, start + model.tendon_num[target]):
        if wraps(int(model.wrap_type[w])) != wraps.mjWRAP_PULLEY:
            bodies.append(
                of.get(wraps(int(model.wrap_type[w])), model.geom_bodyid)[model.wrap_objid[w]]
            )
    return bodies


def _specification(mujoco: Any, plant: Any) -> Any:
    """MuJoCo's specification, whole: with what collides."""
    if isinstance(plant, mujoco.MjSpec):
        return plant.copy()
    if not isinstance(plant, str | os.PathLike):
        raise checks.fail(
            "plant", plant, "the path of an MJCF or URDF, a mujoco.MjSpec or a mujoco.MjModel"
        )
    root, path = read(plant, "plant"), Path(plant)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise _refused(path, error) from None
    if root.tag == "robot":
        _without_missing_meshes(spec, path)
    return spec


def _refused(plant: Any, error: ValueError) -> ValueError:
    """What MuJoCo does not accept, in its words."""
    name, words = (
        plant if isinstance(plant, str | os.PathLike) else "plant",
        " ".join(str(error).split()),
    )
    return ValueError(
        f"{name}: {words}"
        + (". Put the file where the model looks for it." if "opening file" in words else "")
    )


def _without_missing_meshes(spec: Any, path: Path) -> None:
    """Takes the shapes of a URDF whose files are not there out of it: its links have their weights
    from numbers.
    """
    folder = path.parent
    place = folder / spec.meshdir
    missing = {
        mesh.name
        for mesh in spec.meshes
        if not (place / (Path(mesh.file).name if spec.strippath else mesh.file)).exists()
    }
    shapes = [geom for geom in spec.geoms if geom.meshname in missing]
    if shapes:
        reason = "as their meshes are not there: these touch nothing."
        notices.warn(f"{path}: {len(shapes)} shapes are left out, {reason}")
    for geom in shapes:
        spec.delete(geom)
    for mesh in list(spec.meshes):
        if mesh.name in missing:
            spec.delete(mesh)


def _joints(
    tree: Tree, names: tuple[str, ...], n: int, locked: Mapping[str, float]
) -> tuple[list[int], dict[int, float]]:
    """The joints to drive, and where those stay that are locked: the given ones, and what else
    moves on the same arm.
    """
    m = tree.model
    held = {tree.joint(name): locked_position(name, position) for name, position in locked.items()}
    movable = [j for j in range(m.njnt) if m.jnt_type[j] in (HINGE, SLIDE) and j not in held]
    if names:
        for name in names:
            if name not in tree.joint_names:
                raise unknown(
                    "plant", name, "a model that has the scenario's joints", tree.joint_names
                )
        joints = [tree.joint_names.index(name) for name in names]
        for j in joints:
            if j in held:
                raise checks.fail(
                    "locked", tree.joint_names[j], "joints that the scenario does not move"
                )
            if j not in movable:
                raise checks.fail(
                    f"joint {tree.joint_names[j]!r}",
                    Shown("a free joint or a ball"),
                    "a hinge or slide",
                )
    elif len(movable) != n:
        more = "Lock the others, or name the scenario's joints: robots.load does."
        remedy = more if len(movable) > n else "Only hinges and slides count."
        raise checks.fail(
            "plant", Shown(f"{len(movable)} joints that move"), f"{n}, as the scenario has", remedy
        )
    else:
        joints = movable
    arm = {int(m.body_rootid[m.jnt_bodyid[j]]) for j in joints}
    for j in range(m.njnt):
        if j not in joints and j not in held and int(m.body_rootid[m.jnt_bodyid[j]]) in arm:
            if m.jnt_type[j] not in (HINGE, SLIDE):
                raise checks.fail(
                    f"joint {tree.joint_names[j]!r}",
                    Shown("free or a ball"),
                    "an arm on a base that stands still",
                )
            held[j] = float(m.qpos0[m.jnt_qposadr[j]])
    return joints, held


def _compiled(spec: Any, plant: Any) -> Any:
    """The model of a specification; what MuJoCo does not accept is a ValueError in its words."""
    try:
        return spec.compile()
    except ValueError as error:
        raise _refused(plant, error) from None


def _locked(
    mujoco: Any, spec: Any, plant: Any, names: tuple[str, ...], n: int, locked: Mapping[str, float]
) -> tuple[Any, list[int]]:
    """The compiled model without the joints that are locked, their bodies where these hold them,
    and the numbers of the driven ones.
    """
    spec.compiler.fusestatic = False
    whole = _compiled(spec, plant)
    joints, held = _joints(Tree(whole, mujoco, "world", {}), names, n, locked)
    if not held:
        return whole, joints
    data = mujoco.MjData(whole)
    for j, position in held.items():
        data.qpos[whole.jnt_qposadr[j]] = position
    mujoco.mj_kinematics(whole, data)
    gone = _in_the_way(
        mujoco, spec, held
    )  # before any frame is added, with which the numbers of joints are lost
    for body in {int(whole.jnt_bodyid[j]) for j in held}:
        _weld(mujoco, whole, data, spec, body, held)
    for x in gone:
        spec.delete(x)
    left = [j for j in range(whole.njnt) if j not in held]
    return _compiled(spec, plant), [left.index(j) for j in joints]


def _in_the_way(mujoco: Any, spec: Any, held: dict[int, float]) -> list[Any]:
    """The locked joints, and what cannot be without them: tendons over them, what couples, drives
    or senses these, keyframes.
    """
    gone = [joint for joint in spec.joints if joint.id in held]
    tendons = []
    for tendon in spec.tendons:
        wrapped = [wrap.target for wrap in tendon.path if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT]
        if any(joint.id in held for joint in wrapped):
            if not all(joint.id in held for joint in wrapped):
                got = Shown("a tendon over a joint that is locked and one that moves")
                raise checks.fail(
                    f"tendon {tendon.name!r}",
                    got,
                    "one or the other",
                    "Take it out of the model, or lock or drive all of its joints.",
                )
            tendons.append(tendon)
    known = {x.name for x in gone} - {""}, {x.name for x in tendons} - {""}
    of_joints = {mujoco.mjtEq.mjEQ_JOINT: 0, mujoco.mjtEq.mjEQ_TENDON: 1}
    coupled = [
        x
        for x in spec.equalities
        if x.type in of_joints and {x.name1, x.name2} & known[of_joints[x.type]]
    ]
    kinds = {
        mujoco.mjtTrn.mjTRN_JOINT: 0,
        mujoco.mjtTrn.mjTRN_JOINTINPARENT: 0,
        mujoco.mjtTrn.mjTRN_TENDON: 1,
    }
    driven = [
        x for x in spec.actuators if x.trntype in kinds and x.target in known[kinds[x.trntype]]
    ]
    return [*coupled, *driven, *spec.sensors, *spec.keys, *tendons, *gone]


def _weld(mujoco: Any, model: Any, data: Any, spec: Any, body: int, held: dict[int, float]) -> None:
    """Places a body of the specification in its parent where its locked joints hold it."""
    start = int(model.body_jntadr[body])
    own = range(start, start + int(model.body_jntnum[body]))
    if all(held.get(j) == model.qpos0[model.jnt_qposadr[j]] for j in own):
        return
    element = spec.bodies[body]
    if not all(j in held for j in own):
        got, remedy = (
            "a locked joint beside one that moves",
            "Write each into a body of its own, or lock it at its reference.",
        )
        raise checks.fail(
            f"body {element.name!r}", Shown(got), "joints that are locked alone", remedy
        )
    parent, back, turned = int(model.body_parentid[body]), np.zeros(4), np.zeros(4)
    mujoco.mju_negQuat(back, data.xquat[parent])
    mujoco.mju_mulQuat(turned, back, data.xquat[body])
    element.pos = data.xmat[parent].reshape(3, 3).T @ (data.xpos[body] - data.xpos[parent])
    element.quat, element.alt.type = turned, mujoco.mjtOrientation.mjORIENTATION_QUAT
    if (
        element.frame is not None
    ):  # its place is in the parent now: a frame there that moves nothing takes the other's place
        element.set_frame(spec.bodies[parent].add_frame())
