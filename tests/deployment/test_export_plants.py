"""Laws and loops of plants, and further parts, as C, FMUs and WebAssembly: the numbers of
`simulate`, where the results of the C are, and its bounds.  The parts are observers of levels,
states of laws, event triggers and process noise."""

import collections
import ctypes
import re
import subprocess
import warnings

import jax
import jax.numpy as jnp
import loops_of_plants
import members
import numpy as np
import pytest
from exported import Module, built_and_run, fmpy, run_fmu
from iblf_jax.sensors import Direct, Encoder, FilteredDifference, Levels

import iblf_jax as ij
from iblf_jax.deployment import control_law, export
from iblf_jax.deployment.control_law import FLAGS, SampleInputs, bounds_at, inputs_at_start
from iblf_jax.deployment.signal_units import one_unit, per_time
from iblf_jax.deployment.write_c import C_TYPES, fill_template, vectors_of
from iblf_jax.simulation.closed_loop import initial_state
from iblf_jax.simulation.scenario import canonical

PERIOD, DURATION = 1e-3, 0.08
SAMPLING = ij.Sampling(PERIOD)
CASES = loops_of_plants.CASES | {"rigid law": loops_of_plants.rigid_law}
AS_C = ("flexible joint", "user class", "rigid law")
"""Cases whose law is written as C; those of the others are in FMUs and WebAssembly."""


@pytest.mark.slow
@pytest.mark.parametrize("case", [*AS_C, "flexible joint, given"])
@pytest.mark.filterwarnings("ignore:the simulated run")
def test_the_c_of_a_law_gives_the_inputs_of_simulate(tmp_path, case):
    case, _, given = case.partition(", ")
    reference = given or "inside"
    exported = ij.export(CASES[case](), tmp_path, period=PERIOD, reference=reference)
    built_and_run(tmp_path, "-O0")
    is_of_plant = any(path.startswith("plant") for path in exported.parameters)
    assert not (is_of_plant and case == "rigid law")
    header = (tmp_path / "iblf_law.h").read_text()
    order = ij.plants.order_of(CASES[case]().model)
    assert ("*x_3" in header) == (order > 2)
    assert (f"*d{order}q_d" in header) == (order > 2 and reference == "given")


@pytest.mark.slow
def test_a_law_as_an_fmu_and_closed_loops_in_webassembly_and_as_an_fmu_are_simulate(tmp_path):
    scenario = loops_of_plants.electric_drive(sampling=SAMPLING)
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
    scenario = loops_of_plants.electric_drive()
    ij.export(scenario, tmp_path / "wasm", target="wasm", dt=1e-3)
    loop = Module(tmp_path / "wasm")
    found = loop.run(81, 10)
    run = ij.simulate(scenario, duration=0.08, dt=1e-3, record_every=10)
    for name, expected in (("q", run.q), ("tau", run.tau), ("x_3", run.x[:, 2])):
        np.testing.assert_allclose(found[name], expected, atol=1e-10, err_msg=name)
    assert {x["name"]: x["unit"] for x in loop.table["records"]}["x_3"] == "A"
    scenario = loops_of_plants.user_functions()
    ij.export(scenario, tmp_path / "loop", target="fmu-loop")
    run = ij.simulate(scenario, duration=0.08, dt=1e-3, record_every=10)
    names = {"q": run.q, "tau": run.tau, "x_3": run.x[:, 2], "d_2": run.disturbance[:, 1]}
    found = run_fmu(tmp_path / "loop" / "iblf_loop.fmu", names, 0.08, 1e-2, step_size=1e-3)
    for name, expected in names.items():
        values = np.reshape(found[name], np.shape(expected))
        np.testing.assert_allclose(values, expected, atol=1e-9, err_msg=name)


def test_units_of_inputs_and_outputs_and_the_input_at_the_start():
    """Of a drive under a law of robots it is the voltage that holds the robot, and no torque."""
    assert [per_time("rad/s", k) for k in range(3)] == ["rad/s", "rad/s^2", "rad/s^3"]
    assert per_time("A", 1) == "A/s" and per_time("N m/rad", 2) == "N m/(rad s^2)"
    assert one_unit(("m", "m", "rad")) == "1" and one_unit(("m", "m")) == "m"
    paper = ij.presets.zhang_yan_2024()
    motor = {"torque_constant": [2.0, 1.5], "inductance": 0.02, "back_emf": 0.5}
    drive = ij.plants.ElectricDrive(paper.plant, resistance=[1.0, 0.5], **motor)
    law = ij.controllers.WithDrive(ij.controllers.PDGravity(Kp=60.0, Kd=20.0), drive=drive)
    parts = {"plant": drive, "model": paper.plant, "controller": law}
    parts |= {"observer": ij.observers.NoObserver(), "sampling": ij.Sampling(1e-3, delay=1e-3)}
    scenario = canonical(ij.with_parts(paper, **parts))
    balance = control_law.start(scenario, inputs_at_start(scenario))[1]
    in_transit = initial_state(scenario).sampled.commands
    np.testing.assert_array_equal(in_transit, [balance] * len(in_transit))
    np.testing.assert_array_equal(balance, drive.steady_input(scenario.initial.q))


