"""Monte-Carlo studies: the law of the draws, bit-identity, statistics, failed runs, refusals; and
intervals, sets of values without probabilities, which studies refuse."""

import os
import signal
import subprocess
import sys
import time
import warnings
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import study_cases as cases
from conftest import ROOT
from refused import assert_refused
from scipy import stats

import iblf_jax as ij
from iblf_jax.certificates import counterexample
from iblf_jax.core.status import Status
from iblf_jax.engine import execute, sizes
from iblf_jax.studies import execution, statistics, study_setup, time_step
from iblf_jax.studies.distributions import is_interval
from iblf_jax.studies.draws import targets_of

SCENARIO = ij.presets.zhang_yan_2024()


@pytest.fixture(scope="module")
def study():
    return cases.study()


def results(study):
    return cases.named(study) | {"mode": study.fastest_mode}


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [1, 300])
def test_chunk_changes_nothing(study, chunk):
    other = cases.study(executor=ij.studies.LocalExecutor(chunk=chunk))
    assert cases.same(results(study), results(other))


@pytest.mark.parametrize("runs", [1, 257])
def test_number_of_runs_changes_no_run(study, runs):
    fewer = results(cases.study(runs=runs))
    assert cases.same({name: x[:runs] for name, x in results(study).items()}, fewer)


@pytest.mark.slow
def test_the_size_of_a_block_changes_no_bit(monkeypatch):
    """Of a sampled loop; also not of a run that is made again, with its block."""
    velocity = ij.sensors.FilteredDifference(cutoff=300.0)
    parts = {"sensor": ij.sensors.Encoder(counts=2.0**16, velocity=velocity)}
    parts |= {"sampling": ij.Sampling(period=2e-3, delay=1e-3)}
    scenario = ij.with_parts(SCENARIO, actuator=ij.actuators.Motor(bandwidth=200.0), **parts)

    def made():
        return ij.monte_carlo(scenario, cases.perturbations(), runs=600, **cases.options())

    usual = made()
    found, run_spans = [], execution.run_spans_here
    monkeypatch.setattr(sizes, "LARGE_STUDY", 600)
    monkeypatch.setattr(
        execution, "run_spans_here", lambda *args: found.append(args[-1]) or run_spans(*args)
    )
    large = made()
    assert found == [sizes.LARGE_BLOCK] != [sizes.block_size()]
    assert cases.same(results(usual), results(large))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert large.replay(599).status == usual.status[599]


@pytest.mark.slow
def test_two_devices_and_one_agree_bit_for_bit(study, tmp_path, compiled):
    process = cases.start(compiled, str(tmp_path / "two.npz"), "--study", "--devices", "2")
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    assert cases.same(dict(np.load(tmp_path / "two.npz")), cases.named(study))


def test_a_repeated_study_lowers_nothing(study, monkeypatch):
    """Else its second of tracing is longer than many a study, and no second device helps."""
    cases.study()
    monkeypatch.setattr(execute, "run_all", lambda *_, **__: pytest.fail("lowered again"))
    cases.study(ways=cases.perturbations(0.2, 0.01), seed=8)
    stiffer = ij.with_parameters(SCENARIO, {"controller.K2": 30.0})
    ij.monte_carlo(stiffer, cases.perturbations(0.05, 0.01), runs=300, **cases.options())


