"""Branch and bound: what must be proved, what must not, and that nothing depends on threads."""

import threading
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refused import assert_refused
from test_cpu import needs_compiler

from iblf_jax.kernels import interval_kernel
from iblf_jax.kernels.toolchain import ToolchainError
from iblf_jax.proofs import search as module
from iblf_jax.proofs.search import search

pytestmark = needs_compiler

LOW, HIGH = np.full(3, -2.0), np.full(3, 2.0)
NOWHERE = jnp.zeros(0)
"""The region of a statement about the whole box."""


def bowl(x, c):
    """Its maximum, 0 at the origin, plus the constant."""
    return (c[0] - jnp.sum(x**2 / (1 + x**2)))[None], NOWHERE


def waves(x, c):
    """cos(a + b) - |x|^2/10 + c, in which variables occur several times; 1 + c at the origin."""
    a, b = 2 * x[0] + x[1], x[1] * x[2] - x[0]
    cosine = jnp.cos(a) * jnp.cos(b) - jnp.sin(a) * jnp.sin(b)
    return (cosine - 0.1 * jnp.sum(x**2) + c[0])[None], NOWHERE


def problem_of(function, constants, n=3):
    kernel = interval_kernel(function, n, constants)
    return module._Problem(kernel, LOW[None, :n], HIGH[None, :n])


def test_a_kernel_that_has_not_run_or_rounds_to_nearest_proves_nothing():
    """(x + 2^-60) - x is rounded to 0 for x = 1, and is positive."""
    kernel = interval_kernel(waves, 3, [-1.01])
    functions = dict.fromkeys(("search_box", "divide_box"), lambda *a: -1)
    refused = types.SimpleNamespace(record_size=kernel.library.record_size, **functions)
    problem = module._Problem(kernel._replace(library=refused), LOW[None], HIGH[None])
    assert_refused("rounding mode", problem.divided, 100, error=ToolchainError)
    with pytest.raises(ToolchainError, match="rounding mode"):
        problem.searched(np.zeros(problem.size), 100)

    def function(x, c):
        return ((x[0] + c[0]) - x[0])[None], NOWHERE

    one = np.ones(1)
    (nearest,), _ = function(jnp.asarray(one), [2.0**-60])
    assert nearest == 0.0
    assert not search(function, one, one, [2.0**-60], progress=False).proved

    def negative(x, c):
        return (function(x, c)[0] - 2.0**-62), NOWHERE

    assert not search(negative, one, one, [2.0**-60], progress=False).proved


def test_a_maximum_of_exactly_zero_is_not_proved_and_a_positive_one_refuted_with_a_box():
    found = search(bowl, LOW, HIGH, [0.0], progress=False)
    assert found.status == "undecided"
    assert np.all(found.worst.lower <= 0) and np.all(found.worst.upper >= 0)
    assert found.worst.bound >= 0 and np.all(found.worst.upper - found.worst.lower < 1e-5)
    found = search(waves, LOW, HIGH, [-0.9], progress=False)
    assert found.status == "refuted" and not found.proved
    (value,), _ = waves(jnp.asarray((found.worst.lower + found.worst.upper) / 2), [-0.9])
    assert value > 0 and found.worst.value == pytest.approx(float(value), abs=1e-12)


def test_regions_alternatives_and_patterns():
    """x1 + x2 + x3 < 3 inside the ball of radius 1.7 < sqrt(3), and not inside that of 1.8.  Each
    of two bounds is negative on one half."""

    def in_a_ball(x, c):
        return (jnp.sum(x) - 3.0)[None], (jnp.sum(x**2) - c[0] ** 2)[None]

    assert search(in_a_ball, LOW, HIGH, [1.7], progress=False).proved
    found = search(in_a_ball, LOW, HIGH, [1.8], progress=False)
    assert found.status == "refuted" and np.sum(found.worst.lower**2) <= 1.8**2

    def alternatives(x, c):
        return jnp.stack([x[0] - 0.1, -x[0] - 0.1]), NOWHERE

    assert search(alternatives, LOW, HIGH, progress=False).proved

    def with_sign(x, c):
        return (x[3] * x[0] + c[0])[None], NOWHERE

    low = np.array([0.5, -1.0, -1.0])
    negative, both = [[-1.0]], [[-1.0], [1.0]]
    assert search(with_sign, low, HIGH, [0.4], patterns=negative, progress=False).proved
    found = search(with_sign, low, HIGH, [0.4], patterns=both, progress=False)
    assert found.status == "refuted" and found.worst.lower[3] == found.worst.upper[3] == 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("constant", "limit"), [(-1.01, 10**9), (-1.001, 40_000), (-0.9, 10**9)])
