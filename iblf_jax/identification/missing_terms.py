"""Terms that the model lacks: friction, gravity or inertia of a joint, detected in the residuals.

A missing term acts as a torque theta r(t) on one joint, r one of

    tanh(q_j' / w)   q_j'   q_j"   sin q_j   cos q_j   1

It is detected in the torques of the smoothed log (`regression`), at the estimate x:

    tau - e(x; q, q', q") = de/dx dx + theta r + noise

by least squares, each joint weighted by its residual.  Forward selection adds the candidate that
reduces the residual of its joint most, as long as it reduces it by at least SMALLEST_GAIN; backward
elimination removes those that are not significant.  Residuals are far from white, so the standard
error of theta takes blocks of the log as its observations (cluster-robust variance), which covers
any correlation within a block; theta over its error follows Student's t with one degree of freedom
less than there are blocks.  The level is divided by the number of candidates (Bonferroni).

The bias of the parameters is x (without the terms) - x (with them).

Source: H. White, Econometrica 50 (1982) 1-25, and K.-Y. Liang, S. L. Zeger, Biometrika 73 (1986)
13-22 (the variance).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from iblf_jax.identification.smoothing import HALF_WIDTH, SmoothedMotion

FALSE_ALARM_PROBABILITY = 1e-3
"""Probability of at least one finding if no term is missing."""
BLOCK_LENGTH = 6.0 * HALF_WIDTH
"""Length of a block [s]: several times the correlation length of the smoothing."""
MIN_BLOCKS = 10
"""Number of blocks from which the variance between blocks is estimated."""
SMALLEST_OWN_SHARE = 0.01
"""Share of a candidate that the estimated parameters must not explain."""
SMALLEST_GAIN = 0.1
"""Share of a joint's residual that a term must explain."""
SMALLEST_TORQUE_SHARE = 3e-3
"""Root mean square of a term relative to the joint's torque, at least; smoothing alone causes
smaller terms."""
SMALLEST_RESIDUAL_SHARE = 0.2
"""Root mean square of a term relative to the joint's residual torque, at least, beside others."""
COULOMB_WIDTH = 0.05
"""[rad/s]: w of the candidate for Coulomb friction."""
BIASED_FROM = 0.05
"""Relative bias from which a bias matters."""


class Kind(NamedTuple):
    """A kind of missing term."""

    follows: str
    """What the residuals depend on, as text."""
    term: str
    """What is missing, as text."""
    unit: str
    leaves: tuple[str, ...]
    """Names of leaves that hold it."""


KINDS = {
    "sign": Kind("the sign of its velocity", "Coulomb friction", "N m", ("coulomb", "friction")),
    "velocity": Kind("its velocity", "viscous friction", "N m s/rad", ("viscous", "damping")),
    "acceleration": Kind("its acceleration", "inertia", "kg m^2", ("armature", "inertia", "mass")),
    "sine": Kind(
        "the sine of its position", "a torque of gravity", "N m", ("mass", "centre", "payload")
    ),
    "cosine": Kind(
        "the cosine of its position", "a torque of gravity", "N m", ("mass", "centre", "payload")
    ),
    "constant": Kind("a constant", "a constant torque", "N m", ("offset",)),
}


class Finding(NamedTuple):
    """A missing term."""

    joint: int
    kind: str
    size: float
    """theta, in the kind's unit; positive where the model has too little of it."""
    error: float
    """Its standard error."""
    gain: float
    """Share of the joint's residual torque that it explains."""


class MissingTerms(NamedTuple):
    """Missing terms, and the bias that they cause."""

    findings: tuple[Finding, ...]
    bias: np.ndarray
    """Bias of each parameter, (p,); 0 for those that are not estimated."""


class _Design(NamedTuple):
    """A weighted linear regression of the residual torques, with rows (P n,)."""

    columns: np.ndarray
    """Columns of the k parameters and of the c candidates, (P n, k + c)."""
    residuals: np.ndarray
    """Residuals, (P n,)."""
    block: np.ndarray
    """In which block each row is, (P n,)."""
    joint: np.ndarray
    """Of which joint each row is, (P n,)."""


def candidates(motion: SmoothedMotion) -> tuple[list[tuple[int, str]], np.ndarray]:
    """The candidates, (joint, kind), and the torque of each for one unit of theta, (P, n, c)."""
    shapes = {
        "sign": np.tanh(motion.dq / COULOMB_WIDTH),
        "velocity": motion.dq,
        "acceleration": motion.ddq,
        "sine": np.sin(motion.q),
        "cosine": np.cos(motion.q),
        "constant": np.ones_like(motion.q),
    }
    n = motion.q.shape[1]
    names = [(j, kind) for j in range(n) for kind in shapes]
    torque = np.zeros((*motion.q.shape, len(names)))
    for c, (j, kind) in enumerate(names):
        torque[:, j, c] = shapes[kind][:, j]
    return names, torque


