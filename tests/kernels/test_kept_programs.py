"""Programs on the disk: one is read only where the lowering would give the same."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax import kernels
from iblf_jax.kernels import compilation, kept_programs

FLOAT = np.dtype("float64")
FOUR = kernels.Shapes((((4,), FLOAT),))
NOTHING = kernels.Shapes(())
MATRIX = np.arange(16.0).reshape(4, 4)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder of an empty cache that keeps programs of any size."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(kept_programs, "MIN_NODES", 0)
    return tmp_path / "iblf_jax"


def step_of(*, matrix=MATRIX, factor=0.1, length=3, first=0):
    """A step with a constant array, a literal, a scan, a parameter and two inner functions."""
    inner = jax.jit(lambda x: jnp.sin(x) * factor)

    def step(shared, per_run, carry, index):
        (x,) = carry
        y, _ = jax.lax.scan(lambda x, _: (jnp.asarray(matrix) @ x, None), x, None, length)
        return [x + inner(y) + inner(x) * shared[0]], [jax.lax.slice(y, (first,), (first + 2,))]

    return step


def compiled(step, **options):
    """The program of a step, from a function object that no cache in memory knows."""
    new = lambda *arguments: step(*arguments)  # noqa: E731
    return kernels.compile_step(new, FLOAT, FOUR, NOTHING, FOUR, **options).program


def not_called(*_, **__):
    raise AssertionError("the step is lowered again")


def test_a_program_is_lowered_once(folder, monkeypatch):
    first = compiled(step_of())
    assert len(list(folder.glob("*.program"))) == 1
    monkeypatch.setattr(compilation, "_lowered", not_called)
    assert compiled(step_of()) == first
    with pytest.raises(AssertionError, match="lowered again"):
        compiled(step_of(factor=0.2))


CHANGES = {
    "constant array": {"matrix": MATRIX + 1e-15},
    "literal": {"factor": 0.2},
    "length of a scan": {"length": 2},
    "parameter of a primitive": {"first": 1},
}
OPTIONS = {
    "derivative": {"is_derivative": True},
    "known numbers": {"known": (kernels.Known(0.0), kernels.Known(1.0), None, None)},
    "limits": {"limits": kernels.LoweringLimits(written_out=1)},
}


@pytest.mark.parametrize("change", [*CHANGES, *OPTIONS])
def test_another_step_has_another_program(folder, change):
    compiled(step_of())
    compiled(step_of(**CHANGES.get(change, {})), **OPTIONS.get(change, {}))
    assert len(list(folder.glob("*.program"))) == 2


def test_a_program_of_another_version_of_the_compiler_is_not_read(folder, monkeypatch):
    compiled(step_of())
    monkeypatch.setattr(kept_programs, "_this_package", lambda: "another version")
    monkeypatch.setattr(compilation, "_lowered", not_called)
    with pytest.raises(AssertionError, match="lowered again"):
        compiled(step_of())


def test_two_equal_functions_are_not_one_function():
    """The lowering calls one function twice, or two functions once each."""
    one = jax.jit(lambda x: jnp.sin(x) * x)
    other = jax.jit(lambda x: jnp.sin(x) * x)
    shared, apart = (
        jax.make_jaxpr(lambda x, f=f, g=g: f(x) + g(x + 1.0))(1.0)
        for f, g in ((one, one), (one, other))
    )
    texts = [kept_programs._digest(x, kernels.from_jaxpr.PARAMETERS) for x in (shared, apart)]
    assert texts[0] != texts[1]


@pytest.mark.parametrize("content", [b"", b"no program", None])
def test_a_damaged_file_is_lowered_again(folder, content):
    first = compiled(step_of())
    (path,) = folder.glob("*.program")
    whole = path.read_bytes()
    path.write_bytes(whole[:-40] if content is None else content)
    assert compiled(step_of()) == first
    assert path.read_bytes() == whole


def test_without_a_folder_every_step_is_lowered(tmp_path, monkeypatch):
    monkeypatch.setattr(kept_programs, "MIN_NODES", 0)
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert compiled(step_of()).size > 0
    assert list(Path(tmp_path).glob("**/*.program")) == []


def test_a_small_program_is_not_kept(folder, monkeypatch):
    monkeypatch.setattr(kept_programs, "MIN_NODES", 10_000)
    compiled(step_of())
    assert list(folder.glob("*.program")) == []


@pytest.mark.slow
def test_steps_of_this_package_are_kept(folder):
    """Every parameter of their primitives that the lowering reads has a text."""
    sensor = ij.sensors.Encoder(
        counts=65536, noise=1e-5, velocity=ij.sensors.FilteredDifference(cutoff=400.0)
    )
    scenario = ij.with_parts(
        ij.presets.zhang_yan_2024(),
        sampling=ij.Sampling(period=2e-3, delay=1e-3),
        sensor=sensor,
        actuator=ij.actuators.Motor(bandwidth=600.0),
    )
    kernels.CACHES.clear()
    ij.explain(scenario)
    assert len(list(folder.glob("*.program"))) == 1


def test_a_step_that_cannot_be_written_as_text_is_refused_as_before(folder):
    """Keys of random numbers are neither text nor lowered."""
    key = jax.random.PRNGKey(0)

    def step(shared, per_run, carry, index):
        return [carry[0] + jax.random.normal(jax.random.fold_in(key, index))], []

    with pytest.raises(kernels.UnsupportedError):
        compiled(step)
