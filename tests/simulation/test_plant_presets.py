"""The presets of plants in strict-feedback form run inside their bounds, as documented."""

import inspect
import re

import numpy as np
import pytest

import iblf_jax as ij

RUNS = {
    "motor_driven_pendulum": (20.0, 2e-3),
    "motor_driven_two_link": (20.0, 1e-3),
    "flexible_joint_two_link": (20.0, 5e-4),
    "vessel": (160.0, 0.02),
    "flexible_joint_iiwa14": (10.0, 5e-4),
}
"""Preset -> the documented duration and time step [s]."""
LARGEST_INPUT = {
    "motor_driven_pendulum": [12.0],
    "motor_driven_two_link": [40.0, 10.0],
    "flexible_joint_two_link": [10.0, 3.0],
    "vessel": [6.0, 6.0, 1.0],
    "flexible_joint_iiwa14": [320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0],
}
"""[V], [V], [N m], [N, N, N m], and the torque limits of the iiwa 14 [N m]."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=pytest.mark.release) if "iiwa" in x else x for x in RUNS]
)
def test_a_preset_runs_inside_its_bounds(name):
    duration, dt = RUNS[name]
    run = ij.simulate(ij.presets.PRESETS[name](), duration=duration, dt=dt, record_every=5)
    assert int(run.status) == 0 and float(run.metrics.relative_numerical_error) < 1e-4
    assert np.all(run.metrics.margin > 0)
    np.testing.assert_array_less(run.metrics.peak_torque, LARGEST_INPUT[name])


@pytest.mark.parametrize("name", RUNS)
def test_documented_durations_steps_and_assumptions(name):
    text = " ".join((inspect.getdoc(ij.presets.PRESETS[name]) or "").split())
    duration, dt = RUNS[name]
    found = re.search(r"runs of (\d+) s.* at dt = (\S+) s\.", text)
    assert found
    assert (float(found[1]), float(found[2])) == (duration, dt) and "ASSUMPTION" in text


def test_the_presets_of_plants_are_all_tested_here():
    robots = {"zhang_yan_2024", "printed_gap", "ur5", "iiwa14"}
    others = {x for x in ij.presets.PRESETS if not x.startswith("zhang_yan_2024_")}
    assert others - robots == set(RUNS)
