"""`ij.failure_probability` on runs, and the requirement of `tune` that uses its draws again."""

import tomllib
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import study_cases as cases
from refused import assert_refused
from scipy.stats import norm

import iblf_jax as ij
from iblf_jax import cli
from iblf_jax.core.status import Status, has_flag
from iblf_jax.files.study import study_from_dict
from iblf_jax.studies.rare_events import normal_space
from iblf_jax.studies.rare_events.design_points import Pieces
from iblf_jax.tuning import _failure_probability

RUN = {"duration": 0.02, "dt": 1e-3, "method": "euler", "progress": False}
"""So short that a run leaves its bounds only if it starts outside, where the probability is
known: joint i starts outside where |offset| is at least the distance to its bound."""


@pytest.fixture(scope="module")
def scenario():
    return ij.presets.zhang_yan_2024(law="pd")


def distances(scenario):
    """Distances of the start to the lower and the upper bound, (2, n)."""
    run = ij.simulate(scenario, duration=1e-3, dt=1e-3)
    return np.array([run.q[0] - run.lower[0], run.upper[0] - run.q[0]])


def perturbed(start, mass=None):
    """The perturbed leaves of all tests, so that one program serves them."""
    return {"initial.q[1]": ij.offset(start), "plant.mass": ij.factor(mass or ij.uniform(0.9, 1.1))}


def failure_probability(scenario, perturbations, **options):
    return ij.failure_probability(scenario, perturbations, **RUN | options)


def study_of(scenario, perturbations, runs, seed=0):
    """The smallest margin of each run of a study."""
    options = {"duration": 0.02, "dt": 1e-3, "method": "euler", "metrics": (ij.metrics.Margin(),)}
    study = ij.monte_carlo(scenario, perturbations, runs=runs, seed=seed, **options)
    return study, np.asarray(study.metrics.margin).min(axis=1)


def start_perturbations(scenario, beta, mass=None):
    """An offset of the start of joint 1 whose nearer bound is at beta standard deviations."""
    distance = distances(scenario)[:, 1]
    return perturbed(ij.normal(0.0, distance.min() / beta), mass), distance


def exact(distance, beta):
    return float(np.sum(norm.sf(beta * distance / distance.min())))


@pytest.fixture(scope="module")
def rare(scenario):
    """The estimate of a probability near 1e-6."""
    perturbations, distance = start_perturbations(scenario, 4.8)
    found = failure_probability(scenario, perturbations, runs=1000)
    return found, perturbations, exact(distance, 4.8)


@pytest.mark.slow
def test_a_probability_that_is_known_its_most_likely_failure_and_draws_near_it(scenario, rare):
    """The draws all fail or nearly fail, keep their leaves together, and serve a requirement."""
    found, _, probability = rare
    low, high = found.interval
    assert low < probability < high
    assert found.estimator == "subset" and found.coefficient_of_variation < 0.5
    assert found.started_outside == len(found.failures) and found.diverged == found.excluded == 0
    assert found.names == ("initial.q[1]", "plant.mass[0]", "plant.mass[1]")
    assert 1.0 in _failure_probability.FRACTIONS  # a sampled failure itself, with its own noise
    likely = found.most_likely_failure
    assert likely.distance == pytest.approx(4.8, rel=1e-2) and likely.margin <= 0
    z = dict(zip(likely.names, likely.z, strict=True))
    assert abs(z["initial.q[1]"]) == pytest.approx(4.8, rel=1e-2)
    run = likely.replay(record_every=5)
    assert has_flag(run.status, Status.BOUND_VIOLATED)
    np.testing.assert_allclose(np.min(run.metrics.margin), likely.margin, atol=1e-9)
    study, margins = study_of(scenario, found.rare_draws, 200)
    assert np.mean(margins <= 0) == pytest.approx(found.levels[-1].probability, abs=0.12)
    drawn, known = (
        {tuple(x) for x in np.column_stack([values["initial.q[1]"], values["plant.mass"]])}
        for values in (study.samples, found.nearby.values)
    )
    assert drawn <= known
    requirement = ij.objectives.failure_probability_below(1e-7, found)
    assert float(requirement.allowed) == pytest.approx(1e-7 / found.nearby_probability)
    assert requirement.quantity.signal == "deficit"
    assert float(ij.objectives.failure_probability_below(1.0, found).allowed) == 1
    with pytest.raises(ValueError, match=r"an estimate of ij\.failure_probability"):
        ij.objectives.failure_probability_below(1e-7, 1e-6)


