"""Clouds as reports and other programs have them: each kind with its right points and unit."""

from pathlib import Path

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.io.clouds import read_cloud, read_points, unit_of
from limber.geometry.settings import ReconstructSettings

REPORTS = Path(__file__).parents[4] / "shared" / "data" / "reports"
POINTS = np.array([[1.5, 2.0, 3.25], [4.0, 5.0, 6.5], [-7.0, 8.0, 9.75]])
SIZE = [0.243, 0.114, 0.600]
REPORTED = {
    "01-csv-unnamed-index/r_writecsv.csv": 1.0, "02-column-names/csv_space_col.csv": 1.0,
    "02-column-names/de_semicolon.csv": 1.0, "03-id-column-in-blender/cols_zxy.csv": 1.0,
    "03-id-column-in-blender/id_first.csv": 1.0, "04-cloudcompare-ascii/cc_header.asc": 1.0,
    "05-ply-nonascii-comment/ply_umlaut.ply": 1.0, "06-float-colours/ply_floatcolor.ply": 1.0,
    "07-colmap-points3D/colmap_points3D.txt": 1.0, "08-unit-in-header/unit_x_mm_30mm.csv": 0.05,
    "23-pcd-old/pcd_v5_nocount.pcd": 1.0, "24-leica-pts/leica_two_scans.pts": 1.0}


@pytest.mark.parametrize("name", REPORTED)
def test_reported_files(name):
    """All hold the same 7,500 points, one of them as a seedling of 30 mm."""
    path = REPORTS / name
    if not path.exists():
        pytest.skip("the reports are not beside this checkout")
    cloud = read_cloud(path)
    assert len(cloud) == 7500
    np.testing.assert_allclose(np.ptp(cloud.points, axis=0), REPORTED[name] * np.array(SIZE),
                               rtol=2e-3)
    if "color" in cloud.attributes:
        assert cloud.attributes["color"].min() >= 59 and cloud.attributes["color"].max() <= 160


def table(titles, separator=",", order=(0, 1, 2), comma=False, more=()):
    """A header and the points, with further columns behind them."""
    rows = [separator.join([*(f"{point[k]}" for k in order), *more]) for point in POINTS]
    text = "\n".join([titles, *rows]) + "\n"
    return text.replace(".", ",") if comma else text


@pytest.mark.parametrize(("text", "unit"), [
    (table("x_mm,y_mm,z_mm"), "mm"), (table("X (mm),Y (mm),Z (mm)"), "mm"),
    (table("X [cm];Y [cm];Z [cm]", ";", comma=True), "cm"),
    (table("Position [mm] X,Position [mm] Y,Position [mm] Z"), "mm"),
    (table("x in mm\ty in mm\tz in mm", "\t"), "mm"), (table("x/mm y/mm z/mm", " "), "mm"),
    (table("X (millimetres),Y (millimetres),Z (millimetres)"), "mm"),
    (table("x (\u00b5m),y (\u00b5m),z (\u00b5m)"), "um"),
    (table("X Inches,Y Inches,Z Inches"), "in"),
    (table("x,y,z\n(mm),(mm),(mm)"), "mm"), (table("# unit: mm\nx,y,z"), "mm"),
    (table("Units are millimeters\nx y z", " "), "mm"), (table("x_m,y_m,z_m"), "m"),
    (table("pos_x_mm,pos_y_mm,pos_z_mm"), "mm"), (table("x,y,z"), None)])
def test_units_that_a_table_states(tmp_path, text, unit):
    """In titles of any form, in a row of units, in a comment."""
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    cloud = read_points(path)
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.unit == unit
    assert unit_of(cloud, "m")[0] == (unit or "m")


@pytest.mark.parametrize("titles", ["x_mm,y_mm,z_m", "x_mm,y,z", "X (ft),Y (ft),Z (ft)"])
def test_units_that_do_not_fit_are_refused(tmp_path, titles):
    """Of several lengths, or of one that is not known: never read as metres."""
    (tmp_path / "a.csv").write_text(table(titles))
    with pytest.raises(InputError, match="one unit"):
        read_points(tmp_path / "a.csv")


def test_a_given_unit_against_the_files(tmp_path):
    """The user's word counts, and the difference is reported."""
    (tmp_path / "a.csv").write_text(table("x_mm,y_mm,z_mm"))
    unit, notes = unit_of(read_points(tmp_path / "a.csv"), "cm")
    assert unit == "cm" and "in mm, but --unit cm" in notes[0]


@pytest.mark.parametrize("head", ["ply\nformat ascii 1.0\ncomment unit: mm\nelement vertex 3\n"
                                  "property float x\nproperty float y\nproperty float z\n"
                                  "end_header\n",
                                  "# .PCD v0.7, units: mm\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\n"
                                  "TYPE F F F\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA ascii\n"])
