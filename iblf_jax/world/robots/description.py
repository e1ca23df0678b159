"""Reads a robot's description, URDF or MJCF, from an untrusted file.

Such a file may be malformed, very large, an entity expansion attack, or of another format than its
ending.  It is read with limits and parsed without entities, and so are the files that an MJCF
includes.  The `mujoco` library receives a copy with only the elements and attributes that define
kinematics and inertias, without visuals, collision geometry and sensors.  The only other files that
are read are meshes that define the weight of a body of an MJCF (`meshes`).
"""

from __future__ import annotations

import math
import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from xml.parsers import expat

from iblf_jax.core import checks

MAX_BYTES = 8 << 20
"""Bytes of a description, its includes together."""
MAX_DEPTH = 200
"""Levels of elements."""
MAX_NESTED = 8
"""Files that include each other."""
MAX_ELEMENTS = 30_000
"""Elements."""
MAX_BODIES = 1000
"""Links or bodies."""
LARGEST_NUMBER = 1e10
"""Largest length, mass or inertia of a robot in SI units."""
MAX_RANGE = 1e20
"""Largest range or friction; a very large number may mean "none" or "locked"."""
MAX_NUMBERS = 100
"""Numbers of an attribute, except those of a mesh."""
DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
"""A number of a description.

Python's `float` also accepts "2_5", digits of other scripts, "infinity" and "nan".
"""
ARGUMENTS = ("base: ", "tip: ", "locked: ", "locked[", "gravity: ")
"""Beginnings of messages about an argument of `load` instead of the content of the file."""
SPACES = " \t\r\n"
"""What separates the numbers of an attribute: the white space of XML."""


Shown = checks.Words


def read(path: str | os.PathLike, field: str = "path") -> ET.Element:
    """The root element of a description.

    Args:
      path: a file, URDF or MJCF.
      field: what the caller's argument is called in messages.

    Raises:
      ValueError: no such file, not a file, too large, too deep, not XML, or XML that declares
        entities.
    """
    place = checks.file_path(field, path, "a URDF or MJCF file")
    try:
        root = _Reader(place.parent, field).parse(place)
    except ValueError as error:
        raise of_file(path, error) from error
    if root.tag not in ("robot", "mujoco"):
        remedy = f"Its root element is <{root.tag[:40]}>, not <robot> or <mujoco>."
        if root.tag == "sdf":
            remedy = "It is SDF."
        raise checks.fail(field, str(path), "a URDF or MJCF file", remedy)
    return root


def of_file(path: str | os.PathLike, error: ValueError) -> ValueError:
    """The error with the file's name in front, unless its message names the file already.

    Where an argument of the caller is at fault, its name stays in front and the file's follows.
    """
    text = str(error)
    if text.startswith(f"{path}: ") or repr(str(path)) in text:
        return error
    if text.startswith(ARGUMENTS):
        return ValueError(f"{text} The file is {checks.one_line(str(path), 'field')}.")
    return checks.with_location(path, error)


