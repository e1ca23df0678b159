"""The sizes at which the engine changes how it executes a run, with the measurement behind each.

This module imports nothing else of the engine, so that executors and the plan can both read it.
`sizes` has the numbers of runs that studies and tuning compute in one batch.
"""

from __future__ import annotations

import math

from iblf_jax.core import checks
from iblf_jax.kernels import LoweringLimits

# The scan.  Operations are those of a jaxpr.
LONG_EVALUATION = 2500
"""Operations of the longest evaluation of the closed loop that the scan writes out once for each
stage of the integrator."""

# Scalar programs.  Their operations are called nodes.
MAX_SINGLE_RUN_NODES = 60_000
"""Nodes of the longest step of a single run that is lowered on "auto".  For a longer step the
kernel saves less time than its compilation takes.  A run of `presets.ur5`, 18,000 nodes, takes
0.04 s on native and 0.24 s on vmap.  Its first result on a busy processor takes 11 s on native, 30
if the kernel has to be built, and 24 on vmap.  On gpu this is to be measured."""
LOWERING_LIMITS = LoweringLimits(
    choices=64, table=4096, tables=50_000, scan=64, written_out=1000, under_condition=64, power=64
)
"""Limits of what is lowered.  On native, where a step of the paper's scenario takes 90 ns, a choice
among 64 entries takes 9 ns, one among 256 entries 70; twelve tables of 4096 numbers take 18 ns and
2 s to lower and build, 48 of them 100 ns and 7 s; a scan of 64 rounds with a sine in each takes 140
ns, and one of 256 takes 6 s to build.  An inner function costs about as much per call as 30 nodes.
Calling the loop of three joints, 1,000 nodes, takes 4 % of a step's time; that of four joints takes
2 %, and reduces the time to build the step to two thirds."""
MAX_C_FUNCTION_NODES = 4000
"""Nodes of the longest step whose C is one function; a longer step is divided into several."""
SEGMENT_NODES = 500
"""Nodes of each C function of a divided step.  A step of `presets.iiwa14`, 15,000 nodes, takes
12.2 us for a block of runs and builds in 3.3 s; as one function 14.3 us and 6 s, in functions of
125, 250, 1000 and 4000 nodes 3, 1, 5 and 12 % more.  Chains of three, five and six joints (4,600 to
7,800 nodes) gain 6, 1 and 17 %; the paper's loop (1,800) would lose 4 %, a chain of four (3,800)
7 %."""
TILE_STEPS = 128
"""Steps of a tile: a thread makes them for TILE_BLOCKS blocks of runs before it goes on, so that
states and the table of signals stay in its cache.  For the paper's loop tiles of 32 to 512 steps
and 8 to 128 blocks take the same time within 5 %."""
TILE_BLOCKS = 32
"""Blocks of runs of a tile."""
SHORT_VECTOR_BYTES = 16
"""Bytes of a short vector.  A batch whose runs fit in it uses it, because the longest vector of the
processor would hold mostly copies."""
OPERATIONS_PER_CALL = 4e8
"""Nodes times steps in one call of the kernel of a single run.  Python responds to Ctrl-C between
calls: every tenth of a second, while calls take two thousandths of the time.  For the paper's loop
a call makes 220,000 steps."""
FEW_STEPS = 80
"""Steps up to which a single run uses the kernel of a batch: so few steps take less time than
building another kernel.  It also lets runs and batches share the kernel of `LinearizationStep`."""
MAX_STEPS_PER_LAUNCH = 8192
"""Steps of a launch on a GPU.  They limit the size of the table of signals, and the time for which
the GPU does not update a display."""
WARP = 32
"""Threads of a warp on a GPU."""
MAX_THREADS_PER_BLOCK = 128
"""Threads of a block on a GPU; `c/kernels.h` declares this limit to the compiler."""
DEFAULT_MULTIPROCESSORS = 100
"""Multiprocessors that are assumed where JAX does not report their number."""

