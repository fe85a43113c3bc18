"""Optional packages, loaded when they are needed."""

import importlib.util

from limber.core.errors import MissingDependencyError


def require_extra(extra: str, packages: tuple[str, ...], what: str) -> None:
    """Check that the packages of a Limber extra are installed, before work begins.

    Args:
        extra: Name of the extra, as in ``pip install 'limber[report]'``.
        packages: Its packages, by their import names.
        what: The feature that needs it, for the message.

    Raises:
        MissingDependencyError: a package is missing.
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingDependencyError(
            f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} not installed.",
            f"{what} needs {'it' if len(missing) == 1 else 'them'}.",
            f"Install with: pip install 'limber[{extra}]'")
