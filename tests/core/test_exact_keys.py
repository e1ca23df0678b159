"""Keys of structures: two values that can make two programs have two keys."""

import dataclasses
import functools
import pickle
from decimal import Decimal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from proof_cases import pendulum

import iblf_jax as ij
from iblf_jax.core.exact_keys import behaviour_of, exact_key
from iblf_jax.simulation.closed_loop import evaluate, initial_state

FACTOR = 2.0
Axis = type("Axis", (str,), {"__module__": __name__})


@dataclasses.dataclass(frozen=True)
class Settings:
    """A static value of a user."""

    size: float


TABLE = np.array([0.0, 1.0])


def from_a_global(x):
    return FACTOR * x


def from_a_table(x):
    return TABLE[0] * x


def of_another_function(x):
    return from_a_global(x)


def capturing(value):
    return lambda x: value * x


STRUCTURED = [np.dtype([("a", kind), ("b", "i4")]) for kind in ("i4", "f4")]


DIFFERENT = (
    (1, 1.0, True, "1", np.int64(1), np.float32(1.0), np.float64(1.0)),
    (0.0, -0.0, 0j, complex(-0.0, 0.0), Decimal("0"), Decimal("-0"), Settings(0.0), Settings(-0.0)),
    ((1, (2, 0.0)), (1, (2, -0.0))),
    ((), None),
    (functools.partial(max, 1), functools.partial(max, 1.0)),
    (frozenset({1}), frozenset({1.0})),
    (np.zeros(1, jnp.int4), np.zeros(1, jnp.uint4)),
    tuple(np.zeros((), kind) for kind in STRUCTURED),
    (
        functools.partial(max, 1, key=abs),
        functools.partial(min, 1, key=abs),
        functools.partial(max, 2, key=abs),
        functools.partial(max, 1, key=hash),
        functools.partial(max, 1, default=abs),
        functools.partial(max, 1),
    ),
    (np.zeros((1, 2)), np.zeros((2, 1)), np.zeros((1, 2), int), np.array([[0.0, 1.0]])),
    (1 + 2j, 2 + 2j, 1 + 3j),
    ((1, 2), (2, 1), (1, 3), (1, 2, 3), [(1, 2)]),
    (Settings(1.0), Settings(2.0), Settings(functools.partial(max, key=abs))),
)
"""Values that are equal and of two kinds, or that differ in one part each."""


@pytest.mark.parametrize("values", DIFFERENT)
def test_kind_and_each_part_of_a_value_are_part_of_its_key(values):
    assert len({exact_key(value) for value in values}) == len(values)


@pytest.mark.parametrize(
    "value", [1, 0.0, "a", (1, (2.0, "b")), None, float, np.dtype("int32"), Axis("x")]
)
def test_a_value_has_one_key(value):
    copy = pickle.loads(pickle.dumps(value))
    assert exact_key(value) == exact_key(copy)
    assert hash(exact_key(value)) == hash(exact_key(copy))


def as_jax_names_it(x):
    return FACTOR * x


functools.update_wrapper(as_jax_names_it, jnp.sin)
VECTORISED = jax.vmap(from_a_global)
SLOPE = jax.grad(of_another_function)


def of_a_transformed_function(x):
    return VECTORISED(x)


@pytest.mark.parametrize(
    "function",
    [
        from_a_global,
        of_another_function,
        VECTORISED,
        SLOPE,
        of_a_transformed_function,
        functools.partial(from_a_global, 1.0),
    ],
)
def test_a_global_variable_of_a_function_is_part_of_its_key(function, monkeypatch):
    before = exact_key(function)
    assert exact_key(function) == before
    monkeypatch.setitem(globals(), "FACTOR", 3.0)
    assert exact_key(function) != before


def test_an_array_that_changes_in_place_changes_the_key(monkeypatch):
    monkeypatch.setitem(globals(), "TABLE", np.array([0.0, 1.0]))
    captured = np.ones(3)
    functions = from_a_table, capturing(captured)
    before = [exact_key(f) for f in functions]
    TABLE[0] = 5.0
    captured[1] = 5.0
    assert not any(exact_key(f) == key for f, key in zip(functions, before, strict=True))


def test_what_a_closure_captures_is_part_of_its_key():
    value = 1.0

    def scaled(x):
        return value * x

    before = exact_key(scaled)
    value = 2.0
    assert exact_key(scaled) != before


