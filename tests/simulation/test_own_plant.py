"""A plant of order 2 whose second level is not the rate of the first: two water tanks."""

from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refused import assert_refused, refused

import iblf_jax as ij
from iblf_jax.certificates.terms import TorquePoint
from iblf_jax.core.status import Status
from iblf_jax.deployment.cosimulate import _delivered
from iblf_jax.simulation.closed_loop import initial_state
from iblf_jax.simulation.levels import acceleration, motion, start_levels, torque_needed
from iblf_jax.simulation.scenario import canonical
from iblf_jax.tuning.objectives import fitted

LIMITS = {"limit": 9e-5, "lower_limit": 6e-5}
ROOT_OF_2G = 4.429  # [m^0.5/s]
SHORT = {"duration": 40.0, "dt": 0.2}


@ij.component
class Tanks:
    """The level x1 of the lower tank, and the root x2 of the level of the upper one."""

    a1: ij.Leaf = ij.leaf("m^2", sign="positive", shape="scalar")
    a2: ij.Leaf = ij.leaf("m^2", sign="positive", shape="scalar")
    n: ClassVar[int] = 1
    order: ClassVar[int] = 2
    units: ClassVar[tuple[str, ...]] = ("m", "m^0.5", "m^3/s")
    level_names: ClassVar[tuple[str, ...]] = ("lower level", "root of the upper level")
    input_name: ClassVar[str] = "pump flow"
    area: ClassVar[float] = 0.0154

    def drift(self, t: jax.Array, x: jax.Array) -> jax.Array:
        lower = -self.a1 * ROOT_OF_2G * jnp.sqrt(x[0]) / self.area
        upper = -self.a2 * ROOT_OF_2G / (2.0 * self.area) + 0.0 * x[1]
        return jnp.stack([lower, upper])

    def gain(self, t: jax.Array, x: jax.Array) -> jax.Array:
        flow = self.a2 * ROOT_OF_2G / self.area + 0.0 * x[0]
        return jnp.stack([flow, 1.0 / (2.0 * self.area * x[1])])


TUBE = ij.Bounds(lower=ij.bounds.Funnel(-0.01, -0.01, 0.0), upper=ij.bounds.Funnel(0.01, 0.01, 0.0))


def tanks(**parts: Any) -> ij.Scenario:
    root = ij.Bounds(lower=ij.bounds.Constant(0.1), upper=ij.bounds.Constant(0.6))
    own: dict[str, Any] = {
        "plant": Tanks(a1=5e-5, a2=7e-5),
        "reference": ij.references.Sinusoid(offset=0.12, amplitude=0.02, frequency=0.02),
        "bounds": (TUBE, root),
        "controller": ij.controllers.BarrierBackstepping(
            k=(0.03, 0.1), barriers=(ij.barriers.TransformedError(),) * 2, weights=(1e4, 400.0)
        ),
        "initial": ij.Initial(x=[[0.125], [0.247]]),
    }
    return ij.Scenario(**own | parts)


SHORT_DRIFT = ij.plants.StrictFeedback(lambda t, x: x[0], lambda t, x: jnp.ones_like(x), 1, 2)


def run_of(**parts):
    return ij.simulate(tanks(**parts), **SHORT)


START, ADVICE = ij.Initial(q=0.125), r"x_2 is 0 if Initial has no dq: Initial\(x="
test_a_start_or_a_drift_that_does_not_fit_is_named_with_its_levels = refused(
    (lambda: run_of(initial=START), ADVICE),
    (lambda: run_of(initial=START, bounds=TUBE), ADVICE),
    (
        lambda: run_of(plant=Tanks(a1=5e-5, a2=1e-320), initial=ij.Initial(x=[[0.125], [0.2]])),
        r"The start is x = \[\[0.125\], \[0.2\]\](?!.*dq)",
    ),
    (lambda: run_of(plant=SHORT_DRIFT), r"drift.*The plant has 2 levels of 1 component\."),
)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["motor", "smooth"])
def test_an_input_has_a_lower_limit_of_its_own(kind):
    free = tanks()
    command = np.asarray(ij.simulate(free, **SHORT).tau)
    assert command.min() < LIMITS["lower_limit"] and command.max() > LIMITS["limit"]
    law = ij.controllers.Saturated(free.controller, **LIMITS, edge="smooth")
    parts = {"actuator": ij.actuators.Motor(**LIMITS)} if kind == "motor" else {"controller": law}
    scenario = ij.with_parts(free, **parts)
    run = ij.simulate(scenario, **SHORT)
    assert LIMITS["lower_limit"] <= run.tau.min() < 1.02 * LIMITS["lower_limit"]
    assert 0.98 * LIMITS["limit"] < run.tau.max() <= LIMITS["limit"]
    assert Status(int(run.status)) & Status.TORQUE_SATURATED
    study = ij.monte_carlo(
        scenario, {"plant.a2": ij.factor(ij.uniform(1.0, 1.0001))}, runs=2, progress=False, **SHORT
    )
    np.testing.assert_allclose(study.metrics["rmse"][0], run.metrics.rmse, rtol=1e-2)
    np.testing.assert_allclose(study.metrics["peak_torque"][0], np.max(run.tau), rtol=1e-3)


