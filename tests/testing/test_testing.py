"""The checkers themselves: they name what is wrong with a broken member, and accept classes that a
user wrote."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from iblf_jax.controllers import Command

import iblf_jax as ij
from iblf_jax.testing import ContractError
from iblf_jax.testing._contract import Findings, in_dtype
from iblf_jax.testing.joints import joints_of
from iblf_jax.testing.own_claims import check_claims

TWO_LINK = ij.robots.TwoLink


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PlainLaw:
    """A user's law, registered by hand: gravity compensation and a damped spring to the
    reference."""

    gain: jax.Array

    def init(self, q, dq, context):
        return ()

    def command(self, t, q, dq, f_hat, context, state):
        tube = context.tube(t)
        tau = (
            context.model.gravity(q)
            - self.gain * (q - tube.q_d)
            - 0.2 * self.gain * (dq - tube.dq_d)
        )
        no = jnp.zeros(q.shape, bool)
        return Command(tau, tube.dq_d, jnp.zeros_like(q), no, no), ()


@pytest.mark.slow
def test_a_users_law_registered_by_hand_passes_and_runs():
    ij.testing.check_law(PlainLaw(jnp.asarray(30.0)))


def rejects(check, member, *words):
    # Type promotion is on, as it is by default.
    with jax.numpy_dtype_promotion("standard"), pytest.raises(ContractError) as caught:
        check(member)
    for word in words:
        assert word in str(caught.value), str(caught.value)


def changed(base, **methods):
    """A component like `base`'s class with some methods exchanged."""
    return ij.component(type("Broken", (base,), {"__annotations__": {}, **methods}))


def arm(**methods):
    return changed(TWO_LINK, **methods)(
        mass=[2.0, 0.85], length=[0.35, 0.31], centre=[0.2, 0.15], inertia=[0.06, 0.02]
    )


def test_not_a_component_at_all():
    rejects(ij.testing.check_law, object(), "JAX does not know its class", "iblf_jax.component")
    rejects(ij.testing.check_robot, TWO_LINK, "it is a class")


def test_missing_methods_are_listed_with_their_meaning():
    @ij.component
    class Nothing:
        pass

    rejects(
        ij.testing.check_robot,
        Nothing(),
        "mass_matrix(q) is missing",
        "potential(q) is missing",
        "n",
        "[kg m^2]",
    )
    rejects(
        ij.testing.check_law,
        Nothing(),
        "command(t, q, dq, f_hat, context, state) is missing",
        "init(q, dq, context) is missing",
    )
    rejects(
        ij.testing.check_fold, Nothing(), "'units' is missing", "update(acc, sample) is missing"
    )


@ij.component
class Gusts:
    """A user's noise, which grows with the position."""

    size: jax.Array
    levels: ClassVar[tuple[int, ...]] = (2,)

    def diffusion(self, t, x):
        return self.size * (1.0 + x[:1] ** 2)


@pytest.mark.slow
def test_process_noise_of_a_user():
    ij.testing.check_process_noise(Gusts(0.3))
    for methods, words in (
        ({"additive": True}, ("additive is True", "depends on x")),
        ({"levels": (2, 1)}, ("increasing",)),
        ({"levels": ()}, ("such as (2,)",)),
        ({"diffusion": lambda self, t, x: x}, ("has shape (2, 2)", "It must be (1, 2)")),
        ({"diffusion": lambda self, t, x: jnp.sqrt(x[:1] - 0.1)}, ("not finite somewhere",)),
        ({"diffusion": lambda self, t, x: self.size * abs(float(t))}, ("use jax.numpy",)),
    ):
        rejects(ij.testing.check_process_noise, changed(Gusts, **methods)(0.3), *words)


