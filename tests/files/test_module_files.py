"""Scenario files with modules of other libraries: structure in the text, weights beside it."""

import subprocess

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from module_cases import Learned, NetworkObserver
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.files.identification import load_identification_file
from iblf_jax.files.scenario import from_dict, scenario_to_dict, scenario_to_toml
from iblf_jax.files.study import load_study_file
from iblf_jax.files.tuning import load_tuning_file


@jax.tree_util.register_pytree_with_keys_class
class Opaque:
    """A module whose structure a file cannot describe."""

    def __init__(self, gain):
        self.gain = gain

    def __call__(self, x):
        return self.gain @ x

    def tree_flatten_with_keys(self):
        return ((jax.tree_util.GetAttrKey("gain"), self.gain),), None

    @classmethod
    def tree_unflatten(cls, aux, children):
        return cls(*children)


@pytest.fixture(autouse=True)
def named(monkeypatch):
    monkeypatch.setitem(ij.disturbances.MEMBERS, "learned", Learned)
    monkeypatch.setitem(ij.observers.MEMBERS, "network_observer", NetworkObserver)


def mlp(seed=0, size=4, activation=jnp.tanh):
    return eqx.nn.MLP(size, 2, 3, 1, activation=activation, key=jax.random.key(seed))


def with_net(net):
    return ij.with_parts(ij.presets.zhang_yan_2024(), disturbance=Learned(net))


def same(a, b):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        np.array_equal(x, y) and x.dtype == y.dtype for x, y in pairs
    )


SAVED = {
    "equinox": lambda: mlp(activation=jax.nn.gelu),
    "dict": lambda: {"w": [np.ones((2, 4)), (np.zeros(2),)], "f": jnp.tanh, "name": "a", "k": None},
    "integers": lambda: {"w": np.ones(2), "order": np.array([1, 0])},
    "list": lambda: [np.ones((2, 4)), np.ones(2)],
}


@pytest.mark.parametrize("name", SAVED)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_saved_scenario_is_the_same(name, dtype, tmp_path):
    scenario = ij.astype(with_net(SAVED[name]()), dtype)
    ij.save_scenario(scenario, tmp_path / "a.toml")
    assert same(ij.load_scenario(tmp_path / "a.toml"), scenario)
    text = (tmp_path / "a.toml").read_text()
    assert 'weights = "a.weights.npz"' in text and "arrays" not in text
    assert "arrays" in scenario_to_toml(scenario)  # a text alone is complete


def test_the_weights_of_another_scenario_are_refused(tmp_path):
    for name, seed in {"a": 0, "b": 1}.items():
        ij.save_scenario(with_net(mlp(seed)), tmp_path / f"{name}.toml")
    (tmp_path / "b.weights.npz").rename(tmp_path / "a.weights.npz")
    weights = tmp_path / "a.weights.npz"
    for change, words in (
        (lambda: None, r"disturbance\.net\.digest: .*beside it"),
        (lambda: weights.write_bytes(b"PK no archive"), r"disturbance\.net\.weights"),
        (weights.unlink, "Nothing is there"),
    ):
        change()
        assert_refused(words, ij.load_scenario, tmp_path / "a.toml")


def test_a_module_that_a_file_cannot_describe_is_passed(tmp_path):
    scenario = with_net(Opaque(0.1 * jnp.arange(8.0).reshape(2, 4)))
    ij.save_scenario(scenario, tmp_path / "a.toml")
    given = {"disturbance.net": Opaque(jnp.zeros((2, 4)))}
    assert same(ij.load_scenario(tmp_path / "a.toml", modules=given), scenario)
    (tmp_path / "none.toml").write_text('preset = "zhang_yan_2024"\n')
    itself = r'Opaque, expected the module itself.*modules=\{"disturbance.net": module\}'
    for name, modules, words in (
        ("a", None, itself),
        ("none", given, r"modules: .*The file describes no module"),
        ("a", {"disturbance.net": Opaque(jnp.zeros((2, 3)))}, r"modules\['disturbance.net'\]"),
        ("a", {"disturbance.net": mlp()}, r"modules\['disturbance.net'\]"),
        ("a", {"disturbance.nets": mlp()}, r"Did you mean disturbance\.net"),
    ):
        assert_refused(words, ij.load_scenario, tmp_path / f"{name}.toml", modules=modules)
    # A lambda has no import path.
    scenario = with_net(mlp(activation=lambda x: jnp.tanh(2.0 * x)))
    ij.save_scenario(scenario, tmp_path / "b.toml")
    given = {"disturbance.net": scenario.disturbance.net}
    assert same(ij.load_scenario(tmp_path / "b.toml", modules=given), scenario)


