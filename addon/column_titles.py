"""Titles of columns: names without units, units of length, the roles of three columns, and guesses
for columns without a title.

Does not import Limber: ``addon/column_titles.py`` is a copy, so that worker and add-on read alike.
``scripts/make_addon_schema`` makes the copy; a test compares the two.
"""

import re
import unicodedata
from collections.abc import Iterable, Sequence

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


def plain(name: str) -> str:
    """Return the letters and digits of a name in lower case, without accents."""
    letters = unicodedata.normalize("NFKD", name.lower()).encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9]", "", letters)


def split_title(title: str, units: Iterable[str]) -> tuple[str, str | None]:
    """Split the unit from a title: ``x_mm``, ``X (mm)``, ``Position [m] X``, ``x/mm``, ``x in mm``.

    Args:
        title: Title of a column.
        units: Units that need no brackets at the end, in lower case.
    """
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
    """Return how many columns before the coordinates count points, or a scanner's rows and columns.

    Args:
        values: Columns without titles, shape [n, k].
    """
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
    """Return names of columns [n, k] after x, y, z, in the order of scanners and CloudCompare.

    Of four columns, a scanner writes intensity and colour, CloudCompare colour and a scalar. If
    their values are ambiguous, ``intensity_first`` decides.
    """
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
