"""The exported law, compiled as a shared library and called through ctypes.

`law.json`, written by the export, describes the library: joints, period and the offsets of the
gains in the law's struct of parameters, whose members are doubles.
"""

from __future__ import annotations

import ctypes
import importlib.machinery
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

NOT_FINITE = 1
FLAGS = {"outside": 2, "guarded": 4, "saturated": 8, "infeasible": 16}
"""Bits of the status of a sample."""
LIBRARY = "_law"
"""Name of the shared library in the package, without its suffix."""
DESCRIPTION = "law.json"


class GainEntry(NamedTuple):
    """A gain that may change while the law runs."""

    path: str
    unit: str
    is_scalar: bool
    """Whether its ROS parameter is one number and not an array."""
    low: tuple[float, ...]
    high: tuple[float, ...]
    offsets: tuple[tuple[int, ...], ...]
    """For each of its numbers the indices of the doubles in the struct of parameters."""


class LawDescription(NamedTuple):
    """What `law.json` says about the library, and the defaults of the node's parameters."""

    name: str
    """Prefix of the functions in the library."""
    joints: tuple[str, ...]
    has_joint_names: bool
    """Whether the names are those of the scenario's model; otherwise any names are accepted."""
    period: float
    """Sampling period [s]."""
    reads_velocity: bool
    """Whether a sample reads the measured velocities."""
    torque_limits: tuple[float, ...]
    """Largest torques that the node accepts [N m]."""
    on_fault: str
    hold_stiffness: tuple[float, ...]
    """[N m/rad]."""
    hold_damping: tuple[float, ...]
    """[N m s/rad]."""
    gains: tuple[GainEntry, ...]


def read_description(path: Path) -> LawDescription:
    """The description in a file; raises ValueError for a file with other fields."""
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        raise ValueError(f"{path.name}: {error}. Export the package again.") from error
    missing = [name for name in LawDescription._fields if name not in content]
    if missing:
        raise ValueError(f"{path.name}: got no {missing}. Export the package again.")
    fields = {name: content[name] for name in LawDescription._fields}
    for name in ("joints", "torque_limits", "hold_stiffness", "hold_damping"):
        fields[name] = tuple(content[name])
    fields["gains"] = tuple(_gain(gain) for gain in content["gains"])
    return LawDescription(**fields)


def _gain(content: dict[str, Any]) -> GainEntry:
    return GainEntry(
        content["path"],
        content["unit"],
        content["is_scalar"],
        tuple(content["low"]),
        tuple(content["high"]),
        tuple(tuple(places) for places in content["offsets"]),
    )


