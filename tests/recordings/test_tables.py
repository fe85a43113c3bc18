"""Tables as other programs write them."""


import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.foreign_files import CAPTURES, COUNT, M1, M2
from limber.core.errors import InputError
from limber.recordings import tables
from limber.recordings.time_series import clock_seconds

ROWS = [(0.0, 1.5, -2.0, 3.25), (0.01, 1.6, -2.1, 3.25), (0.02, 1.7, -2.2, 3.25)]


def written(tmp_path, text, name="table.csv", encoding="utf-8"):
    path = tmp_path / name
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize(("header", "separator", "decimal", "scale"), [
    ("t_s,tip_x_m,tip_y_m,tip_z_m", ",", ".", 1.0),
    ("Time (s),Tip X (mm),Tip Y (mm),Tip Z (mm)", ",", ".", 1e-3),
    ("timestamp;tip.X;tip.Y;tip.Z", ";", ",", 1.0),
    ("Time\ttip_x_cm\ttip_y_cm\ttip_z_cm", "\t", ".", 1e-2),
    ("time tip:x_mm tip:y_mm tip:z_mm", " ", ".", 1e-3), ("t|tip x|tip y|tip z", "|", ".", 1),
    ("time tip:x_mm tip:y_mm tip:z_mm", " ", ",", 1e-3),
])
def test_one_motion_in_many_dresses(tmp_path, header, separator, decimal, scale):
    """Separators, decimal commas, brackets and units make the same markers."""
    lines = [separator.join(str(value).replace(".", decimal) for value in row) for row in ROWS]
    path = written(tmp_path, "\n".join([header, *lines]) + "\n")
    stream, labels = tables.marker_stream(path)
    assert len(labels) == 1 and tables.same_label(labels[0], "tip")
    assert np.allclose(stream.times, [0.0, 0.01, 0.02])
    assert np.allclose(stream.values, scale * np.array(ROWS)[:, 1:])


def test_preamble_units_row_and_other_encodings(tmp_path):
    """Lines above the header, a row of units below it, a byte order mark, UTF-16, CRLF."""
    body = ("NO_OF_FRAMES,3\r\nDESCRIPTION,Grünling\r\nTime,A_x,A_y,A_z\r\n(ms),(mm),(mm),(mm)\r\n"
            "0,1,2,3\r\n10,2,3,4\r\n20,3,4,5\r\n")
    for encoding in ("utf-8-sig", "utf-16", "latin-1"):
        stream, labels = tables.marker_stream(written(tmp_path, body, encoding=encoding))
        assert labels == ["A"] and stream.times[-1] == pytest.approx(0.02)
        assert stream.values[0] == pytest.approx([1e-3, 2e-3, 3e-3])


def test_header_in_a_comment(tmp_path):
    """numpy's savetxt puts a # before the names."""
    path = written(tmp_path, "# t_s,m_x_m,m_y_m,m_z_m\n0,1,2,3\n1,2,3,4\n")
    assert tables.marker_stream(path)[1] == ["m"]


def test_no_time_needs_a_rate(tmp_path):
    """Frame numbers become times with --rate-hz; without it the columns are named."""
    path = written(tmp_path, "Frame,a_x,a_y,a_z\n10,1,2,3\n12,1,2,3\n13,1,2,3\n")
    with pytest.raises(InputError, match="rate-hz"):
        tables.marker_stream(path)
    stream, _ = tables.marker_stream(path, rate_hz=100)
    assert np.allclose(stream.times, [0.0, 0.02, 0.03])


def test_unseen_markers_and_other_columns(tmp_path):
    """(0, 0, 0) and empty fields are "not seen"; columns that are no marker are named."""
    path = written(tmp_path, "t_s,a_x_m,a_y_m,a_z_m,residual\n0,1,2,3,9\n1,0,0,0,9\n2,,,,9\n")
    stream, _ = tables.marker_stream(path)
    assert np.isnan(stream.values[1:]).all() and np.isfinite(stream.values[0]).all()
    assert any("residual" in warning for warning in stream.warnings)


