"""`with_parts`: a scenario with whole parts exchanged by name."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from members import DISTURBANCES, LAWS, OBSERVERS, REFERENCES, ROBOTS, SIDES
from refused import assert_refused

import iblf_jax as ij

HEAVY = ij.robots.TwoLink(mass=[5.0, 5.0], length=[0.3, 0.3], centre=[0.1, 0.1], inertia=0.02)
CHAIN = ROBOTS["chain_3"]
WIDE = ij.bounds.Bounds(lower=ij.bounds.Constant(-4.0), upper=ij.bounds.Constant(4.0))


def same(a, b) -> bool:
    equal = map(np.array_equal, jax.tree.leaves(a), jax.tree.leaves(b))
    return jax.tree.structure(a) == jax.tree.structure(b) and all(equal)


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("controller", LAWS["saturated"]),
        ("observer", OBSERVERS["extended_state"]),
        ("disturbance", DISTURBANCES["sum"]),
        ("reference", REFERENCES["waypoint_spline"]),
        ("bounds", ij.bounds.Bounds(lower=SIDES["constant"], upper=SIDES["funnel"])),
        ("initial", ij.Initial(q=[0.7, 0.6], dq=0.1)),
        ("plant", ROBOTS["two_link_payload"]),
        ("model", HEAVY),
    ],
)
def test_one_part_is_exchanged_and_no_other(paper, name, part):
    new = ij.with_parts(paper, **{name: part})
    fitted = dataclasses.replace(paper, **{name: part})
    for field in dataclasses.fields(ij.Scenario):
        expected = fitted if field.name == name else paper
        assert same(getattr(new, field.name), getattr(expected, field.name)), field.name
    assert same(paper, ij.presets.zhang_yan_2024())


def test_plant_alone_leaves_the_model_and_robot_takes_both(paper):
    other = ij.with_parts(paper, plant=HEAVY)
    assert same(other.model, paper.model)
    assert np.array_equal(other.plant.mass, [5.0, 5.0])
    both = ij.with_parts(paper, robot=HEAVY)
    assert both.model is both.plant
    assert same(ij.with_parts(other, model=None).model, HEAVY), "model=None is the plant itself"
    surroundings = {
        "reference": ij.references.Sinusoid(offset=0.0, amplitude=0.1),
        "bounds": WIDE,
        "controller": ij.controllers.PDGravity(Kp=40.0, Kd=10.0),
        "observer": ij.observers.NoObserver(),
        "disturbance": ij.disturbances.Nothing(),
        "initial": ij.Initial(q=0.1),
    }
    made = ij.with_parts(paper, robot=CHAIN, **surroundings)
    assert made.n == 3
    assert made.controller.Kp.shape == (3,)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"law": LAWS["pd_gravity"]}, "part: got 'law', expected the name of a part: robot, plant"),
        ({"controller": OBSERVERS["momentum"]}, "Scenario.controller: got .* fits .*RobotLaw"),
        ({"observer": None}, "Scenario.observer: got None"),
        ({"observer": ij.observers.NoObserver}, "It is a class: make an instance"),
        ({"bounds": (0.1, 0.9)}, "Scenario.bounds: .* expected a Bounds"),
        ({"initial": [0.8, 0.8]}, "Scenario.initial: .* expected an Initial"),
        ({"robot": None}, "Scenario.plant: got None"),
        ({"robot": HEAVY, "model": HEAVY}, "either robot, or plant and model"),
        ({"plant": CHAIN}, "plant: got '3 joints', expected 2 joints, as the model has.*robot="),
        ({"robot": CHAIN}, r"reference\.offset: got .* one number, or 3"),
    ],
)
def test_what_is_refused(paper, parts, words):
    assert_refused(words, ij.with_parts, paper, **parts)


def test_the_scenario_is_one_and_has_the_type_of_the_numbers(paper):
    none = ij.observers.NoObserver()
    assert_refused("scenario: got 3, expected a Scenario", ij.with_parts, 3, observer=none)
    small = ij.with_parts(ij.astype(paper, "float32"), observer=ij.observers.Momentum(kf=20.0))
    assert {x.dtype for x in jax.tree.leaves(small)} == {jnp.dtype("float32")}


def test_inside_jit_and_grad(paper):
    """Parts may hold traced numbers: here tau = ... - f_hat, f_hat = eta + kf M0 q'."""
    initial = ij.Initial(q=0.8, dq=[0.3, -0.2])

    def torque(kf):
        observer = ij.observers.Momentum(kf=kf)
        field = ij.vector_field(ij.with_parts(paper, observer=observer, initial=initial))
        return field.sample(0.0, field.start).tau

    M0 = paper.model.mass_matrix(jnp.array([0.8, 0.8]))
    np.testing.assert_allclose(jax.jit(jax.jacfwd(torque))(20.0), -M0 @ initial.dq, rtol=1e-12)
