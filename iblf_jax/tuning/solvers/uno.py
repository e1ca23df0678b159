"""Uno, by the package `unopy`."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import numpy as np

from iblf_jax.tuning.solvers._base import check_options
from iblf_jax.tuning.solvers.packages import check_installed, package
from iblf_jax.tuning.solvers.programme import Programme, RunsToItsEnd


@dataclasses.dataclass(frozen=True)
class Uno(RunsToItsEnd):
    """The solver Uno (filter SQP, interior-point and sequential linear methods), with exact
    gradients and each peak of a requirement as a constraint; forward mode.  It needs the package
    `unopy`: pip install "iblf_jax[tuning]".

    The library runs its own loop: each of the tuning's steps is a whole run, and a checkpoint
    exists after it only.

    Args:
      preset: "filtersqp", "ipopt" or "filterslp", combinations of methods as in these solvers.
      tolerance: of stationarity and complementarity, relative to the objective.
      starts: number of starting points, whose runs follow one another, each to its end; by the
        effort of the tuning if not given.
      sharpenings: how often the smoothing of peaks in the objective is divided by 4, each time
        after a run.
      patience: runs without a better result after which the search ends.

    Source: C. Vanaret, S. Leyffer, Implementing a unified solver for nonlinearly constrained
    optimization, arXiv:2406.13454.
    """

    preset: str = "filtersqp"
    tolerance: float = 1e-5
    starts: int | None = None
    sharpenings: int = 2
    patience: int = 15
    name: ClassVar[str] = "uno"
    handles_requirements: ClassVar[bool] = True
    mode = "forward"
    resample = False

    def __post_init__(self) -> None:
        check_options(self)
        check_installed("unopy")

    def minimise(self, programme: Programme, iterations: int, tolerance: float) -> np.ndarray:
        """As `RunsToItsEnd.minimise`."""
        unopy = package("unopy")
        solver = unopy.UnoSolver()
        solver.set_preset(self.preset)
        options = {
            "logger": "SILENT",
            "print_solution": False,
            "max_iterations": iterations,
            "primal_tolerance": 1e-6,
            "dual_tolerance": tolerance,
        }
        for name, value in options.items():
            solver.set_option(name, value)
        found = solver.optimize(_model(unopy, programme))
        end = np.asarray(found.primal_solution, float)
        return end if np.all(np.isfinite(end)) else programme.z


def _model(unopy: Any, programme: Programme) -> Any:
    """The programme in the form of the library, with a dense Jacobian in column order."""
    size = len(programme.z)
    count = programme.constraints

    def gradient(z: np.ndarray, out: np.ndarray) -> None:
        out[:] = programme.gradient(z)

    def excess(z: np.ndarray, out: np.ndarray) -> None:
        out[:] = programme.excess(z)

    def jacobian(z: np.ndarray, out: np.ndarray) -> None:
        out[:] = programme.jacobian(z).ravel(order="F")

    model = unopy.Model(
        unopy.PROBLEM_NONLINEAR,
        size,
        programme.low.tolist(),
        programme.high.tolist(),
        unopy.ZERO_BASED_INDEXING,
    )
    model.set_objective(unopy.MINIMIZE, programme.objective, gradient)
    if count:
        rows = np.tile(np.arange(count), size).tolist()
        columns = np.repeat(np.arange(size), count).tolist()
        unbounded = np.full(count, -np.inf).tolist()
        model.set_constraints(
            count,
            excess,
            unbounded,
            np.zeros(count).tolist(),
            count * size,
            rows,
            columns,
            jacobian,
        )
    model.set_initial_primal_iterate(programme.z.tolist())
    return model
