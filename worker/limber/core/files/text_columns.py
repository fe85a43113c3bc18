"""Tables of numbers as text: titles, units, separators and numbers; tables of points.

Imports numpy but not Limber: ``scripts/build_extension`` puts it into the extension, so that worker
and add-on read alike.
"""

import codecs
import contextlib
import itertools
import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

LENGTHS = {**{unit: unit for unit in ("m", "cm", "mm", "um", "in")},
           **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
           **dict.fromkeys(("centimeter", "centimeters", "centimetre", "centimetres"), "cm"),
           **dict.fromkeys(("millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
           **dict.fromkeys(("micron", "microns", "micrometer", "micrometers", "micrometre",
                            "micrometres"), "um"), **dict.fromkeys(("inch", "inches"), "in")}
"""Units of length by their names in files, in lower case."""
OTHER_LENGTHS = ("ft", "feet", "foot", "usft", "yd", "km", "dm", "nm", "px", "pixel", "voxel")
"""Units of length that are not supported but are recognised in brackets."""
_FORMS = ("{}", "{}coordinate", "{}coord", "coordinate{}", "coord{}", "{}koordinate",
          "koordinate{}", "{}pos", "{}position", "pos{}", "position{}", "p{}", "point{}",
          "points{}", "scan{}", "world{}", "local{}")
_PLANES = (("easting", "northing"), ("east", "north"), ("e", "n"), ("rechtswert", "hochwert"),
           ("ostwert", "nordwert"), ("ost", "nord"), ("este", "norte"), ("est", "nord"))
_HEIGHTS = ("height", "elevation", "altitude", "z", "h", "hohe", "hoehe", "alt", "up", "elev",
            "elevacion", "cota", "quota", "hauteur")
ROLES = {
    "position": (*(tuple(form.format(axis) for axis in "xyz") for form in _FORMS),
                 *(tuple(f"{word}{k}" for k in range(3)) for word in ("points", "point",
                                                                      "position", "pos", "xyz")),
                 *((*plane, height) for plane in _PLANES for height in _HEIGHTS)),
    "normal": (*(tuple(form.format(axis) for axis in "xyz") for form in ("n{}", "normal{}",
                                                                         "{}normal", "norm{}")),
               *(tuple(f"{word}{k}" for k in range(3)) for word in ("normals", "normal"))),
    "color": (*(tuple(form.format(name) for name in ("red", "green", "blue"))
                for form in ("{}", "color{}", "colour{}", "diffuse{}")),
              *(tuple(form.format(name) for name in "rgb")
                for form in ("{}", "color{}", "col{}", "{}f")),
              ("rot", "grun", "blau"), ("rot", "gruen", "blau"), ("rgb0", "rgb1", "rgb2"))}
"""Names of three columns with one role, in :func:`plain` letters; the first names found are used.
"""
_COUNTED = 5
"""Fewest points whose numbers are recognised as such."""
_STATED = re.compile(r"\b(?:units?|einheit(?:en)?)\b\W{0,3}(?:(?:are|is|in|sind|ist)\b\W{1,2})?"
                     r"([^\W\d_]+)", re.IGNORECASE)
_COUNTERS = ("id", "index", "idx", "nr", "no", "number", "row", "point", "pointid", "pointnumber")
MISSING = ("", "nan", "na", "n/a", "null", "none", "-")
_COLMAP, _HEAD = "POINT3D_ID", 1000  # characters in which COLMAP's column name is searched
_COLMAP_TITLES = ["point3d_id", "x", "y", "z", "red", "green", "blue", "error"]
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
LINES_AT_ONCE = 20_000
"""Lines read at a time: numpy holds the interpreter lock meanwhile."""
_BLOCK = 1 << 20
"""Characters read at a time."""
_MOST_HEAD = 60
"""Most lines above the numbers that are examined."""


def plain(name: str) -> str:
    """Return the letters and digits of a name in lower case, without accents."""
    letters = unicodedata.normalize("NFKD", name.lower()).encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9]", "", letters)


def split_title(title: str, units: Iterable[str]) -> tuple[str, str | None]:
    """Split the unit from a title: ``x_mm``, ``X (mm)``, ``Position [m] X``, ``x/mm``, ``x in mm``;
    ``units``, in lower case, need no brackets at the end."""
    text = title.strip().replace("\u00b5", "u").replace("\u03bc", "u")
    bracket = re.search(r"[(\[]\s*([^)\]]*?)\s*[)\]]", text)
    if bracket and bracket.end() == len(text):
        return text[:bracket.start()].strip(" _"), bracket.group(1) or None
    if bracket and bracket.group(1).lower() in units:
        return f"{text[:bracket.start()].strip()} {text[bracket.end():].strip()}", bracket.group(1)
    end = re.fullmatch(r"(.+?)\s*(?:_|,|(?<!^)/|\s+in\s)\s*([A-Za-z]+)", text, re.DOTALL) or (
        re.fullmatch(r"(.+)\s([A-Za-z]{2,})", text, re.DOTALL))
    if end and end.group(2).lower() in units and not text.startswith("/"):
        return end.group(1).strip(), end.group(2)
    head, _, tail = text.rpartition("_")
    return (head, tail) if head and tail.lower() in units else (text, None)


def three_of(role: str, names: Sequence[str]) -> tuple[int, int, int] | None:
    """Return which columns have a role of :data:`ROLES`; None unless all three are there."""
    for spelt in ([name.lower().lstrip("/#").strip() for name in names],
                  [plain(name) for name in names]):
        for one, two, three in ROLES[role]:
            if one in spelt and two in spelt and three in spelt:
                return spelt.index(one), spelt.index(two), spelt.index(three)
    return None


def stated_unit(text: str) -> str | None:
    """Return the unit of length stated by a comment or a preamble, if any."""
    return next((LENGTHS[word.lower()] for word in _STATED.findall(text)
                 if word.lower() in LENGTHS), None)


def counts_up(column: np.ndarray) -> bool:
    """Whether a column [n] is 0, 1, 2 ... or 1, 2, 3 ..."""
    return column[0] in (0, 1) and bool((np.diff(column) == 1).all())


def counting_columns(values: np.ndarray) -> int:
    """Return how many untitled columns [n, k] before the coordinates count points, or a scanner's
    rows and columns."""
    for count in (1, 2) if len(values) >= _COUNTED else ():
        lead, after = values[:, :count], values[:, count:count + 3]
        if after.shape[1] < 3 or not (after % 1 != 0).any(axis=0).all() or (lead % 1 != 0).any():
            continue
        key = lead @ np.r_[lead.max(axis=0)[1:] + 1, 1.0]
        back = lead[:, ::-1] @ np.r_[lead.max(axis=0)[:-1] + 1, 1.0]
        if counts_up(lead[:, 0]) if count == 1 else (lead >= 0).all() and (
                (np.diff(key) > 0).all() or (np.diff(back) > 0).all()):
            return count
    return 0


def guessed_titles(extra: np.ndarray, intensity_first: bool) -> list[str]:
    """Return names of columns [n, k] after x, y, z, in the order of scanners and CloudCompare: of
    four, a scanner writes intensity and colour, CloudCompare colour and a scalar; if their values
    are ambiguous, ``intensity_first`` decides."""
    count = extra.shape[1]
    if count == 3:
        return ["red", "green", "blue"]
    if count == 4:
        before, after = _are_bytes(extra[:, :3]), _are_bytes(extra[:, 1:])
        if after and (intensity_first or not before):
            return ["intensity", "red", "green", "blue"]
        if before:
            return ["red", "green", "blue", "scalar_0"]
    if count == 6:
        return ["red", "green", "blue", "nx", "ny", "nz"]
    return [f"scalar_{k}" for k in range(count)]


def _are_bytes(columns: np.ndarray) -> bool:
    return bool(((columns >= 0) & (columns <= 255) & (columns % 1 == 0)).all())


class ColumnsError(ValueError):
    """A table cannot be read: what was ``seen``, ``why`` it is wrong, how to ``fix`` it."""

    def __init__(self, seen: str, why: str, fix: str):
        self.seen, self.why, self.fix = seen, why, fix
        super().__init__(f"{seen} {why} {fix}")


@dataclass(frozen=True)
class Columns:
    """A table of points [n, columns]: names in lower case without units, coordinates x, y, z;
    titles as in the file, the coordinates' unit among the values of :data:`LENGTHS`, if stated, and
    notes on what was not used."""

    names: list[str]
    titles: list[str]
    values: np.ndarray
    unit: str | None = None
    notes: tuple[str, ...] = ()


def coding_of(path: Path) -> str:
    """Return the coding of a text file: UTF-8, UTF-16 or, as of spreadsheets, a Windows code
    page. ColumnsError for zero bytes: one line of them may take all memory."""
    reader = codecs.getincrementaldecoder("utf-8")()
    with open(path, "rb") as stream:
        start = stream.read(_BLOCK)
        for mark, coding in ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"),
                             (codecs.BOM_UTF16_BE, "utf-16")):
            if start.startswith(mark):
                return coding
        found = "utf-8"
        while start:
            if b"\0" in start:
                raise ColumnsError(f"{path} is not a text file: it has zero bytes.",
                                   "A table was expected.", "Export it as text in UTF-8.")
            if found == "utf-8":
                try:
                    reader.decode(start)
                except UnicodeDecodeError:
                    found = "cp1252"
            start = stream.read(_BLOCK)
        try:
            reader.decode(b"", final=True)
        except UnicodeDecodeError:
            return "cp1252"
    return found


