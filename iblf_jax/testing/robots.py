"""The checker for robots: the contract is `iblf_jax.robots.Robot`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.core import checks
from iblf_jax.core.families import is_default
from iblf_jax.core.linalg import inner, matvec
from iblf_jax.testing._contract import (
    Findings,
    at_each,
    call_has_shape,
    check_function,
    examine,
    in_dtype,
    shape_of,
)
from iblf_jax.world.robots import (
    Robot,
    coriolis_from_mass_matrix,
    energy_gradient,
    inverse_dynamics,
    mass_matrix_rate,
    momentum,
)

TOLERANCE = 1e-9
"""Relative, float64: closed forms and automatic differentiation agree to rounding."""


def check_robot(robot: Robot, *, q: ArrayLike | None = None) -> None:
    """Checks a robot: shapes, derivatives, float32; M positive definite, M' - 2 C skew, G = dU/dq,
    J = d tip/dq.

        M = M^T > 0,   x^T (M' - 2 C) x = 0,   C(q, v) v = M' v - 1/2 d/dq (v^T M v),   G = dU/dq

    The robot's own `momentum`, `inverse_dynamics` and `energy_gradient` are compared with M, C, G.

    Args:
      robot: an instance.
      q: configurations of the test, (m, n) [rad or m]; random ones if not given.

    Raises:
      ContractError: lists what does not hold, with the remedy.
      ValueError: `q` is not an array of shape (m, n).
    """
    with examine(robot, "Robot", Robot) as findings:
        n = robot.n
        findings.require(
            isinstance(n, int) and n >= 1,
            f"n is {n!r}",
            "It must be the number of joints, a Python int",
        )
        findings.require(
            hasattr(robot, "payload"),
            "it has no leaf `payload`",
            "Add a point mass at the tip [kg], 0 by default",
        )
        findings.require(
            not is_default(robot.skeleton, Robot.skeleton),
            "skeleton(q) is missing",
            "Positions of the base, each joint and the tip, (n + 1, 2) or (n + 1, 3) [m]",
        )
        findings.stop_if_any()
        robot = in_dtype(robot, "float64")
        rng = np.random.default_rng(1)
        if q is None:
            points = jnp.asarray(rng.uniform(-2, 2, (4, n)))
        else:
            points = jnp.atleast_2d(checks.as_floats("q", q))
        checks.check_values("q", points, None)
        if points.ndim != 2 or points.shape[1] != n or not len(points):
            raise checks.fail(
                "q", points, f"configurations, shape (m, {n})", f"Its shape is {points.shape}."
            )
        _shapes(findings, robot, points[0])
        findings.stop_if_any()

        def outputs(robot, q, v, u):
            return {
                "mass_matrix(q)": robot.mass_matrix(q),
                "coriolis(q, v, u)": robot.coriolis(q, v, u),
                "gravity(q)": robot.gravity(q),
                "potential(q)": robot.potential(q),
                "tip(q)": robot.tip(q),
                "jacobian(q)": robot.jacobian(q),
                "skeleton(q)": robot.skeleton(q),
            }

        v, u = jnp.asarray(rng.normal(size=(2, n)))
        check_function(findings, outputs, robot, (points[0], v, u))
        identities = jax.jit(_identities)
        _physics(findings, at_each(lambda q: identities(robot, q, v, u), np.asarray(points)))


def _shapes(findings: Findings, robot: Robot, q: jax.Array) -> None:
    n = robot.n
    tip = shape_of(findings, "tip(q)", robot.tip, q)
    if tip.shape not in ((2,), (3,)):
        findings.stop(f"tip(q) has shape {tip.shape}", "It must be (2,) or (3,)")
    d = tip.shape[0]
    methods: dict[str, tuple[Callable, tuple[jax.Array, ...], tuple[int, ...]]] = {
        "mass_matrix(q)": (robot.mass_matrix, (q,), (n, n)),
        "coriolis(q, v, u)": (robot.coriolis, (q, q, q), (n,)),
        "gravity(q)": (robot.gravity, (q,), (n,)),
        "potential(q)": (robot.potential, (q,), ()),
        "jacobian(q)": (robot.jacobian, (q,), (d, n)),
        "skeleton(q)": (robot.skeleton, (q,), (n + 1, d)),
    }
    for label, (method, args, shape) in methods.items():
        call_has_shape(findings, label, method, args, shape)


def _identities(robot: Any, q: jax.Array, v: jax.Array, u: jax.Array) -> dict[str, jax.Array]:
    """The mass matrix, the residuals of the identities, and the scales of these residuals."""
    M = robot.mass_matrix(q)
    C = jax.vmap(lambda e: robot.coriolis(q, v, e), out_axes=1)(jnp.eye(robot.n))
    N = mass_matrix_rate(robot, q, v) - 2.0 * C
    return {
        "M": M,
        "asymmetry": M - M.T,
        "skew": N + N.T,
        "skew_scale": jnp.max(jnp.abs(C)),
        "linear": robot.coriolis(q, v, u) - C @ u,
        "christoffel": (
            robot.coriolis(q, v, v) - coriolis_from_mass_matrix(robot.mass_matrix, q, v, v)
        ),
        "gravity": robot.gravity(q) - jax.grad(robot.potential)(q),
        "gravity_scale": jnp.max(jnp.abs(robot.gravity(q))),
        "momentum": momentum(robot, q, u) - M @ u,
        "inverse_dynamics": inverse_dynamics(robot, q, v, u, u)
        - (C @ u + robot.gravity(q) + M @ u),
        "energy_gradient": (
            energy_gradient(robot, q, v)
            - 0.5 * jax.grad(lambda x: inner(v, matvec(robot.mass_matrix(x), v)))(q)
        ),
        "jacobian": robot.jacobian(q) - jax.jacfwd(robot.tip)(q),
        "tip": robot.skeleton(q)[-1] - robot.tip(q),
    }


def _physics(findings: Findings, got: dict[str, np.ndarray]) -> None:
    def small(name, scale, problem, remedy):
        size = float(np.max(np.abs(got[name])))
        findings.require(
            size <= TOLERANCE * max(1.0, float(scale)), f"{problem} (by {size:.2g})", remedy
        )

    scale = np.max(np.abs(got["M"]))
    motion = max(np.max(np.abs(got["skew_scale"])), scale)
    small("asymmetry", scale, "M(q) is not symmetric", "Build it symmetric")
    lowest = float(np.min(np.linalg.eigvalsh(0.5 * (got["M"] + np.swapaxes(got["M"], 1, 2)))))
    findings.require(
        lowest > 0,
        f"M(q) is not positive definite (lowest eigenvalue {lowest:.3g})",
        "Give every joint some inertia",
    )
    small(
        "linear", motion, "coriolis(q, v, u) is not linear in u", "It is C(q, v) u, not C(q, v) v"
    )
    small(
        "christoffel",
        motion,
        "coriolis(q, v, v) does not follow from M(q)",
        "Use iblf_jax.robots.from_energy to derive it",
    )
    small(
        "skew",
        motion,
        "M' - 2 C is not skew-symmetric",
        "Use the Christoffel symbols: iblf_jax.robots.from_energy",
    )
    small(
        "gravity",
        np.max(got["gravity_scale"]),
        "gravity(q) is not dU/dq of potential(q)",
        "Look at signs and heights",
    )
    small("momentum", scale, "momentum(q, v) is not M(q) v", "Leave it out")
    small(
        "inverse_dynamics",
        max(motion, np.max(got["gravity_scale"])),
        "inverse_dynamics(q, v, u, a) is not C(q, v) u + G + M a",
        "Leave it out",
    )
    small("energy_gradient", motion, "energy_gradient(q, v) is not dT/dq", "Leave it out")
    small("jacobian", 1.0, "jacobian(q) is not d tip/dq", "Use iblf_jax.robots.from_energy")
    small("tip", 1.0, "the last row of skeleton(q) is not tip(q)", "skeleton is base, joints, tip")
