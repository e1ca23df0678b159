"""The C++ compiler: found, run without a shell, its results kept by content in a directory that
only the user can write.

It is the system's, GCC or Clang, or Clang as the wheel `ziglang` brings it.  The flags depend on
which of them it is, which its version text tells; each compiler prints that text once in a process.

The key of a kernel is a hash of its source, the flags, the compiler's version, the processor and
the header of XLA's interface, so a stale kernel is never loaded.  A kernel is made in a draft,
written out to the disk and renamed, so that two processes do not disturb each other.  A digest of
key and content stands at its end: a file that does not fit it, for whatever reason, is made again,
  and what is loaded is a copy of what was checked.  Nothing here follows a symbolic link that it
  finds in the directory.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax

from iblf_jax.kernels.caches import CACHES
from iblf_jax.kernels.drafts import draft, remove_abandoned
from iblf_jax.kernels.folder import directory, processor
from iblf_jax.kernels.messages import announce_if_slow

COMMON_FLAGS = (
    "-x", "c++", "-std=gnu++17", "-nostdinc++", "-O1", "-fPIC", "-shared", "-pthread",
    "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast",
    "-fno-exceptions", "-fno-rtti", "-fvisibility=hidden", "-w",
)  # fmt: skip
"""Flags that GCC and Clang share.

NaN and infinities keep their meaning: no -ffast-math, no -ffinite-math-only.  Without
  `-ffp-contract=fast`, which makes one
operation of a product and a sum, the sine of a large angle would lose digits.  The headers are C's:
C++ makes of `math.h` a tenth of a second more to read."""
FLAGS_OF_KIND = {
    "gcc": ("-fexpensive-optimizations", "-fcaller-saves", "-ftree-loop-vectorize"),
    "clang": ("-fvectorize", "-fslp-vectorize", "-fno-sanitize=undefined", "-nostdlib++"),
    "other": (),
}
"""Flags that only one kind of compiler knows, by kind.

GCC: of -O3 what the generated text gains by.  The paper's loop runs as fast (1 % either way, one
  run 3 % slower) and builds in
0.6 s instead of 2.7.  The first flag is needed for products and sums to become one operation; with
the second, numbers stay in registers across rare calls (a step of seven joints takes 5 to 25 %
longer without); the third makes one instruction of a root of many runs.

Clang: the first two make one instruction of a root of many runs.  `ziglang` adds checks of
  undefined behaviour to what is not
optimised, and its own C++ library, of which a kernel uses nothing; the other two flags leave both
out."""
TIMEOUT = 300.0
"""Seconds that a compiler may take."""
VERSION_TIMEOUT = 20.0
"""Seconds that it may take to say its version."""
MOST_TEXT = 1 << 20
"""Bytes of a compiler's text that are read."""
DIGEST = hashlib.sha256
"""Of the key and the content, at the end of every kept file."""


class ToolchainError(Exception):
    """No compiler, or it failed, or there is no safe place for its result; the message is one line
    for the user.
    """


class StoppedError(ToolchainError):
    """Stopped by this process itself: another try may do."""


def compiler() -> tuple[str, ...]:
    """The command of a C++ compiler: $CXX if it is set, else c++, g++, clang++ or that of the wheel
    `ziglang`.

    Raises:
      ToolchainError: there is none.
    """
    wanted = os.environ.get("CXX")
    if wanted:
        return _command_of(wanted)
    for name in ("c++", "g++", "clang++"):
        path = shutil.which(name)
        if path:
            return (path,)
    if has_ziglang():
        return ziglang("c++")
    raise ToolchainError(
        "there is no C++ compiler (c++, g++, clang++; pip install ziglang has one)"
    )


def _command_of(wanted: str) -> tuple[str, ...]:
    """The command that $CXX names: a program, or a program and its first arguments."""
    path = shutil.which(wanted)
    if path:
        return (path,)
    with contextlib.suppress(ValueError):  # an open quotation mark
        program, *arguments = shlex.split(wanted) or [""]
        path = shutil.which(program)
        if path:
            return (path, *arguments)
    raise ToolchainError(f"there is no C++ compiler {wanted!r} ($CXX)")


def has_ziglang() -> bool:
    """Whether the wheel `ziglang`, which holds Clang, is installed."""
    return importlib.util.find_spec("ziglang") is not None


