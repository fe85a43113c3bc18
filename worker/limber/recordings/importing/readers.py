"""Detection and reading of recordings other than bags: folders, tables, logs."""

import re
import shutil
from functools import lru_cache
from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.core.files.safe_names import refuse_links
from limber.recordings.force_slope import ForceTable, read_force_displacement
from limber.recordings.image_folders import copy_clouds, copy_rgbd, moved_into
from limber.recordings.importing.import_request import ImportRequest
from limber.recordings.recording import POSE_COLUMNS, WRENCH_COLUMNS, Pull, read_pull
from limber.recordings.robot_tables import is_robot_table, robot_stream, with_columns
from limber.recordings.tables import Title, marker_stream, read_table, split_title
from limber.recordings.time_series import Stream


def read_folder(path: Path, request: ImportRequest) -> Pull:
    """Copy a folder in the pull format and read it."""
    refuse_links(path)
    shutil.copytree(path, request.folder, dirs_exist_ok=True)
    return read_pull(request.folder)


def read_rgbd(path: Path, request: ImportRequest) -> list[str]:
    """Copy a folder of depth images; return warnings."""
    return copy_rgbd(path, request.folder, request.settings, request.progress)


def read_clouds(path: Path, request: ImportRequest) -> list[str]:
    """Copy a folder of clouds; return warnings."""
    return copy_clouds(path, request.folder, request.settings, request.progress)


def is_force_table(path: Path) -> bool:
    """Whether it is a table of displacement and force."""
    names = [title.name.lower() for title in _titles(path)]
    moved = any(re.search(r"displacement|travel|stroke|deflection", name) for name in names)
    return moved and any(re.search(r"force|load", name) for name in names)


def read_force_table(path: Path, request: ImportRequest) -> ForceTable:
    """Return displacements [m] and forces [N]."""
    return read_force_displacement(path, unit=request.settings.unit,
                                   force_unit=request.settings.force_unit)


def is_robot_log(path: Path) -> bool:
    """Whether it is a table of a gripper's position and force."""
    return is_robot_table(_titles(path))


def read_robot(path: Path, request: ImportRequest) -> Stream:
    """Return the gripper's poses and the wrenches about them, in the branch's frame."""
    settings = request.settings
    robot = robot_stream(path, settings.force_unit, settings.rate_hz)
    stream = with_columns(robot, POSE_COLUMNS + WRENCH_COLUMNS)
    if settings.frame_pose is None:
        return stream
    moved = moved_into(settings.frame_pose, stream.values[:, :6], stream.values[:, 6:])
    return Stream(stream.times, np.hstack(moved), stream.columns, stream.warnings)


def read_markers(path: Path, request: ImportRequest) -> tuple[Stream, list[str]]:
    """Return tracks of markers [m], and their labels."""
    return marker_stream(path, request.settings.unit, request.settings.rate_hz)


def _titles(path: Path) -> list[Title]:
    return _titles_of(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _titles_of(path: Path, _changed: int) -> list[Title]:
    """The columns of a table, used by several formats; none if it is no table."""
    try:
        return [split_title(title) for title in read_table(path).titles]
    except InputError:
        return []
