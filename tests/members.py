"""One instance, or a few, of every member of every family: the contract tests run over these lists.

Whoever adds a member adds it here; `test_contracts.test_every_member_is_listed` notices if not.
"""

from __future__ import annotations

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers, disturbances, metrics, observers, references, robots

TWO_LINK = ij.presets.customary_two_link()

ROBOTS = {
    "two_link": TWO_LINK,
    "two_link_payload": robots.TwoLink(mass=[1.0, 2.0], length=[0.5, 0.4], centre=[0.2, 0.3], inertia=[0.02, 0.01], payload=0.7, g=1.62),
    "chain_1": robots.PlanarChain(mass=[1.3], length=[0.4], centre=[0.2], inertia=[0.02]),
    "chain_3": robots.PlanarChain(mass=[2.0, 1.0, 0.5], length=[0.4, 0.3, 0.2], centre=[0.2, 0.15, 0.1], inertia=0.01, payload=0.3),
}

REFERENCES = {
    "sinusoid": references.Sinusoid(offset=0.5, amplitude=[0.14, 0.1], frequency=1.0, phase=[0.0, 1.57]),
    "quintic": references.Quintic(start=[0.1, 0.2], end=[0.8, -0.3], duration=3.0),
    "waypoint_spline": references.WaypointSpline(times=(0.0, 1.0, 2.5, 4.0), waypoints=[[0.0, 0.1], [0.4, 0.3], [0.2, 0.8], [0.5, 0.5]]),
}

SIDES = {
    "constant": bounds.Constant([0.9, 1.2]),
    "sinusoid": bounds.Sinusoid(offset=[0.9, 0.8], amplitude=0.14, frequency=1.0, phase=[1.57, 0.0]),
    "funnel": bounds.Funnel(initial=0.5, final=[0.1, 0.2], rate=1.5),
}

DISTURBANCES = {
    "nothing": disturbances.Nothing(),
    "model_shaped": ij.presets.zhang_yan_2024().disturbance,
    "sinusoids": disturbances.Sinusoids(amplitude=[1.0, 2.0], frequency=3.0, phase=[0.0, 0.4], offset=0.2),
    "step": disturbances.Step(size=[1.0, -0.5], time=5.0),
    "tip_force": disturbances.TipForce(amplitude=[1.0, 2.0], frequency=[1.0, 0.5], phase=0.3, offset=[0.0, -1.0]),
    "friction": disturbances.Friction(viscous=[0.1, 0.2], coulomb=0.3, width=0.05),
    "sum": disturbances.Sum((disturbances.Friction(viscous=0.1), disturbances.Step(size=1.0, time=2.0))),
    "sum_of_none": disturbances.Sum(()),
}

BARRIERS = {
    "integral": barriers.Integral(),
    "integral_wide_guard": barriers.Integral(guard=0.05),
    "log": barriers.Log(),
    "log_p3": barriers.Log(p=3),
}

OBSERVERS = {
    "none": observers.NoObserver(),
    "printed": observers.Printed(kf=[20.0, 10.0]),
    "printed_matched": observers.Printed(kf=20.0, eta0=[0.1, -0.2], start="matched"),
    "momentum": observers.Momentum(kf=[20.0, 10.0]),
}

LAWS = {
    "backstepping": controllers.Backstepping(k1=2.0, K2=20.0, o=0.1),
    "backstepping_corrected_log": controllers.Backstepping(k1=[2.0, 3.0], K2=20.0, o=0.1, barrier=barriers.Log(p=2), reading="corrected"),
}

FOLDS = {type(fold).__name__: fold for fold in metrics.standard()}

FAMILIES = {
    "robot": (ROBOTS, robots.MEMBERS, ij.testing.check_robot),
    "reference": (REFERENCES, references.MEMBERS, ij.testing.check_reference),
    "side": (SIDES, bounds.MEMBERS, ij.testing.check_side),
    "disturbance": (DISTURBANCES, disturbances.MEMBERS, ij.testing.check_disturbance),
    "barrier": (BARRIERS, barriers.MEMBERS, ij.testing.check_barrier),
    "observer": (OBSERVERS, observers.MEMBERS, ij.testing.check_observer),
    "law": (LAWS, controllers.MEMBERS, ij.testing.check_law),
    "fold": (FOLDS, {type(fold).__name__: type(fold) for fold in metrics.standard()}, ij.testing.check_fold),
}
"""Family -> (instances by name, the package's registry, the checker)."""