def test_draws_follow_the_documented_law_and_quantiles_agree_with_scipy(study):
    """Other seeds give other draws, and the entries of a vector are independent."""
    dtype = SCENARIO.initial.q.dtype
    other = cases.study(runs=257, seed=4)
    assert abs(np.corrcoef(study.samples["initial.q"].T)[0, 1]) < 0.15
    for found, seed, i in ((study, 3, 0), (study, 3, 1), (study, 3, 599), (other, 4, 256)):
        key = jax.random.fold_in(jax.random.key(seed), i)
        key = jax.random.fold_in(key, zlib.crc32(b"plant.mass[1]"))
        u = jax.random.uniform(key, (), dtype) + jnp.finfo(dtype).eps / 2
        expected = float(SCENARIO.plant.mass[1]) * stats.norm.ppf(float(u), 1.0, 0.1)
        np.testing.assert_allclose(found.samples["plant.mass[1]"][i], expected, rtol=1e-5)
    u = jnp.linspace(0.01, 0.99, 99)
    for distribution, reference in (
        (ij.uniform(2.0, 5.0), stats.uniform(2.0, 3.0)),
        (ij.normal(1.0, 0.3), stats.norm(1.0, 0.3)),
        (ij.log_uniform(0.1, 10.0), stats.loguniform(0.1, 10.0)),
    ):
        expected = reference.ppf(np.asarray(u, float))
        np.testing.assert_allclose(distribution.quantile(u), expected, rtol=2e-5)
    weighted = ij.choice([1.0, 5.0, 9.0], weights=[1, 0, 3])
    draws = np.asarray(weighted.quantile(jnp.linspace(0.0005, 0.9995, 1000)))
    assert np.mean(draws == 1.0) == pytest.approx(0.25, abs=2e-3) and set(draws) == {1.0, 9.0}


@pytest.mark.slow
def test_a_distribution_from_a_notebook_robot_paths_and_shared_draws():
    """A class that is defined here; paths of `robot` move plant and model together."""

    @ij.component
    class Triangular:
        """Density 2 (1 - x) on (0, 1)."""

        def quantile(self, u):
            return 1 - jnp.sqrt(1 - u)

        def support(self):
            return np.zeros(()), np.ones(())

    found = cases.study(300, {"plant.payload": ij.value(Triangular())})
    assert abs(found.samples["plant.payload"].mean() - 1 / 3) < 0.05
    np.testing.assert_array_equal(found.replay(7).metrics["margin"], found.metrics["margin"][7])
    ways = {"robot.mass[1]": ij.factor(ij.uniform(0.5, 2.0))}
    ways |= {"initial.q": ij.offset(ij.normal(0, 0.01), shared=True)}
    study = cases.study(2, ways)
    assert np.ptp(study.samples["initial.q"], axis=1).max() == 0.0
    run = study.replay(1)
    drawn = study.samples["robot.mass[1]"][1]
    assert run.scenario.plant.mass[1] == drawn == run.scenario.model.mass[1]


@pytest.mark.parametrize("sampler", ["latin_hypercube", "sobol"])
def test_designs_fill_the_range_evenly(sampler):
    study = cases.study(256, sampler=sampler, replicates=4)
    u = stats.norm.cdf(study.samples["plant.mass[1]"].astype(float) / 0.85, 1.0, 0.1)
    for replicate in np.split(u, 4):
        assert np.array_equal(np.sort(np.floor(replicate * 64 + 1e-4)), np.arange(64))
    assert len(np.unique(study.samples["plant.mass[1]"])) == 256


@pytest.mark.slow
def test_all_of_a_study_are_leaves(study):
    """Its setup too: it can be moved to the host, and goes through jit."""
    host = jax.tree.map(np.asarray, study)
    for other in (host, jax.jit(lambda x: x)(host)):
        np.testing.assert_array_equal(other.replay(3).q, study.replay(3).q)
    assert isinstance(hash(jax.tree.structure(study)), int)


def test_replay_is_bit_identical_and_has_the_trajectory(study):
    for i in (0, 300, int(study.worst(1)[0])):
        run = study.replay(i)
        assert cases.same(dict(run.metrics), {name: x[i] for name, x in study.metrics.items()})
        assert int(run.status) == study.status[i]
        assert float(run.fastest_mode) == study.fastest_mode[i]
        np.testing.assert_array_equal(run.q[0], study.samples["initial.q"][i])
        margin = np.min(np.minimum(run.q - run.lower, run.upper - run.q), 0)
        np.testing.assert_allclose(margin, run.metrics.margin, atol=1e-6)