def test_a_check_in_post_init_is_found():
    @jax.tree_util.register_dataclass
    @dataclasses.dataclass(frozen=True)
    class Strict:
        value: jax.Array

        def __post_init__(self):
            if float(self.value) < 0:
                raise ValueError

        def at(self, t, q_d):
            return jnp.broadcast_to(self.value, q_d.shape)

    rejects(ij.testing.check_side, Strict(0.9), "cannot be rebuilt by JAX", "check(self)")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("methods", "words"),
    [
        ({"gravity": lambda self, q: jnp.zeros(3)}, ("gravity(q) has shape (3,)", "(2,)")),
        (
            {
                "gravity": lambda self, q: -TWO_LINK.gravity(self, q),
                "mass_matrix": lambda self, q: -TWO_LINK.mass_matrix(self, q),
                "coriolis": lambda self, q, v, u: TWO_LINK.coriolis(self, q, v, v),
                "jacobian": lambda self, q: TWO_LINK.jacobian(self, q).T,
                "momentum": lambda self, q, v: v,
                "inverse_dynamics": lambda self, q, v, u, a: TWO_LINK.mass_matrix(self, q) @ a,
                "energy_gradient": lambda self, q, v: v,
            },
            (
                "gravity(q) is not dU/dq",
                "not positive definite",
                "does not follow from M",
                "not linear in u",
                "jacobian(q) is not d tip/dq",
                "momentum(q, v) is not M(q) v",
                "inverse_dynamics(q, v, u, a) is not",
                "energy_gradient(q, v) is not dT/dq",
            ),
        ),
        (
            {"coriolis": lambda self, q, v, u: TWO_LINK.coriolis(self, q, v, u) + v[::-1] * u},
            ("not skew-symmetric",),
        ),
        ({"potential": lambda self, q: float(q[0])}, ("potential(q) raised", "use jax.numpy")),
        (
            {
                "tip": lambda self, q: jnp.where(
                    q[0] > 9, jnp.zeros(2), jax.lax.stop_gradient(TWO_LINK.tip(self, q))
                )
            },
            ("derivative of tip(q)",),
        ),
        (
            {"potential": lambda self, q: TWO_LINK.potential(self, q) + jnp.zeros((), "float64")},
            ("potential(q) is float64",),
        ),
    ],
    ids=["shape", "identities", "not-skew", "python-float", "stopped", "float64"],
)
def test_broken_robots(methods, words):
    rejects(ij.testing.check_robot, arm(**methods), *words)


@pytest.mark.slow
def test_broken_reference_and_bound():
    kink = changed(
        ij.references.Sinusoid,
        position=lambda self, t: self.offset + self.amplitude * jnp.abs(t - 3.3),
    )
    rejects(
        ij.testing.check_reference,
        kink(offset=[0.5, 0.5], amplitude=[0.01, 0.02]),
        "the rate of position(t) jumps at t = 3.3",
    )
    root = changed(
        ij.bounds.Constant, at=lambda self, t, q_d: self.value + 0.1 * jnp.sqrt(t) + 0 * q_d
    )
    rejects(ij.testing.check_side, root([0.5, 0.5]), "not finite at t = 0")


def test_an_undeclared_jump_is_found():
    silent = changed(ij.disturbances.Step, jump_times=lambda self: jnp.zeros(0))
    rejects(
        ij.testing.check_disturbance,
        silent(size=[1.0, 0.0], time=4.567),
        "jumps at t = 4.567",
        "jump_times",
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("methods", "words"),
    [
        (
            {"slope": lambda self, tube, q: -ij.barriers.Integral.slope(self, tube, q)},
            ("slope points outward", "not dV1/dq"),
        ),
        (
            {"value": lambda self, tube, q: -jnp.log(1 - tube.xi(q) ** 2)},
            ("value is not finite at xi",),
        ),
        (
            {"virtual_velocity": lambda self, tube, q, k1, o: tube.dq_d + k1 * (q - tube.q_d)},
            ("V1 grows",),
        ),
        (
            {
                "virtual_velocity": (
                    lambda self, tube, q, k1, o: tube.dq_d - k1 * (q - tube.q_d)[::-1]
                )
            },
            ("virtual_velocity mixes joints",),
        ),
        (
            {"decay_rate": lambda self, k1: 10.0 * k1},
            ("decay_rate V1 reaches", "Claim a smaller rate"),
        ),
        ({"decay_rate": lambda self, k1: k1[0]}, ("decay_rate(k1) has shape ()",)),
        (
            {"xi_bound": lambda self, V, tube: 0.5 * ij.barriers.Integral.xi_bound(self, V, tube)},
            ("beyond xi_bound",),
        ),
    ],
    ids=["outward", "no-guard", "sign", "mixed", "rate", "rate-of-no-joint", "bound"],
)
def test_broken_barriers(methods, words):
    rejects(
        ij.testing.check_barrier, changed(ij.barriers.Integral, uses_o=True, **methods)(), *words
    )


