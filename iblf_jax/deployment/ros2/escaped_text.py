"""Numbers and names as text of YAML 1.1, which the parameter files of ROS 2 have, and of Markdown.

Names of joints and links come from files of robots: they may contain quotes, marks of comments and
of tables, and characters beyond ASCII.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence

from iblf_jax.core import checks

MARKUP = frozenset("`|\\")
"""Characters that code between backticks in a table does not contain as they are."""


LONGEST_NAME = 500
"""Characters of a name: keys of YAML have at most 1024, and an escaped character is two."""


def check_printable(field: str, names: Sequence[str], remedy: str) -> None:
    """Raises ValueError for a name that is too long, or with a line break or another character that
    is not printable, which neither a message of ROS nor a README shows as it is.
    """
    for name in names:
        if not name.isprintable() or len(name) > LONGEST_NAME:
            expected = f"at most {LONGEST_NAME} characters in a name, all of them printable"
            raise checks.fail(field, name, expected, remedy)


def yaml_names(names: Iterable[str]) -> str:
    """A list of printable names."""
    return f"[{', '.join(map(yaml_name, names))}]"


def yaml_name(name: str) -> str:
    """A printable name between double quotes, in UTF-8: YAML does not combine the escapes by which
    JSON divides a character beyond 16 bits in two.
    """
    return json.dumps(name, ensure_ascii=False)


def markdown_code(name: str) -> str:
    """A printable name as code in Markdown, also in a table."""
    if MARKUP.isdisjoint(name) and name == name.strip():
        return f"`{name}`"
    characters = (x if x.isalnum() else f"&#{ord(x)};" for x in name)
    return f"<code>{''.join(characters)}</code>"


def yaml_numbers(numbers: Iterable[float]) -> str:
    """A list of floating-point numbers, each with a decimal point."""
    return f"[{', '.join(map(yaml_number, numbers))}]"


def yaml_number(x: float) -> str:
    """A finite floating-point number; in YAML 1.1 exponents need a decimal point and a sign."""
    text = repr(float(x))
    if "e" not in text:
        return text
    mantissa, exponent = text.split("e")
    if "." not in mantissa:
        mantissa += ".0"
    if exponent[0] not in "+-":
        exponent = f"+{exponent}"
    return f"{mantissa}e{exponent}"
