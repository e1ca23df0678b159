"""A store of runs on disk (zarr) that survives a kill at any moment.

- It is made in a temporary folder, which is then renamed: there is never half a store.
- A **unit** is a number of consecutive cases, and one whole chunk of every array, so processes that
  write different units never touch the same file, and two that write the same unit write the same
  bytes.  zarr writes a chunk to a temporary file and renames it.
- A unit's data are written first, then its mark in `done`, one unit a chunk.  The mark is a
  checksum of the unit's data and of the configuration: data that are incomplete, missing, or of
  another store do not agree with their mark and are not read.
- The attributes hold the whole configuration.  A store that was made with another one is refused,
  naming the difference.
- Only arrays of numbers in zarr's format 3 are opened: the older format, and objects, can make the
  reader run code.
- The description of the store is read again before and after every write: a store that was deleted
  or replaced meanwhile is not written to.

zarr does not flush data to the disk: a kill cannot damage a store, but a power failure can, and the
checksum detects it.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import warnings
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.core import checks
from iblf_jax.kernels import draft

FORMAT = 1
ABSENT = object()
"""Stands for an entry that a configuration does not have."""
DONE = "done"
CASE = "case"
_MARK = "iblf_jax_store"
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)
_NUMBERS = "fiub"
"""Kinds of data types that a store may hold; no objects, which zarr unpickles."""


class StoreError(RuntimeError):
    """A store that cannot be written, read or continued; the message says why, and what to do."""


class StoreWriteError(StoreError):
    """A write that failed: a full disk, a path that may not be written to.  What was written before
    stays valid.
    """


class Variable(NamedTuple):
    """One array of a store, without its first axis, which numbers the cases."""

    shape: tuple[int, ...]
    dtype: str
    dims: tuple[str, ...]
    si_unit: str


def _zarr() -> Any:
    try:
        import zarr
    except ImportError:
        raise StoreError(
            "A store needs zarr, which is not installed: pip install zarr, or '.[sweep]' in a"
            " clone."
        ) from None
    return zarr


def differences(theirs: object, ours: object, name: str = "") -> list[str]:
    """Where two configurations differ, "name: the store has x, this call y"."""
    if isinstance(theirs, dict) and isinstance(ours, dict):
        found = []
        for key in {**theirs, **ours}:
            inner = f"{name}.{key}" if name else str(key)
            found += differences(theirs.get(key, ABSENT), ours.get(key, ABSENT), inner)
        return found
    if type(theirs) is type(ours) and theirs == ours:
        return []
    return [f"{name}: the store has {_shown(theirs)}, this call {_shown(ours)}"]


def _shown(value: object) -> str:
    text = "nothing"
    if value is not ABSENT:
        text = json.dumps(value)
    if len(text) > 80:
        text = text[:77] + "..."
    return text


class Store:
    """A store that is open for writing and reading; made by `open_store`."""

    def __init__(self, path: Path, group: Any):
        self.path = path
        self.group = group
        attributes = dict(group.attrs)
        self.config: dict[str, Any] = attributes["config"]
        self.cases: int = attributes["cases"]
        self.unit: int = attributes["unit"]
        for count in (self.cases, self.unit):
            checks.positive_integer("cases and unit", count)
        self.units = checks.ceil_div(self.cases, self.unit)
        self._salt = zlib.crc32(json.dumps(self.config, sort_keys=True).encode())
        self._arrays = {
            name: _checked_array(group, name, self.cases, self.unit)
            for name in attributes["variables"]
        }
        self._done = _checked_array(group, DONE, self.units, 1)
        self._metadata = self._read_metadata()

    def span(self, unit: int) -> slice:
        """The cases of a unit."""
        return slice(unit * self.unit, min((unit + 1) * self.unit, self.cases))

    def size(self, unit: int) -> int:
        """Number of cases of a unit."""
        span = self.span(unit)
        return span.stop - span.start

    def marks(self) -> np.ndarray:
        """Which units are marked as done, (units,) bool."""
        self._check_unchanged()
        try:
            return np.asarray(self._done[:]) != 0
        except Exception as error:
            text = f"{self.path}: the marks cannot be read ({_one_line(error)})."
            raise StoreError(text) from error

    def si_unit(self, name: str) -> str:
        """SI unit of an array."""
        return str(self._arrays[name].attrs.get("units", ""))

    def _mark(self, data: Mapping[str, np.ndarray]) -> int:
        checksum = self._salt
        for name in sorted(data):
            checksum = zlib.crc32(name.encode(), checksum)
            checksum = zlib.crc32(np.ascontiguousarray(data[name]).tobytes(), checksum)
        return (1 << 32) | checksum

    def write(self, unit: int, data: Mapping[str, np.ndarray]) -> None:
        """Writes one unit: its data, then its mark.

        Raises:
          StoreWriteError: it cannot be written, or the store was deleted or replaced; no part of
            the unit is kept.
        """
        self._check_unchanged()
        try:
            self._write(unit, data)
            self._check_unchanged()
        except StoreWriteError:
            self._remove_unit(unit)
            raise

    def _write(self, unit: int, data: Mapping[str, np.ndarray]) -> None:
        try:
            for name, array in self._arrays.items():
                array[self.span(unit)] = data[name]
            self._done[unit] = self._mark(data)
        except OSError as error:
            kept = (
                f" {self.marks().sum()} of {self.units} units are written and valid: start the"
                " same call again to go on."
            )
            raise _write_error(self.path, error, kept) from error

    def _read_metadata(self) -> list[bytes | None]:
        """The metadata files of the group and of its arrays; None for a missing file."""

        def content(file: Path) -> bytes | None:
            try:
                return file.read_bytes()
            except OSError:
                return None

        return [content(self.path / name / "zarr.json") for name in ("", *self._arrays, DONE)]

    def _check_unchanged(self) -> None:
        """Raises StoreWriteError if the store was deleted, wholly or in part, or replaced."""
        now = self._read_metadata()
        if now == self._metadata:
            return
        if now[0] is None:
            text = (
                "was deleted while it was in use. Start the same call again to begin anew, or"
                " choose another path."
            )
        elif now[0] != self._metadata[0]:
            text = (
                "was replaced by another store while it was in use. Choose another path, and start"
                " the same call again."
            )
        else:
            text = (
                "lost arrays while it was in use. Delete what is left of it, and start the same"
                " call again."
            )
        raise StoreWriteError(f"{self.path}: {text}")

    def _remove_unit(self, unit: int) -> None:
        """Removes the chunks of a unit that were written after the store was deleted, and the
        folders that became empty.
        """
        if (self.path / "zarr.json").exists():
            return
        for array in (*self._arrays.values(), self._done):
            first = (unit, *[0] * (array.ndim - 1))
            chunk = self.path / array.path / array.metadata.encode_chunk_key(first)
            with contextlib.suppress(OSError):
                chunk.unlink(missing_ok=True)
                for folder in chunk.parents:  # up to the first that holds something else
                    folder.rmdir()
                    if folder == self.path:
                        break

    def read(self, unit: int) -> dict[str, np.ndarray] | None:
        """The data of one unit; None if they do not fit its mark."""
        try:
            data = {
                name: np.asarray(array[self.span(unit)]) for name, array in self._arrays.items()
            }
            if int(self._done[unit]) != self._mark(data):
                return None
            return data
        except OSError as error:
            if error.errno in _FORBIDDEN:
                raise StoreError(f"{self.path}: cannot be read: {error.strerror}.") from error
            return None
        except Exception:  # whatever a decoder makes of a torn file
            return None

    def pending(self) -> tuple[list[int], list[int]]:
        """The units that are to be computed, and those of them that are marked done but damaged."""
        marks = self.marks()
        damaged = [int(unit) for unit in np.flatnonzero(marks) if self.read(int(unit)) is None]
        return sorted([*map(int, np.flatnonzero(~marks)), *damaged]), damaged

    def read_all(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """The arrays, (cases, ...), and which cases are computed, (cases,) bool; StoreError if a
        unit is damaged.
        """
        done = np.zeros(self.cases, bool)
        out = {
            name: np.full(array.shape, array.fill_value, array.dtype)
            for name, array in self._arrays.items()
        }
        for unit in np.flatnonzero(self.marks()):
            data = self.read(int(unit))
            if data is None:
                raise StoreError(
                    f"{self.path}: unit {unit} is damaged (its data do not fit its checksum). Run"
                    " the same sweep again to mend it."
                )
            done[self.span(int(unit))] = True
            for name, values in data.items():
                out[name][self.span(int(unit))] = values
        return out, done


def _checked_array(group: Any, name: str, rows: int, chunk: int) -> Any:
    """An array of a group; ValueError if this package could not have written it."""
    array = group[name]
    is_array = isinstance(array, _zarr().Array)
    if not is_array or array.metadata.zarr_format != 3 or array.dtype.kind not in _NUMBERS:
        raise ValueError(f"{name!r} is no array of numbers in zarr's format 3")
    if array.shape[:1] != (rows,) or array.chunks != (min(chunk, rows), *array.shape[1:]):
        raise ValueError(
            f"{name!r} has the shape {array.shape} in chunks of {array.chunks}, which is not that"
            f" of {rows} rows"
        )
    return array


def _one_line(error: Exception) -> str:
    """An error of a library, in one line of a bounded length."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:300]