@pytest.mark.slow
def test_broken_observer():
    wrong = changed(
        ij.observers.Momentum, derivative=lambda self, t, q, dq, tau, model, state: (state,)
    )
    rejects(ij.testing.check_observer, wrong(kf=20.0), "derivative", "structure")
    wide = changed(ij.observers.Momentum, init=lambda self, q, dq, model: jnp.zeros(2, "float64"))
    rejects(ij.testing.check_observer, wide(kf=20.0), "estimate is float64 for float32")


@pytest.mark.slow
def test_broken_law():
    no_pair = changed(PlainLaw, command=lambda self, *args: PlainLaw.command(self, *args)[0])
    rejects(ij.testing.check_law, no_pair(3.0), "pair (Command, rate of the state)")
    integer = changed(
        PlainLaw,
        command=lambda self, *a: (
            PlainLaw.command(self, *a)[0]._replace(saturated=jnp.zeros(2, int)),
            (),
        ),
    )
    rejects(ij.testing.check_law, integer(3.0), "Command.saturated", "bool")

    rejects(
        ij.testing.check_law,
        unguarded(0.7),
        "not finite at xi = -0.9995, 0.9995, inside the bounds",
        "guarded_error",
    )


@pytest.mark.slow
def test_class_attributes_that_do_not_fit_the_law_are_found():
    """`gains` names fields, and a law that reads f_hat uses the observer."""

    def command(self, t, q, dq, f_hat, context, state):
        command, rate = PlainLaw.command(self, t, q, dq, f_hat, context, state)
        return command._replace(tau=command.tau - f_hat), rate

    other_gains = changed(PlainLaw, command=command, gains=("gain", "KX"), uses_observer=False)
    rejects(
        ij.testing.check_law,
        other_gains(3.0),
        "gains = ('gain', 'KX') has names that are no field: 'KX'",
        "uses_observer is False, but tau depends on f_hat",
    )


def unguarded(reach):
    """A law with a root that has no real value for |xi| > reach."""

    def command(self, t, q, dq, f_hat, context, state):
        command, state = PlainLaw.command(self, t, q, dq, f_hat, context, state)
        xi = context.tube(t).xi(q) / reach
        return command._replace(tau=command.tau - xi / jnp.sqrt(1 - xi**2)), state

    return changed(PlainLaw, command=command)(3.0)


def published(power=1.0, delta=0.0):
    """A law with s = ln[(A/a) (a + x)/(A - x)] on e1 and on e2, and a power of e2."""

    def slope(tube, x):
        return jnp.log(tube.k_u / tube.k_l * (tube.k_l + x) / (tube.k_u - x))

    def command(self, t, q, dq, f_hat, context, state):
        tube, model = context.tube(t), context.model
        alpha = tube.dq_d - 2.0 * (q - tube.q_d)
        slow, fast = context.speed_limits(t)
        e2 = dq - alpha
        inner = tube._replace(q_d=alpha, lower=slow, upper=fast)
        powered = (
            jnp.sign(e2) * jnp.abs(e2) ** power
            if delta == 0.0
            else e2 * (e2**2 + delta**2) ** ((power - 1.0) / 2)
        )
        tau = model.gravity(q) - slope(tube, q - tube.q_d) - slope(inner, e2) - 5.0 * powered
        no = jnp.zeros(q.shape, bool)
        return Command(tau, alpha, (q - tube.q_d) ** 2, no, no), ()

    return changed(PlainLaw, command=command, needs_velocity_bounds=True)(3.0)


