"""Keys of what is kept on the disk: texts that hold in every process.

`exact_keys` compares by identity what it cannot describe, which means nothing to another process.
`text_of` has no such case: it writes a value completely, or raises `NoKeyError`, and then nothing
is kept.  Two values with one text make the same program, because the text of

- a number, a string, an array of NumPy has its type and all its bits;
- a tuple, a frozenset, a named tuple, a frozen dataclass has its class and the texts of all its
  entries;
- a structure of a pytree has the classes of its nodes and their static fields;
- a class or a function is its name, and only those that this name finds again in a module of this
  package, JAX, NumPy or Python have a text: `environment` determines the source of these modules.

What a user defines, a class, a function, or a module of another library in a field, has no text.

`environment` writes everything else that decides what a program computes: the source of the package
and that it is the code that runs, versions, options of JAX and XLA, processor, threads and the
compiler of kernels.
"""

from __future__ import annotations

import enum
import hashlib
import importlib
import operator
import os
import re
import struct
import sys
import types
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jaxlib
import numpy as np

from iblf_jax import _start
from iblf_jax.core.caches import MEMOISED_TYPE, memoised
from iblf_jax.core.devices import is_alone, threads
from iblf_jax.core.pytree import is_component_class
from iblf_jax.core.thread_options import current_options, process_options
from iblf_jax.kernels import ToolchainError, compiler_key

PACKAGE = Path(__file__).resolve().parents[1]
CLOCK = 1.0
"""Largest difference between the clocks of files and of this process [s]."""
TRACED = ("core", "kernels", "world", "control", "simulation", "engine")
"""Folders with what every kept program is traced from."""
FURTHER = (("studies",), ("studies", "tuning"))
"""Groups of folders with what only programs that name something in them are traced from."""
LIBRARIES = frozenset(("iblf_jax", "jax", "jaxlib", "numpy", *sys.stdlib_module_names))
"""Packages whose source the environment determines."""
CACHED: Any = (MEMOISED_TYPE, type(jax.jit(abs)))
"""Types of functions that another one is wrapped in."""
REPLACEMENTS = frozenset(("unittest",))
"""Modules of Python whose objects stand for something else."""
BY_PICKLE = "__slotnames__"
"""Attribute that Python adds to a class when an object of it is copied."""
NAMED = re.compile(r"\biblf_jax\.(\w+)")
"""A folder of the package in the name of a class or a function."""
OF_NAMED_TUPLES = "namedtuple_"
"""First letters of the module of the constructor that Python writes for a named tuple."""
EXACT_TYPES = (bool, int, str, bytes, types.NoneType)
"""Types whose `repr` is exact."""
WATCHING = ("jax_debug_nans", "jax_debug_infs", "jax_disable_jit")
"""Options of JAX with which it looks into every operation."""
NOT_OF_PROGRAMS = ("jax_compilation_cache", "jax_persistent_cache")
"""First words of the options of JAX that say where programs are kept."""
VARIABLES = ("XLA_", "TF_", "JAX_")
"""First letters of the environment variables that XLA reads."""


class NoKeyError(Exception):
    """A value cannot be described for another process."""


def text_of(value: Any) -> str:
    """The exact text of a value.

    Raises:
      NoKeyError: there is none.
    """
    kind = type(value)
    if kind in EXACT_TYPES:
        return repr(value)
    if kind is float:
        return f"float {struct.pack('>d', value).hex()}"
    if isinstance(value, np.dtype):
        return f"dtype {_type_of_numbers(value)}"
    if isinstance(value, np.ndarray | np.generic):
        return f"{_type_of_numbers(value.dtype)} {value.shape} {value.tobytes().hex()}"
    if isinstance(value, jax.tree_util.PyTreeDef):
        return _of_structure(value)
    if isinstance(value, enum.Enum):
        return f"{_name_of(kind)}.{value.name}"
    if isinstance(value, type | types.FunctionType | types.BuiltinFunctionType):
        return _name_of(value)
    if isinstance(value, tuple | list):
        return f"{_name_of(kind)}({','.join(map(text_of, value))})"
    if isinstance(value, frozenset):
        return f"{_name_of(kind)}({','.join(sorted(map(text_of, value)))})"
    frozen = getattr(kind, "__dataclass_params__", None)
    if frozen is not None and frozen.frozen and not is_component_class(kind):
        fields = ",".join(f"{name}={text_of(x)}" for name, x in sorted(vars(value).items()))
        return f"{_name_of(kind)}({fields})"
    raise NoKeyError(kind.__qualname__)


