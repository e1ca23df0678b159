"""Modules, and names of a package, that Python imports when they are first used, so that importing
the package stays quick.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from iblf_jax.core.former_names import no_attribute


class ModuleOnFirstUse:
    """A module that Python imports when one of its names is read, for annotations that
    `typing.get_type_hints` evaluates.

    Args:
      name: of the module.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self._name), name)


if TYPE_CHECKING:
    import mujoco as mujoco
    import xarray as xarray
else:
    mujoco, xarray = ModuleOnFirstUse("mujoco"), ModuleOnFirstUse("xarray")


def on_first_use(
    package: str, table: Mapping[str, tuple[str, str | None]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package.

    Args:
      package: its `__name__`.
      table: public name -> (module, attribute or None for the module itself).
    """
    names = vars(sys.modules[package])

    def get(name: str) -> Any:
        if name not in table:
            raise no_attribute(package, name)
        module, attribute = table[name]
        imported = importlib.import_module(module)
        names[name] = imported if attribute is None else getattr(imported, attribute)
        return names[name]

    def public_names() -> list[str]:
        listed = {*names, *table}
        return sorted(x for x in listed if not x.startswith("_") or x == "__version__")

    return get, public_names
