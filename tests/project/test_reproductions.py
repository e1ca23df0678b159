"""Published examples: their scenario files and scripts run, do what their pages say, and agree with
programs written here without the package."""

from __future__ import annotations

import functools
import itertools
import runpy
import warnings

import numpy as np
import pytest
from conftest import ROOT
from scipy.integrate import solve_ivp

import iblf_jax as ij
from iblf_jax import cli
from iblf_jax.files.scenario import load_scenario_file

FOLDER = ROOT / "examples" / "reproductions"
NAMES = sorted(path.stem for path in FOLDER.glob("*.toml"))
SCRIPTS = sorted({path.stem for path in FOLDER.glob("*.py")} - set(NAMES))
"""Examples without a scenario file: their plant is a function of the script."""


@functools.cache
def run_of(name):
    """The run that a file asks for."""
    scenario, options = load_scenario_file(FOLDER / f"{name}.toml")
    return ij.simulate(scenario, **options)


@functools.cache
def runs_of(name):
    """The runs that a script makes, by their names; one without a barrier leaves its bounds."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ij.SimulationWarning)
        return runpy.run_path(str(FOLDER / f"{name}.py"))["runs"]


def published(name):
    return np.loadtxt(FOLDER / f"{name}.csv", delimiter=",", skiprows=1)


def test_each_has_a_page_a_source_and_its_command():
    assert len(NAMES) >= 5
    for name in NAMES:
        text = (FOLDER / f"{name}.toml").read_text(encoding="utf-8")
        assert text.splitlines()[0].endswith(
            f": python -m iblf_jax simulate examples/reproductions/{name}.toml"
        )
        assert set(load_scenario_file(FOLDER / f"{name}.toml").run) == {
            "duration",
            "dt",
            "record_every",
        }


def test_a_page_says_what_is_printed_what_is_missing_and_what_is_not_reproduced():
    assert len(SCRIPTS) >= 3
    for name in (*NAMES, *SCRIPTS):
        page = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
        assert all(
            words in page
            for words in ("| printed | value | where |", "**Not printed", "**Not reproduced:**")
        )


@pytest.mark.slow
def test_the_command_of_a_file_runs(capsys):
    assert cli.main(["simulate", str(FOLDER / "mahmud_2021.toml"), "--duration", "0.1"]) == 0
    assert "status: ok" in capsys.readouterr().out


# ---------------------------------------------------------------------------- what the pages say


def dimanidis(run):
    assert run.status == 0
    for joint, limit in ((0, 1e-3), (1, 3e-3)):
        _, t, e1 = published("dimanidis_2018")[published("dimanidis_2018")[:, 0] == joint].T
        assert (
            np.abs(np.interp(t, run.t, run.e1[:, joint]) - e1).max()
            < limit
            < 0.01 * np.abs(e1).max()
        )
    assert np.abs(run.e1[run.t > 6.0]).max() < np.pi / 180


def shaw_cortez(run):
    assert int(run.status) == int(
        ij.Status.TORQUE_SATURATED
    )  # the law asks for more than the filter gives
    assert (
        np.min(run.metrics.margin) > 0
        and np.abs(run.dq).max() < 1.5
        and np.all(np.abs(run.tau).max(axis=0) < [18.0, 10.0])
    )
    kept = published("shaw_cortez_2022")
    for columns, limit in (((1, 2), 6e-3), ((3, 4), 1e-4)):
        off = [
            np.abs(np.interp(kept[:, 0], run.t, run.q[:, i]) - kept[:, column]).max()
            for i, column in enumerate(columns)
        ]
        assert max(off) < limit
    # The reference leaves the bounds, and is no fault of a filter's run.
    assert np.any(run.q_d > run.scenario.bounds.upper.value)


def zhang(run):
    assert run.status == 0
    late = np.flatnonzero(run.t < 6.99)[-1]
    M = np.asarray(run.scenario.plant.mass_matrix(run.q[late]))
    np.testing.assert_allclose(
        run.e1[late], np.linalg.solve(M, [0.15, 0.18, 0.12]) / 1500, rtol=0.03
    )
    assert np.abs(run.e1[run.t < 6.0]).max() < 1e-8


def mahmud(run):
    assert run.status == 0
    np.testing.assert_allclose(
        run.metrics.margin, 2.0, atol=1e-9
    )  # at the start, in a corner of the box
    np.testing.assert_allclose(run.metrics.velocity_margin, 2.0, atol=1e-9)
    assert np.abs(run.q[run.t > 6.0]).max() < 0.05
    np.testing.assert_allclose(
        run.scenario.plant.mass_matrix(np.zeros(2)), [[3.957, 0.438], [0.438, 0.196]], rtol=1e-9
    )


def cruz_ancona(run):
    assert run.status == 0
    w = 1.4195117 * np.linalg.norm(run.dq - run.alpha, axis=1)
    assert w[0] > 1 and w[run.t > 8.0].max() < 0.05


SAID = {
    "dimanidis_2018": dimanidis,
    "shaw_cortez_2022": shaw_cortez,
    "zhang_2022": zhang,
    "mahmud_2021": mahmud,
    "cruz_ancona_2022": cruz_ancona,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_file_does_what_its_page_says(name):
    SAID[name](run_of(name))


def tee_ge(runs):
    assert all(run.status == 0 for run in runs.values())
    model = runs["filter of the model"]
    late = model.t > 3.0
    np.testing.assert_allclose(model.e1.max(), 0.513, atol=1e-3)
    np.testing.assert_allclose(model.tau.min(), -71.0, atol=0.2)
    np.testing.assert_allclose(model.tau.max(), 3.2, atol=0.2)
    assert np.abs(model.tau[late]).max() < 1.2
    assert np.abs(model.e1[late]).max() < 0.002
    constant = runs["exact derivatives, constant reference"]
    np.testing.assert_allclose(constant.x[:, 0].max(), 0.514, atol=2e-3)
    np.testing.assert_allclose(constant.tau[0], -17.1, atol=0.05)
    np.testing.assert_allclose(constant.tau.max(), 1.05, atol=0.01)
    np.testing.assert_allclose(constant.x[:, 1].min(), -0.59, atol=0.01)
    for run in runs.values():
        assert np.abs(run.x[:, 0]).max() < 1.0
        assert np.abs(run.x[:, 1]).max() < 2.5
    for name in ("exact derivatives", "filter of the package"):
        assert 2.4 < np.abs(runs[name].alpha).max() < 2.5


def tangent(runs):
    assert runs["published barrier"].status == 0
    assert runs["Log"].status == 0
    assert runs["Quadratic, no barrier"].status == int(ij.Status.BOUND_VIOLATED)
    for name in ("published barrier", "Log"):
        assert np.abs(runs[name].e1).max() < 0.06
        assert np.diff(runs[name].V).max() < 1e-10
    assert runs["Quadratic, no barrier"].x[:, 0].max() > 0.56


def liu(runs):
    for run in runs.values():
        assert run.status == 0
        assert np.abs(run.e1).max() < 0.51
        assert np.abs(run.x[:, 0]).max() < 1.51
        assert np.diff(run.V).max() < 1e-10


SAID_BY_SCRIPTS = {
    "liu_output_bound": liu,
    "tangent_barrier_2013": tangent,
    "tee_ge_2012": tee_ge,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_does_what_its_page_says(name):
    SAID_BY_SCRIPTS[name](runs_of(name))


# ------------------------------------------------------- programs from the printed numbers alone


def two_links(mass, length, centre, inertia, g):
    """q, v -> M, C v + G of a planar arm, q from the horizontal."""
    (m1, m2), (l1, _), (c1, c2), (i1, i2) = mass, length, centre, inertia

    def at(q, v):
        b, s = m2 * l1 * c2 * np.cos(q[1]), m2 * l1 * c2 * np.sin(q[1])
        a2 = i2 + m2 * c2**2
        M = np.array([[i1 + m1 * c1**2 + m2 * l1**2 + a2 + 2 * b, a2 + b], [a2 + b, a2]])
        outer = m2 * c2 * g * np.cos(q[0] + q[1])
        G = np.array([(m1 * c1 + m2 * l1) * g * np.cos(q[0]) + outer, outer])
        return M, np.array([-s * v[1] * (2 * v[0] + v[1]), s * v[0] ** 2]) + G

    return at


def performance_torque(t, sigma, k, start, end, rate):
    """-2 k T(xi) / ((1 - xi^2) rho), as the thesis prints it."""
    rho = (start - end) * np.exp(-rate * t) + end
    xi = sigma / rho
    return -2 * k * np.log((1 + xi) / (1 - xi)) / ((1 - xi**2) * rho)


def dimanidis_alone(t, x):
    q, v = x[:2], x[2:]
    M, rest = two_links((3.2, 2.0), (0.5, 0.4), (0.25, 0.2), (0.96, 0.81), 9.81)(q, v)
    e = q - np.pi / 2 - np.pi / 6 * np.array([np.sin(t), -np.cos(t)])
    de = v - np.pi / 6 * np.array([np.cos(t), np.sin(t)])
    d = np.array([3 * np.sin(t), 2 * np.cos(t)]) - v
    return np.concatenate(
        [v, np.linalg.solve(M, performance_torque(t, de + 2 * e, 6.0, 30.0, 0.035, 1.5) + d - rest)]
    )


def cruz_ancona_alone(t, x):
    q, v = x[:2], x[2:]
    M, rest = two_links((23.902, 5.88), (0.45, 0.45), (0.091, 0.048), (1.266, 0.093), 9.81)(q, v)
    e, de = q - np.array([np.sin(t) - np.pi / 2, np.cos(t)]), v - np.array([np.cos(t), -np.sin(t)])
    p12 = np.sqrt(2 * 0.503)
    p22 = np.sqrt(0.503 * (2 + 2 * p12))
    tau = performance_torque(t, de + p12 / p22 * e, 0.5, 1.5, 0.05 / p22 / np.sqrt(2), 0.5)
    return np.concatenate([v, np.linalg.solve(M, tau + 2 * np.sin(4 * t) - rest)])


def nearest(u, G, h):
    """The x of least |x - u| with G x <= h, for two numbers: by its active conditions, none, one or
    two."""
    for count in range(3):
        for active in itertools.combinations(range(len(h)), count):
            A = G[list(active)]
            if np.linalg.matrix_rank(A) < count:
                continue
            multipliers = (
                np.linalg.solve(A @ A.T, A @ u - h[list(active)]) if count else np.zeros(0)
            )
            x = u - A.T @ multipliers
            if np.all(multipliers >= 0) and np.all(G @ x <= h + 1e-9 * (1 + np.abs(h))):
                return x
    raise AssertionError("no torque meets all conditions")


def shaw_cortez_alone(t, x):
    q, v = x[:2], x[2:]
    M, rest = two_links((1.0, 1.0), (1.0, 1.0), (0.5, 0.5), (1 / 12 + 0.5, 1 / 12), 0.0)(q, v)
    amplitude, w = np.array([np.pi / 2 + 1.9, np.pi / 6 + 2.1]), 1.3
    r, dr, ddr = (
        amplitude * np.sin(w * t) + [0, 2 * np.pi / 3],
        amplitude * w * np.cos(w * t),
        -amplitude * w**2 * np.sin(w * t),
    )
    u = M @ (ddr - 5 * (v - dr) - 5 * (q - r)) + rest
    gamma, nu, eta, inverse = 0.8906, 10.0, 0.5, np.linalg.inv(M)
    drift, rows, room = -inverse @ rest, [], []
    for sign, side in ((1, [np.pi / 2, 5 * np.pi / 6]), (-1, [-np.pi / 2, np.pi / 2])):
        h, dh = sign * (np.array(side) - q), -sign * v
        z = dh + gamma * np.arctan(h)  # z' = -sign q" + gamma h'/(1 + h^2), and z' + nu z^3 >= eta
        rows.append(sign * inverse)
        room.append(gamma * dh / (1 + h**2) + nu * z**3 - eta - sign * drift)
    limits = np.array([18.0, 10.0])
    tau = nearest(
        u, np.concatenate([*rows, np.eye(2), -np.eye(2)]), np.concatenate([*room, limits, limits])
    )
    return np.concatenate([v, np.linalg.solve(M, tau - rest - 0.001 * v)])


def zhang_alone(t, x):
    q, v, gain, w = x[:3], x[3:], np.array([0.5, 0.8, 0.2]), 2 * np.pi / 5
    c2, c3, c23, s2, s3, s23 = (f(y) for f in (np.cos, np.sin) for y in (q[1], q[2], q[1] + q[2]))
    m22, m23 = 0.4398 + 0.05618 * c3, 0.1788 + 0.02809 * c3
    m12, m13 = m22 + 0.04047 * c23 + 0.1742 * c2, m23 + 0.04047 * c23
    m11 = 1.0425 + 0.08094 * c23 + 0.3484 * c2 + 0.05618 * c3
    M = np.array([[m11, m12, m13], [m12, m22, m23], [m13, m23, 0.1788]])
    a, b, c = v
    inner, middle, outer = 0.1742 * s2, 0.04047 * s23, 0.02809 * s3
    N = np.array(
        [
            -inner * b * (2 * a + b)
            - middle * (b + c) * (2 * a + b + c)
            - outer * c * (2 * a + 2 * b + c),
            (inner + middle) * a**2 - outer * c * (2 * a + 2 * b + c),
            middle * a**2 + outer * (a + b) ** 2,
        ]
    )
    r, dr, ddr = (
        gain * (np.cos(w * t + 1) + 1),
        -gain * w * np.sin(w * t + 1),
        -gain * w**2 * np.cos(w * t + 1),
    )
    tau = M @ (ddr - 48 * (v - dr) - 1500 * (q - r)) + N
    push = np.array([0.15, 0.18, 0.12]) if t >= 6.0 else 0.0
    return np.concatenate([v, np.linalg.solve(M, tau + push - N)])


ALONE = {
    "dimanidis_2018": (dimanidis_alone, 0.0, 2.9),
    "cruz_ancona_2022": (cruz_ancona_alone, 0.0, 4.0),
    "shaw_cortez_2022": (shaw_cortez_alone, 0.0, 4.5),
    "zhang_2022": (zhang_alone, 6.0, 6.9),
}
"""Name -> the rate of (q, q') by hand, and from when to when it is held against the file's run:
between jumps of the disturbance."""


@pytest.mark.slow
@pytest.mark.parametrize("name", ALONE)
def test_a_program_of_the_printed_numbers_gives_the_same_motion(name):
    rate, start, end = ALONE[name]
    run = run_of(name)
    t, states = np.asarray(run.t), np.concatenate([run.q, run.dq], axis=1)
    inside = (t >= start - 1e-9) & (t < end)
    assert start > 0 or np.all(states[inside][0] == states[0])
    # A filter's torque has kinks, where a method of a high order gains nothing and loses nothing.
    found = solve_ivp(
        rate,
        (t[inside][0], end),
        states[inside][0],
        "DOP853",
        t_eval=t[inside],
        rtol=1e-9,
        atol=1e-11,
    ).y.T
    n = run.n
    assert np.abs(found - states[inside])[:, :n].max() < 1e-7


def integral_barrier(z, y, k):
    """The published rho of the integral barrier at z != 0."""
    return k / (2 * z) * np.log((k + z + y) * (k - y) / ((k - z - y) * (k + y)))


def tee_ge_alpha(t, x1):
    y, dy = 0.2 * np.sin(2.5 * t), 0.5 * np.cos(2.5 * t)
    z = x1 - y
    return -0.1 * x1**2 - 5 * z + dy * (1 - x1**2) * integral_barrier(z, y, 1.0)


def tee_ge_input(t, x1, x2, rate):
    """The published input, with what takes the place of alpha_1'."""
    alpha, z1 = tee_ge_alpha(t, x1), x1 - 0.2 * np.sin(2.5 * t)
    z2, room = x2 - alpha, 2.5**2 - x2**2
    moved = rate * integral_barrier(z2, alpha, 2.5) * room / 2.5**2
    exchange = room * z1 / ((1 - x1**2) * 2.5**2)
    return (0.2 * x1 - 0.1 * x1 * x2 - 5 * z2 + moved - exchange) / (1 + x1**2)


def along_motion(alpha, t, x1, rate):
    """alpha_1' by a complex step along the motion."""
    step = 1e-30
    return alpha(t + 1j * step, x1 + 1j * step * rate).imag / step


def tee_ge_rate(x1, x2, u):
    return [0.1 * x1**2 + x2, 0.1 * x1 * x2 - 0.2 * x1 + (1 + x1**2) * u]


def tee_ge_exact(t, x):
    x1, x2 = x
    rate = along_motion(tee_ge_alpha, t, x1, 0.1 * x1**2 + x2)
    return tee_ge_rate(x1, x2, tee_ge_input(t, x1, x2, rate))


def tee_ge_filter(t, x):
    x1, x2, beta = x
    rate = (tee_ge_alpha(t, x1) - beta) / 0.02
    return [*tee_ge_rate(x1, x2, tee_ge_input(t, x1, x2, rate)), rate]


def tangent_alpha(t, x1):
    z = x1 - 0.2 - 0.3 * np.sin(t)
    xi = np.pi * z / 0.12
    return (
        -0.1 * x1**2
        - 2 * z * 0.12 / np.pi * np.cos(xi) ** 3 / np.sinc(xi / np.pi)
        + 0.3 * np.cos(t)
    )


def tangent_alone(t, x):
    x1, x2 = x
    xi = np.pi * (x1 - 0.2 - 0.3 * np.sin(t)) / 0.12
    rate = along_motion(tangent_alpha, t, x1, 0.1 * x1**2 + x2)
    z2 = x2 - tangent_alpha(t, x1)
    u = (0.2 * x1 - 0.1 * x1 * x2 + rate - 2 * z2 - np.sin(xi) / np.cos(xi) ** 3) / (1 + x1**2)
    return tee_ge_rate(x1, x2, u)


def liu_alone(t, x):
    x1, x2 = x
    z1, dz1 = x1 - np.sin(t), x2 - np.cos(t)
    room = 0.51**2 - z1**2
    z2 = x2 + room * 10 * z1 - np.cos(t)
    rate = 20 * dz1 * z1**2 - room * 10 * dz1 - np.sin(t)
    u = (25 * x2 + rate - 10 * z2 - z1 / room) / 133
    return [x2, -25 * x2 + 133 * u]


SCRIPTS_ALONE = {
    "tee_ge_2012, exact derivatives": (tee_ge_exact, (), 1.5),
    "tee_ge_2012, filter of the model": (tee_ge_filter, (0.0,), 0.9),
    "tangent_barrier_2013, published barrier": (tangent_alone, (), 3.0),
    "liu_output_bound, published alpha": (liu_alone, (), 5.0),
}
"""Script and run -> the rate of the state by hand, the start of further states, and the end of the
comparison: the published rho divides by z, which passes 0."""


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS_ALONE)
def test_a_program_of_the_printed_law_gives_the_same_motion_as_a_script(name):
    rate, further, end = SCRIPTS_ALONE[name]
    script, which = name.split(", ", 1)
    run = runs_of(script)[which]
    t, x = np.asarray(run.t), np.asarray(run.x)[..., 0]
    some = np.arange(0, np.searchsorted(t, end), 50)
    start = [*x[0], *further]
    found = solve_ivp(
        rate, (0.0, end), start, "DOP853", t_eval=t[some], rtol=1e-10, atol=1e-12
    ).y.T[:, :2]
    np.testing.assert_allclose(found, x[some], rtol=1e-6, atol=1e-7)
