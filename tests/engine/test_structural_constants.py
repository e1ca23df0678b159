"""The mechanism that is compiled in: which zeros of an arm are left out, that every number still
counts, and that nothing hides a NaN."""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_from_jaxpr import DT, PRESET, STANDARD, carried, carry_of, numbers

import iblf_jax as ij
from iblf_jax.core.pytree import is_leaf_field
from iblf_jax.core.status import Status
from iblf_jax.engine import RunRequest, execute
from iblf_jax.engine.batch import Batch
from iblf_jax.engine.carry import Carry, Inputs, StepOptions
from iblf_jax.engine.loops import program_of
from iblf_jax.engine.structural_constants import robot_constants
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.kernels import written_out
from iblf_jax.kernels.program import Program
from iblf_jax.simulation.paths import get, with_parameters
from iblf_jax.simulation.scenario import canonical

STEP = TimeStep("euler")


@cache
def square_arm() -> ij.Scenario:
    """The paper's law on an arm of two joints with right angles about x; the model has no load."""
    half = 0.5**0.5
    arm = ij.robots.Arm(
        mass=[2.0, 1.0],
        centre=[[0.1, 0.0, 0.0], [0.0, 0.2, 0.05]],
        inertia=[[0.02, 0.03, 0.03, 0.0, 0.0, 0.0], [0.01, 0.01, 0.02, 0.0, 0.001, 0.0]],
        position=[[0.0, 0.0, 0.3], [0.4, 0.0, 0.0]],
        rotation=[(half, -half, 0.0, 0.0), (half, half, 0.0, 0.0)],
        tip_position=[0.0, 0.0, 0.25],
        tip_rotation=(half, half, 0.0, 0.0),
        payload=0.5,
    )
    model = dataclasses.replace(arm, payload=0.0)
    return canonical(dataclasses.replace(PRESET, plant=arm, model=model))


FIELDS = [f.name for f in dataclasses.fields(ij.robots.Arm) if is_leaf_field(f)]


def lowered(scenario, varied=()) -> tuple[Batch, Carry, Program]:
    """One run with what is known of its mechanism, a carry, and the program of a step."""
    leaves = {path: jnp.asarray(get(scenario, path))[None] for path in ("initial.q", *varied)}
    inputs = Inputs(scenario, STANDARD, jnp.asarray(DT), jnp.asarray(10.0))
    carries = carry_of(inputs, {"initial.q": leaves["initial.q"]}, "euler")
    batch = Batch.of(inputs, leaves, constants=robot_constants(scenario))
    return batch, carries, written_out(program_of(STEP, batch, carries).program)


@jax.jit
def by_jax(inputs, carry, index):
    return jax.tree.leaves(STEP(inputs, carry, index, StepOptions())[0])


def assert_same_step(case, lane):
    """A step of a lowered batch by its program, with these leaves of a run, is that of JAX."""
    batch, carries, program = case
    carry, leaves = jax.tree.map(lambda x: x[0], carries), batch.leaves
    values = (numbers(x) for x in (leaves.shared, lane, jax.tree.leaves(carry)))
    expected = numbers(by_jax(leaves.unflatten(leaves.shared, lane), carry, jnp.int32(3)))
    np.testing.assert_allclose(carried(program, *values, 3), expected, rtol=1e-10, atol=1e-12)


def small_numbers(like):
    """Numbers up to 0.01 that all differ."""
    return 0.01 * np.cos(1.0 + np.arange(like.size)).reshape(like.shape)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(3))
def test_every_number_of_an_arm_counts_once_it_is_changed(part):
    """Zeros, ones and equal numbers, each made a number of its own: the program is that of the new
    arms.  Some fields of the plant and some others of the model change in one program."""
    scenario, changed = square_arm(), {}
    of_plant, of_model = FIELDS[part::3], FIELDS[(part + 1) % 3 :: 3]
    for path in [*(f"plant.{x}" for x in of_plant), *(f"model.{x}" for x in of_model)]:
        before = np.asarray(get(scenario, path))
        change = np.where(np.isfinite(before), np.abs(small_numbers(before)), 0.0)
        changed[path] = jnp.asarray(before + change)
    case = lowered(with_parameters(scenario, changed))
    lane = [x[0] for x in case[0].leaves.per_run]
    assert_same_step(case, lane)


@pytest.mark.slow
@pytest.mark.parametrize("path", ["plant.axis", "model.rotation", "plant.position[0]"])
def test_what_differs_between_runs_is_never_compiled_in(path):
    """The same program for other numbers: a run beside it may have anything there."""
    case = lowered(square_arm(), (path,))
    assert_same_step(case, [x[0] + small_numbers(x[0]) for x in case[0].leaves.per_run])


