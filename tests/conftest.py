"""Settings of all tests: float64, no compilation cache on disk, no display, and the compiled runs
that many tests share."""

import ctypes
import functools
import gc
import os
import runpy
import shutil
import signal
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
os.environ.setdefault("MPLBACKEND", "Agg")
# On a machine with a GPU, too.  `JAX_PLATFORMS=cuda,cpu` runs test_cuda.py on it.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# In the environment, for notebooks, benchmarks and commands too, which are processes of their own.
# Few programs are met twice, and to keep what is compiled takes longer (15 to 25 % of a test file's
# time) than to compile these few again.
os.environ.setdefault("JAX_ENABLE_COMPILATION_CACHE", "0")
# Where in Python an operation was written stands in no program that is compiled, and costs a tenth
# of the tracing.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
# Python is told to look for garbage less often: this process here, those that it starts by what
# they find on their path.
STARTUP = ROOT / "tests" / "startup"
if str(STARTUP) not in os.environ.get("PYTHONPATH", ""):
    os.environ["PYTHONPATH"] = os.pathsep.join(
        [str(STARTUP), *filter(None, [os.environ.get("PYTHONPATH")])]
    )
runpy.run_path(str(STARTUP / "sitecustomize.py"))

import hypothesis
import jax
import numpy as np
import pytest
from jax._src.interpreters import mlir

sys.path.insert(0, str(ROOT / "tests"))
# A shell that starts the tests in the background has them ignore Ctrl-C, and so the programs that
# they start.
signal.signal(signal.SIGINT, signal.default_int_handler)

jax.config.update("jax_enable_x64", True)
# A new context for each program is a fifth of the processor time of a program of one operation, of
# which the tests have thousands.
mlir.make_ir_context = functools.cache(mlir.make_ir_context)

hypothesis.settings.register_profile(
    "default", deadline=None, max_examples=100, derandomize=bool(os.environ.get("CI"))
)
hypothesis.settings.load_profile("default")

from time_of_tests import Times

import iblf_jax as ij

PAPER = {"duration": 20.0, "dt": 1e-3, "record_every": 10}
"""The paper's run on the grid of the reference data; used wherever the length does not matter, so
that it compiles once."""

SHORT = {"duration": 0.5, "dt": 1e-3}
"""A run with every step recorded; used wherever the length does not matter, so that it compiles
once."""


XLA_FLAGS = " ".join(
    [
        "--xla_backend_optimization_level=0",
        *(
            ["--xla_cpu_use_fusion_emitters=false"]
            if jax.version.__version_info__ < (0, 11)
            else []
        ),
        "--xla_cpu_parallel_codegen_split_count=1",
        "--xla_disable_hlo_passes=hlo-verifier",
    ]
)
"""Half of the tests' time was the compilers', spent on making loops faster that run for
milliseconds.  XLA is asked for the same programs; it writes the machine's code plainly, operation
by operation and on one thread, and does not check itself after each pass.  The compiler of kernels
does not optimise either (`quick_compiler`).  `test_users_settings.py` runs tests as users compile;
so do the release tests, and all of them with TEST_AS_USERS=1 in the environment."""

STARTED = time.monotonic()

MEMORY = 3 * 2**30
"""Bytes of a process from which what it has compiled is let go after a test: what is needed again
is compiled again."""


