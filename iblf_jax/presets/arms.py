"""Real arms: the ones that come with the package, and a scenario on any arm.

The data of an arm are what its file says, as the [robot] table of a scenario file (folder `data`,
with sources and licences); they need neither the network nor a parser of robot descriptions.

`arm_scenario` fills in what an arm's own numbers give: bounds from its joint ranges, saturation
from its largest torques, and gains in proportion to its inertia.  The inertia of a wrist is a
thousandth of a shoulder's, so one number for all joints will not do: the loop's modes are about K2
/ M, and

    K2_i = rate M_ii min(sum_j |M_ij| / M_ii, 4, 8 / max_t sum_j |R_ij|),   R = D^(1/2) M(q_d(t))^-1
    D^(1/2)

with M at the start and D its diagonal makes them `rate` on a joint that moves by itself and up to
four times that where heavier joints push it, which is what a light wrist at the end of an arm
needs.  With the last term no eigenvalue of M^-1 K2 is above eight times the rate along the
reference: joints whose axes are nearly parallel move against each other with much less inertia than
  M_ii, and a loop that is sampled at 500 Hz allows no faster modes.

The slope of the barrier is a spring besides, of stiffness w ds/de1, whatever K2 is.  With

    w_i = min(1, M_ii (rate/2)^2 / max_t ds_i/de1(e1 = 0))

that spring with a damper rate M_ii is at most critically damped at the reference, and light joints
can be sampled; 1 is the paper's weight.
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
from importlib import resources
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.barriers import Barrier
from iblf_jax.control.barriers._base import CLAIMS
from iblf_jax.control.controllers import LAWS, Controller, PDGravity, law_by_name, within_effort
from iblf_jax.control.controllers.systems import observer_of
from iblf_jax.control.observers import Momentum, Printed
from iblf_jax.core import checks
from iblf_jax.core.cache import keep_programs
from iblf_jax.simulation.scenario import Initial, Scenario, fit_joints
from iblf_jax.world import bounds as bounds_
from iblf_jax.world import disturbances, references
from iblf_jax.world.bounds import Bounds
from iblf_jax.world.disturbances import Disturbance, Nothing
from iblf_jax.world.references import Reference
from iblf_jax.world.robots import Arm, Robot
from iblf_jax.world.robots._base import mass_matrix_at

ARMS = ("ur5", "iiwa14")
"""The arms that come with the package."""

RATE = 25.0
"""1/s.  The modes of the velocity errors on every joint of `arm_scenario`."""
COUPLED = 4.0
"""How much above rate M_ii the gain of a joint may be for the inertia that couples it to others
[1]."""
FASTEST = 8.0
"""How much above `rate` the eigenvalues of M^-1 K2 may be [1]: with 4, the `iiwa14` starts with
errors that last half as long again."""
LEAST_K2 = 0.6
"""N m s/rad; above the 1/2 of Theorem 2 (3.17), for claims with the paper's own weights."""
TIMES = np.linspace(0.0, 20.0, 81)
"""Times at which tubes are looked at for where they are narrowest, and arms for where their modes
are fastest [s]."""


def arm(name: str) -> Arm:
    """An arm that comes with the package.

    Args:
      name: "ur5" (Universal Robots UR5, 6 joints) or "iiwa14" (KUKA LBR iiwa 14 R820, 7 joints).

    Raises:
      ValueError: another name.

    Source: the files in `iblf_jax/presets/data` name theirs.
    """
    checks.one_of("arm", name, ARMS)
    text = (
        resources.files("iblf_jax.presets")
        .joinpath("data", f"{name}.toml")
        .read_text(encoding="utf-8")
    )
    fields: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in tomllib.loads(text).items()
    }
    return Arm(**fields)


@jax.jit
def _start_of(reference: Reference) -> jax.Array:
    return reference.position(jnp.zeros(()))


@jax.jit
def _positions_of(reference: Reference, times: jax.Array) -> jax.Array:
    """Where a reference is at some times (T,): (T, n), or (T,) for one number for all joints
    [rad].
    """
    return jax.vmap(reference.position)(times)


def inertial_gain(robot: Robot, q: Any, rate: float = RATE, least: Any = LEAST_K2) -> jax.Array:
    """K2_i = max(rate M_ii(q), least), (n,) [N m s/rad]: about `rate` for the loop's modes on every
    joint.

    Args:
      robot: of n joints.
      q: a position that is typical of the motion, (n,) [rad].
      rate: [1/s].
      least: smallest entry, one number or one a joint [N m s/rad].
    """
    checks.conforms("robot", robot, Robot)
    given = {
        name: checks.as_floats(name, x) for name, x in (("q", q), ("rate", rate), ("least", least))
    }
    checks.shape_is("q", given["q"], (robot.n,))
    for name in ("rate", "least"):
        if given[name].shape not in ((), (robot.n,)):
            raise checks.fail(name, given[name], f"one number, or {robot.n} (one a joint)")
    inertia = jnp.diagonal(mass_matrix_at(robot, given["q"].astype(jnp.result_type(float))))
    return jnp.maximum(given["rate"] * inertia, given["least"])