def _write_error(path: Path, error: OSError, kept: str = "") -> StoreWriteError:
    """The error for a failed write, with its remedy."""
    text = f"cannot be written ({error.strerror or error})."
    if error.errno in _FULL:
        text = f"no space left to write to ({error.strerror}). Make room, or take another disk."
    elif error.errno in _FORBIDDEN:
        text = f"{text} Choose a path that you may write to."
    return StoreWriteError(f"{path}: {text}{kept}")


def load_store(path: str | os.PathLike) -> Store:
    """Opens a store that exists.

    Raises:
      StoreError: there is no store at this path, or something else is there.
    """
    zarr, folder = _zarr(), Path(path)
    if not folder.exists():
        raise StoreError(f"{folder}: there is no store here.")
    try:
        # Not the consolidated metadata, in which arrays of the older format may hide.
        group = zarr.open_group(str(folder), mode="r+", zarr_format=3, use_consolidated=False)
        known = group.attrs.get(_MARK)
    except PermissionError as error:
        raise StoreError(f"{folder}: cannot be read ({error.strerror}).") from error
    except Exception as error:
        raise StoreError(
            f"{folder}: is not a store of iblf_jax ({type(error).__name__}). Choose another path."
        ) from error
    if known != FORMAT:
        came = f"a store of format {known}"
        if known is None:
            came = "something that iblf_jax did not write"
        raise StoreError(
            f"{folder}: holds {came}, expected a store of format {FORMAT}. Choose another path."
        )
    try:
        return Store(folder, group)
    except Exception as error:
        raise StoreError(
            f"{folder}: is damaged: its description is wrong ({_one_line(error)}). Delete it, or"
            " choose another path."
        ) from error


