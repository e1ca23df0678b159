"""`Runs`: the shared arguments of runs as one object, in place of keywords."""

import dataclasses
import inspect

import numpy as np
import pytest
from refused import assert_refused

import iblf_jax as ij

SHORT = ij.Runs(0.02, method="heun")
TAKING = (
    *(ij.simulate, ij.certify, ij.compare, ij.monte_carlo, ij.sweep, ij.sensitivity),
    *(ij.falsify, ij.failure_probability, ij.pareto, ij.tune),
)


@pytest.mark.slow
def test_a_run_and_a_study_are_those_of_the_keywords(paper):
    by_keywords = ij.simulate(paper, duration=0.02, method="heun")
    by_object = ij.simulate(paper, runs_as=SHORT)
    np.testing.assert_array_equal(by_object.q, by_keywords.q)
    assert by_object.method == "heun" and SHORT.steps == by_object.steps == 20
    assert SHORT.request(by_object.scenario).steps == 20
    draws = {"initial.q": ij.offset(ij.uniform(-0.01, 0.01))}
    runs = ij.Runs(0.005, backend="vmap", seed=3)
    by_object = ij.monte_carlo(paper, draws, runs=2, runs_as=runs)
    by_keywords = ij.monte_carlo(paper, draws, runs=2, **dataclasses.asdict(runs))
    np.testing.assert_array_equal(by_object.samples["initial.q"], by_keywords.samples["initial.q"])
    assert isinstance(by_object.setup.options, ij.Runs)


@pytest.mark.parametrize("function", TAKING, ids=lambda function: function.__name__)
def test_signature_and_docstring_name_the_object_and_its_fields(function):
    parameters = inspect.signature(function).parameters
    assert parameters["runs_as"].default is None
    assert {"duration", "dt", "method"} <= set(parameters)
    assert "runs_as" in function.__doc__


def test_what_contradicts_the_object_and_fields_that_are_not_valid_are_refused(paper):
    with pytest.raises(ValueError, match=r"runs_as: got dt beside it.*dataclasses.replace"):
        ij.simulate(paper, dt=1e-3, runs_as=SHORT)
    assert_refused(r"runs_as: got 20.*ij.Runs\(duration=20.0\)", ij.simulate, paper, runs_as=20.0)
    with pytest.raises(ValueError, match=r"runs_as.seed: got 3.*compare has no argument seed"):
        ij.compare(paper, runs_as=ij.Runs(0.02, seed=3))
    assert_refused("duration", ij.simulate, paper, error=TypeError)
    wrong = {"duration": 0.0105, "dt": -1.0, "method": "rk5", "backend": "abacus", "seed": -1}
    for field, value in wrong.items():
        assert_refused(f"^{field}: got", ij.Runs, **{"duration": 0.02, field: value})
