"""Clouds as E57 files (ASTM E2807), read without a package: none has wheels for all systems.

A file consists of pages of 1,024 bytes, of which the last four are a checksum. Without them it is a
header, an XML text that lists the scans, and for each scan packets of numbers of a few bits each.
"""

import itertools
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import require_size
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import PIECE_POINTS, gathered

_NAMES = {"intensity": "intensity", "rowIndex": "row", "columnIndex": "column",
          "returnIndex": "return", "timeStamp": "time"}
_COLOURS = ("colorRed", "colorGreen", "colorBlue")
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_DATA_PACKET = 1
_MOST_BITS = 64
_BLOCK = 1 << 24  # bytes whose checksums are compared at once


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
    """Return the points of all scans [m] in their common frame, thinned by :func:`gathered`.
    InputError if damaged, empty, or of a compression that the standard leaves open."""
    pages = _Pages(path)
    pages.check()
    start, length = struct.unpack("<QQ", pages.read(24, 16))
    text = pages.read(pages.logical(start), length)
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise ValueError("its XML defines entities")
    try:
        # Without entities an XML text is no larger than its file.
        root = ElementTree.fromstring(text.decode("utf-8"))  # noqa: S314
    except (UnicodeDecodeError, ElementTree.ParseError) as error:
        raise ValueError(f"its XML is invalid ({error})") from error
    for each in root.iter():
        each.tag = each.tag.rpartition("}")[2]
    scans = [_Scan(pages, each) for each in root.findall("./data3D/vectorChild")]
    scans = [scan for scan in scans if scan.count]
    if not scans:
        raise ValueError("it has no scan with points")
    cloud = gathered(piece for scan in scans for piece in scan.pieces())
    if not len(cloud):
        raise ValueError("no point has valid coordinates: all are marked as not seen")
    return replace(cloud, unit="m")


