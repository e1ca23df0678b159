"""Scenarios that are ready to run, each with its source.  `PRESETS` names them for the command
line.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from iblf_jax.control.controllers import LAWS as LAWS
from iblf_jax.control.controllers import FullState, Saturated, law_by_name
from iblf_jax.control.controllers.systems import observer_of
from iblf_jax.control.observers import Momentum, Printed
from iblf_jax.core import checks
from iblf_jax.presets.arms import arm as arm
from iblf_jax.presets.arms import arm_scenario as arm_scenario
from iblf_jax.presets.arms import iiwa14 as iiwa14
from iblf_jax.presets.arms import ur5 as ur5
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Initial, Scenario
from iblf_jax.world import bounds as bounds_
from iblf_jax.world import disturbances, references
from iblf_jax.world.robots import TwoLink


def customary_two_link() -> TwoLink:
    """The two-link arm of this literature.

    The paper prints no parameters and refers to others; these are the customary ones and an
    ASSUMPTION of this package: m = (2, 0.85) kg, l = (0.35, 0.31) m, lc = l/2, I = m l^2/4, g =
      9.81 m/s^2.
    """
    mass, length = np.array([2.0, 0.85]), np.array([0.35, 0.31])
    return TwoLink(mass=mass, length=length, centre=length / 2, inertia=mass * length**2 / 4)


def zhang_yan_2024(*, law: str = "integral", reading: str = "printed", p: int = 1) -> Scenario:
    """The paper's simulation, section 4.
    (4.1)-(4.3)

    Args:
      law: "integral" (the paper's), "log" (its comparison), or any other of `LAWS`: the systems
        that the paper names, at the same gains k1, K2 and o, and the yardsticks "computed_torque"
        and "pd" at their own.  "backstepping" is the unconstrained one; "adaptive_rbf" and "pd" run
        without an observer.  Of `controllers.KEEPERS` those that need no bounds on velocities.
      reading: "printed", or "corrected" (law with C0 alpha, observer in momentum form), for which
        Theorem 2 is exact.
      p: exponent of the logarithmic barrier.

    Returns:
      A Scenario of 2 joints; the paper runs it for 20 s.

    Raises:
      ValueError: an unknown law or reading.

    Source: Zhang & Yan 2024, section 4; the arm's parameters are an assumption, see
      `customary_two_link`.
    """
    checks.one_of("reading", reading, ("printed", "corrected"))
    controller = law_by_name(law, k1=2.0, K2=20.0, o=0.1, reading=reading, p=p)
    cosine = math.pi / 2
    return Scenario(
        plant=customary_two_link(),
        reference=references.Sinusoid(
            offset=0.5, amplitude=0.14, frequency=1.0, phase=[0.0, cosine]
        ),
        bounds=bounds_.Bounds(
            lower=bounds_.Sinusoid(offset=0.2, amplitude=0.14, frequency=1.0, phase=[cosine, 0.0]),
            upper=bounds_.Sinusoid(offset=0.9, amplitude=0.14, frequency=1.0, phase=[cosine, 0.0]),
        ),
        disturbance=disturbances.ModelShaped(
            acceleration_amplitude=0.3,
            acceleration_frequency=1.0,
            acceleration_phase=[0.0, cosine],
            velocity_amplitude=0.3,
            velocity_frequency=0.5,
            velocity_phase=[cosine, 0.0],
        ),
        controller=controller,
        observer=observer_of(law, (Printed if reading == "printed" else Momentum)(kf=20.0)),
        initial=Initial(q=0.8, dq=0.0),
    )


def printed_gap(*, reading: str = "printed") -> Scenario:
    """A start at which the law as printed breaks its own inequality, and the corrected one keeps
    it.                (3.18), (3.20)

    The paper's arm, reference and bounds without disturbance, so that V2 should fall at once.  The
    gains are inside (3.17) and (3.25), near their lower limits; the joints move fast, 4 rad/s.
    There the terms that the printed proof drops outweigh what it leaves, and V2 grows.  Found by
    `certificates.counterexample` with |dq| <= 4 rad/s, K2 >= 0.6, 1.1 <= kf <= 40, and rounded;
    f_hat(0) = (-0.5, 1.4) N m.

    Args:
      reading: "printed" or "corrected"; the same gains and the same start, f_hat(0) included.

    Returns:
      A Scenario of 2 joints; the first 0.1 s tell the difference.

    Raises:
      ValueError: an unknown reading.
    """
    return with_parameters(
        zhang_yan_2024(reading=reading),
        {
            "disturbance.acceleration_amplitude": 0.0,
            "disturbance.velocity_amplitude": 0.0,
            "controller.K2": 0.6,
            "observer.kf": [40.0, 1.1],
            "observer.eta0": [65.0, 1.9],
            "initial.q": [0.68, 0.75],
            "initial.dq": [-4.0, -4.0],
        },
    )


def zhang_yan_2024_saturated(
    *,
    law: str = "integral",
    reading: str = "corrected",
    limit: float | tuple[float, ...] = (7.2, 1.5),
    edge: str = "hard",
) -> Scenario:
    """The paper's simulation with a torque limit below the peak that the law asks for (13.8, 16.3 N
    m).

    The limit is above what gravity and the motion need: the bounds are kept, the error converges as
      before and the estimate is as
    good.  But while the torque is cut, at the start, the inequality of Theorem 2 fails and the
    envelope (3.28) claims nothing. Below gravity, at (6, 2) N m, the arm falls through its bound.

    Args:
      law, reading: as `zhang_yan_2024`.
      limit: largest torque, one number or one a joint [N m].
      edge: "hard", or "smooth" for gradients.

    Raises:
      ValueError: an unknown law, reading or edge; a limit that is not positive.

    Source: this package; the paper leaves saturation to future work.
    """
    scenario = zhang_yan_2024(law=law, reading=reading)
    return dataclasses.replace(
        scenario, controller=Saturated(law=scenario.controller, limit=limit, edge=edge)
    )


def zhang_yan_2024_funnel(
    *, law: str = "prescribed_performance", reading: str = "corrected"
) -> Scenario:
    """The paper's arm, reference and disturbance with prescribed performance: funnels inside the
    paper's bounds.

        q_d - r_l(t) < q < q_d + r_u(t),   r(t) = (r0 - 0.05) exp(-2 t) + 0.05

    with r0 = (0.5, 0.25) rad above and (0.15, 0.4) rad below: from 1 s on the error must be within
    0.12 rad, in the end within 0.05 rad.

    Args:
      law, reading: as `zhang_yan_2024`.

    Raises:
      ValueError: an unknown law or reading.

    Source: Zhang & Yan 2024, section 4, with a funnel as in its references [10, 11]; the funnel's
      numbers are this package's.
    """
    scenario = zhang_yan_2024(law=law, reading=reading)
    lower = bounds_.Funnel(initial=[-0.15, -0.4], final=-0.05, rate=2.0)
    upper = bounds_.Funnel(initial=[0.5, 0.25], final=0.05, rate=2.0)
    return dataclasses.replace(scenario, bounds=bounds_.Bounds(lower=lower, upper=upper))


def zhang_yan_2024_full_state(*, kf: float = 100.0, c: float = 8.0) -> Scenario:
    """The paper's arm, reference, bounds and disturbance with bounds on the velocities too, and the
    law that keeps both.

        -1.6 - 0.1 sin t < q1' < 0.6 + 0.1 cos t,   -1.4 < q2' < 0.5   [rad/s]

    `controllers.FullState` with k1 = 2, K2 = 20 1/s, o = 0.1 and the momentum observer.  The claim
    of case 2 needs c > 6.5 with kf = 100, and c > 33 with the paper's kf = 20.

    Args:
      kf: gain of the observer [1/s].
      c: as `FullState.c` [rad^2/s^3].

    Raises:
      ValueError: a gain that is not positive.

    Source: this package.
    """
    scenario, cosine = zhang_yan_2024(reading="corrected"), 0.5 * math.pi
    lower = bounds_.Sinusoid(offset=[-1.6, -1.4], amplitude=[-0.1, 0.0])
    upper = bounds_.Sinusoid(offset=[0.6, 0.5], amplitude=[0.1, 0.0], phase=cosine)
    law = FullState(k1=2.0, K2=20.0, c=c, o=0.1)
    speeds = bounds_.Bounds(lower=lower, upper=upper)
    return dataclasses.replace(
        scenario, controller=law, observer=Momentum(kf=kf), velocity_bounds=speeds
    )


PRESETS: dict[str, Callable[..., Scenario]] = {
    "zhang_yan_2024": zhang_yan_2024,
    "printed_gap": printed_gap,
    "zhang_yan_2024_saturated": zhang_yan_2024_saturated,
    "zhang_yan_2024_funnel": zhang_yan_2024_funnel,
    "zhang_yan_2024_full_state": zhang_yan_2024_full_state,
    "ur5": ur5,
    "iiwa14": iiwa14,
}
"""Every preset by name."""