def test_robot_tables_of_ur_and_with_quaternions(tmp_path):
    """RTDE's names, and a quaternion instead of a rotation vector; forces in gram-force."""
    ur = "timestamp " + " ".join(f"actual_TCP_pose_{k}" for k in range(6)) + " " + " ".join(
        f"actual_TCP_force_{k}" for k in range(6))
    rows = "\n".join(" ".join(map(str, [k, *np.arange(12) / 4])) for k in range(3))
    stream = tables.robot_stream(written(tmp_path, f"{ur}\n{rows}\n"))
    assert stream.columns[3] == "rx_rad" and stream.columns[-1] == "tz_nm"
    assert np.allclose(stream.values[0], np.arange(12) / 4)
    half = np.sqrt(0.5)
    path = written(tmp_path, "t_ms,x_mm,y_mm,z_mm,qx,qy,qz,qw,Fx (gf),Fy (gf),Fz (gf)\n"
                   f"0,1,2,3,0,0,{half},{half},100,0,0\n500,1,2,3,0,0,{half},{half},100,0,0\n")
    stream = tables.robot_stream(path)
    found = dict(zip(stream.columns, stream.values[1], strict=True))
    assert stream.times[1] == 0.5 and found["x_m"] == pytest.approx(1e-3)
    assert found["rz_rad"] == pytest.approx(np.pi / 2)
    assert found["fx_n"] == pytest.approx(0.980665)


def test_pose_without_rotation_is_told(tmp_path):
    """A gripper of which only the place is known is taken not to turn, with a word."""
    stream = tables.robot_stream(written(tmp_path, "t_s,x_m,y_m,z_m\n0,1,2,3\n1,1,2,3\n"))
    assert np.all(stream.values[:, 3:6] == 0) and "point grasp" in stream.warnings[0]


def test_what_is_no_table(tmp_path):
    """Rubbish, an empty file, numbers without names: each refused with a reason."""
    for text, match in (("", "empty"), ("hello\nworld\n", "row of numbers"),
                        ("1,2,3\n4,5,6\n", "header")):
        with pytest.raises(InputError, match=match):
            tables.read_table(written(tmp_path, text))
    rows = "\n".join("0,1,2" if k % 3 else "broken" for k in range(30))
    with pytest.raises(InputError, match="is not reliable"):
        tables.read_table(written(tmp_path, f"t_s,a,b\n0,1,2\n0,1,2\n{rows}\n0,1,2\n"))


def test_unfinished_line_and_a_bad_one(tmp_path):
    """The last line is dropped where it is cut; one bad line in many is named and dropped."""
    rows = "".join(f"{k},1,2\n" for k in range(60))
    table = tables.read_table(written(tmp_path, f"t_s,a,b\n{rows}oops\n{rows}99,1"))
    assert len(table.values) == 120
    text = " ".join(table.warnings)
    assert "oops" in text and "incomplete" in text


def test_a_clock_that_counts_milliseconds_raises_a_question(tmp_path):
    """Whole numbers that step by 10 are seconds by their name only."""
    rows = "".join(f"{10 * k},1\n" for k in range(9))
    stream = tables.time_stream(tables.read_table(written(tmp_path, f"time,a\n{rows}")))
    assert any("t_ms" in warning for warning in stream.warnings)


def test_titles():
    """Unit and name are told apart."""
    title = tables.split_title("Load Cell Reading (gf)")
    assert (title.name, title.unit) == ("Load Cell Reading", "gf")
    assert tables.split_title("tip1_x_mm").unit == "mm"
    assert tables.split_title("tip1_x").unit is None
    assert tables.same_label("Tip - 1", "tip1") and tables.same_label("beam:tip1", "Tip 1")
    assert not tables.same_label("tip1", "tip2")


