"""The Blender extension Limber: shows branches and starts the worker that computes them.

The add-on computes nothing. ``bridge`` is the only interface between arrays and Blender's data,
each file of ``operators`` one action, each file of ``panels`` one step of the work.
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
    "operators.worker_operator",
    "operators.import_cloud",
    "operators.run_stage",
    "operators.take_choice",
    "operators.arming",
    "operators.replay",
    "operators.from_cursor",
    "operators.place_goal",
    "operators.drag_goal",
    "operators.open_report",
    "operators.help",
    "operators.open_result",
    "operators.play",
    "operators.picture",
    "operators.seeing",
    "operators.several",
    "operators.presets",
    "operators.start",
    "operators.grab",
    "operators.grab_tool",
    "operators.skeleton",
    "operators.sharing",
    "operators.cancel_job",
    "operators.check_worker",
    "panels.start",
    "panels.job",
    "panels.result",
    "panels.robot",
    "panels.steps",
    "panels.play",
    "panels.pie",
    "overlays.skeleton",
    "overlays.legend",
    "overlays.energy_slice",
    "overlays.graph",
    "frame_colours",
    "goal_ball",
    "overlays.cloud",
    "relative_paths",
    "last_used",
    "warming",
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
