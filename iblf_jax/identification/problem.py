"""The identification problem: which parameters are identified from which data."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from iblf_jax.identification.coordinates import Coordinates, to_x
from iblf_jax.identification.log import Log
from iblf_jax.identification.missing_terms import MissingTerms, missing_terms
from iblf_jax.identification.regression import LARGEST_DELAY, inverse_dynamics_at
from iblf_jax.identification.replay import inverse_dynamics_under
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
    smooth: SmoothedMotion
    """Smoothed data of the logs, without the parts that are held back."""
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

    def replay(self, x: np.ndarray, free: FreeTorques) -> ShootingProblem:
        """The simulation of all windows under the logged torque.

        Args:
          x: parameters at which the steps of the integrator are chosen.
          free: torques that are free near standstill.
        """
        return ShootingProblem(
            self.simulated,
            self.coordinates,
            self.windows,
            self.logs,
            self.zero_order_hold,
            self.loss,
            self._substeps(x),
            free,
        )

    def _substeps(self, x: np.ndarray) -> int:
        """Number of integrator steps between two samples."""
        data = self.smooth
        points = [jnp.asarray(a) for a in (data.t, data.q, data.dq, data.tau)]
        sensitivities = inverse_dynamics_under(
            self.simulated, jnp.asarray(x), *points, places=self.coordinates.places
        )
        return substeps_for(sensitivities, min(log.step for log in self.logs))


def missing_terms_of_fit(
    simulated: Scenario, c: Coordinates, data: SmoothedMotion, z: np.ndarray, fitted: np.ndarray
) -> MissingTerms:
    """The terms that a fit lacks.

    Args:
      simulated: scenario whose plant was simulated.
      c: coordinates of the parameters.
      data: the smoothed logs.
      z: end of the fit, (p + 1,), the delay last.
      fitted: entries of z that the fit could move, (p + 1,) bool.
    """
    at_end = inverse_dynamics_at(simulated, c, to_x(c, z[:-1])[0], data)
    torque, by_x = np.asarray(at_end.torque), np.asarray(at_end.by_x)
    return missing_terms(data, torque, by_x, float(z[-1]), fitted)
