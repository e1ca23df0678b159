"""The checkers themselves: they name what is wrong with a broken member, and accept classes that a user wrote."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.controllers import Command
from iblf_jax.testing import ContractError

TWO_LINK = ij.robots.TwoLink


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PlainLaw:
    """A user's law, registered by hand: gravity compensation and a damped spring to the reference."""

    gain: jax.Array

    def init(self, q, dq, setting):
        return ()

    def command(self, t, q, dq, f_hat, setting, state):
        tube = setting.tube(t)
        tau = setting.model.gravity(q) - self.gain * (q - tube.q_d) - 0.2 * self.gain * (dq - tube.dq_d)
        no = jnp.zeros(q.shape, bool)
        return Command(tau, tube.dq_d, jnp.zeros_like(q), no, no), ()


@pytest.mark.slow
def test_a_users_law_registered_by_hand_passes_and_runs():
    ij.testing.check_law(PlainLaw(jnp.asarray(30.0)))


def test_the_checkers_leave_the_session_as_it_was():
    before = jax.config.jax_enable_x64
    ij.testing.check_side(ij.bounds.Constant(0.9))
    assert jax.config.jax_enable_x64 == before


def rejects(check, member, *words):
    # As in a session of a user's, where types are promoted.
    with jax.numpy_dtype_promotion("standard"), pytest.raises(ContractError) as caught:
        check(member)
    for word in words:
        assert word in str(caught.value), str(caught.value)


def changed(base, **methods):
    """A component like `base`'s class with some methods exchanged."""
    return ij.component(type("Broken", (base,), {"__annotations__": {}, **methods}))


def arm(**methods):
    return changed(TWO_LINK, **methods)(mass=[2.0, 0.85], length=[0.35, 0.31], centre=[0.2, 0.15], inertia=[0.06, 0.02])


def test_not_a_component_at_all():
    rejects(ij.testing.check_law, object(), "JAX does not know its class", "iblf_jax.component")
    rejects(ij.testing.check_robot, TWO_LINK, "it is a class")


def test_missing_methods_are_listed_with_their_meaning():
    @ij.component
    class Nothing:
        pass

    rejects(ij.testing.check_robot, Nothing(), "mass_matrix(q) is missing", "gravity(q) is missing", "n", "[kg m^2]")
    rejects(ij.testing.check_law, Nothing(), "command(t, q, dq, f_hat, setting, state) is missing", "init(q, dq, setting) is missing")
    rejects(ij.testing.check_fold, Nothing(), "'units' is missing", "update(acc, sample) is missing")


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
        ({"gravity": lambda self, q: -TWO_LINK.gravity(self, q)}, ("gravity(q) is not dU/dq",)),
        ({"mass_matrix": lambda self, q: -TWO_LINK.mass_matrix(self, q)}, ("not positive definite", "does not follow from M")),
        ({"coriolis": lambda self, q, v, u: TWO_LINK.coriolis(self, q, v, v)}, ("not linear in u",)),
        ({"coriolis": lambda self, q, v, u: TWO_LINK.coriolis(self, q, v, u) + v[::-1] * u}, ("not skew-symmetric",)),
        ({"jacobian": lambda self, q: TWO_LINK.jacobian(self, q).T}, ("jacobian(q) is not d tip/dq",)),
        ({"potential": lambda self, q: float(q[0])}, ("potential(q) raised", "use jax.numpy")),
        (
            {"tip": lambda self, q: jnp.where(q[0] > 9, jnp.zeros(2), jax.lax.stop_gradient(TWO_LINK.tip(self, q)))},
            ("derivative of tip(q)",),
        ),
        ({"potential": lambda self, q: TWO_LINK.potential(self, q) + jnp.zeros((), "float64")}, ("potential(q) is float64",)),
    ],
    ids=["shape", "sign", "negative", "not-linear", "not-skew", "transposed", "python-float", "stopped", "float64"],
)
def test_broken_robots(methods, words):
    rejects(ij.testing.check_robot, arm(**methods), *words)


def test_broken_reference_and_bound():
    kink = changed(ij.references.Sinusoid, position=lambda self, t: self.offset + self.amplitude * jnp.abs(t - 3.3))
    rejects(ij.testing.check_reference, kink(offset=[0.5, 0.5], amplitude=[0.01, 0.02]), "the rate of position(t) jumps at t = 3.3")
    root = changed(ij.bounds.Constant, at=lambda self, t, q_d: self.value + 0.1 * jnp.sqrt(t) + 0 * q_d)
    rejects(ij.testing.check_side, root([0.5, 0.5]), "not finite at t = 0")


def test_an_undeclared_jump_is_found():
    silent = changed(ij.disturbances.Step, jump_times=lambda self: jnp.zeros(0))
    rejects(ij.testing.check_disturbance, silent(size=[1.0, 0.0], time=4.567), "jumps at t = 4.567", "jump_times")


