"""The gpu backend on a CPU, with a CUDA driver that loops over the threads."""

import ctypes
from functools import lru_cache
from pathlib import Path

import jax

from iblf_jax.engine import gpu
from iblf_jax.kernels import cuda, toolchain
from iblf_jax.kernels.emit_c import CUDA, source

FOLDER = Path(__file__).parent
IMAGE = b"image of a kernel, which a driver would load"


def text(name: str) -> str:
    return (FOLDER / name).read_text()


@lru_cache(maxsize=64)
def driver(program, shared: int, lane: int, flags: tuple[str, ...] = ()) -> Path:
    """A library with the entries of CUDA's driver, for one program."""
    whole = "\n".join(
        [text("cuda_language.h"), source(program, shared, lane, CUDA), text("cuda_driver.h")]
    )
    return toolchain.built(whole, ("-std=gnu++20", *flags))[0]


@lru_cache(maxsize=64)
def kernel(
    program, shared: int, lane: int, flags: tuple[str, ...] = (), image: bytes = IMAGE
) -> str:
    """As `gpu.kernel`, for the platform of the tests."""
    launcher = cuda.launcher(program, shared, lane, image) + text("cuda_stream.h")
    library, key = toolchain.built(
        launcher, (f'-DDRIVER="{driver(program, shared, lane, flags)}"',)
    )
    jax.ffi.register_ffi_target(
        key, jax.ffi.pycapsule(toolchain.loaded(library).on_cpu), platform="cpu"
    )
    return key


def run(program, shared, lane, carry, steps, every, *, threads=32, flags=()):
    name = kernel(program, shared.size, lane.shape[0], flags)
    return gpu.call(name, program, shared, lane, carry, steps, every, threads)


def launches(program, shared: int, lane: int) -> tuple[int, int]:
    """How often the image was loaded and a kernel was launched in this process."""
    library = ctypes.CDLL(str(driver(program, shared, lane)))
    library.times_launched.restype = ctypes.c_int64
    return library.times_loaded(), library.times_launched()