def test_units_in_comments_of_other_formats(tmp_path, head):
    path = tmp_path / ("a.ply" if head.startswith("ply") else "a.pcd")
    path.write_text(head + table("", " ").lstrip("\n"))
    np.testing.assert_allclose(read_cloud(path).points, POINTS * 1e-3, rtol=1e-6)


@pytest.mark.parametrize("text", [
    # pandas with its index; R with row names of words; Excel's own first line.
    ",x,y,z\n" + "".join(f"{k},{x},{y},{z}\n" for k, (x, y, z) in enumerate(POINTS)),
    '"","x","y","z"\n' + "".join(f'"p{k}",{x},{y},{z}\n' for k, (x, y, z) in enumerate(POINTS)),
    "sep=;\n" + table("Rechtswert;Hochwert;H\u00f6he", ";", comma=True),
    # A class beside the coordinates, R's word for what is missing, a preamble.
    table("x,y,z,label", more=("wood",)), table("x,y,z,intensity", more=("NA",)),
    "Exported by Scene 7\nDate: 2024-05-01\n" + table("X,Y,Z"),
    # R's write.table with row names of words; a spreadsheet's letters; brackets between blanks.
    '"x" "y" "z"\n' + "".join(f'"p{k}" {x} {y} {z}\n' for k, (x, y, z) in enumerate(POINTS)),
    '"";"x";"y";"z"\n' + "".join(f'"{k}";{x};{y};{z}\n' for k, (x, y, z) in enumerate(POINTS)
                                  ).replace(".", ","),
    table("Rechtswert;Hochwert;H\u00f6he", ";", comma=True).encode("cp1252"),
    table("X (m) Y (m) Z (m)", " "),
    # COLMAP's points without its comments.
    "".join(f"{7 * k} {x} {y} {z} 9 8 7 0.3 {'1 2 ' * (k + 1)}\n"
            for k, (x, y, z) in enumerate(POINTS)),
    table("z,y,x", order=(2, 1, 0)), table("Y-Koordinate;X-Koordinate;Z-Koordinate", ";",
                                           order=(1, 0, 2), comma=True),
    table("Points_0,Points_1,Points_2"), table("#z y x", " ", order=(2, 1, 0)),
    table("East,North,Up"), table("coord. X;coord. Y;coord. Z", ";")])
def test_titles_of_other_programs(tmp_path, text):
    """Coordinates are found by their names, wherever they stand."""
    path = tmp_path / "a.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    np.testing.assert_array_equal(read_points(path).points, POINTS)


def test_a_column_of_words_is_named(tmp_path):
    (tmp_path / "a.csv").write_text(table("x,y,z,label,i", more=("wood", "7")))
    cloud = read_points(tmp_path / "a.csv")
    assert "'label' holds words" in cloud.notes[0] and cloud.attributes["i"].tolist() == [7, 7, 7]


@pytest.mark.parametrize("titles", ["rot;gr\u00fcn;blau", "R;G;B", "Red;Green;Blue", "Rf;Gf;Bf",
                                    "color_r;color_g;color_b"])
def test_names_of_colours(tmp_path, titles):
    (tmp_path / "a.csv").write_text(table(f"x;y;z;{titles}", ";", more=("9", "8", "7")))
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv").attributes["color"][0], [9, 8, 7])


@pytest.mark.parametrize("cut", [1, 30])
def test_cut_points_of_colmap(tmp_path, cut):
    raw = (Path(__file__).parents[2] / "data" / "tour" / "points3D.bin").read_bytes()
    (tmp_path / "points3D.bin").write_bytes(raw[:-cut])
    with pytest.raises(InputError, match=r"cut short|unpack_from"):
        read_points(tmp_path / "points3D.bin")


def test_the_unit_of_the_file_is_that_of_the_branch(tmp_path, monkeypatch):
    """Skeleton, surface and manifest have it, not the default."""
    from limber.stages.shape.reconstruct import Reconstruct

    used = []

    def stop(_raw, settings, **_more):
        used.append(settings.unit)
        raise InputError("that is enough")

    monkeypatch.setattr("limber.geometry.reconstruction.reconstruct_cloud", stop)
    (tmp_path / "a.csv").write_text(table("x_mm,y_mm,z_mm"))
    for settings in (ReconstructSettings(), ReconstructSettings(unit="cm")):
        with pytest.raises(InputError, match="enough"):
            Reconstruct.of(settings, cloud=tmp_path / "a.csv", output=tmp_path / "a.branch").run()
    assert used == ["mm", "cm"]
