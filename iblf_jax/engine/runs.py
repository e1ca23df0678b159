"""The arguments that simulations and studies share, as one object."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any, ParamSpec, Protocol, TypeVar, cast, overload

from iblf_jax.core import checks
from iblf_jax.engine.request import RunRequest, check_backend
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.scenario import Scenario

P = ParamSpec("P")
R = TypeVar("R", covariant=True)


@dataclasses.dataclass(frozen=True)
class Runs:
    """How runs are computed: `ij.simulate(scenario, runs_as=ij.Runs(duration=20.0))`.

    Functions that take duration, dt, method, backend or seed accept one `Runs` in place of them.

    Args:
      duration: length of a run [s], a whole number of steps.
      dt: time step [s].
      method: integrator, a name of `simulate`.
      backend: "auto", "native", "gpu" or "vmap".
      seed: whole number that fixes all random numbers.

    Raises:
      ValueError: an argument that is not valid; the message names it and the remedy.
    """

    duration: float
    dt: float = 1e-3
    method: str = "rk4"
    backend: str = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        checks.whole_steps(self.duration, self.dt)
        tableau(self.method)
        check_backend(self.backend)
        numbers = {"duration": float(self.duration), "dt": float(self.dt)}
        vars(self).update(numbers, seed=checks.seed(self.seed))

    @property
    def steps(self) -> int:
        """Number of time steps of a run."""
        return checks.whole_steps(self.duration, self.dt)

    def request(self, scenario: Scenario, *, record_every: int | None = None) -> RunRequest:
        """The checked request for a scenario.

        Args:
          scenario: canonical scenario.
          record_every: interval of the recorded instants in steps; None for metrics only.

        Raises:
          ValueError: a method that does not fit the scenario.
        """
        return RunRequest.of(
            scenario,
            steps=self.steps,
            method=self.method,
            record_every=record_every,
            backend=self.backend,
        )


class TakesRuns(Protocol[P, R]):
    """A function that accepts `runs_as` in place of the arguments that a `Runs` has."""

    @overload
    def __call__(self, *args: P.args, **options: P.kwargs) -> R: ...
    @overload
    def __call__(self, *args: Any, runs_as: Runs, **options: Any) -> R: ...


def takes_runs(function: Callable[P, R]) -> TakesRuns[P, R]:
    """Decorator of a public function that takes arguments of `Runs` as keywords: it accepts
    `runs_as=Runs(...)` in their place.  The defaults of the function stay its own.

    Raises:
      ValueError: both are given, or a `Runs` with something that the function has no argument for.
    """
    signature = inspect.signature(function)
    fields = {field.name: field.default for field in dataclasses.fields(Runs)}
    taken = [name for name in fields if name in signature.parameters]

    @functools.wraps(function)
    def called(*args: Any, runs_as: Runs | None = None, **options: Any) -> Any:
        if runs_as is None:
            return function(*args, **options)
        if not isinstance(runs_as, Runs):
            raise checks.fail("runs_as", runs_as, "an ij.Runs", "Such as ij.Runs(duration=20.0).")
        twice = [name for name in taken if name in options]
        if twice:
            got = checks.Words(f"{', '.join(twice)} beside it")
            remedy = "Change one of its fields by dataclasses.replace(runs, ...)."
            raise checks.fail("runs_as", got, "either runs_as, or its fields one by one", remedy)
        given = {name: getattr(runs_as, name) for name in fields}
        for name in fields.keys() - taken:
            if given[name] != fields[name]:
                expected = f"the default, as {function.__name__} has no argument {name}"
                raise checks.fail(f"runs_as.{name}", given[name], expected)
        return function(*args, **options, **{name: given[name] for name in taken})

    own = inspect.Parameter(
        "runs_as", inspect.Parameter.KEYWORD_ONLY, default=None, annotation="Runs | None"
    )
    parameters = [*signature.parameters.values(), own]
    vars(called)["__signature__"] = signature.replace(parameters=parameters)
    return cast(TakesRuns[P, R], called)
