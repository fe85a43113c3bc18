"""Recordings of other programs into ``pulls/NAME``: marker tables, C3D, clouds, RGB-D folders."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import Rotation

from limber.errors import InputError
from limber.estimation.alignment import estimate_offset
from limber.estimation.checks import FORCE_UNITS_N, clean
from limber.estimation.force_slope import WHY_NO_MODULUS, force_slope, read_force_displacement
from limber.estimation.recording import (
    POSE_COLUMNS,
    WRENCH_COLUMNS,
    GraspEntry,
    Observations,
    Pull,
    PullEntry,
    SensorEntry,
    read_pull,
    write_entry,
    write_pull,
)
from limber.estimation.streams import Stream, read_stream
from limber.perception.camera import Camera, read_camera, write_camera
from limber.progress import SILENT, Progress
from limber.store import Branch, file_digest

LENGTH_UNITS_M = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
Kind = Literal["auto", "pull", "markers", "c3d", "clouds", "rgbd", "force-displacement"]


class ImportSettings(BaseModel):
    """How to read a recording."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Kind = Field("auto", description="What SOURCE is; auto goes by its name and content.")
    robot: str | None = Field(None, description="CSV of the gripper: t_s, pose and wrench.")
    unit: Literal["m", "cm", "mm"] = Field("m", description="Unit of positions in SOURCE.")
    force_unit: Literal["N", "gf", "mN", "lbf", "kgf", "kN"] = Field(
        "N", description="Unit of forces in the robot's table.")
    rate_hz: float | None = Field(
        None, gt=0, description="Frames a second, where file names are mere numbers.")
    nominal: str | None = Field(
        None, description="CSV label,x_m,y_m,z_m: the markers at rest in the branch's frame; the "
        "recording's first frame is fitted to it.")
    grasp_point: tuple[float, float, float] | None = Field(
        None, description="Where the gripper holds, at rest [m]; else the robot's first pose.")
    grasp_radius: float = Field(0.01, gt=0, description="Radius of the grasp patch [m].")
    grasp_mode: Literal["clamped", "pinned"] = Field(
        "clamped", description="clamped: the gripper also turns the branch.")
    drive: Literal["pose", "force"] = Field(
        "pose", description="What drives the simulation; the other is compared with it.")
    motion: Literal["quasi_static", "dynamic"] = Field(
        "quasi_static", description="dynamic where inertia matters.")
    time_offset: float | None = Field(
        None, description="Added to SOURCE's time stamps [s]; without it, it is estimated.")
    position_sigma: float = Field(1e-3, gt=0, description="Noise of positions [m].")
    force_sigma: float = Field(0.1, gt=0, description="Noise of forces [N].")


def import_pull(branch_folder: Path, source: Path, name: str, settings: ImportSettings, *,
                force: bool = False, progress: Progress = SILENT, warn: Any = lambda text: None,
                ) -> dict[str, Any]:
    """Bring a recording into ``pulls/NAME`` of a branch folder.

    Returns:
        ``pull``, ``kind``, ``frame_count``, ``point_count``, ``time_offset_s``; of a force table
        ``slope_n_per_m``, ``slope_interval_n_per_m`` and ``why_no_modulus``.

    Raises:
        InputError: SOURCE cannot be read as what it is said to be.
    """
    source = Path(source)
    if not source.exists():
        raise InputError(f"There is no {source}.", "A recording was expected.", "Check the path.")
    kind = _guess(source) if settings.kind == "auto" else settings.kind
    branch = (Branch.create if kind == "force-displacement" else Branch.open)(branch_folder)
    key, digests = f"pull:{name}", {"source": _digest(source)}
    if settings.robot:
        digests["robot"] = _digest(Path(settings.robot))
    if not force and branch.is_current(key, settings, digests=digests):
        return branch.manifest.stages[key].result
    with branch.stage(key, settings, digests=digests) as stage:
        prefix = f"pulls/{name}/"
        for old in [file for file in branch.manifest.files if file.startswith(prefix)]:
            stage.remove(old)
        folder = stage.path(prefix + "pull.toml").parent
        progress(0.1, f"reading {kind}")
        if kind == "force-displacement":
            stage.result.update(_import_force_table(source, folder, warn))
        else:
            stage.result.update(_import_motion(kind, source, folder, name, settings, warn))
        stage.result |= {"pull": name, "kind": kind}
    return stage.result


