"""Compilation of the kernels: once, into the user's cache folder, or before the installation.

By default numba stores compiled code beside the source. An installed Limber may be read-only, and
Blender's Python differs from the user's, so the user's cache folder is used instead; an explicit
NUMBA_CACHE_DIR takes precedence. If no folder is writable, the kernels are compiled for the
process. The extension's zip brings compiled kernels (:data:`SHIPPED`).

All x86-64 processors with AVX2 get the same instructions, so that kernels compiled on one machine
run on another, and give the same digits on all. Wider vectors gained nothing.
"""

import contextlib
import functools
import hashlib
import io
import os
import platform
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import llvmlite.binding
import numba
import numpy as np
import platformdirs
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    _CacheLocator,
)
from numba.core.dispatcher import Dispatcher
from numba.core.event import Event, Listener, register

from limber.core.errors import DamagedCacheWarning

SHIPPED = Path(__file__).parents[3] / "limber_kernels"
"""Folder beside the installed package with kernels compiled for this system and Python, if any."""
_PROCESSOR = "x86-64-v3"
_NEEDED = ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")
"""Features that the processor needs for this instruction set, by LLVM's names."""


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
    """Digest of the compilation options: numba detects a changed source, but not other options."""
    return hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:12]


def compiled(function: Callable) -> Callable:
    """Compile ``function`` with numba, with sums in any order; it is kept in :func:`cache_folder`.
    """
    # Always inlined: otherwise a kernel that another calls would exist twice, optimised in two
    # ways. Which one runs (and thus the last digits) would depend on whether it was compiled in
    # this process or loaded.
    return _kept(numba.njit(error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"},
                            forceinline=True)(function))


def compiled_exactly(function: Callable) -> Callable:
    """As :func:`compiled`, with all operations rounded in the order in which they are written."""
    return _kept(numba.njit(function))


def _kept(kernel: Any) -> Any:
    """Let a kernel be stored, where there is a folder and numba compiles at all."""
    if isinstance(kernel, Dispatcher) and cache_folder() is not None:
        kernel._cache = KernelCache(kernel.py_func)
    return kernel


def _choose_instructions() -> None:
    """Compile for the instruction set of :data:`_PROCESSOR`, unless the user has chosen one."""
    features = llvmlite.binding.get_host_cpu_features()
    if (numba.config.CPU_NAME is None and platform.machine().lower() in ("x86_64", "amd64")
            and all(features.get(name) for name in _NEEDED)):
        # In the environment, which numba reads again when it changes, and child processes too.
        os.environ["NUMBA_CPU_NAME"], os.environ["NUMBA_CPU_FEATURES"] = _PROCESSOR, ""
        numba.config.reload_config()


_choose_instructions()


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
    """numba's files of one kernel, each with a checksum of name and content: numba unpickles and
    links them, and one truncated by a full disk or a crash, or another's, would end every command,
    or the process. Here it counts as missing."""

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
            stream.write(content.getvalue() + _checksum(filepath, content.getvalue()))

    def _is_whole(self, path: str) -> bool:
        """Whether a file is undamaged or missing; a damaged one is removed."""
        try:
            content = Path(path).read_bytes()
            if content.endswith(_checksum(path, content[:-32])):
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


def _checksum(path: str, content: bytes) -> bytes:
    """SHA-256 of a file's name and content, 32 bytes: one kernel's whole code is not another's."""
    return hashlib.sha256(os.path.basename(path).encode() + content).digest()


_reported_damage: list[str] = []


def _tell_damage(message: str) -> None:
    """Warn once per process: if one file is damaged, others usually are too."""
    if not _reported_damage:
        _reported_damage.append(message)
        warnings.warn(message, DamagedCacheWarning, stacklevel=2)


@functools.cache
def _digest_of(path: str) -> bytes:
    return hashlib.sha256(Path(path).read_bytes()).digest()


def _stamp(function: Any) -> str:
    """Return a digest of a kernel's file and of the kernels and constants that it takes from
    others. numba alone would use old code after a change in another file's inlined kernel, and
    compile again after each installation, as it compares the file's date."""
    digest = hashlib.sha256(_digest_of(function.__code__.co_filename))
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    # All that its module has so far, and thus has imported: what it calls may stand below it.
    known = [value for name, value in sorted(function.__globals__.items())
             if not name.startswith("__")]
    for value in (*cells, *known):
        if isinstance(value, Dispatcher):
            digest.update(getattr(value._cache, "stamp", "").encode())
        elif isinstance(value, np.ndarray):
            digest.update(value.tobytes())
        elif isinstance(value, int | float | str | tuple):
            digest.update(repr(value).encode())
    return digest.hexdigest()[:16]


class _Place(_CacheLocator):
    """Says where numba stores a kernel: in one folder, by its name and stamp."""

    def __init__(self, function: Any, path: str):
        self._py_file = path
        self._line = function.__code__.co_firstlineno
        self._stamp, self._folder = _stamp(function), cache_folder()

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> "_Place":
        return cls(py_func, py_file)

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._stamp

    def get_disambiguator(self) -> str:
        return f"{self._line}-{self._stamp}"


class _Stored(CompileResultCacheImpl):
    _locator_classes = (_Place,)


class KernelCache(FunctionCache):
    """A kernel's compiled code, shipped or the user's, in files of this name, by the digest of its
    sources. It is compiled again if unusable (argument types are stored by module and name, and an
    update may move one), and not stored if that fails."""

    _impl_class = _Stored

    def __init__(self, function: Any):
        super().__init__(function)
        self.stamp = self._impl.locator.get_source_stamp()
        self.name = self._impl.filename_base
        self._files = [_CheckedFile(folder, self.name, self.stamp)
                       for folder in (str(SHIPPED), self.cache_path)]
        self._cache_file = self._files[-1]

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        # Without the bytecode, in which patch versions of one Python differ: the stamp is of the
        # source.
        types, target, (_, closure) = super()._index_key(sig, codegen)
        return types, target, closure

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        for files in self._files:
            # The last one, the user's, is also where numba stores.
            self._cache_file = files
            try:
                if (found := super().load_overload(sig, target_context)) is not None:
                    return found
            except (ImportError, AttributeError):
                if files is self._files[-1]:
                    self.flush()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            # The kernel is compiled; without caching it only costs time.
            _tell_damage(f"Compiled code cannot be stored in {self.cache_path} "
                         f"({error.strerror}). Every run compiles it again.")


def for_kernels(array: np.ndarray) -> np.ndarray:
    """Return writable floats in C order: kernels are compiled for no other kind."""
    return np.require(array, float, "CW")
