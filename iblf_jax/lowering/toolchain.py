"""The system's C++ compiler: found, run without a shell, its results kept by content in a directory that only the user can write.

The key of a kernel is a hash of its source, the flags, the compiler's version, the processor and the header of XLA's interface, so a
stale kernel is never loaded.  A kernel is built under a temporary name and renamed, so that two processes do not disturb each other.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path

import jax

FLAGS = (
    "-x", "c++", "-std=gnu++17", "-O3", "-march=native", "-fPIC", "-shared", "-pthread", "-fno-math-errno", "-fno-trapping-math",
    "-ffp-contract=fast", "-fno-exceptions", "-fno-rtti", "-fvisibility=hidden", "-w",
)  # fmt: skip
"""NaN and infinities keep their meaning: no -ffast-math, no -ffinite-math-only."""
TIMEOUT = 300
"""Seconds that a compiler may take."""


class ToolchainError(Exception):
    """No compiler, or it failed, or there is no safe place for its result; the message is one line for the user."""


def compiler() -> str:
    """The path of a C++ compiler: $CXX if it is set, else c++, g++ or clang++; ToolchainError if there is none."""
    wanted = os.environ.get("CXX")
    for name in [wanted] if wanted else ["c++", "g++", "clang++"]:
        path = shutil.which(name)
        if path:
            return path
    raise ToolchainError("there is no C++ compiler" + (f" {wanted!r} ($CXX)" if wanted else " (c++, g++, clang++)"))


@cache
def _version(path: str) -> str:
    return _run([path, "--version"]).splitlines()[0]


@cache
def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return "\n".join(sorted({line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))}))
    except OSError:
        return platform.processor() + platform.machine()


def built_for() -> dict[str, str]:
    """What a kernel is tied to, in words; ToolchainError if there is no compiler."""
    found, path = _processor(), compiler()
    names = [line.partition(":")[2].strip() for line in found.splitlines() if line.startswith(("model name", "CPU part"))]
    features = hashlib.sha256(found.encode()).hexdigest()[:8]
    return {"processor": f"{', '.join(names) or platform.machine()}, features {features}", "compiler": f"{_version(path)}, {path}"}


def _run(command: list[str]) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.SubprocessError) as error:
        raise ToolchainError(f"{Path(command[0]).name} could not be run: {error}") from None
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "error" in line] or done.stderr.splitlines() or ["no message"]
        raise ToolchainError(f"{Path(command[0]).name} failed: {lines[0][:200]}")
    return done.stdout


def cache_directory() -> Path:
    """Where kernels are kept: $XDG_CACHE_HOME/iblf_jax, mode 0700; ToolchainError if it cannot be made or is not this user's."""
    base = os.environ.get("XDG_CACHE_HOME")
    path = (Path(base) if base else Path.home() / ".cache") / "iblf_jax"
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = path.lstat()
    except (OSError, RuntimeError) as error:
        raise ToolchainError(f"the kernel cache {path} cannot be made: {error}") from None
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
        raise ToolchainError(f"the kernel cache {path} is not a directory of this user")
    if stat.S_IMODE(status.st_mode) & 0o077:
        path.chmod(0o700)
    return path


def built(source: str, extra: tuple[str, ...] = ()) -> tuple[Path, str]:
    """The shared library of a source and its key, compiled unless it is in the cache; ToolchainError on failure."""
    path = compiler()
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    flags = [*FLAGS, *extra]
    content = [source, *flags, path, _version(path), _processor(), header.read_text()]

    def compile_to(result: Path) -> None:
        text = result.with_suffix(".cc")
        text.write_text(source)
        _run([path, *flags, f"-I{jax.ffi.include_dir()}", str(text), "-o", str(result), "-lm", "-ldl"])

    return kept(content, ".so", compile_to)


def kept(content: Iterable[str], suffix: str, make: Callable[[Path], object]) -> tuple[Path, str]:
    """The file that `make(path)` writes, and the key of its content, made unless it is in the cache; ToolchainError on failure."""
    key = hashlib.sha256("\0".join(content).encode()).hexdigest()[:32]
    directory = cache_directory()
    path = directory / f"{key}{suffix}"
    if not _is_ours(path):
        with tempfile.TemporaryDirectory(dir=directory) as folder:
            result = Path(folder) / f"kernel{suffix}"
            make(result)
            result.chmod(0o700)
            os.replace(result, path)
    return path, key


def _is_ours(path: Path) -> bool:
    try:
        status = path.lstat()
    except OSError:
        return False
    return stat.S_ISREG(status.st_mode) and status.st_uid == os.getuid() and not stat.S_IMODE(status.st_mode) & 0o022


def loaded(library: Path) -> ctypes.CDLL:
    """The library in this process; ToolchainError if it does not load."""
    try:
        return ctypes.CDLL(str(library))
    except OSError as error:
        raise ToolchainError(f"a kernel does not load: {error}") from None


def processors() -> int:
    """Processors that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads() -> int:
    """Threads that a kernel may use: $IBLF_JAX_THREADS, else the process's processors, divided among its CPU devices."""
    wanted = os.environ.get("IBLF_JAX_THREADS", "")
    if wanted.isdigit() and int(wanted) > 0:
        return int(wanted)
    return max(1, processors() // jax.local_device_count("cpu"))