def _coupled_gain(robot: Robot, reference: Reference) -> jax.Array:
    """The gain of `arm_scenario`, (n,) [N m s/rad].

    With D the diagonal of M at the start and R = D^(1/2) M^-1 D^(1/2), M^-1 K2 has the eigenvalues
    of R K2/D.  The largest sum of the sizes in a column, max_i (K2_i/D_i) sum_j |R_ji|, is above
    all of them.
    """
    positions = _positions_of(reference, jnp.asarray(TIMES, jnp.result_type(float)))
    if positions.ndim == 1:
        positions = jnp.repeat(positions[:, None], robot.n, axis=1)
    matrices = jnp.stack(
        [mass_matrix_at(robot, q) for q in positions.astype(jnp.result_type(float))]
    )
    inertia = jnp.diagonal(matrices[0])
    size = jnp.sqrt(inertia)
    coupling = jnp.sum(jnp.abs(matrices[0]), axis=1) / inertia
    sums = jnp.sum(jnp.abs(jnp.linalg.inv(matrices) * size[:, None] * size), axis=1)
    share = jnp.minimum(jnp.minimum(coupling, COUPLED), FASTEST / jnp.max(sums, axis=0))
    return RATE * inertia * share


def inertial_weight(
    robot: Robot, reference: Reference, bounds: Bounds, barrier: Barrier, rate: float = RATE
) -> jax.Array:
    """The weight of the barrier with which its slope suits the inertia of each joint, and at most
    the paper's 1.

        w_i = min(1, M_ii(q) (rate/2)^2 / max_t ds_i/de1),   at e1 = 0 and q = q_d(0)

    The slope acts as a spring of stiffness w ds/de1.  With K2 = rate M_ii it is then at most
    critically damped at the reference, on joints of any inertia and in tubes of any width.

    Args:
      robot: whose inertia counts, of n joints.
      reference: what it follows.
      bounds: of its joints.
      barrier: any `Barrier`.
      rate: of `inertial_gain` [1/s].

    Returns:
      (n,), in the unit of the law's `weight`.

    Raises:
      ValueError: something that is no robot, reference, bounds or barrier; a rate that is not
        positive.

    Source: this package.
    """
    checks.conforms("robot", robot, Robot)
    checks.conforms("reference", reference, Reference)
    checks.conforms("barrier", barrier, Barrier, optional=CLAIMS)
    if not isinstance(bounds, Bounds):
        raise checks.fail(
            "bounds",
            bounds,
            "a Bounds",
            "Such as Bounds(lower=Constant(0.1), upper=Constant(0.9)).",
        )
    rate = checks.positive_number("rate", rate, "1/s")
    reference, bounds = (
        fit_joints(part, robot.n, name)
        for part, name in ((reference, "reference"), (bounds, "bounds"))
    )
    inertia = jnp.diagonal(mass_matrix_at(robot, _start_of(reference)))
    needed = (
        inertia
        * (0.5 * rate) ** 2
        / _stiffness(barrier, reference, bounds, jnp.asarray(TIMES, inertia.dtype))
    )
    return jnp.minimum(needed, 1.0)


@jax.jit
def _stiffness(
    barrier: Barrier, reference: Reference, bounds: Bounds, times: jax.Array
) -> jax.Array:
    """The largest ds/de1 of each joint at e1 = 0 and these times, (n,); where a tube is closed it
    does not count.
    """

    def at(t):
        tube = bounds_.tube_at(reference, bounds, t, acceleration=False)
        stiffness = jax.jvp(
            lambda q: barrier.slope(tube, q), (tube.q_d,), (jnp.ones_like(tube.q_d),)
        )[1]
        return jnp.where((tube.k_l > 0) & (tube.k_u > 0), stiffness, 0.0)

    return jnp.max(jax.vmap(at)(times), axis=0)


def arm_scenario(
    robot: Robot,
    reference: Reference,
    *,
    law: str = "integral",
    reading: str = "corrected",
    bounds: Bounds | None = None,
    disturbance: Disturbance | None = None,
    initial: Initial | None = None,
    model: Robot | None = None,
) -> Scenario:
    """A scenario on an arm, with what follows from the arm's own numbers: bounds, saturation,
    gains.

    k1 = 2; K2_i = 25 min(sum_j |M_ij|, 4 M_ii) with M at the start, less where joints that move
    against each other would have modes of M^-1 K2 above 200 1/s along the reference; the barrier's
    weight as `inertial_weight`; kf = 20; the law within the arm's `effort`; bounds at its joint
    limits; a start on the reference at rest.

    Args:
      robot: with `limits` and `effort`, such as `iblf_jax.robots.load` gives; it is the plant.
      reference: what it should do.
      law, reading: as for `iblf_jax.presets.zhang_yan_2024`.
      bounds: in place of the joint limits.
      disturbance: what acts on it; nothing if not given.
      initial: where it starts.
      model: what the law knows, if not the plant.

    Returns:
      A Scenario; every number in it is a leaf to change.

    Raises:
      ValueError: an unknown law or reading; a joint without limits and no bounds given.

    Source: this package.
    """
    checks.one_of("law", law, LAWS)
    checks.one_of("reading", reading, ("printed", "corrected"))
    checks.conforms("robot", robot, Robot)
    checks.conforms("reference", reference, Reference)
    keep_programs()
    start = _start_of(reference)
    known = robot if model is None else model
    bounds = bounds if bounds is not None else bounds_.from_limits(robot)
    K2 = _coupled_gain(known, reference)
    if law == "pd":  # its gains by name are for one size of joint
        controller: Controller = PDGravity(Kp=3.0 * K2, Kd=K2)
    else:
        controller = law_by_name(law, k1=2.0, K2=K2, o=0.1, reading=reading, p=1)
    if "weight" in getattr(type(controller), "unit_factors", ()):
        weight = inertial_weight(known, reference, bounds, controller.barrier)  # type: ignore[attr-defined]
        controller = dataclasses.replace(controller, weight=weight)  # type: ignore[type-var]
    return Scenario(
        plant=robot,
        model=model,  # type: ignore[arg-type]
        reference=reference,
        bounds=bounds,
        disturbance=disturbance if disturbance is not None else Nothing(),
        controller=within_effort(controller, robot),
        observer=observer_of(law, (Printed if reading == "printed" else Momentum)(kf=20.0)),
        initial=initial if initial is not None else Initial(q=start),
    )