def resident() -> int:
    """Bytes of this process in memory; 0 where that is not known."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if statm.exists() else 0


@pytest.fixture(scope="session")
def memory() -> dict[str, int]:
    """The bytes from which `bounded_memory` lets go."""
    return {"most": MEMORY}


def choose_compilers(*, plain: bool) -> None:
    """Has XLA and the compiler of kernels translate plainly, or as they do for users, in this
    process and in those that it starts."""
    # A worker's environment is its parent's, which has been here: the tester's own words are kept
    # apart.
    own = os.environ.setdefault("TESTER_XLA_FLAGS", os.environ.get("XLA_FLAGS", ""))
    compiler = os.environ.setdefault(
        "TESTER_CXX",
        os.environ.get("CXX") or next(filter(shutil.which, ("c++", "g++", "clang++")), ""),
    )
    os.environ["XLA_FLAGS"] = (
        f"{XLA_FLAGS if plain else ''} {own}".strip()
    )  # read at the first program, and the last of two flags wins
    if compiler:
        os.environ["CXX"] = str(ROOT / "tests" / "quick_compiler") if plain else compiler


def pytest_configure(config):
    """What compilers are told, by this process and those that it starts, and what JAX refuses.

    In the default run an array of another type is a slip, not a promotion; with the slow tests it
    is as in a user's session.  Ranks are promoted in both: the package broadcasts leading axes
    throughout.
    """
    plain = config.option.markexpr != "release" and not os.environ.get("TEST_AS_USERS")
    choose_compilers(plain=plain)
    if "not slow" in config.option.markexpr:
        jax.config.update("jax_numpy_dtype_promotion", "strict")
    is_worker = hasattr(config, "workerinput") or not config.getoption("numprocesses", None)
    # Tests that run pytest would write over the files.
    if is_worker and (folder := os.environ.pop("TEST_TIMES", None)):
        config.pluginmanager.register(Times(ROOT / folder))


def file_of(item: pytest.Item) -> str:
    """The file of a test, relative to the repository."""
    return item.nodeid.split("::")[0]


def pytest_collection_modifyitems(config, items):
    """With SLOW_FILES, which names files of tests, the nearest ones to a change first: leaves the
    slow tests of other files out.

    The tests of these files come in their order.  Two workers begin at both halves of the list, so
    every second file is in its second half.
    """
    if (chosen := os.environ.get("SLOW_FILES")) is None:
        return
    places = {file: place for place, file in enumerate(chosen.split())}
    left_out = {
        item for item in items if item.get_closest_marker("slow") and file_of(item) not in places
    }
    config.hook.pytest_deselected(items=list(left_out))
    items[:] = [item for item in items if item not in left_out]

    def place(item):
        number = places.get(file_of(item), len(places))
        return number % 2, number

    items.sort(key=place)


def pytest_runtest_setup(item):
    """Skips a slow test that would begin more than SLOW_MINUTES after the start."""
    minutes = float(os.environ.get("SLOW_MINUTES", "inf"))
    if item.get_closest_marker("slow") and time.monotonic() - STARTED > 60.0 * minutes:
        pytest.skip(f"slow, and not begun within {minutes:g} minutes")


@pytest.fixture(autouse=True)
def bounded_memory(memory):
    """Compiled programs of hundreds of tests would take 10 GB a process.

    Not all of it comes back (four tenths of what programs took stays), and what is needed again is
    made again, so a process that is still large afterwards is left alone until it has grown by a
    quarter of MEMORY: it would let go after every test.
    """
    yield
    if resident() > memory["most"]:
        jax.clear_caches()
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)
        memory["most"] = max(MEMORY, resident() + MEMORY // 4)


@pytest.fixture
def optimised_kernels(monkeypatch) -> None:
    """Kernels as users compile them, here and in processes that the test starts: what a page, a
    notebook or a script of the gallery computes takes longer than its compilation."""
    if compiler := os.environ["TESTER_CXX"]:
        monkeypatch.setenv("CXX", compiler)


@pytest.fixture(scope="session")
def paper() -> ij.Scenario:
    """The paper's scenario as printed."""
    return ij.presets.zhang_yan_2024()


@pytest.fixture(scope="session")
def paper_run(paper) -> ij.Rollout:
    """The paper's run, 20 s."""
    return ij.simulate(paper, **PAPER)


@pytest.fixture(scope="session")
def short_run(paper) -> ij.Rollout:
    """The first half second, every step recorded."""
    return ij.simulate(paper, **SHORT)


@pytest.fixture(scope="session")
def compiled() -> Path:
    """The folder of compiled programs of the processes that a study is divided among, or that are
    killed and started again."""
    return ROOT / ".jax_cache"


@pytest.fixture(scope="session")
def reference_data() -> dict[str, np.ndarray]:
    """The paper's run by an independent program (SciPy DOP853, rtol 1e-12)."""
    with np.load(ROOT / "tests" / "data" / "paper_reference.npz") as data:
        return dict(data)


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same ones in every test."""
    return np.random.default_rng(0)
