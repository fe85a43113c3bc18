"""The columns of a cloud: names and shapes that every writer of clouds can take."""

import re
import unicodedata
from collections.abc import Collection, Iterable

import numpy as np

PARTS = {"normal": ("nx", "ny", "nz"), "color": ("red", "green", "blue")}
"""Attributes of three numbers a point, and the columns that they are in files."""
_LONGEST_NAME = 60
"""Characters of a name; Blender cuts the names of attributes at 63."""
_RESERVED = frozenset({"x", "y", "z", *PARTS, *(name for parts in PARTS.values()
                                              for name in parts)})
"""Names that mean positions, normals and colours, and may stand for nothing else."""


def property_names(titles: Iterable[str], taken: Collection[str] = ()) -> list[str]:
    """Return a valid name of a PLY property for each title, all different.

    A name has letters, digits and underscores of ASCII; titles that are such names stay as they
    are. Capitals make no difference, since they make none to some readers.

    Args:
        titles: What a file calls its columns: any text, empty or repeated as well.
        taken: Names that are not to be used.
    """
    used = {name.lower() for name in taken}
    names = []
    for title in titles:
        plain = unicodedata.normalize("NFKD", title).encode("ascii", "ignore").decode()
        if not re.fullmatch(r"\w+", plain, re.ASCII):
            plain = re.sub(r"[\W_]+", "_", plain, flags=re.ASCII).strip("_") or "unnamed"
        name, number = plain[:_LONGEST_NAME], 1
        while name.lower() in used:
            number += 1
            end = f"_{number}"
            name = plain[:_LONGEST_NAME - len(end)] + end
        used.add(name.lower())
        names.append(name)
    return names


def valid_columns(attributes: dict[str, np.ndarray], titles: dict[str, str], count: int,
                  taken: Collection[str] = ()) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return attributes that every writer can take, and the file's names of those renamed.

    ``normal`` is of shape [n, 3] and ``color`` as well, in 0..255; all other attributes are columns
    of numbers with valid names. What is no number of each point is dropped.

    Args:
        attributes: Name to array, as a reader made them.
        titles: What the file calls an attribute, where its name is another.
        count: Number of points n.
        taken: Names that attributes must not have.
    """
    kept: dict[str, np.ndarray] = {}
    columns: list[tuple[str, str, np.ndarray]] = []
    for name, values in attributes.items():
        if values.dtype.kind not in "biuf" or values.shape[:1] != (count,):
            continue
        if name in PARTS and values.ndim == 2 and values.shape[1] >= 3:
            kept[name] = _bytes(values[:, :3]) if name == "color" else values[:, :3]
        else:
            columns += _split(titles.get(name, name), name, values)
    names = property_names((name for _, name, _ in columns), _RESERVED | set(taken))
    renamed = {name: title for name, (title, _, _) in zip(names, columns, strict=True)
               if name != title}
    return kept | {name: values for name, (_, _, values) in zip(names, columns, strict=True)
                   }, renamed


def _bytes(color: np.ndarray) -> np.ndarray:
    """Colours in 0..255, of such ones, of fractions of 1 or of 16 bits."""
    if color.dtype == np.uint8:
        return color
    values = np.nan_to_num(color.astype(float), posinf=0.0, neginf=0.0)
    top = values.max(initial=0.0)
    if top > 255:
        values = values / 257
    elif top < 1.01 and color.dtype.kind == "f":  # rounded to a little over 1 by some programs
        values = values * 255
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _split(title: str, name: str, values: np.ndarray) -> list[tuple[str, str, np.ndarray]]:
    """Title, name and numbers of each column of an attribute."""
    if values.ndim == 1:
        return [(title, name, values)]
    flat = values.reshape(len(values), -1)
    return [(f"{title}_{k}", f"{name}_{k}", flat[:, k]) for k in range(flat.shape[1])]


def ply_columns(name: str, values: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Return the properties of a PLY file that a valid attribute becomes, in types that PLY has."""
    values = _in_ply_type(values)
    return [(part, values[:, k]) for k, part in enumerate(PARTS[name])] if name in PARTS else [
        (name, values)]


def _in_ply_type(values: np.ndarray) -> np.ndarray:
    """Numbers in one of the types that PLY has: up to 32 bits if whole, float or double."""
    kind, size = values.dtype.kind, values.dtype.itemsize
    if kind == "b":
        return values.astype(np.uint8)
    if kind == "f":
        return values.astype(np.float64 if size >= 8 else np.float32)
    if size < 8:
        return values.astype(values.dtype.newbyteorder("="))
    low, high = (int(values.min()), int(values.max())) if len(values) else (0, 0)
    small = np.iinfo(np.int32)
    return values.astype(np.int32 if small.min <= low and high <= small.max else np.float64)
