"""Laws and loops of plants in strict-feedback form as C, FMUs and WebAssembly: the numbers of
`simulate`."""

from __future__ import annotations

import loops_of_plants
import numpy as np
import pytest
from exported import Module, built_and_run, fmpy, run_fmu

import iblf_jax as ij
from iblf_jax.deployment import control_law
from iblf_jax.deployment.signal_units import one_unit, per_time
from iblf_jax.simulation.closed_loop import initial_state
from iblf_jax.simulation.scenario import canonical

PERIOD = 1e-3
CASES = loops_of_plants.CASES | {"rigid law": loops_of_plants.rigid_law}
AS_C = ("flexible joint", "user class", "rigid law")
"""Cases whose law is written as C; those of the others are in FMUs and WebAssembly."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "reference"), [*((case, "inside") for case in AS_C), ("flexible joint", "given")]
)
@pytest.mark.filterwarnings("ignore:the simulated run")
def test_the_c_of_a_law_gives_the_inputs_of_simulate(tmp_path, case, reference, monkeypatch):
    monkeypatch.setattr("iblf_jax.deployment.export.VECTORS_DURATION", 0.08)
    ij.export(CASES[case](), tmp_path, period=PERIOD, reference=reference)
    built_and_run(tmp_path, "-O0")
    header = (tmp_path / "iblf_law.h").read_text()
    order = ij.plants.order_of(CASES[case]().model)
    assert ("*x_3" in header) == (order > 2)
    assert (f"*d{order}q_d" in header) == (order > 2 and reference == "given")


@pytest.mark.slow
def test_a_law_of_a_rigid_model_has_no_parameters_of_the_plant(tmp_path):
    exported = ij.export(loops_of_plants.rigid_law(), tmp_path, period=PERIOD)
    assert not [path for path in exported.parameters if path.startswith("plant")]


@pytest.mark.slow
def test_a_law_as_an_fmu_receives_all_levels(tmp_path):
    scenario = loops_of_plants.electric_drive(sampling=ij.Sampling(PERIOD))
    ij.export(scenario, tmp_path, target="fmu")
    file = str(tmp_path / "iblf_law.fmu")
    run = ij.simulate(scenario, duration=0.08, dt=PERIOD)
    inputs = {"time": run.t, "q": run.measured.q, "dq": run.measured.dq}
    inputs["x_3"] = run.measured.higher[:, 0]
    found = run_fmu(file, ["tau"], 0.08, PERIOD, inputs)
    np.testing.assert_allclose(found["tau"][1:], run.tau[:-1], atol=1e-9)
    variables = {v.name: v for v in fmpy.read_model_description(file).modelVariables}
    units = {name: variables[name].unit for name in ("x_3", "tau", "alpha", "d_hat_3")}
    assert units == {"x_3": "A", "tau": "V", "alpha": "rad/s", "d_hat_3": "A/s"}


@pytest.mark.slow
def test_a_closed_loop_as_an_fmu_is_simulate(tmp_path):
    scenario = loops_of_plants.user_functions()
    ij.export(scenario, tmp_path, target="fmu-loop")
    run = ij.simulate(scenario, duration=0.08, dt=1e-3, record_every=10)
    names = {"q": run.q, "tau": run.tau, "x_3": run.x[:, 2], "d_2": run.disturbance[:, 1]}
    found = run_fmu(tmp_path / "iblf_loop.fmu", names, 0.08, 1e-2, step_size=1e-3)
    for name, expected in names.items():
        values = np.reshape(found[name], np.shape(expected))
        np.testing.assert_allclose(values, expected, atol=1e-9, err_msg=name)


@pytest.mark.slow
def test_a_closed_loop_in_webassembly_is_simulate(tmp_path):
    scenario = loops_of_plants.electric_drive()
    ij.export(scenario, tmp_path, target="wasm", dt=1e-3)
    loop = Module(tmp_path)
    found = loop.run(81, 10)
    run = ij.simulate(scenario, duration=0.08, dt=1e-3, record_every=10)
    for name, expected in (("q", run.q), ("tau", run.tau), ("x_3", run.x[:, 2])):
        np.testing.assert_allclose(found[name], expected, atol=1e-10, err_msg=name)
    assert {x["name"]: x["unit"] for x in loop.table["records"]}["x_3"] == "A"


def test_units_of_inputs_and_outputs():
    assert [per_time("rad/s", k) for k in range(3)] == ["rad/s", "rad/s^2", "rad/s^3"]
    assert per_time("A", 1) == "A/s"
    assert per_time("N m/rad", 2) == "N m/(rad s^2)"
    assert one_unit(("m", "m", "rad")) == "1"
    assert one_unit(("m", "m")) == "m"


def test_mujoco_refuses_what_is_no_robot_and_process_noise():
    noise = ij.process_noise.Additive(0.2)
    for scenario, words in (
        (loops_of_plants.flexible_joint(), r"scenario\.plant: got 'FlexibleJoint'.*plant\.robot"),
        (
            ij.with_parts(ij.presets.zhang_yan_2024(), process_noise=noise),
            r"process_noise: got 'Additive'.*process_noise=None",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            ij.cosimulate(scenario, "arm.xml", period=PERIOD, duration=0.1)


def test_the_input_at_the_start_is_that_of_the_loop():
    """Of a drive under a law of robots it is the voltage that holds the robot, and no torque."""
    paper = ij.presets.zhang_yan_2024()
    motor = {"torque_constant": [2.0, 1.5], "inductance": 0.02, "back_emf": 0.5}
    drive = ij.plants.ElectricDrive(paper.plant, resistance=[1.0, 0.5], **motor)
    law = ij.controllers.WithDrive(ij.controllers.PDGravity(Kp=60.0, Kd=20.0), drive=drive)
    parts = {"plant": drive, "model": paper.plant, "controller": law}
    parts |= {"observer": ij.observers.NoObserver(), "sampling": ij.Sampling(1e-3, delay=1e-3)}
    scenario = canonical(ij.with_parts(paper, **parts))
    balance = control_law.start(scenario, control_law.inputs_at_start(scenario))[1]
    in_transit = initial_state(scenario).sampled.commands
    np.testing.assert_array_equal(in_transit, [balance] * len(in_transit))
    q = scenario.initial.q
    np.testing.assert_array_equal(balance, drive.steady_input(q))
