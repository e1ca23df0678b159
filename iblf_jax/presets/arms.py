"""Models of real arms, and scenarios on any arm.

The data of an arm are stored as the [robot] table of a scenario file (folder `data`, with sources
and licences); they need neither the network nor a parser of robot descriptions.

`arm_scenario` derives a scenario from the numbers of an arm: bounds from the joint ranges,
saturation from the largest torques, and gains proportional to the inertia.  The inertia of a wrist
is a thousandth of that of a shoulder, so that one gain does not suit all joints.  The modes of the
loop are about K2 / M.  With

    K2_i = rate M_ii min(sum_j |M_ij| / M_ii, 4, 8 / max_t sum_j |R_ij|),
    R = D^(1/2) M(q_d(t))^-1 D^(1/2),

where M is evaluated at the start and D is its diagonal, the modes are `rate` on a joint without
coupling, and up to four times that on a joint that is coupled to heavier ones, as required for a
light wrist.  The last term keeps the eigenvalues of M^-1 K2 below eight times the rate along the
reference: joints with nearly parallel axes move against each other with much less inertia than
M_ii, and a loop that is sampled at 500 Hz allows no faster modes.

The slope of the barrier acts as a spring of stiffness w ds/de1, independently of K2.  With

    w_i = min(1, M_ii (rate/2)^2 / max_t ds_i/de1(e1 = 0)),

where ds/de1 is that of the side with the nearer bound, this spring and a damper rate M_ii are at
least critically damped at the reference, so that light joints can be sampled.  The paper's weight
is 1.
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
from numpy.typing import ArrayLike

from iblf_jax.control.barriers import Barrier
from iblf_jax.control.controllers import LAWS, PDGravity, TrackingLaw, law_by_name, within_effort
from iblf_jax.control.controllers.systems import observer_of
from iblf_jax.control.observers import AsPublished, Momentum
from iblf_jax.core import checks
from iblf_jax.core.disk_cache import keep_programs
from iblf_jax.core.progress import announced
from iblf_jax.simulation.initial import Initial
from iblf_jax.simulation.scenario import Scenario, fit_joints
from iblf_jax.world import disturbances, references
from iblf_jax.world.bounds import Bounds, from_limits, tube_at
from iblf_jax.world.bounds import Sinusoid as SinusoidalBound
from iblf_jax.world.disturbances import Disturbance, Nothing
from iblf_jax.world.references import Reference
from iblf_jax.world.robots import Arm, Robot
from iblf_jax.world.robots._base import mass_matrix_at

ARMS = ("ur5", "iiwa14")
"""The arms that come with the package."""

RATE = 25.0
"""Modes of the velocity errors on every joint of `arm_scenario` [1/s]."""
COUPLED = 4.0
"""Largest ratio of the gain of a joint to rate M_ii, for joints that are coupled to others [1]."""
FASTEST = 8.0
"""Largest ratio of the eigenvalues of M^-1 K2 to `rate` [1]; with 4, the initial errors of the
`iiwa14` last 1.5 times as long."""
MIN_K2 = 0.6
"""Smallest gain [N m s/rad]; above the 1/2 of Theorem 2 (3.17), for claims with the paper's
weights."""
TIMES = np.linspace(0.0, 20.0, 81)
"""Times at which the fastest modes are sought [s]."""
FINE_TIMES = np.linspace(0.0, 20.0, 2001)
"""Times at which the nearest bound is sought [s].  A reference at 1 rad/s moves 0.01 rad between
them; the slope of a barrier at a bound 0.1 rad away then differs by at most a tenth."""
OBSERVERS: dict[str, Any] = {"printed": AsPublished, "corrected": Momentum}
"""Reading of the paper -> its observer."""


def arm(name: str) -> Arm:
    """An arm that comes with the package.

    Args:
      name: "ur5" (Universal Robots UR5, 6 joints) or "iiwa14" (KUKA LBR iiwa 14 R820, 7 joints).

    Raises:
      ValueError: another name.

    Source: the files in `iblf_jax/presets/data` name theirs.
    """
    checks.one_of("arm", name, ARMS)
    file = resources.files("iblf_jax.presets").joinpath("data", f"{name}.toml")
    fields: dict[str, Any] = tomllib.loads(file.read_text(encoding="utf-8"))
    for key, value in fields.items():
        if isinstance(value, list):
            fields[key] = tuple(value)
    return Arm(**fields)


@jax.jit
def _start_of(reference: Reference) -> jax.Array:
    return reference.position(jnp.zeros(()))


@jax.jit
def _positions_of(reference: Reference, times: jax.Array) -> jax.Array:
    """Positions of a reference at times (T,): (T, n), or (T,) if all joints share one [rad]."""
    return jax.vmap(reference.position)(times)


def inertial_gain(
    robot: Robot, q: ArrayLike, rate: float = RATE, least: ArrayLike = MIN_K2
) -> jax.Array:
    """The gain with which the modes of the loop are about `rate` on every joint.

        K2_i = max(rate M_ii(q), least)

    Args:
      robot: a robot of n joints.
      q: a typical position of the motion, (n,) [rad].
      rate: modes of the loop [1/s].
      least: smallest entry, one number or one per joint [N m s/rad].

    Returns:
      (n,) [N m s/rad].
    """
    checks.conforms("robot", robot, Robot)
    position = checks.as_floats("q", q)
    checks.shape_is("q", position, (robot.n,))
    numbers = {"rate": checks.as_floats("rate", rate), "least": checks.as_floats("least", least)}
    for name, value in numbers.items():
        if value.shape not in ((), (robot.n,)):
            raise checks.fail(name, value, f"one number, or {robot.n} (one per joint)")
    inertia = jnp.diagonal(mass_matrix_at(robot, position.astype(jnp.result_type(float))))
    return jnp.maximum(numbers["rate"] * inertia, numbers["least"])


def _coupled_gain(robot: Robot, reference: Reference) -> np.ndarray:
    """The gain of `arm_scenario`, (n,) [N m s/rad].

    With D the diagonal of M at the start and R = D^(1/2) M^-1 D^(1/2), M^-1 K2 has the eigenvalues
    of R K2/D.  The largest absolute column sum, max_i (K2_i/D_i) sum_j |R_ji|, bounds all of them.
    """
    positions = _positions_of(reference, jnp.asarray(TIMES, jnp.result_type(float)))
    if positions.ndim == 1:
        positions = jnp.repeat(positions[:, None], robot.n, axis=1)
    # By NumPy after the matrices: XLA would compile a program for each operation.
    separate = np.asarray(positions.astype(jnp.result_type(float)))
    matrices = np.stack([np.asarray(mass_matrix_at(robot, q)) for q in separate])
    least = np.linalg.eigvalsh(matrices)[:, 0]
    if not np.all(least > 0.0):
        first = np.argmin(least)
        expected = f"a positive definite matrix on the reference, as at t = {TIMES[first]:g} s"
        remedy = "Check the masses, lengths and inertias."
        raise checks.fail("robot.mass_matrix(q)", matrices[first], expected, remedy)
    inertia = np.diagonal(matrices[0])
    size = np.sqrt(inertia)
    coupling = np.sum(np.abs(matrices[0]), axis=1) / inertia
    sums = np.sum(np.abs(np.linalg.inv(matrices) * size[:, None] * size), axis=1)
    share = np.minimum(np.minimum(coupling, COUPLED), FASTEST / np.max(sums, axis=0))
    return RATE * inertia * share


def inertial_weight(
    robot: Robot, reference: Reference, bounds: Bounds, barrier: Barrier, rate: float = RATE
) -> jax.Array:
    """The weight of the barrier that limits its slope according to the inertia of each joint; at
    most the paper's 1.

        w_i = min(1, M_ii(q) (rate/2)^2 / max_t ds_i/de1),   at e1 = 0 and q = q_d(0)

    The slope acts as a spring of stiffness w ds/de1, which is taken on the side of the tube where
    it is larger.  With K2 = rate M_ii the spring is at least critically damped at the reference,
    for joints of any inertia and bounds of any width.

    Args:
      robot: the robot of n joints that provides the inertia.
      reference: the reference.
      bounds: bounds of the joints.
      barrier: any `Barrier`.
      rate: as for `inertial_gain` [1/s].

    Returns:
      (n,), in the unit of the law's `weight`.

    Raises:
      ValueError: an argument of another class, or a rate that is not positive.

    Source: this package.
    """
    checks.conforms("robot", robot, Robot)
    checks.conforms("reference", reference, Reference)
    checks.conforms("barrier", barrier, Barrier)
    if not isinstance(bounds, Bounds):
        raise checks.fail(
            "bounds",
            bounds,
            "a Bounds",
            "Such as Bounds(lower=Constant(0.1), upper=Constant(0.9)).",
        )
    rate = checks.positive_number("rate", rate, "1/s")
    reference = fit_joints(reference, robot.n, "reference")
    bounds = fit_joints(bounds, robot.n, "bounds")
    inertia = jnp.diagonal(mass_matrix_at(robot, _start_of(reference)))
    stiffness = _stiffness(barrier, reference, bounds, jnp.asarray(FINE_TIMES, inertia.dtype))
    return jnp.minimum(inertia * (0.5 * rate) ** 2 / stiffness, 1.0)


@jax.jit
def _stiffness(
    barrier: Barrier, reference: Reference, bounds: Bounds, times: jax.Array
) -> jax.Array:
    """The largest ds/de1 of each joint at e1 = 0, on both sides and at these times, (n,), while
    lower and upper bound leave room for the reference.
    """

    def on_one_side(tube):
        unit = jnp.ones_like(tube.q_d)
        return jax.jvp(lambda q: barrier.slope(tube, q), (tube.q_d,), (unit,))[1]

    def at(t):
        tube = tube_at(reference, bounds, t, acceleration=False)
        # At e1 = 0 the derivative is that of one side; the other side is that of the mirrored tube.
        mirrored = tube._replace(
            lower=tube.q_d - tube.k_u,
            upper=tube.q_d + tube.k_l,
            dlower=tube.dq_d - tube.dk_u,
            dupper=tube.dq_d + tube.dk_l,
        )
        stiffness = jnp.maximum(on_one_side(tube), on_one_side(mirrored))
        return jnp.where((tube.k_l > 0) & (tube.k_u > 0), stiffness, 0.0)

    return jnp.max(jax.vmap(at)(times), axis=0)


@announced("computing the gains of an arm")
def arm_scenario(
    robot: Robot,
    reference: Reference,
    *,
    law: str = "integral",
    variant: str = "corrected",
    bounds: Bounds | None = None,
    disturbance: Disturbance | None = None,
    initial: Initial | None = None,
    model: Robot | None = None,
) -> Scenario:
    """A scenario on an arm, with bounds, saturation and gains from the arm's numbers.

    The gains are k1 = 2; K2_i = 25 min(sum_j |M_ij|, 4 M_ii) with M at the start, reduced if joints
    that move against each other would have modes of M^-1 K2 above 200 1/s along the reference; and
    kf = 20.  The weight of the barrier is w_i = min(1, M_ii 12.5^2 / s_i') with the largest slope
    s_i' of the barrier at the reference, which is that at the nearest bound.  The torque is limited
    to the arm's `effort`; its `speed` is not checked (`bounds[1]` of `Scenario`).

    Args:
      robot: the plant, with `limits` and `effort`, as `iblf_jax.robots.load` returns it.
      reference: the reference.
      law, variant: as for `iblf_jax.presets.zhang_yan_2024`.
      bounds: bounds of the joints; the joint limits if not given.
      disturbance: the disturbance; none if not given.
      initial: the initial state; at rest on the reference if not given.
      model: the robot that the law knows; the plant if not given.

    Returns:
      A Scenario; all its numbers are leaves.

    Raises:
      ValueError: an unknown law or variant; a joint without limits and no bounds given; a mass
        matrix that is not positive definite on the reference.

    Source: this package.
    """
    checks.one_of("law", law, LAWS)
    checks.one_of("variant", variant, ("printed", "corrected"))
    checks.conforms("robot", robot, Robot)
    checks.conforms("reference", reference, Reference)
    keep_programs()
    start = _start_of(reference)
    if bounds is None:
        bounds = from_limits(robot)
    if disturbance is None:
        disturbance = Nothing()
    if initial is None:
        initial = Initial(q=start)
    controller = _arm_law(robot if model is None else model, reference, bounds, law, variant)
    return Scenario(
        plant=robot,
        model=model,  # type: ignore[arg-type]
        reference=reference,
        bounds=bounds,
        disturbance=disturbance,
        controller=within_effort(controller, robot),
        observer=observer_of(law, OBSERVERS[variant](kf=20.0)),
        initial=initial,
    )


def _arm_law(
    model: Robot, reference: Reference, bounds: Bounds, law: str, variant: str
) -> TrackingLaw:
    """The law of `arm_scenario`, without saturation."""
    K2 = _coupled_gain(model, reference)
    if law == "pd":  # The default gains of "pd" are for one size of joint.
        return PDGravity(Kp=3.0 * K2, Kd=K2)
    controller: Any = law_by_name(law, k1=2.0, K2=K2, o=0.1, variant=variant, p=1)
    if "weight" in type(controller).factors:
        weight = inertial_weight(model, reference, bounds, controller.barrier)
        controller = dataclasses.replace(controller, weight=weight)
    return controller


def ur5(*, law: str = "integral", variant: str = "corrected", payload: float = 2.0) -> Scenario:
    """A Universal Robots UR5 that moves its tool through half a metre, with a payload that its
    model does not contain.

    Every joint has its own frequency and amplitude.  The bounds are at 0.25 to 0.5 rad from the
    reference, differ above and below, vary with time, and lie inside the joint limits.  The law
    respects the torque limits of the actuators, and the disturbance is about 3 % of these.

    Args:
      law, variant: as for `zhang_yan_2024`; gains as in `iblf_jax.presets.arms.arm_scenario`.
      payload: mass at the tip of the plant, which the model does not contain [kg].  (The
        manufacturer allows 5 kg.)

    Returns:
      A Scenario of 6 joints, for runs of 10 s.

    Raises:
      ValueError: an unknown law or variant, or a negative payload.

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
        variant=variant,
    )