@pytest.mark.slow
def test_other_estimators_agree_and_chunks_change_no_bit(scenario, rare):
    subset, perturbations, probability = rare
    found = failure_probability(scenario, perturbations, estimator="importance", runs=600)
    assert found.interval[0] < probability < found.interval[1]
    assert found.coefficient_of_variation < 0.15
    frequent, distance = start_perturbations(scenario, 2.0)
    crude = failure_probability(scenario, frequent, estimator="monte_carlo", runs=2000)
    assert crude.interval[0] < exact(distance, 2.0) < crude.interval[1]
    again = ij.failure_probability(scenario, frequent, **crude.arguments, progress=False)
    assert again.estimate == crude.estimate
    # With a limit above zero it is the share of a study whose margin is at most the limit.
    limit, crudely = 0.3 * float(distance.min()), {"estimator": "monte_carlo", "runs": 2000}
    nearer = failure_probability(scenario, frequent, limit=limit, **crudely)
    share = np.mean(study_of(scenario, frequent, 4000, seed=1)[1] <= limit)
    assert nearer.estimate > 1.5 * crude.estimate
    assert nearer.interval[0] < share < nearer.interval[1]
    chunks = ij.studies.LocalExecutor(chunk=256)
    again = failure_probability(scenario, perturbations, runs=1000, executor=chunks)
    assert again.estimate == subset.estimate
    np.testing.assert_array_equal(again.failures.margins, subset.failures.margins)


@pytest.mark.slow
def test_draws_that_cannot_be_run_a_nominal_run_that_fails_and_values_of_a_list(scenario):
    perturbations, distance = start_perturbations(scenario, 3.2, ij.normal(1.0, 0.6))
    found = failure_probability(scenario, perturbations, runs=1000)
    assert found.excluded > 50 and found.interval[0] < exact(distance, 3.2) < found.interval[1]
    assert "could not be run and are excluded" in repr(found)
    start = ij.normal(1.2 * distances(scenario)[1, 1], 0.01)
    found = failure_probability(scenario, perturbed(start), runs=200)
    assert found.estimate > 0.9 and found.nominal_margin < 0
    assert "medians of all draws fails" in found.notes[0]
    assert found.most_likely_failure.distance == 0
    start = ij.choice([0.0, 1.1 * distances(scenario)[1, 1]], [0.999, 0.001])
    perturbations = perturbed(start, ij.normal(1.0, 0.01))
    found = failure_probability(scenario, perturbations, runs=1000)
    assert found.interval[0] < 0.001 < found.interval[1]
    with pytest.raises(ValueError, match="continuous distributions"):
        failure_probability(scenario, perturbations, estimator="importance")


@pytest.mark.slow
def test_without_failures_the_estimate_is_a_bound(scenario):
    perturbations = perturbed(ij.uniform(-1e-3, 1e-3), ij.uniform(0.999, 1.001))
    found = failure_probability(scenario, perturbations, runs=100)
    assert found.is_upper_bound and found.most_likely_failure is None
    assert found.margins_stagnate
    assert "no failure reachable was found" in repr(found).splitlines()[0]
    assert "at most" not in repr(found)
    figure = found.plot()
    assert "No failure reachable was found" in figure.get_suptitle()
    assert [text.get_text() for text in figure.axes[1].texts] == ["no failure found"]
    crude = failure_probability(scenario, perturbations, estimator="monte_carlo", runs=100)
    assert crude.is_upper_bound and not crude.margins_stagnate
    assert "no sample failed in 101 runs; at most" in repr(crude)  # with the nominal one
    with pytest.raises(ValueError, match="draws near failure"):
        _ = crude.rare_draws
    assert_refused("in which runs failed", ij.objectives.failure_probability_below, 1e-3, crude)


MASS = {"plant.mass": ij.factor(ij.uniform(0.9, 1.1))}


@pytest.mark.parametrize(
    ("perturbations", "options", "words"),
    [
        (MASS, {"estimator": "sorm"}, "estimator"),
        (MASS, {"margin": "torques"}, "margin"),
        (MASS, {"runs": 3}, "runs"),
        (MASS, {"runs": 99, "estimator": "importance"}, ">= 100|100"),
        (MASS, {"confidence": 1.0}, "confidence"),
        (MASS, {"limit": np.nan}, "limit"),
        (MASS, {"margin": "regions"}, "region_margin|regions"),
        ({}, {}, "at least one perturbation"),
        ({"plant.mass": 3.0}, {}, r"ij\.factor\(\.\.\.\)"),
    ],
)
def test_bad_arguments(scenario, perturbations, options, words):
    assert_refused(words, failure_probability, scenario, perturbations, **options)


