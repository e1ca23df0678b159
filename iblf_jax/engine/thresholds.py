"""The sizes at which the engine changes how it executes a run, with the measurement behind each.

Nothing here imports the rest of the engine, so that executors and the plan can both read it.  How
many runs a study or a tuning takes at once is in `sizes`.
"""

from __future__ import annotations

from iblf_jax.kernels import LoweringLimits

# One machine function (`machine_function`), on CPU: numbers of operations are those of a jaxpr.
SMALL_BATCH = 64
"""Runs up to which a batch gains from being one machine function; XLA refuses some of its fusions
there from 128 on."""
LARGEST_ARRAY = 1 << 13
"""Entries of the largest array that is computed inside: XLA shares larger ones out over threads,
which it cannot do there."""
LARGEST_REDUCED = (1 << 12) - 1
"""Entries of the largest array that is summed up or searched inside: from 4,096 on XLA refuses it
there, in either type."""
LONG_EVALUATION = 2500
"""Operations of one evaluation of the closed loop from which it is a machine function of its own,
called from a loop of XLA's: LLVM's time grows faster than a function.  Two joints take some 700,
three 1,500, an arm of seven 10,000."""
LONGEST_FUNCTION = 60_000
"""Operations over which LLVM takes minutes as one machine function."""

# Scalar programs: numbers of operations are nodes of a step.
LONGEST_SINGLE_RUN = 60_000
"""Nodes up to which a single run is lowered on "auto": a longer step gains less by it than it takes
to compile.  A run of `presets.ur5`, 18,000 nodes, takes 0.04 s on native and 0.24 s on vmap; its
first result takes 11 s of a busy processor there, 30 where the kernel has to be built, and 24 on
vmap.  On an H100 1000 steps of it take 0.13 s on gpu and 0.9 on vmap, the first result 28 s and 13;
20,000 steps of the paper's loop take 0.11 s and 3, the first result 5 s and 9."""
LOWERING_LIMITS = LoweringLimits(
    choices=64, table=4096, tables=50_000, scan=64, written_out=1000, under_condition=64, power=64
)
"""What is lowered at all, on native, where a step of the paper's scenario takes 90 ns: a choice
among 64 entries takes 9 ns, one among 256 entries 70; twelve tables of 4096 numbers take 18 ns and
2 s to lower and build, 48 of them 100 ns and 7 s; a scan of 64 rounds with a sine in each takes 140
ns, and one of 256 takes 6 s to build.  To call the loop of three joints, 1,000 nodes, takes 4 % of
a step's time; of four joints 2 %, and the step builds in two thirds of the time.  A call costs
about as much as 30 nodes."""
LONGEST_C_FUNCTION, NODES_OF_A_C_FUNCTION = 4000, 500
"""Nodes above which the C of a step is cut into functions, and of how many each.  A step of
`presets.iiwa14`, 15,000 nodes, takes 12.2 us a block of runs and builds in 3.3 s; in one function
14.3 us and 6 s, in pieces of 125, 250, 1000 and 4000 3, 1, 5 and 12 % more.  Chains of three, five
and six joints (4,600 to 7,800 nodes) gain 6, 1 and 17 %; the paper's loop (1,800) would lose 4 %, a
chain of four (3,800) 7 %."""
STEPS_OF_A_THREAD, BLOCKS_OF_A_THREAD = 128, 32
"""Steps and blocks of runs that a thread goes through together, so that states and the table of
signals stay in its cache: 32 to 512 steps and 8 to 128 blocks take the same time within 5 % (the
paper's loop)."""
SHORT_VECTOR_BYTES = 16
"""Bytes of the runs of a batch up to which they are stepped in vectors of that length: the longest
vector of the processor would hold mostly copies."""
OPERATIONS_PER_CALL = 4e8
"""Nodes times steps of one run in one call of a kernel, after which Python sees whether Ctrl-C was
pressed: a tenth of a second, with two thousandths of the time for the calls.  For the paper's loop
these are 220,000 steps."""
FEW_STEPS = 80
"""Steps up to which a single run uses the kernel of a batch: so few steps take less time than to
build another kernel, and the linearization of a run (`LinearizationStep`) serves a batch too."""
MAX_STEPS_PER_LAUNCH = 8192
"""Steps of a launch on a GPU, at most: it limits the table of signals, and how long a display may
have to wait."""
WARP, MAX_THREADS_PER_BLOCK, MULTIPROCESSORS = 32, 128, 100
"""Threads of a warp and of a block on a GPU, at most (`c/kernels.h` promises the compiler no more);
multiprocessors where JAX does not know."""

