"""The folder of compiled programs, and the processor that they are compiled for."""

from __future__ import annotations

import os
import platform
import stat
from pathlib import Path

from iblf_jax.kernels.caches import CACHES


def directory() -> Path:
    """The folder in which compiled programs are kept between processes; its mode is 0700.

    Raises:
      OSError: it cannot be made, or belongs to another user; the message is one line for the user.
    """
    path = None
    try:
        path = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "iblf_jax"
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        if path.is_symlink():
            raise OSError("it is a link and not a directory of this user")
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            status = os.fstat(folder)
            if status.st_uid != os.getuid():
                raise OSError("it is not a directory of this user")
            if stat.S_IMODE(status.st_mode) & 0o077:
                os.fchmod(folder, 0o700)
        finally:
            os.close(folder)
    except (OSError, RuntimeError) as error:
        raise OSError(f"the cache {path or '~/.cache/iblf_jax'} cannot be made: {error}") from None
    return path


@CACHES.function(maxsize=1)
def processor() -> str:
    """The model and the features of the processor, for which a program is compiled."""
    names = ("model name", "flags", "Features", "CPU part")
    return (
        "\n".join(sorted({line for line in cpuinfo() if line.startswith(names)}))
        or platform.processor() + platform.machine()
    )


def vector_bytes() -> int:
    """Bytes of the registers that kernels use on this processor, as `c/vector.h` chooses them."""
    flags = {word for line in cpuinfo() if line.startswith("flags") for word in line.split()}
    if "avx512f" in flags:
        return 64
    return 32 if "avx" in flags else 16


def cpuinfo() -> list[str]:
    """Lines of /proc/cpuinfo; empty where there is none."""
    try:
        return Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return []
