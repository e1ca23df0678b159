"""The report on a tuning: its order, the check at half the step, and why fresh runs failed."""

import dataclasses
import json

import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax import objectives
from iblf_jax.cli.tune import _has_failed
from iblf_jax.studies.statistics import probability
from iblf_jax.tuning import confirmation, step_check
from iblf_jax.tuning.confirmation import confirmation_of
from iblf_jax.tuning.failures import FailedRuns, FreshRuns, Influence, failed_runs, most_influential
from iblf_jax.tuning.objectives import complete
from iblf_jax.tuning.options import Report, TuningRunOptions
from iblf_jax.tuning.report import Change, TuningReport, Verdict
from iblf_jax.tuning.result import TuneResult, TuneSetup
from iblf_jax.tuning.robust import Risk
from iblf_jax.tuning.samples import Sample, SampleRequest
from iblf_jax.tuning.step_check import RequirementAtSteps, StepCheck, has_rate_of_held_torque

BRIEF = {"duration": 0.2, "dt": 2e-3, "method": "euler"}
DRAWS = {"plant.mass[1]": ij.factor(ij.uniform(0.5, 2.0))}
DRAWS |= {"initial.q": ij.offset(ij.uniform(-0.01, 0.01))}


def test_changes_in_words_allowed_violations_and_numbers_that_go_through_json():
    assert str(Change("objective", 1.0, 1.5, None, None)).endswith("1 -> 1.5 (+50.0 %)")
    diverged = str(Change("objective", 1.08, 1.6251e24, None, None))
    assert diverged == "objective: 1.08 -> 1.6251e+24 (a factor of 1.5e+24)"
    by_chance = Change("objective", 1.0, 0.9, -0.3, 0.1)
    assert by_chance.significant is False and "NOT significant" in str(by_chance)
    report = dataclasses.replace(made_up_report(0, {}), changes=(by_chance,))
    assert "do not show that tuning helped" in str(report) and not report.improved
    report = made_up_report(1, {"violation probability < 0.05": "pass"})
    assert report.failed
    allowed = dataclasses.replace(report.verdicts[0], event="violated")
    assert not dataclasses.replace(report, verdicts=(allowed,)).failed
    report = made_up_report(5, {"a": "fail"}, made_up_check(at_steps(-0.01, 0.02)))
    numbers = json.loads(json.dumps(report.to_dict()))
    assert numbers["step_check"]["requirements"][0]["excess"] == [-0.01, 0.02]
    first, second = numbers["failures"]
    assert first["requirement"] is None and second["requirement"] == "a"
    assert first["influence"]["statistic"] == 0.97 and first["first"] == [3, 8]
    assert numbers["headline"] == report.headline


def drawn(names: str, runs: int = 400, seed: int = 0) -> dict[str, np.ndarray]:
    numbers = np.random.default_rng(seed).uniform(0.5, 1.5, (len(names.split()), runs))
    return dict(zip(names.split(), numbers, strict=True))


def explained(paper, numbers, failed, diverged=False, outside=False) -> FailedRuns:
    every = np.ones(len(failed), bool)
    fresh = FreshRuns(every & diverged, every, every & outside, numbers, paper)
    return failed_runs(None, failed, fresh)


NAMES = "plant.mass[0] plant.mass[1] initial.q[0] plant.length[1]"


@pytest.mark.parametrize(
    ("failing", "side"),
    [
        (lambda x: x > 1.4, "larger"),
        (lambda x: x < 0.52, "smaller"),
        (lambda x: np.abs(x - 1.0) > 0.46, "both ends"),
    ],
)
def test_the_perturbation_that_decides_is_found_with_its_side(paper, failing, side):
    """Statistic and medians against their definitions, pair by pair."""
    numbers = drawn(NAMES)
    x = numbers["plant.mass[1]"]
    failed = failing(x)
    found = explained(paper, numbers, failed)
    influence = found.influence
    assert (influence.path, influence.unit, influence.side) == ("plant.mass[1]", "kg", side)
    compared = np.abs(x - np.median(x)) if side == "both ends" else x
    larger = np.mean(compared[failed][:, None] > compared[~failed])
    assert influence.statistic == pytest.approx(max(larger, 1 - larger), abs=1e-12)
    assert influence.statistic > 0.98 and influence.p_value < 1e-3
    medians = [np.median(compared[failed]), np.median(compared[~failed])]
    assert [influence.failed, influence.kept] == pytest.approx(medians)
    assert found.is_explained and influence.drawn_with == ()
    text = f"{failed.sum()} of 400 runs left their bounds; most influential: plant.mass[1], "
    assert str(found).startswith(text)
    assert f"rank statistic {influence.statistic:.3g}" in str(found)