def test_rules_of_differentiation_are_followed_a_second_one_and_those_of_defjvps_too():
    @jax.custom_jvp
    def square(x):
        return x * x

    def user(x):
        return square(x)

    keys = set()
    for factor in (2.0, 3.0):

        @square.defjvp
        def rule(primals, tangents, factor=factor):
            return square(*primals), factor * primals[0] * tangents[0]

        keys.add(exact_key(user))
    assert len(keys) == 2
    factor = 2.0

    @jax.custom_jvp
    def double(x):
        return 2.0 * x

    double.defjvps(lambda t, answer, x: factor * t)
    before = exact_key(double)
    factor = 3.0
    assert exact_key(double) != before


def test_functions_that_call_each_other_have_a_key():
    """Each is described once: the number of paths to the first one of a chain is that of
    Fibonacci."""
    chain = [lambda x: x, lambda x: x]
    for _ in range(60):
        chain.append(lambda x, f=chain[-1], g=chain[-2]: f(x) + g(x))
    assert exact_key(chain[-1]) == exact_key(chain[-1])

    def even(n):
        return n == 0 or odd(n - 1)

    def odd(n):
        return n != 0 and even(n - 1)

    assert exact_key(even) == exact_key(even)
    assert exact_key(even) != exact_key(odd)


@ij.component
class Push:
    """A constant torque, by a factor that is structure."""

    factor: object = ij.static(default=1.0)

    def torque(self, t, q, dq, plant, model):
        if isinstance(self.factor, bool):
            return jnp.full_like(q, 7.0)
        if isinstance(self.factor, int):
            return jnp.full_like(q, 5.0)
        return jnp.full_like(q, float(np.copysign(3.0, self.factor)))

    def jump_times(self):
        return jnp.zeros(0)


def pushed(factor):
    """A loop with this disturbance that compiles quickly."""
    law = ij.controllers.PDGravity(Kp=60.0, Kd=20.0)
    none = ij.observers.NoObserver()
    return pendulum(disturbance=Push(factor=factor), controller=law, observer=none)


def torque_at_start(factor):
    scenario = pushed(factor)
    _, sample = evaluate(scenario, jnp.zeros(()), initial_state(scenario))
    return float(sample.disturbance[0])


def test_each_value_of_a_static_field_has_its_own_program():
    found = {value: [] for value in ("1.0", "1", "True", "0.0", "-0.0")}
    for value in (*found, *reversed(found)):
        found[value].append(torque_at_start(eval(value)))
    base = found["1.0"][0] - 3.0
    expected = {"1.0": 3.0, "1": 5.0, "True": 7.0, "0.0": 3.0, "-0.0": -3.0}
    first = {value: one for value, (one, _) in found.items()}
    assert first == pytest.approx({value: base + x for value, x in expected.items()})
    assert all(one == other for one, other in found.values())


def test_runs_with_equal_values_of_two_kinds_are_two_programs():
    runs = [
        ij.simulate(
            pushed(factor), duration=1e-3, dt=1e-3, method="euler", metrics=(), backend="vmap"
        )
        for factor in (1.0, 1, 1.0)
    ]
    first, other, again = (float(run.disturbance[0, 0]) for run in runs)
    assert first == again
    assert other == pytest.approx(first + 2.0)


def test_the_members_of_a_class_are_part_of_its_behaviour(monkeypatch):
    class Own:
        size = 1.0

        @functools.cached_property
        def kept(self):
            return FACTOR

        @property
        def computed(self):
            return TABLE[0]

    before = behaviour_of(Own)
    assert behaviour_of(Own) == before
    keys = {before}
    monkeypatch.setitem(globals(), "FACTOR", 9.0)
    keys.add(behaviour_of(Own))
    monkeypatch.setitem(globals(), "TABLE", np.ones(2))
    keys.add(behaviour_of(Own))
    Own.size = 2.0
    keys.add(behaviour_of(Own))
    Own.computed = lambda self: self.size
    keys.add(behaviour_of(Own))
    assert len(keys) == 5
    assert behaviour_of(type(ij.barriers.Log())) is None


def test_a_component_has_no_attributes_but_its_fields(paper):
    again = jax.tree.map(lambda x: x, paper)
    for part in (paper, again, paper.controller, again.plant, Push(factor=2)):
        assert set(vars(part)) == {field.name for field in dataclasses.fields(part)}


def test_a_component_with_functions_is_pickled():
    plant = ij.plants.StrictFeedback(drift=from_a_global, gain=from_a_table, n=1, order=2)
    for part in (plant, Push(factor=2)):
        copy = pickle.loads(pickle.dumps(part))
        assert jax.tree.structure(copy) == jax.tree.structure(part)
    assert jax.tree.structure(Push(factor=2)) != jax.tree.structure(Push(factor=2.0))
