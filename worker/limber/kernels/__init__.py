"""Native kernels: their library, and functions that check the arrays before each call.

Their sources are in ``worker/kernels``, and the built libraries in this folder. A kernel is
declared as its C++ function, arrays with their types and shapes:

>>> sparse_times = Kernel(
...     "sparse_times", "starts int32[starts]", "columns int32[entries]",
...     "values float64[entries]", "field float64[columns, 3]", "out product float64[rows, 3]")

Names in shapes are sizes: where a name returns, the size must too. The function gets all
arguments, arrays first, then each such size in the order of first mention. An array without rows
may have any other sizes. Calls do not hold the interpreter's lock, and may run at the same time.
"""

import ctypes
import functools
import os
import platform
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import MissingDependencyError

FOLDER = Path(__file__).parent
_SOURCES = FOLDER.parents[1] / "kernels"
_SYSTEMS = {"linux": ("linux", "so"), "darwin": ("macos", "dylib"), "win32": ("windows", "dll")}
_MACHINES = {"x86_64": "x64", "amd64": "x64", "arm64": "arm64", "aarch64": "arm64"}
_PLAIN = {"int": ctypes.c_int64, "float": ctypes.c_double, "": None}


@functools.cache
def library() -> ctypes.CDLL:
    """Return the library for this system and processor. In a checkout it is built if a source has
    changed. With ``LIMBER_KERNELS=v2`` it is that for processors without AVX2."""
    system, ending = _SYSTEMS.get(sys.platform, (sys.platform, "so"))
    machine = _MACHINES.get(platform.machine().lower(), platform.machine())
    try:
        if FOLDER.parents[1].name == "worker" and (_SOURCES / "build.py").is_file():
            runpy.run_path(str(_SOURCES / "build.py"))["build"](FOLDER)
        plain = ctypes.CDLL(str(FOLDER / f"{system}-{machine}.{ending}"))
        if plain.has_wide_vectors() and os.environ.get("LIMBER_KERNELS") != "v2":
            return ctypes.CDLL(str(FOLDER / f"{system}-{machine}-v3.{ending}"))
        return plain
    except (OSError, RuntimeError) as error:
        raise MissingDependencyError(
            f"Limber's compiled kernels do not load: {error}.",
            "In a checkout run scripts/setup, which brings a compiler where there is none. Else "
            "install Limber from its wheel.") from error


class Kernel:
    """A native function of a name; arguments as above, ``returns`` is int, float or nothing."""

    def __init__(self, name: str, *arguments: str, returns: str = ""):
        self.name, self._declared, self._returns = name, arguments, returns
        shaped = [argument.rstrip("]").split("[") for argument in arguments if "[" in argument]
        self._count = len(shaped)
        self._dtypes = [np.dtype(head.split()[-1]) for head, _ in shaped]
        self._axes = [tuple(shape.split(", ")) for _, shape in shaped]
        self._written = [number for number, (head, _) in enumerate(shaped)
                         if head.startswith("out ")]
        self._plain: list[Any] = [_PLAIN[plain.split()[-1]] for plain in arguments[self._count:]]
        self._sizes = list(dict.fromkeys(
            axis for axes in self._axes for axis in axes if not axis.isdecimal()))
        self._room = ctypes.c_int64 * (self._count + len(self._sizes))

    @functools.cached_property
    def _function(self) -> Callable:
        function = library()[self.name]
        function.argtypes = [*[ctypes.c_void_p] * self._count, *self._plain,
                             *[ctypes.c_int64] * len(self._sizes)]
        function.restype = _PLAIN[self._returns]
        return function

    @functools.cached_property
    def _fit(self) -> Callable[[int, ctypes.Array], bool]:
        """Whether the arrays that begin at an address are as declared; it writes where their
        numbers begin, and the sizes, in a tenth of the time that Python takes."""
        wanted = [self._count, object.__basicsize__, id(np.ndarray)]
        for number, (dtype, axes) in enumerate(zip(self._dtypes, self._axes, strict=True)):
            # Two of C's integers may have the same bytes.
            twin = next(char for char in "lqidf?" if np.dtype(char) == dtype)
            wanted += [ord(dtype.char), ord(twin), number in self._written, len(axes), *(
                -1 - int(axis) if axis.isdecimal() else self._count + self._sizes.index(axis)
                for axis in axes)]
        function = ctypes.PyDLL(library()._name)["arrays_fit"]
        function.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        function.restype = ctypes.c_bool
        return functools.partial(function, (ctypes.c_int64 * len(wanted))(*wanted))

    def __call__(self, *values: Any) -> Any:
        found = self._room()
        if not self._fit(id(values) + _ITEMS, found):
            raise self._misfit(values[:self._count])
        numbers = found[:]
        return self._function(*numbers[:self._count], *values[self._count:],
                              *numbers[self._count:])

    def of(self, *values: Any) -> Any:
        """As a call, with arrays to read in any order and of any type: they are converted."""
        return self(*[values[k] if k in self._written else np.ascontiguousarray(values[k], dtype)
                      for k, dtype in enumerate(self._dtypes)], *values[self._count:])

    def _misfit(self, arrays: tuple[np.ndarray, ...]) -> TypeError:
        seen = ", ".join(f"{array.dtype}{list(array.shape)}" + (
            "" if array.flags.carray else " read-only or with gaps") for array in map(
                np.asanyarray, arrays))
        return TypeError(f"The kernel {self.name} wants {', '.join(self._declared)}, in C order. "
                         f"It was given {seen}.")


_ITEMS = tuple.__basicsize__
"""Where a tuple's items begin behind its address."""


def for_kernels(array: np.ndarray) -> np.ndarray:
    """Return floats in C order, which kernels take."""
    return np.ascontiguousarray(array, float)
