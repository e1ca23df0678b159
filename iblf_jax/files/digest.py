"""Digests of Datasets: netCDF 3 has no checksum, so a file stores one of what its reader must give
back.

    digest(variable) = SHA-256(name, dimensions, shape, kind of number, attributes, data)

The digest is that of the values after decoding, so padding and the layout of a file do not count,
and whatever would load as other data does.  It is stored per variable, so an error can name the
variables that are damaged.
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
"""What the attributes of a Dataset are called among its variables' digests."""


def dataset_digests(data: xarray.Dataset) -> dict[str, str]:
    """The digest of each variable, and of the Dataset's attributes and list of coordinates.

    Args:
      data: any Dataset of numbers, truth values and strings.

    Returns:
      Name -> hexadecimal digest; "attributes" for what belongs to no variable.
    """
    found = {}
    for name, variable in data.variables.items():
        found[f"variable {name}"] = _variable_digest(str(name), variable)
    found[ATTRIBUTES] = _hexadecimal(
        [_plain(data.attrs), sorted(str(name) for name in data.coords)]
    )
    return found


def encoded(digests: Mapping[str, Mapping[str, str]]) -> str:
    """The text that a file stores: the digests of several Datasets by name."""
    return json.dumps({"algorithm": ALGORITHM, "digests": digests}, sort_keys=True)


def stored_in(attributes: Mapping[str, Any], name: str) -> str | None:
    """The text with the digests among a file's attributes, even if damage has changed its name;
    None in older files.
    """
    if name in attributes:
        return str(attributes[name])
    for value in attributes.values():
        if isinstance(value, str) and f'"{ALGORITHM}"' in value:
            return value
    return None


def differences(stored: str, data: Mapping[str, xarray.Dataset]) -> list[str]:
    """What does not agree with its digest, in words; empty where everything does.

    Args:
      stored: what `encoded` gave.
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
    found = {name: dataset_digests(one) for name, one in data.items()}
    words = [f"run {name!r}" for name in sorted({*expected} ^ {*found})]
    for name in sorted({*expected} & {*found}):
        wanted, own = expected[name], found[name]
        different = [part for part in sorted({*wanted, *own}) if wanted.get(part) != own.get(part)]
        words += [f"{part} of run {name!r}" for part in different]
    return words


def _variable_digest(name: str, variable: Any) -> str:
    values = np.asarray(variable.values)
    head = [
        name,
        list(map(str, variable.dims)),
        list(values.shape),
        _kind(values),
        _plain(variable.attrs),
    ]
    return _hexadecimal(head, _bytes(values))


def _kind(values: np.ndarray) -> str:
    """The kind of number, with the precision of floating-point numbers.

    netCDF 3 shortens integers, so their width does not count.
    """
    if values.dtype.kind == "f":
        return f"f{values.dtype.itemsize}"
    if values.dtype.kind in "iu":
        return "i"
    return "text" if values.dtype.kind in "OUS" else values.dtype.kind


def _bytes(values: np.ndarray) -> bytes:
    """The data in an order and a width that do not depend on the machine or on the file's
    format.
    """
    if values.dtype.kind in "OUS":
        return json.dumps([_text(x) for x in values.ravel().tolist()]).encode()
    if values.dtype.kind == "f":
        # Decoding replaces every NaN by this one.
        one_nan = np.where(np.isnan(values), values.dtype.type(np.nan), values)
        return one_nan.astype(values.dtype.newbyteorder("<")).tobytes()
    if values.dtype.kind in "iu":
        return values.astype("<i8").tobytes()
    return values.tobytes()


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _plain(attributes: Mapping[Any, Any]) -> list[Any]:
    """Attributes in an order of their own; netCDF does not tell one number from a list of one."""
    found: list[Any] = []
    for name, value in sorted(attributes.items(), key=lambda item: str(item[0])):
        if isinstance(value, str | bytes):
            found.append([str(name), _text(value)])
            continue
        values = np.atleast_1d(np.asarray(value))
        found.append([str(name), "number", [float(x) for x in values.ravel().tolist()]])
    return found


def _hexadecimal(head: Any, data: bytes = b"") -> str:
    found = hashlib.sha256(json.dumps(head).encode())
    found.update(data)
    return found.hexdigest()