def test_tails_of_float32_draws_and_noise_as_a_function_of_the_point():
    """Phi(6) rounds to 1 in float32: a normal draw is finite there, a bounded one at its end."""
    z = jnp.asarray([-6.0, 6.0, 12.0], jnp.float32)
    normal = normal_space.NormalCoordinates(ij.normal(1.0, 2.0))
    np.testing.assert_allclose(normal.quantile(z), [-11.0, 13.0, 25.0])
    uniform = normal_space.NormalCoordinates(ij.uniform(2.0, 3.0))
    np.testing.assert_allclose(uniform.quantile(z), [2.0, 3.0, 3.0], atol=1e-6)
    rows = jnp.asarray([2, 0, 1], jnp.float32)
    joint = normal_space.NormalCoordinates(ij.joint_normal(jnp.float32(1), rows, "g"))
    assert joint.group == "g" and joint.draws == 3
    np.testing.assert_allclose(joint.quantile(z), 1.0)
    points = np.random.default_rng(0).normal(size=(5, 3))
    numbers = normal_space.run_numbers(points)
    assert len(set(numbers.tolist())) == 5
    np.testing.assert_array_equal(normal_space.run_numbers(points[2:3]), numbers[2:3])


@pytest.mark.slow
def test_rare_values_of_a_list_in_float32():
    """u near 1 does not resolve a weight of 1e-8 in float32; z does.  Elsewhere both agree."""
    values, weights = jnp.asarray([0.0, 1.0, 2.0], jnp.float32), [0.0, 1 - 1e-8, 1e-8]
    limit = 5.612  # Phi(-5.612) = 1e-8
    z = jnp.asarray([-9.0, 0.0, limit - 0.01, limit + 0.01], jnp.float32)
    weights = jnp.asarray(weights, jnp.float32)
    for_all = normal_space.NormalCoordinates(ij.choice(values, weights))
    np.testing.assert_array_equal(for_all.quantile(z), [1.0, 1.0, 1.0, 2.0])
    joint = normal_space.NormalCoordinates(ij.joint_samples(values, "g", weights))
    np.testing.assert_array_equal(jax.vmap(joint.quantile)(z[:, None]), [1.0, 1.0, 1.0, 2.0])
    drawn = ij.choice([3.0, 1.0, 2.0, 5.0], [0.1, 0.3, 0.0, 0.6])
    u = np.linspace(0.005, 0.995, 100)
    z = jax.scipy.special.ndtri(u)
    np.testing.assert_array_equal(drawn.of_normal(z), drawn.quantile(jnp.asarray(u)))


def test_a_run_without_a_margin_fails(scenario, monkeypatch):
    """A margin that is NaN shows nothing; it is no draw that could not be run."""
    compute = normal_space.run_all_cases

    def without_margins(*args):
        results = compute(*args)
        nothing = np.full_like(results.metrics["margin"], np.nan)
        return results._replace(metrics={**results.metrics, "margin": nothing})

    monkeypatch.setattr(normal_space, "run_all_cases", without_margins)
    perturbations, _ = start_perturbations(scenario, 4.0)
    found = failure_probability(scenario, perturbations, estimator="monte_carlo", runs=50)
    assert found.estimate == 1 and not found.is_upper_bound
    assert found.excluded == 0


class AnalyticSpace:
    """A margin of several pieces in place of runs.

    Args:
      pieces: function of z, (S, d) -> margins, (S, m).
      gradients: d of each piece by z, (m, d).
    """

    def __init__(self, pieces, gradients, seed=0):
        self.prepared = SimpleNamespace(options=SimpleNamespace(seed=seed))
        self.pieces = pieces
        self.gradients = np.asarray(gradients, float)
        self.size = self.gradients.shape[1]

    def __call__(self, z):
        return np.min(self.pieces(z), axis=1)

    def runnable_share(self):
        return 1.0

    def of_pieces(self, z):
        gradients = np.broadcast_to(self.gradients, (len(z), *self.gradients.shape))
        return Pieces(self.pieces(z), gradients)


class SearchedPieces(NamedTuple):
    """The pieces of an `AnalyticSpace`, as the check of an estimate takes them."""

    space: AnalyticSpace
    is_available: bool = True

    def __call__(self, z):
        return self.space.of_pieces(z)


