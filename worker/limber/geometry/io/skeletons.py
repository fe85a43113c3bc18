"""Skeletons of other programs and the registry of their formats; SWC, cylinder models as CSV."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from limber.core.constants import UNIT_METRES
from limber.core.errors import InputError, Option
from limber.core.files.atomic import write_lines
from limber.core.files.reading import read_text, require_finite
from limber.core.files.text_columns import coding_of, fields_of, lines_of, plain, separator_of
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.geometry.io import cylinder_models
from limber.geometry.io.cylinder_models import write_cylinders
from limber.geometry.io.formats import Format, Registry, head_of
from limber.geometry.skeleton.skeleton import STATES, Skeleton

# Reader and writer of multiscale tree graphs (MTG), as in OpenAlea's text files.
#
# A file has sections; the last one, ``MTG:``, has one line per vertex. The column in which its code
# begins states what it refers to: the last vertex of the column before, or, after ``^``, the last
# one of its own column. The code is a chain of signs and labels: ``/`` a part of the preceding
# vertex, ``<`` its successor, ``+`` a side branch. Vertices of any scale with XX, YY and ZZ become
# nodes.
#
# Source: C. Pradal, C. Godin, *MTG user guide* (OpenAlea), and its example files.

Place = Sequence[float] | None
_SECTIONS = ("CODE", "CLASSES", "DESCRIPTION", "FEATURES", "MTG")
_TOKEN = re.compile(r"(/|<<|\+\+|<|\+)?([A-Za-z$]+)(\d*)")
_PLACE = (("XX", "YY", "ZZ"), ("X", "Y", "Z"))
_RADII = {"radius": 1.0, "r": 1.0, "diameter": 0.5, "diam": 0.5, "dia": 0.5}
_WHAT = "a multiscale tree graph"


@dataclass
class _Vertex:
    """A vertex during reading: the node that a part of it attaches to, and where it continues."""

    scale: int
    whole: "_Vertex | None"
    anchor: int
    tail: int = field(default=-1)


def read_mtg(path: Path, *, scale: float | None = None, near: Place = None) -> Skeleton:
    """Read an MTG; nodes without radius or diameter have that of the node before. ``scale`` is
    metres per unit (None: 1). InputError if it is not one tree with positions and radii."""
    lines = list(lines_of(path, coding_of(path)))
    scales, body = _sections(lines)
    reader = _Reader(path, scales, *_header(path, body))
    for number, line in body[1:]:
        try:
            reader.take(line)
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from error
    return reader.skeleton(1.0 if scale is None else scale, near)


def _sections(lines: list[str]) -> tuple[dict[str, int], list[tuple[int, str]]]:
    """The scale of each class, and the lines of the graph with their numbers."""
    found: dict[str, list[tuple[int, str]]] = {}
    current: list[tuple[int, str]] | None = None
    for number, line in enumerate(lines, start=1):
        name, colon, _ = line.strip().partition(":")
        if colon and name.strip() in _SECTIONS and "MTG" not in found:
            current = found.setdefault(name.strip(), [])
        elif current is not None and line.strip() and not line.lstrip().startswith("#"):
            current.append((number, line))
    missing = [name for name in ("CLASSES", "MTG") if not found.get(name)]
    if missing:
        raise ValueError(f"it has no section {' and '.join(missing)}")
    scales = {}
    for number, line in found["CLASSES"][1:]:
        words = line.split()
        if len(words) < 2 or not words[1].isdigit():
            raise ValueError(f"line {number} is no class with its scale: {line.strip()[:60]!r}")
        scales[words[0]] = int(words[1])
    return scales, found["MTG"]


def _header(path: Path, body: list[tuple[int, str]]) -> tuple[int, dict[str, int]]:
    """Number of columns for codes, and the column of each feature."""
    cells = [cell.strip() for cell in body[0][1].split("\t")]
    features = {name: column for column, name in enumerate(cells) if name and column > 0}
    columns = next((names for names in _PLACE if all(name in features for name in names)), None)
    if columns is None:
        raise InputError(f"{path} has no columns XX, YY and ZZ.",
                         "Limber needs the positions of the vertices of an MTG.",
                         "Add these columns. The file has: "
                         f"{', '.join(features) or 'no features'}.")
    radius = next((name for name in features if name.lower() in _RADII), None)
    if radius is None:
        raise InputError(f"{path} has no column Radius or Diameter.",
                         "Limber needs the thickness of the branch at its vertices.",
                         f"Add one of these columns. The file has: {', '.join(features)}.")
    used = dict(zip(("x", "y", "z"), (features[name] for name in columns), strict=True))
    return min(features.values()), used | {radius.lower(): features[radius]}


class _Reader:
    """Reads line by line."""

    def __init__(self, path: Path, scales: dict[str, int], columns: int, features: dict[str, int]):
        self.path, self.scales, self.columns, self.features = path, scales, columns, features
        self.radius_column = next(name for name in features if name in _RADII)
        self.last: dict[int, _Vertex] = {}
        self.nodes: list[tuple[float, ...]] = []
        self.parent: list[int] = []
        self.radius: list[float] = []

    def take(self, line: str) -> None:
        cells = line.split("\t")
        codes = [(column, cell.strip()) for column, cell in enumerate(cells[:self.columns])
                 if cell.strip()]
        if not codes:
            return
        values = self.values(cells)
        vertex: _Vertex | None = None
        for index, (column, code) in enumerate(codes):
            if vertex is None:
                stays = code.startswith("^")
                vertex = self.last.get(column if stays else column - 1)
                if vertex is None and (stays or column > 0):
                    raise ValueError(f"{code!r} refers to a vertex that does not exist")
            vertex = self.chain(code.removeprefix("^"), vertex,
                                values if index == len(codes) - 1 else None)
            self.last = {at: one for at, one in self.last.items() if at < column}
            self.last[column] = vertex

    def chain(self, code: str, vertex: _Vertex | None,
              values: tuple[float, ...] | None) -> _Vertex:
        """Follow a code; its last vertex has the values of the line."""
        at = 0
        while at < len(code):
            token = _TOKEN.match(code, at)
            if token is None or (token.group(1) is None and vertex is not None):
                raise ValueError(f"{code!r} does not consist of /, < or + and labels")
            at = token.end()
            if token.group(2) not in self.scales:
                raise ValueError(f"the file has no class {token.group(2)}")
            vertex = self.vertex((token.group(1) or "/")[0], self.scales[token.group(2)], vertex,
                                 values if at == len(code) else None)
        if vertex is None:
            raise ValueError(f"{code!r} does not name a vertex")
        return vertex

    def vertex(self, sign: str, scale: int, before: _Vertex | None,
               values: tuple[float, ...] | None) -> _Vertex:
        anchor, whole = -1, None
        if before is not None:
            anchor, whole = before.anchor, before
            if sign != "/":
                # A vertex that follows a whole grows from the end of the whole's parts.
                anchor = before.tail if before.scale == scale and before.tail >= 0 else anchor
                while whole is not None and whole.scale >= scale:
                    whole = whole.whole
            elif before.scale >= scale:
                raise ValueError("a part must have a finer scale than its whole")
        found = _Vertex(scale, whole, anchor)
        if values is not None:
            found.anchor = self.node(anchor, values)
            while whole is not None and sign != "+":
                whole.tail, whole = found.anchor, whole.whole
        return found

    def node(self, parent: int, values: tuple[float, ...]) -> int:
        *position, radius = values
        if np.isnan(radius):
            if parent < 0:
                raise ValueError("the first vertex with a position has no radius")
            radius = self.radius[parent]
        self.nodes.append(tuple(position))
        self.parent.append(parent)
        self.radius.append(radius)
        return len(self.nodes) - 1

    def values(self, cells: list[str]) -> tuple[float, ...] | None:
        """Position and radius of a line (nan if it has no radius); None without a position."""
        def value(name: str) -> float:
            column = self.features[name]
            text = cells[column].strip() if column < len(cells) else ""
            return float(text) if text not in ("", "-", "NA") else np.nan

        position = tuple(value(name) for name in "xyz")
        if np.isnan(position).all():
            return None
        require_finite(self.path, {"a position": np.array(position)}, _WHAT)
        return *position, value(self.radius_column) * _RADII[self.radius_column]

    def skeleton(self, scale: float, near: Place) -> Skeleton:
        nodes, parent = np.array(self.nodes).reshape(-1, 3), np.array(self.parent, np.int64)
        if not len(nodes):
            raise ValueError("it has 0 vertices with a position")
        radius = np.array(self.radius)
        require_finite(self.path, {"radii": radius}, _WHAT)
        return _of_nodes(self.path, nodes, parent, radius, scale, near)


def write_mtg(skeleton: Skeleton, path: Path) -> None:
    """Write an MTG: a plant of axes of nodes, with positions and radii [m]. An axis is attached
    with ``+`` to the node that it grows from; nodes follow each other with ``<``."""
    depth = int(skeleton.order.max()) + 1
    tabs = "\t" * (depth + 1)
    lines = ["CODE:\tFORM-A", "", "CLASSES:",
             "SYMBOL\tSCALE\tDECOMPOSITION\tINDEXATION\tDEFINITION",
             "$\t0\tFREE\tFREE\tIMPLICIT", "P\t1\tFREE\tFREE\tIMPLICIT",
             "N\t2\tFREE\tFREE\tIMPLICIT", "", "DESCRIPTION:", "LEFT\tRIGHT\tRELTYPE\tMAX",
             "N\tN\t+\t?", "N\tN\t<\t?", "", "FEATURES:", "NAME\tTYPE", "XX\tREAL", "YY\tREAL",
             "ZZ\tREAL", "Radius\tREAL", "", "MTG:",
             f"ENTITY-CODE{tabs}XX\tYY\tZZ\tRadius", f"/P1{tabs}"]
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
        # Side axes are written before the axis continues: "^" means the last node of that column.
        after = children.get(node, [])
        on = [one for one in after if skeleton.branch[one] == skeleton.branch[node]]
        waiting += on + [one for one in after if one not in on]
    write_lines(path, lines)


_MEANINGS = {
    spelt: name for name, several in {
        "id": ("id", "cylid", "cylinderid"), "parent": ("parent", "parentid", "parentcylid"),
        "radius": ("radius", "radiuscyl", "cylradius"), "length": ("length", "len"),
        "diameter": ("diameter", "diametercyl", "diam"),
        **{f"{end[0]}{axis}": (f"{end[0]}{axis}", f"{end}{axis}", f"{end}{k}", f"{axis}{end}")
           for end in ("start", "end", "axis") for k, axis in enumerate("xyz", 1)}}.items()
    for spelt in several}
"""Columns of Limber, TreeQSM, rTwig, SimpleForest and aRchi, in :func:`.text_columns.plain`."""
_MISSING = {"NA": "nan", "NULL": "nan"}
_LOOSE = 0.1
"""Fraction of the length of a file's trees that may be loose from the longest, and is left out."""
_HEAD = 4096  # bytes searched for the format