def markers_from_c3d(path: Path) -> tuple[Stream, list[str]]:
    """Read the points of a C3D file [m], and their labels.

    Raises:
        InputError: not a C3D file, or one without points.
    """
    import ezc3d

    try:
        data = ezc3d.c3d(str(path))
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{path} cannot be read as C3D ({error}).",
                         "Marker tracks were expected.", "Check the file.") from error
    points = data["data"]["points"][:3]
    if not points.size:
        raise InputError(f"{path} has no points.", "Marker tracks were expected.",
                         "Export the trajectories as well.")
    unit = (data["parameters"]["POINT"].get("UNITS", {}).get("value") or ["mm"])[0].strip()
    scale = LENGTH_UNITS_M.get(unit.lower(), 1e-3)
    labels = [str(label) for label in data["parameters"]["POINT"]["LABELS"]["value"]]
    rate = float(data["header"]["points"]["frame_rate"])
    positions = np.moveaxis(points, 0, -1).transpose(1, 0, 2) * scale
    # An unseen marker is written as (0, 0, 0) by many programs, as NaN by others.
    positions[np.all(positions == 0.0, axis=2)] = np.nan
    times = np.arange(len(positions)) / rate
    names = tuple(f"m{k}_{axis}_m" for k in range(positions.shape[1]) for axis in "xyz")
    return Stream(times, positions.reshape(len(times), -1), names), labels[:positions.shape[1]]


