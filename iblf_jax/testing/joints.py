"""The number of joints of a component, and arms and scenarios with that number for its check."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.controllers import Backstepping
from iblf_jax.control.observers import AsPublished
from iblf_jax.core import checks
from iblf_jax.core.modules import is_module
from iblf_jax.core.pytree import field_values, is_leaf_field
from iblf_jax.presets import customary_two_link, zhang_yan_2024
from iblf_jax.simulation.initial import Initial
from iblf_jax.simulation.scenario import Scenario, fit_joints
from iblf_jax.testing._contract import Findings, examine, in_dtype
from iblf_jax.world.bounds import Bounds, Sinusoid
from iblf_jax.world.disturbances import Sinusoids
from iblf_jax.world.plants import ElectricDrive, FlexibleJoint, Rigid, StrictFeedback
from iblf_jax.world.references import Sinusoid as SinusoidalReference
from iblf_jax.world.robots import PlanarChain

T = TypeVar("T")

DEFAULT_JOINTS = 2
"""Number of joints that is assumed for a component whose leaves are all scalars."""
DEFAULT_LEVELS = 4
"""Number of levels that is assumed for a component for plants in strict-feedback form."""


def joints_of(member: object, default: int = DEFAULT_JOINTS) -> int:
    """The number of joints of a member's leaves; the default if they are scalars or disagree."""
    sizes = set(_declared_sizes(member))
    if not sizes:
        sizes = {np.shape(leaf)[0] for leaf in _undeclared(member) if np.ndim(leaf) == 1}
    return sizes.pop() if len(sizes) == 1 else default


def _declared_sizes(member: object) -> Iterator[int]:
    if isinstance(member, tuple):
        for part in member:
            yield from _declared_sizes(part)
    if not dataclasses.is_dataclass(member) or isinstance(member, type):
        return
    values = field_values(member)
    for field in dataclasses.fields(member):
        value = values[field.name]
        if not is_leaf_field(field):
            yield from _declared_sizes(value)
        elif field.metadata["shape"] == "joint" and np.ndim(value) == 1:
            yield np.shape(value)[0]
        elif field.metadata["shape"] == "level" and np.ndim(value) == 2:
            yield np.shape(value)[1]


def _undeclared(member: object) -> list[Any]:
    """Leaves of a class that was registered by hand, which no field declares."""
    if not dataclasses.is_dataclass(member):
        return jax.tree.leaves(member)
    if any(map(is_leaf_field, dataclasses.fields(member))):
        return []
    # The sizes of a network say nothing about the number of joints.
    return jax.tree.leaves([x for x in field_values(member).values() if not is_module(x)])


@contextmanager
def examine_joints(
    member: object,
    base: type,
    n: int | None,
    name: str,
) -> Iterator[tuple[Findings, Any, int]]:
    """The context of a checker whose component has one number per joint, as `examine`.

    Args:
      member: the component.
      base: base class of the family.
      n: number of joints; that of the leaves if None.
      name: what messages call the component.

    Yields:
      The findings, the component in float64 for n joints, and n.
    """
    check_number(n)
    with examine(member, base.__name__, base) as findings:
        n = number_of_joints(findings, member, n)
        yield findings, fitted_to(in_dtype(member, "float64"), n, name), n


def check_number(n: int | None) -> None:
    """Raises ValueError unless `n` is None or a number of joints."""
    if n is not None:
        checks.positive_integer("n", n, most=checks.MAX_JOINTS)


def check_joints_of(n: int | None, owner: Any, name: str) -> None:
    """Raises ValueError unless `n` is None or the number of joints of its owner."""
    if n not in (None, owner.n):
        expected = f"{owner.n}, the joints of the {name}"
        raise checks.fail("n", n, expected, "Leave one of the two out.")


