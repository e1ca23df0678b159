"""Components: frozen dataclasses that JAX can differentiate, batch and compile.

A robot, a law, a bound is a *component*: it has behaviour (methods) and leaves (arrays).  At every
`jit`, `vmap` and `grad`, JAX flattens a component into its leaves and reconstructs it with tracers,
placeholders or axis numbers in their place.  Two operations are therefore separate:

- **construction by a person**, `TwoLink(mass=[2, 0.85], ...)`: lists become arrays, signs and
  shapes are checked;
- **reconstruction by JAX**: nothing may be converted or checked, because what comes is not a
  number.

`component` implements both: the constructor converts and checks, and the registered `unflatten`
never calls it.  Fields are declared with `leaf` (a differentiable array with a unit), `static`
(structure: changes recompile) or as an annotation only (another component, or a module of another
library, see `core.modules`).  Components are compared by identity (`eq=False`), because `==` of
arrays is ambiguous.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import operator
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, dataclass_transform

import jax

from iblf_jax.core import checks, modules
from iblf_jax.core.exact_keys import behaviour_of, key_of_fields
from iblf_jax.core.families import Part, adopt, statements_of

if TYPE_CHECKING:
    from typing_extensions import TypeIs

T = TypeVar("T")

Leaf: TypeAlias = Any
"""Type of a field declared with `leaf`: a number, a list or an array when a person writes it, a
`jax.Array` from then on."""


def leaf(
    unit: str,
    *,
    sign: str | None = None,
    shape: str = "joint",
    default: object = dataclasses.MISSING,
) -> Any:
    """Declares a field that holds an array of numbers, which can be perturbed, swept, tuned and
    differentiated.

    Args:
      unit: SI unit for tables and axes, such as "kg m^2" ("1" for a pure number).
      sign: None, "positive" or "nonnegative"; "limit" or "positive limit" for what may be infinite,
        because there is no limit. Checked at construction and at the entry points.
      shape: "joint" for one number a joint, (n,), where a scalar is repeated; "level" for m rows of
        one number a joint, (m, n), where a scalar in a row is repeated; "scalar" for (); "any" for
        neither.
      default: the value if none is given.
    """
    metadata = {"unit": unit, "sign": sign, "shape": shape, "leaf": True}
    return dataclasses.field(default=default, metadata=metadata)


def static(*, default: object = dataclasses.MISSING) -> Any:
    """Declares a structural field: hashable, not differentiable, part of what is compiled."""
    return dataclasses.field(default=default, metadata={"static": True})


@dataclass_transform(eq_default=False, frozen_default=True, field_specifiers=(leaf, static))
def component(cls: type[T]) -> type[T]:
    """Class decorator that makes a frozen dataclass a component (see the head of this module).

    A class may define `check(self)`, called once after construction, to raise ValueError when
    fields do not fit together; `Part` lists what else it may state.

    Raises:
      ValueError: fields that Python refuses, or a class that inherits from the base class of a
        family and lacks a method that the family requires.
    """
    if not isinstance(cls, type):
        raise checks.fail("component", cls, "a class", "Write @iblf_jax.component above it.")
    try:
        adopt(cls, Part)
    except TypeError as error:
        raise checks.fail("component", cls, "a class written in Python", f"{error}.") from error
    _keep_required(cls)
    has_own_init = "__init__" in vars(cls)
    try:
        cls = dataclasses.dataclass(frozen=True, eq=False)(cls)
    except (TypeError, ValueError) as error:
        raise checks.fail(
            "component", cls, "a class of annotated fields, those with defaults last", f"{error}."
        ) from error
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    if inspect.isabstract(cls):
        # A field without a value is no attribute of the class, and has a value in every object.
        abstract: Any = cls
        abstract.__abstractmethods__ -= {field.name for field in fields}
    if inspect.isabstract(cls):
        missing = sorted(cls.__abstractmethods__)  # type: ignore[attr-defined]
        raise checks.fail("component", cls, "a complete class", f"It lacks {', '.join(missing)}.")
    dataclass_init = cls.__init__

    @functools.wraps(dataclass_init)
    def checked_init(self, *args, **kwargs):
        try:
            dataclass_init(self, *args, **kwargs)
        except TypeError:
            if not has_own_init:
                checks.check_arguments(cls.__name__, fields, args, kwargs)
            raise
        values = field_values(self)
        for field in fields:
            value = values[field.name]
            if field.metadata.get("static"):
                checks.structural(cls.__name__, field.name, value)
                continue
            # `is_module` comes first: it is False for lists that are nested without end.
            holds_module = not is_leaf_field(field) and modules.is_module(value)
            if holds_module and not modules.is_list_of_numbers(value):
                value = modules.as_module(f"{cls.__name__}.{field.name}", value)
            else:
                value = checks.as_leaf(cls.__name__, field, value)
            object.__setattr__(self, field.name, value)
        self.check()
        _note_modules(self)

    cls.__init__ = checked_init  # type: ignore[method-assign]

    return register_component(cls)


def _keep_required(cls: type) -> None:
    """Marks the fields without a value as such where a base class, which is no dataclass, has a
    default of the same name.
    """
    inherited = getattr(cls, "__dataclass_fields__", {})
    for name, kind in inspect.get_annotations(cls).items():
        is_field = "ClassVar" not in str(kind)
        if is_field and name not in vars(cls) and name not in inherited and hasattr(cls, name):
            setattr(cls, name, dataclasses.field())


def _note_modules(part: Any) -> None:
    """Stores the names of the fields that hold modules with more than numbers in them."""
    values = field_values(part)
    divisions = tuple(
        (field.name, modules.Division.of(values[field.name]))
        for field in dataclasses.fields(part)
        if not is_leaf_field(field) and not field.metadata.get("static")
        if modules.is_module(values[field.name]) and modules.has_structure(values[field.name])
    )
    if divisions:
        object.__setattr__(part, _DIVISIONS, divisions)


def register_component(cls: type[T]) -> type[T]:
    """Registers a component's class as a pytree, and returns it.

    `component` calls it. It is called again where a class arrives from another process by value
    (`studies.workers`), because decorators do not run there.
    """
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    # JAX compares the structures of two components by `==`.  Beside the static fields, a structure
    # therefore holds their exact keys, and of a user's class the key of its methods.
    children = tuple(f.name for f in fields if not f.metadata.get("static"))
    structure = tuple(f.name for f in fields if f.metadata.get("static"))
    # Every call of a compiled function flattens its arguments by these getters.
    children_of, structure_of = _getter(children), _getter(structure)
    keys = tuple(map(jax.tree_util.GetAttrKey, children))

    def flatten_with_keys(obj):
        values, aux = flatten(obj)
        return tuple(zip(keys, values, strict=True)), aux

    def flatten(obj):
        values = children_of(obj)
        divisions = obj._divisions
        if divisions:
            by_name = dict(zip(children, values, strict=True))
            for name, division in divisions:
                by_name[name] = division.with_nodes(by_name[name])
            values = tuple(by_name.values())
        if not has_key and not divisions:
            return values, ()
        fixed = structure_of(obj)
        return values, (fixed, divisions, key_of_fields(fixed), getattr(cls, _BEHAVIOUR))

    def unflatten(aux, values):
        obj = object.__new__(cls)
        attributes = obj.__dict__
        attributes.update(zip(children, values, strict=True))
        if not aux:
            return obj
        fixed, divisions = aux[:2]
        attributes.update(zip(structure, fixed, strict=True))
        if divisions:
            attributes[_DIVISIONS] = divisions
            for name, division in divisions:
                attributes[name] = division.without_nodes(attributes[name])
        return obj

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    setattr(cls, _REGISTERED, True)
    setattr(cls, _DIVISIONS, ())
    behaviour = behaviour_of(cls)
    setattr(cls, _BEHAVIOUR, behaviour)
    has_key = bool(structure) or behaviour is not None
    return cls


def note_code(tree: object) -> None:
    """Notes the methods of the users' classes in a pytree as they are now.

    A program is compiled again if a method has been replaced, or what it captures has changed.
    Every entry point calls this once: to describe a class takes longer than to flatten its objects.
    """
    jax.tree.map(lambda x: None, tree, is_leaf=_noted)


def _noted(part: object) -> bool:
    """False, so that JAX goes on to the parts of this one."""
    cls = type(part)
    if vars(cls).get(_BEHAVIOUR) is not None:
        setattr(cls, _BEHAVIOUR, behaviour_of(cls))
    return False


_DIVISIONS = "_divisions"
"""Attribute with the divisions of those modules of a component that hold functions."""
_BEHAVIOUR = "__behaviour__"
"""Attribute of a class with the key of its methods, as `note_code` found them; None for a class of
the package."""
_REGISTERED = "_registered_component"
"""Attribute of a class that `register_component` has registered."""


def is_component_class(value: object) -> bool:
    """Whether this is a class that `component` was applied to."""
    return isinstance(value, type) and _REGISTERED in vars(value)


def _getter(names: tuple[str, ...]) -> Callable[[Any], tuple]:
    """A function of an object that returns these attributes."""
    if len(names) > 1:
        return operator.attrgetter(*names)
    if names:
        get = operator.attrgetter(names[0])
        return lambda obj: (get(obj),)
    return lambda obj: ()


Pytree: TypeAlias = Any
"""Arrays in containers whose structure a part of a loop defines, such as the state of a law."""
Absent: TypeAlias = tuple[()]
"""The type of an optional part of a pytree that is absent: `()`, which has no leaves."""


def is_absent(x: object) -> TypeIs[Absent]:
    """Whether an optional part of a pytree is absent."""
    return isinstance(x, tuple) and not x


def layers(part: object) -> list[Any]:
    """A component and the components that it wraps, outermost first. The class attribute `wraps`
    is the name of the field that holds the wrapped component.
    """
    found = [part]
    while field := wrapped_field(found[-1]):
        found.append(vars(found[-1])[field])
    return found


def wrapped_field(part: object) -> str | None:
    """The name of the field that holds the wrapped component; None if there is none."""
    return statements_of(part).wraps


def unwrapped(part: object) -> Any:
    """The innermost of the `layers` of a component."""
    return layers(part)[-1]


def rewrapped(part: Any, inner: Any) -> Any:
    """`part` with its innermost component replaced by `inner`; `inner` itself if `part` wraps
    no component.
    """
    name = wrapped_field(part)
    if not name:
        return inner
    return dataclasses.replace(part, **{name: rewrapped(vars(part)[name], inner)})


def field_values(part: Any) -> dict[str, Any]:
    """Name -> value of the fields of a dataclass."""
    return {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}


def is_leaf_field(field: dataclasses.Field) -> bool:
    """Whether a dataclass field was declared with `leaf`."""
    return bool(field.metadata.get("leaf"))


def astype(tree: T, dtype: jax.typing.DTypeLike) -> T:
    """The same component with all its numbers in another floating-point type, `astype(scenario,
    "float32")`.

    Raises:
      ValueError: a type that is not a floating-point one, or something in the component that is no
        number.
    """
    import jax.numpy as jnp

    try:
        floating = jnp.issubdtype(jnp.zeros((), dtype).dtype, jnp.floating)
    except Exception:  # whatever NumPy makes of it
        floating = False
    if not floating:
        raise checks.fail("dtype", dtype, 'a floating-point type, such as "float32"')
    checks.flat_enough("tree", tree)
    return jax.tree.map(lambda x: checks.as_floats("tree", x).astype(dtype), tree)