def missing_terms(
    motion: SmoothedMotion, torque: np.ndarray, by_x: np.ndarray, delay: float, fitted: np.ndarray
) -> MissingTerms:
    """The terms that the fit lacks.

    Args:
      motion: the smoothed log at P times.
      torque: torques of the model with the estimate, (P, n) [N m].
      by_x: their derivative by the parameters, (P, n, p).
      delay: of the logged torque [s].
      fitted: parameters, the delay last, that are estimated and not at a limit, (p + 1,) bool.
    """
    p = by_x.shape[-1]
    names, candidate_columns = candidates(motion)
    residuals = motion.tau - delay * motion.dtau - torque
    parameter_columns = np.concatenate([by_x, motion.dtau[..., None]], axis=-1)[..., fitted]
    design = _weighted_regression(motion, residuals, parameter_columns, candidate_columns)
    k = parameter_columns.shape[-1]
    significant = _backward_elimination(design, k, _forward_selection(design, k, names), len(names))
    without = _least_squares(design, range(k))
    thetas = _least_squares(design, [*range(k), *significant])[k:]
    unit = _rms(candidate_columns)
    least = np.maximum(
        SMALLEST_TORQUE_SHARE * _rms(motion.tau),
        SMALLEST_RESIDUAL_SHARE * _rms(residuals - parameter_columns @ without),
    )
    found = []
    for i, theta in zip(significant, thetas, strict=True):
        joint, _ = names[i - k]
        if abs(theta) * unit[joint, i - k] > least[joint]:
            found.append(i)
    if not found:
        return MissingTerms((), np.zeros(p))
    chosen = [*range(k), *found]
    with_terms, errors = _least_squares(design, chosen), _errors(design, chosen)
    bias = np.zeros(p + 1)
    bias[fitted] = without - with_terms[:k]
    findings = []
    for i, theta, error in zip(found, with_terms[k:].tolist(), errors[k:].tolist(), strict=True):
        joint, kind = names[i - k]
        findings.append(Finding(joint, kind, theta, error, _gain(design, chosen, i, joint)))
    return MissingTerms(tuple(sorted(findings, key=lambda one: -one.gain)), bias[:p])


def _rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(x**2, axis=0))


def _weighted_regression(
    motion: SmoothedMotion,
    residuals: np.ndarray,
    parameter_columns: np.ndarray,
    candidate_columns: np.ndarray,
) -> _Design:
    """The regression, joints weighted by their residual with all candidates."""
    P, n = residuals.shape
    columns = np.concatenate([parameter_columns, candidate_columns], axis=-1)
    spacing = float(np.median(np.abs(np.diff(motion.t)))) if P > 1 else BLOCK_LENGTH
    block = np.arange(P) // max(1, round(BLOCK_LENGTH / max(spacing, 1e-9)))
    sigma = np.std(residuals, axis=0) + 1e-12
    for _ in range(2):
        weight = 1.0 / sigma
        design = _Design(
            (columns * weight[:, None]).reshape(P * n, -1),
            (residuals * weight).ravel(),
            np.repeat(block, n),
            np.tile(np.arange(n), P),
        )
        everything = list(range(columns.shape[-1]))
        sigma = np.maximum(
            np.sqrt(np.mean(_residual(design, everything).reshape(P, n) ** 2, axis=0)) * sigma,
            1e-12,
        )
    return design


def _inverse(A: np.ndarray) -> np.ndarray:
    """Of a symmetric matrix of any scales; combinations without information are omitted."""
    size = np.sqrt(np.maximum(np.diag(A), 1e-300))
    return (
        np.linalg.pinv(A / size[:, None] / size, rcond=1e-10, hermitian=True) / size[:, None] / size
    )


def _least_squares(design: _Design, chosen: Iterable[int]) -> np.ndarray:
    X = design.columns[:, list(chosen)]
    return _inverse(X.T @ X) @ (X.T @ design.residuals)


def _residual(design: _Design, chosen: Iterable[int]) -> np.ndarray:
    chosen = list(chosen)
    return design.residuals - design.columns[:, chosen] @ _least_squares(design, chosen)


def _errors(design: _Design, chosen: Iterable[int]) -> np.ndarray:
    """Cluster-robust standard errors of the chosen columns."""
    chosen = list(chosen)
    X, residuals = design.columns[:, chosen], _residual(design, chosen)
    bread = _inverse(X.T @ X)
    count = int(design.block[-1]) + 1
    scores = np.zeros((count, len(chosen)))
    np.add.at(scores, design.block, X * residuals[:, None])
    return np.sqrt(
        np.maximum(np.diag(bread @ (scores.T @ scores) @ bread) * count / (count - 1), 0.0)
    )


