"""Checks that a law yields finite torques, and finds the parameter that is the cause if not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from iblf_jax.core import checks
from iblf_jax.simulation.paths import parameters, with_parameters
from iblf_jax.simulation.scenario import Scenario

LARGE, SMALL = 1e6, 1e-6
"""A parameter whose absolute value is above or below these may be the cause of torques that are not
finite."""


def check_finite(
    scenario: Scenario, torques_of: Callable[[Scenario], Any], torques: np.ndarray, instant: str
) -> None:
    """Raises ValueError for a law whose torques are not finite.

    Args:
      scenario: the scenario with the law.
      torques_of: computes the torques of a scenario, up to the first that is not finite, (K, n)
        [N m].
      torques: the torques of this scenario, (K, n) [N m].
      instant: time of the last torque, in words for the message.

    Raises:
      ValueError: some torque is not finite; the message names the parameter that causes it, or else
        the torque.
    """
    wrong = np.argwhere(~np.isfinite(torques))
    if not len(wrong):
        return
    row, joint = wrong[0]
    finding = f"the torque tau[{joint}] is {torques[row, joint]} {instant}"
    for parameter in parameters(scenario, named=False):
        value = np.asarray(parameter.value, float)
        size = np.abs(value)
        is_extreme = (size > LARGE) | ((size < SMALL) & (size > 0))
        if not is_extreme.any():
            continue
        moderate = np.where(is_extreme, np.sign(value), value)
        try:
            changed = with_parameters(scenario, {parameter.path: moderate})
        except ValueError:  # this value is the only one that fits the others
            continue
        if np.all(np.isfinite(np.asarray(torques_of(changed)))):
            expected = "a value with which the law yields finite numbers"
            raise checks.fail(parameter.path, value, expected, f"With it {finding}.")
    came = f"a law that yields no numbers: {finding}"
    remedy = "Check its gains and its model."
    raise checks.fail("scenario", came, "finite torques", remedy)
