"""A robot that MuJoCo simulates, with its own model, contacts, stops and integrator.

The joints of a scenario are found in MuJoCo's model by their names, or by their order if the
scenario's joints have no names.  Other joints of the same arm, such as the fingers of a gripper,
are locked as `robots.load` locks them.  Separate bodies move freely.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.status import VELOCITY_LIMIT
from iblf_jax.world.robots.description import Shown, read
from iblf_jax.world.robots.load import locked_position
from iblf_jax.world.robots.payload import Payload
from iblf_jax.world.robots.tree import HINGE, SLIDE, Tree, mujoco_package, unknown

INTEGRATORS = ("RK4", "Euler", "implicit", "implicitfast")

if TYPE_CHECKING:
    import mujoco

MujocoSource: TypeAlias = "str | os.PathLike[str] | mujoco.MjSpec | mujoco.MjModel"
"""What MuJoCo simulates: the path of an MJCF or URDF, a specification or a compiled model."""

TorqueCallback = Callable[[float, np.ndarray, np.ndarray], np.ndarray]
"""Computes the torque of the joints, (n,) [N m], from time [s], q and q'."""


class MujocoPlant:
    """A compiled model, of which some joints are driven."""

    def __init__(
        self,
        plant: MujocoSource,
        names: tuple[str, ...],
        n: int,
        locked: Mapping[str, float],
        integrator: str | None,
        payload: Payload | None = None,
    ) -> None:
        """The arguments of `cosimulate`.

        Args:
          plant: path of an MJCF or URDF, a `mujoco.MjSpec` or a `mujoco.MjModel`; the last two stay
            as they are.
          names: names of the driven joints; empty to use the model's joints in their order.
          n: number of driven joints.
          locked: joint -> position [rad or m].
          integrator: MuJoCo's; None for the model's own.
          payload: a body fixed to the body that the last driven joint moves, in whose frame centre
            and inertia are; none if not given.

        Raises:
          ValueError: missing joints, a model that MuJoCo does not accept, or a payload for an
            `MjModel` or with a start.
          ImportError: the extra `robots` is not installed.
        """
        self.mujoco = mujoco = mujoco_package()
        if payload is not None:
            plant = with_payload(plant, names, payload)
        if isinstance(plant, mujoco.MjModel):
            model = copy.copy(plant)
            joints, locked_positions = _joints(Tree(model, mujoco, "world", {}), names, n, locked)
            if locked_positions:
                came = Shown("an MjModel in which more moves")
                remedy = "Give the file or an MjSpec, in which they can be locked."
                raise checks.fail("plant", came, f"one whose arm has {n} joints that move", remedy)
        else:
            spec = _specification(mujoco, plant)
            model, joints = _with_locked_joints(mujoco, spec, plant, names, n, locked)
        self.model = model
        self.joint_names = tuple(Tree(model, mujoco, "world", {}).joint_names[j] for j in joints)
        self.positions, self.speeds = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        arm = {int(model.body_rootid[model.jnt_bodyid[j]]) for j in joints}
        for a in range(model.nu):  # the law replaces the model's own actuators
            if arm & {int(model.body_rootid[body]) for body in _driven_bodies(mujoco, model, a)}:
                model.actuator_gear[a] = model.actuator_gainprm[a] = model.actuator_biasprm[a] = 0.0
        if integrator is not None:
            model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
        # By default MuJoCo resets a diverged simulation to its first state without any report.
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
        """Sets the state of the driven joints."""
        self.data.qpos[self.positions], self.data.qvel[self.speeds] = q, dq

    @property
    def state(self) -> np.ndarray:
        """Positions and velocities of all joints of the model, as `restore` takes them."""
        return np.concatenate([self.data.qpos, self.data.qvel])

    def restore(self, state: np.ndarray) -> None:
        """Sets positions and velocities of all joints of the model."""
        self.data.qpos[:] = state[: self.model.nq]
        self.data.qvel[:] = state[self.model.nq :]

    def has_diverged(self) -> bool:
        """Whether the state of the driven joints is not finite or too fast."""
        is_finite = np.all(np.isfinite(self.q))
        return not (is_finite and np.all(np.abs(self.dq) < VELOCITY_LIMIT))

    def apply(self, torque: np.ndarray) -> None:
        """Sets a torque of the driven joints, (n,) [N m], that stays until the next one."""
        self.data.qfrc_applied[self.speeds] = torque

    @contextmanager
    def driven(self, torque: TorqueCallback) -> Iterator[None]:
        """Context in which MuJoCo calls `torque` at every stage of its integrator."""
        mujoco, before = self.mujoco, self.mujoco.get_mjcb_control()

        def control(model: Any, data: Any) -> None:
            if before is not None:
                before(model, data)
            if data is self.data:  # MuJoCo calls it for all models of the process.
                data.qfrc_applied[self.speeds] = torque(data.time, self.q, self.dq)

        mujoco.set_mjcb_control(control)
        try:
            yield
        finally:
            mujoco.set_mjcb_control(before)

    def acceleration(self, t: float) -> np.ndarray:
        """Acceleration of the driven joints at time t [s] in the present state, (n,)."""
        self.data.time = t
        self.mujoco.mj_forward(self.model, self.data)
        return self.data.qacc[self.speeds]

    def step(self, t: float, h: float) -> None:
        """Integrates from time t over h [s]."""
        self.data.time, self.model.opt.timestep = t, h
        self.mujoco.mj_step(self.model, self.data)