def test_nothing_depends_on_the_number_of_threads(constant, limit):
    options = {"max_boxes": limit, "progress": False}
    first, *others = (search(waves, LOW, HIGH, [constant], threads=n, **options) for n in (1, 2, 3))
    for found in others:
        assert found[:2] == first[:2] and found.done == first.done
        assert (found.worst is None) == (first.worst is None)
        if found.worst is not None:
            np.testing.assert_array_equal(found.worst.lower, first.worst.lower)


def test_the_number_of_boxes_is_limited_units_are_left_and_a_bar_shows_the_volume(capsys):
    found = search(waves, LOW, HIGH, [-1.0001], max_boxes=50_000, progress=False)
    assert found.status == "out of boxes" and 50_000 <= found.boxes < 50_000 + 50
    assert 0 < found.done < 1 and found.worst.bound >= 0
    assert 0 < len(found.left) < found.units and found.left.shape[1:] == (2, 3)
    assert np.all(found.left[:, 0] <= found.left[:, 1])
    few = search(waves, LOW, HIGH, [-1.0001], max_boxes=100, progress=False)
    assert few.status == "out of boxes" and few.boxes < 1000
    search(waves, LOW, HIGH, [-1.01], progress=True)
    shown = capsys.readouterr().err
    assert "% of the volume" in shown and "boxes" in shown
    assert "100/100" in shown


@pytest.mark.slow
def test_proved_statements_hold_at_random_points():
    points = np.random.default_rng(0).uniform(LOW, HIGH, (10_000, 3))
    for constant in (-1.2, -1.05, -1.01, -0.99, -0.95):
        found = search(waves, LOW, HIGH, [constant], max_boxes=200_000, progress=False)
        values = np.asarray(jax.vmap(lambda x, c=constant: waves(x, [c])[0])(points))
        assert found.proved == (constant < -1)
        if found.proved:
            assert values.max() < 0 and found.worst is None and len(found.left) == 0
            assert found.done == pytest.approx(1.0, abs=1e-12)


def coupled(x, c):
    """The larger one of two terms that are 0 and have a width, beside a term of little width that
    is 0, too; the constant is the value. A bisection of x_0 or x_1 alone does not reduce the
    bound."""
    zeros = jnp.cos(x) ** 2 + jnp.sin(x) ** 2 - 1.0
    return (jnp.maximum(zeros[0], zeros[1]) + 0.01 * zeros[2] + c[0])[None], NOWHERE


@pytest.mark.slow
def test_no_coordinate_is_bisected_alone_for_ever_and_no_choice_of_it_proves_too_much(monkeypatch):
    """Without the guard x_2 alone is bisected: each of its bisections gains a little.  Scales and
    guards at random, also absurd ones, prove a statement or leave it open."""
    options = {"max_boxes": 60_000, "progress": False}
    assert search(coupled, LOW, HIGH, [-0.2], **options).proved
    monkeypatch.setattr(module, "GUARDS", (np.inf,))
    assert search(coupled, LOW, HIGH, [-0.2], **options).status == "out of boxes"
    generator = np.random.default_rng(4)
    for guard in (0.0, 1.0, 3.0, np.inf, np.nan):
        monkeypatch.setattr(module, "GUARDS", (guard,))
        for scales in 10.0 ** generator.uniform(-12.0, 12.0, (2, 3)):
            options = {"scales": scales, "max_boxes": 20_000, "progress": False}
            assert not search(waves, LOW, HIGH, [-0.999], **options).proved
            assert not search(bowl, LOW, HIGH, [0.0], **options).proved
            found = search(waves, LOW, HIGH, [-1.5], **options)
            assert found.proved == (found.done == pytest.approx(1.0, abs=1e-12))


def test_the_halves_of_a_box_cover_it():
    """After a division all units together have the volume that is not finished, and every point of
    the whole is in one of them or has a negative value."""
    units, division = problem_of(waves, [-1.01]).divided(10**6)
    low, high = units[:, :3], units[:, 3:6]
    left = np.prod(high - low, axis=1).sum() / np.prod(HIGH - LOW)
    assert division.done + left == pytest.approx(1.0, abs=1e-12)
    for point in np.random.default_rng(0).uniform(LOW, HIGH, (300, 3)):
        is_inside = np.all((low <= point) & (point <= high), axis=1).any()
        assert is_inside or waves(point, [-1.01])[0] < 0.0


@pytest.mark.slow
@pytest.mark.parametrize("constant", [-1.01, -1.001])
def test_descents_estimate_the_number_of_boxes(constant):
    found = search(waves, LOW, HIGH, [constant], progress=False)
    assert found.proved
    searched = found.boxes - problem_of(waves, [constant]).divided(10**9)[1].boxes
    assert found.expected.boxes == pytest.approx(searched, abs=5.0 * found.expected.error)
    assert found.expected.error < 0.3 * searched


