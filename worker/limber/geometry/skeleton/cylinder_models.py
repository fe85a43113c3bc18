"""Cylinder models (QSM) of other programs, in and out: TreeQSM, SimpleForest, rTwig, MTG.

======================  ===========================================================================
``.mat``                TreeQSM: a struct ``QSM`` with ``cylinder`` (radius, length, start, axis,
                        parent, extension, branch, BranchOrder, PositionInBranch, added)
``.csv``                rTwig's minimum: id, parent, start_x ... end_z, radius; SimpleForest: ID,
                        parentID, startX ... endZ, radius
``.mtg``                MTG text: axes and nodes with XX, YY, ZZ and Radius
======================  ===========================================================================
"""

from pathlib import Path
from typing import Any

import numpy as np

from limber.errors import InputError
from limber.geometry.skeleton.skeleton import Skeleton

TREEQSM_FIELDS = ("radius", "start", "axis", "length", "parent")


def read_treeqsm(path: Path) -> dict[str, np.ndarray]:
    """Return the cylinders of a TreeQSM ``.mat`` file: ids, parents (-1: none), ends and radii.

    Of several models in a file the first counts.

    Raises:
        InputError: it cannot be read (v7.3 files are HDF5 and not read), or has no cylinders.
    """
    from scipy.io import loadmat

    try:
        content = loadmat(path, squeeze_me=True, struct_as_record=False)
    except NotImplementedError as error:
        raise InputError(f"{path} is a MAT file of version 7.3.", "It is HDF5, which is not read.",
                         "Save it in Matlab with -v7.") from error
    except MemoryError:
        raise
    except Exception as error:  # scipy's reader raises whatever its parser raises
        raise InputError(f"{path} cannot be read as a MAT file ({error}).",
                         "A TreeQSM model was expected.", "Save it again.") from error
    cylinder = _cylinder_struct(content)
    if cylinder is None:
        raise InputError(f"{path} has no struct with {', '.join(TREEQSM_FIELDS)}.",
                         "A TreeQSM model was expected.", "Save the QSM of TreeQSM itself.")
    try:
        radius, length, parent = (np.atleast_1d(np.asarray(getattr(cylinder, name), float)).ravel()
                                  for name in ("radius", "length", "parent"))
        start, axis = (np.atleast_2d(np.asarray(getattr(cylinder, name), float))
                       for name in ("start", "axis"))
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: {error}.", "A cylinder's fields are numbers.",
                         "Save it again.") from error
    count = len(radius)
    if not (len(length) == len(parent) == count and start.shape == axis.shape == (count, 3)):
        raise InputError(f"{path} has fields of unequal length.", "Each cylinder has all of them.",
                         "Save it again.")
    return {"id": np.arange(1.0, count + 1), "parent": np.where(parent > 0, parent, -1.0),
            "start": start, "end": start + axis * length[:, None], "radius": radius}


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


def rtwig_text(skeleton: Skeleton) -> str:
    """Return rTwig's minimal table [m]: what its ``reconstruct_qsm`` needs, with branch and order.
    """
    lines = ["id,parent,start_x,start_y,start_z,end_x,end_y,end_z,radius,branch,branch_order"]
    for node in range(1, skeleton.node_count):
        up = int(skeleton.parent[node])
        ends = (*skeleton.nodes[up], *skeleton.nodes[node])
        lines.append(",".join([str(node), str(up), *(f"{value:.9g}" for value in ends),
                               f"{skeleton.radius[node]:.9g}", str(skeleton.branch[node] + 1),
                               str(skeleton.order[node])]))
    return "\n".join(lines) + "\n"


def simpleforest_text(skeleton: Skeleton) -> str:
    """Return a table with SimpleForest's names [m]."""
    head = ("ID,parentID,startX,startY,startZ,endX,endY,endZ,axisX,axisY,axisZ,radius,length,"
            "branchID,branchOrder")
    lines = [head]
    for node in range(1, skeleton.node_count):
        up = int(skeleton.parent[node])
        start, end = skeleton.nodes[up], skeleton.nodes[node]
        length = float(np.linalg.norm(end - start))
        numbers = (*start, *end, *((end - start) / max(length, 1e-300)),
                   skeleton.radius[node], length)
        lines.append(",".join([str(node - 1), str(up - 1), *(f"{v:.9g}" for v in numbers),
                               str(skeleton.branch[node]), str(skeleton.order[node])]))
    return "\n".join(lines) + "\n"


def mtg_text(skeleton: Skeleton) -> str:
    """Return an MTG: a plant of axes of nodes, with places and radii [m].

    An axis hangs with ``+`` on the node that it grows from; nodes follow each other with ``<``.
    """
    depth = int(skeleton.order.max()) + 1
    tabs = "\t" * (depth + 1)
    lines = ["CODE:\tFORM-A", "", "CLASSES:",
             "SYMBOL\tSCALE\tDECOMPOSITION\tINDEXATION\tDEFINITION",
             "$\t0\tFREE\tFREE\tIMPLICIT", "P\t1\tFREE\tFREE\tIMPLICIT",
             "N\t2\tFREE\tFREE\tIMPLICIT", "", "DESCRIPTION:", "LEFT\tRIGHT\tRELTYPE\tMAX",
             "N\tN\t+\t?", "N\tN\t<\t?", "", "FEATURES:", "NAME\tTYPE", "XX\tREAL", "YY\tREAL",
             "ZZ\tREAL", "Radius\tREAL", "", "MTG:",
             f"ENTITY-CODE{tabs}XX\tYY\tZZ\tRadius", f"/P1{tabs}", ""]
    lines.pop()
    children: dict[int, list[int]] = {}
    for node in range(1, skeleton.node_count):
        children.setdefault(int(skeleton.parent[node]), []).append(node)
    waiting = [0]
    while waiting:
        node = waiting.pop()
        up, column = int(skeleton.parent[node]), int(skeleton.order[node])
        same = up < 0 or skeleton.branch[up] == skeleton.branch[node]
        sign = "^/" if up < 0 else ("^<" if same else "+")
        values = "\t".join(f"{value:.9g}" for value in (*skeleton.nodes[node],
                                                        skeleton.radius[node]))
        lines.append("\t" * column + f"{sign}N{node + 1}" + "\t" * (depth + 1 - column) + values)
        # Side axes are told before the axis goes on: "^" means the last node of that column.
        after = children.get(node, [])
        on = [one for one in after if skeleton.branch[one] == skeleton.branch[node]]
        waiting += on + [one for one in after if one not in on]
    return "\n".join(lines) + "\n"
