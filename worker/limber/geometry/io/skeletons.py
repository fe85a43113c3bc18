"""Skeletons of other programs and the registry of their formats; SWC, cylinder models as CSV."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from limber.core.constants import UNIT_METRES
from limber.core.errors import InputError
from limber.core.files.reading import csv_records, read_text
from limber.geometry.io.cylinder_models import (
    read_treeqsm,
    write_rtwig,
    write_simpleforest,
    write_treeqsm,
)
from limber.geometry.io.formats import Format, Registry, head_of
from limber.geometry.io.mtg import read_mtg, write_mtg
from limber.geometry.skeleton.skeleton import STATES, Skeleton

_ALIASES = {"id": "id", "parentid": "parent", "radius": "radius", **{
    f"{end}{axis}": f"{end[0]}{axis}" for end in ("start", "end") for axis in "xyz"}}
"""Names of columns in rTwig and SimpleForest, in lower case and without underscores."""
_HEAD = 4096  # bytes searched for the format


def read_skeleton(path: Path, *, scale: float | None = None) -> Skeleton:
    """Read a skeleton of any format of :data:`SKELETONS`.

    Args:
        path: The file.
        scale: Metres per unit; None uses the file's own, or metres.

    Raises:
        InputError: its format is not known, or it is not a tree; see the formats' readers.
    """
    return SKELETONS.read(Path(path), scale=scale)


def read_swc(path: Path, *, scale: float | None = None) -> Skeleton:
    """Read an SWC file.

    Args:
        path: The file.
        scale: Metres per unit; None uses the header's ``# unit:``, or metres.

    Raises:
        InputError: not an SWC tree; see :meth:`Skeleton.from_edges`.
    """
    rows, header_scale = [], 1.0
    for number, line in enumerate(read_text(path, "a skeleton (SWC)").splitlines(), start=1):
        if line.startswith("#"):
            header_scale = _header_unit(line, header_scale)
            continue
        if not line.strip():
            continue
        try:
            rows.append(_swc_node(line))
        except (ValueError, IndexError, OverflowError) as error:
            raise InputError(f"{path}, line {number}: {line.strip()[:60]!r} is not a node.",
                             "An SWC line has the fields: id type x y z radius parent.",
                             "Correct that line.") from error
    if not rows:
        raise InputError(f"{path} has no nodes.", "The file is empty, or is not an SWC file.",
                         "Choose another file.")
    table = np.array(rows, float)
    _require_whole(path, table[:, [0, 5]])
    parent = _parents(path, table[:, 0].astype(np.int64), table[:, 5].astype(np.int64))
    factor = header_scale if scale is None else scale
    return Skeleton.from_edges(table[:, 1:4] * factor, parent, table[:, 4] * factor)


def _swc_node(line: str) -> list[float]:
    parts = line.replace(",", " ").split()
    return [int(float(parts[0])), *map(float, parts[2:6]), int(float(parts[6]))]


def _first_line(path: Path) -> str:
    """The first line that is not a comment, within the part searched for the format."""
    lines = head_of(path, _HEAD).decode("utf-8", "replace").splitlines()
    return next((line for line in lines if line.strip() and not line.startswith("#")), "")


def _is_swc(path: Path) -> bool:
    try:
        return bool(_swc_node(_first_line(path)))
    except (ValueError, IndexError, OverflowError):
        return False


def _is_cylinders(path: Path) -> bool:
    return "radius" in [title.strip().lower() for title in _first_line(path).split(",")]


def read_cylinders(path: Path, *, scale: float | None = None) -> Skeleton:
    """Read a cylinder model: columns id, parent, sx, sy, sz, ex, ey, ez, radius (any order).

    A cylinder's end becomes a node attached to the end of its parent; the root's start becomes the
    root node. The additions of :func:`write_cylinders` (deviations, states, probabilities) are read
    if present. The names of rTwig and SimpleForest are known, too.

    Args:
        path: The CSV file.
        scale: Metres per unit; None means metres.

    Raises:
        InputError: columns are missing, a value is not a number, or it is not one tree.
    """
    rows = [{_ALIASES.get(name.strip().lower().replace("_", ""), name.strip()): value
             for name, value in row.items() if name is not None}
            for row in csv_records(path, "a cylinder model")]
    names = ("id", "parent", "sx", "sy", "sz", "ex", "ey", "ez", "radius")
    missing = [name for name in names if not rows or name not in rows[0]]
    if missing:
        raise InputError(f"{path} lacks the columns {', '.join(missing)}.",
                         f"A cylinder model has the columns {', '.join(names)}.",
                         "Rename the columns of your export.")
    return _tree_of(path, _numbers(path, rows, names), scale, rows)


def _of_arrays(path: Path, read: dict[str, np.ndarray], *, scale: float | None = None) -> Skeleton:
    table = np.column_stack([read[name] for name in ("id", "parent", "start", "end", "radius")])
    return _tree_of(path, table, scale, start_radius=read.get("start_radius"))


def _read_mat(path: Path, *, scale: float | None = None) -> Skeleton:
    return _of_arrays(path, read_treeqsm(path), scale=scale)


def _tree_of(path: Path, table: np.ndarray, scale: float | None,
             rows: Sequence[dict[str, str]] = (), *,
             start_radius: np.ndarray | None = None) -> Skeleton:
    """The skeleton of cylinders: id, parent, start, end and radius, shape [n, 9]."""
    scale = 1.0 if scale is None else scale
    _require_whole(path, table[:, :2])
    ids, up = table[:, 0].astype(np.int64), table[:, 1].astype(np.int64)
    # Some programs count from 1 and give the root the parent 0.
    parent = _parents(path, ids, np.where((up == 0) & ~(ids == 0).any(), -1, up))
    roots = np.flatnonzero(parent < 0)
    # Several may grow from the ground of the first one.
    first_start = table[roots[:1], 2:5]
    if not len(roots) or not (np.abs(table[roots, 2:5] - first_start) < 1e-9).all():
        raise InputError(f"{path} has {len(roots)} cylinders without a parent.",
                         "A branch has exactly one root.", "Keep only one tree in the file.")
    root = roots[0]
    nodes = np.vstack([table[root, 2:5], table[:, 5:8]]) * scale
    if rows and rows[root].get("start_radius"):
        first = _numbers(path, rows[root:root + 1], ["start_radius"])[0, 0]
    else:
        first = (table[:, 8] if start_radius is None else start_radius)[root]
    radius = np.concatenate([[first], table[:, 8]]) * scale
    hang = np.concatenate([[-1], np.where(parent < 0, 0, parent + 1)])
    fitted = _fitted_columns(path, rows, scale) if rows else {}
    hang, keep = _without_repeats(nodes, hang)
    return Skeleton.from_edges(nodes[keep], hang, radius[keep], **{
        name: np.concatenate([values[root:root + 1], values])[keep]
        for name, values in fitted.items()})


def write_cylinders(skeleton: Skeleton, path: Path) -> None:
    """Write one cylinder for each node but the root, as CSV in the skeleton's unit.

    Columns: id, parent, start and end points, radius, length, axis, branch, order, the radius's
    standard deviation, its state (0 measured, 1 limited, 2 interpolated, 3 unresolved, 4 bridged),
    the probability that the node exists, and the radius at the start.
    """
    start, end = skeleton.nodes[skeleton.parent[1:]], skeleton.nodes[1:]
    length = np.linalg.norm(end - start, axis=1)
    axis = (end - start) / np.maximum(length, 1e-300)[:, None]
    with open(path, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow("id parent sx sy sz ex ey ez radius length ax ay az branch order "
                        "radius_sigma radius_state probability start_radius".split())
        for i in range(len(end)):
            node = i + 1
            numbers = [*start[i], *end[i], skeleton.radius[node], length[i], *axis[i]]
            up = skeleton.parent[node] - 1
            writer.writerow([i, up, *(f"{v:.15g}" for v in numbers), skeleton.branch[node],
                             skeleton.order[node], f"{skeleton.radius_sigma[node]:.3g}",
                             skeleton.radius_state[node],
                             f"{skeleton.probability[node]:.3f}",
                             f"{skeleton.radius[skeleton.parent[node]]:.12g}"])


def _require_whole(path: Path, numbers: np.ndarray) -> None:
    if not (np.abs(numbers) < 2**53).all():
        raise InputError(f"{path} has an id or a parent that is not a whole number.",
                         "The ids of nodes are whole numbers.", "Correct the file.")


def _numbers(path: Path, rows: Sequence[dict[str, str]], names: Sequence[str]) -> np.ndarray:
    """Columns of a table, shape [n, names]."""
    try:
        return np.array([[float(row[name]) for name in names] for row in rows])
    except (TypeError, ValueError) as error:
        raise InputError(f"{path} has a field that is not a number ({error}).",
                         f"{', '.join(names)} are numbers.", "Correct the file.") from error


def _fitted_columns(path: Path, rows: Sequence[dict[str, str]], scale: float,
                    ) -> dict[str, np.ndarray]:
    names = ("radius_sigma", "radius_state", "probability")
    if any(name not in rows[0] for name in names):
        return {}
    sigma, state, probability = np.ascontiguousarray(_numbers(path, rows, names).T)
    if not (((sigma >= 0) & np.isfinite(sigma)).all()
            and np.isin(state, list(STATES.values())).all()
            and ((probability >= 0) & (probability <= 1)).all()):
        raise InputError(f"{path} has a deviation, state or probability outside its range.",
                         f"Deviations must not be negative, states must be {min(STATES.values())} "
                         f"to {max(STATES.values())}, and probabilities 0 to 1.",
                         "Correct the file.")
    return {"radius_sigma": sigma * scale, "radius_state": state.astype(np.int8),
            "probability": probability}


def _header_unit(line: str, scale: float) -> float:
    words = line.lstrip("# ").replace("=", ":").split(":")
    if len(words) == 2 and words[0].strip().lower() in ("unit", "units"):
        return UNIT_METRES.get(words[1].strip(), scale)
    return scale


def _parents(path: Path, ids: np.ndarray, parent_ids: np.ndarray) -> np.ndarray:
    unique, counts = np.unique(ids, return_counts=True)
    if (counts > 1).any():
        raise InputError(f"{path} has id {unique[counts > 1][0]} more than once.",
                         "Each node needs its own id.", "Correct the file.")
    where = {int(node): i for i, node in enumerate(ids)}
    lost = [int(p) for p in parent_ids if p >= 0 and int(p) not in where]
    if lost:
        raise InputError(f"{path}: parent {lost[0]} does not exist in the file.",
                         "Each node except the root must have another node as its parent.",
                         "Correct the file.")
    return np.array([where[int(p)] if p >= 0 else -1 for p in parent_ids], np.int64)


def _without_repeats(nodes: np.ndarray, parent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge a node with its parent where both have the same position: new parents, nodes kept."""
    step = np.linalg.norm(nodes - nodes[parent], axis=1)
    repeated = (parent >= 0) & (step < 1e-9)
    target = np.arange(len(nodes))
    for _ in range(len(nodes)):
        following = np.where(repeated[target], parent[target], target)
        if (following == target).all():
            break
        target = following
    keep = ~repeated
    new_index = np.cumsum(keep) - 1
    moved = np.where(parent < 0, -1, new_index[target[parent]])
    return moved[keep], keep


SKELETONS = Registry("skeleton", "limber.skeletons", [
    Format("SWC", (".swc",), read_swc, Skeleton.write_swc, recognises=_is_swc,
           about="axes with radii"),
    Format("cylinders", (".csv",), read_cylinders, write_cylinders, recognises=_is_cylinders,
           about="cylinders of Limber, rTwig or SimpleForest"),
    Format("rtwig", (".csv",), write=write_rtwig),
    Format("simpleforest", (".csv",), write=write_simpleforest),
    Format("TreeQSM", (".mat",), _read_mat, write_treeqsm,
           about="cylinders of TreeQSM or SmartQSM"),
    Format("MTG", (".mtg",), read_mtg, write_mtg, about="multiscale tree graph of the axes"),
], of_arrays=_of_arrays)
"""Readers take ``scale``, the metres per unit or None; their results are in metres. Arrays that a
format reads are cylinders: ``id``, ``parent`` (-1: none), ``start``, ``end`` and ``radius``.
"""
