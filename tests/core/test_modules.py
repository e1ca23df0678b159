"""Networks of Equinox and Flax NNX, and plain pytrees, as fields of components."""

import dataclasses
import functools
import pickle
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from module_cases import Learned

import iblf_jax as ij
from iblf_jax.core import modules
from iblf_jax.studies.store_config import describe_component, structure

FEW = {"duration": 0.05, "dt": 1e-3}
"""A run whose length does not matter; so few steps of a run and of a batch are one kernel."""


@ij.component
class Plain:
    """The same with the weights of layers in a dict."""

    net: Any

    def torque(self, t, q, dq, plant, model):
        hidden, net = jnp.concatenate([q, dq]), self.net
        for (weight, bias), activation in zip(net["layers"], net["activations"], strict=True):
            hidden = activation(weight @ hidden + bias)
        return net["out"] @ hidden

    def jump_times(self):
        return jnp.zeros(0)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Layer:
    weight: Any
    scale: int = dataclasses.field(default=2, metadata={"static": True})

    def __call__(self, x):
        return self.scale * jnp.tanh(self.weight @ x)


def mlp(seed=0, activation=jnp.tanh, size=4, width=3):
    return eqx.nn.MLP(size, 2, width, 1, activation=activation, key=jax.random.key(seed))


def weights_of(seed=0, *activations):
    rng = np.random.default_rng(seed)
    layers = [[rng.normal(size=(4, 4)), rng.normal(size=4)] for _ in activations]
    return {"layers": layers, "activations": activations, "out": 0.1 * rng.normal(size=(2, 4))}


@pytest.fixture(scope="module")
def scenario(paper):
    return ij.with_parts(paper, disturbance=Learned(mlp()))


def paths_below(part):
    return [p.path for p in ij.parameters(part)]


def refuse(scenario, *paths):
    for path in paths:
        with pytest.raises(ValueError, match="the path of a leaf"):
            ij.with_parameters(scenario, {f"disturbance.{path}": 1.0})


def test_arrays_are_leaves_with_paths_and_the_rest_is_structure(scenario):
    net = scenario.disturbance.net
    assert isinstance(net, eqx.nn.MLP) and net.activation is jnp.tanh
    assert paths_below(scenario.disturbance) == [
        f"net.layers[{i}].{name}" for i in (0, 1) for name in ("weight", "bias")
    ]
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves(scenario))
    plain = Plain(weights_of(0, jnp.tanh))
    assert paths_below(plain) == ["net[layers][0][0]", "net[layers][0][1]", "net[out]"]
    assert paths_below(Learned(Layer(np.ones((2, 4))))) == ["net.weight"]
    assert paths_below(Learned((np.ones((2, 4)), [np.ones(3)]))) == ["net[0]", "net[1][0]"]
    assert paths_below(Learned({"a b": [[1.0, 2.0]], "[": 3.0})) == ['net["["]', "net[a b]"]


def test_a_path_changes_one_number_and_keeps_the_structure(scenario):
    path = "disturbance.net.layers[0].weight[1][2]"
    changed = ij.with_parameters(scenario, {path: 0.25})
    before, after = (s.disturbance.net.layers[0].weight for s in (scenario, changed))
    assert np.array_equal(after, before.at[1, 2].set(0.25))
    assert jax.tree.structure(changed) == jax.tree.structure(scenario)
    assert changed.disturbance.net.activation is jnp.tanh
    refuse(scenario, "net.layers[2].bias", "net.activation", "net.in_size", "net.layers[0]")
    plain = ij.with_parts(scenario, disturbance=Plain(weights_of(0, jnp.tanh)))
    new = ij.with_parameters(plain, {"disturbance.net[layers][0][1][3]": 7.0})
    assert new.disturbance.net["layers"][0][1][3] == 7.0
    assert isinstance(new.disturbance.net["layers"], list)


class Weights(NamedTuple):
    w: Any
    b: Any


def test_a_negative_index_and_a_name_of_a_tuple_lead_to_an_entry(paper):
    module = [np.ones(2), [np.ones(3)], Weights(np.ones(2), np.ones(1))]
    scenario = ij.with_parts(paper, disturbance=Learned(module))
    assert paths_below(scenario.disturbance)[-2:] == ["net[2].w", "net[2].b"]
    for path, found in {
        "net[-3][-1]": lambda net: net[0][1],
        "net[-2][-1]": lambda net: net[1][0][0],
        "net[-1].w": lambda net: net[2].w[0],
    }.items():
        changed = ij.with_parameters(scenario, {f"disturbance.{path}": 7.0})
        assert found(changed.disturbance.net) == 7.0
    refuse(scenario, "net[-4]", "net[3]", "net[2][0]", "net[2].c")


def test_programs_are_found_by_structure(scenario):
    traces = []

    @jax.jit
    def torque(s):
        traces.append(1)
        return s.disturbance.torque(0.0, s.initial.q, s.initial.dq, s.plant, s.model)

    for seed in range(3):
        torque(ij.with_parts(scenario, disturbance=Learned(mlp(seed))))
    assert len(traces) == 1
    torque(ij.with_parts(scenario, disturbance=Learned(mlp(activation=jax.nn.relu))))
    assert len(traces) == 2
    # 1, 1.0 and True are equal, but not the same structure.
    nodes = [jax.tree.structure(modules.Structure(x)) for x in (1, 1.0, True)]
    assert len({*nodes}) == 3