class Stages:
    """Integrates a state that MuJoCo does not have, with the stages of MuJoCo's integrator."""

    def __init__(
        self,
        rate: Callable[[float, np.ndarray, np.ndarray, Any], tuple[np.ndarray, Any]],
        state: Any,
    ) -> None:
        """`rate` gives torque and rate of the state at a time, q, q' and state."""
        self.rate, self.state = rate, state
        self.begin(0.0)

    def begin(self, t: float) -> None:
        """Begins a step at time t [s]; the next call is its first stage."""
        self.start = t
        self.slopes: list[Any] = []

    def __call__(self, t: float, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """The torque at a stage; the state there follows from the rate at the previous stage."""
        state = self.extrapolated(t - self.start, self.slopes[-1:], (1.0,))
        torque, slope = self.rate(t, q, dq, state)
        self.slopes.append(slope)
        return torque

    def finish(self, h: float) -> None:
        """Ends a step of length h [s]."""
        weights: tuple[float, ...] = (1.0,)
        if len(self.slopes) == 4:
            weights = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
        self.state = self.extrapolated(h, self.slopes, weights)

    def extrapolated(self, h: float, slopes: list, weights: tuple[float, ...]) -> Any:
        """The state after h [s]."""
        steps = [h * weight for weight in weights[: len(slopes)]]
        return jax.tree.map(
            lambda x, *rates: x + sum(w * rate for w, rate in zip(steps, rates, strict=True)),
            self.state,
            *slopes,
        )


# ----------------------------------------------------------------- the model and its joints


def _driven_bodies(mujoco: ModuleType, model: mujoco.MjModel, a: int) -> list[int]:
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
        wrap = wraps(int(model.wrap_type[w]))
        if wrap != wraps.mjWRAP_PULLEY:
            bodies.append(of.get(wrap, model.geom_bodyid)[model.wrap_objid[w]])
    return bodies


def _specification(mujoco: ModuleType, plant: MujocoSource) -> Any:
    """MuJoCo's specification of the complete model, with its collision geometry."""
    if isinstance(plant, mujoco.MjSpec):
        return plant.copy()
    if not isinstance(plant, str | os.PathLike):
        expected = "the path of an MJCF or URDF, a mujoco.MjSpec or a mujoco.MjModel"
        raise checks.fail("plant", plant, expected)
    root, path = read(plant, "plant"), Path(plant)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise _refused(path, error) from None
    if root.tag == "robot":
        _without_missing_meshes(spec, path)
    return spec


def _refused(plant: MujocoSource, error: ValueError) -> ValueError:
    """The error for a model that MuJoCo does not accept, with its message."""
    name, words = "plant", " ".join(str(error).split())
    if isinstance(plant, str | os.PathLike):
        name = str(plant)
    if "opening file" in words:
        words += ". Put the file where the model looks for it."
    return ValueError(f"{name}: {words}")


def _without_missing_meshes(spec: mujoco.MjSpec, path: Path) -> None:
    """Removes the shapes of a URDF whose mesh files are missing; the masses of its links are given
    as numbers.
    """
    missing = set()
    for mesh in spec.meshes:
        file = Path(mesh.file)
        if spec.strippath:
            file = Path(file.name)
        if not (path.parent / spec.meshdir / file).exists():
            missing.add(mesh.name)
    shapes = [geom for geom in spec.geoms if geom.meshname in missing]
    if shapes:
        reason = "as their meshes are not there: these touch nothing."
        notices.warn(f"{path}: {len(shapes)} shapes are left out, {reason}")
    for geom in shapes:
        spec.delete(geom)
    for mesh in list(spec.meshes):
        if mesh.name in missing:
            spec.delete(mesh)


LEAST_INERTIA = 1e-12
"""Moment of inertia of a payload that has none [kg m^2]; MuJoCo accepts no smaller one."""


def with_payload(plant: MujocoSource, names: tuple[str, ...], payload: Payload) -> Any:
    """MuJoCo's specification of a robot with a payload, a body that is fixed to the one which the
    last driven joint moves.

    Args:
      plant, names, payload: as in `MujocoPlant`.

    Raises:
      ValueError: as `MujocoPlant`.
    """
    mujoco = mujoco_package()
    if isinstance(plant, mujoco.MjModel):
        remedy = "Give the file or an MjSpec, to which a body can be added."
        raise checks.fail("payload", payload, "None for a compiled model", remedy)
    if not isinstance(payload, Payload):
        remedy = "Such as ij.robots.Payload(mass=0.3, centre=[0.3, 0.0, 0.0])."
        raise checks.fail("payload", payload, "an iblf_jax.robots.Payload, or None", remedy)
    if payload.start is not None:
        remedy = "Take a payload without a start."
        raise checks.fail("payload.start", payload.start, "None, as MuJoCo's mass is fixed", remedy)
    spec = _specification(mujoco, plant)
    mass = checks.positive_number("payload.mass", payload.mass, "kg", zero=True)
    if mass == 0:
        return spec
    tree = Tree(_compiled(spec, plant), mujoco, "world", {})
    last = names[-1:] or tree.joint_names[-1:]
    for name in last:
        if name not in tree.joint_names:
            raise unknown("plant", name, "a model that has the scenario's joints", tree.joint_names)
    joint = tree.joint_names.index(last[0])
    body = spec.bodies[int(tree.model.jnt_bodyid[joint])].add_body(name="payload of the robot")
    body.mass, body.explicitinertial = mass, True
    body.ipos = np.asarray(payload.centre, float)
    inertia = np.asarray(payload.inertia, float)
    if not np.any(inertia):
        inertia = np.array([LEAST_INERTIA] * 3 + [0.0] * 3)
    body.fullinertia = inertia
    return spec


def _joints(
    tree: Tree, names: tuple[str, ...], n: int, locked: Mapping[str, float]
) -> tuple[list[int], dict[int, float]]:
    """The driven joints, and the positions of the locked ones: the given ones, and the other joints
    of the same arm.
    """
    m = tree.model
    locked_positions = {
        tree.joint(name): locked_position(name, position) for name, position in locked.items()
    }
    movable = [
        j for j in range(m.njnt) if m.jnt_type[j] in (HINGE, SLIDE) and j not in locked_positions
    ]
    joints = movable
    if names:
        joints = _joints_by_name(tree, names, movable, locked_positions)
    elif len(movable) != n:
        came = Shown(f"{len(movable)} joints that move")
        remedy = "Only hinges and slides count."
        if len(movable) > n:
            remedy = "Lock the others, or name the scenario's joints: robots.load does."
        raise checks.fail("plant", came, f"{n}, as the scenario has", remedy)
    arm = {int(m.body_rootid[m.jnt_bodyid[j]]) for j in joints}
    for j in set(range(m.njnt)).difference(joints, locked_positions):
        if int(m.body_rootid[m.jnt_bodyid[j]]) not in arm:
            continue
        if m.jnt_type[j] not in (HINGE, SLIDE):
            field, came = f"joint {tree.joint_names[j]!r}", Shown("free or a ball")
            raise checks.fail(field, came, "an arm on a base that stands still")
        locked_positions[j] = float(m.qpos0[m.jnt_qposadr[j]])
    return joints, locked_positions


def _joints_by_name(
    tree: Tree, names: tuple[str, ...], movable: list[int], locked_positions: dict[int, float]
) -> list[int]:
    """The driven joints that the scenario names; ValueError if one of them cannot be driven."""
    for name in names:
        if name not in tree.joint_names:
            expected = "a model that has the scenario's joints"
            raise unknown("plant", name, expected, tree.joint_names)
    joints = [tree.joint_names.index(name) for name in names]
    for name, j in zip(names, joints, strict=True):
        if j in locked_positions:
            raise checks.fail("locked", name, "joints that the scenario does not move")
        if j not in movable:
            came = Shown("a free joint or a ball")
            raise checks.fail(f"joint {name!r}", came, "a hinge or slide")
    return joints


def _compiled(spec: mujoco.MjSpec, plant: MujocoSource) -> mujoco.MjModel:
    """The model of a specification; ValueError with MuJoCo's message if it is not accepted."""
    try:
        return spec.compile()
    except ValueError as error:
        raise _refused(plant, error) from None


def _with_locked_joints(
    mujoco: ModuleType,
    spec: mujoco.MjSpec,
    plant: MujocoSource,
    names: tuple[str, ...],
    n: int,
    locked: Mapping[str, float],
) -> tuple[Any, list[int]]:
    """The compiled model, in which the bodies of locked joints are fixed at the locked positions,
    and the indices of the driven joints in it.
    """
    spec.compiler.fusestatic = False
    full_model = _compiled(spec, plant)
    joints, locked_positions = _joints(Tree(full_model, mujoco, "world", {}), names, n, locked)
    if not locked_positions:
        return full_model, joints
    data = mujoco.MjData(full_model)
    for j, position in locked_positions.items():
        data.qpos[full_model.jnt_qposadr[j]] = position
    mujoco.mj_kinematics(full_model, data)
    # The joints lose their numbers as soon as a frame is added.
    removed = _elements_to_remove(mujoco, spec, locked_positions)
    for body in {int(full_model.jnt_bodyid[j]) for j in locked_positions}:
        _weld(mujoco, full_model, data, spec, body, locked_positions)
    for x in removed:
        spec.delete(x)
    left = [j for j in range(full_model.njnt) if j not in locked_positions]
    return _compiled(spec, plant), [left.index(j) for j in joints]


def _elements_to_remove(
    mujoco: ModuleType, spec: mujoco.MjSpec, locked_positions: dict[int, float]
) -> list[Any]:
    """The locked joints, and the elements that refer to them: tendons, couplings, actuators,
    sensors and keyframes.
    """
    removed = [joint for joint in spec.joints if joint.id in locked_positions]
    tendons = []
    for tendon in spec.tendons:
        wrapped = [wrap.target for wrap in tendon.path if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT]
        if any(joint.id in locked_positions for joint in wrapped):
            if not all(joint.id in locked_positions for joint in wrapped):
                came = Shown("a tendon over a joint that is locked and one that moves")
                remedy = "Take it out of the model, or lock or drive all of its joints."
                raise checks.fail(f"tendon {tendon.name!r}", came, "one or the other", remedy)
            tendons.append(tendon)
    joint_names = {x.name for x in removed} - {""}
    tendon_names = {x.name for x in tendons} - {""}
    coupled_to = {mujoco.mjtEq.mjEQ_JOINT: joint_names, mujoco.mjtEq.mjEQ_TENDON: tendon_names}
    couplings = [x for x in spec.equalities if {x.name1, x.name2} & coupled_to.get(x.type, set())]
    acts_on = {
        mujoco.mjtTrn.mjTRN_JOINT: joint_names,
        mujoco.mjtTrn.mjTRN_JOINTINPARENT: joint_names,
        mujoco.mjtTrn.mjTRN_TENDON: tendon_names,
    }
    actuators = [x for x in spec.actuators if x.target in acts_on.get(x.trntype, set())]
    return [*couplings, *actuators, *spec.sensors, *spec.keys, *tendons, *removed]


def _weld(
    mujoco: ModuleType,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    spec: mujoco.MjSpec,
    body: int,
    locked_positions: dict[int, float],
) -> None:
    """Fixes a body of the specification in its parent at the positions of its locked joints."""
    start = int(model.body_jntadr[body])
    own = range(start, start + int(model.body_jntnum[body]))
    if all(locked_positions.get(j) == model.qpos0[model.jnt_qposadr[j]] for j in own):
        return
    element = spec.bodies[body]
    if not all(j in locked_positions for j in own):
        came = Shown("a locked joint beside one that moves")
        expected = "bodies whose joints are all locked"
        remedy = "Write each into a body of its own, or lock it at its reference."
        raise checks.fail(f"body {element.name!r}", came, expected, remedy)
    parent, back, turned = int(model.body_parentid[body]), np.zeros(4), np.zeros(4)
    mujoco.mju_negQuat(back, data.xquat[parent])
    mujoco.mju_mulQuat(turned, back, data.xquat[body])
    element.pos = data.xmat[parent].reshape(3, 3).T @ (data.xpos[body] - data.xpos[parent])
    element.quat = turned
    element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    if element.frame is not None:
        # The pose is relative to the parent now, so a frame of the parent without an own pose
        # replaces the frame of the body.
        element.set_frame(spec.bodies[parent].add_frame())
