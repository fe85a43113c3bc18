"""The add-on's preferences: the Python that has the worker."""

import importlib.util
import json
import textwrap
import time
from pathlib import Path

import bpy

from . import compat
from .jobs import worker

KEY = __package__
"""The add-on's name among Blender's."""
_LOOK_AGAIN_SECONDS = 5.0
_ROBOT_CLIENT = "rtde_control"
_looked: dict[str, float | bool] = {}


class LimberPreferences(bpy.types.AddonPreferences):
    """Preferences: the Python that has the worker."""

    bl_idname = __package__

    python_path: bpy.props.StringProperty(
        name="Python with Limber", subtype="FILE_PATH", options=compat.PATH_OPTIONS,
        description="The Python in which Limber's worker is installed, for example "
                    ".venv/bin/python of a checkout. If empty, Limber uses LIMBER_PYTHON, then "
                    "the worker in this extension, then `limber` on the PATH")
    worker_status: bpy.props.StringProperty(options={"SKIP_SAVE"})
    worker_parts: bpy.props.StringProperty(options={"SKIP_SAVE"})

    def draw(self, context):
        layout = self.layout
        layout.prop(self, "python_path")
        layout.operator("limber.check_worker", icon="CHECKMARK")
        if not has_worker():
            for number, line in enumerate(textwrap.wrap(worker_trouble(), 90)):
                layout.label(text=line, icon="BLANK1" if number else "ERROR")
        for line in self.worker_status.splitlines()[:1]:
            layout.label(text=line)
        draw_parts(layout, self.worker_parts)
        column = layout.column(align=True)
        column.label(text="The worker does all computations.", icon="INFO")
        brought = "includes it" if worker.bundled_command() else "does not include it"
        column.label(text=f"This extension {brought}.", icon="BLANK1")


def get(context: bpy.types.Context | None = None) -> LimberPreferences | None:
    """Return the preferences; None if the add-on runs without being enabled (a script)."""
    addon = (context or bpy.context).preferences.addons.get(__package__)
    return addon.preferences if addon else None


def own_folder(name: str) -> Path:
    """Return the folder of this name among the add-on's own; without an installed extension, a
    temporary one."""
    try:
        return Path(bpy.utils.extension_path_user(KEY, path=name))
    except ValueError:
        return Path(bpy.app.tempdir, f"limber-{name}")


def worker_command() -> list[str]:
    """Return how to start the worker; WorkerNotFound states what to do if there is none."""
    chosen = get()
    path = chosen.python_path if chosen else ""
    return worker.worker_command(path, bundled=worker.bundled_command())


def has_worker() -> bool:
    """Whether there is a worker, checked every few seconds only: panels ask at every redraw."""
    now = time.monotonic()
    if now - _looked.get("at", -_LOOK_AGAIN_SECONDS) >= _LOOK_AGAIN_SECONDS:
        bundled = worker.bundled_command()
        try:
            command = worker_command()
        except worker.WorkerNotFound:
            command = []
        _looked.update(at=now, found=bool(command), lacks_robot=bool(command)
                       and command == bundled and importlib.util.find_spec(_ROBOT_CLIENT) is None)
    return bool(_looked["found"])


def lacks_robot() -> bool:
    """Whether the worker is known to have no client for robots, as in the zips with wheels."""
    chosen = get()
    told = "" if chosen is None else _parts_of(chosen.worker_parts).get(_ROBOT_CLIENT, "")
    if told:
        return _lacks(told)
    return has_worker() and bool(_looked["lacks_robot"])


def worker_trouble() -> str:
    """Return why there is no worker and what to do, or an empty text."""
    try:
        worker_command()
    except worker.WorkerNotFound as error:
        return str(error)
    return ""


def draw_parts(layout: bpy.types.UILayout, parts: str) -> None:
    """Draw the worker's parts: name, version, or what does not work without it.

    Args:
        parts: JSON; by name a version, or ``missing: `` and what then does not work.
    """
    known = _parts_of(parts)
    column = layout.column(align=True)
    # Missing parts come first.
    for name, told in sorted(known.items(), key=lambda part: not _lacks(part[1])):
        row = column.split(factor=0.25)
        row.label(text=name, icon="ERROR" if _lacks(told) else "CHECKMARK")
        row.label(text=told)


def _parts_of(parts: str) -> dict[str, str]:
    try:
        return json.loads(parts or "{}")
    except ValueError:
        return {}


def _lacks(told: str) -> bool:
    return told.startswith("missing")


CLASSES = (LimberPreferences,)
register = _looked.clear
