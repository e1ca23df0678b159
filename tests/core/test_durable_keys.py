"""Texts of values and of the environment: two that can make two programs differ."""

import os
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refused import assert_refused

import iblf_jax as ij
from iblf_jax import _start
from iblf_jax.core.durable_keys import NoKeyError, _files, environment, text_of
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.structural_constants import StructuralConstants
from iblf_jax.kernels import Known
from iblf_jax.simulation import stability
from iblf_jax.simulation.scenario import canonical
from iblf_jax.studies import blocks, designs, draws
from iblf_jax.tuning import quantities
from iblf_jax.tuning.quantities import TimeIntegral

DIFFERENT = (
    *(None, (), [], ((),), "None", "()"),
    *(0, False, 0.0, -0.0, np.float32(0), np.float64(0), np.zeros(1), np.zeros((1, 1))),
    *(1, True, 1.0, "1", b"1", (1,), [1], frozenset((1,)), np.int32(1), np.int64(1)),
    *(("a", "b"), ("a','b",), ("a,b",), (("a",), "b"), ("a", ("b",))),
    *(float("nan"), float("inf"), float("-inf")),
    *(np.dtype("float32"), np.dtype("float64"), np.float32, np.float64),
    *(RunRequest(1), RunRequest(True), RunRequest(1, "euler"), (1, "rk4", None, None, "auto")),
    *(canonical, stability.growth_rate, ij.Sampling, tuple, type(None)),
)
"""Values of which no two are the same to a program."""


def structure_of(scenario):
    return text_of(jax.tree.structure(canonical(scenario)))


def test_values_scenarios_and_requests_that_differ_have_different_texts():
    """Scenarios in a static field, requests in a constant that is compiled in."""
    texts = [text_of(value) for value in DIFFERENT]
    assert len(set(texts)) == len(texts)
    assert [text_of(value) for value in DIFFERENT] == texts
    paper = ij.presets.zhang_yan_2024()
    samplings = (None, ij.Sampling(period=1e-3), ij.Sampling(period=1e-3, observer="euler"))
    texts = {structure_of(ij.with_parts(paper, sampling=x)) for x in samplings}
    assert len(texts) == 3
    assert structure_of(ij.presets.zhang_yan_2024()) in texts
    known = (None, Known(), Known(0.0), Known(-0.0), Known(1.0), Known(same=1), Known(1.0, None, 2))
    requests = [RunRequest(10, constants=StructuralConstants((x, Known(1.0)))) for x in known]
    texts = {text_of(x) for x in (*requests, RunRequest(10))}
    assert len(texts) == len(known) + 1


@ij.component
class Users(ij.disturbances.Disturbance):
    def torque(self, t, q, dq, plant, model):
        return 0.1 * q

    def jump_times(self):
        return jnp.zeros(0)


@pytest.mark.parametrize(
    "value",
    [
        *(Users, Users.torque, lambda x: x, object(), jnp.zeros(1), {"a": 1}),
        *(jnp.sin, (1, lambda x: x), jax.tree.structure(Users()), np.asarray([object()])),
        jax.tree.structure(ij.with_parts(ij.presets.zhang_yan_2024(), disturbance=Users())),
    ],
)
def test_what_cannot_be_described_has_no_text(value):
    assert text_of(len) == "builtins.len"
    with pytest.raises(NoKeyError):
        text_of(value)


def test_a_number_and_code_of_the_package_that_were_replaced(monkeypatch):
    before = environment()
    assert environment() == before
    monkeypatch.setattr(stability, "THIRD_SIZE", 2.0 * stability.THIRD_SIZE)
    assert environment() != before
    for place in ((stability, "growth_rate"), (ij.Sampling, "check")):
        monkeypatch.undo()
        assert environment() == before
        monkeypatch.setattr(*place, lambda *args: None)
        with pytest.raises(NoKeyError):
            environment()


@pytest.mark.parametrize(
    ("traced", "number", "code"),
    [
        (blocks.result_shapes, (designs, "MAX_RUNS"), (draws, "draw")),
        # The structure of a metric, for example, which a function of the engine takes.
        ((canonical, TimeIntegral), (quantities, "EDGE_WIDTH"), (TimeIntegral, "update")),
    ],
    ids=["studies", "tuning"],
)
def test_code_of_a_folder_counts_for_what_names_it(traced, number, code, monkeypatch):
    texts = text_of((canonical, canonical)), text_of(traced)
    before = [environment(text) for text in texts]
    assert before[0] == environment() != before[1]
    monkeypatch.setattr(*number, 2 * getattr(*number))
    assert environment(texts[0]) == before[0]
    assert environment(texts[1]) != before[1]
    monkeypatch.undo()
    monkeypatch.setattr(*code, lambda *args: None)
    assert environment(texts[0]) == before[0]
    with pytest.raises(NoKeyError):
        environment(texts[1])
    monkeypatch.undo()
    assert [environment(text) for text in texts] == before
    assert_refused("certificates", environment, text_of(ij.certify), error=NoKeyError)


def test_options_of_jax_and_of_xla(monkeypatch):
    texts = [environment()]
    with jax.default_matmul_precision("float32"):
        texts.append(environment())
    with jax.enable_x64(False):
        texts.append(environment())
    monkeypatch.setenv("XLA_FLAGS", f"{os.environ.get('XLA_FLAGS', '')} ")
    texts.append(environment())
    monkeypatch.setenv("IBLF_JAX_THREADS", "7")
    texts.append(environment())
    assert len(set(texts)) == 5
    with jax.debug_nans(True), pytest.raises(NoKeyError):
        environment()


def test_a_file_of_the_package_that_is_newer_than_the_process(monkeypatch):
    newest = max(file.stat().st_mtime for file in _files())
    monkeypatch.setattr(_start, "STARTED", newest + 2.0)
    environment()
    monkeypatch.setattr(_start, "STARTED", newest - 2.0)
    assert_refused("changed", environment, error=NoKeyError)
    assert newest < time.time()
