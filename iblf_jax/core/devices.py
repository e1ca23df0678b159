"""What JAX computes on: all devices of this process, or the one that the user has made the default
(`jax.default_device`).
"""

from __future__ import annotations

import jax


def chosen() -> jax.Device | str | None:
    """The device, or platform, that the user has made the default."""
    return jax.config.jax_default_device  # type: ignore[attr-defined]


def default() -> list[jax.Device]:
    """The devices that are taken where the user names none."""
    device = chosen()
    if device is None:
        return list(jax.local_devices())
    return list(jax.local_devices(backend=device)) if isinstance(device, str) else [device]


def platform() -> str:
    """Their platform, as JAX names it: "cpu", "gpu" or "tpu"."""
    return jax.default_backend() if chosen() is None else default()[0].platform