def lines_of(path: Path, coding: str) -> Iterator[str]:
    """Yield the lines of a text file, of which a part is held in memory."""
    with open(path, encoding=coding, errors="replace", newline="") as stream:
        while block := stream.readlines(_BLOCK):
            yield from "".join(block).splitlines()


def read_columns(path: Path) -> Columns:
    """Read the columns of a text file, as :class:`Table` does, all at once."""
    table = Table(path)
    return table.columns(np.concatenate(list(table.pieces())))


class Table:
    """The columns of a text file, read in pieces; ``axes`` are the coordinates. Numbers are
    separated by blanks, tabs, commas or semicolons, decimals may be commas where these do not
    separate. Lines above may name the columns and a unit, the number of points may precede those of
    each scan. ColumnsError, also later, without numbers or enough columns, for several or unknown
    units, or a line that does not fit, which it names."""

    def __init__(self, path: Path):
        self._path = path
        self._coding = coding_of(path)
        start = "\n".join(itertools.islice(self._lines(), _HEAD))[:_HEAD]
        self._is_colmap = _COLMAP in start or _has_tracks(start)
        sample = list(itertools.islice(self._rows(), _HEAD))
        if not sample:
            raise ColumnsError(f"{path} has no lines with numbers.", "A point cloud was expected.",
                               "Export it again.")
        # The lines above do not show how numbers are written.
        self._separator = None if self._is_colmap else separator_of(sample[len(sample) // 2:][:1])
        self._first = _first_row(sample, self._separator)
        self._head, rows = sample[:self._first], sample[self._first:]
        if not rows:
            raise ColumnsError(f"{path} has a header but no points.", "A point cloud was expected.",
                               "Export it again.")
        self._ending = self._separator is not None and rows[0].rstrip().endswith(self._separator)
        self._titles = _COLMAP_TITLES if self._is_colmap else _titles(
            path, self._head, rows, self._separator)
        self._width = 0
        self._words: list[int] = []
        self._name(rows)

    def pieces(self) -> Iterator[np.ndarray]:
        """Yield the numbers of some lines after the other, shape [n, columns] each."""
        rows = itertools.islice(self._rows(), self._first, None)
        while piece := list(itertools.islice(rows, LINES_AT_ONCE)):
            yield self._numbers(piece)

    def columns(self, values: np.ndarray) -> Columns:
        """Return the table with ``values``, which are all pieces [n, columns], or a part of them.
        """
        titles = self._titles or [*self._untitled(), *guessed_titles(
            values[:, 3 + self._counting:], self._path.suffix.lower() == ".pts")]
        names, unit = _named(self._path, titles)
        return Columns(names, titles, values, unit or self._stated, self._notes)

    def _untitled(self) -> list[str]:
        return [*(f"index_{k}" for k in range(self._counting)), "x", "y", "z"]

    def _lines(self) -> Iterator[str]:
        return (line.replace('"', "") for line in lines_of(self._path, self._coding))

    def _rows(self) -> Iterator[str]:
        """Lines without comments and counts of points; COLMAP's without a point's images, whose
        number varies."""
        rows = (line for line in self._lines() if line.strip() and not _is_comment(line))
        if self._is_colmap:
            return (" ".join(line.split()[:len(_COLMAP_TITLES)]) for line in rows)
        return _without_counts(rows)

    def _name(self, rows: list[str]) -> None:
        """Find out what the columns are, from the first lines of numbers."""
        comments = [] if self._is_colmap else [line.lstrip(" #/") for line in itertools.islice(
            filter(str.strip, self._lines()), _MOST_HEAD) if _is_comment(line)]
        values, titles = self._numbers(rows), self._titles
        if self._is_colmap and values.shape[1] < len(titles):
            raise ColumnsError(f"{self._path}, line {self._place(rows[0])} has {values.shape[1]} "
                               f"values.", "A point of COLMAP has at least "
                               f"{len(titles)}: {', '.join(titles)}.", "Export it again.")
        if values.shape[1] < 3:
            raise ColumnsError(f"{self._path} has too few columns ({values.shape[1]}).",
                               "Coordinates need three columns.", "Export it again.")
        used = [k for k in range(self._width) if k not in self._words]
        if len(titles) == values.shape[1] - 1 and counts_up(values[:, 0]):
            titles = ["", *titles]  # see _columns_of_words
        self._notes = tuple(f"Column {titles[k]!r} holds words and was not read."
                            for k in self._words)
        titles = [titles[k] for k in used] if len(titles) > max(used) else []
        titles = titles or _commented(comments, self._separator, values)
        self._titles = titles if len(titles) == values.shape[1] else []
        self._counting = 0 if self._titles else counting_columns(values)
        if self._counting:
            self._notes += (f"The first {self._counting} columns only count and were not taken "
                            "for coordinates.",)
        self._stated = stated_unit("\n".join([*comments, *self._head]))
        names = _named(self._path, self._titles)[0] if self._titles else self._untitled()
        self.axes = [names.index(axis) for axis in "xyz"]

    def _numbers(self, rows: list[str]) -> np.ndarray:
        """The numbers of some lines, without columns of words."""
        commas = self._separator != ","
        clean = (row.replace(",", ".") for row in rows) if commas else iter(rows)
        if self._ending:
            clean = (row.rstrip().removesuffix(self._separator or "") for row in clean)
        if not self._words:
            with contextlib.suppress(ValueError):
                values = np.loadtxt(clean, delimiter=self._separator, ndmin=2)
                self._width = self._width or values.shape[1]
                if values.shape[1] == self._width:
                    return values
        return self._with_words(rows)

    def _with_words(self, lines: list[str]) -> np.ndarray:
        """The numbers of lines with missing values, or with columns of words beside named ones."""
        rows = [[number_of(part, self._separator != ",") for part in _parts(line, self._separator)]
                for line in lines]
        if not self._width:
            self._width = len(rows[0])
            self._words = self._columns_of_words(rows)
        width, words = self._width, self._words
        for line, row in zip(lines, rows, strict=True):
            if len(row) != width:
                raise ColumnsError(f"{self._path}, line {self._place(line)} has {len(row)} values, "
                                   f"but the first line has {width}.", "The file may be truncated.",
                                   "Export it again, or correct that line.")
            bad = next((k for k in range(width) if k not in words and row[k] is None), None)
            if bad is not None:
                word = _parts(line, self._separator)[bad].strip()[:30]
                raise ColumnsError(f"{self._path}, line {self._place(line)}: {word!r} is not a "
                                   "number.", "Each line of a cloud holds the numbers of one "
                                   "point.", "Correct that line.")
        used = [k for k in range(width) if k not in words]
        return np.array([[row[k] for k in used] for row in rows], float)

    def _columns_of_words(self, rows: list[list[float | None]]) -> list[int]:
        # R's write.table writes no title for its row names.
        titles = ["", *self._titles] if len(self._titles) == self._width - 1 else self._titles
        sample = [row for row in rows[:_MOST_HEAD] if len(row) == self._width]
        axes = three_of("position", _bare(titles)) if len(titles) == self._width else None
        words = [k for k in range(self._width) if axes is not None and k not in axes
                 and all(row[k] is None for row in sample)]
        if words:
            self._titles = titles
        return words

    def _place(self, line: str) -> int:
        beginning = " ".join(line.split())
        return next((k for k, other in enumerate(self._lines(), start=1)
                     if " ".join(other.split()).startswith(beginning)), 1)


def _has_tracks(text: str) -> bool:
    """Whether these are COLMAP's points without its comments: rows end with pairs of numbers."""
    rows = [line.split() for line in text.splitlines()[:-1]]
    widths = {len(row) for row in rows}
    return len(widths) > 1 and min(widths) >= 8 and not any(width % 2 for width in widths) and all(
        row[0].isdigit() and all(part.isdigit() and int(part) < 256 for part in row[4:7])
        for row in rows)


def _without_counts(rows: Iterator[str]) -> Iterator[str]:
    """Lines without counts of the points that follow: first, below titles, at each scan."""
    first = list(itertools.islice(rows, 3))
    start = next((k for k, line in enumerate(first[:2]) if line.strip().isdecimal()), None)
    rows = itertools.chain(first, rows)
    if start is not None and start + 1 < len(first):
        yield from itertools.islice(rows, start)
        for line in rows:
            if not line.strip().isdecimal():
                yield line
                break
            yield from itertools.islice(rows, int(line.strip()[:18]))
    yield from rows


def _is_comment(line: str) -> bool:
    start = line.lstrip()
    return start.startswith(("#", "%")) or (start.startswith("//") and not start[2:3].isalpha())


def separator_of(lines: Sequence[str]) -> str | None:
    """Return the separator of the fields of consecutive lines; None is white space."""
    counts = {mark: np.array([line.count(mark) for line in lines]) for mark in ";\t|,"}
    # The last line may be truncated.
    typical = {mark: float(np.median(count)) for mark, count in counts.items() if len(lines)
               and np.mean((count[:-1] if len(lines) > 1 else count) == np.median(count)) > 0.6}
    best = max(";\t|", key=lambda mark: typical.get(mark, 0.0))
    if typical.get(best, 0.0) >= 1:
        return best
    blanks = lines[len(lines) // 2].split() if lines else []
    if len(blanks) > 2 and all(DECIMAL_COMMA.fullmatch(part) for part in blanks):
        return None
    return "," if typical.get(",", 0.0) >= 1 else None


def fields_of(line: str, separator: str | None) -> list[str]:
    """Return the fields of a line, without quotes."""
    if separator is None:
        # A unit in brackets belongs to the title before it.
        line = re.sub(r"\s+(?=[\[(])", "", line)
    return [part.strip().strip('"').strip() for part in line.split(separator)]


def number_of(part: str, commas: bool) -> float | None:
    """Return the number of a field, whose decimals may be commas; NaN for a word that means
    missing, None for any other."""
    if part.lower() in MISSING:
        return float("nan")
    try:
        return float(part.replace(",", ".") if commas else part)
    except ValueError:
        return None


def with_units(titles: Sequence[str], units: Sequence[str]) -> list[str]:
    """Return titles with the units of the line below them."""
    return [f"{title} ({unit})" if unit else title
            for title, unit in zip(titles, units, strict=True)]


def _parts(line: str, separator: str | None) -> list[str]:
    parts = fields_of(line, separator)
    # Some programs end each line with a separator.
    return parts[:-1] if len(parts) > 3 and parts[-1] == "" else parts


def _first_row(lines: list[str], separator: str | None) -> int:
    """Index of the first line of numbers."""
    for index, line in enumerate(lines[:_MOST_HEAD]):
        parts = _parts(line, separator)
        numbers = [number_of(part, separator != ",") for part in parts]
        known = [number for number in numbers if number is not None]
        # A row of a table may contain words besides numbers, but they are never the majority.
        # A line of separators alone belongs to what stands above the titles.
        if len(known) >= max(3, (len(parts) + 1) // 2) and (
                any(parts) if len(known) == len(parts) else not all(np.isnan(known))):
            return index
    return int(any(part[:1].isalpha() for part in _parts(lines[0], separator)))


def _titles(path: Path, head: list[str], lines: list[str], separator: str | None) -> list[str]:
    """Titles of the columns; none if no line above the numbers names coordinates."""
    for index in reversed(range(len(head))):
        line = head[index]
        other = separator if separator is None or separator in line else separator_of([line])
        titles = _parts(line, other)
        if three_of("position", _bare(titles)) is None:
            continue
        units = [part.strip("()[] ") for part in _parts(head[index + 1], other)] if (
            index + 1 < len(head)) else []
        if len(units) == len(titles) and any(unit.lower() in LENGTHS for unit in units):
            return with_units(titles, units)
        return titles
    last = _parts(head[-1], separator) if head else []
    if last and len(last) == len(_parts(lines[0], separator)):
        raise ColumnsError(f"{path} has the columns {', '.join(_bare(last))[:200]}.",
                           "x, y and z are missing.", "Name the coordinates x, y, z.")
    return []


def _commented(comments: list[str], separator: str | None, values: np.ndarray) -> list[str]:
    """Titles in a comment that names coordinates and the right number of columns."""
    for comment in reversed(comments):
        for mark in (separator, separator_of([comment])):
            titles = _parts(comment, mark)
            counts = [k for k, title in enumerate(titles) if plain(title) in _COUNTERS]
            if len(titles) == values.shape[1] and three_of("position", _bare(titles)) and (
                    (values[:, counts] % 1 == 0).all()):
                return titles
    return []


def _bare(titles: Iterable[str]) -> list[str]:
    """Titles without units of length, in lower case."""
    found = []
    for title in titles:
        name, unit = split_title(title.lower().lstrip("/#").strip(), LENGTHS)
        is_length = unit is not None and unit in (*LENGTHS, *OTHER_LENGTHS)
        found.append(name if is_length else title.lower().lstrip("/#").strip())
    return found


def _named(path: Path, titles: list[str]) -> tuple[list[str], str | None]:
    """Names of columns, and the unit of the coordinates if their titles state it."""
    names = _bare(titles)
    axes = three_of("position", names)
    if axes is None:
        return names, None
    units = {split_title(titles[k].lower(), LENGTHS)[1] for k in axes}
    for k, axis in zip(axes, "xyz", strict=True):
        names[k] = axis
    if units == {None}:
        return names, None
    found = {LENGTHS.get(unit or "") for unit in units}
    if len(found) > 1 or None in found:
        raise ColumnsError(f"{path}: the coordinates are called "
                           f"{', '.join(titles[k] for k in axes)}.",
                           "They must have one unit, out of m, cm, mm, um and in.",
                           "Convert the columns, or correct their titles.")
    return names, found.pop()
