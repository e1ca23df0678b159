"""Compiled programs: those of many structures share a bounded number of places."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax._src import monitoring as jax_monitoring

import iblf_jax as ij
from iblf_jax.core import programs

needs_maps = pytest.mark.skipif(
    programs.count_maps() == 0, reason="this system does not count memory maps"
)


def counted(size: int, **static):
    """A function of arrays of any length, and the lengths for which it was traced."""
    traced: list[int] = []

    def total(x, factor=1):
        traced.append(len(x))
        return factor * jnp.sum(jnp.sin(x) ** 2)

    return programs.StructuredFunction(total, programs.Programs(size), **static), traced


def test_the_program_that_was_not_used_for_longest_leaves():
    total, traced = counted(2)
    for length in (1, 2, 1, 3, 1, 2):
        assert total(np.ones(length)) == pytest.approx(length * np.sin(1.0) ** 2)
    assert traced == [1, 2, 3, 2]


def test_static_arguments_have_programs_of_their_own():
    total, traced = counted(8, static_argnames=("factor",))
    for _ in range(2):
        assert total(np.ones(2), factor=3) == 3 * total(np.ones(2), factor=1)
    assert traced == [2, 2]
    assert total(np.ones(2), 3) == 3 * total(np.ones(2), factor=1)
    assert total._cache_size() == 3
    total.clear_cache()
    total(np.ones(2), factor=3)
    assert len(traced) == 4


def test_it_may_be_transformed_and_called_in_another_program():
    total, _ = counted(8)
    x = np.linspace(0.0, 1.0, 6).reshape(2, 3)
    by_rows = jax.jit(jax.vmap(jax.grad(total)))(x)
    np.testing.assert_allclose(by_rows, np.sin(2.0 * x))


def test_programs_of_one_function_with_different_options_are_kept_apart():
    def doubled(x):
        return 2 * x

    for level in (0, 1):
        options = {"xla_backend_optimization_level": level}
        assert float(programs.jit(doubled, options=options)(3.0)) == 6.0
    assert len(programs.PROGRAMS.of(doubled)) == 2


def test_a_program_that_is_not_optimised_may_be_a_part_of_another():
    """JAX accepts options of the compiler for a whole program only."""
    doubled = programs.jit(lambda x: 2 * x, options=programs.SHORTEST_TO_COMPILE)
    ways = (doubled, jax.jit(doubled), jax.jit(lambda _: doubled(3.0)), jax.grad(doubled))
    assert [float(way(3.0)) for way in ways] == [6.0, 6.0, 6.0, 2.0]


@pytest.mark.slow
@needs_maps
def test_programs_of_users_are_released_before_the_memory_maps_run_out():
    listeners = jax_monitoring.get_event_duration_listeners()
    (own,) = [x for x in listeners if isinstance(x, programs.ProgramBound)]
    assert own.limit == programs.most_maps() and own.bound < 0.7 * own.limit
    jax.jit(lambda x: x + 1)(2.0)
    programs.release_programs()
    before, kept = programs.count_maps(), []
    low = programs.ProgramBound(before + 80, before + 20)
    for size in range(40):
        kept.append(jax.jit(lambda x, size=size: x * size))
        assert float(kept[-1](2.0)) == 2.0 * size
        low(programs.COMPILE_EVENT, 0.1)
        assert programs.count_maps() < before + 40
    assert low.released >= 2


def test_functions_of_scenarios_are_compiled_with_the_bound():
    """`jax.jit` keeps the programs of every structure for the life of the process; a function that
    is inlined while another one is traced has none."""
    package = Path(ij.__file__).parent
    found = [
        path.name
        for folder in ("engine", "studies", "tuning")
        for path in (package / folder).glob("*.py")
        for line in path.read_text().splitlines()
        if line.startswith(("@jax.jit", "@partial(jax.jit")) and "inline=True" not in line
    ]
    assert found == ["summaries.py"], "a function of arrays alone"