def test_an_index_selects_a_run_and_what_a_study_shows(study):
    one = study[-1]
    assert one.index == len(study) - 1
    np.testing.assert_array_equal(one.metrics.margin, study.metrics.margin[-1])
    assert_refused("runs 0 to 599", study.replay, 600, error=IndexError)
    data = study.to_xarray()
    assert data.margin.attrs["units"] == "rad" and data.sizes == {"run": 600, "joint": 2}
    assert data["plant.mass[1]"].attrs["units"] == "kg" and data.attrs["seed"] == 3
    assert np.all(np.diff(study.metrics.margin.min(1)[study.worst(600)]) >= 0)
    text = repr(study)
    assert "600 runs" in text and "95% interval" in text and f"failed: {len(study.failed)}" in text


def test_violation_probability_is_clopper_pearson_and_designs_need_replicates(study):
    found = study.violation_probability
    k, n = found.count, found.runs
    assert (k, n) == (int(np.sum(study.status & 3 != 0)), 600) and found.estimate == k / n
    assert found.low == pytest.approx(stats.beta.ppf(0.025, k, n - k + 1))
    assert found.high == pytest.approx(stats.beta.ppf(0.975, k + 1, n - k))
    end = 1 - 0.025 ** (1 / 50)
    for count, expected in ((0, (0.0, end)), (50, (1 - end, 1.0))):
        event = np.arange(50) < count, np.ones(50, bool)
        found = statistics.probability(*event, 0.95, "independent", 1)
        assert (found.low, found.high) == pytest.approx(expected)
    events, valid = np.random.default_rng(0).random(800) < 0.2, np.ones(800, bool)
    assert statistics.probability(events, valid, 0.95, "sobol", 1).low is None
    found = statistics.probability(events, valid, 0.95, "sobol", 8)
    means = events.reshape(8, 100).mean(1)
    expected = stats.t.interval(0.95, 7, means.mean(), stats.sem(means))
    assert (found.low, found.high) == pytest.approx(expected)
    assert statistics.probability(np.zeros(800, bool), valid, 0.95, "sobol", 8).low is None


def test_inadmissible_draws_are_flagged_and_left_out():
    study = cases.study(256, cases.perturbations(1.0))
    bad = study.samples["plant.mass[1]"] <= 0
    assert 0 < bad.sum() < 128
    np.testing.assert_array_equal(bad, ~study.made)
    assert np.all(study.status[bad] == int(Status.INADMISSIBLE_DRAW))
    assert np.all(np.isnan(study.metrics.margin[bad]))
    assert np.all(np.isfinite(study.metrics.margin[~bad]))
    assert study.violation_probability.runs == (~bad).sum()
    assert study.quantiles().attrs["excluded"] == bad.sum()
    assert np.all(study.made[study.worst(200)])
    assert_refused("admissible", study.replay, int(np.argmax(bad)))


def test_rank_correlation_agrees_with_scipy_and_bands_enclose_the_runs(study):
    found = study.correlations(["margin"])
    y = study.metrics.margin.min(1)
    q, mass = study.samples["initial.q"][:, 1], study.samples["plant.mass[1]"]
    for name, x in (("initial.q[1]", q), ("plant.mass[1]", mass)):
        cell = found.sel(parameter=name, metric="margin")
        expected = stats.spearmanr(x, y)
        assert float(cell.correlation) == pytest.approx(expected.statistic)
        assert float(cell.p_value) == pytest.approx(expected.pvalue)
    bands = study.bands((0.0, 0.5, 1.0), runs=300, samples=10)
    assert bands.sizes == {"quantile": 3, "time": 11, "joint": 2}
    start = study.samples["initial.q"][:300]
    ends = bands.q.isel(time=0, quantile=[0, 2])
    np.testing.assert_allclose(ends, [start.min(0), start.max(0)], rtol=1e-6)
    np.testing.assert_allclose(float(bands.time[-1]), 0.02)
    assert np.all(bands.q.diff("quantile") >= 0)


