"""Cylinder models (QSM) of other programs: TreeQSM, SmartQSM, SimpleForest, rTwig.

======================  ===========================================================================
``.mat``                TreeQSM: a struct ``QSM`` with ``cylinder`` (radius, length, start, axis,
                        parent, extension, branch, BranchOrder, PositionInBranch, added).
                        SmartQSM writes the same struct; its radius is that of a cone's thin end,
                        UnmodRadius that of the thick one (its ``parameterize_and_export``).
                        Version 7.3 by :mod:`limber.geometry.io.cylinder_models`
``.csv``                rTwig's minimum: id, parent, start_x ... end_z, radius; SimpleForest: ID,
                        parentID, startX ... endZ, radius
======================  ===========================================================================
"""

from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import HARMLESS_BYTES, LARGEST_EXPANSION
from limber.core.files.tables import write_table
from limber.core.optional import require_extra
from limber.geometry.io.isolated_readers import read_apart
from limber.geometry.skeleton.skeleton import Skeleton

# Structs in Matlab's version 7.3 files, which are HDF5. A group is a struct, and a field in it is
# an array with reversed axes; for several structs, a field holds references.
#
# Runs in a separate process (:func:`limber.geometry.io.isolated_readers.read_apart`): HDF5 is
# native code, and the file may be corrupt. Links out of the file are not followed.

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_STARTS = (0, 512)
"""Offset at which HDF5 begins: Matlab writes its own header before it."""
_MOST_TEXT = 200


def is_hdf5(path: Path) -> bool:
    """Whether a file is HDF5, with Matlab's header or without; OSError if it cannot be read."""
    with open(path, "rb") as stream:
        head = stream.read(_STARTS[-1] + len(_SIGNATURE))
    return any(head[at:at + len(_SIGNATURE)] == _SIGNATURE for at in _STARTS)


def struct_arrays(path: Path, needed: tuple[str, ...], further: tuple[str, ...],
                  ) -> dict[str, np.ndarray]:
    """Return the fields [rows, columns] of the first struct, or its ``cylinder``, with all needed
    ones, and ``creator``, the text of ``rundata.creator``; empty if none has them. A damaged file
    raises OSError, ValueError, KeyError or RuntimeError."""
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


TREEQSM_FIELDS = ("radius", "start", "axis", "length", "parent")
_THICK = "UnmodRadius"


def read_treeqsm(path: Path) -> dict[str, np.ndarray]:
    """Return ``id``, ``parent`` (-1: none), ``start``, ``end``, ``radius`` and ``start_radius`` of
    a ``.mat`` file's first model. Cylinders without a parent are attached if they start where the
    first does. MissingDependencyError for version 7.3 without h5py."""
    found = _fields(Path(path))
    if not found:
        raise InputError(f"{path} has no struct with the fields {', '.join(TREEQSM_FIELDS)}.",
                         "A TreeQSM model was expected.", "Save the QSM itself from TreeQSM.")
    try:
        radius, length, parent = (np.asarray(found[name], float).ravel()
                                  for name in ("radius", "length", "parent"))
        start, axis = (np.atleast_2d(np.asarray(found[name], float))
                       for name in ("start", "axis"))
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: {error}.", "A cylinder's fields are numbers.",
                         "Save it again.") from error
    count = len(radius)
    if not (len(length) == len(parent) == count and start.shape == axis.shape == (count, 3)):
        raise InputError(f"{path} has fields of different lengths.",
                         "Each field needs one value for each cylinder.", "Save it again.")
    return {"id": np.arange(1.0, count + 1), "parent": np.where(parent > 0, parent, -1.0),
            "start": start, "end": start + axis * length[:, None], "radius": radius,
            "start_radius": _thick_ends(found, radius)}


def _fields(path: Path) -> dict[str, Any]:
    """The fields of the cylinders and ``creator``; empty if there are no cylinders."""
    try:
        is_new = is_hdf5(path)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).",
                         "A TreeQSM model was expected.", "Check the path.") from error
    if is_new:
        require_extra("matlab", ("h5py",),
                      f"The MAT file {path} of version 7.3 (saving it in Matlab with -v7 avoids "
                      "this)")
        return read_apart(mat_v73_fields, path)
    return read_apart(mat_fields, path)


