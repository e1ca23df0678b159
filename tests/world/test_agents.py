"""Agents on a graph against an independent program, limits, and what is refused."""

import independent_agents as other
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refused import refused

import iblf_jax as ij
from iblf_jax import bounds, controllers, plants, references
from iblf_jax.core import sparse
from iblf_jax.simulation.scenario import canonical


def pendulum(i: int) -> ij.robots.PlanarChain:
    rows = (other.MASS, other.LENGTH, other.CENTRE, other.INERTIA)
    return ij.robots.PlanarChain(*([row[i]] for row in rows), g=other.G)


def as_rows(matrix):
    return tuple(tuple(row) for row in np.asarray(matrix).tolist())


STACK = plants.Agents(
    agents=tuple(pendulum(i) for i in range(4)),
    adjacency=as_rows(other.ADJACENCY),
    leader=tuple(other.LEADER.tolist()),
)
MOTION = references.Sinusoid(other.OFFSET, other.AMPLITUDE, other.FREQUENCY)
TUBE = ij.Bounds(*(bounds.Funnel(s * other.WIDE, s * other.NARROW, other.RATE) for s in (-1, 1)))


def law(**fields):
    given = {"k": [other.K1, other.K2], "weights": [other.W1, other.W2]}
    return controllers.BarrierBackstepping(**(given | fields))


def scenario(distributed: bool = False, **parts) -> ij.Scenario:
    given = {
        "plant": STACK,
        "model": STACK.neighbours() if distributed else STACK,
        "reference": STACK.reference(MOTION),
        "bounds": TUBE,
        "controller": law(filter=other.MU[None]) if distributed else law(),
        "initial": ij.Initial(q=STACK.relative_positions(other.P0[:, None]), dq=np.zeros(4)),
    }
    return ij.Scenario(**(given | parts))


