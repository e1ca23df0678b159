"""What all checkers share: a list of findings, and the probe of a member's functions.

A family describes its functions as one pure function `outputs(member, *args) -> {name: array}`.
`probe` runs it compiled, batched, differentiated in both modes and in float32, and writes down what
does not hold.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks

STEP = 1e-6
"""Relative step of the central differences; with float64 they are good to about 1e-9."""


class ContractError(AssertionError):
    """A member that does not fit its family; the message lists what is missing or wrong, and the
    remedy of each.
    """


class Findings:
    """What was found wrong with one member."""

    def __init__(self, member: Any, family: str):
        self.name = type(member).__name__
        self.family = family
        self.problems: list[str] = []
        self.remarks: list[str] = []
        """What a user should know and what fails nothing."""

    def add(self, problem: str, remedy: str = "") -> None:
        """Writes one problem down, once."""
        text = f"{problem}." + (f" {remedy}" if remedy else "")
        if text not in self.problems:
            self.problems.append(text)

    def remark(self, remark: str, remedy: str = "") -> None:
        """Writes one remark down, once."""
        text = f"{remark}." + (f" {remedy}." if remedy else "")
        if text not in self.remarks:
            self.remarks.append(text)

    def require(self, condition: Any, problem: str, remedy: str = "") -> bool:
        """Writes the problem down unless the condition holds; returns whether it holds."""
        if not bool(condition):
            self.add(problem, remedy)
        return bool(condition)

    def stop_if_any(self) -> None:
        """Raises ContractError if anything was found so far."""
        if self.problems:
            listed = "\n".join(f"  - {text}" for text in self.problems)
            raise ContractError(
                f"{self.name} does not fit the contract of"
                f" {checks.with_article(self.family)}:\n{listed}"
            )


@contextmanager
def examine(
    member: Any, family: str, protocol: type, optional: tuple[str, ...] = ()
) -> Iterator[Findings]:
    """Float64 inside, the findings raised at the end; stops at once if the object lacks anything
    but what is optional.
    """
    findings = Findings(member, family)
    with jax.enable_x64(True):
        _is_component(findings, member)
        _has_members(findings, member, protocol, optional)
        findings.stop_if_any()
        yield findings
    findings.stop_if_any()


def _is_component(findings: Findings, member: Any) -> None:
    """The object is a pytree of numbers that JAX can take apart and put together with anything in
    place of the numbers.
    """
    if isinstance(member, type):
        findings.add("it is a class", "Give an instance, with brackets")
        findings.stop_if_any()
    try:
        checks.flat_enough(findings.family, member)
        leaves, structure = jax.tree.flatten(member)
    except Exception as error:
        findings.add(
            f"JAX cannot take it apart ({type(error).__name__}: {checks.line(str(error))})"
        )
        findings.stop_if_any()
        raise
    if any(leaf is member for leaf in leaves):
        findings.add(
            "JAX does not know its class",
            "Decorate it with @iblf_jax.component, or register it with jax.tree_util",
        )
        findings.stop_if_any()
    for path, leaf in jax.tree_util.tree_leaves_with_path(member):
        numeric = isinstance(leaf, jax.Array | np.ndarray | np.generic | float) and jnp.issubdtype(
            jnp.result_type(leaf), jnp.floating
        )
        remedy = (
            "Make it a floating-point array, or declare it with iblf_jax.static if it is structure"
        )
        findings.require(
            numeric,
            f"the leaf {jax.tree_util.keystr(path).lstrip('.')} is {checks.shown(leaf)}, not a"
            " floating-point number",
            remedy,
        )
    try:
        rebuilt = jax.tree.unflatten(structure, [object() for _ in leaves])
        again: Any = jax.tree.structure(rebuilt)
        same = again == structure and hash(again) == hash(structure)
        findings.require(
            same, "it does not keep its structure when JAX takes it apart and puts it together"
        )
    except Exception as error:
        remedy = (
            "JAX rebuilds it with placeholders: convert and check in `check(self)` of a component,"
            " never in __init__ or __post_init__"
        )
        findings.add(f"it cannot be rebuilt by JAX ({type(error).__name__}: {error})", remedy)


def _has_members(
    findings: Findings, member: Any, protocol: type, optional: tuple[str, ...]
) -> None:
    for name, value in vars(protocol).items():
        if name.startswith("_") or name in optional:
            continue
        if not hasattr(member, name):
            text = (inspect.getdoc(value) or "").split("\n")[0]
            signature = (
                str(inspect.signature(value)).replace("self, ", "").split(" ->")[0]
                if callable(value)
                else ""
            )
            findings.add(f"{name}{_without_types(signature)} is missing", text)
    for name in getattr(protocol, "__annotations__", {}):
        findings.require(
            hasattr(member, name),
            f"the attribute {name!r} is missing",
            f"See the docstring of {protocol.__name__}",
        )


def _without_types(signature: str) -> str:
    return (
        "("
        + ", ".join(part.split(":")[0].strip() for part in signature.strip("()").split(", "))
        + ")"
        if signature
        else ""
    )


def shape_of(findings: Findings, label: str, call: Callable, *args: Any) -> Any:
    """Shapes and types of what `call(*args)` returns, or None and a finding if it raises."""
    try:
        return jax.eval_shape(call, *args)
    except Exception as error:
        first = str(error).strip().split("\n")[0]
        remedy = (
            "It is called with tracers: use jax.numpy, and `jnp.where` in place of `if`"
            if isinstance(error, jax.errors.JAXTypeError)
            else ""
        )
        findings.add(f"{label} raised {type(error).__name__}: {first}", remedy)
        return None


def has_shape(
    findings: Findings, label: str, got: Any, shape: tuple[int, ...], kind: Any = jnp.floating
) -> bool:
    """Whether an abstract result is an array of this shape and kind; a finding if not."""
    words = {jnp.floating: "floating-point numbers", jnp.bool_: "bool"}
    if got is None:
        return False
    if not hasattr(got, "shape"):
        findings.add(f"{label} gives {type(got).__name__}", f"It must be an array of shape {shape}")
        return False
    ok = findings.require(
        got.shape == shape, f"{label} has shape {got.shape}", f"It must be {shape}"
    )
    return ok and findings.require(
        jnp.issubdtype(got.dtype, kind), f"{label} is {got.dtype}", f"It must be {words[kind]}"
    )


def same_structure(findings: Findings, label: str, got: Any, like: Any) -> bool:
    """Whether two abstract pytrees have the same structure, shapes and types; a finding if not."""
    if got is None or like is None:
        return False
    structure: Any = jax.tree.structure(got)
    if structure != jax.tree.structure(like):
        findings.add(
            f"{label} has the structure {structure}",
            f"It must be that of the state, {jax.tree.structure(like)}",
        )
        return False
    pairs = list(zip(jax.tree.leaves(got), jax.tree.leaves(like), strict=True))
    described = " and ".join(
        f"{a.dtype}{list(a.shape)} for {b.dtype}{list(b.shape)}"
        for a, b in pairs
        if (a.shape, a.dtype) != (b.shape, b.dtype)
    )
    return findings.require(
        not described,
        f"{label} has {described}",
        "Shapes and types must be those of the state; it is carried by a scan",
    )


def in_dtype(tree: Any, dtype: str) -> Any:
    """A pytree with its floating-point numbers in another type."""

    def one(x):
        is_float = jnp.issubdtype(jnp.result_type(x), jnp.floating)
        return jnp.asarray(
            np.asarray(x, dtype if is_float else None)
        )  # by NumPy: JAX compiles a program for every shape

    return jax.tree.map(one, tree)


def probe(
    findings: Findings,
    outputs: Callable,
    member: Any,
    args: Sequence[Any],
    *,
    rtol: float = 1e-5,
    seed: int = 0,
) -> None:
    """Runs `outputs(member, *args) -> {name: array}` in all the ways in which the package does.

    Args:
      findings: where problems go.
      outputs: pure function of the member and of pytrees of floating-point numbers.
      member: the member.
      args: the other arguments, at a point where the functions are smooth.
      rtol: how well derivatives must agree.
      seed: of the directions.
    """
    point = in_dtype((member, *args), "float64")
    function = jax.jit(lambda p: outputs(*p))
    values = function(point)
    for name, value in values.items():
        findings.require(
            np.all(np.isfinite(value)),
            f"{name} is not finite at an ordinary point: {np.asarray(value)}",
        )
    findings.stop_if_any()
    _derivatives(findings, function, values, point, rtol, np.random.default_rng(seed))
    _batch(findings, function, values, point)
    _float32(findings, outputs, values, point)


def _derivatives(findings, function, values, point, rtol, rng) -> None:
    """Forward mode against central differences, reverse mode against forward mode."""

    def random_like(x):
        size = np.where(np.isfinite(x), np.maximum(np.abs(x), 0.1), 0.1)  # a limit may be infinite
        return rng.normal(size=np.shape(x)) * size

    def floats(p):
        return {k: v for k, v in function(p).items() if jnp.issubdtype(v.dtype, jnp.floating)}

    direction = jax.tree.map(random_like, point)
    weights = {
        k: rng.normal(size=v.shape)
        for k, v in values.items()
        if jnp.issubdtype(v.dtype, jnp.floating)
    }

    @jax.jit
    def both(point, direction, weights):
        _, forward = jax.jvp(floats, (point,), (direction,))
        _, pull = jax.vjp(floats, point)
        return forward, _dot(pull(weights)[0], direction)

    try:
        forward, reverse = both(point, direction, weights)
    except Exception as error:
        findings.add(
            f"it cannot be differentiated ({type(error).__name__}: {str(error).splitlines()[0]})",
            "Use jax.numpy only",
        )
        return
    ahead = function(jax.tree.map(lambda x, d: np.asarray(x) + STEP * d, point, direction))
    behind = function(jax.tree.map(lambda x, d: np.asarray(x) - STEP * d, point, direction))
    for name, slope in forward.items():
        difference = (np.asarray(ahead[name]) - np.asarray(behind[name])) / (2 * STEP)
        scale = max(
            1.0,
            float(np.max(np.abs(difference), initial=0)),
            float(np.max(np.abs(values[name]), initial=0)),
        )
        apart = float(np.max(np.abs(slope - difference), initial=0))
        remedy = (
            "Is something rounded, cut off, stopped (stop_gradient) or given a wrong custom"
            " derivative?"
        )
        findings.require(
            apart <= rtol * scale,
            f"the derivative of {name} differs from its finite difference by {apart:.2g}",
            remedy,
        )
    along = sum(float(np.vdot(weights[k], forward[k])) for k in weights)
    size = max([1.0, *(float(np.max(np.abs(x), initial=0)) for x in forward.values())])
    off = abs(float(reverse) - along)
    remedy = "Look at custom derivatives and at jnp.where over infinities"
    findings.require(
        off <= 1e-8 * size * max(1, len(forward)),
        f"forward and reverse derivative differ by {off:.2g}",
        remedy,
    )


def _dot(a: Any, b: Any) -> Any:
    return sum(jnp.vdot(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def _batch(findings, function, values, point) -> None:
    """A batch of three points gives what each gives alone."""
    factors = (1.0, 1.001, 0.999)
    points = [jax.tree.map(lambda x, c=c: c * np.asarray(x), point) for c in factors]
    try:
        batch = jax.jit(jax.vmap(function))(jax.tree.map(lambda *xs: np.stack(xs), *points))
    except Exception as error:
        findings.add(
            f"it does not work under vmap ({type(error).__name__}: {str(error).splitlines()[0]})",
            "Write it for one run, in jax.numpy",
        )
        return
    alone = [values, *(function(p) for p in points[1:])]
    for name in values:
        for i, one in enumerate(alone):
            scale = max(1.0, float(np.max(np.abs(one[name]), initial=0)))
            off = float(
                np.max(
                    np.abs(np.asarray(batch[name][i], float) - np.asarray(one[name], float)),
                    initial=0,
                )
            )
            findings.require(
                off <= 1e-9 * scale, f"{name} differs by {off:.2g} between vmap and one run"
            )


def _float32(findings, outputs, values, point) -> None:
    """float32 in, float32 out, and about the same numbers."""
    small = in_dtype(point, "float32")
    function = jax.jit(lambda p: outputs(*p))
    result = function(small)
    for name, value in result.items():
        if jnp.issubdtype(values[name].dtype, jnp.floating):
            remedy = (
                "Make constants with the dtype of an argument, jnp.zeros_like(q), or keep them"
                " plain Python numbers"
            )
            if findings.require(
                value.dtype == jnp.float32, f"{name} is {value.dtype} for float32 arguments", remedy
            ):
                scale = max(1.0, float(np.max(np.abs(values[name]), initial=0)))
                off = float(
                    np.max(np.abs(np.asarray(value, float) - np.asarray(values[name])), initial=0)
                )
                findings.require(off <= 5e-3 * scale, f"{name} in float32 is off by {off:.2g}")


def find_jump(
    function: Callable, start: float, end: float, known: Sequence[float] = ()
) -> float | None:
    """A time in [start, end] at which `function` (t -> array) jumps, other than the known ones;
    None if none was seen.

    The intervals of a grid with the largest changes are halved until a smooth function would not
    change any more.
    """
    batched = jax.jit(jax.vmap(function))
    edges = np.linspace(start, end, 2001)
    values = np.asarray(batched(jnp.asarray(edges)), float).reshape(edges.size, -1)
    scale = max(float(np.max(np.abs(values), initial=0)), 1e-9)
    change = np.max(np.abs(np.diff(values, axis=0)), axis=1, initial=0)
    for index in np.argsort(-change)[:8]:
        a, b = edges[index], edges[index + 1]
        if any(a - 1e-9 <= t <= b + 1e-9 for t in known):
            continue
        while b - a > 1e-10 * max(1.0, abs(end)):
            inner = np.linspace(a, b, 2001)
            steps = np.max(
                np.abs(
                    np.diff(
                        np.asarray(batched(jnp.asarray(inner)), float).reshape(2001, -1), axis=0
                    )
                ),
                axis=1,
            )
            a, b = inner[np.argmax(steps)], inner[np.argmax(steps) + 1]
        if np.max(steps) > 1e-6 * scale:
            return float(b)
    return None
