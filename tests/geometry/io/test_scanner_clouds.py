"""Clouds as laser scanners write them: PTX and E57, several scans, each with its own pose."""

import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limber.core.errors import InputError
from limber.geometry.cloud.preparation import gathered
from limber.geometry.io import clouds as clouds_module
from limber.geometry.io import e57 as e57_module
from limber.geometry.io.clouds import read_points
from limber.geometry.io.e57 import checksums

RNG = np.random.default_rng(5)
POINTS = RNG.uniform(-2, 2, (50, 3)).round(4)
TURN, SHIFT = Rotation.from_rotvec([0.2, -0.4, 1.1]), np.array([10.0, -4.0, 1.5])


def ptx(path, *, colour, silent=0, cut=0):
    """Two scans, the second turned and moved, with pixels that saw nothing."""
    lines = []
    for turn, shift in ((Rotation.identity(), np.zeros(3)), (TURN, SHIFT)):
        own = turn.inv().apply(POINTS - shift)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[3, :3] = turn.as_matrix().T, shift
        rows = [" ".join(f"{v:.9f}" for v in point) + " 0.25" + (" 9 8 7" if colour else "")
                for point in own] + ["0 0 0 0.5" + (" 0 0 0" if colour else "")] * silent
        lines += [str(len(rows)), "1", "0 0 0", "1 0 0", "0 1 0", "0 0 1",
                  *(" ".join(f"{v:.12f}" for v in row) for row in matrix), *rows]
    path.write_text("\n".join(lines[:len(lines) - cut]) + "\n")


@pytest.mark.parametrize(("colour", "silent"), [(False, 0), (True, 0), (True, 7)])
def test_ptx(tmp_path, colour, silent):
    """Both scans show the same points in their common frame."""
    ptx(tmp_path / "a.ptx", colour=colour, silent=silent)
    cloud = read_points(tmp_path / "a.ptx")
    np.testing.assert_allclose(cloud.points, np.vstack([POINTS, POINTS]), atol=1e-7)
    assert cloud.unit == "m" and cloud.not_finite == 2 * silent
    assert cloud.attributes["intensity"][0] == 0.25 and ("color" in cloud.attributes) == colour


def test_ptx_in_pieces(tmp_path, monkeypatch):
    """Pieces end within scans; a part of the points is kept; a row may not change its width."""
    ptx(tmp_path / "a.ptx", colour=True, silent=7)
    whole = read_points(tmp_path / "a.ptx")
    monkeypatch.setattr(clouds_module, "LINES_AT_ONCE", 8)
    pieces = read_points(tmp_path / "a.ptx")
    np.testing.assert_array_equal(pieces.points, whole.points)
    np.testing.assert_array_equal(pieces.attributes["color"], whole.attributes["color"])
    assert pieces.not_finite == 14
    monkeypatch.setattr(clouds_module, "gathered", lambda pieces: gathered(pieces, 30))
    some = read_points(tmp_path / "a.ptx")
    assert len(some) <= 30 and some.left_out == len(whole) - len(some) and some.unit == "m"
    lines = (tmp_path / "a.ptx").read_text().splitlines()
    lines[10 + 16:10 + 24] = [line.rsplit(" ", 1)[0] for line in lines[10 + 16:10 + 24]]
    (tmp_path / "a.ptx").write_text("\n".join(lines))
    with pytest.raises(InputError, match="6 columns instead of 7"):
        read_points(tmp_path / "a.ptx")


@pytest.mark.parametrize("text", [None, "3\n1\n0 0 0\n", "1 2 3\n4 5 6\n"])
def test_ptx_that_is_none(tmp_path, text):
    ptx(tmp_path / "a.ptx", colour=False, cut=3)
    if text is not None:
        (tmp_path / "a.ptx").write_text(text)
    with pytest.raises(InputError, match=r"cut short|header of a scan"):
        read_points(tmp_path / "a.ptx")


