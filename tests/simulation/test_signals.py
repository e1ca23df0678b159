"""The signals of the levels and the views of their first rows."""

import numpy as np
import pytest
from plant_cases import ANGLES, pendulum, symmetric

import iblf_jax as ij
from iblf_jax.simulation.signals import FIELDS, SIGNALS, VIEWS

SHORT = {"duration": 0.02, "dt": 1e-3}


@pytest.mark.slow
@pytest.mark.parametrize("above", [(), (None, symmetric(90.0))])
def test_views_are_rows_and_bounds_end_with_the_last_level_that_has_some(above):
    law = ij.controllers.BarrierBackstepping(k=(3.0, 10.0, 30.0))
    run = ij.simulate(pendulum(controller=law, bounds=(ANGLES, *above)), **SHORT)
    samples = run.t.size
    assert run.x.shape == run.e.shape == (samples, 3, 1)
    assert run.level_lower.shape == run.level_upper.shape == (samples, 1 + len(above), 1)
    for name, view in VIEWS.items():
        rows = np.asarray(getattr(run, view.signal))
        expected = rows[:, view.row] if view.row < rows.shape[1] else ()
        np.testing.assert_array_equal(getattr(run, name), expected, err_msg=name)
    if above:
        assert np.all(np.isneginf(run.dq_lower)) and np.all(np.isposinf(run.dq_upper))
        np.testing.assert_array_equal(run.level_upper[:, 2], 90.0)


def test_the_errors_of_a_robot_have_two_rows_and_those_of_all_levels_their_virtual_controls():
    robot = ij.simulate(ij.presets.zhang_yan_2024(), **SHORT)
    assert robot.x.shape == robot.e.shape == (21, 2, 2)
    np.testing.assert_array_equal(robot.e1, robot.q - robot.q_d)
    np.testing.assert_allclose(robot.e2, robot.dq - robot.alpha, rtol=0, atol=1e-15)


def test_every_signal_has_a_unit_and_a_meaning():
    assert set(SIGNALS) == {*FIELDS, *VIEWS}
    assert all(signal.unit and signal.meaning for signal in SIGNALS.values())