class _Pages:
    """The content of a file without the checksums of its pages; ``size`` is without them
    [bytes]."""

    def __init__(self, path: Path):
        self.path = path
        size = path.stat().st_size
        with open(path, "rb") as stream:
            head = stream.read(48)
        if len(head) < 48 or head[:8] != b"ASTM-E57":
            raise ValueError("it does not begin as E57 files do")
        _, _, _, _, self._page = struct.unpack_from("<QQQQQ", head, 8)
        if not 64 <= self._page <= 1 << 20 or self._page & (self._page - 1) or size % self._page:
            raise ValueError("its size is not a whole number of pages")
        self._count = size // self._page
        self.size = self._count * (self._page - 4)

    def check(self) -> None:
        """Compare the pages with their checksums."""
        wrong, at_once = 0, max(_BLOCK // self._page, 1)
        for first in range(0, self._count, at_once):
            pages = self._pages(first, first + at_once)
            wrong += int((checksums(pages[:, :-4]) != pages[:, -4:].copy().view(">u4").ravel()
                          ).sum())
        if wrong:
            raise ValueError(f"{wrong} of its {self._count} pages do not match their checksums")

    def logical(self, physical: int) -> int:
        """Return the place without checksums of a place in the file."""
        return physical // self._page * (self._page - 4) + physical % self._page

    def read(self, start: int, length: int) -> bytes:
        """Return some bytes from ``start``, a place without checksums; fewer at the end."""
        inner = self._page - 4
        end = min(start + length, self.size)
        if not 0 <= start < end:
            return b""
        first = start // inner
        pages = self._pages(first, -(-end // inner))
        return pages[:, :-4].tobytes()[start - first * inner:end - first * inner]

    def _pages(self, first: int, end: int) -> np.ndarray:
        with open(self.path, "rb") as stream:
            stream.seek(first * self._page)
            return np.frombuffer(stream.read((end - first) * self._page), np.uint8).reshape(
                -1, self._page)


def checksums(pages: np.ndarray) -> np.ndarray:
    """Return the CRC-32C of each row of bytes, shape [n]."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = (table >> 1) ^ np.where(table & 1, np.uint32(0x82F63B78), np.uint32(0))
    found = np.full(len(pages), 0xFFFFFFFF, np.uint32)
    for column in pages.T:
        found = table[(found ^ column) & 255] ^ (found >> 8)
    return ~found


class _Scan:
    """One scan of a file: the ``count`` of its points."""

    def __init__(self, pages: _Pages, scan: ElementTree.Element):
        self._pages, self._scan = pages, scan
        points = scan.find("points")
        self.count = int(points.get("recordCount", 0)) if points is not None else 0
        if points is None or self.count == 0:
            return
        if len(points.findall("./codecs/vectorChild")):
            raise InputError(f"{pages.path} has points of a codec of its own.", "Only the "
                             "standard's plain numbers are read.",
                             "Export it as PLY or LAS with CloudCompare.")
        self._fields = [_field(each) for each in points.findall("./prototype/*")]
        self._offset = int(points.get("fileOffset", 0))
        bits = sum(field.bits for field in self._fields)
        if any(field.bits > _MOST_BITS for field in self._fields):
            raise ValueError("it has integers of more than 64 bits")
        require_size(pages.path, self.count * max(bits, 1) / 8, pages.size, f"{self.count} points")

    def pieces(self) -> Iterator[Cloud]:
        """Yield some points after the other [m] in the common frame."""
        held = [bytearray() for _ in self._fields]
        left = self.count
        for packet in _packets(self._pages, self._offset, len(held)):
            for stream, part in zip(held, packet, strict=True):
                stream += part
            ready = min((8 * len(stream) // field.bits for field, stream in zip(
                self._fields, held, strict=True) if field.bits), default=0)
            if PIECE_POINTS <= ready < left:
                # A multiple of eight values of any number of bits ends with a whole byte.
                count = ready - ready % 8
                yield self._taken(held, count)
                left -= count
        yield self._taken(held, left)

    def _taken(self, held: list[bytearray], count: int) -> Cloud:
        columns = {}
        for field, stream in zip(self._fields, held, strict=True):
            size = -(-count * field.bits // 8)
            columns[field.name] = _values(field, bytes(stream[:size]), count)
            del stream[:size]
        return _cloud(columns, self._scan)


def _field(each: ElementTree.Element) -> _Field:
    kind = each.get("type", "")
    if kind == "Float":
        return _Field(each.tag, 32 if each.get("precision") == "single" else 64, kind)
    least, most = int(each.get("minimum", -2**63)), int(each.get("maximum", 2**63 - 1))
    return _Field(each.tag, max(most - least, 0).bit_length(), kind, least,
                  float(each.get("scale", 1.0)), float(each.get("offset", 0.0)))


def _packets(pages: _Pages, offset: int, count: int) -> Iterator[list[bytes]]:
    """Yield the bytes of each column in each packet of a section."""
    section = pages.logical(offset)
    kind, length, begin = struct.unpack("<BxxxxxxxQQ", pages.read(section, 24))
    at, end = pages.logical(begin), min(section + length, pages.size)
    if kind != 1 or not section < at <= end:
        raise ValueError("a section of points is none")
    while at + 4 <= end:
        packet, _, size = struct.unpack("<BBH", pages.read(at, 4))
        if size < 3:
            raise ValueError("a packet of points is shorter than its header")
        if packet == _DATA_PACKET:
            content = pages.read(at, size + 1)
            found, = struct.unpack_from("<H", content, 4)
            sizes = struct.unpack_from(f"<{found}H", content, 6)
            place = 6 + 2 * found
            if found != count or place + sum(sizes) > len(content):
                raise ValueError("a packet of points is longer than it says")
            ends = place + np.cumsum((0, *sizes))
            yield [content[a:b] for a, b in itertools.pairwise(ends)]
        at += size + 1


def _values(field: _Field, stream: bytes, count: int) -> np.ndarray:
    """The numbers of a column, shape [count]."""
    if len(stream) * 8 < count * field.bits:
        raise ValueError(f"its column {field.name} ends early")
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


def _cloud(columns: dict[str, np.ndarray], scan: ElementTree.Element) -> Cloud:
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
        raise ValueError(f"a scan has neither Cartesian nor spherical coordinates, but "
                         f"{', '.join(columns)}")
    seen = np.isfinite(points).all(axis=1) if state is None else state == 0
    turn = [float(scan.findtext(f"./pose/rotation/{axis}") or axis == "w") for axis in "xyzw"]
    shift = [float(scan.findtext(f"./pose/translation/{axis}") or 0) for axis in "xyz"]
    attributes = {_NAMES[name]: values[seen] for name, values in columns.items()
                  if name in _NAMES}
    if set(_COLOURS) <= columns.keys():
        attributes["color"] = np.stack([columns[name] for name in _COLOURS], axis=1)[seen]
    return Cloud(Rotation.from_quat(turn).apply(points[seen]) + shift, attributes,
                 not_finite=int((~seen).sum()))