def rigid_fit(points: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [3, 3] and translation [3] that take ``points`` onto ``target`` (Kabsch), [n, 3]."""
    centre, goal = points.mean(axis=0), target.mean(axis=0)
    left, _, right = np.linalg.svd((points - centre).T @ (target - goal))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(right.T @ left.T))])
    turn = right.T @ flip @ left.T
    return turn, goal - turn @ centre


def _guess(source: Path) -> str:
    if source.is_dir():
        if (source / "pull.toml").exists():
            return "pull"
        if (source / "depth").is_dir():
            return "rgbd"
        return "clouds"
    if source.suffix.lower() == ".c3d":
        return "c3d"
    header = source.read_text(encoding="utf-8-sig", errors="replace").split("\n", 1)[0].lower()
    by_force = "displacement" in header and ("force" in header or "load" in header)
    return "force-displacement" if by_force else "markers"


def _digest(path: Path) -> str:
    if path.is_file():
        return file_digest(path)
    import hashlib

    joined = hashlib.sha256()
    for file in sorted(path.rglob("*")):
        if file.is_file():
            joined.update(file.relative_to(path).as_posix().encode() + file_digest(file).encode())
    return joined.hexdigest()


def _import_force_table(source: Path, folder: Path, warn: Any) -> dict[str, Any]:
    displacement, force, warnings = read_force_displacement(source)
    found = force_slope(displacement, force, warnings=warnings)
    for message in found.warnings:
        warn(message)
    warn(f"No modulus from {source.name}. {WHY_NO_MODULUS}")
    table = np.column_stack([displacement, force])
    np.savetxt(folder / "force.csv", table, "%.9g", ",", header="displacement_m,force_n",
               comments="")
    return {"slope_n_per_m": found.slope, "slope_interval_n_per_m": list(found.interval),
            "contact_m": found.contact, "baseline_n": found.baseline,
            "stiffening": found.stiffening, "frame_count": len(force),
            "why_no_modulus": WHY_NO_MODULUS}


def _import_motion(kind: str, source: Path, folder: Path, name: str, settings: ImportSettings,
                   warn: Any) -> dict[str, Any]:
    if kind == "pull":
        shutil.copytree(source, folder, dirs_exist_ok=True)
        pull = read_pull(folder)
    else:
        pull = _assembled(kind, source, folder, name, settings)
        write_pull(folder, pull)
    cleaned = clean(pull)
    for message in cleaned.warnings:
        warn(message)
    entry = pull.entry
    if kind != "pull" and settings.time_offset is None and cleaned.observations is not None:
        offset, sigma = estimate_offset(cleaned)
        if sigma < 0.02:
            entry = entry.model_copy(update={"time_offset_s": offset})
            write_entry(folder / "pull.toml", entry)
        else:
            warn(f"{name}: the clocks' offset cannot be told from this pull; 0 was taken.")
    seen = cleaned.observations
    return {"frame_count": len(seen.times) if seen is not None else len(pull.times),
            "point_count": seen.point_count if seen is not None else 0,
            "time_offset_s": entry.time_offset_s}


def _assembled(kind: str, source: Path, folder: Path, name: str, settings: ImportSettings) -> Pull:
    observations, rest, labels = None, None, None
    if kind in ("markers", "c3d"):
        stream, labels = (markers_from_c3d(source) if kind == "c3d" else
                          (read_stream(source), None))
        scale = 1.0 if kind == "c3d" else LENGTH_UNITS_M[settings.unit]
        labels = labels or [column.rsplit("_x", 1)[0] for column in stream.columns[::3]]
        observations = Observations(stream.times,
                                    stream.values.reshape(len(stream), -1, 3) * scale)
        if settings.nominal:
            observations, rest = _onto_nominal(observations, labels, Path(settings.nominal))
    else:
        copy = _copy_rgbd if kind == "rgbd" else _copy_clouds
        copy(source, folder, settings)
    times, poses, wrenches, warnings = _robot(settings, observations, rest)
    grasp = settings.grasp_point or tuple(float(x) for x in poses[0, :3])
    entry = PullEntry(
        observation={"rgbd": "depth", "clouds": "clouds"}.get(kind, "markers"),
        drive=settings.drive, motion=settings.motion,
        time_offset_s=settings.time_offset or 0.0, source=source.name,
        grasp=GraspEntry(point_m=grasp, radius_m=settings.grasp_radius, mode=settings.grasp_mode),
        sensor=SensorEntry(position_sigma_m=settings.position_sigma,
                           force_sigma_n=settings.force_sigma),
        rest_points_m=None if rest is None else tuple(map(tuple, rest.tolist())))
    return Pull(name, entry, times, poses, wrenches, observations, warnings)


def _robot(settings: ImportSettings, observations: Observations | None, rest: np.ndarray | None,
           ) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[str, ...]]:
    if settings.robot is None:
        raise InputError("No robot table was given.",
                         "A pull needs what the gripper did: pose, and force where measured.",
                         "Give it with --robot ROBOT.csv.")
    stream = read_stream(settings.robot)
    missing = [column for column in POSE_COLUMNS if column not in stream.columns]
    if missing:
        raise InputError(f"{settings.robot} lacks {', '.join(missing)}.",
                         "The gripper's pose in the branch's frame is needed.",
                         f"Columns: t_s, {', '.join(POSE_COLUMNS + WRENCH_COLUMNS)}.")
    scale = 1.0 if settings.force_unit == "N" else FORCE_UNITS_N[settings.force_unit]
    values = {column: stream.values[:, stream.columns.index(column)] for column in stream.columns}
    poses = np.column_stack([values[column] for column in POSE_COLUMNS])
    empty = np.full(len(stream), np.nan)
    wrenches = scale * np.column_stack([values.get(column, empty) for column in WRENCH_COLUMNS])
    return stream.times, poses, wrenches, stream.warnings


def _onto_nominal(observations: Observations, labels: list[str], path: Path,
                  ) -> tuple[Observations, np.ndarray]:
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()[1:] if line]
    nominal = {row[0].strip(): [float(x) for x in row[1:4]] for row in rows}
    shared = [k for k, label in enumerate(labels) if label in nominal]
    if len(shared) < 3:
        raise InputError(f"{path} names {', '.join(nominal)}; the recording {', '.join(labels)}.",
                         "Three markers in common are needed for a rigid fit.",
                         "Use the recording's labels.")
    first = observations.positions[0, shared]
    turn, shift = rigid_fit(first, np.array([nominal[labels[k]] for k in shared]))
    moved = observations.positions[:, shared] @ turn.T + shift
    return replace(observations, positions=moved), moved[0]


def _copy_clouds(source: Path, folder: Path, settings: ImportSettings) -> None:
    from plyfile import PlyData, PlyElement

    files = sorted(source.glob("*.ply"))
    if len(files) < 2:
        raise InputError(f"{source} has {len(files)} PLY files.",
                         "A folder of frames was expected.", "Name the folder that holds them.")
    scale = LENGTH_UNITS_M[settings.unit]
    (folder / "clouds").mkdir(parents=True, exist_ok=True)
    for index, file in enumerate(files):
        vertex = PlyData.read(str(file))["vertex"]
        points = np.zeros(len(vertex), [("x", "f4"), ("y", "f4"), ("z", "f4")])
        for axis in "xyz":
            points[axis] = np.asarray(vertex[axis]) * scale
        target = folder / "clouds" / f"{_stamp(file, index, settings):.6f}.ply"
        PlyData([PlyElement.describe(points, "vertex")], byte_order="<").write(str(target))
    if (source / "camera.toml").exists():
        write_camera(folder / "camera.toml", read_camera(source / "camera.toml"))


def _copy_rgbd(source: Path, folder: Path, settings: ImportSettings) -> None:
    camera = read_camera(source / "camera.toml")
    listed = _tum_list(source / "depth.txt") or [
        (_stamp(file, index, settings), file)
        for index, file in enumerate(sorted((source / "depth").glob("*.png")))]
    poses = _tum_list(source / "groundtruth.txt")
    if poses:
        camera = _posed(camera, poses[0][1])
    write_camera(folder / "camera.toml", camera)
    (folder / "depth").mkdir(parents=True, exist_ok=True)
    masks = dict(_tum_list(source / "mask.txt"))
    for stamp, file in listed:
        path = source / file if isinstance(file, str) else file
        if not path.is_file():
            raise InputError(f"{source / 'depth.txt'} names {file}, which is not there.",
                             "The recording is incomplete.", "Copy the whole folder.")
        shutil.copyfile(path, folder / "depth" / f"{stamp:.6f}.png")
        mask = source / masks[_nearest(masks, stamp)] if masks else source / "mask" / path.name
        if mask.is_file():
            (folder / "mask").mkdir(exist_ok=True)
            shutil.copyfile(mask, folder / "mask" / f"{stamp:.6f}.png")
    if (source / "background.png").is_file():
        shutil.copyfile(source / "background.png", folder / "background.png")


def _nearest(stamps: dict[float, Any], wanted: float) -> float:
    return min(stamps, key=lambda stamp: abs(stamp - wanted))


def _tum_list(path: Path) -> list[tuple[float, str]]:
    """Read TUM's ``timestamp value...`` lists; lines with # are comments."""
    if not path.is_file():
        return []
    lines = [line.split(None, 1) for line in path.read_text(encoding="utf-8").splitlines()
             if line.strip() and not line.startswith("#")]
    try:
        return [(float(stamp), rest.strip()) for stamp, rest in lines]
    except ValueError as error:
        raise InputError(f"{path} is not a list of time stamps ({error}).",
                         "Each line is `timestamp file` or `timestamp tx ty tz qx qy qz qw`.",
                         "Correct the file.") from error


def _posed(camera: Camera, text: str) -> Camera:
    numbers = [float(part) for part in text.split()]
    turn = Rotation.from_quat(numbers[3:7]).as_rotvec()
    return camera.model_copy(update={"pose": (*numbers[:3], *map(float, turn))})


def _stamp(file: Path, index: int, settings: ImportSettings) -> float:
    if settings.rate_hz is not None:
        return index / settings.rate_hz
    try:
        return float(file.stem)
    except ValueError as error:
        raise InputError(f"The file name {file.name} is no time stamp.",
                         "Frames need times.", "Give --rate-hz.") from error