@pytest.mark.parametrize(("above", "row", "titles"), [
    ((), "{a:.3f}", ["reading_1"]),
    (("12:00:00.000 -> Ready.", "11:59:59.990 -> 3"), "{a:.3f},{b:.2f}",
     ["reading_1", "reading_2"]),
    (("12:00:00.000 -> force_N\tangle_deg",), "{a:.3f}\t{b:.2f}", ["force_N", "angle_deg"]),
    (("12:00:00.000 -> ok",), "force:{a:.3f} angle:{b:.2f}", ["force", "angle"]),
    (("12:00:00.000 -> ok",), "F = {a:.3f}", ["F"])])
def test_the_log_of_a_serial_monitor(tmp_path, above, row, titles):
    """Stamps of the computer's clock before an arrow; readings bare, named, or below titles."""
    path, a = tmp_path / "a.txt", np.sin(np.arange(40) / 3)
    lines = [f"12:00:0{1 + k // 100}.{10 * k % 1000:03d} -> {row.format(a=a[k], b=90 + k)}"
             for k in range(40)]
    path.write_text("\n".join([*above, *lines]) + "\n")
    stream = tables.time_stream(tables.read_table(path))
    assert list(stream.columns) == titles
    np.testing.assert_allclose(stream.times - stream.times[0], 0.01 * np.arange(40), atol=1e-9)
    np.testing.assert_allclose(stream.values[:, 0], a, atol=6e-4)
    if len(titles) == 2:
        np.testing.assert_array_equal(stream.values[:, 1], 90 + np.arange(40))


_TURNS = Rotation.from_rotvec([[0.1, -0.2, 0.3], [1.2, 0.4, -2.0], [-0.5, 2.5, 0.7]])
_PLACES = np.array([[0.4, 0.1, 0.6], [0.5, 0.2, 0.6], [0.6, 0.3, 0.5]])
_WRENCHES = np.arange(18.0).reshape(3, 6) / 7