def ur5(*, law: str = "integral", reading: str = "corrected", payload: float = 2.0) -> Scenario:
    """A Universal Robots UR5 that swings its tool through half a metre, with a payload that its
    model does not know.

    Every joint has its own frequency and range; the bounds are 0.25 to 0.5 rad around them, other
    above than below, move with time, and are inside the joint limits.  The law stays within the
    actuators' torques, and the disturbance is about 3 % of these.

    Args:
      law, reading: as `zhang_yan_2024`; gains as `iblf_jax.presets.arms.arm_scenario`.
      payload: at the tip of the plant; the model has none [kg].  (The maker allows 5 kg.)

    Returns:
      A Scenario of 6 joints; 10 s show it.

    Raises:
      ValueError: an unknown law or reading, or a negative payload.

    Source: this package; the arm as `iblf_jax.presets.arms.arm` says.
    """
    return _swinging(
        arm("ur5"),
        middle=[0.0, -1.2, 1.6, -1.4, -1.57, 0.0],
        amplitude=[0.7, 0.35, 0.5, 0.5, 0.4, 0.8],
        frequency=[0.6, 0.9, 0.7, 1.0, 0.8, 1.1],
        push=[4.0, 4.0, 4.0, 0.8, 0.8, 0.5],
        payload=payload,
        law=law,
        reading=reading,
    )


def iiwa14(*, law: str = "integral", reading: str = "corrected", payload: float = 3.0) -> Scenario:
    """A KUKA LBR iiwa 14 that swings its flange through half a metre, with a payload that its model
    does not know.

    As `ur5`, for 7 joints.  The maker allows a payload of 14 kg.

    Args:
      law, reading: as `zhang_yan_2024`; gains as `iblf_jax.presets.arms.arm_scenario`.
      payload: at the tip of the plant; the model has none [kg].

    Returns:
      A Scenario of 7 joints; 10 s show it.

    Raises:
      ValueError: an unknown law or reading, or a negative payload.

    Source: this package; the arm as `iblf_jax.presets.arms.arm` says.
    """
    return _swinging(
        arm("iiwa14"),
        middle=[0.0, 0.6, 0.0, -1.1, 0.0, 0.9, 0.0],
        amplitude=[0.6, 0.35, 0.5, 0.4, 0.5, 0.4, 0.6],
        frequency=[0.6, 0.9, 0.7, 1.0, 0.8, 1.1, 0.75],
        push=[6.0, 6.0, 4.0, 4.0, 0.3, 0.3, 0.1],
        payload=payload,
        law=law,
        reading=reading,
    )


def _swinging(
    robot: Arm,
    middle: Any,
    amplitude: Any,
    frequency: Any,
    push: Any,
    payload: float,
    law: str,
    reading: str,
) -> Scenario:
    """A scenario in which every joint swings as a cosine, from rest, inside bounds that move."""
    middle, amplitude, frequency = (np.asarray(x, float) for x in (middle, amplitude, frequency))
    quarter = math.pi / 2
    reference = references.Sinusoid(
        offset=middle, amplitude=amplitude, frequency=frequency, phase=quarter
    )
    lower = bounds_.Sinusoid(
        offset=middle - amplitude - 0.4, amplitude=0.1, frequency=0.5, phase=quarter
    )
    upper = bounds_.Sinusoid(offset=middle + amplitude + 0.3, amplitude=0.05, frequency=0.8)
    return arm_scenario(
        dataclasses.replace(robot, payload=payload),
        reference,
        law=law,
        reading=reading,
        bounds=Bounds(lower=lower, upper=upper),
        disturbance=disturbances.Sinusoids(
            amplitude=push, frequency=2.0, phase=np.linspace(0.0, 3.0, robot.n)
        ),
        initial=Initial(q=middle + amplitude - 0.1),
        model=robot,
    )
