"""Units of LAS and LAZ files: what the records of their coordinate system say."""

import numpy as np
import pytest
from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct, WktCoordinateSystemVlr

from limber.core.errors import InputError
from limber.geometry.io.clouds import read_points, unit_of

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


def test_a_packed_file_states_its_unit_too(tmp_path, points):
    """Its points are read in a process of their own."""
    path = _written(tmp_path / "a.laz", points, _keys(_1024=1, _3076=9002))
    np.testing.assert_allclose(read_points(path).points, _FOOT * points, atol=1e-9)


@pytest.mark.parametrize("record", [WktCoordinateSystemVlr(_GEOGRAPHIC), _keys(_1024=2)])
def test_degrees_are_refused(tmp_path, points, record):
    with pytest.raises(InputError, match="degrees"):
        read_points(_written(tmp_path / "a.las", points, record))
