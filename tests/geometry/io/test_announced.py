"""Headers that speak of more points than the file holds are refused before memory is taken."""

import struct

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.io.clouds import las_columns, read_points
from limber.geometry.io.isolated_readers import read_apart

PLY = "ply\nformat {form} 1.0\nelement vertex {count}\nproperty float x\nproperty float y\n" \
      "property float z\nend_header\n"
PCD = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {count}\nHEIGHT 1\n" \
      "POINTS {count}\nDATA {form}\n"


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply(tmp_path, form):
    """As text and binary: billions are refused, as many as there are are read."""
    path = tmp_path / "a.ply"
    body = b"1 2 3\n4 5 6" if form == "ascii" else np.arange(
        6, dtype=">f4" if "big" in form else "<f4").tobytes()
    path.write_bytes(PLY.format(form=form, count=2).encode() + body)
    assert len(read_points(path)) == 2
    path.write_bytes(PLY.format(form=form, count=4_000_000_000).encode() + body)
    with pytest.raises(InputError, match="announces"):
        read_points(path)


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_pcd(tmp_path, form):
    """Likewise, and compressed points whose sizes are mangled."""
    path = tmp_path / "a.pcd"
    body = b"1 2 3\n" if form == "ascii" else struct.pack("<II", 12, 4_000_000_000) + bytes(12)
    path.write_bytes(PCD.format(form=form, count=300_000_000).encode() + body)
    with pytest.raises(InputError, match="announces"):
        read_points(path)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las(tmp_path, suffix):
    """Read as written; with a mangled count refused by the header alone."""
    import laspy

    content = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    content.x, content.y, content.z = np.arange(30.0).reshape(3, 10)
    path = tmp_path / f"a{suffix}"
    content.write(str(path))
    np.testing.assert_allclose(read_points(path).points[:, 0], np.arange(10.0), atol=0.01)
    raw = bytearray(path.read_bytes())
    struct.pack_into("<I", raw, 107, 2_000_000_000)
    path.write_bytes(raw)
    with pytest.raises(InputError, match="announces"):
        read_points(path)


@pytest.mark.slow
def test_a_reader_apart_tells_what_went_wrong(tmp_path):
    """An error of a package in the other process arrives as one of ours."""
    path = tmp_path / "a.laz"
    path.write_bytes(b"LASF" + bytes(400))
    with pytest.raises(InputError, match=r"a\.laz cannot be read"):
        read_apart(las_columns, path)


def test_vertices_of_two_numbers(tmp_path):
    """They are no places."""
    path = tmp_path / "a.obj"
    path.write_text("v 1 2\nv 2 3\nv 3 4\nf 1 2 3\n")
    with pytest.raises(InputError):
        read_points(path)


def test_the_largest_number_means_no_reading(tmp_path):
    """Drivers write it where a pixel saw nothing: those points are left out and counted."""
    path = tmp_path / "a.xyz"
    path.write_text("1 2 3\n4 5 6\n3.4e38 3.4e38 3.4e38\n")
    cloud = read_points(path)
    assert len(cloud) == 2 and cloud.not_finite == 1
