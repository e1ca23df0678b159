"""The checkers name what is wrong with a broken member, and accept classes of users."""

import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
import loops_of_plants
import numpy as np
import pytest
from iblf_jax.controllers import Command
from refused import assert_refused

import iblf_jax as ij
from iblf_jax import plants, testing
from iblf_jax.testing import ContractError
from iblf_jax.testing._contract import Findings, in_dtype
from iblf_jax.testing.joints import joints_of
from iblf_jax.testing.own_claims import check_claims

TWO_LINK = ij.robots.TwoLink
ERROR = ij.barriers.TransformedError
FILTERED = ij.sensors.FilteredDifference


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PlainLaw:
    """A user's law, registered by hand: gravity compensation, a spring and a damper."""

    gain: jax.Array

    def command(self, t, q, dq, f_hat, context, state):
        tube = context.tube(t)
        spring, damper = self.gain * (q - tube.q_d), 0.2 * self.gain * (dq - tube.dq_d)
        tau = context.model.gravity(q) - spring - damper
        no = jnp.zeros(q.shape, bool)
        return Command(tau, tube.dq_d, jnp.zeros_like(q), no, no), ()


class Stating(PlainLaw):
    """A law that states a claim: a damped spring's energy, and what its damper takes."""

    def lyapunov(self, t, q, dq, f_tilde, context, state):
        kinetic = 0.5 * dq * (context.model.mass_matrix(q) @ dq)
        return kinetic + 0.5 * self.gain * (q - context.tube(t).q_d) ** 2

    def decay(self, t, q, dq, f_tilde, context, state):
        return 0.2 * self.gain * dq**2


@ij.component
class Gusts:
    """A user's noise, which grows with the position."""

    size: jax.Array
    levels: ClassVar[tuple[int, ...]] = (2,)

    def diffusion(self, t, x):
        return self.size * (1.0 + x[:1] ** 2)


@ij.component
class VoltageMotor:
    """A user's actuator whose input is a voltage: tau = Kt i, L i' = u - R i - Kt q'."""

    R: ij.Leaf = ij.leaf("ohm", sign="positive")
    Kt: ij.Leaf = ij.leaf("N m/A", sign="positive", default=0.08)
    L: ij.Leaf = ij.leaf("H", sign="positive", default=2e-3)

    def init(self, tau):
        return tau / self.Kt

    def deliver(self, command, dq, state):
        rate = (command - self.R * state - self.Kt * dq) / self.L
        return delivered(self.Kt * state, rate)


def delivered(tau, rate=()):
    return ij.actuators.Delivered(tau, jnp.zeros(tau.shape, bool), rate)


@ij.component
class WeightedMapping:
    """A user's barrier with a leaf of one number per joint: the mapping barrier with a weight."""

    weight: ij.Leaf = ij.leaf("1", sign="positive")
    guard: float = ij.static(default=1e-3)
    uses_o: ClassVar[bool] = False

    def value(self, tube, q):
        return self.weight * ERROR(guard=self.guard).value(tube, q)

    def slope(self, tube, q):
        return self.weight * ERROR(guard=self.guard).slope(tube, q)

    def virtual_velocity(self, tube, q, k1, o):
        return ERROR(guard=self.guard).virtual_velocity(tube, q, k1, o)


@ij.component
class WeightedSquare:
    """A user's objective with a leaf of one number per joint: sum_k dt weight . e1^2."""

    weight: ij.Leaf = ij.leaf("1", sign="positive")

    def init(self, sample):
        return jnp.zeros_like(sample.t)

    def update(self, acc, sample):
        return acc + sample.dt * jnp.sum(self.weight * sample.e1**2)

    def finish(self, acc):
        return acc, acc, acc[None]


@ij.component
class FiniteBarrier:
    """V1 = xi^2 / 2, which a disturbance carries across the bound."""

    guard: float = ij.static(default=1e-3)
    uses_o = False

    def value(self, tube, q):
        error = ij.barriers.guarded_error(tube, q, self.guard)
        return 0.5 * (error.e / error.k) ** 2 + error.e / error.k**2 * error.beyond

    def slope(self, tube, q):
        error = ij.barriers.guarded_error(tube, q, self.guard)
        return error.e / error.k**2

    def virtual_velocity(self, tube, q, k1, o):
        error = ij.barriers.guarded_error(tube, q, self.guard)
        return tube.dq_d - (k1 - error.dk / error.k) * (q - tube.q_d)


@ij.component
class Nothing:
    pass


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Strict:
    """A side that checks what JAX reconstructs it from."""

    value: jax.Array

    def __post_init__(self):
        if float(self.value) < 0:
            raise ValueError

    def at(self, t, q_d):
        return jnp.broadcast_to(self.value, q_d.shape)