def test_reference_data_have_every_level_and_derivative():
    rows = np.arange(3 * 7 * 2.0).reshape(3, 7, 2)
    names = SampleInputs._fields[1:]
    columns = {name: rows[:, i] for i, name in enumerate(names)}
    columns |= {name: columns[name][:, None] for name in ("higher", "further_d")}
    inputs = SampleInputs(np.arange(3.0), **columns)
    found = vectors_of(SampleInputs(*(x[0] for x in inputs)), inputs, np.zeros((3, 2)))
    np.testing.assert_array_equal(np.array(found.first), rows[0])
    np.testing.assert_array_equal(np.stack([found.q, found.dq, *found.further], 1), rows)


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


def robot(**parts):
    return ij.with_parts(ij.presets.zhang_yan_2024(), **({"sampling": SAMPLING} | parts))


def measured(loop, parts, levels):
    """A sampled loop with these sensors of levels; its observer estimates the other levels."""
    observer = ij.observers.StateObserver(bandwidth=100.0, measured=levels)
    return ij.with_parts(loop, sampling=SAMPLING, sensor=Levels(parts), observer=observer)


def noisy():
    return robot(process_noise=ij.process_noise.Additive(0.2))


def switched():
    plant = ij.presets.zhang_yan_2024().plant
    return robot(plant=ij.plants.Switched(plant, {"mass[1]": (0.85, 1.5)}, [0.04]))


FILTERED = Encoder(velocity=FilteredDifference(cutoff=200.0))
NO_OBSERVER = ij.observers.NoObserver()
DRIVE, FLEXIBLE = loops_of_plants.electric_drive, loops_of_plants.flexible_joint
OBSERVED = {
    "robot": lambda: measured(robot(), (Direct(), None), (1,)),
    "drive": lambda: measured(DRIVE(), (Direct(), None, None), (1,)),
    "current": lambda: measured(DRIVE(), (Direct(), None, Direct()), (1, 3)),
    "motor": lambda: measured(FLEXIBLE(), (FILTERED, Direct(), None), (1, 2, 3)),
}
"""Name -> a loop that estimates levels."""
UNREAD = {"robot": {"dq"}, "drive": {"dq", "x_3"}, "current": {"dq"}, "motor": {"dq", "x_4"}}
"""Name -> the inputs that a sample does not read."""
TRIGGER = ij.EventTrigger(relative=0.1, absolute=[0.3, 0.1])
LAWS = {
    "trigger": lambda: robot(sampling=ij.Sampling(1e-3, trigger=TRIGGER)),
    "decays": lambda: robot(controller=members.LAWS["backstepping_decays"], observer=NO_OBSERVER),
}


def release(names, quick):
    """Names as parameters of a test, of which all but one run before a release."""
    marked = [pytest.param(name, marks=pytest.mark.release) for name in names if name != quick]
    return [quick, *marked]


@pytest.fixture(autouse=True)
def short_run(monkeypatch):
    monkeypatch.setattr("iblf_jax.deployment.export.VECTORS_DURATION", DURATION)


