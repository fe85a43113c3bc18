"""Positions in the scan's coordinates, by the option that stages share."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from limber.cli.main import call
from limber.core.alignment import Alignment
from limber.core.errors import InputError
from limber.core.progress import Progress
from limber.geometry.tets.tree_sweep import straight_beam
from limber.recordings.recording import read_pull
from limber.recordings.time_series import Stream, read_stream, write_stream
from limber.stages.pulls.import_pull import ImportPull
from limber.stages.registry import stage_class
from limber.stages.shape.target import SetTarget
from limber.store import Branch
from limber.store.loading import load_branch, load_targets

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
    at = read_pull(folder / "pulls" / "pull-1").entry.grasp.point_m
    in_scan = ALIGNMENT.undo(np.array([at]))[0] * ALIGNMENT.scale
    found = [SetTarget(branch_folder=folder, name=name, at=tuple(place),
                       coordinates=frame).run()["position_m"]
             for name, place, frame in (("a", at, "branch"), ("b", in_scan, "scan"))]
    np.testing.assert_allclose(found[1], found[0], atol=1e-12)


@pytest.mark.parametrize("name", ["plan", "compare", "target"])
def test_all_positions_are_moved_and_boxes_refused(tmp_path, name):
    """No position of these stages stays behind."""
    folder = _aligned(shutil.copytree(EXAMPLE, tmp_path / "a.branch"))
    stage = stage_class(name)
    fields = {field: stage.model_fields[field] for field in stage.parts()["settings"]}
    kinds = {field: (about.json_schema_extra or {}).get("frame") for field, about in fields.items()}
    listed = {field for field, about in fields.items()
              if "position" in (about.description or "").lower()
              and "tuple" in str(about.annotation)}
    assert listed == {field for field, kind in kinds.items() if kind == "branch"}
    asked = stage.checked(
        {"branch_folder": folder, "coordinates": "scan"}
        | ({"name": "a"} if name == "target" else {}) | dict.fromkeys(listed, (5.1, -2.0, 1.0)))
    moved = asked.in_branch()
    for field in listed:
        np.testing.assert_allclose(getattr(moved, field), (0, -0.1, 0), atol=1e-12)
    for field in (field for field, kind in kinds.items() if kind == "branch axes"):
        with pytest.raises(InputError, match=field.replace("_", "-")):
            asked.model_copy(update={field: (0.0, 0.0, 0.0)}).in_branch()


@pytest.mark.slow
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
    ImportPull(branch_folder=folder, source=tmp_path / "markers.csv", name="own",
               robot=str(tmp_path / "robot.csv"), coordinates="scan", time_offset=0.0,
               marker_frame=(0.5, 0.2, 0.0, 0.0, 0.0, np.pi / 2),
               frame_pose=(1.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2)).run()
    found = read_pull(folder / "pulls" / "own")
    np.testing.assert_allclose(found.observations.positions, seen.positions, atol=1e-6)
    # They need not be the control points: they rest where the first frame shows them.
    np.testing.assert_allclose(found.entry.rest_points_m, seen.positions[0], atol=1e-6)
    np.testing.assert_allclose(found.poses, pull.poses, atol=1e-6)
    np.testing.assert_allclose(found.wrenches, pull.wrenches, atol=1e-6)


QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


# `limber target`: places on the branch, what is refused, and who follows them.


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "beam.branch"
    with Branch.create(folder).stage("mesh") as stage:
        straight_beam(0.3, 0.006, 0.005, slice_count=10, young=1e9).write(stage.path("mesh.vtu"))
    return folder


def test_targets_are_set_replaced_and_removed(folder, capsys):
    """By the command: each is said to hang on the nearest place of the branch; files agree."""
    assert call(["target", str(folder), "flower", "--at", "0.012", "0", "0.2", "--mass", "0.01",
                 "--json"]) == 0
    said = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert said["target"] == "flower" and said["targets"] == ["flower"]
    # The beam is 5.3 mm thick there, with six sides.
    assert 0.0062 < said["distance_m"] < 0.0077
    np.testing.assert_allclose(said["branch_point_m"][2], 0.2, atol=2e-3)
    SetTarget(branch_folder=folder, name="leaf", at=(0.0, 0.0, 0.1)).run()
    SetTarget(branch_folder=folder, name="flower", at=(0.0, 0.0, 0.25), mass=0.02).run()
    targets = load_targets(Branch.open(folder))
    assert [(t.name, t.position, t.mass) for t in targets] == [
        ("flower", (0.0, 0.0, 0.25), 0.02), ("leaf", (0.0, 0.0, 0.1), 0.0)]
    loaded = load_branch(Branch.open(folder), gravity=True,
                         progress=Progress(on_warning=pytest.fail))
    assert [m.mass for m in loaded.model.point_masses] == [0.02]
    result = SetTarget(branch_folder=folder, name="flower", remove=True).run()
    assert result["targets"] == ["leaf"]
    assert [t.name for t in load_targets(Branch.open(folder))] == ["leaf"]


def test_one_that_is_there_is_left_as_it_is(folder):
    """Unless it was moved, taken out or asked for again; so is one that is not there."""
    def finished(name="flower"):
        return Branch.open(folder).manifest.stages[f"target:{name}"]
    wish = {"at": (0.0, 0.0, 0.2)}
    first = SetTarget(branch_folder=folder, name="flower", **wish).run()
    before = finished()
    SetTarget(branch_folder=folder, name="leaf", at=(0.0, 0.0, 0.1)).run()
    again = SetTarget(branch_folder=folder, name="flower", **wish).run()
    assert finished() == before and again["targets"] == ["flower", "leaf"]
    assert again["position_m"] == list(first["position_m"])
    SetTarget(branch_folder=folder, name="flower", **wish | {"mass": 0.5}).run()
    assert finished() != before
    SetTarget(branch_folder=folder, name="flower", remove=True).run()
    assert SetTarget(branch_folder=folder, name="flower", remove=True).run()["targets"] == ["leaf"]
    SetTarget(branch_folder=folder, name="flower", **wish).run()
    assert {one.name for one in load_targets(Branch.open(folder))} == {"flower", "leaf"}


@pytest.mark.parametrize(("name", "settings", "words"), [
    ("flower", {"at": (0.2, 0.0, 0.2)}, "away from the branch"),
    ("flower", {"at": (0.0, 0.0, 200.0)}, "unit"),
    ("flower", {"at": (float("nan"), 0.0, 0.1)}, "finite"),
    ("../flower", {"at": (0.0, 0.0, 0.1)}, "cannot name"),
    ("flower", {}, "--remove"),
    ("flower", {"at": (0.0, 0.0, 0.1), "remove": True}, "Both"),
    ("flower", {"remove": True}, "no target"),
])
def test_what_is_refused(folder, name, settings, words):
    """With its reason; targets from before stay."""
    SetTarget(branch_folder=folder, name="leaf", at=(0.0, 0.0, 0.1)).run()
    with pytest.raises(InputError) as caught:
        SetTarget.checked({"branch_folder": folder, "name": name, **settings}).run()
    assert words in str(caught.value)
    assert [t.name for t in load_targets(Branch.open(folder))] == ["leaf"]


def test_newer_file_is_not_misread(folder):
    """Targets of another format are not guessed at."""
    with Branch.open(folder).stage("target:x") as stage:
        stage.path("targets.json").write_text('{"format_version": 2, "targets": []}')
    with pytest.raises(InputError, match="format 2"):
        load_targets(Branch.open(folder))
