"""The registry of recording formats; their readers are imported when needed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from limber.geometry.io.formats import Format, Registry

_TABLES = (".csv", ".tsv", ".txt", ".trc")
_READERS = "limber.recordings.importing"


@dataclass(frozen=True)
class RecordingFormat(Format):
    """A format of recordings; ``read`` is also called with ``request``, an :class:`ImportRequest`.

    Attributes:
        holds: What ``read`` returns. ``markers``: their tracks as a stream with three columns each
            [m], and their labels. ``robot``: a stream of the gripper's poses and wrenches in the
            branch's frame. ``clouds`` and ``depth``: warnings; it writes them to the folder of the
            pull. ``pull``: a whole :class:`Pull`, or a :class:`.import_request.Recorded`.
            ``force``: a :class:`.force_slope.ForceTable`.
    """

    holds: Literal["markers", "robot", "clouds", "depth", "pull", "force"] = "markers"


RECORDINGS = Registry("recording", "limber.recordings", [
    RecordingFormat("bag", (".mcap", ".db3", ".bag"), f"{_READERS}:read_bag_pull",
                    recognises="limber.recordings.bag_reader:is_bag", holds="pull",
                    about="ROS bag, file or folder"),
    RecordingFormat("pull", (), f"{_READERS}:read_folder", holds="pull", about="Limber pull",
                    recognises=lambda path: (path / "pull.toml").exists()),
    RecordingFormat("rgbd", (), f"{_READERS}:read_rgbd", holds="depth", about="RGB-D folder",
                    recognises=lambda path: (path / "depth").is_dir()),
    RecordingFormat("clouds", (), f"{_READERS}:read_clouds", holds="clouds",
                    recognises=Path.is_dir, about="folder of clouds"),
    RecordingFormat("c3d", (".c3d",), f"{_READERS}:c3d_arrays", isolated=True, about="markers"),
    RecordingFormat("force-displacement", _TABLES, f"{_READERS}:read_force_table",
                    recognises=f"{_READERS}:is_force_table", holds="force", about="force table"),
    RecordingFormat("robot", _TABLES, f"{_READERS}:read_robot", holds="robot", about="RTDE log",
                    recognises=f"{_READERS}:is_robot_log"),
    RecordingFormat("markers", _TABLES, f"{_READERS}:read_markers", about="markers",
                    recognises=Path.is_file),
], of_arrays=f"{_READERS}:markers_of_arrays")
"""Arrays read by a format are markers, as :func:`.importing.c3d_arrays` gives them."""


def kind_names() -> tuple[str, ...]:
    """Return the kinds of recording that a user may give."""
    return "auto", *(one.name for one in RECORDINGS)


def recording_format(name: str) -> RecordingFormat:
    """Return the format of a name among :func:`kind_names`."""
    return next(one for one in RECORDINGS if one.name == name)
