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

from collections.abc import Iterable, Iterator
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
_MOST_TEXT, _MOST_MODELS = 200, 1000
Model = tuple[dict[str, Any], str, float]
"""Fields of its cylinders, its creator, mean distance of the cloud's points from it (or NaN)."""


def is_hdf5(path: Path) -> bool:
    """Whether a file is HDF5, with Matlab's header or without; OSError if it cannot be read."""
    with open(path, "rb") as stream:
        head = stream.read(_STARTS[-1] + len(_SIGNATURE))
    return any(head[at:at + len(_SIGNATURE)] == _SIGNATURE for at in _STARTS)


def mat_v73_models(path: Path) -> Iterator[Model]:
    """Yield the models of a MAT file of version 7.3. A damaged file raises OSError, ValueError,
    KeyError or RuntimeError."""
    import h5py

    most = max(LARGEST_EXPANSION * path.stat().st_size, HARMLESS_BYTES)
    with h5py.File(path, "r") as file:
        for name in file:
            for outer in _structs(file, _own(file, name)):
                texts = _structs(file, _own(outer, "rundata"))
                for k, found in enumerate([outer, *_structs(file, _own(outer, "cylinder"))]):
                    if not all(field in found for field in TREEQSM_FIELDS):
                        continue
                    creator = _text(_own(texts[min(k, len(texts)) - 1], "creator")
                                    ) if texts else ""
                    near = _structs(file, _own(outer, "pmdistance"))
                    off = _own(near[min(k, len(near)) - 1], "mean") if near else None
                    yield {field: _numbers(_own(found, field), most)
                           for field in (*TREEQSM_FIELDS, _THICK) if field in found}, creator, (
                        float("nan") if off is None else float(_numbers(off, most).ravel()[0]))


def _own(group: Any, name: str) -> Any:
    """The group's own entry of this name: no link to elsewhere is followed."""
    import h5py

    if not isinstance(group, h5py.Group) or name not in group or not isinstance(
            group.get(name, getlink=True), h5py.HardLink):
        return None
    return group[name]


def _structs(file: Any, found: Any) -> list[Any]:
    """A struct, or all those of an array of structs or a cell array."""
    import h5py

    if isinstance(found, h5py.Dataset) and h5py.check_ref_dtype(found.dtype) is h5py.Reference:
        several = [file[each] for each in np.ravel(found[()])[:_MOST_MODELS] if each]
    else:
        several = [found]
    return [each for each in several if isinstance(each, h5py.Group)]


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
    a ``.mat`` file's model, of several the one nearest to its points (else the first), and
    ``notes`` that list them. MissingDependencyError for version 7.3 without h5py."""
    found = _fields(Path(path))
    if not found:
        raise InputError(f"{path} has no struct with the fields {', '.join(TREEQSM_FIELDS)}.",
                         "A TreeQSM model was expected.", "Save the QSM itself from TreeQSM.")
    notes = [f"{Path(path).name} has {len(found['models'])} models: "
             f"{'; '.join(found['models'])}. Number {found['taken']} was taken. For another, "
             "save it alone in Matlab."] if len(found["models"]) > 1 else []
    radius, length, parent = (np.asarray(found[name], float).ravel()
                              for name in ("radius", "length", "parent"))
    start, axis = (np.atleast_2d(np.asarray(found[name], float)) for name in ("start", "axis"))
    count = len(radius)
    if not (len(length) == len(parent) == count and start.shape == axis.shape == (count, 3)):
        raise ValueError("the fields of its cylinders have different lengths")
    return {"id": np.arange(1.0, count + 1), "parent": np.where(parent > 0, parent, -1.0),
            "start": start, "end": start + axis * length[:, None], "radius": radius,
            "start_radius": _thick_ends(found, radius), "notes": np.array(notes)}


def _fields(path: Path) -> dict[str, Any]:
    """The fields of the cylinders and ``creator``; empty if there are no cylinders."""
    if is_hdf5(path):
        require_extra("matlab", ("h5py",),
                      f"The MAT file {path} of version 7.3 (saving it in Matlab with -v7 avoids "
                      "this)")
        return read_apart(mat_v73_fields, path)
    return read_apart(mat_fields, path)


def mat_v73_fields(path: Path) -> dict[str, np.ndarray]:
    """Return what :func:`mat_fields` does of a MAT file of version 7.3."""
    return _best_of(mat_v73_models(path))


def mat_fields(path: Path) -> dict[str, np.ndarray]:
    """Return the fields of the cylinders, ``creator``, ``models`` (texts on all of the file) and
    ``taken``, the number of the one, of a MAT file of an older version; empty without cylinders.
    scipy's compiled reader can crash on a damaged file."""
    from scipy.io import loadmat

    content = loadmat(path, squeeze_me=True, struct_as_record=False)
    return _best_of(_models_of(content))


def _models_of(content: dict[str, Any]) -> Iterator[Model]:
    for value in content.values():
        several = value.ravel() if isinstance(value, np.ndarray) and value.dtype == object else [
            value]
        for each in several[:_MOST_MODELS]:
            for found in (each, getattr(each, "cylinder", None)):
                if found is not None and all(hasattr(found, name) for name in TREEQSM_FIELDS):
                    off = getattr(getattr(each, "pmdistance", None), "mean", np.nan)
                    yield {name: np.asarray(getattr(found, name))
                           for name in (*TREEQSM_FIELDS, _THICK) if hasattr(found, name)}, str(
                        getattr(getattr(each, "rundata", None), "creator", "")), (
                        float(off) if np.size(off) == 1 else np.nan)
                    break


