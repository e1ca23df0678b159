"""Modules of other libraries in scenario files: a description of their structure, and their arrays.

    [controller.net]
    kind = "module"
    structure = '{"class": "equinox.nn:MLP", "fields": ...}'
    weights = "NAME.weights.npz"        # beside NAME.toml, or
    arrays = {"layers[0].weight" = ...} # in the text itself, where there is no file
    digest = "..."                      # SHA-256 of the arrays

Containers of Python are rebuilt from the description.  Classes and functions are stored by their
import paths, and rebuilt where these lead to the same objects: dataclasses that JAX knows, such as
the modules of Equinox.  A module with another class, such as those of Flax NNX, or with a function
without an import path has `structure = '{"opaque": CLASS}'`: the caller of `load_scenario` passes a
module of the same structure.  Nothing is unpickled, and no package is imported that the program has
not imported itself, except for jax, equinox and flax.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import inspect
import io
import json
import os
import sys
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, modules
from iblf_jax.core.attributes import has_members
from iblf_jax.files.values import Words, as_table, dotted, encode_numbers, known_keys, numbers
from iblf_jax.simulation.paths import arrays_of_module, written

MODULE = "module"
"""The `kind` of the table of a module."""
KEYS = ("kind", "structure", "arrays", "weights", "digest")
IMPORTABLE = ("jax", "equinox", "flax")
"""Packages that loading a file may import."""
PUBLIC = ("jax.nn", "jax.numpy", "jax.lax")
"""Modules under which the functions of JAX are public."""


@dataclasses.dataclass(frozen=True)
class ReadPart:
    """A part that was read from its table, in place of the table."""

    part: Any


class _NoImportPathError(ValueError):
    """A class, a function or a value that a file cannot describe."""


# --- to tables


def encode_module(module: object) -> dict[str, Any]:
    """The table of a module with its arrays in it."""
    arrays = {name: encode_numbers(x) for name, x in arrays_of_module(module).items()}
    try:
        structure = _described(module)
    except _NoImportPathError:
        structure = {"opaque": _class_name(module)}
    return {
        "kind": MODULE,
        "structure": json.dumps(structure),
        "digest": _digest(arrays),
        "arrays": arrays,
    }


def _digest(arrays: Mapping[str, Any]) -> str:
    """SHA-256 of names, shapes and numbers, which does not depend on the precision of JAX."""
    found = hashlib.sha256()
    for name, numbers_of_array in sorted(arrays.items()):
        array = np.asarray(numbers_of_array, "<f8")
        found.update(json.dumps([name, array.shape]).encode())
        found.update(array.tobytes())
    return found.hexdigest()


def _class_name(value: object) -> str:
    cls = type(value)
    return f"{cls.__module__}:{cls.__qualname__}"


def _described(value: Any) -> Any:
    """The structure of a module, or of an entry of it, in JSON."""
    if modules.is_float_array(value):
        return "array"
    if isinstance(value, jax.Array | np.ndarray):
        array = np.asarray(value)
        return {"constant": array.tolist(), "dtype": array.dtype.str}
    if value is None or isinstance(value, bool | int | float | str):
        return {"value": value}
    if type(value) is dict:
        return {"dict": {key: _described(x) for key, x in value.items()}}
    if type(value) in (list, tuple):
        return {type(value).__name__: [_described(x) for x in value]}
    if modules.is_module(value):
        if not dataclasses.is_dataclass(value) or modules.is_component(value):
            raise _NoImportPathError(value)
        fields = {f.name: _described(vars(value)[f.name]) for f in dataclasses.fields(value)}
        return {"class": _import_path(type(value)), "fields": fields}
    if callable(value):
        return {"import": _import_path(value)}
    raise _NoImportPathError(value)


def _import_path(value: Any) -> str:
    """The import path of a class or a function, "equinox.nn:MLP"; the shortest that leads to it.

    A function without a path may be the default of an argument of a method:
    "equinox.nn:MLP.__init__(final_activation)".
    """
    has_name = has_members(value, "__qualname__", "__module__")
    if not has_name or _is_of_python(value):
        raise _NoImportPathError(value)
    parts = str(value.__module__).split(".")
    places = [*PUBLIC, *(".".join(parts[: i + 1]) for i in range(len(parts)))]
    for place in places:
        path = f"{place}:{value.__qualname__}"
        if _found(path) is value:
            return path
    owner = sys.modules.get(str(value.__module__))
    for _, cls in inspect.getmembers(owner, inspect.isclass):
        for argument, parameter in inspect.signature(cls.__init__).parameters.items():
            if parameter.default is value:
                return f"{_import_path(cls)}.__init__({argument})"
    raise _NoImportPathError(value)


def _found(path: str) -> Any:
    """What an import path leads to in modules that are loaded; None if it leads nowhere."""
    place, _, name = path.partition(":")
    name, _, argument = name.removesuffix(")").partition("(")
    value: Any = sys.modules.get(place)
    for part in name.split("."):
        if not has_members(value, part):
            return None
        value = getattr(value, part)
    if not argument:
        return value
    return inspect.signature(value).parameters[argument].default


def tables_of_modules(tables: object, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """The dotted keys and the tables of all modules in the tables of a file."""
    if isinstance(tables, list):
        for i, table in enumerate(tables):
            yield from tables_of_modules(table, f"{path}[{i}]")
    if not isinstance(tables, dict):
        return
    if tables.get("kind") == MODULE:
        yield path, tables
        return
    for key, table in tables.items():
        yield from tables_of_modules(table, dotted(path, key))


def needs_a_module(table: Mapping[str, Any]) -> bool:
    """Whether a module of the same structure must be passed when the table is read."""
    return "opaque" in json.loads(table["structure"])


def with_weights_in_file(tables: dict[str, Any], path: Path) -> bytes | None:
    """Moves the arrays of all modules of the tables to a file beside `path`.

    Returns:
      The file's content; None if there are no modules.
    """
    found: dict[str, np.ndarray] = {}
    for key, table in tables_of_modules(tables):
        arrays = table.pop("arrays")
        table["weights"] = path.name
        found |= {f"{key}:{name}": np.asarray(x) for name, x in arrays.items()}
    if not found:
        return None
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **found)
    return content.getvalue()


# --- from tables


def with_modules_read(
    tables: dict[str, Any], folder: str | os.PathLike, given: Mapping[str, Any] | None
) -> dict[str, Any]:
    """The tables with a `ReadPart` in place of the table of every module.

    Args:
      tables: the tables of a scenario.
      folder: folder of the file, to which the names of files of weights are relative.
      given: dotted key -> a module of the same structure, whose arrays are replaced.

    Raises:
      ValueError: a description that cannot be rebuilt, weights that do not belong to it, or a key
        of `given` at which the tables have no module.
    """
    given = checks.mapping("modules", {} if given is None else given, '{"controller.net": net}')
    known = [path for path, _ in tables_of_modules(tables)]
    for path in given:
        if path not in known:
            expected = "the dotted key of a module in the file"
            remedy = checks.did_you_mean(path, known) or "The file describes no module."
            raise checks.fail("modules", path, expected, remedy)

    def read(value: object, path: str) -> Any:
        if isinstance(value, list):
            return [read(x, f"{path}[{i}]") for i, x in enumerate(value)]
        if not isinstance(value, dict):
            return value
        if value.get("kind") != MODULE:
            return {key: read(x, dotted(path, key)) for key, x in value.items()}
        return ReadPart(_module_of(value, path, folder, given.get(path)))

    if not known:
        return tables
    return {key: read(table, key) for key, table in tables.items()}


def _module_of(table: dict[str, Any], path: str, folder: str | os.PathLike, given: object) -> Any:
    """The module of one table."""
    known_keys(table, path, KEYS)
    structure = _structure(table, path)
    arrays = _arrays(table, path, folder)
    if _digest(arrays) != table.get("digest"):
        remedy = "Put the file that was saved with this scenario beside it."
        came = Words(f"arrays with the digest {_digest(arrays)[:12]}...")
        raise checks.fail(f"{path}.digest", came, str(table.get("digest")), remedy)
    if given is not None:
        return _with_arrays(given, arrays, structure, path)
    reader = _Reader(arrays, path)
    module = reader.entry(structure, "")
    if reader.used != {*arrays}:
        unused = sorted({*arrays} - reader.used)
        came = Words(f"arrays that the structure does not have: {unused}")
        raise checks.fail(f"{path}.arrays", came, "one array for each place of the structure")
    return module


def _structure(table: dict[str, Any], path: str) -> Any:
    expected = "the description of a module in JSON"
    text = checks.string(f"{path}.structure", table.get("structure"), expected)
    try:
        structure = json.loads(text)
    except (ValueError, RecursionError):
        raise checks.fail(f"{path}.structure", text, expected) from None
    checks.flat_enough(f"{path}.structure", structure)
    return structure


def _arrays(table: dict[str, Any], path: str, folder: str | os.PathLike) -> dict[str, np.ndarray]:
    """Name -> array of a module, from the table itself or from the file that it names."""
    if "weights" not in table:
        arrays = as_table(table.get("arrays", {}), f"{path}.arrays")
        return {name: _array(x, f"{path}.arrays.{name}") for name, x in arrays.items()}
    name = checks.string(f"{path}.weights", table["weights"], "the name of a file of weights")
    if Path(name).name != name:
        expected = "the name of a file in the folder of the scenario"
        raise checks.fail(f"{path}.weights", name, expected)
    file = checks.file_to_read(f"{path}.weights", Path(folder) / name, "a file of weights")
    try:
        with np.load(file, allow_pickle=False) as data:
            inside = [key for key in data.files if key.startswith(f"{path}:")]
            return {
                key.removeprefix(f"{path}:"): _array(data[key].tolist(), f"{path}.weights")
                for key in inside
            }
    except (ValueError, OSError, zipfile.BadZipFile) as error:
        expected = "a file of weights (.npz)"
        raise checks.fail(f"{path}.weights", str(file), expected, f"{error}.") from error


def _array(value: object, path: str) -> np.ndarray:
    """The array of a table in double precision, whatever the precision of JAX."""
    try:
        return np.asarray(numbers(value, path), float)
    except ValueError as error:
        raise checks.fail(path, value, "numbers in a rectangular array") from error


def _with_arrays(module: Any, arrays: dict[str, np.ndarray], structure: Any, path: str) -> Any:
    """A module of the caller's with the arrays of a file."""
    name = f"modules[{path!r}]"
    module = modules.as_module(name, module)
    expected_class = as_table(structure, f"{path}.structure").get("opaque")
    if expected_class not in (None, _class_name(module)):
        raise checks.fail(name, Words(_class_name(module)), expected_class)
    own = arrays_of_module(module)
    shapes = {key: np.shape(x) for key, x in own.items()}
    if shapes != {key: np.shape(x) for key, x in arrays.items()}:
        different = [key for key in {*own, *arrays} if key not in own or key not in arrays]
        different += [k for k in own if k in arrays and shapes[k] != arrays[k].shape]
        came = Words(f"a module that differs in {', '.join(sorted(different))}")
        raise checks.fail(name, came, "a module with the arrays of the file")
    # The names of a module have the order of its leaves.
    new = iter([jnp.asarray(arrays[key]) for key in own])
    values, treedef = jax.tree.flatten(module)
    return jax.tree.unflatten(
        treedef, [next(new) if modules.is_float_array(x) else x for x in values]
    )


