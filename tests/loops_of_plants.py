"""Scenarios of plants in strict-feedback form: a flexible joint, a motor-driven arm with bounds on
all levels, a user's two functions and a user's class."""

import jax.numpy as jnp

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers, references

ROBOT = ij.robots.TwoLink(mass=[1.2, 0.9], length=[0.4, 0.3], centre=[0.2, 0.15], inertia=0.02)


def band(low, high) -> bounds.Bounds:
    return bounds.Bounds(lower=bounds.Constant(low), upper=bounds.Constant(high))


ARM = {
    "reference": references.Sinusoid(offset=[0.5, 0.5], amplitude=0.14, frequency=1.0),
    "bounds": band(0.1, 0.9),
    "initial": ij.Initial(q=[0.6, 0.55]),
}


def flexible_joint(**parts) -> ij.Scenario:
    """Order 4: two links on springs."""
    plant = ij.plants.FlexibleJoint(ROBOT, stiffness=300.0, motor_inertia=0.02, motor_damping=0.1)
    law = controllers.BarrierBackstepping(k=(3.0, 20.0, 60.0, 150.0))
    return ij.Scenario(**({"plant": plant, "controller": law, **ARM} | parts))


def rigid_law(**parts) -> ij.Scenario:
    """A law for rigid arms on stiff joints with damped motors; its model is the robot inside."""
    plant = ij.plants.FlexibleJoint(ROBOT, stiffness=3e3, motor_inertia=0.02, motor_damping=3.0)
    law = controllers.Backstepping(k1=3.0, K2=1.0, barrier=barriers.TransformedError())
    return flexible_joint(**({"plant": plant, "model": plant.robot, "controller": law} | parts))


def electric_drive(**parts) -> ij.Scenario:
    """Order 3: two links with motors, and bounds on positions, velocities and currents."""
    plant = ij.plants.ElectricDrive(
        ROBOT, torque_constant=0.9, inductance=0.02, resistance=1.1, back_emf=0.9
    )
    law = controllers.BarrierBackstepping(
        k=(3.0, 20.0, 60.0), barriers=(barriers.TransformedError(),) * 3, c=(0.0, 0.1, 0.1)
    )
    levels = (band(0.1, 0.9), band(-4.0, 4.0), band(-60.0, 60.0))
    own = {"plant": plant, "controller": law, "bounds": levels}
    return ij.Scenario(**(ARM | own | parts))


@ij.component
class MotorPendulum:
    """x1' = x2,  D x2' = x3 - B x2 - N sin x1,  M x3' = u - H x3 - Km x2."""

    D: ij.Leaf = ij.leaf("kg m^2", sign="positive", default=1.0)
    B: ij.Leaf = ij.leaf("N m s/rad", default=1.0)
    N: ij.Leaf = ij.leaf("N m", default=10.0)
    M: ij.Leaf = ij.leaf("H", sign="positive", default=0.1)
    H: ij.Leaf = ij.leaf("ohm", default=1.0)
    Km: ij.Leaf = ij.leaf("N m/A", default=0.2)
    n = 1
    order = 3

    def drift(self, t, x):
        load = self.B * x[1] + self.N * jnp.sin(x[0])
        return jnp.stack([0.0 * x[0], -load / self.D, -(self.H * x[2] + self.Km * x[1]) / self.M])

    def gain(self, t, x):
        one = jnp.ones_like(x[0])
        return jnp.stack([one, one / self.D, one / self.M])


def pendulum_drift(t, x):
    return MotorPendulum().drift(t, x)


def pendulum_gain(t, x):
    return MotorPendulum().gain(t, x)[..., None]


PENDULUM = {
    "controller": controllers.BarrierBackstepping(k=(2.0, 10.0, 30.0)),
    "reference": references.Sinusoid(offset=0.0, amplitude=0.4, frequency=1.0),
    "bounds": band(-0.8, 0.8),
    "initial": ij.Initial(x=[[0.2], [0.0], [0.0]]),
}


def user_class(**parts) -> ij.Scenario:
    return ij.Scenario(**({"plant": MotorPendulum()} | PENDULUM | parts))


def user_functions(**parts) -> ij.Scenario:
    plant = ij.plants.StrictFeedback(pendulum_drift, pendulum_gain, n=1, order=3)
    return ij.Scenario(**({"plant": plant} | PENDULUM | parts))


LOOPS = (flexible_joint, electric_drive, user_class, user_functions)
CASES = {make.__name__.replace("_", " "): make for make in LOOPS}
"""Name -> scenario; all laws are `BarrierBackstepping`."""