def ziglang(language: str) -> tuple[str, ...]:
    """The command of ziglang's compiler for a language, "cc" or "c++"."""
    return (sys.executable, "-m", "ziglang", language)


def _name_of(command: Sequence[str]) -> str:
    """What messages call a compiler."""
    return "ziglang" if tuple(command[1:3]) == ("-m", "ziglang") else Path(command[0]).name


class Version(NamedTuple):
    """What a compiler prints about itself."""

    line: str
    """The first line of it."""
    kind: str
    """A key of FLAGS_OF_KIND."""

    @staticmethod
    def of(text: str) -> Version | None:
        """From the whole text; None if there is nothing in it."""
        line = next((line.strip() for line in text.splitlines() if line.strip()), None)
        if line is None:
            return None
        if "Free Software Foundation" in text:
            return Version(line, "gcc")
        # All compilers that are made of Clang name the folder that they are installed in.
        is_clang = "clang" in text.lower() or "InstalledDir:" in text
        return Version(line, "clang" if is_clang else "other")


def _version(command: tuple[str, ...]) -> Version:
    """The version of a compiler; ToolchainError if it prints none."""
    try:
        version = _version_of(command, os.stat(command[0]).st_mtime_ns)
    except OSError as error:
        raise ToolchainError(f"{_name_of(command)} could not be run: {error.strerror}") from None
    if isinstance(version, ToolchainError):
        raise version
    return version


@CACHES.function(maxsize=16)
def _version_of(command: tuple[str, ...], changed: int) -> Version | ToolchainError:
    """The version, or why there is none: a compiler that hangs is started once."""
    try:
        text = _run([*command, "--version"], "stdout", VERSION_TIMEOUT).decode()
    except ToolchainError as error:
        return error
    except UnicodeDecodeError:
        return ToolchainError(f"{_name_of(command)} --version prints what is no text")
    return Version.of(text) or ToolchainError(f"{_name_of(command)} --version prints nothing")


def flags_of(kind: str) -> tuple[str, ...]:
    """The flags of a kernel for a kind of compiler, a key of FLAGS_OF_KIND."""
    is_arm = platform.machine().lower() in ("arm64", "aarch64")
    # Clang before version 16 does not know the first form there.
    processor_flag = "-mcpu=native" if is_arm and kind == "clang" else "-march=native"
    return (*COMMON_FLAGS, processor_flag, *FLAGS_OF_KIND[kind])


def built_for() -> dict[str, str]:
    """What a kernel is tied to, in words; ToolchainError if there is no compiler."""
    found = processor()
    command = compiler()
    names = [
        line.partition(":")[2].strip()
        for line in found.splitlines()
        if line.startswith(("model name", "CPU part"))
    ]
    features = hashlib.sha256(found.encode()).hexdigest()[:8]
    return {
        "processor": f"{', '.join(names) or platform.machine()}, features {features}",
        "compiler": f"{_version(command).line}, {shlex.join(command)}",
    }


_this_thread = threading.local()


def stop_compilers() -> None:
    """Kills every compiler that this process has started."""
    for pid in tuple(CACHES.running):
        CACHES.running.discard(pid)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)


atexit.register(stop_compilers)


def build_ahead(source: str, extra: tuple[str, ...] = ()) -> None:
    """Starts `built` beside what this process does meanwhile; whoever wants the result waits for
    it, and is told what went wrong.
    """

    def build() -> None:
        _this_thread.is_ahead = True
        with contextlib.suppress(ToolchainError):
            built(source, extra)

    threading.Thread(target=build, daemon=True).start()


def _run(command: list[str], stream: str, seconds: float) -> bytes:
    """What a command says on one of its streams; ToolchainError if it fails, or takes too long, it
    and all that it has started.
    """
    name = _name_of(command)
    said = list[bytes]()
    out, err = (
        subprocess.PIPE if stream == x else subprocess.DEVNULL for x in ("stdout", "stderr")
    )
    try:
        process = subprocess.Popen(
            command, start_new_session=True, stdin=subprocess.DEVNULL, stdout=out, stderr=err
        )
    except (OSError, ValueError) as error:
        raise ToolchainError(f"{name} could not be run: {error}") from None

    def listen() -> None:
        with getattr(process, stream) as pipe:
            said.append(pipe.read(MOST_TEXT))

    CACHES.running.add(process.pid)
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
        stopped = process.pid not in CACHES.running
        CACHES.running.discard(process.pid)
    if stopped:
        raise StoppedError(f"{name} was stopped")
    text = said[0] if said else b""
    if code:
        lines = text.decode(errors="replace").splitlines()
        named = [line for line in lines if "error" in line] or lines or ["no message"]
        raise ToolchainError(
            f"{name} failed: " + (f"ended by signal {-code}" if code < 0 else named[0][:200])
        )
    return text


