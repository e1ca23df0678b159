"""A compiler for the time step of a simulation: from JAX to C or CUDA."""

from iblf_jax.kernels.drafts import draft as draft
from iblf_jax.kernels.folder import cpuinfo as cpuinfo
from iblf_jax.kernels.folder import directory as directory
from iblf_jax.kernels.folder import processor as processor
from iblf_jax.kernels.messages import has_reader as has_reader
from iblf_jax.kernels.toolchain import stop_compilers as stop_compilers