def test_a_weak_influence_is_called_unclear_and_numbers_of_one_draw_are_named_together(paper):
    rng = np.random.default_rng(1)
    numbers = drawn(NAMES, 2000)
    failed = rng.uniform(size=2000) < 0.2 + 0.3 * (numbers["plant.mass[0]"] - 0.5)
    found = explained(paper, numbers, failed)
    assert found.is_explained and 0.55 < found.influence.statistic < 0.75
    assert "no single perturbation separates them clearly; most influential" in str(found)
    numbers = drawn("plant.mass[0] plant.length[0]", 100)
    numbers["plant.mass[1]"] = 3.0 * numbers["plant.mass[0]"]
    numbers["plant.length[1]"] = -numbers["plant.mass[0]"]
    found = most_influential(numbers, numbers["plant.mass[1]"] > 4.0, paper)
    assert found.path == "plant.mass[0]"
    assert set(found.drawn_with) == {"plant.mass[1]", "plant.length[1]"}
    assert "with the same draw: plant.mass[1], plant.length[1]" in str(found)


def test_failures_without_a_cause_name_none(paper):
    numbers = drawn(NAMES, 1000)
    order = np.argsort(numbers["plant.mass[1]"])
    for count, words in ((1, f"run {order[-1]}"), (2, "runs ")):
        failed = np.zeros(1000, bool)
        failed[order[-count:]] = True
        found = explained(paper, numbers, failed)
        assert not found.is_explained and found.influence.path == "plant.mass[1]"
        assert f"too few to name a cause ({words}" in str(found)
        assert "most influential" not in str(found)
    failed[order[-3:]] = True
    three = explained(paper, numbers, failed)
    assert three.is_explained and three.influence.p_value < 1e-6
    assert three.first == tuple(sorted(order[-3:]))
    everything = np.ones(50, bool)
    assert explained(paper, drawn(NAMES, 50), ~everything) is None
    assert "no run is left to compare" in str(explained(paper, drawn(NAMES, 50), everything))
    for numbers in ({}, {"plant.mass[0]": np.ones(50)}):
        found = explained(paper, numbers, np.arange(50) < 5)
        assert found.influence is None and not found.is_explained
        assert str(found).endswith("no perturbation differs between the runs")
    found = explained(paper, {}, np.arange(50) < 5, diverged=True, outside=True)
    assert "(5 of them started outside; 5 of them diverged)" in str(found)


def goal_of(limit: float, allowed: float = 0.25):
    goal = objectives.tracking(scale=0.01) + objectives.peak_torque_below(limit, allowed=allowed)
    return complete(goal + objectives.margin_above(0.05), [1.0])


@pytest.mark.slow
def test_the_step_check_covers_all_runs_of_a_tuning(paper):
    """Against a study with the seed of the tuning, at both steps."""
    draws = {"perturbations": DRAWS, "runs": 8, "seed": 5}
    options = TuningRunOptions(**BRIEF, **draws, risk=Risk("worst")).checked()
    gains, goal = {"controller.K2": np.array([10.0, 15.0])}, goal_of(12.0)
    check = step_check.check_step_size(paper, gains, goal, options, batch=16)
    assert (check.runs, check.seed) == (8, 5)
    assert (check.violated, check.untrusted) == ((0, 0), (0, 0))
    tuned = ij.with_parameters(paper, gains)
    for i, dt in enumerate((2e-3, 1e-3)):
        metrics = ij.monte_carlo(tuned, **draws, progress=False, **BRIEF | {"dt": dt}).metrics
        peak, ise = (np.asarray(x) for x in (metrics.peak_torque, metrics.ise))
        assert check.peak_torque[i] == pytest.approx(peak.max(axis=0))
        assert check.margin[i] == pytest.approx(float(np.min(metrics.margin)))
        assert check.objective[i] == pytest.approx(ise.sum(axis=1).max() / 0.01)
        # A quarter of eight runs may break the limit: the mean of the worst two.
        worst = np.sort(peak.max(axis=1))[-2:].mean()
        torque, margin = check.requirements
        assert torque.value[i] == pytest.approx(worst)
        assert torque.excess[i] == pytest.approx((worst - 12.0) / 12.0)
        assert margin.value[i] == pytest.approx(check.margin[i])
    assert check.objective[0] != check.objective[1]
    half = step_check.excess_at_half_step(paper, gains, goal, options)
    assert half == check.worst
    assert half.requirement == "peak torque < 12 N m" and half.violated == 0
    assert half.is_broken == (half.excess > step_check.STEP_TOLERANCE)


