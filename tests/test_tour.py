"""A tour of files as other programs write them: each is read through its door, by its content."""

import re
import tomllib
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from limber.cell.known_arms import arm_named
from limber.core.errors import InputError
from limber.geometry.io.clouds import read_points
from limber.geometry.io.skeletons import read_skeleton
from limber.recordings.bag_reader import bag_arrays
from limber.recordings.force_slope import force_slope, read_force_displacement
from limber.recordings.recording_formats import RECORDINGS
from limber.recordings.tables import read_table, robot_stream, time_stream

TOUR = Path(__file__).parent / "data" / "tour"
REAL = TOUR.parent / "real"
FOREIGN = tomllib.loads((REAL / "real.toml").read_text(encoding="utf-8"))
STOPS = tomllib.loads((TOUR / "tour.toml").read_text(encoding="utf-8"))


def test_each_file_has_its_stop():
    known = {name.partition("#")[0] for stops in STOPS.values() for name in stops}
    assert known == {path.name for path in TOUR.iterdir()} - {"tour.toml", "README.md"}


@pytest.mark.parametrize(("name", "slope"), STOPS["force"].items())
def test_bending_tests_of_testing_machines(name, slope):
    assert RECORDINGS.of(TOUR / name).name == "force-displacement"
    table = read_force_displacement(TOUR / name)
    assert len(table.force) == 25 and np.ptp(table.displacement) == pytest.approx(0.024)
    assert force_slope(table.displacement, table.force).slope == pytest.approx(slope, rel=0.02)


@pytest.mark.parametrize(("name", "step"), STOPS["clock"].items())
def test_time_stamps_of_any_clock(name, step):
    """Counts, clocks since 1970 and dates become seconds in even steps."""
    stream = time_stream(read_table(TOUR / name))
    np.testing.assert_allclose(np.diff(stream.times), step, atol=2e-6)
    assert len(stream) == 30
    if "micros.csv" in name:
        assert "read as us (533.3 samples per second)" in stream.warnings[0]


@pytest.mark.parametrize(("name", "height"), STOPS["arm"].items())
def test_a_grippers_fingers_are_no_part_of_the_arm(name, height):
    """Sliding, following, and the one that others follow; the end is the hand, or its TCP."""
    with pytest.raises(InputError, match=height) if isinstance(height, str) else nullcontext():
        arm = arm_named(str(TOUR / name))
        assert arm.forward(np.zeros(6))[2, 3] == pytest.approx(height)


@pytest.mark.parametrize(("name", "turn"), STOPS["pose"].items())
def test_poses_of_tum_and_ros(name, turn):
    """A translation and a quaternion, whatever topic they come from."""
    poses = robot_stream(TOUR / name).values[:, :6]
    np.testing.assert_allclose(poses[0], [0.1, 0.2, 0.3, 0, 0, turn], atol=1e-6)


@pytest.mark.parametrize(("name", "stop"), STOPS["skeleton"].items())
def test_an_axis_in_the_models_of_other_programs(name, stop):
    """Titles by their meaning; loose parts are left out with their share; of several trees one is
    asked for; a model is no cloud."""
    if "refused" in stop:
        with pytest.raises(InputError, match=stop["refused"]):
            read_skeleton(TOUR / name)
    if "refused" not in stop or "near" in stop:
        found = read_skeleton(TOUR / name, near=stop.get("near"))
        assert found.node_count == 8 and found.length == pytest.approx(0.707107, rel=1e-5)
        assert re.search(stop.get("note", "^$"), " ".join(found.notes))
    if name.endswith(("csv", "txt")) and name != "treeqsm_text.txt":
        with pytest.raises(InputError, match=r"model.*limber mesh"):
            read_points(TOUR / name)


@pytest.mark.parametrize(("name", "stop"), STOPS["cloud"].items())
def test_clouds_of_phones_and_radiance_fields(tmp_path, name, stop):
    """Positions, colours and normals by each program's layout; floaters are left out, and said."""
    with pytest.raises(InputError, match=stop["refused"]) if "refused" in stop else nullcontext():
        found = read_points(TOUR / name)
        assert len(found) == stop["count"]
        height = found.points[:, stop.get("up", 2)]
        length = stop.get("length", 0.3 if stop["count"] != 40 else 0.249)
        assert np.ptp(height) == pytest.approx(length, abs=3e-4)
        assert np.ptp(found.points, axis=0).min() < 0.025, "a stem, without floaters"
        assert re.search(stop.get("note", "^$|vertices were read"), " ".join(map(str, found.notes)))
        if stop.get("colour", True):
            np.testing.assert_allclose(found.attributes["color"][0], [90, 60, 30], atol=1)
        if "normal" in stop:
            np.testing.assert_allclose(found.attributes["normal"][0, 0], stop["normal"], atol=1e-6)
        found.write_ply(tmp_path / "again.ply")
        assert read_points(tmp_path / "again.ply").attributes.keys() == found.attributes.keys()


@pytest.mark.parametrize(("name", "stop"), [
    (name, stop) for stops in FOREIGN.values() for name, stop in stops.items()])
def test_real_files_of_other_projects(name, stop):
    """What those projects' own programs read."""
    with pytest.raises(InputError, match=stop["refused"]) if "refused" in stop else nullcontext():
        if name in FOREIGN["skeletons"]:
            found = read_skeleton(REAL / name)
            assert found.length == pytest.approx(stop["length"])
        else:
            found = read_points(REAL / name)
            assert len(found) == stop["count"]
            assert ("color" in found.attributes) == stop.get("colour", False)
            np.testing.assert_allclose(np.ptp(found.points, axis=0), stop["size"], rtol=1e-4)
        assert re.search(stop.get("note", ""), " ".join(found.notes))


@pytest.mark.parametrize(("name", "count"), STOPS["bag"].items())
def test_a_killed_recorders_bag_is_read_to_its_last_message(name, count):
    """A force of 50 N/m, in the order of its messages; chunks that cannot be unpacked are lost."""
    found = bag_arrays(TOUR / name)
    assert int(found["read"]) == count
    assert re.search(f"has no end.*Its {count} whole messages were read, \\d+ bytes behind",
                     str(found["notes"][0]))
    force, pose = found["0_values"][:, 0], found["1_values"][:, 0]
    np.testing.assert_allclose(force[:len(pose)], 50 * pose, atol=1e-9)