def test_sobol_indices_of_what_is_known():
    """The margin of the nearest joint is linear in where it starts, and in nothing else."""
    ways, options = cases.perturbations(0.01, 0.003), {"points": 64} | cases.options()

    def start(metrics):
        return np.asarray(metrics.margin)[:, 1]

    found = ij.sensitivity(SCENARIO, ways, output=start, **options)
    assert found.parameters == ("plant.mass[1]", "initial.q[0]", "initial.q[1]")
    np.testing.assert_allclose(found.total_order, [0.0, 0.0, 1.0], atol=0.05)
    assert found.runs == 320 and "initial.q[1]" in repr(found)
    assert found.to_xarray().sizes["parameter"] == 3
    words = "first_violation_time: got '64 of 64 runs without a finite value'"
    assert_refused(words, ij.sensitivity, SCENARIO, ways, output="first_violation_time", **options)


def refused(perturbations=None, **options):
    """A call of `monte_carlo` with these perturbations, or the usual ones."""
    ways = cases.perturbations() if perturbations is None else perturbations
    return lambda: ij.monte_carlo(SCENARIO, ways, **{"runs": 2, "duration": 0.01} | options)


TENTH = ij.factor(ij.uniform(0.9, 1.1))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (refused({"plant.maas": TENTH}), "plant.mass"),
        (refused({"plant.mass[-1]": TENTH}), "index >= 0"),
        (refused({"plant.mass[1]": ij.uniform(0.9, 1.1)}), "ij.factor"),
        (refused({"plant.mass[1]": ij.factor(ij.uniform(-1.0, 1.0))}), "plant.mass"),
        (refused({"plant.mass": ij.factor(ij.uniform([0.9] * 3, [1.1] * 3))}), "shape"),
        (refused({"initial.dq": TENTH}), "offset"),
        (refused({"robot.mass": TENTH, "plant.mass[0]": TENTH}), "overlap"),
        (refused({}), "at least one"),
        (refused(sampler="halton"), "sobol"),
        (refused(runs=100, sampler="sobol"), "128"),
        (refused(runs=10, replicates=2), "replicates"),
        (lambda: ij.uniform(1.0, 1.0), "expected"),
        (lambda: ij.log_uniform(-1.0, 1.0), "expected"),
        (lambda: ij.choice([1.0, 2.0], weights=[1.0]), "expected"),
        (lambda: ij.choice([1.0], weights=[0.0]), "expected"),
    ],
)
def test_what_cannot_be_drawn_is_refused(call, message):
    assert_refused(message, call)


def test_too_many_runs_are_refused_before_anything_is_compiled(monkeypatch):
    monkeypatch.setattr(study_setup, "compile_batch", None)
    assert_refused("runs: got 4294967296, .* GiB", refused({"plant.mass": TENTH}, runs=2**32))


INTERRUPTED = """
import sys
import jax
import iblf_jax as ij
import study_cases

def seen(event, duration, **details):
    if "jaxpr_to_mlir" in event and "_execute" in str(details):
        print("compiles", flush=True)

jax.monitoring.register_event_duration_secs_listener(seen)
def study():
    options = {"runs": 20_000, "duration": 20.0, "dt": 1e-3, "backend": "vmap"}
    ij.monte_carlo(ij.presets.zhang_yan_2024(), study_cases.perturbations(), **options)
if sys.argv[1] == "caught":
    try:
        study()
    except KeyboardInterrupt:
        print("caught", flush=True)
else:
    study()
"""


