"""Compilers of C for what is exported: the system's, or the one that comes with `ziglang`, which
also makes WebAssembly.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from iblf_jax.kernels import ToolchainError, has_ziglang, ziglang

TIMEOUT = 300.0
"""Seconds that a compiler may take."""
MAX_OUTPUT = 2000
"""Characters of a compiler's complaint that are repeated."""


def c_compiler() -> list[str]:
    """The command of a C compiler: $CC if it is set, else cc, gcc, clang or ziglang's;
    ToolchainError if there is none.
    """
    chosen = os.environ.get("CC")
    for name in [chosen] if chosen else ["cc", "gcc", "clang"]:
        path = shutil.which(name)
        if path:
            return [path]
    if not chosen and has_ziglang():
        return zig()
    raise ToolchainError(
        "there is no C compiler"
        + (f" {chosen!r} ($CC)" if chosen else " (cc, gcc, clang; pip install ziglang has one)")
    )


def zig() -> list[str]:
    """The command of ziglang's C compiler; ToolchainError if it is not installed."""
    if not has_ziglang():
        raise ToolchainError(
            'ziglang is not installed: pip install ziglang, or ".[export]" in a clone'
        )
    return list(ziglang("cc"))


def build(command: Sequence[str], folder: Path) -> None:
    """Runs a compiler in a folder; ToolchainError with what it says if it fails."""
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=TIMEOUT, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ToolchainError(f"the C compiler could not be run: {error}") from None
    if done.returncode:
        raise ToolchainError(f"the C compiler failed: {done.stderr[:MAX_OUTPUT]}")


def fmi_platform() -> tuple[str, str]:
    """FMI 3.0's name of this platform, and how its shared libraries end."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(
        platform.machine().lower(), platform.machine().lower()
    )
    system = platform.system().lower()
    return f"{machine}-{system}", {"windows": ".dll", "darwin": ".dylib"}.get(system, ".so")
