"""`ij.failure_probability` on runs, and the requirement of `tune` that uses its draws again."""

from __future__ import annotations

import re

import numpy as np
import pytest
import study_cases as cases

import iblf_jax as ij
from iblf_jax.core.status import Status, has_flag
from iblf_jax.studies.rare_events import normal_space
from iblf_jax.studies.rare_events.result import FailureProbability

RUN = {"duration": 0.02, "dt": 1e-3, "integrator": "euler", "progress": False}
"""So short that a run leaves its bounds only if it starts outside, where the probability is
known: joint i starts outside where |offset| is at least the distance to its bound."""


@pytest.fixture(scope="module")
def scenario():
    return ij.presets.zhang_yan_2024(law="pd")


def distances(scenario):
    """Distances of the start to the lower and the upper bound, (2, n)."""
    run = ij.simulate(scenario, duration=1e-3, dt=1e-3)
    return np.array([run.q[0] - run.lower[0], run.upper[0] - run.q[0]])


def perturbed(start, mass):
    """The perturbed leaves of all tests, so that one program serves them."""
    return {"initial.q[1]": ij.offset(start), "plant.mass": ij.factor(mass)}


def start_perturbations(scenario, beta, mass=None):
    """An offset of the start of joint 1 whose nearer bound is at beta standard deviations."""
    distance = distances(scenario)[:, 1]
    start = ij.normal(0.0, distance.min() / beta)
    return perturbed(start, mass or ij.uniform(0.9, 1.1)), distance


def exact(distance, beta):
    from scipy.stats import norm

    return float(np.sum(norm.sf(beta * distance / distance.min())))


@pytest.fixture(scope="module")
def rare(scenario):
    """The estimate of a probability near 1e-6."""
    perturbations, distance = start_perturbations(scenario, 4.8)
    found = ij.failure_probability(scenario, perturbations, runs=1000, **RUN)
    return found, perturbations, exact(distance, 4.8)


def test_a_probability_of_runs_that_is_known(rare):
    found, _, probability = rare
    low, high = found.interval
    assert low < probability < high
    assert found.method == "subset"
    assert found.coefficient_of_variation < 0.5
    assert found.started_outside == len(found.failures)
    assert found.diverged == found.excluded == 0
    likely = found.most_likely_failure
    assert likely.distance == pytest.approx(4.8, rel=1e-2)
    assert likely.margin <= 0
    z = dict(zip(likely.names, likely.z, strict=True))
    assert abs(z["initial.q[1]"]) == pytest.approx(4.8, rel=1e-2)
    assert found.names == ("initial.q[1]", "plant.mass[0]", "plant.mass[1]")


def test_the_most_likely_failure_fails_again(rare):
    found, _, _ = rare
    run = found.most_likely_failure.replay(record_every=5)
    assert has_flag(run.status, Status.BOUND_VIOLATED)
    np.testing.assert_allclose(
        np.min(run.metrics.margin), found.most_likely_failure.margin, atol=1e-9
    )


def test_the_words_of_a_result(rare):
    found, _, _ = rare
    text = repr(found)
    assert re.match(r"FailureProbability\(\S+e-0\d, 95% interval \S+ to \S+, coefficient", text)
    for words in (
        "Subset simulation with",
        "most likely failure found: distance 4.8",
        "initial.q[1]",
    ):
        assert words in text
    data = found.to_xarray()
    assert data.z.shape == found.failures.z.shape
    assert data.attrs["estimate"] == found.estimate
    assert data["initial.q[1]"].shape == (len(found.failures),)
    assert "<img" in found._repr_html_()


def test_importance_sampling_and_monte_carlo_agree(scenario, rare):
    _, perturbations, probability = rare
    found = ij.failure_probability(scenario, perturbations, method="importance", runs=600, **RUN)
    assert found.interval[0] < probability < found.interval[1]
    assert found.coefficient_of_variation < 0.15
    frequent, distance = start_perturbations(scenario, 2.0)
    crude = ij.failure_probability(scenario, frequent, method="monte_carlo", runs=2000, **RUN)
    assert crude.interval[0] < exact(distance, 2.0) < crude.interval[1]
    again = ij.failure_probability(scenario, frequent, **crude.arguments, progress=False)
    assert again.estimate == crude.estimate


