"""How a batch of runs is executed.  The physics is written once, for one run; a backend decides how many are stepped at a time.

`run_batch` is the one entry: studies call it with the leaves that differ between runs, and all backends give the same results.

    vmap     plain `jax.vmap` of a run: any scenario, any device; on CPU a long closed loop (an arm of many joints) goes run by run
             instead, which is several times faster
    xla      the step's scalar program, one (batch,) array a number, in `lax.scan`: any device, nothing needed but jax
    native   the same program as C, built by the system's compiler, SIMD over runs and threads: CPU
    gpu      the same C as a CUDA kernel, one run a thread, built by NVRTC: NVIDIA GPUs (not yet measured on one)

What a scalar program cannot express runs on `vmap`, and what has no compiler, or is for another device, on `xla`; a `BackendWarning`
says why, once.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any

import jax

from iblf_jax import checks, compact_loop
from iblf_jax.derivatives import Tangents
from iblf_jax.lowering import batch, gpu, native, sensitivities, xla
from iblf_jax.lowering.program import UnsupportedError
from iblf_jax.lowering.toolchain import ToolchainError
from iblf_jax.one_function import SMALL, as_one_function
from iblf_jax.paths import with_parameters
from iblf_jax.scenario import Scenario
from iblf_jax.time_loop import Outcome

BACKENDS = ("auto", "vmap", "xla", "native", "gpu")
"""How a batch can be executed; "auto" is native on CPU, gpu on an NVIDIA GPU, else xla."""
LONGEST_ALONE = 2500
"""Operations of a step up to which one run is lowered unasked: a longer one gains less by it than it takes to compile."""
COMPILED = {"cpu": native, "gpu": gpu}
"""The backend that builds its kernels, by platform."""


class BackendWarning(UserWarning):
    """A batch runs on another backend than was asked for, and why."""


_told: set[str] = set()


def _tell(text: str) -> None:
    if text not in _told:
        _told.add(text)
        warnings.warn(text, BackendWarning, stacklevel=4)


def automatic() -> tuple[str, str | None]:
    """The backend that "auto" takes for what lowers, and why it is not a compiled one, in one line (None if it is)."""
    compiled = COMPILED.get(jax.default_backend())
    reason = compiled.unavailable() if compiled else f"no kernels are compiled for {jax.default_backend()}"
    return ("xla", reason) if compiled is None or reason else (compiled.NAME, None)


def with_fallback(backend: str, run_on: Callable, plain: Callable):
    """`run_on(executor)` on the backend that was asked for, or the next one that can; `plain()` is vmap.

    Args:
      backend: one of BACKENDS.
      run_on: function of an executor (`native.run`, `gpu.run`, `xla.run`).
      plain: function without arguments.

    Raises:
      ValueError: an unknown backend.
    """
    checks.one_of("backend", backend, BACKENDS)
    here = COMPILED.get(jax.default_backend())
    compiled = {"native": native, "gpu": gpu, "auto": here}.get(backend)
    try:
        if compiled and compiled is not here:
            _tell(f"The {backend} backend is not for the default device, {jax.default_backend()}: running on xla.")
        elif compiled:
            try:
                return run_on(compiled.run)
            except ToolchainError as error:
                _tell(f"The {compiled.NAME} backend is not available ({error}): running on xla.")
        if backend != "vmap":
            return run_on(xla.run)
    except UnsupportedError as reason:
        _tell(f"This scenario runs on the vmap backend, several times slower: {reason}.")
    return plain()


def settled(backend: str, scenario: Scenario, varied: Mapping[str, Any], folds, dt: jax.Array, *, method: str) -> str:
    """The backend that a batch will run on, fallbacks and their warnings included; builds the native kernel if it is that one.

    Args:
      backend, scenario, folds, dt, method: as `run_batch`.
      varied: path -> values or their shapes, batch axis first.

    Returns:
      "gpu", "native", "xla" or "vmap".

    Raises:
      ValueError: an unknown backend.
    """
    flat, structure = jax.tree.flatten((scenario, dict(varied), folds, dt))
    return _settled(backend, method, automatic(), structure, tuple((x.shape, x.dtype) for x in flat))


@lru_cache(maxsize=64)
def _settled(backend: str, method: str, available: tuple[str, str | None], structure: Any, shapes: tuple) -> str:
    """`settled` by structure and shapes, on which alone it depends: the trace takes longer than many a study."""

    def trace(leaves):
        scenario, varied, folds, dt = jax.tree.unflatten(structure, leaves)

        def run_on(executor):
            batch.run(executor, scenario, varied, folds, dt, steps=1, method=method, record_every=None)
            return {gpu.run: "gpu", native.run: "native", xla.run: "xla"}[executor]

        found.append(with_fallback(backend, run_on, lambda: "vmap"))

    found: list[str] = []
    jax.eval_shape(trace, [jax.ShapeDtypeStruct(*shape) for shape in shapes])
    return found[-1]


def run_batch(
    scenario: Scenario,
    varied: Mapping[str, jax.Array],
    folds,
    dt: jax.Array,
    *,
    steps: int,
    method: str,
    record_every: int | None = None,
    backend: str = "auto",
) -> Outcome:
    """Runs a scenario once for every entry of `varied`; call it inside `jit`.

    Args:
      scenario: the scenario that all runs share, canonical.
      varied: path -> values, batch axis first; each run replaces these leaves.
      folds: the metrics.
      dt: time step, () [s].
      steps: number of steps, static.
      method: integrator, static.
      record_every: record every so-many-th step, or None for metrics only, static.
      backend: one of BACKENDS, static.

    Returns:
      An `Outcome` with a leading batch axis on every array.

    Raises:
      ValueError: an unknown backend.
    """
    options: dict[str, Any] = {"steps": steps, "method": method, "record_every": record_every}

    def one(varied, alone=False):
        return compact_loop.run(with_parameters(scenario, varied), folds, dt, alone=alone, **options)

    def run_on(executor):
        return batch.run(executor, scenario, varied, folds, dt, **options)

    def plain():
        if jax.default_backend() == "cpu" and compact_loop.is_for(scenario, dt):
            return jax.lax.map(partial(one, alone=True), dict(varied))
        batched = jax.vmap(one)
        return (as_one_function(batched) if min(map(len, varied.values())) <= SMALL else batched)(dict(varied))

    return with_fallback(backend, run_on, plain)


def run_alone(scenario: Scenario, folds, dt: jax.Array, *, steps: int, method: str, record_every: int, backend: str) -> Outcome:
    """One run by its scalar program; call it inside `jit`.

    Args:
      scenario, folds, dt, steps, method, record_every: as `run_batch`, of one run.
      backend: "native" or "gpu", which fall back with a warning; "xla"; or "auto", which is native for short steps where there is a
        compiler.  What is long or does not lower is, on these two, the plain run, without a warning.
    """
    options: dict[str, Any] = {"steps": steps, "method": method, "record_every": record_every}

    def run_on(executor, longest=None):
        return batch.run_alone(executor, scenario, folds, dt, **options, longest=longest)

    def plain():
        return compact_loop.run(scenario, folds, dt, alone=True, **options)

    if backend in ("native", "gpu"):
        return with_fallback(backend, run_on, plain)
    if jax.default_backend() != "cpu" or compact_loop.is_for(scenario, dt):
        return plain()
    try:
        return run_on(native.run if backend == "auto" and not native.unavailable() else xla.run, LONGEST_ALONE)
    except (UnsupportedError, ToolchainError):
        return plain()


def run_batch_jvp(
    scenario: Scenario,
    varied: Mapping[str, jax.Array],
    directions: Mapping[str, Any],
    folds,
    dt: jax.Array,
    *,
    steps: int,
    method: str,
    backend: str = "auto",
) -> Tangents:
    """Values of a batch and their derivatives along P directions in the space of leaves, in one pass; call it inside `jit`.

    Args:
      scenario, varied, folds, dt, steps, method: as `run_batch`.
      backend: as `run_batch`; "auto" runs long programs (many joints and directions), which take minutes to compile, on vmap.
      directions: path -> (P, *shape of the leaf), concrete numbers, the same for every run: direction p moves each of these
        leaves along its p-th row.  For the derivative by each entry of one gain of two joints: `{"controller.K2": np.eye(2)}`.

    Returns:
      The outcome, name -> (batch, P, *shape) for every metric that is a float, and the Gauss-Newton matrices (batch, P, P) of the
      folds that offer `curvature`.

    Raises:
      ValueError: an unknown backend or path.
    """
    along = sensitivities.Directions.of(directions)
    options: dict[str, Any] = {"steps": steps, "method": method}

    def run_on(executor):
        if backend == "auto" and not sensitivities.is_short(executor, scenario, varied, along, folds, dt, method=method):
            return plain()
        return sensitivities.lowered_jvp(executor, scenario, varied, along, folds, dt, **options)

    def plain():
        return sensitivities.plain_jvp(scenario, varied, along, folds, dt, **options)

    return with_fallback(backend, run_on, plain)