def test_new_masses_gains_and_loads_compile_nothing():
    """Nor does another length; one of the plant alone, which the model's was equal to, does."""
    scenario = square_arm()
    known = robot_constants(scenario)
    changes = {"plant.mass": 1e-6, "model.mass[0]": 1.0, "plant.payload": 0.7}
    changes |= {"plant.carried.mass": 2.0, "controller.K2": 1.0, "model.armature": 1.0}
    for path, value in changes.items():
        changed = with_parameters(scenario, {path: jnp.full_like(get(scenario, path), value)})
        assert robot_constants(changed) == known, path
        assert hash(robot_constants(changed)) == hash(known)
    lengths = {f"{part}.position[1]": jnp.asarray([0.5, 0.0, 0.0]) for part in ("plant", "model")}
    one = {"plant.position[1]": lengths["plant.position[1]"]}
    assert robot_constants(with_parameters(scenario, one)) != known
    assert robot_constants(with_parameters(scenario, lengths)) == known


def test_a_right_angle_costs_no_more_in_the_model_than_in_the_plant():
    """Equal numbers of a row, of either sign, are one input, and the model's are the plant's."""
    known = robot_constants(square_arm()).numbers
    given = [x for x in known if x is not None]
    assert [x for x in given if x.sign < 0]
    assert all(known[x.same].same is None for x in given if x.same is not None)


@ij.component
class Mine(ij.robots.Arm):
    geometry: jax.Array = ij.leaf("m", shape="any", default=(1.0, 2.0))
    geometry_fields: jax.Array = ij.leaf("m", shape="any", default=(1.0, 2.0))


def test_a_robot_of_a_user_or_without_a_geometry_and_tracers_have_none():
    arm = square_arm().plant
    mine = Mine(**{f.name: getattr(arm, f.name) for f in dataclasses.fields(arm)})
    assert robot_constants(dataclasses.replace(square_arm(), plant=mine, model=mine)) is None
    assert robot_constants(canonical(PRESET)) is None

    found = []
    jax.eval_shape(lambda scenario: found.append(robot_constants(scenario)), square_arm())
    assert found == [None]


@pytest.mark.slow
def test_another_mechanism_in_the_same_process_is_another_program():
    """The zeros are in the key of the compiled program: the arm that comes second is not run with
    those of the first."""
    first = square_arm()
    centre = jnp.asarray([[0.1, 0.0, 0.0], [0.1, 0.2, 0.05]])
    second = with_parameters(first, {"plant.centre": centre})

    def metrics(scenario, backend):
        request = RunRequest(5, "euler", constants=robot_constants(scenario), backend=backend)
        found = outcome_of(scenario, run=request).metrics
        return np.concatenate([np.ravel(x).astype(float) for _, x in sorted(found.items())])

    arms = (first, second, first)
    by_kernel, by_scan = ([metrics(x, backend) for x in arms] for backend in ("native", "vmap"))
    np.testing.assert_allclose(by_kernel, by_scan, rtol=1e-10, atol=1e-12)
    assert not np.allclose(by_kernel[0], by_kernel[1], rtol=1e-6)
    np.testing.assert_array_equal(by_kernel[0], by_kernel[2])


@partial(jax.jit, static_argnames="run")
def outcome_of(scenario, *, run):
    start = {"initial.q": scenario.initial.q[None]}
    return execute.run_batch(scenario, start, STANDARD, jnp.asarray(DT), run)


@pytest.mark.release
def test_derivatives_by_the_geometry():
    """A direction moves numbers that are compiled in as zeros: their derivatives are there all the
    same."""
    scenario, dt = square_arm(), jnp.asarray(DT)
    along = {"plant.centre": np.eye(6)[[0, 2, 3]].reshape(3, 2, 3)}

    def by(backend, mechanism):
        run = RunRequest(5, "euler", constants=mechanism, backend=backend)
        tangents = partial(execute.run_batch_jvp, scenario)
        start = {"initial.q": scenario.initial.q[None]}
        return jax.jit(lambda v: tangents(v, along, STANDARD[:1], dt, run).tangents)(start)

    known, plain = by("native", robot_constants(scenario)), by("vmap", None)
    for name, expected in plain.items():
        np.testing.assert_allclose(known[name], expected, rtol=1e-9, atol=1e-12, err_msg=name)
    counts = np.abs(plain["rmse"]).max(axis=(0, 2)) > 0
    assert counts.tolist() == [True, False, True], "a height on the vertical axis is no lever"


@pytest.mark.slow
@pytest.mark.parametrize("path", ["initial.dq", "plant.position", "controller.K2"])
def test_a_run_that_is_not_finite_is_seen_to_be_so(path):
    """A product with a zero of the mechanism is left out, whatever the other factor: no run may
    look sound by it."""
    scenario = square_arm()
    value = get(scenario, path)
    for number, expected in ((value, 0), (jnp.full_like(value, jnp.nan), int(Status.NOT_FINITE))):
        # Compiled, so that nothing looks at the number.
        changed = jax.jit(lambda s, x: with_parameters(s, {path: x}))(scenario, number)
        run = RunRequest(5, "euler", constants=robot_constants(changed), backend="native")
        assert int(outcome_of(changed, run=run).status[0]) & int(Status.NOT_FINITE) == expected
