"""The registry of executors: a record that is added is used, and an unknown name is an error."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_cases import light_loop

import iblf_jax as ij
from iblf_jax.core import devices
from iblf_jax.core.caches import CACHE
from iblf_jax.engine import RunRequest, compile, compile_batch, native, registry, single_run
from iblf_jax.engine.period import radius_at
from iblf_jax.engine.plan import ExecutionPlan
from iblf_jax.kernels import StoppedError, ToolchainError, UnsupportedError
from iblf_jax.simulation.scenario import canonical

needs_compiler = pytest.mark.skipif(native.unavailable() is not None, reason="no C++ compiler")
SHORT = {"duration": 0.02, "dt": 1e-3, "method": "euler", "metrics": (ij.metrics.Margin(),)}


@pytest.fixture(scope="module")
def scenario():
    return light_loop()


DRAWS = {"controller.Kp": ij.factor(ij.uniform(0.9, 1.1))}


@pytest.fixture
def use(monkeypatch):
    """Adds an executor of this platform, first of all or the only one; the names of its calls."""

    def added(name="mine", run=native.run, build=native.build, others=()):
        calls = []

        def counted(call, function):
            def called(*arguments):
                calls.append(call)
                return function(*arguments)

            return called

        functions = counted("run", run), lambda: None, counted("build", build)
        one = registry.Executor(name, (devices.platform(),), *functions)
        monkeypatch.setattr(registry, "EXECUTORS", {name: one, **dict(others)})
        CACHE.clear(compile.WARNINGS)
        return calls

    return added


@pytest.mark.slow
@needs_compiler
def test_an_added_executor_makes_runs(scenario, use):
    for part in (single_run._initialize, single_run._all_steps, single_run._finalize):
        part.clear_cache()  # which would hold another test's "mine"
    added = use(others=registry.EXECUTORS)
    expected = ij.simulate(scenario, **SHORT, backend="vmap")
    assert added == []
    found = ij.simulate(scenario, **SHORT)
    np.testing.assert_allclose(found.q, expected.q, rtol=1e-12)
    assert added == ["run"] * 3, "the start, the steps, the end"
    added.clear()
    study = ij.monte_carlo(scenario, DRAWS, runs=3, **SHORT, backend="mine")
    assert study.setup.program.batch.backend == "mine"
    assert (added.count("build"), added.count("run")) == (2, 3)
    other = ij.monte_carlo(scenario, DRAWS, runs=3, **SHORT, backend="vmap")
    np.testing.assert_allclose(study.metrics["margin"], other.metrics["margin"], rtol=1e-12)


@pytest.mark.parametrize("backend", ["fortran", "", None, "NATIVE"])
def test_an_unknown_name_is_an_error(scenario, backend):
    loop, varied = canonical(scenario), {"controller.Kp": jnp.ones((2, 2))}
    request = RunRequest(10, backend=backend)
    for call in (
        lambda: RunRequest.of(loop, steps=10, backend=backend),
        lambda: compile_batch(request, loop, varied, (), jnp.asarray(1e-3)),
        lambda: ij.simulate(scenario, **SHORT, backend=backend),
    ):
        with pytest.raises(ValueError, match=r"backend.*one of 'auto'"):
            call()


@pytest.mark.slow
def test_where_no_kernel_can_be_compiled_auto_runs_by_the_scan(scenario, monkeypatch):
    """One warning names the remedy, for a run and for a batch."""
    reason = 'there is no C++ compiler; `pip install "iblf_jax[export]"` contains one'
    without = registry.NATIVE._replace(
        platforms=(devices.platform(),), unavailable=lambda: reason, run=None, build=None
    )
    monkeypatch.setattr(registry, "EXECUTORS", {"native": without})
    CACHE.clear(compile.WARNINGS)
    assert registry.default_backend() == ("vmap", reason)
    expected = ij.simulate(scenario, **SHORT, backend="vmap")
    with pytest.warns(compile.BackendWarning, match=r"iblf_jax\[export\].*running on vmap"):
        found = ij.simulate(scenario, **SHORT)
    np.testing.assert_array_equal(found.q, expected.q)
    with warnings.catch_warnings(action="error"):
        study = ij.monte_carlo(scenario, DRAWS, runs=3, **SHORT)
    assert study.backend == "vmap"


@pytest.mark.parametrize(
    ("failures", "tried", "result"),
    [
        ({}, ["one"], "one"),
        ({"one": ToolchainError("none")}, ["one", "two"], "two"),
        ({"one": UnsupportedError("a sort")}, ["one"], "scan"),
        ({"one": ToolchainError("none"), "two": ToolchainError("none")}, ["one", "two"], "scan"),
    ],
)
def test_one_place_falls_back(monkeypatch, failures, tried, result):
    """To the next executor where one is not available, to the scan where a step does not lower."""
    monkeypatch.setattr(registry, "EXECUTORS", {"one": "one", "two": "two"})
    execution = ExecutionPlan(("one", "two"), reports_unsupported=False)
    calls = []

    def attempt(name):
        calls.append(name)
        if name in failures:
            raise failures[name]
        return name

    CACHE.clear(compile.WARNINGS)
    with warnings.catch_warnings(record=True, action="always") as given:
        assert compile.first_that_works(execution, attempt, lambda: "scan") == result
    assert calls == tried
    missing = [str(x) for x in failures.values() if isinstance(x, ToolchainError)]
    assert len(given) == len(missing), "a step that does not lower is not reported here"


@pytest.mark.parametrize("stops", [1, 2])
def test_a_stopped_compiler_does_not_decide_the_plan_of_a_batch(scenario, use, stops):
    """One more attempt; after a second stop an error, which is not kept."""

    def build(*_):
        if len(calls) <= stops:
            raise StoppedError("the compiler was stopped")

    calls = use(build=build)
    CACHE.clear()
    request = RunRequest(10, backend="mine")
    arguments = (canonical(scenario), {"controller.Kp": jnp.ones((2, 2))}, (), jnp.asarray(1e-3))
    with warnings.catch_warnings(action="error"):
        if stops == 2:
            with pytest.raises(StoppedError):
                compile_batch(request, *arguments)
        assert compile_batch(request, *arguments).backend == "mine"
    CACHE.clear()


def calls_what_xla_does_not_know(program, shared, per_run, carry, *others):
    """As `native.run`, in a program that XLA cannot load."""
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in carry]
    carry = type(carry)(*jax.ffi.ffi_call("iblf_jax_unknown", shapes)(*carry))
    return native.run(program, shared, per_run, carry, *others)


def runs_without_its_function(*arguments):
    """As `native.run`, with a kernel whose function has another name than is looked for."""
    renamed = (None, ("-DSTRETCH=128", "-DGROUP=32", "-Diblf_jax_kernel=iblf_jax_other"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native.thresholds, "native_build", lambda *_: renamed)
        return native.run(*arguments)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(
    ("run", "reason"),
    [
        (calls_what_xla_does_not_know, "XLA failed: .*iblf_jax_unknown"),
        (runs_without_its_function, "a kernel does not load: .*iblf_jax_kernel"),
    ],
)
def test_what_cannot_be_loaded_runs_by_the_scan(scenario, use, run, reason):
    """With one warning, and one attempt in a process."""
    calls = use(run.__name__, run)
    with pytest.warns(compile.BackendWarning, match=rf"{reason}.*running on vmap") as given:
        found = ij.simulate(scenario, **SHORT)
    assert [x.category for x in given] == [compile.BackendWarning]
    assert calls
    calls.clear()
    again = ij.simulate(scenario, **SHORT)
    assert calls == []
    expected = ij.simulate(scenario, **SHORT, backend="vmap")
    np.testing.assert_array_equal(found.q, expected.q)
    np.testing.assert_array_equal(again.q, expected.q)


@pytest.mark.slow
@needs_compiler
def test_a_study_falls_back_outside_of_its_program(scenario, use):
    """The program of an executor is never that of the scan, which would be kept under its name."""
    expected = ij.monte_carlo(scenario, DRAWS, runs=3, **SHORT, backend="vmap")
    use("broken", calls_what_xla_does_not_know)
    with pytest.warns(compile.BackendWarning, match=r"XLA failed: .*running on vmap"):
        found = ij.monte_carlo(scenario, DRAWS, runs=3, **SHORT)
    for name, values in expected.metrics.items():
        np.testing.assert_array_equal(found.metrics[name], values)


@pytest.mark.slow
@needs_compiler
def test_jacobians_of_a_sampled_loop_fall_back_once(scenario, use, monkeypatch):
    """Periods that are tried one after the other try a broken executor once."""
    sampled = canonical(ij.with_parts(scenario, sampling=ij.Sampling(period=1e-3)))
    monkeypatch.setattr(registry, "EXECUTORS", {})
    expected = radius_at(sampled, 2e-3, np.zeros(0))
    calls = use("broken", calls_what_xla_does_not_know)
    with pytest.warns(compile.BackendWarning, match=r"XLA failed: .*running on vmap"):
        found = radius_at(sampled, 2e-3, np.zeros(0))
    assert calls
    calls.clear()
    assert radius_at(sampled, 2e-3, np.zeros(0)) == found
    assert calls == []
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_an_error_of_xla_is_one_line():
    """Except a lack of memory, of which another executor needs as much."""
    failures = {"": "no message", "\n": "no message", "\nnot found\n at 0": "not found"}
    for text, reason in failures.items():
        with pytest.raises(ToolchainError, match=f"^XLA failed: {reason}$"), compile.building():
            raise jax.errors.JaxRuntimeError(text)
    with pytest.raises(jax.errors.JaxRuntimeError, match="RESOURCE_EXHAUSTED"), compile.building():
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 TiB.")
