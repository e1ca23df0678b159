"""Figures and animations of plants in strict-feedback form: rows of levels, names and units."""

import numpy as np
import pytest
from loops_of_plants import flexible_joint
from made_up_runs import chain, made_up
from plant_cases import body, pendulum
from refused import assert_refused

import iblf_jax as ij
from iblf_jax import plotting
from iblf_jax.plotting._arm import Scene, motions_of
from iblf_jax.plotting._curves import curves_of

LEVELS = ["angle $x_1$ [rad]", "speed $x_2$ [rad/s]", "current $x_{3}$ [A]"]


@pytest.fixture(scope="module")
def run():
    return ij.simulate(pendulum(), duration=0.8, dt=1e-2)


@pytest.fixture(scope="module")
def body_run():
    return ij.simulate(body(), duration=0.8, dt=1e-2)


def labels_of(figure) -> list[str]:
    return [axes.get_ylabel() for axes in figure.axes]


@pytest.mark.slow
def test_figures_have_the_names_and_units_of_the_plant(run, body_run):
    assert labels_of(plotting.levels(run))[::2] == [*LEVELS, "input $u$ [V]"]
    assert r"virtual control $\alpha_{i-1}$" in [x.get_label() for x in run.plot().axes[2].lines]
    overview = labels_of(body_run.plot())
    assert overview[:3] == ["pose $x_1$ [m]", "pose $x_1$ [m]", "pose $x_1$ [rad]"]
    assert "force $u$ [N, N, N m]" in overview
    assert "north\n$u$ [N]" in labels_of(plotting.torques(body_run))
    assert "heading\n$x_2$ [rad/s]" in labels_of(plotting.velocities(body_run))
    assert plotting.positions(body_run).get_suptitle() == "Pose"
    portraits = plotting.velocity_portrait(body_run, "heading"), plotting.phase_portrait(body_run)
    found = [figure.axes[0].get_xlabel() for figure in portraits]
    assert found == ["pose of heading [rad]", "pose of north [m]"]
    assert labels_of(plotting.uncertain_terms(run))[0] == "pendulum\n$d_{2}$ [rad/s^2]"
    assert labels_of(plotting.tube(body()))[2] == "heading\n$x_1$ [rad]"


@pytest.mark.slow
def test_what_cannot_be_drawn_is_refused(run, body_run, tmp_path):
    for words, draw, *arguments in (
        ("the same number of levels", plotting.levels, {"third": run, "second": made_up(chain(1))}),
        ("a component, 0 to 2", plotting.levels, body_run, 3),
        ("expected a plant with a shape", plotting.workspace, run),
        ("expected a plant with a shape", plotting.animate, run, tmp_path / "film.gif"),
    ):
        assert_refused(words, draw, *arguments)


@pytest.mark.slow
def test_a_plant_with_an_outline_is_animated_and_drawn_along_its_path(body_run, tmp_path):
    path = plotting.animate(body_run, tmp_path / "body.gif", fps=2)
    assert path.stat().st_size > 1000
    (axes,) = plotting.workspace(body_run).axes
    triangles = [line for line in axes.get_lines() if len(line.get_xdata()) == 4]
    assert len(triangles) == 9
    start = body_run.scenario.plant.outline(body_run.q[0])
    assert np.allclose(triangles[0].get_xydata()[:3], start, atol=1e-9)


@pytest.mark.slow
def test_a_flexible_arm_is_animated_with_its_motors(tmp_path):
    run = ij.simulate(flexible_joint(), duration=0.08, dt=1e-3)
    curves = curves_of(run)
    scene = Scene(curves, *motions_of(curves, np.array([0.0, 0.05])))
    scene.move_to(1)
    motors = scene.motors[0].get_xdata()
    assert np.allclose(motors, run.x[50, 2], atol=1e-12)
    assert not np.allclose(motors, run.q[50], atol=1e-3)
    assert plotting.animate(run, tmp_path / "arm.gif", fps=5).exists()


@pytest.mark.slow
def test_the_report_of_a_scenario_names_its_levels(tmp_path):
    scenario = ij.report(pendulum(), tmp_path / "scenario.html").read_text()
    assert "3 levels: angle [rad], speed [rad/s], current [A]; input: input [V]" in scenario
    assert "1 component: pendulum" in scenario
