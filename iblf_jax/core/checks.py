"""Host-side checks of arguments: each failure is a ValueError that names the field, the value that
came, what was expected, and the remedy.

A value that JAX is tracing has no number yet, so every check accepts it; the same constructors and
entry points therefore work under `jit`, `vmap` and `grad`. Conditions that are known only inside a
run are flags of `status`.
"""

from __future__ import annotations

import dataclasses
import difflib
import errno
import functools
import inspect
import math
import numbers
import os
import re
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import former_names
from iblf_jax.core.attributes import has_members, missing_members
from iblf_jax.core.devices import default_devices, on_device, platform
from iblf_jax.core.families import adopt, required_members

F = TypeVar("F", bound=Callable)
T = TypeVar("T")

LARGEST_INTEGER = 2**63 - 1
MAX_STEPS = 2**31 - 1
"""Steps are counted in int32 inside the compiled loop."""

LONGEST_TEXT = {"field": 200, "value": 160, "words": 800, "message": 1400}
"""Part of an error message -> its largest number of characters, because a user's input may have any
length; "message" is all that the command line prints."""

SHORTEST_TIME, LONGEST_TIME = 1e-12, 1e9
"""[s].  No run, step, period or delay of a robot is shorter or longer."""

LONGEST_NAME = 220
"""Bytes of the name of a file.

File systems allow 255, and the names of temporary files are longer than those that they replace.
"""

MAX_JOINTS = 10_000
"""More than any robot has."""

MAX_ENTRIES = 1_000_000
"""More rows than any array of a component has: commands in transit, past samples, nodes."""

MAX_POINTS = 100_000
"""More instants or points than a figure shows."""

MAX_DEPTH = 32
"""Largest depth of nested lists that can be an array."""


