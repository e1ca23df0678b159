"""Base classes of families, and the adoption of classes that inherit from none."""

import math
import pickle
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import pytest
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.core.families import Part, adopt
from iblf_jax.core.pytree import note_code

OWN = """
import iblf_jax as ij

@ij.component
class Steep:
    gain: ij.Leaf = ij.leaf("1", default=3.0)
    guard: float = ij.static(default=1e-3)
    uses_o = False

    def value(self, tube, q):
        return self.gain * (q - tube.q_d) ** 2

    def slope(self, tube, q):
        return 2 * self.gain * (q - tube.q_d)

    def virtual_velocity(self, tube, q, k1, o):
        return tube.dq_d - k1 * (q - tube.q_d)
"""


def own_class(base: str = "", field: str = "") -> type:
    names = {"__name__": "__main__"}
    text = OWN.replace("Steep:", f"Steep{base}:")
    exec(text.replace("    gain:", f"    {field}\n    gain:", 1), names)
    return names["Steep"]


def law_with(barrier):
    return ij.controllers.Backstepping(k1=2.0, K2=20.0, barrier=barrier)


def test_a_class_without_a_base_class_gets_what_it_lacks_and_keeps_what_it_has():
    own = own_class()
    barrier = law_with(own()).barrier
    assert type(barrier) is own and isinstance(barrier, ij.barriers.Barrier)
    assert barrier.uses_o is False
    assert barrier.value_unit == "1" and barrier.slope_derivatives == math.inf
    assert barrier.decay_rate(jnp.ones(2)) is None


@pytest.mark.parametrize("base", ["", "(ij.barriers.Barrier)"])
def test_a_field_is_not_replaced_by_a_property_and_the_key_of_a_class_changes_once(base):
    own = own_class(base, "slope_derivatives: int = ij.static()")
    part = law_with(own(slope_derivatives=2)).barrier
    note_code(part)
    first = jax.tree.structure(part)
    assert jax.tree.map(lambda x: x, part).slope_derivatives == part.slope_derivatives == 2
    law_with(own(slope_derivatives=2))
    note_code(part)
    assert jax.tree.structure(part) == first


def test_an_attribute_of_an_object_is_not_replaced_by_a_property_of_the_base_class():
    class Kinked(own_class()):
        def __init__(self, derivatives: int) -> None:
            object.__setattr__(self, "gain", jnp.ones(2))
            object.__setattr__(self, "slope_derivatives", derivatives)

    flatten = lambda part: ((part.gain,), part.slope_derivatives)  # noqa: E731
    jax.tree_util.register_pytree_node(Kinked, flatten, lambda number, _: Kinked(number))
    first = law_with(Kinked(1)).barrier
    assert (first.slope_derivatives, law_with(Kinked(2)).barrier.slope_derivatives) == (1, 2)


def test_a_default_does_not_hide_a_member_of_another_base_class():
    class Claiming:
        def decay_rate(self, k1):
            return k1

    plain = own_class()
    both = [ij.component(type(name, (plain, Claiming), {})) for name in ("Earlier", "Later")]
    assert law_with(both[0]()).barrier.decay_rate(3.0) == 3.0
    assert law_with(plain()).barrier.decay_rate(3.0) is None
    assert law_with(both[1]()).barrier.decay_rate(3.0) == 3.0


def test_the_default_of_a_family_replaces_that_of_all_components():
    class Gravity(Part):
        own_joints: ClassVar[Mapping[str, int]] = {"mass": 3}

    own = own_class()
    assert own().own_joints == {}
    for base in (Gravity, ij.barriers.Barrier):
        adopt(own, base)
        assert own().own_joints == {"mass": 3}


def test_a_leaf_may_have_the_name_of_a_statement_of_classes():
    own = own_class(field='rows: ij.Leaf = ij.leaf("1")')
    assert any(x.path == "barrier.rows" for x in ij.parameters(law_with(own(rows=2.0))))


def test_a_module_of_another_library_gets_the_members():
    equinox = pytest.importorskip("equinox")

    class Module(equinox.Module):
        gain: jax.Array
        guard: float = equinox.field(static=True, default=1e-3)
        value = slope = virtual_velocity = lambda self, *arguments: self.gain

    barrier = law_with(Module(jnp.ones(2))).barrier
    assert isinstance(barrier, ij.barriers.Barrier) and barrier.slope_derivatives == math.inf
    assert jax.tree.map(lambda x: x, barrier).value_unit == "1"


@pytest.mark.slow
@pytest.mark.parametrize("way", ["by value", "by import"])
def test_a_class_that_another_process_gets_has_the_members(way, tmp_path, monkeypatch):
    if way == "by value":
        packed = pytest.importorskip("cloudpickle").dumps(law_with(own_class()(gain=5.0)))
    else:
        (tmp_path / "own_barriers.py").write_text(OWN)
        monkeypatch.syspath_prepend(tmp_path)
        from own_barriers import Steep  # type: ignore[import-not-found]

        packed = pickle.dumps(law_with(Steep(gain=5.0)))
    code = (
        f"import sys; sys.path[:0] = {[str(tmp_path), str(Path(ij.__file__).parents[1])]};"
        "import pickle; barrier = pickle.load(sys.stdin.buffer).barrier; import iblf_jax as ij;"
        "print(float(barrier.gain), barrier.value_unit, barrier.slope_derivatives,"
        "isinstance(barrier, ij.barriers.Barrier))"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, input=packed, capture_output=True, check=True)
    assert done.stdout.split() == [b"5.0", b"1", b"inf", b"True"]


def test_a_field_without_a_value_is_required_although_the_base_class_has_a_default():
    @ij.component
    class Timed(ij.decays.Decay):
        smooth_derivatives: int = ij.static()

        def effective_gain(self, t, k, V):
            return k

    assert_refused("smooth_derivatives", Timed)
    assert Timed(smooth_derivatives=3).smooth_derivatives == 3


def test_a_method_that_is_missing_is_an_error_at_the_definition_or_the_use():
    class Half:
        guard: float = ij.static(default=1e-3)

    inheriting = type("Inheriting", (Half, ij.barriers.Barrier), {"value": lambda *_: 0.0})
    assert_refused(r"It lacks slope\.", ij.component, inheriting)
    half = ij.component(Half)()
    assert_refused(r"It lacks slope, value\.", law_with, half)


def test_a_class_that_takes_members_from_another_object_takes_the_defaults_last():
    @ij.component
    class Delayed:
        motion: ij.references.Reference

        def __getattr__(self, name):
            if name.startswith("__") or name == "motion":
                raise AttributeError(name)
            return getattr(self.motion, name)

    adopt(Delayed, ij.references.Reference)
    step = ij.references.SmoothStep(start=0.0, end=1.0, duration=2.0, derivatives=3)
    assert Delayed(step).continuous_derivatives == 3
    of_other = Delayed(own_class()())
    assert of_other.continuous_derivatives == math.inf and of_other.gain == 3.0
    assert of_other.jump_times().size == 0
    with pytest.raises(AttributeError, match="unknown"):
        _ = of_other.unknown