def test_an_actuator_of_one_direction_is_checked_in_its_range():
    pump = ij.actuators.Motor(limit=1e-4, lower_limit=0.0)
    with pytest.raises(ij.testing.ContractError, match=r"torques=\(low, high\)"):
        ij.testing.check_actuator(pump)
    ij.testing.check_actuator(pump, torques=(0.0, 1e-4))
    assert_refused("torques: got", ij.testing.check_actuator, pump, torques=(1e-4, 0.0))


def test_requirements_and_weights_have_the_names_and_units_of_the_plant():
    assert "1/m^2; 1/m " in repr(ij.parameters(tanks()))
    goal = ij.objectives.tracking() + ij.objectives.peak_torque_below(1e-4)
    goal = fitted(goal + ij.objectives.velocity_margin_above(0.05), tanks())
    names = [requirement.name for requirement in goal.requirements]
    assert names == ["peak pump flow < 0.0001 m^3/s", "root of the upper level margin > 0.05 m^0.5"]


@pytest.mark.slow
def test_a_certificate_counts_inaccurate_runs():
    perturbed = {"plant.a2": ij.factor(ij.uniform(0.999, 1.001))}
    with pytest.warns(UserWarning, match="too large for 3 of 3 runs"):
        study = ij.monte_carlo(tanks(), perturbed, runs=3, progress=False, duration=50.0, dt=2.5)
    assert np.all(study.status & int(Status.INACCURATE))
    assert not np.any(study.status & int(Status.STEP_TOO_LARGE))
    certificate = ij.certify(tanks(), study, worst=2)
    assert certificate.inaccurate == 2
    for text in (str(certificate), certificate.table_html()):
        assert "2 of 2 runs are flagged INACCURATE, so the numbers" in text
    single = str(ij.certify(study.replay(0).scenario, study.replay(0)))
    assert "The run is flagged INACCURATE, so the numbers" in single
    assert "component 0, t = " in single
    accurate = ij.certify(tanks(), **SHORT)
    assert (accurate.inaccurate, accurate.accuracy_note) == (0, "")
    assert "INACCURATE" not in str(accurate) + accurate.table_html()


@ij.component
class Noting(ij.disturbances.Disturbance):
    seen: ClassVar[set[tuple[str, str]]] = set()

    def torque(self, t, q, dq, plant, model):
        self.seen.add((type(plant).__name__, type(model).__name__))
        return jnp.zeros_like(q)

    def jump_times(self):
        return jnp.zeros(0)


ROBOT = ij.robots.PlanarChain(mass=[1.3], length=[0.4], centre=[0.2], inertia=[0.02])
FLEXIBLE = ij.plants.FlexibleJoint(ROBOT, stiffness=300.0, motor_inertia=0.01)
WITHOUT_ROBOT = ij.plants.StrictFeedback(
    lambda t, x: jnp.stack([0.0 * x[0], -x[1]]), lambda t, x: jnp.ones_like(x), n=1, order=2
)
PARTS = {
    "the model is Rigid": (ROBOT, ij.plants.Rigid(ROBOT), "PlanarChain"),
    "the plant is a flexible joint": (FLEXIBLE, FLEXIBLE.rigid(), "WithMotors"),
    "the model has no robot": (ROBOT, WITHOUT_ROBOT, "StrictFeedback"),
    "a Rigid plant": (ij.plants.Rigid(ROBOT), WITHOUT_ROBOT, "StrictFeedback"),
}
"""Plants with their models, and the class of the model that a torque receives."""


@pytest.mark.slow
@pytest.mark.parametrize("parts", PARTS)
def test_every_user_of_a_disturbance_passes_it_the_same_plant_and_model(parts):
    """Those without a robot as they are, and of others the robot inside them."""
    plant, model, received = PARTS[parts]
    noting = Noting()
    noting.seen.clear()
    law: ij.controllers.TrackingLaw = ij.controllers.Backstepping(k1=2.0, K2=5.0)
    if not isinstance(model, ij.robots.Robot):
        law = ij.controllers.BarrierBackstepping(k=(2.0, 10.0), weights=1.0)
    both = ij.disturbances.Sum((noting, ij.disturbances.Levels((noting, noting))))
    parts = {"plant": plant, "model": model, "controller": law, "initial": ij.Initial(q=0.12)}
    walls = ij.Bounds(lower=ij.bounds.Constant(-0.1), upper=ij.bounds.Constant(0.4))
    scenario = canonical(tanks(bounds=walls, disturbance=both, **parts))
    expected = {("PlanarChain", received)}
    assert noting.seen == expected
    t, x, joint = jnp.zeros(()), start_levels(scenario), jnp.zeros(1)
    users = {"the loop": lambda s: motion(s, t, x, joint)}
    if isinstance(law, ij.controllers.Backstepping):
        point = partial(TorquePoint, t=t, state=initial_state(scenario))
        users["certify"] = lambda s: point(s).now["external"]
    if isinstance(plant, ij.robots.Robot):
        users |= {
            "replay": lambda s: acceleration(s, t, joint, joint, joint),
            "excitation": lambda s: torque_needed(s, t, joint, joint, joint),
            "cosimulate": lambda s: _delivered(s, t, joint, joint, joint, ())[1],
        }
    for name, user in users.items():
        noting.seen.clear()
        jax.eval_shape(user, scenario)
        assert noting.seen == expected, name
