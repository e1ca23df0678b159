"""Parts that users write: what a proof refuses, and what it states as an assumption."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from proof_cases import pendulum, within
from refused import assert_refused
from test_chains import lever

import iblf_jax as ij
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.proofs import examination
from iblf_jax.proofs.arms import arm_problem
from iblf_jax.proofs.chains import chain_problem
from iblf_jax.proofs.users_barriers import check_barrier
from iblf_jax.proofs.users_parts import agreement_of_robot, check_agreement


def with_false_rule(function):
    """A function with another derivative."""
    other = jax.custom_jvp(function)
    other.defjvp(lambda primals, tangents: (function(*primals), 0.0 * tangents[0]))
    return other


without_slope = with_false_rule(lambda x: 5.0 * x)


@jax.custom_vjp
def with_rule(x):
    return jnp.sin(x)


with_rule.defvjp(lambda x: (jnp.sin(x), x), lambda x, g: (0.0 * g,))
FALSE_SINE = jax.extend.core.Primitive("sin")
FALSE_SINE.def_impl(lambda x: 100.0 * x)
FALSE_SINE.def_abstract_eval(lambda x: x)
jax.interpreters.ad.primitive_jvps[FALSE_SINE] = lambda primals, tangents: (
    FALSE_SINE.bind(*primals),
    jnp.zeros_like(tangents[0]),
)


def counted(x):
    """A loop whose length depends on x."""
    return jax.lax.while_loop(lambda c: c[0] < x[0], lambda c: (c[0] + 1.0, c[1] + x), (0.0, x))[1]


def called_back(x):
    return jax.pure_callback(np.floor, jax.ShapeDtypeStruct(x.shape, x.dtype), x)


def by_root(x):
    """The root of y - x, whose derivative is that of the equation, which may be another one."""
    return jax.lax.custom_root(lambda y: y - x, x, lambda f, y: jnp.floor(x), lambda g, y: y)


def by_solver(x):
    return jax.lax.custom_linear_solve(lambda y: y, x, lambda f, y: jnp.floor(y), symmetric=True)


JUMPS = {
    "floor": lambda v: 100.0 * jnp.floor(10.0 * v),
    "ceil": jnp.ceil,
    "round": jnp.round,
    "trunc": jnp.trunc,
    "sign": jnp.sign,
    "mod": lambda v: v % 0.1,
    "remainder": lambda v: jnp.fmod(v, 0.1),
    "atan2": lambda v: jnp.arctan2(v, -1.0),
    "where ne": lambda v: jnp.where(v != 0.0, 1.0, 2.0),
    "where lt": lambda v: jnp.where(v < 0.1, 1.0, 2.0),
    "where isfinite": lambda v: jnp.where(jnp.isfinite(1.0 / v), 1.0, 2.0),
    "a truth value": lambda v: (v > 0.1).astype(float),
    "chain of comparisons": lambda v: (v > 0.1).astype(float) - (v < -0.1).astype(float),
    "heaviside": lambda v: jnp.heaviside(v, 0.5),
    "an integer": lambda v: v.astype(int).astype(float),
    "fewer digits": lambda v: v.astype(jnp.float32).astype(float),
    "reduce_precision": lambda v: jax.lax.reduce_precision(v, 5, 10),
    "bits": lambda v: jax.lax.bitcast_convert_type(
        jax.lax.bitcast_convert_type(v, jnp.int64) & ~0xFFFFFFFF, jnp.float64
    ),
    "nextafter": lambda v: jnp.nextafter(v, v + 1.0),
    "argmax": lambda v: jnp.argmax(jnp.stack([v, -v]), axis=0).astype(float),
    "sort": lambda v: jnp.sort(jnp.concatenate([v, -v]))[:1],
    "an index": lambda v: jnp.array([1.0, 2.0, 3.0])[(10.0 * v).astype(int)],
    "interp": lambda v: jnp.interp(v, jnp.array([0.0, 1.0]), jnp.array([0.0, 1.0])),
    "cond": lambda v: jax.lax.cond(v[0] > 0.0, jnp.sin, jnp.cos, v),
    "switch": lambda v: jax.lax.switch(v[0].astype(int), [jnp.sin, jnp.cos], v),
    "while": counted,
    "callback": called_back,
    "random": lambda v: jax.random.normal(jax.random.key(v[0].astype(int)), v.shape),
    "stop_gradient": lambda v: 5.0 * jax.lax.stop_gradient(v),
    "custom_jvp": without_slope,
    "custom_vjp": with_rule,
    "custom_jvp inside jit": jax.jit(without_slope),
    "custom_jvp inside remat": jax.checkpoint(without_slope),
    "custom_jvp inside a loop": lambda v: jax.lax.fori_loop(0, 3, lambda i, x: without_slope(x), v),
    "custom_root": by_root,
    "custom_linear_solve": by_solver,
    "a primitive of the name sin": FALSE_SINE.bind,
    "relu": jax.nn.relu,
    "sinc": jnp.sinc,
    "erf_inv": jax.scipy.special.erfinv,
    "a branch in Python": lambda v: v if v[0] > 0 else -v,
}
"""Functions of a velocity that jump, whose derivative is not theirs, or that cannot be examined."""


@component
class Torque:
    """A torque that is a function of the velocity."""

    function: Any = static()

    def torque(self, t, q, dq, plant, model):
        return -0.1 * self.function(dq)

    def jump_times(self):
        return jnp.zeros(0)


@pytest.fixture
def unchecked_start(monkeypatch):
    """The values at the start, which every other function would compile anew, are not checked."""
    monkeypatch.setattr("iblf_jax.proofs.arms.canonical", lambda scenario: scenario)


@pytest.mark.usefixtures("unchecked_start")
@pytest.mark.parametrize("name", JUMPS)
def test_disturbances_that_jump_or_have_own_derivatives_are_refused(name):
    scenario = pendulum(disturbance=Torque(JUMPS[name]))
    words = "select a case|does not know|cannot be traced|TracerBoolConversionError"
    assert_refused(words, arm_problem, scenario, {}, duration=2.0)


def heir(kind, **members):
    """A class that inherits from another one, with these members."""
    return component(type(f"Other{kind.__name__}", (kind,), {"__annotations__": {}, **members}))


TABLE = {"gain": 1.0, "array": np.array([1.0, 2.0])}
"""Numbers that a function reads from elsewhere."""


@pytest.mark.slow
def test_a_function_whose_numbers_changed_has_another_program(monkeypatch):
    function = jax.jit(lambda v: TABLE["gain"] * jnp.outer(jnp.asarray(TABLE["array"]), v)[1])

    def bound():
        jax.clear_caches()
        return arm_problem(pendulum(disturbance=Torque(function)), {}, duration=2.0).bound

    before = bound()
    assert bound() == before
    monkeypatch.setitem(TABLE, "gain", 5.0)
    assert bound() != before


def by_table(x):
    """A function with constants of its own, inside a loop over numbers that do not vary."""
    return jax.jit(lambda y: y + jnp.sum(jnp.asarray(TABLE["array"])))(x)


@pytest.mark.slow
@pytest.mark.parametrize(
    "function",
    [
        lambda v: TABLE["gain"] * v,
        lambda v: jnp.sum(jnp.asarray(TABLE["array"])) * v,
        jax.jit(lambda v: jnp.outer(jnp.asarray(TABLE["array"]), v)[1]),
        lambda v: jax.lax.fori_loop(0, 2, lambda i, x: x * jnp.asarray(TABLE["array"])[1], v),
        lambda v: v * jax.lax.scan(lambda c, _: (by_table(c), None), jnp.ones(()), None, 3)[0],
        lambda v: v * jax.lax.while_loop(lambda c: c < 9.0, by_table, jnp.ones(())),
        lambda v: TABLE["gain"] * v * without_slope(jnp.ones(())),
    ],
)
def test_a_function_whose_numbers_changed_has_another_digest(function, monkeypatch):
    def digest():
        jax.clear_caches()
        return examination.operations("f", lambda v: function(v), [jnp.zeros(1)]).digest

    before = digest()
    assert digest() == before
    monkeypatch.setitem(TABLE, "gain", 5.0)
    monkeypatch.setitem(TABLE, "array", np.array([1.0, 3.0]))
    assert digest() != before


def test_a_function_that_calls_python_has_another_digest_each_time():
    """No text holds what the called function computes."""

    def function(v):
        return v * called_back(jnp.ones(1))

    digests = {examination.operations("f", function, [jnp.zeros(1)]).digest for _ in range(2)}
    assert len(digests) == 2


SMOOTH = {
    "a polynomial": lambda v: 3.0 + v * (2.0 + v * (1.0 + v**3)),
    "a loop": lambda v: jax.lax.fori_loop(0, 3, lambda i, x: x * v, v),
    "a table with known places": lambda v: jnp.concatenate([v, 2.0 * v])[jnp.array([1])],
    "remat": jax.checkpoint(jnp.sin),
    "silu": jax.nn.silu,
    "drag": lambda v: v * jnp.abs(v),
    "a limit": lambda v: jnp.clip(v, -1.0, 1.0),
    "a norm": lambda v: jnp.sqrt(v**2 + 1.0),
    "a case that is known": lambda v: jnp.where(jnp.arange(1) > 2, 1.0, jnp.tanh(v)),
    "a power": lambda v: (1.0 + v**2) ** 1.5,
}


@pytest.mark.usefixtures("unchecked_start")
@pytest.mark.parametrize("name", SMOOTH)
def test_continuous_disturbances_are_admitted(name):
    arm_problem(pendulum(disturbance=Torque(SMOOTH[name])), {}, duration=2.0)


@component
class Drift:
    """x1' = x2, x2' = u + function(x[row])."""

    function: Any = static()
    row: int = static()
    n: ClassVar[int] = 1
    order: ClassVar[int] = 2

    def drift(self, t, x):
        rows = [jnp.zeros(1), jnp.zeros(1)]
        rows[self.row] = self.function(x[self.row])
        return jnp.stack(rows)

    def gain(self, t, x):
        return jnp.ones_like(x)


def with_drift(function, row):
    plant = Drift(function, row)
    return lever(plant=plant, model=plant)


@pytest.mark.parametrize("name", ["floor", "where ne", "stop_gradient", "custom_jvp", "atan2"])
def test_plants_that_jump_are_refused(name):
    with pytest.raises(ValueError, match=r"select a case|does not know"):
        chain_problem(with_drift(lambda x: -JUMPS[name](x), 1), {})


@pytest.mark.slow
def test_a_kink_is_admitted_in_the_last_level_only():
    """The law contains the derivative of the drift of the first level."""
    chain_problem(with_drift(lambda x: -x * jnp.abs(x), 1), {})
    assert_refused("derivative jumps", chain_problem, with_drift(lambda x: -x * jnp.abs(x), 0), {})


@component
class Link(ij.robots.Robot):
    """A pendulum."""

    mass: Leaf = leaf("kg")
    n: ClassVar[int] = 1

    def mass_matrix(self, q):
        return jnp.broadcast_to(0.2, (1, 1))

    def coriolis(self, q, v, u):
        return jnp.zeros_like(q)

    def gravity(self, q):
        return self.mass * jnp.sin(q)

    def potential(self, q):
        return self.mass * jnp.sum(1.0 - jnp.cos(q))

    def tip(self, q):
        return jnp.stack([jnp.sin(q[0]), -jnp.cos(q[0])])

    def jacobian(self, q):
        return jnp.stack([jnp.cos(q), jnp.sin(q)])

    def skeleton(self, q):
        return jnp.stack([jnp.zeros(2), self.tip(q)])


Stepped = heir(Link, gravity=lambda self, q: jnp.floor(self.mass) * jnp.sin(q))
"""Its load is a step function of a parameter."""


CONTRADICTING = {
    "depends on the time": heir(
        Link, at=lambda self, t: dataclasses.replace(self, mass=self.mass * (1.0 + t))
    ),
    "coriolis": heir(Link, coriolis=lambda self, q, v, u: -3.0 * u),
}


def of_plant(plant, parameters=None):
    return arm_problem(pendulum(plant=plant, model=plant), parameters or {})


def test_a_step_function_of_a_parameter_is_refused_where_the_parameter_varies():
    plant = Stepped(1.2)
    sentences = of_plant(plant).assumptions
    assert any("M' - 2 C of OtherLink is skew-symmetric" in x for x in sentences)
    assert not any("skew-symmetric" in x for x in arm_problem(pendulum(), {}).assumptions)
    assert_refused("does not know", of_plant, plant, within(5.0))
    assert_refused("does not know", arm_problem, pendulum(plant=plant, model=Stepped(0.9)), {})


@pytest.mark.parametrize("words", CONTRADICTING)
def test_robots_that_change_with_time_or_contradict_themselves_are_refused(words):
    assert_refused(words, of_plant, CONTRADICTING[words](1.2))


LIGHT = 1e-9 * np.array([[5.0, 1.0], [3.0, 5.0]])


def test_a_light_robot_is_compared_in_the_size_of_its_own_inertia():
    """Its inertia matrix is not symmetric."""
    light = heir(Link, n=2, mass_matrix=lambda self, q: jnp.asarray(LIGHT))
    assert_refused("mass_matrix", agreement_of_robot, light([1.2, 1.2]))


@pytest.mark.parametrize(
    ("given", "expected"), [([1e-9], [3e-9]), ([1e9, 1.0], [1e9, 2.0]), ([1.0, 1.0], [1.0, np.inf])]
)
def test_a_difference_is_a_share_of_the_number_itself(given, expected):
    assert_refused("a difference of", check_agreement, "part", given, expected)
    check_agreement("part", expected, expected)


WithWrongInverse = heir(Drift, level_input=lambda self, level, t, x, rate, torque: rate)


@component
class Upward:
    """A plant whose first level depends on the second one in a way that scenarios do not see."""

    n: ClassVar[int] = 1
    order: ClassVar[int] = 2

    def drift(self, t, x):
        far = 1.0 + jnp.tanh(50.0 * (jnp.sum(x**2, axis=0) - 1.0))
        return jnp.stack([far * x[1], jnp.zeros(1)])

    def gain(self, t, x):
        return jnp.ones_like(x)


@pytest.mark.parametrize(
    ("plant", "words"),
    [
        (WithWrongInverse(lambda x: -3.0 * x, 1), "level_input of level 2"),
        (Upward(), r"levels above|strict-feedback form"),
    ],
)
def test_plants_with_a_wrong_inverse_or_another_form_are_refused(plant, words):
    assert_refused(words, chain_problem, lever(plant=plant, model=plant), {})


# --- reference and bounds -------------------------------------------------------------------------


@component
class Path:
    """A position that is a function of time."""

    function: Any = static()

    def position(self, t):
        return self.function(t)[None]


Declared = heir(Path, continuous_derivatives=3)


@component
class SideOfPath:
    """A bound that is a function of time."""

    function: Any = static()

    def at(self, t, q_d):
        return jnp.broadcast_to(self.function(t), q_d.shape)


STEPS = {
    "floor": lambda t: 0.5 + 0.01 * jnp.floor(t),
    "where": lambda t: jnp.where(t < 1.0, 0.5, 0.51),
    "max": lambda t: 0.5 + 0.01 * jnp.maximum(t - 1.0, 0.0),
    "clip": lambda t: 0.5 + 0.01 * jnp.clip(t, 0.0, 1.0),
    "custom_jvp": lambda t: 0.5 + 0.001 * without_slope(t),
    "mod": lambda t: 0.5 + 0.01 * (t % 1.0),
}


@pytest.mark.usefixtures("unchecked_start")
@pytest.mark.parametrize("name", STEPS)
def test_references_and_bounds_that_jump_and_declare_nothing_are_refused(name):
    words = "select a case or have a kink|does not know"
    assert_refused(words, arm_problem, pendulum(reference=Path(STEPS[name])), {}, duration=2.0)

    def side(t):
        return STEPS[name](t) + 0.5

    upper = ij.Bounds(lower=ij.bounds.Constant([0.1]), upper=SideOfPath(side))
    assert_refused(words, arm_problem, pendulum(bounds=upper), {}, duration=2.0)


def test_a_reference_of_a_chain_that_jumps_is_refused():
    with pytest.raises(ValueError, match="select a case or have a kink"):
        chain_problem(lever(reference=Path(lambda t: STEPS["where"](t) - 0.4)), {}, duration=2.0)


def test_declared_derivatives_are_an_assumption():
    cubic = Declared(lambda t: 0.5 + 0.01 * jnp.maximum(t - 1.0, 0.0) ** 4)
    found = arm_problem(pendulum(reference=cubic), {}, duration=2.0)
    sentence = "The reference OtherPath has 3 continuous derivatives, as it declares."
    assert sentence in found.assumptions
    smooth = Path(lambda t: 0.5 + 0.1 * jnp.tanh(t))
    found = arm_problem(pendulum(reference=smooth), {}, duration=2.0)
    assert not any("as it declares" in x for x in found.assumptions)
    with pytest.raises(ValueError, match="does not know"):
        arm_problem(pendulum(reference=Declared(STEPS["floor"])), {}, duration=2.0)


# --- law, observer, actuator ----------------------------------------------------------------------


LAW = {"k1": 2.0, "K2": [3.0], "variant": "corrected"}


@component
class OtherDecay:
    """A decay that declares a constant gain."""

    constant: ClassVar[bool] = True

    def effective_gain(self, t, k, V):
        return k


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("controller", heir(ij.controllers.Backstepping)(**LAW)),
        ("observer", heir(ij.observers.Momentum)(kf=[100.0])),
        ("actuator", heir(ij.actuators.Ideal)()),
        ("controller", ij.controllers.Backstepping(**LAW, decays=OtherDecay())),
    ],
)
def test_classes_that_inherit_from_known_ones_are_refused(name, part):
    assert_refused(f"scenario.{name}", arm_problem, pendulum(**{name: part}), {})


def test_a_disturbance_that_inherits_from_a_periodic_one_has_no_period():
    with pytest.raises(ValueError, match="period of disturbance"):
        arm_problem(pendulum(disturbance=heir(ij.disturbances.Sum)(())), {})


# --- barriers -------------------------------------------------------------------------------------


def one(tube, q):
    return jnp.ones_like(q)


@component
class Altered(ij.barriers.TransformedError):
    """A barrier whose methods are multiplied by functions of (tube, e1)."""

    of_value: Any = static(default=one)
    of_slope: Any = static(default=one)
    of_alpha: Any = static(default=one)
    of_ratio: Any = static(default=one)

    def value(self, tube, q):
        return super().value(tube, q) * self.of_value(tube, q)

    def slope(self, tube, q):
        return super().slope(tube, q) * self.of_slope(tube, q)

    def virtual_velocity(self, tube, q, k1, o):
        return super().virtual_velocity(tube, q, k1, o) * self.of_alpha(tube, q)

    def error_over_slope(self, tube, q):
        return super().error_over_slope(tube, q) * self.of_ratio(tube, q)


def shares(function):
    """A function of xi."""
    return lambda tube, q: function(q / tube.k_u)


BARRIERS = {
    "a length in V1": ({"of_value": lambda tube, q: 1.0 + 1e-9 * q**2}, "length of its own"),
    "a length far away": (
        {"of_alpha": lambda tube, q: 1.0 + jax.nn.sigmoid(1e3 * (tube.upper - tube.lower - 10.0))},
        "length of its own",
    ),
    "a length in a comparison": (
        {"of_alpha": lambda tube, q: jnp.where(q > 0.2, 1.0, 2.0)},
        "no case of the sign",
    ),
    "a share in a comparison": (
        {"of_alpha": shares(lambda xi: jnp.where(xi > 0.2, 1.0, 2.0))},
        "no case of the sign",
    ),
    "a jump at 0": ({"of_alpha": lambda tube, q: jnp.where(q > 0.0, 1.0, 2.0)}, "at e1 = 0"),
    "a slope that is none of V1": ({"of_slope": lambda tube, q: 2.0 * one(tube, q)}, "slope"),
    "a floor": ({"of_alpha": shares(jnp.floor)}, "floor, which a proof does"),
    "a floor in e1/s": (
        {"of_ratio": shares(lambda xi: 1.0 + jnp.floor(1e-6 * xi**2))},
        "error_over_slope with floor, which a proof does not know",
    ),
    "its own rule in e1/s": (
        {"of_ratio": shares(lambda xi: 0.2 * without_slope(xi) / xi)},
        "error_over_slope with custom_jvp_call, which a proof does not know",
    ),
    "fewer digits": (
        {"of_slope": shares(lambda xi: xi.astype(jnp.float32).astype(float))},
        "does not know",
    ),
    "its own rule": ({"of_slope": shares(without_slope)}, "does not know"),
    "stop_gradient": ({"of_alpha": shares(jax.lax.stop_gradient)}, "does not know"),
}


def with_barrier(barrier):
    return pendulum(controller=ij.controllers.Backstepping(**LAW, barrier=barrier))


@pytest.mark.usefixtures("unchecked_start")
@pytest.mark.parametrize("name", BARRIERS)
def test_barriers_with_lengths_jumps_or_wrong_slopes_are_refused(name):
    fields, words = BARRIERS[name]
    assert_refused(words, arm_problem, with_barrier(Altered(**fields)), {})


def test_a_registered_barrier_is_not_one_of_the_package(monkeypatch):
    claims = "The claims of Altered hold"
    monkeypatch.setitem(ij.barriers.MEMBERS, "altered", Altered)
    of_levels = lever(ij.barriers.TransformedError(), Altered())
    for problem in (arm_problem(with_barrier(Altered()), {}), chain_problem(of_levels, {})):
        assert any(claims in x for x in problem.assumptions)
    assert not any("claims of" in x for x in arm_problem(pendulum(), {}).assumptions)
    length = BARRIERS["a length in V1"][0]
    assert_refused("length of its own", arm_problem, with_barrier(Altered(**length)), {})


def digests_of(barrier, n):
    """What `check_barrier` finds of a barrier without its guard."""
    object.__setattr__(barrier, "guard", -np.inf)
    return check_barrier("barrier", barrier, jnp.asarray(0.1), n=n, homogeneous=True)


@component
class Shifted(ij.barriers.TransformedError):
    """A barrier on the error of another joint in one of its methods."""

    method: str = static(default="value")
    move: Any = static(default=lambda q: q[::-1])

    def moved(self, method, q):
        return self.move(q) if method == self.method else q

    def value(self, tube, q):
        return super().value(tube, self.moved("value", q))

    def slope(self, tube, q):
        return super().slope(tube, self.moved("slope", q))

    def virtual_velocity(self, tube, q, k1, o):
        return super().virtual_velocity(tube, self.moved("virtual_velocity", q), k1, o)


@pytest.mark.parametrize("method", ["value", "slope", "virtual_velocity"])
def test_a_barrier_whose_joints_mix_is_refused(method):
    with pytest.raises(ValueError, match=f"{method}: got .* depends on another joint"):
        digests_of(Shifted(method=method), 2)


@pytest.mark.slow
def test_joints_may_not_mix_for_the_number_of_joints_of_the_arm():
    digests_of(Shifted(move=lambda q: jnp.roll(q, 2)), 2)
    with pytest.raises(ValueError, match="depends on another joint"):
        digests_of(Shifted(move=lambda q: jnp.roll(q, 2)), 3)


def test_a_ratio_that_jumps_although_the_barrier_denies_it_is_refused():
    """A barrier with twice the slope above e1 = 0, and a ratio that jumps there."""

    def two_sides(tube, q):
        return jnp.where(q > 0.0, 2.0, 1.0)

    kinked = heir(Altered, error_at=lambda self, V, tube, above: None)
    both = {"of_value": two_sides, "of_slope": two_sides}
    barrier = kinked(**both, of_ratio=lambda tube, q: 1.0 / two_sides(tube, q))
    assert not barrier.ratio_jumps
    assert_refused("at e1 = 0", digests_of, barrier, 1)


@pytest.mark.slow
def test_a_changed_ratio_of_a_barrier_has_another_digest(monkeypatch):
    """The ratio e1/s is in the law of every level above the first one."""
    barrier = Altered(of_ratio=lambda tube, q: one(tube, q) + 1e-9 * (TABLE["gain"] - 1.0))
    before = digests_of(barrier, 1)
    assert digests_of(barrier, 1) == before
    monkeypatch.setitem(TABLE, "gain", 2.0)
    jax.clear_caches()
    assert digests_of(barrier, 1) != before


# --- domains of functions -------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "function",
    [
        lambda v: 1e-3 * jnp.log(v - 100.0),
        lambda v: 1e-3 * jnp.arctanh(v + 100.0),
        lambda v: 1e-3 * v**1.5,
    ],
)
def test_functions_that_are_not_defined_are_not_proved(function):
    """Their derivatives are numbers, and the functions are not."""
    options = {"level": 0.1, "parameters": {}, "weight": 2e-3, "duration": 0.1, "runs": 0}
    scenario = pendulum(disturbance=Torque(function))
    assert not ij.prove(scenario, max_boxes=50_000, progress=False, **options).proved
