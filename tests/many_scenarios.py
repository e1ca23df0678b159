"""Scenarios of one joint that all differ in their structure, and so in their programs."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import jax

import iblf_jax as ij
from iblf_jax.core.programs import COMPILE_EVENT

CHAIN = ij.robots.PlanarChain(mass=[1.0], length=[0.4], centre=[0.2], inertia=[0.02])
REFERENCES = tuple(
    ij.references.WaypointSpline(
        times=tuple(range(points)), waypoints=[[0.1 + 0.05 * (i % 2)] for i in range(points)]
    )
    for points in range(2, 10)
)
BARRIERS = (
    ij.barriers.Log(),
    ij.barriers.Log(p=2),
    ij.barriers.Tan(),
    ij.barriers.TransformedError(),
    ij.barriers.Integral(),
    ij.barriers.PrescribedPerformance(),
)
LAWS = (
    *(ij.controllers.Backstepping(k1=2.0, K2=20.0, barrier=barrier) for barrier in BARRIERS),
    ij.controllers.PDGravity(Kp=60.0, Kd=20.0),
    ij.controllers.ComputedTorque(Kp=25.0, Kd=10.0),
)
OBSERVERS = (ij.observers.NoObserver(), ij.observers.Momentum(kf=20.0))
DISTURBANCES = (
    ij.disturbances.Nothing(),
    ij.disturbances.Step(size=[0.1], time=5.0),
    ij.disturbances.Sinusoids(amplitude=[0.1], frequency=3.0, phase=[0.0], offset=0.0),
    ij.disturbances.Friction(viscous=[0.1], coulomb=0.1, width=0.05),
)


def scenarios() -> Iterator[ij.Scenario]:
    """512 of them."""
    bounds = ij.Bounds(lower=ij.bounds.Constant(-0.9), upper=ij.bounds.Constant(0.9))
    for law, observer, disturbance, reference in itertools.product(
        LAWS, OBSERVERS, DISTURBANCES, REFERENCES
    ):
        yield ij.Scenario(
            plant=CHAIN,
            reference=reference,
            bounds=bounds,
            controller=law,
            observer=observer,
            disturbance=disturbance,
            initial=ij.Initial(q=[0.1], dq=[0.0]),
        )


class CompileCounter:
    """Counts the programs that JAX compiles, while it is a context manager."""

    def __enter__(self) -> CompileCounter:
        self.count = 0
        jax.monitoring.register_event_duration_secs_listener(self._listen)
        return self

    def __exit__(self, *_: object) -> None:
        jax.monitoring.unregister_event_duration_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **_: str | int) -> None:
        self.count += event == COMPILE_EVENT
