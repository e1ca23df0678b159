"""Scenarios on the two-link arm of the paper, each with its source."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from iblf_jax.control.barriers import Integral
from iblf_jax.control.controllers import BarrierBackstepping, Saturated, law_by_name
from iblf_jax.control.controllers.systems import observer_of
from iblf_jax.control.observers import Momentum
from iblf_jax.core import checks
from iblf_jax.presets.arms import OBSERVERS
from iblf_jax.simulation.initial import Initial
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world import disturbances, references
from iblf_jax.world.bounds import Bounds, Funnel
from iblf_jax.world.bounds import Sinusoid as SinusoidalBound
from iblf_jax.world.robots import TwoLink


def customary_two_link() -> TwoLink:
    """The two-link arm with the customary parameters of the literature.

    The paper prints no parameters and refers to other work.  The parameters are an ASSUMPTION of
    this package: m = (2, 0.85) kg, l = (0.35, 0.31) m, lc = l/2, I = m l^2/4, g = 9.81 m/s^2.
    """
    mass, length = np.array([2.0, 0.85]), np.array([0.35, 0.31])
    return TwoLink(mass=mass, length=length, centre=length / 2, inertia=mass * length**2 / 4)


@checks.known_keywords
def zhang_yan_2024(*, law: str = "integral", variant: str = "printed", p: int = 1) -> Scenario:
    """The simulation of the paper's section 4, equations (4.1) to (4.3).

    Args:
      law: "integral" (the paper's law), "log" (its comparison), or another one of `LAWS`: the laws
        that the paper names, at the same gains k1, K2 and o, and the baselines "computed_torque"
        and "pd" at their own gains.  "backstepping" has no constraints; "adaptive_rbf" and "pd" run
        without an observer.  A law of `controllers.KEEPERS` must not need bounds on velocities.
      variant: "printed", or "corrected" (law with C0 alpha, observer in momentum form), for which
        Theorem 2 is exact.
      p: exponent of the logarithmic barrier.

    Returns:
      A Scenario of 2 joints; the paper runs it for 20 s.

    Raises:
      ValueError: an unknown law or variant.

    Source: Zhang & Yan 2024, section 4; the arm's parameters are an assumption, see
      `customary_two_link`.
    """
    checks.one_of("variant", variant, tuple(OBSERVERS))
    cosine = math.pi / 2
    wave = {"amplitude": 0.14, "frequency": 1.0}
    return Scenario(
        plant=customary_two_link(),
        reference=references.Sinusoid(offset=0.5, phase=[0.0, cosine], **wave),
        bounds=Bounds(
            lower=SinusoidalBound(offset=0.2, phase=[cosine, 0.0], **wave),
            upper=SinusoidalBound(offset=0.9, phase=[cosine, 0.0], **wave),
        ),
        disturbance=disturbances.ModelShaped(
            acceleration_amplitude=0.3,
            acceleration_frequency=1.0,
            acceleration_phase=[0.0, cosine],
            velocity_amplitude=0.3,
            velocity_frequency=0.5,
            velocity_phase=[cosine, 0.0],
        ),
        controller=law_by_name(law, k1=2.0, K2=20.0, o=0.1, variant=variant, p=p),
        observer=observer_of(law, OBSERVERS[variant](kf=20.0)),
        initial=Initial(q=0.8, dq=0.0),
    )


def printed_gap(*, variant: str = "printed") -> Scenario:
    """An initial state at which the law as printed violates the inequality (3.18), (3.20), and the
    corrected law satisfies it.

    The arm, the reference and the bounds are the paper's, without disturbance, so that V2 should
    decrease from the start.  The gains satisfy (3.17) and (3.25) near their lower limits, and the
    joints start at 4 rad/s.  There the terms that the printed proof drops exceed the terms that it
    keeps, and V2 grows.  The state was found by `certificates.counterexample` with |dq| <= 4 rad/s,
    K2 >= 0.6, 1.1 <= kf <= 40, and rounded; f_hat(0) = (-0.5, 1.4) N m.

    Args:
      variant: "printed" or "corrected"; gains and initial state, including f_hat(0), are the same.

    Returns:
      A Scenario of 2 joints; the variants differ in the first 0.1 s.

    Raises:
      ValueError: an unknown variant.

    Source: this package.
    """
    return with_parameters(
        zhang_yan_2024(variant=variant),
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


@checks.known_keywords
def zhang_yan_2024_saturated(
    *,
    law: str = "integral",
    variant: str = "corrected",
    limit: float | tuple[float, ...] = (7.2, 1.5),
    edge: str = "hard",
) -> Scenario:
    """The paper's simulation with a torque limit below the peak of the law's torque, (13.8, 16.3)
    N m.

    The limit is above the torque that gravity and the motion need: the bounds hold, the error
    converges as before, and the estimate is as accurate.  While the torque saturates at the start,
    the inequality of Theorem 2 fails and the envelope (3.28) claims nothing.  At a limit below
    gravity, (6, 2) N m, the arm violates its bounds.

    Args:
      law, variant: as for `zhang_yan_2024`.
      limit: largest torque, one number or one per joint [N m].
      edge: "hard", or "smooth" for gradients.

    Raises:
      ValueError: an unknown law, variant or edge; a limit that is not positive.

    Source: this package; the paper leaves saturation to future work.
    """
    scenario = zhang_yan_2024(law=law, variant=variant)
    return dataclasses.replace(
        scenario, controller=Saturated(law=scenario.controller, limit=limit, edge=edge)
    )


@checks.known_keywords
def zhang_yan_2024_funnel(
    *, law: str = "prescribed_performance", variant: str = "corrected"
) -> Scenario:
    """The paper's arm, reference and disturbance with prescribed performance: funnels inside the
    paper's bounds.

        q_d - r_l(t) < q < q_d + r_u(t),   r(t) = (r0 - 0.05) exp(-2 t) + 0.05

    with r0 = (0.5, 0.25) rad above and (0.15, 0.4) rad below.  The error must be within 0.12 rad
    from 1 s on, and finally within 0.05 rad.

    Args:
      law, variant: as for `zhang_yan_2024`.

    Raises:
      ValueError: an unknown law or variant.

    Source: Zhang & Yan 2024, section 4, with a funnel as in its references [10, 11]; the funnel's
      numbers are this package's.
    """
    scenario = zhang_yan_2024(law=law, variant=variant)
    lower = Funnel(initial=[-0.15, -0.4], final=-0.05, rate=2.0)
    upper = Funnel(initial=[0.5, 0.25], final=0.05, rate=2.0)
    return dataclasses.replace(scenario, bounds=Bounds(lower=lower, upper=upper))


@checks.known_keywords
def zhang_yan_2024_full_state(*, kf: float = 100.0, c: float = 8.0) -> Scenario:
    """The paper's arm, reference, bounds and disturbance with additional bounds on the velocities,
    and a law that satisfies both.

        -1.6 - 0.1 sin t < q1' < 0.6 + 0.1 cos t,   -1.4 < q2' < 0.5   [rad/s]

    The law is `controllers.BarrierBackstepping` with integral barriers, k = (2, 20) 1/s, weights
    of 1, o = 0.1 and the momentum observer.  The claim of case 2 needs c > 6.5 with kf = 100, and
    c > 33 with the paper's kf = 20.

    Args:
      kf: gain of the observer [1/s].
      c: of the second level [rad^2/s^3].

    Raises:
      ValueError: a gain that is not positive.

    Source: this package.
    """
    lower = SinusoidalBound(offset=[-1.6, -1.4], amplitude=[-0.1, 0.0])
    upper = SinusoidalBound(offset=[0.6, 0.5], amplitude=[0.1, 0.0], phase=0.5 * math.pi)
    paper = zhang_yan_2024(variant="corrected")
    return dataclasses.replace(
        paper,
        controller=BarrierBackstepping(
            k=(2.0, 20.0), barriers=(Integral(), Integral()), c=(0.0, c), weights=1.0, o=0.1
        ),
        observer=Momentum(kf=kf),
        bounds=(paper.bounds[0], Bounds(lower=lower, upper=upper)),
    )
