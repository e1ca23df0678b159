"""The system's C++ compiler: found, run without a shell, its results kept by content in a directory that only the user can write.

The key of a kernel is a hash of its source, the flags, the compiler's version, the processor and the header of XLA's interface, so a
stale kernel is never loaded.  A kernel is made in a draft, written out to the disk and renamed, so that two processes do not disturb each
other.  A digest of key and content stands at its end: a file that does not fit it, for whatever reason, is made again, and what is loaded
is a copy of what was checked.  Nothing here follows a symbolic link that it finds in the directory.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import hashlib
import os
import platform
import shutil
import signal
import stat
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path

import jax

from iblf_jax._start import AT_END
from iblf_jax.core import notices
from iblf_jax.core.cache import directory, processor
from iblf_jax.core.drafts import draft, remove_abandoned
from iblf_jax.core.progress import told

COMPILER_FLAGS = (
    "-x", "c++", "-std=gnu++17", "-nostdinc++", "-O1", "-fexpensive-optimizations", "-fcaller-saves", "-ftree-loop-vectorize",
    "-march=native", "-fPIC", "-shared", "-pthread", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-fno-exceptions",
    "-fno-rtti", "-fvisibility=hidden", "-w",
)  # fmt: skip
"""Of -O3 what the generated text gains by: the paper's loop runs as fast (1 % either way, one run 3 % slower) and builds in 0.6 s instead
of 2.7.  Products and sums are one operation by the second flag, and a large angle's sine would lose digits without; numbers stay in
registers across what is called rarely by the third (a step of seven joints takes 5 to 25 % longer without); the fourth makes one
instruction of a root of many runs.

NaN and infinities keep their meaning: no -ffast-math, no -ffinite-math-only.  The headers are C's: C++ makes of `math.h` a tenth of a
second more to read."""
TIMEOUT = 300.0
"""Seconds that a compiler may take."""
VERSION_TIMEOUT = 20.0
"""Seconds that it may take to say its version."""
MOST_TEXT = 1 << 20
"""Bytes of a compiler's text that are read."""
MOST_THREADS = 256
"""Threads that a kernel takes at most (`c/driver.h`)."""
DIGEST = hashlib.sha256
"""Of the key and the content, at the end of every kept file."""


class ToolchainError(Exception):
    """No compiler, or it failed, or there is no safe place for its result; the message is one line for the user."""


class StoppedError(ToolchainError):
    """Stopped by this process itself: another try may do."""


def compiler() -> str:
    """The path of a C++ compiler: $CXX if it is set, else c++, g++ or clang++; ToolchainError if there is none."""
    wanted = os.environ.get("CXX")
    for name in [wanted] if wanted else ["c++", "g++", "clang++"]:
        path = shutil.which(name)
        if path:
            return path
    raise ToolchainError("there is no C++ compiler" + (f" {wanted!r} ($CXX)" if wanted else " (c++, g++, clang++)"))


def _version(path: str) -> str:
    """What a compiler says of itself in its first line."""
    try:
        version = _version_of(path, os.stat(path).st_mtime_ns)
    except OSError as error:
        raise ToolchainError(f"{Path(path).name} could not be run: {error.strerror}") from None
    if isinstance(version, ToolchainError):
        raise version
    return version


@cache
def _version_of(path: str, changed: int) -> str | ToolchainError:
    """The version, or why there is none: a compiler that hangs is asked once."""
    try:
        lines = _run([path, "--version"], "stdout", VERSION_TIMEOUT).decode().splitlines()
    except ToolchainError as error:
        return error
    except UnicodeDecodeError:
        return ToolchainError(f"{Path(path).name} --version prints what is no text")
    return next((line.strip() for line in lines if line.strip()), None) or ToolchainError(f"{Path(path).name} --version prints nothing")


def built_for() -> dict[str, str]:
    """What a kernel is tied to, in words; ToolchainError if there is no compiler."""
    found, path = processor(), compiler()
    names = [line.partition(":")[2].strip() for line in found.splitlines() if line.startswith(("model name", "CPU part"))]
    features = hashlib.sha256(found.encode()).hexdigest()[:8]
    return {"processor": f"{', '.join(names) or platform.machine()}, features {features}", "compiler": f"{_version(path)}, {path}"}


_running: set[int] = set()
"""Compilers that run now."""
_making: dict[str, threading.Lock] = {}
"""Key -> the lock of who makes it."""
_failures: dict[str, ToolchainError] = {}
"""Key -> why a thread that built it ahead could not."""
_this_thread = threading.local()