def changed(base, **methods):
    return ij.component(type("Broken", (base,), {"__annotations__": {}, **methods}))


def of(base, *values, **fields):
    """A function that makes a member of a class with other methods."""
    return lambda **methods: changed(base, **methods)(*values, **fields)


arm = of(TWO_LINK, mass=[2.0, 0.85], length=[0.35, 0.31], centre=[0.2, 0.15], inertia=[0.06, 0.02])
barrier = of(changed(ij.barriers.Integral, uses_o=True))
constant = of(ij.bounds.Constant, [0.5, 0.5])
law = of(PlainLaw, 3.0)
momentum = of(ij.observers.Momentum, kf=20.0)
motor = of(VoltageMotor, R=[1.0])
noise = of(Gusts, 0.3)
reading = of(ij.sensors.Ideal)
sinusoid = of(ij.references.Sinusoid, offset=[0.5, 0.5], amplitude=[0.01, 0.02])
step = of(ij.disturbances.Step, size=[1.0, 0.0], time=4.567)


def root(name):
    """The root of an integral, which has no derivative on a run without any error."""
    methods = {"units": {name: "rad"}, "finish": lambda self, acc: {"rms": jnp.sqrt(acc)}}
    return changed(WeightedSquare, **methods)(weight=1.0)


def commanded(replace):
    """A `command` that changes the record of PlainLaw's by a function of the f_hat and of it."""

    def command(self, t, q, dq, f_hat, context, state):
        given, state = PlainLaw.command(self, t, q, dq, f_hat, context, state)
        return given._replace(**replace(given, f_hat, context.tube(t).xi(q))), state

    return command


def unguarded(reach):
    """A law with a root that has no real value for |xi| > reach."""

    def with_root(given, f_hat, xi):
        return {"tau": given.tau - xi / reach / jnp.sqrt(1 - (xi / reach) ** 2)}

    return law(command=commanded(with_root))


def with_wrong_sign(self, command, dq, state):
    return delivered(self.Kt * state, (command + self.R * state) / self.L)


WRONG_IDENTITIES = {
    "gravity": lambda self, q: -TWO_LINK.gravity(self, q),
    "mass_matrix": lambda self, q: -TWO_LINK.mass_matrix(self, q),
    "coriolis": lambda self, q, v, u: TWO_LINK.coriolis(self, q, v, v),
    "jacobian": lambda self, q: TWO_LINK.jacobian(self, q).T,
    "momentum": lambda self, q, v: v,
    "inverse_dynamics": lambda self, q, v, u, a: TWO_LINK.mass_matrix(self, q) @ a,
    "energy_gradient": lambda self, q, v: v,
}
PENDULUM = ij.presets.motor_driven_pendulum().plant
pendulum = of(type(PENDULUM), **vars(PENDULUM))


def drift(t, x):
    return jnp.stack([jnp.cos(x[0]), x[0] * x[1]])


def gain(t, x):
    return jnp.stack([jnp.ones_like(x[0]), 2.0 + x[0] ** 2])


def plant_of(drift=drift, gain=gain, **others):
    return plants.StrictFeedback(drift=drift, gain=gain, **({"n": 1, "order": 2} | others))


def instance(kind):
    return kind()


