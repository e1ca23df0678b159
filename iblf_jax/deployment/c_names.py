"""Parameters as a C struct whose fields are the paths of leaves; valid C names, comments and
literals.

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
    text = "".join(c if re.fullmatch(r"[A-Za-z0-9_]", c) else f"_u{ord(c):x}_" for c in name)
    return f"{text}_" if text in RESERVED or not re.match(r"[A-Za-z_]", text) else text


def comment(text: str) -> str:
    """Text that can stand in a C comment, whatever is in it: ASCII without the marks of comments,
    trigraphs or a line's end.
    """
    return re.sub(
        r"\?(?=\?)",
        "? ",
        json.dumps(text)[1:-1].replace("*/", "* /").replace("/*", "/ *").replace("\\", "|"),
    )


def number(x: float, is_float: bool) -> str:
    """A C literal of exactly this number, as a float or a double; what is not finite is a name of
    `math.h`.
    """
    with np.errstate(over="ignore"):
        value = float(np.float32(x)) if is_float else float(x)
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "-INFINITY" if value < 0 else "INFINITY"
    return f"{value!r}{'f' if is_float else ''}"


class Field(NamedTuple):
    """One leaf that the code reads."""

    path: str
    names: tuple[str, ...]
    """Of the structs that hold it, and its own."""
    shape: tuple[int, ...]
    unit: str
    value: np.ndarray

    @property
    def place(self) -> str:
        """Where it is in the struct of all parameters: `controller.K2`."""
        return ".".join(self.names)


class Parameters(NamedTuple):
    """The leaves that programs read."""

    fields: tuple[Field, ...]
    numbers: tuple[str, ...]
    """What C calls each number of the scenario, leaf after leaf; "" for those that are not read."""

    @staticmethod
    def of(scenario: Scenario, programs: Iterable[Program]) -> Parameters:
        """Those of a scenario that any of the programs reads, as fields of a struct `p` points
        to.
        """
        read = {node.value for program in programs for node in program.nodes if node.op == "shared"}
        fields, numbers = list[Field](), list[str]()
        for leaf in parameters(scenario, named=False):
            size = math.prod(leaf.shape)
            if read.isdisjoint(range(len(numbers), len(numbers) + size)):
                numbers += [""] * size
                continue
            names = tuple(_field_name(token) for token in parse(leaf.path))
            fields.append(Field(leaf.path, names, leaf.shape, leaf.unit, np.asarray(leaf.value)))
            numbers += [f"p->{fields[-1].place}{_index(place)}" for place in np.ndindex(leaf.shape)]
        assert len(numbers) == sum(np.size(x) for x in jax.tree.leaves(scenario))
        return Parameters(tuple(_in_order(_nested(fields))), tuple(numbers))

    @property
    def size(self) -> int:
        """How many numbers they are."""
        return sum(math.prod(field.shape) for field in self.fields)

    def declaration(self, real: str, joints: Sequence[str] = ()) -> str:
        """The members of the struct, of the type `real`."""
        return "\n".join(_members(_nested(self.fields), 1, real, joints)) or f"  {real} none;"

    def defaults(self, is_float: bool) -> str:
        """Their values, as C's initialiser."""
        return _initialiser(_nested(self.fields), is_float) if self.fields else "{0}"


def _field_name(token: str | int) -> str:
    return f"part_{token}" if isinstance(token, int) else identifier(token)


def _index(place: tuple[int, ...]) -> str:
    return "".join(f"[{i}]" for i in place)


def _nested(fields: Sequence[Field]) -> dict[str, Any]:
    """The fields as a tree of structs."""
    tree: dict[str, Any] = {}
    for field in fields:
        *outer, last = field.names
        node = tree
        for name in outer:
            node = node.setdefault(name, {})
            if isinstance(node, Field):
                raise checks.fail("scenario", field.path, "paths that differ as names of C")
        if last in node:
            raise checks.fail("scenario", field.path, "paths that differ as names of C")
        node[last] = field
    return tree


def _in_order(tree: dict[str, Any]) -> Iterator[Field]:
    """The fields as they stand in the struct."""
    for part in tree.values():
        yield from (part,) if isinstance(part, Field) else _in_order(part)


def _members(tree: dict[str, Any], depth: int, real: str, joints: Sequence[str]) -> list[str]:
    lines, indent = list[str](), "  " * depth
    for name, part in tree.items():
        if isinstance(part, Field):
            of = (
                f", joint by joint: {', '.join(map(str, joints))}"
                if joints and part.shape[:1] == (len(joints),)
                else ""
            )
            lines.append(
                f"{indent}{real} {name}{_index(part.shape)};  /* {comment(part.path)}"
                f" [{comment(part.unit)}]{comment(of)} */"
            )
        else:
            lines += [
                f"{indent}struct {{",
                *_members(part, depth + 1, real, joints),
                f"{indent}}} {name};",
            ]
    return lines


def _initialiser(part: Any, is_float: bool, depth: int = 0) -> str:
    if isinstance(part, dict):
        inner = ",\n".join(
            f"{'  ' * (depth + 1)}.{name} = {_initialiser(x, is_float, depth + 1)}"
            for name, x in part.items()
        )
        return f"{{\n{inner}\n{'  ' * depth}}}"
    value = part.value if isinstance(part, Field) else part
    if value.ndim == 0:
        return number(float(value), is_float)
    return "{" + ", ".join(_initialiser(x, is_float) for x in value) + "}"
