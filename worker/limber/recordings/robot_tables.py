"""Robot tables: the gripper's pose and wrench, whatever the names of the columns."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from limber.core.constants import FORCE_UNITS_N
from limber.core.errors import InputError, Option, Text
from limber.recordings.recording import POSE_COLUMNS, WRENCH_COLUMNS
from limber.recordings.tables import (
    ANGLE_UNITS_RAD,
    FORCE_NAMES_N,
    LENGTH_UNITS_M,
    TORQUE_UNITS_NM,
    Title,
    read_table,
    scale_of,
    split_title,
    time_stream,
)
from limber.recordings.time_series import Stream

_ALIASES = {
    **{f"{a}_m": (a, f"p{a}", f"pos{a}", f"position{a}", f"tcp{a}", f"actualtcppose{k}",
                  f"otee{12 + k}") for k, a in enumerate("xyz")},
    **{f"r{a}_rad": (f"r{a}", f"rot{a}", f"rotvec{a}", f"tcpr{a}", f"actualtcppose{k}")
       for k, a in enumerate("xyz", 3)},
    **{f"f{a}_n": (f"f{a}", f"force{a}", f"tcpf{a}", f"actualtcpforce{k}", f"ofexthatk{k}")
       for k, a in enumerate("xyz")},
    **{f"t{a}_nm": (f"t{a}", f"m{a}", f"torque{a}", f"actualtcpforce{k}", f"ofexthatk{k}")
       for k, a in enumerate("xyz", 3)}}
_QUATERNION = {f"q{a}": f"orientation{a}" for a in "xyzw"}
_IN_TOPICS = {**{f"{a}_m": f"position{a}" for a in "xyz"},
              **{f"f{a}_n": f"force{a}" for a in "xyz"},
              **{f"t{a}_nm": f"torque{a}" for a in "xyz"}}
"""Last parts of the names in ROS messages, whatever topic precedes them."""
_ANGLES = (("roll", "pitch", "yaw"), ("c", "b", "a"))
"""About the fixed axes x, y, z in turn: of most programs, and of KUKA's A, B, C."""
_TRANSFORM = "otee"
"""Franka's ``O_T_EE``, by columns."""
_UNITS = {"m": (LENGTH_UNITS_M, "m"), "rad": (ANGLE_UNITS_RAD, "rad"),
          "n": (FORCE_NAMES_N, "N"), "nm": (TORQUE_UNITS_NM, "Nm")}


def robot_stream(path: str | Path, force_unit: str | None = None,
                 rate_hz: float | None = None) -> Stream:
    """Read a robot's table: the columns x_m .. rz_rad, fx_n .. tz_nm; NaN if not measured. Known
    names are our own, those of UR's RTDE (``actual_TCP_pose_0``) and Franka's libfranka
    (``O_T_EE_0``, ``O_F_ext_hat_K_0``), and short ones with a unit; a rotation may be a quaternion
    qx .. qw, or angles roll, pitch, yaw or KUKA's A, B, C. ``force_unit`` overrides the titles',
    ``rate_hz`` stands for a missing time column. InputError if the gripper's position is
    missing."""
    table = read_table(path)
    stream = time_stream(table, rate_hz)
    titles = _known([split_title(title) for title in stream.columns])
    values, warnings = {}, list(stream.warnings)
    for name, aliases in _ALIASES.items():
        at = next((k for k, title in enumerate(titles) if title.plain in aliases), None)
        if at is not None:
            values[name] = stream.values[:, at] * _scale(name, titles[at], force_unit, Path(path))
    missing = [name for name in POSE_COLUMNS[:3] if name not in values]
    if missing:
        raise InputError(f"{path} lacks {', '.join(missing)}.",
                         "The gripper's pose in the branch's frame is needed.",
                         f"Columns: t_s, {', '.join(POSE_COLUMNS + WRENCH_COLUMNS)}.")
    _add_rotation(values, titles, stream, warnings, Path(path))
    unmeasured = np.full(len(stream), np.nan)
    found = np.column_stack([values.get(name, unmeasured) for name in _ALIASES])
    return Stream(stream.times, found, tuple(_ALIASES), tuple(warnings))


