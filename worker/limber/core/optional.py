"""Optional packages, loaded when they are needed."""

import importlib.metadata
import importlib.util
import shlex
import sys
from pathlib import Path

from limber.core.errors import MissingDependencyError

DISTRIBUTION = "limber-branch"
"""Name by which pip knows Limber: ``limber`` is another program there."""


def require_extra(extra: str, packages: tuple[str, ...], what: str) -> None:
    """Check that the packages of a Limber extra are installed, before work begins.

    Args:
        extra: Name of the extra, as ``report``.
        packages: Its packages, by their import names.
        what: The feature that needs it, for the message.

    Raises:
        MissingDependencyError: a package is missing.
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingDependencyError(
            f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} not installed.",
            f"{what} needs {'it' if len(missing) == 1 else 'them'}.", how_to_install(extra))


def how_to_install(extra: str) -> str:
    """Return how an extra comes to this Python, by the way in which Limber came to it."""
    checkout = Path(__file__).resolve().parents[3]
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
