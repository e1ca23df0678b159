"""Finds and runs the C compiler for exported code: the system's, or the one in `ziglang`, which
also compiles to WebAssembly.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from iblf_jax.kernels import ToolchainError, has_ziglang, ziglang

TIMEOUT = 300.0
"""Longest time that a compiler may run [s]."""
MAX_OUTPUT = 2000
"""Largest number of characters of a compiler's message that an error repeats."""


def c_compiler() -> list[str]:
    """The command of a C compiler: $CC if it is set, else cc, gcc, clang or ziglang's;
    ToolchainError if there is none.
    """
    chosen = os.environ.get("CC")
    names = [chosen] if chosen else ["cc", "gcc", "clang"]
    for path in filter(None, map(shutil.which, names)):
        return [path]
    if chosen:
        raise ToolchainError(f"there is no C compiler {chosen!r} ($CC)")
    if not has_ziglang():
        raise ToolchainError("there is no C compiler (cc, gcc, clang; pip install ziglang has one)")
    return zig()


def zig() -> list[str]:
    """The command of ziglang's C compiler; ToolchainError if it is not installed."""
    if not has_ziglang():
        raise ToolchainError(
            'ziglang is not installed: pip install ziglang, or ".[export]" in a clone'
        )
    return list(ziglang("cc"))


def write_files(folder: Path, texts: Mapping[str, str]) -> None:
    """Writes texts, file name -> text, into a folder, which is created if it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")


def build(command: Sequence[str], folder: Path) -> None:
    """Runs a compiler in a folder; a ToolchainError repeats its message if it fails."""
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        words = f"the C compiler {command[0]} took more than {TIMEOUT:g} s: repeat this when the"
        raise ToolchainError(f"{words} machine has less to do") from None
    except OSError as error:
        raise ToolchainError(f"the C compiler could not be run: {error}") from None
    if done.returncode:
        raise ToolchainError(f"the C compiler failed: {done.stderr[:MAX_OUTPUT]}")


def fmi_platform() -> tuple[str, str]:
    """FMI 3.0's name of this platform, and the file ending of its shared libraries."""
    machine = platform.machine().lower()
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
    system = platform.system().lower()
    return f"{machine}-{system}", {"windows": ".dll", "darwin": ".dylib"}.get(system, ".so")
