"""A scenario for every member of every family: the member in a loop into which it fits."""

import dataclasses
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax.numpy as jnp
import members

import iblf_jax as ij

# Each is made where a test needs it: most default tests need one of them or none, and every worker
# collects all tests.
paper = cache(partial(ij.presets.zhang_yan_2024, variant="corrected"))
chain = cache(ij.presets.motor_driven_two_link)
flexible = cache(ij.presets.flexible_joint_two_link)
vessel = cache(ij.presets.vessel)
LAW = partial(ij.controllers.Backstepping, k1=2.0, K2=20.0)
SAMPLING = ij.Sampling(period=2e-3)
WIDE = ij.Bounds(lower=ij.bounds.Constant(-4.0), upper=ij.bounds.Constant(4.0))
FAR = ij.Bounds(lower=ij.bounds.Constant(-20.0), upper=ij.bounds.Constant(20.0))


def with_velocity_bounds(law: Any) -> ij.Scenario:
    return ij.with_parts(paper(), controller=law, bounds=(paper().bounds[0], WIDE))


def inside(plant: Any, controller: Any, initial: ij.Initial) -> ij.Scenario:
    """A loop whose bounds are 0 and 1."""
    return ij.Scenario(
        plant=plant,
        reference=ij.references.Sinusoid(offset=0.5, amplitude=0.1, frequency=1.0, phase=0.0),
        bounds=ij.Bounds(lower=ij.bounds.Constant(0.0), upper=ij.bounds.Constant(1.0)),
        controller=controller,
        initial=initial,
    )


def of_robot(robot: Any) -> ij.Scenario:
    initial = ij.Initial(q=jnp.full(robot.n, 0.45), dq=jnp.zeros(robot.n))
    return inside(robot, LAW(), initial)


def of_plant(plant: Any) -> ij.Scenario:
    law = ij.controllers.BarrierBackstepping(k=(2.0,) * plant.order)
    return inside(plant, law, ij.Initial(x=jnp.zeros((plant.order, plant.n)).at[0].set(0.45)))


FITTING: dict[str, Callable[[Any], ij.Scenario]] = {
    "robot": of_robot,
    "plant": of_plant,
    "reference": lambda part: ij.with_parts(paper(), reference=part, bounds=WIDE),
    "side": lambda part: ij.with_parts(
        of_robot(members.TWO_LINK), bounds=ij.Bounds(lower=ij.bounds.Constant(0.0), upper=part)
    ),
    "region": lambda part: ij.with_parts(paper(), regions=(part,)),
    "disturbance": lambda part: ij.with_parts(paper(), disturbance=part),
    "process_noise": lambda part: ij.with_parts(chain(), process_noise=part),
    "barrier": lambda part: ij.with_parts(paper(), controller=LAW(barrier=part)),
    "decay": lambda part: ij.with_parts(
        paper(), controller=LAW(barrier=ij.barriers.TransformedError(), decays=(part, part))
    ),
    "observer": lambda part: ij.with_parts(paper(), observer=part),
    "sensor": lambda part: ij.with_parts(paper(), sensor=part, sampling=SAMPLING),
    "actuator": lambda part: ij.with_parts(paper(), actuator=part),
    "law": lambda part: ij.with_parts(paper(), controller=part),
}


def sampled(scenario: ij.Scenario, **parts: Any) -> ij.Scenario:
    return ij.with_parts(scenario, sampling=SAMPLING, **parts)


def estimated(part: Any) -> ij.Scenario:
    """A robot whose velocity is not measured."""
    observer = ij.observers.StateObserver(bandwidth=40.0, measured=(1,))
    law = ij.controllers.BarrierBackstepping(k=(2.0, 20.0))
    return sampled(paper(), sensor=part, observer=observer, controller=law)


def in_space(region: Any) -> ij.Scenario:
    return ij.with_parts(of_robot(members.ROBOTS["arm"]), regions=(region,))


SPECIAL: dict[str, Callable[[Any], ij.Scenario]] = {
    "plant neighbour_model": lambda part: ij.with_parts(
        of_plant(members.PAIR),
        model=part,
        controller=ij.controllers.BarrierBackstepping(k=(2.0, 2.0), filter=0.01),
    ),
    "reference ellipse": lambda part: ij.with_parts(vessel(), reference=part, bounds=FAR),
    "region half_space_of_the_elbow": lambda part: in_space(dataclasses.replace(part, offset=-2.0)),
    "region sphere_inside": in_space,
    "observer level": lambda part: ij.with_parts(chain(), observer=part),
    "observer state_observer": lambda part: ij.with_parts(flexible(), observer=part),
    "observer state_observer_two_encoders": lambda part: ij.with_parts(flexible(), observer=part),
    "sensor levels": lambda part: sampled(chain(), sensor=part),
    "sensor levels_encoders": lambda part: sampled(flexible(), sensor=part),
    "sensor levels_unmeasured": estimated,
    "law barrier_backstepping_velocities": with_velocity_bounds,
    "law barrier_backstepping_mixed": with_velocity_bounds,
    "law with_drive": lambda part: ij.with_parts(chain(), controller=part, model=part.drive.robot),
}
"""Members that fit into a loop of their own."""


def scenarios() -> dict[str, Callable[[], ij.Scenario]]:
    return {
        f"{family} {name}": partial(SPECIAL.get(f"{family} {name}", make), part)
        for family, make in FITTING.items()
        for name, part in members.FAMILIES[family][0].items()
    }