def read_skeleton(path: Path, *, scale: float | None = None, near: Place | str = None,
                  progress: Progress = SILENT) -> Skeleton:
    """Read a skeleton of any format of :data:`SKELETONS`, and tell its notes. ``scale`` is metres
    per unit; None uses the file's own, or metres; of several trees that with its root ``near`` a
    place [3] in the file's coordinates (no word) is taken. InputError if its format is not known,
    or it is not a tree."""
    options = {} if near is None or isinstance(near, str) else {"near": near}
    found = SKELETONS.read(Path(path), scale=scale, **options)
    for text in found.notes:
        progress.warn(text)
    return found


def read_swc(path: Path, *, scale: float | None = None, near: Place = None) -> Skeleton:
    """Read an SWC file. ``scale`` is metres per unit; None uses the header's ``# unit:``, or
    metres. InputError if it is not a tree; see :meth:`Skeleton.from_edges`."""
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
    return _of_nodes(path, table[:, 1:4], parent, table[:, 4], factor, near)


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


def _of_nodes(path: Path, nodes: np.ndarray, parent: np.ndarray, radius: np.ndarray,
              factor: float, near: Place) -> Skeleton:
    """The skeleton of a file's nodes [n, 3]."""
    keep, notes = _one_tree(path, parent, nodes, np.where(
        parent < 0, 0.0, np.linalg.norm(nodes - nodes[parent], axis=1)), near)
    return replace(Skeleton.from_edges(nodes[keep] * factor, _moved(parent, keep),
                                       radius[keep] * factor), notes=notes)


