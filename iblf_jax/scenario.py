"""A scenario: everything that defines a run except its length and its step.

The plant (the truth) and the model (what law and observer know) are apart.  By default they are the same robot; give `model`
to let them differ, or perturb leaves of `plant` alone.
"""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax import checks
from iblf_jax.bounds import Bounds, tube_at
from iblf_jax.controllers import Controller, Setting
from iblf_jax.disturbances import Disturbance, Nothing
from iblf_jax.observers import NoObserver, Observer
from iblf_jax.pytree import component, is_leaf_field, leaf
from iblf_jax.references import Reference
from iblf_jax.robots import Robot


@component
class Initial:
    """Where a run starts."""

    q: jax.Array = leaf("rad")
    dq: jax.Array = leaf("rad/s", default=0.0)


@component
class Scenario:
    """Plant, model, reference, bounds, disturbance, law, observer and start of a run.

    Leaves that hold one number a joint may be given as a scalar; they are repeated for the plant's n joints.

    Raises:
      ValueError: if a leaf has the wrong number of joints, or model and plant differ in theirs.
    """

    plant: Robot
    reference: Reference
    bounds: Bounds
    controller: Controller
    initial: Initial
    observer: Observer = NoObserver()
    disturbance: Disturbance = Nothing()
    model: Robot | None = None
    """What law and observer know; the plant itself if not given."""

    def check(self) -> None:
        """Completes the model and gives every joint-wise leaf its n entries."""
        if self.model is None:
            object.__setattr__(self, "model", self.plant)
        if self.model.n != self.plant.n:
            raise checks.fail("Scenario.model", f"{self.model.n} joints", f"{self.plant.n} joints, as the plant has")
        for field in dataclasses.fields(self):
            object.__setattr__(self, field.name, _fit_joints(getattr(self, field.name), self.plant.n, field.name))

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.plant.n

    @property
    def setting(self) -> Setting:
        """What the law knows: model, reference and bounds."""
        return Setting(self.model, self.reference, self.bounds)


def _fit_joints(part: Any, n: int, path: str) -> Any:
    """`part` with its joint-wise scalars repeated n times; ValueError where a leaf has another number of joints."""
    if isinstance(part, tuple):
        return tuple(_fit_joints(x, n, f"{path}[{i}]") for i, x in enumerate(part))
    if not dataclasses.is_dataclass(part) or isinstance(part, type):
        return part
    fitted = object.__new__(type(part))
    for field in dataclasses.fields(part):
        value, name = getattr(part, field.name), f"{path}.{field.name}"
        if is_leaf_field(field) and field.metadata["shape"] == "joint" and value is not None:
            if jnp.ndim(value) == 0:
                value = jnp.broadcast_to(value, (n,))
            elif jnp.shape(value) != (n,):
                raise checks.fail(name, value, f"one number, or {n} (one a joint)", f"Its shape is {jnp.shape(value)}.")
        elif not is_leaf_field(field):
            value = _fit_joints(value, n, name)
        object.__setattr__(fitted, field.name, value)
    return fitted


def check_values(part: Any, path: str = "") -> None:
    """Raises ValueError for the first concrete leaf that is not finite or has the wrong sign, with its path."""
    if isinstance(part, tuple):
        for i, x in enumerate(part):
            check_values(x, f"{path}[{i}]")
    elif dataclasses.is_dataclass(part) and not isinstance(part, type):
        for field in dataclasses.fields(part):
            name = f"{path}.{field.name}" if path else field.name
            if not field.metadata.get("static"):
                value = getattr(part, field.name)
                if isinstance(value, jax.Array | np.ndarray | float | int):
                    checks.check_values(name, value, field.metadata.get("sign"))
                else:
                    check_values(value, name)


def canonical(scenario: Scenario) -> Scenario:
    """The scenario with every leaf an array of one floating-point type, checked: what every entry point calls first.

    Raises:
      ValueError: a leaf is not finite or has the wrong sign, a mass matrix is not positive definite, the start is outside
        its bounds; the message names the field, the value and the mend.
    """
    if not isinstance(scenario, Scenario):
        raise checks.fail("scenario", scenario, "a Scenario", "Make one with ij.presets or ij.Scenario.")
    check_values(scenario)
    dtype = jnp.result_type(float)
    floats = [jnp.result_type(x) for x in jax.tree.leaves(scenario)]
    floats = [kind for kind in floats if jnp.issubdtype(kind, jnp.floating)]
    if floats and all(kind == floats[0] for kind in floats):
        dtype = floats[0]
    scenario = jax.tree.map(lambda x: jnp.asarray(x, dtype), scenario)
    if checks.is_concrete(scenario):
        _check_start(scenario)
        for part in (scenario.controller, scenario.observer):
            for text in getattr(part, "advice", list)():
                warnings.warn(text, stacklevel=3)
    return scenario


@jax.jit
def _start(scenario: Scenario):
    q = scenario.initial.q
    tube = tube_at(scenario.reference, scenario.bounds, jnp.zeros((), q.dtype))
    M = jnp.stack([scenario.plant.mass_matrix(q), scenario.model.mass_matrix(q)])
    return tube.q_d, tube.lower, tube.upper, M


def _check_start(scenario: Scenario) -> None:
    q = np.asarray(scenario.initial.q)
    q_d, lower, upper, M = (np.asarray(x) for x in _start(scenario))
    for name, values in (("reference", q_d), ("bounds.lower", lower), ("bounds.upper", upper)):
        if values.shape != (scenario.n,):
            raise checks.fail(name, values, f"{scenario.n} joints", f"Its shape at t = 0 is {values.shape}.")
        if not np.all(np.isfinite(values)):
            raise checks.fail(name, values, "finite values at t = 0")
    for i in range(scenario.n):
        if not lower[i] < upper[i]:
            raise checks.fail(f"bounds of joint {i}", (lower[i], upper[i]), "lower < upper at t = 0", "Exchange or widen them.")
        if not lower[i] < q_d[i] < upper[i]:
            raise checks.fail(
                f"reference of joint {i}", q_d[i], f"a value inside the bounds ({lower[i]:.6g}, {upper[i]:.6g}) at t = 0", "Move the reference or widen the bounds (Assumption 2)."
            )
        if not lower[i] < q[i] < upper[i]:
            raise checks.fail(f"initial.q[{i}]", q[i], f"a start inside the bounds ({lower[i]:.6g}, {upper[i]:.6g}) at t = 0", "Move the start or widen the bounds.")
    for name, matrix in zip(("plant", "model"), M, strict=True):
        symmetric = 0.5 * (matrix + matrix.T)
        if not np.all(np.isfinite(matrix)) or np.linalg.eigvalsh(symmetric)[0] <= 0:
            raise checks.fail(f"{name}.mass_matrix(initial.q)", matrix, "a positive definite matrix", "Check the masses, lengths and inertias.")
