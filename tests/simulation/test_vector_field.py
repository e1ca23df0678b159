"""`vector_field`: the closed loop in other solvers, as docs/how_to/other_solvers.md shows it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import run_page
from conftest import ROOT
from members import LAWS, OBSERVERS
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.simulation.closed_loop import initial_state, rate

PAGE = ROOT / "docs" / "how_to" / "other_solvers.md"
LAW_WITH_MEMORY = {"controller": LAWS["adaptive_rbf"], "observer": OBSERVERS["extended_state"]}


@pytest.mark.slow
def test_diffrax_and_scipy_agree_with_simulate(paper):
    """With so small a step that nothing is left of it at 1e-12."""
    pytest.importorskip("diffrax")
    page = run_page.run(PAGE)
    converged = ij.simulate(paper, duration=0.5, dt=2.5e-5, record_every=400)
    np.testing.assert_allclose(page["q"], converged.q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(page["scipy_q"], converged.q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(page["tau"], converged.tau, rtol=0, atol=1e-6)
    assert np.all(np.abs(np.diag(page["slope"])) > 1e-5)
    np.testing.assert_allclose(page["error"], [3.0 / 60.0, -1.5 / 60.0], atol=1e-9)
    assert np.all(np.real(page["modes"]) < 0)


@pytest.mark.slow
def test_the_rate_is_the_loops_own_with_memory_in_law_and_observer(paper):
    field = ij.vector_field(ij.with_parts(paper, **LAW_WITH_MEMORY))
    m = 2 + 2 + 8 * 2 + 2 + 2
    assert len(field.names) == m
    assert field.names[4:6] == ("controller[0, 0]", "controller[0, 1]")
    last = [f"observer.{name}[{i}]" for name in ("p_hat", "f_hat") for i in (0, 1)]
    assert list(field.names[-4:]) == last
    x = field.start + 0.01 * jnp.arange(m, dtype=field.start.dtype)
    state = field.unpack(x)
    assert jax.tree.structure(state) == jax.tree.structure(initial_state(field.scenario))
    expected = rate(field.scenario, jnp.array(0.3), state)
    for a, b in zip(*map(jax.tree.leaves, (field.unpack(field(0.3, x)), expected)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(field.pack(state), x)
    many = field.unpack(np.stack([x, 2 * x, 3 * x]))
    assert many.controller.shape == (3, 8, 2)
    np.testing.assert_array_equal(field.pack(many), np.stack([x, 2 * x, 3 * x]))
    np.testing.assert_array_equal(field(0.3, np.asarray(x), "anything"), field(0.3, x))


def test_float32_stays_float32(paper):
    field = ij.vector_field(ij.astype(paper, "float32"))
    assert field.start.dtype == field(0.1, np.asarray(field.start, float)).dtype == jnp.float32


def test_bad_arguments(paper):
    field = ij.vector_field(paper)
    state = field.unpack(field.start)
    shape = r"expected shape \(\.\.\., 6\)\. Its shape is \(5,\)\. .*solution\.y\.T"
    outside = ij.with_parts(paper, initial=ij.Initial(q=5.0))
    refused = [
        (f"x: .* {shape}", lambda: field(0.0, np.zeros(5))),
        (r"VectorField.scenario: .* ij.vector_field", lambda: ij.VectorField(3)),
        ("scenario: got 3, expected a Scenario", lambda: ij.vector_field(3)),
        (r"initial.q\[0\]", lambda: ij.vector_field(outside)),
    ]
    for x in (3.0, "q", None, 1j * np.zeros(6), [[1.0], [2.0, 3.0]], {"q": 1.0}):
        refused += [("x: ", lambda x=x: field.unpack(x)), ("x: ", lambda x=x: field(0.0, x))]
    for t in ([0.0, 1.0], "now", None):
        refused.append(("t: ", lambda t=t: field.sample(t, field.start)))
    changed = ({"x": np.zeros((2, 3))}, {"controller": np.zeros(2)}, {"x": "ab"})
    for wrong in (3.0, None, (1, 2, 3, 4), *(state._replace(**change) for change in changed)):
        refused.append(("state: ", lambda wrong=wrong: field.pack(wrong)))
    for words, made in refused:
        assert_refused(words, made)