QUICK = {
    ("plant", plant_of): {
        "StrictFeedback.drift(t, x): got row 0 that depends on x[1] | row 0 of the gain": {
            "drift": lambda t, x: jnp.stack([x[1], x[0]])
        },
        "row 1 of gain(t, x) is not finite at x = [ | check_plant(plant, x=": {
            "gain": lambda t, x: jnp.stack([x[0] ** 0, jnp.sqrt(x[1] - 1.0)])
        },
        "(1,). All rows of jnp.stack must have one shape: write 0.0 * x[0]": {
            "drift": lambda t, x: jnp.stack([0.0, x[1]])
        },
        "row 1 of gain(t, x) is singular": {
            "gain": lambda t, x: jnp.stack([x[0] ** 0, 0.0 * x[0]])
        },
        "row 0 of gain(t, x) is singular": {
            "n": 2,
            "drift": lambda t, x: -x,
            "gain": lambda t, x: jnp.ones((2, 2, 2), x.dtype),
        },
        "drift(t, x) | has shape (1,) | It must be (2, 1)": {"drift": lambda t, x: x[0]},
        "gain(t, x) | has shape (1, 1) | (2, 1) for diagonal gains": {
            "gain": lambda t, x: jnp.ones((1, 1), x.dtype)
        },
        "not finite": {"drift": lambda t, x: jnp.stack([jnp.sqrt(x[0] - x[0]), x[1]])},
    },
    ("plant", pendulum): {
        "level_rate is not f_i + G_i x_{i+1}": {
            "level_rate": lambda self, level, t, x, above, torque: above
        },
        "level_input is not the inverse": {
            "level_input": lambda self, level, t, x, rate, torque: rate
        },
        "transposed_gain is not G_i^T s": {"transposed_gain": lambda self, level, t, x, s: 2.0 * s},
        "do not hold the plant at q": {"steady_input": lambda self, q: 1.0 + 0.0 * q},
        "weights has negative entries": {"weights": lambda self, x: -jnp.ones_like(x)},
        "level_names | expected a tuple of 3 texts": {"level_names": ("angle", "speed")},
        "4 units": {"units": ("rad", "rad/s", "V")},
    },
    ("law", instance): {
        "JAX does not know its class | iblf_jax.component": {"kind": object},
        "command(t, q, dq, f_hat, context, state) is missing": {"kind": Nothing},
    },
    ("robot", instance): {
        "it is a class": {"kind": lambda: TWO_LINK},
        "mass_matrix(q) is missing | potential(q) is missing | n | [kg m^2]": {"kind": Nothing},
    },
    ("fold", instance): {"'units' is missing | update(acc, sample) is missing": {"kind": Nothing}},
    ("side", Strict): {"cannot be rebuilt by JAX | check(self)": {"value": 0.9}},
    ("disturbance", step): {
        "jumps at t = 4.567 | jump_times": {"jump_times": lambda self: jnp.zeros(0)}
    },
    ("actuator", motor): {
        "no input makes it deliver that torque | `init` must return": {
            "init": lambda self, tau: 0.7 * tau / self.Kt
        },
        "its state grows by itself | sign of its rate": {"deliver": with_wrong_sign},
        "iblf_jax.actuators.Delivered": {
            "deliver": lambda self, command, dq, state: (state, state, state)
        },
    },
    ("actuator", VoltageMotor): {
        "its leaves are for 2 and 3 joints": {"R": [1.0, 2.0, 3.0], "Kt": [0.1, 0.2]}
    },
    ("sensor", reading): {
        "iblf_jax.sensors.Measurement": {"measure": lambda self, q, dq, *others: ((q, dq), ())}
    },
}
SLOW = {
    ("process_noise", noise): {
        "additive is True | depends on x": {"additive": True},
        "has shape (2, 2) | It must be (1, 2)": {"diffusion": lambda self, t, x: x},
        "use jax.numpy": {"diffusion": lambda self, t, x: self.size * abs(float(t))},
    },
    ("robot", arm): {
        (
            "gravity(q) is not dU/dq | not positive definite | does not follow from M"
            " | not linear in u | jacobian(q) is not d tip/dq | momentum(q, v) is not M(q) v"
            " | inverse_dynamics(q, v, u, a) is not | energy_gradient(q, v) is not dT/dq"
        ): WRONG_IDENTITIES,
        "not skew-symmetric": {
            "coriolis": lambda self, q, v, u: TWO_LINK.coriolis(self, q, v, u) + v[::-1] * u
        },
        "potential(q) raised | use jax.numpy": {"potential": lambda self, q: float(q[0])},
        "potential(q) is float64": {
            "potential": lambda self, q: TWO_LINK.potential(self, q) + jnp.zeros((), "float64")
        },
    },
    ("reference", sinusoid): {
        "the rate of position(t) jumps at t = 3.3": {
            "position": lambda self, t: self.offset + self.amplitude * jnp.abs(t - 3.3)
        },
    },
    ("side", constant): {
        "not finite at t = 0": {
            "at": lambda self, t, q_d: self.value + 0.1 * jnp.sqrt(t) + 0 * q_d
        },
    },
    ("barrier", barrier): {
        "slope points outward | not dV1/dq": {
            "slope": lambda self, tube, q: -ij.barriers.Integral.slope(self, tube, q)
        },
        "V1 grows": {
            "virtual_velocity": lambda self, tube, q, k1, o: tube.dq_d + k1 * (q - tube.q_d)
        },
        "virtual_velocity mixes joints": {
            "virtual_velocity": lambda self, tube, q, k1, o: tube.dq_d - k1 * (q - tube.q_d)[::-1]
        },
        "decay_rate V1 reaches | Claim a smaller rate": {"decay_rate": lambda self, k1: 10.0 * k1},
        "beyond xi_bound": {
            "xi_bound": lambda self, V, tube: 0.5 * ij.barriers.Integral.xi_bound(self, V, tube)
        },
    },
    ("barrier", FiniteBarrier): {"V1 is finite at the bound: it is 0.5 ": {}},
    ("observer", momentum): {
        "derivative | structure": {
            "derivative": lambda self, t, q, dq, tau, model, state: (state,)
        },
    },
    ("law", law): {
        "pair (Command, rate of the state)": {
            "command": lambda self, *args: PlainLaw.command(self, *args)[0]
        },
        (
            "gains = ('gain', 'KX') has names that are no field: 'KX' | "
            "uses_observer is False, but tau depends on f_hat"
        ): {
            "command": commanded(lambda given, f_hat, xi: {"tau": given.tau - f_hat}),
            "gains": ("gain", "KX"),
            "uses_observer": False,
        },
    },
    ("law", unguarded): {
        "not finite at xi = -0.9995, 0.9995, inside the bounds | guarded_error": {"reach": 0.7}
    },
    ("fold", root): {
        "NaN on a run without any error": {"name": "rms"},
        "units names ['other']": {"name": "other"},
    },
}
"""Family and a function that makes a member -> words of what is found, and arguments for that."""


