"""Loading on first use: `limber --help` imports no heavy package."""

import importlib
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any


def exports(package: str, modules: Mapping[str, str],
            ) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a package (PEP 562).

    Args:
        package: Name of the package.
        modules: Names, each with the module (relative to the package) that defines it.
    """
    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{package}.{modules[name]}"), name)

    def names() -> list[str]:
        return sorted(modules)

    return get, names


def loaded(function: Any) -> Any:
    """Return a function, or the object at the path ``module:name``."""
    if not isinstance(function, str):
        return function
    module, _, name = function.partition(":")
    return attrgetter(name)(importlib.import_module(module))