def _one_tree(path: Path, parent: np.ndarray, start: np.ndarray, length: np.ndarray,
              near: Place) -> tuple[np.ndarray, tuple[str, ...]]:
    """Which parts of a file [n] are its tree, by their parents (-1: none), start [n, 3] and length,
    and notes on those left out: the tree ``near`` a place, else the longest. InputError if there
    are several."""
    below, roots = np.flatnonzero(parent >= 0), np.flatnonzero(parent < 0)
    # Several may grow from the ground of one root.
    _, first, group = np.unique(np.round(start[roots], 9), axis=0, return_index=True,
                                return_inverse=True)
    links = (np.r_[below, roots], np.r_[parent[below], roots[first[group.ravel()]]])
    count, label = connected_components(
        coo_array((np.ones(len(parent)), links), (len(parent),) * 2), directed=False)
    if count == 1 or len(np.unique(label[roots])) < count or not np.isfinite(length).all():
        # A cycle, or no numbers: refused by the skeleton.
        return np.ones(len(parent), bool), ()
    share = np.bincount(label, length) / max(length.sum(), 1e-300)
    if near is not None:
        nearest = roots[np.linalg.norm(start[roots] - near, axis=1).argmin()]
        return label == label[nearest], (
            f"{path.name} has {count} trees. The one with its root at {_place(start[nearest])} was "
            f"taken: {100 * share[label[nearest]]:.3g} % of their length.",)
    longest = np.argsort(-share, kind="stable")
    loose = 1.0 - share[longest[0]]
    if loose > _LOOSE:
        places = "; ".join(f"{_place(start[roots[label[roots] == k][0]])} ({100 * share[k]:.2g} %)"
                           for k in longest[:4] if (label[roots] == k).any())
        raise InputError(f"{path} has {count} trees. Roots, with shares of the length: {places}.",
                         "A branch has exactly one root.", "Choose one with ", Option("root"),
                         " and a place near its root, or keep only one tree in the file.")
    return label == longest[0], (
        f"{path.name}: {int((label != longest[0]).sum())} of {len(parent)} parts, "
        f"{100 * loose:.2g} % of the length, are loose from the tree and were left out.",)


