"""Compilation of the kernels: once, into the user's cache folder.

By default numba stores compiled code beside the source. An installed Limber may be read-only, and
Blender's Python differs from the user's, so the user's cache folder is used instead; an explicit
NUMBA_CACHE_DIR takes precedence. If no folder is writable, the kernels are compiled for the
process.
"""

import contextlib
import functools
import hashlib
import io
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np
import platformdirs
from numba.core.caching import IndexDataCacheFile
from numba.core.event import Event, Listener, register

from limber.core.errors import DamagedCacheWarning


def cache_folder() -> Path | None:
    """Return the folder for compiled kernels, or None if it is not writable."""
    return _writable(Path(os.environ.get("NUMBA_CACHE_DIR")
                          or platformdirs.user_cache_path("limber") / "numba" / _layout()))


@functools.cache
def _writable(folder: Path) -> Path | None:
    """Make a folder; None if it is not writable. Checked once, as there are many kernels."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return None


@functools.cache
def _layout() -> str:
    """Digest of the compilation options.

    numba itself detects a changed source, but would use a kernel compiled with other options.
    """
    return hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:12]


def compiled(function: Callable) -> Callable:
    """Compile ``function`` with numba; the result is stored in :func:`cache_folder`."""
    folder = cache_folder()
    # Always inlined: otherwise a kernel that another calls would exist twice, optimised in two
    # ways. Which one runs (and thus the last digits) would depend on whether it was compiled in
    # this process or loaded.
    options = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp"},
               "forceinline": True}
    if folder is None:
        return numba.njit(**options)(function)
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(folder)
    try:
        return _forgiving(numba.njit(cache=True, **options)(function))
    finally:
        numba.config.CACHE_DIR = before


def when_compiling(tell: Callable[[], None]) -> None:
    """Call ``tell`` once, when the first kernel is compiled rather than loaded."""
    register("numba:compile", _FirstStart(tell))


class _FirstStart(Listener):
    """Calls a function at the first start of a compilation."""

    def __init__(self, tell: Callable[[], None]):
        self._tell: Callable[[], None] | None = tell

    def on_start(self, event: Event) -> None:
        tell, self._tell = self._tell, None
        if tell is not None:
            tell()

    def on_end(self, event: Event) -> None:
        """The end of a compilation is not reported."""


class _CheckedFile(IndexDataCacheFile):
    """numba's files of one kernel, each with a checksum appended to numba's content.

    numba unpickles these files and passes them to the linker. A file truncated by a full disk or a
    crash would end every command, or the process. Here such a file counts as missing.
    """

    def _load_index(self) -> dict:
        return super()._load_index() if self._is_whole(self._index_path) else {}

    def _load_data(self, name: str) -> Any:
        path = self._data_path(name)
        if not self._is_whole(path):
            # numba compiles again if a file is missing.
            raise FileNotFoundError(path)
        return super()._load_data(name)

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        with super()._open_for_write(filepath) as stream:
            content = io.BytesIO()
            yield content
            stream.write(content.getvalue() + hashlib.sha256(content.getvalue()).digest())

    def _is_whole(self, path: str) -> bool:
        """Whether a file is undamaged or missing; a damaged one is removed."""
        try:
            content = Path(path).read_bytes()
            if content[-_DIGEST:] == hashlib.sha256(content[:-_DIGEST]).digest():
                return True
            os.unlink(path)
            _tell_damage(f"The compiled code stored in {path} is damaged. It is compiled again.")
        except FileNotFoundError:
            # The file is missing; or another process has just removed it and has warned.
            return True
        except OSError as error:
            _tell_damage(f"The compiled code stored in {path} cannot be read or replaced "
                         f"({error.strerror}). It is compiled for this run only. Remove that file "
                         "or change its permissions.")
        return False


_DIGEST = hashlib.sha256().digest_size


_reported_damage: list[str] = []


def _tell_damage(message: str) -> None:
    """Warn once per process: if one file is damaged, others usually are too."""
    if not _reported_damage:
        _reported_damage.append(message)
        warnings.warn(message, DamagedCacheWarning, stacklevel=2)


def _forgiving(kernel: Any) -> Any:
    """Compile a kernel again if its cached form is unusable, or do not cache it.

    Argument types are cached by module and name. After an update that moves one, numba reads the
    old entry before it notices the changed source, and fails.
    """
    cache = getattr(kernel, "_cache", None)  # missing where numba is told not to compile
    if cache is None:
        return kernel
    cache._cache_file = _CheckedFile(cache.cache_path, cache._impl.filename_base,
                                     cache._impl.locator.get_source_stamp())
    load, save = cache.load_overload, cache.save_overload

    def load_or_forget(signature: Any, target: Any) -> Any:
        try:
            return load(signature, target)
        except (ImportError, AttributeError):
            cache.flush()
            return None

    def save_or_tell(signature: Any, data: Any) -> None:
        try:
            save(signature, data)
        except OSError as error:
            # The kernel is compiled; without caching it only costs time.
            _tell_damage(f"Compiled code cannot be stored in {cache.cache_path} "
                         f"({error.strerror}). Every run compiles it again.")
    cache.load_overload, cache.save_overload = load_or_forget, save_or_tell
    return kernel


def for_kernels(array: np.ndarray) -> np.ndarray:
    """Return writable floats in C order: kernels are compiled for no other kind."""
    return np.require(array, float, "CW")
