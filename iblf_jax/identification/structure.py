"""Whether what a fit leaves follows something that was left out of it: friction, gravity, inertia
of a joint.

A term that was left out acts as a torque theta r(t) on one joint, r one of

    tanh(q_j' / w)   q_j'   q_j"   sin q_j   cos q_j   1

It is looked for in the torques of the smoothed log (`regression`), at the numbers x that were
found:

    tau - e(x; q, q', q") = de/dx dx + theta r + noise

by least squares, each joint by what is left of it.  Candidates are added one by one, the one that
takes away most first, while it takes away at least GAIN of what is left of its joint; then those
are dropped that are not significant.  Residuals are far from white, so the standard error of theta
takes blocks of the log as its observations (cluster-robust variance), which covers any correlation
within a block; theta over its error follows Student's t with one degree of freedom less than there
are blocks.  The level is divided by the number of candidates (Bonferroni).

What the numbers lose when the terms are added is their bias:  x (without them) - x (with them).

Source: H. White, Econometrica 50 (1982) 1-25, and K.-Y. Liang, S. L. Zeger, Biometrika 73 (1986)
  13-22 (the variance).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from iblf_jax.identification.smoothing import HALF, Smoothed

LEVEL = 1e-3
"""Probability of one finding or more where nothing was left out."""
BLOCK = 6.0 * HALF
"""Length of a block [s]: several times what smoothing correlates."""
FEWEST_BLOCKS = 10
"""Below which the spread between blocks is not known."""
OWN = 0.01
"""Part of a candidate that must be its own: less, and the fitted numbers explain the same."""
GAIN = 0.1
"""Part of what is left of a joint that a term must take away."""
LEAST = 3e-3
"""Part of a joint's torque, root of the mean square, that a term must have: smoothing alone makes
less."""
SHARE = 0.2
"""Part of what a joint's torque leaves, root of the mean square, that a term must have beside
others."""
SLOW = 0.05
"""[rad/s]: w of the candidate for Coulomb friction."""
BIASED_FROM = 0.05
"""Part of a number from which its bias matters."""


class Kind(NamedTuple):
    """One form of term that can be left out."""

    follows: str
    """What the residuals follow, in words."""
    term: str
    """What is missing, in words."""
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
    """A term that was left out."""

    joint: int
    kind: str
    size: float
    """theta, in the kind's unit; positive where the model has too little of it."""
    error: float
    """Its standard error."""
    gain: float
    """Part of what was left of the joint's torque that it takes away."""


class LeftOut(NamedTuple):
    """What was left out, and what that does to the numbers."""

    findings: tuple[Finding, ...]
    bias: np.ndarray
    """What was left out adds to each number, (p,); 0 for those that were not looked for."""


class _Design(NamedTuple):
    """A linear regression of the torques that are left, rows (P n,), weighted."""

    columns: np.ndarray
    """Of the numbers that were looked for, and of the candidates, (P n, k + c)."""
    rest: np.ndarray
    """What is left, (P n,)."""
    block: np.ndarray
    """In which block each row is, (P n,)."""
    joint: np.ndarray
    """Of which joint each row is, (P n,)."""


def candidates(seen: Smoothed) -> tuple[list[tuple[int, str]], np.ndarray]:
    """The candidates, (joint, kind), and the torque of each for one unit of theta, (P, n, c)."""
    shapes = {
        "sign": np.tanh(seen.dq / SLOW),
        "velocity": seen.dq,
        "acceleration": seen.ddq,
        "sine": np.sin(seen.q),
        "cosine": np.cos(seen.q),
        "constant": np.ones_like(seen.q),
    }
    n = seen.q.shape[1]
    names = [(j, kind) for j in range(n) for kind in shapes]
    torque = np.zeros((*seen.q.shape, len(names)))
    for c, (j, kind) in enumerate(names):
        torque[:, j, c] = shapes[kind][:, j]
    return names, torque