@pytest.mark.slow
@pytest.mark.parametrize("distributed", [False, True])
def test_vector_field_of_the_independent_program(distributed, rng):
    field, points = ij.vector_field(scenario(distributed)), 20
    t = rng.uniform(0.0, 1.0, points)
    e = rng.uniform(-0.2, 0.2, (points, 4))
    x_0 = other.OFFSET + other.AMPLITUDE * np.sin(other.FREQUENCY * t)
    rest = rng.normal(size=(points, 8 if distributed else 4))
    states = np.concatenate([other.LEADER * x_0[:, None] + e, rest], axis=1)
    found = jax.jit(jax.vmap(field))(jnp.asarray(t), jnp.asarray(states))
    for i in range(points):
        expected = other.field(t[i], states[i], distributed)
        np.testing.assert_allclose(found[i], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_agents_of_order_four_and_two_joints_follow_the_leader():
    """Flexible joints: the start with given positions is the springs' equilibrium of each agent."""
    arm = ij.presets.customary_two_link()
    agents = [
        plants.FlexibleJoint(arm, stiffness=stiffness, motor_inertia=0.02, motor_damping=0.5)
        for stiffness in (200.0, 300.0)
    ]
    stack = plants.Agents(agents=agents, adjacency=((0, 0), (1, 0)), leader=(1, 0))
    p = np.array([[0.5, 0.6], [0.4, 0.5]])
    y = stack.relative_positions(p)
    np.testing.assert_allclose(y, [0.5, 0.6, -0.1, -0.1], atol=1e-15)
    np.testing.assert_allclose(stack.positions(y), p, atol=1e-15)
    steady, rest = stack.steady_levels(y, jnp.zeros(4)), jnp.zeros(4)
    flow = plants.flow(stack, 0.0, jnp.stack([y, rest, *steady]), stack.steady_input(y))
    np.testing.assert_allclose(flow, 0.0, atol=1e-10)
    offsets = np.array([[0.0, 0.0], [0.1, -0.1]])
    reference = stack.reference(references.Sinusoid(offset=[0.5, 0.6], amplitude=0.0), offsets)
    expected = stack.relative_positions(np.array([0.5, 0.6]) + offsets)
    np.testing.assert_allclose(reference.position(jnp.asarray(0.3)), expected, atol=1e-15)
    assert stack.component_names[2] == "agent 2: joint 0"
    assert stack.units == ("rad", "rad/s", "rad", "rad/s", "N m")


@pytest.mark.slow
def test_friction_of_the_agents_robots_acts_on_the_plant(rng):
    """The friction of each agent enters its own acceleration, which no law knows."""
    damping = [0.3, 0.5]
    robots = [ij.robots.WithMotors(pendulum(i), inertia=0.0, damping=damping[i]) for i in (0, 1)]
    adjacency = ((0, 0), (1, 0))
    parts = {"bounds": TUBE, "controller": controllers.BarrierBackstepping(k=(2.0, 20.0))}

    def acceleration(pair):
        stack = plants.Agents(agents=pair, adjacency=adjacency, leader=(1, 0))
        own = {"reference": stack.reference(MOTION), "initial": ij.Initial(q=[0.25, 0.05], dq=0.0)}
        field = ij.vector_field(ij.Scenario(plant=stack, **own, **parts))
        return field(0.1, jnp.asarray([0.25, 0.05, 0.4, -0.6]))[2:]

    difference = acceleration(robots) - acceleration([pendulum(0), pendulum(1)])
    expected = -np.asarray(damping) * [0.4, -0.6] / other.M[:2]
    np.testing.assert_allclose(difference, expected, rtol=1e-10)


@pytest.mark.release
@pytest.mark.parametrize("distributed", [False, True])
def test_the_certificate_of_the_levels_holds(distributed):
    """With filters the equality (S.3) contains their lag, which the certificate reports."""
    found = ij.certify(scenario(distributed), duration=1.0, dt=1e-3)
    assert found.holds and found["equality"].verdict == "holds"
    if distributed:
        assert any("ultimate boundedness" in note for note in repr(found).splitlines())


def test_a_sparse_solution_is_that_of_numpy(rng):
    adjacency = np.where(rng.uniform(size=(7, 7)) < 0.4, rng.uniform(size=(7, 7)), 0.0)
    np.fill_diagonal(adjacency, 0.0)
    H = np.diag(adjacency.sum(axis=1) + rng.uniform(0.1, 1.0, 7)) - adjacency
    b = rng.normal(size=(7, 2))
    found = sparse.solve(as_rows(H), list(b))
    np.testing.assert_allclose(found, np.linalg.solve(H, b), rtol=1e-12)


PAIR = (pendulum(0), pendulum(1))


def agents(adjacency=((0, 0), (1, 0)), leader=(1, 0), agents=PAIR):
    return plants.Agents(agents=agents, adjacency=adjacency, leader=leader)


test_refused_with_a_remedy = pytest.mark.slow(
    refused(
        (
            lambda: agents(((0, 0), (0, 0))),
            r"no path from the leader to agent 2.*adjacency\[i\]\[j\] > 0 is a path",
        ),
        (lambda: agents(((1, 0), (1, 0))), "a zero diagonal"),
        (lambda: agents(((0, 0), (-1, 0))), r"Agents\.adjacency.*numbers >= 0"),
        (
            lambda: agents(agents=(PAIR[0], ij.presets.customary_two_link())),
            r"Agents\.agents\[1\]\.n: got 2, expected 1",
        ),
        (lambda: agents(((0,),), (1,), ("arm",)), "a plant or a robot"),
        (
            lambda: references.Leader(motion=MOTION, weights=(1.0, -1.0), components=1),
            r"Leader\.weights.*finite numbers >= 0",
        ),
        (
            lambda: canonical(scenario(model=STACK.neighbours())),
            r"controller\.filter.*filter=0\.01",
        ),
        (
            lambda: canonical(scenario(True, plant=STACK.neighbours())),
            r"row 0 that depends on x\[1\]",
        ),
    )
)