def options_of(estimator):
    return _failure_probability.FailureOptions(estimator, "positions", 0.0, 0.95, 1000)


def checked_estimate(pieces, gradients, seed=0):
    """The estimate of subset simulation, and what its check reports."""
    space, options = AnalyticSpace(pieces, gradients, seed), options_of("subset")
    first = _failure_probability._by_subset(space, options, options.runs)
    arguments = (space, options, SearchedPieces(space), first, 1.0)
    return first, _failure_probability._checked_by_importance(*arguments)


SMALL = {
    "small": lambda x: 0.1 * (5.2 - x),
    "floor": lambda x: 0.1 + np.maximum(0.0, 1.0 - x),
    "equal": np.ones_like,
}
"""A small piece as a function of z_0, which subset simulation follows: most failures are at large
z_1; one with a floor above zero; and one whose only level leads nowhere."""


@pytest.mark.parametrize("name", SMALL)
def test_failures_that_subset_simulation_misses_are_found_by_the_check(name):
    slope, end = (-0.1, 4.0) if name == "small" else (0.0, 4.5)

    def pieces(z):
        return np.stack([SMALL[name](z[:, 0]), 10 * (end - z[:, 1])], axis=1)

    first, checked = checked_estimate(pieces, [[slope, 0.0], [0.0, -10.0]])
    reported, exact = checked.estimate, norm.sf(end) + (norm.sf(5.2) if name == "small" else 0.0)
    assert (first.estimator == "subset" and first.high < exact) or first.is_upper_bound
    assert first.is_upper_bound == (name != "small")
    assert len(first.levels) > 1 or name == "equal"
    assert reported.estimator == "importance" and reported.low < exact < reported.high
    note = "missed failures" if name == "small" else "reached no failure"
    assert note in reported.notes[0]


@pytest.mark.parametrize(("share", "hides"), [(0.1, True), (1.0, False)])
def test_the_check_names_a_design_point_without_sampled_failures(share, hides):
    """The levels follow z_0 > 4.5 where its piece is small, and a fourth of the failures is at
    z_1 > 4.7; both regions are sampled where neither hides the other."""
    large = 1.0 / share

    def pieces(z):
        return np.stack([share * (4.5 - z[:, 0]), large * (4.7 - z[:, 1])], axis=1)

    first, checked = checked_estimate(pieces, [[-share, 0.0], [0.0, -large]])
    assert np.any(first.failures.z[:, 1] > 4.7) != hides
    if not hides:
        assert checked.estimate.notes == ()
        return
    assert checked.estimate.probability == first.probability
    (note,) = checked.estimate.notes
    assert "near the design point at distance 4.70, which has about 28% of" in note
    np.testing.assert_allclose(checked.points, [[4.5, 0.0], [0.0, 4.7]], atol=1e-6)
    assert "1024 samples around 2 design points at distances 4.50 to 4.70 gave" in checked.check


def test_no_design_point_is_stated_and_the_check_keeps_an_estimate_that_it_confirms():
    """Of fifty estimates of one half space, at most a few are replaced: the check does not
    select the larger one of two estimates that agree."""
    space = AnalyticSpace(lambda z: np.ones((len(z), 1)), [[0.0, 0.0]])
    options = options_of("importance")
    found = _failure_probability._by_importance(space, options, SearchedPieces(space), 1.0)
    assert found.points.shape == (0, 2)
    assert "The samples are around the medians of all draws. Check: " in found.check
    assert found.estimate.notes[0] == _failure_probability.NO_DESIGN_POINT
    replaced = 0
    for seed in range(50):
        first, checked = checked_estimate(lambda z: 4.75 - z[:, :1], [[-1.0, 0.0]], seed)
        replaced += checked.estimate.estimator != first.estimator
    assert replaced <= 2


