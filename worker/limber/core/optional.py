"""Packages that Limber works without until something needs them."""

import importlib.util

from limber.core.errors import MissingDependencyError


def require_extra(extra: str, packages: tuple[str, ...], what: str) -> None:
    """Make sure that what an extra of Limber brings is installed, before work begins.

    Args:
        extra: Its name, as in ``pip install 'limber[report]'``.
        packages: What it brings, by the names they are imported with.
        what: What needs it, for the message.

    Raises:
        MissingDependencyError: a package is missing.
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingDependencyError(
            f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} not installed.",
            f"{what} needs {'it' if len(missing) == 1 else 'them'}.",
            f"Install with: pip install 'limber[{extra}]'")
