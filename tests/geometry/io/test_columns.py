"""Columns of clouds: whatever a file calls them, everything that is written can name them."""

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.cloud.cloud import Cloud, property_names
from limber.geometry.io.clouds import read_points

COUNT = 40
POINTS = np.random.default_rng(1).normal(size=(COUNT, 3)).round(3)
VALUES = np.arange(COUNT) + 0.5
TITLES = ("", " ", "Intensität", "反射率", "Scan Angle", "angle [deg]", "angle (deg)", "angle_deg",
          "red", "NX", "normal", "color", "leaf", "x_2", "element", "end_header", "comment",
          "a\tb", "a/b", "\N{PILE OF POO}", "-", "1", "n" * 500, "N" * 500, "e\u0301", "nan")


def _random_titles(rng, count):
    """Return titles of random letters from all over Unicode, some of them twice."""
    letters = [chr(code) for code in (*range(32, 127), 0xA0, 0xB5, 0xDF, 0xE4, 0x3B1, 0x4E2D,
                                      0x1F33F, 0x200B)]
    titles = ["".join(rng.choice(letters, rng.integers(0, 70))) for _ in range(count)]
    return titles + titles[:2]


@pytest.mark.parametrize("seed", range(30))
def test_any_title_becomes_a_valid_name_of_its_own(seed):
    """Names are ASCII words, differ without regard to capitals, and are stable."""
    titles = [*TITLES, *_random_titles(np.random.default_rng(seed), 20)]
    names = property_names(titles, ["x", "y", "z"])
    assert len({name.lower() for name in names} | {"x", "y", "z"}) == len(titles) + 3
    assert all(name.isascii() and name.replace("_", "a").isalnum() for name in names)
    assert max(map(len, names)) <= 63
    assert property_names(names) == names


@pytest.mark.parametrize("seed", range(10))
def test_a_cloud_of_any_names_is_written_and_read_again(tmp_path, seed):
    """No name fails the writer, no column is lost or takes another's place."""
    rng = np.random.default_rng(seed)
    titles = list(dict.fromkeys([*TITLES, *_random_titles(rng, 20)]))
    attributes = {title: VALUES + 100 * k for k, title in enumerate(titles)}
    Cloud(POINTS, attributes | {"normal": POINTS, "features": np.outer(VALUES, [1, 2])}).write_ply(
        tmp_path / "a.ply")
    again = read_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(again.points, POINTS)
    np.testing.assert_allclose(again.attributes.pop("normal"), POINTS)
    first = sorted(values[0] for name, values in again.attributes.items()
                   if not name.startswith("features"))
    assert first == [0.5 + 100 * k for k, title in enumerate(titles) if title != "normal"]
    again.write_ply(tmp_path / "b.ply")
    assert set(read_points(tmp_path / "b.ply").attributes) == set(again.attributes)


def test_the_file_tells_the_titles(tmp_path):
    """What a column was called stands in a comment, in ASCII."""
    Cloud(POINTS, {"Intensität": VALUES, "plain": VALUES}).write_ply(tmp_path / "a.ply")
    head = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0].decode("ascii")
    assert "comment column Intensitat: 'Intensit\\xe4t'" in head and "plain:" not in head


@pytest.mark.parametrize("values", [
    VALUES.astype(np.float16), VALUES.astype(np.longdouble), VALUES.astype(">f4"), VALUES > 3,
    np.arange(COUNT, dtype=np.uint64) + 2**40, np.arange(COUNT).astype(">i2"),
    np.arange(COUNT, dtype=np.int64)])
def test_numbers_of_any_type_keep_their_values(tmp_path, values):
    """PLY has neither half precision nor 64-bit integers."""
    Cloud(POINTS, {"a": values}).write_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply").attributes["a"], values)


HEADERS = {
    "R write.csv": '"","x","y","z"\n', "index twice": "index,x,y,z,index\n",
    "German": "X;Y;Z;Intensität\n", "blank": "x,y,z,Scan Angle\n",
    "brackets": "x,y,z,time (s),time [s]\n", "one colour": "x,y,z,red\n",
    "two colours": "x,y,z,red,r,g,b\n", "meanings": "x,y,z,normal,color,leaf,residual\n",
    "x again": "x,y,z,X\n", "long": f"x,y,z,{'n' * 70000}\n"}