def at_steps(full: float, half: float, name: str = "peak torque < 10 N m") -> RequirementAtSteps:
    values = 10.0 * (1 + full), 10.0 * (1 + half)
    return RequirementAtSteps(name, (full, half), values, 10.0, "N m")


def made_up_check(*requirements, violated=(0, 0), objective=(1.0, 1.0), seed=0) -> StepCheck:
    given = (1 if seed is None else 64, seed, 1e-3, objective, requirements, (0.1, 0.09))
    return StepCheck(*given, ((1.0, 2.0), (1.0, 2.1)), violated, (0, 0))


def test_what_half_the_step_changes_is_named_with_its_amount():
    broken = at_steps(-0.01, 0.02)
    assert broken.is_broken == (False, True)
    values = "peak torque < 10 N m: 9.9 N m, at dt / 2 10.2 N m"
    assert str(broken) == f"{values}: kept at dt, BROKEN at dt / 2 by 0.2 N m"
    assert str(at_steps(0.03, 0.02)).endswith("BROKEN by 0.3 N m")
    assert str(at_steps(-0.1, -0.1)).endswith(": kept")
    margin = dataclasses.replace(at_steps(-0.1, -0.1, "p < 0.1"), event="violated", averaged=7)
    assert str(margin).startswith("p < 0.1: mean margin of the worst 7 runs 9 N m")
    within = made_up_check(at_steps(-1e-5, 5e-4))
    assert not within.worst.is_broken and not within.warnings_of_requirements()
    assert "broken there by 0.0005 of its scale, within the tolerance of 0.001" in str(within)
    (warning,) = made_up_check(broken, at_steps(-1.0, -1.0, "b")).warnings_of_requirements()
    assert warning.startswith("WARNING: the 64 runs of the tuning: peak torque < 10 N m")
    assert "leave it some room, or take a smaller dt" in warning
    assert made_up_check(at_steps(0.3, 0.3), broken).worst == (0.3, "peak torque < 10 N m", 0)
    assert made_up_check().worst == (-np.inf, "", 0)
    assert not made_up_check(at_steps(0.3, 0.3), seed=None).warnings_of_requirements()
    assert "WARNING" not in str(made_up_check(objective=(1.0, 1.009)))
    for half in (1.011, np.nan):
        assert "more than 1% apart: take a smaller dt" in str(made_up_check(objective=(1.0, half)))
    # It is not the remedy for the rate of a held torque.
    jumping = dataclasses.replace(made_up_check(objective=(1.0, 2.0)), torque_jumps=True)
    assert "an actuator with a lag" in str(jumping) and "take a smaller dt" not in str(jumping)


def test_a_held_torque_is_one_of_a_sampled_loop_without_a_lag(paper):
    sampled = ij.with_parts(paper, sampling=ij.Sampling(period=2e-3))
    rate = objectives.tracking() + objectives.torque_rate()
    assert has_rate_of_held_torque(sampled, rate)
    for fields, is_held in (({"limit": 50.0}, True), ({"bandwidth": 200.0}, False)):
        driven = ij.with_parts(sampled, actuator=ij.actuators.Motor(**fields))
        assert has_rate_of_held_torque(driven, rate) is is_held
    assert not has_rate_of_held_torque(sampled, objectives.tracking() + objectives.effort())
    assert not has_rate_of_held_torque(paper, rate)


def made_up_report(violated, verdicts, check=None, seed=1) -> TuningReport:
    def of(count):
        return probability(np.arange(100) < count, np.ones(100, bool), 0.95, "independent", 1)

    cause = Influence("plant.mass[1]", "kg", "larger", 0.97, 1e-6, 1.38, 1.02)
    events = [(None, violated), *((name, 7) for name, kind in verdicts.items() if kind == "fail")]
    changes = [Change(f"{x} (mean)", 1.0, 0.5, -0.6, -0.4) for x in ("objective", "tracking")]
    judged = [Verdict(name, 0.1, of(0), of(0), kind) for name, kind in verdicts.items()]
    failed = [FailedRuns(name, x, 100, 0, 0, (3, 8), cause) for name, x in events if x]
    parts = {"changes": tuple(changes), "verdicts": tuple(judged), "failures": tuple(failed)}
    parts |= {"violation": (of(0), of(violated)), "margin": (0.1, -0.1), "step_check": check}
    parts |= {"at_limits": ("k1 is at an end",), "notes": ("stopped: converged",)}
    return TuningReport(runs=100, seed=seed, confidence=0.95, peak_torque=((1.0,), (2.0,)), **parts)


