"""The devices and threads that computations use: all devices of this process, or the one that the
user has made the default (`jax.default_device`).
"""

from __future__ import annotations

import os

import jax

from iblf_jax.core import notices

MAX_THREADS = 256
"""Largest number of threads of a kernel (`kernels/c/driver.h`)."""


def user_default() -> jax.Device | str | None:
    """The device, or platform, that the user has made the default."""
    return jax.config.jax_default_device  # type: ignore[attr-defined]


def default_devices() -> list[jax.Device]:
    """The devices that are used where the user names none."""
    device = user_default()
    if device is None:
        return list(jax.local_devices())
    if isinstance(device, str):
        return list(jax.local_devices(backend=device))
    return [device]


def platform() -> str:
    """The platform of the default devices, as JAX names it: "cpu", "gpu" or "tpu"."""
    if user_default() is None:
        return jax.default_backend()
    return default_devices()[0].platform


def is_alone() -> bool:
    """Whether this process is the only one of its program, and has a CPU and no other device."""
    is_single = jax.process_count() == 1 and jax.local_device_count() == 1
    return is_single and jax.default_backend() == "cpu"


def on_device(values: object) -> jax.Array:
    """Numbers of the host as an array, also inside a trace.

    `jnp.asarray` compiles a program for every new shape, 20 ms each.  JAX may share the memory of
    the argument.
    """
    with jax.ensure_compile_time_eval():
        return jax.device_put(values)  # type: ignore[no-any-return]


def processors() -> int:
    """Number of processors that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def threads() -> int:
    """Number of threads that a kernel may use.

    It is $IBLF_JAX_THREADS if this is a whole number from 1 to 256, and otherwise the number of
    processors divided by the number of CPU devices. A larger number counts as 256. Both this and
    any other text give a warning.
    """
    default_threads = max(1, processors() // jax.local_device_count("cpu"))
    text = os.environ.get("IBLF_JAX_THREADS", "")
    if not text:
        return default_threads
    used = default_threads
    if text.isascii() and text.isdigit() and text.strip("0"):
        digits = text.lstrip("0")[:10]  # of any length, as Python refuses to read thousands
        if int(digits) <= MAX_THREADS:
            return int(digits)
        used = MAX_THREADS
    notices.warn(
        f"IBLF_JAX_THREADS: got {text[:40]!r}, expected a whole number from 1 to {MAX_THREADS}."
        f" Running with {used} threads."
    )
    return used