class _Reader:
    """Rebuilds a module from its description and its arrays.

    Args:
      arrays: path in the module -> array.
      path: dotted key of the module in the file.
    """

    def __init__(self, arrays: Mapping[str, np.ndarray], path: str) -> None:
        self.arrays, self.path = arrays, path
        self.used: set[str] = set()

    @property
    def key(self) -> str:
        """The dotted key of the description, for messages."""
        return f"{self.path}.structure"

    def entry(self, node: Any, inside: str) -> Any:
        """The entry of a description; `inside` is its path in the module."""
        if node == "array":
            return self.array(inside.lstrip("."))
        if not isinstance(node, dict) or not node:
            raise checks.fail(self.key, node, EXPECTED_NODE)
        kind, content = next(iter(node.items()))
        if kind == "value" and isinstance(content, bool | int | float | str | None):
            return content
        if kind == "constant":
            return self.constant(content, node.get("dtype"))
        if kind == "import":
            return _imported(content, self.key)
        if kind == "class":
            fields = self.entries(as_table(node.get("fields"), self.key).items(), inside)
            return _object(_imported(content, self.key), fields, self.key)
        if kind == "opaque":
            raise self.needs_a_module(content)
        return self.container(kind, content, inside)

    def constant(self, content: Any, dtype: Any) -> np.ndarray:
        """An array that is no leaf, from its entries and the text of its type."""
        try:
            kind: str = np.dtype(checks.string(self.key, dtype, "a dtype")).kind
        except (TypeError, ValueError, SyntaxError):
            kind = ""
        if kind not in CONSTANT_KINDS:
            expected = "a NumPy dtype of numbers, truth values or text, such as '<i8'"
            raise checks.fail(f"{self.key}: dtype of a constant", dtype, expected)
        try:
            return np.asarray(content, dtype)
        except (TypeError, ValueError, OverflowError):
            expected = f"a rectangular array with entries of the dtype {dtype}"
            raise checks.fail(f"{self.key}: constant", content, expected) from None

    def container(self, kind: str, content: Any, inside: str) -> Any:
        """A dict, list or tuple."""
        if kind == "dict" and isinstance(content, dict):
            pairs = [(modules.RowName(key), x) for key, x in content.items()]
            return {str(key): x for key, x in self.entries(pairs, inside).items()}
        if kind in SEQUENCES and isinstance(content, list):
            return SEQUENCES[kind](self.entries(enumerate(content), inside).values())
        raise checks.fail(self.key, kind, EXPECTED_NODE)

    def entries(self, pairs: Iterable[tuple[Any, Any]], inside: str) -> dict[Any, Any]:
        """The entries of a container or an object by their tokens."""
        return {token: self.entry(x, inside + written(token)) for token, x in pairs}

    def array(self, name: str) -> jax.Array:
        """The array at a path in the module."""
        if name not in self.arrays:
            raise checks.fail(self.key, Words("no array"), f"an array {name}")
        self.used.add(name)
        return jnp.asarray(self.arrays[name])

    def needs_a_module(self, class_name: object) -> ValueError:
        """The error for a class that a file cannot describe."""
        came = Words(f"only the arrays of a module of class {class_name}")
        expected = "the module itself, because a file cannot rebuild its class or its functions"
        remedy = (
            "Build a module of the same structure in Python and pass it,"
            f" modules={{{json.dumps(self.path)}: module}}: its arrays are replaced by those of the"
            " file."
        )
        return checks.fail(self.path, came, expected, remedy)