def left_out(
    seen: Smoothed, torque: np.ndarray, by_x: np.ndarray, delay: float, fitted: np.ndarray
) -> LeftOut:
    """The terms that the fit lacks.

    Args:
      seen: the log, smoothed, P times.
      torque: what the joints need with the numbers that were found, (P, n) [N m].
      by_x: its derivative by the numbers, (P, n, p).
      delay: of the logged torque [s].
      fitted: which of the numbers, the delay last, were looked for and are at no limit, (p + 1,)
        bool.
    """
    p = by_x.shape[-1]
    names, of_candidates = candidates(seen)
    rest = seen.tau - delay * seen.dtau - torque
    numbers = np.concatenate([by_x, seen.dtau[..., None]], axis=-1)[..., fitted]
    design = _weighted(seen, rest, numbers, of_candidates)
    k = numbers.shape[-1]
    found = _significant(design, k, _added(design, k, names), len(names))
    thetas = _solved(design, [*range(k), *found])[k:]
    unit = _rms(of_candidates)
    least = np.maximum(
        LEAST * _rms(seen.tau), SHARE * _rms(rest - numbers @ _solved(design, range(k)))
    )
    found = [
        i
        for i, theta in zip(found, thetas, strict=True)
        if _is_large(theta, unit, least, names, i - k)
    ]
    bias = np.zeros(p)
    if not found:
        return LeftOut((), bias)
    moved = np.zeros(p + 1)
    without, with_them = _solved(design, range(k)), _solved(design, [*range(k), *found])
    moved[fitted] = without - with_them[:k]
    errors = _errors(design, [*range(k), *found])[k:]
    made = []
    for i, theta, error in zip(found, with_them[k:].tolist(), errors.tolist(), strict=True):
        j, kind = names[i - k]
        made.append(Finding(j, kind, theta, error, _gain(design, [*range(k), *found], i, j)))
    return LeftOut(tuple(sorted(made, key=lambda one: -one.gain)), moved[:p])


def _rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(x**2, axis=0))


def _is_large(
    theta: float, unit: np.ndarray, least: np.ndarray, names: list[tuple[int, str]], c: int
) -> bool:
    """Whether a term is a torque that matters on its joint.

    Args:
      theta: its size.
      unit: root of the mean square of each candidate's torque for one unit, (n, c) [N m].
      least: what matters on each joint, (n,) [N m].
      names: of the candidates.
      c: which candidate.
    """
    joint, _ = names[c]
    return abs(theta) * unit[joint, c] > least[joint]


