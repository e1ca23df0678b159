"""The identification problem: which parameters are identified from which data."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from iblf_jax.identification.coordinates import LARGEST_DELAY, Coordinates
from iblf_jax.identification.log import Log
from iblf_jax.identification.replay import inverse_dynamics_for_torque
from iblf_jax.identification.shooting import Prior, ShootingProblem, Windows, substeps_for
from iblf_jax.identification.smoothing import SmoothedMotion
from iblf_jax.identification.standstill import FreeTorques
from iblf_jax.simulation.scenario import Scenario


class IdentificationProblem(NamedTuple):
    """Parameters, data and options of one call of `identify`.

    The vector z has the p coordinates of the parameters and the delay of the torque.
    """

    start: Scenario
    """The user's scenario, in float64."""
    simulated: Scenario
    """The scenario whose plant is simulated under the logged torque."""
    coordinates: Coordinates
    logs: list[Log]
    windows: Windows
    motion: SmoothedMotion
    """The smoothed logs, without the parts that are held back."""
    prior: Prior
    requested: int
    """Number of paths that the user named, without that of the delay."""
    fixed_delay: float | None
    """Delay of the torque [s]; None if it is estimated."""
    zero_order_hold: bool
    """Whether the torque is constant between samples; otherwise it is interpolated."""
    loss: str
    iterations: int

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """The lower and upper limits of z."""
        low, high = -LARGEST_DELAY, LARGEST_DELAY
        if self.fixed_delay is not None:
            low = high = self.fixed_delay
        return np.append(self.coordinates.low, low), np.append(self.coordinates.high, high)

    def shooting(self, x: np.ndarray, free: FreeTorques) -> ShootingProblem:
        """The multiple-shooting problem of all windows under the logged torque.

        Args:
          x: parameters at which the steps of the integrator are chosen.
          free: torques that are free near standstill.
        """
        motion = self.motion
        points = [jnp.asarray(a) for a in (motion.t, motion.q, motion.dq, motion.tau)]
        sensitivities = inverse_dynamics_for_torque(
            self.simulated, jnp.asarray(x), *points, places=self.coordinates.places
        )
        shortest = min(log.step for log in self.logs)
        return ShootingProblem(
            self.simulated,
            self.coordinates,
            self.windows,
            self.logs,
            self.zero_order_hold,
            self.loss,
            substeps_for(sensitivities, shortest),
            free,
        )
