"""Arms that several test files look at: real ones from tests/data/arms, random chains, and the same
chains as MuJoCo's MJCF."""

import numpy as np
from conftest import ROOT

import iblf_jax as ij
from iblf_jax.simulation.scenario import canonical

ARMS = ROOT / "tests" / "data" / "arms"
REAL = {"ur5": "ur5.urdf", "iiwa14": "iiwa14.urdf", "xarm7": "xarm7.urdf"}


def random_inertia(rng) -> np.ndarray:
    """Inertia about the centre of a random body, xx yy zz xy xz yz [kg m^2]."""
    second = rng.normal(size=(3, 3)) * 0.1
    second = second @ second.T + 0.002 * np.eye(3)
    J = np.trace(second) * np.eye(3) - second
    return np.array([J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]])


def random_arm(n: int, seed: int, prismatic: float = 0.3, **fields) -> ij.robots.Arm:
    """A chain of n links with nothing aligned, and a load at its tip."""
    rng = np.random.default_rng(seed)
    is_prismatic = np.random.default_rng(n).uniform(size=n) < prismatic  # compiled once for an n
    kinds = tuple("prismatic" if x else "revolute" for x in is_prismatic)
    carried = ij.robots.Payload(
        mass=rng.uniform(0.1, 1), centre=rng.normal(size=3) * 0.1, inertia=random_inertia(rng)
    )
    return ij.robots.Arm(
        mass=rng.uniform(0.2, 4, n),
        centre=rng.normal(size=(n, 3)) * 0.1,
        inertia=np.array([random_inertia(rng) for _ in range(n)]),
        position=rng.normal(size=(n, 3)) * 0.3,
        rotation=rng.normal(size=(n, 4)),
        axis=rng.normal(size=(n, 3)),
        tip_position=rng.normal(size=3) * 0.2,
        tip_rotation=rng.normal(size=4),
        g=rng.normal(size=3) * 5,
        carried=carried,
        kinds=kinds,
        **fields,
    )


def _words(values) -> str:
    return " ".join(repr(float(x)) for x in np.ravel(values))


def _place(position, rotation) -> str:
    return f'pos="{_words(position)}" quat="{_words(rotation)}"'


def _inertial(mass, centre, inertia) -> str:
    place = f'pos="{_words(centre)}" mass="{_words(mass)}"'
    return f'<inertial {place} fullinertia="{_words(inertia)}"/>'


def as_mjcf(arm: ij.robots.Arm) -> str:
    """The same arm, written by hand for MuJoCo, what it carries as a body of its own."""
    carried, tip = arm.carried, _place(arm.tip_position, arm.tip_rotation)
    inner = f'<site name="tip" {tip}/>'
    if carried.mass > 0.0:
        inertial = _inertial(carried.mass, carried.centre, carried.inertia)
        inner += f'<body name="load" {tip}>{inertial}</body>'
    for i in reversed(range(arm.n)):
        kind = {"revolute": "hinge", "prismatic": "slide"}[arm.kinds[i]]
        joint = (
            f'<joint name="{arm.joints[i]}" type="{kind}" axis="{_words(arm.axis[i])}"'
            f' armature="{_words(arm.armature[i])}" damping="{_words(arm.damping[i])}"'
            f' frictionloss="{_words(arm.friction[i])}"/>'
        )
        place = _place(arm.position[i], arm.rotation[i])
        inertial = _inertial(arm.mass[i], arm.centre[i], arm.inertia[i])
        inner = f'<body name="{arm.links[i]}" {place}>{joint}{inertial}{inner}</body>'
    options = f'<compiler angle="radian"/><option gravity="{_words(arm.g)}"/>'
    return f"<mujoco>{options}<worldbody>{inner}</worldbody></mujoco>"


def without_constraints(model):
    """A model of MuJoCo's with everything off that an Arm does not have, and RK4."""
    import mujoco

    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.timestep = 1e-3
    model.dof_damping[:] = 0
    model.dof_frictionloss[:] = 0
    return model


def dynamics_of(model, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """M and C v + G by MuJoCo."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, v
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    return M, data.qfrc_bias.copy()


def light_loop() -> ij.Scenario:
    """The paper's arm under a law that compiles sooner than the paper's."""
    law, observer = ij.controllers.PDGravity(Kp=60.0, Kd=20.0), ij.observers.NoObserver()
    return ij.with_parts(ij.presets.zhang_yan_2024(), controller=law, observer=observer)


def loop_on(arm, law, **parts) -> ij.Scenario:
    """A law on the arm of an `independent.Loop`, which follows a sinusoid inside wide bounds."""
    numbers = arm.mass, arm.length, arm.centre, arm.inertia
    plant = ij.robots.TwoLink(*numbers, g=arm.g)
    values = {
        "reference": ij.references.Sinusoid(0.3, 0.2, 1.5, phase=[0.0, 0.4]),
        "bounds": ij.Bounds(lower=ij.bounds.Constant(-0.5), upper=ij.bounds.Constant(1.5)),
        "initial": ij.Initial(q=[0.45, 0.2], dq=[0.1, 0.2]),
    }
    return canonical(ij.Scenario(plant=plant, controller=law, **(values | parts)))
