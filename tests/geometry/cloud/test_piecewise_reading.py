"""Scans of more points than are kept, read piece by piece."""

import tracemalloc

import numpy as np
import pytest

from limber.core.files import text_columns
from limber.geometry.cloud import preparation
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import gathered, prepare
from limber.geometry.io import clouds
from limber.geometry.io.clouds import read_points


def _tube(count):
    rng = np.random.default_rng(0)
    angle, along = 2 * np.pi * rng.random(count), rng.random(count)
    return np.stack([0.02 * np.cos(angle), 0.02 * np.sin(angle), along], axis=1)


def _pieces(points, count):
    numbers = np.arange(len(points))
    return [Cloud(part, {"number": number}) for part, number in zip(
        np.array_split(points, count), np.array_split(numbers, count), strict=True)]


def test_few_points_stay_as_they_are():
    points = _tube(500)
    whole = gathered(_pieces(points, 7), most=500)
    np.testing.assert_array_equal(whole.points, points)
    np.testing.assert_array_equal(whole.attributes["number"], np.arange(500))
    assert whole.left_out == 0


def test_of_many_points_an_even_part_stays():
    """Whichever piece they come in: of the first as many as of the last."""
    points = _tube(40_000)
    points = points[np.argsort(points[:, 2])]
    some = gathered(_pieces(points, 40), most=3000)
    np.testing.assert_array_equal(some.points, gathered(_pieces(points, 1), most=3000).points)
    assert 700 < len(some) <= 3000 and some.left_out == 40_000 - len(some)
    np.testing.assert_array_equal(some.points, points[some.attributes["number"]])
    shares = np.histogram(some.points[:, 2], 10, (0, 1))[0] / len(some)
    assert shares.min() > 0.08 and shares.max() < 0.12


def test_what_is_held_is_bounded():
    """No more than twice what is kept, and a piece, lies in memory together."""
    points, held, most = _tube(40_000), [], 3000
    kept = preparation._together

    def together(pieces):
        held.append(sum(map(len, pieces)))
        return kept(pieces)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preparation, "_together", together)
        gathered(_pieces(points, 40), most)
    assert max(held) <= 2 * most + 1000


def test_points_that_are_not_finite_make_no_cells():
    points = _tube(9000)
    points[::10] = np.nan
    some = gathered(_pieces(points, 9), most=2000)
    assert np.isfinite(some.points).all()
    assert some.not_finite == 900 and some.left_out + len(some) == 8100


@pytest.mark.parametrize("suffix", [".ply", ".las", ".txt", ".pcd", ".ascii.pcd"])
def test_files_are_read_in_pieces(tmp_path, monkeypatch, suffix):
    """As a whole, and thinned, with their attributes; the user is told."""
    points, path = _tube(5000), tmp_path / f"a{suffix}"
    intensity = np.arange(5000, dtype=np.uint16)
    if suffix == ".ply":
        Cloud(points, {"intensity": intensity}).write_ply(path)
    elif suffix.endswith(".pcd"):
        pypcd4 = pytest.importorskip("pypcd4")
        form = pypcd4.Encoding.ASCII if "ascii" in suffix else pypcd4.Encoding.BINARY
        pypcd4.PointCloud.from_points([*points.T, intensity], ("x", "y", "z", "intensity"),
                                      (*[np.float64] * 3, np.uint16)).save(path, form)
    elif suffix == ".txt":
        np.savetxt(path, np.column_stack([intensity, points]), "%.8g", header="Intensity Z X Y")
        points = points[:, [1, 2, 0]]
    else:
        laspy = pytest.importorskip("laspy")
        header = laspy.LasHeader(point_format=3, version="1.2")
        header.scales = [1e-6] * 3
        content = laspy.LasData(header)
        content.x, content.y, content.z = points.T
        content.intensity = intensity
        content.write(path)
    monkeypatch.setattr(clouds, "PIECE_POINTS", 700)
    monkeypatch.setattr(text_columns, "LINES_AT_ONCE", 700)
    whole = read_points(path)
    np.testing.assert_allclose(whole.points, points, atol=1e-6)
    np.testing.assert_array_equal(whole.attributes["intensity"], intensity)
    monkeypatch.setattr(clouds, "gathered", lambda pieces: gathered(pieces, 1000))
    some = read_points(path)
    assert len(some) <= 1000 and some.left_out == 5000 - len(some)
    chosen = some.attributes["intensity"].astype(int)
    np.testing.assert_array_equal(some.points, whole.points[chosen])
    prepared = prepare(some, 1.0)
    assert prepared.counts["read"] == 5000
    assert prepared.counts["thinned_on_reading"] == some.left_out
    assert any("5000 points" in text for text in prepared.warnings)


def test_a_text_is_held_in_parts(tmp_path, monkeypatch):
    """Rows with a missing value, a count before each scan and comments may come in any part."""
    monkeypatch.setattr(text_columns, "LINES_AT_ONCE", 1000)
    monkeypatch.setattr(text_columns, "_BLOCK", 10_000)
    path, rows = tmp_path / "a.txt", [f"{k} {k / 7:.6f} {-k} 5" for k in range(30_000)]
    rows[15_000] = "15000 NA -15000 5"
    path.write_text("x y z n\n15000\n" + "\n".join(rows[:15_000]) + "\n15000\n# two\n"
                    + "\n".join(rows[15_000:]) + "\n")
    table = text_columns.Table(path)
    tracemalloc.start()
    total = sum(np.nansum(piece, axis=0) for piece in table.pieces())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert total[[0, 3]].tolist() == [sum(range(30_000)), 150_000]
    assert total[1] == pytest.approx((total[0] - 15_000) / 7, rel=1e-6)
    whole = text_columns.read_columns(path)
    assert whole.values.shape == (30_000, 4) and whole.names == ["x", "y", "z", "n"]
    assert np.flatnonzero(np.isnan(whole.values[:, 1])).tolist() == [15_000]
    assert peak < 1e6  # bytes; the lines as Python's texts take 2e6