def built(source: str, extra: tuple[str, ...] = ()) -> tuple[Path, str]:
    """The shared library of a source and its key, compiled unless it is in the cache;
    ToolchainError on failure.
    """
    command = compiler()
    version = _version(command)
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    flags = [*flags_of(version.kind), *extra]
    content = [source, *flags, *command, version.line, processor(), header.read_text()]

    def compile_to(result: Path) -> None:
        text = result.with_suffix(".cc")
        text.write_text(source)
        files = [f"-I{jax.ffi.include_dir()}", str(text), "-o", str(result), "-lm", "-ldl"]
        lines = source.count("\n")
        with announce_if_slow(
            f"{_name_of(command)} is compiling a step of {lines:,} lines: once, the result is kept"
        ):
            _run([*command, *flags, *files], "stderr", TIMEOUT)

    return kept(content, ".so", compile_to)


def kept(content: Iterable[str], suffix: str, make: Callable[[Path], object]) -> tuple[Path, str]:
    """The file that holds what `make(path)` writes, and the key of its content; made unless it is
    in the cache, whole and this user's.

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
        with CACHES.locks.setdefault(key, threading.Lock()):
            waiting = False
            if key in CACHES.failures:
                raise CACHES.failures.pop(key)
            try:
                yield
            except ToolchainError as error:
                if getattr(_this_thread, "is_ahead", False) and not isinstance(error, StoppedError):
                    CACHES.failures[key] = error
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
    """The bytes of a file; None if it is none of this user's, or has a bit of `forbidden` in its
    mode.
    """
    try:
        file = os.open(
            path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
        )  # neither follows a link nor waits at a pipe
        with open(file, "rb") as opened:
            status = os.fstat(file)
            fits = (
                stat.S_ISREG(status.st_mode)
                and status.st_uid == os.getuid()
                and not status.st_mode & forbidden
            )
            return opened.read() if fits else None
    except OSError:
        return None


def _checked(path: Path) -> bytes | None:
    """What a kept file holds; None if it is not there, not whole, of another key, or could have
    been written by another user.
    """
    whole, size = _read(path, forbidden=0o022) or b"", DIGEST().digest_size
    image, digest = whole[:-size], whole[-size:]
    return image if DIGEST(path.stem.encode() + image).digest() == digest else None


def content_of(path: Path) -> bytes:
    """What a file of `kept` holds; ToolchainError if it has been damaged since."""
    image = _checked(path)
    if image is None:
        raise ToolchainError(f"the kernel {path} was damaged just now")
    return image


def loaded(library: Path, *names: str) -> ctypes.CDLL:
    """A library of `built` in this process, from a copy that nobody can change; ToolchainError if
    it does not load or lacks a name.
    """
    key = library.stem
    try:
        found = CACHES.libraries[key] if key in CACHES.libraries else _load(content_of(library))
        for name in names:
            getattr(found, name)
    except (OSError, AttributeError) as error:
        with contextlib.suppress(OSError):
            library.unlink()  # the compiler may do better another time
        raise ToolchainError(f"a kernel does not load: {error}") from None
    return CACHES.libraries.setdefault(key, found)


def _load(image: bytes) -> ctypes.CDLL:
    """A library from its bytes."""
    file = None
    try:
        file = os.memfd_create("iblf_jax")
        with open(file, "wb", closefd=False) as out:
            out.write(image)
        return ctypes.CDLL(
            f"/proc/self/fd/{file}"
        )  # and stays open: the loader takes another library of this name for this one
    except (OSError, AttributeError):  # no such files on this system, or none that may be executed
        if file is not None:
            os.close(file)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kernel.so"
        path.write_bytes(image)
        return ctypes.CDLL(str(path))