def test_a_guard_that_needs_more_boxes_is_not_chosen_and_no_number_may_be_enough():
    """The bound hardly depends on x_1 and x_2, which a small guard bisects nevertheless.  Where the
    value is exactly 0 every path ends at a box that is too narrow."""

    def one_of_three(x, c):
        y = jnp.array([20.0, 1e-3, 1e-3]) * x
        return (jnp.sum(jnp.cos(y) ** 2 + jnp.sin(y) ** 2) - 3.0 + c[0])[None], NOWHERE

    problem = problem_of(one_of_three, [-1e-2])
    units, _ = problem.divided(10**6)
    fair, _ = problem.expected(units)
    assert problem.choose_guard(units).boxes < 0.1 * fair.boxes
    assert problem.guard > module.GUARDS[0]

    def zero(x, c):
        return (jnp.cos(x[0]) ** 2 + jnp.sin(x[0]) ** 2 - c[0])[None], NOWHERE

    problem = problem_of(zero, [1.0], 1)
    units, _ = problem.divided(10**5)
    expected = problem.choose_guard(units)
    assert expected.boxes == np.inf and "no number of boxes" in str(expected)


@pytest.mark.slow
def test_an_interrupted_proof_continues(tmp_path, monkeypatch):
    """After an interruption the search needs no proved unit again, and gives the same count."""
    options = {"progress": False}
    complete = search(waves, LOW, HIGH, [-1.001], **options)
    checkpoint, half = options | {"checkpoint": tmp_path / "proof.npz"}, complete.boxes // 2
    assert search(waves, LOW, HIGH, [-1.001], max_boxes=half, **checkpoint).status == "out of boxes"
    searched = []
    original = module._Problem.searched

    def counted(self, unit, max_boxes):
        searched.append(threading.get_ident())
        return original(self, unit, max_boxes)

    monkeypatch.setattr(module._Problem, "searched", counted)
    rest = search(waves, LOW, HIGH, [-1.001], **checkpoint)
    assert rest[:2] == complete[:2] and rest.done == pytest.approx(complete.done, abs=1e-12)
    resumed = len(searched)
    searched.clear()
    search(waves, LOW, HIGH, [-1.001], **options)
    assert 0 < resumed < 0.8 * len(searched)


def test_checkpoints_of_other_problems_and_units_are_refused(tmp_path, monkeypatch):
    """Units of other places do not count as proved, although their number is the same."""
    path = tmp_path / "proof.npz"
    search(waves, LOW, HIGH, [-1.2], progress=False, checkpoint=path)
    with pytest.raises(ValueError, match="this very proof"):
        search(waves, LOW, HIGH, [-1.3], progress=False, checkpoint=path)
    path.write_bytes(b"no archive")
    with pytest.raises(ValueError, match="cannot be read"):
        search(waves, LOW, HIGH, [-1.2], progress=False, checkpoint=path)
    path.unlink()
    search(waves, LOW, HIGH, [-1.02], progress=False, checkpoint=path)
    divided = module._Problem.divided

    def in_another_order(self, max_boxes):
        units, division = divided(self, max_boxes)
        return units[::-1].copy(), division

    monkeypatch.setattr(module._Problem, "divided", in_another_order)
    with pytest.raises(ValueError, match="this very proof"):
        search(waves, LOW, HIGH, [-1.02], progress=False, checkpoint=path)


def test_no_two_problems_have_the_bytes_of_a_digest_in_common():
    """Numbers that move from one part of a problem to the next one give another digest."""
    kernel = interval_kernel(waves, 3, [-1.2])
    units = np.arange(44.0).reshape(4, 11)

    def digest(lower, upper, units, scales=None):
        return module._Problem(kernel, lower, upper, scales).digest(units)

    digests = [
        digest(LOW[None], HIGH[None], units),
        digest(LOW[None], HIGH[None], units.reshape(2, 22)),
        digest(LOW[None], HIGH[None], units[:3]),
        digest(np.stack([LOW, HIGH]), np.stack([HIGH, HIGH]), units),
        digest(LOW[None], np.nextafter(HIGH, 3.0)[None], units),
        digest(LOW[None], HIGH[None], units, np.array([4.0, 4.0, 2.0])),
    ]
    assert len(set(digests)) == len(digests)


@pytest.mark.parametrize(
    ("lower", "options", "message"),
    [
        ([0.0, 2.0], {}, "lower"),
        ([0.0, np.nan], {}, "lower"),
        ([0.0], {}, "lower"),
        ([0.0, 0.0], {"threads": 0}, "threads"),
        ([0.0, 0.0], {"max_boxes": 0}, "max_boxes"),
        ([0.0, 0.0], {"scales": [0.0, 1.0]}, "scales"),
        ([0.0, 0.0], {"scales": [1.0]}, "scales"),
    ],
)
def test_bad_input_is_refused(lower, options, message):
    assert_refused(message, search, bowl, lower, [1.0, 1.0], [0.0], **options)
