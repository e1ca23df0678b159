"""Scenarios on plants in strict-feedback form under `controllers.BarrierBackstepping`, each with
the sources of its numbers.

The gains are set by hand: each level is two to four times faster than the level below it.  Every
docstring names a duration and a time step at which the numerical error of the tracking error is
below 0.01 % of the width of the bounds.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from iblf_jax.control.barriers import Barrier, Quadratic, TransformedError
from iblf_jax.control.controllers import BarrierBackstepping
from iblf_jax.control.observers import LevelObserver, Momentum
from iblf_jax.presets.arms import iiwa14
from iblf_jax.presets.paper import customary_two_link, zhang_yan_2024
from iblf_jax.simulation.initial import Initial
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world.bounds import Bounds, Constant, Funnel, from_speed_limits
from iblf_jax.world.bounds import Sinusoid as SinusoidalBound
from iblf_jax.world.disturbances import Levels, Sinusoids, Sum
from iblf_jax.world.plants import DrivenPendulum, ElectricDrive, FlexibleJoint, Vessel
from iblf_jax.world.references import Ellipse, Sinusoid


def _within(limit: float | list[float]) -> Bounds:
    """Constant bounds -limit and limit."""
    size = np.asarray(limit)
    return Bounds(lower=Constant(-size), upper=Constant(size))


def _law(k: tuple[float, ...], *barriers: Barrier) -> Any:
    """The law with gains k [1/s] and one barrier a level."""
    return BarrierBackstepping(k=k, barriers=barriers)


def _observer(*gain: float) -> Any:
    """The observer of the disturbances, with one gain a level [1/s]."""
    return LevelObserver(gain=gain)


def cybership_ii() -> Vessel:
    """CyberShip II, a 1:70 model of a supply ship of 1.255 m and 23.8 kg.

    The rigid body, the added masses and the full nonlinear damping are the identified ones.  The
    symmetric part of the linear damping is not positive definite.

    Source: R. Skjetne, O. Smogeli, T. I. Fossen, A nonlinear ship manoeuvering model:
      identification and adaptive control with experiments for a model ship, Modeling,
      Identification and Control 25 (2004) 3-27, tables 1, 2 and 4.
    """
    return Vessel(
        mass=23.8,
        length=1.255,
        beam=0.29,
        yaw_inertia=1.76,
        centre=0.046,
        X_du=-2.0,
        Y_dv=-10.0,
        Y_dr=0.0,
        N_dr=-1.0,
        X_u=-0.72253,
        X_uu=-1.32742,
        X_uuu=-5.86643,
        Y_v=-0.88965,
        Y_vv=-36.47287,
        Y_rv=-0.805,
        Y_r=-7.25,
        Y_vr=-0.845,
        Y_rr=-3.45,
        N_v=0.0313,
        N_vv=3.95645,
        N_rv=0.13,
        N_r=-1.9,
        N_vr=0.08,
        N_rr=-0.75,
    )


def vessel(*, current: float = 0.05, waves: float = 0.5) -> Scenario:
    """CyberShip II on an ellipse of 10 m by 6 m, with its heading along the path, in a slowly
    turning current and in waves.

    Funnels around the reference shrink from 1.5 m to 0.4 m and from 0.8 rad to 0.3 rad; the surge
    velocity stays between -0.2 and 0.8 m/s, the sway velocity within 0.3 m/s and the yaw rate
    within 0.5 rad/s.  The current is a disturbance of the position, which no force opposes
    directly; the observer of both levels estimates it.  Bounds, disturbances and gains are
    ASSUMPTIONS of this package, as is a force in every direction: CyberShip II has two propellers
    of about 4 N each and a bow thruster.

    Args:
      current: its speed to the north and to the east, which varies as a sinusoid [m/s].
      waves: amplitude of their force in surge and in sway [N]; a fifth of it as a yaw moment [N m].

    Returns:
      A Scenario of order 2 with 3 components, for runs of 160 s (two revolutions) at dt = 0.02 s.

    Source: this package; the vessel as `cybership_ii` says.
    """
    widest, narrowest = np.array([1.5, 1.5, 0.8]), np.array([0.4, 0.4, 0.3])
    drift = Sinusoids(amplitude=[current, current, 0.0], frequency=0.02, phase=[0.0, 1.5, 0.0])
    force = Sinusoids(amplitude=[waves, waves, 0.2 * waves], frequency=0.8, phase=[0.0, 1.0, 2.0])
    plant: Any = cybership_ii()
    return Scenario(
        plant=plant,
        reference=Ellipse(axes=(5.0, 3.0), frequency=0.08),
        bounds=(
            Bounds(
                lower=Funnel(initial=-widest, final=-narrowest, rate=0.05),
                upper=Funnel(initial=widest, final=narrowest, rate=0.05),
            ),
            Bounds(lower=Constant([-0.2, -0.3, -0.5]), upper=Constant([0.8, 0.3, 0.5])),
        ),
        disturbance=Sum((Levels((drift,)), force)),
        controller=_law((0.2, 1.0), TransformedError(), TransformedError()),
        observer=_observer(0.5, 2.0),
        initial=Initial(q=[5.3, -0.3, 1.5], dq=0.0),
    )


def motor_driven_pendulum() -> Scenario:
    """A pendulum with a brush motor, of order 3, whose angle, velocity and motor torque are all
    bounded.

    The motor and the link are those of a one-link arm with J = 1.625e-3 kg m^2, m = 0.506 kg,
    M0 = 0.434 kg, L0 = 0.305 m, R0 = 0.023 m, B0 = 16.25e-3 N m s/rad, L = 25 mH, R = 5 ohm and
    Kt = Kb = 0.9 N m/A.  Bounds, disturbance and gains are ASSUMPTIONS of this package.  The
    disturbance is a torque on the pendulum, in its second level, which an observer estimates.

    Returns:
      A Scenario of order 3 with 1 component, for runs of 20 s at dt = 2e-3 s.

    Source: D. M. Dawson, J. Hu, T. C. Burg, Nonlinear Control of Electric Machinery, 1998 (arm and
      motor, as public programs quote them); otherwise this package.
    """
    rotor, link, load, length, radius = 1.625e-3, 0.506, 0.434, 0.305, 0.023
    inductance, resistance, motor_constant = 25e-3, 5.0, 0.9
    inertia = rotor + (link / 3.0 + load) * length**2 + 0.4 * load * radius**2
    plant: Any = DrivenPendulum(
        D=inertia,
        B=16.25e-3,
        N=9.81 * (0.5 * link + load) * length,
        M=inductance / motor_constant,
        H=resistance / motor_constant,
        Km=motor_constant,
    )
    return Scenario(
        plant=plant,
        reference=Sinusoid(offset=0.0, amplitude=1.0, frequency=1.5),
        bounds=(
            Bounds(
                lower=Constant(-1.15),
                upper=SinusoidalBound(offset=1.2, amplitude=0.05, frequency=0.5),
            ),
            _within(2.2),
            _within(2.6),
        ),
        disturbance=Levels((None, Sinusoids(amplitude=1.5, frequency=3.0))),
        controller=_law(
            (2.0, 15.0, 60.0), TransformedError(), TransformedError(), TransformedError()
        ),
        observer=_observer(0.0, 20.0, 0.0),
        initial=Initial(q=0.6, dq=0.0),
    )


def motor_driven_two_link() -> Scenario:
    """The paper's arm, reference, bounds and disturbance with an electric drive on each joint, with
    bounds on the velocities and on the currents.

    Both joints have the motor constants of `motor_driven_pendulum`, referred to the joint; that
    they drive this arm is an ASSUMPTION, as are the bounds of 1.5 rad/s, 16 A and 6 A.  The input
    is the voltage; the largest one is 39 V.

    Returns:
      A Scenario of order 3 with 2 joints, for runs of 20 s at dt = 1e-3 s.

    Source: Zhang & Yan 2024, section 4 (arm, reference, bounds, disturbance); Dawson, Hu and Burg
      1998 (motor).
    """
    paper = zhang_yan_2024(variant="corrected")
    plant: Any = ElectricDrive(
        robot=customary_two_link(),
        torque_constant=0.9,
        inductance=25e-3,
        resistance=5.0,
        back_emf=0.9,
    )
    return dataclasses.replace(
        paper,
        plant=plant,
        model=plant,
        bounds=(paper.bounds[0], _within(1.5), _within([16.0, 6.0])),
        controller=_law(
            (2.0, 10.0, 40.0), TransformedError(), TransformedError(), TransformedError()
        ),
        observer=Momentum(kf=20.0),
    )


def flexible_joint_two_link(*, stiffness: float = 300.0) -> Scenario:
    """The paper's arm, reference, bounds and disturbance with flexible joints, of order 4, with
    bounds on the velocities of links and motors.

    Stiffness, motor inertia (0.02 kg m^2), motor damping (0.1 N m s/rad) and the bounds of 1 rad/s
    and 2 rad/s are ASSUMPTIONS of this package.  The motor positions have no bounds.

    Args:
      stiffness: of both joints [N m/rad].

    Returns:
      A Scenario of order 4 with 2 joints, for runs of 20 s at dt = 5e-4 s.

    Source: Zhang & Yan 2024, section 4 (arm, reference, bounds, disturbance); otherwise this
      package.
    """
    paper = zhang_yan_2024(variant="corrected")
    plant: Any = FlexibleJoint(
        robot=customary_two_link(), stiffness=stiffness, motor_inertia=0.02, motor_damping=0.1
    )
    return dataclasses.replace(
        paper,
        plant=plant,
        model=plant,
        bounds=(paper.bounds[0], _within(1.0), None, _within(2.0)),
        controller=_law(
            (2.0, 10.0, 30.0, 60.0),
            TransformedError(),
            TransformedError(),
            Quadratic(),
            TransformedError(),
        ),
        observer=Momentum(kf=20.0),
    )


def flexible_joint_iiwa14() -> Scenario:
    """The motion of `iiwa14` with flexible joints, of order 4, without a payload.

    The manufacturer publishes neither the stiffness of the joints nor the inertia of the motors,
    and no measurement of an iiwa 14 is known to this package.  ASSUMPTIONS: the stiffness is that
    of a public simulation (18,000 to 3,000 N m/rad, chosen by its author), the motor inertia is
    that of the LWR 4+, a smaller arm (3.19 to 0.39 kg m^2 on the side of the links), and the motor
    damping is 10 N m s/rad.  The speed limits of the arm are the bounds of the velocities of the
    links; runs record their margins, and the law, which is slow against them, has no barrier there.

    Returns:
      A Scenario of order 4 with 7 joints, for runs of 10 s at dt = 5e-4 s.

    Source: arm as `iblf_jax.presets.arms.arm` says; A. Jubien, M. Gautier, A. Janot, IFAC
      Proceedings Volumes 47 (2014) 8391-8396 (motor inertia of the LWR 4+); otherwise this
      package.
    """
    rigid = iiwa14(payload=0.0)
    arm = rigid.model
    plant: Any = FlexibleJoint(
        robot=arm,
        stiffness=[18e3, 16e3, 12e3, 9e3, 6e3, 4e3, 3e3],
        motor_inertia=[3.19, 3.05, 1.98, 2.05, 0.787, 0.391, 0.394],
        motor_damping=10.0,
    )
    return dataclasses.replace(
        rigid,
        plant=plant,
        model=plant,
        bounds=(rigid.bounds[0], from_speed_limits(arm)),
        controller=_law((2.0, 8.0, 20.0, 50.0), TransformedError()),
        observer=Momentum(kf=40.0),
        initial=Initial(q=np.asarray(rigid.initial.q) + 0.07),
    )
