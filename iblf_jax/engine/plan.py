"""Stage 2 of a run: how a request is executed, decided from sizes and the platform alone.

`choose_plan` is a pure function from a request, the sizes of its inputs and the machine to an
`ExecutionPlan`: which executors are tried, and how XLA is given a batch.  The other functions
decide how long a piece of code a compiler gets at a time, whether derivatives are taken in forward
or reverse mode, and how many runs or steps go together.  All thresholds are in the table below,
with the measurement behind each where there is one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from iblf_jax.kernels import LoweringLimits

if TYPE_CHECKING:
    from iblf_jax.engine.registry import Machine
    from iblf_jax.engine.request import RunRequest

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
LONGEST_SINGLE_RUN, LONGEST_SINGLE_RUN_XLA = 60_000, 2500
"""Nodes up to which a single run is lowered on "auto", for executors that compile kernels and for
xla: a longer step gains less by it than it takes to compile.  A run of `presets.ur5`, 18,000
nodes, takes 0.04 s on native and 0.24 on scan; its first result takes 11 s of a busy processor
there, 30 where the kernel has to be built, and 24 on scan.  On an H100 1000 steps of it take 0.13 s
on gpu and 0.9 on scan, the first result 28 s and 13; 20,000 steps of the paper's loop take 0.11 s
and 3, the first result 5 s and 9."""
LIMITS = LoweringLimits(
    choices=64, table=4096, tables=50_000, scan=64, written_out=1000, under_condition=64, power=64
)
"""What is lowered at all, on native, where a step of the paper's scenario takes 90 ns: a choice
among 64 entries takes 9 ns, one among 256 entries 70; twelve tables of 4096 numbers take 18 ns and
2 s to lower and build, 48 of them 100 ns and 7 s; a scan of 64 rounds with a sine in each takes 140
ns, and one of 256 takes 6 s to build.  To call the loop of three joints, 1,000 nodes, takes 4 % of
a step's time; of four joints 2 %, and the step builds in two thirds of the time.  A call costs
about as much as 30 nodes."""
XLA_DEAR, XLA_STORED = 8, 8
"""What an operation costs on CPU where a cheap one costs 1, and the cost from which a number with
several uses is stored: XLA would compute it again for each use."""
XLA_BLOCK = 64
"""Runs that go through a stretch of steps together on CPU: their numbers stay in the first-level
cache (32 are half as fast, 128 the same)."""
XLA_BLOCK_ALWAYS = 10_000
"""Nodes from which a block is always that wide: loops over fewer runs would be unrolled, and LLVM
takes up to 20 GB over that."""
XLA_LONGEST = 20_000
"""Nodes above which XLA takes many minutes."""
XLA_STRETCH = 4096
"""Steps whose signals are tabulated at once, at most."""
XLA_SEGMENT = 2000
"""Nodes in one XLA computation on CPU: its passes take more than linear time."""
NATIVE_LONG, NATIVE_SEGMENT = 4000, 500
"""Nodes above which the C of a step is cut into functions, and of how many each.  A step of
`presets.iiwa14`, 15,000 nodes, takes 12.2 us a block of runs and builds in 3.3 s; in one function
14.3 us and 6 s, in pieces of 125, 250, 1000 and 4000 3, 1, 5 and 12 % more.  Chains of three, five
and six joints (4,600 to 7,800 nodes) gain 6, 1 and 17 %; the paper's loop (1,800) would lose 4 %, a
chain of four (3,800) 7 %."""
NATIVE_STRETCH, NATIVE_GROUP = 128, 32
"""Steps and blocks of runs that a thread goes through together, so that states and the table of
signals stay in its cache: 32 to 512 steps and 8 to 128 blocks take the same time within 5 % (the
  paper's loop)."""
NATIVE_NARROW = 16
"""Bytes of the runs of a batch up to which they are stepped in vectors of that length: a
processor's longest would be mostly copies."""
NATIVE_UNSEEN = 4e8
"""Nodes times steps of one run that a kernel makes before Python sees whether Ctrl-C was pressed: a
tenth of a second, and two tenths of a per cent of time for the calls.  The paper's loop: 220,000
steps."""
NATIVE_FEW = 80
"""Steps up to which the kernel of a batch also runs a single run: so few steps take less time than
a build of their own, and the linearization of a run (`LinearizationStep`) serves a batch too."""
GPU_STRETCH = 8192
"""Steps of a launch, at most: bounds the table of signals, and how long a display may have to
wait."""
GPU_WARP, GPU_MOST_THREADS, GPU_PROCESSORS = 32, 128, 100
"""Threads of a warp and of a block, at most (`c/kernels.h` promises the compiler no more);
multiprocessors where JAX does not know."""
JVP_LARGEST, JVP_LARGEST_IN_SEGMENTS = 60_000, 150_000
"""Nodes of a step, times one and its tangents, up to which "auto" lowers its derivatives: compilers
take minutes over longer ones, the native one, which cuts a step into segments, half a minute.
Equal numbers are computed once, so about a third is left of them."""

FORWARD_MOST = 32
"""Numbers that are differentiated by up to which forward mode is taken, above it reverse mode."""
COLUMNS_ORDER, COLUMNS_KEPT = 2, 1 << 27
"""Derivatives that are made column by column, and numbers of such a derivative of one run's records
that are kept, 1 GiB: others are the scan's, in the mode that the caller takes."""
COLUMNS_MOST = 96
"""Numbers by which derivatives of a transformable run are made column by column, at most; by more
numbers they are the scan's. 64 runs of 500 steps of the paper's loop with N weights take, by
columns and by the scan in reverse mode: N = 8, 0.06 and 1.6 s; N = 32, 0.36 and 1.2 s; N = 96,
4.2 and 3.5 s; N = 386, 9.7 and 2.2 s (two cores)."""

# Studies: runs are made in blocks of one compiled shape.
STUDY_BLOCK, STUDY_BLOCK_ELSEWHERE = {"cpu": 256}, 32_768
"""Runs in a block of a study, by platform.  On an H100 100,000 runs of 20 s of the paper's loop
take 0.48 s in float64, in blocks of 16,384 0.70 s and of 65,536 0.52 s; 1,000 runs, which a block
is filled up from, 0.16 s, 0.13 s and 0.28 s."""
STUDY_MEMORY = 256 * 2**20
"""Bytes that runs in flight may take, unless the caller says otherwise."""
STEP_SIZE_CHUNK = 1000
"""Steps after which the pair of runs that decides on a step size is assessed again."""
STUDY_IN_FLIGHT = 4
"""Blocks that are computed on a device at the same time, each by a thread: draws and results of one
block are handled while the kernel of another one runs."""
SWEEP_UNIT, SWEEP_UNITS = 2e8, 16
"""Steps of all runs of a unit of a sweep's store together, seconds to a minute of work; units that
a sweep has at least, if it is large."""
TUNE_TOGETHER = 16
"""Runs that are evaluated at once at least, where starts of a tuning run out one by one: what a
processor's vectors hold."""
TUNE_FRESH = 10_000_000
"""Steps up to which fresh runs are made in the shape of a search's values: half a second of work
for the paper's scenario, where XLA compiles a block of them in 1.5 s."""


class BatchLayout(NamedTuple):
    """How XLA is given a batch of runs."""

    mapping: str
    """"vmap": all runs advance together; "map": one run after the other."""
    machine_functions: str
    """"loop": the whole time loop is one machine function; "parts": its parts are one each (closed
    loop, record and metrics, start, end); "none"."""
    rolled: bool
    """Whether the integrator's stages are a loop.  One run as a machine function takes half the
    time so, and a third to compile; 32 runs take 2.3 times as long, and XLA's own loop over one run
    three times."""


PLAIN_LAYOUT = BatchLayout("vmap", "none", False)
"""A batch by `jax.vmap`, compiled by XLA in its usual way."""
STATES_LAYOUT = BatchLayout("vmap", "none", True)
"""How one step is made from each of many states: it is made few times, so what counts is how long
it compiles."""


class Sizes(NamedTuple):
    """What is known of the work before it is compiled."""

    operations: int
    """Operations of one evaluation of the closed loop."""
    runs: int | None
    """Runs of the batch; None for a single run."""
    nodes: int | None = None
    """Nodes of a step's scalar program, where a decision needs them."""
    unsupported: str | None = None
    """Why the step cannot be lowered to a scalar program."""


class ExecutionPlan(NamedTuple):
    """How a request is executed."""

    executors: tuple[str, ...]
    """Names of the executors to try, best first.  The scan follows if none of them can run it."""
    layout: BatchLayout
    """Of what surrounds a scalar program."""
    scan_layout: BatchLayout
    """Of the scan."""
    reports_fallback: bool
    """Whether a warning says that the requested executor is replaced by another one."""
    notes: tuple[str, ...] = ()
    """Warnings about the request itself."""


def choose_plan(request: RunRequest, sizes: Sizes, machine: Machine) -> ExecutionPlan:
    """The plan for a request.

    Args:
      request: what is to be run.
      sizes: of the work.
      machine: platform and the executors for it.
    """
    operations, runs, nested = sizes.operations, sizes.runs, request.nested
    layout = lowered_layout(machine.platform, operations, runs or 1, nested)
    by_scan = scan_layout(machine.platform, operations, runs, nested)
    if runs is not None:
        names, notes = requested_executors(request.backend, machine)
        return ExecutionPlan(names, layout, by_scan, True, notes)
    names, notes = single_run_executors(request.backend, operations, machine)
    reports = machine.builds_kernels(request.backend)
    if sizes.unsupported is not None:
        notes = (*notes, slower_by_scan(sizes.unsupported)) if reports else notes
        return ExecutionPlan((), layout, by_scan, reports, notes)
    if names and not reports and sizes.nodes is not None:
        limit = machine.limits(names[0]).single_run
        names = names if limit is None or sizes.nodes <= limit else ()
    return ExecutionPlan(names, layout, by_scan, reports, notes)


def requested_executors(backend: str, machine: Machine) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The executors for a requested backend on a machine, best first, and warnings about it."""
    if backend == "vmap":
        return (), ()
    if backend == "auto":
        return machine.names, ()
    if backend in machine.names:
        others = tuple(name for name in machine.portable if name != backend)
        return (backend, *others), ()
    instead = machine.portable[0] if machine.portable else "vmap"
    note = (
        f"The {backend} backend is not for the default device, {machine.platform}: running on"
        f" {instead}."
    )
    return machine.portable, (note,)


def single_run_executors(
    backend: str, operations: int, machine: Machine
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The executors for a single run, best first, and warnings about the request.

    A requested executor that compiles kernels is always tried.  Otherwise only one is, and only if
    its program is short enough.

    Args:
      backend: the requested one.
      operations: of one evaluation of the closed loop.
      machine: where it runs.
    """
    if machine.builds_kernels(backend):
        return requested_executors(backend, machine)
    if backend == "auto" and machine.builds_kernels(machine.automatic):
        return (machine.automatic,), ()
    if machine.platform != "cpu":
        return (), ()
    requested = (backend,) if backend in machine.portable else machine.portable
    found = [name for name in requested if _fits(operations, machine.limits(name).evaluation)]
    return tuple(found[:1]), ()


def _fits(size: int, limit: int | None) -> bool:
    return limit is None or size <= limit


def slower_by_scan(reason: object) -> str:
    """The warning that a scenario runs by the scan."""
    return f"This scenario runs on the vmap backend, several times slower: {reason}."


def scan_layout(platform: str, operations: int, runs: int | None, nested: bool) -> BatchLayout:
    """How the scan runs a batch.

    Args:
      platform: as JAX names it.
      operations: of one evaluation of the closed loop.
      runs: in the batch; None for one run.
      nested: whether a caller may batch, differentiate or loop over the result: XLA refuses machine
        functions there, or aborts.
    """
    is_long = operations > LONG_EVALUATION
    if platform != "cpu" or nested:
        return BatchLayout("vmap", "none", is_long)
    if is_long:
        return BatchLayout("map", "parts", True)
    is_small = (runs or 1) <= SMALL_BATCH
    return BatchLayout("vmap", {True: "loop", False: "none"}[is_small], runs is None)


def lowered_layout(platform: str, operations: int, runs: int, nested: bool) -> BatchLayout:
    """How what surrounds a scalar program is compiled: for one run in two thirds of XLA's own time;
    of 48 runs, and of arms of many joints, XLA refuses a fusion.
    """
    in_parts = platform == "cpu" and runs == 1 and operations <= LONG_EVALUATION and not nested
    return BatchLayout("vmap", {True: "parts", False: "none"}[in_parts], False)


def compiles_states(operations: int) -> bool:
    """Whether a kernel makes one step from each of many states: it is made few times, so that only
    a short program pays.
    """
    return operations <= LONG_EVALUATION


def carries_tangents(limit: int | None, nodes: int, tangents: int) -> bool:
    """Whether one kernel steps a run and all its tangents on "auto": longer ones compile for
    minutes.

    Args:
      limit: of the executor (`Limits.derivatives`).
      nodes: of a step without tangents.
      tangents: how many.
    """
    return _fits(nodes * (1 + tangents), limit)


def xla_width(platform: str, nodes: int, runs: int) -> int:
    """Runs in a block of the xla executor."""
    narrow = runs < XLA_BLOCK and nodes < XLA_BLOCK_ALWAYS
    return runs if narrow or platform != "cpu" else XLA_BLOCK


def xla_stretch(steps: int, every: int) -> int:
    """Steps of a stretch, a multiple of `every`: so that one length does for all where there is
    such a length, as each is compiled.
    """
    most = max(XLA_STRETCH // every, 1) * every
    if steps <= most:
        return steps
    exact = next((d for d in range(most, 0, -every) if steps % d == 0), 0)
    if exact > most // 16:
        return exact
    return most


def native_build(nodes: int, narrow: bool) -> tuple[int | None, tuple[str, ...]]:
    """Nodes of a function of the generated C, None for one function, and the flags of
    the compiler.

    Args:
      nodes: of the step.
      narrow: for so few runs, of many steps, that they fill a short vector.
    """
    sizes = (
        f"-DSTRETCH={NATIVE_STRETCH}",
        f"-DGROUP={NATIVE_GROUP}",
        *((f"-DVECTOR_BYTES={NATIVE_NARROW}",) if narrow else ()),
    )
    return NATIVE_SEGMENT if nodes > NATIVE_LONG else None, sizes


def native_stretch(nodes: int, steps: int, every: int | None) -> int:
    """Steps of one run that a kernel makes in one call, a multiple of `every` unless that is all
    steps.
    """
    unit = every or 1
    most = max(int(NATIVE_UNSEEN / max(nodes, 1)) // unit, 1) * unit
    return min(steps, max(most, NATIVE_FEW + 1))


def gpu_threads(runs: int, processors: int) -> int:
    """Threads in a block: few enough that every multiprocessor gets a block, in whole warps."""
    return min(max(-(-runs // (processors * GPU_WARP)) * GPU_WARP, GPU_WARP), GPU_MOST_THREADS)


def study_block(platform: str) -> int:
    """Runs in a block of a study: results do not depend on it, but a kept study is laid out by
    it.
    """
    return STUDY_BLOCK.get(platform, STUDY_BLOCK_ELSEWHERE)


def blocks_in_flight(
    chunk: int | None, memory: float, block_bytes: int, block: int, devices: int
) -> int:
    """Blocks of a study that may be in flight: `chunk` runs if the caller says so, else what
    `memory` holds.
    """
    allowed = memory // max(block_bytes, 1) if chunk is None else chunk // block
    return int(min(max(allowed, 1), STUDY_IN_FLIGHT * devices))


def keeps_columns(order: int, numbers: int) -> bool:
    """Whether a derivative of this order, of so many numbers, is made column by column and kept."""
    return order <= COLUMNS_ORDER and numbers <= COLUMNS_KEPT


def differentiates_by_columns(numbers: int) -> bool:
    """Whether a derivative of a transformable run by so many numbers is made column by column."""
    return numbers <= COLUMNS_MOST


def differentiates_forward(numbers: int) -> bool:
    """Whether derivatives by so many numbers are taken in forward mode."""
    return numbers <= FORWARD_MOST


def starts_together(starts: int, runs: int) -> int:
    """Starts of a tuning, of so many runs each, that are evaluated at once."""
    return min(starts, values_together(runs))


def values_together(runs: int) -> int:
    """Points of a tuning, of so many runs each, of which values are computed at once."""
    return -(-TUNE_TOGETHER // runs)


def fresh_together(platform: str, steps: int, compiled: int) -> int:
    """Runs of a tuning's report that are made at once.

    Args:
      platform: as JAX names it.
      steps: of all of them.
      compiled: how many the search made at once for its values.
    """
    return compiled if steps <= TUNE_FRESH else study_block(platform)


def checkpoint_edge(steps: int) -> tuple[int, int]:
    """Steps of an inner loop and blocks of the outer one, for reverse mode: inner^2 blocks >=
    steps, with few steps too many.

    About 3 steps^(1/3) states are in memory at a time.
    """
    edge = max(1, round(steps ** (1 / 3)))
    inner = min(range(edge, 0, -1)[: max(1, edge // 3)], key=lambda i: -(-steps // (i * i)) * i * i)
    return inner, -(-steps // (inner * inner))
