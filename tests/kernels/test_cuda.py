"""The gpu backend: the kernel on a GPU or, without one, its logic on a CPU; its source through
NVRTC; and what happens without a device.

    JAX_PLATFORMS=cuda,cpu python -m pytest tests/kernels/test_cuda.py

runs on a GPU what elsewhere runs on the CPU.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import warnings

import gpu_on_cpu
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fallback import with_fallback
from scenarios_of_members import scenarios
from test_cpu import assert_same, draws, needs_compiler
from test_from_jaxpr import DT, STANDARD, arrays_of, carry_of, stepped

import iblf_jax as ij
from iblf_jax.core.caches import CACHE
from iblf_jax.engine import RunRequest, compile, execute, gpu, registry, thresholds
from iblf_jax.engine.batch import Batch
from iblf_jax.engine.carry import Inputs
from iblf_jax.engine.derivatives import Directions, run_with_tangents
from iblf_jax.engine.loops import kernel_stepper, program_of
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.kernels import nvrtc
from iblf_jax.kernels.emit_c import CUDA, source
from iblf_jax.kernels.layout import Layout
from iblf_jax.kernels.packed import Packed
from iblf_jax.kernels.program import Builder, finished
from iblf_jax.kernels.toolchain import ToolchainError
from iblf_jax.simulation.metrics import standard
from iblf_jax.simulation.scenario import canonical


def _has_nvrtc() -> bool:
    try:
        nvrtc.library()
    except ToolchainError:
        return False
    return True


pytestmark = pytest.mark.filterwarnings("error::iblf_jax.engine.compile.BackendWarning")
ON_A_GPU = jax.default_backend() == "gpu"
needs_a_cpu = pytest.mark.skipif(ON_A_GPU, reason="what happens without a GPU")
run_program = gpu.run if ON_A_GPU else gpu_on_cpu.run
needs_nvrtc = pytest.mark.skipif(not _has_nvrtc(), reason="no NVRTC")


def step_of(scenario, varied, folds=STANDARD, method="euler", dtype="float64"):
    """The lowered step of a scenario and the arrays that its kernel takes."""
    scenario = canonical(ij.astype(scenario, dtype))
    folds = jax.tree.map(lambda x: jnp.asarray(x, dtype), folds)
    varied = {path: jnp.asarray(x, dtype) for path, x in varied.items()}
    inputs = Inputs(scenario, folds, *jnp.asarray([DT, 1e3], dtype))
    of, carry = Batch.of(inputs, varied), carry_of(inputs, varied, method)
    program, _ = program_of(TimeStep(method), of, carry)
    return program, *arrays_of(of, carry, dtype)


@pytest.mark.skipif(not ON_A_GPU, reason="test_from_jaxpr runs one of some families")
@pytest.mark.parametrize("name", scenarios())
def test_a_kernel_does_what_its_program_does(name):
    scenario = scenarios()[name]()
    starts = scenario.initial.q + jnp.asarray([[0.0], [0.01], [-0.01]])
    program, shared, lane, carry = step_of(scenario, {"initial.q": starts})
    (floats, ints), _ = run_program(program, shared, lane, carry, 5, None)
    layout, expected = Layout.of(program), stepped(program, shared, lane, carry, 5)
    np.testing.assert_allclose(floats, expected[layout.floats], rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(ints, expected[layout.ints])


def gpu_for_this_platform(monkeypatch, **changes):
    """The gpu executor is the one that compiles kernels for CPUs."""
    record = registry.GPU._replace(platforms=("cpu",), **changes)
    monkeypatch.setattr(registry, "EXECUTORS", {"gpu": record})


@pytest.fixture
def runs_here(monkeypatch):
    """The gpu backend runs here, 64 steps a launch, on a CPU in blocks of 32 threads."""
    monkeypatch.setattr(thresholds, "MAX_STEPS_PER_LAUNCH", 64)
    CACHE.clear(compile.WARNINGS)
    if not ON_A_GPU:
        gpu_for_this_platform(monkeypatch, run=gpu_on_cpu.run, unavailable=lambda: None)


TOLERANCE = {"float64": 1e-10, "float32": 1e-4}


def runs_of(dtype, backend, steps):
    """Values -> the outcome of so many steps of runs of the paper's scenario."""
    scenario = canonical(ij.astype(ij.presets.zhang_yan_2024(), dtype))
    folds = jax.tree.map(lambda x: jnp.asarray(x, dtype), standard())
    dt, request = jnp.asarray(DT, dtype), RunRequest(steps, "heun", 7, backend=backend)
    compiled = jax.jit(lambda v: execute.run_batch(scenario, v, folds, dt, request))
    return lambda values: jax.tree.map(
        np.asarray, compiled({k: jnp.asarray(v, dtype) for k, v in values.items()})
    )


