"""The gpu backend: the kernel on a GPU or, without one, on a CPU; NVRTC; and without a device.

    JAX_PLATFORMS=cuda,cpu python -m pytest tests/kernels/test_cuda.py

runs on a GPU what elsewhere runs on the CPU.
"""

from functools import partial
from types import SimpleNamespace

import gpu_on_cpu
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fallback import with_fallback
from refused import assert_refused
from scenarios_of_members import scenarios
from test_cpu import assert_same, draws, needs_compiler, part
from test_from_jaxpr import DT, STANDARD, arrays_of, carry_of, stepped

import iblf_jax as ij
from iblf_jax.core.caches import CACHE
from iblf_jax.engine import RunRequest, compile, execute, gpu, registry, thresholds
from iblf_jax.engine.batch import Batch
from iblf_jax.engine.carry import Inputs
from iblf_jax.engine.loops import program_of
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.kernels import nvrtc
from iblf_jax.kernels.emit_c import CUDA, source
from iblf_jax.kernels.layout import Layout
from iblf_jax.kernels.packed import Packed
from iblf_jax.kernels.program import Builder, finished
from iblf_jax.kernels.toolchain import ToolchainError
from iblf_jax.simulation.scenario import canonical

pytestmark = pytest.mark.filterwarnings("error::iblf_jax.engine.compile.BackendWarning")
ON_A_GPU = jax.default_backend() == "gpu"
on_a_gpu = pytest.mark.skipif(not ON_A_GPU, reason="no GPU")
needs_a_cpu = pytest.mark.skipif(ON_A_GPU, reason="what happens without a GPU")
run_program = gpu.run if ON_A_GPU else gpu_on_cpu.run


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
    folds = jax.tree.map(lambda x: jnp.asarray(x, dtype), STANDARD)
    dt, request = jnp.asarray(DT, dtype), RunRequest(steps, "heun", 7, backend=backend)
    compiled = jax.jit(lambda v: execute.run_batch(scenario, v, folds, dt, request))
    return lambda values: jax.tree.map(
        np.asarray, compiled({k: jnp.asarray(v, dtype) for k, v in values.items()})
    )


def spoiled(runs):
    values = draws(runs)
    values["plant.mass[1]"][[1, 4]] = np.nan, 0.02
    values["initial.q"][3] = 40.0
    return values


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize(
    ("dtype", "runs", "steps"),
    [("float64", 37, 200)]
    + [pytest.param(x, 1000, 1000, marks=on_a_gpu) for x in ("float64", "float32")],
)
def test_a_batch_agrees_with_the_reference(dtype, runs, steps, runs_here):
    """The last of two blocks and of four launches are not full.  Runs that fail touch no other."""
    values, by_kernel = spoiled(runs), runs_of(dtype, "gpu", steps)
    found, good = by_kernel(values), by_kernel(draws(runs))
    expected = runs_of(dtype, "vmap", steps)(values)
    np.testing.assert_array_equal(found.status, expected.status)
    assert len(set(found.status[[0, 1, 3]].tolist())) == 3
    others = np.setdiff1d(np.arange(runs), [1, 3, 4])
    found, good, expected = (part(x, others) for x in (found, good, expected))
    jax.tree.map(np.testing.assert_array_equal, found, good)
    assert_same(found, expected, TOLERANCE[dtype])


def results_of(operation, dtype, x, y):
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
def test_quotients_and_special_numbers(dtype):
    """Quotients are within one unit of the last place; special numbers are those of IEEE 754."""
    rng = np.random.default_rng(0)
    sign = rng.choice([-1.0, 1.0], (2, 20_000))
    x, y = (sign * 2.0 ** rng.uniform(-60, 60, sign.shape)).astype(dtype)
    found = results_of("div", dtype, x, y)
    exact = x.astype(np.longdouble) / y
    worst = np.max(np.abs(found - exact) / np.spacing(np.abs(exact.astype(dtype))))
    assert worst <= 1.0, f"{worst} units of the last place"
    numbers = np.asarray([0.0, -0.0, 1.0, -3.0, 1e30, 1e-30, np.inf, -np.inf, np.nan], dtype)
    x, y = (a.ravel() for a in np.meshgrid(numbers, numbers))
    for operation, expected in (("div", np.divide), ("max", np.maximum), ("min", np.minimum)):
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
def test_launches_and_what_the_driver_refuses(paper, monkeypatch):
    """The image is loaded once and launched for some steps at a time; an error is one of JAX."""
    monkeypatch.setattr(thresholds, "MAX_STEPS_PER_LAUNCH", 4)
    program, shared, lane, carry = step_of(paper, draws(2))
    sizes, seen = (program, shared.size, lane.shape[0]), []
    for _ in range(3):
        gpu_on_cpu.run(program, shared, lane, carry, 10, None)[0].floats.block_until_ready()
        seen.append(gpu_on_cpu.launches(*sizes))
    loaded, launched = zip(*seen, strict=True)
    assert loaded == (1, 1, 1)
    # Other tests may have launched it before.
    assert np.diff(launched).tolist() == [1 + 2 * 3] * 2
    (floats, ints), _ = gpu_on_cpu.run(program, shared, lane, carry, 0, None)
    np.testing.assert_array_equal(floats, carry.floats)
    np.testing.assert_array_equal(ints, carry.ints)
    kernel, nothing = gpu_on_cpu.kernel(*sizes), gpu_on_cpu.kernel(*sizes, image=b"nothing")
    for words, name, numbers, threads in (
        (r"loading: device kernel image is invalid \(CUDA error 200\)", nothing, shared, 32),
        (r"launch: invalid argument \(CUDA error 1\)", kernel, shared, 256),
        ("wrong shapes", kernel, shared[1:], 32),
    ):
        with pytest.raises(Exception, match=words):
            jax.block_until_ready(gpu.call(name, program, numbers, lane, carry, 1, None, threads))


