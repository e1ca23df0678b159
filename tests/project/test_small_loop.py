"""Searches, proofs and simulators that compile too much for a default test, on loops that are small
enough: one joint, ten steps, and two gains.

What they find is compared with what holds for it whatever the loop: solvers agree, what a search
returns is no worse than its start, and other programs end where the run does.
"""

import functools
import zipfile
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import members
import numpy as np
import pytest
from made_up_runs import made_up
from PIL import Image
from proof_cases import pendulum

import iblf_jax as ij
from iblf_jax import objectives
from iblf_jax.engine import thresholds
from iblf_jax.proofs import Verdict

LOOP = pendulum(
    controller=ij.controllers.PDGravity(Kp=60.0, Kd=[20.0]),
    observer=ij.observers.NoObserver(),
    bounds=ij.Bounds(lower=ij.bounds.Constant([0.0]), upper=ij.bounds.Constant([1.2])),
)
PERIOD = 5e-3
RUN = {"duration": 0.05, "dt": PERIOD, "method": "euler"}
GAINS = ["controller.Kp", "controller.Kd"]
TERMS = (objectives.tracking(), objectives.effort())
MASS = {"plant.mass": ij.factor(ij.uniform(0.8, 1.2))}
GOAL = TERMS[0] + 0.1 * TERMS[1] + objectives.margin_above(0.01)


@functools.cache
def tuned(solver: str) -> ij.tuning.TuneResult:
    return ij.tune(LOOP, GAINS, GOAL, solver=solver, effort="quick", progress=False, **RUN)


@pytest.mark.parametrize(
    "solver", ["sqp", "slsqp", "trust-constr", "lbfgs", "adam", "differential-evolution", "cma"]
)
def test_all_solvers_find_one_optimum(solver, monkeypatch):
    """It is flat in the gains: a part in ten thousand of it is a tenth of a gain."""
    if solver == "cma":
        pytest.importorskip("cma")
    monkeypatch.setattr(thresholds, "MAX_FORWARD_NUMBERS", 1 if solver == "lbfgs" else 32)
    best = tuned(solver)
    assert best.optimiser == solver
    assert best.objective == pytest.approx(1.018519, rel=1e-4)
    after = ij.simulate(best.scenario, **RUN).metrics
    before = ij.simulate(LOOP, **RUN).metrics
    tracking, effort = np.sum(after.ise) / np.sum(before.ise), after.effort / before.effort
    assert best.objective == pytest.approx(float(tracking + 0.1 * effort), rel=1e-6)
    for path, number in zip(GAINS, (24.4, 2.65), strict=True):
        found = np.asarray(ij.simulation.paths.get(best.scenario, path))
        np.testing.assert_allclose(found, number, rtol=0.1)