def packed(values, bits):
    """Whole numbers as E57 packs them: the lowest bit first."""
    held = sum(int(value) << (bits * k) for k, value in enumerate(values))
    return held.to_bytes((bits * len(values) + 7) // 8, "little")


FLOATS = ("".join(f'<cartesian{a} type="Float"/>' for a in "XYZ"),
          [POINTS[:, k].astype("<f8").tobytes() for k in range(3)])
SCALED = ("".join(f'<cartesian{a} type="ScaledInteger" minimum="-20000" maximum="20000" '
                  'scale="1e-4"/>' for a in "XYZ"),
          [packed(np.round(POINTS[:, k] * 1e4).astype(int) + 20000, 16) for k in range(3)])
WIDE = ("".join(f'<cartesian{a} type="ScaledInteger" minimum="{-2**60}" maximum="{2**60}" '
                'scale="1e-4"/>' for a in "XYZ"),
        [packed([int(v) + 2**60 for v in np.round(POINTS[:, k] * 1e4)], 62) for k in range(3)])
SPHERES = ("".join(f'<spherical{a} type="Float"/>' for a in ("Range", "Azimuth", "Elevation")),
           [column.astype("<f8").tobytes() for column in (
               np.linalg.norm(POINTS, axis=1), np.arctan2(POINTS[:, 1], POINTS[:, 0]),
               np.arcsin(POINTS[:, 2] / np.linalg.norm(POINTS, axis=1)))])


def e57(path, columns, extra=("", ()), pose=""):
    """One scan, its points in two packets that part each column's bytes anywhere."""
    prototype, streams = columns[0] + extra[0], [*columns[1], *extra[1]]
    body = b""
    for half in (0, 1):
        parts = [s[:len(s) // 3] if half == 0 else s[len(s) // 3:] for s in streams]
        packet = struct.pack(f"<H{len(parts)}H", len(parts), *map(len, parts)) + b"".join(parts)
        packet += bytes(-(len(packet) + 4) % 4)
        body += struct.pack("<BBH", 1, 0, len(packet) + 3) + packet
    section = struct.pack("<BxxxxxxxQQQ", 1, 32 + len(body), 48 + 32, 0) + body
    xml = ('<?xml version="1.0"?><e57Root type="Structure" xmlns="urn:e57"><data3D type="Vector">'
           f'<vectorChild type="Structure">{pose}<points type="CompressedVector" fileOffset="48" '
           f'recordCount="{len(POINTS)}"><prototype type="Structure">{prototype}</prototype>'
           '<codecs type="Vector"/></points></vectorChild></data3D></e57Root>').encode()
    logical = 48 + len(section)
    content = struct.pack("<8sIIQQQQ", b"ASTM-E57", 1, 0, 0, logical // 1020 * 1024
                          + logical % 1020, len(xml), 1024) + section + xml
    pages = np.frombuffer(content + bytes(-len(content) % 1020), np.uint8).reshape(-1, 1020)
    path.write_bytes(np.hstack([pages, checksums(pages).astype(">u4")[:, None].view(np.uint8)]
                               ).tobytes())


def test_checksums_are_those_of_the_standard():
    """CRC-32C of the digits 1 to 9, from RFC 3720's kin."""
    assert checksums(np.frombuffer(b"123456789", np.uint8)[None])[0] == 0xE3069283


@pytest.mark.parametrize("columns", [FLOATS, SCALED, WIDE, SPHERES])
def test_e57(tmp_path, columns):
    """Plain, scaled and spherical coordinates, moved by the scan's pose."""
    x, y, z, w = TURN.as_quat()
    pose = (f"<pose><rotation><w>{w}</w><x>{x}</x><y>{y}</y><z>{z}</z></rotation><translation>"
            "<x>10</x><y>-4</y><z>1.5</z></translation></pose>")
    colours = ("".join(f'<color{c} type="Integer" minimum="0" maximum="255"/>'
                       for c in ("Red", "Green", "Blue")), [bytes([value] * 50) for value in
                                                            (9, 8, 7)])
    e57(tmp_path / "a.e57", columns, colours, pose)
    cloud = read_points(tmp_path / "a.e57")
    np.testing.assert_allclose(cloud.points, TURN.apply(POINTS) + SHIFT, atol=1e-9)
    assert cloud.unit == "m" and cloud.attributes["color"].tolist() == [[9, 8, 7]] * 50


def test_e57_without_what_was_not_seen(tmp_path):
    """Points that the scanner marks as invalid are left out and counted."""
    state = np.arange(50) % 5 == 0
    e57(tmp_path / "a.e57", FLOATS, (
        '<cartesianInvalidState type="Integer" minimum="0" maximum="2"/>',
        [packed(2 * state, 2)]))
    cloud = read_points(tmp_path / "a.e57")
    np.testing.assert_array_equal(cloud.points, POINTS[~state])
    assert cloud.not_finite == 10


@pytest.mark.parametrize("columns", [FLOATS, SCALED, WIDE])
def test_e57_in_pieces(tmp_path, monkeypatch, columns):
    """Pieces end between packets, and in the middle of bytes; a part of the points is kept."""
    colours = ("".join(f'<color{c} type="Integer" minimum="0" maximum="7"/>'
                       for c in ("Red", "Green", "Blue")), [packed(np.arange(50) % 7, 3)] * 3)
    e57(tmp_path / "a.e57", columns, colours)
    whole = read_points(tmp_path / "a.e57")
    monkeypatch.setattr(e57_module, "PIECE_POINTS", 5)
    monkeypatch.setattr(e57_module, "gathered", lambda pieces: gathered(pieces, 50))
    pieces = read_points(tmp_path / "a.e57")
    np.testing.assert_array_equal(pieces.points, whole.points)
    np.testing.assert_array_equal(pieces.attributes["color"][:, 0], np.arange(50) % 7)
    monkeypatch.setattr(e57_module, "gathered", lambda pieces: gathered(pieces, 20))
    some = read_points(tmp_path / "a.e57")
    assert len(some) <= 20 and some.left_out == 50 - len(some)


def test_e57_that_nobody_saw(tmp_path):
    """Every point is invalid, or a number has more bits than there are."""
    state = '<cartesianInvalidState type="Integer" minimum="0" maximum="2"/>'
    e57(tmp_path / "a.e57", FLOATS, (state, [packed([2] * 50, 2)]))
    with pytest.raises(InputError, match="valid coordinates"):
        read_points(tmp_path / "a.e57")
    e57(tmp_path / "b.e57", FLOATS, (state.replace('"2"', f'"{2**70}"'), [bytes(450)]))
    with pytest.raises(InputError, match="64 bits"):
        read_points(tmp_path / "b.e57")


@pytest.mark.parametrize("at", [9, 100, 700, 1500])
def test_damaged_e57_is_refused(tmp_path, at):
    """A changed byte does not match the page's checksum; a cut file is no whole number of pages."""
    e57(tmp_path / "a.e57", FLOATS)
    raw = bytearray((tmp_path / "a.e57").read_bytes())
    raw[at] ^= 4
    (tmp_path / "a.e57").write_bytes(raw)
    with pytest.raises(InputError, match="checksums"):
        read_points(tmp_path / "a.e57")
    (tmp_path / "a.e57").write_bytes(raw[:-at])
    with pytest.raises(InputError, match="pages"):
        read_points(tmp_path / "a.e57")
