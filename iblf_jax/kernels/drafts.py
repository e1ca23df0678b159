"""Temporary folders in which files are written before they are moved to their place at once.

The owner of a draft holds a lock on its folder, which the system releases when the process ends,
however it ends. A draft whose lock is free is therefore abandoned, and the next draft of the same
name removes it.
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
except ImportError:  # on Windows, only the age of a draft decides
    fcntl = None  # type: ignore[assignment]

STALE = 3600.0
"""Seconds after which a draft counts as abandoned where locks do not work: it was made on another
machine, or on a disk without locks."""


@contextlib.contextmanager
def draft(parent: Path, name: str) -> Iterator[Path]:
    """A new folder in `parent` that only this user can enter; it is removed at the end.

    Args:
      parent: a folder that exists.
      name: name of the draft; abandoned drafts of the same name are removed first.

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
        if path.exists():  # else another process removed it before it was locked
            break
        _release(lock)
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        _release(lock)


def remove_abandoned(path: Path, *, lockable: bool) -> None:
    """Removes an abandoned folder; links are not touched.

    Args:
      path: the folder.
      lockable: whether its owner, if it runs, is on this machine and holds a lock on it.
    """
    with contextlib.suppress(OSError):
        if path.is_symlink():
            return
        lock = None
        if lockable:
            lock = _locked(path, wait=False)
        if lock is not None or time.time() - path.lstat().st_mtime > STALE:
            shutil.rmtree(path, ignore_errors=True)
        _release(lock)


def _locked(path: Path, *, wait: bool) -> int | None:
    """A lock on a folder, as an open file; None where locks do not work.

    Raises:
      BlockingIOError: another process holds it and `wait` is False.
    """
    if fcntl is None:
        return None
    try:
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return None
    operation = fcntl.LOCK_EX
    if not wait:
        operation |= fcntl.LOCK_NB
    try:
        fcntl.flock(folder, operation)
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