def _place(point: np.ndarray) -> str:
    return f"({', '.join(f'{value:.6g}' for value in point)})"


def _moved(parent: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """Parents of the kept parts, counted among them."""
    return np.where(parent < 0, -1, (np.cumsum(keep) - 1)[parent])[keep]


def is_cylinders(path: Path) -> bool:
    """Return whether a file begins with the titles of a table of cylinders."""
    found = _columns([_first_line(path)])
    return {"parent", "sx"} <= set(found) and bool({"radius", "diameter"} & set(found))


def _columns(lines: Sequence[str]) -> dict[str, Sequence[Any]]:
    """The fields below each title, by its meaning if that is known."""
    mark = separator_of(lines[:1])
    titles, *rows = [fields_of(line, mark) for line in lines]
    found: dict[str, Sequence[Any]] = {}
    for k, title in enumerate(titles):
        found.setdefault(_MEANINGS.get(plain(title), title), [
            row[k].replace(",", ".") if k < len(row) else "" for row in rows])
    return found


def read_cylinders(path: Path, *, scale: float | None = None, near: Place = None) -> Skeleton:
    """Read columns parent, sx, sy, sz, radius and ex, ey, ez, or ax, ay, az and length (any order,
    separator and names of :data:`_MEANINGS`; without id they are counted from 1), and what
    :func:`write_cylinders` adds. An end becomes a node attached to its parent's end; the root's
    start is the root. InputError if it is not one tree."""
    lines = [line for line in read_text(path, "a cylinder model").splitlines()
             if line.strip() and not line.startswith("#")]
    columns = _columns(lines) if lines else {}
    columns.setdefault("id", range(1, len(lines)))
    if "radius" not in columns and "diameter" in columns:
        columns["radius"] = (_numbers(path, columns, ["diameter"])[:, 0] / 2).tolist()
    if "ex" not in columns and {"ax", "ay", "az", "length"} <= set(columns):
        read = _numbers(path, columns, ("sx", "sy", "sz", "ax", "ay", "az", "length"))
        columns |= zip(("ex", "ey", "ez"), (
            read[:, :3] + read[:, 3:6] * read[:, 6:]).T.tolist(), strict=True)
    names = ("id", "parent", "sx", "sy", "sz", "ex", "ey", "ez", "radius")
    missing = [name for name in names if name not in columns]
    if missing or len(lines) < 2:
        raise InputError(f"{path} lacks the columns {', '.join(missing)}." if missing else
                         f"{path} has no cylinders.",
                         f"A cylinder model has the columns {', '.join(names)}.",
                         "Rename the columns of your export.")
    return _tree_of(path, _numbers(path, columns, names), scale, near, columns)


_SEGMENT = re.compile(r"x,y,z,radius,parent_id[\w,]*")


def is_tree_file(path: Path) -> bool:
    """Return whether a file begins with the titles of a tree file of raycloudtools."""
    return _SEGMENT.search(head_of(path, _HEAD).decode("utf-8", "replace")) is not None


def read_tree_file(path: Path, *, scale: float | None = None, near: Place = None) -> Skeleton:
    """Read a tree file of raycloudtools: a line for each tree with its attributes and segments,
    these with the place of their end, radius and the number of their parent (-1: the root).
    InputError if a line is not of this kind, or without one tree."""
    text = read_text(path, "a tree file")
    titles = present(_SEGMENT.search(text), "titles of a tree file").group().strip(",").split(",")
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not re.match(r"\s*[-\d.]", line):
            continue
        before = len(rows)
        try:
            for part in re.split(r",\s+", line.strip().rstrip(",")):
                fields = [float(field) for field in part.split(",")]
                if len(fields) == len(titles):
                    up = fields[4]
                    rows.append([len(rows), up + before if up >= 0 else -1, *fields[:4]])
                elif len(rows) > before:
                    raise ValueError(f"{len(fields)} values instead of {len(titles)}")
            if len(rows) == before:
                raise ValueError(f"no segment of {len(titles)} values")
        except ValueError as error:
            raise ValueError(f"line {number} is not a tree ({error})") from error
    if not rows:
        raise ValueError("it has no trees")
    table = np.array(rows)
    parent = _parents(path, table[:, 0].astype(np.int64), table[:, 1].astype(np.int64))
    return _of_nodes(path, table[:, 2:5], parent, table[:, 5], 1.0 if scale is None else scale,
                     near)


def _of_arrays(path: Path, read: dict[str, np.ndarray], *, scale: float | None = None,
               near: Place = None) -> Skeleton:
    table = np.column_stack([read[name] for name in ("id", "parent", "start", "end", "radius")])
    found = _tree_of(path, table, scale, near, start_radius=read.get("start_radius"))
    return replace(found, notes=(*found.notes, *map(str, read.get("notes", ()))))


def _read_mat(path: Path, **options: Any) -> Skeleton:
    return _of_arrays(path, cylinder_models.read_treeqsm(path), **options)


def _tree_of(path: Path, table: np.ndarray, scale: float | None, near: Place,
             columns: Mapping[str, Sequence[Any]] | None = None, *,
             start_radius: np.ndarray | None = None) -> Skeleton:
    """The skeleton of cylinders: id, parent, start, end and radius, shape [n, 9]."""
    scale = 1.0 if scale is None else scale
    table[:, 1] = np.where(np.isnan(table[:, 1]), -1, table[:, 1])
    _require_whole(path, table[:, :2])
    ids, up = table[:, 0].astype(np.int64), table[:, 1].astype(np.int64)
    # Some programs count from 1 and give the root the parent 0.
    parent = _parents(path, ids, np.where((up == 0) & ~(ids == 0).any(), -1, up))
    if not (parent < 0).any():
        raise InputError(f"{path} has 0 cylinders without a parent.",
                         "A branch has exactly one root.", "Correct the file.")
    whole, notes = _one_tree(path, parent, table[:, 2:5], np.linalg.norm(
        table[:, 5:8] - table[:, 2:5], axis=1), near)
    fitted = _fitted_columns(path, columns, scale) if columns else {}
    first = np.array(table[:, 8] if start_radius is None else start_radius)
    if columns and "start_radius" in columns:
        first = _numbers(path, columns, ["start_radius"])[:, 0]
    parent, table, first = _moved(parent, whole), table[whole], first[whole]
    fitted = {name: values[whole] for name, values in fitted.items()}
    root = np.flatnonzero(parent < 0)[0]
    nodes = np.vstack([table[root, 2:5], table[:, 5:8]]) * scale
    radius = np.concatenate([[first[root]], table[:, 8]]) * scale
    hang = np.concatenate([[-1], np.where(parent < 0, 0, parent + 1)])
    hang, keep = _without_repeats(nodes, hang)
    return replace(Skeleton.from_edges(nodes[keep], hang, radius[keep], **{
        name: np.concatenate([values[root:root + 1], values])[keep]
        for name, values in fitted.items()}), notes=notes)


def _require_whole(path: Path, numbers: np.ndarray) -> None:
    if not (np.abs(numbers) < 2**53).all():
        raise InputError(f"{path} has an id or a parent that is not a whole number.",
                         "The ids of nodes are whole numbers.", "Correct the file.")


def _numbers(path: Path, columns: Mapping[str, Sequence[Any]], names: Sequence[str]) -> np.ndarray:
    """Columns of a table, shape [n, names]; NaN for a word that means missing."""
    try:
        return np.column_stack([[float(_MISSING.get(part, part)) for part in columns[name]]
                                for name in names])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} has a field that is not a number ({error}).",
                         f"{', '.join(names)} are numbers.", "Correct the file.") from error


