"""Clouds as E57 files (ASTM E2807), read without a package: none has wheels for all systems.

A file consists of pages of 1,024 bytes, of which the last four are a checksum. Without them it is a
header, an XML text that lists the scans, and for each scan packets of numbers of a few bits each.
"""

import struct
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import require_size
from limber.geometry.cloud.cloud import Cloud

_NAMES = {"intensity": "intensity", "rowIndex": "row", "columnIndex": "column",
          "returnIndex": "return", "timeStamp": "time"}
_COLOURS = ("colorRed", "colorGreen", "colorBlue")
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_DATA_PACKET = 1


@dataclass(frozen=True)
class _Field:
    """A column: its name, bits per value, and meaning of its values."""

    name: str
    bits: int
    kind: str
    least: int = 0
    scale: float = 1.0
    offset: float = 0.0


def read_e57(path: Path) -> Cloud:
    """Return the points of all scans [m] in their common frame, with colour and scalars.

    Raises:
        InputError: the file is damaged, is compressed in a way that the standard leaves open, or
            has no scan with points.
    """
    content, page = _content(path)
    start, length = struct.unpack_from("<QQ", content, 24)
    text = content[_logical(start, page):_logical(start, page) + length]
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise _damaged(path, "its XML defines entities")
    try:
        # Without entities an XML text is no larger than its file.
        root = ElementTree.fromstring(text.decode("utf-8"))  # noqa: S314
    except (UnicodeDecodeError, ElementTree.ParseError) as error:
        raise _damaged(path, f"its XML is invalid ({error})") from error
    for each in root.iter():
        each.tag = each.tag.rpartition("}")[2]
    scans = [_scan(path, content, page, each) for each in root.findall("./data3D/vectorChild")]
    scans = [scan for scan in scans if len(scan)]
    if not scans:
        raise InputError(f"{path} has no scan with points.", "A point cloud was expected.",
                         "Export it again.")
    shared = set.intersection(*(set(scan.attributes) for scan in scans))
    return Cloud(np.concatenate([scan.points for scan in scans]),
                 {name: np.concatenate([scan.attributes[name] for scan in scans])
                  for name in scans[0].attributes if name in shared},
                 sum(scan.not_finite for scan in scans), unit="m")


def _content(path: Path) -> tuple[bytes, int]:
    """The file without the checksums of its pages, and the length of a page."""
    raw = np.frombuffer(path.read_bytes(), np.uint8)
    if len(raw) < 48 or raw[:8].tobytes() != b"ASTM-E57":
        raise _damaged(path, "it does not begin as E57 files do")
    _, _, _, _, page = struct.unpack_from("<QQQQQ", raw.tobytes()[:48], 8)
    if not 64 <= page <= 1 << 20 or page & (page - 1) or len(raw) % page:
        raise _damaged(path, "its size is not a whole number of pages")
    pages = raw.reshape(-1, page)
    wrong = checksums(pages[:, :-4]) != pages[:, -4:].copy().view(">u4").ravel()
    if wrong.any():
        raise _damaged(path, f"{int(wrong.sum())} of its {len(pages)} pages do not match their "
                       "checksums")
    return pages[:, :-4].tobytes(), int(page)


