"""Rare-event estimators on functions whose probabilities are known; no robot is run.

The cases are independent of the package: their probabilities come from SciPy's distributions and
quadrature.
"""

from typing import NamedTuple

import numpy as np
import pytest
from scipy import integrate, stats

from iblf_jax.studies.rare_events import limit_state
from iblf_jax.studies.rare_events.crude import crude_monte_carlo
from iblf_jax.studies.rare_events.design_points import Pieces, design_points
from iblf_jax.studies.rare_events.importance import importance_sampling, tail_shape
from iblf_jax.studies.rare_events.limit_state import stagnate, upper_bound
from iblf_jax.studies.rare_events.subset import subset_simulation


class Case(NamedTuple):
    """Pieces of a margin, and the exact probability."""

    dimension: int
    probability: float
    pieces: object

    def margin(self, z):
        return np.min(self.pieces(z), axis=1)

    def of_pieces(self, z):
        """With their gradients: central differences are exact for pieces of order two."""
        steps = 1e-3 * np.eye(self.dimension)
        slopes = [(self.pieces(z + step) - self.pieces(z - step)) / 2e-3 for step in steps]
        return Pieces(self.pieces(z), np.stack(slopes, axis=-1))


def linear(dimension, beta):
    """One half space at distance beta, equally inclined to all axes."""
    a = np.full(dimension, dimension**-0.5)
    return Case(dimension, stats.norm.sf(beta), lambda z: (beta - z @ a)[:, None])


def quadratic(dimension, beta, curvature):
    """Fails where z_0 >= beta + curvature z_1^2."""

    def density(y):
        return stats.norm.pdf(y) * stats.norm.sf(beta + curvature * y * y)

    probability = integrate.quad(density, -12, 12)[0]
    return Case(dimension, probability, lambda z: beta + curvature * z[:, 1:2] ** 2 - z[:, :1])


def series(dimension, beta):
    """Fails in two opposite half spaces at distance beta."""
    sides = np.array([1.0, -1.0])
    return Case(dimension, 2 * stats.norm.sf(beta), lambda z: beta - z[:, :1] * sides)


CASES = {
    "1e-6 in 50": linear(50, 4.75),
    "1e-8 in 10": linear(10, 5.6),
    "quadratic": quadratic(5, 4.2, 0.2),
    "two regions": series(10, 4.5),
}
OPTIONS = {"share": 0.1, "levels": 20, "confidence": 0.95}


def by_subset(case, seed, runs=4000):
    return subset_simulation(case.margin, case.dimension, runs=runs, seed=seed, **OPTIONS)


def by_importance(case, seed, runs=2000):
    points, _ = design_points(case.of_pieces, np.zeros((0, case.dimension)))
    return importance_sampling(case.margin, points, runs=runs, seed=seed, confidence=0.95)


@pytest.mark.parametrize("name", CASES)
def test_subset_simulation_estimates_known_probabilities(name):
    """The mean of ten estimates is exact within four of its standard errors."""
    case = CASES[name]
    found = [by_subset(case, seed) for seed in range(10)]
    ratios = np.array([x.probability for x in found]) / case.probability
    error = found[0].coefficient_of_variation / np.sqrt(len(found))
    assert abs(np.mean(ratios) - 1) < 4 * error
    assert all(x.low < x.probability < x.high for x in found)
    product = np.prod([level.probability for level in found[0].levels])
    assert found[0].probability == pytest.approx(product)
    thresholds = [level.threshold for level in found[0].levels]
    assert np.all(np.diff(thresholds) < 0) and thresholds[-1] == 0
    assert np.all(found[0].failures.margins <= 0)


def test_one_in_a_million_from_thirty_thousand_runs():
    """Coefficient of variation 0.3 or better, in large batches; the same bits for the same seed."""
    case, sizes = CASES["1e-6 in 50"], []

    def counted(z):
        sizes.append(len(z))
        return case.margin(z)

    found = subset_simulation(counted, 50, runs=4000, seed=1, **OPTIONS)
    assert sum(sizes) <= 30_000 and min(sizes) >= 400
    assert found.coefficient_of_variation < 0.3
    again = by_subset(case, 1)
    assert again.probability == found.probability
    np.testing.assert_array_equal(again.failures.z, found.failures.z)
    assert by_subset(case, 2).probability != found.probability


@pytest.mark.parametrize("name", CASES)
def test_importance_sampling_estimates_known_probabilities(name):
    case = CASES[name]
    found = by_importance(case, 0)
    assert abs(found.probability / case.probability - 1) < 4 * found.coefficient_of_variation
    assert found.coefficient_of_variation < 0.1 and found.notes == ()