def spoiled(runs):
    """Draws, of which three fail."""
    values = draws(runs)
    values["plant.mass[1]"][1] = np.nan
    values["initial.q"][3] = 40.0
    values["plant.mass[1]"][4] = 0.02
    return values


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize(
    "dtype",
    ["float64", pytest.param("float32", marks=pytest.mark.skipif(not ON_A_GPU, reason="no GPU"))],
)
def test_a_batch_agrees_with_the_reference(dtype, runs_here):
    """37 runs are two blocks, the second not full; 200 steps are four launches, the last not
    full.  Runs that fail have the reference's status and touch no other."""
    values, by_kernel = spoiled(37), runs_of(dtype, "gpu", 200)
    found, good = by_kernel(values), by_kernel(draws(37))
    expected = runs_of(dtype, "vmap", 200)(values)
    np.testing.assert_array_equal(found.status, expected.status)
    assert len(set(found.status[[0, 1, 3]].tolist())) == 3
    others = np.setdiff1d(np.arange(37), [1, 3, 4])
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(good), strict=True):
        np.testing.assert_array_equal(x[others], y[others])
    sound = [jax.tree.map(lambda x: x[others], x) for x in (found, expected)]
    assert_same(*sound, TOLERANCE[dtype])


@pytest.mark.skipif(not ON_A_GPU, reason="no GPU")
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_on_a_gpu_many_runs_agree_with_the_reference(dtype):
    """Many blocks, of as many threads as the plan takes, in launches of their usual length."""
    values = spoiled(1000)
    found, expected = (runs_of(dtype, backend, 1000)(values) for backend in ("gpu", "vmap"))
    np.testing.assert_array_equal(found.status, expected.status)
    sound = [jax.tree.map(lambda x: x[expected.status == 0], x) for x in (found, expected)]
    assert_same(*sound, TOLERANCE[dtype])


@needs_compiler
@pytest.mark.slow
def test_one_run_is_the_run(runs_here, paper):
    timing = {"duration": 0.06, "dt": 4e-4, "method": "heun", "record_every": 10}
    one, other = (ij.simulate(paper, **timing, backend=backend) for backend in ("gpu", "vmap"))
    np.testing.assert_allclose(one.tau, other.tau, rtol=0, atol=1e-9)


@needs_compiler
@pytest.mark.slow
def test_every_run_has_its_own_jump(runs_here, paper):
    """The steps of a sampled loop are divided where each run's disturbance jumps."""
    soft = ij.with_parameters(paper, {"controller.K2": 4.0, "observer.kf": 4.0})
    late = ij.disturbances.Step(size=[20.0, 5.0], time=0.1)
    scenario = canonical(
        ij.with_parts(soft, sampling=ij.Sampling(1e-2, delay=3.7e-3), disturbance=late)
    )
    varied = {"disturbance.time": jnp.asarray([0.1, 0.0537, 0.1234, 0.9])}

    def metrics(backend):
        request, dt = RunRequest(20, "euler", backend=backend), jnp.asarray(1e-2)
        run = jax.jit(lambda v: execute.run_batch(scenario, v, standard(), dt, request))
        return run(varied).metrics

    found, expected = metrics("gpu"), metrics("vmap")
    for name in ("rmse", "effort", "torque_variation", "estimate_rmse"):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-9, err_msg=name)


