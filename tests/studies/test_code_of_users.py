"""Stores and checkpoints know the code of a user: changed code is refused, equal code goes on."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij

TIMES = np.linspace(0.0, 1.0, 1500)
SHORT = {"duration": 0.02, "dt": 2e-3, "method": "euler"}


@ij.component
class Table:
    """A torque from a table of many numbers, of which one differs between two users."""

    table: object = ij.static()
    by_callback: bool = ij.static(default=False)

    def torque(self, t, q, dq, plant, model):
        if self.by_callback:
            shape = jax.ShapeDtypeStruct((), q.dtype)
            call = lambda t: np.asarray(self.table(t))  # noqa: E731
            return q + jax.pure_callback(call, shape, t, vmap_method="sequential")
        return jnp.full_like(q, self.table(t))

    def jump_times(self):
        return jnp.zeros(0)


def table_of(middle):
    """A function of time that looks up a table of 1,500 numbers; `middle` is one of them."""
    values = np.zeros(len(TIMES))
    values[750] = middle
    return lambda t: jnp.interp(t, TIMES, values)


def scaled(factor):
    return lambda t: factor * t


def sweep(part, store, backend):
    scenario = ij.with_parts(ij.presets.zhang_yan_2024(), disturbance=part)
    options = {"metrics": (ij.metrics.Margin(),), "store": store, "backend": backend} | SHORT
    return ij.sweep(scenario, {"controller.K2": [10.0, 20.0]}, **options)


@pytest.mark.slow
@pytest.mark.parametrize(("backend", "make"), [("auto", table_of), ("vmap", scaled)])
def test_a_store_of_changed_code_is_refused(tmp_path, backend, make):
    pytest.importorskip("zarr")
    first = sweep(Table(make(1.0)), tmp_path / "store", backend)
    assert sweep(Table(make(1.0)), tmp_path / "store", backend).identical(first)
    with pytest.raises(ij.StoreError, match="the code of a law, a robot or a metric has changed"):
        sweep(Table(make(2.0)), tmp_path / "store", backend)


@pytest.mark.slow
def test_a_store_of_a_program_that_calls_python_is_not_continued(tmp_path):
    pytest.importorskip("zarr")
    part = Table(lambda t: 1.0, by_callback=True)
    written = sweep(part, tmp_path / "store", "vmap")
    assert ij.load_sweep(tmp_path / "store").identical(written)
    with pytest.raises(ij.StoreError, match=r"functions of Python compute .* cannot be compared"):
        sweep(part, tmp_path / "store", "vmap")


def tuned(part, checkpoint, iterations):
    scenario = ij.with_parts(ij.presets.zhang_yan_2024(), disturbance=part)
    goal = ij.objectives.tracking(scale=1.0) + 0.1 * ij.objectives.effort(scale=1.0)
    effort = ij.tuning.Effort(iterations=iterations, starts=1)
    options = {"effort": effort, "checkpoint": checkpoint, "progress": False} | SHORT
    return ij.tune(scenario, ["controller.K2"], goal, **options)


@pytest.mark.slow
def test_a_checkpoint_of_changed_code_or_of_a_program_that_calls_python_is_refused(tmp_path):
    file = tmp_path / "search.npz"
    tuned(Table(scaled(3.0)), file, 2)
    tuned(Table(scaled(3.0)), file, 4)
    with pytest.raises(ValueError, match="a checkpoint of this very problem"):
        tuned(Table(scaled(50.0)), file, 4)
    with pytest.raises(ValueError, match=r"checkpoint: .*pure_callback"):
        tuned(Table(lambda t: 1.0, by_callback=True), tmp_path / "other.npz", 2)


SCRIPT = """
import sys
import jax
import jax.numpy as jnp
import iblf_jax as ij
from iblf_jax.studies import blocks

jax.config.update("jax_enable_x64", True)
folder, resumed = sys.argv[1], len(sys.argv) > 2
functions = (lambda t, x: jnp.stack([-x[0], x[0] * x[1]]), lambda t, x: jnp.ones_like(x))
plant = ij.plants.StrictFeedback(*functions, n=1, order=2)
scenario = ij.Scenario(
    plant=plant,
    reference=ij.references.Sinusoid(offset=0.0, amplitude=[0.1], frequency=1.0, phase=0.0),
    bounds=ij.Bounds(lower=ij.bounds.Constant(-0.9), upper=ij.bounds.Constant(0.9)),
    controller=ij.controllers.BarrierBackstepping(k=(2.0, 5.0)),
    initial=ij.Initial(x=[[0.1], [0.0]]),
)
options = {"duration": 0.02, "dt": 2e-3}
if resumed:
    blocks.run_blocks = lambda *_, **__: iter(())  # nothing is left to compute
ij.sweep(scenario, {"controller.k[0]": [1.0, 2.0]}, store=f"{folder}/store", **options)
goal = ij.objectives.tracking(scale=1.0) + 0.1 * ij.objectives.effort(scale=1.0)
effort = ij.tuning.Effort(iterations=3 + resumed, starts=1)
options |= {"effort": effort, "checkpoint": f"{folder}/search.npz", "progress": False}
print(ij.tune(scenario, ["controller.k[0]"], goal, **options).values)
"""


@pytest.mark.slow
def test_functions_of_a_plant_are_known_in_another_process(tmp_path):
    """No address of a function is part of a key."""
    pytest.importorskip("zarr")
    environment = os.environ | {"PYTHONPATH": str(Path(ij.__file__).parents[1])}
    for more in ([], ["again"]):
        command = [sys.executable, "-c", SCRIPT, str(tmp_path), *more]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
