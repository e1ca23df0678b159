"""Studies by other executors: the same bits as in this process, lost workers, Ctrl-C, stores that
are resumed by another executor, classes of a script."""

import concurrent.futures
import concurrent.futures.process
import signal
from pathlib import Path

import numpy as np
import pytest
import study_cases as cases

import iblf_jax as ij
from iblf_jax.studies import store, workers

SCENARIO = ij.presets.zhang_yan_2024()


@pytest.fixture(scope="module")
def table():
    return cases.table()


@pytest.fixture
def threads():
    """An executor in this process: tasks are packed and unpacked as for any other."""
    with concurrent.futures.ThreadPoolExecutor(2) as executor:
        yield executor


class LosesWorkers(concurrent.futures.Executor):
    """An executor that fails after so many tasks."""

    def __init__(self, tasks, error):
        self.tasks, self.error = tasks, error

    def submit(self, function, /, *args, **more):
        future = concurrent.futures.Future()
        self.tasks -= 1
        if self.tasks < 0:
            future.set_exception(self.error)
        else:
            future.set_result(function(*args, **more))
        return future


@pytest.mark.slow
def test_studies_are_bit_identical_and_errors_of_a_task_are_the_users(threads):
    assert cases.same(cases.named(cases.study()), cases.named(cases.study(executor=threads)))
    options = {"points": 4} | cases.options()
    here = ij.sensitivity(SCENARIO, cases.perturbations(), **options)
    there = ij.sensitivity(SCENARIO, cases.perturbations(), executor=threads, **options)
    np.testing.assert_array_equal(here.total_order, there.total_order)
    assert here.runs == there.runs
    # An error of a task is not taken for a lost worker.
    with pytest.raises(ValueError, match="from the task"):
        cases.study(executor=LosesWorkers(0, ValueError("from the task")))


@pytest.mark.slow
@pytest.mark.parametrize("writer", ["client", "worker"])
def test_a_store_is_bit_identical_whoever_writes_it(threads, table, writer, tmp_path):
    options = ij.studies.StoreOptions(tmp_path / "sweep.zarr", cases.UNIT, writer=writer)
    assert cases.table(store=options, executor=threads).identical(table)
    assert cases.table(store=options.path).identical(table)


class KilledWorkerError(Exception):
    """As Dask's, which is recognised by its module."""

    __module__ = "distributed.scheduler"


@pytest.mark.slow
@pytest.mark.parametrize("kind", [concurrent.futures.BrokenExecutor, KilledWorkerError])
def test_a_lost_worker_ends_the_call_and_another_executor_resumes(kind, table, threads, tmp_path):
    path = tmp_path / "sweep.zarr"
    with pytest.raises(ij.studies.WorkerError, match=r"lost.*died.*start the same call again"):
        cases.table(store=path, executor=LosesWorkers(3, kind("a worker died")))
    assert ij.load_sweep(path).attrs["computed_cases"] <= 3 * cases.UNIT
    assert cases.table(store=path, executor=threads).identical(table)


@pytest.mark.slow
def test_ctrl_c_stops_after_a_unit(threads, table, tmp_path, monkeypatch):
    path, write = tmp_path / "sweep.zarr", store.Store.write

    def write_and_interrupt(self, unit, data):
        write(self, unit, data)
        signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(store.Store, "write", write_and_interrupt)
        with pytest.raises(KeyboardInterrupt, match=r"after 1 of 12 units.*Start the same call"):
            cases.table(store=path, executor=threads)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert cases.table(store=path, executor=threads).identical(table)


@pytest.mark.parametrize(
    ("name", "value", "remedy"),
    [
        ("iblf_jax", "0.0", "same versions"),
        ("jax", "0.0", "same versions"),
        ("jax_enable_x64", None, "JAX_ENABLE_X64=1"),
        ("compiler", "another", "vmap"),
    ],
)
def test_a_worker_of_another_kind_is_refused(name, value, remedy, threads, monkeypatch):
    client = workers.environment("vmap")
    other = client | {name: value}
    monkeypatch.setattr(workers, "environment", lambda executor: client if called() else other)
    calls = iter([False])

    def called():
        """Whether the client has packed its task."""
        return next(calls, True)

    with pytest.raises(ij.studies.WorkerError, match=rf"{name} is .*{remedy}"):
        cases.study(runs=4, seed=77, executor=threads)


def test_a_workers_path_that_is_not_shared_and_a_store_of_an_earlier_version(tmp_path):
    """The store was made by the code of commit d674b34: 4 points with 3 runs each."""
    shared = workers.SharedStore(str(tmp_path / "nothing.zarr"), {})
    with pytest.raises(ij.StoreError, match=r"no store here.*writer='client' does not"):
        workers._open_shared(shared)
    folder = Path(__file__).parents[1] / "data"
    found = ij.load_sweep(folder / "sweep_d674b34.zarr")
    with np.load(folder / "sweep_d674b34.npz") as expected:
        assert cases.same(cases.arrays(found), dict(expected))
    assert found.attrs["computed_cases"] == 12


@pytest.mark.slow
def test_units_that_another_process_writes_are_skipped(table, tmp_path, monkeypatch):
    """A second process works on the same store while this one computes."""
    path, write, seen = tmp_path / "sweep.zarr", store.Store.write, []
    options = ij.studies.StoreOptions(path, cases.UNIT, shared=True)

    def write_all_at_first(self, unit, data):
        write(self, unit, data)
        seen.append(unit)
        if len(seen) == 1:
            cases.table(store=path, executor=ij.studies.LocalExecutor(chunk=1))

    monkeypatch.setattr(store.Store, "write", write_all_at_first)
    assert cases.table(store=options, executor=ij.studies.LocalExecutor(chunk=1)).identical(table)
    assert len(seen) <= 12 + 2, "units that are written are not computed again"


@pytest.mark.slow
def test_two_processes_share_a_store(compiled, tmp_path, table):
    words = ("--store", str(tmp_path / "sweep.zarr"), "--shared")
    both = [cases.start(compiled, str(tmp_path / f"{i}.npz"), *words) for i in (0, 1)]
    for i, process in enumerate(both):
        _, errors = process.communicate(timeout=600)
        assert process.returncode == 0, errors
        assert cases.same(dict(np.load(tmp_path / f"{i}.npz")), cases.arrays(table))


@pytest.mark.slow
def test_dask_and_a_process_pool(tmp_path):
    """Two Dask workers, then a pool: see the script for what happens to them."""
    pytest.importorskip("distributed")
    script = str(Path(__file__).parent / "executor_script.py")
    process = cases.start_python(tmp_path / "compiled", script, str(tmp_path))
    shown, errors = process.communicate(timeout=900)
    assert process.returncode == 0, errors[-3000:]
    assert shown.splitlines() == ["own law", "killed worker", "Ctrl-C", "process pool"]