def checksums(pages: np.ndarray) -> np.ndarray:
    """Return the CRC-32C of each row of bytes, shape [n]."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = (table >> 1) ^ np.where(table & 1, np.uint32(0x82F63B78), np.uint32(0))
    found = np.full(len(pages), 0xFFFFFFFF, np.uint32)
    for column in pages.T:
        found = table[(found ^ column) & 255] ^ (found >> 8)
    return ~found


def _logical(physical: int, page: int) -> int:
    return physical // page * (page - 4) + physical % page


def _scan(path: Path, content: bytes, page: int, scan: ElementTree.Element) -> Cloud:
    points = scan.find("points")
    count = int(points.get("recordCount", 0)) if points is not None else 0
    if points is None or count == 0:
        return Cloud(np.empty((0, 3)))
    if len(points.findall("./codecs/vectorChild")):
        raise InputError(f"{path} has points of a codec of its own.", "Only the standard's plain "
                         "numbers are read.", "Export it as PLY or LAS with CloudCompare.")
    fields = [_field(each) for each in points.findall("./prototype/*")]
    bits = sum(field.bits for field in fields)
    require_size(path, count * max(bits, 1) / 8, len(content), f"{count} points")
    streams = _streams(path, content, page, int(points.get("fileOffset", 0)), len(fields))
    columns = {field.name: _values(path, field, stream, count)
               for field, stream in zip(fields, streams, strict=True)}
    return _cloud(path, columns, scan)


def _field(each: ElementTree.Element) -> _Field:
    kind = each.get("type", "")
    if kind == "Float":
        return _Field(each.tag, 32 if each.get("precision") == "single" else 64, kind)
    least, most = int(each.get("minimum", -2**63)), int(each.get("maximum", 2**63 - 1))
    return _Field(each.tag, max(most - least, 0).bit_length(), kind, least,
                  float(each.get("scale", 1.0)), float(each.get("offset", 0.0)))


def _streams(path: Path, content: bytes, page: int, offset: int, count: int) -> list[bytes]:
    """The bytes of each column, out of the packets of a section."""
    section = _logical(offset, page)
    kind, length, begin = struct.unpack_from("<BxxxxxxxQQ", content, section)
    at, end = _logical(begin, page), min(section + length, len(content))
    if kind != 1 or not section < at <= end:
        raise _damaged(path, "a section of points is none")
    parts: list[list[bytes]] = [[] for _ in range(count)]
    while at + 4 <= end:
        packet, _, size = struct.unpack_from("<BBH", content, at)
        if size < 3:
            raise _damaged(path, "a packet of points is shorter than its header")
        if packet == _DATA_PACKET:
            found, = struct.unpack_from("<H", content, at + 4)
            sizes = struct.unpack_from(f"<{found}H", content, at + 6)
            place = at + 6 + 2 * found
            if found != count or place + sum(sizes) > at + size + 1:
                raise _damaged(path, "a packet of points is longer than it says")
            for part, width in zip(parts, sizes, strict=True):
                part.append(content[place:place + width])
                place += width
        at += size + 1
    return [b"".join(part) for part in parts]


def _values(path: Path, field: _Field, stream: bytes, count: int) -> np.ndarray:
    """The numbers of a column, shape [count]."""
    if len(stream) * 8 < count * field.bits:
        raise _damaged(path, f"its column {field.name} ends early")
    if field.kind == "Float":
        return np.frombuffer(stream, "<f4" if field.bits == 32 else "<f8", count)
    at = np.arange(count, dtype=np.int64) * field.bits
    padded = np.frombuffer(stream + bytes(16), np.uint8)
    words = np.lib.stride_tricks.sliding_window_view(padded, 8)[at >> 3].copy().view("<u8").ravel()
    shift = (at & 7).astype(np.uint64)
    found = words >> shift
    if field.bits > 57:
        # Nine bytes: the last brings the uppermost bits.
        upper = padded[(at >> 3) + 8].astype(np.uint64)
        found |= np.where(shift > 0, upper << (np.uint64(64) - np.maximum(shift, 1)),
                          np.uint64(0))
    if field.bits < 64:
        found &= np.uint64((1 << field.bits) - 1)
    whole = found.astype(np.int64) + field.least
    return whole * field.scale + field.offset if field.kind == "ScaledInteger" else whole


def _cloud(path: Path, columns: dict[str, np.ndarray], scan: ElementTree.Element) -> Cloud:
    from scipy.spatial.transform import Rotation

    if set(_CARTESIAN) <= columns.keys():
        points = np.stack([columns[name] for name in _CARTESIAN], axis=1).astype(float)
        state = columns.get("cartesianInvalidState")
    elif set(_SPHERICAL) <= columns.keys():
        distance, azimuth, elevation = (columns[name].astype(float) for name in _SPHERICAL)
        flat = distance * np.cos(elevation)
        points = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth),
                           distance * np.sin(elevation)], axis=1)
        state = columns.get("sphericalInvalidState")
    else:
        raise InputError(f"{path} has a scan with the columns {', '.join(columns)}.",
                         "Cartesian or spherical coordinates were expected.", "Export it again.")
    seen = np.isfinite(points).all(axis=1) if state is None else state == 0
    turn = [float(scan.findtext(f"./pose/rotation/{axis}") or axis == "w") for axis in "xyzw"]
    shift = [float(scan.findtext(f"./pose/translation/{axis}") or 0) for axis in "xyz"]
    attributes = {_NAMES[name]: values[seen] for name, values in columns.items() if name in _NAMES}
    if set(_COLOURS) <= columns.keys():
        attributes["color"] = np.stack([columns[name] for name in _COLOURS], axis=1)[seen]
    return Cloud(Rotation.from_quat(turn).apply(points[seen]) + shift, attributes,
                 not_finite=int((~seen).sum()))


def _damaged(path: Path, seen: str) -> InputError:
    return InputError(f"{path} cannot be read: {seen}.",
                      "The file is damaged, or is not an E57 file.",
                      "Export it again, or as PLY or LAS with CloudCompare.")
