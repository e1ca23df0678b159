"""The perturbations of a scenario as functions of independent standard normal numbers, and its
margin as a limit state.

A draw of a study is F^-1(u) with u uniform on (0, 1).  Here u = Phi(z), and d numbers z address all
draws of a run.  A normal distribution is evaluated at z itself, because Phi(z) rounds to 1 in its
upper tail (at z = 5.4 in float32).

The noise of a run depends on its number.  The number is a hash of z here, so that a margin is a
function of z, and different points have independent noise.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.pytree import component
from iblf_jax.core.status import Status, has_flag
from iblf_jax.simulation.error_growth import errors_by_step
from iblf_jax.simulation.noise import NOISE_NAME, noise_values
from iblf_jax.studies import statistics
from iblf_jax.studies.blocks import BlockResults
from iblf_jax.studies.distributions import Distribution, Perturbation, is_interval
from iblf_jax.studies.draws import draw, draw_shapes
from iblf_jax.studies.execution import run_all_cases
from iblf_jax.studies.options import LocalExecutor
from iblf_jax.studies.perturbation_cube import Cube
from iblf_jax.studies.study_setup import PreparedStudy
from iblf_jax.studies.time_step import warn_of_step

MARGINS = {"positions": "margin", "velocities": "velocity_margin", "regions": "region_margin"}
"""What may fail -> the metric that is its margin."""
ADMISSIBILITY_DRAWS = 65_536
"""Number of draws from which the probability that a draw can be run is estimated; none of them is
run."""


@component
class NormalCoordinates(Distribution):
    """A distribution in the coordinate z = Phi^-1(u).

    Args:
      distribution: any `Distribution`.
    """

    distribution: Distribution

    @property
    def group(self) -> str:
        """As the distribution's."""
        return self.distribution.group

    @property
    def draws(self) -> int:
        """As the distribution's."""
        return self.distribution.draws

    def quantile(self, z: jax.Array) -> jax.Array:
        """F^-1(Phi(z))."""
        return self.distribution.of_normal(z)

    def support(self) -> tuple[np.ndarray, np.ndarray]:
        """As the distribution's."""
        return self.distribution.support()


def in_normal_coordinates(prepared: PreparedStudy) -> PreparedStudy:
    """The study with distributions that take standard normal numbers instead of uniform ones."""
    uncertain = prepared.shared.uncertain
    perturbations = {}
    for path, p in uncertain.perturbations.items():
        distribution: Any = p.distribution  # no interval: `prepare` refuses them
        coordinates = NormalCoordinates(distribution)
        perturbations[path] = dataclasses.replace(p, distribution=coordinates)
    shared = prepared.shared._replace(uncertain=uncertain._replace(perturbations=perturbations))
    return dataclasses.replace(prepared, shared=shared)


def is_discrete(perturbations: Mapping[str, Perturbation]) -> bool:
    """Whether a distribution is discrete, so that a margin has no gradient by its draw."""
    distributions: Any = (p.distribution for p in perturbations.values() if not is_interval(p))
    return any(distribution.is_discrete for distribution in distributions)