@pytest.mark.slow
def test_the_torque_of_a_run_is_that_of_numpy(scenario):
    run = ij.simulate(scenario, **FEW)
    first, last = scenario.disturbance.net.layers
    for k in (0, 7, len(run.t) - 1):
        hidden = np.tanh(first.weight @ np.concatenate([run.q[k], run.dq[k]]) + first.bias)
        expected = last.weight @ hidden + last.bias
        assert np.allclose(run.disturbance[k], expected, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_compiled_batch_over_weights_is_its_single_runs(paper):
    deep = ij.with_parts(paper, disturbance=Plain(weights_of(1, jnp.tanh)))
    spread = {"disturbance.net[layers][0][0]": ij.factor(ij.uniform(0.5, 1.5))}
    batch = ij.monte_carlo(deep, spread, runs=3, seed=2, **FEW)
    assert len({*np.asarray(batch.metrics.rmse)[:, 0].tolist()}) == 3
    again = batch.replay(1)
    assert np.allclose(again.metrics.rmse, batch.metrics.rmse[1], rtol=1e-10, atol=0)
    first = [x.disturbance.net["layers"][0][0] for x in (again.scenario, deep)]
    assert not np.array_equal(*first)


@pytest.mark.slow
def test_gradient_by_a_weight_and_single_precision(scenario):
    start = scenario.disturbance.net.layers[1].bias

    def position(bias):
        changed = ij.with_parameters(scenario, {"disturbance.net.layers[1].bias": bias})
        return ij.simulate(changed, **FEW).q[-1, 0]

    slope = jax.grad(position)(start)
    step = jnp.asarray([1e-4, 0.0])
    difference = (position(start + step) - position(start - step)) / 2e-4
    assert np.isclose(slope[0], difference, rtol=1e-6)
    single = ij.simulate(ij.astype(scenario, "float32"), **FEW)
    assert single.q.dtype == jnp.float32
    assert np.allclose(single.q, ij.simulate(scenario, **FEW).q, atol=1e-5)


def test_stores_describe_modules_without_addresses(scenario):
    leaky = Learned(mlp(activation=functools.partial(jax.nn.leaky_relu, negative_slope=0.3)))
    for describe in (describe_component, structure):
        text, of_leaky = str(describe(scenario.disturbance)), str(describe(leaky))
        assert "0x" not in text + of_leaky and "tanh" in text
        assert text == str(describe(Learned(mlp())))
        assert "leaky_relu" in of_leaky and "0.3" in of_leaky
    assert "relu" in str(structure(Learned(mlp(activation=jax.nn.relu))))


def test_tables_show_a_large_module_as_one_row(paper):
    deep = eqx.nn.MLP(4, 2, 16, 7, key=jax.random.key(0))
    table = ij.parameters(ij.with_parts(paper, disturbance=Learned(deep)))
    rows = [row for row in repr(table).splitlines() if "disturbance" in row]
    numbers = sum(x.size for x in jax.tree.leaves(eqx.filter(deep, eqx.is_array)))
    assert len(rows) == 1 and f"16 arrays, {numbers} numbers" in rows[0]
    assert sum("disturbance" in p.path for p in table) == 16
    small = repr(ij.parameters(Learned(mlp(width=16))))
    assert "64 numbers from" in small


class Unregistered:
    """A network that JAX does not know."""

    def __init__(self):
        self.weight = jnp.ones((2, 4))

    def __call__(self, x):
        return self.weight @ x


def test_what_is_no_module_is_refused_by_name():
    for value, words in (
        ({"net": Unregistered()}, "register_dataclass"),
        ({"f": functools.partial(jnp.add, jnp.ones(2))}, "register_dataclass"),
        ({"w": np.ones(2), "set": {1, 2}}, "hashable"),
        ({"w": np.ones(2) * 1j}, "real numbers"),
        ({"w": np.ones(2), "key": jax.random.key(0)}, "random state"),
        ({"w": {1: np.ones(2)}}, "strings"),
    ):
        with pytest.raises(ValueError, match=words) as caught:
            Learned(value)
        assert str(caught.value).startswith("Learned.net")


def test_a_run_refuses_a_field_with_its_path(paper):
    not_finite = eqx.tree_at(lambda n: n.layers[0].bias, mlp(), jnp.full(3, jnp.nan))
    for value, words in (
        (Unregistered(), r": .*register_dataclass"),
        (lambda x: x, r": .*register_dataclass"),
        (not_finite, r"\.layers\[0\]\.bias: .*finite"),
    ):
        with pytest.raises(ValueError, match=rf"disturbance\.net{words}"):
            ij.simulate(ij.with_parts(paper, disturbance=Learned(value)), **FEW)


def test_arrays_of_integers_are_structure():
    part = Learned({"w": np.ones(3), "order": np.array([2, 0, 1])})
    assert paths_below(part) == ["net[w]"]
    again = jax.tree.map(lambda x: 2.0 * x, part)
    assert np.array_equal(again.net["order"], [2, 0, 1]) and again.net["w"][0] == 2.0
    other = Learned({"w": np.ones(3), "order": np.array([2, 1, 0])})
    assert jax.tree.structure(part) != jax.tree.structure(other)


def test_components_with_modules_are_copied_by_pickle(scenario):
    division = scenario.disturbance._divisions[0][1]
    again = pickle.loads(pickle.dumps(division))
    assert again == division and hash(again) == hash(division)
