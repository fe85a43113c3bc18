"""Reader and writer of multiscale tree graphs (MTG), as in OpenAlea's text files.

A file has sections; the last one, ``MTG:``, has one line per vertex. The column in which its code
begins states what it refers to: the last vertex of the column before, or, after ``^``, the last one
of its own column. The code is a chain of signs and labels: ``/`` a part of the preceding vertex,
``<`` its successor, ``+`` a side branch. Vertices of any scale with XX, YY and ZZ become nodes.

Source: C. Pradal, C. Godin, *MTG user guide* (OpenAlea), and its example files.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.core.files.atomic import write_lines
from limber.core.files.reading import read_text, require_finite
from limber.geometry.skeleton.skeleton import Skeleton

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


def read_mtg(path: Path, *, scale: float | None = None) -> Skeleton:
    """Read the nodes of an MTG: vertices with positions, each attached to its parent.

    A vertex without a radius or diameter has that of the node before it.

    Args:
        path: The file.
        scale: Metres per unit, which an MTG does not state; None means metres.

    Raises:
        InputError: the file is not an MTG, has no positions or radii, or is not one tree.
    """
    lines = read_text(path, _WHAT).splitlines()
    scales, body = _sections(path, lines)
    reader = _Reader(path, scales, *_header(path, body))
    for number, line in body[1:]:
        reader.take(number, line)
    return reader.skeleton(1.0 if scale is None else scale)


def _sections(path: Path, lines: list[str]) -> tuple[dict[str, int], list[tuple[int, str]]]:
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
        raise InputError(f"{path} has no section {' and '.join(missing)}.",
                         "An MTG has the sections CODE, CLASSES, DESCRIPTION, FEATURES and MTG.",
                         "Choose an MTG file (FORM-A).")
    scales = {}
    for number, line in found["CLASSES"][1:]:
        words = line.split()
        if len(words) < 2 or not words[1].isdigit():
            raise InputError(f"{path}, line {number}: {line.strip()[:60]!r} is not a class.",
                             "A class has a symbol and a scale.", "Correct that line.")
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

    def take(self, number: int, line: str) -> None:
        cells = line.split("\t")
        codes = [(column, cell.strip()) for column, cell in enumerate(cells[:self.columns])
                 if cell.strip()]
        if not codes:
            return
        values = self.values(number, cells)
        vertex: _Vertex | None = None
        for index, (column, code) in enumerate(codes):
            if vertex is None:
                stays = code.startswith("^")
                vertex = self.last.get(column if stays else column - 1)
                if vertex is None and (stays or column > 0):
                    raise self.wrong(number, code, "It refers to a vertex that does not exist.")
            vertex = self.chain(number, code.removeprefix("^"), vertex,
                                values if index == len(codes) - 1 else None)
            self.last = {at: one for at, one in self.last.items() if at < column}
            self.last[column] = vertex

    def chain(self, number: int, code: str, vertex: _Vertex | None,
              values: tuple[float, ...] | None) -> _Vertex:
        """Follow a code; its last vertex has the values of the line."""
        at = 0
        while at < len(code):
            token = _TOKEN.match(code, at)
            if token is None or (token.group(1) is None and vertex is not None):
                raise self.wrong(number, code, "A code consists of /, < or + and labels.")
            at = token.end()
            if token.group(2) not in self.scales:
                raise self.wrong(number, code, f"The file has no class {token.group(2)}.")
            vertex = self.vertex(number, code, (token.group(1) or "/")[0],
                                 self.scales[token.group(2)], vertex,
                                 values if at == len(code) else None)
        if vertex is None:
            raise self.wrong(number, code, "It does not name a vertex.")
        return vertex

    def vertex(self, number: int, code: str, sign: str, scale: int, before: _Vertex | None,
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
                raise self.wrong(number, code, "A part must have a finer scale than its whole.")
        found = _Vertex(scale, whole, anchor)
        if values is not None:
            found.anchor = self.node(number, code, anchor, values)
            while whole is not None and sign != "+":
                whole.tail, whole = found.anchor, whole.whole
        return found

    def node(self, number: int, code: str, parent: int, values: tuple[float, ...]) -> int:
        *position, radius = values
        if np.isnan(radius):
            if parent < 0:
                raise self.wrong(number, code, "The first vertex with a position has no radius.")
            radius = self.radius[parent]
        self.nodes.append(tuple(position))
        self.parent.append(parent)
        self.radius.append(radius)
        return len(self.nodes) - 1

    def values(self, number: int, cells: list[str]) -> tuple[float, ...] | None:
        """Position and radius of a line (nan if it has no radius); None without a position."""
        def value(name: str) -> float:
            column = self.features[name]
            text = cells[column].strip() if column < len(cells) else ""
            try:
                return float(text) if text not in ("", "-", "NA") else np.nan
            except ValueError as error:
                raise self.wrong(number, text, "Positions and radii must be numbers.") from error
        position = tuple(value(name) for name in "xyz")
        if np.isnan(position).all():
            return None
        require_finite(self.path, {f"position in line {number}": np.array(position)}, _WHAT)
        return *position, value(self.radius_column) * _RADII[self.radius_column]

    def skeleton(self, scale: float) -> Skeleton:
        roots = self.parent.count(-1)
        if roots != 1:
            raise InputError(f"{self.path} has {roots} vertices with a position that grow from no "
                             "other vertex.", "A branch has exactly one root.",
                             "Keep only one plant in the file.")
        nodes, radius = np.array(self.nodes), np.array(self.radius)
        require_finite(self.path, {"radii": radius}, _WHAT)
        return Skeleton.from_edges(nodes * scale, np.array(self.parent), radius * scale)

    def wrong(self, number: int, code: str, why: str) -> InputError:
        return InputError(f"{self.path}, line {number}: {code[:60]!r} cannot be read.", why,
                          "Correct that line.")


def write_mtg(skeleton: Skeleton, path: Path) -> None:
    """Write an MTG: a plant of axes of nodes, with positions and radii [m].

    An axis is attached with ``+`` to the node that it grows from; nodes follow each other with
    ``<``.
    """
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
