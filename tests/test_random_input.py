"""Random input at the entry points: a ValueError or a result, never a crash of another kind, never a silent NaN."""

from __future__ import annotations

import dataclasses
import math
import warnings

import jax
import numpy as np
import pytest
from conftest import SHORT
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from members import FAMILIES

import iblf_jax as ij
from iblf_jax import checks, paths, rollout
from iblf_jax.pytree import is_leaf_field
from iblf_jax.scenario import check_values
from iblf_jax.status import Status

SCALARS = st.one_of(
    st.floats(),
    st.integers(),
    st.booleans(),
    st.none(),
    st.text(max_size=5),
    st.complex_numbers(),
    st.binary(max_size=3),
    st.sampled_from(
        [np.float16(1), np.float32("nan"), np.int64(-3), np.bool_(True), np.str_("x"), 10**400, Ellipsis, object, {}, set(), b""]
    ),
)
ARRAYS = hnp.arrays(
    st.sampled_from([np.float16, np.float32, np.float64, np.int32, np.uint8, np.bool_, np.complex64, "U3", object]),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3),
)
ANYTHING = st.one_of(
    SCALARS, ARRAYS, st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=3) | st.tuples(inner, inner), max_leaves=5)
)
MEMBERS = [member for family, (members, _, _) in FAMILIES.items() for member in members.values()]
many = settings(max_examples=400)


def accepts_or_value_error(call):
    """The result, or None if the call raised a ValueError that names what came."""
    refusal = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return call()
        except ValueError as error:
            refusal = str(error)
    assert ": got " in refusal, refusal
    return None


def finite(tree) -> bool:
    return all(np.all(np.isfinite(x)) for x in jax.tree.leaves(tree))


@many
@given(member=st.sampled_from(MEMBERS), data=st.data(), value=ANYTHING)
def test_constructors(member, data, value):
    """Any field of any member, given anything."""
    fields = [f for f in dataclasses.fields(member) if f.init]
    if not fields:
        return
    field = data.draw(st.sampled_from(fields))
    given_now = {f.name: getattr(member, f.name) for f in fields} | {field.name: value}
    made = accepts_or_value_error(lambda: type(member)(**given_now))
    if made is not None:
        check_values(made)
        if is_leaf_field(field) and getattr(made, field.name) is not None:
            assert np.issubdtype(getattr(made, field.name).dtype, np.floating)


@many
@given(name=st.sampled_from([f.name for f in dataclasses.fields(ij.Scenario)]), value=st.one_of(ANYTHING, st.sampled_from(MEMBERS)))
def test_scenarios(paper, name, value):
    """Any part of a scenario exchanged for anything, other families' members included."""
    accepts_or_value_error(lambda: dataclasses.replace(paper, **{name: value}))


PATHLIKE = st.one_of(
    st.text(alphabet="plantmscoer.[]0123456789-_K ", max_size=20),
    st.builds(
        lambda a, b, i: f"{a}.{b}{i}",
        st.sampled_from(["plant", "model", "robot", "controller", "initial", "disturbance", "bounds.lower", "observer", "x"]),
        st.sampled_from(["mass", "K2", "k1", "q", "g", "kf", "phase", "offset", "reading", "barrier", "__init__"]),
        st.sampled_from(["", "[0]", "[1]", "[-1]", "[7]", "[0][0]", "[99999999999]", ".real", "[a]"]),
    ),
    ANYTHING,
)


@many
@given(path=PATHLIKE)
def test_parse_and_get(paper, path):
    tokens = accepts_or_value_error(lambda: paths.parse(path))
    if tokens is not None:
        assert all(isinstance(t, str | int) for t in tokens)
        assert paths.parse("".join(f"[{t}]" if isinstance(t, int) else f".{t}" for t in tokens).removeprefix(".")) == tokens
    value = accepts_or_value_error(lambda: paths.get(paper, path))
    assert value is None or np.all(np.isfinite(value))


@many
@given(path=PATHLIKE.filter(lambda p: isinstance(p, str)), value=ANYTHING)
def test_with_parameters(paper, path, value):
    other = accepts_or_value_error(lambda: ij.with_parameters(paper, {path: value}))
    if other is not None:
        assert finite(other)
        assert jax.tree.structure(other) == jax.tree.structure(paper)
        assert [np.shape(x) for x in jax.tree.leaves(other)] == [np.shape(x) for x in jax.tree.leaves(paper)]
        before, after = ({p.path: np.asarray(p.value) for p in ij.parameters(s)} for s in (paper, other))
        changed = {p for p in before if not np.array_equal(before[p], after[p])}
        touched = {p.split("[")[0] for p in paths.expand(path)}
        assert changed <= touched


class Entered(Exception):  # noqa: N818
    """The arguments were accepted; nothing is compiled in these tests."""


def entered(*args, **options):
    raise Entered


@many
@given(data=st.data(), value=ANYTHING)
def test_arguments_of_simulate(paper, data, value):
    name = data.draw(st.sampled_from(["duration", "dt", "method", "record_every", "metrics", "scenario"]))
    options = {"scenario": paper, **SHORT, name: value}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollout, "_run_lowered", entered)
        try:
            accepts_or_value_error(lambda: ij.simulate(options.pop("scenario"), **options))
        except Entered:
            assert name != "scenario"


@many
@given(duration=st.floats(), dt=st.floats())
def test_steps(duration, dt):
    steps = accepts_or_value_error(lambda: checks.whole_steps(duration, dt))
    if steps is not None:
        assert 1 <= steps <= checks.MOST_STEPS
        assert math.isclose(steps * dt, duration, rel_tol=1e-2)


NUMBERS = st.one_of(
    st.floats(-1e3, 1e3), st.floats(1e-3, 1e2), st.floats(allow_nan=False, allow_infinity=False), st.sampled_from([1e-300, 1e300, 0.0])
)


@pytest.mark.slow
@settings(max_examples=300)
@given(
    values=st.dictionaries(st.sampled_from([p.path for p in ij.parameters(ij.presets.zhang_yan_2024())]), NUMBERS, min_size=1, max_size=4)
)
def test_no_silent_nan_in_a_run(paper, values):
    """Any numbers in any leaves: refused, or run; a run that is not finite says so, and its records are finite up to there."""
    run = accepts_or_value_error(lambda: ij.simulate(ij.with_parameters(paper, values), **SHORT))
    if run is None:
        return
    status = int(run.status)
    state = np.concatenate([np.asarray(run.q).ravel(), np.asarray(run.dq).ravel(), np.asarray(run.observer_state).ravel()])
    assert np.all(np.isfinite(state))
    others = [np.asarray(x) for x in (run.tau, run.e1, run.e2, run.xi, run.disturbance, run.disturbance_estimate, run.V)]
    if not all(np.all(np.isfinite(x)) for x in others):
        assert status & Status.NOT_FINITE, values
