"""Check that a law yields finite torques, and the parameter that causes others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from iblf_jax.core import checks
from iblf_jax.simulation.paths import parameters, with_parameters
from iblf_jax.simulation.scenario import Scenario

LARGE, SMALL = 1e6, 1e-6
"""Sizes beyond which a parameter may be why a law yields no numbers."""


def check_finite(
    scenario: Scenario, torques_of: Callable[[Scenario], Any], torques: np.ndarray, instant: str
) -> None:
    """Refuses a law whose torques are not finite.

    Args:
      scenario: with the law.
      torques_of: the torques of a scenario like this one, up to those that are not finite, (K, n)
        [N m].
      torques: those of this scenario, (K, n) [N m].
      instant: when the last of them is, for the message.

    Raises:
      ValueError: some torque is not finite; the message names the parameter that causes it, or else
        the torque.
    """
    wrong = np.argwhere(~np.isfinite(torques))
    if not len(wrong):
        return
    row, joint = wrong[0]
    finding = f"the torque tau[{joint}] is {torques[row, joint]} {instant}"
    blamed = _cause(scenario, torques_of)
    if blamed is None:
        raise checks.fail(
            "scenario",
            f"a law that yields no numbers: {finding}",
            "finite torques",
            "Check its gains and its model.",
        )
    path, value = blamed
    raise checks.fail(
        path, value, "a value with which the law yields finite numbers", f"With it {finding}."
    )


def _cause(
    scenario: Scenario, torques_of: Callable[[Scenario], Any]
) -> tuple[str, np.ndarray] | None:
    """The parameter, of extreme size, without which the torques are finite; None if there is
    none.
    """
    for parameter in parameters(scenario, named=False):
        value = np.asarray(parameter.value, float)
        size = np.abs(value)
        is_extreme = (size > LARGE) | ((size < SMALL) & (size > 0))
        if not is_extreme.any():
            continue
        try:
            changed = with_parameters(
                scenario, {parameter.path: np.where(is_extreme, np.sign(value), value)}
            )
        except ValueError:  # this value is the only one that fits the others
            continue
        if np.all(np.isfinite(np.asarray(torques_of(changed)))):
            return parameter.path, value
    return None
