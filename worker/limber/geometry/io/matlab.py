"""Structs in Matlab's version 7.3 files, which are HDF5. A group is a struct, and a field in it is
an array with reversed axes; for several structs, a field holds references.

Runs in a separate process (:func:`limber.geometry.io.isolated_readers.read_apart`): HDF5 is native
code, and the file may be corrupt. Links out of the file are not followed.
"""

from pathlib import Path
from typing import Any

import numpy as np

from limber.core.files.reading import HARMLESS_BYTES, LARGEST_EXPANSION

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_STARTS = (0, 512)
"""Offset at which HDF5 begins: Matlab writes its own header before it."""
_MOST_TEXT = 200


def is_hdf5(path: Path) -> bool:
    """Whether a file is HDF5, with Matlab's header or without.

    Raises:
        OSError: the file cannot be read.
    """
    with open(path, "rb") as stream:
        head = stream.read(_STARTS[-1] + len(_SIGNATURE))
    return any(head[at:at + len(_SIGNATURE)] == _SIGNATURE for at in _STARTS)


def struct_arrays(path: Path, needed: tuple[str, ...], further: tuple[str, ...],
                  ) -> dict[str, np.ndarray]:
    """Return the fields of the first struct of a file, or of its ``cylinder``, that has all needed.

    Args:
        needed: Names of fields with numbers.
        further: Names of fields that are read if present.

    Returns:
        Arrays as Matlab has them, shape [rows, columns]; and ``creator``, the text of
        ``rundata.creator``. Empty if no struct has those fields.

    Raises:
        OSError, ValueError, KeyError, RuntimeError: the file is damaged.
    """
    import h5py

    most = max(LARGEST_EXPANSION * path.stat().st_size, HARMLESS_BYTES)
    with h5py.File(path, "r") as file:
        for name in file:
            first = _struct(file, _own(file, name))
            for found in (first, _struct(file, _own(first, "cylinder"))):
                if found is not None and all(name in found for name in needed):
                    arrays = {name: _numbers(_own(found, name), most)
                              for name in (*needed, *further) if name in found}
                    creator = _own(_struct(file, _own(first, "rundata")), "creator")
                    return arrays | {"creator": np.array(_text(creator))}
    return {}


def _own(group: Any, name: str) -> Any:
    """The group's own entry of this name: no link to elsewhere is followed."""
    import h5py

    if not isinstance(group, h5py.Group) or name not in group or not isinstance(
            group.get(name, getlink=True), h5py.HardLink):
        return None
    return group[name]


def _struct(file: Any, found: Any) -> Any:
    """A struct; for an array of structs or a cell array, the first one."""
    import h5py

    if isinstance(found, h5py.Dataset) and h5py.check_ref_dtype(found.dtype) is h5py.Reference:
        if not found.size:
            return None
        first = found[(0,) * found.ndim]
        found = file[first] if first else None
    return found if isinstance(found, h5py.Group) else None


def _numbers(found: Any, most_bytes: float) -> np.ndarray:
    import h5py

    if not isinstance(found, h5py.Dataset) or found.dtype.kind not in "iuf":
        raise ValueError("the fields of a cylinder must be numbers")
    if found.external or found.is_virtual:
        raise ValueError("its numbers are stored in other files, which Limber does not read")
    if found.size * 8 > most_bytes:
        raise ValueError(f"the file announces an array of shape {found.shape}, but is too small to "
                         "hold it")
    if found.attrs.get("MATLAB_empty"):
        return np.zeros((0, 0))
    return np.asarray(found[()], float).T


def _text(found: Any) -> str:
    """A text, which Matlab stores as the numbers of its letters."""
    import h5py

    if not isinstance(found, h5py.Dataset) or found.dtype.kind != "u" or found.external or (
            found.is_virtual) or found.size > _MOST_TEXT:
        return ""
    return "".join(chr(int(letter)) for letter in np.asarray(found[()]).ravel())
