"""Fronts, attacks on tuned gains, saved results, the command line and the figures of tuning."""

import jax
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.paths import get
from iblf_jax.tuning._pareto import non_dominated

jax.config.update("jax_enable_x64", True)

SHORT = {"duration": 0.3, "dt": 1e-3, "method": "euler"}
SETS = {
    "plant.mass[1]": ij.factor(ij.uniform(0.5, 1.5)),
    "initial.q": ij.offset(ij.uniform(-0.05, 0.02)),
    "initial.dq": ij.value(ij.uniform(-3.0, 3.0)),
    "disturbance.acceleration_amplitude": ij.value(ij.uniform(-20.0, 20.0)),
}


@pytest.fixture(scope="module")
def paper():
    return ij.presets.zhang_yan_2024()


def test_falsify_finds_worse_than_random_runs_of_the_same_cost(paper):
    attack = ij.falsify(paper, SETS, starts=4, iterations=8, **SHORT)
    budget = 6 * attack.runs  # a value with its derivatives costs less than six values
    study = ij.monte_carlo(paper, SETS, runs=budget, seed=1, progress=False, **SHORT)
    assert attack.margin < float(np.min(study.metrics.margin)) and attack.margin < attack.first_margin
    assert attack.margin == pytest.approx(float(np.min(attack.replay().metrics.margin)), abs=1e-9)
    for path, perturbation in SETS.items():
        low, high = perturbation.range(np.asarray(get(paper, path)))
        assert np.all(attack.values[path] >= low - 1e-9) and np.all(attack.values[path] <= high + 1e-9)
    with pytest.raises(ValueError, match="bounded"):
        ij.falsify(paper, {"initial.q": ij.offset(ij.normal(0.0, 0.01))}, **SHORT)


def test_pareto_is_a_front(paper):
    pair = (ij.objectives.tracking(), ij.objectives.effort())
    front = ij.pareto(paper, ["controller.k1", "controller.K2"], pair, points=4, iterations=10, **SHORT)
    a, b = front.objectives.T
    assert len(front) >= 4 and np.all(np.diff(a) > 0) and np.all(np.diff(b) < 0)
    assert not np.any(np.all(front.tried[:, None] < front.objectives[None] - 1e-12, axis=-1))
    assert a[0] < front.first[0] and b[-1] < front.first[1]
    again = ij.simulate(front.scenario(0), **SHORT).metrics.ise.sum() / ij.simulate(paper, **SHORT).metrics.ise.sum()
    assert float(again) == pytest.approx(a[0], rel=1e-9)
    with pytest.raises(ValueError, match="one plain term"):
        ij.pareto(paper, ["controller.k1"], (ij.objectives.tracking(), ij.objectives.peak_torque()), **SHORT)


def test_non_dominated():
    points = np.array([[1.0, 5.0], [2.0, 4.0], [2.0, 3.0], [3.0, 3.5], [4.0, 1.0]])
    assert non_dominated(points).tolist() == [0, 2, 4]
