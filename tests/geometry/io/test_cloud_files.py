"""Readers: every format gives the same points, and bad files are named."""

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from benchmarks.foreign_files import CLOUD as POINTS
from benchmarks.foreign_files import CLOUDS
from limber.core.errors import InputError
from limber.geometry.io import isolated_readers
from limber.geometry.io.clouds import las_columns, read_cloud, read_points
from limber.geometry.io.depth_images import read_depth
from limber.geometry.io.isolated_readers import read_apart


@pytest.mark.parametrize("name", CLOUDS)
def test_each_format_gives_the_points(tmp_path, name):
    """Positions agree to the precision of the format's own numbers."""
    path = tmp_path / name
    CLOUDS[name](path)
    np.testing.assert_allclose(read_points(path).points, POINTS, atol=2e-5)


def test_units_become_metres(tmp_path):
    """A file in millimetres is read in metres."""
    path = tmp_path / "a.xyz"
    np.savetxt(path, POINTS * 1000)
    np.testing.assert_allclose(read_cloud(path, unit="mm").points, POINTS, atol=1e-9)


@pytest.mark.parametrize(("name", "content", "complaint"), [
    ("a.xyz", b"", "is empty"),
    ("a.xyz", b"# only a comment\n", "no lines"),
    ("a.xyz", b"1 2 3\n4 5\n", "line 2 has 2 values"),
    ("a.xyz", b"1 2 3\n4 five 6\n", "line 2: 'five' is not a number"),
    ("a.xyz", b"nan 2 3\n4 nan 6\n", "finite"),
    ("a.csv", b"x,y,w\n1,2,3\n", "z are missing"),
    ("a.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\n"
              b"property float y\nproperty float z\nend_header\n1234", "announces"),
    ("a.pcd", b"nonsense", "no header"),
    ("a.laz", b"nonsense", "not a LAS"),
    ("a.docx", b"nonsense", "suffix"),
])
def test_bad_files_are_named(tmp_path, name, content, complaint):
    """Empty, cut short, non-numeric, not finite, unknown: an error that says which and where."""
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=complaint):
        read_points(path)


@pytest.mark.parametrize(("name", "content"), [
    ("a.csv", "x;y;z\n1,5;2,0;3,25\n4;5;6,5\n"), ("a.txt", "x\ty\tz\n1,5\t2,0\t3,25\n4\t5\t6,5\n"),
    ("a.xyz", "1,5 2,0 3,25\n4,0 5,0 6,5\n"), ("a.csv", "x, y, z\n1.5, 2, 3.25\n4, 5, 6.5\n"),
    ("a.csv", "Easting,Northing,Height\n1.5,2,3.25\n4,5,6.5\n"),
    ("a.csv", "x [m],y [m],z [m]\n1.5,2,3.25\n4,5,6.5\n"),
    ("a.csv", '"Points:0","Points:1","Points:2"\n"1.5","2","3.25"\n"4","5","6.5"\n'),
    ("a.csv", "x,y,z,\n1.5,2,3.25,\n4,5,6.5,\n"), ("a.pts", "2\n1.5 2 3.25\n4 5 6.5\n"),
    ("a.csv", "id,z,y,x\n0,3.25,2,1.5\n1,6.5,5,4\n"),
    ("a.asc", "//X Y Z R G B Scalar_field_#1\n2\n1.5 2 3.25 9 8 7 0.5\n4 5 6.5 9 8 7 0.5\n"),
    ("a.pts", "1\n1.5 2 3.25 -900 9 8 7\n1\n4 5 6.5 -900 9 8 7\n"),
])
def test_text_as_programs_write_it(tmp_path, name, content):
    """Decimal commas, headers with units or other names, quotes, closing separators, counts."""
    for coding in ("utf-8", "utf-8-sig", "utf-16"):
        (tmp_path / name).write_bytes(content.encode(coding))
        np.testing.assert_array_equal(
            read_points(tmp_path / name).points, [[1.5, 2, 3.25], [4, 5, 6.5]])


def test_a_line_of_colmap_that_is_cut(tmp_path):
    """Rows are not of one length, as the images that saw a point follow it."""
    text = (Path(__file__).parents[2] / "data" / "tour" / "points3D.txt").read_text()
    for content, told in ((text + "99 1.5 2.5", "line 52 has 3 values"),
                          ("# POINT3D_ID, X, Y, Z\n7 1 2 3\n", "line 2 has 4 values.*at least 8")):
        (tmp_path / "points3D.txt").write_text(content)
        with pytest.raises(InputError, match=told):
            read_points(tmp_path / "points3D.txt")


@pytest.mark.parametrize("end", ["\n", " \n", "\r\n"])
@pytest.mark.parametrize("version", [".5", "0.6", ".7"])
def test_pcd_of_older_versions_and_with_blanks(tmp_path, version, end):
    """Without COUNT, VIEWPOINT and POINTS, with blanks at the ends of lines, with any field."""
    lines = [f"VERSION {version}", "FIELDS x y z Höhe[m]", "SIZE 4 4 4 4", "TYPE F F F F",
             "WIDTH 200", "HEIGHT 1", "DATA ascii", *(f"{x} {y} {z} 7" for x, y, z in POINTS)]
    (tmp_path / "a.pcd").write_bytes("".join(line + end for line in lines).encode())
    cloud = read_points(tmp_path / "a.pcd")
    np.testing.assert_allclose(cloud.points, POINTS, atol=1e-6)
    assert cloud.titles == {"Hohe_m": "Höhe[m]"}