def stop_compilers() -> None:
    """Kills every compiler that this process has started."""
    for pid in tuple(_running):
        _running.discard(pid)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)


AT_END.append(stop_compilers)
atexit.register(stop_compilers)


def build_ahead(source: str, extra: tuple[str, ...] = ()) -> None:
    """Starts `built` beside what this process does meanwhile; whoever wants the result waits for it, and is told what went wrong."""

    def build() -> None:
        _this_thread.is_ahead = True
        with contextlib.suppress(ToolchainError):
            built(source, extra)

    threading.Thread(target=build, daemon=True).start()


def _run(command: list[str], stream: str, seconds: float) -> bytes:
    """What a command says on one of its streams; ToolchainError if it fails, or takes too long, it and all that it has started."""
    name, said = Path(command[0]).name, list[bytes]()
    out, err = (subprocess.PIPE if stream == x else subprocess.DEVNULL for x in ("stdout", "stderr"))
    try:
        process = subprocess.Popen(command, start_new_session=True, stdin=subprocess.DEVNULL, stdout=out, stderr=err)
    except (OSError, ValueError) as error:
        raise ToolchainError(f"{name} could not be run: {error}") from None

    def listen() -> None:
        with getattr(process, stream) as pipe:
            said.append(pipe.read(MOST_TEXT))

    _running.add(process.pid)
    listener, end = threading.Thread(target=listen, daemon=True), time.monotonic() + seconds
    listener.start()
    try:
        listener.join(seconds)
        code = process.wait(max(0.0, end - time.monotonic()))
    except BaseException as error:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        if isinstance(error, subprocess.TimeoutExpired):
            raise ToolchainError(f"{name} took longer than {seconds:g} s and was stopped") from None
        raise
    finally:
        stopped = process.pid not in _running
        _running.discard(process.pid)
    if stopped:
        raise StoppedError(f"{name} was stopped")
    text = said[0] if said else b""
    if code:
        lines = text.decode(errors="replace").splitlines()
        named = [line for line in lines if "error" in line] or lines or ["no message"]
        raise ToolchainError(f"{name} failed: " + (f"ended by signal {-code}" if code < 0 else named[0][:200]))
    return text


def built(source: str, extra: tuple[str, ...] = ()) -> tuple[Path, str]:
    """The shared library of a source and its key, compiled unless it is in the cache; ToolchainError on failure."""
    path = compiler()
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    flags = [*COMPILER_FLAGS, *extra]
    content = [source, *flags, path, _version(path), processor(), header.read_text()]

    def compile_to(result: Path) -> None:
        text = result.with_suffix(".cc")
        text.write_text(source)
        with told(f"{Path(path).name} is compiling a step of {source.count(chr(10)):,} lines: once, the result is kept"):
            _run([path, *flags, f"-I{jax.ffi.include_dir()}", str(text), "-o", str(result), "-lm", "-ldl"], "stderr", TIMEOUT)

    return kept(content, ".so", compile_to)


def kept(content: Iterable[str], suffix: str, make: Callable[[Path], object]) -> tuple[Path, str]:
    """The file that holds what `make(path)` writes, and the key of its content; made unless it is in the cache, whole and this user's.

    Raises:
      ToolchainError: it cannot be made, or there is no safe place or no room for it.
    """
    key = hashlib.sha256("\0".join(content).encode()).hexdigest()[:32]
    try:
        folder = directory()
    except OSError as error:
        raise ToolchainError(str(error)) from None
    path = folder / f"{key}{suffix}"
    with _made_once(key):
        _keep(folder, path, make)
    return path, key


@contextlib.contextmanager
def _made_once(key: str) -> Iterator[None]:
    """Waits while another thread makes the same; who stops waiting stops the compilers.

    Raises:
      ToolchainError: what kept `build_ahead` from making it, once.
    """
    waiting = True
    try:
        with _making.setdefault(key, threading.Lock()):
            waiting = False
            if key in _failures:
                raise _failures.pop(key)
            try:
                yield
            except ToolchainError as error:
                if getattr(_this_thread, "is_ahead", False) and not isinstance(error, StoppedError):
                    _failures[key] = error
                raise
    except BaseException:
        if waiting:
            stop_compilers()
        raise