class Words(str):
    """Words in place of a value in an error message: `shown` quotes them as they are."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def given(part: T | None) -> T:
    """An optional part in code that runs only with it."""
    assert part is not None
    return part


def is_concrete(value: object) -> bool:
    """Whether every leaf of `value` is a number now, rather than a tracer or a placeholder."""
    if is_deep(value):
        return True
    try:
        leaves = jax.tree.leaves(value)
    except Exception:  # a dict whose keys have no order: nothing that is traced
        return True
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


def is_deep(value: object) -> bool:
    """Whether lists, tuples and dicts are nested more deeply than in any array or file of this
    package.

    JAX must not see such a value: it recurses, and the interpreter's recursion counter is wrong
    from then on.
    """
    level = _containers([value])
    for _ in range(MAX_DEPTH):
        inner: dict[int, Any] = {}
        for container in level.values():
            if isinstance(container, dict):
                container = container.values()
            inner |= _containers(container)
        if not inner:
            return False
        level = inner
    return True


def _containers(values: Iterable[Any]) -> dict[int, Any]:
    """The lists, tuples and dicts among values, each once, by their identity."""
    return {id(x): x for x in values if isinstance(x, list | tuple | dict)}


def flat_enough(name: str, value: object) -> None:
    """Raises for lists, tuples and dicts nested so deeply that JAX must not see them."""
    if is_deep(value):
        raise fail(name, value, f"at most {MAX_DEPTH} lists inside each other")


def one_line(text: str, part: str = "words") -> str:
    """Text as one line of a message: shortened, with escape sequences for characters that cannot be
    printed.
    """
    most = LONGEST_TEXT[part]
    text = re.sub(r"\s*\n\s*", " ", text[: 4 * most])
    text = "".join(x if x.isprintable() else ascii(x)[1:-1] for x in text)
    if len(text) > most:
        return text[: most - 3] + "..."
    return text


def shown(value: object) -> str:
    """A value as an error message quotes it."""
    if not is_concrete(value):
        return "a value that JAX is tracing"
    try:
        if isinstance(value, jax.Array | np.ndarray):
            text = np.array2string(np.asarray(value), precision=6, threshold=8)
        elif isinstance(value, np.generic):
            text = repr(value.item())
        else:
            text = repr(value)
    except Exception:
        # An integer of thousands of digits, a key, deeply nested lists, a class with a broken repr.
        text = f"an object of class {type(value).__name__}"
    return one_line(text, "value")


def fail(field: str, got: object, expected: str, remedy: str = "") -> ValueError:
    """The one form of error message: field, value, expectation and remedy, in one line."""
    text = f"{one_line(field, 'field')}: got {shown(got)}, expected {one_line(expected)}."
    if remedy:
        text += f" {one_line(remedy)}"
    return ValueError(text)


def nearest(name: object, known: Iterable[str]) -> str:
    """The remedy for a misspelt or a former word; nothing where no known word is near."""
    given, words = str(name)[: LONGEST_TEXT["value"]], list(map(str, known))
    present, form = former_names.ARGUMENTS.get(given, ("", ""))
    if present in words:
        return f"Write {form} in its place."
    close = difflib.get_close_matches(given, words, n=2, cutoff=0.6)
    return f"Did you mean {' or '.join(close)}?" if close else ""


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """The remedy for a misspelt word: the nearest known ones, or all of them."""
    words = [str(word) for word in known]
    return nearest(name, words) or f"There are: {', '.join(words)}." if words else ""


def with_article(noun: str) -> str:
    """A noun with its indefinite article: "an Actuator", "a Controller".

    The first letter decides, but for a vowel that is spoken as a consonant, as in "a Uniform".
    """
    spoken_as_consonant = re.match(r"(?i)(uni(?!n|m[^o])|us[ei]|eu|one([^a-z]|$))", noun)
    begins_with_vowel = noun[:1].lower() in tuple("aeiou")
    if begins_with_vowel and not spoken_as_consonant:
        return f"an {noun}"
    return f"a {noun}"


class ArgumentError(TypeError, ValueError):
    """Arguments that do not fit a constructor.

    It is a ValueError like every other refusal, and the TypeError that Python itself would raise.
    """


def check_arguments(
    owner: str,
    fields: Iterable[dataclasses.Field],
    args: tuple,
    kwargs: Mapping[str, Any],
) -> None:
    """Raises ArgumentError where arguments are too many, unknown, given twice or missing.

    Args:
      owner: name of the class.
      fields: its fields, in order.
      args, kwargs: as they were given.
    """
    fields = [field for field in fields if field.init]
    names = [field.name for field in fields]
    positional = [field.name for field in fields if not field.kw_only]
    call = f"{owner}({', '.join(f'{name}=...' for name in names)})"
    if len(args) > len(positional):
        got, expected = Words(f"{len(args)} positional arguments"), f"at most {len(positional)}"
        raise ArgumentError(fail(owner, got, expected, f"Write {call}."))
    for name in kwargs:
        if name not in names:
            got, expected = Words(f"an unknown argument {name!r}"), f"fields of {owner}"
            raise ArgumentError(fail(owner, got, expected, did_you_mean(name, names)))
        if name in positional[: len(args)]:
            got = Words("two values")
            raise ArgumentError(fail(f"{owner}.{name}", got, "one", f"Write {call}."))
    given = {*kwargs, *positional[: len(args)]}
    for field in fields:
        has_value = field.default is not dataclasses.MISSING
        has_maker = field.default_factory is not dataclasses.MISSING
        if not has_value and not has_maker and field.name not in given:
            expected = _kind_of(field)
            remedy = f"Write {owner}({field.name}=...); help({owner}) says what it means."
            raise ArgumentError(fail(f"{owner}.{field.name}", Words("nothing"), expected, remedy))


def _kind_of(field: dataclasses.Field) -> str:
    """What a field holds, in words."""
    if field.metadata.get("leaf"):
        return f"a number or an array of numbers [{field.metadata['unit']}]"
    if isinstance(field.type, str):
        return with_article(field.type)
    if isinstance(field.type, type):
        return with_article(field.type.__name__)
    return with_article(str(field.type))


def known_keywords(function: F) -> F:
    """Decorator of a public function: an unknown keyword argument raises a TypeError that names the
    expected ones.
    """
    known = tuple(inspect.signature(function).parameters)

    @functools.wraps(function)
    def called(*args: Any, **options: Any) -> Any:
        for name in options:
            if name not in known:
                text = f"{function.__name__}() got an unexpected keyword argument {name!r}."
                remedies = f"{nearest(name, known)} Its arguments are {', '.join(known)}.".lstrip()
                raise TypeError(f"{text} {remedies}")
        return function(*args, **options)

    return cast(F, called)


def with_location(where: str | os.PathLike, error: Exception) -> ValueError:
    """The error with the name of the file, or of the part of a file, in front of its text."""
    if not where:
        return ValueError(str(error))
    name, most = os.fspath(where), LONGEST_TEXT["field"]
    if len(name) > most:  # of a long path the end says more than the beginning
        name = "..." + name[-(most - 3) :]
    return ValueError(f"{one_line(name, 'field')}: {error}")


def _is_number_like(value: object, depth: int = 0) -> bool:
    """Whether this is a number, an array, or nested lists and tuples of such."""
    if isinstance(value, list | tuple):
        return depth < MAX_DEPTH and all(_is_number_like(x, depth + 1) for x in value)
    return isinstance(value, numbers.Number | np.ndarray | np.generic | jax.Array)


MAX_AXES = {
    "scalar": (0, "one number"),
    "joint": (1, "one number, or one a joint, (n,)"),
    "level": (2, "one number a level, or one a level and joint, (m, n)"),
}
"""Shape of a leaf -> largest number of its axes, and what is expected."""


def as_leaf(owner: str, field: dataclasses.Field, value: object) -> Any:
    """Converts a user's value for a leaf field to a floating-point array and checks it.

    A field that was not declared with `leaf` is converted too if it holds numbers, and is otherwise
    returned as it is (it is another component).
    """
    declared = field.metadata.get("leaf", False)
    name = f"{owner}.{field.name}"
    expected = "a number or an array of numbers"
    if value is None:
        if field.default is None:
            return None
        if isinstance(field.default, tuple):
            raise fail(name, value, "a tuple, () for none")
        raise fail(name, value, expected if declared else "a component")
    if not declared and isinstance(value, tuple | list) and not value:
        return tuple(value)
    if not _is_number_like(value):
        if declared:
            raise fail(name, value, expected)
        return value
    if declared and field.metadata["shape"] == "level":
        value = _with_equal_rows(name, value)
    array = as_floats(name, value)
    if declared:
        shape = f"Its shape is {array.shape}."
        if array.size == 0:
            raise fail(name, value, "at least one number", shape)
        most, expected = MAX_AXES.get(field.metadata["shape"], (array.ndim, ""))
        if array.ndim > most:
            raise fail(name, value, expected, shape)
    check_values(name, array, field.metadata.get("sign"))
    return array


def _with_equal_rows(name: str, value: object) -> Any:
    """The rows of a leaf of the shape "level", where some are single numbers and some have one
    number a joint: each with one number a joint.
    """
    if not isinstance(value, tuple | list) or not value:
        return value
    rows = [as_floats(f"{name}[{i}]", row) for i, row in enumerate(value)]
    try:
        shape = np.broadcast_shapes(*[row.shape for row in rows])
    except ValueError:
        got = [row.shape for row in rows]
        raise fail(name, got, "rows of one number, or of one a joint each") from None
    # A user may have set the strict promotion of JAX, which refuses rows of different types.
    with jax.numpy_dtype_promotion("standard"):
        return jnp.stack([jnp.broadcast_to(row, shape) for row in rows])


def as_floats(name: str, value: object) -> jax.Array:
    """An array of floating-point numbers, or a ValueError that names the field."""
    flat_enough(name, value)
    try:
        array = _as_array(value)
    except Exception as error:
        # NumPy and JAX raise many kinds: too large, ragged, nested too deeply, not numeric.
        raise fail(name, value, "numbers in a rectangular array") from error
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array
    if jnp.issubdtype(array.dtype, jnp.integer):
        return array.astype(jnp.result_type(float))
    raise fail(name, value, "real numbers", f"Its type is {array.dtype}.")


def _as_array(value: object) -> jax.Array:
    """The array of a value."""
    if isinstance(value, list | tuple):
        is_on_host = all(isinstance(x, int | float) for x in jax.tree.leaves(value))
    else:
        is_on_host = isinstance(value, int | float | np.ndarray | np.generic)
    if not is_on_host or isinstance(value, np.ma.MaskedArray):  # JAX refuses a mask
        return jnp.asarray(value)
    host: Any = np.array(value)  # a copy: JAX may share the memory of its argument
    if host.dtype.kind in "iu":
        host = host.astype(jnp.result_type(float))
    if isinstance(value, float):
        host = value  # stays weakly typed
    return on_device(host)


SIGNS: dict[str | None, tuple[Callable[[np.ndarray], Any], str, str]] = {
    None: (np.isfinite, "finite numbers", "Replace the NaN or infinite entries."),
    "limit": (
        lambda x: ~np.isnan(x),
        "numbers, infinite where there is no limit",
        "Replace the NaN entries.",
    ),
    "positive": (lambda x: x > 0, "numbers > 0", "Give positive values."),
    "nonnegative": (lambda x: x >= 0, "numbers >= 0", "Give non-negative values."),
}
"""Sign of a leaf -> whether numbers have it, what is expected, and the remedy."""
SIGNS_TO_CHECK = {
    None: (None,),
    "limit": ("limit",),
    "positive limit": ("limit", "positive"),
    "positive": (None, "positive"),
    "nonnegative": (None, "nonnegative"),
}
"""Declared sign of a leaf -> the entries of `SIGNS` that its numbers must satisfy."""


def check_values(name: str, array: object, sign: str | None) -> None:
    """Raises if a concrete array has a NaN, an infinity or a number of the wrong sign."""
    if array is None or isinstance(array, jax.core.Tracer):
        return
    values = np.asarray(array)
    for each in SIGNS_TO_CHECK[sign]:
        has_sign, expected, remedy = SIGNS[each]
        if not np.all(has_sign(values)):
            raise fail(name, array, expected, remedy)


def structural(owner: str, name: str, value: object) -> None:
    """Raises if the value of a static field is an array or cannot be hashed."""
    try:
        if isinstance(value, jax.Array | np.ndarray):
            raise TypeError("an array")
        hash(value)
    except Exception as error:
        remedy = "It is a structural field: give a number, a string or a tuple, not an array."
        raise fail(f"{owner}.{name}", value, "a hashable value", remedy) from error


def one_of(name: str, value: Any, allowed: Any) -> None:
    """Raises if `value` is not one of the allowed words."""
    if not isinstance(value, str) or value not in allowed:
        raise fail(name, value, "one of " + ", ".join(repr(x) for x in allowed))


PUBLIC_MODULES = {
    "iblf_jax.simulation.metrics": "iblf_jax.metrics",
    "iblf_jax.tuning.quantities": "iblf_jax.objectives",
}
"""Module with the base class of a family -> where users find it."""


def conforms(name: str, value: object, base: type, remedy: str = "") -> None:
    """Raises unless `value` is an object that JAX can flatten and that has what the family `base`
    requires; its class is then adopted by the family.
    """
    module = base.__module__
    public = PUBLIC_MODULES.get(module, module.removesuffix("._base"))
    expected = f"a component that fits {public}.{base.__name__}"
    if isinstance(value, type):
        raise fail(name, value, expected, "It is a class: make an instance, with brackets.")
    if _is_plain(value):
        raise fail(name, value, expected, remedy)
    offers(name, value, required_members(base), expected, remedy)
    fields = vars(value) if has_members(value, "__dict__") else {}
    for field, part in fields.items():
        flat_enough(f"{name}.{field}", part)
    try:
        leaves = jax.tree.leaves(value)
    except Exception as error:
        raise fail(name, value, expected, f"JAX cannot take it apart: {error}") from error
    if any(leaf is value for leaf in leaves):
        remedy = "JAX does not know its class: decorate it with iblf_jax.component."
        raise fail(name, value, expected, remedy)
    adopt(type(value), base)


def _is_plain(value: object) -> bool:
    """Whether this is None, a word, a container of Python's, or numbers: no object with members."""
    return (
        value is None
        or isinstance(value, str | bytes | tuple | list | dict)
        or _is_number_like(value)
    )