def open_store(
    path: str | os.PathLike,
    config: dict[str, Any],
    variables: Mapping[str, Variable],
    cases: int,
    unit: int,
    *,
    any_unit: bool = False,
) -> Store:
    """Opens a store to resume it, or creates it.

    Args:
      path: its folder.
      config: what defines the data; JSON.
      variables: name -> array.
      cases: number of cases.
      unit: cases in a unit.
      any_unit: take the unit of a store that exists, whatever it is.

    Raises:
      StoreError: it was made with another configuration, is foreign or damaged, or cannot be
        written.
    """
    folder, config = Path(path), json.loads(json.dumps(config))
    if not _is_occupied(folder):
        _create(folder, config, variables, cases, unit)
    store = load_store(folder)
    found = differences(store.config, config)
    # Any other difference changes the program as well, and explains more than its digest.
    explained = [text for text in found if not text.startswith("program:")]
    why = "the code of a law, a robot or a metric has changed"
    if "calls Python" in str(config.get("program")):
        why = "what functions of Python compute while a program runs cannot be compared"
    found = explained or [f"{text} ({why})" for text in found]
    if not any_unit:
        found += differences({"unit": store.unit}, {"unit": unit})
    if found:
        remedy = "Go on with the same arguments, or choose another path."
        if any(text.startswith("kernel.") for text in found):
            remedy = (
                "A native kernel is tied to processor and compiler: go on on a machine of the same"
                ' kind, or choose another path, with backend="vmap" if machines of several kinds'
                " are to share it."
            )
        shown = "; ".join(found[:3])
        if len(found) > 3:
            shown += f" (and {len(found) - 3} more)"
        raise StoreError(f"{folder}: was made with another configuration: {shown}. {remedy}")
    if not os.access(folder, os.W_OK):
        raise _write_error(folder, PermissionError(errno.EACCES, os.strerror(errno.EACCES)))
    return store


def _is_occupied(folder: Path) -> bool:
    """Whether something is there (an empty folder is nothing)."""
    try:
        if folder.is_dir():
            return any(folder.iterdir())
        return folder.exists()
    except OSError as error:
        raise _write_error(folder, error) from error


def _create(
    folder: Path, config: dict[str, Any], variables: Mapping[str, Variable], cases: int, unit: int
) -> None:
    """Creates a store in a temporary folder and renames it; a store that another process created
    in the meantime is kept.
    """
    zarr = _zarr()
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with draft(folder.parent, folder.name) as temporary:
            group = zarr.open_group(str(temporary / "store"), mode="w", zarr_format=3)
            for name, v in variables.items():
                array = group.create_array(
                    name,
                    shape=(cases, *v.shape),
                    chunks=(unit, *v.shape),
                    dtype=v.dtype,
                    fill_value=np.nan if np.dtype(v.dtype).kind == "f" else -1,
                    dimension_names=(CASE, *v.dims),
                    config={"write_empty_chunks": True},
                )
                array.attrs["units"] = v.si_unit
            group.create_array(
                DONE,
                shape=(checks.ceil_div(cases, unit),),
                chunks=(1,),
                dtype="uint64",
                fill_value=0,
                dimension_names=("unit",),
            )
            attributes = {"config": config, "cases": cases, "unit": unit}
            group.attrs.update({_MARK: FORMAT, **attributes, "variables": list(variables)})
            with warnings.catch_warnings():
                # zarr says that consolidated metadata are not in its specification yet.
                warnings.simplefilter("ignore")
                zarr.consolidate_metadata(group.store)
            os.rename(temporary / "store", folder)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST) or not folder.is_dir():
            raise _write_error(folder, error) from error