@pytest.mark.slow
@pytest.mark.parametrize("case", release(OBSERVED, "robot"))
@pytest.mark.filterwarnings("ignore:the simulated run")
def test_a_law_that_estimates_levels_reads_the_measured_ones(tmp_path, case):
    scenario = canonical(OBSERVED[case]())
    ij.export(scenario, tmp_path)
    built_and_run(tmp_path, "-O0")
    source = (tmp_path / "iblf_law.c").read_text()
    assert set(re.findall(r"if \((\w+) == NULL\)", source)) == UNREAD[case]
    run = ij.simulate(scenario, duration=DURATION, dt=1e-3)
    torques = export.vectors(scenario, external_reference=False).tau
    np.testing.assert_allclose(torques, run.tau[:-1:10], rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_the_run_of_the_self_test_has_the_time_step_that_the_plant_needs(tmp_path):
    """Friction that decays by about 4500 1/s: RK4 diverges with steps of 1 ms."""
    stiff = robot(disturbance=ij.disturbances.Friction(viscous=100.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ij.export(stiff, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("case", release(LAWS, "trigger"))
@pytest.mark.filterwarnings("ignore:the simulated run")
def test_the_c_of_a_law_with_a_state_of_its_own_passes_its_self_test(tmp_path, case):
    ij.export(LAWS[case](), tmp_path)
    built_and_run(tmp_path, "-O0")


@pytest.mark.release
@pytest.mark.parametrize(("case", "method"), [(noisy, "euler_maruyama"), (switched, "rk4")])
def test_a_sampled_closed_loop_as_an_fmu_is_simulate(tmp_path, case, method):
    ij.export(case(), tmp_path, target="fmu-loop", method=method, seed=3)
    run = ij.simulate(case(), duration=DURATION, dt=1e-3, method=method, seed=3)
    found = run_fmu(tmp_path / "iblf_loop.fmu", ["q", "tau"], DURATION, 1e-3)
    np.testing.assert_allclose(found["q"], run.q, atol=1e-9)
    np.testing.assert_allclose(found["tau"], run.tau, atol=1e-9)


@pytest.mark.parametrize("target", ["fmu-loop", "wasm"])
def test_a_closed_loop_with_noise_needs_a_stochastic_method(tmp_path, target):
    with pytest.raises(ValueError, match=r"method: got 'rk4'.*as the plant has process noise"):
        ij.export(noisy(), tmp_path, target=target)


NUMBERED = """
static void count(F *r, int size) { while (size-- > 0) r[size] = size; }
static void law_start(const law_parameters *p, const F *t, const F *q, const F *dq, F *r) {
  count(r, 5);
}
static void law_sample(const law_parameters *p, const F *m, const F *t, const F *q, const F *dq,
    F *r) {
  count(r, 9);
  r[9] = r[11] = 1;
  r[10] = r[12] = 0;
}
static void law_tube(const law_parameters *p, const F *t, const F *q, const F *dq, F *r) {
  count(r, 4);
}
"""
"""Programs of a law with a memory of three numbers, whose results are their own places."""


def compiled(folder, name):
    command = ["cc", "-std=c99", "-shared", "-fPIC", f"{name}.c", "-lm", "-o", "law.so"]
    subprocess.run(command, cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "law.so"))


def test_each_result_is_where_the_header_says(tmp_path):
    """Memory, torques, virtual velocities, estimate and flags; lower bounds before upper ones."""
    names = {"name": "law", "upper": "LAW", "guard": "LAW_H", "parameters": "  double one;"}
    sizes = {"joints": 2, "memory_count": 3, "memory_size": 3, "estimate_size": 2}
    copy = "memcpy(s->memory, result, sizeof s->memory);"
    keep = {"keep_start": copy, "keep_sample": copy}
    code = {"start": NUMBERED, "defaults": "{0}", "default_unread": "(void)zero;"}
    values = collections.defaultdict(str, C_TYPES[False] | names | sizes | keep | code)
    values["flags"] = len(FLAGS)
    values["prelude"] = fill_template("prelude.c", values)
    for ending in ("h", "c"):
        (tmp_path / f"law.{ending}").write_text(fill_template(f"law.{ending}", values))
    law, parameters = compiled(tmp_path, "law"), ctypes.c_double(0.0)
    state, zero, lower, upper, tau = (np.zeros(x) for x in (9, 2, 2, 2, 2))
    at = [ctypes.c_void_p(x.ctypes.data) for x in (state, zero, zero)]
    assert law.law_init(ctypes.byref(parameters), *at) == 0
    np.testing.assert_array_equal(state, [0, 1, 2, 3, 4, 0, 0, 0, 0])
    torque = ctypes.c_void_p(tau.ctypes.data)
    status = law.law_step(ctypes.byref(parameters), at[0], ctypes.c_double(0.0), *at[1:], torque)
    np.testing.assert_array_equal(state, np.arange(9))
    np.testing.assert_array_equal(tau, [3, 4])
    assert status == 2 | 8
    sides = [ctypes.c_void_p(x.ctypes.data) for x in (lower, upper)]
    law.law_bounds(ctypes.byref(parameters), ctypes.c_double(0.0), *sides)
    np.testing.assert_array_equal([lower, upper], [[0, 1], [2, 3]])


def bounds_of_c(folder, size, t, *reference):
    library = compiled(folder, "iblf_law")
    lower, upper = (np.empty(size) for _ in range(2))
    pointers = [np.ascontiguousarray(x, float) for x in (*reference, lower, upper)]
    pointers[-2:] = lower, upper
    defaults = ctypes.c_char.in_dll(library, "iblf_law_defaults")
    arguments = [ctypes.c_void_p(x.ctypes.data) for x in pointers]
    library.iblf_law_bounds.restype = None
    library.iblf_law_bounds(ctypes.byref(defaults), ctypes.c_double(t), *arguments)
    return lower, upper


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "reference"),
    [("motor_driven_pendulum", "inside"), ("zhang_yan_2024_funnel", "given")],
)
def test_bounds_are_a_function_of_time_and_reference(name, reference, tmp_path):
    scenario = ij.with_parts(getattr(ij.presets, name)(), sampling=ij.Sampling(0.01))
    ij.export(scenario, tmp_path, reference=reference)
    scenario = canonical(scenario)
    inputs, given = inputs_at_start(scenario)._replace(t=jnp.asarray(0.7)), []
    if reference == "given":
        given = [np.array(x) for x in ([0.3, 0.4], [0.1, -0.2], [0.0, 0.5])]
        q_d, dq_d, ddq_d = map(jnp.asarray, given)
        inputs = inputs._replace(q_d=q_d, dq_d=dq_d, ddq_d=ddq_d)
    expected = np.asarray(jax.jit(bounds_at)(scenario, inputs))
    np.testing.assert_allclose(bounds_of_c(tmp_path, scenario.n, 0.7, *given), expected, rtol=1e-12)
    if given:
        moved = bounds_of_c(tmp_path, scenario.n, 0.7, given[0] + 0.1, *given[1:])
        np.testing.assert_allclose(moved, expected + 0.1, rtol=1e-12)
