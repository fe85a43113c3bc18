"""Optional packages, loaded when they are needed."""

import importlib
import importlib.metadata
import importlib.util
import shlex
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from operator import attrgetter
from pathlib import Path
from typing import Any

from limber.core.errors import MissingDependencyError

DISTRIBUTION = "limber-branch"
"""Name by which pip knows Limber: ``limber`` is another program there."""


_PYTHONS = {"planning": (11, 12, 13), "robot": (11, 12), "blender": (11, 13)}
"""Minor versions of Python 3 for which an extra's packages have wheels, where some lack."""


def require_extra(extra: str, packages: tuple[str, ...], what: str) -> None:
    """Check that an extra's packages, by their import names, are installed before work on ``what``
    begins; MissingDependencyError if one is not."""
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingDependencyError(
            f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} not installed.",
            f"{what} needs {'it' if len(missing) == 1 else 'them'}.", how_to_install(extra))


def how_to_install(extra: str) -> str:
    """Return how an extra comes to this Python, by the way in which Limber came to it."""
    minor = sys.version_info.minor
    if minor not in (known := _PYTHONS.get(extra, (minor,))):
        return f"It has no wheel for Python 3.{minor}: use Limber with Python 3.{known[-1]} for it."
    checkout = Path(__file__).resolve().parents[3]
    if Path(sys.prefix) == checkout / ".venv":
        return f"Run `{shlex.join([str(checkout / 'scripts' / 'setup'), '--with', extra])}`."
    if (checkout / "pyproject.toml").is_file():
        return pip_install("-e", f"{checkout}[{extra}]")
    try:
        by_pip = importlib.metadata.distribution(DISTRIBUTION).read_text("INSTALLER")
    except importlib.metadata.PackageNotFoundError:
        by_pip = None
    if by_pip:
        return pip_install(f"{DISTRIBUTION}[{extra}]")
    # Blender unpacks the wheels of an extension itself.
    return ("Blender's extension does not bring it. In the add-on's preferences, choose a Python "
            f"in which Limber is installed with its extra `{extra}`.")


def pip_install(*words: str) -> str:
    """Return the advice to install packages: with this Python's pip, whichever is on the PATH."""
    return f"Install with `{shlex.join([sys.executable, '-m', 'pip', 'install', *words])}`."


# Loading on first use: `limber --help` imports no heavy package.


def exports(package: str, modules: Mapping[str, str],
            ) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a package (PEP 562) for names, each with the
    module, relative to the package, that defines it."""
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


@dataclass(frozen=True)
class Choices:
    """Objects that a setting names: ``own`` by their paths ``module:name``, imported when chosen,
    and those that other packages have as entry points of ``group``."""

    group: str
    own: Mapping[str, str]

    def names(self) -> tuple[str, ...]:
        return (*self.own, *entry_points(group=self.group).names)

    def named(self, name: str) -> Any:
        return loaded(self.own[name]) if name in self.own else (
            entry_points(group=self.group)[name].load())
