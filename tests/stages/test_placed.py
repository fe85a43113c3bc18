"""Positions in the scan's coordinates, by the option that stages share."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from limber.core.alignment import Alignment
from limber.core.errors import InputError
from limber.recordings.recording import read_pull
from limber.recordings.settings import ImportSettings
from limber.recordings.time_series import Stream, read_stream, write_stream
from limber.stages.pulls.import_pull import import_pull
from limber.stages.registry import stage_description

EXAMPLE = Path(__file__).parents[2] / "blend_files" / "bending_branch"
ALIGNMENT = Alignment(scale=1e-3, origin=(5.0, -2.0, 1.0),
                      rotation=((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
"""Of a scan in millimetres, turned and far from its root."""


def _aligned(folder: Path) -> Path:
    entries = json.loads((folder / "branch.json").read_text())
    entries["alignment"] = ALIGNMENT.model_dump()
    (folder / "branch.json").write_text(json.dumps(entries))
    return folder


def test_a_target_is_where_the_scan_shows_it(tmp_path):
    """At the same point of the branch as by the branch's own coordinates."""
    folder = _aligned(shutil.copytree(EXAMPLE, tmp_path / "a.branch"))
    stage = stage_description("target")
    at = read_pull(folder / "pulls" / "pull-1").entry.grasp.point_m
    in_scan = ALIGNMENT.undo(np.array([at]))[0] * ALIGNMENT.scale
    found = [stage.run(*stage.models({"branch_folder": folder, "name": name, "at": tuple(place),
                                      "coordinates": frame}), None)["position_m"]
             for name, place, frame in (("a", at, "branch"), ("b", in_scan, "scan"))]
    np.testing.assert_allclose(found[1], found[0], atol=1e-12)


@pytest.mark.parametrize("name", ["plan", "compare", "target"])
def test_all_positions_are_moved_and_boxes_refused(tmp_path, name):
    """No position of these stages stays behind."""
    folder = _aligned(shutil.copytree(EXAMPLE, tmp_path / "a.branch"))
    stage = stage_description(name)
    kinds = {field: (about.json_schema_extra or {}).get("frame")
             for field, about in stage.settings.model_fields.items()}
    listed = {field for field, about in stage.settings.model_fields.items()
              if "position" in (about.description or "").lower()
              and "tuple" in str(about.annotation)}
    assert listed == {field for field, kind in kinds.items() if kind == "branch"}
    inputs, settings, _ = stage.models(
        {"branch_folder": folder, "coordinates": "scan"}
        | ({"name": "a"} if name == "target" else {}) | dict.fromkeys(listed, (5.1, -2.0, 1.0)))
    moved = inputs.in_branch(settings)
    for field in listed:
        np.testing.assert_allclose(getattr(moved, field), (0, -0.1, 0), atol=1e-12)
    for field in (field for field, kind in kinds.items() if kind == "branch axes"):
        with pytest.raises(InputError, match=field.replace("_", "-")):
            inputs.in_branch(settings.model_copy(update={field: (0.0, 0.0, 0.0)}))


def test_tables_in_frames_of_their_own(tmp_path):
    """Markers in a motion capture's frame, poses and forces in a robot's, both known in the scan's
    coordinates: the pull is that of tables in the branch's frame.
    """
    folder = _aligned(shutil.copytree(EXAMPLE, tmp_path / "a.branch"))
    pull = read_pull(folder / "pulls" / "pull-1")
    seen, gripper = pull.observations, read_stream(folder / "pulls" / "pull-1" / "robot.csv")
    to_branch = np.array(ALIGNMENT.rotation)

    def in_frame(points, shift):
        """Points of the branch in a frame at ``shift`` in the scan, turned by 90 degrees about z.
        """
        in_scan = points @ to_branch + ALIGNMENT.origin
        return (in_scan - shift) @ QUARTER

    robot = gripper.values.copy()
    robot[:, :3] = in_frame(robot[:, :3], (1.0, 0.0, 0.0))
    for columns in (slice(6, 9), slice(9, 12)):
        robot[:, columns] = robot[:, columns] @ to_branch @ QUARTER
    # 90 degrees of the frame undo those of the alignment: rotations stay.
    write_stream(tmp_path / "robot.csv", Stream(gripper.times, robot, gripper.columns))
    count = seen.positions.shape[1]
    write_stream(tmp_path / "markers.csv", Stream(
        seen.times, in_frame(seen.positions, (0.5, 0.2, 0.0)).reshape(len(seen.times), -1),
        tuple(f"m{k}_{axis}_m" for k in range(count) for axis in "xyz")))
    import_pull(folder, tmp_path / "markers.csv", "own", ImportSettings(
        robot=str(tmp_path / "robot.csv"), coordinates="scan", time_offset=0.0,
        marker_frame=(0.5, 0.2, 0.0, 0.0, 0.0, np.pi / 2),
        frame_pose=(1.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2)))
    found = read_pull(folder / "pulls" / "own")
    np.testing.assert_allclose(found.observations.positions, seen.positions, atol=1e-6)
    # They need not be the control points: they rest where the first frame shows them.
    np.testing.assert_allclose(found.entry.rest_points_m, seen.positions[0], atol=1e-6)
    np.testing.assert_allclose(found.poses, pull.poses, atol=1e-6)
    np.testing.assert_allclose(found.wrenches, pull.wrenches, atol=1e-6)


QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
