"""NVIDIA's run-time compiler, NVRTC, which comes with the CUDA plugin of jax.

It compiles CUDA C++ to the machine code of one GPU architecture. It is a library of this process:
nvcc, a CUDA installation, a shell and a GPU are not necessary, so that a kernel can be compiled,
though not executed, anywhere. The result is machine code and not PTX: a driver accepts the machine
code of a newer compiler of its generation, but PTX of its own compiler only.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import importlib.util
import os
from collections.abc import Iterator
from ctypes import byref, c_char_p, c_int, c_size_t, c_void_p
from pathlib import Path

from iblf_jax.kernels.caches import CACHES
from iblf_jax.kernels.toolchain import ToolchainError, cached_file, content_of

NVRTC_FLAGS = (
    "--std=c++17",
    "--fmad=true",
    "--ftz=false",
    "--prec-div=true",
    "--prec-sqrt=true",
    "-w",
)
"""Products are added without rounding, as on CPUs; all other operations are rounded as IEEE 754
specifies."""


def _candidates() -> Iterator[Path | str]:
    """Where the library may be: the wheels that jax's CUDA plugin needs (those of CUDA 12 first,
    any driver takes their code), the system's path, $CUDA_HOME.
    """
    spec = importlib.util.find_spec("nvidia")
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        yield from sorted(Path(folder).glob("*/lib/libnvrtc.so.*"), reverse=True)
    found = ctypes.util.find_library("nvrtc")
    if found:
        yield found
    for name in ("CUDA_HOME", "CUDA_PATH"):
        if os.environ.get(name):
            yield Path(os.environ[name]) / "lib64" / "libnvrtc.so"


@CACHES.function(maxsize=1)
def library() -> ctypes.CDLL:
    """NVRTC; ToolchainError if there is none."""
    for path in _candidates():
        try:
            return ctypes.CDLL(str(path))
        except OSError:
            continue
    raise ToolchainError(
        "there is no NVRTC, which comes with jax[cuda12] and jax[cuda13] (package"
        ' "nvidia-cuda-nvrtc")'
    )


def _check(code: int, what: str) -> None:
    if code:
        text = library().nvrtcGetErrorString
        text.restype = c_char_p
        raise ToolchainError(f"NVRTC {what} failed: {text(c_int(code)).decode()}")


def version() -> str:
    """Its version."""
    major, minor = c_int(), c_int()
    _check(library().nvrtcVersion(byref(major), byref(minor)), "version")
    return f"{major.value}.{minor.value}"


def _log(program: c_void_p) -> str:
    size = c_size_t()
    library().nvrtcGetProgramLogSize(program, byref(size))
    log = ctypes.create_string_buffer(size.value + 1)
    library().nvrtcGetProgramLog(program, log)
    return log.value.decode(errors="replace")


def _compile(source: str, flags: tuple[str, ...]) -> bytes:
    program, size = c_void_p(), c_size_t()
    _check(
        library().nvrtcCreateProgram(
            byref(program), source.encode(), b"kernel.cu", c_int(0), None, None
        ),
        "start",
    )
    try:
        options = (c_char_p * len(flags))(*(flag.encode() for flag in flags))
        if library().nvrtcCompileProgram(program, c_int(len(flags)), options):
            lines = [line for line in _log(program).splitlines() if "error" in line] or [
                "no message"
            ]
            raise ToolchainError(f"NVRTC {version()} failed: {lines[0][:200]}")
        _check(library().nvrtcGetCUBINSize(program, byref(size)), "output")
        image = ctypes.create_string_buffer(size.value)
        _check(library().nvrtcGetCUBIN(program, image), "output")
        return image.raw
    finally:
        library().nvrtcDestroyProgram(byref(program))


def compiled(source: str, architecture: str) -> bytes:
    """The machine code of a CUDA source, from the cache if it is there.

    Args:
      source: CUDA C++ without includes.
      architecture: as in "sm_90".

    Raises:
      ToolchainError: no NVRTC, an error from it, or an architecture that it does not know.
    """
    flags = (*NVRTC_FLAGS, f"--gpu-architecture={architecture}")
    path, _ = cached_file(
        [source, *flags, version()],
        ".cubin",
        lambda result: result.write_bytes(_compile(source, flags)),
    )
    return content_of(path)
