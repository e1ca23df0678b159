"""Stage 1 of a run: what a caller requests.

A `RunRequest` is static and hashable. Together with the structure of the inputs (scenario, metrics,
time step) it determines the compiled program. The values of the inputs are not part of it.
"""

from __future__ import annotations

from typing import NamedTuple

from iblf_jax.core import checks
from iblf_jax.engine.registry import backends
from iblf_jax.engine.structural_constants import StructuralConstants, constants_of
from iblf_jax.simulation.noise import check_method
from iblf_jax.simulation.scenario import Scenario


class RunRequest(NamedTuple):
    """What is to be run, except for the inputs; `RunRequest.of` checks its arguments."""

    steps: int
    method: str = "rk4"
    """The integrator."""
    record_every: int | None = None
    """Interval of the recorded instants in steps, from t = 0; None for metrics only."""
    constants: StructuralConstants | None = None
    """The numbers of the scenario that are compiled in; None for none."""
    backend: str = "auto"
    """"auto", "vmap" (the scan) or the name of an executor."""
    assessed: bool = True
    """Whether the outcome has the accuracy of the run, the radius of its sampled loop, and the
    flags that follow from them.  Searches read metrics and `status.UNTRUSTED` only.  They do
    without: of a sampled arm it is most of what is compiled and computed after the last step."""

    @property
    def instants(self) -> int:
        """Instants at which the closed loop is evaluated: the start and the end of every step."""
        return self.steps + 1

    @staticmethod
    def of(
        scenario: Scenario,
        *,
        steps: int,
        method: str = "rk4",
        record_every: int | None = None,
        backend: str = "auto",
    ) -> RunRequest:
        """The checked request for a scenario, with the numbers of it that are compiled in.

        Args:
          scenario: canonical scenario; numbers that are traced are not compiled in.
          steps: number of time steps (`checks.whole_steps`).
          method: a name in `integrators.METHODS`.
          record_every: interval of the recorded instants in steps; None for metrics only.
          backend: "auto", "native", "gpu" or "vmap".

        Raises:
          ValueError: an unknown method or backend, or a method that does not fit the scenario
            (`noise.check_method`).
        """
        check_method(scenario, method)
        backend = check_backend(backend)
        return RunRequest(steps, method, record_every, constants_of(scenario), backend)


def check_backend(backend: str) -> str:
    """The name of a backend; raises ValueError for an unknown one."""
    checks.one_of("backend", backend, backends())
    return backend
