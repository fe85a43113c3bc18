"""Cylinder models (QSM) of other programs: TreeQSM, SmartQSM, SimpleForest, rTwig.

======================  ===========================================================================
``.mat``                TreeQSM: a struct ``QSM`` with ``cylinder`` (radius, length, start, axis,
                        parent, extension, branch, BranchOrder, PositionInBranch, added).
                        SmartQSM writes the same struct; its radius is that of a cone's thin end,
                        UnmodRadius that of the thick one (its ``parameterize_and_export``).
                        Version 7.3 by :mod:`limber.geometry.io.matlab`
``.csv``                rTwig's minimum: id, parent, start_x ... end_z, radius; SimpleForest: ID,
                        parentID, startX ... endZ, radius
======================  ===========================================================================
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.core.files.atomic import write_lines
from limber.core.optional import require_extra
from limber.geometry.io.isolated_readers import read_apart
from limber.geometry.io.matlab import is_hdf5, struct_arrays
from limber.geometry.skeleton.skeleton import Skeleton

TREEQSM_FIELDS = ("radius", "start", "axis", "length", "parent")
_THICK = "UnmodRadius"


def read_treeqsm(path: Path) -> dict[str, np.ndarray]:
    """Return the cylinders of a ``.mat`` file of TreeQSM or SmartQSM.

    If a file has several models, the first is read. Cylinders without a parent that start at the
    start of the first one are attached there.

    Returns:
        Arrays ``id``, ``parent`` (-1: none), ``start``, ``end``, ``radius`` and ``start_radius``,
        which equals ``radius`` if the file does not state it.

    Raises:
        InputError: the file cannot be read, or has no cylinders.
        MissingDependencyError: the file is of version 7.3, and h5py is not installed.
    """
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
    """Return the fields of the cylinders and ``creator`` of a MAT file of an older version.

    Empty without cylinders. scipy's compiled reader can crash on a damaged file.
    """
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
    lines = ["id,parent,start_x,start_y,start_z,end_x,end_y,end_z,radius,branch,branch_order"]
    for node in range(1, skeleton.node_count):
        up = int(skeleton.parent[node])
        numbers = (*skeleton.nodes[up], *skeleton.nodes[node], skeleton.radius[node])
        lines.append(_row(node, up, numbers, skeleton.branch[node] + 1, skeleton.order[node]))
    write_lines(path, lines)


def write_simpleforest(skeleton: Skeleton, path: Path) -> None:
    """Write a table with SimpleForest's names [m]."""
    lines = ["ID,parentID,startX,startY,startZ,endX,endY,endZ,axisX,axisY,axisZ,radius,length,"
             "branchID,branchOrder"]
    for node in range(1, skeleton.node_count):
        up = int(skeleton.parent[node])
        start, end = skeleton.nodes[up], skeleton.nodes[node]
        length = float(np.linalg.norm(end - start))
        numbers = (*start, *end, *((end - start) / max(length, 1e-300)), skeleton.radius[node],
                   length)
        lines.append(_row(node - 1, up - 1, numbers, skeleton.branch[node], skeleton.order[node]))
    write_lines(path, lines)


def _row(number: int, parent: int, numbers: Iterable[float], branch: int, order: int) -> str:
    cells = (number, parent, *(f"{value:.9g}" for value in numbers), branch, order)
    return ",".join(map(str, cells))
