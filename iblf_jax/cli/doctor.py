"""`doctor`: what is installed, what is missing, and the remedy."""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import os
import platform
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

HELP = "show what is installed and what is missing"
DESCRIPTION = (
    "Show the Python, JAX with its devices and precision, the compiler, the extras and the caches"
    " that are found, and a remedy for what is missing or does not work."
)
EPILOG = (
    "Exit code 1 if something is missing that every command needs, or that makes them slow: a"
    " supported Python and JAX, a compiler, a folder for compiled programs.  A missing extra is"
    " reported and no error."
)

TOOLS_OF_THE_PROJECT = ("docs", "browser", "test", "release", "bench")
"""Extras for work on the package itself, which are not listed."""


class Finding(NamedTuple):
    """One line of the report."""

    subject: str
    found: str
    remedy: str = ""
    """What to do if it is missing."""
    is_needed: bool = True
    """Whether the exit code depends on it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command, of which there are none."""


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from iblf_jax.core import tables

    findings = [*_versions(), _devices(), _compiler(), *_extras(), *_caches()]
    rows = [(x.subject, "missing" if x.remedy else "ok", x.found) for x in findings]
    print(*tables.as_text(rows, left=(0, 1, 2)), sep="\n")
    faults = [x for x in findings if x.remedy]
    if faults:
        print("\nRemedies:", *(f"  {x.subject}: {x.remedy}" for x in faults), sep="\n")
    return int(any(x.is_needed for x in faults))


def _requirements() -> list[Requirement]:
    return [Requirement(text) for text in importlib.metadata.requires("iblf_jax") or []]


def _versions() -> Iterator[Finding]:
    """Package, Python, JAX and jaxlib."""
    import iblf_jax

    where = Path(iblf_jax.__file__).parent
    yield Finding("iblf_jax", f"{iblf_jax.__version__}, {where}")
    try:
        supported = importlib.metadata.metadata("iblf_jax")["Requires-Python"]
    except importlib.metadata.PackageNotFoundError:
        remedy = "install the package: pip install . in a clone"
        yield Finding("installation", "the package is imported and not installed", remedy)
        return
    version = platform.python_version()
    remedy = ""
    if not _is_within(version, supported):
        remedy = f"take a Python {supported}"
    yield Finding("Python", f"{version}, {sys.executable}", remedy)
    allowed = {x.name: str(x.specifier) for x in _requirements() if x.marker is None}
    for name in ("jax", "jaxlib"):
        version = importlib.metadata.version(name)
        remedy = ""
        if not _is_within(version, allowed.get(name, "")):
            remedy = f'pip install "{name}{allowed[name]}"'
        yield Finding(name, version, remedy)


def _is_within(version: str, specifier: str) -> bool:
    """Whether a version satisfies conditions such as >=0.10.2,<0.13."""
    return SpecifierSet(specifier).contains(version, prereleases=True)


def _devices() -> Finding:
    import jax

    try:
        devices = jax.devices()
    except RuntimeError as error:
        remedy = "set JAX_PLATFORMS=cpu, or install the driver and jax for this accelerator"
        return Finding("devices", str(error).splitlines()[0], remedy)
    kinds = sorted({f"{x.platform} ({x.device_kind})" for x in devices})
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    config: Any = jax.config  # its fields are made when JAX starts
    precision = "float64" if config.jax_enable_x64 else "float32"
    return Finding("devices", f"{len(devices)}: {', '.join(kinds)}; {cores} cores; {precision}")


def _compiler() -> Finding:
    from iblf_jax.kernels import ToolchainError, built_for

    try:
        return Finding("compiler", built_for()["compiler"])
    except ToolchainError as error:
        return Finding("compiler", "none that works; runs use XLA and are slower", str(error))


def _extras() -> Iterator[Finding]:
    """Every extra for users, with the packages that it lacks."""
    requirements = _requirements()
    for extra in importlib.metadata.metadata("iblf_jax").get_all("Provides-Extra", []):
        names = [x.name for x in requirements if x.marker and x.marker.evaluate({"extra": extra})]
        if extra in TOOLS_OF_THE_PROJECT or not names:
            continue
        lacking = [name for name in names if not _version_of(name)]
        found = ", ".join(f"{name} {_version_of(name)}".strip() for name in names)
        remedy = ""
        if lacking:
            found = f"without {', '.join(lacking)}"
            remedy = f'pip install "iblf_jax[{extra}]", or ".[{extra}]" in a clone'
        yield Finding(f"extra {extra}", found, remedy, is_needed=False)


def _version_of(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _caches() -> Iterator[Finding]:
    """The folder of compiled programs, and that of JAX if the user has chosen another one."""
    import jax

    from iblf_jax.kernels import directory

    try:
        folder = directory()
    except OSError as error:
        remedy = "set XDG_CACHE_HOME to a folder of yours that can be written"
        yield Finding("compiled programs", str(error), remedy)
        return
    yield Finding("compiled programs", _size_of(folder))
    config: Any = jax.config  # its fields are made when JAX starts
    of_jax = config.jax_compilation_cache_dir
    if of_jax is None:
        remedy = "unset JAX_ENABLE_COMPILATION_CACHE"
        if config.jax_enable_compilation_cache:
            remedy = "none: XLA does not load its own programs on this processor (jax issue 38445)"
        yield Finding("programs of XLA", "not kept between processes", remedy, is_needed=False)
    elif not Path(of_jax).is_relative_to(folder):
        yield Finding("programs of XLA", _size_of(Path(of_jax)))


def _size_of(folder: Path) -> str:
    """A folder, the number of its files and their size."""
    sizes = []
    for place, _, names in os.walk(folder):
        for name in names:
            # Another process may have removed a program since its name was read.
            with contextlib.suppress(FileNotFoundError):
                found = os.lstat(os.path.join(place, name))
                if stat.S_ISREG(found.st_mode):
                    sizes.append(found.st_size)
    return f"{folder}, {len(sizes)} files, {sum(sizes) / 2**20:.0f} MiB; may be deleted"