MASS = "plant.mass[1], median 1.38 kg in them, 1.02 kg in the others (rank statistic 0.97)"


def test_violated_bounds_come_first_then_requirements_then_the_objective():
    check = made_up_check(at_steps(-0.01, 0.02, "c"), violated=(0, 2), objective=(1.0, 1.2))
    report = made_up_report(5, {"a": "pass", "b": "fail"}, check)
    assert [row.strip() for row in str(report).splitlines()[1:4]] == [
        "bounds violated: 0 (0 of 100 runs; 95% interval 0 to 0.0362) -> 0.05 (5 of 100 runs; 95%"
        " interval 0.0164 to 0.113); WARNING: with the tuned gains the bounds are not kept",
        f"5 of 100 runs left their bounds; most influential: {MASS}",
        "WARNING: of 64 runs of the tuning, leave their bounds or diverge: 0 at dt, 2 at dt / 2",
    ]
    order = ["smallest margin: 0.1", "requirement b", f"    most influential: {MASS}"]
    order += ["requirement a", "WARNING: the 64 runs of the tuning: c", "objective (mean)"]
    order += ["tracking (mean)", "peak torque", "k1 is at an end"]
    order += ["WARNING: the 64 runs of the tuning at dt / 2: objective", "stopped: converged"]
    places = [str(report).index(words) for words in order]
    assert places == sorted(places)


BROKEN, VIOLATED = made_up_check(at_steps(-0.1, 0.1)), made_up_check(violated=(0, 1))


@pytest.mark.parametrize(
    ("report", "headline", "failed"),
    [
        (made_up_report(0, {}), "kept", False),
        (made_up_report(5, {}), "VIOLATED in 5 of 100 runs", True),
        (made_up_report(1, {}, seed=None), "VIOLATED", True),
        (
            made_up_report(0, {"a": "fail", "b": "pass"}),
            "kept; 1 of 2 requirements FAILED; 1 of 2 requirements passed",
            True,
        ),
        (made_up_report(0, {"a": "undecided"}), "kept; 1 of 1 requirements undecided", False),
        (
            made_up_report(0, {"a": "pass"}, BROKEN),
            "kept; 1 of 1 requirements passed; a requirement is BROKEN at dt / 2",
            True,
        ),
        (
            made_up_report(0, {"a": "pass"}, VIOLATED),
            "VIOLATED in the runs of the tuning; 1 of 1 requirements passed",
            True,
        ),
    ],
)
def test_bounds_and_requirements_decide_headline_and_exit_code(report, headline, failed):
    assert report.headline == f"bounds {headline}"
    assert report.failed is failed and _has_failed(report) is failed


def test_the_title_is_the_verdict_with_what_failed_first_and_an_unstable_loop_is_in_the_headline():
    assert made_up_report(0, {}).title == "100 of 100 fresh runs keep the bounds"
    assert made_up_report(1, {}, seed=None).title == "the nominal run leaves its bounds"
    failed = made_up_report(5, {"a": "pass", "b": "fail"}).title
    assert failed == "1 of 2 requirements FAILED; 95 of 100 fresh runs keep the bounds"
    undecided = made_up_report(0, {"a": "undecided"})
    [verdict] = undecided.verdicts
    claim = f"runs are needed to claim {100 * (1 - verdict.allowed):g} %"
    kept = "100 of 100 fresh runs keep the bounds"
    assert undecided.title == f"{kept}; {verdict.runs_needed} {claim}"
    assert f"but {verdict.runs_needed} such runs are needed" in str(verdict)
    check = made_up_check(violated=(0, 1))
    assert made_up_report(0, {}, check).title == "the runs of the tuning leave their bounds"
    stable = dataclasses.replace(made_up_report(0, {}), sampling_radius=(0.998, 0.995))
    assert "largest sampling_radius: 0.998 -> 0.995; stable below 1\n" in str(stable)
    assert stable.headline == "bounds kept"
    unstable = dataclasses.replace(stable, sampling_radius=(0.998, 1.005), unstable=(0, 3))
    words = "the sampled loop is unstable in 3 of 100 runs: narrow the ranges of its gains"
    assert f"-> 1.005; stable below 1; WARNING: with the tuned gains {words}" in str(unstable)
    assert unstable.headline == "bounds kept; the sampled loop is UNSTABLE in 3 of 100 runs"
    assert "sampling_radius" not in str(made_up_report(0, {}))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of the unstable runs