@pytest.mark.parametrize(
    ("methods", "words"),
    [
        ({"slope": lambda self, tube, q: -ij.barriers.Integral.slope(self, tube, q)}, ("slope points outward", "not dV1/dq")),
        ({"value": lambda self, tube, q: -jnp.log(1 - tube.xi(q) ** 2)}, ("value is not finite at xi",)),
        ({"virtual_velocity": lambda self, tube, q, k1, o: tube.dq_d + k1 * (q - tube.q_d)}, ("V1 grows",)),
        ({"virtual_velocity": lambda self, tube, q, k1, o: tube.dq_d - k1 * (q - tube.q_d)[::-1]}, ("virtual_velocity mixes joints",)),
        ({"decay_rate": lambda self, k1: 10.0 * k1}, ("decay_rate V1 reaches", "Claim a smaller rate")),
        ({"decay_rate": lambda self, k1: k1[0]}, ("decay_rate(k1) has shape ()",)),
        ({"xi_bound": lambda self, V, tube: 0.5 * ij.barriers.Integral.xi_bound(self, V, tube)}, ("beyond xi_bound",)),
    ],
    ids=["outward", "no-guard", "wrong-sign", "mixed", "rate-too-large", "rate-of-no-joint", "bound-too-small"],
)
def test_broken_barriers(methods, words):
    rejects(ij.testing.check_barrier, changed(ij.barriers.Integral, uses_o=True, **methods)(), *words)


def test_broken_observer():
    wrong = changed(ij.observers.Momentum, derivative=lambda self, t, q, dq, tau, model, state: (state,))
    rejects(ij.testing.check_observer, wrong(kf=20.0), "derivative", "structure")
    wide = changed(ij.observers.Momentum, init=lambda self, q, dq, model: jnp.zeros(2, "float64"))
    rejects(ij.testing.check_observer, wide(kf=20.0), "estimate is float64 for float32")


def test_broken_law():
    no_pair = changed(PlainLaw, command=lambda self, *args: PlainLaw.command(self, *args)[0])
    rejects(ij.testing.check_law, no_pair(3.0), "pair (Command, rate of the state)")
    integer = changed(PlainLaw, command=lambda self, *a: (PlainLaw.command(self, *a)[0]._replace(saturated=jnp.zeros(2, int)), ()))
    rejects(ij.testing.check_law, integer(3.0), "Command.saturated", "bool")

    rejects(ij.testing.check_law, unguarded(0.7), "not finite at xi = -0.9995, 0.9995, inside the bounds", "guarded_error")


def unguarded(reach):
    """A law with a root that has no real value for |xi| > reach."""

    def command(self, t, q, dq, f_hat, setting, state):
        command, state = PlainLaw.command(self, t, q, dq, f_hat, setting, state)
        xi = setting.tube(t).xi(q) / reach
        return command._replace(tau=command.tau - xi / jnp.sqrt(1 - xi**2)), state

    return changed(PlainLaw, command=command)(3.0)


def published(power=1.0, delta=0.0):
    """A law with s = ln[(A/a) (a + x)/(A - x)] on e1 and on e2, and a power of e2."""

    def slope(tube, x):
        return jnp.log(tube.k_u / tube.k_l * (tube.k_l + x) / (tube.k_u - x))

    def command(self, t, q, dq, f_hat, setting, state):
        tube, model = setting.tube(t), setting.model
        alpha = tube.dq_d - 2.0 * (q - tube.q_d)
        slow, fast = setting.speed_limits(t)
        e2 = dq - alpha
        inner = tube._replace(q_d=alpha, lower=slow, upper=fast)
        powered = jnp.sign(e2) * jnp.abs(e2) ** power if delta == 0.0 else e2 * (e2**2 + delta**2) ** ((power - 1.0) / 2)
        tau = model.gravity(q) - slope(tube, q - tube.q_d) - slope(inner, e2) - 5.0 * powered
        no = jnp.zeros(q.shape, bool)
        return Command(tau, alpha, (q - tube.q_d) ** 2, no, no), ()

    return changed(PlainLaw, command=command, needs_velocity_bounds=True)(3.0)


def test_a_law_that_is_undefined_beyond_its_bounds_fits_with_a_remark():
    (remark,) = ij.testing.check_law(unguarded(1.0))
    assert "undefined beyond the bound" in remark
    assert "-40, -1, 1, 40" in remark


def test_so_does_one_that_is_undefined_beyond_velocity_bounds():
    position, velocity = ij.testing.check_law(published())
    assert "undefined beyond the bound" in position
    assert "undefined beyond the velocity bound" in velocity


def test_an_infinite_derivative_in_e2_is_named():
    with pytest.raises(ContractError) as caught:
        ij.testing.check_law(published(power=0.6))
    assert "with respect to e2" in str(caught.value)
    assert "delta^2" in str(caught.value)
    assert "wall" not in str(caught.value)
    assert len(ij.testing.check_law(published(power=0.6, delta=0.05))) == 2


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
    rejects(ij.testing.check_fold, grows(), "update(acc, sample)", "carried by a scan")


def test_random_samples_are_apart(rng):
    """The made-up samples of the fold checker have no ties, at which maxima have no derivative."""
    from iblf_jax.testing.metrics import samples

    e1 = np.asarray(samples(rng).e1)
    assert np.unique(e1).size == e1.size
