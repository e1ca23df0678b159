"""Finds and runs the C++ compiler, and keeps its results in a directory that only the user can
write.

The compiler is the system's (GCC or Clang) or, where there is none, Clang from the package
`ziglang`. It is run without a shell. The flags depend on the kind of compiler, which its version
text shows; each compiler prints this text once in a process.

The key of a kernel is a hash of its source, the flags, the compiler's version, the processor and
the header of XLA's interface, so a stale kernel is never loaded. A kernel is compiled in a draft,
written to the disk and renamed, so that two processes do not disturb each other. A digest of key
and content is at the end of the file: a file that does not match its digest is compiled again, and
the process loads a copy of the bytes that were verified. No symbolic link in the directory is
followed.
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
from typing import Any, NamedTuple

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

NaN and infinities keep their meaning: there is no -ffast-math and no -ffinite-math-only.
`-ffp-contract=fast` combines a product and a sum in one operation; without it, the sine of a large
angle would lose digits. `-nostdinc++` selects the headers of C: the `math.h` of C++ takes a tenth
of a second longer to read."""
FLAGS_OF_KIND = {
    "gcc": (
        "-fexpensive-optimizations",
        "-fcaller-saves",
        "-ftree-loop-vectorize",
        "-fno-dse",
        "-fno-tree-dse",
        "-fno-forward-propagate",
        "-fno-tree-sink",
        "-fno-guess-branch-probability",
    ),
    "clang": ("-fvectorize", "-fslp-vectorize", "-fno-sanitize=undefined", "-nostdlib++"),
    "other": (),
}
"""Flags that only one kind of compiler accepts, by kind.

GCC: the optimisations of -O3 from which the generated text gains. The paper's loop runs as fast as
with -O3 (within 1 %, a single run 3 % slower) and is compiled in 0.6 s instead of 2.7 s. The first
flag is necessary for products and sums to become one operation. With the second, numbers stay in
registers across rare calls (a step of seven joints takes 5 to 25 % longer without it). The third
makes the square roots of many runs one instruction. The others switch off passes from which the
generated text gains nothing: a step with 21 tangents of seven joints compiles in 13.6 s instead of
18.4 s, the paper's loop in 0.45 s instead of 0.52 s, and both run as fast as with them.

Clang: the first two flags make the square roots of many runs one instruction. `ziglang` adds checks
of undefined behaviour to code that is not optimised, and its own C++ library, of which a kernel
uses nothing; the other two flags exclude both."""
TIMEOUT = 300.0
"""Time limit of a compiler [s]."""
VERSION_TIMEOUT = 20.0
"""Time limit for printing its version [s]."""
MAX_TEXT = 1 << 20
"""Bytes of a compiler's text that are read, at most."""
DIGEST = hashlib.sha256
"""The digest of key and content at the end of every file."""


class ToolchainError(Exception):
    """There is no compiler, or it failed, or there is no safe place for its result.

    The message is one line for the user.
    """


class StoppedError(ToolchainError):
    """The compiler was stopped by this process: another attempt may succeed."""


def compiler() -> tuple[str, ...]:
    """The command of a C++ compiler: $CXX if it is set, else c++, g++, clang++ or that of the wheel
    `ziglang`.

    Raises:
      ToolchainError: there is none.
    """
    requested = os.environ.get("CXX")
    if requested:  # a program, or a program and its first arguments
        path = shutil.which(requested)
        if path:
            return (path,)
        with contextlib.suppress(ValueError):  # an open quotation mark
            program, *arguments = shlex.split(requested) or [""]
            path = shutil.which(program)
            if path:
                return (path, *arguments)
        raise ToolchainError(f"there is no C++ compiler {requested!r} ($CXX)")
    for name in ("c++", "g++", "clang++"):
        path = shutil.which(name)
        if path:
            return (path,)
    if has_ziglang():
        return ziglang("c++")
    raise ToolchainError(
        "there is no C++ compiler (c++, g++, clang++); install one, or `pip install"
        ' "iblf_jax[export]"`, which contains one'
    )


def has_ziglang() -> bool:
    """Whether the package `ziglang`, which contains Clang, is installed."""
    return importlib.util.find_spec("ziglang") is not None


def ziglang(language: str) -> tuple[str, ...]:
    """The command of ziglang's compiler for a language, "cc" or "c++"."""
    return (sys.executable, "-m", "ziglang", language)


def _name_of(command: Sequence[str]) -> str:
    """The name of a compiler in messages."""
    if tuple(command[1:3]) == ("-m", "ziglang"):
        return "ziglang"
    return Path(command[0]).name


