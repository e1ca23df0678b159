"""The Pythons of this machine that `release` and `newest_python` may use."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path


def interpreter(minor: int) -> Path | None:
    """A Python 3.`minor` on PATH or of pyenv; None if there is none that starts."""
    candidates = [shutil.which(f"python3.{minor}")]
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    candidates += [str(path) for path in sorted(pyenv.glob(f"3.{minor}.*/bin/python"))]
    for candidate in filter(None, candidates):
        if version_of(Path(candidate)) == (3, minor):
            return Path(candidate)
    return None


def version_of(python: Path) -> tuple[int, int] | None:
    """(3, minor) of an interpreter that can make virtual environments; None of another one."""
    code = "import sys, ensurepip, venv; print(*sys.version_info[:2])"
    try:
        done = subprocess.run([python, "-c", code], capture_output=True, text=True, check=False)
    except OSError:
        return None
    if done.returncode:
        return None
    try:
        major, minor = map(int, done.stdout.split())
    except ValueError:
        return None
    return major, minor
