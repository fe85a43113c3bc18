"""The Blender extension Limber: shows branches and starts the worker that computes them.

The add-on computes nothing. ``bridge`` is the only interface between arrays and Blender's data,
``panels`` is the sidebar, and each other folder is one action of the user.
"""

import functools
import importlib
from collections.abc import Callable
from pathlib import Path

# The build puts the reader of tables beside these files; in a checkout the worker has it.
__path__.append(str(Path(__file__).resolve().parents[1] / "worker" / "limber" / "core" / "files"))

# In the order of registration: a class comes after those that it refers to.
MODULES = (
    "preferences",
    "properties",
    "jobs.worker_operator",
    "scan.import_cloud",
    "jobs.run_stage",
    "jobs.take_choice",
    "bend.replay",
    "plan.from_cursor",
    "plan.drag_goal",
    "plan.robot",
    "panels.open_report",
    "panels.guide",
    "branch.open_result",
    "plan.play",
    "show.picture",
    "show.seeing",
    "branch.several",
    "jobs.presets",
    "panels.first_minutes",
    "bend.grab",
    "bend.grab_tool",
    "skeleton.operators",
    "show.sharing",
    "jobs.cancel_job",
    "jobs.check_worker",
    "panels.start",
    "panels.job",
    "panels.result",
    "panels.steps",
    "plan.play_panel",
    "panels.pie",
    "skeleton.node_marks",
    "show.legend",
    "plan.energy_slice",
    "show.graph",
    "show.frame_colours",
    "plan.goal_ball",
    "scan.cloud_overlay",
    "branch.relative_paths",
    "branch.last_used",
    "jobs.warming",
    "command",
)

_undo: list[Callable[[], None]] = []
"""What takes back each step of :func:`register`."""


def register() -> None:
    """Register every module: its ``CLASSES``, then by its own ``register`` if it has one. If one
    fails, those before it are unregistered."""
    import bpy
    try:
        for name in MODULES:
            module = importlib.import_module(f".{name}", __package__)
            for each in getattr(module, "CLASSES", ()):
                bpy.utils.register_class(each)
                _undo.append(functools.partial(bpy.utils.unregister_class, each))
            getattr(module, "register", bool)()
            if hasattr(module, "unregister"):
                _undo.append(module.unregister)
    except BaseException:
        unregister()
        raise


def unregister() -> None:
    """Unregister everything that :func:`register` registered, in reverse order."""
    while _undo:
        _undo.pop()()