def _gain(design: _Design, chosen: list[int], i: int, joint: int) -> float:
    """Share of a joint's residual without column i that the column explains."""
    own = design.joint == joint
    others = [x for x in chosen if x != i]
    before = float(np.sum(_residual(design, others)[own] ** 2))
    after = float(np.sum(_residual(design, [*others, i])[own] ** 2))
    return 1.0 - after / max(before, 1e-300)


def _forward_selection(design: _Design, k: int, names: list[tuple[int, str]]) -> list[int]:
    """Columns of candidates, added while each explains enough of its joint's residual."""
    chosen: list[int] = []
    own = [design.joint == j for j, _ in names]
    X = design.columns
    for _ in names:
        base = [*range(k), *chosen]
        inverse, residuals = _inverse(X[:, base].T @ X[:, base]), _residual(design, base)
        best, most = None, SMALLEST_GAIN
        for c in range(len(names)):
            column = X[:, k + c]
            size = float(column @ column)
            part = column - X[:, base] @ (inverse @ (X[:, base].T @ column))
            if k + c in chosen or float(part @ part) < SMALLEST_OWN_SHARE * size:
                continue
            less = float(part @ residuals) ** 2 / float(part @ part)
            gain = less / max(float(np.sum(residuals[own[c]] ** 2)), 1e-300)
            if gain > most:
                best, most = k + c, gain
        if best is None:
            return chosen
        chosen.append(best)
    return chosen


def _backward_elimination(design: _Design, k: int, chosen: list[int], tests: int) -> list[int]:
    """Those of the chosen columns that are significant, the least significant one dropped until all
    are.
    """
    from scipy.stats import t

    count = int(design.block[-1]) + 1 if len(design.block) else 0
    if count < MIN_BLOCKS:
        return []
    needed = float(t.isf(0.5 * FALSE_ALARM_PROBABILITY / tests, count - 1))
    chosen = list(chosen)
    while chosen:
        both = [*range(k), *chosen]
        statistic = np.abs(_least_squares(design, both)) / np.maximum(_errors(design, both), 1e-300)
        worst = int(np.argmin(statistic[k:]))
        if statistic[k + worst] >= needed:
            return chosen
        chosen.pop(worst)
    return chosen


def biased(found: MissingTerms, x: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """The bias of each parameter, (p,), where it matters; else 0.

    It matters where it is more than the standard error or than BIASED_FROM of the parameter; the
    standard errors already contain the factor for unexplained residuals.

    Args:
      found: what was left out.
      x, errors: the parameters and their standard errors, (p,).
    """
    much = (np.abs(found.bias) > errors) | (np.abs(found.bias) > BIASED_FROM * np.abs(x))
    return np.where(np.isfinite(errors) & much, found.bias, 0.0)


def describe_finding(finding: Finding, joint: str, remedy: str) -> str:
    """A finding as a line of the report.

    Args:
      finding: what was found.
      joint: its joint's name.
      remedy: what to do.
    """
    kind = KINDS[finding.kind]
    more = "more" if finding.size > 0 else "less"
    return (
        f"The residual torque of {joint} depends on {kind.follows}: the robot has"
        f" {abs(finding.size):.3g} +- {finding.error:.1g} {kind.unit} {more} of {kind.term} there"
        f" than the model, which explains {finding.gain:.0%} of this residual. {remedy}"
    )


def remedy_for(finding: Finding, available: Iterable[str], names: tuple[str, ...]) -> str:
    """Which leaf to add to the paths.

    Args:
      finding: what was found.
      available: paths of all leaves of the plant and of the disturbance.
      names: names of the identified parameters.
    """
    kind = KINDS[finding.kind]
    suffixes = [(path, path.rsplit(".", 1)[-1]) for path in available]
    same = [path for name in kind.leaves for path, last in suffixes if last == name]
    missing = [path for path in same if not _is_in(path, finding.joint, names)]
    if missing:
        return f"Add {missing[0].replace('plant.', 'robot.', 1)!r} to the paths."
    if same:
        return f"{same[0]} is identified already, so the term has another form than the model's."
    if finding.kind in ("sign", "velocity"):
        return (
            "Give the scenario ij.disturbances.Friction(...) and add"
            f" 'disturbance.{kind.leaves[0]}' to the paths."
        )
    return "The scenario has no leaf for it."


def _is_in(path: str, joint: int, names: tuple[str, ...]) -> bool:
    """Whether the parameter of a joint at a path was identified, by any name of its owner."""
    owner, _, rest = path.partition(".")
    owners = ("plant", "robot", "model") if owner == "plant" else (owner,)
    return any(
        name in (f"{one}.{rest}[{joint}]", f"{one}.{rest}") for one in owners for name in names
    )
