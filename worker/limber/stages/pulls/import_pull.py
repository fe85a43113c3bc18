"""Stage ``import-pull``, and a pull's result."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from limber.core.errors import InputError
from limber.core.files.atomic import file_digest
from limber.core.progress import SILENT, Progress
from limber.geometry.io.formats import listed
from limber.recordings.recording_formats import RECORDINGS, recording_format
from limber.recordings.settings import ImportSettings, ImportSpec
from limber.stages.result import FORCE, POSE, Picture, Result, frozen, of_files, shown
from limber.stages.stage import About, BranchStage, KeptStage, argument, required
from limber.store import Branch

if TYPE_CHECKING:
    from limber.recordings.import_request import BranchFrame, RobotKnown
    from limber.results.report.section import Section


class Pull(Result):
    """A recording of force and motion.

    >>> pull = limber.open("a.branch").pulls["pull-1"]
    >>> pull.table()["fx_n"].shape == pull.times.shape
    True
    """

    heading = "Pull: {name}"
    missing = "limber import-pull or virtual-pull"
    pictures = (Picture("figures.pull", "Force on the branch and displacement of the grasp over "
                        "time.", ("recording",)),)
    columns: ClassVar = {"times": "time_s", "poses": POSE, "forces": FORCE,
                         "torques": "tx_nm ty_nm tz_nm"}

    name: str = shown("name")
    frame_count: int = shown("frames", ",")
    duration: float = shown("duration", ".3g s")
    way: float = shown("way", ".3g mm", meaning="largest distance of the grasp from its first "
                                                "position [m]")
    peak_force: float | None = shown("peak force", ".3g N")
    times: np.ndarray = of_files("[s], shape [n]")
    poses: np.ndarray = of_files("poses of the grasp: position [m], rotation vector [rad], shape "
                                 "[n, 6]")
    forces: np.ndarray = of_files("forces of the gripper on the branch [N], shape [n, 3]; NaN if "
                                  "not measured")
    torques: np.ndarray = of_files("likewise [N m], shape [n, 3]")
    marker_times: np.ndarray = of_files("[s], shape [k]; empty if there are no markers")
    markers: np.ndarray = of_files("positions of the observed points [m], shape [k, points, 3]; "
                                   "NaN if not observed")
    recording: Any = of_files("what was read, a :class:`limber.recordings.recording.Pull`")

    def of_folder(self, branch: Branch, key: str) -> dict[str, Any]:
        from limber.recordings.recording import read_pull

        found = read_pull(branch.path(f"pulls/{key.partition(':')[2]}"))
        seen, forces = found.observations, found.wrenches[:, :3]
        size = np.linalg.norm(forces, axis=1)
        return {"recording": found, "name": found.name, "frame_count": len(found.times),
                "duration": float(np.ptp(found.times)), "way": float(np.linalg.norm(
                    found.poses[:, :3] - found.poses[0, :3], axis=1).max()),
                "peak_force": float(np.nanmax(size)) if np.isfinite(size).any() else None,
                "times": frozen(found.times), "poses": frozen(found.poses),
                "forces": frozen(forces), "torques": frozen(found.wrenches[:, 3:]),
                "marker_times": frozen([] if seen is None else seen.times),
                "markers": frozen(np.empty((0, 0, 3)) if seen is None else seen.positions)}

    def illustrate(self, section: Section, branch: Branch, key: str) -> None:
        if self.values.get("young_true_pa") is not None:
            # The true modulus of a branch that was not generated is unknown.
            known = "a known" if branch.has("truth/truth.json") else "an assumed"
            section.title += " (simulated)"
            section.text.append("This pull was simulated on a separate, finer mesh, with "
                                f"{known} Young's modulus and sensor noise. There is no robot "
                                "recording of this branch.")
        super().illustrate(section, branch, key)


def _moved(values: Mapping[str, Any]) -> str | None:
    """Report how far the points of a load's recording moved."""
    if "displacement_m" not in values:
        return None
    farthest = float(np.linalg.norm(values["displacement_m"], axis=-1).max())
    return f"The points moved by up to {1e3 * farthest:.3g} mm under the load."


