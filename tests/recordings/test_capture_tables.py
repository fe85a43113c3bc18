"""Tables of motion capture, ROS and loggers: markers, units, rates and clocks as they mean them."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.foreign_files import CAPTURES, COUNT, M1, M2
from limber.core.errors import InputError
from limber.recordings.robot_tables import is_robot_table, robot_stream
from limber.recordings.tables import marker_stream, read_table, split_title, time_stream
from limber.recordings.time_series import clock_seconds

MOTIVE = (Path(__file__).parents[3] / "shared" / "data" / "reports" / "17-motive-csv"
          / "motive.csv")


@pytest.mark.parametrize("name", CAPTURES)
def test_markers_of_motion_capture(tmp_path, name):
    """Both markers, in metres, at 100 frames a second, in every program's layout."""
    (tmp_path / name).write_text(CAPTURES[name])
    stream, labels = marker_stream(tmp_path / name)
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
        marker_stream(tmp_path / name)


def test_the_reported_motive_file():
    if not MOTIVE.exists():
        pytest.skip("the reports are not beside this checkout")
    stream, labels = marker_stream(MOTIVE)
    assert labels == ["M1", "M2"] and len(stream) == 200
    np.testing.assert_allclose(stream.values[0], np.r_[M1, M2], atol=1e-9)
    np.testing.assert_allclose(np.diff(stream.times), 0.01, atol=1e-9)


def clocked(stamps, title="time"):
    """A column of time stamps beside one of readings."""
    return f"{title},a\n" + "".join(f"{stamp},{k}\n" for k, stamp in enumerate(stamps))


DAY = "2024-05-01"
STEPS = list(range(30))
CLOCKS = {
    "micros": (clocked([19202812 + 1875 * k for k in STEPS], "Time Stamp"), 1.875e-3),
    "millis that began anew": (clocked([(2**32 - 50 + 10 * k) % 2**32 for k in STEPS], "millis"),
                               0.01),
    "micros that began anew": (clocked([(2**32 - 5000 + 2000 * k) % 2**32 for k in STEPS]), 2e-3),
    "ns since 1970": (clocked([1714558272000000000 + 5000000 * k for k in STEPS]), 5e-3),
    "us since 1970": (clocked([1714558272000000 + 5000 * k for k in STEPS], "timestamp"), 5e-3),
    "ms since 1970": (clocked([1714558272000 + 5 * k for k in STEPS], "Timestamp"), 5e-3),
    "s since 1970": (clocked([f"{1714558272 + 5e-3 * k:.4f}" for k in STEPS]), 5e-3),
    "ms in the title": (clocked([f"{2.5 * k:.3f}" for k in STEPS], "Time [ms]"), 2.5e-3),
    "micro in the title": (clocked([250 * k for k in STEPS], "t (\u00b5s)"), 2.5e-4),
    "ns in the title": (clocked([250000 * k for k in STEPS], "timestamp_ns"), 2.5e-4),
    "timestampMs": (clocked([3 * k for k in STEPS], "timestampMs"), 3e-3),
    "ISO": (clocked([f"{DAY}T10:11:{12 + 0.25 * k:06.3f}Z" for k in STEPS], "timestamp"), 0.25),
    "German": (clocked([f"01.05.2024 10:11:{12 + 0.25 * k:06.3f}" for k in STEPS], "Zeitstempel"),
               0.25),
    "American": (clocked([f"05/01/2024 10:11:{12 + 0.25 * k:06.3f} PM" for k in STEPS]), 0.25),
    "over midnight": (clocked([f"{'23:59' if k < 4 else '00:00'}:{(59 + 0.25 * k) % 60:05.2f}"
                               for k in STEPS]), 0.25),
    "date and time": ("Date,Time,a\n" + "".join(f"{DAY},10:11:{12 + 0.25 * k:06.3f},{k}\n"
                                                for k in STEPS), 0.25),
    "TOA5": ('"TOA5","CR1000","Tree"\n"TIMESTAMP","RECORD","a"\n"TS","RN","m/s2"\n"","","Smp"\n'
             + "".join(f'"{DAY} 10:11:{12 + 0.1 * k:06.3f}",{k},{k}\n' for k in STEPS), 0.1),
    "rostopic": ("%time,field.header.frame_id,field.a\n" + "".join(
        f"{1714558272000000000 + 8000000 * k},base,{k}\n" for k in STEPS), 8e-3),
    "ROS stamp": ("/a/header/stamp/sec,/a/header/stamp/nanosec,/a/value\n" + "".join(
        f"{1714558272 + k // 10},{100000000 * (k % 10)},{k}\n" for k in STEPS), 0.1),
    "first stamps are zero": (clocked([0, 0, 0, *(1714558272 + 0.01 * k for k in STEPS)]), 0.01),
}


