"""Files that are there as a whole or not at all."""

from __future__ import annotations

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import IO


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[IO[bytes]]:
    """A file to be written, which takes the place of `path` once its content is on the disk.

    Whoever opens `path` meanwhile, or after an exception or a loss of power, finds what was there
    before.  Of several writers at the same time, the last one to finish wins.

    Args:
      path: the file; its folder must exist.  A device, such as /dev/null, is written directly.

    Raises:
      OSError: the file cannot be written.
    """
    if path.exists() and not path.is_file():
        with path.open("wb") as device:
            yield device
        return
    # The name is that of no other writer; it leaves that of `path` out, which may have the greatest
    # length that the system allows.
    temporary = path.with_name(f".{uuid.uuid4().hex}.partial")
    try:
        with temporary.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
