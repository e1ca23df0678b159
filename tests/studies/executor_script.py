"""A script that sends a study with a law of its own to two Dask workers and to a process pool.

`test_executors.py` runs it in a process of its own: `python executor_script.py FOLDER`.  Processes
that start by spawn import this file again, so that everything is under the guard at its end.
"""

import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1]))
import study_cases as cases

import iblf_jax as ij


@ij.component
class Spring:
    """tau = G0 + stiffness (q_d - q) - damping q'."""

    stiffness: ij.Leaf = ij.leaf("N m/rad", sign="positive")
    damping: ij.Leaf = ij.leaf("N m s/rad", sign="positive")

    def command(self, t, q, dq, f_hat, context, state):
        """The torque; the commanded velocity is the reference's."""
        tube, no = context.tube(t), jnp.zeros(q.shape, bool)
        tau = context.model.gravity(q) + self.stiffness * (tube.q_d - q) - self.damping * dq
        return ij.controllers.Command(tau, tube.dq_d, 0.0 * q, no, no), ()


def study_of_own_law(**more):
    scenario = ij.with_parts(ij.presets.zhang_yan_2024(), controller=Spring(60.0, 20.0))
    return ij.monte_carlo(scenario, cases.perturbations(), runs=300, **cases.options() | more)


def after_units(path, count, action):
    """Calls `action` in a thread when so many units of a store are written."""

    def watch():
        while True:
            try:
                if ij.load_sweep(path).attrs["computed_cases"] >= count * cases.UNIT:
                    break
            except ij.StoreError:
                pass
            time.sleep(0.005)
        action()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    return thread


def shared_by(path, writer):
    """A store whose units are written by the client or by the workers."""
    return ij.studies.StoreOptions(path, cases.UNIT, writer=writer)


def on_dask(folder, expected):
    """Dask: a law of `__main__`, a killed worker, Ctrl-C."""
    from distributed import Client, LocalCluster

    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(**options) as cluster, Client(cluster) as client:
        client.register_worker_callbacks(ij.studies.initialize_worker)
        executor = client.get_executor()
        here = cases.named(study_of_own_law())
        assert cases.same(here, cases.named(study_of_own_law(executor=executor)))
        print("own law", flush=True)

        pids = list(client.run(os.getpid).values())
        path = folder / "killed.zarr"
        after_units(path, 2, lambda: os.kill(pids[0], signal.SIGKILL))
        assert cases.table(store=shared_by(path, "worker"), executor=executor).identical(expected)
        assert pids[0] not in client.run(os.getpid).values()
        print("killed worker", flush=True)

        path = folder / "stopped.zarr"
        # After the first unit: the others take a fraction of a second.
        after_units(path, 1, lambda: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(KeyboardInterrupt, match="Start the same call or command again"):
            cases.table(store=shared_by(path, "client"), executor=executor)
        assert 0 < ij.load_sweep(path).attrs["computed_cases"] < 6 * cases.RUNS
        print("Ctrl-C", flush=True)


def on_a_pool(folder, expected):
    """A process pool resumes the store of Dask; one of its workers is killed."""
    path = folder / "stopped.zarr"
    before = ij.load_sweep(path).attrs["computed_cases"] // cases.UNIT
    context = multiprocessing.get_context("spawn")
    setup = ij.studies.initialize_worker
    lost = pytest.raises(ij.studies.WorkerError, match="start the same call again")
    with lost, ProcessPoolExecutor(2, mp_context=context, initializer=setup) as pool:
        pid = pool.submit(os.getpid).result()
        after_units(path, before + 1, lambda: os.kill(pid, signal.SIGKILL))
        cases.table(store=shared_by(path, "worker"), executor=pool)
    assert ij.load_sweep(path).attrs["computed_cases"] // cases.UNIT > before
    assert cases.table(store=path).identical(expected)
    print("process pool", flush=True)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    reference = cases.table()
    on_dask(Path(sys.argv[1]), reference)
    on_a_pool(Path(sys.argv[1]), reference)
