"""Limits of plants and laws in strict-feedback form: small inductance, stiff joints, fast levels
and fast filters.  Each is measured as an order of convergence, over runs of one length."""

from __future__ import annotations

import numpy as np
import pytest

import iblf_jax as ij

PAPER = ij.presets.zhang_yan_2024(variant="corrected")
ROBOT = PAPER.plant
SHORT = {"duration": 0.4, "dt": 2e-4, "record_every": 20}


def drive(inductance):
    return ij.plants.ElectricDrive(
        ROBOT, torque_constant=[2.0, 1.5], inductance=inductance, resistance=1.0, back_emf=0.5
    )


def flexible(stiffness):
    return ij.plants.FlexibleJoint(
        ROBOT, stiffness=stiffness, motor_inertia=[0.1, 0.02], motor_damping=[2.0, 0.5]
    )


def on(plant, law, model=None, disturbance=PAPER.disturbance, **parts):
    """The paper's task on another plant."""
    return ij.Scenario(
        plant=plant,
        model=model,
        reference=PAPER.reference,
        bounds=PAPER.bounds[0],
        controller=law,
        initial=PAPER.initial,
        disturbance=disturbance,
        **parts,
    )


def distance(a, b):
    """Largest distance of the positions of two runs [rad]."""
    return float(np.max(np.abs(np.asarray(a.q) - np.asarray(b.q))))


def orders(errors):
    """The orders of convergence between errors at parameters that are halved."""
    return np.log2(np.asarray(errors[:-1]) / np.asarray(errors[1:]))


@pytest.mark.slow
def test_a_rigid_law_on_a_drive_tends_to_the_rigid_loop_for_a_small_inductance():
    """First order in L: the current lags by L/R."""
    law = ij.controllers.Backstepping(k1=2.0, K2=5.0, o=0.1, variant="corrected")
    observer = ij.observers.Momentum(kf=5.0)
    rigid = ij.simulate(ij.with_parts(PAPER, controller=law, observer=observer), **SHORT)
    errors = []
    for inductance in (4e-3, 2e-3, 1e-3):
        plant = drive(inductance)
        with_drive = ij.controllers.WithDrive(law, drive=plant)
        run = ij.simulate(on(plant, with_drive, model=ROBOT, observer=observer), **SHORT)
        errors.append(distance(run, rigid))
    assert errors[-1] < 1e-3
    assert np.all(np.abs(orders(errors) - 1.0) < 0.15), errors


@pytest.mark.slow
def test_a_rigid_law_on_stiff_joints_tends_to_the_robot_with_motors():
    """First order in 1/K, with the inertia of the motors in the model."""
    law = ij.controllers.Backstepping(k1=2.0, K2=[4.0, 0.6], o=0.1, variant="corrected")
    rigid = flexible(1.0).rigid()
    limit = ij.simulate(on(rigid, law, model=rigid), **SHORT)
    errors = []
    for stiffness in (2e3, 4e3, 8e3, 16e3):
        run = ij.simulate(on(flexible(stiffness), law, model=rigid), **SHORT)
        errors.append(distance(run, limit))
    assert np.all(np.abs(orders(errors) - 1.0) < 0.15), errors
    assert errors[-1] < 5e-4


@pytest.mark.slow
def test_a_dynamic_surface_tends_to_the_exact_law_for_fast_filters():
    """First order in mu, without a disturbance: a filter follows the true rate of alpha, and the
    exact law computes that of its model."""
    gains = {"k": (2.0, 10.0, 40.0)}
    plant, still = drive(0.02), ij.disturbances.Nothing()
    exact = ij.controllers.BarrierBackstepping(**gains)
    limit = ij.simulate(on(plant, exact, disturbance=still), **SHORT)
    errors = []
    for mu in (4e-3, 2e-3, 1e-3):
        law = ij.controllers.BarrierBackstepping(**gains, filter=mu)
        run = ij.simulate(on(plant, law, disturbance=still), **SHORT)
        errors.append(distance(run, limit))
    assert np.all(np.abs(orders(errors) - 1.0) < 0.2), errors
    assert errors[-1] < 5e-3