class _Reader:
    """Reads files with one budget of bytes and elements for all of them."""

    def __init__(self, folder: Path, field: str) -> None:
        self.folder = folder
        self.field = field
        self.bytes_left = MAX_BYTES
        self.elements_left = MAX_ELEMENTS

    def parse(self, path: Path, nesting: int = 0) -> ET.Element:
        """The root element of a file, with included files in place of their <include>."""
        data = self._bytes(path)
        builder, parser = ET.TreeBuilder(), expat.ParserCreate()
        depth = 0

        def fail(problem: str, remedy: str = "") -> ValueError:
            where = f"line {parser.CurrentLineNumber} of {str(path)!r}"
            return ValueError(f"{where}: {problem}." + (f" {remedy}" if remedy else ""))

        def start(tag: str, attributes: dict[str, str]) -> None:
            nonlocal depth
            depth += 1
            self.elements_left -= 1
            if depth > MAX_DEPTH:
                raise fail(f"more than {MAX_DEPTH} levels of elements")
            if self.elements_left < 0:
                raise fail(f"more than {MAX_ELEMENTS} elements")
            if tag.startswith("xacro:"):
                raise fail(
                    f"<{tag[:40]}> is a macro",
                    "Expand the file first: xacro arm.urdf.xacro > arm.urdf",
                )
            builder.start(tag, attributes)

        def end(tag: str) -> None:
            nonlocal depth
            depth -= 1
            builder.end(tag)

        def doctype(*_: object) -> None:
            raise fail(
                "it declares a document type or entities",
                "A robot needs none: remove <!DOCTYPE ...>.",
            )

        parser.StartElementHandler, parser.EndElementHandler = start, end
        parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = doctype
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            raise fail(
                f"malformed XML, {expat.ErrorString(error.code)}", "Correct it there."
            ) from None
        except (LookupError, UnicodeError) as error:
            raise fail(f"an encoding that cannot be read, {error}") from None
        return self._with_includes(builder.close(), path, nesting)

    def _with_includes(self, root: ET.Element, path: Path, nesting: int) -> ET.Element:
        """`root` of an MJCF, with the children of each file that it includes in the place of the
        <include>.
        """
        if root.tag != "mujoco":
            return root
        if nesting > MAX_NESTED:
            expected = f"at most {MAX_NESTED} files inside each other"
            raise checks.fail("<include>", str(path), expected, "Does it include itself?")
        for parent in list(root.iter()):
            for element in [child for child in parent if child.tag == "include"]:
                file = element.get("file")
                if not file:
                    raise checks.fail("<include>", Shown("no file"), 'file="..."')
                children = list(self.parse(self._included(file), nesting + 1))
                at = list(parent).index(element)
                parent[at : at + 1] = children
        return root

    def _included(self, file: str) -> Path:
        """The path of an included file, which must be in the main file's folder or below it.

        Symbolic links are followed before the comparison: a link cannot lead out of the folder.
        """
        folder = os.path.realpath(self.folder)
        if "\0" not in file and not os.path.isabs(file):
            target = os.path.realpath(os.path.join(folder, file))
            if os.path.commonpath([folder, target]) == folder:
                return Path(target)
        expected = f"a file in the folder of the description, {folder}, or in a folder below it"
        remedy = "Copy the file into that folder and name it by a relative path."
        raise checks.fail("<include>: file", file, expected, remedy)

    def _bytes(self, path: Path) -> bytes:
        data = contents(self.field, path, self.bytes_left, "the path of a URDF or MJCF file")
        self.bytes_left -= len(data)
        if self.bytes_left < 0:
            expected = f"a file of at most {MAX_BYTES >> 20} MiB"
            remedy = "A description without meshes is far smaller."
            raise checks.fail(self.field, str(path), expected, remedy)
        return data


def contents(field: str, path: Path, most: int, expected: str, remedy: str = "") -> bytes:
    """The first `most` + 1 bytes of a file; ValueError with `field` unless the file can be read."""
    try:
        if not path.is_file():
            found = "Nothing is there."
            if path.is_dir():
                found = "It is a directory."
            elif path.exists():
                found = "It is not a file."
            raise checks.fail(field, str(path), expected, f"{found} {remedy}".strip())
        with path.open("rb") as file:
            return file.read(most + 1)
    except OSError as error:
        found = f"It cannot be read: {error}."
        raise checks.fail(field, str(path), expected, f"{found} {remedy}".strip()) from None


def label(element: ET.Element) -> str:
    """The name of an element in messages, such as link 'forearm'."""
    name = element.get("name")
    if not name:
        return f"<{element.tag[:40]}>"
    return f"{element.tag} {name[:60]!r}"


def floats(
    where: str,
    text: str,
    count: int | None = None,
    *,
    most: float = LARGEST_NUMBER,
    longest: int = MAX_NUMBERS,
) -> list[float]:
    """The numbers that an attribute holds; ValueError, with `where`, unless they are as many as
    expected, finite and below `most`.
    """
    words = [word for word in re.split(f"[{SPACES}]+", text.strip(SPACES)) if word]
    expected = {None: "numbers", 1: "one number"}.get(count, f"{count} numbers")
    if (count is not None and len(words) != count) or not 1 <= len(words) <= longest:
        raise checks.fail(where, text, expected)
    if not all(DECIMAL.fullmatch(word) for word in words):
        remedy = "Write decimal numbers such as 0.25, -3 or 1.5e-3, separated by spaces."
        expected = f"{expected}, finite, in decimal notation and in SI units"
        raise checks.fail(where, text, expected, remedy)
    values = [float(word) for word in words]
    if not all(math.isfinite(x) and abs(x) < most for x in values):
        expected = f"{expected}, finite and in SI units"
        raise checks.fail(where, text, expected, f"Its size must be below {most:g}.")
    return values
