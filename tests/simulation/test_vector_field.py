"""`vector_field`: the closed loop in other libraries' solvers, as docs/how_to/other_solvers.md
shows it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import run_page
from conftest import ROOT
from members import LAWS, OBSERVERS

import iblf_jax as ij
from iblf_jax.simulation.closed_loop import initial_state, rate

PAGE = ROOT / "docs" / "how_to" / "other_solvers.md"
LAW_WITH_MEMORY = {"controller": LAWS["adaptive_rbf"], "observer": OBSERVERS["extended_state"]}


@pytest.fixture(scope="module")
def page() -> dict:
    """What the code blocks of the page leave behind, run from top to bottom as a reader would."""
    pytest.importorskip("diffrax")
    return run_page.run(PAGE)


@pytest.fixture(scope="module")
def converged(paper) -> ij.Rollout:
    """The run of the page with so small a step that nothing is left of it at 1e-12."""
    return ij.simulate(paper, duration=0.5, dt=2.5e-5, record_every=400)


@pytest.mark.slow
def test_diffrax_and_scipy_agree_with_simulate(page, converged):
    np.testing.assert_allclose(page["q"], converged.q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(page["scipy_q"], converged.q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(page["tau"], converged.tau, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_the_gradient_through_the_solver(page):
    gains, step = jnp.array([20.0, 20.0]), 1e-3
    for i in range(2):
        ahead, behind = (page["final_error"](gains.at[i].add(h)) for h in (step, -step))
        np.testing.assert_allclose(
            page["slope"][:, i], (ahead - behind) / (2 * step), rtol=0, atol=1e-8
        )
    assert np.all(np.abs(np.diag(page["slope"])) > 1e-5)


@pytest.mark.slow
def test_the_equilibrium(page):
    np.testing.assert_allclose(page["error"], [3.0 / 60.0, -1.5 / 60.0], atol=1e-9)
    assert np.all(np.real(page["modes"]) < 0)


@pytest.mark.slow
def test_scipy_agrees_with_an_independent_program(paper, reference_data):
    from scipy.integrate import solve_ivp

    field, times = ij.vector_field(paper), reference_data["t"][:6]
    found = solve_ivp(
        field, (0.0, times[-1]), field.start, method="DOP853", t_eval=times, rtol=1e-11, atol=1e-11
    )
    state = field.unpack(found.y.T)
    np.testing.assert_allclose(state.q, reference_data["iblf_printed.q"][:6], rtol=0, atol=1e-9)
    tau = [field.sample(t, x).tau for t, x in zip(found.t, found.y.T, strict=True)]
    np.testing.assert_allclose(tau, reference_data["iblf_printed.tau"][:6], rtol=0, atol=1e-6)


@pytest.mark.slow
def test_the_rate_is_the_loops_own_with_memory_in_law_and_observer(paper):
    scenario = ij.with_parts(paper, **LAW_WITH_MEMORY)
    field = ij.vector_field(scenario)
    m = len(field.names)
    assert m == 2 + 2 + 8 * 2 + 2 + 2
    assert field.names[4:6] == ("controller[0, 0]", "controller[0, 1]")
    assert field.names[-4:] == (
        "observer.p_hat[0]",
        "observer.p_hat[1]",
        "observer.f_hat[0]",
        "observer.f_hat[1]",
    )
    x = field.start + 0.01 * jnp.arange(m, dtype=field.start.dtype)
    state = field.unpack(x)
    assert jax.tree.structure(state) == jax.tree.structure(initial_state(field.scenario))
    expected = rate(field.scenario, jnp.array(0.3), state)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12),
        field.unpack(field(0.3, x)),
        expected,
    )
    np.testing.assert_array_equal(field.pack(state), x)
    many = field.unpack(np.stack([x, 2 * x, 3 * x]))
    assert many.controller.shape == (3, 8, 2)
    np.testing.assert_array_equal(field.pack(many), np.stack([x, 2 * x, 3 * x]))
    np.testing.assert_array_equal(field(0.3, np.asarray(x), "anything"), field(0.3, x))


def test_float32_stays_float32(paper):
    field = ij.vector_field(ij.astype(paper, "float32"))
    assert field.start.dtype == field(0.1, np.asarray(field.start, float)).dtype == jnp.float32


def test_a_batch_of_fields(paper):
    def first(K2):
        field = ij.vector_field(ij.with_parameters(paper, {"controller.K2": K2}))
        return field(0.0, field.start)

    gains = jnp.array([10.0, 20.0])
    np.testing.assert_allclose(
        jax.vmap(first)(gains), jnp.stack([first(gains[0]), first(gains[1])]), rtol=1e-12
    )


def test_bad_arguments(paper):
    field = ij.vector_field(paper)
    with pytest.raises(
        ValueError,
        match=r"x: .* expected shape \(\.\.\., 6\)\. Its shape is \(5,\)\. .*solution\.y\.T",
    ):
        field(0.0, np.zeros(5))
    for x in (3.0, "q", None, 1j * np.zeros(6), [[1.0], [2.0, 3.0]], {"q": 1.0}):
        with pytest.raises(ValueError, match="x: "):
            field.unpack(x)
        with pytest.raises(ValueError, match="x: "):
            field(0.0, x)
    for t in ([0.0, 1.0], "now", None):
        with pytest.raises(ValueError, match="t: "):
            field.sample(t, field.start)
    state = field.unpack(field.start)
    changed = ({"x": np.zeros((2, 3))}, {"controller": np.zeros(2)}, {"x": "ab"})
    for wrong in (3.0, None, (1, 2, 3, 4), *(state._replace(**change) for change in changed)):
        with pytest.raises(ValueError, match="state: "):
            field.pack(wrong)
    with pytest.raises(ValueError, match=r"VectorField.scenario: .* ij.vector_field"):
        ij.VectorField(3)
    with pytest.raises(ValueError, match="scenario: got 3, expected a Scenario"):
        ij.vector_field(3)
    with pytest.raises(ValueError, match=r"initial.q\[0\]"):
        ij.vector_field(ij.with_parts(paper, initial=ij.Initial(q=5.0)))