def _type_of_numbers(dtype: np.dtype) -> str:
    """The text of the type of numbers of an array."""
    if dtype.hasobject or dtype.names is not None:
        raise NoKeyError(str(dtype))
    return f"{dtype.name}{dtype.str}"


def _of_structure(structure: jax.tree_util.PyTreeDef) -> str:
    """The text of the structure of a pytree."""
    node = structure.node_data()
    if node is None:
        return "*"
    kind, fixed = node
    if is_component_class(kind) and fixed:
        # The static fields, modules of other libraries, the key of the fields, and that of the
        # methods of a user's class (`pytree.register_component`).
        fields, modules, _, behaviour = fixed
        if modules or behaviour is not None:
            raise NoKeyError(kind.__qualname__)
        fixed = fields
    children = ",".join(map(_of_structure, structure.children()))
    return f"{_name_of(kind)}[{text_of(fixed)}]({children})"


def _name_of(value: Any) -> str:
    """The name of a class or a function, by which another process finds the same one."""
    module, name = str(value.__module__), str(value.__qualname__)
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    # A decorated function is inside of what has its name.
    places = (found, getattr(found, "__wrapped__", None), types.NoneType)
    is_found = any(place is value for place in places)
    if module.partition(".")[0] not in LIBRARIES or not is_found:
        raise NoKeyError(f"{module}.{name}")
    return f"{module}.{name}"


def environment(text: str = "") -> str:
    """The text of what decides, besides the arguments, what a program computes (head of this
    module).

    Args:
      text: `text_of` what the program is traced from; the functions and classes that it names may
        be outside of the folders TRACED.

    Raises:
      NoKeyError: something cannot be described, or a program must not be kept: the package was
        changed on the disk or by other code since it was loaded, a mode of JAX looks into every
        operation, or the device is no CPU or not the only one.
    """
    options = {**process_options(), **current_options()}
    if any(options[name] for name in WATCHING) or not is_alone():
        raise NoKeyError("JAX")
    if not jax.sharding.get_abstract_mesh().empty:
        raise NoKeyError("mesh")
    try:
        kernels = compiler_key()
    except ToolchainError:
        kernels = ()  # then no program has any
    parts = (
        (sys.version, jax.__version__, jaxlib.__version__, np.__version__),
        _source(),
        *map(_state, _folders(text)),
        tuple(sorted((k, x) for k, x in os.environ.items() if k.startswith(VARIABLES))),
        tuple((k, options[k]) for k in sorted(options) if not k.startswith(NOT_OF_PROGRAMS)),
        threads(),
        kernels,
    )
    return text_of(parts)


def _source() -> str:
    """The digest of all files of the package.

    A file that was written after this process loaded the package may not be the code that runs.
    """
    try:
        newest = max(file.stat().st_mtime for file in _files())
        if newest + CLOCK >= _start.STARTED:
            raise NoKeyError("the package was changed")
        return _digest_of_files()
    except OSError as error:
        raise NoKeyError("the package cannot be read") from error


@memoised(1)
def _files() -> tuple[Path, ...]:
    """All files of the package that are code."""
    return tuple(x for x in sorted(PACKAGE.rglob("*")) if x.suffix in (".py", ".h"))


@memoised(1)
def _digest_of_files() -> str:
    """The digest of the names and contents of `_files`."""
    found = hashlib.sha256()
    for file in _files():
        content = file.read_bytes()
        found.update(f"{file.relative_to(PACKAGE)} {len(content)} ".encode() + content)
    return found.hexdigest()