@needs_a_cpu
def test_without_a_gpu_it_runs_on_vmap_with_one_warning(paper, monkeypatch):
    CACHE.clear(compile.WARNINGS)
    called = []
    words = "gpu backend is not for the default device, cpu: running on vmap"
    with pytest.warns(compile.BackendWarning, match=words):
        with_fallback("gpu", called.append, lambda: called.append("vmap"))
    with_fallback("gpu", called.append, lambda: called.append("vmap"))  # a warning is an error here
    assert called == ["vmap"] * 2
    gpu_for_this_platform(monkeypatch)
    told = repr(ij.explain(paper))
    assert "a batch runs on vmap: it needs an NVIDIA GPU, not cpu\n" in told
    assert "derivatives of simulate: by plain JAX: it needs" in told


@needs_a_cpu
def test_auto_on_a_gpu_without_nvrtc_runs_on_vmap(monkeypatch):
    def missing(*_):
        raise ToolchainError("there is no NVRTC")

    CACHE.clear(compile.WARNINGS)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(gpu, "architecture", lambda: "sm_90")
    monkeypatch.setattr(nvrtc, "library", missing)
    assert registry.default_backend() == ("vmap", "there is no NVRTC")
    words = "gpu backend is not available .there is no NVRTC.: running on vmap"
    with pytest.warns(compile.BackendWarning, match=words):
        assert with_fallback("auto", lambda name: name, lambda: "vmap") == "vmap"
    monkeypatch.setattr(nvrtc, "library", lambda: None)
    monkeypatch.setattr(gpu, "compiler", lambda: None)
    assert registry.default_backend() == ("gpu", None)


@pytest.mark.slow
@needs_a_cpu
@needs_compiler
def test_the_default_device_decides_on_a_machine_with_a_gpu(paper, monkeypatch):
    """Runs and studies take the backend and the devices of the processor."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    draw = partial(ij.monte_carlo, paper, {"plant.mass[1]": ij.value(ij.uniform(0.7, 0.9))})
    executor = ij.studies.LocalExecutor(devices=jax.devices("cpu"))
    words = r"platform that JAX computes on, gpu.*jax\.default_device"
    assert_refused(words, draw, runs=3, duration=0.05, executor=executor)
    monkeypatch.setattr(jax, "local_devices", lambda **_: pytest.fail("these would be GPUs"))
    with jax.default_device(jax.devices("cpu")[0]):
        assert registry.default_backend() == ("native", None)
        assert ij.simulate(paper, duration=0.05, dt=1e-3).ok
        study = draw(runs=600, duration=0.05, dt=1e-3)
    assert study.backend == "native" and not study.status.any()


ARCHITECTURES = {"sm_90": ["9.0"], "sm_120": ["12.0"] * 2}
UNKNOWN = {"differ": ["8.0", "9.0"], "NVIDIA": ["gfx90a"]}


@pytest.mark.parametrize("found", [*ARCHITECTURES, *UNKNOWN])
def test_architecture(found, monkeypatch):
    versions = (ARCHITECTURES | UNKNOWN)[found]
    devices = [SimpleNamespace(device_kind="a card", compute_capability=x) for x in versions]
    monkeypatch.setattr(jax, "local_devices", lambda: devices)
    if found in ARCHITECTURES:
        assert gpu.architecture() == found
    else:
        assert_refused(found, gpu.architecture, error=ToolchainError)


def needs_nvrtc() -> None:
    try:
        nvrtc.library()
    except ToolchainError:
        pytest.skip("no NVRTC")


@pytest.mark.parametrize(("architecture", "dtype"), [("sm_80", "float32"), ("sm_90", "float64")])
def test_nvrtc_compiles_the_kernel(architecture, dtype, paper):
    needs_nvrtc()
    program, shared, lane, _ = step_of(paper, draws(2), method="rk4", dtype=dtype)
    text = source(program, shared.size, lane.shape[0], CUDA)
    image = nvrtc.compiled(text, architecture)
    assert image[:4] == b"\x7fELF" and b"iblf_jax_advance" in image
    assert nvrtc.compiled(text, architecture) == image
    for text, target in (("this is not CUDA;", "sm_90"), ("", "sm_1")):
        with pytest.raises(ToolchainError, match=r"^NVRTC \d+\.\d+ failed: .*error.*$"):
            nvrtc.compiled(text, target)


@needs_a_cpu
@needs_compiler
def test_the_kernel_is_registered_for_cuda_and_called_with_its_attributes(paper, monkeypatch):
    needs_nvrtc()
    monkeypatch.setattr(gpu, "architecture", lambda: "sm_90")
    gpu_for_this_platform(monkeypatch)
    scenario, dt = canonical(paper), jnp.asarray(DT)
    varied = {k: jnp.asarray(v) for k, v in draws(2).items()}
    request = RunRequest(20_000, "rk4", 10, backend="gpu")
    call = jax.jit(lambda v: execute.run_batch(scenario, v, STANDARD, dt, request))
    text = call.trace(varied).lower(lowering_platforms=("cuda",)).as_text()
    assert text.count("custom_call @iblf_jax_") == 3, (
        "the rates around the start, the steps, the rates around two more instants"
    )
    assert "every = 10 : i64, steps = 20001 : i64, threads = 32 : i64" in text
