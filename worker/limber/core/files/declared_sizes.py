"""Comparison of a cloud file's declared size with its actual one, before it is read.

The packages that read PLY, PCD and LAS allocate memory for the points that a header declares; a
corrupt header may declare billions.
"""

import os
import re
import struct
from pathlib import Path

from limber.core.errors import InputError
from limber.core.files.reading import HARMLESS_BYTES, require_size

_PLY_BYTES = {"char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2,
              "uint16": 2, "int": 4, "uint": 4, "int32": 4, "uint32": 4, "float": 4, "float32": 4,
              "double": 8, "float64": 8}
_LONGEST_HEADER = 1 << 20
_LZF_EXPANSION = 90.0
"""A byte of LZF expands to at most 264 / 3 bytes."""
_LAZ_EXPANSION = 1000.0


def check_ply(path: Path) -> None:
    """Refuse a PLY file that holds fewer elements than its header declares.

    Raises:
        InputError: it holds fewer.
    """
    lines, body = _text_header(path, b"end_header")
    is_text, announced, count, width = False, 0.0, 0, 0
    for words in [line.split() for line in lines] + [["element", "", "0"]]:
        if words[:1] == ["format"]:
            is_text = words[1:2] == ["ascii"]
        elif words[:1] == ["element"]:
            announced += count * width
            count, width = _count(path, words[2] if len(words) > 2 else ""), 0
        elif words[:1] == ["property"] and len(words) > 2:
            kind = words[2] if words[1] == "list" else words[1]
            # As text a value takes at least one digit and a separator.
            width += 2 if is_text else _PLY_BYTES.get(kind, 1)
    held = path.stat().st_size - body
    # The last value of a text needs no separator.
    require_size(path, announced, held + is_text, "its elements")


def check_pcd(path: Path) -> None:
    """Refuse a PCD file that holds fewer points than its header declares.

    Raises:
        InputError: it holds fewer.
    """
    lines, body = _text_header(path, b"\nDATA")
    header = {words[0]: words[1:] for line in lines if (words := line.split())}
    count = max(_count(path, word) for word in
                (header.get("POINTS") or ["0"])[:1] + (header.get("WIDTH") or ["0"])[:1])
    if header.get("WIDTH") and header.get("HEIGHT"):
        count = max(count, _count(path, header["WIDTH"][0]) * _count(path, header["HEIGHT"][0]))
    sizes = [_count(path, word) for word in header.get("SIZE", [])]
    repeats = [_count(path, word) for word in header.get("COUNT", [])] or [1] * len(sizes)
    kind = (header.get("DATA") or [""])[0]
    held = float(path.stat().st_size - body)
    if kind == "ascii":
        require_size(path, 2.0 * count * sum(repeats), held + 1, f"{count} points")
        return
    width = sum(size * repeat for size, repeat in zip(sizes, repeats, strict=False))
    if kind == "binary_compressed":
        with open(path, "rb") as stream:
            stream.seek(body)
            head = stream.read(8)
        packed, whole = struct.unpack("<II", head) if len(head) == 8 else (0, 0)
        require_size(path, packed, held - 8, "compressed points")
        require_size(path, whole, _LZF_EXPANSION * held, "compressed points")
        held = float(whole)
    require_size(path, float(count * width), held, f"{count} points")


def check_las(path: Path) -> None:
    """Refuse a LAS or LAZ file that holds fewer points than its header declares.

    Raises:
        InputError: it holds fewer, or it is not such a file.
    """
    size = path.stat().st_size
    with open(path, "rb") as stream:
        head = stream.read(375)
    if len(head) < 227 or head[:4] != b"LASF":
        raise InputError(f"{path} is not a LAS file.", "It does not begin with the LAS signature.",
                         "Export it again.")
    minor = head[25]
    start, record_count = struct.unpack_from("<II", head, 96)
    form, width, count = struct.unpack_from("<BHI", head, 104)
    if minor >= 4 and len(head) >= 255:
        extended_start, extended = struct.unpack_from("<QI", head, 235)
        count = max(count, struct.unpack_from("<Q", head, 247)[0])
        require_size(path, 60.0 * extended, max(size - extended_start, 0), "extended records")
    require_size(path, start, size, "an offset to its points")
    require_size(path, 54.0 * record_count, start, "its variable records")
    is_packed = bool(form & 0xC0)
    held = (size - start) * (_LAZ_EXPANSION if is_packed else 1.0)
    require_size(path, float(count) * max(width, 1), held, f"{count} points")
    if is_packed and count * width > HARMLESS_BYTES:
        require_size(path, float(count) * width, 100.0 * (size - start), f"{count} points")


def _text_header(path: Path, end: bytes) -> tuple[list[str], int]:
    """Return the lines of a header up to the line of ``end``, and its end position."""
    head, stop = header_bytes(path, end)
    return re.split(r"[\r\n]+", head.decode("latin-1").rstrip("\r\n")), stop


def header_bytes(path: Path, end: bytes) -> tuple[bytes, int]:
    """Return a header up to and including the line of ``end``, and its end position.

    Raises:
        InputError: there is no such line.
    """
    with open(path, "rb") as stream:
        head = stream.read(_LONGEST_HEADER)
    at = head.find(end)
    stop = head.find(b"\n", at + 1) if at >= 0 else -1
    if stop < 0:
        raise InputError(f"{path} has no header.",
                         "It is cut short, or its suffix does not match its content.",
                         "Export it again.")
    return head[:stop + 1], stop + 1


def _count(path: str | os.PathLike, word: str) -> int:
    if not re.fullmatch(r"\d{1,18}", word):
        raise InputError(f"{path} has {word[:30]!r} where a count was expected.",
                         "Its header is damaged.", "Export it again.")
    return int(word)