@pytest.mark.slow
@needs_compiler
def test_forward_sensitivities(paper):
    scenario, dt = canonical(paper), jnp.asarray(DT)
    along = Directions.of({"controller.K2": np.eye(3, 2), "observer.kf": np.eye(3, 2, -1)})
    varied = {k: jnp.asarray(v) for k, v in draws(3).items()}
    inputs, run = Inputs(scenario, standard()[:1], dt, jnp.asarray(60.0)), RunRequest(60, "euler")
    loop = kernel_stepper(registry.GPU._replace(run=run_program))
    numbers = {path: np.reshape(x, shape) for path, shape, x in along.items}
    pushed = jax.jit(lambda v: run_with_tangents(loop, Batch.of(inputs, v), along, run))(varied)
    by_scan = run._replace(backend="vmap")
    expected = jax.jit(
        lambda v: execute.run_batch_jvp(scenario, v, numbers, inputs.folds, dt, by_scan)
    )(varied)
    for x, y in zip(pushed, expected, strict=True):
        assert_same(jax.tree.map(np.asarray, x), jax.tree.map(np.asarray, y), 1e-10)


def results_of(operation, dtype, x, y):
    """An operation on floats, for each pair of numbers, by the kernel."""
    builder = Builder(dtype)
    inputs = [builder.input("carry", i, "f") for i in range(2)]
    result = builder.emit(operation, *inputs, kind="f")
    program = finished(builder, [*inputs, -1], [*inputs, result], [])
    floats = jnp.asarray(np.stack([x, y, np.zeros_like(x)]), dtype)
    carry = Packed(floats, jnp.zeros((0, len(x)), jnp.int32))
    shared, per_run = jnp.zeros(1, dtype), jnp.zeros((1, len(x)), dtype)
    (found, _), _ = run_program(program, shared, per_run, carry, 1, None)
    return np.asarray(found[2])


@needs_compiler
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_quotients_are_within_one_unit_of_the_last_place(dtype):
    rng = np.random.default_rng(0)
    sign = rng.choice([-1.0, 1.0], (2, 20_000))
    x, y = (sign * 2.0 ** rng.uniform(-60, 60, sign.shape)).astype(dtype)
    found = results_of("div", dtype, x, y)
    exact = x.astype(np.longdouble) / y
    worst = np.max(np.abs(found - exact) / np.spacing(np.abs(exact.astype(dtype))))
    assert worst <= 1.0, f"{worst} units of the last place"


@needs_compiler
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize(
    ("operation", "expected"), [("div", np.divide), ("max", np.maximum), ("min", np.minimum)]
)
def test_special_numbers_are_those_of_ieee_754(operation, expected, dtype):
    numbers = np.asarray([0.0, -0.0, 1.0, -3.0, 1e30, 1e-30, np.inf, -np.inf, np.nan], dtype)
    x, y = (a.ravel() for a in np.meshgrid(numbers, numbers))
    with np.errstate(all="ignore"):
        exact = expected(x, y)
    normal = ~((np.abs(exact) > 0) & (np.abs(exact) < np.finfo(dtype).tiny))
    found = results_of(operation, dtype, x, y)
    np.testing.assert_allclose(found[normal], exact[normal], rtol=2 * np.finfo(dtype).eps)


@needs_compiler
def test_angles_that_become_far_within_a_later_launch(runs_here, monkeypatch):
    """A run whose angle grows beyond the limit of the polynomials, and one whose angle does not."""
    monkeypatch.setattr(thresholds, "MAX_STEPS_PER_LAUNCH", 4)
    builder = Builder("float64")
    angle, factor, total = (builder.input("carry", i, "f") for i in range(3))
    after = [
        builder.emit("mul", angle, factor, kind="f"),
        factor,
        builder.emit("add", total, builder.emit("sin", angle, kind="f"), kind="f"),
    ]
    program = finished(builder, [angle, factor, total], after, [])
    start = np.asarray([[0.7, 0.7], [64.0, 1.0], [0.0, 0.0]])
    carry = Packed(jnp.asarray(start), jnp.zeros((0, 2), jnp.int32))
    (found, _), _ = run_program(program, jnp.zeros(1), jnp.zeros((1, 2)), carry, 11, None)
    angles = start[0] * start[1] ** np.arange(11)[:, None]
    assert np.max(angles) > 1e14
    np.testing.assert_allclose(found[2], np.sum(np.sin(angles), axis=0), rtol=1e-13)