def test_joint_samples(scenario):
    """Leaves of a group are drawn from one sample; in files as the other distributions.  Other
    numbers of samples would pair them by chance; one draw for two numbers would make both the
    same."""
    values = np.arange(12.0).reshape(4, 3)
    drawn = ij.joint_samples(values, "g", [0.0, 1.0, 1.0, 0.0])
    np.testing.assert_array_equal(drawn.quantile(np.array([0.4])), values[1])
    np.testing.assert_array_equal(drawn.quantile(np.array([0.6])), values[2])
    assert [x.tolist() for x in drawn.support()] == [values[1].tolist(), values[2].tolist()]
    for bad in ({"values": 1.0}, {"group": ""}, {"weights": [1.0]}, {"weights": np.zeros(4)}):
        assert_refused("joint_samples", ij.joint_samples, **{"values": values, "group": "g"} | bad)
    samples = 'value = "joint_samples", values = [[0.1, 0.2], [0.3, 0.4]], group = "g"'
    text = cases.STUDY.replace('offset = "normal", std = 0.05', samples)
    drawn = study_from_dict(tomllib.loads(text), "study").perturbations["initial.q"].distribution
    np.testing.assert_array_equal(drawn.values, [[0.1, 0.2], [0.3, 0.4]])
    mass = ij.joint_samples([[1.0, 1.0], [1.1, 1.1], [1.2, 1.2]], "g")
    normal = ij.joint_normal([1.0, 1.0], 0.01 * np.eye(2), "g")
    two = ij.joint_samples([0.1, 0.2], "g")
    weighted = ij.joint_samples([0.1, 0.2, 0.3], "g", weights=[1.0, 2.0, 3.0])
    words = r"group 'g'.*plant\.mass.*plant\.payload"
    other = (mass, weighted, "weights of samples")
    for of_mass, of_load, message in ((mass, two, words), (normal, two, words), other):
        perturbations = {"plant.mass": ij.factor(of_mass), "plant.payload": ij.value(of_load)}
        assert_refused(message, study_of, scenario, perturbations, 8)


@pytest.mark.slow
def test_the_command(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = cases.STUDY.split("[study]")[0] + '[failure]\nestimator = "monte_carlo"\nruns = 400\n'
    (tmp_path / "failure.toml").write_text(text)
    code = cli.main(["failure", "failure.toml", "--quiet", "--seed", "2", "--out", "found.nc"])
    out, err = capsys.readouterr()
    assert code == 0, err
    assert "FailureProbability(" in out
    xarray = pytest.importorskip("xarray")
    assert xarray.load_dataset(tmp_path / "found.nc", engine="scipy").attrs["runs"] > 400
    assert cli.main(["failure", "failure.toml", "--estimator", "sorm", "--quiet"]) == 2
    assert "estimator" in capsys.readouterr().err


def arm(stiffness):
    """An arm under a PD law that leaves its bounds with a heavy load, and its perturbations."""
    pd = ij.presets.zhang_yan_2024(law="pd")
    scenario = ij.with_parameters(pd, {"controller.Kp": stiffness, "controller.Kd": 10.0})
    mass = {"plant.mass": ij.factor(ij.normal(1.0, 0.08))}
    return scenario, {"plant.payload": ij.value(ij.uniform(0.0, 1.5))} | mass


OF_ARM = {"duration": 4.0, "dt": 2e-3}


@pytest.mark.release
def test_tuned_gains_keep_a_probability():
    """Draws near failure are used again; the probability that is estimated anew keeps the limit."""
    scenario, perturbations = arm(36.0)
    before = ij.failure_probability(scenario, perturbations, runs=1000, **OF_ARM)
    limit = 1e-3 * before.estimate
    goal = ij.objectives.effort() + ij.objectives.failure_probability_below(limit, before)
    options = OF_ARM | {"perturbations": before.rare_draws, "runs": 32, "effort": "quick"}
    best = ij.tune(scenario, ["controller.Kp", "controller.Kd"], goal, **options)
    after = ij.failure_probability(best.scenario, perturbations, **before.arguments)
    assert after.estimate < limit < before.estimate


@pytest.mark.release
def test_fifty_estimates_of_a_few_in_a_thousand():
    """Subset simulation on runs of an arm agrees with 200,000 independent runs: no bias beyond
    three standard errors, and the 95 % interval covers in at least 90 % of the repetitions."""
    scenario, perturbations = arm(35.0)
    options = OF_ARM | {"progress": False}
    many = options | {"estimator": "monte_carlo", "runs": 200_000}
    crude = ij.failure_probability(scenario, perturbations, **many)
    assert 1e-3 < crude.estimate < 5e-3
    options["runs"] = 1000
    seeds = range(1, 51)
    found = [ij.failure_probability(scenario, perturbations, seed=x, **options) for x in seeds]
    assert {x.estimator for x in found} == {"subset"}
    estimates = np.array([x.estimate for x in found])
    own, of_crude = np.std(estimates) / 50**0.5, crude.coefficient_of_variation * crude.estimate
    assert abs(np.mean(estimates) - crude.estimate) < 3 * np.hypot(own, of_crude)
    assert np.mean([x.interval[0] <= crude.estimate <= x.interval[1] for x in found]) >= 0.9