def test_the_same_bits_for_a_seed_whatever_the_chunks(scenario, rare):
    found, perturbations, _ = rare
    chunks = ij.studies.ThisProcess(chunk=256)
    again = ij.failure_probability(scenario, perturbations, runs=1000, executor=chunks, **RUN)
    assert again.estimate == found.estimate
    np.testing.assert_array_equal(again.failures.margins, found.failures.margins)


def test_draws_that_cannot_be_run_are_counted(scenario):
    perturbations, distance = start_perturbations(scenario, 3.2, ij.normal(1.0, 0.6))
    found = ij.failure_probability(scenario, perturbations, runs=1000, **RUN)
    assert found.excluded > 50
    assert found.interval[0] < exact(distance, 3.2) < found.interval[1]
    assert "could not be run and are excluded" in repr(found)


def test_a_nominal_run_that_fails_is_said(scenario):
    start = ij.normal(1.2 * distances(scenario)[1, 1], 0.01)
    moved = perturbed(start, ij.uniform(0.9, 1.1))
    found = ij.failure_probability(scenario, moved, runs=200, **RUN)
    assert found.estimate > 0.9
    assert found.nominal_margin < 0
    assert "nominal run fails" in found.notes[0]
    assert found.most_likely_failure.distance == 0


def test_a_limit_above_zero(scenario):
    """The share of the runs of a study whose margin is at most the limit."""
    perturbations, distance = start_perturbations(scenario, 4.0)
    limit = 0.3 * float(distance.min())
    found = ij.failure_probability(scenario, perturbations, runs=1000, limit=limit, **RUN)
    options = {"duration": 0.02, "dt": 1e-3, "method": "euler", "metrics": (ij.metrics.Margin(),)}
    study = ij.monte_carlo(scenario, perturbations, runs=20_000, **options)
    share = np.mean(study.metrics.margin.min(axis=1) <= limit)
    assert found.interval[0] < share < found.interval[1]
    assert len(found.levels) == 3


def test_without_failures_the_estimate_is_a_bound(scenario):
    perturbations = perturbed(ij.uniform(-1e-3, 1e-3), ij.uniform(0.999, 1.001))
    found = ij.failure_probability(scenario, perturbations, runs=100, **RUN)
    assert found.is_upper_bound
    assert found.most_likely_failure is None
    assert "none of which failed" in repr(found)
    figure = found.plot()
    assert "at most" in figure.get_suptitle()
    assert [text.get_text() for text in figure.axes[1].texts] == ["no run failed"]
    crude = ij.failure_probability(scenario, perturbations, method="monte_carlo", runs=100, **RUN)
    assert crude.is_upper_bound
    with pytest.raises(ValueError, match="draws near failure"):
        _ = crude.rare_draws
    with pytest.raises(ValueError, match="in which runs failed"):
        ij.objectives.failure_probability_below(1e-3, crude)


def test_discrete_distributions(scenario):
    distance = distances(scenario)[1, 1]
    start = ij.choice([0.0, 1.1 * distance], [0.999, 0.001])
    perturbations = perturbed(start, ij.normal(1.0, 0.01))
    found = ij.failure_probability(scenario, perturbations, runs=1000, **RUN)
    assert found.interval[0] < 0.001 < found.interval[1]
    with pytest.raises(ValueError, match="continuous distributions"):
        ij.failure_probability(scenario, perturbations, method="importance", **RUN)