class Version(NamedTuple):
    """The text that a compiler prints about itself."""

    line: str
    """The first line."""
    kind: str
    """A key of FLAGS_OF_KIND."""

    @staticmethod
    def of(text: str) -> Version | None:
        """The version from the entire text; None if the text is empty."""
        line = next((line.strip() for line in text.splitlines() if line.strip()), None)
        if line is None:
            return None
        if "Free Software Foundation" in text:
            return Version(line, "gcc")
        # All compilers that are derived from Clang print the folder of their installation.
        if "clang" in text.lower() or "InstalledDir:" in text:
            return Version(line, "clang")
        return Version(line, "other")


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
    """The version, or the error: a compiler that does not answer is started once."""
    try:
        text = _run([*command, "--version"], "stdout", VERSION_TIMEOUT).decode()
    except StoppedError:
        raise  # this process stopped it, so its answer is not known
    except ToolchainError as error:
        return error
    except UnicodeDecodeError:
        return ToolchainError(f"{_name_of(command)} --version prints no text in UTF-8")
    return Version.of(text) or ToolchainError(f"{_name_of(command)} --version prints nothing")


def flags_of(kind: str) -> tuple[str, ...]:
    """The flags of a kernel for a kind of compiler, a key of FLAGS_OF_KIND."""
    is_arm = platform.machine().lower() in ("arm64", "aarch64")
    processor_flag = "-march=native"
    if is_arm and kind == "clang":
        # There, Clang before version 16 accepts only this form.
        processor_flag = "-mcpu=native"
    return (*COMMON_FLAGS, processor_flag, *FLAGS_OF_KIND[kind])


def built_for() -> dict[str, str]:
    """Processor and compiler of the kernels, in words; ToolchainError if there is no compiler."""
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


class _ThisThread(threading.local):
    is_ahead = False
    """Whether the thread compiles something before it is needed."""

    def __init__(self) -> None:
        self.needed_by: object = object()
        """Mark of the thread that needs what this one compiles: of another one if it is ahead."""


_this_thread = _ThisThread()


def stop_compilers() -> None:
    """Kills every compiler that this process has started."""
    _stop(tuple(CACHES.running))


def stop_own_compilers() -> None:
    """Kills the compilers that this thread has started, also those that it has started ahead.

    A thread that waits for one of their kernels compiles it itself.
    """
    mark = _this_thread.needed_by
    _stop([pid for pid, needed_by in tuple(CACHES.running.items()) if needed_by is mark])


def _stop(pids: Iterable[int]) -> None:
    for pid in pids:
        CACHES.running.pop(pid, None)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)


atexit.register(stop_compilers)


def build_ahead(source: str, extra: tuple[str, ...] = ()) -> None:
    """Starts `built` in the background; a later call of `built` waits for it, and raises its
    error.
    """
    needed_by = _this_thread.needed_by

    def build() -> None:
        _this_thread.is_ahead = True
        _this_thread.needed_by = needed_by
        with contextlib.suppress(ToolchainError):
            built(source, extra)

    threading.Thread(target=build, daemon=True).start()


def _run(command: list[str], stream: str, seconds: float) -> bytes:
    """The text that a command writes to one of its streams, "stdout" or "stderr".

    Raises:
      ToolchainError: it fails, or it takes longer than the given time; then the command and all
        processes that it has started are stopped.
    """
    name = _name_of(command)
    received: list[bytes] = []
    streams = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, stream: subprocess.PIPE}
    try:
        process = subprocess.Popen(
            command,
            start_new_session=True,
            stdin=subprocess.DEVNULL,
            stdout=streams["stdout"],
            stderr=streams["stderr"],
        )
    except (OSError, ValueError) as error:
        raise ToolchainError(f"{name} could not be run: {error}") from None

    def listen() -> None:
        pipe: Any = {"stdout": process.stdout, "stderr": process.stderr}[stream]
        with pipe:
            received.append(pipe.read(MAX_TEXT))

    CACHES.running[process.pid] = _this_thread.needed_by
    listener = threading.Thread(target=listen, daemon=True)
    end = time.monotonic() + seconds
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
        CACHES.running.pop(process.pid, None)
    if stopped:
        raise StoppedError(f"{name} was stopped")
    text = b"".join(received)
    if code < 0:
        raise ToolchainError(f"{name} failed: ended by signal {-code}")
    if code:
        lines = text.decode(errors="replace").splitlines()
        errors = [line for line in lines if "error" in line] or lines or ["no message"]
        raise ToolchainError(f"{name} failed: {errors[0][:200]}")
    return text


def built(source: str, extra: tuple[str, ...] = ()) -> tuple[Path, str]:
    """The shared library of a source and its key; it is compiled unless it is in the cache.

    Args:
      source: the C++ source.
      extra: flags of the compiler, besides those of all kernels.

    Raises:
      ToolchainError: no compiler, or an error from it.
    """
    command = compiler()
    flags = [*flags_of(_version(command).kind), *extra]
    content = [source, *extra, *compiler_key()]

    def compile_to(result: Path) -> None:
        text = result.with_suffix(".cc")
        text.write_text(source)
        files = [f"-I{jax.ffi.include_dir()}", str(text), "-o", str(result), "-lm", "-ldl"]
        lines = source.count("\n")
        with announce_if_slow(
            f"{_name_of(command)} is compiling a step of {lines:,} lines: once, the result is kept"
        ):
            _run([*command, *flags, *files], "stderr", TIMEOUT)

    return cached_file(content, ".so", compile_to)