class CLaw:
    """The law of a shared library, with its parameters and its state.

    Args:
      library: path of the shared library.
      description: of the law that the library must contain.

    Raises:
      OSError: the library cannot be loaded.
      ValueError: the library contains another law.
    """

    def __init__(self, library: Path, description: LawDescription) -> None:
        loaded = ctypes.CDLL(str(library))
        name = description.name
        n = len(description.joints)
        self.description = description
        _check_library(loaded, description)
        state_bytes = _function(loaded, f"{name}_state_bytes", ctypes.c_size_t)()
        parameter_bytes = _function(loaded, f"{name}_parameter_bytes", ctypes.c_size_t)()
        self._init = _function(loaded, f"{name}_init", ctypes.c_int, 4)
        self._balance = _function(loaded, f"{name}_balance", ctypes.c_int, 3)
        self._bounds = _function(loaded, f"{name}_bounds", None)
        pointer = ctypes.c_void_p
        self._bounds.argtypes = (pointer, ctypes.c_double, pointer, pointer)
        self._step = _function(loaded, f"{name}_step", ctypes.c_int)
        self._step.argtypes = (pointer, pointer, ctypes.c_double, pointer, pointer, pointer)
        vector = ctypes.c_double * n
        self._parameters = (ctypes.c_double * (parameter_bytes // 8))()
        self._state = (ctypes.c_double * (state_bytes // 8))()
        self._q, self._dq, self._tau = vector(), vector(), vector()
        self._lower, self._upper = vector(), vector()
        defaults = (ctypes.c_char * parameter_bytes).in_dll(loaded, f"{name}_defaults")
        ctypes.memmove(self._parameters, defaults, parameter_bytes)
        # Addresses are computed once: a call from Python then costs about a microsecond.
        self._at_parameters = ctypes.addressof(self._parameters)
        self._at_state = ctypes.addressof(self._state)
        self._at_q, self._at_dq = ctypes.addressof(self._q), ctypes.addressof(self._dq)
        self._at_tau = ctypes.addressof(self._tau)
        self._at_lower = ctypes.addressof(self._lower)
        self._at_upper = ctypes.addressof(self._upper)
        self._gains = {gain.path: gain for gain in description.gains}
        self._at_read_dq = self._at_dq if description.reads_velocity else None

    def init(self, q: Sequence[float], dq: Sequence[float] | None) -> bool:
        """Starts the law at positions [rad] and velocities [rad/s]; False for non-finite input."""
        self._q[:] = q  # type: ignore[call-overload]
        # A law whose filter computes the velocities starts at rest if they are not measured.
        self._dq[:] = [0.0] * len(q) if dq is None else dq  # type: ignore[call-overload]
        return self._init(self._at_parameters, self._at_state, self._at_q, self._at_dq) == 0

    def step(
        self, t: float, q: Sequence[float], dq: Sequence[float] | None
    ) -> tuple[list[float], int]:
        """One sample at the time t since the start of reference and bounds [s].

        Args:
          t: time [s].
          q: positions, (n,) [rad].
          dq: velocities, (n,) [rad/s]; not used if the law does not read them.

        Returns:
          The torques, (n,) [N m], and the status, whose bits are NOT_FINITE and FLAGS.
        """
        self._q[:] = q  # type: ignore[call-overload]
        if self._at_read_dq is not None:
            self._dq[:] = dq  # type: ignore[call-overload]
        status = self._step(
            self._at_parameters, self._at_state, t, self._at_q, self._at_read_dq, self._at_tau
        )
        return self._tau[:], status

    def balance(self, q: Sequence[float]) -> list[float]:
        """The torques that balance gravity at positions [rad], (n,) [N m]; the state is unchanged.

        They are zero if they are not finite.
        """
        self._q[:] = q  # type: ignore[call-overload]
        self._balance(self._at_parameters, self._at_q, self._at_tau)
        return self._tau[:]

    def bounds(self, t: float) -> tuple[list[float], list[float]]:
        """The lower and the upper bounds on the positions at time t [s], (n,) each [rad]."""
        self._bounds(self._at_parameters, t, self._at_lower, self._at_upper)
        return self._lower[:], self._upper[:]

    def gain(self, path: str) -> list[float]:
        """The numbers of a gain; KeyError for an unknown path."""
        return [self._parameters[places[0]] for places in self._gains[path].offsets]

    def set_gain(self, path: str, values: Sequence[float]) -> None:
        """Changes a gain between two samples.

        Args:
          path: of the gain.
          values: its numbers.

        Raises:
          KeyError: an unknown path.
          ValueError: another number of values, or one outside of the range.
        """
        gain = self._gains[path]
        reason = why_refused(gain, values)
        if reason:
            raise ValueError(reason)
        for places, value in zip(gain.offsets, values, strict=True):
            for place in places:
                self._parameters[place] = value


def why_refused(gain: GainEntry, values: Sequence[float]) -> str:
    """Why values of a gain are refused; empty if they are valid."""
    if len(values) != len(gain.offsets):
        return f"{gain.path}: got {len(values)} numbers, expected {len(gain.offsets)}."
    for value, low, high in zip(values, gain.low, gain.high, strict=True):
        # NaN is not between the limits either.
        if not low <= value <= high:
            limits = f"a number from {low:g} to {high:g} [{gain.unit}]"
            remedy = "Export with a wider range if the law is tuned for it."
            return f"{gain.path}: got {value:g}, expected {limits}. {remedy}"
    return ""


def _function(loaded: ctypes.CDLL, name: str, result: Any, pointers: int = 0) -> Any:
    """A function of the library with so many pointers as arguments."""
    function = loaded[name]
    function.restype = result
    function.argtypes = (ctypes.c_void_p,) * pointers
    return function


def _check_library(loaded: ctypes.CDLL, description: LawDescription) -> None:
    """Raises ValueError for a library that does not contain the described law."""
    name, remedy = description.name, "Build the package again."
    try:
        joints = _function(loaded, f"{name}_joint_count", ctypes.c_int)()
        period = _function(loaded, f"{name}_period", ctypes.c_double)()
    except AttributeError:
        raise ValueError(f"library: got no law {name!r}. {remedy}") from None
    if joints != len(description.joints):
        expected = f"{len(description.joints)} as in {DESCRIPTION}"
        raise ValueError(f"library: got {joints} joints, expected {expected}. {remedy}")
    if period != description.period:
        expected = f"{description.period:g} s as in {DESCRIPTION}"
        raise ValueError(f"library: got the period {period:g} s, expected {expected}. {remedy}")


def load_law(folder: Path) -> CLaw:
    """The law of a package.

    Args:
      folder: of the package's modules, with `law.json` and the shared library.

    Raises:
      ValueError: no shared library, or one that contains another law.
    """
    suffixes = importlib.machinery.EXTENSION_SUFFIXES
    candidates = [folder / f"{LIBRARY}{suffix}" for suffix in suffixes]
    for path in candidates:
        if path.is_file():
            return CLaw(path, read_description(folder / DESCRIPTION))
    expected = f"expected one of {[path.name for path in candidates]}"
    remedy = "Build the package with colcon or pip; a C compiler is needed."
    raise ValueError(f"{folder}: got no shared library of the law, {expected}. {remedy}")