def is_robot_table(titles: list[Title]) -> bool:
    """Return whether the columns hold a gripper's position and force, as a robot's log does."""
    plain = {title.plain for title in _known(titles)}
    return all(plain & set(_ALIASES[name]) for name in (*POSE_COLUMNS[:3],
                                                        *WRENCH_COLUMNS[:3]))


def _known(titles: list[Title]) -> list[Title]:
    """Titles of ROS topics and of TUM's trajectories, renamed to our names."""
    plain = [title.plain for title in titles]
    if {"tx", "ty", "tz", "qx", "qy", "qz", "qw"} <= set(plain) and not (
            set(_ALIASES["x_m"]) & set(plain)):
        # TUM's translation; without a quaternion it is a torque.
        positions = {f"t{a}": f"p{a}" for a in "xyz"}
        return [Title(positions.get(title.plain, title.name), title.unit) for title in titles]
    renamed = list(titles)
    for name, aliases in _ALIASES.items():
        end = _IN_TOPICS.get(name)
        if end and not set(aliases) & set(plain):
            at = next((k for k, letters in enumerate(plain) if letters.endswith(end)), None)
            if at is not None:
                renamed[at] = Title(aliases[0], titles[at].unit)
    for part, end in _QUATERNION.items():
        at = next((k for k, letters in enumerate(plain) if letters.endswith(end)), None)
        if at is not None and part not in plain:
            renamed[at] = Title(part, None)
    return renamed


def _scale(name: str, title: Title, force_unit: str | None, path: Path) -> float:
    kind = name.rpartition("_")[2]
    if force_unit and kind in ("n", "nm"):
        return FORCE_UNITS_N[force_unit]
    return scale_of(title, *_UNITS[kind], path)


def _add_rotation(values: dict[str, np.ndarray], titles: list[Title], stream: Stream,
                  warnings: list[str], path: Path) -> None:
    if all(name in values for name in POSE_COLUMNS[3:]):
        return
    at = {title.plain: k for k, title in enumerate(titles)}
    angles = next((names for names in _ANGLES if set(names) <= set(at)), None)
    if all(name in at for name in ("qx", "qy", "qz", "qw")):
        turns = _of_quaternions(stream.values[:, [at["qx"], at["qy"], at["qz"], at["qw"]]])
    elif f"{_TRANSFORM}0" in at:
        columns = [at[f"{_TRANSFORM}{k}"] for k in (0, 4, 8, 1, 5, 9, 2, 6, 10)]
        turns = Rotation.from_matrix(stream.values[:, columns].reshape(-1, 3, 3)).as_rotvec()
    elif angles is not None:
        turns = _of_angles({name: stream.values[:, at[name]] * scale_of(
            titles[at[name]], ANGLE_UNITS_RAD, "rad", path) for name in angles}, path)
    else:
        warnings.append(Text("The robot's table has no rotation, so the gripper is assumed not to "
                             "rotate. This is correct for a point grasp (",
                             Option("grasp_mode", "point"), ")."))
        turns = np.zeros((len(stream), 3))
    values |= dict(zip(POSE_COLUMNS[3:], turns.T, strict=True))


def _of_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """Rotation vectors [n, 3]; a quaternion of length 0 is no rotation."""
    length = np.linalg.norm(quaternions, axis=1)
    known = np.isfinite(length) & (length > 1e-6)
    turns = np.full((len(quaternions), 3), np.nan)
    turns[known] = Rotation.from_quat(quaternions[known]).as_rotvec()
    return turns


def _of_angles(angles: dict[str, np.ndarray], path: Path) -> np.ndarray:
    """Rotation vectors [n, 3] of angles [rad] about the fixed axes x, y, z in turn."""
    largest = max(np.nanmax(np.abs(values), initial=0) for values in angles.values())
    if largest > 2 * np.pi + 1e-3:
        raise InputError(f"{path}: the angles {', '.join(angles)} reach {largest:.4g}, in radians.",
                         "They seem to be degrees.",
                         f"Name the unit in their titles, such as {next(iter(angles))} [deg].")
    known = np.isfinite(list(angles.values())).all(axis=0)
    turns = np.full((len(known), 3), np.nan)
    turns[known] = Rotation.from_euler("xyz", np.column_stack(list(angles.values()))[known]
                                       ).as_rotvec()
    return turns
