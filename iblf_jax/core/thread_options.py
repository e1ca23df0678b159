"""Carries the options of JAX from the thread of a caller to the threads that work for it.

A context manager such as `jax.default_matmul_precision("float32")` changes an option of the current
thread only.  A thread that works for it starts with the options of the process, and would compute
something else.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import jax

P = ParamSpec("P")
R = TypeVar("R")

OPTIONS: dict[str, Callable[[Any], contextlib.AbstractContextManager]] = {
    "jax_enable_x64": jax.enable_x64,
    "jax_default_device": jax.default_device,
    "jax_default_matmul_precision": jax.default_matmul_precision,
    "jax_default_prng_impl": jax.default_prng_impl,
    "jax_threefry_partitionable": jax.threefry_partitionable,
    "jax_numpy_dtype_promotion": jax.numpy_dtype_promotion,
    "jax_numpy_rank_promotion": jax.numpy_rank_promotion,
    "jax_softmax_custom_jvp": jax.softmax_custom_jvp,
    "jax_disable_jit": jax.disable_jit,
    "jax_debug_nans": jax.debug_nans,
    "jax_debug_infs": jax.debug_infs,
    "jax_debug_key_reuse": jax.debug_key_reuse,
    "jax_check_tracer_leaks": jax.check_tracer_leaks,
    "jax_enable_checks": jax.enable_checks,
    "jax_log_compiles": jax.log_compiles,
    "jax_explain_cache_misses": jax.explain_cache_misses,
    "jax_transfer_guard_host_to_device": jax.transfer_guard_host_to_device,
    "jax_transfer_guard_device_to_device": jax.transfer_guard_device_to_device,
    "jax_transfer_guard_device_to_host": jax.transfer_guard_device_to_host,
}
"""Name of an option -> the context manager that sets it for the current thread."""
OF_ANY_PROCESS = frozenset(OPTIONS) - {"jax_enable_x64", "jax_default_device"}
"""Settings that another process takes from its client.  Another process has other devices, and is
started with its own floating-point type (`studies.workers.initialize_worker`)."""


def current_options() -> dict[str, Any]:
    """The options of the current thread, by name."""
    return {name: getattr(jax.config, name) for name in OPTIONS}


def process_options() -> dict[str, Any]:
    """All options of JAX as this process has them, by name."""
    options: Any = jax.config
    return dict(options.values)


def of_any_process() -> dict[str, Any]:
    """The options of the current thread that another process takes over."""
    return {name: value for name, value in current_options().items() if name in OF_ANY_PROCESS}


@contextlib.contextmanager
def applied(requested: Mapping[str, Any]) -> Iterator[None]:
    """Context manager that sets options for the current thread.

    An option that already has the requested value is not set: JAX would compile everything again
    for a thread that sets what others only have by default.

    Args:
      requested: name -> value, as from `current_options`.
    """
    with contextlib.ExitStack() as stack:
        for name, value in requested.items():
            if getattr(jax.config, name) != value:
                stack.enter_context(OPTIONS[name](value))
        yield


def with_options_of_caller(function: Callable[P, R]) -> Callable[P, R]:
    """`function`, to be called by another thread with the options that the current thread has now.

    Args:
      function: any function; pass the result to an executor of threads.
    """
    requested = current_options()

    @wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        with applied(requested):
            return function(*args, **kwargs)

    return called