SEQUENCES: dict[str, Callable[[Iterable[Any]], Any]] = {"list": list, "tuple": tuple}
"""Name in a description -> the container."""
CONSTANT_KINDS = ("b", "i", "u", "f", "U")
"""Kinds of the dtypes that a constant may have."""
EXPECTED_NODE = "the description of an entry of a module"


def _imported(path: object, key: str) -> Any:
    """The class or function of an import path, from a package that may be used."""
    text = checks.string(key, path, "an import path")
    package = text.partition(":")[0]
    top = package.partition(".")[0]
    remedy = "Import its package first, or pass the module by `modules=`."
    expected = "the import path of a class or function of an imported package"
    if top in IMPORTABLE:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise checks.fail(key, text, expected, f"{error}. {remedy}") from error
    try:
        value = _found(text)
    except (TypeError, ValueError, KeyError):
        value = None
    has_name = callable(value) and has_members(value, "__module__")
    if not has_name or _is_of_python(value):
        raise checks.fail(key, text, expected, remedy)
    return value


def _is_of_python(value: object) -> bool:
    """Whether a class or function belongs to Python's own library, which has no parts of networks
    but has functions that act on the machine.
    """
    top = str(value.__module__).partition(".")[0]
    return top != "__main__" and top in ("None", *sys.stdlib_module_names)


def _object(cls: Any, values: dict[str, Any], key: str) -> Any:
    """An object of a dataclass that JAX knows, with all its fields."""
    expected = "a dataclass that JAX can take apart"
    if not isinstance(cls, type) or not dataclasses.is_dataclass(cls):
        raise checks.fail(key, cls, expected)
    names = [field.name for field in dataclasses.fields(cls)]
    if names != list(values):
        came = Words(f"the fields {', '.join(values)}")
        raise checks.fail(key, came, f"those of {cls.__name__}: {', '.join(names)}")
    made = object.__new__(cls)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    if not modules.entries(made):
        raise checks.fail(key, cls, expected)
    return made