@pytest.mark.slow
def test_a_law_that_is_undefined_beyond_its_bounds_fits_with_a_remark():
    (remark,) = ij.testing.check_law(unguarded(1.0))
    assert "undefined beyond the bound" in remark
    assert "-40, -1, 1, 40" in remark


@pytest.mark.slow
def test_so_does_one_that_is_undefined_beyond_velocity_bounds():
    position, velocity = ij.testing.check_law(published())
    assert "undefined beyond the bound" in position
    assert "undefined beyond the velocity bound" in velocity


@pytest.mark.slow
def test_an_infinite_derivative_in_e2_is_named():
    with pytest.raises(ContractError) as caught:
        ij.testing.check_law(published(power=0.6))
    assert "with respect to e2" in str(caught.value)
    assert "delta^2" in str(caught.value)
    assert "Near the bound" not in str(caught.value)
    assert len(ij.testing.check_law(published(power=0.6, delta=0.05))) == 2


class Stating(PlainLaw):
    """A law that states a claim: a damped spring's energy, and what its damper takes."""

    def lyapunov(self, t, q, dq, f_tilde, context, state):
        tube = context.tube(t)
        return (
            0.5 * dq * (context.model.mass_matrix(q) @ dq) + 0.5 * self.gain * (q - tube.q_d) ** 2
        )

    def decay(self, t, q, dq, f_tilde, context, state):
        return 0.2 * self.gain * dq**2


def claims_of(law):
    """What `check_law` finds wrong with a law's own claim."""
    findings = Findings(law, "Controller")
    with jax.numpy_dtype_promotion("standard"), jax.enable_x64(True):
        base = ij.with_parts(ij.presets.zhang_yan_2024(), controller=law)
        check_claims(findings, in_dtype(base, "float64"))
    return findings.problems


def test_broken_claims_of_a_law():
    half = changed(Stating, decay=ij.controllers.RobotLaw.decay)
    with pytest.raises(ContractError, match="it has lyapunov and no decay"):
        claims_of(half(3.0))
    wide = changed(Stating, decay=lambda self, t, q, dq, *args: jnp.zeros(3))
    with pytest.raises(
        ContractError,
        match=(
            r"decay\(t, q, dq, f_tilde, context, state\) gives .*must be an array of shape \(\) or"
            r" \(2,\)"
        ),
    ):
        claims_of(wide(3.0))
    terms = changed(
        Stating,
        disturbance_terms=lambda self, t, q, dq, f_tilde, df, context, state: df.astype("float64"),
    )
    with pytest.raises(ContractError, match=r"disturbance_terms.* gives float64 for float32"):
        claims_of(terms(3.0))


@pytest.mark.slow
def test_claims_of_a_law_are_nonnegative():
    assert claims_of(changed(Stating)(3.0)) == []
    growing = changed(Stating, decay=lambda self, t, q, dq, *args: 3.0 * (dq - 0.2) * dq)
    assert any("decay is -" in problem for problem in claims_of(growing(3.0)))


@pytest.mark.slow
def test_broken_fold():
    class Root:
        units: ClassVar[dict[str, str]] = {"rms": "rad"}

        def init(self, sample):
            return jnp.zeros_like(sample.t)

        def update(self, acc, sample):
            return acc + sample.dt * jnp.sum(sample.e1**2)

        def finish(self, acc):
            return {"rms": jnp.sqrt(acc)}

    rejects(ij.testing.check_fold, ij.component(Root)(), "NaN on a run without any error")
    rejects(ij.testing.check_fold, changed(Root, units={"other": "1"})(), "units names ['other']")
    grows = changed(Root, update=lambda self, acc, sample: jnp.append(acc, sample.t))
    rejects(ij.testing.check_fold, grows(), "update(acc, sample)", "which a scan carries")