def offers(
    name: str, value: object, members: Sequence[str], expected: str, remedy: str = ""
) -> None:
    """Raises unless `value` is an object, not a class, an array or a word, that has these methods
    or fields.
    """
    if members and (isinstance(value, type) or _is_plain(value)):
        raise fail(name, value, expected)
    missing = missing_members(value, members)
    if missing:
        raise fail(name, value, expected, f"{remedy} It lacks {', '.join(missing)}.".strip())


def vectors(n: int | None = None, **named: Any) -> tuple[jax.Array, ...]:
    """Vectors with one number a joint, (n,), from arguments by name, traced or not; as long as the
    first if n is not given.
    """
    arrays = {name: as_floats(name, value) for name, value in named.items()}
    shape: tuple[int, ...] = next(iter(arrays.values())).shape if n is None else (n,)
    for name, array in arrays.items():
        if array.ndim != 1 or array.shape != shape:
            expected = str(shape) if len(shape) == 1 else "(n,)"
            remedy = f"Its shape is {array.shape}."
            raise fail(name, array, f"one number a joint, shape {expected}", remedy)
    return tuple(arrays.values())


def shape_is(name: str, array: Any, shape: tuple[int, ...]) -> None:
    """Raises if an array has another shape."""
    if jnp.shape(array) != shape:
        raise fail(name, array, f"shape {shape}", f"Its shape is {jnp.shape(array)}.")