def number_of_joints(findings: Findings, member: object, n: int | None) -> int:
    """The number of joints to check for: `n`, or that of the leaves."""
    if n is not None:
        return n
    sizes = sorted(set(_declared_sizes(member)))
    if len(sizes) > 1:
        listed = " and ".join(map(str, sizes))
        remedy = "Use scalars, or leaves with one number per joint of the same arm"
        findings.stop(f"its leaves are for {listed} joints", remedy)
    return joints_of(member)


def fitted_to(member: T, n: int, family: str) -> T:
    """The component with its scalars repeated for n joints.

    Raises:
      ValueError: a leaf is for another number of joints.
    """
    return fit_joints(member, n, family)


def arm_of(n: int) -> Any:
    """An arm of n joints: the customary two-link arm, or a planar chain like it."""
    if n == DEFAULT_JOINTS:
        return customary_two_link()
    shrink = 0.8 ** np.arange(n)
    mass, length = 2.0 * shrink, 0.35 * shrink
    return PlanarChain(mass=mass, length=length, centre=length / 2, inertia=mass * length**2 / 4)


def levels_of(member: Any) -> int:
    """The number of levels of a component for plants in strict-feedback form: that of the rows of
    its leaves, or `DEFAULT_LEVELS` if these are single numbers.
    """
    if not dataclasses.is_dataclass(member):
        return DEFAULT_LEVELS
    values = field_values(member)
    rows = [
        np.shape(values[field.name])[0]
        for field in dataclasses.fields(member)
        if is_leaf_field(field)
        if field.metadata["shape"] == "level" and np.ndim(values[field.name]) > 0
    ]
    return max(rows, default=DEFAULT_LEVELS)


def plant_of(order: int, n: int) -> Any:
    """A plant in strict-feedback form with this number of levels, of n components: an arm that is
    rigid, has electric drives or flexible joints, or a chain of integrators.
    """
    arm = arm_of(n)
    if order == 2:
        return Rigid(arm)
    if order == 3:
        return ElectricDrive(
            arm, torque_constant=1.5, inductance=0.02, resistance=0.8, back_emf=0.4
        )
    if order == 4:
        return FlexibleJoint(arm, stiffness=300.0, motor_inertia=0.02, motor_damping=0.1)
    return StrictFeedback(
        drift=lambda t, x: -x, gain=lambda t, x: jnp.ones_like(x), n=n, order=order
    )


def scenario_of(n: int) -> Scenario:
    """A scenario of n joints: the paper's, or one with similar reference, bounds and gains."""
    if n == DEFAULT_JOINTS:
        return zhang_yan_2024()
    quarter = np.pi / 2
    phases = np.resize([0.0, quarter], n)
    return Scenario(
        plant=arm_of(n),
        reference=SinusoidalReference(offset=0.5, amplitude=0.14, frequency=1.0, phase=phases),
        bounds=Bounds(
            lower=Sinusoid(offset=0.2, amplitude=0.14, frequency=1.0, phase=quarter - phases),
            upper=Sinusoid(offset=0.9, amplitude=0.14, frequency=1.0, phase=quarter - phases),
        ),
        disturbance=Sinusoids(amplitude=0.01, frequency=1.0, phase=phases),
        controller=Backstepping(k1=2.0, K2=20.0, o=0.1),
        observer=AsPublished(kf=20.0),
        initial=Initial(q=0.8, dq=0.0),
    )


def check_scenario(scenario: object, n: int | None) -> None:
    """Raises ValueError unless `scenario` is None or a Scenario, of `n` joints if `n` is given."""
    check_number(n)
    if scenario is None:
        return
    if not isinstance(scenario, Scenario):
        remedy = "Such as iblf_jax.presets.zhang_yan_2024()."
        raise checks.fail("scenario", scenario, "a Scenario", remedy)
    check_joints_of(n, scenario, "scenario")


def scenario_for(
    findings: Findings, member: object, scenario: Scenario | None, n: int | None
) -> Scenario:
    """The given scenario, or one with the number of joints of the component."""
    if scenario is not None:
        return scenario
    return scenario_of(number_of_joints(findings, member, n))
