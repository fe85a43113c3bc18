"""How the kernels are compiled: once, into the user's cache folder.

numba keeps compiled code beside the source by default. An installed Limber may be read-only, and
Blender's and the user's Python differ, so it goes to the user's cache folder instead; an explicit
NUMBA_CACHE_DIR wins. Where no folder can be written the kernels are compiled for the process.
"""

import functools
import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import platformdirs
from numba.core.event import Event, Listener, register


def cache_folder() -> Path | None:
    """Return the folder for compiled kernels, or None if it cannot be written to."""
    folder = Path(os.environ.get("NUMBA_CACHE_DIR")
                  or platformdirs.user_cache_path("limber") / "numba" / _layout())
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return None


@functools.cache
def _layout() -> str:
    """Digest of the modules' names and of how kernels are compiled.

    numba finds by itself that a kernel's source has changed. A kernel kept for a module that has
    been renamed since would fail to load; one that was compiled otherwise would be used.
    """
    package = Path(__file__).parent
    names = sorted(path.relative_to(package).as_posix() for path in package.rglob("*.py"))
    digest = hashlib.sha256("\n".join(names).encode())
    digest.update(Path(__file__).read_bytes())
    return digest.hexdigest()[:12]


def compiled(function: Callable) -> Callable:
    """Compile ``function`` with numba; the result is kept in :func:`cache_folder`."""
    folder = cache_folder()
    # Inlined always: a kernel that another calls would otherwise be there twice, optimised in two
    # ways, and which one runs (and so the last digits) would depend on whether it was compiled
    # in this process or loaded.
    options = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp"},
               "forceinline": True}
    if folder is None:
        return numba.njit(**options)(function)
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(folder)
    try:
        return _forgetful(numba.njit(cache=True, **options)(function))
    finally:
        numba.config.CACHE_DIR = before


def when_compiling(tell: Callable[[], None]) -> None:
    """Call ``tell`` once, when the first kernel has to be compiled and is not just read again."""
    register("numba:compile", _FirstStart(tell))


class _FirstStart(Listener):
    """Calls a function at the first start that it hears of."""

    def __init__(self, tell: Callable[[], None]):
        self._tell: Callable[[], None] | None = tell

    def on_start(self, event: Event) -> None:
        tell, self._tell = self._tell, None
        if tell is not None:
            tell()

    def on_end(self, event: Event) -> None:
        """Who was told of the start knows enough."""


def _forgetful(kernel: Any) -> Any:
    """Let a kernel be compiled anew where what is kept of it cannot be read any more.

    Types of arguments are kept by module and name. After an update that moves one, numba reads
    the old entry before it sees that the source has changed, and fails.
    """
    cache = getattr(kernel, "_cache", None)  # there is none where numba is told not to compile
    if cache is None:
        return kernel
    load = cache.load_overload

    def load_or_forget(signature: Any, target: Any) -> Any:
        try:
            return load(signature, target)
        except (ImportError, AttributeError):
            cache.flush()
            return None
    cache.load_overload = load_or_forget
    return kernel


def for_kernels(array: np.ndarray) -> np.ndarray:
    """Return floats in C order that may be written to: kernels are compiled for no other kind."""
    return np.require(array, float, "CW")
