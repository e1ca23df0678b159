"""`check_plant` names what is wrong with a broken plant."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import pytest

import iblf_jax as ij
from iblf_jax import plants
from iblf_jax.testing import ContractError, check_plant

PENDULUM = ij.presets.motor_driven_pendulum().plant


def drift(t, x):
    return jnp.stack([jnp.cos(x[0]), x[0] * x[1]])


def gain(t, x):
    return jnp.stack([jnp.ones_like(x[0]), 2.0 + x[0] ** 2])


def plant_of(drift=drift, gain=gain, **others):
    return plants.StrictFeedback(drift=drift, gain=gain, **({"n": 1, "order": 2} | others))


def altered(**members):
    fields = [(field.name, field.type, field) for field in dataclasses.fields(PENDULUM)]
    namespace = dict(vars(type(PENDULUM))) | members
    for name in ("__dict__", "__weakref__", "__init__"):
        namespace.pop(name, None)
    cls = type("Altered", (), {"__annotations__": {name: "Leaf" for name, _, _ in fields}})
    for name, value in namespace.items():
        if not name.startswith("__"):
            setattr(cls, name, value)
    for name, _, _ in fields:
        setattr(cls, name, ij.leaf("1"))
    values = {name: getattr(PENDULUM, name) for name, _, _ in fields}
    return ij.component(cls)(**values)


@pytest.mark.slow
def test_an_altered_copy_fits_where_nothing_is_altered():
    check_plant(altered())


BROKEN = {
    "StrictFeedback.drift(t, x): got row 0 that depends on x[1] | row 0 of the gain": lambda: (
        plant_of(drift=lambda t, x: jnp.stack([x[1], x[0]]))
    ),
    "row 1 of gain(t, x) is not finite at x = [ | check_plant(plant, x=": lambda: plant_of(
        gain=lambda t, x: jnp.stack([x[0] ** 0, jnp.sqrt(x[1] - 1.0)])
    ),
    "(1,). All rows of jnp.stack must have one shape: write 0.0 * x[0]": lambda: plant_of(
        drift=lambda t, x: jnp.stack([0.0, x[1]])
    ),
    "row 1 of gain(t, x) is singular": lambda: plant_of(
        gain=lambda t, x: jnp.stack([x[0] ** 0, 0.0 * x[0]])
    ),
    "row 0 of gain(t, x) is singular": lambda: plant_of(
        drift=lambda t, x: -x, gain=lambda t, x: jnp.ones((2, 2, 2), x.dtype), n=2
    ),
    "drift(t, x) | has shape (1,) | It must be (2, 1)": lambda: plant_of(drift=lambda t, x: x[0]),
    "gain(t, x) | has shape (1, 1) | (2, 1) for diagonal gains": lambda: plant_of(
        gain=lambda t, x: jnp.ones((1, 1), x.dtype)
    ),
    "not finite": lambda: plant_of(drift=lambda t, x: jnp.stack([jnp.sqrt(x[0] - x[0]), x[1]])),
    "level_rate is not f_i + G_i x_{i+1}": lambda: altered(
        level_rate=lambda self, level, t, x, above, torque: above
    ),
    "level_input is not the inverse": lambda: altered(
        level_input=lambda self, level, t, x, rate, torque: rate
    ),
    "transposed_gain is not G_i^T s": lambda: altered(
        transposed_gain=lambda self, level, t, x, s: 2.0 * s
    ),
    "do not hold the plant at q": lambda: altered(steady_input=lambda self, q: 1.0 + 0.0 * q),
    "weights has negative entries": lambda: altered(weights=lambda self, x: -jnp.ones_like(x)),
    "level_names | expected a tuple of 3 texts": lambda: altered(level_names=("angle", "speed")),
    "4 units": lambda: altered(units=("rad", "rad/s", "V")),
}


@pytest.mark.parametrize(("words", "make"), BROKEN.items(), ids=list(BROKEN))
def test_broken_plants(words, make):
    with jax.numpy_dtype_promotion("standard"), pytest.raises(ContractError) as caught:
        check_plant(make())
    for word in words.split(" | "):
        assert word in str(caught.value)


@pytest.mark.slow
def test_states_may_be_given_for_a_plant_that_is_defined_in_a_part_of_the_space():
    tank = plant_of(drift=lambda t, x: jnp.stack([-jnp.sqrt(x[0]), -x[1]]))
    with pytest.raises(ContractError, match="not finite"):
        check_plant(tank)
    check_plant(tank, x=[[[0.5], [0.1]], [[2.0], [-0.3]]])
    with pytest.raises(ValueError, match=r"x: got .* shape \(m, 2, 1\)"):
        check_plant(tank, x=[[0.5, 0.1]])
