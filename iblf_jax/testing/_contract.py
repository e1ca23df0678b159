"""The tools of all checkers: a list of findings, and generic tests of a component's functions.

A checker describes the functions of a component as one pure function `outputs(member, *args) ->
{name: array}`.  `check_function` runs it compiled, batched, differentiated in both modes and in
float32, and records the problems.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple, NoReturn, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from iblf_jax.core import checks
from iblf_jax.core.families import adopt, required_members

STEP = 1e-6
"""Relative step of the central differences, whose error is about 1e-9 in float64."""


STACKED = (
    "All rows of jnp.stack must have one shape: write 0.0 * x[0], or jnp.zeros_like(x[0]), for a"
    " row of zeros, and add a constant to it"
)
"""The remedy for rows of different shapes."""


T = TypeVar("T")


class ContractError(AssertionError):
    """A component violates the contract of its family; the message lists the problems with their
    remedies.
    """


class StoppedCheckError(Exception):
    """A check that cannot go on; the reason is among the findings."""


class Findings:
    """The problems of one component."""

    def __init__(self, member: object, family: str):
        self.name = type(member).__name__
        self.family = family
        self.problems: list[str] = []
        self.remarks: list[str] = []
        """Properties that the user should know and that violate no contract."""
        self.kind = ""
        """Suffix of all labels of the current check: the type of its arguments."""

    def add(self, problem: str, remedy: str = "") -> None:
        """Records a problem, once."""
        text = f"{problem}. {remedy}".strip()
        if text not in self.problems:
            self.problems.append(text)

    def remark(self, remark: str, remedy: str) -> None:
        """Records a remark, once."""
        text = f"{remark}. {remedy}."
        if text not in self.remarks:
            self.remarks.append(text)

    def require(self, condition: object, problem: str, remedy: str = "") -> bool:
        """Records the problem unless the condition holds; returns whether it holds."""
        if not bool(condition):
            self.add(problem, remedy)
        return bool(condition)

    def stop(self, problem: str, remedy: str = "") -> NoReturn:
        """Records a problem that ends the check."""
        self.add(problem, remedy)
        raise StoppedCheckError

    def result_is(self, condition: object, label: str, got: object, remedy: str) -> None:
        """Stops the check unless a result has the type that the condition requires."""
        if not condition:
            self.stop(f"{label} gives {type(got).__name__}", remedy)

    def stop_if_any(self) -> None:
        """Raises ContractError if there are problems."""
        if self.problems:
            listed = "\n".join(f"  - {text}" for text in self.problems)
            raise ContractError(
                f"{self.name} does not fit the contract of"
                f" {checks.with_article(self.family)}:\n{listed}"
            )


@contextmanager
def examine(member: object, family: str, base: type) -> Iterator[Findings]:
    """The context of a checker: computes in float64, and raises the findings at the end.

    Args:
      member: the component.
      family: name of the family, for messages.
      base: base class of the family, which adopts the component's class.

    Raises:
      ContractError: at once if the object is not a component or lacks a required member.
    """
    findings = Findings(member, family)
    with jax.enable_x64(True), suppress(StoppedCheckError):
        _is_component(findings, member)
        _has_members(findings, member, base)
        findings.stop_if_any()
        adopt(type(member), base)
        yield findings
    findings.stop_if_any()


def _is_component(findings: Findings, member: object) -> None:
    """Requires a pytree of floating-point numbers that JAX can flatten, and unflatten with other
    objects instead of the numbers.
    """
    if isinstance(member, type):
        findings.stop("it is a class", "Pass an instance, with brackets")
    try:
        checks.flat_enough(findings.family, member)
        leaves, structure = jax.tree.flatten(member)
    except Exception as error:
        findings.stop(
            f"JAX cannot flatten it ({type(error).__name__}: {checks.one_line(str(error))})"
        )
    if any(leaf is member for leaf in leaves):
        remedy = "Decorate it with @iblf_jax.component, or register it with jax.tree_util"
        findings.stop("JAX does not know its class", remedy)
    remedy = "Make it a floating-point array, or declare it with iblf_jax.static"
    for path, leaf in jax.tree_util.tree_leaves_with_path(member):
        name = jax.tree_util.keystr(path).lstrip(".")
        problem = f"the leaf {name} is {checks.shown(leaf)}, not a floating-point number"
        is_number = isinstance(leaf, jax.Array | np.ndarray | np.generic | float)
        findings.require(is_number and is_float(leaf), problem, remedy)
    try:
        rebuilt = jax.tree.unflatten(structure, [object() for _ in leaves])
        again: Any = jax.tree.structure(rebuilt)
        same = again == structure and hash(again) == hash(structure)
        findings.require(same, "its structure changes when JAX flattens and unflattens it")
    except Exception as error:
        remedy = (
            "JAX rebuilds it with placeholders: convert and check in `check(self)` of a component,"
            " never in __init__ or __post_init__"
        )
        findings.add(f"it cannot be rebuilt by JAX ({type(error).__name__}: {error})", remedy)


def is_float(x: ArrayLike) -> bool:
    """Whether numbers are floating-point numbers."""
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


def first_line(error: Exception) -> str:
    """The class of an exception and the first line of its text."""
    text = str(error).strip().partition("\n")[0]
    return f"{type(error).__name__}: {text.rstrip('.')}"


def _has_members(findings: Findings, member: object, base: type) -> None:
    for name in required_members(base):
        if hasattr(member, name):
            continue
        method = getattr(base, name, None)
        if method is None:
            findings.add(f"the attribute {name!r} is missing", f"See {base.__name__}")
            continue
        arguments = ""
        if callable(method):
            names = [word for word in inspect.signature(method).parameters if word != "self"]
            arguments = f"({', '.join(names)})"
        text = (inspect.getdoc(method) or "").split("\n")[0]
        findings.add(f"{name}{arguments} is missing", text)


def shape_of(findings: Findings, label: str, call: Callable, *args: Any) -> Any:
    """Shapes and types of the result of `call(*args)`; the check stops if it raises."""
    try:
        return jax.eval_shape(call, *args)
    except Exception as error:
        remedy = ""
        if isinstance(error, jax.errors.JAXTypeError):
            remedy = "It is called with tracers: use jax.numpy, and `jnp.where` in place of `if`"
        elif "stack" in str(error):
            remedy = STACKED
        findings.stop(f"{label}{findings.kind} raised {first_line(error)}", remedy)


def traced_methods() -> Callable[[str], Callable[..., Any]]:
    """The methods of components as JAX keeps them: a function of a name that returns the method,
    of (component, *arguments).

    JAX transforms what it has traced, so that Python runs once for each type of the arguments.
    """

    @functools.cache
    def method(name: str) -> Callable[..., Any]:
        return jax.jit(lambda part, *arguments: getattr(part, name)(*arguments))

    return method


def abstract_shape(x: object) -> tuple[int, ...]:
    """The shape of an abstract result; () for objects that are not arrays."""
    shape: tuple[int, ...] = getattr(x, "shape", ())
    return shape


def has_shape(
    findings: Findings, label: str, got: Any, shape: tuple[int, ...], kind: Any = jnp.floating
) -> bool:
    """Requires that an abstract result is an array of this shape and kind."""
    words = {jnp.floating: "floating-point numbers", jnp.bool_: "bool"}
    label += findings.kind
    if not hasattr(got, "shape"):
        findings.add(f"{label} gives {type(got).__name__}", f"It must be an array of shape {shape}")
        return False
    if not findings.require(
        got.shape == shape, f"{label} has shape {got.shape}", f"It must be {shape}"
    ):
        return False
    is_kind = jnp.issubdtype(got.dtype, kind)
    return findings.require(is_kind, f"{label} is {got.dtype}", f"It must be {words[kind]}")


def call_has_shape(
    findings: Findings, label: str, call: Callable, args: Sequence[Any], shape: tuple[int, ...]
) -> bool:
    """Requires that `call(*args)` returns floating-point numbers of this shape."""
    try:
        got = shape_of(findings, label, call, *args)
    except StoppedCheckError:
        return False
    return has_shape(findings, label, got, shape)


def same_structure(findings: Findings, label: str, got: object, like: object) -> None:
    """Requires that two abstract pytrees have the same structure, shapes and types."""
    label += findings.kind
    structure: Any = jax.tree.structure(got)
    expected: Any = jax.tree.structure(like)
    if structure != expected:
        remedy = f"It must be that of the state, {expected}"
        findings.add(f"{label} has the structure {structure}", remedy)
        return
    different = []
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(like), strict=True):
        if (a.shape, a.dtype) != (b.shape, b.dtype):
            different.append(f"{a.dtype}{list(a.shape)} for {b.dtype}{list(b.shape)}")
    findings.require(
        not different,
        f"{label} has {' and '.join(different)}",
        "Shapes and types must be those of the state, which a scan carries",
    )


def in_dtype(tree: T, dtype: str) -> T:
    """A pytree with its floating-point numbers in another type."""

    def convert(x):
        # NumPy converts without compiling a program for every shape, unlike JAX.
        return jnp.asarray(np.asarray(x, dtype if is_float(x) else None))

    return jax.tree.map(convert, tree)


def in_both_types(findings: Findings, check: Callable, *args: Any) -> None:
    """Runs `check(findings, *args)` in float64 and in float32, then raises the problems."""
    for dtype in ("float64", "float32"):
        findings.kind = f" ({dtype})"
        with suppress(StoppedCheckError):
            check(findings, *in_dtype(args, dtype))
    findings.kind = ""
    findings.stop_if_any()


def leaves_by_name(name: str, tree: object) -> dict[str, Any]:
    """The leaves of a pytree by name, for the result of an `outputs` function."""
    return {f"{name}, leaf {i}": x for i, x in enumerate(jax.tree.leaves(tree))}


def largest(x: ArrayLike) -> float:
    """The largest absolute value; 0 for an empty array."""
    return float(np.max(np.abs(x), initial=0))


def at_each(function: Callable[..., T], *rows: Iterable[Any]) -> T:
    """The results of a compiled function at several points, as NumPy arrays with a leading axis.

    To call a program for each point costs less than to trace and to compile one for all points.
    """
    found = [function(*point) for point in zip(*rows, strict=True)]
    return jax.tree.map(lambda *values: np.stack(values), *found)


def check_function(
    findings: Findings,
    outputs: Callable,
    member: object,
    args: Sequence[Any],
    *,
    rtol: float = 1e-5,
    seed: int = 0,
) -> Callable[[Any], dict[str, jax.Array]]:
    """Tests `outputs(member, *args) -> {name: array}` compiled, batched, differentiated in both
    modes and in float32.

    Args:
      findings: receives the problems.
      outputs: pure function of the component and of pytrees of floating-point numbers.
      member: the component.
      args: the other arguments, at a point where the functions are smooth.
      rtol: relative tolerance of derivatives.
      seed: seed of the random directions.

    Returns:
      `outputs` as a compiled function of the tuple (member, *args).
    """
    point = in_dtype((member, *args), "float64")
    # Python runs once for each type of numbers: what follows transforms what JAX has traced.
    function = jax.jit(lambda p: outputs(*p))
    values = function(point)
    for name, value in values.items():
        findings.require(
            np.all(np.isfinite(value)),
            f"{name} is not finite at an ordinary point: {np.asarray(value)}",
        )
    findings.stop_if_any()
    along = _directions(point, values, np.random.default_rng(seed))
    points = [jax.tree.map(lambda x, c=c: c * np.asarray(x), point) for c in BATCH]
    errors: dict[str, Exception] = {}

    @jax.jit
    def transformed(point, points, low, along):
        # All in one program, because each program has a cost of its own.
        found = {"float32": function(low)}
        for name, transform, arguments in (
            ("slopes", functools.partial(_slopes, function), (point, along)),
            ("batch", jax.vmap(function), (points,)),
        ):
            try:
                found[name] = transform(*arguments)
            except Exception as error:
                errors[name] = error
        return found

    stacked = jax.tree.map(lambda *xs: np.stack(xs), *points)
    found = transformed(point, stacked, in_dtype(point, "float32"), along)
    if "slopes" in errors:
        problem = f"it cannot be differentiated ({first_line(errors['slopes'])})"
        findings.add(problem, "Use only jax.numpy")
    else:
        _same_slopes(findings, function, values, point, along, found["slopes"], rtol)
    if "batch" in errors:
        problem = f"it does not work under vmap ({first_line(errors['batch'])})"
        findings.add(problem, "Write it for one run, in jax.numpy")
    else:
        single = [values, *(function(p) for p in points[1:])]
        _same_batch(findings, single, found["batch"])
    _same_in_float32(findings, values, found["float32"])
    return function


BATCH = (1.0, 1.001, 0.999)
"""Factors of the points of a batch."""


class Along(NamedTuple):
    """Random directions in which derivatives are compared."""

    direction: Any
    """Of the arguments, of their structure."""
    weights: dict[str, np.ndarray]
    """Of the results that are floating-point numbers."""


def _directions(point: Any, values: dict[str, jax.Array], rng: np.random.Generator) -> Along:
    def random_like(x):
        size = np.where(np.isfinite(x), np.maximum(np.abs(x), 0.1), 0.1)  # limits may be infinite
        return rng.normal(size=np.shape(x)) * size

    direction = jax.tree.map(random_like, point)
    weights = {k: rng.normal(size=v.shape) for k, v in values.items() if is_float(v)}
    return Along(direction, weights)


def _slopes(function: Callable, point: Any, along: Along) -> tuple[dict[str, jax.Array], jax.Array]:
    """The forward derivative of each result along a direction, and the reverse derivative of all
    of them with their weights along the same direction.
    """

    def floats(p):
        return {k: v for k, v in function(p).items() if is_float(v)}

    # Both are of one linear function, so that JAX differentiates once.
    linear = jax.linearize(floats, point)[1]
    (pulled,) = jax.linear_transpose(linear, point)(along.weights)
    return linear(along.direction), _dot(pulled, along.direction)


def _dot(a: Any, b: Any) -> Any:
    return sum(jnp.vdot(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def _same_slopes(findings, function, values, point, along, slopes, rtol) -> None:
    """Forward mode against central differences, reverse mode against forward mode."""
    forward, reverse = slopes
    ahead, behind = (
        function(jax.tree.map(lambda x, d, h=h: np.asarray(x) + h * d, point, along.direction))
        for h in (STEP, -STEP)
    )
    remedy = (
        "Look for rounding, clipping, stop_gradient and wrong custom derivatives in the function"
    )
    for name, slope in forward.items():
        difference = (np.asarray(ahead[name]) - np.asarray(behind[name])) / (2 * STEP)
        scale = max(1.0, largest(difference), largest(values[name]))
        off = largest(np.asarray(slope) - difference)
        problem = f"the derivative of {name} differs from its finite difference by {off:.2g}"
        findings.require(off <= rtol * scale, problem, remedy)
    total = sum(float(np.vdot(weight, forward[k])) for k, weight in along.weights.items())
    size = max([1.0, *map(largest, forward.values())])
    off = abs(float(reverse) - total)
    findings.require(
        off <= 1e-8 * size * max(1, len(forward)),
        f"forward and reverse derivative differ by {off:.2g}",
        "Look at custom derivatives and at jnp.where over infinities",
    )


def _same_batch(findings, single, batch) -> None:
    """Requires that a batch of points gives the results of single evaluations."""
    for name, rows in batch.items():
        for batched, one in zip(np.asarray(rows, float), single, strict=True):
            expected = np.asarray(one[name], float)
            off = largest(batched - expected)
            problem = f"{name} differs by {off:.2g} between vmap and one run"
            findings.require(off <= 1e-9 * max(1.0, largest(expected)), problem)


def _same_in_float32(findings, values, result) -> None:
    """Requires float32 results for float32 arguments, with about the same numbers."""
    remedy = "Make constants with the dtype of an argument, jnp.zeros_like(q), or Python numbers"
    for name, value in result.items():
        if not is_float(values[name]):
            continue
        problem = f"{name} is {value.dtype} for float32 arguments"
        if findings.require(value.dtype == jnp.float32, problem, remedy):
            off = largest(np.asarray(value, float) - np.asarray(values[name]))
            scale = max(1.0, largest(values[name]))
            findings.require(off <= 5e-3 * scale, f"{name} in float32 is off by {off:.2g}")


def find_jump(
    values: Callable[[np.ndarray], Any], start: float, end: float, known: Sequence[float] = ()
) -> float | None:
    """A time in [start, end] at which a function jumps, other than the known times; None if there
    is none.

    The search refines the intervals of a grid with the largest changes until a smooth function
    would not change any more.

    Args:
      values: the function at the times of a grid, (GRID,) -> (GRID, ...).
      start, end: of the interval [s].
      known: times of known jumps [s].
    """

    def at(times):
        return np.asarray(values(times), float).reshape(GRID, -1)

    def changes(times):
        return np.max(np.abs(np.diff(at(times), axis=0)), axis=1, initial=0)

    times = np.linspace(start, end, GRID)
    scale = max(largest(at(times)), 1e-9)
    for index in np.argsort(-changes(times))[:8]:
        a, b = times[index], times[index + 1]
        if any(a - 1e-9 <= t <= b + 1e-9 for t in known):
            continue
        while b - a > 1e-10 * max(1.0, abs(end)):
            inner = np.linspace(a, b, GRID)
            steps = changes(inner)
            steepest = np.argmax(steps)
            a, b = inner[steepest], inner[steepest + 1]
        if np.max(steps) > 1e-6 * scale:
            return float(b)
    return None


GRID = 2001
"""Number of points of the grids that `find_jump` searches."""