class ImportPull(ImportSettings, KeptStage, BranchStage):
    """Import a recording of a pull into the branch folder."""

    about = About(
        "import-pull", 50, Pull, key="pull:{name}", writes=("pulls/{name}/",),
        found=("Pull {pull} ({kind}): {frame_count} frames of {point_count} points.", _moved,
               "Force over displacement: {slope_n_per_m:.3g} N/m.",
               "By beam theory, force and motion imply a modulus of about {young_beam_pa:.2g} Pa."),
        then="limber estimate {branch_folder}", step="pulls", label="Import Pull")

    source: Path = argument(f"A recording: {listed(RECORDINGS.readers())}.")
    name: str = required("Name of the pull.", "pull-1", group="output")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Import a recording into ``pulls/NAME`` of a branch folder.

        Returns:
            ``pull``, ``kind`` and the result of
            :func:`limber.recordings.importing.import_recording`; of a swing under an unknown load
            that of :class:`.FitVibration`.

        Raises:
            InputError: the recording cannot be read as the stated kind.
        """
        if self.motion != "swing" or self.weight is not None or self.load is not None:
            return _imported(self, progress)
        # The load is unknown: the frequencies determine the modulus, positions do not.
        from limber.stages.moduli.vibration import FitVibration

        fitted = FitVibration(branch_folder=self.branch_folder, record=self.source,
                              rate_hz=self.rate_hz)
        return fitted.run(progress) | {"kind": "ringing"}


def _imported(asked: ImportPull, progress: Progress) -> dict[str, Any]:
    from limber.recordings.import_request import BranchFrame, ImportRequest
    from limber.recordings.importing import import_recording

    source, name = asked.source, asked.name
    if not source.exists():
        raise InputError(f"There is no {source}.", "A recording was expected.", "Check the path.")
    kind = RECORDINGS.of(source).name if asked.kind == "auto" else asked.kind
    is_force = recording_format(kind).holds == "force"
    settings, robot = _of_cell(asked)
    branch = (Branch.create if is_force else Branch.open)(asked.branch_folder)
    digests = {"source": _digest(source)}
    for key_of, named in (("robot", settings.robot), ("nominal", settings.nominal),
                          ("yolo", settings.yolo_weights), ("cell", settings.cell),
                          ("pull_toml", settings.pull_toml)):
        if named and named.is_file():
            digests[key_of] = _digest(named)
    if settings.is_kept(branch, digests=digests):
        return branch.manifest.stages[asked.entry].result
    with branch.stage(asked.entry, settings, digests=digests) as stage:
        prefix = f"pulls/{name}/"
        for old in [file for file in branch.manifest.files if file.startswith(prefix)]:
            stage.remove(old)
        folder = stage.path(prefix + "pull.toml").parent
        is_bare = is_force and not branch.has("mesh.vtu")
        frame = BranchFrame() if is_bare else _frame(branch, settings)
        in_branch = ImportSpec.of(settings.model_copy(update=_poses_in_branch(asked, branch, kind)))
        stage.result.update(import_recording(kind, ImportRequest(
            source, folder, name, in_branch, frame, robot, progress)))
        stage.result |= {"pull": name, "kind": kind}
    return stage.result


def _poses_in_branch(asked: ImportPull, branch: Branch, kind: str) -> dict[str, Any]:
    """The poses of frames in the branch's frame: those that the user gave; those of a table that
    has its own in no other frame."""
    is_table = kind in ("markers", "c3d", "robot")
    poses = {name: np.array(getattr(asked, name) or (0.0,) * 6) for name, other in (
        ("frame_pose", asked.cell), ("marker_frame", asked.nominal))
             if asked.coordinates == "scan" and (getattr(asked, name) or (is_table and not other))}
    from limber.core.numerics.rigid import composed, rotation_vector

    alignment = branch.manifest.alignment
    turn = rotation_vector(np.array(alignment.rotation))
    return {name: (*alignment.apply_metres(pose[:3]).tolist(),
                   *composed(turn, pose[3:]).tolist()) for name, pose in poses.items()}


def _of_cell(settings: ImportPull) -> tuple[ImportPull, RobotKnown | None]:
    """The settings with the cell's base, and the cell's data on its robot."""
    if settings.cell is None:
        return settings, None
    from limber.cell.cell_file import read_cell
    from limber.core.numerics.rigid import matrices, pose_vectors
    from limber.recordings.import_request import RobotKnown
    from limber.robot.recorder import known_errors, known_noise

    cell = read_cell(settings.cell)
    joint_names = cell.arm.ros_joints
    tool = matrices(np.array(cell.tool.grasp_pose))

    def joint_poses(names: tuple[str, ...], angles: np.ndarray) -> np.ndarray:
        # ROS sends joints in any order, UR's with names like left_shoulder_pan_joint.
        order = [[k for k, name in enumerate(names) if part in name] for part in joint_names]
        if any(len(found) != 1 for found in order):
            raise InputError(f"The joints are named {', '.join(names)}.",
                             f"A {cell.arm.name}'s are {', '.join(joint_names)}.",
                             "Record poses or TF, or rename the joints.")
        return pose_vectors(cell.arm.forward(angles[:, [found[0] for found in order]]) @ tool)

    if settings.frame_pose is None:
        settings = settings.model_copy(update={"frame_pose": cell.base.pose})
    return settings, RobotKnown(joint_poses, known_noise(cell),
                                lambda seconds: known_errors(cell, seconds))


def _frame(branch: Branch, settings: ImportSettings) -> BranchFrame:
    from limber.recordings.import_request import BranchFrame
    from limber.store.loading import load_mesh, load_skeleton

    loaded = settings.weight is not None or settings.load is not None
    skeleton = load_skeleton(branch) if branch.has("skeleton.swc") else None
    if not (loaded or branch.has("mesh.vtu")):
        return BranchFrame(branch.manifest.alignment, branch.gravity, skeleton=skeleton)
    mesh = load_mesh(branch)
    marks = mesh.point_data.get("control_point")
    return BranchFrame(branch.manifest.alignment, branch.gravity, mesh.nodes, skeleton,
                       None if marks is None else np.array([
                           mesh.nodes[marks == k].mean(axis=0) for k in range(marks.max() + 1)]))


def _digest(path: Path) -> str:
    if path.is_file():
        return file_digest(path)
    joined = hashlib.sha256()
    for file in sorted(path.rglob("*")):
        if file.is_file():
            joined.update(file.relative_to(path).as_posix().encode() + file_digest(file).encode())
    return joined.hexdigest()
