"""Clouds as laser scanners write them: PTX and E57, several scans, each with its own pose."""

import numpy as np
import pytest
from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct, WktCoordinateSystemVlr

from benchmarks.foreign_files import (
    FLOATS,
    POINTS,
    SCALED,
    SHIFT,
    SPHERES,
    TURN,
    WIDE,
    e57,
    packed,
    ptx,
)
from limber.core.errors import InputError
from limber.geometry.cloud.preparation import gathered
from limber.geometry.io import clouds as clouds_module
from limber.geometry.io import e57 as e57_module
from limber.geometry.io.clouds import read_points, unit_of
from limber.geometry.io.e57 import checksums


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
    monkeypatch.setattr(clouds_module.text_columns, "LINES_AT_ONCE", 8)
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


# Units of LAS and LAZ files: what the records of their coordinate system say.

_FOOT, _SURVEY = 0.3048, 1200 / 3937
_GEOGRAPHIC = ('GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.25]],'
               'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]')
_PLANE = ('PROJCS["a plane",{geographic},PROJECTION["Lambert"],PARAMETER["false_easting",0],'
          'UNIT["{name}",{size!r}],AXIS["X",EAST],AXIS["Y",NORTH]]')
_HEIGHT = 'VERT_CS["NAVD88",VERT_DATUM["North American",2005],UNIT["{name}",{size!r}]]'
_NEW = ('PROJCRS["a plane",BASEGEOGCRS["WGS 84",DATUM["World",ELLIPSOID["WGS 84",6378137,298.25,'
        'LENGTHUNIT["metre",1]]]],CONVERSION["a",METHOD["b"],PARAMETER["False easting",0,'
        'LENGTHUNIT["metre",1]]],CS[Cartesian,2],AXIS["e",east],LENGTHUNIT["US survey foot",'
        '0.304800609601219]]')


def _plane(name, size):
    return _PLANE.format(geographic=_GEOGRAPHIC, name=name, size=size)


def _keys(**values):
    record = GeoKeyDirectoryVlr()
    record.geo_keys_header.number_of_keys = len(values)
    record.geo_keys = [GeoKeyEntryStruct(int(key[1:]), 0, 1, value)
                       for key, value in values.items()]
    return record


@pytest.fixture
def points():
    return np.random.default_rng(2).uniform(0, 3, (50, 3)).round(3)


def _written(path, points, *records):
    import laspy

    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = [1e-3] * 3
    header.vlrs.extend(records)
    content = laspy.LasData(header)
    content.x, content.y, content.z = points.T
    content.write(path)
    return path


@pytest.mark.parametrize(("record", "metres"), [
    (WktCoordinateSystemVlr(_plane("metre", 1)), (1, 1)),
    (WktCoordinateSystemVlr(_plane("US survey foot", _SURVEY)), (_SURVEY, _SURVEY)),
    (WktCoordinateSystemVlr(f"COMPD_CS[\"both\",{_plane('metre', 1)},"
                            f"{_HEIGHT.format(name='foot', size=_FOOT)}]"), (1, _FOOT)),
    (WktCoordinateSystemVlr(_NEW), (0.304800609601219, 0.304800609601219)),
    (_keys(_1024=1, _3072=2225, _3076=9003, _4099=9002), (_SURVEY, _FOOT)),
    (_keys(_1024=1, _3076=9001), (1, 1))])
def test_units_that_are_spelt_out(tmp_path, points, record, metres):
    """Old and new WKT and GeoTIFF keys; heights may have a unit of their own."""
    cloud = read_points(_written(tmp_path / "a.las", points, record))
    np.testing.assert_allclose(cloud.points, points * [metres[0], metres[0], metres[1]], atol=1e-9)
    assert cloud.unit == "m" and bool(cloud.notes) == (metres != (1, 1))
    assert unit_of(cloud, None)[0] == "m"


@pytest.mark.parametrize("record", [
    None, _keys(_1024=1, _3072=32633), _keys(_3076=9093),
    WktCoordinateSystemVlr(_plane("chain", 20.1168))])
def test_units_that_are_not(tmp_path, points, record):
    """The coordinates stay as they are, and the unit is unknown."""
    cloud = read_points(_written(tmp_path / "a.las", points, *[record] * (record is not None)))
    np.testing.assert_allclose(cloud.points, points, atol=1e-9)
    assert cloud.unit is None


@pytest.mark.parametrize("record", [WktCoordinateSystemVlr(_GEOGRAPHIC), _keys(_1024=2)])
def test_degrees_are_refused(tmp_path, points, record):
    with pytest.raises(InputError, match="degrees"):
        read_points(_written(tmp_path / "a.las", points, record))
