"""Clouds as PCD files, of all versions."""

import io
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.core.files.declared_sizes import header_bytes
from limber.core.files.text_columns import stated_unit
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.columns import property_names
from limber.geometry.cloud.piecewise_reading import PIECE_POINTS, gathered

_PADDING = "#$%&~~"  # prefix by which pypcd4 names fields that are called _


def read_pcd(path: Path) -> Cloud:
    """Return the points of a PCD file, with the file's own names of renamed columns."""
    raw, body = header_bytes(path, b"\nDATA")
    header, titles = _completed(path, raw.decode("utf-8", "replace"))
    cloud = gathered(_cloud(table, titles) for table in _tables(path, header, body))
    comments = [line for line in raw.decode("utf-8", "replace").splitlines()
                if line.startswith("#")]
    return replace(cloud, unit=stated_unit("\n".join(comments)))


def _cloud(table: np.ndarray, titles: dict[str, str]) -> Cloud:
    """A piece of the points, copied out of the file."""
    columns = {name: np.array(table[name]) for name in table.dtype.names or ()
               if not name.startswith(_PADDING)}
    if "rgb" in columns:
        packed = columns.pop("rgb")
        packed = packed.view(np.uint32) if packed.dtype == np.float32 else packed.astype(np.uint32)
        columns |= {"r": packed >> 16 & 255, "g": packed >> 8 & 255, "b": packed & 255}
    return Cloud.from_columns(columns, titles)


def _tables(path: Path, header: str, body: int) -> Iterator[np.ndarray]:
    """The points in pieces, structured by field; at least one piece, which may be empty.

    Raises:
        InputError: there are fewer points than the header declares.
    """
    from pypcd4 import MetaData, PointCloud

    meta = MetaData.parse_header(header.splitlines())
    dtype = meta.build_dtype()
    whole: Any = np.empty(0, dtype)
    with open(path, "rb") as stream:
        stream.seek(body)
        if meta.data.value == "ascii" and meta.points:
            listed, rows = 0, (line for line in stream if line.strip())
            while lines := list(islice(rows, PIECE_POINTS)):
                piece = np.loadtxt(lines, dtype, ndmin=1)
                listed += len(piece)
                yield piece
            if listed < meta.points:
                raise InputError(f"{path} announces {meta.points} points and lists {listed}.",
                                 "It is cut short, or its header is damaged.", "Export it again.")
            return
        if meta.data.value == "binary" and meta.points:
            whole = np.memmap(path, dtype, "r", body, (meta.points,))
        elif meta.points:
            content: Any = io.BytesIO(header.encode() + stream.read())
            whole = PointCloud.from_fileobj(content).pc_data
    for start in range(0, max(len(whole), 1), PIECE_POINTS):
        yield whole[start:start + PIECE_POINTS]


def _completed(path: Path, source: str) -> tuple[str, dict[str, str]]:
    """A PCD header as its package reads it, and the file's names of renamed fields.

    Versions before 0.7 lack entries; some programs end lines with blanks, or have special
    characters in the names of fields.
    """
    entries = {words[0]: words[1:] for line in source.splitlines()
               if (words := line.split()) and not words[0].startswith("#")}
    for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "DATA"):
        if not entries.get(key):
            raise InputError(f"The header of {path} has no entry {key}.",
                             "A PCD header needs this entry.", "Export it again.")
    fields = entries["FIELDS"]
    names = iter(property_names([title for title in fields if title != "_"]))
    renamed = [title if title == "_" else next(names) for title in fields]
    height = entries.get("HEIGHT") or ["1"]
    complete = {"VERSION": ["0.7"], "FIELDS": renamed, "SIZE": entries["SIZE"],
                "TYPE": entries["TYPE"], "COUNT": entries.get("COUNT") or ["1"] * len(fields),
                "WIDTH": entries["WIDTH"], "HEIGHT": height,
                "POINTS": entries.get("POINTS") or [str(int(entries["WIDTH"][0])
                                                        * int(height[0]))],
                "DATA": entries["DATA"]}
    return "".join(f"{key} {' '.join(words)}\n" for key, words in complete.items()), {
        name: title for name, title in zip(renamed, fields, strict=True) if name != title}