@pytest.mark.parametrize("name", HEADERS)
def test_text_with_any_header_is_read_and_written(tmp_path, name):
    """Each column beside the coordinates is an attribute that can be written."""
    header = HEADERS[name]
    mark = ";" if ";" in header else ","
    titles = [title.strip('"\n').lower() for title in header.split(mark)]
    table = np.tile(VALUES[:, None], len(titles))
    for k, axis in enumerate("xyz"):
        table[:, titles.index(axis)] = POINTS[:, k]
    rows = "\n".join(mark.join(f"{value:.3f}" for value in row) for row in table)
    path = tmp_path / "a.csv"
    path.write_text(header + (rows.replace(".", ",") if mark == ";" else rows), encoding="utf-8")
    cloud = read_points(path)
    np.testing.assert_array_equal(cloud.points, POINTS)
    kept = sum(3 if values.ndim == 2 else 1 for values in cloud.attributes.values())
    assert kept == len(titles) - 3
    cloud.write_ply(tmp_path / "a.ply")
    assert len(read_points(tmp_path / "a.ply").attributes) == len(cloud.attributes)


def test_row_names_without_a_title_are_no_coordinates(tmp_path):
    """R's write.table has one title fewer than columns."""
    rows = "\n".join(f"{k + 1} {x} {y} {z}" for k, (x, y, z) in enumerate(POINTS))
    (tmp_path / "a.txt").write_text(f'"x" "y" "z"\n{rows}\n')
    np.testing.assert_array_equal(read_points(tmp_path / "a.txt").points, POINTS)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_extra_dimensions_of_las(tmp_path, suffix):
    """Blanks, brackets, letters of other languages, and words of the programs."""
    import laspy

    content = laspy.create(point_format=3)
    content.header.scales, content.header.offsets = [1e-3] * 3, [0, 0, 0]
    titles = ["Scan Angle [deg]", "Höhe", "file", "residual"]
    content.add_extra_dims([laspy.ExtraBytesParams(title, "f4") for title in titles])
    content.x, content.y, content.z = POINTS.T
    for title in titles:
        content[title] = VALUES
    content.write(tmp_path / f"a.{suffix}")
    cloud = read_points(tmp_path / f"a.{suffix}")
    np.testing.assert_allclose(cloud.points, POINTS, atol=1e-6)
    assert set(cloud.titles.values()) == {"Scan Angle [deg]", "Höhe"}
    cloud.write_ply(tmp_path / "a.ply")
    assert read_points(tmp_path / "a.ply").attributes.keys() == {
        "color", "Scan_Angle_deg", "Hohe", "file", "residual"}


def test_arrays_that_are_no_columns(tmp_path):
    """Text, other lengths and other shapes than a meaning has do not reach the writer."""
    np.savez(tmp_path / "a.npz", points=POINTS, names=np.array(["a"] * COUNT), normals=VALUES,
             colors=np.full((COUNT, 4), 7, np.uint8), few=np.arange(3), feat=np.ones((COUNT, 2)),
             deep=np.ones((COUNT, 2, 2)), complex=VALUES * 1j)
    cloud = read_points(tmp_path / "a.npz")
    cloud.write_ply(tmp_path / "a.ply")
    assert cloud.attributes.keys() == {"normal_2", "color", "feat_0", "feat_1", "deep_0", "deep_1",
                                       "deep_2", "deep_3"}
    assert cloud.attributes["color"].shape == (COUNT, 3)


@pytest.mark.parametrize("coding", ["latin-1", "utf-8"])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_ply_with_other_letters_in_its_header(tmp_path, coding, kind):
    """In a comment and in a property's name, as text and as numbers."""
    head = (f"ply\nformat {kind} 1.0\ncomment gemessen von Prüfstelle\nelement vertex {COUNT}\n"
            "property float x\nproperty float y\nproperty float z\nproperty float Höhe\n"
            "property float Hohe\nend_header\n").encode(coding)
    table = np.column_stack([POINTS, VALUES, 2 * VALUES]).astype(np.float32)
    body = table.tobytes() if kind != "ascii" else "\n".join(
        " ".join(map(str, row)) for row in table).encode()
    (tmp_path / "a.ply").write_bytes(head + body)
    cloud = read_points(tmp_path / "a.ply")
    np.testing.assert_allclose(cloud.points, POINTS, atol=1e-6)
    assert sorted(values[1] for values in cloud.attributes.values()) == [1.5, 3.0]
    assert "Höhe" in cloud.titles.values()