class NormalSpace:
    """The runs of a scenario by standard normal numbers: `space(z)` are their margins.

    Args:
      prepared: the study, as `study_setup.prepare` returns it.
      metric: name of the margin among its metrics.
      limit: margin at which a run fails, in its unit.
      executor: where runs are computed.
      advance: called with the number of runs whenever some are computed.
    """

    def __init__(
        self,
        prepared: PreparedStudy,
        metric: str,
        limit: float,
        executor: LocalExecutor | Executor,
        advance: Callable[[int], None],
    ):
        self.prepared = in_normal_coordinates(prepared)
        self.metric = metric
        self.limit = limit
        self.executor = executor
        self.advance = advance
        self.runs = 0
        """Runs until now."""
        self.status: list[np.ndarray] = []
        self._modes: list[np.ndarray] = []
        self._errors: list[np.ndarray] = []

    @property
    def cube(self) -> Cube:
        """The perturbations as functions of z."""
        uncertain = self.prepared.shared.uncertain
        targets = self.prepared.program.targets
        shapes = tuple(draw_shapes(targets, uncertain.perturbations).items())
        return Cube(uncertain, targets, shapes)

    @property
    def size(self) -> int:
        """Number of standard normal numbers d."""
        return self.cube.size

    def names(self) -> list[str]:
        """The name of each of the d numbers."""
        shapes = self.cube.shapes
        return [name for path, shape in shapes for name in statistics.entry_paths(path, shape)]

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """The margins of runs above the limit at points z, (k, d) -> (k,); NaN for points that
        cannot be run.

        A run that diverged failed, whatever its margin was until then.  So did one that has no
        margin (NaN, from a bound that is not defined at all times, for example): nothing shows
        that it stayed within its bounds.
        """
        results = self._run(z)
        self.runs += len(z)
        self.status.append(results.status)
        self._modes.append(results.fastest_mode)
        self._errors.append(np.asarray(errors_by_step(results.metrics)))
        margins = statistics.worst_joint(results.metrics, self.metric).astype(float) - self.limit
        margins = np.nan_to_num(margins, nan=0.0, posinf=np.inf, neginf=-np.inf)
        diverged = has_flag(results.status, Status.NOT_FINITE)
        margins = np.where(diverged, np.minimum(margins, 0.0), margins)
        not_run = has_flag(results.status, Status.INADMISSIBLE_DRAW)
        return np.where(not_run, np.nan, margins)

    def _run(self, z: np.ndarray) -> BlockResults:
        dtype = self.prepared.scenario.initial.q.dtype
        parts = self.cube.numbers(jnp.asarray(z, dtype))
        designed = {name: np.asarray(x) for name, x in parts.items()}
        options = dataclasses.replace(self.prepared.options, runs=len(z))
        numbers = run_numbers(z)
        prepared = dataclasses.replace(
            self.prepared, options=options, designed=designed, numbers=numbers
        )
        return run_all_cases(prepared, self.executor, self.advance)

    def values(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Path -> drawn values at points z, (k, ...)."""
        found = _values(self.cube, jnp.asarray(z, self.prepared.scenario.initial.q.dtype))
        return {path: np.asarray(x) for path, x in found.items()}

    def runnable_share(self) -> float:
        """The probability that a draw can be run, from draws that are not run."""
        supports = [
            self.cube.uncertain.perturbations[target.path].distribution.support()
            for target in self.cube.targets
            if target.sign is not None
        ]
        # `prepare` refuses bounded distributions that reach inadmissible values.
        if all(np.all(np.isfinite(end)) for support in supports for end in support):
            return 1.0
        rng = np.random.default_rng([self.prepared.options.seed, 2])
        return float(
            np.mean(self.admissible(rng.standard_normal((ADMISSIBILITY_DRAWS, self.size))))
        )

    def admissible(self, z: np.ndarray) -> np.ndarray:
        """Whether the draws at points z, (k, d), can be run, (k,)."""
        dtype = self.prepared.scenario.initial.q.dtype
        return np.asarray(_admissible(self.cube, jnp.asarray(z, dtype)))

    def noise(self, point: np.ndarray) -> jax.Array | None:
        """Key of the noise of the run at a point, (d,); None for a scenario without noise."""
        uncertain = self.prepared.shared.uncertain
        number = run_numbers(point[None])[0]
        return noise_values(uncertain.scenario, uncertain.key, number).get(NOISE_NAME)

    def warn(self) -> None:
        """Warns if runs were flagged because of their time step."""
        if not self.status:
            return
        status, modes, errors = map(np.concatenate, (self.status, self._modes, self._errors))
        options = self.prepared.options
        warn_of_step(status, modes, errors, options.dt, options.method)


def run_numbers(z: np.ndarray) -> np.ndarray:
    """The number of the run of each point, which its noise depends on, (k,) uint32."""
    rows = np.ascontiguousarray(z, dtype=np.float64)
    return np.array([zlib.crc32(row.tobytes()) for row in rows], np.uint32)


def check_varied(perturbations: object) -> None:
    """Raises ValueError for no perturbations."""
    if isinstance(perturbations, Mapping) and not perturbations:
        raise checks.fail(
            "perturbations",
            perturbations,
            "at least one perturbation",
            "Say what varies, such as {'plant.mass': ij.factor(ij.normal(1.0, 0.1))}.",
        )


@jax.jit
def _values(cube: Cube, z: jax.Array) -> dict[str, jax.Array]:
    return jax.vmap(cube.values)(z)


@jax.jit
def _admissible(cube: Cube, z: jax.Array) -> jax.Array:
    def of_point(point: jax.Array) -> jax.Array:
        numbers = cube.numbers(point)
        return draw(cube.uncertain, cube.targets, jnp.uint32(0), {}, numbers)[2]

    return jax.vmap(of_point)(z)
