"""Rigid transforms one at a time, for loops at the controller's rate: a call takes a microsecond.

Frames are [4, 4], poses [6] in m and rad. Arrays of poses use :mod:`limber.core.numerics.rigid`.
"""

import ctypes
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from limber.kernels import library

_HEAD = object.__basicsize__


SMALL_KERNELS: dict[str, tuple[str, ...]] = {}
"""The arguments of each small kernel, without what it fills."""


def small_kernel(name: str, *arguments: str, shape: tuple[int, ...] = ()) -> Callable:
    """Return a native function of small arrays of floats, and of floats, that fills and returns
    an array: a new one of a ``shape``, or ``out``. Arrays may have any strides; the function checks
    them, in a tenth of a :class:`~limber.kernels.Kernel`'s time. It holds the interpreter's lock.
    TypeError if a shape does not fit."""
    def loaded() -> Callable:
        found = ctypes.PyDLL(library()._name)[name]
        found.argtypes = [
            *(ctypes.py_object if "[" in each else ctypes.c_double for each in arguments),
            ctypes.py_object, ctypes.c_int64]
        found.restype = ctypes.c_bool
        return found

    function, head, empty = None, object.__basicsize__, np.empty
    SMALL_KERNELS[name] = arguments

    def kernel(*values: Any, out: np.ndarray | None = None) -> np.ndarray:
        nonlocal function
        result = empty(shape) if out is None else out
        if function is None:
            function = loaded()
        if function(*values, result, head):
            return result
        # Lists, or other numbers than floats.
        values = tuple(np.array(value, float) if "[" in each else value
                       for value, each in zip(values, arguments, strict=True))
        if function(*values, result, head):
            return result
        raise TypeError(f"The kernel {name} wants {', '.join(arguments)}. It was given shapes "
                        f"{', '.join(str(np.shape(one)) for one in values)}.")

    return kernel


rotation_vector = small_kernel("rotation_vector", "frame[4, 4]", shape=(3,))
"""Return the rotation vector [rad] of a frame [4, 4] or rotation matrix [3, 3]."""
frame_of = small_kernel("frame_of", "pose[6]", shape=(4, 4))
"""Return the frame of a pose."""
pose_of = small_kernel("pose_of", "frame[4, 4]", shape=(6,))
"""Return the pose of a frame."""
inverse_of = small_kernel("inverse_of", "frame[4, 4]", shape=(4, 4))
"""Return the inverse of a frame."""
turn_between = small_kernel("turn_between", "first[6]", "second[6]", shape=(3,))
"""Return the relative rotation vector from one pose's rotation to another's [rad]."""
pose_between = small_kernel("pose_between", "first[6]", "second[6]", "part", shape=(6,))
"""Return the pose at fraction ``part`` of a straight line and the shortest rotation."""
crossed = small_kernel("crossed", "first[3]", "second[3]", shape=(3,))
"""Return the cross product of two vectors."""
weight_wrench = small_kernel("weight_wrench", "mass", "centre[3]", "rotation[3, 3]", shape=(6,))
"""Return the wrench of gravity on a ``mass`` [kg] at the flange, flange frame [N, N m]: by its
``centre`` there [m] and the flange's ``rotation`` in a frame with z up."""
turned_wrench = small_kernel("turned_wrench", "rotation[3, 3]", "wrench[6]", "lever[3]", shape=(6,))
"""Return a ``wrench`` in other axes and about another point: by the ``rotation`` from its axes to
the new ones, and the ``lever`` from the new point to its old one, new axes [m]."""


def length(vector: np.ndarray) -> float:
    """Return the Euclidean length of a vector [n]."""
    return math.hypot(*vector.tolist())