def broken():
    for table, marks in ((QUICK, ()), (SLOW, pytest.mark.slow)):
        for (family, make), rows in table.items():
            for words, options in rows.items():
                made = functools.partial(make, **options)
                yield pytest.param(family, words, made, marks=marks, id=f"{family}: {words}")


@pytest.mark.parametrize(("family", "words", "make"), list(broken()))
def test_what_is_wrong_with_a_broken_member_is_named(family, words, make):
    # Type promotion is on, as it is by default.
    with jax.numpy_dtype_promotion("standard"), pytest.raises(ContractError) as caught:
        getattr(testing, f"check_{family}")(make())
    for word in words.split(" | "):
        assert word in str(caught.value), str(caught.value)


def test_actuators_with_other_inputs_and_without_a_steady_state():
    """A voltage; one in mA and in the other direction; a torque that follows changes only."""

    def without_memory(self, command, dq, state):
        return delivered(-1e-3 * self.Kt * command)

    def washed_out(self, command, dq, state):
        return delivered(command - state, self.R * (command - state))

    words = r"actuator.R: got .*expected one number, or 2"
    testing.check_actuator(VoltageMotor(R=[1.0]))
    assert_refused(words, testing.check_actuator, VoltageMotor(R=[1.0]), n=2)
    testing.check_actuator(motor(init=lambda self, tau: (), deliver=without_memory))
    testing.check_actuator(motor(init=lambda self, tau: 0.0 * tau, deliver=washed_out))


def published():
    """A law with s = ln[(A/a) (a + x)/(A - x)] on e1 and on e2."""

    def slope(tube, x):
        return jnp.log(tube.k_u / tube.k_l * (tube.k_l + x) / (tube.k_u - x))

    def command(self, t, q, dq, f_hat, context, state):
        tube, model = context.tube(t), context.model
        alpha = tube.dq_d - 2.0 * (q - tube.q_d)
        slow, fast = context.speed_limits(t)
        e2 = dq - alpha
        inner = tube._replace(q_d=alpha, lower=slow, upper=fast)
        tau = model.gravity(q) - slope(tube, q - tube.q_d) - slope(inner, e2) - 5.0 * e2
        no = jnp.zeros(q.shape, bool)
        return Command(tau, alpha, (q - tube.q_d) ** 2, no, no), ()

    return law(command=command, needs_velocity_bounds=True)


@pytest.mark.slow
def test_a_law_that_is_undefined_beyond_its_bounds_fits_with_a_remark():
    (remark,) = testing.check_law(unguarded(1.0))
    assert "undefined beyond the bound" in remark and "-40, -1, 1, 40" in remark
    position, velocity = testing.check_law(published())
    assert "undefined beyond the bound" in position
    assert "undefined beyond the velocity bound" in velocity


def claims_of(law):
    findings = Findings(law, "Controller")
    with jax.numpy_dtype_promotion("standard"), jax.enable_x64(True):
        base = ij.with_parts(ij.presets.zhang_yan_2024(), controller=law)
        check_claims(findings, in_dtype(base, "float64"))
    return findings.problems


SHAPES = r"\(t, q, dq, f_tilde, context, state\) gives .*must be an array of shape \(\) or \(2,\)"


def test_broken_claims_of_a_law():
    for words, claims in (
        ("it has lyapunov and no decay", {"decay": ij.controllers.RobotLaw.decay}),
        (f"decay{SHAPES}", {"decay": lambda self, *args: jnp.zeros(3)}),
        (
            r"disturbance_terms.* gives float64 for float32",
            {"disturbance_terms": lambda self, t, q, dq, f, df, *_: df.astype("float64")},
        ),
    ):
        assert_refused(words, claims_of, changed(Stating, **claims)(3.0), error=ContractError)


