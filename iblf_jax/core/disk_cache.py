"""The folder of compiled programs, which later processes reuse: those of XLA and our own kernels.

It is $XDG_CACHE_HOME/iblf_jax, or ~/.cache/iblf_jax; the programs of XLA have a folder in it for
each kind of processor. The first run of a process enables JAX's cache there, unless the user
has configured another folder or disabled the cache (JAX_ENABLE_COMPILATION_CACHE=0). When all
entries take more than MAX_BYTES, the least recently used ones are removed. The folder may be
deleted at any time.

JAX does not verify what it loads. Each of its entries in our folder therefore ends in a digest of
the entry's name and content. An entry that is damaged, belongs to another program or is not a file
is removed, and the program is compiled again.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import stat
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
from jax.experimental.compilation_cache.compilation_cache import reset_cache

from iblf_jax.core import notices
from iblf_jax.core.caches import memoised
from iblf_jax.kernels import cpuinfo, directory, processor

MAX_BYTES = 2 * 2**30
"""Largest size of all entries together."""
JAX_SUFFIX = "-cache"
"""Suffix of the names of JAX's entries."""
SUFFIXES = (JAX_SUFFIX, "-atime", ".so", ".cubin", ".program")
"""Suffixes of the names of entries that may be removed: JAX's and ours."""
DIGEST_SIZE = 32
"""Bytes of a digest."""
IN_USE = 3600.0
"""Seconds after its last use in which an entry stays: another process may be loading it."""


class VerifiedCache:
    """JAX's cache of compiled programs (`base`, in `folder`) with verified entries.

    It has the two methods that JAX calls: `get` and `put`.
    """

    def __init__(self, base: Any, folder: Path) -> None:
        self._base = base
        self._path = folder  # which JAX prints when it resets its cache
        self._thread = threading.local()

    @contextlib.contextmanager
    def unused(self) -> Iterator[None]:
        """Context manager in which the cache keeps nothing and has nothing, for this thread."""
        self._thread.is_unused = True
        try:
            yield
        finally:
            self._thread.is_unused = False

    def _is_unused(self) -> bool:
        return getattr(self._thread, "is_unused", False)

    def get(self, key: str) -> bytes | None:
        """The entry of a key; None, after its removal, if it is not what was put there."""
        if self._is_unused():
            return None
        path = self._path / f"{key}{JAX_SUFFIX}"
        try:
            is_file = stat.S_ISREG(path.lstat().st_mode)
        except OSError:
            return None
        # Only a file is opened: at a pipe, a reader waits.
        entry = None
        if is_file:
            entry = self._base.get(key)
        if entry is not None:
            image, digest = entry[:-DIGEST_SIZE], entry[-DIGEST_SIZE:]
            if digest == entry_digest(key, image):
                return image
        with contextlib.suppress(OSError):
            if stat.S_ISDIR(path.lstat().st_mode):
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()  # of a link, the link itself
        return None

    def put(self, key: str, value: bytes) -> None:
        """Keeps an entry."""
        if self._is_unused():
            return
        self._base.put(key, value + entry_digest(key, value))


def entry_digest(key: str, image: bytes) -> bytes:
    """The digest at the end of an entry, of its name and its content."""
    return hashlib.sha256(key.encode() + b"\0" + image).digest()


def _verify_entries(folder: Path) -> VerifiedCache | None:
    """Makes JAX use `VerifiedCache` for its folder, and returns it.

    JAX has no public function to set a cache. A release that keeps its cache elsewhere is not
    changed; its entries are then not verified, and `tests/kernels/test_toolchain.py` fails.
    """
    try:
        from jax._src import compilation_cache

        base, _ = compilation_cache.get_file_cache(str(folder))  # type: ignore[misc]
        holds_cache = hasattr(compilation_cache, "_cache") and hasattr(
            compilation_cache, "_cache_initialized"
        )
    except (ImportError, AttributeError, TypeError):
        return None
    if not holds_cache:
        return None
    cache = VerifiedCache(base, folder)
    compilation_cache._cache = cache  # type: ignore[assignment]
    compilation_cache._cache_initialized = True
    return cache


