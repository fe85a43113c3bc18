"""Columns of a cloud: names and shapes that every writer of clouds accepts."""

import re
import unicodedata
from collections.abc import Collection, Iterable

import numpy as np

PARTS = {"normal": ("nx", "ny", "nz"), "color": ("red", "green", "blue")}
"""Attributes of three numbers per point, and their columns in files."""
_LONGEST_NAME = 60
"""Most characters of a name; Blender cuts the names of attributes at 63."""
_RESERVED = frozenset({"x", "y", "z", *PARTS, *(name for parts in PARTS.values()
                                              for name in parts)})
"""Reserved names: positions, normals and colours only."""


def property_names(titles: Iterable[str], taken: Collection[str] = ()) -> list[str]:
    """Return a valid name of a PLY property for each title, all different.

    A name has ASCII letters, digits and underscores; titles that are already such names are kept.
    Names are compared without case, since some readers ignore it.

    Args:
        titles: Names of a file's columns: any text, may be empty or repeated.
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
    """Return attributes that every writer accepts, and the file's names of those renamed.

    ``normal`` and ``color`` (in 0..255) are of shape [n, 3]; all other attributes are columns of
    numbers with valid names. Anything that is not a number per point is dropped.

    Args:
        attributes: Name to array, from a reader.
        titles: The file's name of an attribute, where it differs.
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
    """Colours in 0..255, converted from 0..255, fractions of 1 or 16 bits."""
    if color.dtype == np.uint8:
        return color
    values = np.nan_to_num(color.astype(float), posinf=0.0, neginf=0.0)
    top = values.max(initial=0.0)
    if top > 255:
        values = values / 257
    elif top < 1.01 and color.dtype.kind == "f":  # some programs round to a little over 1
        values = values * 255
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _split(title: str, name: str, values: np.ndarray) -> list[tuple[str, str, np.ndarray]]:
    """Title, name and numbers of each column of an attribute."""
    if values.ndim == 1:
        return [(title, name, values)]
    flat = values.reshape(len(values), -1)
    return [(f"{title}_{k}", f"{name}_{k}", flat[:, k]) for k in range(flat.shape[1])]


def ply_columns(name: str, values: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Return the PLY properties of a valid attribute, in types that PLY has."""
    values = _in_ply_type(values)
    return [(part, values[:, k]) for k, part in enumerate(PARTS[name])] if name in PARTS else [
        (name, values)]


def _in_ply_type(values: np.ndarray) -> np.ndarray:
    """Numbers in one of PLY's types: up to 32 bits for integers, float or double."""
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
