"""One instance, or a few, of every member of every family: the contract tests run over these lists.

Whoever adds a member adds it here; `test_contracts.test_every_member_is_listed` notices if not.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp
import users_functions
from arm_cases import random_arm

import iblf_jax as ij
from iblf_jax import (
    actuators,
    barriers,
    bounds,
    controllers,
    decays,
    disturbances,
    observers,
    plants,
    process_noise,
    references,
    regions,
    robots,
    sensors,
)
from iblf_jax.core.pytree import unwrapped
from iblf_jax.simulation import metrics

TWO_LINK = ij.presets.customary_two_link()

ROBOTS = {
    "two_link": TWO_LINK,
    "two_link_payload": robots.TwoLink(
        mass=[1.0, 2.0],
        length=[0.5, 0.4],
        centre=[0.2, 0.3],
        inertia=[0.02, 0.01],
        payload=0.7,
        g=1.62,
    ),
    "chain_1": robots.PlanarChain(mass=[1.3], length=[0.4], centre=[0.2], inertia=[0.02]),
    "chain_3": robots.PlanarChain(
        mass=[2.0, 1.0, 0.5],
        length=[0.4, 0.3, 0.2],
        centre=[0.2, 0.15, 0.1],
        inertia=0.01,
        payload=0.3,
    ),
    "arm": random_arm(3, seed=1, armature=0.1, payload=0.4),
    "with_motors": robots.WithMotors(TWO_LINK, inertia=[0.02, 0.01], damping=0.1),
}

PLANTS = {
    "rigid": plants.Rigid(TWO_LINK),
    "driven_pendulum": ij.presets.motor_driven_pendulum().plant,
    "electric_drive": plants.ElectricDrive(
        TWO_LINK, torque_constant=[0.9, 0.5], inductance=0.025, resistance=5.0, back_emf=0.9
    ),
    "flexible_joint": plants.FlexibleJoint(
        TWO_LINK, stiffness=[300.0, 200.0], motor_inertia=0.02, motor_damping=0.1
    ),
    "vessel": ij.presets.cybership_ii(),
    "vessel_moored": dataclasses.replace(
        ij.presets.cybership_ii(),
        restoring=plants.Mooring(stiffness=[3.0, 5.0, 0.8], position=[0.2, -0.1, 0.3]),
    ),
    "switched": plants.Switched(
        ij.presets.motor_driven_pendulum().plant, {"D": (1.0, 1.5, 0.8)}, times=[0.3, 0.9]
    ),
    "markov_switched": plants.MarkovSwitched(
        ij.presets.cybership_ii(),
        {"mass": (23.8, 30.0)},
        rates=[[-2.0, 2.0], [1.0, -1.0]],
        switches=3,
    ),
    "strict_feedback": plants.StrictFeedback(
        drift=users_functions.coupled_drift,
        gain=users_functions.coupled_gain,
        n=2,
        order=2,
        units=(("m", "rad"), "1/s", "N"),
        component_names=("cart", "pole"),
    ),
    "strict_feedback_diagonal": plants.StrictFeedback(
        drift=users_functions.diagonal_drift,
        gain=users_functions.diagonal_gain,
        n=1,
        order=3,
    ),
}

PAIR = plants.Agents(
    agents=(
        robots.PlanarChain(mass=[1.3], length=[0.4], centre=[0.2], inertia=[0.02]),
        robots.PlanarChain(mass=[0.9], length=[0.5], centre=[0.3], inertia=[0.01]),
    ),
    adjacency=((0.0, 0.5), (1.0, 0.0)),
    leader=(1.0, 0.0),
)
PLANTS |= {"agents": PAIR, "neighbour_model": PAIR.neighbours()}

REFERENCES = {
    "leader": references.Leader(
        motion=references.Sinusoid(offset=0.5, amplitude=0.14), weights=(1.0, 0.4), components=1
    ),
    "sinusoid": references.Sinusoid(0.5, [0.14, 0.1], frequency=1.0, phase=[0.0, 1.57]),
    "quintic": references.Quintic(start=[0.1, 0.2], end=[0.8, -0.3], duration=3.0),
    "smooth_step": references.SmoothStep(start=[0.1, 0.2], end=[0.8, -0.3], duration=3.0),
    "ellipse": references.Ellipse(axes=(5.0, 3.0), frequency=0.4, centre=(1.0, -2.0)),
    "waypoint_spline": references.WaypointSpline(
        times=(0.0, 1.0, 2.5, 4.0), waypoints=[[0.0, 0.1], [0.4, 0.3], [0.2, 0.8], [0.5, 0.5]]
    ),
}

SIDES = {
    "constant": bounds.Constant([0.9, 1.2]),
    "sinusoid": bounds.Sinusoid([0.9, 0.8], 0.14, frequency=1.0, phase=[1.57, 0.0]),
    "funnel": bounds.Funnel(initial=0.5, final=[0.1, 0.2], rate=1.5),
}

REGIONS = {
    "half_space": regions.HalfSpace(normal=[1.0, -2.0], offset=-0.6),
    "half_space_of_the_elbow": regions.HalfSpace(normal=[0.0, 0.0, 2.0], offset=0.1, point=1),
    "sphere": regions.Sphere(centre=[0.2, 0.4], radius=0.1),
    "sphere_inside": regions.Sphere(centre=[0.2, 0.4, 0.1], radius=0.9, keep="inside"),
}

DISTURBANCES = {
    "nothing": disturbances.Nothing(),
    "model_shaped": ij.presets.zhang_yan_2024().disturbance,
    "sinusoids": disturbances.Sinusoids([1.0, 2.0], 3.0, phase=[0.0, 0.4], offset=0.2),
    "step": disturbances.Step(size=[1.0, -0.5], time=5.0),
    "tip_force": disturbances.TipForce([1.0, 2.0], [1.0, 0.5], phase=0.3, offset=[0.0, -1.0]),
    "friction": disturbances.Friction(viscous=[0.1, 0.2], coulomb=0.3, width=0.05),
    "sum": disturbances.Sum(
        (disturbances.Friction(viscous=0.1), disturbances.Step(size=1.0, time=2.0))
    ),
    "levels": disturbances.Levels((None, disturbances.Step(size=1.0, time=2.0))),
    "sum_of_none": disturbances.Sum(()),
}

PROCESS_NOISES = {
    "additive": process_noise.Additive([[0.3, 0.2], [0.1, 0.4]], levels=(1, 3)),
    "proportional": process_noise.Proportional([[0.3, 0.2]], substeps=2),
    "diffusion": process_noise.Diffusion(users_functions.fading_noise),
    "diffusion_additive": process_noise.Diffusion(users_functions.periodic_noise, additive=True),
}

BARRIERS = {
    "integral": barriers.Integral(),
    "log": barriers.Log(),
    "tan": barriers.Tan(),
    "state": barriers.StateBarrier(),
    "prescribed_performance": barriers.PrescribedPerformance(),
    "mapping": barriers.TransformedError(),
    "quadratic": barriers.Quadratic(),
}

DECAYS = {
    "exponential": decays.Exponential(),
    "finite_time": decays.FiniteTime(k_a=[2.0, 1.0], a=0.4, delta=[0.02, 0.01]),
    "fixed_time": decays.FixedTime(k_a=2.0, k_b=[1.0, 0.5], a=[0.3, 0.5]),
    "prescribed_time": decays.PrescribedTime(T=[0.9, 1.2], gain=3.0, cap=[30.0, 40.0]),
}

OBSERVERS = {
    "none": observers.NoObserver(),
    "printed": observers.AsPublished(kf=[20.0, 10.0]),
    "printed_matched": observers.AsPublished(kf=20.0, eta0=[0.1, -0.2], start="matched"),
    "momentum": observers.Momentum(kf=[20.0, 10.0]),
    "extended_state": observers.ExtendedState(bandwidth=[40.0, 30.0]),
    "extended_state_two_gains": observers.ExtendedState(l1=80.0, l2=[1600.0, 900.0]),
}

LEVEL_OBSERVERS = {
    "level": observers.LevelObserver(gain=(0.0, [20.0, 10.0], 30.0), eta0=(0.0, 0.1, 0.2)),
    "state_observer": observers.StateObserver(bandwidth=[40.0, 30.0], offset=(0.0, 0.1, 0.2, 0.0)),
    "state_observer_two_encoders": observers.StateObserver(
        bandwidth=200.0, measured=(1, 3), disturbance=False
    ),
    "state_observer_limited": observers.StateObserver(40.0, limit=5.0, disturbance_limit=50.0),
}
"""Observers of plants in strict-feedback form, some of more levels than a robot has."""

VELOCITIES = {
    "measured": sensors.Measured(noise=[0.01, 0.02]),
    "filtered_difference": sensors.FilteredDifference(cutoff=[200.0, 300.0]),
    "tracking": sensors.Tracking(bandwidth=100.0),
}

SENSORS = {
    "ideal": sensors.Ideal(),
    **{
        f"encoder_{name}": sensors.Encoder(counts=4096, offset=[0.1, 0.0], noise=1e-4, velocity=v)
        for name, v in VELOCITIES.items()
    },
}

SENSORS |= {
    "levels": sensors.Levels((SENSORS["encoder_tracking"], sensors.Direct(noise=[0.1, 0.2]))),
    "levels_encoders": sensors.Levels(
        (SENSORS["encoder_filtered_difference"], SENSORS["encoder_measured"])
    ),
    "levels_unmeasured": sensors.Levels((sensors.Direct(resolution=1e-3, offset=0.1), None)),
}

ACTUATORS = {
    "ideal": actuators.Ideal(),
    "motor_two_limits": actuators.Motor(limit=[40.0, 20.0], lower_limit=[-30.0, -5.0]),
    "chain": actuators.Chain(
        (
            actuators.Motor(bandwidth=900.0, limit=[40.0, 20.0]),
            actuators.Ideal(),
            actuators.Motor(bandwidth=300.0),
        )
    ),
    "fault": actuators.Fault(effectiveness=[0.7, 0.5], bias=[0.3, -0.2], time=0.5),
    "dead_zone": actuators.DeadZone(lower=[-0.2, -0.4], upper=[0.5, 0.3], slope=[0.9, 1.1]),
    "quantiser": actuators.Quantiser(step=[0.01, 0.02]),
    "backlash": actuators.Backlash(gap=[0.2, 0.1], bandwidth=400.0),
    "delay": actuators.Delay(delay=3e-3),
    "delay_chain": actuators.Chain(
        (actuators.Delay(delay=3e-3), actuators.Fault(effectiveness=0.8, time=0.1))
    ),
    "motor": actuators.Motor(
        bandwidth=300.0,
        limit=[40.0, 20.0],
        rate_limit=500.0,
        stall=[40.0, 20.0],
        no_load_speed=[6.0, 8.0],
    ),
}

SURFACE = bounds.Bounds(
    lower=bounds.Funnel(initial=-9.0, final=-0.5, rate=1.5), upper=bounds.Constant([8.0, 6.0])
)


def two_barriers(
    k1: Any = 2.0,
    K2: Any = 20.0,
    c: Any = 1.0,
    first: Any = None,
    second: Any = None,
    weight: Any = 1.0,
    **fields: Any,
) -> controllers.BarrierBackstepping:
    """The law of a robot with a barrier on the positions and one on the velocities, integral ones
    if not given; K2 in 1/s.
    """
    both = tuple(barriers.Integral() if x is None else x for x in (first, second))
    weights = (weight, 1.0)
    return controllers.BarrierBackstepping(
        k=(k1, K2), barriers=both, c=(0.0, c), weights=weights, **fields
    )


def keeps_velocities(law: Any) -> bool:
    """Whether a law has a barrier on the second level of a plant."""
    return any(not isinstance(x, barriers.Quadratic) for x in unwrapped(law).barriers[1:2])


def velocities_squared(t: Any, x: Any) -> Any:
    """A regressor: q' and |q'| q' on the second level, 0 on the first."""
    known = jnp.stack([x[1], jnp.abs(x[1]) * x[1]], axis=-1)
    return jnp.stack([jnp.zeros_like(known), known])