@pytest.mark.slow
@pytest.mark.parametrize("what", ["left", "caught"])
def test_an_interrupted_study_ends_without_a_crash(what):
    """XLA compiles in threads of its own, which go on after Ctrl-C."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-c", INTERRUPTED, what]
    # XLA compiles as it does for users: longer, and on several threads.
    environment = os.environ | {"PYTHONPATH": path, "XLA_FLAGS": os.environ["TESTER_XLA_FLAGS"]}
    outputs = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, env=environment, **outputs)
    assert process.stdout.readline() == "compiles\n"
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    begin = time.monotonic()
    out, err = process.communicate(timeout=120)
    assert process.returncode == (0 if what == "caught" else -signal.SIGINT), err[-2000:]
    assert "KeyboardInterrupt" in err if what == "left" else out == "caught\n"
    assert what == "caught" or time.monotonic() - begin < 30


def test_a_study_of_runs_that_are_sampled_too_slowly_warns():
    status = np.array([0, int(ij.Status.SAMPLING_TOO_SLOW), 0])
    radii = np.array([1.1, 1.0002, 0.9])
    with pytest.warns(UserWarning, match=r"in 1 of 3 runs.* by 0\.02 % .*\(run 1\)"):
        time_step.warn_of_sampling(status, radii)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        time_step.warn_of_sampling(status, None)
        time_step.warn_of_sampling(0 * status, radii)


MASS = {"plant.mass": ij.factor(ij.interval(0.9, 1.1))}
RUN = {"duration": 0.01, "dt": 1e-3}
PAYLOAD = {"plant.payload": ij.interval(0.0, 0.1)}
DESIGN = ij.studies.Design("random", points=2)


def test_an_interval_has_ends_which_are_rounded_outward_and_no_quantile():
    interval = ij.interval([0.9, 0.8], 1.1)
    np.testing.assert_allclose(interval.support()[0], [0.9, 0.8])
    np.testing.assert_allclose(ij.offset(interval).range(np.array([1.0, 2.0]))[1], [2.1, 3.1])
    assert not hasattr(interval, "quantile")
    assert is_interval(MASS["plant.mass"]) and not is_interval(ij.factor(ij.uniform(0.9, 1.1)))
    with jax.enable_x64(False):
        interval = ij.interval(0.97, [1.03, 2.0])
    assert interval.low.dtype == np.float32 and float(interval.low) < 0.97
    np.testing.assert_array_less(1.03, float(interval.high[0]))
    assert float(interval.high[1]) == 2.0
    for ends in ((1.1, 0.9), (1.0, 1.0), (0.9, np.inf), (np.nan, 1.0)):
        assert_refused(r"low < high|finite", ij.interval, *ends)


STUDIES = {
    "monte_carlo": lambda: ij.monte_carlo(SCENARIO, MASS, runs=2, **RUN),
    "sweep": lambda: ij.sweep(SCENARIO, {"controller.k1": [1.0]}, perturbations=MASS, **RUN),
    "design": lambda: ij.sweep(SCENARIO, PAYLOAD, design=DESIGN, **RUN),
    "sensitivity": lambda: ij.sensitivity(SCENARIO, MASS, **RUN),
    "falsify": lambda: ij.falsify(SCENARIO, MASS, **RUN),
    "counterexample": lambda: counterexample(SCENARIO, MASS),
}


@pytest.mark.parametrize("study", STUDIES)
def test_studies_refuse_intervals_and_name_the_remedy(study):
    assert_refused(r"without probabilities.*ij\.uniform\(low, high\)", STUDIES[study])


def test_a_proof_refuses_a_distribution_and_names_the_remedy():
    uniform = {"plant.mass": ij.factor(ij.uniform(0.9, 1.1))}
    with pytest.raises(ValueError, match=r"ij\.factor\(ij\.interval\(0\.9, 1\.1\)\)"):
        targets_of(SCENARIO, uniform, "parameters", intervals=True)
    assert targets_of(SCENARIO, MASS, "parameters", intervals=True)[0]
