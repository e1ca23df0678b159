"""Options of JAX of a thread: the threads and workers of a study take those of their caller."""

import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest
import study_cases as cases
from jax._src import config as jax_config

from iblf_jax.core import thread_options
from iblf_jax.engine import CompiledBatch, RunRequest
from iblf_jax.engine.plan import ExecutionPlan
from iblf_jax.studies import blocks, workers
from iblf_jax.studies.study_setup import StudyProgram

VALUES = {
    "jax_default_device": (None, "cpu"),
    "jax_default_matmul_precision": (None, "float32"),
    "jax_default_prng_impl": ("threefry2x32", "rbg"),
    "jax_numpy_dtype_promotion": ("standard", "strict"),
    "jax_numpy_rank_promotion": ("allow", "warn"),
    "jax_transfer_guard_host_to_device": ("allow", "log"),
    "jax_transfer_guard_device_to_device": ("allow", "log"),
    "jax_transfer_guard_device_to_host": ("allow", "log"),
}
"""Two values of each option that is not a truth value."""
NOT_TRANSFERRED = {
    *("allow_f16_reductions", "array_garbage_collection_guard", "auto_pcast"),
    *("enable_custom_prng", "jax2tf_associative_scan_reductions", "legacy_prng_key"),
    *("no_execution", "no_tracing", "remove_size_one_mesh_axis_from_type", "thread_guard"),
}
"""Public options that change no result of this package, or that forbid work in other threads."""


class Prepared:
    """The members of a prepared study that `run_blocks` reads, without a computation."""

    program = StudyProgram((), CompiledBatch(RunRequest(1), ExecutionPlan((), False)))
    shared = None

    def inputs_of(self, cases):
        return None


@pytest.fixture
def seen(monkeypatch):
    """Threads and options in which blocks are computed; the computation is left out."""
    found = []

    def recorded(shared, inputs, **options):
        found.append((threading.current_thread(), thread_options.current_options()))
        return np.zeros(1)

    monkeypatch.setattr(blocks, "_execute", recorded)
    return found


@pytest.mark.parametrize("name", thread_options.OPTIONS)
def test_threads_that_run_blocks_have_the_options_of_the_caller(name, seen):
    value = next(x for x in VALUES.get(name, (False, True)) if x != getattr(jax.config, name))
    with thread_options.OPTIONS[name](value):
        list(blocks.run_blocks(Prepared(), range(3)))
    threads = {thread for thread, _ in seen}
    assert len(threads - {threading.current_thread()}) >= 1
    assert [options[name] for _, options in seen] == [value] * 3


def test_the_options_of_a_thread_are_its_own_afterwards(seen):
    before = thread_options.current_options()
    with jax.debug_nans(True):
        in_caller = thread_options.with_options_of_caller(thread_options.current_options)
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(in_caller).result()["jax_debug_nans"]
        assert not pool.submit(thread_options.current_options).result()["jax_debug_nans"]
    assert thread_options.current_options() == before


def test_every_public_option_is_transferred_or_known():
    """A new release of JAX may add an option: it belongs in one of the two lists."""
    public = {name for name in dir(jax) if isinstance(getattr(jax, name), jax_config.State)}
    transferred = {name.removeprefix("jax_") for name in thread_options.OPTIONS}
    assert public <= transferred | NOT_TRANSFERRED
    assert not transferred & NOT_TRANSFERRED


@pytest.mark.slow
def test_a_study_in_float32_is_in_float32_in_every_block():
    with jax.enable_x64(False):
        study = cases.study(runs=600)
    assert next(iter(study.metrics.values())).dtype == np.float32


class ForgetfulExecutor(ThreadPoolExecutor):
    """Runs each task in a thread that has none of the client's options, as a process has."""


@pytest.mark.slow
def test_workers_have_the_options_of_the_client(monkeypatch):
    found = []

    def recorded(*args, run_spans=workers.run_spans_here):
        found.append(jax.config.jax_default_matmul_precision)
        return run_spans(*args)

    monkeypatch.setattr(workers, "run_spans_here", recorded)
    with ForgetfulExecutor(1) as executor, jax.default_matmul_precision("float32"):
        cases.study(runs=4, executor=executor)
    assert set(found) == {"float32"}
