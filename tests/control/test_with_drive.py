"""The input map of a law of robots on electric drives, and models of flexible joints."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from iblf_jax.controllers import BarrierBackstepping, PDGravity, Saturated, WithDrive
from refused import refused

import iblf_jax as ij
from iblf_jax.simulation.scenario import canonical

PAPER = ij.presets.zhang_yan_2024()
ROBOT = PAPER.plant
DRIVE = ij.plants.ElectricDrive(
    ROBOT, torque_constant=[2.0, 1.5], inductance=0.02, resistance=[1.0, 0.5], back_emf=0.5
)
FLEXIBLE = ij.plants.FlexibleJoint(
    ROBOT, stiffness=3000.0, motor_inertia=[0.1, 0.02], motor_damping=[0.3, 0.2]
)
PD = PDGravity(Kp=60.0, Kd=20.0)


def on(plant, law, **parts):
    parts |= {"plant": plant, "controller": law, "observer": ij.observers.NoObserver()}
    return ij.with_parts(PAPER, **parts)


def test_the_voltage_is_that_of_the_steady_current():
    """u = R tau/Kt + Kb q'; tau is still the torque, also of a law that receives x."""
    x, t, context = jnp.array([[0.7, 0.6], [0.2, -0.4]]), jnp.asarray(0.1), PAPER.context
    rigid = BarrierBackstepping(k=(2.0, 10.0), weights=np.ones((2, 2)))
    for law, q, d_hat in ((PD, (x[0], x[1]), jnp.zeros(2)), (rigid, (x,), jnp.zeros((2, 2)))):
        torque = law.command(t, *q, d_hat, context, ())[0].tau
        command, _ = WithDrive(law, drive=DRIVE).command(t, x, d_hat, context, ())
        np.testing.assert_array_equal(command.tau, torque)
        expected = np.array([1.0, 0.5]) * torque / np.array([2.0, 1.5]) + 0.5 * x[1]
        np.testing.assert_allclose(command.input, expected, rtol=1e-14)


def test_paths_reach_the_law_and_the_drive():
    scenario = on(DRIVE, WithDrive(PD, drive=DRIVE))
    values = {"controller.Kp": 30.0, "controller.drive.resistance": 2.0}
    changed = ij.with_parameters(scenario, values)
    np.testing.assert_array_equal(changed.controller.law.Kp, [30.0, 30.0])
    np.testing.assert_array_equal(changed.controller.drive.resistance, [2.0, 2.0])


@pytest.mark.slow
def test_an_observer_receives_the_torque():
    """Its estimate contains the torque that the current lacks; tau is recorded as the voltage."""
    parts = {"observer": ij.observers.Momentum(kf=20.0), "plant": DRIVE, "model": ROBOT}
    scenario = ij.with_parts(PAPER, controller=WithDrive(PD, drive=DRIVE), **parts)
    run = ij.simulate(scenario, duration=0.5, dt=1e-3)
    assert run.x.shape[1:] == (3, 2)
    np.testing.assert_allclose(DRIVE.voltage(run.x[-1, 2], run.dq[-1]), run.tau[-1], atol=0.2)


VOLTS = WithDrive(PD, drive=DRIVE)
test_a_law_that_commands_another_quantity_is_refused = refused(
    (
        lambda: on(DRIVE, PD, model=ROBOT),
        r"PDGravity, which commands \[N m\].*\[V\].*WithDrive\(law, drive=plant\)",
    ),
    (lambda: on(ROBOT, VOLTS, model=ROBOT), r"WithDrive, which commands \[V\]"),
    (lambda: on(DRIVE, Saturated(VOLTS, limit=9.0), model=ROBOT), "outermost"),
    (lambda: WithDrive(PD, ROBOT), r"WithDrive\.drive"),
    (lambda: WithDrive(DRIVE, DRIVE), r"WithDrive\.law"),
)


def test_a_rigid_model_has_the_motors_or_the_links_alone_and_the_members_of_its_robot():
    q, v = jnp.array([0.4, -0.3]), jnp.array([0.5, 0.2])
    rigid, links = FLEXIBLE.rigid(), FLEXIBLE.rigid(motors=False)
    assert links is ROBOT
    expected = ROBOT.mass_matrix(q) + np.diag([0.1, 0.02])
    np.testing.assert_allclose(rigid.mass_matrix(q), expected, rtol=1e-15)
    np.testing.assert_array_equal(rigid.coriolis(q, v, v), ROBOT.coriolis(q, v, v))
    np.testing.assert_allclose(ij.robots.friction_torque(rigid, v), [-0.15, -0.04], rtol=1e-15)
    arm = ij.presets.arms.arm("iiwa14")
    motors = ij.robots.WithMotors(arm, inertia=0.1)
    assert ij.robots.joint_names(motors, 7) == ij.robots.joint_names(arm, 7)
    np.testing.assert_array_equal(motors.effort, arm.effort)
    np.testing.assert_array_equal(motors.limits.upper, arm.limits.upper)


def chain(inertia):
    return ij.robots.PlanarChain(mass=[1.3], length=[0.4], centre=[0.2], inertia=[inertia])


@pytest.mark.slow
def test_models_with_the_motors_are_accepted_without_a_word():
    """Also one less its motors here, and one whose links differ from those of the plant."""
    plant = ij.plants.FlexibleJoint(chain(0.02), stiffness=3000.0, motor_inertia=0.03)
    parts = {"initial": ij.Initial(q=0.6), "disturbance": ij.disturbances.Nothing()}
    parts["reference"] = ij.references.Sinusoid(offset=0.5, amplitude=0.1, frequency=1.0)
    parts["bounds"] = ij.Bounds(lower=ij.bounds.Constant(0.1), upper=ij.bounds.Constant(0.9))
    in_another_form = on(plant, PD, model=chain(0.05), **parts)
    loaded = on(FLEXIBLE, PD, model=FLEXIBLE.rigid())
    loaded = ij.with_parameters(loaded, {"plant.robot.payload": 0.2})
    with warnings.catch_warnings(action="error"):
        canonical(in_another_form)
        canonical(loaded)


def test_a_model_without_the_motors_says_so():
    with pytest.warns(UserWarning, match=r"contains 0% of that of the motors.*plant\.rigid\(\)"):
        canonical(on(FLEXIBLE, PD, model=ROBOT))


@pytest.mark.parametrize("side", ["lower", "upper"])
def test_velocity_bounds_around_two_centres_are_refused(side):
    """A funnel of a robot's velocities follows q_d', of another plant's second level alpha_1."""
    sides = {"lower": ij.bounds.Constant(-6.0), "upper": ij.bounds.Constant(6.0)}
    sides[side] = ij.bounds.Funnel(*((-6.0, -4.0) if side == "lower" else (6.0, 4.0)), 1.0)
    levels = PAPER.bounds[0], ij.Bounds(**sides)
    law = BarrierBackstepping(k=(2.0, 10.0), weights=np.ones((2, 2)))
    ij.with_parts(PAPER, controller=law, bounds=levels)
    with pytest.raises(ValueError, match=r"Scenario\.bounds\[1\]: got a Funnel, expected no"):
        on(FLEXIBLE, law, model=FLEXIBLE.rigid(), bounds=levels)