@pytest.mark.parametrize(("name", "row", "scalar"), [
    ("a.pts", "-1200 110 118 156", "intensity"), ("a.pts", "17 110 118 156", "intensity"),
    ("a.xyz", "110 118 156 0.5", "scalar_0"), ("a.xyz", "110 118 156 17", "scalar_0"),
    ("a.xyz", "0.25 110 118 156", "intensity")])
def test_colour_beside_a_scalar_is_told(tmp_path, name, row, scalar):
    """A scanner's intensity comes before the colour, CloudCompare's scalar field after it."""
    (tmp_path / name).write_text(f"1 2 3 {row}\n4 5 6 {row}\n")
    cloud = read_points(tmp_path / name)
    assert cloud.attributes.keys() == {"color", scalar}
    np.testing.assert_array_equal(cloud.attributes["color"][0], [110, 118, 156])


def test_points_that_are_no_numbers_are_left_away_and_counted(tmp_path):
    """Drivers of depth cameras write NaN where a pixel saw nothing: no reason to refuse."""
    points = POINTS.copy()
    points[::7] = np.nan
    points[1, 2] = np.inf
    np.save(tmp_path / "a.npy", points)
    cloud = read_points(tmp_path / "a.npy")
    good = np.isfinite(points).all(axis=1)
    np.testing.assert_array_equal(cloud.points, points[good])
    assert cloud.not_finite == (~good).sum()


def test_missing_file_and_folder(tmp_path):
    """Neither is a cloud."""
    with pytest.raises(InputError, match="no file"):
        read_points(tmp_path / "none.ply")
    with pytest.raises(InputError, match="is a folder"):
        read_points(tmp_path)


def test_depth_image_with_mask(tmp_path):
    """A flat depth image at 0.5 m becomes points at 0.5 m, only where the mask is."""
    from PIL import Image

    depth = np.full((48, 64), 500, np.uint16)  # too few of them in the mask to judge
    mask = np.zeros((48, 64), np.uint8)
    mask[10:20, 30:40] = 255
    Image.fromarray(depth).save(tmp_path / "depth.png")
    Image.fromarray(mask).save(tmp_path / "mask.png")
    (tmp_path / "camera.toml").write_text(
        "width = 64\nheight = 48\nfx = 60.0\nfy = 60.0\ncx = 32.0\ncy = 24.0\n")
    cloud = read_depth(tmp_path / "depth.png", tmp_path / "camera.toml", tmp_path / "mask.png")
    assert len(cloud) == 100
    np.testing.assert_allclose(cloud.points[:, 2], 0.5)


# Headers that speak of more points than the file holds are refused before memory is taken.

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


@pytest.mark.parametrize(("name", "at", "kind"), [("autzen.las", 107, "<I"),
                                                  ("1_4_w_evlr.laz", 247, "<Q")])
def test_las_with_a_mangled_count(tmp_path, name, at, kind):
    """Refused by the header alone."""
    raw = bytearray((Path(__file__).parents[2] / "data" / "real" / "laspy" / name).read_bytes())
    struct.pack_into(kind, raw, at, 2_000_000_000)
    (tmp_path / name).write_bytes(raw)
    with pytest.raises(InputError, match="announces"):
        read_points(tmp_path / name)


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


# Meshes that are brought as clouds: their vertices are read, or the mesh is named.


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".off"])
@pytest.mark.parametrize("mesh", [trimesh.creation.cylinder(0.01, 0.4, sections=32),
                                  trimesh.creation.box((0.1, 0.1, 0.4))])
def test_a_mesh_of_large_faces_is_no_cloud(tmp_path, suffix, mesh):
    """A Blender cylinder has its surface where no vertex is."""
    mesh.export(tmp_path / f"a{suffix}")
    with pytest.raises(InputError, match=r"mesh of .* faces.*limber mesh"):
        read_points(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl"])
def test_a_fine_mesh_is_read_and_named(tmp_path, suffix):
    """A scanner's program writes triangles between its points."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    ball.export(tmp_path / f"a{suffix}")
    cloud = read_points(tmp_path / f"a{suffix}")
    assert "is a mesh of 1280 faces" in cloud.notes[0]
    np.testing.assert_allclose(np.ptp(cloud.points, axis=0), 0.2, rtol=1e-3)


# Readers in a process of their own: what stops them is their own work, and is named.


@pytest.fixture
def packed(tmp_path):
    """A good LAZ file."""
    import laspy

    content = laspy.create(point_format=3)
    content.header.scales = [1e-4] * 3
    content.x, content.y, content.z = np.random.default_rng(0).uniform(0, 1, (3, 50))
    content.write(tmp_path / "a.laz")
    return tmp_path / "a.laz"


def test_too_much_work_is_named_as_that(packed, monkeypatch):
    """A reader that computes for ever is stopped; its file is not called damaged."""
    monkeypatch.setattr(isolated_readers, "_LEAST_SECONDS", 0.0)
    monkeypatch.setattr(isolated_readers, "_SECONDS_PER_MB", 0.0)
    with pytest.raises(InputError, match="s of processor time") as caught:
        read_points(packed)
    assert "damaged" not in str(caught.value)