@pytest.mark.slow
@needs_a_cpu
@needs_compiler
def test_the_image_is_loaded_once_and_launched_for_some_steps_at_a_time(paper, monkeypatch):
    monkeypatch.setattr(thresholds, "MAX_STEPS_PER_LAUNCH", 4)
    program, shared, lane, carry = step_of(paper, draws(2))
    sizes, seen = (program, shared.size, lane.shape[0]), []
    for _ in range(3):
        gpu_on_cpu.run(program, shared, lane, carry, 10, None)[0].floats.block_until_ready()
        seen.append(gpu_on_cpu.launches(*sizes))
    assert [loaded for loaded, _ in seen] == [1, 1, 1]
    assert (
        np.diff([launched for _, launched in seen]).tolist() == [1 + 2 * 3] * 2
    )  # other tests may have launched it before
    (floats, ints), _ = gpu_on_cpu.run(program, shared, lane, carry, 0, None)
    np.testing.assert_array_equal(floats, carry.floats)
    np.testing.assert_array_equal(ints, carry.ints)


@pytest.mark.slow
@needs_a_cpu
@needs_compiler
def test_what_the_driver_refuses_is_an_error_of_jax(paper):
    program, shared, lane, carry = step_of(paper, draws(2))
    sizes = program, shared.size, lane.shape[0]
    nothing = gpu_on_cpu.kernel(*sizes, image=b"nothing")
    with pytest.raises(
        Exception, match=r"loading: device kernel image is invalid \(CUDA error 200\)"
    ):
        jax.block_until_ready(gpu.call(nothing, program, shared, lane, carry, 1, None, 32))
    with pytest.raises(Exception, match=r"launch: invalid argument \(CUDA error 1\)"):
        jax.block_until_ready(
            gpu.call(gpu_on_cpu.kernel(*sizes), program, shared, lane, carry, 1, None, 256)
        )
    with pytest.raises(Exception, match="wrong shapes"):
        jax.block_until_ready(
            gpu.call(gpu_on_cpu.kernel(*sizes), program, shared[1:], lane, carry, 1, None, 32)
        )


@pytest.mark.parametrize(
    ("runs", "threads"), [(1, 32), (4096, 32), (10_000, 96), (65_536, 128), (10**7, 128)]
)
def test_threads_in_a_block(runs, threads):
    assert thresholds.gpu_threads(runs, 132) == threads