# Derivatives.
MAX_DERIVATIVE_NODES = 60_000
"""Nodes of a step, times one plus the number of tangents, up to which "auto" lowers derivatives.
Equal nodes are merged later, so that about a third remain."""
MAX_SEGMENTED_DERIVATIVE_NODES = 150_000
"""The same for executors that divide a step into functions, which compile for half a minute where
the others compile for minutes."""
ADJOINT_NODES = 3
"""Nodes of the adjoint of a step for each node of the step, approximately: 2 for the paper's loop,
5 for `presets.ur5`.  Gradients of 8 runs of 300 steps of the latter take 0.019 s of processor time
by kernels and 1.8 s by the scan; the first one took 90 and 277 s on a busy machine."""
MAX_NODES_PER_OPERATION = 12.0
"""Nodes of a step for each operation of the closed loop, up to which a kernel of a batch computes
derivatives, in forward and in reverse mode.  A scalar program writes out the products of arrays
that XLA computes as one operation.  For 64 runs of 500 steps of the paper's loop with a network of
two hidden layers, by 2 of its weights, kernel and scan take: layers of 32 (6 nodes), 0.11 and
0.25 s (11 and 15 s of processor time with compilation); layers of 64 (19 nodes), 0.53 and 0.39 s
(25 and 18 s).  In reverse mode, by all weights and on a busy machine: layers of 32, 0.6 and 4.5 s
(the first gradient 41 and 113 s); layers of 64, 2.7 and 7.2 s (184 and 40 s).  Without a network
there are 2 nodes."""
SEGMENT_BYTES = 1 << 22
"""Bytes of the carries of a segment of reverse mode by kernels, at least sqrt(steps) of them.  The
threads wait for each other twice per segment.  The gradient of 64 runs of 500 steps by 162 weights
of a network takes, with 1 << 18, 20, 22 and 24 bytes, 8, 8, 6 and 5 times as long as the runs on
two busy cores, and 4, 4, 5 and 5 times as long on one core."""
MAX_FORWARD_NUMBERS = 32
"""Numbers by which forward mode differentiates; reverse mode differentiates by more."""
MAX_COLUMN_ORDER = 2
"""Highest order of a derivative that is computed column by column.  The scan computes all others,
in the caller's mode."""
MAX_KEPT_NUMBERS = 1 << 27
"""Numbers of such a derivative of the records of one run: 1 GiB."""
MAX_COLUMNS = 32
"""Numbers by which a transformable run is differentiated column by column; reverse mode (`adjoint`,
or the scan) differentiates by more.  64 runs of 500 steps of the paper's loop with N weights take,
by columns and by the scan in reverse mode: N = 8, 0.06 and 1.6 s; N = 32, 0.36 and 1.2 s; N = 96,
4.2 and 3.5 s; N = 386, 9.7 and 2.2 s (two cores).  Reverse mode by kernels takes 0.1 s for N = 162
and 0.2 s for N = 374 on a busy machine."""
STEP_SIZE_CHUNK = 1000
"""Steps between two assessments of the pair of runs that determines a step size."""


def is_within(size: float, limit: float | None) -> bool:
    """Whether a size is within a limit; None is no limit."""
    return limit is None or size <= limit


def rolls_stages(operations: int) -> bool:
    """Whether the stages of the integrator are a loop in the scan, for so many operations of the
    closed loop.
    """
    return operations > LONG_EVALUATION


def native_build(nodes: int, short_vector: bool) -> tuple[int | None, tuple[str, ...]]:
    """The arguments of `kernels.Build`: nodes of each C function, and flags of the compiler.

    Args:
      nodes: nodes of the step.
      short_vector: whether runs are stepped in short vectors (SHORT_VECTOR_BYTES).
    """
    flags = [f"-DSTRETCH={TILE_STEPS}", f"-DGROUP={TILE_BLOCKS}"]
    if short_vector:
        flags.append(f"-DVECTOR_BYTES={SHORT_VECTOR_BYTES}")
    segment = None
    if nodes > MAX_C_FUNCTION_NODES:
        segment = SEGMENT_NODES
    return segment, tuple(flags)


def uses_short_vector(bytes_of_runs: int, steps: int) -> bool:
    """Whether a kernel makes so many steps in short vectors.

    Args:
      bytes_of_runs: bytes of one number of each run.
      steps: number of steps.
    """
    return bytes_of_runs <= SHORT_VECTOR_BYTES and steps > FEW_STEPS


def segment_steps(steps: int, bytes_per_step: int) -> int:
    """Steps of a segment of reverse mode by kernels.

    Args:
      steps: steps of the run.
      bytes_per_step: bytes of the carries of all runs.
    """
    return min(steps, max(math.isqrt(steps - 1) + 1, SEGMENT_BYTES // bytes_per_step))


def steps_per_call(nodes: int, steps: int, every: int | None) -> int:
    """Steps of a single run in one call of a kernel: all of them, or a multiple of `every`."""
    unit = every or 1
    most = max(int(OPERATIONS_PER_CALL / max(nodes, 1)) // unit, 1) * unit
    return min(steps, max(most, FEW_STEPS + 1))


def gpu_threads(runs: int, multiprocessors: int) -> int:
    """Threads of a block, in complete warps: few enough that every multiprocessor has a block."""
    warps = max(checks.ceil_div(runs, multiprocessors * WARP), 1)
    return min(warps * WARP, MAX_THREADS_PER_BLOCK)


def differentiates_forward(numbers: int) -> bool:
    """Whether derivatives with respect to so many numbers are computed in forward mode."""
    return numbers <= MAX_FORWARD_NUMBERS


def checkpoint_edge(steps: int) -> tuple[int, int]:
    """Lengths of the nested loops of `loops.checkpointed`: inner^2 blocks >= steps, where the
    excess is small.

    About 3 steps^(1/3) states are in memory at a time.

    Returns:
      Iterations of each of the two inner loops, and of the outer one ("blocks").
    """
    edge = max(1, round(steps ** (1 / 3)))
    candidates = range(edge, edge - max(1, edge // 3), -1)

    def blocks(inner: int) -> int:
        return checks.ceil_div(steps, inner**2)

    inner = min(candidates, key=lambda inner: blocks(inner) * inner**2)
    return inner, blocks(inner)