LAWS = {
    "backstepping": controllers.Backstepping(k1=2.0, K2=20.0, o=0.1),
    "backstepping_corrected_log": controllers.Backstepping(
        k1=[2.0, 3.0],
        K2=[20.0, 15.0],
        o=0.1,
        barrier=barriers.Log(p=2),
        variant="corrected",
        gain_matrix=[[1.0, 0.3], [-0.1, 0.9]],
    ),
    "barrier_backstepping": controllers.BarrierBackstepping(k=(2.0, [20.0, 15.0])),
    "barrier_backstepping_compensated": controllers.BarrierBackstepping(
        k=(2.0, [20.0, 15.0]), filter=0.02, filter_form="compensated"
    ),
    "barrier_backstepping_damped": controllers.BarrierBackstepping(
        k=(2.0, 20.0),
        barriers=(barriers.Tan(),),
        c=(0.0, 0.1),
        weights=[[1.0, 2.0], [0.5, 0.1]],
        damping=(0.0, 0.3),
        regressor=velocities_squared,
    ),
    "barrier_backstepping_matrices": controllers.BarrierBackstepping(
        k=(2.0, 1.0),
        gain_matrices=[[[1.0, 0.0], [0.0, 1.0]], [[40.0, 6.0], [2.0, 20.0]]],
        weight_matrices=[[[1.0, 0.0], [0.0, 1.0]], [[2.0, 0.3], [0.3, 0.7]]],
    ),
    "backstepping_decays": controllers.Backstepping(
        k1=2.0,
        K2=[20.0, 15.0],
        barrier=barriers.TransformedError(),
        variant="corrected",
        decays=(DECAYS["finite_time"], decays.PrescribedTime(T=1.0)),
    ),
    "barrier_backstepping_velocities": two_barriers(K2=[20.0, 15.0], o=0.1),
    "barrier_backstepping_mixed": two_barriers(
        first=barriers.Tan(), second=barriers.PrescribedPerformance(), weight=[0.5, 2.0]
    ),
    "dynamic_surface": controllers.DynamicSurface(
        k1=2.0, K2=[20.0, 15.0], filter=[0.02, 0.03], o=0.1, weight=[0.5, 2.0]
    ),
    "dynamic_surface_compensated": controllers.DynamicSurface(
        k1=2.0, K2=[20.0, 15.0], filter=[0.02, 0.03], filter_form="compensated"
    ),
    "adaptive_rbf": controllers.AdaptiveRBF(k1=2.0, K2=[20.0, 15.0], o=0.1, nodes=8),
    "adaptive_rbf_fuzzy": controllers.AdaptiveRBF(
        k1=2.0, K2=[20.0, 15.0], nodes=8, barrier=barriers.PrescribedPerformance(), normalised=True
    ),
    "adaptive_network": controllers.AdaptiveNetwork(
        k1=2.0, K2=[20.0, 15.0], nodes=4, barrier=barriers.TransformedError(), weight=[0.5, 2.0]
    ),
    "adaptive_parameters": controllers.AdaptiveParameters(
        law=controllers.Backstepping(k1=2.0, K2=[20.0, 15.0], variant="corrected"),
        parameters=("mass[0]", "payload"),
        Gamma=[3.0, 2.0],
        lower=-0.5,
        upper=[4.0, 2.0],
        sigma=0.1,
    ),
    "adaptive_parameters_levels": controllers.AdaptiveParameters(
        law=controllers.BarrierBackstepping(k=(2.0, 20.0)),
        parameters=("g",),
        Gamma=3.0,
        lower=5.0,
        upper=15.0,
    ),
    "surface_barrier": controllers.SurfaceBarrier(a=2.0, K=[4.0, 3.0], surface=SURFACE),
    "terminal_sliding_mode": controllers.TerminalSlidingMode([1.0, 2.0], [20.0, 15.0], layer=0.02),
    "computed_torque": controllers.ComputedTorque(Kp=25.0, Kd=[10.0, 12.0]),
    "pd_gravity": controllers.PDGravity(Kp=60.0, Kd=[20.0, 10.0]),
    "reference_governor": controllers.ReferenceGovernor(
        law=controllers.PDGravity(Kp=60.0, Kd=[20.0, 15.0]), margin=[0.01, 0.03]
    ),
    "safety_filter": controllers.SafetyFilter(
        law=controllers.PDGravity(Kp=60.0, Kd=20.0),
        a1=[8.0, 9.0],
        nearest="acceleration",
        shape1="atan",
        shape2="cubic",
        margin=[0.1, 0.2],
    ),
    "safety_filter_limited": controllers.SafetyFilter(
        law=controllers.ComputedTorque(Kp=25.0, Kd=10.0), limit=[20.0, 10.0]
    ),
    "saturated": controllers.Saturated(controllers.PDGravity(60.0, 20.0), limit=[7.2, 1.5]),
    "saturated_auxiliary": controllers.Saturated(
        law=controllers.Backstepping(k1=2.0, K2=20.0, o=0.1, variant="corrected"),
        limit=[7.2, 1.5],
        auxiliary=[5.0, 8.0],
    ),
    "saturated_auxiliary_of_state": controllers.Saturated(
        law=controllers.ComputedTorque(Kp=25.0, Kd=10.0), limit=[7.2, 1.5], auxiliary=5.0
    ),
    "event_compensated": controllers.EventCompensated(
        law=controllers.Backstepping(k1=2.0, K2=20.0, o=0.1),
        relative=0.1,
        absolute=[0.3, 0.2],
        epsilon=0.5,
    ),
    "saturated_smooth": controllers.Saturated(
        law=controllers.ComputedTorque(Kp=25.0, Kd=10.0), limit=[7.2, 1.5], edge="smooth"
    ),
}

