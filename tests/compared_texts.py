"""Texts whose words must be equal, and whose numbers may differ by rounding."""

import math
import re

NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|inf|nan)(?![\w.]*\w)")
"""A number that stands alone: "0.4", "-2.6e-15", but not the 2 of "alpha_2" or of "K2"."""
ROUNDING = 1e-9
"""Size below which a number of a certificate is rounding only: its margins are sums of terms of
size 1 to 1000 (V', tau, rad), of which float64 keeps 13 to 16 digits."""


def same_number(found: str, stored: str, digits: int | None) -> bool:
    """Whether two printed numbers are equal, but for one in the last printed digit.

    Zeros at the end are not printed by "%.4g", so that the longer one says how many digits there
    are, and three are the least.  Whole numbers are counts, and must be equal.

    Args:
      found, stored: the numbers as printed.
      digits: the number of significant digits that must agree; as many as are printed if None.
    """
    if found == stored:
        return True
    if found.lstrip("+-").isdigit() and stored.lstrip("+-").isdigit():
        return False
    a, b = float(found), float(stored)
    if not (math.isfinite(a) and math.isfinite(b)):
        return False
    size = max(abs(a), abs(b))
    if size < ROUNDING:
        return True
    if digits is None:
        mantissas = (x.split("e")[0].lstrip("+-").replace(".", "") for x in (found, stored))
        digits = max(3, *(len(x.lstrip("0")) for x in mantissas))
    last = 10.0 ** (math.floor(math.log10(size)) + 1 - digits)
    return abs(a - b) <= 1.01 * last + ROUNDING * 1e-3


def same_text(found: str, stored: str, digits: int | None = None) -> bool:
    """Whether the words are equal, and the numbers as `same_number` compares them."""
    if found == stored:
        return True
    if NUMBER.sub("#", found) != NUMBER.sub("#", stored):
        return False
    pairs = zip(NUMBER.findall(found), NUMBER.findall(stored), strict=True)
    return all(same_number(a, b, digits) for a, b in pairs)


def same_row(found: str, stored: str) -> bool:
    """`same_text` of a row of a printed table, whatever the widths of its columns.

    Where a margin is rounding only, so is its place: the last cell is then not compared.
    """
    cells, expected = (re.split(r" {2,}", row.strip()) for row in (found, stored))
    if len(cells) != len(expected):
        return False
    if len(cells) > 3 and _is_rounding(cells[3]) and _is_rounding(expected[3]):
        cells, expected = cells[:-1], expected[:-1]
    return all(same_text(a, b) for a, b in zip(cells, expected, strict=True))


def _is_rounding(cell: str) -> bool:
    number = NUMBER.match(cell)
    return number is not None and abs(float(number.group())) < ROUNDING