def iiwa14(*, law: str = "integral", variant: str = "corrected", payload: float = 3.0) -> Scenario:
    """A KUKA LBR iiwa 14 that moves its flange through half a metre, with a payload that its model
    does not contain.

    Motion and bounds are chosen as for `ur5`.  The manufacturer allows a payload of 14 kg.

    Args:
      law, variant: as for `zhang_yan_2024`; gains as in `iblf_jax.presets.arms.arm_scenario`.
      payload: mass at the tip of the plant, which the model does not contain [kg].

    Returns:
      A Scenario of 7 joints, for runs of 10 s.

    Raises:
      ValueError: an unknown law or variant, or a negative payload.

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
        variant=variant,
    )


def _swinging(
    robot: Arm,
    middle: ArrayLike,
    amplitude: ArrayLike,
    frequency: ArrayLike,
    push: ArrayLike,
    payload: float,
    law: str,
    variant: str,
) -> Scenario:
    """A scenario in which every joint follows a cosine, from rest, between time-varying bounds."""
    middle = np.asarray(middle)
    amplitude = np.asarray(amplitude)
    quarter = math.pi / 2
    reference = references.Sinusoid(
        offset=middle, amplitude=amplitude, frequency=frequency, phase=quarter
    )
    lowest = middle - amplitude - 0.4
    lower = SinusoidalBound(offset=lowest, amplitude=0.1, frequency=0.5, phase=quarter)
    upper = SinusoidalBound(offset=middle + amplitude + 0.3, amplitude=0.05, frequency=0.8)
    return arm_scenario(
        dataclasses.replace(robot, payload=payload),
        reference,
        law=law,
        variant=variant,
        bounds=Bounds(lower=lower, upper=upper),
        disturbance=disturbances.Sinusoids(
            amplitude=push, frequency=2.0, phase=np.linspace(0.0, 3.0, robot.n)
        ),
        initial=Initial(q=middle + amplitude - 0.1),
        model=robot,
    )
