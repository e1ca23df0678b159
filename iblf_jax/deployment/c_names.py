"""The parameters of exported code as a C struct whose fields are named by the paths of the leaves;
valid C names, comments and literals.

Text from a file or a user's class never enters the generated code unescaped: a name keeps letters,
digits and underscores, and a comment is an ASCII JSON string that cannot end the comment.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax.core import checks
from iblf_jax.kernels import Program
from iblf_jax.simulation.paths import parameters, parse
from iblf_jax.simulation.scenario import Scenario

RESERVED = frozenset(
    re.findall(
        r"\w+",
        """
        auto break case char const continue default do double else enum extern float for
        goto if inline int long register restrict return short signed sizeof static struct
        switch typedef union unsigned void volatile while asm typeof bool true false class
        new delete this template typename namespace private public protected friend virtual
        explicit mutable operator using try catch throw export import and and_eq bitand
        bitor compl not not_eq or or_eq xor xor_eq alignas alignof constexpr decltype
        noexcept nullptr static_assert thread_local typeid wchar_t const_cast dynamic_cast
        reinterpret_cast static_cast concept requires real integer F I FN NULL NAN INFINITY
        SEPARATE RESTRICT TABLE MASK AT DOMAIN OVERFLOW UNDERFLOW SING PLOSS TLOSS linux
        unix
        """,
    )
)
"""Words of C and C++, of their headers, and of the generated code."""
FILES = frozenset(
    re.findall(
        r"\w+",
        """
        selftest vectors assert complex ctype errno fenv float inttypes iso646 limits locale
        math setjmp signal stdarg stdbool stddef stdint stdio stdlib string tgmath time
        wchar wctype all clean edit_cache help install m package package_source preinstall
        rebuild_cache test
        """,
    )
)
"""Reserved file names in lower case: the other generated files, headers of C, and targets and
libraries of CMake."""


def identifier(name: str) -> str:
    """A C identifier for a Python name."""
    text = re.sub(r"[^A-Za-z0-9_]", lambda found: f"_u{ord(found[0]):x}_", name)
    if text in RESERVED or not re.match(r"[A-Za-z_]", text):
        return f"{text}_"
    return text


def comment(text: str) -> str:
    """Any text as the content of a C comment: ASCII without comment marks or trigraphs."""
    ascii_text = json.dumps(text)[1:-1]
    for mark, replacement in (("*/", "* /"), ("/*", "/ *"), ("\\", "|")):
        ascii_text = ascii_text.replace(mark, replacement)
    return re.sub(r"\?(?=\?)", "? ", ascii_text)


def number(x: float, is_float: bool) -> str:
    """A C literal of exactly this float or double, or the name that `math.h` has for NaN or
    infinity.
    """
    dtype, suffix = C_LITERALS[is_float]
    with np.errstate(over="ignore"):
        value = float(dtype(x))
    if math.isfinite(value):
        return f"{value!r}{suffix}"
    return {"nan": "NAN", "inf": "INFINITY", "-inf": "-INFINITY"}[repr(value)]


C_LITERALS: dict[bool, tuple[Any, str]] = {False: (np.float64, ""), True: (np.float32, "f")}
"""Whether a number is a float -> its NumPy type and the suffix of its literals in C."""


class Field(NamedTuple):
    """One leaf that the code reads."""

    path: str
    names: tuple[str, ...]
    """Names of the structs that contain it, outermost first, and its own name."""
    shape: tuple[int, ...]
    unit: str
    value: np.ndarray

    @property
    def place(self) -> str:
        """The C expression for it in the struct of all parameters, such as `controller.K2`."""
        return ".".join(self.names)


class Parameters(NamedTuple):
    """The leaves of a scenario that exported programs read."""

    fields: tuple[Field, ...]
    numbers: tuple[str, ...]
    """The C expression for each number of the scenario, leaf after leaf; "" for those that are not
    read."""

    @staticmethod
    def of(scenario: Scenario, programs: Iterable[Program]) -> Parameters:
        """The leaves of a scenario that any of the programs reads, as fields of the struct `*p`."""
        read = {node.value for program in programs for node in program.nodes if node.op == "shared"}
        fields, numbers = list[Field](), list[str]()
        for leaf in parameters(scenario, named=False):
            size = math.prod(leaf.shape)
            if read.isdisjoint(range(len(numbers), len(numbers) + size)):
                numbers += [""] * size
                continue
            tokens = parse(leaf.path)
            names = tuple(f"part_{x}" if isinstance(x, int) else identifier(x) for x in tokens)
            fields.append(Field(leaf.path, names, leaf.shape, leaf.unit, np.asarray(leaf.value)))
            numbers += [f"p->{fields[-1].place}{_index(place)}" for place in np.ndindex(leaf.shape)]
        assert len(numbers) == sum(np.size(x) for x in jax.tree.leaves(scenario))
        return Parameters(tuple(_in_order(_nested(fields))), tuple(numbers))

    @property
    def size(self) -> int:
        """Number of floating-point numbers in the struct."""
        return sum(math.prod(field.shape) for field in self.fields)

    def declaration(self, real: str, joints: Sequence[str] = ()) -> str:
        """The members of the struct, of the type `real`."""
        return "\n".join(_members(_nested(self.fields), 1, real, joints)) or f"  {real} none;"

    def defaults(self, is_float: bool) -> str:
        """The values as an initialiser of the struct."""
        if not self.fields:
            return "{0}"
        return _initialiser(_nested(self.fields), is_float)


def _index(place: tuple[int, ...]) -> str:
    return "".join(f"[{i}]" for i in place)


def _nested(fields: Sequence[Field]) -> dict[str, Any]:
    """The fields as a tree of structs."""
    tree: dict[str, Any] = {}
    for field in fields:
        *outer, last = field.names
        node: Any = tree
        for name in outer:
            node = node.setdefault(name, {})
            if isinstance(node, Field):
                break
        if isinstance(node, Field) or last in node:
            raise checks.fail("scenario", field.path, "paths that differ as names of C")
        node[last] = field
    return tree


def _in_order(tree: dict[str, Any]) -> Iterator[Field]:
    """The fields in the order of the struct."""
    for part in tree.values():
        if isinstance(part, Field):
            yield part
        else:
            yield from _in_order(part)


def _members(tree: dict[str, Any], depth: int, real: str, joints: Sequence[str]) -> list[str]:
    lines, indent = list[str](), "  " * depth
    for name, part in tree.items():
        if not isinstance(part, Field):
            inner = _members(part, depth + 1, real, joints)
            lines += [f"{indent}struct {{", *inner, f"{indent}}} {name};"]
            continue
        meaning = f"{comment(part.path)} [{comment(part.unit)}]"
        if joints and part.shape[:1] == (len(joints),):
            meaning += comment(f", joint by joint: {', '.join(joints)}")
        lines.append(f"{indent}{real} {name}{_index(part.shape)};  /* {meaning} */")
    return lines


def _initialiser(part: Any, is_float: bool, depth: int = 0) -> str:
    if isinstance(part, dict):
        inner = ",\n".join(
            f"{'  ' * (depth + 1)}.{name} = {_initialiser(x, is_float, depth + 1)}"
            for name, x in part.items()
        )
        return f"{{\n{inner}\n{'  ' * depth}}}"
    if isinstance(part, Field):
        part = part.value
    if part.ndim == 0:
        return number(float(part), is_float)
    return "{" + ", ".join(_initialiser(x, is_float) for x in part) + "}"