INPUT_MAPS = {
    "with_drive": controllers.WithDrive(
        law=controllers.PDGravity(Kp=60.0, Kd=20.0),
        drive=plants.ElectricDrive(
            TWO_LINK, torque_constant=[2.0, 1.5], inductance=0.02, resistance=1.0, back_emf=0.5
        ),
    )
}
"""Laws that command another input than a torque, for a plant of their own."""

OPTIONAL_FOLDS = (
    metrics.AboveGravity(),
    metrics.FirstExit(),
    metrics.LyapunovValue(),
    metrics.VelocityMargin(),
    metrics.LevelMargin(),
    metrics.RegionMargin(),
    metrics.Slack(),
    metrics.RegionSlack(),
    metrics.LevelEstimation(),
    metrics.Auxiliary(),
    metrics.Events(),
)
FOLDS = {type(fold).__name__: fold for fold in (*metrics.standard(), *OPTIONAL_FOLDS)}

FAMILIES = {
    "robot": (ROBOTS, robots.MEMBERS, ij.testing.check_robot),
    "plant": (PLANTS, plants.MEMBERS, ij.testing.check_plant),
    "reference": (REFERENCES, references.MEMBERS, ij.testing.check_reference),
    "side": (SIDES, bounds.MEMBERS, ij.testing.check_side),
    "region": (REGIONS, regions.MEMBERS, ij.testing.check_region),
    "disturbance": (DISTURBANCES, disturbances.MEMBERS, ij.testing.check_disturbance),
    "process_noise": (PROCESS_NOISES, process_noise.MEMBERS, ij.testing.check_process_noise),
    "barrier": (BARRIERS, barriers.MEMBERS, ij.testing.check_barrier),
    "decay": (DECAYS, decays.MEMBERS, ij.testing.check_decay),
    "observer": (OBSERVERS | LEVEL_OBSERVERS, observers.MEMBERS, ij.testing.check_observer),
    "sensor": (SENSORS, sensors.MEMBERS, ij.testing.check_sensor),
    "actuator": (ACTUATORS, actuators.MEMBERS, ij.testing.check_actuator),
    "law": (LAWS | INPUT_MAPS, controllers.MEMBERS, ij.testing.check_law),
    "fold": (FOLDS, {cls.__name__: cls for cls in metrics.MEMBERS.values()}, ij.testing.check_fold),
}
"""Family -> (instances by name, the package's registry, the checker)."""


def further(instances: dict[str, Any]) -> set[str]:
    """The names of instances whose class has another one before them: the default tests leave them
    to the slow ones."""
    classes = [type(member) for member in instances.values()]
    return {name for i, name in enumerate(instances) if classes[i] in classes[:i]}
