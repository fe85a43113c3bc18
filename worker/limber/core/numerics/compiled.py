"""How the kernels are compiled: once, into the user's cache folder.

numba keeps compiled code beside the source by default. An installed Limber may be read-only, and
Blender's and the user's Python differ, so it goes to the user's cache folder instead; an explicit
NUMBA_CACHE_DIR wins. Where no folder can be written the kernels are compiled for the process.
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
    """Return the folder for compiled kernels, or None if it cannot be written to."""
    return _writable(Path(os.environ.get("NUMBA_CACHE_DIR")
                          or platformdirs.user_cache_path("limber") / "numba" / _layout()))


@functools.cache
def _writable(folder: Path) -> Path | None:
    """Make a folder; None where nothing can be written to it. Asked once: kernels are many."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return None


@functools.cache
def _layout() -> str:
    """Digest of how kernels are compiled.

    numba finds by itself that a kernel's source has changed; one that was compiled otherwise would
    be used.
    """
    return hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:12]


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
        return _forgiving(numba.njit(cache=True, **options)(function))
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


class _CheckedFile(IndexDataCacheFile):
    """numba's files of one kernel, each with a checksum behind what numba wrote.

    numba unpickles what it finds, and hands it to the linker: a file that a full disk or a lost
    computer cut off would end every command, or the process. Here such a file counts as missing.
    """

    def _load_index(self) -> dict:
        return super()._load_index() if self._is_whole(self._index_path) else {}

    def _load_data(self, name: str) -> Any:
        path = self._data_path(name)
        if not self._is_whole(path):
            # numba compiles anew where a file is missing.
            raise FileNotFoundError(path)
        return super()._load_data(name)

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        with super()._open_for_write(filepath) as stream:
            content = io.BytesIO()
            yield content
            stream.write(content.getvalue() + hashlib.sha256(content.getvalue()).digest())

    def _is_whole(self, path: str) -> bool:
        """Whether a file is as it was written, or is not there; one that is damaged is removed."""
        try:
            content = Path(path).read_bytes()
            if content[-_DIGEST:] == hashlib.sha256(content[:-_DIGEST]).digest():
                return True
            os.unlink(path)
            _tell_damage(f"The compiled code stored in {path} is damaged. It is compiled again.")
        except FileNotFoundError:
            # Nothing is kept; or another process has just removed it, and said so.
            return True
        except OSError as error:
            _tell_damage(f"The compiled code stored in {path} cannot be read or replaced "
                         f"({error.strerror}). It is compiled for this run only. Remove that file "
                         "or change its permissions.")
        return False


_DIGEST = hashlib.sha256().digest_size


_damage_told: list[str] = []


def _tell_damage(message: str) -> None:
    """Warn, once in a process: where one file is damaged, others mostly are too."""
    if not _damage_told:
        _damage_told.append(message)
        warnings.warn(message, DamagedCacheWarning, stacklevel=2)


def _forgiving(kernel: Any) -> Any:
    """Let a kernel be compiled anew where what is kept of it cannot be used, or nothing be kept.

    Types of arguments are kept by module and name. After an update that moves one, numba reads
    the old entry before it sees that the source has changed, and fails.
    """
    cache = getattr(kernel, "_cache", None)  # there is none where numba is told not to compile
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
            # The kernel is compiled: that it is not kept costs time, no result.
            _tell_damage(f"Compiled code cannot be stored in {cache.cache_path} "
                         f"({error.strerror}). Every run compiles it again.")
    cache.load_overload, cache.save_overload = load_or_forget, save_or_tell
    return kernel


def for_kernels(array: np.ndarray) -> np.ndarray:
    """Return floats in C order that may be written to: kernels are compiled for no other kind."""
    return np.require(array, float, "CW")