RUN = "[run]\nduration = 0.1\ndt = 1e-3\n"
FILES = {
    "study": ("[study]\nruns = 2\n", lambda path, **given: load_study_file(path, "study", **given)),
    "sweep": ("[sweep]\n[grid]\n", lambda path, **given: load_study_file(path, "sweep", **given)),
    "tuning": (
        '[tune]\nparameters = ["controller.K2"]\n[[objective]]\nkind = "tracking"\n',
        load_tuning_file,
    ),
    "identification": (
        '[identify]\nlog = "log.csv"\nparameters = ["plant.mass"]\n',
        load_identification_file,
    ),
}


@pytest.mark.parametrize("kind", FILES)
def test_files_of_studies_receive_modules(kind, tmp_path):
    tables, load = FILES[kind]
    scenario = with_net(Opaque(jnp.ones((2, 4))))
    path = tmp_path / "a.toml"
    ij.save_scenario(scenario, path)
    path.write_text(path.read_text() + RUN + tables)
    assert_refused(r'modules=\{"disturbance.net": module\}', load, path)
    found = load(path, modules={"disturbance.net": Opaque(jnp.zeros((2, 4)))})
    assert same(found["scenario"] if isinstance(found, dict) else found.scenario, scenario)


def test_files_lead_to_no_function_of_python_and_import_nothing(tmp_path):
    ij.save_scenario(with_net(mlp()), tmp_path / "a.toml")
    text = (tmp_path / "a.toml").read_text()
    assert "equinox.nn:MLP" in text and "jax.nn:tanh" in text
    for path in (
        *("os:system", "builtins:eval", "json:os.system", "jax:os.system", "not_a_package:f"),
        "jax.nn:no_such_function",
    ):
        (tmp_path / "a.toml").write_text(text.replace("jax.nn:tanh", path))
        assert_refused("import path", ij.load_scenario, tmp_path / "a.toml")


BROKEN = {
    "no JSON": "{",
    "a number": "3",
    "no array": '{"dict": {"v": "array"}}',
    "no dataclass": '{"class": "jax.nn:relu", "fields": {}}',
    "other fields": '{"class": "equinox.nn:Linear", "fields": {"weight": "array"}}',
    "a constant of objects": '{"constant": [1], "dtype": "O"}',
    "a ragged constant": '{"constant": [[1], [1, 2]], "dtype": "<i8"}',
    "a constant out of range": '{"constant": [300], "dtype": "|i1"}',
    "nested": "[" * 60 + "]" * 60,
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_description_is_refused_with_its_key(case):
    tables = scenario_to_dict(with_net({"w": np.ones(2)}))
    tables["disturbance"]["net"]["structure"] = BROKEN[case]
    assert_refused(r"disturbance\.net\.(structure|arrays)", from_dict, tables)


@pytest.mark.slow
def test_a_network_is_part_of_an_exported_law(tmp_path):
    parts = {"observer": NetworkObserver(ij.observers.Momentum(kf=20.0), mlp(size=2))}
    scenario = ij.with_parts(ij.presets.zhang_yan_2024(), sampling=ij.Sampling(1e-3), **parts)
    ij.save_scenario(scenario, tmp_path / "a.toml")
    assert same(ij.load_scenario(tmp_path / "a.toml"), scenario)
    written = ij.export(scenario, tmp_path / "c")
    header = (tmp_path / "c" / "iblf_law.h").read_text()
    assert "weight[3][2]" in header and "observer.net.layers[0].weight" in written.parameters
    command = "gcc -O1 iblf_law.c selftest.c -lm -o selftest && ./selftest"
    subprocess.run(command, shell=True, cwd=tmp_path / "c", check=True)