def _keep(folder: Path, path: Path, make: Callable[[Path], object]) -> None:
    """Makes a file of `kept` unless it is there."""
    try:
        if _checked(path) is None:
            for left in folder.glob("tmp????????"):  # of version 0.1.0
                remove_abandoned(left, lockable=False)
            with draft(folder, "kernel") as work:
                made = work / f"made{path.suffix}"
                make(made)
                image = _read(made)
                if not image:
                    raise ToolchainError("the compiler left no file")
                _write(work, image, path)
    except OSError as error:
        raise ToolchainError(f"the cache {folder} cannot be used: {error}") from None


def _write(folder: Path, image: bytes, path: Path) -> None:
    """Puts a file with its digest into its place, from a draft, and on to the disk's surface."""
    whole = folder / "whole"
    file = os.open(whole, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o700)
    with open(file, "wb") as out:
        os.fchmod(file, 0o700)
        out.write(image + DIGEST(path.stem.encode() + image).digest())
        out.flush()
        os.fsync(file)
    if path.is_dir() and not path.is_symlink():
        path.rename(folder / "in the way")
    whole.replace(path)
    parent = os.open(path.parent, os.O_RDONLY)
    with contextlib.suppress(OSError):  # not every disk can do that for a directory
        os.fsync(parent)
    os.close(parent)


def _read(path: Path, forbidden: int = 0) -> bytes | None:
    """The bytes of a file; None if it is none of this user's, or has a bit of `forbidden` in its mode."""
    try:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)  # neither follows a link nor waits at a pipe
        with open(file, "rb") as opened:
            status = os.fstat(file)
            fits = stat.S_ISREG(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & forbidden
            return opened.read() if fits else None
    except OSError:
        return None


def _checked(path: Path) -> bytes | None:
    """What a kept file holds; None if it is not there, not whole, of another key, or could have been written by another user."""
    whole, size = _read(path, forbidden=0o022) or b"", DIGEST().digest_size
    image, digest = whole[:-size], whole[-size:]
    return image if DIGEST(path.stem.encode() + image).digest() == digest else None


def content_of(path: Path) -> bytes:
    """What a file of `kept` holds; ToolchainError if it has been damaged since."""
    image = _checked(path)
    if image is None:
        raise ToolchainError(f"the kernel {path} was damaged just now")
    return image


_libraries: dict[str, ctypes.CDLL] = {}
"""Key -> what this process has loaded of it: once, as XLA takes one address for a name."""


def loaded(library: Path, *names: str) -> ctypes.CDLL:
    """A library of `built` in this process, from a copy that nobody can change; ToolchainError if it does not load or lacks a name."""
    key = library.stem
    try:
        found = _libraries[key] if key in _libraries else _load(content_of(library))
        for name in names:
            getattr(found, name)
    except (OSError, AttributeError) as error:
        with contextlib.suppress(OSError):
            library.unlink()  # the compiler may do better another time
        raise ToolchainError(f"a kernel does not load: {error}") from None
    return _libraries.setdefault(key, found)


def _load(image: bytes) -> ctypes.CDLL:
    """A library from its bytes."""
    file = None
    try:
        file = os.memfd_create("iblf_jax")
        with open(file, "wb", closefd=False) as out:
            out.write(image)
        return ctypes.CDLL(f"/proc/self/fd/{file}")  # and stays open: the loader takes another library of this name for this one
    except (OSError, AttributeError):  # no such files on this system, or none that may be executed
        if file is not None:
            os.close(file)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kernel.so"
        path.write_bytes(image)
        return ctypes.CDLL(str(path))


def processors() -> int:
    """Processors that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads() -> int:
    """Threads that a kernel may use: $IBLF_JAX_THREADS, else the process's processors, divided among its CPU devices.

    What is no whole number from 1 to 256 is warned of: a larger one counts as 256, anything else as not given.
    """
    wanted = os.environ.get("IBLF_JAX_THREADS", "")
    usual = max(1, processors() // jax.local_device_count("cpu"))
    number = wanted.lstrip("0") if wanted.isascii() and wanted.isdigit() else ""
    if not wanted or (0 < len(number) < 10 and int(number) <= MOST_THREADS):
        return int(number) if wanted else usual
    chosen = MOST_THREADS if number else usual
    expected = f"expected a whole number from 1 to {MOST_THREADS}. Running with {chosen} threads."
    notices.warn(f"IBLF_JAX_THREADS: got {wanted[:40]!r}, {expected}")
    return chosen
