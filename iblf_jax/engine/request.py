"""Stage 1 of a run: what a caller requests, checked once.

A `RunRequest` is static and hashable: together with the structure of the inputs (scenario, metrics,
time step) it decides what is compiled.  The numbers of the inputs are not part of it.
"""

from __future__ import annotations

from typing import NamedTuple

from iblf_jax.core import checks, notices
from iblf_jax.engine.registry import backends
from iblf_jax.engine.structural_constants import StructuralConstants, constants_of
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.scenario import Scenario


class RunRequest(NamedTuple):
    """What is to be run, besides the inputs; use `RunRequest.of` to have it checked."""

    steps: int
    method: str = "rk4"
    """The integrator."""
    record_every: int | None = None
    """Every so-many-th instant is recorded, from t = 0; None records nothing but metrics."""
    constants: StructuralConstants | None = None
    """Which numbers of the scenario are compiled in (`mechanism`)."""
    backend: str = "auto"
    """The requested backend: "auto", "vmap" or a name in the registry of executors."""
    nested: bool = False
    """Whether the caller runs the program inside a loop or a branch of JAX."""

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
          method: "rk4", "heun" or "euler".
          record_every: interval of the recorded instants in steps; None for metrics only.
          backend: "auto", "native", "gpu" or "vmap".

        Raises:
          ValueError: an unknown method or backend.
        """
        tableau(method)
        backend = check_backend(backend)
        return RunRequest(steps, method, record_every, constants_of(scenario), backend)


def check_backend(backend: str) -> str:
    """The name of a backend; raises ValueError for an unknown one."""
    if isinstance(backend, str) and backend == "xla":
        notices.warn(
            'backend="xla" was removed and means "vmap" now; "auto" is faster wherever there is a'
            " C++ compiler.",
            DeprecationWarning,
        )
        return "vmap"
    checks.one_of("backend", backend, backends())
    return backend