TRACED = (
    "It decides how many steps are compiled: use a Python number, or static_argnames in your jit."
)


def positive_number(name: str, value: object, unit: str, zero: bool = False) -> float:
    """A finite positive Python float (or 0, if that may be) from a user's argument, or a
    ValueError.
    """
    expected = f"a number >= 0 [{unit}]" if zero else f"a positive number [{unit}]"
    if isinstance(value, jax.core.Tracer):
        raise fail(name, value, expected, TRACED)
    number = _as_float(value)
    if not (np.isfinite(number) and number >= 0 and (zero or number > 0)):
        raise fail(name, value, expected)
    return number


def _as_float(value: object) -> float:
    """A real number, or an array of one, as a Python float; NaN for everything else."""
    if isinstance(value, np.generic | np.ndarray | jax.Array):
        is_real = jnp.issubdtype(value.dtype, np.number) and not jnp.iscomplexobj(value)
        return float(value) if is_real and value.ndim == 0 else math.nan
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf


def number_between(
    name: str, value: object, least: float, most: float, unit: str, remedy: str = ""
) -> float:
    """A Python float from `least` >= 0 to `most` from a user's argument, or a ValueError."""
    number = math.nan
    if not isinstance(value, jax.core.Tracer):
        number = _as_float(value)
    if not least <= number <= most:
        raise fail(name, value, f"a number from {least:g} to {most:g} [{unit}]", remedy)
    return number


