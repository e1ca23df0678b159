"""Computes and compares digests of Datasets, because netCDF 3 has no checksum.

    digest(variable) = SHA-256(name, dimensions, shape, kind of number, attributes, data)

A digest is computed from the decoded values.  It does not depend on padding or the layout of the
file, and it changes if the file would load as other data.  Each variable has its own digest, so
that an error can name the damaged variables.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray

ALGORITHM = "sha256"
ATTRIBUTES = "attributes"
"""Key of the digest of a Dataset's attributes, besides those of its variables."""


def dataset_digests(data: xarray.Dataset) -> dict[str, str]:
    """The digest of each variable, and of the Dataset's attributes and list of coordinates.

    Args:
      data: a Dataset of numbers, booleans and strings.

    Returns:
      Name -> hexadecimal digest; "attributes" for the attributes and the list of coordinates.
    """
    found = {}
    for name, variable in data.variables.items():
        values = np.asarray(variable.values)
        dims, shape = list(map(str, variable.dims)), list(values.shape)
        head = [str(name), dims, shape, _kind(values), _canonical(variable.attrs)]
        found[f"variable {name}"] = _hexadecimal(head, _bytes(values))
    coordinates = sorted(str(name) for name in data.coords)
    found[ATTRIBUTES] = _hexadecimal([_canonical(data.attrs), coordinates])
    return found


def encoded(digests: Mapping[str, Mapping[str, str]]) -> str:
    """The text for a file: the digests of several Datasets by name."""
    return json.dumps({"algorithm": ALGORITHM, "digests": digests}, sort_keys=True)


def stored_in(attributes: Mapping[str, Any], name: str) -> str | None:
    """The digests among a file's attributes, even if damage has changed the attribute's name; None
    in files of older versions.
    """
    if name in attributes:
        return str(attributes[name])
    for value in attributes.values():
        if isinstance(value, str) and f'"{ALGORITHM}"' in value:
            return value
    return None


def differences(stored: str, data: Mapping[str, xarray.Dataset]) -> list[str]:
    """The parts that differ from their digests, in words.

    Args:
      stored: the text of `encoded`.
      data: the Datasets by name, as they were read.

    Raises:
      ValueError: the stored text is itself damaged.
    """
    try:
        content = json.loads(stored)
        expected = content["digests"]
        if content["algorithm"] != ALGORITHM or not isinstance(expected, dict):
            raise KeyError("algorithm")
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError("the stored digest itself cannot be read") from error
    words = [f"run {name!r}" for name in sorted({*expected} ^ {*data})]
    for name in sorted({*expected} & {*data}):
        before, now = expected[name], dataset_digests(data[name])
        for part in sorted({*before, *now}):
            if before.get(part) != now.get(part):
                words.append(f"{part} of run {name!r}")
    return words


def _kind(values: np.ndarray) -> str:
    """The kind of number, with the precision of floating-point numbers.

    netCDF 3 shortens integers, so their width is left out.
    """
    kind = values.dtype.kind
    if kind == "f":
        return f"f{values.dtype.itemsize}"
    if kind in "iu":
        return "i"
    if kind in "OUS":
        return "text"
    return kind


def _bytes(values: np.ndarray) -> bytes:
    """The data in a byte order and width that do not depend on the machine or the file format."""
    if values.dtype.kind in "OUS":
        return json.dumps([_text(x) for x in values.ravel().tolist()]).encode()
    if values.dtype.kind == "f":
        # Decoding replaces every NaN by the same one.
        one_nan = np.where(np.isnan(values), values.dtype.type(np.nan), values)
        return one_nan.astype(values.dtype.newbyteorder("<")).tobytes()
    if values.dtype.kind in "iu":
        return values.astype("<i8").tobytes()
    return values.tobytes()


def _text(value: object) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _canonical(attributes: Mapping[Any, Any]) -> list[Any]:
    """Attributes in sorted order, with every number as a list, because netCDF stores a number and a
    list of one number in the same way.
    """
    found: list[Any] = []
    for name, value in sorted(attributes.items(), key=lambda item: str(item[0])):
        if isinstance(value, str | bytes):
            found.append([str(name), _text(value)])
            continue
        values = np.atleast_1d(np.asarray(value))
        found.append([str(name), "number", [float(x) for x in values.ravel().tolist()]])
    return found


def _hexadecimal(head: object, data: bytes = b"") -> str:
    return hashlib.sha256(json.dumps(head).encode() + data).hexdigest()