def test_random_samples_are_apart(rng):
    """The made-up samples of the fold checker have no ties, at which maxima have no derivative."""
    from iblf_jax.testing.metrics import samples

    e1 = np.asarray(samples(rng).e1)
    assert np.unique(e1).size == e1.size


# --- any number of joints


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
        return ij.actuators.Delivered(self.Kt * state, jnp.zeros(command.shape, bool), rate)


def without_memory(self, command, dq, state):
    """Its input is a current in mA, its torque proportional to it, in the other direction."""
    return ij.actuators.Delivered(-1e-3 * self.Kt * command, jnp.zeros(command.shape, bool), ())


def washed_out(self, command, dq, state):
    """It delivers what changes, and in the end nothing."""
    return ij.actuators.Delivered(
        command - state, jnp.zeros(command.shape, bool), self.R * (command - state)
    )


def with_wrong_sign(self, command, dq, state):
    return ij.actuators.Delivered(
        self.Kt * state, jnp.zeros(command.shape, bool), (command + self.R * state) / self.L
    )


def per_joint(n):
    return np.linspace(1.0, 2.0, n)


def test_an_actuator_of_one_joint_whose_input_is_a_voltage():
    ij.testing.check_actuator(VoltageMotor(R=[1.0]))
    with pytest.raises(ValueError, match=r"actuator.R: got .*expected one number, or 2"):
        ij.testing.check_actuator(VoltageMotor(R=[1.0]), n=2)


@pytest.mark.parametrize(
    ("methods", "words"),
    [
        (
            {"init": lambda self, tau: 0.7 * tau / self.Kt},
            ("no input makes it deliver that torque", "`init` must return"),
        ),
        ({"deliver": with_wrong_sign}, ("its state grows by itself", "sign of its rate")),
        (
            {"deliver": lambda self, command, dq, state: (state, state, state)},
            ("iblf_jax.actuators.Delivered",),
        ),
    ],
    ids=["init", "sign", "no-record"],
)
def test_broken_actuators(methods, words):
    rejects(ij.testing.check_actuator, changed(VoltageMotor, **methods)(R=[1.0]), *words)


@pytest.mark.parametrize(
    "methods",
    [
        {"init": lambda self, tau: (), "deliver": without_memory},
        {"init": lambda self, tau: 0.0 * tau, "deliver": washed_out},
    ],
)
def test_actuators_with_other_inputs_and_without_a_steady_state(methods):
    ij.testing.check_actuator(changed(VoltageMotor, **methods)(R=[1.0]))


def test_a_sensor_without_its_record_is_refused():
    broken = changed(
        ij.sensors.Ideal, measure=lambda self, q, dq, normal, period, state: ((q, dq), state)
    )
    rejects(ij.testing.check_sensor, broken(), "iblf_jax.sensors.Measurement")


MEMBERS_OF_JOINTS = {
    "actuator": (6, ij.testing.check_actuator, lambda k: VoltageMotor(R=k)),
    "sensor": (
        3,
        ij.testing.check_sensor,
        lambda k: ij.sensors.Encoder(
            counts=4096, velocity=ij.sensors.FilteredDifference(cutoff=200 * k)
        ),
    ),
    "observer": (3, ij.testing.check_observer, lambda k: ij.observers.Momentum(kf=20 * k)),
    "disturbance": (
        6,
        ij.testing.check_disturbance,
        lambda k: ij.disturbances.Friction(viscous=0.1 * k),
    ),
    "reference": (
        1,
        ij.testing.check_reference,
        lambda k: ij.references.Sinusoid(offset=0.5 * k, amplitude=0.1),
    ),
    "side": (1, ij.testing.check_side, ij.bounds.Constant),
    "fold": (3, ij.testing.check_fold, lambda k: ij.metrics.Settling(tolerance=0.01 * k)),
    "objective": (1, ij.testing.check_objective, lambda k: WeightedSquare(weight=k)),
    "law": (
        1,
        ij.testing.check_law,
        lambda k: ij.controllers.Saturated(
            ij.controllers.PDGravity(Kp=60 * k, Kd=20 * k), limit=90.0
        ),
    ),
    "law-by-hand": (3, ij.testing.check_law, lambda k: PlainLaw(jnp.asarray(20.0 * k))),
    "barrier": (3, ij.testing.check_barrier, lambda k: WeightedMapping(weight=k)),
}
"""Family -> a number of joints other than two, its checker, and a member from one number per
joint."""


