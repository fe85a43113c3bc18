"""Clouds as PCD files, of all versions."""

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.core.files.column_titles import stated_unit
from limber.core.files.declared_sizes import header_bytes
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.columns import property_names

_PADDING = "#$%&~~"  # prefix by which pypcd4 names fields that are called _


def read_pcd(path: Path) -> Cloud:
    """Return the points of a PCD file, with the file's own names of renamed columns."""
    from pypcd4 import PointCloud

    stream, titles = _stream(path)
    content = PointCloud.from_fileobj(stream)
    listed = len(content.pc_data)
    if listed < content.points:
        raise InputError(f"{path} announces {content.points} points and lists {listed}.",
                         "It is cut short, or its header is damaged.", "Export it again.")
    columns = {name: np.asarray(content.pc_data[name]).ravel() for name in content.fields
               if not name.startswith(_PADDING)}
    if "rgb" in columns:
        packed = columns.pop("rgb")
        packed = packed.view(np.uint32) if packed.dtype == np.float32 else packed.astype(np.uint32)
        columns |= {"r": packed >> 16 & 255, "g": packed >> 8 & 255, "b": packed & 255}
    comments = [line for line in header_bytes(path, b"\nDATA")[0].decode(
        "utf-8", "replace").splitlines() if line.startswith("#")]
    return replace(Cloud.from_columns(columns, titles), unit=stated_unit("\n".join(comments)))


def _stream(path: Path) -> tuple[Any, dict[str, str]]:
    """A PCD file as its package reads it, and the file's names of renamed fields.

    Versions before 0.7 lack entries of the header; some programs end lines with blanks, or have
    special characters in the names of fields.
    """
    raw, body = header_bytes(path, b"\nDATA")
    source_header = {words[0]: words[1:] for line in raw.decode("utf-8", "replace").splitlines()
                     if (words := line.split()) and not words[0].startswith("#")}
    for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "DATA"):
        if not source_header.get(key):
            raise InputError(f"The header of {path} has no entry {key}.",
                             "A PCD header needs this entry.", "Export it again.")
    fields = source_header["FIELDS"]
    own = [title for title in fields if title != "_"]
    names = iter(property_names(own))
    renamed = [title if title == "_" else next(names) for title in fields]
    size = int(source_header["WIDTH"][0]) * int(source_header.get("HEIGHT", "1")[0])
    new_header = {"VERSION": ["0.7"], "FIELDS": renamed, "SIZE": source_header["SIZE"],
                  "TYPE": source_header["TYPE"],
                  "COUNT": source_header.get("COUNT") or ["1"] * len(fields),
                  "WIDTH": source_header["WIDTH"],
                  "HEIGHT": source_header.get("HEIGHT") or ["1"],
                  "POINTS": source_header.get("POINTS")
                  or [str(size)],
                  "DATA": source_header["DATA"]}
    header = "".join(f"{key} {' '.join(words)}\n" for key, words in new_header.items()).encode()
    with open(path, "rb") as stream:
        stream.seek(body)
        points = stream.read()
    if source_header["DATA"][0] == "ascii":
        points = b"\n".join(b" ".join(line.split()) for line in points.splitlines())
    return io.BytesIO(header + points), {
        name: title for name, title in zip(renamed, fields, strict=True) if name != title}