def test_bad_arguments(scenario):
    perturbations = {"plant.mass": ij.factor(ij.uniform(0.9, 1.1))}
    for words, given in {
        "method": {"method": "sorm"},
        "margin": {"margin": "torques"},
        "runs": {"runs": 3},
        "confidence": {"confidence": 1.0},
        "limit": {"limit": np.nan},
        "region_margin|regions": {"margin": "regions"},
    }.items():
        with pytest.raises(ValueError, match=words):
            ij.failure_probability(scenario, perturbations, **(RUN | given))
    with pytest.raises(ValueError, match="at least one perturbation"):
        ij.failure_probability(scenario, {}, **RUN)
    with pytest.raises(ValueError, match=r"ij\.factor\(\.\.\.\)"):
        ij.failure_probability(scenario, {"plant.mass": 3.0}, **RUN)


def test_tails_of_float32_draws():
    """Phi(6) rounds to 1 in float32; a normal draw is still finite there, and a bounded one is at
    its end."""
    import jax.numpy as jnp

    z = jnp.asarray([-6.0, 6.0, 12.0], jnp.float32)
    normal = normal_space.NormalCoordinates(ij.normal(1.0, 2.0))
    np.testing.assert_allclose(normal.quantile(z), [-11.0, 13.0, 25.0])
    uniform = normal_space.NormalCoordinates(ij.uniform(2.0, 3.0))
    np.testing.assert_allclose(uniform.quantile(z), [2.0, 3.0, 3.0], atol=1e-6)
    rows = jnp.asarray([2, 0, 1], jnp.float32)
    joint = normal_space.NormalCoordinates(ij.joint_normal(jnp.float32(1), rows, "g"))
    assert joint.group == "g"
    assert joint.draws == 3
    np.testing.assert_allclose(joint.quantile(z), 1.0)


def test_noise_is_a_function_of_the_point():
    z = np.random.default_rng(0).normal(size=(5, 3))
    numbers = normal_space.run_numbers(z)
    assert len(set(numbers.tolist())) == 5
    np.testing.assert_array_equal(normal_space.run_numbers(z[2:3]), numbers[2:3])


def test_joint_samples():
    """Leaves of a group are drawn from one sample; in files as the other distributions."""
    from iblf_jax.files.study import study_from_dict

    values = np.arange(12.0).reshape(4, 3)
    drawn = ij.joint_samples(values, "g", [0.0, 1.0, 1.0, 0.0])
    np.testing.assert_array_equal(drawn.quantile(np.array([0.4])), values[1])
    np.testing.assert_array_equal(drawn.quantile(np.array([0.6])), values[2])
    assert [x.tolist() for x in drawn.support()] == [values[1].tolist(), values[2].tolist()]
    for bad in ({"values": 1.0}, {"group": ""}, {"weights": [1.0]}, {"weights": np.zeros(4)}):
        with pytest.raises(ValueError, match="joint_samples"):
            ij.joint_samples(**({"values": values, "group": "g"} | bad))
    import tomllib

    text = cases.STUDY.replace(
        'initial.q = { offset = "normal", std = 0.05 }',
        'initial.q = { value = "joint_samples", values = [[0.1, 0.2], [0.3, 0.4]], group = "g" }',
    )
    file = study_from_dict(tomllib.loads(text), "study")
    np.testing.assert_array_equal(
        file.perturbations["initial.q"].distribution.values, [[0.1, 0.2], [0.3, 0.4]]
    )


def test_the_draws_near_failure_are_perturbations(scenario, rare):
    """All of the draws fail or nearly fail, and keep their leaves together."""
    found, _, _ = rare
    study = ij.monte_carlo(
        scenario,
        found.rare_draws,
        runs=200,
        duration=0.02,
        dt=1e-3,
        method="euler",
        metrics=(ij.metrics.Margin(),),
    )
    share = np.mean(study.metrics.margin.min(axis=1) <= 0)
    assert share == pytest.approx(found.levels[-1].probability, abs=0.12)
    drawn = np.column_stack([study.samples["initial.q[1]"], study.samples["plant.mass"]])
    known = np.column_stack(
        [found.nearby.values["initial.q[1]"], found.nearby.values["plant.mass"]]
    )
    assert {tuple(x) for x in drawn} <= {tuple(x) for x in known}