def _franka():
    matrices = np.tile(np.eye(4), (3, 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = _TURNS.as_matrix(), _PLACES
    return ([f"O_T_EE_{k}" for k in range(16)] + [f"O_F_ext_hat_K_{k}" for k in range(6)],
            np.column_stack([matrices.transpose(0, 2, 1).reshape(3, 16), _WRENCHES]))


def _angles(titles, order, degrees):
    return (["x", "y", "z", *titles, "fx_n", "fy_n", "fz_n", "tx", "ty", "tz"],
            np.column_stack([_PLACES, _TURNS.as_euler(order, degrees), _WRENCHES]))


@pytest.mark.parametrize(("titles", "rows"), [
    _franka(), _angles(("roll [rad]", "pitch [rad]", "yaw [rad]"), "xyz", False),
    _angles(("roll_deg", "pitch_deg", "yaw_deg"), "xyz", True),
    _angles(("A [deg]", "B [deg]", "C [deg]"), "ZYX", True)])
def test_rotations_of_other_robots(tmp_path, titles, rows):
    """Franka's transform by columns, angles about fixed axes, KUKA's angles."""
    path = written(tmp_path, "\n".join([",".join(["t_s", *titles]), *(
        ",".join(f"{value:.12g}" for value in (k, *row)) for k, row in enumerate(rows))]) + "\n")
    stream = tables.robot_stream(path)
    assert not stream.warnings
    np.testing.assert_allclose(stream.values[:, :3], _PLACES, atol=1e-9)
    turns = Rotation.from_rotvec(stream.values[:, 3:6])
    assert (turns * _TURNS.inv()).magnitude().max() < 1e-6
    np.testing.assert_allclose(stream.values[:, 6:], _WRENCHES, atol=1e-9)


def test_degrees_without_a_unit_are_not_radians(tmp_path):
    titles, rows = _angles(("roll", "pitch", "yaw"), "xyz", True)
    path = written(tmp_path, "\n".join([",".join(["t_s", *titles]), *(
        ",".join(map(str, (k, *row))) for k, row in enumerate(rows))]) + "\n")
    with pytest.raises(InputError, match=r"reach .* roll \[deg\]"):
        tables.robot_stream(path)


# Tables of motion capture, ROS and loggers: markers, units, rates and clocks as they mean them.

@pytest.mark.parametrize("name", CAPTURES)
def test_markers_of_motion_capture(tmp_path, name):
    """Both markers, in metres, at 100 frames a second, in every program's layout."""
    (tmp_path / name).write_text(CAPTURES[name])
    stream, labels = tables.marker_stream(tmp_path / name)
    assert [label.rpartition(":")[2] for label in labels] == ["M1", "M2"]
    np.testing.assert_allclose(stream.values[0], np.r_[M1, M2], atol=1e-9)
    np.testing.assert_allclose(stream.values[-1, 0], 0.1 + 1e-3 * (COUNT - 1), atol=1e-9)
    np.testing.assert_allclose(np.diff(stream.times), 0.01, atol=1e-9)
    assert len(stream) == COUNT


@pytest.mark.parametrize("name", ["vicon.csv", "qualisys.tsv", "opensim.trc"])
def test_a_capture_of_one_frame_is_refused(tmp_path, name):
    """Its last line may be cut short, and then there is none."""
    text = CAPTURES[name]
    (tmp_path / name).write_text(text[:text.index("0.150000" if name == "qualisys_header.tsv"
                                                  else "150.000000")])
    with pytest.raises(InputError):
        tables.marker_stream(tmp_path / name)


def clocked(stamps, title="time"):
    """A column of time stamps beside one of readings."""
    return f"{title},a\n" + "".join(f"{stamp},{k}\n" for k, stamp in enumerate(stamps))


STEPS = list(range(30))


@pytest.mark.parametrize("stamps", [STEPS, [2 * k for k in STEPS], [1.875 * k for k in STEPS],
                                    [10**9 * k for k in STEPS]])
def test_a_clock_of_two_meanings_is_asked_for(tmp_path, stamps):
    """Whole numbers one by one: seconds, or milliseconds of a fast logger."""
    (tmp_path / "a.csv").write_text(clocked(stamps))
    with pytest.raises(InputError, match="Name the unit in the title"):
        tables.time_stream(tables.read_table(tmp_path / "a.csv"))
    (tmp_path / "a.csv").write_text(clocked(stamps, "t_ms"))
    found = tables.time_stream(tables.read_table(tmp_path / "a.csv"))
    assert found.times[1] == pytest.approx(stamps[1] / 1000)


@pytest.mark.parametrize("text", ["12", "1.5", "base_link", "", "10.5.2", "99/99/2024", "-"])
def test_what_is_no_clock(text):
    assert clock_seconds(text) is None


def test_a_wrench_of_a_topic_makes_a_robots_log(tmp_path):
    titles = ["time", *(f"/tcp/pose/position/{a}" for a in "xyz"),
              *(f"/ft/wrench/force/{a}" for a in "xyz")]
    assert tables.is_robot_table([tables.split_title(title) for title in titles])
    assert not tables.is_robot_table([tables.split_title(f"tip_position_{a}") for a in "xyz"])


@pytest.mark.parametrize("position", ["x y z", "pos_x pos_y pos_z", "tcp_x tcp_y tcp_z"])
def test_torques_beside_a_quaternion_stay_torques(tmp_path, position):
    """Only where nothing else is a position is tx TUM's translation."""
    (tmp_path / "a.txt").write_text(f"t_s {position} qx qy qz qw fx fy fz tx ty tz\n" + "".join(
        f"{0.01 * k} 0.1 0.2 0.3 0 0 0 1 1 2 3 4 5 6\n" for k in range(9)))
    stream = tables.robot_stream(tmp_path / "a.txt")
    found = dict(zip(stream.columns, stream.values[0], strict=True))
    assert found["x_m"] == 0.1 and found["tx_nm"] == 4.0 and found["fx_n"] == 1.0