def mat_v73_fields(path: Path) -> dict[str, np.ndarray]:
    """Return the fields of the cylinders of a MAT file of version 7.3."""
    return struct_arrays(path, TREEQSM_FIELDS, (_THICK,))


def mat_fields(path: Path) -> dict[str, np.ndarray]:
    """Return the fields of the cylinders and ``creator`` of a MAT file of an older version; empty
    without cylinders. scipy's compiled reader can crash on a damaged file."""
    from scipy.io import loadmat

    content = loadmat(path, squeeze_me=True, struct_as_record=False)
    cylinder = _cylinder_struct(content)
    if cylinder is None:
        return {}
    creator = getattr(getattr(content.get("QSM"), "rundata", None), "creator", "")
    fields = {name: np.asarray(getattr(cylinder, name)) for name in (*TREEQSM_FIELDS, _THICK)
              if hasattr(cylinder, name)}
    for name, values in fields.items():
        if values.dtype.kind == "O":
            raise ValueError(f"{name} has values that are no numbers")
    return fields | {"creator": np.asarray(str(creator))}


def _thick_ends(found: dict[str, Any], radius: np.ndarray) -> np.ndarray:
    """SmartQSM stores a cone's other radius where TreeQSM has the radius before its corrections."""
    try:
        thick = np.asarray(found.get(_THICK, ()), float).ravel()
    except (TypeError, ValueError):
        return radius
    fits = str(found["creator"]) == "SmartQSM" and thick.shape == radius.shape
    return thick if fits and (np.isfinite(thick) & (thick > 0)).all() else radius


def _cylinder_struct(content: dict[str, Any]) -> Any:
    for value in content.values():
        first = value.ravel()[0] if isinstance(value, np.ndarray) and value.size and (
            value.dtype == object) else value
        for found in (first, getattr(first, "cylinder", None)):
            if found is not None and all(hasattr(found, name) for name in TREEQSM_FIELDS):
                return found
    return None


def write_treeqsm(skeleton: Skeleton, path: Path) -> None:
    """Write a TreeQSM ``.mat`` file in metres: a struct ``QSM`` with ``cylinder``."""
    from scipy.io import savemat

    start, end = skeleton.nodes[skeleton.parent[1:]], skeleton.nodes[1:]
    length = np.linalg.norm(end - start, axis=1)
    count = len(end)
    extension = np.zeros(count)
    position = np.ones(count)
    for node in range(2, count + 1):
        up = int(skeleton.parent[node])
        if up > 0 and skeleton.branch[up] == skeleton.branch[node]:
            extension[up - 1] = node
            position[node - 1] = position[up - 1] + 1
    column = {name: np.asarray(values, float)[:, None] for name, values in {
        "radius": skeleton.radius[1:], "length": length, "parent": skeleton.parent[1:],
        "extension": extension, "branch": skeleton.branch[1:] + 1,
        "BranchOrder": skeleton.order[1:], "PositionInBranch": position,
        "added": np.zeros(count)}.items()}
    axis = (end - start) / np.maximum(length, 1e-300)[:, None]
    savemat(path, {"QSM": {"cylinder": {**column, "start": start, "axis": axis}}},
            do_compression=True)


def write_rtwig(skeleton: Skeleton, path: Path) -> None:
    """Write rTwig's minimal table [m]: what its ``reconstruct_qsm`` needs, with branch and order.
    """
    titles = ("id parent start_x start_y start_z end_x end_y end_z radius branch "
              "branch_order").split()
    write_table(path, titles, (
        (node, up, *skeleton.nodes[up], *skeleton.nodes[node], skeleton.radius[node],
         skeleton.branch[node] + 1, skeleton.order[node])
        for node, up in enumerate(skeleton.parent[1:], start=1)))


def write_simpleforest(skeleton: Skeleton, path: Path) -> None:
    """Write a table with SimpleForest's names [m]."""
    titles = ("ID parentID startX startY startZ endX endY endZ axisX axisY axisZ radius length "
              "branchID branchOrder").split()
    rows = []
    for node, up in enumerate(skeleton.parent[1:], start=1):
        start, end = skeleton.nodes[up], skeleton.nodes[node]
        length = float(np.linalg.norm(end - start))
        rows.append((node - 1, up - 1, *start, *end, *((end - start) / max(length, 1e-300)),
                     skeleton.radius[node], length, skeleton.branch[node], skeleton.order[node]))
    write_table(path, titles, rows)