def test_the_largest_radius_of_the_fresh_runs_is_that_of_a_study_with_the_same_seed(paper):
    """K2 of the first gains is stable at 2 ms, and that of the tuned ones is not."""
    sampled = ij.with_parts(paper, sampling=ij.Sampling(2e-3))
    slow = ij.with_parameters(sampled, {"controller.K2": 5.0})
    gains = {"controller.K2": np.array([40.0, 40.0])}
    draws = {"plant.mass": ij.factor(ij.uniform(0.8, 1.2))}
    report = result_of(slow, gains, goal_of(50.0), perturbations=draws, runs=4).report
    studies = [study_of_report(s, draws) for s in (slow, ij.with_parameters(slow, gains))]
    radii = [np.max(study.metrics.sampling_radius) for study in studies]
    np.testing.assert_allclose(report.sampling_radius, radii, rtol=1e-6)
    flagged = [np.asarray(s.status) & int(ij.Status.SAMPLING_TOO_SLOW) != 0 for s in studies]
    assert report.unstable == tuple(int(x.sum()) for x in flagged)
    assert report.unstable[0] == 0 and report.unstable[1] > 0


def rounds_of(monkeypatch, failing, confirm=0.01, most=6):
    """Rounds whose runs exceed the limit by `failing(round)`, (N,); every tenth cannot be run."""
    goal = complete(objectives.tracking() + objectives.peak_torque_below(10.0), [1.0])
    options = TuningRunOptions(**BRIEF, perturbations=DRAWS).checked()
    found = confirmation_of(confirm, 0.95, goal, options)
    request = SampleRequest(None, (), goal, options, 1e-3, 0, seed=7)

    def sample_runs(request, scenarios):
        excess = np.resize(failing(len(found.rounds)), request.runs)
        exact = np.stack([np.ones(request.runs), 10.0 * (1 + excess), np.ones(request.runs)], 1)
        status = np.zeros(request.runs, int)
        return [Sample(exact, exact, status, excess, np.arange(request.runs) % 10 > 0)]

    monkeypatch.setattr(confirmation, "sample_runs", sample_runs)
    tightened = found.tightened
    while tightened is not None:
        found = found.after_round(request, None, tightened)
        tightened = found.next_tightening
    return found


def test_fresh_runs_confirm_a_probability_and_tighten_what_failed(monkeypatch):
    found = rounds_of(monkeypatch, lambda n: [-0.1] * 50 + [0.03 if n < 2 else -0.01])
    assert found.is_confirmed and len(found.rounds) == len(set(found.seeds)) == 3
    assert [x.count > 0 for x in found.rounds] == [True, True, False]
    assert found.tightened == pytest.approx((2 * 2 * 0.03,))
    assert str(found).startswith("confirmed with 95% confidence: a run fails with a probability")
    assert "peak torque < 10 N m by 0.12" in str(found)
    # Draws that cannot be run do not count: the claim has as many runs as it needs.
    assert all(x.runs >= least for x, least in zip(found.rounds, (368, 437, 506), strict=True))
    # The probability that gains which fail once in a hundred runs pass any round.
    assert sum(0.99**least for least in (368, 437, 506)) < 0.05
    refuted = rounds_of(monkeypatch, lambda n: [0.03])
    assert not refuted.is_confirmed and len(refuted.rounds) == confirmation.MOST_ROUNDS
    assert "NOT confirmed" in str(refuted)


def test_a_confirmation_that_cannot_be_is_refused():
    goal = objectives.tracking() + objectives.peak_torque_below(10.0, allowed=0.02)
    drawn = {"perturbations": DRAWS}
    too_many = "0.02 or more, which is the share that may break peak torque.*allowed=0.01"
    for confirm, goal_of_it, more, words in (
        (1.5, goal, drawn, "between 0 and 1"),
        (0.05, goal, {}, "give perturbations"),
        (0.01, goal, drawn, too_many),
        (1e-12, objectives.tracking(), drawn, "ij.failure_probability"),
    ):
        options = TuningRunOptions(**BRIEF, **more).checked()
        with pytest.raises(ValueError, match=words):
            confirmation_of(confirm, 0.95, goal_of_it, options)


