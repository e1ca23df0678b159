"""A pendulum with the paper's reference and bounds of its first joint."""

import math

import iblf_jax as ij

MASS = "plant.mass"


def pendulum(*, K2=3.0, kf=100.0, **parts) -> ij.Scenario:
    robot = ij.robots.PlanarChain(mass=[2.0], length=0.35, centre=0.175, inertia=0.06)
    wave = {"amplitude": [0.14], "frequency": 1.0}
    side = {"phase": [0.5 * math.pi], **wave}
    scenario = ij.Scenario(
        plant=robot,
        reference=ij.references.Sinusoid(offset=[0.5], phase=[0.0], **wave),
        bounds=ij.Bounds(
            lower=ij.bounds.Sinusoid(offset=[0.2], **side),
            upper=ij.bounds.Sinusoid(offset=[0.9], **side),
        ),
        controller=ij.controllers.Backstepping(k1=2.0, K2=[K2], o=0.1, variant="corrected"),
        observer=ij.observers.Momentum(kf=[kf]),
        initial=ij.Initial(q=[0.8], dq=[0.0]),
    )
    return ij.with_parts(scenario, **parts) if parts else scenario


def within(percent: float) -> dict:
    share = percent / 100.0
    return {MASS: ij.factor(ij.interval(1.0 - share, 1.0 + share))}
