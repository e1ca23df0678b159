"""Units of the quantities of a scenario: those of its plant."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from iblf_jax.core.pytree import layers
from iblf_jax.core.status import WORDS, WORDS_OF_LEVELS, Status
from iblf_jax.core.units import ROBOT, Unit, as_text, of_component, resolved
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import SIGNALS
from iblf_jax.world import plants


def symbols_of(scenario: Any) -> Mapping[str, Unit]:
    """The unit of each symbol of `core.units` in a scenario; those of a robot for another
    component.
    """
    if not isinstance(scenario, Scenario):
        return ROBOT
    found = dict(plants.unit_symbols(scenario.plant, scenario.model))
    for law in layers(scenario.controller):
        found |= law.unit_symbols(scenario.model)
    return found


def unit_text(scenario: Scenario, unit: Unit, component: int | None = None) -> str:
    """A unit as tables and axes show it for a scenario.

    Args:
      scenario: any.
      unit: a text, or a `PlantUnit`.
      component: one component of a level; None for all of them.
    """
    found = resolved(unit, symbols_of(scenario))
    if component is not None:
        found = of_component(found, component)
    return as_text(found)


def signal_unit(scenario: Scenario, name: str, component: int | None = None) -> str:
    """The unit of a recorded signal in runs of a scenario; arguments as `unit_text`."""
    return unit_text(scenario, SIGNALS[name].unit, component)


def status_words(scenario: Scenario) -> Mapping[Status, str]:
    """The text of each status flag for runs of a scenario."""
    return WORDS if scenario.plant.is_robot else WORDS_OF_LEVELS


def signal_meanings(scenario: Scenario) -> dict[str, str]:
    """What each recorded signal is in runs of a scenario: name -> words."""
    found = {name: signal.meaning for name, signal in SIGNALS.items()}
    plant = scenario.plant
    if plant.is_robot:
        return found
    first, second, *_ = plants.level_names(plant)
    found |= {
        "q": first,
        "dq": second,
        "tau": f"input: {plants.input_name(plant)}",
        "e1": f"error of {first}, x_1 - x_d",
        "e2": f"error of {second}, x_2 - alpha_1",
        "q_d": f"reference of {first}",
        "dq_d": f"rate of the reference of {first}",
        "lower": f"lower bound of {first}",
        "upper": f"upper bound of {first}",
        "alpha": f"virtual control alpha_1 of {second}",
        "dq_lower": f"lower bound of {second}",
        "dq_upper": f"upper bound of {second}",
    }
    if not scenario.model.is_robot:
        found["disturbance"] = "disturbances d_1 ... d_r of the levels"
        found["disturbance_estimate"] = "estimates of the disturbances of the levels"
        found["V"] = "Lyapunov function, sum of w_i V_i"
    return found