@pytest.mark.slow
def test_gains_that_fail_in_fresh_runs_are_tightened_until_they_are_confirmed(paper, tmp_path):
    """With four runs the torque is at its limit in one of them, and beyond it in others."""
    goal = objectives.tracking() + objectives.peak_torque_below(12.0)
    draws = {"initial.q": ij.offset(ij.uniform(-0.01, 0.01))}
    options = {"effort": "quick", "confirm": 0.02, "progress": False}
    best = ij.tune(paper, ["controller.K2"], goal, perturbations=draws, runs=4, **options, **BRIEF)
    found = best.confirmation
    assert found.is_confirmed and len(found.rounds) > 1 and found.tightened[0] > 0
    assert best.report.verdicts[0].after.estimate < 0.02 and str(found) in str(best.report)
    assert str(ij.load(best.save(tmp_path / "tuning")).confirmation) == str(found)


def study_of_report(scenario, draws):
    """A study with the seed of the report of `result_of`."""
    return ij.monte_carlo(scenario, draws, runs=200, seed=7, progress=False, **BRIEF)


def result_of(scenario, gains, objective, **options) -> TuneResult:
    """A result as a tuning that ended at these gains returns it."""
    run = TuningRunOptions(**BRIEF, **options).checked()
    setup = TuneSetup(**vars(run), objective=objective, report=Report(runs=200, seed=7))
    first = np.concatenate([np.ravel(x) for x in gains.values()])
    history = {"x": first[None, None], "z": np.log(first)[None, None]}
    history |= {"valid": np.ones((1, 1), bool), "evaluations": np.ones(1, int)}
    history |= {"terms": np.ones((1, 1, len(objective.terms)))}
    history |= {"excess": np.ones((1, 1, len(objective.requirements)))}
    history |= dict.fromkeys(("loss", "objective", "margin", "gradient_norm"), np.ones((1, 1)))
    names = tuple(f"{path}[{i}]" for path, x in gains.items() for i in range(len(x)))
    ended = (names, history, 0, "converged", "sqp", "forward", 1.0, setup)
    return TuneResult(ij.with_parameters(scenario, gains), scenario, gains, *ended)


@pytest.mark.slow
def test_failed_fresh_runs_are_those_of_a_study_with_the_seed_of_the_report(paper):
    """The torque is exceeded where the second joint starts far from the reference.  Then the upper
    bound is 0.1 rad above the start, which is drawn up to 0.12 rad away."""
    gains = {"controller.K2": np.array([20.0, 20.0])}
    loose = result_of(paper, gains, goal_of(16.0), perturbations=DRAWS, runs=4)
    (found,) = loose.report.failures
    study = study_of_report(paper, DRAWS)
    broken = np.asarray(study.metrics.peak_torque).max(axis=1) >= 16.0
    start = np.asarray(study.samples["initial.q"])[:, 1]
    assert 5 < found.count < 195
    assert found.count == np.sum(broken) == loose.report.verdicts[0].after.count
    assert found.requirement == "peak torque < 16 N m"
    assert found.first == tuple(np.flatnonzero(broken)[:10])
    assert found.influence.path == "initial.q[1]" and found.influence.side == "larger"
    medians = [np.median(start[broken]), np.median(start[~broken])]
    assert [found.influence.failed, found.influence.kept] == pytest.approx(medians)
    assert found.cause_in_words() in str(loose.report)
    drawn_start = {"initial.q": ij.offset(ij.uniform([0.0, -0.12], [1e-6, 0.12]))}
    gains = {"controller.K2": np.array([4.0, 1.0])}
    result = result_of(paper, gains, goal_of(12.0), perturbations=drawn_start, runs=2)
    first = result.report.failures[0]
    study = study_of_report(result.scenario, drawn_start)
    assert first.started_outside == study.started_outside.sum() > 10
    assert first.count == result.report.violation[1].count == study.violation_probability.count
    assert first.influence.path == "initial.q[1]" and first.influence.side == "larger"
    assert f"({first.started_outside} of them started outside" in str(result.report)