@ij.component
class WeightedMapping:
    """A user's barrier with a leaf of one number per joint: the mapping barrier with a weight."""

    weight: ij.Leaf = ij.leaf("1", sign="positive")
    guard: float = ij.static(default=1e-3)
    uses_o: ClassVar[bool] = False

    def value(self, tube, q):
        return self.weight * ij.barriers.TransformedError(guard=self.guard).value(tube, q)

    def slope(self, tube, q):
        return self.weight * ij.barriers.TransformedError(guard=self.guard).slope(tube, q)

    def virtual_velocity(self, tube, q, k1, o):
        return ij.barriers.TransformedError(guard=self.guard).virtual_velocity(tube, q, k1, o)


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


QUICK = ("sensor", "disturbance", "side")


@pytest.mark.parametrize(
    "family",
    [x if x in QUICK else pytest.param(x, marks=pytest.mark.slow) for x in MEMBERS_OF_JOINTS],
)
def test_members_of_any_number_of_joints(family):
    n, check, member_of = MEMBERS_OF_JOINTS[family]
    check(member_of(per_joint(n)))


def test_coordinates_of_the_tip_are_no_numbers_of_joints():
    assert joints_of(ij.disturbances.TipForce(amplitude=[1.0, 2.0, 3.0])) == 2


def test_leaves_of_different_numbers_of_joints_are_a_finding():
    rejects(
        ij.testing.check_actuator,
        VoltageMotor(R=[1.0, 2.0, 3.0], Kt=[0.1, 0.2]),
        "its leaves are for 2 and 3 joints",
    )


@pytest.mark.parametrize(
    "check", [ij.testing.check_law, ij.testing.check_observer, ij.testing.check_disturbance]
)
def test_a_number_of_joints_beside_a_robot_must_be_its_own(check, paper):
    member = {"check_law": paper.controller, "check_observer": paper.observer}.get(
        check.__name__, paper.disturbance
    )
    beside = {"check_law": {"scenario": paper}, "check_observer": {"model": paper.model}}.get(
        check.__name__, {"plant": paper.plant}
    )
    with pytest.raises(ValueError, match=r"n: got 3, expected 2"):
        check(member, n=3, **beside)


@ij.component
class FiniteBarrier:
    """V1 = xi^2 / 2, which a disturbance carries across the bound."""

    guard: float = ij.static(default=1e-3)
    uses_o = False

    def value(self, tube, q):
        """V1."""
        error = ij.barriers.guarded_error(tube, q, self.guard)
        return 0.5 * (error.e / error.k) ** 2 + error.e / error.k**2 * error.beyond

    def slope(self, tube, q):
        """s."""
        error = ij.barriers.guarded_error(tube, q, self.guard)
        return error.e / error.k**2

    def virtual_velocity(self, tube, q, k1, o):
        """alpha."""
        error = ij.barriers.guarded_error(tube, q, self.guard)
        return tube.dq_d - (k1 - error.dk / error.k) * (q - tube.q_d)


@pytest.mark.slow
def test_a_barrier_that_is_finite_at_its_bound_is_refused():
    with pytest.raises(ij.testing.ContractError, match=r"V1 is finite at the bound: it is 0\.5 "):
        ij.testing.check_barrier(FiniteBarrier())