@needs_a_cpu
def test_without_a_gpu_it_runs_on_vmap_with_one_warning(monkeypatch):
    CACHE.clear(compile.WARNINGS)
    called = []
    with pytest.warns(
        compile.BackendWarning,
        match="gpu backend is not for the default device, cpu: running on vmap",
    ):
        with_fallback("gpu", called.append, lambda: called.append("vmap"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with_fallback("gpu", called.append, lambda: called.append("vmap"))
    assert called == ["vmap"] * 2


@needs_a_cpu
@needs_compiler
def test_explain_says_what_a_batch_runs_on(paper, monkeypatch):
    told = repr(ij.explain(paper))
    assert "a batch runs on native\n" in told and told.endswith(
        "on native, one run a number, first and second ones; first ones by more of them in reverse"
        " mode; others by plain JAX"
    )
    gpu_for_this_platform(monkeypatch)
    told = repr(ij.explain(paper))
    assert (
        "a batch runs on vmap: it needs an NVIDIA GPU, not cpu\n" in told
        and "derivatives of simulate: by plain JAX: it needs" in told
    )


@needs_a_cpu
def test_auto_on_a_gpu_without_nvrtc_runs_on_vmap(monkeypatch):
    def missing(*_):
        raise ToolchainError("there is no NVRTC")

    CACHE.clear(compile.WARNINGS)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(gpu, "architecture", lambda: "sm_90")
    monkeypatch.setattr(nvrtc, "library", missing)
    assert registry.default_backend() == ("vmap", "there is no NVRTC")
    with pytest.warns(
        compile.BackendWarning,
        match="gpu backend is not available .there is no NVRTC.: running on vmap",
    ):
        assert with_fallback("auto", lambda name: name, lambda: "vmap") == "vmap"
    monkeypatch.setattr(nvrtc, "library", lambda: None)
    monkeypatch.setattr(gpu, "compiler", lambda: None)
    assert registry.default_backend() == ("gpu", None)


@pytest.mark.slow
@needs_a_cpu
@needs_compiler
def test_the_default_device_decides_on_a_machine_with_a_gpu(paper, monkeypatch):
    """Where JAX computes on a GPU, a user may compute on the processor: runs and studies take its
    backend and its devices."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    perturbations = {"plant.mass[1]": ij.value(ij.uniform(0.7, 0.9))}
    executor = ij.studies.LocalExecutor(devices=jax.devices("cpu"))
    with pytest.raises(
        ValueError, match=r"platform that JAX computes on, gpu.*jax\.default_device"
    ):
        ij.monte_carlo(paper, perturbations, runs=3, duration=0.05, executor=executor)
    monkeypatch.setattr(jax, "local_devices", lambda **_: pytest.fail("these would be GPUs"))
    with jax.default_device(jax.devices("cpu")[0]):
        assert registry.default_backend() == ("native", None)
        run = ij.simulate(paper, duration=0.05, dt=1e-3)
        study = ij.monte_carlo(paper, perturbations, runs=600, duration=0.05, dt=1e-3)
    assert study.backend == "native"
    assert run.ok
    assert not study.status.any()


@pytest.mark.parametrize(
    ("capabilities", "found"),
    [
        (["9.0"], "sm_90"),
        (["12.0"] * 2, "sm_120"),
        (["8.0", "9.0"], "differ"),
        (["gfx90a"], "NVIDIA"),
    ],
)
def test_architecture(capabilities, found, monkeypatch):
    class Device:
        device_kind = "a card"

        def __init__(self, capability):
            self.compute_capability = capability

    monkeypatch.setattr(jax, "local_devices", lambda: [Device(c) for c in capabilities])
    if found.startswith("sm"):
        assert gpu.architecture() == found
    else:
        with pytest.raises(ToolchainError, match=found):
            gpu.architecture()


@needs_nvrtc
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("architecture", ["sm_80", "sm_90"])
def test_nvrtc_compiles_the_kernel(architecture, dtype, paper):
    program, shared, lane, _ = step_of(paper, draws(2), method="rk4", dtype=dtype)
    text = source(program, shared.size, lane.shape[0], CUDA)
    image = nvrtc.compiled(text, architecture)
    assert image[:4] == b"\x7fELF"
    assert b"iblf_jax_advance" in image
    assert nvrtc.compiled(text, architecture) == image


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("nvcc") is None, reason="no nvcc")
def test_the_paper_s_step_stays_in_registers(paper, tmp_path):
    program, shared, lane, _ = step_of(paper, draws(2), method="rk4", dtype="float32")
    (tmp_path / "kernel.cu").write_text(source(program, shared.size, lane.shape[0], CUDA))
    command = ["nvcc", "-w", "-cubin", "-arch=sm_90", "-Xptxas", "-v", "-o", "out", "kernel.cu"]
    done = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True)
    report = done.stderr
    found = re.search(
        r"function 'iblf_jax_advance'.*?(\d+) bytes spill stores.*?Used (\d+) registers",
        report,
        re.DOTALL,
    )
    assert found, report
    assert int(found[1]) == 0
    assert int(found[2]) <= 256, "two blocks of 128 threads fit a multiprocessor"


@needs_nvrtc
def test_what_nvrtc_refuses_is_reported_in_one_line():
    for text, target in (("this is not CUDA;", "sm_90"), ("", "sm_1")):
        with pytest.raises(ToolchainError, match=r"NVRTC \d+\.\d+ failed: .*error") as error:
            nvrtc.compiled(text, target)
        assert "\n" not in str(error.value)


@needs_a_cpu
@needs_nvrtc
@needs_compiler
def test_the_kernel_is_registered_for_cuda_and_called_with_its_attributes(paper, monkeypatch):
    monkeypatch.setattr(gpu, "architecture", lambda: "sm_90")
    gpu_for_this_platform(monkeypatch)
    scenario, dt, varied = (
        canonical(paper),
        jnp.asarray(DT),
        {k: jnp.asarray(v) for k, v in draws(2).items()},
    )
    request = RunRequest(20_000, "rk4", 10, backend="gpu")
    call = jax.jit(lambda v: execute.run_batch(scenario, v, STANDARD, dt, request))
    text = call.trace(varied).lower(lowering_platforms=("cuda",)).as_text()
    assert text.count("custom_call @iblf_jax_") == 3, (
        "the rates around the start, the steps, the rates around two more instants"
    )
    assert "every = 10 : i64, steps = 20001 : i64, threads = 32 : i64" in text