# Derivatives.
LONGEST_DERIVATIVE, LONGEST_DERIVATIVE_CUT = 60_000, 150_000
"""Nodes of a step, times one plus the number of tangents, up to which "auto" lowers its
derivatives; the second number is for executors that cut a step into functions, which compile half a
minute where the others compile minutes.  Equal nodes are computed once, so about a third of them
is left."""
FORWARD_MOST = 32
"""Numbers that are differentiated by up to which forward mode is taken, above it reverse mode."""
HIGHEST_COLUMN_ORDER, KEPT_NUMBERS = 2, 1 << 27
"""Highest order of the derivatives that are computed column by column, and the most numbers of such
a derivative of one run's records, 1 GiB.  The scan computes all others, in the caller's mode."""
MAX_COLUMNS = 96
"""Numbers by which a transformable run is differentiated column by column, at most; the scan
differentiates by more. 64 runs of 500 steps of the paper's loop with N weights take, by
columns and by the scan in reverse mode: N = 8, 0.06 and 1.6 s; N = 32, 0.36 and 1.2 s; N = 96,
4.2 and 3.5 s; N = 386, 9.7 and 2.2 s (two cores)."""
STEP_SIZE_CHUNK = 1000
"""Steps after which the pair of runs that decides on a step size is assessed again."""


def is_within(size: float, limit: float | None) -> bool:
    """Whether a size is within a limit; None is no limit."""
    return limit is None or size <= limit


def has_machine_functions(platform: str) -> bool:
    """Whether XLA compiles machine functions for a platform."""
    return platform == "cpu"


def native_build(nodes: int, short_vector: bool) -> tuple[int | None, tuple[str, ...]]:
    """Nodes of a function of the generated C, None for one function, and the flags of the compiler.

    Args:
      nodes: of the step.
      short_vector: for so few runs, of many steps, that they fill a short vector.
    """
    flags = [f"-DSTRETCH={STEPS_OF_A_THREAD}", f"-DGROUP={BLOCKS_OF_A_THREAD}"]
    if short_vector:
        flags.append(f"-DVECTOR_BYTES={SHORT_VECTOR_BYTES}")
    segment = None
    if nodes > LONGEST_C_FUNCTION:
        segment = NODES_OF_A_C_FUNCTION
    return segment, tuple(flags)


def steps_per_call(nodes: int, steps: int, every: int | None) -> int:
    """Steps of one run that a native kernel makes in one call, a multiple of `every` unless that is
    all steps.
    """
    unit = every or 1
    most = max(int(OPERATIONS_PER_CALL / max(nodes, 1)) // unit, 1) * unit
    return min(steps, max(most, FEW_STEPS + 1))


def gpu_threads(runs: int, multiprocessors: int) -> int:
    """Threads in a block: few enough that every multiprocessor gets a block, in whole warps."""
    warps = max(-(-runs // (multiprocessors * WARP)), 1)
    return min(warps * WARP, MAX_THREADS_PER_BLOCK)


def compiles_states(operations: int) -> bool:
    """Whether a kernel makes one step from each of many states: it is made few times, so that only
    a short program pays.
    """
    return operations <= LONG_EVALUATION


def differentiates_forward(numbers: int) -> bool:
    """Whether derivatives by so many numbers are taken in forward mode."""
    return numbers <= FORWARD_MOST


def checkpoint_edge(steps: int) -> tuple[int, int]:
    """Steps of an inner loop and blocks of the outer one, for reverse mode: inner^2 blocks >=
    steps, with few steps too many.

    About 3 steps^(1/3) states are in memory at a time.
    """
    edge = max(1, round(steps ** (1 / 3)))
    inner = min(range(edge, 0, -1)[: max(1, edge // 3)], key=lambda i: -(-steps // (i * i)) * i * i)
    return inner, -(-steps // (inner * inner))
