"""The Blender extension Limber: shows branches and starts the worker that computes them.

The add-on computes nothing. ``bridge`` is the only interface between arrays and Blender's data,
``panels`` is the sidebar, and each other folder is one action of the user.
"""

import functools
import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

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
    "branch.branches",
    "command",
)

_undo: list[Callable[[], None]] = []
"""What takes back each step of :func:`register`."""


def register() -> None:
    """Register every module. If one fails, those before it are unregistered.

    A module may have ``CLASSES``; ``HANDLERS``, pairs of an event and a function, kept when another
    file is loaded; ``DRAWN``, a function that draws in the 3D view, and when; ``SHORTCUT``; and its
    own ``register`` and ``unregister`` for the rest.
    """
    import bpy
    try:
        for name in MODULES:
            module = importlib.import_module(f".{name}", __package__)
            for each in getattr(module, "CLASSES", ()):
                bpy.utils.register_class(each)
                _undo.append(functools.partial(bpy.utils.unregister_class, each))
            for event, function in getattr(module, "HANDLERS", ()):
                # An older Blender may not have the event.
                handlers = getattr(bpy.app.handlers, event, [])
                handlers.append(bpy.app.handlers.persistent(function))
                _undo.append(functools.partial(handlers.remove, function))
            if not bpy.app.background:
                _add_to_window(module)
            getattr(module, "register", bool)()
            if hasattr(module, "unregister"):
                _undo.append(module.unregister)
    except BaseException:
        unregister()
        raise


def _add_to_window(module: ModuleType) -> None:
    """Add what a module draws in the 3D view, and its shortcut there."""
    import bpy
    if hasattr(module, "DRAWN"):
        view = bpy.types.SpaceView3D
        handle = view.draw_handler_add(module.DRAWN[0], (), "WINDOW", module.DRAWN[1])
        _undo.append(functools.partial(view.draw_handler_remove, handle, "WINDOW"))
    # Among the add-ons' shortcuts: the user's own have priority, and may change them.
    keys = bpy.context.window_manager.keyconfigs.addon
    if hasattr(module, "SHORTCUT") and keys is not None:
        where, operator, key, given = module.SHORTCUT
        items = keys.keymaps.new(**where).keymap_items
        item = items.new(operator, key, "PRESS", shift=True, alt=True)
        for name, value in given.items():
            setattr(item.properties, name, value)
        _undo.append(functools.partial(items.remove, item))


def unregister() -> None:
    """Unregister everything that :func:`register` registered, in reverse order."""
    while _undo:
        _undo.pop()()