def _weighted(
    seen: Smoothed, rest: np.ndarray, numbers: np.ndarray, of_candidates: np.ndarray
) -> _Design:
    """The regression, joints weighed by what all candidates together leave of them."""
    P, n = rest.shape
    columns = np.concatenate([numbers, of_candidates], axis=-1)
    spacing = float(np.median(np.abs(np.diff(seen.t)))) if P > 1 else BLOCK
    block = np.arange(P) // max(1, round(BLOCK / max(spacing, 1e-9)))
    sigma = np.std(rest, axis=0) + 1e-12
    for _ in range(2):
        weight = 1.0 / sigma
        design = _Design(
            (columns * weight[:, None]).reshape(P * n, -1),
            (rest * weight).ravel(),
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
    """Of a symmetric matrix of any scales; combinations that nothing is known of are left out."""
    size = np.sqrt(np.maximum(np.diag(A), 1e-300))
    return (
        np.linalg.pinv(A / size[:, None] / size, rcond=1e-10, hermitian=True) / size[:, None] / size
    )


def _solved(design: _Design, chosen: Any) -> np.ndarray:
    X = design.columns[:, list(chosen)]
    return _inverse(X.T @ X) @ (X.T @ design.rest)


def _residual(design: _Design, chosen: Any) -> np.ndarray:
    chosen = list(chosen)
    return design.rest - design.columns[:, chosen] @ _solved(design, chosen)


def _errors(design: _Design, chosen: Any) -> np.ndarray:
    """Cluster-robust standard errors, one a column that is chosen."""
    chosen = list(chosen)
    X, left = design.columns[:, chosen], _residual(design, chosen)
    bread = _inverse(X.T @ X)
    count = int(design.block[-1]) + 1
    scores = np.zeros((count, len(chosen)))
    np.add.at(scores, design.block, X * left[:, None])
    return np.sqrt(
        np.maximum(np.diag(bread @ (scores.T @ scores) @ bread) * count / (count - 1), 0.0)
    )


def _gain(design: _Design, chosen: list[int], i: int, joint: int) -> float:
    """Part of what is left of a joint, without column i, that the column takes away."""
    own = design.joint == joint
    others = [x for x in chosen if x != i]
    before = float(np.sum(_residual(design, others)[own] ** 2))
    after = float(np.sum(_residual(design, [*others, i])[own] ** 2))
    return 1.0 - after / max(before, 1e-300)


def _added(design: _Design, k: int, names: list[tuple[int, str]]) -> list[int]:
    """Columns of candidates, added while each takes away enough of what is left of its joint."""
    chosen: list[int] = []
    own = [design.joint == j for j, _ in names]
    X = design.columns
    for _ in names:
        base = [*range(k), *chosen]
        inverse, left = _inverse(X[:, base].T @ X[:, base]), _residual(design, base)
        best, most = None, GAIN
        for c in range(len(names)):
            column = X[:, k + c]
            size = float(column @ column)
            part = column - X[:, base] @ (inverse @ (X[:, base].T @ column))
            if k + c in chosen or float(part @ part) < OWN * size:
                continue
            less = float(part @ left) ** 2 / float(part @ part)
            gain = less / max(float(np.sum(left[own[c]] ** 2)), 1e-300)
            if gain > most:
                best, most = k + c, gain
        if best is None:
            return chosen
        chosen.append(best)
    return chosen


def _significant(design: _Design, k: int, chosen: list[int], tests: int) -> list[int]:
    """Those of the chosen columns that are significant, the least significant one dropped until all
    are.
    """
    from scipy.stats import t

    count = int(design.block[-1]) + 1 if len(design.block) else 0
    if count < FEWEST_BLOCKS:
        return []
    needed = float(t.isf(0.5 * LEVEL / tests, count - 1))
    chosen = list(chosen)
    while chosen:
        both = [*range(k), *chosen]
        statistic = np.abs(_solved(design, both)) / np.maximum(_errors(design, both), 1e-300)
        worst = int(np.argmin(statistic[k:]))
        if statistic[k + worst] >= needed:
            return chosen
        chosen.pop(worst)
    return chosen


def biased(found: LeftOut, x: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """What was left out adds to each number, (p,), where that matters; else 0.

    It matters where it is more than the number's standard error, or than a part of the number: the
    standard errors have already been multiplied by how much of the residuals the model does not
    explain.

    Args:
      found: what was left out.
      x, errors: the numbers and their standard errors, (p,).
    """
    much = (np.abs(found.bias) > errors) | (np.abs(found.bias) > BIASED_FROM * np.abs(x))
    return np.where(np.isfinite(errors) & much, found.bias, 0.0)


def in_words(finding: Finding, joint: str, remedy: str) -> str:
    """A finding as a line of the report.

    Args:
      finding: what was found.
      joint: its joint's name.
      remedy: what to do.
    """
    kind = KINDS[finding.kind]
    more = "more" if finding.size > 0 else "less"
    return (
        f"What is left of the torque of {joint} follows {kind.follows}: the robot has"
        f" {abs(finding.size):.3g} +- {finding.error:.1g} {kind.unit} {more} of {kind.term} there"
        f" than the model, which explains {finding.gain:.0%} of what is left. {remedy}"
    )


def remedy_for(finding: Finding, available: Any, names: tuple[str, ...]) -> str:
    """Which leaf to add to the paths.

    Args:
      finding: what was found.
      available: paths of all leaves of the plant and of the disturbance.
      names: of the numbers that were looked for.
    """
    kind = KINDS[finding.kind]
    suffixes = [(path, path.rsplit(".", 1)[-1]) for path in available]
    same = [path for name in kind.leaves for path, last in suffixes if last == name]
    missing = [path for path in same if not _is_in(path, finding.joint, names)]
    if missing:
        return f"Add {missing[0].replace('plant.', 'robot.', 1)!r} to the paths."
    if same:
        return f"{same[0]} is looked for, so it is of another form than the model's."
    if finding.kind in ("sign", "velocity"):
        return (
            "Give the scenario ij.disturbances.Friction(...) and add"
            f" 'disturbance.{kind.leaves[0]}' to the paths."
        )
    return "The scenario has no leaf for it."


def _is_in(path: str, joint: int, names: tuple[str, ...]) -> bool:
    """Whether the number of a joint at a path was looked for, whichever way its owner was
    called.
    """
    owner, _, rest = path.partition(".")
    owners = ("plant", "robot", "model") if owner == "plant" else (owner,)
    return any(
        name in (f"{one}.{rest}[{joint}]", f"{one}.{rest}") for one in owners for name in names
    )
