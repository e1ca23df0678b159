"""Scenarios that are ready to run, each with its source.  `PRESETS` names them for the command line."""

from __future__ import annotations

import math

import numpy as np

from iblf_jax import bounds as bounds_
from iblf_jax import checks, disturbances, references
from iblf_jax.barriers import Integral, Log
from iblf_jax.controllers import Backstepping
from iblf_jax.observers import Momentum, Printed
from iblf_jax.robots import TwoLink
from iblf_jax.scenario import Initial, Scenario


def customary_two_link() -> TwoLink:
    """The two-link arm of this literature.

    The paper prints no parameters and refers to others; these are the customary ones and an ASSUMPTION of this package:
    m = (2, 0.85) kg, l = (0.35, 0.31) m, lc = l/2, I = m l^2/4, g = 9.81 m/s^2.
    """
    mass, length = np.array([2.0, 0.85]), np.array([0.35, 0.31])
    return TwoLink(mass=mass, length=length, centre=length / 2, inertia=mass * length**2 / 4)


def zhang_yan_2024(*, law: str = "integral", reading: str = "printed", p: int = 1) -> Scenario:
    """The paper's simulation, section 4.                                                                 (4.1)-(4.3)

    Args:
      law: "integral" (the paper's) or "log" (its comparison).
      reading: "printed", or "corrected" (law with C0 alpha, observer in momentum form), for which Theorem 2 is exact.
      p: exponent of the logarithmic barrier.

    Returns:
      A Scenario of 2 joints; the paper runs it for 20 s.

    Raises:
      ValueError: an unknown law or reading.

    Source: Zhang & Yan 2024, section 4; the arm's parameters are an assumption, see `customary_two_link`.
    """
    checks.one_of("law", law, ("integral", "log"))
    checks.one_of("reading", reading, ("printed", "corrected"))
    barrier = Integral() if law == "integral" else Log(p=p)
    cosine = math.pi / 2
    return Scenario(
        plant=customary_two_link(),
        reference=references.Sinusoid(offset=0.5, amplitude=0.14, frequency=1.0, phase=[0.0, cosine]),
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
        controller=Backstepping(k1=2.0, K2=20.0, o=0.1, barrier=barrier, reading=reading),
        observer=(Printed if reading == "printed" else Momentum)(kf=20.0),
        initial=Initial(q=0.8, dq=0.0),
    )


PRESETS = {"zhang_yan_2024": zhang_yan_2024}
"""Every preset by name."""
