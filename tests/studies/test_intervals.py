"""Intervals: sets of values without probabilities, which studies refuse."""

import jax
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.certificates import counterexample
from iblf_jax.studies.distributions import is_interval
from iblf_jax.studies.draws import targets_of

SCENARIO = ij.presets.zhang_yan_2024()
MASS = {"plant.mass": ij.factor(ij.interval(0.9, 1.1))}
RUN = {"duration": 0.01, "dt": 1e-3}


def test_an_interval_has_ends_and_no_quantile():
    interval = ij.interval([0.9, 0.8], 1.1)
    np.testing.assert_allclose(interval.support()[0], [0.9, 0.8])
    np.testing.assert_allclose(ij.offset(interval).range(np.array([1.0, 2.0]))[1], [2.1, 3.1])
    assert not hasattr(interval, "quantile")
    assert is_interval(MASS["plant.mass"])
    assert not is_interval(ij.factor(ij.uniform(0.9, 1.1)))


@pytest.mark.parametrize("ends", [(1.1, 0.9), (1.0, 1.0), (0.9, np.inf), (np.nan, 1.0)])
def test_ends_that_are_no_interval_are_refused(ends):
    with pytest.raises(ValueError, match=r"low < high|finite"):
        ij.interval(*ends)


STUDIES = {
    "monte_carlo": lambda: ij.monte_carlo(SCENARIO, MASS, runs=2, **RUN),
    "sweep": lambda: ij.sweep(SCENARIO, {"controller.k1": [1.0]}, perturbations=MASS, **RUN),
    "design": lambda: ij.sweep(
        SCENARIO,
        {"plant.payload": ij.interval(0.0, 0.1)},
        design=ij.studies.Design("random", points=2),
        **RUN,
    ),
    "sensitivity": lambda: ij.sensitivity(SCENARIO, MASS, **RUN),
    "falsify": lambda: ij.falsify(SCENARIO, MASS, **RUN),
    "counterexample": lambda: counterexample(SCENARIO, MASS),
}


@pytest.mark.parametrize("study", STUDIES)
def test_studies_refuse_intervals_and_name_the_remedy(study):
    with pytest.raises(ValueError, match="without probabilities") as error:
        STUDIES[study]()
    assert "ij.uniform(low, high)" in str(error.value)


def test_a_proof_refuses_a_distribution_and_names_the_remedy():
    uniform = {"plant.mass": ij.factor(ij.uniform(0.9, 1.1))}
    with pytest.raises(ValueError, match="interval") as error:
        targets_of(SCENARIO, uniform, "parameters", intervals=True)
    assert "ij.factor(ij.interval(0.9, 1.1))" in str(error.value)
    assert targets_of(SCENARIO, MASS, "parameters", intervals=True)[0]


def test_ends_in_single_precision_are_rounded_outward():
    with jax.enable_x64(False):
        interval = ij.interval(0.97, [1.03, 2.0])
    assert interval.low.dtype == np.float32
    assert float(interval.low) < 0.97
    np.testing.assert_array_less(1.03, float(interval.high[0]))
    assert float(interval.high[1]) == 2.0