def test_design_points_of_all_regions_and_from_known_failures():
    """A margin without a gradient at the origin has a design point that only a failure leads to."""
    points, evaluations = design_points(CASES["two regions"].of_pieces, np.zeros((0, 10)))
    assert evaluations < 40
    np.testing.assert_allclose(np.sort(points[:, 0]), [-4.5, 4.5])
    np.testing.assert_allclose(points[:, 1:], 0, atol=1e-12)

    def of_pieces(z):
        ramp = np.maximum(z[:, 0] - 1, 0)
        return Pieces((3 - ramp)[:, None], np.where(z[:, :1] > 1, [[-1.0, 0.0]], 0.0)[:, None, :])

    none, _ = design_points(of_pieces, np.zeros((0, 2)))
    assert len(none) == 0
    points, _ = design_points(of_pieces, np.array([[5.0, 1.0]]))
    np.testing.assert_allclose(points, [[4.0, 0.0]], atol=1e-2)


def test_degenerate_weights_are_flagged():
    """A failure region that bends towards the origin has weights without a finite variance."""
    case = quadratic(5, 4.5, -0.1)
    assert np.mean([bool(by_importance(case, seed).notes) for seed in range(20)]) > 0.7
    assert tail_shape(stats.genpareto.rvs(0.9, size=4000, random_state=1)) > 0.5
    assert tail_shape(stats.genpareto.rvs(-0.3, size=4000, random_state=1)) < 0.2
    assert tail_shape(np.ones(100)) == -np.inf and tail_shape(np.ones(3)) == np.inf


def test_an_estimate_without_failures_is_an_upper_bound_with_notes():
    """All margins equal; margins that come no nearer; no failure among independent draws.  A load
    below 1 has margins above 0.1; the same load without its limit can fail.  No failure far from
    the origin bounds the failures behind the origin by little; around the origin itself the bound
    is that of independent draws."""

    def constant(z):
        return np.ones(len(z))

    found = subset_simulation(constant, 3, runs=500, seed=0, **OPTIONS)
    assert found.is_upper_bound and found.probability == pytest.approx(1 - 0.05 ** (1 / 500))
    assert found.low == 0 and "upper bound" in found.notes[0]
    assert "no level nearer to failure" in found.notes[1]

    def floor(z):
        return np.maximum(1 - z[:, 0], 0.1)

    found = subset_simulation(floor, 3, runs=500, seed=0, **OPTIONS)
    assert found.is_upper_bound and found.probability < stats.norm.sf(0.9)
    crude = crude_monte_carlo(constant, 3, runs=100, seed=0, confidence=0.95)
    assert crude.is_upper_bound
    assert crude.high == crude.probability == pytest.approx(1 - 0.05 ** (1 / 100))
    around = importance_sampling(constant, np.ones((1, 3)), runs=100, seed=0, confidence=0.95)
    assert around.is_upper_bound and around.notes

    def note_of(margin):
        found = subset_simulation(margin, 2, runs=500, seed=0, **OPTIONS)
        assert found.is_upper_bound
        return " ".join(found.notes)

    assert "approach 0.1 and not 0" in note_of(lambda z: 0.2 - 0.1 * stats.norm.cdf(z[:, 0]))
    assert "approach" not in note_of(lambda z: 20.0 - z[:, 0])

    options = {"runs": 4096, "seed": 0, "confidence": 0.95}
    far = importance_sampling(lambda z: z[:, 0] + 2.0, np.array([[5.0, 0.0]]), **options)
    assert far.is_upper_bound and stats.norm.sf(2.0) < far.probability == far.high <= 1
    for share in (1.0, 0.5):
        options = {"runs": 4096, "seed": 0, "confidence": 0.95, "runnable": share}
        here = importance_sampling(constant, np.zeros((1, 2)), **options)
        assert here.probability == pytest.approx(upper_bound(4096, 0.95) / share)


MARGINS = {
    "frequent": (lambda z: 0.5 - z[:, 0], 0.5),
    # As discrete parameters give: levels with ties, and a step below which floor gives 0.
    "discrete": (lambda z: np.floor(2 * (4.0 - z[:, 0])) / 2 - (z[:, 0] > 3.5), 3.5),
    # Runs that diverge, and thresholds between finite and infinite margins.
    "diverging": (lambda z: np.where(z[:, 0] > 3.0, -np.inf, 1.0 + z[:, 1] ** 2), 3.0),
    # Runs with one start have its margin unless they come nearer to a bound later: 1 % here.
    "shared": (lambda z: np.minimum(1.0, 0.4 * (4.75 - z[:, 0])), 4.75),
}
"""Margins that are no smooth function -> the normal quantile at which they fail."""


