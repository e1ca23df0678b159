"""Folders in which something is made before it is moved to its place in one piece.

The maker of a draft holds a lock on its folder, which the system drops when the process ends,
however it ends.  A draft whose lock can be had is therefore nobody's any more, and whoever makes
the next one removes it.
"""

from __future__ import annotations

import contextlib
import glob
import os
import platform
import shutil
import time
import uuid
import zlib
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows: age alone tells
    fcntl = None  # type: ignore[assignment]

STALE = 3600.0
"""Seconds after which a draft is nobody's where no lock can tell: made on another machine, or on a
disk without locks."""


@contextlib.contextmanager
def draft(parent: Path, name: str) -> Iterator[Path]:
    """A new folder in `parent` that nobody else can enter; gone at the end, with what has not been
    moved out of it.

    Args:
      parent: a folder that exists.
      name: what is made; drafts of the same name that killed processes have left are removed first.

    Raises:
      OSError: the folder cannot be made.
    """
    machine = f"{zlib.crc32(platform.node().encode()):08x}"
    for left in parent.glob(f".{glob.escape(name)}.*.partial"):
        remove_abandoned(left, lockable=left.name.startswith(f".{name}.{machine}."))
    while True:
        path = parent / f".{name}.{machine}.{uuid.uuid4().hex[:16]}.partial"
        path.mkdir(mode=0o700)
        lock = _locked(path, wait=True)
        if path.exists():  # else another process took it for abandoned between the two lines above
            break
        _release(lock)
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        _release(lock)


def remove_abandoned(path: Path, *, lockable: bool) -> None:
    """Removes a folder that nobody works in any more; links are left alone.

    Args:
      path: the folder.
      lockable: whether its maker, if alive, is on this machine and holds a lock on it.
    """
    with contextlib.suppress(OSError):
        if path.is_symlink():
            return
        lock = _locked(path, wait=False) if lockable else None
        if lock is not None or time.time() - path.lstat().st_mtime > STALE:
            shutil.rmtree(path, ignore_errors=True)
        _release(lock)


def _locked(path: Path, *, wait: bool) -> int | None:
    """A lock on a folder, as an open file; None where there are no locks.  BlockingIOError if
    another holds it and `wait` is False.
    """
    if fcntl is None:
        return None
    try:
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        os.close(folder)
        raise
    except OSError:
        os.close(folder)
        return None
    return folder


def _release(lock: int | None) -> None:
    if lock is not None:
        os.close(lock)