def _folders(text: str) -> list[tuple[str, ...]]:
    """The groups of folders with the code that the functions and classes of a text run."""
    places = {*NAMED.findall(text)} - {*TRACED}
    if not places:
        return [TRACED]
    for group in FURTHER:
        if places <= {*group}:
            return [TRACED, group]
    raise NoKeyError(f"code in {places}")


def _state(folders: tuple[str, ...]) -> str:
    """The digest of the functions, classes and plain values that the modules in some folders of the
    package name now: other code may have replaced some.
    """
    first = _first_state(folders)
    now = _namespaces(folders)
    if len(now) == len(first.values) and all(map(_are_same, now.values(), first.values)):
        return first.digest
    return _State.of(now).digest


class _State(NamedTuple):
    """What modules and classes name at an instant."""

    digest: str
    values: list[dict[str, Any]]
    """The objects themselves, of each module and class."""

    @staticmethod
    def of(namespaces: dict[str, Mapping[str, Any]]) -> _State:
        """The state of namespaces."""
        found = hashlib.sha256()
        values = []
        for name, namespace in namespaces.items():
            own = {key: x for key, x in sorted(namespace.items()) if key != BY_PICKLE}
            found.update(f"{name}\n".encode())
            for key, value in own.items():
                found.update(f"{key} {_named(value)}\n".encode())
            values.append(own)
        return _State(found.hexdigest(), values)


@memoised(3)
def _first_state(folders: tuple[str, ...]) -> _State:
    """The state when this process first asks for it, with which later ones are compared."""
    return _State.of(_namespaces(folders))


def _are_same(namespace: Mapping[str, Any], values: dict[str, Any]) -> bool:
    """Whether a namespace has the same objects as before."""
    size = len(namespace) - (BY_PICKLE in namespace)
    now = map(namespace.get, values)
    return size == len(values) and all(map(operator.is_, now, values.values()))


def _namespaces(folders: tuple[str, ...]) -> dict[str, Mapping[str, Any]]:
    """Name -> attributes, of all modules in some folders and of the classes that they define."""
    found: dict[str, Mapping[str, Any]] = {}
    for module in _modules(folders):
        attributes = found[module] = vars(sys.modules[module])
        for value in list(attributes.values()):
            if isinstance(value, type) and value.__module__ == module:
                found[f"{module}.{value.__qualname__}"] = vars(value)
    return found


@memoised(3)
def _modules(folders: tuple[str, ...]) -> tuple[str, ...]:
    """The names of the modules in some folders, all of them loaded: what a process has loaded
    before must not matter.
    """
    files = [x for folder in folders for x in sorted((PACKAGE / folder).rglob("*.py"))]
    dotted = [".".join(x.relative_to(PACKAGE.parent).with_suffix("").parts) for x in files]
    names = tuple(name.removesuffix(".__init__") for name in dotted)
    for name in names:
        importlib.import_module(name)
    return names


def _named(value: Any) -> str:
    """What a name stands for: the value of a plain one, and the place of definition of others."""
    if type(value) in EXACT_TYPES or type(value) is float:
        return text_of(value)
    if isinstance(value, tuple):
        return f"({','.join(map(_named, value))})"
    if isinstance(value, frozenset):
        return f"{{{','.join(sorted(map(_named, value)))}}}"
    if isinstance(value, types.ModuleType):
        return value.__name__
    if isinstance(value, property):
        value = value.fget
    if isinstance(value, staticmethod | classmethod):
        value = value.__func__
    if isinstance(value, CACHED):
        value = value.__wrapped__
    if isinstance(value, partial):
        return _named((value.func, value.args))
    if isinstance(value, types.FunctionType):
        # Its attribute `__module__` may be that of a function which it wraps.
        home = value.__globals__.get("__name__", "")
    else:
        # The attributes of other objects are not read: a module may be loaded at its first use.
        value = value if isinstance(value, type) else type(value)
        home = value.__module__
    package = home.partition(".")[0]
    if package not in LIBRARIES - REPLACEMENTS and not package.startswith(OF_NAMED_TUPLES):
        raise NoKeyError(f"{home}.{value.__qualname__}")
    return f"{home}.{value.__qualname__}"