def time_span(name: str, value: object, zero: bool = False) -> float:
    """A duration, period or delay [s] from a user's argument, or a ValueError.

    It lies between the shortest and the longest that a robot has.
    """
    seconds = positive_number(name, value, "s", zero)
    if seconds == 0.0:
        return seconds
    return number_between(name, seconds, SHORTEST_TIME, LONGEST_TIME, "s", "Times are in seconds.")


def _is_integer(value: object) -> bool:
    """Whether this is a whole number of Python or NumPy, and no truth value."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool | np.bool_)


def positive_integer(name: str, value: Any, *, least: int = 1, most: int | None = None) -> int:
    """A Python int from `least` on, at most `most`, from a user's argument, or a ValueError."""
    expected = f"a whole number >= {least}"
    if most is not None:
        expected += f" and <= {most}"
    if not _is_integer(value) or value < least or (most is not None and value > most):
        raise fail(name, value, expected)
    return int(value)


class NoSuchEntryError(IndexError, ValueError):
    """An index out of range: a ValueError like every other refusal, and the IndexError that
    Python's protocols expect.
    """


def seed(value: Any, name: str = "seed") -> int:
    """A seed as a Python int in [0, 2^32), or a ValueError."""
    if not _is_integer(value) or not 0 <= value < 2**32:
        raise fail(name, value, "a whole number from 0 to 2**32 - 1")
    return int(value)


