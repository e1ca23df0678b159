"""Numbers as text of YAML 1.1, as the parameter files of ROS 2 have them."""

from __future__ import annotations

from collections.abc import Iterable


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