def _fitted_columns(path: Path, columns: Mapping[str, Sequence[Any]], scale: float,
                    ) -> dict[str, np.ndarray]:
    names = ("radius_sigma", "radius_state", "probability")
    if any(name not in columns for name in names):
        return {}
    sigma, state, probability = np.ascontiguousarray(_numbers(path, columns, names).T)
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
    Format("cylinders", (".csv", ".txt"), read_cylinders, write_cylinders,
           recognises=is_cylinders, about="cylinders of Limber, rTwig, SimpleForest or aRchi"),
    Format("tree file", (".txt",), read_tree_file, recognises=is_tree_file,
           about="trees of raycloudtools"),
    Format("rtwig", (".csv",), write=cylinder_models.write_rtwig),
    Format("simpleforest", (".csv",), write=cylinder_models.write_simpleforest),
    Format("TreeQSM", (".mat",), _read_mat, cylinder_models.write_treeqsm,
           about="cylinders of TreeQSM or SmartQSM"),
    Format("MTG", (".mtg",), read_mtg, write_mtg, about="multiscale tree graph of the axes"),
], of_arrays=_of_arrays)
"""Readers take ``scale``, the metres per unit or None, and ``near``, the place of a root, where it
is given; their results are in metres. Arrays that a format reads are cylinders: ``id``, ``parent``
(-1: none), ``start``, ``end`` and ``radius``.
"""