def test_the_requirement_of_a_probability(rare):
    found, _, _ = rare
    requirement = ij.objectives.failure_probability_below(1e-7, found)
    assert float(requirement.allowed) == pytest.approx(1e-7 / found.nearby_probability)
    assert requirement.quantity.signal == "deficit"
    assert float(ij.objectives.failure_probability_below(1.0, found).allowed) == 1
    with pytest.raises(ValueError, match=r"an estimate of ij\.failure_probability"):
        ij.objectives.failure_probability_below(1e-7, 1e-6)
    assert isinstance(found, FailureProbability)


@pytest.mark.slow
def test_the_command(tmp_path, capsys, monkeypatch):
    from iblf_jax import cli

    monkeypatch.chdir(tmp_path)
    text = cases.STUDY.split("[study]")[0] + '[failure]\nmethod = "monte_carlo"\nruns = 400\n'
    (tmp_path / "failure.toml").write_text(text)
    code = cli.main(["failure", "failure.toml", "--quiet", "--seed", "2", "--out", "found.nc"])
    out, err = capsys.readouterr()
    assert code == 0, err
    assert "FailureProbability(" in out
    xarray = pytest.importorskip("xarray")
    assert xarray.load_dataset(tmp_path / "found.nc", engine="scipy").attrs["runs"] > 400
    assert cli.main(["failure", "failure.toml", "--method", "sorm", "--quiet"]) == 2
    assert "method" in capsys.readouterr().err


def arm(stiffness):
    """An arm under a PD law that leaves its bounds with a heavy load, and its perturbations."""
    pd = ij.presets.zhang_yan_2024(law="pd")
    scenario = ij.with_parameters(pd, {"controller.Kp": stiffness, "controller.Kd": 10.0})
    perturbations = {
        "plant.payload": ij.value(ij.uniform(0.0, 1.5)),
        "plant.mass": ij.factor(ij.normal(1.0, 0.08)),
    }
    return scenario, perturbations


OF_ARM = {"duration": 4.0, "dt": 2e-3}


@pytest.mark.release
def test_tuned_gains_keep_a_probability():
    """Draws near failure are used again; the probability that is estimated anew keeps the limit."""
    scenario, perturbations = arm(36.0)
    before = ij.failure_probability(scenario, perturbations, runs=1000, **OF_ARM)
    limit = 1e-3 * before.estimate
    best = ij.tune(
        scenario,
        ["controller.Kp", "controller.Kd"],
        ij.objectives.effort() + ij.objectives.failure_probability_below(limit, before),
        perturbations=before.rare_draws,
        runs=32,
        effort="quick",
        **OF_ARM,
    )
    after = ij.failure_probability(best.scenario, perturbations, **before.arguments)
    assert after.estimate < limit < before.estimate


@pytest.mark.release
def test_fifty_estimates_of_a_few_in_a_thousand():
    """Subset simulation on runs of an arm agrees with 200,000 independent runs: no bias beyond
    three standard errors, and the 95 % interval covers in at least 90 % of the repetitions."""
    scenario, perturbations = arm(35.0)
    options = OF_ARM | {"progress": False}
    crude = ij.failure_probability(
        scenario, perturbations, method="monte_carlo", runs=200_000, **options
    )
    assert 1e-3 < crude.estimate < 5e-3
    found = [
        ij.failure_probability(scenario, perturbations, runs=1000, seed=seed, **options)
        for seed in range(1, 51)
    ]
    assert {x.method for x in found} == {"subset"}
    estimates = np.array([x.estimate for x in found])
    error = np.hypot(
        np.std(estimates) / np.sqrt(50), crude.coefficient_of_variation * crude.estimate
    )
    assert abs(np.mean(estimates) - crude.estimate) < 3 * error
    covered = np.mean([x.interval[0] <= crude.estimate <= x.interval[1] for x in found])
    assert covered >= 0.9