def entry(name: str, value: Any, count: int, what: str) -> int:
    """A Python int from 0 to `count` - 1 from a user's index, which may count from the end;
    NoSuchEntryError where it leads nowhere.
    """
    if not _is_integer(value) or not -count <= value < count:
        raise NoSuchEntryError(str(fail(name, value, f"one of the {what} 0 to {count - 1}")))
    return int(value) % count


def fits_memory(name: str, count: int, bytes_each: float, remedy: str = "") -> None:
    """Raises if `count` objects of that size exceed this machine's memory; the message says how
    many fit.
    """
    most = int(memory() // max(1, bytes_each))
    if count > most:
        expected = f"at most {most}, which is what {memory() / 2**30:.3g} GiB hold"
        raise fail(name, count, expected, remedy)


def ceil_div(a: int, b: int) -> int:
    """The quotient of two positive integers, rounded up."""
    return -(-a // b)


def memory() -> int:
    """Bytes of this machine's memory; 16 GiB where the system does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 16 * 2**30


def boolean(name: str, value: object, optional: bool = False) -> Any:
    """True or False (or None, if that may be) from a user's argument, or a ValueError."""
    if value is None and optional:
        return None
    if not isinstance(value, bool | np.bool_):
        raise fail(name, value, "True or False or None" if optional else "True or False")
    return bool(value)


def string(name: str, value: object, what: str) -> str:
    """A string from a user's argument, or a ValueError."""
    if not isinstance(value, str):
        raise fail(name, value, what)
    return value


def mapping(name: str, value: object, example: str) -> Mapping[str, Any]:
    """`value` if it is a mapping from words, else a ValueError."""
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise fail(name, value, f"a mapping from words such as {example}")
    return value


def nonempty_list(name: str, value: object, example: str) -> list[Any]:
    """The entries of a list or tuple that has some, else a ValueError."""
    if not isinstance(value, list | tuple) or not value:
        raise fail(name, value, f"a list such as {example}")
    return list(value)


def devices(name: str, value: Any) -> list[jax.Device]:
    """A user's devices, all of this process if there are none given, or a ValueError."""
    if value is None:
        return default_devices()
    is_list = isinstance(value, list | tuple) and len(value) > 0
    if not is_list or not all(isinstance(x, jax.Device) for x in value):
        remedy = "jax.devices() lists them; leave it out for all of them."
        raise fail(name, value, "a list of at least one device", remedy)
    if {device.platform for device in value} != {platform()}:
        expected = f"devices of the platform that JAX computes on, {platform()}"
        remedy = "Put the call into `with jax.default_device(device):` to compute on another one."
        raise fail(name, value, expected, remedy)
    return list(value)


def file_path(name: str, value: Any, what: str = "a file") -> Path:
    """A path from a user's argument that this system can spell, or a ValueError.  The file need
    not exist.
    """
    expected = f"the path of {what}"
    try:
        text = os.fspath(value)
        if not isinstance(text, str) or not text or "\0" in text:
            raise fail(name, value, expected, "Nothing is there." if not text else "")
        os.lstat(text)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (TypeError, UnicodeError):
        raise fail(name, value, expected) from None
    except OSError as error:
        if error.errno not in (errno.ENAMETOOLONG, errno.ELOOP):
            raise
        raise fail(name, text, expected, f"{error.strerror}.") from None
    if any(len(os.fsencode(part)) > LONGEST_NAME for part in Path(text).parts):
        raise fail(name, text, expected, f"A name in it is longer than {LONGEST_NAME} bytes.")
    return Path(text)


def file_to_read(name: str, value: object, what: str = "a file") -> Path:
    """The path of a file that is there, or a ValueError; a MissingFileError where nothing is."""
    path = file_path(name, value, what)
    expected = f"the path of {what}"
    if not path.exists():
        raise MissingFileError(fail(name, str(path), expected, "Nothing is there."))
    if path.is_dir():
        raise fail(name, str(path), expected, "It is a folder.")
    if not path.is_file():
        raise fail(name, str(path), expected, "It is not a file.")
    return path


class UnwritableError(OSError, ValueError):
    """A path at which nothing can be written.

    It is a ValueError like every other refusal, and the OSError that programs which write files
    expect.
    """


class MissingFileError(FileNotFoundError, ValueError):
    """A path at which nothing is, or whose folder does not exist.

    It is a ValueError like every other refusal, and the FileNotFoundError that programs which open
    files expect.
    """


def file_to_write(name: str, value: object, what: str = "a file") -> Path:
    """A path where a file can be written, or a ValueError; a MissingFileError where its folder does
    not exist.
    """
    path = file_path(name, value, what)
    if path.is_dir():
        raise fail(name, str(path), f"the path of {what}", "It is a folder.")
    if not path.parent.exists():
        remedy = f"The folder {path.parent} does not exist: create it first."
        raise MissingFileError(fail(name, str(path), f"the path of {what}", remedy))
    if path.exists() and not path.is_file():  # a device, such as /dev/null
        return path
    _can_be_written(name, path, path.parent, f"the path of {what} in a folder that can be written")
    return path


def folder_to_write(name: str, value: object) -> Path:
    """The path of a folder that is there or can be made, or a ValueError.

    Files can be written there.
    """
    path = file_path(name, value, "a folder")
    expected = "the path of a folder that can be written"
    nearest = next((place for place in (path, *path.parents) if place.exists()), Path())
    _can_be_written(name, path, nearest, expected)
    return path


def _can_be_written(name: str, path: Path, folder: Path, expected: str) -> None:
    """Raises UnwritableError unless a file can be made in `folder`, which is there.

    The function creates a temporary file, because permissions do not show whether a file system is
    read-only.
    """
    if not folder.is_dir():
        raise UnwritableError(fail(name, str(path), expected, f"{folder} is not a folder."))
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        if error.errno == errno.ENOSPC:
            return  # The path is valid although the disk is full; a later write reports it.
        remedy = f"{folder} cannot be written ({error.strerror}): choose another place."
        raise UnwritableError(fail(name, str(path), expected, remedy)) from None


def whole_steps(duration: object, dt: object, *, dt_is_free: bool = True) -> int:
    """The number of steps of size `dt` in `duration`, or a ValueError that proposes a duration, or
    a dt if that is free.
    """
    duration = positive_number("duration", duration, "s")
    dt = positive_number("dt", dt, "s")
    if not duration / dt <= MAX_STEPS:
        remedy = "Shorten the run or take a larger dt."
        raise fail("duration", duration, f"at most {MAX_STEPS} steps dt = {dt:g} s", remedy)
    steps = round(duration / dt)
    # A difference of a thousandth of a step is accepted, as of a duration rounded to float32.
    if steps < 1 or abs(steps * dt - duration) > 1e-3 * dt + 1e-12 * duration:
        near = max(steps, 1)
        remedy = f"Take duration={near * dt:.12g}"
        if dt_is_free:
            remedy += f" or dt={duration / near:.12g}"
        remedy += "."
        raise fail("duration", duration, f"a whole number of steps dt = {dt:g} s", remedy)
    return steps


def recorded_every(value: object, steps: int) -> int:
    """The interval of the recorded samples in steps, as an int32 of the compiled loops.

    All numbers beyond the last step have the same effect: only the first instant is recorded. A
    number that does not fit in 64 bits is an error.
    """
    return min(positive_integer("record_every", value, most=LARGEST_INTEGER), steps + 1, MAX_STEPS)