@pytest.mark.slow
def test_classes_of_users_fit_and_claims_of_a_law_are_nonnegative():
    testing.check_law(PlainLaw(jnp.asarray(30.0)))
    testing.check_process_noise(Gusts(0.3))
    assert claims_of(changed(Stating)(3.0)) == []
    growing = changed(Stating, decay=lambda self, t, q, dq, *args: 3.0 * (dq - 0.2) * dq)
    assert any("decay is -" in problem for problem in claims_of(growing(3.0)))


def saturated(k):
    return ij.controllers.Saturated(ij.controllers.PDGravity(Kp=60 * k, Kd=20 * k), limit=90.0)


MEMBERS_OF_JOINTS = {
    "actuator": (6, lambda k: VoltageMotor(R=k)),
    "sensor": (3, lambda k: ij.sensors.Encoder(counts=4096, velocity=FILTERED(cutoff=200 * k))),
    "observer": (3, lambda k: ij.observers.Momentum(kf=20 * k)),
    "disturbance": (6, lambda k: ij.disturbances.Friction(viscous=0.1 * k)),
    "reference": (1, lambda k: ij.references.Sinusoid(offset=0.5 * k, amplitude=0.1)),
    "side": (1, ij.bounds.Constant),
    "fold": (3, lambda k: ij.metrics.Settling(tolerance=0.01 * k)),
    "objective": (1, lambda k: WeightedSquare(weight=k)),
    "law": (1, saturated),
    "barrier": (3, lambda k: WeightedMapping(weight=k)),
}
"""Family -> a number of joints other than two, and a member from one number per joint."""
QUICK_FAMILIES = ("sensor", "disturbance", "side")


def families():
    for family in MEMBERS_OF_JOINTS:
        yield pytest.param(family, marks=[pytest.mark.slow] * (family not in QUICK_FAMILIES))


@pytest.mark.parametrize("family", list(families()))
def test_members_of_any_number_of_joints(family):
    n, member_of = MEMBERS_OF_JOINTS[family]
    getattr(testing, f"check_{family}")(member_of(np.linspace(1.0, 2.0, n)))


def test_a_number_of_joints_beside_a_robot_must_be_its_own(paper):
    """Coordinates of the tip are no numbers of joints."""
    assert joints_of(ij.disturbances.TipForce(amplitude=[1.0, 2.0, 3.0])) == 2
    for check, member, beside in (
        (testing.check_law, paper.controller, {"scenario": paper}),
        (testing.check_observer, paper.observer, {"model": paper.model}),
        (testing.check_disturbance, paper.disturbance, {"plant": paper.plant}),
    ):
        assert_refused(r"n: got 3, expected 2", check, member, n=3, **beside)


@pytest.mark.slow
def test_states_may_be_given_for_a_plant_that_is_defined_in_a_part_of_the_space():
    tank = plant_of(drift=lambda t, x: jnp.stack([-jnp.sqrt(x[0]), -x[1]]))
    assert_refused("not finite", testing.check_plant, tank, error=ContractError)
    testing.check_plant(tank, x=[[[0.5], [0.1]], [[2.0], [-0.3]]])
    assert_refused(r"x: got .* shape \(m, 2, 1\)", testing.check_plant, tank, x=[[0.5, 0.1]])


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [pytest.param("electric drive", marks=pytest.mark.release), "user functions"]
)
def test_laws_of_plants_pass_in_their_scenario(case):
    scenario = loops_of_plants.CASES[case]()
    assert testing.check_law(scenario.controller, scenario=scenario) == ()


@ij.component
class WrongShape:
    """A law whose input has a row for every level, (r, n) in the place of (n,)."""

    k: ij.Leaf = ij.leaf("1/s", default=1.0)
    receives_x = True

    def command(self, t, x, d_hat, context, state):
        inside = jnp.zeros(x.shape[1:], bool)
        return Command(-self.k * x, x[1], jnp.zeros_like(x[0]), inside, inside), ()


def test_a_law_of_another_order_or_with_an_input_of_the_wrong_shape_says_so():
    with pytest.raises(ContractError, match=r"3 levels.*expected 2 levels"):
        testing.check_law(ij.controllers.BarrierBackstepping(k=(2.0, 20.0, 30.0)))
    with pytest.raises(ContractError, match=r"Command\.tau"):
        testing.check_law(WrongShape(), scenario=loops_of_plants.user_class())
