"""The fallback from one executor to the next, as a batch of runs makes it."""

from iblf_jax.engine import compile, plan, registry
from iblf_jax.engine.request import RunRequest


def with_fallback(backend, run_on, by_scan):
    """`run_on(name)` with the first executor of the plan of a batch that works."""
    execution = plan.choose_plan(RunRequest(1, backend=backend), 3, registry.machine())
    return compile.first_that_works(execution, lambda executor: run_on(executor.name), by_scan)