@pytest.mark.parametrize("name", CLOCKS)
def test_time_stamps_of_any_clock(tmp_path, name):
    """Counts, clocks since 1970 and dates become seconds in even steps."""
    text, step = CLOCKS[name]
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    stream = time_stream(read_table(tmp_path / "a.csv"))
    np.testing.assert_allclose(np.diff(stream.times), step, atol=2e-6)
    assert len(stream) == len(STEPS)


def test_a_unit_that_was_taken_is_named(tmp_path):
    (tmp_path / "a.csv").write_text(CLOCKS["micros"][0])
    stream = time_stream(read_table(tmp_path / "a.csv"))
    assert "read as us (533.3 samples per second)" in stream.warnings[0]


@pytest.mark.parametrize("stamps", [STEPS, [2 * k for k in STEPS], [1.875 * k for k in STEPS],
                                    [10**9 * k for k in STEPS]])
def test_a_clock_of_two_meanings_is_asked_for(tmp_path, stamps):
    """Whole numbers one by one: seconds, or milliseconds of a fast logger."""
    (tmp_path / "a.csv").write_text(clocked(stamps))
    with pytest.raises(InputError, match="Name the unit in the title"):
        time_stream(read_table(tmp_path / "a.csv"))
    (tmp_path / "a.csv").write_text(clocked(stamps, "t_ms"))
    assert time_stream(read_table(tmp_path / "a.csv")).times[1] == pytest.approx(stamps[1] / 1000)


@pytest.mark.parametrize("text", ["12", "1.5", "base_link", "", "10.5.2", "99/99/2024", "-"])
def test_what_is_no_clock(text):
    assert clock_seconds(text) is None


@pytest.mark.parametrize("header", [
    "# timestamp tx ty tz qx qy qz qw",
    "time /tcp/pose/position/x /tcp/pose/position/y /tcp/pose/position/z "
    "/tcp/pose/orientation/x /tcp/pose/orientation/y /tcp/pose/orientation/z "
    "/tcp/pose/orientation/w",
    "t_s field.pose.position.x field.pose.position.y field.pose.position.z "
    "field.pose.orientation.x field.pose.orientation.y field.pose.orientation.z "
    "field.pose.orientation.w"])
def test_poses_of_tum_and_ros(tmp_path, header):
    """A translation and a quaternion, whatever topic they come from."""
    half = np.sqrt(0.5)
    path = tmp_path / "a.txt"
    path.write_text(header + "\n" + "".join(
        f"{1714558272 + 0.01 * k:.2f} 0.1 0.2 0.3 0 0 {half} {half}\n" for k in range(9)))
    stream = robot_stream(path)
    assert stream.columns[:6] == ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
    np.testing.assert_allclose(stream.values[0, :6], [0.1, 0.2, 0.3, 0, 0, np.pi / 2], atol=1e-9)


def test_a_wrench_of_a_topic_makes_a_robots_log(tmp_path):
    titles = ["time", *(f"/tcp/pose/position/{a}" for a in "xyz"),
              *(f"/ft/wrench/force/{a}" for a in "xyz")]
    assert is_robot_table([split_title(title) for title in titles])
    assert not is_robot_table([split_title(f"tip_position_{a}") for a in "xyz"])


@pytest.mark.parametrize("position", ["x y z", "pos_x pos_y pos_z", "tcp_x tcp_y tcp_z"])
def test_torques_beside_a_quaternion_stay_torques(tmp_path, position):
    """Only where nothing else is a position is tx TUM's translation."""
    (tmp_path / "a.txt").write_text(f"t_s {position} qx qy qz qw fx fy fz tx ty tz\n" + "".join(
        f"{0.01 * k} 0.1 0.2 0.3 0 0 0 1 1 2 3 4 5 6\n" for k in range(9)))
    stream = robot_stream(tmp_path / "a.txt")
    found = dict(zip(stream.columns, stream.values[0], strict=True))
    assert found["x_m"] == 0.1 and found["tx_nm"] == 4.0 and found["fx_n"] == 1.0