@pytest.mark.parametrize("written", [
    lambda color: color / np.float32(255), lambda color: color.astype(np.uint16) * 257,
    lambda color: color.astype(float), lambda color: color.astype(np.int64)])
def test_colours_of_any_scale_are_bytes(tmp_path, written):
    """Fractions of 1 as Blender and Open3D write them, 8 bits, and 16 bits."""
    color = np.random.default_rng(0).integers(0, 256, (COUNT, 3)).astype(np.uint8)
    np.savez(tmp_path / "a.npz", points=POINTS, colors=written(color))
    cloud = read_points(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.attributes["color"], color)
    cloud.write_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply").attributes["color"], color)


def _lines(points, form="{} {} {}"):
    return "\n".join(form.format(*point, k=k, row=k // 8, column=k % 8)
                     for k, point in enumerate(points)) + "\n"


@pytest.mark.parametrize(("form", "counting"), [
    ("{k} {} {} {}", 1), ("{row} {column} {} {} {} 10 20 30", 2), ("{} {} {}", 0),
    ("{} {} {} {k} {row} {column}", 0)])
def test_columns_that_count_are_no_coordinates(tmp_path, form, counting):
    """The number of a point, or a scanner's row and column, before coordinates without titles."""
    points = np.random.default_rng(0).uniform(0, 1, (40, 3)).round(4)
    (tmp_path / "a.xyz").write_text(_lines(points, form))
    cloud = read_points(tmp_path / "a.xyz")
    np.testing.assert_array_equal(cloud.points, points)
    assert ("index_0" in cloud.attributes) == (counting > 0) and bool(cloud.notes) == (counting > 0)


@pytest.mark.parametrize("text", [
    "0 0.5 0.5 0.5\n1 0.2 0.3 0.4\n",  # too few to tell
    "".join(f"{k // 8} {k % 8} {0.1 * k + 0.05} 10 20 30\n" for k in range(40))])  # a height map
def test_whole_coordinates_stay(tmp_path, text):
    (tmp_path / "a.xyz").write_text(text)
    cloud = read_points(tmp_path / "a.xyz")
    assert cloud.points[1].tolist() == [float(word) for word in text.split("\n")[1].split()[:3]]


@pytest.mark.parametrize(("titles", "mark"), [
    ("x|y|z", "|"), ("Este;Norte;Elevaci\u00f3n", ";"), ("EST;NORD;QUOTA", ";")])
def test_further_titles_and_separators(tmp_path, titles, mark):
    points = np.random.default_rng(0).uniform(0, 1, (9, 3)).round(4)
    (tmp_path / "a.csv").write_text(titles + "\n" + _lines(points, mark.join(["{}"] * 3)))
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv").points, points)


@pytest.mark.parametrize("first", ["nan nan nan", "NaN nan NA", "nan nan nan nan nan nan"])
def test_pixels_without_depth_may_come_first(tmp_path, first):
    """A depth image written as text often begins with them; they are no titles."""
    points = np.random.default_rng(0).uniform(0, 1, (9, len(first.split()))).round(4)
    (tmp_path / "a.xyz").write_text((first + "\n") * 3 + "".join(
        " ".join(map(str, row)) + "\n" for row in points))
    np.testing.assert_array_equal(read_points(tmp_path / "a.xyz").points, points[:, :3])


def test_arrays_of_named_fields(tmp_path):
    """A structured array; and one whose names are not those of coordinates."""
    points = np.random.default_rng(0).uniform(0, 1, (9, 3))
    kinds = [("z", "f8"), ("x", "f8"), ("y", "f8"), ("ring", "u1")]
    np.save(tmp_path / "a.npy", np.array([(z, x, y, 3) for x, y, z in points], kinds))
    cloud = read_points(tmp_path / "a.npy")
    np.testing.assert_array_equal(cloud.points, points)
    assert cloud.attributes["ring"].tolist() == [3] * 9
    np.savez(tmp_path / "b.npz", pcl=points)
    with pytest.raises(InputError, match=r"b\.npz has the arrays pcl"):
        read_points(tmp_path / "b.npz")


def test_a_text_pcd_of_too_few_points_is_refused(tmp_path):
    head = ("VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 12\nHEIGHT 1\n"
            "POINTS 12\nDATA ascii\n")
    points = np.random.default_rng(0).uniform(0, 1, (9, 3))
    (tmp_path / "a.pcd").write_text(head + _lines(points))
    with pytest.raises(InputError, match="announces 12 points and lists 9"):
        read_points(tmp_path / "a.pcd")