def _best_of(models: Iterable[Model]) -> dict[str, np.ndarray]:
    """The model nearest to its points, and what there is of others."""
    known = list(models)
    for fields, _, _ in known:
        for name, values in fields.items():
            if values.dtype.kind == "O":
                raise ValueError(f"{name} has values that are no numbers")
    if not known:
        return {}
    off = [distance if np.isfinite(distance) else np.inf for *_, distance in known]
    best = int(np.argmin(off))
    fields, creator, _ = known[best]
    about = [f"{k}: {np.size(each['radius'])} cylinders"
             + (f", {1e3 * distance:.3g} mm from its points" if np.isfinite(distance) else "")
             for k, (each, _, distance) in enumerate(known, 1)]
    return fields | {"creator": np.asarray(creator), "models": np.array(about),
                     "taken": np.array(best + 1)}


def _thick_ends(found: dict[str, Any], radius: np.ndarray) -> np.ndarray:
    """SmartQSM stores a cone's other radius where TreeQSM has the radius before its corrections."""
    try:
        thick = np.asarray(found.get(_THICK, ()), float).ravel()
    except (TypeError, ValueError):
        return radius
    fits = str(found["creator"]) == "SmartQSM" and thick.shape == radius.shape
    return thick if fits and (np.isfinite(thick) & (thick > 0)).all() else radius


def _columns_of(skeleton: Skeleton) -> dict[str, np.ndarray]:
    """The cylinder below each node but the root: its place, length, axis, radius and branch."""
    up, node = skeleton.parent[1:], np.arange(1, skeleton.node_count)
    start, end = skeleton.nodes[up], skeleton.nodes[1:]
    length = np.linalg.norm(end - start, axis=1)
    return {"node": node, "up": up, "start": start, "end": end, "length": length,
            "axis": (end - start) / np.maximum(length, 1e-300)[:, None],
            "radius": skeleton.radius[1:], "branch": skeleton.branch[1:],
            "order": skeleton.order[1:]}


def _write(path: Path, titles: str, *columns: np.ndarray, **options: Any) -> None:
    """Write a table with these columns, each [n] or [n, 3]."""
    parts = (list(part) for column in columns for part in np.atleast_2d(column.T))
    write_table(path, titles.split(), zip(*parts, strict=True), **options)


def write_treeqsm(skeleton: Skeleton, path: Path) -> None:
    """Write a TreeQSM ``.mat`` file in metres: a struct ``QSM`` with ``cylinder``."""
    from scipy.io import savemat

    found = _columns_of(skeleton)
    extension, position = np.zeros(len(found["up"])), np.ones(len(found["up"]))
    for node, up in zip(found["node"][1:], found["up"][1:], strict=True):
        if up > 0 and skeleton.branch[up] == skeleton.branch[node]:
            extension[up - 1], position[node - 1] = node, position[up - 1] + 1
    column = {name: np.asarray(values, float)[:, None] for name, values in {
        "radius": found["radius"], "length": found["length"], "parent": found["up"],
        "extension": extension, "branch": found["branch"] + 1, "BranchOrder": found["order"],
        "PositionInBranch": position, "added": np.zeros(len(position))}.items()}
    savemat(path, {"QSM": {"cylinder": column | {key: found[key] for key in ("start", "axis")}}},
            do_compression=True)


def write_cylinders(skeleton: Skeleton, path: Path) -> None:
    """Write one cylinder for each node but the root, as CSV in the skeleton's unit. The state of a
    radius is 0 measured, 1 limited, 2 interpolated, 3 unresolved or 4 bridged."""
    c, later = _columns_of(skeleton), slice(1, None)
    _write(path, "id parent sx sy sz ex ey ez radius length ax ay az branch order radius_sigma "
           "radius_state probability start_radius", c["node"] - 1, c["up"] - 1, c["start"],
           c["end"], c["radius"], c["length"], c["axis"], c["branch"], c["order"],
           *(np.array([f"{value:{form}}" for value in values]) for values, form in (
               (skeleton.radius_sigma[later], ".3g"), (skeleton.radius_state[later], "d"),
               (skeleton.probability[later], ".3f"), (skeleton.radius[c["up"]], ".12g"))),
           digits=15, line_end="\r\n")


def write_rtwig(skeleton: Skeleton, path: Path) -> None:
    """Write rTwig's minimal table [m]: what its ``reconstruct_qsm`` needs, with branch and order.
    """
    c = _columns_of(skeleton)
    _write(path, "id parent start_x start_y start_z end_x end_y end_z radius branch branch_order",
           c["node"], c["up"], c["start"], c["end"], c["radius"], c["branch"] + 1, c["order"])


def write_simpleforest(skeleton: Skeleton, path: Path) -> None:
    """Write a table with SimpleForest's names [m]."""
    c = _columns_of(skeleton)
    _write(path, "ID parentID startX startY startZ endX endY endZ axisX axisY axisZ radius length "
           "branchID branchOrder", c["node"] - 1, c["up"] - 1, c["start"], c["end"], c["axis"],
           c["radius"], c["length"], c["branch"], c["order"])