@memoised(1)
def keep_programs() -> VerifiedCache | None:
    """Removes old entries and enables JAX's cache on the disk, once per process; returns the cache.

    JAX's cache stays as it is where the user has configured or disabled it, or where no folder is
    safe.
    """
    try:
        top = directory()
        foreign = _not_ours(top)
        if foreign is None:
            _trim(top)  # kernels are here whatever JAX does
        config: Any = jax.config  # its fields are made when JAX starts
        if (
            config.jax_compilation_cache_dir is not None
            or not config.jax_enable_compilation_cache
            or _reloads_badly()
        ):
            return None
        # XLA's programs are for one kind of processor, which JAX does not check, and several
        # machines may share a home folder.
        folder = top / f"xla-{hashlib.sha256(processor().encode()).hexdigest()[:12]}"
        if foreign is None:
            folder.mkdir(mode=0o700, exist_ok=True)
            foreign = _not_ours(folder)
    except OSError:
        return None
    if foreign is not None:
        problem = f"{top} holds {foreign!r}, a link or of another user; remove it."
        notices.warn(f"compiled programs are not kept: {problem}")
    elif os.access(folder, os.W_OK | os.X_OK):
        config.update("jax_compilation_cache_dir", str(folder))
        config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        config.update("jax_persistent_cache_min_entry_size_bytes", -1)
        reset_cache()  # a program that JAX compiled earlier has made it decide to keep nothing
        return _verify_entries(folder)
    return None


def keeps_programs() -> bool:
    """Whether JAX keeps compiled programs in our folder now."""
    cache = keep_programs()
    config: Any = jax.config
    return (
        cache is not None
        and config.jax_enable_compilation_cache
        and config.jax_compilation_cache_dir == str(cache._path)
    )


def without_cache() -> contextlib.AbstractContextManager[None]:
    """Context manager in which JAX compiles anew: XLA cannot write an executable that it has read
    once more.
    """
    cache = keep_programs()
    assert cache is not None, "only where `keeps_programs`"
    return cache.unused()


def _reloads_badly() -> bool:
    """Whether XLA refuses to load its own programs on this processor, with a warning for each
    (github.com/jax-ml/jax/issues/38445).

    LLVM compiles with the tuning option "prefer no gather" for processors with the bug GDS, and XLA
    mistakes the option for a feature that the processor lacks.
    """
    return any(line.startswith("bugs") and "gds" in line.split() for line in cpuinfo())


def _entries(folder: Path) -> list[tuple[os.DirEntry, os.stat_result]]:
    """The entries of a folder with their status, that of the link itself for a link; entries that
    another process removes meanwhile are left out.
    """
    found = []
    with os.scandir(folder) as entries:
        for entry in entries:
            with contextlib.suppress(FileNotFoundError):
                found.append((entry, entry.stat(follow_symlinks=False)))
    return found


def _not_ours(folder: Path) -> str | None:
    """The name of an entry of a folder that is a link or that another user owns; None if there is
    none.
    """
    return next(
        (
            x.name
            for x, status in _entries(folder)
            if x.is_symlink() or status.st_uid != os.getuid()
        ),
        None,
    )


def _trim(folder: Path) -> None:
    """Removes the least recently used entries until the rest is small enough."""
    top = _entries(folder)
    entries = list(top)
    for x, _ in top:
        if x.name.startswith("xla-") and x.is_dir(follow_symlinks=False):
            entries += _entries(Path(x.path))
    kept = [
        (max(status.st_atime, status.st_mtime), status.st_size, x.path)
        for x, status in entries
        if x.name.endswith(SUFFIXES)
    ]
    size = sum(bytes_of_one for _, bytes_of_one, _ in kept)
    for last_use, bytes_of_one, path in sorted(kept):
        if size <= MAX_BYTES or last_use > time.time() - IN_USE:
            break
        with contextlib.suppress(OSError):
            os.unlink(path)
            size -= bytes_of_one