def compiler_key() -> tuple[str, ...]:
    """What decides, beside its source, how a kernel is compiled; ToolchainError if there is no
    compiler.
    """
    command = compiler()
    version = _version(command)
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    return (*flags_of(version.kind), *command, version.line, processor(), header.read_text())


def cached_file(
    content: Iterable[str], suffix: str, make: Callable[[Path], object]
) -> tuple[Path, str]:
    """A file of the cache and its key; `make(path)` writes the file unless it is in the cache,
    intact and owned by this user.

    Args:
      content: texts that determine the content of the file; the key is their hash.
      suffix: of the name of the file.
      make: function that writes the file to a given path.

    Raises:
      ToolchainError: the file cannot be made, or there is no safe place or no space for it.
    """
    path = cache_path(content, suffix)
    with _made_once(path.stem):
        _make_if_missing(path.parent, path, make)
    return path, path.stem


def cache_path(content: Iterable[str], suffix: str) -> Path:
    """The path of a file of the cache, which need not exist; arguments and errors as
    `cached_file`.
    """
    key = hashlib.sha256("\0".join(content).encode()).hexdigest()[:32]
    return cache_folder() / f"{key}{suffix}"


def cache_folder() -> Path:
    """The folder of the cache; ToolchainError if there is no safe place for it."""
    try:
        return directory()
    except OSError as error:
        raise ToolchainError(str(error)) from None


@contextlib.contextmanager
def _made_once(key: str) -> Iterator[None]:
    """Waits while another thread makes the same file; an interrupted wait stops the compilers of
    this thread.

    Raises:
      ToolchainError: the error of `build_ahead`, once.
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
                if _this_thread.is_ahead and not isinstance(error, StoppedError):
                    CACHES.failures[key] = error
                raise
    except BaseException:
        if waiting:
            stop_own_compilers()
        raise


def _make_if_missing(folder: Path, path: Path, make: Callable[[Path], object]) -> None:
    """Makes a file of the cache unless an intact one exists."""
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
    """Moves a file with its digest from a draft to its place, and flushes it to the disk."""
    complete = folder / "complete"
    file = os.open(complete, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o700)
    with open(file, "wb") as out:
        os.fchmod(file, 0o700)
        out.write(image + DIGEST(path.stem.encode() + image).digest())
        out.flush()
        os.fsync(file)
    if path.is_dir() and not path.is_symlink():
        path.rename(folder / "in the way")
    complete.replace(path)
    parent = os.open(path.parent, os.O_RDONLY)
    with contextlib.suppress(OSError):  # not every file system supports this for a directory
        os.fsync(parent)
    os.close(parent)


def _read(path: Path, forbidden: int = 0) -> bytes | None:
    """The bytes of a file; None if it is not a file of this user, or has a bit of `forbidden` in
    its mode.
    """
    # Do not follow a link, and do not wait for a pipe.
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
    try:
        with open(os.open(path, flags), "rb") as file:
            status = os.fstat(file.fileno())
            is_own = stat.S_ISREG(status.st_mode) and status.st_uid == os.getuid()
            if is_own and not status.st_mode & forbidden:
                return file.read()
    except OSError:
        pass
    return None


def _checked(path: Path) -> bytes | None:
    """The content of a file of the cache; None if it is missing, incomplete, of another key, or
    could have been written by another user.
    """
    content = _read(path, forbidden=0o022) or b""
    size = DIGEST().digest_size
    image = content[:-size]
    digest = content[-size:]
    if DIGEST(path.stem.encode() + image).digest() != digest:
        return None
    return image


def content_of(path: Path) -> bytes:
    """The content of a file of `cached_file`; ToolchainError if it has been damaged since."""
    image = _checked(path)
    if image is None:
        raise ToolchainError(f"the kernel {path} was damaged just now")
    return image


def loaded(library: Path, *names: str) -> ctypes.CDLL:
    """Loads a library of `built`, from a copy that no other process can change.

    Raises:
      ToolchainError: it cannot be loaded, or lacks one of the names.
    """
    key = library.stem
    try:
        found = CACHES.libraries.get(key) or _load(content_of(library))
        for name in names:
            found[name]  # raises AttributeError if the library lacks it
    except (OSError, AttributeError) as error:
        with contextlib.suppress(OSError):
            library.unlink()  # the next compilation may succeed
        raise ToolchainError(f"a kernel does not load: {error}") from None
    return CACHES.libraries.setdefault(key, found)


def _load(image: bytes) -> ctypes.CDLL:
    """A library from its bytes; it takes five memory maps, and no file stays open."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kernel.so"
        try:
            file = os.memfd_create("iblf_jax")
        except (OSError, AttributeError):  # this system has no files in memory
            path.write_bytes(image)
            return ctypes.CDLL(str(path))
        with open(file, "wb") as out:
            out.write(image)
            out.flush()
            try:
                # By a name of its own: the loader would take another library of the name
                # /proc/self/fd/... for this one.
                path.symlink_to(f"/proc/self/fd/{file}")
                return ctypes.CDLL(str(path))
            except OSError:  # files in memory are not executable here
                path.unlink(missing_ok=True)
        path.write_bytes(image)
        return ctypes.CDLL(str(path))
