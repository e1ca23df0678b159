"""Warnings about a scenario: those of its parts, and of parts that hardly fit together."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from iblf_jax.core.pytree import layers
from iblf_jax.simulation.measurement_noise import noise_advice
from iblf_jax.world import plants
from iblf_jax.world.robots import WithMotors
from iblf_jax.world.robots._base import mass_matrix_at

if TYPE_CHECKING:
    from iblf_jax.simulation.scenario import Scenario


def advice_of(scenario: Scenario) -> list[str]:
    """The warnings of the parts about their parameter values."""
    advice = scenario.controller.advice()
    if all(part.uses_observer for part in layers(scenario.controller)):
        advice = advice + scenario.observer.advice()
    advice = advice + motors_advice(scenario)
    if scenario.sampling is not None:
        advice = advice + scenario.sensor.advice(scenario.sampling.period)
        advice = advice + noise_advice(scenario)
    return advice


def motors_advice(scenario: Scenario) -> list[str]:
    """A warning about a robot as the model of a flexible joint whose inertia lacks that of the
    motors.
    """
    plant, model = scenario.plant, scenario.model
    if not isinstance(plant, plants.FlexibleJoint) or not model.is_robot:
        return []
    if isinstance(model, WithMotors):
        return []
    q = scenario.initial.q
    links, known = (np.diag(mass_matrix_at(robot, q)) for robot in (plant.robot, model))
    inertia = np.asarray(plant.motor_inertia)
    share = float(np.min((known - links) / inertia))
    if share > LEAST_SHARE_OF_MOTORS:
        return []
    return [
        f"model: the inertia of this robot contains {max(share, 0.0):.0%} of that of the motors"
        f" (plant.motor_inertia = {inertia} kg m^2), although a law of robots commands their"
        " torque. Take model=plant.rigid(), whose inertia is M + diag(J)."
    ]


LEAST_SHARE_OF_MOTORS = 0.5
"""Share of the inertia of a motor below which a model counts as one of the links alone.  A robot
may contain that inertia in other ways than `WithMotors`, such as the armature of an `Arm`."""
