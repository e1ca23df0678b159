"""Laws and loops of plants in strict-feedback form as C, FMUs and WebAssembly: the numbers of
`simulate`."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import loops_of_plants
import numpy as np
import pytest
from test_export_parts import self_test

import iblf_jax as ij
from iblf_jax.deployment import control_law
from iblf_jax.deployment.control_law import GivenReference
from iblf_jax.deployment.signal_units import one_unit, per_time
from iblf_jax.simulation.closed_loop import initial_state
from iblf_jax.simulation.scenario import canonical

PERIOD = 1e-3
CASES = loops_of_plants.CASES | {"rigid law": loops_of_plants.rigid_law}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "reference"), [*((case, "inside") for case in CASES), ("electric drive", "given")]
)
@pytest.mark.filterwarnings("ignore:the simulated run")
def test_the_c_of_a_law_gives_the_inputs_of_simulate(tmp_path, case, reference, monkeypatch):
    monkeypatch.setattr("iblf_jax.deployment.export.VECTORS_DURATION", 0.08)
    ij.export(CASES[case](), tmp_path, period=PERIOD, reference=reference)
    self_test(tmp_path)
    header = (tmp_path / "iblf_law.h").read_text()
    order = ij.plants.order_of(CASES[case]().model)
    assert ("*x_3" in header) == (order > 2)
    assert (f"*d{order}q_d" in header) == (order > 2 and reference == "given")


@pytest.mark.slow
def test_a_law_of_a_rigid_model_has_no_parameters_of_the_plant(tmp_path):
    exported = ij.export(loops_of_plants.rigid_law(), tmp_path, period=PERIOD)
    assert not [path for path in exported.parameters if path.startswith("plant")]


@pytest.mark.slow
def test_a_given_reference_has_the_derivatives_that_it_is_given():
    derivatives = [0.3, -0.2, 0.5, 0.7, -1.1]
    numbers = [jnp.asarray([x]) for x in derivatives]
    reference = GivenReference(jnp.asarray(2.0), *numbers[:3], further_d=jnp.stack(numbers[3:]))
    function = reference.position
    for expected in derivatives:
        np.testing.assert_allclose(function(jnp.asarray(2.0)), [expected], rtol=1e-12)
        function = jax.jacfwd(function)


@pytest.mark.slow
def test_a_law_as_an_fmu_receives_all_levels(tmp_path):
    fmpy = pytest.importorskip("fmpy")
    pytest.importorskip("fmpy.validation")
    scenario = loops_of_plants.electric_drive(sampling=ij.Sampling(PERIOD))
    ij.export(scenario, tmp_path, target="fmu")
    file = str(tmp_path / "iblf_law.fmu")
    assert fmpy.validation.validate_fmu(file) == []
    run = ij.simulate(scenario, duration=0.08, dt=PERIOD)
    levels = {"q": run.measured.q, "dq": run.measured.dq, "x_3": run.measured.higher[:, 0]}
    kinds = [("time", float), *((name, float, (2,)) for name in levels)]
    inputs = np.zeros(run.t.size, kinds)
    inputs["time"] = run.t
    for name, values in levels.items():
        inputs[name] = values
    found = fmpy.simulate_fmu(
        file, stop_time=0.08, step_size=PERIOD, output_interval=PERIOD, output=["tau"], input=inputs
    )
    np.testing.assert_allclose(found["tau"][1:], run.tau[:-1], atol=1e-9)
    variables = {v.name: v for v in fmpy.read_model_description(file).modelVariables}
    units = {name: variables[name].unit for name in ("x_3", "tau", "alpha", "d_hat_3")}
    assert units == {"x_3": "A", "tau": "V", "alpha": "rad/s", "d_hat_3": "A/s"}


@pytest.mark.slow
def test_a_closed_loop_as_an_fmu_is_simulate(tmp_path):
    fmpy = pytest.importorskip("fmpy")
    pytest.importorskip("fmpy.validation")
    scenario = loops_of_plants.user_functions()
    ij.export(scenario, tmp_path, target="fmu-loop")
    file = str(tmp_path / "iblf_loop.fmu")
    assert fmpy.validation.validate_fmu(file) == []
    run = ij.simulate(scenario, duration=0.08, dt=1e-3, record_every=10)
    names = {"q": run.q, "tau": run.tau, "x_3": run.x[:, 2], "d_2": run.disturbance[:, 1]}
    found = fmpy.simulate_fmu(
        file, stop_time=0.08, step_size=1e-3, output_interval=1e-2, output=list(names)
    )
    for name, expected in names.items():
        values = np.reshape(found[name], np.shape(expected))
        np.testing.assert_allclose(values, expected, atol=1e-9, err_msg=name)


@pytest.mark.slow
def test_a_closed_loop_in_webassembly_is_simulate(tmp_path):
    wasmtime = pytest.importorskip("wasmtime")
    pytest.importorskip("ziglang")
    scenario = loops_of_plants.electric_drive()
    ij.export(scenario, tmp_path, target="wasm", dt=1e-3)
    store = wasmtime.Store()
    module = wasmtime.Module.from_file(store.engine, str(tmp_path / "iblf_loop.wasm"))
    loop = wasmtime.Instance(store, module, []).exports(store)
    table = json.loads((tmp_path / "iblf_loop.json").read_text())
    loop["_initialize"](store)
    loop["defaults"](store)
    settings = np.asarray(table["settings"], float).tobytes()
    loop["memory"].write(store, settings, loop["settings"](store))
    loop["start"](store)
    rows = loop["run"](store, 81, 10)
    place = loop["records"](store)
    numbers = loop["memory"].read(store, place, place + 8 * rows * table["record"])
    numbers = np.frombuffer(numbers, float).reshape(rows, -1)
    found = {x["name"]: numbers[:, x["offset"] :][:, : x["size"]] for x in table["records"]}
    run = ij.simulate(scenario, duration=0.08, dt=1e-3, record_every=10)
    for name, expected in (("q", run.q), ("tau", run.tau), ("x_3", run.x[:, 2])):
        np.testing.assert_allclose(found[name], expected, atol=1e-10, err_msg=name)
    assert {x["name"]: x["unit"] for x in table["records"]}["x_3"] == "A"


def test_units_of_inputs_and_outputs():
    assert [per_time("rad/s", k) for k in range(3)] == ["rad/s", "rad/s^2", "rad/s^3"]
    assert per_time("A", 1) == "A/s"
    assert per_time("N m/rad", 2) == "N m/(rad s^2)"
    assert one_unit(("m", "m", "rad")) == "1"
    assert one_unit(("m", "m")) == "m"


def test_mujoco_refuses_what_is_no_robot():
    with pytest.raises(ValueError, match=r"scenario\.plant: got 'FlexibleJoint'.*plant\.robot"):
        ij.cosimulate(loops_of_plants.flexible_joint(), "arm.xml", period=PERIOD, duration=0.1)


def test_mujoco_refuses_process_noise():
    scenario = ij.with_parts(
        ij.presets.zhang_yan_2024(), process_noise=ij.process_noise.Additive(0.2)
    )
    with pytest.raises(ValueError, match=r"process_noise: got 'Additive'.*process_noise=None"):
        ij.cosimulate(scenario, "arm.xml", period=PERIOD, duration=0.1)


def test_the_input_at_the_start_is_that_of_the_loop():
    """Of a drive under a law of robots it is the voltage that holds the robot, and no torque."""
    paper = ij.presets.zhang_yan_2024()
    drive = ij.plants.ElectricDrive(
        paper.plant,
        torque_constant=[2.0, 1.5],
        inductance=0.02,
        resistance=[1.0, 0.5],
        back_emf=0.5,
    )
    law = ij.controllers.WithDrive(ij.controllers.PDGravity(Kp=60.0, Kd=20.0), drive=drive)
    scenario = canonical(
        ij.with_parts(
            paper,
            plant=drive,
            model=paper.plant,
            controller=law,
            observer=ij.observers.NoObserver(),
            sampling=ij.Sampling(period=1e-3, delay=1e-3),
        )
    )
    balance = control_law.start(scenario, control_law.inputs_at_start(scenario))[1]
    in_transit = initial_state(scenario).sampled.commands
    np.testing.assert_array_equal(in_transit, [balance] * len(in_transit))
    q = scenario.initial.q
    np.testing.assert_array_equal(balance, drive.steady_input(q))