def test_a_front_goes_from_one_least_value_to_the_other(monkeypatch):
    # The step that a warning names takes longer to find than the run.
    monkeypatch.setattr("iblf_jax.engine.diagnosis.find_dt", lambda *_, **__: PERIOD / 5)
    front = ij.pareto(LOOP, GAINS, TERMS, points=3, iterations=2, progress=False, **RUN)
    low, high = front.objectives.T
    assert np.all(np.diff(low) > 0.0) and np.all(np.diff(high) < 0.0)
    assert (low[0], high[-1]) == tuple(front.tried.min(axis=0))
    scenario = front.scenario(len(low) // 2)
    after, before = (ij.simulate(x, **RUN).metrics for x in (scenario, LOOP))
    found = [np.sum(after.ise) / np.sum(before.ise), after.effort / before.effort]
    np.testing.assert_allclose(found, front.objectives[len(low) // 2], rtol=1e-6)


def test_the_worst_mass_is_no_better_than_a_random_one():
    worst = ij.falsify(LOOP, MASS, starts=2, iterations=2, progress=False, **RUN)
    assert worst.margin <= worst.first_margin and not worst.violated
    run = ij.simulate(worst.scenario, **RUN)
    assert worst.margin == pytest.approx(float(np.min(run.metrics["margin"])), rel=1e-9)


def test_a_run_of_a_study_has_the_mode_of_its_replay():
    study = ij.monte_carlo(LOOP, MASS, runs=3, seed=1, progress=False, **RUN)
    modes = [float(study.replay(i).fastest_mode) for i in range(3)]
    np.testing.assert_allclose(study.fastest_mode, modes, rtol=1e-9)
    assert np.ptp(modes) > 0.0


def test_a_motion_that_excites_a_mass_stays_inside_the_bounds():
    motion = ij.excitation(LOOP, ["plant.mass"], duration=1.0, waypoints=4, iterations=1)
    q = np.asarray(jax.jit(jax.vmap(motion.position))(np.linspace(0.0, 1.0, 21)))
    assert np.all((q > 0.0) & (q < 1.2))
    assert np.ptp(q) > 0.1


MUJOCO = """<mujoco><worldbody><body>
<inertial pos="0.175 0 0" mass="2" diaginertia="0.06 0.06 0.06"/>
<joint name="a" type="hinge" axis="0 -1 0"/>
</body></worldbody><actuator><motor joint="a"/></actuator></mujoco>"""


def test_mujoco_ends_where_the_run_does():
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjSpec.from_string(MUJOCO)
    there = ij.cosimulate(LOOP, model, duration=0.05, period=PERIOD, dt=PERIOD / 5)
    sampled = ij.with_parts(LOOP, sampling=ij.Sampling(period=PERIOD))
    here = ij.simulate(sampled, duration=0.05, dt=PERIOD / 5)
    for name in ("q", "dq", "tau"):
        np.testing.assert_allclose(getattr(there, name)[-1], getattr(here, name)[-1], rtol=1e-6)


def test_an_arm_in_space_moves_in_an_animation(tmp_path):
    run = made_up(members.ROBOTS["arm"], duration=0.05)
    path = ij.plotting.animate(run, tmp_path / "arm.gif")
    with Image.open(path) as film:
        frames = [np.asarray(film.convert("L"), int)]
        film.seek(film.n_frames - 1)
        frames.append(np.asarray(film.convert("L"), int))
    assert film.n_frames > 1 and np.any(frames[0] != frames[1])
    assert np.ptp(frames[0]) > 100


def test_an_fmu_has_its_inputs_outputs_and_gains(tmp_path):
    ij.export(LOOP, tmp_path, target="fmu", period=PERIOD)
    (path,) = tmp_path.glob("*.fmu")
    with zipfile.ZipFile(path) as archive:
        text = archive.read("modelDescription.xml").decode()
        assert any(name.startswith("binaries/") for name in archive.namelist())
    for causality, least in (("input", 2), ("output", 1), ("parameter", 2)):
        assert text.count(f'causality="{causality}"') >= least


@ij.component
class Lever(ij.plants.Plant):
    """x1' = x2,   J x2' = u - b x2 - 2 sin x1."""

    J: Any = ij.leaf("1", sign="positive")
    b: Any = ij.leaf("1", sign="nonnegative")
    n: ClassVar[int] = 1
    order: ClassVar[int] = 2

    def drift(self, t, x):
        return jnp.stack([0.0 * x[0], -(self.b * x[1] + 2.0 * jnp.sin(x[0])) / self.J])

    def gain(self, t, x):
        return jnp.stack([jnp.ones_like(x[0]), jnp.ones_like(x[0]) / self.J])


def test_few_boxes_decide_nothing():
    """Of a plant in strict-feedback form, whose bound is short."""
    scenario = ij.Scenario(
        plant=Lever(J=1.2, b=0.3),
        model=Lever(J=1.2, b=0.25),
        reference=ij.references.Sinusoid(offset=0.1, amplitude=0.4, frequency=1.0),
        bounds=tuple(
            ij.Bounds(lower=ij.bounds.Constant(-x), upper=ij.bounds.Constant(x)) for x in (0.8, 2.5)
        ),
        controller=ij.controllers.BarrierBackstepping(
            k=(2.0, 8.0), barriers=(ij.barriers.TransformedError(),) * 2, weights=(89.0, 10.0)
        ),
        observer=ij.observers.LevelObserver(gain=(0.0, 40.0)),
        initial=ij.Initial(x=[[0.1], [0.0]]),
    )
    parameters = {"plant.J": ij.factor(ij.interval(0.99, 1.01))}
    proof = ij.prove(
        scenario, level=0.3, parameters=parameters, weight=8.0, max_boxes=50, runs=1, progress=False
    )
    assert proof.verdict is Verdict.UNDECIDED and "UNDECIDED" in str(proof)
    assert 0 < proof.boxes < 60
    (run,) = proof.adversarial_runs(1, duration=0.1, dt=0.02)
    assert run.t[-1] == pytest.approx(0.1)
