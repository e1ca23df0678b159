"""Which side of a threshold is which."""

import itertools
import math

import pytest

from iblf_jax.engine import thresholds


def test_few_numbers_are_differentiated_forward_and_few_runs_of_many_steps_have_short_vectors():
    """A limit is within itself."""
    most = thresholds.MAX_FORWARD_NUMBERS
    forward = [thresholds.differentiates_forward(numbers) for numbers in (1, most, most + 1)]
    assert forward == [True, True, False]
    assert [thresholds.is_within(3, limit) for limit in (None, 4, 3, 2)] == [True] * 3 + [False]
    runs, steps = (8, 16, 17), (thresholds.FEW_STEPS, thresholds.FEW_STEPS + 1)
    short = {x for x in itertools.product(runs, steps) if thresholds.uses_short_vector(*x)}
    assert short == set(itertools.product(runs[:2], steps[1:]))


@pytest.mark.parametrize("is_short", [False, True])
def test_only_a_long_step_is_divided_into_functions(is_short):
    limit = thresholds.MAX_C_FUNCTION_NODES
    builds = [thresholds.native_build(nodes, is_short) for nodes in (limit, limit + 1)]
    segments, flags = zip(*builds, strict=True)
    assert segments == (None, thresholds.SEGMENT_NODES)
    assert all(any("VECTOR_BYTES" in flag for flag in each) == is_short for each in flags)


@pytest.mark.parametrize("steps", [1, 2, 100, 101, 20_000])
def test_a_segment_of_reverse_mode_is_the_root_of_the_steps_or_fills_its_memory(steps):
    root = math.ceil(math.sqrt(steps))
    assert thresholds.segment_steps(steps, 10**9) == root
    each = thresholds.SEGMENT_BYTES // (root + 1)
    assert thresholds.segment_steps(steps, each) == min(steps, root + 1)