@pytest.mark.parametrize("name", MARGINS)
def test_margins_that_are_no_smooth_function(name):
    """The mean of ten estimates is exact within four of its standard errors."""
    margin, quantile = MARGINS[name]
    options = {"runs": 4000} | OPTIONS
    found = [subset_simulation(margin, 3, seed=seed, **options).probability for seed in range(10)]
    ratios = np.array(found) / stats.norm.sf(quantile)
    assert np.mean(ratios) == pytest.approx(1, abs=4 * max(np.std(ratios), 0.05) / np.sqrt(10))


def test_draws_that_cannot_be_run_are_excluded():
    """The probability is one given that a draw can be run: z_1 > 0 here."""

    def margin(z):
        return np.where(z[:, 1] > 0, 3.5 - z[:, 0], np.nan)

    exact = stats.norm.sf(3.5)
    found = subset_simulation(margin, 2, runs=4000, seed=0, **OPTIONS)
    assert found.low < exact < found.high
    crude = crude_monte_carlo(margin, 2, runs=100_000, seed=0, confidence=0.95)
    assert len(crude.levels[0].margins) == pytest.approx(50_000, rel=0.02)
    assert crude.low < exact < crude.high
    points = np.array([[3.5, 0.0]])
    around = importance_sampling(margin, points, runs=4000, seed=0, confidence=0.95, runnable=0.5)
    assert around.low < exact < around.high

    def never(z):
        return np.full(len(z), np.nan)

    options = {"runs": 9, "seed": 0, "confidence": 0.9}
    around = importance_sampling(never, points, runnable=0.0, **options)
    for nothing in (crude_monte_carlo(never, 2, **options), around):
        assert nothing.probability == nothing.high == 1
        assert nothing.is_upper_bound and nothing.notes == (limit_state.NO_RUN,)


def test_intervals_and_levels_that_end_above_the_limit_stagnate():
    """Thresholds that converge, a last level that none is below, and too few levels."""
    reference = stats.binomtest(7, 200).proportion_ci(0.9, "exact")
    expected = pytest.approx((reference.low, reference.high))
    assert limit_state.binomial_interval(7, 200, 0.9) == expected
    assert limit_state.binomial_interval(0, 50, 0.95)[0] == 0
    assert limit_state.binomial_interval(50, 50, 0.95)[1] == 1
    low, high = limit_state.log_normal_interval(1e-6, 0.2, 0.95)
    assert low * high == pytest.approx(1e-12)
    assert high / 1e-6 == pytest.approx(np.exp(1.959964 * np.sqrt(np.log(1.04))))
    assert limit_state.log_normal_interval(0.9, 2.0, 0.95)[1] == 1
    assert stats.binom.pmf(0, 300, upper_bound(300, 0.95)) == pytest.approx(0.05)

    def levels(*thresholds, last=0.1):
        shares = [0.1] * (len(thresholds) - 1) + [last]
        return [
            limit_state.Level(x, p, np.zeros(1), 0.1, 0.5)
            for x, p in zip(thresholds, shares, strict=True)
        ]

    assert stagnate(levels(1.0, 0.5, 0.1001, 0.1000)) and stagnate(levels(1.0, 0.5, last=1.0))
    assert not stagnate(levels(1.0, 0.8, 0.6, 0.4)) and not stagnate(levels(1.0, 0.0))


@pytest.mark.release
@pytest.mark.parametrize("method", [by_subset, by_importance])
@pytest.mark.parametrize("name", CASES)
def test_statistics_of_two_hundred_repetitions(name, method):
    """Unbiased within four standard errors; the reported coefficient of variation is that of the
    estimates within a quarter; the 95 % interval covers in 89 to 100 % of the repetitions."""
    case = CASES[name]
    found = [method(case, seed) for seed in range(200)]
    ratios = np.array([x.probability for x in found]) / case.probability
    spread = np.std(ratios)
    assert abs(np.mean(ratios) - 1) < 4 * spread / np.sqrt(len(found))
    reported = np.mean([x.coefficient_of_variation for x in found])
    assert reported == pytest.approx(spread / np.mean(ratios), rel=0.25)
    assert np.mean([x.low <= case.probability <= x.high for x in found]) >= 0.89
    largest = 0.3 if case.probability > 5e-7 else 0.4
    assert method is by_importance or spread < largest
